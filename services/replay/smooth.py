"""Smooths the senses' poses: `services.fusion.smoother` on the poses of a file, or on poses computed from it now."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from penumbra.services.fusion.estimate import RefusedMeasurement, measured, stream_of
from penumbra.services.fusion.learning import Learned, learned
from penumbra.services.fusion.settings import Subject
from penumbra.services.fusion.smoother import NothingMeasuredError, Smoother
from penumbra.services.replay.chain import Heard
from penumbra.services.replay.tracks import Tracks, Writer
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import SmoothedPose
from penumbra.shared.contract.senses import SENSES
from penumbra.shared.contract.topics import Topic
from penumbra.shared.geometry import rigid
from penumbra.shared.recording.faults import RecordingError
from penumbra.shared.recording.reading import Played, Recording

BY_TOPIC = {sense.topic: sense for sense in SENSES}
READ = (*BY_TOPIC, topics.FUSED, topics.TRUTH)
"""Topics that are read to smooth the senses' poses of a recording."""


class Smoothing:
    """The smoothers of all targets of a cell: collects the senses' messages, and computes the poses."""

    def __init__(self, cell: cells.Cell):
        self._cell = cell
        self._smoothers = {name: Smoother(Subject.of(target, cell.body)) for name, target in cell.targets.items()}
        self.missing: dict[str, str] = {}

    def take(self, topic: Topic, names: dict[str, str], message: Any) -> None:
        """Add a message of a sense; other topics are ignored. Faulty messages are counted."""
        sense, smoother = BY_TOPIC.get(topic), self._smoothers.get(names.get("target", ""))
        if sense is None or smoother is None or (sense.usable is not None and message.state != sense.usable):
            return
        try:
            stream_of(sense, message, names["target"], self._cell)
            smoother.measure(sense.name, message.stamp_ns, *measured(message, sense.measures))
        except RefusedMeasurement as error:
            smoother.log.refused(sense.name, error.kind)

    def poses(self) -> Iterator[Heard]:
        """The smoothed poses of all targets, one target after the other, at the rate of the topic. A target without measurements
        is added to `missing`. Raises RecordingError if all targets are missing."""
        period_ns = round(1e9 / topics.SMOOTHED.rate_hz)
        for name, smoother in self._smoothers.items():
            try:
                trajectory = smoother.trajectory()
            except NothingMeasuredError as error:
                self.missing[name] = str(error)
                continue
            stamps_ns = np.arange(trajectory.begin_ns, trajectory.end_ns + 1, period_ns)
            for stamp_ns, estimate in zip(stamps_ns.tolist(), trajectory.estimates(stamps_ns), strict=True):
                position, orientation = rigid.position_orientation(estimate.T)
                message = SmoothedPose(
                    stamp_ns=stamp_ns,
                    target=name,
                    frame=self._cell.frame,
                    position=position,
                    orientation=orientation,
                    velocity=estimate.velocity,
                    covariance=estimate.covariance,
                    state=estimate.state,
                )
                yield Heard(stamp_ns, topics.SMOOTHED, {"target": name}, message)
        if len(self.missing) == len(self._smoothers):
            why = "; ".join(f"{name}: {reason}" for name, reason in self.missing.items())
            raise RecordingError(f"{why}; give --in-process to make them of what the sensors said, or record vision and haptic")

    def learned(self) -> Learned:
        """The motion of all targets. Raises RecordingError if there are too few measurements."""
        measured = [smoother for name, smoother in self._smoothers.items() if name not in self.missing]
        try:
            return learned(measured)
        except NothingMeasuredError as error:
            raise RecordingError(str(error)) from None

    def described(self) -> dict[str, Any]:
        """By target: counts of each sense's measurements, number of measurements that the gates refused but the smoother used,
        and number that passed the gates but were dismissed."""
        return {
            name: {
                "senses": {source: asdict(counts) for source, counts in smoother.log.counts.items()},
                "reinstated": smoother.reinstated,
                "dismissed": smoother.dismissed,
            }
            for name, smoother in self._smoothers.items()
            if name not in self.missing
        }


def smooth(
    recording: Iterable[Played], copied: Iterable[Recording], writer: Writer | None, smoothing: Smoothing
) -> dict[str, Any]:
    """Smooth the senses' poses of a recording, and describe the smoothed ones as `in_process.play` does. writer: a new recording
    with everything in the copied ones and the smoothed poses. Raises RecordingError if no sense has measured."""
    tracks = Tracks()
    for each in recording:
        smoothing.take(each.topic, each.names, each.message)
        if each.topic in (topics.FUSED, topics.TRUTH):
            tracks.then(each.topic, each.names, each.message)
    found = add(smoothing, tracks, writer, copied)
    return found | {"poses": tracks.described()}


def add(smoothing: Smoothing, tracks: Tracks, writer: Writer | None, copied: Iterable[Recording] = ()) -> dict[str, Any]:
    """Add the smoothed poses to the tracks and to a new recording, after everything in the copied ones."""
    items = list(smoothing.poses())
    if writer is not None:
        for each in copied:
            writer.copy(each)
    for item in items:
        tracks.now(item.topic, item.names, item.message)
        if writer is not None:
            writer.write(item)
    return {"measurements": smoothing.described(), "not_smoothed": smoothing.missing}
