"""Estimates the nearest surface point before each pad, for objects of any shape, from the pad's electrodes alone.

The paper names this as future work ("interpreting the surface points measured by individual sensors as a point cloud"). Relative
to a forearm that lies across the pad, another shape changes the electrodes' signals by other factors. These factors are treated
as noise whose mean and covariance were measured on objects of random shapes in the full field model (`shapes.py`). Let d0 be the
gap at which such a forearm gives the pad's total signal. Let x = (log(d / d0), u_x, u_y, log(g / d0)) with the nearest point's
distance d from the pad's middle, its direction u, and the gap g of the surface to the pad's board. Let r be the logs of the
electrodes' signals over the forearm's at d0. The estimate is the linear one of minimum mean square error (Kay, Estimation Theory,
1993, section 12.3):

    x = m_x + C_xr (C_rr + N)^-1 (r - m_r),     covariance C_xx - C_xr (C_rr + N)^-1 C_rx,

with m and C by d0, and N the voltages' noise. Where an electrode feels less than noise, an inverse hyperbolic sine replaces the
log. A link behind a pad reduces the pad's signals and the forearm's alike, so the pad's own field model accounts for it.

The points of all pads form one cloud: no pad's distance is larger than that to another pad's point (`fused`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.geometry.rigid import Array
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import Response

GAPS: Array = np.geomspace(0.003, 0.4, 48)
"""Gaps [m] of the reference forearm at which its signals are tabulated."""
NEAREST = 0.004
"""Smallest gap [m] for which the field models are fitted. Below it, the forearm's signals are extrapolated."""
ACROSS = (np.eye(3), np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
"""Orientations of the reference forearm: along the pad's x and y. Its signals are the geometric mean of the two."""
MODEL_ERROR = 0.02
"""Standard deviation of the error of field model and calibration at an electrode, as a share of its signal."""
DOUBT = np.square([0.05, 0.1, 0.1, 0.05])
"""Variances added to those of the statistics, for x: links behind pads, neighbouring pads, objects unlike all that were drawn.
Chosen by the squared errors over their variances on scenes of another seed than the results'."""
FAR_DOUBT, FAR = 0.1, 0.1
"""Standard deviation added to the log distance: FAR_DOUBT at FAR [m], growing with the power 3/2 of the distance, because a faint
signal says little about the shape. Chosen likewise."""
FELT = 6.0
"""Total signal of a pad, in standard deviations, above which it has a point. Chosen: with a lower threshold, only windows in
which noise adds to the signal have a point, and its distance is too small."""
STEEPEST = 0.95
"""Maximum sine of the angle between a pad's normal and the direction of its point."""
CONTRADICTION = 8.0
"""Root mean square of an electrode's deviation, in standard deviations of all shapes, above which its pad has no point because an
electrode is faulty. Chosen: no shape of `penumbra bench haptics --only-surface` reaches half of it."""
PRESSED_SHARE = 0.05
"""An electrode at the near end of its converter counts only if another one of its pad reads at least this share of the forearm's
signal at NEAREST. Measured: a rod of 3 cm that touches the middle gives 15 %; an electrode that is stuck there gives none."""


class SurfacePoint(NamedTuple):
    """The nearest surface point before a pad. position (3,): in the world; toward (3,): unit vector from the pad's middle to it,
    against the surface's normal; distance: from the pad's middle [m]; along, across: standard deviations in this direction and in
    each one across it [m]; gap: between the surface and the pad's board [m]."""

    pad: str
    position: Array
    toward: Array
    distance: float
    along: float
    across: float
    gap: float

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) [m^2] of the position."""
        return self.across**2 * np.eye(3) + (self.along**2 - self.across**2) * np.outer(self.toward, self.toward)


@dataclass(frozen=True)
class Shapes:
    """Statistics of objects of unknown shape on a pad's signals, by the gap d0 (m,) [m] of the forearm with the same total
    signal: mean (m, 4 + e) and covariance (m, 4 + e, 4 + e) of x and r (see above). error: root mean square error of log(d) on
    held-out shapes."""

    gaps: Array
    mean: Array
    covariance: Array
    error: float = 0.0

    @staticmethod
    def load(folder: Path, fingerprint: str) -> Shapes:
        """Load the statistics of a pad's design and target, as `shared.skin.response.fingerprint` names them without a link.
        Raises FileNotFoundError if the folder has none."""
        for path in sorted(folder.glob("shapes-*.npz")):
            with np.load(path) as data:
                if str(data["fingerprint"]) == fingerprint:
                    gaps, mean, covariance = (data[name].astype(np.float64) for name in ("gaps", "mean", "covariance"))
                    return Shapes(gaps, mean, covariance, float(data["error"]))
        raise FileNotFoundError(f"{folder}: expected a file shapes-*.npz of this pad's design; run `penumbra haptics shapes`")

    def at(self, gaps: Array) -> tuple[Array, Array]:
        """Mean (k, 4 + e) and covariance (k, 4 + e, 4 + e) at gaps (k,), interpolated in the log of the gap."""
        place = np.interp(np.log(gaps), np.log(self.gaps), np.arange(len(self.gaps)))
        low = np.minimum(place.astype(np.int64), len(self.gaps) - 2)
        share = place - low
        mean = self.mean[low] + share[:, None] * (self.mean[low + 1] - self.mean[low])
        return mean, self.covariance[low] + share[:, None, None] * (self.covariance[low + 1] - self.covariance[low])


def across(surface: Surface) -> list[Array]:
    """T_pad_target (4, 4) of the target's part around its origin, at each of GAPS, for each direction of ACROSS in turn."""
    poses = []
    for R in ACROSS:
        T = np.eye(4)
        T[:3, :3], T[2, 3] = R, 0.05
        for gap in np.maximum(GAPS, NEAREST):
            for _ in range(6):
                T[2, 3] += gap - float(surface.nearest((-T[:3, 3])[None] @ R)[0][0])
            poses.append(T.copy())
    return poses


def extended(logs: Array) -> Array:
    """Log signals (m, ...) at GAPS; those nearer than NEAREST are extrapolated linearly from the next ones."""
    known = int(np.searchsorted(GAPS, NEAREST * 1.001))
    slope = (logs[known + 2] - logs[known]) / math.log(GAPS[known + 2] / GAPS[known])
    near = np.log(GAPS[:known] / GAPS[known])
    return np.concatenate([logs[known] + near.reshape(-1, *(1,) * (logs.ndim - 1)) * slope, logs[known:]])


def forearm(skin: Skin, response: Response, surface: Surface) -> Array:
    """Log changes (m, p, e) [fF] of the target, at its own size, lying across each pad, at GAPS."""
    p = len(skin.pads)
    logs = np.log([response.change(np.tile(T, (p, 1, 1))) for T in across(surface)])
    return extended(logs.reshape(len(ACROSS), len(GAPS), p, -1).mean(axis=0))


class SurfacePoints:
    """Finds the surface points. skin, response: of one cell; surface: of its target; shapes: of its pads' design."""

    def __init__(self, skin: Skin, response: Response, surface: Surface, shapes: Shapes):
        self._pads, self._scale = skin.pads, skin.gain * skin.sensitivity
        self._noise, self._near_end = skin.noise, np.where(skin.polarity > 0.0, skin.full_scale - skin.a3, skin.a3)
        self._logs = forearm(skin, response, surface)
        self._changes = np.exp(self._logs)
        self._totals = self._changes.sum(axis=2)
        self._slopes = np.diff(self._logs, axis=0) / STEP
        self._touching = np.exp(self._logs[np.searchsorted(GAPS, NEAREST * 0.999)])
        self._mean, self._covariance = shapes.at(GAPS)
        self._farthest = FARTHEST_RANGES * float(skin.range.max())
        self._eye = np.eye(self._logs.shape[2])

    def find(self, signal: Array, variance: Array, pressed: NDArray[np.bool_], T_world_pads: Array) -> list[SurfacePoint]:
        """The fused points of the pads that feel something.

        signal, variance (n,): mean voltage less its rest [V] and its variance [V^2], infinite for electrodes to leave out;
        pressed (n,): electrodes at the near end of their converter, which feel that or more; T_world_pads (p, 4, 4).
        """
        e = len(self._eye)
        used = np.isfinite(variance).reshape(-1, e)
        if pressed.any():
            change = (np.where(pressed, self._near_end, signal) / self._scale).reshape(-1, e)
            share = np.where(used, change / self._touching, 0.0).max(axis=1)
            used = used | pressed.reshape(-1, e) & (share > PRESSED_SHARE)[:, None]
            variance = np.where(pressed, self._noise, variance)
        else:
            change = (signal / self._scale).reshape(-1, e)
        sigma = (np.sqrt(variance) / self._scale).reshape(-1, e)
        if not used.all():
            change, sigma = np.where(used, change, 0.0), np.where(used, sigma, 0.0)
        total = change.sum(axis=1)
        own = (total > FELT * np.sqrt((sigma * sigma).sum(axis=1))).nonzero()[0]
        if not len(own):
            return []
        found = self._estimated(own, change[own], sigma[own], used[own], total[own])
        return fused(self._pads, *found, T_world_pads, self._farthest) if len(found[0]) else []

    def _estimated(
        self, own: NDArray[np.intp], change: Array, sigma: Array, used: NDArray[np.bool_], total: Array
    ) -> tuple[NDArray[np.intp], Array, Array]:
        """The pads (k,) that have a point, its x (k, 4) in the pad's frame with d0 = 1 m, and the covariance."""
        place, logs, slopes = self._forearm_at(own, used, total)
        nearest = (place + 0.5).astype(np.int64)
        mean, C = self._mean[nearest], self._covariance[nearest]
        # r, and the derivatives of r by the log of the change, at the forearm's change
        model, twice = np.exp(logs), 2.0 * np.where(used, sigma, 1.0)
        r = np.arcsinh(change / twice) - np.arcsinh(model / twice)
        by_change = used / np.sqrt(model * model + twice * twice)
        slope = by_change * model
        # noise of log d0, by the total's slope, and of r, which contains it too
        by_total = used / (used * model * slopes).sum(axis=1)[:, None]
        A = self._eye * by_change[:, :, None] - (slope * slopes)[:, :, None] * by_total[:, None]
        noise = sigma * sigma
        noisy = A * noise[:, None]
        # an electrode that is left out has its own error and no effect on x
        own_error = self._eye * np.where(used, MODEL_ERROR**2, 1.0)[:, None]
        Crr = slope[:, :, None] * C[:, X:, X:] * slope[:, None] + noisy @ A.transpose(0, 2, 1) + own_error
        Cxr = C[:, :X, X:] * slope[:, None]
        Cxr[:, SCALES] -= (noisy * by_total[:, None]).sum(axis=2)[:, None]
        left = used * (r - slope * mean[:, X:])
        solved = np.linalg.solve(Crr, np.concatenate([left[:, :, None], Cxr.transpose(0, 2, 1)], axis=2))
        explained = Cxr @ solved
        x = mean[:, :X] + explained[:, :, 0]
        x[:, SCALES] += (LOG_NEAREST + place * STEP)[:, None]
        covariance = C[:, :X, :X] + DOUBTS - explained[:, :, 1:]
        lasting = FAR_DOUBT**2 * (np.exp(x[:, 0]) / FAR) ** 3
        covariance[:, SCALES_2[0], SCALES_2[1]] += ((by_total * by_total * noise).sum(axis=1) + lasting)[:, None, None]
        keep = (left * solved[:, :, 0]).sum(axis=1) < CONTRADICTION**2 * used.sum(axis=1)
        return (own, x, covariance) if keep.all() else (own[keep], x[keep], covariance[keep])

    def _forearm_at(self, own: NDArray[np.intp], used: NDArray[np.bool_], total: Array) -> tuple[Array, Array, Array]:
        """For pads (k,): the position (k,) among GAPS where the forearm gives their totals [fF] on the electrodes in use (k, e),
        the logs (k, e) of its changes there and their slopes (k, e) by the gap's log."""
        totals = self._totals[:, own] if used.all() else (self._changes[:, own] * used).sum(axis=2)
        low = np.minimum(np.maximum((totals > total).sum(axis=0) - 1, 0), len(GAPS) - 2)
        at = totals[low, np.arange(len(own))]
        slopes = self._slopes[low, own]
        beyond = np.log(total / at) / (np.log(totals[low + 1, np.arange(len(own))] / at))
        beyond = np.minimum(np.maximum(beyond, 0.0), 1.0)
        return low + beyond, self._logs[low, own] + (beyond * STEP)[:, None] * slopes, slopes


STEP = float(np.log(GAPS[1] / GAPS[0]))
"""Spacing of GAPS in log gap."""
DOUBTS = np.diag(DOUBT)
LOG_NEAREST = float(np.log(GAPS[0]))
X, SCALES = 4, np.array([0, 3])
SCALES_2 = np.ix_(SCALES, SCALES)
"""Length of x, its components that are logs of distances, and their indices in a covariance."""
FARTHEST_RANGES = 4.0 / 3.0
"""Maximum distance of reported points, as a share of the pads' range: 20 cm for a range of 15 cm."""


def fused(
    pads: tuple[str, ...], own: NDArray[np.intp], x: Array, covariance: Array, T_world_pads: Array, farthest: float
) -> list[SurfacePoint]:
    """The points of pads `own` (k,) as one cloud, from their x (k, 4) with d0 = 1 m and its covariances (k, 4, 4).

    A pad's point is the nearest on a surface that also holds the other pads' points, so its distance is at most that to each of
    them. A normal distribution truncated by such a bound, itself normal, has the moments of Azzalini (1985), section 2. Points
    beyond `farthest` [m] are left out.
    """
    distance = np.exp(x[:, 0])
    u, C = x[:, 1:3], covariance[:, 1:3, 1:3]
    sine2 = (u * u).sum(axis=1)
    if sine2.max() > STEEPEST**2:
        u = u * np.minimum(1.0, STEEPEST / np.sqrt(np.maximum(sine2, 1e-9)))[:, None]
        sine2 = np.minimum(sine2, STEEPEST**2)
    rise2 = 1.0 - sine2
    toward = (T_world_pads[own, :3, :3] @ np.concatenate([u, np.sqrt(rise2)[:, None]], axis=1)[:, :, None])[:, :, 0]
    middles = T_world_pads[own, :3, 3]
    along2 = distance * distance * covariance[:, 0, 0]
    turned = C[:, 0, 0] + C[:, 1, 1] + (u * (C @ u[:, :, None])[:, :, 0]).sum(axis=1) / rise2
    across2 = 0.5 * distance * distance * turned
    factor, narrower = _bounded(middles, toward, distance, along2, across2)
    # only the distance changes; the direction stays
    nearer = factor * distance
    points = middles + nearer[:, None] * toward
    gaps = np.minimum(factor * np.exp(x[:, 3]), nearer)
    numbers = np.array([nearer, narrower * np.sqrt(along2), np.sqrt(across2), gaps]).T.tolist()
    return [
        SurfacePoint(pads[k], points[i], toward[i], *numbers[i]) for i, k in enumerate(own.tolist()) if numbers[i][0] < farthest
    ]


def _bounded(middles: Array, toward: Array, distance: Array, along2: Array, across2: Array) -> tuple[Array, Array]:
    """Factors (k,) on distances (k,) [m] and on their standard deviations, when no distance exceeds that to another pad's point.

    middles, toward (k, 3): of pads, and unit vectors from there to their points; along2, across2 (k,) [m^2]: variances of the
    points. The points have common errors (the shape), so only the tightest bound counts, widened by a standard deviation.
    """
    if len(distance) < 2:
        return np.ones(len(distance)), np.ones(len(distance))
    to = (middles + distance[:, None] * toward)[None] - middles[:, None]
    bound = np.sqrt((to * to).sum(axis=2))
    cosine = (to * toward[None]).sum(axis=2) / np.maximum(bound, 1e-9)
    doubt = np.sqrt(across2 + (along2 - across2) * cosine * cosine)
    reach = bound + doubt
    j = np.arange(len(distance))
    reach[j, j] = np.inf
    k = reach.argmin(axis=1)
    total = np.sqrt(along2 + doubt[j, k] ** 2)
    z = np.maximum((reach[j, k] - distance) / total, -6.0)
    below = np.array([math.erfc(-each) for each in (z / math.sqrt(2.0)).tolist()])
    pull = np.exp(-0.5 * z * z) * (2.0 / math.sqrt(2.0 * math.pi)) / below
    factor = 1.0 - along2 / total * pull / distance
    narrower = 1.0 - along2 / (total * total) * pull * (z + pull)
    return np.maximum(factor, 0.05), np.sqrt(np.maximum(narrower, 0.05))
