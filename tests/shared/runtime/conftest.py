"""Fixtures of the tests of nodes."""

from collections.abc import Iterator

import pytest

from penumbra.shared.cell import description as cells
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support.live import free_port


@pytest.fixture
def router() -> Iterator[Node]:
    """The router as a node of this process."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Node("router", cells.load("table"), bus.Connection("router", listen=(endpoint,))) as node:
        yield node
