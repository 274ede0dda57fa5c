"""Contents of a file: messages on channels."""

from __future__ import annotations

from dataclasses import dataclass

from penumbra.shared.runtime.tap import Taken

KEY, PUBLISHER = "key", "publisher"
"""Metadata of a channel that is replayed: the key on the bus, and the identity of the publisher."""


@dataclass(frozen=True)
class Channel:
    """A stream of messages in a file.

    topic: its name in the file. encoding: `msgpack` or `protobuf`. schema: name of the message's type. definition: serialised
    FileDescriptorSet of a Protobuf schema. about: metadata, as pairs.
    """

    topic: str
    encoding: str
    schema: str
    definition: bytes = b""
    about: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Entry:
    """A message in a file. log_ns: time of reception; stamp_ns: of the measurement; number: in the publisher's sequence."""

    channel: Channel
    log_ns: int
    stamp_ns: int
    data: bytes
    number: int = 0


def as_on_the_bus(taken: Taken) -> Entry:
    """Entry that stores the unchanged bytes of a message."""
    about = ((KEY, taken.key), (PUBLISHER, taken.publisher.hex()))
    channel = Channel(taken.key, "msgpack", f"penumbra.{taken.topic.message.__name__}", about=about)
    return Entry(channel, taken.received_ns, taken.stamp_ns, taken.payload, taken.number)
