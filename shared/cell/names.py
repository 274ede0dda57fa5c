"""Path of a cell file, and the names of the cell and its targets. Commands that only query a running cell read no more than this,
because importing the model of a whole cell takes longer than they run."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from penumbra.shared.cell import BUILT_IN, document
from penumbra.shared.cell.faults import CellError

NAME = r"^[A-Za-z0-9_-]{1,64}$"
"""Pattern of a name in a cell file. Names become parts of keys and of file names."""


@dataclass(frozen=True)
class Names:
    """The name of a cell and those of its targets."""

    name: str
    targets: tuple[str, ...]

    def target(self, name: str | None) -> str:
        """Checked name of a target; None means the first one. Raises CellError."""
        return one(self.name, "target", self.targets, name)


def read(cell: str | Path) -> Names:
    """Names of a built-in cell or a YAML file. Raises CellError where there is no such file, or it lacks the names."""
    match document.read(source(cell)).data:
        case {"name": str(name), "targets": {**targets}} if targets and all(_is_name(each) for each in (name, *targets)):
            return Names(name, tuple(map(str, targets)))
    from penumbra.shared.cell import description  # it reports the faults of the file

    whole = description.load(cell)
    return Names(whole.name, tuple(whole.targets))


def _is_name(value: object) -> bool:
    return isinstance(value, str) and re.match(NAME, value) is not None


def one(cell: str, kind: str, known: Iterable[str], name: str | None) -> str:
    """Checked name of a part of a cell; None means the first one. Raises CellError."""
    names = list(known)
    if name is None and names:
        return names[0]
    if name is None:
        raise CellError(f"cell {cell} has no {kind}")
    if name not in names:
        raise CellError(f"cell {cell} has no {kind} {name!r}: it has {', '.join(names) or 'none'}")
    return name


def source(cell: str | Path) -> Path:
    """YAML file of a built-in name (`table`, `arm`) or path. Raises CellError where there is none."""
    path = built_in(cell) or Path(cell)
    if not is_file(path):
        ours = ", ".join(sorted(p.stem for p in BUILT_IN.glob("*.yaml")))
        raise CellError(f"{_missing(path)}: give one of {ours}, or the path of a YAML file")
    return path


def _missing(path: Path) -> str:
    """What is wrong with a path where there is no file."""
    if os.path.isdir(path):
        return f"{path} is a folder"
    return f"no such file {path}" if path.suffix or len(path.parts) > 1 else f"no cell {str(path)!r}"


def built_in(cell: str | Path) -> Path | None:
    """YAML file of a built-in name; None for any other text."""
    path = BUILT_IN / f"{cell}.yaml"
    return path if is_file(path) else None


def is_bare(cell: str | Path) -> bool:
    """Whether a cell is given by a name alone, as one that runs may be: it is neither built in nor a file."""
    return _is_name(cell) and not built_in(cell) and not is_file(Path(cell))


def is_file(path: Path) -> bool:
    """Whether a file exists; false for a name that the file system does not allow."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
