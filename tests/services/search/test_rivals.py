"""Rivals of a pose: what pictures say of them adds up, and one that has taken the pose's place keeps it for a while."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from penumbra.services.search import detect
from penumbra.services.search.mask_fit import Fit, Limits
from penumbra.services.search.rivals import RIVALS, TURNS, Rivals
from penumbra.shared.geometry import rigid

PICTURE_NS = 50_000_000
HERE = rigid.transform([0.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0])


def turned(radians: float) -> np.ndarray:
    T = HERE.copy()
    T[:3, :3] = rigid.rotation(radians * T[:3, 0]) @ T[:3, :3]
    return T


def fitted(T: np.ndarray, cost: float) -> Fit:
    """A pose of 50 points, with a cost in chi^2."""
    return Fit(T, 1e-4 * np.eye(6), T, 50.0, 0.1, 0.0, cost, 1.0, 0, 0, 1.0, sharp=True)


def roll(fit: Fit) -> float:
    """The turn [rad] from HERE."""
    return float(rigid.pose_error(fit.T, HERE)[3:] @ HERE[:3, 0])


def costs(preferred: float, by: float) -> Callable[[np.ndarray, int], Fit]:
    """Pictures in which every turn costs 100, but one so much less."""

    def shown(T: np.ndarray, passes: int) -> Fit:
        away = float(np.linalg.norm(rigid.pose_error(T, turned(preferred))[3:]))
        return fitted(T, 100.0 - (by if away < 0.1 else 0.0))

    return shown


def taken(by: float, pictures: int) -> list[float]:
    """The turns said of so many pictures in which the fit ends at HERE and another turn costs less."""
    rivals, shown = Rivals(Limits()), costs(TURNS[3], by)
    return [
        roll(rivals.contested(shown(HERE, 1), PICTURE_NS * i, shown, lambda T, covariance: 0.0)) for i in range(1, pictures + 1)
    ]


@pytest.mark.parametrize(("by", "rounds"), [(25.0, 1), (12.0, 2), (8.0, 4)])
def test_what_pictures_say_of_a_rival_adds_up(by, rounds):
    said = np.abs(taken(by, RIVALS * (rounds + 1)))
    assert said[: RIVALS * (rounds - 1)].max(initial=0.0) < 0.1
    assert said[RIVALS * (rounds - 1) :].max() == pytest.approx(TURNS[3], abs=0.01)


def test_noise_that_prefers_now_the_one_and_now_the_other_changes_nothing():
    rng = np.random.default_rng(5)
    rivals = Rivals(Limits())
    for i in range(1, 30 * RIVALS):
        best = fitted(HERE, 100.0 + rng.normal(scale=3.0))
        estimate = rivals.contested(best, PICTURE_NS * i, lambda T, _: fitted(T, 100.0 + rng.normal(scale=3.0)), lambda T, _: 0.0)
        assert abs(roll(estimate)) < 0.1


def test_a_rival_that_took_the_place_keeps_it_where_fits_begin_from_the_turn_before():
    said = np.abs(taken(25.0, 4 * RIVALS))
    first = int(np.argmax(said > 0.1))
    assert (said[first:] > 0.1).all()


def test_a_limb_found_with_the_wrong_tilt_has_the_right_one_at_once():
    tilted = rigid.transform([0.0, 0.0, 1.5], [0.0, np.sin(0.25), 0.0, np.cos(0.25)])
    mirror = detect.mirrored(tilted)[0]

    def apart(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.linalg.norm(rigid.pose_error(a, b)[3:]))

    def shown(T: np.ndarray, passes: int) -> Fit:
        return fitted(T, 80.0 if apart(T, mirror) < 0.1 else 100.0)

    found = Rivals(Limits()).contested(shown(tilted, 1), PICTURE_NS, shown, lambda T, covariance: 0.0)
    assert apart(tilted, mirror) > 0.5 and apart(found.T, mirror) < 0.1
