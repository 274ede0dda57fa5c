"""Every example runs as a user would run it, against real services."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.sim.world.world import Sensors, World
from penumbra.tests.support import numbered
from penumbra.tests.support.live import PATIENCE_S, free_port, penumbra_up, wait_for
from penumbra.tests.support.small import small

EXAMPLES = Path(__file__).parents[2] / "examples"


class Example:
    """A running example. lines: what it has printed."""

    def __init__(self, process: subprocess.Popen):
        assert process.stdout is not None and process.stderr is not None
        self.process, self.errors, printed = process, process.stderr, process.stdout
        self.lines: list[str] = []
        threading.Thread(target=lambda: self.lines.extend(printed), daemon=True).start()  # until it ends

    def printed(self, text: str) -> str:
        """The first line with this text that is printed from now on."""
        seen = len(self.lines)
        return wait_for(lambda: next((line for line in self.lines[seen:] if text in line), None), 60, f"{text!r} printed")


@contextmanager
def example(name: str, endpoint: str, *arguments: str) -> Iterator[Example]:
    """Runs an example beside a cell, and ends it as by Ctrl-C, without a traceback."""
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    environment = {**os.environ, "PENUMBRA_CONNECT": endpoint}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        running = Example(process)
        yield running
        assert process.poll() is None, running.errors.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0, running.errors.read()
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short_says_how_to_run_it_and_is_run_here(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 45
    assert f"python examples/{path.name}" in text.split('"""')[1]
    assert f'"{path.name}"' in Path(__file__).read_text()


def test_read_poses_prints_the_state_and_the_position(router):
    with small("table", router) as chain, chain.fusion(), example("read_poses.py", router) as running:
        running.printed("lost")
        chain.seen.set()
        line = running.printed("tracking")
        assert "z   15." in line or "z   14." in line, line
        assert "vision 100%" in line


def test_stop_when_lost_goes_and_stops_with_the_pose(router):
    with small("table", router) as chain, contextlib.ExitStack() as stack:
        stack.enter_context(chain.fusion())
        chain.seen.set()
        running = stack.enter_context(example("stop_when_lost.py", router))
        running.printed("go")
        chain.seen.clear()
        running.printed("stop: the target is lost")
        chain.seen.set()
        running.printed("go")


def test_stop_when_lost_stops_when_fusion_ends(router):
    with small("table", router) as chain, contextlib.ExitStack() as stack:
        with chain.fusion():
            chain.seen.set()
            running = stack.enter_context(example("stop_when_lost.py", router))
            running.printed("go")
        running.printed("stop: no pose for 0.1 s")
        with chain.fusion():
            running.printed("go")


def test_own_joints_publishes_the_joints_of_the_robot(router):
    with small("arm", router) as chain, chain.fusion(), chain.node("reader") as reader:
        found = []
        reader.subscribe(topics.JOINTS, lambda message, _: found.append(message.position))
        with example("own_joints.py", router):
            wait_for(lambda: len(found) > 20, 60, "joint angles")
        assert found[0].shape == (len(chain.cell.robots["panda"].joints),)
        (report,) = reader.report().topics.values()
        assert not report.bad


@pytest.fixture(scope="module")
def own_cell():
    """The table cell without its emulator: nothing is measured but what the test publishes."""
    with penumbra_up("table", 5, "--replicas", "emulator=0") as running:
        yield running


def endpoint(running) -> str:
    return f"tcp/127.0.0.1:{running.port}"


def arrived(running, service: str, key: str) -> bool:
    """Whether a service has received messages on a key, and refused none but such as a busy machine has delayed."""
    report = running.health().get(service, {}).get("topics", {}).get(key)
    return bool(report) and report["count"] > 0 and report["bad"].keys() <= {"past"}


def film(path: Path) -> messages.Truth:
    """A film of the resting arm, as the cell's camera sees it; where the arm is."""
    cell = cells.load("table")
    sensors = Sensors(World(cell, 5), time.time_ns())
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 20, (640, 480))
    stream = sensors.frame("front", 0)
    image = next(message.image for _, _, message in stream if isinstance(message, messages.Frame))
    for _ in range(40):
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    return next(message for _, _, message in sensors.tick(1) if isinstance(message, messages.Truth))


def is_seen_near(running, position: np.ndarray) -> bool:
    """Whether the camera has measured the target within 5 cm of a position. The first measurements are of a search under way."""
    pose = running.pose()
    return pose is not None and "vision" in pose["sources"] and bool(np.linalg.norm(pose["position"] - position) < 0.05)


@pytest.mark.slow
def test_own_camera_leads_to_an_own_pose(own_cell, tmp_path):
    truth = film(tmp_path / "film.avi")
    with example("own_camera.py", endpoint(own_cell), str(tmp_path / "film.avi")):
        # a busy machine loses the pose now and then; the last position stays
        wait_for(lambda: is_seen_near(own_cell, truth.position), 300, "a pose near the truth", 0.2)
    assert arrived(own_cell, "segmentation", topics.FRAME.at(cell="table", camera="front"))


@pytest.mark.slow
def test_own_skin_reaches_the_haptics(own_cell):
    with example("own_skin.py", endpoint(own_cell)) as running:
        running.printed("pads: p0, p1")
        for pad in ("p0", "p7"):
            key = topics.VOLTAGES.at(cell="table", pad=pad)
            wait_for(partial(arrived, own_cell, "haptics", key), 120, f"voltages of {pad}", 0.2)


@pytest.mark.parametrize("words", ["read_poses.py", "own_joints.py", "own_skin.py", "own_camera.py 0"])
def test_an_example_without_a_router_is_one_line_that_says_what_to_start(words):
    name, *arguments = words.split()
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    environment = {**os.environ, "PENUMBRA_CONNECT": f"tcp/127.0.0.1:{free_port()}"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode in (1, 2)
    assert "start `penumbra router` or `penumbra up`" in done.stderr and "Traceback" not in done.stderr


def test_own_camera_says_what_it_expected_where_there_is_no_camera(router, tmp_path):
    with small("table", router) as chain, chain.fusion():
        command = [sys.executable, str(EXAMPLES / "own_camera.py"), str(tmp_path / "nothing.mp4")]
        environment = {**os.environ, "PENUMBRA_CONNECT": router}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "expected images from" in done.stderr and "Traceback" not in done.stderr


def test_an_example_says_what_the_cell_does_not_have_and_which_images_it_expects(router, tmp_path):
    path = tmp_path / "small.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 20, (64, 48))
    writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    with small("table", router) as chain, chain.fusion():
        for words, told in (
            (["own_joints.py"], "expected a cell with a robot, got table, which has none"),
            (["own_camera.py", str(path), "--camera", "back"], "no camera 'back'; cell table has: front"),
            (["own_camera.py", str(path)], "camera front: expected"),
        ):
            command = [sys.executable, str(EXAMPLES / words[0]), *words[1:]]
            environment = {**os.environ, "PENUMBRA_CONNECT": router}
            done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)
            assert done.returncode == 2 and told in done.stderr and "Traceback" not in done.stderr, done.stderr


def test_the_adapter_of_an_sdk_publishes_what_its_camera_takes(router, tmp_path):
    """Pylon emulates a camera, whose pictures are a moving ramp of grey."""
    pytest.importorskip("pypylon")
    script = EXAMPLES / "pylon_camera.py"
    emulated = {**os.environ, "PYLON_CAMEMU": "1"}
    alone = subprocess.run([sys.executable, str(script)], env=emulated, capture_output=True, text=True, timeout=PATIENCE_S)
    assert alone.stdout == "a picture of 640 x 480 px\n", alone.stderr
    path = numbered.cell(tmp_path, {"url": f"adapter:{script.stem}:Basler"})
    (tmp_path / script.name).write_text(script.read_text())
    with numbered.viewer(path, router) as seen, numbered.camera_process(path, router, env=emulated):
        stamps = [frame.stamp_ns for frame in seen.more(20)]
        assert 0.6 < (stamps[-1] - stamps[0]) * 1e-9 < PATIENCE_S
        assert seen.front()["stamps"] == "arrival"
        assert "times of exposure are not known: stamps are of the arrival" in seen.waits_for_reason("measure the latency")
