"""Structured logs on standard error: a sentence and its fields, as key=value text or as one JSON object per line.

A line of JSON is `{time, level, service, instance, message, fields}`, and `trace` where an exception is logged.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import re
import sys
import threading
from collections.abc import Iterator, MutableMapping
from datetime import UTC, datetime
from functools import partial
from typing import Any, TextIO

_TIME = re.compile(r'(?:\{"time": ")?(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z)')
_ROUTINE = re.compile(_TIME.pattern + r'(?:", "level": "| )(?:debug|info)\b')
LEVELS = ("debug", "info", "warning", "error")
FORMATS = ("text", "json")


class Log(logging.LoggerAdapter[logging.Logger]):
    """A standard logger that also takes fields: `log.info("calibrated", pad="p0", gain=1.02)`."""

    def process(self, msg: Any, kwargs: MutableMapping[str, Any]) -> tuple[Any, MutableMapping[str, Any]]:
        known = {name: kwargs[name] for name in ("exc_info", "stack_info", "stacklevel") if name in kwargs}
        fields = {
            **(self.extra or {}),
            **{name: value for name, value in kwargs.items() if name not in known and name != "extra"},
        }
        return msg, {**known, "extra": {"fields": fields}}


def get(service: str, **fields: Any) -> Log:
    """Log of a service; `fields` are added to every line."""
    return Log(logging.getLogger(f"penumbra.{service}"), fields)


def configure(level: str = "info", form: str = "text", service: str = "penumbra", ends_with_thread: bool = False) -> None:
    """Sends the logs of Penumbra to standard error, from `level` on. As JSON, other output of the process of `service` becomes a
    line of JSON too: warnings of libraries, and the exception that ends a thread or the process.

    ends_with_thread: the process ends with the first of its threads that fails, with exit code 1. Otherwise it would look alive
    and do only a part of its work; so its supervisor restarts it. A thread that has no memory to start counts as failed.
    """
    handler = _ToStandardError()
    handler.setFormatter(_Json() if form == "json" else _Text())
    logger = logging.getLogger("penumbra")
    logger.handlers[:] = [handler]
    logger.setLevel(level.upper())
    logger.propagate = False
    if form == "json":
        logging.getLogger().handlers[:] = [handler]
        logging.captureWarnings(True)
        log = get(service)
        sys.excepthook = lambda kind, error, trace: log.error(f"{kind.__name__}: {error}", exc_info=(kind, error, trace))
    threading.excepthook = partial(_on_thread, get(service) if form == "json" else None, ends_with_thread)
    if ends_with_thread:
        sys.unraisablehook = _on_unraisable


def _on_thread(log: Log | None, ends_process: bool, failed: threading.ExceptHookArgs) -> None:
    """Hook for an exception that ends a thread. log: where it is reported, None for Python's default output."""
    try:
        if log is None:
            threading.__excepthook__(failed)
        else:
            log.error(f"{failed.exc_type.__name__}: {failed.exc_value}", exc_info=failed.exc_value or True)
    finally:  # even if there is no memory for the report
        if ends_process:
            os._exit(1)


def _on_unraisable(failed: sys.UnraisableHookArgs) -> None:
    """Hook for an exception that cannot be caught, such as that of a thread without the memory to start: its starter would wait
    forever."""
    try:
        sys.__unraisablehook__(failed)
    finally:
        if failed.exc_type is MemoryError:
            os._exit(1)


def is_json() -> bool:
    """Whether `configure` has selected JSON."""
    return any(isinstance(handler.formatter, _Json) for handler in logging.getLogger("penumbra").handlers)


def sentence(line: str) -> str:
    """Message of a log line; of a line that is not JSON, the whole line."""
    try:
        return str(json.loads(line)["message"])
    except (ValueError, TypeError, KeyError):
        return line


def is_routine(line: str) -> bool:
    """Whether a line is a log line below a warning."""
    return _ROUTINE.match(line) is not None


def time_of(line: str) -> str | None:
    """Time of a log line as text that can be sorted; None for a continuation line, as in a trace."""
    found = _TIME.match(line)
    return found[1] if found else None


FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers of a full disk."""


class Lossy:
    """Wrapper of a text stream that discards text while the disk is full, rather than raising OSError."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with lost_where_full():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with lost_where_full():
            self._stream.flush()


@contextlib.contextmanager
def lost_where_full() -> Iterator[None]:
    """Suppresses the OSError of a full disk; the data are lost."""
    try:
        yield
    except OSError as error:
        if error.errno not in FULL:
            raise


class _ToStandardError(logging.Handler):
    """Writes to the current sys.stderr, which a live table replaces."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            sys.stderr.write(self.format(record) + "\n")
        except Exception:
            self.handleError(record)


def _common(record: logging.LogRecord) -> tuple[str, str, str]:
    time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").removesuffix("+00:00") + "Z"
    return time, record.levelname.lower(), record.name.removeprefix("penumbra.")


class _Text(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        time, level, service = _common(record)
        words = "".join(f" {name}={_value(value)}" for name, value in getattr(record, "fields", {}).items() if name != "instance")
        trace = "\n" + self.formatException(record.exc_info) if record.exc_info else ""
        return f"{time} {level:7} {service}: {record.getMessage()}{words}{trace}"


class _Json(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        time, level, service = _common(record)
        fields = dict(getattr(record, "fields", {}))
        instance = fields.pop("instance", None)
        line = {"time": time, "level": level, "service": service, "instance": instance, "message": record.getMessage()}
        line["fields"] = fields
        if record.exc_info:
            line["trace"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def _value(value: Any) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return json.dumps(text) if not text or any(c.isspace() or c in '"=' for c in text) else text
