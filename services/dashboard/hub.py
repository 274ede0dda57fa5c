"""Queues of messages to the browsers: one slot per stream and page; the next message is sent only after the page has shown the
last one.

Everything here belongs to the thread of the server's event loop, except `Hub.wanted`, which is replaced as a whole and may be
read from any thread.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

PICTURE, MOMENT, SLOW = "picture", "moment", "slow"
STREAMS = (MOMENT, PICTURE, SLOW)
"""Streams of a page, in the order in which they are sent: pose and scene, the camera's picture, processes and rates."""
MOST_PAGES = 16
"""Maximum number of pages that are open at the same time."""


@dataclass(frozen=True)
class Wanted:
    """What the open pages can receive now. pages: their number; moment: whether one of them has shown its last moment; cameras:
    those that a page looks at; ready: those of them for which a page has shown its last picture."""

    pages: int = 0
    moment: bool = False
    cameras: frozenset[str] = frozenset()
    ready: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Offer:
    """A message for the pages. payload: encoded once for all pages; camera: for a picture, its camera."""

    stream: str
    payload: bytes
    camera: str = ""


class Page:
    """One open page, with its waiting messages and its credit. camera: the one that it looks at, empty for none."""

    def __init__(self, camera: str = ""):
        self.camera = camera
        self._slots: dict[str, bytes] = {}
        self._credit = set(STREAMS)
        self._changed = asyncio.Event()

    def offer(self, stream: str, payload: bytes) -> None:
        """Put a message into its slot, replacing one that was not sent yet."""
        self._slots[stream] = payload
        self._changed.set()

    def shown(self, stream: str) -> None:
        """Record that the page has shown the last message of a stream. Raises ValueError for an unknown stream."""
        if stream not in STREAMS:
            raise ValueError(f"expected one of {', '.join(STREAMS)}, got {stream!r:.40}")
        self._credit.add(stream)
        self._changed.set()

    def has_credit(self, stream: str) -> bool:
        """Whether the page has shown the last message of a stream."""
        return stream in self._credit

    async def next(self) -> tuple[str, bytes]:
        """Wait for the next message that the page can receive; returns its stream and payload."""
        while True:
            for stream in STREAMS:
                if stream in self._slots and stream in self._credit:
                    self._credit.discard(stream)
                    return stream, self._slots.pop(stream)
            self._changed.clear()
            await self._changed.wait()


class Hub:
    """All open pages."""

    def __init__(self) -> None:
        self._pages: list[Page] = []
        self.wanted = Wanted()

    @property
    def is_full(self) -> bool:
        """Whether the maximum number of pages is open."""
        return len(self._pages) >= MOST_PAGES

    def open(self, page: Page) -> None:
        """Add a page."""
        self._pages.append(page)
        self.look()

    def close(self, page: Page) -> None:
        """Remove a page and its waiting messages."""
        self._pages.remove(page)
        self.look()

    def offer(self, *offers: Offer) -> None:
        """Offer messages to every page, pictures to the pages that look at their camera."""
        for offer in offers:
            for page in self._pages:
                if offer.stream != PICTURE or page.camera == offer.camera:
                    page.offer(offer.stream, offer.payload)

    def look(self) -> None:
        """Update `wanted`."""
        cameras = frozenset(page.camera for page in self._pages if page.camera)
        ready = frozenset(page.camera for page in self._pages if page.camera and page.has_credit(PICTURE))
        self.wanted = Wanted(len(self._pages), any(page.has_credit(MOMENT) for page in self._pages), cameras, ready)
