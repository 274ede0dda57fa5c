"""Recordings for tests, made from the simulated cell's messages as a recorder makes them from the bus."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.contract.topics import Topic
from penumbra.shared.recording import provenance
from penumbra.shared.recording.entries import Entry, as_on_the_bus
from penumbra.shared.recording.file import File
from penumbra.shared.recording.foxglove import Viewers
from penumbra.shared.runtime.tap import Taken
from penumbra.sim.world.world import record

DELAY_NS = 3_000_000
"""Time [ns] from a measurement to its arrival."""
PUBLISHER = bytes(range(12))


def taken(cell: cells.Cell, topic: Topic, names: dict[str, str], message: messages.Message, number: int = 0) -> Taken:
    """A message as a recorder takes it from the bus."""
    key, payload = topic.at(cell=cell.name, **names), messages.encode(message)
    return Taken(message.stamp_ns + DELAY_NS, message.stamp_ns, topic, key, names, payload, PUBLISHER, number)


def on_the_bus(cell: cells.Cell, seed: int, seconds: float, frames: bool = True) -> Iterator[Taken]:
    """The messages of the emulator, as a recorder takes them."""
    for number, (topic, names, message) in enumerate(record(cell, seed, seconds, frames)):
        yield taken(cell, topic, names, message, number)


def entries(cell: cells.Cell, messages: Iterable[Taken], keeps_frames: bool = False) -> Iterator[Entry]:
    """The entries that a recorder writes for these messages."""
    viewers = Viewers(cell, keeps_frames)
    for each in messages:
        if each.topic is not topics.FRAME or keeps_frames:
            yield as_on_the_bus(each)
        yield from viewers.of(each)


def new_file(path: Path, cell: str = "table") -> File:
    """A new file with its first entries."""
    file = File(path, provenance.about(cell), provenance.attachments(cell), 10**18)
    for entry in Viewers(cells.load(cell)).stage(10**18):
        file.write(entry)
    return file


def recorded(path: Path, cell: str, messages: Iterable[Taken], keeps_frames: bool = False) -> Path:
    """Writes a complete recording of messages of a cell, and returns its path."""
    file = new_file(path, cell)
    for entry in entries(cells.load(cell), messages, keeps_frames):
        file.write(entry)
    file.close()
    return path
