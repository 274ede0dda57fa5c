"""The launcher with real processes, some of them misbehaving."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from rich.console import Console
from rich.text import Text

from penumbra.services import flags as command_line
from penumbra.services.launcher import display, launch, supervised
from penumbra.services.launcher import up as up_command
from penumbra.services.launcher.fleet import Fleet, Kind
from penumbra.services.launcher.supervised import Supervised
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import Truth
from penumbra.shared.contract.processes import PROCESSES
from penumbra.shared.contract.report import Report, TopicReport
from penumbra.shared.perception.accuracy import accuracy
from penumbra.shared.runtime import bus, logs
from penumbra.shared.runtime.node import Node
from penumbra.tests.support.live import PATIENCE_S, connect, free_port, penumbra_command, service_of, stays, wait_for
from penumbra.tests.support.nodes import node_command, pose

CELL = cells.load("table")
ROOT = Path(__file__).parents[3]
ALWAYS_CRASHES = "import sys; sys.exit('out of luck')"
REFUSES = "import sys; print('cell table has no camera: it has front', file=sys.stderr); sys.exit(2)"
SLEEPS = "import time; print('up', flush=True); time.sleep(600)"
IGNORES_SIGTERM = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(600)"
LOGS_AND_SLEEPS = (
    "import time; from penumbra.shared.runtime import logs; logs.configure('info', '{form}'); "
    "logs.get('sleeper').info('on the bus'); time.sleep(600)"
)
HAS_A_CHILD = (
    "import subprocess, sys, time; subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)']); time.sleep(600)"
)


def python(name, code, restart="always"):
    return Supervised(name, [sys.executable, "-c", code], restart)


@pytest.fixture
def supervise():
    """Starts processes, watches them while a condition is waited for, and stops them."""
    started = []

    def make(*processes):
        for process in processes:
            process.start()
            started.append(process)

        def until(condition, seconds, what):
            def step():
                for process in processes:
                    process.watch()
                return condition()

            return wait_for(step, seconds, what)

        return until

    yield make
    supervised.stop(started)


@pytest.mark.parametrize("form", ["text", "json"])
def test_a_killed_process_is_started_again_and_the_reason_reported_and_logged(supervise, form, capsys):
    logs.configure()
    lines: list[str] = []
    process = Supervised("sleeper", [sys.executable, "-c", LOGS_AND_SLEEPS.format(form=form)], write=lines.append)
    until = supervise(process)
    until(lambda: lines, PATIENCE_S, "its line")
    first = process.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    until(lambda: process.pid not in (None, first), 2, "another process")
    assert process.restarts == 1
    assert process.note == "killed by SIGKILL", "and not what it said when all was well"
    assert 'launcher: a process ended process=sleeper why="killed by SIGKILL"' in capsys.readouterr().err


def test_a_crash_loop_is_reported_slows_down_and_leaves_the_others_alone(supervise):
    crashing, steady = python("crashing", ALWAYS_CRASHES), python("steady", SLEEPS)
    until = supervise(crashing, steady)
    pid = steady.pid
    started = time.monotonic()
    until(lambda: crashing.note.startswith("crash loop: exit code 1: out of luck"), 10, "the report of a crash loop")
    until(lambda: crashing.restarts == 4, 10, "the fourth restart")
    assert time.monotonic() - started > 0.2 + 0.4 + 0.8 + 1.6, "the pause doubles"
    assert (steady.pid, steady.restarts) == (pid, 0)


def test_a_process_that_was_asked_for_nothing_it_has_fails_with_its_last_output_and_stays_down(supervise):
    process = python("wrong", REFUSES)
    until = supervise(process)
    until(lambda: process.state == "failed", 3, "failure")
    assert process.note == "exit code 2: cell table has no camera: it has front"

    def stays_down():
        process.watch()
        return not process.restarts

    assert stays(stays_down, 0.5)


def test_a_process_that_hangs_is_killed_and_started_again(supervise, monkeypatch):
    monkeypatch.setattr(supervised, "SILENT_S", 0.3)
    process = python("hanging", SLEEPS)
    until = supervise(process)
    first = process.pid
    process.heard()
    until(lambda: process.pid not in (None, first), 3, "another process")
    assert "no answer" in process.note

    def is_spared():
        process.watch()
        return process.restarts <= 1

    assert stays(is_spared, 0.6), "not killed before its first answer: it may still be loading"


def test_a_process_whose_handler_hangs_is_killed_and_started_again_although_it_answers(router, monkeypatch):
    monkeypatch.setattr(supervised, "SILENT_S", 1.5)
    fleet = Fleet({"hanging": Kind(node_command("hanging", router))}, {"hanging": 1})
    (process,) = fleet.processes
    with Node("launcher", CELL, bus.Connection(connect=(router,))) as node:
        node.every(0.1, lambda: node.stopping.set() if process.restarts else None)
        launch.Launcher(node, fleet, Console(quiet=True)).run(60)
    assert process.restarts == 1
    assert re.fullmatch(r"timer publish of 0.01 s hangs for \d+ s, killed by SIGKILL.*", process.note)


def test_stopping_waits_for_nobody_who_would_not_end_by_himself(supervise):
    processes = [
        python("sleeper", SLEEPS),
        python("deaf", IGNORES_SIGTERM),
        python("parent", HAS_A_CHILD),
        python("crashing", ALWAYS_CRASHES),
    ]
    until = supervise(*processes)
    tree = until(lambda: len(found := family(processes)) >= 4 and found, 5, "a grandchild")
    started = time.monotonic()
    supervised.stop(processes)
    assert time.monotonic() - started < PATIENCE_S, "they would sleep for ten minutes"
    wait_for(lambda: not any(alive(process) for process in tree), 10, "all of them to be gone")


def family(processes):
    own = [psutil.Process(process.pid) for process in processes if process.pid]
    return own + [child for process in own for child in process.children(recursive=True)]


def alive(process):
    return process.is_running() and process.status() != psutil.STATUS_ZOMBIE


def test_the_launcher_shows_a_service_running_and_its_topics(capsys):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    fleet = Fleet(
        {"steady": Kind([sys.executable, "-m", "penumbra.tests.support.nodes", "steady", "--connect", endpoint])}, {"steady": 1}
    )
    (steady,) = fleet.processes
    node = Node("launcher", CELL, bus.Connection("router", listen=(endpoint,)))
    with node:
        console = Console(width=400)
        launcher = launch.Launcher(node, fleet, console)
        launcher.watch.refresh()
        node.every(0.1, lambda: node.stopping.set() if is_shown(launcher, steady) else None)
        launcher.run(20)
        for size in ((80, 24), (40, 24)):
            narrow = Console(width=size[0], height=size[1])
            with narrow.capture() as drawn:
                narrow.print(display.Picture("penumbra pose", launcher.watch).draw([steady.row()], *size))
            lines = drawn.get().splitlines()
            assert lines[1:5] == ["forearm: tracking", "x 0.0  y 0.0  z 20.0 cm", "roll 0  pitch 0  yaw 0 deg",
                                  "from haptic 30 %, vision 70 %"]  # fmt: skip
            assert any(line.startswith("fused ") for line in lines)
            assert len(lines) < size[1] and max(map(len, lines)) <= size[0]
        with console.capture() as drawn:
            console.print(display.plain([steady.row()], launcher.watch))
    assert "pose of forearm: tracking, at 0.0 0.0 20.0 cm" in drawn.get()
    assert steady.state == "stopped"
    assert "restarts: none" in capsys.readouterr().out


def test_only_the_last_column_of_a_table_is_cut_to_the_width():
    cells = [
        "segmentation",
        "degraded",
        "27666",
        "100",
        "1198",
        "0",
        "no camera/front/mask for 1.6 s; refused on camera/front/frame",
    ]
    for width in (80, 71, 60):
        console = Console(width=width)
        with console.capture() as drawn:
            console.print(
                display._table(["process", "state", "pid", "CPU %", "MB", "restarts", ""], [list(map(Text, cells))], width)
            )
        (row,) = drawn.get().splitlines()[1:]
        assert row.split()[:6] == cells[:6]
        assert row.rstrip().endswith("…") and len(row) <= width


def is_shown(launcher, process):
    rates = {row.name: row.rate_hz for row in launcher.watch.topic_rows()}
    return process.state == "running" and process.cpu > 0 and rates["fused"] > 50 and launcher.watch.accuracy


def test_the_error_is_measured_against_the_truth_at_the_time_of_the_pose():
    now = time.time_ns()
    base = pose(now, x=0.03)
    moving = Truth(
        stamp_ns=now - 10**7,
        target="forearm",
        frame="world",
        position=base.position - [0.05, 0.0, 0.0],
        orientation=base.orientation,
        velocity=np.array([3.0, 0.0, 0.0, 0.0, 0.0, 3.0]),
        hidden=0.0,
        gap=0.1,
    )
    found = accuracy(base, [moving])
    assert found.position == pytest.approx(0.02)  # 5 cm away 10 ms ago, 3 cm nearer since
    assert found.axis == pytest.approx(0.03)


def up(*arguments, **kwargs):
    command = penumbra_command("up", *arguments)
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **kwargs)


def up_until(words, *arguments, **kwargs):
    """`penumbra up` for a moment, and for longer where a busy machine has not come to say these words; exit code and output."""
    for seconds in ("1.5", "30"):
        process = up("--seconds", seconds, *arguments, **kwargs)
        out, err = process.communicate(timeout=PATIENCE_S)
        if words in out + err:
            break
    return process.returncode, out, err


NOTHING = [
    word for process in PROCESSES if process.replicas and process.name != "router" for word in ("--replicas", f"{process.name}=0")
]


def test_up_stops_by_itself_with_exit_code_zero_and_a_summary():
    code, out, err = up_until("launcher running", "--port", str(free_port()), *NOTHING)
    assert code == 0, err
    assert "launcher running" in out
    assert "restarts: none" in out


def test_up_prints_where_the_page_is_and_opens_it_in_the_browser(tmp_path, monkeypatch):
    browser, opened, address = tmp_path / "browser", tmp_path / "opened", f"http://127.0.0.1:{free_port()}/"
    browser.write_text(f'#!/bin/sh\necho "$1" > {opened}\n')
    browser.chmod(0o755)
    monkeypatch.setenv("BROWSER", str(browser))
    page = address.rpartition(":")[2].strip("/")
    _, out, _ = up_until(
        f"page: {address}", "--port", str(free_port()), *NOTHING, "--replicas", "dashboard=1", "--page", page, "--open"
    )
    assert f"page: {address}" in out
    assert opened.read_text() == f"{address}\n"


def test_up_says_that_its_port_is_taken_and_what_to_do():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Node("router", CELL, bus.Connection("router", listen=(endpoint,))):
        process = up("--port", endpoint.rpartition(":")[2])
        _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    other = int(endpoint.rpartition(":")[2]) + 1
    assert err == (
        f"penumbra up: the port of {endpoint} is taken: another router runs there; stop it, or give another port (penumbra up "
        f"--port {other}; penumbra router --listen tcp/127.0.0.1:{other})\n"
    )


def test_up_refuses_replicas_of_what_does_not_exist():
    process = up("--replicas", "magic=2")
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert "--replicas magic=2: expected one of router, emulator, camera, segmentation" in err


def started_by(process):
    try:
        return psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_nothing_is_left_behind_however_the_launcher_ends(number):
    port = free_port()
    process = up("--port", str(port), *NOTHING, "--replicas", "fusion=2")
    node = Node("test", CELL, bus.Connection(connect=(f"tcp/127.0.0.1:{port}",)))
    try:
        with node.open(patience_s=10):
            session = node.session
            assert session is not None
            tokens = lambda: [r for r in session.liveliness().get(topics.alive("table", "fusion"), timeout=1.0) if r.ok]  # noqa: E731
            wait_for(lambda: len(tokens()) == 2, 20, "both replicas on the bus", 0.1)
        children = started_by(process)
        services = [name for child in children if (name := service_of(child))]
        assert sorted(services) == ["fusion", "fusion", "router"]
        started = time.monotonic()
        process.send_signal(number)
        wait_for(lambda: process.poll() is not None and not any(alive(child) for child in children), 30, "the end of all")
        print(f"{number.name}: all gone after {time.monotonic() - started:.2f} s")
        assert process.returncode == (0 if number != signal.SIGKILL else -signal.SIGKILL)
    finally:
        process.kill()
        process.communicate()


def test_a_router_that_dies_is_started_again_and_everybody_comes_back():
    port = free_port()
    process = up("--port", str(port), *NOTHING, "--replicas", "fusion=1")
    try:
        with connect(port) as session:
            services = ("fusion", "launcher")

            def alive() -> bool:
                found = [r.ok.key_expr for r in session.liveliness().get(topics.alive("table", "*"), timeout=1.0) if r.ok]
                return {str(key).split("/")[-2] for key in found} >= set(services)

            wait_for(alive, 30, "both on the bus")
            (router,) = (child for child in started_by(process) if service_of(child) == "router")
            router.kill()
            wait_for(lambda: not alive(), 10, "nobody to be reached")
            wait_for(alive, 30, "both on the bus again")
        assert process.poll() is None
    finally:
        process.terminate()
        process.communicate(timeout=PATIENCE_S)


def test_every_line_of_the_table_is_a_package_and_every_service_is_in_the_table():
    services = ROOT / "services"
    assert {process.name for process in PROCESSES} == {path.parent.name for path in services.glob("*/service.py")}


@pytest.mark.parametrize(
    ("name", "needed"), [("emulator", True), ("segmentation", False), ("search", False), ("haptics", True), ("fusion", True)]
)
def test_a_cell_without_cameras_needs_no_process_that_looks(name, needed):
    blind = CELL.model_copy(update={"cameras": {}})
    assert next(process for process in PROCESSES if process.name == name).is_needed(blind) is needed


# ---- what `up` says by its exit code, and what it refuses


def test_a_process_that_failed_is_reported_by_the_exit_code(router):
    fleet = Fleet({"wrong": Kind([sys.executable, "-c", REFUSES])}, {"wrong": 1})
    (wrong,) = fleet.processes
    with Node("launcher", CELL, bus.Connection(connect=(router,))) as node:
        node.every(0.05, lambda: node.stopping.set() if wrong.state == "failed" else None)
        assert launch.Launcher(node, fleet, Console(quiet=True)).run(60) == 1


@pytest.mark.parametrize(("service", "code"), [("search", 1), ("skin", 0)])
def test_a_sense_and_a_fusion_without_a_tracked_pose_are_reported_by_the_exit_code(router, capsys, service, code):
    idle = Kind([sys.executable, "-c", SLEEPS])
    fleet = Fleet({service: idle, "fusion": idle}, {service: 1, "fusion": 1})
    with Node("launcher", CELL, bus.Connection(connect=(router,))) as node:
        assert launch.Launcher(node, fleet, Console(width=400)).run(0.5) == code
    assert ("no pose was tracked within 0.5 s" in capsys.readouterr().out) == bool(code)


def test_replicas_that_publish_a_stream_by_turns_are_shown_with_the_rate_of_both(router):
    with Node("launcher", CELL, bus.Connection(connect=(router,))) as node:
        watch = display.Watch(node)
        key = topics.FUSED.at(cell="table", target="forearm")
        published = {key: TopicReport(rate_hz=100.0)}
        watch.health = {name: Report("fusion", name, "ok", published=published) for name in ("a", "b")}
        (row,) = (row for row in watch.topic_rows() if row.name == "fused")
    assert row.rate_hz == 200.0


def test_what_a_process_does_while_it_starts_is_shown():
    process = Supervised("fusion", [])
    process.state = "running"
    row = process.row(Report("fusion", "a", "starting", ["compiling 12 of 40"]))
    assert (row.state, row.note) == ("starting", "compiling 12 of 40")


def test_a_second_emulator_of_a_cell_is_refused(router):
    with Node("emulator", CELL, bus.Connection(connect=(router,))):
        process = up("--connect", router)
        _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    told = f"penumbra up: cell table at {router} has a process emulator already, and two would contradict each other: "
    assert err.splitlines()[-1] == f"{told}leave this one out with --replicas emulator=0"


def test_up_uses_the_router_of_the_environment_unless_it_is_given_a_port(router):
    environment = {**os.environ, "PENUMBRA_CONNECT": router}
    for flags, starts_a_router in (([], False), (["--port", str(free_port())], True)):
        awaited = "router running" if starts_a_router else "launcher running"
        code, out, err = up_until(awaited, *flags, *NOTHING, env=environment)
        assert (code, awaited in out, "router running" in out) == (0, True, starts_a_router), err


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--port", "99999"], "--port: expected a port from 1 to 65535, got '99999'"),
        (["--port", "0"], "--port: expected a port from 1 to 65535, got '0'"),
        (["--seconds", "nan"], "--seconds: expected a time above 0, in seconds, got 'nan'"),
        (["--seconds", "-3"], "--seconds: expected a time above 0, in seconds, got '-3'"),
        (["--method", "foo"], "--method: expected default or paper, got 'foo'"),
        (["--observer", "foo"], "--observer: expected default or paper, got 'foo'"),
        (["--cel", "table"], "no option --cel; did you mean --cell?"),
        (["--replicas", "router=0"], "--replicas router: expected 1, got 0: all other processes meet there"),
    ],
)
def test_up_refuses_a_bad_flag_in_one_line(flags, words, capsys):
    with pytest.raises((SystemExit, cells.CellError)) as ended:
        up_command.main(flags)
    assert words in (capsys.readouterr().err or str(ended.value))


def test_the_children_of_up_import_nothing_from_the_current_folder(tmp_path):
    for name in ("penumbra", "shared", "zenoh", "json"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(f"raise SystemExit('the {name} of the current folder')")
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); "
    main = "from penumbra.services.command.cli import main; sys.exit(main(sys.argv[1:]))"
    flags = ["up", "--port", str(free_port()), *NOTHING, "--replicas", "fusion=1"]
    for fork in (True, False):  # without a fork server every process is started plainly
        broken = (
            "" if fork else "from penumbra.services.launcher import forkserver; forkserver.ForkServer.start = lambda self: None; "
        )
        command = [
            sys.executable,
            "-P",
            "-c",
            f"{code}{broken}{main}",
            *flags,
        ]
        process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        lines = read_until(process, "fusion: on the bus", 1)
        process.terminate()
        said = "".join(lines) + process.communicate(timeout=PATIENCE_S)[1]
        assert "fusion: on the bus" in said and "of the current folder" not in said, said


def read_until(process, words, times):
    """The lines of standard error until so many of them have the words, or the end."""
    lines = []
    for line in process.stderr:
        lines.append(line)
        if sum(words in each for each in lines) == times:
            break
    return lines


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM])
def test_up_ends_in_order_and_without_noise_also_when_its_terminal_is_closed(number):
    process = up("--port", str(free_port()), *NOTHING, "--replicas", "fusion=2")
    read_until(process, "fusion: on the bus", 2)
    process.send_signal(number)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert "restarts: none" in out
    assert "Traceback" not in err and "waiting for the router" not in err


@pytest.mark.parametrize("keep_going", [False, True])
def test_up_ends_where_a_process_does_not_start_and_names_it(router, capsys, keep_going):
    fleet = Fleet(
        {"wrong": Kind([sys.executable, "-c", REFUSES]), "idle": Kind([sys.executable, "-c", SLEEPS])},
        {"wrong": 1, "idle": 1},
    )
    wrong, looks = fleet.processes[0], []
    with Node("launcher", CELL, bus.Connection(connect=(router,))) as node:

        def end_what_goes_on():
            if wrong.state == "failed":
                looks.append(time.monotonic())
            if len(looks) > 10:
                node.stopping.set()

        node.every(0.1, end_what_goes_on)
        assert launch.Launcher(node, fleet, Console(width=400), keep_going).run(600.0) == 1
    out = capsys.readouterr().out
    assert (len(looks) > 10) is keep_going
    assert "failed: wrong: exit code 2: cell table has no camera: it has front" in out
    assert ("wrong did not start, and the others were ended: penumbra up --keep-going" in out) is not keep_going


def test_up_ends_where_a_process_dies_each_time_it_starts(router, capsys):
    fleet = Fleet({"crashing": Kind([sys.executable, "-c", ALWAYS_CRASHES])}, {"crashing": 1})
    with Node("launcher", CELL, bus.Connection(connect=(router,))) as node:
        assert launch.Launcher(node, fleet, Console(width=400)).run(60) == 1
    assert "crashing did not start" in capsys.readouterr().out


def test_a_state_is_shown_when_it_has_lasted_and_an_end_at_once():
    now = [0.0]
    steady = display.Steady(lambda: now[0])
    assert steady.show("search", "starting") == "starting"
    assert steady.show("search", "running") == "running"
    for now[0] in (0.5, 1.0, 1.5):
        assert steady.show("search", "degraded") == "running"
    now[0] = 1.6
    assert steady.show("search", "running") == "running"
    now[0] = 1.7
    assert steady.show("search", "degraded") == "running", "it has to last again"
    now[0] = 3.3
    assert steady.show("search", "degraded") == "degraded"
    assert steady.show("search", "waiting") == "waiting"


def test_the_screen_names_the_command_that_works():
    options = up_options("--cell", "table")
    assert launch.pose_command(options) == "penumbra pose"
    assert launch.pose_command(up_options("--port", "7557", "--cell", "arm")) == (
        "penumbra pose --cell arm --connect tcp/127.0.0.1:7557"
    )


def up_options(*argv):
    options = command_line.parse(up_command.PARAMS, argv)
    options.port = options.port or launch.PORT
    return options


def test_a_dumb_terminal_gets_plain_lines():
    primary, secondary = os.openpty()
    command = [sys.executable, "-m", "penumbra", "up", "--port", str(free_port()), *NOTHING]
    process = subprocess.Popen(command, stdout=secondary, stderr=secondary, env={**os.environ, "TERM": "dumb"})
    os.close(secondary)
    out = b""
    with contextlib.suppress(OSError):
        while part := os.read(primary, 4096):
            out += part
            if b"launcher running" in part:  # printed every five seconds, and at the end
                process.terminate()
                break
        while part := os.read(primary, 4096):
            out += part
    os.close(primary)
    assert process.wait(PATIENCE_S) == 0
    assert b"\x1b" not in out and b"launcher running" in out
