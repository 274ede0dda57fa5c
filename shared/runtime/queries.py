"""Queries: functions that answer on a key, each in a thread of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import zenoh

from penumbra.shared.runtime import bus
from penumbra.shared.runtime.link import Link

QUERY_DEPTH = 32
"""Maximum number of queries on a key that wait for an answer."""

Answer = Callable[[dict[str, str], bytes], "bytes | tuple[bytes, str]"]


class Queries:
    """Answers and sends queries on a link. failed: called with the place and the exception of a function that fails."""

    def __init__(self, service: str, link: Link, failed: Callable[[str, Exception], None]):
        self._service, self._link, self._failed = service, link, failed

    def answer(self, key: str, function: Answer) -> None:
        """Answers on `key` from the time when the link makes its declarations."""
        self._link.declare(lambda session: self.serve(session, key, function))

    def serve(self, session: zenoh.Session, key: str, function: Answer) -> None:
        """Answers on `key` from now on."""
        queryable = session.declare_queryable(key, zenoh.handlers.RingChannel(QUERY_DEPTH))

        def run() -> None:
            while True:
                try:
                    query = queryable.recv()
                except zenoh.ZError:
                    return
                with query:
                    self._reply(key, query, function)

        self._link.spawn(run, f"answer {key}")

    def ask(self, key: str, parameters: str, payload: bytes | None, timeout_s: float) -> list[bytes]:
        """Payloads of all answers; empty where nobody answers or the link is not open. Raises bus.Refused."""
        session = self._link.session
        return bus.ask(session, key, parameters, payload, timeout_s) if session else []

    def _reply(self, key: str, query: zenoh.Query, function: Answer) -> None:
        parameters = dict(cast(Any, query.parameters))
        try:
            result = function(parameters, query.payload.to_bytes() if query.payload is not None else b"")
        except ValueError as error:
            query.reply_err(str(error).encode())
        except Exception as error:
            self._failed(f"answer on {key}", error)
            query.reply_err(f"{self._service} failed: {type(error).__name__}: {error}".encode())
        else:
            payload, encoding = result if isinstance(result, tuple) else (result, None)
            query.reply(key, payload, encoding=encoding)
