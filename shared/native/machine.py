"""Selects the committed library for this machine."""

from __future__ import annotations

import platform
import sys
from pathlib import Path

FOLDER = Path(__file__).parent / "lib"
V3 = {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"}
"""Instruction sets of x86-64-v3, as named in /proc/cpuinfo."""
V2 = {"cx16", "lahf_lm", "popcnt", "sse4_1", "sse4_2", "ssse3"}


def library() -> Path | None:
    """Path of the library to load; None where there is none for this machine."""
    kind = name()
    return FOLDER / f"{kind}.so" if kind and (FOLDER / f"{kind}.so").exists() else None


def name() -> str | None:
    """x86_64-v3, x86_64-v2 or aarch64; None for another machine."""
    if not sys.platform.startswith("linux"):
        return None
    kind = platform.machine()
    if kind == "x86_64":
        flags = _flags()
        return "x86_64-v3" if flags >= V2 | V3 else "x86_64-v2" if flags >= V2 else None
    return "aarch64" if kind == "aarch64" else None


def _flags() -> set[str]:
    with open("/proc/cpuinfo") as file:
        for line in file:
            if line.startswith("flags"):
                return set(line.partition(":")[2].split())
    return set()
