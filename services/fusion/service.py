"""Wiring of the fusion service: poses of the senses in, the fused pose out at 200 Hz and to whoever asks."""

from __future__ import annotations

import argparse
import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from services.fusion import so3
from services.fusion.estimate import AHEAD_S, Array, Estimate, Refused, information, latest
from services.fusion.observer import Bank, ErrorStateObserver
from services.fusion.paper import PaperObserver
from shared.cell import description
from shared.contract import messages, topics
from shared.geometry import rigid
from shared.runtime.node import ServiceNode

NAME = "fusion"
OBSERVERS = {"default": ErrorStateObserver, "paper": PaperObserver}
PERIOD_S = 1.0 / topics.FUSED.rate_hz
SILENCE_S = 0.025
"""A replica speaks for the one before it in rank after so long a silence: a frozen process counts as alive for another second."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """The service's own flags."""
    parser.add_argument(
        "--observer", choices=sorted(OBSERVERS), default="default", help="default: error-state filter; paper: the paper's"
    )
    parser.add_argument("--target", metavar="NAME", help="fuse this target only (default: all of the cell)")


def start(node: ServiceNode, options: argparse.Namespace) -> None:
    """Wires one observer per target, and one timer for all. Raises CellError for a target that the cell does not have.

    Threads: readers of vision and skin, the timer and the answers share the observers of a `Group` under its lock; `state` and
    what is known of other replicas belong to the timer; `Publishers` has a stream for each reader, which alone uses it.
    """
    names = [node.cell.one("targets", options.target)] if options.target else list(node.cell.targets)
    warm_up(OBSERVERS[options.observer])
    group = Group(options.observer, [node.cell.targets[name] for name in names], node.now_ns)
    fusions = [Fusion(node, name, group, observer) for name, observer in zip(names, group.observers, strict=True)]

    def publish() -> None:
        stamp_ns, estimates = group.estimates()
        for fusion, estimate in zip(fusions, estimates, strict=True):
            fusion.publish(stamp_ns, estimate)

    node.every(PERIOD_S, publish)
    # a replica that takes over goes on with the pose: it does not begin with "lost" while the other one knows it
    node.warm_when(lambda: all(fusion.state != "lost" for fusion in fusions))


def warm_up(kind: type[ErrorStateObserver | PaperObserver]) -> None:
    """Compiles everything, or loads what an earlier start has compiled, so that the first measurement takes no longer than the
    others."""
    observer = kind(np.eye(4), (1.0, 1.0))
    observer.measure("vision", 1, np.eye(4), np.eye(6))
    so3.quaternion(observer.estimate(1).T[:3, :3])


class Group:
    """The observers of the cell's targets, of which all can be asked at once, and their clock now_ns()."""

    def __init__(self, kind: str, targets: list[description.Target], now_ns: Callable[[], int]):
        homes = [target.home.transform for target in targets]
        spreads = [(target.home_spread.position, target.home_spread.rotation) for target in targets]
        self.lock = threading.Lock()
        self._now_ns, self._last_ns = now_ns, now_ns()
        self.observers: Sequence[ErrorStateObserver | PaperObserver]
        if kind == "paper":
            self.observers = [PaperObserver(home, spread) for home, spread in zip(homes, spreads, strict=True)]
            self._bank = None
        else:
            self._bank = Bank(np.array(homes), spreads)
            self.observers = [ErrorStateObserver.of(self._bank, i) for i in range(len(targets))]

    def now_ns(self) -> int:
        """The time, asked with the lock held. Where the clock was set back, all that is known is of a time to come, of which
        nothing can be told now: it is forgotten. Where it was set forward, it is too old."""
        stamp_ns = self._now_ns()
        if stamp_ns < self._last_ns - AHEAD_S * 1e9:
            for observer in self.observers:
                observer.forget()
        self._last_ns = stamp_ns
        return stamp_ns

    def estimates(self) -> tuple[int, list[Estimate]]:
        """The time [ns] and the estimates of all."""
        with self.lock:
            stamp_ns = self.now_ns()
            if self._bank is not None:
                return stamp_ns, self._bank.estimates(stamp_ns)
            return stamp_ns, [observer.estimate(stamp_ns) for observer in self.observers]


class Publishers:
    """Who may speak for a stream: one process at a time. Two that do not know of each other would count every error twice. A
    replica that takes over is heard as soon as the one before it has been silent for a while."""

    def __init__(self) -> None:
        self._speaks: dict[str, tuple[str, float]] = {}

    def check(self, stream: str, publisher: str, now_s: float, silence_s: float) -> None:
        """Raises Refused for a publisher while another one of this stream was heard in the last silence_s. now_s: the time of a
        clock that nobody sets."""
        speaker, heard_s = self._speaks.get(stream, (publisher, now_s))
        if speaker != publisher and now_s - heard_s < silence_s:
            raise Refused(
                "publisher",
                f"{stream}: one publisher expected, {publisher} came beside {speaker}: two processes publish the same poses; "
                "end one of them",
            )
        self._speaks[stream] = publisher, now_s


class Fusion:
    """One target: its observer, what it hears and what it says. Every replica listens, the stream's owner publishes, and the next
    in rank where it is silent. One that knows nothing yet goes on from what the others publish."""

    def __init__(self, node: ServiceNode, target: str, group: Group, observer: ErrorStateObserver | PaperObserver):
        self.node, self.target, self.group, self.observer = node, target, group, observer
        self._publishers = Publishers()
        self._told: set[tuple[str, str]] = set()
        self.state = "lost"
        self._others = node.latest(topics.FUSED, from_others=True, target=target)
        self._others_count, self._heard_s = 0, time.monotonic()
        node.subscribe(topics.VISION, self.on_vision, target=target)
        node.subscribe(topics.HAPTIC, self.on_haptic, target=target)
        node.answer(topics.current_pose(node.cell.name, target), self.answer)
        node.tell(target, self.describe)

    def on_vision(self, message: messages.VisionPose, names: dict[str, str]) -> None:
        """A camera's pose; each camera of the cell is a stream of its own."""
        self._take("vision", message, lambda: self._seen(message, names["publisher"]), message.hidden)

    def on_haptic(self, message: messages.HapticPose, names: dict[str, str]) -> None:
        """The skin's pose."""
        self._take("haptic", message, lambda: self._felt(message, names["publisher"]), None)

    def _hear_others(self) -> None:
        """Notes when another replica spoke last, and takes over the pose that it knows where this one knows none."""
        if (count := self._others.drain()) == self._others_count:
            return
        self._others_count, self._heard_s = count, time.monotonic()
        if self.state != "lost" or self.node.owns(self.target):
            return
        message: messages.FusedPose | None = self._others.get(target=self.target)
        if message is not None and message.state != "lost":
            with self.group.lock:
                if message.stamp_ns <= latest(self.group.now_ns()):
                    self.observer.adopt(message)

    def _seen(self, message: messages.VisionPose, publisher: str) -> Array | None:
        """The information (6, 6) of a camera's pose, None where it is not to be used. Raises Refused."""
        if message.camera not in self.node.cell.cameras:
            known = ", ".join(self.node.cell.cameras)
            raise Refused("camera", f"vision: a camera of the cell ({known}) expected, {message.camera!r:.60} came")
        self._publishers.check(f"vision of camera {message.camera}", publisher, time.monotonic(), topics.VISION.stale_s)
        return information(message.covariance) if message.state == "tracking" else None

    def _felt(self, message: messages.HapticPose, publisher: str) -> Array | None:
        """The information (6, 6) of the skin's pose, None where it is not to be used. Raises Refused."""
        self._publishers.check("haptic", publisher, time.monotonic(), topics.HAPTIC.stale_s)
        return message.information if message.state == "in_range" else None

    def _take(self, source: str, message: Any, read: Callable[[], Array | None], hidden: float | None) -> None:
        """Hands a measurement on to the observer, or the news that a sense is there but has nothing to say; what is refused is
        counted, and told once of each kind."""
        log = self.observer.log
        try:
            self._check_place(source, message)
            information = read()
        except Refused as error:
            log.refused(source, error.kind)
            self._tell(source, error)
            return
        with self.group.lock:
            now_ns = self.group.now_ns()
            if information is None:
                log.heard(source, message.stamp_ns)
                return
            T = rigid.transform(message.position, message.orientation)
            try:
                self.observer.measure(source, message.stamp_ns, T, information, hidden, now_ns)
            except Refused as error:
                self._tell(source, error)

    def _check_place(self, source: str, message: Any) -> None:
        expected, came = (self.target, self.node.cell.frame), (message.target, message.frame)
        if came != expected:
            raise Refused("frame", f"{source}: target and frame {expected} expected, {came!r:.120} came")

    def _tell(self, source: str, error: Refused) -> None:
        if (source, error.kind) not in self._told:
            self._told.add((source, error.kind))
            why = "measurement refused; more of this kind are only counted"
            self.node.log.warning(why, target=self.target, source=source, kind=error.kind, why=str(error))

    def describe(self) -> dict[str, Any]:
        """For the health report: the state, and what became of the measurements of each source."""
        return {"state": self.state, **{source: asdict(counts) for source, counts in self.observer.log.counts.items()}}

    def publish(self, stamp_ns: int, estimate: Estimate) -> None:
        """Publishes an estimate, where it is this replica's turn."""
        self._hear_others()
        changed, self.state = (estimate.state == "lost") != (self.state == "lost"), estimate.state
        if time.monotonic() - self._heard_s < self.node.rank(self.target) * SILENCE_S:
            return
        self.node.publish(topics.FUSED, estimate.message(stamp_ns, self.target, self.node.cell.frame), target=self.target)
        if changed:
            counts = {f"{source}_{what}": n for source, c in self.observer.log.counts.items() for what, n in vars(c).items() if n}
            self.node.log.info("lost" if estimate.state == "lost" else "found", target=self.target, **counts)

    def answer(self, parameters: dict[str, str], payload: bytes) -> tuple[bytes, str]:
        """The current pose, or with `stamp_ns=` that at the stamp of a picture, say, by all that is known by now: MessagePack of
        FusedPose, or JSON with `format=json`. Raises ValueError on another format, and a stamp that is none or out of reach."""
        form = parameters.get("format", "msgpack")
        if form not in ("msgpack", "json"):
            raise ValueError(f"format: msgpack or json expected, {form!r} came")
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
    """The stamp [ns] that is asked for. Raises ValueError where none is known there."""
    if not text.isdecimal() or not earliest_ns <= int(text) <= now_ns:
        raise ValueError(f"stamp_ns: nanoseconds from {earliest_ns} to {now_ns} expected, {text!r} came: ask within the history")
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
