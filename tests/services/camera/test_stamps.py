"""When a picture was exposed: by a driver's clock, by a stream's, and what is old without any."""

import numpy as np
import pytest

from penumbra.services.camera.stamps import CALM_S, SETTLES_S, WINDOW_S, Backlog, StreamClock, of_driver
from penumbra.shared.runtime.lowest import Lowest

EPOCH_NS = 1_800_000_000_000_000_000
UP_NS = 86_400_000_000_000


@pytest.mark.parametrize("age_ns", [-5_000_000, 0, 33_000_000, 1_900_000_000])
@pytest.mark.parametrize("now_ns", [UP_NS, EPOCH_NS], ids=["monotonic", "time of day"])
def test_a_drivers_stamp_by_either_clock_of_this_host_becomes_the_same_time(now_ns, age_ns):
    assert of_driver(now_ns - age_ns, UP_NS, EPOCH_NS) == EPOCH_NS - age_ns


@pytest.mark.parametrize("stamp_ns", [0, 1, UP_NS + 20_000_000, UP_NS - 6_000_000_000, 2 * EPOCH_NS])
def test_a_drivers_stamp_by_no_clock_of_this_host_is_not_believed(stamp_ns):
    """A driver without stamps gives zeros; one with a clock of its own, anything."""
    assert of_driver(stamp_ns, UP_NS, EPOCH_NS) is None


def test_the_lowest_is_that_of_the_last_minute():
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.0, 2.0, 400))
    values = rng.normal(size=400)
    lowest = Lowest(WINDOW_S)
    for k, now_s in enumerate(times):
        expected = min(values[: k + 1][now_s - times[: k + 1] <= WINDOW_S])
        assert lowest.add(float(values[k]), float(now_s)) == expected


def stream(delays_s, period_s=0.05, drift=0.0, origin_s=0.0):
    """Stamps, arrivals [ns] and a steady clock [s] of pictures that arrive late; drift: of the stream's clock against ours."""
    for k, delay_s in enumerate(delays_s):
        sent_s = k * period_s
        yield round(1e9 * (origin_s + sent_s * (1.0 + drift))), EPOCH_NS + round(1e9 * (sent_s + delay_s)), sent_s + delay_s


def test_a_stream_is_stamped_by_its_quickest_pictures():
    """The network delays a picture by 10 ms, and up to 200 ms more; its stamp is off by the 10 ms, which nothing measures."""
    rng = np.random.default_rng(2)
    clock = StreamClock()
    delays_s = 0.01 + rng.exponential(0.03, 2000).clip(0.0, 0.2)
    errors = [
        (clock.stamp(own_ns, arrival_ns, now_s) - (EPOCH_NS + own_ns)) * 1e-9 for own_ns, arrival_ns, now_s in stream(delays_s)
    ]
    assert np.all(np.array(errors) >= 0.01 - 1e-6)
    assert max(errors[200:]) < 0.0115, (
        "after ten seconds: the quickest of 200 pictures is a hundredth of the mean above the least"
    )


def test_a_stream_whose_clock_drifts_is_followed():
    clock = StreamClock()
    errors = []
    for own_ns, arrival_ns, now_s in stream(np.full(20 * 600, 0.01), drift=-2e-4):
        errors.append((clock.stamp(own_ns, arrival_ns, now_s) - arrival_ns) * 1e-9)
    assert min(errors) > -2e-4 * (WINDOW_S + 1.0), "off by what the clock drifts in the window, of 0.12 s in all"


def test_the_burst_at_the_beginning_of_a_stream_is_waited_for():
    """As GStreamer's server sends: what it had kept for a second, at once."""
    clock = StreamClock()
    burst = [max(0.0, 1.0 - 0.05 * k) + 0.001 for k in range(40)]
    settled = []
    for own_ns, arrival_ns, now_s in stream(burst):
        clock.stamp(own_ns, arrival_ns, now_s)
        settled.append(clock.is_settled(now_s))
    first = settled.index(True)
    assert burst[first] == 0.001 and first > 20 + CALM_S / 0.05 - 1


def test_a_stream_that_never_calms_is_used_all_the_same():
    clock = StreamClock()
    for k in range(200):
        clock.stamp(k * 50_000_000, EPOCH_NS + round(1e9 * k * 0.03), k * 0.03)  # ever quicker
        if clock.is_settled(k * 0.03):
            break
    assert SETTLES_S < k * 0.03 < SETTLES_S + 0.1


def test_a_stream_whose_clock_begins_anew_is_stamped_anew():
    clock = StreamClock()
    for own_ns, arrival_ns, now_s in stream([0.01] * 100, origin_s=50.0):
        clock.stamp(own_ns, arrival_ns, now_s)
    later_ns = EPOCH_NS + 10_000_000_000
    assert clock.stamp(0, later_ns, 10.0) == later_ns


def test_a_clock_of_this_host_that_is_set_moves_stamps_with_it_at_once():
    clock = StreamClock()
    for k, (own_ns, arrival_ns, now_s) in enumerate(stream([0.01] * 100)):
        step_ns = 0 if k < 50 else -3_600_000_000_000 if k < 75 else 3_600_000_000_000
        assert abs(clock.stamp(own_ns, arrival_ns + step_ns, now_s) - arrival_ns - step_ns) < 1000


def drained(backlog, pictures):
    """The numbers of the pictures (asked for and come [s]) that are not old."""
    return [k for k, (asked_s, came_s) in enumerate(pictures) if not backlog.is_old(asked_s, came_s)]


def test_pictures_that_waited_through_a_pause_are_left_out():
    """Twenty a second; after two pauses of a second each, before and within a read, four pictures of the driver's queue come
    at once, and the fifth is waited for."""
    steady = [(0.05 * k, 0.05 * k + 0.049) for k in range(10)]
    before = [(1.5 + 0.001 * k, 1.501 + 0.001 * k) for k in range(4)] + [(1.504, 1.55)]
    within = [(1.55, 2.6)] + [(2.6 + 0.001 * k, 2.601 + 0.001 * k) for k in range(3)] + [(2.604, 2.65), (2.65, 2.70)]
    assert drained(Backlog(0.05), steady + before + within) == [*range(1, 10), 14, 19, 20]


def test_a_camera_that_always_has_a_picture_ready_is_not_drained_for_ever():
    ready = [(0.02 * k, 0.02 * k + 0.0001) for k in range(100)]
    assert drained(Backlog(0.02), ready) == [*range(50, 100)]


@pytest.mark.parametrize("expected_s", [0.5, 0.05], ids=["as expected", "slower than expected, as in the dark"])
def test_a_slow_camera_has_no_backlog(expected_s):
    slow = [(0.5 * k, 0.5 * k + 0.49) for k in range(100)]
    found = drained(Backlog(expected_s), slow)
    assert len(found) > 90 and found[-80:] == [*range(20, 100)]
