"""Carries the topics of `penumbra ros2` between Zenoh and a ROS on another middleware, such as Fast DDS or Cyclone DDS.

`penumbra ros2` takes part in ROS on Zenoh. Where ROS nodes speak DDS, run this one file with the Python that has rclpy (after
`source /opt/ros/jazzy/setup.bash`). It needs nothing of Penumbra, but `pip install eclipse-zenoh`. Messages pass as they are, in
CDR; which topics there are, with their types and quality of service, it reads from the tokens of `penumbra ros2`.

    python3 dds_bridge.py [ENDPOINT [DOMAIN]]

ENDPOINT is the router that `penumbra ros2 --ros-connect` names, which may be Penumbra's own (default tcp/localhost:7447), DOMAIN
that of `penumbra ros2 --domain` (default 0). The environment's ROS_DOMAIN_ID is that of the DDS side.
"""

from __future__ import annotations

import importlib
import json
import queue
import struct
import sys
import time
import uuid
from functools import partial
from typing import Any

import rclpy
import zenoh
import zenoh.ext
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

ATTACHMENT = struct.Struct("<qqB16s")
"""Attachment that rmw_zenoh expects: number of the message, time of publication [ns], length of the publisher's identity,
identity."""
ROUTER, NODE = "tcp/localhost:7447", "ros2"
"""Default router, and the name of the ROS node of `penumbra ros2`."""
WAIT_S, STEP_S = 1.0, 0.1
"""Period [s] of attempts to reach the router, and of checks whether ROS ends."""
MOST = 1000
"""Maximum number of messages that wait for ROS; further ones are dropped."""


class Endpoint:
    """A publisher or subscription of `penumbra ros2`, from its token `…/MP|MS/ENCLAVE/NAMESPACE/NODE/TOPIC/TYPE/HASH/QOS`, whose
    parts have percent signs for slashes. Raises ValueError for another token."""

    def __init__(self, token: str):
        _, self.domain, _, _, _, self.what, _, _, self.node, topic, kind, hash, profile = token.split("/")
        self.topic = topic.replace("%", "/")
        self.package, _, _, name = kind.split("::")
        self.name = name.removesuffix("_")
        self.key = f"{self.domain}/{self.topic.strip('/')}/{kind}/{hash}"
        reliability, durability, history, *_ = profile.split(":")
        self.profile = QoSProfile(depth=int(history.split(",")[1] or 42))
        self.is_latched = durability == "1"
        if self.is_latched:
            self.profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        if reliability == "2":
            self.profile.reliability = ReliabilityPolicy.BEST_EFFORT

    def message_class(self) -> Any:
        """The ROS class of its messages. Raises ImportError or AttributeError if this ROS does not have the type."""
        return getattr(importlib.import_module(f"{self.package}.msg"), self.name)


class Bridge:
    """The ROS node and the Zenoh session. Data from Zenoh's threads waits in `_work` for the thread of ROS."""

    def __init__(self, session: zenoh.Session, node: Any):
        self._session, self._node = session, node
        self._work: queue.Queue[Any] = queue.Queue(MOST)
        self._open: dict[str, list[Any]] = {}
        self._gid = uuid.uuid4().bytes
        self._count = 0

    def watch(self, domain: int, name: str) -> Any:
        """Bridge the topics of the existing nodes of this name, and of those that appear."""
        return self._session.liveliness().declare_subscriber(
            f"@ros2_lv/{domain}/*/*/*/*/*/*/{name}/**",
            lambda sample: self._work.put(partial(self._on_token, str(sample.key_expr), sample.kind)),
            history=True,
        )

    def step(self, patience_s: float) -> None:
        """Process waiting work, and let ROS run, for about `patience_s`."""
        deadline = time.monotonic() + patience_s
        while (left_s := deadline - time.monotonic()) > 0.0:
            try:
                self._work.get(timeout=min(left_s, 0.002))()
            except queue.Empty:
                rclpy.spin_once(self._node, timeout_sec=0.0)

    def _on_token(self, token: str, kind: zenoh.SampleKind) -> None:
        parts = token.split("/")
        if len(parts) != 13 or parts[5] not in ("MP", "MS"):
            return
        if kind == zenoh.SampleKind.DELETE:
            for each in self._open.pop(token, []):
                each()
            return
        found = Endpoint(token)
        try:
            message = found.message_class()
        except (ImportError, AttributeError):
            print(f"left out {found.topic}: ROS here has no {found.package}/{found.name}", file=sys.stderr, flush=True)
            return
        self._open[token] = self._from_zenoh(found, message) if found.what == "MP" else self._from_ros(found, message)
        print(f"{found.topic} {'to' if found.what == 'MP' else 'from'} ROS", file=sys.stderr, flush=True)

    def _from_zenoh(self, found: Endpoint, message: Any) -> list[Any]:
        publisher = self._node.create_publisher(message, found.topic, found.profile)

        def on_sample(sample: zenoh.Sample) -> None:
            try:
                self._work.put_nowait(partial(publisher.publish, sample.payload.to_bytes()))
            except queue.Full:
                print(f"{found.topic}: ROS is slower than its messages come; one is dropped", file=sys.stderr, flush=True)

        if found.is_latched:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=found.profile.depth)
            subscriber: Any = zenoh.ext.declare_advanced_subscriber(self._session, found.key, on_sample, history=history)
        else:
            subscriber = self._session.declare_subscriber(found.key, on_sample)
        return [subscriber.undeclare, partial(self._node.destroy_publisher, publisher)]

    def _from_ros(self, found: Endpoint, message: Any) -> list[Any]:
        publisher = self._session.declare_publisher(found.key)

        def on_message(payload: bytes) -> None:
            self._count += 1
            publisher.put(payload, attachment=ATTACHMENT.pack(self._count, time.time_ns(), 16, self._gid))

        subscription = self._node.create_subscription(message, found.topic, on_message, found.profile, raw=True)
        return [publisher.undeclare, partial(self._node.destroy_subscription, subscription)]


def opened(endpoint: str) -> zenoh.Session:
    """Open a session at the router, as soon as it is there."""
    config = zenoh.Config()
    for key, value in {"mode": "client", "connect/endpoints": [endpoint], "scouting/multicast/enabled": False}.items():
        config.insert_json5(key, json.dumps(value))
    told = False
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            if "Unable to connect" not in str(error):
                raise
        if not told:
            print(f"waiting for the Zenoh router at {endpoint}", file=sys.stderr, flush=True)
            told = True
        time.sleep(WAIT_S)


def main() -> None:
    words = sys.argv[1:]
    endpoint, domain = [*words[:2], *(ROUTER, "0")[len(words[:2]) :]]
    if len(words) > 2 or endpoint.startswith("-") or not domain.isdecimal():
        sys.exit(f"expected an endpoint and a domain, got {' '.join(words)!r}\n\n{__doc__}")
    try:
        with opened(endpoint) as session:
            rclpy.init()
            bridge = Bridge(session, rclpy.create_node("penumbra_bridge"))
            watched = bridge.watch(int(domain), NODE)
            while rclpy.ok():
                bridge.step(STEP_S)
            watched.undeclare()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
