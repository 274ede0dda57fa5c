"""Pictures that show a number, films of them, and a small cell with one camera of their size that `penumbra camera` reads."""

from __future__ import annotations

import functools
import json
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml

from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import Frame
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support import gstreamer
from penumbra.tests.support.gstreamer import COLUMNS, HEIGHT, ROWS, WIDTH, luma
from penumbra.tests.support.live import PATIENCE_S, penumbra_command, wait_for

SYSTEM_PYTHON = "/usr/bin/python3"
GSTREAMER = [SYSTEM_PYTHON, str(Path(gstreamer.__file__))]
"""The command line of `gstreamer.py`."""
FRONT = {"width": WIDTH, "height": HEIGHT, "fx": 110.0, "fy": 110.0, "cx": 63.5, "cy": 47.5, "position": [0.35, -1.15, 0.9]}
"""A camera that takes pictures of this size."""


@functools.cache
def lacks_gstreamer() -> str:
    """The reason why GStreamer's server cannot run here; empty where it can."""
    code = "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import GstRtspServer"
    try:
        found = subprocess.run([SYSTEM_PYTHON, "-c", code], capture_output=True)
    except FileNotFoundError:
        return f"there is no {SYSTEM_PYTHON}"
    packages = "gstreamer1.0-rtsp gir1.2-gst-rtsp-server-1.0 python3-gi gstreamer1.0-plugins-good gstreamer1.0-plugins-base"
    return "" if found.returncode == 0 else f"GStreamer's RTSP server is not installed: apt install {packages}"


def image(number: int) -> np.ndarray:
    """The picture (HEIGHT, WIDTH, 3) that shows a number."""
    return np.repeat(np.frombuffer(luma(number), np.uint8).reshape(HEIGHT, WIDTH, 1), 3, 2)


def number(picture: np.ndarray) -> int:
    """The number that a picture of any size shows."""
    height, width, _ = picture.shape
    blocks = picture[..., 1].reshape(ROWS, height // ROWS, COLUMNS, width // COLUMNS).mean((1, 3))
    return sum(1 << k for k, is_set in enumerate((blocks > 128).ravel()) if is_set)


def film(path: Path, numbers: Sequence[int], rate_hz: float, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    """Writes a film of numbers. size: of its pictures."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, size)
    for each in numbers:
        writer.write(cv2.resize(image(each), size, interpolation=cv2.INTER_NEAREST))
    writer.release()
    return path


def cell(folder: Path, source: dict[str, Any] | None = None, **camera: Any) -> Path:
    """Writes a cell file with one camera and its source, and returns its path."""
    front = {**FRONT, "look_at": [0.05, 0.0, 0.15], **camera, **({"source": source} if source else {})}
    forearm = {"mesh": "body:forearm", "labels": ["forearm", "hand"], "home": {"position": [0.0, 0.0, 0.2]}}
    path = folder / "numbered.yaml"
    path.write_text(yaml.safe_dump({"name": "numbered", "cameras": {"front": front}, "targets": {"forearm": forearm}}))
    return path


class Seen(NamedTuple):
    """A frame that arrived: the number that it shows, its stamp and its arrival [ns since the epoch]."""

    number: int
    stamp_ns: int
    arrival_ns: int


class Viewer:
    """A program that receives the frames of a cell, and asks for the health of its camera process."""

    def __init__(self, node: Node):
        self.node = node
        self.frames: list[Seen] = []
        node.subscribe(topics.FRAME, self._on_frame, camera="front")

    def _on_frame(self, frame: Frame, names: dict[str, str]) -> None:
        self.frames.append(Seen(number(frame.image), frame.stamp_ns, time.time_ns()))

    def health(self) -> dict[str, Any]:
        """The report of the camera process; empty where none answers."""
        answers = self.node.query(topics.health(self.node.cell.name, "camera"))
        return json.loads(answers[0]) if answers else {}

    def front(self) -> dict[str, Any]:
        """The part of the report about its camera."""
        return self.health().get("report", {}).get("front", {})

    def waits_for(self, state: str) -> None:
        wait_for(lambda: self.front().get("state") == state, PATIENCE_S, f"the state {state}", 0.1)

    def waits_for_reason(self, text: str) -> str:
        """Waits for a reason that contains this text, and returns it."""
        reasons = lambda: next((why for why in self.health().get("reasons", ()) if text in why), None)  # noqa: E731
        return wait_for(reasons, PATIENCE_S, f"the reason {text!r}", 0.1)

    def more(self, count: int) -> list[Seen]:
        """The next `count` frames that arrive."""
        before = len(self.frames)
        wait_for(lambda: len(self.frames) >= before + count, PATIENCE_S, f"{count} frames")
        return self.frames[before : before + count]


@contextmanager
def viewer(path: Path, router: str) -> Iterator[Viewer]:
    """A viewer at a router."""
    node = Node("viewer", cells.load(path), bus.Connection(connect=(router,)))
    found = Viewer(node)
    with node:
        yield found


class Service(NamedTuple):
    """`penumbra camera` as a process, and the lines of its log so far."""

    process: subprocess.Popen
    lines: list[str]


@contextmanager
def camera_process(path: Path, router: str, *arguments: str, **popen: Any) -> Iterator[Service]:
    """`penumbra camera` for a cell file, ended by SIGTERM, after which its exit code must be 0."""
    command = penumbra_command("camera", "--cell", str(path), "--connect", router, *arguments)
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **popen)
    assert process.stderr is not None
    lines: list[str] = []
    reading = threading.Thread(target=lambda errors: lines.extend(errors), args=(process.stderr,), daemon=True)
    reading.start()
    try:
        yield Service(process, lines)
        process.terminate()
        assert process.wait(PATIENCE_S) == 0, lines
    finally:
        process.kill()
        process.wait()
