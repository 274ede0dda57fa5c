"""The default observer: takes poses of any rank, late and in any order, and answers with the pose at any moment.

The arithmetic of one step is in `filter.py`, the going back and replaying in `history.py`.
"""

from __future__ import annotations

import numpy as np

from services.fusion.estimate import Array, Estimate, Log, checked
from services.fusion.filter import MOTION, POSE, Filter, Measurement, Settings, State
from services.fusion.history import History
from shared import geometry
from shared.messages import Source


class ErrorStateObserver:
    """Fuses the poses of the senses by how much each can be trusted now.

    home : expected pose (4, 4) before anything is known, with standard deviations `spread` (position [m], rotation [rad]).
    """

    def __init__(self, home: geometry.Array, spread: tuple[float, float], settings: Settings | None = None):
        self.settings = settings or Settings()
        self.log = Log()
        self._home = home
        self._home_covariance = np.diag(np.repeat(np.square(spread), 3))
        self._filter = Filter(self.settings, home, self._home_covariance)
        self._history: History[State, Measurement] = History(self._filter.step, self.settings.horizon)

    def measure(self, source: str, stamp_ns: int, T: Array, information: Array, hidden: float | None = None) -> bool:
        """Takes a pose T (4, 4) with its information (6, 6, zero along what is not observed). True if it was accepted.

        `hidden` is not used: the information says how good the measurement is. Raises ValueError on a pose or an information
        that is none, and on an unknown source.
        """
        self.log.heard(source, stamp_ns)
        counts = self.log.counts[source]
        measurement = self._filter.measurement(source, stamp_ns, *checked(T, information))
        if measurement.rank == 0:
            return False
        fate = self._history.insert(measurement)
        if fate == "applied":
            passed = self._history.after(measurement.key).passed
            counts.accepted += passed
            counts.gated += not passed
            return passed
        counts.late += fate == "late"
        counts.duplicate += fate == "duplicate"
        return False

    def estimate(self, stamp_ns: int) -> Estimate:
        """The pose at a stamp, from the measurements up to it. Disturbs nothing.

        A stamp before the history reads its oldest state. A source's weight is its share of the information that the senses
        brought in the last `weight_time`, fading exponentially; information in nats, as `filter.Record.gain` defines it.
        """
        state = self._history.before(stamp_ns)
        senses = state.senses if state else {}
        total = sum(record.gain for record in senses.values())
        sources = {}
        for name, since_ns in self.log.heard_ns.items():
            record = senses.get(name)
            newest_ns = record.accepted_ns if record and record.accepted_ns is not None else since_ns
            weight = record.gain / total if record and total > 0.0 else 0.0
            sources[name] = Source(max(0.0, (stamp_ns - newest_ns) * 1e-9), weight)
        if state is None:
            return Estimate(self._home, np.zeros(6), self._home_covariance, "lost", sources)
        dt = max(0.0, (stamp_ns - state.stamp_ns) * 1e-9)
        p, R, velocity = self._filter.moved(state, dt)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, p
        F, Q = self._filter.transition(state, dt)
        covariance = F[:POSE] @ state.P[:MOTION, :MOTION] @ F[:POSE].T + Q[:POSE, :POSE]
        age_s = (stamp_ns - state.accepted_ns) * 1e-9
        return Estimate(T, velocity, covariance, self.settings.limits.state(age_s, covariance), sources)
