"""Protocol of the sensing board on its serial line: commands of 16 bytes, replies with sums, and amplitudes from the sums.

A board excites its pad's ring with a sine of `electrode_hz`, takes `samples_per_cycle` samples of each of its six channels in
every cycle, and sums each of these samples over many cycles. The amplitude of a channel is the first Fourier component of the
mean cycle. There is no header, no checksum and no sequence number: only a reply's size and the plausibility of its values show
whether it is complete. Only bytes and arrays here: `services/skin` has the serial port, `sim.skin.board` the emulated board.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from penumbra.shared.cell.pads import Pad, PadType, SensingBoard
from penumbra.shared.geometry.rigid import Array

BAUD = 500_000
"""Rate of the serial line [bit/s]."""
BYTE_S = 10 / BAUD
"""Duration [s] of a byte on the line: eight bits, a start and a stop."""
CLOCK_HZ = 120e6
"""Clock frequency [Hz]. Every period is a whole number of its ticks."""
SAMPLE_HZ = 400e3
"""Sampling rate [Hz] of a channel after power-on."""
ELECTRODE_HZ = 100e3
"""Frequency [Hz] of the excitation after power-on."""
CHANNELS = 6
"""Number of channels of the converter."""
COMMAND_BYTES, HEAD_BYTES = 16, 16
"""Length [bytes] of a command, and of a reply before its sums."""
SAMPLES_PER_CYCLE = range(2, 10)
"""Samples per cycle that a board supports; with more, its firmware stops."""
BLOCK = 128
"""Number of samples that a board takes at once. The number of cycles grows in steps of about BLOCK / samples_per_cycle."""
MOST_MEASURES = 65_504
"""Maximum number of cycles in a command that a board answers."""
FULL_SCALE = 4095
"""Maximum value of one sample, 12 bits."""
UNUSED = 0xFFFF_FFFF
"""Value of `measures` in a command that does not use it."""
KEEP = struct.unpack("<f", b"\xff\xff\xff\xfe")[0]
"""Frequency in a command that leaves the setting unchanged, as any negative one does. With UNUSED and KEEP no 16 bytes across two
commands look like another command, so a board that lost a byte stays silent and executes nothing unintended."""
OVERRUN = b"Error\r\n"
"""Text that the firmware prints, on the same line and at any place, when its converter was not read in time."""

_COMMAND = struct.Struct("<iIff")
_HEAD = struct.Struct("<Bx6H2x")


class PacketError(ValueError):
    """Bytes that are not a command or reply of a board. The text says what was expected and what was received."""


class Kind(IntEnum):
    """Type of a command."""

    SEND_MEASURES = 0
    SET_FREQ = 1
    SET_FREQ_2 = 2


@dataclass(frozen=True)
class Command:
    """A command. kind: a `Kind`, or any other 32-bit integer, which no board answers. measures: cycles to measure. electrode_hz:
    of the excitation. sample_hz: of the converter, and for SET_FREQ_2 the samples per cycle."""

    kind: int
    measures: int = UNUSED
    electrode_hz: float = KEEP
    sample_hz: float = KEEP

    def pack(self) -> bytes:
        """The command as 16 bytes. Raises PacketError for numbers out of range."""
        try:
            return _COMMAND.pack(self.kind, self.measures, self.electrode_hz, self.sample_hz)
        except (struct.error, OverflowError):
            raise PacketError(f"expected a 32-bit kind, measures from 0 to 2^32 - 1 and frequencies, got {self}") from None

    @staticmethod
    def unpack(data: bytes) -> Command:
        """Decodes a command. Raises PacketError for any size but 16 bytes."""
        if len(data) != COMMAND_BYTES:
            raise PacketError(f"expected a command or its echo of {COMMAND_BYTES} bytes, got {len(data)}")
        return Command(*_COMMAND.unpack(data))

    def is_answered(self, samples_per_cycle: int) -> bool:
        """Whether a board answers the command or stays silent."""
        if self.kind == Kind.SEND_MEASURES:
            return 0 < self.measures <= MOST_MEASURES and samples_per_cycle in SAMPLES_PER_CYCLE
        return self.kind in (Kind.SET_FREQ, Kind.SET_FREQ_2)


def send_measures(measures: int) -> bytes:
    """Requests the sums over a number of cycles, rounded as in `cycles`. Raises PacketError for a number that is never
    answered."""
    if not 0 < measures <= MOST_MEASURES:
        raise PacketError(f"measures: expected 1 to {MOST_MEASURES} cycles, got {measures}, which a board never answers")
    return Command(Kind.SEND_MEASURES, measures).pack()


def set_frequency(electrode_hz: float, samples_per_cycle: int) -> bytes:
    """The command SET_FREQ_2. Raises PacketError for values that stop the firmware."""
    if samples_per_cycle not in SAMPLES_PER_CYCLE:
        raise PacketError(f"samples_per_cycle: expected 2 to 9, got {samples_per_cycle}; above 9 the firmware stops")
    if not 0.0 < electrode_hz * samples_per_cycle < CLOCK_HZ:
        raise PacketError(f"electrode_hz: expected above 0 and below {CLOCK_HZ / samples_per_cycle:g} Hz, got {electrode_hz:g}")
    return Command(Kind.SET_FREQ_2, UNUSED, electrode_hz, float(samples_per_cycle)).pack()


def period(hz: float, multiple: int = 1) -> int:
    """Period, in ticks of the clock [1 / 120 MHz], that a board uses for a frequency: a multiple of `multiple`, at least one."""
    return max(1, round(CLOCK_HZ / hz / multiple)) * multiple


def actual_hz(hz: float, multiple: int = 1) -> float:
    """Frequency that a board uses for a requested one. multiple: samples per cycle, where the two are set together."""
    return CLOCK_HZ / period(hz, multiple)


def step(samples_per_cycle: int) -> int:
    """Number of cycles in one block, by which `measures` grow."""
    return round(BLOCK / samples_per_cycle)


def cycles(measures: int, samples_per_cycle: int) -> int:
    """Number of cycles that a board measures when `measures` are requested: 100 at 4 samples per cycle gives 128."""
    size = step(samples_per_cycle)
    return -(-measures // size) * size


def reply_bytes(samples_per_cycle: int) -> int:
    """Size [bytes] of a reply to SEND_MEASURES."""
    return HEAD_BYTES + 4 * CHANNELS * samples_per_cycle


def reply_s(count: int, electrode_hz: float, samples_per_cycle: int) -> float:
    """Minimum time [s] from a command's first byte to its reply's last: two packets on the line and the cycles."""
    return (COMMAND_BYTES + reply_bytes(samples_per_cycle)) * BYTE_S + count / electrode_hz


@dataclass(frozen=True)
class Reply:
    """A reply. counts (6,): cycles of each channel; sums (6, samples_per_cycle): sums of the raw samples over these cycles."""

    counts: NDArray[np.int64]
    sums: NDArray[np.int64]

    @property
    def samples_per_cycle(self) -> int:
        return int(self.sums.shape[1])

    def fourier(self) -> tuple[Array, NDArray[np.complex128]]:
        """Mean level (6,) and first Fourier component X (6,) of the mean cycle, in steps of the converter: |X| is the amplitude,
        arg X the phase of a cosine. With two samples per cycle only the component along the samples is observable.

        Raises PacketError where a channel has no cycles.
        """
        if not self.counts.all():
            empty = ", ".join(map(str, np.flatnonzero(self.counts == 0)))
            raise PacketError(
                f"expected at least one cycle in every channel, got none in channel {empty}; request the cycles again"
            )
        mean = self.sums / self.counts[:, None]
        return mean.mean(axis=1), mean @ _waves(self.samples_per_cycle)

    def is_possible(self, count: int) -> bool:
        """Whether the reply to a request of `count` cycles is plausible: every channel has this count, and no sum exceeds full
        scale in all cycles."""
        return bool((self.counts == count).all() and self.sums.max() <= FULL_SCALE * count)


@cache
def _waves(samples_per_cycle: int) -> NDArray[np.complex128]:
    """Fourier weights (samples_per_cycle,): 2 / n exp(-2 pi i k / n). With two samples the wave is its own conjugate and counts
    once."""
    n = samples_per_cycle
    waves: NDArray[np.complex128] = (1.0 if n == 2 else 2.0) / n * np.exp(-2j * np.pi * np.arange(n) / n)
    return waves.round(15)


def encode(counts: ArrayLike, sums: ArrayLike) -> bytes:
    """Bytes of a reply with counts (6,) and sums (6, samples_per_cycle). Raises PacketError for values out of range."""
    n, s = np.asarray(counts), np.asarray(sums)
    if n.shape != (CHANNELS,) or s.ndim != 2 or len(s) != CHANNELS or s.shape[1] not in SAMPLES_PER_CYCLE:
        raise PacketError(f"expected counts (6,) and sums (6, 2 to 9), got {n.shape} and {s.shape}")
    if n.min() < 0 or n.max() > 0xFFFF or s.min() < 0 or s.max() > 0xFFFF_FFFF:
        raise PacketError(f"expected counts of 16 bits and sums of 32 bits, got up to {n.max()} and {s.max()}")
    return _HEAD.pack(s.shape[1], *map(int, n)) + s.astype("<u4").tobytes()


def decode(data: bytes) -> Reply:
    """Counts and sums of a complete reply. Raises PacketError that names the valid sizes."""
    spc = data[0] if data else 0
    if spc in SAMPLES_PER_CYCLE and len(data) == reply_bytes(spc):
        counts = np.array(_HEAD.unpack_from(data)[1:], dtype=np.int64)
        return Reply(counts, np.frombuffer(data, "<u4", offset=HEAD_BYTES).reshape(CHANNELS, spc).astype(np.int64))
    sizes = {reply_bytes(n): n for n in SAMPLES_PER_CYCLE}
    got = "1 byte" if len(data) == 1 else f"{len(data)} bytes"
    if len(data) in sizes:
        fit = f"{reply_bytes(spc)} bytes fit" if spc in SAMPLES_PER_CYCLE else "a board takes 2 to 9"
        raise PacketError(f"{got} hold {sizes[len(data)]} samples a cycle, but the first byte says {spc}: {fit}")
    fit = f", and by its first byte this one has {reply_bytes(spc)}" if spc in SAMPLES_PER_CYCLE else ""
    listed = f"{', '.join(map(str, list(sizes)[:-1]))} or {max(sizes)}"
    raise PacketError(f"expected a reply of {listed} bytes (16 + 24 n for n = 2 to 9 samples a cycle){fit}, got {got}")


def readers(pad: Pad, pad_type: PadType) -> tuple[SensingBoard, ...]:
    """Boards of a pad from the cell file. Default: two electrodes per board in the order of the pad type, the first on channels 0
    to 2, the second on 3 to 5. Five electrodes c, r, l, t, b need three boards."""
    if pad.boards:
        return pad.boards
    names = list(pad_type.electrodes)
    pairs = [names[k : k + 2] for k in range(0, len(names), 2)]
    return tuple(SensingBoard(channels={name: (3 * k, 3 * k + 1, 3 * k + 2) for k, name in enumerate(pair)}) for pair in pairs)


FILLER = b"\xff"
"""A byte with which no command starts. 16 of them end any command that a board is reading."""


def realign_probes(attempt: int = 0) -> list[bytes]:
    """Stream of 16 pieces in which a board finds exactly one command, wherever in a command it is: each piece is one byte longer
    than a command. Each asks to keep the frequencies, and carries its number and that of the attempt (modulo 8) in `measures`,
    which the board's answer repeats. A board recognises nothing else in the stream. Between the pieces it needs time to
    answer."""
    return [_probe(attempt, number).pack() + FILLER for number in range(COMMAND_BYTES)]


def realign_answer(data: bytes, attempt: int = 0) -> tuple[int, Command] | None:
    """First answer to `realign_probes` of this attempt in received bytes: the number of the piece that the board understood, and
    the answer; None where there is none. After `sent` pieces, (number - sent) % 16 fillers realign the board."""
    answers = {_probe(attempt, number).pack()[:8]: number for number in range(COMMAND_BYTES)}
    for at in range(len(data) - COMMAND_BYTES + 1):
        if (number := answers.get(data[at : at + 8])) is not None:
            return number, Command.unpack(data[at : at + COMMAND_BYTES])
    return None


def _probe(attempt: int, number: int) -> Command:
    return Command(Kind.SET_FREQ, 0xFFFF_FF80 | attempt % 8 << 4 | number)
