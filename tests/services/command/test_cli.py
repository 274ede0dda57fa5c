"""The `penumbra` command as a user meets it."""

import importlib.metadata
import json
import math
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import click
import pytest

from penumbra.services import flags, progress
from penumbra.services.command import cli, doctor, runs
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import processes
from penumbra.shared.perception import landmarks
from penumbra.shared.runtime import bus
from penumbra.tests.support.live import PATIENCE_S, free_port, penumbra_command

CELL = cells.load("table")
ROOT = Path(__file__).parents[3]


def run(*argv, code=None):
    command = [sys.executable, "-c", code] if code else penumbra_command()
    return subprocess.run([*command, *argv], capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["fly"], "penumbra: expected a command, got 'fly'; choose one of up, "),
        (
            ["fusion", "--cell", "nowhere"],
            "penumbra fusion: no cell 'nowhere': give one of arm, table, or the path of a YAML file",
        ),
        (["check", "nope.yaml"], "penumbra check: no such file nope.yaml: give one of arm, table, or the path of a YAML file"),
        (["check", "nope/cell"], "penumbra check: no such file nope/cell: give one of arm, table, or the path of a YAML file"),
        (["check", "/"], "penumbra check: / is a folder: give one of arm, table, or the path of a YAML file"),
        (["pose", "--target", "hand"], "penumbra pose: no option --target; give the target without it, as a word of its own"),
        (
            ["pose", "--connect", "nonsense"],
            "penumbra pose: endpoint: expected PROTOCOL/ADDRESS, as in tcp/127.0.0.1:7447, got 'nonsense'",
        ),
        (
            ["pose", "--config", "/nowhere.json5"],
            "penumbra pose: --config /nowhere.json5: expected a Zenoh configuration (JSON5)",
        ),
        (["router", "--fly"], "penumbra router: no option --fly (see penumbra router --help)"),
        (
            ["bench", "nothing"],
            "penumbra bench: expected a benchmark, got 'nothing'; choose one of ablation, calibration, dashboard, faults, fusion",
        ),
        (["bench"], "penumbra bench: expected a benchmark, got none; choose one of ablation, "),
        (["poes"], "penumbra: expected a command, got 'poes'; did you mean pose? (see penumbra --help)"),
        (["pose", "--cel", "table"], "penumbra pose: no option --cel; did you mean --cell? (see penumbra pose --help)"),
        (["segmentation", "trian"], "penumbra segmentation: expected a command, got 'trian'; did you mean train?"),
        (
            ["router", "--log-level", "inof"],
            "penumbra router: --log-level: expected debug, info, warning or error, got 'inof'; did",
        ),
        (["pose", "--wait", "nan"], "penumbra pose: --wait: expected a time above 0, in seconds, got 'nan'"),
        (["pose", "--wait", "-3"], "penumbra pose: --wait: expected a time above 0, in seconds, got '-3'"),
        (["pose", "--watch", "--wait"], "penumbra pose: expected --watch or --wait, got both"),
        (["topics", "--seconds", "3"], "penumbra topics: expected --hz beside --seconds, got --seconds alone"),
        (["topics", "--hz", "--seconds", "inf"], "penumbra topics: --seconds: expected a number above 0, got 'inf'"),
        (["restart", "fusion", "--all"], "penumbra restart: expected --all or names, got both: fusion"),
        (["scale", "fusion"], "penumbra scale: NAME=NUMBER: expected NAME=NUMBER, as in segmentation=2, got 'fusion'"),
        (["scale"], "penumbra scale: expected NAME=NUMBER, got nothing"),
        (["snapshot", "nowhere/cell.png"], "penumbra snapshot: FILE: expected a file in a folder that exists"),
        (
            ["haptics", "train", "--steps", "3", "--minutes", "1"],
            "penumbra haptics train: expected --minutes or --steps, got both",
        ),
        (["bench", "live", "--seconds", "-1"], "penumbra bench live: --seconds: expected a number above 0, got '-1'"),
        (["bench", "fusion", "--runs", "0"], "penumbra bench fusion: --runs: expected a whole number from 1, got '0'"),
        (["bench", "search", "--frames", "0"], "penumbra bench search: --frames: expected a whole number from 1, got '0'"),
    ],
)
def test_a_wrong_command_is_one_line_that_says_what_to_do_and_exit_code_two(argv, line, capsys):
    code: str | int | None
    try:
        code = cli.main(argv)
    except SystemExit as end:
        code = end.code
    err = capsys.readouterr().err
    assert code == 2
    assert err.startswith(line)
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("command", [*cli.COMMANDS, *(f"{p.name} {tool.name}" for p in processes.PROCESSES for tool in p.tools)])
def test_every_help_has_an_example_whose_flags_there_are(command, capsys):
    assert cli.main([*command.split(), "--help"]) == 0
    out = capsys.readouterr().out
    assert "%(default)" not in out
    example = out.partition("Example:\n")[2]
    assert f"penumbra {command}" in example
    for line in example.splitlines():
        words = line.partition("#")[0].split()
        if words[:1] == ["penumbra"]:
            assert all(word.startswith("--version") or word in out for word in words if word.startswith("--"))


def test_help_shows_what_the_flag_help_shows(capsys):
    assert cli.main(["help", "search", "refine"]) == 0
    told = capsys.readouterr().out
    assert cli.main(["search", "refine", "--help"]) == 0
    assert told == capsys.readouterr().out != ""


def test_bench_help_names_every_benchmark_with_what_it_measures(capsys):
    assert cli.main(["bench", "--help"]) == 0
    out = capsys.readouterr().out
    for path in (ROOT / "tests" / "bench").glob("*.py"):
        assert path.stem == "__init__" or any(len(line.split()) > 3 for line in out.splitlines() if f"  {path.stem} " in line)


def test_the_version_is_that_of_the_installation(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"penumbra {importlib.metadata.version('penumbra')}\n"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("penumbra po", {"pose", "posecnn"}),
        ("penumbra segmentation tr", {"train"}),
        ("penumbra pose --cell a", {"arm"}),
        ("penumbra pose --cell table f", {"forearm"}),
        ("penumbra restart h", {"haptics"}),
        ("penumbra up --vision ", {"procnet", "posecnn"}),
        ("penumbra bench ta", {"table1"}),
    ],
)
def test_a_shell_completes_commands_flags_and_names_of_the_cell(line, expected):
    words = {"_PENUMBRA_COMPLETE": "bash_complete", "COMP_WORDS": line, "COMP_CWORD": str(len(line.split(" ")) - 1)}
    command = [sys.executable, "-m", "penumbra"]
    out = subprocess.run(command, env={**os.environ, **words}, capture_output=True, text=True, timeout=60)
    assert {each.partition(",")[2] for each in out.stdout.splitlines()} == expected, out.stderr


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_completion_of_every_shell_can_be_printed(shell, capsys):
    assert cli.main(["completion", shell]) == 0
    assert "_PENUMBRA_COMPLETE" in capsys.readouterr().out


def test_flags_that_take_several_words_take_all_up_to_the_next_flag():
    params = [
        flags.Option("--size", type=int, takes="many"),
        flags.Option("--serial", takes="many", without="*"),
        flags.Option("--up", takes="rest"),
        flags.Option("--wait", type=flags.seconds, takes="maybe", without="inf"),
        flags.Argument("target", required=False, help="of the cell"),
    ]
    found = flags.parse(params, ["--size", "16", "-3", "--serial", "--wait", "arm", "--up", "--size", "x"])
    assert (found.size, found.serial, found.up) == ((16, -3), ("*",), ("--size", "x"))
    assert (found.wait, found.target) == (math.inf, "arm")
    assert flags.parse(params, ["--wait", "3", "--serial", "p0", "p1"]).serial == ("p0", "p1")
    assert flags.parse(params, ["--wait", "3"]).wait == 3.0
    with pytest.raises(click.UsageError):
        flags.parse(params, ["--size"])


def test_a_service_that_logs_json_logs_its_error_as_json_and_an_unknown_format_is_refused(monkeypatch):
    out = run("fusion", "--cell", "nowhere", "--log-format", "json")
    line = json.loads(out.stderr)
    assert (out.returncode, line["service"], line["level"]) == (2, "fusion", "error")
    assert line["message"].startswith("no cell 'nowhere': give one of arm, table")
    monkeypatch.setenv("PENUMBRA_LOG_FORMAT", "xml")
    out = run("pose")
    assert (out.returncode, "--log-format: expected text or json, got 'xml'" in out.stderr) == (2, True)


@pytest.mark.parametrize(
    "command",
    [
        "segmentation infer arm.png --out {}",
        "segmentation label film.mp4 --out {}",
        "segmentation models --out {}/models",
        "segmentation photographs clones --out {}",
        "segmentation train --out {}/net.npz",
        "search track --mesh cup.ply --camera camera.json --init pose.json --masks masks --out {}",
        "skin characterise --out {}",
        "calibrate camera --save {}",
    ],
)
def test_a_file_where_a_folder_is_written_is_refused_before_the_work(command, tmp_path, capsys):
    file = tmp_path / "results"
    file.touch()
    assert cli.main(command.format(file).split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"got {file}, which is a file; give another name" in line


def test_a_bad_cell_file_is_reported_with_its_line(tmp_path, capsys):
    path = tmp_path / "cell.yaml"
    path.write_text("name: mine\ncolour: red\ntargets:\n  arm: {mesh: 'body:forearm', labels: [hand], home: {}}\n")
    assert cli.main(["router", "--cell", str(path)]) == 2
    assert f"penumbra router: {path}:2: colour" in capsys.readouterr().err


def test_no_router_is_one_line_that_says_how_to_start_one(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))  # no cell of another test
    where = f"tcp/127.0.0.1:{free_port()}"
    assert cli.main(["pose", "--connect", where]) == 2
    assert capsys.readouterr().err == (
        f"penumbra pose: no router at {where}: nothing listens there: start `penumbra router` or `penumbra up`, or give "
        "another endpoint (--connect, in Python endpoint=)\n"
    )


def test_without_a_router_the_cells_of_this_machine_are_named_with_their_endpoints(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    where = f"tcp/127.0.0.1:{free_port()}"
    with runs.recorded("table", tmp_path / "table.yaml", ("tcp/127.0.0.1:7999",), None, None):
        assert cli.main(["pose", "--connect", where]) == 2
        error = capsys.readouterr().err
        assert f"no router at {where}: nothing listens there" in error
        assert "penumbra pose: cell table runs on this machine at another endpoint: give --connect tcp/127.0.0.1:7999\n" in error
        assert cli.main(["pose", "--connect", "tcp/127.0.0.1:7999"]) == 2
        assert "another endpoint: give" not in capsys.readouterr().err


def test_a_missing_package_is_one_line_with_the_extra_that_installs_it():
    code = (
        "import sys; sys.modules['msgspec'] = None; from penumbra.services.command.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    result = run("fusion", code=code)
    assert (result.returncode, result.stderr) == (2, "penumbra fusion: msgspec is not installed: pip install -e '.[fusion]'\n")


@pytest.mark.parametrize("command", ["segmentation train", "posecnn train", "haptics train", "skin model"])
def test_training_without_torch_names_the_extra_for_training(command):
    code = "import sys; sys.modules['torch'] = None; from penumbra.services.command.cli import main; sys.exit(main(sys.argv[1:]))"
    result = run(*command.split(), code=code)
    tool = processes.tool(*command.split())
    assert tool is not None
    extra = tool.extra
    assert "train" in extra.split(",")
    assert (result.returncode, result.stderr) == (2, f"penumbra {command}: torch is not installed: pip install -e '.[{extra}]'\n")


@pytest.mark.parametrize(
    ("command", "folder"), [("up", "launcher"), ("fusion", "fusion"), ("replay", "replay"), ("record save", "record")]
)
def test_a_command_whose_folder_an_image_does_not_have_says_so(command, folder):
    code = f"""
import sys
from penumbra.services.command.cli import main
class Without:
    def find_spec(self, name, path=None, target=None):
        if name == "penumbra.services.{folder}":
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Without())
sys.exit(main(sys.argv[1:]))
"""
    result = run(*command.split(), code=code)
    assert (result.returncode, result.stderr) == (2, f"penumbra {command.split()[0]}: not part of this installation\n")


def test_an_import_error_in_our_own_code_is_not_explained_away():
    with pytest.raises(ImportError):
        cli._explain_import(
            "fusion",
            [],
            ImportError("cannot import name 'x' from 'penumbra.shared.runtime.bus'", name="penumbra.shared.runtime.bus"),
        )


def test_help_lists_every_command(capsys):
    assert cli.main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(f"  {name} " in out for name in cli.COMMANDS)
    assert all(f"  {code} " in out for code in cli.EXIT_CODES)


@pytest.mark.parametrize("command", ["pose", "topics", "router"])
def test_light_commands_import_nothing_heavy(command):
    code = f"import sys, penumbra.services.command.cli as cli; cli.main([{command!r}, '--fly'])"
    guard = "import atexit, sys; atexit.register(lambda: print(sorted({m.partition('.')[0] for m in sys.modules})))\n"
    loaded = run(code=guard + code).stdout
    assert "'zenoh'" in loaded
    assert not [heavy for heavy in ("torch", "numba", "cv2", "pybullet", "trimesh") if f"'{heavy}'" in loaded]


@pytest.mark.parametrize("module", ["penumbra.services.command.cli", "click", "zenoh", "numpy"])
def test_ctrl_c_during_the_imports_ends_a_command_without_a_traceback(module):
    entry = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]["penumbra"]
    script = f"""
import os, pkgutil, signal, sys
class Interrupter:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell has it ignored in its background
main = pkgutil.resolve_name({entry!r})
sys.meta_path.insert(0, Interrupter())
sys.exit(main())
"""
    result = run("pose", code=script)
    assert (result.returncode, result.stderr) == (130, "")


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
    command = penumbra_command("pose", "--watch", "--json", "--connect", endpoint)
    watch = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert watch.stdout is not None and watch.stderr is not None
    watch.stdout.readline()
    watch.stdout.close()
    assert watch.stderr.read() == ""
    assert watch.wait(PATIENCE_S) == 0


@pytest.mark.parametrize("command", ["topics", "doctor", "pose"])
def test_a_command_whose_reader_is_gone_ends_quietly(command, endpoint):
    asked = subprocess.Popen(
        penumbra_command(command, "--connect", endpoint), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert asked.stdout is not None
    asked.stdout.close()
    assert (asked.communicate(timeout=PATIENCE_S)[1], asked.returncode) == ("", 0)


@pytest.mark.parametrize("argv", [["topics"], ["--help"], ["pose", "--json"]])
def test_output_that_cannot_be_written_is_one_line_and_no_traceback(argv, endpoint):
    argv = [*argv, "--connect", endpoint] if argv[0] == "pose" else argv
    command = penumbra_command(*argv)
    with open("/dev/full", "w") as full:
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    told = f"penumbra {argv[0].strip('-')}: the output cannot be written: No space left on device\n"
    assert (result.returncode, result.stderr) == (1, told)


def test_a_long_command_whose_output_is_piped_reports_how_far_it_is(capsys):
    assert list(progress.track("abc", "letters")) == ["a", "b", "c"]
    assert capsys.readouterr().err == "letters: 0 of 3\nletters: 3 of 3\n"


def test_doctor_says_which_models_may_be_fetched_beside_what_is_installed(tmp_path, monkeypatch):
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path))
    (missing,) = doctor._landmarks()
    assert missing.status == "ok" and "penumbra segmentation models" in missing.mend
    for name in landmarks.FILES:
        path = landmarks.kept() / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"")
    (there,) = doctor._landmarks()
    assert there.status == "ok" and not there.mend and str(tmp_path) in there.text


def test_doctor_finds_nothing_to_repair_on_a_healthy_installation(endpoint, capsys):
    assert cli.main(["doctor", "--connect", endpoint]) == 0
    out = capsys.readouterr().out
    assert "has no weights" not in out and "fail" not in out
    assert f"ok   router at {endpoint}" in out
