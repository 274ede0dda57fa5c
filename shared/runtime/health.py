"""Status of a process and its reasons.

ok: no fault. starting: it prepares its work, or waits for a process that does. degraded: it works, but with faults. down: it is
disconnected from the others.
"""

from __future__ import annotations

import math
import threading
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping, Sequence

from penumbra.shared.runtime.traffic import Traffic

STATUSES = ("ok", "starting", "degraded", "down")
LATELY_S = 30.0
"""Time [s] for which a fault affects the status."""
TURNS = "turns"
"""Kind of the counter of changes between publishers of a stream."""
MOST_TURNS = 10
"""Number of changes within LATELY_S up to which a publisher may just have been restarted."""


class Lately:
    """Growth of counters within the last LATELY_S. To be called at least once a second."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last: dict[tuple[str, str], int] = {}
        self._grew: deque[tuple[float, tuple[str, str], int]] = deque()

    def look(self, counts: Mapping[tuple[str, str], int], now_s: float) -> Counter[tuple[str, str]]:
        """Reads the counters, named by place and kind, at a monotonic time; returns those that grew, and by how much."""
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
    """Counters of faults: refused messages by key and kind, changes between publishers that should be one, and exceptions."""
    refused = {(key, kind): n for key, traffic in list(received.items()) for kind, n in list(traffic.bad.items())}
    turns = {(key, TURNS): traffic.turns for key, traffic in list(received.items()) if traffic.is_exclusive}
    return refused | turns | {("", kind): n for kind, n in list(faults.items())}


def judge(
    away: str,
    received: Mapping[str, Traffic],
    grown: Mapping[tuple[str, str], int],
    own: Sequence[str],
    now_ns: int,
    progress: str = "",
    waits: Callable[[Traffic], str] = lambda traffic: "",
) -> tuple[str, list[str]]:
    """Status and reasons. away: why the others cannot be reached, empty where they can. received: counters of what is read, by
    key. grown: growth of `counts` lately. own: the service's own reasons. progress: of its preparation. waits: why an input that
    was never received is not a fault yet, empty where it is one."""
    missing: defaultdict[tuple[str, str], list[tuple[str, float]]] = defaultdict(list)  # by fault and pattern of keys
    known: Counter[str] = Counter()
    for key, traffic in sorted(received.items()):
        pattern = _pattern(key)
        known[pattern] += math.isfinite(traffic.stale_s)  # others, such as the counters of unknown keys, are never missing
        if traffic.is_stale(now_ns):
            age_s = traffic.age_s(now_ns)
            why = "late" if age_s is not None else waits(traffic)
            missing[why, pattern].append((key, age_s or 0.0))
    starting = [progress] if progress else []
    degraded = [away] if away else []
    for (why, pattern), found in missing.items():
        which = _which([key for key, _ in found], pattern, known[pattern])
        if why == "late":
            degraded.append(f"no {which} for {max(age_s for _, age_s in found):.1f} s")
        elif why:
            starting.append(f"waiting for {which}: {why}")
        else:
            degraded.append(f"nothing received on {which} yet")
    contested: defaultdict[str, list[str]] = defaultdict(list)  # by pattern of keys
    for (key, kind), n in sorted(grown.items()):
        if kind == TURNS and n > MOST_TURNS:
            contested[_pattern(key)].append(key)
    for pattern, keys in contested.items():
        which = _which(keys, pattern, sum(_pattern(key) == pattern for key, traffic in received.items() if traffic.is_exclusive))
        only = ", ".join(received[keys[0]].publishers)
        degraded.append(f"several publishers of {which} contradict each other: let only one publish it (of {only})")
    for key in sorted({key for key, kind in grown if key and kind != TURNS}):
        kinds = ", ".join(f"{n} {kind}" for (where, kind), n in sorted(grown.items()) if where == key and kind != TURNS)
        degraded.append(f"refused on {_short(key)} in the last {LATELY_S:.0f} s: {kinds}")
    if faults := ", ".join(f"{n} {kind}" for (where, kind), n in sorted(grown.items()) if not where):
        degraded.append(f"faults in the last {LATELY_S:.0f} s: {faults}")
    degraded += own
    status = "down" if away else "degraded" if degraded else "starting" if starting else "ok"
    return status, degraded + starting


def _pattern(key: str) -> str:
    """Pattern of all keys of a topic and kind of part: `penumbra/{cell}/skin/*/voltages`."""
    chunks = key.split("/")
    return "/".join([*chunks[:3], "*", *chunks[4:]])


def _which(keys: list[str], pattern: str, known: int) -> str:
    """Keys of one pattern as text. known: number of keys with that pattern."""
    if len(keys) == 1:
        return _short(keys[0])
    return f"{_short(pattern)} ({len(keys)})" if len(keys) == known else f"{_short(pattern)} ({len(keys)} of {known})"


def _short(key: str) -> str:
    """A key without `penumbra/{cell}/`."""
    return key.split("/", 2)[-1]
