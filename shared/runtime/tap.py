"""Access to all messages of topics, as unchecked bytes, for a recorder: no message is left out for lack of a reader.

Zenoh's thread copies a message as soon as it arrives, so that a camera's shared memory is free again at once. The owner takes the
messages together, a few times a second.
"""

from __future__ import annotations

import functools
import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import zenoh

from penumbra.shared.contract.messages import BadMessage, head
from penumbra.shared.contract.topics import Topic
from penumbra.shared.runtime.guard import PUBLISHERS, SequenceWindow
from penumbra.shared.runtime.reader import sender_of
from penumbra.shared.runtime.traffic import Traffic


@dataclass(frozen=True)
class Taken:
    """A message as it was on the bus. received_ns: its arrival. stamp_ns: its stamp, else its arrival. publisher: its identity,
    empty where it has none; number: in the publisher's sequence."""

    received_ns: int
    stamp_ns: int
    topic: Topic
    key: str
    names: dict[str, str]
    payload: bytes
    publisher: bytes = b""
    number: int = 0


class Tap:
    """Messages since the last `take`.

    keys: the concrete keys of each topic, with the names in them and their counters. most_bytes: maximum size of waiting
    messages; further ones are lost. lost: number of lost messages. now_ns: the clock.
    """

    def __init__(
        self,
        keys: Iterable[tuple[Topic, str, dict[str, str], Traffic]],
        most_bytes: int,
        now_ns: Callable[[], int],
    ):
        self._keys = {key: (topic, names, traffic) for topic, key, names, traffic in keys}
        self._most_bytes, self._now_ns = most_bytes, now_ns
        self._lock = threading.Lock()
        self._waiting: deque[Taken] = deque()
        self._bytes = 0
        self._windows: dict[tuple[str, bytes], SequenceWindow] = {}
        self.lost = 0

    def open(self, session: zenoh.Session) -> None:
        """Subscribes."""
        for key in self._keys:
            # runs in Zenoh's own thread: another thread would be woken for each message
            handler = zenoh.handlers.Callback(functools.partial(self._put, key), indirect=False)
            session.declare_subscriber(key, handler)

    def take(self) -> list[Taken]:
        """All waiting messages, in the order of their arrival."""
        with self._lock:
            waiting, self._waiting, self._bytes = self._waiting, deque(), 0
        for taken in waiting:
            self._count(taken)
        return sorted(waiting, key=lambda taken: taken.received_ns)

    def _put(self, key: str, sample: zenoh.Sample) -> None:
        received_ns = self._now_ns()
        topic, names, traffic = self._keys[key]
        size = len(sample.payload)
        if size > topic.message.MAX_BYTES or self._bytes + size > self._most_bytes:
            self.lost += 1
            return
        publisher, number = sender_of(sample)
        payload = sample.payload.to_bytes()
        try:
            stamp_ns = head(topic.message, payload).stamp_ns
        except BadMessage as error:
            traffic.bad[error.kind] = traffic.bad.get(error.kind, 0) + 1
            stamp_ns = received_ns
        if not 0 <= stamp_ns < 1 << 64:
            stamp_ns = received_ns
        with self._lock:
            self._waiting.append(Taken(received_ns, stamp_ns, topic, key, names, payload, publisher, number or 0))
            self._bytes += size

    def _count(self, taken: Taken) -> None:
        traffic = self._keys[taken.key][2]
        traffic.record(taken.stamp_ns, taken.received_ns)
        source = taken.key, taken.publisher
        if not taken.publisher:
            return
        window = self._windows.get(source)
        if window is None:
            if len(self._windows) < PUBLISHERS * len(self._keys):
                self._windows[source] = SequenceWindow(taken.number)
            return
        try:
            traffic.missed(window.take(taken.number))
        except BadMessage as error:
            traffic.bad[error.kind] = traffic.bad.get(error.kind, 0) + 1
