"""What poses leave open: directions that are not observed, and likelihoods linearised elsewhere than where they peak."""

from __future__ import annotations

import numpy as np
import pytest

from penumbra.services.fusion.estimate import STRAIGHT, RefusedMeasurement, straight
from penumbra.services.fusion.observer import ErrorStateObserver
from penumbra.services.fusion.paper import PaperObserver
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array, perturb, pose_error
from penumbra.tests.support.fusion_data import HOME, SKIN, SPREAD, STEP, VISION, ns, still, without_roll

OBSERVERS = [ErrorStateObserver, PaperObserver]


# ---- directions that are not observed


def test_a_rank_deficient_measurement_leaves_the_other_directions_alone() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    still(observer, HOME, 0.0, 0.5)
    before = observer.estimate(ns(0.5))
    height = np.diag([0, 0, 1e6, 0, 0, 0])
    made_up = perturb(HOME, [0.5, -0.3, 0.005, 0.0, 0.0, 1.0])
    assert observer.measure("haptic", ns(0.5), made_up, height)
    after = observer.estimate(ns(0.5))
    moved = pose_error(after.T, before.T)
    assert 0.001 < moved[2] < 0.005
    np.testing.assert_allclose(np.delete(moved, 2), 0.0, atol=1e-9)
    np.testing.assert_allclose(after.covariance[:2, :2], before.covariance[:2, :2], rtol=1e-9)
    assert after.covariance[2, 2] < before.covariance[2, 2]


@pytest.mark.parametrize("make", OBSERVERS)
def test_a_roll_that_is_made_up_does_not_disturb_the_axis(make: type) -> None:
    rng = np.random.default_rng(0)
    T = perturb(HOME, [0.03, 0.02, -0.04, 0.3, 0.2, 0.4])
    observer = make(HOME, SPREAD)
    for k in range(100):
        observer.measure("haptic", ns(k * 0.01), T @ rigid.from_rpy([0, 0, 0], [rng.uniform(-2, 2), 0, 0]), without_roll(T, SKIN))
    estimate = observer.estimate(ns(1.0))
    assert np.linalg.norm(pose_error(T, estimate.T)[:3]) < 1e-3
    assert rigid.axis_angle_error(T, estimate.T) < 1e-3
    roll_variance = T[:3, 0] @ estimate.covariance[3:, 3:] @ T[:3, 0]
    assert roll_variance > 0.5 * SPREAD[1] ** 2  # nobody saw it


@pytest.mark.parametrize(("lateral", "turn", "least", "most"), [(0.02, 0.0, 0.01, 0.02), (0.1, 0.6, 0.0, 0.02)])
def test_what_is_seen_far_along_the_limb_says_little_about_it_the_more_it_is_turned_there(
    lateral: float, turn: float, least: float, most: float
) -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    still(observer, HOME, 0.0, 0.5, np.diag(np.square([25.0, 33.0, 33.0, 2.5, 5.0, 5.0])))
    elsewhere = perturb(HOME, [-0.23, lateral, 0.0, 0.0, 0.0, turn])
    across, up = np.array([0.0, 33.0, 0.0, 0.0, 0.0, -2.8]), np.array([0.0, 0.0, 11.0, 0.0, 0.9, 0.0])
    for k in range(10):
        observer.measure("haptic", ns(0.5 + 0.02 * k), elsewhere, np.outer(across, across) + np.outer(up, up))
    assert least < np.linalg.norm(pose_error(HOME, observer.estimate(ns(0.68)).T)[:3]) < most


def test_a_turn_that_a_pose_leaves_open_is_bound_to_the_rest_no_farther_than_it_is_straight() -> None:
    slope = np.array([0.02, -0.1, 0.05, 1.0, 0.0, 0.0])  # of the others by the roll
    near = np.diag(np.square([0.002, 0.004, 0.003, 0.05, 0.01, 0.02]))
    vague = near + 1.5**2 * np.outer(slope, slope)
    found = straight(vague)
    np.testing.assert_allclose(found[3:, 3:], vague[3:, 3:], atol=1e-12)
    assert 1.0 / np.linalg.inv(vague)[3, 3] < 0.1**2 and 1.0 / np.linalg.inv(found)[3, 3] > 1.0
    np.testing.assert_allclose(
        np.sqrt(np.diag(found)[:3]), np.hypot(np.sqrt(np.diag(near)[:3]), STRAIGHT * np.abs(slope[:3])), rtol=0.1
    )
    sure = near + 0.3**2 * np.outer(slope, slope)
    np.testing.assert_array_equal(straight(sure), sure)


# ---- likelihoods that were linearised elsewhere than where they peak


def test_a_pose_is_believed_as_it_is_wherever_its_likelihood_was_linearised() -> None:
    T = perturb(HOME, STEP)
    observer = ErrorStateObserver(HOME, SPREAD)
    for k in range(100):
        observer.measure("haptic", ns(0.01 * k), T, 100.0 * VISION, step=STEP)
    np.testing.assert_allclose(pose_error(T, observer.estimate(ns(1.0)).T), 0.0, atol=1e-3)


def test_steps_of_poses_with_one_origin_average_as_vectors() -> None:
    observer, other = ErrorStateObserver(HOME, SPREAD), perturb(HOME, 0.5 * STEP)
    for k in range(200):
        step = STEP * (1.0 if k % 2 else 0.0)
        observer.measure("haptic", ns(0.01 * k), perturb(HOME, step), VISION, step=step)
    np.testing.assert_allclose(pose_error(other, observer.estimate(ns(1.99)).T), 0.0, atol=0.02)


def test_poses_that_are_uncertain_by_tens_of_degrees_add_up_where_they_were_linearised() -> None:
    """Each window has four pads that feel how far a limb is, at different places along it, from nearly one side. Poses that are
    taken where they peak lead the yaw away, together, by 36 and 58 degrees."""
    known = np.array([0, 1, 2, 4, 5])
    for seed in range(2):
        rng, errors, squares = np.random.default_rng(seed), [], []
        observer = ErrorStateObserver(HOME, SPREAD)
        for k in range(500):
            information = felt_from_one_side(rng)
            w, V = np.linalg.eigh(information)
            seen = w > 1e-6 * w[-1]
            step = V[:, seen] @ (rng.standard_normal(seen.sum()) / np.sqrt(w[seen]))
            T, turn = perturb(HOME, step), np.eye(6)
            turn[3:, 3:] = rigid.rotation(step[3:])
            observer.measure("haptic", ns(0.02 * k), T, turn @ information @ turn.T, step=step)
            if k >= 150 and k % 10 == 0:
                estimate = observer.estimate(ns(0.02 * k))
                error, covariance = pose_error(HOME, estimate.T)[known], estimate.covariance[np.ix_(known, known)]
                errors.append(error)
                squares.append(float(error @ np.linalg.solve(covariance, error)) / len(known))
        assert np.degrees(np.sqrt(np.mean(np.square(errors), 0)[-1])) < 20.0
        assert np.mean(squares) < 1.0


def felt_from_one_side(rng: np.random.Generator) -> Array:
    """Information (6, 6) of four distances to points of HOME's axis, each with a standard deviation of 4 cm."""
    information = np.zeros((6, 6))
    for _ in range(4):
        off = 0.3 * rng.normal()
        toward = np.array([0.3 * rng.normal(), np.sin(off), np.cos(off)])
        toward /= np.linalg.norm(toward)
        row = np.concatenate([toward, np.cross([rng.uniform(-0.06, 0.06), 0.0, 0.0], toward)])
        row[3] = 0.0  # the roll is not felt
        information += np.outer(row, row) / 0.04**2
    return information


def test_a_step_that_is_not_finite_is_refused() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    with pytest.raises(RefusedMeasurement, match="pose: expected a finite rigid transform"):
        observer.measure("haptic", ns(0.0), HOME, VISION, step=np.full(6, np.nan))
    assert observer.log.counts["haptic"].refused == {"pose": 1}


def test_the_first_haptic_pose_is_completed_by_home() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    T = perturb(HOME, [0.1, 0.05, -0.1, 0.0, 0.0, 0.5])
    across = np.diag([0, 1e5, 1e5, 0, 1e3, 1e3])  # neither roll nor the way along the x axis
    observer.measure("haptic", ns(0), T, across)
    found = observer.estimate(ns(0))
    np.testing.assert_allclose(found.T[1:3, 3], T[1:3, 3], atol=2e-3)
    assert abs(found.T[0, 3] - HOME[0, 3]) < 1e-6
    assert found.covariance[0, 0] == pytest.approx(SPREAD[0] ** 2, rel=0.1)
    assert rigid.axis_angle_error(T, found.T) < 0.02
