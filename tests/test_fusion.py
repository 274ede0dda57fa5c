"""The observers: rotations, late and shuffled data, the gate and its way out, unobserved directions; and the service."""

from __future__ import annotations

import argparse
import itertools
import json
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from services.fusion import service, so3
from services.fusion.estimate import ACCEPTED, DUPLICATE, FATES, SOURCES, Refused, information
from services.fusion.filter import Settings
from services.fusion.observer import Bank, ErrorStateObserver
from services.fusion.paper import PaperObserver
from shared import bus, cell, geometry, messages, topics
from shared.geometry import Array, perturb, pose_error
from shared.service import Node
from tests.fusion_data import HOME, SKIN, SPREAD, VISION, ns, without_roll
from tests.live import free_port, wait_for

OBSERVERS = [ErrorStateObserver, PaperObserver]


# ---- rotations


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 9.9e-5, 1.01e-4, 0.5, 3.0, np.pi - 1e-7, np.pi - 1e-12, np.pi])
def test_exp_log_and_quaternion_agree_with_scipy_also_near_zero_and_pi(angle: float) -> None:
    rng = np.random.default_rng(0)
    for axis in [*np.eye(3), *-np.eye(3), *rng.normal(size=(20, 3))]:
        r = angle * axis / np.linalg.norm(axis)
        R = Rotation.from_rotvec(r).as_matrix()
        np.testing.assert_allclose(so3.exp(r), R, atol=1e-14)
        found = so3.log(so3.exp(r))
        # at pi both signs are the same rotation
        np.testing.assert_allclose(so3.exp(found), R, atol=1e-12)
        if angle < 3.1:
            np.testing.assert_allclose(found, r, atol=1e-14, rtol=1e-9)
        assert abs(np.dot(so3.quaternion(R), Rotation.from_matrix(R).as_quat())) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 1.01e-4, 1.0, 3.0])
def test_left_jacobian_inverse_is_the_derivative_of_log(angle: float) -> None:
    r = angle * np.array([0.6, 0.0, 0.8])
    step = 1e-6
    columns = [(so3.log(so3.exp(d) @ so3.exp(r)) - so3.log(so3.exp(-d) @ so3.exp(r))) / (2 * step) for d in step * np.eye(3)]
    np.testing.assert_allclose(so3.left_jacobian_inverse(r), np.column_stack(columns), atol=1e-8)


# ---- what arrives late, twice, wrong, or not at all


def still(observer: ErrorStateObserver | PaperObserver, T: Array, begin: float, end: float, information: Array = VISION) -> None:
    """Perfect vision of a limb that rests at T, at 20 Hz."""
    for t in np.arange(begin, end, 0.05):
        observer.measure("vision", ns(t), T, information, 0.0)


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


def test_a_sense_that_disagrees_for_long_is_heard_again_beside_one_that_is_believed() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    wrong = perturb(HOME, [0.0, 0.1, 0.0, 0.0, 0.0, 0.0])
    for k in range(250):
        observer.measure("haptic", ns(k * 0.01), wrong, 4.0 * VISION)
        if k >= 50 and k % 5 == 0:
            observer.measure("vision", ns(k * 0.01), HOME, VISION)
    vision = observer.estimate(ns(2.5)).sources["vision"]
    assert observer.log.counts["vision"].gated >= 5
    assert vision.age_s < 0.2 and vision.weight > 0.01


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
    observer.log.heard("vision", ns(0.0))
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
        pytest.param(np.full((4, 4), np.nan), VISION, 0.0, "pose", "a finite rigid transform", id="not a number"),
        pytest.param(
            np.diag([0.0, 0, 0, 1]), VISION, 0.0, "pose", "is its quaternion of length one?", id="quaternion of length 0"
        ),
        pytest.param(np.diag([2.0, 2, 2, 1]), VISION, 0.0, "pose", "a finite rigid transform", id="stretched"),
        pytest.param(FAR @ np.diag([1.0, 1, -1, 1]), VISION, 0.0, "pose", "a finite rigid transform", id="mirrored"),
        pytest.param(np.eye(3), VISION, 0.0, "pose", "(4, 4)", id="a rotation only"),
        pytest.param(FAR, -VISION, 0.0, "information", "no negative eigenvalue expected, -1e+04 beside", id="negative"),
        pytest.param(
            FAR,
            np.diag([1.0, 1, 1, 1, 1, -1]),
            0.0,
            "information",
            "no negative eigenvalue expected, -1 beside 1 came",
            id="mixed",
        ),
        pytest.param(FAR, SKEW, 0.0, "information", "a symmetric matrix expected", id="not symmetric"),
        pytest.param(FAR, np.full((6, 6), np.inf), 0.0, "information", "a finite (6, 6) matrix expected", id="infinite"),
        pytest.param(FAR, np.eye(5), 0.0, "information", "a finite (6, 6) matrix expected", id="another shape"),
        pytest.param(FAR, VISION, 0.06, "future", "at most 0.05 s ahead of the clock expected, 0.060 s came", id="future"),
    ],
)
def test_what_is_no_measurement_is_refused_with_the_reason_counted_and_changes_nothing(
    make: type, T: Array, seen: Array, ahead: float, kind: str, text: str
) -> None:
    observer = make(HOME, SPREAD)
    still(observer, HOME, 0.0, 1.0)
    before = observer.estimate(ns(1.1))
    with pytest.raises(Refused) as caught:
        observer.measure("vision", ns(1.0 + ahead), T, seen, 0.0, now_ns=ns(1.0))
    assert caught.value.kind == kind and text in str(caught.value)
    assert observer.log.counts["vision"].refused == {kind: 1}
    after = observer.estimate(ns(1.1))
    np.testing.assert_array_equal(after.T, before.T)
    np.testing.assert_array_equal(after.covariance, before.covariance)
    assert after.sources == before.sources
    assert observer.measure("vision", ns(1.04), HOME, VISION, 0.0, now_ns=ns(1.0)), "clocks differ a little"


@pytest.mark.parametrize("make", OBSERVERS)
def test_a_source_that_nobody_knows_is_refused(make: type) -> None:
    with pytest.raises(ValueError, match="source: one of vision, haptic expected, 'sonar' came"):
        make(HOME, SPREAD).measure("sonar", ns(0), HOME, VISION)


# ---- many targets, many measurements


def test_a_bank_of_targets_does_what_each_of_them_does_alone() -> None:
    homes = [perturb(HOME, [0.1 * i, 0, 0, 0, 0, 0.3 * i]) for i in range(3)]
    bank = Bank(np.array(homes), [SPREAD] * 3)
    alone = [ErrorStateObserver(home, SPREAD) for home in homes]
    streams = [stream(0.5, seed=i) for i in range(3)]
    for rows in zip(*streams, strict=True):
        stamps = np.array([row[1] for row in rows])
        sources = np.array([SOURCES.index(row[0]) for row in rows])
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
    bank = Bank(np.array([HOME, HOME]), [SPREAD] * 2)
    targets, sources, stamps = np.array([0, 1, 1, 1]), np.zeros(4, np.int64), np.full(4, ns(0.0))
    seen = np.array([-VISION, VISION, VISION, VISION])
    fates = bank.measure(targets, sources, stamps, np.array([HOME, np.zeros((4, 4)), FAR, FAR]), seen, now_ns=ns(0.0))
    assert [FATES[fate] for fate in fates] == ["information", "pose", "accepted", "duplicate"]
    assert [e.state for e in bank.estimates(ns(0.0))] == ["lost", "tracking"]
    assert fates[3] == DUPLICATE and bank.logs[0].counts["vision"].refused == {"information": 1}


def test_a_storm_of_measurements_shortens_the_history_and_nothing_else() -> None:
    observer = ErrorStateObserver(HOME, SPREAD, Settings(capacity=16))
    for k in range(100):
        observer.measure("haptic", ns(0.001 * k), HOME, VISION)
    assert observer.measure("vision", ns(0.0905), HOME, VISION)
    assert not observer.measure("vision", ns(0.0505), HOME, VISION)
    assert observer.log.counts["vision"].late == 1
    assert observer.estimate(ns(0.1)).state == "tracking"
    np.testing.assert_allclose(observer.estimate(ns(0.1)).T, HOME, atol=1e-9)


def test_no_measurement_is_believed_beyond_the_floor() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    observer.measure("vision", ns(0.0), HOME, 1e18 * np.eye(6))
    floor = Settings().senses["vision"].floor
    sigma = np.sqrt(np.diag(observer.estimate(ns(0.0)).covariance))
    np.testing.assert_allclose(sigma, floor * np.array([0.1, 0.1, 0.1, 1, 1, 1]), rtol=0.02)


# ---- directions that are not observed


def test_a_rank_deficient_measurement_leaves_the_other_directions_alone() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    still(observer, HOME, 0.0, 0.5)
    before = observer.estimate(ns(0.5))
    height = np.diag([0, 0, 1e6, 0, 0, 0])
    made_up = perturb(HOME, [0.5, -0.3, 0.005, 0.0, 0.0, 1.0])
    assert observer.measure("haptic", ns(0.5), made_up, height)
    after = observer.estimate(ns(0.5))
    moved = pose_error(after.T, before.T)
    assert 0.001 < moved[2] < 0.005
    np.testing.assert_allclose(np.delete(moved, 2), 0.0, atol=1e-9)
    np.testing.assert_allclose(after.covariance[:2, :2], before.covariance[:2, :2], rtol=1e-9)
    assert after.covariance[2, 2] < before.covariance[2, 2]


@pytest.mark.parametrize("make", OBSERVERS)
def test_a_roll_that_is_made_up_does_not_disturb_the_axis(make: type) -> None:
    rng = np.random.default_rng(0)
    T = perturb(HOME, [0.03, 0.02, -0.04, 0.3, 0.2, 0.4])
    observer = make(HOME, SPREAD)
    for k in range(100):
        observer.measure(
            "haptic", ns(k * 0.01), T @ geometry.from_rpy([0, 0, 0], [rng.uniform(-2, 2), 0, 0]), without_roll(T, SKIN)
        )
    estimate = observer.estimate(ns(1.0))
    assert np.linalg.norm(pose_error(T, estimate.T)[:3]) < 1e-3
    assert geometry.axis_angle_error(T, estimate.T) < 1e-3
    roll_variance = T[:3, 0] @ estimate.covariance[3:, 3:] @ T[:3, 0]
    assert roll_variance > 0.5 * SPREAD[1] ** 2  # nobody saw it


def test_the_first_haptic_pose_is_completed_by_home() -> None:
    observer = ErrorStateObserver(HOME, SPREAD)
    T = perturb(HOME, [0.1, 0.05, -0.1, 0.0, 0.0, 0.5])
    across = np.diag([0, 1e5, 1e5, 0, 1e3, 1e3])  # neither roll nor the way along the x axis
    observer.measure("haptic", ns(0), T, across)
    found = observer.estimate(ns(0))
    np.testing.assert_allclose(found.T[1:3, 3], T[1:3, 3], atol=2e-3)
    assert abs(found.T[0, 3] - HOME[0, 3]) < 1e-6
    assert found.covariance[0, 0] == pytest.approx(SPREAD[0] ** 2, rel=0.1)
    assert geometry.axis_angle_error(T, found.T) < 0.02


@pytest.mark.parametrize("make", OBSERVERS)
def test_a_turn_through_pi_is_followed(make: type) -> None:
    observer = make(HOME, SPREAD)
    rate = 2.0
    worst = 0.0
    for k in range(100):  # from -2.6 to 7.4 rad about the vertical
        t = 0.05 * k
        T = geometry.from_rpy([0.0, 0.0, 0.2], [0.0, 0.0, -2.6 + rate * t])
        observer.measure("vision", ns(t), T, VISION, 0.0)
        if t > 1.0:
            ahead = geometry.from_rpy([0.0, 0.0, 0.2], [0.0, 0.0, -2.6 + rate * (t + 0.02)])
            worst = max(worst, np.abs(pose_error(ahead, observer.estimate(ns(t + 0.02)).T)).max())
    assert worst < 0.06  # 3.4 degrees, at 115 degrees a second


# ---- the service


@pytest.fixture(scope="module")
def table() -> cell.Cell:
    return cell.load("table")


@pytest.fixture
def router(table: cell.Cell) -> Iterator[str]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Node("router", table, bus.Connection(mode="router", listen=(endpoint,))):
        yield endpoint


def vision_pose(table: cell.Cell, **changes: object) -> messages.VisionPose:
    values = {
        "stamp_ns": time.time_ns(),
        "target": "forearm",
        "camera": "front",
        "frame": "world",
        "position": np.array([0.01, 0.02, 0.15]),
        "orientation": np.array([0.0, 0.0, 0.0, 1.0]),
        "covariance": np.diag([1e-4] * 3 + [1e-3] * 3),
        "overlap": 0.95,
        "hidden": 0.0,
        "state": "tracking",
    }
    return messages.VisionPose(**(values | changes))


@pytest.mark.parametrize("observer", ["default", "paper"])
def test_the_service_publishes_and_answers_in_both_formats(observer: str, table: cell.Cell, router: str) -> None:
    parser = argparse.ArgumentParser()
    service.arguments(parser)
    fusion = Node(service.NAME, table, bus.Connection(connect=(router,)))
    service.start(fusion, parser.parse_args(["--observer", observer]))
    user = Node("user", table, bus.Connection(connect=(router,)))
    key = topics.current_pose("table", "forearm")
    heard: list[messages.FusedPose] = []
    user.subscribe(topics.FUSED, lambda message, _: heard.append(message))
    with fusion, user:

        def answer() -> dict:
            replies = user.query(key, "format=json")
            return json.loads(replies[0]) if replies else {}

        first = wait_for(answer, 5.0, "an answer")
        assert first["state"] == "lost" and first["sources"] == {}
        np.testing.assert_allclose(first["position"], [0.0, 0.0, 0.2])

        def occluded() -> bool:
            user.publish(
                topics.VISION, vision_pose(table, state="occluded", position=np.array([9.0, 9.0, 9.0])), target="forearm"
            )
            return "vision" in answer()["sources"]

        wait_for(occluded, 5.0, "vision to be heard")
        assert answer()["state"] == "lost"

        def tracking() -> bool:
            user.publish(topics.VISION, vision_pose(table), target="forearm")
            return answer()["state"] == "tracking"

        wait_for(tracking, 5.0, "the state tracking")
        user.publish(topics.VISION, vision_pose(table), target="forearm")
        pose = answer()
        np.testing.assert_allclose(pose["position"], [0.01, 0.02, 0.15], atol=1e-3)
        assert np.array(pose["covariance"]).shape == (6, 6) and len(pose["velocity"]) == 6
        assert set(pose) == {
            "target",
            "frame",
            "stamp_ns",
            "position",
            "orientation",
            "rpy",
            "velocity",
            "covariance",
            "state",
            "sources",
        }
        assert pose["sources"]["vision"]["weight"] == pytest.approx(1.0)
        packed = messages.decode(messages.FusedPose, user.query(key)[0])
        np.testing.assert_allclose(packed.orientation, [0.0, 0.0, 0.0, 1.0], atol=1e-3)
        with pytest.raises(bus.Refused, match="format: msgpack or json expected, 'xml' came"):
            user.query(key, "format=xml")
        wait_for(lambda: len(heard) > 20, 5.0, "fused poses on the bus")
        stamps = np.diff([message.stamp_ns for message in heard])
        assert (stamps > 0).all()


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


def test_the_next_replica_speaks_while_the_owner_is_silent_and_no_longer(table: cell.Cell, router: str) -> None:
    parser = argparse.ArgumentParser()
    service.arguments(parser)
    options = parser.parse_args([])

    class Frozen(Node):
        """Alive to the others, but silent when told so."""

        is_silent = False

        def publish(self, topic: topics.Topic, message: messages.Message, **names: str) -> None:
            if not self.is_silent:
                super().publish(topic, message, **names)

    nodes = [Frozen(service.NAME, table, bus.Connection(connect=(router,))) for _ in range(2)]
    user = Node("user", table, bus.Connection(connect=(router,)))
    heard: list[str] = []
    user.subscribe(topics.FUSED, lambda message, names: heard.append(names["publisher"]))
    see = lambda: user.publish(topics.VISION, vision_pose(table), target="forearm")  # noqa: E731
    for node in nodes:
        service.start(node, options)
    with user, nodes[0], nodes[1]:
        ready = lambda: see() or (all(node.health()["ready"] for node in nodes) and any(n.owns("forearm") for n in nodes))  # noqa: E731
        wait_for(ready, 20.0, "both replicas")
        (owner,) = (node for node in nodes if node.owns("forearm"))
        wait_for(lambda: len(heard) > 20 and len(set(heard[-20:])) == 1, 5.0, "the owner's poses alone")
        speaker = heard[-1]
        owner.is_silent = True
        wait_for(lambda: heard[-1] != speaker, 5.0, "the other one's poses")
        assert owner.owns("forearm"), "it is alive"
        owner.is_silent = False
        wait_for(lambda: len(heard) > 20 and set(heard[-20:]) == {speaker}, 5.0, "the owner alone")


@pytest.mark.parametrize("observer", ["default", "paper"])
def test_a_replica_that_takes_over_goes_on_with_the_pose(
    observer: str, table: cell.Cell, router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where it begins before it has heard anything: the default observer goes on from what the old one publishes; the
    paper's leaves the word to the old one until it has."""
    monkeypatch.setattr("shared.service.NEWS_S", 5.0)  # however busy the machine is
    monkeypatch.setattr("shared.service.WARM_UP_S", 60.0)
    parser = argparse.ArgumentParser()
    service.arguments(parser)
    options = parser.parse_args(["--observer", observer])

    def replica() -> Node:
        node = Node(service.NAME, table, bus.Connection(connect=(router,)))
        service.start(node, options)
        return node

    user = Node("user", table, bus.Connection(connect=(router,)))
    heard: list[tuple[messages.FusedPose, str]] = []
    user.subscribe(topics.FUSED, lambda message, names: heard.append((message, names["publisher"])))
    see = lambda: user.publish(topics.VISION, vision_pose(table), target="forearm")  # noqa: E731
    with user, replica() as old:
        wait_for(lambda: see() or (heard and heard[-1][0].state == "tracking"), 10.0, "a tracked pose")
        with replica() as new:
            del heard[:]
            wait_for(lambda: len(heard) > 5, 5.0, "poses while the new one has heard nothing")
            if observer == "default":
                wait_for(lambda: new.health()["ready"], 5.0, "the new one to be ready without a measurement of its own")
            else:
                assert not new.health()["ready"] and not new.owns("forearm")
            (answer, *_) = user.query(topics.current_pose("table", "forearm"), "format=json")
            assert json.loads(answer)["state"] != "lost", "the old one's"
            assert len(user.query(topics.health("table", service.NAME))) == 2
            wait_for(lambda: see() or new.health()["ready"], 5.0, "the new one to be ready")
            speaker = heard[0][1]
            old.close()
            taken_over = lambda: see() or {publisher for _, publisher in heard} - {speaker}  # noqa: E731
            wait_for(taken_over, 5.0, "the new one to publish")
            assert new.owns("forearm")
    assert {message.state for message, _ in heard} <= {"tracking", "coasting"}


@pytest.mark.parametrize("observer", ["default", "paper"])
def test_what_the_service_refuses_is_counted_in_its_health_by_kind_and_moves_nothing(
    observer: str, table: cell.Cell, router: str
) -> None:
    parser = argparse.ArgumentParser()
    service.arguments(parser)
    fusion = Node(service.NAME, table, bus.Connection(connect=(router,)))
    service.start(fusion, parser.parse_args(["--observer", observer]))
    user, rival = (Node("user", table, bus.Connection(connect=(router,))) for _ in range(2))
    key = topics.current_pose("table", "forearm")

    def health() -> dict:
        (reply,) = user.query(topics.health("table", service.NAME, fusion.instance)) or [b"{}"]
        return json.loads(reply)

    def refused() -> dict:
        return health().get("report", {}).get("forearm", {}).get("vision", {}).get("refused", {})

    def by_decoder() -> int:
        return health()["topics"][topics.VISION.at(cell="table", target="forearm")]["bad"].get("values", 0)

    with fusion, user, rival:
        good = threading.Event()

        def hold_still() -> None:
            while not good.wait(0.02):
                user.publish(topics.VISION, vision_pose(table), target="forearm")

        publisher = threading.Thread(target=hold_still, daemon=True)
        publisher.start()
        wait_for(lambda: health().get("report", {}).get("forearm", {}).get("state") == "tracking", 5.0, "the state tracking")
        away = np.array([0.06, 0.02, 0.15])
        wrong = [
            ("frame", user, {"frame": "moon"}),
            ("frame", user, {"target": "leg"}),
            ("camera", user, {"camera": "back"}),
            ("covariance", user, {"covariance": np.zeros((6, 6))}),
            ("future", user, {"stamp_ns": 300_000_000}),
            ("publisher", rival, {}),
        ]
        counted: dict[str, int] = {}
        for kind, node, changes in wrong:
            counted[kind] = counted.get(kind, 0) + 1
            stamp_ns = time.time_ns() + changes.pop("stamp_ns", 0)
            node.publish(topics.VISION, vision_pose(table, position=away, stamp_ns=stamp_ns, **changes), target="forearm")
            wait_for(lambda counted=counted: refused() == counted, 5.0, f"{kind} among {counted}")
        for k, changes in enumerate(({"orientation": np.zeros(4)}, {"covariance": np.diag([1.0, 1, 1, 1, 1, -1])})):
            user.publish(topics.VISION, vision_pose(table, position=away, **changes), target="forearm")
            wait_for(lambda k=k: by_decoder() == k + 1, 5.0, "what is not even decoded")
        wait_for(lambda: health()["report"]["forearm"]["vision"]["accepted"] > 5, 5.0, "that good poses go on being accepted")
        good.set()
        publisher.join()
        assert health()["faults"] == {}
        pose = json.loads(user.query(key, "format=json")[0])
        np.testing.assert_allclose(pose["position"], [0.01, 0.02, 0.15], atol=2e-3)


def test_another_publisher_of_a_stream_is_heard_after_the_silence_of_the_first_and_beside_another_stream() -> None:
    publishers = service.Publishers()
    publishers.check("front", "a", 0.0, 0.3)
    publishers.check("side", "b", 0.1, 0.3)
    publishers.check("front", "a", 0.2, 0.3)
    with pytest.raises(Refused, match="front: one publisher expected, b came beside a: two processes publish the same poses"):
        publishers.check("front", "b", 0.4, 0.3)
    publishers.check("front", "b", 0.6, 0.3)
    with pytest.raises(Refused, match="a came beside b"):
        publishers.check("front", "a", 0.7, 0.3)


@pytest.mark.parametrize("kind", sorted(service.OBSERVERS))
def test_a_clock_that_is_set_makes_the_pose_lost_until_the_next_measurement_and_never_an_old_one_tracking(
    table: cell.Cell, kind: str
) -> None:
    now_ns = ns(10_000.0)
    group = service.Group(kind, list(table.targets.values()), lambda: now_ns)

    def state(measured: bool) -> str:
        with group.lock:
            if measured:
                group.observers[0].measure("vision", group.now_ns(), np.eye(4), 1e6 * np.eye(6), 0.0, now_ns)
        return group.estimates()[1][0].state

    assert state(measured=False) == "lost"
    assert state(measured=True) == "tracking"
    now_ns -= 10**7
    assert state(measured=False) == "tracking", "clocks that are kept together by small steps lose nothing"
    for jump in (-3600.0, -1.0, 3600.0):
        now_ns += int(jump * 1e9)
        assert state(measured=False) == "lost"
        assert group.observers[0].estimate(now_ns + 7200 * 10**9).state == "lost"
        assert state(measured=True) == "tracking"


def test_a_target_that_the_cell_does_not_have_is_told(table: cell.Cell) -> None:
    parser = argparse.ArgumentParser()
    service.arguments(parser)
    with pytest.raises(cell.CellError, match="cell table has no target 'leg': it has forearm"):
        service.start(Node(service.NAME, table), parser.parse_args(["--target", "leg"]))


def test_a_covariance_that_is_none_is_refused() -> None:
    np.testing.assert_allclose(information(np.diag([4.0, 1, 1, 1, 1, 2])), np.diag([0.25, 1, 1, 1, 1, 0.5]))
    for bad in (np.zeros((6, 6)), -np.eye(6), np.eye(6) + np.eye(6, k=2)):
        with pytest.raises(ValueError, match="symmetric and positive definite expected"):
            information(bad)
