"""Parts of the command line: commands, flags and the types of their values. click parses, helps and completes."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, NoReturn

import click
from click.shell_completion import CompletionItem

from penumbra.shared.cell import BUILT_IN, DEFAULT
from penumbra.shared.contract.processes import PROCESSES
from penumbra.shared.runtime import logs

if TYPE_CHECKING:
    from penumbra.shared.runtime.metrics import Reports

Options = SimpleNamespace
"""The values of a command's flags and arguments, by name."""
ROUTER = "tcp/127.0.0.1:7447"
"""Default router, as shown by help; `shared.runtime.connection` has it too, but is slow to import."""
COMMAND_LINE = click.core.ParameterSource.COMMANDLINE
WIDTH = 100
"""Columns of help on a wide terminal."""


# ---- types of values


class Checked(click.ParamType):
    """A type from a function that returns the value of a text, or raises ValueError that says what was expected."""

    def __init__(self, convert: Callable[[str], Any]):
        self.name = convert.__name__.strip("_")
        self._convert = convert

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):  # a default
            return value
        try:
            return self._convert(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)


class Choice(click.Choice):
    """A type with a fixed set of words."""

    def get_invalid_choice_message(self, value: Any, ctx: click.Context | None) -> str:
        return f"expected {any_of(self.choices)}, got {value!r}{meant(str(value), self.choices)}"


def integer(text: str) -> int:
    """Type of a flag: a whole number."""
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"expected a whole number, got {text!r}") from None


def number(text: str) -> float:
    """Type of a flag: a finite number."""
    return _number(text, math.isfinite, "a number")


def port(text: str) -> int:
    """Type of a flag: a TCP port."""
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise ValueError(f"expected a port from 1 to 65535, got {text!r}")
    return int(text)


def seconds(text: str) -> float:
    """Type of a flag: a time [s] above 0, or inf."""
    return _number(text, lambda value: value > 0, "a time above 0, in seconds")


def above_zero(text: str) -> float:
    """Type of a flag: a finite number above 0."""
    return _number(text, lambda value: 0 < value < math.inf, "a number above 0")


def natural(text: str) -> int:
    """Type of a flag: a count, which may be 0."""
    if not text.isdecimal():
        raise ValueError(f"expected a whole number from 0, got {text!r}")
    return int(text)


def positive(text: str) -> int:
    """Type of a flag: a count of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"expected a whole number from 1, got {text!r}")
    return int(text)


def folder(text: str) -> Path:
    """Type of a flag: a folder to write to, which is made where it is missing."""
    _no_file_at(Path(text), "a folder to write to")
    return Path(text)


def output(text: str) -> Path:
    """Type of a flag: a file to write, whose folder is made where it is missing."""
    path = Path(text)
    if path.is_dir():
        raise ValueError(f"expected a file to write, got the folder {text}; add the file's name")
    _no_file_at(path.parent, "a file to write in a folder")
    return path


def _no_file_at(folder: Path, what: str) -> None:
    for place in (folder, *folder.parents):
        if place.exists() and not place.is_dir():
            raise ValueError(f"expected {what}, got {place}, which is a file; give another name")


def _number(text: str, is_good: Callable[[float], bool], what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not is_good(value):  # a comparison with nan is false
        raise ValueError(f"expected {what}, got {text!r}")
    return value


def address(text: str) -> tuple[str, int]:
    """Type of a flag: an address to listen at, and a port; the default address is loopback."""
    host, _, digits = text.rpartition(":")
    try:
        return host.strip("[]") or "127.0.0.1", port(digits)
    except ValueError:
        raise ValueError(f"expected a port from 1 to 65535, or ADDRESS:PORT as in 0.0.0.0:9464, got {text!r}") from None


TYPES: dict[Any, click.ParamType] = {
    int: Checked(integer),
    float: Checked(number),
    Path: click.Path(path_type=Path),
    str: click.STRING,
}


# ---- flags and arguments


class Option(click.Option):
    """A flag, as in `Option("--seed", type=int, default=1, help=...)`.

    `type`: int, float, Path, str or a function that raises ValueError; `choices`: the allowed words; `takes`: the number of
    words, `one`, `many` (all that follow, up to the next flag), `rest` (all that follow, including flags) or `maybe` (one of its
    type, or none, which stands for `without`); `section`: the heading under which help shows it.
    """

    def __init__(
        self,
        *names: str,
        type: Any = None,
        choices: Iterable[Any] = (),
        takes: Literal["one", "many", "rest", "maybe"] = "one",
        without: str = "",
        section: str = "Options",
        **kwargs: Any,
    ):
        self.takes, self.without, self.section = takes, without, section
        choices = tuple(choices)
        if not kwargs.get("is_flag") and not (any("/" in name for name in names)):
            kwargs["type"] = Choice(choices) if choices else TYPES.get(type or str) or Checked(type)
        if takes in ("many", "rest"):
            kwargs["multiple"] = True
        super().__init__(names, **kwargs)


class Argument(click.Argument):
    """A word without a flag; `help` describes it."""

    def __init__(self, name: str, *, help: str, type: Any = None, choices: Iterable[Any] = (), **kwargs: Any):
        choices = tuple(choices)
        kind = Choice(choices) if choices else TYPES.get(type or str) or Checked(type)
        super().__init__([name], type=kind, help=help, **kwargs)


def spread(params: Iterable[click.Parameter], args: Sequence[str]) -> list[str]:
    """The words of a command line, with every flag that takes several words repeated for each word, because click does not
    support such flags."""
    takes = {name: param for param in params if isinstance(param, Option) and param.takes != "one" for name in param.opts}
    out: list[str] = []
    rest = list(args)
    while rest:
        word = rest.pop(0)
        flag = takes.get(word)
        if flag is None:
            out.append(word)
        elif flag.takes == "maybe":
            out.append(f"{word}={rest.pop(0) if rest and _is_value(flag, rest[0]) else flag.without}")
        else:
            values = []
            while rest and (flag.takes == "rest" or not _is_flag(rest[0])):
                values.append(rest.pop(0))
            # a flag without a word becomes `without` if it has one; for the others click reports the missing word
            out += [f"{word}={value}" for value in values] or ([f"{word}={flag.without}"] if flag.without else [word])
    return out


def _is_value(flag: Option, word: str) -> bool:
    """Whether a word belongs to the flag before it, whose word is optional. A bad number does, and is refused there."""
    if _is_flag(word) or _is_number(word):
        return _is_number(word)
    try:
        flag.type.convert(word, flag, None)
    except click.BadParameter:
        return False
    return True


def _is_flag(word: str) -> bool:
    return len(word) > 1 and word[0] == "-" and not _is_number(word)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


# ---- commands


class _Words(click.Command):
    """Common base of commands and groups: spread words, help with sections and an example."""

    example: str

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.meta["words"] = list(args)
        return super().parse_args(ctx, spread(self.get_params(ctx), args))

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        sections: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            if not isinstance(param, Argument) and (record := param.get_help_record(ctx)) is not None:
                sections.setdefault(getattr(param, "section", "Options"), []).append(record)
        for title, rows in sections.items():
            with formatter.section(title):
                formatter.write_dl(rows)
        if isinstance(self, click.Group):
            self.format_commands(ctx, formatter)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        if self.example:
            with formatter.section("Example"):
                for line in self.example.splitlines():
                    formatter.write(f"{' ' * formatter.current_indent}{line}\n")


class Command(_Words):
    """A command of `penumbra`. A call with a list of words runs it and returns its exit code; invalid words end the process with
    exit code 2."""

    def __init__(self, name: str, example: str, **kwargs: Any):
        super().__init__(name, context_settings=SETTINGS, **kwargs)
        self.example = example

    def __call__(self, argv: Sequence[str] | None = None) -> int:  # type: ignore[override]
        try:
            return execute(self, f"penumbra {self.name}", sys.argv[1:] if argv is None else argv)
        except click.ClickException as error:
            sys.stderr.write(f"{explain(error)}\n")
            raise SystemExit(2) from None


SETTINGS: dict[str, Any] = {"show_default": True, "max_content_width": WIDTH, "help_option_names": ["-h", "--help"]}


class Group(_Words, click.Group):
    """A command with subcommands; `follows`: what a subcommand is called."""

    follows = "command"

    def __init__(self, name: str, example: str, **kwargs: Any):
        super().__init__(name, context_settings=SETTINGS, **kwargs)
        self.example = example

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if not args and not self.invoke_without_command and not ctx.resilient_parsing:
            ctx.fail(f"expected a {self.follows}, got none; choose one of {', '.join(self.list_commands(ctx))}")
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        name, known = args[0], self.list_commands(ctx)
        if name not in known and not ctx.resilient_parsing:
            choose = f"; choose one of {', '.join(known)}" if known else ""
            ctx.fail(f"expected a {self.follows}, got {name!r}{meant(name, known) or choose}")
        return super().resolve_command(ctx, args)


def command(
    name: str, about: str, *params: click.Parameter, example: str
) -> Callable[[Callable[[Options], int | None]], Command]:
    """Decorator that makes the command `penumbra NAME` from a function of its options, which returns the exit code, None for 0.
    Where the command has the flags of LOG, they are applied.

    about: the help text; line breaks within a paragraph do not matter; example: a working command line, or several lines.
    """

    def make(function: Callable[[Options], int | None]) -> Command:
        def callback(**values: Any) -> int:
            if "log_level" in values:
                logs.configure(values["log_level"], values["log_format"], name)
            return function(Options(**values)) or 0

        return Command(name, example, callback=callback, params=list(params), help=_kept(about))

    return make


def _kept(about: str) -> str:
    """A help text whose paragraphs with indented lines keep their line breaks: click refills the others."""
    paragraphs = about.strip().split("\n\n")
    return "\n\n".join(f"\b\n{text}" if "\n " in f"\n{text}" else text for text in paragraphs)


def execute(command: click.Command, prog: str, argv: Sequence[str]) -> int:
    """Run a command with these words; returns its exit code. Raises click.ClickException for invalid words."""
    try:
        with command.make_context(prog, list(argv)) as ctx:
            return int(command.invoke(ctx) or 0)
    except click.exceptions.Exit as ended:  # --help, --version
        return ended.exit_code


def parse(params: Iterable[click.Parameter], argv: Sequence[str] = ()) -> Options:
    """The options that result from these words for the flags."""
    return Options(**Command("", "", params=list(params)).make_context("penumbra", list(argv)).params)


def is_given(name: str) -> bool:
    """Whether a flag of the running command was given on its command line."""
    return click.get_current_context().get_parameter_source(name) is COMMAND_LINE


def words() -> list[str]:
    """The words after the name of the running command."""
    return list(click.get_current_context().meta["words"])


def refuse(text: str) -> NoReturn:
    """End the running command with exit code 2 and a line that says what was expected."""
    raise click.UsageError(text, click.get_current_context(silent=True))


# ---- messages about a wrong command line


def explain(error: click.ClickException) -> str:
    """One line: the command, what was expected, and where to find help."""
    path = error.ctx.command_path if isinstance(error, click.UsageError) and error.ctx else "penumbra"
    return f"{path}: {reason(error)} (see {path} --help)"


def reason(error: click.ClickException) -> str:
    """What was expected and what came, without the command."""
    match error:
        case click.NoSuchOption():
            params = error.ctx.command.get_params(error.ctx) if error.ctx else []
            word = error.option_name.lstrip("-")
            if any(isinstance(param, click.Argument) and param.name == word for param in params):
                return f"no option {error.option_name}; give the {word} without it, as a word of its own"
            known = [name for param in params if isinstance(param, click.Option) for name in param.opts]
            return f"no option {error.option_name}{meant(error.option_name, known)}"
        case click.MissingParameter() if error.param is not None:
            hint = error.param.get_error_hint(error.ctx) if error.ctx else error.param.name or ""
            return f"expected {hint.strip(chr(39))}, got nothing"
        case click.BadParameter() if isinstance(error.param, click.Option):
            name = max(error.param.opts, key=len)
            variable = error.param.envvar
            value = os.environ.get(variable, "") if isinstance(variable, str) else ""
            return f"{name}: {error.message}" + (f" in ${variable}" if value and repr(value) in error.message else "")
        case click.BadParameter() if error.param is not None:
            return f"{error.param.human_readable_name}: {error.message}"
    text = error.format_message().rstrip(".")
    return text[:1].lower() + text[1:]


def any_of(words: Iterable[str]) -> str:
    """`a`, `a or b`, `a, b or c`."""
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last


def meant(word: str, known: Iterable[str]) -> str:
    """`; did you mean X?` if a word is similar to a known one, else empty."""
    from difflib import get_close_matches

    near = get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near else ""


# ---- flags that commands share


def complete_cell(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """The built-in cells, and the shell's own completion of files for a cell file."""
    names = [path.stem for path in sorted(BUILT_IN.glob("*.yaml")) if path.stem.startswith(incomplete)]
    return [CompletionItem(name) for name in names] or [CompletionItem(incomplete, type="file")]


def complete_part(part: str) -> Callable[[click.Context, click.Parameter, str], list[CompletionItem]]:
    """Completes the names of a part of the cell that --cell names, such as `targets`."""

    def complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        import yaml

        cell = str(ctx.params.get("cell") or os.environ.get("PENUMBRA_CELL") or DEFAULT)
        path = BUILT_IN / f"{cell}.yaml"
        try:
            names = yaml.safe_load((path if path.is_file() else Path(cell)).read_text())[part]
        except (OSError, yaml.YAMLError, KeyError, TypeError):
            return []  # a completion cannot report errors
        return [CompletionItem(str(name)) for name in names if str(name).startswith(incomplete)]

    return complete


def complete_service(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """The names of the services."""
    return [CompletionItem(process.name) for process in PROCESSES if process.name.startswith(incomplete)]


_CELL: dict[str, Any] = {
    "envvar": "PENUMBRA_CELL",
    "show_envvar": True,
    "metavar": "CELL",
    "shell_complete": complete_cell,
    "help": "table, arm or a YAML file",
}
CELL = Option("--cell", default=DEFAULT, **_CELL)
RUNNING_CELL = Option(
    "--cell",
    show_default=f"the only one that runs there, else {DEFAULT}",
    **_CELL | {"help": "table, arm, a YAML file, or the name of a cell that runs there"},
)
"""CELL of commands and processes beside a running cell; its value is None where none is given."""
SECURE = Option(
    "--secure",
    type=Path,
    envvar="PENUMBRA_SECURE",
    show_envvar=True,
    metavar="FOLDER",
    section="Bus",
    help="certificates of `penumbra certs`: TLS, and every process limited to its topics",
)
BUS = (
    Option(
        "-m",
        "--mode",
        choices=("client", "peer", "router"),
        section="Bus",
        show_default="client; of router: router",
        help="Zenoh mode",
    ),
    Option(
        "-e",
        "--connect",
        multiple=True,
        metavar="ENDPOINT",
        section="Bus",
        show_default=f"$PENUMBRA_CONNECT or {ROUTER}, with --secure tls/",
        help="router to reach; may be repeated",
    ),
    Option("-l", "--listen", multiple=True, metavar="ENDPOINT", section="Bus", help="endpoint to listen on; may be repeated"),
    Option("-c", "--config", type=Path, metavar="FILE", section="Bus", help="Zenoh configuration (JSON5)"),
    SECURE,
)
LOG_LEVEL = Option("--log-level", choices=logs.LEVELS, default="info", section="Log", help="the least important lines to write")
QUIET_LOG_LEVEL = Option("--log-level", choices=logs.LEVELS, default="warning", section="Log", help=LOG_LEVEL.help)
"""LOG_LEVEL of commands that print an answer."""
LOG_FORMAT = Option(
    "--log-format",
    choices=logs.FORMATS,
    envvar="PENUMBRA_LOG_FORMAT",
    show_envvar=True,
    default="text",
    section="Log",
    help="json: one object a line",
)
LOG = (LOG_LEVEL, LOG_FORMAT)
METRICS = Option(
    "--metrics-port",
    type=address,
    envvar="PENUMBRA_METRICS_PORT",
    show_envvar=True,
    metavar="[ADDRESS:]PORT",
    help="serve metrics in Prometheus' format there; without ADDRESS on loopback",
)
JSON = Option("--json", is_flag=True, help="print JSON")
COMMON = (CELL, *BUS, *LOG)
"""Flags of every process on the bus."""
JOINING = (RUNNING_CELL, *BUS, *LOG)
"""Flags of processes that join a running cell."""
MEASURING = (CELL, *BUS, QUIET_LOG_LEVEL, LOG_FORMAT)
"""Flags of commands that need a cell file."""
LOOKING = (RUNNING_CELL, *BUS, QUIET_LOG_LEVEL, LOG_FORMAT)
"""Flags of commands that look at a running cell."""


@contextmanager
def metrics(where: tuple[str, int] | None, reports: Reports) -> Iterator[None]:
    """Context in which the metrics of `reports()` are served at the address of METRICS; none are served if it was not given."""
    if where is None:
        yield
        return
    from penumbra.shared.runtime import metrics

    try:
        server = metrics.serve(*where, reports)
    except OSError as error:
        refuse(f"--metrics-port {where[0]}:{where[1]} cannot be opened ({error.strerror or error}): give another one")
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
