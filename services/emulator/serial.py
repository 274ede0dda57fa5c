"""The pads' sensing boards on pseudo-terminals: a driver talks to them as to the real ones.

A pseudo-terminal has no line that could be held low, so no BREAK passes through it. What passes is that the driver empties its
output queue, which a driver does before a BREAK: that stands for one here.
"""

from __future__ import annotations

import errno
import fcntl
import os
import select
import struct
import termios
import threading
import tty
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from shared import board
from shared.geometry import Array
from sim.board import Board, Tank
from sim.world import TICK_NS, World

IDLE_S = 0.05
"""How long the boards wait for bytes before they look whether the emulator ends."""
TOLERANCE = 0.01
"""Of the coils' inductance, as a standard deviation: every board has its own resonance."""
CHUNK = 4096


class Amplitudes:
    """Noise-free amplitudes of all electrodes at any time, from the world at every tick of the skin."""

    def __init__(self, world: World):
        self._world = world
        self._ticks: dict[int, Array] = {}

    def at(self, time_s: float) -> Array:
        """(n,) [V] at a time >= 0, in the order of `shared.skin.Skin`; between ticks the logs of the changes are interpolated."""
        assert self._world.skin is not None
        k, part = divmod(time_s, TICK_NS * 1e-9)
        part /= TICK_NS * 1e-9
        logs = (1.0 - part) * self._log_change(int(k)) + part * self._log_change(int(k) + 1)
        return self._world.skin.skin.amplitude(np.exp(logs))

    def of_pad(self, pad: int, time_s: float) -> Array:
        """(e,) [V] of one pad, with the faults in force on it."""
        world = self._world
        assert world.skin is not None and world.skin_faults is not None
        return world.skin_faults.apply(pad, [time_s], self.at(time_s)[None, world.skin.skin.of(pad)])[0]

    def _log_change(self, k: int) -> Array:
        found = self._ticks.get(k)
        if found is None:
            found = np.log(self._world.change(self._world.state(k * TICK_NS * 1e-9)))
            self._ticks = {tick: logs for tick, logs in self._ticks.items() if tick >= k - 2} | {k: found}
        return found


class SerialBoards:
    """boards: by name; folder: where links to their devices are made, with these names; time_s: the boards' clock.

    devices: the paths of the pseudo-terminals by name. Raises OSError where a link cannot be made.
    """

    def __init__(self, boards: Mapping[str, Board], folder: Path | None, time_s: Callable[[], float]):
        self.boards, self.devices = dict(boards), dict[str, str]()
        self._names: dict[int, str] = {}  # by the file descriptor of the emulator's end
        self._slaves: list[int] = []  # kept open: what a driver closes stays there for the next one
        self._folder, self._time_s = folder, time_s
        for name in boards:
            self._add(name)

    def _add(self, name: str) -> None:
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        fcntl.ioctl(master, termios.TIOCPKT, struct.pack("i", 1))  # tells when the other end empties its queue
        self.devices[name], self._names[master] = os.ttyname(slave), name
        self._slaves.append(slave)
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            link = self._folder / name
            if link.is_symlink():
                link.unlink()
            link.symlink_to(self.devices[name])

    def serve(self, stopping: threading.Event) -> None:
        """Carries bytes between the boards and their devices until the emulator stops."""
        try:
            while not stopping.is_set():
                self._turn()
        finally:
            self.close()

    def close(self) -> None:
        """Ends the devices and removes their links."""
        for fd in (*self._names, *self._slaves):
            os.close(fd)
        self._names, self._slaves = {}, []
        if self._folder is not None:
            for name in self.devices:
                (self._folder / name).unlink(missing_ok=True)

    def _turn(self) -> None:
        due_s = min(emulated.next_s() for emulated in self.boards.values())
        wait_s = min(max(0.0, due_s - self._time_s()), IDLE_S)
        for master in select.select(list(self._names), [], [], wait_s)[0]:
            self._receive(master, self.boards[self._names[master]])
        for master, name in self._names.items():
            packet = self.boards[name].send(self._time_s())
            if packet:
                with suppress(BlockingIOError):  # nobody reads: on a line without flow control the bytes are lost
                    os.write(master, packet)

    def _receive(self, master: int, emulated: Board) -> None:
        data = _read(master)
        if data[:1] and data[0] & termios.TIOCPKT_FLUSHWRITE:
            while _read(master):
                pass  # what was under way is lost with the BREAK
            emulated.receive_break(self._time_s())
        elif data[:1] == b"\0":  # TIOCPKT_DATA
            emulated.receive(data[1:], self._time_s())


def _read(master: int) -> bytes:
    """The next packet of a pseudo-terminal in packet mode: its kind in one byte, then data; nothing where there is none."""
    try:
        return os.read(master, CHUNK)
    except OSError as error:
        if error.errno not in (errno.EAGAIN, errno.EIO):
            raise
        return b""


def pad_boards(world: World, pads: Sequence[str]) -> dict[str, Board]:
    """The boards of pads as the cell file has them, each with a coil of its own: p0-0, p0-1 and so on. Raises CellError for an
    unknown pad."""
    cell, amplitudes, out = world.cell, Amplitudes(world), {}
    for pad in pads:
        place = list(cell.pads).index(cell.one("pads", pad))
        kind = cell.pad_types[cell.pads[pad].type]
        for number, reader in enumerate(board.readers(cell.pads[pad], kind)):
            electrode_of = np.full(board.CHANNELS, -1)
            for k, channels in enumerate(reader.channels.values()):
                electrode_of[list(channels)] = k
            own = [list(kind.electrodes).index(name) for name in reader.channels]
            seed = 1000 * world.seed + 10 * place + number
            coil = Tank().coil * (1.0 + TOLERANCE * np.random.default_rng([seed, 8]).standard_normal())
            out[f"{pad}-{number}"] = Board(
                partial(_chosen, amplitudes, place, own),
                electrode_of.tolist(),
                seed,
                kind.rest.noise,
                kind.chain.adc_reference,
                Tank(coil=coil),
            )
    return out


def _chosen(amplitudes: Amplitudes, pad: int, own: list[int], time_s: float) -> Array:
    return amplitudes.of_pad(pad, time_s)[own]
