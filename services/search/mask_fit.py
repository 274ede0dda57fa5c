"""The default search: least squares between the mesh's occluding contour and the boundary of the mask.

One pass, from a pose T_camera_target:
  1. project the mesh; its occluding contour consists of the edges between a front face and a back face (`contour._trace`);
  2. keep the points on the outside of the silhouette and outside everything that covers the target;
  3. from each, walk along the contour's normal to the mask's boundary: the offset r [px] (`contour._match`);
  4. solve the damped normal equations for the pose error e and the mask's dilation b, r = J e + b + noise.
The passes are Levenberg-Marquardt with Huber's weights. If the start fits badly, coarse passes with a longer walk come
first. Hidden parts are dropped and not scored.

The mesh's hand is stiff, and people bend theirs. If the hand's contour fits much worse than the forearm's, its offsets count as
more uncertain by that factor, and the last passes are repeated.

The covariance is that of the measurement alone. Neighbouring points of a mask's boundary share their errors, so the contour
counts as one independent point per correlation length. The dilation b is a nuisance parameter with its own prior and is
marginalised, because half a pixel around the limb looks like centimetres of depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from penumbra.services.search.contour import DROPPED, Equations, Model, Points, normal_equations
from penumbra.services.search.evidence import TARGET, Evidence, compare
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

SPACING_PX = 3.0
"""Spacing [px] of the sampled contour points: closer ones add no information."""


@dataclass(frozen=True)
class Noise:
    """Errors of a mask's boundary, in pixels of the mask.

    `edge`: standard deviation along the normal; `correlation`: length along the contour over which points share their error;
    `dilation`: standard deviation of the dilation of the whole mask. Defaults: for a trained network's masks, chosen and not
    measured.
    """

    edge: float = 0.5
    correlation: float = 14.0
    dilation: float = 0.3


@dataclass(frozen=True)
class Limits:
    """Standard deviations of position [m] and rotation [rad] along directions that the contour does not show: the weak prior that
    keeps the solve regular, and the maximum that is published."""

    position: float = 1.0
    rotation: float = 1.5

    @property
    def covariance(self) -> Array:
        return np.diag([self.position**2] * 3 + [self.rotation**2] * 3)

    @property
    def information(self) -> Array:
        return np.diag([self.position**-2.0] * 3 + [self.rotation**-2.0] * 3)


COARSE = (24.0, 5.0, 4)
"""Reach of the walk [px], Huber's threshold [px] and maximum number of passes, for a start that may be far off."""
FINE = (8.0, 2.0, 8)
"""The same for the passes that end a fit."""
CONVERGED = 1e-3
"""Step [m] below which a fit ends if no refinement on the image follows."""
ROUGH = 4e-3
"""Step [m] below which a fit ends if the image refines it: a pixel or two."""
MAX_STEP = np.array([0.06, 0.06, 0.10, 0.25, 0.25, 0.25])
"""Maximum step of a pass [m, rad]: beyond it, the matched points belong to other parts of the contour."""
DAMPING = (1e-3, 10.0, 1e2)
"""Marquardt's factor at the start, its change after a pass that lowered the cost or did not, and the factor above which passes
end."""
BENT, MOST_BENT = 2.0, 8.0
"""Ratio of the offsets of the hand's contour to the forearm's from which the hand counts as bent, unlike the mesh's stiff one,
and the maximum of this ratio as a factor on the hand's standard deviation."""
LEAST_ARM_PX = 30.0
"""Minimum length [px] of the forearm's contour: with less, the hand counts as straight."""
BENDS = 3
"""Maximum number of times that the fit is repeated for a bent hand."""
KEPT = 0.05
"""Share of the prior's information that stays in the measurement: without any, directions that the contour hardly shows would be
extrapolated far beyond the linear range."""
GOOD = 2.0
"""Maximum `Fit.misfit` of nearly all right fits."""
MISFIT = 3.0
"""`Fit.misfit` that one in a hundred right fits, and most wrong ones, exceed."""


@dataclass(frozen=True)
class Fit:
    """T_camera_target with its 6 x 6 covariance along the camera's axes; `T_searched`: pose at which contour and mask were
    compared; `points`: number of independent contour points that were measured; `rms`: of their remaining offsets [px];
    `dilation`: the mask's estimated dilation [px]; `misfit`: the mask's cost per measurement, 1 to 3 for right poses; `both`,
    `free`: see `evidence.compare`; `overlap`: see `overlap_of`; `hand`: ratio of the uncertainty of the hand's contour to that of
    the forearm's (`Problem.bent`); `sharp`: whether the image has edges along the contour (`image_fit.fit_image`); `shape`:
    standard deviation of the limb's surface from the mesh's [m], if the contour was fitted with one (`shape_fit.fit_shape`).

    `cost`: chi^2 of contour, dilation and prior; after `fit_image`, of the contour alone, in the mask's pixels; with a `shape`,
    of the forearm's contour, with errors estimated from its remaining offsets."""

    T: Array
    covariance: Array
    T_searched: Array
    points: float
    rms: float
    dilation: float
    cost: float
    misfit: float
    both: int
    free: int
    overlap: float
    hand: float = 1.0
    sharp: bool = False
    shape: float | None = None


def overlap_of(model: Model, T: Array, evidence: Evidence, hand: float) -> tuple[int, int, float]:
    """Numbers of pixels of the silhouette at T_camera_target that show the target, and that are free (`evidence.compare`), and
    the intersection over union of the silhouette and the mask's target among scored pixels, in [0, 1]; a pixel beyond the wrist
    counts 1 / hand."""
    state = evidence.state
    shown = model.silhouette(T, evidence.intrinsics, (0, 0, *state.shape[::-1]))
    both, free = compare(state, shown)
    if hand == 1.0:
        return both, free, both / max(evidence.seen_px + free, 1)
    beyond = model.beyond_wrist(T, evidence.intrinsics, state.shape)
    both_hand, free_hand = compare(state[beyond][None], shown[beyond][None])
    seen_hand, less = int(np.count_nonzero(state[beyond] == TARGET)), 1.0 - 1.0 / hand
    either = evidence.seen_px + free - less * (seen_hand + free_hand)
    return both, free, (both - less * both_hand) / max(either, 1.0)


def hand_differs(model: Model, T: Array, evidence: Evidence) -> int:
    """Number of pixels beyond the wrist, of a limb at T_camera_target, that only its silhouette or only the mask's target covers;
    zero where the limb points at the camera."""
    state = evidence.state
    beyond = model.beyond_wrist(T, evidence.intrinsics, state.shape)
    shown, seen = model.silhouette(T, evidence.intrinsics, (0, 0, *state.shape[::-1]))[beyond], state[beyond]
    both, free = compare(seen[None], shown[None])
    return int(np.count_nonzero(seen == TARGET)) - both + free


@dataclass(frozen=True)
class Pass:
    """The contour at one pose, which is `moved` (7,) from the prior: pose error and dilation."""

    T: Array
    moved: Array
    points: Points
    r: Array
    kind: NDArray[np.uint8]
    H: Array
    g: Array
    cost: float


class Problem:
    def __init__(self, model: Model, evidence: Evidence, noise: Noise, regular: Array, converged: float):
        self.model, self.evidence, self.noise, self.regular, self.converged = model, evidence, noise, regular, converged
        self.hand = 1.0

    def at(self, T: Array, moved: Array, reach: float, huber: float) -> Pass:
        evidence = self.evidence
        found = self.model.matched(T, evidence, SPACING_PX, reach, self.hand)
        r, both = found.r - moved[6], found.both
        equations = self.normal_equations(T, found.points, r, found.kind, huber, True)
        # parts of the mask without a contour nearby do not pull, but must not lower the cost; nor must points that drop out
        unexplained = (evidence.seen_px - both) / (self.noise.correlation * self.noise.edge)
        cost = equations.cost * evidence.boundary_px / max(equations.counted, 1.0) + unexplained
        cost += float(np.dot(moved, self.regular @ moved))
        return Pass(T, moved, found.points, r, found.kind, equations.H, equations.g, cost)

    def normal_equations(
        self, T: Array, points: Points, r: Array, kind: NDArray[np.uint8], huber: float, bounded: bool
    ) -> Equations:
        noise, k = self.noise, self.evidence.intrinsics
        weights = points["length"] / (noise.correlation * noise.edge**2)
        return normal_equations(points, r, kind, weights, T[:3, 3], T[:3, 0], k.fx, k.fy, huber, bounded)

    def bent(self, here: Pass) -> tuple[float, float]:
        """Ratio of the offsets of the hand's contour to the forearm's, from 1 to MOST_BENT, and the length of the hand's contour
        [px]; the ratio is 1 if too little of the forearm is visible, or if it is below BENT."""
        points = here.points
        beyond = (points["position"] - here.T[:3, 3]) @ here.T[:3, 0] > self.model.wrist
        length = np.where(here.kind == DROPPED, 0.0, points["length"]) * np.where(beyond, self.hand**2, 1.0)
        hand_px, arm_px = float(length[beyond].sum()), float(length[~beyond].sum())
        if arm_px < LEAST_ARM_PX or hand_px == 0.0:
            return 1.0, hand_px
        square = length * here.r**2
        arm = max(math.sqrt(square[~beyond].sum() / arm_px), self.noise.edge)
        ratio = math.sqrt(square[beyond].sum() / hand_px) / arm
        return (1.0 if ratio < BENT else min(ratio, MOST_BENT)), hand_px

    def loosened(self, here: Pass) -> tuple[Pass, float]:
        """The last pass of a fit after adapting the hand's uncertainty to its offsets, and the cost of this: the logarithm of a
        Gaussian's width, so that a pose that explains the hand wins over one that does not."""
        hand_px = 0.0
        for _ in range(BENDS):
            hand, hand_px = self.bent(here)
            if abs(hand - self.hand) < 0.2 * self.hand:
                break
            self.hand = hand
            here = self.fine(self.at(here.T, here.moved, *FINE[:2]))
        return here, 2.0 * math.log(self.hand) * hand_px / self.noise.correlation

    def coarse(self, T: Array, moved: Array) -> tuple[Array, Array]:
        """The pose and its distance from the prior after coarse steps, which are all taken, as each changes the matched
        points."""
        reach, huber, passes = COARSE
        for _ in range(passes):
            step = self.step(self.at(T, moved, reach, huber), 0.0)
            T, moved = rigid.perturb(T, step[:6]), moved + step
            if _small(step, self.converged):
                break
        return T, moved

    def fine(self, here: Pass, stage: tuple[float, float, int] = FINE) -> Pass:
        """The best pose nearby, by Levenberg-Marquardt."""
        (reach, huber, passes), damping = stage, DAMPING[0]
        for _ in range(passes):
            step = self.step(here, damping)
            there = self.at(rigid.perturb(here.T, step[:6]), here.moved + step, reach, huber)
            if there.cost < here.cost:
                here, damping = there, damping / DAMPING[1]
            else:
                damping *= DAMPING[1]
            if _small(step, self.converged) or damping > DAMPING[2]:
                break
        return here

    def step(self, here: Pass, damping: float) -> Array:
        information = here.H + self.regular
        information[_DIAGONAL] *= 1.0 + damping
        step = np.linalg.solve(information, here.g - self.regular @ here.moved)
        return np.asarray(step / max(1.0, float(np.max(np.abs(step[:6]) / MAX_STEP))), np.float64)


_DIAGONAL = np.diag_indices(7)


def fit(
    model: Model,
    T_start: Array,
    evidence: Evidence,
    T_prior: Array | None = None,
    prior: Array | None = None,
    noise: Noise | None = None,
    limits: Limits | None = None,
    converged: float = CONVERGED,
) -> Fit:
    """The pose T_camera_target whose contour lies on the mask's boundary, searched from T_start (4 x 4).

    `prior` (6, 6): information about T_prior (T_start if None) along the camera's axes. It keeps the solve near the prior where
    the contour gives little information, and is removed from the result: `Fit.T` and `Fit.covariance` are the measurement's
    alone. `converged`: a pass that moves less than this [m], and four times this [rad], is the last of its stage.
    """
    noise, limits = noise or Noise(), limits or Limits()
    weak = limits.information
    regular = np.zeros((7, 7))
    regular[:6, :6] = weak if prior is None else prior + weak
    regular[6, 6] = noise.dilation**-2
    problem = Problem(model, evidence, noise, regular, converged)

    start = np.zeros(7)
    if T_prior is not None:
        start[:6] = rigid.pose_error(T_start, T_prior)
    independent = evidence.measurements(noise.correlation)
    here = problem.at(T_start, start, *FINE[:2])
    if here.cost > GOOD * independent:  # the start may be too far away for the short walk
        there = problem.at(*problem.coarse(T_start, start), *FINE[:2])
        here = min(here, there, key=lambda one: one.cost)
    here, loose = problem.loosened(problem.fine(here))
    cost = here.cost + loose

    # the pose is final: only measured points give information
    moved = here.moved
    measured = problem.normal_equations(here.T, here.points, here.r, here.kind, FINE[1], False)
    length = measured.length
    rms = math.sqrt(measured.square / length) if length > 0 else math.inf
    misfit = cost / independent
    # if the mask or the fit is worse than expected, the residuals set the noise
    trust = 1.0 / max(1.0, (rms / noise.edge) ** 2 if length > 0 else 1.0, misfit / MISFIT)
    both, free, overlap = overlap_of(model, here.T, evidence, problem.hand)
    rolls = measured.rolls if problem.hand == 1.0 else None
    T, covariance = marginal(here.T, moved, measured.H * trust, measured.g * trust, regular, rolls, limits)
    return Fit(
        T, covariance, here.T, length / noise.correlation, rms, float(moved[6]), cost, misfit, both, free, overlap, problem.hand
    )  # fmt: skip


def marginal(
    T: Array, moved: Array, H: Array, g: Array, regular: Array, rolls: float | None, limits: Limits, waves: Array | None = None
) -> tuple[Array, Array]:
    """The pose and covariance (6, 6) of the measurement alone, from the normal equations of pose error and dilation at T, which
    is `moved` (7,) from the prior. The prior in `regular` (7, 7) is removed except for the share KEPT, and the dilation is
    marginalised (Schur complement).

    `rolls`: share of the information about the roll that is used, see `normal_equations`; None for a bent hand, which may be a
    straight one at another roll; `waves` (7, k): right sides of errors of one standard deviation that the whole contour shares.
    """
    gain = H[:6, 6] / (H[6, 6] + regular[6, 6])
    weak = (1.0 - KEPT) * limits.information + KEPT * regular[:6, :6]
    covariance = np.linalg.inv(H[:6, :6] - np.outer(gain, H[6, :6]) + weak)
    offset = covariance @ (g[:6] - gain * (g[6] - regular[6, 6] * moved[6]) - weak @ moved[:6])
    if waves is not None:
        bent = covariance @ (waves[:6] - np.outer(gain, waves[6]))
        covariance = covariance + bent @ bent.T
    covariance = (covariance + covariance.T) / 2.0
    if rolls is None:  # a bent hand makes only the forearm's roll uncertain
        covariance[3:, 3:] += limits.rotation**2 * np.outer(T[:3, 0], T[:3, 0])
    else:  # the roll of a nearly round section is uncertain, and so is all that is correlated with it
        c = covariance[:, 3:] @ T[:3, 0]
        roll = float(T[:3, 0] @ c[3:])
        covariance += min(1.0 / max(rolls, 1e-9) - 1.0, limits.rotation**2 / roll) * np.outer(c, c) / roll
    return rigid.perturb(T, offset), covariance


def with_prior(T: Array, covariance: Array, T_prior: Array, prior: Array) -> Array:
    """The most probable pose of a measurement T with its covariance (6, 6) and of a prior with its information (6, 6)."""
    information = np.linalg.inv(covariance)
    return rigid.perturb(T_prior, np.linalg.solve(information + prior, information @ rigid.pose_error(T, T_prior)))


def _small(step: Array, converged: float) -> bool:
    return bool(np.abs(step[:3]).max() < converged and np.abs(step[3:6]).max() < 4.0 * converged)
