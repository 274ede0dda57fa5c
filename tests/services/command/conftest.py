"""A router with a small service, for commands that look at a running cell."""

import pytest

from penumbra.shared.cell import description as cells
from penumbra.shared.contract import outline, topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support.live import free_port, wait_for
from penumbra.tests.support.nodes import start

CELL = cells.load("table")


@pytest.fixture
def endpoint():
    """Of a router with the small service beside it."""
    where = f"tcp/127.0.0.1:{free_port()}"
    router = Node("router", CELL, bus.Connection("router", listen=(where,)))
    worker = Node("worker", CELL, bus.Connection(connect=(where,)))
    start(worker)
    worker.answer(topics.description("table"), lambda parameters, payload: (outline.of(CELL).encode(), "application/json"))
    with router, worker:
        wait_for(lambda: router.query(topics.description("table")), 5, "the service")
        yield where
