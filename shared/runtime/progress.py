"""Progress of a process that is starting, and of the publishers that it waits for."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable

from penumbra.shared.contract import report
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.logs import Log
from penumbra.shared.runtime.traffic import Traffic

LOG_S = 2.0
"""Period [s] of the log lines about one task."""
ABSENT_S = 10.0
"""Time [s] after the start of this process for which a publisher without an answer may still be starting."""
SETTLE_S = 2.0
"""Maximum time [s] between a publisher's readiness and its first message."""
STARTING_S = 120.0
"""Time [s] after which an input that was never received is a fault, whatever its publishers report."""


class Progress:
    """Tasks in progress during a start, each with its completed and total steps. Thread-safe."""

    def __init__(self, log: Log):
        self._log = log
        self._lock = threading.Lock()
        self._tasks: dict[str, str] = {}
        self._logged_s: dict[str, float] = {}

    def set(self, what: str, done: int, total: int) -> None:
        """Records the state of a task, which ends with its last step."""
        text = f"{what} {done} of {total}"
        with self._lock:
            if done >= total:
                self._tasks.pop(what, None)
                is_due = self._logged_s.pop(what, None) is not None
            else:
                self._tasks[what] = text
                now_s = time.monotonic()
                is_due = now_s - self._logged_s.get(what, -LOG_S) >= LOG_S
                if is_due:
                    self._logged_s[what] = now_s
        if is_due:
            self._log.info(text)

    def __str__(self) -> str:
        """The tasks as text; empty where there are none."""
        with self._lock:
            return ", ".join(self._tasks.values())


class Waiting:
    """Reasons why an input that was never received is not a fault yet: its publishers are starting, or were a moment ago.

    ask: returns the answers of a service to the health query; raises bus.Refused where it is too busy to answer. `look` calls it,
    and may block for that time; `why` does not.
    """

    def __init__(self, ask: Callable[[str], Iterable[bytes]]):
        self._ask = ask
        self._began_s = time.monotonic()
        self._doing: dict[str, str] = {}  # progress by service that is starting
        self._settled_s: dict[str, float] = {}  # time since which a service answers that it is not starting

    def look(self, received: Iterable[Traffic], now_ns: int) -> None:
        """Queries the progress of the publishers of inputs that were never received."""
        missing = [traffic for traffic in received if traffic.stamp_ns is None and traffic.is_stale(now_ns)]
        now_s = time.monotonic()
        if now_s - self._began_s > STARTING_S:
            return
        for service in sorted({service for traffic in missing for service in traffic.publishers}):
            reports = []
            try:
                answers = self._ask(service)
            except bus.Refused:  # for example because it compiles
                self._doing.setdefault(service, "")
                self._settled_s.pop(service, None)
                continue
            for answer in answers:
                with contextlib.suppress(ValueError):  # a report of another release
                    reports.append(report.read(answer))
            starting = [found for found in reports if found.status == "starting"]
            if starting:
                self._doing[service] = next((found.progress for found in starting if found.progress), "")
                self._settled_s.pop(service, None)
            elif reports:
                self._doing.pop(service, None)
                self._settled_s.setdefault(service, now_s)
            else:
                self._doing.pop(service, None)
                self._settled_s.pop(service, None)

    def why(self, traffic: Traffic) -> str:
        """State of an input's publishers as text; empty where the input should have been received by now."""
        now_s = time.monotonic()
        if now_s - self._began_s > STARTING_S:
            return ""
        for service in traffic.publishers:
            if service in self._doing:
                return f"{service} is {self._doing[service] or 'starting'}"
        settled_s = [self._settled_s[service] for service in traffic.publishers if service in self._settled_s]
        if settled_s:
            return f"{' or '.join(traffic.publishers)} has just started" if now_s - min(settled_s) < SETTLE_S else ""
        return f"{' or '.join(traffic.publishers)} is not there yet" if now_s - self._began_s < ABSENT_S else ""
