"""Writes messages.md beside it from the tables of topics and messages: `python docs/messages.py`."""

from __future__ import annotations

import re
import typing
from pathlib import Path
from typing import Any

import msgspec

from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import VERSION, Array, Message
from penumbra.shared.contract.processes import LAUNCHER, PROCESSES
from penumbra.shared.runtime.guard import IDENTITY_BYTES, NUMBER_BYTES

PAGE = Path(__file__).with_suffix(".md")
HEAD = f"""# Messages

<!-- Written by docs/messages.py from the tables in shared/contract: change these, not this. -->

Every message is a MessagePack map of its fields, with `version` {VERSION}. Any MessagePack library reads it. An array
is `[dtype, shape, bytes]`, row-major, little-endian. `stamp_ns` is the time of the measurement in nanoseconds since the
epoch. Units are SI; a pose is `position` [m] and `orientation` (quaternion x, y, z, w) of the target in `frame`;
covariances are ordered x, y, z, rotation about x, y, z of that frame.

A reader refuses and counts a message with another version, an unknown or missing field, a wrong dtype or shape, a
number that is not finite or out of range, or a stamp that is too old or ahead of its clock by more than 0.5 s.

Publishers attach {IDENTITY_BYTES + NUMBER_BYTES} bytes to each message: {IDENTITY_BYTES} random ones, the same in all
messages of a publisher on a key, and a number that counts them (little-endian). Readers find losses and repetitions by
them. A program may leave the attachment out: then each of its stamps must be newer than the one before.

## Topics

| topic | key | message | rate [1/s] | stale after [s] | published by | slow link [1/s] | what |
|---|---|---|---|---|---|---|---|
"""
QUERIES = """
`penumbra topics` prints this table for a cell, `penumbra topics --hz` with what is received.

## Queries

A refusal is an error reply, whose payload is the reason as text.

| query | key | answered by | what |
|---|---|---|---|
"""


def page() -> str:
    rows = [
        f"| {topic.name} | `{topic.key}` | [{topic.message.__name__}](#{topic.message.__name__.lower()}) | {topic.rate_hz:g} | "
        f"{topic.stale_s:g} | {', '.join(topic.publishers)} | {topic.slow_hz:g} | {topic.about} |"
        for topic in topics.TOPICS
    ]
    queries = [
        f"| {name.replace('_', ' ')} | `{key}` | {_answering(name)} | {_text(getattr(topics, name))} |"
        for name, key in topics.QUERYABLES.items()
    ]
    queries += [f"| health | `{topics.health('{cell}', '{service}', '{instance}')}` | every process | {_text(topics.health)} |"]
    kinds = dict.fromkeys(topic.message for topic in (*topics.TOPICS, topics.SMOOTHED))
    return "\n".join([HEAD.rstrip("\n"), *rows, QUERIES.rstrip("\n"), *queries, *(_message(kind) for kind in kinds)]) + "\n"


def _answering(query: str) -> str:
    return ", ".join(process.name for process in (*PROCESSES, LAUNCHER) if query in process.answers)


def _text(documented: object) -> str:
    """The docstring of a function or message in one line."""
    return re.sub(r"\s+", " ", documented.__doc__ or "").strip()


def _message(kind: type[Message]) -> str:
    hints = typing.get_type_hints(kind, include_extras=True)
    names = [each.encode_name for each in msgspec.structs.fields(kind)]
    rows = "\n".join(f"| `{name}` | {_type(hints[name])} |" for name in names)
    return f"\n## {kind.__name__}\n\n{_text(kind)} At most {kind.MAX_BYTES:,} bytes.\n\n| field | type |\n|---|---|\n{rows}"


def _type(hint: Any) -> str:
    """A field's type in words, with the range or the shape that a reader checks."""
    extras = getattr(hint, "__metadata__", ())
    for extra in extras:
        if isinstance(extra, Array):
            shape = ", ".join("n" if length is None else str(length) for length in extra.shape)
            return f"{extra.dtype} array ({shape})"
    if extras:
        (meta,) = extras
        limits = [f"{words} {value:g}" for words, value in (("from", meta.ge), ("to", meta.le)) if value is not None]
        limits += [f"at most {meta.max_length}"] if meta.max_length is not None else []
        return " ".join([_type(typing.get_args(hint)[0]), *limits])
    if typing.get_origin(hint) is typing.Literal:
        return " or ".join(f'"{value}"' for value in typing.get_args(hint))
    if typing.get_origin(hint) is dict:
        value = typing.get_args(hint)[1]
        inner = ", ".join(f"`{name}`" for name in value.__struct_fields__)
        return f"map of names to maps with {inner},"
    if typing.get_origin(hint) is tuple:
        inner = [_type(each) for each in typing.get_args(hint) if each is not Ellipsis]
        return f"list of {inner[0]}," if len(inner) == 1 else f"list of {len(inner)} numbers"
    return {"int": "integer", "float": "number", "str": "text"}.get(hint.__name__, hint.__name__)


if __name__ == "__main__":
    PAGE.write_text(page())
