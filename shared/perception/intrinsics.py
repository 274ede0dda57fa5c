"""The pinhole of a window of a camera's picture."""

from __future__ import annotations

from dataclasses import dataclass

from penumbra.shared.cell.description import Camera


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole in pixels of a mask, whose first pixel's centre is (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float

    @staticmethod
    def of_window(camera: Camera, x0: int, y0: int, scale: int) -> Intrinsics:
        """The intrinsics of a window of a camera's image whose pixels cover `scale` x `scale` image pixels."""
        return Intrinsics(camera.fx, camera.fy, camera.cx - x0, camera.cy - y0).coarser(scale)

    def coarser(self, scale: int) -> Intrinsics:
        """The same view in pixels that cover `scale` x `scale` of these."""
        centre = (scale - 1) / 2.0
        return Intrinsics(self.fx / scale, self.fy / scale, (self.cx - centre) / scale, (self.cy - centre) / scale)
