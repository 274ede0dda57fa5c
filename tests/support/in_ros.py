"""Run by the Python of a ROS environment, which has rclpy and nothing of Penumbra: answers a line of JSON with a line of JSON.

{"decode": TYPE, "cdr": HEX}    the fields of the message, and its CDR as rclpy writes it again
{"hash": TYPE}                  the type hash as the ROS graph shows it
{"hear": TYPE, "topic": NAME}   the fields of the next message of a topic, null where none came within 0.2 s
{"say": TYPE, "topic": NAME, "cdr": HEX}    publishes a message
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from typing import Any

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message

WAIT_S = 0.2


def class_of(kind: str) -> Any:
    package, _, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def plain(value: Any) -> Any:
    """A message as JSON."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):  # the type `byte`
        return value[0]
    if isinstance(value, bool | int | float | str):
        return value
    return [plain(each) for each in value.tolist()] if hasattr(value, "tolist") else [plain(each) for each in value]


class Answers:
    """The possible questions, and the ROS node that answers them."""

    def __init__(self) -> None:
        rclpy.init()
        self._node = rclpy.create_node("in_ros")
        self._heard: dict[str, list[Any]] = {}
        self._publishers: dict[str, Any] = {}

    def decode(self, asked: dict[str, str]) -> Any:
        message = deserialize_message(bytes.fromhex(asked["cdr"]), class_of(asked["decode"]))
        return {"fields": plain(message), "cdr": bytes(serialize_message(message)).hex()}

    def hash(self, asked: dict[str, str]) -> Any:
        topic = f"/hash_of/{asked['hash'].replace('/', '_')}"
        publisher = self._node.create_publisher(class_of(asked["hash"]), topic, 1)
        found: list[Any] = []
        while not found:
            rclpy.spin_once(self._node, timeout_sec=0.05)
            found = self._node.get_publishers_info_by_topic(topic)
        self._node.destroy_publisher(publisher)
        return f"RIHS{found[0].topic_type_hash.version:02}_{bytes(found[0].topic_type_hash.value).hex()}"

    def hear(self, asked: dict[str, str]) -> Any:
        topic = asked["topic"]
        if topic not in self._heard:
            profile = QoSProfile(depth=10)
            if topic == "/tf_static":
                profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
            self._heard[topic] = []
            self._node.create_subscription(class_of(asked["hear"]), topic, self._heard[topic].append, profile)
        deadline = time.monotonic() + WAIT_S
        while not self._heard[topic] and time.monotonic() < deadline:
            rclpy.spin_once(self._node, timeout_sec=0.05)
        return plain(self._heard[topic].pop(0)) if self._heard[topic] else None

    def say(self, asked: dict[str, str]) -> Any:
        topic, kind = asked["topic"], class_of(asked["say"])
        if topic not in self._publishers:
            self._publishers[topic] = self._node.create_publisher(kind, topic, 10)
        self._publishers[topic].publish(deserialize_message(bytes.fromhex(asked["cdr"]), kind))
        rclpy.spin_once(self._node, timeout_sec=0.0)
        return True


def main() -> None:
    answers = Answers()
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        print(json.dumps(getattr(answers, next(iter(asked)))(asked)), flush=True)


if __name__ == "__main__":
    main()
