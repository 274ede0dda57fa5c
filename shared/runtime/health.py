"""How a process fares, in one word and its reasons. ok: nothing to say; degraded: it works, but not as it should; down: it is cut
off from the others."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Mapping, Sequence

from shared.runtime.bus import Traffic

LATELY_S = 30.0
"""What happened longer ago than this says nothing about now."""


class Lately:
    """By how much counters grew in the last LATELY_S. They are looked at once a second or more often."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last: dict[tuple[str, str], int] = {}
        self._grew: deque[tuple[float, tuple[str, str], int]] = deque()

    def look(self, counts: Mapping[tuple[str, str], int], now_s: float) -> Counter[tuple[str, str]]:
        """Takes the counters, each named by where and what, at a time of a steady clock; what grew, and by how much."""
        with self._lock:
            for name, count in counts.items():
                if by := count - self._last.get(name, 0):
                    self._grew.append((now_s, name, by))
                    self._last[name] = count
            while self._grew and now_s - self._grew[0][0] > LATELY_S:
                self._grew.popleft()
            grown: Counter[tuple[str, str]] = Counter()
            for _, name, by in self._grew:
                grown[name] += by
            return grown


def counts(received: Mapping[str, Traffic], faults: Mapping[str, int]) -> dict[tuple[str, str], int]:
    """The counters of what should not happen: refused messages by key and kind, and exceptions."""
    refused = {(key, kind): n for key, traffic in list(received.items()) for kind, n in list(traffic.bad.items())}
    return refused | {("", kind): n for kind, n in list(faults.items())}


def judge(
    away: str, received: Mapping[str, Traffic], grown: Mapping[tuple[str, str], int], own: Sequence[str], now_ns: int
) -> tuple[str, list[str]]:
    """Status and reasons. away: why the others cannot be reached, empty where they can; received: what is read, by key; grown:
    which of `counts` grew lately; own: what the service itself suffers from."""
    reasons = [away] if away else []
    for key, traffic in sorted(received.items()):
        if traffic.is_stale(now_ns):
            age_s = traffic.age_s(now_ns)
            reasons.append(f"nothing heard on {_short(key)} yet" if age_s is None else f"no {_short(key)} for {age_s:.1f} s")
    for key in sorted({key for key, _ in grown if key}):
        kinds = ", ".join(f"{n} {kind}" for (where, kind), n in sorted(grown.items()) if where == key)
        reasons.append(f"refused on {_short(key)} in the last {LATELY_S:.0f} s: {kinds}")
    if faults := ", ".join(f"{n} {kind}" for (where, kind), n in sorted(grown.items()) if not where):
        reasons.append(f"faults in the last {LATELY_S:.0f} s: {faults}")
    reasons += own
    return "down" if away else "degraded" if reasons else "ok", reasons


def _short(key: str) -> str:
    """A key without `penumbra/{cell}/`."""
    return key.split("/", 2)[-1]
