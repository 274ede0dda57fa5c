"""The cases of the judgement of a fitted pose, one by one."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from penumbra.services.search.settings import ONE_IN_10, ONE_IN_10_000, ONE_IN_100, SearchSettings
from penumbra.services.search.verdict import WEIGHTS, Findings, Verdict, explains_mask, is_of_other_shape, verdict

SETTINGS = SearchSettings()
GOOD = Findings(
    overlap=0.95,
    misfit=1.0,
    is_sharp=True,
    shape=None,
    points=40.0,
    hidden=0.1,
    covered=0.05,
    has_image=True,
    is_expected=False,
    sigma=0.01,
    surprise=5.0,
    expected_sigma=0.03,
)


def judged(**changes: object) -> Verdict:
    return verdict(replace(GOOD, **changes), SETTINGS)  # type: ignore[arg-type]


def test_a_pose_that_mask_and_image_confirm_is_tracked():
    assert judged() is Verdict.RIGHT
    assert judged(has_image=False, is_sharp=False) is Verdict.RIGHT


def test_a_pose_without_edges_in_the_image_is_lost_whatever_its_mask():
    assert judged(is_sharp=False) is Verdict.UNCONFIRMED
    assert judged(is_sharp=False, is_expected=True) is Verdict.UNCONFIRMED


def test_without_an_image_the_mask_s_boundary_decides():
    assert judged(has_image=False, misfit=SETTINGS.wrong_misfit) is Verdict.MISSHAPEN
    assert judged(has_image=False, misfit=0.99 * SETTINGS.wrong_misfit) is Verdict.RIGHT
    assert judged(has_image=True, misfit=SETTINGS.wrong_misfit) is Verdict.RIGHT  # the image is the better witness


def test_a_limb_of_another_shape_needs_no_edges_where_the_mesh_has_them_but_may_not_be_just_anything():
    least, most = SETTINGS.other_shape
    assert judged(is_sharp=False, shape=0.99 * most) is Verdict.RIGHT
    assert judged(is_sharp=False, shape=most) is Verdict.MISSHAPEN
    assert judged(is_sharp=False, shape=0.5 * most, overlap=0.99 * SETTINGS.fits_shaped) is Verdict.ELSEWHERE
    assert is_of_other_shape(SETTINGS.fits_shaped, 0.5 * most, SETTINGS)
    assert not is_of_other_shape(SETTINGS.fits, least, SETTINGS)  # an error of the mask
    assert not is_of_other_shape(SETTINGS.fits, None, SETTINGS)


@pytest.mark.parametrize("overlap", [SETTINGS.fits_expected, 0.99 * SETTINGS.fits])
def test_a_poor_overlap_is_enough_only_for_a_sharp_pose_that_is_expected(overlap):
    assert judged(overlap=overlap) is Verdict.ELSEWHERE
    assert judged(overlap=overlap, is_expected=True) is Verdict.RIGHT
    assert judged(overlap=overlap, is_expected=True, has_image=False, is_sharp=False) is Verdict.ELSEWHERE


def test_a_small_piece_is_accepted_only_where_it_is_expected():
    for small in ({"hidden": 0.6}, {"points": 6.0}):
        assert judged(**small) is Verdict.TOO_LITTLE
        assert judged(**small, is_expected=True) is Verdict.RIGHT
    for smaller in ({"hidden": 0.96}, {"points": 2.9}):
        assert judged(**smaller, is_expected=True) is Verdict.TOO_LITTLE


def test_what_shows_too_little_is_occluded_where_something_covers_it_and_lost_where_nothing_does():
    assert judged(hidden=0.99, covered=0.9) is Verdict.COVERED
    assert judged(hidden=0.99, covered=0.5) is Verdict.TOO_LITTLE
    assert {case.state for case in Verdict} == {"tracking", "occluded", "lost"}
    assert Verdict.COVERED.state == "occluded" and Verdict.TOO_LITTLE.state == "lost"


WORSE = ({"overlap": 0.7}, {"is_sharp": False}, {"points": 4.0}, {"hidden": 0.9}, {"sigma": 0.2}, {"surprise": 1e2},
         {"expected_sigma": 0.3})  # fmt: skip


def confidence(**changes: object) -> float:
    return replace(GOOD, **changes).confidence  # type: ignore[arg-type]


@pytest.mark.parametrize("worse", WORSE)
def test_whatever_speaks_against_a_pose_makes_it_less_probable(worse):
    assert GOOD.confidence > 0.95
    assert confidence(**worse) < GOOD.confidence


def test_several_findings_together_make_a_pose_improbable():
    assert confidence(is_sharp=False) < confidence(is_sharp=False, has_image=False) < GOOD.confidence
    assert confidence(is_sharp=False, overlap=0.4, surprise=400.0) < 0.1
    assert confidence(points=3.0, sigma=0.2, hidden=0.9, expected_sigma=0.3) < 0.3  # a small piece may be anything


def test_a_pose_that_nothing_refutes_is_not_tracked_if_it_is_improbable_all_the_same():
    odd = {"overlap": 0.81, "sigma": 0.3, "surprise": 300.0, "points": 9.0, "hidden": 0.4}
    assert judged(**(odd | {"surprise": 3.0})) is Verdict.RIGHT
    assert judged(**odd) is Verdict.IMPROBABLE
    assert judged(**odd, shape=0.005, is_sharp=False) is Verdict.RIGHT  # the probability is that of limbs that are the mesh


def test_the_log_odds_are_the_weighted_sum_of_the_features():
    assert GOOD.features.keys() == WEIGHTS.keys()
    odds = sum(WEIGHTS[name] * value for name, value in GOOD.features.items())
    assert math.log(GOOD.confidence / (1.0 - GOOD.confidence)) == pytest.approx(odds)
    surer = confidence(overlap=1.0)
    assert math.log(surer / (1.0 - surer)) - odds == pytest.approx(0.05 * WEIGHTS["overlap"])


def test_a_pose_explains_a_mask_by_overlap_and_boundary_together():
    assert explains_mask(SETTINGS.fits, 1.0, SETTINGS)
    assert not explains_mask(0.99 * SETTINGS.fits, 1.0, SETTINGS)
    assert not explains_mask(SETTINGS.fits, SETTINGS.wrong_misfit, SETTINGS)


def test_the_gates_are_the_quantiles_that_their_names_say():
    shares = [0.9, 0.99, 0.9999]
    np.testing.assert_allclose([ONE_IN_10, ONE_IN_100, ONE_IN_10_000], chi2.ppf(shares, 6), atol=0.05)  # rounded to a tenth
