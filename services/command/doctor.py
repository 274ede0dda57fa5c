"""`penumbra doctor`: checks this machine and the running processes, and says how to repair faults; with --skin checks the pads of
a running cell."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import re
import shutil
import threading
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from packaging.requirements import Requirement
from rich.markup import escape

from penumbra.services import flags
from penumbra.services.command import check, look
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.processes import PROCESSES
from penumbra.shared.runtime import bus, running, scheduling

ROOT = Path(__file__).parents[2]
SHM_BYTES = 128 << 20
"""Minimum shared memory [bytes]: frames pass between processes in it, and Docker's default of 64 MB is too little for two
cameras."""
STYLES = {"ok": "green", "warn": "yellow", "fail": "red"}
FOUND = {"ok": "ok", "starting": "warn", "degraded": "warn", "down": "fail"}


@dataclass(frozen=True)
class Finding:
    """Result of a check: ok, warn or fail; `mend` says what to do."""

    status: str
    text: str
    mend: str = ""


@flags.command(
    "doctor",
    "Checks this machine and reports how to fix what is wrong. The exit code is 1 where something failed.",
    flags.Option("--skin", is_flag=True, help="look at the pads of the running cell instead, by their voltages"),
    flags.Option("--seconds", type=flags.above_zero, default=6.0, help="with --skin: how long to listen, 2 to 3600"),
    flags.JSON,
    *flags.LOOKING,
    example="penumbra doctor\npenumbra doctor --skin --seconds 10",
)
def main(options: flags.Options) -> int:
    """Print every finding; returns 1 if any failed."""
    cell = look.file_of(options)
    if options.skin:
        from penumbra.services.skin import doctor

        if not 2.0 <= options.seconds <= 3600.0:
            flags.refuse(f"--seconds: expected 2 to 3600, got {options.seconds:g}")
        return doctor.main(cells.load(cell), bus.connection(options), options.seconds, options.json)
    if flags.is_given("seconds"):
        flags.refuse("expected --skin beside --seconds, got --seconds alone")
    found: Iterable[Finding] = findings(cell, bus.connection(options))
    if options.json:
        found = list(found)
        print(json.dumps([asdict(finding) for finding in found]))
        return int(any(finding.status == "fail" for finding in found))
    console = look.console(highlight=False, soft_wrap=True)
    failed = False
    for finding in found:
        mend = f" -> {finding.mend}" if finding.mend else ""
        console.print(f"[{STYLES[finding.status]}]{finding.status:4}[/] {escape(finding.text + mend)}")
        failed |= finding.status == "fail"
    return int(failed)


def findings(cell: str, connection: bus.Connection) -> Iterator[Finding]:
    """All findings, in the order in which they should be repaired."""
    yield _python()
    yield from _packages()
    yield _cores()
    yield _priority()
    yield _shared_memory()
    yield from _cell(cell)
    yield from _weights()
    yield from _landmarks()
    router = _router(connection)
    yield router
    if router.status == "ok":
        yield from _processes(cell, connection)


def _python() -> Finding:
    return Finding("ok", f"Python {platform.python_version()} on {platform.machine()}")


def _packages() -> Iterator[Finding]:
    """The packages that every process needs, and then, by the extras of the table of processes, those of single processes."""
    try:
        needed = requirements()
    except importlib.metadata.PackageNotFoundError:
        yield Finding("fail", "penumbra is not installed", "pip install -e '.[all]'")
        return
    told: set[str] = set()
    for extra in ("", *dict.fromkeys(process.extra for process in PROCESSES)):
        for name in closure(extra, needed):
            if name in told:
                continue
            told.add(name)
            try:
                yield Finding("ok", f"{name} {importlib.metadata.version(name)}")
            except importlib.metadata.PackageNotFoundError:
                install = f"pip install -e '.[{extra}]'" if extra else "pip install -e ."
                yield Finding("warn" if extra else "fail", f"{name} is not installed", install)


def requirements(lines: Iterable[str] | None = None) -> dict[str, list[str]]:
    """The requirements of this project by extra, "" for the unconditional ones; an extra that requires another is listed as
    `penumbra[EXTRA]`.

    lines: as in a package's metadata, `numba<1,>=0.60; extra == "fusion"` (default: those of the installed project). Raises
    importlib.metadata.PackageNotFoundError if it is not installed.
    """
    out: dict[str, list[str]] = {}
    for line in importlib.metadata.requires("penumbra") or () if lines is None else lines:
        requirement = Requirement(line)
        extra = re.search(r"extra == ['\"]([\w-]+)", line)
        name = extra[1] if extra else ""
        if requirement.marker is None or requirement.marker.evaluate({"extra": name}):  # else: not for this Python
            own = f"[{','.join(sorted(requirement.extras))}]" if requirement.extras else ""
            out.setdefault(name, []).append(requirement.name + own)
    return out


def closure(extras: str, needed: dict[str, list[str]]) -> list[str]:
    """The packages that extras (`robot`, or `skin,robot`) install, including those of the extras that they name in turn."""
    out: list[str] = []
    for name in (name for extra in extras.split(",") for name in needed.get(extra, ())):
        own = re.fullmatch(r"penumbra\[([\w,-]+)\]", name)
        out += closure(own[1], needed) if own else [name]
    return list(dict.fromkeys(out))


def _cores() -> Finding:
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if usable < 2:
        return Finding("warn", f"{usable} core", "the whole chain needs two for its rates")
    return Finding("ok", f"{usable} cores")


def _priority() -> Finding:
    names = ", ".join(process.name for process in PROCESSES if process.goes_first)
    if scheduling.may_go_first():
        return Finding("ok", f"real-time priority for {names}")
    later = f"no real-time priority for {names}: the skin's poses are later"
    return Finding("ok", later, "optional: docs/operation.md, Real time, tells how to permit it")


def _shared_memory(folder: Path = Path("/dev/shm")) -> Finding:
    if not folder.is_dir():
        return Finding("warn", f"no {folder}", "frames go over TCP instead of shared memory, which costs time")
    usage = shutil.disk_usage(folder)
    text = f"{folder}: {usage.free >> 20} of {usage.total >> 20} MB free"
    if usage.free < SHM_BYTES:
        return Finding("warn", text, f"{SHM_BYTES >> 20} MB are wanted: free some, or in a container set shm_size: 256m")
    return Finding("ok", text)


def _cell(cell: str) -> Iterator[Finding]:
    """The findings of `penumbra check`."""
    try:
        path = cells.source(cell)
    except cells.CellError as error:
        yield Finding("fail", str(error))
        return
    found, faults = check.examine(path)
    for fault in faults:
        yield Finding("warn" if fault.is_warning else "fail", str(fault))
    if found is not None:
        counts = {kind: len(getattr(found, kind)) for kind in ("cameras", "robots", "pads", "targets")}
        parts = ", ".join(f"{count} {kind if count != 1 else kind[:-1]}" for kind, count in counts.items())
        yield Finding("ok", f"cell {found.name}: {parts}")


def _weights() -> Iterator[Finding]:
    """Weights of every trained service that is installed, each with its card."""
    for process in PROCESSES:
        folder = ROOT / "services" / process.name
        if not process.trained_by or not folder.is_dir():
            continue
        weights = [path for path in sorted((folder / "weights").glob("*")) if path.suffix in (".npz", ".pt")]
        train = f"penumbra {process.name} {process.trained_by}"
        if not weights:
            yield Finding("fail", f"{process.name} has no weights", train)
        for path in weights:
            yield _card(path, train)


def _landmarks() -> Iterator[Finding]:
    """Optional models, which help if they are installed."""
    try:
        from penumbra.shared.perception import landmarks
    except ImportError:  # reported above
        return
    folder = landmarks.kept()
    if landmarks.is_installed(folder):
        yield Finding("ok", f"landmark models in {folder}: lost arms are looked for with them")
    else:
        mend = "optional: penumbra segmentation models fetches them"
        yield Finding("ok", "no landmark models: lost arms are looked for in the masks alone", mend)


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
    """State of the running processes of the cell, with the reasons."""
    try:
        name = cells.load(cell).name
    except cells.CellError:  # reported above
        return
    with bus.open_session(connection, threading.Event(), lambda: None, 0.0) as session:
        instances = running.ask(session, name)
        others = running.cells_at_work(session)
    if not instances and others:
        yield Finding(
            "warn", f"no process of cell {name} runs there, where cells run: {', '.join(others)}", f"give --cell {others[0]}"
        )
    elif not instances:
        yield Finding("warn", f"no process of cell {name} runs there", f"penumbra up --cell {cell}")
    for instance in instances:
        mend = f"penumbra restart {instance.service}" if instance.status == "down" else ""
        yield Finding(FOUND.get(instance.status, "warn"), str(instance), mend)
