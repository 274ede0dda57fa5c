"""The bus: one Zenoh session per process, readers that never stall one another, and what they count.

Sensor streams are read from a ring per subscription by a thread of its own. A Python callback or the default channel would let
one slow reader hold up every other subscriber of the session.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import math
import os
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from shared.contract import access
from shared.contract.messages import BadMessage, Message, decode
from shared.contract.topics import TOPICS, Topic
from shared.runtime.guard import Guard
from shared.runtime.hang import Turn
from shared.runtime.slow_links import SlowLinks

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
SECURE_ENDPOINT = "tls/127.0.0.1:7447"
SECURE_PROTOCOLS = ("tls",)
PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream", "unixpipe", "serial", "vsock")
POOL_BYTES = 4 << 20
"""Of shared memory, at least: four frames of a small camera."""
SHARED_BYTES = 100_000
"""Frames go by shared memory; what is smaller takes no longer through a socket, and leaves its readers nothing behind where its
publisher dies: they keep its pool for as long as they live."""
KEPT_BYTES, SPARE_BYTES = 16 << 20, 32 << 20
"""Blocks of memory up to the first size come from what the process has, and stay there; beyond the second it gives some back."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Of malloc.h."""
RATE_WINDOW_S = 3.0
ATTEMPT_MS = 500
"""How long one attempt to reach the router may block inside Zenoh, where no signal is heard."""


class BusError(RuntimeError):
    """The bus cannot be used as asked; the text says what to do."""


class Refused(ValueError):
    """A query was answered with an error; the text is the answerer's."""


@dataclass(frozen=True)
class Connection:
    """How a session meets the others. `mode`: client (behind a router), peer or router; `connect`, `listen`: endpoints such as
    tcp/127.0.0.1:7447; `config`: a Zenoh JSON5 file, whose settings stand unless `connect` or `listen` say otherwise; `secure`: a
    folder of `penumbra certs`, with which nothing goes unencrypted and nobody without a certificate takes part; `service`: who
    this is, and so whose certificate it shows; `slow`: a router's links that carry little; `pool_bytes`: of shared memory, by
    which what is large goes to processes of the same host. Readers keep the pool of a publisher that is gone for as long as they
    live, so it is no larger than it must be."""

    mode: str | None = None
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config: Path | None = None
    secure: Path | None = None
    service: str = access.VIEWER
    slow: SlowLinks | None = None
    pool_bytes: int = POOL_BYTES

    @property
    def default(self) -> str:
        """The endpoint where none is given."""
        return SECURE_ENDPOINT if self.secure else DEFAULT_ENDPOINT

    @property
    def where(self) -> str:
        """The endpoints in words."""
        return ", ".join(self.connect) or (f"the endpoints of {self.config}" if self.config else self.default)

    @property
    def whereabouts(self) -> str:
        """Where a router is looked for, and what it must have."""
        return f"at {self.where}" + (f" with a certificate of the same CA as in {self.secure}" if self.secure else "")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The Zenoh flags that every process takes."""
    group = parser.add_argument_group("bus")
    group.add_argument("-m", "--mode", choices=("client", "peer", "router"), help="Zenoh mode (default: client; router: router)")
    group.add_argument("-e", "--connect", action="append", default=[], metavar="ENDPOINT",
                       help=f"router to reach; may be repeated (default: $PENUMBRA_CONNECT or {DEFAULT_ENDPOINT}, "
                       f"with --secure {SECURE_ENDPOINT})")  # fmt: skip
    group.add_argument("-l", "--listen", action="append", default=[], metavar="ENDPOINT", help="endpoint to listen on")
    group.add_argument("-c", "--config", type=Path, metavar="FILE", help="Zenoh configuration (JSON5)")
    add_secure(group)


def add_secure(group: argparse._ActionsContainer) -> None:
    """The one switch between a bus for this machine and one for a network."""
    default = os.environ.get("PENUMBRA_SECURE")
    group.add_argument(
        "--secure", type=Path, default=Path(default) if default else None, metavar="FOLDER",
        help="certificates of `penumbra certs`: TLS, and each may say only what is its own (default: $PENUMBRA_SECURE or off)",
    )  # fmt: skip


def connection(options: argparse.Namespace) -> Connection:
    """The connection that the flags of `add_arguments` and the environment ask for."""
    connect = tuple(options.connect)
    if not connect and options.config is None and options.mode in (None, "client"):
        connect = tuple(os.environ.get("PENUMBRA_CONNECT", "").split())
    return Connection(options.mode, connect, tuple(options.listen), options.config, options.secure)


def mode(connection: Connection) -> str:
    """client, peer or router, as the connection or its file says. Raises BusError like `configuration`."""
    return str(json.loads(configuration(connection).get_json("mode")))


def configuration(connection: Connection) -> zenoh.Config:
    """The Zenoh configuration of a connection. Raises BusError for a file or an endpoint that Zenoh does not take."""
    try:
        config = zenoh.Config.from_file(str(connection.config)) if connection.config else zenoh.Config()
    except zenoh.ZError as error:
        raise BusError(f"--config {connection.config}: a Zenoh configuration (JSON5) expected: {_short(error)}") from None

    def is_set(key: str) -> bool:
        return connection.config is not None and config.get_json(key) not in ("null", "[]")

    mode = connection.mode or (json.loads(config.get_json("mode")) if is_set("mode") else "client")
    settings: dict[str, Any] = {"mode": mode}
    if connection.connect:
        settings["connect/endpoints"] = connection.connect
    elif mode == "client" and not is_set("connect/endpoints"):
        settings["connect/endpoints"] = [connection.default]
    if connection.listen:
        settings["listen/endpoints"] = connection.listen
    elif mode == "router" and connection.config is None:
        settings["listen/endpoints"] = [connection.default]
    defaults = {
        # one attempt is short, because Ctrl-C is not heard inside it; `open_session` repeats it, and later Zenoh itself does
        "connect/timeout_ms": ATTEMPT_MS,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 200, "period_increase_factor": 1},
        # processes meet at the router and nowhere else: what is not configured is not found by chance
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,  # nor waited for
        "transport/shared_memory/transport_optimization/pool_size": connection.pool_bytes,
        "transport/shared_memory/transport_optimization/message_size_threshold": SHARED_BYTES,
    }
    settings |= {key: value for key, value in defaults.items() if not is_set(key)}
    if connection.config is None:
        settings["transport/link/tx/lease"] = 1000  # ms after which a frozen process is no longer alive
    for endpoint in (*connection.connect, *connection.listen):
        protocols = SECURE_PROTOCOLS if connection.secure else PROTOCOLS
        if endpoint.partition("/")[0] not in protocols:  # Zenoh would try it for ever
            raise BusError(
                f"endpoint {endpoint!r}: PROTOCOL/ADDRESS expected, as in {connection.default}; "
                f"protocols{' with --secure' if connection.secure else ''}: {', '.join(protocols)}"
            )
    if connection.secure is not None:
        settings |= _secure(connection.secure, access.holder(connection.service, mode == "router"), mode)
    if connection.slow is not None:
        settings |= connection.slow.settings()
        for side in ("connect", "listen"):
            if (found := settings.get(f"{side}/endpoints")) is not None:
                settings[f"{side}/endpoints"] = connection.slow.bounded(found, side == "listen")
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise BusError(f"{key}: {json.dumps(value)} is nothing that Zenoh takes: {_short(error)}") from None
    return config


def _secure(folder: Path, holder: str, mode: str) -> dict[str, Any]:
    """Zenoh's settings for mutual TLS, and in a router for who may say what."""
    if mode == "peer":
        raise BusError("--secure with --mode peer: client or router expected: only a router looks at who says what")
    files = {name: folder / f"{name}.pem" for name in ("ca", holder, f"{holder}-key")}
    for path in files.values():
        try:
            path.read_bytes()
        except OSError as error:
            names = ", ".join(file.name for file in files.values())
            raise BusError(
                f"--secure {folder}: {names} expected, {path.name} cannot be read ({error.strerror}): make them with "
                f"`penumbra certs --out {folder}`, or copy them from where they were made"
            ) from None
    tls = {
        "root_ca_certificate": str(files["ca"]),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    for side in ("listen", "connect"):
        tls |= {f"{side}_certificate": str(files[holder]), f"{side}_private_key": str(files[f"{holder}-key"])}
    settings: dict[str, Any] = {"transport/link/tls": tls, "transport/link/protocols": SECURE_PROTOCOLS}
    if mode == "router":
        settings |= {"access_control": access.control(), "low_pass_filter": access.limits()}
    return settings


def taken(endpoint: str) -> BusError:
    """The error of a router whose port is in use."""
    return BusError(
        f"the port of {endpoint} is taken: another router runs there; stop it, or give another port "
        "(penumbra up --port 7448; penumbra router --listen tcp/127.0.0.1:7448)"
    )


def open_session(
    connection: Connection, stopping: threading.Event, waiting: Callable[[], None], patience_s: float = math.inf
) -> zenoh.Session:
    """A session, as soon as the router is there; `waiting` is called once if it is not yet. Once open, the session comes back by
    itself whenever the router does.

    Raises BusError where the configuration cannot be used, the port is taken, or no router came within `patience_s` or before
    `stopping` was set.
    """
    config = configuration(connection)
    _keep_memory()
    deadline = time.monotonic() + patience_s
    told = False
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            if "Address already in use" in str(error):
                raise taken(", ".join(connection.listen) or connection.default) from None
            if "Unable to connect" not in str(error):
                raise BusError(f"the Zenoh session does not open: {_short(error)}") from None
        if stopping.is_set() or time.monotonic() > deadline:
            raise BusError(f"no router {connection.whereabouts}: start `penumbra router` or `penumbra up`, or give --connect")
        if not told:
            waiting()
            told = True


def ask(
    session: zenoh.Session, key: str, parameters: str = "", payload: bytes | None = None, timeout_s: float = 1.0
) -> list[bytes]:
    """The payloads of all answers to a query. Raises Refused where the only answers are errors."""
    selector = f"{key}?{parameters}" if parameters else key
    answers, errors = [], []
    # every answerer counts, also where several processes answer on the same key
    for reply in session.get(
        selector,
        payload=payload,
        timeout=timeout_s,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    ):
        if reply.ok is not None:
            answers.append(reply.ok.payload.to_bytes())
        elif reply.err is not None:
            errors.append(reply.err.payload.to_bytes().decode(errors="replace"))
    if errors and not answers:
        raise Refused(errors[0])
    return answers


def topic_of(key: str, known: Iterable[Topic] = TOPICS) -> Topic | None:
    """The topic that a key (or a key expression) belongs to, of those that are known."""
    return next((topic for topic in known if zenoh.KeyExpr(topic.at()).includes(key)), None)


class Rate:
    """Events per second over about the last RATE_WINDOW_S, at a constant cost per event: an exponentially weighted count,
    divided by the weight that the time since the first event can have."""

    def __init__(self) -> None:
        self._first = self._last = math.nan
        self._weight = 0.0

    def add(self, now_s: float) -> None:
        if math.isnan(self._first):
            self._first = self._last = now_s  # one event has no rate: it only starts the clock
            return
        self._weight = self._weight * math.exp((self._last - now_s) / RATE_WINDOW_S) + 1.0
        self._last = now_s

    def hz(self, now_s: float) -> float:
        elapsed = now_s - self._first
        if not elapsed > 0:
            return 0.0
        weight = self._weight * math.exp((self._last - now_s) / RATE_WINDOW_S)
        return weight / (RATE_WINDOW_S * -math.expm1(-elapsed / RATE_WINDOW_S))


@dataclass
class Traffic:
    """What came (or went) on one key. `bad`: refused messages by kind; `dropped`: gaps in the publishers' own count, None for
    what cannot be known; `delay_s`: from the measurement to here, of the last message; `is_read`: whether anybody here reads it
    now: what another replica reads is never stale."""

    stale_s: float
    count: int = 0
    bad: dict[str, int] = field(default_factory=dict)
    dropped: int | None = None
    stamp_ns: int | None = None
    delay_s: float = math.nan
    is_read: bool = True
    rate: Rate = field(default_factory=Rate)

    def took(self, stamp_ns: int, now_ns: int) -> None:
        """Counts a good message."""
        self.count += 1
        self.stamp_ns = stamp_ns
        self.delay_s = (now_ns - stamp_ns) * 1e-9
        self.rate.add(time.monotonic())

    def missed(self, count: int | None) -> None:
        """Counts messages that did not come; None where the publisher does not number them."""
        if count is not None:
            self.dropped = (self.dropped or 0) + count

    def age_s(self, now_ns: int) -> float | None:
        """Seconds since the newest measurement; None where none ever came."""
        return None if self.stamp_ns is None else (now_ns - self.stamp_ns) * 1e-9

    def is_stale(self, now_ns: int) -> bool:
        age = self.age_s(now_ns)
        return self.is_read and math.isfinite(self.stale_s) and (age is None or age > self.stale_s)

    def report(self, now_ns: int) -> dict[str, Any]:
        """The counters as JSON."""
        age = self.age_s(now_ns)
        return {
            "count": self.count,
            "rate_hz": round(self.rate.hz(time.monotonic()), 2),
            "age_s": None if age is None else round(age, 4),
            "delay_s": None if math.isnan(self.delay_s) else round(self.delay_s, 5),
            "dropped": self.dropped,
            "bad": dict(self.bad),
            "stale": self.is_stale(now_ns),
        }


class Reader:
    """One subscription: a ring of `depth` samples and a thread that decodes them and hands them on.

    keys: every concrete key that the cell knows, with its names, counters and guard; a sample on any other key is refused, so
    that nobody can grow the table. `refused` is told of the first bad message of each kind on a key, `failed` of every exception
    of the handler. from_others: leaves out what this session publishes itself. turn: is told when the handler begins and
    returns.
    """

    def __init__(
        self,
        session: zenoh.Session,
        expression: str,
        depth: int,
        topic: Topic,
        keys: dict[str, tuple[dict[str, str], Traffic, Guard]],
        strangers: Traffic,
        handler: Callable[[Any, dict[str, str]], None],
        now_ns: Callable[[], int],
        refused: Callable[[str, BadMessage], None],
        failed: Callable[[str, Exception], None],
        from_others: bool,
        turn: Turn,
    ):
        self._topic, self._keys, self._strangers = topic, keys, strangers
        self._handler, self._now_ns, self._refused, self._failed, self._turn = handler, now_ns, refused, failed, turn
        origin = zenoh.Locality.REMOTE if from_others else zenoh.Locality.ANY
        self._subscriber = session.declare_subscriber(expression, zenoh.handlers.RingChannel(depth), allowed_origin=origin)
        self._ring = self._subscriber.handler  # the subscriber itself cannot be closed while a thread waits in it
        self.thread = threading.Thread(target=self._run, name=f"read {expression}", daemon=True)
        self.thread.start()

    def close(self) -> None:
        """Ends the subscription; the message that is under way is still handed on."""
        self._subscriber.undeclare()

    def _run(self) -> None:
        while True:
            try:
                sample = self._ring.recv()
            except zenoh.ZError:  # the subscription, or the session, was closed
                return
            self._take(sample)

    def _take(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        names, traffic, guard = self._keys.get(key) or ({}, self._strangers, None)
        publisher, number = _publisher(sample.source_info)
        try:
            if guard is None:
                raise BadMessage("key", f"one of the cell's {len(self._keys)} keys expected, {key!r:.120} came")
            traffic.missed(guard.admit(publisher, number, time.monotonic()))  # before anything that takes long
            message = self._decode(sample)
            guard.believe(publisher, message.stamp_ns, time.monotonic(), getattr(message, "camera", ""))
        except BadMessage as error:
            traffic.bad[error.kind] = traffic.bad.get(error.kind, 0) + 1
            if traffic.bad[error.kind] == 1:
                self._refused(key, error)
            return
        traffic.took(message.stamp_ns, self._now_ns())
        try:
            with self._turn:
                self._handler(message, names | {"publisher": publisher})
        except Exception as error:
            self._failed(f"reader of {key}", error)

    def _decode(self, sample: zenoh.Sample) -> Message:
        kind = self._topic.message
        if sample.kind == zenoh.SampleKind.DELETE:
            raise BadMessage("delete", f"a {kind.__name__} expected, a deletion came")
        if len(sample.payload) > kind.MAX_BYTES:  # before it is copied
            raise BadMessage("size", f"{kind.__name__}: at most {kind.MAX_BYTES} bytes expected, {len(sample.payload)} came")
        return decode(kind, sample.payload.to_bytes(), self._now_ns(), self._topic.oldest_s)


def _keep_memory() -> None:
    """Has glibc keep the memory of large messages. It would map pages for each and unmap them again, and the kernel would clear
    them: for a frame of 921 kB that takes longer than all the copying. Elsewhere than with glibc nothing changes."""
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, KEPT_BYTES)
        mallopt(M_TRIM_THRESHOLD, SPARE_BYTES)


def _publisher(info: zenoh.SourceInfo | None) -> tuple[str, int | None]:
    """Who sent a message, and its number; nobody and None where it does not say."""
    return ("", None) if info is None else (f"{info.source_id.zid}/{info.source_id.eid}", info.source_sn)


def _short(error: Exception) -> str:
    """The first line of Zenoh's text, without the place in its sources."""
    return str(error).partition(" at /")[0].strip().replace("\n", " ")[:300]
