"""Subscription to poses. Only the newest pose is kept, and only poses that are taken are decoded.

Zenoh's thread calls a function for each sample. The function only replaces the content of a slot and wakes the reader, so a slow
reader delays nobody and finds the newest pose, never a queue.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
import weakref
from collections.abc import Callable
from types import TracebackType
from typing import Self

import zenoh

from penumbra.client.pose import Pose
from penumbra.shared.contract.messages import BadMessage, FusedPose, decode
from penumbra.shared.contract.topics import FUSED

_LOG = logging.getLogger("penumbra.client")
SET_BACK_NS = int(FUSED.oldest_s * 1e9)
"""If stamps go back by more than this [ns], the publisher's clock was set back, and the pose is not late."""


class Slot:
    """Holds the newest sample. Any thread may put, one thread or one event loop takes."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._sample: zenoh.Sample | None = None
        self._wake: Callable[[], object] | None = None
        self.is_closed = False

    def put(self, sample: zenoh.Sample) -> None:
        """Replaces what is there and wakes the reader."""
        with self._changed:
            self._sample = sample
            self._rouse()

    def close(self) -> None:
        """Ends the waiting: no sample follows."""
        with self._changed:
            self.is_closed = True
            self._rouse()

    def wait(self, deadline: float | None) -> zenoh.Sample | None:
        """Waits for the sample and takes it; None once the slot is closed. Raises TimeoutError when the deadline (monotonic time,
        None for none) has passed."""
        with self._changed:
            while self._sample is None and not self.is_closed:
                left = None if deadline is None else deadline - time.monotonic()
                if left is not None and left <= 0:
                    raise TimeoutError
                self._changed.wait(left)
            return self._taken()

    def take(self, wake: Callable[[], object]) -> zenoh.Sample | None:
        """Takes the sample. If there is none, `wake` is called once, from another thread, at the next change."""
        with self._changed:
            if self._sample is None and not self.is_closed:
                self._wake = wake
            return self._taken()

    def _taken(self) -> zenoh.Sample | None:
        sample, self._sample = self._sample, None
        return sample

    def _rouse(self) -> None:
        self._changed.notify()
        if self._wake is not None:
            wake, self._wake = self._wake, None
            wake()


class Subscription:
    """Poses of one target. key: their key. why_silent: returns the reason why no poses arrive, as text."""

    def __init__(self, session: zenoh.Session, key: str, timeout: float | None, why_silent: Callable[[], str]):
        self._slot, self._timeout, self._why_silent = Slot(), timeout, why_silent
        self._last_ns: int | None = None
        self._logged: set[str] = set()
        self._refusal = ""
        # in Zenoh's own thread: Python would wait at the end of the program for a thread of the callback's
        handler = zenoh.handlers.Callback(self._slot.put, self._slot.close, indirect=False)
        subscriber = session.declare_subscriber(key, handler)
        # a subscriber with a callback lives as long as the session unless it is undeclared
        self._end = weakref.finalize(self, _undeclare, subscriber)
        self._end.atexit = False

    def close(self) -> None:
        """Ends the subscription, and with it every loop over these poses."""
        self._end()
        self._slot.close()

    def _pose_of(self, sample: zenoh.Sample) -> Pose | None:
        """The pose in a sample; None for a message that was refused, and for one that is not newer than the last. Both replicas
        of fusion publish while one takes over from the other."""
        try:
            message = decode(FusedPose, sample.payload.to_bytes())
        except BadMessage as error:
            if error.kind not in self._logged:
                self._logged.add(error.kind)
                _LOG.warning("message on %s refused; more of this kind are ignored: %s", sample.key_expr, error)
            self._refusal = f"a message was refused: {error}"
            return None
        if self._last_ns is not None and 0 <= self._last_ns - message.stamp_ns < SET_BACK_NS:
            return None
        self._last_ns = message.stamp_ns
        return Pose.of(message)

    def _silence(self) -> TimeoutError:
        """The error that says why no pose came within the timeout."""
        why, self._refusal = self._refusal or self._why_silent(), ""
        return TimeoutError(f"no pose for {self._timeout:g} s: {why}")


class Poses(Subscription):
    """Iterates over the poses of a target, each the newest at the moment it is taken, with increasing stamps.

    Each step waits for `timeout` [s] and then raises TimeoutError; the iterator can be used again afterwards. It ends when it or
    its cell is closed. One thread at a time.
    """

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Pose:
        deadline = None if self._timeout is None else time.monotonic() + self._timeout
        while True:
            try:
                sample = self._slot.wait(deadline)
            except TimeoutError:
                raise self._silence() from None
            if sample is None:
                raise StopIteration
            if (pose := self._pose_of(sample)) is not None:
                return pose

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _undeclare(subscriber: zenoh.Subscriber[None]) -> None:
    with contextlib.suppress(zenoh.ZError):  # the session is closed
        subscriber.undeclare()
