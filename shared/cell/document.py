"""A YAML file with the lines of its values."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from penumbra.shared.cell.faults import CellError, Fault

MAX_BYTES = 1_000_000
MAX_NODES = 200_000
"""Maximum number of bytes and values of a file: a thousand calibrated pads."""

SYNTAX = (
    (r"character '\\t'", "expected spaces, got a tab; indent with spaces"),
    (
        r"mapping values are not allowed|sequence entries are not allowed",
        "expected one `key: value` in a line, got another; check the indentation here and in the line before, and put a text "
        "with a colon in quotes",
    ),
    (r"could not find expected ':'", "expected `key: value`, got no colon; add one"),
    (r"expected ',' or '([\]}])'", r"expected a comma or \1; close the bracket, or separate the values with commas"),
    (
        r"did not find expected|expected <block end>|expected the node content",
        "expected the indentation of the keys before; indent the keys of a map equally, and close brackets and quotes",
    ),
    (r"found another document", "expected one document, got another after a line `---`; remove that line"),
    (r"unexpected end of stream", "expected a closing quote, got the end of the file; close it"),
    (r"undefined alias|could not determine a constructor", "expected plain values; remove the * or ! or put the text in quotes"),
    (r"found unhashable key|unacceptable key", "expected a plain name as a key; remove the brackets or braces before the colon"),
    (r"found character .* that cannot start any token", "expected a value; put a text that begins with this character in quotes"),
)
"""Patterns of PyYAML's errors, each with a remedy. PyYAML's own texts name its internal states."""


@dataclass(frozen=True)
class Document:
    """Content of a YAML file: its values, and the nodes that they were made from. duplicates: faults of keys given twice."""

    path: Path
    data: Any
    tree: yaml.Node | None
    duplicates: tuple[Fault, ...]

    def line(self, location: Sequence[str]) -> int:
        """Line of the deepest existing value on the path to a place."""
        node = self.tree
        if node is None:
            return 1
        line: int = node.start_mark.line + 1
        for part in location:
            if isinstance(node, yaml.MappingNode):
                match = next(((k, v) for k, v in node.value if k.value == part), None)
                if match is None:
                    break
                line, node = match[0].start_mark.line + 1, match[1]
            elif isinstance(node, yaml.SequenceNode) and part.isdigit() and int(part) < len(node.value):
                node = node.value[int(part)]
                line = node.start_mark.line + 1
            else:
                break
        return line

    def fault(self, place: str | Sequence[str], reason: str, is_warning: bool = False) -> Fault:
        """A fault at a place: keys, or keys joined by dots."""
        location = place.split(".") if isinstance(place, str) else list(place)
        return Fault(self.path, self.line(location), ".".join(location), reason, is_warning)


def read(path: Path) -> Document:
    """Reads a YAML file. Raises CellError with file and line where it is not YAML, or holds more than a cell needs: nested
    references in a short file may expand to more than fits into memory."""
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise CellError(f"{path}: cannot be read: {error.strerror}") from None
    loader = None
    try:
        if len(text) > MAX_BYTES:
            raise ValueError(f"expected at most {MAX_BYTES} bytes, got more")
        loader = yaml.SafeLoader(text.decode())
        tree = loader.get_single_node()
        _count_nodes(tree, {})
        duplicates = _duplicates(path, tree)
        return Document(path, None if tree is None else loader.construct_document(tree), tree, duplicates)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise CellError(str(Fault(path, mark.line + 1 if mark else 1, "", f"{_words(error)} (not YAML)"))) from None
    except Exception as error:  # PyYAML raises many kinds of errors for a scalar that does not match its tag
        line = text[: error.start].count(b"\n") + 1 if isinstance(error, UnicodeDecodeError) else 1
        if isinstance(error, UnicodeDecodeError):
            reason = f"expected UTF-8, got the byte 0x{text[error.start]:02x}; save the file as UTF-8"
        elif isinstance(error, yaml.reader.ReaderError):
            line = text.decode()[: error.position].count("\n") + 1
            reason = f"expected printable characters, got U+{int(error.character):04X}; remove it"
        elif isinstance(error, RecursionError):
            reason = "expected a few levels of brackets, got a nesting too deep (recursion)"
        else:
            reason = f"not YAML: {error!s:.300}"
        raise CellError(str(Fault(path, line, "", reason))) from None


def _words(error: yaml.MarkedYAMLError) -> str:
    problem = f"{error.problem or error.context or 'not YAML'}"
    for pattern, words in SYNTAX:
        if match := re.search(pattern, problem):
            return match.expand(words)
    return f"{problem:.300}"


def _count_nodes(node: yaml.Node | None, known: dict[int, int | None]) -> int:
    """Number of nodes in a tree; an aliased node counts at each reference. Raises ValueError for more than MAX_NODES, and where a
    node contains itself."""
    if not isinstance(node, yaml.CollectionNode):
        return 1
    if id(node) not in known:
        known[id(node)] = None
        pairs = isinstance(node, yaml.MappingNode)
        inner = [part for pair in node.value for part in pair] if pairs else node.value
        known[id(node)] = 1 + sum(_count_nodes(part, known) for part in inner)
    count = known[id(node)]
    if count is None:
        raise ValueError("expected a tree of values, got a value that contains itself")
    if count > MAX_NODES:
        raise ValueError(f"expected at most {MAX_NODES} values, got more")
    return count


def _duplicates(path: Path, tree: yaml.Node | None) -> tuple[Fault, ...]:
    """Faults of keys that a map has twice. YAML parsers silently keep the last one."""
    out: list[Fault] = []
    seen: set[int] = set()
    pending: list[tuple[yaml.Node | None, tuple[str, ...]]] = [(tree, ())]
    while pending:
        node, place = pending.pop()
        if not isinstance(node, yaml.CollectionNode) or id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            pending += [(part, (*place, str(i))) for i, part in enumerate(node.value)]
            continue
        first: dict[str, int] = {}
        for key, value in node.value:
            name, line = str(key.value), key.start_mark.line + 1
            if name in first and key.tag != "tag:yaml.org,2002:merge":
                what = f"expected each key once, got {name:.60} again (line {first[name]} has it); rename or remove one of them"
                out.append(Fault(path, line, ".".join((*place, name)), what))
            first.setdefault(name, line)
            pending.append((value, (*place, name)))
    return tuple(sorted(out, key=lambda fault: fault.line))
