"""Wiring: camera frames and fused poses in, masks out."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from services.segmentation.infer import WEIGHTS, Segmenter, load_segmenter
from shared.cell import Camera
from shared.messages import Frame, FusedPose, Mask
from shared.service import Node
from shared.topics import FRAME, FUSED, MASK
from shared.window import Lookout

NAME = "segmentation"


def arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of this service."""
    parser.add_argument("--camera", help="the camera whose frames are segmented (default: all of the cell)")
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="the network, made by `penumbra segmentation train`")


def start(node: Node, options: argparse.Namespace) -> None:
    """Segment the frames of the cell's cameras that this replica owns."""
    torch.set_num_threads(1)
    cell = node.cell
    cameras = [cell.one("cameras", options.camera)] if options.camera else list(cell.cameras)

    lookouts = {name: Lookout(cell, name) for name in cameras}

    def on_pose(message: FusedPose, _: dict[str, str]) -> None:
        for lookout in lookouts.values():
            lookout.hear(message)

    def watch(name: str, camera: Camera, lookout: Lookout, segmenter: Segmenter) -> None:
        segmenter.prepare(lookout.window)

        def on_frame(frame: Frame, _: dict[str, str]) -> None:
            if frame.image.shape[:2] != (camera.height, camera.width):
                came = f"{frame.image.shape[1]} x {frame.image.shape[0]}"
                raise ValueError(
                    f"camera {name}: frames of {camera.width} x {camera.height} expected (the cell file), {came} came"
                )
            window = lookout.look(frame.stamp_ns)
            segmenter.prepare(window)
            labels = segmenter(frame.image, window, frame.stamp_ns)
            mask = Mask(stamp_ns=frame.stamp_ns, labels=labels, x0=window.x0, y0=window.y0, scale=window.scale)
            node.publish(MASK, mask, camera=name)

        node.subscribe(FRAME, on_frame, streams=[f"camera/{name}"], camera=name)

    for target in dict.fromkeys(target for lookout in lookouts.values() for target in lookout.targets):
        node.subscribe(FUSED, on_pose, target=target)
    for name, lookout in lookouts.items():
        watch(name, cell.cameras[name], lookout, load_segmenter(options.weights))
