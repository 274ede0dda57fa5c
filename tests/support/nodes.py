"""A small real service for the tests of the runtime: `python -m penumbra.tests.support.nodes SERVICE --connect ENDPOINT`.

It publishes the fused pose of the table's forearm at 100 Hz (where it owns it), answers the pose query, and counts frames; as
`camera` it sends them; as `hanging` its timer hangs after a second.
"""

from __future__ import annotations

import json
import sys
import threading
import time

import numpy as np

from penumbra.services import flags, run
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.runtime import bus, logs
from penumbra.shared.runtime.node import Node


def node_command(service: str, endpoint: str, *arguments: str) -> list[str]:
    """The command line of a small service of this file that connects to a router."""
    return [sys.executable, "-m", "penumbra.tests.support.nodes", service, "--connect", endpoint, *arguments]


def pose(stamp_ns: int | None = None, x: float = 0.0) -> messages.FusedPose:
    return messages.FusedPose(
        stamp_ns=time.time_ns() if stamp_ns is None else stamp_ns,
        target="forearm",
        frame="world",
        position=np.array([x, 0.0, 0.2]),
        orientation=np.array([0.0, 0.0, 0.0, 1.0]),
        velocity=np.zeros(6),
        covariance=1e-4 * np.eye(6),
        state="tracking",
        sources={"vision": messages.Source(age_s=0.05, weight=0.7), "haptic": messages.Source(age_s=0.01, weight=0.3)},
    )


def pose_json(target: str = "forearm") -> bytes:
    """Fusion's answer to a pose query with ?format=json."""
    now = pose()
    return json.dumps(
        {
            "target": target,
            "frame": now.frame,
            "stamp_ns": now.stamp_ns,
            "position": now.position.tolist(),
            "orientation": now.orientation.tolist(),
            "rpy": [0.0, 0.0, 0.0],
            "velocity": now.velocity.tolist(),
            "covariance": now.covariance.tolist(),
            "state": now.state,
            "sources": {name: {"age_s": source.age_s, "weight": source.weight} for name, source in now.sources.items()},
        }
    ).encode()


def start(node: Node) -> None:
    began = time.monotonic()

    def publish() -> None:
        if node.service == "hanging" and time.monotonic() - began > 1.0:
            threading.Event().wait()
        if node.owns("pose/forearm"):
            node.publish(topics.FUSED, pose(), target="forearm")

    node.every(0.01, publish)
    if node.service == "camera":
        image = np.zeros((480, 640, 3), np.uint8)
        node.every(0.05, lambda: node.publish(topics.FRAME, messages.Frame(stamp_ns=time.time_ns(), image=image), camera="front"))
    else:
        node.subscribe(topics.FRAME, lambda message, names: None)
    node.answer(topics.current_pose(node.cell.name, "forearm"), lambda parameters, payload: (pose_json(), "application/json"))


def main() -> None:
    options = flags.parse(flags.COMMON, sys.argv[2:])
    logs.configure(options.log_level, options.log_format, sys.argv[1])
    node = Node(sys.argv[1], cells.load(options.cell), bus.connection(options))
    start(node)
    node.run()
    sys.exit(run.leave())


if __name__ == "__main__":
    main()
