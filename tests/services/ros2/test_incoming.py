"""JointState by the names of joints, and pictures of every encoding."""

import cv2
import numpy as np
import pytest

from penumbra.services.ros2 import convert, incoming
from penumbra.services.ros2.cdr import Types
from penumbra.services.ros2.incoming import Refused
from penumbra.shared.cell import description as cells

ROS = Types("jazzy")
CAMERA = cells.load("arm").cameras["side"].model_copy(update={"width": 8, "height": 6})
MS = 1_000_000
BEGIN_NS = 1_700_000_000_000_000_000
RGB = np.random.default_rng(1).integers(0, 256, (6, 8, 3), np.uint8)


def joint_state(after_ms, **positions):
    return ROS.make(
        convert.JOINT_STATE,
        header=convert.header(ROS, BEGIN_NS + after_ms * MS, ""),
        name=list(positions),
        position=np.array(list(positions.values()), float),
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )


def image(encoding, data, step, width=8, height=6):
    head = convert.header(ROS, BEGIN_NS, "camera")
    return ROS.make(convert.IMAGE, header=head, height=height, width=width, encoding=encoding, is_bigendian=0, step=step,
                    data=np.ascontiguousarray(data).reshape(-1))  # fmt: skip


def test_joints_are_mapped_by_name_whatever_their_order_and_what_else_is_there():
    joints = incoming.Joints(["a", "b", "c"])
    found = joints.add(joint_state(0, finger=9.0, c=3.0, a=1.0, b=2.0))
    assert found is not None
    stamp_ns, position = found
    assert stamp_ns == BEGIN_NS and position.tolist() == [1.0, 2.0, 3.0] and joints.missing == ()


def test_joints_of_several_nodes_are_collected_and_what_is_missing_is_named():
    joints = incoming.Joints(["a", "b"])
    assert joints.missing == ("a", "b")
    assert joints.add(joint_state(0, a=1.0)) is None and joints.missing == ("b",)
    found = joints.add(joint_state(20, b=2.0))
    assert found is not None
    stamp_ns, position = found
    assert stamp_ns == BEGIN_NS + 20 * MS and position.tolist() == [1.0, 2.0]


def test_a_joint_whose_node_has_fallen_silent_is_missing_again():
    joints = incoming.Joints(["a", "b"])
    joints.add(joint_state(0, a=1.0, b=2.0))
    assert joints.add(joint_state(90, a=1.1)) is not None
    assert joints.add(joint_state(150, a=1.2)) is None and joints.missing == ("b",)


def test_a_robot_that_sends_a_thousand_sets_a_second_is_read_a_hundred_times():
    joints = incoming.Joints(["a"])
    assert sum(joints.add(joint_state(ms, a=0.0)) is not None for ms in range(1000)) == 100


def test_a_message_about_other_joints_alone_publishes_nothing():
    joints = incoming.Joints(["a"])
    joints.add(joint_state(0, a=1.0))
    assert joints.add(joint_state(50, finger=1.0)) is None and joints.missing == ()


def test_positions_that_are_none_are_refused():
    joints = incoming.Joints(["a"])
    with pytest.raises(Refused, match="joint a: expected a finite position, got nan"):
        joints.add(joint_state(0, a=np.nan))
    message = joint_state(0, a=1.0)
    message.position = np.zeros(0)
    with pytest.raises(Refused, match="expected a position for each of 1 joints, got 0"):
        joints.add(message)


@pytest.mark.parametrize(
    ("encoding", "data", "expected"),
    [
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[..., ::-1], RGB),
        ("rgba8", np.dstack([RGB, RGB[..., 0]]), RGB),
        ("bgra8", np.dstack([RGB[..., ::-1], RGB[..., 0]]), RGB),
        ("mono8", RGB[..., 0], np.repeat(RGB[..., :1], 3, axis=2)),
    ],
)
def test_a_picture_becomes_rgb(encoding, data, expected):
    flat = np.ascontiguousarray(data).reshape(6, -1)
    for padding in (0, 5):  # bytes at the end of each row
        rows = np.hstack([flat, np.full((6, padding), 77, np.uint8)])
        found = incoming.image(image(encoding, rows, flat.shape[1] + padding), CAMERA)
        np.testing.assert_array_equal(found, expected)
        assert found.flags.c_contiguous


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_the_colours_of_a_bayer_pattern_are_those_of_ros(pattern):
    """A surface of one colour, as each pixel's filter lets it through."""
    colour = {"r": 200, "g": 100, "b": 20}
    tile = np.array([[colour[c] for c in pattern[:2]], [colour[c] for c in pattern[2:]]], np.uint8)
    found = incoming.image(image(f"bayer_{pattern}8", np.tile(tile, (3, 4)), 8), CAMERA)
    np.testing.assert_array_equal(found[2:4, 2:6].reshape(-1, 3), np.tile([200, 100, 20], (8, 1)))


@pytest.mark.parametrize(("encoding", "order"), [("uyvy", "uyvy"), ("yuv422", "uyvy"), ("yuyv", "yuyv"), ("yuv422_yuy2", "yuyv")])
def test_the_order_of_luma_and_chroma_is_that_of_ros(encoding, order):
    y, u, v = 120, 90, 200
    pair = [{"y": y, "u": u, "v": v}[c] for c in order]
    found = incoming.image(image(encoding, np.tile(np.array(pair, np.uint8), (6, 4)), 16), CAMERA)
    # ITU-R BT.601 in studio range, as cameras send it
    expected = 1.164 * (y - 16) + np.array([1.596 * (v - 128), -0.813 * (v - 128) - 0.391 * (u - 128), 2.018 * (u - 128)])
    assert np.abs(found - expected).max() <= 1.5


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (image("16UC1", np.zeros(96, np.uint8), 16), "expected an encoding of rgb8, .* got '16UC1'"),
        (image("rgb8", np.zeros(0, np.uint8), 24), "expected 6 rows of 24 bytes or more for rgb8, got 0 bytes in rows of 24"),
        (image("rgb8", np.zeros(144, np.uint8), 8), "expected 6 rows of 24 bytes or more"),
        (image("rgb8", RGB, 24, width=640, height=480), "expected 8 x 6 pixels as in the cell file, got 640 x 480"),
    ],
)
def test_a_picture_that_is_none_of_this_camera_is_refused(message, why):
    with pytest.raises(Refused, match=why):
        incoming.image(message, CAMERA)


def compressed(data, form="jpeg"):
    head = convert.header(ROS, BEGIN_NS, "camera")
    return ROS.make(convert.COMPRESSED_IMAGE, header=head, format=form, data=np.asarray(data, np.uint8).reshape(-1))


def test_compressed_pictures_come_in_the_right_colours():
    _, png = cv2.imencode(".png", RGB[..., ::-1])
    np.testing.assert_array_equal(incoming.compressed_image(compressed(png, "rgb8; png compressed bgr8"), CAMERA), RGB)
    red = np.zeros((6, 8, 3), np.uint8)
    red[...] = (200, 20, 20)
    _, jpeg = cv2.imencode(".jpg", red[..., ::-1])
    assert np.abs(incoming.compressed_image(compressed(jpeg), CAMERA).astype(int) - red).max() < 8


@pytest.mark.parametrize(
    ("data", "form", "why"),
    [
        (np.arange(40), "jpeg", "expected a JPEG or PNG, got 40 bytes of format 'jpeg' that are none"),
        (np.zeros(0), "jpeg", "expected a JPEG or PNG in colour or grey, got 0 bytes"),
        (np.arange(40), "16UC1; compressedDepth png", "expected a JPEG or PNG in colour or grey"),
        (cv2.imencode(".png", np.zeros((3, 3, 3), np.uint8))[1], "png", "expected 8 x 6 pixels as in the cell file, got 3 x 3"),
    ],
)
def test_compressed_bytes_that_are_no_picture_of_this_camera_are_refused(data, form, why):
    with pytest.raises(Refused, match=why):
        incoming.compressed_image(compressed(data, form), CAMERA)
