"""A running cell as a program sees it: its parts, its poses, its health, and its sensors for publishing."""

from __future__ import annotations

import contextlib
import threading
import weakref
from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import TracebackType
from typing import Self, TypeVar

import numpy as np
import zenoh

from penumbra.client.pose import Pose
from penumbra.client.poses import Poses
from penumbra.client.publish import Camera, Pad, Robot, Stream
from penumbra.shared.contract import access, topics
from penumbra.shared.contract.messages import FusedPose, decode
from penumbra.shared.contract.outline import Outline
from penumbra.shared.runtime import bus, running
from penumbra.shared.runtime.connection import short

FRAMES_UNDER_WAY = 3
"""Number of images of each camera in shared memory: one that is written and two that are read."""
PUBLISH_S = 3.0
"""Maximum time [s] that a program's first message waits for the router."""
LOOK_S = 0.2
"""Maximum time [s] of a look for fusion where no pose arrives: a program that stops a robot then waits for the reason."""

Sensor = TypeVar("Sensor", Camera, Robot, Pad)


class CellBase:
    """Common part of `Cell` and `AsyncCell`. session: for reading. connection: how it was opened. outline: summary of the cell.

    Sensors publish in a second session, which the first message opens. On a secured bus that session shows the certificate of a
    driver, and its shared memory has room for the cameras' images. A program that only reads needs neither.
    """

    def __init__(self, session: zenoh.Session, connection: bus.Connection, outline: Outline):
        self._session, self._connection, self._outline = session, connection, outline
        # at the latest at the end of the program: in an interpreter that has ended, calls from Zenoh's thread would block forever
        self._close_session = weakref.finalize(self, session.close)
        self._closing = threading.Event()
        self._opening = threading.Lock()  # guards the session for publishing
        self._publishing: zenoh.Session | None = None
        self._cameras = {
            name: Camera(
                name,
                found.width,
                found.height,
                found.rate_hz,
                np.array(found.K),
                np.array(found.T_world_camera),
                self._stream(topics.FRAME, found.rate_hz, camera=name),
            )
            for name, found in outline.cameras.items()
        }
        self._robots = {
            name: Robot(name, joints, self._stream(topics.JOINTS, robot=name)) for name, joints in outline.robots.items()
        }
        self._pads = {
            name: Pad(name, found.electrodes, found.limit_V, self._stream(topics.VOLTAGES, pad=name))
            for name, found in outline.pads.items()
        }

    @property
    def name(self) -> str:
        """The name of the cell."""
        return self._outline.name

    @property
    def frame(self) -> str:
        """The name of the fixed frame of all poses."""
        return self._outline.frame

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets."""
        return self._outline.targets

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(self._cameras)

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots."""
        return tuple(self._robots)

    @property
    def pads(self) -> tuple[str, ...]:
        """Names of the skin's pads."""
        return tuple(self._pads)

    def camera(self, name: str) -> Camera:
        """A camera, to publish its images.

        Raises:
            LookupError: The cell has no camera of this name.
        """
        return self._one("camera", self._cameras, name)

    def robot(self, name: str) -> Robot:
        """A robot, to publish its joint angles.

        Raises:
            LookupError: The cell has no robot of this name.
        """
        return self._one("robot", self._robots, name)

    def pad(self, name: str) -> Pad:
        """A pad, to publish its voltages.

        Raises:
            LookupError: The cell has no pad of this name.
        """
        return self._one("pad", self._pads, name)

    def __repr__(self) -> str:
        return f"<cell {self.name!r} at {self._connection.where} with {', '.join(self.targets)}>"

    def _one(self, kind: str, known: Mapping[str, Sensor], name: str) -> Sensor:
        if name not in known:
            raise LookupError(f"no {kind} {name!r}; cell {self.name} has: {', '.join(known) or 'none'}")
        return known[name]

    def _target(self, name: str | None) -> str:
        """Checked name of a target; the first one where it is None."""
        if name is None:
            return self.targets[0]
        if name not in self.targets:
            raise LookupError(f"no target {name!r}; cell {self.name} has: {', '.join(self.targets)}")
        return name

    def _stream(self, topic: topics.Topic, rate_hz: float = 0.0, **names: str) -> Stream:
        ((kind, name),) = names.items()
        key = topic.at(cell=self.name, **names)
        return Stream(self._publishing_session, topic, key, f"{kind} {name}", max(topic.rate_hz, rate_hz))

    def _publishing_session(self) -> zenoh.Session:
        """Session in which sensors publish. Raises bus.BusError."""
        with self._opening:
            if self._closing.is_set():
                raise bus.BusError(f"cell {self.name} is closed: publish inside of `with penumbra.connect() as cell`")
            if self._publishing is None:
                images = sum(3 * camera.width * camera.height for camera in self._cameras.values())
                pool_bytes = max(bus.POOL_BYTES, FRAMES_UNDER_WAY * images)
                connection = replace(self._connection, service=access.DRIVER, pool_bytes=pool_bytes)
                self._publishing = bus.open_session(connection, self._closing, lambda: None, PUBLISH_S)
            return self._publishing

    @contextlib.contextmanager
    def _reading(self) -> Iterator[None]:
        """Raises bus.BusError in place of Zenoh's error where the session is closed."""
        try:
            yield
        except zenoh.ZError as error:
            raise bus.BusError(f"cell {self.name} cannot be read ({short(error)}): is the cell closed?") from None

    def _why_silent(self) -> str:
        """Reason why no poses arrive, as far as it can be found, as text. Raises bus.BusError where the cell is closed."""
        with self._reading():
            if not self._session.info.routers_zid():
                return f"the router at {self._connection.where} does not answer; poses go on when it is back"
            if running.ask(self._session, self.name, "fusion", LOOK_S):
                return f"fusion of cell {self.name} runs: give a longer timeout, or see `penumbra doctor`"
        return f"no fusion of cell {self.name} answers: start `penumbra fusion` or `penumbra up`"

    def _ask_pose(self, at: int | None, target: str | None, timeout: float) -> Pose:
        name = self._target(target)
        parameters = "" if at is None else f"stamp_ns={at}"
        answers: list[bytes] = []
        with self._reading(), contextlib.suppress(bus.TimedOut):
            answers = bus.ask(self._session, topics.current_pose(self.name, name), parameters, timeout_s=timeout)
        if not answers:
            raise TimeoutError(f"no pose of {name} within {timeout:g} s: {self._why_silent()}")
        return Pose.of(decode(FusedPose, answers[0]))

    def _ask_health(self) -> tuple[running.Instance, ...]:
        with self._reading():
            return tuple(running.ask(self._session, self.name))

    def _leave(self) -> None:
        self._closing.set()
        self._close_session()
        with self._opening:
            if self._publishing is not None:
                self._publishing.close()


class Cell(CellBase):
    """A running cell, as returned by `penumbra.connect`. Threads may share it, but not one sensor or one iterator over poses."""

    def poses(self, target: str | None = None, *, timeout: float | None = None) -> Poses:
        """Iterates over the poses of a target. Each is the newest at the moment it is taken: fusion publishes 200 per second, and
        a slow reader skips some. Poses are also published while the target is lost; see their `state`. When the router or fusion
        ends and starts again, the poses resume.

        Args:
            target: Its name. Default: the cell's first.
            timeout: Maximum wait for each pose [s]. After it the iterator raises TimeoutError, which says why there is none.
                None waits forever.

        Raises:
            LookupError: The cell has no target of this name.
            BusError: The cell is closed.
        """
        name = self._target(target)
        with self._reading():
            return Poses(self._session, topics.FUSED.at(cell=self.name, target=name), timeout, self._why_silent)

    def pose(self, *, at: int | None = None, target: str | None = None, timeout: float = 1.0) -> Pose:
        """Asks fusion for the pose of a target. The answer uses all measurements that fusion has received so far.

        Args:
            at: A time within about the last second [ns since the epoch], such as the stamp of an image. None: now.
            target: Its name. Default: the cell's first.
            timeout: Maximum wait for the answer [s].

        Raises:
            TimeoutError: Nobody answered; the text says why.
            LookupError: The cell has no target of this name.
            ValueError: The time is outside of fusion's history.
            BusError: The cell is closed.
        """
        return self._ask_pose(at, target, timeout)

    def health(self) -> tuple[running.Instance, ...]:
        """The state of each process of the cell: `service`, `instance`, `status` (ok, starting, degraded or down), `reasons`.

        Raises:
            BusError: The cell is closed.
        """
        return self._ask_health()

    def close(self) -> None:
        """Leaves the bus; loops over poses end."""
        self._leave()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
