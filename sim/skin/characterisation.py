"""The paper's characterisation of a pad on the emulated skin: a pad is held before a limb as the authors' robot held it.

Distances from 1 to 20 cm at angles from 0 to 90 degrees to the limb, and a scan of a plane 1 cm above each part of it. Every pose
is one solution of the field model (`sim.skin.field`), sampled repeatedly with the noise of the pad's signal chain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from penumbra.shared.body.anatomy import target_mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry.rigid import Array, inverse
from penumbra.shared.geometry.surface import Surface
from penumbra.sim.skin.field import PadField, limb

GAPS_M = np.arange(2, 41) * 0.005
ANGLES_DEG = np.arange(10) * 10.0
"""Gaps [m] and angles [degrees] of the distance scan."""
PLANE_M = 0.01
"""Height [m] of a plane scan above its part of the limb."""
MARGIN_M = (0.06, 0.08)
"""Lengths [m] by which a plane scan extends beyond its part of the limb, along the limb and across it."""
OVER_M = 0.03
"""Length [m] by which a plane scan overlaps the adjacent part that is nearer to the elbow."""
ALONG = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""R_limb_pad of a pad above the limb that faces down, with the limb along the pad's y axis."""
EMPTY_SAMPLES = 1000
"""Minimum number of samples without a limb."""


@dataclass(frozen=True)
class Pose:
    """Where a pad is held: scan (empty, distance or plane), part (of the limb), gap [m] between board and skin, angle
    [degrees], x and y [m] in the limb's frame, T_limb_pad (4, 4), None where nothing is near."""

    scan: str
    part: str
    gap: float
    angle: float
    x: float
    y: float
    T_limb_pad: Array | None


def poses(cell: cells.Cell, target: str, pad_type: str, step: float) -> list[Pose]:
    """Every pose of the characterisation, with the plane scans on a grid of `step` [m]."""
    mesh = target_mesh(cell.targets[target], cell)
    surface = Surface(mesh.vertices, mesh.faces)
    size = np.array(cell.pad_types[pad_type].board.size)
    across = np.linspace(-0.5, 0.5, 7)
    board = np.array([(x * size[0], y * size[1], 0.0) for x in across for y in across])
    own = mesh.vertices[np.unique(mesh.faces[mesh.labels == mesh.labels[0]])]
    top = own[own[:, 2] > own[:, 2].max() - 1e-3].mean(axis=0)  # where it is thickest: level, so that the pad's middle is nearest
    out = [Pose("empty", "", np.inf, 0.0, 0.0, 0.0, None)]
    for angle in ANGLES_DEG:
        rotation = ALONG @ Rotation.from_euler("y", angle, degrees=True).as_matrix()
        for gap in GAPS_M:
            T = np.eye(4)
            T[:3, :3] = rotation
            T[:3, 3] = (top[0], top[1], top[2] + gap)
            for _ in range(40):  # its nearest edge comes to the gap from below
                T[2, 3] += gap - surface.nearest(board @ T[:3, :3].T + T[:3, 3])[0].min()
            out.append(Pose("distance", Label(mesh.labels[0]).name.lower(), float(gap), float(angle), T[0, 3], T[1, 3], T))
    for label in np.unique(mesh.labels):
        low, high = _part(mesh.vertices, mesh.faces[mesh.labels == label])
        xs = np.arange(low[0] - (OVER_M if low[0] > mesh.vertices[:, 0].min() else MARGIN_M[0]), high[0] + MARGIN_M[0], step)
        ys = np.arange(low[1] - MARGIN_M[1], high[1] + MARGIN_M[1], step)
        held = np.array([(x, y, high[2]) for x in xs for y in ys])
        for _ in range(10):  # from below, until the pad is clear of the limb at every place
            points = (board[::2] @ ALONG.T)[None] + held[:, None]
            held[:, 2] += max(PLANE_M - surface.nearest(points.reshape(-1, 3))[0].min(), 0.0)
        for position in held:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = ALONG, position
            out.append(Pose("plane", Label(label).name.lower(), PLANE_M, 0.0, float(position[0]), float(position[1]), T))
    return out


def measure(
    cell: cells.Cell,
    target: str,
    pad_type: str,
    held: list[Pose],
    samples: int,
    seed: int,
    progress: Callable[[list[Pose]], Iterator[Pose]] = iter,
) -> list[Array]:
    """Noisy amplitudes (s, e) [V] of a pad of this type as designed, at every pose; at least EMPTY_SAMPLES without a limb."""
    kind = cell.pad_types[pad_type]
    field, body = PadField(kind), limb(target_mesh(cell.targets[target], cell))
    chain, rest = kind.chain, kind.rest
    rng = np.random.default_rng([seed, 7])
    out = []
    for pose in progress(held):
        if pose.T_limb_pad is None:
            change, count = np.zeros(len(kind.electrodes)), max(EMPTY_SAMPLES, samples)
        else:
            change, count = field.change(body, inverse(pose.T_limb_pad)), samples
        clean = rest.a3 + rest.polarity * chain.sensitivity * change
        noise = np.sqrt(rest.noise) * rng.standard_normal((count, len(change)))
        out.append(np.clip(clean + noise, 0.0, chain.adc_reference / 2.0))
    return out


def _part(vertices: Array, faces: NDArray[np.integer]) -> Array:
    """Lowest and highest corner (2, 3) of the bounding box of some faces."""
    own = vertices[np.unique(faces)]
    return np.stack([own.min(axis=0), own.max(axis=0)])
