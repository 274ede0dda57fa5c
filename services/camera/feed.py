"""Interface of a picture source, implemented by the classes of `live.py`, `files.py` and the user's own (`adapter.py`)."""

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
"""Description of each kind of stamp, in words."""
WITHOUT_LATENCY: tuple[Stamps, ...] = ("stream", "arrival")
"""Stamps that are late by an unmeasured latency."""


class Shot(NamedTuple):
    """A picture, RGB (height, width, 3), and its time of exposure [ns since the epoch], None if unknown."""

    image: Image
    stamp_ns: int | None


def rgb(image: Any) -> Image:
    """A picture from OpenCV (BGR), converted to RGB."""
    return cast(Image, cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


class Feed(Protocol):
    """An open camera, stream or film. stamps: kind of its last picture's stamp."""

    @property
    def stamps(self) -> Stamps: ...

    def read(self) -> Shot | None:
        """Wait for the next picture; None if none arrives within a time of its choice, a few seconds at most.

        Raises OSError if the camera is lost, ValueError for an unusable picture, EOFError at the end of a film.
        """

    def close(self) -> None:
        """Release the camera."""
