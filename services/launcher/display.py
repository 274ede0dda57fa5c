"""What the launcher shows: processes, topics, the pose and its error, as a table that redraws itself or as plain lines."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zenoh
from rich.console import Group
from rich.table import Table
from rich.text import Text

from services.launcher.supervised import ProcessRow
from shared.contract import report, topics
from shared.contract.messages import BadMessage, FusedPose, Truth, decode
from shared.contract.report import Report
from shared.geometry import rigid
from shared.runtime import bus
from shared.runtime.node import Node

ANSWER_S = 2.0
"""How long an instance may take to say how it is."""
STYLES = {"running": "green", "starting": "yellow", "degraded": "yellow"}


@dataclass
class TopicRow:
    """All keys of one topic: rates by key, of all replicas that publish it together; delays to readers; sums of what was dropped
    and refused."""

    name: str
    rates: dict[str, float] = field(default_factory=dict)
    delays_s: list[float] = field(default_factory=list)
    dropped: int = 0
    bad: int = 0

    @property
    def rate_hz(self) -> float:
        """Mean rate of a key."""
        return sum(self.rates.values()) / len(self.rates) if self.rates else 0.0


@dataclass(frozen=True)
class Accuracy:
    """The fused pose, and where the truth is known its error: position [m] and limb axis [rad]."""

    pose: FusedPose
    position: float = math.nan
    axis: float = math.nan


class Watch:
    """Looks at a cell once a `refresh`: the health of every instance and the newest fused pose beside the truth.

    Truth and pose are taken from small rings when they are looked at: nothing is decoded in between.
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
        self.has_tracked = False  # whether a fused pose was `tracking` at some look

    def refresh(self) -> None:
        """Asks all instances how they are; `health` is then their answers by instance."""
        found = [report.read(answer) for answer in self._node.query(topics.health(self._node.cell.name), timeout_s=ANSWER_S)]
        self.health = {each.instance: each for each in found}
        self._look_at_pose()

    def local(self) -> dict[int, Report]:
        """The answers of this host's instances by pid."""
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
        rows = {topic.name: TopicRow(topic.name) for topic in topics.TOPICS if self._node.keys(topic, {})}
        for found in self.health.values():
            for key, traffic in found.published.items():
                if (topic := bus.topic_of(key)) is not None and topic.name in rows:
                    rates = rows[topic.name].rates
                    rates[key] = rates.get(key, 0.0) + traffic.rate_hz
            for key, traffic in found.topics.items():
                if (topic := bus.topic_of(key.partition(" #")[0])) is not None and topic.name in rows:
                    row = rows[topic.name]
                    row.delays_s += [traffic.delay_s] if traffic.delay_s is not None else []
                    row.dropped += traffic.dropped or 0
                    row.bad += sum(traffic.bad.values())
        return list(rows.values())


def accuracy(pose: FusedPose, truths: Iterable[Truth]) -> Accuracy:
    """The error of a pose against the truth nearest in time, moved to the pose's stamp by its velocity."""
    truth = min(truths, key=lambda truth: abs(truth.stamp_ns - pose.stamp_ns), default=None)
    if truth is None:
        return Accuracy(pose)
    elapsed_s = (pose.stamp_ns - truth.stamp_ns) * 1e-9
    T_true = rigid.perturb(rigid.transform(truth.position, truth.orientation), truth.velocity * elapsed_s)
    T = rigid.transform(pose.position, pose.orientation)
    return Accuracy(pose, float(np.linalg.norm(T_true[:3, 3] - T[:3, 3])), rigid.axis_angle_error(T_true, T))


def table(title: str, processes: list[ProcessRow], watch: Watch) -> Group:
    """Everything at one look."""
    left = Table("process", "state", "pid", "CPU %", "MB", "restarts", "", box=None)
    for row in processes:
        state = Text(row.state, STYLES.get(row.state, "red"))
        numbers = (f"{100 * row.cpu:.0f}", f"{row.memory_mb:.0f}") if row.pid else ("", "")
        left.add_row(row.name, state, str(row.pid or ""), *numbers, str(row.restarts), Text(row.note, overflow="ellipsis"))
    right = Table("topic", "Hz", "expected", "delay ms", "dropped", "refused", box=None)
    for line in watch.topic_rows():
        expected = next(topic.rate_hz for topic in topics.TOPICS if topic.name == line.name)
        delay = f"{1e3 * max(line.delays_s):.1f}" if line.delays_s else "-"
        right.add_row(line.name, f"{line.rate_hz:.1f}", f"{expected:g}", delay, str(line.dropped), str(line.bad))
    return Group(Text(title), left, Text(), right, Text(), Text(pose_line(watch.accuracy)))


def pose_line(accuracy: Accuracy | None) -> str:
    """The pose and its error in one line."""
    if accuracy is None:
        return "pose: none yet"
    pose = accuracy.pose
    position = " ".join(f"{100 * value:.1f}" for value in pose.position)
    rpy = " ".join(f"{math.degrees(value):.0f}" for value in rigid.rpy(pose.orientation))
    senses = ", ".join(f"{name} {100 * source.weight:.0f} %" for name, source in sorted(pose.sources.items())) or "no sense"
    line = f"pose of {pose.target}: {pose.state}, at {position} cm, rpy {rpy} deg, from {senses}"
    if math.isfinite(accuracy.position):
        line += f", error {100 * accuracy.position:.2f} cm and {math.degrees(accuracy.axis):.1f} deg"
    return line


def plain(processes: list[ProcessRow], watch: Watch) -> str:
    """The same in a few words, for a log."""
    states = ", ".join(f"{row.name} {row.state}" + (f" ({row.note})" if row.note else "") for row in processes)
    rates = ", ".join(f"{row.name} {row.rate_hz:.0f}" for row in watch.topic_rows() if row.rates)
    return f"{time.strftime('%H:%M:%S')} {states}; Hz: {rates or 'nothing yet'}; {pose_line(watch.accuracy)}"


def summary(processes: list[ProcessRow], watch: Watch) -> str:
    """What happened, at the end."""
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
