"""Rivals of a pose: what pictures say of them adds up, and one that has taken the pose's place keeps it for a while."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from penumbra.services.search import detect
from penumbra.services.search.image_fit import SHARP
from penumbra.services.search.mask_fit import Fit, Limits
from penumbra.services.search.rivals import REST_NS, RIVALS, TURNS, Rivals, against_mirror
from penumbra.shared.geometry import rigid

PICTURE_NS = 50_000_000
HERE = rigid.transform([0.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0])


def turned(radians: float) -> np.ndarray:
    T = HERE.copy()
    T[:3, :3] = rigid.rotation(radians * T[:3, 0]) @ T[:3, :3]
    return T


def fitted(T: np.ndarray, cost: float, hand: float = 1.0, rms: float = 0.1) -> Fit:
    """A pose of 50 points, with a cost in chi^2."""
    return Fit(T, 1e-4 * np.eye(6), T, 50.0, rms, 0.0, cost, 1.0, 0, 0, 1.0, hand=hand, sharp=rms < SHARP)


def same(fit: Fit) -> int:
    """Of pictures whose masks tell nothing."""
    return 0


def roll(fit: Fit) -> float:
    """The turn [rad] from HERE."""
    return float(rigid.pose_error(fit.T, HERE)[3:] @ HERE[:3, 0])


def costs(preferred: float, by: float) -> Callable[[np.ndarray, int, float], Fit]:
    """Pictures in which every turn costs 100, but one so much less."""

    def shown(T: np.ndarray, passes: int, hand: float) -> Fit:
        away = float(np.linalg.norm(rigid.pose_error(T, turned(preferred))[3:]))
        return fitted(T, 100.0 - (by if away < 0.1 else 0.0))

    return shown


def taken(by: float, pictures: int) -> list[float]:
    """The turns said of so many pictures in which the fit ends at HERE and another turn costs less."""
    rivals, shown = Rivals(Limits()), costs(TURNS[3], by)
    return [
        roll(rivals.contested(shown(HERE, 1, 1.0), PICTURE_NS * i, shown, lambda fit: 0.0, same)) for i in range(1, pictures + 1)
    ]


@pytest.mark.parametrize(("by", "comparisons"), [(25.0, 1), (12.0, 2), (8.0, 4)])
def test_what_pictures_say_of_a_rival_adds_up_and_the_one_that_they_prefer_is_compared_every_second_time(by, comparisons):
    said = np.abs(taken(by, 2 * RIVALS))
    first = int(np.argmax(said > 0.1))
    assert said[first] == pytest.approx(TURNS[3], abs=0.01)
    assert first == (1 + 3 if comparisons == 1 else RIVALS + 2 * (comparisons - 2))


def test_noise_that_prefers_now_the_one_and_now_the_other_changes_nothing():
    rng = np.random.default_rng(5)
    rivals = Rivals(Limits())
    for i in range(1, 30 * RIVALS):
        best = fitted(HERE, 100.0 + rng.normal(scale=3.0))
        estimate = rivals.contested(
            best, PICTURE_NS * i, lambda T, *_: fitted(T, 100.0 + rng.normal(scale=3.0)), lambda fit: 0.0, same
        )
        assert abs(roll(estimate)) < 0.1


def test_a_rival_that_took_the_place_keeps_it_where_fits_begin_from_the_turn_before():
    said = np.abs(taken(25.0, 4 * RIVALS))
    first = int(np.argmax(said > 0.1))
    assert (said[first:] > 0.1).all()


@pytest.mark.parametrize(
    ("cost", "hand", "wins"),
    [(88.0, 1.0, (True, False, True)), (100.0, 1.0, (False, False, True)), (88.0, 4.0, (True, True, True))],
)
def test_a_turn_that_leaves_a_thumb_in_the_mask_unexplained_loses_unless_hands_are_not_believed(cost, hand, wins):
    def is_rival(fit: Fit) -> bool:
        return abs(roll(fit) - TURNS[3]) < 0.1

    def shown(T: np.ndarray, passes: int, hand: float) -> Fit:
        found = fitted(T, 100.0, hand)
        return replace(found, cost=cost) if is_rival(found) else found

    def is_taken(px: int) -> bool:
        def differs(fit: Fit) -> int:
            return px if is_rival(fit) else 50

        rivals, turns = Rivals(Limits()), []
        for i in range(1, 4 * RIVALS):
            turns.append(roll(rivals.contested(shown(HERE, 1, hand), PICTURE_NS * i, shown, lambda fit: 0.0, differs)))
        return max(turns) > 0.9

    assert (is_taken(50), is_taken(150), is_taken(0)) == wins


def test_while_all_are_refuted_every_second_comparison_is_of_a_nearest_turn():
    starts: list[float] = []

    def shown(T: np.ndarray, passes: int, hand: float) -> Fit:
        starts.append(apart(T, TILTED))
        return fitted(T, 150.0)

    rivals = Rivals(Limits())
    for i in range(1, 20 * RIVALS):
        rivals.contested(fitted(TILTED, 100.0), PICTURE_NS * i, shown, lambda fit: 0.0, same)
    near = np.isclose(starts, np.radians(30.0), atol=0.01)
    assert near[: 2 * RIVALS].sum() == 4, "each of the nine twice: two pictures are needed to refute it"
    assert near[2 * RIVALS :].mean() == pytest.approx(0.5 + 0.5 * 2 / RIVALS, abs=0.05)


def test_what_was_said_of_a_rival_before_it_was_one_with_the_pose_is_forgotten():
    rivals, stamps = Rivals(Limits()), itertools.count(PICTURE_NS, PICTURE_NS)
    for _ in range(10 * RIVALS):
        rivals.contested(fitted(HERE, 100.0), next(stamps), lambda *_: fitted(HERE, 100.0), lambda fit: 0.0, same)
    shown = costs(TURNS[3], 25.0)  # they part, and the first comparison tells which is right
    every = -(-REST_NS // PICTURE_NS)
    said = [
        roll(rivals.contested(fitted(HERE, 100.0), next(stamps), shown, lambda fit: 0.0, same)) for _ in range(RIVALS * every)
    ]
    assert max(np.abs(said)) == pytest.approx(TURNS[3], abs=0.01)


TILTED = rigid.transform([0.0, 0.0, 1.5], [0.0, np.sin(0.25), 0.0, np.cos(0.25)])
MIRROR = detect.mirrored(TILTED)[0]


def apart(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(rigid.pose_error(a, b)[3:]))


def test_a_limb_found_with_the_wrong_tilt_has_the_right_one_at_once():
    def shown(T: np.ndarray, passes: int, hand: float) -> Fit:
        return fitted(T, 80.0 if apart(T, MIRROR) < 0.1 else 100.0)

    found = Rivals(Limits()).contested(shown(TILTED, 1, 1.0), PICTURE_NS, shown, lambda fit: 0.0, same)
    assert apart(TILTED, MIRROR) > 0.5 and apart(found.T, MIRROR) < 0.1


@pytest.mark.parametrize(("degrees", "right"), [(5.0, 27.0), (-5.0, -27.0), (5.0, -17.0), (27.0, 5.0), (-27.0, -5.0)])
def test_a_limb_whose_tilt_is_22_degrees_off_on_either_side_of_the_image_plane_is_set_right_and_stays_so(degrees, right):
    there, here = (detect.tilted(HERE, np.radians(each)) for each in (right, degrees))

    def shown(T: np.ndarray, passes: int, hand: float) -> Fit:
        return fitted(T, 70.0 if apart(T, there) < 0.1 else 100.0)

    rivals = Rivals(Limits())  # every fit from the prediction ends at the wrong tilt, as long as the rivals are compared
    said = [rivals.contested(shown(here, 1, 1.0), PICTURE_NS * i, shown, lambda fit: 0.0, same) for i in range(1, 2 * RIVALS)]
    is_right = np.array([apart(each.T, there) < 0.1 for each in said])
    assert detect.tilt(there) == pytest.approx(np.radians(right))
    assert is_right[RIVALS - 1 :].all()


def test_the_mirror_image_of_a_turn_that_wins_is_compared_next():
    rivals, starts = Rivals(Limits()), []
    mirrored = detect.mirrored(TILTED)[0]

    def shown(T: np.ndarray, passes: int, hand: float) -> Fit:
        starts.append(T)
        return fitted(T, 100.0 if apart(T, mirrored) > 0.1 and apart(T, TILTED) > 0.1 else 160.0)

    for i in range(1, 4):  # the mirror image costs as much, the first turn less, then the turn's mirror image is looked at
        best = fitted(TILTED, 160.0) if i < 3 else fitted(starts[-1], 100.0)
        rivals.contested(best, PICTURE_NS * i, shown, lambda fit: 0.0, same)
    assert apart(starts[0], mirrored) < 0.01
    assert apart(starts[1], TILTED) > 1.0
    assert apart(starts[2], detect.mirrored(starts[1])[0]) < 0.01


@pytest.mark.parametrize(("straight_px", "is_taken"), [(0.35, True), (0.1, False)])
def test_where_the_hand_is_bent_the_forearm_tells_the_tilt_unless_a_straight_hand_fits(straight_px, is_taken):
    def shown(T: np.ndarray, passes: int, hand: float) -> Fit:
        is_mirror = apart(T, MIRROR) < 0.1
        if hand == 1.0:  # believed, the hand that is not the mesh's prefers the wrong tilt
            return fitted(T, 150.0 if is_mirror else 100.0, rms=straight_px)
        return fitted(T, 70.0 if is_mirror else 100.0, hand)

    found = Rivals(Limits()).contested(fitted(TILTED, 100.0, 4.0), PICTURE_NS, shown, lambda fit: 0.0, same)
    assert (apart(found.T, MIRROR) < 0.1) == is_taken


@pytest.mark.parametrize(
    ("excess", "surprise", "is_taken"), [(4.0, 0.0, False), (-4.0, 0.0, True), (-4.0, 9.0, False), (4.0, -9.0, True)]
)
def test_a_limb_that_is_not_quite_the_mesh_is_as_uncertain_as_its_mirror_image_is_apart(excess, surprise, is_taken):
    def surprising(fit: Fit) -> float:
        return max(surprise, 0.0) if apart(fit.T, MIRROR) < 0.1 else max(-surprise, 0.0)

    best = replace(fitted(TILTED, 10.0), shape=0.003)
    found = against_mirror(best, lambda T: fitted(T, 10.0 + excess), surprising, 0.8, Limits())
    assert (apart(found.T, MIRROR) < 0.1) == is_taken
    away = rigid.pose_error(MIRROR, TILTED)[3:]
    assert np.sqrt(away @ found.covariance[3:, 3:] @ away) > 0.5 * away @ away


def test_a_mirror_image_that_does_not_explain_the_mask_changes_nothing():
    best = replace(fitted(TILTED, 10.0), shape=0.003)
    poor = replace(fitted(MIRROR, -50.0), overlap=0.5)
    assert against_mirror(best, lambda T: poor, lambda fit: 0.0, 0.8, Limits()) is best
