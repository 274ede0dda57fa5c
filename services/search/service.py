"""Connects the search to the bus: masks, frames, joints and the fused pose in, the camera's pose out."""

from __future__ import annotations

import functools

from penumbra.services import flags
from penumbra.services.search import detect
from penumbra.services.search.refinder import Refinder
from penumbra.services.search.tracker import METHODS, Search
from penumbra.shared.contract.messages import Frame, Joints, Mask
from penumbra.shared.contract.topics import FRAME, FUSED, JOINTS, MASK, VISION
from penumbra.shared.geometry.lens import Undistortion
from penumbra.shared.perception import landmarks
from penumbra.shared.perception.joint_history import RobotJoints
from penumbra.shared.perception.lookout import Lookout
from penumbra.shared.perception.prediction import predict
from penumbra.shared.runtime.node import ServiceNode

NAME = "search"
FRAMES_KEPT = 4
"""Maximum number of frames per camera that are kept until their masks come."""
JOINTS_NEAR_NS = 200_000_000
"""Maximum time [ns] between a frame and the joint angles with which robots are drawn into it. Chosen: a mask without any
knowledge of the robot is worse than one with a robot that has moved a little."""
LOOK_S = 0.05
"""Period [s] of the thread that looks for lost arms: a picture waits up to this long."""
LOAD_S = 30.0
"""Maximum time [s] of a look, in which the landmark models may be loaded."""

FLAGS = (
    flags.Option("--method", choices=METHODS, default="default", help="default: contour least squares; paper: ascent on f_m"),
    flags.Option(
        "--landmarks",
        choices=("auto", "off"),
        default="auto",
        help="auto: find lost arms by landmarks, where models are installed",
    ),
    flags.Option("--camera", show_default="all of the cell", help="search only the masks of this camera"),
    flags.Option("--target", show_default="all of the cell", help="search only this target"),
)
EXAMPLE = "penumbra search --cell table --method paper"


def start(node: ServiceNode, options: flags.Options) -> None:
    """Subscribes. Each mask is searched for every target that its camera can see and this replica owns.

    Threads: the reader of a robot's joints writes these, and the reader of a camera's frames writes `frames[camera]`. The reader
    of the camera's masks uses what is there at that moment, and only it uses the searches of that camera. A timer's thread looks
    for lost arms by landmarks (`Refinder`).
    """
    cell = node.cell
    cameras = [cell.one("cameras", options.camera)] if options.camera else list(cell.cameras)
    targets = [cell.one("targets", options.target)] if options.target else list(cell.targets)
    seen = {camera: Lookout(cell, camera).targets for camera in cameras}
    searches = {(c, t): Search(cell, c, t, options.method) for c in cameras for t in targets if t in seen[c]}
    for camera in cameras:
        if not seen[camera]:
            node.log.warning("no target's home is in the image: no search in this camera", camera=camera)
    for k, search in enumerate(searches.values()):
        node.progress("preparing searches", k, len(searches))
        search.prepare()
    node.progress("preparing searches", len(searches), len(searches))
    joints = RobotJoints({name: len(robot.joints) for name, robot in cell.robots.items()}, JOINTS_NEAR_NS)
    fused = {target: node.latest(FUSED, target=target) for target in targets}
    frames: dict[str, tuple[Frame, ...]] = dict.fromkeys(cameras, ())
    undistort = {camera: Undistortion(cell.cameras[camera].lens) for camera in cameras}

    refinder = None
    if options.landmarks == "auto" and options.method == "default":
        refinder = Refinder(cell, landmarks.kept())
        node.add_report("landmarks", refinder.describe)
        if refinder.missing:
            node.log.info("lost arms are looked for in the masks alone", why=refinder.missing)
        else:
            node.every(LOOK_S, refinder.look, LOAD_S)

    def on_frame(message: Frame, names: dict[str, str]) -> None:
        known = frames[names["camera"]]
        frames[names["camera"]] = (*known, message)[-FRAMES_KEPT:]  # a new tuple: `on_mask` may be reading the old one

    def on_joints(message: Joints, names: dict[str, str]) -> None:
        joints.add(names["robot"], message.stamp_ns, message.position)

    def on_mask(message: Mask, names: dict[str, str]) -> None:
        frame = next((frame for frame in frames[names["camera"]] if frame.stamp_ns == message.stamp_ns), None)
        image, whole = None, None
        if frame is not None:
            (h, w), scale, whole = message.labels.shape, message.scale, functools.partial(undistort[names["camera"]], frame.image)
            image = whole((message.x0, message.y0, message.x0 + w * scale, message.y0 + h * scale))
        known, lost = joints.at(message.stamp_ns), list[str]()
        for (camera, target), search in searches.items():
            if camera != names["camera"] or not node.owns(f"{camera}/{target}"):
                continue
            T_prior, covariance = predict(fused[target].get(target=target), message.stamp_ns)
            starts = refinder.starts(camera, target, message.stamp_ns) if refinder else ()
            estimate = search.update(message, T_prior, covariance, known, image, starts)
            if estimate.state == "lost" and detect.is_shown(message, cell.targets[target].label_values):
                lost.append(target)
            pose = estimate.message(message.stamp_ns, target, camera, cell.frame)
            node.publish(VISION, pose, target=target)
        if refinder and whole:
            refinder.ask(names["camera"], lost, message.stamp_ns, whole)

    for robot in cell.robots:
        node.subscribe(JOINTS, on_joints, robot=robot)
    for camera in cameras:
        streams = [f"{camera}/{target}" for target in targets]
        node.subscribe(FRAME, on_frame, streams, camera=camera)
        node.subscribe(MASK, on_mask, streams, camera=camera)
