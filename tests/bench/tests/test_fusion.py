"""The benchmark of fusion: its scores are exact, its senses as good as they say, its rivals sound, and it runs."""

from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from penumbra.services.fusion.observer import ErrorStateObserver
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import perturb
from penumbra.tests.bench import fusion
from penumbra.tests.bench.lib import fusion_runs as runs
from penumbra.tests.bench.lib import fusion_scores as scores
from penumbra.tests.bench.lib.fusion_baselines import FixedLagSmoother, Newest

TILTED = rigid.from_rpy([0.02, -0.03, 0.15], [0.4, -0.3, 0.7])


# ---- scores


def test_the_normalised_error_is_the_squared_one_in_standard_deviations() -> None:
    sigma = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    error = sigma * np.array([1.0, -2.0, 0.5, 0.3, -0.1, 0.2])
    T = perturb(TILTED, -error)
    expected = 1.0 + 4.0 + 0.25 + 0.09 + 0.01 + 0.04
    assert scores.normalised(TILTED, T, np.diag(sigma**2), rolls=True) == pytest.approx(expected, rel=1e-9)
    L = np.random.default_rng(0).normal(size=(6, 6))
    said = perturb(TILTED, -1e-3 * L @ np.ones(6))
    assert scores.normalised(TILTED, said, 1e-6 * L @ L.T, rolls=True) == pytest.approx(6.0, rel=1e-9)


def test_without_the_roll_a_turn_about_the_limb_is_no_error_and_a_turn_across_it_is() -> None:
    rolled = TILTED @ rigid.from_rpy([0, 0, 0], [0.5, 0, 0])
    covariance = np.diag(np.square([0.01, 0.01, 0.01, 0.1, 0.1, 0.1]))
    assert scores.normalised(TILTED, rolled, covariance, rolls=False) == pytest.approx(0.0, abs=1e-18)
    assert scores.normalised(TILTED, rolled, covariance, rolls=True) == pytest.approx(25.0)
    across = TILTED @ rigid.from_rpy([0, 0, 0], [0, 0.2, 0])
    assert scores.normalised(TILTED, across, covariance, rolls=False) == pytest.approx(4.0)
    both = rigid.perturb(rolled, rigid.pose_error(across, TILTED))  # a roll of tens of degrees does not turn the axis's error
    assert scores.normalised(TILTED, both, 4.0 * np.eye(6), rolls=False) == pytest.approx(
        scores.normalised(TILTED, across, 4.0 * np.eye(6), rolls=False)
    )


def test_the_band_is_that_of_the_mean_of_independent_chi_square_values() -> None:
    np.testing.assert_allclose(scores.band([6.0] * 100), chi2.ppf([0.025, 0.975], 600) / 100)
    np.testing.assert_allclose(scores.band([6.0, 5.0, 5.0]), chi2.ppf([0.025, 0.975], 16) / 3)


@pytest.mark.parametrize(("factor", "inside"), [(1.0, (0.9, 1.0)), (1.5, (0.0, 0.05)), (0.7, (0.0, 0.05))])
def test_a_perfect_filter_is_inside_its_band_and_one_that_is_too_sure_or_too_shy_is_not(
    factor: float, inside: tuple[float, float]
) -> None:
    count, instants = 100, 200
    rng = np.random.default_rng(0)
    times = np.tile(0.11 * np.arange(instants), count)
    dof = np.where(times < 10.0, 6, 5)
    found = scores.consistency(times, factor * rng.chisquare(dof), dof, count)
    assert found["mean"] == pytest.approx(factor * dof.mean(), rel=0.02)
    np.testing.assert_allclose(found["band"], chi2.ppf([0.025, 0.975], count * dof.mean()) / count)
    assert inside[0] <= found["inside"] <= inside[1]
    assert (found["band"][0] <= found["mean"] <= found["band"][1]) == (factor == 1.0)


def test_nothing_to_score_is_no_score() -> None:
    assert scores.consistency(np.array([]), np.array([]), np.array([]), 3) == {"mean": None, "band": None, "inside": None}


# ---- runs


def test_the_same_seed_gives_the_same_run_and_another_another() -> None:
    a, b, c = (runs.drawn("visible", seed, 3, 1.0) for seed in (1, 1, 2))
    assert len(a.messages) == len(b.messages)
    for one, same in zip(a.messages, b.messages, strict=True):
        assert one.arrival == same.arrival
        np.testing.assert_array_equal(one.T, same.T)
    assert np.abs(a.messages[0].T - c.messages[0].T).max() > 1e-3


def test_messages_come_in_order_of_arrival_pictures_40_to_60_ms_and_the_skins_3_ms_late() -> None:
    messages = runs.drawn("one sense wrong", 1, 0, 2.0).messages
    assert all(a.arrival <= b.arrival for a, b in itertools.pairwise(messages))
    late = {source: [m.arrival - m.stamp for m in messages if m.source == source] for source in runs.PERIOD_S}
    assert 0.04 <= min(late["vision"]) < max(late["vision"]) <= 0.06
    np.testing.assert_allclose(late["haptic"], 0.003)
    assert any(a.stamp > b.stamp for a, b in itertools.pairwise(messages))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["visible", "part hidden", "hidden, in range"])
def test_the_senses_err_as_their_information_says(name: str) -> None:
    ratios: dict[str, list[float]] = {"vision": [], "haptic": []}
    for index in range(40):
        run = runs.drawn(name, 5, index, 8.0)
        for m in run.messages[::4]:
            e = rigid.pose_error(run.at(m.stamp), m.T)
            if m.source == "haptic":  # its roll is not measured: the error of the axis alone
                e[3:] = np.cross(m.T[:3, 0], run.at(m.stamp)[:3, 0])
            ratios[m.source].append(float(e @ m.information @ e) / (6 if m.source == "vision" else 5))
    for source, found in ratios.items():
        if found:
            # calibration, which no information contains, adds a few per cent; errors that last leave few independent values
            assert 0.8 < np.mean(found) < 1.35, source


def test_a_sense_that_is_wrong_is_wrong_by_10_cm_for_a_second_and_the_other_is_not() -> None:
    run = runs.drawn("one sense wrong", 1, 1, 12.0)
    for index, source in enumerate(("vision", "haptic")):
        for right, wrong in zip(run.messages, runs.wronged(run, 1, index).messages, strict=True):
            moved = np.linalg.norm(rigid.pose_error(wrong.T, right.T))
            assert moved == pytest.approx(0.1 if right.source == source and 10.0 <= right.stamp < 11.0 else 0.0, abs=1e-12)


def test_a_wrong_sense_runs_away_stands_still_drifts_or_is_turned() -> None:
    right = runs.drawn("one sense wrong", 1, 1, 12.0)
    felt = lambda run: [m for m in run.messages if m.source == "haptic" and 10.0 <= m.stamp < 11.0]  # noqa: E731
    wrong = {name: felt(runs.wronged(right, 1, 1, way)) for name, way in runs.WAYS.items()}
    off = {
        name: np.array([rigid.pose_error(b.T, a.T) for a, b in zip(felt(right), found, strict=True)])
        for name, found in wrong.items()
    }
    since = np.array([m.stamp - 10.0 for m in felt(right)])
    for name, far in {
        "off by 10 cm": 0.1 + 0.0 * since,
        "off by 10 cm, running away at 30 cm/s": 0.1 + 0.3 * since,
        "drifting away at 10 cm/s": 0.1 * since,
    }.items():
        np.testing.assert_allclose(np.linalg.norm(off[name][:, :3], axis=1), far, atol=1e-9)
        np.testing.assert_allclose(off[name][:, 3:], 0.0, atol=1e-9)
    still = wrong["standing still, 10 cm away"]
    assert all(m.T is still[0].T for m in still)
    assert np.linalg.norm(off["standing still, 10 cm away"][0, :3]) == pytest.approx(0.1)
    turned = off["turned by 46 degrees"]
    np.testing.assert_allclose(np.linalg.norm(turned[:, 3:], axis=1), 0.8, atol=1e-9)
    np.testing.assert_allclose(turned[:, :3], 0.0, atol=1e-9)


def test_a_sense_that_runs_away_moves_the_pose_no_farther_than_a_silent_one_and_a_turned_one_is_counted() -> None:
    found = scores.ways(8704, 0, 13.5)
    assert set(found) == {*runs.WAYS, scores.SILENT}
    assert all(way.poses == 175 for way in found.values())
    for way in found.values():
        assert 0.0 < way.moved < 0.2 and 0 <= way.beyond <= way.tracked <= way.poses
    assert found["off by 10 cm"].moved < found[scores.SILENT].moved
    assert found["off by 10 cm, running away at 30 cm/s"].moved < 1.5 * found[scores.SILENT].moved


def test_the_rows_of_wrong_senses_are_those_of_all_runs() -> None:
    each = [{"off": scores.Way(0.01, 100, 50, 1)}, {"off": scores.Way(0.03, 100, 100, 2)}]
    assert fusion.by_way(each) == [
        {"way": "off", "runs": 2, "median": pytest.approx(2.0), "worst": 3.0, "tracking": 0.75, "beyond_3_sigma": 0.02}
    ]


def test_a_sense_is_silent_when_it_would_be_wrong_and_the_other_is_not() -> None:
    run = runs.drawn("one sense wrong", 5, 0, 12.0)
    wrong, silent = runs.wronged(run, 5, 0), runs.silenced(run, 0)
    kept = [m for m, other in zip(run.messages, wrong.messages, strict=True) if m is other]
    assert len(kept) == len(run.messages) - 20, "pictures of a second"
    assert all(m is other for m, other in zip(kept, silent.messages, strict=True))


def test_a_limb_that_jumps_is_where_another_run_has_it_from_half_the_time_on() -> None:
    before, after, run = runs.drawn("visible", 5, 6, 4.0), runs.drawn("visible", 5, 7, 4.0), runs.jumped("visible", 5, 3, 4.0)
    for t, of in ((1.9, before), (2.1, after)):
        np.testing.assert_array_equal(run.at(t), of.at(t))
    assert {m.stamp < 2.0 for m in run.messages if any(m is each for each in before.messages)} <= {True}
    assert [m.arrival for m in run.messages] == sorted(m.arrival for m in run.messages)
    assert np.linalg.norm(run.at(1.99)[:3, 3] - run.at(2.01)[:3, 3]) > 0.03


def test_a_fast_hand_is_as_fast_as_hands_are_and_no_faster() -> None:
    run = runs.drawn("fast hand", 1, 0, 20.0)
    h = 1e-3
    places = np.array([run.at(t)[:3, 3] for t in np.arange(0.0, 20.0, h)])
    speed = np.linalg.norm(np.diff(places, axis=0), axis=1) / h
    acceleration = np.linalg.norm(np.diff(places, 2, axis=0), axis=1) / h**2
    assert 1.0 < speed.max() <= runs.FAST_SPEED + 1e-6
    assert 20.0 < acceleration.max() <= runs.FAST_ACCELERATION + 1e-6


# ---- late measurements


def test_late_and_shuffled_measurements_end_in_the_same_poses() -> None:
    found = scores.late(3, 0, 6.0)
    assert list(found) == ["0", "50", "200", "shuffled"]
    assert all(each.difference < 1e-9 for each in found.values())
    np.testing.assert_allclose(found["50"].now.mean(), found["0"].now.mean(), rtol=0.4)
    assert found["200"].now.mean() > found["0"].now.mean()


def test_an_observer_that_takes_late_for_new_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    class Naive(ErrorStateObserver):
        newest_ns = 0

        def measure(self, source, stamp_ns, *rest):
            self.newest_ns = max(self.newest_ns + 1, stamp_ns)
            return super().measure(source, self.newest_ns, *rest)

    monkeypatch.setattr(scores, "ErrorStateObserver", Naive)
    assert scores.late(3, 0, 3.0)["shuffled"].difference > 1e-3


# ---- baselines


def message(source: str, stamp: float, T: np.ndarray, information: np.ndarray) -> runs.Message:
    return runs.Message(stamp, stamp, source, T, information, None)


def test_the_oracle_takes_the_nearest_of_the_senses_that_are_fresh() -> None:
    newest = Newest()
    newest.take(message("vision", 0.0, perturb(TILTED, [0.01, 0, 0, 0, 0, 0]), np.eye(6)))
    newest.take(message("haptic", 0.1, perturb(TILTED, [0, 0.03, 0, 0, 0, 0]), np.eye(6)))
    assert newest.oracle(0.1, TILTED) == pytest.approx(0.01)
    assert newest.oracle(0.3, TILTED) == pytest.approx(0.03)  # the picture is too old
    assert newest.oracle(9.0, TILTED) == pytest.approx(0.03)  # all are: the newest
    newest.take(message("haptic", 0.05, TILTED, np.eye(6)))  # came late: the newer one stays
    assert newest.oracle(0.1, TILTED) == pytest.approx(0.01)


def test_the_average_weighs_by_information_and_by_direction() -> None:
    newest = Newest()
    newest.take(message("vision", 0.0, perturb(TILTED, [0.01, 0.01, 0, 0, 0, 0]), np.eye(6)))
    newest.take(message("haptic", 0.0, TILTED, np.diag([3.0, 0.0, 1.0, 1.0, 1.0, 1.0])))
    e = rigid.pose_error(newest.average(0.1), TILTED)
    np.testing.assert_allclose(e, [0.0025, 0.01, 0, 0, 0, 0], atol=1e-9)
    assert np.array_equal(newest.average(9.0), newest.average(9.0))


def moving(t: float) -> np.ndarray:
    return perturb(TILTED, [0.1 * t, -0.05 * t, 0.02 * t, 0, 0, 0])


def test_the_smoother_follows_a_limb_also_from_late_pictures_and_a_roll_that_is_made_up() -> None:
    rng = np.random.default_rng(0)
    smoother = FixedLagSmoother(TILTED, (0.12, 0.4))
    information = np.diag(1.0 / np.square([0.003, 0.003, 0.003, 0.03, 0.03, 0.03]))
    arriving = []
    for k in range(100):
        T = moving(0.02 * k)
        B = np.kron(np.eye(2), T[:3, :3])
        rolled = T @ rigid.from_rpy([0, 0, 0], [rng.uniform(-1, 1), 0, 0])
        arriving.append((0.02 * k + 0.003, message("haptic", 0.02 * k, rolled, B @ np.diag([1e5, 1e5, 1e5, 0, 1e3, 1e3]) @ B.T)))
        if k % 5 == 0:
            arriving.append((0.02 * k + 0.05, message("vision", 0.02 * k, T, information)))
    for _, m in sorted(arriving, key=lambda each: each[0]):
        smoother.take(m)
    e = rigid.pose_error(moving(2.05), smoother.pose(2.05))
    assert np.linalg.norm(e[:3]) < 0.001
    assert np.linalg.norm(e[3:]) < 0.03


# ---- the whole


def test_a_tiny_run_writes_the_layout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fusion, "TARGETS", (1, 3))
    path = tmp_path / "fusion.json"
    assert fusion.main(["--seed", "3", "--runs", "1", "--seconds", "4", "--jobs", "1", "--json", str(path)]) == 0
    found = json.loads(path.read_text())
    assert found["seed"] == 3
    assert set(found["situations"]) == set(runs.SITUATIONS) and len(found["situations"]) == 7
    for row in found["situations"].values():
        assert {"nees", "nees_band", "nis", "nis_band", "error_cm", "baselines_cm"} <= set(row)
        assert set(row["baselines_cm"]) >= {"oracle", "average", "gtsam"}
        assert row["nees_band"][0] < 6.0 < row["nees_band"][1]
        assert 0.0 < row["error_cm"] < 20.0
        assert sum(row["states"].values()) == pytest.approx(1.0)
    assert set(found["late"]) == {"0", "50", "200", "shuffled"}
    assert max(found["late_difference_mm"].values()) < 1e-6
    # a jump in the middle; nothing is wrong in the first four seconds
    assert found["wrong_sense_cm"] == found["silent_sense_cm"] == {"runs": fusion.WRONG_RUNS, "median": 0.0, "worst": 0.0}
    assert [row["way"] for row in found["wrong_ways"]] == [*runs.WAYS, scores.SILENT]
    assert 0.0 <= found["jump"]["noticed_worst_s"] <= found["jump"]["again_worst_s"] < 1.0
    assert 0.0 < found["guessed_cm"]["median"] <= found["guessed_cm"]["worst"]
    measured, fused = found["situations"]["visible"]["at_stamps_cm"]["vision"]
    assert 0.0 < fused < 1.5 * measured
    assert found["step_ms"] > 0.0
    assert [row["n"] for row in found["targets"]] == [1, 3]
    shown = capsys.readouterr().out
    assert all(name in shown for name in runs.SITUATIONS)


def test_counts_and_states_are_those_of_all_runs() -> None:
    one = scores.Scores(
        times=np.array([1.0, 2.0]),
        errors={key: np.array([0.01, 0.03]) for key in ("ours", *scores.BASELINES)},
        nees=np.array([25.0, 6.0]),
        nees_dof=np.array([6, 6]),
        states=np.array(["tracking", "coasting"]),
        stamps=np.array([]),
        nis=np.array([]),
        nis_dof=np.array([]),
        at_stamps={"vision": np.array([[0.02, 0.01]]), "haptic": np.zeros((0, 2))},
        gated=2,
    )
    row = fusion.summary([one, dataclasses.replace(one, nees=np.array([6.0, 25.0]), gated=3)])
    assert row["refused"] == 5
    assert row["states"] == {"tracking": 0.5, "coasting": 0.5, "lost": 0.0}
    assert row["error_cm"] == pytest.approx(2.0) and row["nees"] == 15.5 and row["nis"] is None
    assert row["beyond_3_sigma"] == 0.5, "of the two that are called tracking"
    assert row["at_stamps_cm"] == {"vision": pytest.approx([2.0, 1.0])}
