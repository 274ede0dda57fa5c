"""What a reader takes from a publisher: each message once, and no flood."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from penumbra.shared.contract.messages import BadMessage
from penumbra.shared.runtime.guard import FORGET_S, NUMBERS, PUBLISHERS, RATE_TIMES, WINDOW, Bucket, Guard, SequenceWindow


def refusal(call, *arguments) -> str:
    with pytest.raises(BadMessage) as caught:
        call(*arguments)
    return caught.value.kind


@given(st.integers(0, NUMBERS - 1), st.lists(st.integers(-2 * WINDOW, 2 * WINDOW), max_size=200))
def test_no_number_is_taken_twice_and_what_is_missing_is_counted(first, steps):
    window, taken, missing, highest = SequenceWindow(first), {0}, 0, 0
    for step in steps:
        number = highest + step  # on an endless count from the first
        was_here = number in taken or number <= max(0, highest - WINDOW) or number <= 0
        if was_here:
            assert refusal(window.take, (first + number) % NUMBERS) == "replayed"
        else:
            missing += window.take((first + number) % NUMBERS)
            taken.add(number)
            highest = max(highest, number)
    assert missing == highest + 1 - len(taken)


def test_numbers_come_around_after_the_last_one():
    window = SequenceWindow(NUMBERS - 2)
    assert [window.take(number) for number in (NUMBERS - 1, 1, 0)] == [0, 1, -1]
    assert refusal(window.take, NUMBERS - 1) == "replayed"


def test_a_jump_of_half_the_count_is_taken_for_an_old_number():
    assert refusal(SequenceWindow(7).take, (7 + NUMBERS // 2) % NUMBERS) == "replayed"


@given(st.floats(1.0, 1000.0), st.lists(st.floats(0.0, 0.1), min_size=1, max_size=300))
def test_a_bucket_lets_its_rate_through_and_a_second_s_worth_at_once(rate_hz, gaps):
    bucket, times = Bucket(rate_hz, 0.0), np.cumsum(gaps)
    taken = [now for now in times if bucket.take(now)]
    assert len(taken) <= rate_hz * (1.0 + times[-1]) * (1 + 1e-9) + 1e-6
    if len(gaps) <= rate_hz:
        assert len(taken) == len(gaps)


def test_a_steady_publisher_at_its_rate_loses_nothing_and_a_flood_only_what_is_too_much():
    guard, refused = Guard(50.0), []
    for k in range(20_000):  # 20 s at a thousand a second beside 20 s at fifty
        if k % 20 == 0:
            guard.admit("steady", k // 20, k * 1e-3)
            guard.accept("steady", k, k * 1e-3)
        try:
            guard.admit("flood", k, k * 1e-3)
            guard.accept("flood", -k - 1, k * 1e-3)
        except BadMessage as error:
            refused.append(error.kind)
    assert set(refused) == {"rate"}
    assert 20_000 - len(refused) == pytest.approx(RATE_TIMES * 50.0 * 21.0, abs=1.5)


def test_what_a_rate_refuses_is_not_counted_as_missing():
    guard, missing = Guard(1.0), 0
    for k in range(100):
        try:
            missing += guard.admit("flood", k, k * 0.1) or 0
        except BadMessage as error:
            assert error.kind == "rate"
    assert missing == 0


def test_without_numbers_only_newer_stamps_are_taken_until_the_publisher_was_silent():
    guard = Guard(50.0)

    def take(stamp_ns, now_s):
        assert guard.admit("", None, now_s) is None
        guard.accept("", stamp_ns, now_s)

    take(100, 0.0)
    assert refusal(take, 100, 0.1) == "replayed"
    assert refusal(take, 99, 0.2) == "replayed"
    take(101, 0.3)
    for k in range(9):  # its clock was set back: what is refused does not keep it known
        assert refusal(take, 50, 0.5 + 0.6 * k) == "replayed"
    take(50, 0.31 + FORGET_S)


def test_with_numbers_an_older_stamp_is_taken():
    guard = Guard(50.0)
    for number, stamp_ns in enumerate((100, 90, 110)):
        guard.admit("two cameras", number, 0.1 * number)
        guard.accept("two cameras", stamp_ns, 0.1 * number)


def test_a_measurement_that_another_publisher_has_published_is_not_accepted_again():
    guard = Guard(50.0)
    for number, (stamp_ns, camera) in enumerate(((100, "front"), (100, "side"), (200, "front"))):
        guard.admit("search", number, 0.0)
        guard.accept("search", stamp_ns, 0.0, camera)
    guard.admit("its replica", 0, 0.1)
    assert refusal(guard.accept, "its replica", 100, 0.1, "side") == "repeated"
    guard.accept("its replica", 300, 0.1, "front")


def test_publishers_without_end_do_not_fill_the_memory_and_do_not_drive_out_the_known():
    guard = Guard(50.0)
    for k in range(PUBLISHERS):
        guard.admit(f"known {k}", 0, 0.0)
        guard.accept(f"known {k}", k, 0.0)
    for k in range(1000):
        assert refusal(guard.admit, f"new {k}", 0, 1.0) == "publishers"
    assert guard.admit("known 3", 1, 1.0) == 0
    guard.accept("known 3", PUBLISHERS, 1.0)
    assert guard.admit("new", 0, 0.1 + FORGET_S) == 0
    assert refusal(guard.admit, "known 3", 1, 0.1 + FORGET_S) == "replayed"
