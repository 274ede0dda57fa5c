"""The `penumbra` command. Each subcommand imports only what it needs: fusion starts without torch, `pose` at once."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from shared.contract import processes
from shared.contract.processes import PROCESSES, Process
from shared.runtime.logs import FULL


@dataclass(frozen=True)
class Command:
    """A command that is no service. `about`: the line of `penumbra --help`; `function`: `MODULE:FUNCTION`, called with the
    arguments that follow; `extra`: what it needs of `pip install -e '.[EXTRA]'`."""

    about: str
    function: str
    extra: str = "all"


STEERING = {
    "up": Command("start every process of a cell with a router, and show what they do", "services.launcher.up:main"),
    "restart": Command(
        "restart services of the running `penumbra up`, one after another, without losing the pose",
        "services.command.steer:restart",
    ),
    "scale": Command("change the number of replicas of a service of the running `penumbra up`", "services.command.steer:scale"),
}
LOOKING = {
    "pose": Command("print the current pose", "services.command.look:pose"),
    "topics": Command("list the topics, and with --hz what really arrives", "services.command.look:list_topics"),
    "sim": Command("steer the emulator: occlude, motion, pause, resume, speed, skin, state", "services.command.look:sim"),
    "snapshot": Command("write a picture of the cell and its pose", "services.command.snapshot:main"),
    "bench": Command("run a benchmark", "services.command.cli:bench", extra="test"),
    "certs": Command("make certificates for a cell on a network", "services.command.certs:main", extra="certs"),
    "doctor": Command("check this machine and say how to mend it", "services.command.doctor:main"),
}
COMMANDS: dict[str, Command | Process] = {
    **STEERING,
    **{process.name: process for process in PROCESSES},
    **LOOKING,
}
"""Everything that `penumbra` can be followed by, in the order of its help. Processes come from their table."""


def main(argv: list[str] | None = None) -> int:
    """Runs `penumbra ARGV...` and returns the exit code: 0 well, 1 failed, 2 asked for something that is not there."""
    argv = sys.argv[1:] if argv is None else argv
    is_help = not argv or argv[0] in ("-h", "--help", "help")
    command, rest = ("help", []) if is_help else (argv[0], argv[1:])
    if not is_help and command not in COMMANDS:
        print(f"penumbra: no command {command!r}: one of {', '.join(COMMANDS)} expected", file=sys.stderr)
        return 2
    try:
        code = _help(bool(argv)) if is_help else _run(command, rest)
        sys.stdout.flush()
        return code
    except ImportError as error:
        return _explain_import(command, rest, error)
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


def _run(command: str, argv: list[str]) -> int:
    tool = processes.tool(command, argv[0]) if argv else None
    found = tool or COMMANDS[command]
    if isinstance(found, Process):
        from services import run

        return run.serve(command, argv)
    module, _, function = found.function.partition(":")
    call: Callable[[list[str]], int | None] = getattr(importlib.import_module(module), function)
    return call(argv[1:] if tool else argv) or 0


def _discard_output() -> None:
    """Nobody takes what is still to be written: Python would complain of it at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def bench(argv: list[str]) -> int:
    """`penumbra bench NAME`"""
    folder = Path(__file__).parents[2] / "tests" / "bench"
    names = sorted(path.stem for path in folder.glob("*.py") if path.stem != "__init__")
    if not argv or argv[0] not in names:
        print(f"penumbra bench: one of {', '.join(names) or '(none installed)'} expected", file=sys.stderr)
        return 2
    return importlib.import_module(f"tests.bench.{argv[0]}").main(argv[1:]) or 0


def _help(is_asked: bool) -> int:
    print(_usage())
    return 0 if is_asked else 2


def _usage() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:{width}}  {command.about}" for name, command in COMMANDS.items())
    return f"usage: penumbra COMMAND [--help] ...\n\nTracks a forearm beside a robot, also while something hides it.\n\n{rows}"


def _complain(command: str, line: str) -> None:
    from shared.runtime import logs

    if logs.is_json():
        logs.get(command).error(line)
    else:
        print(f"penumbra {command}: {line}", file=sys.stderr)


def _is_ours(error: Exception) -> bool:
    """Whether the text of an error already says what was expected, what came and what to do."""
    from shared.cell.description import CellError
    from shared.runtime.bus import BusError, Refused

    return isinstance(error, BusError | Refused | CellError | FileNotFoundError)


def _explain_import(command: str, argv: list[str], error: ImportError) -> int:
    """Names the extra that installs what is missing; an error in our own code is not explained away."""
    name = (error.name or "").partition(".")[0]
    if not name or (name in ("services", "shared", "sim") and error.name != f"services.{command}"):
        raise error
    if error.name == f"services.{command}":
        print(f"penumbra {command}: not part of this installation", file=sys.stderr)
        return 2
    tool = processes.tool(command, argv[0]) if argv else None
    extra = (tool or COMMANDS[command]).extra
    words = f"{command} {tool.name}" if tool else command
    print(f"penumbra {words}: {name} is not installed: pip install -e '.[{extra}]'", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
