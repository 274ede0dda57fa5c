"""Fork server: a process that has imported the services' common modules, and from which services are forked in some tens of
milliseconds; a plain start takes a second or two.

    launcher ---- command, environment, stderr ----> fork server ----> in between ----> service
    launcher <--------------- its pid --------------------'  (the one in between has ended)
    launcher -------------------------------- go ------------------------------------> `python -m MODULE ...`

The process in between ends at once, and the launcher adopts its child: it waits for it, ends it, and takes it along when it ends
itself, as if it had started it. A service depends on the fork server only until it runs.

The fork server opens no Zenoh session and has one thread: in a forked process only the forking thread continues, and locks held
by other threads stay locked.

At first it imports the modules that all services share, and is ready: the cell starts from it. Once the cell runs, it also
imports the services themselves, so that a service that dies is back at once.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import json
import os
import runpy
import select
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TextIO

ROOT = Path(__file__).parents[3]
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "passive",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Every process is one worker: spinning thread pools would take the cores from the other processes."""
COMMON = ("penumbra.shared.runtime.node", "penumbra.services.flags", "penumbra.services.run")
"""Modules imported before the first service is forked. Modules of single services are imported by these, in parallel."""
ANSWER_S = 2.0
"""Maximum time [s] for a fork, which takes some milliseconds, and a second on an overloaded machine. A slower fork server is
ended, and the service is started plainly."""
CALM_S = 20.0
"""Time [s] for which no process may have been starting before the fork server imports the services: that takes a second of CPU,
which the search for a limb needs more."""
AGAIN_S = 10.0
"""Time [s] after which a fork server that ended is started again."""
MAX_BYTES = 1 << 17
"""Maximum size [bytes] of a request: the command and the environment."""
READY = b"ready"
IMPORT = b"import"
GO = b"1"


def environment(own: Mapping[str, str] | None = None) -> dict[str, str]:
    """The environment of the launcher's processes; own: additional variables of one of them.

    They import this checkout or installation and nothing from the current folder.
    """
    return {**ONE_THREAD, **os.environ, **import_path(), "PENUMBRA_PARENT": str(os.getpid()), **(own or {})}


def import_path() -> dict[str, str]:
    """The environment with which Python imports this checkout or installation, and nothing from the current folder."""
    path = [str(ROOT), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    return {"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(path)}


class Forked:
    """A forked service: the part of `subprocess.Popen` that its supervisor needs. stderr: the service's standard error."""

    def __init__(self, command: list[str], pid: int, stderr: TextIO):
        self.args, self.pid, self.stderr = command, pid, stderr
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """The exit code, negative for a signal's number; None while it runs."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end; returns the exit code. Raises subprocess.TimeoutExpired."""
        if self.poll() is None:
            ended = os.pidfd_open(self.pid)
            select.select([ended], [], [], timeout)
            os.close(ended)
        if (code := self.poll()) is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return code


class ForkServer:
    """The launcher's side of the fork server. common: modules imported before it is ready; modules: those imported once the cell
    runs. Linux only: elsewhere it is never ready, and services are started plainly."""

    def __init__(self, common: Sequence[str] = COMMON, modules: Sequence[str] = ()):
        self.modules = modules
        self._common = common
        self._popen: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._is_ready = self._has_modules = False
        self._due = 0.0
        self._busy_at = time.monotonic()

    @property
    def pid(self) -> int | None:
        return self._popen.pid if self._popen else None

    @property
    def is_ready(self) -> bool:
        """Whether a service can be forked now."""
        return self.wait(0.0)

    @property
    def has_modules(self) -> bool:
        """Whether the services themselves are imported."""
        return self._has_modules and self.is_ready

    def start(self) -> None:
        """Start the fork server. To be called from the main thread: the kernel ends the server with it."""
        if sys.platform != "linux":
            return
        PR_SET_CHILD_SUBREAPER = 36
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)  # adopts the forked processes
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._popen = subprocess.Popen(
                [sys.executable, "-m", "penumbra.services.launcher.forkserver", str(theirs.fileno()), *self._common],
                env=environment(),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )

    def wait(self, seconds: float) -> bool:
        """Wait up to `seconds` until a service can be forked; returns whether it can, and False at once if the server has
        ended."""
        if self._channel is not None and not self._is_ready and select.select([self._channel], [], [], seconds)[0]:
            with contextlib.suppress(OSError):
                self._is_ready = self._channel.recv(len(READY), socket.MSG_DONTWAIT) == READY
        return self._is_ready

    def watch(self, is_calm: bool) -> None:
        """Tell the server to import the services once no process has been starting for CALM_S (`is_calm`: none is now), and
        restart it if it has ended. To be called from the main thread."""
        now = time.monotonic()
        self._busy_at = self._busy_at if is_calm else now
        if self._popen is None:
            if is_calm and now >= self._due:
                self.start()
        elif self._popen.poll() is not None:
            self.stop()
        elif now - self._busy_at >= CALM_S and self.is_ready and not self._has_modules and self._channel is not None:
            self._has_modules, self._is_ready = True, False
            with contextlib.suppress(OSError):
                self._channel.send(b"\n".join([IMPORT, *(module.encode() for module in self.modules)]))

    def renew(self) -> None:
        """Fork the next services from the currently installed code."""
        self.stop()
        self._due = 0.0

    def stop(self) -> None:
        """End the fork server. Services forked from it continue."""
        if self._popen is not None:
            self._popen.kill()
            self._popen.wait()
        if self._channel is not None:
            self._channel.close()
        self._popen, self._channel, self._is_ready, self._has_modules = None, None, False, False
        self._due = time.monotonic() + AGAIN_S

    def fork(self, command: list[str], environment: Mapping[str, str]) -> Forked | None:
        """Fork a service from `[sys.executable, "-m", MODULE, ...]`; None if it has to be started plainly."""
        if command[:2] != [sys.executable, "-m"] or not self.is_ready or self._channel is None:
            return None
        said, stderr = os.pipe()
        wait, go = os.pipe()
        ours, theirs = [said, go], [stderr, wait]
        try:
            request = json.dumps({"command": command, "environment": dict(environment)}).encode()
            self._channel.settimeout(ANSWER_S)
            socket.send_fds(self._channel, [request], theirs)
            pid = int(self._channel.recv(32))
            os.write(go, GO)  # a child that never gets this ends: no process runs unknown to the launcher
            ours.remove(said)
            return Forked(command, pid, open(said, errors="replace"))
        except (OSError, ValueError):
            self.stop()
            return None
        finally:
            for descriptor in (*ours, *theirs):
                os.close(descriptor)


def main(channel: socket.socket, modules: Sequence[str]) -> None:
    """Run the fork server, and in its children the service."""
    _import(modules)
    with contextlib.suppress(OSError):  # the launcher has ended
        channel.send(READY)
        request = _serve(channel)
        if request is not None:
            channel.close()
            _become(*request)


def _import(modules: Sequence[str]) -> None:
    for module in modules:
        with contextlib.suppress(ImportError):  # its service reports missing packages
            importlib.import_module(module)
    from penumbra.shared import native

    native.load()
    threads = os.listdir("/proc/self/task")
    if len(threads) > 1:
        sys.exit(f"fork server: expected one thread after its imports, got {len(threads)}: services are started plainly")
    gc.collect()
    gc.freeze()  # a collection in a child would copy the shared pages


def _serve(channel: socket.socket) -> tuple[list[str], dict[str, str], int, int] | None:
    """Fork for every request. In the child, returns its command, environment, stderr and the descriptor to wait for; None at the
    end."""
    while True:
        request, descriptors, _, _ = socket.recv_fds(channel, MAX_BYTES, 2)
        if not request:  # the launcher is gone
            return None
        if request.startswith(IMPORT):
            _import(request.decode().splitlines()[1:])
            channel.send(READY)
            continue
        read, write = os.pipe()
        between = os.fork()
        if not between:
            if os.fork():
                os._exit(0)
            os.setsid()
            os.write(write, str(os.getpid()).encode())
            os.close(read)
            os.close(write)
            asked = json.loads(request)
            return asked["command"], asked["environment"], descriptors[0], descriptors[1]
        os.waitpid(between, 0)  # now the launcher is its parent
        for descriptor in (write, *descriptors):
            os.close(descriptor)
        channel.send(os.read(read, 32))
        os.close(read)


def _become(command: list[str], environment: dict[str, str], stderr: int, go: int) -> None:
    """Run `python -m MODULE ...` in this process, once the launcher has adopted it and knows its pid."""
    if os.read(go, len(GO)) != GO:
        os._exit(1)
    os.close(go)
    os.dup2(stderr, 2)
    os.close(stderr)
    os.environ.clear()
    os.environ.update(environment)
    module, sys.argv = command[2], command[2:]
    sys.modules.pop(module, None)  # it runs as __main__
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    from penumbra.services.run import die_with_parent, entitle

    die_with_parent()
    entitle("penumbra fork server")
    main(socket.socket(fileno=int(sys.argv[1])), sys.argv[2:])
