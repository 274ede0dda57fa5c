"""`penumbra doctor`: looks at this machine and at what runs, and says how to mend what is wrong; with --skin at the pads of a
running cell."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from services import flags
from services.command import health
from services.launcher.launch import PROCESSES
from shared.cell import description as cells
from shared.runtime import bus

ROOT = Path(__file__).parents[2]
SHM_BYTES = 128 << 20
"""Frames cross between processes in shared memory; Docker's default of 64 MB is too little for two cameras."""
CORE = ("eclipse-zenoh", "msgpack", "numpy", "scipy", "pydantic", "pyyaml", "prometheus_client", "psutil", "rich")
EXTRAS = {
    "torch": "segmentation",
    "openvino": "segmentation",
    "opencv-python-headless": "search",
    "matplotlib": "skin",
    "ruamel.yaml": "skin",
    "scikit-learn": "skin",
    "trimesh": "mesh",
    "pybullet": "robot",
    "pyserial": "skin",
}
STYLES = {"ok": "green", "warn": "yellow", "fail": "red"}
FOUND = {"ok": "ok", "degraded": "warn", "down": "fail"}


@dataclass(frozen=True)
class Finding:
    """ok, warn or fail; `mend` says what to do."""

    status: str
    text: str
    mend: str = ""


def main(argv: list[str]) -> int:
    """Prints every finding; 1 if any failed."""
    parser = flags.parser("doctor", "Looks at this machine and says how to mend what is wrong.")
    parser.add_argument("--skin", action="store_true", help="look at the pads of the running cell instead, by their voltages")
    parser.add_argument("--seconds", type=float, default=6.0, help="of --skin: how long to listen (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="of --skin: print what was found as JSON")
    options = parser.parse_args(argv)
    if options.skin:
        from services.skin import doctor

        if not 2.0 <= options.seconds <= 3600.0:
            parser.error(f"--seconds: 2 to 3600 expected, {options.seconds:g} came")
        return doctor.main(cells.load(options.cell), bus.connection(options), options.seconds, options.json)
    console = Console(highlight=False, soft_wrap=True)
    failed = False
    for finding in findings(options.cell, bus.connection(options)):
        mend = f" -> {finding.mend}" if finding.mend else ""
        console.print(f"[{STYLES[finding.status]}]{finding.status:4}[/] {escape(finding.text + mend)}")
        failed |= finding.status == "fail"
    return int(failed)


def findings(cell: str, connection: bus.Connection) -> Iterator[Finding]:
    """Everything that is looked at, in the order in which it should be mended."""
    yield _python()
    yield from _packages()
    yield _cores()
    yield _shared_memory()
    yield from _cell(cell)
    yield from _weights()
    router = _router(connection)
    yield router
    if router.status == "ok":
        yield from _processes(cell, connection)


def _python() -> Finding:
    return Finding("ok", f"Python {platform.python_version()} on {platform.machine()}")


def _packages() -> Iterator[Finding]:
    for name in (*CORE, *EXTRAS):
        try:
            yield Finding("ok", f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            extra = EXTRAS.get(name)
            status = "warn" if extra else "fail"
            yield Finding(status, f"{name} is not installed", f"pip install -e '.[{extra}]'" if extra else "pip install -e .")


def _cores() -> Finding:
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if usable < 2:
        return Finding("warn", f"{usable} core", "the whole chain needs two for its rates")
    return Finding("ok", f"{usable} cores")


def _shared_memory(folder: Path = Path("/dev/shm")) -> Finding:
    if not folder.is_dir():
        return Finding("warn", f"no {folder}", "frames go over TCP instead of shared memory, which costs time")
    usage = shutil.disk_usage(folder)
    text = f"{folder}: {usage.free >> 20} of {usage.total >> 20} MB free"
    if usage.free < SHM_BYTES:
        return Finding("warn", text, f"{SHM_BYTES >> 20} MB are wanted: free some, or in a container set shm_size: 256m")
    return Finding("ok", text)


def _cell(cell: str) -> Iterator[Finding]:
    try:
        found = cells.load(cell)
    except cells.CellError as error:
        for line in str(error).splitlines():
            yield Finding("fail", line, "mend that line of the cell file")
        return
    parts = f"{len(found.cameras)} cameras, {len(found.robots)} robots, {len(found.pads)} pads, {len(found.targets)} targets"
    yield Finding("ok", f"cell {found.name}: {parts}")


def _weights() -> Iterator[Finding]:
    """Every learned service has weights, each with its card beside it."""
    for process in PROCESSES:
        folder = ROOT / "services" / process.name
        if not (folder / "train.py").is_file():
            continue
        weights = [path for path in sorted((folder / "weights").glob("*")) if path.suffix in (".npz", ".pt")]
        train = f"penumbra {process.name} train"
        if not weights:
            yield Finding("fail", f"{process.name} has no weights", train)
        for path in weights:
            yield _card(path, train)


def _card(path: Path, train: str) -> Finding:
    name = path.relative_to(ROOT)
    try:
        card = json.loads(path.with_suffix(".json").read_text())
        return Finding("ok", f"{name}: seed {card['seed']}, {card['date']}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        return Finding("warn", f"{name} has no card that can be read ({type(error).__name__}: {error})", f"{train} writes one")


def _router(connection: bus.Connection) -> Finding:
    try:
        with bus.open_session(connection, threading.Event(), lambda: None, 0.0):
            return Finding("ok", f"router at {connection.where}")
    except bus.BusError as error:
        return Finding("warn", *str(error).split(": ", 1)) if str(error).startswith("no router") else Finding("fail", str(error))


def _processes(cell: str, connection: bus.Connection) -> Iterator[Finding]:
    """How the running processes of the cell fare, with the reasons."""
    try:
        name = cells.load(cell).name
    except cells.CellError:  # told above
        return
    with bus.open_session(connection, threading.Event(), lambda: None, 0.0) as session:
        instances = health.ask(session, name)
    if not instances:
        yield Finding("warn", f"no process of cell {name} runs there", f"penumbra up --cell {cell}")
    for instance in instances:
        mend = f"penumbra restart {instance.service}" if instance.status == "down" else ""
        yield Finding(FOUND[instance.status], str(instance), mend)
