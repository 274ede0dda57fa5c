"""The runtime that every service is built on: a Node wires functions to topics, and keeps count of what they do.

def start(node, options):                     # wires; nothing is received before the node runs
    node.subscribe(FRAME, on_frame, camera="front")
    node.every(0.005, publish_pose)

node.run()                                    # until SIGINT or SIGTERM
"""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import secrets
import signal
import socket
import string
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, cast

import psutil
import zenoh

from shared.cell import description as cell
from shared.contract import topics
from shared.contract.messages import VERSION, BadMessage, Message, encode
from shared.contract.topics import QoS, Topic
from shared.runtime import bus, health, logs
from shared.runtime.guard import Guard
from shared.runtime.hang import HANG_S, Turn
from shared.runtime.replicas import Clock, Pace, Replicas, Share

CLOSE_S = 0.8
"""Closing a session on a bad network may take much longer; a process that ends does not wait for that."""
FRAMES_UNDER_WAY = 3
"""Of each camera, in shared memory: one that is written and two that are read."""
QUERY_DEPTH = 32
NEWS_S = 0.2
"""Within this a session has heard which replicas there are."""
LOOK_S = 0.2
"""How often it is looked whether this replica is fit for its part."""
UNWATCHED_S = 5.0
"""After so long without a look what looks hangs itself, as where it wants a thread that has no memory to begin."""
WARM_UP_S = 2.0
"""How long a replica that joins others may listen before it takes its share."""


Answer = Callable[[dict[str, str], bytes], "bytes | tuple[bytes, str]"]


class Node:
    """One service instance: a session, its subscriptions, timers and queryables, their counters, and a log.

    Whatever is declared before `open` (which `run` calls) is declared on the bus when it opens; what is published before that is
    dropped, as it is where nobody listens. Use `with` where the node does not `run`.

    service: name of the service. cell: the cell. connection: how to reach the others.
    """

    def __init__(self, service: str, cell: cell.Cell, connection: bus.Connection = bus.Connection()):  # noqa: B008 (frozen)
        frames = sum(3 * camera.width * camera.height for camera in cell.cameras.values())
        pool_bytes = max(bus.POOL_BYTES, FRAMES_UNDER_WAY * frames)
        self.service, self.cell, self.connection = service, cell, replace(connection, service=service, pool_bytes=pool_bytes)
        self._needs_router = bus.mode(self.connection) == "client"  # refuses a bad configuration before anything else is done
        self.instance = f"{_safe(socket.gethostname())}-{os.getpid()}-{secrets.token_hex(2)}"
        self.log = logs.get(service, instance=self.instance)
        self.stopping = threading.Event()
        self.session: zenoh.Session | None = None
        self._pending: list[Callable[[], None]] = []
        self._threads: list[threading.Thread] = []
        self._received: dict[str, bus.Traffic] = {}
        self._published: dict[str, bus.Traffic] = {}
        self._publishers: dict[tuple[str, ...], tuple[zenoh.Publisher, bus.Traffic, zenoh.EntityGlobalId, itertools.count]] = {}
        self._faults: dict[str, int] = {}
        self._lately = health.Lately()
        self.report: dict[str, Callable[[], Any]] = {}
        self.worries: Callable[[], Sequence[str]] = list  # what the service itself suffers from, in words
        self._turns: list[Turn] = []
        self._hang = ""  # the handler that hangs, in words
        self._looked_s = math.inf  # when it was last looked whether this replica is fit
        self._slowness = ""  # that this process does not get its time, in words
        self._clock, self._pace = Clock(), Pace()
        self.is_warm: Callable[[], bool] = lambda: True  # whether it could go on with what another replica does
        self.replicas = Replicas(topics.alive(self.cell.name, service, self.instance))
        self._process = psutil.Process()
        self._cpu = 0.0
        self._started = time.monotonic()
        self._reachable = False
        self._other_versions = itertools.count()

    # ---- life

    def open(self, patience_s: float = float("inf")) -> Node:
        """Opens the session, waiting for the router, and declares what was asked for. Raises bus.BusError."""
        self.session = bus.open_session(self.connection, self.stopping, self._tell_waiting, patience_s)
        self._reachable = True
        if not self.is_warm():
            self.replicas.wait()
        session = self.session
        self._spawn(lambda: self.replicas.watch(session), "replicas")
        self.answer(topics.health(self.cell.name, self.service, self.instance), self._answer_health)
        for declare in self._pending:
            declare()
        self._pending.clear()
        self._come_alive()
        self._process.cpu_percent()
        self.every(1.0, self._keep_house)
        self._spawn(self._watch_fitness, "watch fitness")
        self.log.info("on the bus", at=", ".join(self.connection.listen) or self.connection.where)
        return self

    def _come_alive(self) -> None:
        """The last step: who is alive can be asked, is listening, and owns streams. Beside living replicas a service warms up
        first, for at most WARM_UP_S; alone, a cold one is better than none."""
        session = cast(zenoh.Session, self.session)

        def warm_up() -> None:
            began = time.monotonic()
            while not self.is_warm() and time.monotonic() - began < (WARM_UP_S if self.replicas.others else NEWS_S):
                if self.stopping.wait(0.02):
                    return
            self.replicas.join(session)

        if not self.is_warm():
            self._spawn(warm_up, "warm up")
        else:
            self.replicas.join(session)

    def run(self) -> None:
        """Opens, and serves until SIGINT or SIGTERM; a second signal ends the process at once. Raises bus.BusError."""
        with self.until_signal():
            try:
                self.open()
            except bus.BusError:
                if not self.stopping.is_set():  # else: told to stop before the router came
                    raise
            self.stopping.wait()

    @contextmanager
    def until_signal(self) -> Iterator[None]:
        """Within it SIGINT, SIGTERM and SIGHUP (a terminal that is closed) set `stopping`; at its end the node is closed."""
        numbers = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # else: run by nohup
            numbers.append(signal.SIGHUP)
        previous = {number: signal.signal(number, self._on_signal) for number in numbers}
        try:
            yield
        finally:
            self.close()
            for number, handler in previous.items():
                signal.signal(number, handler)

    def close(self) -> None:
        """Leaves the bus and ends the node's threads, within about CLOSE_S."""
        self.stopping.set()
        if self.session is None:
            return
        readers = self.replicas.leave()
        session, self.session = self.session, None
        deadline = time.monotonic() + CLOSE_S
        closing = threading.Thread(target=session.close, name="close", daemon=True)
        closing.start()
        for thread in (closing, *self._threads, *(reader.thread for reader in readers)):
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))

    def __enter__(self) -> Node:
        return self if self.session else self.open()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _on_signal(self, number: int, _: Any) -> None:
        if self.stopping.is_set():
            os._exit(128 + number)
        self.stopping.set()

    # ---- messages

    def now_ns(self) -> int:
        """Nanoseconds since the epoch."""
        return time.time_ns()

    def publish(self, topic: Topic, message: Message, **names: str) -> None:
        """Sends a message. names: every {name} of the topic's key, e.g. camera="front". Raises CellError for a name that the cell
        does not have, BadMessage for an array of the wrong dtype or shape."""
        session = self.session
        if session is None:
            return
        identity = (topic.name, *names.values())
        found = self._publishers.get(identity)
        if found is None:
            found = self._publishers.setdefault(identity, self._declare_publisher(session, topic, names))
        publisher, traffic, source, numbers = found
        payload = encode(message)
        try:
            publisher.put(payload, source_info=zenoh.SourceInfo(source, next(numbers) & 0xFFFFFFFF))
        except zenoh.ZError:
            if self.session is not None:  # else: closed meanwhile
                raise
            return
        traffic.took(message.stamp_ns, self.now_ns())

    def _declare_publisher(self, session: zenoh.Session, topic: Topic, names: dict[str, str]) -> Any:
        missing = [name for name in _names(topic) if name not in names]
        if missing:
            raise ValueError(f"publishing {topic.name} needs {', '.join(f'{name}=' for name in missing)}")
        (key,) = self.keys(topic, names)
        publisher = session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.BLOCK if topic.qos is QoS.NEVER_DROP else zenoh.CongestionControl.DROP,
            priority=getattr(zenoh.Priority, topic.priority.value),
        )
        traffic = self._published.setdefault(key, bus.Traffic(topic.stale_s))
        return publisher, traffic, publisher.id, itertools.count()

    def subscribe(
        self,
        topic: Topic,
        handler: Callable[[Any, dict[str, str]], None],
        streams: Sequence[str] = (),
        from_others: bool = False,
        **names: str,
    ) -> None:
        """Calls `handler(message, names)` for every good message, in a thread of this subscription.

        names: fix some of the topic's {names}; the others take every value that the cell has. The handler is told them all, and
        as `publisher` who sent the message (empty where nobody says), which tells two processes on one key apart. While the
        handler is busy the newest `topic.depth` messages per key are kept. Bad messages are counted and logged once per kind; so
        are exceptions of the handler. Raises CellError for a name that the cell does not have.

        streams: the subscription is there only while this replica owns one of these streams (see `owns`); so the replicas of a
        service divide the messages, and none receives what another one works on. from_others: leaves out what this node
        publishes itself.
        """
        keys = self.keys(topic, names)
        if not keys:
            self.log.info("nothing to read: the cell has no such part", topic=topic.name)
            return
        expression = next(iter(keys)) if len(keys) == 1 else topic.at(cell=self.cell.name, **names)
        stale_s = math.inf if from_others else topic.stale_s  # there need not be others
        table = {key: (found, self._count(key, stale_s), Guard(self._rate_hz(topic, found))) for key, found in keys.items()}
        strangers = (
            bus.Traffic(float("inf")) if len(keys) == 1 else self._received.setdefault(expression, bus.Traffic(float("inf")))
        )

        turn = self._turn(f"reader of {expression}")

        def read() -> bus.Reader:
            return bus.Reader(
                cast(zenoh.Session, self.session),
                expression,
                topic.depth * len(keys),
                topic,
                table,
                strangers,
                handler,
                self.now_ns,
                self._refused,
                self.fault,
                from_others,
                turn,
            )

        if streams:
            share = Share(tuple(streams), [traffic for _, traffic, _ in table.values()], read)
            self._declare(lambda: self.replicas.share(share))
        else:
            self._declare(lambda: self._threads.append(read().thread))

    def _turn(self, what: str, patience_s: float = HANG_S) -> Turn:
        self._turns.append(turn := Turn(what, patience_s))
        return turn

    def _rate_hz(self, topic: Topic, names: dict[str, str]) -> float:
        """How often a key's publisher sends: as the table says, but for what follows the cameras' own rates."""
        rates = {name: camera.rate_hz for name, camera in self.cell.cameras.items()}
        if topic.by_camera:
            return max(topic.rate_hz, sum(rates.values()))
        return max(topic.rate_hz, rates.get(names.get("camera", ""), 0.0))

    def _count(self, key: str, stale_s: float) -> bus.Traffic:
        """Counters for one more reader of a key."""
        readers = sum(1 for known in self._received if known.partition(" #")[0] == key)
        traffic = bus.Traffic(stale_s)
        self._received[key if not readers else f"{key} #{readers + 1}"] = traffic
        return traffic

    def keys(self, topic: Topic, names: dict[str, str]) -> dict[str, dict[str, str]]:
        """Every concrete key of a topic in this cell with its names, some of them fixed; none where the cell has no such part.
        Raises CellError for a name that the cell does not have."""
        values: list[Sequence[str]] = []
        for name in _names(topic):
            kind = cast(Literal["cameras", "robots", "pads", "targets"], f"{name}s")
            values.append([self.cell.one(kind, names[name])] if name in names else list(getattr(self.cell, kind)))
        unknown = names.keys() - set(_names(topic))
        if unknown:
            raise ValueError(f"topic {topic.name} has the names {', '.join(_names(topic))}, not {', '.join(sorted(unknown))}")
        combinations = (dict(zip(_names(topic), choice, strict=True)) for choice in itertools.product(*values))
        return {topic.at(cell=self.cell.name, **found): found for found in combinations}

    # ---- queries

    def answer(self, key: str, function: Answer) -> None:
        """Answers queries on `key` with `function(parameters, payload)`: bytes, or bytes and their encoding. A ValueError becomes
        an error reply with its text. While it warms up, or is unfit, beside others, it leaves the answers to them."""

        def serve(queryable: Any) -> None:
            while True:
                try:
                    query = queryable.recv()
                except zenoh.ZError:
                    return
                with query:
                    self._reply(key, query, function)

        def declare() -> None:
            queryable = cast(zenoh.Session, self.session).declare_queryable(key, zenoh.handlers.RingChannel(QUERY_DEPTH))
            self._spawn(lambda: serve(queryable), f"answer {key}")

        self._declare(declare)

    def _reply(self, key: str, query: zenoh.Query, function: Answer) -> None:
        parameters = dict(cast(Any, query.parameters))
        try:
            if not self.replicas.has_joined and self.replicas.others and function != self._answer_health:
                raise ValueError(f"{self.service} {self.instance} has no part now: ask the others")
            result = function(parameters, query.payload.to_bytes() if query.payload is not None else b"")
        except ValueError as error:
            query.reply_err(str(error).encode())
        except Exception as error:
            self.fault(f"answer on {key}", error)
            query.reply_err(f"{self.service} failed: {type(error).__name__}: {error}".encode())
        else:
            payload, encoding = result if isinstance(result, tuple) else (result, None)
            query.reply(key, payload, encoding=encoding)

    def query(self, key: str, parameters: str = "", payload: bytes | None = None, timeout_s: float = 1.0) -> list[bytes]:
        """The payloads of all answers; none where nobody answers. Raises bus.Refused where the only answers are errors."""
        return bus.ask(self.session, key, parameters, payload, timeout_s) if self.session else []

    # ---- time, replicas, health

    def every(self, period_s: float, function: Callable[[], None], patience_s: float = HANG_S) -> None:
        """Calls `function` every `period_s` in a thread of its own; turns that are missed are left out, not made up for. A turn
        hangs that takes `patience_s` longer than usual: infinite for one that returns when the node stops."""
        what = f"timer {getattr(getattr(function, 'func', function), '__name__', '')} of {period_s} s"
        turn = self._turn(what, patience_s)

        def loop() -> None:
            due = time.monotonic()
            while not self.stopping.wait(max(0.0, due - time.monotonic())):
                try:
                    with turn:
                        function()
                except Exception as error:
                    self.fault(what, error)
                due = max(due + period_s, time.monotonic() - period_s)

        self._declare(lambda: self._spawn(loop, f"every {period_s} s"))

    def _watch_fitness(self) -> None:
        """While a handler hangs, this process stands still or its clock is off, it has no part where others live: its streams are
        theirs until it is fit again."""
        self._looked_s, has_withdrawn = time.monotonic(), False
        while not self.stopping.wait(LOOK_S):
            now_s = time.monotonic()
            late_s, self._looked_s = now_s - self._looked_s - LOOK_S, now_s
            self._slowness = self._pace.judge(late_s, LOOK_S)
            if late_s < LOOK_S:  # else the whole process stood still
                longest_s, what = max(((turn.hangs_s(now_s), turn.what) for turn in self._turns), default=(0.0, ""))
                self._hang = f"{what} hangs for {longest_s:.0f} s" if longest_s else ""
            unfit = self._hang or self._slowness or self._clock.judge(self._received.values(), now_s)
            try:
                if unfit and self.replicas.has_joined and self.replicas.others:
                    self.log.warning("unfit: the other replicas take over", why=unfit)
                    has_withdrawn = True
                    self.replicas.withdraw()
                elif has_withdrawn and not unfit:
                    self.log.info("fit again")
                    has_withdrawn = False
                    self._come_alive()
            except zenoh.ZError:  # the session was closed
                return

    def owns(self, stream: str) -> bool:
        """Whether this replica is the one of the living replicas of its service that handles `stream`. While the news of a
        replica's coming or going is under way two may own a stream, or none."""
        return self.replicas.owns(stream)

    def rank(self, stream: str) -> float:
        """How many living replicas are before this one to handle `stream`; infinity where this one has no part now."""
        return self.replicas.rank(stream)

    def health(self) -> dict[str, Any]:
        """What this instance is and how it fares, as JSON: its status and the reasons for it (`shared.runtime.health`), CPU in
        cores, memory in MB, counters of every topic, and what the service tells of itself in `report`: JSON by name, from a
        function each."""
        now = self.now_ns()
        status, reasons = health.judge(self._away(), self._received, self._look(), self._suffers(), now)
        return {
            "service": self.service,
            "instance": self.instance,
            "status": status,
            "reasons": reasons,
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "cell": self.cell.name,
            "wire_version": VERSION,
            "ready": self.replicas.has_joined,
            "hangs": self._hangs(),
            "uptime_s": round(time.monotonic() - self._started, 1),
            "cpu": round(self._cpu, 3),
            "memory_mb": round(self._process.memory_info().rss / 1e6, 1),
            "replicas": len(self.replicas),
            "topics": {key: traffic.report(now) for key, traffic in sorted(self._received.items())},
            "published": {key: traffic.report(now) for key, traffic in sorted(self._published.items())},
            "stale": sorted(key for key, traffic in self._received.items() if traffic.is_stale(now)),
            "faults": dict(self._faults),
            **({"report": {name: tell() for name, tell in self.report.items()}} if self.report else {}),
        }

    def _answer_health(self, parameters: dict[str, str], payload: bytes) -> bytes:
        return json.dumps(self.health()).encode()

    def _suffers(self) -> list[str]:
        return [*filter(None, [self._hangs(), self._slowness, self._clock.fault]), *self.worries()]

    def _hangs(self) -> str:
        """What hangs, in words; empty where nothing does."""
        is_watched = time.monotonic() - self._looked_s < UNWATCHED_S
        return self._hang if is_watched else f"nobody has looked after this process for {UNWATCHED_S:g} s"

    def _look(self) -> Counter[tuple[str, str]]:
        return self._lately.look(health.counts(self._received, self._faults), time.monotonic())

    def _away(self) -> str:
        """Why the others cannot be reached; empty where they can."""
        if self.session is None:
            return "not on the bus"
        return "" if self._reachable else f"no router at {self.connection.where}"

    def fault(self, where: str, error: Exception) -> None:
        """Counts an exception; the first of its kind and place is logged with its trace. Raises a MemoryError again: what is out
        of memory does nothing well any more, and ends to begin anew (`services.run.serve`)."""
        if isinstance(error, MemoryError):
            raise error
        frames = traceback.extract_tb(error.__traceback__)
        place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"
        kind = f"{type(error).__name__} at {place}"
        self._faults[kind] = self._faults.get(kind, 0) + 1
        if self._faults[kind] == 1:
            self.log.error(f"{type(error).__name__}: {error}", where=where, at=place, exc_info=error)

    def _refused(self, key: str, error: BadMessage) -> None:
        """Told of the first bad message of each kind on a key. Another release speaks on many keys at once: it is told once."""
        if error.kind == "version" and next(self._other_versions):
            return
        self.log.warning("message refused; more of this kind are only counted", key=key, kind=error.kind, why=str(error))

    def _tell_waiting(self) -> None:
        self.log.warning(f"waiting for the router {self.connection.whereabouts}: start `penumbra router` or `penumbra up`")

    def _keep_house(self) -> None:
        """Once a second: CPU, what should not happen, the state of the link, and the heartbeat file that a container's health
        check reads: the status and its reasons, in words."""
        self._cpu = self._process.cpu_percent() / 100
        grown = self._look()
        session = self.session
        if session is None:
            return
        reachable = not self._needs_router or bool(session.info.routers_zid())
        if reachable != self._reachable:
            self._reachable = reachable
            if reachable:
                self.log.info("the router is back")
            else:
                self._tell_waiting()
        heartbeat = os.environ.get("PENUMBRA_HEARTBEAT")
        if heartbeat:
            status, reasons = health.judge(self._away(), self._received, grown, self._suffers(), self.now_ns())
            fresh = Path(f"{heartbeat}.new")
            fresh.write_text(": ".join([status, "; ".join(reasons)]).removesuffix(": ") + "\n")
            fresh.replace(heartbeat)  # nobody reads half of it

    def _declare(self, declare: Callable[[], None]) -> None:
        if self.session is None:
            self._pending.append(declare)
        else:
            declare()

    def _spawn(self, function: Callable[[], None], name: str) -> None:
        thread = threading.Thread(target=function, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()


def _names(topic: Topic) -> tuple[str, ...]:
    """The {names} of a topic's key, without the cell's."""
    return tuple(name for _, name, _, _ in string.Formatter().parse(topic.key) if name and name != "cell")


def _safe(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "-", text)
