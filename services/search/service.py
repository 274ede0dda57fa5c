"""Wires the search to the bus: masks, frames, joints and the fused pose in, the camera's pose out."""

from __future__ import annotations

from penumbra.services import flags
from penumbra.services.search.tracker import METHODS, Search
from penumbra.shared.contract.messages import Frame, Joints, Mask
from penumbra.shared.contract.topics import FRAME, FUSED, JOINTS, MASK, VISION
from penumbra.shared.geometry.lens import Undistortion
from penumbra.shared.perception.joint_history import RobotJoints
from penumbra.shared.perception.lookout import Lookout
from penumbra.shared.perception.prediction import predict
from penumbra.shared.runtime.node import ServiceNode

NAME = "search"
FRAMES_KEPT = 4
"""Number of frames of a camera that are kept until their masks come."""
JOINTS_NEAR_NS = 200_000_000
"""Largest distance [ns] of a frame from the joint angles with which robots are drawn into it. Chosen: a mask of which nothing is
known of the robot is worse than one with a robot that has moved a little."""


FLAGS = (
    flags.Option("--method", choices=METHODS, default="default", help="default: contour least squares; paper: ascent on f_m"),
    flags.Option("--camera", show_default="all of the cell", help="search only the masks of this camera"),
    flags.Option("--target", show_default="all of the cell", help="search only this target"),
)
EXAMPLE = "penumbra search --cell table --method paper"


def start(node: ServiceNode, options: flags.Options) -> None:
    """Subscribes; every mask is searched for every target that its camera can see and this replica owns.

    Threads: the joints of a robot are written by their reader, `frames[camera]` to the reader of that camera's
    frames. The reader of its masks takes what is there at that moment; the searches of a camera are that reader's alone.
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

    def on_frame(message: Frame, names: dict[str, str]) -> None:
        known = frames[names["camera"]]
        frames[names["camera"]] = (*known, message)[-FRAMES_KEPT:]  # a new one each time: `on_mask` may be in the old one

    def on_joints(message: Joints, names: dict[str, str]) -> None:
        joints.add(names["robot"], message.stamp_ns, message.position)

    def on_mask(message: Mask, names: dict[str, str]) -> None:
        image = next((frame.image for frame in frames[names["camera"]] if frame.stamp_ns == message.stamp_ns), None)
        if image is not None:
            (h, w), scale = message.labels.shape, message.scale
            image = undistort[names["camera"]](image, (message.x0, message.y0, message.x0 + w * scale, message.y0 + h * scale))
        known = joints.at(message.stamp_ns)
        for (camera, target), search in searches.items():
            if camera != names["camera"] or not node.owns(f"{camera}/{target}"):
                continue
            T_prior, covariance = predict(fused[target].get(target=target), message.stamp_ns)
            estimate = search.update(message, T_prior, covariance, known, image)
            pose = estimate.message(message.stamp_ns, target, camera, cell.frame)
            node.publish(VISION, pose, target=target)

    for robot in cell.robots:
        node.subscribe(JOINTS, on_joints, robot=robot)
    for camera in cameras:
        streams = [f"{camera}/{target}" for target in targets]
        node.subscribe(FRAME, on_frame, streams, camera=camera)
        node.subscribe(MASK, on_mask, streams, camera=camera)
