"""Interface of the observers: their estimate, the measurements that they refuse, and their states."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import astuple, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.cell.description import Cell
from penumbra.shared.contract.messages import MAX_FUTURE_S, FusedPose, FusedState, Message, Source
from penumbra.shared.contract.senses import Measures, Sense
from penumbra.shared.geometry import rigid, so3
from penumbra.shared.native import kernel

Array = NDArray[np.floating[Any]]

STATES: tuple[FusedState, ...] = ("tracking", "coasting", "lost")
TRACKING, COASTING, LOST = range(len(STATES))
FATES = ("accepted", "gated", "late", "duplicate", "nothing", "future", "pose", "information")
"""Outcomes of a measurement: used; too far from the prediction; older than the history; received before; observing nothing. The
others are faults of the measurement, for which it is refused."""
ACCEPTED, GATED, LATE, DUPLICATE, NOTHING, FUTURE, POSE_FAULT, INFORMATION_FAULT = range(len(FATES))
PROMISED = 3.0
"""Number of standard deviations of the position that tracking promises to be within its bound."""
NO_CLOCK = (1 << 63) - 1
"""Latest accepted stamp if stamps are not compared with a clock."""
ROUNDING = 1e-6
"""Maximum error of a rotation, or of a symmetric matrix without negative eigenvalues, relative to its largest entry. Chosen, not
measured."""
STRAIGHT = 0.35
"""Maximum rotation [rad] over which the rest of a pose depends linearly on it, as a covariance says. Chosen: values from 0.2 to
0.6 make no difference."""


class RefusedMeasurement(ValueError):
    """A measurement that is refused for a fault of its own. `kind` groups equal faults, so that they can be counted."""

    def __init__(self, kind: str, text: str):
        super().__init__(text)
        self.kind = kind


@dataclass(frozen=True)
class Estimate:
    """The target at one moment. `T` (4, 4); `velocity` (6,): linear [m/s], angular [rad/s]; `covariance` (6, 6) of the pose error
    (`shared.geometry.rigid`); `state`: tracking, coasting or lost; `sources`: those that have sent a message."""

    T: rigid.Array
    velocity: Array
    covariance: Array
    state: FusedState
    sources: dict[str, Source]

    def message(self, stamp_ns: int, target: str, frame: str) -> FusedPose:
        """The estimate at a stamp, as it is published."""
        position, orientation = rigid.position_orientation(self.T)
        return FusedPose(
            stamp_ns=stamp_ns,
            target=target,
            frame=frame,
            position=position,
            orientation=orientation,
            velocity=self.velocity,
            covariance=self.covariance,
            state=self.state,
            sources=self.sources,
        )


@dataclass(frozen=True)
class Limits:
    """Limits of tracking.

    tracking_age : age [s] of the newest measurement above which the target is not tracked: three periods of a camera at 20 Hz and
        the delay of vision.
    tracking_bound : bound [m] that tracking promises: PROMISED standard deviations of the position along its worst direction are
        within it. The cell file sets it.
    lost_sigma : standard deviation of the position [m] along its worst direction above which it is no help for a search. Chosen,
        not measured.
    lost_age : time [s] without a measurement after which a limb's pose is unknown. Chosen, not measured.
    """

    tracking_age: float = 0.25
    tracking_bound: float = 0.15
    lost_sigma: float = 0.15
    lost_age: float = 3.0

    def state(self, age_s: float, covariance: Array) -> FusedState:
        """tracking, coasting or lost, from the age of the newest measurement in use and the pose's covariance (6, 6)."""
        return STATES[int(state_of(age_s, np.ascontiguousarray(covariance), np.array(astuple(self))))]


@kernel("f8, f8[n, n], f8[4] -> i8")
def state_of(age_s, covariance, limits):  # type: ignore[no-untyped-def]
    """Which of STATES, by the covariance of at least the position and the Limits in the order of their fields."""
    position, vectors = np.empty((3, 3)), np.empty((3, 3))
    so3.copy(covariance, position)
    so3.eigen(position, 3, vectors)
    sigma = math.sqrt(position[2, 2])
    if sigma > limits[2] or age_s > limits[3]:
        return LOST
    return TRACKING if age_s <= limits[0] and PROMISED * sigma <= limits[1] else COASTING


@dataclass
class Counts:
    """Numbers of the measurements of one source by outcome, see FATES; `refused` by kind."""

    accepted: int = 0
    gated: int = 0
    late: int = 0
    duplicate: int = 0
    refused: dict[str, int] = field(default_factory=dict)


class Log:
    """Counts per source, and the stamp [ns] of the first measurement of each source. names: of the senses."""

    def __init__(self, names: Iterable[str]) -> None:
        self.counts = {name: Counts() for name in names}
        self.first_ns: dict[str, int] = {}

    def check(self, source: str) -> None:
        """Raises ValueError for an unknown source."""
        if source not in self.counts:
            raise ValueError(f"source: expected one of {', '.join(self.counts)}, got {source!r}")

    def received(self, source: str, stamp_ns: int) -> None:
        """Notes that a sense has sent a message."""
        self.check(source)
        self.first_ns.setdefault(source, stamp_ns)

    def record(self, source: str, stamp_ns: int, fate: int) -> None:
        """Counts a measurement by its outcome (index of FATES)."""
        if fate >= FUTURE:
            self.refused(source, FATES[fate])
            return
        self.received(source, stamp_ns)
        if fate != NOTHING:
            counts, name = self.counts[source], FATES[fate]
            setattr(counts, name, getattr(counts, name) + 1)

    def refused(self, source: str, kind: str) -> None:
        """Counts a measurement with a fault."""
        refused = self.counts[source].refused
        refused[kind] = refused.get(kind, 0) + 1

    def admitted(
        self, source: str, stamp_ns: int, T: Array, information: Array, now_ns: int | None = None
    ) -> tuple[Array, Array]:
        """A measurement's pose (4, 4) and information (6, 6), symmetric. Raises RefusedMeasurement, and counts it, if they have a
        fault, and ValueError for an unknown source. now_ns: the reader's clock, if the stamp is to be compared with it."""
        self.check(source)
        T, information = shaped(T, (4, 4)), shaped(information, (6, 6))
        fate = fault(stamp_ns, T, information, latest(now_ns))
        if fate:
            self.refused(source, FATES[fate])
            raise refusal(fate, stamp_ns, T, information, now_ns)
        self.received(source, stamp_ns)
        return T, 0.5 * (information + information.T)


def shaped(values: Array, shape: tuple[int, ...]) -> Array:
    """Contiguous numbers of this shape; an array of another shape becomes NaN, which is a fault."""
    values = np.ascontiguousarray(values, np.float64)
    return values if values.shape == shape else np.full(shape, np.nan)


def latest(now_ns: int | None) -> int:
    """Latest stamp [ns] that is accepted at a time; None: without a clock. Clocks of one cell differ by MAX_FUTURE_S or less."""
    return NO_CLOCK if now_ns is None else now_ns + int(MAX_FUTURE_S * 1e9)


@kernel("i8, f8[4, 4], f8[6, 6], i8 -> i8")
def fault(stamp_ns, T, information, latest_ns):  # type: ignore[no-untyped-def]
    """FUTURE, POSE_FAULT or INFORMATION_FAULT of a measurement, 0 where it has none: what `refusal` puts in words."""
    if stamp_ns > latest_ns:
        return FUTURE
    off = 0.0
    for i in range(4):
        for j in range(4):
            if not math.isfinite(T[i, j]):
                return POSE_FAULT
            if i == 3:
                off = max(off, abs(T[i, j] - (1.0 if j == 3 else 0.0)))
            elif j < 3:
                off = max(off, abs(so3.dot(T[i, :3], T[j, :3]) - (1.0 if i == j else 0.0)))
    third = np.empty(3)
    so3.cross(T[0, :3], T[1, :3], third)
    if off > ROUNDING or so3.dot(third, T[2, :3]) < 0.0:
        return POSE_FAULT
    largest = off = 0.0
    for i in range(6):
        for j in range(6):
            if not math.isfinite(information[i, j]):
                return INFORMATION_FAULT
            largest = max(largest, abs(information[i, j]))
            off = max(off, abs(information[i, j] - information[j, i]))
    if off > ROUNDING * largest:
        return INFORMATION_FAULT
    eigenvalues, vectors = np.empty((6, 6)), np.empty((6, 6))
    so3.copy(information, eigenvalues)
    so3.eigen(eigenvalues, 6, vectors)
    low, high = eigenvalues[0, 0], eigenvalues[5, 5]
    return INFORMATION_FAULT if high < 0.0 or low < -ROUNDING * high else 0


def refusal(fate: int, stamp_ns: int, T: Array, information: Array, now_ns: int | None) -> RefusedMeasurement:
    """The error for a measurement that has a `fault`, with a text that explains it."""
    if fate == FUTURE:
        ahead = f"{1e-9 * (stamp_ns - (now_ns or 0)):.3f} s; check the clocks of its publisher and of fusion (chrony, ptp4l)"
        text = f"stamp: expected at most {MAX_FUTURE_S} s ahead of the clock, got {ahead}"
    elif fate == POSE_FAULT:
        text = "pose: expected a finite rigid transform (4, 4) with a rotation, got none: is its quaternion of length one?"
    elif not np.isfinite(information).all():
        text = "information: expected a finite (6, 6) matrix, got none"
    elif np.abs(information - information.T).max() > ROUNDING * np.abs(information).max():
        text = "information: expected a symmetric matrix, got one with different halves"
    else:
        low, high = np.linalg.eigvalsh(information)[[0, -1]]
        text = f"information: expected no negative eigenvalue, got {low:.3g} beside {high:.3g}"
    return RefusedMeasurement(FATES[fate], text)


def measured(message: Message, measures: Measures) -> tuple[Array, Array, Array | None]:
    """The pose (4, 4) in a message of a sense, its information (6, 6), zero along unobserved directions, and the step (6,) to it
    from its point of linearisation, None if the message has none. Raises RefusedMeasurement for a covariance that is not
    symmetric and positive definite."""
    of: Any = message
    match measures:
        case Measures.POSE:
            return rigid.transform(of.position, of.orientation), information(straight(of.covariance)), None
        case Measures.POSE_INFORMATION:
            return rigid.transform(of.position, of.orientation), of.information, getattr(of, "step", None)
        case Measures.POSITION:
            seen = np.zeros((6, 6))
            seen[:3, :3] = information(of.covariance)
            return rigid.transform(of.position), seen, None


def stream_of(sense: Sense, message: Any, target: str, cell: Cell) -> str:
    """The stream that a message of a sense belongs to: the sense, and, if it has several streams, the part of the cell that
    measured. Raises RefusedMeasurement for a message of another target, frame or part of the cell."""
    expected, got = (target, cell.frame), (message.target, message.frame)
    if got != expected:
        raise RefusedMeasurement("frame", f"{sense.name}: expected target and frame {expected}, got {got!r:.120}")
    if sense.part is None:
        return sense.name
    part, known = getattr(message, sense.part), getattr(cell, f"{sense.part}s")
    if part not in known:
        text = f"{sense.name}: expected a {sense.part} of the cell ({', '.join(known)}), got {part!r:.60}"
        raise RefusedMeasurement(sense.part, text)
    return f"{sense.name} of {sense.part} {part}"


def straight(covariance: Array) -> Array:
    """A pose's covariance (6, 6) in which the rest depends on the least certain rotation only over STRAIGHT. If a pose leaves a
    rotation open, such as the roll of a limb, the rest changes linearly with it only at first; beyond that, only the rotation
    itself is uncertain."""
    variances, axes = np.linalg.eigh(covariance[3:, 3:])
    variance, near = float(variances[-1]), STRAIGHT**2
    if not variance > near:
        return covariance
    turn = np.concatenate([np.zeros(3), axes[:, -1]])
    bound = covariance @ turn
    return covariance - (1.0 - near / variance) * np.outer(bound, bound) / variance + (variance - near) * np.outer(turn, turn)


def information(covariance: Array) -> Array:
    """The inverse (n, n) of a covariance. Raises RefusedMeasurement if it is not symmetric and positive definite."""
    eigenvalues, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    low, high = eigenvalues[[0, -1]]
    if np.abs(covariance - covariance.T).max() > ROUNDING * high or low <= 1e-14 * high:
        text = f"covariance: expected symmetric and positive definite, got eigenvalues {low:.3g} to {high:.3g}"
        raise RefusedMeasurement("covariance", text)
    return (vectors / eigenvalues) @ vectors.T
