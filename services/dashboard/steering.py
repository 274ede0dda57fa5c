"""Requests of an operator on the page, answered by the emulator and the launcher on the bus.

On a secured bus only an operator's certificate may make requests. If the dashboard's folder has one, it opens its own session
with it; the router decides by that certificate, so a dashboard without one can steer nothing, whatever a page sends.
"""

from __future__ import annotations

import json
import secrets
import threading
import time
from dataclasses import replace
from typing import Any

import zenoh

from penumbra.shared.contract import access, topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node

ANSWER_S = 1.0
OPEN_S = 3.0
"""Maximum time [s] for the operator's session to open."""
ASK_S = 0.2
CHANGE_S = 180.0
"""Maximum time [s] for which a restart is followed: the launcher gives up earlier."""
COMMANDS = ("occlude", "motion", "speed", "pause", "resume", "state")
"""Commands that a page may send to the emulator. Faults of the skin are for `penumbra sim`."""


class Steering:
    """Makes requests as an operator. Its functions wait for answers, and may be called from any thread.

    All of them raise bus.BusError if nobody answers, and ValueError with the reason if the request is refused.
    """

    def __init__(self, node: Node):
        self._node, self._cell = node, node.cell.name
        self._own: zenoh.Session | None = None
        self._lock = threading.Lock()

    def emulator(self, command: str, value: float | str | None = None) -> dict[str, Any]:
        """Send the emulator a command; returns the settings that are then in force."""
        if command not in COMMANDS:
            raise ValueError(f"expected one of {', '.join(COMMANDS)}, got {command!r:.40}")
        request = {"command": command} | ({"value": value} if value is not None else {})
        answers = self._ask(topics.control(self._cell), request)
        if not answers:
            raise bus.BusError(f"no emulator answers in cell {self._cell}: it runs only in a simulated cell")
        return answers[0]

    def restart(self, service: str) -> dict[str, Any]:
        """Have the launcher restart a service; returns the result: `what` and `error`, empty if it succeeded."""
        key, name = topics.launcher(self._cell), secrets.token_hex(8)
        answers = self._ask(key, {"command": "restart", "services": [service], "id": name})
        if not answers:
            raise bus.BusError(f"no launcher runs in cell {self._cell}: its processes are restarted by what started them")
        heard = began = time.monotonic()
        while not all(each["done"] for each in answers):
            if self._node.stopping.wait(ASK_S) or time.monotonic() - began > CHANGE_S:
                break
            if found := self._ask(key, {"command": "state", "id": name}):
                answers, heard = found, time.monotonic()
            elif time.monotonic() - heard > OPEN_S:
                raise bus.BusError(f"the launcher ended during the {answers[0]['what']}")
        return {"what": answers[0]["what"], "error": "; ".join(each["error"] for each in answers if each["error"])}

    def close(self) -> None:
        """Close the operator's session."""
        with self._lock:
            if self._own is not None:
                self._own.close()
                self._own = None

    def _ask(self, key: str, request: dict[str, Any]) -> list[dict[str, Any]]:
        answers = bus.ask(self._session(), key, payload=json.dumps(request).encode(), timeout_s=ANSWER_S)
        return [json.loads(answer) for answer in answers]

    def _session(self) -> zenoh.Session:
        connection = self._node.connection
        if connection.secure is None:
            if self._node.session is None:
                raise bus.BusError("the dashboard is not on the bus yet")
            return self._node.session
        with self._lock:
            if self._own is None:
                asking = replace(connection, service=access.OPERATOR)
                self._own = bus.open_session(asking, self._node.stopping, lambda: None, OPEN_S)
            return self._own
