"""Fixtures that several files share."""

import threading
from collections.abc import Iterator

import pytest

from shared import bus, messages, topics
from tests.live import Running, free_port, penumbra_up, wait_for


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of the running chain come last: it would take the cores from all others until the session ends."""
    items.sort(key=lambda item: "running" in getattr(item, "fixturenames", ()))


@pytest.fixture(scope="session")
def running() -> Running:
    """The whole chain on the table cell, held still in sight and in reach: what happens to the pose is the test's doing."""
    with penumbra_up("table", 5) as running:
        wait_for(running.is_tracking, 180, "a tracked pose", 0.2)
        wait_for(lambda: running.control({"command": "occlude", "value": 0}), 10, "the emulator's answer")
        truths = running.session.declare_subscriber(topics.TRUTH.at(cell="table"))
        wait_for(lambda: in_reach(truths.recv()), 60, "the arm above the pads", 0.0)
        wait_for(lambda: running.control({"command": "motion", "value": "off"}), 10, "the emulator's answer")
        truths.undeclare()
        wait_for(lambda: running.is_tracking() and len(running.pose()["sources"]) == 2, 60, "a tracked pose of both senses", 0.2)
        yield running


@pytest.fixture
def router() -> Iterator[str]:
    """The endpoint of a router of the test's own."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    session = bus.open_session(bus.Connection("router", (), (endpoint,)), threading.Event(), lambda: None, 5.0)
    yield endpoint
    session.close()


def in_reach(sample) -> bool:
    return 0.04 < messages.decode(messages.Truth, sample.payload.to_bytes()).gap < 0.09
