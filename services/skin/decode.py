"""`penumbra skin decode`: one reply of a sensing board, in hex from standard input, as JSON."""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np

from penumbra.services import flags
from penumbra.shared.skin import board


@flags.command(
    "skin decode",
    "Reads one reply packet in hex from standard input (spaces and line breaks do not matter) and prints it as JSON.",
    example="penumbra skin decode < packet.hex",
)
def main(options: flags.Options) -> int:
    """Print the reply's contents; returns 0, or 2 for a text that is no reply."""
    try:
        print(json.dumps(describe(from_hex(sys.stdin.buffer.read()))))
    except board.PacketError as error:
        print(f"penumbra skin decode: {error}", file=sys.stderr)
        return 2
    return 0


def from_hex(text: bytes) -> bytes:
    """Bytes from hex digits. Raises PacketError with the first character that is no hex digit."""
    digits = b"".join(text.split())
    stranger = next((at for at, digit in enumerate(digits) if digit not in b"0123456789abcdefABCDEF"), None)
    if stranger is not None:
        got = digits[stranger : stranger + 1].decode("ascii", errors="backslashreplace")
        raise board.PacketError(f"expected hex digits, got {got!r} as character {stranger + 1}")
    if len(digits) % 2:
        raise board.PacketError(f"expected two hex digits per byte, got {len(digits)} digits")
    return bytes.fromhex(digits.decode())


def describe(packet: bytes) -> dict[str, Any]:
    """A reply's contents, six channels each: cycles, sums, and the mean cycle's level and amplitude [steps of the converter] and
    phase [degrees, above -180 to 180]. Raises PacketError for bytes that are no reply."""
    reply = board.decode(packet)
    dc, component = reply.fourier()
    return {
        "samples_per_cycle": reply.samples_per_cycle,
        "counts": reply.counts.tolist(),
        "sums": reply.sums.tolist(),
        "dc": dc.tolist(),
        "amplitude": np.abs(component).tolist(),
        "phase_deg": (np.degrees(np.angle(component)) + 0.0).tolist(),
    }
