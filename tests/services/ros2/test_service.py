"""`penumbra ros2` between the cell's bus and a router like rmw_zenohd, with a ROS node in peer mode behind that."""

import time
from typing import Any

import cv2
import numpy as np
import pytest

from penumbra.services.ros2 import convert, names
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.contract.messages import FusedPose, Source
from penumbra.tests.support import ros
from penumbra.tests.support.live import free_port, stays, wait_for

ARM = cells.load("arm")
Q = np.array([0.1, -0.2, 0.1, -2.0, 0.2, 1.8, 0.7])
JOINTS = ARM.robots["panda"].joints
STEP_S = 0.02


def fused(state="tracking", x=0.0):
    return FusedPose(
        stamp_ns=time.time_ns(),
        target="forearm",
        frame="world",
        position=np.array([x, -0.2, 0.62]),
        orientation=np.array([0.0, 0.0, 0.0, 1.0]),
        velocity=np.zeros(6),
        covariance=np.diag([1e-4, 4e-4, 2e-4, 1e-3, 1e-3, 1e-3]),
        state=state,
        sources={"vision": Source(age_s=0.05, weight=0.7)},
    )


class Cell:
    """What the other processes of the cell would send: poses, joints, voltages, frames and masks."""

    def __init__(self, node):
        self.node = node
        self.state = "tracking"
        rng = np.random.default_rng(2)
        self.image = rng.integers(90, 120, (480, 640, 3), np.uint8)

    def send(self):
        self.send_pose()
        self.node.publish(topics.JOINTS, messages.Joints(stamp_ns=time.time_ns(), position=Q), robot="panda")

    def send_pose(self):
        self.node.publish(topics.FUSED, fused(self.state), target="forearm")

    def send_picture(self):
        stamp_ns = time.time_ns()
        labels = np.full((48, 64), 4, np.uint8)
        self.node.publish(topics.FRAME, messages.Frame(stamp_ns=stamp_ns, image=self.image), camera="side")
        mask = messages.Mask(stamp_ns=stamp_ns, labels=labels, x0=100, y0=100, scale=2)
        volts = np.full((5, 5), 0.6, np.float32)
        for pad in ARM.pads:
            self.node.publish(topics.VOLTAGES, messages.Voltages(stamp_ns=stamp_ns, period_ns=1_000_000, volts=volts), pad=pad)
        time.sleep(STEP_S)  # the frame is there before its mask, as it is in a cell
        self.node.publish(topics.MASK, mask, camera="side")


@pytest.fixture
def cell(world):
    with world.node("cell") as node:
        yield Cell(node)


def heard(peer, subscriber, kind, act=lambda: None):
    """The first message that comes while `act` is called again and again."""
    sample = wait_for(lambda: next(iter(ros.taken(subscriber)), None), 20, kind, STEP_S, act)
    return peer.ros.decode(kind, sample.payload.to_bytes())


def reasons(node):
    return "; ".join(node.report().reasons)


def test_a_ros_node_in_peer_mode_reads_poses_with_what_rmw_zenoh_attaches_to_them(world, peer, cell):
    subscriber = peer.subscribe("/penumbra/forearm/pose", convert.POSE)
    samples: list[Any] = []
    with world.service():

        def some():
            samples.extend(ros.taken(subscriber))
            return len(samples) >= 4

        wait_for(some, 20, "poses", STEP_S, cell.send)
        tokens = peer.tokens()
    attached = [names.ATTACHMENT.unpack(sample.attachment.to_bytes()) for sample in samples]
    assert [number for number, *_ in attached] == list(range(attached[0][0], attached[0][0] + len(samples)))
    assert all(abs(time.time_ns() - stamp_ns) < 60e9 and length == 16 for _, stamp_ns, length, _ in attached)
    (own,) = [token for token in tokens if "%penumbra%forearm%pose/" in token]
    assert own.split("/")[5] == "MP" and attached[0][3] == names.gid(own), "the gid is that of the publisher's token"
    pose = peer.ros.decode(convert.POSE, samples[-1].payload.to_bytes())
    assert pose.header.frame_id == "world" and pose.pose.pose.position.z == 0.62
    assert pose.pose.covariance[7] == 4e-4


def test_the_ros_graph_shows_one_node_with_all_its_topics(world, peer, cell):
    with world.service("--joints", "/joint_states"):
        tokens = wait_for(lambda: len(found := peer.tokens()) == 10 and found, 20, "the tokens")
    parts = [token.split("/") for token in tokens]
    assert {(part[7], part[8]) for part in parts} == {("%penumbra", "ros2")}
    assert sorted((part[5], part[9].replace("%", "/"), part[-1]) for part in parts if part[5] != "NN") == [
        ("MP", "/diagnostics", "::,10:,:,:,,"),
        ("MP", "/penumbra/forearm/pose", "::,10:,:,:,,"),
        ("MP", "/penumbra/forearm/twist", "::,10:,:,:,,"),
        ("MP", "/penumbra/markers", "::,1:,:,:,,"),
        ("MP", "/penumbra/side/camera_info", "::,2:,:,:,,"),
        ("MP", "/penumbra/side/overlay/compressed", "::,2:,:,:,,"),
        ("MP", "/tf", "::,100:,:,:,,"),
        ("MP", "/tf_static", ":1:,1:,:,:,,"),
        ("MS", "/joint_states", "::,10:,:,:,,"),
    ]


def test_a_lost_pose_is_not_sent_and_diagnostics_say_that_it_is_lost(world, peer, cell):
    poses, diagnostics = (
        peer.subscribe("/penumbra/forearm/pose", convert.POSE),
        peer.subscribe("/diagnostics", convert.DIAGNOSTICS),
    )
    with world.service():
        heard(peer, poses, convert.POSE, cell.send)
        cell.state = "lost"

        def is_told():
            cell.send()
            found = [peer.ros.decode(convert.DIAGNOSTICS, sample.payload.to_bytes()) for sample in ros.taken(diagnostics)]
            return any(status.message == "lost" for message in found for status in message.status)

        wait_for(is_told, 20, "a diagnosis of the lost target", STEP_S)
        ros.taken(poses)
        assert stays(lambda: cell.send() or not ros.taken(poses), 0.5), "no pose while it is lost"
        cell.state = "coasting"
        heard(peer, poses, convert.POSE, cell.send)


def test_frames_that_do_not_move_reach_a_ros_node_that_comes_later_and_links_follow_the_joints(world, peer, cell):
    with world.service():
        wait_for(lambda: any("%tf_static" in token for token in peer.tokens()), 20, "the token of /tf_static")
        late = peer.subscribe_latched("/tf_static", convert.TF)
        still = heard(peer, late, convert.TF)
        assert {"side_optical_frame", "panda_link0", "p0"} <= {each.child_frame_id for each in still.transforms}
        tf = peer.subscribe("/tf", convert.TF)
        found = {}

        def is_whole():
            cell.send()
            for sample in ros.taken(tf):
                found.update(
                    {each.child_frame_id: each for each in peer.ros.decode(convert.TF, sample.payload.to_bytes()).transforms}
                )
            return {"forearm", "panda_link7"} <= found.keys()

        wait_for(is_whole, 20, "the arm's and the links' frames", STEP_S)
    assert found["forearm"].header.frame_id == "world" and found["forearm"].transform.translation.z == 0.62
    assert found["panda_link7"].header.frame_id == "panda_link6"


@pytest.mark.parametrize(("parts", "expected"), [("cell", {"panda_link0"}), ("none", set())])
def test_frames_that_others_have_are_left_to_them(world, peer, cell, parts, expected):
    with world.service("--tf", parts) as node:

        def all_there():
            found = {token.split("/")[9].replace("%", "/") for token in peer.tokens() if "/MP/" in token}
            return found if found == node.report().report["ros"]["published"].keys() else None

        topics_of = wait_for(all_there, 20, "the tokens of all that is published")
        assert ("/tf_static" in topics_of) == (parts != "none")
        if expected:
            still = heard(peer, peer.subscribe_latched("/tf_static", convert.TF), convert.TF)
            links = {each.child_frame_id for each in still.transforms if each.child_frame_id.startswith("panda")}
            assert links == expected


def test_pictures_and_markers_are_made_while_somebody_in_ros_reads_them(world, peer, cell):
    with world.service() as node:

        def send():
            cell.send()
            cell.send_picture()

        def sent():
            return node.report().report["ros"]["published"]

        reader = peer.subscribe("/penumbra/forearm/pose", convert.POSE)
        wait_for(lambda: sent()["/penumbra/forearm/pose"] > 5, 20, "poses", STEP_S, send)
        assert ros.taken(reader) and not sent()["/penumbra/forearm/twist"]
        assert not sent()["/penumbra/side/overlay/compressed"] and not sent()["/penumbra/markers"]
        picture = heard(
            peer, peer.subscribe("/penumbra/side/overlay/compressed", convert.COMPRESSED_IMAGE), convert.COMPRESSED_IMAGE, send
        )
        info = heard(peer, peer.subscribe("/penumbra/side/camera_info", convert.CAMERA_INFO), convert.CAMERA_INFO, send)
        markers = heard(peer, peer.subscribe("/penumbra/markers", convert.MARKERS), convert.MARKERS, send)
    assert picture.header.frame_id == info.header.frame_id == "side_optical_frame"
    image = cv2.imdecode(picture.data, cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (480, 640, 3) and picture.format.endswith("jpeg compressed bgr8")
    blue, green, red = image[150, 170].astype(int)  # in the mask, whose forearm is green
    assert green > red + 20 and green > blue + 20
    assert abs(info.k[0] - ARM.cameras["side"].fx) < 1e-9
    assert [(each.ns, each.text) for each in markers.markers] == [
        ("target", "forearm"), ("covariance", "forearm"), *(("pads", name) for name in ARM.pads)
    ]  # fmt: skip


def test_diagnostics_have_the_health_of_every_process(world, peer, cell):
    subscriber = peer.subscribe("/diagnostics", convert.DIAGNOSTICS)
    with world.service():

        def processes():
            found = [peer.ros.decode(convert.DIAGNOSTICS, sample.payload.to_bytes()) for sample in ros.taken(subscriber)]
            return {status.name.split()[2] for message in found for status in message.status} >= {"cell", "ros2", "target"}

        wait_for(processes, 20, "both processes and the target", STEP_S, cell.send)


# ---- what comes in


def joint_state(peer, positions, stamp_ns=None):
    return peer.ros.make(
        convert.JOINT_STATE,
        header=convert.header(peer.ros, time.time_ns() if stamp_ns is None else stamp_ns, ""),
        name=list(positions),
        position=np.array(list(positions.values()), float),
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )


def test_joints_of_ros_become_the_joints_of_the_cell_by_their_names(world, peer, cell):
    latest = cell.node.latest(topics.JOINTS, from_others=True)
    shuffled = dict(reversed([("panda_finger_joint1", 0.02), *zip(JOINTS, Q, strict=True)]))
    with world.service("--joints", "/joint_states") as node:
        send = lambda: peer.publish("/joint_states", convert.JOINT_STATE, joint_state(peer, shuffled))  # noqa: E731
        found = wait_for(lambda: latest.get(robot="panda"), 20, "joints", STEP_S, send)
        np.testing.assert_array_equal(found.position, Q)
        wait_for(lambda: "/joint_states" not in reasons(node), 20, "no reason", STEP_S, send)


def test_missing_joints_and_bad_stamps_of_ros_are_named_in_the_health_report(world, peer, cell):
    with world.service("--joints", "panda=/joint_states") as node:
        some = dict(zip(JOINTS[:5], Q, strict=False))
        send = lambda: peer.publish("/joint_states", convert.JOINT_STATE, joint_state(peer, some))  # noqa: E731
        missing = "/joint_states: robot panda lacks the joints panda_joint6, panda_joint7"
        wait_for(lambda: missing in reasons(node), 20, missing, STEP_S, send)
        old = lambda: peer.publish(  # noqa: E731
            "/joint_states", convert.JOINT_STATE, joint_state(peer, dict(zip(JOINTS, Q, strict=True)), 1_000_000_000)
        )
        wait_for(lambda: "/joint_states: Joints: expected a stamp at most" in reasons(node), 20, "a bad stamp", STEP_S, old)
        wait_for(lambda: "/joint_states: no sensor_msgs/msg/JointState for" in reasons(node), 20, "silence")


@pytest.mark.parametrize("topic", ["/camera/image_raw", "/camera/image_raw/compressed"])
def test_pictures_of_ros_become_frames_of_the_cell(world, peer, cell, topic):
    image = np.zeros((480, 640, 3), np.uint8)
    image[...] = (200, 40, 20)

    def send():
        head = convert.header(peer.ros, time.time_ns(), "camera")
        if topic.endswith("/compressed"):
            _, jpeg = cv2.imencode(".jpg", image[..., ::-1])
            message = peer.ros.make(convert.COMPRESSED_IMAGE, header=head, format="jpeg", data=jpeg.reshape(-1))
            peer.publish(topic, convert.COMPRESSED_IMAGE, message)
        else:
            message = peer.ros.make(
                convert.IMAGE, header=head, height=480, width=640, encoding="bgr8", is_bigendian=0, step=1920,
                data=np.ascontiguousarray(image[..., ::-1]).reshape(-1),
            )  # fmt: skip
            peer.publish(topic, convert.IMAGE, message)

    latest = cell.node.latest(topics.FRAME, from_others=True)
    with world.service("--image", f"side={topic}"):
        frame = wait_for(lambda: latest.get(camera="side"), 20, "a frame", 0.05, send)
    assert np.abs(frame.image.astype(int) - image).max() < 10


def test_a_picture_of_another_size_is_named_in_the_health_report(world, peer, cell):
    head = convert.header(peer.ros, time.time_ns(), "camera")
    small = peer.ros.make(convert.IMAGE, header=head, height=2, width=2, encoding="mono8", is_bigendian=0, step=2,
                          data=np.zeros(4, np.uint8))  # fmt: skip

    def send():
        small.header = convert.header(peer.ros, time.time_ns(), "camera")
        peer.publish("/image_raw", convert.IMAGE, small)

    with world.service("--image", "/image_raw") as node:
        why = "/image_raw: expected 640 x 480 pixels as in the cell file, got 2 x 2"
        wait_for(lambda: why in reasons(node), 20, why, STEP_S, send)


# ---- the router


def test_without_a_ros_router_the_reason_says_so_and_the_service_begins_when_one_comes(world, cell):
    why = f"no ROS router at tcp/127.0.0.1:{world.ros_port}: start `ros2 run rmw_zenoh_cpp rmw_zenohd`"
    with world.service() as node:
        wait_for(lambda: why in reasons(node), 20, why)
        session = ros.router(world.ros_port)
        with ros.peer(world.ros_port) as peer:
            heard(peer, peer.subscribe("/penumbra/forearm/pose", convert.POSE), convert.POSE, cell.send)
            wait_for(lambda: why not in reasons(node), 20, "no reason")
            still = peer.subscribe_latched("/tf_static", convert.TF)
            heard(peer, still, convert.TF)
        session.close()


def test_after_a_new_start_of_the_ros_router_everything_goes_on(world, cell):
    session = ros.router(world.ros_port)
    with world.service() as node:
        with ros.peer(world.ros_port) as peer:
            heard(peer, peer.subscribe("/penumbra/forearm/pose", convert.POSE), convert.POSE, cell.send)
        session.close()
        wait_for(lambda: "no ROS router" in reasons(node), 20, "a reason", STEP_S, cell.send)
        session = ros.router(world.ros_port)
        with ros.peer(world.ros_port) as peer:
            heard(peer, peer.subscribe("/penumbra/forearm/pose", convert.POSE), convert.POSE, cell.send)
            wait_for(lambda: any("%penumbra%forearm%pose" in token for token in peer.tokens()), 20, "the tokens")
            heard(peer, peer.subscribe_latched("/tf_static", convert.TF), convert.TF)
            wait_for(lambda: "no ROS router" not in reasons(node), 20, "no reason")
    session.close()


def test_a_node_that_ends_leaves_the_ros_graph(world, peer, cell):
    with world.service():
        wait_for(lambda: any("/ros2/" in token for token in peer.tokens()), 20, "the tokens")
    wait_for(lambda: not peer.tokens(), 20, "an empty graph")


def test_a_ros_router_linked_to_the_cell_s_own_router_is_enough(router, cell):
    """Where Penumbra's router has the port of ROS, rmw_zenohd on another one calls it, and the service stays at Penumbra's."""
    from penumbra.tests.services.ros2.conftest import World

    port = free_port()
    linked = ros.router(port, (router,))
    with World(router, int(router.rpartition(":")[2])).service(), ros.peer(port) as peer:
        heard(peer, peer.subscribe("/penumbra/forearm/pose", convert.POSE), convert.POSE, cell.send)
        assert any("%penumbra%forearm%pose" in token for token in peer.tokens())
    linked.close()


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--domain", "233"], "--domain: expected a domain of ROS from 0 to 232, got '233'"),
        (["--joints", "joint_states"], "--joints: expected a name of ROS such as /joint_states"),
        (["--image", "=/image"], "--image: expected NAME=TOPIC, got '=/image'"),
        (["--namespace", "penumbra"], "--namespace: expected a name of ROS"),
        (["--joints", "ur5=/joint_states"], "ur5"),
        (["--ros-connect", "localhost:7448"], "endpoint: expected PROTOCOL/ADDRESS"),
    ],
)
def test_a_wrong_command_line_is_refused_with_a_reason(world, words, why, capsys):
    from penumbra.services.command import cli

    with pytest.raises(SystemExit) as ended:
        raise SystemExit(cli.main(["ros2", "--cell", "arm", "--connect", world.endpoint, *words]))
    assert ended.value.code == 2
    assert why in capsys.readouterr().err
