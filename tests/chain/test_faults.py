"""Hostile input against the running chain: nothing crashes, nothing stalls, and the pose is back within a second."""

import time
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from penumbra.shared.contract import messages, topics
from penumbra.tests.support.live import wait_for

NAMES = {"cell": "table", "camera": "front", "robot": "panda", "pad": "p0", "target": "forearm"}
READ_TOPICS = [topic for topic in topics.TOPICS if topic is not topics.TRUTH]


def good(topic: topics.Topic, stamp_ns: int) -> dict:
    """The fields of a valid message of this topic."""
    pose: dict[str, Any] = {"position": np.zeros(3), "orientation": np.array([0.0, 0, 0, 1])}
    named: dict[str, Any] = {"target": "forearm", "frame": "world"}
    kinds = {
        "frame": lambda: messages.Frame(stamp_ns=stamp_ns, image=np.zeros((48, 64, 3), np.uint8)),
        "mask": lambda: messages.Mask(stamp_ns=stamp_ns, labels=np.zeros((16, 16), np.uint8), x0=0, y0=0, scale=1),
        "joints": lambda: messages.Joints(stamp_ns=stamp_ns, position=np.zeros(7)),
        "voltages": lambda: messages.Voltages(stamp_ns=stamp_ns, period_ns=10**6, volts=np.zeros((5, 5), np.float32)),
        "vision": lambda: messages.VisionPose(
            stamp_ns=stamp_ns, **named, **pose, camera="front", covariance=np.eye(6), overlap=1.0, hidden=0.0, state="tracking"
        ),
        "haptic": lambda: messages.HapticPose(
            stamp_ns=stamp_ns, sample_stamp_ns=stamp_ns, **named, **pose, information=np.eye(6), gap=0.1, state="in_range"
        ),
        "fused": lambda: messages.FusedPose(
            stamp_ns=stamp_ns, **named, **pose, velocity=np.zeros(6), covariance=np.eye(6), state="tracking", sources={}
        ),
    }
    return msgpack.unpackb(messages.encode(kinds[topic.name]()))


def arrays(fields: dict) -> list[str]:
    return [name for name, value in fields.items() if isinstance(value, list) and value]  # `touched` is an empty list


@st.composite
def hostile(draw, topic: topics.Topic) -> list[bytes]:
    """One bad payload of each kind that this topic can carry."""
    now = time.time_ns()
    fields = good(topic, now)
    packed = msgpack.packb(fields)
    name = draw(st.sampled_from(arrays(fields)))
    dtype, shape, data = fields[name]
    out = [
        draw(st.binary(max_size=200)),  # malformed
        packed[: draw(st.integers(0, len(packed) - 1))],  # truncated
        msgpack.packb(fields | {"stamp_ns": now + draw(st.integers(10**9, 10**18))}),
        msgpack.packb(fields | {"stamp_ns": now - draw(st.integers(10**10, 10**18))}),
        msgpack.packb(fields | {name: [dtype, [*shape, draw(st.integers(2, 9))], data]}),  # wrong shape
        msgpack.packb(fields | {name: [draw(st.sampled_from(["float16", "int64", "object", "nonsense"])), shape, data]}),
        msgpack.packb(fields | {draw(st.text(max_size=5)): draw(st.integers(-(2**63), 2**63))}),
    ]
    if dtype.startswith("float"):
        broken = np.frombuffer(data, dtype).copy()
        broken[draw(st.integers(0, broken.size - 1))] = draw(st.sampled_from([np.nan, np.inf, -np.inf]))
        out.append(msgpack.packb(fields | {name: [dtype, shape, broken.tobytes()]}))
    return out


@pytest.mark.parametrize("topic", READ_TOPICS, ids=lambda topic: topic.name)
def test_a_thousand_bad_messages_of_each_kind_do_not_stop_anything(running, topic):
    pids = {name: process.pid for name, process in running.processes().items()}
    publisher = running.session.declare_publisher(topic.at(**NAMES))

    @settings(max_examples=1000, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck), database=None)
    @given(hostile(topic))
    def storm(payloads):
        for payload in payloads:
            publisher.put(payload)

    storm()
    for _ in range(1000 if topic.message.MAX_BYTES < 10**6 else 3):  # images: three of 64 MB say as much as a thousand
        publisher.put(bytes(topic.message.MAX_BYTES + 1))
    ended_ns = time.time_ns()
    wait_for(lambda: running.is_tracking(ended_ns), 1.0, "a tracked pose within a second of the storm")
    assert {name: process.pid for name, process in running.processes().items()} == pids, "a process was restarted"


def test_what_was_refused_is_counted_in_the_health_of_its_reader(running):
    publisher = running.session.declare_publisher(topics.HAPTIC.at(**NAMES))

    def refused() -> int:
        rows = running.health().get("fusion", {}).get("topics", {}).values()
        return sum(sum(row.get("bad", {}).values()) for row in rows)

    before = refused()
    publisher.put(b"nonsense")
    wait_for(lambda: refused() > before, 5.0, "the refused message in fusion's health")


def test_a_pose_query_in_an_unknown_format_is_answered_with_the_formats_there_are(running):
    reply = next(iter(running.session.get(topics.current_pose("table", "forearm") + "?format=xml", timeout=2.0)))
    assert reply.ok is None
    assert "json" in reply.err.payload.to_string()


@pytest.mark.parametrize("command", ["nonsense", "[]", '{"command": "occlude", "value": 7}', '{"command": "fly"}'])
def test_a_bad_control_command_is_answered_with_what_is_possible(running, command):
    reply = next(iter(running.session.get(topics.control("table"), payload=command, timeout=2.0)))
    assert reply.ok is None
    assert "occlude" in reply.err.payload.to_string()
