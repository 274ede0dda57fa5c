"""How the C library keeps the memory of large messages."""

from __future__ import annotations

import contextlib
import ctypes

KEPT_BYTES, SPARE_BYTES = 16 << 20, 32 << 20
"""Blocks of memory up to the first size come from what the process has, and stay there; beyond the second it gives some back."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Numbers of these options in malloc.h."""


def keep() -> None:
    """Has glibc keep the memory of large messages. It would map pages for each and unmap them again, and the kernel would clear
    them: for a frame of 921 kB that takes longer than all the copying. Elsewhere than with glibc nothing changes."""
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, KEPT_BYTES)
        mallopt(M_TRIM_THRESHOLD, SPARE_BYTES)
