"""Events of the cell: states of the poses with their reasons, and processes that started, ended or are not well."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

KEPT = 200
"""Number of entries that are kept."""
FLICKER_S = 0.3
"""Maximum duration [s] of a state between two equal states that is not recorded."""
PASSING = ("ok", "degraded")
"""Statuses of a process that may alternate briefly on a busy machine."""


class Timeline:
    """The newest KEPT entries, oldest first. An entry: `number` from 1, `time` [s since the epoch], `about` (a target or a
    process), `kind` (target or process), `state`, `why` in words."""

    def __init__(self) -> None:
        self.entries: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self._number = 0
        self._states: dict[str, str] = {}
        self._processes: dict[str, str] | None = None
        self._looked: dict[str, str] = {}

    def state(self, target: str, state: str, time_s: float, why: Iterable[str]) -> bool:
        """Record the state of a target at a time; adds an entry if it differs from the previous one, and returns whether it did.
        Instead, the entry of a flicker is removed. why: is read only for a new entry."""
        if self._states.get(target) == state:
            return False
        self._states[target] = state
        own = [entry for entry in self.entries if entry["about"] == target]
        if len(own) >= 2 and own[-2]["state"] == state and time_s - own[-1]["time"] < FLICKER_S:
            self.entries.remove(own[-1])
            return False
        self._add(target, "target", state, time_s, "; ".join(why))
        return True

    def processes(self, rows: Iterable[Mapping[str, Any]], time_s: float) -> None:
        """Record the rows of all processes (`state.processes`); a process that starts, ends or changes its status gets an entry.
        A change between ok and degraded counts only after two looks. The first look only records the existing processes."""
        named = {row["id"]: row for row in rows}
        now = {name: str(row["status"]) for name, row in named.items()}
        looked, self._looked = self._looked, now
        if self._processes is None:
            self._processes = now
            return
        before, self._processes = self._processes, {}
        for name in now:
            flickers = name in before and now[name] in PASSING and looked.get(name) != now[name]
            self._processes[name] = before[name] if flickers else now[name]
            if self._processes[name] != before.get(name):
                self._add(named[name]["name"], "process", now[name], time_s, named[name]["why"])
        for name in before.keys() - now.keys():
            self._add(name, "process", "ended", time_s, "")

    def _add(self, about: str, kind: str, state: str, time_s: float, why: str) -> None:
        self._number += 1
        entry = {"number": self._number, "time": time_s, "about": about, "kind": kind, "state": state, "why": why}
        self.entries.append(entry)
