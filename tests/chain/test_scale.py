"""Cells of many cameras and targets as real processes, and the benchmark that measures them."""

import json
import threading
from functools import partial

import pytest
import zenoh

from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.runtime import bus
from penumbra.tests.bench import scale
from penumbra.tests.bench.lib import buses
from penumbra.tests.bench.lib.results import markdown
from penumbra.tests.support.cells import derive
from penumbra.tests.support.live import connect, free_port, penumbra_up, wait_for

CAMERA_HZ = 1
"""Eight cameras share the cores with all that looks at their frames."""
START_S = 240.0


@pytest.mark.slow
def test_the_bench_of_the_bus_measures_both_sides_of_every_payload(monkeypatch):
    monkeypatch.setattr(scale, "FLOOD_S", 0.1)
    monkeypatch.setattr(scale, "MESSAGES", 20)
    runs = [scale.bus_rows(rounds=1) for _ in range(3)]  # one slow moment makes no ratio
    for rows in runs:
        assert [row["bytes"] for row in rows] == [len(messages.encode(payload.make(0))) for payload in buses.PAYLOADS.values()]
        for row in rows:
            assert row["latency_ratio"] == pytest.approx(row["latency_us"]["ours"] / row["latency_us"]["raw"], rel=0.02)
            assert row["throughput_ratio"] == pytest.approx(row["per_s"]["ours"] / row["per_s"]["raw"], rel=0.02)
    small, large = (sorted(rows[k]["per_s"]["ours"] for rows in runs)[1] for k in (0, -1))
    assert small > large, "larger messages take longer"
    for of_one_payload in zip(*runs, strict=True):
        assert 0.01 < sorted(row["throughput_ratio"] for row in of_one_payload)[1] < 2.0


@pytest.mark.slow
def test_a_message_of_the_bench_that_is_lost_is_reported_and_does_not_hang(monkeypatch):
    monkeypatch.setattr(buses, "PATIENCE_S", 2.0)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = bus.open_session(bus.Connection("router", (), (endpoint,)), threading.Event(), lambda: None, 5.0)
    with router, buses.linked(endpoint) as link:
        link._acks.undeclare()
        with pytest.raises(AssertionError, match="16 messages were sent, 0 read: one was lost"):
            link.per_s(64, "raw", 5.0)


@pytest.mark.slow
def test_the_bench_counts_what_a_cell_does():
    row = scale.row(1, 1, seed=2, seconds=4.0, rate_hz=2.0)
    assert (row["cameras"], row["targets"], row["replicas"]) == (1, 1, 1)
    assert 0 < row["masks_per_s"] <= row["offered_per_s"] + 1
    assert row["cpu"] == pytest.approx(sum(row["cpu_of"].values()), abs=0.01) and row["cpu"] > 0.05
    assert set(row["cpu_of"]) == {"launcher", "router", *scale.SINGLE, *scale.SHARED}
    assert row["message_bytes"]["frame"] == pytest.approx(640 * 480 * 3, rel=0.01)
    published, links = row["published_bytes_per_s"], row["link_bytes_per_s"]
    assert published["frame"] == pytest.approx(row["offered_per_s"] * row["message_bytes"]["frame"], rel=0.05)
    assert links["emulator"] > published["frame"] and links["segmentation"] > 0
    shown = markdown(scale.tables(json.loads(json.dumps({"seed": 2, "sizes": [1], "cores": 2, "rows": [row], "bus": []}))))
    assert f"| {row['offered_per_s']:.1f} | {row['masks_per_s']:.1f} |" in shown


@pytest.fixture(scope="module")
def eight(tmp_path_factory):
    path = derive("table", 8, 8, tmp_path_factory.mktemp("cells"), CAMERA_HZ)
    with penumbra_up(str(path), 3, "--replicas", "segmentation=2", "--log-level", "error") as running:
        yield cells.load(path), running


@pytest.mark.slow
def test_every_camera_is_masked_and_every_target_is_searched_felt_and_fused(eight):
    cell, running = eight
    wanted = {(topic.name, key) for topic in (topics.MASK, topics.VISION, topics.HAPTIC, topics.FUSED)
              for key in keys(topic, cell)}  # fmt: skip
    heard: set[tuple[str, str]] = set()

    def note(name: str, sample: zenoh.Sample) -> None:
        heard.add((name, str(sample.key_expr)))

    with connect(running.port) as session:
        for topic in (topics.MASK, topics.VISION, topics.HAPTIC, topics.FUSED):
            session.declare_subscriber(topic.at(cell=cell.name), partial(note, topic.name))
        wait_for(lambda: heard >= wanted, START_S, "all streams", 0.2)


def keys(topic, cell):
    kind, parts = ("camera", cell.cameras) if "{camera}" in topic.key else ("target", cell.targets)
    return [topic.at(cell=cell.name, **{kind: name}) for name in parts]


@pytest.mark.slow
def test_each_camera_s_poses_are_of_the_target_before_it_alone(eight):
    cell, running = eight
    seen: set[tuple[str, str]] = set()

    def hear(sample):
        pose = messages.decode(messages.VisionPose, sample.payload.to_bytes())
        seen.add((pose.camera, pose.target))

    with connect(running.port) as session:
        session.declare_subscriber(topics.VISION.at(cell=cell.name), hear)
        wait_for(lambda: len({camera for camera, _ in seen}) == 8, START_S, "a pose by each camera", 0.2)
    assert seen == set(zip(cell.cameras, cell.targets, strict=True))


@pytest.mark.slow
def test_the_poses_of_eight_targets_are_at_their_work_places(eight):
    cell, running = eight
    for name, target in cell.targets.items():
        answer = wait_for(partial(running.pose, name), 20, f"the pose of {name}")
        assert abs(answer["position"][0] - target.home.position[0]) < 1.0
