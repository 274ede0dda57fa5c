"""Whether a replica is fit for its part: its handlers return, the process gets its time, and its clock is that of the others."""

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
"""Period [s] of the checks whether this replica is fit for its part."""
UNWATCHED_S = 5.0
"""Time [s] without a check after which the watchdog itself is blocked, as where there is no memory for a thread."""


class Fitness:
    """Watches a replica, and has it leave its streams to the others while it is unfit."""

    def __init__(self, replicas: Replicas, log: Log):
        self._replicas, self._log = replicas, log
        self._turns: list[Turn] = []
        self._hang = ""  # the handler that hangs, in words
        self._looked_s = math.inf
        self._slowness = ""  # that this process does not get its time, in words
        self._clock, self._pace = Clock(), Pace()

    def turn(self, what: str, patience_s: float = HANG_S) -> Turn:
        """The calls of a handler, to be watched from now on."""
        self._turns.append(turn := Turn(what, patience_s))
        return turn

    def watch(
        self,
        stopping: threading.Event,
        received: Callable[[], Iterable[Traffic]],
        rejoin: Callable[[], None],
        before: Callable[[], None],
    ) -> None:
        """Looks every LOOK_S until `stopping` is set. While a handler hangs, this process stands still or its clock is off, it
        has no part where others live: its streams are theirs until it is fit again. Where all are unfit, as on an overloaded
        machine, one keeps its part: the last to withdraw looks once more before it does. received: the counters of what is read.
        rejoin: called when the replica is fit again, or alone. before: called before each look."""
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
        """What hangs, in words; empty where nothing does."""
        is_watched = time.monotonic() - self._looked_s < UNWATCHED_S
        return self._hang if is_watched else f"the watchdog itself has been blocked for {UNWATCHED_S:g} s"

    def faults(self) -> list[str]:
        """Why this replica is unfit, in words."""
        return [*filter(None, [self.hangs(), self._slowness, self._clock.fault])]

    def _look(self, now_s: float, received: Callable[[], Iterable[Traffic]]) -> str:
        late_s, self._looked_s = now_s - self._looked_s - LOOK_S, now_s
        self._slowness = self._pace.judge(late_s, LOOK_S)
        if late_s < LOOK_S:  # else the whole process stood still
            longest_s, what = max(((turn.hangs_s(now_s), turn.what) for turn in self._turns), default=(0.0, ""))
            self._hang = f"{what} hangs for {longest_s:.0f} s" if longest_s else ""
        return self._hang or self._slowness or self._clock.judge(received(), now_s)
