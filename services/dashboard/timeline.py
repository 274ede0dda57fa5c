"""What happened in the cell: states of the poses with their reasons, and processes that came, went or are not well."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

KEPT = 200
"""Entries that are kept."""
FLICKER_S = 0.3
"""A state that lasted no longer than this, between two that are the same, is no news."""
PASSING = ("ok", "degraded")
"""Statuses of a process between which a busy machine has it change for a moment."""


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
        """Takes the state of a target at a time, and where it is another one than before an entry; returns whether there is one.
        why: is read only then."""
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
        """Takes the rows of all processes (`state.processes`); one that begins, ends or changes its status gets an entry; well or
        degraded it is only once two looks have found it so. The first look only learns who is there."""
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
