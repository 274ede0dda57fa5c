"""Kernels of the library for aarch64, called in an emulator: where Debian's qemu-user, gcc-aarch64-linux-gnu and
libc6-dev-arm64-cross are installed."""

from __future__ import annotations

import shutil
import struct
import subprocess
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from penumbra.shared.native import Kernel, machine

EMULATOR, COMPILER, SYSTEM = "qemu-aarch64", "aarch64-linux-gnu-gcc", "/usr/aarch64-linux-gnu"
SOURCE = Path(__file__).parent / "call_kernels.c"
LIBRARY = machine.FOLDER / "aarch64.so"
INTEGER = struct.Struct("<q")


@dataclass(frozen=True)
class Call:
    """A call of a kernel: copies of the arguments before and after it, and the result, None where it has none."""

    kernel: Kernel
    before: tuple[Any, ...]
    after: tuple[Any, ...]
    result: Any


def missing() -> str:
    """The required programs that are not installed; empty where all are."""
    return ", ".join(name for name in (EMULATOR, COMPILER) if shutil.which(name) is None)


@contextmanager
def recorded(most: int) -> Iterator[list[Call]]:
    """The kernel calls within the context, at most the first `most` of each kernel."""
    calls: list[Call] = []
    counts: Counter[str] = Counter()
    call = Kernel.__call__

    def record(kernel: Kernel, *arguments: Any) -> Any:
        counts[kernel.name] += 1
        if counts[kernel.name] > most:
            return call(kernel, *arguments)
        before = tuple(map(np.copy, arguments))
        result = call(kernel, *arguments)
        calls.append(Call(kernel, before, tuple(map(np.copy, arguments)), result))
        return result

    with mock.patch.object(Kernel, "__call__", record):
        yield calls


def run(calls: Sequence[Call], folder: Path) -> Iterator[tuple[Call, list[np.ndarray], Any]]:
    """Each call with its arrays and its result as the emulated processor leaves them. folder: for files. Raises
    subprocess.CalledProcessError where the program ends on an error, and AssertionError where a kernel fails."""
    program, given, found = folder / "call_kernels", folder / "calls", folder / "results"
    subprocess.run([COMPILER, "-O1", "-o", program, SOURCE, "-Wl,--no-as-needed", "-lm", "-ldl"], check=True)
    given.write_bytes(INTEGER.pack(len(calls)) + b"".join(map(_packed, calls)))
    subprocess.run([EMULATOR, "-L", SYSTEM, program, LIBRARY, given, found], check=True)
    data, at = found.read_bytes(), 0
    for call in calls:
        assert data[at : at + INTEGER.size] == INTEGER.pack(0), f"{call.kernel.name} failed"
        at += INTEGER.size
        arrays = []
        for each in _arrays(call):
            arrays.append(np.frombuffer(data, each.dtype, each.size, at).reshape(each.shape))
            at += each.nbytes
        yield call, arrays, arrays.pop().item() if call.kernel.signature.result is not None else None
    assert at == len(data)


def _arrays(call: Call) -> list[np.ndarray]:
    """All arrays of a call; the last is for the result, if there is one."""
    result = call.kernel.signature.result
    arrays = [each for each, kind in zip(call.before, call.kernel.signature.parameters, strict=True) if kind.is_array]
    return arrays + ([np.empty(1, result)] if result is not None else [])


def _packed(call: Call) -> bytes:
    """A call as the program reads it; pointers to arrays are 0 in its block."""
    symbol = call.kernel.symbol.encode()
    block, slots = [INTEGER.pack(0)], []  # an array object begins with the address of its data
    for value, kind in zip(call.before, call.kernel.signature.parameters, strict=True):
        if kind.is_array:
            slots.append(len(block))
            block += [INTEGER.pack(each) for each in (0, *value.shape)]
        else:
            block.append(struct.pack("<" + kind.format, value.item()))
    if call.kernel.signature.result is not None:
        slots.append(len(block))
        block.append(INTEGER.pack(0))
    arrays = _arrays(call)
    parts = [INTEGER.pack(len(symbol)), symbol, INTEGER.pack(len(block)), *block, INTEGER.pack(len(arrays))]
    for slot, each in zip(slots, arrays, strict=True):
        parts += [INTEGER.pack(slot), INTEGER.pack(each.nbytes), each.tobytes()]
    return b"".join(parts)
