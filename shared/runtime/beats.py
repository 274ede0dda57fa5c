"""Which replicas of a service stand still: those whose beats are missed.

A liveliness token is there for as long as the connection's lease, also where its process is frozen. Beats tell it sooner; where
they are wrong, two replicas work on a stream for a moment, and no connection is lost.
"""

from __future__ import annotations

from collections.abc import Collection

BEAT_S, MISSED = 0.05, 5
"""Period [s] of a replica's beats, and how many the others miss in a row before they take it for frozen: it stands still for a
quarter of a second. Chosen: half of the time in which a replica is to have taken over."""
STEADY = 20
"""How often it then has to beat before it counts again: one that is stopped again and again does not come and go."""


class Beats:
    """The beats of the replicas, as one of them hears them. own: that one."""

    def __init__(self, own: str):
        self._own = own
        self._missed: dict[str, int] = {}  # in a row, of those that have ever beaten
        self._unsteady: dict[str, int] = {}  # how often each has to beat until it counts again
        self._last_s: float | None = None

    def judge(self, others: Collection[str], heard: Collection[str], now_s: float) -> frozenset[str]:
        """The replicas that are taken for frozen, at another beat of this one's own: while it stands still itself it misses none,
        and the others miss its own, so that it is of them afterwards.

        others: those that hold a token. heard: those that have beaten since the last time; one that never has is not missed, as
        one of an older release. now_s: of a clock that nobody sets.
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
