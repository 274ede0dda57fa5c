"""Connects fusion to the bus: measurements of the senses in, the fused pose out at 200 Hz and on request."""

from __future__ import annotations

import itertools
import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

from penumbra.services import flags
from penumbra.services.fusion import paper
from penumbra.services.fusion.estimate import Estimate, RefusedMeasurement, latest, measured, stream_of
from penumbra.services.fusion.observer import Bank, ErrorStateObserver
from penumbra.services.fusion.paper import PaperObserver, PaperSettings
from penumbra.services.fusion.settings import FusionSettings, Subject, with_motion
from penumbra.shared.contract import messages, outline, topics
from penumbra.shared.contract.senses import SENSES, Sense
from penumbra.shared.geometry import rigid
from penumbra.shared.runtime.node import ServiceNode

NAME = "fusion"
OBSERVERS = {"default": ErrorStateObserver, "paper": PaperObserver}
PERIOD_S = 1.0 / topics.FUSED.rate_hz
SILENCE_S = 0.025
"""Time [s] of silence of the replica before it in rank after which a replica publishes, five periods: a frozen process counts as
alive for ten times as long."""
WAITING = 5
"""Number of periods after which a replica that does not publish reads its own pose: it only has to know whether it has one."""
SET_BACK_S = 0.05
"""A clock that goes back by more than this [s] was set; by less, it is being synchronised. Chosen, not measured."""


FLAGS = (
    flags.Option(
        "--observer", choices=sorted(OBSERVERS), default="default", help="default: error-state filter; paper: the paper's"
    ),
    flags.Option("--target", metavar="NAME", show_default="all of the cell", help="fuse only this target"),
    flags.Option(
        "--motion",
        type=with_motion,
        metavar="FILE.json",
        show_default="the built-in one",
        help="how limbs move, learned by penumbra replay --smooth --motion; of the default observer",
    ),
)
EXAMPLE = "penumbra fusion --cell table --observer paper"


def start(node: ServiceNode, options: flags.Options, senses: Sequence[Sense] = SENSES) -> None:
    """Creates one observer per target, and one timer for all. senses: senses whose measurements are used; the paper's observer
    uses only its two. Raises CellError for a target that the cell does not have.

    Threads: the senses' readers, the timer and the answers share the observers of a `Group` under its lock; only the timer uses
    `state` and the data on other replicas; `Publishers` has a stream for each reader, and only this reader uses it.
    """
    names = [node.cell.one("targets", options.target)] if options.target else list(node.cell.targets)
    if options.observer == "paper":
        senses = [sense for sense in senses if sense.name in paper.SENSES]
    subjects = [Subject.of(node.cell.targets[name], node.cell.body) for name in names]
    group = Group(options.observer, subjects, node.now_ns, senses, options.motion)
    described = outline.of(node.cell).encode(), "application/json"
    node.answer(topics.description(node.cell.name), lambda parameters, payload: described)
    fusions = [Fusion(node, name, group, observer, senses) for name, observer in zip(names, group.observers, strict=True)]

    turns = itertools.count()

    def publish() -> None:
        due = [fusion.is_due() for fusion in fusions]
        if any(due) or next(turns) % WAITING == 0:
            stamp_ns, estimates = group.estimates()
            for fusion, estimate, is_due in zip(fusions, estimates, due, strict=True):
                fusion.take(stamp_ns, estimate, is_due)

    node.every(PERIOD_S, publish)
    # a replica that takes over continues the pose: it does not start with "lost" while the other one knows the pose
    node.warm_when(lambda: all(fusion.state != "lost" for fusion in fusions))


class Group:
    """The observers of the cell's targets, which can all be asked at once, and their clock now_ns()."""

    def __init__(
        self,
        kind: str,
        subjects: list[Subject],
        now_ns: Callable[[], int],
        senses: Sequence[Sense] = SENSES,
        settings: FusionSettings | None = None,
    ):
        self.lock = threading.Lock()
        self._now_ns, self._last_ns = now_ns, now_ns()
        self.observers: Sequence[ErrorStateObserver | PaperObserver]
        if kind == "paper":
            self.observers = [PaperObserver(each.home, each.spread, PaperSettings(limits=each.limits)) for each in subjects]
            self._bank = None
        else:
            self._bank = Bank(subjects, settings, senses)
            self.observers = [ErrorStateObserver.of(self._bank, i) for i in range(len(subjects))]

    def now_ns(self) -> int:
        """The time; the caller holds the lock. If the clock was set back, all stamps are in the future and say nothing about the
        present: the observers start over. If it was set forward, all measurements are too old."""
        stamp_ns = self._now_ns()
        if stamp_ns < self._last_ns - SET_BACK_S * 1e9:
            for observer in self.observers:
                observer.forget()
        self._last_ns = stamp_ns
        return stamp_ns

    def estimates(self) -> tuple[int, list[Estimate]]:
        """The time [ns] and the estimates of all targets."""
        with self.lock:
            stamp_ns = self.now_ns()
            if self._bank is not None:
                return stamp_ns, self._bank.estimates(stamp_ns)
            return stamp_ns, [observer.estimate(stamp_ns) for observer in self.observers]


class Publishers:
    """The publisher of each stream: one process at a time. Two processes that do not know of each other would count every error
    twice. A replica that takes over is accepted as soon as the one before it has been silent for a while."""

    def __init__(self) -> None:
        self._publishers: dict[str, tuple[str, float]] = {}

    def check(self, stream: str, publisher: str, now_s: float, silence_s: float) -> None:
        """Raises RefusedMeasurement for a publisher if another one of this stream has published in the last silence_s. now_s:
        from a monotonic clock."""
        known, received_s = self._publishers.get(stream, (publisher, now_s))
        if known != publisher and now_s - received_s < silence_s:
            raise RefusedMeasurement(
                "publisher",
                f"{stream}: expected one publisher, got {publisher} beside {known}: two processes publish the same poses; "
                "end one of them",
            )
        self._publishers[stream] = publisher, now_s


class Fusion:
    """One target: its observer, its measurements and its pose. Every replica receives the measurements. The stream's owner
    publishes, and if it is silent, the next replica in rank. A replica without a pose continues from the poses of the others."""

    def __init__(
        self, node: ServiceNode, target: str, group: Group, observer: ErrorStateObserver | PaperObserver, senses: Sequence[Sense]
    ):
        self.node, self.target, self.group, self.observer = node, target, group, observer
        self._publishers = Publishers()
        self._logged: set[tuple[str, str]] = set()
        self.state = "lost"
        self._others = node.latest(topics.FUSED, from_others=True, target=target)
        self._others_count, self._others_s = 0, time.monotonic()
        for sense in senses:
            node.subscribe(sense.topic, partial(self.on_measurement, sense), target=target)
        node.answer(topics.current_pose(node.cell.name, target), self.answer)
        node.add_report(target, self.describe)

    def on_measurement(self, sense: Sense, message: Any, names: dict[str, str]) -> None:
        """Passes a measurement to the observer, or that a sense denies that the target is where it is expected, or that it runs
        but observes nothing. Refused measurements are counted, and the first of each kind is logged."""
        log = self.observer.log
        try:
            self._check_origin(sense, message, names["publisher"])
            is_usable = sense.usable is None or message.state == sense.usable
            found = measured(message, sense.measures) if is_usable else None
        except RefusedMeasurement as error:
            log.refused(sense.name, error.kind)
            self._log(sense.name, error)
            return
        with self.group.lock:
            now_ns = self.group.now_ns()
            if found is None:
                if message.state == sense.denies:
                    self.observer.deny(sense.name, message.stamp_ns, now_ns)
                else:
                    log.received(sense.name, message.stamp_ns)
                return
            hidden = getattr(message, "hidden", None)  # the share with which the paper's observer weights the camera
            try:
                T, information, step = found
                self.observer.measure(sense.name, message.stamp_ns, T, information, hidden, now_ns, step)
            except RefusedMeasurement as error:
                self._log(sense.name, error)

    def _check_origin(self, sense: Sense, message: Any, publisher: str) -> None:
        """Raises RefusedMeasurement for a message of another target, frame or part of the cell, and for a second publisher."""
        stream = stream_of(sense, message, self.target, self.node.cell)
        self._publishers.check(stream, publisher, time.monotonic(), sense.topic.stale_s)

    def _follow_others(self) -> None:
        """Notes when another replica published last, and adopts its pose if this one has none."""
        if (count := self._others.drain()) == self._others_count:
            return
        self._others_count, self._others_s = count, time.monotonic()
        if self.state != "lost" or self.node.owns(self.target):
            return
        message: messages.FusedPose | None = self._others.get(target=self.target)
        if message is not None and message.state != "lost":
            with self.group.lock:
                if message.stamp_ns <= latest(self.group.now_ns()):
                    self.observer.adopt(message)

    def _log(self, source: str, error: RefusedMeasurement) -> None:
        if (source, error.kind) not in self._logged:
            self._logged.add((source, error.kind))
            why = "measurement refused; more of this kind are only counted"
            self.node.log.warning(why, target=self.target, source=source, kind=error.kind, why=str(error))

    def describe(self) -> dict[str, Any]:
        """Fields of the health report: the state, and the outcomes of the measurements of each source."""
        return {"state": self.state, **{source: asdict(counts) for source, counts in self.observer.log.counts.items()}}

    def is_due(self) -> bool:
        """Whether it is this replica's turn to publish."""
        self._follow_others()
        return time.monotonic() - self._others_s >= self.node.rank(self.target) * SILENCE_S

    def take(self, stamp_ns: int, estimate: Estimate, is_due: bool) -> None:
        """Notes an estimate's state, and publishes the estimate if that is due."""
        changed, self.state = (estimate.state == "lost") != (self.state == "lost"), estimate.state
        if not is_due:
            return
        self.node.publish(topics.FUSED, estimate.message(stamp_ns, self.target, self.node.cell.frame), target=self.target)
        if changed:
            counts = {f"{source}_{what}": n for source, c in self.observer.log.counts.items() for what, n in vars(c).items() if n}
            self.node.log.info("lost" if estimate.state == "lost" else "found", target=self.target, **counts)

    def answer(self, parameters: dict[str, str], payload: bytes) -> tuple[bytes, str]:
        """The current pose, or with `stamp_ns=` the pose at that stamp, such as a picture's, using all measurements received so
        far: MessagePack of FusedPose, or JSON with `format=json`. Raises ValueError for another format, and for a stamp that is
        no number or outside the history."""
        form = parameters.get("format", "msgpack")
        if form not in ("msgpack", "json"):
            raise ValueError(f"format: expected msgpack or json, got {form!r}")
        with self.group.lock:
            stamp_ns = self.group.now_ns()
            if "stamp_ns" in parameters:
                stamp_ns = _within(parameters["stamp_ns"], self.observer.earliest_ns, stamp_ns)
            estimate = self.observer.estimate(stamp_ns)
        message = estimate.message(stamp_ns, self.target, self.node.cell.frame)
        if form == "msgpack":
            return messages.encode(message), "application/msgpack"
        return json.dumps(as_json(message)).encode(), "application/json"


def _within(text: str, earliest_ns: int, now_ns: int) -> int:
    """The requested stamp [ns]. Raises ValueError if no pose is known there."""
    if not text.isdecimal() or not earliest_ns <= int(text) <= now_ns:
        raise ValueError(f"stamp_ns: expected nanoseconds from {earliest_ns} to {now_ns}, got {text!r}; ask within the history")
    return int(text)


def as_json(message: messages.FusedPose) -> dict[str, Any]:
    """The answer in JSON: metres, radians, seconds; orientation (x, y, z, w), rpy about the fixed axes."""
    return {
        "target": message.target,
        "frame": message.frame,
        "stamp_ns": message.stamp_ns,
        "position": message.position.tolist(),
        "orientation": message.orientation.tolist(),
        "rpy": rigid.rpy(message.orientation).tolist(),
        "velocity": message.velocity.tolist(),
        "covariance": message.covariance.tolist(),
        "state": message.state,
        "sources": {name: {"age_s": source.age_s, "weight": source.weight} for name, source in message.sources.items()},
    }
