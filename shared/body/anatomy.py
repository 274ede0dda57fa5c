"""The person as closed triangle meshes, made from published body measures (ANSUR II, Gordon et al. 2014, DTIC ADA611869)."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from penumbra.shared.body.simplification import simplified
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import Label

EXTENT = (0.02, 3.0)
"""Minimum and maximum length [m] of a limb's mesh, its longest side."""
MOST_FACES = 4000
"""Maximum number of triangles of a user's mesh after simplification. Finer ones are smaller than a pixel."""
SIZE = np.array([0.0, -0.08])
"""Log length and log girth of an average limb, relative to the target's mesh."""
SIZE_SPREAD = np.array([0.06, 0.11])
"""Standard deviations of log length and log girth between people. From the 5th percentile of women to the 95th of men, the log
girth runs from -0.27 to 0.11 (ANSUR II)."""
SIZE_MEASURED = np.array([0.015, 0.03])
"""Standard deviations of log length and log girth around the size that the cell file states for a person."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    vertices: (n, 3) float64 [m]. faces: (m, 3) int32, counter-clockwise seen from outside. labels: (m,) uint8, class of each
    face.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    labels: NDArray[np.uint8]


def loft(
    centres: NDArray[np.float64], half_y: NDArray[np.float64], half_z: NDArray[np.float64], segments: int
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Closed tube through elliptical sections in the y-z plane: centres (k, 3), half axes (k,) [m]."""
    angle = np.arange(segments) * 2 * np.pi / segments
    ring = np.stack([np.zeros(segments), np.cos(angle), np.sin(angle)], axis=1)
    k = len(centres)
    scale = np.stack([np.zeros(k), half_y, half_z], axis=1)
    vertices = (centres[:, None, :] + ring[None] * scale[:, None, :]).reshape(-1, 3)
    vertices = np.vstack([vertices, centres[0], centres[-1]])
    i = np.arange(segments)
    j = (i + 1) % segments
    faces = [np.stack([np.full(segments, k * segments), j, i], axis=1)]
    for r in range(k - 1):
        a, b = r * segments, (r + 1) * segments
        faces += [np.stack([a + i, a + j, b + i], axis=1), np.stack([a + j, b + j, b + i], axis=1)]
    last = (k - 1) * segments
    faces.append(np.stack([np.full(segments, k * segments + 1), last + i, last + j], axis=1))
    return vertices, np.concatenate(faces).astype(np.int32)


def half_axes(circumference: ArrayLike, flatness: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Half axes (wide, thin) [m] of an ellipse with this circumference [m]. `flatness` is the ratio of the thin to the wide axis.
    (Ramanujan's first formula.)"""
    k = np.asarray(flatness, float)
    wide = np.asarray(circumference, float) / (np.pi * (3 * (1 + k) - np.sqrt((3 + k) * (1 + 3 * k))))
    return wide, k * wide


def _along_x(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> NDArray[np.float64]:
    return np.stack(np.broadcast_arrays(np.asarray(x, float), y, z), axis=1)


def _join(*parts: tuple[NDArray[np.float64], NDArray[np.int32], Label]) -> Mesh:
    vertices, faces, labels, n = [], [], [], 0
    for v, f, label in parts:
        vertices.append(v)
        faces.append(f + n)
        labels.append(np.full(len(f), label, np.uint8))
        n += len(v)
    return Mesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int32), np.concatenate(labels))


def forearm_mesh(body: cells.Body) -> Mesh:
    """Forearm with hand, thumb on +y. Origin midway between elbow and wrist on the axis, x towards the hand, z dorsal."""
    length = body.forearm_length
    # The muscle belly lies at a quarter of the length from the elbow; the wrist is flatter than the belly.
    at = np.array([0.0, 0.06, 0.25, 0.45, 0.65, 0.85, 1.0])
    around = (
        np.interp(at, [0.0, 0.06, 0.25, 0.45, 0.65, 0.85, 1.0], [0.78, 0.92, 1.0, 0.93, 0.76, 0.6, 0.0])
        * body.forearm_circumference
    )
    around[-1] = body.wrist_circumference
    wide, thin = half_axes(around, np.interp(at, [0, 0.25, 1.0], [0.95, 0.92, 0.68]))
    forearm = loft(_along_x((at - 0.5) * length, 0.0, 0.0), wide, thin, 18)

    wrist, hand, breadth = length / 2, body.hand_length, body.hand_breadth
    at = np.array([0.0, 0.12, 0.3, 0.52, 0.75, 0.93, 1.0])
    wide_hand = np.array([0.0, 0.42, 0.49, 0.5, 0.46, 0.34, 0.16]) * breadth
    thin_hand = np.array([0.0, 0.2, 0.17, 0.15, 0.11, 0.08, 0.05]) * breadth
    wide_hand[0], thin_hand[0] = wide[-1], thin[-1]
    # Relaxed fingers curl a little towards the palm (-z).
    palm = loft(_along_x(wrist + at * hand, 0.0, -0.10 * hand * at**2), wide_hand, thin_hand, 16)

    root = np.array([wrist + 0.16 * hand, 0.26 * breadth, -0.08 * breadth])
    tip = np.array([wrist + 0.55 * hand, 0.92 * breadth, -0.24 * breadth])
    at = np.array([0.0, 0.35, 0.75, 1.0])
    radius = np.array([0.17, 0.145, 0.115, 0.05]) * breadth
    thumb = loft(root + at[:, None] * (tip - root), radius, radius, 8)
    return _join((*forearm, Label.FOREARM), (*palm, Label.HAND), (*thumb, Label.HAND))


def upper_arm_mesh(body: cells.Body) -> Mesh:
    """Upper arm; origin at the shoulder, x towards the elbow."""
    at = np.array([0.0, 0.12, 0.4, 0.75, 0.97, 1.0])
    around = np.array([0.75, 1.0, 0.98, 0.85, 0.72, 0.45]) * body.upper_arm_circumference
    wide, thin = half_axes(around, 0.9)
    return _join((*loft(_along_x(at * body.upper_arm_length, 0.0, 0.0), wide, thin, 14), Label.UPPER_ARM))


def torso_mesh(body: cells.Body) -> Mesh:
    """Trunk, neck and head, z up, facing +x. The origin is the right shoulder joint, so the trunk lies on the +y side."""
    h, half = body.shoulder_height, body.chest_breadth / 2
    z = np.array([-1.0, -0.75, -0.35, -0.05, 0.07, 0.12, 0.24, 0.32, 0.47, 0.6, 0.63]) * h
    wide = np.array([1.05, 0.95, 1.08, 1.2, 0.95, 0.38, 0.36, 0.5, 0.54, 0.4, 0.15]) * half
    depth = np.array([0.8, 0.78, 1.0, 0.9, 0.6, 0.45, 0.45, 0.68, 0.76, 0.55, 0.2]) * body.chest_depth / 2
    vertices, faces = loft(_along_x(z, 0.0, 0.0), wide, depth, 18)
    vertices = np.stack([-vertices[:, 2], vertices[:, 1], vertices[:, 0]], axis=1)  # turned upright: x becomes z
    vertices[:, 1] += 1.2 * half
    return _join((vertices, faces, Label.TORSO))


def target_mesh(target: cells.Target, cell: cells.Cell) -> Mesh:
    """Mesh of a target, scaled by its size: the parametric forearm, or the user's own file (metres, x along the limb). Raises
    CellError."""
    mesh, size = _mesh(target, cell), target.size
    return mesh if size is None else replace(mesh, vertices=mesh.vertices * (size.length, size.girth, size.girth))


def _mesh(target: cells.Target, cell: cells.Cell) -> Mesh:
    if target.mesh == "body:forearm":
        return forearm_mesh(cell.body)
    vertices, faces = _few(cell.folder / target.mesh)
    return Mesh(vertices, faces, np.full(len(faces), target.label_values[0], np.uint8))


def _few(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """As `read`, with at most MOST_FACES triangles; cached per file and process."""
    try:
        return _simplified(path, path.stat().st_mtime_ns)
    except OSError as error:
        raise cells.CellError(f"{path}: cannot be read: {error.strerror}") from None


@functools.lru_cache(maxsize=8)
def _simplified(path: Path, changed_ns: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    vertices, faces = read(path)
    if len(faces) > MOST_FACES:
        vertices, faces = simplified(vertices, faces, MOST_FACES)
    return vertices, faces


def read(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices (n, 3) [m] and faces (m, 3) of a limb's mesh file, unchanged. Raises CellError."""
    import trimesh

    try:
        mesh = trimesh.load_mesh(path)
    except Exception:  # trimesh's readers raise any exception, with texts about their internals
        what = f"expected a triangle mesh (STL, OBJ, PLY, GLB or OFF), got {path}, which cannot be read as {path.suffix or 'one'}"
        raise cells.CellError(f"{what}; export it again") from None
    vertices, faces = np.asarray(getattr(mesh, "vertices", ()), np.float64), np.asarray(getattr(mesh, "faces", ()), np.int32)
    if not len(faces):
        raise cells.CellError(f"expected a triangle mesh, got no triangles in {path}; export it again, as triangles")
    if not np.isfinite(vertices[faces]).all():
        raise cells.CellError(f"expected finite coordinates, got some in {path} that are not; export it again")
    extent = float(np.ptp(vertices[faces].reshape(-1, 3), axis=0).max())
    if not EXTENT[0] < extent < EXTENT[1]:
        units = {"mm": 1e-3, "cm": 1e-2, "inches": 0.0254, "km": 1e3}
        fitting = next((unit for unit, metres in units.items() if EXTENT[0] < extent * metres < EXTENT[1]), None)
        hint = f"if its unit is {fitting}, scale it by {units[fitting]:g}" if fitting else "scale it"
        what = f"expected a limb of {EXTENT[0]} to {EXTENT[1]:g} m, got {extent:.3g} m in {path}; {hint} to metres"
        raise cells.CellError(what)
    return vertices, faces
