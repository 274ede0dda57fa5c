"""The chain as a user meets it: real processes, a real router, one pose that anyone can query."""

import json
import os
import signal
import subprocess
import time

import cv2
import numpy as np
import pytest
import zenoh

from penumbra.shared.contract import messages, topics
from penumbra.tests.support.live import connect, penumbra_command, wait_for


def penumbra(running, *arguments: str) -> subprocess.CompletedProcess:
    command = penumbra_command(*arguments, "--connect", f"tcp/127.0.0.1:{running.port}")
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


def test_the_query_answers_in_json_with_every_key_and_unit_vectors(running):
    pose = running.pose()
    assert pose.keys() == {
        "target", "frame", "stamp_ns", "position", "orientation", "rpy", "velocity", "covariance", "state", "sources"
    }  # fmt: skip
    assert np.linalg.norm(pose["orientation"]) == pytest.approx(1.0, abs=1e-6)
    covariance = np.array(pose["covariance"])
    assert covariance.shape == (6, 6) and (np.linalg.eigvalsh(covariance) > 0).all()
    assert {"vision", "haptic"} == pose["sources"].keys()
    assert sum(source["weight"] for source in pose["sources"].values()) == pytest.approx(1.0, abs=1e-3)
    assert time.time_ns() - pose["stamp_ns"] < 1e9


def test_the_query_without_a_format_answers_in_message_pack(running):
    reply = next(iter(running.session.get(topics.current_pose("table", "forearm"), timeout=2.0)))
    pose = messages.decode(messages.FusedPose, reply.ok.payload.to_bytes())
    assert np.linalg.norm(pose.position - running.pose()["position"]) < 0.05


def test_any_zenoh_client_receives_fused_poses_at_a_hundred_hertz_or_more(running):
    with connect(running.port) as session:
        heard = []
        session.declare_subscriber(topics.FUSED.at(cell="table"), lambda sample: heard.append(time.monotonic()))
        wait_for(lambda: len(heard) >= 300, 3.0, "300 fused poses within 3 s")


def test_the_pose_is_near_the_truth(running):
    errors = []
    with connect(running.port) as session:
        truths = session.declare_subscriber(topics.TRUTH.at(cell="table"))
        fused = session.declare_subscriber(topics.FUSED.at(cell="table"))
        truth = messages.decode(messages.Truth, truths.recv().payload.to_bytes())  # nothing moves
        for _ in range(200):
            pose = messages.decode(messages.FusedPose, fused.recv().payload.to_bytes())
            errors.append(np.linalg.norm(pose.position - truth.position))
    assert np.median(errors) < 0.03


def test_penumbra_pose_prints_the_answer_and_its_json(running):
    def prints_a_tracked_pose() -> bool:
        result = penumbra(running, "pose")
        assert result.returncode == 0, result
        return "tracking" in result.stdout

    wait_for(prints_a_tracked_pose, 20, "a tracked pose, printed")  # a busy machine coasts now and then
    assert json.loads(penumbra(running, "pose", "--json").stdout)["target"] == "forearm"


def test_penumbra_topics_reports_what_arrives(running):
    result = penumbra(running, "topics", "--hz")
    assert result.returncode == 0
    for key in ("camera/front/frame", "camera/front/mask", "pose/vision", "pose/haptic", "pose/fused"):
        assert key in result.stdout


def test_a_snapshot_shows_the_camera_s_picture_with_the_arm_outlined(running, tmp_path):
    def shows_the_outline_of_a_tracked_pose() -> bool:
        result = penumbra(running, "snapshot", str(tmp_path / "out.png"))
        assert result.returncode == 0, result.stderr
        picture = cv2.imread(str(tmp_path / "out.png"))
        assert picture is not None and picture.shape == (480, 640, 3)
        green = (picture[..., 1] > 200) & (picture[..., 0] < 120) & (picture[..., 2] < 120)
        return bool(green.sum() > 100)

    wait_for(shows_the_outline_of_a_tracked_pose, 30, "a green outline")


def pids(running, service: str) -> set[int]:
    return {process.pid for name, process in running.processes().items() if name.partition("-")[0] == service}


@pytest.mark.parametrize("service", ["fusion", "search"])
def test_a_service_that_dies_is_started_again_and_the_pose_comes_back(running, service):
    before = pids(running, service)
    for pid in before:
        os.kill(pid, signal.SIGKILL)
    wait_for(lambda: len(pids(running, service) - before) == len(before), 10, f"{service} started again")
    killed_ns = time.time_ns()
    wait_for(lambda: running.is_tracking(killed_ns), 30, f"the pose after {service} died")


@pytest.mark.slow
def test_a_rolling_restart_of_all_that_estimates_never_loses_the_pose(running):
    """All but the emulator, which stands for the sensors and holds the arm still for the other tests."""
    services = ("segmentation", "search", "haptics", "fusion")
    before = {service: pids(running, service) for service in services}
    with connect(running.port) as session:
        fused, states = session.declare_subscriber(topics.FUSED.at(cell="table"), zenoh.handlers.FifoChannel(100_000)), []
        where = ("--connect", f"tcp/127.0.0.1:{running.port}")
        result = subprocess.run(penumbra_command("restart", *services, *where), capture_output=True, text=True)
        while (sample := fused.try_recv()) is not None:
            states.append(messages.decode(messages.FusedPose, sample.payload.to_bytes()).state)
    assert result.returncode == 0, result.stdout + result.stderr
    for service, old in before.items():
        now = pids(running, service)
        assert len(now) == len(old) and not now & old, service
    assert states and "lost" not in states


@pytest.mark.parametrize(("flag", "word"), [("--camera", "camera"), ("--target", "target")])
def test_a_service_asked_for_what_the_cell_has_not_says_what_it_has(running, flag, word):
    result = penumbra(running, "search", flag, "left")
    assert result.returncode == 2
    assert f"no {word} 'left': it has" in result.stderr and len(result.stderr.splitlines()) == 1
