"""Lens model of a camera: its distortion, and the undistortion of pictures.

The distortion model is OpenCV's (Brown 1971): radial k1 k2 k3 and tangential p1 p2. The lens maps the pinhole's normalised
coordinates x, y, with r^2 = x^2 + y^2, to

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

Everything after `Undistortion` works on the pinhole picture: the same intrinsics and size, all coefficients zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from penumbra.shared.geometry.rigid import Array

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
"""Distortion coefficients, in the order of OpenCV's first five."""
LARGEST = 20.0
"""Maximum magnitude of a coefficient. Coefficients of real lenses are below 5."""
VIEW = (0.15, 60.0)
"""Minimum and maximum focal length, in widths of the picture: fields of view of 147 degrees and 1 degree."""
SQUARE = 1.25
"""Maximum ratio of the two focal lengths. Pixels of real sensors are square to 1 %."""
NEWTON_STEPS = 20
CONVERGED_PX = 1e-6
"""Maximum number of Newton steps of the inverse distortion, and the error [px] below which they end."""
RADII = 2000
"""Number of radii at which the distortion is tested for a fold."""

_CALIBRATE = "calibrate with cv2.calibrateCamera and its default flags, and give k1 k2 p1 p2 k3"
_RATIONAL = f"the rational, thin-prism and tilted models are not supported; {_CALIBRATE}"
_FISHEYE = "fisheye models are not supported; undistort the pictures with cv2.fisheye before they are published, and leave it out"
_VECTOR = f"expected the coefficients one by one, {' '.join(COEFFICIENTS)}, in OpenCV's order"
FOREIGN = {
    **dict.fromkeys(("k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY", "taux", "tauy"), _RATIONAL),
    **dict.fromkeys(("fisheye", "xi", "alpha", "omega"), _FISHEYE),
    **dict.fromkeys(("distortion_model", "camera_model", "model"), f"expected no name of a model: it is OpenCV's; {_CALIBRATE}"),
    **dict.fromkeys(
        ("D", "d", "dist", "distCoeffs", "dist_coeffs", "distortion", "distortion_coefficients", "coefficients"), _VECTOR
    ),
}
"""Keys of other distortion models, each with a remedy."""


@dataclass(frozen=True)
class Lens:
    """Picture size and intrinsics [px] of a camera, pixel centres at integer coordinates, and its distortion."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens has no distortion."""
        return not any(getattr(self, name) for name in COEFFICIENTS)

    def faults(self, room: float = 0.0) -> list[tuple[str, str]]:
        """Implausible fields, each with what was expected. `room`: how far outside the picture the principal point may lie, as a
        share of the picture's size; above zero for crops."""
        out = []
        for name in ("fx", "fy"):
            low, high = (round(share * self.width) for share in VIEW)
            if not low <= getattr(self, name) <= high:
                out.append(
                    (name, f"expected a focal length of {low} to {high} pixels for a picture {self.width} wide, got "
                     f"{getattr(self, name):g}; check whether it is in millimetres or for another image size")
                )  # fmt: skip
        if not out and not 1.0 / SQUARE < self.fx / self.fy < SQUARE:
            what = f"expected fx and fy of nearly the same size, got {self.fx:g} and {self.fy:g}"
            out.append(("fx", f"{what}; check that fx is not swapped with cx, or fy with cy"))
        for name, size in (("cx", self.width), ("cy", self.height)):
            if not -room * size <= getattr(self, name) <= (1.0 + room) * size - 1.0:
                where = f"in or near the picture ({size} pixels)" if room else f"in the picture, from 0 to {size - 1}"
                what = f"expected the principal point {where}, got {getattr(self, name):g}"
                out.append((name, f"{what}; check that width and height belong to these intrinsics"))
        if out:
            return out
        for name in COEFFICIENTS:
            if abs(value := getattr(self, name)) > LARGEST:
                out.append((name, f"expected a coefficient from -{LARGEST:g} to {LARGEST:g}, got {value:g}; {_CALIBRATE}"))
        edge = min(self.cx / self.fx, self.cy / self.fy, (self.width - self.cx) / self.fx, (self.height - self.cy) / self.fy)
        if not out and self._reach < edge:
            text = (
                f"expected a distortion that fills the picture, got one that folds over at {self._reach / edge:.0%} of its half"
            )
            out.append(("k1", f"{text}; check signs and order, {' '.join(COEFFICIENTS)}"))
        return out

    def distorted(self, pixels: ArrayLike) -> Array:
        """Maps points (..., 2) [px] of the pinhole picture to the camera's picture (..., 2) [px]."""
        return np.asarray(self._bent(self._normalised(pixels))[0] * (self.fx, self.fy) + (self.cx, self.cy), np.float64)

    def undistorted(self, pixels: ArrayLike) -> Array:
        """Maps points (..., 2) [px] of the camera's picture to the pinhole picture (..., 2) [px] by Newton's method; NaN for a
        point that no ray reaches."""
        wanted = self._normalised(pixels)
        x = wanted.copy()
        error = np.zeros_like(x)
        for _ in range(NEWTON_STEPS):
            bent, J = self._bent(x)
            error = bent - wanted
            if np.abs(error).max(initial=0.0) * self.fx < CONVERGED_PX:
                break
            det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
            det = np.where(np.abs(det) < 1e-9, 1e-9, det)
            dx = (J[..., 1, 1] * error[..., 0] - J[..., 0, 1] * error[..., 1]) / det
            dy = (J[..., 0, 0] * error[..., 1] - J[..., 1, 0] * error[..., 0]) / det
            x = x - np.clip(np.stack([dx, dy], axis=-1), -0.3, 0.3)
        lost = (np.abs(error).max(axis=-1) * self.fx > 0.01) | (np.hypot(x[..., 0], x[..., 1]) > self._fold)
        return np.where(lost[..., None], np.nan, x * (self.fx, self.fy) + (self.cx, self.cy))

    def is_seen(self, pixels: ArrayLike) -> NDArray[np.bool_]:
        """Whether the camera's picture shows points (..., 2) [px] of the pinhole picture."""
        x = self._normalised(pixels)
        u, v = np.moveaxis(self.distorted(pixels), -1, 0)
        inside = (u >= -0.5) & (u <= self.width - 0.5) & (v >= -0.5) & (v <= self.height - 0.5)
        return np.asarray(inside & (np.hypot(x[..., 0], x[..., 1]) <= self._fold))

    def grid(self) -> Array:
        """Pixel centres (height, width, 2) of the picture."""
        return np.stack(np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float)), axis=-1)

    def _normalised(self, pixels: ArrayLike) -> Array:
        return np.asarray((np.asarray(pixels, float) - (self.cx, self.cy)) / (self.fx, self.fy), np.float64)

    def _bent(self, points: Array) -> tuple[Array, Array]:
        """Distorted points (..., 2) of normalised points (..., 2), and their derivatives (..., 2, 2)."""
        x, y = points[..., 0], points[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = 2.0 * (self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3))  # derivative of the radial factor by x, divided by x
        p1, p2 = self.p1, self.p2
        bent = np.stack(
            [x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y],
            axis=-1,
        )
        mixed = slope * x * y + 2.0 * (p1 * x + p2 * y)
        J = np.empty((*points.shape, 2))
        J[..., 0, 0] = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        J[..., 0, 1] = J[..., 1, 0] = mixed
        J[..., 1, 1] = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        return bent, J

    @cached_property
    def _folding(self) -> tuple[float, float]:
        """Radius at which the radial distortion starts to decrease, infinite where it never does near the picture, and the
        maximum distorted radius up to there. Both are normalised."""
        corner = np.hypot(max(self.cx, self.width - self.cx) / self.fx, max(self.cy, self.height - self.cy) / self.fy)
        r = np.linspace(0.0, 4.0 * corner, RADII)
        shown = r * (1.0 + r**2 * (self.k1 + r**2 * (self.k2 + r**2 * self.k3)))
        backwards = np.flatnonzero(np.diff(shown) <= 0.0)
        if not len(backwards):
            return np.inf, float(shown[-1])
        return float(r[backwards[0]]), float(shown[backwards[0]])

    @property
    def _fold(self) -> float:
        return self._folding[0]

    @property
    def _reach(self) -> float:
        return self._folding[1]


class Undistortion:
    """Converts a camera's pictures to pinhole pictures. `unseen` (height, width): pixels of the pinhole picture that the camera
    does not show, None where it shows all."""

    def __init__(self, lens: Lens):
        self._lens = lens
        self._maps: tuple[NDArray[np.int16], NDArray[np.uint16]] | None = None
        self.unseen: NDArray[np.bool_] | None = None
        if not lens.is_pinhole:
            import cv2  # not needed for a pinhole camera

            grid = lens.grid()
            u, v = np.moveaxis(lens.distorted(grid), -1, 0).astype(np.float32)
            self._maps = cv2.convertMaps(u, v, cv2.CV_16SC2)
            unseen = ~lens.is_seen(grid)
            self.unseen = unseen if unseen.any() else None

    def __call__(self, image: NDArray[np.uint8], region: tuple[int, int, int, int] | None = None) -> NDArray[np.uint8]:
        """Pinhole picture of a picture (height, width, channels) uint8, black where the camera shows nothing. Returns the picture
        itself where the lens has no distortion. region: columns and rows (x0, y0, x1, y1) that are needed; the others may be
        black. Raises ValueError for a picture of another size."""
        height, width = self._lens.height, self._lens.width
        if image.shape[:2] != (height, width):
            raise ValueError(
                f"expected a picture of {width} x {height}, got {image.shape[1]} x {image.shape[0]}; correct the camera's width "
                "and height"
            )
        if self._maps is None:
            return image
        import cv2

        x0, y0, x1, y1 = (0, 0, width, height) if region is None else np.clip(region, 0, (width, height, width, height))
        out = np.zeros_like(image)
        if x0 < x1 and y0 < y1:
            places, weights = (part[y0:y1, x0:x1] for part in self._maps)
            out[y0:y1, x0:x1] = cv2.remap(image, places, weights, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return out
