"""`penumbra bench live`: the whole chain as real processes, measured from outside over the bus.

Ages come from the emulator's exposure and sample stamps on the same clock; errors are taken at each estimate's own stamp against
the truth there. Motion and occlusion are drawn from `--seed`.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import zenoh
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from penumbra.services import flags
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.tests.support.live import penumbra_up, wait_for

VISIBLE = 0.33
"""At most this share of the target hidden: visible (the paper's light occlusion)."""
OCCLUDED, OCCLUDED_S = 0.90, 2.0
"""More than this share hidden, for at least this long: occluded."""

SENSES = {"vision": topics.VISION, "haptic": topics.HAPTIC, "fused": topics.FUSED}
USED_STATES = {"tracking", "in_range", "coasting"}


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


@dataclass
class TruthTrack:
    """The truth as arrays over its stamps, and the situation at each of them."""

    stamp_ns: np.ndarray
    position: np.ndarray
    axis: np.ndarray
    hidden: np.ndarray
    gap: np.ndarray

    @classmethod
    def of(cls, truths: list[messages.Truth]) -> TruthTrack:
        truths = sorted(truths, key=lambda truth: truth.stamp_ns)
        axis = Rotation.from_quat([t.orientation for t in truths]).as_matrix()[:, :, 0]
        return cls(
            np.array([t.stamp_ns for t in truths]),
            np.array([t.position for t in truths]),
            axis,
            np.array([t.hidden for t in truths]),
            np.array([t.gap for t in truths]),
        )

    def situations(self, reach: float) -> dict[tuple[str, str], np.ndarray]:
        """(visible|occluded, in_range|out_of_range) to a boolean per stamp."""
        occluded = long_runs(self.hidden > OCCLUDED, self.stamp_ns, OCCLUDED_S)
        sight = {"visible": self.hidden <= VISIBLE, "occluded": occluded}
        skin = {"in_range": self.gap <= reach, "out_of_range": self.gap > reach}
        return {(a, b): seen & felt for a, seen in sight.items() for b, felt in skin.items()}

    def errors(self, estimates: list[Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For estimates within the track: index of the nearest truth, position error [m], angle between limb axes [rad]."""
        estimates = [e for e in estimates if self.stamp_ns[0] <= e.stamp_ns <= self.stamp_ns[-1]]
        if not estimates:
            return np.zeros(0, int), np.zeros(0), np.zeros(0)
        stamps = np.array([e.stamp_ns for e in estimates])
        at = lambda values: np.column_stack([np.interp(stamps, self.stamp_ns, column) for column in values.T])  # noqa: E731
        position = np.linalg.norm(np.array([e.position for e in estimates]) - at(self.position), axis=1)
        axis = Rotation.from_quat([e.orientation for e in estimates]).as_matrix()[:, :, 0]
        truth_axis = at(self.axis)
        cosine = np.sum(axis * truth_axis, axis=1) / np.linalg.norm(truth_axis, axis=1)
        nearest = np.searchsorted(self.stamp_ns, stamps).clip(0, len(self.stamp_ns) - 1)
        return nearest, position, np.arccos(cosine.clip(-1, 1))


def long_runs(flags: np.ndarray, stamps_ns: np.ndarray, seconds: float) -> np.ndarray:
    """`flags`, without the runs of true that last less than `seconds`."""
    out = np.zeros_like(flags)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        if (stamps_ns[end - 1] - stamps_ns[start]) * 1e-9 >= seconds:
            out[start:end] = True
    return out


def fused_ages_s(vision: list[messages.VisionPose], fused: list[messages.FusedPose]) -> np.ndarray:
    """For each tracked frame: from its exposure to the first fused pose that has taken it in."""
    with_vision = [f for f in fused if "vision" in f.sources]
    taken_in = np.array([f.stamp_ns - f.sources["vision"].age_s * 1e9 for f in with_vision])
    newest = np.maximum.accumulate(taken_in) if len(taken_in) else taken_in
    ages = []
    for pose in vision:
        first = int(np.searchsorted(newest, pose.stamp_ns - 1e6))
        if pose.state == "tracking" and first < len(newest):
            ages.append((with_vision[first].stamp_ns - pose.stamp_ns) * 1e-9)
    return np.array(ages)


def percentiles(values: np.ndarray, scale: float = 1.0) -> dict[str, float | None]:
    if len(values) == 0:
        return {"p50": None, "p95": None}
    return {"p50": round(float(np.percentile(values, 50)) * scale, 3), "p95": round(float(np.percentile(values, 95)) * scale, 3)}


def cpu_times(processes: dict[str, psutil.Process]) -> dict[str, float]:
    out = {}
    for name, process in processes.items():
        if process.is_running():
            times = process.cpu_times()
            out[name] = times.user + times.system
    return out


def accuracy(truths: list[messages.Truth], estimates: dict[str, list[Any]], reach: float, seconds: float) -> dict[str, Any]:
    """Errors of each sense's estimates in each situation, how long the situations lasted, and the fused states."""
    truth = TruthTrack.of(truths)
    situations = truth.situations(reach)
    result: dict[str, Any] = {}
    for key in ("error_cm", "error_p95_cm", "axis_deg", "samples"):
        result[key] = {sight: {skin: {} for skin in ("in_range", "out_of_range")} for sight in ("visible", "occluded")}
    for sense, found in estimates.items():
        nearest, position, angle = truth.errors([e for e in found if e.state in USED_STATES])
        for (sight, skin), chosen in situations.items():
            inside = chosen[nearest]
            position_cm = percentiles(position[inside], 100)
            result["error_cm"][sight][skin][sense] = position_cm["p50"]
            result["error_p95_cm"][sight][skin][sense] = position_cm["p95"]
            result["axis_deg"][sight][skin][sense] = percentiles(np.degrees(angle[inside]))["p50"]
            result["samples"][sight][skin][sense] = int(inside.sum())
    states = [f.state for f in estimates["fused"]]
    result["fused_states"] = {
        state: round(states.count(state) / max(len(states), 1), 4) for state in ("tracking", "coasting", "lost")
    }
    result["situation_s"] = {
        sight: {skin: round(float(situations[sight, skin].mean()) * seconds, 1) for skin in ("in_range", "out_of_range")}
        for sight in ("visible", "occluded")
    }
    return result


def measure(recording: Recording, reach: float, seconds: float) -> dict[str, Any]:
    """The numbers of a recording of `seconds`: rates, ages and accuracy."""
    received, estimates = {}, {}
    for sense, topic in SENSES.items():
        received[sense], estimates[sense] = recording.decoded(topic)
    haptic_age = received["haptic"] - np.array([h.sample_stamp_ns for h in estimates["haptic"]], dtype=np.int64)
    return {
        "frames_per_s": round(len(estimates["vision"]) / seconds, 2),
        "fused_hz": round(len(estimates["fused"]) / seconds, 2),
        "age_ms": percentiles(fused_ages_s(estimates["vision"], estimates["fused"]), 1e3),
        "haptic_age_ms": percentiles(haptic_age, 1e-6),
        **accuracy(recording.decoded(topics.TRUTH)[1], estimates, reach, seconds),
    }


def reach_of(cell: cells.Cell) -> float:
    """The longest range of the cell's pads [m]."""
    return max(cell.pad_types[pad.type].range for pad in cell.pads.values())


def show(result: dict[str, Any], console: Console) -> None:
    table = Table("", "measured", "goal", title=f"cell {result['cell']}, seed {result['seed']}, {result['seconds']} s")
    table.add_row("frames used per second", f"{result['frames_per_s']:.1f}", ">= 15")
    table.add_row("fused poses per second", f"{result['fused_hz']:.0f}", ">= 100")
    table.add_row("exposure to fused pose, p50 / p95 ms", "{p50} / {p95}".format(**result["age_ms"]), "p95 <= 100")
    table.add_row("skin sample to haptic pose, p50 / p95 ms", "{p50} / {p95}".format(**result["haptic_age_ms"]), "p95 <= 10")
    for name, share in result["cpu"].items():
        table.add_row(f"CPU of {name}", f"{share:.2f} cores", "")
    console.print(table)
    show_errors(result, console)


def show_errors(result: dict[str, Any], console: Console) -> None:
    title = f"cell {result['cell']}, seed {result['seed']}: position error cm, median (p95); limb axis deg, median"
    table = Table("situation", "s", *SENSES, "goal", title=title)
    for sight in ("visible", "occluded"):
        for skin in ("in_range", "out_of_range"):
            columns = []
            for sense in SENSES:
                median, p95, axis = (result[key][sight][skin][sense] for key in ("error_cm", "error_p95_cm", "axis_deg"))
                columns.append("-" if median is None else f"{median:.2f} ({p95:.2f})  {axis:.1f}")
            goal = {"visible": "fused <= 2.0", "occluded": "fused <= 2.5" if skin == "in_range" else ""}[sight]
            table.add_row(f"{sight}, {skin}", str(result["situation_s"][sight][skin]), *columns, goal)
    console.print(table)


@flags.command(
    "bench live",
    __doc__ or "",
    flags.Option("--cell", default="table", help="built-in cell or YAML file"),
    flags.Option("--seconds", type=flags.above_zero, default=60.0, help="length of the measurement"),
    flags.Option("--seed", type=int, default=1, help="draws motion, occlusion and appearance"),
    flags.Option("--json", type=Path, metavar="FILE", help="write the numbers to this file"),
    flags.Option("--up", takes="rest", metavar="WORDS", help="further arguments for `penumbra up` (last)"),
    example="penumbra bench live --json live.json",
)
def main(options: flags.Options) -> int:
    cell = cells.load(options.cell)
    target = cell.one("targets", None)
    with penumbra_up(options.cell, options.seed, *options.up) as running:
        wait_for(running.is_tracking, 120, "a tracked pose", 0.5)
        processes = running.processes()
        recording = Recording(running.session, cell.name, target)
        cpu_before, started = cpu_times(processes), time.monotonic()
        time.sleep(options.seconds)
        elapsed, cpu_after = time.monotonic() - started, cpu_times(processes)
        recording.close()
    result = {"cell": cell.name, "seed": options.seed, "seconds": options.seconds, **measure(recording, reach_of(cell), elapsed)}
    result["cpu"] = {name: round((cpu_after[name] - cpu_before[name]) / elapsed, 3) for name in cpu_after}
    show(result, Console())
    if options.json:
        options.json.write_text(json.dumps(result, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
