"""Names and encodings of rmw_zenoh on the bus: keys of topics, liveliness tokens, quality of service, gids and attachments.

Pure functions of text and bytes. Source: github.com/ros2/rmw_zenoh, `liveliness_utils.cpp` (keys, tokens, quality of service and
gid, 0.2.9 and later), `attachment_helpers.cpp` and `rmw_publisher_data.cpp`. Types are named as in `geometry_msgs/msg/Pose`.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Literal

import xxhash

ADMIN = "@ros2_lv"
"""Prefix of the tokens of the ROS graph."""
DEFAULT_DEPTH = 42
"""Depth of rmw_zenoh's default profile; default values are left out of a token."""
RELIABLE_IS_DEFAULT, BEST_EFFORT = "", "2"
VOLATILE_IS_DEFAULT, TRANSIENT_LOCAL = "", "1"
"""Values of rmw/types.h, empty if they are those of the default profile."""
ATTACHMENT = struct.Struct("<qqB16s")
"""Attachment: sequence number, time of publication [ns since the epoch], length of the gid, gid."""
GID_BYTES = 16
MOST_DOMAINS = 232
"""Largest domain of ROS 2: DDS has no ports for larger ones."""
Kind = Literal["NN", "MP", "MS"]
"""Kinds of entities: node, publisher (message publisher), subscription (message subscription)."""
_PART = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@dataclass(frozen=True)
class Profile:
    """The quality of service of a publisher or a subscription that keeps the last `depth` messages. is_latched: late subscribers
    receive them too (transient local)."""

    depth: int = 10
    is_latched: bool = False
    is_reliable: bool = True

    def __str__(self) -> str:
        """As in a token: reliability:durability:history,depth:deadline:lifespan:liveliness, with defaults empty."""
        reliability = RELIABLE_IS_DEFAULT if self.is_reliable else BEST_EFFORT
        durability = TRANSIENT_LOCAL if self.is_latched else VOLATILE_IS_DEFAULT
        depth = "" if self.depth == DEFAULT_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


@dataclass(frozen=True)
class Node:
    """A ROS node of a Zenoh session. zid: the session's identity as Zenoh prints it; namespace: `/` or as in `/penumbra`."""

    domain: int
    zid: str
    namespace: str
    name: str
    id: int = 0


def topic(text: str) -> str:
    """Type of a fully qualified ROS name, as in `/joint_states`. Raises ValueError for an invalid one."""
    parts = text.removeprefix("/").split("/")
    if not text.startswith("/") or not all(_PART.fullmatch(part) for part in parts):
        raise ValueError(
            f"expected a name of ROS such as /joint_states (letters, digits and _ between slashes, no digit first), got {text!r}"
        )
    return text


def namespace(text: str) -> str:
    """Type of a ROS namespace, as in `/penumbra`, or `/` for none. Raises ValueError for an invalid one."""
    return text if text == "/" else topic(text)


def within(space: str, name: str) -> str:
    """The fully qualified name of `name` in a namespace."""
    return f"{space.rstrip('/')}/{name}"


def safe(text: str) -> str:
    """A name of the cell as a part of a ROS name: only letters, digits and _, and no digit first."""
    found = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return found if _PART.fullmatch(found) else f"_{found}"


def dds_type(kind: str) -> str:
    """The DDS name of a type: `geometry_msgs/msg/Pose` becomes `geometry_msgs::msg::dds_::Pose_`."""
    package, middle, name = kind.split("/")
    return f"{package}::{middle}::dds_::{name}_"


def topic_key(domain: int, name: str, kind: str, hash: str) -> str:
    """The key of a topic's messages. hash: `RIHS01_` and 64 hexadecimal digits."""
    return f"{domain}/{name.strip('/')}/{dds_type(kind)}/{hash}"


def mangled(name: str) -> str:
    """A name as one part of a token."""
    return name.replace("/", "%")


def node_token(node: Node) -> str:
    """The liveliness token of a node. Its enclave is `/`, none."""
    return _token(node, node.id, "NN")


def endpoint_token(node: Node, id: int, what: Literal["MP", "MS"], name: str, kind: str, hash: str, profile: Profile) -> str:
    """The liveliness token of a publisher or a subscription. id: its number in the session."""
    return f"{_token(node, id, what)}/{mangled(name)}/{dds_type(kind)}/{hash}/{profile}"


def _token(node: Node, id: int, what: Kind) -> str:
    place = f"{ADMIN}/{node.domain}/{node.zid}/{node.id}/{id}/{what}"
    return f"{place}/{mangled('/')}/{mangled(node.namespace)}/{mangled(node.name)}"


def gid(token: str) -> bytes:
    """The gid (16 bytes) of the entity with a token: XXH3-128 of it, the low half first, each half little-endian."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(GID_BYTES, "little")


def attachment(number: int, stamp_ns: int, gid: bytes) -> bytes:
    """The attachment of a message (33 bytes). number: of the message, counted from 1; stamp_ns: time of publication. A ROS node
    fails on a message without one, or with another one."""
    return ATTACHMENT.pack(number, stamp_ns, GID_BYTES, gid)
