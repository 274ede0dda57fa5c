"""Edits of a cell file that preserve the rest of its text: comments, order and layout belong to the user."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from penumbra.shared.cell import BUILT_IN, description, document
from penumbra.shared.cell.document import Document
from penumbra.shared.cell.faults import CellError
from penumbra.shared.cell.names import source


def destination(cell: str | Path, out: Path | None) -> Path:
    """Path that a changed cell is written to. Raises CellError for a built-in cell without `out`."""
    path = source(cell)
    if out is None and path.parent == BUILT_IN:
        raise CellError(f"the built-in cell {cell} is not overwritten: give --out FILE, and use that with --cell")
    return out or path


def with_values(path: Path, place: Sequence[str], values: Mapping[str, str], instead: Mapping[str, str] | None = None) -> str:
    """Text of a cell file after setting values, each given as YAML, in the map at a place. An existing key keeps its position,
    and comments within its old value are lost. A new key follows the key that comes before it in `values`.

    instead: by new key, the existing key that it replaces. Raises CellError where the file is not YAML, has no such map, or
    refers to it by an alias.
    """
    found, text = document.read(path), path.read_text()
    for key, value in values.items():
        at = list(values).index(key)
        before = list(values)[at - 1] if at else ""
        text = _changed(found, text, place, key, value, before, (instead or {}).get(key, ""))
        found = _parsed(path, text)
    expected = _lookup(document.read(path).data, place)
    expected = {key: value for key, value in expected.items() if key not in (instead or {}).values()}
    expected |= {key: yaml.safe_load(value) for key, value in values.items()}
    if _lookup(found.data, place) != expected:
        raise CellError(f"{found.fault(list(place), 'cannot be changed here: write its values one below the other')}")
    return text


def difference(path: Path, text: str) -> str:
    """Unified diff between a file and its new text; empty where they are equal."""
    before = path.read_text().splitlines(keepends=True) if path.exists() else []
    lines = difflib.unified_diff(before, text.splitlines(keepends=True), str(path), str(path), n=1)
    return "".join(lines)


def write(path: Path, text: str) -> None:
    """Replaces a cell file atomically with a text that loads. Raises CellError where the text does not load or cannot be
    written."""
    draft = path.with_name(f".{path.name}.{os.getpid()}.yaml")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(text)
        description.load(draft)
        draft.replace(path)
    except CellError as error:
        raise CellError(f"{path}: the cell would not load from there: {str(error).replace(str(draft), str(path))}") from None
    except OSError as error:
        raise CellError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        draft.unlink(missing_ok=True)


def _parsed(path: Path, text: str) -> Document:
    tree = yaml.compose(text, yaml.SafeLoader)
    return Document(path, yaml.safe_load(text), tree, ())


def _lookup(data: Any, place: Sequence[str]) -> dict[str, Any]:
    for key in place:
        data = data[key]
    return dict(data)


def _map(found: Document, place: Sequence[str]) -> yaml.MappingNode:
    """The map at a place. Raises CellError."""
    node: Any = found.tree
    for key in place:
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        match = next(((name, value) for name, value in pairs if name.value == key), None)
        if match is None:
            raise CellError(str(found.fault(list(place), f"expected {key}, got none; add it")))
        _refuse_alias(found, place, *match)
        node = match[1]
    if not isinstance(node, yaml.MappingNode) or not node.value:
        raise CellError(str(found.fault(list(place), "expected a map with values, got something else")))
    return node


def _refuse_alias(found: Document, place: Sequence[str], key: yaml.Node, value: yaml.Node) -> None:
    """Raises CellError for an alias: its text stands elsewhere, and may have other uses."""
    if value.start_mark.index < key.end_mark.index:
        raise CellError(str(found.fault(list(place), f"expected the value of {key.value} itself, got an alias; write it out")))


def _end(node: yaml.Node) -> int:
    """Index at which a value's text ends. PyYAML ends a block where the next key begins, after comments that do not belong to
    it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(node, yaml.MappingNode) else last)
    return int(node.end_mark.index)


def _changed(found: Document, text: str, place: Sequence[str], key: str, value: str, before: str, instead: str) -> str:
    """The text with one value added or replaced."""
    node = _map(found, place)
    pairs = {name.value: (name, each) for name, each in node.value}
    old = key if key in pairs else instead
    if old in pairs:
        name, each = pairs[old]
        _refuse_alias(found, place, name, each)
        start, end = name.start_mark.index, _end(each)
        between = text[name.end_mark.index : each.start_mark.index]
        return f"{text[:start]}{key}{between}{value}{text[end:]}"
    if before not in pairs:
        at = node.value[0][0].start_mark
        separator = ", " if node.flow_style else f"\n{' ' * at.column}"
        return f"{text[: at.index]}{key}: {value}{separator}{text[at.index :]}"
    name, each = pairs[before]
    _refuse_alias(found, place, name, each)
    if node.flow_style:
        return f"{text[: each.end_mark.index]}, {key}: {value}{text[each.end_mark.index :]}"
    line_end = text.find("\n", _end(each))
    line_end = len(text) if line_end < 0 else line_end
    return f"{text[:line_end]}\n{' ' * name.start_mark.column}{key}: {value}{text[line_end:]}"
