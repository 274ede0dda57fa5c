"""The benchmark of the start, on one real start."""

import os

import pytest

from penumbra.shared.cell import description as cells
from penumbra.shared.contract.processes import PROCESSES
from penumbra.tests.bench import start


@pytest.mark.slow
def test_a_start_tells_when_each_process_showed_itself_and_when_the_pose_was_tracked(tmp_path):
    found = start.start(start.ROOT, "table", 1, tmp_path)
    cell = cells.load("table")
    used = [process for process in PROCESSES if process.replicas and process.is_needed(cell)]
    names = {process.name for process in used if process.vision in (None, "procnet")}
    assert set(found.seconds) >= names
    assert all(0 < found.seconds["router"] <= seconds for name, seconds in found.seconds.items() if name != "launcher")
    assert found.seconds["segmentation"] > found.seconds["emulator"], "there is no mask before the first frame"
    assert found.seconds["search"] > found.seconds["segmentation"]
    assert all(found.cpu_s[name] > 0 for name in names)


def test_a_start_that_does_not_come_to_a_pose_fails_with_the_launchers_last_words(tmp_path):
    package = tmp_path / "penumbra"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "__main__.py").write_text("print('no licence')")
    with pytest.raises(start.Failed, match="the launcher of cell table ended: no licence"):
        start.start(tmp_path, "table", 1, tmp_path)


def test_a_fresh_copy_holds_the_sources_and_nothing_that_is_compiled():
    with start.fresh() as folder:
        names = {name for _, folders, files in os.walk(folder / "checkout") for name in (*folders, *files)}
        assert {"pyproject.toml", "filter.py", "prednet.npz", "start.py"} <= names
        assert not {name for name in names if name == "__pycache__" or name.endswith((".nbi", ".nbc", ".pyc"))}
        assert not list((folder / "home").iterdir())
    assert not folder.exists()


def test_the_summary_is_the_median_of_each_and_compiling_is_what_a_cold_start_uses_more():
    def once(tracking_s, cpu_s):
        return start.Start({"emulator": tracking_s - 1, "fusion": tracking_s}, {"emulator": 1.0, "fusion": cpu_s})

    result = start.summary([once(9, 6.0), once(8, 5.0), once(20, 9.0)], [once(3, 1.0), once(4, 1.0), once(2, 1.0)])
    assert (result["cold_s"], result["warm_s"]) == (9, 3)
    assert result["services"]["fusion"] == {"cold_s": 9, "warm_s": 3, "compile_cpu_s": 5.0}
    assert result["services"]["emulator"]["compile_cpu_s"] == 0.0
