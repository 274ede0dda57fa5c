"""The launcher of `penumbra up`: it starts, watches and restarts the processes of a cell, as their table says."""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import sys
import time
from collections.abc import Callable
from typing import Any, TextIO, cast

from rich.console import Console
from rich.live import Live

from services import flags as arguments
from services.launcher import display
from services.launcher.fleet import Fleet, Kind
from services.launcher.forkserver import ForkServer
from services.launcher.supervised import ProcessRow
from shared.cell import description as cells
from shared.contract import topics
from shared.contract.processes import LAUNCHER, PROCESSES, ROUTER, VISION, Process
from shared.runtime import bus, logs
from shared.runtime.hang import HANG_S
from shared.runtime.node import Node

PORT = 7447
POLL_S = 0.05
REDRAW_S = 0.5
PLAIN_S = 5.0
FORKSERVER_S = 10.0
"""How long the start waits for the fork server; after that, processes are started plainly. It imports what each of them would
import itself, so that only a fork server that is broken takes longer than a plain start."""
LISTEN_S = 0.005
"""How often it is looked whether the router listens."""
SENSES = (topics.VISION, topics.HAPTIC)
"""What a fused pose is made of."""


class Launcher:
    """Runs the processes of a cell until it is told to stop, and changes them when it is asked to."""

    def __init__(self, node: Node, fleet: Fleet, console: Console):
        self.node, self.fleet, self.console = node, fleet, console
        self.watch = display.Watch(node)
        node.tell("processes", self._processes)
        node.worry(self._worries)
        node.answer(topics.launcher(node.cell.name), fleet.answer)
        self._looping: set[str] = set()

    def run(self, seconds: float) -> int:
        """Starts what is not started yet, and returns after `seconds` or when the node is stopping; then nothing is left.

        Returns the exit code: 1 where a process had failed by then, or where no pose was tracked within `seconds` although a
        sense and the fusion ran here.
        """
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
            rows, is_over = self._rows(), not self.node.stopping.is_set()
            self.node.stopping.set()  # it does not miss the router that it ends
            self.fleet.stop()
        lacks_pose = is_over and self._should_track() and not self.watch.has_tracked
        self.console.print(display.summary(rows, self.watch), highlight=False)
        if lacks_pose:
            self.console.print(f"no pose was tracked within {seconds:g} s", highlight=False)
        return int(lacks_pose or any(row.state in ("waiting", "failed") for row in rows))

    def _should_track(self) -> bool:
        """Whether a sense and what fuses it run here."""
        services = {process.service for process in self.fleet.processes}
        return bool(services & set(topics.FUSED.publishers)) and any(services & set(topic.publishers) for topic in SENSES)

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
            process.name: {
                "state": process.state,
                "is_running": process.state == "running",
                "restarts": process.restarts,
                "note": process.note,
            }
            for process in self.fleet.processes
        }

    def _worries(self) -> list[str]:
        return [f"{each.name} {each.state}: {each.note}" for each in self.fleet.processes if each.state in ("waiting", "failed")]

    def _rows(self) -> list[ProcessRow]:
        local = self.watch.local()
        own = local.get(os.getpid())
        cpu, memory_mb = (own.cpu, own.memory_mb) if own else (0.0, 0.0)
        launcher = ProcessRow(LAUNCHER.name, "running", os.getpid(), cpu, memory_mb, 0)
        return [launcher, *(process.row(local.get(process.pid or 0)) for process in self.fleet.processes)]


def fleet(cell: cells.Cell, options: argparse.Namespace, forkserver: ForkServer | None = None) -> Fleet:
    """The processes that this cell needs, ready to start: the router among them, unless there is one already (--connect). Raises
    CellError for an unknown name or an impossible number."""
    own = {"PENUMBRA_METRICS_PORT": ""}  # the launcher's port covers all
    kinds, counts = {}, {}
    for process in PROCESSES:
        if not process.replicas or (process is ROUTER and options.connect):
            continue
        kinds[process.name] = Kind(_command(process, options), process.restart, own, process.beside, process.is_required)
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
    if forkserver is not None:
        forkserver.modules = [process.module for process in PROCESSES if counts.get(process.name)]
    return Fleet(kinds, counts, forkserver)


def _command(process: Process, options: argparse.Namespace) -> list[str]:
    where = [("--listen", listening(options))] if process is ROUTER else [("--connect", at) for at in meeting_points(options)]
    command = [sys.executable, "-m", "services.command.cli", process.name, "--cell", str(options.cell), *sum(where, ())]
    command += ["--secure", str(options.secure)] if options.secure else []
    command += ["--log-level", options.log_level, "--log-format", options.log_format]
    for flag in process.flags:
        if (value := getattr(options, flag.name)) is not None:
            command += [f"--{flag.name}", str(value)]
    return command


def listening(options: argparse.Namespace) -> str:
    """Where the launcher's router listens: on loopback, or, secured, on every network of this machine."""
    return f"tls/0.0.0.0:{options.port}" if options.secure else f"tcp/127.0.0.1:{options.port}"


def meeting_points(options: argparse.Namespace) -> tuple[str, ...]:
    """The endpoints at which all meet."""
    own = f"{'tls' if options.secure else 'tcp'}/127.0.0.1:{options.port}"
    return tuple(options.connect) or (own,)


def check_port(node: Node, port: int) -> None:
    """Raises bus.BusError where another router has the port."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            raise bus.taken(node.connection.where) from None


def wait_for_router(node: Node, fleet: Fleet, port: int) -> None:
    """Returns when the router that was started listens, or the node is stopping. Raises bus.BusError where it cannot start."""
    router = next(process for process in fleet.processes if process.service == ROUTER.name)
    while not node.stopping.wait(LISTEN_S):
        fleet.watch()
        if router.state == "failed":
            raise bus.BusError(f"the router does not start: {router.note}")
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 0.1):
            return


def check_alone(node: Node, fleet: Fleet) -> None:
    """Raises bus.BusError where the bus has a process already of which a cell can have but one, and this fleet holds another."""
    assert node.session is not None
    single = {process.name for process in PROCESSES if not process.beside} & {process.service for process in fleet.processes}
    cell = node.cell.name
    found = {str(reply.ok.key_expr).split("/")[-2] for reply in node.session.liveliness().get(topics.alive(cell)) if reply.ok}
    for name in sorted(single & found):
        raise bus.BusError(
            f"cell {cell} at {node.connection.where} has a process {name} already, and two would contradict each other: "
            f"leave this one out with --replicas {name}=0"
        )


def parser() -> arguments.Parser:
    """The flags of `penumbra up`: its own, and those that the table of processes lets it pass on."""
    out = arguments.Parser(
        prog="penumbra up",
        description="Starts every process of a cell around a router, and shows what they do. Exit code 0: well; 1: a process had "
        "failed at the end, or no pose was tracked within --seconds; 2: it could not start.",
    )
    arguments.add_cell(out)
    out.add_argument("--port", type=arguments.port, help=f"TCP port of the router (default: {PORT})")
    where = "use a router that runs elsewhere, and start none; may be repeated (default: without --port, $PENUMBRA_CONNECT)"
    out.add_argument("--connect", action="append", default=[], metavar="ENDPOINT", help=where)
    out.add_argument("--seconds", type=arguments.seconds, default=float("inf"), help="stop after this time (default: at Ctrl-C)")
    out.add_argument(
        "--vision", choices=VISION, default=VISION[0], help="segmentation and search, or PoseCNN (default: %(default)s)"
    )
    for process in PROCESSES:
        for flag in process.flags:
            about = f"{flag.about} (see penumbra {process.name} --help)"
            out.add_argument(f"--{flag.name}", type=flag.type, choices=flag.choices or None, help=about)
    out.add_argument(
        "--replicas",
        action="append",
        default=[],
        metavar="NAME=N",
        help="run N of a process; 0 leaves it out; `penumbra scale` changes it later",
    )
    bus.add_secure(out)
    arguments.add_log(out)
    arguments.add_metrics(out)
    return out


def main(argv: list[str], forkserver: ForkServer) -> int:
    """`penumbra up`, with processes from a fork server that has been started."""
    flags = parser()
    options = flags.parse_args(argv)
    if not options.connect and options.port is None:
        options.connect = os.environ.get("PENUMBRA_CONNECT", "").split()
    options.port = options.port or PORT
    sys.stdout, sys.stderr = cast(TextIO, logs.Lossy(sys.stdout)), cast(TextIO, logs.Lossy(sys.stderr))
    logs.configure(options.log_level, options.log_format, LAUNCHER.name)
    cell = cells.load(options.cell)
    processes = fleet(cell, options, forkserver)
    node = Node(LAUNCHER.name, cell, bus.Connection(connect=meeting_points(options), secure=options.secure))
    with node.until_signal():
        try:
            forkserver.wait(FORKSERVER_S)
            if options.connect:
                check_alone(node.open(), processes)
            else:
                check_port(node, options.port)
                processes.start()
                wait_for_router(node, processes, options.port)
                node.open()
            launcher = Launcher(node, processes, Console(width=None if sys.stdout.isatty() else 400))
            with arguments.metrics(flags, options.metrics_port, lambda: launcher.watch.health.values()):
                return launcher.run(options.seconds)
        except bus.BusError:
            if not node.stopping.is_set():  # else: told to stop before the router came
                raise
            return 0
        finally:
            processes.stop()  # also where it did not come to run
