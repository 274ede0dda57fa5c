"""The smoother: what it makes of a linear problem is the batch solution, and of a limb a better and true trajectory."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from penumbra.services.fusion import history
from penumbra.services.fusion.estimate import Estimate
from penumbra.services.fusion.observer import ErrorStateObserver
from penumbra.services.fusion.records import MOTION, POSE, UNITS
from penumbra.services.fusion.settings import FusionSettings, Subject
from penumbra.services.fusion.smoother import Filter, NothingMeasuredError, Smoother, Trajectory
from penumbra.shared.contract.senses import SENSES, Errors, Sense
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array, perturb, pose_error
from penumbra.sim.world.motion import Reach
from penumbra.tests.bench.lib import fusion_runs as runs
from penumbra.tests.support.fusion_data import HOME, SKIN, SPREAD, VISION, motion, ns, without_roll

SUBJECT = Subject(HOME, SPREAD)
CALIBRATION = np.diag(np.square(SENSES[0].errors.floor * np.array(UNITS)))
"""What the observer adds to the covariance of its pose when it publishes it; the same for all senses."""
LINEAR = FusionSettings(learning=(0.0, 0.0))
"""Nothing is learned and no noise depends on the state: what the filter does to a position is linear."""


def smoother(measurements: list[tuple[str, float, Array, Array]]) -> Smoother:
    """One that has taken measurements: source, time [s], pose and information."""
    out = Smoother(SUBJECT)
    for source, t, T, information in measurements:
        out.measure(source, ns(t), T, information)
    return out


def at(trajectory: Trajectory, *times: float) -> list[Estimate]:
    return list(trajectory.estimates(np.array([ns(t) for t in times])))


def resting(begin: float, end: float, T: Array = HOME, seed: int = 0) -> list[tuple[str, float, Array, Array]]:
    """Vision at 20 Hz of a limb that rests at T, with a millimetre of noise."""
    rng = np.random.default_rng(seed)
    return [
        ("vision", float(t), perturb(T, 0.001 * rng.normal(size=6)), VISION) for t in np.arange(round(begin * 20), end * 20) / 20
    ]


# ---- the smoother's equations


def split(of: Errors, sigma: float) -> tuple[float, float]:
    """The variance [m^2] by which a measurement with a standard deviation sigma [m] is weighed, and the rest of its variance."""
    variance, sure = sigma**2, (UNITS[0] * of.sure) ** 2
    share = of.typical + (1.0 - of.typical) * variance / (variance + sure)
    return share * variance, (1.0 - share) * variance


def batch(times: Array, measured: dict[int, float], sigma: float, sense: Sense) -> tuple[Array, Array]:
    """Position, velocity, acceleration and bias (k, 4) of one axis at all times, and their covariances (k, 4, 4): the solution of
    the whole linear problem at once. measured: position [m] by the index of its time, with a standard deviation sigma [m]."""
    count, of = len(times), sense.errors
    information, pull = np.zeros((4 * count, 4 * count)), np.zeros(4 * count)
    spread = LINEAR.velocity_spread[0]
    first = 10.0 * SPREAD[0], spread, spread / LINEAR.motion_time[0], 1.0  # as `filter.start` begins where a measurement decides
    information[:4, :4] += np.diag(np.square(first) ** -1.0)
    pull[0] += measured[0] / first[0] ** 2
    typical, _ = split(of, sigma)
    lasting = np.sqrt(of.lasting * typical + (UNITS[0] * of.floor) ** 2)
    h = np.array([1.0, 0.0, 0.0, lasting])
    for k, z in measured.items():
        here = slice(4 * k, 4 * k + 4)
        information[here, here] += np.outer(h, h) / ((1.0 - of.lasting) * typical)
        pull[here] += h * z / ((1.0 - of.lasting) * typical)
    for k, dt in enumerate(np.diff(times)):
        F, Q = np.eye(4), np.eye(4)
        F[:3, :3], Q[:3, :3] = motion(float(dt), LINEAR)
        F[3, 3] = np.exp(-dt / of.time_constant)
        Q[3, 3] = 1.0 - F[3, 3] ** 2
        D = np.hstack([-F, np.eye(4)])
        both = slice(4 * k, 4 * k + 8)
        information[both, both] += D.T @ np.linalg.solve(Q, D)
    covariance = np.linalg.inv(information)
    blocks = np.array([covariance[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] for k in range(count)])
    return (covariance @ pull).reshape(-1, 4), blocks


def test_of_a_linear_problem_it_finds_the_batch_least_squares_solution_also_between_the_measurements() -> None:
    rng, sigma = np.random.default_rng(3), 0.01
    times = np.sort(np.append(np.arange(0.0, 1.0, 0.05), [0.33, 1.7, 1.95, 2.0]))  # at 0.33 and 1.7 nothing is measured
    measured = {k: 0.02 * np.sin(3.0 * t) + 0.5 * sigma * rng.normal() for k, t in enumerate(times) if t not in (0.33, 1.7)}
    expected, covariances = batch(times, measured, sigma, SENSES[0])
    of = Smoother(SUBJECT, LINEAR)
    for k, z in measured.items():
        of.measure("vision", ns(times[k]), perturb(HOME, [0.0, 0.0, z, 0.0, 0.0, 0.0]), VISION)
    trajectory = of.trajectory()
    found = at(trajectory, *times)
    assert of.dismissed == of.reinstated == 0
    np.testing.assert_allclose([each.T[2, 3] - HOME[2, 3] for each in found], expected[:, 0], atol=1e-9)
    np.testing.assert_allclose([each.velocity[2] for each in found], expected[:, 1], atol=1e-8)
    errors = SENSES[0].errors
    typical, rest = split(errors, sigma)
    larger = rest / (errors.lasting * typical + (UNITS[0] * errors.floor) ** 2)
    of_bias = covariances[:, 0, 3] ** 2 / covariances[:, 3, 3]  # the part of the position's variance that is the bias's
    expected_variances = covariances[:, 0, 0] + larger * of_bias
    np.testing.assert_allclose([each.covariance[2, 2] for each in found], expected_variances, rtol=1e-6)
    states = trajectory._segments[0].smoothed
    kept = sorted(measured)
    rows = np.array([2, POSE + 2, 2 * POSE + 2, MOTION + 2])
    np.testing.assert_allclose(states.senses["bias"][:, 0, 2], expected[kept, 3], atol=1e-7)
    np.testing.assert_allclose(states.P[:, rows[:, None], rows], covariances[kept], rtol=1e-5, atol=1e-9)


def test_the_motion_between_two_states_is_the_observers_own() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    measurements = [(s, t, perturb(HOME, [t, 0.1 * t, 0, t, 0.5 * t, 0]), info) for s, t, _, info in resting(0.0, 0.5)]
    for source, t, T, information in measurements:
        observer.measure(source, ns(t), T, information)
    of = smoother(measurements)
    known, *_ = of._gated()
    filter = Filter(SUBJECT, FusionSettings(), SENSES, is_gated=True)
    states = filter.run(known, np.zeros((len(known), 2))).of(slice(-1, None))
    assert np.abs(states.now["velocity"]).max() > 0.3
    for dt in (0.0, 0.005, 0.3, 2.0):
        later, F, Q = filter.moved(states, np.array([ns(0.45 + dt)]))
        expected = observer.estimate(ns(0.45 + dt))
        published = later.P[0, :6, :6] + CALIBRATION
        history.consider(filter.senses, later.senses[0], later.P[0], published)
        np.testing.assert_allclose(published, expected.covariance, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(later.now["p"][0], expected.T[:3, 3], atol=1e-12)
        np.testing.assert_allclose(later.now["R"][0], expected.T[:3, :3], atol=1e-12)
        np.testing.assert_allclose(F[0] @ states.P[0] @ F[0].T + Q[0], later.P[0], atol=1e-15)


def test_at_the_last_measurement_it_is_the_filter() -> None:
    measurements = resting(0.0, 2.0)
    observer = ErrorStateObserver(HOME, SPREAD, LINEAR)
    of = Smoother(SUBJECT, LINEAR)
    for source, t, T, information in measurements:
        observer.measure(source, ns(t), T, information)
        of.measure(source, ns(t), T, information)
    (found,) = at(of.trajectory(), measurements[-1][1])
    expected = observer.estimate(ns(measurements[-1][1]))
    np.testing.assert_allclose(found.T, expected.T, atol=1e-9)
    np.testing.assert_allclose(found.covariance + CALIBRATION, expected.covariance, rtol=1e-6, atol=1e-12)
    assert found.state == expected.state == "tracking"


# ---- what it makes of limbs


def played(name: str, index: int) -> tuple[runs.Run, Smoother, ErrorStateObserver]:
    """A run of the benchmark's, of a seed of this test, with what both have taken."""
    run = runs.drawn(name, 1234, index, 12.0)
    run = runs.wronged(run, 1234, index) if run.situation.wrong else runs.delayed(run, lambda: 0.0)
    observer, of = ErrorStateObserver(HOME, SPREAD), Smoother(SUBJECT)
    for m in run.messages:
        observer.measure(m.source, runs.ns(m.stamp), m.T, m.information)
        of.measure(m.source, runs.ns(m.stamp), m.T, m.information)
    return run, of, observer


@pytest.mark.parametrize("name", ["hidden, out of range", "fast hand", "hand-over"])
def test_it_is_nearer_to_the_truth_than_the_filter_and_as_far_from_it_as_it_says(name: str) -> None:
    errors, nees = [], []
    for index in range(4):
        run, of, _ = played(name, index)
        trajectory, filtered = of.trajectory(), ErrorStateObserver(HOME, SPREAD)
        times = [t for t in np.arange(2.0, 11.0, 0.11) if run.situation.scored(t)]
        messages = iter([*run.messages, replace(run.messages[-1], stamp=1e9)])
        message = next(messages)
        for t, found in zip(times, at(trajectory, *times), strict=True):
            while message.stamp <= t:
                filtered.measure(message.source, runs.ns(message.stamp), message.T, message.information)
                message = next(messages)
            truth = run.at(t)
            off = [np.linalg.norm(truth[:3, 3] - T[:3, 3]) for T in (found.T, filtered.estimate(runs.ns(t)).T)]
            errors.append(off)
            error = pose_error(truth, found.T)[:3]
            nees.append(error @ np.linalg.solve(found.covariance[:3, :3], error))
    smoothed, fused = np.array(errors).T
    assert smoothed.mean() < 0.85 * fused.mean()
    assert np.percentile(smoothed, 95) < 0.85 * np.percentile(fused, 95)
    # 3 expected; the errors of one run hang together, so that a few runs are off by as much as a half
    assert 1.5 < np.mean(nees) < 4.5


def test_a_sense_that_is_wrong_for_a_second_does_not_move_it() -> None:
    for index in range(2):
        run, of, _ = played("one sense wrong", index)
        times = np.arange(9.5, 11.4, 0.05)
        for t, found in zip(times, at(of.trajectory(), *times), strict=True):
            assert np.linalg.norm(run.at(t)[:3, 3] - found.T[:3, 3]) < 0.03
        assert sum(counts.gated for counts in of.log.counts.values()) > 15


def test_what_the_gates_refused_is_used_where_the_later_measurements_agree_with_it() -> None:
    """A hand that is at 3 m/s 0.14 s after a rest is refused at first; afterwards it is known where it went."""
    reach = Reach(1.0, 0.28, 3.0, np.zeros(6), np.array([0.45, 0.0, 0.0, 0.0, 0.0, 0.0]))
    way = [(t, reach.at(t)[0][0]) for t in np.arange(0.0, 3.0, 0.05)]
    measurements = [("vision", float(t), perturb(HOME, [x, 0, 0, 0, 0, 0]), VISION) for t, x in way]
    of = smoother(measurements)
    trajectory = of.trajectory()
    refused = of.log.counts["vision"].gated
    assert refused >= 2 and of.reinstated >= refused - 1
    for (t, x), found in zip(way, at(trajectory, *(t for t, _ in way)), strict=True):
        assert abs(found.T[0, 3] - HOME[0, 3] - x) < 0.02, t


def test_after_a_jump_it_is_there_from_the_first_measurement_on_and_before_it_stays_where_it_was() -> None:
    far = perturb(HOME, [3.0, -2.0, 0.1, 0.0, 0.5, 1.5])
    of = smoother([*resting(0.0, 2.0), *resting(2.0, 4.0, far, seed=1)])
    trajectory = of.trajectory()
    for found, T in zip(at(trajectory, 1.5, 1.95, 2.0, 2.1, 3.0), (HOME, HOME, far, far, far), strict=True):
        assert np.abs(pose_error(T, found.T)).max() < 0.02
        assert found.state == "tracking"
    assert of.reinstated >= 10, "half a second that the gates refused"


def test_where_nothing_measured_it_is_less_certain_then_coasting_and_after_long_lost() -> None:
    short = smoother([*resting(0.0, 1.0), *resting(2.0, 3.0)]).trajectory()
    before, edge, middle, after = at(short, 0.9, 1.1, 1.5, 2.1)
    assert [each.state for each in (before, edge, middle, after)] == ["tracking", "tracking", "coasting", "tracking"]
    assert middle.covariance[0, 0] > 4.0 * before.covariance[0, 0]
    long = smoother([*resting(0.0, 1.0), *resting(7.0, 8.0)]).trajectory()
    assert [each.state for each in at(long, 0.9, 4.0, 6.5, 7.5)] == ["tracking", "lost", "lost", "tracking"]


def test_a_roll_that_nothing_observes_stays_unknown_and_about_the_limb() -> None:
    measurements = []
    for k in range(150):
        T = perturb(HOME, [0.1 * np.sin(k / 25), 0.0, 0.0, 0.0, 0.0, 0.8 * np.sin(k / 25)])
        made_up = T @ rigid.from_rpy([0, 0, 0], [0.5 * np.sin(k), 0, 0])
        measurements.append(("haptic", 0.02 * k, made_up, without_roll(T, SKIN)))
    for found in at(smoother(measurements).trajectory(), *np.arange(0.5, 2.5, 0.07)):
        values, vectors = np.linalg.eigh(found.covariance[3:, 3:])
        assert np.sqrt(values[2]) > 0.3 and np.sqrt(values[1]) < 0.1
        assert abs(vectors[:, 2] @ found.T[:3, 0]) > 0.99
        assert np.linalg.eigvalsh(found.covariance)[0] > 0.0


# ---- what comes in


def test_the_order_of_arrival_does_not_matter_to_a_bit() -> None:
    run, _, _ = played("visible", 0)
    found = []
    for order in (range(len(run.messages)), np.random.default_rng(1).permutation(len(run.messages))):
        of = Smoother(SUBJECT)
        for i in order:
            of.measure(run.messages[i].source, runs.ns(run.messages[i].stamp), run.messages[i].T, run.messages[i].information)
        found.append(at(of.trajectory(), *np.arange(0.2, 10.0, 0.037)))
    for a, b in zip(*found, strict=True):
        assert a.T.tobytes() == b.T.tobytes() and a.covariance.tobytes() == b.covariance.tobytes() and a.state == b.state


def test_what_is_wrong_with_a_measurement_or_twice_there_is_counted_and_left_out() -> None:
    good = resting(0.0, 2.0)
    bad: list[tuple[str, float, Any, Any]] = [
        ("vision", 0.52, np.full((4, 4), np.nan), VISION),
        ("vision", 0.53, HOME, -VISION),
        ("vision", 0.54, HOME[:3], VISION),
        ("haptic", 0.55, HOME, np.zeros((6, 6))),
        good[3],
    ]
    with_bad, without = smoother([*good, *bad]), smoother(good)
    a, b = (of.trajectory() for of in (with_bad, without))
    for one, other in zip(at(a, 0.3, 1.2), at(b, 0.3, 1.2), strict=True):
        assert one.T.tobytes() == other.T.tobytes()
    counts = with_bad.log.counts["vision"]
    assert (counts.accepted, counts.duplicate, counts.refused) == (40, 1, {"pose": 2, "information": 1})


def test_without_a_measurement_of_use_there_is_no_trajectory() -> None:
    with pytest.raises(NothingMeasuredError, match="expected poses of vision or haptic, got none"):
        smoother([]).trajectory()
    with pytest.raises(NothingMeasuredError, match="that can be used, got 1 others"):
        smoother([("vision", 0.0, HOME, np.zeros((6, 6)))]).trajectory()
    with pytest.raises(ValueError, match="expected one of vision, haptic, got 'radar'"):
        smoother([("radar", 0.0, HOME, VISION)])
    (only,) = at(smoother(resting(0.0, 0.04)).trajectory(), 0.0)
    assert np.abs(pose_error(HOME, only.T)).max() < 0.01


def test_a_stamp_before_the_first_measurement_or_after_the_last_one_is_refused() -> None:
    trajectory = smoother(resting(0.0, 1.0)).trajectory()
    for t in (-0.001, 0.951):
        with pytest.raises(ValueError, match="stamps: expected"):
            at(trajectory, t)
