"""The one table of processes: what is not derived from it agrees with it, and a new row is enough for a new service."""

import ast
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

from penumbra.services import flags
from penumbra.services.command import cli, doctor
from penumbra.services.launcher import launch, up
from penumbra.shared.contract import access, topics
from penumbra.shared.contract.processes import LAUNCHER, PROCESSES, REPORTING, ROUTER, find
from penumbra.tests.support.live import free_port

ROOT = Path(__file__).parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DECLARED = PROJECT["project"]["optional-dependencies"]


def of_extra(extra, line):
    """A requirement of an extra as a package's metadata have it; it may have a marker of its own."""
    requirement, _, marker = line.partition(";")
    return f"{requirement}; {f'({marker}) and ' if marker else ''}extra == '{extra}'"


EXTRAS = doctor.requirements(
    [*PROJECT["project"]["dependencies"], *(of_extra(extra, line) for extra, lines in DECLARED.items() for line in lines)]
)
NAMES = [process.name for process in PROCESSES]
TOOLS = {
    f"{process.name} {tool.name}": (tool.function.partition(":")[0], tool.extra)
    for process in PROCESSES
    for tool in process.tools
}
COMMANDS = {
    **{process.name: (process.module, process.extra) for process in PROCESSES},
    **TOOLS,
    **{
        name: (command.function.partition(":")[0], command.extra)
        for name, command in cli.COMMANDS.items()
        if isinstance(command, cli.Entry)
    },
}
"""Everything that can be run, with its module and the extra that it needs."""


def test_no_service_imports_another_one_and_the_contract_names_them_all():
    contracts = PROJECT["tool"]["importlinter"]["contracts"]
    (contract,) = (each for each in contracts if each["type"] == "independence")
    assert sorted(contract["modules"]) == sorted(f"penumbra.services.{name}" for name in NAMES)


def test_every_process_has_a_stage_in_the_dockerfile_with_its_own_folder_and_extra():
    text = (ROOT / "docker" / "Dockerfile").read_text()
    stages = dict(re.findall(r"^FROM base AS (\w+)\n(.*?)(?=^FROM|\Z)", text, re.MULTILINE | re.DOTALL))
    assert sorted(stages) == sorted(NAMES)
    for process in PROCESSES:
        stage = stages[process.name]
        assert "COPY penumbra penumbra\n" in stage
        assert f"COPY services/{process.name} services/{process.name}\n" in stage
        assert f'CMD ["{process.name}"]' in stage
        assert ("COPY sim sim\n" in stage) == process.imports_sim, process.name
        assert (f"RUN pip install '.[{process.extra}]'\n" in stage) == bool(DECLARED[process.extra]), process.name


@pytest.mark.parametrize("file", ["compose.yaml", "docker/secure.yaml"])
def test_compose_runs_the_processes_that_the_table_says(file):
    services = yaml.safe_load(re.sub(r"!override ", "", (ROOT / file).read_text()))["services"]
    assert set(services) - {"zenohd"} == {process.name for process in PROCESSES if process.in_compose}
    for process in PROCESSES:
        service = services.get(process.name, {})
        assert service.get("build", {}).get("target", process.name) == process.name
        assert service.get("deploy", {}).get("replicas", process.replicas) == process.replicas
    if file == "compose.yaml":
        with_replicas = {name for name, service in services.items() if "deploy" in service}
        assert with_replicas == {process.name for process in PROCESSES if process.in_compose and process.replicas > 1}


def test_publishers_and_queryables_are_those_of_processes_in_the_table():
    names = {access.DRIVER, *(process.name for process in REPORTING)}
    assert {name for topic in topics.TOPICS for name in topic.publishers} <= names
    assert sorted(name for process in REPORTING for name in process.answers) == sorted(topics.QUERYABLES)
    assert find("launcher") is LAUNCHER and find("nobody") is None and ROUTER.name == "router"


@pytest.mark.parametrize("process", PROCESSES, ids=NAMES)
def test_a_flag_that_up_passes_on_is_one_of_the_service_with_the_same_choices(process):
    own = {option.name: option for option in __import__(process.module, fromlist=["FLAGS"]).FLAGS}
    for flag in process.flags:
        expected = flags.Option("--x", type=flag.type, choices=flag.choices).type
        assert type(own[flag.name].type) is type(expected)
        assert sorted(getattr(own[flag.name].type, "choices", ())) == sorted(flag.choices)


@pytest.mark.parametrize("process", [process for process in PROCESSES if process.trained_by], ids=lambda process: process.name)
def test_a_trained_service_names_the_tool_that_makes_its_weights(process):
    assert process.trained_by in {tool.name for tool in process.tools}
    assert list((ROOT / "services" / process.name / "weights").glob("*.npz"))


def test_weights_lie_only_where_the_table_says_that_something_is_trained():
    assert {path.parent.name for path in (ROOT / "services").glob("*/weights")} == {p.name for p in PROCESSES if p.trained_by}


@pytest.mark.parametrize("command", COMMANDS)
def test_the_extra_of_a_command_installs_all_that_its_modules_import(command):
    """What modules import at their top: what functions import they may do without."""
    module, extra = COMMANDS[command]
    packages = importlib.metadata.packages_distributions()
    needed = {normal(packages[name][0]) for name in foreign_imports(module)}
    installed = {normal(name) for name in [*doctor.closure("", EXTRAS), *doctor.closure(extra, EXTRAS)]}
    assert needed <= installed, f"'.[{extra}]' does not install them"


def foreign_imports(module):
    """The packages of others that a module of ours and all that it imports of ours import."""
    found, waiting, seen = set(), [module], set()
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        if name.partition(".")[0] == "penumbra":
            waiting += [name.rpartition(".")[0], *top_level_imports(name)]
        elif name:
            found.add(name.partition(".")[0])
    return found - set(sys.stdlib_module_names)


def top_level_imports(module):
    """The modules that a module of ours imports at its top; of none that there is not: `from X import Y` may name a function."""
    path = ROOT / Path(*module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    if not path.is_file():
        return
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def test_extras_that_name_others_install_what_those_do():
    lines = ["numpy>=2", 'penumbra[b]; extra == "a"', "numba<1,>=0.60; extra == 'b'", "ruamel.yaml>=0.18 ; extra == 'b'"]
    needed = doctor.requirements(lines)
    assert (doctor.closure("", needed), doctor.closure("a,b", needed)) == (["numpy"], ["numba", "ruamel.yaml"])


@pytest.mark.parametrize("command", ["haptics train", "segmentation train", "skin model"])
def test_a_tool_that_lacks_a_package_names_the_extra_that_installs_it_for_the_tool(command):
    code = "import sys; sys.modules['torch'] = None; from penumbra.services.command.cli import main; sys.exit(main(sys.argv[1:]))"
    out = subprocess.run([sys.executable, "-c", code, *command.split()], capture_output=True, text=True)
    hint = f"penumbra {command}: torch is not installed: pip install -e '.[{TOOLS[command][1]}]'"
    assert (out.returncode, out.stderr.splitlines()[-1]) == (2, hint)


# ---- a new service

ROW = """
    Process(
        "echo",
        "repeats what it receives",
        extra="router",
        flags=(Flag("volume", "of the echo", choices=("low", "high")),),
        tools=(Tool("loud", "loudly", "penumbra.services.echo.loud:main", extra="router"),),
        trained_by="loud",
        answers=("current_pose",),
        in_compose=False,
    ),
)
"""
SERVICE = '''"""Repeats what it receives."""

from penumbra.services import flags
from penumbra.shared.contract.topics import FUSED

NAME = "echo"


FLAGS = (flags.Option("--volume", choices=("low", "high"), default="low"),)


def start(node, options):
    node.log.info("echoes", volume=options.volume)
    node.every(0.1, lambda: None)
'''


TOOL = '''"""Echoes."""

from penumbra.services import flags


@flags.command("echo loud", "Echoes.", flags.Argument("word", help="what is echoed"), example="penumbra echo loud hello")
def main(options):
    print("ECHO", options.word)
'''


@pytest.fixture(scope="module")
def with_echo(tmp_path_factory):
    """A copy of the house with one more row in the table and one more folder: nothing else is touched."""
    root = tmp_path_factory.mktemp("house")
    shutil.copytree(ROOT / "penumbra", root / "penumbra", ignore=shutil.ignore_patterns("__pycache__", "tests"))
    table = root / "penumbra" / "shared" / "contract" / "processes.py"
    before, after = table.read_text().split("\n)\n\nLAUNCHER = ")
    table.write_text(f"{before}{ROW}\nLAUNCHER = {after}")
    own = root / "penumbra" / "services" / "echo"
    own.mkdir()
    (own / "__init__.py").write_text('"""Repeats what it receives."""\n')
    (own / "service.py").write_text(SERVICE)
    (own / "loud.py").write_text(TOOL)
    return root


def run_in(root, *argv):
    environment = {**os.environ, "PYTHONPATH": str(root)}
    command = [sys.executable, "-P", "-m", "penumbra", *argv]
    return subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, timeout=60)


def test_a_new_service_is_in_the_help_and_its_tools_and_flags_work(with_echo):
    assert "  echo          repeats what it receives (also: loud)\n" in run_in(with_echo, "--help").stdout
    assert run_in(with_echo, "echo", "loud", "hello").stdout == "ECHO hello\n"
    assert "--volume [low|high]" in run_in(with_echo, "up", "--help").stdout
    assert "Repeats what it receives." in run_in(with_echo, "echo", "--help").stdout


def test_a_new_service_is_allowed_to_answer_and_report_on_a_secured_bus(with_echo):
    code = "import json; from penumbra.shared.contract import access; print(json.dumps(access.control()))"
    rules = json.loads(subprocess.run([sys.executable, "-c", code], cwd=with_echo, capture_output=True, text=True).stdout)
    (answers,) = (rule for rule in rules["rules"] if rule["id"] == "echo answers")
    assert answers["key_exprs"] == [topics.health("*", "echo"), topics.current_pose("*", "*")]
    assert "echo" in [subject["id"] for subject in rules["subjects"]]


def test_the_doctor_looks_after_a_new_service(with_echo):
    out = run_in(with_echo, "doctor", "--connect", f"tcp/127.0.0.1:{free_port()}").stdout
    assert "fail echo has no weights -> penumbra echo loud" in out


def test_up_starts_a_new_service_with_its_flags(with_echo):
    others = [f"--replicas={process.name}=0" for process in PROCESSES if process.replicas and process is not ROUTER]
    for seconds in ("4", "30"):  # where a busy machine is not through with the start by then
        out = run_in(with_echo, "up", "--port", str(free_port()), "--seconds", seconds, "--volume", "high", *others)
        if "echo running" in out.stdout:
            break
    assert "echo: echoes volume=high" in out.stderr
    assert "echo running" in out.stdout
    assert out.returncode == 0


def test_there_is_one_way_to_a_command_line():
    folders = ("services", "shared", "sim", "tests/bench")
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    assert len(paths) > 100
    assert not [path for path in paths if "argparse" in path.read_text()]


def test_up_starts_a_recorder_where_it_is_asked_to_and_gives_it_the_file():
    def recorders(*words):
        options = flags.parse(up.PARAMS, words)
        return [p.command[-2:] for p in launch.fleet(launch.cells.load("table"), options).processes if p.service == "record"]

    assert recorders("--seed", "1") == []
    assert recorders("--record", "run.mcap") == [["--out", "run.mcap"]]
    assert recorders("--record", "--seed", "1") == [["--out", "."]]


def test_up_takes_part_in_ros_where_it_is_asked_to_and_says_where_its_router_is():
    def participants(*words):
        options = flags.parse(up.PARAMS, words)
        return [p.command[-2:] for p in launch.fleet(launch.cells.load("table"), options).processes if p.service == "ros2"]

    assert participants("--port", "7448") == []
    assert participants("--port", "7448", "--ros2") == [["--ros-connect", "tcp/127.0.0.1:7447"]]
    assert participants("--ros2", "tcp/127.0.0.1:7448") == [["--ros-connect", "tcp/127.0.0.1:7448"]]


def test_up_gives_every_flag_of_the_table_to_its_process():
    options = flags.parse(up.PARAMS, ["--observer", "paper", "--method", "paper", "--seed", "7", "--port", "7"])
    commands = {process.service: process.command for process in launch.fleet(launch.cells.load("table"), options).processes}
    for name, words in {"fusion": ["--observer", "paper"], "search": ["--method", "paper"], "emulator": ["--seed", "7"]}.items():
        assert commands[name][-2:] == words
