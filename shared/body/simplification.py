"""Simplification of meshes, and detection of holes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.geometry.rigid import Array

Faces = NDArray[np.int32]

SCALE = 1000.0
"""Largest side of a mesh during simplification: the order of the edge collapses depends on an absolute distance."""


def simplified(vertices: Array, faces: Faces, most: int) -> tuple[Array, Faces]:
    """Vertices (n, 3) and faces (m, 3) of nearly the same surface with about `most` triangles. Edge collapse with quadric errors
    (Garland, Heckbert 1997, doi:10.1145/258734.258849)."""
    import fast_simplification

    middle, scale = vertices.mean(axis=0), SCALE / float(np.ptp(vertices, axis=0).max())
    simple, faces = fast_simplification.simplify(((vertices - middle) * scale).astype(np.float32), faces, target_count=most)
    return simple.astype(np.float64) / scale + middle, faces.astype(np.int32)


def open_edges(faces: Faces) -> int:
    """Number of edges with an odd number of triangles (m, 3): zero for closed surfaces, also where two of them touch."""
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1).astype(np.int64)
    _, count = np.unique(ends[:, 0] << 32 | ends[:, 1], return_counts=True)
    return int(np.count_nonzero(count % 2))
