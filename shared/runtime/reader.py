"""Readers of a subscription: `Reader` passes every message to a handler, `Latest` keeps the newest until it is read.

Both check a sample alike: its key, its size, the publisher's number and rate (`shared.runtime.guard`), its version and its stamp.
These checks run at most 200 times a second and find no cache warm: each call of another library, and each call into Zenoh, costs
some ten microseconds.
"""

from __future__ import annotations

import functools
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import zenoh

from penumbra.shared.contract.messages import BadMessage, Message, check_stamp, codec, decode, head
from penumbra.shared.contract.topics import Topic
from penumbra.shared.runtime.guard import IDENTITY_BYTES, NUMBER_BYTES, PUBLISHERS, Guard
from penumbra.shared.runtime.hang import Turn
from penumbra.shared.runtime.traffic import Traffic

M = TypeVar("M", bound=Message)


@dataclass
class Stream:
    """One key that is read: the names in it, its counters, its publishers, and the last one of them."""

    names: dict[str, str]
    traffic: Traffic
    guard: Guard
    publisher: bytes | None = None

    def __post_init__(self) -> None:
        self.names_with = functools.lru_cache(PUBLISHERS)(self._names_with)
        """The names, and as `publisher` who sent a message; one dictionary for all messages of a publisher."""

    def _names_with(self, publisher: bytes) -> dict[str, str]:
        return {**self.names, "publisher": publisher.hex()}


@dataclass(frozen=True)
class Inbox:
    """Settings of a reader.

    expression: the key expression of the subscription. depth: maximum number of samples that wait. streams: all concrete keys of
    the cell. A sample on any other key is refused and counted in `unknown`, so that no publisher can make the table grow. now_ns:
    the clock to which stamps are compared. refused: called with the first bad message of each kind on a key. failed: called with
    every exception of a handler. from_others: excludes messages that this session publishes.
    """

    topic: Topic
    expression: str
    depth: int
    streams: Mapping[str, Stream]
    now_ns: Callable[[], int]
    refused: Callable[[str, BadMessage], None]
    failed: Callable[[str, Exception], None]
    from_others: bool = False
    unknown: Traffic = field(default_factory=lambda: Traffic(math.inf))

    def subscribe(self, session: zenoh.Session) -> zenoh.Subscriber[Any]:
        """Subscribes with a ring buffer: with a Python callback or the default channel, one slow reader would block all other
        subscribers of the session."""
        origin = zenoh.Locality.REMOTE if self.from_others else zenoh.Locality.ANY
        return session.declare_subscriber(self.expression, zenoh.handlers.RingChannel(self.depth), allowed_origin=origin)

    def admit(self, sample: zenoh.Sample, now_s: float) -> tuple[Stream, bytes, bytes]:
        """Stream, publisher and payload of a sample, after the fast checks. Raises BadMessage."""
        key = self.key_of(sample)
        stream = self.streams.get(key)
        if stream is None:
            raise BadMessage("key", f"expected one of the cell's {len(self.streams)} keys, got {key!r:.120}")
        publisher, number = sender_of(sample)
        stream.traffic.missed(stream.guard.admit(publisher, number, now_s))
        if publisher != stream.publisher:
            stream.traffic.turns += stream.publisher is not None
            stream.publisher = publisher
        kind, payload = self.topic.message, sample.payload
        size = len(payload)
        if not size and sample.kind == zenoh.SampleKind.DELETE:
            raise BadMessage("delete", f"expected a {kind.__name__}, got a deletion")
        if size > kind.MAX_BYTES:  # before it is copied
            raise BadMessage("size", f"{kind.__name__}: expected at most {kind.MAX_BYTES} bytes, got {size}")
        return stream, publisher, payload.to_bytes()

    def key_of(self, sample: zenoh.Sample) -> str:
        """Key of a sample. Where the subscription has a single key, every sample belongs to it."""
        return self.expression if len(self.streams) == 1 else str(sample.key_expr)

    def refuse(self, key: str, error: BadMessage) -> None:
        """Counts a bad message; the first of its kind on its key is reported."""
        stream = self.streams.get(key)
        bad = (self.unknown if stream is None else stream.traffic).bad
        bad[error.kind] = bad.get(error.kind, 0) + 1
        if bad[error.kind] == 1:
            self.refused(key, error)


class Reader:
    """Thread that decodes samples as they arrive and calls `handler(message, names)` with each. turn: notified when the handler
    begins and returns."""

    def __init__(self, session: zenoh.Session, inbox: Inbox, handler: Callable[[Any, dict[str, str]], None], turn: Turn):
        self._inbox, self._handler, self._turn = inbox, handler, turn
        self._decode, self._oldest_s = codec(inbox.topic.message).decode, inbox.topic.oldest_s
        self._subscriber = inbox.subscribe(session)
        self._ring = self._subscriber.handler  # the subscriber itself cannot be closed while a thread waits in it
        self.thread = threading.Thread(target=self._run, name=f"read {inbox.expression}", daemon=True)
        self.thread.start()

    def close(self) -> None:
        """Ends the subscription. The message in progress is still handled."""
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
        inbox, now_s = self._inbox, time.monotonic()
        now_ns = inbox.now_ns()
        try:
            stream, publisher, payload = inbox.admit(sample, now_s)
            message = self._decode(payload)
            check_stamp(inbox.topic.message, message.stamp_ns, now_ns, self._oldest_s)
            stream.guard.accept(publisher, message.stamp_ns, now_s, getattr(message, "camera", ""))
        except BadMessage as error:
            inbox.refuse(inbox.key_of(sample), error)
            return
        stream.traffic.record(message.stamp_ns, now_ns)
        try:
            with self._turn:
                self._handler(message, stream.names_with(publisher))
        except Exception as error:
            inbox.failed(f"reader of {inbox.key_of(sample)}", error)


@dataclass
class _Newest(Generic[M]):
    payload: bytes | None = None
    message: M | None = None


class Latest(Generic[M]):
    """The newest message of each key of a topic, for a caller that reads less often than messages arrive. No thread wakes up when
    a message arrives, and only a message that is read is decoded. `drain` takes the others from the ring, checks their number,
    version and stamp, and counts them. Thread-safe.

    `drain` must be called at least every LOOK_S (`fitness`), or the ring overflows; the node does so.
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
        """The newest good message of the key with these names, None before the first. Raises KeyError for a key that is not
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
        """Processes the messages since the last call, and returns `count`."""
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
        inbox, now_s, now_ns = self._inbox, time.monotonic(), self._inbox.now_ns()
        kind = inbox.topic.message
        try:
            stream, publisher, payload = inbox.admit(sample, now_s)
            found = head(kind, payload)
            check_stamp(kind, found.stamp_ns, now_ns, inbox.topic.oldest_s)
            stream.guard.accept(publisher, found.stamp_ns, now_s, found.camera)
        except BadMessage as error:
            inbox.refuse(inbox.key_of(sample), error)
            return
        stream.traffic.record(found.stamp_ns, None)
        self._newest[inbox.key_of(sample)].payload = payload
        self.count += 1


def sender_of(sample: zenoh.Sample) -> tuple[bytes, int | None]:
    """Publisher of a message, and its number (`guard.Numbering`); empty and None without a valid attachment."""
    attachment = sample.attachment
    if attachment is None or len(attachment) != IDENTITY_BYTES + NUMBER_BYTES:
        return b"", None
    found = attachment.to_bytes()
    return found[:IDENTITY_BYTES], int.from_bytes(found[IDENTITY_BYTES:], "little")
