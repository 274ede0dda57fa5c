"""Occluding contour of a mesh, its offsets from the boundary of a mask, and their normal equations in the pose."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from penumbra.services.search.evidence import COVERED, FORESHORTENED, LEAST_KNOWN, TAPS, Evidence, count_compared
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.geometry.raster import draw_silhouette
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import inner, kernel
from penumbra.shared.perception.intrinsics import Intrinsics

NEAR = 0.05
"""Minimum depth [m]: nearer edges are left out."""
BESIDE = 1.5
"""Distance [px] below which the contours of two parts cannot be distinguished in a mask."""
FINE = 2
"""Resolution of the silhouette that separates the outer contour from the inner one, in pixels per pixel of the mask along each
axis: distant fingers are as wide as one pixel of the mask."""
ACROSS = 0.35
"""Distance [px] from the contour, to both sides, at which the silhouette is sampled."""
COLUMN = 8
"""Width [px] of the columns in which neighbouring points are searched for, at least BESIDE."""
APART = 0.01
"""Difference in depth [m] from which two points of the contour belong to two parts."""
SHAPE = 0.006
"""Error of the mesh's cross-section [m]: shorter levers give no information about the roll."""
MOST = 4096
"""Maximum number of points of a contour: more than fit in an image."""
CREASE = 0.8
"""Angle [rad] between two facets above which their edge is a crease of the body, and not a sample of a round surface."""


POINT = np.dtype(
    [
        ("position", "f8", 3),  # X, Y, Z in the camera's frame [m]
        ("pixel", "f8", 2),  # u, v [px]
        ("normal", "f8", 2),  # the contour's outward unit normal in the image
        ("length", "f8"),  # of contour that the point represents [px]
    ]
)
"""A point of a contour."""
Points = NDArray[np.void]
"""An array (n,) of POINT."""


@dataclass(frozen=True)
class Matched:
    """A contour compared with a mask: its `points` (n,), their offsets r (n,) [px] along the outward normal to the mask's
    boundary, and their `kind` (n,) (`_match`); `both`, `free`: see `evidence.compare`."""

    points: Points
    r: Array
    kind: NDArray[np.uint8]
    both: int
    free: int


class Model:
    """A triangle mesh prepared for contours. `edges` (n, 4): two vertices and two faces (-1: none) per edge; `wrist`: x at which
    its hand begins [m], infinite without a hand."""

    def __init__(self, mesh: Mesh):
        self.vertices = np.ascontiguousarray(mesh.vertices, np.float64)
        self.faces = np.ascontiguousarray(mesh.faces, np.int32)
        self.edges = _edges(self.faces)
        in_hand = mesh.vertices[mesh.faces[mesh.labels == Label.HAND], 0]
        self.wrist = float(in_hand.min(initial=math.inf))
        self.closed = bool((self.edges[:, 3] >= 0).all())
        # the output of a pass: of the same size for every pose, so that its kernel's arguments are checked once
        self._memory = np.empty(MOST, POINT), np.empty(MOST), np.empty(MOST, np.uint8), np.empty(2, np.int64)

    def beyond_wrist(self, T: Array, k: Intrinsics, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """The pixels (h, w) beyond the wrist at a pose T_camera_target; none if the limb points at the camera."""
        ends = T[:3, 3] + np.outer([0.0, self.wrist], T[:3, 0]) if math.isfinite(self.wrist) else np.zeros((2, 3))
        if ends[:, 2].min() < NEAR:
            return np.zeros(shape, np.bool_)
        (u0, v0), (u, v) = ends[:, :2] / ends[:, 2:] * (k.fx, k.fy) + (k.cx, k.cy)
        along = np.array([u - u0, v - v0])
        if np.hypot(*along) < FORESHORTENED * k.fx * self.wrist / ends[0, 2]:
            return np.zeros(shape, np.bool_)
        rows, columns = np.arange(shape[0])[:, None], np.arange(shape[1])
        return np.asarray((columns - u) * along[0] + (rows - v) * along[1] > 0.0)

    def in_camera(self, T: Array) -> Array:
        """The vertices (n, 3) [m] in the camera's frame."""
        return rigid.apply(T, self.vertices)

    def silhouette(self, T: Array, k: Intrinsics, window: tuple[int, int, int, int]) -> NDArray[np.bool_]:
        """The silhouette (h, w) in a window (x0, y0, w, h) of the image with intrinsics k."""
        V = self.in_camera(T)
        front = np.empty_like(self.faces)
        return raster.silhouette(V, front[: _front(V, self.faces, self.closed, front)], (k.fx, k.fy, k.cx, k.cy), window)

    def outline(self, V: Array, k: Intrinsics, shape: tuple[int, ...], spacing: float) -> Points:
        """Points (n,) of the outer contour (`_trace`) in a window (h, w) of vertices (n, 3) [m] in the camera's frame."""
        points = np.empty(MOST, POINT)
        intrinsics = np.array([k.fx, k.fy, k.cx, k.cy])
        return points[: _outline(V, self.faces, self.edges, self.closed, intrinsics, *shape, spacing, points)]

    def matched(self, T: Array, evidence: Evidence, spacing: float, reach: float, hand: float = 1.0) -> Matched:
        """The outer contour at a pose T_camera_target, compared with a mask's boundary within `reach` [px]. Beyond the wrist,
        where offsets are `hand` times as uncertain, the length of a point is multiplied by `hand`^-2."""
        V, k = self.in_camera(T), evidence.intrinsics
        found, intrinsics = self._memory, np.array([k.fx, k.fy, k.cx, k.cy])
        mask = evidence.state, evidence.field, evidence.guarded, evidence.known
        n = _matched(V, self.faces, self.edges, self.closed, intrinsics, *mask, spacing, reach, *found)
        points, r, kind, counts = found
        both, free = counts.tolist()
        points = points[:n].copy()
        points["length"][(points["position"] - T[:3, 3]) @ T[:3, 0] > self.wrist] *= hand**-2.0
        return Matched(points, r[:n].copy(), kind[:n].copy(), both, free)


def _edges(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    found: dict[tuple[int, int], list[int]] = {}
    for f, (a, b, c) in enumerate(faces.tolist()):
        for i, j in ((a, b), (b, c), (c, a)):
            found.setdefault((min(i, j), max(i, j)), []).append(f)
    return np.array([(i, j, fs[0], fs[1] if len(fs) > 1 else -1) for (i, j), fs in found.items()], np.int32)


@kernel("f8[v, 3], i4[n, 3], b1, out i4[n, 3] -> i8")
def _front(V, faces, closed, out):
    """Writes the faces that turn their outside to the camera, and returns their number; all of a mesh that is not closed, as the
    far side of one that is adds nothing."""
    n = 0
    if not closed:
        out[:] = faces
        return len(faces)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = V[b, 0] - V[a, 0], V[b, 1] - V[a, 1], V[b, 2] - V[a, 2]
        vx, vy, vz = V[c, 0] - V[a, 0], V[c, 1] - V[a, 1], V[c, 2] - V[a, 2]
        if (uy * vz - uz * vy) * V[a, 0] + (uz * vx - ux * vz) * V[a, 1] + (ux * vy - uy * vx) * V[a, 2] < 0.0:
            out[n] = faces[f]
            n += 1
    return n


@inner
def _lean(V, edge, N, X, Y, Z):
    """How far behind (X, Y, Z) of a silhouette edge, along the line of sight, the round surface is seen edge-on [m].

    A facet's edge turns with the body, the contour of a round limb does not: without this, the roll would be measured on the
    eighteen flat sides of the mesh. Between two facets the normal turns evenly; a crease of the body itself stays where it is.
    """
    i, j, f, g = edge[0], edge[1], edge[2], edge[3]
    turn = math.acos(min(1.0, max(-1.0, N[f, 0] * N[g, 0] + N[f, 1] * N[g, 1] + N[f, 2] * N[g, 2])))
    if turn < 1e-6 or turn > CREASE:
        return 0.0
    nx, ny, nz = N[f, 0] + N[g, 0], N[f, 1] + N[g, 1], N[f, 2] + N[g, 2]
    away = (nx * X + ny * Y + nz * Z) / math.sqrt((nx * nx + ny * ny + nz * nz) * (X * X + Y * Y + Z * Z))
    ex, ey, ez = V[j, 0] - V[i, 0], V[j, 1] - V[i, 1], V[j, 2] - V[i, 2]
    width = (N[f, 3] + N[g, 3]) / (2.0 * math.sqrt(ex * ex + ey * ey + ez * ez))  # mean height of the two facets above the edge
    return -math.asin(away) / turn * width


@inner
def _contour(V, faces, front, edges, k, h, w, spacing, points):
    """Writes the points (m,) of the outer contour in a window (h, w), as many as there is room for, and returns their number.
    front (n, 3): of the faces (f, 3), those that may be seen."""
    fx, fy, cx, cy = k
    left, right, top, bottom = math.inf, -math.inf, math.inf, -math.inf
    for i in range(len(V)):
        if V[i, 2] < NEAR:
            return 0
        u, v = fx * V[i, 0] / V[i, 2] + cx, fy * V[i, 1] / V[i, 2] + cy
        left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    x0, y0 = max(int(max(left, -4.0)) - 2, 0), max(int(max(top, -4.0)) - 2, 0)
    x1, y1 = int(min(right, float(w))) + 3, int(min(bottom, float(h))) + 3
    x1, y1 = min(x1, w), min(y1, h)
    if x1 <= x0 or y1 <= y0:
        return 0
    fine = np.zeros(((y1 - y0) * FINE, (x1 - x0) * FINE), np.bool_)
    half = (FINE - 1) / 2.0
    draw_silhouette(V, front, fx * FINE, fy * FINE, (cx - x0) * FINE + half, (cy - y0) * FINE + half, fine)
    return _trace(V, faces, edges, fx, fy, cx, cy, fine, x0, y0, w, h, spacing, points)


@kernel("f8[v, 3], i4[n, 3], i4[e, 4], b1, f8[4], i8, i8, f8, out POINT[m] -> i8", POINT=POINT)
def _outline(V, faces, edges, closed, k, h, w, spacing, points):
    """See `Model.outline`."""
    front = np.empty_like(faces)
    front = front[: _front(V, faces, closed, front)]
    return _contour(V, faces, front, edges, (k[0], k[1], k[2], k[3]), h, w, spacing, points)


@kernel(
    """f8[v, 3], i4[n, 3], i4[e, 4], b1, f8[4], u1[h, w], f4[h, w], u1[h, w], f4[a, b], f8, f8,
    out POINT[m], out f8[m], out u1[m], out i8[2] -> i8""",
    POINT=POINT,
)
def _matched(V, faces, edges, closed, k, state, field, guarded, known, spacing, reach, points, r, kind, counts):
    """A pass of a search over a mask: silhouette, contour and offsets in one call. Writes and returns what `Matched` holds."""
    h, w = state.shape
    front = np.empty_like(faces)
    front = front[: _front(V, faces, closed, front)]
    shown = np.zeros((h, w), np.bool_)
    draw_silhouette(V, front, k[0], k[1], k[2], k[3], shown)
    count_compared(state, shown, counts)
    n = _contour(V, faces, front, edges, (k[0], k[1], k[2], k[3]), h, w, spacing, points)
    _match(points[:n], field, guarded, shown, state, known, reach, r[:n], kind[:n])
    return n


@kernel("f8[v, 3], i4[n, 3], i4[e, 4], f8, f8, f8, f8, b1[a, b], i8, i8, i8, i8, f8, out POINT[m] -> i8", POINT=POINT)
def _trace(V, faces, edges, fx, fy, cx, cy, fine, x0, y0, w, h, spacing, points):
    """Writes points (m,) of the outer occluding contour, as many as there is room for, and returns their number. V (v, 3) [m];
    fine (a, b): silhouette of the same pose with FINE x FINE pixels on each of the window's, from pixel (x0, y0) on; w, h: size
    of the window.

    Where two parts (thumb and palm) end within BESIDE of one another, the points are left out: the smallest motion decides which
    of the two is the contour, so that neither predicts how it moves.
    """
    n_faces, n_vertices = len(faces), len(V)
    N = np.empty((n_faces, 4))  # unit normal and twice the area
    front = np.empty(n_faces, np.bool_)
    for f in range(n_faces):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = V[b, 0] - V[a, 0], V[b, 1] - V[a, 1], V[b, 2] - V[a, 2]
        vx, vy, vz = V[c, 0] - V[a, 0], V[c, 1] - V[a, 1], V[c, 2] - V[a, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        size = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-30
        N[f, 0], N[f, 1], N[f, 2], N[f, 3] = nx / size, ny / size, nz / size, size
        front[f] = nx * V[a, 0] + ny * V[a, 1] + nz * V[a, 2] < 0.0
    P = np.empty((n_vertices, 2))
    for i in range(n_vertices):
        z = max(V[i, 2], 1e-9)
        P[i, 0] = fx * V[i, 0] / z + cx
        P[i, 1] = fy * V[i, 1] / z + cy
    out = np.empty_like(points)
    outer = np.empty(len(points), np.bool_)
    n = 0
    for e in range(len(edges)):
        i, j, f, g = edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3]
        if (g >= 0 and front[f] == front[g]) or V[i, 2] < NEAR or V[j, 2] < NEAR:
            continue
        seen = f if (g < 0 or front[f]) else g
        dx, dy = P[j, 0] - P[i, 0], P[j, 1] - P[i, 1]
        length = math.sqrt(dx * dx + dy * dy)
        if length < 1e-6:
            continue
        nx, ny = dy / length, -dx / length
        k = faces[seen, 0] + faces[seen, 1] + faces[seen, 2] - i - j  # the face's third vertex lies inside
        if nx * (P[k, 0] - P[i, 0]) + ny * (P[k, 1] - P[i, 1]) > 0.0:
            nx, ny = -nx, -ny
        count = max(1, int(length / spacing + 0.5))
        for m in range(count):
            s = (m + 0.5) / count
            u, v = P[i, 0] + s * dx, P[i, 1] + s * dy
            if not (0 <= u < w - 1 and 0 <= v < h - 1) or n == len(out):
                continue
            outer[n] = not _lookup(fine, u + ACROSS * nx - x0, v + ACROSS * ny - y0)
            outer[n] = outer[n] and _lookup(fine, u - ACROSS * nx - x0, v - ACROSS * ny - y0)
            # the point of the edge in space that projects to (u, v): linear in the inverse depth
            z = 1.0 / ((1.0 - s) / V[i, 2] + s / V[j, 2])
            x, y = (u - cx) / fx * z, (v - cy) / fy * z
            if g >= 0:
                scale = 1.0 + _lean(V, edges[e], N, x, y, z) / math.sqrt(x * x + y * y + z * z)
                x, y, z = x * scale, y * scale, z * scale
            point = out[n]
            point.position[0], point.position[1], point.position[2] = x, y, z
            point.pixel[0], point.pixel[1] = u, v
            point.normal[0], point.normal[1] = nx, ny
            point.length = length / count
            n += 1
    # chains of points by column, so that each is compared with its neighbours only
    columns = w // COLUMN + 1
    last, previous = np.full(columns, -1), np.empty(n, np.int64)
    for i in range(n):
        c = min(max(int(out[i].pixel[0]) // COLUMN, 0), columns - 1)
        previous[i], last[c] = last[c], i
    kept = 0
    for i in range(n):
        if outer[i] and not _beside(out, i, last, previous):
            points[kept] = out[i]
            kept += 1
    return kept


@inner
def _lookup(fine, u, v):
    """Whether a silhouette of FINE times the resolution covers the point (u, v)."""
    x, y = int(math.floor((u + 0.5) * FINE)), int(math.floor((v + 0.5) * FINE))
    return 0 <= x < fine.shape[1] and 0 <= y < fine.shape[0] and fine[y, x]


@inner
def _beside(points, i, last, previous):
    """Whether another part's contour runs along point i."""
    point = points[i]
    u, v, nx, ny, z = point.pixel[0], point.pixel[1], point.normal[0], point.normal[1], point.position[2]
    column = min(max(int(u) // COLUMN, 0), len(last) - 1)
    for c in range(max(column - 1, 0), min(column + 2, len(last))):
        k = last[c]
        while k >= 0:
            other = points[k]
            du, dv = other.pixel[0] - u, other.pixel[1] - v
            alike = other.normal[0] * nx + other.normal[1] * ny
            if abs(other.position[2] - z) >= APART and max(abs(du), abs(dv)) <= BESIDE and alike > 0.5:
                return True
            k = previous[k]
    return False


@inner
def _bilinear(image, u, v):
    h, w = image.shape
    x, y = int(math.floor(u)), int(math.floor(v))
    if x < 0 or y < 0 or x >= w - 1 or y >= h - 1:
        return -1.0
    a, b = u - x, v - y
    top = image[y, x] * (1.0 - a) + image[y, x + 1] * a
    bottom = image[y + 1, x] * (1.0 - a) + image[y + 1, x + 1] * a
    return top * (1.0 - b) + bottom * b


@inner
def _nearest(image, u, v):
    """The pixel's value; 255 outside."""
    x, y = int(math.floor(u + 0.5)), int(math.floor(v + 0.5))
    if x < 0 or y < 0 or x >= image.shape[1] or y >= image.shape[0]:
        return 255
    return image[y, x]


LEVELS = (0.2, 0.7)
"""Minimum and maximum value of a field that counts as its boundary."""
DROPPED, MEASURED, BOUNDED = 0, 1, 2
"""Kind of a contour point. BOUNDED: something covers the view before the boundary, or no boundary is within reach, so the contour
has to move at least that far."""


@inner
def _field_of(shown, state, known, u, v):
    """The value at (u, v), between the pixels of the window, of the field of a mask that shows what a silhouette (h, w) shows
    where something is known: as `evidence.gather` would smooth it, but of four pixels only."""
    h, w = state.shape
    x, y, most = int(math.floor(u)), int(math.floor(v)), len(TAPS) // 2
    corner00, corner01, corner10, corner11 = 0.0, 0.0, 0.0, 0.0
    for i in range(-most, most + 2):
        row = min(max(y + i, 0), h - 1)
        left, right = 0.0, 0.0
        for j in range(-most, most + 2):
            column = min(max(x + j, 0), w - 1)
            if shown[row, column] and state[row, column] != COVERED:
                left += TAPS[j + most] if j <= most else 0.0
                right += TAPS[j + most - 1] if j > -most else 0.0
        if i <= most:
            corner00 += TAPS[i + most] * left
            corner01 += TAPS[i + most] * right
        if i > -most:
            corner10 += TAPS[i + most - 1] * left
            corner11 += TAPS[i + most - 1] * right
    if known.size:
        corner00 = corner00 / known[y, x] if known[y, x] > LEAST_KNOWN else 0.0
        corner01 = corner01 / known[y, x + 1] if known[y, x + 1] > LEAST_KNOWN else 0.0
        corner10 = corner10 / known[y + 1, x] if known[y + 1, x] > LEAST_KNOWN else 0.0
        corner11 = corner11 / known[y + 1, x + 1] if known[y + 1, x + 1] > LEAST_KNOWN else 0.0
    a, b = u - x, v - y
    return (corner00 * (1.0 - a) + corner01 * a) * (1.0 - b) + (corner10 * (1.0 - a) + corner11 * a) * b


@inner
def _match(points, field, guarded, shown, state, known, reach, r, kind):
    """Writes the offsets r (n,) [px] along the outward normal from each contour point to the mask's boundary, and their kinds
    (n,).

    The boundary is where the mask's `field` (h, w) has the value that the silhouette's own has on the contour: half on a straight
    one, less on a finger's, which blurring makes smaller.
    """
    for i in range(len(points)):
        point = points[i]
        u, v, nx, ny = point.pixel[0], point.pixel[1], point.normal[0], point.normal[1]
        r[i], kind[i] = 0.0, DROPPED
        before = _bilinear(field, u, v)
        if before < 0.0 or _nearest(guarded, u, v) != 0:
            continue
        level = min(max(_field_of(shown, state, known, u, v), LEVELS[0]), LEVELS[1])
        way = 1.0 if before >= level else -1.0  # inside the mask: the boundary lies outwards
        r[i] = way * reach  # where no boundary is in reach: at least so far
        kind[i] = BOUNDED
        for step in range(1, int(reach) + 1):
            t = way * step
            pu, pv = u + t * nx, v + t * ny
            value = _bilinear(field, pu, pv)
            if value < 0.0 or _nearest(guarded, pu, pv) != 0:
                r[i] = t
                if step <= 2:
                    kind[i] = DROPPED
                break
            if (value < level) == (way > 0.0):
                r[i] = t - way * (value - level) / (value - before)
                kind[i] = MEASURED
                break
            before = value


def slow_waves(points: Points, T: Array) -> list[Array]:
    """Slowly varying error shapes (n,) of the contour of a limb at T_camera_target (4, 4): per side, linear and quadratic along
    the limb."""
    along = (points["position"] - T[:3, 3]) @ T[:3, 0]
    s = 2.0 * (along - along.min(initial=0.0)) / max(float(np.ptp(along)) if len(along) else 0.0, 1e-6) - 1.0
    return [np.where(side, shape, 0.0) for side in sides(points, T) for shape in (s, 1.5 * s**2 - 0.5)]


def sides(points: Points, T: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which points of a contour (n,) are on one side and on the other side of a limb at T_camera_target (4, 4) in the image."""
    across = points["normal"][:, 0] * T[1, 0] - points["normal"][:, 1] * T[0, 0] > 0.0
    return ~across, across


def stretched(points: Points, T: Array, k: Intrinsics) -> tuple[Array, Array]:
    """Displacements (n,) [px] of the contour of a limb at T_camera_target (4, 4) along its normals, per unit of log length and of
    log girth."""
    axis, from_middle = T[:3, 0], points["position"] - T[:3, 3]
    along = np.outer(from_middle @ axis, axis)
    x, y, z = points["position"].T
    nx, ny = points["normal"][:, 0] * k.fx, points["normal"][:, 1] * k.fy
    moves = np.stack([nx / z, ny / z, -(nx * x + ny * y) / z**2], axis=1)
    return np.sum(moves * along, axis=1), np.sum(moves * (from_middle - along), axis=1)


class Equations(NamedTuple):
    """Normal equations for the pose error along the camera's axes and the mask's dilation, from a contour's offsets.

    H (7, 7) : information. g (7,) : its right side. length : of the measured contour [px]. square : sum of length times squared
    offset, limited by `huber` [px^3]. counted : length that enters the cost [px]. cost : Huber's cost (chi^2 if all offsets are
    within `huber`). rolls : share of the information about the roll that comes from levers longer than SHAPE.
    """

    H: Array
    g: Array
    length: float
    square: float
    counted: float
    cost: float
    rolls: float


def normal_equations(
    points: Points,
    r: Array,
    kind: NDArray[np.uint8],
    weights: Array,
    origin: Array,
    axis: Array,
    fx: float,
    fy: float,
    huber: float,
    bounded: bool,
) -> Equations:
    """Normal equations from the offsets r (n,) [px] of contour points (n,) and their kinds (n,) (`_match`).

    `weights` (n,) [1/px^2] of the points; `origin` (3,) [m] and `axis` (3,) of the target; `bounded`: whether BOUNDED points
    enter the normal equations, and not only the cost.
    """
    H, g, sums = np.zeros((7, 7)), np.zeros(7), np.empty(5)
    origin, axis = np.ascontiguousarray(origin), np.ascontiguousarray(axis)
    _normal_equations(points, r, kind, weights, origin, axis, fx, fy, huber, bounded, H, g, sums)
    return Equations(H, g, *sums.tolist())


@kernel("POINT[n], f8[n], u1[n], f8[n], f8[3], f8[3], f8, f8, f8, b1, out f8[7, 7], out f8[7], out f8[5]", POINT=POINT)
def _normal_equations(points, r, kind, weights, origin, axis, fx, fy, huber, bounded, H, g, sums):
    """Adds to H and g, and writes the five numbers after them: see `normal_equations`."""
    J = np.empty(7)
    length, square, counted, cost = 0.0, 0.0, 0.0, 0.0
    rolls, long_rolls = 1e-12, 0.0
    for i in range(len(points)):
        if kind[i] == DROPPED:
            continue
        point = points[i]
        X, Y, Z, nx, ny = point.position[0], point.position[1], point.position[2], point.normal[0], point.normal[1]
        # motion of the contour along its normal by a motion of its point: n' d(projection)/dX
        J[0] = nx * fx / Z
        J[1] = ny * fy / Z
        J[2] = -(nx * fx * X + ny * fy * Y) / (Z * Z)
        x, y, z = X - origin[0], Y - origin[1], Z - origin[2]
        J[3] = J[2] * y - J[1] * z  # rotation vector w moves the point by w x (X - origin)
        J[4] = J[0] * z - J[2] * x
        J[5] = J[1] * x - J[0] * y
        J[6] = 1.0
        if kind[i] == MEASURED:
            length += point.length
            square += point.length * min(r[i] * r[i], huber * huber)
        weight = weights[i]
        counted += point.length
        if abs(r[i]) <= huber:
            cost += weight * r[i] * r[i]
        else:
            cost += weight * huber * (2.0 * abs(r[i]) - huber)
            weight *= huber / abs(r[i])
        if kind[i] == BOUNDED and not bounded:
            continue
        roll = abs(J[3] * axis[0] + J[4] * axis[1] + J[5] * axis[2])
        rolls += weight * roll * roll
        long_rolls += weight * max(roll - SHAPE * fx / Z, 0.0) ** 2
        for a in range(7):
            g[a] += weight * J[a] * r[i]
            for b in range(7):
                H[a, b] += weight * J[a] * J[b]
    sums[0], sums[1], sums[2], sums[3], sums[4] = length, square, counted, cost, long_rolls / rolls
