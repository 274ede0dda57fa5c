"""The client for `async` programs: `aconnect`, its cell and its poses. Only this module imports asyncio."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

import zenoh

from penumbra.client.cell import CellBase
from penumbra.client.connect import PATIENCE_S, Search
from penumbra.client.pose import Pose
from penumbra.client.poses import Subscription
from penumbra.shared.contract import topics
from penumbra.shared.contract.outline import Outline
from penumbra.shared.runtime import bus, running


class AsyncPoses(Subscription):
    """As `Poses`, for `async for`. One task at a time."""

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Pose:
        loop = asyncio.get_running_loop()
        await asyncio.sleep(0)  # lets other tasks run even if a pose is always ready
        try:
            async with asyncio.timeout(self._timeout):
                while True:
                    changed = asyncio.Event()
                    sample = self._slot.take(partial(_call, loop, changed.set))
                    if sample is not None:
                        if (pose := self._pose_of(sample)) is not None:
                            return pose
                    elif self._slot.is_closed:
                        raise StopAsyncIteration
                    else:
                        await changed.wait()
        except TimeoutError:
            raise await asyncio.to_thread(self._silence) from None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class AsyncCell(CellBase):
    """A running cell, as returned by `penumbra.aconnect`, for one event loop. Members that are not listed are as in `Cell`:
    names, and sensors, whose publishing does not block."""

    def poses(self, target: str | None = None, *, timeout: float | None = None) -> AsyncPoses:
        """As `Cell.poses`, for `async for`."""
        name = self._target(target)
        with self._reading():
            return AsyncPoses(self._session, topics.FUSED.at(cell=self.name, target=name), timeout, self._why_silent)

    async def pose(self, *, at: int | None = None, target: str | None = None, timeout: float = 1.0) -> Pose:
        """As `Cell.pose`."""
        return await asyncio.to_thread(self._ask_pose, at, target, timeout)

    async def health(self) -> tuple[running.Instance, ...]:
        """As `Cell.health`."""
        return await asyncio.to_thread(self._ask_health)

    async def close(self) -> None:
        """As `Cell.close`."""
        await asyncio.to_thread(self._leave)


@asynccontextmanager
async def aconnect(
    cell: str | Path | None = None,
    *,
    endpoint: str | None = None,
    secure: str | Path | None = None,
    timeout: float = PATIENCE_S,
) -> AsyncIterator[AsyncCell]:
    """As `connect`, for `async with`."""
    search = Search.of(cell, endpoint, secure, timeout)
    searching = asyncio.get_running_loop().run_in_executor(None, search.run)
    try:
        found = AsyncCell(*await asyncio.shield(searching))
    except asyncio.CancelledError:
        search.stopping.set()
        searching.add_done_callback(_discard)
        raise
    try:
        yield found
    finally:
        await found.close()


def _discard(searched: asyncio.Future[tuple[zenoh.Session, bus.Connection, Outline]]) -> None:
    if searched.exception() is None:
        searched.result()[0].close()


def _call(loop: asyncio.AbstractEventLoop, function: Callable[[], object]) -> None:
    with contextlib.suppress(RuntimeError):  # the loop is closed: no task waits any more
        loop.call_soon_threadsafe(function)
