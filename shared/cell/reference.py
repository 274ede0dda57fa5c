"""All keys of a cell file in Markdown, from the model. `python -m penumbra.shared.cell.reference docs/own-cell.md` writes them
into that page; a test compares."""

from __future__ import annotations

import sys
import types
import typing
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from penumbra.shared.cell.description import Cell

BEGIN, END = "<!-- keys: begin -->", "<!-- keys: end -->"
NUMBERS = {"float": "number", "int": "whole number", "str": "text", "bool": "true or false"}


def markdown() -> str:
    """One table for each map of a cell file, in the order of the file."""
    sections: dict[type[BaseModel], list[str]] = {}
    _collect(Cell, "", sections)
    return "\n\n".join(_section(model, places) for model, places in sections.items())


def inserted(page: str) -> str:
    """The page with the tables between its marks. Raises ValueError where a mark is missing."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"expected a page with the lines {BEGIN} and {END}, got one without")
    return f"{before}{BEGIN}\n\n{markdown()}\n\n{END}{after}"


def _collect(model: type[BaseModel], place: str, out: dict[type[BaseModel], list[str]]) -> None:
    """Collects a model and all models below it, with the places of each."""
    out.setdefault(model, []).append(place)
    for name, field in model.model_fields.items():
        for inner, below in _models(field.annotation):
            _collect(inner, f"{place}.{name}{below}".removeprefix("."), out)


def _models(annotation: Any) -> list[tuple[type[BaseModel], str]]:
    bare, _ = _bare(annotation)
    if isinstance(bare, type) and issubclass(bare, BaseModel):
        return [(bare, "")]
    arguments = typing.get_args(bare)
    if typing.get_origin(bare) is dict:
        return [(model, f".NAME{below}") for model, below in _models(arguments[1])]
    if typing.get_origin(bare) is tuple and arguments[-1] is Ellipsis:
        return [(model, f"[]{below}") for model, below in _models(arguments[0])]
    return []


def _section(model: type[BaseModel], places: list[str]) -> str:
    about = " ".join((model.__doc__ or "").split())
    title = ", ".join(f"`{place}`" for place in places) if places != [""] else "The file"
    rows = [
        f"| `{name}` | {_type(field)} | {_default(field)} | {field.description} |"
        for name, field in model.model_fields.items()
        if not field.exclude
    ]
    return "\n".join([f"### {title}", "", about, "", "| key | value | default | meaning |", "|---|---|---|---|", *rows])


def _type(field: FieldInfo) -> str:
    limits = _limits(field.metadata)
    return _words(field.annotation, limits)


def _words(annotation: Any, limits: str = "") -> str:
    bare, more = _bare(annotation)
    limits = limits or more
    arguments = typing.get_args(bare)
    match typing.get_origin(bare):
        case None if isinstance(bare, type) and issubclass(bare, BaseModel):
            return "map"
        case None:
            return " ".join(filter(None, (NUMBERS[bare.__name__], limits)))
        case origin if origin is Literal:
            return " or ".join(str(each) for each in arguments)
        case origin if origin is dict:
            inner = _words(arguments[1])
            return "map by name" if inner == "map" else f"map by name: {inner}"
        case _ if arguments[-1] is Ellipsis:
            return "list of maps" if _words(arguments[0]) == "map" else f"list: {_words(arguments[0])}"
        case _:
            return f"list of {len(arguments)}: {_words(arguments[0])}"


def _bare(annotation: Any) -> tuple[Any, str]:
    """A type without its metadata and without None, and its limits."""
    limits = ""
    while typing.get_origin(annotation) in (typing.Annotated, typing.Union, types.UnionType):
        arguments = typing.get_args(annotation)
        if typing.get_origin(annotation) is typing.Annotated:
            annotation, *notes = arguments
            limits = limits or _limits(notes)
        else:
            annotation = next(each for each in arguments if each is not type(None))
    return annotation, limits


def _limits(notes: Any) -> str:
    """Bounds in words: above 0, up to 5."""
    found: dict[str, float] = {}
    for note in notes:
        for each in (note, *getattr(note, "metadata", ())):
            found |= {name: getattr(each, name) for name in ("gt", "ge", "le") if getattr(each, name, None) is not None}
    found = {name: int(value) if value == int(value) else round(value, 3) for name, value in found.items()}
    parts = [f"above {found['gt']}"] if "gt" in found else []
    if "ge" in found and "le" in found:
        parts.append(f"from {found['ge']} to {found['le']}")
    elif "ge" in found:
        parts.append(f"from {found['ge']}")
    elif "le" in found:
        parts.append(f"up to {found['le']}")
    return ", ".join(parts)


def _default(field: FieldInfo) -> str:
    if field.default is PydanticUndefined:
        return "required"
    if field.default is None:
        return "none"
    if isinstance(field.default, BaseModel):
        given = field.default.model_dump(exclude_unset=True)
        return f"`{{{', '.join(f'{name}: {_value(value)}' for name, value in given.items())}}}`" if given else "its defaults"
    if field.default in ({}, ()):
        return "none"
    return f"`{_value(field.default)}`"


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(inserted(path.read_text()))
