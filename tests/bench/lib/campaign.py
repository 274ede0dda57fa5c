"""Many trials on several cores, each stored as soon as it is done, so that an interrupted campaign can go on.

Results lie in FOLDER/FINGERPRINT, where the fingerprint is that of all code, weights and cells that a trial depends on: a change
of any of them starts anew and keeps the old results.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from penumbra.tests.bench.lib import results
from penumbra.tests.bench.lib.results import ROOT, Result

DEPENDS = ("shared", "sim", "services", "tests/bench/lib/trials.py")
"""The project's files and folders on which a trial's result depends."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables that limit each process to one thread, as the processes share the cores."""


@dataclass(frozen=True)
class Job:
    """A call of a function of the project, `MODULE:NAME`, with arguments; `name`: of its result's file."""

    name: str
    function: str
    arguments: tuple[Any, ...]

    def __call__(self) -> Result:
        module, _, function = self.function.partition(":")
        result: Result = getattr(importlib.import_module(module), function)(*self.arguments)
        return result


def fingerprint() -> str:
    """A hash of the names and contents of the files that results depend on."""
    digest = hashlib.sha256()
    for part in DEPENDS:
        path = ROOT / part
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.suffix in (".py", ".yaml", ".npz", ".pt"):
                digest.update(file.relative_to(ROOT).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:12]


def run(jobs: Sequence[Job], folder: Path, processes: int, progress: Progress, what: str) -> list[Result]:
    """The results of all jobs in their order; those that `folder` has are read, the others computed and stored there."""
    home = folder / fingerprint()
    home.mkdir(parents=True, exist_ok=True)
    missing = [job for job in jobs if not (home / f"{job.name}.json").is_file()]
    task = progress.add_task(what, total=len(jobs), completed=len(jobs) - len(missing))
    for job, result in _computed(missing, processes):
        results.write(home / f"{job.name}.json", result)
        progress.advance(task)
    return [json.loads((home / f"{job.name}.json").read_text()) for job in jobs]


def bar(console: Any) -> Progress:
    """A progress bar with how many are done and how long the rest will take."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console)


def _computed(jobs: Sequence[Job], processes: int) -> Iterator[tuple[Job, Result]]:
    if processes == 1 or len(jobs) < 2:
        for job in jobs:
            yield job, job()
        return
    with _one_thread(), ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _start) as pool:
        pending = {pool.submit(job): job for job in jobs}
        try:
            for future in as_completed(pending):
                yield pending[future], future.result()
        finally:  # after an error or Ctrl-C no further job is begun
            pool.shutdown(wait=False, cancel_futures=True)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Within it, processes that are started compute on one thread."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


def _start() -> None:
    """Prepares a worker process: one thread, and a silent end on Ctrl-C or when its parent process is gone."""
    import torch

    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
