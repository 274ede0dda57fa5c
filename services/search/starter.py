"""First poses of a forearm from landmarks in the picture: elbow, wrist and knuckles.

They are used for a lost target, beside the hypotheses of `detect.py`, which know only its mask. The hand is attached by a
wrist with two angles, as a bent hand would otherwise pull the forearm aside. A forearm that points to the camera and one that
points away look the same except for perspective: both are returned.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from penumbra.shared.cell.description import Body, Camera, Target
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.limbs import KNUCKLES, Limb

TO_KNUCKLES = 0.47
"""Distance of the knuckles from the wrist as a share of the hand's length."""
ACROSS = (0.36, 0.12, -0.12, -0.36)
"""Positions of the knuckles from index to little finger across the hand, in breadths of the hand, towards the thumb."""
ELBOW, WRIST, KNUCKLE = 0.35, 0.12, 0.1
"""Standard deviations of the landmarks, in distances from the wrist to the knuckles: measured on photographs, the elbow's with
the body's model, the others with the hand's; the rest is the variation of bodies."""
BENT = np.array([0.35, 0.2])
"""Standard deviations of the wrist's angles [rad]: up and down, and sideways."""
ABOUT_Y, ABOUT_Z = np.array([[[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], float)
"""Cross-product matrices of the wrist's axes, for the derivatives of rotations about them."""
TURNS = 4
"""Number of rolls from which the fit begins."""
PASSES, CONVERGED = 12, 5e-3
"""Maximum number of passes of a fit, and the step [m, rad] below which a pass is the last."""
DAMPING = (1e-2, 10.0)
"""Marquardt's factor at the start, and its change after a pass that lowered the cost or did not."""
NEAR_M = 0.05
"""Minimum depth [m] in projections: nearer points are projected as if they were at this depth."""
FAR_RAD, FAR = 0.3, 0.05
"""Differences of distinct poses: in rotation [rad], or in position as a share of the distance from the camera."""


@dataclass(frozen=True)
class Start:
    """A pose of the forearm T_camera_target (4, 4) and its misfit to the landmarks, in standard deviations (RMS)."""

    T: Array
    misfit: float


def body_of(target: Target, body: Body) -> Body | None:
    """The dimensions of the limb that a target's mesh represents; None for a user's own mesh, whose elbow and wrist are not
    known."""
    if target.mesh != "body:forearm":
        return None
    if target.size is None:
        return body
    length, girth = target.size.length, target.size.girth
    return body.model_copy(
        update={
            "forearm_length": length * body.forearm_length,
            "hand_length": length * body.hand_length,
            "hand_breadth": girth * body.hand_breadth,
        }
    )


def starts(limb: Limb, camera: Camera, body: Body) -> list[Start]:
    """Poses of a body's forearm that would look like this limb in the undistorted picture, best first; none if its landmarks are
    no hand. For a left arm, its mirror image is found, with the thumb in its place: the mesh is a right arm."""
    problem = _Problem.of(limb, camera, body)
    if problem is None:
        return []
    out: list[Start] = []
    for start in sorted((problem.fitted(T) for T in _first(limb, camera, body, problem.size)), key=lambda start: start.misfit):
        if start.T[2, 3] > 2.0 * NEAR_M and all(_differ(start.T, other.T) for other in out):
            out.append(start)
    return out


def _first(limb: Limb, camera: Camera, body: Body, size: float) -> list[Array]:
    """Rough poses from which to fit: the limb's direction in the picture, tilted to the camera and away, at TURNS rolls."""
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    wrist = limb.points[0]
    depth = float(focal.mean()) * TO_KNUCKLES * body.hand_length / size
    if limb.elbow is None:
        flat, tilt = -limb.back, 0.4
    else:
        away = wrist - limb.elbow
        flat = away / max(float(np.linalg.norm(away)), 1e-6)
        seen_m = float(np.linalg.norm(away)) / float(focal.mean()) * depth
        tilt = float(np.arccos(np.clip(seen_m / body.forearm_length, 0.2, 0.98)))
    out = []
    for sign, turn in itertools.product((1.0, -1.0), range(TURNS)):
        x = np.array([*(np.cos(tilt) * flat), sign * np.sin(tilt)])
        y = np.cross([0.0, 0.0, 1.0], x)
        y /= np.linalg.norm(y)
        T = np.eye(4)
        T[:3, :3] = rigid.rotation(turn * 2.0 * np.pi / TURNS * x) @ np.column_stack([x, y, np.cross(x, y)])
        T[:3, 3] = depth * np.array([*((wrist - centre) / focal), 1.0]) - body.forearm_length / 2.0 * x
        out.append(T)
    return out


@dataclass(frozen=True)
class _Problem:
    """Landmarks (n, 2) [px] with their standard deviations (n, 1) [px]: wrist, knuckles and, if known, the elbow. size: of the
    hand [px], from wrist to knuckles; half: half the forearm's length [m]; knuckles (4, 3) in the hand's frame [m]."""

    points: Array
    sigma: Array
    size: float
    half: float
    knuckles: Array
    focal: Array
    centre: Array

    @classmethod
    def of(cls, limb: Limb, camera: Camera, body: Body) -> _Problem | None:
        knuckles, ahead = limb.points[list(KNUCKLES)], TO_KNUCKLES * body.hand_length
        across = float(np.linalg.norm(knuckles[0] - knuckles[3])) / ((ACROSS[0] - ACROSS[3]) * body.hand_breadth)
        size = max(float(np.linalg.norm(knuckles.mean(0) - limb.points[0])), across * ahead)
        if not size > 1.0:
            return None
        points, sigma = [limb.points[:1], knuckles], [WRIST, *[KNUCKLE] * 4]
        if limb.elbow is not None:
            points, sigma = [*points, limb.elbow[None]], [*sigma, ELBOW]
        there = np.column_stack([np.full(4, ahead), np.array(ACROSS) * body.hand_breadth, np.zeros(4)])
        focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        return cls(np.vstack(points), size * np.array(sigma)[:, None], size, body.forearm_length / 2.0, there, focal, centre)

    def fitted(self, T: Array) -> Start:
        """The pose near T that fits the landmarks best, by Levenberg-Marquardt; an outlier counts linearly and not by its square
        (weights of the smooth L1 loss)."""
        angles, damping = np.zeros(2), DAMPING[0]
        r, J = self._residuals(T, angles)
        for _ in range(PASSES):
            weighted = J.T / np.sqrt(1.0 + r**2)
            H = weighted @ J
            step = -np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-9 * np.eye(8), weighted @ r)
            there = rigid.perturb(T, step[:6]), angles + step[6:]
            ahead = self._residuals(*there)
            if _cost(ahead[0]) < _cost(r):
                (T, angles), (r, J), damping = there, ahead, damping / DAMPING[1]
            else:
                damping *= DAMPING[1]
            if np.abs(step).max() < CONVERGED:
                break
        return Start(T, float(np.sqrt(_cost(r) / self.points.size)))

    def _residuals(self, T: Array, angles: Array) -> tuple[Array, Array]:
        """Offsets of the projected landmarks, and of the wrist's angles (2,) from rest, in standard deviations (m,), and their
        derivatives (m, 8) by pose error and angles."""
        about_y, about_z = rigid.rotation((0.0, angles[0], 0.0)), rigid.rotation((0.0, 0.0, angles[1]))
        bent = self.knuckles @ (about_z @ about_y).T
        wrist = np.array([self.half, 0.0, 0.0])
        model = np.vstack([wrist, wrist + bent, -wrist])[: len(self.points)]
        turned = np.zeros((len(model), 3, 2))  # derivatives of the model's points by the angles
        turned[1:5, :, 0] = (self.knuckles @ about_y.T @ ABOUT_Y.T) @ about_z.T
        turned[1:5, :, 1] = bent @ ABOUT_Z.T
        there = rigid.apply(T, model)
        depth = np.maximum(there[:, 2], NEAR_M)
        pixels = there[:, :2] / depth[:, None] * self.focal + self.centre
        project = np.zeros((len(model), 2, 3))
        project[:, 0, 0], project[:, 1, 1] = self.focal[0] / depth, self.focal[1] / depth
        project[:, :, 2] = (self.centre - pixels) / depth[:, None]
        x, y, z = (there - T[:3, 3]).T
        zero = np.zeros_like(x)
        swing = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=-1).reshape(-1, 3, 3)  # rotation vector w: w x (x, y, z)
        J = np.concatenate([project, project @ swing, project @ (T[:3, :3] @ turned)], axis=2) / self.sigma[:, None]
        rest = np.concatenate([np.zeros((2, 6)), np.diag(1.0 / BENT)], axis=1)
        return np.concatenate([((pixels - self.points) / self.sigma).ravel(), angles / BENT]), np.vstack([J.reshape(-1, 8), rest])


def _cost(r: Array) -> float:
    return float(2.0 * np.sum(np.sqrt(1.0 + r**2) - 1.0))


def _differ(a: Array, b: Array) -> bool:
    error = rigid.pose_error(a, b)
    return bool(np.linalg.norm(error[3:]) > FAR_RAD or np.linalg.norm(error[:3]) > FAR * np.linalg.norm(a[:3, 3]))
