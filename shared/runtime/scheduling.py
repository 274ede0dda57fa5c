"""Real-time scheduling, for processes whose work is short: it does not wait for that of vision, which takes a core for 10 ms."""

from __future__ import annotations

import contextlib
import os
import threading
from pathlib import Path

PRIORITY = 1
"""Priority in real time, the lowest: it is before all processes that have none."""
ITSELF = 0
"""The number of the calling thread, for the kernel."""
TASKS = Path("/proc/self/task")
"""The threads of this process."""


def go_first(with_children: bool = True) -> bool:
    """Schedules all threads of this process before the processes of this machine that have no real-time priority (SCHED_RR, `man
    7 sched`). Returns whether the system permits it; if not, nothing changes. It needs Linux, and a limit RLIMIT_RTPRIO of at
    least `PRIORITY` or the capability CAP_SYS_NICE. with_children: also the threads and processes that it starts from then on."""
    if not may_go_first():
        return False
    for task in TASKS.iterdir():
        with contextlib.suppress(ProcessLookupError):  # it has just ended
            _schedule(int(task.name), os.SCHED_RR if with_children else os.SCHED_RR | os.SCHED_RESET_ON_FORK)
    return True


def may_go_first() -> bool:
    """Whether the system permits `go_first` to this process."""
    permitted = False

    def ask() -> None:
        nonlocal permitted
        with contextlib.suppress(AttributeError, PermissionError):  # not Linux, or no right
            _schedule(ITSELF, os.SCHED_RR)
            permitted = True

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    return permitted


def goes_first(pid: int) -> bool:
    """Whether a process, by its main thread, is scheduled in real time. Raises OSError if there is no such process."""
    return hasattr(os, "sched_getscheduler") and os.sched_getscheduler(pid) == os.SCHED_RR


def _schedule(thread: int, policy: int) -> None:
    os.sched_setscheduler(thread, policy, os.sched_param(PRIORITY))
