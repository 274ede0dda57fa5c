"""What an operator asks for on the page: the emulator and the launcher answer it on the bus.

On a secured bus only an operator's certificate may ask. The dashboard has one where its folder holds it, and opens a session of
its own with it; the router decides by that certificate, so that a dashboard without one can steer nothing, whatever a page says.
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
"""How long the operator's session may take to open."""
ASK_S = 0.2
CHANGE_S = 180.0
"""How long a restart is followed: the launcher gives up earlier."""
COMMANDS = ("occlude", "motion", "speed", "pause", "resume", "state")
"""What a page may ask of the emulator. Faults of the skin are for `penumbra sim`."""


class Steering:
    """Asks as an operator. Its functions wait for answers, and may be called from any thread.

    Raises, in each of them: bus.BusError where nobody answers, ValueError with the answerer's reason where it refuses.
    """

    def __init__(self, node: Node):
        self._node, self._cell = node, node.cell.name
        self._own: zenoh.Session | None = None
        self._lock = threading.Lock()

    def emulator(self, command: str, value: float | str | None = None) -> dict[str, Any]:
        """Gives the emulator a command, and returns what is in force then."""
        if command not in COMMANDS:
            raise ValueError(f"expected one of {', '.join(COMMANDS)}, got {command!r:.40}")
        request = {"command": command} | ({"value": value} if value is not None else {})
        answers = self._ask(topics.control(self._cell), request)
        if not answers:
            raise bus.BusError(f"no emulator answers in cell {self._cell}: it runs only in a simulated cell")
        return answers[0]

    def restart(self, service: str) -> dict[str, Any]:
        """Has the launcher restart a service, and returns what became of it: `what` and `error`, empty where all is well."""
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
        """Ends the operator's session."""
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
