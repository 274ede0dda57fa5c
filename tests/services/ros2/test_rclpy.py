"""Against the real rclpy of ROS distributions, in environments of their own: CDR both ways, type hashes, and the bridge to DDS.

docs/ros2.md says how the environments are made; PENUMBRA_ROS_VENVS is the folder in which they are.
"""

import dataclasses
import json
import subprocess
import threading
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest

from penumbra.services.ros2 import convert
from penumbra.services.ros2.cdr import Types
from penumbra.shared.contract import topics
from penumbra.tests.services.ros2.test_convert import STAMP_NS, every_message
from penumbra.tests.services.ros2.test_service import JOINTS, Cell, Q, joint_state
from penumbra.tests.support import ros
from penumbra.tests.support.live import PATIENCE_S, wait_for

DISTRIBUTIONS = ("jazzy", "kilted")
ROS = Types("kilted")
ABSENT = {convert.TF}
"""tf2_msgs has no wheel; what a TFMessage holds has one."""


@pytest.fixture(scope="module", params=DISTRIBUTIONS)
def rclpy(request):
    found = ros.Answering(request.param, "in_ros.py")
    yield found
    found.close()


def plain(message):
    """The fields of a message as JSON, in rosbags' classes, which have constants too, in capital letters."""
    if dataclasses.is_dataclass(message):
        names = [field.name for field in dataclasses.fields(message) if field.name != "__msgtype__"]
        return {name: plain(getattr(message, name)) for name in names if not name.isupper()}
    if isinstance(message, np.ndarray):
        return message.tolist()
    return [plain(each) for each in message] if isinstance(message, list | tuple) else message


def messages():
    """One of each type that goes out or comes in."""
    joints = joint_state(Here, dict(zip(JOINTS, Q, strict=True)), STAMP_NS)
    head = convert.header(ROS, STAMP_NS, "camera")
    image = ROS.make(convert.IMAGE, header=head, height=2, width=3, encoding="mono8", is_bigendian=0, step=3,
                     data=np.arange(6, dtype=np.uint8))  # fmt: skip
    out = every_message()
    return {**out, convert.JOINT_STATE: joints, convert.IMAGE: image, **inner(out[convert.TF])}


class Here:
    ros = ROS


def inner(tf):
    """What a TFMessage holds."""
    return {"geometry_msgs/msg/TransformStamped": tf.transforms[0]}


@pytest.mark.parametrize("kind", sorted(messages().keys() - ABSENT))
def test_rclpy_reads_what_we_write_and_we_read_what_rclpy_writes(rclpy, kind):
    message = messages()[kind]
    answer = rclpy.ask(decode=kind, cdr=ROS.encode(message).hex())
    fields = json.loads(json.dumps(plain(message)))
    assert fields_of(answer["fields"]) == fields_of(fields)
    written = ROS.decode(kind, bytes.fromhex(answer["cdr"]))
    assert fields_of(json.loads(json.dumps(plain(written)))) == fields_of(fields)


def fields_of(fields):
    """The fields with float32 numbers as they are on the wire."""
    if isinstance(fields, dict):
        if set(fields) == {"r", "g", "b", "a"}:
            return {name: float(np.float32(value)) for name, value in fields.items()}
        return {name: fields_of(value) for name, value in fields.items()}
    return [fields_of(each) for each in fields] if isinstance(fields, list) else fields


@pytest.mark.parametrize("kind", sorted(messages().keys() - ABSENT))
def test_type_hashes_are_those_that_the_ros_graph_shows(rclpy, kind):
    assert rclpy.ask(hash=kind) == ROS.hash(kind)


# ---- the bridge


@contextmanager
def bridge(distribution, port):
    """services/ros2/dds_bridge.py, run by a ROS that knows nothing of Penumbra; it ends as by Ctrl-C, without a traceback."""
    script = str(ros.ROOT / "services" / "ros2" / "dds_bridge.py")
    words = [f"tcp/127.0.0.1:{port}", str(ros.DOMAIN)]
    process = subprocess.Popen(
        [ros.python_of(distribution), script, *words], env=ros.environment(), stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    errors, lines = process.stderr, list[str]()
    threading.Thread(target=lambda: lines.extend(errors), daemon=True).start()
    try:
        yield lines
        assert process.poll() is None, "".join(lines)
        process.send_signal(2)
        assert process.wait(PATIENCE_S) == 0, "".join(lines)
        assert "Traceback" not in "".join(lines), "".join(lines)
    finally:
        process.kill()
        process.wait()


def test_a_ros_node_on_dds_reads_the_pose_and_the_cell_reads_its_joints(world, ros_router, ros_port):
    """Kilted's rclpy on Fast DDS, the bridge, `penumbra ros2`, and the bus of the cell."""
    ros.python_of("kilted")  # skips before anything is started
    with world.node("cell") as node, world.service("--joints", "/joint_states"), bridge("kilted", ros_port) as lines:
        cell, latest = Cell(node), node.latest(topics.JOINTS, from_others=True)
        wait_for(lambda: any("/joint_states from ROS" in line for line in lines), 60, "the bridge")
        listener = ros.Answering("kilted", "in_ros.py")
        hear = partial(listener.ask, hear=convert.POSE, topic="/penumbra/forearm/pose")
        pose = wait_for(hear, 60, "the pose in rclpy", 0.0, cell.send_pose)
        assert pose["header"]["frame_id"] == "world" and pose["pose"]["pose"]["position"]["z"] == 0.62
        assert pose["pose"]["covariance"][7] == 4e-4
        diagnosis = wait_for(partial(listener.ask, hear=convert.DIAGNOSTICS, topic="/diagnostics"), 60, "diagnostics", 0.0)
        assert any(status["name"].startswith("penumbra arm: ros2") for status in diagnosis["status"])
        assert any("left out /tf: ROS here has no tf2_msgs/TFMessage" in line for line in lines)

        def say():
            moved = joint_state(Here, dict(zip(JOINTS, Q + 0.25, strict=True)))
            listener.ask(say=convert.JOINT_STATE, topic="/joint_states", cdr=ROS.encode(moved).hex())

        found = wait_for(lambda: latest.get(robot="panda"), 60, "joints", 0.02, say)
        np.testing.assert_array_equal(found.position, Q + 0.25)
        listener.close()


def test_the_bridge_leaves_out_what_ends_and_takes_up_what_comes(world, ros_router, ros_port):
    ros.python_of("kilted")  # skips before anything is started
    with bridge("kilted", ros_port) as lines:
        for _ in range(2):
            lines.clear()
            with world.service("--tf", "none"):
                wait_for(lambda: any("forearm/pose to ROS" in line for line in lines), 60, "the bridge")
