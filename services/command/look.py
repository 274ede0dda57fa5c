"""Commands that look at a running cell from outside: `penumbra pose`, `topics` and `sim`."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import shutil
import string
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import zenoh

from penumbra.services import flags
from penumbra.shared.cell import DEFAULT, names
from penumbra.shared.contract import access, topics
from penumbra.shared.contract.report import TopicReport
from penumbra.shared.runtime import bus, running, which

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from penumbra.shared.cell.description import Cell
    from penumbra.shared.contract.outline import Outline

PATIENCE_S = 1.0
"""Time [s] that a command waits for the router before it reports that there is none."""
WATCH_S = 0.1
WIDE = 72
"""Columns of a pose in words."""
PIPED_COLUMNS = 1000
"""Maximum columns of a table that goes into a file or pipe."""
LOST = 3
"""Exit code of a lost pose."""
ACTIONS = ("occlude", "motion", "pause", "resume", "speed", "skin", "board", "state")


@flags.command(
    "pose",
    "Prints the current fused pose of a target. The exit code is 3 where the pose is lost, and 1 where --wait ends with "
    "a coasting one.",
    flags.Argument(
        "target", required=False, shell_complete=flags.complete_part("targets"), help="of the cell; its first where none is named"
    ),
    flags.Option("--watch", is_flag=True, help="print it again and again, until Ctrl-C"),
    flags.Option(
        "--wait",
        type=flags.seconds,
        takes="maybe",
        without="inf",
        metavar="[SECONDS]",
        help="wait until the target is tracked, at most so long",
    ),
    flags.Option("--json", is_flag=True, help="print the answer as it is on the bus, one line a pose"),
    *flags.LOOKING,
    example="penumbra pose --wait 30\npenumbra pose forearm --json",
)
def pose(options: flags.Options) -> int:
    """Print the pose; returns 0, or 3 if it is lost, or 1 if it was to be tracked and is coasting."""
    if options.watch and options.wait is not None:
        flags.refuse("expected --watch or --wait, got both")
    patience_s = PATIENCE_S if options.wait is None else options.wait
    deadline = time.monotonic() + (options.wait or 0.0)
    cell = names.read(options.cell) if options.cell and not names.is_bare(options.cell) else None
    with open_session(bus.connection(options), patience_s) as session:
        while True:
            try:
                cell = cell or which.names_of(session, options.cell)
                found = _ask_pose(session, cell.name, cell.target(options.target))
            except bus.BusError as error:
                if not options.watch and time.monotonic() >= deadline:
                    raise
                if options.watch:
                    print(error, file=sys.stderr)
            else:
                is_over = options.wait is None or found["state"] == "tracking" or time.monotonic() >= deadline
                if is_over:
                    _print_pose(found, options)
                if is_over and not options.watch:
                    return LOST if found["state"] == "lost" else int(options.wait is not None and found["state"] != "tracking")
            time.sleep(WATCH_S)


def _ask_pose(session: zenoh.Session, cell: str, target: str) -> dict[str, Any]:
    answers = bus.ask(session, topics.current_pose(cell, target), "format=json")
    if not answers:
        raise bus.BusError(f"no answer for the pose of {target} in cell {cell}: {which.whats_there(session, cell, 'fusion')}")
    found: dict[str, Any] = json.loads(answers[0])
    return found


def _print_pose(found: dict[str, Any], options: flags.Options) -> None:
    if options.json:
        print(json.dumps(found), flush=True)
    elif sys.stdout.isatty():
        text = describe(found, shutil.get_terminal_size().columns)
        # overwrite each line and erase its rest: erasing first would flicker
        print("\x1b[H" + text.replace("\n", "\x1b[K\n") + "\x1b[K\n\x1b[J" if options.watch else text, flush=True)
    else:
        print(describe(found), flush=True)


def describe(pose: dict[str, Any], columns: int = WIDE) -> str:
    """The answer to the pose query in words and everyday units. columns: of the terminal; below WIDE, names get their own
    lines."""
    spread = [math.sqrt(max(0.0, pose["covariance"][i][i])) for i in range(6)]
    age_ms = (time.time_ns() - pose["stamp_ns"]) * 1e-6
    senses = [
        f"{name} {100 * sense['weight']:.0f} % ({1e3 * sense['age_s']:.0f} ms old)"
        for name, sense in sorted(pose["sources"].items())
    ]
    rows = {
        pose["target"]: f"{pose['state']}, in frame {pose['frame']}, {age_ms:.0f} ms old",
        "position": _row(pose["position"], 100, "8.2f", "cm", max(spread[:3])),
        "roll pitch yaw": _row(pose["rpy"], math.degrees(1), "8.1f", "deg", max(spread[3:])),
        "velocity": _row(pose["velocity"][:3], 100, "8.1f", "cm/s"),
        "senses": ", ".join(senses) or "none received",
    }
    if columns >= WIDE:
        return "\n".join(f"{name:15} {text}" for name, text in rows.items())
    return "\n".join(f"{name}\n  " + text.strip().replace(", ", "\n  ") for name, text in rows.items())


def _row(values: list[float], scale: float, spec: str, unit: str, spread: float | None = None) -> str:
    text = " ".join(format(value * scale, f"z{spec}") for value in values)
    return f"{text} {unit}" + ("" if spread is None else f"  +- {spread * scale:.2g} {unit}")


@flags.command(
    "topics",
    "Lists the cell's topics, and with --hz what really arrives. A narrow terminal shows fewer columns than a pipe.",
    flags.Option("--hz", is_flag=True, help="measure what arrives, and print it with the state of the processes"),
    flags.Option("--seconds", type=flags.above_zero, default=3.0, help="with --hz: how long to listen"),
    flags.JSON,
    *flags.LOOKING,
    example="penumbra topics --hz --seconds 5",
)
def list_topics(options: flags.Options) -> None:
    """Print the table of topics, or the traffic."""
    if flags.is_given("seconds") and not options.hz:
        flags.refuse("expected --hz beside --seconds, got --seconds alone")
    show_topics(options)


def show_topics(options: flags.Options, known: Sequence[topics.Topic] = topics.TOPICS) -> None:
    """Print the known topics that the cell can have, or their traffic."""
    cell = _parts(options)
    known = [topic for topic in known if topic.is_expected(cell)]
    if options.hz:
        received, instances = listen(cell, bus.connection(options), options.seconds, known)
        if options.json:
            print(json.dumps({"topics": received, "processes": instances}, default=asdict))
        else:
            _show_traffic(received, instances, known)
        return
    rows = [(key, topic) for topic in known for key in keys(topic, cell)]
    if options.json:
        print(json.dumps([_described(key, topic) for key, topic in rows]))
        return
    from rich.markup import escape

    columns = {
        "topic": [topic.name for _, topic in rows],
        "key": [key for key, _ in rows],
        "message": [topic.message.__name__ for _, topic in rows],
        "Hz": [f"{topic.rate_hz:g}" for _, topic in rows],
        "slow link": [f"{topic.slow_hz:g}" for _, topic in rows],
        "quality of service": [topic.qos.name.lower().replace("_", " ") for _, topic in rows],
        "priority": [topic.priority.name.lower() for _, topic in rows],
        "stale after": [f"{topic.stale_s:g} s" for _, topic in rows],
        "from": [" or ".join(topic.publishers) for _, topic in rows],
        "what": [escape(topic.about) for _, topic in rows],
    }
    out = console()
    out.print(table_of(columns, ("quality of service", "priority", "slow link", "stale after", "from", "what", "message"), out))


def keys(topic: topics.Topic, cell: Cell | Outline) -> list[str]:
    """The keys of a topic in a cell; empty if the cell has no such part."""
    fields = [name for _, name, _, _ in string.Formatter().parse(topic.key) if name and name != "cell"]
    parts = itertools.product(*(getattr(cell, f"{name}s") for name in fields))
    return [topic.at(cell=cell.name, **dict(zip(fields, part, strict=True))) for part in parts]


def _described(key: str, topic: topics.Topic) -> dict[str, Any]:
    return {
        "topic": topic.name,
        "key": key,
        "message": topic.message.__name__,
        "rate_hz": topic.rate_hz,
        "slow_hz": topic.slow_hz,
        "qos": topic.qos.name.lower(),
        "priority": topic.priority.name.lower(),
        "stale_s": topic.stale_s,
        "publishers": topic.publishers,
        "about": topic.about,
    }


def _show_traffic(received: dict[str, TopicReport], instances: list[running.Instance], known: Sequence[topics.Topic]) -> None:
    from rich.markup import escape
    from rich.table import Column, Table

    out = console()
    table = Table(Column("key", overflow="fold"), "Hz", "expected", "delay ms", "dropped", "bad", box=None)
    for key, row in received.items():
        expected = bus.topic_of(key, known)
        if row.count or row.bad or "*" not in key:
            delay = "-" if row.delay_s is None else f"{1e3 * row.delay_s:.1f}"
            bad = ", ".join(f"{n} {kind}" for kind, n in row.bad.items()) or "0"
            table.add_row(
                key, f"{row.rate_hz:.1f}", f"{expected.rate_hz:g}" if expected else "", delay, str(row.dropped or 0), bad
            )
    out.print(table)
    table = Table("process", "instance", "status", "reasons", box=None)
    for instance in instances:
        table.add_row(instance.service, instance.instance, instance.status, escape("; ".join(instance.reasons)))
    out.print()
    out.print(table)


def console(**settings: Any) -> Console:
    """A console as wide as the terminal; in a file or pipe so wide that no row breaks and no key is cut. A pipe whose reader ends
    raises BrokenPipeError, as `print` does. settings: of rich."""
    from rich.console import Console

    class Quiet(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    return Quiet(width=None if sys.stdout.isatty() else PIPED_COLUMNS, **settings)


def table_of(columns: Mapping[str, Sequence[str]], expendable: Sequence[str], out: Console) -> Table:
    """A table with all columns, or without the first `expendable` ones as far as the terminal is too narrow for them."""
    from rich.table import Table

    shown = dict(columns)
    for name in (None, *expendable):
        shown.pop(name or "", None)
        table = Table(*shown, box=None)
        for row in zip(*shown.values(), strict=True):
            table.add_row(*row)
        if out.measure(table, options=out.options.update(max_width=PIPED_COLUMNS)).maximum <= out.width:
            break
    return table


def listen(
    cell: Cell | Outline, connection: bus.Connection, seconds: float, known: Sequence[topics.Topic]
) -> tuple[dict[str, TopicReport], list[running.Instance]]:
    """The counters of every key of the known topics after listening for `seconds`, and the states of the cell's processes."""
    from penumbra.shared.runtime.node import Node

    node = Node("topics", cast("Cell", cell), connection)  # it reads no part of a cell that an outline lacks
    for topic in known:
        node.subscribe(topic, lambda message, names: None)
    with node.open(PATIENCE_S):
        assert node.session is not None
        node.stopping.wait(seconds)
        instances = [found for found in running.ask(node.session, cell.name) if found.instance != node.instance]
        if not instances:
            print(f"cell {cell.name}: {which.elsewhere(node.session, cell.name)}", file=sys.stderr)
        return node.report().topics, instances


@flags.command(
    "ls",
    "Lists routers and the cells on them: the router that --connect or $PENUMBRA_CONNECT names (default: that of this machine), "
    "those of this machine's `penumbra up`, and on other hosts those that run with `penumbra router --announce`. A router also "
    "lists the cells on the routers that it is linked to.",
    flags.Option("--seconds", type=flags.above_zero, default=0.5, help="how long to wait for answers from the network"),
    flags.JSON,
    *flags.BUS,
    example="penumbra ls\npenumbra ls --connect tcp/192.168.0.7:7447 --json",
)
def list_cells(options: flags.Options) -> None:
    """Print a row per router."""
    from penumbra.services.command import runs

    asked = bus.connection(options)
    guess = None if asked.connect else replace(asked, connect=(asked.default,))
    places = [guess] if guess else [replace(asked, connect=(at,)) for at in asked.connect]
    places += [replace(asked, connect=run.connect, secure=Path(run.secure) if run.secure else None) for run in runs.running()]
    places += [replace(asked, connect=found) for found in _announced(options.seconds)]
    known: set[str] = set()
    rows = [row for place in places for row in _rows(place, PATIENCE_S if place is not guess else 0.0, known)]
    if guess and any(not row["why"] for row in rows):  # a missing default router does not matter then
        rows = [row for row in rows if not (row["why"] and row["router"] == asked.default)]
    if options.json:
        print(json.dumps(rows))
        return
    for row in rows:
        print(row["why"] or f"{row['router']}: {', '.join(row['cells']) or 'no cell'}")


def _announced(seconds: float) -> list[tuple[str, ...]]:
    """The endpoints of each router that answers on the network within `seconds`."""
    scout = zenoh.scout(what="router", config=zenoh.Config())
    time.sleep(seconds)
    found = {}
    while (each := scout.try_recv()) is not None:
        found[str(each.zid)] = tuple(map(str, each.locators))
    scout.stop()
    return list(found.values())


def _rows(place: bus.Connection, patience_s: float, known: set[str]) -> list[dict[str, Any]]:
    """The router at the first of several endpoints that opens, and its cells; empty if the router is in `known`, to which it is
    added. If none opens, the reason of the first one."""
    reasons = []
    for at in place.connect:
        try:
            with open_session(replace(place, connect=(at,)), patience_s) as session:
                routers = {str(each) for each in session.info.routers_zid()}
                if routers & known:
                    return []
                known |= routers
                return [{"router": at, "cells": running.cells_at_work(session), "why": ""}]
        except bus.BusError as error:
            reasons.append(str(error))
    return [{"router": place.connect[0], "cells": [], "why": reasons[0]}] if reasons else []


@flags.command(
    "sim",
    "Steers the emulator: occlude LEVEL|auto, motion on|off, pause, resume, speed FACTOR, state, "
    "skin PAD[/ELECTRODE] dead|saturated|drift|warm|hum|gain|turned|mirrored|none [SIZE], "
    "board PAD-NUMBER error|lost|short|missing|slip.",
    flags.Argument(
        "action",
        metavar="COMMAND",
        choices=ACTIONS,
        help=flags.any_of(ACTIONS),
    ),
    flags.Argument("value", nargs=-1, help="of occlude, motion, speed, skin and board"),
    flags.JSON,
    *flags.LOOKING,
    example="penumbra sim occlude 0.8\npenumbra sim state --json",
)
def sim(options: flags.Options) -> None:
    """Pass the command to the emulator, which decides what values are possible."""
    request = {"command": options.action} | ({"value": " ".join(options.value)} if options.value else {})
    with open_session(replace(bus.connection(options), service=access.OPERATOR)) as session:
        cell = which.name_of(session, options.cell)
        answers = bus.ask(session, topics.control(cell), payload=json.dumps(request).encode())
        if not answers:
            raise bus.BusError(f"no emulator in cell {cell}: {which.whats_there(session, cell, 'emulator')}")
    state = json.loads(answers[0])
    print(json.dumps(state) if options.json else "\n".join(_settings(state)))


def _settings(state: dict[str, Any]) -> list[str]:
    """The emulator's answer in lines. The occluder takes a moment to its place: its share now stands behind the one that was
    set."""
    if (now := state.pop("occlusion_now", None)) is not None:
        state["occlusion"] = f"{state['occlusion']}, and now {now:.2f}"
    return [f"{name:10} {_plain(value)}" for name, value in state.items()]


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def file_of(options: flags.Options, service: str = access.VIEWER) -> str:
    """The cell that --cell names; without it the file of the only one that runs at the router, else the default, also where there
    is no router. The file of a running cell is known if it is built in, or if `penumbra up` runs it on this machine. Raises
    BusError for another one. service: who asks."""
    name, file = _name_and_file(options, service)
    if file is None:
        where = bus.connection(options).where
        raise bus.BusError(
            f"cell {name} runs at {where}, and its file is not known here: give --cell FILE.yaml, the file of cell {name}"
        )
    return file


def _parts(options: flags.Options) -> Cell | Outline:
    """The cell like `file_of`; where its file is not known, fusion's description of it."""
    from penumbra.shared.cell import description

    name, file = _name_and_file(options)
    if file is not None:
        return description.load(file)
    with open_session(bus.connection(options)) as session:
        return which.described(session, name)


def _name_and_file(options: flags.Options, service: str = access.VIEWER) -> tuple[str, str | None]:
    """As `file_of`, with the name or file that was given; no file for a running cell whose file is not known here."""
    if options.cell and not names.is_bare(options.cell):
        return options.cell, options.cell
    connection = replace(bus.connection(options), service=service)
    there: list[str] = []
    # without a router: the command reports it, if it needs one
    with contextlib.suppress(bus.BusError), open_session(connection, 0.0) as session:
        there = running.cells_at_work(session)
    name = options.cell or (there[0] if len(there) == 1 else DEFAULT)
    if name not in there:
        return name, name  # whoever reads this file says that there is none
    from penumbra.services.command import runs  # imports psutil, which `penumbra pose` does without

    where = set(connection.connect or (connection.default,))
    files = [run.file for run in runs.running() if run.cell == name and run.file and where & set(run.connect)]
    return name, files[0] if files else name if names.built_in(name) else None


def open_session(connection: bus.Connection, patience_s: float = PATIENCE_S) -> zenoh.Session:
    """A session with the router. Raises BusError if there is none after `patience_s`, with the cells that this machine runs at
    other endpoints."""
    nothing: Callable[[], None] = lambda: None  # noqa: E731
    try:
        return bus.open_session(connection, threading.Event(), nothing, patience_s)
    except bus.BusError as error:
        raise bus.BusError("\n".join([str(error), *_elsewhere(connection)])) from None


def _elsewhere(connection: bus.Connection) -> list[str]:
    """What to give for each cell that `penumbra up` runs on this machine at other endpoints than a connection's."""
    from penumbra.services.command import runs  # imports psutil, which is not needed where there is a router

    asked = set(connection.connect or (connection.default,))
    flags_of = {
        run.cell: f"--connect {run.connect[0]}" + (f" --secure {run.secure}" if run.secure else "")
        for run in runs.running()
        if run.connect and not asked & set(run.connect)
    }
    return [f"cell {cell} runs on this machine at another endpoint: give {words}" for cell, words in flags_of.items()]
