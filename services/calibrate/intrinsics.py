"""Intrinsics and distortion of a camera from views of the board, with standard deviations and bad views.

1. closed form and least squares of all views' corners, by OpenCV (Zhang 2000)
2. a view whose residual is far above the others' is left out, and the fit repeated
3. k3 is kept only if it differs from zero by more than its uncertainty: otherwise it bends the corners of pictures needlessly
4. standard deviations by bootstrap over views: corners of one view share their error (a board that is not quite flat, blur), so
   those of the least squares, which assumes independent corners, are too small
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.services.calibrate.board import Board, CalibrationError
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.lens import COEFFICIENTS, Lens
from penumbra.shared.geometry.rigid import Array

NAMES = ("fx", "fy", "cx", "cy", *COEFFICIENTS)
FEWEST_VIEWS = 8
"""Minimum number of views for nine unknowns."""
FAR_ABOVE = 3.0
"""Factor on the median residual above which a view is bad, if its residual also exceeds GOOD_PX."""
GOOD_PX = 0.5
"""Residual [px] up to which no view is bad, however small the others' residuals are."""
MOST_BAD = 0.25
"""Maximum share of bad views: with more, the board or the camera is at fault."""
SIGNIFICANT = 3.0
"""Number of standard deviations from zero above which k3 is kept."""
FLATTEST = np.radians(8.0)
"""Minimum difference [rad] in tilt between views; below it, they do not separate the focal length from the distance."""


@dataclass(frozen=True)
class View:
    """Corners (n, 2) [px] of the board in a distorted picture, and their numbers (n,)."""

    name: str
    corners: Array
    numbers: NDArray[np.int64]


@dataclass(frozen=True)
class Intrinsics:
    """Result of the calibration. lens: intrinsics and distortion; deviation: standard deviations by NAMES; rms_px: of the corners
    used, per coordinate; residuals: rms by view [px]; left_out: bad views, with their residuals; poses: T_camera_board by
    view."""

    lens: Lens
    deviation: dict[str, float]
    rms_px: float
    residuals: dict[str, float]
    left_out: dict[str, float]
    poses: dict[str, Array]


def calibrate(
    board: Board, views: Sequence[View], width: int, height: int, resamples: int = 60, rng: np.random.Generator | None = None
) -> Intrinsics:
    """Calibrate the lens from views in pictures of this size. Raises CalibrationError if the views do not determine it."""
    rng = rng or np.random.default_rng(0)
    views = list(views)
    _need(len(views))
    left_out: dict[str, float] = {}
    while True:
        fit = _fit(board, views, (width, height), 0)
        worst = max(fit.residuals, key=lambda name: fit.residuals[name])
        if fit.residuals[worst] <= max(GOOD_PX, FAR_ABOVE * float(np.median(list(fit.residuals.values())))):
            break
        left_out[worst] = fit.residuals[worst]
        views = [view for view in views if view.name != worst]
        if len(left_out) > MOST_BAD * (len(views) + len(left_out)):
            names = ", ".join(left_out)
            raise CalibrationError(
                f"expected views that fit one lens, got {len(left_out)} of {len(views) + len(left_out)} that do not ({names}): "
                "is the board flat, is focus or zoom changing, are these pictures of one camera?"
            )
        _need(len(views))
    _look_at_tilts(list(fit.poses.values()))
    if abs(fit.k[8]) < SIGNIFICANT * fit.deviation[8]:
        fit = _fit(board, views, (width, height), cv2.CALIB_FIX_K3)
    lens = Lens(width, height, **dict(zip(NAMES, map(float, fit.k), strict=True)))
    if faults := lens.faults():
        reasons = "; ".join(f"{name}: {reason}" for name, reason in faults)
        raise CalibrationError(f"the views give no possible lens ({reasons}): take views that fill the picture up to its corners")
    drawn = np.array(list(_resampled(board, views, (width, height), fit, resamples, rng)))
    # the spread among n views drawn with repetition is that of a sample of n - 1 views
    deviation = drawn.std(axis=0, ddof=1) * np.sqrt(len(views) / (len(views) - 1.0))
    deviation = np.maximum(deviation, fit.deviation)
    return Intrinsics(lens, dict(zip(NAMES, map(float, deviation), strict=True)), fit.rms_px, fit.residuals, left_out, fit.poses)


@dataclass(frozen=True)
class _Fit:
    k: Array
    deviation: Array
    rms_px: float
    residuals: dict[str, float]
    poses: dict[str, Array]
    flags: int


def _fit(board: Board, views: Sequence[View], size: tuple[int, int], flags: int, start: _Fit | None = None) -> _Fit:
    """OpenCV's least squares over all views; `start` replaces the closed form."""
    guess: tuple[Any, Any] = (None, None) if start is None else _matrices(start.k)  # OpenCV's type hints do not allow None
    if start is not None:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
    objects = [board.corners[view.numbers].astype(np.float32) for view in views]
    images = [view.corners.astype(np.float32) for view in views]
    try:
        _, K, D, rotations, places, deviation, _, rms = cv2.calibrateCameraExtended(objects, images, size, *guess, flags=flags)
    except cv2.error as error:
        raise CalibrationError(f"OpenCV finds no lens for these views: {str(error).strip()[-200:]}") from None
    k = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(D)[:5]])
    poses = {}
    for view, rotation, place in zip(views, rotations, places, strict=True):
        poses[view.name] = T = np.eye(4)
        T[:3, :3], T[:3, 3] = rigid.rotation(np.ravel(rotation)), np.ravel(place)
    each = np.ravel(rms) / np.sqrt(2.0)  # OpenCV's residuals are lengths
    whole = float(np.sqrt(np.average(each**2, weights=[len(view.numbers) for view in views])))
    residuals = {view.name: float(residual) for view, residual in zip(views, each, strict=True)}
    return _Fit(k, np.ravel(deviation)[:9].astype(float), whole, residuals, poses, flags & ~cv2.CALIB_USE_INTRINSIC_GUESS)


def _matrices(k: Array) -> tuple[Array, Array]:
    return np.array([[k[0], 0.0, k[2]], [0.0, k[1], k[3]], [0.0, 0.0, 1.0]]), k[4:].copy()


def _resampled(
    board: Board, views: Sequence[View], size: tuple[int, int], fit: _Fit, resamples: int, rng: np.random.Generator
) -> Iterator[Array]:
    """The unknowns (9,) of fits to the same number of views, drawn with repetition."""
    for _ in range(resamples):
        drawn = [views[i] for i in rng.integers(len(views), size=len(views))]
        yield _fit(board, drawn, size, fit.flags, fit).k


def _need(count: int) -> None:
    if count < FEWEST_VIEWS:
        raise CalibrationError(f"expected at least {FEWEST_VIEWS} pictures that show the board, 15 to 30 are good, got {count}")


def _look_at_tilts(poses: Sequence[Array]) -> None:
    """Raise CalibrationError if all views have the same tilt."""
    normals = np.array([T[:3, 2] for T in poses])
    mean = normals.mean(axis=0) / np.linalg.norm(normals.mean(axis=0))
    spread = float(np.arccos(np.clip(normals @ mean, -1.0, 1.0)).max())
    if spread < FLATTEST:
        raise CalibrationError(
            f"expected views at different tilts, got all within {np.degrees(spread):.0f} degrees: from them a longer lens and a "
            "farther board look the same; tilt the board by 20 to 40 degrees to each side"
        )
