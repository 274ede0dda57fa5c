"""A controller of Universal Robots as a client of RTDE sees it: `python -m penumbra.tests.support.rtde_peer ADDRESS`.

It speaks version 2 of the published protocol on port 30004 ("Real-Time Data Exchange (RTDE) Guide" of Universal Robots): version
of protocol and controller, a recipe of outputs, start, pause, and data packages. A process of its own, because the client holds
Python's lock while it waits for answers. It takes commands on standard input: `freeze` and `thaw` its data, `move ANGLE` its
base.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
import threading
import time

PORT = 30004
HZ = 125
VERSION, CONTROLLER, OUTPUTS, INPUTS, START, PAUSE, DATA = 86, 118, 79, 73, 83, 80, 85
TYPES = {"timestamp": "DOUBLE", "actual_q": "VECTOR6D", "robot_status_bits": "UINT32", "runtime_state": "UINT32"}
FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "UINT32": "I", "INT32": "i", "UINT64": "Q", "VECTOR6INT32": "6i", "VECTOR3D": "3d"}
JOINTS = [0.1, -1.2, 1.3, -0.4, 0.5, -0.6]
UPTIME_S = 1234.5
"""Time [s] of the controller's clock when the peer starts."""


class Peer:
    """The state of one controller."""

    def __init__(self) -> None:
        self.began = time.monotonic()
        self.joints = list(JOINTS)
        self.is_frozen = False

    def serve(self, address: str) -> None:
        """Answers every client, one thread each."""
        with socket.create_server((address, PORT)) as server:
            print("listening", flush=True)
            while True:
                client, _ = server.accept()
                threading.Thread(target=self._answer, args=(client,), daemon=True).start()

    def _answer(self, client: socket.socket) -> None:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        names: list[str] = []
        period_s = 1.0 / HZ
        sending = threading.Event()
        with client, contextlib.suppress(OSError, struct.error):
            while True:
                kind, payload = _receive(client)
                if kind == VERSION:
                    _send(client, kind, b"\x01" if struct.unpack(">H", payload) == (2,) else b"\x00")
                elif kind == CONTROLLER:
                    _send(client, kind, struct.pack(">4I", 5, 11, 1, 108318))
                elif kind == OUTPUTS:
                    period_s = 1.0 / struct.unpack(">d", payload[:8])[0]
                    names = payload[8:].decode().rstrip(",").split(",")  # ur_rtde ends its list with a comma
                    types = [TYPES.get(name, "NOT_FOUND") for name in names]
                    _send(client, kind, b"\x01" + ",".join(types).encode())
                elif kind == START:
                    _send(client, kind, b"\x01")
                    if not sending.is_set():
                        sending.set()
                        threading.Thread(target=self._stream, args=(client, names, period_s, sending), daemon=True).start()
                elif kind == PAUSE:
                    sending.clear()
                    _send(client, kind, b"\x01")
                else:
                    _send(client, kind, b"\x00")

    def _stream(self, client: socket.socket, names: list[str], period_s: float, sending: threading.Event) -> None:
        with contextlib.suppress(OSError):
            while sending.is_set():
                time.sleep(period_s)
                if not self.is_frozen:
                    _send(client, DATA, b"\x01" + b"".join(self._value(name) for name in names))

    def _value(self, name: str) -> bytes:
        values: dict[str, list[float]] = {
            "timestamp": [UPTIME_S + time.monotonic() - self.began],
            "actual_q": self.joints,
            "robot_status_bits": [3],
        }
        return struct.pack(">" + FORMATS[TYPES[name]], *values.get(name, [1]))


def _send(client: socket.socket, kind: int, payload: bytes) -> None:
    client.sendall(struct.pack(">HB", 3 + len(payload), kind) + payload)


def _receive(client: socket.socket) -> tuple[int, bytes]:
    size, kind = struct.unpack(">HB", _exactly(client, 3))
    return kind, _exactly(client, size - 3)


def _exactly(client: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        if not (part := client.recv(count - len(data))):
            raise OSError("closed")
        data += part
    return data


def main() -> None:
    peer = Peer()
    threading.Thread(target=peer.serve, args=(sys.argv[1],), daemon=True).start()
    for line in sys.stdin:
        match line.split():
            case ["freeze"]:
                peer.is_frozen = True
            case ["thaw"]:
                peer.is_frozen = False
            case ["move", angle]:
                peer.joints[0] = float(angle)


if __name__ == "__main__":
    main()
