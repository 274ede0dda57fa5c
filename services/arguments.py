"""The flags that all commands share."""

from __future__ import annotations

import argparse
import os
from typing import NoReturn

from shared import bus, logs


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line that says what to do."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def parser(command: str, about: str) -> Parser:
    """A parser for `penumbra COMMAND` with the cell, the bus and the log."""
    out = Parser(prog=f"penumbra {command}", description=about)
    add_cell(out)
    bus.add_arguments(out)
    add_log(out)
    return out


def add_cell(out: argparse.ArgumentParser) -> None:
    default = os.environ.get("PENUMBRA_CELL", "table")
    out.add_argument(
        "--cell", default=default, metavar="CELL", help="table, arm or a YAML file (default: $PENUMBRA_CELL or table)"
    )


def add_log(out: argparse.ArgumentParser) -> None:
    group = out.add_argument_group("log")
    group.add_argument("--log-level", choices=logs.LEVELS, default="info")
    group.add_argument(
        "--log-format",
        type=_log_format,
        default=os.environ.get("PENUMBRA_LOG_FORMAT") or "text",
        metavar="{text,json}",
        help="json: one object a line (default: $PENUMBRA_LOG_FORMAT or text)",
    )


def _log_format(text: str) -> str:
    if text not in logs.FORMATS:
        raise argparse.ArgumentTypeError(f"{' or '.join(logs.FORMATS)} expected, {text!r} came; $PENUMBRA_LOG_FORMAT too")
    return text
