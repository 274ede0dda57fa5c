"""Results of a replay compared with the recording: tracks of poses, and a new recording."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from penumbra.services.replay.chain import Heard
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import Message, encode
from penumbra.shared.contract.topics import Topic
from penumbra.shared.recording.entries import as_on_the_bus
from penumbra.shared.recording.file import File
from penumbra.shared.recording.foxglove import Viewers
from penumbra.shared.recording.reading import Recording
from penumbra.shared.runtime.tap import Taken

NEAR_S = 0.02
"""Maximum difference [s] between stamps of poses of the same moment."""
SMOOTHED = topics.SMOOTHED.key.rpartition("{target}")[2]
"""Suffix of the channels of smoothed poses, including those for viewers."""


class Track:
    """Stamps, positions and states of the poses of one topic, and a digest of their bytes in order."""

    def __init__(self) -> None:
        self.stamps_ns: list[int] = []
        self.positions: list[list[float]] = []
        self.states: list[str] = []
        self._digest = hashlib.sha256()

    def add(self, message: Any) -> None:
        self.stamps_ns.append(message.stamp_ns)
        self.positions.append(message.position.tolist())
        self.states.append(getattr(message, "state", ""))
        self._digest.update(encode(message))

    def described(self) -> dict[str, Any]:
        """Number of messages, share of each state, and the digest."""
        shares = {state: round(self.states.count(state) / len(self.states), 4) for state in sorted(set(self.states))}
        return {"messages": len(self.states), "states": shares, "sha256": self._digest.hexdigest()}

    def apart_mm(self, other: Track) -> dict[str, float] | None:
        """Distances [mm] between positions and those of another track at the same moments: median and maximum; None if at no
        moment both are valid."""
        if not self.stamps_ns or not other.stamps_ns:
            return None
        order = np.argsort(other.stamps_ns, kind="stable")
        theirs, stamps = np.array(other.stamps_ns)[order], np.array(self.stamps_ns)
        after = np.clip(np.searchsorted(theirs, stamps), 1, len(theirs) - 1) if len(theirs) > 1 else np.zeros(len(stamps), int)
        before = np.maximum(after - 1, 0)
        nearest = np.where(np.abs(theirs[before] - stamps) <= np.abs(theirs[after] - stamps), before, after)
        lost = {"lost", "out_of_range", "unidentified", "object", "occluded"}
        are_good = np.array([state not in lost for state in self.states])
        are_good &= np.array([other.states[i] not in lost for i in order])[nearest]
        are_good &= np.abs(theirs[nearest] - stamps) < NEAR_S * 1e9
        if not are_good.any():
            return None
        off = np.linalg.norm(np.array(self.positions) - np.array(other.positions)[order][nearest], axis=1)[are_good]
        return {"median": round(1e3 * float(np.median(off)), 3), "largest": round(1e3 * float(off.max()), 3)}


class Tracks:
    """The replayed and the recorded tracks, by topic and target."""

    def __init__(self) -> None:
        self._now: dict[tuple[str, str], Track] = {}
        self._then: dict[tuple[str, str], Track] = {}

    def now(self, topic: Topic, names: Mapping[str, str], message: Message) -> None:
        """Add a replayed pose."""
        self._now.setdefault((topic.name, names["target"]), Track()).add(message)

    def then(self, topic: Topic, names: Mapping[str, str], message: Message) -> None:
        """Add a recorded pose, or a recorded truth."""
        self._then.setdefault((topic.name, names["target"]), Track()).add(message)

    def described(self) -> dict[str, dict[str, Any]]:
        """For each topic and target of the replayed poses: number, states and digest, and their distances from the recorded ones
        and from the truth [mm]. Smoothed poses, which no recorder records, are compared with the fused ones."""
        found = {}
        for (name, target), track in sorted(self._now.items()):
            truth = self._then.get((topics.TRUTH.name, target), Track())
            before = topics.FUSED.name if name == topics.SMOOTHED.name else name
            recorded = self._then.get((before, target))
            found[f"{name} {target}"] = track.described() | {
                "from_recorded_mm": track.apart_mm(recorded) if recorded else None,
                "from_truth_mm": track.apart_mm(truth),
                "recorded_from_truth_mm": recorded.apart_mm(truth) if recorded else None,
            }
        return found


class Writer:
    """A new recording of replayed messages, with its metadata `about` and attachments."""

    def __init__(self, cell: cells.Cell, out: Path, about: Mapping[str, Mapping[str, str]], attached: Mapping[str, bytes]):
        self._cell, self._out, self._about, self._attached = cell, out, about, attached
        self._viewers = Viewers(cell)
        self._file: File | None = None

    def write(self, item: Heard) -> None:
        if self._file is None:
            self._file = File(self._out, self._about, self._attached, item.time_ns)
            for entry in self._viewers.stage(item.time_ns):
                self._file.write(entry)
        key = item.topic.at(cell=self._cell.name, **item.names)
        taken = Taken(item.time_ns, item.message.stamp_ns, item.topic, key, item.names, encode(item.message))
        if item.topic is not topics.FRAME:
            self._file.write(as_on_the_bus(taken))
        for entry in self._viewers.of(taken):
            self._file.write(entry)

    def copy(self, recording: Recording) -> None:
        """Copy all of a recording except smoothed poses."""
        for entry in recording.entries():
            if self._file is None:
                self._file = File(self._out, self._about, self._attached, entry.log_ns)
            if not entry.channel.topic.endswith(SMOOTHED):
                self._file.write(entry)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
