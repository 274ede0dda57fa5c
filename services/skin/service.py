"""Reads the sensing boards of pads on serial ports and publishes the amplitudes of their electrodes.

Three boards make one pad of five electrodes: give their ports in order with --device, or in the cell file under `boards:` of the
pad. The cell file also says which channels measure which electrode; by default each board measures two electrodes in the order of
the pad type, on channels 0 to 2 and 3 to 5: c and r on the first board, l and t on the second, b on the third.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

from penumbra.services import flags
from penumbra.services.skin.driver import Batches, Line, PadReader
from penumbra.services.skin.port import SerialPort
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import SensingBoard
from penumbra.shared.contract.messages import Voltages
from penumbra.shared.contract.topics import VOLTAGES
from penumbra.shared.runtime.node import Node
from penumbra.shared.skin import board

NAME = "skin"
BACKOFF_S = (0.2, 5.0)
"""Initial and maximum delay [s] before a board is opened again."""
TOLD_EVERY = 20
"""Number of attempts after which a missing board is logged again."""


FLAGS = (
    flags.Option(
        "--device",
        multiple=True,
        metavar="DEVICE",
        show_default="those of the cell file",
        help="a board's serial port; several times for a pad of several boards, in their order",
    ),
    flags.Option("--pad", metavar="NAME", show_default="the cell's first", help="the pad that --device belongs to"),
    flags.Option(
        "--cycles",
        type=int,
        default=128,
        metavar="N",
        help="cycles of the excitation in a reply: 128 give 231 a second, 32 give 298 with twice the noise",
    ),
)
EXAMPLE = "penumbra skin --pad p0 --device /dev/ttyUSB0 --device /dev/ttyUSB1 --device /dev/ttyUSB2"


def start(node: Node, options: flags.Options) -> None:
    """Start one thread per pad, which owns the pad's `Session`: its boards are read together. The health report, in another
    thread, only reads counters."""
    if not 0 < options.cycles <= 60_000:
        raise cells.CellError(f"--cycles: expected 1 to 60000, got {options.cycles}")
    for pad, readers in pads(node.cell, options.device, options.pad).items():
        for reader in readers:
            if not Path(str(reader.port)).exists():
                node.log.warning("no such device yet: it is waited for; is the board plugged in?", pad=pad, port=reader.port)
        session = Session(node, pad, readers, options.cycles)
        node.add_report(pad, session.describe)
        node.add_reasons(session.reasons)
        node.every(BACKOFF_S[0], partial(Session.run, session), math.inf)


def pads(cell: cells.Cell, ports: Sequence[str], pad: str | None) -> dict[str, tuple[SensingBoard, ...]]:
    """The pads to read, each with its boards and their ports. Raises CellError if pads and ports do not match."""
    if not ports:
        named = {name: found for name, found in cell.pads.items() if pad in (None, name) and found.boards}
        if pad is not None:
            cell.one("pads", pad)
        for name, found in named.items():
            if any(reader.port is None for reader in found.boards):
                raise cells.CellError(
                    f"pads.{name}.boards: expected a port of every board; add it, or give --pad {name} --device"
                )
        if not named:
            what = f"pad {pad} of cell {cell.name} has no boards" if pad else f"no pad of cell {cell.name} has boards"
            raise cells.CellError(f"{what}: give --device DEVICE, or `boards:` in the cell file")
        return {name: found.boards for name, found in named.items()}
    if twice := sorted({port for port in ports if ports.count(port) > 1}):
        raise cells.CellError(f"--device: expected a port per board, got {', '.join(twice)} twice")
    name = cell.one("pads", pad)
    kind = cell.pads[name].type
    readers = board.readers(cell.pads[name], cell.pad_types[kind])
    if len(ports) > len(readers):
        needs = "; ".join(", ".join(reader.channels) for reader in readers)
        raise cells.CellError(
            f"pad {name}: expected {len(readers)} ports, one per board ({needs}), got {len(ports)}; give --device for each, in "
            "this order, or change `boards:` of the pad in the cell file"
        )
    return {name: tuple(reader.model_copy(update={"port": port}) for reader, port in zip(readers, ports, strict=False))}


class Session:
    """Reads one pad from opening its boards until they are lost, repeatedly."""

    def __init__(self, node: Node, pad: str, readers: tuple[SensingBoard, ...], cycles: int):
        self._node, self._pad, self._readers, self._cycles = node, pad, readers, cycles
        self._kind = node.cell.pad_types[node.cell.pads[pad].type]
        self._lsb = self._kind.chain.adc_reference / board.FULL_SCALE
        self._lines: list[Line] = []
        self._batches = Batches()
        self._skew_ns = 0
        self._state = "starting"
        self._opened = 0
        self._delay_s, self._failures = BACKOFF_S[0], 0
        read = {name for reader in readers for name in reader.channels}
        if missing := [name for name in self._kind.electrodes if name not in read]:
            why = "these electrodes have no board: they read 0 V, as dead ones do"
            node.log.warning(why, pad=pad, electrodes=", ".join(missing))
        try:
            self._reader()
        except ValueError as error:
            raise cells.CellError(f"pad {pad}: {error}") from None

    def run(self) -> None:
        """Read until the node stops, or until the boards are gone; then wait and return, to be called again."""
        with ExitStack() as stack:
            try:
                reader = self._open(stack)
                while not self._node.stopping.is_set():
                    row = reader.read()
                    for batch in self._batches.flush() if row is None else self._batches.add(row):
                        self._publish(*batch)
                    self._skew_ns = row.skew_ns if row else self._skew_ns
            except OSError as error:
                self._lost(error)
        self._node.stopping.wait(self._delay_s)

    def _open(self, stack: ExitStack) -> PadReader:
        self._lines = []
        for reader in self._readers:
            port = SerialPort(str(reader.port))
            stack.callback(_close, port)
            used = [channel for chosen in reader.channels.values() for channel in chosen]
            noise = float(self._kind.rest.noise) ** 0.5 / self._lsb
            line = Line(port, used, self._cycles, noise=noise)
            line.tune()
            if not line.resonance_hz:
                why = f"no resonance between 80 and 115 kHz: {line.electrode_hz:g} Hz is used; is the pad connected?"
                self._node.log.warning(why, pad=self._pad, port=port.name)
            self._lines.append(line)
        self._batches = Batches()
        self._opened += 1
        self._state = "reading"
        frequencies = ", ".join(f"{1e-3 * line.electrode_hz:.2f}" for line in self._lines)
        self._node.log.info("reading", pad=self._pad, boards=len(self._lines), kHz=frequencies)
        return self._reader()

    def _reader(self) -> PadReader:
        return PadReader(self._lines, [reader.channels for reader in self._readers], list(self._kind.electrodes), self._lsb)

    def _lost(self, error: OSError) -> None:
        if not self._failures % TOLD_EVERY:
            self._node.log.error(f"{error}; trying again", pad=self._pad)
        self._state = str(error)
        self._delay_s = min(BACKOFF_S[0] * 2.0**self._failures, BACKOFF_S[1])
        self._failures += 1

    def _publish(self, stamp_ns: int, period_ns: int, volts: Any) -> None:
        stamp_ns += self._node.now_ns() - self._lines[0].port.now_ns()
        message = Voltages(stamp_ns=stamp_ns, period_ns=period_ns, volts=volts.astype("float32"))
        self._node.publish(VOLTAGES, message, pad=self._pad)
        self._failures = 0

    def reasons(self) -> list[str]:
        """Why no voltages are published."""
        return [] if self._state in ("starting", "reading") else [f"pad {self._pad}: {self._state}"]

    def describe(self) -> dict[str, Any]:
        """The pad's entry in the health report: rate and skew, and each board's resonance and line statistics."""
        return {
            "state": self._state,
            "opened": self._opened,
            "rate_hz": round(1e9 / self._batches.period_ns, 1) if self._batches.period_ns else None,
            "skew_us": round(1e-3 * self._skew_ns, 1),
            "boards": [
                {
                    "port": line.port.name,
                    "resonance_hz": round(line.resonance_hz, 1) or None,
                    "electrode_hz": round(line.electrode_hz, 1),
                    "replies": line.count.replies,
                    "faults": dict(line.count.faults),
                    "resyncs": line.count.resyncs,
                    "breaks": line.count.breaks,
                    "longest_gap_ms": round(1e3 * line.count.longest_s, 1),
                }
                for line in list(self._lines)
            ],
        }


def _close(port: SerialPort) -> None:
    with suppress(OSError):
        port.close()
