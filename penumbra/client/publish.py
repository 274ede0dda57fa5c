"""Publishing of a program's own measurements, with checks.

A stamp is the time of the measurement in integer nanoseconds since the epoch, as `time.time_ns()` returns it; None means now.
Messages that readers would refuse raise ValueError here: a wrong shape, dtype, range or stamp, and too many messages per second.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import zenoh
from numpy.typing import ArrayLike, NDArray

from penumbra.shared.contract.messages import BadMessage, Frame, Joints, Message, Voltages, check_stamp
from penumbra.shared.contract.topics import Topic
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.runtime.connection import BusError, short
from penumbra.shared.runtime.guard import RATE_TIMES, Bucket
from penumbra.shared.runtime.sender import Sender

LARGEST_ANGLE = 100.0
"""Joint angle [rad] above which degrees are assumed: sixteen turns."""
PERIOD_NS = 1_000_000
"""Default time [ns] between samples of a pad without stamps: sensing boards give a thousand per second."""
UNEVEN = 0.5
"""Maximum deviation of a row's stamp from an even spacing, in periods."""


class Stream:
    """One key on which this program may publish, from one thread at a time. session: returns the session, which is opened when
    the first message is sent. name: of the sensor. rate_hz: expected rate of the cell."""

    def __init__(self, session: Callable[[], zenoh.Session], topic: Topic, key: str, name: str, rate_hz: float):
        self._session, self._topic, self._key, self.name = session, topic, key, name
        self._sender: Sender | None = None
        self._limit_hz = RATE_TIMES * rate_hz
        self._bucket = Bucket(self._limit_hz, time.monotonic())
        self.last_ns: int | None = None

    def check(self, stamp_ns: int) -> None:
        """Raises ValueError for a stamp that readers would refuse."""
        try:
            check_stamp(self._topic.message, stamp_ns, time.time_ns(), self._topic.oldest_s)
        except BadMessage as error:
            raise ValueError(f"{self.name}: {error}; a stamp is time.time_ns() of the measurement") from None
        if self.last_ns is not None and stamp_ns <= self.last_ns:
            raise ValueError(
                f"{self.name}: expected a stamp after the last one, {self.last_ns}, got {stamp_ns}; publish each measurement once"
            )

    def send(self, message: Message) -> None:
        """Checks the stamp and the rate, and sends. Raises ValueError, and BusError where the cell is closed or no router is
        found for the first message."""
        self.check(message.stamp_ns)
        if not self._bucket.take(time.monotonic()):
            raise ValueError(
                f"{self.name}: expected at most {self._limit_hz:g} messages a second, which is what readers accept, got more; "
                "publish less often"
            )
        if self._sender is None:
            self._sender = Sender(self._session(), self._topic, self._key)
        try:
            self._sender.send(message)
        except zenoh.ZError as error:
            raise BusError(f"{self.name}: the message cannot be sent ({short(error)}): is the cell closed?") from None
        self.last_ns = message.stamp_ns


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera of the cell, as its file describes it.

    Attributes:
        name: Its name in the cell.
        width: Columns of an image [px].
        height: Rows of an image [px].
        rate_hz: Expected images per second.
        K: (3, 3), intrinsic matrix [px].
        T_world_camera: (4, 4), pose of the optical frame (x right, y down, z forward).
    """

    name: str
    width: int
    height: int
    rate_hz: float
    K: Array
    T_world_camera: Array
    _stream: Stream = field(repr=False)

    def publish(self, image: NDArray[np.uint8], stamp_ns: int | None = None) -> None:
        """Sends an image.

        Args:
            image: uint8 (height, width, 3), channels in the order red, green, blue. OpenCV has the opposite order:
                `cv2.cvtColor(image, cv2.COLOR_BGR2RGB)`.
            stamp_ns: The middle of the exposure [ns since the epoch]. None: now.

        Raises:
            ValueError: The image or the stamp is not as expected, or images come too often. The text says what to do.
            BusError: The cell is closed, or no router is found for the first message.
        """
        expected = (self.height, self.width, 3)
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.shape != expected:
            raise ValueError(
                f"camera {self.name}: expected an image, uint8 {expected} (height, width, RGB), got {_what(image)}; convert or "
                "resize it, or change width and height in the cell file"
            )
        self._stream.send(Frame(stamp_ns=_stamp(self._stream.name, stamp_ns), image=image))


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot of the cell.

    Attributes:
        name: Its name in the cell.
        joints: Names of its moving joints, in the order of their angles.
    """

    name: str
    joints: tuple[str, ...]
    _stream: Stream = field(repr=False)

    def publish(self, q: ArrayLike, stamp_ns: int | None = None) -> None:
        """Sends joint angles.

        Args:
            q: Angles [rad], or displacements [m] of prismatic joints, in the order of `joints`.
            stamp_ns: Time of the measurement [ns since the epoch]. None: now.

        Raises:
            ValueError: Angles or stamp are not as expected, or messages come too often. The text says what to do.
            BusError: The cell is closed, or no router is found for the first message.
        """
        angles = _floats(f"robot {self.name}", q)
        if angles.shape != (len(self.joints),):
            order = ", ".join(self.joints)
            raise ValueError(f"robot {self.name}: expected {len(self.joints)} joint angles ({order}), got shape {angles.shape}")
        if np.abs(angles).max() > LARGEST_ANGLE:
            worst = angles[np.abs(angles).argmax()]
            raise ValueError(f"robot {self.name}: expected radians up to {LARGEST_ANGLE:g}, got {worst:g}: are these degrees?")
        self._stream.send(Joints(stamp_ns=_stamp(self._stream.name, stamp_ns), position=angles))


@dataclass(frozen=True, eq=False)
class Pad:
    """A pad of the skin.

    Attributes:
        name: Its name in the cell.
        electrodes: Their names, in the order of the columns of voltages.
        limit_V: The reference of its converter [V], the maximum accepted amplitude.
    """

    name: str
    electrodes: tuple[str, ...]
    limit_V: float
    _stream: Stream = field(repr=False)

    def publish(self, volts: ArrayLike, stamps_ns: ArrayLike | None = None) -> None:
        """Sends amplitudes of the electrodes. Readers accept 250 messages per second from a pad: send faster samples in batches.

        Args:
            volts: Amplitudes [V]: one row (electrodes,), or a batch (samples, electrodes) with the oldest row first.
            stamps_ns: A stamp [ns since the epoch] for each row, evenly spaced. None: the last row was measured now, and the rows
                are a millisecond apart. The period of a single row is the time since the row before it.

        Raises:
            ValueError: Amplitudes or stamps are not as expected, or messages come too often. The text says what to do.
            BusError: The cell is closed, or no router is found for the first message.
        """
        what = f"pad {self.name}"
        rows = np.atleast_2d(_floats(what, volts))
        if rows.ndim != 2 or rows.shape[1] != len(self.electrodes) or not len(rows):
            order = ", ".join(self.electrodes)
            raise ValueError(f"{what}: expected rows of {len(self.electrodes)} amplitudes ({order}), got shape {rows.shape}")
        if np.abs(rows).max() > self.limit_V:
            raise ValueError(
                f"{what}: expected amplitudes up to {self.limit_V:g} V, got {np.abs(rows).max():g}: are these volts, and is "
                "adc_reference right in the cell file?"
            )
        stamp_ns, period_ns = self._times(stamps_ns, len(rows), self._stream.last_ns)
        self._stream.send(Voltages(stamp_ns=stamp_ns, period_ns=period_ns, volts=rows.astype(np.float32)))

    def _times(self, stamps_ns: ArrayLike | None, count: int, last_ns: int | None) -> tuple[int, int]:
        """Stamp of the last row and period [ns] of `count` rows; last_ns: the stamp before them."""
        if stamps_ns is None:
            stamps = time.time_ns() - PERIOD_NS * np.arange(count - 1, -1, -1, dtype=np.int64)
        else:
            stamps = np.atleast_1d(np.asarray(stamps_ns))
        if stamps.shape != (count,) or stamps.dtype.kind not in "iu":
            raise ValueError(
                f"pad {self.name}: expected {count} stamps, one a row, in integer nanoseconds since the epoch, got "
                f"{_what(stamps)}; use time.time_ns()"
            )
        newest = int(stamps[-1])
        if count == 1:
            elapsed = PERIOD_NS if last_ns is None else newest - last_ns
            return newest, min(max(elapsed, 1), 1_000_000_000)
        period_ns = (newest - int(stamps[0])) / (count - 1)
        even = stamps[0] + period_ns * np.arange(count)
        if not 1 <= period_ns <= 1e9 or np.abs(stamps - even).max() > UNEVEN * period_ns:
            raise ValueError(
                f"pad {self.name}: expected stamps that grow evenly, got {_short(stamps)}; send a gap as two batches"
            )
        return newest, round(period_ns)


def _stamp(name: str, stamp_ns: int | None) -> int:
    if stamp_ns is None:
        return time.time_ns()
    if isinstance(stamp_ns, bool) or not isinstance(stamp_ns, int | np.integer):
        raise ValueError(
            f"{name}: expected a stamp in integer nanoseconds since the epoch, as of time.time_ns(), got {stamp_ns!r:.60} "
            f"({type(stamp_ns).__name__}); multiply seconds by 1e9 and round"
        )
    return int(stamp_ns)


def _floats(what: str, values: ArrayLike) -> Array:
    """The values as float64. Raises ValueError where one is not a finite number."""
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what}: expected numbers, got {values!r:.60} ({error})") from None
    if not array.size or not np.isfinite(array).all():
        raise ValueError(f"{what}: expected finite numbers, got {_short(array)}; leave a faulty measurement out")
    return array


def _what(value: object) -> str:
    return f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else f"{type(value).__name__} {value!r:.60}"


def _short(array: NDArray[np.generic]) -> str:
    return np.array2string(array, threshold=6, edgeitems=3).replace("\n", "")
