"""Real-time scheduling, for processes whose work is short: it does not wait for that of vision, which takes a core for 10 ms."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterable
from pathlib import Path

PRIORITY = 1
"""Priority in real time, the lowest: it is before all processes that have none."""
ITSELF = 0
"""The number of the calling thread, for the kernel."""


def go_first() -> bool:
    """Schedules all threads of this process, and those that they start, before the processes of this machine that have no
    real-time priority (SCHED_RR, `man 7 sched`). Returns whether the system permits it; if not, nothing changes. It needs Linux,
    and a limit RLIMIT_RTPRIO of at least `PRIORITY` or the capability CAP_SYS_NICE."""
    return _schedule([ITSELF]) and _schedule(int(task.name) for task in Path("/proc/self/task").iterdir())


def may_go_first() -> bool:
    """Whether the system permits `go_first` to this process."""
    permitted = False

    def ask() -> None:
        nonlocal permitted
        permitted = _schedule([ITSELF])

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    return permitted


def goes_first(pid: int) -> bool:
    """Whether a process, by its main thread, is scheduled in real time. Raises OSError if there is no such process."""
    return hasattr(os, "sched_getscheduler") and os.sched_getscheduler(pid) == os.SCHED_RR


def _schedule(threads: Iterable[int]) -> bool:
    if not hasattr(os, "sched_setscheduler"):
        return False
    for thread in threads:
        try:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(PRIORITY))
        except PermissionError:
            return False
    return True
