"""One Zenoh session at the router of ROS, in client mode, with the publishers and subscriptions of one ROS node.

A router of rmw_zenoh forwards the messages of clients. It does not forward between peers, because they find each other by gossip:
a peer that takes no part in gossip would receive nothing.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from typing import Any, Literal

import zenoh
import zenoh.ext

from penumbra.services.ros2 import names
from penumbra.services.ros2.cdr import Types
from penumbra.services.ros2.names import Profile
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.connection import short
from penumbra.shared.runtime.logs import Log

LOOK_S = 0.5
"""Period [s] of attempts to reach the router, and of checks whether it is still there."""
HEARTBEAT_S = 0.5
"""Period [s] at which rmw_zenoh's latched publishers announce the number of their last message."""


class Publisher:
    """A topic that this node publishes; may be used from several threads."""

    def __init__(self, ros: Types, topic: str, kind: str, profile: Profile):
        self.topic, self.kind, self.profile = topic, kind, profile
        self.count = 0
        self._ros = ros
        self._gid = b""
        self._publisher: Any = None
        self._last: bytes | None = None
        self._lock = threading.Lock()

    def open(self, session: zenoh.Session, key: str, token: str) -> None:
        """Declare the publisher; an earlier latched message is published now."""
        with self._lock:
            self._gid = names.gid(token)
            drop, reliable = zenoh.CongestionControl.DROP, zenoh.Reliability.RELIABLE
            if self.profile.is_latched:
                self._publisher = zenoh.ext.declare_advanced_publisher(
                    session,
                    key,
                    congestion_control=drop,
                    reliability=reliable,
                    cache=zenoh.ext.CacheConfig(self.profile.depth),
                    sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
                    publisher_detection=True,
                )
            else:
                self._publisher = session.declare_publisher(key, congestion_control=drop, reliability=reliable)
            if self._last is not None:
                self._put(self._last)

    def publish(self, message: Any) -> None:
        """Send a message; before the router is there only a latched one is kept."""
        if self._publisher is None and not self.profile.is_latched:
            return
        payload = self._ros.encode(message)
        with self._lock:
            if self.profile.is_latched:
                self._last = payload
            if self._publisher is not None:
                self._put(payload)

    def is_wanted(self) -> bool:
        """Whether there is a matching subscription; unknown for a latched topic."""
        return self._publisher is not None and bool(self._publisher.matching_status.matching)

    def close(self) -> None:
        """Stop sending."""
        with self._lock:
            self._publisher = None

    def _put(self, payload: bytes) -> None:
        self.count += 1
        try:
            self._publisher.put(payload, attachment=names.attachment(self.count, time.time_ns(), self._gid))
        except zenoh.ZError:  # the session has just been closed
            self._publisher = None


class Subscription:
    """A topic that this node reads, in its own thread: `handler(message)` receives the newest `profile.depth` messages; those
    that it refuses with ValueError are counted. last_s: time of the last message, by time.monotonic; why: reason of its refusal,
    empty if it was accepted."""

    def __init__(self, ros: Types, topic: str, kind: str, profile: Profile, handler: Callable[[Any], None]):
        self.topic, self.kind, self.profile = topic, kind, profile
        self.count = self.refused = 0
        self.last_s: float | None = None
        self.why = ""
        self._ros, self._handler = ros, handler

    def open(self, session: zenoh.Session, key: str) -> None:
        subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(self.profile.depth))
        threading.Thread(target=self._read, args=(subscriber,), name=f"reader of {self.topic}", daemon=True).start()

    def _read(self, subscriber: Any) -> None:
        while True:
            try:
                sample = subscriber.recv()
            except zenoh.ZError:  # the session is closed
                return
            try:
                self._handler(self._ros.decode(self.kind, sample.payload.to_bytes()))
            except ValueError as error:
                self.refused += 1
                self.why = str(error)
            else:
                self.count += 1
                self.why = ""
            self.last_s = time.monotonic()


class Participant:
    """A ROS node. Its topics are declared before `serve`.

    connection: of the session, in client mode.
    """

    def __init__(self, ros: Types, connection: bus.Connection, domain: int, namespace: str, name: str, log: Log):
        self.publishers: list[Publisher] = []
        self.subscriptions: list[Subscription] = []
        self._ros, self._connection, self._log = ros, connection, log
        self._domain, self._namespace, self._name = domain, namespace, name
        self._session: zenoh.Session | None = None
        self._tokens: list[zenoh.LivelinessToken] = []
        self._is_reached: bool | None = None  # before the first attempt
        bus.configuration(connection)  # refuse a bad endpoint or file first

    def publisher(self, topic: str, kind: str, profile: Profile = Profile()) -> Publisher:  # noqa: B008 (frozen)
        """A topic of this node, by its fully qualified name."""
        found = Publisher(self._ros, topic, kind, profile)
        self.publishers.append(found)
        return found

    def subscribe(self, topic: str, kind: str, profile: Profile, handler: Callable[[Any], None]) -> Subscription:
        """Call `handler(message)` for every message of a topic, once the router is there."""
        found = Subscription(self._ros, topic, kind, profile, handler)
        self.subscriptions.append(found)
        return found

    def reasons(self) -> list[str]:
        """Why ROS cannot be reached; empty if it can."""
        where = self._connection.where
        what = f"no ROS router at {where}: start `ros2 run rmw_zenoh_cpp rmw_zenohd`, or say where it is with --ros-connect"
        return [what] if self._is_reached is False else []

    def serve(self, stopping: threading.Event) -> None:
        """Open the session as soon as the router is there, and close it when `stopping` is set."""
        try:
            self._look()
            while not stopping.wait(LOOK_S):
                self._look()
        finally:
            self.close()

    def close(self) -> None:
        """Leave the ROS graph."""
        for publisher in self.publishers:
            publisher.close()
        session, self._session = self._session, None
        if session is not None:
            session.close()

    def _look(self) -> None:
        """Open the session, or check whether its router is still there: Zenoh itself reconnects to it."""
        session = self._session = self._session or self._open()
        reached = session is not None and bool(session.info.routers_zid())
        if session is not None and reached and not self._tokens:
            self._declare(session)
        if reached is not self._is_reached:
            self._is_reached = reached
            if reached:
                self._log.info("at the ROS router", at=self._connection.where)
            else:
                self._log.warning(self.reasons()[0])

    def _open(self) -> zenoh.Session | None:
        config = bus.configuration(self._connection)
        config.insert_json5("timestamping/enabled", json.dumps(True))  # identifies latched messages on retrieval
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            if "Unable to connect" not in str(error):
                raise bus.BusError(f"the session at the ROS router does not open: {short(error)}") from None
            return None

    def _declare(self, session: zenoh.Session) -> None:
        """Declare tokens first, so that ROS nodes know the senders of messages."""
        node = names.Node(self._domain, str(session.info.zid()), self._namespace, self._name)
        liveliness = session.liveliness()
        self._tokens = [liveliness.declare_token(names.node_token(node))]
        ends: list[Publisher | Subscription] = [*self.publishers, *self.subscriptions]
        for id, end in enumerate(ends, start=1):
            what: Literal["MP", "MS"] = "MP" if isinstance(end, Publisher) else "MS"
            hash = self._ros.hash(end.kind)
            token = names.endpoint_token(node, id, what, end.topic, end.kind, hash, end.profile)
            key = names.topic_key(self._domain, end.topic, end.kind, hash)
            self._tokens.append(liveliness.declare_token(token))
            if isinstance(end, Publisher):
                end.open(session, key, token)
            else:
                end.open(session, key)
