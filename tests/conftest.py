"""Fixtures that several files share."""

import importlib.util
import logging
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from penumbra.shared.runtime import bus
from penumbra.tests.support.live import Running, free_port, hold_in_reach, penumbra_up

HERE = Path(__file__).parent
collect_ignore = [] if importlib.util.find_spec("pybullet") else ["test_pybullet.py", "test_dynamics.py"]
"""What only pybullet can answer; it has wheels up to CPython 3.11."""


def pytest_configure() -> None:
    """What the tests start inherits which signals are ignored, as they are in a run in the background, and tests send them."""
    for number in (signal.SIGINT, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number is signal.SIGINT else signal.SIG_DFL)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks what runs whole chains as `alone`. Tests of the running chain come last: it would take the cores from all others
    until the session ends."""
    for item in items:
        if item.path.is_relative_to(HERE / "chain") or item.path.is_relative_to(HERE / "examples"):
            item.add_marker("alone")
    items.sort(key=lambda item: "running" in getattr(item, "fixturenames", ()))


@pytest.fixture(autouse=True)
def logs_as_before() -> Iterator[None]:
    """A command that a test runs in this process configures the logs of the process; the next test finds them as they were."""
    logger = logging.getLogger("penumbra")
    handlers, level, propagate = logger.handlers[:], logger.level, logger.propagate
    yield
    logger.handlers[:], logger.propagate = handlers, propagate
    logger.setLevel(level)


@pytest.fixture(scope="session")
def running() -> Iterator[Running]:
    """The whole chain on the table cell, held still in sight and in reach: what happens to the pose is the test's doing."""
    with penumbra_up("table", 5) as running:
        hold_in_reach(running)
        yield running


@pytest.fixture
def router() -> Iterator[str]:
    """The endpoint of a router of the test's own."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    session = bus.open_session(bus.Connection("router", (), (endpoint,)), threading.Event(), lambda: None, 5.0)
    yield endpoint
    session.close()
