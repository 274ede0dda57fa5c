"""The emulator as a process: what control queries say, how turns keep time, and what really arrives on the bus."""

import json
import math
import os
import subprocess
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from penumbra.services.emulator import service
from penumbra.services.emulator.control import COMMANDS, control
from penumbra.services.emulator.pacing import Pacer, Time
from penumbra.services.skin.driver import Line
from penumbra.services.skin.port import SerialPort
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.sim.world.world import World
from penumbra.tests.support.live import PATIENCE_S, free_port, penumbra_command, wait_for

ROOT = Path(__file__).parents[3]


@pytest.fixture
def world():
    return World(cells.load("table"), 1)


def ask(world, command, value=None, time_s=1.0):
    return control(world, json.dumps({"command": command} | ({} if value is None else {"value": value})).encode(), time_s)


def test_every_command_answers_with_what_is_in_force(world):
    assert ask(world, "state") | {"scene_s": 0} == {
        "occlusion": "auto", "occlusion_now": 0.0, "motion": "on", "paused": False, "speed": 1.0, "scene_s": 0, "stopped": {},
        "skin": {}, "seed": 1,
    }  # fmt: skip
    assert ask(world, "occlude", "0.8")["occlusion"] == 0.8
    assert ask(world, "occlude", 0)["occlusion"] == 0.0
    assert ask(world, "occlude", "auto")["occlusion"] == "auto"
    assert ask(world, "motion", "off")["motion"] == "off"
    assert ask(world, "motion", "on")["motion"] == "on"
    assert ask(world, "pause")["paused"] is True
    assert ask(world, "resume")["paused"] is False
    assert ask(world, "speed", "2.5")["speed"] == 2.5
    assert world.clock.rate(5.0) == 2.5
    assert ask(world, "skin", "p0/r hum 0.02")["skin"] == {"p0/r": "hum 0.02"}
    assert ask(world, "skin", "all none")["skin"] == {}


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (b"", r'expected \{"command": NAME, "value": VALUE\}, got \'\''),
        (b"\xff\xfe", "expected .*, got .*. Commands:"),
        (b"[]", "NAME"),
        (b"nan", "NAME"),
        (b'{"command": 3}', "NAME"),
        (b'{"command": "state", "colour": "red"}', "colour"),
        (b'{"command": "fly"}', "got 'fly'. Commands:\n  occlude"),
        (b'{"command": "occlude"}', "occlude: expected a share .*from 0 to 1, or auto, got nothing"),
        (b'{"command": "occlude", "value": "most"}', "occlude: expected .* or auto, got 'most'"),
        (b'{"command": "occlude", "value": 1.5}', "occlude: expected a share from 0 to 1 or auto, got 1.5"),
        (b'{"command": "occlude", "value": NaN}', "occlude: expected a share from 0 to 1 or auto, got nan"),
        (b'{"command": "occlude", "value": true}', "or auto, got True"),
        (b'{"command": "motion"}', "motion: expected on or off.*, got nothing"),
        (b'{"command": "skin"}', "skin: expected .*, got nothing"),
        (b'{"command": "motion", "value": "fast"}', "motion: expected on or off.*, got 'fast'"),
        (b'{"command": "motion", "value": [1]}', "motion: expected on or off"),
        (b'{"command": "speed", "value": -1}', "speed: expected a factor above 0 and at most 4, got -1"),
        (b'{"command": "board", "value": "p0-0 error"}', "no boards are served: start the emulator with --serial"),
        (b'{"command": "pause", "value": 3}', "pause: expected no value, got 3"),
        (b'{"command": "skin", "value": 3}', r"skin: expected PAD\[/ELECTRODE\] FAULT .*, got 3"),
        (b'{"command": "skin", "value": "p0/r torn"}', "got 'p0/r torn'. Faults: dead: a broken wire"),
    ],
)
def test_a_bad_command_is_refused_with_what_is_possible_and_changes_nothing(world, payload, text):
    before = ask(world, "state")
    with pytest.raises(ValueError, match=text):
        control(world, payload, 1.0)
    assert ask(world, "state") == before


def test_the_list_of_commands_is_complete(world):
    with pytest.raises(ValueError) as error:
        ask(world, "help")
    assert all(f"  {name} " in str(error.value) for name in COMMANDS)


def test_a_pacer_gives_every_tick_once_while_turns_are_in_time():
    now = 1000
    pacer = Pacer(epoch_ns=1000, period_ns=10.0, now_ns=lambda: now, late_ns=0.0)
    for expected in range(1, 6):
        assert pacer.next() == expected
        now += 6  # prepared
        assert pacer.ready() == pytest.approx((1000 + 10 * expected - now) * 1e-9)
        now = 1000 + 10 * expected + 2  # sent, a little late
    assert pacer.dropped == 0


def test_the_world_goes_on_where_the_wall_clock_is_set_and_only_its_stamps_jump():
    shift_ns = 10**18
    wall_ns = lambda: time.monotonic_ns() + shift_ns  # noqa: E731
    world_time = Time(wall_ns)
    began_ns = world_time.epoch_ns()
    assert 0 <= world_time.now_ns() < 10**10
    assert began_ns == world_time.epoch_ns()
    for step_ns in (-3_600 * 10**9, 7_200 * 10**9):
        shift_ns += step_ns
        before_ns = world_time.now_ns()
        assert world_time.epoch_ns() - began_ns == pytest.approx(step_ns, abs=10**7)
        assert 0 <= world_time.now_ns() - before_ns < 10**10
        began_ns += step_ns


def test_a_pacer_drops_what_is_overdue_and_keeps_the_rhythm():
    now = 1000
    pacer = Pacer(epoch_ns=1000, period_ns=10.0, now_ns=lambda: now, late_ns=5.0)
    assert pacer.next() == 1
    assert pacer.ready() == pytest.approx(10e-9)
    now = 1047  # something held the process up: ticks 2, 3 and 4 are overdue, 4 by 7
    assert pacer.next() == 5 and pacer.dropped == 3
    assert pacer.next() == 6 and pacer.ready() == pytest.approx(13e-9)


def test_a_stream_that_takes_longer_than_its_period_becomes_thinner_and_not_later():
    now = 0
    pacer = Pacer(epoch_ns=0, period_ns=50.0, now_ns=lambda: now, late_ns=5.0)
    late, ticks = [], []
    for _ in range(40):
        ticks.append(pacer.next())
        now += 70
        wait = pacer.ready() * 1e9
        now += round(wait)
        late.append(now - 50 * ticks[-1])
    assert max(late[10:]) <= 5 and ticks[-1] <= 2 * 40  # every second frame, each in time


@pytest.fixture(scope="module")
def ports(tmp_path_factory):
    """Where the emulator makes links to the boards of p7."""
    return tmp_path_factory.mktemp("ports")


@pytest.fixture(scope="module")
def emulator(ports):
    """A router in this process, a real emulator beside it, and a node that hears it: (node, what it heard)."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = bus.open_session(bus.Connection("router", (), (endpoint,)), threading.Event(), lambda: None, 5.0)
    command = penumbra_command("emulator", "--cell", "arm", "--seed", "2", "--connect", endpoint)
    command += ["--serial", "p7", "--serial-folder", str(ports)]
    process = subprocess.Popen(command, cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": "1"})
    node = Node("listener", cells.load("arm"), bus.Connection("client", (endpoint,)))
    heard: dict[tuple[str, ...], list[tuple[int, Any]]] = {}

    def hear(topic, message, names):
        stream = (topic.name, *(value for name, value in names.items() if name != "publisher"))
        heard.setdefault(stream, []).append((node.now_ns(), message))

    for topic in (topics.FRAME, topics.JOINTS, topics.VOLTAGES, topics.TRUTH):
        node.subscribe(topic, partial(hear, topic))
    try:
        with node:
            yield node, heard
    finally:
        process.terminate()
        code = process.wait(PATIENCE_S)
        router.close()
    assert code == 0 and not list(ports.iterdir())


def test_the_emulator_publishes_every_stream_of_the_cell_on_its_beat_and_in_time(emulator):
    _, heard = emulator
    streams = {("frame", "side"), ("joints", "panda"), ("truth", "forearm"), *(("voltages", f"p{i}") for i in range(7))}
    wait_for(lambda: set(heard) == streams, 60.0, "all streams")  # the first run compiles
    heard.clear()

    def smallest_age_ms(stream):
        return min(((received - m.stamp_ns) / 1e6 for received, m in list(heard.get(stream, ()))), default=math.inf)

    def is_in_time(stream):
        return smallest_age_ms(stream) < 15.0

    for stream in streams:
        # A reading is sent at its instant: rendering alone takes longer than this. A machine that does other things as well
        # reaches it at times.
        wait_for(partial(is_in_time, stream), 30.0, f"{stream} within 15 ms of its stamp")
    wait_for(lambda: len(heard[("frame", "side")]) >= 5, 30.0, "5 frames")
    for stream in streams:
        stamps = np.array([m.stamp_ns for _, m in heard[stream]])
        periods = np.diff(stamps) / (50e6 if stream[0] == "frame" else 5e6)
        np.testing.assert_allclose(periods, np.maximum(np.round(periods), 1), atol=1e-6)  # some may be left out, none is between
        assert smallest_age_ms(stream) > 0.0  # and none comes before its time


def test_a_second_emulator_of_a_cell_is_refused_and_one_that_leaves_is_waited_for(router):
    cell, connection = cells.load("table"), bus.Connection(connect=(router,))
    first, second = Node("emulator", cell, connection), Node("emulator", cell, connection)
    with first:
        with pytest.raises(bus.BusError, match=r"cell table at .* has an emulator already, and two would contradict each other"):
            service.refuse_second(second)
        leaving = threading.Timer(0.3, first.close)
        leaving.start()
        service.refuse_second(second)
        leaving.join()


def test_the_emulator_obeys_control_queries_and_refuses_others(emulator):
    node, heard = emulator
    wait_for(lambda: len(heard.get(("truth", "forearm"), ())) > 0, 60.0, "the truth")
    key = topics.control("arm")

    def ask(command, value=None):
        return json.loads(node.query(key, payload=json.dumps({"command": command, "value": value}).encode())[0])

    assert ask("occlude", 1)["occlusion"] == 1.0
    wait_for(lambda: heard[("truth", "forearm")][-1][1].hidden == 1.0, 5.0, "the arm to be hidden")
    assert ask("pause")["paused"] is True
    wait_for(lambda: not heard[("truth", "forearm")][-1][1].velocity.any(), 5.0, "stillness")
    with pytest.raises(bus.Refused, match=r"got 'dance'. Commands:"):
        ask("dance")
    with pytest.raises(bus.Refused, match=r"one of p7-0, p7-1, p7-2 and one of error, .*, got 'p6-0 error'"):
        ask("board", "p6-0 error")
    assert ask("resume")["paused"] is False
    wait_for(lambda: heard[("truth", "forearm")][-1][1].velocity.any(), 5.0, "motion")


def test_the_boards_of_a_pad_on_serial_ports_feel_what_the_world_and_its_faults_make_of_it(emulator, ports):
    node, heard = emulator
    wait_for(lambda: len(heard.get(("truth", "forearm"), ())) > 0, 60.0, "the truth")

    def ask(command, value=None):
        return json.loads(node.query(topics.control("arm"), payload=json.dumps({"command": command, "value": value}).encode())[0])

    scene_s = ask("pause")["scene_s"]
    ask("skin", "p7/l saturated")
    cell = cells.load("arm")
    world = World(cell, 2)
    assert world.skin is not None
    skin = world.skin.skin
    own = skin.of(skin.pads.index("p7"))
    expected = skin.amplitude(world.change(world.state(scene_s)))[own]
    line = Line(SerialPort(str(ports / "p7-0")), range(6))
    line.tune()

    def amplitudes():
        line.recover()
        line.ask()
        found = line.answer()
        return None if found is None else list(np.abs(found[1]) * skin.lsb[own][0])

    c, r = expected[:2]
    found = wait_for(amplitudes, 10.0, "a reply")
    sigma = np.sqrt(skin.noise[own][0] * 100 / 128)
    np.testing.assert_allclose(found, [c, c, c, r, r, r], rtol=3e-3, atol=5.0 * sigma)
    assert ask("board", "p7-0 error")["paused"] is True
    wait_for(lambda: amplitudes() is None and line.count.faults["overrun"], 10.0, "the fault")
    line.port.close()
    line = Line(SerialPort(str(ports / "p7-1")), range(6))
    line.tune()
    assert wait_for(amplitudes, 10.0, "a reply")[0] > 0.8 * skin.full_scale[own][2]  # l: cut off by the converter, where noisy
    line.port.close()
    ask("skin", "p7 none")
    ask("resume")
