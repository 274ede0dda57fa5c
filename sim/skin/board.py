"""An emulated sensing board: bytes of commands in, bytes of replies out, at the times at which the real one sends them.

Behind the bytes are two electrodes on six channels: a sine around half of the converter's reference, its amplitude a function of
time, through the resonance of the excitation's coil and capacitors, with the noise of the pad and a converter of 12 bits. The
firmware's quirks are part of it: numbers of cycles in steps, requests that are overtaken or never answered, phases that slip,
a stop above nine samples per cycle. It has no clock: the caller gives the time.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin import board
from penumbra.shared.skin.board import Command, Kind

OVERHEAD_S = 0.48e-3
"""Time [s] of the firmware per request, in addition to cycles and transfer: from 231 replies/s at 128 cycles, 298/s at 32."""
SAMPLE_S = 1e-3
"""Duration [s] of the sample to which a pad's noise refers: 100 cycles at 100 kHz."""
CONVERTER_NOISE = 1.0
"""Standard deviation of a channel's own noise in a sample [steps]; the rest of a pad's noise is common to all channels of an
electrode."""
PHASE = 0.35
"""Phase of the sine at resonance [rad], relative to the converter's first sample."""
LONGEST = 0xFFFF
"""Maximum period of the firmware's timer [ticks]: a request for a longer one gets this one."""
FAULTS = {
    "error": "the text of an overrun in the middle of the next reply",
    "lost": "one byte of the next command is lost on its way",
    "short": "one byte of the next reply is lost on its way",
    "missing": "the next request is not answered",
    "slip": "a sample is lost in the middle of the next measurement, and its phases stay shifted",
}
"""Faults that a board can be made to have, and their effects."""


@dataclass(frozen=True)
class Tank:
    """The excitation's resonant circuit: coil [H], capacitor and the ring's own capacitance [F], quality factor."""

    coil: float = 47e-3
    capacitor: float = 47e-12
    ring: float = 15.7e-12
    quality: float = 20.0

    @property
    def resonance_hz(self) -> float:
        return float(1.0 / (2.0 * np.pi * np.sqrt(self.coil * (self.capacitor + self.ring))))

    def response(self, hz: float) -> complex:
        """Complex gain at a frequency [Hz]; 1 at resonance."""
        ratio = hz / self.resonance_hz
        return 1.0 / (1.0 + 1j * self.quality * (ratio - 1.0 / ratio))


class Board:
    """An emulated board. amplitude(time_s): amplitudes (e,) [V] of its electrodes at resonance. electrode_of (6,): the electrode
    that each channel measures, -1 for none. noise [V^2]: variance of an amplitude over a millisecond. reference [V]: of the
    converter.

    Times are seconds of any clock and must not decrease from call to call.
    """

    def __init__(
        self,
        amplitude: Callable[[float], ArrayLike],
        electrode_of: Sequence[int] = (0, 0, 0, 1, 1, 1),
        seed: int = 0,
        noise: float = 6.2e-6,
        reference: float = 3.3,
        tank: Tank = Tank(),
    ):
        self.tank = tank
        self._amplitude, self._noise, self._lsb = amplitude, noise, reference / board.FULL_SCALE
        self._electrode_of = np.asarray(electrode_of)
        self._rng = np.random.default_rng([seed, 7])
        self._due: Counter[str] = Counter()
        self._line_s = 0.0
        self.power_on()

    def power_on(self) -> None:
        """Resets to the state after power-on: standard frequencies, nothing pending."""
        self._ticks = board.period(board.ELECTRODE_HZ)
        self._sample_ticks = board.period(board.SAMPLE_HZ)
        self._stopped = False
        self._slipped = 0
        self._partial = b""
        self._pending: deque[tuple[float, Command]] = deque()
        self._free_s = 0.0
        self._sent: deque[tuple[float, bytes]] = deque()

    @property
    def samples_per_cycle(self) -> int:
        return max(2, round(self._ticks / self._sample_ticks))

    @property
    def electrode_hz(self) -> float:
        return board.CLOCK_HZ / self._ticks

    def fault(self, kind: str) -> None:
        """Let one of FAULTS happen once. Raises ValueError for an unknown one."""
        if kind not in FAULTS:
            raise ValueError(f"expected a fault of a board, one of {', '.join(FAULTS)}, got {kind!r}")
        self._due[kind] += 1

    def receive(self, data: bytes, time_s: float) -> None:
        """Receives bytes whose transmission began at time_s."""
        self.send(time_s)
        if data and self._happens("lost"):
            data = data[: len(data) // 2] + data[len(data) // 2 + 1 :]
        self._line_s = max(self._line_s, time_s)
        while data:
            taken = min(len(data), board.COMMAND_BYTES - len(self._partial))
            self._partial, data = self._partial + data[:taken], data[taken:]
            self._line_s += taken * board.BYTE_S
            if len(self._partial) == board.COMMAND_BYTES:
                command = Command.unpack(self._partial)
                if command.is_answered(self.samples_per_cycle):  # unanswered commands overtake no request
                    self._pending.append((self._line_s, command))
                self._partial = b""

    def receive_break(self, time_s: float) -> None:
        """Handles a BREAK (the line held low): drops a partly received command and all pending ones."""
        self.send(time_s)
        self._partial = b""
        self._pending.clear()

    def send(self, time_s: float) -> bytes:
        """Returns the bytes that have reached the other end of the line by time_s and were not returned before."""
        while self._pending and (begins := self._begins())[0] <= time_s:
            start_s, number = begins
            for _ in range(number):  # only the last of several is answered
                command = self._pending.popleft()[1]
            self._carry_out(command, start_s)
        out = b""
        while self._sent and self._sent[0][0] <= time_s:
            out += self._sent.popleft()[1]
        return out

    def next_s(self) -> float:
        """Time [s] at which `send` next has something to do: infinity where nothing is under way."""
        times = [self._sent[0][0]] if self._sent else []
        times += [self._begins()[0]] if self._pending else []
        return min(times, default=float("inf"))

    def _begins(self) -> tuple[float, int]:
        """Time [s] at which the next request is processed, OVERHEAD_S after the firmware is free and after the last request of a
        burst, and the number of pending requests that have arrived by then."""
        start_s = max(self._free_s, self._pending[0][0]) + OVERHEAD_S
        number = 0
        for arrived_s, _ in self._pending:
            if arrived_s > start_s:
                break
            start_s, number = max(start_s, arrived_s + OVERHEAD_S), number + 1
        return start_s, number

    def _happens(self, kind: str) -> bool:
        happens = self._due[kind] > 0
        self._due[kind] -= happens
        return happens

    def _carry_out(self, command: Command, start_s: float) -> None:
        if self._stopped or self._happens("missing"):
            return
        if command.kind == Kind.SEND_MEASURES:
            count = board.cycles(command.measures, self.samples_per_cycle)
            ends_s = start_s + count * self._ticks / board.CLOCK_HZ
            packet = board.encode(*self._measure(count, 0.5 * (start_s + ends_s)))
        else:
            ends_s, packet = start_s, self._set_frequency(command).pack()
            if self.samples_per_cycle not in board.SAMPLES_PER_CYCLE:
                self._stopped = True
                return
        middle = len(packet) // 2
        if self._happens("error"):
            packet = packet[:middle] + board.OVERRUN + packet[middle:]
        if self._happens("short"):
            packet = packet[:middle] + packet[middle + 1 :]
        self._free_s = ends_s + len(packet) * board.BYTE_S
        self._sent.append((self._free_s, packet))

    def _set_frequency(self, command: Command) -> Command:
        """Sets the frequencies, within the limits of the timers, and returns the answer with the actual ones."""
        electrode_hz = command.electrode_hz if command.electrode_hz > 0.0 else self.electrode_hz
        sample = command.sample_hz
        if command.kind == Kind.SET_FREQ_2:
            asked = round(min(sample, 255.0)) if sample > 0.0 else self.samples_per_cycle
            samples = max(2, asked)
            self._ticks = min(board.period(electrode_hz, samples), LONGEST // samples * samples)
            self._sample_ticks = self._ticks // samples
        else:
            self._ticks = min(board.period(electrode_hz), LONGEST)
            self._sample_ticks = min(board.period(sample), LONGEST) if sample > 0.0 else self._sample_ticks
        return Command(command.kind, command.measures, self.electrode_hz, board.CLOCK_HZ / self._sample_ticks)

    def _measure(self, count: int, middle_s: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Counts (6,) and sums (6, samples_per_cycle) over `count` cycles around middle_s."""
        spc = self.samples_per_cycle
        volts = np.append(np.asarray(self._amplitude(middle_s), dtype=float), 0.0)  # the last one for channels without electrode
        sine = volts * self.tank.response(self.electrode_hz) * np.exp(1j * PHASE) / self._lsb
        turns, share, lengths = self._blocks(count)
        samples = np.exp(2j * np.pi * np.arange(spc) / spc)
        levels = 0.5 * board.FULL_SCALE + share * np.real(sine[:, None, None] * np.exp(1j * turns)[:, None] * samples)
        # White noise of a raw sample that gives an amplitude over 100 cycles of 4 samples the pad's noise: var A = 2 var / 400.
        total = np.sqrt(200.0 * self._noise) / self._lsb
        mean, variance = _converted(levels[self._electrode_of], np.hypot(total, 1.0 / np.sqrt(12.0)))
        common = 1.0 - min(1.0, (CONVERTER_NOISE / max(total, 1e-9)) ** 2)
        electrode = self._rng.standard_normal((len(volts), spc))[self._electrode_of]
        own = self._rng.standard_normal((board.CHANNELS, spc))
        noise = np.sqrt(common) * electrode + np.sqrt(1.0 - common) * own
        exact = np.einsum("b,cbs->cs", lengths, mean)
        sums = np.rint(exact + np.sqrt(np.einsum("b,cbs->cs", lengths, variance)) * noise)
        # A count that does not fit its 16 bits wraps around, as it does on the board.
        return np.full(board.CHANNELS, count & 0xFFFF), np.clip(sums, 0, board.FULL_SCALE * count).astype(np.int64)

    def _blocks(self, count: int) -> tuple[Array, float, Array]:
        """Runs of cycles with the same phase: phases [rad] (b,), share of the amplitude left in each, numbers of cycles (b,).

        Phases drift where the converter's rate is no multiple of the excitation's. They jump from one block of 128 samples to
        the next where the number of samples per cycle does not divide it.
        """
        spc, size = self.samples_per_cycle, board.step(self.samples_per_cycle)
        shift = 2.0 * np.pi * self._slipped / spc
        drift = 2.0 * np.pi * ((spc * self._sample_ticks / self._ticks + 0.5) % 1.0 - 0.5)  # in one cycle
        jump = 2.0 * np.pi * (board.BLOCK % spc) / spc  # in one block
        if self._happens("slip"):
            self._slipped = (self._slipped + 1) % spc
            return np.array([shift, shift + 2.0 * np.pi / spc]), 1.0, np.array([count - count // 2, count // 2], dtype=float)
        if not drift and not jump:
            return np.array([shift]), 1.0, np.array([float(count)])
        blocks = np.arange(count // size)
        share = float(np.sin(0.5 * size * drift) / (size * np.sin(0.5 * drift))) if drift else 1.0
        turns = shift + blocks * (size * drift + jump) + 0.5 * (size - 1) * drift
        return turns.astype(float), share, np.full(len(blocks), float(size))


def _converted(level: Array, sigma: float) -> tuple[Array, Array]:
    """Mean and variance [steps] of samples of a level with normal noise, clipped to the converter's range. sigma includes the
    rounding, which with noise of many steps is white and independent of the level."""
    low, high = -level / sigma, (board.FULL_SCALE - level) / sigma
    below, above = ndtr(low), ndtr(-high)
    density_low, density_high = (np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi) for z in (low, high))
    inside = 1.0 - below - above
    mean = level * inside + sigma * (density_low - density_high) + board.FULL_SCALE * above
    square = (level**2 + sigma**2) * inside + sigma * (level * density_low - (level + board.FULL_SCALE) * density_high)
    square += board.FULL_SCALE**2 * above
    return mean, np.maximum(square - mean**2, 0.0)
