"""The cell that a command looks at, and what to do where it is not there."""

from __future__ import annotations

import zenoh

from penumbra.shared.cell import names
from penumbra.shared.cell.names import Names
from penumbra.shared.contract import outline, topics
from penumbra.shared.contract.messages import BadMessage
from penumbra.shared.contract.processes import ROUTER
from penumbra.shared.runtime import bus, running


def name_of(session: zenoh.Session, cell: str | None) -> str:
    """Name of a cell that is given by a built-in name or its file; None means the only one that runs, else the default. Raises
    CellError."""
    return names.read(cell).name if cell else running.only_cell(session) or names.DEFAULT


def names_of(session: zenoh.Session, cell: str | None) -> Names:
    """Names of a cell like `name_of`; those of the only one that runs come from fusion's description unless it is built in.
    Raises CellError, and BusError where fusion does not answer."""
    name = cell or running.only_cell(session) or names.DEFAULT
    if cell or names.built_in(name):
        return names.read(name)
    try:
        answers = bus.ask(session, topics.description(name), timeout_s=running.ANSWER_S)
    except bus.Refused:  # fusion is not ready yet
        answers = []
    if not answers:
        raise bus.BusError(f"no answer for the targets of cell {name}: {whats_there(session, name, 'fusion')}")
    try:
        found = outline.decode(answers[0])
    except BadMessage as error:
        raise bus.BusError(str(error)) from None
    return Names(found.name, found.targets)


def whats_there(session: zenoh.Session, cell: str, service: str) -> str:
    """Remedy where a service does not answer, depending on which processes, or which other cells, are on this router."""
    services = sorted({instance.service for instance in running.ask(session, cell)})
    if service in services:
        return f"{service} runs, and has nothing to answer yet: see `penumbra topics --hz`"
    if services not in ([], [ROUTER.name]):  # a router serves all cells
        return f"its processes are {', '.join(services)}: start `penumbra {service}`"
    return elsewhere(session, cell)


def elsewhere(session: zenoh.Session, cell: str) -> str:
    """Remedy where no process of a cell is on this router, depending on which other cells are."""
    others = [each for each in running.cells_at_work(session) if each != cell]
    if others:
        return f"no process of it is on this router, where cells run: {', '.join(others)}; {give(others[0])}"
    return "no process of any cell is on this router: start `penumbra up`"


def give(cell: str) -> str:
    """The words that tell a user how to name a cell that runs."""
    return f"give --cell {cell}" if names.built_in(cell) else f"give --cell FILE.yaml, the file of cell {cell}"
