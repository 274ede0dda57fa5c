"""Finds the pose of an object from the colours and edges of a picture around the start, with or without a mask.

  1. Learn the colours inside and outside as histograms: from the mask without the pixels near its boundary, or from where the
     start predicts the object. Their log-odds say how probably a pixel is the object's (`Window.table`).
  2. On a small picture, turn the start in all directions, and shift each turned contour to where it lies on edges and between the
     colours (`hypotheses`).
  3. Least squares over lines across the contour, from small to large pictures (correspondence lines: Stoiber et al. 2022,
     doi:10.1007/s11263-022-01579-8): on each line the log-odds and the strength of the edges give a distribution of the contour's
     offset. Without a mask every hypothesis learns the colours from its own silhouette. Creases count as edges, too.
  4. Compare the hypotheses by the likelihood of the offsets (`contest.py`).

Two errors of the contour are unknown and marginalised (`information`): its dilation relative to the object in the picture, and
waves along its direction, from errors of mesh, shadows and picture. A mask gives no information within
BAND_PX of its boundary.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.services.search.contour import DROPPED, MEASURED, NEAR, POINT, Model
from penumbra.services.search.evidence import GUARD_PX
from penumbra.services.search.mask_fit import Limits
from penumbra.services.search.objects import basin
from penumbra.services.search.objects.basin import Contour, Prior, Shape
from penumbra.services.search.objects.paint import Compared, Painted, compared, smoothed
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import kernel
from penumbra.shared.perception.intrinsics import Intrinsics

Bool = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

SIZES = (45.0, 90.0, 200.0)
"""Square root of the silhouette's area [px] in the pictures, which are scaled down by powers of two to about these sizes."""
BINS = 16
"""Number of bins of a histogram per colour channel."""
LARGEST_ODDS = 3.0
"""Maximum log-odds of a colour: no colour is certain."""
MIXED = 0.1
"""Share of both sides' colours that is expected on either side."""
BAND_PX, MASK_ODDS = 4.0, 1.5
"""Maximum error of a mask's boundary [px of the image], and the log-odds of pixels further inside or outside."""
RING = 0.35
"""Width of the ring around the silhouette in which the outer colours are learned, as a share of its size."""
ROBUST = (0.7, 0.25)
"""Offset beyond which a line's weight decreases, as a share of its reach: in a search, and near a prediction, where larger
offsets belong to occluders."""
SPACING = 2.0
"""Spacing of the lines along the contour [px]."""
TEMPERATURE = 3.0
"""Number of a line's pixels that count as one: neighbours have the same colour."""
FLAT, FLAT_INSIDE = 0.15, 0.3
"""Likelihood of the contour where the picture shows no edge, relative to that at a strong edge, which is 1; and the same of
creases, which are often not visible."""
EDGE, CORRELATION = 0.4, 6.0
"""Minimum standard deviation of an offset, and length of contour over which offsets share their error [px]."""
DILATION = 1.0
"""Standard deviation of the contour's dilation [px of the image]: meshes and poses of real objects differ from their pictures by
this much."""
HARMONICS, WAVES = 4, 0.3
"""Number of harmonics of the normal's direction in the common errors (waves) of the contour, and of the creases, and the usual
standard deviation of the waves [px of the image]: at poses fitted to 13 photographs, their amplitudes are 0.1 to 0.7 px."""
_DILATION, _WAVES = 6, np.arange(7, 7 + 4 * HARMONICS)
"""Indices of the contour's own errors after the six of the pose: its dilation, and cosines and sines of the harmonics, for the
contour and for the creases."""
STIFF = 0.1
"""Usual standard deviation of waves near a prediction [px of the image]: the contour has hardly changed since it was fitted."""
ASSUMED, ESTIMATES = 1.0, 3
"""Number of waves as which the usual standard deviation counts in the estimate of a picture's, and iterations of that."""
DEPTHS = (0.95, 1.0, 1.05)
"""Distances of the hypotheses, relative to the start's."""
ANGLES = 8
"""Number of edge directions that are distinguished."""
STEP = 2
"""Spacing of the shifts that are tried [px of the small picture]."""
BESIDE = 2.5
"""Distance from the contour at which the colours on both sides are compared [px of the small picture]."""
BY_EDGE, BY_COLOUR = 0.15, 0.04
"""Weights, per pixel of a shifted contour, of the log-likelihood of edges and of the log-odds of colours."""
ONTO = 1.0
"""Distance from the contour [px] within which an edge is the contour's."""


@dataclass(frozen=True)
class Level:
    """A window of the picture whose pixels are `scale` image pixels wide: log-odds (h, w) of being the object's; gradient (h, w,
    2) of the strongest colour channel, relative to its typical size; `guarded` (h, w) uint8, where something covers; `painted`:
    picture for the comparison with the mesh's colours, None if it has none."""

    odds: Floats
    gradient: Floats
    guarded: Bytes
    k: Intrinsics
    scale: int
    painted: Painted | None

    def compared(self, shape: Shape, T: Array) -> Compared | None:
        """Compares the colours of mesh and picture at a pose; None if there are none to compare."""
        return None if self.painted is None else compared(self.painted, shape.coarse, T)

    @property
    def shape(self) -> tuple[int, int]:
        return self.odds.shape[0], self.odds.shape[1]


@dataclass(frozen=True)
class _Plain:
    """A window at one size, before colours are learned: `bins` (h, w) of the colours, `prior` (h, w): log-odds by the mask, and
    `inside` (h, w): distance from the mask's boundary in bands; both are None without a mask."""

    bins: NDArray[np.int64]
    gradient: Floats
    covered: Bytes
    guarded: Bytes
    k: Intrinsics
    prior: Floats | None
    inside: Floats | None
    painted: Painted | None

    @property
    def shape(self) -> tuple[int, int]:
        return self.bins.shape[0], self.bins.shape[1]


class Window:
    """The part of a picture (H, W, 3) in which an object is searched for.

    `mask`, `occluder` (H, W): pixels that show the object, and something in front of it; `margin` [px]: around the contour at T.
    """

    def __init__(
        self, picture: Bytes, mask: Bool | None, occluder: Bool | None, k: Intrinsics, shape: Shape, T: Array, margin: float
    ):
        height, width = picture.shape[:2]
        V = shape.coarse.in_camera(T)
        z = np.maximum(V[:, 2], NEAR)
        u, v = k.fx * V[:, 0] / z + k.cx, k.fy * V[:, 1] / z + k.cy
        left, right, top, bottom = float(u.min()), float(u.max()), float(v.min()), float(v.max())
        size = math.hypot(right - left, bottom - top)
        if mask is not None:
            rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
            left, right, top, bottom = min(left, columns[0]), max(right, columns[-1]), min(top, rows[0]), max(bottom, rows[-1])
        x0, x1 = _span(left - margin - 0.2 * size, right + margin + 0.2 * size, width)
        y0, y1 = _span(top - margin - 0.2 * size, bottom + margin + 0.2 * size, height)
        extent = _extent(shape.coarse, T, k, size)
        s = self.scale = max(1, int(extent / SIZES[-1]))
        self._extent, h, w = extent / s, max((y1 - y0) // s, 8), max((x1 - x0) // s, 8)

        def cut(image: Bytes) -> Bytes:
            part = np.ascontiguousarray(image[y0 : y0 + h * s, x0 : x0 + w * s])
            if part.shape[:2] != (h * s, w * s):  # the picture is smaller than the minimum window
                return np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA), np.uint8)
            return part if s == 1 else np.asarray(cv2.resize(part, (w, h), interpolation=cv2.INTER_AREA), np.uint8)

        self._image = cut(picture)
        self._mask = None if mask is None else cut(mask.astype(np.uint8) * np.uint8(255)) > 127
        covered = np.zeros((h, w), np.uint8) if occluder is None else cut(occluder.astype(np.uint8) * np.uint8(255))
        self._covered = np.minimum(covered, 1).astype(np.uint8)
        half = (s - 1) / 2.0
        self._k = Intrinsics(k.fx / s, k.fy / s, (k.cx - x0 - half) / s, (k.cy - y0 - half) / s)
        self.factors = sorted({2 ** max(0, round(math.log2(max(self._extent / size, 1.0)))) for size in SIZES}, reverse=True)
        self._learning = self.factors[min(1, len(self.factors) - 1)]
        self._paints, self._depth = shape.paints, max(T[2, 3], NEAR)
        self._plain: dict[int, _Plain] = {}

    def plain(self, factor: int) -> _Plain:
        """The window scaled down by a factor."""
        if factor not in self._plain:
            self._plain[factor] = self._made(factor)
        return self._plain[factor]

    def _made(self, f: int) -> _Plain:
        h, w = self._image.shape[0] // f, self._image.shape[1] // f

        def half(array: NDArray) -> NDArray:
            array = array[: h * f, : w * f]
            return array if f == 1 else np.asarray(cv2.resize(array, (w, h), interpolation=cv2.INTER_AREA), array.dtype)

        image = half(self._image)
        c = (image >> 4).astype(np.int64)
        gradient = np.empty((h, w, 2), np.float32)
        square = _gradient(np.asarray(cv2.GaussianBlur(image, (5, 5), 0.7), np.uint8), gradient)
        gradient /= np.float32(math.sqrt(square) + 1.0)
        covered = np.minimum(half(self._covered * np.uint8(255)), 1).astype(np.uint8)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * GUARD_PX + 1, 2 * GUARD_PX + 1))
        guarded = np.asarray(cv2.dilate(covered, disc, borderType=cv2.BORDER_CONSTANT, borderValue=1), np.uint8)
        off = (f - 1) / 2.0
        k = Intrinsics(self._k.fx / f, self._k.fy / f, (self._k.cx - off) / f, (self._k.cy - off) / f)
        prior = inside = None
        if self._mask is not None:
            mask = self._mask.astype(np.uint8)
            distance = cv2.distanceTransform(mask, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - mask, cv2.DIST_L2, 5)
            inside = half((distance / min(BAND_PX / self.scale, 0.1 * self._extent)).astype(np.float32))
            prior = np.where(np.abs(inside) < 1.0, 0.0, np.sign(inside) * MASK_ODDS).astype(np.float32)
        painted = None
        if self._paints is not None and f in self.factors[:2]:
            paint = self._paints[self.factors.index(f)]
            painted = Painted(paint, smoothed(image, paint.spread * k.fx / self._depth), guarded, k)
        return _Plain((c[..., 0] * BINS + c[..., 1]) * BINS + c[..., 2], gradient, covered, guarded, k, prior, inside, painted)

    def level(self, factor: int, table: Floats) -> Level:
        """The window scaled down by a factor, with the log-odds (BINS^3,) of the colours."""
        at = self.plain(factor)
        n, (h, w) = max(factor // self._learning, 1), at.shape
        # smaller pictures mix colours that were not learned together: their log-odds are the mean of the pixels'
        odds = table[self.plain(factor // n).bins[: h * n, : w * n]]
        if n > 1:
            odds = np.asarray(cv2.resize(odds, (w, h), interpolation=cv2.INTER_AREA), np.float32)
        odds = odds if at.prior is None else odds + at.prior
        # the points are a few pixels of the second size apart: larger pictures show no more of them
        painted = self.plain(factor if factor in self.factors[:2] else self.factors[1]).painted
        return Level(odds, at.gradient, at.guarded, at.k, factor * self.scale, painted)

    def table(self, inside: Floats, outside: Floats) -> Floats:
        """Log-odds (BINS^3,) of the colours by the weights (h, w) of pixels inside and outside, at the size for learning."""
        at = self.plain(self._learning)
        both = []
        for weight in (inside, outside):
            used = (weight > 0.0) & (at.covered == 0)
            found: Array = np.bincount(at.bins[used], weight[used], BINS**3).reshape(BINS, BINS, BINS).astype(np.float64)
            for axis in range(3):
                found = _smoothed(found, axis)
            both.append(found / max(float(found.sum()), 1e-9))
        p, q = both
        either = MIXED * (p + q) / 2.0 + 1e-6
        odds = np.log((p + either) / (q + either))
        return np.clip(odds, -LARGEST_ODDS, LARGEST_ODDS).astype(np.float32).ravel()

    def of_mask(self) -> Floats | None:
        """The table of the mask's colours, away from its boundary; None without a mask."""
        inside = self.plain(self._learning).inside
        return None if inside is None else self.table((inside > 1.0).astype(np.float32), (inside < -1.0).astype(np.float32))

    def of_pose(self, model: Model, T: Array, gap: float) -> Floats:
        """The table of the colours inside and around a silhouette, without pixels nearer to its contour than `gap`, a share of
        its size."""
        at, size = self.plain(self._learning), self._extent / self._learning
        h, w = at.shape
        shown = model.silhouette(T, at.k, (0, 0, w, h)).astype(np.uint8)
        inner = cv2.erode(shown, _square(gap * size))
        if np.count_nonzero(inner) < 0.3 * np.count_nonzero(shown):  # too thin
            inner = shown
        outer = cv2.dilate(shown, _square(RING * size)) - cv2.dilate(shown, _square(gap * size))
        return self.table(inner.astype(np.float32), outer.astype(np.float32))

    def of_poses(self, model: Model, poses: list[Array]) -> Floats:
        """The table of colours, weighted by the share of many poses that cover a pixel."""
        small = self.plain(self.factors[0])
        h, w = small.shape
        share = sum((model.silhouette(T, small.k, (0, 0, w, h)).astype(np.float32) for T in poses), np.zeros((h, w), np.float32))
        h, w = self.plain(self._learning).shape
        share = np.asarray(cv2.resize(share / np.float32(len(poses)), (w, h), interpolation=cv2.INTER_LINEAR), np.float32)
        return self.table(share**2, (1.0 - share) ** 2)


def _span(first: float, last: float, size: int) -> tuple[int, int]:
    """The pixels [first, last), limited to a picture's side."""
    begin = int(min(max(first, 0.0), size - 9.0))
    return begin, int(max(min(last, size), begin + 8.0))


def _extent(model: Model, T: Array, k: Intrinsics, size: float) -> float:
    """Square root of the silhouette's area [px], measured in a small picture; `size` [px]: diagonal of its bounding box."""
    f = max(size / 64.0, 1e-3)
    x, y, z = T[:3, 3]
    n = 160
    k = Intrinsics(k.fx / f, k.fy / f, n / 2.0 - k.fx / f * x / max(z, NEAR), n / 2.0 - k.fy / f * y / max(z, NEAR))
    return f * math.sqrt(max(int(np.count_nonzero(model.silhouette(T, k, (0, 0, n, n)))), 1))


def _square(radius: float) -> Bytes:
    r = max(int(radius + 0.5), 1)
    return np.ones((2 * r + 1, 2 * r + 1), np.uint8)


def _smoothed(histogram: Array, axis: int) -> Array:
    """A histogram smoothed by 1/4, 1/2, 1/4 along an axis."""
    a = np.moveaxis(histogram, axis, 0)
    out = 0.5 * a
    out[1:] += 0.25 * a[:-1]
    out[:-1] += 0.25 * a[1:]
    return np.moveaxis(out, 0, axis)


@kernel("u1[h, w, 3], out f4[h, w, 2] -> f8")
def _gradient(image, out):
    """Writes the gradient of the colour in which it is the largest, and returns the mean of its square."""
    h, w, _ = image.shape
    total = 0.0
    for y in range(h):
        above, below = max(y - 1, 0), min(y + 1, h - 1)
        for x in range(w):
            left, right = max(x - 1, 0), min(x + 1, w - 1)
            most, gx, gy = -1.0, 0.0, 0.0
            for c in range(3):
                dx = 0.5 * (float(image[y, right, c]) - float(image[y, left, c]))
                dy = 0.5 * (float(image[below, x, c]) - float(image[above, x, c]))
                square = dx * dx + dy * dy
                if square > most:
                    most, gx, gy = square, dx, dy
            out[y, x, 0], out[y, x, 1] = gx, gy
            total += most
    return total / (h * w)


# --- lines ------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lines:
    """Measurements of the lines across a contour: its points with offsets r (n,) [px], their variance (n,) [px^2], and the
    likelihood (n,) of an offset near zero, relative to that of any offset."""

    contour: Contour
    variance: Array
    support: Array

    @property
    def length(self) -> Array:
        """Length of contour (n,) [px] that each measured point represents."""
        return np.asarray(self.contour.points["length"] * (self.contour.kind == MEASURED), np.float64)


def lines(shape: Shape, model: Model, at: Level, T: Array, reach: int, inside: bool = False) -> Lines:
    """The lines across the contour of a model at a pose, `reach` [px] to both sides, or, if `inside`, across its creases."""
    h, w = at.shape
    if inside:
        points, shown = shape.creases.points(T, at.k, at.shape, SPACING), np.zeros((h, w), np.bool_)
    else:
        points, shown = model.outline(model.in_camera(T), at.k, at.shape, SPACING), model.silhouette(T, at.k, (0, 0, w, h))
    n = len(points)
    r, variance, support, kind = np.zeros(n), np.ones(n), np.ones(n), np.zeros(n, np.uint8)
    if n:
        flat = FLAT_INSIDE if inside else FLAT
        _lines(
            points, at.odds, at.gradient, at.guarded, shown, inside, reach, TEMPERATURE, flat, ONTO, r, variance, support, kind
        )
    return Lines(Contour(points, r, kind), variance, support)


@kernel(
    """POINT[n], f4[h, w], f4[h, w, 2], u1[h, w], b1[h, w], b1, i8, f8, f8, f8,
    out f8[n], out f8[n], out f8[n], out u1[n]""",
    POINT=POINT,
)
def _lines(points, odds, gradient, guarded, shown, inside, reach, temperature, flat, onto, r, variance, support, kind):
    """Writes offset, variance, support and kind (DROPPED, MEASURED) of each point: see `Lines`. `inside`: the points are of
    creases, of which edges alone say something. A line ends where something covers, and where the silhouette `shown` (h, w) ends
    or begins again."""
    h, w = odds.shape
    value, edge, score = np.empty(2 * reach + 1), np.empty(2 * reach + 1), np.empty(2 * reach + 1)
    for i in range(len(points)):
        point = points[i]
        nx, ny = point.normal[0], point.normal[1]
        first, last = reach, reach
        kind[i] = DROPPED
        for way in (1, -1):
            for t in range(0 if way == 1 else 1, reach + 1):
                u, v = point.pixel[0] + way * t * nx, point.pixel[1] + way * t * ny
                x, y = int(math.floor(u)), int(math.floor(v))
                if x < 0 or y < 0 or x >= w - 1 or y >= h - 1 or guarded[int(v + 0.5), int(u + 0.5)] != 0:
                    break
                if not inside and t > 1 and shown[int(v + 0.5), int(u + 0.5)] != (way < 0):
                    break
                a, b = u - x, v - y
                c00, c01, c10, c11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
                s = reach + way * t
                value[s] = c00 * odds[y, x] + c01 * odds[y, x + 1] + c10 * odds[y + 1, x] + c11 * odds[y + 1, x + 1]
                across = 0.0
                for c in range(2):
                    g = c00 * gradient[y, x, c] + c01 * gradient[y, x + 1, c]
                    g += c10 * gradient[y + 1, x, c] + c11 * gradient[y + 1, x + 1, c]
                    across += g * point.normal[c]
                edge[s] = abs(across)
                first, last = min(first, s), max(last, s)
            if way == 1 and last == reach:
                break
        if first == reach or last == reach:
            continue
        # the log-likelihood of the contour at sample s: all before it inside, all behind it outside
        total, best = 0.0, -1e30
        for s in range(first, last + 1):
            if not inside:
                total += 0.5 * value[s]
            score[s] = total / temperature + math.log(flat + edge[s] / (1.0 + edge[s]))
            if not inside:
                total += 0.5 * value[s]
            best = max(best, score[s])
        mass, moment, second, near = 0.0, 0.0, 0.0, 0.0
        for s in range(first, last + 1):
            p, d = math.exp(score[s] - best), float(s - reach)
            mass += p
            moment += p * d
            second += p * d * d
            if abs(d) <= onto:
                near += p
        r[i] = moment / mass
        variance[i] = max(second / mass - r[i] * r[i], 0.0)
        support[i] = near / mass * (last - first + 1) / (2.0 * onto + 1.0)
        kind[i] = MEASURED


def _equations(one: Lines, inside: bool, at: Level, T: Array, width: float) -> tuple[Array, Array]:
    """Jacobian (n, m) of the offsets by the pose error and the contour's own errors, and the same with the offsets' weights,
    which decrease beyond an offset of `width` [px]."""
    normal = one.contour.points["normal"]
    turns = np.arange(1, HARMONICS + 1) * np.arctan2(normal[:, 1], normal[:, 0])[:, None]
    J = np.zeros((len(normal), 7 + len(_WAVES)))
    J[:, :7] = one.contour.jacobian(T, at.k)
    if inside:
        J[:, _DILATION] = 0.0
    J[:, np.split(_WAVES, 2)[int(inside)]] = np.concatenate([np.cos(turns), np.sin(turns)], axis=1)
    weights = one.length * basin.robust(one.contour.r, width) / ((one.variance + EDGE**2) * CORRELATION)
    return J, J * weights[:, None]


def information(
    found: list[tuple[Lines, bool]], at: Level, T: Array, width: float, usual_px: float = WAVES
) -> tuple[Array, Array]:
    """The information (6, 6) about the pose error at T and its right side (6,), from the lines of contour and creases (True),
    with the contour's own errors marginalised (Schur complement); `usual_px`: the waves' usual standard deviation [px of the
    image].

    The size of the waves is estimated together with them (the evidence procedure: MacKay 1992, doi:10.1162/neco.1992.4.3.415): an
    exact mesh shows the pose by small differences of its shape, an inexact one only by its size and place.
    """
    n = 7 + len(_WAVES)
    H, g = np.zeros((n, n)), np.zeros(n)
    for one, inside in found:
        J, weighted = _equations(one, inside, at, T, width)
        H, g = H + weighted.T @ J, g + weighted.T @ one.contour.r
    H[_DILATION, _DILATION] += (DILATION / at.scale) ** -2
    usual = (usual_px / at.scale) ** 2
    variance = usual
    for _ in range(ESTIMATES):
        A = H.copy()
        A[:6, :6] += Limits().information
        A[_WAVES, _WAVES] += 1.0 / variance
        P = np.linalg.inv(A)
        waves = P[_WAVES] @ g
        shown = len(_WAVES) - float(P[_WAVES, _WAVES].sum()) / variance  # number of waves that the lines determine
        variance = (float(waves @ waves) + ASSUMED * usual) / (shown + ASSUMED)
    H[_WAVES, _WAVES] += 1.0 / variance
    gain = np.linalg.solve(H[6:, 6:], H[6:, :6]).T
    return H[:6, :6] - gain @ H[6:, :6], g[:6] - gain @ g[6:]


def descend(
    shape: Shape,
    model: Model,
    at: Level,
    T: Array,
    prior: Prior,
    reaches: tuple[int, ...],
    creases: bool,
    near: bool = False,
) -> Array:
    """Least-squares steps, one for each length of the lines in `reaches` [px], with or without creases. `near` a prediction, an
    occluder must not pull the pose along: weights decrease beyond a smaller offset, and waves are smaller."""
    robust, waves = (ROBUST[1], STIFF) if near else (ROBUST[0], WAVES)
    for reach in reaches:
        found = [(lines(shape, model, at, T, reach, inside), inside) for inside in ((False, True) if creases else (False,))]
        H, g = information(found, at, T, robust * reach, waves)
        if (colours := at.compared(shape, T)) is not None:
            more, towards = colours.information
            H, g = H + more, g + towards
        H += prior.information
        H[_DIAGONAL] *= 1.0 + basin.DAMPING
        step = np.linalg.solve(H, g + prior.information @ rigid.pose_error(prior.T, T))
        step /= max(1.0, float(np.max(np.abs(step) / basin.MAX_STEP)))
        T = rigid.perturb(T, step)
        T[2, 3] = max(T[2, 3], 2.0 * NEAR)
    return T


_DIAGONAL = np.diag_indices(6)


def covariance(shape: Shape, at: Level, T: Array, trust: float, colours: Compared | None) -> Array:
    """The covariance (6, 6) of a pose from contour and creases, whose information is multiplied by `trust`, and from the mesh's
    colours if they are convincing, with the errors of the mesh's scale (SCALE) and of its levers (LEVER)."""
    both = [(lines(shape, shape.fine, at, T, ENDING, inside), inside) for inside in (False, True)]
    H, _ = information(both, at, T, 0.7 * ENDING)
    lever2 = 0.0
    for one, inside in both:
        J, weighted = _equations(one, inside, at, T, 0.7 * ENDING)
        lever2 += float(np.sum(np.hypot(weighted[:, 0], weighted[:, 1]) * np.hypot(J[:, 0], J[:, 1]))) * (LEVER * shape.size) ** 2
    # a body of revolution gives no information about its turn, but its facets and a scan's roughness seem to
    scale = np.repeat([1.0, 1.0 / shape.size], 3)
    values, vectors = np.linalg.eigh(np.outer(scale, scale) * (H - np.diag(np.repeat([0.0, lever2], 3))))
    believed = (vectors * np.maximum(values, 0.0)) @ vectors.T / np.outer(scale, scale)
    P = np.linalg.inv(believed + Limits().information)
    farther = np.concatenate([SCALE * T[:3, 3], np.zeros(3)])  # a larger object further away looks the same
    if colours is None:
        return np.asarray((P + np.outer(farther, farther)) / trust, np.float64)
    P = np.linalg.inv(np.linalg.inv(P / trust) + colours.information[0])
    return np.asarray(P + np.outer(farther, farther), np.float64)


SCALE = 0.01
"""Relative standard deviation of a mesh's scale: of scans, and of objects of one kind."""
LEVER = 0.02
"""Standard deviation of the levers by which the contour shows a rotation, as a share of the object's size."""
ENDING = 4
"""Reach of the lines in the last steps [px]."""


@kernel("POINT[n], f4[a, h, w], f4[h, w], i8, f8, f8, f8, out f8[m, m]", POINT=POINT)
def _vote(points, edges, odds, step, beside, by_edge, by_colour, value):
    """Writes what speaks for a contour (n,) at each of (m, m) shifts by multiples of `step` [px], the middle being none: its
    points on `edges` (a, h, w) of their direction, and between unlike log-odds (h, w)."""
    angles, h, w = edges.shape
    most = len(value) // 2
    value[:] = 0.0
    for i in range(len(points)):
        point = points[i]
        u, v, nx, ny = point.pixel[0] + 0.5, point.pixel[1] + 0.5, point.normal[0], point.normal[1]
        a = int(math.floor(math.atan2(ny, nx) / math.pi * angles + 0.5)) % angles
        x, y = int(math.floor(u)), int(math.floor(v))
        x_in, y_in = int(math.floor(u - beside * nx)), int(math.floor(v - beside * ny))
        x_out, y_out = int(math.floor(u + beside * nx)), int(math.floor(v + beside * ny))
        for r in range(len(value)):
            dy = (r - most) * step
            if min(y, y_in, y_out) + dy < 0 or max(y, y_in, y_out) + dy >= h:
                continue
            for c in range(len(value)):
                dx = (c - most) * step
                if min(x, x_in, x_out) + dx < 0 or max(x, x_in, x_out) + dx >= w:
                    continue
                between = odds[y_in + dy, x_in + dx] - odds[y_out + dy, x_out + dx]
                value[r, c] += point.length * (by_edge * edges[a, y + dy, x + dx] + by_colour * between)


def hypotheses(model: Model, at: Level, starts: list[Array], prior: Prior, reach: float) -> list[tuple[float, Array]]:
    """The poses that result from shifting each start, up to `reach` [m], to the two places where its contour lies best on edges
    and between the colours, with their scores; best first."""
    h, w = at.shape
    edges = np.empty((ANGLES, h, w), np.float32)
    for a in range(ANGLES):
        angle = math.pi * a / ANGLES
        e = np.abs(at.gradient[..., 0] * np.float32(math.cos(angle)) + at.gradient[..., 1] * np.float32(math.sin(angle)))
        e = np.asarray(cv2.dilate(np.log(np.float32(FLAT) + e / (1.0 + e)), np.ones((3, 3), np.uint8)))
        edges[a] = e - e.mean()
    odds = np.asarray(cv2.blur(np.where(at.guarded > 0, np.float32(0.0), at.odds), (3, 3)), np.float32)
    found = []
    for start in starts:
        for depth in DEPTHS:
            T = start.copy()
            T[:3, 3] *= depth
            most = int(reach * at.k.fx / T[2, 3] / STEP) + 1
            value = np.empty((2 * most + 1, 2 * most + 1))
            points = model.outline(model.in_camera(T), at.k, (h, w), 1.25 * SPACING)
            _vote(points, edges, odds, STEP, BESIDE, BY_EDGE, BY_COLOUR, value)
            shift = (np.arange(2 * most + 1) - most) * STEP * T[2, 3] / at.k.fx
            information = prior.information
            value -= 0.5 * (information[0, 0] * shift**2 + information[1, 1] * shift[:, None] ** 2) + 0.5 * prior.cost(T)
            for _ in range(2):
                y, x = divmod(int(value.argmax()), 2 * most + 1)
                there = T.copy()
                there[:2, 3] += (shift[x], shift[y])
                found.append((float(value[y, x]), there))
                value[max(y - 3, 0) : y + 4, max(x - 3, 0) : x + 4] = -np.inf
    return sorted(found, key=lambda one: -one[0])
