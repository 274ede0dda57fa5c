"""`penumbra robot`: joints by their names, stamps by the controller's clock, and what happens when a controller is lost."""

import json
import math
import subprocess
import sys
import time
from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import psutil
import pytest

from penumbra.services import flags
from penumbra.services.command import cli
from penumbra.services.robot import driver, service
from penumbra.services.robot.clock import ControllerClock
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support import injected, rtde_peer
from penumbra.tests.support.devices import ORDER, Controller, robot_cell
from penumbra.tests.support.live import penumbra_command, wait_for

WANTED = [rtde_peer.JOINTS[driver.UR_JOINTS.index(name)] for name in ORDER]


@pytest.fixture
def controller():
    pytest.importorskip("rtde_receive", reason="pip install -e '.[ur]'")
    found = Controller()
    yield found
    found.kill()


@contextmanager
def running(path, endpoint, *words):
    """The service and what it publishes: pairs of message and arrival."""
    cell = cells.load(path)
    connection = bus.Connection(connect=(endpoint,))
    node, reader = Node("robot", cell, connection), Node("reader", cell, connection)
    heard = []
    reader.subscribe(topics.JOINTS, lambda message, names: heard.append((message, time.time_ns())))
    service.start(node, flags.parse(service.FLAGS, words))
    with reader.open(5.0), node.open(5.0):
        yield node, heard


def test_joints_of_a_ur_controller_come_by_name_with_its_stamps(tmp_path, router, controller):
    with running(robot_cell(tmp_path, f"ur:{controller.address}"), router) as (node, heard):
        wait_for(lambda: len(heard) > 50, 10, "fifty messages")
        assert heard[-1][0].position.tolist() == pytest.approx(WANTED)
        stamps = [message.stamp_ns for message, _ in heard]
        assert all(a < b for a, b in pairwise(stamps))
        assert all(arrival - message.stamp_ns > -1e6 for message, arrival in heard), "no stamp is of the future"
        assert min(arrival - message.stamp_ns for message, arrival in heard) < 1e9
        controller.tell("move 0.75")
        wait_for(lambda: heard[-1][0].position[1] == pytest.approx(0.75), 5, "the angle that the base moved to")
        report = node.report()
        assert report.report["arm"]["state"] == "reading" and report.report["arm"]["stamps"] == "controller"
        assert not [reason for reason in report.reasons if "robot arm" in reason]


def test_a_controller_that_is_lost_comes_back_by_itself_and_health_says_why_it_was_away(tmp_path, router, controller):
    with running(robot_cell(tmp_path, f"ur:{controller.address}"), router) as (node, heard):
        wait_for(lambda: len(heard) > 10, 10, "joints")
        controller.tell("freeze")
        wait_for(lambda: "has sent nothing for 1 s" in str(node.report().reasons), 10, "the reason that nothing comes")
        controller.kill()
        wait_for(
            lambda: "no controller of Universal Robots at" in str(node.report().reasons), 20, "the reason that nobody is there"
        )
        assert node.report().status == "degraded"
        count = len(heard)
        controller.start()
        wait_for(lambda: len(heard) > count + 10, 20, "joints again")
        assert heard[-1][0].position.tolist() == pytest.approx(WANTED)
        wait_for(lambda: not node.report().report["arm"]["fault"], 5, "no reason any more")
        assert node.report().report["arm"]["connected"] >= 2


def test_a_process_that_stood_still_reads_on_and_does_not_take_the_pause_for_the_controller_s(tmp_path, router, controller):
    path = robot_cell(tmp_path, f"ur:{controller.address}")
    cell = cells.load(path)
    reader, heard = Node("reader", cell, bus.Connection(connect=(router,))), []
    reader.subscribe(topics.JOINTS, lambda message, names: heard.append(message))
    process = subprocess.Popen(penumbra_command("robot", "--cell", str(path), "--connect", router))
    try:
        with reader.open(5.0):
            wait_for(lambda: len(heard) > 50, 30, "joints")
            with injected.frozen(psutil.Process(process.pid)):
                time.sleep(2 * driver.SILENCE_S)
            count = len(heard)
            wait_for(lambda: len(heard) > count + 50, 10, "joints again")
            (answer,) = reader.query(topics.health(cell.name, "robot"))
    finally:
        process.terminate()
        process.wait()
    assert json.loads(answer)["report"]["arm"]["connected"] == 1


def test_names_with_a_prefix_are_matched_and_a_joint_that_the_controller_has_not_is_named(tmp_path, router, controller):
    names = tuple(f"left_{name}" for name in ORDER)
    path = robot_cell(tmp_path, f"ur:{controller.address}", names, ", prefix: left_")
    with running(path, router) as (node, heard):
        wait_for(lambda: heard, 10, "joints")
        assert heard[0][0].position.tolist() == pytest.approx(WANTED)
    path = robot_cell(tmp_path, f"ur:{controller.address}", (*ORDER, "finger_joint"))
    with running(path, router) as (node, heard):
        text = "robot arm: expected joints finger_joint, got shoulder_pan_joint, shoulder_lift_joint, "
        wait_for(lambda: text in str(node.report().reasons), 10, "the name of the joint that is missing")
        assert not heard


ADAPTER = """
class Robot:
    made = 0

    def __init__(self):
        Robot.made += 1
        self.count = 0

    def read(self):
        import time

        time.sleep(0.01)
        self.count += 1
        if self.count > 30:
            raise OSError("the cable is out")
        return {"b": 0.2, "a": 0.1}, None

    def close(self):
        pass


class NoRobot:
    def read(self):
        pass
"""


def test_an_adapter_of_ones_own_is_read_and_called_again_where_it_fails(tmp_path, router):
    (tmp_path / "my_arm.py").write_text(ADAPTER)
    with running(robot_cell(tmp_path, "adapter:my_arm:Robot", ("a", "b")), router) as (node, heard):
        wait_for(lambda: len(heard) > 20, 10, "joints")
        assert heard[0][0].position.tolist() == [0.1, 0.2]
        wait_for(lambda: "robot arm: the cable is out" in str(node.report().reasons), 10, "the adapter's own words")
        wait_for(lambda: len(heard) > 40, 20, "joints of the second connection")
        assert node.report().report["arm"]["stamps"] == "arrival"
        assert sys.modules["my_arm"].Robot.made >= 2


@pytest.mark.parametrize(
    ("body", "why"),
    [
        (
            "return [0.1, 0.2], None",
            "Odd.read: expected (joints, clock_s), a dict of angles by name and a number or None, got tuple",
        ),
        ("return {'a': 'up', 'b': 0.2}, None", "Odd.read: ValueError: could not convert string to float: 'up'"),
        ("raise RuntimeError('the SDK has ended')", "Odd.read: RuntimeError: the SDK has ended"),
        ("threading.Event().wait(60)", " s from adapter:odd_arm:Odd"),
    ],
)
def test_an_adapter_that_does_not_keep_to_the_form_is_a_reason_in_words(tmp_path, router, monkeypatch, body, why):
    monkeypatch.delitem(sys.modules, "odd_arm", raising=False)
    text = "import threading\n\n\nclass Odd:\n    def read(self):\n        {}\n\n    def close(self):\n        pass\n"
    (tmp_path / "odd_arm.py").write_text(text.format(body))
    monkeypatch.syspath_prepend(str(tmp_path))
    with running(robot_cell(tmp_path, "adapter:odd_arm:Odd", ("a", "b")), router) as (node, heard):
        wait_for(lambda: any(why in reason for reason in node.report().reasons), 10, "the reason")
        assert not heard


def test_a_franka_that_is_not_there_is_called_again_and_again(tmp_path, router):
    pytest.importorskip("panda_py", reason="pip install -e '.[panda]'")
    names = tuple(f"panda_joint{i}" for i in range(1, 8))
    with running(robot_cell(tmp_path, joints=names), router, "--source", "panda:127.9.9.9") as (node, _):
        wait_for(lambda: "no controller of Franka at 127.9.9.9" in str(node.report().reasons), 10, "the reason")


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("kuka:1.2.3.4", "robots.arm.source.url: expected ur:ADDRESS, panda:ADDRESS or adapter:MODULE:CLASS, got 'kuka:1.2.3.4'"),
        ("ur:", "expected ur:ADDRESS, panda:ADDRESS or adapter:MODULE:CLASS, got 'ur:'"),
        ("adapter:my_arm", "expected adapter:MODULE:CLASS, as in adapter:my_robot:Robot"),
        ("adapter:nowhere:Robot", "nowhere cannot be imported (ModuleNotFoundError: No module named 'nowhere')"),
        ("adapter:my_arms:Robots", "expected a class Robots in my_arms, got none; see docs/robot-joints.md"),
        ("adapter:my_arms:NoRobot", "expected the methods read and close, got none called close"),
        (None, "no robot of cell mine has one: give --source SOURCE, or `source:` of the robot in the cell file"),
    ],
)
def test_a_source_that_cannot_be_is_refused(tmp_path, capsys, source, text):
    (tmp_path / "my_arms.py").write_text(ADAPTER)
    assert cli.main(["robot", "--cell", str(robot_cell(tmp_path, source, ("a", "b")))]) == 2
    assert text in capsys.readouterr().err


def test_a_robot_is_moved_by_the_emulator_or_has_a_source(tmp_path, capsys):
    assert cli.main(["robot", "--cell", "arm", "--source", "ur:127.0.0.1"]) == 2
    assert "cell arm has `sim`: its emulator moves panda; remove `sim` from the cell file" in capsys.readouterr().err
    text = cells.source("arm").read_text().replace("    urdf: panda/", "    source: {url: 'panda:172.16.0.2'}\n    urdf: panda/")
    (tmp_path / "both.yaml").write_text(text)
    with pytest.raises(cells.CellError, match=r"robots.panda.source: expected no source beside `sim`"):
        cells.load(tmp_path / "both.yaml")


def test_joints_that_are_missing_or_impossible_are_told_apart():
    limits = {"a": (-math.inf, math.inf), "b": (-3.0, 3.0), "x_a": (-1.0, 1.0), "x_b": (-1.0, 1.0)}
    q, fault = service.matched({"b": 2.0, "a": 1.0, "c": 3.0}, ("a", "b"), "", limits)
    assert q is not None and q.tolist() == [1.0, 2.0] and not fault
    q, fault = service.matched({"a": 1.0}, ("x_a", "x_b"), "x_", limits)
    assert q is None and fault == "expected joints x_b, got x_a; correct `joints` in the cell file, or the prefix"
    for angle in (120.0, float("nan"), float("inf")):
        q, fault = service.matched({"a": angle}, ("a",), "", limits)
        assert q is None and "are these degrees?" in fault
    q, fault = service.matched({"a": 45.0, "b": -45.0}, ("a", "b"), "", limits)
    assert q is None and fault == (
        "expected joints within the limits of the URDF, got b -45 (-3 to 3): are these degrees, or millimetres?"
    )


def test_stamps_are_those_of_the_quickest_messages_and_follow_a_clock_that_drifts_or_begins_anew():
    clock, rng = ControllerClock(), np.random.default_rng(0)
    offset_ns, drift = 1_700_000_000_000_000_000, 2e-5
    late = 1e-3 + rng.exponential(5e-3, 4000)
    errors = []
    for i in range(4000):
        clock_s = 500.0 + 0.008 * i
        true_ns = offset_ns + round(1e9 * clock_s * (1.0 + drift))
        stamp = clock.stamp(clock_s, true_ns + round(1e9 * late[i]))
        errors.append((stamp - true_ns) * 1e-9)
    # at most the time of the quickest one above, and below it what the clock drifts in ten seconds
    assert max(errors[200:]) < 1.5e-3 and min(errors[200:]) > 1e-3 - 3e-4
    again = clock.stamp(3.0, offset_ns + 5)
    assert again == offset_ns + 5, "the controller was started again"
    assert clock.stamp(None, 77) == 77
