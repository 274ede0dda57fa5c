"""Compiles kernels on the machine that runs them, and caches the result: for sources that the committed libraries do not
match."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path

import llvmlite
import llvmlite.binding as llvm

from penumbra.shared.cache import cache
from penumbra.shared.native import Kernel, Progress
from penumbra.shared.native.fingerprint import FORMAT

NUMBA = version("numba")
_ENGINES: list[llvm.ExecutionEngine] = []
"""Engines of all loaded code, which stays in memory as long as they do."""


def folder() -> Path:
    """Cache of compiled kernels. File names contain the fingerprint of the sources, the processor and the versions of the
    compilers, so a file is never out of date."""
    return cache() / "native"


def load(kernels: Sequence[Kernel], progress: Progress | None = None) -> list[Callable[[bytes], int]]:
    """Code of kernels, compiled where it is not cached. Processes that need the same kernel compile it once: the others wait."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    made_by = f"{llvm.get_host_cpu_name()}-{llvmlite.__version__}-{NUMBA}-{FORMAT}"
    files = [folder() / f"{kernel.symbol}-{made_by}.o" for kernel in kernels]
    missing = [file for file in files if not file.exists()]
    codes = []
    for kernel, file in zip(kernels, files, strict=True):
        if file in missing and progress:
            progress(missing.index(file) + 1, len(missing))
        codes.append(_loaded(_kept(kernel, file), kernel.symbol))
    return codes


def _kept(kernel: Kernel, file: Path) -> bytes:
    with contextlib.suppress(OSError):
        return file.read_bytes()
    with _alone(file):
        with contextlib.suppress(OSError):  # another process was faster
            return file.read_bytes()
        from penumbra.shared.native.compiler import Target, compiled  # numba takes a second to import

        features = llvm.get_host_cpu_features().flatten()
        code = compiled([kernel], Target(llvm.get_process_triple(), llvm.get_host_cpu_name(), features))
        with contextlib.suppress(OSError), tempfile.NamedTemporaryFile(dir=file.parent, delete=False) as new:
            new.write(code)  # on a full disk, the next start compiles again
            new.flush()
            os.replace(new.name, file)
    return code


@contextlib.contextmanager
def _alone(file: Path) -> Iterator[None]:
    """Lock that admits one process at a time, where the folder is writable."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            lock = stack.enter_context(open(file.with_suffix(".lock"), "w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _loaded(code: bytes, symbol: str) -> Callable[[bytes], int]:
    machine = llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    return ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_char_p)(engine.get_function_address(symbol))
