"""Commands that look at a running cell, or steer it, as a user meets them."""

import functools
import io
import json
import signal
import subprocess
import sys
import time

import pytest
from rich.console import Console

from penumbra.services.command import cli, doctor, look, runs, snapshot
from penumbra.services.emulator.control import COMMANDS
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import outline, topics
from penumbra.shared.runtime import bus, running
from penumbra.shared.runtime.node import Node
from penumbra.tests.support import numbered
from penumbra.tests.support.live import PATIENCE_S, free_port, penumbra_command, wait_for
from penumbra.tests.support.nodes import pose_json, start

CELL = cells.load("table")


def test_pose_prints_the_pose_in_words(endpoint, capsys):
    assert cli.main(["pose", "--connect", endpoint]) == 0
    out = capsys.readouterr().out
    assert "tracking, in frame world" in out
    assert "0.00     0.00    20.00 cm  +- 1 cm" in out
    assert "haptic 30 % (10 ms old), vision 70 % (50 ms old)" in out


@pytest.mark.parametrize("columns", [40, 71, 80])
def test_a_pose_in_words_fits_the_terminal(columns):
    text = look.describe(json.loads(pose_json()), columns)
    assert max(map(len, text.splitlines())) <= columns
    for word in ("forearm", "tracking", "20.00 cm", "roll pitch yaw", "velocity", "haptic 30 %", "vision 70 %"):
        assert word in text


def test_pose_as_json_is_exactly_what_fusion_answers(endpoint, capsys):
    assert cli.main(["pose", "--json", "--connect", endpoint]) == 0
    assert json.loads(capsys.readouterr().out).keys() == json.loads(pose_json()).keys()


def test_pose_loads_nothing_that_takes_longer_than_its_answer(endpoint):
    program = (
        "import sys; from penumbra.services.command import cli; cli.main(['pose', '--json', '--connect', sys.argv[1]]); "
        "print([name for name in ('torch', 'numba', 'cv2', 'pybullet', 'trimesh', 'scipy', 'rich', 'pydantic', 'psutil', 'ssl') "
        "if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", program, endpoint], capture_output=True, text=True, timeout=PATIENCE_S)
    assert result.stdout.splitlines()[-1] == "[]", result


def test_watch_prints_pose_after_pose_until_ctrl_c(endpoint):
    command = penumbra_command("pose", "--watch", "--json", "--connect", endpoint)
    # a shell starts what runs in its background with Ctrl-C ignored: not so here, wherever the tests run
    listening = functools.partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    watch = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=listening)
    assert watch.stdout is not None
    try:
        stamps = [json.loads(watch.stdout.readline())["stamp_ns"] for _ in range(4)]
        assert stamps == sorted(set(stamps))
        watch.send_signal(2)
        assert watch.wait(PATIENCE_S) in (0, 130)
    finally:
        watch.kill()
        watch.communicate()


@pytest.mark.parametrize("flag", [[], ["--cell", "table"]])
def test_a_target_that_the_cell_does_not_have_is_one_line_with_those_that_it_has(endpoint, flag, capsys):
    assert cli.main(["pose", "leg", "--connect", endpoint, *flag]) == 2
    assert capsys.readouterr().err == "penumbra pose: cell table has no target 'leg': it has forearm\n"


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A router with a cell of one's own as the only one, whose services answer like fusion and the emulator: its file and its
    endpoint."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.delenv("PENUMBRA_CELL", raising=False)
    path = tmp_path / "mine.yaml"
    path.write_text(cells.source("table").read_text().replace("name: table", "name: mine", 1))
    cell, where = cells.load(path), f"tcp/127.0.0.1:{free_port()}"
    router = Node("router", cell, bus.Connection("router", listen=(where,)))
    fusion = Node("fusion", cell, bus.Connection(connect=(where,)))
    start(fusion)
    fusion.answer(topics.description("mine"), lambda parameters, payload: (outline.of(cell).encode(), "application/json"))
    fusion.answer(topics.control("mine"), lambda parameters, payload: b'{"speed": 1}')
    with router, fusion:
        wait_for(lambda: router.query(topics.control("mine"), payload=b"{}"), 5, "the services")
        yield path, where


def test_commands_that_look_take_the_only_cell_that_runs(own, capsys):
    path, where = own
    with runs.recorded("mine", path, (where,), None, None):
        for argv, word in (
            (["pose"], "forearm"),
            (["sim", "state"], "speed"),
            (["topics"], "penumbra/mine/camera/front/frame"),
            (["topics", "--hz", "--seconds", "0.5"], "penumbra/mine/target/forearm/pose/fused"),
            (["doctor"], "cell mine: "),
        ):
            assert cli.main([*argv, "--connect", where]) == 0
            assert word in capsys.readouterr().out, argv


def test_a_recorder_beside_a_running_cell_takes_the_only_one(own, tmp_path):
    path, where = own
    command = penumbra_command("record", "--connect", where, "--out", str(tmp_path / "run.mcap"))
    with runs.recorded("mine", path, (where,), None, None), subprocess.Popen(command, stderr=subprocess.PIPE) as recorder:
        try:
            connection = bus.Connection(connect=(where,))
            with look.open_session(connection) as session:
                wait_for(lambda: running.ask(session, "mine", "record"), PATIENCE_S, "the recorder of the cell")
        finally:
            recorder.terminate()
            words = recorder.communicate(timeout=PATIENCE_S)[1]
    assert recorder.returncode == 0, words
    again = subprocess.run(penumbra_command("record", "--connect", where), capture_output=True, timeout=PATIENCE_S)
    assert again.returncode == 2, "its file is not known here any more"


@pytest.mark.parametrize("cell", [[], ["--cell", "mine"]])
def test_a_running_cell_whose_file_is_elsewhere_is_described_by_fusion_or_named_with_what_to_give(own, cell, capsys):
    _, where = own
    for argv, word in (
        (["pose"], "forearm"),
        (["sim", "state"], "speed"),
        (["topics"], "penumbra/mine/target/forearm/truth"),
        (["topics", "--hz", "--seconds", "0.5"], "penumbra/mine/target/forearm/truth"),
    ):
        assert cli.main([*argv, "--connect", where, *cell]) == 0
        assert word in capsys.readouterr().out, argv
    for argv in (["snapshot", "out.png"], ["doctor"]):
        assert cli.main([*argv, "--connect", where, *cell]) == 2
        assert capsys.readouterr().err == (
            f"penumbra {argv[0]}: cell mine runs at {where}, and its file is not known here: give --cell FILE.yaml, the file of "
            "cell mine\n"
        )


def test_a_cell_that_does_not_run_where_another_does_is_named_with_what_to_give(own, monkeypatch, capsys):
    _, where = own
    monkeypatch.setattr(snapshot, "PATIENCE_S", 0.1)
    remedy = "where cells run: mine; give --cell mine"
    for argv in (["pose"], ["sim", "state"], ["restart"], ["topics", "--hz", "--seconds", "0.1"], ["snapshot", "out.png"]):
        cli.main([*argv, "--cell", "table", "--connect", where])
        assert remedy in capsys.readouterr().err, argv
    for argv in (["pose"], ["sim", "state"], ["restart"]):
        assert cli.main([*argv, "--cell", "mini", "--connect", where]) == 2
        assert remedy in capsys.readouterr().err, "a name that is neither built in nor a file may be that of a running cell"
    found = list(doctor._processes("table", bus.Connection(connect=(where,))))
    assert [(each.text, each.mend) for each in found] == [
        ("no process of cell table runs there, where cells run: mine", "give --cell mine")
    ]


def test_where_several_cells_run_at_a_router_they_are_named(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("PENUMBRA_CELL", raising=False)
    found = []
    for name in ("left", "right"):
        path = tmp_path / f"{name}.yaml"
        path.write_text(cells.source("table").read_text().replace("name: table", f"name: {name}", 1))
        found.append(cells.load(path))
    where = f"tcp/127.0.0.1:{free_port()}"
    left, right = (Node("fusion", cell, bus.Connection(connect=(where,))) for cell in found)
    with Node("router", CELL, bus.Connection("router", listen=(where,))) as router, left, right:
        session = router.session
        assert session is not None
        wait_for(lambda: running.cells_at_work(session) == ["left", "right"], 5, "both cells")
        assert cli.main(["pose", "--connect", where]) == 2
    assert "where cells run: left, right; give --cell left" in capsys.readouterr().err


def test_a_pose_that_no_process_answers_names_the_cells_and_processes_that_run(endpoint, capsys):
    assert cli.main(["pose", "--cell", "arm", "--connect", endpoint]) == 2
    assert (
        "no answer for the pose of forearm in cell arm: no process of it is on this router, where cells run: table; "
        "give --cell table"
    ) in capsys.readouterr().err


def answering(endpoint, *states):
    """A fusion that answers with one state after another, and with the last one from then on."""
    node = Node("fusion", cells.load("arm"), bus.Connection(connect=(endpoint,)))
    rest = list(states)

    def answer(parameters, payload):
        state = rest.pop(0) if len(rest) > 1 else rest[0]
        return json.dumps({**json.loads(pose_json()), "state": state}).encode(), "application/json"

    node.answer(topics.current_pose("arm", "forearm"), answer)
    return node


def test_a_lost_pose_has_an_exit_code_of_its_own(endpoint, capsys):
    with answering(endpoint, "lost"):
        assert wait_for(lambda: (code := cli.main(["pose", "--cell", "arm", "--connect", endpoint])) != 2 and code, 5, "it") == 3
        assert "lost, in frame world" in capsys.readouterr().out
        assert cli.main(["pose", "--cell", "arm", "--connect", endpoint, "--wait", "0.3"]) == 3
        assert capsys.readouterr().out.count("lost") == 1


def test_pose_waits_until_the_target_is_tracked(endpoint, capsys):
    with answering(endpoint, "lost", "lost", "coasting", "tracking"):
        assert cli.main(["pose", "--cell", "arm", "--connect", endpoint, "--wait", "--json"]) == 0
        assert [json.loads(line)["state"] for line in capsys.readouterr().out.splitlines()] == ["tracking"]


def test_a_pose_that_is_not_tracked_in_time_is_no_success(endpoint, capsys):
    with answering(endpoint, "coasting"):
        wait_for(lambda: cli.main(["pose", "--cell", "arm", "--connect", endpoint]) == 0, 5, "the pose")
        assert cli.main(["pose", "--cell", "arm", "--connect", endpoint, "--wait", "0.3"]) == 1
        assert "coasting, in frame world" in capsys.readouterr().out


def test_pose_waits_for_a_router_too_and_says_at_the_end_what_is_missing(capsys):
    where = f"tcp/127.0.0.1:{free_port()}"
    began = time.monotonic()
    assert cli.main(["pose", "--connect", where, "--wait", "1.5"]) == 2
    assert time.monotonic() - began >= 1.5
    assert f"no router at {where}" in capsys.readouterr().err


def test_commands_that_look_print_json(endpoint, capsys):
    assert cli.main(["topics", "--hz", "--seconds", "1", "--json", "--connect", endpoint]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["topics"][topics.FUSED.at(cell="table", target="forearm")]["rate_hz"] > 10
    assert {process["service"] for process in found["processes"]} == {"router", "worker"}
    assert cli.main(["doctor", "--json", "--connect", endpoint]) == 0
    assert {finding["status"] for finding in json.loads(capsys.readouterr().out)} <= {"ok", "warn"}


def test_topics_lists_the_keys_that_the_cell_has_and_no_other(capsys):
    assert cli.main(["topics", "--cell", "arm"]) == 0
    out = capsys.readouterr().out
    assert all(f" {topic.name} " in out for topic in topics.TOPICS)
    assert "joint angles [rad]" in out and "penumbra/arm/skin/p7/voltages" in out and "{" not in out
    assert cli.main(["topics", "--cell", "table", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {row["topic"] for row in rows} == {topic.name for topic in topics.TOPICS} - {"joints"}, "the table has no robot"
    user = Node("user", CELL)
    assert sorted(row["key"] for row in rows) == sorted(key for topic in topics.TOPICS for key in user.keys(topic, {}))


def test_topics_of_a_cell_without_pads_and_emulator_are_neither_listed_nor_expected(endpoint, tmp_path, capsys):
    path = str(numbered.cell(tmp_path))
    assert cells.load(path).sim is None
    assert cli.main(["topics", "--cell", path, "--json"]) == 0
    assert {row["topic"] for row in json.loads(capsys.readouterr().out)} == {"frame", "mask", "vision", "fused"}
    assert cli.main(["topics", "--cell", path, "--hz", "--seconds", "0.1", "--json", "--connect", endpoint]) == 0
    found = json.loads(capsys.readouterr().out)["topics"]
    assert not [key for key in found if key.endswith(("haptic", "truth", "voltages"))]


def test_topics_hz_measures_what_arrives(endpoint, capsys):
    assert cli.main(["topics", "--hz", "--seconds", "1", "--connect", endpoint]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "pose/fused" in line).split()
    assert 10 < float(row[1]) < 120, "a hundred a second, fewer on a busy machine"


def test_sim_passes_the_command_on_and_prints_the_answer_or_the_refusal(endpoint, capsys):
    def control(parameters, payload):
        request = json.loads(payload)
        if request["command"] != "occlude":
            raise ValueError("expected occlude")
        return json.dumps({"occlusion": request["value"], "occlusion_now": 0.123, "motion": "on"}).encode()

    with Node("emulator", CELL, bus.Connection(connect=(endpoint,))) as emulator:
        emulator.answer(topics.control("table"), control)
        wait_for(lambda: cli.main(["sim", "occlude", "0.8", "--connect", endpoint]) == 0, 5, "the answer")
        assert capsys.readouterr().out.splitlines()[-2:] == ["occlusion  0.8, and now 0.12", "motion     on"]
        assert cli.main(["sim", "pause", "--connect", endpoint]) == 2
        assert capsys.readouterr().err == "penumbra sim: expected occlude\n"


def test_sim_refuses_a_command_that_the_emulator_does_not_have_in_its_own_words(capsys):
    assert tuple(COMMANDS) == look.ACTIONS
    assert cli.main(["sim", "bogus"]) == 2
    what = "COMMAND: expected occlude, motion, pause, resume, speed, skin, board or state, got 'bogus'"
    assert capsys.readouterr().err == f"penumbra sim: {what} (see penumbra sim --help)\n"


def test_sim_without_an_emulator_says_what_to_start(endpoint, capsys):
    assert cli.main(["sim", "state", "--connect", endpoint]) == 2
    assert "no emulator in cell table: its processes are router, worker: start `penumbra emulator`" in capsys.readouterr().err


def test_a_narrow_terminal_shows_fewer_columns_before_it_cuts_one():
    columns = {"key": ["penumbra/table/camera/front/frame"], "Hz": ["20"], "from": ["emulator"], "what": ["one image"]}
    for width, expected in ((80, list(columns)), (55, ["key", "Hz", "from"]), (40, ["key", "Hz"])):
        text = io.StringIO()
        out = Console(width=width, file=text)
        out.print(look.table_of(columns, ("what", "from"), out))
        heads, row = text.getvalue().splitlines()
        assert heads.split() == expected
        assert row.split()[0] == columns["key"][0]
