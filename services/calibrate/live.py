"""Views of the board from the bus: pictures are used while the board, and the robot that carries it, stand still."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from penumbra.services.calibrate.board import Board
from penumbra.services.calibrate.intrinsics import View
from penumbra.services.calibrate.views import Picture
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import Frame, Joints
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.joint_history import JointHistory
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node

PATIENCE_S = 5.0
"""Time [s] to wait for a picture, or for joints, before an error is reported."""
STILL_PX = 0.7
"""Maximum mean motion [px] of the corners since the previous picture at which the board stands still: twice their noise."""
STILL_RAD = 2e-3
"""Maximum motion [rad] of any joint over STILL_S at which the robot stands still."""
STILL_S = 0.3
TOLERANCE_NS = 60_000_000
"""Maximum distance [ns] between a picture and the nearest joints."""


@dataclass(frozen=True)
class Still:
    """A picture of the board standing still: its view, the picture itself, and the joints (n,) [rad] of the robot, None without a
    robot."""

    view: View
    image: Picture
    joints: Array | None


class Watcher:
    """Reads a camera, and optionally a robot, and returns every picture in which both stand still."""

    def __init__(self, board: Board, camera: str, robot: str | None):
        self._board, self._camera, self._robot = board, camera, robot
        self._history = JointHistory(TOLERANCE_NS)
        self._fresh = threading.Condition()
        self._frame: Frame | None = None
        self._last: View | None = None
        self._count = 0
        self.status = ""
        """Why the last picture was not used, in words; empty if it was."""

    def on_frame(self, frame: Frame, names: dict[str, str]) -> None:
        """Keep the newest picture."""
        with self._fresh:
            self._frame = frame
            self._fresh.notify()

    def on_joints(self, joints: Joints, names: dict[str, str]) -> None:
        """Keep the joints of the last seconds."""
        self._history.add(joints.stamp_ns, joints.position)

    def stills(self) -> Iterator[Still | None]:
        """One item per picture: None if it is of no use. Raises BusError if no picture arrives."""
        while True:
            with self._fresh:
                if not self._fresh.wait_for(lambda: self._frame is not None, PATIENCE_S):
                    raise bus.BusError(
                        f"camera {self._camera}: expected pictures within {PATIENCE_S:g} s, got none; start what publishes "
                        "them, and look at `penumbra topics --hz`"
                    )
                frame, self._frame = self._frame, None
            assert frame is not None
            yield self._look(frame)

    def _look(self, frame: Frame) -> Still | None:
        found = self._board.find(frame.image)
        view = None if found is None else View(f"{self._count:03d}.png", *found)
        last, self._last = self._last, view
        if view is None:
            self.status = "the board is not seen"
            return None
        if last is None or _moved(last, view) > STILL_PX:
            self.status = "hold it still"
            return None
        joints = None
        if self._robot is not None:
            joints = self._history.at(frame.stamp_ns)
            before = self._history.at(frame.stamp_ns - int(STILL_S * 1e9))
            if joints is None or before is None:
                self.status = f"no joints of robot {self._robot} arrive"
                return None
            if np.abs(joints - before).max() > STILL_RAD:
                self.status = "the robot moves"
                return None
        self.status = ""
        self._count += 1
        return Still(view, frame.image, joints)


def _moved(last: View, view: View) -> float:
    """Mean motion [px] of the corners visible in both views."""
    shared, mine, others = np.intersect1d(view.numbers, last.numbers, return_indices=True)
    if not len(shared):
        return np.inf
    return float(np.linalg.norm(view.corners[mine] - last.corners[others], axis=1).mean())


@contextmanager
def watcher(
    cell: cells.Cell, connection: bus.Connection, board: Board, camera: str, robot: str | None = None
) -> Iterator[Watcher]:
    """A watcher of a camera, and of a robot, of a running cell. Raises BusError if there is no router."""
    node = Node("calibrate", cell, connection)
    found = Watcher(board, camera, robot)
    node.subscribe(topics.FRAME, found.on_frame, camera=camera)
    if robot is not None:
        node.subscribe(topics.JOINTS, found.on_joints, robot=robot)
    with node.open(1.0):
        yield found


def collect(
    found: Watcher, is_wanted: Callable[[Still], bool], count: int, what_next: Callable[[], str], say: Callable[[str], None]
) -> list[Still]:
    """Collect `count` wanted stills; fewer if Ctrl-C ends it. what_next: the instruction for the person; say: shows a line
    whenever something changes."""
    out: list[Still] = []
    said, due = "", 0.0
    try:
        for still in found.stills():
            if still is not None and is_wanted(still):
                out.append(still)
                due = 0.0
            if len(out) >= count:
                break
            status = found.status or what_next()
            line = f"{len(out)} of {count}: {status}"
            if line != said and time.monotonic() >= due:
                say(line)
                said, due = line, time.monotonic() + 1.0
    except KeyboardInterrupt:
        say(f"ended with {len(out)} of {count}")
    return out
