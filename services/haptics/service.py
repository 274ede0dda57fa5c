"""Haptics service: estimates haptic poses from voltages, joint angles and the fused pose, one per window (50 per second)."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from penumbra.services import flags
from penumbra.services.haptics import paper_network
from penumbra.services.haptics.batches import SATURATED, Backlog, Collector, VoltageWindow
from penumbra.services.haptics.estimator import FOREIGN, Estimator, HapticEstimate
from penumbra.services.haptics.pad_poses import PadPoses
from penumbra.services.haptics.surface_points import Shapes
from penumbra.shared.body.anatomy import target_mesh
from penumbra.shared.body.posture import Posture
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell.description import Cell
from penumbra.shared.contract.messages import FusedPose, HapticPose, Joints, SurfacePoint, Voltages
from penumbra.shared.contract.topics import FUSED, HAPTIC, JOINTS, VOLTAGES
from penumbra.shared.geometry.rigid import position_orientation
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.perception.prediction import LONGEST_S, predict
from penumbra.shared.runtime.node import ServiceNode
from penumbra.shared.skin.layout import Near, Skin
from penumbra.shared.skin.response import Response, fingerprint

NAME = "haptics"
WEIGHTS = Path(__file__).parent / "weights"
SHARE = 0.01
"""Weight of the newest window in a pad's mean misfit: an average over about two seconds."""
WORST = 10.0
"""Maximum residual, in standard deviations, that an electrode contributes to its pad's mean misfit."""
LASTING_NS = 1_000_000_000
"""Time [ns] that a fault, or its end, must last before it is logged."""


FLAGS = (
    flags.Option(
        "--method",
        choices=("solve", "paper"),
        default="solve",
        help="solve: least squares, started by the network; paper: the network alone",
    ),
    flags.Option("--weights", type=Path, default=WEIGHTS, show_default="the built-in ones", help="folder of CELL-TARGET.npz"),
    flags.Option("--window-ms", type=flags.above_zero, default=20.0, help="voltages averaged for one pose"),
)
EXAMPLE = "penumbra haptics --cell table --method paper"


def start(node: ServiceNode, options: flags.Options) -> None:
    """Subscribe; solve every window of voltages for every target that this replica owns.

    Threads: the thread that reads voltages owns the collector, the estimators and their reports; `poses` has its own lock,
    because the thread that reads joints adds to it.
    """
    cell = node.cell
    skin = Skin(cell)
    poses = PadPoses(cell, skin, robot_models(cell))
    collector = Collector(skin, length_ns=int(options.window_ms * 1e6))
    near = {name: found for name in cell.targets if len((found := Near.of(cell, name)).pads)}
    for name in cell.targets.keys() - near.keys():
        node.log.info("never estimated: no pad is within its reach", target=name)
    estimators = {}
    for k, (name, found) in enumerate(near.items()):
        node.progress("preparing estimators", k, len(near))
        estimators[name] = estimator(node, options, found.cell, name)
    node.progress("preparing estimators", len(near), len(near))
    backlog = Backlog()
    told = Faults(node)
    misfits, contacts = Misfits(node), Contacts(node)
    fused = {target: node.latest(FUSED, target=target) for target in estimators}

    def on_joints(message: Joints, names: dict[str, str]) -> None:
        poses.add(names["robot"], message.stamp_ns, message.position)

    def on_voltages(message: Voltages, names: dict[str, str]) -> None:
        window = collector.add(names["pad"], message.stamp_ns, message.period_ns, message.volts.astype(np.float64))
        if window is not None and not backlog.is_late(window.newest_ns, node.now_ns()):
            on_window(window)

    def on_window(window: VoltageWindow) -> None:
        found = poses.at(window.stamp_ns)
        faults = dict(window.faults)
        if found is None:
            faults["joints"] = "no joint angles near the time of the voltages: is the robot's source running?"
        for target, which in estimators.items():
            if not node.owns(f"haptic/{target}"):
                continue
            if found is None:
                estimate = which.nothing(faults["joints"])
            else:
                T, covariance = predict(seen(fused[target].get(target=target), window.stamp_ns), window.stamp_ns)
                expected = None if T is None or covariance is None else (T, covariance)
                (T_world_pads, joints), own = found, near[target]
                amplitude, samples = window.amplitude[own.electrodes], window.samples[own.electrodes]
                pressed = window.pressed[own.electrodes]
                estimate = which.update(window.stamp_ns, amplitude, samples, T_world_pads[own.pads], joints, expected, pressed)
                misfits.update(estimate, which.skin, samples)
                contacts.update(target, estimate)
                faults = {name: why for name, why in faults.items() if not is_by_touch(name, why, estimate)}
            if estimate.why == FOREIGN:
                faults[target] = FOREIGN
            node.publish(HAPTIC, _message(estimate, window, target, cell), target=target)
        told.update(faults, window.stamp_ns)

    streams = [f"haptic/{target}" for target in estimators]
    node.subscribe(JOINTS, on_joints, streams)
    node.subscribe(VOLTAGES, on_voltages, streams)


def estimator(node: ServiceNode, options: flags.Options, cell: Cell, target: str) -> Estimator:
    """An estimator ready to run on a cell's pads: weights loaded if they fit it, code compiled."""
    path = options.weights / f"{cell.name}-{target}.npz"
    weights = None
    try:
        weights = paper_network.load(path, cell, target)
    except (FileNotFoundError, ValueError) as error:
        node.log.warning("no network: the solve starts from the target's home instead", target=target, why=str(error))
    shapes = None
    try:
        shapes = shapes_of(cell, target, options.weights)
    except (FileNotFoundError, ValueError) as error:
        node.log.warning("no points of surfaces, and nothing touches", target=target, why=str(error))
    response, posture = Response(cell, target), Posture.usual(cell, cell.targets[target])
    if posture is not None and response.bearers is None:
        why = "the field model has none: run `penumbra skin model` for this cell, which adds them"
        node.log.warning("upper arm and torso are taken for a nearer limb", target=target, why=why)
    mesh = target_mesh(cell.targets[target], cell)
    spread = cell.targets[target].home_spread
    made = Estimator(
        Skin(cell),
        response,
        Surface(mesh.vertices, mesh.faces),
        cell.targets[target].home.transform,
        np.repeat([spread.position, spread.rotation], 3),
        weights,
        options.method,
        cell.targets[target].size is not None,
        shapes=shapes,
        posture=posture,
    )
    made.warm_up(sum(len(robot.joints) for robot in cell.robots.values()))
    return made


def shapes_of(cell: Cell, target: str, weights: Path) -> Shapes:
    """Statistics of unknown shapes for the pads of a cell. Raises FileNotFoundError if they were not measured for the pads'
    design, and ValueError if the pads have several designs."""
    designs = {fingerprint(cell, pad, target, bare=True) for pad in cell.pads}
    if len(designs) > 1:
        raise ValueError(f"expected pads of one design, got {len(designs)}; points of surfaces need equal pads")
    return Shapes.load(weights, designs.pop())


def is_by_touch(name: str, why: str, estimate: HapticEstimate) -> bool:
    """Whether a fault of PAD/ELECTRODE is caused by something that touches the pad."""
    return why.startswith(SATURATED.partition(":")[0]) and name.partition("/")[0] in estimate.touched


class Contacts:
    """Reports the contact state and touched pads by target as `contact` in the health report; logs changes of the state."""

    def __init__(self, node: ServiceNode):
        self._node = node
        self._now: dict[str, HapticEstimate] = {}
        node.add_report("contact", self._told)

    def update(self, target: str, estimate: HapticEstimate) -> None:
        """Add the estimate of a window."""
        before = self._now.get(target)
        self._now[target] = estimate
        if (before.contact if before else "none") != estimate.contact:
            self._node.log.info("contact", state=estimate.contact, pads=" ".join(estimate.touched), target=target)

    def _told(self) -> dict[str, dict[str, Any]]:
        return {target: {"state": now.contact, "touched": list(now.touched)} for target, now in self._now.copy().items()}


class Misfits:
    """Reports per pad, as misfit/PAD in the health report, the mean squared residual of the limb's fit in variances, over windows
    in which the object in range may be a limb. A pad that is turned, or has another pad's calibration, stands out."""

    def __init__(self, node: ServiceNode):
        self._node = node
        self._means: dict[str, float] = {}

    def update(self, estimate: HapticEstimate, skin: Skin, samples: NDArray[np.int64]) -> None:
        """Add the residuals (n,) of a window on a skin, with their numbers of samples (n,)."""
        if not estimate.may_be_limb:
            return
        used = (samples > 0).astype(np.float64)
        squares = np.minimum(estimate.residuals**2, WORST**2) * used
        sums = (np.add.reduceat(each, skin.first[:-1]).tolist() for each in (squares, used))
        for pad, total, count in zip(skin.pads, *sums, strict=True):
            if count:
                now = total / count
                before = self._means.get(pad, now)
                self._means[pad] = before + SHARE * (now - before)
                self._node.add_report(f"misfit/{pad}", partial(self._told, pad))

    def _told(self, pad: str) -> float:
        return round(self._means[pad], 2)


class Faults:
    """Logs faults that begin or end, once they have lasted, so that short hiccups do not fill the log."""

    def __init__(self, node: ServiceNode):
        self._node = node
        self._told: dict[str, str] = {}
        self._since_ns: dict[str, int] = {}

    def update(self, faults: dict[str, str], stamp_ns: int) -> None:
        """Update with the faults of the window at stamp_ns: reasons by name."""
        for name in set(self._told) | set(faults) | set(self._since_ns):
            if faults.get(name) == self._told.get(name):
                self._since_ns.pop(name, None)
            elif stamp_ns - self._since_ns.setdefault(name, stamp_ns) >= LASTING_NS:
                del self._since_ns[name]
                if name in faults:
                    self._told[name] = faults[name]
                    self._node.log.warning("left out", what=name, why=faults[name])
                else:
                    del self._told[name]
                    self._node.log.info("back in use", what=name)


def seen(fused: FusedPose | None, stamp_ns: int) -> FusedPose | None:
    """The fused pose, if a camera contributed to it shortly before a stamp. Feeding back a pose from the skin alone would make
    the skin confirm itself."""
    if fused is None or (camera := fused.sources.get("vision")) is None:
        return None
    return fused if camera.age_s + (stamp_ns - fused.stamp_ns) * 1e-9 < LONGEST_S else None


def _message(estimate: HapticEstimate, window: VoltageWindow, target: str, cell: Cell) -> HapticPose:
    position, orientation = position_orientation(estimate.T)
    return HapticPose(
        stamp_ns=window.stamp_ns,
        target=target,
        frame=cell.frame,
        sample_stamp_ns=window.newest_ns,
        position=position,
        orientation=orientation,
        information=estimate.information,
        gap=estimate.gap,
        state=estimate.state,
        surface={
            point.pad: SurfacePoint(
                cell.pads[point.pad].link, tuple(point.position.tolist()), point.distance, point.along, point.across, point.gap
            )
            for point in estimate.surface
        },
        contact=estimate.contact,
        touched=estimate.touched,
        step=estimate.step,
    )
