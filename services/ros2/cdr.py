"""Messages of a ROS distribution: classes, type hashes and CDR bytes, by rosbags, which has their definitions."""

from __future__ import annotations

from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

DISTRIBUTIONS = {"jazzy": Stores.ROS2_JAZZY, "kilted": Stores.ROS2_KILTED}
"""Distributions whose rmw_zenoh uses the keys of `names`; in Humble they have no type hashes."""
LONGEST = 16_000_000
"""Maximum number of entries in a list of a decoded message."""
TRAILING = (0, 4, 8)
"""Numbers of trailing bytes that are dropped if a message cannot be decoded otherwise: `rclpy.serialization` writes them after
empty lists. rosbags itself accepts three more, for alignment."""


class Types:
    """The types of a distribution, named as in `geometry_msgs/msg/Pose`."""

    def __init__(self, distribution: str):
        self.distribution = distribution
        self._store = get_typestore(DISTRIBUTIONS[distribution])
        self._store.max_sequence_length = LONGEST

    def make(self, kind: str, **fields: Any) -> Any:
        """Make a message of a type; every field must be given."""
        return self._store.types[kind](**fields)

    def constant(self, kind: str, name: str) -> int:
        """A constant of a type, such as `CUBE` of `visualization_msgs/msg/Marker`."""
        return int(getattr(self._store.types[kind], name))

    def hash(self, kind: str) -> str:
        """The type hash (REP 2016): `RIHS01_` and 64 hexadecimal digits."""
        return self._store.hash_rihs01(kind)

    def encode(self, message: Any) -> bytes:
        """The CDR bytes of a message, little-endian, after the four bytes of encapsulation."""
        return bytes(self._store.serialize_cdr(message, message.__msgtype__))

    def decode(self, kind: str, payload: bytes) -> Any:
        """Decode a message of a type from CDR bytes. Raises ValueError for invalid bytes."""
        first: SerdeError | None = None
        for count in TRAILING:
            try:
                return self._store.deserialize_cdr(payload[: len(payload) - count], kind)
            except SerdeError as error:
                first = first or error
            except RecursionError:
                break
        raise ValueError(f"expected CDR of {kind}, got {len(payload)} bytes that are none: {first}")
