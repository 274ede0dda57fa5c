"""What delivers the pictures of a camera: the classes of `live.py`, `files.py` and the user's own (`adapter.py`)."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, Protocol, cast

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Stamps = Literal["", "exposure", "sender", "stream", "arrival", "playback"]
STAMPS: dict[Stamps, str] = {
    "": "not known yet",
    "exposure": "the middle of the exposure, as the driver says",
    "sender": "the exposure by the camera's own clock, which is synchronised",
    "stream": "the stream's clock, set by its quickest pictures, less the latency",
    "arrival": "the arrival, less the latency",
    "playback": "when it was played",
}
"""How the stamps of pictures are known, in words."""
WITHOUT_LATENCY: tuple[Stamps, ...] = ("stream", "arrival")
"""Stamps that are late by a latency which nothing measures."""


class Shot(NamedTuple):
    """A picture, RGB (height, width, 3), and the time of its exposure [ns since the epoch]; None where that is not known."""

    image: Image
    stamp_ns: int | None


def rgb(image: Any) -> Image:
    """The picture that OpenCV delivers, with its colours in our order."""
    return cast(Image, cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


class Feed(Protocol):
    """An open camera, stream or film. stamps: how the stamps of its last picture are known."""

    @property
    def stamps(self) -> Stamps: ...

    def read(self) -> Shot | None:
        """The next picture, waited for; None where none came within a time of its choice, a few seconds at most.

        Raises OSError where the camera is lost, ValueError for a picture that cannot be used, EOFError at the end of a film.
        """

    def close(self) -> None:
        """Gives the camera back."""
