"""Converts messages from the bus to entries of a recording, on a disk or in memory."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from penumbra.services.record.disk import Disk
from penumbra.services.record.last import Last
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import BadMessage, FusedPose, decode
from penumbra.shared.recording.entries import Entry, as_on_the_bus
from penumbra.shared.recording.foxglove import Viewers
from penumbra.shared.runtime.logs import Log
from penumbra.shared.runtime.tap import Taken, Tap

FLUSH_TURNS = 4
"""Number of turns after which received data is flushed to the kernel."""
AFTER_S = 2.0
"""Time [s] after a loss at which the last seconds are written, so that they include its aftermath."""
SAVE_S = 60.0
"""Maximum time [s] to wait for a requested file."""


class Recorder:
    """Records a bus. One thread calls `turn`; others may call the rest.

    tap: source of the messages. keeps_frames: whether frames are also kept raw. disk: where files are written. last: keeps the
    last seconds, which become a file on request; None: everything is written to the disk. now_ns: the clock.
    """

    def __init__(
        self, tap: Tap, viewers: Viewers, keeps_frames: bool, disk: Disk, last: Last | None, now_ns: Callable[[], int], log: Log
    ):
        self._tap, self._viewers, self._keeps_frames = tap, viewers, keeps_frames
        self._disk, self._last, self._now_ns, self._log = disk, last, now_ns, log
        self._turns = 0
        self._unshown: dict[str, int] = {}
        self._states: dict[str, str] = {}
        self._lost_s = self._saved_s = float("-inf")
        self._wishes: list[Wish] = []
        self._lock = threading.Lock()  # of turns; `close` runs the last one

    def turn(self) -> None:
        """Record the messages since the last turn."""
        with self._lock:
            taken = self._tap.take()
            if self._last is None:
                self._disk.write(self._entries(taken), self._now_ns())
                self._turns += 1
                if self._turns % FLUSH_TURNS == 0:
                    self._disk.flush()
                return
            self._last.add(self._entries(taken))
            self._watch(taken)
            wishes, self._wishes = self._wishes, []
            if wishes or self._is_loss_due():
                file, why = self._save(self._last)
                for wish in wishes:
                    wish.grant(file, why)

    def answer(self, payload: bytes) -> dict[str, Any]:
        """Answer `penumbra record save`: write the last seconds; returns the file. Raises ValueError if that is not possible."""
        try:
            command = json.loads(payload)["command"]
        except (ValueError, KeyError, TypeError):
            command = payload[:60]
        if command != "save":
            raise ValueError(f'expected {{"command": "save"}}, got {command!r}')
        if self._last is None:
            raise ValueError(f"this recorder writes all to {self._disk.folder}: only one with --last keeps anything back")
        with self._lock:
            self._wishes.append(wish := Wish())
        return {"file": wish.wait(SAVE_S), "seconds": round(self._last.span_s, 1)}

    def close(self) -> None:
        """Write the remaining messages, and end the file."""
        self.turn()
        with self._lock:
            self._disk.close()
            if self._last is None and not self._disk.files:
                self._log.warning("nothing was recorded, and no file written")

    def describe(self) -> dict[str, Any]:
        """For the health report."""
        kept = {"kept_s": round(self._last.span_s, 1), "kept_bytes": self._last.bytes} if self._last is not None else {}
        return {
            "file": self._disk.name,
            "files": self._disk.files,
            "bytes": self._disk.bytes,
            "messages": self._disk.messages,
            "lost": self._disk.lost + self._tap.lost,
            "unshown": dict(self._unshown),
            **kept,
        }

    def reasons(self) -> list[str]:
        """Why not everything is recorded."""
        return [f"not recording: {self._disk.fault}"] if self._disk.fault else []

    def _entries(self, taken: Iterable[Taken]) -> Iterator[Entry]:
        """The bytes of each message, and its form for viewers. A frame is kept only as a picture, unless frames are kept raw."""
        for each in taken:
            is_shown = True
            shown: list[Entry] = []
            try:
                shown = list(self._viewers.of(each))
            except BadMessage as error:
                self._unshown[error.kind] = self._unshown.get(error.kind, 0) + 1
                is_shown = False
            if each.topic is not topics.FRAME or self._keeps_frames or not is_shown:
                yield as_on_the_bus(each)
            yield from shown

    def _watch(self, taken: Iterable[Taken]) -> None:
        """Note when a target becomes lost."""
        for each in taken:
            if each.topic is topics.FUSED:
                try:
                    state = decode(FusedPose, each.payload).state
                except BadMessage:
                    continue
                if state == "lost" and self._states.get(each.key, "lost") != "lost":
                    self._lost_s = time.monotonic()
                    self._log.warning("lost: the last seconds will be written", key=each.key)
                self._states[each.key] = state

    def _is_loss_due(self) -> bool:
        """Whether the last seconds are to be written after a loss. Within the duration of the last file they wait, so that no two
        files show the same."""
        assert self._last is not None, "without --last everything is written"
        now_s = time.monotonic()
        is_due = now_s - self._lost_s >= AFTER_S and self._lost_s > self._saved_s
        return is_due and now_s - self._saved_s >= self._last.seconds

    def _save(self, last: Last) -> tuple[str, str]:
        """Write the last seconds; returns the file, or the reason why there is none."""
        self._saved_s = time.monotonic()
        try:
            path = self._disk.save(last.all(), self._now_ns())
        except OSError as error:
            self._log.error("the last seconds cannot be written", why=str(error))
            return "", f"the last seconds cannot be written: {error}"
        self._log.info("the last seconds are written", file=str(path), seconds=round(last.span_s, 1))
        return str(path), ""


class Wish:
    """A requested file and its waiting requester."""

    def __init__(self) -> None:
        self._is_granted = threading.Event()
        self._file = self._why = ""

    def grant(self, file: str, why: str) -> None:
        self._file, self._why = file, why
        self._is_granted.set()

    def wait(self, seconds: float) -> str:
        """Wait for the file. Raises ValueError if there is none."""
        if not self._is_granted.wait(seconds):
            raise ValueError(f"the file was not written within {seconds:g} s: is the disk slow?")
        if self._why:
            raise ValueError(self._why)
        return self._file
