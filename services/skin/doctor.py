"""`penumbra doctor --skin`: listens to the pads of a running cell, reports faults, and says how to repair them.

Faults of an electrode show in its voltages (`shared.skin.faults.Watch`). A pad that is mounted wrongly, or has another pad's
calibration, reads plausible signals, but not those of this limb: they differ from the field model's signals at the fused pose.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from penumbra.shared.body.posture import Posture
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import report, topics
from penumbra.shared.contract.messages import FusedPose, Joints, Voltages
from penumbra.shared.geometry.rigid import Array, transform
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.shared.skin.faults import MENDS, MISFIT, Fault, Look, Watch, likely
from penumbra.shared.skin.layout import Skin, link_names

PATIENCE_S = 1.0
"""Maximum time [s] to wait for the router."""
NEAR_NS = 15_000_000
"""Maximum difference [ns] between the stamps of voltages and of the pose and joints that are used for them."""
IN_REACH_V = (0.005, 0.4)
"""Range of a pad's largest predicted signal [V] in which it is compared with the pose: less says little, and more means a gap too
small for the model's errors."""
SLOPE = 3.0
"""Maximum power of the gap with which a signal falls: the signal's relative error is this factor times the gap's."""
TOGETHER = 25
"""Number of moments per compared mean: half a second, so that noise hides no contrast."""
LEAST = 4
"""Minimum number of such means in reach for a comparison."""
LEAST_EMPTY = 25
"""Minimum number of moments with nothing near for an estimate of the offsets."""
NOTHING_V = 5e-4
"""Predicted signal [V] below which a scene counts as empty."""
OFFSET_V = 3e-3
"""Maximum signal [V] of a healthy electrode in an empty scene."""


@dataclass
class Pad:
    """Data received from one pad: its watch, its looks, the faults seen, and moments: predicted and measured signals (e,) [V],
    the variance of the measured ones (e,) [V^2], and the relative error of the predicted ones due to the pose."""

    watch: Watch
    looks: list[Look] = field(default_factory=list)
    faults: dict[str, Fault] = field(default_factory=dict)
    moments: list[tuple[Array, Array, Array, float]] = field(default_factory=list)


class Examination:
    """Collects messages from the bus, in several threads, and judges the pads."""

    def __init__(self, cell: cells.Cell):
        self.cell, self.skin = cell, Skin(cell)
        self.pads = {name: Pad(Watch(self.skin, k)) for k, name in enumerate(self.skin.pads)}
        self.notes: list[str] = []
        self._target = next(iter(cell.targets))
        self._posture = Posture.usual(cell, cell.targets[self._target])
        self._robots = robot_models(cell)
        self._poses: deque[FusedPose] = deque(maxlen=200)
        self._joints: dict[str, deque[Joints]] = {name: deque(maxlen=100) for name in cell.robots}
        self._lock = threading.Lock()
        try:
            from penumbra.shared.skin.response import Response

            self._response: Response | None = Response(cell, self._target)
        except (cells.CellError, ImportError) as error:
            self._response = None
            self.notes.append(f"no comparison with the pose: {error}")

    def voltages(self, message: Voltages, names: dict[str, str]) -> None:
        """Add a batch of a pad."""
        with self._lock:
            pad = self.pads[names["pad"]]
            if message.volts.shape[1] != len(pad.watch.names):
                raise ValueError(
                    f"expected {len(pad.watch.names)} electrodes of pad {names['pad']}, got {message.volts.shape[1]}"
                )
            before = pad.watch.look
            volts = message.volts.astype(np.float64)
            pad.faults.update(pad.watch.add(message.stamp_ns, message.period_ns, volts))
            if pad.watch.look is not None and pad.watch.look is not before:
                pad.looks.append(pad.watch.look)
            middle = message.stamp_ns - (len(volts) - 1) * message.period_ns // 2
            self._compare(names["pad"], pad, middle, volts)

    def pose(self, message: FusedPose, _: dict[str, str]) -> None:
        with self._lock:
            self._poses.append(message)

    def joints(self, message: Joints, names: dict[str, str]) -> None:
        with self._lock:
            self._joints[names["robot"]].append(message)

    def _compare(self, name: str, pad: Pad, stamp_ns: int, volts: Array) -> None:
        """Store a pad's reading with the field model's prediction at the fused pose of that time; the newest pose is slightly
        older than the voltages."""
        pose = _nearest(self._poses, stamp_ns)
        joints = {robot: _nearest(known, stamp_ns) for robot, known in self._joints.items()}
        if self._response is None or pose is None or pose.state != "tracking" or None in joints.values():
            return
        links = {robot: self._robots[robot].link_transforms(known.position) for robot, known in joints.items() if known}
        T_world_pads = self.skin.T_world_pads(link_names(links))
        T_world_target = transform(pose.position, pose.orientation)
        own = self.skin.of(self.skin.pads.index(name))
        angles = np.concatenate([np.empty(0), *(known.position for known in joints.values() if known)])
        parts = [T_world_target, *(self._posture.poses(T_world_target) if self._posture else [])]
        change = self._response.person(T_world_pads, parts) + self._response.rest(angles)
        predicted = self.skin.signal(self.skin.amplitude(change))[own]
        measured = self.skin.polarity[own] * (volts.mean(axis=0) - self.skin.a3[own])
        gap = np.sqrt(max(self.skin.peak[own].max() / max(predicted.max(), 1e-6) - 1.0, 1.0) / self.skin.a2[own].max())
        error = SLOPE * np.sqrt(np.linalg.eigvalsh(pose.covariance[:3, :3]).max()) / gap
        pad.moments.append((predicted, measured, self.skin.noise[own] / len(volts), float(error)))

    def judge(self, misfits: dict[str, float], touched: frozenset[str] = frozenset()) -> dict[str, Any]:
        """The findings as JSON; misfits: mean squared residuals of the haptic estimate by pad, in variances; touched: touched
        pads, whose electrodes may read the end of their scale."""
        with self._lock:
            gains = {name: found.gain for name, pad in self.pads.items() if (found := self._suspect(name, pad, 1.0)) is not None}
            # a limb of another size scales all pads' signals alike: only a pad that differs from the others is suspect
            common = float(np.median(list(gains.values()))) if len(gains) >= 3 else 1.0
            pads = {name: self._verdict(name, pad, common, misfits.get(name), name in touched) for name, pad in self.pads.items()}
        wrong = sum(bool(pad["wrong"]) + sum(e["fault"] is not None for e in pad["electrodes"].values()) for pad in pads.values())
        return {"cell": self.cell.name, "wrong": wrong, "compared": sorted(gains), "pads": pads, "notes": self.notes}

    def _suspect(self, name: str, pad: Pad, common: float) -> Any:
        count = len(pad.moments) // TOGETHER
        if not count or pad.faults:
            return None
        columns = (np.stack(column)[-count * TOGETHER :] for column in zip(*pad.moments, strict=True))
        predicted, measured, noise, error = (c.reshape(count, TOGETHER, *c.shape[1:]).mean(axis=1) for c in columns)
        near = (predicted.max(axis=1) > IN_REACH_V[0]) & (predicted.max(axis=1) < IN_REACH_V[1])
        if near.sum() < LEAST:
            return None
        own = self.skin.of(self.skin.pads.index(name))
        return likely(common * predicted[near], measured[near], noise[near] / TOGETHER, error[near], self.skin.centroids[own])

    def _verdict(self, name: str, pad: Pad, common: float, misfit: float | None, is_touched: bool) -> dict[str, Any]:
        own = self.skin.of(self.skin.pads.index(name))
        out: dict[str, Any] = {"wrong": None, "mend": None, "misfit": misfit, "touched": is_touched, "electrodes": {}}
        if not pad.looks:
            out |= {"wrong": "silent: no voltages received", "mend": "start its driver: penumbra skin, or penumbra emulator"}
            return out
        offsets = self._offsets(pad)
        found = self._suspect(name, pad, common)
        if found is not None and found.text is not None:
            mend = "mount it as in the cell file, or change its rpy there, or swap the channels of its electrodes"
            if "calibrated" in found.text or "reason" in found.text:
                mend = f"calibrate it: penumbra skin calibrate --pad {name}; and compare its place with the cell file"
            text = f"{found.text} (residual of {found.misfit:.1f} variances, {found.left:.1f} if so)"
            out |= {"wrong": text, "mend": mend}
        elif found is None and misfit is not None and misfit > MISFIT and not pad.faults:
            text = f"does not fit the haptic pose: residual of {misfit:.1f} variances"
            out |= {"wrong": text, "mend": "bring the limb within 5 to 10 cm of this pad and run this again"}
        last = pad.looks[-1]
        for k, electrode in enumerate(pad.watch.names):
            fault = pad.faults.get(electrode) or offsets.get(electrode)
            if is_touched and fault is not None and fault.kind == "saturated":
                fault = None
            out["electrodes"][electrode] = {
                "rest_V": float(self.skin.a3[own][k]),
                "level_V": float(last.level[k]),
                "lowest_V": float(min(look.signal[k] for look in pad.looks)),
                "signal_V": float(last.signal[k]),
                "noise_V": float(np.sqrt(np.median([look.noise[k] for look in pad.looks]))),
                "calibrated_noise_V": float(np.sqrt(self.skin.noise[own][k])),
                "hum_V": float(max(look.hum[k] for look in pad.looks)),
                "fault": fault.kind if fault else None,
                "text": fault.text if fault else None,
                "mend": MENDS[fault.kind] if fault else None,
            }
        return out

    def _offsets(self, pad: Pad) -> dict[str, Fault]:
        """Electrodes that read a signal while nothing is near by the pose."""
        empty = [moment for moment in pad.moments if moment[0].max() < NOTHING_V]
        if len(empty) < LEAST_EMPTY:
            return {}
        offset = np.mean([measured - predicted for predicted, measured, *_ in empty], axis=0)
        return {
            name: Fault("drift", f"drift: {1e3 * offset[k]:+.2g} mV with nothing near according to the pose")
            for k, name in enumerate(pad.watch.names)
            if abs(offset[k]) > OFFSET_V
        }


def examine(cell: cells.Cell, connection: bus.Connection, seconds: float, progress: Progress | None = None) -> dict[str, Any]:
    """Listen to a running cell and judge its pads, as JSON. Raises CellError for a cell without pads, BusError if nothing
    runs."""
    if not cell.pads:
        raise cells.CellError(f"cell {cell.name} has no pads: there is no skin to look at")
    examination = Examination(cell)
    node = Node("doctor", cell, connection)
    node.subscribe(topics.JOINTS, examination.joints)
    node.subscribe(topics.FUSED, examination.pose)
    node.subscribe(topics.VOLTAGES, examination.voltages)
    with node.open(PATIENCE_S):
        task = progress.add_task("listening", total=seconds) if progress else None
        step = 0.1
        for _ in range(round(seconds / step)):
            node.stopping.wait(step)
            if progress and task is not None:
                progress.advance(task, step)
        answers = node.query(topics.health(cell.name, "haptics"))
    if not any(pad.looks for pad in examination.pads.values()):
        raise bus.BusError(
            f"cell {cell.name}: expected voltages within {seconds:g} s, got none; start `penumbra up`, or `penumbra skin "
            "--device DEVICE` for a real board"
        )
    return examination.judge(_misfits(answers), _touched(answers))


def _misfits(answers: list[bytes]) -> dict[str, float]:
    """Mean squared residuals [variances] by pad, as the haptics service reports them in its health."""
    out: dict[str, float] = {}
    for answer in answers:
        for name, value in report.read(answer).report.items():
            if name.startswith("misfit/") and value is not None:
                out[name.removeprefix("misfit/")] = float(value)
    return out


def _touched(answers: list[bytes]) -> frozenset[str]:
    """Touched pads, as the haptics service reports them in its health."""
    contacts = [contact for answer in answers for contact in report.read(answer).report.get("contact", {}).values()]
    return frozenset(pad for contact in contacts for pad in contact["touched"])


def _nearest(known: deque[Any], stamp_ns: int) -> Any:
    """The message nearest to a stamp, or None if none is within NEAR_NS."""
    found = min(known, key=lambda message: abs(message.stamp_ns - stamp_ns), default=None)
    return found if found is not None and abs(found.stamp_ns - stamp_ns) <= NEAR_NS else None


def main(cell: cells.Cell, connection: bus.Connection, seconds: float, as_json: bool) -> int:
    """Print the findings of `examine`; returns 1 if anything is wrong."""
    with Progress(console=Console(stderr=True), transient=True) as progress:
        found = examine(cell, connection, seconds, progress)
    if as_json:
        print(json.dumps(found))
        return int(found["wrong"] > 0)
    console = Console(highlight=False, soft_wrap=True)
    headings = ("electrode", "rest mV", "signal mV", "lowest", "noise mV", "calibrated", "hum mV", "verdict")
    table = Table(*headings, box=None)
    for name, pad in found["pads"].items():
        for electrode, row in pad["electrodes"].items():
            numbers = (row[key] for key in ("rest_V", "signal_V", "lowest_V", "noise_V", "calibrated_noise_V", "hum_V"))
            verdict = f"[red]{row['fault']}[/]" if row["fault"] else "[green]ok[/]"
            table.add_row(f"{name}/{electrode}", *(f"{1e3 * number:.2f}" for number in numbers), verdict)
    console.print(table)
    for name, pad in found["pads"].items():
        wrongs = [(name, pad["wrong"], pad["mend"])] if pad["wrong"] else []
        wrongs += [(f"{name}/{e}", row["text"], row["mend"]) for e, row in pad["electrodes"].items() if row["fault"]]
        for where, text, mend in wrongs:
            console.print(f"[red]fail[/] {escape(f'{where}: {text} -> {mend}')}")
    if not found["wrong"]:
        console.print(f"[green]ok[/]   {len(found['pads'])} pads, nothing wrong")
    elsewhere = [name for name in found["pads"] if name not in found["compared"] and not found["pads"][name]["wrong"]]
    if elsewhere and not found["notes"]:
        console.print(
            f"[yellow]note[/] {', '.join(elsewhere)}: no limb with a known pose was within about 5 to 10 cm, or a fault is in "
            "the way: their mounting and calibration were not checked"
        )
    if touched := [name for name, pad in found["pads"].items() if pad["touched"]]:
        console.print(f"[yellow]note[/] {', '.join(touched)}: touched, so that electrodes may read the end of their scale")
    for note in found["notes"]:
        console.print(f"[yellow]note[/] {escape(note)}")
    return int(found["wrong"] > 0)
