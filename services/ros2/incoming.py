"""Converts messages of ROS to measurements of the cell: JointState by joint names, Image and CompressedImage as RGB."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.shared.cell.description import Camera

SPREAD_NS = 100_000_000
"""Maximum time [ns] between the parts of one set of joints, if several nodes publish them."""
LEAST_STEP_NS = 10_000_000
"""Minimum time [ns] between sets of joints; earlier ones are dropped: robots send up to a thousand sets per second, of which the
cell reads a hundred."""
SECOND_NS = 1_000_000_000

COLOURS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUYV),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUYV),
}
"""Bytes per pixel, and OpenCV's conversion to RGB, by the encoding of sensor_msgs/Image (image_encodings.hpp)."""


class Refused(ValueError):
    """A message that cannot be used; the text says why."""


def stamp_ns(message: Any) -> int:
    """The stamp of a message with a header, nanoseconds since the epoch."""
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


class Joints:
    """Collects the joints of one robot, each from the newest message that names it.

    names: in the order of `Joints.position`. missing: joints that no message has named, or whose last value is older than the
    newest part by more than SPREAD_NS.
    """

    def __init__(self, names: Sequence[str]):
        self.names = tuple(names)
        self.missing = self.names
        self._parts: dict[str, tuple[int, float]] = {}
        self._last_ns = 0

    def add(self, message: Any) -> tuple[int, NDArray[np.float64]] | None:
        """Add a JointState; returns the stamp of the newest part and all positions (n,) [rad or m] if the set is complete and the
        last one was at least LEAST_STEP_NS ago. Raises Refused for invalid positions."""
        if len(message.position) != len(message.name):
            raise Refused(f"expected a position for each of {len(message.name)} joints, got {len(message.position)}")
        now_ns = stamp_ns(message)
        for name, position in zip(message.name, message.position.tolist(), strict=True):
            if name in self.names:
                if not math.isfinite(position):
                    raise Refused(f"joint {name}: expected a finite position, got {position}")
                self._parts[name] = now_ns, position
        newest_ns = max((part_ns for part_ns, _ in self._parts.values()), default=0)
        self.missing = tuple(
            name for name in self.names if name not in self._parts or newest_ns - self._parts[name][0] > SPREAD_NS
        )
        if self.missing or not set(self.names) & set(message.name) or abs(newest_ns - self._last_ns) < LEAST_STEP_NS:
            return None
        self._last_ns = newest_ns
        return newest_ns, np.array([self._parts[name][1] for name in self.names])


def image(message: Any, camera: Camera) -> NDArray[np.uint8]:
    """The picture (h, w, 3) RGB of an Image. Raises Refused for another size than the camera's, and for
    encodings other than eight-bit colour or grey."""
    if message.encoding not in COLOURS:
        raise Refused(f"expected an encoding of {', '.join(COLOURS)}, got {message.encoding!r:.40}")
    _check_size(message.width, message.height, camera)
    depth, way = COLOURS[message.encoding]
    width, height, step = int(message.width), int(message.height), int(message.step)
    if step < width * depth or len(message.data) < step * height:
        wanted = f"{height} rows of {width * depth} bytes or more"
        raise Refused(f"expected {wanted} for {message.encoding}, got {len(message.data)} bytes in rows of {step}")
    rows = np.frombuffer(message.data, np.uint8, step * height).reshape(height, step)[:, : width * depth]
    pixels = np.ascontiguousarray(rows).reshape((height, width) if depth == 1 else (height, width, depth))
    if depth == 2 and width % 2:
        raise Refused(f"expected an even width for {message.encoding}, got {width}")
    return pixels if way is None else np.asarray(cv2.cvtColor(pixels, way), np.uint8)


def compressed_image(message: Any, camera: Camera) -> NDArray[np.uint8]:
    """The picture (h, w, 3) RGB of a CompressedImage. Raises Refused unless it is a JPEG or PNG of the camera's size."""
    if "compressedDepth" in message.format or not len(message.data):
        raise Refused(f"expected a JPEG or PNG in colour or grey, got {len(message.data)} bytes of format {message.format!r:.40}")
    try:
        found = cv2.imdecode(np.asarray(message.data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        found = None
    if found is None:
        raise Refused(f"expected a JPEG or PNG, got {len(message.data)} bytes of format {message.format!r:.40} that are none")
    _check_size(found.shape[1], found.shape[0], camera)
    return np.asarray(cv2.cvtColor(found, cv2.COLOR_BGR2RGB), np.uint8)


def _check_size(width: int, height: int, camera: Camera) -> None:
    if (width, height) != (camera.width, camera.height):
        raise Refused(f"expected {camera.width} x {camera.height} pixels as in the cell file, got {width} x {height}")
