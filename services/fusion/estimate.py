"""What every observer of this service answers, and how it calls its own state."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared import geometry
from shared.messages import Source

Array = NDArray[np.floating[Any]]

SOURCES = ("vision", "haptic")


@dataclass(frozen=True)
class Estimate:
    """The target at one moment. `T` (4, 4); `velocity` (6,): linear [m/s], angular [rad/s]; `covariance` (6, 6) of the pose error
    (`shared.geometry`); `state`: tracking, coasting or lost; `sources`: the senses heard so far."""

    T: geometry.Array
    velocity: Array
    covariance: Array
    state: str
    sources: dict[str, Source]


@dataclass(frozen=True)
class Limits:
    """Where tracking ends.

    tracking_age : a measurement older than this [s] is not tracking any more: three camera periods and the delay of vision.
    tracking_sigma, lost_sigma : standard deviation of the position [m] along its worst direction. A forearm is 8 cm thick: beyond
        that the estimate no longer overlaps it; beyond 15 cm it is no help as a place to look at.
    lost_age : without a measurement for so long [s], nothing is known about a limb.
    """

    tracking_age: float = 0.25
    tracking_sigma: float = 0.08
    lost_sigma: float = 0.15
    lost_age: float = 3.0

    def state(self, age_s: float, covariance: Array) -> str:
        """tracking, coasting or lost, from the age of the newest measurement in use and the pose's covariance (6, 6)."""
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        if sigma > self.lost_sigma or age_s > self.lost_age:
            return "lost"
        return "tracking" if age_s <= self.tracking_age and sigma <= self.tracking_sigma else "coasting"


@dataclass
class Counts:
    """What became of the measurements of one source."""

    accepted: int = 0
    gated: int = 0  # further from the prediction than both uncertainties allow
    late: int = 0  # older than the history
    duplicate: int = 0


@dataclass
class Log:
    """Counts per source, and since when each was heard [ns]."""

    counts: dict[str, Counts] = field(default_factory=lambda: {source: Counts() for source in SOURCES})
    heard_ns: dict[str, int] = field(default_factory=dict)

    def heard(self, source: str, stamp_ns: int) -> None:
        if source not in self.counts:
            raise ValueError(f"source: one of {', '.join(self.counts)} expected, {source!r} came")
        self.heard_ns.setdefault(source, stamp_ns)


def checked(T: Array, information: Array) -> tuple[Array, Array]:
    """A measurement's pose (4, 4) and information (6, 6), symmetric. Raises ValueError that says what is wrong with them."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-6:
        raise ValueError("pose: a finite rigid transform (4, 4) expected, what came is none")
    if information.shape != (6, 6) or not np.isfinite(information).all():
        raise ValueError("information: a finite (6, 6) matrix expected, what came is none")
    information = 0.5 * (information + information.T)
    low, high = np.linalg.eigvalsh(information)[[0, -1]]
    if high < 0.0 or low < -1e-6 * high:
        raise ValueError(f"information: no negative eigenvalue expected, {low:.3g} beside {high:.3g} came")
    return T, information


def information(covariance: Array) -> Array:
    """The inverse (6, 6) of a covariance. Raises ValueError where it is not symmetric and positive definite."""
    eigenvalues, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    low, high = eigenvalues[[0, -1]]
    if np.abs(covariance - covariance.T).max() > 1e-6 * high or low <= 1e-14 * high:
        raise ValueError(f"covariance: symmetric and positive definite expected, eigenvalues {low:.3g} to {high:.3g} came")
    return (vectors / eigenvalues) @ vectors.T
