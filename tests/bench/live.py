"""`penumbra bench live`: the whole chain as real processes, measured from outside over the bus.

Ages come from the emulator's exposure and sample stamps on the same clock; errors are taken at each estimate's own stamp against
the truth there. Motion and occlusion are drawn from `--seed`.
"""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

import numpy as np
import psutil
import zenoh
from rich.table import Table

from penumbra.services import flags
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.contract.processes import PROCESSES
from penumbra.shared.runtime import scheduling
from penumbra.tests.bench.lib import accuracy, results
from penumbra.tests.bench.lib.accuracy import SENSES, percentiles
from penumbra.tests.bench.lib.results import Part, Result, marked
from penumbra.tests.support.live import penumbra_up, wait_for

RATES = (("frames_per_s", "frames used per second", 19.0), ("fused_hz", "fused poses per second", 100.0))
AGES = (
    ("age_ms", "exposure to fused pose, p50 / p95 ms", 80.0),
    ("haptic_age_ms", "skin sample to haptic pose, p50 / p95 ms", 10.0),
)
"""Keys of the result, their names and their goals; the cameras of the built-in cells give 20 frames a second."""
CPU_GOAL = 0.8
"""Maximum CPU [cores] of all processes but the emulator."""


class Recording:
    """Everything that arrives on some topics: receive stamp and payload, decoded only afterwards."""

    def __init__(self, session: zenoh.Session, cell: str, target: str):
        self.samples: dict[str, list[tuple[int, bytes]]] = {}
        self._subscribers = []
        for topic in (*SENSES.values(), topics.TRUTH):
            rows = self.samples.setdefault(topic.name, [])
            subscriber = session.declare_subscriber(topic.at(cell=cell, target=target), zenoh.handlers.FifoChannel(1000))
            threading.Thread(target=self._read, args=(subscriber, rows), daemon=True).start()
            self._subscribers.append(subscriber)

    @staticmethod
    def _read(subscriber: Any, rows: list[tuple[int, bytes]]) -> None:
        for sample in subscriber:
            rows.append((time.time_ns(), sample.payload.to_bytes()))

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()

    def decoded(self, topic: topics.Topic) -> tuple[np.ndarray, list[Any]]:
        """Receive stamps [ns] (n,) and messages."""
        rows = self.samples[topic.name]
        return np.array([row[0] for row in rows], dtype=np.int64), [messages.decode(topic.message, row[1]) for row in rows]


def fused_ages_s(vision: list[messages.VisionPose], fused: list[messages.FusedPose]) -> np.ndarray:
    """Ages [s] of tracked frames: from the exposure to the first fused pose that uses the frame."""
    with_vision = [f for f in fused if "vision" in f.sources]
    taken_in = np.array([f.stamp_ns - f.sources["vision"].age_s * 1e9 for f in with_vision])
    newest = np.maximum.accumulate(taken_in) if len(taken_in) else taken_in
    ages = []
    for pose in vision:
        first = int(np.searchsorted(newest, pose.stamp_ns - 1e6))
        if pose.state == "tracking" and first < len(newest):
            ages.append((with_vision[first].stamp_ns - pose.stamp_ns) * 1e-9)
    return np.array(ages)


def cpu_times(processes: dict[str, psutil.Process]) -> dict[str, float]:
    out = {}
    for name, process in processes.items():
        if process.is_running():
            times = process.cpu_times()
            out[name] = times.user + times.system
    return out


def tables(result: Result) -> list[Part]:
    """Rates, ages and CPU beside their goals, then the errors."""
    table = Table("", "measured", "goal", title=f"Cell {result['cell']}, seed {result['seed']}, {result['seconds']:g} s")
    for key, name, goal in RATES:
        table.add_row(name, marked(f"{result[key]:.1f}", result[key] >= goal), f">= {goal:g}")
    for key, name, goal in AGES:
        p50, p95 = result[key]["p50"], result[key]["p95"]
        table.add_row(name, "-" if p95 is None else marked(f"{p50:.1f} / {p95:.1f}", p95 <= goal), f"p95 <= {goal:g}")
    names = ", ".join(process.name for process in PROCESSES if process.goes_first)
    table.add_row(f"{names} in real time", "yes" if result["in_real_time"] else "no", "")
    for name, share in result["cpu"].items():
        table.add_row(f"CPU of {name}", f"{share:.2f} cores", "")
    own = sum(share for name, share in result["cpu"].items() if name != "emulator")
    table.add_row("CPU of all but the emulator", marked(f"{own:.2f} cores", own <= CPU_GOAL), f"<= {CPU_GOAL:g} cores")
    return [table, accuracy.table(result)]


@results.benchmark(
    "live",
    __doc__ or "",
    tables,
    flags.Option("--cell", default="table", help="built-in cell or YAML file"),
    flags.Option("--seconds", type=flags.above_zero, default=60.0, help="length of the measurement"),
    flags.Option("--seed", type=int, default=1, help="draws motion, occlusion and appearance"),
    flags.Option("--up", takes="rest", metavar="WORDS", help="further arguments for `penumbra up` (last)"),
    example="penumbra bench live --json live.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    cell = cells.load(options.cell)
    target = cell.one("targets", None)
    with penumbra_up(options.cell, options.seed, *options.up) as running:
        wait_for(running.is_tracking, 120, "a tracked pose", 0.5)
        processes = running.processes()
        first = [processes[process.name] for process in PROCESSES if process.goes_first and process.name in processes]
        in_real_time = all(scheduling.goes_first(process.pid) for process in first)
        recording = Recording(running.session, cell.name, target)
        scheduling.go_first(with_children=False)  # or ages contain this process's own waiting
        cpu_before, started = cpu_times(processes), time.monotonic()
        time.sleep(options.seconds)
        elapsed, cpu_after = time.monotonic() - started, cpu_times(processes)
        recording.close()
    received, estimates = {}, {}
    for sense, topic in SENSES.items():
        received[sense], estimates[sense] = recording.decoded(topic)
    haptic_age = received["haptic"] - np.array([h.sample_stamp_ns for h in estimates["haptic"]], dtype=np.int64)
    report.save({
        **accuracy.summary(cell, options, recording.decoded(topics.TRUTH)[1], estimates, elapsed),
        "frames_per_s": round(len(estimates["vision"]) / elapsed, 2),
        "fused_hz": round(len(estimates["fused"]) / elapsed, 2),
        "age_ms": percentiles(fused_ages_s(estimates["vision"], estimates["fused"]), 1e3),
        "haptic_age_ms": percentiles(haptic_age, 1e-6),
        "in_real_time": in_real_time,
        "cpu": {name: round((cpu_after[name] - cpu_before[name]) / elapsed, 3) for name in cpu_after},
    })  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
