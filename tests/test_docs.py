"""The documents tell the truth: their links lead somewhere, and the site builds without a warning."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from penumbra.tests.bench.lib import published

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_leads_to_a_file(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", text)
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing


def test_the_site_builds_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    assert {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("index.html")} >= {
        "index.html",
        "install/index.html",
    }


def test_every_page_is_in_the_menu_of_the_site():
    menu = (ROOT / "mkdocs.yml").read_text()
    pages = {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}
    assert not {page for page in pages if f"- {page}\n" not in menu}


def test_the_page_of_messages_is_that_of_the_tables():
    written = runpy.run_path(str(ROOT / "docs" / "messages.py"))
    assert (ROOT / "docs" / "messages.md").read_text() == written["page"](), "run `just docs`"


@pytest.mark.parametrize("page", sorted(published.PAGES.glob("*.md")), ids=lambda page: page.name)
def test_the_tables_of_the_results_are_what_their_files_give(page):
    text = page.read_text()
    assert published.filled(text) == text, "run `just results`"


def test_every_result_has_its_page():
    assert not published.unshown()


@pytest.mark.parametrize("page", sorted(published.PAGES.glob("*.md")), ids=lambda page: page.name)
def test_a_table_that_was_copied_by_hand_says_when_it_was_measured(page):
    by_hand = {
        name: text for name, text in published.regions(page.read_text()).items() if not (published.DATA / f"{name}.json").exists()
    }
    assert not [name for name, text in by_hand.items() if not published.BY_HAND.match(text)]
