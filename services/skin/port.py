"""The serial port of a sensing board, by pyserial."""

from __future__ import annotations

import errno
import os
import select
import termios
import time
from contextlib import suppress
from pathlib import Path

import serial

from penumbra.shared.skin import board

BREAK_S = 1e-3
"""Length [s] of a BREAK, fifty bytes: a receiver detects a BREAK from one byte on."""
CHUNK = 4096
"""Maximum number of bytes read at once."""


class SerialPort:
    """`driver.Port` on a device such as /dev/ttyUSB0, opened exclusively. Raises OSError with what to do about it."""

    def __init__(self, device: str):
        self.name = device
        try:
            self._serial = serial.Serial(device, board.BAUD, exclusive=True)
        except OSError as error:
            raise OSError(_why(device, error)) from None
        with suppress(OSError, ValueError, NotImplementedError):  # other converters have no such mode and do not need it
            self._serial.set_low_latency_mode(True)  # otherwise an FTDI converter delays bytes by 16 ms

    def now_ns(self) -> int:
        return time.monotonic_ns()

    # pyserial's own read and write take three times as long, hundreds of times a second.

    def write(self, data: bytes) -> None:
        try:
            taken = os.write(self._serial.fileno(), data)
        except BlockingIOError:
            taken = 0
        if taken < len(data):
            raise OSError(f"{self.name} accepts no more bytes; check that the board is connected")

    def read(self, timeout_s: float) -> bytes:
        if timeout_s > 0.0 and not select.select([self._serial.fileno()], [], [], timeout_s)[0]:
            return b""
        data = os.read(self._serial.fileno(), CHUNK)
        if not data and timeout_s > 0.0:  # readable but empty: the device is gone
            raise OSError(f"{self.name} is gone; check that the board is connected")
        return data

    def send_break(self) -> None:
        """Send a BREAK. A pseudo-terminal carries none; there the flush of its queue, which comes first, replaces it."""
        try:
            self._serial.reset_output_buffer()
            self._serial.break_condition = True
            time.sleep(BREAK_S)
            self._serial.break_condition = False
            self._serial.reset_input_buffer()
        except termios.error as error:
            raise OSError(f"{self.name} is gone: {error}") from None

    def close(self) -> None:
        self._serial.close()


def _why(device: str, error: OSError) -> str:
    """Reason why a device cannot be opened, and what to do."""
    if not Path(device).exists():
        there = sorted(str(path) for pattern in ("ttyUSB*", "ttyACM*") for path in Path("/dev").glob(pattern))
        return f"no device {device}: is the board plugged in? Serial devices now: {', '.join(there) or 'none'}"
    if error.errno == errno.EACCES:
        return f"{device} may not be opened by this user: add it to the group that owns the device (often dialout)"
    if error.errno in (errno.EAGAIN, errno.EBUSY) or "lock" in str(error):
        return f"{device} is in use by another process: end it, or give another port"
    return f"{device} cannot be opened as a serial port: {error}"
