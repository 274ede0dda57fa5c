"""Segmentation service: publishes masks from camera frames, joints and fused poses."""

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
"""Period [s] of the prediction of the next windows, including those of other replicas' cameras."""
AHEAD_S = 0.4
"""Time [s] by which this prediction looks ahead: meanwhile the network is compiled for the window's size."""
SHARE = 0.4
"""Share of a core's time for the frames of all cameras, unless `--pixels` is given: the whole chain has two cores, including the
emulator."""
JOINTS_NEAR_NS = 100_000_000
"""Maximum distance [ns] between a frame and the joint angles with which robots are drawn into it: a frame does not wait for the
angles of its stamp, and until they arrive the last velocity is extrapolated. Chosen: the age after which joints are stale."""


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

    A network with priors also receives the expected silhouettes of robots and targets; one without reads no joints.

    Threads: the reader of a camera's frames and the timer `follow` share its lookout, under a lock, and its segmenter. The timer
    only prepares windows, and only while another replica owns the camera. The joints of a robot are written by their reader.
    """
    cell = node.cell
    cameras = [cell.one("cameras", options.camera)] if options.camera else list(cell.cameras)

    segmenters = {name: load_segmenter(options.weights) for name in cameras}
    rate_hz = sum(cell.cameras[name].rate_hz for name in cameras)
    first = Lookout(cell, cameras[0]).window
    most = options.pixels or affordable(load_segmenter(options.weights), first, SHARE / rate_hz)
    node.add_report("largest_window_px", lambda: most)
    lookouts = {name: Lookout(cell, name, most) for name in cameras}
    looking = {name: threading.Lock() for name in cameras}  # a camera's frames and `follow` take turns
    for name, segmenter in segmenters.items():
        segmenter.prepare(lookouts[name].window, lookouts[name].at_home)  # while the process joins the others

    joints = RobotJoints({name: len(robot.joints) for name, robot in cell.robots.items()}, JOINTS_NEAR_NS, is_carried_on=True)
    priors = {name: Priors(cell, name, lookouts[name].targets) for name in cameras if segmenters[name].has_priors}
    for name, prior in priors.items():
        prior.prepare(lookouts[name].window)

    fused = {target: node.latest(FUSED, target=target) for lookout in lookouts.values() for target in lookout.targets}

    def informed(name: str) -> Lookout:
        """A camera's lookout, updated with the newest poses; to be called with its lock held."""
        for target in lookouts[name].targets:
            if (pose := fused[target].get(target=target)) is not None:
                lookouts[name].add(pose)
        return lookouts[name]

    def is_ready(names: Iterable[str]) -> bool:
        """Whether frames of these cameras would wait for no compilation; compiles ahead if they would, once a fused pose has
        arrived."""
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
        """Follow the cameras of other replicas, which may become this one's: the other replica does not publish its windows."""
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
            if undistort.unseen is not None:  # these pixels are unknown, as behind an occluder
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
