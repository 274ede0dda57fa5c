"""What a driver of a robot is, and the drivers that there are.

An adapter of one's own is a class with these three methods, in a module beside the cell file or in an installed package.
It is named as `adapter:MODULE:CLASS`:

    class MyRobot:
        def __init__(self):                       # connects; an exception where it cannot
            self.sdk = mysdk.connect("192.168.0.5", timeout=2)

        def read(self):                           # waits for the next measurement, at most a second
            state = self.sdk.wait_state()         # an exception where the robot is gone
            joints = dict(zip(state.joint_names, state.angles))        # by name, in radians (or metres)
            return joints, state.controller_time                       # seconds of its own clock, or None

        def close(self):
            self.sdk.close()
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from penumbra.shared.cell.description import CellError, JointSource
from penumbra.shared.runtime.adapter import load

Reading = tuple[dict[str, float], float | None]
"""Joint angles [rad] or displacements [m] by name, and their time by the controller's own clock [s], None if unknown."""
UR_HZ = 125.0
"""Data packages per second: the maximum of a CB3; an e-Series also supports it."""
FRANKA_S = 0.01
"""Time [s] between two readings of a controller that sends a thousand per second."""
SILENCE_S = 1.0
"""Time [s] without data after which a controller counts as lost."""
LOOK_S, LONG_LOOK_S = 0.002, 0.05
"""Period [s] of checks for a data package. A longer check counts as LONG_LOOK_S: then this process was delayed, not the
controller."""
UR_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""Names of the joints in the URDFs of Universal Robots, from the base on."""
FRANKA_JOINTS = tuple(f"joint{i}" for i in range(1, 8))


class Driver(Protocol):
    """A connection to a robot, used by one thread."""

    def read(self) -> Reading:
        """Wait for the next measurement, at most about a second. Raises OSError if the robot is gone."""

    def close(self) -> None:
        """Close the connection."""


class UniversalRobots:
    """A controller of Universal Robots, CB3 from software 3.3 on and e-Series, by RTDE on port 30004."""

    def __init__(self, address: str):
        from rtde_receive import RTDEReceiveInterface

        try:
            self._receive = RTDEReceiveInterface(address, UR_HZ, ["timestamp", "actual_q"])
        except RuntimeError as error:  # any failure
            raise OSError(f"no controller of Universal Robots at {address}: {_line(error)}") from None
        self._address = address
        self._last_s = 0.0

    def read(self) -> Reading:
        silent_s, looked_s = 0.0, time.monotonic()
        while silent_s < SILENCE_S:
            now_s = float(self._receive.getTimestamp())
            q = self._receive.getActualQ()
            # the next data package may have arrived between the two calls
            if now_s != self._last_s and len(q) == len(UR_JOINTS) and now_s == self._receive.getTimestamp():
                self._last_s = now_s
                return dict(zip(UR_JOINTS, map(float, q), strict=True)), now_s
            time.sleep(LOOK_S)
            silent_s += min(time.monotonic() - looked_s, LONG_LOOK_S)
            looked_s = time.monotonic()
        raise OSError(f"the controller at {self._address} has sent nothing for {SILENCE_S:g} s")

    def close(self) -> None:
        self._receive.disconnect()


class Franka:
    """A controller of Franka (Panda, FR3) by the Franka Control Interface, which must be enabled in Desk. It serves one client at
    a time: if another program moves the robot, that program must publish the joints."""

    def __init__(self, address: str):
        from panda_py import libfranka

        self._address = address
        try:
            self._robot = libfranka.Robot(address, libfranka.RealtimeConfig.kIgnore)
        except RuntimeError as error:
            raise OSError(f"no controller of Franka at {address}: {_line(error)}") from None

    def read(self) -> Reading:
        time.sleep(FRANKA_S)
        try:
            state = self._robot.read_once()
        except RuntimeError as error:
            raise OSError(f"the controller at {self._address} is gone: {_line(error)}") from None
        return dict(zip(FRANKA_JOINTS, map(float, state.q), strict=True)), float(state.time.to_sec())

    def close(self) -> None:
        del self._robot  # libfranka closes with its last reference


class Adapted:
    """A robot by a user's class, whose exceptions count as a lost robot."""

    def __init__(self, kind: type[Any]):
        self._kind = kind.__name__
        self._own = self._guarded("", kind)

    def read(self) -> Reading:
        got = self._guarded(".read", self._own.read)
        match got:
            case (dict() as joints, (int() | float() | None) as clock_s):
                return self._guarded(".read", lambda: {str(name): float(angle) for name, angle in joints.items()}), clock_s
        what = "expected (joints, clock_s), a dict of angles by name and a number or None"
        raise OSError(f"{self._kind}.read: {what}, got {type(got).__name__}")

    def close(self) -> None:
        self._guarded(".close", self._own.close)

    def _guarded(self, what: str, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except OSError:  # in the adapter's own words
            raise
        except Exception as error:
            raise OSError(f"{self._kind}{what}: {type(error).__name__}: {error}") from error


DRIVERS: dict[str, tuple[type[UniversalRobots] | type[Franka], str, str, str]] = {
    "ur": (UniversalRobots, "rtde_receive", "ur", ""),
    "panda": (Franka, "panda_py", "panda", "panda_"),
}
"""By the kind of a source: driver, the module that it needs, the extra that installs it, and the prefix of joint names."""


def opener(source: JointSource, folder: Path) -> Callable[[], Driver]:
    """A function that connects to a source; folder: additional search path for an adapter's module. Raises CellError if a package
    or the adapter's class is missing."""
    if source.kind == "adapter":
        return partial(Adapted, load(source.place, folder, "docs/robot-joints.md"))
    driver, module, extra, _ = DRIVERS[source.kind]
    if importlib.util.find_spec(module) is None:
        raise CellError(f"{source.url}: {module} is not installed: pip install -e '.[{extra}]'")
    return lambda: driver(source.place)


def prefix(source: JointSource) -> str:
    """The prefix of the cell's joint names relative to the driver's."""
    if source.prefix is not None:
        return source.prefix
    return DRIVERS[source.kind][3] if source.kind in DRIVERS else ""


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
