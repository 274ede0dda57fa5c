"""The default search: least squares between the mesh's occluding contour and the boundary of the mask.

One pass, from a pose T_camera_target:
  1. project the mesh; its occluding contour are the edges between a face seen from the front and one seen from behind (`trace`);
  2. keep the points on the outside of the silhouette and outside everything that covers the target;
  3. from each, walk along the contour's normal to the mask's boundary: the offset r [px] (`match`);
  4. solve the damped normal equations for the pose error and for the mask's dilation b, r = J e + b + noise.
The passes are Levenberg-Marquardt with Huber's weights, from coarse to fine. What is hidden is dropped and not scored.

The covariance is that of the measurement alone. Neighbouring points of a mask's boundary err together, so the contour counts as
one independent point per correlation length; the dilation b is a nuisance with a prior of its own and is marginalised, because
half a pixel around the limb looks like centimetres of depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.search.contour import Model, match, normal_equations, trace
from services.search.evidence import Evidence, compare
from shared import geometry, raster

Array = NDArray[np.float64]

SPACING_PX = 3.0
"""Distance of the sampled contour points: closer ones bring no new information."""


@dataclass(frozen=True)
class Noise:
    """How a mask's boundary errs, in pixels of the mask.

    `edge`: standard deviation along the normal; `correlation`: length along the contour over which errors are one error;
    `dilation`: standard deviation of the whole mask's being too large or small; `joint`: deviation [m] of the border with
    the limb's next part, which is one error along its whole length. Defaults: a trained network's masks.
    """

    edge: float = 0.5
    correlation: float = 14.0
    dilation: float = 0.3
    joint: float = 0.015


@dataclass(frozen=True)
class Limits:
    """Standard deviations of position [m] and rotation [rad] of a direction that the contour does not show: the weak prior
    that keeps the solve regular, and the largest deviations published."""

    position: float = 0.5
    rotation: float = 0.5

    @property
    def covariance(self) -> Array:
        return np.diag([self.position**2] * 3 + [self.rotation**2] * 3)

    @property
    def information(self) -> Array:
        return np.diag([self.position**-2.0] * 3 + [self.rotation**-2.0] * 3)


STAGES = ((24.0, 5.0, 5), (8.0, 2.0, 7))
"""(reach of the walk [px], Huber's threshold [px], passes at most), from coarse to fine."""
CONVERGED = 5e-4
"""A pass that moves less than this [m], and four times it [rad], is the last of its stage."""
MAX_STEP = np.array([0.06, 0.06, 0.10, 0.25, 0.25, 0.25])
"""Largest step of a pass [m, rad]: beyond it the points matched belong to other parts of the contour."""
DAMPING = (1e-3, 10.0, 1e2)
"""Marquardt's factor at the start, its change after a pass that gained or lost, and where the search gives up."""


@dataclass(frozen=True)
class Fit:
    """T_camera_target with its 6 x 6 covariance along the camera's axes; `T_searched`: where contour and mask were compared;
    `length`: pixels of contour that were measured; `rms`: their offset left [px]; `dilation`: the mask's estimated dilation [px];
    `cost`: chi^2 of contour, dilation and prior together; `both`, `either`, `free`: see `compare`."""

    T: Array
    covariance: Array
    T_searched: Array
    length: float
    rms: float
    dilation: float
    cost: float
    both: int
    either: int
    free: int

    @property
    def overlap(self) -> float:
        """Of the pixels that are scored: those of both the mask's target and the silhouette, as a share of those of either."""
        return self.both / self.either if self.either else 0.0


@dataclass(frozen=True)
class _Pass:
    """One pose (as pose error from the prior, and dilation) and the normal equations of the contour there."""

    T: Array
    moved: Array
    H: Array
    g: Array
    length: float
    square: float
    cost: float
    counts: tuple[int, int, int]


def fit(
    model: Model,
    T_start: Array,
    evidence: Evidence,
    T_prior: Array | None = None,
    prior: Array | None = None,
    noise: Noise | None = None,
    limits: Limits | None = None,
) -> Fit:
    """The pose T_camera_target whose contour lies on the mask's boundary, searched from T_start (4 x 4).

    `prior` (6, 6) is the information about T_prior (T_start where None) along the camera's axes. It keeps the solve near where
    the contour says little, and is taken out of the result again: `Fit.T` and `Fit.covariance` are the measurement's alone.
    """
    noise, limits = noise or Noise(), limits or Limits()
    weak = limits.information
    regular = np.zeros((7, 7))
    regular[:6, :6] = weak if prior is None else prior + weak
    regular[6, 6] = noise.dilation**-2

    def at(T: Array, moved: Array, reach: float, huber: float, bounded: bool) -> _Pass:
        k = evidence.intrinsics
        intrinsics = (k.fx, k.fy, k.cx, k.cy)
        V = model.in_camera(T)
        silhouette = raster.silhouette(V, model.faces, intrinsics, (0, 0, *evidence.state.shape[::-1]))
        points = trace(V, model.faces, model.edges, *intrinsics, silhouette, SPACING_PX)
        r, kind = match(points, evidence.field, evidence.state, evidence.guarded, reach)
        weights = (noise.edge, noise.correlation, noise.joint, huber, bounded)
        H, g, length, square, cost = normal_equations(points, r - moved[6], kind, T[:3, 3], k.fx, k.fy, *weights)
        counts = compare(evidence.state, silhouette)
        # parts of the mask that no contour is near pull at nothing, but must not look cheap
        unexplained = (counts[1] - counts[2] - counts[0]) / (noise.correlation * noise.edge)
        return _Pass(T, moved, H, g, length, square, cost + unexplained + float(np.dot(moved, regular @ moved)), counts)

    T, moved = T_start, np.zeros(7)
    if T_prior is not None:
        moved[:6] = geometry.pose_error(T_start, T_prior)
    for reach, huber, passes in STAGES:
        here, damping = at(T, moved, reach, huber, True), DAMPING[0]
        for _ in range(passes):
            information = here.H + regular
            step = np.linalg.solve(information + damping * np.diag(np.diag(information)), here.g - regular @ here.moved)
            step *= min(1.0, float(np.min(MAX_STEP / np.maximum(np.abs(step[:6]), 1e-12))))
            there = at(geometry.perturb(here.T, step[:6]), here.moved + step, reach, huber, True)
            if there.cost < here.cost:
                here, damping = there, damping / DAMPING[1]
            else:
                damping *= DAMPING[1]
            if (np.abs(step[:3]).max() < CONVERGED and np.abs(step[3:6]).max() < 4.0 * CONVERGED) or damping > DAMPING[2]:
                break
        T, moved = here.T, here.moved

    last = at(T, moved, reach, huber, False)  # the pose is final: only what was measured informs
    H, g = last.H, last.g
    rms = math.sqrt(last.square / last.length) if last.length > 0 else math.inf
    if last.length > 0 and rms > noise.edge:  # a mask worse than expected: believe its residuals
        H, g = H * (noise.edge / rms) ** 2, g * (noise.edge / rms) ** 2
    # the dilation is marginalised (Schur complement), and the prior left out
    gain = H[:6, 6] / (H[6, 6] + regular[6, 6])
    covariance = np.linalg.inv(H[:6, :6] - np.outer(gain, H[6, :6]) + weak)
    offset = covariance @ (g[:6] - gain * (g[6] - regular[6, 6] * moved[6]) - weak @ moved[:6])
    covariance = (covariance + covariance.T) / 2.0
    return Fit(geometry.perturb(T, offset), covariance, T, last.length, rms, float(moved[6]), last.cost, *last.counts)
