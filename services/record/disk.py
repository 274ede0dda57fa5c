"""Recording files on a disk: a file ends complete at a maximum size, at a maximum age, and before the disk is full."""

from __future__ import annotations

import itertools
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from penumbra.shared.recording.entries import Entry
from penumbra.shared.recording.file import File
from penumbra.shared.runtime.logs import Log

AGAIN_S = 1.0
"""Period [s] of attempts to write to a full disk again; recording resumes at most this late."""


@dataclass(frozen=True)
class Limits:
    """roll_bytes, roll_s: size and age at which a file ends and the next one begins. free_bytes: space that stays free on the
    disk."""

    roll_bytes: float
    roll_s: float
    free_bytes: float


class Disk:
    """Writes a sequence of recording files. out: a file (.mcap), with numbers appended for the following ones, or a folder, in
    which files are named by cell and time. about, attached: metadata and attachments of each file. stage: the first entries of
    each file, at a time [ns].

    fault: why nothing is written now; empty if all is well. bytes, messages, files: written so far. lost: number of messages that
    were not written because the disk was full.
    """

    def __init__(
        self,
        out: Path,
        cell: str,
        about: Mapping[str, Mapping[str, str]],
        attached: Mapping[str, bytes],
        stage: Callable[[int], Iterable[Entry]],
        limits: Limits,
        log: Log,
    ):
        self._out, self._cell, self._about, self._attached = out, cell, about, attached
        self._stage, self._limits, self._log = stage, limits, log
        self._file: File | None = None
        self._began_s = self._tried_s = float("-inf")
        self._bytes = 0
        self.fault, self.name = "", ""
        self.messages = self.files = self.lost = 0

    @property
    def bytes(self) -> int:
        return self._bytes + (self._file.size if self._file else 0)

    @property
    def folder(self) -> Path:
        """Folder of the files."""
        return self._out.parent if self._out.suffix == ".mcap" else self._out

    def check(self) -> None:
        """Raise OSError if no file can be made."""
        self.folder.mkdir(parents=True, exist_ok=True)
        probe = next(self._names())
        probe.open("x").close()
        probe.unlink()

    def write(self, entries: Iterable[Entry], now_ns: int) -> None:
        """Write entries, to the next file if the current one is due to end. A file begins with its first entry: where nothing
        comes, none is left. Entries are lost, and counted, while the disk is full."""
        now_s = time.monotonic()
        file = self._file
        if file is not None and (file.size >= self._limits.roll_bytes or now_s - self._began_s >= self._limits.roll_s):
            self.close()
        waiting = iter(entries)
        if (first := next(waiting, None)) is None:
            return
        waiting = itertools.chain([first], waiting)
        if self._file is None and now_s - self._tried_s >= AGAIN_S:
            self._begin(now_ns, now_s)
        if self._file is not None:
            try:
                for entry in waiting:
                    self._file.write(entry)
                    self.messages += 1
            except OSError as error:
                self._fail(self._file, error)
        self.lost += sum(1 for _ in waiting)

    def flush(self) -> None:
        """Flush to the kernel; ends the file before the disk is full."""
        if self._file is None:
            return
        try:
            self._file.flush()
        except OSError as error:
            self._fail(self._file, error)
            return
        if not self._has_room():
            self.close()
            self._pause(f"less than {self._limits.free_bytes / 1e6:g} MB are free in {self.folder}")

    def save(self, entries: Iterable[Entry], now_ns: int) -> Path:
        """Write entries to a separate file. Raises OSError if the disk has no room for it."""
        if not self._has_room():
            raise OSError(28, f"less than {self._limits.free_bytes / 1e6:g} MB are free in {self.folder}")
        file = self._new(now_ns)
        try:
            for entry in entries:
                file.write(entry)
                self.messages += 1
            file.close()
        except OSError:
            file.cut()
            raise
        finally:
            self._bytes += file.size
        return file.path

    def sync(self) -> None:
        """Sync the kernel's data to the disk. Any thread may call it."""
        if (file := self._file) is not None:
            with suppress(OSError):  # closed meanwhile, or full: `flush` finds out
                file.sync()

    def close(self) -> None:
        """End the open file."""
        if (file := self._file) is None:
            return
        try:
            file.close()
        except OSError as error:
            self._fail(file, error)
            return
        self._ended(file)

    def _begin(self, now_ns: int, now_s: float) -> None:
        self._tried_s = now_s
        if not self._has_room():
            self._pause(f"less than {self._limits.free_bytes / 1e6:g} MB are free in {self.folder}")
            return
        try:
            self._file = self._new(now_ns)
        except OSError as error:
            self._pause(f"{self.folder}: {error.strerror}")
            return
        self._began_s = now_s
        self._log.info("recording" if not self.fault else "recording again", file=str(self._file.path))
        self.fault = ""

    def _new(self, now_ns: int) -> File:
        for path in self._names():
            try:
                file = File(path, self._about, self._attached, now_ns)
            except FileExistsError:
                continue
            self.name, self.files = str(path), self.files + 1
            try:
                for entry in self._stage(now_ns):
                    file.write(entry)
                file.flush()
            except OSError:
                file.cut()
                raise
            return file
        raise AssertionError("names have no end")

    def _names(self) -> Iterator[Path]:
        """Unused paths for the next file, as far as one can know."""
        first = self._out
        if first.suffix != ".mcap":
            first = self._out / f"{self._cell}-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
        number = 1
        while True:
            path = first if number == 1 else first.with_stem(f"{first.stem}-{number}")
            if not path.exists():
                yield path
            number += 1

    def _has_room(self) -> bool:
        return shutil.disk_usage(self.folder).free >= self._limits.free_bytes

    def _fail(self, file: File, error: OSError) -> None:
        """Handle a write error in the middle of a file."""
        with suppress(OSError):
            file.cut()
        self._ended(file)
        self._pause(f"{file.path}: {error.strerror}")

    def _ended(self, file: File) -> None:
        self._bytes += file.size
        self._file = None
        self._tried_s = float("-inf")

    def _pause(self, why: str) -> None:
        self._tried_s = time.monotonic()
        if not self.fault:
            self._log.error("recording pauses until there is room again; the file before is whole", why=why)
        self.fault = why
