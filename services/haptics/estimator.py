"""Estimates one limb pose per window of voltages, from all pads together.

Each window is estimated from its own samples, and its likelihood is published. Earlier windows only set where the solve starts
and its prior, and the slowly changing states (`person.py`, `drift.py`). The steps of a window:

1. predict: the track decays to its home (`track.py`), or moves to a fused pose that is known well, or better than the track
2. solve from there (`solve.py`), with the learned size and shoulder as a prior; where nothing is felt, the track stays
3. if that does not explain the voltages, or nothing is tracked, solve from scratch: from the likeliest of `starts.py`
4. far from the pads, thick and thin parts of a limb feel alike: another possible place, from scratch, found beside the track or
   at the fused pose, is kept as its rival and solved as well, until the windows have decided between the two
5. learn the trust in each pad (`trust.py`), the limb's size close to the pads, and while nothing is near or a camera sees the
   limb the drift of the electrodes and where the shoulder is
6. add up the evidence on whether the object that is felt is a limb (`identity.py`)
7. publish the likelihood: body and roll marginalised, the errors of model and drift counted as nearly the same in several
   windows; if there is a rival, the likelihood of the mixture of the two
8. independently of the pose: the nearest surface point before each pad (`surface_points.py`), and contact (`contact.py`)

Voltages that no limb explains (a metal part, a block) are reported as an object, and as unidentified until that is decided.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from penumbra.services.haptics.contact import Contact
from penumbra.services.haptics.drift import Drift, Seen
from penumbra.services.haptics.identity import Identity
from penumbra.services.haptics.paper_network import PoseNetwork, Relative, features
from penumbra.services.haptics.person import PERSON_S, SIZE_GAP, SIZE_LASTING, Person
from penumbra.services.haptics.settings import HapticSettings
from penumbra.services.haptics.solve import SCALES, Prior, Reading, Solution, Solver, peak
from penumbra.services.haptics.starts import Limb, Starts
from penumbra.services.haptics.surface_points import Shapes, SurfacePoint, SurfacePoints
from penumbra.services.haptics.track import Home, Place, Track
from penumbra.services.haptics.trust import PadTrust, SmoothedMisfit
from penumbra.shared.body.posture import Posture
from penumbra.shared.contract.messages import ContactState, HapticState
from penumbra.shared.geometry.rigid import Array, pose_error
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import Response

FOREIGN = "the signals fit no limb: another object is near"
"""`HapticEstimate.why` of voltages that no limb explains."""
UNIDENTIFIED = "the signals do not show yet whether a limb or another object is near"
"""`HapticEstimate.why` of voltages that a limb and other objects explain equally well."""
NOTHING = "nothing near"
"""`HapticEstimate.why` of voltages of empty space."""
WHY = {"in_range": "", "unidentified": UNIDENTIFIED, "object": FOREIGN, "out_of_range": NOTHING}
"""`HapticEstimate.why` by state."""


@dataclass(frozen=True)
class HapticEstimate:
    """T_world_target (4, 4) and information (6, 6) of the voltages alone: zero along unobserved directions, and all zero if the
    voltages are not a limb's; step (6,): pose error from the point of linearisation to T; gap [m]: smallest one from an electrode
    to the skin, at most `HapticSettings.farthest_gap`; state: see `HapticPose`, only `in_range` is worth using; why: the reason
    for any other state; residuals (n,): of the limb's fit, in standard deviations; surface: the nearest point before each pad
    that feels something; contact, touched: the contact state and the touched pads."""

    T: Array
    information: Array
    step: Array
    gap: float
    state: HapticState
    why: str
    residuals: Array
    surface: tuple[SurfacePoint, ...] = ()
    contact: ContactState = "none"
    touched: tuple[str, ...] = ()

    @property
    def in_range(self) -> bool:
        """Whether a limb is felt."""
        return self.state == "in_range"

    @property
    def may_be_limb(self) -> bool:
        """Whether a limb is felt, or an object that may be one."""
        return self.state in ("in_range", "unidentified")


class Estimator:
    """Haptic pose estimator of one target. home (4, 4), spread (6,): the expected pose; network: None if none was trained (the
    solve then starts from home); method: `solve`, or `paper` for the network alone; measured: whether the cell file states this
    person's limb size; shapes: None if they were not measured for these pads (then no surface points); posture: where the rest of
    the person is, None for a limb without one. Raises ValueError for `paper` without a network."""

    def __init__(
        self,
        skin: Skin,
        response: Response,
        surface: Surface,
        home: Array,
        spread: ArrayLike,
        network: PoseNetwork | None = None,
        method: str = "solve",
        measured: bool = False,
        settings: HapticSettings | None = None,
        shapes: Shapes | None = None,
        posture: Posture | None = None,
    ):
        if method not in ("solve", "paper"):
            raise ValueError(f"method: expected solve or paper, got {method!r}")
        if method == "paper" and network is None:
            raise ValueError("method paper needs the network's weights: run `penumbra haptics train` for this cell, or use solve")
        self.skin, self.surface, self.network, self.method = skin, surface, network, method
        self.settings = settings or HapticSettings()
        self.person = Person(measured, posture.spread if posture else 1.0)
        self.drift = Drift(skin, self.settings.links_error, self.person.usual[1])
        self.identity = Identity(skin, response.error, self.settings)
        self._response, self._solver = response, Solver(skin, response, posture)
        self._home = Home(home, spread, self.settings)
        self._limb, self._pads = Limb(skin, surface), PadTrust(skin, self.settings)
        self._track = Track(self._home, self.settings)
        self._starts = Starts(home, self._limb, self._network_pose, self.settings)
        self._points = None if shapes is None else SurfacePoints(skin, response, surface, shapes)
        self._contact = Contact(skin)
        self.reset()

    def reset(self) -> None:
        """Forget all earlier windows."""
        self._stamp_ns, self._away_s = 0, 0.0
        self._is_tracking, self._untracked = False, -1  # number of windows since the track was lost
        self._track_misfit = SmoothedMisfit(self.settings)
        for part in (self._track, self._starts, self._pads, self.person, self.drift, self.identity, self._contact):
            part.forget()

    def nothing(self, why: str) -> HapticEstimate:
        """The estimate when nothing can be felt: home, with zero information."""
        return HapticEstimate(
            self._home.T, np.zeros((6, 6)), np.zeros(6), self.settings.farthest_gap, "out_of_range", why, np.zeros(len(self.skin))
        )

    def warm_up(self, joints: int) -> None:
        """Compile and run everything once, so that the first real window takes no longer than the others."""
        pads = np.tile(np.eye(4), (len(self.skin.pads), 1, 1))
        amplitude = self.skin.volts(0.1)
        for stamp_ns in (1, 2, 3):
            self.update(stamp_ns, amplitude, np.full(len(self.skin), 10), pads, np.zeros(joints))
        self.reset()

    @property
    def pose(self) -> Array:
        """The most probable T_world_target after the last window, including earlier windows."""
        return self._track.place.T

    def update(
        self,
        stamp_ns: int,
        amplitude: Array,
        samples: NDArray[np.integer],
        T_world_pads: Array,
        joints: ArrayLike = (),
        expected: tuple[Array, Array] | None = None,
        pressed: NDArray[np.bool_] | None = None,
    ) -> HapticEstimate:
        """The estimate at stamp_ns from mean voltages (n,) over samples (n,), zero for electrodes to leave out, with the pads at
        T_world_pads (p, 4, 4). expected: fused T_world_target (4, 4) and covariance (6, 6); pressed (n,): see `VoltageWindow`."""
        samples = np.asarray(samples)
        if not (samples > 0).any():
            self._contact.forget()
            return self.nothing("no electrode is free of faults")
        elapsed_s = self._predict(stamp_ns)
        is_expected = expected is not None and self._track.expect(*expected)
        links = self.skin.gain * self.skin.sensitivity * self._response.rest(joints)
        reading = self._reading(amplitude, samples, T_world_pads, links, joints)
        seen = None
        if self.method == "paper":
            estimate = self._by_network(reading)
        else:
            estimate, seen = self._by_solve(reading, self._track.place if is_expected else None, elapsed_s)
        is_near = is_expected or estimate.state != "out_of_range"
        self.drift.take(reading.signal, links, samples, elapsed_s, seen, is_near)
        self._watch_absence(estimate.may_be_limb, elapsed_s)
        return estimate if self._points is None else self._with_surface(estimate, reading, pressed)

    # ---- the steps of a window

    def _predict(self, stamp_ns: int) -> float:
        """Predict all states to a window's stamp; returns the seconds since the last window."""
        elapsed_s = (stamp_ns - self._stamp_ns) * 1e-9
        if self._stamp_ns:  # not the first window
            self.drift.predict(max(elapsed_s, 0.0))
        if not 0.0 <= elapsed_s < self.settings.memory_s:
            self.reset()
            elapsed_s = 0.0
        self._stamp_ns = stamp_ns
        self.person.predict(elapsed_s, self.drift.shoulder)
        self._track.decay(elapsed_s)
        return elapsed_s

    def _reading(
        self, amplitude: Array, samples: NDArray[np.integer], T_world_pads: Array, links: Array, joints: ArrayLike
    ) -> Reading:
        """The signals: voltages less the electrodes' rests and the effect (n,) [V] of the robot's other links."""
        signal = np.where(samples > 0, self.drift.signal(self.skin.signal(amplitude), links), 0.0)
        variance = np.where(samples > 0, self.skin.noise / np.maximum(samples, 1), np.inf)
        gain, offset = self.drift.sigma
        doubt, error = np.hypot(self.settings.links_error * links, offset), np.hypot(self._response.error, gain)
        return Reading(signal, variance, T_world_pads, self._pads.distrust(), doubt, error, joints)

    def _with_surface(self, estimate: HapticEstimate, reading: Reading, pressed: NDArray[np.bool_] | None) -> HapticEstimate:
        """The estimate with surface points and contact."""
        assert self._points is not None
        ended = np.zeros(len(self.skin), np.bool_) if pressed is None else pressed
        points = self._points.find(reading.signal, reading.variance + reading.doubt**2, ended, reading.T_world_pads)
        contact = self._contact.take(points, reading.T_world_pads)
        return replace(estimate, surface=tuple(points), contact=contact, touched=self._contact.touched)

    def _by_network(self, reading: Reading) -> HapticEstimate:
        assert self.network is not None
        x = self._features(reading)
        self._track.place = Place(self.network.posterior(x), self._home.place.covariance)
        relative = Relative.of(self.skin, self.surface, reading.T_world_pads, np.isfinite(reading.variance), self.pose)
        T, information = self.network.likelihood(x, relative)
        gap = self._limb.gap(reading, T, self.person.size)
        state: HapticState = "in_range" if self._is_felt(information, gap) else "out_of_range"
        return self._estimate(T, information, np.zeros(6), gap, state, np.zeros(len(self.skin)))

    def _by_solve(self, reading: Reading, expected: Place | None, elapsed_s: float) -> tuple[HapticEstimate, Seen | None]:
        """The estimate, and the camera's prediction of the window. expected: the limb's place that a camera has just seen."""
        before = copy(self._track)
        solution = self._solution(reading, expected is not None)
        if self.identity.odds < 0.0 and before.place.is_apart(self._track.place, self.settings):
            self.identity.doubt()
        gap = self._limb.gap(reading, solution.T, solution.body[:2])
        self._judge(solution)
        self._learn_size(reading, solution, gap)
        information, gradient = self._pose_likelihood(reading, solution)
        information, gradient = self._home.without_roll(solution.T, information, gradient)
        information, gradient = self._track.mixed(information, gradient)
        T, information = self._peak(solution, information, gradient)
        is_felt = self._is_felt(information, gap)
        if not is_felt:
            self._track = before  # fits to noise would lead it away, and their covariances would call it sure
        state = self._identified(reading, solution, gap, expected, elapsed_s) if is_felt else self._absent(elapsed_s)
        self._pads.update(solution.residuals, np.isfinite(reading.variance))
        seen = None if expected is None or state == "object" else self._seen(reading, solution, expected)
        step = pose_error(T, solution.T)
        return self._estimate(T, self.settings.trusted * information, step, gap, state, solution.residuals), seen

    def _watch_absence(self, in_range: bool, elapsed_s: float) -> None:
        """Forget the size of a limb that has been away: the next one may be another person's."""
        self._away_s = 0.0 if in_range else self._away_s + elapsed_s
        if self._away_s > PERSON_S:
            self.person.forget()

    # ---- where the limb is

    def _solution(self, reading: Reading, is_expected: bool) -> Solution:
        """The solution at the track, or at its rival if that has become more probable, or the best one from scratch. Moves the
        track there. is_expected: the fused pose gives the limb's place, so no other place is searched for."""
        if not self._is_tracking:
            self._untracked += 1
            if self._untracked % self.settings.scratch_every == 0:
                return self._from_scratch(reading)
        prior = self._prior(self._track.place)
        solution = self._solve(reading, prior, self.pose, coarse=0 if self._is_tracking else 12)
        if self._is_tracking and self._track_misfit.after(solution.misfit) > self.settings.track_misfit:
            self._untracked = 0
            return self._from_scratch(reading)
        self._track.place = self._place(reading, solution, prior)
        may_be_elsewhere, fused = self._is_tracking and not is_expected, self._track.fused
        if may_be_elsewhere and fused is not None and not self._track.includes(fused):
            self._contest(reading, solution, fused.T, 0, lambda evidence: evidence / self.settings.error_lasts)
        if self._track.rival is not None:
            return self._compared(reading, solution, prior, self._track.rival)
        if may_be_elsewhere and (self._starts.is_due() or self.identity.odds < 0.0):
            elsewhere = self._starts.elsewhere(reading, self.pose, self.person.size)
            self._contest(
                reading, solution, elsewhere, 12, lambda evidence: self.settings.beside_odds + self._track.limited(evidence)
            )
        return solution

    def _compared(self, reading: Reading, solution: Solution, prior: Prior, rival: Place) -> Solution:
        """The solution at the track, found from this prior, or at the rival if that has become more probable. Only the voltages
        count as evidence: the odds already contain the priors. The field model's error is nearly the same in several windows, so
        each of them counts for its share only."""
        rival_prior = self._prior(rival)
        other = self._solve(reading, rival_prior, rival.T, coarse=0)
        evidence = other.cost - rival_prior.cost(other) - (solution.cost - prior.cost(solution))
        evidence /= self.settings.error_lasts
        return other if self._track.weigh(self._place(reading, other, rival_prior), evidence) else solution

    def _contest(self, reading: Reading, solution: Solution, start: Array, coarse: int, odds: Callable[[float], float]) -> None:
        """Solve from another start (4, 4) than the tracked solution; a different place becomes its rival, if it is more probable
        than the rival before. odds: of the track, by the evidence of the window for it."""
        home = self._prior(self._home.place)
        other = self._solve(reading, home, start, coarse)
        rival = self._place(reading, other, home)
        if not self._track.includes(rival):
            # judge the track with the same freedom: from its pose, but with home's spread
            same = self._solver.solve(reading, home, solution.T, solution.body, 0, 2)
            odds_to_rival = odds(other.cost - same.cost)
            if self._track.rival is None or odds_to_rival < self._track.odds:
                self._track.contest(rival, odds_to_rival)

    def _from_scratch(self, reading: Reading) -> Solution:
        """The best solution from the fused pose, the track and all starts, of which the most probable ones are solved; the second
        best at another place becomes the rival."""
        home, track = self._prior(self._home.place), self._track
        starts = [self.pose, *(self._starts.at(which, reading, self.person.size) for which in range(len(self._starts)))]
        cost = [self._solver.solve(reading, home, start, self.person.mean, coarse=0, fine=0).cost for start in starts]
        likely = [starts[which] for which in np.argsort(cost)[: self.settings.scratch_solves]]
        if track.fused is not None:
            likely.append(track.fused.T)
        best, *others = sorted((self._solve(reading, home, start) for start in likely), key=lambda solution: solution.cost)
        track.place, track.rival = self._place(reading, best, home), None
        self._track_misfit.value = best.misfit
        for other in others:
            if track.rival is None and other.cost - best.cost < self.settings.odds_decided:
                track.contest(self._place(reading, other, home), other.cost - best.cost)
        return best

    def _solve(self, reading: Reading, prior: Prior, start: Array, coarse: int = 12) -> Solution:
        return self._solver.solve(reading, prior, start, self.person.mean, coarse=coarse)

    def _prior(self, place: Place) -> Prior:
        return Prior(place.T, place.information, self.person.mean, self.person.information)

    def _place(self, reading: Reading, solution: Solution, prior: Prior) -> Place:
        """The limb's place by a window's solution from a prior."""
        information, gradient = self._solver.likelihood(reading, solution)
        information = self.person.marginalised(information, gradient, solution.body)[0] + prior.information
        return Place(solution.T, np.asarray(np.linalg.inv(information), np.float64))

    def _network_pose(self, reading: Reading) -> Array:
        """The network's pose, or home if there is no network."""
        return self._home.T if self.network is None else self.network.posterior(self._features(reading))

    def _features(self, reading: Reading) -> NDArray[np.float32]:
        assert self.network is not None
        variance = reading.variance + (self._response.error * np.maximum(reading.signal, 0.0)) ** 2
        return features(self.skin, self.network.home, reading.signal, variance, reading.T_world_pads, reading.joints)

    # ---- what a solution tells

    def _judge(self, solution: Solution) -> None:
        """Update whether the track still explains the voltages."""
        self._track_misfit.take(solution.misfit)
        self._is_tracking = self._track_misfit.value <= self.settings.track_misfit

    def _learn_size(self, reading: Reading, solution: Solution, gap: float) -> None:
        """Learn the size where it can be separated from the pose: close to the pads, without a rival."""
        if gap < SIZE_GAP and self._is_tracking and self._track.rival is None:
            likelihood = self._solver.likelihood(reading, solution, SIZE_LASTING)
            self.person.learn(solution.body, *likelihood, self._home.place.information)

    def _identified(
        self, reading: Reading, solution: Solution, gap: float, expected: Place | None, elapsed_s: float
    ) -> HapticState:
        """The state after a window and its best limb solution; elapsed_s: time since the last window."""
        free = self._solver.free(reading, solution, self._prior(self._home.place))
        self.identity.take(reading, solution, free, gap, elapsed_s)
        if self.person.strangeness > self.settings.strange_size:
            self.identity.refuse()
        is_there = expected is not None and not self._track.place.is_apart(expected, self.settings)
        if is_there and solution.misfit < self.settings.track_misfit:
            self.identity.see()
        verdict = self.identity.verdict
        if verdict == "object":
            self.person.forget()  # it was not a limb's size
        return "in_range" if verdict == "limb" else verdict

    def _absent(self, elapsed_s: float) -> HapticState:
        self.identity.miss(elapsed_s)
        return "out_of_range"

    def _seen(self, reading: Reading, solution: Solution, expected: Place) -> Seen | None:
        """The camera's prediction for a limb at the expected place; None if the voltages say that it is elsewhere."""
        if self._track.place.is_apart(expected, self.settings):
            return None
        toward = np.concatenate([pose_error(expected.T, solution.T), self.person.usual[0] - solution.body])
        slopes = solution.signal[:, None] * solution.point.rows
        gains = np.square(reading.error) - np.square(self._response.error)
        error = np.sqrt(np.square(solution.point.error) - gains)
        return Seen(solution.signal, error, slopes, toward, expected.covariance, solution.T[:3, 3])

    def _pose_likelihood(self, reading: Reading, solution: Solution) -> tuple[Array, Array]:
        """Information (6, 6) and gradient (6,) of the pose from the voltages alone, with the body marginalised."""
        likelihood = self._solver.likelihood(reading, solution, self.settings.error_lasts)
        return self.person.marginalised(*likelihood, solution.body, self.settings.size_lasts)

    def _peak(self, solution: Solution, information: Array, gradient: Array) -> tuple[Array, Array]:
        """T_world_target (4, 4) where a likelihood at the solution peaks, and its information (6, 6) there. Voltages with a large
        misfit carry less information than their noise suggests."""
        trust = 1.0 / max(1.0, solution.misfit)
        best, known = peak(solution.T, trust * information, trust * gradient)
        turn = best[:3, :3] @ solution.T[:3, :3].T  # rotate the unobserved directions with the pose
        known[3:] = turn @ known[3:]
        known[:, 3:] = known[:, 3:] @ turn.T
        return best, 0.5 * (known + known.T)

    def _is_felt(self, information: Array, gap: float) -> bool:
        """Whether something is near: within range, and known well enough along at least one direction."""
        if gap >= self.settings.range_share * float(self.skin.range.max()):
            return False
        return float(np.linalg.eigvalsh(information * SCALES)[-1]) > 1.0 / self.settings.worst_sigma**2

    def _estimate(
        self, T: Array, information: Array, step: Array, gap: float, state: HapticState, residuals: Array
    ) -> HapticEstimate:
        known = information if state in ("in_range", "unidentified") else np.zeros((6, 6))
        gap = min(max(gap, 0.0), self.settings.farthest_gap)
        return HapticEstimate(T, known, step, gap, state, WHY[state], residuals)
