"""Commands for the processes on this machine: `penumbra ps`, `logs` and `down`."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
from bisect import bisect_right
from collections.abc import Collection, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import psutil
from click.shell_completion import CompletionItem

from penumbra.services import flags
from penumbra.services.command import runs
from penumbra.services.command.look import console, open_session
from penumbra.services.command.runs import Run
from penumbra.shared.contract import report, topics
from penumbra.shared.contract.processes import LAUNCHER
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.logs import time_of

MEASURED_S = 0.2
"""Time [s] over which CPU is measured."""
ANSWER_S = 0.5
ENDS_S = 10.0
"""Time [s] that a launcher has to end its processes; then it is killed together with them."""
LOOK_S = 0.2


@dataclass(frozen=True)
class Row:
    """One process. `cpu`: cores; `uptime_s`: time since its start."""

    cell: str
    process: str
    pid: int
    state: str
    cpu: float
    memory_mb: float
    uptime_s: float
    restarts: int = 0
    note: str = ""


@flags.command(
    "ps",
    "Shows the cells that `penumbra up` runs on this machine, and their processes.",
    flags.JSON,
    example="penumbra ps\npenumbra ps --json",
)
def ps(options: flags.Options) -> None:
    """Print a row per process."""
    found = [row for run in runs.running() for row in rows(run)]
    if options.json:
        print(json.dumps([asdict(row) for row in found]))
    elif not found:
        print("no cell runs on this machine: start one with `penumbra up`")
    else:
        from rich.markup import escape
        from rich.table import Table

        table = Table("cell", "process", "pid", "state", "CPU %", "MB", "up", "restarts", "", box=None)
        for row in found:
            table.add_row(row.cell, row.process, str(row.pid), row.state, f"{100 * row.cpu:.0f}", f"{row.memory_mb:.0f}",
                          _duration(row.uptime_s), str(row.restarts), escape(row.note))  # fmt: skip
        console().print(table)


def rows(run: Run) -> list[Row]:
    """The launcher of a cell and its processes: their states from the launcher's report, the rest from the operating system."""
    known: dict[str, dict[str, Any]] = {LAUNCHER.name: {"pid": run.pid, "state": "running"}}
    try:
        known |= _reported(run)
    except bus.BusError as error:
        known[LAUNCHER.name]["note"] = str(error).partition("\n")[0]
    measured: dict[str, psutil.Process] = {}
    for name, fields in known.items():
        with contextlib.suppress(psutil.Error):
            if fields.get("pid"):
                measured[name] = psutil.Process(fields["pid"])
                measured[name].cpu_percent()
    time.sleep(MEASURED_S)
    out = []
    for name, process in measured.items():
        with contextlib.suppress(psutil.Error):
            fields = known[name]
            memory_mb, age_s = process.memory_info().rss / 1e6, time.time() - process.create_time()
            out.append(Row(run.cell, name, process.pid, str(fields["state"]), process.cpu_percent() / 100, memory_mb, age_s,
                           int(fields.get("restarts", 0)), str(fields.get("note", ""))))  # fmt: skip
    return out


def _reported(run: Run) -> dict[str, dict[str, Any]]:
    """The launcher's report of its processes. Raises BusError if it cannot be reached."""
    connection = bus.Connection(connect=run.connect, secure=Path(run.secure) if run.secure else None)
    with open_session(connection, ANSWER_S) as session:
        for answer in bus.ask(session, topics.health(run.cell, LAUNCHER.name), timeout_s=ANSWER_S):
            found = report.read(answer)
            if found.pid == run.pid:
                return dict(found.report.get("processes", {}))
    return {}


def _duration(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def complete_cell(ctx: object, param: object, incomplete: str) -> list[CompletionItem]:
    """The running cells."""
    return [CompletionItem(run.cell) for run in runs.running() if run.cell.startswith(incomplete)]


@flags.command(
    "down",
    "Ends a cell that `penumbra up` runs on this machine.",
    flags.Argument("cell", required=False, shell_complete=complete_cell, help="its name; the one that runs where none is named"),
    example="penumbra down table",
)
def down(options: flags.Options) -> None:
    """Return when no process of the cell runs any more."""
    for run in _chosen(options.cell):
        with contextlib.suppress(psutil.NoSuchProcess):
            launcher = psutil.Process(run.pid)
            os.kill(run.pid, signal.SIGTERM)
            if psutil.wait_procs([launcher], ENDS_S)[1]:
                launcher.kill()
                launcher.wait()
        print(f"{run.cell}: ended (pid {run.pid})")


def _chosen(cell: str | None) -> list[Run]:
    """The runs of a cell, or without a name those of the only one. Raises BusError if there are none, or several cells."""
    found = runs.running()
    names = sorted({run.cell for run in found})
    if not found:
        raise bus.BusError("no cell runs on this machine: start one with `penumbra up`")
    if cell is None and len(names) > 1:
        raise bus.BusError(f"expected the name of a cell, got none; choose one of {', '.join(names)}")
    if cell is not None and cell not in names:
        raise bus.BusError(f"expected a cell that runs on this machine, got {cell!r}; choose one of {', '.join(names)}")
    return [run for run in found if cell in (None, run.cell)]


@flags.command(
    "logs",
    "Prints what the processes of a cell have logged, in the order of time, of one that was started with `penumbra up --detach`.",
    flags.Argument("service", nargs=-1, shell_complete=flags.complete_service, help="only of these; of all where none is named"),
    flags.Option("-f", "--follow", is_flag=True, help="go on with what is logged from now on, until Ctrl-C"),
    flags.Option("-n", "--lines", type=flags.natural, default=100, help="how many of the newest lines"),
    flags.Option("--cell", shell_complete=complete_cell, show_default="the only one with logs", help="the cell's name"),
    example="penumbra logs\npenumbra logs -f fusion",
)
def logs(options: flags.Options) -> None:
    """Print the newest lines, and follow."""
    where = _folder(options.cell)
    names = sorted(path.stem for path in where.glob("*.log"))
    if unknown := [name for name in options.service if name not in names]:
        raise bus.BusError(f"{where}: expected the log of one of {', '.join(names)}, got {unknown[0]!r}")
    merged = Merged(where, options.service)
    lines = merged.read()
    _show(lines[max(0, len(lines) - options.lines) :], merged.width)
    while options.follow:
        time.sleep(LOOK_S)
        _show(merged.settled(), merged.width)


def _show(lines: list[Line], width: int) -> None:
    """Print lines. width: of the services' names, which are left out if it is 0."""
    for line in lines:
        print(f"{line.service:{width}} | {line.text}" if width else line.text)
    sys.stdout.flush()


def _folder(cell: str | None) -> Path:
    """The folder of a cell's logs. Raises BusError if the cell is ambiguous or unknown."""
    base = runs.logs_of("")
    names = sorted(path.name for path in base.glob("*") if any(path.glob("*.log")))
    if not names:
        raise bus.BusError("no logs on this machine: `penumbra up --detach` keeps them")
    if cell is None:
        running = sorted({run.cell for run in runs.running() if run.logs})
        if len(running or names) > 1:
            raise bus.BusError(f"expected --cell, got none; choose one of {', '.join(running or names)}")
        cell = (running or names)[0]
    if cell not in names:
        raise bus.BusError(f"--cell: expected a cell with logs, one of {', '.join(names)}, got {cell!r}")
    return base / cell


class Line(NamedTuple):
    """A line of a service's log. time: as written in the line, or that of the previous line if it has none."""

    time: str
    service: str
    text: str


class Merged:
    """The lines of a cell's logs in the order of their times. only: services; an empty collection stands for all, including those
    that begin to log later."""

    def __init__(self, where: Path, only: Collection[str]):
        self._where, self._only = where, only
        self._tails: dict[str, Tail] = {}
        self._times: dict[str, str] = {}
        self._waiting: list[Line] = []

    @property
    def width(self) -> int:
        """Width of the services' names; 0 if there is only one service."""
        return max(map(len, self._tails)) if len(self._tails) > 1 else 0

    def read(self) -> list[Line]:
        """The lines since the last call."""
        for path in self._where.glob("*.log"):
            if path.stem not in self._tails and (not self._only or path.stem in self._only):
                self._tails[path.stem] = Tail(path)
        lines = [self._line(name, text) for name, tail in self._tails.items() for text in tail.read()]
        return sorted(lines, key=lambda line: line.time)

    def settled(self) -> list[Line]:
        """The lines not newer than those of the previous call: a service's line may appear in its file slightly later than a
        newer line of another service."""
        last = self._waiting[-1].time if self._waiting else ""
        lines = sorted(self._waiting + self.read(), key=lambda line: line.time)
        count = bisect_right(lines, last, key=lambda line: line.time)
        self._waiting = lines[count:]
        return lines[:count]

    def _line(self, service: str, text: str) -> Line:
        at = self._times[service] = time_of(text) or self._times.get(service, "")
        return Line(at, service, text.rstrip())


class Tail:
    """The new lines of a log file at each call, also after it was rolled."""

    def __init__(self, path: Path):
        self._path = path
        self._file = path.open(errors="replace")
        self._rest = ""

    def read(self) -> Iterator[str]:
        """The new complete lines."""
        yield from self._lines()
        with contextlib.suppress(OSError):
            if os.fstat(self._file.fileno()).st_ino != self._path.stat().st_ino:
                self._file.close()
                self._file = self._path.open(errors="replace")
                yield from self._lines()

    def _lines(self) -> Iterator[str]:
        *lines, self._rest = (self._rest + self._file.read()).split("\n")
        yield from lines
