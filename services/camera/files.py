"""Films and folders of pictures, played at their rate. While the process pauses, the film pauses too."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path

import cv2

from penumbra.services.camera.feed import Image, Shot, Stamps, rgb

PICTURES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
"""Suffixes of picture files in a folder."""
LONGEST_S = 1.0
"""Maximum time [s] between two pictures of a film; a longer one is replaced by the usual one."""
MOST_HZ = 1000.0


class Played(ABC):
    """Pictures of a film or folder, each delivered when it is due. Every round calls `_pass`, which reopens the film."""

    stamps: Stamps = "playback"

    def __init__(self, path: Path, is_looping: bool, stopping: threading.Event):
        self._path, self._is_looping, self._stopping = path, is_looping, stopping
        self._due_s: float | None = None
        self._next = self._pictures()

    @abstractmethod
    def _pass(self) -> Iterator[tuple[Image | None, str, float]]:
        """Each picture (RGB), or its fault, and the time [s] since the previous one. Raises OSError."""

    def _pictures(self) -> Iterator[tuple[Image | None, str, float]]:
        while True:
            count = 0
            for picture in self._pass():
                count += 1
                yield picture
            if not count:
                raise OSError(f"{self._path} holds no picture; give another film or folder")
            if not self._is_looping:
                raise EOFError(f"{self._path} has ended; start it again, with --loop for one that does not end")

    def read(self) -> Shot | None:
        image, fault, step_s = next(self._next)
        now_s = time.monotonic()
        due_s = now_s if self._due_s is None else self._due_s + step_s
        self._due_s = max(due_s, now_s - step_s)  # if late by more than a step, continue from now: the film was held up
        if self._stopping.wait(max(0.0, due_s - now_s)):
            return None
        if image is None:
            raise ValueError(fault)
        return Shot(image, time.time_ns())

    def close(self) -> None:
        self._next.close()  # type: ignore[attr-defined]  # a generator


class Film(Played):
    """A film file. rate_hz: replaces the film's own rate. otherwise_hz: used if the film has none."""

    def __init__(self, path: Path, is_looping: bool, rate_hz: float | None, otherwise_hz: float, stopping: threading.Event):
        super().__init__(path, is_looping, stopping)
        self._rate_hz, self._otherwise_hz = rate_hz, otherwise_hz

    def _pass(self) -> Iterator[tuple[Image | None, str, float]]:
        if not self._path.is_file():
            raise OSError(f"no film {self._path}: give the path of a file, beside the cell file or from here with --source")
        capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
        try:
            if not capture.isOpened():
                raise OSError(f"{self._path} is no film that FFmpeg reads; convert it, to MP4 for one")
            own_hz = capture.get(cv2.CAP_PROP_FPS)
            usual_s = 1.0 / (own_hz if 0.0 < own_hz <= MOST_HZ else self._otherwise_hz)
            last_s = float("nan")
            while True:
                is_there, image = capture.read()
                if not is_there:
                    return
                at_s = 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC)
                own_s = at_s - last_s if 0.0 < at_s - last_s <= LONGEST_S else usual_s  # films of phones have an uneven rate
                last_s = at_s
                yield rgb(image), "", 1.0 / self._rate_hz if self._rate_hz else own_s
        finally:
            capture.release()


class Folder(Played):
    """A folder's pictures in the order of their names."""

    def __init__(self, path: Path, is_looping: bool, rate_hz: float, stopping: threading.Event):
        super().__init__(path, is_looping, stopping)
        self._period_s = 1.0 / rate_hz

    def _pass(self) -> Iterator[tuple[Image | None, str, float]]:
        if not self._path.is_dir():
            raise OSError(f"no folder {self._path}: give the path of one with pictures")
        paths = sorted(path for path in self._path.iterdir() if path.suffix.lower() in PICTURES and path.name[0] != ".")
        if not paths:
            raise OSError(f"no pictures in {self._path}: expected files that end with {', '.join(PICTURES)}")
        for path in paths:
            image = cv2.imread(str(path), cv2.IMREAD_COLOR)
            if image is None:
                yield None, f"{path} cannot be read as a picture; remove it or save it again", self._period_s
            else:
                yield rgb(image), "", self._period_s
