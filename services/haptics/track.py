"""Tracks the limb: a place, a rival if a second place is possible, and the odds between the two.

Far from the pads, thick and thin parts of a limb feel alike, so two places may explain one window. Both are then kept and solved
in every window; the evidence of the windows adds up in the odds until it has decided.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from penumbra.services.haptics.settings import HapticSettings
from penumbra.services.haptics.solve import marginal
from penumbra.shared.geometry.rigid import Array, perturb, pose_error


@dataclass(frozen=True)
class Place:
    """A possible place of the limb: T_world_target (4, 4) and its covariance (6, 6)."""

    T: Array
    covariance: Array

    @functools.cached_property
    def information(self) -> Array:
        """The inverse (6, 6) of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance), np.float64)

    @functools.cached_property
    def sigma(self) -> float:
        """The standard deviation [m] of the position along its worst direction."""
        return math.sqrt(float(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    def is_apart(self, other: Place, settings: HapticSettings) -> bool:
        """Whether the distance between two places exceeds their covariances."""
        offset = self.T[:3, 3] - other.T[:3, 3]
        spread = (self.covariance + other.covariance)[:3, :3] + settings.same_place**2 * np.eye(3)
        return float(offset @ np.linalg.solve(spread, offset)) > settings.apart

    def stands_for(self, other: Place, settings: HapticSettings) -> bool:
        """Whether this place, with its covariance, includes another one; a sharp place does not include a vague one beside it."""
        offset = other.T[:3, 3] - self.T[:3, 3]
        spread = self.covariance[:3, :3] + settings.same_place**2 * np.eye(3)
        return float(offset @ np.linalg.solve(spread, offset)) < settings.apart


class Home:
    """The expected pose of the limb while nothing is felt, and the decay of a place towards it. T (4, 4): T_world_target; spread
    (6,): standard deviations [m, rad] of the pose about it; place: both together."""

    def __init__(self, T: Array, spread: ArrayLike, settings: HapticSettings):
        self.T = T
        self.place = Place(T, np.diag(np.asarray(spread, dtype=float) ** 2))
        self._settings = settings

    def decayed(self, place: Place, elapsed_s: float) -> Place:
        """A place after elapsed_s seconds in which nothing was felt: an Ornstein-Uhlenbeck process about home, whose spread never
        exceeds home's. The roll about the limb's axis has its own time constant."""
        keep = math.exp(-elapsed_s / self._settings.memory_s)
        T = perturb(self.T, keep * pose_error(place.T, self.T))
        covariance = keep**2 * place.covariance + (1.0 - keep**2) * self.place.covariance
        kept, axis = math.exp(-elapsed_s / self._settings.roll_memory_s), roll_axis(T)
        T = perturb(T, (kept - 1.0) * self._roll(T) * axis)  # about the axis, which does not change
        spread = float(axis @ (self.place.covariance - covariance) @ axis)
        return Place(T, covariance + max(0.0, (1.0 - kept**2) * spread) * (axis[:, None] * axis))

    def without_roll(self, T: Array, information: Array, gradient: Array) -> tuple[Array, Array]:
        """Information (6, 6) and gradient (6,) at a pose T (4, 4) after marginalising the roll about the limb's axis, with home's
        prior on it. The voltages would determine the roll only by the flatness of wrist and hand, with several solutions that
        look equally certain."""
        axis = roll_axis(T)
        known = float(axis @ self.place.information @ axis)
        gradient = gradient + axis * (known * float(axis @ pose_error(self.T, T)))
        return marginal(information + known * (axis[:, None] * axis), gradient, axis[:, None])

    def _roll(self, T: Array) -> float:
        """The turn about the limb's axis [rad] from home: the twist of the rotation between them."""
        (a, _, _), (_, e, f), (_, h, i) = (self.T[:3, :3].T @ T[:3, :3]).tolist()
        return 2.0 * math.atan2(h - f, 1.0 + a + e + i)


class Track:
    """The tracked place, its rival (None if only one place is possible) and odds: the log odds of the place to the rival, never
    negative; fused: where the fused pose has the limb in this window, None if it is unknown."""

    def __init__(self, home: Home, settings: HapticSettings):
        self._home, self._settings = home, settings
        self._floor = np.diag(np.repeat(np.square(settings.expected_floor), 3))
        self.forget()

    def forget(self) -> None:
        """Restart at home."""
        self.place, self.odds = self._home.place, 0.0
        self.rival: Place | None = None
        self.fused: Place | None = None

    def decay(self, elapsed_s: float) -> None:
        """Decay both places over elapsed_s seconds in which nothing is felt, and forget the fused pose."""
        self.fused = None
        self.place = self._home.decayed(self.place, elapsed_s)
        self.rival = None if self.rival is None else self._home.decayed(self.rival, elapsed_s)

    def expect(self, T: Array, covariance: Array) -> bool:
        """Take a fused pose (4, 4) with covariance (6, 6), and move the track there if it is known well (`expected_sigma`), or
        better than the track; the track then has no rival. Returns whether it is known well."""
        settings = self._settings
        self.fused = Place(T, covariance)
        is_sure = self.fused.sigma < settings.expected_sigma
        expected = Place(T, settings.expected_inflation**2 * covariance + self._floor)
        if is_sure or expected.sigma < self.place.sigma:
            self.place, self.rival = expected, None
        return is_sure

    def includes(self, place: Place) -> bool:
        """Whether the tracked place or its rival stands for another one."""
        known = (self.place,) if self.rival is None else (self.place, self.rival)
        return any(one.stands_for(place, self._settings) for one in known)

    def contest(self, rival: Place, odds: float) -> None:
        """Keep a rival with these log odds of the track to it, if it is a distinct place and still possible."""
        possible = odds < self._settings.odds_decided and not self.place.stands_for(rival, self._settings)
        self.rival, self.odds = rival if possible else None, max(odds, 0.0)

    def weigh(self, rival: Place, evidence: float) -> bool:
        """Add a window's evidence (log likelihood of the track less that of its rival) to the odds. rival: the place after this
        window. Returns whether the two changed places."""
        self.odds += self.limited(evidence)
        is_overtaken = self.odds < 0.0
        if is_overtaken:
            self.place, rival, self.odds = rival, self.place, -self.odds
        self.contest(rival, self.odds)
        return is_overtaken

    def limited(self, evidence: float) -> float:
        """The evidence of one window, limited to the maximum change by one window."""
        return min(max(evidence, -self._settings.odds_step), self._settings.odds_step)

    def mixed(self, information: Array, gradient: Array) -> tuple[Array, Array]:
        """Widen a likelihood at the track, as information (6, 6) and gradient (6,), to the mixture of the track and its rival.
        The scatter between the two lasts until one of them is dropped."""
        if self.rival is None:
            return information, gradient
        offset, share = pose_error(self.rival.T, self.place.T), 1.0 / (1.0 + np.exp(self.odds))
        mean, scatter = share * offset, share * (1.0 - share) * np.outer(offset, offset)
        if scatter.any():
            keep = np.linalg.inv(np.eye(6) + self._settings.doubt_lasts * information @ scatter)
            gradient = keep @ (gradient + information @ mean)
            information = keep @ information
        return information, gradient


def roll_axis(T: Array) -> Array:
    """The pose error (6,) of a turn by one radian about the limb's axis."""
    return np.array([0.0, 0.0, 0.0, *T[:3, 0].tolist()])
