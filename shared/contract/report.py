"""The health report: a process's answer to the health query, as JSON on the bus and typed here."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import msgspec


@dataclass(frozen=True)
class TopicReport:
    """Statistics of the messages on one key that a process has received or published.

    count: good messages. rate_hz: good messages per second. age_s: time since the newest measurement [s], None before the first.
    delay_s: time from the measurement in the last message to its arrival [s], None where it is unknown. dropped: numbered
    messages that never arrived, None where no publisher numbers its messages. bad: refused messages by kind. stale: whether the
    input is missing.
    """

    count: int = 0
    rate_hz: float = 0.0
    age_s: float | None = None
    delay_s: float | None = None
    dropped: int | None = None
    bad: dict[str, int] = field(default_factory=dict)
    stale: bool = False


@dataclass(frozen=True)
class Report:
    """One running instance of a service.

    status: ok, starting, degraded or down (`shared.runtime.health`), with its reasons in words. host, pid: where it runs. cell:
    name of its cell. wire_version: of `shared.contract.messages`. ready: whether the other replicas count it as available. hangs:
    description of what hangs; empty where nothing does. progress: of its preparation, as in `compiling 12 of 40`; empty where it
    is ready. uptime_s: time since its start [s]. cpu: in use [cores]. memory_mb: resident [MB]. replicas: living instances of the
    service. topics, published: statistics by key. stale: keys of missing inputs. faults: exceptions by kind and place. report:
    the service's own entries, by name.
    """

    service: str
    instance: str
    status: str
    reasons: list[str] = field(default_factory=list)
    host: str = ""
    pid: int = 0
    cell: str = ""
    wire_version: int = 0
    ready: bool = False
    hangs: str = ""
    progress: str = ""
    uptime_s: float = 0.0
    cpu: float = 0.0
    memory_mb: float = 0.0
    replicas: int = 0
    topics: dict[str, TopicReport] = field(default_factory=dict)
    published: dict[str, TopicReport] = field(default_factory=dict)
    stale: list[str] = field(default_factory=list)
    faults: dict[str, int] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """The report as JSON objects, without `report` where the service adds nothing."""
        out = dataclasses.asdict(self)
        if not self.report:
            del out["report"]
        return out


_DECODER = msgspec.json.Decoder(Report)


def read(answer: bytes) -> Report:
    """Report in the answer to a health query. Additional fields of other releases are ignored. Raises ValueError where the answer
    is not a report."""
    return _DECODER.decode(answer)
