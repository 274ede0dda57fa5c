"""RTSP cameras, from a real server of GStreamer whose pictures show when they were made."""

from itertools import pairwise

import psutil
import pytest

from penumbra.tests.support import injected, numbered
from penumbra.tests.support.devices import CameraServer
from penumbra.tests.support.live import PATIENCE_S, free_port, stays, wait_for
from penumbra.tests.support.numbered import camera_process, viewer

pytestmark = pytest.mark.skipif(bool(numbered.lacks_gstreamer()), reason=numbered.lacks_gstreamer())

RATE_HZ = 20
ERROR_S = 0.15
"""What a stamp may be off by on a busy machine: the quickest picture of a minute takes some milliseconds to arrive."""


def errors(frames):
    """By how much stamps are after the time that the pictures show [s]; a picture shows the millisecond that it began in."""
    return [1e-9 * frame.stamp_ns - 1e-3 * frame.number for frame in frames]


def source(port, **more):
    return {"url": f"rtsp://127.0.0.1:{port}/camera", **more}


def test_stamps_of_a_stream_are_those_of_its_quickest_pictures_and_no_old_ones_come_at_first(tmp_path, router):
    port = free_port()
    path = numbered.cell(tmp_path, source(port))
    with CameraServer(port, RATE_HZ), viewer(path, router) as seen, camera_process(path, router):
        frames = seen.more(40)
        assert all(-0.002 < error < ERROR_S for error in errors(frames)), errors(frames)
        assert all(after.number > before.number for before, after in pairwise(frames))
        why = seen.waits_for_reason("times of exposure are not known: stamps are of the stream's clock")
        assert "measure the latency and write it into the cell file" in why
        assert seen.front()["stamps"] == "stream"


def test_the_latency_of_the_cell_file_is_taken_off(tmp_path, router):
    port = free_port()
    path = numbered.cell(tmp_path, source(port, latency=0.5))
    with CameraServer(port, RATE_HZ), viewer(path, router) as seen, camera_process(path, router):
        assert all(-0.502 < error < ERROR_S - 0.5 for error in errors(seen.more(20)))
        assert seen.health()["status"] == "ok"


def test_a_synchronised_camera_says_itself_when_a_picture_was_taken(tmp_path, router):
    """The server's clock is this host's. Its first report of it comes after some seconds."""
    port = free_port()
    path = numbered.cell(tmp_path, source(port, synchronised=True))
    with CameraServer(port, RATE_HZ), viewer(path, router) as seen, camera_process(path, router):
        wait_for(lambda: seen.front().get("stamps") == "sender", PATIENCE_S, "the sender's clock", 0.2)
        assert all(abs(error) < 0.02 for error in errors(seen.more(20))), "however busy this machine is"
        assert seen.health()["reasons"] == []
        assert -20.0 < seen.front()["sender_latency_ms"] < 1e3 * ERROR_S


def test_a_server_that_dies_is_a_reason_and_when_it_is_back_so_are_the_frames(tmp_path, router):
    port = free_port()
    path = numbered.cell(tmp_path, source(port, latency=0.0))
    with viewer(path, router) as seen, camera_process(path, router) as running:
        assert f"no stream at rtsp://127.0.0.1:{port}/camera: check address" in seen.waits_for_reason("(lost for")
        with CameraServer(port, RATE_HZ):
            seen.more(20)
            wait_for(lambda: seen.health()["status"] == "ok", PATIENCE_S, "all to be well", 0.1)
        assert "camera front: " in seen.waits_for_reason("(lost for")
        assert seen.health()["status"] == "degraded"
        count = len(seen.frames)
        with CameraServer(port, RATE_HZ):
            frames = seen.more(20)
            assert all(-0.002 < error < ERROR_S for error in errors(frames)), "the new stream's clock is another one"
        assert len(seen.frames) >= count + 20
        assert running.process.poll() is None


def test_a_server_that_hangs_is_missed_within_its_time_and_its_old_pictures_are_not_shown(tmp_path, router):
    port = free_port()
    path = numbered.cell(tmp_path, source(port, latency=0.0))
    with CameraServer(port, RATE_HZ) as hung, viewer(path, router) as seen, camera_process(path, router):
        seen.more(20)
        with injected.frozen(psutil.Process(hung.process.pid)):
            assert "has stopped" in seen.waits_for_reason("(lost for")
        frames = seen.more(20)
        assert all(-0.002 < error < ERROR_S for error in errors(frames))
        assert all(1e-9 * frame.arrival_ns - 1e-3 * frame.number < 1.0 for frame in frames)


def test_a_process_that_was_stopped_does_not_replay_what_it_missed(tmp_path, router):
    """OpenCV alone hands on all pictures of the pause when it is over."""
    port = free_port()
    path = numbered.cell(tmp_path, source(port, latency=0.0))
    with CameraServer(port, RATE_HZ), viewer(path, router) as seen, camera_process(path, router) as running:
        seen.more(RATE_HZ)
        with injected.frozen(psutil.Process(running.process.pid)):
            count = len(seen.frames)
            assert stays(lambda: len(seen.frames) <= count + 2, 1.5), "it stands"
        frames = seen.more(RATE_HZ)
        shown_after_s = [1e-9 * frame.arrival_ns - 1e-3 * frame.number for frame in frames]
        assert max(shown_after_s[2:]) < 0.8, "pictures of the pause are up to 1.5 s old; two may have been under way before it"
        assert all(-0.002 < error < ERROR_S for error in errors(frames))
        front = wait_for(seen.front, PATIENCE_S, "the report")
        assert front["late"] > 10 or front["opened"] > 1, "its pictures were left out; or, where it stood for 2 s, the stream"
