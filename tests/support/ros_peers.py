"""Run by the Python of an environment with zenoh-ros2-sdk and pamoja-ros2, which has nothing of Penumbra: two programs that speak
rmw_zenoh's language without a line of ours. Answers a line of JSON with a line of JSON; the argument is the port of the router.

    {"key": [DOMAIN, NAME, TYPE, HASH]}             the key of a topic, by pamoja-ros2
    {"node": [DOMAIN, ZID, ID, NAME, NAMESPACE]}    the token of a node, by zenoh-ros2-sdk; {"endpoint": …} that of an endpoint
    {"attachment": HEX}                             number, time and gid of an attachment, by zenoh-ros2-sdk
    {"topics": DOMAIN}                              the names and types of the ROS graph
    {"hear": TYPE, "topic": NAME, "domain": N, "hash": HASH}    the newest PoseWithCovarianceStamped, null where none came
    {"say": TYPE, "topic": NAME, "domain": N, "hash": HASH, "joints": {NAME: POSITION}, "stamp_ns": N}  publishes a JointState

zenoh-ros2-sdk clones message definitions from the net, and writes to git's configuration; here it gets rosbags' definitions, so
that it does neither.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

import numpy as np
from pamoja.ros2 import entity_key
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber, ZenohSession, get_topic_names_and_types
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
from zenoh_ros2_sdk.keyexpr import endpoint_liveliness_keyexpr, node_liveliness_keyexpr

HOST = "127.0.0.1"


class Answers:
    def __init__(self, port: int):
        self._at = {"router_ip": HOST, "router_port": port}
        self._subscribers: dict[str, Any] = {}
        self._heard: dict[str, list[Any]] = {}
        self._publishers: dict[str, Any] = {}
        session = ZenohSession.get_instance(HOST, port)
        session.store = get_typestore(Stores.ROS2_KILTED)
        session._registered_types = {kind: kind for kind in session.store.types}
        self._store = session.store

    def key(self, asked: dict[str, Any]) -> Any:
        return entity_key(*asked["key"])

    def node(self, asked: dict[str, Any]) -> Any:
        return node_liveliness_keyexpr(NodeEntity(*asked["node"]))

    def endpoint(self, asked: dict[str, Any]) -> Any:
        *rest, kind, name, dds_type, hash, profile = asked["endpoint"][1:]
        node = NodeEntity(*asked["endpoint"][0])
        return endpoint_liveliness_keyexpr(EndpointEntity(node, *rest, EntityKind(kind), name, dds_type, hash, profile))

    def attachment(self, asked: dict[str, Any]) -> Any:
        found = Attachment.from_bytes(bytes.fromhex(asked["attachment"]))
        return [found.sequence_id, found.timestamp_ns, found.gid.hex()]

    def topics(self, asked: dict[str, Any]) -> Any:
        return get_topic_names_and_types(asked["topics"], **self._at)

    def hear(self, asked: dict[str, Any]) -> Any:
        topic = asked["topic"]
        if topic not in self._subscribers:
            heard = self._heard[topic] = []
            self._subscribers[topic] = ROS2Subscriber(
                topic, asked["hear"], heard.append, domain_id=asked["domain"], type_hash=asked["hash"], **self._at
            )
        if not self._heard[topic]:
            return None
        message = self._heard[topic].pop()
        position = message.pose.pose.position
        return {"frame": message.header.frame_id, "position": [position.x, position.y, position.z],
                "covariance": message.pose.covariance.tolist()}  # fmt: skip

    def say(self, asked: dict[str, Any]) -> Any:
        topic, make = asked["topic"], self._store.types
        if topic not in self._publishers:
            self._publishers[topic] = ROS2Publisher(
                topic, asked["say"], domain_id=asked["domain"], type_hash=asked["hash"], **self._at
            )
        stamp = make["builtin_interfaces/msg/Time"](sec=asked["stamp_ns"] // 10**9, nanosec=asked["stamp_ns"] % 10**9)
        self._publishers[topic].publish(
            header=make["std_msgs/msg/Header"](stamp=stamp, frame_id=""),
            name=list(asked["joints"]),
            position=np.array(list(asked["joints"].values()), float),
            velocity=np.zeros(0),
            effort=np.zeros(0),
        )
        return True


def main() -> None:
    answers = Answers(int(sys.argv[1]))
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        print(json.dumps(getattr(answers, next(iter(asked)))(asked)), flush=True)
    os._exit(0)  # a thread of zenoh-ros2-sdk would keep the process


if __name__ == "__main__":
    main()
