"""Conventions of poses and their errors."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from penumbra.shared.geometry import rigid


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def random_transform(rng):
    return rigid.transform(rng.normal(size=3), Rotation.random(random_state=rng.integers(2**31)).as_quat())


def test_position_and_quaternion_round_trip(rng):
    for _ in range(100):
        T = random_transform(rng)
        np.testing.assert_allclose(rigid.transform(*rigid.position_orientation(T)), T, atol=1e-12)


def test_rotations_are_those_of_scipy_near_every_half_turn_too(rng):
    axes = [*np.eye(3), *rng.normal(size=(20, 3))]
    angles = [0.0, 1e-12, 1e-6, 0.3, 1.5, 3.0, np.pi - 1e-3, np.pi - 1e-7, np.pi]
    for axis, angle in itertools.product(axes, angles):
        vector = angle * axis / np.linalg.norm(axis)
        expected = Rotation.from_rotvec(vector)
        np.testing.assert_allclose(rigid.rotation(vector), expected.as_matrix(), atol=1e-12)
        T = rigid.transform((0, 0, 0), 3.0 * expected.as_quat())
        np.testing.assert_allclose(T[:3, :3], expected.as_matrix(), atol=1e-12)
        found = rigid.position_orientation(T)[1]
        assert found[3] >= 0.0
        np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), expected.as_matrix(), atol=1e-12)
        error = rigid.pose_error(T, np.eye(4))[3:]
        assert np.linalg.norm(error) <= np.pi + 1e-12
        np.testing.assert_allclose(rigid.rotation(error), expected.as_matrix(), atol=1e-9)


def test_euler_angles_are_those_of_scipy_and_defined_where_the_pitch_is_a_quarter_turn(rng):
    for angles in rng.uniform(-1.5, 1.5, (50, 3)):
        T = rigid.from_rpy((0, 0, 0), angles)
        np.testing.assert_allclose(T[:3, :3], Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(rigid.rpy(rigid.position_orientation(T)[1]), angles, atol=1e-9)
    for pitch, roll, yaw in itertools.product((-np.pi / 2, np.pi / 2), (0.0, 0.4, 2.0), (0.0, -0.7, 3.0)):
        R = rigid.from_rpy((0, 0, 0), (roll, pitch, yaw))[:3, :3]
        angles = rigid.rpy(Rotation.from_matrix(R).as_quat())
        assert angles[2] == 0.0
        np.testing.assert_allclose(rigid.from_rpy((0, 0, 0), angles)[:3, :3], R, atol=1e-7)


def test_a_quaternion_of_no_length_is_refused():
    with pytest.raises(ValueError, match=r"expected a unit quaternion \(x, y, z, w\), got \(0.0, 0.0, 0.0, 0.0\)"):
        rigid.transform((0, 0, 0), (0, 0, 0, 0))


def test_roll_pitch_yaw_turn_about_the_fixed_axes_in_that_order():
    T = rigid.from_rpy((0, 0, 0), (np.pi / 2, 0, np.pi / 2))
    np.testing.assert_allclose(T[:3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-12)  # rolled up to z, where the yaw leaves it
    np.testing.assert_allclose(T[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rigid.rpy(rigid.position_orientation(T)[1]), (np.pi / 2, 0, np.pi / 2), atol=1e-12)


def test_the_inverse_undoes_a_transform(rng):
    T = random_transform(rng)
    np.testing.assert_allclose(rigid.inverse(T) @ T, np.eye(4), atol=1e-12)
    points = rng.normal(size=(5, 3))
    np.testing.assert_allclose(rigid.apply(rigid.inverse(T), rigid.apply(T, points)), points, atol=1e-12)


def test_a_pose_error_applied_gives_the_true_pose(rng):
    for _ in range(100):
        true, estimate = random_transform(rng), random_transform(rng)
        np.testing.assert_allclose(rigid.perturb(estimate, rigid.pose_error(true, estimate)), true, atol=1e-9)


def test_the_axis_error_does_not_see_a_roll_about_that_axis():
    T = np.eye(4)
    assert rigid.axis_angle_error(rigid.from_rpy((0, 0, 0), (1.0, 0, 0)), T) < 1e-7
    assert rigid.axis_angle_error(rigid.from_rpy((0, 0, 0), (0, 0, 0.1)), T) == pytest.approx(0.1)


def test_a_camera_that_looks_at_a_point_has_it_on_its_optical_axis():
    T = rigid.look_at((1.0, -2.0, 0.5), (0.1, 0.2, 0.3))
    x, y, z = rigid.apply(rigid.inverse(T), (0.1, 0.2, 0.3))
    assert abs(x) < 1e-12 and abs(y) < 1e-12 and z > 0
    assert T[2, 1] < 0  # image rows run downwards
