"""The pads' sensing boards on pseudo-terminals: a driver talks to them as to real ones.

They run in a separate process: a board answers within a tenth of a millisecond, while the emulator may be rendering. The emulator
sends it the skin's signals of the next moments, tick by tick.

A pseudo-terminal has no line that can be held low, so it transmits no BREAK. It does transmit that the driver flushes its output
queue, which a driver does before a BREAK: the flush stands for the BREAK.
"""

from __future__ import annotations

import errno
import fcntl
import multiprocessing
import os
import select
import signal
import struct
import termios
import threading
import time
import tty
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from penumbra.shared.cell import description as cells
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin import board
from penumbra.shared.skin.layout import Skin
from penumbra.sim.skin.board import FAULTS, Board, Tank
from penumbra.sim.skin.faults import SkinFaults

if TYPE_CHECKING:
    from penumbra.sim.world.world import World

IDLE_S = 0.05
"""Time [s] that the boards wait for bytes before they check whether they are to end."""
TOLERANCE = 0.01
"""Relative standard deviation of the coils' inductance: every board has its own resonance."""
CHUNK = 4096
"""Maximum number of bytes read at once."""
PATIENCE_S = 30.0
"""Maximum time [s] for the boards' process to start."""


class Feed:
    """The skin's signals at any time, interpolated between instants `tick_s` apart."""

    def __init__(self, skin: Skin, tick_s: float):
        self._skin, self._tick_s = skin, tick_s
        self._logs: dict[int, Array] = {}
        self._faults = SkinFaults(skin)

    def take(self, k: int, log_change: Array, faults: SkinFaults) -> None:
        """Add the logs of the changes (n,) [fF] at tick k, and the faults in force."""
        self._logs = {tick: logs for tick, logs in self._logs.items() if tick > k - 50} | {k: log_change}
        self._faults = faults

    def amplitude(self, pad: int, time_s: float) -> Array:
        """Amplitudes (e,) [V] of one pad without noise, at rest until the first `take`. Between ticks logs are interpolated;
        after the last tick its signals persist."""
        own, change = self._skin.of(pad), np.zeros(len(self._skin))
        if self._logs:
            k, part = divmod(time_s / self._tick_s, 1.0)
            newest = max(self._logs)
            before = self._logs.get(int(k), self._logs[newest])
            change = np.exp((1.0 - part) * before + part * self._logs.get(int(k) + 1, before))
        return self._faults.apply(pad, [time_s], self._skin.amplitude(change)[None, own])[0]


class Terminals:
    """Pseudo-terminals of boards. boards: by name; time_s: their clock. devices: the paths of the pseudo-terminals by name."""

    def __init__(self, boards: Mapping[str, Board], time_s: Callable[[], float]):
        self.boards, self.devices = dict(boards), dict[str, str]()
        self._names: dict[int, str] = {}  # by our end's file descriptor
        self._slaves: list[int] = []  # kept open: a driver may close its end and another one open it
        self._time_s = time_s
        for name in boards:
            master, slave = os.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            fcntl.ioctl(master, termios.TIOCPKT, struct.pack("i", 1))  # reports when the other end empties its queue
            self.devices[name], self._names[master] = os.ttyname(slave), name
            self._slaves.append(slave)

    def turn(self, other: Sequence[int] = ()) -> None:
        """Wait for bytes from the devices, for a board's due answer, or for file descriptors `other`, at most IDLE_S; then
        transfer bytes both ways."""
        due_s = min(emulated.next_s() for emulated in self.boards.values())
        wait_s = min(max(0.0, due_s - self._time_s()), IDLE_S)
        ready = select.select([*self._names, *other], [], [], wait_s)[0]
        for master in set(ready) & set(self._names):
            self._receive(master, self.boards[self._names[master]])
        for master, name in self._names.items():
            packet = self.boards[name].send(self._time_s())
            if packet:
                with suppress(BlockingIOError):  # no reader: without flow control the bytes are lost
                    os.write(master, packet)

    def close(self) -> None:
        """Close the devices."""
        for fd in (*self._names, *self._slaves):
            os.close(fd)
        self._names, self._slaves = {}, []

    def _receive(self, master: int, emulated: Board) -> None:
        """Handle a packet of a pseudo-terminal in packet mode: its kind in one byte, then data."""
        try:
            packet = os.read(master, CHUNK)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EIO):
                raise
            return
        if packet[:1] == b"\0":  # TIOCPKT_DATA
            emulated.receive(packet[1:], self._time_s())
        elif packet and packet[0] & termios.TIOCPKT_FLUSHWRITE:
            emulated.receive_break(self._time_s())


def pad_boards(cell: cells.Cell, pads: Sequence[str], seed: int, feed: Feed) -> dict[str, Board]:
    """The boards of pads as in the cell file, each with its own coil: p0-0, p0-1 and so on."""
    out = {}
    for pad in pads:
        place = list(cell.pads).index(pad)
        kind = cell.pad_types[cell.pads[pad].type]
        for number, reader in enumerate(board.readers(cell.pads[pad], kind)):
            electrode_of = np.full(board.CHANNELS, -1)
            for k, channels in enumerate(reader.channels.values()):
                electrode_of[list(channels)] = k
            own = [list(kind.electrodes).index(name) for name in reader.channels]
            board_seed = 1000 * seed + 10 * place + number
            coil = Tank().coil * (1.0 + TOLERANCE * np.random.default_rng([board_seed, 8]).standard_normal())
            out[f"{pad}-{number}"] = Board(
                partial(_chosen, feed, place, own),
                electrode_of.tolist(),
                board_seed,
                kind.rest.noise,
                kind.chain.adc_reference,
                Tank(coil=coil),
            )
    return out


def _chosen(feed: Feed, pad: int, own: list[int], time_s: float) -> Array:
    return feed.amplitude(pad, time_s)[own]


def _serve(link: Connection, cell: cells.Cell, pads: Sequence[str], seed: int, began_ns: int, tick_s: float) -> None:
    """Run the boards' process until the emulator closes its end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the emulator handles Ctrl-C
    feed = Feed(Skin(cell), tick_s)
    terminals = Terminals(pad_boards(cell, pads, seed, feed), lambda: (time.monotonic_ns() - began_ns) * 1e-9)
    link.send(terminals.devices)
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            terminals.turn([link.fileno()])
            while link.poll():
                message = link.recv()
                if isinstance(message, tuple):
                    feed.take(*message)
                else:
                    name, _, fault = message.partition(" ")
                    terminals.boards[name].fault(fault)
    terminals.close()


class SerialBoards:
    """The emulator's end. pads: whose boards are served; folder: of the links to their devices; began_ns: time zero of the world
    by the steady clock; tick_s: period at which the boards receive the skin's signals; ahead_s: how long in advance.

    devices: the paths of the pseudo-terminals by name, such as p0-2 for the third board of pad p0. Raises CellError for an
    unknown pad, OSError if a link cannot be made.
    """

    def __init__(self, world: World, pads: Sequence[str], folder: Path | None, began_ns: int, tick_s: float, ahead_s: float):
        self._world, self._began_ns, self._tick_s, self._ahead_s = world, began_ns, tick_s, ahead_s
        self.pads = tuple(world.cell.one("pads", pad) for pad in pads)
        self._link, theirs = multiprocessing.Pipe()
        self._lock = threading.Lock()
        arguments = (theirs, world.cell, self.pads, world.seed, began_ns, tick_s)
        # Not a fork: it would inherit the threads' locks, but not the threads.
        self._process = multiprocessing.get_context("spawn").Process(target=_serve, args=arguments, daemon=True)
        self._process.start()
        theirs.close()
        if not self._link.poll(PATIENCE_S):
            raise OSError(f"the boards' process did not start within {PATIENCE_S:g} s")
        self.devices: dict[str, str] = self._link.recv()
        self._links = _linked(self.devices, folder) if folder is not None else []
        self._sent = -1

    def fault(self, words: str) -> None:
        """`PAD-NUMBER FAULT`: cause a fault on a board's line. Raises ValueError that says what is possible."""
        name, _, kind = words.partition(" ")
        if name not in self.devices or kind not in FAULTS:
            possible = f"one of {', '.join(self.devices)} and one of {', '.join(FAULTS)}"
            raise ValueError(f"board: expected a board and its fault, {possible}, got {words!r}")
        self._send(words)

    def serve(self, stopping: threading.Event) -> None:
        """Send the skin's signals to the boards until the emulator stops."""
        try:
            while not stopping.wait(self._tick_s):
                now_s = (time.monotonic_ns() - self._began_ns) * 1e-9
                for k in range(max(self._sent + 1, int(now_s / self._tick_s)), int((now_s + self._ahead_s) / self._tick_s) + 1):
                    log_change = np.log(self._world.change(self._world.state(k * self._tick_s)))
                    self._send((k, log_change, self._world.skin_faults))
                    self._sent = k
        finally:
            self.close()

    def close(self) -> None:
        """End the boards' process and remove the links to its devices."""
        self._link.close()
        for link in self._links:
            link.unlink(missing_ok=True)
        self._process.join(1.0)

    def _send(self, message: object) -> None:
        with self._lock:
            self._link.send(message)


def _linked(devices: Mapping[str, str], folder: Path) -> list[Path]:
    """Make links to the devices, with their names; those of an earlier emulator are replaced."""
    folder.mkdir(parents=True, exist_ok=True)
    links = [folder / name for name in devices]
    for link, device in zip(links, devices.values(), strict=True):
        if link.is_symlink():
            link.unlink()
        link.symlink_to(device)
    return links
