"""`penumbra up`: the one table of processes, and the launcher that starts, watches and restarts them."""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TextIO, cast

from rich.console import Console
from rich.live import Live

from services import flags
from services.launcher import display
from services.launcher.fleet import Fleet, Kind
from services.launcher.forkserver import ForkServer
from services.launcher.supervised import environment
from shared.cell import description as cells
from shared.contract import topics
from shared.runtime import bus, logs
from shared.runtime.hang import HANG_S
from shared.runtime.node import Node


@dataclass(frozen=True)
class Process:
    """One line of the table. `extra`: what `pip install -e '.[extra]'` it needs; `needs`: the part of the cell without which it
    has nothing to do; `vision`: the way to see that it belongs to, None where to all; `flags`: flags of `penumbra up` that are
    passed on to it; `beside`: whether a second one may run, which shares the streams with the first."""

    name: str
    extra: str
    replicas: int = 1
    restart: Literal["always", "never"] = "always"
    needs: Literal["cameras", "pads", "sim"] | None = None
    vision: str | None = None
    flags: tuple[str, ...] = ()
    beside: bool = True

    @property
    def module(self) -> str:
        return f"services.{self.name}.service"

    def is_needed(self, cell: cells.Cell) -> bool:
        return self.needs is None or bool(getattr(cell, self.needs))


PROCESSES = (
    Process("router", "router", beside=False),
    Process("emulator", "emulator", needs="sim", flags=("seed",), beside=False),
    Process("segmentation", "segmentation", needs="cameras", vision="procnet"),
    Process("search", "search", needs="cameras", vision="procnet", flags=("method",)),
    Process("posecnn", "posecnn", needs="cameras", vision="posecnn"),
    Process("skin", "skin", replicas=0, needs="pads", beside=False),  # belongs to a machine with boards, which name their ports
    Process("haptics", "haptics", needs="pads"),
    Process("fusion", "fusion", replicas=2, flags=("observer",)),  # the pose must not pause where one of them dies
)

VISION = ("procnet", "posecnn")
"""Ways to see: segmentation and search of its masks, or the paper's rival in place of both."""
POLL_S = 0.05
REDRAW_S = 0.5
PLAIN_S = 5.0


class Launcher:
    """Runs the processes of a cell until it is told to stop, and changes them when it is asked to."""

    def __init__(self, node: Node, fleet: Fleet, console: Console):
        self.node, self.fleet, self.console = node, fleet, console
        self.watch = display.Watch(node)
        node.tell("processes", self._processes)
        node.worry(self._worries)
        node.answer(topics.launcher(node.cell.name), fleet.answer)
        self._looping: set[str] = set()

    def run(self, seconds: float) -> None:
        """Starts everything, and returns after `seconds` or when the node is stopping; then nothing is left."""
        title = f"Penumbra, cell {self.node.cell.name}: penumbra pose --cell {self.node.cell.name} in another terminal"
        deadline = time.monotonic() + seconds
        self.node.every(1.0, self._refresh, display.ANSWER_S + HANG_S)
        try:
            self.fleet.start()
            if self.console.is_terminal:
                with Live(console=self.console, auto_refresh=False) as screen:
                    self._loop(
                        deadline, REDRAW_S, lambda: screen.update(display.table(title, self._rows(), self.watch), refresh=True)
                    )
            else:
                self._loop(
                    deadline, PLAIN_S, lambda: self.console.print(display.plain(self._rows(), self.watch), highlight=False)
                )
        finally:
            rows = self._rows()
            self.node.stopping.set()  # it does not miss the router that it ends
            self.fleet.stop()
        self.console.print(display.summary(rows, self.watch), highlight=False)

    def _loop(self, deadline: float, period_s: float, show: Callable[[], None]) -> None:
        due = time.monotonic() + min(period_s, 1.0)
        while not self.node.stopping.is_set() and time.monotonic() < deadline:
            self.fleet.wait(POLL_S)
            self.fleet.watch()
            if time.monotonic() >= due:
                show()
                due = time.monotonic() + period_s

    def _refresh(self) -> None:
        self.watch.refresh()
        local = self.watch.local()
        for process in self.fleet.processes:
            process.measure()
            if (report := local.get(process.pid or 0)) is not None:
                process.heard(report.ready, report.hangs)

        self._tell_of_loops()

    def _tell_of_loops(self) -> None:
        looping = {process.name: process.note for process in self.fleet.processes if process.is_looping}
        for name in looping.keys() - self._looping:
            self.node.log.error("a process dies again and again; the others go on", process=name, why=looping[name])
        self._looping = set(looping)

    def _processes(self) -> dict[str, dict[str, Any]]:
        return {
            process.name: {"state": process.state, "restarts": process.restarts, "note": process.note}
            for process in self.fleet.processes
        }

    def _worries(self) -> list[str]:
        return [f"{each.name} {each.state}: {each.note}" for each in self.fleet.processes if each.state in ("waiting", "failed")]

    def _rows(self) -> list[display.ProcessRow]:
        local = self.watch.local()
        own = local.get(os.getpid())
        cpu, memory_mb = (own.cpu, own.memory_mb) if own else (0.0, 0.0)
        launcher = display.ProcessRow("launcher", "running", os.getpid(), cpu, memory_mb, 0)
        return [launcher, *(process.row(local.get(process.pid or 0)) for process in self.fleet.processes)]


def fleet(cell: cells.Cell, options: argparse.Namespace, endpoint: str) -> Fleet:
    """The processes that this cell needs, ready to start: the router among them, unless there is one already (--connect). Raises
    CellError for an unknown name or an impossible number."""
    own = {
        "PENUMBRA_METRICS_PORT": "",  # the launcher's port covers all
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep),
    }
    kinds, counts = {}, {}
    for process in PROCESSES:
        if not process.replicas or (process.name == "router" and options.connect):
            continue
        where = ["--listen", listening(options)] if process.name == "router" else ["--connect", endpoint]
        command = [sys.executable, "-m", "services.command.cli", process.name, "--cell", str(options.cell), *where]
        command += ["--secure", str(options.secure)] if options.secure else []
        command += ["--log-level", options.log_level, "--log-format", options.log_format]
        for flag in process.flags:
            if (value := getattr(options, flag)) is not None:
                command += [f"--{flag}", str(value)]
        kinds[process.name] = Kind(command, process.restart, own, process.beside)
        if process.is_needed(cell) and process.vision in (None, options.vision):
            counts[process.name] = process.replicas
    for text in options.replicas:
        name, _, number = text.partition("=")
        if name not in kinds or not number.isdecimal():
            raise cells.CellError(f"--replicas {text}: NAME=NUMBER with NAME one of {', '.join(kinds)} expected")
        try:
            kinds[name].check(name, int(number))
        except ValueError as error:
            raise cells.CellError(f"--replicas {error}") from None
        counts[name] = int(number)
    modules = [process.module for process in PROCESSES if counts.get(process.name)]
    return Fleet(kinds, counts, ForkServer(modules, environment(own)) if sys.platform == "linux" else None)


def listening(options: argparse.Namespace) -> str:
    """Where the launcher's router listens: on loopback, or, secured, on every network of this machine."""
    return f"tls/0.0.0.0:{options.port}" if options.secure else f"tcp/127.0.0.1:{options.port}"


def meeting_point(options: argparse.Namespace) -> str:
    """The endpoint at which all meet."""
    return options.connect or f"{'tls' if options.secure else 'tcp'}/127.0.0.1:{options.port}"


def start_router(node: Node, fleet: Fleet, port: int) -> None:
    """Starts the fleet's router and waits until it listens, or the node is stopping, so that nobody has to wait for it. Raises
    bus.BusError where it cannot start."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            raise bus.taken(node.connection.where) from None
    (router,) = fleet.start("router")
    while not node.stopping.wait(0.02):
        fleet.watch()
        if router.state == "failed":
            raise bus.BusError(f"the router does not start: {router.note}")
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 0.1):
            return


def main(argv: list[str]) -> int:
    """`penumbra up`"""
    parser = flags.Parser(
        prog="penumbra up", description="Starts every process of a cell around a router, and shows what they do."
    )
    flags.add_cell(parser)
    parser.add_argument("--port", type=int, default=7447, help="TCP port of the router (default: %(default)s)")
    parser.add_argument("--connect", metavar="ENDPOINT", help="use a router that runs elsewhere, and start none")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after this time (default: at Ctrl-C)")
    parser.add_argument("--seed", type=int, help="of the emulator")
    parser.add_argument(
        "--vision", choices=VISION, default=VISION[0], help="segmentation and search, or PoseCNN (default: %(default)s)"
    )
    parser.add_argument("--observer", help="of the fusion (see penumbra fusion --help)")
    parser.add_argument("--method", help="of the search (see penumbra search --help)")
    parser.add_argument(
        "--replicas",
        action="append",
        default=[],
        metavar="NAME=N",
        help="run N of a process; 0 leaves it out; `penumbra scale` changes it later",
    )
    bus.add_secure(parser)
    flags.add_log(parser)
    flags.add_metrics(parser)
    options = parser.parse_args(argv)
    sys.stdout, sys.stderr = cast(TextIO, logs.Lossy(sys.stdout)), cast(TextIO, logs.Lossy(sys.stderr))
    logs.configure(options.log_level, options.log_format, "launcher")
    cell = cells.load(options.cell)
    endpoint = meeting_point(options)
    processes = fleet(cell, options, endpoint)
    node = Node("launcher", cell, bus.Connection(connect=(endpoint,), secure=options.secure))
    with node.until_signal():
        try:
            if not options.connect:
                start_router(node, processes, options.port)
            launcher = Launcher(node.open(), processes, Console(width=None if sys.stdout.isatty() else 400))
            with flags.metrics(parser, options.metrics_port, lambda: launcher.watch.health.values()):
                launcher.run(options.seconds)
        except bus.BusError:
            if not node.stopping.is_set():  # else: told to stop before the router came
                raise
        finally:
            processes.stop()  # also where it did not come to run
    return 0
