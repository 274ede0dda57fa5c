"""Common parts of all benchmarks: the flag --json and its file, the description of a run, and tables on the screen and as
Markdown.

A benchmark has a function `tables` that makes all that is shown of a result, of its JSON alone. The screen and the pages of
docs/results (`tests.bench.lib.published`) show the same parts.
"""

from __future__ import annotations

import json
import os
import platform
import re
import shlex
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table
from rich.text import Text

from penumbra.services import flags

ROOT = Path(__file__).resolve().parents[3]
"""Root folder of the checkout."""
WIDTH = 250
"""Width [columns] of output that does not go to a terminal: the widest table needs it."""

Result = dict[str, Any]
Part = Table | str
"""A table, or a line of text, in rich's markup."""
Tables = Callable[[Result], Sequence[Part]]


# ---- the JSON file


def file(text: str) -> Path:
    """Type of a flag: a file that can be written. Raises ValueError at once: a benchmark may take an hour until it writes."""
    path = Path(text)
    if path.exists() and not path.is_file():
        raise ValueError(f"expected the name of a file, got {text!r}, which is something else; choose another name")
    if not path.parent.is_dir():
        raise ValueError(f"expected a file in a folder that exists, got {text!r}; create the folder {path.parent}")
    _write_to(path.parent)
    return path


def folder(text: str) -> Path:
    """Type of a flag: a folder that can be written; it is created where there is none. Raises ValueError."""
    path = Path(text)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"expected a folder that can be made, got {text!r} ({error.strerror}); choose another one") from None
    _write_to(path)
    return path


def _write_to(path: Path) -> None:
    try:
        tempfile.TemporaryFile(dir=path).close()
    except OSError as error:
        raise ValueError(
            f"expected a folder that can be written to, got {str(path)!r} ({error.strerror}); choose another one"
        ) from None


def write(path: Path, data: Any) -> None:
    """Writes JSON atomically: the file is always the old one or the new one, never a part of it."""
    partial = path.with_name(f"{path.name}.part")
    partial.write_text(json.dumps(data, indent=1) + "\n")
    partial.replace(path)


class Report:
    """The result of the running benchmark, and the file for it, if any. result: None until one is saved."""

    def __init__(self, path: Path | None):
        self.run, self._path = run(), path
        self.result: Result | None = None

    def save(self, result: Result) -> None:
        """Keeps a result with the key `run`, also in the file. May be called again with more of it."""
        self.result = json.loads(json.dumps({**result, "run": self.run}))
        if self._path:
            write(self._path, self.result)

    def show(self, tables: Tables) -> None:
        """Prints what was saved last."""
        if self.result is not None:
            show(tables(self.result))


def benchmark(
    name: str, about: str, tables: Tables, *params: click.Parameter, example: str
) -> Callable[[Callable[[flags.Options, Report], int | None]], flags.Command]:
    """Makes the command `penumbra bench NAME` of a function that saves its result in a report and returns the exit code, None
    for 0. What was saved is shown at the end, also after an error. Otherwise as `flags.command`."""

    def make(function: Callable[[flags.Options, Report], int | None]) -> flags.Command:
        option = flags.Option("--json", type=file, metavar="FILE", help="write the numbers to this file")

        @flags.command(f"bench {name}", about, *params, option, example=example)
        def main(options: flags.Options) -> int | None:
            report = Report(options.json)
            try:
                return function(options, report)
            finally:
                report.show(tables)

        return main

    return make


# ---- description of a run


def run() -> dict[str, Any]:
    """Describes the running command: how it was called, what ran, when and on what. commit: None outside a checkout; modified:
    whether the checkout differs from it, apart from documents."""
    context = click.get_current_context()
    commit = _git("rev-parse", "--short", "HEAD") if _git("rev-parse", "--show-toplevel") == str(ROOT) else None
    return {
        "command": command_line(f"penumbra {context.command.name}", flags.words()),
        "seed": context.params["seed"],
        "commit": commit,
        "modified": commit is not None and _git("status", "--porcelain", "--", ":(exclude)docs", ":(exclude)*.md") != "",
        "date": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
    }


def command_line(name: str, words: Sequence[str]) -> str:
    """A command as it was typed, with paths reduced to their last part."""
    return shlex.join([*name.split(), *(re.sub(r"[^\s=]*/(?=[^/])", "", word) for word in words)])


def processor() -> str:
    """The processor's model, or its architecture where the system does not report it."""
    found = re.search(r"^model name\s*: (.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return found[1].strip() if found else platform.machine()


def _git(*words: str) -> str | None:
    """The output of git about the checkout; None where there is no git, or no checkout."""
    try:
        done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


# ---- tables


def marked(text: str, is_met: bool) -> str:
    """A value; one that misses its goal is red on the screen and bold on a page."""
    return text if is_met else f"[bold red]{text}[/]"


def show(parts: Sequence[Part]) -> None:
    """Prints tables and lines."""
    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, WIDTH)
    for part in parts:
        console.print(part, highlight=False)


def markdown(parts: Sequence[Part]) -> str:
    """The same tables and lines as Markdown."""
    return "\n\n".join(_line(part) if isinstance(part, str) else _table(part) for part in parts)


def _table(table: Table) -> str:
    columns = [[_cell(column.header), *map(_cell, column.cells)] for column in table.columns]
    head, *rows = (f"| {' | '.join(cells)} |" for cells in zip(*columns, strict=True))
    lines = "\n".join([head, f"|{'---|' * len(columns)}", *rows])
    around = [f"*{_line(table.title)}*" if table.title else "", lines, _line(table.caption) if table.caption else ""]
    return "\n\n".join(filter(None, around))


def _cell(cell: Any) -> str:
    return _line(cell).replace("\n", " ").replace("|", "\\|")


def _line(text: Any) -> str:
    """Markup of rich as Markdown: text with any style is bold."""
    text = text if isinstance(text, Text) else Text.from_markup(text)
    out, done = "", 0
    for span in sorted(text.spans, key=lambda span: span.start):
        out += f"{text.plain[done : span.start]}**{text.plain[span.start : span.end]}**"
        done = span.end
    return out + text.plain[done:]
