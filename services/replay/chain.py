"""Replays messages through the services in one process, bit for bit reproducibly: time is that of the data.

Each service is wired by its own `start`, to a `ReplayNode` instead of the bus. A message of a service is delivered after the time
that a real machine needs to make it, so that fusion receives vision late, as it does live.
"""

from __future__ import annotations

import heapq
import importlib
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import click

from penumbra.services import flags
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import processes, topics
from penumbra.shared.contract.messages import Message, decode, encode
from penumbra.shared.contract.topics import Topic
from penumbra.shared.perception.lookout import MAX_PIXELS
from penumbra.shared.recording.reading import Played
from penumbra.shared.runtime import logs
from penumbra.shared.runtime.bus import BusError
from penumbra.shared.runtime.hang import HANG_S
from penumbra.shared.runtime.node import ServiceNode

SERVICES = ("segmentation", "search", "haptics", "fusion")
DELAY_NS = {topics.FRAME: 2_000_000, topics.MASK: 30_000_000, topics.VISION: 5_000_000, topics.HAPTIC: 1_000_000}
"""Delay [ns] from the cause of a message to its arrival; other topics arrive at once."""

DEFAULTS = {"search": ("--landmarks", "off"), "segmentation": ("--pixels", str(MAX_PIXELS))}
"""Default arguments of services, placed before others: a replay must be the same on every machine, with or without the landmark
models and whatever its speed."""


@dataclass(frozen=True)
class Heard:
    """A message of the recording or of a service, with its arrival time and names."""

    time_ns: int
    topic: Topic
    names: dict[str, str]
    message: Any


class Replay:
    """Clock, message queue and subscribers of a replay.

    services: the services to run, if the cell has work for them; arguments: their flags. hear: called with every delivered
    message; None: messages are kept in `heard`, in order. Raises BusError for flags that a service does not have.
    """

    def __init__(
        self,
        cell: cells.Cell,
        services: Iterable[str] = SERVICES,
        arguments: Mapping[str, Sequence[str]] | None = None,
        hear: Callable[[Heard], None] | None = None,
    ):
        self.cell, self.now_ns = cell, 0
        self.heard: list[Heard] = []
        self._hear = hear or self.heard.append
        self._listeners: list[tuple[Topic, dict[str, str], Callable[[Any, dict[str, str]], None]]] = []
        self._timers: list[tuple[int, Callable[[], None]]] = []
        self._answers: dict[str, Callable[[dict[str, str], bytes], Any]] = {}
        self._queue: list[tuple[int, int, Callable[[], None]]] = []
        self._count = itertools.count()
        chosen = arguments or {}
        for name in services:
            if (process := processes.find(name)) is not None and not process.is_needed(cell):
                continue
            module = importlib.import_module(f"penumbra.services.{name}.service")
            words = [*DEFAULTS.get(name, ()), *chosen.get(name, ())]
            try:
                options = flags.parse(module.FLAGS, words)
            except click.ClickException as error:
                raise BusError(f"--{name}: {flags.reason(error)} (see penumbra {name} --help)") from None
            module.start(ReplayNode(self, name), options)

    def run(self, recording: Iterable[tuple[Topic, dict[str, str], Message]]) -> list[Heard]:
        """Play messages in the order of their stamps, each delivered after its sensor's delay; returns `heard`."""
        return self._play(
            Heard(message.stamp_ns + DELAY_NS.get(topic, 0), topic, names, message) for topic, names, message in recording
        )

    def run_recorded(self, recording: Iterable[Played]) -> list[Heard]:
        """Play messages at their recorded times of arrival; returns `heard`."""
        return self._play(Heard(each.received_ns, each.topic, each.names, each.message) for each in recording)

    def _play(self, recording: Iterable[Heard]) -> list[Heard]:
        for item in recording:
            begins_ns = item.time_ns - DELAY_NS.get(item.topic, 0)
            if not self.now_ns:
                self.now_ns = begins_ns
                for period_ns, function in self._timers:
                    self._tick(begins_ns, period_ns, function)
            self._advance(max(begins_ns, self.now_ns))
            self._send(item)
        self._advance(self.now_ns + max(DELAY_NS.values()))
        return self.heard

    def publish(self, topic: Topic, names: dict[str, str], message: Message) -> None:
        """Send a message made now: it arrives after the time that it takes to make."""
        self._send(Heard(self.now_ns + DELAY_NS.get(topic, 0), topic, names, message))

    def _send(self, item: Heard) -> None:
        copy = decode(item.topic.message, encode(item.message))  # as over the wire: no array is shared
        self._at(item.time_ns, lambda: self._deliver(item.topic, item.names, copy))

    def listen(self, topic: Topic, names: dict[str, str], handler: Callable[[Any, dict[str, str]], None]) -> None:
        self._listeners.append((topic, names, handler))

    def ask(self, key: str, **parameters: str) -> Any:
        """The answer of a service to a query of this key."""
        return self._answers[key](parameters, b"")

    def answer(self, key: str, function: Callable[[dict[str, str], bytes], Any]) -> None:
        self._answers[key] = function

    def every(self, period_ns: int, function: Callable[[], None]) -> None:
        self._timers.append((period_ns, function))

    def _at(self, time_ns: int, function: Callable[[], None]) -> None:
        heapq.heappush(self._queue, (time_ns, next(self._count), function))

    def _tick(self, time_ns: int, period_ns: int, function: Callable[[], None]) -> None:
        def fire() -> None:
            function()
            self._tick(time_ns + period_ns, period_ns, function)

        self._at(time_ns + period_ns, fire)

    def _advance(self, until_ns: int) -> None:
        while self._queue and self._queue[0][0] <= until_ns:
            self.now_ns, _, function = heapq.heappop(self._queue)
            function()
        self.now_ns = until_ns

    def _deliver(self, topic: Topic, names: dict[str, str], message: Any) -> None:
        self._hear(Heard(self.now_ns, topic, names, message))
        for wanted, chosen, handler in self._listeners:
            if wanted is topic and chosen.items() <= names.items():
                handler(message, names | {"publisher": topic.publishers[0]})


class ReplayLatest:
    """The newest delivered message of each key."""

    def __init__(self) -> None:
        self._newest: dict[frozenset[tuple[str, str]], Any] = {}
        self._count = 0

    def hear(self, message: Any, names: dict[str, str]) -> None:
        self._newest[frozenset((name, value) for name, value in names.items() if name != "publisher")] = message
        self._count += 1

    def get(self, **names: str) -> Any:
        return self._newest.get(frozenset(names.items()))

    def drain(self) -> int:
        return self._count


class ReplayNode(ServiceNode):
    """A `ServiceNode` on the replay's clock; a handler's exception ends it."""

    def __init__(self, replay: Replay, service: str):
        self._replay, self._log = replay, logs.get(service)
        self._warm: list[Callable[[], bool]] = []

    @property
    def cell(self) -> cells.Cell:
        return self._replay.cell

    @property
    def log(self) -> logs.Log:
        return self._log

    def now_ns(self) -> int:
        return self._replay.now_ns

    def publish(self, topic: Topic, message: Message, **names: str) -> None:
        self._replay.publish(topic, names, message)

    def subscribe(
        self,
        topic: Topic,
        handler: Callable[[Any, dict[str, str]], None],
        streams: Sequence[str] = (),
        from_others: bool = False,
        **names: str,
    ) -> None:
        """Subscribe. There is one replica of each service: it owns all streams, and there are no others."""
        if not from_others:
            self._replay.listen(topic, names, handler)

    def latest(self, topic: Topic, from_others: bool = False, **names: str) -> ReplayLatest:
        latest = ReplayLatest()
        self.subscribe(topic, latest.hear, from_others=from_others, **names)
        return latest

    def progress(self, what: str, done: int, total: int) -> None:
        """Ignored: nobody queries during a replay."""

    def add_report(self, name: str, function: Callable[[], Any]) -> None:
        """Ignored: nobody queries during a replay."""

    def add_reasons(self, function: Callable[[], Sequence[str]]) -> None:
        """Ignored: nobody queries during a replay."""

    def warm_when(self, function: Callable[[], bool]) -> None:
        self._warm.append(function)

    def is_warm(self) -> bool:
        return all(function() for function in self._warm)

    def every(self, period_s: float, function: Callable[[], None], patience_s: float = HANG_S) -> None:
        self._replay.every(round(period_s * 1e9), function)

    def answer(self, key: str, function: Callable[[dict[str, str], bytes], Any]) -> None:
        self._replay.answer(key, function)

    def owns(self, stream: str) -> bool:
        return True

    def rank(self, stream: str) -> float:
        return 0.0
