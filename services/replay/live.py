"""Publishes a recording on the bus again: with new stamps, because readers refuse old messages, and with the recorded timing."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import msgspec
import zenoh

from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import Message
from penumbra.shared.contract.topics import Topic
from penumbra.shared.recording.reading import Played
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.guard import RATE_TIMES
from penumbra.shared.runtime.sender import Sender

SENSORS = (topics.FRAME, topics.JOINTS, topics.VOLTAGES)
"""Topics of a cell's sensors: all others are derived from them, except the truth, which only an emulator has."""


@dataclass
class Count:
    """Published messages, in all and by topic, and the maximum lateness [s]."""

    messages: int = 0
    late_s: float = 0.0
    topics: dict[str, int] = field(default_factory=dict)


def moved(message: Message, when: Callable[[int], int], rate: float) -> Message:
    """A message with shifted stamps. when: the new time [ns] of an old one. Times between samples shrink with the rate."""
    changes = {name: when(getattr(message, name)) for name in message.__struct_fields__ if name.endswith("stamp_ns")}
    if rate != 1.0 and "period_ns" in message.__struct_fields__:
        changes["period_ns"] = max(1, round(message.period_ns / rate))  # type: ignore[attr-defined]
    return msgspec.structs.replace(message, **changes)


class Player:
    """Publishes messages of a recording. session: of the bus. rate: seconds of the recording per second."""

    def __init__(self, session: zenoh.Session, rate: float):
        self._session, self._rate = session, rate
        self._senders: dict[tuple[str, str], Sender] = {}
        self.count = Count()

    def play(self, recording: Iterable[Played], stopping: threading.Event) -> None:
        """Publish each message when it is due, until the end, or until `stopping` is set."""
        first_ns = began_ns = 0
        began_s = 0.0
        for each in recording:
            if not first_ns:
                first_ns, began_ns, began_s = each.received_ns, time.time_ns(), time.monotonic()
            due_s = began_s + (each.received_ns - first_ns) * 1e-9 / self._rate
            if stopping.wait(max(0.0, due_s - time.monotonic())):
                return
            self.count.late_s = max(self.count.late_s, time.monotonic() - due_s)

            def when(old_ns: int, first_ns: int = first_ns, began_ns: int = began_ns) -> int:
                return began_ns + round((old_ns - first_ns) / self._rate)

            self._send(each, moved(each.message, when, self._rate))

    def _send(self, each: Played, message: Message) -> None:
        source = each.key, each.publisher
        sender = self._senders.get(source)
        if sender is None:
            sender = self._senders[source] = Sender(self._session, each.topic, each.key)
        sender.send(message)
        self.count.messages += 1
        self.count.topics[each.topic.name] = self.count.topics.get(each.topic.name, 0) + 1


def check_alone(session: zenoh.Session, cell: str, wanted: Iterable[Topic]) -> None:
    """Raise bus.BusError if a process on the bus publishes one of these topics itself."""
    found = {str(reply.ok.key_expr).split("/")[-2] for reply in session.liveliness().get(topics.alive(cell)) if reply.ok}
    for topic in wanted:
        for name in sorted(found & set(topic.publishers)):
            raise bus.BusError(
                f"cell {cell} has a process {name}, which publishes {topic.name} itself, and readers would get both: end it "
                f"(penumbra scale {name}=0), or leave its topics out (--sensors, --topics)"
            )


def check_rate(rate: float) -> None:
    """Raise ValueError for a rate at which readers would refuse messages."""
    if not 0 < rate <= RATE_TIMES / 2:
        raise ValueError(
            f"expected more than 0 and at most {RATE_TIMES / 2:g}, above which readers refuse messages, got {rate:g}"
        )
