"""Replicas of a service: which are alive, which of them owns a stream, and which are unfit to own any.

Each replica that can work holds a liveliness token. All replicas that see the same tokens find the same owner for a stream. One
that stands still is excluded before its token expires (`beats.py`).
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from hashlib import blake2b
from typing import Protocol

import zenoh

from penumbra.shared.runtime.beats import BEAT_S, Beats
from penumbra.shared.runtime.traffic import Traffic

CLOCK_MESSAGES = 10
"""Number of messages in a row refused for their stamps from which a process's clock differs from all others. Chosen, not
measured."""
CLOCK_SILENT_S = 1.0
"""Time [s] without such messages after which nothing is known of the clock any more."""
PACE_SHARE = 0.5
"""Weight of the newest check in the smoothed lateness of a process: three late checks in a row suffice."""
PACE_LOST = 0.5
"""Share of lost processor time above which a process withdraws: the next replica is faster. Chosen, not measured."""


class ReaderThread(Protocol):
    """Reader of a subscription."""

    thread: threading.Thread

    def close(self) -> None: ...


@dataclass
class Share:
    """A subscription that is open only while this replica owns one of `streams`. traffic: counters of its keys; read: opens
    it."""

    streams: tuple[str, ...]
    traffic: list[Traffic]
    read: Callable[[], ReaderThread]
    reader: ReaderThread | None = None

    def follow(self, is_own: bool) -> None:
        """Opens or closes the subscription according to the ownership."""
        for traffic in self.traffic:
            traffic.is_read = is_own
        if is_own and self.reader is None:
            self.reader = self.read()
        elif not is_own and self.reader is not None:
            self.reader.close()
            self.reader = None


class Replicas:
    """This replica among the living ones. key, beat_key: keys of its liveliness token and its heartbeats, with the instance as
    the last chunk.

    Before it is open it is alone and owns everything. `others`: the other instances that hold a token.
    """

    def __init__(self, key: str, beat_key: str):
        self._key, self._beat_key = key, beat_key
        self._instance = key.rpartition("/")[2]
        self._lock = threading.RLock()
        self._token: zenoh.LivelinessToken | None = None
        self._frozen: frozenset[str] = frozenset()
        self._shares: list[Share] = []
        self._ranks: dict[str, float] = {}
        self._living = frozenset({self._instance})
        self.others: frozenset[str] = frozenset()

    @property
    def has_joined(self) -> bool:
        """Whether the others know of this replica."""
        return self._token is not None

    @property
    def is_last_to_withdraw(self) -> bool:
        """Whether this replica withdraws last among the living ones, where all are unfit."""
        return self._instance == min(self._living, default="")

    def __len__(self) -> int:
        return len(self._living)

    def wait(self) -> None:
        """Gives up ownership until the other replicas are known."""
        with self._lock:
            self._living, self._ranks = frozenset(), {}

    def watch(self, session: zenoh.Session) -> None:
        """Follows the liveliness tokens until the session is closed."""
        expression = f"{self._key.rpartition('/')[0]}/*"
        tokens = session.liveliness().declare_subscriber(expression, zenoh.handlers.FifoChannel(256), history=True)
        living: set[str] = set()
        while True:
            try:
                sample = tokens.recv()
                instance = str(sample.key_expr).rpartition("/")[2]
                (living.discard if sample.kind == zenoh.SampleKind.DELETE else living.add)(instance)
                with self._lock:
                    self.others = frozenset(living - {self._instance})
                    self._count()
            except zenoh.ZError:
                return

    def beat(self, session: zenoh.Session, stopping: threading.Event) -> None:
        """Sends heartbeats to the other replicas, and excludes those whose heartbeats are missing, until `stopping` is set."""
        beats, own, expression = Beats(self._instance), self._beat_key, f"{self._beat_key.rpartition('/')[0]}/*"
        try:
            ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(64)
            inbox = session.declare_subscriber(expression, ring, allowed_origin=zenoh.Locality.REMOTE)
            while not stopping.wait(BEAT_S):
                if self.others:
                    session.put(own, b"")
                heard = {str(sample.key_expr).rpartition("/")[2] for sample in iter(inbox.try_recv, None)}
                self._leave_out(beats.judge(self.others, heard, time.monotonic()))
        except zenoh.ZError:  # the session was closed
            return

    def _leave_out(self, frozen: frozenset[str]) -> None:
        with self._lock:
            if frozen != self._frozen:
                self._frozen = frozen
                if self._living:  # otherwise it still waits for the others' tokens
                    self._count()

    def join(self, session: zenoh.Session) -> None:
        """Declares the liveliness token: from now on this replica can own streams."""
        with self._lock:
            if self._token is None:
                self._token = session.liveliness().declare_token(self._key)
            self._count()

    def withdraw(self) -> None:
        """Leaves its streams to the others."""
        with self._lock:
            if self._token is not None:
                token, self._token = self._token, None
                token.undeclare()
            self._count()

    def share(self, share: Share) -> None:
        """Opens and closes a share's subscription from now on."""
        with self._lock:
            self._shares.append(share)
            share.follow(any(map(self.owns, share.streams)))

    def leave(self) -> list[ReaderThread]:
        """Stops taking over streams; returns the readers of the streams that it owns."""
        with self._lock:
            shares, self._shares = self._shares, []
            return [share.reader for share in shares if share.reader is not None]

    def owns(self, stream: str) -> bool:
        """Whether `rank` is 0."""
        return self.rank(stream) == 0

    def rank(self, stream: str) -> float:
        """Number of living replicas of this service that precede this one for `stream`: 0 for its owner, 1 for its next owner;
        infinity while this one takes no part. Rendezvous hashing (Thaler and Ravishankar 1998, doi:10.1109/90.663936): a replica
        that comes or goes moves only its own streams."""
        rank = self._ranks.get(stream)
        if rank is None:
            ranks, living = self._ranks, self._living
            own = _weight(self._instance, stream)
            rank = sum(_weight(each, stream) > own for each in living) if self._instance in living else math.inf
            ranks[stream] = rank
        return rank

    def _count(self) -> None:
        """Updates who is living. This replica counts as soon as the others know of it, or where there are none. Where all stand
        still, as on an overloaded machine, all count."""
        self._ranks = {}
        here = self.others if self._token is None and self.others else self.others | {self._instance}
        self._living = here - self._frozen or here
        self._ranks = {}  # again: meanwhile another thread may have stored a rank computed from the old replicas
        for share in self._shares:
            share.follow(any(map(self.owns, share.streams)))


class Clock:
    """Detects, from refused messages, that this host's clock differs from those of all publishers. fault: as text, empty where
    there is none."""

    def __init__(self) -> None:
        self._good = self._odd = self._odd_before = 0
        self._odd_s = -math.inf
        self.fault = ""

    def judge(self, traffic: Iterable[Traffic], now_s: float) -> str:
        """The current fault. traffic: counters of everything that is read; now_s: monotonic time."""
        traffic = list(traffic)
        good = sum(each.count for each in traffic)
        odd = sum(each.bad.get("past", 0) + each.bad.get("future", 0) for each in traffic)
        if odd != self._odd:
            self._odd, self._odd_s = odd, now_s
        if good != self._good or now_s - self._odd_s > CLOCK_SILENT_S:
            self._good, self._odd_before, self.fault = good, odd, ""
        elif odd - self._odd_before >= CLOCK_MESSAGES:
            self.fault = "all received messages have stamps of another time: check the clock of this host"
        return self.fault


class Pace:
    """Detects a lack of processor time, from the lateness of a periodic check: the process is stopped again and again, or the
    machine is overloaded, where fewer replicas do more. A single long stop does not count, because it is over."""

    def __init__(self) -> None:
        self._lost = 0.0

    def judge(self, late_s: float, period_s: float) -> str:
        """The current fault, empty where there is none. late_s: delay of the check beyond period_s."""
        self._lost += PACE_SHARE * (late_s / (late_s + period_s) - self._lost)
        return f"this process is stalled for {self._lost:.0%} of the time" if self._lost > PACE_LOST else ""


def _weight(instance: str, stream: str) -> bytes:
    return blake2b(f"{instance} {stream}".encode()).digest()
