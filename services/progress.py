"""Progress of a long command: a bar on a terminal, or a line now and then if its output goes to a file or a pipe."""

from __future__ import annotations

import sys
import time
from collections.abc import Collection, Iterator
from typing import TypeVar

T = TypeVar("T")
LINE_S = 10.0
"""Time [s] between two lines."""


def track(items: Collection[T], what: str) -> Iterator[T]:
    """Iterate over items while standard error shows how many of them are done."""
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import track

        yield from track(items, what, console=Console(stderr=True))
        return
    due = 0.0
    for k, item in enumerate(items):
        if (now := time.monotonic()) >= due:
            print(f"{what}: {k} of {len(items)}", file=sys.stderr, flush=True)
            due = now + LINE_S
        yield item
    print(f"{what}: {len(items)} of {len(items)}", file=sys.stderr, flush=True)
