"""`penumbra camera` as a process on the bus: what it publishes, what it says of its cameras, and which publisher wins."""

import itertools
import subprocess
from types import SimpleNamespace

import cv2
import numpy as np
import psutil
import pytest
from prometheus_client.core import Metric

from penumbra.services.camera import service
from penumbra.services.command import cli
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, report, topics
from penumbra.shared.runtime import bus, metrics
from penumbra.shared.runtime.node import Node
from penumbra.tests.support import injected, numbered
from penumbra.tests.support.live import PATIENCE_S, free_port, penumbra_command, penumbra_up, stays, wait_for
from penumbra.tests.support.numbered import camera_process, viewer


def test_a_film_that_the_cell_file_names_is_on_the_bus_at_its_rate_and_says_how_its_stamps_are_known(tmp_path, router):
    numbered.film(tmp_path / "film.mp4", range(40), 25.0)
    path = numbered.cell(tmp_path, {"url": "file:film.mp4", "loop": True})
    with viewer(path, router) as seen, camera_process(path, router):
        frames = seen.more(60)
        steps = np.diff([frame.number for frame in frames]) % 40
        assert set(steps) <= {1, 2, 3} and np.median(steps) == 1, "from its end to its beginning; a reader may miss one"
        assert np.mean(np.diff([frame.stamp_ns for frame in frames])) > 0.99 * 40e6
        front = seen.front()
        assert (front["state"], front["stamps"], front["source"]) == ("streaming", "playback", "file:film.mp4")
        assert seen.health()["status"] == "ok"


def test_a_film_that_ends_is_said_to_and_the_process_stays(tmp_path, router):
    film = numbered.film(tmp_path / "film.mp4", range(10), 20.0)
    path = numbered.cell(tmp_path)
    with viewer(path, router) as seen, camera_process(path, router, "--source", f"file:{film}", "--rate", "100"):
        seen.waits_for("ended")
        assert "film.mp4 has ended; start it again, with --loop" in seen.waits_for_reason("camera front")
        assert seen.front()["opened"] == 1


def test_a_film_that_vanishes_is_missed_and_played_again_when_it_is_back(tmp_path, router):
    numbered.film(tmp_path / "film.mp4", range(10), 20.0)
    path = numbered.cell(tmp_path, {"url": "file:film.mp4", "loop": True})
    with viewer(path, router) as seen, camera_process(path, router) as running:
        seen.more(5)
        (tmp_path / "film.mp4").rename(tmp_path / "away.mp4")
        assert "no film" in seen.waits_for_reason("(lost for")
        (tmp_path / "away.mp4").rename(tmp_path / "film.mp4")
        seen.waits_for("streaming")
        seen.more(5)
        assert seen.front()["opened"] > 1
        wait_for(lambda: seen.health()["status"] == "ok", PATIENCE_S, "all to be well", 0.1)
        assert len([line for line in running.lines if "no film" in line]) == 1, "logged once"


def test_a_stopped_process_goes_on_with_its_film_and_with_true_stamps(tmp_path, router):
    numbered.film(tmp_path / "film.mp4", range(200), 20.0)
    path = numbered.cell(tmp_path, {"url": "file:film.mp4", "loop": True})
    with viewer(path, router) as seen, camera_process(path, router) as running:
        seen.more(5)
        with injected.frozen(psutil.Process(running.process.pid)):
            count = len(seen.frames)
            assert stays(lambda: len(seen.frames) <= count + 2, 1.5), "it stands"
            last = seen.frames[-1].number
        after = seen.more(10)
        numbers = [frame.number - last for frame in after]
        assert numbers[0] < 10 and numbers == sorted(numbers), "30 pictures would have been shown in the pause"
        assert all((frame.arrival_ns - frame.stamp_ns) * 1e-9 < 1.0 for frame in after[2:]), "and none has a stamp of before it"


def test_pictures_of_another_size_are_refused_with_what_to_do(tmp_path, router):
    numbered.film(tmp_path / "film.mp4", range(10), 20.0, (256, 192))
    path = numbered.cell(tmp_path, {"url": "file:film.mp4", "loop": True})
    with viewer(path, router) as seen, camera_process(path, router):
        assert "expected pictures of 128 x 96 px in three colours, got 256 x 192" in seen.waits_for_reason("intrinsics")
        assert not seen.frames and seen.health()["status"] == "degraded"


def test_a_folder_is_played_at_the_given_rate(tmp_path, router):
    (tmp_path / "pictures").mkdir()
    for number in np.random.default_rng(1).permutation(range(10, 20)):
        assert cv2.imwrite(str(tmp_path / "pictures" / f"{number}.png"), numbered.image(number))
    path = numbered.cell(tmp_path, {"url": "folder:pictures", "loop": True, "rate_hz": 40})
    with viewer(path, router) as seen, camera_process(path, router):
        frames = seen.more(30)
        steps = np.diff([frame.number for frame in frames]) % 10
        assert set(steps) <= {1, 2, 3} and np.median(steps) == 1, "in the order of names, again and again; a reader may miss one"
        assert np.median(np.diff([frame.stamp_ns for frame in frames])) > 0.9 * 25e6


def test_a_missing_device_is_a_reason_at_once_and_the_process_waits_for_it(tmp_path, router):
    path = numbered.cell(tmp_path)
    with viewer(path, router) as seen, camera_process(path, router, "--source", "v4l2:/dev/video97"):
        assert "no device /dev/video97: is the camera plugged in?" in seen.waits_for_reason("no device")
        assert seen.front()["opened"] == 0


def test_a_missing_film_of_the_cell_file_is_named_before_there_is_a_router(tmp_path):
    path = numbered.cell(tmp_path, {"url": "file:nope.mp4"})
    command = penumbra_command("camera", "--cell", str(path), "--connect", f"tcp/127.0.0.1:{free_port()}")
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as popen:
        assert popen.stderr is not None
        said = list(itertools.takewhile(lambda line: "waiting for the router" not in line, popen.stderr))
        popen.terminate()
        popen.communicate(timeout=PATIENCE_S)
    assert any("nothing is there yet" in line and "source=file:nope.mp4" in line for line in said), said


# ---- who publishes a camera


def test_the_emulator_leaves_out_a_camera_with_a_source_and_publishes_the_truth(tmp_path, router):
    text = cells.source("table").read_text()
    path = tmp_path / "table.yaml"
    look = "    look_at: [0.05, 0.0, 0.15]\n"
    path.write_text(text.replace(look, f"{look}    source: {{url: 'file:film.mp4'}}\n"))
    command = penumbra_command("emulator", "--cell", str(path), "--connect", router)
    node = Node("viewer", cells.load(path), bus.Connection(connect=(router,)))
    counts = {"frames": 0, "truths": 0}
    node.subscribe(topics.FRAME, lambda message, names: counts.update(frames=counts["frames"] + 1))
    node.subscribe(topics.TRUTH, lambda message, names: counts.update(truths=counts["truths"] + 1))
    emulator = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        with node:
            wait_for(lambda: counts["truths"] > 100, PATIENCE_S, "two seconds of truth")
    finally:
        emulator.terminate()
        _, errors = emulator.communicate(timeout=PATIENCE_S)
    assert counts["frames"] == 0
    assert "left to `penumbra camera`: the cell file gives it a source camera=front" in errors


def test_a_camera_without_a_source_in_the_cell_file_is_left_to_a_living_emulator(tmp_path, router):
    text = cells.source("table").read_text()
    path = tmp_path / "table.yaml"
    path.write_text(text)
    film = numbered.film(tmp_path / "film.mp4", range(20), 20.0, (640, 480))
    cell = cells.load(path)
    node = Node("viewer", cell, bus.Connection(connect=(router,)))
    seen = numbered.Viewer(node)
    with node, camera_process(path, router, "--source", f"file:{film}", "--loop"):
        seen.waits_for("streaming")
        wait_for(lambda: seen.frames, PATIENCE_S, "frames while no emulator lives")
        with Node("emulator", cell, bus.Connection(connect=(router,))):
            why = seen.waits_for_reason("the emulator publishes it: write its source into the cell file, or start the cell with")
            assert "camera front: not published" in why
            count = len(seen.frames)
            assert stays(lambda: len(seen.frames) <= count + 1, 1.0), "one was under way"
        seen.more(5)


def test_up_plays_the_film_of_a_cell_file_and_masks_follow(tmp_path):
    """What a user does first: the whole chain on a film, with nothing but a cell file. A killed process comes back."""
    numbered.film(tmp_path / "film.mp4", range(20), 20.0)
    path = numbered.cell(tmp_path, {"url": "file:film.mp4", "loop": True})
    stamps: dict[str, set[int]] = {"frame": set(), "mask": set()}

    def listen(topic, kind):
        return lambda sample: stamps[topic].add(messages.decode(kind, sample.payload.to_bytes()).stamp_ns)

    with penumbra_up(str(path), 1, "--replicas", "fusion=1", "--replicas", "search=0") as running:
        readers = [
            running.session.declare_subscriber(topic.at(cell="numbered"), listen(topic.name, topic.message))
            for topic in (topics.FRAME, topics.MASK)
        ]
        wait_for(lambda: len(stamps["mask"]) > 10, 180, "masks of the film", 0.1)
        assert "emulator" not in running.processes()
        camera = running.processes()["camera"]
        camera.kill()
        is_another = lambda: (now := running.processes().get("camera")) is not None and now.pid != camera.pid  # noqa: E731
        wait_for(is_another, 60, "another camera process", 0.1)
        count = len(stamps["mask"])
        wait_for(lambda: len(stamps["mask"]) > count + 10, 60, "masks of its frames", 0.1)
        for reader in readers:
            reader.undeclare()
    assert len(stamps["mask"] & stamps["frame"]) > 10, "a mask has the stamp of its frame"


# ---- what is asked of it


def options(**given):
    return SimpleNamespace(**{"source": None, "camera": None, "loop": False, "rate": None, "latency": None, **given})


def test_flags_change_the_sources_of_the_cell_file(tmp_path):
    cell = cells.load(numbered.cell(tmp_path, {"url": "file:film.mp4", "rate_hz": 5}))
    assert service.sources(cell, options())["front"] is cell.sources["front"]
    (changed,) = service.sources(cell, options(loop=True, rate=2.0)).values()
    assert (changed.url, changed.loop, changed.rate_hz) == ("file:film.mp4", True, 2.0)
    (given,) = service.sources(cell, options(source="rtsp://192.0.2.1/a", camera="front", latency=0.1)).values()
    assert (given.kind, given.place, given.latency) == ("rtsp", "//192.0.2.1/a", 0.1)


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"camera": "side"}, "cell numbered has no camera 'side': it has front"),
        ({}, "no camera of cell numbered has a source: give --source SOURCE, or `source:` of the camera in the cell file"),
        ({"camera": "front"}, "camera front of cell numbered has no source: give --source"),
        ({"source": "webcam"}, r"--source: expected v4l2:/dev/video0, rtsp://HOST/PATH, .*, got 'webcam'"),
        (
            {"source": "file:nope.mp4"},
            "--source: expected a film or a folder of pictures, got nothing at .*/nope.mp4; correct it",
        ),
        ({"source": "v4l2:/dev/video0", "loop": True}, "--loop: expected it with file: or folder: only, got it with v4l2:"),
        ({"source": "v4l2:/dev/video0", "rate": 3.0}, "--rate: expected it with file: or folder: only"),
        ({"source": "v4l2:/dev/video0", "latency": -1.0}, "--latency: expected a number of at least 0, got -1"),
    ],
)
def test_a_source_that_cannot_be_is_refused_with_what_to_do(tmp_path, given, why):
    with pytest.raises(cells.CellError, match=why):
        service.sources(cells.load(numbered.cell(tmp_path)), options(**given))


def test_the_command_says_that_no_camera_has_a_source(tmp_path, capsys):
    assert cli.main(["camera", "--cell", str(numbered.cell(tmp_path))]) == 2
    assert "no camera of cell numbered has a source: give --source" in capsys.readouterr().err


def test_the_state_of_a_camera_is_a_metric():
    front = {"state": "lost", "opened": 3, "late": 2}
    found = report.Report("camera", "a", "degraded", report={"front": front})
    families: dict[str, Metric] = {family.name: family for family in metrics.metrics([found])}
    states = {s.labels["state"]: s.value for s in families["penumbra_camera_state"].samples if s.labels["camera"] == "front"}
    assert states == {"opening": 0.0, "streaming": 0.0, "lost": 1.0, "ended": 0.0}
    assert families["penumbra_camera_opened"].samples[0].value == 3.0
