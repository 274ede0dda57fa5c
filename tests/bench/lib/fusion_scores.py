"""Plays runs of the fusion benchmark to the observer and its baselines, and scores them.

`tests.bench.fusion`, which draws the runs and summarises them, explains the scores.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from penumbra.services.fusion.estimate import Estimate
from penumbra.services.fusion.observer import ErrorStateObserver
from penumbra.services.fusion.paper import PaperObserver
from penumbra.shared.contract.senses import SENSES
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.tests.bench.lib import fusion_runs as runs
from penumbra.tests.bench.lib.fusion_baselines import FixedLagSmoother, Newest

HOME, SPREAD = rigid.from_rpy([0.0, 0.0, 0.2], [0.0, 0.0, 0.0]), (0.12, 0.4)
"""Home and spread of the target in the cell `table`."""
INSTANTS_S = 0.11
"""Interval [s] between scored moments: it passes through all phases of both senses' periods."""
LATE_S = {"0": (0.0, 0.0), "50": (0.05, 0.05), "200": (0.2, 0.2), "shuffled": (0.0, 0.2)}
CONFIDENCE = 0.95
THREE_SIGMA = 0.9973
"""Share of normal errors within three standard deviations."""
NOTICED_S, GUESSED_S = 0.1, 0.5
"""Times [s] within which a jump must be noticed, and for which a limb that nothing measures must still be known."""
PUBLISHED_HZ = 200.0
BASELINES = ("oracle", "average", "gtsam", "paper")
SLOW, SLOW_EVERY = ("gtsam", "paper"), 4
"""Baselines that take most of the time, and are played in every fourth run only."""
SOURCES = tuple(sense.name for sense in SENSES)


@dataclass(frozen=True)
class Scores:
    """One run: at scored instants [s] (k,) the errors [m] of the observer and of each baseline that was played, the NEES and its
    degrees of freedom, and its state; of every accepted measurement its stamp [s], NIS and degrees of freedom (n,); by source the
    errors [m] of the measurements and of the observer at their stamps (m, 2); the number of refused measurements."""

    times: Array
    errors: dict[str, Array]
    nees: Array
    nees_dof: Array
    states: NDArray[np.str_]
    stamps: Array
    nis: Array
    nis_dof: Array
    at_stamps: dict[str, Array]
    gated: int


def normalised(truth: Array, T: Array, covariance: NDArray[np.floating[Any]], rolls: bool) -> float:
    """The squared pose error of T (4, 4) in units of its covariance (6, 6); without `rolls` that of its place and of the limb's
    axis, five directions."""
    error = rigid.pose_error(truth, T)
    if not rolls:
        turn = np.cross(T[:3, 0], truth[:3, 0])  # of the axis alone: a roll of tens of degrees is no error of it
        error[3:] = rigid.axis_angle_error(truth, T) * turn / max(float(np.linalg.norm(turn)), 1e-12)
        axes = np.eye(6)
        axes[3:, 3:] = T[:3, :3]
        seen = np.delete(axes, 3, axis=1)
        error, covariance = seen.T @ error, seen.T @ covariance @ seen
    return float(error @ np.linalg.solve(covariance, error))


def band(dof: Sequence[float] | Array) -> tuple[float, float]:
    """The 95 % band of the mean of independent chi-square values with these degrees of freedom."""
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = chi2.ppf([tail, 1.0 - tail], np.sum(dof)) / len(dof)
    return float(low), float(high)


def consistency(times: Array, values: Array, dof: Array, count: int) -> dict[str, Any]:
    """Mean, band and share of instants inside of values (n,) at times (n,), of `count` runs; None where there are none."""
    if not len(values):
        return {"mean": None, "band": None, "inside": None}
    low, high = band(np.full(count, dof.mean()))
    instants = np.round(1000.0 * times).astype(int)
    inside = []
    for instant in np.unique(instants):
        here = instants == instant
        bounds = band(dof[here])
        inside.append(bounds[0] <= values[here].mean() <= bounds[1])
    return {"mean": float(values.mean()), "band": [low, high], "inside": float(np.mean(inside))}


class Player:
    """Passes the messages of a run to `takers` in the order of arrival."""

    def __init__(self, run: runs.Run, takers: Iterable[Callable[[runs.Message], object]]):
        self._messages, self._takers, self._next = run.messages, list(takers), 0

    def until(self, now: float) -> None:
        while self._next < len(self._messages) and self._messages[self._next].arrival <= now + 1e-6:  # a tie is an arrival
            for take in self._takers:
                take(self._messages[self._next])
            self._next += 1


def instants(run: runs.Run) -> list[float]:
    """The moments [s] of a run that count."""
    every = np.arange(INSTANTS_S, run.seconds, INSTANTS_S)
    return [float(t) for t in every if run.situation.scored(t)]


def taking(observer: ErrorStateObserver | PaperObserver) -> Callable[[runs.Message], bool]:
    return lambda m: observer.measure(m.source, runs.ns(m.stamp), m.T, m.information, m.hidden)


def scored(name: str, seed: int, index: int, seconds: float) -> Scores:
    """One run of a situation, played to the observer and to all baselines."""
    run = runs.drawn(name, seed, index, seconds)
    if run.situation.wrong:
        run = runs.wronged(run, seed, index)
    ours, paper = ErrorStateObserver(HOME, SPREAD), PaperObserver(HOME, SPREAD)
    newest, smoother = Newest(), FixedLagSmoother(HOME, SPREAD)
    rivals = [taking(paper), smoother.take] if index % SLOW_EVERY == 0 else []
    at_stamps: dict[str, list[tuple[float, float]]] = {source: [] for source in SOURCES}

    def compare(m: runs.Message) -> None:
        if run.situation.scored(m.stamp):
            truth = run.at(m.stamp)
            at_stamps[m.source].append((_distance(truth, m.T), _distance(truth, ours.estimate(runs.ns(m.stamp)).T)))

    player = Player(run, [taking(ours), compare, newest.take, *rivals])
    errors: dict[str, list[float]] = {key: [] for key in ("ours", *BASELINES)}
    times, nees, dof, states = instants(run), [], [], []
    for now in times:
        player.until(now)
        truth, estimate = run.at(now), ours.estimate(runs.ns(now))
        poses = {"ours": estimate.T, "average": newest.average(now)}
        if rivals:
            poses |= {"gtsam": smoother.pose(now), "paper": paper.estimate(runs.ns(now)).T}
        for key, T in poses.items():
            errors[key].append(_distance(truth, T))
        errors["oracle"].append(newest.oracle(now, truth))
        rolls = run.situation.rolls(now)
        nees.append(normalised(truth, estimate.T, estimate.covariance, rolls))
        dof.append(6 if rolls else 5)
        states.append(estimate.state)
    stamps, nis, nis_dof = innovations(run)
    return Scores(
        np.array(times),
        {key: np.array(values) for key, values in errors.items()},
        np.array(nees),
        np.array(dof),
        np.array(states),
        stamps,
        nis,
        nis_dof,
        {source: np.array(pairs).reshape(-1, 2) for source, pairs in at_stamps.items()},
        sum(counts.gated for counts in ours.log.counts.values()),
    )


def innovations(run: runs.Run) -> tuple[Array, Array, Array]:
    """Stamps [s], NIS and degrees of freedom of all accepted measurements of a settled observer, each as its sense reported
    it and in the order of the stamps: a late one is judged once, with all earlier ones known."""
    observer, found = ErrorStateObserver(HOME, SPREAD), []
    for m in runs.delayed(run, lambda: 0.0).messages:
        accepted = taking(observer)(m)
        if accepted and m.stamp >= runs.SETTLED_S:
            found.append((m.stamp, *observer.innovation()))
    stamps, nis, dof = np.array(found).reshape(-1, 3).T
    return stamps, nis, dof


def shift(seed: int, index: int, seconds: float) -> tuple[float, float]:
    """Largest displacement [m] of the pose by a wrong sense, against the same run in which it is right, and by the same sense
    when it is silent for as long."""
    right, times = _beside(seed, index, seconds)
    wrong, silent = runs.wronged(right, seed, index), runs.silenced(right, index)
    track, moved, missed = (_poses(run, times) for run in (right, wrong, silent))
    return _apart(track, moved), _apart(track, missed)


@dataclass(frozen=True)
class Way:
    """The effect of a sense that is wrong in one way: largest displacement of the pose [m]; number of poses from then on, of
    those called tracking, and of the latter beyond three sigma."""

    moved: float
    poses: int
    tracked: int
    beyond: int


SILENT = "silent"
"""Name of the way in which a sense is silent instead of wrong."""


def ways(seed: int, index: int, seconds: float) -> dict[str, Way]:
    """One run for each way in which a sense is wrong, and one in which it is silent, against that in which it is right."""
    right, times = _beside(seed, index, seconds)
    track = _poses(right, times)
    played = {name: runs.wronged(right, seed, index, way) for name, way in runs.WAYS.items()}
    found = {}
    for name, run in {**played, SILENT: runs.silenced(right, index)}.items():
        estimates = _poses(run, times)
        tracked = [(right.at(t), each) for t, each in zip(times, estimates, strict=True) if each.state == "tracking"]
        beyond = sum(bool(normalised(T, each.T, each.covariance, True) > chi2.ppf(THREE_SIGMA, 6)) for T, each in tracked)
        found[name] = Way(_apart(track, estimates), len(times), len(tracked), beyond)
    return found


def _beside(seed: int, index: int, seconds: float) -> tuple[runs.Run, list[float]]:
    """A run in which both senses are right, and the moments [s] at which a wrong one is compared with it."""
    end = min(seconds, runs.WRONG_S[1] + 4.0)
    return runs.drawn("one sense wrong", seed, index, end), np.arange(runs.WRONG_S[0], end, 0.02).tolist()


def _poses(run: runs.Run, times: list[float]) -> list[Estimate]:
    """The observer's estimates at some moments [s] of a run."""
    observer = ErrorStateObserver(HOME, SPREAD)
    player, found = Player(run, [taking(observer)]), []
    for now in times:
        player.until(now)
        found.append(observer.estimate(runs.ns(now)))
    return found


def _apart(one: list[Estimate], other: list[Estimate]) -> float:
    """The largest distance [m] between poses of the same moments."""
    return max((_distance(a.T, b.T) for a, b in zip(one, other, strict=True)), default=0.0)


@dataclass(frozen=True)
class Jump:
    """One jump: time until it was noticed [s]; number of poses called tracking after NOTICED_S, and of those beyond three sigma;
    time until the pose was right and called tracking again [s]."""

    noticed: float
    tracked: int
    wrong: int
    again: float


def jump(seed: int, index: int, seconds: float) -> Jump:
    """One run with a jump at half its time; in every other run the skin feels the limb as well."""
    run = runs.jumped("one sense wrong" if index % 2 else "visible", seed, index, seconds)
    observer, begin = ErrorStateObserver(HOME, SPREAD), seconds / 2.0
    player, rows = Player(run, [taking(observer)]), []
    for now in np.arange(begin, min(seconds, begin + 4.0), 1.0 / PUBLISHED_HZ):
        player.until(now)
        estimate = observer.estimate(runs.ns(now))
        off = estimate.T[:3, 3] - run.at(now)[:3, 3]
        is_right = off @ np.linalg.solve(estimate.covariance[:3, :3], off) <= chi2.ppf(THREE_SIGMA, 3)
        rows.append((now - begin, estimate.state == "tracking", bool(is_right)))
    after = [(tracked, right) for t, tracked, right in rows if t > NOTICED_S]
    return Jump(
        next((t for t, tracked, right in rows if right or not tracked), seconds),
        sum(tracked for tracked, _ in after),
        sum(tracked and not right for tracked, right in after),
        next((t for t, tracked, right in rows if right and tracked), seconds),
    )


@dataclass(frozen=True)
class Lateness:
    """Errors [m] of a run with late measurements: of the pose as of the newest stamp that has arrived, and as of now; and the
    largest distance [m] of the poses as of a stamp, once all up to it has arrived, from those of the run without delays."""

    newest: Array
    now: Array
    difference: float


def late(seed: int, index: int, seconds: float) -> dict[str, Lateness]:
    """One run of the situation `visible` for each entry of LATE_S."""
    drawn = runs.drawn("visible", seed, index, seconds)
    longest = max(bounds[1] for bounds in LATE_S.values())
    times = [t for t in instants(drawn) if t + longest < seconds]
    found: dict[str, Lateness] = {}
    exact: list[Array] = []
    for name, bounds in LATE_S.items():
        rng = np.random.default_rng([seed, index])
        run = runs.delayed(drawn, partial(rng.uniform, *bounds))
        observer, stamps = ErrorStateObserver(HOME, SPREAD), [0.0]
        take = taking(observer)
        player = Player(run, [take, partial(_note_stamp, stamps)])
        newest, now, settled = [], [], []
        for when, asked in sorted([*((t, t) for t in times), *((t + longest, t) for t in times)]):
            player.until(when)
            if when > asked:
                settled.append(observer.estimate(runs.ns(asked)).T)
                continue
            newest.append(_distance(run.at(stamps[-1]), observer.estimate(runs.ns(stamps[-1])).T))
            now.append(_distance(run.at(asked), observer.estimate(runs.ns(asked)).T))
        exact = exact or settled
        difference = max(_distance(a, b) for a, b in zip(settled, exact, strict=True))
        found[name] = Lateness(np.array(newest), np.array(now), difference)
    return found


def _note_stamp(stamps: list[float], message: runs.Message) -> None:
    """Appends the newest stamp of all messages so far."""
    stamps.append(max(message.stamp, stamps[-1]))


def _distance(a: Array, b: Array) -> float:
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
