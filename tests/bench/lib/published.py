"""The pages of docs/results, with tables generated from the committed results. `python -m penumbra.tests.bench.lib.published`
writes them; a test compares.

docs/results/data/NAME.json is what `penumbra bench BENCHMARK --json` wrote; NAME is the benchmark's, with -WORD where there are
several results of one. A page has a region of that name between two marks. A region without a file keeps its text, which was
written by hand and says when it was measured.
"""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path

from penumbra.tests.bench.lib.results import ROOT, Result, markdown

PAGES = ROOT / "docs" / "results"
DATA = PAGES / "data"
REGION = re.compile(r"(<!-- ([\w-]+): begin -->\n\n)(.*?)(\n\n<!-- \2: end -->)", re.DOTALL)
MARK = re.compile(r"<!-- ([\w-]+): (begin|end) -->")
BY_HAND = re.compile(r"Measured at [0-9a-f]{7,} or before \(\d{4}-\d\d-\d\d\), copied by hand\.")
"""The note that a region without a file must contain."""


def regions(page: str) -> dict[str, str]:
    """The texts of a page's regions by name. Raises ValueError for a mark without its counterpart."""
    found = {match[2]: match[3] for match in REGION.finditer(page)}
    if (marks := len(MARK.findall(page))) != 2 * len(found):
        raise ValueError(
            "expected each region once: '<!-- NAME: begin -->', an empty line, a text, an empty line, '<!-- NAME: end -->'; got "
            f"{len(found)} regions and {marks} marks; complete the others"
        )
    return found


def text(path: Path) -> str:
    """The text of a result's region: how it was measured, and all that the benchmark shows of it. Raises ValueError for a file
    that no benchmark wrote."""
    result: Result = json.loads(path.read_text())
    benchmark = path.stem.partition("-")[0]
    if "run" not in result:
        raise ValueError(f"{path.name}: expected the key run, got none; write it with `penumbra bench {benchmark} --json`")
    return f"{told(result['run'])}\n\n{markdown(importlib.import_module(f'penumbra.tests.bench.{benchmark}').tables(result))}"


def told(run: Result) -> str:
    """A line that describes a run: command, commit, date, seed, machine."""
    commit = "outside a checkout" if run["commit"] is None else f"commit {run['commit']}{' with changes' * run['modified']}"
    date = run["date"].replace("T", " ").replace("Z", " UTC")
    machine = f"{run['processor']}, {run['cores']} cores, Python {run['python']}"
    return f"`{run['command']}`: {commit}, {date}, seed {run['seed']}; {machine}."


def filled(page: str, data: Path = DATA) -> str:
    """A page with its regions regenerated where their results are in a folder. Raises ValueError."""
    known = {name: text(data / f"{name}.json") for name in regions(page) if (data / f"{name}.json").exists()}
    return REGION.sub(lambda match: f"{match[1]}{known.get(match[2], match[3])}{match[4]}", page)


def unshown(data: Path = DATA) -> set[str]:
    """The results that no page has a region for."""
    known = {name for page in PAGES.glob("*.md") for name in regions(page.read_text())}
    return {path.stem for path in data.glob("*.json")} - known


def main() -> None:
    """Writes all pages."""
    if missing := unshown():
        raise SystemExit(
            f"{DATA.relative_to(ROOT)}: expected a page with a region for each result, got none for "
            f"{', '.join(sorted(missing))}; add its marks"
        )
    for path in sorted(PAGES.glob("*.md")):
        path.write_text(filled(path.read_text()))


if __name__ == "__main__":
    main()
