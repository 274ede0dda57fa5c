"""Limbs that jump, and cameras that do not see a limb where it is expected: what is called tracking then."""

from __future__ import annotations

import numpy as np
import pytest

from penumbra.services.fusion.observer import ErrorStateObserver
from penumbra.shared.contract.messages import MAX_FUTURE_S
from penumbra.shared.geometry.rigid import perturb
from penumbra.tests.support.fusion_data import HOME, SPREAD, VISION, ns, still


def test_a_jump_that_the_skin_cannot_feel_is_noticed_at_once_and_followed() -> None:
    along = HOME[:3, 0]
    spread = np.diag([0.02**2] * 3 + [0.2**2] * 3)
    spread[:3, :3] += 0.15**2 * np.outer(along, along)
    felt = np.linalg.inv(spread)  # well across the limb, hardly along it
    observer, jumped = ErrorStateObserver(HOME, SPREAD), perturb(HOME, [*(0.12 * along), 0.0, 0.0, 0.0])
    states, errors = [], []
    for k in range(130):
        observer.measure("haptic", ns(k * 0.01), HOME, felt)
        if k % 5 == 0:
            observer.measure("vision", ns(k * 0.01), jumped if k >= 100 else HOME, VISION)
        estimate = observer.estimate(ns(k * 0.01))
        states.append(estimate.state)
        errors.append(float(np.linalg.norm(estimate.T[:3, 3] - jumped[:3, 3])))
    assert set(states[50:100]) == {"tracking"}
    right = next(k for k in range(100, 130) if errors[k] < 0.03)
    assert right <= 120
    assert set(states[100:right]) == {"coasting"}
    assert states[-1] == "tracking"


def test_a_camera_that_falls_silent_after_a_refused_picture_does_not_end_what_the_skin_tracks() -> None:
    spread = np.diag([0.02**2] * 3 + [0.2**2] * 3)
    spread[:3, :3] += 0.15**2 * np.outer(HOME[:3, 0], HOME[:3, 0])
    observer = ErrorStateObserver(HOME, SPREAD)
    states = {}
    for k in range(250):
        observer.measure("haptic", ns(k * 0.01), HOME, np.linalg.inv(spread))
        if k <= 100 and k % 5 == 0:
            away = 0.12 * HOME[:3, 0] if k == 100 else np.zeros(3)
            accepted = observer.measure("vision", ns(k * 0.01), perturb(HOME, [*away, 0.0, 0.0, 0.0]), VISION)
            assert accepted == (k < 100)
        states[k] = observer.estimate(ns(k * 0.01)).state
    assert {states[k] for k in range(100, 150)} == {"coasting"}
    assert {states[k] for k in range(150, 170)} == {"tracking"}


def seen_until_one_second_and_felt(until: float) -> ErrorStateObserver:
    """A limb that vision sees for a second, and that the skin feels until a time [s]."""
    observer = ErrorStateObserver(HOME, SPREAD)
    for k in range(round(until * 100)):
        observer.measure("haptic", ns(k * 0.01), HOME, VISION)
        if k <= 100 and k % 5 == 0:
            observer.measure("vision", ns(k * 0.01), HOME, VISION)
    return observer


def test_a_pose_that_a_camera_does_not_see_where_it_is_expected_is_not_called_tracking_for_half_a_second() -> None:
    observer = seen_until_one_second_and_felt(1.8)
    assert observer.estimate(ns(1.3)).state == "tracking"  # nobody has denied it
    before = observer.estimate(ns(1.3))
    observer.deny("vision", ns(1.2))
    states = {at: observer.estimate(ns(at)).state for at in (1.19, 1.21, 1.69, 1.71)}
    assert states == {1.19: "tracking", 1.21: "coasting", 1.69: "coasting", 1.71: "tracking"}
    np.testing.assert_array_equal(observer.estimate(ns(1.3)).T, before.T)
    np.testing.assert_array_equal(observer.estimate(ns(1.3)).covariance, before.covariance)
    observer.deny("vision", ns(1.65))
    observer.measure("vision", ns(1.7), HOME, VISION)
    assert observer.estimate(ns(1.75)).state == "tracking"  # seen again


def test_a_camera_does_not_deny_what_another_one_sees_at_the_same_time() -> None:
    observer = seen_until_one_second_and_felt(1.8)
    observer.deny("vision", ns(1.04))
    assert observer.estimate(ns(1.06)).state == "tracking"


def test_a_camera_that_has_seen_nothing_for_long_denies_nothing_that_the_skin_feels() -> None:
    observer, states = seen_until_one_second_and_felt(4.9), {}
    for at in (1.2, 2.5, 3.9, 4.1, 4.8):
        observer.deny("vision", ns(at))
        states[at] = observer.estimate(ns(at)).state
    assert states == {1.2: "coasting", 2.5: "coasting", 3.9: "coasting", 4.1: "tracking", 4.8: "tracking"}


def test_a_denial_from_the_future_counts_for_nothing_and_one_is_forgotten_with_all_else() -> None:
    observer = seen_until_one_second_and_felt(1.8)
    observer.deny("vision", ns(1.3 + 2 * MAX_FUTURE_S), ns(1.3))
    assert observer.estimate(ns(1.35)).state == "tracking"
    observer.deny("vision", ns(1.3))
    observer.forget()
    still(observer, HOME, 1.0, 1.4)
    assert observer.estimate(ns(1.4)).state == "tracking"
    with pytest.raises(ValueError, match="expected one of vision, haptic, got 'lidar'"):
        observer.deny("lidar", ns(1.0))
