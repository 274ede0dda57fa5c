"""Against two independent programs that speak rmw_zenoh's language: zenoh-ros2-sdk (keys, tokens, attachments, messages both
ways, the graph) and pamoja-ros2 (keys).

docs/ros2.md says how their environment is made; PENUMBRA_ROS_VENVS is the folder in which it is.
"""

import time
from functools import partial

import numpy as np
import pytest

from penumbra.services.ros2 import convert, names
from penumbra.services.ros2.cdr import Types
from penumbra.services.ros2.names import Profile
from penumbra.shared.contract import topics
from penumbra.tests.services.ros2.test_service import JOINTS, Cell, Q
from penumbra.tests.support import ros
from penumbra.tests.support.live import wait_for

ROS = Types("kilted")
KINDS = (
    convert.POSE, convert.TWIST, convert.TF, convert.CAMERA_INFO, convert.COMPRESSED_IMAGE, convert.IMAGE, convert.MARKERS,
    convert.DIAGNOSTICS, convert.JOINT_STATE,
)  # fmt: skip
ZID = "aac3178e146ba6f1fc6e6a4085e77f21"


@pytest.fixture
def others(ros_router, ros_port, tmp_path):
    """Both programs. What one of them writes to git's configuration and clones would be under tmp_path."""
    found = ros.Answering(
        "peers",
        "ros_peers.py",
        str(ros_port),
        GIT_CONFIG_GLOBAL=str(tmp_path / "gitconfig"),
        ZENOH_ROS2_SDK_CACHE=str(tmp_path / "cache"),
    )
    yield found
    found.close()
    assert not list(tmp_path.iterdir()), "nothing was cloned, and git's configuration is as it was"


def test_both_have_our_keys(others):
    for kind in KINDS:
        for domain, name in ((0, "/penumbra/forearm/pose"), (7, "/tf")):
            assert others.ask(key=[domain, name, kind, ROS.hash(kind)]) == names.topic_key(domain, name, kind, ROS.hash(kind))


@pytest.mark.parametrize("namespace", ["/", "/penumbra", "/cell/one"])
def test_an_independent_program_has_our_tokens(others, namespace):
    node = names.Node(3, ZID, namespace, "ros2")
    described = [3, ZID, 0, "ros2", namespace]
    assert others.ask(node=described) == names.node_token(node)
    for profile in (Profile(10), Profile(1, is_latched=True), Profile(1, is_reliable=False)):
        for what in ("MP", "MS"):
            kind, hash = convert.POSE, ROS.hash(convert.POSE)
            theirs = others.ask(endpoint=[described, 4, what, "/a/pose", names.dds_type(kind), hash, str(profile)])
            assert theirs == names.endpoint_token(node, 4, what, "/a/pose", kind, hash, profile)


def test_an_independent_program_reads_our_attachment(others):
    gid = names.gid(names.node_token(names.Node(3, ZID, "/", "ros2")))
    assert others.ask(attachment=names.attachment(12, 1_700_000_000_000_000_001, gid).hex()) == [
        12, 1_700_000_000_000_000_001, gid.hex()
    ]  # fmt: skip


def test_an_independent_ros_node_finds_and_reads_the_pose_and_the_cell_reads_its_joints(world, others):
    with world.node("cell") as node, world.service("--joints", "/joint_states"):
        cell, latest = Cell(node), node.latest(topics.JOINTS, from_others=True)

        def found():
            return dict(others.ask(topics=ros.DOMAIN)).get("/penumbra/forearm/pose")

        assert wait_for(found, 30, "the pose in the graph") == [convert.POSE]
        at = {"domain": ros.DOMAIN, "hash": ROS.hash(convert.POSE), "topic": "/penumbra/forearm/pose"}
        pose = wait_for(partial(others.ask, hear=convert.POSE, **at), 30, "the pose", 0.02, cell.send_pose)
        assert pose["frame"] == "world" and pose["position"] == [0.0, -0.2, 0.62] and pose["covariance"][7] == 4e-4
        at = {"domain": ros.DOMAIN, "hash": ROS.hash(convert.JOINT_STATE), "topic": "/joint_states"}
        shuffled = dict(reversed(list(zip(JOINTS, (Q + 0.5).tolist(), strict=True))))

        def say():
            others.ask(say=convert.JOINT_STATE, joints=shuffled, stamp_ns=time.time_ns(), **at)

        joints = wait_for(lambda: latest.get(robot="panda"), 30, "joints", 0.02, say)
        np.testing.assert_array_equal(joints.position, Q + 0.5)
