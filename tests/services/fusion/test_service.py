"""The fusion service on a real bus: what it hears, refuses and says, and how its replicas relieve one another."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest

from penumbra.services import flags
from penumbra.services.fusion import service
from penumbra.services.fusion.estimate import RefusedMeasurement, information
from penumbra.services.fusion.settings import Arm, Subject
from penumbra.shared.cell import description
from penumbra.shared.contract import messages, topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support.fusion_data import ns
from penumbra.tests.support.live import free_port, wait_for


@pytest.fixture(scope="module")
def table() -> description.Cell:
    return description.load("table")


@pytest.fixture
def router(table: description.Cell) -> Iterator[str]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Node("router", table, bus.Connection(mode="router", listen=(endpoint,))):
        yield endpoint


def vision_pose(table: description.Cell, **changes: object) -> messages.VisionPose:
    values: dict[str, Any] = {
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
def test_the_service_publishes_and_answers_in_both_formats(observer: str, table: description.Cell, router: str) -> None:
    fusion = Node(service.NAME, table, bus.Connection(connect=(router,)))
    service.start(fusion, flags.parse(service.FLAGS, ["--observer", observer]))
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

        wait_for(occluded, 5.0, "vision to be received")
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
        with pytest.raises(bus.Refused, match="format: expected msgpack or json, got 'xml'"):
            user.query(key, "format=xml")
        wait_for(lambda: len(heard) > 20, 5.0, "fused poses on the bus")
        stamps = np.diff([message.stamp_ns for message in heard])
        assert (stamps > 0).all()


def test_the_next_replica_publishes_while_the_owner_is_silent_and_no_longer(table: description.Cell, router: str) -> None:
    options = flags.parse(service.FLAGS, [])

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
        owners = lambda: [node for node in nodes if node.owns("forearm")]  # noqa: E731
        # at first each may be an owner, until it hears of the other one
        ready = lambda: see() or (all(node.health()["ready"] for node in nodes) and len(owners()) == 1)  # noqa: E731
        wait_for(ready, 20.0, "both replicas, and an owner")
        (owner,) = owners()
        wait_for(lambda: len(heard) > 20 and len(set(heard[-20:])) == 1, 5.0, "the owner's poses alone")
        speaker = heard[-1]
        owner.is_silent = True
        wait_for(lambda: heard[-1] != speaker, 5.0, "the other one's poses")
        assert owner.owns("forearm"), "it is alive"
        owner.is_silent = False
        wait_for(lambda: len(heard) > 20 and set(heard[-20:]) == {speaker}, 5.0, "the owner alone")


@pytest.mark.parametrize("observer", ["default", "paper"])
def test_a_replica_that_takes_over_goes_on_with_the_pose(
    observer: str, table: description.Cell, router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where it begins before it has heard anything: the default observer goes on from what the old one publishes; the
    paper's leaves the word to the old one until it has."""
    monkeypatch.setattr("penumbra.shared.runtime.node.NEWS_S", 5.0)  # however busy the machine is
    monkeypatch.setattr("penumbra.shared.runtime.node.WARM_UP_S", 60.0)
    options = flags.parse(service.FLAGS, ["--observer", observer])

    def replica() -> Node:
        node = Node(service.NAME, table, bus.Connection(connect=(router,)))
        service.start(node, options)
        return node

    user = Node("user", table, bus.Connection(connect=(router,)))
    heard: list[messages.FusedPose] = []
    user.subscribe(topics.FUSED, lambda message, _: heard.append(message))
    see = lambda: user.publish(topics.VISION, vision_pose(table), target="forearm")  # noqa: E731
    with user, replica() as old:
        wait_for(lambda: see() or (heard and heard[-1].state == "tracking"), 10.0, "a tracked pose")
        with replica() as new:
            del heard[:]
            wait_for(lambda: len(heard) > 5, 5.0, "poses while the new one has received nothing")
            if observer == "default":
                wait_for(lambda: new.health()["ready"], 5.0, "the new one to be ready without a measurement of its own")
            else:
                assert not new.health()["ready"] and not new.owns("forearm")
            (answer, *_) = user.query(topics.current_pose("table", "forearm"), "format=json")
            assert json.loads(answer)["state"] != "lost", "the old one's"
            assert len(user.query(topics.health("table", service.NAME))) == 2
            wait_for(lambda: see() or new.health()["ready"], 5.0, "the new one to be ready")
            old.close()
            on_their_way = len(heard) + 20
            wait_for(lambda: see() or len(heard) > on_their_way, 5.0, "the new one to publish")
            assert new.owns("forearm")
    assert {message.state for message in heard} <= {"tracking", "coasting"}


@pytest.mark.parametrize("observer", ["default", "paper"])
def test_what_the_service_refuses_is_counted_in_its_health_by_kind_and_moves_nothing(
    observer: str, table: description.Cell, router: str
) -> None:
    fusion = Node(service.NAME, table, bus.Connection(connect=(router,)))
    service.start(fusion, flags.parse(service.FLAGS, ["--observer", observer]))
    user, rival = (Node("user", table, bus.Connection(connect=(router,))) for _ in range(2))
    key = topics.current_pose("table", "forearm")

    def health() -> dict:
        (reply,) = user.query(topics.health("table", service.NAME, fusion.instance)) or [b"{}"]
        return json.loads(reply)

    def are_refused(counted: dict[str, int]) -> bool:
        return health().get("report", {}).get("forearm", {}).get("vision", {}).get("refused", {}) == counted

    def are_not_decoded(count: int) -> bool:
        return health()["topics"][topics.VISION.at(cell="table", target="forearm")]["bad"].get("values", 0) == count

    with fusion, user, rival:
        good = threading.Event()

        def hold_still() -> None:
            while not good.wait(0.02):
                user.publish(topics.VISION, vision_pose(table), target="forearm")

        publisher = threading.Thread(target=hold_still, daemon=True)
        publisher.start()
        wait_for(lambda: health().get("report", {}).get("forearm", {}).get("state") == "tracking", 5.0, "the state tracking")
        away = np.array([0.06, 0.02, 0.15])
        wrong: list[tuple[str, Node, dict[str, Any]]] = [
            ("frame", user, {"frame": "moon"}),
            ("frame", user, {"target": "leg"}),
            ("camera", user, {"camera": "back"}),
            ("covariance", user, {"covariance": np.zeros((6, 6))}),
            ("publisher", rival, {}),
        ]
        counted: dict[str, int] = {}
        for kind, node, changes in wrong:
            counted[kind] = counted.get(kind, 0) + 1
            stamp_ns = time.time_ns() + changes.pop("stamp_ns", 0)
            node.publish(topics.VISION, vision_pose(table, position=away, stamp_ns=stamp_ns, **changes), target="forearm")
            wait_for(partial(are_refused, counted), 5.0, f"{kind} among {counted}")
        for k, (field, value) in enumerate((("orientation", np.zeros(4)), ("covariance", np.diag([1.0, 1, 1, 1, 1, -1])))):
            user.publish(topics.VISION, vision_pose(table, position=away, **{field: value}), target="forearm")
            wait_for(partial(are_not_decoded, k + 1), 5.0, "what is not even decoded")
        wait_for(lambda: health()["report"]["forearm"]["vision"]["accepted"] > 5, 5.0, "that good poses go on being accepted")
        good.set()
        publisher.join()
        assert health()["faults"] == {}
        pose = json.loads(user.query(key, "format=json")[0])
        np.testing.assert_allclose(pose["position"], [0.01, 0.02, 0.15], atol=2e-3)


@pytest.mark.parametrize("observer", ["default", "paper"])
def test_a_camera_whose_clock_is_ahead_by_less_than_the_bus_allows_is_fused(
    observer: str, table: description.Cell, router: str
) -> None:
    fusion, user = (Node(name, table, bus.Connection(connect=(router,))) for name in (service.NAME, "user"))
    service.start(fusion, flags.parse(service.FLAGS, ["--observer", observer]))

    def see(ahead_s: float) -> dict:
        stamp_ns = time.time_ns() + int(1e9 * ahead_s)
        user.publish(topics.VISION, vision_pose(table, stamp_ns=stamp_ns), target="forearm")
        (reply,) = user.query(topics.health("table", service.NAME, fusion.instance)) or [b"{}"]
        return json.loads(reply)

    key = topics.VISION.at(cell="table", target="forearm")
    bad = lambda: see(messages.MAX_FUTURE_S + 0.2).get("topics", {}).get(key, {}).get("bad", {})  # noqa: E731
    with fusion, user:
        wait_for(lambda: bad().get("future"), 10.0, "a refusal")
        accepted = lambda: see(0.8 * messages.MAX_FUTURE_S)["report"]["forearm"]["vision"]  # noqa: E731
        wait_for(lambda: accepted()["accepted"] > 3, 10.0, "measurements to be accepted")
        assert accepted()["refused"] == {}


def test_another_publisher_of_a_stream_is_accepted_after_the_silence_of_the_first_and_beside_another_stream() -> None:
    publishers = service.Publishers()
    publishers.check("front", "a", 0.0, 0.3)
    publishers.check("side", "b", 0.1, 0.3)
    publishers.check("front", "a", 0.2, 0.3)
    with pytest.raises(
        RefusedMeasurement, match="front: expected one publisher, got b beside a: two processes publish the same poses"
    ):
        publishers.check("front", "b", 0.4, 0.3)
    publishers.check("front", "b", 0.6, 0.3)
    with pytest.raises(RefusedMeasurement, match="got a beside b"):
        publishers.check("front", "a", 0.7, 0.3)


@pytest.mark.parametrize("kind", sorted(service.OBSERVERS))
def test_the_cell_file_says_what_tracking_promises(table: description.Cell, kind: str) -> None:
    for bound, state in ((0.005, "coasting"), (0.3, "tracking")):
        target = table.targets["forearm"].model_copy(update={"tracking_bound": bound})
        group = service.Group(kind, [Subject.of(target, table.body)], lambda: ns(0.0))
        group.observers[0].measure("vision", ns(0.0), target.home.transform, 1e4 * np.eye(6), 0.0)
        assert group.estimates()[1][0].state == state


def test_the_cell_file_s_person_says_how_far_an_arm_reaches(table: description.Cell) -> None:
    target = table.targets["forearm"].model_copy(update={"shoulder": (-0.4, 0.1, 0.4)})
    assert Subject.of(target, table.body).arm == Arm(
        (-0.4, 0.1, 0.4), table.body.upper_arm_length, table.body.forearm_length / 2.0
    )
    assert Subject.of(table.targets["forearm"], table.body).arm == Arm(), "nobody knows where the shoulder is"


@pytest.mark.parametrize("kind", sorted(service.OBSERVERS))
def test_a_clock_that_is_set_makes_the_pose_lost_until_the_next_measurement_and_never_an_old_one_tracking(
    table: description.Cell, kind: str
) -> None:
    now_ns = ns(10_000.0)
    group = service.Group(kind, [Subject.of(target, table.body) for target in table.targets.values()], lambda: now_ns)

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


def test_a_target_that_the_cell_does_not_have_is_reported(table: description.Cell) -> None:
    with pytest.raises(description.CellError, match="cell table has no target 'leg': it has forearm"):
        service.start(Node(service.NAME, table), flags.parse(service.FLAGS, ["--target", "leg"]))


def test_a_covariance_that_is_none_is_refused() -> None:
    np.testing.assert_allclose(information(np.diag([4.0, 1, 1, 1, 1, 2])), np.diag([0.25, 1, 1, 1, 1, 0.5]))
    for bad in (np.zeros((6, 6)), -np.eye(6), np.eye(6) + np.eye(6, k=2)):
        with pytest.raises(ValueError, match="expected symmetric and positive definite"):
            information(bad)
