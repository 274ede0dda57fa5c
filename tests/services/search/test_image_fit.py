"""The refinement of the pose on the image, on rendered pictures with their truth."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from penumbra.services.search import contour, detect, evidence, tracker
from penumbra.services.search.contour import MEASURED, POINT
from penumbra.services.search.image_fit import UNKNOWNS, ImageSettings, fit_image, offsets, unfitted
from penumbra.services.search.mask_fit import Limits, hand_differs, marginal
from penumbra.services.search.rivals import PASSES, RIVALS
from penumbra.services.search.tracker import Search, Searched
from penumbra.shared.contract.labels import TARGET_LABELS, Label
from penumbra.shared.contract.messages import Mask
from penumbra.shared.geometry import rigid
from penumbra.shared.perception.intrinsics import Intrinsics
from penumbra.shared.perception.lookout import corners_of, window_around
from penumbra.sim.sets import shots
from penumbra.sim.sets.shots import Shot

PRIOR = np.diag(np.repeat([0.0115**2, 0.04**2], 3))
"""Covariance of the starts: together 2 cm and 4 degrees."""
SEEDS = range(8)


def with_open_roll(T: np.ndarray) -> np.ndarray:
    """PRIOR of a limb at T whose roll is not known, as of one that was just found."""
    covariance = PRIOR.copy()
    covariance[3:, 3:] += 2.0**2 * np.outer(T[:3, 0], T[:3, 0])
    return covariance


def pictures(hidden: float) -> list[Shot]:
    return [shots.shot(7100, index, hidden=hidden, domain="easy") for index in SEEDS]


@pytest.fixture(scope="module")
def half_hidden() -> list[Shot]:
    return pictures(0.4)


@pytest.fixture(scope="module")
def visible() -> list[Shot]:
    return pictures(0.0)


def start(shot: Shot, seed: int) -> np.ndarray:
    return rigid.perturb(shot.T_world_target, np.random.default_rng(seed).normal(size=6) * np.sqrt(np.diag(PRIOR)))


def mask(shot: Shot, T: np.ndarray, spoiled: float = 0.0, seed: int = 0) -> Mask:
    """The exact mask around a pose; `spoiled` [px]: the boundary off by that everywhere, and by as much correlated noise."""
    window = window_around(shot.camera, [(T, corners_of(shot.mesh.vertices))])
    assert window is not None and window.scale == 1
    labels = shot.labels[window.y0 : window.bottom, window.x0 : window.right].copy()
    if spoiled:
        target = np.isin(labels, (Label.FOREARM, Label.HAND)).astype(np.uint8)
        distance = cv2.distanceTransform(target, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - target, cv2.DIST_L2, 5)
        wobble = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=labels.shape), (0, 0), 3.0)
        larger = distance - np.sign(distance) / 2 + spoiled * (1.0 + wobble / wobble.std()) > 0
        labels[larger & (labels == Label.BACKGROUND)] = Label.FOREARM
        labels[~larger & (target != 0)] = Label.BACKGROUND
    return Mask(stamp_ns=shot.stamp_ns, labels=labels, x0=window.x0, y0=window.y0, scale=1)


def error_cm(shot: Shot, estimate: Searched) -> float:
    return 100.0 * float(np.linalg.norm(shot.T_world_target[:3, 3] - estimate.T[:3, 3]))


def test_the_image_takes_out_what_a_mask_is_too_large(visible):
    alone, together = [], []
    for seed, shot in enumerate(visible):
        T, search = start(shot, seed), Search(shot.cell)
        spoiled = mask(shot, T, 0.7, seed)
        alone.append(error_cm(shot, search.update(spoiled, T, PRIOR, shot.joints)))
        estimate = search.update(spoiled, T, PRIOR, shot.joints, shot.image)
        assert estimate.state == "tracking"
        together.append(error_cm(shot, estimate))
    assert np.median(together) < 0.6
    assert np.median(together) < 0.5 * np.median(alone)


def test_the_covariance_of_the_refined_pose_is_that_of_its_errors(visible, half_hidden):
    nees = []
    for seed, shot in enumerate([*visible, *half_hidden]):
        T, search = start(shot, seed), Search(shot.cell)
        for _ in range(2 * RIVALS):  # until all are refuted, which takes two pictures each, a pose is less certain
            estimate = search.update(mask(shot, T, 0.4, seed), T, PRIOR, shot.joints, shot.image)
        if estimate.state == "tracking":
            error = rigid.pose_error(shot.T_world_target, estimate.T)
            nees.append(error @ np.linalg.solve(estimate.covariance, error))
    assert len(nees) > 10
    assert 0.5 < np.median(nees) < 9.0  # chi^2 with six degrees of freedom: 5.3


def test_the_roll_of_a_limb_that_was_just_found_is_open_until_its_rivals_are_compared(visible):
    for seed, shot in enumerate(visible):
        T, search = start(shot, seed), Search(shot.cell)
        estimates = [search.update(mask(shot, T), T, with_open_roll(T), shot.joints, shot.image) for _ in range(RIVALS)]
        rolls = [float(np.sqrt(each.T[:3, 0] @ each.covariance[3:, 3:] @ each.T[:3, 0])) for each in estimates]
        assert rolls[0] > 1.0
        assert rolls[-1] < 0.5 * rolls[0]
        places = [np.sqrt(np.trace(each.covariance[:3, :3])) for each in estimates]
        assert places[0] < 2.0 * places[-1]  # the place is known at once


def test_an_occluder_that_the_mask_takes_for_background_is_not_accepted(half_hidden):
    errors = []
    for seed, shot in enumerate(half_hidden):
        T = start(shot, seed)
        blind = mask(shot, T)
        labels = np.where(blind.labels == Label.OCCLUDER, np.uint8(Label.BACKGROUND), blind.labels)
        estimate = Search(shot.cell).update(replace(blind, labels=labels), T, PRIOR, shot.joints, shot.image)
        if estimate.state == "tracking":
            errors.append(error_cm(shot, estimate))
    assert len(errors) >= len(SEEDS) - 1
    assert max(errors) < 3.0


def test_a_mask_beside_the_limb_is_corrected_or_not_accepted(visible):
    for seed, shot in enumerate(visible):
        T = start(shot, seed)
        right = mask(shot, T)
        estimate = Search(shot.cell).update(
            replace(right, labels=np.roll(right.labels, 10, axis=1)), T, PRIOR, shot.joints, shot.image
        )
        assert estimate.state != "tracking" or error_cm(shot, estimate) < 1.5


def test_an_image_of_another_camera_is_refused(visible):
    shot = visible[0]
    with pytest.raises(ValueError, match=r"image: expected 640 x 480.*got 320 x 240"):
        Search(shot.cell).update(mask(shot, shot.T_world_target), shot.T_world_target, PRIOR, shot.joints, shot.image[::2, ::2])


def turned(shot: Shot, degrees: float) -> np.ndarray:
    T = shot.T_world_target.copy()
    T[:3, :3] = rigid.rotation(np.radians(degrees) * T[:3, 0]) @ T[:3, :3]
    return T


def off(shot: Shot, estimate: Searched) -> np.ndarray:
    return rigid.pose_error(shot.T_world_target, estimate.T)


def looked_at(shot: Shot, mask: Mask, image: np.ndarray, T: np.ndarray, prior: np.ndarray) -> list[Searched]:
    """The estimates of pictures of a limb at rest, whose prediction T stays wrong: one round of rivals, and one more."""
    search = Search(shot.cell)
    return [search.update(mask, T, prior, shot.joints, image) for _ in range(2 * RIVALS)][RIVALS:]


@pytest.mark.parametrize("degrees", [-140.0, -60.0, 60.0, 140.0])
def test_a_limb_with_its_hand_in_sight_does_not_stay_turned_over(visible, degrees):
    right = []
    for shot in visible:
        estimates = looked_at(shot, mask(shot, shot.T_world_target), shot.image, turned(shot, degrees), PRIOR)
        rolls = [abs(np.degrees(off(shot, estimate)[3:] @ estimate.T[:3, 0])) for estimate in estimates]
        right.append(np.median(rolls) < 10.0)
    assert np.mean(right) > 0.8


def test_a_hand_differs_from_the_mask_at_another_turn_and_less_where_it_is_hidden(visible):
    def differs(shot: Shot, seen: Mask, degrees: float) -> int:
        k = Intrinsics.of_window(shot.camera, seen.x0, seen.y0, seen.scale)
        known = evidence.gather(evidence.classify(seen.labels, TARGET_LABELS), seen.labels, k, seen.x0, seen.y0, seen.scale)
        T_camera_world = rigid.inverse(shot.camera.T_world_camera)
        return hand_differs(contour.Model(shot.mesh), T_camera_world @ turned(shot, degrees), known)

    for shot in visible:
        shown, behind = mask(shot, shot.T_world_target), with_hand_covered(shot)[0]
        assert differs(shot, shown, 0.0) == differs(shot, behind, 0.0) == 0
        assert differs(shot, shown, 90.0) > max(200, 2 * differs(shot, behind, 90.0))


def test_a_turn_that_takes_the_pose_s_place_is_doubted_until_the_others_are_compared_with_it(visible):
    changes = []
    for shot in visible:
        T, search = turned(shot, 120.0), Search(shot.cell)
        estimates = [
            search.update(mask(shot, shot.T_world_target), T, with_open_roll(T), shot.joints, shot.image)
            for _ in range(3 * RIVALS)
        ]
        errors = [abs(off(shot, each)[3:] @ each.T[:3, 0]) for each in estimates]
        spreads = [float(np.sqrt(each.T[:3, 0] @ each.covariance[3:, 3:] @ each.T[:3, 0])) for each in estimates]
        changes += [
            (spreads[i + 1], spreads[-1])
            for i in range(len(errors) - 1)
            if errors[i] > 0.5 and errors[i + 1] < 0.2 and errors[-1] < 0.2
        ]
    assert len(changes) >= len(visible) // 2
    first, last = np.array(changes).T
    assert first.min() > 1.0 and np.median(last) < 0.5 * np.median(first)


def test_a_limb_that_was_found_tilted_too_little_does_not_stay_so():
    shot = shots.shot(7200, 14, hidden=0.0, domain="easy")
    camera, search, errors = shot.camera.T_world_camera, Search(shot.cell), []
    T = camera @ detect.tilted(rigid.inverse(camera) @ shot.T_world_target, np.radians(22.0))
    T[:3, 3] += (shot.T_world_target[:3, :3] - T[:3, :3]) @ shot.mesh.vertices.mean(axis=0)
    for _ in range(3 * RIVALS):
        estimate = search.update(mask(shot, T, 0.4), T, 25.0 * PRIOR, shot.joints, shot.image)
        T = estimate.T_searched
        errors.append(error_cm(shot, estimate))
    assert errors[0] > 2.0
    assert np.median(errors[RIVALS:]) < 1.0


def with_hand_covered(shot: Shot) -> tuple[Mask, np.ndarray]:
    """Mask and image of a scene in which something lies before the hand."""
    assert shot.image is not None
    image, seen = shot.image.copy(), mask(shot, shot.T_world_target)
    rows, columns = np.nonzero(shot.labels == Label.HAND)
    covered = (slice(rows.min() - 4, rows.max() + 5), slice(columns.min() - 4, columns.max() + 5))
    image[covered] = (90, 120, 60)
    labels = shot.labels.copy()
    labels[covered] = Label.OCCLUDER
    h, w = seen.labels.shape
    return replace(seen, labels=labels[seen.y0 : seen.y0 + h, seen.x0 : seen.x0 + w]), image


def test_a_roll_that_a_hidden_hand_leaves_open_is_uncertain(visible):
    nees = []
    for shot in visible:
        behind, image = with_hand_covered(shot)
        T = turned(shot, 120.0)
        for estimate in looked_at(shot, behind, image, T, with_open_roll(T)):
            if estimate.state == "tracking":
                error = off(shot, estimate)
                nees.append(error @ np.linalg.solve(estimate.covariance, error))
    assert len(nees) > 10
    assert np.mean(np.array(nees) > 20.1) < 0.1  # beyond three standard deviations


def test_a_bent_hand_leaves_the_roll_open_and_nothing_else():
    rng = np.random.default_rng(4)
    T, limits = rigid.perturb(np.eye(4), rng.normal(size=6)), Limits()
    J = rng.normal(size=(40, 7)) * [3e3, 3e3, 1e3, 3e2, 3e2, 3e2, 1.0]
    straight, bent = (marginal(T, np.zeros(7), J.T @ J, np.zeros(7), np.eye(7), rolls, limits)[1] for rolls in (1.0, None))
    axis = np.concatenate([np.zeros(3), T[:3, 0]])
    np.testing.assert_allclose(bent - straight, limits.rotation**2 * np.outer(axis, axis), atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_what_the_prediction_knows_stays_known_where_the_hand_is_hidden(visible, seed):
    shot = visible[seed]
    behind, image = with_hand_covered(shot)
    T = start(shot, seed)
    known, not_known = (looked_at(shot, behind, image, T, prior)[-1] for prior in (PRIOR, with_open_roll(T)))
    place, open_place = (np.sqrt(np.trace(each.covariance[:3, :3])) for each in (known, not_known))
    roll, open_roll = (np.sqrt(each.T[:3, 0] @ each.covariance[3:, 3:] @ each.T[:3, 0]) for each in (known, not_known))
    assert known.state == not_known.state == "tracking"
    assert place < open_place and roll < 0.9 * open_roll
    assert error_cm(shot, known) < 3.0 * 100.0 * place


def test_the_edge_of_a_side_in_the_shade_is_found_where_it_is():
    # a limb above row 30 darkens towards its edge, to what is behind it but for a little blue
    depth = np.arange(29.5, -31.0, -1.0)[:60, None]
    limb = np.array([103.0, 85.0, 74.0]) + np.clip(depth - 1.0, 0.0, 12.0) * [9.0, 6.0, 5.0]
    light = np.repeat(np.where(depth > 0.0, limb, [104.0, 88.0, 90.0])[:, None] ** 2, 80, axis=1)
    values = np.sqrt(cv2.GaussianBlur(light, (0, 0), 0.7)) + np.random.default_rng(1).normal(0.0, 1.5, light.shape)
    points = np.zeros(20, POINT)
    points["pixel"] = np.column_stack([np.arange(10.0, 70.0, 3.0), np.full(20, 29.5)])
    points["normal"], points["length"] = (0.0, 1.0), 3.0
    nothing, settings = np.zeros((60, 80), np.uint8), ImageSettings()
    noise = (settings.pooling, settings.floor, settings.clipped, settings.temperature, settings.mask)
    r, _, kind = offsets(points, np.rint(values).astype(np.uint8), nothing, np.zeros(20), nothing[0, :20].copy(), *noise)
    assert (kind == MEASURED).all()
    assert abs(np.mean(r)) < 0.1


@pytest.mark.parametrize("points", [8.0, 16.0, 64.0])
def test_what_a_fit_leaves_tells_the_noise_whatever_the_number_of_points(points):
    rng = np.random.default_rng(3)
    left = []
    for _ in range(4000):
        A, r = rng.normal(size=(int(points), UNKNOWNS)), rng.normal(size=int(points))
        left.append(np.mean((r - A @ np.linalg.lstsq(A, r, rcond=None)[0]) ** 2))
    assert unfitted(float(np.sqrt(np.mean(left))), points) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("across", [False, True])
def test_how_far_away_a_distant_limb_is_need_not_be_known_to_expect_it(across):
    states = []
    for index in SEEDS:
        shot = shots.shot(7100, index, 1280, 960, distance_m=6.0, hidden=0.65, domain="easy")
        sight = shot.T_world_target[:3, 3] - np.array(shot.camera.position)
        unsure = np.cross(sight, [0.0, 0.0, 1.0]) if across else sight
        unsure /= np.linalg.norm(unsure)
        prior = PRIOR.copy()
        prior[:3, :3] += 0.2**2 * np.outer(unsure, unsure)
        T = start(shot, index)
        states.append(Search(shot.cell).update(mask(shot, T), T, prior, shot.joints, shot.image).state)
    assert "tracking" not in states if across else np.mean([state == "tracking" for state in states]) > 0.7


def test_a_rival_that_the_image_refuses_is_fitted_to_the_mask_before_it_is_tried_again(monkeypatch):
    """A turned limb of which only a piece shows lies elsewhere than the pose."""
    shot = shots.shot(7400, 1, hidden=0.6, domain="easy")
    shown, search = mask(shot, shot.T_world_target), Search(shot.cell)
    model = contour.Model(shot.mesh)
    k = Intrinsics.of_window(shot.camera, shown.x0, shown.y0, shown.scale)
    is_target = np.isin(shown.labels, TARGET_LABELS)
    fitted: list[tuple[np.ndarray, int, bool]] = []

    def overlap(T: np.ndarray) -> float:
        is_shown = model.silhouette(T, k, (0, 0, *is_target.shape[::-1]))
        covered = np.isin(shown.labels, (Label.FOREARM, Label.HAND, Label.BACKGROUND))  # what may show the target
        return float((is_shown & is_target).sum() / ((is_shown & covered) | is_target).sum())

    def recorded(model, first, image, evidence, T_prior, prior, settings=None):
        found = fit_image(model, first, image, evidence, T_prior, prior, settings or ImageSettings())
        fitted.append((first.T_searched, settings.passes if settings else 0, found.sharp))
        return found

    monkeypatch.setattr(tracker, "fit_image", recorded)
    for i in range(1, RIVALS + 1):
        found = search.update(replace(shown, stamp_ns=50_000_000 * i), shot.T_world_target, PRIOR, shot.joints, shot.image)
        assert found.state == "tracking"
    tried = [(T, sharp) for T, passes, sharp in fitted if passes == PASSES]
    refused = [(T, again) for (T, sharp), (again, _) in itertools.pairwise(tried) if not sharp]
    assert len(tried) > RIVALS and len(refused) >= 2
    nearer = [overlap(again) > overlap(T) for T, again in refused]
    assert np.mean(nearer) > 0.7
