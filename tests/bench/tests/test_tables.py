"""What the benchmarks show of their results: nothing is lost or taken for another thing on the way into a table."""

import time
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from rich.table import Table

from penumbra.services import flags
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import FusedPose, Truth
from penumbra.shared.recording.file import MAGIC
from penumbra.tests.bench import dashboard, faults, recorder
from penumbra.tests.bench.lib import accuracy, connected, results
from penumbra.tests.support.nodes import pose
from penumbra.tests.support.recorded import entries, new_file, taken


def columns(part: results.Part) -> dict[str, list[str]]:
    """The cells of a table by the heads of its columns."""
    assert isinstance(part, Table)
    return {str(column.header): [str(cell) for cell in column.cells] for column in part.columns}


def row(fault: str, service: str, replicas: int, **numbers: float | None) -> dict[str, Any]:
    usual: dict[str, Any] = {"lasts_s": 5.0, "gap_ms": 40.0, "recovery_s": 5.5, "reused": 0, "false_tracking": 1, "tracking": 100}
    return {"fault": fault, "service": service, "replicas": replicas, "worst_cm": 2.0} | usual | numbers


def test_faults_have_a_row_each_with_the_services_beside_one_another():
    rows = [
        row("slow", "fusion", 1, gap_ms=300.0, worst_cm=7.0),
        row("slow", "fusion", 2, recovery_s=0.4),
        row("slow", "search", 1, recovery_s=None),
        row("slow", "haptics", 1, gap_ms=45.0),
        row("none", "all", 1, recovery_s=0.0, false_tracking=0),
    ]
    (part,) = faults.tables({"seed": 1, "rows": rows})
    found = columns(part)
    assert list(zip(found["fault"], found["of each"], strict=True)) == [("none", "1"), ("slow", "1"), ("slow", "2")]
    assert found["fusion\nback s"] == ["-", "5.50", "0.40"]
    assert found["search\nback s"] == ["-", results.marked("never", False), "-"]
    assert found["all\nback s"] == ["0.00", "-", "-"]
    gaps = ["40 / -", f"45 / {results.marked('300', False)}", "- / 40"]
    assert found["gap ms, fusion\nnot struck / struck"] == gaps
    one, three = (results.marked(count, False) for count in "13")
    assert found["false tracking\nof poses"] == ["0 of 100", f"{three} of 300", f"{one} of 100"]
    assert found["worst cm"] == ["2.0", "7.0", "2.0"]


def connected_row(service: str, fault: str, **numbers: float | None) -> dict[str, Any]:
    usual: dict[str, Any] = {"lasts_s": 3.0, "back_s": 4.0, "missing_s": 4.1, "before_s": None, "gap_ms": None}
    return {"service": service, "fault": fault} | usual | numbers


def test_services_that_connect_have_a_row_for_each_fault_and_what_is_late_or_lost_is_marked():
    rows = [
        connected_row("record", "kill", before_s=0.2, gap_ms=20.0),
        connected_row("record", "freeze", before_s=0.4, gap_ms=80.0, back_s=4.6),
        connected_row("robot", "freeze", back_s=None),
    ]
    chain, part = faults.tables({"seed": 1, "rows": [row("none", "all", 1)], "connected": rows})
    assert columns(chain)["fault"] == ["none"] and len(faults.tables({"seed": 1, "rows": [], "connected": rows})) == 1
    found = columns(part)
    assert list(zip(found["service"], found["fault"], strict=True)) == [(each["service"], each["fault"]) for each in rows]
    assert found["back s"] == ["4.00", results.marked("4.60", False), results.marked("never", False)]
    assert found["of it before the fault s"] == ["0.20", results.marked("0.40", False), "-"]
    assert found["gap ms of the chain's pose"] == ["20", results.marked("80", False), "-"]


def test_what_a_recorder_costs_is_compared_by_pairs_and_a_pair_without_an_age_is_left_out():
    usual: dict[str, Any] = {"haptic_hz": 50.0, "fused_hz": 200.0, "chain_cores": 1.0}
    without = [usual | {"vision_hz": hz, "age_ms": 30.0} for hz in (20.0, 10.0)]
    beside = [
        usual | {"vision_hz": 0.9 * hz, "age_ms": age_ms, "recorder_cores": 0.1, "mb_per_s": 1.0}
        for hz, age_ms in ((20.0, 33.0), (10.0, None))
    ]
    (part,) = recorder.tables({"cell": "table", "seed": 1, "seconds": 5.0, "without": without, "beside": beside})
    found = columns(part)
    assert found["change %"][0] == results.marked("-10.0 +- 0.0", False) and found["change %"][2] == "+0.0 +- 0.0"
    assert found["change %"][3].startswith("+10.0 +- nan")
    assert found["with a recorder"][-2:] == ["0.10", "1.00"]


def planned(*words: str) -> dict[str, list[str]]:
    command = faults.main
    return faults.connected_plan(flags.parse(command.params, words))


def test_faults_and_services_that_are_named_are_struck_alone(monkeypatch):
    monkeypatch.setattr(connected, "lacks", lambda service: "it is not installed" if service == "ros2" else "")
    assert planned().keys() == connected.SERVICES.keys() - {"ros2"}
    assert planned("--service", "record", "--service", "fusion") == {"record": list(connected.SERVICES["record"])}
    assert planned("--fault", "other end hangs") == {"camera": ["other end hangs"], "robot": ["other end hangs"]}
    assert planned("--replicas", "2") == {} == planned("--fault", "slow")


def test_files_of_a_recorder_that_was_killed_count_as_far_as_they_can_be_read(tmp_path):
    table = cells.load("table")
    began_s = time.monotonic()
    said = [taken(table, topics.FUSED, {"target": "forearm"}, pose(x=0.01 * k), k) for k in range(30)]
    file = new_file(tmp_path / "run.mcap")
    for entry in entries(table, said[:20]):
        file.write(entry)
    file.flush()
    for entry in entries(table, said[20:]):
        file.write(entry)  # and it is killed
    (tmp_path / "run-2.mcap").write_bytes(MAGIC)
    found = connected.recorded(tmp_path)
    assert len(found) == 20
    assert all(began_s - 1.0 < at_s < time.monotonic() + 1.0 for at_s in found)


@pytest.mark.parametrize(("off_m", "shown"), [(0.01, "1.00"), (0.04, results.marked("4.00", False))])
def test_errors_stand_in_the_row_of_their_situation_and_a_missed_goal_is_marked(off_m, shown):
    table = cells.load("table")
    truths, poses = [], []
    for k in range(40):
        at: dict[str, Any] = {"stamp_ns": k * 100_000_000, "target": "forearm", "frame": "world", "velocity": np.zeros(6)}
        at |= {"orientation": np.array([0.0, 0.0, 0.0, 1.0])}
        truths.append(Truth(**at, position=np.array([0.0, 0.0, 0.2]), hidden=0.1, gap=0.5))
        said: dict[str, Any] = {"state": "coasting" if k % 2 else "tracking", "covariance": np.eye(6), "sources": {}}
        poses.append(FusedPose(**at, **said, position=np.array([off_m, 0.0, 0.2])))
    estimates: dict[str, list] = {"vision": [], "haptic": [], "fused": poses}
    options = SimpleNamespace(seed=1, seconds=4.0)
    found = accuracy.summary(table, options, truths, estimates, 4.0)
    part = accuracy.table(found)
    by_head = columns(part)
    far = by_head["situation"].index("visible, out of range")
    assert by_head["fused"][far].startswith(f"{shown} (") and by_head["vision"] == ["-"] * 4
    assert [text == "-" for text in by_head["fused"]] == [k != far for k in range(4)]
    assert by_head["s"][far] == "4.0" and "50.0% coasting" in str(part.caption)
    # the covariance is that of poses within metres
    assert found["fused_beyond_3_sigma"] == 0.0 and "0.00% are beyond three sigma" in str(part.caption)
    sure = [msgspec.structs.replace(pose, covariance=1e-6 * np.eye(6)) for pose in poses]
    assert accuracy.beyond_3_sigma(truths, sure) == 1.0 and accuracy.beyond_3_sigma(truths, poses[1::2]) is None


def test_what_a_page_costs_is_the_median_of_turns_beside_each_other_and_a_slower_chain_is_marked():
    def side(frames: float, cpu: float) -> dict[str, Any]:
        rates = {"frames_per_s": frames, "haptic_per_s": 50.0, "fused_per_s": 200.0}
        return rates | {"shown_per_s": {"picture": 40.0, "moment": 59.0}, "cpu": 1.0, "dashboard_cpu": cpu}

    # the machine was busy with something else in the second turn, without and with pages alike
    pairs = [{"without": side(frames, 0.02), "with": side(0.9 * frames, 0.1)} for frames in (20.0, 4.0, 20.0)]
    (part,) = dashboard.tables({"cell": "table", "seed": 1, "seconds": 4.0, "pages": 2, "pairs": pairs})
    found = columns(part)
    assert found["change"][:2] == [results.marked("-10.0 % (-10.0 to -10.0)", False), "+0.0 % (+0.0 to +0.0)"]
    assert found["with"][3:] == [results.marked("0.100 cores", False), "1.00 cores", "29.5", "20.0"], "of each page"
