"""The parts of the haptic estimator: the track and its rival, what is forgotten, trust in pads, and starts from scratch."""

from __future__ import annotations

import numpy as np
import pytest

from penumbra.services.haptics.settings import HapticSettings
from penumbra.services.haptics.solve import Reading
from penumbra.services.haptics.starts import Limb, Starts
from penumbra.services.haptics.track import Home, Place, Track, roll_axis
from penumbra.services.haptics.trust import PadTrust, SmoothedMisfit
from penumbra.shared.body.anatomy import target_mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.layout import Skin

SETTINGS = HapticSettings()
HOME = Home(rigid.transform([0.0, 0.0, 0.2]), np.repeat([0.12, 0.4], 3), SETTINGS)
NEAR = np.diag(np.repeat([0.01, 0.05], 3) ** 2)


def place(x: float) -> Place:
    """A place that is known to a centimetre, so far along the limb from home [m]."""
    return Place(rigid.transform([x, 0.0, 0.1]), NEAR)


def followed(rival: Place | None = None, odds: float = 0.0) -> Track:
    track = Track(HOME, SETTINGS)
    track.place = place(0.0)
    if rival is not None:
        track.contest(rival, odds)
    return track


@pytest.fixture(scope="module")
def skin() -> Skin:
    return Skin(cells.load("table"))


# ---- the track and its rival


def test_a_place_is_a_rival_only_where_it_is_apart_and_possible():
    assert followed(place(0.15)).rival is not None
    assert followed(place(0.03)).rival is None, "one of them with its covariance stands for both"
    assert followed(place(0.15), SETTINGS.odds_decided).rival is None, "the windows have decided"


def test_a_sharp_place_does_not_stand_for_a_vague_one_beside_it():
    vague = Place(place(0.15).T, 100.0 * place(0.15).covariance)
    sharp = followed(vague)
    assert sharp.rival is not None, "the vague place may be where the sharp one is, and elsewhere as well"
    sharp.place = vague
    sharp.contest(place(0.15), 1.0)
    assert sharp.rival is None


def test_a_single_window_changes_the_odds_by_a_limited_step_and_several_decide():
    track = followed(place(0.15))
    assert not track.weigh(place(0.15), 100.0)
    assert track.odds == SETTINGS.odds_step and track.rival is not None
    while track.odds + SETTINGS.odds_step < SETTINGS.odds_decided:
        track.weigh(place(0.15), 100.0)
        assert track.rival is not None
    track.weigh(place(0.15), 100.0)
    assert track.rival is None, "a thousand to one: the rival is dropped"


def test_a_rival_that_becomes_more_probable_changes_places_with_the_track():
    track = followed(place(0.15), 1.0)
    assert track.weigh(place(0.15), -1.5)
    assert track.place.T[0, 3] == 0.15 and track.odds == pytest.approx(0.5)
    assert track.rival is not None and track.rival.T[0, 3] == 0.0


def test_the_mixture_of_two_places_is_less_sure_along_the_line_between_them_alone():
    information = 1e4 * np.eye(6)
    alone, _ = followed().mixed(information, np.zeros(6))
    np.testing.assert_array_equal(alone, information)
    mixed, gradient = followed(place(0.15)).mixed(information, np.zeros(6))
    covariance = np.linalg.inv(mixed)
    between = 0.25 * 0.15**2  # two places equally probable
    assert covariance[0, 0] == pytest.approx(1e-4 + SETTINGS.doubt_lasts * between)
    np.testing.assert_allclose(np.diag(covariance)[1:], 1e-4, rtol=1e-9)
    assert np.linalg.solve(mixed, gradient)[0] == pytest.approx(0.075), "its mean lies half-way"


def test_a_sure_fused_pose_moves_the_track_and_leaves_no_rival():
    track = followed(place(0.15))
    T = rigid.transform([0.05, 0.0, 0.1])
    assert not track.expect(T, np.diag(np.repeat([0.03, 0.1], 3) ** 2)) and track.rival is not None
    assert track.expect(T, np.diag(np.repeat([0.01, 0.1], 3) ** 2)) and track.rival is None
    np.testing.assert_array_equal(track.place.T, T)
    assert np.sqrt(track.place.covariance[0, 0]) == pytest.approx(np.hypot(0.02, 0.01))


def test_a_fused_pose_that_is_known_better_than_the_track_moves_it_without_being_sure():
    track, T = Track(HOME, SETTINGS), rigid.transform([0.05, 0.0, 0.1])
    assert not track.expect(T, np.diag(np.repeat([0.03, 0.1], 3) ** 2))
    np.testing.assert_array_equal(track.place.T, T)
    assert track.place.sigma == pytest.approx(np.hypot(0.06, 0.01))
    assert not track.expect(rigid.transform([0.1, 0.0, 0.1]), np.diag(np.repeat([0.04, 0.1], 3) ** 2))
    np.testing.assert_array_equal(track.place.T, T, "this one is known worse")


def test_a_fused_pose_elsewhere_is_not_included_until_it_is_the_track_s_rival_and_counts_for_its_window_alone():
    track = followed()
    track.expect(rigid.transform([0.15, 0.0, 0.1]), np.diag(np.repeat([0.06, 0.1], 3) ** 2))
    assert track.fused is not None and not track.includes(track.fused)
    track.contest(place(0.15), 0.0)
    assert track.includes(track.fused) and track.includes(place(0.01)) and not track.includes(place(0.4))
    track.decay(0.02)
    assert track.fused is None and track.rival is not None


# ---- what is forgotten


def test_a_place_decays_to_home_and_its_spread_never_exceeds_home_s():
    later = HOME.decayed(place(0.3), SETTINGS.memory_s)
    assert later.T[0, 3] == pytest.approx(0.3 / np.e)
    assert later.T[2, 3] == pytest.approx(0.2 - 0.1 / np.e)
    much_later = HOME.decayed(place(0.3), 100.0 * SETTINGS.memory_s)
    np.testing.assert_allclose(much_later.T, HOME.T, atol=1e-9)
    np.testing.assert_allclose(much_later.covariance, HOME.place.covariance, atol=1e-9)
    np.testing.assert_array_equal(HOME.decayed(place(0.3), 0.0).T, place(0.3).T)


def test_the_roll_is_forgotten_long_before_the_pose():
    turned = Place(rigid.from_rpy((0.1, 0.0, 0.1), (0.5, 0.0, 0.0)), NEAR)
    later = HOME.decayed(turned, SETTINGS.roll_memory_s)
    assert later.T[2, 1] == pytest.approx(np.sin(0.5 / np.e), rel=0.02)
    assert later.T[0, 3] == pytest.approx(0.1, rel=0.02)
    axis = roll_axis(later.T)
    assert axis @ later.covariance @ axis > 0.5 * 0.4**2


def test_no_information_about_the_roll_is_left():
    rng = np.random.default_rng(0)
    J = rng.standard_normal((20, 6))
    T = rigid.from_rpy((0.0, 0.0, 0.1), (0.1, 0.2, 0.3))
    information, gradient = HOME.without_roll(T, J.T @ J, J.T @ rng.standard_normal(20))
    np.testing.assert_allclose(information @ roll_axis(T), 0.0, atol=1e-6)
    assert gradient @ roll_axis(T) == pytest.approx(0.0, abs=1e-6)


# ---- trust


def test_a_misfit_is_smoothed_and_one_window_cannot_decide():
    misfit = SmoothedMisfit(SETTINGS)
    misfit.take(1e6)
    assert misfit.value == pytest.approx(1.0 + SETTINGS.misfit_share * (SETTINGS.misfit_cap - 1.0))
    before = misfit.value
    assert misfit.after(1.0) < before and misfit.value == before, "asked for, and not taken"


def test_a_pad_that_never_fits_loses_its_weight_and_the_others_keep_theirs(skin: Skin):
    pads = PadTrust(skin, SETTINGS)
    residuals = np.where(skin.pad_of == 2, 6.0, 1.0)
    for _ in range(200):
        pads.update(residuals, np.ones(len(skin), bool))
    distrust = pads.distrust()
    assert distrust[skin.pad_of == 2] == pytest.approx((36.0 / SETTINGS.pad_misfit) ** 2, rel=0.05)
    np.testing.assert_array_equal(distrust[skin.pad_of != 2], 1.0)
    pads.forget()
    np.testing.assert_array_equal(pads.distrust(), 1.0)


# ---- starts


@pytest.fixture(scope="module")
def limb(skin: Skin) -> Limb:
    table = cells.load("table")
    mesh = target_mesh(table.targets["forearm"], table)
    return Limb(skin, Surface(mesh.vertices, mesh.faces))


def nothing_felt(skin: Skin) -> Reading:
    ones = np.ones(len(skin))
    return Reading(0.0 * ones, ones, skin.T_world_pads(), ones, 0.0 * ones, 0.0 * ones)


def test_starts_from_scratch_lie_along_the_limb_clear_of_the_pads_and_end_with_the_network_s(skin: Skin, limb: Limb):
    by_network, reading = rigid.transform([9.0, 0.0, 0.0]), nothing_felt(skin)
    low = rigid.transform([0.0, 0.0, 0.02])  # inside the table
    starts = Starts(low, limb, lambda reading: by_network, SETTINGS)
    size = np.zeros(2)
    poses = [starts.at(which, reading, size) for which in range(len(starts))]
    assert poses[-1] is by_network
    assert [T[0, 3] for T in poses[:-1]] == pytest.approx(SETTINGS.slides)
    assert min(limb.gap(reading, T, size) for T in poses[:-1]) > SETTINGS.clearance - 0.01


def test_another_start_than_the_track_is_tried_every_few_windows_and_never_from_where_the_track_is(skin: Skin, limb: Limb):
    home, reading = rigid.transform([0.0, 0.0, 0.2]), nothing_felt(skin)
    starts = Starts(home, limb, lambda reading: home, SETTINGS)
    due = [starts.is_due() for _ in range(3 * SETTINGS.elsewhere_every)]
    assert np.flatnonzero(due).tolist() == [SETTINGS.elsewhere_every * k - 1 for k in (1, 2, 3)]
    tracked = rigid.transform([-0.08, 0.0, 0.2])
    for _ in range(2 * len(starts)):
        start = starts.elsewhere(reading, tracked, np.zeros(2))
        assert start is home or abs(start[0, 3] + 0.08) >= SETTINGS.elsewhere_away
