"""Faults for real processes, injected from outside as they would happen: the tests and `penumbra bench faults` share them."""

from __future__ import annotations

import mmap
import os
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
import zenoh

from penumbra.shared.contract import topics
from penumbra.shared.runtime.guard import Numbering
from penumbra.tests.support.live import Running, free_port, penumbra_command, penumbra_up, service_of

CLOCK_SOURCE = Path(__file__).parent / "clock_shift.c"
PIDS = 1 << 22
"""More process ids than Linux gives out."""
QUESTION_BYTES = 1 << 26
"""Size [bytes] of a question that no process has room for: malloc maps new memory for 32 MB and more."""


@contextmanager
def at_once(fault: Callable[[], object]) -> Iterator[None]:
    """A fault that happens at once and does not need to be ended."""
    fault()
    yield


# ---- one process


def kill(process: psutil.Process) -> None:
    """Sends SIGKILL, as the kernel's out-of-memory killer does."""
    with suppress(psutil.NoSuchProcess):
        process.kill()


@contextmanager
def frozen(process: psutil.Process) -> Iterator[None]:
    """Stops a process (SIGSTOP): it keeps its connections and its memory, and does nothing."""
    with _signalled(process, signal.SIGCONT):
        process.send_signal(signal.SIGSTOP)
        yield


@contextmanager
def slowed(process: psutil.Process, stopped_s: float = 0.4, running_s: float = 0.1) -> Iterator[list[tuple[float, float]]]:
    """Lets a process run for a fifth of the time, in bursts that the lease of its connection does not notice. The list has the
    begin and end of each stop [s, steady clock]."""
    done = threading.Event()
    stops: list[tuple[float, float]] = []

    def alternate() -> None:
        with suppress(psutil.NoSuchProcess):
            while not done.is_set():
                process.send_signal(signal.SIGSTOP)
                stopped_at_s = time.monotonic()
                done.wait(stopped_s)
                stops.append((stopped_at_s, time.monotonic()))
                process.send_signal(signal.SIGCONT)
                done.wait(running_s)

    with _signalled(process, signal.SIGCONT), meanwhile(alternate, done):
        yield stops


@contextmanager
def meanwhile(function: Callable[[], None], done: threading.Event) -> Iterator[None]:
    """Runs a function in a thread of its own, which ends when `done` is set; the end of the context sets it."""
    thread = threading.Thread(target=function)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


@contextmanager
def _signalled(process: psutil.Process, number: signal.Signals) -> Iterator[None]:
    try:
        yield
    finally:
        with suppress(psutil.NoSuchProcess):
            process.send_signal(number)


def starve(process: psutil.Process, session: zenoh.Session, cell: str, seconds: float) -> bool:
    """Out of memory: the kernel refuses a service's process every further page (RLIMIT_AS below its present size), until it ends
    or `seconds` are over. Returns whether it ended. A process may go on for ever with the memory that it has, so it is asked for
    its health again and again, with a question for which it needs new memory."""
    before = resource.prlimit(process.pid, resource.RLIMIT_AS, (1 << 20, resource.RLIM_INFINITY))
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        session.get(
            topics.health(cell, instance=f"$*-{process.pid}-$*"),
            payload=bytes(QUESTION_BYTES),
            priority=zenoh.Priority.BACKGROUND,  # messages of others are not delayed
        )
        with suppress(psutil.TimeoutExpired):
            process.wait(1.0)
            return True
    with suppress(ProcessLookupError):
        resource.prlimit(process.pid, resource.RLIMIT_AS, before)
    return False


@contextmanager
def crash_loop(processes: Callable[[], Iterable[psutil.Process]], period_s: float = 0.05) -> Iterator[None]:
    """Kills every process that `processes` finds, at its start, again and again."""
    done = threading.Event()

    def reap() -> None:
        while not done.wait(period_s):
            for process in processes():
                kill(process)

    with meanwhile(reap, done):
        yield


# ---- the disk


@contextmanager
def small_disk(folder: Path, megabytes: float) -> Iterator[None]:
    """Mounts a separate disk of this size at `folder`. Raises PermissionError where this user may not."""
    folder.mkdir(parents=True, exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={int(megabytes * 1024)}k", "penumbra-test", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise PermissionError(f"expected a user who may mount a disk for the test: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@contextmanager
def full(folder: Path) -> Iterator[None]:
    """Fills the disk of a folder to the last byte."""
    ballast = folder / "ballast"
    with ballast.open("wb", buffering=0) as file, suppress(OSError):
        for size in (1 << 16, 1 << 10, 1):
            with suppress(OSError):
                while file.write(bytes(size)) == size:
                    pass
    try:
        yield
    finally:
        ballast.unlink()


# ---- the network


class Link:
    """A link between the processes of a chain and their router that can be cut for some of them (`tests.support.link`)."""

    def __init__(self, target: int):
        self.port = free_port()
        command = [sys.executable, "-m", "penumbra.tests.support.link", str(self.port), str(target)]
        self._popen = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._answer("ready")

    @contextmanager
    def cut(self, process: psutil.Process) -> Iterator[None]:
        """Stops all traffic of this process; no side is notified that the link is gone."""
        connections = process.net_connections("tcp")
        ports = [c.laddr.port for c in connections if c.raddr and c.raddr.port == self.port]
        if not ports:
            raise AssertionError(f"{process} is not connected through the link at {self.port}")
        self._tell(f"cut {' '.join(map(str, ports))}")
        try:
            yield
        finally:
            self._tell("mend")

    def close(self) -> None:
        self._popen.kill()
        self._popen.wait()
        for stream in (self._popen.stdin, self._popen.stdout):
            assert stream is not None
            stream.close()

    def _tell(self, words: str) -> None:
        assert self._popen.stdin is not None
        self._popen.stdin.write(f"{words}\n")
        self._popen.stdin.flush()
        self._answer("done")

    def _answer(self, expected: str) -> None:
        assert self._popen.stdout is not None
        if (got := self._popen.stdout.readline().strip()) != expected:
            raise AssertionError(f"the link: expected {expected}, got {got!r}")


class Router:
    """`penumbra router` as a process of its own, to be killed and started again."""

    def __init__(self, environment: Mapping[str, str]):
        self.port, self._environment = free_port(), environment
        self.start()

    def start(self) -> None:
        command = penumbra_command("router", "--listen", f"tcp/127.0.0.1:{self.port}")
        self.popen = subprocess.Popen(command, env={**os.environ, **self._environment})

    def kill(self) -> None:
        self.popen.kill()
        self.popen.wait()

    def replace(self) -> None:
        """Kills the router, and starts another one in its place."""
        self.kill()
        self.start()


# ---- the clock


class Clocks:
    """The wall clocks of the processes that run with `environment`, which can be changed while they run. folder: for two
    files."""

    def __init__(self, folder: Path):
        library, shifts = folder / "clock_shift.so", folder / "clock_shift"
        subprocess.run(["gcc", "-O2", "-shared", "-fPIC", "-o", str(library), str(CLOCK_SOURCE)], check=True)
        with shifts.open("wb") as file:
            file.truncate(8 * PIDS)  # sparse
        self._file = shifts.open("r+b")
        self._shifts = mmap.mmap(self._file.fileno(), 8 * PIDS)
        self.environment: Mapping[str, str] = {"LD_PRELOAD": str(library), "CLOCK_SHIFT": str(shifts)}

    @contextmanager
    def shifted(self, seconds: float, process: psutil.Process | None = None) -> Iterator[None]:
        """Makes the clock of one process, or of all, jump by `seconds`, and back at the end."""
        self.jump(seconds, process)
        try:
            yield
        finally:
            self.jump(-seconds, process)

    def jump(self, seconds: float, process: psutil.Process | None = None) -> None:
        """Makes the clock of one process, or of all, jump by `seconds`."""
        at = 8 * (process.pid if process else 0)
        (before,) = struct.unpack("=q", self._shifts[at : at + 8])
        self._shifts[at : at + 8] = struct.pack("=q", before + round(seconds * 1e9))

    def close(self) -> None:
        self._shifts.close()
        self._file.close()


# ---- messages


@contextmanager
def storm(session: zenoh.Session, key: str, times: int = 10) -> Iterator[list[int]]:
    """Repeats every message of a key `times` times, numbered as another publisher's own. The list has the count so far."""
    sent = [0]
    numbering = Numbering()
    publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
    subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(4), allowed_origin=zenoh.Locality.REMOTE)

    def repeat() -> None:
        for sample in subscriber:
            for _ in range(times):
                publisher.put(sample.payload, attachment=numbering.attachment())
                sent[0] += 1

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield sent
    finally:
        with suppress(zenoh.ZError):
            subscriber.undeclare()
        thread.join(2)
        publisher.undeclare()


# ---- a chain that can be broken


@dataclass(frozen=True)
class Breakable:
    """`penumbra up --connect` to a router of its own through a link that can be cut, with clocks that can be set, and with its
    logs, caches, temporary files and heartbeat on a disk that can be filled. disk: None where this user may not mount one.

    The link is a proxy on loopback: it cuts one running process off at any time and needs no rights, where network namespaces
    would cut off whole hosts."""

    running: Running
    router: Router
    link: Link
    clocks: Clocks
    disk: Path | None


DISK_MB = 64


@contextmanager
def breakable(cell: str, seed: int, *arguments: str) -> Iterator[Breakable]:
    """The chain on `cell`; arguments: of `penumbra up`."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        disk: Path | None = folder / "disk"
        try:
            stack.enter_context(small_disk(folder / "disk", DISK_MB))
        except PermissionError:
            disk = None
        files = folder / "disk"  # an ordinary folder where nothing is mounted
        clocks = Clocks(folder)
        stack.callback(clocks.close)
        router = Router(clocks.environment)
        stack.callback(router.kill)
        link = Link(router.port)
        stack.callback(link.close)
        kept = {"PENUMBRA_HEARTBEAT": str(files / "heartbeat"), "TMPDIR": str(files), "XDG_CACHE_HOME": str(files)}
        streams = {name: stack.enter_context((files / name).open("w")) for name in ("stdout", "stderr")}
        through = ("--connect", f"tcp/127.0.0.1:{link.port}", *arguments)
        environment = {**clocks.environment, **kept}
        with penumbra_up(cell, seed, *through, port=router.port, environment=environment, **streams) as running:
            yield Breakable(running, router, link, clocks, disk)


# ---- the processes that are struck


def instances(launcher: psutil.Process, service: str) -> list[psutil.Process]:
    """The running processes of a service, recognised by their titles."""
    with suppress(psutil.NoSuchProcess):
        return [child for child in launcher.children(recursive=True) if service_of(child) == service]
    return []
