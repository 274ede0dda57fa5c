"""Zenoh session of a node: its opening, its declarations, and its end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable

import zenoh

from penumbra.shared.runtime import bus
from penumbra.shared.runtime.logs import Log

CLOSE_S = 0.8
"""Maximum wait [s] for a session to close, which may take much longer on a bad network."""


class Link:
    """One session and its threads. Declarations made before the session is open are deferred until `declare_all`. connection: how
    to reach the others. stopping: set when the process is to end."""

    def __init__(self, connection: bus.Connection, stopping: threading.Event, log: Log):
        self.connection = connection
        self.session: zenoh.Session | None = None
        self._needs_router = bus.mode(connection) == "client"  # also refuses a bad configuration early
        self._stopping, self._log = stopping, log
        self._opening = threading.Lock()
        self._pending: list[Callable[[zenoh.Session], None]] | None = []
        self._threads: list[threading.Thread] = []
        self._reachable = False

    def open(self, patience_s: float) -> zenoh.Session:
        """The session, opened if necessary; waits for the router, or for another thread that opens the session. Raises
        bus.BusError."""
        with self._opening:
            if self.session is None:
                self.session = bus.open_session(self.connection, self._stopping, self._report_waiting, patience_s)
                self._reachable = True
            return self.session

    def declare(self, declare: Callable[[zenoh.Session], None]) -> None:
        """Calls `declare(session)`, now or in `declare_all`."""
        if self._pending is not None:
            self._pending.append(declare)
        elif (session := self.session) is not None:
            declare(session)

    def declare_all(self) -> None:
        """Makes the deferred declarations; later declarations are made at once."""
        assert self.session is not None, "the session must be open"
        pending, self._pending = self._pending or [], None
        for declare in pending:
            declare(self.session)

    def spawn(self, function: Callable[[], None], name: str) -> None:
        """Runs a function in a thread of the node."""
        thread = threading.Thread(target=function, name=name, daemon=True)
        self.join(thread)
        thread.start()

    def join(self, thread: threading.Thread) -> None:
        """Adds a thread to those that `close` waits for."""
        self._threads.append(thread)

    def close(self, others: Iterable[threading.Thread] = ()) -> None:
        """Closes the session and waits for the node's threads and others, for about CLOSE_S. `stopping` must be set, so that a
        thread that opens the session gives up."""
        deadline = time.monotonic() + CLOSE_S
        is_settled = self._opening.acquire(timeout=CLOSE_S)
        session, self.session = self.session, None
        if is_settled:
            self._opening.release()
        threads = [*self._threads, *others]
        if session is not None:
            closing = threading.Thread(target=session.close, name="close", daemon=True)
            closing.start()
            threads.insert(0, closing)
        for thread in threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))

    def look(self) -> None:
        """Checks whether the router is reachable, and logs changes."""
        if (session := self.session) is None:
            return
        reachable = not self._needs_router or bool(session.info.routers_zid())
        if reachable != self._reachable:
            self._reachable = reachable
            if reachable:
                self._log.info("the router is back")
            else:
                self._report_waiting()

    def away(self) -> str:
        """Why the others cannot be reached; empty where they can."""
        if self.session is None:
            return "not on the bus"
        return "" if self._reachable else f"no router at {self.connection.where}"

    def _report_waiting(self) -> None:
        self._log.warning(f"waiting for the router {self.connection.whereabouts}: start `penumbra router` or `penumbra up`")
