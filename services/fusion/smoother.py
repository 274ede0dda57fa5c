"""The trajectory of a target from a whole recording: every pose uses the measurements before and after it.

1. The observer's filter runs over all measurements in the order of their stamps, with its gates, and backwards in time. A
   measurement that passes in one direction is used: those of a limb that sets out unexpectedly are refused at first in one
   direction and at last in the other, those of a wrong sense in both. A segment begins where the filter started over; nothing is
   carried over to the next one.
2. The filter runs over the used measurements of each segment: with gates, forwards and backwards in time, which shows how
   unsteady the limb is at each moment, and then forwards without gates, with the larger agility of the two.
3. A fixed-interval smoother goes back over the states of the filter: pose, velocity, acceleration, and the biases of the senses.
4. Every measurement is judged by the smoothed state without its own part in it: one that was used and does not agree is left
   out, one that was refused and agrees is used. If that changes something, 2 to 4 are repeated, at most PASSES times.

A state x with the covariance P is one step before a predicted state, P_p = F P F' + Q, whose smoothed error is e and whose
smoothed covariance is P_s. With C = P F' P_p^-1 its own smoothed error is C e, and its covariance P + C (P_s - P_p) C', here as
(I - C F) P (I - C F)' + C (Q + P_s) C', which rounding does not make indefinite.

Errors are along fixed axes and rotations are applied from the left, as in the filter. A covariance turns with its pose: the roll
that no sense observes is about the axis of the limb at the smoothed pose.

Sources: Rauch, Tung, Striebel, "Maximum likelihood estimates of linear dynamic systems" (1965), equations (3.28) to (3.31), DOI
10.2514/3.3166; error states on SO(3): Sola (2017), as in `filter.py`; residuals without a measurement's own part: Cook, Weisberg,
"Residuals and Influence in Regression" (1982), section 2.2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from penumbra.services.fusion import history, transitions
from penumbra.services.fusion.estimate import ACCEPTED, GATED, NO_CLOCK, Array, Estimate, Limits, Log, shaped
from penumbra.services.fusion.records import MEASUREMENT, MODEL, MOTION, POSE, SENSE_STATE, STATE, History, size
from penumbra.services.fusion.settings import FusionSettings, Subject, model, sense_models
from penumbra.shared.contract.senses import SENSES, Sense
from penumbra.shared.geometry import rigid, so3

PASSES = 4
"""Maximum number of times that 2 and 3 are done. Chosen: later ones change only a measurement or two."""
FOREVER_S = 1e9
"""A horizon [s] beyond all recordings."""
BLOCK = 256
"""Number of states that are predicted at a time: it bounds the memory for their transitions."""
OWN = 0.01
"""Minimum variance of a residual, as a share of the measurement's white noise: below it, nothing else measured that direction.
Chosen, not measured."""
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]


class NothingMeasuredError(ValueError):
    """There is no measurement from which a trajectory could be made."""


@dataclass(frozen=True)
class States:
    """States of the filter: now (k,) STATE, senses (k, n) SENSE_STATE, P (k, size, size) covariances of all errors."""

    now: NDArray[np.void]
    senses: NDArray[np.void]
    P: Array

    def of(self, which: Indices | slice) -> States:
        """A selection of the states."""
        return States(self.now[which], self.senses[which], self.P[which])

    def copy(self) -> States:
        return States(self.now.copy(), self.senses.copy(), self.P.copy())

    def error(self, i: int, of: States, j: int) -> Array:
        """The error (size,) of state j of the others, if state i of these is true."""
        rotation = np.empty(3)
        a, b = self.now[i], of.now[j]
        so3.log(a["R"] @ b["R"].T, rotation)
        biases = self.senses["bias"][i] - of.senses["bias"][j]
        rates = a["velocity"] - b["velocity"], a["acceleration"] - b["acceleration"]
        return np.concatenate([a["p"] - b["p"], rotation, *rates, biases.ravel(), a["offset"] - b["offset"]])

    def correct(self, i: int, error: Array, P: Array) -> None:
        """Moves state i by an error (size,), and gives it a covariance P of the pose before, which turns with it."""
        turn = rigid.rotation(error[3:6])
        now = self.now[i]
        now["p"] += error[:3]
        now["R"] = turn @ now["R"]
        so3.orthonormalise(now["R"])
        now["velocity"] += error[POSE : 2 * POSE]
        now["acceleration"] += error[2 * POSE : MOTION]
        self.senses["bias"][i] += error[MOTION:-POSE].reshape(-1, POSE)
        now["offset"] += error[-POSE:]
        self.P[i] = turned(turn, P)


def turned(turn: Array, P: Array) -> Array:
    """The covariance (size, size) of a pose after a rotation (3, 3) is applied to the pose."""
    W = np.eye(len(P))
    W[3:6, 3:6] = W[9:12, 9:12] = W[15:18, 15:18] = turn
    out: Array = W @ P @ W.T
    return out


@dataclass(frozen=True)
class Taken:
    """Measurements (m,) in the order of their stamps: sources, stamps [ns], poses (m, 4, 4), information (m, 6, 6),
    steps (m, 6)."""

    sources: Indices
    stamps_ns: Indices
    T: Array
    information: Array
    steps: Array

    def of(self, which: Indices | Flags) -> Taken:
        """A selection of the measurements."""
        return Taken(self.sources[which], self.stamps_ns[which], self.T[which], self.information[which], self.steps[which])

    def __len__(self) -> int:
        return len(self.stamps_ns)


def reversed_in_time(measurements: NDArray[np.void]) -> NDArray[np.void]:
    """Measurements (k,) of a limb that moves backwards in time: the last one first, at the stamp of the first one."""
    back = measurements[::-1].copy()
    back["stamp_ns"] = measurements["stamp_ns"][0] + measurements["stamp_ns"][-1] - back["stamp_ns"]
    return back


class Filter:
    """The observer's filter over a complete set of measurements. is_gated: whether it refuses those that are too far off."""

    def __init__(self, subject: Subject, settings: FusionSettings, senses: Sequence[Sense], is_gated: bool):
        self.one, self.senses = np.array([model(settings, subject)], MODEL), sense_models(senses)
        self.one["horizon"], self._gated = FOREVER_S, self.senses.copy()
        if not is_gated:
            self.senses["threshold"] = np.inf

    def known(self, taken: Taken) -> tuple[NDArray[np.void], States, Indices]:
        """The measurements that it keeps (k,), the states after them, and the outcomes of all (m,), indices of FATES."""
        count, n = len(taken), len(self.senses)
        memory = History.empty(1, count + 1, n)
        history.clear_all(*memory)
        fates, room = np.empty(count, np.int64), (np.empty(1, MEASUREMENT), np.empty((size(n), POSE)))
        history.measure_all(
            *(self.one, self.senses, *memory, np.zeros(count, np.int64)),
            *(taken.sources, taken.stamps_ns, taken.T, taken.information, taken.steps, NO_CLOCK, fates, *room),
        )
        known = slice(1, int(memory.rings[0, 1]))  # before the first one there is a state without information
        states = States(memory.states[0, known], memory.senses[0, known], memory.P[0, known])
        return memory.measurements[0, known], states, fates

    def run(self, measurements: NDArray[np.void], agility: Array) -> States:
        """The states after measurements (k,), with the agilities (k, 2) of the motion to each: see `transitions.run`."""
        return self._run(measurements, self.senses, agility, len(measurements) + 1).of(slice(1, None))

    def learned(self, measurements: NDArray[np.void]) -> NDArray[np.void]:
        """The STATEs after measurements (k,), with the agilities that the filter learns, faster with its gates; without
        covariances, which are large."""
        return self._run(measurements, self._gated, np.zeros((len(measurements), 2)), 2).now[1:]

    def _run(self, measurements: NDArray[np.void], senses: NDArray[np.void], agility: Array, kept: int) -> States:
        k, n = len(measurements) + 1, len(self.senses)
        states = States(np.zeros(k, STATE), np.zeros((k, n), SENSE_STATE), np.zeros((kept, size(n), size(n))))
        transitions.run(
            *(self.one, senses, measurements, agility),
            *(states.now, states.senses, states.P, np.empty((size(n), POSE))),
        )
        return states

    def agility(self, measurements: NDArray[np.void]) -> Array:
        """Agilities (k, 2) of the motion to each measurement (k,): the larger of those that the filter learns forwards and
        backwards in time. Forwards it learns late that a limb sets out, backwards that it stops."""
        out = np.zeros((len(measurements), 2))
        before = self.learned(measurements)[:-1]
        after = self.learned(reversed_in_time(measurements))[-2::-1]
        out[1:] = np.maximum(before["agility"], after["agility"])
        return out

    def moved(self, states: States, stamps_ns: Indices) -> tuple[States, Array, Array]:
        """States (k,) at later stamps (k,), with F and Q (k, size, size): see `transitions.transit`."""
        later = States(np.empty_like(states.now), np.empty_like(states.senses), np.empty_like(states.P))
        F, Q = np.empty_like(states.P), np.empty_like(states.P)
        transitions.transit(self.one, self.senses, states.now, states.senses, stamps_ns, later.now, later.senses, F, Q)
        later.P[:] = F @ states.P @ F.transpose(0, 2, 1) + Q
        return later, F, Q

    def linearised(self, measurements: NDArray[np.void], states: States) -> tuple[Array, Array, Array]:
        """See `transitions.linearise`: z (k, 6), H (k, 6, 12) and white (k, 6)."""
        k = len(measurements)
        z, H, white = np.empty((k, POSE)), np.empty((k, POSE, 2 * POSE)), np.empty((k, POSE))
        transitions.linearise(self.one, self.senses, measurements, states.now, states.senses, z, H, white)
        return z, H, white


class Segment:
    """The used measurements between two starts of the filter, with the filtered and the smoothed states after them (k,)."""

    def __init__(self, filter: Filter, measurements: NDArray[np.void]):
        self._filter = filter
        self._filtered = filter.run(measurements, filter.agility(measurements))
        self.stamps_ns = measurements["stamp_ns"].copy()
        self.smoothed = self._filtered.copy()
        count = len(self.stamps_ns)
        for end in range(count - 1, 0, -BLOCK):  # backwards, a block of transitions at a time
            begin = max(0, end - BLOCK)
            later, F, Q = filter.moved(self._filtered.of(slice(begin, end)), self.stamps_ns[begin + 1 : end + 1])
            for k in range(end - 1, begin - 1, -1):
                smooth(self.smoothed, k, later, k - begin, F[k - begin], Q[k - begin], self.smoothed, k + 1)

    def at(self, stamps_ns: Indices) -> States:
        """The smoothed states at stamps (m,), none of them before the first measurement; after the last one, predictions. Call it
        with a block at a time: each state needs 15 kB in between."""
        nearest = np.searchsorted(self.stamps_ns, stamps_ns, side="right") - 1
        out, _, _ = self._filter.moved(self._filtered.of(nearest), stamps_ns)
        within = np.flatnonzero(nearest + 1 < len(self.stamps_ns))
        after = nearest[within] + 1
        later, F, Q = self._filter.moved(out.of(within), self.stamps_ns[after])
        for j, (i, k) in enumerate(zip(within.tolist(), after.tolist(), strict=True)):
            smooth(out, i, later, j, F[j], Q[j], self.smoothed, k)
        return out

    def covariance(self, states: States, i: int) -> Array:
        """The covariance (6, 6) of the pose of state i."""
        P = states.P[i]
        covariance: Array = P[:POSE, :POSE].copy()
        history.consider(self._filter.senses, states.senses[i], P, covariance)
        return covariance

    def agreement(self, measurements: NDArray[np.void], states: States, is_used: bool) -> Array:
        """Squared Mahalanobis distances (m,) of measurements from the smoothed states at their stamps. is_used: whether the
        states contain them; each is then compared with the states without it."""
        z, H, white = self._filter.linearised(measurements, states)
        first = MOTION + POSE * measurements["source"][:, None] + np.arange(POSE)
        rows = np.concatenate([np.broadcast_to(np.arange(POSE), first.shape), first], axis=1)
        P = np.take_along_axis(np.take_along_axis(states.P, rows[:, :, None], 1), rows[:, None, :], 2)
        spread = H @ P @ H.transpose(0, 2, 1) / np.sqrt(white[:, :, None] * white[:, None, :])
        values, vectors = np.linalg.eigh(np.eye(POSE) + (-spread if is_used else spread))
        along = np.einsum("kij,ki->kj", vectors, z / np.sqrt(white))
        return np.sum(along**2 / np.maximum(values, OWN), axis=1)


def smooth(states: States, i: int, later: States, j: int, F: Array, Q: Array, smoothed: States, k: int) -> None:
    """One step back, in place: smooths state i from the smoothed state k at the stamp of its prediction j, with F and Q (size,
    size)."""
    P = states.P[i]
    C = np.linalg.solve(later.P[j], F @ P).T
    ahead = smoothed.error(k, later, j)
    rest = np.eye(len(P)) - C @ F
    known = turned(rigid.rotation(-ahead[3:6]), smoothed.P[k]) + Q  # as of the predicted pose
    wide = rest @ P @ rest.T + C @ known @ C.T
    states.correct(i, C @ ahead, 0.5 * (wide + wide.T))


class Trajectory:
    """The poses of a target at all stamps from `begin_ns` to `end_ns`, those of its first and last used measurement."""

    def __init__(self, segments: Sequence[Segment], limits: Limits):
        self._segments, self._limits = segments, limits
        self._begins_ns = np.array([segment.stamps_ns[0] for segment in segments])
        self.begin_ns, self.end_ns = int(segments[0].stamps_ns[0]), int(segments[-1].stamps_ns[-1])

    def estimates(self, stamps_ns: Indices) -> Iterator[Estimate]:
        """The poses at ascending stamps. Their state depends on the measurement nearest in time, before or after. In a gap after
        which the filter started over, they are predictions from before. Raises ValueError for stamps outside."""
        if len(stamps_ns) and not self.begin_ns <= stamps_ns[0] <= stamps_ns[-1] <= self.end_ns:
            raise ValueError(f"stamps: expected {self.begin_ns} to {self.end_ns}, got {stamps_ns[0]} to {stamps_ns[-1]}")
        of = np.searchsorted(self._begins_ns, stamps_ns, side="right") - 1
        for number, segment in enumerate(self._segments):
            mine = stamps_ns[of == number]
            for part in (mine[i : i + BLOCK] for i in range(0, len(mine), BLOCK)):
                states = segment.at(part)
                for i, stamp_ns in enumerate(part.tolist()):
                    now, covariance = states.now[i], segment.covariance(states, i)
                    after = int(np.searchsorted(segment.stamps_ns, stamp_ns))
                    age_s = 1e-9 * float(np.abs(segment.stamps_ns[max(0, after - 1) : after + 1] - stamp_ns).min())
                    T = np.eye(4)
                    T[:3, :3], T[:3, 3] = now["R"], now["p"]
                    yield Estimate(T, now["velocity"].copy(), covariance, self._limits.state(age_s, covariance), {})


class Smoother:
    """Takes all measurements of one target, in any order, and computes its trajectory.

    subject : prior knowledge of the target. senses : senses whose measurements are used. log : outcomes of the measurements, as
    in the observer; `reinstated`: number of refused ones that are used after all, and `dismissed`: of accepted ones that are not
    used.
    """

    def __init__(self, subject: Subject, settings: FusionSettings | None = None, senses: Sequence[Sense] = SENSES):
        self._subject, self._settings, self._senses = subject, settings or FusionSettings(), tuple(senses)
        self._names = tuple(sense.name for sense in senses)
        self._measured: list[tuple[int, int, Array, Array, Array]] = []
        self.log = Log(self._names)
        self.reinstated = self.dismissed = 0

    def measure(self, source: str, stamp_ns: int, T: Array, information: Array, step: Array | None = None) -> None:
        """Takes a pose T (4, 4) with its information (6, 6) and step (6,), as `ErrorStateObserver.measure`; `trajectory` counts
        its faults. Raises ValueError for an unknown source."""
        self.log.check(source)
        step = np.zeros(POSE) if step is None else shaped(step, (POSE,))
        which, T, information = self._names.index(source), shaped(T, (4, 4)), shaped(information, (POSE, POSE))
        self._measured.append((stamp_ns, which, T, information, step))

    def trajectory(self) -> Trajectory:
        """The trajectory, from the measurements so far. Raises NothingMeasuredError if none of them can be used."""
        measurements, parts, passed, used = self._gated()
        open_filter = self.filter(self._settings)
        for left in range(PASSES - 1, -1, -1):
            segments, revised = [], used.copy()
            for mine in parts:
                if used[mine].any():
                    segments.append(Segment(open_filter, measurements[mine[used[mine]]]))
                    revised[mine] = self._judged(segments[-1], measurements[mine], used[mine])
            if not left or (revised == used).all() or not revised.any():
                break
            used = revised
        self.reinstated, self.dismissed = int((used & ~passed).sum()), int((passed & ~used).sum())
        return Trajectory(segments, self._subject.limits)

    def segments(self) -> list[NDArray[np.void]]:
        """The measurements of each segment that pass the gates, forwards or backwards in time. Raises NothingMeasuredError if
        there are none."""
        measurements, parts, _, used = self._gated()
        return [measurements[mine[used[mine]]] for mine in parts if used[mine].any()]

    def filter(self, settings: FusionSettings) -> Filter:
        """The filter without gates of this target, with other settings."""
        return Filter(self._subject, settings, self._senses, is_gated=False)

    def _gated(self) -> tuple[NDArray[np.void], list[Indices], Flags, Flags]:
        """Runs the filter with its gates over all: the measurements that it keeps (m,), the indices of those of each segment, and
        flags of those that passed and of those to be used."""
        if not self._measured:
            raise NothingMeasuredError(f"expected poses of {' or '.join(self._names)}, got none")
        stamps_ns, sources, T, information, steps = (np.array(column) for column in zip(*self._measured, strict=True))
        order = np.lexsort((*(T[:, :3, 3] - steps[:, :3])[:, ::-1].T, sources, stamps_ns))  # as `history` orders them
        taken = Taken(sources, stamps_ns, T, information, steps).of(order)
        gated = Filter(self._subject, self._settings, self._senses, is_gated=True)
        measurements, states, fates = gated.known(taken)
        for source, stamp_ns, fate in zip(taken.sources, taken.stamps_ns.tolist(), fates.tolist(), strict=True):
            self.log.record(self._names[source], stamp_ns, fate)
        passed = fates[(fates == ACCEPTED) | (fates == GATED)] == ACCEPTED
        if not passed.any():
            raise NothingMeasuredError(f"expected poses of {' or '.join(self._names)} that can be used, got {len(order)} others")
        back = gated.learned(reversed_in_time(measurements))
        used, starts = passed | (back["passed"][::-1] == 1), np.flatnonzero(states.now["rank"] == 0)
        for number, start in enumerate(starts[1:], 1):
            last = int(np.flatnonzero(passed[:start])[-1])
            age_s = 1e-9 * float(states.now["stamp_ns"][start] - states.now["stamp_ns"][last])
            if age_s <= self._subject.limits.lost_age:  # all were refused until it started over: it should have started earlier
                starts[number] = last + 1
                used[last + 1 : start] = True
        return measurements, np.split(np.arange(len(used)), starts[1:]), passed, used

    def _judged(self, segment: Segment, measurements: NDArray[np.void], used: Flags) -> Flags:
        """Flags (m,) of the measurements of a segment to be used, from those of the ones that were."""
        thresholds, out = sense_models(self._senses)["threshold"], used.copy()
        mine = measurements[used]
        keep = thresholds[mine["source"], 0, mine["rank"]]
        out[used] = segment.agreement(mine, segment.smoothed, is_used=True) <= keep
        refused = np.flatnonzero(~used & (measurements["stamp_ns"] >= segment.stamps_ns[0]))
        for part in (refused[i : i + BLOCK] for i in range(0, len(refused), BLOCK)):
            theirs = measurements[part]
            distances = segment.agreement(theirs, segment.at(theirs["stamp_ns"].copy()), is_used=False)
            out[part] = distances <= thresholds[theirs["source"], 1, theirs["rank"]]
        return out
