"""Wiring: camera frames and fused poses in, the camera's poses out."""

from __future__ import annotations

from pathlib import Path

import torch

from penumbra.services import flags
from penumbra.services.posecnn.estimator import WEIGHTS, PoseCNN, load
from penumbra.shared.contract.messages import Frame
from penumbra.shared.contract.topics import FRAME, FUSED, VISION
from penumbra.shared.geometry.lens import Undistortion
from penumbra.shared.perception.lookout import Lookout
from penumbra.shared.perception.prediction import predict
from penumbra.shared.runtime.node import ServiceNode

NAME = "posecnn"


FLAGS = (
    flags.Option("--camera", show_default="all of the cell", help="the camera whose frames are used"),
    flags.Option("--target", show_default="all of the cell", help="estimate only this target"),
    flags.Option(
        "--weights",
        type=Path,
        default=WEIGHTS,
        show_default="the built-in ones",
        help="the network, made by `penumbra posecnn train`",
    ),
)
EXAMPLE = "penumbra posecnn --cell table --camera front"


def start(node: ServiceNode, options: flags.Options) -> None:
    """Subscribes; every frame is searched for every target that its camera can see and this replica owns.

    Threads: the lookout and the estimators of a camera belong to the reader of its frames.
    """
    torch.set_num_threads(1)
    cell = node.cell
    cameras = [cell.one("cameras", options.camera)] if options.camera else list(cell.cameras)
    targets = [cell.one("targets", options.target)] if options.target else list(cell.targets)
    net, uncertainty = load(options.weights)
    lookouts = {camera: Lookout(cell, camera) for camera in cameras}
    estimators = {
        (camera, target): PoseCNN(cell, camera, target, net, uncertainty)
        for camera, lookout in lookouts.items()
        for target in targets
        if target in lookout.targets
    }
    for k, estimator in enumerate(estimators.values()):
        node.progress("preparing estimators", k, len(estimators))
        estimator.prepare()
    node.progress("preparing estimators", len(estimators), len(estimators))
    undistort = {camera: Undistortion(cell.cameras[camera].lens) for camera in cameras}
    fused = node.latest(FUSED)

    def on_frame(frame: Frame, names: dict[str, str]) -> None:
        camera = names["camera"]
        for target in lookouts[camera].targets:
            if (pose := fused.get(target=target)) is not None:
                lookouts[camera].add(pose)
        window = lookouts[camera].look(frame.stamp_ns)
        image = undistort[camera](frame.image)
        for (own, target), estimator in estimators.items():
            if own != camera or not node.owns(f"{camera}/{target}"):
                continue
            T_prior, _ = predict(fused.get(target=target), frame.stamp_ns)
            estimate = estimator.update(image, window, T_prior)
            node.publish(VISION, estimate.message(frame.stamp_ns, target, camera, cell.frame), target=target)

    for camera in cameras:
        node.subscribe(FRAME, on_frame, streams=[f"{camera}/{target}" for target in targets], camera=camera)
