"""Wiring: camera frames and fused poses in, masks out."""

from __future__ import annotations

import argparse
import threading
from collections.abc import Iterable
from pathlib import Path

import torch

from services.segmentation.inference import WEIGHTS, Segmenter, load_segmenter
from shared.cell.description import Camera
from shared.contract.messages import Frame, Mask
from shared.contract.topics import FRAME, FUSED, MASK
from shared.perception.lookout import Lookout, Window
from shared.runtime.node import ServiceNode

NAME = "segmentation"
FOLLOW_S = 0.2
"""How often a replica looks where it would have to look in the frames that are another one's."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of this service."""
    parser.add_argument("--camera", help="the camera whose frames are segmented (default: all of the cell)")
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="the network, made by `penumbra segmentation train`")


def start(node: ServiceNode, options: argparse.Namespace) -> None:
    """Segment the frames of the cell's cameras that this replica owns.

    Threads: the reader of a camera's frames and the timer `follow` share its lookout, under a lock, and its segmenter, of which
    the timer only prepares windows, and only while another replica owns the camera.
    """
    torch.set_num_threads(1)
    cell = node.cell
    cameras = [cell.one("cameras", options.camera)] if options.camera else list(cell.cameras)

    lookouts = {name: Lookout(cell, name) for name in cameras}
    looking = {name: threading.Lock() for name in cameras}  # a camera's frames and `follow` look by turns
    segmenters = {name: load_segmenter(options.weights) for name in cameras}

    fused = {target: node.latest(FUSED, target=target) for lookout in lookouts.values() for target in lookout.targets}

    def look(name: str, stamp_ns: int) -> Window:
        """The window of a camera's frame at a stamp, by the newest poses."""
        with looking[name]:
            for target in lookouts[name].targets:
                if (pose := fused[target].get(target=target)) is not None:
                    lookouts[name].hear(pose)
            return lookouts[name].look(stamp_ns)

    def is_ready(names: Iterable[str]) -> bool:
        """Whether frames of these cameras would wait for nothing; compiles ahead where they would, once it is known where to
        look."""
        if not any(each.drain() for each in fused.values()):
            return False
        windows = {name: look(name, node.now_ns()) for name in names}
        for name, window in windows.items():
            segmenters[name].prepare(window)
        return all(segmenters[name].is_prepared(window) for name, window in windows.items())

    def follow() -> None:
        """What another replica works on may be this one's next."""
        is_ready([name for name in lookouts if not node.owns(f"camera/{name}")])

    def watch(name: str, camera: Camera, segmenter: Segmenter) -> None:
        def on_frame(frame: Frame, _: dict[str, str]) -> None:
            if frame.image.shape[:2] != (camera.height, camera.width):
                came = f"{frame.image.shape[1]} x {frame.image.shape[0]}"
                raise ValueError(
                    f"camera {name}: frames of {camera.width} x {camera.height} expected (the cell file), {came} came"
                )
            window = look(name, frame.stamp_ns)
            segmenter.prepare(window)
            labels = segmenter(frame.image, window, frame.stamp_ns)
            mask = Mask(stamp_ns=frame.stamp_ns, labels=labels, x0=window.x0, y0=window.y0, scale=window.scale)
            node.publish(MASK, mask, camera=name)

        node.subscribe(FRAME, on_frame, streams=[f"camera/{name}"], camera=name)

    for name in cameras:
        watch(name, cell.cameras[name], segmenters[name])
    node.every(FOLLOW_S, follow)
    node.warm_when(lambda: is_ready(lookouts))
