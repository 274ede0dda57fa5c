"""What was recorded, played again: on a real bus, and through the methods in one process."""

import functools
import itertools
import json
import re
import subprocess
import threading
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from penumbra.services.command import cli
from penumbra.services.replay import in_process, live, tracks
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.recording.reading import Played, Recording
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support import numbered
from penumbra.tests.support.live import PATIENCE_S, penumbra_command, wait_for
from penumbra.tests.support.nodes import node_command, pose
from penumbra.tests.support.recorded import on_the_bus, recorded, taken

TABLE = cells.load("table")
POSES = 40


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Half a second of sensors, with a fused pose every 10 ms that moves along x."""
    fused = [
        taken(TABLE, topics.FUSED, {"target": "forearm"}, pose(10**18 + i * 10_000_000, x=0.001 * i), i) for i in range(POSES)
    ]
    said = sorted([*on_the_bus(TABLE, 4, 0.5), *fused], key=lambda each: each.received_ns)
    return recorded(tmp_path_factory.mktemp("recording") / "run.mcap", "table", said)


class Listener:
    """A service's node on the bus that reads what comes, with all its guards."""

    def __init__(self, router: str, *wanted: topics.Topic):
        self.node = Node("listener", TABLE, bus.Connection(connect=(router,)))
        self.heard: list[tuple[topics.Topic, messages.Message]] = []
        for topic in wanted:
            self.node.subscribe(topic, functools.partial(self._hear, topic))

    def _hear(self, topic: topics.Topic, message: messages.Message, names: dict[str, str]) -> None:
        self.heard.append((topic, message))

    def of(self, topic: topics.Topic) -> list[Any]:
        return [message for each, message in self.heard if each is topic]

    def refused(self):
        return {key: found.bad for key, found in self.node.report().topics.items() if found.bad}


def replay(path, router, *arguments):
    command = penumbra_command("replay", str(path), "--connect", router, "--json", *arguments)
    return subprocess.run(command, capture_output=True, text=True, timeout=2 * PATIENCE_S)


# ---- on the bus


def test_a_replay_moves_the_fused_pose_on_the_bus_with_stamps_of_now(router, path):
    listener = Listener(router, topics.FUSED, topics.FRAME, topics.VOLTAGES)
    with listener.node.open():
        done = replay(path, router)
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        wait_for(lambda: len(listener.of(topics.FUSED)) >= POSES - 4, 10, "the poses")
    assert found["topics"]["fused"] == POSES and found["topics"]["frame"] == 11 and found["topics"]["truth"] == 25
    heard = listener.of(topics.FUSED)
    assert [each.position[0] for each in heard] == sorted(each.position[0] for each in heard)
    assert heard[-1].position[0] == pytest.approx(0.001 * (POSES - 1))
    assert listener.of(topics.FRAME) and listener.of(topics.VOLTAGES)
    assert not listener.refused(), "readers take what is replayed as they take what is live"


def test_with_sensors_nothing_but_what_sensors_say_is_played(router, path):
    done = replay(path, router, "--sensors")
    assert set(json.loads(done.stdout)["topics"]) == {"frame", "voltages"}, done.stderr


def test_a_part_of_it_is_played_from_a_time_on(router, path):
    done = replay(path, router, "--topics", "fused", "--from", "0.2")
    assert json.loads(done.stdout)["topics"] == {"fused": POSES - 20}, done.stderr


def test_in_a_loop_it_begins_again(router, path):
    listener = Listener(router, topics.FUSED)
    command = penumbra_command("replay", str(path), "--connect", router, "--loop", "--topics", "fused")
    with listener.node.open():
        popen = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            wait_for(
                lambda: _falls([each.position[0] for each in listener.of(topics.FUSED)]), 30, "a pose from the beginning again"
            )
        finally:
            popen.terminate()
            popen.communicate(timeout=PATIENCE_S)
    assert not listener.refused()


def _falls(values):
    return sum(after < before for before, after in itertools.pairwise(values)) >= 2


def test_while_a_process_publishes_a_topic_itself_it_is_not_replayed(router, path):
    with bus.open_session(bus.Connection(connect=(router,)), threading.Event(), lambda: None, 10.0) as session:
        fusion = subprocess.Popen(node_command("fusion", router))
        try:
            wait_for(lambda: list(session.liveliness().get(topics.alive("table", "fusion"))), 30, "fusion")
            done = replay(path, router)
            assert done.returncode == 2
            assert "cell table has a process fusion, which publishes fused itself" in done.stderr
            assert replay(path, router, "--sensors").returncode == 0
        finally:
            fusion.terminate()
            fusion.wait(PATIENCE_S)


def test_stamps_move_and_the_time_between_samples_shrinks_with_the_rate():
    haptic = messages.HapticPose(
        stamp_ns=1000, sample_stamp_ns=900, target="forearm", frame="world", position=np.zeros(3),
        orientation=np.array([0.0, 0, 0, 1]), information=np.eye(6), gap=0.1, state="in_range",
    )  # fmt: skip
    moved: Any = live.moved(haptic, lambda old_ns: 5000 + old_ns // 2, 2.0)
    assert (moved.stamp_ns, moved.sample_stamp_ns) == (5500, 5450)
    assert messages.encode(msgspec.structs.replace(moved, stamp_ns=1000, sample_stamp_ns=900)) == messages.encode(haptic)
    volts = messages.Voltages(stamp_ns=10, period_ns=1_000_000, volts=np.zeros((2, 5), np.float32))
    faster: Any = live.moved(volts, lambda old_ns: old_ns, 2.0)
    assert faster.period_ns == 500_000


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--rate", "0"], "--rate: expected more than 0 and at most 2.5"),
        (["--rate", "3"], "above which readers refuse messages"),
        (["--sensors", "--topics", "fused"], "expected --sensors or --topics, got both"),
        (["--out", "x.mcap"], "expected --in-process or --smooth beside --out"),
        (["--from", "-1"], "expected seconds from the beginning"),
        (["--smooth", "--from", "1000"], "--from 1000: the recording is 0.5 s long"),
        (["--in-process", "--sensors"], "expected --in-process and --smooth without --sensors, --topics, --loop and --rate"),
        (["--in-process", "--rate", "2"], "--in-process always takes only what the sensors said"),
        (["--fusion", "--observer paper"], "expected --in-process beside --fusion, got --fusion alone"),
        (["--in-process", "--fusion", "'"], "--fusion: No closing quotation"),
        (["--in-process", "--cell", "arm"], "run.mcap: expected a recording of cell arm, got one of cell table"),
    ],
)
def test_what_cannot_be_played_is_refused(words, text, path, capsys):
    assert cli.main(["replay", str(path), *words]) == 2
    assert text in capsys.readouterr().err


def test_a_flag_that_a_method_does_not_have_is_refused_with_where_its_flags_are_listed(path, capsys):
    assert cli.main(["replay", str(path), "--in-process", "--fusion", "--bogus"]) == 2
    assert capsys.readouterr().err == "penumbra replay: --fusion: no option --bogus (see penumbra fusion --help)\n"


def test_files_of_two_cells_are_not_played_as_one(path, tmp_path, capsys):
    other = recorded(tmp_path / "arm.mcap", "arm", [])
    assert cli.main(["replay", str(path), str(other), "--smooth"]) == 2
    assert "arm.mcap: expected a recording of cell table, got one of cell arm" in capsys.readouterr().err


def test_what_is_no_recording_is_refused(tmp_path, capsys):
    (tmp_path / "run.mcap").write_bytes(b"nonsense")
    assert cli.main(["replay", str(tmp_path / "run.mcap"), "--in-process"]) == 2
    assert "expected an MCAP file of `penumbra record`" in capsys.readouterr().err


def test_on_a_secured_bus_only_sensors_are_played(path, tmp_path, capsys):
    assert cli.main(["replay", str(path), "--secure", str(tmp_path)]) == 2
    assert "nobody may publish for all others: give --sensors" in capsys.readouterr().err


# ---- in one process


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """Three seconds of sensors that arrive late and not in the order of their stamps, as they do live."""
    rng = np.random.default_rng(1)
    said = [
        replace(each, received_ns=each.stamp_ns + int(rng.uniform(1e6, 8e6)) + 20_000_000 * (each.topic is topics.FRAME))
        for each in on_the_bus(TABLE, 5, 3.0)
    ]
    return recorded(tmp_path_factory.mktemp("recording") / "long.mcap", "table", sorted(said, key=lambda each: each.received_ns))


def test_in_process_every_run_gives_the_same_poses_to_the_bit(long, tmp_path):
    out = tmp_path / "now.mcap"
    found = [json.loads(_in_process(long, *words)) for words in ((), ("--smooth", "--out", str(out)))]
    smoothed = found[1]["poses"].pop("smoothed forearm")
    assert found[0]["poses"] == found[1]["poses"]
    assert smoothed["messages"] > 400 and smoothed["from_truth_mm"]["median"] < 40.0
    assert sum(1 for _ in Recording(out).messages([topics.SMOOTHED])) == smoothed["messages"]
    poses = found[0]["poses"]
    assert poses["fused forearm"]["messages"] > 500 and poses["vision forearm"]["messages"] > 30
    assert poses["fused forearm"]["states"]["tracking"] > 0.3
    assert poses["fused forearm"]["from_truth_mm"]["median"] < 40.0
    again = json.loads(_in_process(out))["poses"]
    assert {name: track["messages"] for name, track in again.items()} == {name: t["messages"] for name, t in poses.items()}
    fused = [each.message for each in Recording(out).messages([topics.FUSED])]
    digest = tracks.Track()
    for message in fused:
        digest.add(message)
    assert digest.described()["sha256"] == poses["fused forearm"]["sha256"], "the new recording has these very poses"


def test_a_cell_without_a_skin_is_played_through_the_services_that_it_has(tmp_path):
    cell = cells.load(numbered.cell(tmp_path))
    frames = [messages.Frame(stamp_ns=10**18 + k * 50_000_000, image=numbered.image(k)) for k in range(5)]
    key = topics.FRAME.at(cell=cell.name, camera="front")
    played = [Played(frame.stamp_ns, topics.FRAME, key, {"camera": "front"}, "", frame) for frame in frames]
    found = in_process.play(cell, played, {})["poses"]
    assert found["fused forearm"]["states"].keys() == {"lost"} and "haptic forearm" not in found


def _in_process(path, *words):
    """In processes of their own: what one run leaves in memory must not matter to the next."""
    command = penumbra_command("replay", str(path), "--in-process", "--json", *words)
    done = subprocess.run(command, capture_output=True, text=True, timeout=10 * PATIENCE_S)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_in_process_a_service_s_log_has_time_level_and_service_and_can_be_json(tmp_path):
    """A pad that falls silent in the middle is left out."""
    silent_ns = 10**18 + 10**9
    said = [
        each
        for each in on_the_bus(TABLE, 5, 3.0, frames=False)
        if each.topic is not topics.VOLTAGES or each.names["pad"] != "p0" or each.stamp_ns < silent_ns
    ]
    path = recorded(tmp_path / "silent.mcap", "table", said)
    command = penumbra_command("replay", str(path), "--in-process")
    text = subprocess.run(command, capture_output=True, text=True, timeout=10 * PATIENCE_S, check=True).stderr
    assert re.search(r"^\S+Z warning haptics: left out what=p0 why=silent$", text, re.MULTILINE), text
    command = penumbra_command("replay", str(path), "--in-process", "--log-format", "json")
    lines = subprocess.run(command, capture_output=True, text=True, timeout=10 * PATIENCE_S, check=True).stderr.splitlines()
    assert {"what": "p0", "why": "silent"} in [json.loads(line)["fields"] for line in lines]


def test_how_far_tracks_are_apart_counts_poses_of_the_same_moment_that_are_not_lost():
    ours, theirs = tracks.Track(), tracks.Track()
    for i in range(10):
        ours.add(pose(10**18 + i * 10_000_000, x=0.001 * i))
        lost = msgspec.structs.replace(
            pose(10**18 + i * 10_000_000 + 1000, x=0.001 * i + 0.002), state="lost" if i > 7 else "tracking"
        )
        theirs.add(lost)
    assert ours.apart_mm(theirs) == {"median": 2.0, "largest": 2.0}
    late = tracks.Track()
    late.add(pose(10**18 + 10**9))
    assert ours.apart_mm(late) is None and tracks.Track().apart_mm(ours) is None
