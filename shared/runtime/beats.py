"""Detection of frozen replicas of a service by missed heartbeats.

A liveliness token lasts as long as the connection's lease, even if its process is frozen. Heartbeats show this sooner. When they
are wrong, two replicas work on a stream for a moment, and no connection is lost.
"""

from __future__ import annotations

from collections.abc import Collection

BEAT_S, MISSED = 0.05, 5
"""Period [s] of a replica's heartbeats, and the number of successive missed ones after which the others take it for frozen: a
quarter of a second. Chosen: half of the time within which another replica must have taken over."""
STEADY = 20
"""Number of heartbeats after which such a replica counts again, so that one that is stopped again and again does not come and
go."""


class Beats:
    """Heartbeats of all replicas, as received by one of them. own: that replica."""

    def __init__(self, own: str):
        self._own = own
        self._missed: dict[str, int] = {}  # successive misses, by replica that has ever sent a heartbeat
        self._unsteady: dict[str, int] = {}  # heartbeats that each still has to send until it counts again
        self._last_s: float | None = None

    def judge(self, others: Collection[str], heard: Collection[str], now_s: float) -> frozenset[str]:
        """Replicas that are taken for frozen. Called at each heartbeat of this replica.

        After it stood still, this replica counts itself as frozen: it cannot have missed others, but they missed its heartbeats.

        others: replicas that hold a token. heard: replicas heard since the last call; one that has never sent a heartbeat (an
        older release) is not missed. now_s: monotonic time.
        """
        known = [each for each in others if each in heard or each in self._missed]
        self._missed = {each: 0 if each in heard else self._missed[each] + 1 for each in known}
        has_stalled = self._last_s is not None and now_s - self._last_s > MISSED * BEAT_S
        self._last_s = now_s
        is_frozen = {each: missed >= MISSED for each, missed in self._missed.items()} | {self._own: has_stalled}
        self._unsteady = {
            each: STEADY if frozen else max(0, self._unsteady.get(each, 0) - 1) for each, frozen in is_frozen.items()
        }
        return frozenset(each for each, beats in self._unsteady.items() if beats)
