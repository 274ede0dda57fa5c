"""Fitness of a replica: its handlers return, the process gets processor time, and its clock agrees with the others."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable

import zenoh

from penumbra.shared.runtime.hang import HANG_S, Turn
from penumbra.shared.runtime.logs import Log
from penumbra.shared.runtime.replicas import Clock, Pace, Replicas
from penumbra.shared.runtime.traffic import Traffic

LOOK_S = 0.2
"""Period [s] of the fitness checks of a replica."""
UNWATCHED_S = 5.0
"""Time [s] without a check after which the watchdog itself is blocked, for example without memory for a thread."""


class Fitness:
    """Monitors a replica, and leaves its streams to the others while it is unfit."""

    def __init__(self, replicas: Replicas, log: Log):
        self._replicas, self._log = replicas, log
        self._turns: list[Turn] = []
        self._hang = ""  # description of the hanging handler
        self._looked_s = math.inf
        self._slowness = ""  # description of a lack of processor time
        self._clock, self._pace = Clock(), Pace()

    def turn(self, what: str, patience_s: float = HANG_S) -> Turn:
        """A new handler's calls, monitored from now on."""
        self._turns.append(turn := Turn(what, patience_s))
        return turn

    def watch(
        self,
        stopping: threading.Event,
        received: Callable[[], Iterable[Traffic]],
        rejoin: Callable[[], None],
        before: Callable[[], None],
    ) -> None:
        """Checks the replica every LOOK_S until `stopping` is set.

        While a handler hangs, the process stands still or its clock is off, the replica withdraws if others live, and they own
        its streams until it is fit again. Where all are unfit, as on an overloaded machine, one stays: the last to withdraw waits
        for one more check. received: counters of everything that is read. rejoin: called when the replica is fit again, or alone.
        before: called before each check.
        """
        self._looked_s, has_withdrawn, unfit_looks = time.monotonic(), False, 0
        while not stopping.wait(LOOK_S):
            before()
            unfit = self._look(time.monotonic(), received)
            unfit_looks = unfit_looks + 1 if unfit else 0
            try:
                if unfit_looks > self._replicas.is_last_to_withdraw and self._replicas.has_joined and self._replicas.others:
                    self._log.warning("unfit: the other replicas take over", why=unfit)
                    has_withdrawn = True
                    self._replicas.withdraw()
                elif has_withdrawn and not (unfit and self._replicas.others):
                    self._log.info("no other replica is left" if unfit else "fit again")
                    has_withdrawn = False
                    rejoin()
            except zenoh.ZError:  # the session was closed
                return

    def hangs(self) -> str:
        """Description of what hangs; empty where nothing does."""
        is_watched = time.monotonic() - self._looked_s < UNWATCHED_S
        return self._hang if is_watched else f"the watchdog itself has been blocked for {UNWATCHED_S:g} s"

    def faults(self) -> list[str]:
        """Reasons why this replica is unfit."""
        return [*filter(None, [self.hangs(), self._slowness, self._clock.fault])]

    def _look(self, now_s: float, received: Callable[[], Iterable[Traffic]]) -> str:
        late_s, self._looked_s = now_s - self._looked_s - LOOK_S, now_s
        self._slowness = self._pace.judge(late_s, LOOK_S)
        if late_s < LOOK_S:  # otherwise the whole process stood still
            longest_s, what = max(((turn.hangs_s(now_s), turn.what) for turn in self._turns), default=(0.0, ""))
            self._hang = f"{what} hangs for {longest_s:.0f} s" if longest_s else ""
        return self._hang or self._slowness or self._clock.judge(received(), now_s)
