"""Poses of held-out pictures beside the truth: what the covariance is calibrated on, and the card's score."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from penumbra.services.posecnn.estimator import PoseCNN, PoseCnnEstimate
from penumbra.services.posecnn.network import Network
from penumbra.services.posecnn.uncertainty import KINDS, Uncertainty, errors, fitted
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell.description import Cell
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.lookout import corners_of, whole_frame, window_around

START = (0.02, np.radians(4.0))
"""Root mean square length of the predictions' errors: position [m], rotation [rad]."""
BANDS = ((0.0, 0.33), (0.33, 0.66), (0.66, 1.0))
"""Shares of the target that are hidden: light, medium and heavy occlusion, as in the paper."""
LEAST = 60
"""Poses that a calibration needs."""
UNCALIBRATED = Uncertainty(dict.fromkeys(KINDS, (0.0,) * 6))


class Shown(Protocol):
    """A picture and its truth, as `sim.sets.shots.Shot`: image (h, w, 3) uint8 RGB, hidden share, T_world_target (4, 4), the cell
    with its one camera, and the target's mesh."""

    @property
    def image(self) -> NDArray[np.uint8] | None: ...
    @property
    def hidden(self) -> float: ...
    @property
    def T_world_target(self) -> Array: ...
    @property
    def T_camera_target(self) -> Array: ...
    @property
    def cell(self) -> Cell: ...
    @property
    def mesh(self) -> Mesh: ...


@dataclass(frozen=True)
class Result:
    """An estimate, and what it is an estimate of."""

    estimate: PoseCnnEstimate
    T_camera_target: Array
    T_world_camera: Array
    length: float
    hidden: float

    @property
    def T(self) -> Array:
        """The estimated T_camera_target."""
        return rigid.inverse(self.T_world_camera) @ self.estimate.T

    @property
    def error(self) -> Array:
        """The pose error (6,) along the world's axes."""
        return rigid.pose_error(self.T_world_camera @ self.T_camera_target, self.estimate.T)

    @property
    def errors(self) -> dict[str, Array]:
        """The errors by kind (`uncertainty.errors`)."""
        return errors(self.T_camera_target, self.T, self.length)

    @property
    def nees(self) -> float:
        """The normalised squared error: chi-square distributed with six degrees of freedom where the covariance is right."""
        return float(self.error @ np.linalg.solve(self.estimate.covariance, self.error))


def results(net: Network, uncertainty: Uncertainty, shown: Iterable[Shown], seed: int) -> list[Result]:
    """Estimates of pictures, each looked for around a prediction that is off by START."""
    out = []
    for index, shot in enumerate(shown):
        assert shot.image is not None
        rng = np.random.default_rng([seed, index])
        T_prior = rigid.perturb(shot.T_world_target, rng.normal(size=6) * np.repeat(START, 3) / np.sqrt(3.0))
        camera = next(iter(shot.cell.cameras.values()))
        window = window_around(camera, [(T_prior, corners_of(shot.mesh.vertices))]) or whole_frame(camera)
        estimate = PoseCNN(shot.cell, net=net, uncertainty=uncertainty).update(shot.image, window, T_prior)
        length = float(np.ptp(shot.mesh.vertices[:, 0]))
        out.append(Result(estimate, shot.T_camera_target, camera.T_world_camera, length, shot.hidden))
    return out


def calibrated(net: Network, shown: Iterable[Shown], seed: int) -> Uncertainty:
    """The uncertainty that pictures show; where too few of them were tracked to say, that of a network that knows nothing."""
    tracked = [one for one in results(net, UNCALIBRATED, shown, seed) if one.estimate.signs is not None]
    if len(tracked) < LEAST:
        return UNCALIBRATED
    return fitted([one.estimate.signs for one in tracked if one.estimate.signs is not None], [one.errors for one in tracked])


def score(found: list[Result]) -> list[dict[str, Any]]:
    """Errors of each band of BANDS: of the poses that count as tracking, their share, and how right their covariance is: mean
    NEES (6 expected, with the band that holds 95 % of such means) and the share of poses within the ellipsoid of 95 %."""
    rows = []
    for low, high in BANDS:
        band = [one for one in found if low <= one.hidden < high]
        tracked = [one for one in band if one.estimate.state == "tracking"]
        row: dict[str, Any] = {"hidden": [low, high], "count": len(band), "tracking": round(len(tracked) / max(len(band), 1), 3)}
        if tracked:
            position = 100.0 * np.array([np.linalg.norm(one.error[:3]) for one in tracked])
            kinds = {kind: np.median([np.linalg.norm(one.errors[kind]) for one in tracked]) for kind in KINDS}
            spread = {name: _2(value) for name, value in zip(("median", "p95"), np.quantile(position, (0.5, 0.95)), strict=True)}
            nees, n = np.array([one.nees for one in tracked]), len(tracked)
            row |= {
                "position_cm": spread | {"mean": _2(position.mean())},
                "depth_percent": _2(100.0 * kinds["depth"]),
                "lateral_cm": _2(100.0 * np.median([np.linalg.norm(one.errors["lateral"]) * one.length for one in tracked])),
                **{f"{kind}_deg": _2(np.degrees(kinds[kind])) for kind in ("turn", "tilt", "roll")},
                "nees": _2(nees.mean()),
                "nees_band": [_2(chi2.ppf(q, 6 * n) / n) for q in (0.025, 0.975)],
                "within_95": _2(np.mean(nees < chi2.ppf(0.95, 6))),
            }
        rows.append(row)
    return rows


def _2(value: Any) -> float:
    return round(float(value), 2)
