"""Hosts for tests: namespaces of this machine with a network, a host name and a shared memory of their own, linked by veth pairs.

With a common /dev/shm Zenoh would detect that they are one machine, and send large messages past the network.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import TracebackType

import zenoh

from penumbra.shared.cell import description as cells
from penumbra.shared.runtime import bus
from penumbra.tests.support.live import PATIENCE_S, penumbra_command, wait_for

ROOT = Path(__file__).parents[3]
NAMESPACES = ("--net", "--mount", "--uts")


@cache
def why_not() -> str:
    """The reason why hosts cannot be made here; empty where they can."""
    try:
        command = "ip link add type veth && tc qdisc add dev veth0 root tbf rate 1mbit burst 4kb latency 50ms"
        made = subprocess.run(["unshare", *NAMESPACES, "sh", "-c", command], capture_output=True, text=True)
    except FileNotFoundError as error:
        return f"no {error.filename}"
    return "" if made.returncode == 0 else f"namespaces, veth pairs and tc need root: {made.stderr.strip()}"


@dataclass
class Host:
    """One host, for as long as its context is open. processes: those that were started on it, by name."""

    name: str
    processes: dict[str, subprocess.Popen] = field(default_factory=dict)

    def __enter__(self) -> Host:
        setup = f"mount -t tmpfs tmpfs /dev/shm && hostname {self.name} && ip link set lo up && echo ready && exec cat"
        self._holder = subprocess.Popen(
            ["unshare", *NAMESPACES, "sh", "-c", setup], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )  # ends with the test, which closes its input
        assert self._holder.stdout is not None and self._holder.stdout.readline() == "ready\n"
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        assert self._holder.stdin is not None
        self._holder.stdin.close()
        self._holder.wait(PATIENCE_S)

    @property
    def pid(self) -> int:
        """The process whose namespaces make up the host."""
        return self._holder.pid

    def run(self, *command: str) -> None:
        """Runs a command on the host to its end."""
        subprocess.run([*self._enter(), *command], check=True, capture_output=True, text=True)

    def penumbra(self, *words: str) -> str:
        """The output of `penumbra WORDS...` on the host."""
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        command = [*self._enter(), *penumbra_command(*words)]
        return subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout

    def start(self, service: str, *arguments: str) -> subprocess.Popen:
        """Starts `penumbra SERVICE`, which by default connects to the host's own router."""
        environment = os.environ | {"PYTHONPATH": str(ROOT), "PENUMBRA_PARENT": str(os.getpid())}
        command = [*self._enter(), *penumbra_command(service, "--log-level", "warning", *arguments)]
        self.processes[service] = subprocess.Popen(command, env=environment)
        return self.processes[service]

    def _enter(self) -> list[str]:
        return ["nsenter", "--target", str(self.pid), *NAMESPACES]


@dataclass(frozen=True)
class Link:
    """A cable between two hosts; each names its end after the other host. number: of its network, 10.77.NUMBER.0/30,
    in which `one` is .1 and `other` .2."""

    one: Host
    other: Host
    number: int

    def lay(self) -> Link:
        peer = ["peer", "name", self.one.name, "netns", str(self.other.pid)]
        self.one.run("ip", "link", "add", self.other.name, "type", "veth", *peer)
        for place, (host, end) in enumerate(self._ends(), 1):
            host.run("ip", "address", "add", f"10.77.{self.number}.{place}/30", "dev", end)
            host.run("ip", "link", "set", end, "up")
        return self

    def throttle(self, bytes_per_s: int) -> None:
        """Limits the rate in each direction, as a modem does: excess data waits for up to 0.2 s, then it is lost."""
        for host, end in self._ends():
            host.run("tc", "qdisc", "add", "dev", end, "root", "tbf", "rate", f"{8 * bytes_per_s}bit",
                     "burst", "4kb", "latency", "200ms")  # fmt: skip

    @contextmanager
    def cut(self) -> Iterator[None]:
        """Unplugs the cable within the context."""
        self.one.run("ip", "link", "set", self.other.name, "down")
        try:
            yield
        finally:
            self.one.run("ip", "link", "set", self.other.name, "up")

    def _ends(self) -> Sequence[tuple[Host, str]]:
        return (self.one, self.other.name), (self.other, self.one.name)


@dataclass
class Hosts:
    """A cell on three hosts: the camera's, linked to the one that computes and to the robot's. The sensors are on the camera's.
    sessions: a client session at each host's router, by the host's name."""

    cell: str
    hosts: dict[str, Host]
    links: dict[str, Link]
    sessions: dict[str, zenoh.Session]


SERVICES = {"camera": ("emulator",), "compute": ("segmentation", "search"), "robot": ("haptics", "fusion")}


@contextmanager
def three_hosts(folder: Path, cell: str, seed: int, slow: int | None = None) -> Iterator[Hosts]:
    """Starts the services of a cell on three hosts, each with a router.

    folder: of the routers' sockets, through which a test connects to each of them without a network. slow: limit [bytes/s] of the
    robot's link, which the flags of its routers declare as slow; None for a fast one.
    """
    with ExitStack() as stack:
        found = {name: stack.enter_context(Host(name)) for name in SERVICES}
        links = {name: Link(found["camera"], found[name], number).lay() for number, name in enumerate(("compute", "robot"), 1)}
        flags: dict[str, list[str]] = {"camera": [f"--listen=tcp/10.77.{link.number}.1:7447" for link in links.values()]}
        flags |= {name: [f"--connect=tcp/10.77.{link.number}.1:7447"] for name, link in links.items()}
        if slow is not None:
            links["robot"].throttle(slow)
            flags["camera"].append("--slow=robot")
            flags["robot"].append("--slow=camera")
        sessions = {}
        for name, host in found.items():
            socket = folder / f"{name}.socket"
            listen = [f"--listen=unixsock-stream/{socket}", "--listen=tcp/127.0.0.1:7447"]
            host.start("router", "--cell", cell, *listen, *flags[name])
            wait_for(socket.exists, 20, f"the router of {name}")
            sessions[name] = stack.enter_context(client(socket))
        started = [host.start(service, "--cell", cell, *(["--seed", str(seed)] if service == "emulator" else []))
                   for name, host in found.items() for service in SERVICES[name]]  # fmt: skip
        assert not any(process.poll() for process in started)
        yield Hosts(cells.load(cell).name, found, links, sessions)


def client(socket: Path) -> zenoh.Session:
    connection = bus.Connection(connect=(f"unixsock-stream/{socket}",))
    deadline = time.monotonic() + 10
    while True:
        try:
            return zenoh.open(bus.configuration(connection))
        except zenoh.ZError:
            if time.monotonic() > deadline:
                raise
