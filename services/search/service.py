"""Wires the search to the bus: masks, frames, joints and the fused pose in, the camera's pose out."""

from __future__ import annotations

import argparse
import threading
from collections import deque

import numpy as np
from numpy.typing import NDArray

from services.search.tracker import METHODS, Search
from shared.contract.messages import Frame, FusedPose, Joints, Mask
from shared.contract.topics import FRAME, FUSED, JOINTS, MASK, VISION
from shared.perception.joint_history import JointHistory
from shared.perception.lookout import Lookout
from shared.perception.prediction import predict
from shared.runtime.node import Node

NAME = "search"
FRAMES_KEPT = 4
"""Number of frames of a camera that are kept until their masks come."""
JOINTS_NEAR_NS = 200_000_000
"""Largest distance [ns] of a frame from the joint angles with which robots are drawn into it. Chosen: a mask of which nothing is
known of the robot is worse than one with a robot that has moved a little."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """The service's own flags."""
    parser.add_argument(
        "--method", choices=METHODS, default="default", help="default: contour least squares; paper: ascent on f_m"
    )
    parser.add_argument("--camera", help="search only the masks of this camera (default: of all)")
    parser.add_argument("--target", help="search only this target (default: all)")


class RecentFrames:
    """The last frames of a camera. The bus calls the handlers of frames and of masks on different threads."""

    def __init__(self) -> None:
        self._frames: deque[Frame] = deque(maxlen=FRAMES_KEPT)
        self._lock = threading.Lock()

    def add(self, frame: Frame) -> None:
        """Keeps a frame, the oldest one goes."""
        with self._lock:
            self._frames.append(frame)

    def image_at(self, stamp_ns: int) -> NDArray[np.uint8] | None:
        """The image (h, w, 3) of the frame with this stamp, None where it is not kept."""
        with self._lock:
            return next((frame.image for frame in self._frames if frame.stamp_ns == stamp_ns), None)


def start(node: Node, options: argparse.Namespace) -> None:
    """Subscribes; every mask is searched for every target that its camera can see and this replica owns."""
    cell = node.cell
    cameras = [cell.one("cameras", options.camera)] if options.camera else list(cell.cameras)
    targets = [cell.one("targets", options.target)] if options.target else list(cell.targets)
    seen = {camera: Lookout(cell, camera).targets for camera in cameras}
    searches = {(c, t): Search(cell, c, t, options.method) for c in cameras for t in targets if t in seen[c]}
    for camera in cameras:
        if not seen[camera]:
            node.log.warning("no target's home is in the picture: nothing is searched there", camera=camera)
    for search in searches.values():
        search.prepare()
    history = {robot: JointHistory(JOINTS_NEAR_NS) for robot in cell.robots}
    fused: dict[str, FusedPose] = {}
    frames = {camera: RecentFrames() for camera in cameras}

    def on_frame(message: Frame, names: dict[str, str]) -> None:
        frames[names["camera"]].add(message)

    def on_joints(message: Joints, names: dict[str, str]) -> None:
        robot, expected = names["robot"], len(cell.robots[names["robot"]].joints)
        if len(message.position) != expected:
            raise ValueError(f"joints of {robot}: expected {expected} values, got {len(message.position)}")
        history[robot].add(message.stamp_ns, message.position)

    def on_fused(message: FusedPose, names: dict[str, str]) -> None:
        fused[names["target"]] = message

    def on_mask(message: Mask, names: dict[str, str]) -> None:
        image = frames[names["camera"]].image_at(message.stamp_ns)
        joints = {robot: q for robot, h in history.items() if (q := h.at(message.stamp_ns)) is not None}
        for (camera, target), search in searches.items():
            if camera != names["camera"] or not node.owns(f"{camera}/{target}"):
                continue
            T_prior, covariance = predict(fused.get(target), message.stamp_ns)
            estimate = search.update(message, T_prior, covariance, joints, image)
            pose = estimate.message(message.stamp_ns, target, camera, cell.frame)
            node.publish(VISION, pose, target=target)

    for robot in cell.robots:
        node.subscribe(JOINTS, on_joints, robot=robot)
    for target in targets:
        node.subscribe(FUSED, on_fused, target=target)
    for camera in cameras:
        streams = [f"{camera}/{target}" for target in targets]
        node.subscribe(FRAME, on_frame, streams, camera=camera)
        node.subscribe(MASK, on_mask, streams, camera=camera)
