"""A cell to look at, and a dashboard that shows it, on a bus of their own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from penumbra.services import flags
from penumbra.services.dashboard import service
from penumbra.shared.cell import description as cells
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support.live import free_port, wait_for
from penumbra.tests.support.shown import Shown


def started(cell: cells.Cell, connection: bus.Connection, *words: str) -> Node:
    """A dashboard that is wired, and not open yet."""
    node = Node(service.NAME, cell, connection)
    service.start(node, flags.parse(service.FLAGS, words))
    return node


def address(node: Node) -> str:
    """Where a dashboard serves its page, as its health report says; waits for it."""
    return wait_for(lambda: node.health()["report"]["page"]["address"], 30, "the page to be served")


@dataclass
class Served:
    """A shown cell and its page."""

    shown: Shown
    node: Node
    url: str
    endpoint: str

    @property
    def host(self) -> str:
        return self.url.split("/")[2]

    @property
    def page(self) -> Any:
        return self.node.health()["report"]["page"]


@pytest.fixture(scope="package")
def served() -> Iterator[Served]:
    cell, endpoint = cells.load("table"), f"tcp/127.0.0.1:{free_port()}"
    with Shown(cell, endpoint) as shown, started(cell, bus.Connection(connect=(endpoint,)), "--page", str(free_port())) as node:
        yield Served(shown, node, address(node), endpoint)
