"""The default observer: takes poses of any rank, late and in any order, and answers with the pose at any moment.

The arithmetic, the going back and the replaying are in `kernel.py`, compiled: a call does it for as many targets as it is given.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.fusion import filter
from services.fusion.estimate import (
    ACCEPTED,
    FUTURE,
    SOURCES,
    STATES,
    Array,
    Estimate,
    Log,
    latest,
    refusal,
    shaped,
)
from services.fusion.records import ESTIMATE, MEASUREMENT, MODEL, NEVER, POSE, STATE
from services.fusion.settings import Settings, model
from shared.contract.messages import FusedPose, Source
from shared.geometry import rigid


class Bank:
    """The observers of n targets, which share nothing but the calls.

    homes : expected poses (n, 4, 4) before anything is known, with standard deviations `spreads` (n, 2), of position [m] and
    rotation [rad].
    """

    def __init__(self, homes: Array, spreads: Sequence[tuple[float, float]], settings: Settings | None = None):
        self.settings = settings or Settings()
        n = len(homes)
        self.logs = [Log() for _ in range(n)]
        self._models = np.array([model(self.settings, *given) for given in zip(homes, spreads, strict=True)], MODEL)
        self._states = np.zeros((n, self.settings.capacity), STATE)
        self._measurements = np.zeros((n, self.settings.capacity), MEASUREMENT)
        self._rings = np.zeros((n, 2), np.int64)
        filter.clear_all(self._states, self._measurements, self._rings)

    def __len__(self) -> int:
        return len(self.logs)

    def forget(self, targets: slice = slice(None)) -> None:
        """Begins anew with every target, or with some of them; their counts go on."""
        filter.clear_all(self._states[targets], self._measurements[targets], self._rings[targets])
        for log in self.logs[targets]:
            log.heard_ns.clear()

    def measure(
        self,
        targets: NDArray[np.int64],
        sources: NDArray[np.int64],
        stamps_ns: NDArray[np.int64],
        T: Array,
        information: Array,
        now_ns: int | None = None,
    ) -> NDArray[np.int64]:
        """Takes m poses T (m, 4, 4) with their information (m, 6, 6), one after the other; their fates (m,), of FATES.

        targets, sources (m,) : which target each belongs to, and which of SOURCES it comes from; otherwise as
        `ErrorStateObserver.measure`. What is refused is counted, and the others are taken.
        """
        fates = np.empty(len(targets), np.int64)
        filter.measure_all(
            *(self._models, self._states, self._measurements, self._rings),
            *(targets, sources, stamps_ns, T, information, latest(now_ns), fates),
        )
        columns = (each.tolist() for each in (targets, sources, stamps_ns, fates))
        for target, source, stamp_ns, fate in zip(*columns, strict=True):
            self.logs[target].took(SOURCES[source], stamp_ns, fate)
        return fates

    def adopt(self, target: int, message: FusedPose) -> None:
        """As `ErrorStateObserver.adopt`, of one target."""
        believed_ns, weight = np.full(len(SOURCES), NEVER), np.zeros(len(SOURCES))
        for s, name in enumerate(SOURCES):
            if (source := message.sources.get(name)) is not None:
                believed_ns[s], weight[s] = message.stamp_ns - int(1e9 * source.age_s), source.weight
                self.logs[target].heard(name, int(believed_ns[s]))
        T = rigid.transform(message.position, message.orientation)
        filter.adopt(
            *(self._models[target], self._states, self._measurements, self._rings, target),
            *(message.stamp_ns, T, message.velocity, message.covariance, believed_ns, weight),
        )

    def estimate(self, stamp_ns: int, targets: slice = slice(None)) -> NDArray[np.void]:
        """The ESTIMATE of every target (n,) at a stamp, or of some of them; otherwise as `ErrorStateObserver.estimate`."""
        models = self._models[targets]
        out = np.empty(len(models), ESTIMATE)
        filter.estimate_all(models, self._states[targets], self._rings[targets], stamp_ns, out)
        return out

    def earliest_ns(self, target: int) -> int:
        """As `ErrorStateObserver.earliest_ns`, of one target."""
        first, count = self._rings[target]
        return int(self._states[target, first]["stamp_ns"]) if count else 0

    def innovation(self, target: int) -> tuple[float, int]:
        """As `ErrorStateObserver.innovation`, of one target."""
        first, count = self._rings[target]
        newest = self._states[target, (first + count - 1) % self._states.shape[1]]
        return float(newest["distance"]), int(newest["rank"])

    def estimates(self, stamp_ns: int) -> list[Estimate]:
        """The same, each with its sources, to be told to others."""
        return _told(self.estimate(stamp_ns), self.logs, stamp_ns)


class ErrorStateObserver:
    """Fuses the poses of the senses by how much each can be trusted now.

    home : expected pose (4, 4) before anything is known, with standard deviations `spread` (position [m], rotation [rad]).
    """

    def __init__(self, home: rigid.Array, spread: tuple[float, float], settings: Settings | None = None):
        self._join(Bank(np.asarray(home)[None], [spread], settings), 0)

    @classmethod
    def of(cls, bank: Bank, target: int) -> ErrorStateObserver:
        """The observer of one target of a bank."""
        observer = cls.__new__(cls)
        observer._join(bank, target)
        return observer

    def _join(self, bank: Bank, target: int) -> None:
        self._bank, self._target = bank, target
        self.settings, self.log = bank.settings, bank.logs[target]

    def measure(
        self, source: str, stamp_ns: int, T: Array, information: Array, hidden: float | None = None, now_ns: int | None = None
    ) -> bool:
        """Takes a pose T (4, 4) with its information (6, 6, zero along what is not observed). True if it was accepted.

        `hidden` is not used: the information says how good the measurement is. `now_ns` is the reader's clock, where the stamp is
        to be compared with it. Raises Refused, which is counted and leaves the state as it is, for a pose that is no rigid
        transform, an information that is not symmetric and positive semi-definite, and a stamp from the future; ValueError on an
        unknown source.
        """
        self.log.check(source)
        T, information = shaped(T, (4, 4)), shaped(information, (POSE, POSE))
        target, which, stamp = np.array([[self._target], [SOURCES.index(source)], [stamp_ns]])
        fate = int(self._bank.measure(target, which, stamp, T[None], information[None], now_ns)[0])
        if fate >= FUTURE:
            raise refusal(fate, stamp_ns, T, information, now_ns)
        return fate == ACCEPTED

    def adopt(self, message: FusedPose) -> None:
        """Goes on from a pose that another observer of this target has published; what was known here is forgotten. Measurements
        before its stamp are in it already, and count as late."""
        self._bank.adopt(self._target, message)

    def forget(self) -> None:
        """Begins anew; the counts go on."""
        self._bank.forget(slice(self._target, self._target + 1))

    def innovation(self) -> tuple[float, int]:
        """Squared Mahalanobis distance of the newest measurement's innovation (NIS) and its degrees of freedom: 0 and 0 where it
        began the state."""
        return self._bank.innovation(self._target)

    @property
    def earliest_ns(self) -> int:
        """The first stamp at which the pose can be told: that of the oldest measurement kept."""
        return self._bank.earliest_ns(self._target)

    def estimate(self, stamp_ns: int) -> Estimate:
        """The pose at a stamp, from the measurements up to it. Disturbs nothing.

        A stamp before the history reads its oldest state. A source's weight is its share of the information that the senses
        brought in the last `weight_time`, fading exponentially; information in nats, as `records.STATE` defines its gain.
        """
        found = self._bank.estimate(stamp_ns, slice(self._target, self._target + 1))
        return _told(found, [self.log], stamp_ns)[0]


def _told(found: NDArray[np.void], logs: Sequence[Log], stamp_ns: int) -> list[Estimate]:
    """The ESTIMATE of n targets (n,) for others to read."""
    names = ("state", "believed_ns", "weight")
    arrays, lists = (found["T"], found["velocity"], found["covariance"]), (found[name].tolist() for name in names)
    out = []
    for T, velocity, covariance, state, believed_ns, weight, log in zip(*arrays, *lists, logs, strict=True):
        sources = {}
        for name, since_ns in log.heard_ns.items():
            s = SOURCES.index(name)
            newest_ns = believed_ns[s] if believed_ns[s] != NEVER else since_ns
            sources[name] = Source(max(0.0, (stamp_ns - newest_ns) * 1e-9), weight[s])
        out.append(Estimate(T, velocity, covariance, STATES[state], sources))
    return out
