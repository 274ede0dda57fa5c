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


def go_first(with_caller: bool = True) -> bool:
    """Schedules all threads of this process, and those that they start, before the processes of this machine that have no
    real-time priority (SCHED_RR, `man 7 sched`). Returns whether the system permits it; if not, nothing changes. It needs Linux,
    and a limit RLIMIT_RTPRIO of at least `PRIORITY` or the capability CAP_SYS_NICE. with_caller: the calling thread as well."""
    if not may_go_first():
        return False
    left_out = None if with_caller else threading.get_native_id()
    for thread in (int(task.name) for task in TASKS.iterdir()):
        if thread != left_out:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                _schedule(thread)
    return True


def may_go_first() -> bool:
    """Whether the system permits `go_first` to this process."""
    permitted = False

    def ask() -> None:
        nonlocal permitted
        with contextlib.suppress(AttributeError, PermissionError):  # not Linux, or no right
            _schedule(ITSELF)
            permitted = True

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    return permitted


def goes_first(pid: int) -> bool:
    """Whether a process, by its main thread, is scheduled in real time. Raises OSError if there is no such process."""
    return hasattr(os, "sched_getscheduler") and os.sched_getscheduler(pid) == os.SCHED_RR


def _schedule(thread: int) -> None:
    os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(PRIORITY))
