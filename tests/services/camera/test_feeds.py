"""Films, folders, devices and adapters as feeds, and the reader that drains them, without a bus."""

import subprocess
import threading
import time
from contextlib import contextmanager

import cv2
import numpy as np
import pytest

from penumbra.services.camera import adapter, files, live
from penumbra.services.camera.feed import Shot
from penumbra.services.camera.reader import Reader
from penumbra.shared.cell import description as cells
from penumbra.shared.runtime.adapter import load
from penumbra.tests.support import numbered
from penumbra.tests.support.live import wait_for

CAMERA = cells.Camera.model_validate({**numbered.FRONT, "look_at": [0.05, 0.0, 0.15]})


@pytest.fixture
def stopping():
    event = threading.Event()
    yield event
    event.set()


def numbers(feed):
    """The numbers of all pictures up to the end."""
    found = []
    with pytest.raises(EOFError, match="has ended"):
        while True:
            found.append(numbered.number(feed.read().image))
    return found


def numbers_of(feed, count):
    """The numbers of the next pictures."""
    return [numbered.number(feed.read().image) for _ in range(count)]


def film(path, stopping, is_looping=False, rate_hz=None):
    return files.Film(path, is_looping, rate_hz, CAMERA.rate_hz, stopping)


def test_every_picture_of_a_film_comes_once_and_in_order(tmp_path, stopping):
    path = numbered.film(tmp_path / "film.mp4", range(30), 200.0)
    assert numbers(film(path, stopping)) == [*range(30)]


@pytest.mark.parametrize(("rate_hz", "expected_hz"), [(None, 25.0), (80.0, 80.0)], ids=["its own rate", "a given rate"])
def test_a_film_is_played_at_its_rate(tmp_path, stopping, rate_hz, expected_hz):
    path = numbered.film(tmp_path / "film.mp4", range(20), 25.0)
    feed = film(path, stopping, rate_hz=rate_hz)
    stamps = [feed.read().stamp_ns for _ in range(20)]
    took_s = (stamps[-1] - stamps[0]) * 1e-9
    assert took_s > 0.99 * 19 / expected_hz, "a film is never faster, and on a busy machine it is slower"
    assert min(np.diff(stamps)) > 0


@pytest.mark.skipif(bool(numbered.lacks_gstreamer()), reason=numbered.lacks_gstreamer())
def test_the_time_between_two_pictures_is_that_of_the_film_where_it_has_no_even_rate(tmp_path, stopping):
    """As phones film."""
    path, times_ms = tmp_path / "uneven.mkv", np.cumsum([0, 40, 240, 40, 240, 40])
    subprocess.run([*numbered.GSTREAMER, "film", str(path), *map(str, times_ms)], check=True)
    pictures = list(film(path, stopping)._pass())
    assert [numbered.number(picture) for picture, _, _ in pictures] == [*range(6)]
    np.testing.assert_allclose([step_s for _, _, step_s in pictures][1:], 1e-3 * np.diff(times_ms), atol=1e-6)


def test_a_film_that_loops_begins_again_and_is_missed_where_it_vanishes(tmp_path, stopping):
    path = numbered.film(tmp_path / "film.mp4", range(3), 100.0)
    feed = film(path, stopping, is_looping=True)
    assert numbers_of(feed, 7) == [0, 1, 2, 0, 1, 2, 0]
    path.unlink()
    with pytest.raises(OSError, match=r"no film .*film.mp4: give the path of a file"):
        for _ in range(3):
            feed.read()


def test_what_is_no_film_is_refused_with_what_to_do(tmp_path, stopping):
    path = tmp_path / "film.mp4"
    path.write_text("no film")
    with pytest.raises(OSError, match=r"no film that FFmpeg reads; convert it"):
        film(path, stopping).read()


def test_a_film_that_is_waited_for_ends_with_the_process(tmp_path, stopping):
    feed = film(numbered.film(tmp_path / "film.mp4", range(3), 100.0), stopping, rate_hz=0.001)
    assert numbers_of(feed, 1) == [0]
    threading.Timer(0.1, stopping.set).start()
    assert feed.read() is None


def test_a_folder_is_played_in_the_order_of_its_names_and_says_which_picture_is_broken(tmp_path, stopping):
    for name, number in (("b.png", 2), ("a.PNG", 1), ("c.bmp", 3)):
        assert cv2.imwrite(str(tmp_path / name), numbered.image(number))
    (tmp_path / ".hidden.png").write_text("")
    (tmp_path / "notes.txt").write_text("")
    (tmp_path / "bb.png").write_text("broken")
    feed = files.Folder(tmp_path, False, 200.0, stopping)
    assert numbers_of(feed, 2) == [1, 2]
    with pytest.raises(ValueError, match=r"bb.png cannot be read as a picture; remove it"):
        feed.read()
    assert numbers(feed) == [3]


@pytest.mark.parametrize(
    ("name", "why"), [("none", "no folder .*none: give"), ("", "no pictures in .*: expected files that end")]
)
def test_a_folder_without_pictures_is_refused(tmp_path, stopping, name, why):
    with pytest.raises(OSError, match=why):
        files.Folder(tmp_path / name, True, 20.0, stopping).read()


# ---- devices and adapters


def test_a_device_that_is_not_there_is_named_with_those_that_are():
    with pytest.raises(OSError, match=r"no device /dev/video97: is the camera plugged in\? Video devices now: "):
        live.V4l2("/dev/video97", CAMERA)


def test_a_device_that_is_no_camera_is_refused():
    live.quiet()
    with pytest.raises(OSError, match=r"/dev/null delivers no pictures: it is in use by another process, or no camera"):
        live.V4l2("/dev/null", CAMERA)


OWN = """
import numpy as np

class Camera:
    def __init__(self, name, camera):
        self.answers = [(np.full((camera.height, camera.width, 3), 7, np.uint8), None), None, (name, 3), "nothing"]
    def read(self):
        return self.answers.pop(0)
    def close(self):
        self.answers.clear()

class Broken(Camera):
    def __init__(self, name, camera):
        self.rows = camera.high
"""


def test_an_adapter_is_found_beside_the_cell_file_and_its_faults_are_those_of_a_lost_camera(tmp_path):
    (tmp_path / "own_sdk.py").write_text(OWN)
    feed = adapter.Adapted(load("own_sdk:Camera", tmp_path, "docs/own-camera.md"), "front", CAMERA)
    first = feed.read()
    assert (
        first is not None
        and first.image.shape == (numbered.HEIGHT, numbered.WIDTH, 3)
        and first.stamp_ns is None
        and feed.stamps == "arrival"
    )
    assert feed.read() is None
    for got in ("tuple", "str"):
        with pytest.raises(OSError, match=rf"Camera.read: expected \(image, stamp_ns\), an array and an int or None, got {got}"):
            feed.read()
    with pytest.raises(OSError, match=r"Camera.read: IndexError: pop from empty list"):
        feed.read()
    with pytest.raises(OSError, match=r"Broken: AttributeError: .* no attribute 'high'"):
        adapter.Adapted(load("own_sdk:Broken", tmp_path, "docs/own-camera.md"), "front", CAMERA)


def test_an_adapter_that_is_not_there_is_refused_before_the_start(tmp_path):
    with pytest.raises(
        cells.CellError, match=r"adapter:no_such_sdk:Camera: no_such_sdk cannot be imported \(ModuleNotFoundError"
    ):
        load("no_such_sdk:Camera", tmp_path, "docs/own-camera.md")
    with pytest.raises(cells.CellError, match=r"expected a class Cam in json, got none; see docs/own-camera.md"):
        load("json:Cam", tmp_path, "docs/own-camera.md")


# ---- the reader


class Given:
    """A feed of what a test gives, and an OSError at the end."""

    stamps = "exposure"

    def __init__(self, shots):
        self._shots = iter(shots)

    def read(self):
        try:
            return next(self._shots)
        except StopIteration:
            raise OSError("unplugged") from None

    def close(self):
        raise OSError("gone already")


def reader(open_feed, stopping, source=None, **camera):
    own = CAMERA.model_copy(update=camera)
    given = cells.CameraSource.model_validate(source or {"url": "adapter:a:A", "latency": 0.0})
    lines: list[str] = []
    found = Reader("front", own, given, open_feed, True, 1.0, stopping, lines.append)
    return found, lines


def play(found, stopping):
    """Lets a reader run until it has lost its feed, and returns the newest picture."""
    thread = threading.Thread(target=found.session)
    thread.start()
    wait_for(lambda: found.describe()["state"] in ("lost", "ended"), 10.0, "the end of the feed")
    stopping.set()
    thread.join()
    return found.take(0.0)


def shot(number, age_s=0.0):
    return Shot(numbered.image(number), time.time_ns() - round(1e9 * age_s))


def aged(ages_s, period_s=0.02):
    """Pictures whose stamps are so old, one each period."""
    for k, age_s in enumerate(ages_s):
        time.sleep(period_s)  # no wait: pictures come at a rate
        yield shot(k, age_s)


def test_the_newest_picture_wins_and_a_backlog_is_left_out(stopping):
    found, _ = reader(lambda: Given(aged([0.1] * 5 + [0.6, 0.58, 0.56])), stopping)
    newest = play(found, stopping)
    assert numbered.number(newest.image) == 4
    report = found.describe()
    assert (report["late"], report["superseded"], report["received"]) == (3, 4, 8)


def test_a_picture_is_never_handed_on_before_or_with_one_that_was_taken_later(stopping):
    now = shot(1)
    found, _ = reader(lambda: Given([now, now, shot(2, 0.05)]), stopping)
    assert numbered.number(play(found, stopping).image) == 1
    assert found.describe()["late"] == 2


def test_a_clock_that_is_set_back_does_not_stop_the_pictures(stopping, monkeypatch):
    real, offset_ns = time.time_ns, 0
    monkeypatch.setattr(time, "time_ns", lambda: real() + offset_ns)

    def shots():
        nonlocal offset_ns
        yield shot(1)
        offset_ns = -3_600_000_000_000
        yield shot(2)

    found, _ = reader(lambda: Given(shots()), stopping)
    assert numbered.number(play(found, stopping).image) == 2


def test_a_picture_that_a_loop_brings_again_is_logged_once(stopping):
    def shots():
        for _ in range(3):
            yield shot(1)
            yield Shot(np.zeros((48, 64, 3), np.uint8), time.time_ns())

    found, lines = reader(lambda: Given(shots()), stopping)
    play(found, stopping)
    assert found.describe()["refused"] == 3
    assert len([line for line in lines if "got 64 x 48" in line]) == 1


def test_two_pictures_at_once_do_not_make_a_camera_too_fast(stopping):
    """A film that was held up while the process started catches up by one picture."""
    with running(aged([0.0] * 2, period_s=1e-4), stopping, "playback") as found:
        wait_for(lambda: found.describe()["received"] == 2, 10.0, "both pictures")
        assert not [why for why in found.reasons() if "pictures a second" in why]


def test_pictures_of_another_size_are_refused_and_not_scaled(stopping):
    found, lines = reader(lambda: Given([shot(1)]), stopping, width=640, height=480)
    assert play(found, stopping) is None
    (why,) = found.reasons()
    assert why.startswith("camera front: expected pictures of 640 x 480 px in three colours, got 128 x 96: intrinsics belong to")
    assert lines[0] in why


@contextmanager
def running(shots, stopping, stamps="exposure", source=None):
    """A reader of these pictures, and then of none."""

    def pictures():
        yield from shots
        stopping.wait()

    feed = Given(pictures())
    feed.stamps = stamps
    found, _ = reader(lambda: feed, stopping, source)
    thread = threading.Thread(target=found.session)
    thread.start()
    yield found
    stopping.set()
    thread.join()


@pytest.mark.parametrize("latency", [None, 0.08])
def test_stamps_without_a_latency_are_a_reason_and_with_one_are_so_much_earlier(stopping, latency):
    source = {"url": "adapter:a:A", **({} if latency is None else {"latency": latency})}
    arrivals = (picture._replace(stamp_ns=None) for picture in aged([0.0] * 3))
    with running(arrivals, stopping, "arrival", source) as found:
        newest = wait_for(lambda: found.take(0.1), 10.0, "a picture")
        assert (time.time_ns() - newest.stamp_ns) * 1e-9 >= (latency or 0.0)
        unknown = [why for why in found.reasons() if "times of exposure are not known: stamps are of the arrival" in why]
        assert bool(unknown) == (latency is None)


@pytest.mark.parametrize(
    ("age_s", "why"),
    [(1.5, "pictures are 1.5 s old when they arrive, and readers refuse them"), (-0.2, "ahead of this host's clock")],
)
def test_stamps_that_readers_refuse_are_a_reason(stopping, age_s, why):
    with running(aged([age_s] * 3), stopping) as found:
        wait_for(lambda: any(why in reason for reason in found.reasons()), 10.0, why)


def test_a_lost_camera_is_reported_opened_again_and_waited_for_longer_each_time(stopping):
    found, lines = reader(lambda: Given([]), stopping)
    delays = set()
    thread = threading.Thread(target=lambda: [found.session() for _ in range(3)])
    thread.start()
    opened = lambda: found.describe()["opened"] == 3  # noqa: E731
    wait_for(opened, 10.0, "the third attempt", act=lambda: delays.add(found._delay_s))
    stopping.set()
    thread.join()
    assert sorted(delays)[:3] == [0.2, 0.4, 0.8]
    (why,) = found.reasons()
    assert why.startswith("camera front: unplugged (lost for ")
    assert lines == ["unplugged; trying again"], "the same fault is logged once"


def test_a_reader_keeps_users_and_passwords_to_itself(stopping):
    url = "rtsp://anna:s3cr@t@192.0.2.1/stream"
    found, _ = reader(lambda: Given([]), stopping, {"url": url})
    assert "s3cr" not in f"{found.describe()} {found.reasons()}" and found.describe()["source"] == "rtsp://192.0.2.1/stream"
