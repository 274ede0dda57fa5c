"""Reads the boards of one pad simultaneously, decodes their replies, and recovers boards that lost synchronisation.

A row of a pad, about 230 times a second:

1. request a measurement from all boards in quick succession, so that they measure at the same time
2. read every reply; it is valid if it has its size, the requested cycles, possible sums, and the expected phase
3. amplitude of an electrode: mean over its channels of the first Fourier component's length; stamp: the middle of the integration
4. a board that failed is recovered, and the row is left out

Recovery tries the cheapest step first. A damaged reply shows that the board receives commands: wait until the line is quiet.
After a missing reply, or a jump of the phase: end the command that the board is reading, and send a stream of probes to find
where its commands begin and which frequency it has (`shared.skin.board.realign_probes`). If there is no answer: a BREAK, and the
probes again. If there is still none: `BoardSilent`.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin import board
from penumbra.shared.skin.board import Command, Kind, PacketError

Components = NDArray[np.complex128]

SWEEP_HZ = (80e3, 115e3, 1e3)
"""First, last and step [Hz] of the frequency sweep for the resonance."""
OVERHEAD_S = 0.5e-3
"""Time [s] that a board needs for an answer besides cycles and line."""
PATIENCE_S = 14e-3
"""Maximum delay [s] of an answer beyond its minimum time, caused by a USB converter and the machine."""
PACE_S = 0.7e-3
"""Time [s] between probes: a board starts on a command half a millisecond after it arrived, unless another one arrives."""
PROBE_S = 3e-3
"""Time [s] to wait for the answer to the last probe of a round."""
LAST_PACE_S = 0.015
"""Time [s] between probes, and for their answers, in the last round before a board is given up."""
QUIET_S = 2e-3
"""Time [s] without bytes after which a line is quiet: USB delivers once per millisecond."""
TURN = np.radians(2.0)
"""Phase jump [rad] that counts as a slip, if it also exceeds six times the phase's noise."""
FOLLOW = 0.1
"""Weight of the newest reply in the expected phase, which drifts with temperature."""
BATCH_NS = 20_000_000
"""Length [ns] of a published batch of rows, as in the emulator."""
UNEVEN = 0.5
"""Maximum deviation of a row's spacing within a batch, as a share of the period."""


class Port(Protocol):
    """A serial line to a board. Raises OSError if it is gone."""

    name: str

    def now_ns(self) -> int:
        """Time [ns] of a monotonic clock."""

    def write(self, data: bytes) -> None:
        """Pass bytes to the line and return at once."""

    def read(self, timeout_s: float) -> bytes:
        """Received bytes, at least one; nothing if none arrives within the time."""

    def send_break(self) -> None:
        """Discard unsent bytes, and hold the line low for longer than a byte."""

    def close(self) -> None:
        """Close the line."""


class BoardSilent(OSError):
    """No measuring board answers on this port, or no longer: it has to be opened and tuned again."""


@dataclass
class Count:
    """Statistics of a line: replies, faults by kind, recoveries, BREAKs needed for them, and the longest time [s] between two
    replies with a fault in between."""

    replies: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    resyncs: int = 0
    breaks: int = 0
    longest_s: float = 0.0


class Line:
    """One board on its port. measures: cycles per reply; noise: standard deviation of an amplitude over 100 cycles, in steps of
    the converter. `electrode_hz` is the frequency last set, `resonance_hz` the result of `tune`, `asked_ns` the time of the last
    request."""

    def __init__(self, port: Port, channels: Sequence[int], measures: int = 128, samples_per_cycle: int = 4, noise: float = 3.1):
        self.port, self.channels, self.count = port, list(channels), Count()
        self.samples_per_cycle = samples_per_cycle
        self.cycles = board.cycles(measures, samples_per_cycle)
        self._request = board.send_measures(self.cycles)
        self._size = board.reply_bytes(samples_per_cycle)
        self._noise = noise * np.sqrt(100.0 / self.cycles)
        self.electrode_hz, self.resonance_hz = board.ELECTRODE_HZ, 0.0
        self._phase: Components | None = None
        self._slack: deque[int] = deque(maxlen=200)
        self.asked_ns = self._answered_ns = port.now_ns()
        self._fault, self._is_cut, self._is_tuned = "", False, False
        self._attempt = 0  # an answer to an earlier attempt may arrive late

    # ---- replies

    def ask(self) -> None:
        """Request a measurement."""
        stray = self.port.read(0.0)
        if stray:
            self.count.faults["overrun" if board.OVERRUN in stray else "garbled"] += 1
        self.port.write(self._request)
        self.asked_ns = self.port.now_ns()

    def answer(self) -> tuple[int, Components] | None:
        """The middle of the integration on the port's clock [ns] and the Fourier components (6,) [steps] of the requested
        measurement; None after a fault, and then `recover` must be called first."""
        data = self._read(self._size, self.asked_ns, self._least_s() + PATIENCE_S)
        received_ns = self.port.now_ns()
        components, self._fault = self._judge(data)
        if self._fault:
            self.count.faults[self._fault] += 1
            self._is_cut = True
            return None
        if self._is_cut:
            self.count.longest_s = max(self.count.longest_s, (received_ns - self._answered_ns) * 1e-9)
        self.count.replies += 1
        self._answered_ns, self._is_cut = received_ns, False
        return self._middle_ns(received_ns), components

    def _judge(self, data: bytes) -> tuple[Components, str]:
        """The components of a reply, and its fault, if any."""
        nothing = np.empty(0, complex)
        if board.OVERRUN in data:  # samples are missing as well: the whole reply is invalid
            return nothing, "overrun"
        if len(data) != self._size:
            return nothing, "silent" if not data else "short" if len(data) < self._size else "garbled"
        try:
            reply = board.decode(data)
            components = reply.fourier()[1]
        except PacketError:
            return nothing, "garbled"
        if not reply.is_possible(self.cycles):
            return nothing, "garbled"
        return components, "slip" if self._has_slipped(components) else ""

    def recover(self) -> None:
        """Make the board answer again after a fault. Raises BoardSilent if nothing helps."""
        fault, self._fault = self._fault, ""
        if not fault:
            return
        if fault in ("silent", "slip"):  # a reset board also shows a phase jump: it has another frequency
            self._realign()
        else:
            self._wait_until_quiet(QUIET_S)
        self.count.resyncs += 1

    def _read(self, size: int, since_ns: int, within_s: float) -> bytes:
        """Read `size` bytes and any that come with them; fewer if they do not arrive in time. The text of an overrun does not
        count. Bytes that arrived while the machine did other things are not late."""
        data = b""
        while len(data) < size + (len(board.OVERRUN) if board.OVERRUN in data else 0):
            left_s = within_s - (self.port.now_ns() - since_ns) * 1e-9
            received = self.port.read(max(0.0, left_s))
            if not received:
                break
            data += received
        return data

    def _least_s(self) -> float:
        return board.reply_s(self.cycles, self.electrode_hz, self.samples_per_cycle) + OVERHEAD_S

    def _middle_ns(self, received_ns: int) -> int:
        """The middle of the integration. Half of the minimum slack beyond line and cycles lies before it; any further slack of a
        reply was a delay in this machine or on the line."""
        slack = received_ns - self.asked_ns - round(1e9 * board.reply_s(self.cycles, self.electrode_hz, self.samples_per_cycle))
        self._slack.append(max(0, slack))
        before_s = board.COMMAND_BYTES * board.BYTE_S + 0.5 * self.cycles / self.electrode_hz
        return self.asked_ns + round(1e9 * before_s) + min(self._slack) // 2

    def _has_slipped(self, components: Components) -> bool:
        """Whether all channels have turned relative to earlier replies: samples were lost, and the amplitude is wrong."""
        used = components[self.channels]
        now = used / np.maximum(np.abs(used), 1e-9)
        if self._phase is None:
            self._phase = now
            return False
        along = complex(np.sum(used * self._phase.conj()))
        noise = self._noise * len(used) / max(abs(along), 1e-9)
        if abs(np.angle(along)) > max(TURN, 6.0 * noise):
            self._phase = now
            return True
        self._phase += FOLLOW * (now - self._phase)
        self._phase /= np.maximum(np.abs(self._phase), 1e-9)
        return False

    # ---- frequency

    def tune(self) -> None:
        """Set the excitation to the frequency of maximum amplitude: the board's resonance. If there is none, set the standard
        frequency and resonance_hz to 0. Raises BoardSilent."""
        self._is_tuned = False
        asked = np.arange(SWEEP_HZ[0], SWEEP_HZ[1] + 1.0, SWEEP_HZ[2])
        found = np.array([self._amplitude_at(hz) for hz in asked])
        self.resonance_hz = resonance(asked, found, 6.0 * self._noise)
        self.set_frequency(self.resonance_hz or board.ELECTRODE_HZ)
        self._is_tuned = True

    def _amplitude_at(self, hz: float) -> float:
        """Mean amplitude over the channels [steps]; zero if no reply can be obtained."""
        self.set_frequency(hz)
        for _ in range(3):
            self.ask()
            found = self.answer()
            if found is not None:
                return float(np.abs(found[1][self.channels]).mean())
            self.recover()
        return 0.0

    def set_frequency(self, hz: float) -> None:
        """Set the frequencies of excitation and converter. Raises BoardSilent."""
        command = board.set_frequency(hz, self.samples_per_cycle)
        for _ in range(3):
            self.port.write(command)
            within_s = 2 * board.COMMAND_BYTES * board.BYTE_S + OVERHEAD_S + PATIENCE_S
            answer = self._read(board.COMMAND_BYTES, self.port.now_ns(), within_s)
            self._phase = None
            if len(answer) == board.COMMAND_BYTES:
                taken = Command.unpack(answer)
                if taken.kind == Kind.SET_FREQ_2 and _is_near(taken, hz, self.samples_per_cycle, 0.01):  # by whole ticks
                    self.electrode_hz = taken.electrode_hz
                    return
            self._fault = "silent" if not answer else "garbled"
            self.count.faults[self._fault] += 1
            self.recover()
        raise BoardSilent(
            f"expected a board that accepts {hz:g} Hz, got wrong answers; check whether {self.port.name} is another device"
        )

    # ---- synchronisation with the stream of commands

    def _realign(self) -> None:
        self.port.write(board.COMMAND_BYTES * board.FILLER)
        self._wait_until_quiet(self._least_s() + QUIET_S)
        found = self._probe(PACE_S, PROBE_S)
        for pace_s, patience_s in ((PACE_S, PROBE_S), (LAST_PACE_S, LAST_PACE_S)):
            if found is None:
                self.count.breaks += 1
                self.port.send_break()
                found = self._probe(pace_s, patience_s)
        if found is None:
            raise BoardSilent(
                f"no answer on {self.port.name}, nor after a BREAK; check that it is the board's port, and its power"
            )
        if self._is_tuned and not _is_near(found, self.electrode_hz, self.samples_per_cycle, 1e-6):
            self.count.faults["reset"] += 1
            raise BoardSilent(f"the board on {self.port.name} has lost its frequency: was its power off?")

    def _probe(self, pace_s: float, patience_s: float) -> Command | None:
        """Find where the board's commands begin, align it, and return the frequencies that it reports."""
        data, sent = b"", 0
        self._attempt += 1
        for probe in board.realign_probes(self._attempt):
            self.port.write(probe)
            sent += 1
            data, found = self._await_probe(data, pace_s)
            if found is not None:
                break
        else:
            data, found = self._await_probe(data, patience_s)
        if found is None:
            return None
        number, answer = found
        self.port.write((number - sent) % board.COMMAND_BYTES * board.FILLER)
        return answer

    def _await_probe(self, data: bytes, within_s: float) -> tuple[bytes, tuple[int, Command] | None]:
        """Received bytes appended to `data`, and the answer once it is complete."""
        ends_ns = self.port.now_ns() + round(1e9 * within_s)
        while (found := board.realign_answer(data, self._attempt)) is None and (left_ns := ends_ns - self.port.now_ns()) > 0:
            data += self.port.read(left_ns * 1e-9)
        return data, found

    def _wait_until_quiet(self, quiet_s: float) -> None:
        deadline_ns = self.port.now_ns() + round(1e9 * (self._least_s() + PATIENCE_S))
        while self.port.read(quiet_s) and self.port.now_ns() < deadline_ns:
            quiet_s = QUIET_S


def _is_near(answer: Command, electrode_hz: float, samples_per_cycle: int, tolerance: float) -> bool:
    """Whether a board's answer states these frequencies, up to a relative tolerance."""
    samples_hz = electrode_hz * samples_per_cycle
    return abs(answer.electrode_hz / electrode_hz - 1.0) < tolerance and abs(answer.sample_hz / samples_hz - 1.0) < tolerance


def resonance(hz: Array, amplitude: Array, least: float) -> float:
    """Frequency [Hz] of the maximum of amplitudes (n,) over frequencies (n,); 0 if there is none inside the range.

    Near a resonance 1 / amplitude^2 = a + b f^2 + c / f^2 with its minimum at (c / b)^(1/4): a linear least squares over the
    amplitudes above half of the maximum, weighted by the accuracy of the reciprocal squares. least: amplitudes below it are
    noise.
    """
    top = int(np.argmax(amplitude))
    if not 0 < top < len(hz) - 1 or amplitude[top] < least:
        return 0.0
    near = amplitude > 0.5 * amplitude[top]
    x, y = hz[near] / hz[top], (amplitude[top] / amplitude[near]) ** 2
    if len(x) < 3:
        return float(hz[top])
    weight = y**-1.5
    terms = np.stack([np.ones_like(x), x**2, x**-2], axis=1)
    _, b, c = np.linalg.lstsq(weight[:, None] * terms, weight * y, rcond=None)[0]
    if b <= 0.0 or c <= 0.0:
        return 0.0
    found = float(hz[top] * (c / b) ** 0.25)
    return found if hz[0] < found < hz[-1] else 0.0


@dataclass(frozen=True)
class Row:
    """A measurement of all electrodes. stamp_ns: the middle of the integration, on the ports' clock, averaged over the boards;
    volts (e,) in the order of the pad type; skew_ns: spread of the boards' middles; lag_ns: time from the request to the stamp,
    of which the part on the line is assumed shorter once a reply was faster."""

    stamp_ns: int
    volts: Array
    skew_ns: int
    lag_ns: int = 0

    @property
    def asked_ns(self) -> int:
        """When the measurement was requested."""
        return self.stamp_ns - self.lag_ns


class PadReader:
    """The boards of a pad together. channels: by board, the channels that measure each electrode; electrodes: their order in a
    row; lsb [V]: a step of the converter. An electrode that no board measures reads 0 V, as a dead one does. Raises ValueError
    for an electrode that several boards measure."""

    def __init__(
        self, lines: Sequence[Line], channels: Sequence[Mapping[str, Sequence[int]]], electrodes: Sequence[str], lsb: float
    ):
        self.lines, self._lsb = list(lines), lsb
        self._sources: list[tuple[int, list[int]] | None] = []
        for name in electrodes:
            found = [(k, list(of[name])) for k, of in enumerate(channels) if name in of]
            if len(found) > 1:
                raise ValueError(f"electrode {name}: expected one board that measures it, got {len(found)}; see `boards:`")
            self._sources.append(found[0] if found else None)

    def read(self) -> Row | None:
        """The next row; None if a board failed and was recovered. Raises BoardSilent, OSError for a port that is gone."""
        for line in self.lines:
            line.ask()
        answers = [line.answer() for line in self.lines]
        for line in self.lines:
            line.recover()
        whole = [answer for answer in answers if answer is not None]
        if len(whole) < len(answers):
            return None
        stamps = [stamp_ns for stamp_ns, _ in whole]
        amplitudes = np.abs(np.array([components for _, components in whole]))
        volts = np.array([0.0 if at is None else amplitudes[at[0], at[1]].mean() for at in self._sources]) * self._lsb
        stamp_ns, asked_ns = sum(stamps) // len(stamps), sum(line.asked_ns for line in self.lines) // len(self.lines)
        return Row(stamp_ns, volts, max(stamps) - min(stamps), stamp_ns - asked_ns)


class Batches:
    """Collects evenly spaced rows into batches. A late row ends the batch before it, so no stamp is invented. Rows are as far
    apart as their requests: stamps come nearer to each other where the lag turns out to be less."""

    def __init__(self, length_ns: int = BATCH_NS):
        self._length_ns = length_ns
        self._rows: list[Row] = []
        self.period_ns = 0

    def add(self, row: Row) -> list[tuple[int, int, Array]]:
        """Batches that are complete now, each (stamp of the last row [ns], period [ns], volts (rows, e))."""
        out = []
        if self._rows:
            elapsed_ns = row.asked_ns - self._rows[-1].asked_ns
            usual_ns = self._spacing_ns() or elapsed_ns
            if abs(elapsed_ns - usual_ns) > UNEVEN * usual_ns:
                out += self.flush()
        self._rows.append(row)
        spacing_ns = self._spacing_ns()
        if spacing_ns and row.asked_ns - self._rows[0].asked_ns + spacing_ns >= self._length_ns:
            out += self.flush()
        return out

    def flush(self) -> list[tuple[int, int, Array]]:
        """The collected rows as a batch; empty if there are none. A single row gets the period of the previous batch."""
        rows, self._rows = self._rows, []
        if len(rows) > 1:
            self.period_ns = round((rows[-1].asked_ns - rows[0].asked_ns) / (len(rows) - 1))
        if not rows or not self.period_ns:
            return []
        return [(rows[-1].stamp_ns, self.period_ns, np.array([row.volts for row in rows]))]

    def _spacing_ns(self) -> int:
        """Spacing [ns] of the collected rows; for a single one that of the previous batch."""
        if len(self._rows) < 2:
            return self.period_ns
        return (self._rows[-1].asked_ns - self._rows[0].asked_ns) // (len(self._rows) - 1)
