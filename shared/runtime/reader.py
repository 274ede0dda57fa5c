"""What reads a subscription: `Reader` hands every message to a handler, `Latest` keeps the newest until somebody looks at it.

Both judge a sample alike: its key, its size, the publisher's number and rate (`shared.runtime.guard`), its version and its stamp.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import zenoh

from shared.contract.messages import BadMessage, Message, check_stamp, decode, head
from shared.contract.topics import Topic
from shared.runtime.guard import Guard
from shared.runtime.hang import Turn
from shared.runtime.traffic import Traffic

M = TypeVar("M", bound=Message)


@dataclass
class Stream:
    """One key that is read: the names in it, its counters, and who may send on it."""

    names: dict[str, str]
    traffic: Traffic
    guard: Guard


@dataclass(frozen=True)
class Inbox:
    """What a reader is declared with.

    expression: the key expression that is subscribed to. depth: samples that are kept while nobody takes them. streams: every
    concrete key that the cell knows; a sample on any other key is refused and counted in `strangers`, so that nobody can grow the
    table. now_ns: the clock that stamps are compared with. refused: called with the first bad message of each kind on a key.
    failed: called with every exception of a handler. from_others: leaves out what this session publishes itself.
    """

    topic: Topic
    expression: str
    depth: int
    streams: Mapping[str, Stream]
    now_ns: Callable[[], int]
    refused: Callable[[str, BadMessage], None]
    failed: Callable[[str, Exception], None]
    from_others: bool = False
    strangers: Traffic = field(default_factory=lambda: Traffic(math.inf))

    def subscribe(self, session: zenoh.Session) -> zenoh.Subscriber[Any]:
        """A subscription with a ring: a Python callback or the default channel would let one slow reader hold up every other
        subscriber of the session."""
        origin = zenoh.Locality.REMOTE if self.from_others else zenoh.Locality.ANY
        return session.declare_subscriber(self.expression, zenoh.handlers.RingChannel(self.depth), allowed_origin=origin)

    def admit(self, sample: zenoh.Sample, key: str, publisher: str, number: int | None, now_s: float) -> tuple[Stream, bytes]:
        """The stream and the payload of a sample, before anything that takes long. Raises BadMessage."""
        stream = self.streams.get(key)
        if stream is None:
            raise BadMessage("key", f"one of the cell's {len(self.streams)} keys expected, {key!r:.120} came")
        stream.traffic.missed(stream.guard.admit(publisher, number, now_s))
        kind, payload = self.topic.message, sample.payload
        if sample.kind == zenoh.SampleKind.DELETE:
            raise BadMessage("delete", f"a {kind.__name__} expected, a deletion came")
        if len(payload) > kind.MAX_BYTES:  # before it is copied
            raise BadMessage("size", f"{kind.__name__}: at most {kind.MAX_BYTES} bytes expected, {len(payload)} came")
        return stream, payload.to_bytes()

    def refuse(self, key: str, error: BadMessage) -> None:
        """Counts a bad message; the first of its kind on its key is reported."""
        stream = self.streams.get(key)
        bad = (self.strangers if stream is None else stream.traffic).bad
        bad[error.kind] = bad.get(error.kind, 0) + 1
        if bad[error.kind] == 1:
            self.refused(key, error)


class Reader:
    """A thread that decodes samples as they come and calls `handler(message, names)` with each. turn: is told when the handler
    begins and returns."""

    def __init__(self, session: zenoh.Session, inbox: Inbox, handler: Callable[[Any, dict[str, str]], None], turn: Turn):
        self._inbox, self._handler, self._turn = inbox, handler, turn
        self._subscriber = inbox.subscribe(session)
        self._ring = self._subscriber.handler  # the subscriber itself cannot be closed while a thread waits in it
        self.thread = threading.Thread(target=self._run, name=f"read {inbox.expression}", daemon=True)
        self.thread.start()

    def close(self) -> None:
        """Ends the subscription; the message that is under way is still handed on."""
        self._subscriber.undeclare()

    def _run(self) -> None:
        receive, take = self._ring.recv, self._take
        while True:
            try:
                sample = receive()
            except zenoh.ZError:  # the subscription, or the session, was closed
                return
            take(sample)

    def _take(self, sample: zenoh.Sample) -> None:
        inbox, key = self._inbox, str(sample.key_expr)
        publisher, number = publisher_of(sample)
        now_s, now_ns = time.monotonic(), inbox.now_ns()
        try:
            stream, payload = inbox.admit(sample, key, publisher, number, now_s)
            message = decode(inbox.topic.message, payload, now_ns, inbox.topic.oldest_s)
            stream.guard.believe(publisher, message.stamp_ns, now_s, getattr(message, "camera", ""))
        except BadMessage as error:
            inbox.refuse(key, error)
            return
        stream.traffic.took(message.stamp_ns, now_ns, now_s)
        try:
            with self._turn:
                self._handler(message, {**stream.names, "publisher": publisher})
        except Exception as error:
            inbox.failed(f"reader of {key}", error)


@dataclass
class _Newest(Generic[M]):
    payload: bytes | None = None
    message: M | None = None


class Latest(Generic[M]):
    """The newest message of each key of a topic, for whoever looks rarely at what comes often: nothing wakes up when a message
    comes, and only a message that is looked at is decoded. The others are taken from the ring by `drain`, which looks at their
    number, version and stamp, and counts them. Several threads may look at once.

    `drain` must be called every LOOK_S at least, or the ring overflows; the node does so.
    """

    def __init__(self, inbox: Inbox):
        self._inbox = inbox
        self._lock = threading.Lock()
        self._subscriber: zenoh.Subscriber[Any] | None = None
        self._newest: dict[str, _Newest[M]] = {key: _Newest() for key in inbox.streams}
        self._keys = {tuple(sorted(stream.names.items())): key for key, stream in inbox.streams.items()}
        self.count = 0
        """Good messages so far, on all keys, when last drained."""

    def open(self, session: zenoh.Session) -> None:
        """Subscribes."""
        self._subscriber = self._inbox.subscribe(session)

    def get(self, **names: str) -> M | None:
        """The newest good message of the key with these names, None where there was none. Raises KeyError for a key that is not
        read."""
        key = self._keys[tuple(sorted(names.items()))]
        with self._lock:
            self._drain()
            newest = self._newest[key]
            if newest.payload is not None:
                payload, newest.payload = newest.payload, None
                try:
                    newest.message = decode(self._inbox.topic.message, payload)  # type: ignore[assignment]
                except BadMessage as error:
                    self._inbox.refuse(key, error)
            return newest.message

    def drain(self) -> int:
        """Takes what has come since the last time, and returns `count`."""
        with self._lock:
            self._drain()
            return self.count

    def _drain(self) -> None:
        if self._subscriber is None:
            return
        try:
            while (sample := self._subscriber.handler.try_recv()) is not None:
                self._take(sample)
        except zenoh.ZError:  # the session was closed
            self._subscriber = None

    def _take(self, sample: zenoh.Sample) -> None:
        inbox, key = self._inbox, str(sample.key_expr)
        publisher, number = publisher_of(sample)
        now_s, now_ns = time.monotonic(), inbox.now_ns()
        kind = inbox.topic.message
        try:
            stream, payload = inbox.admit(sample, key, publisher, number, now_s)
            found = head(kind, payload)
            check_stamp(kind, found.stamp_ns, now_ns, inbox.topic.oldest_s)
            stream.guard.believe(publisher, found.stamp_ns, now_s, found.camera)
        except BadMessage as error:
            inbox.refuse(key, error)
            return
        stream.traffic.took(found.stamp_ns, None, now_s)
        self._newest[key].payload = payload
        self.count += 1


def publisher_of(sample: zenoh.Sample) -> tuple[str, int | None]:
    """Who sent a message, and its number; nobody and None where it does not say."""
    info = sample.source_info
    if info is None:
        return "", None
    source = info.source_id
    return f"{source.zid}/{source.eid}", info.source_sn
