"""One pose per window of voltages, from all pads together.

Each window is estimated from its own samples; what is handed on is its likelihood. Earlier windows enter as the point and spread
where the solve looks, and through what changes slowly (`slow.py`):

1. predict: from the fused pose where that is known, else the last pose drifts back to its home as an Ornstein-Uhlenbeck process,
   so its spread never exceeds home's
2. solve from there (`solve.py`), with the limb's size as it is known by now
3. if that does not explain the voltages, or nothing is tracked, solve from scratch: from home moved along the limb, and from the
   network's pose
4. far from the pads thick and thin parts of a limb feel alike: another place that is possible, from scratch or found beside the
   track, is kept as its rival and solved as well, until the windows have decided between the two
5. learn the size close to the pads, the electrodes' rests while nothing is near
6. hand on the likelihood: size and roll marginalised, the model's error counted as what it is, nearly the same in several
   windows; where a rival is possible, that of the two together

Voltages that no limb explains (a metal part, a block) are reported as out of range.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from services.haptics.paper_network import PoseNetwork, Relative, features
from services.haptics.size_and_rest import PERSON_S, SIZE_GAP, SIZE_LASTING, Size, Tare
from services.haptics.solve import LEVER, Prior, Solution, Solver, Window, marginal, peak
from shared.geometry.rigid import Array, perturb, pose_error
from shared.geometry.surface import Surface
from shared.skin.layout import Skin
from shared.skin.response import Response

MEMORY_S = 10.0
"""Time in which a pose is forgotten: with a home known to 12 cm, 5 mm a window, twice what a limb moves."""
EXPECTED_SIGMA = 0.02
"""A fused pose is looked at where its position is known so well along its worst direction [m]: what the camera saw a moment ago
tells apart places that feel alike …"""
EXPECTED_INFLATION, EXPECTED_FLOOR = 2.0, (0.01, 0.1)
"""… with its standard deviations doubled, and these [m, rad] added: it says where to look and not what is felt."""
MISFIT = 2.0
"""Misfit of the track, smoothed over windows, above which it does not explain the voltages, and the solve starts afresh: a single
window far away, of few electrodes, has twice the misfit by its noise, and tells apart no places that feel alike."""
NO_LIMB = 2.2
"""Misfit, smoothed over windows, above which what is felt is no limb …"""
MISFIT_SHARE, WORST = 0.2, 6.0
"""… with so large a share of the newest window, and one of them counting at most so much."""
PAD_MISFIT = 4.0
"""Mean squared residual of a pad, in variances, from which its electrodes lose weight as its square: it is turned, or has another
pad's calibration …"""
PAD_SHARE, PAD_WORST = 0.03, 100.0
"""… smoothed over windows with this share of the newest, and a squared residual counting at most so much."""
STRANGE = 3.5
"""No limb has a size so many standard deviations from the mean one: a metal bar feels like a thin arm."""
FOREIGN = "what is felt is no limb: something else is near"
AGAIN = 3
"""Of so many windows that nothing explains, one is solved from scratch: a search takes some milliseconds."""
OTHER_EVERY = 5
"""Of so many windows one also looks elsewhere, from one start: as limbs come near, the place where they may be splits in two
within a few of them …"""
TRACKS_OWN = 0.06
"""… but not from so near to the track along the limb [m]: from there it would end where the track is."""
SAME, APART = 0.02, 4.0
"""Two places are two when the square of their distance is above APART of its variances, with SAME [m] added: below, one of them
with its covariance stands for both."""
BESIDE = 2.0
"""Log odds of the track at least, when a rival is found beside it that explains the window as well: seven to one, for the rival
was looked for, and of many places one explains some window …"""
CLEAR = 2.0
"""… of which one window can change no more than this, lest one burst of noise decides …"""
CONVINCING = 5.0
"""… until they are these, 150 to one, and the rival is dropped; below zero the two change places."""
LASTING = 5.0
"""Windows in which the model's error is about the same. Whoever fuses poses takes their errors for independent, so it is
published with so many times its variance."""
SIZE_LASTS = 25.0
"""The same of what is not known of the limb's size, which stays for as long as the person does."""
LINKS_ERROR = 0.005
"""Standard deviation of what the robot's other links are predicted to change, as a share."""
ROLL_MEMORY_S = 0.1
"""MEMORY_S of the roll about the limb's axis. Short: a wrong roll that was once believed must not be kept for seconds."""
SLIDES = (0.0, -0.08, 0.08, -0.16, 0.16)
"""From scratch the solve starts from home moved so far along the limb [m]: thick and thin parts are felt alike …"""
CLEARANCE = 0.05
"""… and with a gap of at least this [m]: from inside a pad nothing leads out."""
FARTHEST = 1.0
"""The gap [m] that stands for everything beyond."""
REACH = 4.0 / 3.0
"""In range: the smallest gap is below this share of the pad's range (20 cm of 15) …"""
WORTH = 0.03
"""… and the best known direction is better than this [m]."""


@dataclass(frozen=True)
class Place:
    """Where the limb may be: T_world_target (4, 4) and its covariance (6, 6)."""

    T: Array
    covariance: Array

    def is_apart(self, other: Place) -> bool:
        """Whether two places differ by more than is unknown of them."""
        offset = self.T[:3, 3] - other.T[:3, 3]
        spread = (self.covariance + other.covariance)[:3, :3] + SAME**2 * np.eye(3)
        return float(offset @ np.linalg.solve(spread, offset)) > APART


@dataclass(frozen=True)
class Estimate:
    """T_world_target (4, 4) and information (6, 6) of the voltages alone, zero along what they do not show; gap [m]: the
    smallest from an electrode to the skin, at most FARTHEST; in_range: worth using; why: the reason where it is not; residuals
    (n,): what the limb leaves unexplained, in standard deviations."""

    T: Array
    information: Array
    gap: float
    in_range: bool
    why: str
    residuals: Array


class Estimator:
    """home (4, 4), spread (6,): where the target is expected; network: None where none was trained (the solve then starts
    from home); method: `solve`, or `paper` for the network alone; measured: whether the limb's size is that of the cell file's
    target, and not any person's. Raises ValueError for `paper` without a network."""

    def __init__(
        self,
        skin: Skin,
        response: Response,
        surface: Surface,
        home: Array,
        spread: Array,
        network: PoseNetwork | None = None,
        method: str = "solve",
        measured: bool = False,
    ):
        if method not in ("solve", "paper"):
            raise ValueError(f"method: solve or paper expected, {method!r} came")
        if method == "paper" and network is None:
            raise ValueError("method paper needs the network's weights: run `penumbra haptics train` for this cell, or use solve")
        self.skin, self.surface, self.home, self.network, self.method = skin, surface, home, network, method
        self.size, self.tare = Size(measured), Tare(skin.noise)
        self._response, self._solver = response, Solver(skin, response)
        self._home_covariance = np.diag(np.asarray(spread, dtype=float) ** 2)
        self._home_information = np.linalg.inv(self._home_covariance)
        self._home = Place(home, self._home_covariance)
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._track, self._stamp_ns, self._tracking = self._home, 0, False
        self._waited, self._away_s, self._misfit, self._track_misfit = -1, 0.0, 1.0, 1.0
        self._pad_misfit = np.ones(len(self.skin.pads))
        self._rival: Place | None = None
        self._odds = 0.0  # log, of the track to the rival
        self._turn, self._rests, self._shown = 0, 0, False
        self.size.forget()
        self.tare.forget()

    def nothing(self, why: str) -> Estimate:
        """The estimate when nothing can be felt: home, without information."""
        return Estimate(self.home, np.zeros((6, 6)), FARTHEST, False, why, np.zeros(len(self.skin)))

    def warm_up(self, joints: int) -> None:
        """Compile and touch everything once, so that the first real window takes no longer than the others."""
        pads = np.tile(np.eye(4), (len(self.skin.pads), 1, 1))
        amplitude = self.skin.volts(0.1)
        for stamp_ns in (1, 2, 3):
            self.update(stamp_ns, amplitude, np.full(len(self.skin), 10), pads, np.zeros(joints))
        self.reset()

    @property
    def pose(self) -> Array:
        """T_world_target that is most probable after the last window, with what earlier windows said."""
        return self._track.T

    def update(
        self,
        stamp_ns: int,
        amplitude: Array,
        samples: NDArray[np.integer],
        T_world_pads: Array,
        joints: ArrayLike = (),
        expected: tuple[Array, Array] | None = None,
    ) -> Estimate:
        """The estimate at stamp_ns of mean voltages (n,) over so many samples (n,), none for electrodes to leave out, with the
        pads at T_world_pads (p, 4, 4); expected: T_world_target (4, 4) and covariance (6, 6) by all senses."""
        samples = np.asarray(samples)
        if not (samples > 0).any():
            return self.nothing("no electrode can be believed")
        elapsed_s = self._predict(stamp_ns)
        self._shown = expected is not None and self._expect(*expected)
        own = self.skin.gain * self.skin.sensitivity * self._response.rest(joints)  # what the robot's other links change
        signal = np.where(samples > 0, self.skin.signal(amplitude) - own - self.tare.offset, 0.0)
        variance = np.where(samples > 0, self.skin.noise / np.maximum(samples, 1), np.inf)
        distrust = np.maximum(1.0, self._pad_misfit / PAD_MISFIT) ** 2
        window = Window(signal, variance, T_world_pads, distrust[self.skin.pad_of], LINKS_ERROR * own)
        estimate = self._by_network(window, joints) if self.method == "paper" else self._by_solve(window, joints)
        self.tare.update(signal, samples, elapsed_s, estimate.in_range)
        self._away_s = 0.0 if estimate.in_range else self._away_s + elapsed_s
        if self._away_s > PERSON_S:
            self.size.forget()
        return estimate

    def _by_network(self, window: Window, joints: ArrayLike) -> Estimate:
        assert self.network is not None
        x = self._features(window, joints)
        self._track = Place(self.network.posterior(x), self._home_covariance)
        relative = Relative.of(self.skin, self.surface, window.T_world_pads, np.isfinite(window.variance), self._track.T)
        T, information = self.network.likelihood(x, relative)
        return self._estimate(T, information, self._gap(window, T, self.size.mean), "", np.zeros(len(self.skin)))

    def _by_solve(self, window: Window, joints: ArrayLike) -> Estimate:
        solution = self._tracked(window, joints)
        T, size = solution.T, solution.size
        gap = self._gap(window, T, size)
        mean, scatter = self._mixture()
        self._track_misfit = self._smoothed(self._track_misfit, solution)
        self._tracking = self._track_misfit <= MISFIT
        squares = np.minimum(solution.residuals**2, PAD_WORST)
        used = np.maximum(np.add.reduceat(np.isfinite(window.variance).astype(float), self.skin.first[:-1]), 1.0)
        self._pad_misfit += PAD_SHARE * (np.add.reduceat(squares, self.skin.first[:-1]) / used - self._pad_misfit)
        if gap < SIZE_GAP and self._tracking and self._rival is None:
            self.size.learn(size, *self._solver.likelihood(window, solution, SIZE_LASTING), self._home_information)
        self._misfit = self._smoothed(self._misfit, solution)
        if self._misfit > NO_LIMB or self.size.strangeness > STRANGE:
            return self._estimate(T, np.zeros((6, 6)), gap, FOREIGN, solution.residuals)
        information, gradient = _size_known(*self._solver.likelihood(window, solution, LASTING), size, self.size, SIZE_LASTS)
        information, gradient = self._without_roll(T, information, gradient)
        if scatter.any():  # it lasts as the model's error does
            keep = np.linalg.inv(np.eye(6) + LASTING * information @ scatter)
            gradient = keep @ (gradient + information @ mean)
            information = keep @ information
        trust = 1.0 / max(1.0, solution.misfit)  # voltages that are explained badly say less than their noise promises
        best, known = peak(T, trust * information, trust * gradient)
        turn = np.eye(6)
        turn[3:, 3:] = best[:3, :3] @ T[:3, :3].T  # what is unknown about T's axis is so about the published one
        known = turn @ known @ turn.T
        return self._estimate(best, 0.5 * (known + known.T), gap, "", solution.residuals)

    def _tracked(self, window: Window, joints: ArrayLike) -> Solution:
        """The solution at the track, or at the rival where that is more probable by now, or the best one from scratch. Takes both
        places on."""
        if not self._tracking:
            self._waited += 1
            if self._waited % AGAIN == 0:
                return self._from_scratch(window, joints)
        prior = self._prior(self._track)
        solution = self._solve(window, prior, self._track.T, coarse=0 if self._tracking else 12)
        if self._tracking and self._smoothed(self._track_misfit, solution) > MISFIT:
            self._waited = 0
            return self._from_scratch(window, joints)
        self._track = self._place(window, solution, prior)
        if self._rival is not None:
            return self._compared(window, self._rival, solution, solution.cost - prior.cost(solution))
        if self._tracking and not self._shown:
            self._look_elsewhere(window, joints, solution)
        return solution

    def _compared(self, window: Window, rival: Place, solution: Solution, cost: float) -> Solution:
        """The solution at the track, whose voltages have this cost, or that at the rival where it is more probable by now. Only
        the voltages count: what was believed before is in the odds already."""
        prior = self._prior(rival)
        other = self._solve(window, prior, rival.T, coarse=0)
        rival = self._place(window, other, prior)
        self._odds += float(np.clip(other.cost - prior.cost(other) - cost, -CLEAR, CLEAR))
        if self._odds < 0.0:
            self._track, rival, solution, self._odds = rival, self._track, other, -self._odds
        self._contest(rival, self._odds)
        return solution

    def _contest(self, rival: Place, odds: float) -> None:
        """Keeps a rival with these log odds of the track, where it is another place and possible."""
        possible = odds < CONVINCING and rival.is_apart(self._track)
        self._rival, self._odds = rival if possible else None, max(odds, 0.0)

    def _look_elsewhere(self, window: Window, joints: ArrayLike, solution: Solution) -> None:
        """Now and then solves from another start than the track, whose solution this is; another place becomes its rival."""
        self._rests = (self._rests + 1) % OTHER_EVERY
        if self._rests:
            return
        home = self._prior(self._home)
        other = self._solve(window, home, self._elsewhere(window, joints))
        rival = self._place(window, other, home)
        if rival.is_apart(self._track):
            # the track is judged with the same freedom: from its pose, but with home's spread
            same = self._solver.solve(window, home, solution.T, solution.size, 0, 2)
            self._contest(rival, BESIDE + float(np.clip(other.cost - same.cost, -CLEAR, CLEAR)))

    def _elsewhere(self, window: Window, joints: ArrayLike) -> Array:
        """The next start from scratch that is not the track's own place."""
        along = float((self._track.T[:3, 3] - self.home[:3, 3]) @ self.home[:3, 0])
        self._turn = (self._turn + 1) % (len(SLIDES) + 1)
        if self._turn < len(SLIDES) and abs(SLIDES[self._turn] - along) < TRACKS_OWN:
            self._turn += 1
        return self._start(self._turn, window, joints)

    def _from_scratch(self, window: Window, joints: ArrayLike) -> Solution:
        """The best solution from everywhere and from the track; the next best one at another place becomes the rival."""
        home = self._prior(self._home)
        starts = [self._track.T, *(self._start(which, window, joints) for which in range(len(SLIDES) + 1))]
        best, *others = sorted((self._solve(window, home, start) for start in starts), key=lambda solution: solution.cost)
        self._track, self._track_misfit = self._place(window, best, home), best.misfit
        self._rival = None
        for other in others:
            if self._rival is None and other.cost - best.cost < CONVINCING:
                self._contest(self._place(window, other, home), other.cost - best.cost)
        return best

    def _place(self, window: Window, solution: Solution, prior: Prior) -> Place:
        """Where the limb is by a window's solution from a prior."""
        information, gradient = self._solver.likelihood(window, solution)
        information = _size_known(information, gradient, solution.size, self.size, 1.0)[0] + prior.information
        return Place(solution.T, np.asarray(np.linalg.inv(information), np.float64))

    def _mixture(self) -> tuple[Array, Array]:
        """Mean (6,), as a pose error from the track, and scatter (6, 6) of the track and its rival."""
        if self._rival is None:
            return np.zeros(6), np.zeros((6, 6))
        offset, share = pose_error(self._rival.T, self._track.T), 1.0 / (1.0 + np.exp(self._odds))
        return share * offset, share * (1.0 - share) * np.outer(offset, offset)

    @staticmethod
    def _smoothed(misfit: float, solution: Solution) -> float:
        return misfit + MISFIT_SHARE * (min(solution.misfit, WORST) - misfit)

    def _start(self, which: int, window: Window, joints: ArrayLike) -> Array:
        """Where a solve from scratch begins: home with one of its slides, no nearer to the pads than CLEARANCE, or the network's
        pose."""
        if which == len(SLIDES):
            return self.home if self.network is None else self.network.posterior(self._features(window, joints))
        T = self.home.copy()
        T[:3, 3] += SLIDES[which] * T[:3, 0]
        normal = window.T_world_pads[:, :3, 2].mean(axis=0)
        normal /= np.linalg.norm(normal) + 1e-9
        for _ in range(3):
            short = CLEARANCE - self._gap(window, T, self.size.mean)
            if short < 0.005:
                break
            T[:3, 3] += short * normal
        return T

    def _solve(self, window: Window, prior: Prior, start: Array, coarse: int = 12) -> Solution:
        return self._solver.solve(window, prior, start, self.size.mean, coarse=coarse)

    def _prior(self, place: Place) -> Prior:
        return Prior(place.T, np.asarray(np.linalg.inv(place.covariance), np.float64), self.size.mean, self.size.information)

    def _features(self, window: Window, joints: ArrayLike) -> NDArray:
        assert self.network is not None
        variance = window.variance + (self._response.error * np.maximum(window.signal, 0.0)) ** 2
        return features(self.skin, self.network.home, window.signal, variance, window.T_world_pads, joints)

    def _predict(self, stamp_ns: int) -> float:
        """Takes the track and its rival to a window's stamp; returns the seconds since the last one."""
        elapsed_s = (stamp_ns - self._stamp_ns) * 1e-9
        if not 0.0 <= elapsed_s < MEMORY_S:
            self.reset()
            elapsed_s = 0.0
        self._stamp_ns = stamp_ns
        self.size.predict(elapsed_s)
        self._track = self._drifted(self._track, elapsed_s)
        self._rival = None if self._rival is None else self._drifted(self._rival, elapsed_s)
        return elapsed_s

    def _drifted(self, place: Place, elapsed_s: float) -> Place:
        """A place after so many seconds in which nothing was felt."""
        keep = np.exp(-elapsed_s / MEMORY_S)
        T = perturb(self.home, keep * pose_error(place.T, self.home))
        covariance = keep**2 * place.covariance + (1.0 - keep**2) * self._home_covariance
        forgotten = 1.0 - np.exp(-elapsed_s / ROLL_MEMORY_S)
        T = _turned(T, -forgotten * self._roll(T))
        axis = _roll_axis(T)
        spread = float(axis @ self._home_covariance @ axis) - float(axis @ covariance @ axis)
        return Place(T, covariance + max(0.0, (1.0 - (1.0 - forgotten) ** 2) * spread) * np.outer(axis, axis))

    def _expect(self, T: Array, covariance: Array) -> bool:
        """Looks around a pose (4, 4) with its covariance (6, 6), where it is known well enough; whether it is. Then there is no
        rival, and none is looked for."""
        known = float(np.linalg.eigvalsh(covariance[:3, :3])[-1]) < EXPECTED_SIGMA**2
        if known:
            wider = EXPECTED_INFLATION**2 * covariance + np.diag(np.repeat(np.square(EXPECTED_FLOOR), 3))
            self._track, self._rival = Place(T, wider), None
        return known

    def _roll(self, T: Array) -> float:
        """The turn about the limb's axis [rad] from home: the twist of the rotation between them."""
        R = self.home[:3, :3].T @ T[:3, :3]
        return float(2.0 * np.arctan2(R[2, 1] - R[1, 2], 1.0 + np.trace(R)))

    def _without_roll(self, T: Array, information: Array, gradient: Array) -> tuple[Array, Array]:
        """Information (6, 6) and gradient (6,) after the roll about the limb's axis, known as well as at home, was marginalised:
        only the flatness of wrist and hand shows it, with several solutions that look equally certain."""
        axis = _roll_axis(T)
        known = float(axis @ self._home_information @ axis)
        gradient = gradient + axis * (known * float(axis @ pose_error(self.home, T)))
        return marginal(information + known * np.outer(axis, axis), gradient, axis[:, None])

    def _gap(self, window: Window, T: Array, size: Array) -> float:
        """Smallest gap [m] from an electrode in use to the skin of a limb at T of this size; negative inside."""
        scale = np.exp(size[[0, 1, 1]])
        local = (self.skin.positions(window.T_world_pads)[np.isfinite(window.variance)] - T[:3, 3]) @ T[:3, :3] / scale
        distance, _, gradient = self.surface.nearest(local)
        return float((distance / np.linalg.norm(gradient / scale, axis=1)).min())

    def _estimate(self, T: Array, information: Array, gap: float, why: str, residuals: Array) -> Estimate:
        scale = np.array([1.0, 1.0, 1.0, 1.0 / LEVER, 1.0 / LEVER, 1.0 / LEVER])
        strongest = float(np.linalg.eigvalsh(information * np.outer(scale, scale))[-1])
        if not why and (gap >= REACH * float(self.skin.range.max()) or strongest <= 1.0 / WORTH**2):
            why = "nothing near"
        return Estimate(T, np.zeros((6, 6)) if why else information, min(max(gap, 0.0), FARTHEST), not why, why, residuals)


def _size_known(information: Array, gradient: Array, size: Array, known: Size, lasting: float) -> tuple[Array, Array]:
    """Information (6, 6) and gradient (6,) of the pose after the size was marginalised that is known so well. Its error lasts as
    well: lasting is the factor on its covariance."""
    information, gradient = information.copy(), gradient.copy()
    information[6:, 6:] += known.information / lasting
    gradient[6:] += known.information @ (known.mean - size) / lasting
    information, gradient = marginal(information, gradient, np.eye(8)[:, 6:])
    return information[:6, :6], gradient[:6]


def _turned(T: Array, roll: float) -> Array:
    return perturb(T, roll * _roll_axis(T))


def _roll_axis(T: Array) -> Array:
    """The pose error (6,) of a turn by one radian about the limb's axis."""
    return np.concatenate([np.zeros(3), T[:3, 0]])
