"""Detection of hanging handlers: a handler can hang while other threads of the process still answer queries."""

from __future__ import annotations

import threading
import time
from types import TracebackType

HANG_S = 1.0
"""Time [s] beyond the usual duration after which a handler hangs."""
FIRST_S = 2.0
"""Initial usual duration [s]: the first calls compile kernels and fill caches."""
SHARE = 0.05
"""Weight of one call in the usual duration, a running mean of about twenty calls."""


class Turn:
    """The calls of one handler, one at a time: `with turn: handler(...)`. A call waits for the one in progress, which is in
    another thread if a subscription was closed and opened again meanwhile.

    what: description of the handler. patience_s: maximum time beyond the usual duration; infinite for a handler that never
    returns.
    """

    def __init__(self, what: str, patience_s: float = HANG_S):
        self.what = what
        self._patience_s = patience_s
        self._is_free = threading.Lock()
        self._began_s: float | None = None
        self._usual_s = FIRST_S

    def __enter__(self) -> None:
        self._is_free.acquire()
        self._began_s = time.monotonic()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._began_s is not None:
            self._usual_s += SHARE * (time.monotonic() - self._began_s - self._usual_s)
        self._began_s = None
        self._is_free.release()

    def hangs_s(self, now_s: float) -> float:
        """Duration [s] of the call in progress, where it is too long; else 0. `now_s`: time.monotonic()."""
        began_s = self._began_s
        lasts_s = 0.0 if began_s is None else now_s - began_s
        return lasts_s if lasts_s > self._patience_s + self._usual_s else 0.0
