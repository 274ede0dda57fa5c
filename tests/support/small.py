"""A small real chain in this process: a router, fusion, and a method that measures a resting arm."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from penumbra.services.fusion import service as fusion
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node

POSITION = (0.05, -0.02, 0.15)
"""Where the arm rests [m]."""


@dataclass
class Small:
    """The chain. connection: to its router. seen: whether the arm is measured, at 20 Hz."""

    cell: cells.Cell
    connection: bus.Connection
    seen: threading.Event

    def node(self, service: str) -> Node:
        """A node that connects to the router, not yet open."""
        return Node(service, self.cell, self.connection)

    @contextmanager
    def fusion(self) -> Iterator[Node]:
        """Runs the real service in the context."""
        node = self.node("fusion")
        fusion.start(node, SimpleNamespace(observer="default", target=None, motion=None))
        with node:
            yield node

    def see(self, node: Node) -> None:
        """Publishes the camera's pose of the first target."""
        if self.seen.is_set():
            target = next(iter(self.cell.targets))
            node.publish(topics.VISION, vision(target, next(iter(self.cell.cameras)), self.cell.frame), target=target)


@contextmanager
def small(cell: str | Path, endpoint: str, secure: Path | None = None) -> Iterator[Small]:
    """A chain of the cell at the router of `endpoint`, with fusion not yet started. secure: folder of certificates."""
    chain = Small(cells.load(cell), bus.Connection(connect=(endpoint,), secure=secure), threading.Event())
    search = chain.node("search")
    search.every(0.05, lambda: chain.see(search))
    with search:
        yield chain


def vision(target: str, camera: str, frame: str) -> messages.VisionPose:
    return messages.VisionPose(
        stamp_ns=time.time_ns(),
        target=target,
        camera=camera,
        frame=frame,
        position=np.array(POSITION),
        orientation=np.array([0.0, 0.0, 0.0, 1.0]),
        covariance=np.diag([1e-5] * 3 + [1e-4] * 3),
        overlap=0.9,
        hidden=0.0,
        state="tracking",
    )
