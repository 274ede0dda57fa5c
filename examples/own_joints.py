"""Publishes the joint angles of a robot, 50 times a second.

    penumbra up --cell mycell.yaml               # in another terminal; a cell file without `sim` starts no emulator
    python examples/own_joints.py

Put the call of your robot into `measure`. Angles are in radians, in the order of `robot.joints`.
"""

import contextlib
import math
import sys
import time

import numpy as np

import penumbra


def measure(joints: tuple[str, ...]) -> tuple[np.ndarray, int]:
    """The joint angles [rad] and the moment when they were measured [ns since the epoch]. Here: a robot that sways."""
    stamp_ns = time.time_ns()
    return np.full(len(joints), 0.2 * math.sin(stamp_ns * 1e-9)), stamp_ns


def main() -> None:
    with penumbra.connect() as cell:
        if not cell.robots:
            print(f"expected a cell with a robot, got {cell.name}, which has none", file=sys.stderr)
            sys.exit(2)
        robot = cell.robot(cell.robots[0])
        print(f"robot {robot.name}: {', '.join(robot.joints)}", flush=True)
        while True:
            robot.publish(*measure(robot.joints))
            time.sleep(0.02)


if __name__ == "__main__":
    try:
        with contextlib.suppress(KeyboardInterrupt):
            main()
    except penumbra.BusError as error:  # no router, no cell
        sys.exit(str(error))
