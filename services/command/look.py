"""Commands that look at a running cell from outside: `penumbra pose`, `topics` and `sim`."""

from __future__ import annotations

import json
import math
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import zenoh

from services import flags
from services.command import health
from shared.cell import description as cells
from shared.contract import access, topics
from shared.contract.report import TopicReport
from shared.runtime import bus

PATIENCE_S = 1.0
"""How long a command waits for the router before it says that there is none."""
WATCH_S = 0.1


def pose(argv: list[str]) -> int:
    """`penumbra pose [TARGET] [--watch] [--json]`"""
    parser = flags.parser("pose", "Prints the current fused pose of a target.")
    parser.add_argument("target", nargs="?", help="a target of the cell (default: its first)")
    parser.add_argument("--watch", action="store_true", help="print it again and again, until Ctrl-C")
    parser.add_argument("--json", action="store_true", help="print the answer as it is on the bus, one line a pose")
    options = parser.parse_args(argv)
    cell = cells.load(options.cell)
    target = cell.one("targets", options.target)
    key = topics.current_pose(cell.name, target)

    def show(session: zenoh.Session) -> None:
        answers = bus.ask(session, key, "format=json")
        if not answers:
            raise bus.BusError(f"nobody knows the pose of {target} in cell {cell.name}: is `penumbra fusion` running?")
        text = answers[0].decode()
        if not options.json:
            text = _describe(json.loads(text))
            if options.watch and sys.stdout.isatty():
                text = "\x1b[H\x1b[J" + text
        print(text, flush=True)

    with open_session(bus.connection(options)) as session:
        while True:
            try:
                show(session)
            except bus.BusError as error:
                if not options.watch:
                    raise
                print(error, file=sys.stderr)
            if not options.watch:
                return 0
            time.sleep(WATCH_S)


def _describe(pose: dict[str, Any]) -> str:
    """The answer to the pose query in words and everyday units."""
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
        "senses": ", ".join(senses) or "none heard",
    }
    return "\n".join(f"{name:15} {text}" for name, text in rows.items())


def _row(values: list[float], scale: float, spec: str, unit: str, spread: float | None = None) -> str:
    text = " ".join(format(value * scale, spec) for value in values)
    return f"{text} {unit}" + ("" if spread is None else f"  +- {spread * scale:.2g} {unit}")


def list_topics(argv: list[str], known: Sequence[topics.Topic] = topics.TOPICS) -> int:
    """`penumbra topics [--hz]` of the topics that are known."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    parser = flags.parser("topics", "Lists the table of topics, and with --hz what really arrives.")
    parser.add_argument("--hz", action="store_true", help="listen to everything; print what arrives and how the processes fare")
    parser.add_argument("--seconds", type=flags.above_zero, default=3.0, help="how long to listen (default: %(default)s)")
    options = parser.parse_args(argv)
    cell = cells.load(options.cell)
    console = Console(width=None if sys.stdout.isatty() else 200)
    if not options.hz:
        table = Table("topic", "key", "message", "Hz", "slow link", "quality of service", "priority", "stale after", "from",
                      "what", box=None)  # fmt: skip
        for topic in known:
            key = topic.key.replace("{cell}", cell.name)
            table.add_row(topic.name, key, topic.message.__name__, f"{topic.rate_hz:g}", f"{topic.slow_hz:g}",
                          topic.qos.name.lower().replace("_", " "), topic.priority.name.lower(), f"{topic.stale_s:g} s",
                          " or ".join(topic.publishers), escape(topic.about))  # fmt: skip
        console.print(table)
        return 0
    report, instances = listen(cell, bus.connection(options), options.seconds, known)
    table = Table("key", "Hz", "expected", "delay ms", "dropped", "bad", box=None)
    for key, row in report.items():
        expected = bus.topic_of(key, known)
        if row.count or row.bad or "*" not in key:
            delay = "-" if row.delay_s is None else f"{1e3 * row.delay_s:.1f}"
            bad = ", ".join(f"{n} {kind}" for kind, n in row.bad.items()) or "0"
            table.add_row(
                key, f"{row.rate_hz:.1f}", f"{expected.rate_hz:g}" if expected else "", delay, str(row.dropped or 0), bad
            )
    console.print(table)
    table = Table("process", "instance", "status", "reasons", box=None)
    for instance in instances:
        table.add_row(instance.service, instance.instance, instance.status, escape("; ".join(instance.reasons)))
    console.print()
    console.print(table)
    return 0


def listen(
    cell: cells.Cell, connection: bus.Connection, seconds: float, known: Sequence[topics.Topic] = topics.TOPICS
) -> tuple[dict[str, TopicReport], list[health.Instance]]:
    """The counters of every key of the topics that are known after listening for a while, and how the cell's processes fare."""
    from shared.runtime.node import Node

    node = Node("topics", cell, connection)
    for topic in known:
        node.subscribe(topic, lambda message, names: None)
    with node.open(PATIENCE_S):
        assert node.session is not None
        node.stopping.wait(seconds)
        instances = [found for found in health.ask(node.session, cell.name) if found.instance != node.instance]
        return node.report().topics, instances


def sim(argv: list[str]) -> int:
    """`penumbra sim COMMAND [VALUE ...]`: what is possible is the emulator's to say."""
    parser = flags.parser(
        "sim",
        "Steers the emulator: occlude LEVEL|auto, motion on|off, pause, resume, speed FACTOR, state, "
        "skin PAD[/ELECTRODE] dead|saturated|drift|hum|gain|turned|mirrored|none [SIZE], "
        "board PAD-NUMBER error|lost|short|missing|slip.",
    )
    parser.add_argument("command", help="occlude, motion, pause, resume, speed, skin, board or state")
    parser.add_argument("value", nargs="*", help="of occlude, motion, speed, skin and board")
    options = parser.parse_args(argv)
    cell = cells.load(options.cell)
    request = {"command": options.command} | ({"value": " ".join(options.value)} if options.value else {})
    with open_session(replace(bus.connection(options), service=access.OPERATOR)) as session:
        answers = bus.ask(session, topics.control(cell.name), payload=json.dumps(request).encode())
    if not answers:
        raise bus.BusError(f"no emulator in cell {cell.name}: start `penumbra emulator` or `penumbra up`")
    print(answers[0].decode())
    return 0


def open_session(connection: bus.Connection) -> zenoh.Session:
    nothing: Callable[[], None] = lambda: None  # noqa: E731
    return bus.open_session(connection, threading.Event(), nothing, PATIENCE_S)
