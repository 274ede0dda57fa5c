"""What a reader takes from a publisher: every message once, and no more of them than belong to its topic.

A replayed message carries a number that was here before, or a stamp too old for its topic (`Topic.oldest_s`). A publisher is
forgotten only when whatever it has sent is too old by its stamp. What another publisher repeats, as where two replicas both
take themselves for the owner, carries a stamp that was here before.
"""

from __future__ import annotations

import itertools
import secrets
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass

from penumbra.shared.contract.messages import MAX_FUTURE_S, MAX_PAST_S, BadMessage

RATE_TIMES = 5.0
"""Largest multiple of its topic's rate at which a publisher may send; a second's worth of that may come at once."""
PUBLISHERS = 16
"""Maximum number of publishers of one key at a time."""
FORGET_S = MAX_PAST_S + MAX_FUTURE_S
WINDOW = 64
"""Number of messages of a publisher that may arrive out of order."""
MEASUREMENTS = 64
"""Measurements of a key that are remembered: of the slowest stream more than its oldest that is taken."""
SEEN = (1 << WINDOW) - 1
"""The window of a publisher of which every number was here."""
NUMBERS = 1 << 32
"""Publishers count modulo this: at 200 Hz it comes around after eight months."""
IDENTITY_BYTES, NUMBER_BYTES = 12, 4
"""Sizes of the attachment of a message: its publisher, drawn at random, and its number, little-endian."""


class Numbering:
    """The attachments of one publisher. Zenoh's `source_info` says as much, but takes a reader six calls into Zenoh."""

    def __init__(self) -> None:
        self._identity = secrets.token_bytes(IDENTITY_BYTES)
        self._numbers = itertools.count()

    def attachment(self) -> bytes:
        """That of the next message. Several threads may ask at once."""
        return self._identity + (next(self._numbers) % NUMBERS).to_bytes(NUMBER_BYTES, "little")


class SequenceWindow:
    """Which of a publisher's numbers were here: the sliding window of RFC 4303, section 3.4.3 (doi:10.17487/RFC4303)."""

    def __init__(self, number: int):
        self._highest = number
        self._seen = SEEN  # what was before the first is not waited for

    def take(self, number: int) -> int:
        """How many more numbers are missing than before: those that were left out, or -1 for one that comes late. Raises
        BadMessage for one that was here, or may have been."""
        ahead = (number - self._highest) % NUMBERS
        if ahead == 1:  # as almost always
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
    """Lets `rate_hz` events a second through, and a second's worth at once (a token bucket). Seconds may start anywhere."""

    def __init__(self, rate_hz: float, now_s: float):
        self._rate_hz = rate_hz
        self._tokens = self._full = max(1.0, rate_hz)
        self._last_s = now_s

    def take(self, now_s: float) -> bool:
        """Whether one more fits."""
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
    """The publishers of one key. rate_hz: how often one of them is expected to send."""

    def __init__(self, rate_hz: float):
        self._limit_hz = RATE_TIMES * rate_hz
        self._publishers: dict[Hashable, _Publisher] = {}
        self._measurements: deque[tuple[int, str]] = deque(maxlen=MEASUREMENTS)
        self._newest_ns: int | None = None  # of these: what is newer cannot be one of them

    def admit(self, publisher: Hashable, number: int | None, now_s: float) -> int | None:
        """How many more numbers of this publisher are missing than before; None where it does not count. `now_s` must not run
        backwards. Raises BadMessage: replayed, rate, or publishers where there are too many."""
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
        """Takes a good message that was admitted; camera: the one that it is measured with, if any. Raises BadMessage for a
        measurement that was received from another publisher already, and where a publisher that does not number its messages
        sends one that is not newer; one that does may, as where a pose of one camera is older than the last of another."""
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
