"""Pinhole intrinsics of a window of a camera's picture."""

from __future__ import annotations

from dataclasses import dataclass

from penumbra.shared.cell.description import Camera


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole intrinsics in pixels of a mask. The centre of the first pixel is (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float

    @staticmethod
    def of_window(camera: Camera, x0: int, y0: int, scale: int) -> Intrinsics:
        """Intrinsics of a window of a camera's image. Pixels of the window cover `scale` x `scale` image pixels."""
        return Intrinsics(camera.fx, camera.fy, camera.cx - x0, camera.cy - y0).coarser(scale)

    def coarser(self, scale: int) -> Intrinsics:
        """Intrinsics of the same view with pixels that cover `scale` x `scale` of these."""
        centre = (scale - 1) / 2.0
        return Intrinsics(self.fx / scale, self.fy / scale, (self.cx - centre) / scale, (self.cy - centre) / scale)
