"""`penumbra up`: the one table of processes, and the launcher that starts, watches and restarts them around its own router."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import psutil
from rich.console import Console
from rich.live import Live

from services import arguments, live
from shared import bus, logs
from shared import cell as cells
from shared.service import Node


@dataclass(frozen=True)
class Process:
    """One line of the table. `extra`: what `pip install -e '.[extra]'` it needs; `needs`: the part of the cell without which it
    has nothing to do; `vision`: the way to see that it belongs to, None where to all; `flags`: flags of `penumbra up` that are
    passed on to it."""

    name: str
    extra: str
    replicas: int = 1
    restart: Literal["always", "never"] = "always"
    needs: Literal["cameras", "pads", "sim"] | None = None
    vision: str | None = None
    flags: tuple[str, ...] = ()

    @property
    def module(self) -> str:
        return f"services.{self.name}.service"

    def is_needed(self, cell: cells.Cell) -> bool:
        return self.needs is None or bool(getattr(cell, self.needs))


PROCESSES = (
    Process("router", "router", replicas=0),  # inside the launcher; a process of its own in containers
    Process("emulator", "emulator", needs="sim", flags=("seed",)),
    Process("segmentation", "segmentation", needs="cameras", vision="procnet"),
    Process("search", "search", needs="cameras", vision="procnet", flags=("method",)),
    Process("posecnn", "posecnn", needs="cameras", vision="posecnn"),
    Process("skin", "skin", replicas=0, needs="pads"),  # belongs to a machine with boards, which name their ports
    Process("haptics", "haptics", needs="pads"),
    Process("fusion", "fusion", flags=("observer",)),
)

VISION = ("procnet", "posecnn")
"""Ways to see: segmentation and search of its masks, or the paper's rival in place of both."""
BACKOFF_S = (0.2, 10.0)
STABLE_S = 10.0
"""A process that ran this long is healthy again: its back-off starts anew."""
CRASH_LOOP = 3
SILENT_S = 10.0
"""A process that answered before and does not for this long hangs: it is killed and started again."""
TERMINATE_S = 1.5
ASKED_FOR_NOTHING = 2
"""Exit code of a process whose flags, cell or installation cannot work: starting it again changes nothing."""
POLL_S = 0.05
REDRAW_S = 0.5
PLAIN_S = 5.0

# Every process is one worker: pools of threads that spin would take the two cores from the others.
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "passive",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}


class Supervised:
    """One process that is started, watched and started again.

    state: starting, running, waiting (for its next start), failed (it will not be started again) or stopped.
    """

    def __init__(self, name: str, command: list[str], restart: str = "always", environment: dict[str, str] | None = None):
        self.name, self.command, self.restart = name, command, restart
        self.state, self.note, self.restarts = "stopped", "", 0
        self.popen: subprocess.Popen[str] | None = None
        self.cpu, self.memory_mb = 0.0, 0.0
        self._environment = environment or {}
        self._delay_s = BACKOFF_S[0]
        self._crashes = 0
        self._started = self._due = self._heard = 0.0
        self._hung = ""
        self._last_words: deque[str] = deque(maxlen=20)
        self._usage: psutil.Process | None = None
        self._listener: threading.Thread | None = None

    @property
    def pid(self) -> int | None:
        return self.popen.pid if self.popen else None

    def start(self) -> None:
        """Starts it, from the launcher's main thread: the kernel ends it when that thread ends."""
        self._last_words.clear()
        self.popen = subprocess.Popen(
            self.command,
            env={**ONE_THREAD, **os.environ, **self._environment, "PENUMBRA_PARENT": str(os.getpid())},
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,  # Ctrl-C reaches the launcher alone, which then stops the others in order
        )
        self._started, self._heard, self._hung = time.monotonic(), 0.0, ""
        self.state = "starting"
        self._usage = psutil.Process(self.popen.pid)
        self._listener = threading.Thread(target=self._listen, args=(self.popen,), daemon=True)
        self._listener.start()

    def _listen(self, popen: subprocess.Popen[str]) -> None:
        assert popen.stderr is not None
        for line in popen.stderr:
            self._last_words.append(line.rstrip())
            sys.stderr.write(line)  # rich moves it above the live table
        popen.stderr.close()

    def watch(self) -> None:
        """Looks whether it still runs, and starts it again when it is due."""
        now = time.monotonic()
        if self.state == "waiting":
            if now >= self._due:
                self.restarts += 1
                self.start()
            return
        if self.popen is None:
            return
        if now - self._started > STABLE_S:
            self._delay_s, self._crashes, self.note = BACKOFF_S[0], 0, ""
        code = self.popen.poll()
        if code is None:
            if self._heard and now - self._heard > SILENT_S:
                self._hung = f"no answer for {SILENT_S:.0f} s, "
                self.signal(signal.SIGKILL)
            return
        self._ended(code, now)

    def _ended(self, code: int, now: float) -> None:
        self.signal(signal.SIGKILL)  # whatever it started itself
        if self._listener is not None:
            self._listener.join(0.2)
        self.popen = None
        self.cpu = self.memory_mb = 0.0
        words = next((logs.sentence(line.strip()) for line in reversed(self._last_words) if line.strip()), "")
        why = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        self.note = f"{self._hung}{why}: {words}".removesuffix(": ")
        if code == ASKED_FOR_NOTHING or self.restart == "never":
            self.state = "failed"
            return
        self._crashes += 1
        if self._crashes >= CRASH_LOOP:
            self.note = f"crash loop: {self.note}"
        self.state, self._due = "waiting", now + self._delay_s
        self._delay_s = min(2 * self._delay_s, BACKOFF_S[1])

    def heard(self) -> None:
        """Its health query was answered."""
        self._heard = time.monotonic()
        if self.state == "starting":
            self.state = "running"

    def measure(self) -> None:
        """Takes CPU (cores since the last call) and memory."""
        if self._usage is not None and self.popen is not None:
            with contextlib.suppress(psutil.NoSuchProcess):
                self.cpu = self._usage.cpu_percent() / 100
                self.memory_mb = self._usage.memory_info().rss / 1e6

    def signal(self, number: signal.Signals) -> None:
        """To its whole process group, which it leads."""
        if self.popen is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.popen.pid, number)

    def row(self, health: dict[str, Any] | None = None) -> live.ProcessRow:
        """For the table; health: its own report, where it gave one."""
        state, note = self.state, self.note
        if state == "running" and health is not None and health["status"] != "ok":
            state, note = health["status"], "; ".join([*([note] if note else []), *health["reasons"]])
        return live.ProcessRow(self.name, state, self.pid, self.cpu, self.memory_mb, self.restarts, note)


def stop(processes: list[Supervised]) -> None:
    """SIGTERM to all, and SIGKILL to what is still there after TERMINATE_S."""
    for process in processes:
        process.signal(signal.SIGTERM)
    deadline = time.monotonic() + TERMINATE_S
    for process in processes:
        if process.popen is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.popen.wait(max(0.0, deadline - time.monotonic()))
            process.signal(signal.SIGKILL)
            process.popen.wait()
        process.popen, process.state = None, "failed" if process.state == "failed" else "stopped"


class Launcher:
    """Runs the processes of a cell until it is told to stop."""

    def __init__(self, node: Node, processes: list[Supervised], console: Console):
        self.node, self.processes, self.console = node, processes, console
        self.watch = live.Watch(node)
        node.report["processes"] = lambda: {
            process.name: {"state": process.state, "restarts": process.restarts, "note": process.note}
            for process in self.processes
        }

    def run(self, seconds: float) -> None:
        """Starts everything, and returns after `seconds` or when the node is stopping; then nothing is left."""
        title = f"Penumbra, cell {self.node.cell.name}: penumbra pose --cell {self.node.cell.name} in another terminal"
        deadline = time.monotonic() + seconds
        self.node.every(1.0, self._refresh)
        try:
            for process in self.processes:
                process.start()
            if self.console.is_terminal:
                with Live(console=self.console, auto_refresh=False) as screen:
                    self._loop(
                        deadline, REDRAW_S, lambda: screen.update(live.table(title, self._rows(), self.watch), refresh=True)
                    )
            else:
                self._loop(deadline, PLAIN_S, lambda: self.console.print(live.plain(self._rows(), self.watch), highlight=False))
        finally:
            rows = self._rows()
            stop(self.processes)
        self.console.print(live.summary(rows, self.watch), highlight=False)

    def _loop(self, deadline: float, period_s: float, show: Callable[[], None]) -> None:
        due = time.monotonic() + min(period_s, 1.0)
        while not self.node.stopping.wait(POLL_S) and time.monotonic() < deadline:
            for process in self.processes:
                process.watch()
            if time.monotonic() >= due:
                show()
                due = time.monotonic() + period_s

    def _refresh(self) -> None:
        self.watch.refresh()
        local = self.watch.local()
        for process in self.processes:
            process.measure()
            if process.pid in local:
                process.heard()

    def _rows(self) -> list[live.ProcessRow]:
        local = self.watch.local()
        own = local.get(os.getpid(), {})
        launcher = live.ProcessRow("launcher", "running", os.getpid(), own.get("cpu", 0.0), own.get("memory_mb", 0.0), 0)
        return [launcher, *(process.row(local.get(process.pid or 0)) for process in self.processes)]


def commands(cell: cells.Cell, options: argparse.Namespace, endpoint: str) -> list[Supervised]:
    """The processes that this cell needs, ready to start. Raises CellError for an unknown process name."""
    known = {process.name: process for process in PROCESSES if process.replicas}
    replicas = {
        name: process.replicas
        for name, process in known.items()
        if process.is_needed(cell) and process.vision in (None, options.vision)
    }
    for text in options.replicas:
        name, _, number = text.partition("=")
        if name not in known or not number.isdigit():
            raise cells.CellError(f"--replicas {text}: NAME=NUMBER with NAME one of {', '.join(known)} expected")
        replicas[name] = int(number)
    environment = {
        "PENUMBRA_METRICS_PORT": "",  # the launcher's port covers all
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep),
    }
    out = []
    for name, count in replicas.items():
        process = known[name]
        command = [sys.executable, "-m", "services.cli", name, "--cell", str(options.cell), "--connect", endpoint]
        command += ["--log-level", options.log_level, "--log-format", options.log_format]
        for flag in process.flags:
            if (value := getattr(options, flag)) is not None:
                command += [f"--{flag}", str(value)]
        for number in range(1, count + 1):
            label = name if count == 1 else f"{name} {number}"
            out.append(Supervised(label, command, process.restart, environment))
    return out


def main(argv: list[str]) -> int:
    """`penumbra up`"""
    parser = arguments.Parser(
        prog="penumbra up", description="Starts every process of a cell around a router, and shows what they do."
    )
    arguments.add_cell(parser)
    parser.add_argument("--port", type=int, default=7447, help="TCP port of the router on loopback (default: %(default)s)")
    parser.add_argument("--connect", metavar="ENDPOINT", help="use a router that runs elsewhere, and start none")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after this time (default: at Ctrl-C)")
    parser.add_argument("--seed", type=int, help="of the emulator")
    parser.add_argument(
        "--vision", choices=VISION, default=VISION[0], help="segmentation and search, or PoseCNN (default: %(default)s)"
    )
    parser.add_argument("--observer", help="of the fusion (see penumbra fusion --help)")
    parser.add_argument("--method", help="of the search (see penumbra search --help)")
    parser.add_argument("--replicas", action="append", default=[], metavar="NAME=N", help="run N of a process; 0 leaves it out")
    arguments.add_log(parser)
    arguments.add_metrics(parser)
    options = parser.parse_args(argv)
    logs.configure(options.log_level, options.log_format, "launcher")
    cell = cells.load(options.cell)
    endpoint = options.connect or f"tcp/127.0.0.1:{options.port}"
    connection = bus.Connection(connect=(endpoint,)) if options.connect else bus.Connection("router", listen=(endpoint,))
    processes = commands(cell, options, endpoint)
    node = Node("launcher", cell, connection)
    with node.until_signal():
        launcher = Launcher(node.open(), processes, Console(width=None if sys.stdout.isatty() else 400))
        with arguments.metrics(parser, options.metrics_port, lambda: launcher.watch.health.values()):
            launcher.run(options.seconds)
    return 0
