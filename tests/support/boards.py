"""An emulated board on a port with a clock of its own: the driver's actions take as long as on the real line."""

from __future__ import annotations

import numpy as np

from penumbra.shared.skin import board
from penumbra.sim.skin.board import Board


class SimulatedPort:
    """A port whose clock advances only when somebody waits, so that nothing depends on the machine's speed. `deaf`: the board
    receives nothing until a BREAK; `dead`: nor after it."""

    def __init__(self, device: Board, clock: list[float], name: str = "simulated"):
        self.device, self.name, self._clock = device, name, clock
        self.deaf = self.dead = False
        self._came = b""

    def now_ns(self) -> int:
        return round(self._clock[0] * 1e9)

    def write(self, data: bytes) -> None:
        if not self.deaf and not self.dead:
            self.device.receive(data, self._clock[0])

    def read(self, timeout_s: float) -> bytes:
        deadline = self._clock[0] + timeout_s
        while True:
            self._came += self.device.send(self._clock[0])
            due = self.device.next_s()
            if self._came or due > deadline:
                break
            self._clock[0] = max(self._clock[0], due)
        if not self._came:
            self._clock[0] = deadline
        out, self._came = self._came, b""
        return out

    def send_break(self) -> None:
        self.deaf = False
        self._clock[0] += 1e-3
        self.device.receive_break(self._clock[0])
        self._came = b""

    def close(self) -> None:
        pass


def ask(device: Board, clock: list[float], command: bytes) -> bytes:
    """All bytes that a board sends after a command."""
    device.receive(command, clock[0])
    out = b""
    while (due := device.next_s()) < np.inf:
        clock[0] = due
        out += device.send(due)
    return out


def amplitudes(packet: bytes) -> np.ndarray:
    """Amplitudes (6,) [V] of the channels in a reply."""
    return np.abs(board.decode(packet).fourier()[1]) * 3.3 / board.FULL_SCALE
