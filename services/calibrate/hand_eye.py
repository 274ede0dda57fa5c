"""Hand-eye calibration: the pose of a camera, from pictures of a board that a robot carries: A Z = X B.

A is the pose of the link that carries the board in the world, from the robot's joints; B is the pose of the board in the camera,
from its picture; X = T_world_camera and Z = T_link_board are the same in every pair.

1. rotations of X and Z: null space of a linear system, projected onto rotations; then translations: linear too (Shah 2013)
2. least squares on the corners' reprojection over X and Z; joints and lens are assumed to be exact
3. before that, the same with weights that fall with a pair's residual: pairs that stay far off are outliers, and left out
4. leave-one-out: each pair as predicted by the others
5. standard deviations by bootstrap over pairs: errors of the robot's joints are common to all corners of a pair, so the
   covariance of 2, which assumes independent corners, is several times too small
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from penumbra.services.calibrate.board import Board, CalibrationError
from penumbra.services.calibrate.intrinsics import View
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.lens import Lens
from penumbra.shared.geometry.rigid import Array

FEWEST_PAIRS = 8
"""Minimum number of pairs for meaningful residuals and bootstrap; three would determine a pose."""
FAR_ABOVE = 3.0
"""Factor on the median residual above which a pair is an outlier, if its residual also exceeds GOOD_PX."""
GOOD_PX = 0.4
"""Residual [px] up to which no pair is an outlier, however small the others' residuals are."""
MOST_BAD = 0.25
"""Maximum share of outliers: with more, the robot, the board or the lens is at fault."""
LEAST_TURN = np.radians(3.0)
"""Minimum standard deviation [rad] of the flange's rotation about its second axis; below it, the problem has no useful
solution."""
GOOD_TURN = np.radians(10.0)
"""The same standard deviation [rad] below which the result is poor."""
WORST_M, WORST_TURN = 0.05, np.radians(5.0)
"""Standard deviations of the camera's position [m] and rotation [rad] above which pairs do not belong together: even few and flat
views of a good board are ten times better."""
SUSPECTS = "are the joints those of the pictures, is the board fixed to the link, and is its square as long as said?"
ROUNDS = 8
"""Number of fits that find the outliers, each with the weights from the previous one."""
RUNS, NEARBY = 5, 1e-3
"""Maximum number of runs of the fit, and step [m or rad] below which it stops: the derivatives are those of a small step."""


@dataclass(frozen=True)
class Pair:
    """One picture: the pose in the world of the link with the board (4, 4), and the corners (n, 2) [px] in the undistorted
    picture, with their positions (n, 3) [m] on the board."""

    name: str
    T_world_link: Array
    corners: Array
    points: Array
    lens: Lens

    @classmethod
    def of(cls, view: View, T_world_link: Array, board: Board, lens: Lens) -> Pair:
        """The pair of a view. Raises CalibrationError if the lens cannot have taken it."""
        corners = lens.undistorted(view.corners)
        if np.isnan(corners).any():
            raise CalibrationError(f"{view.name}: expected corners that this lens can show: calibrate the camera first")
        pinhole = Lens(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
        return cls(view.name, T_world_link, corners, board.corners[view.numbers], pinhole)

    @cached_property
    def T_camera_board(self) -> Array:
        """The board's pose from its picture alone."""
        K = np.array([[self.lens.fx, 0.0, self.lens.cx], [0.0, self.lens.fy, self.lens.cy], [0.0, 0.0, 1.0]])
        _, rotations, places, _ = cv2.solvePnPGeneric(self.points, self.corners, K, None, flags=cv2.SOLVEPNP_IPPE)
        rotation, place = cv2.solvePnPRefineLM(self.points, self.corners, K, None, rotations[0], places[0])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rigid.rotation(np.ravel(rotation)), np.ravel(place)
        return T


class Corners:
    """The corners of several pairs in one array (n,), and their residuals for given X and Z. `pair` (n,): index of each corner's
    pair."""

    def __init__(self, pairs: Sequence[Pair]):
        counts = [len(pair.points) for pair in pairs]
        self.pair = np.repeat(np.arange(len(pairs)), counts)
        self.count = len(pairs)
        self._points = np.concatenate([pair.points for pair in pairs])
        self._corners = np.concatenate([pair.corners for pair in pairs])
        self._T = np.repeat([pair.T_world_link for pair in pairs], counts, axis=0)
        lens = pairs[0].lens
        self._focal, self._centre = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])

    def residuals(self, X: Array, Z: Array) -> Array:
        """Reprojection residuals (n, 2) [px]."""
        points = self._in_camera(X, Z)
        return np.asarray(points[:, :2] / points[:, 2:] * self._focal + self._centre - self._corners)

    def rms(self, X: Array, Z: Array) -> Array:
        """Root mean square residual (p,) of each pair, per coordinate [px]."""
        squares = np.bincount(self.pair, (self.residuals(X, Z) ** 2).mean(axis=1), self.count)
        return np.asarray(np.sqrt(squares / np.bincount(self.pair, minlength=self.count)))

    def jacobian(self, X: Array, Z: Array) -> Array:
        """Derivatives (n, 2, 12) of the residuals by `perturb` of X and of Z."""
        R_camera_world = X[:3, :3].T
        R_camera_link = R_camera_world @ self._T[:, :3, :3]
        moved = np.empty((len(self._points), 3, 12))
        moved[:, :, :3] = -R_camera_world
        moved[:, :, 3:6] = R_camera_world @ _skew(self._in_world(Z) - X[:3, 3])
        moved[:, :, 6:9] = R_camera_link
        moved[:, :, 9:] = -R_camera_link @ _skew(self._points @ Z[:3, :3].T)  # rotated, without translation
        x, y, z = self._in_camera(X, Z).T
        by_point = np.zeros((len(z), 2, 3))
        by_point[:, 0, 0], by_point[:, 1, 1] = self._focal[0] / z, self._focal[1] / z
        by_point[:, 0, 2], by_point[:, 1, 2] = -self._focal[0] * x / z**2, -self._focal[1] * y / z**2
        return np.asarray(by_point @ moved)

    def _in_world(self, Z: Array) -> Array:
        on_link = rigid.apply(Z, self._points)
        return np.asarray(np.einsum("nij,nj->ni", self._T[:, :3, :3], on_link) + self._T[:, :3, 3])

    def _in_camera(self, X: Array, Z: Array) -> Array:
        points = rigid.apply(rigid.inverse(X), self._in_world(Z))
        points[:, 2] = np.maximum(points[:, 2], 1e-3)  # a point behind the camera gets a large but finite residual
        return points


@dataclass(frozen=True)
class LeftOne:
    """A pair as predicted by the other pairs: rms of its corners [px], and distance [m] and angle [rad] between the board's
    predicted pose and the one from its picture."""

    rms_px: float
    distance: float
    angle: float


@dataclass(frozen=True)
class HandEye:
    """T_world_camera and T_link_board, their covariances (6, 6) for `perturb`, the rms of all corners per coordinate [px], the
    leave-one-out residuals of the pairs used and of those left out, and weaknesses of the result, in words."""

    T_world_camera: Array
    T_link_board: Array
    covariance: Array
    board_covariance: Array
    rms_px: float
    residuals: dict[str, LeftOne]
    left_out: dict[str, LeftOne]
    notes: tuple[str, ...] = ()

    @property
    def spread(self) -> tuple[float, float]:
        """Standard deviations of the camera's position [m] and rotation [rad] along their worst directions."""
        position, rotation = self.covariance[:3, :3], self.covariance[3:, 3:]
        return float(np.sqrt(np.linalg.eigvalsh(position)[-1])), float(np.sqrt(np.linalg.eigvalsh(rotation)[-1]))


def solve(pairs: Sequence[Pair], resamples: int = 200, rng: np.random.Generator | None = None) -> HandEye:
    """Solve for the camera's pose. Raises CalibrationError if the pairs do not determine it."""
    rng = rng or np.random.default_rng(0)
    _need(len(pairs))
    look_at_turns([pair.T_world_link for pair in pairs])
    pairs, outliers = _apart(pairs)
    _need(len(pairs))
    notes = look_at_turns([pair.T_world_link for pair in pairs])
    corners = Corners(pairs)
    X, Z = refine(corners, *linear(pairs))
    residuals = {}
    for i, pair in enumerate(pairs):
        others = refine(corners, X, Z, np.arange(len(pairs)) != i)
        residuals[pair.name] = _left_one(pair, *others)
    left_out = {pair.name: _left_one(pair, X, Z) for pair in outliers}
    drawn = (refine(corners, X, Z, weights) for weights in _drawn(pairs, resamples, rng))
    offsets = np.array([np.concatenate([rigid.pose_error(a, b) for a, b in zip(each, (X, Z), strict=True)]) for each in drawn])
    # each pair gives 6 numbers, and the result has 12: residuals are smaller than the errors
    covariance = len(pairs) / (len(pairs) - 2.0) * np.cov(offsets, rowvar=False)
    rms = float(np.sqrt(np.mean(corners.residuals(X, Z) ** 2)))
    found = HandEye(X, Z, covariance[:6, :6], covariance[6:, 6:], rms, residuals, left_out, tuple(notes))
    metres, radians = found.spread
    if metres > WORST_M or radians > WORST_TURN:
        raise CalibrationError(
            f"expected pairs that fit one place of the camera, got one that is uncertain by {metres:.2g} m and "
            f"{np.degrees(radians):.2g} degrees: {SUSPECTS}"
        )
    return found


def _apart(pairs: Sequence[Pair]) -> tuple[list[Pair], list[Pair]]:
    """The consistent pairs, and the outliers: in a fit in which a pair's weight falls with its residual, outliers stay far off.
    Raises CalibrationError if there are too many."""
    corners = Corners(pairs)
    X, Z = refine(corners, *linear(pairs))
    rms = corners.rms(X, Z)
    for _ in range(ROUNDS):
        scale = max(GOOD_PX / FAR_ABOVE, float(np.median(rms)))
        X, Z = refine(corners, X, Z, 1.0 / (1.0 + (rms / scale) ** 2))  # Cauchy's weights
        rms = corners.rms(X, Z)
    is_off = rms > max(GOOD_PX, FAR_ABOVE * float(np.median(rms)))
    if is_off.sum() > MOST_BAD * len(pairs):
        names = ", ".join(pair.name for pair, off in zip(pairs, is_off, strict=True) if off)
        raise CalibrationError(
            f"expected pairs that fit one place of the camera, got {is_off.sum()} of {len(pairs)} that do not ({names}): "
            f"{SUSPECTS}"
        )
    return [p for p, off in zip(pairs, is_off, strict=True) if not off], [p for p, off in zip(pairs, is_off, strict=True) if off]


def look_at_turns(poses: Sequence[Array]) -> list[str]:
    """Weaknesses of the link's rotations for a good result. Raises CalibrationError if they determine none: with turns about one
    axis only, the camera may lie anywhere along it."""
    vectors = np.array([rigid.pose_error(T, poses[0])[3:] for T in poses])
    for _ in range(3):  # about the mean, where rotation vectors are small and well-behaved
        mean = vectors.mean(axis=0)
        middle = np.eye(4)
        middle[:3, :3] = rigid.rotation(mean) @ poses[0][:3, :3]
        vectors = np.array([rigid.pose_error(T, middle)[3:] for T in poses]) + mean
    spread, axes = _principal(vectors - vectors.mean(axis=0))
    axis = ", ".join(f"{each:+.2f}" for each in axes[0])
    if spread[1] < LEAST_TURN:
        only = f"about ({axis}) by {np.degrees(spread[0]):.0f} degrees" if spread[0] > LEAST_TURN else "hardly at all"
        raise CalibrationError(
            f"expected poses that turn the board about two axes or more, got turns {only}: from these the camera may stand "
            "anywhere along a line; turn the flange by 20 to 40 degrees about other axes too, and take pictures there"
        )
    if spread[1] < GOOD_TURN:
        return [
            f"the board turns by {np.degrees(spread[1]):.0f} degrees (one standard deviation) across ({axis}): with 10 or more "
            "the camera's place would be more certain"
        ]
    return []


def _principal(vectors: Array) -> tuple[Array, Array]:
    """Standard deviations (3,) of vectors (n, 3) along their principal axes, the largest first, and these axes (3, 3) as rows."""
    _, values, axes = np.linalg.svd(vectors, full_matrices=False)
    return values / np.sqrt(len(vectors)), axes * np.where(axes.sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)


def linear(pairs: Sequence[Pair]) -> tuple[Array, Array]:
    """X and Z in closed form (Shah 2013)."""
    A, B = (np.array(list(each)) for each in zip(*((p.T_world_link, p.T_camera_board) for p in pairs), strict=True))
    eye = np.eye(3)
    # R_A R_Z = R_X R_B; with row-major vec, vec(P Q R) = (P kron R') vec(Q)
    system = np.concatenate(
        [np.hstack([np.kron(a, eye), -np.kron(eye, b.T)]) for a, b in zip(A[:, :3, :3], B[:, :3, :3], strict=True)]
    )
    null = np.linalg.svd(system)[2][-1]
    R_Z, R_X = _rotation(null[:9].reshape(3, 3)), _rotation(null[9:].reshape(3, 3))
    # R_A t_Z + t_A = R_X t_B + t_X
    left = np.concatenate([np.hstack([a, -eye]) for a in A[:, :3, :3]])
    right = (B[:, :3, 3] @ R_X.T - A[:, :3, 3]).ravel()
    t = np.linalg.lstsq(left, right, rcond=None)[0]
    X, Z = np.eye(4), np.eye(4)
    X[:3, :3], X[:3, 3], Z[:3, :3], Z[:3, 3] = R_X, t[3:], R_Z, t[:3]
    return X, Z


def _rotation(matrix: Array) -> Array:
    """The rotation nearest to a multiple of a rotation, of either sign."""
    u, _, v = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return np.asarray(u @ v)


def refine(corners: Corners, X: Array, Z: Array, weights: ArrayLike | None = None) -> tuple[Array, Array]:
    """Minimise the sum of squares of all corners' residuals over X and Z; weights: of the pairs (p,)."""
    root = np.sqrt(np.ones(corners.count) if weights is None else np.asarray(weights, float))[corners.pair, None]

    def moved(error: Array) -> tuple[Array, Array]:
        return rigid.perturb(X, error[:6]), rigid.perturb(Z, error[6:])

    for _ in range(RUNS):
        found = least_squares(
            lambda error: (root * corners.residuals(*moved(error))).ravel(),
            np.zeros(12),
            lambda error: (root[..., None] * corners.jacobian(*moved(error))).reshape(-1, 12),
            method="lm",
        )
        X, Z = moved(found.x)
        if np.abs(found.x).max() < NEARBY:
            break
    return X, Z


def _left_one(pair: Pair, X: Array, Z: Array) -> LeftOne:
    """The residuals of a pair at X and Z."""
    off = rigid.pose_error(rigid.inverse(X) @ pair.T_world_link @ Z, pair.T_camera_board)
    rms = float(Corners([pair]).rms(X, Z)[0])
    return LeftOne(rms, float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:])))


def _drawn(pairs: Sequence[Pair], resamples: int, rng: np.random.Generator) -> Iterator[NDArray[np.int64]]:
    """Bootstrap weights: counts of the pairs (p,) in samples of the same size, drawn with repetition, that turn about two
    axes."""
    count = 0
    while count < resamples:
        weights = np.bincount(rng.integers(len(pairs), size=len(pairs)), minlength=len(pairs))
        try:
            look_at_turns([pair.T_world_link for pair, weight in zip(pairs, weights, strict=True) if weight])
        except CalibrationError:
            continue
        count += 1
        yield weights


def _skew(vectors: Array) -> Array:
    """Skew matrices (n, 3, 3): [v] with [v] w = v x w."""
    out = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    return out - out.transpose(0, 2, 1)


def _need(count: int) -> None:
    if count < FEWEST_PAIRS:
        raise CalibrationError(
            f"expected at least {FEWEST_PAIRS} pairs of picture and joints that show the board, 15 to 25 are good, got {count}"
        )
