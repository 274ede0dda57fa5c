"""Common parts of the benchmarks: their files, the description of a run, the same tables on the screen and on a page."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.table import Table

from penumbra.services import flags
from penumbra.services.command import cli
from penumbra.tests.bench.lib import published, results

ROWS = [["near [1, 2]", 0.5, True], ["far | away", 2.0, False]]


def tables(result: results.Result) -> list[results.Part]:
    table = Table("where\nit is", "cm", title="Errors", caption="Less is better")
    for name, value, is_met in result["rows"]:
        table.add_row(name, results.marked(f"{value:.2f}", is_met))
    return [table, f"In all: {results.marked('2', False)} rows."]


@results.benchmark("tiny", "About.", tables, flags.Option("--seed", type=int, default=1), flags.Option("--weights"), example="")
def tiny(options: flags.Options, report: results.Report) -> None:
    for count in (1, 2):
        report.save({"seed": options.seed, "rows": ROWS[:count]})
        if options.weights == "broken":
            raise RuntimeError("after the first row")


def git(*words: str, cwd: Path) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    return subprocess.run(["git", *identity, *words], cwd=cwd, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A small checkout to which the run is attributed."""
    folder = tmp_path.resolve() / "checkout"
    (folder / "docs").mkdir(parents=True)
    (folder / "code.py").write_text("1")
    git("init", cwd=folder)
    git("add", "-A", cwd=folder)
    git("commit", "-m", "first", cwd=folder)
    monkeypatch.setattr(results, "ROOT", folder)
    return folder


def test_the_file_has_what_the_benchmark_found_and_how_it_was_run(tmp_path, checkout):
    path = tmp_path / "tiny.json"
    assert tiny(["--seed", "7", "--weights", f"{tmp_path}/sub/w.npz", "--json", str(path)]) == 0
    found = json.loads(path.read_text())
    assert (found["seed"], found["rows"]) == (7, ROWS)
    run = found["run"]
    assert run["command"] == "penumbra bench tiny --seed 7 --weights w.npz --json tiny.json"
    assert (run["seed"], run["modified"]) == (7, False)
    assert run["commit"] == git("rev-parse", "--short", "HEAD", cwd=checkout)
    assert set(run) == {"command", "seed", "commit", "modified", "date", "processor", "cores", "python"}
    assert [file.name for file in tmp_path.glob("tiny*")] == ["tiny.json"]


@pytest.mark.parametrize(("name", "modified"), [("code.py", True), ("new.py", True), ("docs/data.json", False), ("A.md", False)])
def test_a_checkout_with_changes_is_told_but_for_its_documents(checkout, name, modified):
    (checkout / name).write_text("2")
    with flags.Command("bench tiny", "", params=[flags.Option("--seed", type=int, default=1)]).make_context("", []):
        assert results.run()["modified"] is modified


def test_outside_a_checkout_there_is_no_commit(tmp_path, checkout, monkeypatch):
    (checkout / "inside").mkdir()
    monkeypatch.setattr(results, "ROOT", checkout / "inside")  # as an installation below another project's checkout
    with flags.Command("bench tiny", "", params=[flags.Option("--seed", type=int, default=1)]).make_context("", []):
        assert (results.run()["commit"], results.run()["modified"]) == (None, False)


def test_only_the_last_part_of_a_path_is_told():
    words = ["--cell", "/home/me/mine.yaml", "--json=/a/b.json", "--segmentation", "--weights /a/w.npz", "--ratio", "1/"]
    told = "penumbra bench replay --cell mine.yaml --json=b.json --segmentation '--weights w.npz' --ratio 1/"
    assert results.command_line("penumbra bench replay", words) == told


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("missing/a.json", "expected a file in a folder that exists, got '{0}/missing/a.json'; create the folder {0}/missing"),
        ("", "expected the name of a file, got '{0}/', which is something else; choose another name"),
    ],
)
def test_a_file_that_cannot_be_written_is_refused_before_the_benchmark_starts(tmp_path, capsys, path, expected):
    assert cli.main(["bench", "live", "--json", f"{tmp_path}/{path}"]) == 2
    assert capsys.readouterr().err.startswith(f"penumbra bench live: --json: {expected.format(tmp_path)}")


def test_a_folder_that_cannot_be_written_to_is_refused_before_the_benchmark_starts(tmp_path, capsys):
    folder = Path("/proc/self") if os.geteuid() == 0 else tmp_path / "closed"  # root may write to any other
    if os.geteuid() != 0:
        folder.mkdir(mode=0o500)
    assert cli.main(["bench", "live", "--json", f"{folder}/a.json"]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"penumbra bench live: --json: expected a folder that can be written to, got '{folder}' (")
    assert cli.main(["bench", "paper", "--out", f"{folder}/sub"]) == 2
    assert "penumbra bench paper: --out: expected a folder that can be made" in capsys.readouterr().err


def test_a_write_that_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    results.write(path, {"a": 1})
    with pytest.raises(TypeError):
        results.write(path, {"a": object()})
    assert json.loads(path.read_text()) == {"a": 1}


def test_what_was_saved_before_an_error_is_kept_and_shown(tmp_path, capsys):
    with pytest.raises(RuntimeError, match="after the first row"):
        tiny(["--weights", "broken", "--json", str(tmp_path / "tiny.json")])
    assert json.loads((tmp_path / "tiny.json").read_text())["rows"] == ROWS[:1]
    assert "near [1, 2]" in capsys.readouterr().out


def test_the_page_shows_what_the_screen_shows(capsys):
    parts = tables({"rows": ROWS})
    assert results.markdown(parts) == (
        "*Errors*\n\n| where it is | cm |\n|---|---|\n| near [1, 2] | 0.50 |\n| far \\| away | **2.00** |\n\nLess is better\n\n"
        "In all: **2** rows."
    )
    results.show(parts)
    shown = capsys.readouterr().out
    assert all(text in shown for text in ("Errors", "near [1, 2]", "0.50", "2.00", "Less is better", "In all: 2 rows."))


# ---- pages

PAGE = """# Page

<!-- tiny-one: begin -->

Measured at 1234567 or before (2026-11-21), copied by hand.

<!-- tiny-one: end -->

Between.

<!-- other: begin -->

By hand.

<!-- other: end -->
"""


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A folder with a result of the benchmark above."""
    monkeypatch.setattr(published.importlib, "import_module", {"penumbra.tests.bench.tiny": sys.modules[__name__]}.__getitem__)
    assert tiny(["--seed", "7", "--json", str(tmp_path / "tiny-one.json")]) == 0
    return tmp_path


def test_a_region_is_made_of_its_file_and_one_without_keeps_its_text(data):
    page = published.filled(PAGE, data)
    run = json.loads((data / "tiny-one.json").read_text())["run"]
    own, other = published.regions(page).values()
    line, rest = own.split("\n\n", 1)
    assert line.startswith("`penumbra bench tiny --seed 7 --json tiny-one.json`: commit ") and ", seed 7; " in line
    assert run["date"].replace("T", " ").removesuffix("Z") in line and run["processor"] in line
    assert rest == results.markdown(tables({"rows": ROWS}))
    assert other == "By hand." and "\n\nBetween.\n\n" in page
    assert published.filled(page, data) == page


def test_a_file_that_no_benchmark_wrote_is_refused(data):
    results.write(data / "tiny-one.json", {"rows": ROWS})
    with pytest.raises(ValueError, match=r"tiny-one\.json: expected the key run, got none; write it with `penumbra bench tiny"):
        published.filled(PAGE, data)


@pytest.mark.parametrize("mark", ["<!-- tiny-one: end -->", "<!-- other: begin -->"])
def test_a_mark_without_its_other_one_is_refused(mark):
    with pytest.raises(ValueError, match="got 1 regions and 3 marks"):
        published.regions(PAGE.replace(mark, ""))


def test_a_result_without_a_page_is_told(data):
    assert published.unshown(data) == {"tiny-one"}
