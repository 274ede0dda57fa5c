"""The square picture that the network looks at, cut out of an image and resampled."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.shared.geometry.rigid import Array

SIDE = 256
"""Pixels a side."""
COARSEST = 0.6
"""A picture is halved before it would be sampled more coarsely than this, so that nothing is skipped."""


@dataclass(frozen=True)
class Patch:
    """pixels (SIDE, SIDE, 3) uint8 RGB, black outside the image; focal [px] along both axes; centre (2,) [px]: its principal
    point, which may lie outside."""

    pixels: NDArray[np.uint8]
    focal: float
    centre: Array


def square(intrinsics: Array, middle: Array, side: float | Array, angle: float | Array = 0.0) -> tuple[Array, Array, Array]:
    """(M (..., 2, 3), focal (...), principal point (..., 2)) of patches: M maps pixels of an image with `intrinsics` (..., 4)
    (fx, fy, cx, cy) to those of the patch around `middle` (..., 2), `side` (...) image columns wide, turned by `angle` (...)
    [rad] clockwise.

    Rows are scaled so that both focal lengths become one. A picture that is turned and scaled about its principal point is that
    of a camera turned about its axis with another lens: poses need no other correction.
    """
    fx, fy, cx, cy = np.moveaxis(np.asarray(intrinsics, float), -1, 0)
    zoom = SIDE / np.asarray(side)
    c, s = zoom * np.cos(angle), zoom * np.sin(angle)
    linear = np.stack([np.stack([c, -s * fx / fy], -1), np.stack([s, c * fx / fy], -1)], -2)
    offset = (SIDE - 1) / 2.0 - np.einsum("...ij,...j->...i", linear, middle)
    principal = np.einsum("...ij,...j->...i", linear, np.stack([cx, cy], -1)) + offset
    return np.concatenate([linear, offset[..., None]], -1), zoom * fx, principal


def warp(image: NDArray[np.uint8], M: Array) -> NDArray[np.uint8]:
    """The pixels (SIDE, SIDE, 3) of the map M (2, 3) from pixels of an image (h, w, 3); black where there is no image."""
    M = M.copy()
    inverse = cv2.invertAffineTransform(M)
    corners = np.array([[0, 0], [SIDE, 0], [0, SIDE], [SIDE, SIDE]]) @ inverse[:, :2].T + inverse[:, 2]
    low = np.clip(np.floor(corners.min(axis=0)).astype(int) - 2, 0, [image.shape[1] - 1, image.shape[0] - 1])
    high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 3, low + 1, [image.shape[1], image.shape[0]])
    image = image[low[1] : high[1], low[0] : high[0]]
    M[:, 2] += M[:, :2] @ low
    while np.sqrt(abs(np.linalg.det(M[:, :2]))) < COARSEST and min(image.shape[:2]) > 1:
        height, width = image.shape[0] // 2, image.shape[1] // 2
        image = np.asarray(cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        M[:, 2] += M[:, :2] @ [0.5, 0.5]  # the middle of the first half-size pixel
        M[:, :2] *= 2.0
    return np.asarray(cv2.warpAffine(image, M, (SIDE, SIDE), flags=cv2.INTER_LINEAR), np.uint8)


def cut(image: NDArray[np.uint8], intrinsics: Array, middle: Array, side: float) -> Patch:
    """The upright patch of an image (h, w, 3) uint8 RGB around a point (2,) [px], `side` image columns wide."""
    M, focal, centre = square(intrinsics, middle, side)
    return Patch(warp(image, M), float(focal), centre)


def facing(point: Array) -> Array:
    """R_camera_ray (..., 3, 3): the camera turned by the shortest way until a point (..., 3) in its frame lies straight ahead.
    The rotation of an object relative to it is allocentric: that in which it looks the same wherever in the image it is."""
    x, y, z = np.moveaxis(point / np.linalg.norm(point, axis=-1, keepdims=True), -1, 0)
    a = 1.0 / (1.0 + z)
    rows = ([1.0 - a * x * x, -a * x * y, x], [-a * x * y, 1.0 - a * y * y, y], [-x, -y, z])
    return np.stack([np.stack(row, -1) for row in rows], -2)
