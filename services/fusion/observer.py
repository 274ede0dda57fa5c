"""The default observer: takes poses of any rank, late and in any order, and gives the pose at any moment.

The arithmetic is compiled (`filter.py`, `history.py`): one call handles all targets that it is given.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from penumbra.services.fusion import history
from penumbra.services.fusion.estimate import ACCEPTED, FUTURE, STATES, Array, Estimate, Log, latest, refusal, shaped
from penumbra.services.fusion.records import ESTIMATE, MEASUREMENT, MODEL, NEVER, POSE, SENSE_ESTIMATE, History, size
from penumbra.services.fusion.settings import FusionSettings, Subject, model, sense_models
from penumbra.shared.contract.messages import FusedPose, Source
from penumbra.shared.contract.senses import SENSES, Sense
from penumbra.shared.geometry import rigid


class Bank:
    """The observers of n targets, which share only the calls.

    subjects : prior knowledge of each target. senses : senses whose measurements are used.
    """

    def __init__(
        self,
        subjects: Sequence[Subject],
        settings: FusionSettings | None = None,
        senses: Sequence[Sense] = SENSES,
    ):
        self.settings, self.subjects = settings or FusionSettings(), tuple(subjects)
        self.names = tuple(sense.name for sense in senses)
        self.logs = [Log(self.names) for _ in subjects]
        self._models = np.array([model(self.settings, subject) for subject in subjects], MODEL)
        self._sense_models = sense_models(senses)
        self._history = History.empty(len(subjects), self.settings.capacity * len(senses), len(senses))
        self._room = np.empty(1, MEASUREMENT), np.empty((size(len(senses)), POSE))
        self._denied_ns = np.full((len(subjects), len(senses)), NEVER)
        history.clear_all(*self._history)

    def __len__(self) -> int:
        return len(self.logs)

    def forget(self, targets: slice = slice(None)) -> None:
        """Starts over for all targets, or for some of them; their counts continue."""
        history.clear_all(*self._history.of(targets))
        self._denied_ns[targets] = NEVER
        for log in self.logs[targets]:
            log.first_ns.clear()

    def measure(
        self,
        targets: NDArray[np.int64],
        sources: NDArray[np.int64],
        stamps_ns: NDArray[np.int64],
        T: Array,
        information: Array,
        now_ns: int | None = None,
        steps: Array | None = None,
    ) -> NDArray[np.int64]:
        """Takes m poses T (m, 4, 4) with their information (m, 6, 6) and steps (m, 6), one after the other. Returns their
        outcomes (m,), indices of FATES.

        targets, sources (m,) : target of each pose, and its sense, an index of `names`; otherwise as
        `ErrorStateObserver.measure`. Refused poses are counted, and the others are used.
        """
        fates = np.empty(len(targets), np.int64)
        steps = np.zeros((len(targets), POSE)) if steps is None else steps
        history.measure_all(
            *(self._models, self._sense_models, *self._history),
            *(targets, sources, stamps_ns, T, information, steps, latest(now_ns), fates, *self._room),
        )
        columns = (each.tolist() for each in (targets, sources, stamps_ns, fates))
        for target, source, stamp_ns, fate in zip(*columns, strict=True):
            self.logs[target].record(self.names[source], stamp_ns, fate)
        return fates

    def deny(self, target: int, source: str, stamp_ns: int, now_ns: int | None = None) -> None:
        """As `ErrorStateObserver.deny`, for one target."""
        self.logs[target].received(source, stamp_ns)
        which = self.names.index(source)
        if stamp_ns <= latest(now_ns):
            self._denied_ns[target, which] = max(self._denied_ns[target, which], stamp_ns)

    def adopt(self, target: int, message: FusedPose) -> None:
        """As `ErrorStateObserver.adopt`, for one target."""
        known = np.array([(NEVER, 0.0)] * len(self.names), SENSE_ESTIMATE)
        for record, name in zip(known, self.names, strict=True):
            if (source := message.sources.get(name)) is not None:
                record["accepted_ns"], record["weight"] = message.stamp_ns - int(1e9 * source.age_s), source.weight
                self.logs[target].received(name, int(record["accepted_ns"]))
        T = rigid.transform(message.position, message.orientation)
        history.adopt(
            *(self._models, self._sense_models, *self._history, target),
            *(message.stamp_ns, T, message.velocity, message.covariance, known),
        )

    def estimate(self, stamp_ns: int, targets: slice = slice(None)) -> tuple[NDArray[np.void], NDArray[np.void]]:
        """The ESTIMATE of every target (n,) at a stamp, or of some of them, and the SENSE_ESTIMATE of every target and sense;
        otherwise as `ErrorStateObserver.estimate`."""
        models = self._models[targets]
        out, senses = np.empty(len(models), ESTIMATE), np.empty((len(models), len(self.names)), SENSE_ESTIMATE)
        denied_ns = self._denied_ns[targets]
        history.estimate_all(models, self._sense_models, *self._history.of(targets), denied_ns, stamp_ns, out, senses)
        return out, senses

    def earliest_ns(self, target: int) -> int:
        """As `ErrorStateObserver.earliest_ns`, for one target."""
        first, count = self._history.rings[target]
        return int(self._history.states[target, first]["stamp_ns"]) if count else 0

    def innovation(self, target: int) -> tuple[float, int]:
        """As `ErrorStateObserver.innovation`, for one target."""
        first, count = self._history.rings[target]
        newest = self._history.states[target, (first + count - 1) % self._history.states.shape[1]]
        return float(newest["distance"]), int(newest["rank"])

    def estimates(self, stamp_ns: int) -> list[Estimate]:
        """The estimates of all targets, with their sources."""
        return self._described(slice(None), stamp_ns)

    def one(self, stamp_ns: int, target: int) -> Estimate:
        """The same of one target."""
        return self._described(slice(target, target + 1), stamp_ns)[0]

    def _described(self, targets: slice, stamp_ns: int) -> list[Estimate]:
        found, senses = self.estimate(stamp_ns, targets)
        out = []
        columns = (found["pose"], found["velocity"], found["covariance"], found["state"].tolist(), senses.tolist())
        for T, velocity, covariance, state, known, log in zip(*columns, self.logs[targets], strict=True):
            sources = {}
            for name, (accepted_ns, weight) in zip(self.names, known, strict=True):
                if name in log.first_ns:
                    newest_ns = accepted_ns if accepted_ns != NEVER else log.first_ns[name]
                    sources[name] = Source(max(0.0, (stamp_ns - newest_ns) * 1e-9), weight)
            out.append(Estimate(T, velocity, covariance, STATES[state], sources))
        return out


class ErrorStateObserver:
    """Fuses the poses of the senses by how far each can be trusted at the moment.

    home : expected pose (4, 4) before the first measurement, with standard deviations `spread` (position [m], rotation [rad]).
    senses : senses whose measurements are used.
    """

    def __init__(
        self,
        home: rigid.Array,
        spread: tuple[float, float],
        settings: FusionSettings | None = None,
        senses: Sequence[Sense] = SENSES,
    ):
        self._join(Bank([Subject(home, spread)], settings, senses), 0)

    @classmethod
    def of(cls, bank: Bank, target: int) -> ErrorStateObserver:
        """The observer of one target of a bank."""
        observer = cls.__new__(cls)
        observer._join(bank, target)
        return observer

    def _join(self, bank: Bank, target: int) -> None:
        self._bank, self._target = bank, target
        self.settings, self.subject, self.log = bank.settings, bank.subjects[target], bank.logs[target]

    def measure(
        self,
        source: str,
        stamp_ns: int,
        T: Array,
        information: Array,
        hidden: float | None = None,
        now_ns: int | None = None,
        step: Array | None = None,
    ) -> bool:
        """Takes a pose T (4, 4) with its information (6, 6, zero along unobserved directions). True if it was accepted.

        `step` (6,) is the pose error that leads to T from the pose at which its likelihood was linearised; None: it was at T.
        `hidden` is not used: the information says how good the measurement is. `now_ns` is the reader's clock, if the stamp is to
        be compared with it. Raises RefusedMeasurement, which is counted and leaves the state unchanged, for a pose that is no
        rigid transform, an information that is not symmetric and positive semi-definite, and a stamp from the future; ValueError
        for an unknown source.
        """
        self.log.check(source)
        T, information = shaped(T, (4, 4)), shaped(information, (POSE, POSE))
        steps = None if step is None else shaped(step, (POSE,))[None]
        target, which, stamp = np.array([[self._target], [self._bank.names.index(source)], [stamp_ns]])
        fate = int(self._bank.measure(target, which, stamp, T[None], information[None], now_ns, steps)[0])
        if fate >= FUTURE:
            raise refusal(fate, stamp_ns, T, information, now_ns)
        return fate == ACCEPTED

    def deny(self, source: str, stamp_ns: int, now_ns: int | None = None) -> None:
        """Takes the word of a sense that the target is not where it is expected. A pose that this sense measured until recently
        is then not called tracking for some time (`FusionSettings.denial`), whatever other senses say; the pose itself stays as
        it is. A stamp ahead of the reader's clock `now_ns` (if given) denies nothing. Raises ValueError for an unknown source.
        """
        self._bank.deny(self._target, source, stamp_ns, now_ns)

    def adopt(self, message: FusedPose) -> None:
        """Continues from a pose that another observer of this target has published, and forgets its own state. Measurements
        before that stamp are already in the pose, and count as late."""
        self._bank.adopt(self._target, message)

    def forget(self) -> None:
        """Starts over; the counts continue."""
        self._bank.forget(slice(self._target, self._target + 1))

    def innovation(self) -> tuple[float, int]:
        """Squared Mahalanobis distance of the newest measurement's innovation (NIS) and its degrees of freedom: 0 and 0 if it
        started the state."""
        return self._bank.innovation(self._target)

    @property
    def earliest_ns(self) -> int:
        """The first stamp for which the pose is known: that of the oldest measurement kept."""
        return self._bank.earliest_ns(self._target)

    def estimate(self, stamp_ns: int) -> Estimate:
        """The pose at a stamp, from the measurements up to it. Does not change the state.

        For a stamp before the history, the oldest state is used. A source's weight is its share of the information that the
        senses brought in the last `weight_time`, with exponential decay; information in nats, as `records.SENSE_STATE` defines
        its gain.
        """
        return self._bank.one(stamp_ns, self._target)
