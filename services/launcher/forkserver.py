"""A process that has imported what the services need, and from which one that died is forked: in some tens of milliseconds, where
a plain start takes a second or two.

    launcher ---- command, environment, stderr ----> fork server ----> in between ----> service
    launcher <------------------------------- its pid -------------------------------------'
    launcher -------------------------------- go ------------------------------------> `python -m MODULE ...`

The one in between ends at once, and the launcher adopts its child: it waits for it, ends it, and takes it along when it ends
itself, as if it had started it. A service depends on the fork server no longer than until it runs.

The fork server opens no Zenoh session and has one thread: of a process that is forked only the thread that forks goes on, and
what another one holds stays locked.
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

ANSWER_S = 2.0
"""A fork takes some milliseconds, on a machine that is far too busy a second. A fork server that takes longer is ended, and the
service is started plainly."""
AGAIN_S = 10.0
"""After which a fork server that ended is started again."""
MOST_BYTES = 1 << 17
"""Of a request: the command and the environment."""
READY = b"ready"
GO = b"1"


class Forked:
    """A service that was forked: as much of `subprocess.Popen` as its supervisor needs. stderr: what it says."""

    def __init__(self, command: list[str], pid: int, stderr: TextIO):
        self.args, self.pid, self.stderr = command, pid, stderr
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """The exit code, negative for the number of a signal; None while it runs."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """The exit code, as soon as it has ended. Raises subprocess.TimeoutExpired."""
        if self.poll() is None:
            ended = os.pidfd_open(self.pid)
            select.select([ended], [], [], timeout)
            os.close(ended)
        if (code := self.poll()) is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return code


class ForkServer:
    """The launcher's side. modules: what is imported before a service is forked. Linux only."""

    def __init__(self, modules: Sequence[str], environment: Mapping[str, str]):
        self._modules, self._environment = modules, environment
        self._popen: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._is_ready = False
        self._due = 0.0

    @property
    def pid(self) -> int | None:
        return self._popen.pid if self._popen else None

    @property
    def is_ready(self) -> bool:
        """Whether it has imported everything."""
        if self._channel is not None and not self._is_ready:
            with contextlib.suppress(OSError):
                self._is_ready = self._channel.recv(len(READY), socket.MSG_DONTWAIT) == READY
        return self._is_ready

    def watch(self, is_calm: bool) -> None:
        """Starts it as soon as nothing else is starting, and again where it has ended. To be called from the main thread, with
        which the kernel ends it."""
        if self._popen is None:
            if is_calm and time.monotonic() >= self._due:
                self._start()
        elif self._popen.poll() is not None:
            self.stop()

    def renew(self) -> None:
        """Lets the next service be forked from what is installed now."""
        self.stop()
        self._due = 0.0

    def stop(self) -> None:
        """Ends it. The services that came from it go on."""
        if self._channel is not None:
            self._channel.close()
        if self._popen is not None:
            self._popen.kill()
            self._popen.wait()
        self._popen, self._channel, self._is_ready = None, None, False
        self._due = time.monotonic() + AGAIN_S

    def fork(self, command: list[str], environment: Mapping[str, str]) -> Forked | None:
        """A service from `[sys.executable, "-m", MODULE, ...]`; None where it has to be started plainly."""
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
            os.write(go, GO)  # whoever waits for this in vain ends: nothing runs that is not known here
            ours.remove(said)
            return Forked(command, pid, open(said, errors="replace"))
        except (OSError, ValueError):
            self.stop()
            return None
        finally:
            for descriptor in (*ours, *theirs):
                os.close(descriptor)

    def _start(self) -> None:
        PR_SET_CHILD_SUBREAPER = 36
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)  # adopts what it forks
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._popen = subprocess.Popen(
                [sys.executable, "-m", "services.launcher.forkserver", str(theirs.fileno()), *self._modules, ROOM],
                env={**self._environment, "PENUMBRA_PARENT": str(os.getpid())},
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )


ROOM = " " * 1024
"""Where a service's command line is written, which is longer than the fork server's."""


def main(channel: socket.socket, modules: Sequence[str]) -> None:
    """The fork server, and in its children the service."""
    _entitle(["python", "-m", "services.launcher.forkserver", *modules])
    for module in modules:
        with contextlib.suppress(ImportError):  # its service says what is not installed
            importlib.import_module(module)
    from shared import native

    native.load()
    threads = os.listdir("/proc/self/task")
    if len(threads) > 1:
        sys.exit(f"fork server: one thread expected after its imports, {len(threads)} came: services are started plainly")
    gc.collect()
    gc.freeze()  # a collection in a child would copy the pages that all share
    channel.send(READY)
    request = _serve(channel)
    if request is not None:
        _become(channel, *request)


def _serve(channel: socket.socket) -> tuple[list[str], dict[str, str], int, int] | None:
    """Forks for every request. In the child: its command, environment, stderr and what to wait for; None at the end."""
    while True:
        request, descriptors, _, _ = socket.recv_fds(channel, MOST_BYTES, 2)
        if not request:  # the launcher is gone
            return None
        between = os.fork()
        if not between:
            if os.fork():
                os._exit(0)
            asked = json.loads(request)
            return asked["command"], asked["environment"], descriptors[0], descriptors[1]
        for descriptor in descriptors:
            os.close(descriptor)
        os.waitpid(between, 0)


def _become(channel: socket.socket, command: list[str], environment: dict[str, str], stderr: int, go: int) -> None:
    """Runs `python -m MODULE ...` in this process, once the launcher has adopted it and knows its pid."""
    os.setsid()
    deadline = time.monotonic() + ANSWER_S
    while os.getppid() != int(environment["PENUMBRA_PARENT"]):
        if time.monotonic() > deadline:
            os._exit(1)
        time.sleep(0.0005)
    channel.send(str(os.getpid()).encode())
    channel.close()
    if os.read(go, len(GO)) != GO:
        os._exit(1)
    os.close(go)
    os.dup2(stderr, 2)
    os.close(stderr)
    os.environ.clear()
    os.environ.update(environment)
    _entitle(command)
    module, sys.argv = command[2], command[2:]
    sys.modules.pop(module, None)  # it runs as __main__
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def _entitle(command: Sequence[str]) -> None:
    """Shows a command line as that of this process, in ps."""
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    begin, end = int(fields[45]), int(fields[46])  # arg_start and arg_end of proc(5)
    shown = "\0".join(command).encode()[: end - begin - 1]
    ctypes.memmove(begin, shown.ljust(end - begin, b"\0"), end - begin)


if __name__ == "__main__":
    from services.command.cli import die_with_parent

    die_with_parent()
    main(socket.socket(fileno=int(sys.argv[1])), sys.argv[2:-1])
