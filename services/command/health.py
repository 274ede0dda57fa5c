"""How the processes of a cell fare, asked from outside: `penumbra doctor` and `penumbra topics --hz` show it."""

from __future__ import annotations

from dataclasses import dataclass

import zenoh

from shared.contract import report, topics
from shared.runtime import bus

ANSWER_S = 1.0


@dataclass(frozen=True)
class Instance:
    """One running instance: its status (ok, starting, degraded or down, as `shared.runtime.health` has them) and the reasons."""

    service: str
    instance: str
    status: str
    reasons: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.service} {self.instance}: {self.status}" + (f": {'; '.join(self.reasons)}" if self.reasons else "")


def ask(session: zenoh.Session, cell: str) -> list[Instance]:
    """Every instance of a cell, by service; one that is on the bus but does not answer within ANSWER_S is down."""
    found = {}
    for reply in session.liveliness().get(topics.alive(cell), timeout=ANSWER_S):
        if reply.ok is not None:
            service, instance = str(reply.ok.key_expr).split("/")[-2:]
            found[instance] = Instance(service, instance, "down", (f"it hangs: no answer within {ANSWER_S:g} s",))
    for each in map(report.read, bus.ask(session, topics.health(cell), timeout_s=ANSWER_S)):
        found[each.instance] = Instance(each.service, each.instance, each.status, tuple(each.reasons))
    return sorted(found.values(), key=lambda each: (each.service, each.instance))
