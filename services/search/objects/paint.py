"""The colours of a mesh against those of the picture inside its silhouette, where the mesh has a texture or coloured vertices.

Points spread evenly over the surface carry the mesh's colours, smoothed as far as their neighbours (`painted`). At a pose, those that
the camera sees are compared with the picture, which is smoothed as much. Both are logarithms, so that light is an offset: each channel
of the picture is fitted by a multiple of the mesh's colour, the direction of the surface (shading) and an offset (`compared`).

That says two things. How the offsets between the colours change with the pose gives least squares (`information`), as photometric
tracking does (Lucas, Kanade 1981). How much better the mesh's colours explain the picture than shading alone is the likelihood of the
texture's being there against that of any other (`score`); what hides a part makes it wrong only there.
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
from penumbra.shared.native import kernel
from penumbra.shared.perception.intrinsics import Intrinsics

Floats = NDArray[np.float32]

CLOUD = 24_000
"""Number of points of the surface whose colours are read from a mesh's file."""
POINTS = (1200, 4000)
"""Number of points that are compared, in the smallest picture and in larger ones: half of them are seen, 2 to 4 px apart."""
SPREAD = 0.6
"""Standard deviation of the smoothing of colours, in distances of the points."""
LEAST_CONTRAST = 0.05
"""Standard deviation of a mesh's colours (logarithm) below which it is of one colour, and says nothing."""
DARK = 16.0
"""Added to a colour of 0 to 255 before the logarithm: darker ones are noise and reflections."""
SIGMA = 0.15
"""Least standard deviation of the picture's colours (logarithm) from those that the mesh's explain: highlights, shadows, prints that
differ."""
GAIN = (0.0, 1.6)
"""Bounds of the picture's contrast against the mesh's: textures are scanned in other light and fade, but light is never dark."""
GRAZING = 0.2
"""Least cosine between a surface's direction and the line of sight: flatter ones show nothing."""
EDGE = 2.0
"""Distance from the silhouette's edge within which nothing is compared, in standard deviations of the smoothing."""
FEWEST = 40
"""Least number of points that are compared."""
ROBUST = 0.4
"""Difference of colours (logarithm) beyond which a point counts less and less: something hides it."""
FITS = 2
"""Number of fits of the light, each with the weights of the one before."""
HIDDEN = 0.05
"""Least likelihood of a point's colour, against that of any: it may be hidden."""
PATCH = 10.0
"""Number of points whose colours' differences err together: smoothing joins 4 or 5 of them (4 pi SPREAD^2), and highlights, shadows
and errors of the texture's place more."""


@dataclass(frozen=True)
class Cloud:
    """Points (n, 3) [m] of a mesh's surface with the colours (n, 3) 0 to 255 RGB that its file gives them."""

    points: Array
    colours: Array


@dataclass(frozen=True)
class Paint:
    """Points (n, 3) [m] of a surface, their outward normals (n, 3) and colours (n, 3), logarithms smoothed by `spread` [m]."""

    points: Array
    normals: Array
    colours: Array
    spread: float


def cloud(mesh: Any) -> Cloud | None:
    """The coloured points of a trimesh.Trimesh; None where it has no colours."""
    visual, faces = mesh.visual, np.asarray(mesh.faces)
    vertices = np.asarray(mesh.vertices, np.float64)
    points, face, weights = spread_over(vertices, faces, CLOUD)
    if visual.kind == "vertex":
        colours = np.einsum("nc,ncd->nd", weights, np.asarray(visual.vertex_colors, np.float64)[faces[face], :3])
    elif visual.kind == "face":
        colours = np.asarray(visual.face_colors, np.float64)[face, :3]
    elif visual.kind == "texture" and visual.uv is not None and (image := _image(visual.material)) is not None:
        u, v = np.einsum("nc,ncd->nd", weights, np.asarray(visual.uv, np.float64)[faces[face]]).T
        h, w = image.shape[:2]
        colours = image[np.floor((1.0 - v % 1.0) * h).astype(int) % h, np.floor(u % 1.0 * w).astype(int) % w].astype(np.float64)
    else:
        return None
    return Cloud(points, colours)


def _image(material: Any) -> NDArray[np.uint8] | None:
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    return None if image is None else np.asarray(image.convert("RGB"))


def spread_over(vertices: Array, faces: NDArray[np.int_], count: int) -> tuple[Array, NDArray[np.int64], Array]:
    """Points (count, 3) spread evenly over a mesh, the face (count,) and the weights (count, 3) of its corners for each."""
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
    """The paint of a mesh whose faces are turned outwards, for POINTS; None where it is of one colour."""
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


@kernel("f8[n, 3], f8[n, 3], f4[h, w, 3], f4[h, w], u1[h, w], f8[4], f8, f8, out i8[n], out f8[n, 3], out f8[n, 3, 2] -> i8")
def _sampled(P, N, image, depth, unknown, k, behind, grazing, index, value, gradient):
    """Writes of the points P (n, 3) with normals N, in the camera's frame, which are seen, the picture's colours there and how they
    change along the picture's axes; returns how many."""
    h, w = depth.shape
    n = 0
    for i in range(len(P)):
        x, y, z = P[i, 0], P[i, 1], P[i, 2]
        if z <= 0.0 or -(N[i, 0] * x + N[i, 1] * y + N[i, 2] * z) < grazing * math.sqrt(x * x + y * y + z * z):
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
            left = (1.0 - b) * image[r, c - 1, d] + b * image[r + 1, c - 1, d]
            right = (1.0 - b) * image[r, c + 2, d] + b * image[r + 1, c + 2, d]
            middle_left, middle_right = (1.0 - b) * i00 + b * i10, (1.0 - b) * i01 + b * i11
            gradient[n, d, 0] = 0.5 * ((1.0 - a) * (middle_right - left) + a * (right - middle_left))
            above = (1.0 - a) * image[r - 1, c, d] + a * image[r - 1, c + 1, d]
            below = (1.0 - a) * image[r + 2, c, d] + a * image[r + 2, c + 1, d]
            top, bottom = (1.0 - a) * i00 + a * i01, (1.0 - a) * i10 + a * i11
            gradient[n, d, 1] = 0.5 * ((1.0 - b) * (bottom - above) + b * (below - top))
        index[n] = i
        n += 1
    return n


@dataclass(frozen=True)
class Compared:
    """The points (n,) that are seen at a pose: `position` (n, 3) [m] in the camera's frame, the picture's `gradient` (n, 3, 2)
    [1/px], what the mesh's colours leave of the picture's (n, 3), what shading alone leaves of them (n, 3), and the `share` (n,)
    of an independent patch that each point is; `shading` (n, 4) and `colours` (n, 3): what was fitted."""

    position: Array
    gradient: Array
    left: Array
    plain: Array
    share: Array
    shading: Array
    colours: Array

    def trust(self, channel: int) -> Array:
        """Weights (n,) of the points' offsets: those of Cauchy's distribution, for what hides a part."""
        return np.asarray(1.0 / (1.0 + np.square(self.left[:, channel] / ROBUST)), np.float64)

    @property
    def score(self) -> float:
        """Log-likelihood of the mesh's colours against that of any others, over all patches."""
        usual = np.sqrt(np.average(np.square(self.plain), axis=0, weights=self.share))
        trust = self.share[:, None] * np.stack([self.trust(c) for c in range(3)], axis=1)
        left = np.sqrt(np.sum(trust * np.square(self.left), axis=0) / np.sum(trust, axis=0))
        sigma = np.minimum(np.maximum(SIGMA, left), usual)
        better = 0.5 * np.square(self.plain / usual) - 0.5 * np.square(self.left / sigma) + np.log(usual / sigma)
        return float(self.share @ np.log((1.0 - HIDDEN) * np.exp(np.minimum(better.mean(axis=1), 30.0)) + HIDDEN))

    def information(self, T: Array) -> tuple[Array, Array]:
        """The information (6, 6) about the pose error at T [m, rad] and its right side (6,), with the light marginalised."""
        (X, Y, Z), arm = self.position.T, self.position - T[:3, 3]
        H, g = np.zeros((6, 6)), np.zeros(6)
        for c in range(3):
            J, (gx, gy) = np.empty((len(X), 6)), self.gradient[:, c].T
            J[:, 0], J[:, 1], J[:, 2] = gx / Z, gy / Z, -(gx * X + gy * Y) / Z**2
            J[:, 3:] = np.cross(arm, J[:, :3])  # a rotation vector w moves the point by w x (X - origin)
            weights = self.share * self.trust(c) / (3.0 * SIGMA**2)
            J, _ = _without(J, np.column_stack([self.shading, self.colours[:, c]]), weights)
            H, g = H + (J * weights[:, None]).T @ J, g - (J * weights[:, None]).T @ self.left[:, c]
        return H, g


def _without(Y: Array, X: Array, weights: Array) -> tuple[Array, Array]:
    """What a linear fit by the columns of X (n, k) leaves of those of Y (n, m), and its coefficients (k, m)."""
    weighted = X * weights[:, None]
    A = weighted.T @ X
    A[np.diag_indices_from(A)] += 1e-3 * weights.sum()  # directions that are not seen
    fit = np.linalg.solve(A, weighted.T @ Y)
    return Y - X @ fit, fit


def compared(paint: Paint, model: Model, image: Floats, guarded: NDArray[np.uint8], k: Intrinsics, T: Array) -> Compared | None:
    """The colours of the mesh and of a smoothed picture (h, w, 3) at a pose T_camera_object; None where too little is seen."""
    P, N = paint.points @ T[:3, :3].T + T[:3, 3], paint.normals @ T[:3, :3].T
    h, w = guarded.shape
    surface = raster.Raster(w, h)
    surface.draw(model.in_camera(T), model.faces, k.fx, k.fy, k.cx, k.cy, 0)
    # near the contour the smoothed picture shows the surroundings, too
    r = max(round(EDGE * paint.spread * k.fx / max(T[2, 3], raster.NEAR)), 1)
    beside = np.isinf(surface.depth).astype(np.uint8)
    unknown = cv2.dilate(beside, np.ones((2 * r + 1, 2 * r + 1), np.uint8)) | guarded
    n = len(P)
    index, value, gradient = np.empty(n, np.int64), np.empty((n, 3)), np.empty((n, 3, 2))
    four = np.array([k.fx, k.fy, k.cx, k.cy])
    n = _sampled(P, N, image, surface.depth, unknown, four, BEHIND, GRAZING, index, value, gradient)
    if n < FEWEST:
        return None
    index, value, gradient = index[:n], value[:n], gradient[:n]
    gradient[..., 0] *= k.fx
    gradient[..., 1] *= k.fy
    P, N, colours = P[index], N[index], paint.colours[index]
    share = -np.einsum("nd,nd->n", N, P) / (P[:, 2] * PATCH)  # foreshortened
    found = Compared(P, gradient, np.zeros((n, 3)), np.empty((n, 3)), share, np.column_stack([np.ones(n), N]), colours)
    for c in range(3):
        both = np.stack([value[:, c], colours[:, c]], axis=1)
        for _ in range(FITS):
            weights = share * found.trust(c)
            rest, _ = _without(both, found.shading, weights)
            own = float(weights @ np.square(rest[:, 1])) + 1e-6
            gain = min(max(float(weights @ (rest[:, 0] * rest[:, 1])) / own, GAIN[0]), GAIN[1])
            found.left[:, c], found.plain[:, c] = rest[:, 0] - gain * rest[:, 1], rest[:, 0]
    return found
