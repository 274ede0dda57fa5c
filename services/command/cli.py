"""The `penumbra` command. Each subcommand imports only what it needs: fusion starts without torch, `pose` at once."""

from __future__ import annotations

import importlib
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from penumbra.services import flags
from penumbra.shared.contract import processes
from penumbra.shared.contract.processes import PROCESSES, Process, Tool
from penumbra.shared.runtime.logs import FULL

COMPLETE = "_PENUMBRA_COMPLETE"
"""Environment variable with which a shell requests completions."""
EXIT_CODES = {
    0: "done",
    1: "failed: something that was checked or started is not well; the lines before say what",
    2: "cannot be done as asked: a flag, the cell, the router or the installation; nothing was started",
    3: "the pose is lost (pose)",
    130: "ended by Ctrl-C",
}


@dataclass(frozen=True)
class Entry:
    """A command that is not a service. `about`: the line of `penumbra --help`; `function`: `MODULE:NAME` of its `flags.Command`
    or group; `extra`: the extra of `pip install -e '.[EXTRA]'` that it needs."""

    about: str
    function: str
    extra: str = "all"


STEERING = {
    "up": Entry("start every process of a cell with a router, and show what they do", "penumbra.services.launcher.up:main"),
    "down": Entry("end a cell that runs on this machine", "penumbra.services.command.machine:down"),
    "replay": Entry(
        "play what was recorded: onto the bus, or through the methods in one process",
        "penumbra.services.replay.command:main",
        extra="record",
    ),
    "restart": Entry(
        "restart services of the running `penumbra up`, one after another, without losing the pose",
        "penumbra.services.command.steer:restart",
    ),
    "scale": Entry("change the number of replicas of a service", "penumbra.services.command.steer:scale"),
}
LOOKING = {
    "pose": Entry("print the current pose", "penumbra.services.command.look:pose"),
    "ps": Entry("show the cells of this machine and their processes", "penumbra.services.command.machine:ps"),
    "logs": Entry("print what the processes of a detached cell have logged", "penumbra.services.command.machine:logs"),
    "ls": Entry("list routers and the cells on them", "penumbra.services.command.look:list_cells"),
    "topics": Entry("list the topics, and with --hz what really arrives", "penumbra.services.command.look:list_topics"),
    "sim": Entry(
        "steer the emulator: occlude, motion, pause, resume, speed, skin, board, state", "penumbra.services.command.look:sim"
    ),
    "snapshot": Entry("write a picture of the cell and its pose", "penumbra.services.command.snapshot:main"),
    "check": Entry("check a cell file before anything starts", "penumbra.services.command.check:main"),
    "doctor": Entry("check this machine and report how to fix what is wrong", "penumbra.services.command.doctor:main"),
}
TOOLS = {
    "calibrate": Entry(
        "measure a camera's lens and where it stands, with a printed board: board, camera, hand-eye",
        "penumbra.services.calibrate.group:main",
        extra="calibrate",
    ),
    "certs": Entry("make certificates for a cell on a network", "penumbra.services.command.certs:main", extra="certs"),
    "bench": Entry("run a benchmark", "penumbra.services.command.cli:bench", extra="test"),
    "completion": Entry("print the completion of bash, zsh or fish", "penumbra.services.command.cli:completion"),
    "help": Entry("show the help of a command", "penumbra.services.command.cli:show_help"),
}
SECTIONS: dict[str, dict[str, Any]] = {
    "A cell": STEERING,
    "What it does": LOOKING,
    "Its processes, each by itself": {process.name: process for process in PROCESSES},
    "Others": TOOLS,
}
COMMANDS: dict[str, Entry | Process] = {name: entry for entries in SECTIONS.values() for name, entry in entries.items()}
"""All subcommands of `penumbra`, in the order of its help. Processes come from their table."""


def main(argv: list[str] | None = None) -> int:
    """Run `penumbra ARGV...`; returns the exit code, one of EXIT_CODES."""
    argv = sys.argv[1:] if argv is None else argv
    if COMPLETE in os.environ:
        from click.shell_completion import shell_complete

        return shell_complete(PENUMBRA, {}, "penumbra", COMPLETE, os.environ[COMPLETE])
    command = argv[0].strip("-") if argv else "help"
    try:
        code = flags.execute(PENUMBRA, "penumbra", argv or ["--help"])
        sys.stdout.flush()
        return code if argv else 2
    except click.ClickException as error:
        print(flags.explain(error), file=sys.stderr)
        return 2
    except ImportError as error:
        return _explain_import(command, argv[1:], error)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # `penumbra topics | head`
        _discard_output()
        return 0
    except Exception as error:
        if isinstance(error, OSError) and error.errno in FULL and error.filename is None:  # `penumbra pose > /dev/full`
            _discard_output()
            _complain(command, f"the output cannot be written: {error.strerror}")
            return 1
        if not _is_ours(error):
            raise
        for line in str(error).splitlines():
            _complain(command, line)
        return 2


# ---- groups, which import a command on demand


def load(function: str) -> click.Command:
    """The command named by `MODULE:NAME`."""
    module, _, name = function.partition(":")
    found: click.Command = getattr(importlib.import_module(module), name)
    return found


class Penumbra(flags.Group):
    """The command itself."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        entry = COMMANDS.get(name)
        if isinstance(entry, Process):
            return Service(entry)
        return load(entry.function) if entry else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for title, entries in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(name, _about(entry)) for name, entry in entries.items()])
        with formatter.section("Exit codes"):
            formatter.write_dl([(str(code), meaning) for code, meaning in EXIT_CODES.items()])


def _about(entry: Entry | Process) -> str:
    tools = [tool.name for tool in entry.tools] if isinstance(entry, Process) else []
    return f"{entry.about} (also: {', '.join(tools)})" if tools else entry.about


class Service(flags.Group):
    """`penumbra NAME`: runs a service, or one of its tools. The service's module, which may be slow to import, is imported only
    to run the service itself."""

    def __init__(self, process: Process):
        super().__init__(process.name, f"penumbra {process.name}", invoke_without_command=True, callback=self._serve)
        self._process = process
        self._tools: dict[str, Tool] = {tool.name: tool for tool in process.tools}

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.meta["is_tool"] = bool(args) and args[0] in self._tools
        if not ctx.meta["is_tool"]:
            module = importlib.import_module(self._process.module)
            package = importlib.import_module(module.__name__.rpartition(".")[0])
            self.help = (package.__doc__ or self._process.about).partition("\n\n")[0]
            self.example = getattr(module, "EXAMPLE", self.example)
            self.params = [*module.FLAGS, flags.METRICS, *(flags.JOINING if self._process.joins else flags.COMMON)]
        return super().parse_args(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._tools)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        return load(self._tools[name].function) if name in self._tools else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        if self._tools:
            with formatter.section("Tools"):
                formatter.write_dl([(tool.name, tool.about) for tool in self._tools.values()])

    def _serve(self, **values: Any) -> int:
        ctx = click.get_current_context()
        if ctx.meta["is_tool"]:
            return 0
        from penumbra.services import run

        options = flags.Options(**values)
        if options.cell is None:
            from penumbra.services.command import look

            options.cell = look.file_of(options, self._process.name)
        return run.serve(self._process, options, flags.words())


class Bench(flags.Group):
    """`penumbra bench NAME`: the modules of the folder of benchmarks."""

    follows = "benchmark"
    FOLDER = Path(__file__).parents[2] / "tests" / "bench"

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(path.stem for path in self.FOLDER.glob("*.py") if path.stem != "__init__")

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        return load(f"penumbra.tests.bench.{name}:main") if name in self.list_commands(ctx) else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Benchmarks"):
            formatter.write_dl([(name, self._first_line(name)) for name in self.list_commands(ctx)])

    def _first_line(self, name: str) -> str:
        """First line of the module's docstring, without the slow import."""
        with (self.FOLDER / f"{name}.py").open() as file:
            return file.readline().strip().strip('"').partition(": ")[2]


PENUMBRA = Penumbra(
    "penumbra",
    "penumbra up --cell table        # and in another terminal:\npenumbra pose --wait",
    help="Tracks a person's forearm beside a robot, also while something hides it: camera and capacitive skin, fused.",
    params=[
        click.Option(
            ["--version"],
            is_flag=True,
            is_eager=True,
            expose_value=False,
            callback=lambda ctx, param, value: _show_version(ctx) if value and not ctx.resilient_parsing else None,
            help="Show the version and exit.",
        )
    ],
)
bench = Bench(
    "bench",
    "penumbra bench live --seconds 30 --json live.json",
    help="Runs a benchmark. Here --json FILE writes the numbers to a file.",
)


def _show_version(ctx: click.Context) -> None:
    import importlib.metadata

    try:
        print(f"penumbra {importlib.metadata.version('penumbra')}")
    except importlib.metadata.PackageNotFoundError:
        print("penumbra, not installed: pip install -e '.[all]'")
    ctx.exit()


@flags.command(
    "completion",
    "Prints the script that lets a shell complete commands, flags, cells, targets and services.",
    flags.Argument("shell", choices=("bash", "zsh", "fish"), help="the shell that reads it"),
    example='eval "$(penumbra completion bash)"                                            # in ~/.bashrc\n'
    'eval "$(penumbra completion zsh)"                                             # in ~/.zshrc\n'
    "penumbra completion fish > ~/.config/fish/completions/penumbra.fish",
)
def completion(options: flags.Options) -> None:
    """Print click's completion script."""
    from click.shell_completion import get_completion_class

    kind = get_completion_class(options.shell)
    assert kind is not None, options.shell
    print(kind(PENUMBRA, {}, "penumbra", COMPLETE).source())


@flags.command(
    "help",
    "Shows the help of a command.",
    flags.Argument("command", nargs=-1, help="a command, and what follows it"),
    example="penumbra help pose\npenumbra help search refine",
)
def show_help(options: flags.Options) -> int:
    """Show help, like `penumbra COMMAND --help`."""
    return flags.execute(PENUMBRA, "penumbra", [*options.command, "--help"])


# ---- error messages


def _discard_output() -> None:
    """Discard unwritten output without a reader: Python would complain about it at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _complain(command: str, line: str) -> None:
    from penumbra.shared.runtime import logs

    if logs.is_json():
        logs.get(command).error(line)
    else:
        print(f"penumbra {command}: {line}", file=sys.stderr)


def _is_ours(error: Exception) -> bool:
    """Whether the text of an error already says what was expected, what was received and what to do."""
    from penumbra.shared.cell.faults import CellError
    from penumbra.shared.recording.faults import RecordingError
    from penumbra.shared.runtime.bus import BusError, Refused

    return isinstance(error, BusError | Refused | CellError | RecordingError | FileNotFoundError)


def _explain_import(command: str, argv: list[str], error: ImportError) -> int:
    """Name the extra that installs the missing package; an error in our own code is raised as it is."""
    name = (error.name or "").partition(".")[0]
    tool = processes.tool(command, argv[0]) if argv else None
    entry = tool or COMMANDS.get(command)
    if entry is None or not name:
        raise error
    module = entry.module if isinstance(entry, Process) else entry.function
    if error.name == ".".join(module.split(".")[:3]):  # its folder, which an image of another process does not have
        print(f"penumbra {command}: not part of this installation", file=sys.stderr)
        return 2
    if name == "penumbra":
        raise error
    extra = entry.extra
    words = f"{command} {tool.name}" if tool else command
    print(f"penumbra {words}: {name} is not installed: pip install -e '.[{extra}]'", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
