"""Compares the colours of a mesh, of its texture or its vertices, with those of the picture inside its silhouette.

Points spread evenly over the surface have the mesh's colours, smoothed as far as their neighbours (`painted`). At a pose, the
visible points are compared with the picture, which is smoothed by the same amount. Both are logarithms, so that light is an
offset: each channel of the picture is fitted by a multiple of the mesh's colour, the direction of the surface (shading) and an
offset (`compared`).

The comparison has two uses. The derivative of the colour differences by the pose gives least squares (`information`), as in
photometric tracking (Lucas, Kanade 1981). How much better the mesh's colours explain the picture than shading alone is the
likelihood that the texture is there, relative to any other (`score`); an occluder makes it wrong only where it hides the object.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from penumbra.services.search.contour import Model
from penumbra.services.search.objects.creases import BEHIND
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.geometry import raster
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import inner, kernel
from penumbra.shared.perception.intrinsics import Intrinsics

Floats = NDArray[np.float32]

CLOUD = 24_000
"""Number of points of the surface at which colours are read from a mesh's file."""
POINTS = (1200, 4000)
"""Number of points that are compared, in the smallest picture and in larger ones: half of them are visible, 2 to 4 px apart."""
SPREAD = 0.6
"""Standard deviation of the smoothing of colours, in distances between points."""
LEAST_CONTRAST = 0.05
"""Standard deviation of a mesh's colours (logarithm) below which it counts as of one colour and gives no information."""
DARK = 16.0
"""Added to a colour of 0 to 255 before the logarithm: darker colours are noise and reflections."""
SIGMA = 0.15
"""Minimum standard deviation of the picture's colours (logarithm) from those that the mesh explains: highlights, shadows, prints
that differ."""
GAIN = 1.6
"""Maximum contrast of the picture relative to the mesh's; the minimum is zero: textures are scanned in other light, and fade."""
GRAZING = 0.2
"""Minimum cosine of the angle between a surface's normal and the line of sight: flatter surfaces show nothing."""
EDGE = 2.0
"""Distance from the silhouette's edge within which nothing is compared, in standard deviations of the smoothing."""
LEAST_SEEN = 1e-3
"""Share of the points' weight that is added to the normal equations of the light, for directions that no visible surface has."""
FEWEST = 40
"""Minimum number of points that are compared."""
ROBUST = 0.4
"""Difference of colours (logarithm) beyond which a point's weight decreases: something hides it."""
FITS = 2
"""Number of fits of the light, each with weights from the one before."""
HIDDEN = 0.05
"""Minimum likelihood of a point's colour, relative to that of any: it may be hidden."""
PATCH = 20.0
"""Number of points whose colour differences share their error: smoothing joins 4 or 5 of them (4 pi SPREAD^2); highlights,
shadows and errors of the texture's place join more."""


@dataclass(frozen=True)
class Cloud:
    """Points (n, 3) [m] of a mesh's surface with the colours (n, 3) 0 to 255 RGB that its file gives them."""

    points: Array
    colours: Array


@dataclass(frozen=True)
class Paint:
    """Points (n, 3) [m] of a surface, their outward normals (n, 3) and colours (n, 3): logarithms smoothed by `spread` [m]."""

    points: Array
    normals: Array
    colours: Array
    spread: float


def cloud(mesh: Any) -> Cloud | None:
    """The coloured points of a trimesh.Trimesh; None if it has no colours."""
    visual, faces = mesh.visual, np.asarray(mesh.faces)
    vertices = np.asarray(mesh.vertices, np.float64)
    points, face, weights = spread_over(vertices, faces, CLOUD)
    if visual.kind == "vertex":
        colours = np.einsum("nc,ncd->nd", weights, np.asarray(visual.vertex_colors, np.float64)[faces[face], :3])
    elif visual.kind == "face":
        colours = np.asarray(visual.face_colors, np.float64)[face, :3]
    elif visual.kind == "texture" and visual.uv is not None and (image := _image(visual.material)) is not None:
        at = np.einsum("nc,ncd->nd", weights, np.asarray(visual.uv, np.float64)[faces[face]])
        u, v = np.where((at < 0.0) | (at > 1.0), at % 1.0, at).T  # it repeats; v points up
        h, w = image.shape[:2]
        colours = image[np.minimum((1.0 - v) * h, h - 1).astype(int), np.minimum(u * w, w - 1).astype(int)].astype(np.float64)
    else:
        return None
    return Cloud(points, colours)


def _image(material: Any) -> NDArray[np.uint8] | None:
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    return None if image is None else np.asarray(image.convert("RGB"))


def spread_over(vertices: Array, faces: NDArray[np.integer[Any]], count: int) -> tuple[Array, NDArray[np.int64], Array]:
    """Points (count, 3) spread evenly over a mesh, with the face (count,) and the weights (count, 3) of its corners per point."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    ends = np.cumsum(area)
    i = np.arange(count)
    face = np.minimum(np.searchsorted(ends, (i + 0.5) / count * ends[-1]), len(faces) - 1)
    a, b = (i * 0.7548776662466927) % 1.0, (i * 0.5698402909980532) % 1.0  # the R2 sequence is even in a square
    over = a + b > 1.0
    a, b = np.where(over, 1.0 - a, a), np.where(over, 1.0 - b, b)
    weights = np.stack([1.0 - a - b, a, b], axis=1)
    return np.einsum("nc,ncd->nd", weights, corners[face]), face, weights


def painted(mesh: Mesh, found: Cloud) -> tuple[Paint, Paint] | None:
    """The points of a mesh whose faces are turned outwards, for each of POINTS; None if it is of one colour."""
    tree = cKDTree(found.points)
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = float(np.linalg.norm(normal, axis=1).sum()) / 2.0
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
    out = []
    for count in POINTS:
        points, face, _ = spread_over(mesh.vertices, mesh.faces, count)
        spread = SPREAD * math.sqrt(area / count)
        # as many neighbours as lie within two standard deviations
        distance, near = tree.query(points, max(1, round(len(found.points) * math.pi * (2.0 * spread) ** 2 / area)))
        distance, near = distance.reshape(count, -1), near.reshape(count, -1)
        weights = np.exp(-0.5 * np.square((distance - distance[:, :1]) / spread))
        mean = np.einsum("nk,nkc->nc", weights / weights.sum(axis=1, keepdims=True), found.colours[near])
        out.append(Paint(points, normal[face], np.log(mean + DARK), spread))
    return None if out[0].colours.std(axis=0).max() < LEAST_CONTRAST else (out[0], out[1])


def smoothed(image: NDArray[np.uint8], sigma: float) -> Floats:
    """The logarithm of a picture (h, w, 3) smoothed by sigma [px]."""
    if sigma > 0.3:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)
    return np.log(np.arange(256, dtype=np.float32) + np.float32(DARK))[image]


@dataclass(frozen=True)
class Painted:
    """The paint of a mesh; the smoothed picture (h, w, 3) with intrinsics k with which it is compared; and `guarded` (h, w),
    where something covers the picture."""

    paint: Paint
    picture: Floats
    guarded: NDArray[np.uint8]
    k: Intrinsics


@dataclass(frozen=True)
class Compared:
    """The points (n,) that are visible at a pose T: `position` and `normal` (n, 3) in the camera's frame, `colours` (n, 3) of the
    mesh, `gradient` (n, 3, 2) of the picture by the direction of the line of sight, the residuals of the picture's colours `left`
    (n, 3) by the mesh's colours and `plain` (n, 3) by shading alone, and the `share` (n,) of an independent patch that each point
    represents."""

    T: Array
    position: Array
    normal: Array
    colours: Array
    gradient: Array
    left: Array
    plain: Array
    share: Array

    @property
    def score(self) -> float:
        """Log-likelihood of the mesh's colours relative to any others, over all patches."""
        return float(_score(self.left, self.plain, self.share, SIGMA, ROBUST, HIDDEN))

    @property
    def information(self) -> tuple[Array, Array]:
        """The information (6, 6) about the pose error at T [m, rad] and its right side (6,), with the light marginalised."""
        H, g, origin = np.empty((6, 6)), np.empty(6), np.ascontiguousarray(self.T[:3, 3])
        basis = self.position, self.normal, self.colours
        _information(*basis, self.gradient, self.left, self.share, origin, SIGMA, ROBUST, LEAST_SEEN, H, g)
        return H, g


def compared(at: Painted, model: Model, T: Array) -> Compared | None:
    """Compares the colours of mesh and picture at a pose T_camera_object; the model gives the visible points. None if too few."""
    paint, k = at.paint, at.k
    P, N = paint.points @ T[:3, :3].T + T[:3, 3], paint.normals @ T[:3, :3].T
    h, w = at.guarded.shape
    surface = raster.Raster(w, h)
    surface.draw(model.in_camera(T), model.faces, k.fx, k.fy, k.cx, k.cy, 0)
    # near the contour the smoothed picture shows the surroundings, too
    r = max(round(EDGE * paint.spread * k.fx / max(T[2, 3], raster.NEAR)), 1)
    near = cv2.dilate((surface.ids == raster.EMPTY).view(np.uint8), np.ones((2 * r + 1, 2 * r + 1), np.uint8))
    unknown = np.asarray(near, np.uint8) | at.guarded
    n = len(P)
    index, gradient = np.empty(n, np.int64), np.empty((n, 3, 2))
    left, plain, share = np.empty((n, 3)), np.empty((n, 3)), np.empty(n)
    four = np.array([k.fx, k.fy, k.cx, k.cy])
    n = _sampled(P, N, at.picture, surface.depth, unknown, four, BEHIND, GRAZING, PATCH, index, plain, gradient, share)
    if n < FEWEST:
        return None
    index = index[:n]
    P, N, C = P[index], N[index], paint.colours[index]
    left, plain, gradient, share = left[:n], plain[:n], gradient[:n], share[:n]
    _fit(N, C, share, ROBUST, FITS, GAIN, LEAST_SEEN, plain, left)
    return Compared(T, P, N, C, gradient, left, plain, share)


@kernel(
    """f8[n, 3], f8[n, 3], f4[h, w, 3], f4[h, w], u1[h, w], f8[4], f8, f8, f8,
    out i8[n], out f8[n, 3], out f8[n, 3, 2], out f8[n] -> i8"""
)
def _sampled(P, N, image, depth, unknown, k, behind, grazing, patch, index, value, gradient, share):
    """Writes of the points P (n, 3) with normals N, in the camera's frame, which are seen, the picture's colours there, how they
    change with the line of sight, and the share of a patch; returns how many."""
    h, w = depth.shape
    n = 0
    for i in range(len(P)):
        x, y, z = P[i, 0], P[i, 1], P[i, 2]
        if z <= 0.0:
            continue
        facing = -(N[i, 0] * x + N[i, 1] * y + N[i, 2] * z) / math.sqrt(x * x + y * y + z * z)
        if facing < grazing:
            continue
        u, v = k[0] * x / z + k[2], k[1] * y / z + k[3]
        c, r = int(math.floor(u)), int(math.floor(v))
        if c < 1 or r < 1 or c >= w - 2 or r >= h - 2:
            continue
        near_c, near_r = int(u + 0.5), int(v + 0.5)
        if unknown[near_r, near_c] != 0 or z > depth[near_r, near_c] + behind:
            continue
        a, b = u - c, v - r
        for d in range(3):
            i00, i01, i10, i11 = image[r, c, d], image[r, c + 1, d], image[r + 1, c, d], image[r + 1, c + 1, d]
            value[n, d] = (1.0 - b) * ((1.0 - a) * i00 + a * i01) + b * ((1.0 - a) * i10 + a * i11)
            left, right = (1.0 - b) * i00 + b * i10, (1.0 - b) * i01 + b * i11
            before = (1.0 - b) * image[r, c - 1, d] + b * image[r + 1, c - 1, d]
            behind_right = (1.0 - b) * image[r, c + 2, d] + b * image[r + 1, c + 2, d]
            gradient[n, d, 0] = 0.5 * k[0] * ((1.0 - a) * (right - before) + a * (behind_right - left))
            top, bottom = (1.0 - a) * i00 + a * i01, (1.0 - a) * i10 + a * i11
            above = (1.0 - a) * image[r - 1, c, d] + a * image[r - 1, c + 1, d]
            below = (1.0 - a) * image[r + 2, c, d] + a * image[r + 2, c + 1, d]
            gradient[n, d, 1] = 0.5 * k[1] * ((1.0 - b) * (bottom - above) + b * (below - top))
        index[n], share[n] = i, facing / patch
        n += 1
    return n


@inner
def _solve(A, B):
    """Replaces B (n, m) by A^-1 B, A (n, n) symmetric and positive; A is overwritten."""
    n, m = B.shape
    for i in range(n):
        for j in range(i + 1, n):
            f = A[j, i] / A[i, i]
            for c in range(i, n):
                A[j, c] -= f * A[i, c]
            for c in range(m):
                B[j, c] -= f * B[i, c]
    for i in range(n - 1, -1, -1):
        for c in range(m):
            for j in range(i + 1, n):
                B[i, c] -= A[i, j] * B[j, c]
            B[i, c] /= A[i, i]


@inner
def _trusted(left, robust):
    """The weight of a point that is off: Cauchy's, for what hides a part."""
    return 1.0 / (1.0 + left * left / (robust * robust))


@inner
def _variance(left, share, d, robust):
    """Of what is left of the picture in a channel d, of the points that are trusted."""
    square, trust = 0.0, 0.0
    for i in range(len(left)):
        weight = share[i] * _trusted(left[i, d], robust)
        square += weight * left[i, d] * left[i, d]
        trust += weight
    return square / trust


@kernel("f8[n, 3], f8[n, 3], f8[n], f8, i8, f8, f8, out f8[n, 3], out f8[n, 3]")
def _fit(N, C, share, robust, fits, largest, least, plain, left):
    """Replaces the picture's colours `plain` (n, 3) by what shading leaves of them, and writes what the mesh's colours C (n, 3)
    leave of those."""
    A, B, x = np.empty((4, 4)), np.empty((4, 2)), np.ones(4)
    own, weight = np.empty(len(N)), np.empty(len(N))
    for d in range(3):
        left[:, d] = 0.0
        for _ in range(fits):
            A[:], B[:], total = 0.0, 0.0, 0.0
            for i in range(len(N)):
                weight[i] = share[i] * _trusted(left[i, d], robust)
                total += weight[i]
                x[1], x[2], x[3] = N[i, 0], N[i, 1], N[i, 2]
                for r in range(4):
                    for c in range(4):
                        A[r, c] += weight[i] * x[r] * x[c]
                    B[r, 0] += weight[i] * x[r] * plain[i, d]
                    B[r, 1] += weight[i] * x[r] * C[i, d]
            for r in range(4):
                A[r, r] += least * total
            _solve(A, B)
            both, square = 0.0, 1e-6
            for i in range(len(N)):
                plain[i, d] -= B[0, 0] + B[1, 0] * N[i, 0] + B[2, 0] * N[i, 1] + B[3, 0] * N[i, 2]
                own[i] = C[i, d] - (B[0, 1] + B[1, 1] * N[i, 0] + B[2, 1] * N[i, 1] + B[3, 1] * N[i, 2])
                both += weight[i] * plain[i, d] * own[i]
                square += weight[i] * own[i] * own[i]
            gain = min(max(both / square, 0.0), largest)
            for i in range(len(N)):
                left[i, d] = plain[i, d] - gain * own[i]


@kernel("f8[n, 3], f8[n, 3], f8[n], f8, f8, f8 -> f8")
def _score(left, plain, share, sigma, robust, hidden):
    """See `Compared.score`."""
    better = np.zeros(len(left))
    for d in range(3):
        usual, total = 0.0, 0.0
        for i in range(len(left)):
            usual += share[i] * plain[i, d] * plain[i, d]
            total += share[i]
        usual = usual / total + 1e-9
        variance = min(max(_variance(left, share, d, robust), sigma * sigma), usual)
        for i in range(len(left)):
            of_any, of_mesh = plain[i, d] * plain[i, d] / usual, left[i, d] * left[i, d] / variance
            better[i] += (of_any - of_mesh + math.log(usual / variance)) / 6.0  # the mean of three channels
    total = 0.0
    for i in range(len(left)):
        total += share[i] * math.log((1.0 - hidden) * math.exp(min(better[i], 30.0)) + hidden)
    return total


@kernel("f8[n, 3], f8[n, 3], f8[n, 3], f8[n, 3, 2], f8[n, 3], f8[n], f8[3], f8, f8, f8, out f8[6, 6], out f8[6]")
def _information(P, N, C, gradient, left, share, origin, sigma, robust, least, H, g):
    """See `Compared.information`: least squares of the pose without (Schur complement) what shading and gain explain."""
    H[:], g[:] = 0.0, 0.0
    A, B, other, x, J = np.empty((5, 5)), np.empty((5, 7)), np.empty((5, 7)), np.ones(5), np.empty(7)
    for d in range(3):
        A[:], B[:], total = 0.0, 0.0, 0.0
        variance = max(_variance(left, share, d, robust), sigma * sigma)
        for i in range(len(P)):
            weight = share[i] * _trusted(left[i, d], robust) / (3.0 * variance)
            total += weight
            X, Y, Z = P[i, 0], P[i, 1], P[i, 2]
            J[0], J[1] = gradient[i, d, 0] / Z, gradient[i, d, 1] / Z
            J[2] = -(J[0] * X + J[1] * Y) / Z
            X, Y, Z = X - origin[0], Y - origin[1], Z - origin[2]
            # a rotation vector w moves the point by w x (X - origin)
            J[3], J[4], J[5] = Y * J[2] - Z * J[1], Z * J[0] - X * J[2], X * J[1] - Y * J[0]
            J[6] = -left[i, d]
            x[1], x[2], x[3], x[4] = N[i, 0], N[i, 1], N[i, 2], C[i, d]
            for r in range(5):
                for c in range(5):
                    A[r, c] += weight * x[r] * x[c]
                for c in range(7):
                    B[r, c] += weight * x[r] * J[c]
            for r in range(6):
                for c in range(6):
                    H[r, c] += weight * J[r] * J[c]
                g[r] += weight * J[r] * J[6]
        for r in range(5):
            A[r, r] += least * total
        other[:] = B
        _solve(A, B)
        for r in range(6):
            for e in range(5):
                for c in range(6):
                    H[r, c] -= other[e, r] * B[e, c]
                g[r] -= other[e, r] * B[e, 6]
