"""The flags that all commands share."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NoReturn

from shared.runtime import bus, logs

if TYPE_CHECKING:
    from shared.runtime.metrics import Reports


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line that says what to do, and which takes no abbreviated flags: they would hide mistakes."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"allow_abbrev": False, **kwargs})

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def parser(command: str, about: str) -> Parser:
    """A parser for `penumbra COMMAND` with the cell, the bus and the log."""
    out = Parser(prog=f"penumbra {command}", description=about)
    add_cell(out)
    bus.add_arguments(out)
    add_log(out)
    return out


def port(text: str) -> int:
    """Type of a flag: a TCP port."""
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise argparse.ArgumentTypeError(f"expected a port from 1 to 65535, got {text!r}")
    return int(text)


def seconds(text: str) -> float:
    """Type of a flag: a time [s] above 0, or inf."""
    return _number(text, lambda value: value > 0, "a time above 0, in seconds,")


def above_zero(text: str) -> float:
    """Type of a flag: a finite number above 0."""
    return _number(text, lambda value: 0 < value < math.inf, "a number above 0,")


def natural(text: str) -> int:
    """Type of a flag: how many, none included."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a number from 0, got {text!r}")
    return int(text)


def positive(text: str) -> int:
    """Type of a flag: how many, at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a number from 1, got {text!r}")
    return int(text)


def _number(text: str, is_good: Callable[[float], bool], what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not is_good(value):  # of nan no comparison is true
        raise argparse.ArgumentTypeError(f"expected {what} got {text!r}")
    return value


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


def add_metrics(out: argparse.ArgumentParser) -> None:
    out.add_argument(
        "--metrics-port",
        type=_metrics_port,
        default=os.environ.get("PENUMBRA_METRICS_PORT") or None,
        metavar="[ADDRESS:]PORT",
        help="serve metrics in Prometheus' format there, without ADDRESS on loopback (default: $PENUMBRA_METRICS_PORT or none)",
    )


def _metrics_port(text: str) -> tuple[str, int]:
    address, _, number = text.rpartition(":")
    try:
        return address or "127.0.0.1", port(number)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(
            f"a port from 1 to 65535, or ADDRESS:PORT as in 0.0.0.0:9464, expected, {text!r} came"
        ) from None


@contextmanager
def metrics(parser: argparse.ArgumentParser, where: tuple[str, int] | None, reports: Reports) -> Iterator[None]:
    """Within it the metrics of `reports()` are served where `add_metrics` was told to; nothing where it was not."""
    if where is None:
        yield
        return
    from shared.runtime import metrics

    try:
        server = metrics.serve(*where, reports)
    except OSError as error:
        parser.error(f"--metrics-port {where[0]}:{where[1]} cannot be opened ({error.strerror or error}): give another one")
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
