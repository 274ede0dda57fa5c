"""Nearest point on a triangle mesh, and signed distance to it.

The skin's response law needs it twice: in the emulator for the gap of every electrode, and in the haptic solve for the gap and
its derivative. Point to triangle after Ericson, Real-Time Collision Detection (2005), 5.1.5; the sign by angle-weighted
pseudonormals (Baerentzen & Aanaes 2005, DOI 10.1109/TVCG.2005.49), exact for closed meshes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import inner, kernel


class Surface:
    """A mesh prepared for nearest-point queries.

    vertices (n, 3) [m] in the mesh's own frame; faces (m, 3) vertex indices, counter-clockwise seen from outside.
    Raises ValueError where the arrays do not describe a mesh.
    """

    def __init__(self, vertices: Array, faces: NDArray[np.integer]):
        vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        faces = np.ascontiguousarray(faces, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise ValueError(f"expected a mesh of (n, 3) vertices and (m, 3) faces, got {vertices.shape} and {faces.shape}")
        if not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError(f"expected finite vertices and face indices below {len(vertices)} in the mesh; repair it")
        # Duplicate vertices (one per face) are merged for the pseudonormals.
        _, first, inverse = np.unique(np.round(vertices, 9), axis=0, return_index=True, return_inverse=True)
        vertices, faces = vertices[first], inverse.reshape(-1)[faces]
        corners = vertices[faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        solid = area > 1e-14
        self.vertices, self.faces = vertices, faces[solid]
        self._corners = np.ascontiguousarray(corners[solid])
        centers, self._radii = _enclosing_circles(self._corners)
        self._centers = np.ascontiguousarray(centers.T)
        self._normals = _pseudonormals(vertices, self.faces)

    def nearest(self, points: Array) -> tuple[Array, Array, Array]:
        """Signed distances (n,) [m] (negative inside), nearest points (n, 3) and unit gradients (n, 3) of the distance, for
        points (n, 3) in the mesh's frame."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        distance, nearest, gradient = np.empty(len(points)), np.empty((len(points), 3)), np.empty((len(points), 3))
        nearest_points(points, *self.arrays, distance, nearest, gradient)
        return distance, nearest, gradient

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """Corners (m, 3, 3), centres (3, m), radii (m,) and pseudonormals (m, 7, 3), as arguments of `nearest_points`."""
        return self._corners, self._centers, self._radii, self._normals


def _enclosing_circles(corners: Array) -> tuple[Array, Array]:
    """Centres (m, 3) and radii (m,) of the smallest circles around triangles (m, 3, 3): the circumcircle, or for an obtuse
    triangle the circle on its longest edge. Each centre lies on its triangle."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    # barycentric weights of the circumcentre, from the squared edges; a negative one is opposite to an obtuse corner
    squares = np.stack([np.sum((p - q) ** 2, axis=1) for p, q in ((b, c), (c, a), (a, b))], axis=1)
    weights = squares * (squares.sum(axis=1, keepdims=True) - 2.0 * squares)
    weights = np.maximum(weights / np.abs(weights).sum(axis=1, keepdims=True), 0.0)
    obtuse = (weights == 0.0).any(axis=1)
    longest = np.argmax(squares, axis=1)
    weights[obtuse] = 0.5
    weights[obtuse, longest[obtuse]] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    centers = np.einsum("mk,mki->mi", weights, corners)
    return centers, np.linalg.norm(corners - centers[:, None], axis=2).max(axis=1)


def _pseudonormals(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """Outward directions (m, 7, 3), not normalised, of each face, its edges 01, 12, 20 and its corners 0, 1, 2."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    out = np.empty((len(faces), 7, 3))
    out[:, 0] = normal
    at_vertex = np.zeros_like(vertices)
    edges: dict[tuple[int, int], Array] = {}
    for k in range(3):
        a, b, c = corners[:, k], corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]
        cosine = np.sum((b - a) * (c - a), axis=1) / (np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - a, axis=1))
        np.add.at(at_vertex, faces[:, k], np.arccos(np.clip(cosine, -1, 1))[:, None] * normal)
        for i, j, n in zip(faces[:, k], faces[:, (k + 1) % 3], normal, strict=True):
            key = (min(i, j), max(i, j))
            edges[key] = edges.get(key, np.zeros(3)) + n
    for k in range(3):
        out[:, 4 + k] = at_vertex[faces[:, k]]
        for f, (i, j) in enumerate(zip(faces[:, k], faces[:, (k + 1) % 3], strict=True)):
            out[f, 1 + k] = edges[(min(i, j), max(i, j))]
    return out


@inner
def _closest(p, a, b, c):  # type: ignore[no-untyped-def]
    """Barycentric weights (v, w) of b and c at the point of triangle abc nearest to p, and where it lies (index as in
    `_pseudonormals`)."""
    abx, aby, abz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    acx, acy, acz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    apx, apy, apz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    d1 = abx * apx + aby * apy + abz * apz
    d2 = acx * apx + acy * apy + acz * apz
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0, 4
    bpx, bpy, bpz = p[0] - b[0], p[1] - b[1], p[2] - b[2]
    d3 = abx * bpx + aby * bpy + abz * bpz
    d4 = acx * bpx + acy * bpy + acz * bpz
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0, 5
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return d1 / (d1 - d3), 0.0, 1
    cpx, cpy, cpz = p[0] - c[0], p[1] - c[1], p[2] - c[2]
    d5 = abx * cpx + aby * cpy + abz * cpz
    d6 = acx * cpx + acy * cpy + acz * cpz
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0, 6
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return 0.0, d2 / (d2 - d6), 3
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 1.0 - w, w, 2
    scale = 1.0 / (va + vb + vc)
    return vb * scale, vc * scale, 0


@kernel("f8[n, 3], f8[m, 3, 3], f8[3, m], f8[m], f8[m, 7, 3], out f8[n], out f8[n, 3], out f8[n, 3]")
def nearest_points(points, corners, centers, radii, normals, distance, nearest, gradient):  # type: ignore[no-untyped-def]
    """Fill distance (n,), nearest (n, 3) and gradient (n, 3) for points (n, 3): see `Surface.nearest`."""
    m = len(corners)
    to_center = np.empty(m)
    for i in range(len(points)):
        p = points[i]
        for j in range(m):  # kept apart from the search for the smallest, so that it compiles to vector instructions
            x, y, z = p[0] - centers[0, j], p[1] - centers[1, j], p[2] - centers[2, j]
            to_center[j] = x * x + y * y + z * z
        first = int(np.argmin(to_center))
        # A centre lies on the surface: the nearest one bounds the distance, its triangle bounds it closely (and is therefore
        # looked at first), and few other triangles reach below that bound.
        bound = np.sqrt(to_center[first]) * (1.0 + 1e-9) + 1e-12
        best = bound * bound
        face, feature = first, 0
        for k in range(-1, m):
            j = first if k < 0 else k
            reach = bound + radii[j]
            if to_center[j] > reach * reach:
                continue
            # Sharper than the ball is the disc around the triangle: its height below p, and how far aside its rim stays.
            height = (
                (p[0] - centers[0, j]) * normals[j, 0, 0]
                + (p[1] - centers[1, j]) * normals[j, 0, 1]
                + (p[2] - centers[2, j]) * normals[j, 0, 2]
            )
            aside = max(np.sqrt(max(to_center[j] - height * height, 0.0)) - radii[j], 0.0)
            if height * height + aside * aside > best:
                continue
            a, b, c = corners[j, 0], corners[j, 1], corners[j, 2]
            v, w, part = _closest(p, a, b, c)
            u = 1.0 - v - w
            qx, qy, qz = u * a[0] + v * b[0] + w * c[0], u * a[1] + v * b[1] + w * c[1], u * a[2] + v * b[2] + w * c[2]
            square = (p[0] - qx) ** 2 + (p[1] - qy) ** 2 + (p[2] - qz) ** 2
            if square < best:
                best, bound = square, np.sqrt(square)
                nearest[i, 0], nearest[i, 1], nearest[i, 2] = qx, qy, qz
                face, feature = j, part
        x, y, z = p[0] - nearest[i, 0], p[1] - nearest[i, 1], p[2] - nearest[i, 2]
        n = normals[face, feature]
        sign = 1.0 if x * n[0] + y * n[1] + z * n[2] >= 0.0 else -1.0
        distance[i] = sign * bound
        scale = sign / max(bound, 1e-12)
        if bound < 1e-9:  # on the surface: its normal
            x, y, z, scale = n[0], n[1], n[2], 1.0 / np.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
        gradient[i, 0], gradient[i, 1], gradient[i, 2] = scale * x, scale * y, scale * z
