"""Our bus beside plain Zenoh: arrays of the same size, quality of service and rings between the same two processes.

Both sides send and receive an array. Plain Zenoh does the minimum for that: its payload is the array's bytes after as many others
as our message has, so that payloads are equally long. It numbers, checks and counts nothing.

`python -m penumbra.tests.bench.lib.buses ENDPOINT` is the receiver: on `begin` it drops what came, on `end` it prints it as JSON.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Condition, Thread
from typing import Any

import msgspec
import numpy as np
import zenoh

from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.contract.topics import Topic
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node

CELL = cells.load("arm")
NAMES = {"robot": "panda", "camera": "side"}
KINDS = ("ours", "raw")
ACK = "raw/ack"
QUIET_S = 0.15
"""Time [s] without a message after which no more messages are expected."""
PATIENCE_S = 30.0


@dataclass(frozen=True)
class Payload:
    """A message as `topic` carries it, unlimited in rate so that the guard lets a flood through. The topic's depth, the number of
    messages that a reader keeps, is the number in flight in a flood."""

    topic: Topic
    make: Callable[[int], messages.Message]

    @property
    def names(self) -> dict[str, Any]:
        return {name: value for name, value in NAMES.items() if f"{{{name}}}" in self.topic.key}

    @property
    def array(self) -> np.ndarray:
        """The array that a message carries."""
        (array,) = (value for value in msgspec.structs.astuple(self.make(0)) if isinstance(value, np.ndarray))
        return array

    @property
    def raw_key(self) -> str:
        return f"raw/{self.topic.name}"


def _payload(topic: Topic, name: str, depth: int, make: Callable[[int], messages.Message]) -> Payload:
    return Payload(replace(topic, name=name, key=f"{topic.key}/{name}", rate_hz=1e7, depth=depth), make)


FEW, MANY = np.zeros(1), np.zeros(500)
IMAGE = np.zeros((480, 640, 3), np.uint8)
LABELS = np.zeros((480, 480), np.uint8)
PAYLOADS = {
    64: _payload(topics.JOINTS, "tiny", 16, lambda now: messages.Joints(stamp_ns=now, position=FEW)),
    4_000: _payload(topics.JOINTS, "small", 16, lambda now: messages.Joints(stamp_ns=now, position=MANY)),
    230_000: _payload(topics.MASK, "mask", 8, lambda now: messages.Mask(stamp_ns=now, labels=LABELS, x0=0, y0=0, scale=1)),
    921_000: _payload(topics.FRAME, "image", 2, lambda now: messages.Frame(stamp_ns=now, image=IMAGE)),
}
"""Payloads by approximate size [bytes]: 64 B, 4 kB, 230 kB and a frame. All that are in flight fit into the shared memory of a
small cell (`bus.POOL_BYTES`)."""


class Sender:
    """Sends a payload of each kind; the raw one is as long as ours, and has its stamp in the attachment."""

    def __init__(self, node: Node, payload: Payload):
        self._node, self._payload = node, payload
        self._array, self._names = payload.array, payload.names
        self.bytes = len(messages.encode(payload.make(0)))
        self._before = bytes(self.bytes - self._array.nbytes)
        assert node.session is not None
        self._publisher = node.session.declare_publisher(
            payload.raw_key,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=getattr(zenoh.Priority, payload.topic.priority.value),
        )

    def send(self, kind: str) -> None:
        now = time.time_ns()
        if kind == "raw":
            payload = b"".join((self._before, self._array.data))
            self._publisher.put(payload, attachment=now.to_bytes(8, "little"))
        else:
            self._node.publish(self._payload.topic, self._payload.make(now), **self._names)


class Link:
    """The sender's end: a node, and the process that receives."""

    def __init__(self, node: Node, receiver: subprocess.Popen):
        self._receiver = receiver
        self._read, self._news = 0, Condition()
        assert node.session is not None
        self._acks = node.session.declare_subscriber(ACK, self._on_ack)
        self.senders = {size: Sender(node, payload) for size, payload in PAYLOADS.items()}
        for sender in self.senders.values():
            for kind in KINDS:
                self._until_heard(sender, kind)

    def latencies_s(self, size: int, kind: str, count: int, pause_s: float) -> np.ndarray:
        """Times from before a message is made until it is read, of those of `count` messages that arrived."""
        self._ask("begin")
        for _ in range(count):
            self.senders[size].send(kind)
            time.sleep(pause_s)
        return np.array([(came - sent) * 1e-9 for came, sent in self._ask("end")])

    def per_s(self, size: int, kind: str, seconds: float) -> float:
        """Messages per second that are sent and read without a loss, with as many in flight as the reader keeps."""
        self._ask("begin")
        self._read, sent, ends, depth = 0, 0, time.monotonic() + seconds, PAYLOADS[size].topic.depth
        while time.monotonic() < ends:
            with self._news:
                if not self._news.wait_for(lambda: sent < self._read + depth, PATIENCE_S):  # noqa: B023 (called at once)
                    raise AssertionError(f"{sent} messages were sent, {self._read} read: one was lost")
            self.senders[size].send(kind)
            sent += 1
        came = self._ask("end")
        return (len(came) - 1) / ((came[-1][0] - came[0][0]) * 1e-9)

    def _on_ack(self, sample: zenoh.Sample) -> None:
        with self._news:
            self._read = int.from_bytes(sample.payload.to_bytes(), "little")
            self._news.notify()

    def _until_heard(self, sender: Sender, kind: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            self._ask("begin")
            sender.send(kind)
            if self._ask("end"):
                return
        raise AssertionError(f"{kind}: expected a message within {PATIENCE_S} s, got none")

    def _ask(self, what: str) -> list[list[int]]:
        assert self._receiver.stdin is not None and self._receiver.stdout is not None
        self._receiver.stdin.write(f"{what}\n")
        self._receiver.stdin.flush()
        return json.loads(self._receiver.stdout.readline())


@contextmanager
def linked(endpoint: str) -> Iterator[Link]:
    """A sender here and a receiver in a process of its own, both clients of a router."""
    command = [sys.executable, "-m", "penumbra.tests.bench.lib.buses", endpoint]
    root = Path(__file__).parents[4]
    receiver = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=root)
    try:
        with Node("sender", CELL, bus.Connection(connect=(endpoint,))) as node:
            yield Link(node, receiver)
    finally:
        receiver.kill()
        receiver.communicate()


def receive(endpoint: str) -> None:
    """Runs the receiver until its input ends."""
    came: list[tuple[int, int]] = []
    node = Node("receiver", CELL, bus.Connection(connect=(endpoint,)))

    def take(payload: Payload, sent_ns: int) -> None:
        came.append((time.time_ns(), sent_ns))
        if len(came) % (payload.topic.depth // 2) == 0:
            acks.put(len(came).to_bytes(8, "little"))

    def hear(payload: Payload, message: messages.Message, names: dict[str, str]) -> None:
        take(payload, message.stamp_ns)

    def hear_raw(payload: Payload, subscriber: zenoh.Subscriber) -> None:
        array = payload.array
        dtype, shape, before = array.dtype, array.shape, len(messages.encode(payload.make(0))) - array.nbytes
        for sample in subscriber:
            assert sample.attachment is not None
            np.frombuffer(sample.payload.to_bytes(), dtype, offset=before).reshape(shape)
            take(payload, int.from_bytes(sample.attachment.to_bytes(), "little"))

    for payload in PAYLOADS.values():
        node.subscribe(payload.topic, partial(hear, payload), **payload.names)
    with node:
        assert node.session is not None
        acks = node.session.declare_publisher(ACK)
        for payload in PAYLOADS.values():
            subscriber = node.session.declare_subscriber(payload.raw_key, zenoh.handlers.RingChannel(payload.topic.depth))
            Thread(target=hear_raw, args=(payload, subscriber), daemon=True).start()
        for line in sys.stdin:
            if line == "begin\n":
                came.clear()
                print("[]", flush=True)
                continue
            heard = -1
            while heard != len(came):
                heard = len(came)
                time.sleep(QUIET_S)
            print(json.dumps(came), flush=True)


if __name__ == "__main__":
    receive(sys.argv[1])
