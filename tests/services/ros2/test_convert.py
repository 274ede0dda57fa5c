"""Messages of Penumbra as messages of ROS: conventions, frames, and that every message survives its CDR."""

import time
from typing import Any

import numpy as np
import pytest

from penumbra.services.ros2 import convert
from penumbra.services.ros2.cdr import DISTRIBUTIONS, Types
from penumbra.services.ros2.markers import Markers, ellipsoid
from penumbra.shared.body import anatomy
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.messages import FusedPose, Source
from penumbra.shared.contract.report import Report, TopicReport
from penumbra.shared.geometry import rigid

ROS = Types("kilted")
ARM = cells.load("arm")
MODELS = robot_models(ARM)
STAMP_NS = 1_700_000_000_123_456_789
COVARIANCE = np.diag([1e-4, 4e-4, 9e-4, 1e-3, 2e-3, 3e-3]) + 1e-5 * np.tri(6, 6, -1) + 1e-5 * np.tri(6, 6, -1).T
HASHES = {
    # of `get_publishers_info_by_topic` of rclpy, Jazzy 7.1.6 and Kilted 9.1.2
    convert.POSE: "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    convert.JOINT_STATE: "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    convert.IMAGE: "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    convert.CAMERA_INFO: "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
    convert.COMPRESSED_IMAGE: "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    convert.DIAGNOSTICS: "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    convert.TF: "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    convert.MARKERS: "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
}


def fused(state="tracking", **fields):
    values: dict[str, Any] = {
        "stamp_ns": STAMP_NS,
        "target": "forearm",
        "frame": "world",
        "position": np.array([0.1, -0.2, 0.3]),
        "orientation": np.array([0.1, 0.2, 0.3, np.sqrt(0.86)]),
        "velocity": np.array([1.0, 2.0, 3.0, 0.4, 0.5, 0.6]),
        "covariance": COVARIANCE,
        "sources": {"vision": Source(age_s=0.05, weight=0.7)},
    }
    return FusedPose(state=state, **(values | fields))


def matrix(transform):
    t, r = transform.transform.translation, transform.transform.rotation
    return rigid.transform((t.x, t.y, t.z), (r.x, r.y, r.z, r.w))


def every_message():
    """One of each type that goes out."""
    meshes = {"forearm": anatomy.target_mesh(ARM.targets["forearm"], ARM)}
    markers = Markers(ROS, "world", meshes, {name: ARM.pad_types[pad.type] for name, pad in ARM.pads.items()})
    found = [*markers.target(fused(), (0.1, 0.9, 0.2)), *markers.pads(STAMP_NS, {"p0": np.eye(4)}, {"p0": 0.5})]
    report = Report("fusion", "host-1", "degraded", ["no router"], "host", 7, topics={"a/key": TopicReport(rate_hz=20.0)})
    return {
        convert.POSE: convert.pose(ROS, fused()),
        convert.TWIST: convert.twist(ROS, fused()),
        convert.TF: convert.transforms(ROS, convert.still_transforms(ROS, ARM, MODELS, STAMP_NS, with_links=True)),
        convert.CAMERA_INFO: convert.camera_info(ROS, ARM.cameras["side"], "side", STAMP_NS),
        convert.COMPRESSED_IMAGE: convert.compressed_image(ROS, "side", STAMP_NS, np.arange(100, dtype=np.uint8)),
        convert.MARKERS: markers.array(found),
        convert.DIAGNOSTICS: convert.diagnostics(ROS, "arm", STAMP_NS, [report], {"forearm": fused()}, STAMP_NS),
    }


def test_a_pose_keeps_position_order_of_the_quaternion_and_covariance_row_by_row():
    message = convert.pose(ROS, fused())
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    assert message.header.frame_id == "world"
    assert (message.pose.pose.position.x, message.pose.pose.position.z) == (0.1, 0.3)
    assert (message.pose.pose.orientation.x, message.pose.pose.orientation.w) == (0.1, np.sqrt(0.86))
    np.testing.assert_array_equal(message.pose.covariance.reshape(6, 6), COVARIANCE)


def test_a_twist_is_linear_then_angular_and_says_that_its_covariance_is_not_known():
    message = convert.twist(ROS, fused())
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    assert (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z) == (1.0, 2.0, 3.0, 0.4, 0.5, 0.6)
    assert np.all(np.diag(message.twist.covariance.reshape(6, 6)) == convert.NOT_KNOWN)


def test_the_frames_of_a_robot_lead_from_the_world_to_where_its_links_and_pads_are():
    q = np.array([0.1, -0.2, 0.1, -2.0, 0.2, 1.8, 0.7])
    still = convert.still_transforms(ROS, ARM, MODELS, STAMP_NS, with_links=True)
    moving = convert.link_transforms(ROS, ARM, "panda", MODELS["panda"], STAMP_NS, q)
    found = {each.child_frame_id: each for each in (*still, *moving)}
    assert len(found) == len(still) + len(moving), "no frame has two parents"

    def in_world(frame):
        T = np.eye(4)
        while frame != "world":
            T = matrix(found[frame]) @ T
            frame = found[frame].header.frame_id
        return T

    links = MODELS["panda"].link_transforms(q)
    for name, T in links.items():
        np.testing.assert_allclose(in_world(name), T, atol=1e-12, err_msg=name)
    for name, pad in ARM.pads.items():
        np.testing.assert_allclose(in_world(name), links[pad.link.partition("/")[2]] @ pad.T_link_pad, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(in_world("side_optical_frame"), ARM.cameras["side"].T_world_camera, atol=1e-12)


def test_without_links_only_what_the_cell_file_places_has_a_frame():
    still = convert.still_transforms(ROS, ARM, MODELS, STAMP_NS, with_links=False)
    assert {each.child_frame_id for each in still} == {"side_optical_frame", MODELS["panda"].links[0], *ARM.pads}


def test_a_camera_s_model_is_that_of_the_undistorted_picture():
    camera = ARM.cameras["side"].model_copy(update={"k1": -0.2})
    message = convert.camera_info(ROS, camera, "side", STAMP_NS)
    assert (message.width, message.height, message.distortion_model) == (640, 480, "plumb_bob")
    np.testing.assert_array_equal(message.d, np.zeros(5))
    np.testing.assert_array_equal(message.k.reshape(3, 3), camera.K)
    np.testing.assert_array_equal(message.p.reshape(3, 4)[:, :3], camera.K)


@pytest.mark.parametrize(("status", "level"), [("ok", 0), ("starting", 1), ("degraded", 1), ("down", 2)])
def test_diagnostics_have_the_level_of_the_health_report_and_its_reasons(status, level):
    report = Report("search", "host-9", status, ["no frames", "no joints"] if level else [], "host")
    (found,) = convert.diagnostics(ROS, "arm", STAMP_NS, [report], {}, STAMP_NS).status
    assert (found.level, found.name, found.hardware_id) == (level, "penumbra arm: search host-9", "host")
    assert found.message == ("no frames; no joints" if level else "ok")


@pytest.mark.parametrize(("state", "level"), [("tracking", 0), ("coasting", 1), ("lost", 2)])
def test_diagnostics_have_the_state_of_a_target(state, level):
    (found,) = convert.diagnostics(ROS, "arm", STAMP_NS, [], {"forearm": fused(state)}, STAMP_NS + 250_000_000).status
    values = {each.key: each.value for each in found.values}
    assert (found.level, found.message, values["age_s"], values["vision weight"]) == (level, state, "0.25", "0.7")
    (none,) = convert.diagnostics(ROS, "arm", STAMP_NS, [], {"forearm": None}, STAMP_NS).status
    assert none.level == ROS.constant("diagnostic_msgs/msg/DiagnosticStatus", "STALE")


def test_the_ellipsoid_holds_nine_positions_of_ten():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 3)) * 0.01
    covariance = root @ root.T
    lengths, orientation = ellipsoid(covariance)
    draws = rng.multivariate_normal(np.zeros(3), covariance, 20_000) @ rigid.transform(np.zeros(3), orientation)[:3, :3]
    inside = np.square(draws / lengths).sum(axis=1) < 1.0
    assert abs(inside.mean() - 0.9) < 0.01  # five standard deviations of that share


def test_a_lost_target_s_markers_are_taken_away():
    meshes = {"forearm": anatomy.target_mesh(ARM.targets["forearm"], ARM)}
    markers = Markers(ROS, "world", meshes, {})
    shown, gone = markers.target(fused(), (0.0, 1.0, 0.0)), markers.target(fused("lost"), (1.0, 0.0, 0.0))
    assert [each.action for each in shown] == [0, 0] and [each.action for each in gone] == [2, 2]
    assert [(each.ns, each.id) for each in shown] == [(each.ns, each.id) for each in gone]
    assert len(shown[0].points) == 3 * len(meshes["forearm"].faces)


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_type_hashes_are_those_of_ros(distribution):
    types = Types(distribution)
    assert {kind: types.hash(kind) for kind in HASHES} == {kind: f"RIHS01_{digest}" for kind, digest in HASHES.items()}


def test_every_message_is_the_same_after_its_cdr():
    for kind, message in every_message().items():
        payload = ROS.encode(message)
        assert payload[:4] == bytes((0, 1, 0, 0)), kind
        assert ROS.encode(ROS.decode(kind, payload)) == payload, kind


def test_bytes_after_a_message_are_left_out_and_bytes_that_are_none_are_refused():
    payload = ROS.encode(convert.pose(ROS, fused()))
    for count in (4, 8):
        assert ROS.decode(convert.POSE, payload + bytes(count)).header.frame_id == "world"
    for wrong in (b"", b"\x00\x01\x00\x00", payload[:40], payload + bytes(100), b"\x09" + payload[1:]):
        with pytest.raises(ValueError, match="expected CDR of geometry_msgs/msg/PoseWithCovarianceStamped"):
            ROS.decode(convert.POSE, wrong)


def test_a_list_that_claims_to_be_endless_is_refused_at_once():
    names = ROS.encode(ROS.make(convert.JOINT_STATE, header=convert.header(ROS, 0, ""), name=[], position=np.zeros(0),
                                velocity=np.zeros(0), effort=np.zeros(0)))  # fmt: skip
    began = time.process_time()
    with pytest.raises(ValueError, match="expected CDR"):
        ROS.decode(convert.JOINT_STATE, names[:16] + b"\xff\xff\xff\x7f" + names[20:])
    assert time.process_time() - began < 5.0  # it would take minutes
