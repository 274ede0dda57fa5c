"""What a file consists of: messages on channels."""

from __future__ import annotations

from dataclasses import dataclass

from penumbra.shared.runtime.tap import Taken

KEY, PUBLISHER = "key", "publisher"
"""Metadata of a channel from which a replay takes messages: the key on the bus, and the identity of who published on it."""


@dataclass(frozen=True)
class Channel:
    """A stream of messages in a file.

    topic: its name there. encoding: `msgpack` or `protobuf`. schema: name of the message's type. definition: of a Protobuf
    schema, a serialised FileDescriptorSet. about: its metadata, as pairs.
    """

    topic: str
    encoding: str
    schema: str
    definition: bytes = b""
    about: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Entry:
    """A message of a file. log_ns: when it was received; stamp_ns: of the measurement; number: its publisher's."""

    channel: Channel
    log_ns: int
    stamp_ns: int
    data: bytes
    number: int = 0


def as_on_the_bus(taken: Taken) -> Entry:
    """The entry that keeps a message to the bit."""
    about = ((KEY, taken.key), (PUBLISHER, taken.publisher.hex()))
    channel = Channel(taken.key, "msgpack", f"penumbra.{taken.topic.message.__name__}", about=about)
    return Entry(channel, taken.received_ns, taken.stamp_ns, taken.payload, taken.number)
