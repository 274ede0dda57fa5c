"""The `penumbra` command as a user meets it."""

import functools
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from services import progress
from services.command import cli, doctor
from shared.cell import description as cells
from shared.contract import processes, topics
from shared.runtime import bus
from shared.runtime.node import Node
from tests.support.live import free_port, wait_for
from tests.support.nodes import pose_json, start

CELL = cells.load("table")
ROOT = Path(__file__).parents[3]


def run(*argv, code=None):
    command = [sys.executable, "-c", code] if code else [sys.executable, "-m", "services.command.cli"]
    return subprocess.run([*command, *argv], capture_output=True, text=True, timeout=60)


@pytest.fixture
def endpoint():
    """Of a router with the small service beside it."""
    where = f"tcp/127.0.0.1:{free_port()}"
    router = Node("router", CELL, bus.Connection("router", listen=(where,)))
    worker = Node("worker", CELL, bus.Connection(connect=(where,)))
    start(worker)
    with router, worker:
        wait_for(lambda: router.query(topics.current_pose("table", "forearm")), 5, "the service")
        yield where


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["fly"], "penumbra: no command 'fly': one of up, restart, scale, router, "),
        (
            ["fusion", "--cell", "nowhere"],
            "penumbra fusion: no cell 'nowhere': give one of arm, table, or the path of a YAML file",
        ),
        (["pose", "leg"], "penumbra pose: cell table has no target 'leg': it has forearm"),
        (["pose", "--connect", "nonsense"], "penumbra pose: endpoint 'nonsense': PROTOCOL/ADDRESS expected"),
        (
            ["pose", "--config", "/nowhere.json5"],
            "penumbra pose: --config /nowhere.json5: a Zenoh configuration (JSON5) expected",
        ),
        (["router", "--fly"], "penumbra router: unrecognized arguments: --fly (see penumbra router --help)"),
        (["bench", "nothing"], "penumbra bench: one of ablation, faults, fusion, haptics, live"),
    ],
)
def test_a_wrong_command_is_one_line_that_says_what_to_do_and_exit_code_two(argv, line, capsys):
    try:
        code = cli.main(argv)
    except SystemExit as end:
        code = end.code
    err = capsys.readouterr().err
    assert code == 2
    assert err.startswith(line)
    assert len(err.splitlines()) == 1


def test_a_service_that_logs_json_tells_its_error_as_json_and_an_unknown_format_is_refused(monkeypatch):
    out = run("fusion", "--cell", "nowhere", "--log-format", "json")
    line = json.loads(out.stderr)
    assert (out.returncode, line["service"], line["level"]) == (2, "fusion", "error")
    assert line["message"].startswith("no cell 'nowhere': give one of arm, table")
    monkeypatch.setenv("PENUMBRA_LOG_FORMAT", "xml")
    out = run("pose")
    assert (out.returncode, "--log-format: text or json expected, 'xml' came" in out.stderr) == (2, True)


def test_a_bad_cell_file_is_told_with_its_line(tmp_path, capsys):
    path = tmp_path / "cell.yaml"
    path.write_text("name: mine\ncolour: red\ntargets:\n  arm: {mesh: 'body:forearm', labels: [hand], home: {}}\n")
    assert cli.main(["router", "--cell", str(path)]) == 2
    assert f"penumbra router: {path}:2: colour" in capsys.readouterr().err


def test_no_router_is_one_line_that_says_how_to_start_one(capsys):
    where = f"tcp/127.0.0.1:{free_port()}"
    assert cli.main(["pose", "--connect", where]) == 2
    assert capsys.readouterr().err == (
        f"penumbra pose: no router at {where}: start `penumbra router` or `penumbra up`, or give --connect\n"
    )


def test_a_missing_package_is_one_line_with_the_extra_that_installs_it():
    code = "import sys; sys.modules['msgspec'] = None; from services.command.cli import main; sys.exit(main(sys.argv[1:]))"
    result = run("fusion", code=code)
    assert (result.returncode, result.stderr) == (2, "penumbra fusion: msgspec is not installed: pip install -e '.[fusion]'\n")


@pytest.mark.parametrize("command", ["segmentation train", "posecnn train", "haptics train", "skin model"])
def test_training_without_torch_names_the_extra_for_training(command):
    code = "import sys; sys.modules['torch'] = None; from services.command.cli import main; sys.exit(main(sys.argv[1:]))"
    result = run(*command.split(), code=code)
    extra = processes.tool(*command.split()).extra
    assert "train" in extra.split(",")
    assert (result.returncode, result.stderr) == (2, f"penumbra {command}: torch is not installed: pip install -e '.[{extra}]'\n")


def test_an_import_error_in_our_own_code_is_not_explained_away():
    with pytest.raises(ImportError):
        cli._explain_import(
            "fusion", [], ImportError("cannot import name 'x' from 'shared.runtime.bus'", name="shared.runtime.bus")
        )


def test_help_lists_every_command(capsys):
    assert cli.main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(f"  {name} " in out for name in cli.COMMANDS)


@pytest.mark.parametrize("command", ["pose", "topics", "router"])
def test_light_commands_import_nothing_heavy(command):
    code = f"import sys, services.command.cli as cli; cli.main([{command!r}, '--fly'])"
    guard = "import atexit, sys; atexit.register(lambda: print(sorted({m.partition('.')[0] for m in sys.modules})))\n"
    loaded = run(code=guard + code).stdout
    assert "'shared'" in loaded
    assert not [heavy for heavy in ("torch", "numba", "cv2", "pybullet", "trimesh") if f"'{heavy}'" in loaded]


def test_pose_prints_the_pose_in_words(endpoint, capsys):
    assert cli.main(["pose", "--connect", endpoint]) == 0
    out = capsys.readouterr().out
    assert "tracking, in frame world" in out
    assert "0.00     0.00    20.00 cm  +- 1 cm" in out
    assert "haptic 30 % (10 ms old), vision 70 % (50 ms old)" in out


def test_pose_as_json_is_exactly_what_fusion_answers(endpoint, capsys):
    assert cli.main(["pose", "--json", "--connect", endpoint]) == 0
    assert json.loads(capsys.readouterr().out).keys() == json.loads(pose_json()).keys()


def test_pose_loads_nothing_heavy(endpoint):
    program = (
        "import sys; from services.command import cli; cli.main(['pose', '--json', '--connect', sys.argv[1]]); "
        "print([name for name in ('torch', 'numba', 'cv2', 'pybullet', 'trimesh') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", program, endpoint], capture_output=True, text=True, timeout=30)
    assert result.stdout.splitlines()[-1] == "[]", result


def test_watch_prints_pose_after_pose_until_ctrl_c(endpoint):
    command = [sys.executable, "-m", "services.command.cli", "pose", "--watch", "--json", "--connect", endpoint]
    # a shell starts what runs in its background with Ctrl-C ignored: not so here, wherever the tests run
    listening = functools.partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    watch = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=listening)
    try:
        stamps = [json.loads(watch.stdout.readline())["stamp_ns"] for _ in range(4)]
        assert stamps == sorted(set(stamps))
        watch.send_signal(2)
        assert watch.wait(5) in (0, 130)
    finally:
        watch.kill()
        watch.communicate()


def test_a_pose_that_nobody_knows_is_told(endpoint, capsys, monkeypatch):
    assert cli.main(["pose", "--cell", "arm", "--connect", endpoint]) == 2
    assert "nobody knows the pose of forearm in cell arm: is `penumbra fusion` running?" in capsys.readouterr().err


def test_topics_lists_every_topic_with_its_unit(capsys):
    assert cli.main(["topics"]) == 0
    out = capsys.readouterr().out
    assert all(topic.name in out for topic in topics.TOPICS)
    assert "joint angles [rad]" in out


def test_topics_hz_measures_what_arrives(endpoint, capsys):
    assert cli.main(["topics", "--hz", "--seconds", "1", "--connect", endpoint]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "pose/fused" in line).split()
    assert 80 < float(row[1]) < 120


def test_sim_passes_the_command_on_and_prints_the_answer_or_the_refusal(endpoint, capsys):
    def control(parameters, payload):
        request = json.loads(payload)
        if request["command"] != "occlude":
            raise ValueError("occlude expected")
        return json.dumps({"occlude": request["value"]}).encode()

    with Node("emulator", CELL, bus.Connection(connect=(endpoint,))) as emulator:
        emulator.answer(topics.control("table"), control)
        wait_for(lambda: cli.main(["sim", "occlude", "0.8", "--connect", endpoint]) == 0, 5, "the answer")
        assert capsys.readouterr().out.splitlines()[-1] == '{"occlude": "0.8"}'
        assert cli.main(["sim", "fly", "--connect", endpoint]) == 2
        assert capsys.readouterr().err == "penumbra sim: occlude expected\n"


def test_sim_without_an_emulator_says_what_to_start(endpoint, capsys):
    assert cli.main(["sim", "state", "--connect", endpoint]) == 2
    assert "no emulator in cell table: start `penumbra emulator`" in capsys.readouterr().err


def test_doctor_warns_of_a_router_that_does_not_run_and_finds_one_that_does(endpoint):
    away = bus.Connection(connect=(f"tcp/127.0.0.1:{free_port()}",))
    found = doctor._router(away)
    assert (found.status, "penumbra up" in found.mend) == ("warn", True)
    assert doctor._router(bus.Connection(connect=(endpoint,))).status == "ok"


def test_doctor_fails_with_the_line_of_a_bad_cell_file(tmp_path, capsys):
    path = tmp_path / "cell.yaml"
    path.write_text("name: mine\ncolour: red\ntargets:\n  arm: {mesh: 'body:forearm', labels: [hand], home: {}}\n")
    assert cli.main(["doctor", "--cell", str(path), "--connect", f"tcp/127.0.0.1:{free_port()}"]) == 1
    out = capsys.readouterr().out
    assert f"fail {path}:2: colour" in out
    assert "ok   numpy" in out


def test_doctor_asks_for_more_shared_memory_and_for_cards_of_weights(tmp_path, monkeypatch):
    assert doctor._shared_memory(tmp_path / "nowhere").status == "warn"
    monkeypatch.setattr(doctor, "SHM_BYTES", 1 << 60)
    small = doctor._shared_memory(tmp_path)
    assert (small.status, "shm_size" in small.mend) == ("warn", True)
    monkeypatch.setattr(doctor, "ROOT", tmp_path)
    weights = tmp_path / "net.npz"
    weights.touch()
    assert doctor._card(weights, "penumbra haptics train").status == "warn"
    weights.with_suffix(".json").write_text('{"seed": 1, "date": "2026-01-01"}')
    assert doctor._card(weights, "penumbra haptics train").status == "ok"


def test_a_command_ends_quietly_when_its_reader_does(endpoint):
    command = [sys.executable, "-m", "services.command.cli", "pose", "--watch", "--json", "--connect", endpoint]
    watch = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    watch.stdout.readline()
    watch.stdout.close()
    assert watch.stderr.read() == ""
    assert watch.wait(10) == 0


@pytest.mark.parametrize("argv", [["topics"], ["--help"], ["pose", "--json"]])
def test_output_that_cannot_be_written_is_one_line_and_no_traceback(argv, endpoint):
    argv = [*argv, "--connect", endpoint] if argv[0] == "pose" else argv
    command = [sys.executable, "-m", "services.command.cli", *argv]
    with open("/dev/full", "w") as full:
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    told = f"penumbra {argv[0].strip('-')}: the output cannot be written: No space left on device\n"
    assert (result.returncode, result.stderr) == (1, told)


def test_a_long_command_whose_output_is_piped_tells_how_far_it_is(capsys):
    assert list(progress.track("abc", "letters")) == ["a", "b", "c"]
    assert capsys.readouterr().err == "letters: 0 of 3\nletters: 3 of 3\n"


def test_doctor_finds_nothing_to_mend_on_a_healthy_installation(endpoint, capsys):
    assert cli.main(["doctor", "--connect", endpoint]) == 0
    out = capsys.readouterr().out
    assert "has no weights" not in out and "fail" not in out
    assert f"ok   router at {endpoint}" in out
