"""Replays the sensors of a recording through the current methods, in one process, and compares the result with the recording."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from penumbra.services.replay import smooth
from penumbra.services.replay.chain import SERVICES, Heard, Replay
from penumbra.services.replay.live import SENSORS
from penumbra.services.replay.smooth import Smoothing
from penumbra.services.replay.tracks import Tracks, Writer
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.recording.reading import Played

RESULTS = (topics.VISION, topics.HAPTIC, topics.FUSED)


def play(
    cell: cells.Cell,
    recording: Iterable[Played],
    arguments: Mapping[str, Sequence[str]],
    services: Sequence[str] = SERVICES,
    writer: Writer | None = None,
    smoothing: Smoothing | None = None,
) -> dict[str, Any]:
    """Play the sensors' messages, and describe the resulting poses (`Tracks.described`). writer: a new recording of the sensors'
    messages and the results. smoothing: smooths the senses' results. Raises RecordingError if there are none."""
    tracks = Tracks()

    def hear(item: Heard) -> None:
        if item.topic in RESULTS:
            tracks.now(item.topic, item.names, item.message)
        if smoothing is not None:
            smoothing.take(item.topic, item.names, item.message)
        if writer is not None:
            writer.write(item)

    def sensors() -> Iterator[Played]:
        for each in recording:
            if each.topic in SENSORS:
                yield each
            elif each.topic in (*RESULTS, topics.TRUTH):
                tracks.then(each.topic, each.names, each.message)

    Replay(cell, services, arguments, hear).run_recorded(sensors())
    found = smooth.add(smoothing, tracks, writer) if smoothing is not None else {}
    return found | {"poses": tracks.described()}
