"""What the benchmarks show of their results: nothing is lost or taken for another thing on the way into a table."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.table import Table

from penumbra.shared.cell import description as cells
from penumbra.shared.contract.messages import FusedPose, Truth
from penumbra.tests.bench import faults
from penumbra.tests.bench.lib import accuracy, results


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
