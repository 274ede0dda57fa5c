"""Publishes the joints of robots whose controllers the cell file names.

A source is ur:ADDRESS, panda:ADDRESS or adapter:MODULE:CLASS, a class of yours for any other robot. Give it with --source, or in
the cell file under `source:` of the robot: then `penumbra up` starts this process.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from penumbra.services import flags
from penumbra.services.robot import driver
from penumbra.services.robot.clock import ControllerClock
from penumbra.services.robot.driver import Driver, Reading
from penumbra.shared.body import urdf
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.explain import explain
from penumbra.shared.contract.messages import Joints
from penumbra.shared.contract.topics import JOINTS
from penumbra.shared.runtime.node import Node

NAME = "robot"
BACKOFF_S = (0.2, 1.0)
"""Initial and maximum delay [s] before a reconnection; the maximum is also the time that a cell waits for a controller that was
switched on."""
TOLD_EVERY = 60
"""Number of attempts after which a missing controller is logged again."""
LARGEST = 100.0
"""Maximum joint angle [rad] of a joint without limits; a larger one, beyond sixteen turns, is probably in degrees."""
BEYOND = 0.5
"""Distance [rad or m] beyond a joint's limits in the URDF up to which it is believed: limits differ between controllers and
URDFs, degrees and millimetres are farther away."""
SILENT_S = 3.0
"""Time [s] without a measurement after which a robot counts as faulty: a driver's `read` takes a second at most."""

FLAGS = (
    flags.Option(
        "--source",
        metavar="SOURCE",
        show_default="those of the cell file",
        help="ur:ADDRESS, panda:ADDRESS or adapter:MODULE:CLASS",
    ),
    flags.Option(
        "--robot",
        metavar="NAME",
        show_default="the cell's first, or all with a source in the cell file",
        shell_complete=flags.complete_part("robots"),
        help="the robot that --source belongs to",
    ),
    flags.Option(
        "--prefix",
        metavar="TEXT",
        show_default="panda_ of panda:, else none",
        help="what the cell's joints are called before the controller's names",
    ),
)
EXAMPLE = "penumbra robot --source ur:192.168.0.2\npenumbra robot --robot panda --source panda:172.16.0.2 --prefix fr3_"


def start(node: Node, options: flags.Options) -> None:
    """Start one thread per robot, which owns the robot's `Session`; the health report, in another thread, only reads."""
    for name, source in sources(node.cell, options).items():
        folder = node.cell.folder if options.source is None else Path.cwd()
        session = Session(node, name, source, folder.absolute())
        node.add_report(name, session.describe)
        node.add_reasons(session.reasons)
        node.every(BACKOFF_S[0], partial(Session.run, session), math.inf)


def sources(cell: cells.Cell, options: flags.Options) -> dict[str, cells.JointSource]:
    """The sources to read, by robot. Raises CellError if there is none, if one is invalid, or if the emulator moves the robot."""
    found = cell.joint_sources
    if options.source is not None:
        found = {cell.one("robots", options.robot): _checked(options.source, options.prefix)}
    elif options.robot is not None:
        name = cell.one("robots", options.robot)
        found = {each: source for each, source in found.items() if each == name}
    if not found:
        what = (
            f"robot {options.robot} of cell {cell.name} has no source"
            if options.robot
            else f"no robot of cell {cell.name} has one"
        )
        raise cells.CellError(f"{what}: give --source SOURCE, or `source:` of the robot in the cell file")
    if cell.sim is not None:
        raise cells.CellError(
            f"cell {cell.name} has `sim`: its emulator moves {', '.join(found)}; remove `sim` from the cell file"
        )
    return found


def _checked(url: str, prefix: str | None) -> cells.JointSource:
    try:
        return cells.JointSource(url=url, prefix=prefix)
    except ValidationError as error:
        reasons = "; ".join(reason for _, reason in explain(cells.JointSource, error.errors()))
        raise cells.CellError(f"--source: {reasons}") from None


class Session:
    """One robot from connecting until it is lost, repeatedly."""

    def __init__(self, node: Node, name: str, source: cells.JointSource, folder: Path):
        self._node, self._name, self._source = node, name, source
        self._open = driver.opener(source, folder)
        robot = node.cell.robots[name]
        self._joints = robot.joints
        moving = urdf.read(cells.urdf_path(robot, node.cell.folder)).joints
        self._limits = {joint.name: (joint.lower, joint.upper) for joint in moving}
        self._prefix = driver.prefix(source)
        self._state, self._fault = "connecting", ""
        self._connected = 0
        self._delay_s, self._failures = BACKOFF_S[0], 0
        self._last_ns = 0
        self._last_s = time.monotonic()
        self._is_clocked = False
        self._late_ms = 0.0

    def run(self) -> None:
        """Read until the node stops, or until the controller is gone; then wait and return, to be called again."""
        found: Driver | None = None
        try:
            found = self._open()
            self._connected += 1
            is_first, clock = True, ControllerClock()
            while not self._node.stopping.is_set():
                reading = found.read()
                if is_first:
                    self._node.log.info("connected", robot=self._name, source=self._source.url)
                is_first, self._last_s = False, time.monotonic()
                self._take(reading, clock, self._node.now_ns())
        except OSError as error:
            self._lost(str(error))
        finally:
            if found is not None:
                with suppress(OSError):
                    found.close()
        self._node.stopping.wait(self._delay_s)

    def _take(self, reading: Reading, clock: ControllerClock, arrival_ns: int) -> None:
        """Publish a measurement that has all joints of the cell."""
        joints, clock_s = reading
        q, self._fault = matched(joints, self._joints, self._prefix, self._limits)
        stamp_ns = clock.stamp(clock_s, arrival_ns)
        self._is_clocked, self._late_ms = clock_s is not None, (arrival_ns - stamp_ns) * 1e-6
        self._failures = 0
        self._state = "lost" if self._fault else "reading"
        if q is not None and stamp_ns > self._last_ns:
            self._last_ns = stamp_ns
            self._node.publish(JOINTS, Joints(stamp_ns=stamp_ns, position=q), robot=self._name)

    def _lost(self, error: str) -> None:
        if not self._failures % TOLD_EVERY:
            self._node.log.error(f"{error}; trying again", robot=self._name)
        self._state, self._fault = "lost", error
        self._delay_s = min(BACKOFF_S[0] * 2.0**self._failures, BACKOFF_S[1])
        self._failures += 1

    def reasons(self) -> list[str]:
        """Why no joints are published."""
        silent_s = time.monotonic() - self._last_s
        silence = f"no measurement for {silent_s:.0f} s from {self._source.url}" if silent_s > SILENT_S else ""
        fault = self._fault or silence
        return [f"robot {self._name}: {fault}"] if fault else []

    def describe(self) -> dict[str, Any]:
        """The robot's entry in the health report."""
        return {
            "state": self._state,
            "source": self._source.url,
            "fault": self._fault,
            "connected": self._connected,
            "stamps": "controller" if self._is_clocked else "arrival",
            "late_ms": round(self._late_ms, 2),
        }


def matched(
    joints: dict[str, float], wanted: tuple[str, ...], prefix: str, limits: Mapping[str, tuple[float, float]]
) -> tuple[np.ndarray | None, str]:
    """The angles (n,) of the cell's joints in order, None if one is missing or impossible; and the fault. limits: lower and upper
    limit of each joint in the URDF [rad or m]."""
    named = {f"{prefix}{name}": angle for name, angle in joints.items()}
    if missing := [name for name in wanted if name not in named]:
        return None, (
            f"expected joints {', '.join(missing)}, got {', '.join(named) or 'none'}; correct `joints` in the cell "
            "file, or the prefix"
        )
    q = np.array([named[name] for name in wanted], np.float64)
    if not np.abs(q).max() <= LARGEST:
        return None, f"expected joints of at most {LARGEST:g} rad, got {np.abs(q).max():g}: are these degrees?"
    low, high = np.array([limits[name] for name in wanted]).T
    if beyond := [i for i in range(len(q)) if not low[i] - BEYOND <= q[i] <= high[i] + BEYOND]:
        got = ", ".join(f"{wanted[i]} {q[i]:g} ({low[i]:g} to {high[i]:g})" for i in beyond)
        return None, f"expected joints within the limits of the URDF, got {got}: are these degrees, or millimetres?"
    return q, ""
