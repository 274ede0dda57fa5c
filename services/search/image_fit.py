"""Refines the pose on the image itself, which is sharper than a network's mask.

One pass, from a pose near the right one (contracting curve density: Hanek, Beetz 2004, doi:10.1023/B:VISI.0000036836.66311.97):
  1. project the mesh's contour (`contour.Model.matched`) and read the picture's colours on a short line across it at each point;
  2. learn the colours on both sides: mean and covariance just beyond the edge's blur, pooled along the contour;
  3. for every offset of the edge on the line, compare the colours with those of a blurred step between the two sides, and add
     the mask's term; this is the likelihood of the contour's offset, approximated by a Gaussian;
  4. solve for the pose error as `fit` does.
The lines end where something covers the target (`Evidence.guarded`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.services.search.contour import MEASURED, POINT, Equations, Model, Points, normal_equations, sides, slow_waves
from penumbra.services.search.evidence import Evidence
from penumbra.services.search.mask_fit import Fit, Limits, marginal, overlap_of, with_prior
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import inner, kernel
from penumbra.shared.perception.intrinsics import Intrinsics

LINE = 5
"""Reach of a line on both sides of the contour [px]; it is sampled once per pixel."""
OFFSETS = 8
"""Maximum offset of the edge on the line, to both sides [half pixels]."""
BLUR = 0.7
"""Width of the edge [px]: the image of a step is 0.5 - 0.5 tanh(x / BLUR)."""
NEAREST = 1
"""Minimum distance [px] from the contour at which a side's colours are learned: the pixel on it shows both sides."""
NEAR, SPREADS = 1.5, (1.0, 1.5)
"""Distance [px] from the contour at which a pixel's colour counts most for its side, and standard deviations [px] of that weight
inside and outside. Nearer, the sides are mixed, and farther inside a limb is lit differently. With equal weights the edge of a
side in the shade was found up to 0.9 px too far inside, since its last pixels look more like the background than like the rest of
the limb. Chosen on seven replays and 1120 single pictures."""


@dataclass(frozen=True)
class ImageSettings:
    """Noise of a picture's colours. `passes`: maximum number; `spacing` of contour points [px]; `pooling`: standard deviation of
    the pooling along the contour [px]; `floor`: minimum standard deviation of a colour [of 255]; `clipped`: maximum squared
    Mahalanobis distance of a pixel; `temperature`: number of a line's pixels that count as one; `mask`: standard deviation of the
    mask's boundary on a line [px]; `huber`: Huber's threshold [px]; `edge`: minimum standard deviation of an offset [px];
    `correlation`: length of contour over which offsets share their error [px]; `dilation`: standard deviation of the whole
    contour's [px]; `wave`: standard deviation of errors that change slowly along each side of the limb, as its shading does [px].
    With one side hidden, they look like another distance. If both sides of an edge are so alike that its offset is more uncertain
    than `wave`, they are as large as that, and what exceeds `edge` is an error of the whole side of the limb. If offsets are
    larger than TYPICAL, all these errors grow."""

    passes: int = 5
    spacing: float = 3.0
    pooling: float = 4.0
    floor: float = 2.0
    clipped: float = 25.0
    temperature: float = 2.0
    mask: float = 2.5
    huber: float = 0.5
    edge: float = 0.2
    correlation: float = 9.0
    dilation: float = 0.07
    wave: float = 0.13


def native(image: NDArray[np.uint8], evidence: Evidence) -> tuple[NDArray[np.uint8], Evidence]:
    """The part of an image (h, w, 3) in the evidence's window, and the evidence at the image's resolution."""
    (h, w), scale = evidence.state.shape, evidence.scale
    x0, y0, width, height = evidence.x0, evidence.y0, w * scale, h * scale
    inside = np.ascontiguousarray(image[max(y0, 0) : max(y0 + height, 0), max(x0, 0) : max(x0 + width, 0)])
    left, top = min(max(-x0, 0), width), min(max(-y0, 0), height)
    right, bottom = width - left - inside.shape[1], height - top - inside.shape[0]
    if left or top or right or bottom:  # pixels outside the image are COVERED, so their colours do not matter
        inside = np.pad(inside, ((top, bottom), (left, right), (0, 0)))
    if scale == 1:
        return inside, evidence

    def enlarged(array: NDArray, how: int) -> NDArray:
        return np.asarray(cv2.resize(array, (width, height), interpolation=how), array.dtype)

    k, centre = evidence.intrinsics, (scale - 1) / 2.0
    return inside, replace(
        evidence,
        state=enlarged(evidence.state, cv2.INTER_NEAREST),
        field=enlarged(evidence.field, cv2.INTER_LINEAR),
        known=enlarged(evidence.known, cv2.INTER_LINEAR) if evidence.known.size else evidence.known,
        guarded=enlarged(evidence.guarded, cv2.INTER_NEAREST),
        hand=enlarged(evidence.hand, cv2.INTER_NEAREST),
        seen_px=evidence.seen_px * scale**2,
        boundary_px=evidence.boundary_px * scale,
        intrinsics=Intrinsics(k.fx * scale, k.fy * scale, k.cx * scale + centre, k.cy * scale + centre),
        scale=1,
    )


def fit_image(
    model: Model,
    first: Fit,
    image: NDArray[np.uint8],
    evidence: Evidence,
    T_prior: Array,
    prior: Array,
    settings: ImageSettings | None = None,
    limits: Limits | None = None,
) -> Fit:
    """The pose near `first` whose contour lies on a colour edge in the mask's image (h, w, 3) uint8 RGB.

    `prior` (6, 6): information about T_prior (4 x 4) along the camera's axes, removed from the result as by `fit`.
    """
    settings, limits = settings or ImageSettings(), limits or Limits()
    regular = np.zeros((7, 7))
    regular[:6, :6] = prior + limits.information
    regular[6, 6] = settings.dilation**-2
    pictures = _pyramid(_Picture(model, *native(image, evidence), settings, T_prior, regular, first.hand), evidence.scale)
    T = with_prior(first.T, first.covariance, T_prior, prior)
    best = _through(pictures[-1:], T)
    for enough, start, way in _further(pictures, T, T_prior if prior.any() else None):
        if best.rms >= enough:
            best = min(best, _through(way, start), key=lambda one: one.rms)
    points = best.length / settings.correlation
    trust = min(1.0, (TYPICAL / max(unfitted(best.rms, points), 1e-3)) ** 4)
    loosened = regular.copy()
    loosened[6, 6] *= trust
    waves = trust * best.waves(settings, 1.0 / math.sqrt(trust))
    rolls = best.rolls if first.hand == 1.0 else None
    measured = partial(marginal, best.T, best.moved, trust * best.H, trust * best.g, loosened, rolls, limits)
    bends = trust * best.bends(measured(waves)[1], pictures[-1].evidence.intrinsics)
    T, covariance = measured(np.hstack([waves, bends]))
    both, free, overlap = overlap_of(model, best.T, evidence, first.hand)
    return replace(
        first,
        T=T,
        covariance=covariance,
        T_searched=best.T,
        points=points,
        rms=best.rms,
        cost=points / evidence.scale * best.misfit / settings.edge**2,
        both=both,
        free=free,
        overlap=overlap,
        sharp=best.rms < SHARP,
    )


def straightest(straight: Fit, bent: Fit) -> Fit:
    """The fit that trusts the mesh's stiff hand if it is about as good as the one that trusts it less; else the latter."""
    return straight if straight.rms < STRAIGHT * bent.rms else bent


def unfitted(rms: float, points: float) -> float:
    """RMS [px] of the offsets about the true pose, if a fit to `points` independent points left `rms`: the fit absorbs as many
    degrees of freedom as a pose has unknowns."""
    return rms * math.sqrt(points / max(points - UNKNOWNS, 1.0))


@dataclass(frozen=True)
class _Pass:
    """Normal equations (7, 7), (7,) at a pose T, which is `moved` (7,) from the prior; length of the measured contour [px], RMS
    of the remaining offsets [px] and the share of the roll that is used. points (n,) of the contour; sigma (n,) [px]: standard
    deviations of their offsets; equations: function from offsets (n,) to normal equations. misfit: mean square [px^2] of the
    remaining offsets and of their uncertainty, so that a contour along which nothing is seen is not a good one."""

    T: Array
    moved: Array
    H: Array
    g: Array
    length: float
    rms: float
    rolls: float
    points: Points
    sigma: Array
    misfit: float
    equations: Callable[[Array], Equations]

    def waves(self, settings: ImageSettings, larger: float) -> Array:
        """The right sides (7, k) of the errors of `ImageSettings.wave`, times `larger`."""
        shared, whole = np.maximum(self.sigma, settings.wave), np.maximum(self.sigma - settings.edge, 0.0)
        errors = [shared * wave for wave in slow_waves(self.points, self.T)]
        errors += [whole * side for side in sides(self.points, self.T)]
        return np.stack([self.equations(larger * error).g for error in errors], axis=1)

    def bends(self, covariance: Array, intrinsics: Intrinsics) -> Array:
        """The right sides (7, BENDS) of the second-order motion of the contour, which the equations leave out, for pose errors of
        one standard deviation along the most uncertain directions of a covariance (6, 6)."""
        axis = self.T[:3, 0]
        lever = np.diag([1.0, 1.0, 1.0, LEVER_M, LEVER_M, LEVER_M])
        lever[3:, 3:] -= LEVER_M * np.outer(axis, axis)  # a roll hardly moves the contour; `marginal` adds its uncertainty
        variances, directions = np.linalg.eigh(lever @ covariance @ lever)
        off = directions[:, -BENDS:] * np.sqrt(np.maximum(variances[-BENDS:], 0.0))
        off[3:] /= LEVER_M
        return np.stack([self.equations(_bend(self.points, self.T, error, intrinsics)).g for error in off.T], axis=1)


@dataclass(frozen=True)
class _Picture:
    """An image (h, w, 3) uint8 in which the pose is searched for, with the evidence of its pixels; hand: as of `mask_fit.Fit`."""

    model: Model
    image: NDArray[np.uint8]
    evidence: Evidence
    settings: ImageSettings
    T_prior: Array
    regular: Array
    hand: float

    def halved(self) -> _Picture:
        """The same at half the resolution, which doubles the reach."""
        h, w = self.evidence.state.shape[0] // 2, self.evidence.state.shape[1] // 2
        k, evidence = self.evidence.intrinsics, self.evidence

        def half(array: NDArray) -> NDArray:
            return np.asarray(cv2.resize(array[: 2 * h, : 2 * w], (w, h), interpolation=cv2.INTER_AREA))

        smaller = replace(
            evidence,
            state=np.ascontiguousarray(evidence.state[: 2 * h : 2, : 2 * w : 2]),
            field=half(evidence.field).astype(np.float32, copy=False),
            known=half(evidence.known).astype(np.float32, copy=False) if evidence.known.size else evidence.known,
            guarded=(half(evidence.guarded * np.uint8(4)) > 0).astype(np.uint8),
            intrinsics=Intrinsics(k.fx / 2.0, k.fy / 2.0, (k.cx - 0.5) / 2.0, (k.cy - 0.5) / 2.0),
        )
        return replace(self, image=half(self.image).astype(np.uint8, copy=False), evidence=smaller)

    def descend(self, T: Array, passes: int) -> _Pass:
        """The best of the Gauss-Newton steps from T: if little is visible, the last one is not always the best."""
        moved = np.zeros(7)
        moved[:6] = rigid.pose_error(T, self.T_prior)
        best: _Pass | None = None
        for _ in range(passes):
            here = self._at(T, moved)
            step = np.linalg.solve(here.H + self.regular, here.g - self.regular @ moved)
            step /= max(1.0, float(np.max(np.abs(step[:6]) / MAX_STEP)))
            T, moved = rigid.perturb(T, step[:6]), moved + step
            if best is None or here.rms < best.rms:  # derivatives at the pose before the step, which hardly changes them
                best = replace(here, T=T, moved=moved, g=here.g - here.H @ step)
            if np.abs(step[:3]).max() < CONVERGED and np.abs(step[3:6]).max() < 4.0 * CONVERGED:
                break
        assert best is not None, "expected at least one pass"
        return best

    def _at(self, T: Array, moved: Array) -> _Pass:
        evidence, settings, k = self.evidence, self.settings, self.evidence.intrinsics
        found = self.model.matched(T, evidence, settings.spacing, LINE, self.hand)
        points = found.points
        noise = (settings.pooling, settings.floor, settings.clipped, settings.temperature, settings.mask)
        r, sigma, kind = offsets(points, self.image, evidence.guarded, found.r, found.kind, *noise)
        weight = points["length"] / (settings.correlation * (sigma**2 + settings.edge**2))

        def equations(r: Array) -> Equations:
            return normal_equations(points, r, kind, weight, T[:3, 3], T[:3, 0], k.fx, k.fy, settings.huber, False)

        found_by = equations(r - moved[6])
        length = found_by.length
        rms = math.sqrt(found_by.square / length) if length > 0 else math.inf
        seen = points["length"] * (kind == MEASURED)
        left = np.minimum((r - moved[6]) ** 2 + sigma**2, settings.huber**2)
        misfit = float(seen @ left) / length if length > 0 else math.inf
        return _Pass(T, moved, found_by.H, found_by.g, length, rms, found_by.rolls, points, sigma, misfit, equations)


def _pyramid(picture: _Picture, scale: int) -> list[_Picture]:
    """The pictures from the mask's resolution, `scale` times coarser, to the image's own, in steps of two. A mask's error is
    constant in its own pixels, and so larger in those of finer pictures."""
    pictures = [replace(picture, settings=replace(picture.settings, mask=scale * picture.settings.mask))]
    while scale > 1:
        scale //= 2
        smaller = pictures[0].halved()
        pictures.insert(0, replace(smaller, settings=replace(smaller.settings, mask=scale * picture.settings.mask)))
    return pictures


def _further(pictures: list[_Picture], T: Array, T_prior: Array | None) -> Iterator[tuple[float, Array, list[_Picture]]]:
    """Further starts and pictures in case the mask's pose T was misleading, in the order in which they are tried, with the RMS
    [px] of the offsets below which a try is not needed: from the prediction, if there is one; from coarse to fine, if the right
    pose was out of the lines' reach; both, with twice the reach at first."""
    if T_prior is not None:
        yield TYPICAL, T_prior, pictures[-1:]
    if len(pictures) > 1:
        yield SHARP, T, pictures
    if T_prior is not None:
        yield SHARP, T_prior, [pictures[0].halved(), *pictures]


def _through(pictures: list[_Picture], T: Array) -> _Pass:
    """The last pass of a descent from T through the pictures in turn."""
    for picture in pictures:
        found = picture.descend(T, picture.settings.passes)
        T = found.T
    return found


def _bend(points: Points, T: Array, error: Array, intrinsics: Intrinsics) -> Array:
    """Second-order part (n,) [px] of the motion of contour points along their normals under a pose error (6,)."""
    from_middle = points["position"] - T[:3, 3]

    def pixels(moved: Array) -> Array:
        there = from_middle @ rigid.rotation(moved[3:]).T + (T[:3, 3] + moved[:3])
        return there[:, :2] / there[:, 2:] * (intrinsics.fx, intrinsics.fy) + (intrinsics.cx, intrinsics.cy)

    second = 0.5 * (pixels(error) + pixels(-error)) - points["pixel"]
    return np.asarray(np.sum(second * points["normal"], axis=1))


BENDS = 2
"""Number of directions of a pose along which the contour's motion is computed to second order: distance and tilt."""
UNKNOWNS = 6
"""Number of unknowns of a pose."""
LEVER_M = 0.15
"""Length [m] that converts a rotation to a displacement: half of a forearm's."""
TYPICAL = 0.2
"""RMS [px] of the offsets (`unfitted`) up to which the covariance is that of the settings. Above it, the covariance grows with
the fourth power of the RMS, including the errors that the contour's points share."""
SHARP = 0.3
"""RMS [px] of the remaining offsets, each limited to `ImageSettings.huber`, below which a pose is accepted."""
STRAIGHT = 1.15
"""Maximum ratio of the remaining offsets with a straight hand to those with a bent one at which the hand counts as straight.
Measured on four runs of `arm`: it is for 70 % of the poses whose roll is right, and for 10 % of those more than 15 degrees off,
for which a hand only seems bent."""
MAX_STEP = np.array([0.02, 0.02, 0.05, 0.1, 0.1, 0.1])
"""Maximum step of a pass [m, rad]."""
CONVERGED = 2e-4
"""A pass that moves less than this [m], and four times this [rad], is the last."""
_SAMPLES = 2 * LINE + 1
_GRID = 2 * OFFSETS + 1
_MIXED = 3
"""Distance from the edge [half pixels] up to which a pixel shows a mixture of both sides."""


def offsets(
    points: Points,
    image: NDArray[np.uint8],
    guarded: NDArray[np.uint8],
    by_mask: Array,
    mask_kind: NDArray[np.uint8],
    pooling: float,
    floor: float,
    clipped: float,
    temperature: float,
    mask_sigma: float,
) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Offset [px] of the edge along the outward normal of each contour point, its standard deviation, and whether it was measured
    (DROPPED, MEASURED). The arguments after `mask_kind` are those of `ImageSettings`."""
    n = len(points)
    r, sigma, kind = np.zeros(n), np.ones(n), np.zeros(n, np.uint8)
    noise = (pooling, floor, clipped, temperature, mask_sigma)
    _offsets(points, image, guarded, by_mask, mask_kind, *noise, r, sigma, kind)
    return r, sigma, kind


@kernel("POINT[n], u1[h, w, 3], u1[h, w], f8[n], u1[n], f8, f8, f8, f8, f8, out f8[n], out f8[n], out u1[n]", POINT=POINT)
def _offsets(points, image, guarded, by_mask, mask_kind, pooling, floor, clipped, temperature, mask_sigma, r, sigma, kind):
    n = len(points)
    colours = np.empty((n, _SAMPLES, 3), np.float32)
    first, last = np.empty(n, np.int64), np.empty(n, np.int64)  # of the samples that nothing covers
    counts = np.empty(_SAMPLES)
    for s in range(_SAMPLES):
        t = s - LINE
        counts[s] = math.exp(-0.5 * ((abs(t) - NEAR) / SPREADS[0 if t < 0 else 1]) ** 2)
    own = np.zeros((n, 2, 10))  # of the samples inside and outside: number, sums, sums of products
    for i in range(n):
        first[i], last[i] = _read(points[i], image, guarded, colours[i])
        for s in range(first[i], last[i] + 1):
            t = s - LINE
            if abs(t) >= NEAREST:
                _count(own[i, 0 if t < 0 else 1], colours[i, s], counts[s])
    side = np.empty((2, 10))
    mean, spread = np.empty((2, 3)), np.empty((2, 6))
    mixture = np.empty((2 * _MIXED + 1, 10))  # mean, precision and log determinant of each
    pure = np.empty((2, _SAMPLES))
    score = np.empty(_GRID)
    reach2 = (2.5 * pooling) ** 2
    for i in range(n):
        if first[i] > LINE - NEAREST or last[i] < LINE + NEAREST:
            continue
        side[:] = 0.0
        here = points[i]
        for j in range(n):
            other = points[j]
            du, dv = other.pixel[0] - here.pixel[0], other.pixel[1] - here.pixel[1]
            d2 = du * du + dv * dv
            if d2 < reach2 and other.normal[0] * here.normal[0] + other.normal[1] * here.normal[1] > 0.5:
                w = math.exp(-0.5 * d2 / (pooling * pooling))
                for a in range(2):
                    for b in range(10):
                        side[a, b] += w * own[j, a, b]
        if side[0, 0] < 2.0 or side[1, 0] < 2.0:
            continue
        for a in range(2):
            _moments(side[a], floor, mean[a], spread[a])
        for m in range(2 * _MIXED + 1):
            share = 0.5 - 0.5 * math.tanh(0.5 * (m - _MIXED) / BLUR)
            if m == 0:
                share = 1.0
            elif m == 2 * _MIXED:
                share = 0.0
            _mix(share, mean, spread, mixture[m])
        for s in range(first[i], last[i] + 1):
            pure[0, s] = _misfit(colours[i, s], mixture[0], clipped)
            pure[1, s] = _misfit(colours[i, s], mixture[2 * _MIXED], clipped)
        best = -1e30
        for o in range(_GRID):
            edge = 0.5 * (o - OFFSETS)
            total = 0.0
            for s in range(first[i], last[i] + 1):
                m = int(2.0 * (s - LINE - edge)) + _MIXED
                if m <= 0:
                    total += pure[0, s]
                elif m >= 2 * _MIXED:
                    total += pure[1, s]
                else:
                    total += _misfit(colours[i, s], mixture[m], clipped)
            score[o] = -0.5 * total / temperature
            if mask_kind[i] == MEASURED:
                score[o] -= 0.5 * ((edge - by_mask[i]) / mask_sigma) ** 2
            best = max(best, score[o])
        total, first_moment, second = 0.0, 0.0, 0.0
        for o in range(_GRID):
            edge = 0.5 * (o - OFFSETS)
            p = math.exp(score[o] - best)
            total += p
            first_moment += p * edge
            second += p * edge * edge
        r[i] = first_moment / total
        sigma[i] = math.sqrt(max(second / total - r[i] * r[i], 0.0))
        kind[i] = MEASURED


@inner
def _read(point, image, guarded, colours):
    """Fills the colours along a point's line; returns the first and last sample before something covers it or it ends."""
    h, w = guarded.shape
    first, last = LINE + 1, LINE - 1
    for way in (1, -1):
        for t in range(0 if way == 1 else 1, LINE + 1):
            u, v = point.pixel[0] + way * t * point.normal[0], point.pixel[1] + way * t * point.normal[1]
            x, y = int(math.floor(u)), int(math.floor(v))
            if x < 0 or y < 0 or x >= w - 1 or y >= h - 1 or guarded[int(v + 0.5), int(u + 0.5)] != 0:
                break
            s = LINE + way * t
            a, b = u - x, v - y
            for c in range(3):
                top = _light(image[y, x, c]) * (1.0 - a) + _light(image[y, x + 1, c]) * a
                bottom = _light(image[y + 1, x, c]) * (1.0 - a) + _light(image[y + 1, x + 1, c]) * a
                colours[s, c] = math.sqrt(top * (1.0 - b) + bottom * b)
            first, last = min(first, s), max(last, s)
        if last < LINE:  # the contour's point itself is covered
            break
    return first, last


@inner
def _light(value):
    """The light of a display's value, which is its root (gamma 2, near enough)."""
    return float(value) * float(value)


@inner
def _count(sums, colour, weight):
    r, g, b = colour[0], colour[1], colour[2]
    sums[0] += weight
    sums[1] += weight * r
    sums[2] += weight * g
    sums[3] += weight * b
    sums[4] += weight * r * r
    sums[5] += weight * r * g
    sums[6] += weight * r * b
    sums[7] += weight * g * g
    sums[8] += weight * g * b
    sums[9] += weight * b * b


@inner
def _moments(sums, floor, mean, spread):
    """Mean (3,) and covariance (6,) (rr, rg, rb, gg, gb, bb) of colours summed by `_count`."""
    n = sums[0]
    for c in range(3):
        mean[c] = sums[1 + c] / n
    k = 0
    for c in range(3):
        for d in range(c, 3):
            spread[k] = sums[4 + k] / n - mean[c] * mean[d] + (floor * floor if c == d else 0.0)
            k += 1


@inner
def _mix(share, mean, spread, out):
    """Mean (3,), precision (6,) and log determinant of the covariance of the colours where a pixel shows `share` of the inside.

    Light mixes, and not a display's values: without this an edge seems to lie in the darker side, by up to a quarter of a pixel.
    """
    for c in range(3):
        out[c] = math.sqrt(share * mean[0, c] ** 2 + (1.0 - share) * mean[1, c] ** 2)
    mixed = share * spread[0] + (1.0 - share) * spread[1]
    a, b, c, d, e, f = mixed[0], mixed[1], mixed[2], mixed[3], mixed[4], mixed[5]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * A + b * B + c * C
    out[3], out[4], out[5] = A / det, B / det, C / det
    out[6], out[7], out[8] = (a * f - c * c) / det, (b * c - a * e) / det, (a * d - b * b) / det
    out[9] = math.log(det)


@inner
def _misfit(colour, mixture, clipped):
    """Squared Mahalanobis distance of a colour from a mixture, clipped, and the mixture's log determinant."""
    r, g, b = colour[0] - mixture[0], colour[1] - mixture[1], colour[2] - mixture[2]
    d = mixture[3] * r * r + mixture[6] * g * g + mixture[8] * b * b
    d += 2.0 * (mixture[4] * r * g + mixture[5] * r * b + mixture[7] * g * b)
    return min(d, clipped) + mixture[9]
