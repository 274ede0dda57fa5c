"""Fixtures of the tests of `penumbra ros2`: the cell's bus, ROS beside it, and the service between them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest
import zenoh

from penumbra.services import flags
from penumbra.services.ros2 import service
from penumbra.shared.cell import description as cells
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support import ros
from penumbra.tests.support.live import free_port


@dataclass
class World:
    """endpoint: of the cell's router; ros_port: of the ROS router."""

    endpoint: str
    ros_port: int

    def node(self, name: str, cell: str = "arm") -> Node:
        """A process of the cell that is not open yet."""
        return Node(name, cells.load(cell), bus.Connection(connect=(self.endpoint,)))

    @contextmanager
    def service(self, *arguments: str, cell: str = "arm") -> Iterator[Node]:
        """`penumbra ros2` in this process."""
        words = ["--ros-connect", f"tcp/127.0.0.1:{self.ros_port}", "--domain", str(ros.DOMAIN), *arguments]
        node = self.node("ros2", cell)
        service.start(node, flags.parse(service.FLAGS, words))
        with node:
            yield node


@pytest.fixture
def ros_port() -> int:
    return free_port()


@pytest.fixture
def ros_router(ros_port: int) -> Iterator[zenoh.Session]:
    session = ros.router(ros_port)
    yield session
    session.close()


@pytest.fixture
def world(router: str, ros_port: int) -> World:
    return World(router, ros_port)


@pytest.fixture
def peer(ros_router: zenoh.Session, ros_port: int) -> Iterator[ros.Peer]:
    """A ROS node."""
    with ros.peer(ros_port) as found:
        yield found
