"""Conventions of poses and their errors."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shared import geometry


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def random_transform(rng):
    return geometry.transform(rng.normal(size=3), Rotation.random(random_state=rng.integers(2**31)).as_quat())


def test_position_and_quaternion_round_trip(rng):
    for _ in range(100):
        T = random_transform(rng)
        np.testing.assert_allclose(geometry.transform(*geometry.position_orientation(T)), T, atol=1e-12)


def test_roll_pitch_yaw_turn_about_the_fixed_axes_in_that_order():
    T = geometry.from_rpy((0, 0, 0), (np.pi / 2, 0, np.pi / 2))
    np.testing.assert_allclose(T[:3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-12)  # rolled up to z, where the yaw leaves it
    np.testing.assert_allclose(T[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(geometry.rpy(geometry.position_orientation(T)[1]), (np.pi / 2, 0, np.pi / 2), atol=1e-12)


def test_the_inverse_undoes_a_transform(rng):
    T = random_transform(rng)
    np.testing.assert_allclose(geometry.inverse(T) @ T, np.eye(4), atol=1e-12)
    points = rng.normal(size=(5, 3))
    np.testing.assert_allclose(geometry.apply(geometry.inverse(T), geometry.apply(T, points)), points, atol=1e-12)


def test_a_pose_error_applied_gives_the_true_pose(rng):
    for _ in range(100):
        true, estimate = random_transform(rng), random_transform(rng)
        np.testing.assert_allclose(geometry.perturb(estimate, geometry.pose_error(true, estimate)), true, atol=1e-9)


def test_the_axis_error_does_not_see_a_roll_about_that_axis():
    T = np.eye(4)
    assert geometry.axis_angle_error(geometry.from_rpy((0, 0, 0), (1.0, 0, 0)), T) < 1e-7
    assert geometry.axis_angle_error(geometry.from_rpy((0, 0, 0), (0, 0, 0.1)), T) == pytest.approx(0.1)


def test_a_camera_that_looks_at_a_point_has_it_on_its_optical_axis():
    T = geometry.look_at((1.0, -2.0, 0.5), (0.1, 0.2, 0.3))
    x, y, z = geometry.apply(geometry.inverse(T), (0.1, 0.2, 0.3))
    assert abs(x) < 1e-12 and abs(y) < 1e-12 and z > 0
    assert T[2, 1] < 0  # image rows run downwards
