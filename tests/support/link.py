"""A link that can be cut: `python -m penumbra.tests.support.link LISTEN TARGET` passes TCP bytes on between ports of loopback.

On standard input: `cut PORT...` stops the bytes of the callers that have these ports, and of all later callers; `mend` lets all
pass again, those held back first, as when a cable is plugged in again. No side is notified: a cut link is silent.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys

HOST = "127.0.0.1"
CHUNK = 1 << 16


class Link:
    """Passes the bytes of its callers on; each caller has a gate that is open or shut."""

    def __init__(self, target: int):
        self._target = target
        self._gates: dict[int, asyncio.Event] = {}
        self._is_cut = False
        self._calls: set[asyncio.Task] = set()

    async def call(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Carries one caller's bytes until one side leaves."""
        port = writer.get_extra_info("peername")[1]
        gate = self._gates[port] = asyncio.Event()
        if not self._is_cut:
            gate.set()
        try:
            await gate.wait()
            far_reader, far_writer = await asyncio.open_connection(HOST, self._target)
            pumps = [self._pump(gate, reader, far_writer), self._pump(gate, far_reader, writer)]
            await asyncio.gather(*pumps, return_exceptions=True)
        except OSError:  # nobody there: the end of its connection notifies the caller
            pass
        finally:
            del self._gates[port]
            writer.close()

    async def _pump(self, gate: asyncio.Event, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(CHUNK):
                await gate.wait()
                writer.write(data)
                await writer.drain()
        finally:
            await gate.wait()
            with contextlib.suppress(OSError):
                writer.close()

    def command(self, words: list[str]) -> None:
        """Carries out `cut PORT...` or `mend`."""
        self._is_cut = words[0] == "cut"
        for port, gate in self._gates.items():
            if not self._is_cut:
                gate.set()
            elif str(port) in words[1:]:
                gate.clear()


async def serve(listen: int, target: int) -> None:
    """Serves until standard input ends."""
    link = Link(target)
    server = await asyncio.start_server(link.call, HOST, listen)
    loop = asyncio.get_running_loop()
    print("ready", flush=True)
    async with server:
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            link.command(line.split())
            print("done", flush=True)


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1]), int(sys.argv[2])))
