"""The benchmarks of the search: their bound, their statistics, and that they run."""

import itertools
import json
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from penumbra.services.search import contour
from penumbra.services.search.tracker import Searched
from penumbra.shared.body import anatomy
from penumbra.shared.contract.labels import Label
from penumbra.shared.contract.messages import FusedPose, VisionPose
from penumbra.shared.geometry import rigid
from penumbra.shared.perception.intrinsics import Intrinsics
from penumbra.sim.sets import shots
from penumbra.tests.bench import lost, search, tracking
from penumbra.tests.bench.lib import bound, judgements, searches, verdicts


def rms_cm(information: np.ndarray) -> float:
    return 100.0 * bound.position_rms([information])


def test_the_bound_of_the_occluding_edges_is_that_of_renderings():
    ratios = []
    for index in range(4):
        shot = shots.shot(41, index, images=False)
        edges, rendered = bound.information(shot, facets=True), bound.rendered_information(shot)
        # renderings are blurred by a pixel's share and differ over finite steps, which the fingers and the thumb feel
        np.testing.assert_allclose(np.sqrt(np.diag(edges)), np.sqrt(np.diag(rendered)), rtol=0.15)
        ratios.append(rms_cm(edges) / rms_cm(rendered))  # noise informs where there is next to nothing: above 1
    assert 0.95 < np.median(ratios) < 1.2


def test_the_bound_is_that_of_the_contour_which_the_search_would_trace_in_a_finer_picture():
    shot, finer = shots.shot(42, 0, images=False), 8
    camera, T = shot.camera, shot.T_camera_target
    model, k = contour.Model(shot.mesh), Intrinsics.of_window(camera, 0, 0, 1)
    fine = Intrinsics(k.fx * finer, k.fy * finer, (k.cx + 0.5) * finer - 0.5, (k.cy + 0.5) * finer - 0.5)
    V = model.in_camera(T)
    points = model.outline(V, fine, (camera.height * finer, camera.width * finer), 0.5 * finer)
    near = bound._visible(shot, (points["pixel"] + 0.5) / finer - 0.5)
    points = points[near]
    normals, X = points["normal"], points["position"]
    a, b = normals[:, 0] * k.fx / X[:, 2], normals[:, 1] * k.fy / X[:, 2]
    by_position = np.column_stack([a, b, -(a * X[:, 0] + b * X[:, 1]) / X[:, 2]])
    motion = np.hstack([by_position, np.cross(X - T[:3, 3], by_position)])
    traced = (motion * (points["length"] / finer / bound.VARIANCE_PX2)[:, None]).T @ motion
    np.testing.assert_allclose(np.diag(bound.information(shot)), np.diag(traced), rtol=0.1)


def test_the_less_is_seen_and_the_coarser_the_picture_the_larger_is_the_bound():
    def median(hidden: float, width: int) -> float:
        pictures = [shots.shot(43, i, width, width * 3 // 4, 1.5, hidden, images=False) for i in range(8)]
        return float(np.median(bound.position_errors([bound.information(shot) for shot in pictures])))

    by_hidden = [median(hidden, 640) for hidden in searches.HIDDEN]
    assert all(a < b for a, b in itertools.pairwise(by_hidden))
    assert median(0.0, 320) > 1.5 * by_hidden[0]


def test_an_efficient_estimator_has_the_errors_of_its_information():
    errors = bound.position_errors([np.diag([1e4, 1e4, 1e4, 1.0, 1.0, 1.0])], draws=4000)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(0.01 * np.sqrt(3.0), rel=0.05)
    assert np.median(errors) == pytest.approx(0.01 * 1.538, rel=0.05)  # of the Maxwell distribution


@pytest.fixture(scope="module")
def drawn() -> list[searches.Result]:
    """Estimates whose errors are drawn from their own covariances, except for the roll."""
    rng = np.random.default_rng(5)
    shot = shots.shot(44, 0, 320, 240, images=False)
    results = []
    for _ in range(400):
        root = rng.normal(size=(6, 6)) * np.repeat([0.003, 0.02], 3)[:, None]
        error = root @ rng.normal(size=6)
        error[3:] += rng.normal() * shot.T_world_target[:3, 0]  # a roll that no covariance contains
        T = rigid.perturb(shot.T_world_target, -error)
        results.append(searches.Result(Searched(T, root @ root.T, 0.95, 0.0, "tracking", T), shot, 1.0))
    return results


def test_true_covariances_lie_in_the_band_and_too_small_ones_do_not(drawn):
    small = [r for r in drawn if np.linalg.norm(r.error[3:]) < 0.3]  # a rotation vector is a vector for small ones only
    told = search.nees(small)
    assert told["frames"] == len(small) > 60
    assert told["band"][0] < told["mean"] < told["band"][1]
    boasting = [replace(r, estimate=replace(r.estimate, covariance=r.estimate.covariance / 2.0)) for r in small]
    assert search.nees(boasting)["mean"] > search.nees(boasting)["band"][1]


def test_errors_are_told_apart_along_and_across_the_line_of_sight_and_about_the_limb():
    shot = shots.shot(45, 0, 320, 240, images=False)
    sight = shot.T_world_target[:3, 3] - shot.camera.T_world_camera[:3, 3]
    sight /= np.linalg.norm(sight)
    roll = 0.3 * shot.T_world_target[:3, 0]
    T = rigid.perturb(shot.T_world_target, [*(0.02 * sight), *roll])
    result = searches.Result(Searched(T, np.eye(6), 1.0, 0.0, "tracking", T), shot, 1.0)
    assert (result.depth, result.lateral) == pytest.approx((0.02, 0.0), abs=1e-9)
    assert (result.roll, result.axis) == pytest.approx((0.3, 0.0), abs=1e-6)
    assert not result.is_wrong


def test_the_area_under_the_curve_counts_pairs_in_order():
    positive = np.array([True, True, False, False])
    assert judgements.auc(np.array([3.0, 2.0, 1.0, 0.0]), positive) == 1.0
    assert judgements.auc(np.array([np.inf, 1.0, 2.0, 0.0]), positive) == 0.75
    assert judgements.auc(np.ones(4), positive) == 0.5
    assert judgements.auc(np.ones(4), np.zeros(4, bool)) is None


def test_a_mask_shows_the_target_where_it_agrees_with_the_truth_at_any_scale():
    shot = shots.shot(48, 0, 320, 240, hidden=0.3, images=False)
    window = searches.window_of(shot, shot.T_world_target)
    mask = searches.exact_mask(shot, window)
    assert judgements.shows_target(mask, shot)
    coarse = msgspec.structs.replace(mask, labels=np.ascontiguousarray(mask.labels[::2, ::2]), scale=2)
    assert judgements.shows_target(coarse, shot)
    assert not judgements.shows_target(msgspec.structs.replace(mask, labels=np.zeros_like(mask.labels)), shot)
    assert not judgements.shows_target(msgspec.structs.replace(mask, x0=mask.x0 // 2, y0=mask.y0 // 2 + 40), shot)


def test_giving_up_is_right_where_a_mask_shows_something_else_and_the_start_was_right_by_luck():
    def told(state: Any, wrong: bool, shown: bool) -> bool:
        T = np.eye(4)
        return judgements.Judgement("wrong mask", Searched(T, np.eye(6), 1.0, 0.0, state, T), wrong, shown).should_be_doubted

    assert told("lost", False, False) and told("lost", True, True) and told("tracking", True, True)
    assert not told("lost", False, True)  # it could have been measured
    assert not told("tracking", False, False)  # right all the same


def test_the_share_of_right_poses_is_told_by_their_confidence():
    T = np.eye(4)

    def frame(confidence: float, wrong: bool) -> judgements.Judgement:
        return judgements.Judgement(
            "good start", Searched(T, np.eye(6), 1.0, 0.0, "tracking", T, confidence=confidence), wrong, True
        )

    rows = judgements.reliability([frame(0.95, False), frame(0.97, True), frame(1.0, False), frame(0.2, True)])
    assert [(row["frames"], row["confidence"], row["right"]) for row in rows] == [(1, 0.2, 0.0), (3, 0.973, 0.667)]


def test_the_weights_of_the_verdict_are_those_by_which_poses_were_drawn():
    rng = np.random.default_rng(6)
    features = np.column_stack([np.ones(20_000), rng.normal(0.8, 0.1, 20_000), rng.normal(2.0, 1.0, 20_000)])
    weights = np.array([-7.0, 10.0, -0.5])
    is_right = (rng.random(20_000) < 1.0 / (1.0 + np.exp(-features @ weights))).astype(float)
    np.testing.assert_allclose(verdicts.fitted(features, is_right), weights, rtol=0.05, atol=0.02)


@pytest.mark.slow
def test_the_search_s_benchmark_runs_and_tells_all_rows(tmp_path):
    out = tmp_path / "search.json"
    assert search.main(["--seed", "46", "--quick", "--json", str(out)]) == 0
    result = json.loads(out.read_text())
    rows = {(r["masks"], r["width"], r["distance_m"], r["occlusion"], r["method"]) for r in result["rows"]}
    assert len(rows) == 2 * len(searches.VIEWS) * len(searches.HIDDEN) * 2
    exact = [r for r in result["rows"] if r["masks"] == "exact" and r["width"] == 640 and r["method"] == "contour"]
    assert exact[0]["position_cm"]["median"] < 1.0  # centimetres where nothing is hidden
    assert {"mean", "band"} <= result["nees"].keys()
    assert result["hidden_frames"] > 0
    assert sum(kind["frames"] for kind in result["lost"].values()) == 5 * search.QUICK.lost


def pose(kind, stamp_ns: int, T: np.ndarray, state: Any):
    position, orientation = rigid.position_orientation(T)
    common: dict[str, Any] = {
        "stamp_ns": stamp_ns,
        "target": "forearm",
        "frame": "world",
        "position": position,
        "orientation": orientation,
    }
    if kind is VisionPose:
        return VisionPose(**common, camera="front", covariance=np.eye(6), overlap=1.0, hidden=0.0, state=state)
    return FusedPose(**common, velocity=np.zeros(6), covariance=np.eye(6), state=state, sources={})


def film(hidden: list[float], states: list[str]) -> tracking.Film:
    truths = [tracking.Truth(i, np.eye(4), share) for i, share in enumerate(hidden)]
    vision = {i: pose(VisionPose, i, np.eye(4), state) for i, state in enumerate(states)}
    return tracking.Film(truths, vision, {i: pose(FusedPose, i, np.eye(4), "coasting") for i in range(len(hidden))})


def test_recovery_is_counted_from_the_first_frame_that_shows_the_arm_again():
    hidden = [0.0, 0.6, 1.0, 1.0, 0.8, 0.4, 0.1, 0.0, 0.0]
    states = ["tracking", "tracking", "occluded", "occluded", "lost", "lost", "lost", "tracking", "tracking"]
    found = film(hidden, states)
    (begin, end, back), = tracking.passes(found)  # fmt: skip
    assert (begin, end, back) == (2, 3, 5)
    assert tracking.recovery(found, back) == 3
    assert tracking.recovery(film(hidden, ["lost"] * 9), back) is None


def test_tracking_what_is_hidden_is_counted_as_false(monkeypatch):
    monkeypatch.setattr(tracking, "SKIPPED_S", 0.0)
    told = tracking.scored([film([0.0, 1.0, 0.97, 0.2], ["tracking", "tracking", "occluded", "lost"])])
    assert (told["false_tracking"], told["hidden_frames"]) == (1, 2)
    assert told["tracked"] == 0.5


def test_a_lost_stream_is_recovered_in_the_frame_of_its_first_right_pose():
    wrong = film([0.0] * 4, ["lost", "tracking", "tracking", "lost"])
    wrong.vision[1] = pose(VisionPose, 1, rigid.transform((8.0, 0.0, 0.0)), "tracking")
    told = lost.scored([wrong, film([0.0] * 4, ["lost"] * 4)])
    beyond = {"vision": 0.5, "fused": None}
    assert told == {"streams": 2, "recovered": 1, "median": 3.0, "frames": [3, None], "wrong": 1, "beyond_3_sigma": beyond}


def test_an_outline_is_compared_with_the_arms_that_it_touches():
    cell = lost.cell_of(np.zeros((240, 320, 3), np.uint8))
    T = rigid.transform((0.0, 0.0, 0.8))
    model = contour.Model(anatomy.target_mesh(cell.targets["arm"], cell))
    k = Intrinsics.of_window(cell.cameras["camera"], 0, 0, 1)
    labels = np.where(model.silhouette(T, k, (0, 0, 320, 240)), np.uint8(Label.FOREARM), np.uint8(Label.BACKGROUND))
    labels[:20, :20] = Label.HAND  # another arm
    outline = lost.Outline(cell, labels)
    assert outline.iou(T) == 1.0
    assert 0.05 < outline.iou(rigid.transform((0.05, 0.05, 0.8))) < 0.5
    assert outline.iou(rigid.transform((0.0, 0.3, 0.8))) == 0.0


@pytest.mark.slow
def test_the_benchmark_of_lost_streams_runs(tmp_path):
    out = tmp_path / "lost.json"
    assert lost.main(["--seed", "47", "--quick", "--json", str(out)]) == 0
    rows = json.loads(out.read_text())["streams"]
    assert {row["landmarks"] for row in rows} <= {"off", "auto"} and all(row["streams"] == 1 for row in rows)


@pytest.mark.slow
def test_the_tracking_benchmark_runs_on_both_backgrounds(tmp_path):
    out = tmp_path / "tracking.json"
    assert tracking.main(["--seed", "47", "--quick", "--json", str(out)]) == 0
    rows = json.loads(out.read_text())["rows"]
    assert [row["background"] for row in rows] == ["plain", "cluttered"]
    assert all(row["hidden_frames"] > 0 for row in rows)
    assert all(row["visible_cm"]["median"] is not None for row in rows[:1])
