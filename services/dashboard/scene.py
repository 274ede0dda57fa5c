"""The static parts of the scene: meshes of robots and targets, pads and cameras, sent once to each page that opens."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from penumbra.services.dashboard.state import pose_of
from penumbra.shared.body import anatomy
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.body.robot import RobotModel, robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import COLOURS

LINK_DIGITS = 9
"""Decimals of a link's pose in its parent: errors along a chain of links add up."""


def pack(cell: cells.Cell) -> bytes:
    """The length of a header, the header (JSON), and the meshes: vertices (n, 3) float32 [m] and faces (m, 3) uint32 of each.

    The header states the offsets of each mesh's two arrays, in four-byte numbers after the header. Raises CellError if a mesh
    cannot be read.
    """
    blocks: list[bytes] = []
    meshes: dict[str, dict[str, int]] = {}
    at = 0
    for name, mesh in _meshes(cell).items():
        vertices = np.ascontiguousarray(mesh.vertices, "<f4")
        faces = np.ascontiguousarray(mesh.faces, "<u4")
        meshes[name] = {"at": at, "vertices": len(vertices), "faces": len(faces)}
        at += vertices.size + faces.size
        blocks += [vertices.tobytes(), faces.tobytes()]
    text = json.dumps(describe(cell) | {"meshes": meshes}).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<I", len(text)) + text + b"".join(blocks)


def describe(cell: cells.Cell) -> dict[str, Any]:
    """Description of a cell for a page: names, poses of pads and cameras, colours of the classes."""
    return {
        "cell": cell.name,
        "frame": cell.frame,
        "targets": list(cell.targets),
        "robots": list(cell.robots),
        "links": {name: link for robot, model in robot_models(cell).items() for name, link in _links(robot, model).items()},
        "cameras": {
            name: {
                "pose": pose_of(camera.T_world_camera),
                "size": [camera.width, camera.height],
                "angle": float(2.0 * np.arctan2(camera.height, 2.0 * camera.fy)),
            }
            for name, camera in cell.cameras.items()
        },
        "pads": {
            name: {
                "link": pad.link,
                "pose": pose_of(pad.T_link_pad),
                "size": [float(side) for side in cell.pad_types[pad.type].board.size],
                "electrodes": list(cell.pad_types[pad.type].electrodes),
            }
            for name, pad in cell.pads.items()
        },
        "labels": {
            str(int(label)): {"name": label.name.lower().replace("_", " "), "colour": COLOURS[label]} for label in COLOURS
        },
        "is_simulated": cell.sim is not None,
        "senses": [sense for sense, part in (("vision", cell.cameras), ("haptic", cell.pads)) if part],
    }


def _meshes(cell: cells.Cell) -> dict[str, Mesh]:
    """Meshes by `link/ROBOT/LINK` and `target/NAME`."""
    out = {f"link/{robot}/{link}": mesh for robot, model in robot_models(cell).items() for link, mesh in model.meshes.items()}
    return out | {f"target/{name}": anatomy.target_mesh(target, cell) for name, target in cell.targets.items()}


def _links(robot: str, model: RobotModel) -> dict[str, dict[str, Any]]:
    """The links of a robot as `ROBOT/LINK`, a parent before its children.

    parent: the link that carries it, null for the base, which is fixed to the world. pose: in its parent, with its joint at zero.
    joint: index of its joint in a message of joints, null if it does not move. axis: of the joint, in the link's frame. slides:
    whether the joint moves the link along the axis instead of turning it.
    """
    out = {}
    for i, (link, parent) in enumerate(zip(model.links, model.parents, strict=True)):
        joint = model.description.joints[i - 1] if i else None
        moves = joint is not None and joint.name in model.joints
        out[f"{robot}/{link}"] = {
            "parent": f"{robot}/{model.links[parent]}" if i else None,
            "pose": pose_of(model.T_parent_link[i], LINK_DIGITS),
            "joint": model.joints.index(joint.name) if joint is not None and moves else None,
            "axis": joint.axis.tolist() if joint is not None and moves else None,
            "slides": joint is not None and joint.kind == "prismatic",
        }
    return out
