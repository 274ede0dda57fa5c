"""Devices of a cell as processes that may hang, be killed and start again at the same address: a robot's controller and a
camera's server; and a cell with a robot."""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from penumbra.tests.support import numbered

ORDER = ("elbow_joint", "shoulder_pan_joint", "wrist_3_joint", "shoulder_lift_joint", "wrist_1_joint", "wrist_2_joint")
"""Order of the cell's joints, which differs from the controller's."""


class Device:
    """A program that prints `listening` when it is ready. `process` is the current one."""

    def __init__(self, *command: str):
        self._command = command
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None and self.process.stdout.readline() == "listening\n"

    def tell(self, line: str) -> None:
        """Writes a line to its standard input."""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


class Controller(Device):
    """A controller of Universal Robots that speaks RTDE (`rtde_peer`)."""

    def __init__(self) -> None:
        self.address = f"127.{random.randint(1, 254)}.{random.randint(0, 254)}.{random.randint(2, 254)}"
        super().__init__(sys.executable, "-m", "penumbra.tests.support.rtde_peer", self.address)


class CameraServer(Device):
    """GStreamer's RTSP server, whose pictures show their time of creation (`gstreamer`)."""

    def __init__(self, port: int, rate_hz: int):
        self.url = f"rtsp://127.0.0.1:{port}/camera"
        super().__init__(*numbered.GSTREAMER, "serve", str(port), str(rate_hz))


def urdf(names: Sequence[str]) -> str:
    """The URDF of a chain of revolute joints."""
    links = "".join(f'<link name="l{i}"/>' for i in range(len(names) + 1))
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/><axis xyz="0 0 1"/>'
        '<limit lower="-6" upper="6" effort="1" velocity="1"/></joint>'
        for i, name in enumerate(names)
    )
    return f'<robot name="arm">{links}{joints}</robot>'


def robot_cell(folder: Path, source: str | None = None, joints: Sequence[str] = ORDER, more: str = "") -> Path:
    """Writes a cell with one robot, and returns its path. more: further fields of its source."""
    (folder / "arm.urdf").write_text(urdf(joints))
    origin = f", source: {{url: '{source}'{more}}}" if source else ""
    path = folder / "mine.yaml"
    path.write_text(
        f"name: mine\nrobots:\n  arm: {{urdf: arm.urdf, joints: [{', '.join(joints)}]{origin}}}\n"
        "targets:\n  forearm: {mesh: 'body:forearm', labels: [forearm], home: {position: [0, 0, 0.2]}}\n"
    )
    return path
