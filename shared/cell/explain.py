"""Translates pydantic's errors into the terms of a cell file: the place, what was expected, what was found, and what to do."""

from __future__ import annotations

import types
import typing
from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel

from penumbra.shared.cell.faults import Faulty, close_to, meant, short
from penumbra.shared.geometry import lens

UNITS = {"[m]": "metres", "[rad]": "radians", "[px]": "pixels"}
"""Units to suggest in an error about a number out of range."""


def explain(model: type[BaseModel], errors: Sequence[Any]) -> list[tuple[list[str], str]]:
    """Translates pydantic's errors into (place, reason), several where a validator found several. A key is not missing where a
    mistyped one explains it."""
    out: list[tuple[list[str], str]] = []
    mistyped: set[tuple[str, ...]] = set()
    for error in sorted(errors, key=lambda error: error["type"] != "extra_forbidden"):
        location = [str(part) for part in error["loc"]]
        if error["type"] == "extra_forbidden" and (close := close_to(location[-1], known_keys(model, location[:-1]))):
            mistyped.add((*location[:-1], close))
        if error["type"] == "missing" and tuple(location) in mistyped:
            continue
        if isinstance(raised := error.get("ctx", {}).get("error"), Faulty):
            out += [([*location, *place.split(".")] if place else location, reason) for place, reason in raised.faults]
        else:
            out.append((location, _reason(model, location, error)))
    return [([part for part in location if part != "[key]"], reason) for location, reason in out]


def _reason(model: type[BaseModel], location: list[str], error: Any) -> str:
    kind, limits, got = error["type"], error.get("ctx", {}), short(error.get("input"))
    match kind:
        case "missing" if location[-1].isdigit():
            return f"expected {_length(_annotation(model, location[:-1]))} numbers, got {got}"
        case "missing":
            return f"expected {location[-1]}, got none; add `{location[-1]}:`{_about(model, location)}"
        case "extra_forbidden":
            return _unknown(location, known_keys(model, location[:-1]))
        case "greater_than" | "greater_than_equal" | "less_than" | "less_than_equal":
            words = {"gt": "above", "ge": "of at least", "lt": "below", "le": "of at most"}
            limit = next(f"{words[name]} {value:g}" for name, value in limits.items() if name in words)
            about = _about(model, location)
            unit = next((f"; give {name}" for sign, name in UNITS.items() if sign in about), "")
            return f"expected a number {limit}, got {got}{about}{unit}"
        case "finite_number":
            return f"expected a finite number, got {got}{_about(model, location)}"
        case "int_from_float" | "int_parsing" | "int_type" | "int_parsing_size":
            return f"expected a whole number, got {got}{_about(model, location)}"
        case "float_parsing" | "float_type":
            return f"expected a number, got {got}{_about(model, location)}"
        case "bool_parsing" | "bool_type":
            return f"expected true or false, got {got}"
        case "string_type":
            return f"expected a text, got {got}; put it in quotes"
        case "string_pattern_mismatch":
            return f"expected a name of at most 64 letters, digits, _ and -, got {got}; rename it"
        case "literal_error":
            known = [str(value) for value in _values(_annotation(model, location))]
            return f"expected one of {', '.join(known)}, got {got}{meant(str(error.get('input')), known)}"
        case "tuple_type" | "list_type":
            return f"expected a list such as [..., ...], got {got}{_about(model, location)}"
        case "too_long" | "too_short":
            low, high, actual = limits.get("min_length"), limits.get("max_length"), limits.get("actual_length")
            if (exact := _length(_annotation(model, location))) is not None:
                return f"expected {exact} numbers, got {actual}"
            return f"expected {f'at most {high}' if high is not None else f'at least {low}'}, got {actual}; add or remove some"
        case "model_type" | "model_attributes_type" | "dict_type" | "mapping_type":
            known = known_keys(model, location)
            text = error.get("input")
            hint = f"; write {{{known[0]}: {text:.100}}}" if known and isinstance(text, str) else ""
            return f"expected a map{f' with {_listed(known)}' if known else ''}, got {got}{hint}"
        case _:
            return f"expected something else ({error['msg']}), got {got}"


def _unknown(location: list[str], known: Sequence[str]) -> str:
    name = location[-1]
    if "k1" in known and name in lens.FOREIGN:
        return lens.FOREIGN[name]
    return f"expected one of the keys {_listed(known)}, got {name:.60}{meant(name, known) or '; remove it'}"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names)


def known_keys(model: type[BaseModel], location: Sequence[str]) -> list[str]:
    """Keys that the model allows at a place; none where the user chooses the names."""
    found = _model(_annotation(model, location))
    return [] if found is None else [name for name, field in found.model_fields.items() if not field.exclude]


def _about(model: type[BaseModel], location: Sequence[str]) -> str:
    """Description of a value with its unit, in brackets."""
    path = list(location)
    while path and path[-1].isdigit():  # an element of a list
        path.pop()
    found = _model(_annotation(model, path[:-1])) if path else None
    field = None if found is None else found.model_fields.get(path[-1])
    return f" ({field.description})" if field is not None and field.description else ""


def _annotation(model: type[BaseModel], location: Sequence[str]) -> Any:
    """Type of the value at a place; None where no value may stand there."""
    found: Any = model
    for part in location:
        inner = _model(found)
        if inner is not None:
            field = inner.model_fields.get(part)
            found = None if field is None else field.annotation
            continue
        found = _bare(found)
        arguments = typing.get_args(found)
        if typing.get_origin(found) is dict:
            found = arguments[1]
        elif typing.get_origin(found) is tuple:
            found = (
                arguments[0] if arguments[-1] is Ellipsis or not part.isdigit() else arguments[min(int(part), len(arguments) - 1)]
            )
        else:
            return None
    return found


def _bare(annotation: Any) -> Any:
    """A type without its Annotated metadata and without None."""
    if typing.get_origin(annotation) is typing.Annotated:
        return _bare(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return _bare(next(each for each in typing.get_args(annotation) if each is not type(None)))
    return annotation


def _model(annotation: Any) -> type[BaseModel] | None:
    bare = _bare(annotation)
    return bare if isinstance(bare, type) and issubclass(bare, BaseModel) else None


def _length(annotation: Any) -> int | None:
    """Length of a list of fixed length; None for any other type."""
    arguments = typing.get_args(_bare(annotation))
    return None if typing.get_origin(_bare(annotation)) is not tuple or arguments[-1] is Ellipsis else len(arguments)


def _values(annotation: Any) -> tuple[Any, ...]:
    return typing.get_args(_bare(annotation))
