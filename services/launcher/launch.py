"""The launcher of `penumbra up`: starts, watches and restarts the processes of a cell, as their table says."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, TextIO, cast

from rich.console import Console
from rich.live import Live

from penumbra.services import flags
from penumbra.services.command import check, runs
from penumbra.services.launcher import background, display
from penumbra.services.launcher.fleet import Fleet, Kind
from penumbra.services.launcher.forkserver import ForkServer
from penumbra.services.launcher.supervised import ProcessRow, Supervised
from penumbra.shared.cell import DEFAULT
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import access, topics
from penumbra.shared.contract.processes import LAUNCHER, PROCESSES, ROUTER, Process
from penumbra.shared.contract.report import Report
from penumbra.shared.runtime import bus, logs, page
from penumbra.shared.runtime.connection import connect_by_environment
from penumbra.shared.runtime.hang import HANG_S
from penumbra.shared.runtime.node import Node

PORT = 7447
POLL_S = 0.05
REDRAW_S = 0.5
PLAIN_S = 5.0
FORKSERVER_S = 10.0
"""Maximum time [s] that the start waits for the fork server; after that, processes are started plainly. It imports what each of
them would import itself, so only a broken fork server takes longer than a plain start."""
LISTEN_S = 0.005
"""Period [s] at which the launcher checks whether the router listens."""
SENSES = (topics.VISION, topics.HAPTIC)
"""Topics from which a pose is fused."""


class Launcher:
    """Runs the processes of a cell until it is stopped, and changes them on request.

    keep_going: continue if a process does not start. notify: receives the progress of the start line by line, instead of a
    screen. hint: the command that the screen names. page_key: key in the links to the web page; opens: whether a browser opens
    it.
    """

    def __init__(
        self,
        node: Node,
        fleet: Fleet,
        console: Console,
        keep_going: bool = False,
        notify: Callable[[str], None] | None = None,
        hint: str = "penumbra pose",
        page_key: str | None = None,
        opens: bool = False,
    ):
        self.node, self.fleet, self.console = node, fleet, console
        self._keep_going, self._notify, self._hint = keep_going, notify, hint
        self._page_key, self._opens = page_key, opens
        self._first: list[Supervised] = []
        self.watch = display.Watch(node)
        node.add_report("processes", self._processes)
        node.add_reasons(self._reasons)
        node.answer(topics.launcher(node.cell.name), fleet.answer)
        self._looping: set[str] = set()

    def run(self, seconds: float) -> int:
        """Start the processes that are not started yet, and return after `seconds` or when the node is stopping; all processes
        have then ended.

        Returns the exit code: 1 if a process had failed by then, or if no pose was tracked within `seconds` although a sense and
        the fusion ran here.
        """
        deadline = time.monotonic() + seconds
        self.node.every(1.0, self._refresh, display.ANSWER_S + HANG_S)
        try:
            self.fleet.start()
            self._first = self.fleet.processes
            if self._notify is not None:
                self._loop(deadline, REDRAW_S, self._tell_of_start)
            elif self.console.is_terminal and not self.console.is_dumb_terminal:
                picture = display.Picture(self._hint, self.watch, self.page_link)
                with Live(console=self.console, auto_refresh=False) as screen:
                    self._loop(
                        deadline, REDRAW_S, lambda: screen.update(picture.draw(self._rows(), *self.console.size), refresh=True)
                    )
            else:
                self._loop(
                    deadline,
                    PLAIN_S,
                    lambda: self._print(display.plain(self._rows(), self.watch, self.page_link(with_key=False))),
                )
        finally:
            failed, rows = self._failed(), self._rows()
            is_over = not failed and not self.node.stopping.is_set()
            self.node.stopping.set()  # so that the node does not report the loss of the router that it ends
            self.fleet.stop()
        lacks_pose = is_over and self._should_track() and not self.watch.has_tracked
        self._print(display.summary(rows, self.watch))
        if failed:
            self._print(f"{', '.join(failed)} did not start, and the others were ended: penumbra up --keep-going lets them run")
        if lacks_pose:
            self._print(f"no pose was tracked within {seconds:g} s")
        return int(lacks_pose or any(row.state in ("waiting", "failed") for row in rows))

    def _print(self, text: str) -> None:
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def page_link(self, with_key: bool = True) -> str:
        """The link of the web page, empty while it is not served. with_key: include the key, only for the user of this screen."""
        address = page.address_in(self.watch.local().values())
        return page.link(address, self._page_key if with_key else None) if address else ""

    def _open_page(self) -> None:
        """Open the page in a browser, once it is served, if requested; a browser in the terminal returns when it ends."""
        if self._opens and (link := self.page_link()):
            self._opens = False
            import webbrowser

            threading.Thread(target=webbrowser.open, args=(link,), name="open page", daemon=True).start()

    def _failed(self) -> list[str]:
        """The processes of the start that prevent the cell from running: they cannot begin, or have died repeatedly."""
        if self._keep_going:
            return []
        return [each.name for each in self._first if each.state == "failed" or (each.is_looping and not each.has_served)]

    def _tell_of_start(self) -> None:
        """Report the progress of the start to the waiting process, until it is done."""
        assert self._notify is not None, "only a launcher in the background reports its start"
        rows = self._rows()
        waiting = [f"{row.name} ({row.note.partition(';')[0] or row.state})" for row in rows if row.state != "running"]
        cell, link = f"cell {self.node.cell.name}", self.page_link()
        at = f", its page is {link}" if link else ""
        if self.watch.has_tracked:
            self._notify(f"{background.UP}{cell} is tracking{at}")
        elif not self._should_track() and all(process.state == "running" for process in self.fleet.processes):
            self._notify(f"{background.UP}{cell} runs{at}")
        else:
            self._notify(f"waiting for {', '.join(waiting) or 'the first pose that is tracked'}")
            return
        self._notify = lambda text: None

    def _should_track(self) -> bool:
        """Whether a sense and the fusion run here."""
        services = {process.service for process in self.fleet.processes}
        return bool(services & set(topics.FUSED.publishers)) and any(services & set(topic.publishers) for topic in SENSES)

    def _loop(self, deadline: float, period_s: float, show: Callable[[], None]) -> None:
        due = time.monotonic() + min(period_s, 1.0)
        while not self.node.stopping.is_set() and time.monotonic() < deadline:
            self.fleet.wait(POLL_S)
            self.fleet.watch()
            if self._failed():
                return
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
        self._open_page()

    def _tell_of_loops(self) -> None:
        looping = {process.name: process.note for process in self.fleet.processes if process.is_looping}
        for name in looping.keys() - self._looping:
            self.node.log.error("a process exits repeatedly; the others continue", process=name, why=looping[name])
        self._looping = set(looping)

    def _processes(self) -> dict[str, dict[str, Any]]:
        return {
            process.name: {
                "pid": process.pid,
                "state": process.state,
                "is_running": process.state == "running",
                "restarts": process.restarts,
                "note": process.note,
            }
            for process in self.fleet.processes
        }

    def _reasons(self) -> list[str]:
        down = [each for each in self.fleet.processes if each.state in ("waiting", "failed") or each.is_looping]
        return [f"{each.name} {each.state}: {each.note}" for each in down]

    def _rows(self) -> list[ProcessRow]:
        local = self.watch.local()
        own = local.get(os.getpid())
        cpu, memory_mb = (own.cpu, own.memory_mb) if own else (0.0, 0.0)
        launcher = ProcessRow(LAUNCHER.name, "running", os.getpid(), cpu, memory_mb, 0)
        return [launcher, *(process.row(local.get(process.pid or 0)) for process in self.fleet.processes)]


def fleet(
    cell: cells.Cell,
    options: flags.Options,
    forkserver: ForkServer | None = None,
    write: Callable[[str, str], None] | None = None,
) -> Fleet:
    """The processes that this cell needs, ready to start, including the router, unless there is one already (--connect). Raises
    CellError for an unknown name or an impossible number."""
    own = {"PENUMBRA_METRICS_PORT": ""}  # the launcher's port serves the metrics of all
    kinds, counts = {}, {}
    for process in PROCESSES:
        number = process.replicas or int(_started(process, options) is not None)
        if not number or (process is ROUTER and options.connect):
            continue
        kinds[process.name] = Kind(_command(process, options), process.restart, own, process.beside, process.is_required)
        if process.is_needed(cell) and process.vision in (None, options.vision):
            counts[process.name] = number
    for name, number in options.replicas:
        if name not in kinds:
            raise cells.CellError(f"--replicas {name}={number}: expected one of {', '.join(kinds)}, got {name!r}")
        try:
            kinds[name].check(name, number)
        except ValueError as error:
            raise cells.CellError(f"--replicas {error}") from None
        counts[name] = number
    if forkserver is not None:
        forkserver.modules = [process.module for process in PROCESSES if counts.get(process.name)]
    return Fleet(kinds, counts, forkserver, write)


def _command(process: Process, options: flags.Options) -> list[str]:
    where = [("--listen", listening(options))] if process is ROUTER else [("--connect", at) for at in meeting_points(options)]
    command = [sys.executable, "-m", "penumbra", process.name, "--cell", str(options.cell), *sum(where, ())]
    command += ["--secure", str(options.secure)] if options.secure else []
    command += ["--log-level", options.log_level, "--log-format", options.log_format]
    for flag in process.flags:
        if (value := getattr(options, flag.name)) is not None:
            command += [f"--{flag.name}", str(value)]
    if process.starter is not None and (value := _started(process, options)) is not None:
        command += [process.starter.passes, value]
    return command


def _started(process: Process, options: flags.Options) -> str | None:
    """The value of the flag that starts a process; None if it is not given, or there is no such flag."""
    return getattr(options, process.starter.name) if process.starter is not None else None


def listening(options: flags.Options) -> str:
    """The endpoint of the launcher's router: on loopback, or, secured, on every network of this machine."""
    return f"tls/0.0.0.0:{options.port}" if options.secure else f"tcp/127.0.0.1:{options.port}"


def meeting_points(options: flags.Options) -> tuple[str, ...]:
    """The endpoints at which all processes meet."""
    own = f"{'tls' if options.secure else 'tcp'}/127.0.0.1:{options.port}"
    return tuple(options.connect) or (own,)


def pose_command(options: flags.Options) -> str:
    """The command that prints the pose of this cell, in another terminal."""
    words = ["penumbra pose"]
    words += ["--cell", str(options.cell)] if options.cell != DEFAULT else []
    own = options.port == PORT and not options.connect
    words += [] if own else [word for at in meeting_points(options) for word in ("--connect", at)]
    words += ["--secure", str(options.secure)] if options.secure else []
    return " ".join(words)


def _notifier(descriptor: int | None) -> Callable[[str], None] | None:
    """A function that writes lines to a pipe, as long as it is read."""
    if descriptor is None:
        return None

    def notify(line: str) -> None:
        with contextlib.suppress(OSError):
            os.write(descriptor, f"{line}\n".encode())

    return notify


def check_port(node: Node, port: int) -> None:
    """Raise bus.BusError if another program has the port."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            raise bus.taken(*node.connection.connect) from None


def wait_for_router(node: Node, fleet: Fleet, port: int) -> None:
    """Wait until the started router listens, or the node is stopping. Raises bus.BusError if it cannot start."""
    router = next(process for process in fleet.processes if process.service == ROUTER.name)
    while not node.stopping.wait(LISTEN_S):
        fleet.watch()
        if router.state == "failed":
            raise bus.BusError(f"the router did not start: {router.note}")
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 0.1):
            return


def check_alone(node: Node, fleet: Fleet) -> None:
    """Raise bus.BusError if the bus already has a process of which a cell can have only one, and this fleet has another."""
    assert node.session is not None
    single = {process.name for process in PROCESSES if not process.beside} & {process.service for process in fleet.processes}
    cell = node.cell.name
    found = {str(reply.ok.key_expr).split("/")[-2] for reply in node.session.liveliness().get(topics.alive(cell)) if reply.ok}
    for name in sorted(single & found):
        raise bus.BusError(
            f"cell {cell} at {node.connection.where} has a process {name} already, and two would contradict each other: "
            f"leave this one out with --replicas {name}=0"
        )


def run(options: flags.Options, forkserver: ForkServer) -> int:
    """Run `penumbra up`, with processes from a started fork server; returns the exit code."""
    if not options.connect and options.port is None:
        options.connect = connect_by_environment()
    options.port = options.port or PORT
    sys.stdout, sys.stderr = cast(TextIO, logs.Lossy(sys.stdout)), cast(TextIO, logs.Lossy(sys.stderr))
    logs.configure(options.log_level, options.log_format, LAUNCHER.name)
    cell = check.refuse(options.cell)
    logs_of = runs.logs_of(cell.name) if options.notify else None
    processes = fleet(cell, options, forkserver, runs.Logs(logs_of).write if logs_of else None)
    node = Node(LAUNCHER.name, cell, bus.Connection(connect=meeting_points(options), secure=options.secure))
    launchers: list[Launcher] = []  # filled once the bus is there; the metrics' port opens before anything starts

    def health() -> list[Report]:
        return [report for launcher in launchers for report in launcher.watch.health.values()]

    record = runs.recorded(cell.name, cells.source(options.cell), meeting_points(options), options.secure, logs_of)
    notify = _notifier(options.notify)
    with node.until_signal(), flags.metrics(options.metrics_port, health), record:
        try:
            forkserver.wait(FORKSERVER_S)
            if options.connect:
                if notify is not None:
                    notify(f"waiting for the router {node.connection.whereabouts}")
                check_alone(node.open(), processes)
            else:
                check_port(node, options.port)
                processes.start()
                wait_for_router(node, processes, options.port)
                node.open()
            launcher = Launcher(
                node,
                processes,
                Console(),
                options.keep_going,
                notify,
                pose_command(options),
                page.key(options.secure, access.OPERATOR) if options.secure else None,
                options.open,
            )
            launchers.append(launcher)
            return launcher.run(options.seconds)
        except bus.BusError:
            if not node.stopping.is_set():  # else: stopped before the router came
                raise
            return 0
        finally:
            processes.stop()  # also if it did not get to run
