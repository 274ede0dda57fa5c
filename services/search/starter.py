"""First poses of a forearm from landmarks in the picture: elbow, wrist and knuckles.

For a target that is lost, beside the hypotheses of `detect.py`, where something finds hands and bodies in the picture. The hand
hangs on the forearm by a wrist with two angles, as a bent one would pull the forearm aside. A forearm that points to the camera
and one that points away look the same but for perspective: both are returned.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from penumbra.shared.cell.description import Body, Camera
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

KNUCKLES = 0.47
"""Distance of the knuckles from the wrist as a share of the hand's length."""
ACROSS = (0.36, 0.12, -0.12, -0.36)
"""Where the knuckles of index to little finger lie across the hand, in breadths, towards the thumb."""
ELBOW, WRIST, KNUCKLE = 0.35, 0.12, 0.1
"""Standard deviations of the landmarks, in distances from the wrist to the knuckles: measured on photographs, the elbow's by the
body's model, the others by the hand's; the rest is what bodies differ by."""
BENT = (0.35, 0.2)
"""Standard deviations of the wrist's angles [rad]: up and down, and to the sides."""
TURNS = 4
"""Rolls from which the fit begins."""
FAR_RAD, FAR = 0.3, 0.05
"""Poses are two where they differ by so much in direction, or so much of their distance from the camera."""


@dataclass(frozen=True)
class Seen:
    """Landmarks of an arm in the undistorted picture [px]: wrist (2,), the knuckles (4, 2) of index to little finger, the elbow
    (2,) where it is known."""

    wrist: Array
    knuckles: Array
    elbow: Array | None


@dataclass(frozen=True)
class Start:
    """A pose of the forearm T_camera_target (4, 4) and how badly it fits the landmarks, in standard deviations (RMS)."""

    T: Array
    misfit: float


def starts(seen: Seen, camera: Camera, body: Body) -> list[Start]:
    """Poses of a body's forearm that would look like these landmarks, best first; none where they are no hand. Of a left arm its
    mirror image is found, the thumb where it is: the mesh is a right one."""
    k = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    half = body.forearm_length / 2.0
    elbow, wrist = np.array([-half, 0.0, 0.0]), np.array([half, 0.0, 0.0])
    across = np.array(ACROSS) * body.hand_breadth
    knuckles = np.column_stack([np.full(4, KNUCKLES * body.hand_length), across, np.zeros(4)])
    size = max(
        float(np.linalg.norm(seen.knuckles.mean(0) - seen.wrist)),
        float(np.linalg.norm(seen.knuckles[0] - seen.knuckles[3]) * KNUCKLES * body.hand_length / (0.72 * body.hand_breadth)),
    )
    if not size > 1.0:
        return []
    points = np.vstack([seen.wrist, seen.knuckles] + ([] if seen.elbow is None else [seen.elbow]))
    sigma = size * np.array([WRIST, *[KNUCKLE] * 4] + ([] if seen.elbow is None else [ELBOW]))[:, None]

    def model(p: Array) -> Array:
        """The landmarks (n, 3) in the forearm's frame for the wrist's angles p[6:]."""
        bent = wrist + knuckles @ rigid.rotation((0.0, p[6], 0.0)).T @ rigid.rotation((0.0, 0.0, p[7])).T
        return np.vstack([wrist, bent] + ([] if seen.elbow is None else [elbow]))

    def residuals(p: Array, T: Array) -> Array:
        there = rigid.apply(rigid.perturb(T, p[:6]), model(p))
        depth = np.maximum(there[:, 2:], 0.05)
        pixels = there[:, :2] / depth * k[0] + k[1]
        return np.concatenate([((pixels - points) / sigma).ravel(), p[6:] / BENT])

    depth = float(k[0].mean()) * KNUCKLES * body.hand_length / size
    behind = seen.wrist - (seen.knuckles.mean(0) if seen.elbow is None else seen.elbow)
    flat = (behind if seen.elbow is not None else -behind) / max(float(np.linalg.norm(behind)), 1e-6)
    seen_m = 0.0 if seen.elbow is None else float(np.linalg.norm(behind)) / float(k[0].mean()) * depth
    tilt = 0.4 if seen.elbow is None else float(np.arccos(np.clip(seen_m / body.forearm_length, 0.2, 0.98)))
    found: list[Start] = []
    for sign, turn in itertools.product((1.0, -1.0), range(TURNS)):
        x = np.array([*(np.cos(tilt) * flat), sign * np.sin(tilt)])
        y = np.cross([0.0, 0.0, 1.0], x)
        y /= np.linalg.norm(y)
        T = np.eye(4)
        T[:3, :3] = rigid.rotation(turn * 2.0 * np.pi / TURNS * x) @ np.column_stack([x, y, np.cross(x, y)])
        T[:3, 3] = depth * np.array([*((seen.wrist - k[1]) / k[0]), 1.0]) - half * x
        fit = least_squares(residuals, np.zeros(8), args=(T,), loss="soft_l1", max_nfev=40)
        pose = rigid.perturb(T, fit.x[:6])
        if pose[2, 3] > 0.1:
            found.append(Start(pose, float(np.sqrt(2.0 * fit.cost / points.size))))
    out: list[Start] = []
    for start in sorted(found, key=lambda start: start.misfit):
        if all(_differ(start.T, other.T) for other in out):
            out.append(start)
    return out


def _differ(a: Array, b: Array) -> bool:
    error = rigid.pose_error(a, b)
    return bool(np.linalg.norm(error[3:]) > FAR_RAD or np.linalg.norm(error[:3]) > FAR * np.linalg.norm(a[:3, 3]))
