"""Settings of the C library's allocator for large messages."""

from __future__ import annotations

import contextlib
import ctypes

KEPT_BYTES, SPARE_BYTES = 16 << 20, 32 << 20
"""Thresholds [bytes]: blocks up to the first come from the heap, which keeps them; beyond the second, free memory is returned."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Numbers of these options in malloc.h."""


def keep() -> None:
    """Makes glibc keep the memory of large messages. Otherwise it maps and unmaps pages for each message, and the kernel clears
    them: for a frame of 921 kB this takes longer than all copying. No effect without glibc."""
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, KEPT_BYTES)
        mallopt(M_TRIM_THRESHOLD, SPARE_BYTES)
