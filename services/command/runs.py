"""Records of the launchers that `penumbra up` runs on this machine, and the logs of those in the background.

Both are under `$XDG_STATE_HOME/penumbra`, by default `~/.local/state/penumbra`.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from logging.handlers import RotatingFileHandler
from pathlib import Path

import psutil

LOG_BYTES = 5 << 20
"""Size [bytes] at which a log is rolled: the newest lines are in SERVICE.log, older ones in SERVICE.log.1 and so on."""
LOGS_KEPT = 3
BEGAN_S = 1.0
"""Maximum difference [s] between two readings of the same process's start time."""


@dataclass(frozen=True)
class Run:
    """A launcher: its process, that process's start time [s since the epoch], its cell, the endpoints at which the processes
    meet, the folder of certificates, the folder of logs if it runs in the background, and the cell's file."""

    pid: int
    began: float
    cell: str
    connect: tuple[str, ...]
    secure: str | None = None
    logs: str | None = None
    file: str | None = None


def folder() -> Path:
    """Folder of records and logs. Raises RuntimeError for a user without a home."""
    state = os.environ.get("XDG_STATE_HOME")
    return (Path(state) if state else Path.home() / ".local" / "state") / "penumbra"


def logs_of(cell: str) -> Path:
    """The folder of a cell's logs."""
    return folder() / "logs" / cell


@contextlib.contextmanager
def recorded(cell: str, file: Path, connect: tuple[str, ...], secure: Path | None, logs: Path | None) -> Iterator[None]:
    """Context in which `penumbra ps` and `penumbra down` find this launcher, and commands that look find its cell's file. If
    nothing can be written they do not, but the launcher runs."""
    run = Run(os.getpid(), psutil.Process().create_time(), cell, connect, str(secure) if secure else None,
              str(logs) if logs else None, str(file.resolve()))  # fmt: skip
    path = None
    with contextlib.suppress(OSError, RuntimeError):
        path = folder() / "run" / f"{run.pid}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.write_text(json.dumps(asdict(run)))
        part.replace(path)
    try:
        yield
    finally:
        if path is not None:
            with contextlib.suppress(OSError):
                path.unlink()


def running() -> list[Run]:
    """The running launchers, sorted by cell; stale records are removed."""
    found = []
    try:
        paths = sorted((folder() / "run").glob("*.json"))
    except RuntimeError:
        return []
    for path in paths:
        try:
            fields = json.loads(path.read_text())
            run = Run(**{**fields, "connect": tuple(fields["connect"])})
            is_it = abs(psutil.Process(run.pid).create_time() - run.began) < BEGAN_S
        except (OSError, ValueError, TypeError, KeyError, psutil.Error):
            is_it = False
        if is_it:
            found.append(run)
        else:
            with contextlib.suppress(OSError):
                path.unlink()
    return sorted(found, key=lambda run: (run.cell, run.pid))


class Logs:
    """The rolled log files of a cell's services."""

    def __init__(self, where: Path):
        self.where = where
        where.mkdir(parents=True, exist_ok=True)
        self._files: dict[str, RotatingFileHandler] = {}

    def write(self, service: str, line: str) -> None:
        """Add a line to the log of a service. Processes of one service share a file."""
        if service not in self._files:
            path = self.where / f"{service}.log"
            self._files[service] = RotatingFileHandler(path, maxBytes=LOG_BYTES, backupCount=LOGS_KEPT, encoding="utf-8")
        self._files[service].handle(logging.makeLogRecord({"msg": line.rstrip("\n")}))
