"""A camera by a class of the user's, for the SDK of any maker.

class Camera:                                   # in my_camera.py; the source is adapter:my_camera:Camera
    def __init__(self, name, camera):           # the cell's name of the camera, and what its file says: width, height, rate_hz …
        self.device = sdk.open()                # an exception is a camera that is not there: it is tried again

    def read(self):                             # waits for the next picture, two seconds at most
        picture = self.device.grab()            # an exception is a camera that was lost: it is closed and opened again
        return picture.rgb, picture.stamp_ns    # uint8 (height, width, 3); the middle of the exposure [ns since the epoch],
                                                # None where the SDK does not say; return None where no picture came

    def close(self):
        self.device.close()
"""

from __future__ import annotations

from typing import Any

import numpy as np

from penumbra.services.camera.feed import Shot, Stamps
from penumbra.shared.cell.description import Camera


class Adapted:
    """A feed by a user's class, whose exceptions count as a lost camera."""

    def __init__(self, kind: type[Any], name: str, camera: Camera):
        self._kind = kind.__name__
        self._stamps: Stamps = ""
        try:
            self._own = kind(name, camera)
        except Exception as error:
            raise OSError(f"{self._kind}: {type(error).__name__}: {error}") from error

    @property
    def stamps(self) -> Stamps:
        return self._stamps

    def read(self) -> Shot | None:
        try:
            got = self._own.read()
        except EOFError:
            raise
        except Exception as error:
            raise OSError(f"{self._kind}.read: {type(error).__name__}: {error}") from error
        if got is None:
            return None
        match got:
            case (np.ndarray() as image, (int() | np.integer() | None) as stamp_ns):
                self._stamps = "arrival" if stamp_ns is None else "exposure"
                return Shot(image, None if stamp_ns is None else int(stamp_ns))
        raise OSError(f"{self._kind}.read: expected (image, stamp_ns), an array and an int or None, got {type(got).__name__}")

    def close(self) -> None:
        try:
            self._own.close()
        except Exception as error:
            raise OSError(f"{self._kind}.close: {type(error).__name__}: {error}") from error
