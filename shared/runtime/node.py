"""Runtime of every service: a Node connects functions to topics, and counts messages and faults.

def start(node, options):                     # connects; nothing is received before the node runs
    node.subscribe(FRAME, on_frame, camera="front")
    node.every(0.005, publish_pose)

node.run()                                    # until SIGINT or SIGTERM

Threads. Each subscription calls its handler in a thread of its own, one message after another: two handlers of one service run at
the same time, and so do timers (`every`), answers (`answer`) and the functions of the health report (`add_report`,
`add_reasons`). Data that two of them share either have a lock, or one of them owns the data and the others only read them as a
whole (an attribute or a dictionary's value that is replaced, never a container that changes while another thread iterates over
it). `latest` may be read from any thread.
"""

from __future__ import annotations

import atexit
import json
import os
import re
import secrets
import signal
import socket
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import psutil
import zenoh

from penumbra.shared.cell import description as cell
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import VERSION, Message
from penumbra.shared.contract.report import Report
from penumbra.shared.contract.topics import Topic
from penumbra.shared.runtime import bus, health, logs
from penumbra.shared.runtime.fitness import Fitness
from penumbra.shared.runtime.hang import HANG_S
from penumbra.shared.runtime.link import CLOSE_S, Link
from penumbra.shared.runtime.logs import Log
from penumbra.shared.runtime.progress import Progress, Waiting
from penumbra.shared.runtime.queries import Answer, Queries
from penumbra.shared.runtime.reader import Latest
from penumbra.shared.runtime.replicas import Replicas
from penumbra.shared.runtime.slow_links import SlowLinks
from penumbra.shared.runtime.streams import Handler, Streams
from penumbra.shared.runtime.tap import Tap

__all__ = ["CLOSE_S", "LatestMessages", "Node", "ServiceNode"]

FRAMES_UNDER_WAY = 3
"""Number of frames of each camera in shared memory: one that is written and two that are read."""
NEWS_S = 0.2
"""Maximum time [s] that a session needs to learn of the living replicas."""
WARM_UP_S = 2.0
"""Maximum time [s] for which a replica that joins others only receives, before it takes its share."""
ASK_S = 0.5
"""Maximum wait [s] for the progress of the publishers of a missing input."""


class LatestMessages(Protocol):
    """The newest message of each key of a topic."""

    def get(self, **names: str) -> Any:
        """The newest message of the key with these names; None before the first."""

    def drain(self) -> int:
        """Processes received messages; returns the number of good messages so far."""


class ServiceNode(Protocol):
    """Interface for the `start` of a service, provided by the node on the bus and by that of a replay."""

    @property
    def cell(self) -> cell.Cell: ...
    @property
    def log(self) -> Log: ...
    def now_ns(self) -> int: ...
    def publish(self, topic: Topic, message: Message, **names: str) -> None: ...
    def subscribe(
        self, topic: Topic, handler: Handler, streams: Sequence[str] = (), from_others: bool = False, **names: str
    ) -> None: ...
    def latest(self, topic: Topic, from_others: bool = False, **names: str) -> LatestMessages: ...
    def answer(self, key: str, function: Answer) -> None: ...
    def every(self, period_s: float, function: Callable[[], None], patience_s: float = HANG_S) -> None: ...
    def owns(self, stream: str) -> bool: ...
    def rank(self, stream: str) -> float: ...
    def progress(self, what: str, done: int, total: int) -> None: ...
    def add_report(self, name: str, function: Callable[[], Any]) -> None: ...
    def add_reasons(self, function: Callable[[], Sequence[str]]) -> None: ...
    def warm_when(self, function: Callable[[], bool]) -> None: ...


class Node:
    """One service instance: a session, its subscriptions, timers and queryables, their counters, and a log.

    Declarations before `open` (which `run` calls) take effect when it opens. Messages published before that are dropped, as they
    are without a subscriber. Use `with` where the node does not `run`.

    service: name of the service. cell: the cell. connection: how to reach the others.
    """

    def __init__(self, service: str, cell: cell.Cell, connection: bus.Connection = bus.Connection()):  # noqa: B008 (frozen)
        frames = sum(3 * camera.width * camera.height for camera in cell.cameras.values())
        pool_bytes = max(bus.POOL_BYTES, FRAMES_UNDER_WAY * frames)
        self.service, self.cell = service, cell
        self.instance = f"{_safe(socket.gethostname())}-{os.getpid()}-{secrets.token_hex(2)}"
        self.log = logs.get(service, instance=self.instance)
        self.stopping = threading.Event()
        self._link = Link(replace(connection, service=service, pool_bytes=pool_bytes), self.stopping, self.log)
        self._is_open = False
        self.replicas = Replicas(*(key(self.cell.name, service, self.instance) for key in (topics.alive, topics.beat)))
        self._fitness = Fitness(self.replicas, self.log)
        self._streams = Streams(cell, self._link, self.replicas, lambda: self.now_ns(), self._fitness.turn, self.fault, self.log)
        self._queries = Queries(service, self._link, self.fault)
        self._progress = Progress(self.log)
        self._is_announced = self._is_early = False
        self._announcing = threading.Lock()
        self._waiting = Waiting(self._ask_health)
        self._faults: dict[str, int] = {}
        self._lately = health.Lately()
        self._reports: dict[str, Callable[[], Any]] = {}
        self._reasons: list[Callable[[], Sequence[str]]] = []
        self._warm: list[Callable[[], bool]] = []
        self._when_closed: list[Callable[[], None]] = []
        self._process = psutil.Process()
        self._cpu = 0.0
        self._started = time.monotonic()

    @property
    def connection(self) -> bus.Connection:
        """How the others are reached."""
        return self._link.connection

    @property
    def session(self) -> zenoh.Session | None:
        """The Zenoh session, None before it is open and after the node is closed."""
        return self._link.session

    # ---- life

    def open(self, patience_s: float = float("inf")) -> Node:
        """Opens the session, waiting for the router, and makes the deferred declarations. Raises bus.BusError."""
        session = self._link.open(patience_s)
        self._is_open = True
        if not self.is_warm():
            self.replicas.wait()
        self._link.spawn(lambda: self.replicas.watch(session), "replicas")
        self._link.spawn(lambda: self.replicas.beat(session, self.stopping), "beat")
        self._announce(session)
        self._link.declare_all()
        self._come_alive()
        self._process.cpu_percent()
        self.every(1.0, self._update, HANG_S + len(topics.TOPICS) * ASK_S)
        self._link.spawn(self._watch_fitness, "watch fitness")
        self.log.info("on the bus", at=", ".join(self.connection.listen) or self.connection.where)
        return self

    def _announce(self, session: zenoh.Session) -> None:
        """Starts answering the health query."""
        with self._announcing:
            if self._is_announced:
                return
            self._is_announced = True
            self._queries.serve(session, topics.health(self.cell.name, self.service, self.instance), self._answer_health)

    def _announce_early(self) -> None:
        """Reports the progress of a process whose node is not open yet."""
        try:
            if not self.stopping.is_set():
                self._announce(self._link.open(float("inf")))
        except bus.BusError:  # `open` raises it again
            return

    def _watch_fitness(self) -> None:
        received = self._streams.received
        self._fitness.watch(self.stopping, lambda: list(received.values()), self._come_alive, self._streams.look)

    def _come_alive(self) -> None:
        """Last step of opening: the replica joins the living ones, which answer queries, subscribe, and own streams. If there are
        other replicas, it warms up first, for at most WARM_UP_S; alone, it starts cold."""
        session = self.session
        if session is None:
            return

        def warm_up() -> None:
            began = time.monotonic()
            while not self.is_warm() and time.monotonic() - began < (WARM_UP_S if self.replicas.others else NEWS_S):
                if self.stopping.wait(0.02):
                    return
            try:
                self.replicas.join(session)
            except zenoh.ZError:  # the session was closed just now
                if not self.stopping.is_set():
                    raise

        if not self.is_warm():
            self._link.spawn(warm_up, "warm up")
        else:
            self.replicas.join(session)

    def run(self) -> None:
        """Opens, and serves until SIGINT or SIGTERM. A second signal ends the process at once. Raises bus.BusError."""
        with self.until_signal():
            try:
                self.open()
            except bus.BusError:
                if not self.stopping.is_set():  # otherwise it was stopped while it waited for the router
                    raise
            self.stopping.wait()

    @contextmanager
    def until_signal(self) -> Iterator[None]:
        """Context in which SIGINT, SIGTERM and SIGHUP (a terminal that is closed) set `stopping`. At its end the node is
        closed."""
        numbers = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # otherwise it runs under nohup
            numbers.append(signal.SIGHUP)
        previous = {number: signal.signal(number, self._on_signal) for number in numbers}
        try:
            yield
        finally:
            self.close()
            for number, handler in previous.items():
                signal.signal(number, handler)

    def close(self) -> None:
        """Leaves the bus and ends the node's threads, within about CLOSE_S; then calls the functions of `when_closed`."""
        self.stopping.set()
        self._link.close(reader.thread for reader in self.replicas.leave())
        while self._when_closed:
            self._when_closed.pop()()

    def when_closed(self, function: Callable[[], None]) -> None:
        """Calls `function` after the node has left the bus and before the process ends, for work that must be completed."""
        self._when_closed.append(function)

    def __enter__(self) -> Node:
        return self if self._is_open else self.open()

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
        self._streams.publish(topic, message, names)

    def subscribe(
        self, topic: Topic, handler: Handler, streams: Sequence[str] = (), from_others: bool = False, **names: str
    ) -> None:
        """Calls `handler(message, names)` for every good message, in a thread of this subscription.

        names: fix some of the topic's {names}; the others take every value in the cell. The handler receives all names, and as
        `publisher` the sender's identity (empty where it has none), which distinguishes two processes on one key. While the
        handler is busy the newest `topic.depth` messages per key are kept. Bad messages are counted and logged once per kind; so
        are exceptions of the handler. Raises CellError for a name that the cell does not have.

        streams: the subscription is active only while this replica owns one of these streams (see `owns`). So the replicas of a
        service divide the messages, and none receives those that another one processes. from_others: excludes messages that this
        node publishes.
        """
        self._streams.subscribe(topic, handler, streams, from_others, names)

    def latest(self, topic: Topic, from_others: bool = False, **names: str) -> Latest[Any]:
        """The newest message of each key, for a service that reads less often than messages arrive. Only messages that are read
        are decoded, and no thread wakes up on arrival. They are guarded, counted and reported as missing like those of
        `subscribe`, except that their delay is unknown. names, from_others: as in `subscribe`."""
        return self._streams.latest(topic, from_others, names)

    def tap(self, wanted: Sequence[Topic], most_bytes: int) -> Tap:
        """All messages of these topics in this cell, as unchecked bytes, kept until they are taken. most_bytes: maximum size of
        the waiting messages; further messages are lost, and counted."""
        return self._streams.tap(wanted, most_bytes)

    def keys(self, topic: Topic, names: dict[str, str]) -> dict[str, dict[str, str]]:
        """All concrete keys of a topic in this cell with their names, some of them fixed; empty where the cell has no such part.
        Raises CellError for a name that the cell does not have."""
        return self._streams.keys(topic, names)

    # ---- queries

    def answer(self, key: str, function: Answer) -> None:
        """Answers queries on `key` with `function(parameters, payload)`, which returns bytes, or bytes and their encoding. A
        ValueError becomes an error reply with its text. A replica that warms up or is unfit leaves the answers to the others."""

        def answer(parameters: dict[str, str], payload: bytes) -> bytes | tuple[bytes, str]:
            if not self.replicas.has_joined and self.replicas.others:
                raise ValueError(f"{self.service} {self.instance} serves nothing now; ask another replica")
            return function(parameters, payload)

        self._queries.answer(key, answer)

    def query(self, key: str, parameters: str = "", payload: bytes | None = None, timeout_s: float = 1.0) -> list[bytes]:
        """Payloads of all answers, possibly none. Raises bus.Refused where the only answers are errors."""
        return self._queries.ask(key, parameters, payload, timeout_s)

    # ---- time and replicas

    def every(self, period_s: float, function: Callable[[], None], patience_s: float = HANG_S) -> None:
        """Calls `function` every `period_s` in a thread of its own; missed calls are skipped. A call hangs if it takes
        `patience_s` longer than usual. Give infinity for a function that returns only when the node stops."""
        what = f"timer {getattr(getattr(function, 'func', function), '__name__', '')} of {period_s} s"
        turn = self._fitness.turn(what, patience_s)

        def loop() -> None:
            due = time.monotonic()
            while not self.stopping.wait(max(0.0, due - time.monotonic())):
                try:
                    with turn:
                        function()
                except Exception as error:
                    self.fault(what, error)
                due = max(due + period_s, time.monotonic() - period_s)

        self._link.declare(lambda _: self._link.spawn(loop, f"every {period_s} s"))

    def owns(self, stream: str) -> bool:
        """Whether this replica, among the living ones of its service, handles `stream`. For a short time after a replica comes or
        goes, two or none may own a stream."""
        return self.replicas.owns(stream)

    def rank(self, stream: str) -> float:
        """Number of living replicas that precede this one for `stream`; infinity while this one takes no part."""
        return self.replicas.rank(stream)

    # ---- the health report

    def progress(self, what: str, done: int, total: int) -> None:
        """Reports the progress of the preparation of the service, as in `progress("compiling", 12, 40)`; the last step ends it.

        Until then the status is `starting` with the reason `compiling 12 of 40`, on the bus also before the node is open.
        Services that wait for this one have the status `starting` too. The log has a line every 2 s.
        """
        self._progress.set(what, done, total)
        if not self._is_early and not self._is_open:
            self._is_early = True
            atexit.register(self.close)  # also where `start` fails: Zenoh aborts a process that ends with an open session
            self._link.spawn(self._announce_early, "announce")

    def add_report(self, name: str, function: Callable[[], Any]) -> None:
        """Adds the result of `function`, as JSON, to the health report under `report` and this name."""
        self._reports[name] = function

    def add_reasons(self, function: Callable[[], Sequence[str]]) -> None:
        """Adds reasons, as texts from `function`: while there are any, the status is `degraded`."""
        self._reasons.append(function)

    def warm_when(self, function: Callable[[], bool]) -> None:
        """Lets a replica join the others only when `function` returns true: that it could continue another one's work."""
        self._warm.append(function)

    def is_warm(self) -> bool:
        """Whether this replica could continue another one's work."""
        return all(function() for function in self._warm)

    def thin_out(self, slow: SlowLinks) -> None:
        """Limits the traffic of a router over some of its links. Call before the node is open."""
        self._link.connection = replace(self.connection, slow=slow)

    def announce(self) -> None:
        """Makes a router answer searches on the network. Call before the node is open."""
        self._link.connection = replace(self.connection, is_announced=True)

    def report(self) -> Report:
        """The health report of this instance."""
        self._streams.drain()
        now_ns = self.now_ns()
        status, reasons = self._judge(self._look(), now_ns)
        received, published = self._streams.received, self._streams.published
        return Report(
            service=self.service,
            instance=self.instance,
            status=status,
            reasons=reasons,
            host=socket.gethostname(),
            pid=os.getpid(),
            cell=self.cell.name,
            wire_version=VERSION,
            ready=self.replicas.has_joined,
            hangs=self._fitness.hangs(),
            progress=str(self._progress),
            uptime_s=round(time.monotonic() - self._started, 1),
            cpu=round(self._cpu, 3),
            memory_mb=round(self._process.memory_info().rss / 1e6, 1),
            replicas=len(self.replicas),
            topics={key: traffic.report(now_ns) for key, traffic in sorted(received.items())},
            published={key: traffic.report(now_ns) for key, traffic in sorted(published.items())},
            stale=sorted(key for key, traffic in received.items() if traffic.is_stale(now_ns)),
            faults=dict(self._faults),
            report={name: function() for name, function in list(self._reports.items())},
        )

    def health(self) -> dict[str, Any]:
        """The report as JSON objects."""
        return self.report().as_json()

    def fault(self, where: str, error: Exception) -> None:
        """Counts an exception; the first of its kind and place is logged with its trace. Raises a MemoryError again: a process
        that is out of memory ends and is restarted (`services.run.serve`)."""
        if isinstance(error, MemoryError):
            raise error
        frames = traceback.extract_tb(error.__traceback__)
        place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"
        kind = f"{type(error).__name__} at {place}"
        self._faults[kind] = self._faults.get(kind, 0) + 1
        if self._faults[kind] == 1:
            self.log.error(f"{type(error).__name__}: {error}", where=where, at=place, exc_info=error)

    def _ask_health(self, service: str) -> list[bytes]:
        """Health reports of another service; empty for this service, because it would wait for itself."""
        return [] if service == self.service else self.query(topics.health(self.cell.name, service), timeout_s=ASK_S)

    def _answer_health(self, parameters: dict[str, str], payload: bytes) -> bytes:
        return json.dumps(self.health()).encode()

    def _judge(self, grown: Counter[tuple[str, str]], now_ns: int) -> tuple[str, list[str]]:
        """Status and reasons; grown: counters that grew lately."""
        if not self._is_open and self.session is not None:  # on the bus before `open`: nothing is read yet
            return health.judge("", {}, grown, [], now_ns, str(self._progress) or "not ready yet")
        own = [*self._fitness.faults(), *(reason for reasons in self._reasons for reason in reasons())]
        progress = str(self._progress)
        return health.judge(self._link.away(), self._streams.received, grown, own, now_ns, progress, self._waiting.why)

    def _look(self) -> Counter[tuple[str, str]]:
        return self._lately.look(health.counts(self._streams.received, self._faults), time.monotonic())

    def _update(self) -> None:
        """Updates CPU, the counters of faults and the state of the link once a second. It also writes the heartbeat file for a
        container's health check: the status and its reasons as text."""
        self._cpu = self._process.cpu_percent() / 100
        grown = self._look()
        if self.session is None:
            return
        self._link.look()
        self._waiting.look(list(self._streams.received.values()), self.now_ns())
        heartbeat = os.environ.get("PENUMBRA_HEARTBEAT")
        if heartbeat:
            self._streams.drain()
            status, reasons = self._judge(grown, self.now_ns())
            fresh = Path(f"{heartbeat}.new")
            fresh.write_text(": ".join([status, "; ".join(reasons)]).removesuffix(": ") + "\n")
            fresh.replace(heartbeat)  # atomically: it is never read half written


def _safe(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "-", text)
