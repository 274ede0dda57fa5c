"""Traffic of a cell by topic, from the health reports of its processes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from penumbra.shared.contract.report import Report
from penumbra.shared.runtime import bus


@dataclass
class TopicRow:
    """Traffic on all keys of one topic: rates by key, summed over the replicas that publish it; delays to readers; numbers of
    dropped and refused messages."""

    name: str
    rates: dict[str, float] = field(default_factory=dict)
    delays_s: list[float] = field(default_factory=list)
    dropped: int = 0
    bad: int = 0

    @property
    def rate_hz(self) -> float:
        """Mean rate per key."""
        return sum(self.rates.values()) / len(self.rates) if self.rates else 0.0


def topic_rows(reports: Iterable[Report], names: Iterable[str]) -> list[TopicRow]:
    """One row for each topic of these names: rates as published, delays and losses as received."""
    rows = {name: TopicRow(name) for name in names}
    for found in reports:
        for key, traffic in found.published.items():
            if (topic := bus.topic_of(key)) is not None and topic.name in rows:
                rates = rows[topic.name].rates
                rates[key] = rates.get(key, 0.0) + traffic.rate_hz
        for key, traffic in found.topics.items():
            if (topic := bus.topic_of(key.partition(" #")[0])) is not None and topic.name in rows:
                row = rows[topic.name]
                row.delays_s += [traffic.delay_s] if traffic.delay_s is not None else []
                row.dropped += traffic.dropped or 0
                row.bad += sum(traffic.bad.values())
    return list(rows.values())
