"""Live cameras by OpenCV: V4L2 devices and RTSP streams."""

from __future__ import annotations

import os
import time
from pathlib import Path

import cv2

from penumbra.services.camera import stamps
from penumbra.services.camera.feed import Shot, Stamps, rgb
from penumbra.shared.cell.description import Camera, CameraSource

OPEN_S, READ_S = 5.0, 2.0
"""Maximum time [s] to wait for a stream to open, and for a picture."""
EXPOSURE_S = 1.0
"""Period [s] at which a camera is asked for its exposure time, which changes with the light."""
EXPOSURE_UNIT_S = 1e-4
"""Unit of V4L2's exposure time [s]."""
LARGEST_EPOCH_US = 4e15
"""Upper bound of a stream's start time [us since the epoch] (the year 2096); if it is unknown, OpenCV returns other numbers."""


def quiet() -> None:
    """Silence the output of OpenCV and FFmpeg: faults are in the log and the health report, with what to do."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", f"{READ_S:.0f}")  # 10 s otherwise
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


class V4l2:
    """A device such as /dev/video0. Its driver stamps each picture; uvcvideo, for USB cameras, at the start of the exposure, so
    half of the exposure time is added."""

    def __init__(self, device: str, camera: Camera):
        path = Path(device)
        if not path.exists():
            there = ", ".join(sorted(str(each) for each in Path("/dev").glob("video*"))) or "none"
            raise OSError(f"no device {device}: is the camera plugged in? Video devices now: {there}")
        if not os.access(path, os.R_OK | os.W_OK):
            raise OSError(f"{device} may not be opened by this user: add it to the group that owns the device (often video)")
        self._device, self._period_s = device, 1.0 / camera.rate_hz
        self._stamps: Stamps = ""
        self._capture = cv2.VideoCapture(device, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise OSError(
                f"{device} delivers no pictures: it is in use by another process, or no camera; end it, or give another"
            )
        self._capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))  # USB 2 carries large pictures only so
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
        self._capture.set(cv2.CAP_PROP_FPS, camera.rate_hz)
        self._asked_s, self._exposure_s = float("-inf"), 0.0

    @property
    def stamps(self) -> Stamps:
        return self._stamps

    def read(self) -> Shot:
        is_there, image = self._capture.read()
        monotonic_ns, epoch_ns = time.monotonic_ns(), time.time_ns()
        if not is_there:
            raise OSError(f"{self._device} delivers no more pictures; check that the camera is connected")
        own_ns = round(1e6 * self._capture.get(cv2.CAP_PROP_POS_MSEC))
        stamp_ns = stamps.of_driver(own_ns, monotonic_ns, epoch_ns)
        self._stamps = "arrival" if stamp_ns is None else "exposure"
        return Shot(rgb(image), None if stamp_ns is None else stamp_ns + round(5e8 * self._exposure()))

    def _exposure(self) -> float:
        """The exposure time [s]; 0 if the camera does not report it."""
        if (now_s := time.monotonic()) - self._asked_s > EXPOSURE_S:
            found_s = EXPOSURE_UNIT_S * self._capture.get(cv2.CAP_PROP_EXPOSURE)
            self._asked_s, self._exposure_s = now_s, found_s if 0.0 < found_s <= self._period_s else 0.0
        return self._exposure_s

    def close(self) -> None:
        self._capture.release()


class Rtsp:
    """An RTSP stream. Its pictures carry the time since its start. The start is given by the sender in its own clock after a few
    seconds, and by the quickest pictures in this host's clock."""

    def __init__(self, source: CameraSource):
        self._shown, self._is_synchronised = source.shown, source.synchronised
        self._latency_ns = round(1e9 * (source.latency or 0.0))
        self._clock = stamps.StreamClock()
        self._stamps: Stamps = "stream"
        self.sender_latency_s: float | None = None
        options = {
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: round(1e3 * OPEN_S),
            cv2.CAP_PROP_READ_TIMEOUT_MSEC: round(1e3 * READ_S),
            cv2.CAP_PROP_N_THREADS: 1,  # each further thread delays pictures by one
        }
        self._capture = cv2.VideoCapture(source.url, cv2.CAP_FFMPEG, [word for pair in options.items() for word in pair])
        if not self._capture.isOpened():
            raise OSError(f"no stream at {self._shown}: check address, user and password, and that the camera is on")

    @property
    def stamps(self) -> Stamps:
        return self._stamps

    def read(self) -> Shot:
        while True:
            is_there, image = self._capture.read()
            arrival_ns, now_s = time.time_ns(), time.monotonic()
            if not is_there:
                raise OSError(f"the stream at {self._shown} has stopped")
            own_ns = round(1e6 * self._capture.get(cv2.CAP_PROP_POS_MSEC))
            stamp_ns = self._clock.stamp(own_ns, arrival_ns, now_s)
            sent_ns = self._sent_ns(own_ns)
            if sent_ns is not None:
                self.sender_latency_s = (stamp_ns - sent_ns) * 1e-9
            if self._is_synchronised and sent_ns is not None:
                self._stamps = "sender"
                return Shot(rgb(image), sent_ns)
            if self._clock.is_settled(now_s):
                return Shot(rgb(image), stamp_ns - self._latency_ns)

    def _sent_ns(self, own_ns: int) -> int | None:
        """The time of a picture by the sender's clock (RTCP) [ns since the epoch]; None until the sender reports it."""
        began_us = self._capture.get(cv2.CAP_PROP_STREAM_OPEN_TIME_USEC)
        return round(1e3 * began_us) + own_ns if 0.0 < began_us < LARGEST_EPOCH_US else None

    def close(self) -> None:
        self._capture.release()
