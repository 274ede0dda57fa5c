"""Finds a running cell: its router by an endpoint, and the cell by fusion's answer on `topics.description`."""

from __future__ import annotations

import os
import re
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import zenoh

from penumbra.client.cell import Cell
from penumbra.shared.contract import outline, topics
from penumbra.shared.contract.messages import BadMessage
from penumbra.shared.contract.outline import Outline
from penumbra.shared.runtime import bus, running
from penumbra.shared.runtime.connection import connect_by_environment, secure_by_environment

ANSWER_S = 1.0
"""Maximum wait [s] for the answer to one query for the description."""
AGAIN_S = 0.1
"""Time [s] between two queries until the cell answers."""
PATIENCE_S = 3.0


def connect(
    cell: str | Path | None = None,
    *,
    endpoint: str | None = None,
    secure: str | Path | None = None,
    timeout: float = PATIENCE_S,
) -> Cell:
    """Connects to a running cell; use it in `with`.

    Args:
        cell: Name of the cell, or its YAML file. Default: `$PENUMBRA_CELL`, else the only cell at the router.
        endpoint: Endpoint of the router, such as `tcp/192.168.0.7:7447`; separate several by spaces. Default:
            `$PENUMBRA_CONNECT`, else this machine.
        secure: Folder of certificates of `penumbra certs`; needs `ca`, `viewer` and, to publish, `driver`. Default:
            `$PENUMBRA_SECURE`, else without certificates.
        timeout: Maximum wait for the router and the cell [s], by default 3 s. A program that starts with the machine
            may use `math.inf`.

    Raises:
        BusError: The router, fusion or the cell is missing, several cells run there, or an argument cannot be used. The text says
            which, and what to do.
        CellError: The YAML file cannot be read or has faults; a ValueError. The text names file and line.
    """
    return Cell(*Search.of(cell, endpoint, secure, timeout).run())


@dataclass(frozen=True)
class Search:
    """Search for a cell by name; None accepts the only cell. stopping: ends the search early."""

    cell: str | None
    connection: bus.Connection
    timeout: float
    stopping: threading.Event

    @classmethod
    def of(cls, cell: str | Path | None, endpoint: str | None, secure: str | Path | None, timeout: float) -> Search:
        """As `connect`, with its defaults. Raises bus.BusError."""
        for name, value, types, what in (
            ("endpoint", endpoint, str, "text, as in 'tcp/192.168.0.7:7447'"),
            ("secure", secure, str | Path, "a folder"),
            ("timeout", timeout, int | float, "seconds"),
        ):
            if value is not None and not isinstance(value, types):
                raise bus.BusError(f"{name}: expected {what}, got {value!r:.60} ({type(value).__name__})")
        connection = bus.Connection(
            connect=tuple(endpoint.split()) if endpoint else connect_by_environment(),
            secure=Path(secure) if secure else secure_by_environment(),
        )
        return cls(_name(cell or os.environ.get("PENUMBRA_CELL")), connection, timeout, threading.Event())

    def run(self) -> tuple[zenoh.Session, bus.Connection, Outline]:
        """Returns the session, its connection, and the summary of the cell. Raises bus.BusError."""
        deadline = time.monotonic() + self.timeout
        session = bus.open_session(self.connection, self.stopping, lambda: None, self.timeout)
        try:
            return session, self.connection, self._outline(session, deadline)
        except BaseException:
            session.close()
            raise

    def _outline(self, session: zenoh.Session, deadline: float) -> Outline:
        while True:
            try:
                answers = bus.ask(session, topics.description(self.cell or "*"), timeout_s=ANSWER_S)
                found = {each.name: each for each in map(outline.decode, answers)}
            except bus.Refused:  # fusion is not ready yet
                found = {}
            except BadMessage as error:
                raise bus.BusError(str(error)) from None
            if len(found) == 1:
                return next(iter(found.values()))
            if found:
                names = ", ".join(sorted(found))
                raise bus.BusError(f"several cells run {self.connection.whereabouts}: {names}; say which, as in connect(cell=…)")
            if time.monotonic() > deadline or self.stopping.wait(AGAIN_S):
                raise bus.BusError(self._nobody(session))

    def _nobody(self, session: zenoh.Session) -> str:
        """Reason why there is no answer, as text."""
        services = running.services_at_work(session)
        where, names = self.connection.whereabouts, ", ".join(sorted(services))
        if not services:
            return f"no cell runs {where}: start `penumbra up`"
        if self.cell is not None and self.cell not in services:
            return f"no cell {self.cell!r} {where}; running there: {names}"
        is_coming = "fusion" in services[self.cell] if self.cell else any("fusion" in each for each in services.values())
        if is_coming:
            return f"fusion of cell {self.cell or names} {where} is not ready yet: wait longer, as in connect(timeout=60)"
        return f"no fusion in cell {self.cell or names} {where}: it has the poses; start `penumbra fusion` or `penumbra up`"


def _name(cell: str | Path | None) -> str | None:
    """Name of a cell, given by its name or its YAML file. Raises BusError for other values, CellError for a faulty file."""
    if cell is None or cell == "":
        return None
    is_text = isinstance(cell, str | Path)
    if is_text and Path(cell).suffix in (".yaml", ".yml"):
        from penumbra.shared.cell import description  # slow to import, and needed for this only

        return description.load(cell).name
    if not is_text or not re.fullmatch(r"[A-Za-z0-9_-]+", str(cell)):
        got = repr(str(cell)) if is_text else f"{cell!r:.60} ({type(cell).__name__})"
        raise bus.BusError(f"expected the name of a cell (letters, digits, _ and -) or its YAML file, got {got}")
    return str(cell)
