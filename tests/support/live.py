"""Helpers of the tests and benchmarks that start real processes."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import psutil
import zenoh

from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, processes, topics
from penumbra.shared.runtime.connection import RETRY

PATIENCE_S = 60.0
"""Minimum deadline [s] of a test: a step that is short on a quiet machine takes a while on a busy one, and a deadline that is not
reached costs nothing."""


def wait_for(
    condition: Callable[[], Any], seconds: float, what: str, interval: float = 0.02, act: Callable[[], object] = lambda: None
) -> Any:
    """The first true value of `condition`; fails with `what` where none comes within `seconds`, or PATIENCE_S where that is more.
    act: is called before each look."""
    seconds = max(seconds, PATIENCE_S)
    deadline = time.monotonic() + seconds
    while True:
        act()
        if value := condition():
            return value
        if time.monotonic() > deadline:
            raise AssertionError(f"waited {seconds} s in vain for {what}")
        time.sleep(interval)


def stays(condition: Callable[[], Any], seconds: float, interval: float = 0.02) -> bool:
    """Whether a condition holds at every look for `seconds`."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if not condition():
            return False
        time.sleep(interval)
    return True


def penumbra_command(*arguments: str) -> list[str]:
    """The words that run `penumbra ARGUMENTS` in this interpreter."""
    return [sys.executable, "-m", "penumbra", *arguments]


_held: list[socket.socket] = []
"""Sockets that hold a port, one each, until this process ends."""


def free_port() -> int:
    """A TCP port that nobody listens on, and that is reserved for the caller until this process ends.

    The socket that got it from the kernel stays bound and does not listen. The kernel assigns the port to no other socket,
    neither to listen on nor to connect from, but lets a server listen there that asks for it by number (SO_REUSEADDR, which all
    servers set)."""
    holder = socket.socket()
    holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    holder.bind(("", 0))
    _held.append(holder)
    return int(holder.getsockname()[1])


def connect(port: int = 7447) -> zenoh.Session:
    """A client session at a router on loopback, as any user of the bus would open it, but one that finds a router that is back as
    soon as the services do: with Zenoh's default it tries again after a second."""
    return zenoh.open(
        zenoh.Config.from_json5(
            f'{{mode: "client", connect: {{endpoints: ["tcp/127.0.0.1:{port}"], timeout_ms: -1, exit_on_failure: false, '
            f"retry: {json.dumps(RETRY)}}}, scouting: {{multicast: {{enabled: false}}}}}}"
        )
    )


@dataclass
class Running:
    """`penumbra up` and a session beside it."""

    cell: str
    port: int
    launcher: subprocess.Popen
    session: zenoh.Session

    def pose(self, target: str = "forearm") -> dict | None:
        """The answer to the pose query, or None where nobody answers."""
        for reply in self.session.get(topics.current_pose(self.cell, target) + "?format=json", timeout=1.0):
            if reply.ok:
                return json.loads(reply.ok.payload.to_string())
        return None

    def is_tracking(self, after_ns: int = 0) -> bool:
        pose = self.pose()
        return pose is not None and pose["state"] == "tracking" and pose["stamp_ns"] > after_ns

    def is_tracked_by_both(self) -> bool:
        pose = self.pose()
        return pose is not None and pose["state"] == "tracking" and len(pose["sources"]) == 2

    def control(self, command: dict) -> dict | None:
        """The emulator's answer to a control command, or None where nobody answers."""
        for reply in self.session.get(topics.control(self.cell), payload=json.dumps(command), timeout=1.0):
            if reply.ok:
                return json.loads(reply.ok.payload.to_string())
        return None

    def health(self) -> dict[str, dict]:
        """The health of an instance of every service that answers, by service."""
        replies = self.session.get(topics.health(self.cell), timeout=1.0)
        found = [json.loads(reply.ok.payload.to_string()) for reply in replies if reply.ok]
        return {item["service"]: item for item in found}

    def processes(self) -> dict[str, psutil.Process]:
        """The launcher and its services by name, recognised by their titles; further instances have their pid in the name."""
        launcher = psutil.Process(self.launcher.pid)
        out = {"launcher": launcher}
        for child in launcher.children(recursive=True):
            if name := service_of(child):
                out[name if name not in out else f"{name}-{child.pid}"] = child
        return out


def service_of(process: psutil.Process) -> str | None:
    """The service that a process runs, by its title; None for any other process, one that has ended, and one that is just
    starting."""
    try:
        words = " ".join(process.cmdline()).split()
    except psutil.NoSuchProcess:
        return None
    return words[1] if len(words) > 1 and words[0] == "penumbra" and processes.find(words[1]) else None


@contextmanager
def penumbra_up(
    cell: str, seed: int, *arguments: str, port: int | None = None, environment: Mapping[str, str] | None = None, **streams: Any
) -> Iterator[Running]:
    """The whole chain as real processes, stopped by SIGTERM at the end.

    port: of the router on loopback, a free one if none is given. environment: variables in addition to those of this process.
    streams: where stdout (default: nowhere) and stderr of the launcher go.
    """
    port = port or free_port()
    command = penumbra_command("up", "--cell", cell, "--seed", str(seed), "--port", str(port), *arguments)
    launcher = subprocess.Popen(command, env={**os.environ, **(environment or {})}, **({"stdout": subprocess.DEVNULL} | streams))
    try:
        with connect(port) as session:
            yield Running(cells.load(cell).name, port, launcher, session)
    finally:
        launcher.terminate()
        launcher.wait(PATIENCE_S)


def hold_in_reach(running: Running) -> None:
    """Waits until the arm is tracked in sight of the camera and above the pads, and stops it there, so that only the test changes
    the pose from then on."""
    wait_for(running.is_tracking, 180, "a tracked pose", 0.2)
    wait_for(lambda: running.control({"command": "occlude", "value": 0}), 10, "the emulator's answer")
    truths = running.session.declare_subscriber(topics.TRUTH.at(cell=running.cell))
    wait_for(lambda: _is_in_reach(truths.recv()), 60, "the arm above the pads", 0.0)
    wait_for(lambda: running.control({"command": "motion", "value": "off"}), 10, "the emulator's answer")
    truths.undeclare()
    wait_for(running.is_tracked_by_both, 60, "a tracked pose of the resting arm, by both senses", 0.2)


def _is_in_reach(sample: zenoh.Sample) -> bool:
    return 0.04 < messages.decode(messages.Truth, sample.payload.to_bytes()).gap < 0.09
