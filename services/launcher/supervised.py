"""A process that the launcher starts, watches, restarts and ends."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import psutil

from penumbra.services.launcher.forkserver import Forked, ForkServer, environment
from penumbra.shared.contract.processes import LAUNCHER
from penumbra.shared.contract.report import Report
from penumbra.shared.runtime import logs

BACKOFF_S = (0.2, 10.0)
"""Initial and maximum delay [s] before a process that does not become healthy is restarted; the delay is doubled each time."""
STABLE_S = 10.0
"""Time [s] after which a process is healthy: when it dies it is restarted at once."""
CRASH_LOOP = 3
SILENT_S = 10.0
"""Time [s] for which a formerly healthy process may hang or not answer before it is killed and restarted."""
TERMINATE_S = 1.5
ASKED_FOR_NOTHING = 2
"""Exit code of a process whose flags, cell or installation cannot work: a restart changes nothing."""


@dataclass(frozen=True)
class ProcessRow:
    """State of one process. `note` says why it is not running, or not as it should; `cpu`: cores."""

    name: str
    state: str
    pid: int | None
    cpu: float
    memory_mb: float
    restarts: int
    note: str = ""


class Supervised:
    """One process that is started, watched and restarted.

    state: starting, running, waiting (for its next start), failed (it will not be restarted), stopping or stopped. is_ready: it
    serves the others. has_served: it was ready at some time. forkserver: where it is forked, if possible. write: receives the
    lines of its standard error; by default they go to the launcher's.
    """

    def __init__(
        self,
        name: str,
        command: list[str],
        restart: str = "always",
        environment: dict[str, str] | None = None,
        forkserver: ForkServer | None = None,
        write: Callable[[str], None] | None = None,
    ):
        self.service = self.name = name  # several processes of a service are numbered in their names
        self.command, self.restart = command, restart
        self.state, self.note, self.restarts = "stopped", "", 0
        self.is_ready = self.has_served = False
        self.popen: subprocess.Popen[str] | Forked | None = None
        self.cpu, self.memory_mb = 0.0, 0.0
        self._environment, self._forkserver = environment or {}, forkserver
        self._write = write or _to_stderr
        self._orphans: set[int] = set()  # process groups of ended processes, whose children the launcher may have adopted
        self.pidfd: int | None = None  # readable when the process has ended
        self._delay_s = BACKOFF_S[0]
        self._crashes = 0
        self._started = self._due = self._heard = 0.0
        self._hangs = self._hung = ""
        self._last_words: deque[str] = deque(maxlen=20)
        self._log = logs.get(LAUNCHER.name)
        self._usage: psutil.Process | None = None
        self._listener: threading.Thread | None = None

    @property
    def pid(self) -> int | None:
        return self.popen.pid if self.popen else None

    @property
    def is_looping(self) -> bool:
        """Whether it died repeatedly, and has not run for STABLE_S since."""
        return self._crashes >= CRASH_LOOP

    def start(self, is_afresh: bool = False) -> None:
        """Start it, from the launcher's main thread: the kernel ends it when that thread ends. is_afresh: from the currently
        installed code, and not from the fork server, which has imported earlier code."""
        server = None if is_afresh else self._forkserver
        forked = server.fork(self.command, environment(self._environment)) if server else None
        self._attend(forked or self._plain())

    def _plain(self) -> subprocess.Popen[str]:
        return subprocess.Popen(
            self.command,
            env=environment(self._environment),
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,  # Ctrl-C reaches the launcher alone, which then stops the others in order
        )

    def _start_again(self) -> None:
        self.restarts += 1
        self.start()

    def _attend(self, popen: subprocess.Popen[str] | Forked) -> None:
        """Begin to supervise a process that has just started."""
        self.popen = popen
        with contextlib.suppress(OSError, AttributeError):  # Linux only; elsewhere its end is noticed slightly later
            self.pidfd = os.pidfd_open(popen.pid)
        self._last_words.clear()
        self._started, self._heard = time.monotonic(), 0.0
        self._hangs = self._hung = ""
        self.state, self.is_ready = "starting", False
        self._usage = psutil.Process(popen.pid)
        self._listener = threading.Thread(target=self._listen, args=(popen,), daemon=True)
        self._listener.start()

    def _listen(self, popen: subprocess.Popen[str] | Forked) -> None:
        assert popen.stderr is not None
        for line in popen.stderr:
            self._last_words.append(line.rstrip())
            self._write(line)
        popen.stderr.close()

    def watch(self) -> None:
        """Check whether it still runs, and restart it when due."""
        now = time.monotonic()
        self._bury()
        if self.state == "stopping":
            self._stopping(now)
            return
        if self.popen is not None:
            self._look(self.popen, now)
        if self.state == "waiting" and now >= self._due:
            self._start_again()

    def _look(self, popen: subprocess.Popen[str] | Forked, now: float) -> None:
        if now - self._started > STABLE_S:
            self._delay_s, self._crashes, self.note = 0.0, 0, ""
        code = popen.poll()
        if code is None:
            if self._heard and now - self._heard > SILENT_S:
                self._hung = f"{self._hangs or f'no answer for {SILENT_S:.0f} s'}, "
                self.signal(signal.SIGKILL)
            return
        self._ended(code, now)

    def _ended(self, code: int, now: float) -> None:
        self.clear()
        last = next((line.strip() for line in reversed(self._last_words) if line.strip()), "")
        words = "" if logs.is_routine(last) else logs.sentence(last)
        why = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        self.note = f"{self._hung}{why}: {words}".removesuffix(": ")
        self._log.warning("a process ended", process=self.name, why=self.note)
        if code == ASKED_FOR_NOTHING or self.restart == "never":
            self.state = "failed"
            return
        self._crashes += 1
        if self.is_looping:
            self.note = f"crash loop: {self.note}"
        self.state, self._due = "waiting", now + self._delay_s
        self._delay_s = min(max(2 * self._delay_s, BACKOFF_S[0]), BACKOFF_S[1])

    def clear(self) -> None:
        """Clean up after its end."""
        self.signal(signal.SIGKILL)  # processes that it started itself
        if self._listener is not None:
            self._listener.join(0.2)
        if self.popen is not None:
            self._orphans.add(self.popen.pid)
        if self.pidfd is not None:
            os.close(self.pidfd)
        self.popen = self.pidfd = None
        self.cpu = self.memory_mb = 0.0
        self.is_ready = False

    def _bury(self) -> None:
        """Reap children that ended processes left to the launcher."""
        for group in tuple(self._orphans):
            try:
                os.waitpid(-group, os.WNOHANG)
            except ChildProcessError:
                self._orphans.discard(group)

    def end(self) -> None:
        """Ask it to end permanently; `watch` enforces this after TERMINATE_S."""
        if self.popen is None:
            self.state = "stopped"
            return
        self.signal(signal.SIGTERM)
        self.state, self._due = "stopping", time.monotonic() + TERMINATE_S

    def _stopping(self, now: float) -> None:
        assert self.popen is not None
        if self.popen.poll() is not None:
            self.clear()
            self.state, self.note = "stopped", ""
        elif now > self._due:
            self.signal(signal.SIGKILL)

    def heard(self, is_ready: bool = True, hangs: str = "") -> None:
        """Its health query was answered: is_ready, and what in it hangs."""
        if not hangs or not self._heard:
            self._heard = time.monotonic()
        self.is_ready, self._hangs = is_ready, hangs
        self.has_served |= is_ready
        if self.state == "starting":
            self.state = "running"

    def measure(self) -> None:
        """Measure CPU (cores since the last call) and memory."""
        if self._usage is not None and self.popen is not None:
            with contextlib.suppress(psutil.NoSuchProcess):
                self.cpu = self._usage.cpu_percent() / 100
                self.memory_mb = self._usage.memory_info().rss / 1e6

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to its process group, which it leads."""
        if self.popen is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.popen.pid, number)

    def row(self, health: Report | None = None) -> ProcessRow:
        """Its row in the table; health: its own report, if it gave one."""
        state, note = self.state, self.note
        if state == "running" and health is not None and health.status != "ok":
            state, note = health.status, "; ".join([*([note] if note else []), *health.reasons])
        return ProcessRow(self.name, state, self.pid, self.cpu, self.memory_mb, self.restarts, note)


def _to_stderr(line: str) -> None:
    sys.stderr.write(line)  # rich moves it above the live table


def wait(processes: Iterable[Supervised], seconds: float) -> None:
    """Wait until one of them ends, or for `seconds`."""
    ends = select.poll()
    for process in processes:
        if process.pidfd is not None:
            ends.register(process.pidfd, select.POLLIN)
    ends.poll(1e3 * seconds)


def stop(processes: list[Supervised]) -> None:
    """Send SIGTERM to all, and SIGKILL to those still running after TERMINATE_S."""
    for process in processes:
        process.signal(signal.SIGTERM)
    deadline = time.monotonic() + TERMINATE_S
    for process in processes:
        if process.popen is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.popen.wait(max(0.0, deadline - time.monotonic()))
            process.signal(signal.SIGKILL)
            process.popen.wait()
        process.clear()
        process.state = "failed" if process.state == "failed" else "stopped"
