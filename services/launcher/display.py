"""Display of the launcher: processes, topics, the pose and its error, as a live table or as plain lines."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import zenoh
from rich.console import Group
from rich.table import Table
from rich.text import Text

from penumbra.services.launcher.supervised import ProcessRow
from penumbra.shared.contract import report, topics
from penumbra.shared.contract.messages import BadMessage, FusedPose, Truth, decode
from penumbra.shared.contract.report import Report
from penumbra.shared.geometry import rigid
from penumbra.shared.perception.accuracy import Accuracy, accuracy
from penumbra.shared.runtime.node import Node
from penumbra.shared.runtime.rates import TopicRow, topic_rows

ANSWER_S = 2.0
"""Maximum time [s] for an instance to answer the health query."""
STYLES = {"running": "green", "starting": "yellow", "degraded": "yellow", "tracking": "green", "coasting": "yellow"}
PASSING = {"running", "degraded", "tracking", "coasting", "lost"}
"""States between which a process or a pose may change briefly."""
LASTS_S = 1.5
"""Time [s] for which a change between passing states must last before it is shown."""
WIDE = 70
"""Minimum number of terminal columns for which all columns of the tables are shown."""


class Watch:
    """Observes a cell at each `refresh`: the health of every instance, and the newest fused pose against the truth.

    Truth and pose are read from small ring buffers at each refresh: nothing is decoded in between.
    """

    def __init__(self, node: Node):
        self._node = node
        self._target = node.cell.one("targets", None)
        session = node.session
        assert session is not None, "the node must be open"
        names = {"cell": node.cell.name, "target": self._target}
        self._fused = session.declare_subscriber(topics.FUSED.at(**names), zenoh.handlers.RingChannel(1))
        self._truth = session.declare_subscriber(topics.TRUTH.at(**names), zenoh.handlers.RingChannel(64))
        self.health: dict[str, Report] = {}
        self.accuracy: Accuracy | None = None
        self.errors: list[tuple[float, float]] = []
        self.has_tracked = False  # whether a fused pose was `tracking` at some refresh

    def refresh(self) -> None:
        """Query the health of all instances; `health` holds their answers by instance."""
        found = [report.read(answer) for answer in self._node.query(topics.health(self._node.cell.name), timeout_s=ANSWER_S)]
        self.health = {each.instance: each for each in found}
        self._look_at_pose()

    def local(self) -> dict[int, Report]:
        """The reports of this host's instances, by pid."""
        host = socket.gethostname()
        return {each.pid: each for each in self.health.values() if each.host == host}

    def _look_at_pose(self) -> None:
        samples = list(_drain(self._fused))
        truths = list(_drain(self._truth))
        try:
            pose = decode(FusedPose, samples[-1].payload.to_bytes(), self._node.now_ns()) if samples else None
            near = [decode(Truth, sample.payload.to_bytes()) for sample in truths] if pose else []
        except BadMessage:
            return
        if pose is None:
            self.accuracy = None
            return
        self.has_tracked |= pose.state == "tracking"
        self.accuracy = accuracy(pose, near)
        if math.isfinite(self.accuracy.position):
            self.errors.append((self.accuracy.position, self.accuracy.axis))

    def topic_rows(self) -> list[TopicRow]:
        """The traffic of the cell: rates as published, delays and losses as received."""
        return topic_rows(self.health.values(), (topic.name for topic in topics.TOPICS if self._node.keys(topic, {})))


class Steady:
    """Displayed states: a change is shown once it has lasted, so that brief changes do not flicker."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._shown: dict[str, str] = {}
        self._since: dict[str, tuple[str, float]] = {}

    def show(self, name: str, state: str) -> str:
        """The state to show for a name. States outside PASSING are shown at once: such a process has ended or begun."""
        now = self._clock()
        shown = self._shown.setdefault(name, state)
        if state == shown:
            self._since.pop(name, None)
            return shown
        since = self._since.get(name)
        if since is None or since[0] != state:
            since = self._since[name] = (state, now)
        if not {state, shown} <= PASSING or now - since[1] >= LASTS_S:
            self._shown[name] = state
            self._since.pop(name, None)
        return self._shown[name]


class Picture:
    """The screen: the pose first, then the processes, then the topics, cut to the size of the terminal. hint: a command for
    another terminal; link: returns the link of the web page, empty while it is not served."""

    def __init__(self, hint: str, watch: Watch, link: Callable[[], str] = str):
        self._hint, self._watch, self._link = hint, watch, link
        self._steady = Steady()

    def draw(self, processes: list[ProcessRow], width: int, height: int) -> Group:
        """Render at most `height` rows of `width` columns."""
        link = self._link()
        page = [Text(link, "dim", no_wrap=True, overflow="fold")] if link else []  # a truncated link is useless
        head = [_line(f"{self._hint}   (in another terminal)", "dim"), *page, *self._pose()]
        is_wide = width >= WIDE
        names = ("process", "state", "pid", "CPU %", "MB", "restarts", "") if is_wide else ("process", "state", "")
        left = []
        for row in processes:
            state = self._steady.show(row.name, row.state)
            numbers = (f"{100 * row.cpu:.0f}", f"{row.memory_mb:.0f}") if row.pid else ("", "")
            middle = (str(row.pid or ""), *numbers, str(row.restarts)) if is_wide else ()
            note = row.note if state != "running" or row.state in ("waiting", "failed") else ""
            left.append([Text(row.name), Text(state, STYLES.get(state, "red")), *map(Text, middle), Text(note)])
        columns = ("topic", "Hz", "expected", "delay ms", "dropped", "refused") if is_wide else ("topic", "Hz", "expected")
        right = []
        for line in self._watch.topic_rows():
            expected = next(topic.rate_hz for topic in topics.TOPICS if topic.name == line.name)
            delay = f"{1e3 * max(line.delays_s):.1f}" if line.delays_s else "-"
            more = (delay, str(line.dropped), str(line.bad)) if is_wide else ()
            right.append([*map(Text, (line.name, f"{line.rate_hz:.1f}", f"{expected:g}", *more))])
        room = height - len(head) - len(left) - 3  # two headings, and the cursor's line
        tables = [_table(names, left, width)]
        if room > 0 and right:
            tables.append(_table(columns, right[:room], width))
        return Group(*head, *tables)

    def _pose(self) -> list[Text]:
        """Lines of less than 40 columns."""
        found = self._watch.accuracy
        if found is None:
            return [_line("no pose yet", "yellow")]
        pose = found.pose
        state = self._steady.show("the pose", pose.state)
        x, y, z = (round(100 * value, 1) + 0.0 for value in pose.position)  # no minus before a zero
        roll, pitch, yaw = (round(math.degrees(value)) for value in rigid.rpy(pose.orientation))
        senses = ", ".join(f"{name} {100 * source.weight:.0f} %" for name, source in sorted(pose.sources.items()))
        lines = [
            _line(f"{pose.target}: {state}", f"bold {STYLES.get(state, 'red')}"),
            _line(f"x {x:.1f}  y {y:.1f}  z {z:.1f} cm"),
            _line(f"roll {roll}  pitch {pitch}  yaw {yaw} deg"),
            _line(f"from {senses or 'no sense'}"),
        ]
        if math.isfinite(found.position):
            lines.append(_line(f"error {100 * found.position:.2f} cm, {math.degrees(found.axis):.1f} deg"))
        return lines


def _line(text: str, style: str = "") -> Text:
    return Text(text, style, no_wrap=True, overflow="ellipsis")


def _table(columns: Sequence[str], rows: Sequence[Sequence[Text]], width: int) -> Table:
    """A table whose names and numbers keep their width; the last column gets the rest of `width`, and is cut."""
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))  # one column of space between two, as counted below
    left = width
    for k, name in enumerate(columns):
        needed = max([len(name), *(len(row[k]) for row in rows)])
        needed = min(needed, left) if k == len(columns) - 1 else needed
        left -= needed + 1
        table.add_column(name, no_wrap=True, overflow="ellipsis", width=max(needed, 1))
    for row in rows:
        table.add_row(*row)
    return table


def pose_line(accuracy: Accuracy | None) -> str:
    """The pose and its error in one line."""
    if accuracy is None:
        return "pose: none yet"
    pose = accuracy.pose
    position = " ".join(f"{100 * value:z.1f}" for value in pose.position)
    rpy = " ".join(f"{math.degrees(value):z.0f}" for value in rigid.rpy(pose.orientation))
    senses = ", ".join(f"{name} {100 * source.weight:.0f} %" for name, source in sorted(pose.sources.items())) or "no sense"
    line = f"pose of {pose.target}: {pose.state}, at {position} cm, rpy {rpy} deg, from {senses}"
    if math.isfinite(accuracy.position):
        line += f", error {100 * accuracy.position:.2f} cm and {math.degrees(accuracy.axis):.1f} deg"
    return line


def plain(processes: list[ProcessRow], watch: Watch, link: str = "") -> str:
    """The same in one line, for a log. link: of the web page, empty while it is not served."""
    states = ", ".join(f"{row.name} {row.state}" + (f" ({row.note})" if row.note else "") for row in processes)
    rates = ", ".join(f"{row.name} {row.rate_hz:.0f}" for row in watch.topic_rows() if row.rates)
    return f"{time.strftime('%H:%M:%S')} {pose_line(watch.accuracy)}; {states}; Hz: {rates or 'nothing yet'}" + (
        f"; page: {link}" if link else ""
    )


def summary(processes: list[ProcessRow], watch: Watch) -> str:
    """A final summary."""
    restarts = ", ".join(f"{row.name} {row.restarts}" for row in processes if row.restarts) or "none"
    failed = ", ".join(f"{row.name}: {row.note}" for row in processes if row.state == "failed")
    lines = [f"restarts: {restarts}"] + ([f"failed: {failed}"] if failed else [])
    if watch.errors:
        position, axis = np.median(watch.errors, axis=0)
        lines.append(f"median error of the fused pose: {100 * position:.2f} cm, {math.degrees(axis):.1f} deg")
    return "\n".join(lines)


def _drain(subscriber: Any) -> Iterable[zenoh.Sample]:
    while (sample := subscriber.try_recv()) is not None:
        yield sample
