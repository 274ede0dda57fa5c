"""A clock that differs from all others is noticed within two looks, and one wrong publisher, or a message on its way, is not."""

import math

from penumbra.shared.runtime.replicas import CLOCK_MESSAGES, CLOCK_SILENT_S, Clock
from penumbra.shared.runtime.traffic import Traffic

LOOK_S = 0.2


class Looks:
    """A clock's verdicts on messages of two keys that arrive between looks."""

    def __init__(self):
        self.clock, self.now_s = Clock(), 100.0
        self.keys = [Traffic(math.inf), Traffic(math.inf)]

    def after(self, good=0, past=0, future=0):
        first, second = self.keys
        first.count += good
        second.bad["past"] = second.bad.get("past", 0) + past
        second.bad["future"] = second.bad.get("future", 0) + future
        self.now_s += LOOK_S
        return bool(self.clock.judge(self.keys, self.now_s))


def test_a_clock_that_is_set_is_noticed_at_the_second_look_and_trusted_again_with_the_first_good_message():
    looks = Looks()
    assert [looks.after(good=40) for _ in range(3)] == [False] * 3
    assert not looks.after(good=20, past=20)
    assert looks.after(past=40)
    assert looks.after() and looks.after(past=1)
    assert not looks.after(good=1, past=10)
    assert looks.after(future=CLOCK_MESSAGES)


def test_slow_messages_add_up_until_they_tell():
    looks = Looks()
    looks.after(good=4)
    assert [looks.after(past=4) for _ in range(3)] == [False, False, True]


def test_one_publisher_with_another_clock_is_no_fault_of_this_one():
    looks = Looks()
    assert not any(looks.after(good=1, past=40) for _ in range(20))


def test_nothing_is_known_of_the_clock_where_nothing_arrives():
    looks = Looks()
    looks.after(good=40)
    assert looks.after(past=40)
    silent = [looks.after() for _ in range(round(2 * CLOCK_SILENT_S / LOOK_S))]
    assert silent[0] and not silent[-1]
    assert not looks.after(past=CLOCK_MESSAGES - 1)
