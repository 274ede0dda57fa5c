"""Wiring of the fusion service: poses of the senses in, the fused pose out at 200 Hz and to whoever asks."""

from __future__ import annotations

import argparse
import json
import threading
from typing import Any

import numpy as np

from services.fusion import so3
from services.fusion.estimate import Estimate, information
from services.fusion.observer import ErrorStateObserver
from services.fusion.paper import PaperObserver
from shared import cell, geometry, messages, topics
from shared.service import Node

NAME = "fusion"
OBSERVERS = {"default": ErrorStateObserver, "paper": PaperObserver}
PERIOD_S = 1.0 / topics.FUSED.rate_hz


def arguments(parser: argparse.ArgumentParser) -> None:
    """The service's own flags."""
    parser.add_argument(
        "--observer", choices=sorted(OBSERVERS), default="default", help="default: error-state filter; paper: the paper's"
    )
    parser.add_argument("--target", metavar="NAME", help="fuse this target only (default: all of the cell)")


def start(node: Node, options: argparse.Namespace) -> None:
    """Wires one observer per target. Raises CellError for a target that the cell does not have."""
    names = [node.cell.one("targets", options.target)] if options.target else list(node.cell.targets)
    for name in names:
        Fusion(node, name, options.observer)


class Fusion:
    """One target: its observer, what it hears and what it says. Every replica listens, the stream's owner publishes."""

    def __init__(self, node: Node, target: str, observer: str):
        self.node, self.target = node, target
        home: cell.Target = node.cell.targets[target]
        spread = (home.home_spread.position, home.home_spread.rotation)
        self.observer = OBSERVERS[observer](home.home.transform, spread)
        self._lock = threading.Lock()
        self._state = "lost"
        node.subscribe(topics.VISION, self.on_vision, target=target)
        node.subscribe(topics.HAPTIC, self.on_haptic, target=target)
        node.every(PERIOD_S, self.publish)
        node.answer(topics.current_pose(node.cell.name, target), self.answer)

    def on_vision(self, message: messages.VisionPose, names: dict[str, str]) -> None:
        self._take("vision", message, information(message.covariance) if message.state == "tracking" else None, message.hidden)

    def on_haptic(self, message: messages.HapticPose, names: dict[str, str]) -> None:
        self._take("haptic", message, message.information if message.state == "in_range" else None, None)

    def _take(self, source: str, message: Any, information: Any, hidden: float | None) -> None:
        """A measurement, or with no information the news that a sense is there but has nothing to say."""
        expected = (self.target, self.node.cell.frame)
        if (message.target, message.frame) != expected:
            raise ValueError(f"{source} pose: target and frame {expected} expected, {(message.target, message.frame)} came")
        if information is None:
            with self._lock:
                self.observer.log.heard(source, message.stamp_ns)
            return
        T = geometry.transform(message.position, message.orientation)
        with self._lock:
            self.observer.measure(source, message.stamp_ns, T, information, hidden)

    def publish(self) -> None:
        if not self.node.owns(self.target):
            return
        stamp_ns, estimate = self._now()
        self.node.publish(topics.FUSED, self._message(stamp_ns, estimate), target=self.target)
        if (estimate.state == "lost") != (self._state == "lost"):
            counts = {f"{source}_{what}": n for source, c in self.observer.log.counts.items() for what, n in vars(c).items() if n}
            self.node.log.info("lost" if estimate.state == "lost" else "found", target=self.target, **counts)
        self._state = estimate.state

    def answer(self, parameters: dict[str, str], payload: bytes) -> tuple[bytes, str]:
        """The current pose: MessagePack of FusedPose, or JSON with `format=json`. Raises ValueError on another format."""
        form = parameters.get("format", "msgpack")
        if form not in ("msgpack", "json"):
            raise ValueError(f"format: msgpack or json expected, {form!r} came")
        message = self._message(*self._now())
        if form == "msgpack":
            return messages.encode(message), "application/msgpack"
        return json.dumps(as_json(message)).encode(), "application/json"

    def _now(self) -> tuple[int, Estimate]:
        with self._lock:
            stamp_ns = self.node.now_ns()
            return stamp_ns, self.observer.estimate(stamp_ns)

    def _message(self, stamp_ns: int, estimate: Estimate) -> messages.FusedPose:
        return messages.FusedPose(
            stamp_ns=stamp_ns,
            target=self.target,
            frame=self.node.cell.frame,
            position=estimate.T[:3, 3],
            orientation=np.array(so3.quaternion(estimate.T[:3, :3])),
            velocity=estimate.velocity,
            covariance=estimate.covariance,
            state=estimate.state,
            sources=estimate.sources,
        )


def as_json(message: messages.FusedPose) -> dict[str, Any]:
    """The answer in JSON: metres, radians, seconds; orientation (x, y, z, w), rpy about the fixed axes."""
    return {
        "target": message.target,
        "frame": message.frame,
        "stamp_ns": message.stamp_ns,
        "position": message.position.tolist(),
        "orientation": message.orientation.tolist(),
        "rpy": geometry.rpy(message.orientation).tolist(),
        "velocity": message.velocity.tolist(),
        "covariance": message.covariance.tolist(),
        "state": message.state,
        "sources": {name: {"age_s": source.age_s, "weight": source.weight} for name, source in message.sources.items()},
    }
