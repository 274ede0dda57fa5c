"""Where a cell file is, what the cell is called and what it tracks. Commands that only ask a running cell read no more: the model
of a whole cell takes longer to import than they take to run."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from penumbra.shared.cell import document
from penumbra.shared.cell.faults import CellError

BUILT_IN = Path(__file__).parent / "built_in"
NAME = r"^[A-Za-z0-9_-]{1,64}$"
"""What a name in a cell file may be: it becomes a part of keys and of files' names."""


@dataclass(frozen=True)
class Names:
    """The name of a cell and those of its targets."""

    name: str
    targets: tuple[str, ...]

    def target(self, name: str | None) -> str:
        """The name of a target, checked; None means the first one. Raises CellError."""
        return one(self.name, "target", self.targets, name)


def read(cell: str | Path) -> Names:
    """The names of a built-in cell or a YAML file. Raises CellError where there is no such file, or where they are not in it."""
    match document.read(source(cell)).data:
        case {"name": str(name), "targets": {**targets}} if targets and all(_is_name(each) for each in (name, *targets)):
            return Names(name, tuple(map(str, targets)))
    from penumbra.shared.cell import description  # says what is wrong with the file

    whole = description.load(cell)
    return Names(whole.name, tuple(whole.targets))


def _is_name(value: object) -> bool:
    return isinstance(value, str) and re.match(NAME, value) is not None


def one(cell: str, kind: str, known: Iterable[str], name: str | None) -> str:
    """The name of a part of a cell, checked; None means the first one. Raises CellError."""
    names = list(known)
    if name is None and names:
        return names[0]
    if name is None or name not in names:
        raise CellError(f"cell {cell} has no {kind} {name!r}: it has {', '.join(names) or 'none'}")
    return name


def source(cell: str | Path) -> Path:
    """The YAML file of a built-in name (`table`, `arm`) or path. Raises CellError where there is none."""
    path = BUILT_IN / f"{cell}.yaml"
    if not is_file(path):
        path = Path(cell)
    if not is_file(path):
        built_in = ", ".join(sorted(p.stem for p in BUILT_IN.glob("*.yaml")))
        raise CellError(f"no cell {str(cell)!r}: give one of {built_in}, or the path of a YAML file")
    return path


def is_file(path: Path) -> bool:
    """Whether a file is there; none is where the name cannot be one."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
