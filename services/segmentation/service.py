"""Wiring: camera frames, joints and fused poses in, masks out."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from pathlib import Path

from penumbra.services import flags
from penumbra.services.segmentation.inference import WEIGHTS, Segmenter, affordable, load_segmenter
from penumbra.services.segmentation.priors import Priors
from penumbra.shared.cell.description import Camera
from penumbra.shared.contract.labels import Label
from penumbra.shared.contract.messages import Frame, Joints, Mask
from penumbra.shared.contract.topics import FRAME, FUSED, JOINTS, MASK
from penumbra.shared.geometry.lens import Undistortion
from penumbra.shared.perception.joint_history import RobotJoints
from penumbra.shared.perception.lookout import Lookout
from penumbra.shared.runtime.node import ServiceNode

NAME = "segmentation"
FOLLOW_S = 0.2
"""Period [s] of the prediction of the next windows, also of those that are another replica's."""
AHEAD_S = 0.4
"""Time [s] ahead of that prediction: in it the network is compiled for a window's size."""
SHARE = 0.4
"""Of a core's time, the part that the frames of all cameras may take, where `--pixels` does not say otherwise: two cores are the
whole chain's, the emulator's with it."""
JOINTS_NEAR_NS = 100_000_000
"""Largest distance [ns] of a frame from the joint angles with which robots are drawn into it: a frame does not wait for those of
its stamp, and before they come the last velocity goes on. Chosen: the age after which joints are stale."""


FLAGS = (
    flags.Option("--camera", show_default="all of the cell", help="the camera whose frames are segmented"),
    flags.Option(
        "--weights",
        type=Path,
        default=WEIGHTS,
        show_default="the built-in ones",
        help="the network, made by `penumbra segmentation train`",
    ),
    flags.Option(
        "--pixels",
        type=flags.positive,
        show_default="as many as this machine has time for",
        help="largest window around the targets [px]; what is larger is shown at a coarser scale",
    ),
)
EXAMPLE = "penumbra segmentation --cell table --camera front"


def start(node: ServiceNode, options: flags.Options) -> None:
    """Segment the frames of the cell's cameras that this replica owns.

    A network with priors is also given where robots and targets should be; one without reads no joints.

    Threads: the reader of a camera's frames and the timer `follow` share its lookout, under a lock, and its segmenter, of which
    the timer only prepares windows, and only while another replica owns the camera. The joints of a robot are written by their
    reader.
    """
    cell = node.cell
    cameras = [cell.one("cameras", options.camera)] if options.camera else list(cell.cameras)

    segmenters = {name: load_segmenter(options.weights) for name in cameras}
    rate_hz = sum(cell.cameras[name].rate_hz for name in cameras)
    first = Lookout(cell, cameras[0]).window
    most = options.pixels or affordable(load_segmenter(options.weights), first, SHARE / rate_hz)
    node.add_report("largest_window_px", lambda: most)
    lookouts = {name: Lookout(cell, name, most) for name in cameras}
    looking = {name: threading.Lock() for name in cameras}  # a camera's frames and `follow` look by turns
    for name, segmenter in segmenters.items():
        segmenter.prepare(lookouts[name].window, lookouts[name].at_home)  # while the process joins the others

    joints = RobotJoints({name: len(robot.joints) for name, robot in cell.robots.items()}, JOINTS_NEAR_NS, is_carried_on=True)
    priors = {name: Priors(cell, name, lookouts[name].targets) for name in cameras if segmenters[name].has_priors}
    for name, prior in priors.items():
        prior.prepare(lookouts[name].window)

    fused = {target: node.latest(FUSED, target=target) for lookout in lookouts.values() for target in lookout.targets}

    def informed(name: str) -> Lookout:
        """A camera's lookout that knows the newest poses; to be called with its lock held."""
        for target in lookouts[name].targets:
            if (pose := fused[target].get(target=target)) is not None:
                lookouts[name].add(pose)
        return lookouts[name]

    def is_ready(names: Iterable[str]) -> bool:
        """Whether frames of these cameras would wait for nothing; compiles ahead where they would, once it is known where to
        look."""
        if not any(each.drain() for each in fused.values()):
            return False
        now_ns, ready = node.now_ns(), True
        for name in names:
            with looking[name]:
                lookout = informed(name)
                window, later = lookout.foresee(now_ns), lookout.foresee(now_ns + round(AHEAD_S * 1e9))
            segmenters[name].prepare(window, later)
            ready &= segmenters[name].is_prepared(window)
        return ready

    def follow() -> None:
        """What another replica works on may be this one's next, and the other replica does not say how it looks at it."""
        for name in lookouts:
            if not node.owns(f"camera/{name}"):
                with looking[name]:
                    informed(name).look(node.now_ns())
        is_ready(lookouts)

    def watch(name: str, camera: Camera, segmenter: Segmenter) -> None:
        undistort = Undistortion(camera.lens)

        def on_frame(frame: Frame, _: dict[str, str]) -> None:
            if frame.image.shape[:2] != (camera.height, camera.width):
                got = f"{frame.image.shape[1]} x {frame.image.shape[0]}"
                raise ValueError(f"camera {name}: expected frames of {camera.width} x {camera.height} (the cell file), got {got}")
            with looking[name]:
                window = informed(name).look(frame.stamp_ns)
                poses = lookouts[name].predicted(frame.stamp_ns)
            known = priors[name](window, poses, joints.at(frame.stamp_ns)) if name in priors else None
            image = undistort(frame.image, (window.x0, window.y0, window.right, window.bottom))
            labels = segmenter(image, window, frame.stamp_ns, known)
            if undistort.unseen is not None:  # nothing is known there, as behind an occluder
                unseen = undistort.unseen[window.y0 : window.bottom : window.scale, window.x0 : window.right : window.scale]
                labels[unseen] = Label.OCCLUDER
            mask = Mask(stamp_ns=frame.stamp_ns, labels=labels, x0=window.x0, y0=window.y0, scale=window.scale)
            node.publish(MASK, mask, camera=name)

        node.subscribe(FRAME, on_frame, streams=[f"camera/{name}"], camera=name)

    def on_joints(message: Joints, names: dict[str, str]) -> None:
        joints.add(names["robot"], message.stamp_ns, message.position)

    if priors:
        for robot in cell.robots:
            node.subscribe(JOINTS, on_joints, [f"camera/{name}" for name in cameras], robot=robot)
    for name in cameras:
        watch(name, cell.cameras[name], segmenters[name])
    node.every(FOLLOW_S, follow)
    node.warm_when(lambda: is_ready(lookouts))
