"""The cell that a command looks at, and what to do where it is not there."""

from __future__ import annotations

import zenoh

from penumbra.shared.cell import DEFAULT, names
from penumbra.shared.cell.names import Names
from penumbra.shared.contract import outline, topics
from penumbra.shared.contract.messages import BadMessage
from penumbra.shared.contract.outline import Outline
from penumbra.shared.contract.processes import ROUTER
from penumbra.shared.runtime import bus, running


def name_of(session: zenoh.Session, cell: str | None) -> str:
    """Name of a cell that is given by its name or its file; None means the only one that runs, else the default. Raises
    CellError."""
    if not cell:
        return running.only_cell(session) or DEFAULT
    return cell if names.is_bare(cell) else names.read(cell).name


def names_of(session: zenoh.Session, cell: str | None) -> Names:
    """Names of a cell like `name_of`; they come from fusion's description where no file is given and the cell is not built in.
    Raises CellError, and BusError where fusion does not answer."""
    name = cell or running.only_cell(session) or DEFAULT
    if (cell and not names.is_bare(cell)) or names.built_in(name):
        return names.read(name)
    found = described(session, name)
    return Names(found.name, found.targets)


def described(session: zenoh.Session, name: str) -> Outline:
    """Fusion's description of a running cell. Raises BusError where it does not answer."""
    try:
        answers = bus.ask(session, topics.description(name), timeout_s=running.ANSWER_S)
    except bus.Refused:  # fusion is not ready yet
        answers = []
    if not answers:
        raise bus.BusError(f"no description of cell {name}: {whats_there(session, name, 'fusion')}")
    try:
        return outline.decode(answers[0])
    except BadMessage as error:
        raise bus.BusError(str(error)) from None


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
        return f"no process of it is on this router, where cells run: {', '.join(others)}; give --cell {others[0]}"
    return "no process of any cell is on this router: start `penumbra up`"
