"""`penumbra snapshot OUT.png`: the camera's picture, with the network's mask and the observer's pose of the arm.

Drawn over the camera's picture: the mask's classes as a tint, the silhouette of the fused pose as a line (green: tracking, amber:
coasting, red: lost), each pad as its outline, filled more brightly the more it feels.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import zenoh
from numpy.typing import NDArray

from penumbra.services import flags
from penumbra.services.command import look
from penumbra.shared.body import anatomy
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.contract.labels import COLOURS, Label
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.geometry.lens import Undistortion
from penumbra.shared.runtime import bus, running, which
from penumbra.shared.skin.layout import Skin, link_names, pad_poses

PATIENCE_S = 5.0
"""Time [s] to wait for a message of every topic."""

LINES = {"tracking": (30, 230, 60), "coasting": (255, 190, 30), "lost": (240, 40, 40)}
PAD_HALF = (0.0305, 0.03)
FULL_SIGNAL = 0.6
"""Signal [V] of the strongest electrode at which a pad is drawn full: that of an arm at 1 cm."""


def _picture(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise ValueError(f"expected a .png or .jpg, got {text!r}")
    if not path.parent.is_dir():
        raise ValueError(f"expected a file in a folder that exists, got {text!r}")
    return path


@flags.command(
    "snapshot",
    "Writes a picture of the cell: camera, mask, fused silhouette, pads lit by signal.",
    flags.Argument("out", type=_picture, metavar="FILE", help="the picture to write (.png or .jpg)"),
    flags.Option("--camera", shell_complete=flags.complete_part("cameras"), show_default="its first", help="of the cell"),
    flags.Option("--target", shell_complete=flags.complete_part("targets"), show_default="its first", help="of the cell"),
    *flags.LOOKING,
    example="penumbra snapshot cell.png --camera front",
)
def main(options: flags.Options) -> None:
    """Write the picture, and print its size."""
    cell = cells.load(look.file_of(options))
    camera, target = cell.one("cameras", options.camera), cell.one("targets", options.target)
    with look.open_session(bus.connection(options)) as session:
        heard = listen(session, cell, camera, target)
    picture = draw(cell, camera, target, **heard)
    if not cv2.imwrite(str(options.out), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)):
        raise bus.BusError(f"{options.out} cannot be written: check the folder's permissions")
    print(f"{options.out}: {picture.shape[1]} x {picture.shape[0]}")


def listen(session: zenoh.Session, cell: cells.Cell, camera: str, target: str) -> dict[str, Any]:
    """One moment of the cell: a mask and its frame, the fused pose nearest to it, joints and voltages."""
    keep = {topics.FRAME: 30, topics.MASK: 30, topics.FUSED: 400, topics.JOINTS: 1, topics.VOLTAGES: len(cell.pads)}
    names = {"cell": cell.name, "camera": camera, "target": target}
    readers = {topic: session.declare_subscriber(topic.at(**names), zenoh.handlers.RingChannel(n)) for topic, n in keep.items()}
    frames: dict[int, messages.Frame] = {}
    fused: dict[int, messages.FusedPose] = {}
    joints: dict[str, messages.Joints] = {}
    voltages: dict[str, messages.Voltages] = {}
    deadline = time.monotonic() + PATIENCE_S
    missing = "frame"
    while time.monotonic() < deadline:
        mask = None
        for topic, reader in readers.items():
            while (sample := reader.try_recv()) is not None:
                message = messages.decode(topic.message, sample.payload.to_bytes())
                part = str(sample.key_expr).split("/")[3]
                match message:
                    case messages.Frame():
                        frames[message.stamp_ns] = message
                    case messages.Mask():
                        mask = message
                    case messages.FusedPose():
                        fused[message.stamp_ns] = message
                    case messages.Joints():
                        joints[part] = message
                    case messages.Voltages():
                        voltages[part] = message
        complete = set(voltages) >= set(cell.pads) and set(joints) >= set(cell.robots) and fused
        missing = "frame" if not frames else "fused pose" if not fused else "voltages or joints" if not complete else "mask"
        if mask and complete and mask.stamp_ns in frames:
            nearest = min(fused, key=lambda stamp: abs(stamp - mask.stamp_ns))
            return {
                "frame": frames[mask.stamp_ns],
                "mask": mask,
                "pose": fused[nearest],
                "joints": {name: message.position for name, message in joints.items()},
                "volts": {name: message.volts.mean(axis=0) for name, message in voltages.items()},
            }
        time.sleep(0.01)
    remedy = "check `penumbra topics --hz`" if running.ask(session, cell.name) else which.elsewhere(session, cell.name)
    raise bus.BusError(f"cell {cell.name}: expected {missing} within {PATIENCE_S:.0f} s, got none; {remedy}")


def draw(
    cell: cells.Cell,
    camera_name: str,
    target_name: str,
    frame: messages.Frame,
    mask: messages.Mask | None,
    pose: messages.FusedPose,
    joints: Mapping[str, NDArray],
    volts: Mapping[str, NDArray],
) -> NDArray[np.uint8]:
    """The picture (h, w, 3) uint8 RGB. mask: of the frame, or None; joints: by robot; volts: mean electrode amplitudes by pad."""
    camera = cell.cameras[camera_name]
    picture = Undistortion(camera.lens)(frame.image).copy()
    if mask is not None:
        _tint(picture, mask)
    _pads(picture, cell, camera, joints, volts)
    mesh = anatomy.target_mesh(cell.targets[target_name], cell)
    T = rigid.inverse(camera.T_world_camera) @ rigid.transform(pose.position, pose.orientation)
    k = (camera.fx, camera.fy, camera.cx, camera.cy)
    silhouette = raster.silhouette(rigid.apply(T, mesh.vertices), mesh.faces, k, (0, 0, camera.width, camera.height))
    outline, _ = cv2.findContours(silhouette.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outline, -1, LINES[pose.state], 2, cv2.LINE_AA)
    senses = ", ".join(f"{name} {100 * source.weight:.0f} %" for name, source in sorted(pose.sources.items()))
    deviation_cm = 100 * np.sqrt(np.linalg.eigvalsh(pose.covariance[:3, :3]).max())
    text = f"{cell.name}: {pose.state}, +-{deviation_cm:.1f} cm  ({senses or 'no sense received'})"
    picture[:30] = (0.35 * picture[:30]).astype(np.uint8)
    cv2.putText(picture, text, (10, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def _tint(picture: NDArray[np.uint8], mask: messages.Mask) -> None:
    """Blend the classes of the mask's window into the picture, in place."""
    colours = np.zeros((256, 3), np.float32)
    for label, colour in COLOURS.items():
        colours[label] = colour
    labels = np.kron(mask.labels, np.ones((mask.scale, mask.scale), np.uint8))
    top, left = max(mask.y0, 0), max(mask.x0, 0)
    bottom = min(mask.y0 + labels.shape[0], picture.shape[0])
    right = min(mask.x0 + labels.shape[1], picture.shape[1])
    if bottom <= top or right <= left:
        return
    labels = labels[top - mask.y0 : bottom - mask.y0, left - mask.x0 : right - mask.x0]
    region = picture[top:bottom, left:right]
    shown = labels != Label.BACKGROUND
    region[shown] = (0.55 * region[shown] + 0.45 * colours[labels[shown]]).astype(np.uint8)


def pad_levels(cell: cells.Cell, volts: Mapping[str, NDArray]) -> dict[str, float]:
    """Level of each pad from 0 to 1, by its strongest electrode. volts: mean electrode amplitudes [V] by pad."""
    if not volts:
        return {}
    skin = Skin(cell)
    out = {}
    for name, found in volts.items():
        own = skin.of(skin.pads.index(name))
        signal = float(np.max(skin.polarity[own] * (found - skin.a3[own])))
        out[name] = float(np.clip(np.log1p(max(signal, 0.0) / 0.003) / np.log1p(FULL_SIGNAL / 0.003), 0.0, 1.0))
    return out


def _pads(picture: NDArray[np.uint8], cell: cells.Cell, camera: cells.Camera, joints: Mapping, volts: Mapping) -> None:
    """Draw the pads that face the camera and whose pose is known, filled by their strongest signal, in place."""
    links = link_names(
        {name: model.link_transforms(joints[name]) for name, model in robot_models(cell).items() if name in joints}
    )
    levels = pad_levels(cell, volts)
    T_camera_world = rigid.inverse(camera.T_world_camera)
    corners = np.array([(x * PAD_HALF[0], y * PAD_HALF[1], 0.0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    for name, T_world_pad in pad_poses(cell, links).items():
        T = T_camera_world @ T_world_pad
        points = rigid.apply(T, corners)
        if points[:, 2].min() < raster.NEAR or T[:3, 2] @ T[:3, 3] > 0:
            continue
        outline = (points @ camera.K.T / points[:, 2:])[:, :2].round().astype(np.int32)
        level = levels.get(name, 0.0)
        lit = picture.copy()
        cv2.fillPoly(lit, [outline], (int(60 + 195 * level), int(60 + 150 * level), int(90 * (1 - level))), cv2.LINE_AA)
        cv2.addWeighted(lit, 0.35 + 0.5 * level, picture, 0.65 - 0.5 * level, 0, picture)
        cv2.polylines(picture, [outline], True, (255, 255, 255), 1, cv2.LINE_AA)
