"""Pictures of a camera with lens distortion, warped from those of a pinhole camera."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.shared.cell import description as cells
from penumbra.shared.geometry.lens import Lens

WIDEST = 3.0
"""Maximum size of the pinhole picture that is rendered, in widths and heights of the camera's; beyond it the edge is repeated."""


class Distortion:
    """Warps pinhole pictures of `window` = (x0, y0, width, height), which covers the lens's view, into the camera's."""

    def __init__(self, lens: Lens):
        places = lens.undistorted(lens.grid())
        size = np.array([lens.width, lens.height])
        middle, most = (size - 1) / 2.0, WIDEST * size / 2.0
        low = np.maximum(np.floor(np.nanmin(places, axis=(0, 1))) - 1.0, middle - most).clip(None, 0.0).astype(int)
        high = np.minimum(np.ceil(np.nanmax(places, axis=(0, 1))) + 2.0, middle + most).clip(size, None).astype(int)
        self.window = (int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
        places = np.where(np.isnan(places), -1e6, places - low).astype(np.float32)
        self._columns, self._rows = np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1])

    @staticmethod
    def of(camera: cells.Camera) -> Distortion | None:
        """The distortion of a camera; None for a pinhole."""
        return None if camera.lens.is_pinhole else Distortion(camera.lens)

    def __call__(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """The camera's picture (h, w, 3) from the window's (height, width, 3)."""
        bent = cv2.remap(image, self._columns, self._rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.maximum(bent, np.float32(0.0))  # cubic interpolation undershoots beside an edge

    def pinhole(self, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The part (h, w) of the window's labels (height, width) that the camera's undistorted picture shows."""
        x0, y0 = self.window[:2]
        height, width = self._rows.shape
        return labels[-y0 : height - y0, -x0 : width - x0]
