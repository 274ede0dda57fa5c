"""Forearms with hands and fingers in any pose, for training: the tracked mesh has one stiff hand, people do not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.body import anatomy as bodies
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

PALM = 0.54
"""Length of the palm as a share of the hand's."""
FINGERS = ((0.36, 0.40), (0.12, 0.44), (-0.12, 0.41), (-0.35, 0.33))
"""Index to little finger: position across the palm as a share of the hand's breadth, length as a share of the hand's."""
PHALANXES = (0.47, 0.3, 0.23)
"""Lengths of a finger's bones as shares of the finger's."""
SEGMENTS = 8
"""Number of corners of a finger's cross-section."""


def mesh(body: cells.Body, rng: np.random.Generator) -> Mesh:
    """A person's forearm and a posed hand, in the frame of `anatomy.forearm_mesh`: wrist bent by up to 60 degrees, fingers from
    spread to a fist."""
    whole = bodies.forearm_mesh(body)
    faces = whole.faces[whole.labels == Label.FOREARM]
    parts = [(whole.vertices[: faces.max() + 1], faces)]
    T_arm_hand = rigid.from_rpy(
        (body.forearm_length / 2.0, 0.0, 0.0),
        np.radians([rng.uniform(-15.0, 15.0), rng.uniform(-1.0, 1.0) ** 3 * 60.0, rng.uniform(-25.0, 20.0)]),
    )
    hand = [(rigid.apply(T_arm_hand, vertices), faces) for vertices, faces in _hand(body, rng)]
    labels = [np.full(len(faces), Label.FOREARM if i == 0 else Label.HAND, np.uint8) for i, (_, faces) in enumerate(parts + hand)]
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts + hand)])
    return Mesh(
        np.concatenate([vertices for vertices, _ in parts + hand]),
        np.concatenate([faces + start for (_, faces), start in zip(parts + hand, starts, strict=False)]).astype(np.int32),
        np.concatenate(labels),
    )


def band(body: cells.Body, rng: np.random.Generator) -> Mesh:
    """A watch or a bracelet around the wrist, in the frame of `anatomy.forearm_mesh`; it is labelled as forearm."""
    wide, thin = bodies.half_axes(body.wrist_circumference, 0.72)
    half, thick = rng.uniform(0.003, 0.018), rng.uniform(0.002, 0.008)
    x = body.forearm_length / 2.0 - half - rng.uniform(0.0, 0.04) + np.array([-half, -half, half, half])
    grow = 1.0 + 0.06 * (body.forearm_length / 2.0 - x) / 0.04  # the forearm gets wider towards the elbow
    added = np.array([0.0, thick, thick, 0.0])
    centres = np.stack([x, np.zeros(4), np.zeros(4)], axis=1)
    vertices, faces = bodies.loft(centres, wide * grow + added, thin * grow + added, 18)
    return Mesh(vertices, faces, np.full(len(faces), Label.FOREARM, np.uint8))


def _hand(body: cells.Body, rng: np.random.Generator) -> list[tuple[Array, NDArray[np.int32]]]:
    """Vertices and faces of palm, fingers and thumb; origin at the wrist, x towards the fingers, z dorsal, thumb on +y."""
    length, breadth = body.hand_length, body.hand_breadth
    wide_wrist, thin_wrist = bodies.half_axes(body.wrist_circumference, 0.68)
    at = np.array([-0.04, 0.1, 0.3, 0.8, 1.0, 1.06]) * PALM * length
    wide = np.array([0.9 * wide_wrist, 0.42 * breadth, 0.49 * breadth, 0.5 * breadth, 0.44 * breadth, 0.25 * breadth])
    thin = np.array([0.9 * thin_wrist, 0.19 * breadth, 0.18 * breadth, 0.15 * breadth, 0.12 * breadth, 0.06 * breadth])
    parts = [bodies.loft(np.stack([at, np.zeros(6), np.zeros(6)], axis=1), wide, thin, 16)]
    curl = rng.choice([rng.uniform(-0.1, 0.25), rng.uniform(0.1, 0.6), rng.uniform(0.6, 1.0)], p=[0.4, 0.35, 0.25])
    spread = rng.uniform(0.0, 1.0) * (1.0 - max(curl, 0.0))
    points = rng.random() < 0.1
    for k, (across, share) in enumerate(FINGERS):
        bend = 0.0 if points and k == 0 else float(np.clip(curl + rng.normal(0.0, 0.12), -0.15, 1.0))
        yaw = np.radians(40.0 * across * spread + rng.normal(0.0, 3.0))
        root = rigid.from_rpy((PALM * length, across * breadth, 0.0), (0.0, 0.0, yaw))
        parts += _finger(root, share * length, 0.1 * breadth, np.radians([75.0, 95.0, 60.0]) * bend)
    out, under = rng.uniform(10.0, 65.0) * (1.0 - 0.5 * max(curl, 0.0)), rng.uniform(5.0, 60.0)
    root = rigid.from_rpy((0.14 * length, 0.3 * breadth, -0.08 * breadth), np.radians([0.0, 0.5 * under, out]))
    parts += _finger(root, 0.58 * length, 0.125 * breadth, np.radians([0.0, 15.0, 30.0]) * rng.uniform(-0.5, 1.5))
    return parts


def _finger(root: Array, length: float, radius: float, bends: Array) -> list[tuple[Array, NDArray[np.int32]]]:
    """The bones of a finger (4, 4) rooted in the hand, each bent by an angle [rad] towards the palm (-z)."""
    parts, T = [], root
    for bone, angle, width in zip(PHALANXES, bends, (1.0, 0.92, 0.82), strict=True):
        T = T @ rigid.from_rpy((0.0, 0.0, 0.0), (0.0, angle, 0.0))
        at, r = np.array([-0.25 * radius, 0.1 * radius, bone * length, bone * length + 0.5 * radius]), radius * width
        tip = np.array([0.6, 1.0, 0.93, 0.5]) * r
        vertices, faces = bodies.loft(np.stack([at, np.zeros(4), np.zeros(4)], axis=1), tip, tip, SEGMENTS)
        parts.append((rigid.apply(T, vertices), faces))
        T = T @ rigid.from_rpy((bone * length, 0.0, 0.0), (0.0, 0.0, 0.0))
    return parts
