"""Takes part in ROS 2 on Zenoh (rmw_zenoh) without ROS: poses, frames, pictures, markers and diagnostics go out; joints and
pictures of ROS come in where --joints and --image name their topics.

It meets the ROS nodes at their Zenoh router (`ros2 run rmw_zenoh_cpp rmw_zenohd`), which listens on port 7447 as Penumbra's own
does: one of the two needs another port.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from penumbra.services import flags
from penumbra.services.ros2 import convert, incoming, names
from penumbra.services.ros2.cdr import DISTRIBUTIONS, Types
from penumbra.services.ros2.names import Profile
from penumbra.services.ros2.outgoing import Diagnosis, Overlay, Poses, Scene, Shown
from penumbra.services.ros2.participant import LOOK_S, Participant, Subscription
from penumbra.shared.body.robot import robot_models
from penumbra.shared.contract import messages, report, topics
from penumbra.shared.contract.messages import Frame, FusedPose, Joints
from penumbra.shared.contract.topics import FRAME, FUSED, JOINTS, MASK, VOLTAGES
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.hang import HANG_S
from penumbra.shared.runtime.node import Node

NAME = "ros2"
ROS_ROUTER = "tcp/127.0.0.1:7447"
"""Default endpoint of rmw_zenohd."""
MARKERS_S, DIAGNOSTICS_S = 0.1, 1.0
TF_DEPTH = 100
"""Depth of tf2's own broadcasters."""
ASK_S = 0.4
"""Maximum time [s] to wait for the health reports."""
SILENT_S = 2.0
"""Time [s] without a message after which a topic of ROS is reported as missing."""


def domain(text: str) -> int:
    """Type of a flag: a domain of ROS."""
    if not text.isdecimal() or int(text) > names.MOST_DOMAINS:
        raise ValueError(f"expected a domain of ROS from 0 to {names.MOST_DOMAINS}, got {text!r}")
    return int(text)


def source(text: str) -> tuple[str | None, str]:
    """Type of a flag: NAME=TOPIC, or TOPIC alone."""
    name, found, topic = text.rpartition("=")
    if found and not name:
        raise ValueError(f"expected NAME=TOPIC, got {text!r}")
    return name or None, names.topic(topic)


FLAGS = (
    flags.Option(
        "--ros-connect",
        envvar="PENUMBRA_ROS_CONNECT",
        show_envvar=True,
        default=ROS_ROUTER,
        metavar="ENDPOINT",
        help="the Zenoh router of the ROS nodes",
    ),
    flags.Option(
        "--ros-config",
        type=Path,
        metavar="FILE",
        help="Zenoh configuration (JSON5) of the session at that router, for TLS say; it stays a client",
    ),
    flags.Option(
        "--domain", type=domain, envvar="ROS_DOMAIN_ID", show_envvar=True, default=0, metavar="N", help="domain of the ROS nodes"
    ),
    flags.Option("--distribution", choices=DISTRIBUTIONS, default="jazzy", help="of the ROS nodes: whose messages are spoken"),
    flags.Option("--namespace", type=names.namespace, default="/penumbra", help="of the node and its topics"),
    flags.Option(
        "--tf",
        choices=("all", "cell", "none"),
        default="all",
        help="frames to publish. cell: all but those of links, where robot_state_publisher has them",
    ),
    flags.Option(
        "--joints",
        type=source,
        multiple=True,
        metavar="[ROBOT=]TOPIC",
        help="read a robot's joints from a JointState, by their names; without ROBOT those of every robot. May be repeated",
    ),
    flags.Option(
        "--image",
        type=source,
        multiple=True,
        metavar="[CAMERA=]TOPIC",
        help="read a camera's pictures from an Image, or a CompressedImage where TOPIC ends in /compressed. May be repeated",
    ),
)
EXAMPLE = """\
penumbra ros2 --ros-connect tcp/localhost:7448                     # where Penumbra's router has port 7447
penumbra ros2 --joints /joint_states --image front=/camera/image_raw/compressed --tf cell"""


def start(node: Node, options: flags.Options) -> None:
    """Threads: poses, joints, frames and masks are passed on by their readers, of the cell and of ROS; shared data is in `Scene`.
    A separate timer opens the session at the ROS router, and closes it when the node stops."""
    ros = Types(options.distribution)
    connection = bus.Connection("client", (options.ros_connect,), config=options.ros_config)
    participant = Participant(ros, connection, options.domain, options.namespace, NAME, node.log)
    publish(node, ros, participant, options)
    sources = [*read_joints(node, participant, options.joints), *read_images(node, participant, options.image)]
    node.add_reasons(lambda: [*participant.reasons(), *(reason for each in sources for reason in each.reasons())])
    node.add_report("ros", lambda: describe(options, participant))
    node.every(LOOK_S, lambda: participant.serve(node.stopping), math.inf)


def publish(node: Node, ros: Types, participant: Participant, options: flags.Options) -> None:
    """Declare the published topics, and pass on the cell's messages."""
    cell, space = node.cell, options.namespace
    models = robot_models(cell)
    scene = Scene(cell, models, node.latest(VOLTAGES) if cell.pads else None, node.now_ns)
    tf = participant.publisher("/tf", convert.TF, Profile(TF_DEPTH)) if options.tf != "none" else None
    if options.tf != "none":
        still = participant.publisher("/tf_static", convert.TF, Profile(1, is_latched=True))
        found = convert.still_transforms(ros, cell, models, node.now_ns(), with_links=options.tf == "all")
        still.publish(convert.transforms(ros, found))
    poses = Poses(ros, participant, cell, space, tf)
    overlays = {camera: Overlay(ros, participant, scene, camera, space) for camera in cell.cameras}
    shown, diagnosis = Shown(ros, participant, scene, space), Diagnosis(ros, participant, scene)

    def on_fused(fused: FusedPose, names: dict[str, str]) -> None:
        scene.poses[names["target"]] = fused
        poses.send(fused)

    def on_joints(joints: Joints, names: dict[str, str]) -> None:
        robot = names["robot"]
        scene.joints[robot] = joints.position
        if tf is not None and options.tf == "all" and tf.is_wanted():
            tf.publish(
                convert.transforms(
                    ros, convert.link_transforms(ros, cell, robot, models[robot], joints.stamp_ns, joints.position)
                )
            )

    def diagnose() -> None:
        reports = [report.read(answer) for answer in node.query(topics.health(cell.name), timeout_s=ASK_S)]
        diagnosis.send(reports, node.now_ns())

    node.subscribe(FUSED, on_fused)
    if cell.robots:
        node.subscribe(JOINTS, on_joints)
    for camera, overlay in overlays.items():
        node.subscribe(FRAME, overlay.on_frame, camera=camera)
        node.subscribe(MASK, overlay.on_mask, from_others=True, camera=camera)  # no warning if missing: PoseCNN makes none
    node.every(MARKERS_S, shown.send)
    node.every(DIAGNOSTICS_S, diagnose, HANG_S + ASK_S)


class Source:
    """A topic of ROS that is read. why: faults of its messages, in words, besides refused ones."""

    def __init__(self, subscription: Subscription, why: Callable[[], Sequence[str]] = tuple):
        self._subscription, self._why = subscription, why
        self._began_s = time.monotonic()

    def reasons(self) -> list[str]:
        """Why the cell does not get this topic's data."""
        found = self._subscription
        silent_s = time.monotonic() - (found.last_s or self._began_s)
        if silent_s > SILENT_S:
            return [f"{found.topic}: no {found.kind} for {silent_s:.0f} s"]
        why = [found.why] if found.why else self._why() if found.last_s is not None else []
        return [f"{found.topic}: {each}" for each in why]


def read_joints(node: Node, participant: Participant, wanted: Sequence[tuple[str | None, str]]) -> list[Source]:
    """Subscribe to JointStates; a robot's joints may come from several topics. Raises CellError for a robot that the cell does
    not have, and if it has none."""
    robots_of: dict[str, set[str]] = {}
    for robot, topic in wanted:
        robots_of.setdefault(topic, set()).update([node.cell.one("robots", robot)] if robot else node.cell.robots)
        node.cell.one("robots", robot)
    collectors = {robot: incoming.Joints(node.cell.robots[robot].joints) for robots in robots_of.values() for robot in robots}
    lock = threading.Lock()

    def reader(topic: str, robots: Sequence[str]) -> Source:
        def on_message(message: Any) -> None:
            messages.check_stamp(Joints, incoming.stamp_ns(message), node.now_ns(), JOINTS.oldest_s)
            with lock:
                found = {robot: collectors[robot].add(message) for robot in robots}
            for robot, joints in found.items():
                if joints is not None:
                    stamp_ns, position = joints
                    node.publish(JOINTS, Joints(stamp_ns=stamp_ns, position=position), robot=robot)

        def missing() -> list[str]:
            return [
                f"robot {robot} lacks the joints {', '.join(collectors[robot].missing)}"
                for robot in robots
                if collectors[robot].missing
            ]

        return Source(participant.subscribe(topic, convert.JOINT_STATE, Profile(), on_message), missing)

    return [reader(topic, sorted(robots)) for topic, robots in robots_of.items()]


def read_images(node: Node, participant: Participant, wanted: Sequence[tuple[str | None, str]]) -> list[Source]:
    """Subscribe to pictures. Raises CellError for a camera that the cell does not have."""

    def reader(camera: str, topic: str) -> Source:
        is_compressed = topic.endswith("/compressed")
        kind = convert.COMPRESSED_IMAGE if is_compressed else convert.IMAGE
        decode = incoming.compressed_image if is_compressed else incoming.image

        def on_message(message: Any) -> None:
            stamp_ns = incoming.stamp_ns(message)
            messages.check_stamp(Frame, stamp_ns, node.now_ns(), FRAME.oldest_s)
            image = decode(message, node.cell.cameras[camera])
            node.publish(FRAME, Frame(stamp_ns=stamp_ns, image=image), camera=camera)

        return Source(participant.subscribe(topic, kind, Profile(1, is_reliable=False), on_message))

    return [reader(node.cell.one("cameras", camera), topic) for camera, topic in wanted]


def describe(options: flags.Options, participant: Participant) -> dict[str, Any]:
    """The entry in the health report: the ROS router, and counts of published and read messages."""
    return {
        "router": options.ros_connect,
        "domain": options.domain,
        "distribution": options.distribution,
        "published": {each.topic: each.count for each in participant.publishers},
        "read": {each.topic: each.count for each in participant.subscriptions},
        "refused": {each.topic: each.refused for each in participant.subscriptions},
    }
