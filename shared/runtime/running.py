"""State of a cell's processes, queried from outside: for `penumbra doctor`, `penumbra topics --hz` and the Python client."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import zenoh

from penumbra.shared.contract import report, topics
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


def cells_there(session: zenoh.Session) -> list[str]:
    """Names of the cells that have a process on the bus."""
    replies = session.liveliness().get(topics.alive("*"), timeout=ANSWER_S)
    return sorted({str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok is not None})


def whats_there(session: zenoh.Session, cell: str, service: str) -> str:
    """Remedy where a service does not answer, depending on which processes, or which other cells, are on this router."""
    running = sorted({instance.service for instance in ask(session, cell)})
    if service in running:
        return f"{service} runs, and has nothing to answer yet: see `penumbra topics --hz`"
    if running:
        return f"its processes are {', '.join(running)}: start `penumbra {service}`"
    others = cells_there(session)
    if others:
        return f"no process of it is on this router, where cells run: {', '.join(others)}; give --cell {others[0]}, or its file"
    return "no process of any cell is on this router: start `penumbra up`"
