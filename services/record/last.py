"""Ring buffer of the last seconds in memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from penumbra.shared.recording.entries import Entry

OVERHEAD = 200
"""Assumed memory [bytes] of an entry besides its data."""


class Last:
    """Entries of the last `seconds`, of at most `most_bytes`. bytes: their current size."""

    def __init__(self, seconds: float, most_bytes: float):
        self.seconds, self._most_bytes = seconds, most_bytes
        self._entries: deque[Entry] = deque()
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._entries)

    def add(self, entries: Iterable[Entry]) -> None:
        """Add entries in the order of their arrival, and drop the oldest."""
        for entry in entries:
            size = len(entry.data) + OVERHEAD
            while self._entries and self.bytes + size > self._most_bytes:
                self._forget()
            self._entries.append(entry)
            self.bytes += size
        while self.span_s > self.seconds:
            self._forget()

    def _forget(self) -> None:
        self.bytes -= len(self._entries.popleft().data) + OVERHEAD

    @property
    def span_s(self) -> float:
        """Time [s] from the oldest to the newest entry."""
        return (self._entries[-1].log_ns - self._entries[0].log_ns) * 1e-9 if self._entries else 0.0

    def all(self) -> list[Entry]:
        """The entries, oldest first."""
        return list(self._entries)
