"""One pose per window of voltages, from all pads together.

Each window is estimated from its own samples; what is handed on is its likelihood, so consecutive estimates have
independent noise. Earlier windows enter only as the point and spread where the solve looks:

1. predict: the last pose drifts back to its home as an Ornstein-Uhlenbeck process, so its spread never exceeds home's
2. solve from there (`solve.py`); close to the pads from three rolls, because a hand that is turned either way can be felt alike
3. if that does not explain the voltages, nothing is tracked, or some time has passed, solve from scratch: from the
   network's pose with three rolls and from the track, with home's spread; this replaces the track where it explains the
   voltages clearly better
4. merge what fits about equally well into one Gaussian, and take the prior's share out again
5. marginalise the roll about the limb's axis: only the hand's flatness shows it, with several solutions that look equally
   certain, so it is solved for and never published
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from services.haptics.network import PoseNetwork, features
from services.haptics.solve import LEVER, MODEL_ERROR, Solution, peak, solve
from shared.geometry import Array, from_rpy, perturb, pose_error
from shared.skin import Skin
from shared.surface import Surface

MEMORY_S = 10.0
"""Time in which a pose is forgotten: with a home known to 12 cm, 5 mm a window, twice what a limb moves."""
MISFIT = 2.5
"""Mean squared residual above which the voltages are not explained, and the solve starts afresh."""
CHECK_EVERY = 10
"""Windows between solves from scratch beside the track: a limb can be felt alike at two places along it."""
CONVINCING = 8.0
"""A solve from scratch replaces the track when doubt has summed up to this: the log of how much more probable it is, less one,
window after window, never below zero (Page's cumulative sum, DOI 10.2307/2333009) …"""
CLEAR = 4.0
"""… of which one window can give no more than this, lest one burst of noise carries the track away."""
ROLL_GAP = 0.10
"""Nearer than this [m] the roll can be felt, and has several solutions."""
ROLL_MEMORY_S = 0.1
"""The same for the roll about the limb's axis. Short: a wrong roll that was once believed must not be kept for seconds."""
ROLLS = (-0.45, 0.45)
"""Rolls about home [rad] from which the solve starts as well, near the pads."""
FARTHEST = 1.0
"""The gap [m] that stands for everything beyond."""
REACH = 4.0 / 3.0
"""In range: the smallest gap is below this share of the pad's range (20 cm of 15) …"""
WORTH = 0.03
"""… and the best known direction is better than this [m]."""


@dataclass(frozen=True)
class Estimate:
    """T_world_target (4, 4) and information (6, 6) of the voltages alone, zero along what they do not show; gap [m]: the
    smallest from an electrode to the skin, at most FARTHEST; in_range: worth using."""

    T: Array
    information: Array
    gap: float
    in_range: bool


class Estimator:
    """home (4, 4), spread (6,): where the target is expected; network: None where none was trained (the solve then starts
    from home); method: `solve`, or `paper` for the network alone. Raises ValueError for `paper` without a network."""

    def __init__(
        self, skin: Skin, surface: Surface, home: Array, spread: Array, network: PoseNetwork | None, method: str = "solve"
    ):
        if method not in ("solve", "paper"):
            raise ValueError(f"method: solve or paper expected, {method!r} came")
        if method == "paper" and network is None:
            raise ValueError("method paper needs the network's weights: run `penumbra haptics train` for this cell, or use solve")
        self.skin, self.surface, self.home, self.network, self.method = skin, surface, home, network, method
        self._home_covariance = np.diag(np.asarray(spread, dtype=float) ** 2)
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._T, self._covariance, self._stamp_ns, self._tracking, self._gap = self.home, self._home_covariance, 0, False, np.inf
        self._since_check, self._doubt = 0, 0.0

    def nothing(self) -> Estimate:
        """The estimate when nothing can be felt: home, without information."""
        return Estimate(self.home, np.zeros((6, 6)), FARTHEST, False)

    def warm_up(self, joints: int) -> None:
        """Compile and touch everything once, so that the first real window takes no longer than the others."""
        p = len(self.skin.pads)
        for stamp_ns in (1, 2, 3):
            pads = np.tile(np.eye(4), (p, 1, 1))
            self.update(stamp_ns, self.skin.volts(0.1), np.full(len(self.skin), 10), np.ones(p, bool), pads, np.zeros(joints))
        self.reset()

    @property
    def pose(self) -> Array:
        """T_world_target that is most probable after the last window, with what earlier windows said."""
        return self._T

    def update(
        self,
        stamp_ns: int,
        amplitude: Array,
        samples: NDArray[np.integer],
        alive: NDArray[np.bool_],
        T_world_pads: Array,
        joints: ArrayLike = (),
    ) -> Estimate:
        """The estimate at stamp_ns of mean voltages (n,) over so many samples (n,), pads alive (p,) at T_world_pads (p, 4, 4)."""
        skin = self.skin
        felt = alive[skin.pad_of] & (samples > 0)
        if not felt.any():
            return self.nothing()
        variance = np.where(felt, skin.noise / np.maximum(samples, 1), np.inf)
        electrodes = skin.positions(T_world_pads)
        if self.method == "paper":
            assert self.network is not None
            T, information = self.network.likelihood(self._features(amplitude, variance, alive, T_world_pads, joints))
            gap = float(self.surface.nearest((electrodes - T[:3, 3]) @ T[:3, :3])[0][felt].min())
            return self._estimate(T, information, max(gap, 0.0))

        self._predict(stamp_ns)
        tracked: list[Solution] = []
        if self._tracking:
            tracked = self._solutions(electrodes, amplitude, variance, self._starts(), coarse=0, fine=2)
        found, self._since_check = tracked, self._since_check + 1
        if not tracked or tracked[0].misfit > MISFIT or self._since_check >= CHECK_EVERY:
            self._since_check = 0
            kept = self._T, self._covariance
            self._T, self._covariance = self.home, self._home_covariance
            start = self.home
            if self.network is not None:
                start = self.network.posterior(self._features(amplitude, variance, alive, T_world_pads, joints))
            starts = [start, *(_turned(start, roll - self._roll(start)) for roll in ROLLS)]
            found = self._solutions(electrodes, amplitude, variance, starts, coarse=3, fine=3)
            # The track is judged with the same freedom: from its pose, but with home's spread.
            (same,) = self._solutions(electrodes, amplitude, variance, [kept[0]], coarse=0 if tracked else 3, fine=3)
            advantage = CLEAR if same.misfit > MISFIT else same.cost - found[0].cost
            self._doubt = max(0.0, self._doubt + min(advantage, CLEAR) - 1.0)
            if tracked and self._doubt < CONVINCING:
                found, (self._T, self._covariance) = tracked, kept
                self._since_check = CHECK_EVERY if self._doubt else 0  # a doubt is settled by the next windows
            else:
                found, self._doubt = sorted([*found, same], key=lambda solution: solution.cost), 0.0
        T, information, gradient = self._merge(found)
        information, gradient = without_roll(T, information, gradient)
        # Voltages that the model explains badly say less than their noise promises.
        trust = 1.0 / max(1.0, found[0].misfit)
        best, known = peak(T, trust * information, trust * gradient)
        return self._estimate(best, known, found[0].gap)

    def _features(self, amplitude: Array, variance: Array, alive: NDArray[np.bool_], pads: Array, joints: ArrayLike) -> NDArray:
        assert self.network is not None
        total = variance + (MODEL_ERROR * np.maximum(self.skin.signal(amplitude), 0.0)) ** 2
        return features(self.skin, self.network.home, amplitude, total, alive, pads, joints)

    def _predict(self, stamp_ns: int) -> None:
        elapsed_s = (stamp_ns - self._stamp_ns) * 1e-9
        if not 0.0 <= elapsed_s < MEMORY_S:
            self.reset()
        self._stamp_ns = stamp_ns
        keep = np.exp(-elapsed_s / MEMORY_S) if 0.0 <= elapsed_s < MEMORY_S else 0.0
        self._T = perturb(self.home, keep * pose_error(self._T, self.home))
        self._covariance = keep**2 * self._covariance + (1.0 - keep**2) * self._home_covariance
        forgotten = 1.0 - np.exp(-elapsed_s / ROLL_MEMORY_S) if keep else 1.0
        self._T = _turned(self._T, -forgotten * self._roll(self._T))
        axis = np.concatenate([np.zeros(3), self._T[:3, 0]])
        spread = float(axis @ self._home_covariance @ axis) - float(axis @ self._covariance @ axis)
        self._covariance += max(0.0, (1.0 - (1.0 - forgotten) ** 2) * spread) * np.outer(axis, axis)

    def _roll(self, T: Array) -> float:
        """The turn about the limb's axis [rad] from home: the twist of the rotation between them."""
        x, _, _, w = Rotation.from_matrix(self.home[:3, :3].T @ T[:3, :3]).as_quat(canonical=True)
        return float(2.0 * np.arctan2(x, w))

    def _starts(self) -> list[Array]:
        turns = [roll - self._roll(self._T) for roll in ROLLS] if self._gap < ROLL_GAP else []
        return [self._T, *(_turned(self._T, turn) for turn in turns)]

    def _solutions(
        self, electrodes: Array, amplitude: Array, variance: Array, starts: list[Array], coarse: int, fine: int
    ) -> list[Solution]:
        prior = np.linalg.inv(self._covariance)
        found = [
            solve(self.skin, self.surface, electrodes, amplitude, variance, start, self._T, prior, coarse, fine)
            for start in starts
        ]
        return sorted(found, key=lambda solution: solution.cost)

    def _merge(self, found: list[Solution]) -> tuple[Array, Array, Array]:
        """One Gaussian of the solutions (best first) by their moments; sets the track to it and returns its pose, and the
        likelihood's information and gradient there."""
        prior = np.linalg.inv(self._covariance)
        best = found[0]
        offsets, covariances, logs = [np.zeros(6)], [np.linalg.inv(best.information + prior)], [0.0]
        for other in found[1:]:
            offset = pose_error(other.T, best.T)
            apart = min((offset - o) @ np.linalg.solve(P, offset - o) for o, P in zip(offsets, covariances, strict=True))
            if other.cost - best.cost < 5.0 and apart > 1.0:
                offsets.append(offset)
                covariances.append(np.linalg.inv(other.information + prior))
                logs.append(best.cost - other.cost + 0.5 * (_log_det(covariances[-1]) - _log_det(covariances[0])))
        T_prior = self._T
        if len(offsets) == 1:
            T, covariance, information, gradient = best.T, covariances[0], best.information, best.gradient
        else:
            share = np.exp(np.array(logs) - max(logs))
            share /= share.sum()
            mean = share @ np.array(offsets)
            away = np.array(offsets) - mean
            covariance = np.einsum("m,mij->ij", share, np.array(covariances)) + np.einsum("m,mi,mj->ij", share, away, away)
            T = perturb(best.T, mean)
            information = np.linalg.inv(covariance) - prior
            gradient = prior @ pose_error(T, T_prior)
        self._T, self._covariance, self._gap = T, covariance, best.gap
        self._tracking = best.misfit <= MISFIT
        return T, information, gradient

    def _estimate(self, T: Array, information: Array, gap: float) -> Estimate:
        scale = np.array([1.0, 1.0, 1.0, 1.0 / LEVER, 1.0 / LEVER, 1.0 / LEVER])
        strongest = float(np.linalg.eigvalsh(information * np.outer(scale, scale))[-1])
        in_range = gap < REACH * float(self.skin.range.max()) and strongest > 1.0 / WORTH**2
        return Estimate(T, information if in_range else np.zeros((6, 6)), min(gap, FARTHEST), in_range)


def without_roll(T: Array, information: Array, gradient: Array) -> tuple[Array, Array]:
    """Information (6, 6) and gradient (6,) of a likelihood at T after its roll about the limb's axis was marginalised."""
    roll = np.concatenate([np.zeros(3), T[:3, 0]])
    along = information @ roll
    strength = float(roll @ along)
    if strength < 1e-6:
        return information, gradient
    return information - np.outer(along, along) / strength, gradient - along * float(roll @ gradient) / strength


def _turned(T: Array, roll: float) -> Array:
    return T @ from_rpy((0.0, 0.0, 0.0), (roll, 0.0, 0.0))


def _log_det(covariance: NDArray[np.floating]) -> float:
    return float(np.linalg.slogdet(covariance)[1])
