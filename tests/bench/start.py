"""`penumbra bench start`: how long `penumbra up` takes to a tracked pose, cold and warm, and how much of it is compiling.

Cold: a copy of this checkout in which nothing is compiled and nothing cached, with the caches of a home of its own. Warm: the
same copy once more. Times run from before the launcher is started until this process receives a service's first message: for
fusion the first pose that is `tracking`; for a process that publishes nothing, until it is alive on the bus. A service's
compiling CPU is what its processes used until then, cold minus warm.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import psutil
import zenoh
from rich.table import Table

from penumbra.services import flags
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, processes, topics
from penumbra.tests.bench.lib import results
from penumbra.tests.bench.lib.results import ROOT, Part, Result, marked
from penumbra.tests.support.live import connect, free_port, penumbra_command, service_of

LEFT_OUT = ("__pycache__", ".*", "build", "runs", "*.egg-info")
"""Patterns of files that a fresh clone does not hold: everything compiled or cached."""
PATIENCE_S = 300.0
"""Time [s] after which a start that is not complete counts as failed."""
LOOK_S = 0.01
MEASURE_S = 0.2
"""Period [s] at which the processes' CPU times are read: every 10 ms it took half a core of the two in use."""
GOALS_S = {"cold_s": 10.0, "warm_s": 3.0}
"""Goals for the time [s] to a tracked pose."""


class Failed(RuntimeError):
    """A start ended before every process was seen on the bus; the text holds the end of the launcher's log."""


@dataclass
class Start:
    """One start. `seconds` and `cpu_s` until each process' first message, by the name of its row in the table."""

    seconds: dict[str, float] = field(default_factory=dict)
    cpu_s: dict[str, float] = field(default_factory=dict)

    @property
    def tracking_s(self) -> float:
        return self.seconds["fusion"]


class Listener:
    """Receives the first message of every process of a cell, from the router at a port of loopback."""

    def __init__(self, cell: cells.Cell, port: int):
        self._cell, self.first_s = cell, dict[str, float]()
        self._session = connect(port)
        self._tokens = self._session.liveliness().declare_subscriber(topics.alive(cell.name), self._on_token, history=True)
        for topic in topics.TOPICS:
            subscriber = self._session.declare_subscriber(topic.at(cell=cell.name), zenoh.handlers.RingChannel(1))
            threading.Thread(target=self._listen, args=(topic, subscriber), daemon=True).start()

    def close(self) -> None:
        self._session.close()

    def _on_token(self, sample: zenoh.Sample) -> None:
        service = str(sample.key_expr).split("/")[-2]
        if not any(service in topic.publishers for topic in topics.TOPICS):
            self.first_s.setdefault(service, time.monotonic())

    def _listen(self, topic: topics.Topic, subscriber: Any) -> None:
        with contextlib.suppress(zenoh.ZError):  # the session is closed
            for sample in subscriber:
                if topic is topics.FUSED:
                    if messages.decode(messages.FusedPose, sample.payload.to_bytes()).state != "tracking":
                        continue
                    self.first_s.setdefault("fusion", time.monotonic())
                else:  # of two possible publishers one runs: posecnn in place of search, skin beside the emulator
                    self.first_s.setdefault(next(name for name in topic.publishers if name in self.names), time.monotonic())
                subscriber.undeclare()
                return

    @property
    def is_done(self) -> bool:
        """Whether every process has been seen on the bus."""
        return self.first_s.keys() >= set(self.names)

    @property
    def names(self) -> list[str]:
        """The processes that `penumbra up` starts for the cell."""
        chosen = (None, processes.VISION[0])
        return [
            process.name
            for process in processes.PROCESSES
            if process.replicas and process.vision in chosen and process.is_needed(self._cell)
        ]


def start(folder: Path, cell: str, seed: int, home: Path) -> Start:
    """Starts the cell from the checkout in `folder`, and ends it when all processes have been seen. Raises Failed."""
    port = free_port()
    environment = {name: value for name, value in os.environ.items() if name != "PENUMBRA_CACHE"}
    environment |= {"PYTHONPATH": str(folder), "XDG_CACHE_HOME": str(home)}
    command = penumbra_command("up", "--cell", cell, "--seed", str(seed), "--port", str(port))
    with tempfile.TemporaryFile("w+") as log:
        began_s = time.monotonic()
        launcher = subprocess.Popen(
            command, env=environment, cwd=home, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
        )
        try:
            _until(lambda: _listens(port) or launcher.poll() is not None, began_s + PATIENCE_S)
            if launcher.poll() is not None:
                raise Failed(f"the launcher of cell {cell} ended: {_words(log)}")
            listener = Listener(cells.load(cell), port)
            used_s = _until_done(listener, launcher)
        finally:
            launcher.terminate()
            launcher.wait()
        listener.close()
        if not listener.is_done:
            missing = ", ".join(sorted(set(listener.names) - listener.first_s.keys()))
            raise Failed(f"nothing of {missing} in cell {cell} within {PATIENCE_S:.0f} s: {_words(log)}")
    names = [name for name in (*listener.names, processes.LAUNCHER.name) if name in listener.first_s]
    return Start(
        {name: round(listener.first_s[name] - began_s, 3) for name in names}, {name: used_s.get(name, 0.0) for name in names}
    )


def _until(is_done: Callable[[], bool], deadline_s: float, period_s: float = LOOK_S) -> None:
    """Waits until a condition holds, checked each period, or until a deadline of the monotonic clock."""
    while not is_done() and time.monotonic() < deadline_s:
        time.sleep(period_s)


def _listens(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
        return True
    return False


def _words(log: IO[str]) -> str:
    """The end of a launcher's log."""
    log.seek(0)
    return log.read()[-2000:]


def _until_done(listener: Listener, launcher: subprocess.Popen[bytes]) -> dict[str, float]:
    """CPU [s] of each service's processes at its first message; returns when all have been seen."""
    used_s: dict[str, float] = {}
    known: dict[int, tuple[str, psutil.Process]] = {}

    def is_over() -> bool:
        _measure(listener, launcher, known, used_s)
        return listener.is_done or launcher.poll() is not None

    _until(is_over, time.monotonic() + PATIENCE_S, MEASURE_S)
    return used_s


def _measure(
    listener: Listener, launcher: subprocess.Popen[bytes], known: dict[int, tuple[str, psutil.Process]], used_s: dict[str, float]
) -> None:
    with contextlib.suppress(psutil.NoSuchProcess):
        for child in psutil.Process(launcher.pid).children():
            if child.pid not in known and (name := service_of(child)):
                known[child.pid] = name, child
        known[launcher.pid] = processes.LAUNCHER.name, psutil.Process(launcher.pid)
    now_s: dict[str, float] = {}
    for name, child in known.values():
        with contextlib.suppress(psutil.NoSuchProcess):
            times = child.cpu_times()
            now_s[name] = now_s.get(name, 0.0) + times.user + times.system
    for name, seconds in now_s.items():
        if name not in listener.first_s or name not in used_s:
            used_s[name] = seconds


@contextlib.contextmanager
def fresh() -> Iterator[Path]:
    """A folder with a copy of this checkout, `checkout`, in which nothing is compiled, and an empty one for caches, `home`."""
    with tempfile.TemporaryDirectory(prefix="penumbra-start-") as name:
        folder = Path(name)
        shutil.copytree(ROOT, folder / "checkout", symlinks=True, ignore=shutil.ignore_patterns(*LEFT_OUT))
        (folder / "home").mkdir()
        yield folder


def measure(cell: str, seed: int, runs: int) -> dict[str, Any]:
    """`runs` cold and as many warm starts of a cell, as JSON. Raises Failed."""
    cold, warm = [], []
    for k in range(runs):
        with fresh() as folder:
            cold.append(start(folder / "checkout", cell, seed + k, folder / "home"))
            warm.append(start(folder / "checkout", cell, seed + k, folder / "home"))
    return summary(cold, warm)


def summary(cold: list[Start], warm: list[Start]) -> dict[str, Any]:
    """The medians of cold starts and of the warm ones that followed them, as JSON."""
    services = {}
    for name in cold[0].seconds:
        pairs = [(c.cpu_s[name], w.cpu_s[name]) for c, w in zip(cold, warm, strict=True) if name in c.cpu_s and name in w.cpu_s]
        services[name] = {
            "cold_s": _median([c.seconds[name] for c in cold if name in c.seconds]),
            "warm_s": _median([w.seconds[name] for w in warm if name in w.seconds]),
            "compile_cpu_s": max(0.0, _median([c - w for c, w in pairs])),
        }
    return {
        "cold_s": _median([c.tracking_s for c in cold]),
        "warm_s": _median([w.tracking_s for w in warm]),
        "runs": {"cold_s": [c.tracking_s for c in cold], "warm_s": [w.tracking_s for w in warm]},
        "services": services,
    }


def _median(values: list[float]) -> float:
    return round(statistics.median(values), 2) if values else float("nan")


def tables(result: Result) -> list[Part]:
    """The times to a tracked pose beside their goals, then those of each process."""
    cold_goal, warm_goal = (f"<= {goal:g}" for goal in GOALS_S.values())
    tracked = Table("cell", "cold s", "goal", "warm s", "goal", title="From the start to a tracked pose")
    parts: list[Part] = [tracked]
    for cell, found in result["cells"].items():
        cold, warm = (marked(f"{found[key]:.2f}", found[key] <= goal) for key, goal in GOALS_S.items())
        tracked.add_row(cell, cold, cold_goal, warm, warm_goal)
        each = Table("process", "cold s", "warm s", "compiling, CPU s", title=f"Cell {cell}: until a process shows itself")
        for name, row in found["services"].items():
            each.add_row(name, *(f"{row[column]:.2f}" for column in ("cold_s", "warm_s", "compile_cpu_s")))
        parts.append(each)
    return parts


@results.benchmark(
    "start",
    (__doc__ or "").partition("\n\n")[0],
    tables,
    flags.Option("--cell", multiple=True, metavar="CELL", help="may be repeated (default: table and arm)"),
    flags.Option("--runs", type=flags.positive, default=1, help="cold and warm starts of each"),
    flags.Option("--seed", type=int, default=1, help="of the emulator"),
    example="penumbra bench start --json start.json",
)
def main(options: flags.Options, report: results.Report) -> int:
    found: dict[str, dict[str, Any]] = {}
    try:
        for cell in options.cell or ["table", "arm"]:
            found[cells.load(cell).name] = measure(cell, options.seed, options.runs)
            report.save({"cells": found})
    except Failed as error:
        print(f"penumbra bench start: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
