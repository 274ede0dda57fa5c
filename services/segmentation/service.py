"""Wiring: camera frames and fused poses in, masks out."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from services.segmentation.crop import corners_of, extrapolate, whole_frame, window_around
from services.segmentation.infer import WEIGHTS, Segmenter, load_segmenter
from shared import body, geometry
from shared.cell import Camera
from shared.messages import Frame, FusedPose, Mask
from shared.service import Node
from shared.topics import FRAME, FUSED, MASK

NAME = "segmentation"
MAX_POSE_AGE_S = 0.5
"""A fused pose older than the frame by more than this says nothing about it."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of this service."""
    parser.add_argument("--camera", help="the camera whose frames are segmented (default: all of the cell)")
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="the network, made by `penumbra segmentation train`")


def start(node: Node, options: argparse.Namespace) -> None:
    """Segment the frames of the cell's cameras that this replica owns."""
    torch.set_num_threads(1)
    cell = node.cell
    cameras = [cell.one("cameras", options.camera)] if options.camera else list(cell.cameras)
    corners = {name: corners_of(body.target_mesh(target, cell).vertices) for name, target in cell.targets.items()}
    poses: dict[str, FusedPose] = {}

    def on_pose(message: FusedPose, names: dict[str, str]) -> None:
        poses[names["target"]] = message

    def watch(name: str, camera: Camera, segmenter: Segmenter) -> None:
        window = whole_frame(camera)
        segmenter.prepare(window)

        def on_frame(frame: Frame, _: dict[str, str]) -> None:
            nonlocal window
            if not node.owns(f"camera/{name}"):
                return
            if frame.image.shape[:2] != (camera.height, camera.width):
                came = f"{frame.image.shape[1]} x {frame.image.shape[0]}"
                raise ValueError(
                    f"camera {name}: frames of {camera.width} x {camera.height} expected (the cell file), {came} came"
                )
            known = [(predicted(poses.get(target), frame.stamp_ns), box) for target, box in corners.items()]
            around = None
            if all(T is not None for T, _ in known):
                around = window_around(camera, [(T, box) for T, box in known if T is not None], window)
            window = around or whole_frame(camera)
            segmenter.prepare(window)
            labels = segmenter(frame.image, window, frame.stamp_ns)
            mask = Mask(stamp_ns=frame.stamp_ns, labels=labels, x0=window.x0, y0=window.y0, scale=window.scale)
            node.publish(MASK, mask, camera=name)

        node.subscribe(FRAME, on_frame, camera=name)

    node.subscribe(FUSED, on_pose)
    for name in cameras:
        watch(name, cell.cameras[name], load_segmenter(options.weights))


def predicted(pose: FusedPose | None, stamp_ns: int) -> geometry.Array | None:
    """T_world_target at a stamp; None where the pose is lost or too old to say."""
    if pose is None or pose.state == "lost":
        return None
    dt_s = (stamp_ns - pose.stamp_ns) * 1e-9
    if abs(dt_s) > MAX_POSE_AGE_S:
        return None
    return extrapolate(geometry.transform(pose.position, pose.orientation), pose.velocity, dt_s)
