"""ROS 2 on Zenoh as its own nodes set it up: a router configured like rmw_zenohd, and sessions in peer mode beside it."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh.ext

from penumbra.services.ros2 import names
from penumbra.services.ros2.cdr import Types
from penumbra.tests.support.live import PATIENCE_S

ROOT = Path(__file__).parents[2]
DOMAIN = 7
COMMON: dict[str, Any] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    "timestamping/enabled": True,
    "transport/shared_memory/enabled": False,
}
"""Settings that DEFAULT_RMW_ZENOH_ROUTER_CONFIG.json5 and DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5 have in common."""


def session(settings: dict[str, Any]) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in (COMMON | settings).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def router(port: int, connect: tuple[str, ...] = ()) -> zenoh.Session:
    """A router like rmw_zenohd, which passes nothing on between its peers."""
    return session(
        {
            "mode": "router",
            "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
            "connect/endpoints": list(connect),
            "routing/router/peers_failover_brokering": False,
            "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
            "scouting/gossip/autoconnect": {"router": [], "peer": ["router", "peer"]},
        }
    )


class Peer:
    """A ROS node of the tests: a session in peer mode that finds other peers by gossip, as rmw_zenoh's are."""

    def __init__(self, port: int, distribution: str = "kilted"):
        self.ros = Types(distribution)
        self.session = session(
            {
                "mode": "peer",
                "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
                "listen/endpoints": ["tcp/127.0.0.1:0"],
                "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
                "scouting/gossip/autoconnect": {"router": [], "peer": ["router", "peer"]},
            }
        )
        self._publishers: dict[str, tuple[Any, list[int]]] = {}

    def key(self, topic: str, kind: str) -> str:
        return names.topic_key(DOMAIN, topic, kind, self.ros.hash(kind))

    def subscribe(self, topic: str, kind: str) -> Any:
        """The newest hundred samples of a topic."""
        return self.session.declare_subscriber(self.key(topic, kind), zenoh.handlers.RingChannel(100))

    def subscribe_latched(self, topic: str, kind: str) -> Any:
        """A subscription as rmw_zenoh makes it for the durability transient local."""
        return zenoh.ext.declare_advanced_subscriber(
            self.session,
            self.key(topic, kind),
            zenoh.handlers.RingChannel(100),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        )

    def publish(self, topic: str, kind: str, message: Any) -> None:
        if topic not in self._publishers:
            self._publishers[topic] = self.session.declare_publisher(self.key(topic, kind)), [0]
        publisher, count = self._publishers[topic]
        count[0] += 1
        publisher.put(self.ros.encode(message), attachment=names.attachment(count[0], 0, bytes(16)))

    def tokens(self) -> set[str]:
        """The tokens of the ROS graph."""
        replies = self.session.liveliness().get(f"{names.ADMIN}/{DOMAIN}/**", timeout=2.0)
        return {str(reply.ok.key_expr) for reply in replies if reply.ok}


def taken(subscriber: Any) -> list[Any]:
    """The samples that have arrived since the last call."""
    return list(iter(subscriber.try_recv, None))


@contextmanager
def peer(port: int) -> Iterator[Peer]:
    found = Peer(port)
    try:
        yield found
    finally:
        found.session.close()


# ---- environments of their own


def python_of(name: str) -> str:
    """The Python of an environment beside this one; skips the test where it is not there."""
    folder = os.environ.get("PENUMBRA_ROS_VENVS")
    if folder is None:
        pytest.skip("PENUMBRA_ROS_VENVS is not set: docs/ros2.md says how the environments of ROS are made")
    python = Path(folder) / name / "bin" / "python"
    if not python.exists():
        pytest.skip(f"no {python}: docs/ros2.md says how it is made")
    return str(python)


def environment(**more: str) -> dict[str, str]:
    """The environment variables of a user without Penumbra. Programs that speak DDS stay on loopback, in a domain of their
    own."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV", "ROS_", "RMW_"))}
    own = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "87", "PYTHONUNBUFFERED": "1"}
    return kept | own | more


class Answering:
    """A program of tests/support in another environment, which answers lines of JSON."""

    def __init__(self, name: str, script: str, *arguments: str, **more: str):
        self._command = [python_of(name), str(ROOT / "tests" / "support" / script), *arguments]
        self.process = subprocess.Popen(
            self._command, env=environment(**more), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self._answer() == "ready"

    def ask(self, **asked: Any) -> Any:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(asked) + "\n")
        self.process.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, f"{self._command} ended with exit code {self.process.wait()}"
        return json.loads(line)

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        try:
            self.process.wait(PATIENCE_S)
        finally:
            self.process.kill()
