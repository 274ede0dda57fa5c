"""The bus: one Zenoh session per process, queries, and the mapping from keys to topics.

`shared.runtime.connection` has the configuration, `shared.runtime.reader` the readers of subscriptions, `shared.runtime.traffic`
their counters.
"""

from __future__ import annotations

import json
import math
import os
import threading
import time
from collections.abc import Callable, Iterable

import zenoh

from penumbra.shared.contract.topics import TOPICS, Topic
from penumbra.shared.runtime import memory
from penumbra.shared.runtime.connection import (
    DEFAULT_ENDPOINT,
    POOL_BYTES,
    SECURE_ENDPOINT,
    BusError,
    Connection,
    configuration,
    connection,
    mode,
    short,
)

__all__ = [
    "DEFAULT_ENDPOINT",
    "POOL_BYTES",
    "SECURE_ENDPOINT",
    "BusError",
    "Connection",
    "Refused",
    "TimedOut",
    "ask",
    "configuration",
    "connection",
    "mode",
    "open_session",
    "taken",
    "topic_of",
]


RUNTIME_VARIABLE = "ZENOH_RUNTIME"
RUNTIME = "(rx: (handover: app), app: (worker_threads: 2))"
"""Zenoh's threads in a client. The thread that waits for the socket also reads the messages. By default it wakes another thread
for that, and a third one that finds nothing to do. A router keeps the default, so that a reader that waits for space on one link
does not block the others."""
TOO_LATE = "Timeout"
"""Text of the error with which Zenoh itself answers a query when its time is over."""


class Refused(ValueError):
    """A query was answered with an error; the text is that of the answer."""


class TimedOut(Refused):
    """Nobody answered a query in time."""


def taken(*endpoints: str) -> BusError:
    """Error of a router of whose ports one is in use."""
    from penumbra.shared.runtime import diagnosis  # imports Python's TLS, which nothing else here needs

    who = "another router runs there" if any(map(_has_router, endpoints)) else diagnosis.STRANGER
    digits = endpoints[0].partition("#")[0].rpartition(":")[2]
    other = min(int(digits) + 1, 65535) if digits.isdecimal() else 7448
    return BusError(
        f"the port of {', '.join(endpoints)} is taken: {who}; stop it, or give another port "
        f"(penumbra up --port {other}; penumbra router --listen tcp/127.0.0.1:{other})"
    )


def _has_router(endpoint: str) -> bool:
    """Whether a router listens at an endpoint, with TLS or without."""
    from penumbra.shared.runtime import diagnosis

    plain = Connection("client", (f"tcp/{endpoint.partition('/')[2]}",))
    try:
        open_session(plain, threading.Event(), lambda: None, 0.0).close()
    except BusError as error:
        return diagnosis.WITHOUT_TLS in str(error)
    return True


def open_session(
    connection: Connection, stopping: threading.Event, waiting: Callable[[], None], patience_s: float = math.inf
) -> zenoh.Session:
    """Opens a session as soon as the router is available; `waiting` is called once if it is not yet. An open session reconnects
    by itself whenever the router comes back.

    Raises BusError where the configuration cannot be used, the port is taken, or no router was found within `patience_s` or
    before `stopping` was set.
    """
    config = configuration(connection)
    memory.keep()
    deadline = time.monotonic() + patience_s
    told = False
    while True:
        try:
            return _open(config)
        except zenoh.ZError as error:
            if "Address already in use" in str(error):
                raise taken(*(connection.listen or (connection.default,))) from None
            if "Unable to connect" not in str(error):
                raise BusError(f"the Zenoh session does not open: {short(error)}") from None
        if stopping.is_set() or time.monotonic() > deadline:
            from penumbra.shared.runtime import diagnosis  # imports Python's TLS, which nothing else here needs

            raise BusError(diagnosis.no_router(connection))
        if not told:
            waiting()
            told = True


def _open(config: zenoh.Config) -> zenoh.Session:
    """Opens a session, in a client with the threads of RUNTIME. Zenoh reads them when the first session of a process opens. Child
    processes, which may be routers, inherit nothing."""
    if json.loads(config.get_json("mode")) != "client" or RUNTIME_VARIABLE in os.environ:
        return zenoh.open(config)
    os.environ[RUNTIME_VARIABLE] = RUNTIME
    try:
        return zenoh.open(config)
    finally:
        del os.environ[RUNTIME_VARIABLE]


def ask(
    session: zenoh.Session, key: str, parameters: str = "", payload: bytes | None = None, timeout_s: float = 1.0
) -> list[bytes]:
    """Payloads of all answers to a query. Raises Refused where the only answers are errors, TimedOut where somebody could have
    answered and nobody did in time."""
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
        refusals = [error for error in errors if error != TOO_LATE]
        raise Refused(refusals[0]) if refusals else TimedOut(f"no answer within {timeout_s:g} s")
    return answers


def topic_of(key: str, known: Iterable[Topic] = TOPICS) -> Topic | None:
    """The known topic that a key (or a key expression) belongs to; None where there is none."""
    return next((topic for topic in known if zenoh.KeyExpr(topic.at()).includes(key)), None)
