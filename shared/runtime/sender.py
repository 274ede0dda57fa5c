"""Publisher of messages on one key."""

from __future__ import annotations

import zenoh

from penumbra.shared.contract.messages import Message, codec
from penumbra.shared.contract.topics import QoS, Topic
from penumbra.shared.runtime.guard import Numbering


class Sender:
    """Sends the messages of a topic on one key with the topic's quality of service. It numbers them, so that readers can count
    lost messages and refuse replayed ones."""

    def __init__(self, session: zenoh.Session, topic: Topic, key: str):
        self._publisher = session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.BLOCK if topic.qos is QoS.NEVER_DROP else zenoh.CongestionControl.DROP,
            priority=getattr(zenoh.Priority, topic.priority.value),
        )
        self._encode = codec(topic.message).encode
        self._numbering = Numbering()

    def send(self, message: Message) -> None:
        """Encodes and sends a message of the topic. Raises BadMessage where an array does not have the declared dtype and shape,
        and zenoh.ZError where the session is closed."""
        self._publisher.put(self._encode(message), attachment=self._numbering.attachment())
