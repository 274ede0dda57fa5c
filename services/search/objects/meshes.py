"""Reads, checks, repairs and simplifies users' meshes, so that contours can be drawn from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from penumbra.services.search.objects import paint
from penumbra.services.search.objects.paint import Cloud
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.body.simplification import simplified
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import kernel

Faces = NDArray[np.int32]

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
"""Metres per unit."""
EXTENT = (0.005, 20.0)
"""Bounds of the largest side [m] of an object: outside them its unit is wrong."""
MERGE = 1e-6
"""Distance, as a share of the largest side, below which vertices are merged."""

DENSE = 5
"""Multiple of the wanted number of triangles above which the mesh is simplified on a grid first."""
CELL = 0.008
"""Side of the grid's cells, as a share of the largest side: less than a pixel of most pictures."""


class ObjectFileError(ValueError):
    """Input of a user that cannot be used; the text says what was expected, what was received and what to do."""


def load(path: Path, unit: str) -> tuple[Mesh, Cloud | None]:
    """The triangle mesh of a file (PLY, STL, OBJ, GLB, OFF) in metres, not repaired, and its colours, None if it has none; `unit`
    is one of UNITS. Raises ObjectFileError."""
    import trimesh

    if not path.is_file():
        raise ObjectFileError(f"{path}: expected a mesh file, found none")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # trimesh's readers raise anything
        raise ObjectFileError(f"{path}: expected a triangle mesh that trimesh reads (PLY, STL, OBJ, GLB, OFF): {error}") from None
    vertices, faces = np.asarray(getattr(mesh, "vertices", ())), np.asarray(getattr(mesh, "faces", ()))
    if not len(faces):
        raise ObjectFileError(f"{path}: expected a triangle mesh, got a file without triangles")
    if not np.isfinite(vertices[faces]).all():
        raise ObjectFileError(f"{path}: expected finite coordinates, got vertices that are not; repair the file")
    extent = float(np.ptp(vertices[faces].reshape(-1, 3), axis=0).max())
    if not EXTENT[0] <= extent * UNITS[unit] <= EXTENT[1]:
        fitting = [name for name, metres in UNITS.items() if 0.02 <= extent * metres <= 3.0]
        hint = f"if its unit is {' or '.join(fitting)}, give it with --mesh-unit" if fitting else "scale it"
        raise ObjectFileError(
            f"{path}: expected an object of {EXTENT[0]} to {EXTENT[1]:g} m, got one of {extent * UNITS[unit]:.3g} m with "
            f"--mesh-unit {unit}; {hint}"
        )
    mesh.apply_scale(UNITS[unit])
    whole = Mesh(np.asarray(mesh.vertices, np.float64), faces.astype(np.int32), np.zeros(len(faces), np.uint8))
    return whole, paint.cloud(mesh)


def repaired(mesh: Mesh, most: int) -> Mesh:
    """The same surface with at most about `most` triangles. Coinciding vertices are merged, triangles without area and duplicates
    are removed, and the triangles are oriented outwards. Holes stay. Raises ObjectFileError if nothing is left."""
    vertices, faces = _merged(mesh.vertices, mesh.faces)
    if not len(faces):
        raise ObjectFileError("mesh: expected triangles with an area, got none")
    if len(faces) > DENSE * most:
        vertices, faces = _clustered(vertices, faces)
    faces = _oriented(vertices, faces)
    if len(faces) > most:
        vertices, faces = _merged(*simplified(vertices, faces, most))
        faces = _oriented(vertices, faces)
    return Mesh(vertices, faces, np.zeros(len(faces), np.uint8))


def _merged(vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    grid = MERGE * float(np.ptp(vertices, axis=0).max()) + 1e-300
    _, first, index = np.unique(
        np.round((vertices - vertices.min(axis=0)) / grid).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    faces = index.reshape(-1)[faces].astype(np.int32)
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    _, kept = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(kept)]
    used, again = np.unique(faces, return_inverse=True)
    return np.ascontiguousarray(vertices[first][used]), np.ascontiguousarray(again.reshape(-1, 3), np.int32)


def _clustered(vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    """One vertex per grid cell, where the planes of its triangles meet best (Lindstrom 2000, doi:10.1145/344779.344912)."""
    cell = CELL * float(np.ptp(vertices, axis=0).max())
    key = np.floor((vertices - vertices.min(axis=0)) / cell).astype(np.int64)
    _, index, count = np.unique(key @ np.array([1, 1 << 20, 1 << 40]), return_inverse=True, return_counts=True)
    n = len(count)
    mean = np.stack([np.bincount(index, vertices[:, k]) for k in range(3)], axis=1) / count[:, None]
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # longer for larger triangles
    A, b = np.zeros((n, 3, 3)), np.zeros((n, 3))
    for c in range(3):
        at = index[faces[:, c]]
        height = np.einsum("ij,ij->i", normal, corners[:, 0] - mean[at])
        for i in range(3):
            b[:, i] += np.bincount(at, normal[:, i] * height, n)
            for j in range(3):
                A[:, i, j] += np.bincount(at, normal[:, i] * normal[:, j], n)
    size = np.trace(A, axis1=1, axis2=2)[:, None, None] + 1e-300
    step = np.linalg.solve(A / size + 1e-3 * np.eye(3), b[..., None] / size)[..., 0]  # flat cells stay at their middle
    return _merged(mean + np.clip(step, -cell, cell), index[faces].astype(np.int32))


def _oriented(vertices: Array, faces: Faces) -> Faces:
    """The faces, consistently oriented within each connected part, and outwards."""
    a = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    owner = np.tile(np.arange(len(faces)), 3)
    ends = np.sort(a, axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    same = (ends[order[1:]] == ends[order[:-1]]).all(axis=1)
    i, j = order[:-1][same], order[1:][same]
    # consistently oriented neighbours run along their common edge in opposite directions
    differ = (a[i, 0] == a[j, 0]).astype(np.int8)
    part, flip = np.empty(len(faces), np.int64), np.empty(len(faces), np.int8)
    _spread(owner[i], owner[j], differ, part, flip)
    faces = np.where(flip[:, None] == 1, faces[:, ::-1], faces)
    corners = vertices[faces]
    # the volume about the part's own middle also finds the outside of a part with holes
    count = np.bincount(part)
    middle = np.stack([np.bincount(part, corners.mean(axis=1)[:, k]) / np.maximum(count, 1) for k in range(3)], axis=1)
    corners = corners - middle[part][:, None]
    volume = np.bincount(part, np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))
    return np.ascontiguousarray(np.where(volume[part][:, None] < 0.0, faces[:, ::-1], faces), np.int32)


@kernel("i8[m], i8[m], i1[m], out i8[n], out i1[n]")
def _spread(first, second, differ, part, flip):
    """Writes the connected part of each face, and whether it has to be flipped to be turned as the part's first."""
    m, n = len(first), len(part)
    start = np.zeros(n + 1, np.int64)
    for e in range(m):
        start[first[e] + 1] += 1
        start[second[e] + 1] += 1
    for f in range(n):
        start[f + 1] += start[f]
    fill, other, parity = start[:-1].copy(), np.empty(2 * m, np.int64), np.empty(2 * m, np.int8)
    for e in range(m):
        f, g = first[e], second[e]
        other[fill[f]], parity[fill[f]] = g, differ[e]
        other[fill[g]], parity[fill[g]] = f, differ[e]
        fill[f] += 1
        fill[g] += 1
    part[:], flip[:], stack = -1, 0, np.empty(n, np.int64)
    parts = 0
    for f in range(n):
        if part[f] >= 0:
            continue
        part[f], stack[0], top = parts, f, 1
        while top > 0:
            top -= 1
            at = stack[top]
            for e in range(start[at], start[at + 1]):
                g = other[e]
                if part[g] < 0:
                    part[g], flip[g] = parts, flip[at] ^ parity[e]
                    stack[top] = g
                    top += 1
        parts += 1
