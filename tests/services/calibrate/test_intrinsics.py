"""A lens from views of the board: right within its own uncertainty, robust to a bad view, refused where views do not tell it."""

import numpy as np
import pytest

from penumbra.services.calibrate import intrinsics
from penumbra.services.calibrate.board import CalibrationError
from penumbra.services.calibrate.intrinsics import NAMES, View
from penumbra.services.calibrate.views import Coverage
from penumbra.shared.geometry import rigid
from penumbra.tests.support.charuco import LENS, held

SEEDS = range(3)
"""`penumbra bench calibration` takes more."""


def seen(take, poses, rng):
    return [view for i, T in enumerate(poses) if (view := take(f"{i}", T, rng))]


@pytest.fixture(scope="module")
def many(photographer):
    """Twenty views for each seed."""
    out = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        take = photographer.corners if seed else photographer.view  # of one seed, real pictures
        out.append(seen(take, held(photographer.board, 20, rng), rng))
    return out


def test_intrinsics_and_distortion_are_right_within_three_of_their_own_standard_deviations(photographer, many):
    errors = []
    for views in many:
        found = intrinsics.calibrate(photographer.board, views, LENS.width, LENS.height)
        assert found.rms_px < 0.1 and not found.left_out
        assert found.deviation["fx"] < 0.003 * LENS.fx
        errors.append([(getattr(found.lens, name) - getattr(LENS, name)) / max(found.deviation[name], 1e-9) for name in NAMES])
        grid = LENS.grid()[::40, ::40]
        assert np.abs(found.lens.distorted(grid) - LENS.distorted(grid)).max() < 3.0  # cx and cy shift all, and poses with them
    assert np.abs(errors).max() < 3.0
    assert np.sqrt(np.mean(np.square(errors))) > 0.2  # nor are they far too large


def test_one_view_that_does_not_fit_is_named_and_left_out(photographer, many):
    rng = np.random.default_rng(7)
    views = list(many[0])
    bent = views[4].corners + 3.0 * rng.standard_normal(views[4].corners.shape)
    views[4] = View(views[4].name, bent, views[4].numbers)
    found = intrinsics.calibrate(photographer.board, views, LENS.width, LENS.height)
    assert list(found.left_out) == [views[4].name] and found.left_out[views[4].name] > 1.5
    assert abs(found.lens.fx - LENS.fx) < 3 * found.deviation["fx"]


def test_views_that_mostly_do_not_fit_are_refused(photographer, many):
    rng = np.random.default_rng(8)
    views = [
        View(view.name, view.corners + (4.0 * rng.standard_normal(view.corners.shape) if i % 3 == 0 else 0.0), view.numbers)
        for i, view in enumerate(many[0])
    ]
    with pytest.raises(CalibrationError, match=r"of 20 that do not .*is the board flat"):
        intrinsics.calibrate(photographer.board, views, LENS.width, LENS.height)


def test_too_few_views_and_views_of_one_tilt_are_refused(photographer, many):
    with pytest.raises(CalibrationError, match=r"expected at least 8 pictures that show the board, 15 to 30 are good, got 5"):
        intrinsics.calibrate(photographer.board, many[0][:5], LENS.width, LENS.height)
    rng = np.random.default_rng(3)
    flat = []
    for x in (-0.15, 0.0, 0.1):
        for y in (-0.1, 0.0, 0.08):
            T = np.eye(4)
            T[:3, 3] = np.array([x, y, 0.6]) - np.array([*photographer.board.size, 0.0]) / 2.0
            flat.append(T)
    with pytest.raises(CalibrationError, match=r"at different tilts, got all within . degrees"):
        intrinsics.calibrate(photographer.board, seen(photographer.corners, flat, rng), LENS.width, LENS.height)


def test_coverage_says_what_is_missing_and_takes_only_what_adds_something(photographer, many):
    coverage = Coverage(photographer.board, LENS)
    assert len(coverage.missing()) == 3
    first, *rest = many[0]
    assert coverage.adds(first)
    coverage.add(first)
    assert not coverage.adds(first), "the same view again"
    for view in rest:
        coverage.add(view)
    assert len(" ".join(coverage.missing())) < 120
    parts = Coverage(photographer.board, LENS)
    rng = np.random.default_rng(1)
    T = np.eye(4)
    T[:3, :3] = rigid.rotation((0.0, np.radians(30.0), 0.0))
    T[:3, 3] = np.array([-0.05, -0.05, 0.5]) - T[:3, :3] @ np.array([*photographer.board.size, 0.0]) / 2.0
    parts.add(photographer.corners("tilted", T, rng))
    (sides,) = (each for each in parts.missing() if "tilted" in each)
    # turned by +30 degrees about y (down): the left side comes nearer
    assert sides.startswith(("its right, ", "its left, "))
    nearer = "left" if (T @ [0.0, 0.1, 0.0, 1.0])[2] < (T @ [0.28, 0.1, 0.0, 1.0])[2] else "right"
    assert nearer not in sides.partition("side")[0]
