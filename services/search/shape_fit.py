"""Fits a limb that is not quite the mesh.

A person's forearm has its own muscles, sleeves and dimensions. Its contour lies millimetres beside the mesh's, which at close
range are several pixels: more than the error of a mask, and more than an edge in the image may be off. So if no pose of the mesh
explains the mask, the difference is attributed to the shape. The surface deviates from the mesh's by `Fit.shape`, a standard
deviation that follows from the remaining offsets. Its errors are shared over the length BULGE along the limb, on either side in
slow waves, by a size that is not this person's, and by a hand that is bent as a whole. All of this is in the covariance: without
a girth the distance is not certain, but the limb's direction and its place in the picture are known as well as before.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from penumbra.services.search.contour import DROPPED, MEASURED, Model, slow_waves, stretched
from penumbra.services.search.evidence import Evidence
from penumbra.services.search.mask_fit import (
    BENT,
    CONVERGED,
    FINE,
    LEAST_ARM_PX,
    MOST_BENT,
    Fit,
    Limits,
    Noise,
    Pass,
    Problem,
    marginal,
    overlap_of,
)
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

REACH, HUBER = 3.0, 2.0
"""Reach of the walk and Huber's threshold, in standard deviations of the contour."""
FARTHEST = 24.0
"""Maximum length of the walk [px]: other things lie beyond it."""
BULGE = 0.04
"""Length [m] along a limb over which its surface shares its error: that of a muscle's belly, or of a fold of a sleeve."""
UNLIKE = 2.0
"""Factor on the resulting standard deviations: people differ from the mesh in more ways. Without it, the errors of distance,
place across the line of sight and tilt of 57 people with exact masks and bent hands (0.8 m, found without a prediction) have an
RMS of 2.2, 2.0 and 2.6 standard deviations."""
ROUNDS = 4
"""Number of rounds, each of which estimates the pose and then the shape."""


def fit_shape(
    model: Model,
    first: Fit,
    evidence: Evidence,
    T_prior: Array,
    prior: Array,
    size_spread: Array,
    noise: Noise | None = None,
    limits: Limits | None = None,
) -> Fit:
    """The pose near `first` of a limb whose surface differs from the mesh's, with the size of the difference.

    `prior` (6, 6): information about T_prior (4 x 4) along the camera's axes, removed from the result as by `mask_fit.fit`;
    size_spread (2,): standard deviations of log length and log girth about the mesh's.
    """
    noise, limits = noise or Noise(), limits or Limits()
    px_per_m = evidence.intrinsics.fx / max(float(first.T_searched[2, 3]), 1e-3)
    regular = np.zeros((7, 7))
    regular[:6, :6] = prior + limits.information
    T, moved, sigma, hand = first.T_searched, np.zeros(7), FINE[0] / REACH, first.hand
    moved[:6] = rigid.pose_error(T, T_prior)
    for _ in range(ROUNDS):
        regular[6, 6] = 1.0 / (noise.dilation**2 + sigma**2)
        problem = Problem(model, evidence, replace(noise, edge=sigma), regular, CONVERGED)
        problem.hand = hand
        stage = min(max(FINE[0], REACH * sigma), FARTHEST), HUBER * sigma, FINE[2]
        here = problem.fine(problem.at(T, moved, *stage[:2]), stage)
        T, moved = here.T, here.moved
        sigma, hand = _spreads(here, model.wrist, problem.hand, noise.edge, stage[1])

    problem.noise = replace(noise, edge=sigma, correlation=max(noise.correlation, BULGE * px_per_m))
    measured = problem.normal_equations(T, here.points, here.r, here.kind, HUBER * sigma, False)
    shapes = [sigma * wave for wave in slow_waves(here.points, T)]
    sizes = [spread * off for spread, off in zip(size_spread, stretched(here.points, T, evidence.intrinsics), strict=True)]
    length, beyond = _lengths(here, model.wrist, problem.hand)
    bends = [np.where(beyond, problem.hand * sigma * here.points["normal"][:, i], 0.0) for i in (0, 1)]
    errors = [problem.normal_equations(T, here.points, r, here.kind, math.inf, False).g for r in (*shapes, *sizes, *bends)]
    both, free, overlap = overlap_of(model, T, evidence, hand)
    rolls = measured.rolls if hand < BENT else None
    T_measured, covariance = marginal(T, moved, measured.H, measured.g, regular, rolls, limits, np.stack(errors, axis=1))
    arm_px = float(np.sum(length[~beyond & (here.kind != DROPPED)]))
    return replace(
        first,
        T=T_measured,
        covariance=UNLIKE**2 * covariance,
        T_searched=T,
        points=_measured_px(here, model.wrist, problem.hand) / noise.correlation,
        rms=math.sqrt(measured.square / measured.length) if measured.length > 0 else math.inf,
        dilation=float(moved[6]),
        cost=2.0 * arm_px / problem.noise.correlation * math.log(sigma / noise.edge),
        both=both,
        free=free,
        overlap=overlap,
        hand=hand,
        shape=math.sqrt(max(sigma**2 - noise.edge**2, 0.0) + moved[6] ** 2) / px_per_m,
    )


def _measured_px(here: Pass, wrist: float, hand: float) -> float:
    """The length of the measured contour [px], a bent hand included: that says little about the pose, but shows a limb."""
    return float(np.sum(_lengths(here, wrist, hand)[0] * (here.kind == MEASURED)))


def _lengths(here: Pass, wrist: float, hand: float) -> tuple[Array, NDArray[np.bool_]]:
    """The length of contour [px] that each point represents, and whether it lies beyond the wrist."""
    beyond = (here.points["position"] - here.T[:3, 3]) @ here.T[:3, 0] > wrist
    return here.points["length"] * np.where(beyond, hand**2, 1.0), beyond


def _spreads(here: Pass, wrist: float, hand: float, least: float, huber: float) -> tuple[float, float]:
    """The standard deviation [px] of the offsets of the forearm's contour, at least `least`, and the ratio of the hand's to it;
    if hardly any of the forearm is visible, the standard deviation of both, and 1. An offset beyond Huber's threshold counts
    linearly."""
    length, beyond = _lengths(here, wrist, hand)
    length = np.where(here.kind == DROPPED, 0.0, length)
    r = np.abs(here.r)
    square = length * np.where(r <= huber, r**2, huber * (2.0 * r - huber))
    arm_px, hand_px = float(length[~beyond].sum()), float(length[beyond].sum())
    if arm_px < LEAST_ARM_PX:
        return max(least, math.sqrt(float(square.sum()) / max(arm_px + hand_px, 1e-9))), 1.0
    arm = max(least, math.sqrt(float(square[~beyond].sum()) / arm_px))
    bent = math.sqrt(float(square[beyond].sum()) / max(hand_px, 1e-9)) / arm
    return arm, min(max(bent, 1.0), MOST_BENT)
