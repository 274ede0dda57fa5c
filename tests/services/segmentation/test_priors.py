"""Priors: what is known of a window beside its picture, drawn for the network and for its training."""

import cv2
import numpy as np
import pytest

from penumbra.services.segmentation import model, priors
from penumbra.services.segmentation.training import priors as drawn
from penumbra.shared.body import anatomy
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import TARGET_LABELS, UNLABELLED, Label
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.perception.intrinsics import Intrinsics
from penumbra.shared.perception.lookout import Window
from penumbra.sim.sets import sequences, shots

ROBOT, TARGET = (model.PRIORS.index(name) for name in ("robot", "target"))
SURE = 1e-10 * np.eye(6)


@pytest.fixture(scope="module")
def shot() -> shots.Shot:
    """The arm cell, with its robot and target in the picture."""
    found = (shots.shot(36, index, 320, 240, images=False) for index in range(1, 40, 2))
    return next(shot for shot in found if shot.joints and (shot.labels == Label.ROBOT).sum() > 500)


def of(shot: shots.Shot) -> priors.Priors:
    return priors.Priors(shot.cell, next(iter(shot.cell.cameras)), shot.cell.targets)


@pytest.mark.parametrize("window", [Window(0, 0, 320, 240), Window(0, 0, 160, 120, 2), Window(64, 40, 96, 128)])
def test_robot_and_target_are_where_the_picture_shows_them(shot, window):
    known = of(shot)(window, dict.fromkeys(shot.cell.targets, (shot.T_world_target, SURE)), shot.joints)
    assert known.shape == (window.height, window.width, 2) and known.dtype == np.float32
    middle = window.scale // 2
    labels = shot.labels[window.y0 + middle : window.bottom : window.scale, window.x0 + middle : window.right : window.scale]
    inner = lambda mask: cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0  # noqa: E731
    for channel, shown in ((ROBOT, labels == Label.ROBOT), (TARGET, np.isin(labels, TARGET_LABELS))):
        if inner(shown).any():  # pads stand out of the robot's hull, and are a part of it in the picture
            assert (known[..., channel][inner(shown)] == 1.0).mean() > 0.85
    free = inner(labels == Label.BACKGROUND)
    assert (known[free] == -1.0).mean() > 0.95


def test_what_is_not_known_is_zero(shot):
    window, pose = Window(0, 0, 320, 240), (shot.T_world_target, SURE)
    nothing = of(shot)(window, {}, {})
    assert not nothing.any()
    half = of(shot)(window, {}, shot.joints)
    assert not half[..., TARGET].any() and set(np.unique(half[..., ROBOT])) == {-1.0, 1.0}
    two = shot.cell.model_copy(update={"targets": {name: next(iter(shot.cell.targets.values())) for name in "ab"}})
    one_lost = priors.Priors(two, next(iter(two.cameras)), "ab")(window, {"a": pose}, shot.joints)
    assert set(np.unique(one_lost[..., TARGET])) == {0.0, 1.0}, "the other one may be anywhere"
    behind = rigid.perturb(shot.camera.T_world_camera, np.zeros(6)), SURE
    assert not of(shot)(window, dict.fromkeys(shot.cell.targets, behind), {})[..., TARGET].any()


def test_a_silhouette_is_as_soft_as_its_pose_is_uncertain():
    """The mean of the silhouettes of drawn poses, and what the blur makes of the middle one."""
    cell = cells.load("table")
    mesh = anatomy.target_mesh(next(iter(cell.targets.values())), cell)
    rng, k, shape = np.random.default_rng(0), Intrinsics(400.0, 400.0, 96.0, 80.0), (160, 192)
    T = rigid.from_rpy((0.0, 0.0, 1.2), (0.3, 0.4, 0.5))
    for metres, turn in ((0.004, 0.02), (0.015, 0.1), (0.04, 0.2)):
        stated = np.repeat([metres, turn], 3)
        mean = np.zeros(shape)
        for error in stated * rng.normal(size=(300, 6)):
            points = rigid.apply(rigid.perturb(T, error), mesh.vertices)
            mean += raster.silhouette(points, mesh.faces, (k.fx, k.fy, k.cx, k.cy), (0, 0, 192, 160)) / 300.0
        found = priors.silhouette(mesh, T, np.diag(stated**2), k, shape)
        assert found is not None and found.min() >= 0.0 and found.max() <= 1.0 + 1e-6
        assert np.abs(found - mean)[(mean > 0.01) | (found > 0.01)].mean() < 0.06
        assert np.abs(found - mean).max() < 0.5  # one blur for all of the limb, whose ends are less sure than its middle


def test_a_wide_blur_on_a_coarse_grid_is_that_of_the_fine_one():
    rng = np.random.default_rng(0)
    shares = (cv2.GaussianBlur(rng.normal(size=(128, 160)), (0, 0), 6.0) > 0.0).astype(np.float32)
    for sigma in (0.3, 2.0, 5.0, 11.0, 17.0):
        wanted = cv2.GaussianBlur(shares, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE) if sigma > 0.4 else shares
        inner = np.s_[32:-32, 32:-32]  # beyond the border pixels go on as they are there, and the coarse grid's are larger
        np.testing.assert_allclose(priors.blurred(shares, (sigma, sigma))[inner], wanted[inner], atol=0.03)


@pytest.fixture(scope="module")
def simulated() -> list[sequences.Sequence]:
    return [sequences.render(77, index, sequences.Variety(frames=5, size=96)) for index in range(24)]


def test_a_training_draws_right_wrong_and_missing_priors_and_bytes_keep_them(simulated):
    rng = np.random.default_rng(0)
    films = [drawn.of_sequence(sequence, rng) for sequence in simulated for _ in range(6)]
    for channel in (ROBOT, TARGET):
        missing = [not film[..., channel].any() for film in films]
        frames = [film[..., channel].reshape(len(film), -1).any(1) for film in films]
        assert 0.2 < np.mean(missing) < 0.5
        assert 0.05 < np.mean([there.any() and not there.all() for there in frames]) < 0.4, "lost or found in between"
    kept = drawn.unpacked(drawn.packed(films[0]))
    np.testing.assert_allclose(kept, films[0], atol=0.005)
    assert not drawn.unpacked(drawn.packed(np.zeros((2, 2), np.float32))).any(), "nothing is nothing"


def test_right_priors_lie_on_the_target_and_wrong_ones_do_not(simulated):
    on: dict[drawn.Kind, list[float]] = {"right": [], "wrong": []}
    for index, sequence in enumerate(simulated):
        shown = np.isin(sequence.labels, TARGET_LABELS)
        if shown.sum() < 500 or sequence.hidden.max() > 0.5:
            continue
        for kind in on:
            known = drawn.of_sequence(sequence, np.random.default_rng(index), kind)[..., TARGET]
            on[kind].append(float(known[shown].mean() - known[~shown].mean()))
    assert len(on["right"]) > 5 and np.mean(on["right"]) > 0.5 > 0.3 > np.mean(on["wrong"])


def test_robots_are_known_where_something_covers_them(simulated):
    covered = 0
    for sequence in simulated:
        assert sequence.robots is not None
        assert sequence.robots[sequence.labels == Label.ROBOT].mean() > 0.999 if (sequence.labels == Label.ROBOT).any() else True
        covered += (sequence.robots & (sequence.labels != Label.ROBOT)).sum()
    assert covered > 1000


def test_of_labels_alone_a_prior_shows_both_arms_or_one():
    labels = np.full((5, 96, 96), Label.BACKGROUND, np.uint8)
    labels[:, 20:80, 10:25], labels[:, 20:80, 70:85], labels[:, :5] = Label.FOREARM, Label.HAND, UNLABELLED
    shown = set()
    for seed in range(60):
        known = drawn.of_labels(labels, np.random.default_rng(seed), "right")
        assert known.shape == (5, 96, 96, 2) and not known[..., ROBOT].any()
        if known.max() > 0.8:  # a sharp one
            shown.add((known[..., 10:25, TARGET].max() > 0.5, known[..., 70:85, TARGET].max() > 0.5))
    assert {(True, True), (True, False), (False, True)} <= shown
    assert not drawn.of_labels(np.zeros_like(labels), np.random.default_rng(0), "right").any()
