"""Admission of messages from publishers: every message once, and no more messages than belong to its topic.

A replayed message carries a number that was received before, or a stamp too old for its topic (`Topic.oldest_s`). A publisher is
forgotten only when the stamps of all its messages are too old. A measurement that another publisher repeats, as when two replicas
both act as the owner, carries a stamp that was received before.
"""

from __future__ import annotations

import itertools
import secrets
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass

from penumbra.shared.contract.messages import MAX_FUTURE_S, MAX_PAST_S, BadMessage

RATE_TIMES = 5.0
"""Maximum rate of a publisher as a multiple of its topic's rate. Messages of one second may arrive at once."""
PUBLISHERS = 16
"""Maximum number of publishers of one key at a time."""
FORGET_S = MAX_PAST_S + MAX_FUTURE_S
WINDOW = 64
"""Number of a publisher's messages that may arrive out of order."""
MEASUREMENTS = 64
"""Number of measurements remembered per key. In the slowest stream, the oldest of them is older than any accepted message."""
SEEN = (1 << WINDOW) - 1
"""Window of a publisher from which every number was received."""
NUMBERS = 1 << 32
"""Modulus of publishers' sequence numbers: at 200 Hz they repeat after eight months."""
IDENTITY_BYTES, NUMBER_BYTES = 12, 4
"""Sizes of the parts of a message's attachment: its publisher's random identity, and its number, little-endian."""


class Numbering:
    """Attachments of one publisher's messages. Zenoh's `source_info` has the same content, but costs a reader six calls into
    Zenoh."""

    def __init__(self) -> None:
        self._identity = secrets.token_bytes(IDENTITY_BYTES)
        self._numbers = itertools.count()

    def attachment(self) -> bytes:
        """Attachment of the next message. Thread-safe."""
        return self._identity + (next(self._numbers) % NUMBERS).to_bytes(NUMBER_BYTES, "little")


class SequenceWindow:
    """Received sequence numbers of a publisher: the sliding window of RFC 4303, section 3.4.3 (doi:10.17487/RFC4303)."""

    def __init__(self, number: int):
        self._highest = number
        self._seen = SEEN  # numbers before the first are not expected

    def take(self, number: int) -> int:
        """Change of the count of missing numbers: the numbers skipped, or -1 for one that arrives late. Raises BadMessage for a
        number that was received, or may have been."""
        ahead = (number - self._highest) % NUMBERS
        if ahead == 1:  # the usual case
            self._seen = (self._seen << 1 | 1) & SEEN
            self._highest = number
            return 0
        if ahead == 0 or ahead >= NUMBERS // 2:
            behind = -ahead % NUMBERS
            if behind >= WINDOW or self._seen >> behind & 1:
                raise BadMessage("replayed", f"expected a new number after {self._highest}, got {number}")
            self._seen |= 1 << behind
            return -1
        self._seen = (self._seen << ahead | 1) & SEEN if ahead < WINDOW else 1
        self._highest = number
        return ahead - 1


class Bucket:
    """Token bucket that admits `rate_hz` events per second, and at most those of one second at once."""

    def __init__(self, rate_hz: float, now_s: float):
        self._rate_hz = rate_hz
        self._tokens = self._full = max(1.0, rate_hz)
        self._last_s = now_s

    def take(self, now_s: float) -> bool:
        """Whether one more event is admitted."""
        tokens = self._tokens + (now_s - self._last_s) * self._rate_hz
        if tokens > self._full:
            tokens = self._full
        self._last_s = now_s
        self._tokens = tokens - 1.0 if tokens >= 1.0 else tokens
        return tokens >= 1.0


@dataclass
class _Publisher:
    bucket: Bucket
    received_s: float
    window: SequenceWindow | None = None
    stamp_ns: int | None = None


class Guard:
    """Publishers of one key. rate_hz: expected rate of each of them."""

    def __init__(self, rate_hz: float):
        self._limit_hz = RATE_TIMES * rate_hz
        self._publishers: dict[Hashable, _Publisher] = {}
        self._measurements: deque[tuple[int, str]] = deque(maxlen=MEASUREMENTS)
        self._newest_ns: int | None = None  # the newest of these: a newer stamp cannot be a repetition

    def admit(self, publisher: Hashable, number: int | None, now_s: float) -> int | None:
        """Change of this publisher's count of missing numbers; None where it does not number its messages. `now_s` must be
        monotonic. Raises BadMessage: replayed, rate, or publishers where there are too many."""
        found = self._publishers.get(publisher)
        if found is None or now_s - found.received_s > FORGET_S:
            found = self._newcomer(publisher, now_s)
        missing = None
        if number is not None:
            if found.window is None:
                found.window, missing = SequenceWindow(number), 0
            else:
                missing = found.window.take(number)
        if not found.bucket.take(now_s):
            raise BadMessage("rate", f"expected at most {self._limit_hz:g} messages a second of a publisher, got more")
        return missing

    def accept(self, publisher: Hashable, stamp_ns: int, now_s: float, camera: str = "") -> None:
        """Registers a good message that was admitted. camera: the camera of the measurement, if any.

        Raises BadMessage for a measurement that was received already, from any publisher. A publisher that does not number its
        messages must also send newer stamps each time; one that does need not, as poses of different cameras may arrive out of
        order.
        """
        found = self._publishers[publisher]
        if found.window is None:
            if found.stamp_ns is not None and stamp_ns <= found.stamp_ns:
                raise BadMessage(
                    "replayed", f"expected a stamp after {found.stamp_ns} in messages without numbers, got {stamp_ns}"
                )
            found.stamp_ns = stamp_ns
        if self._newest_ns is None or stamp_ns > self._newest_ns:
            self._newest_ns = stamp_ns
        elif (stamp_ns, camera) in self._measurements:
            raise BadMessage("repeated", f"expected every measurement once, got that of stamp {stamp_ns} again")
        self._measurements.append((stamp_ns, camera))
        found.received_s = now_s

    def _newcomer(self, publisher: Hashable, now_s: float) -> _Publisher:
        self._publishers = {name: known for name, known in self._publishers.items() if now_s - known.received_s <= FORGET_S}
        if len(self._publishers) >= PUBLISHERS:
            raise BadMessage("publishers", f"expected at most {PUBLISHERS} publishers of a key, got another one")
        return self._publishers.setdefault(publisher, _Publisher(Bucket(self._limit_hz, now_s), now_s))
