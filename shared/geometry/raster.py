"""Z-buffer rasteriser for triangle meshes, on one thread.

A pixel belongs to a triangle if its centre lies inside. Centres on a shared edge belong to exactly one of the two triangles
(top-left rule, on a grid of 1/256 pixel). Triangles are clipped at the near plane. Depth is the camera's z [m].
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from penumbra.shared.native import inner, kernel

NEAR = 0.02
"""Depth [m] of the near plane. Nothing closer to the camera is drawn."""
SUBPIXEL = 256
"""Coordinates are rounded to this fraction of a pixel, so that the edge functions are exact in integers."""
EMPTY = 255
"""The id of pixels without a triangle."""
_FAR_PX = 16384.0  # coordinates are clamped to this, which keeps the edge functions within 64 bits


class Raster:
    """Render target: `depth` [m] (h, w) float32 (infinite where empty), `ids` (h, w) uint8 (EMPTY where empty) and `triangles`
    (h, w) int32, the index of the drawn triangle counted over all draws since `clear` (-1 where empty)."""

    def __init__(self, width: int, height: int):
        self.depth = np.empty((height, width), np.float32)
        self.ids = np.empty((height, width), np.uint8)
        self.triangles = np.empty((height, width), np.int32)
        self._drawn = 0
        self.clear()

    def clear(self) -> None:
        self.depth.fill(np.inf)
        self.ids.fill(EMPTY)
        self.triangles.fill(-1)
        self._drawn = 0

    def draw(
        self,
        vertices: NDArray[np.floating[Any]],
        faces: NDArray[np.int32],
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        ids: ArrayLike,
    ) -> None:
        """Draws a mesh: vertices (n, 3) [m] in the camera's frame, faces (m, 3). ids: one id for all faces, or one per face
        (m,)."""
        ids = np.ascontiguousarray(np.broadcast_to(np.asarray(ids, np.uint8), len(faces)))
        vertices = np.ascontiguousarray(vertices, np.float64)
        _draw(vertices, faces, fx, fy, cx, cy, ids, self._drawn, self.depth, self.ids, self.triangles)
        self._drawn += len(faces)


def silhouette(
    vertices: NDArray[np.floating[Any]],
    faces: NDArray[np.int32],
    intrinsics: tuple[float, float, float, float],
    window: tuple[int, int, int, int],
) -> NDArray[np.bool_]:
    """The pixels (h, w) that a mesh covers in a window (x0, y0, w, h) of an image with intrinsics (fx, fy, cx, cy).

    vertices (n, 3) [m] in the camera's frame, faces (m, 3).
    """
    fx, fy, cx, cy = intrinsics
    x0, y0, w, h = window
    out = np.zeros((h, w), np.bool_)
    draw_silhouette(np.ascontiguousarray(vertices, np.float64), faces, fx, fy, cx - x0, cy - y0, out)
    return out


@inner
def _project(x, y, z, fx, fy, cx, cy):  # type: ignore[no-untyped-def]
    """Sub-pixel integer coordinates of a point."""
    u = min(max(fx * x / z + cx, -_FAR_PX), _FAR_PX)
    v = min(max(fy * y / z + cy, -_FAR_PX), _FAR_PX)
    return int(math.floor(u * SUBPIXEL + 0.5)), int(math.floor(v * SUBPIXEL + 0.5))


@inner
def _clip(triangle, clipped):  # type: ignore[no-untyped-def]
    """Cuts a triangle (3, 3) at the near plane into `clipped` (4, 3); returns the number of corners left (0, 3 or 4)."""
    n = 0
    for i in range(3):
        a, b = triangle[i], triangle[(i + 1) % 3]
        if a[2] >= NEAR:
            clipped[n] = a
            n += 1
        if (a[2] >= NEAR) != (b[2] >= NEAR):
            t = (NEAR - a[2]) / (b[2] - a[2])
            for k in range(3):
                clipped[n, k] = a[k] + t * (b[k] - a[k])
            clipped[n, 2] = NEAR
            n += 1
    return n


@inner
def _span(y, ax, ay, bx, by, qx, qy, first, last):  # type: ignore[no-untyped-def]
    """The pixels [first, last] of row y (sub-pixel units) that lie inside the counter-clockwise triangle, top-left rule."""
    for e in range(3):
        if e == 0:
            x0, y0, x1, y1 = ax, ay, bx, by
        elif e == 1:
            x0, y0, x1, y1 = bx, by, qx, qy
        else:
            x0, y0, x1, y1 = qx, qy, ax, ay
        dx, dy = x1 - x0, y1 - y0
        # inside: dx (y - y0) - dy (x - x0) > 0, or = 0 on a top or left edge
        bias = 0 if (dy < 0 or (dy == 0 and dx > 0)) else 1
        c = dx * (y - y0) + dy * x0 - bias
        step = dy * SUBPIXEL
        if dy == 0:
            if c < 0:
                return 1, 0
        elif dy > 0:  # x <= c / step
            last = min(last, c // step)
        else:  # x >= c / step, rounded up
            first = max(first, -(c // -step))
    return first, last


@kernel("f8[n, 3], i4[m, 3], f8, f8, f8, f8, out b1[h, w]")
def draw_silhouette(V, faces, fx, fy, cx, cy, out):  # type: ignore[no-untyped-def]
    """Marks the pixels that a mesh covers in out (h, w), where nothing is marked yet: see `silhouette`."""
    h, w = out.shape
    n = len(V)
    P = np.empty((n, 2), np.int64)
    for i in range(n):
        if V[i, 2] >= NEAR:
            P[i, 0], P[i, 1] = _project(V[i, 0], V[i, 1], V[i, 2], fx, fy, cx, cy)
    triangle, clipped = np.empty((3, 3)), np.empty((4, 3))
    corners = np.empty((4, 2), np.int64)
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        if V[i, 2] >= NEAR and V[j, 2] >= NEAR and V[k, 2] >= NEAR:
            _fill(P[i, 0], P[i, 1], P[j, 0], P[j, 1], P[k, 0], P[k, 1], w, h, out)
            continue
        triangle[0], triangle[1], triangle[2] = V[i], V[j], V[k]
        m = _clip(triangle, clipped)
        for c in range(m):
            corners[c, 0], corners[c, 1] = _project(clipped[c, 0], clipped[c, 1], clipped[c, 2], fx, fy, cx, cy)
        for c in range(2, m):
            _fill(corners[0, 0], corners[0, 1], corners[c - 1, 0], corners[c - 1, 1], corners[c, 0], corners[c, 1], w, h, out)


@inner
def _fill(ax, ay, bx, by, qx, qy, w, h, out):  # type: ignore[no-untyped-def]
    area = (bx - ax) * (qy - ay) - (by - ay) * (qx - ax)
    if area == 0:
        return
    if area < 0:
        bx, by, qx, qy = qx, qy, bx, by
    first_row = max(0, -(-min(ay, by, qy) // SUBPIXEL))
    last_row = min(h - 1, max(ay, by, qy) // SUBPIXEL)
    left = max(0, -(-min(ax, bx, qx) // SUBPIXEL))
    right = min(w - 1, max(ax, bx, qx) // SUBPIXEL)
    for row in range(first_row, last_row + 1):
        first, last = _span(row * SUBPIXEL, ax, ay, bx, by, qx, qy, left, right)
        for x in range(first, last + 1):
            out[row, x] = True


@kernel("f8[n, 3], i4[m, 3], f8, f8, f8, f8, u1[m], i8, out f4[h, w], out u1[h, w], out i4[h, w]")
def _draw(V, faces, fx, fy, cx, cy, ids, start, depth, out_ids, out_triangles):  # type: ignore[no-untyped-def]
    n = len(V)
    P = np.empty((n, 2), np.int64)
    for i in range(n):
        if V[i, 2] >= NEAR:
            P[i, 0], P[i, 1] = _project(V[i, 0], V[i, 1], V[i, 2], fx, fy, cx, cy)
    triangle, clipped = np.empty((3, 3)), np.empty((4, 3))
    corners = np.empty((4, 2), np.int64)
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        if V[i, 2] >= NEAR and V[j, 2] >= NEAR and V[k, 2] >= NEAR:
            _draw_triangle(
                P[i, 0], P[i, 1], V[i, 2], P[j, 0], P[j, 1], V[j, 2], P[k, 0], P[k, 1], V[k, 2],
                ids[f], start + f, depth, out_ids, out_triangles,
            )  # fmt: skip
            continue
        triangle[0], triangle[1], triangle[2] = V[i], V[j], V[k]
        m = _clip(triangle, clipped)
        for c in range(m):
            corners[c, 0], corners[c, 1] = _project(clipped[c, 0], clipped[c, 1], clipped[c, 2], fx, fy, cx, cy)
        for c in range(2, m):
            _draw_triangle(
                corners[0, 0], corners[0, 1], clipped[0, 2],
                corners[c - 1, 0], corners[c - 1, 1], clipped[c - 1, 2],
                corners[c, 0], corners[c, 1], clipped[c, 2],
                ids[f], start + f, depth, out_ids, out_triangles,
            )  # fmt: skip


@inner
def _draw_triangle(ax, ay, az, bx, by, bz, qx, qy, qz, value, index, depth, out_ids, out_triangles):  # type: ignore[no-untyped-def]
    """A triangle of three points in the image (sub-pixel units) with their depths [m]."""
    h, w = depth.shape
    area = (bx - ax) * (qy - ay) - (by - ay) * (qx - ax)
    if area == 0:
        return
    first_row = max(0, -(-min(ay, by, qy) // SUBPIXEL))
    last_row = min(h - 1, max(ay, by, qy) // SUBPIXEL)
    left = max(0, -(-min(ax, bx, qx) // SUBPIXEL))
    right = min(w - 1, max(ax, bx, qx) // SUBPIXEL)
    if first_row > last_row or left > right:
        return
    za, zb, zq = 1.0 / az, 1.0 / bz, 1.0 / qz
    if area < 0:
        bx, by, qx, qy = qx, qy, bx, by
        zb, zq = zq, zb
        area = -area
    # the inverse depth is linear in the image: 1/z = z0 + gx x + gy y
    dxb, dyb, dxq, dyq = bx - ax, by - ay, qx - ax, qy - ay
    gx = ((zb - za) * dyq - (zq - za) * dyb) / area * SUBPIXEL
    gy = ((zq - za) * dxb - (zb - za) * dxq) / area * SUBPIXEL
    z0 = za - gx * ax / SUBPIXEL - gy * ay / SUBPIXEL
    nearest, furthest = max(za, zb, zq), min(za, zb, zq)
    for row in range(first_row, last_row + 1):
        first, last = _span(row * SUBPIXEL, ax, ay, bx, by, qx, qy, left, right)
        for x in range(first, last + 1):
            inverse = min(max(z0 + gx * x + gy * row, furthest), nearest)
            z = np.float32(1.0 / inverse)
            if z < depth[row, x]:
                depth[row, x] = z
                out_ids[row, x] = value
                out_triangles[row, x] = index
