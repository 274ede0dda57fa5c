"""Where a robot's joints were at a moment, from the messages around it."""

import numpy as np
import pytest

from penumbra.shared.perception.joint_history import JointHistory, RobotJoints

MS = 1_000_000


def history(is_carried_on: bool = False) -> JointHistory:
    """Joint angles of 0, 1 and 2 rad at 0, 5 and 10 ms."""
    made = JointHistory(tolerance_ns=200 * MS, is_carried_on=is_carried_on)
    for stamp_ns, angle in ((0, 0.0), (5 * MS, 1.0), (10 * MS, 2.0)):
        made.add(stamp_ns, np.array([angle]))
    return made


def test_joints_are_interpolated_at_the_stamp_and_never_invented():
    assert JointHistory(200 * MS).at(0) is None
    assert history().at(7_500_000) == pytest.approx(1.5)
    assert history().at(12 * MS) == pytest.approx(2.0), "held after the newest"
    assert history().at(-3 * MS) == pytest.approx(0.0), "held before the oldest"
    assert history().at(210 * MS) == pytest.approx(2.0) and history().at(211 * MS) is None
    assert history().at(-200 * MS) == pytest.approx(0.0) and history().at(-201 * MS) is None


def test_after_the_newest_message_the_last_velocity_goes_on_where_that_is_asked_for():
    assert history(is_carried_on=True).at(12 * MS) == pytest.approx(2.4)
    assert history(is_carried_on=True).at(-3 * MS) == pytest.approx(0.0), "held before the oldest"
    single = JointHistory(200 * MS, is_carried_on=True)
    single.add(0, np.array([1.0]))
    assert single.at(5 * MS) == pytest.approx(1.0)


def test_far_from_both_neighbours_nothing_is_known():
    gap = history()
    gap.add(1_000 * MS, np.array([3.0]))
    assert gap.at(500 * MS) is None
    assert gap.at(901 * MS) == pytest.approx(2.9)


def test_late_messages_are_left_out_and_a_clock_that_was_set_back_begins_anew():
    late = history()
    late.add(2 * MS, np.array([9.0]))
    assert late.at(2_500_000) == pytest.approx(0.5)
    hour_ns = 3_600_000 * MS
    late.add(-hour_ns, np.array([5.0]))
    assert late.at(-hour_ns) == pytest.approx(5.0)
    assert late.at(10 * MS) is None


def test_of_several_robots_those_are_known_that_sent_joints_near_the_stamp():
    joints = RobotJoints({"left": 2, "right": 1}, 200 * MS, is_carried_on=True)
    assert joints.at(0) == {}
    joints.add("left", 0, np.array([0.0, 1.0]))
    joints.add("left", 10 * MS, np.array([0.1, 1.0]))
    assert joints.at(20 * MS).keys() == {"left"} and joints.at(20 * MS)["left"] == pytest.approx([0.2, 1.0])
    with pytest.raises(ValueError, match="robot right: expected 1 joint angles, got shape"):
        joints.add("right", 0, np.zeros(2))
    with pytest.raises(ValueError, match="expected a robot of left, right, got 'middle'"):
        joints.add("middle", 0, np.zeros(1))
