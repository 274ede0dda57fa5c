"""The observers: late and shuffled data, the gate and its way out, banks of targets."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from penumbra.services.fusion import history
from penumbra.services.fusion.estimate import ACCEPTED, DUPLICATE, FATES, Estimate, Limits, RefusedMeasurement
from penumbra.services.fusion.observer import Bank, ErrorStateObserver
from penumbra.services.fusion.paper import PaperObserver
from penumbra.services.fusion.settings import Arm, FusionSettings, Subject
from penumbra.shared.contract.messages import MAX_FUTURE_S
from penumbra.shared.contract.senses import SENSES
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array, perturb, pose_error
from penumbra.shared.native import Kernel
from penumbra.tests.support.fusion_data import HOME, SKIN, SPREAD, STEP, VISION, ns, still, without_roll

OBSERVERS = [ErrorStateObserver, PaperObserver]
AS_STATED = tuple(replace(sense, errors=replace(sense.errors, typical=1.0)) for sense in SENSES)
"""The senses with errors as large as they state."""


# ---- what arrives late, twice, wrong, or not at all


def stream(seconds: float, seed: int = 0) -> list[tuple[str, int, Array, Array]]:
    """Vision and rank-deficient haptic poses of a moving limb, in order of their stamps."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(round(seconds * 100)):
        T = perturb(HOME, [0.05 * np.sin(k / 30), 0.02, 0.03 * np.cos(k / 20), 0.2 * np.sin(k / 25), 0, 0.1])
        out.append(("haptic", ns(k * 0.01), perturb(T, 0.002 * rng.normal(size=6)), without_roll(T, SKIN)))
        if k % 5 == 0:
            out.append(("vision", ns(k * 0.01), perturb(T, 0.01 * rng.normal(size=6)), VISION))
    return out


def test_late_and_shuffled_measurements_give_the_same_as_in_order() -> None:
    in_order, shuffled = ErrorStateObserver(HOME, SPREAD), ErrorStateObserver(HOME, SPREAD)
    measurements = stream(0.5)
    measurements[40] = (*measurements[40][:2], perturb(HOME, [0.5, 0, 0, 0, 0, 0]), measurements[40][3])  # one that is refused
    for measurement in measurements:
        in_order.measure(*measurement)
    for i in np.random.default_rng(1).permutation(len(measurements)):
        shuffled.measure(*measurements[i])
    for t in (0.3, 0.5, 0.7):
        a, b = in_order.estimate(ns(t)), shuffled.estimate(ns(t))
        np.testing.assert_allclose(a.T, b.T, atol=1e-12)
        np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-12)
        np.testing.assert_allclose(a.velocity, b.velocity, atol=1e-12)
        assert a.sources == b.sources


def test_asking_changes_nothing() -> None:
    for make in OBSERVERS:
        asked, quiet = make(HOME, SPREAD), make(HOME, SPREAD)
        for source, stamp_ns, T, seen in stream(0.5):
            asked.measure(source, stamp_ns, T, seen, 0.1)
            quiet.measure(source, stamp_ns, T, seen, 0.1)
            for later in (0, 3_000_000, 40_000_000, 400_000_000):
                asked.estimate(stamp_ns + later)
        np.testing.assert_allclose(asked.estimate(ns(0.52)).T, quiet.estimate(ns(0.52)).T, atol=1e-13)


def test_two_cameras_that_expose_together_are_both_accepted_in_either_order() -> None:
    first, second = ErrorStateObserver(HOME, SPREAD), ErrorStateObserver(HOME, SPREAD)
    left, right = perturb(HOME, [0.004, 0, 0, 0, 0, 0]), perturb(HOME, [-0.004, 0, 0, 0, 0, 0])
    for k in range(5):
        for observer, order in ((first, (left, right)), (second, (right, left))):
            for T in order:
                assert observer.measure("vision", ns(0.05 * k), T, VISION)
    a, b = first.estimate(ns(0.2)), second.estimate(ns(0.2))
    np.testing.assert_array_equal(a.T, b.T)
    np.testing.assert_array_equal(a.covariance, b.covariance)
    assert abs(a.T[0, 3] - HOME[0, 3]) < 0.001, "one of them alone would draw it 4 mm"
    assert not first.measure("vision", ns(0.2), right, VISION)
    assert first.log.counts["vision"].duplicate == 1


def test_what_comes_twice_or_after_the_history_is_refused_and_counted() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    still(observer, HOME, 0.0, 2.0)
    before = observer.estimate(ns(2.0)).covariance
    assert not observer.measure("vision", ns(1.95), HOME, VISION)
    assert not observer.measure("haptic", ns(0.5), HOME, VISION)
    counts = observer.log.counts
    assert (counts["vision"].duplicate, counts["haptic"].late, counts["vision"].accepted) == (1, 1, 40)
    np.testing.assert_array_equal(observer.estimate(ns(2.0)).covariance, before)


def test_an_outlier_is_refused_and_moves_nothing() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    still(observer, HOME, 0.0, 1.0)
    assert not observer.measure("vision", ns(1.0), perturb(HOME, [0.2, 0, 0, 0, 0, 0]), VISION)
    assert not observer.measure("haptic", ns(1.0), perturb(HOME, [0, 0, 0, 0, 0, 1.0]), VISION)
    assert observer.log.counts["vision"].gated == observer.log.counts["haptic"].gated == 1
    np.testing.assert_allclose(observer.estimate(ns(1.0)).T, HOME, atol=1e-6)


@pytest.mark.parametrize("make", OBSERVERS)
def test_a_limb_that_jumps_is_found_again_within_three_quarters_of_a_second(make: type) -> None:
    observer = make(HOME, SPREAD)
    far = perturb(HOME, [3.0, -2.0, 0.1, 0.0, 0.5, 1.5])
    still(observer, HOME, 0.0, 1.0)
    still(observer, far, 1.0, 1.75)
    estimate = observer.estimate(ns(1.75))
    assert np.abs(pose_error(far, estimate.T)).max() < 0.02
    assert estimate.state == "tracking"


def test_a_limb_that_jumps_is_not_called_tracking_from_the_first_measurement_that_shows_it() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    still(observer, HOME, 0.0, 1.0)
    assert observer.estimate(ns(1.0)).state == "tracking"
    far = perturb(HOME, [0.2, 0.0, 0.1, 0.0, 0.0, 0.0])
    wrong = set()
    for t in np.arange(1.0, 2.0, 0.05):
        observer.measure("vision", ns(t), far, VISION)
        estimate = observer.estimate(ns(t))
        if np.linalg.norm(pose_error(far, estimate.T)[:3]) > 0.03:
            wrong.add(estimate.state)
    assert wrong == {"coasting"}
    assert observer.estimate(ns(2.0)).state == "tracking"


def test_a_sense_that_is_wrong_beside_another_ends_tracking_only_until_the_other_confirms_the_pose() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    still(observer, HOME, 0.0, 1.0)
    observer.measure("haptic", ns(1.0), perturb(HOME, [0.2, 0.0, 0.0, 0.0, 0.0, 0.0]), VISION)
    assert observer.estimate(ns(1.0)).state == "coasting"
    still(observer, HOME, 1.05, 1.1)
    observer.measure("haptic", ns(1.06), perturb(HOME, [0.2, 0.0, 0.0, 0.0, 0.0, 0.0]), VISION)
    assert observer.estimate(ns(1.06)).state == "tracking"


def test_a_sense_that_was_wrong_is_used_again_when_it_agrees_and_not_when_it_is_nearly_plausible() -> None:
    def accepted(refusals: int) -> bool:
        """Whether the skin, 5 cm off, is accepted after 20 measurements that were 10 cm off."""
        observer = ErrorStateObserver(HOME, SPREAD, FusionSettings(refusals=refusals), AS_STATED)
        still(observer, HOME, 0.0, 1.0)
        for k in range(20):
            t = 1.0 + 0.01 * k
            if k % 5 == 0:
                still(observer, HOME, t, t + 0.01)
            observer.measure("haptic", ns(t), perturb(HOME, [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]), 2.0 * VISION)
        still(observer, HOME, 1.2, 1.21)
        return observer.measure("haptic", ns(1.205), perturb(HOME, [0.05, 0.0, 0.0, 0.0, 0.0, 0.0]), 2.0 * VISION)

    assert accepted(refusals=100) and not accepted(refusals=5)


def beside_a_wrong_skin(off: Callable[[float], float], speed: float = 0.1) -> ErrorStateObserver:
    """One that sees a limb until 1.95 s, at a speed [m/s] from 1.2 s on, beside a skin that is off along y by `off` [m] from 1 s
    on."""
    observer = ErrorStateObserver(HOME, SPREAD)
    for k in range(196):
        t = 0.01 * k
        moved = speed * max(0.0, t - 1.2)
        if k % 5 == 0:
            observer.measure("vision", ns(t), perturb(HOME, [0.0, moved, 0.0, 0.0, 0.0, 0.0]), VISION)
        observer.measure(
            "haptic", ns(t), perturb(HOME, [0.0, moved + (off(t) if t >= 1.0 else 0.0), 0.0, 0.0, 0.0, 0.0]), 4.0 * VISION
        )
    return observer


def test_a_sense_that_is_off_by_an_offset_is_refused_and_still_makes_the_pose_surer() -> None:
    wrong, silent = beside_a_wrong_skin(lambda t: 0.1), ErrorStateObserver(HOME, SPREAD)
    for k in range(196):
        t = 0.01 * k
        T = perturb(HOME, [0.0, 0.1 * max(0.0, t - 1.2), 0.0, 0.0, 0.0, 0.0])
        if k % 5 == 0:
            silent.measure("vision", ns(t), T, VISION)
        if t < 1.0:
            silent.measure("haptic", ns(t), T, 4.0 * VISION)
    assert wrong.log.counts["haptic"].gated == 96
    assert wrong.estimate(ns(1.95)).covariance[1, 1] < 0.9 * silent.estimate(ns(1.95)).covariance[1, 1]
    assert wrong.estimate(ns(1.95)).T[1, 3] == pytest.approx(0.075, abs=0.005)


@pytest.mark.parametrize(
    ("off", "within"),
    [
        pytest.param(lambda t: 0.1 - 0.1 * max(0.0, t - 1.2), 0.02, id="stands still"),
        pytest.param(lambda t: 0.1 + 0.3 * (t - 1.0), 0.005, id="runs away"),
        pytest.param(lambda t: 0.1 + 0.1 * (round(100 * t) % 2), 0.005, id="to and fro"),
    ],
)
def test_a_wrong_sense_whose_offset_does_not_stay_is_hardly_followed(off: Callable[[float], float], within: float) -> None:
    # the limb has gone 7.5 cm, and the offset has changed by as much, by 28 cm, and by 10 cm
    assert beside_a_wrong_skin(off).estimate(ns(1.95)).T[1, 3] == pytest.approx(0.075, abs=within)


def test_a_wrong_sense_is_not_used_again_where_a_limb_sets_out_and_the_covariance_grows() -> None:
    observer = beside_a_wrong_skin(lambda t: -0.1, speed=0.8)  # the skin feels the limb where it was when it set out
    assert observer.log.counts["haptic"].gated == 96
    assert observer.estimate(ns(1.95)).T[1, 3] == pytest.approx(0.6, abs=0.01)


def test_tracking_promises_its_bound_at_three_standard_deviations() -> None:
    observers = [
        ErrorStateObserver.of(Bank([Subject(HOME, SPREAD, Limits(tracking_bound=bound))]), 0) for bound in (0.01, 0.05, 0.15)
    ]
    for observer in observers:
        still(observer, HOME, 0.0, 1.0)
    assert [observer.estimate(ns(0.95)).state for observer in observers] == ["coasting", "tracking", "tracking"]
    for age in np.arange(0.0, 0.5, 0.01):
        for observer in observers:
            estimate = observer.estimate(ns(0.95 + age))
            promised = 3.0 * np.sqrt(np.linalg.eigvalsh(estimate.covariance[:3, :3])[-1])
            limits = observer.subject.limits
            assert (estimate.state == "tracking") == (promised <= limits.tracking_bound and age <= limits.tracking_age)


def test_a_guess_stays_within_the_reach_of_an_arm_whose_shoulder_is_known_and_what_is_measured_is_believed() -> None:
    elbow, upper_arm = 0.13, 0.3
    shoulder = HOME[:3, 3] + [-elbow, 0.0, upper_arm - 0.01]  # the elbow, when at home, is 1 cm within reach
    subjects = [Subject(HOME, SPREAD, arm=arm) for arm in (Arm(tuple(shoulder), upper_arm, elbow), Arm())]
    held, free = (ErrorStateObserver.of(Bank([subject]), 0) for subject in subjects)
    for k in range(20):
        for observer in (held, free):  # down, at 0.5 m/s
            observer.measure("vision", ns(0.05 * k), perturb(HOME, [0.0, 0.0, 0.5 * (0.95 - 0.05 * k), 0.0, 0.0, 0.0]), VISION)
    away = [np.linalg.norm(observer.estimate(ns(1.5)).T[:3, 3] - [elbow, 0.0, 0.0] - shoulder) for observer in (held, free)]
    assert away[0] == pytest.approx(upper_arm, abs=1e-6) and away[1] > upper_arm + 0.03
    for observer in (held, free):
        still(observer, perturb(HOME, [0.0, 0.0, -0.1, 0.0, 0.0, 0.0]), 1.5, 3.0)
        assert observer.estimate(ns(2.95)).T[2, 3] == pytest.approx(HOME[2, 3] - 0.1, abs=0.005)


def test_a_sense_that_disagrees_for_long_is_used_again_beside_one_that_is_accepted() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    wrong = perturb(HOME, [0.0, 0.1, 0.0, 0.0, 0.0, 0.0])
    for k in range(250):
        observer.measure("haptic", ns(k * 0.01), wrong, 4.0 * VISION)
        if k >= 50 and k % 5 == 0:
            observer.measure("vision", ns(k * 0.01), HOME, VISION)
    vision = observer.estimate(ns(2.5)).sources["vision"]
    assert observer.log.counts["vision"].gated >= 5
    assert vision.age_s < 0.2 and vision.weight > 0.01


def test_the_skin_which_does_not_feel_a_roll_does_not_keep_vision_from_one() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    axis = np.concatenate([np.zeros(3), HOME[:3, 0]])
    without_roll = np.eye(6) - np.outer(axis, axis)
    felt = without_roll @ (4.0 * VISION) @ without_roll
    for k in range(150):
        observer.measure("haptic", ns(k * 0.01), HOME, felt)
        if k % 5 == 0:
            observer.measure("vision", ns(k * 0.01), perturb(HOME, 1.5 * axis) if k >= 100 else HOME, VISION)
    error = rigid.pose_error(perturb(HOME, 1.5 * axis), observer.estimate(ns(1.5)).T)
    assert abs(error @ axis) < 0.2


def test_without_measurements_the_covariance_grows_and_the_state_goes_from_tracking_to_lost() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    still(observer, HOME, 0.0, 1.0)
    estimates = [observer.estimate(ns(0.95 + age)) for age in np.arange(0.0, 4.0, 0.01)]
    sigmas = [np.linalg.eigvalsh(e.covariance) for e in estimates]
    assert all((b > a).all() for a, b in itertools.pairwise(sigmas))
    states = [e.state for e in estimates]
    assert list(dict.fromkeys(states)) == ["tracking", "coasting", "lost"]
    assert states[20] == "tracking" and states[30] == "coasting"


@pytest.mark.parametrize("make", OBSERVERS)
def test_before_the_first_measurement_the_target_is_lost_at_home(make: type) -> None:
    observer = make(HOME, SPREAD)
    observer.log.received("vision", ns(0.0))
    estimate = observer.estimate(ns(1.0))
    np.testing.assert_array_equal(estimate.T, HOME)
    np.testing.assert_allclose(np.sqrt(np.diag(estimate.covariance)), np.repeat(SPREAD, 3))
    assert estimate.state == "lost"
    assert estimate.sources["vision"].weight == 0.0 and estimate.sources["vision"].age_s == pytest.approx(1.0)
    assert "haptic" not in estimate.sources


FAR = perturb(HOME, [0.03, 0.0, 0.0, 0.0, 0.0, 0.1])
SKEW = VISION + np.diag([1e3] * 4, k=2)


@pytest.mark.parametrize("make", OBSERVERS)
@pytest.mark.parametrize(
    ("T", "seen", "ahead", "kind", "text"),
    [
        pytest.param(np.full((4, 4), np.nan), VISION, 0.0, "pose", "expected a finite rigid transform", id="not a number"),
        pytest.param(
            np.diag([0.0, 0, 0, 1]), VISION, 0.0, "pose", "is its quaternion of length one?", id="quaternion of length 0"
        ),
        pytest.param(np.diag([2.0, 2, 2, 1]), VISION, 0.0, "pose", "expected a finite rigid transform", id="stretched"),
        pytest.param(FAR @ np.diag([1.0, 1, -1, 1]), VISION, 0.0, "pose", "expected a finite rigid transform", id="mirrored"),
        pytest.param(np.eye(3), VISION, 0.0, "pose", "(4, 4)", id="a rotation only"),
        pytest.param(FAR, -VISION, 0.0, "information", "expected no negative eigenvalue, got -1e+04 beside", id="negative"),
        pytest.param(
            FAR,
            np.diag([1.0, 1, 1, 1, 1, -1]),
            0.0,
            "information",
            "expected no negative eigenvalue, got -1 beside 1",
            id="mixed",
        ),
        pytest.param(FAR, SKEW, 0.0, "information", "expected a symmetric matrix", id="not symmetric"),
        pytest.param(FAR, np.full((6, 6), np.inf), 0.0, "information", "expected a finite (6, 6) matrix", id="infinite"),
        pytest.param(FAR, np.eye(5), 0.0, "information", "expected a finite (6, 6) matrix", id="another shape"),
        pytest.param(FAR, VISION, 0.51, "future", "expected at most 0.5 s ahead of the clock, got 0.510 s; check", id="future"),
    ],
)
def test_what_is_no_measurement_is_refused_with_the_reason_counted_and_changes_nothing(
    make: type, T: Array, seen: Array, ahead: float, kind: str, text: str
) -> None:
    observer = make(HOME, SPREAD)
    still(observer, HOME, 0.0, 1.0)
    before = observer.estimate(ns(1.1))
    with pytest.raises(RefusedMeasurement) as caught:
        observer.measure("vision", ns(1.0 + ahead), T, seen, 0.0, now_ns=ns(1.0))
    assert caught.value.kind == kind and text in str(caught.value)
    assert observer.log.counts["vision"].refused == {kind: 1}
    after = observer.estimate(ns(1.1))
    np.testing.assert_array_equal(after.T, before.T)
    np.testing.assert_array_equal(after.covariance, before.covariance)
    assert after.sources == before.sources
    assert observer.measure("vision", ns(1.49), HOME, VISION, 0.0, now_ns=ns(1.0)), "clocks of one cell may differ by 0.5 s"


def test_a_sense_whose_clock_is_ahead_by_less_than_cells_allow_is_fused_and_makes_nothing_late() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    ahead = 0.9 * MAX_FUTURE_S
    for k in range(60):
        now = 0.05 * k
        assert observer.measure("vision", ns(now + ahead), HOME, VISION, 0.0, now_ns=ns(now))
        assert observer.measure("haptic", ns(now - 0.1), perturb(HOME, [0.002, 0, 0, 0, 0, 0]), VISION, now_ns=ns(now))
        if now > ahead:
            estimate = observer.estimate(ns(now))
            assert estimate.state == "tracking" and estimate.sources.keys() == {"vision", "haptic"}
            assert np.abs(pose_error(HOME, estimate.T)[:3]).max() < 0.003
    assert observer.log.counts["haptic"].late == observer.log.counts["vision"].late == 0


@pytest.mark.parametrize("make", OBSERVERS)
def test_a_source_that_nobody_knows_is_refused(make: type) -> None:
    with pytest.raises(ValueError, match="source: expected one of vision, haptic, got 'sonar'"):
        make(HOME, SPREAD).measure("sonar", ns(0), HOME, VISION)


# ---- many targets, many measurements


def test_a_bank_of_targets_does_what_each_of_them_does_alone() -> None:
    homes = [perturb(HOME, [0.1 * i, 0, 0, 0, 0, 0.3 * i]) for i in range(3)]
    bank = Bank([Subject(home, SPREAD) for home in homes])
    alone = [ErrorStateObserver(home, SPREAD) for home in homes]
    streams = [stream(0.5, seed=i) for i in range(3)]
    for rows in zip(*streams, strict=True):
        stamps = np.array([row[1] for row in rows])
        sources = np.array([bank.names.index(row[0]) for row in rows])
        T, seen = (np.array([row[column] for row in rows]) for column in (2, 3))
        fates = bank.measure(np.arange(3), sources, stamps, T, seen)
        for observer, row, fate in zip(alone, rows, fates, strict=True):
            assert observer.measure(*row) == (fate == ACCEPTED)
    for found, observer in zip(bank.estimates(ns(0.52)), alone, strict=True):
        expected = observer.estimate(ns(0.52))
        np.testing.assert_array_equal(found.T, expected.T)
        np.testing.assert_array_equal(found.covariance, expected.covariance)
        assert (found.state, found.sources) == (expected.state, expected.sources)
    assert [log.counts for log in bank.logs] == [observer.log.counts for observer in alone]


def test_a_bank_takes_what_is_good_beside_what_is_bad() -> None:
    bank = Bank([Subject(HOME, SPREAD)] * 2)
    targets, sources, stamps = np.array([0, 1, 1, 1]), np.zeros(4, np.int64), np.full(4, ns(0.0))
    seen = np.array([-VISION, VISION, VISION, VISION])
    fates = bank.measure(targets, sources, stamps, np.array([HOME, np.zeros((4, 4)), FAR, FAR]), seen, now_ns=ns(0.0))
    assert [FATES[fate] for fate in fates] == ["information", "pose", "accepted", "duplicate"]
    assert [e.state for e in bank.estimates(ns(0.0))] == ["lost", "tracking"]
    assert fates[3] == DUPLICATE and bank.logs[0].counts["vision"].refused == {"information": 1}


def test_a_storm_of_measurements_shortens_the_history_and_nothing_else() -> None:
    observer = ErrorStateObserver(HOME, SPREAD, FusionSettings(capacity=8))
    for k in range(100):
        observer.measure("haptic", ns(0.001 * k), HOME, VISION)
    assert observer.measure("vision", ns(0.0905), HOME, VISION)
    assert not observer.measure("vision", ns(0.0505), HOME, VISION)
    assert observer.log.counts["vision"].late == 1
    assert observer.estimate(ns(0.1)).state == "tracking"
    np.testing.assert_allclose(observer.estimate(ns(0.1)).T, HOME, atol=1e-9)


def test_no_measurement_is_trusted_beyond_the_floor() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    observer.measure("vision", ns(0.0), HOME, 1e18 * np.eye(6))
    floor = SENSES[0].errors.floor * np.array([0.1, 0.1, 0.1, 1, 1, 1])
    sigma = np.sqrt(np.diag(observer.estimate(ns(0.0)).covariance))
    # at first the calibration is in it twice: as the sense's bias, which many measurements average out, and as what they do not
    np.testing.assert_allclose(sigma, np.sqrt(2.0) * floor, rtol=0.02)
    for k in range(1, 400):
        for source in ("vision", "haptic"):
            observer.measure(source, ns(0.01 * k), HOME, 1e18 * np.eye(6))
    sigma = np.sqrt(np.diag(observer.estimate(ns(3.99)).covariance))
    assert (sigma >= floor).all() and (sigma < 1.5 * floor).all()


def test_the_compiled_filter_does_what_its_source_says(monkeypatch: pytest.MonkeyPatch) -> None:
    def played() -> Estimate:
        observer = ErrorStateObserver(HOME, SPREAD)
        measurements = stream(0.3)
        measurements[20] = (*measurements[20][:2], perturb(HOME, [0.5, 0, 0, 0, 0, 0]), measurements[20][3])  # that is refused
        late = [*measurements[:10], *measurements[15:], *measurements[10:15]]
        for measurement in late:
            observer.measure(*measurement)
        observer.measure("haptic", ns(0.31), perturb(HOME, STEP), VISION, step=STEP)
        return observer.estimate(ns(0.32))

    def interpreted(compiled: Kernel) -> Callable[..., object]:
        def call(*arguments: object) -> object:
            with_fields = (
                each.view(np.recarray) if isinstance(each, np.ndarray) and each.dtype.names else each for each in arguments
            )
            return compiled.function(*with_fields)

        return call

    fast = played()
    for name in ("clear_all", "measure_all", "estimate_all"):
        monkeypatch.setattr(history, name, interpreted(getattr(history, name)))
    slow = played()
    # compiled code joins multiplications and additions: the last digits differ
    np.testing.assert_allclose(fast.T, slow.T, atol=1e-11)
    np.testing.assert_allclose(fast.covariance, slow.covariance, atol=1e-11)
    np.testing.assert_allclose(fast.velocity, slow.velocity, atol=1e-9)
    assert (fast.state, fast.sources.keys()) == (slow.state, slow.sources.keys())


# ---- going on


@pytest.mark.parametrize("make", OBSERVERS)
def test_a_turn_through_pi_is_followed(make: type) -> None:
    observer = make(HOME, SPREAD)
    rate = 2.0
    worst = 0.0
    for k in range(100):  # from -2.6 to 7.4 rad about the vertical
        t = 0.05 * k
        T = rigid.from_rpy([0.0, 0.0, 0.2], [0.0, 0.0, -2.6 + rate * t])
        observer.measure("vision", ns(t), T, VISION, 0.0)
        if t > 1.0:
            ahead = rigid.from_rpy([0.0, 0.0, 0.2], [0.0, 0.0, -2.6 + rate * (t + 0.02)])
            worst = max(worst, np.abs(pose_error(ahead, observer.estimate(ns(t + 0.02)).T)).max())
    assert worst < 0.06  # 3.4 degrees, at 115 degrees a second


def test_an_observer_that_adopts_a_published_pose_goes_on_without_a_jump() -> None:
    old, new = ErrorStateObserver(HOME, SPREAD), ErrorStateObserver(HOME, SPREAD)
    measurements = stream(2.0)
    handed = ns(1.0)
    for measurement in measurements:
        if measurement[1] <= handed:
            old.measure(*measurement)
    published = old.estimate(handed + 3_000_000)
    new.adopt(published.message(handed + 3_000_000, "forearm", "world"))
    taken = new.estimate(handed + 3_000_000)
    assert taken.state == published.state == "tracking"
    np.testing.assert_allclose(taken.T, published.T, atol=1e-9)
    np.testing.assert_allclose(taken.covariance, published.covariance, atol=1e-12)
    np.testing.assert_allclose(taken.velocity, published.velocity)
    for source, of in published.sources.items():
        assert taken.sources[source].weight == pytest.approx(of.weight)
        assert taken.sources[source].age_s == pytest.approx(of.age_s, abs=1e-6)
    assert not new.measure("vision", handed, HOME, VISION), "it is in the published pose already"
    assert new.log.counts["vision"].late == 1
    for measurement in measurements:
        if measurement[1] > handed + 3_000_000:
            old.measure(*measurement)
            before = new.estimate(measurement[1])
            new.measure(*measurement)
            after = new.estimate(measurement[1])
            jump = pose_error(before.T, after.T)
            assert jump @ np.linalg.solve(before.covariance, jump) < 20.0, "a jump beyond the covariance"
            e = pose_error(old.estimate(measurement[1]).T, after.T)
            assert np.abs(e[:3]).max() < 0.03
    np.testing.assert_allclose(new.estimate(ns(2.0)).T, old.estimate(ns(2.0)).T, atol=5e-3)
