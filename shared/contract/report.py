"""The health report: the answer of a process to the health query, as JSON on the bus and typed here."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import msgspec


@dataclass(frozen=True)
class TopicReport:
    """The messages of one key that a process has received or published.

    count: good messages. rate_hz: good messages a second. age_s: since the newest measurement [s], None where there was none.
    delay_s: from the measurement of the last message to its arrival [s], None where that is not known. dropped: messages that
    their publishers numbered and that never arrived, None where nobody numbers them. bad: refused messages by kind. stale:
    whether the input is missing.
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
    name of its cell. wire_version: of `shared.contract.messages`. ready: whether the other replicas count on it. hangs: what
    hangs, in words, empty where nothing does. progress: what it does before it can work and how far it is, as in `compiling 12 of
    40`; empty where it is ready to work. uptime_s: since it began [s]. cpu: in use [cores]. memory_mb: resident [MB]. replicas:
    living instances of the service. topics, published: by key. stale: keys of missing inputs. faults: exceptions by kind and
    place. report: what the service adds, by name.
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
        """The report as JSON objects; `report` is left out where the service adds nothing."""
        out = dataclasses.asdict(self)
        if not self.report:
            del out["report"]
        return out


_DECODER = msgspec.json.Decoder(Report)


def read(answer: bytes) -> Report:
    """The report in the answer to a health query. Fields that another release sends besides are ignored. Raises ValueError for
    what is no report."""
    return _DECODER.decode(answer)
