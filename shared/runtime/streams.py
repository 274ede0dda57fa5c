"""Messages of a node: the keys of a topic in its cell, their publishers and readers, and their counters."""

from __future__ import annotations

import itertools
import math
import string
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, cast

import zenoh

from penumbra.shared.cell import description as cell
from penumbra.shared.contract.messages import BadMessage, Message
from penumbra.shared.contract.processes import PROCESSES
from penumbra.shared.contract.topics import Topic
from penumbra.shared.runtime.fitness import LOOK_S
from penumbra.shared.runtime.guard import Guard
from penumbra.shared.runtime.hang import Turn
from penumbra.shared.runtime.link import Link
from penumbra.shared.runtime.logs import Log
from penumbra.shared.runtime.reader import Inbox, Latest, Reader, Stream
from penumbra.shared.runtime.replicas import Replicas, Share
from penumbra.shared.runtime.sender import Sender
from penumbra.shared.runtime.tap import Tap
from penumbra.shared.runtime.traffic import Traffic

REPLICATED = {process.name for process in PROCESSES if process.beside}
"""Services whose replicas share streams, and take them over from each other."""
Handler = Callable[[Any, dict[str, str]], None]


class _Publisher(NamedTuple):
    """Cached objects for publishing on one key."""

    sender: Sender
    traffic: Traffic


class Streams:
    """The topics that a node reads and publishes.

    link: the session. replicas: ownership of streams. now_ns: the clock of stamps. turn: makes the monitor of a new handler.
    failed: called with the place and the exception of a handler that fails. received, published: counters by key.
    """

    def __init__(
        self,
        cell: cell.Cell,
        link: Link,
        replicas: Replicas,
        now_ns: Callable[[], int],
        turn: Callable[[str], Turn],
        failed: Callable[[str, Exception], None],
        log: Log,
    ):
        self._cell, self._link, self._replicas, self._now_ns = cell, link, replicas, now_ns
        self._turn, self._failed, self._log = turn, failed, log
        self.received: dict[str, Traffic] = {}
        self.published: dict[str, Traffic] = {}
        self._publishers: dict[tuple[str, ...], _Publisher] = {}
        self._latest: list[Latest[Any]] = []
        self._other_versions = itertools.count()

    def publish(self, topic: Topic, message: Message, names: dict[str, str]) -> None:
        """As `Node.publish`."""
        session = self._link.session
        if session is None:
            return
        identity = (topic.name, *names.values())
        found = self._publishers.get(identity)
        if found is None:
            found = self._publishers.setdefault(identity, self._declare_publisher(session, topic, names))
        try:
            found.sender.send(message)
        except zenoh.ZError:
            if self._link.session is not None:  # otherwise it was closed meanwhile
                raise
            return
        found.traffic.record(message.stamp_ns, self._now_ns())

    def subscribe(self, topic: Topic, handler: Handler, owned: Sequence[str], from_others: bool, names: dict[str, str]) -> None:
        """As `Node.subscribe`; owned: its `streams`."""
        inbox = self._inbox(topic, from_others, names, lambda keys: topic.depth * keys)
        if inbox is None:
            return
        turn = self._turn(f"reader of {inbox.expression}")
        if owned:
            traffic = [stream.traffic for stream in inbox.streams.values()]

            def read() -> Reader:
                return Reader(cast(zenoh.Session, self._link.session), inbox, handler, turn)

            self._link.declare(lambda _: self._replicas.share(Share(tuple(owned), traffic, read)))
        else:
            self._link.declare(lambda session: self._link.join(Reader(session, inbox, handler, turn).thread))

    def latest(self, topic: Topic, from_others: bool, names: dict[str, str]) -> Latest[Any]:
        """As `Node.latest`."""
        rate_hz = max((self.rate_hz(topic, found) for found in self.keys(topic, names).values()), default=0.0)
        inbox = self._inbox(topic, from_others, names, lambda keys: keys * (math.ceil(2 * LOOK_S * rate_hz) + topic.depth))
        if inbox is None:
            return Latest(Inbox(topic, "", 1, {}, self._now_ns, self._refused, self._failed))
        latest: Latest[Any] = Latest(inbox)
        self._latest.append(latest)
        self._link.declare(latest.open)
        return latest

    def tap(self, wanted: Sequence[Topic], most_bytes: int) -> Tap:
        """As `Node.tap`."""
        keys = [
            (topic, key, names, self._count(key, Traffic(math.inf, topic.publishers)))
            for topic in wanted
            for key, names in self.keys(topic, {}).items()
        ]
        tap = Tap(keys, most_bytes, self._now_ns)
        self._link.declare(tap.open)
        return tap

    def drain(self) -> None:
        """Processes the messages for `latest`, so that counters and ages are current."""
        for latest in self._latest:
            latest.drain()

    def look(self) -> None:
        """Processes the messages for `latest`, and updates the rates. One thread calls it, every LOOK_S."""
        self.drain()
        now_s = time.monotonic()
        for traffic in (*self.received.values(), *self.published.values()):
            traffic.rate.look(traffic.count, now_s)

    def _inbox(self, topic: Topic, from_others: bool, names: dict[str, str], depth: Callable[[int], int]) -> Inbox | None:
        """Settings of a reader of a topic, with counters of its own; None where the cell has no such part. depth: of the ring, as
        a function of the number of keys."""
        keys = self.keys(topic, names)
        if not keys:
            self._log.info("nothing to read: the cell has no such part", topic=topic.name)
            return None
        expression = next(iter(keys)) if len(keys) == 1 else topic.at(cell=self._cell.name, **names)
        is_expected = topic.is_expected(self._cell) and not from_others  # other publishers are optional
        stale_s = topic.stale_s if is_expected else math.inf
        is_exclusive = not REPLICATED & set(topic.publishers)
        streams = {
            key: Stream(
                found,
                self._count(key, Traffic(stale_s, topic.publishers, is_exclusive=is_exclusive)),
                Guard(self.rate_hz(topic, found)),
            )
            for key, found in keys.items()
        }
        inbox = Inbox(topic, expression, depth(len(keys)), streams, self._now_ns, self._refused, self._failed, from_others)
        if len(keys) > 1:
            self.received.setdefault(expression, inbox.unknown)
        return inbox

    def _declare_publisher(self, session: zenoh.Session, topic: Topic, names: dict[str, str]) -> _Publisher:
        missing = [name for name in _names(topic) if name not in names]
        if missing:
            raise ValueError(f"publishing {topic.name} needs {', '.join(f'{name}=' for name in missing)}")
        (key,) = self.keys(topic, names)
        return _Publisher(Sender(session, topic, key), self.published.setdefault(key, Traffic(topic.stale_s)))

    def rate_hz(self, topic: Topic, names: dict[str, str]) -> float:
        """Rate of a key's publisher: that of the table, or higher where it follows the cameras' rates."""
        rates = {name: camera.rate_hz for name, camera in self._cell.cameras.items()}
        if topic.by_camera:
            return max(topic.rate_hz, sum(rates.values()))
        return max(topic.rate_hz, rates.get(names.get("camera", ""), 0.0))

    def keys(self, topic: Topic, names: dict[str, str]) -> dict[str, dict[str, str]]:
        """As `Node.keys`."""
        values: list[Sequence[str]] = []
        for name in _names(topic):
            kind = cast(Literal["cameras", "robots", "pads", "targets"], f"{name}s")
            values.append([self._cell.one(kind, names[name])] if name in names else list(getattr(self._cell, kind)))
        unknown = names.keys() - set(_names(topic))
        if unknown:
            raise ValueError(f"topic {topic.name} has the names {', '.join(_names(topic))}, not {', '.join(sorted(unknown))}")
        combinations = (dict(zip(_names(topic), choice, strict=True)) for choice in itertools.product(*values))
        return {topic.at(cell=self._cell.name, **found): found for found in combinations}

    def _count(self, key: str, traffic: Traffic) -> Traffic:
        """Registers the counters of one more reader of a key."""
        readers = sum(1 for known in self.received if known.partition(" #")[0] == key)
        self.received[key if not readers else f"{key} #{readers + 1}"] = traffic
        return traffic

    def _refused(self, key: str, error: BadMessage) -> None:
        """Logs the first bad message of each kind on a key. A wrong version is logged once for all keys: another release
        publishes on many."""
        if error.kind == "version" and next(self._other_versions):
            return
        self._log.warning("message refused; more of this kind are only counted", key=key, kind=error.kind, why=str(error))


def _names(topic: Topic) -> tuple[str, ...]:
    """The {names} of a topic's key, without the cell."""
    return tuple(name for _, name, _, _ in string.Formatter().parse(topic.key) if name and name != "cell")
