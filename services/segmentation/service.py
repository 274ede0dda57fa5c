"""Wiring: camera frames and fused poses in, masks out."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import torch

from services.segmentation.inference import WEIGHTS, Segmenter, load_segmenter
from shared.cell.description import Camera
from shared.contract.messages import Frame, FusedPose, Mask
from shared.contract.topics import FRAME, FUSED, MASK
from shared.perception.lookout import Lookout
from shared.runtime.node import Node

NAME = "segmentation"
FOLLOW_S = 0.2
"""How often a replica looks where it would have to look in the frames that are another one's."""


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
    segmenters = {name: load_segmenter(options.weights) for name in cameras}

    heard: set[str] = set()

    def on_pose(message: FusedPose, names: dict[str, str]) -> None:
        heard.add(names["target"])
        for lookout in lookouts.values():
            lookout.hear(message)

    def is_ready(names: Iterable[str]) -> bool:
        """Whether frames of these cameras would wait for nothing; compiles ahead where they would, once it is known where to
        look."""
        if not heard:
            return False
        windows = {name: lookouts[name].look(node.now_ns()) for name in names}
        for name, window in windows.items():
            segmenters[name].prepare(window)
        return all(segmenters[name].is_prepared(window) for name, window in windows.items())

    def follow() -> None:
        """What another replica works on may be this one's next."""
        is_ready([name for name in lookouts if not node.owns(f"camera/{name}")])

    def watch(name: str, camera: Camera, lookout: Lookout, segmenter: Segmenter) -> None:
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
        watch(name, cell.cameras[name], lookout, segmenters[name])
    node.every(FOLLOW_S, follow)
    node.is_warm = lambda: is_ready(lookouts)
