"""Running cells and the state of their processes, queried from outside: for the commands that look, and the Python client."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import zenoh

from penumbra.shared.contract import report, topics
from penumbra.shared.contract.processes import ROUTER
from penumbra.shared.runtime import bus

ANSWER_S = 1.0
"""Maximum wait [s] for the answer of an instance."""


@dataclass(frozen=True)
class Instance:
    """One running process of a cell.

    Attributes:
        service: Its name, such as `fusion`.
        instance: Distinguishes replicas of a service.
        status: `ok`, `starting`, `degraded` or `down`.
        reasons: For a status other than `ok`.
    """

    service: str
    instance: str
    status: str
    reasons: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.service} {self.instance}: {self.status}" + (f": {'; '.join(self.reasons)}" if self.reasons else "")


def ask(session: zenoh.Session, cell: str, service: str = "*", timeout_s: float = ANSWER_S) -> list[Instance]:
    """All instances of a cell, or of one of its services. An instance that is on the bus but does not answer in time is down."""
    found = {}
    for reply in session.liveliness().get(topics.alive(cell, service), timeout=timeout_s):
        if reply.ok is not None:
            name, instance = str(reply.ok.key_expr).split("/")[-2:]
            found[instance] = Instance(name, instance, "down", (f"hangs: no answer within {timeout_s:g} s",))
    with contextlib.suppress(bus.TimedOut):
        for each in map(report.read, bus.ask(session, topics.health(cell, service), timeout_s=timeout_s)):
            found[each.instance] = Instance(each.service, each.instance, each.status, tuple(each.reasons))
    return sorted(found.values(), key=lambda each: (each.service, each.instance))


def services_at_work(session: zenoh.Session) -> dict[str, set[str]]:
    """Services of each cell that have a process on the bus, without routers, which serve all cells."""
    found: dict[str, set[str]] = {}
    for reply in session.liveliness().get(topics.alive("*"), timeout=ANSWER_S):
        if reply.ok is not None:
            _, cell, _, service, _ = str(reply.ok.key_expr).split("/")
            if service != ROUTER.name:
                found.setdefault(cell, set()).add(service)
    return found


def cells_at_work(session: zenoh.Session) -> list[str]:
    """Names of the cells that have a process on the bus beside a router."""
    return sorted(services_at_work(session))


def only_cell(session: zenoh.Session) -> str | None:
    """Name of the only cell at work; None where there are none or several."""
    found = cells_at_work(session)
    return found[0] if len(found) == 1 else None
