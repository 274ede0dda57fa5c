"""The table of senses: a sense more is a row more, and fusion takes it as it takes the others."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pytest

from penumbra.services import flags
from penumbra.services.command import look
from penumbra.services.fusion import service
from penumbra.services.fusion.observer import ErrorStateObserver
from penumbra.shared.cell import description
from penumbra.shared.contract import messages, topics
from penumbra.shared.contract.senses import SENSES, Errors, Measures, Sense
from penumbra.shared.geometry.rigid import perturb
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support import injected
from penumbra.tests.support.fusion_data import HOME, SPREAD, VISION, ns
from penumbra.tests.support.live import free_port, wait_for

TRUE = np.array([0.03, -0.02, 0.18])
"""Where the limb rests [m]."""
CAMERA_ERROR = np.array([0.02, 0.0, 0.0])
"""By which the camera is wrong [m], for as long as the limb rests."""


OUTLIER = np.array([0.3, 0.0, 0.0])


if TYPE_CHECKING:
    PositionCovariance: TypeAlias = np.ndarray
else:
    PositionCovariance = messages.array("float64", 3, 3, check=messages.not_semidefinite)


class BeaconPosition(messages.Message, frozen=True, kw_only=True):
    """What a made-up sensor measures that sees a beacon on the forearm and nothing of the arm's rotation."""

    target: messages.Name
    frame: messages.Name
    position: messages.Position
    covariance: PositionCovariance


TOPIC = topics.Topic("beacon", "penumbra/{cell}/target/{target}/beacon", BeaconPosition, 50, 16, 0.1, ("beacon",),
                     "a beacon's position", topics.Priority.POSE, 20)  # fmt: skip
BEACON = Sense("beacon", TOPIC, Measures.POSITION, Errors(lasting=0.2, time_constant=0.3))
THREE, TOPICS = (*SENSES, BEACON), (*topics.TOPICS, TOPIC)


def beacon(position: np.ndarray, **changes: object) -> BeaconPosition:
    """A measurement with a standard deviation of 2 mm."""
    values: dict[str, Any] = {"stamp_ns": time.time_ns(), "target": "forearm", "frame": "world"}
    return BeaconPosition(**(values | {"position": position, "covariance": np.diag([4e-6] * 3)} | changes))


def camera() -> messages.VisionPose:
    """A pose that is wrong, and says so: its standard deviation is 2 cm."""
    return messages.VisionPose(
        stamp_ns=time.time_ns(),
        target="forearm",
        camera="front",
        frame="world",
        position=TRUE + CAMERA_ERROR,
        orientation=np.array([0.0, 0.0, 0.0, 1.0]),
        covariance=np.diag([4e-4] * 3 + [1e-3] * 3),
        overlap=0.9,
        hidden=0.0,
        state="tracking",
    )


@dataclass(frozen=True)
class Chain:
    """A fusion process with three senses, the publishers of two of them, and somebody who asks."""

    endpoint: str
    fusion: Node
    eye: Node
    sensor: Node
    user: Node

    def pose(self) -> dict:
        """The answer to the pose query, empty where none comes in time."""
        try:
            answers = self.user.query(topics.current_pose("table", "forearm"), "format=json")
        except bus.Refused:
            return {}
        return json.loads(answers[0]) if answers else {}

    def report(self) -> dict:
        """What fusion tells of the forearm in its health."""
        (answer,) = self.user.query(topics.health("table", service.NAME, self.fusion.instance)) or [b"{}"]
        return json.loads(answer).get("report", {}).get("forearm", {})

    def error(self) -> float:
        """Distance [m] of the fused pose from the true one, NaN where none is known."""
        return float(np.linalg.norm(np.subtract(self.pose().get("position", [np.nan] * 3), TRUE)))


@pytest.fixture
def chain() -> Iterator[Chain]:
    table = description.load("table")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = Node("router", table, bus.Connection(mode="router", listen=(endpoint,)))
    fusion, eye, sensor, user = (
        Node(name, table, bus.Connection(connect=(endpoint,))) for name in (service.NAME, "search", "beacon", "user")
    )
    service.start(fusion, flags.parse(service.FLAGS, []), senses=THREE)
    with router, fusion, eye, sensor, user:
        yield Chain(endpoint, fusion, eye, sensor, user)


@contextmanager
def publishing(node: Node, topic: topics.Topic, make: Callable[[], messages.Message], period_s: float) -> Iterator[None]:
    """A measurement each period, in a thread of its own."""
    done = threading.Event()

    def publish() -> None:
        while not done.wait(period_s):
            node.publish(topic, make(), target="forearm")

    with injected.meanwhile(publish, done):
        yield


def test_a_third_sense_that_measures_a_position_is_fused_weighed_listed_and_gated(
    chain: Chain, capsys: pytest.CaptureFixture[str]
) -> None:
    with publishing(chain.eye, topics.VISION, camera, 0.05):
        wait_for(lambda: chain.pose().get("state") == "tracking", 10.0, "a pose by the camera alone")
        wait_for(lambda: chain.error() > 0.015, 10.0, "the camera's error in the fused pose")
        assert set(wait_for(chain.pose, 5.0, "a pose")["sources"]) == {"vision"}
        with publishing(chain.sensor, TOPIC, lambda: beacon(TRUE), 0.02):
            # fused: the beacon says 2 mm where the camera says 2 cm
            wait_for(lambda: chain.error() < 0.004, 10.0, "the error to fall")
            # weighed
            sources = wait_for(chain.pose, 5.0, "a pose")["sources"]
            assert set(sources) == {"vision", "beacon"}
            assert sources["beacon"]["age_s"] >= 0.0
            assert 0.0 < sources["beacon"]["weight"] <= 1.0
            assert sum(source["weight"] for source in sources.values()) == pytest.approx(1.0)
            # listed
            report = chain.report()
            assert report["beacon"]["accepted"] > 0 and report["haptic"]["accepted"] == 0
            params = look.list_topics.params
            look.show_topics(flags.parse(params), TOPICS)
            listed = next(line for line in capsys.readouterr().out.splitlines() if line.startswith(" beacon"))
            assert "penumbra/table/target/forearm/beacon" in listed and "BeaconPosition" in listed
            look.show_topics(flags.parse(params, ["--connect", chain.endpoint, "--hz", "--seconds", "0.5"]), TOPICS)
            heard = next(line for line in capsys.readouterr().out.splitlines() if "target/forearm/beacon" in line)
            rate_hz, expected_hz = (float(each) for each in heard.split()[1:3])
            assert rate_hz > 0.0 and expected_hz == TOPIC.rate_hz
            # gated: beside two senses that agree
            before = chain.report()["beacon"]["gated"]
            chain.sensor.publish(TOPIC, beacon(TRUE + OUTLIER), target="forearm")
            wait_for(lambda: chain.report()["beacon"]["gated"] > before, 5.0, "the outlier to be refused")
            wait_for(lambda: chain.error() < 0.004, 5.0, "a pose that the outlier has not moved")


def test_what_is_wrong_with_a_third_sense_s_messages_is_refused_and_counted(chain: Chain) -> None:
    chain.sensor.publish(TOPIC, beacon(TRUE, frame="moon"), target="forearm")
    wrong: dict[str, dict[str, Any]] = {"frame": {"frame": "moon"}, "covariance": {"covariance": np.zeros((3, 3))}}
    for kind, changes in wrong.items():

        def is_refused(kind: str = kind, changes: dict[str, Any] = changes) -> bool:
            chain.sensor.publish(TOPIC, beacon(TRUE, **changes), target="forearm")
            return chain.report().get("beacon", {}).get("refused", {}).get(kind, 0) > 0

        wait_for(is_refused, 10.0, f"a refusal for its {kind}")
    assert chain.report()["beacon"]["accepted"] == 0


def test_a_row_that_nobody_publishes_changes_no_number_of_the_others() -> None:
    two, three = ErrorStateObserver(HOME, SPREAD), ErrorStateObserver(HOME, SPREAD, senses=THREE)
    rng = np.random.default_rng(0)
    for k in range(60):
        source = ("haptic", "vision")[k % 3 == 0]
        T = perturb(HOME, 0.01 * rng.normal(size=6) * (20.0 if k == 40 else 1.0))  # one that is refused
        assert two.measure(source, ns(0.02 * k), T, VISION) == three.measure(source, ns(0.02 * k), T, VISION)
    a, b = two.estimate(ns(1.2)), three.estimate(ns(1.2))
    # the rows and columns of the third bias hold zeros: the same sums in the same order
    np.testing.assert_array_equal(a.T, b.T)
    np.testing.assert_array_equal(a.covariance, b.covariance)
    assert a.sources == b.sources


def test_the_rows_of_the_table_have_names_and_topics_of_their_own() -> None:
    assert len({sense.name for sense in SENSES}) == len({sense.topic.name for sense in SENSES}) == len(SENSES)
    assert all(sense.topic in topics.TOPICS for sense in SENSES)


def test_each_sense_is_gated_by_its_own_row() -> None:
    def fate(gate: float) -> bool:
        rows = tuple(replace(sense, errors=replace(sense.errors, gate=(gate, gate, gate))) for sense in SENSES)
        observer = ErrorStateObserver(HOME, SPREAD, senses=rows)
        for k in range(20):
            observer.measure("vision", ns(0.05 * k), HOME, VISION)
        away = perturb(HOME, [0.037, 0.0, 0.0, 0.0, 0.0, 0.0])  # between the quantiles
        return observer.measure("vision", ns(1.0), away, VISION)

    assert fate(0.9999) and not fate(0.99)


def test_a_sense_whose_message_does_not_hold_what_it_measures_is_refused() -> None:
    with pytest.raises(TypeError, match=r"sense beacon: expected .* got BeaconPosition without information, orientation"):
        replace(BEACON, measures=Measures.POSE_INFORMATION)
    with pytest.raises(TypeError, match="got BeaconPosition without camera, state"):
        replace(BEACON, usable="tracking", part="camera")
    with pytest.raises(TypeError, match=r"expected a topic with \{target\} in its key, got penumbra/.*/frame"):
        replace(BEACON, topic=topics.FRAME)


def test_the_papers_observer_takes_its_two_senses_whatever_the_table_has() -> None:
    table = description.load("table")
    node = Node(service.NAME, table)
    service.start(node, flags.parse(service.FLAGS, ["--observer", "paper"]), senses=THREE)
    assert {sense for sense in node.report().report["forearm"] if sense != "state"} == {"vision", "haptic"}
