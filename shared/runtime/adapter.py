"""Loads a user's own classes, which a source names as adapter:MODULE:CLASS."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from penumbra.shared.cell.faults import CellError

METHODS = ("read", "close")


def load(place: str, folder: Path, guide: str) -> type[Any]:
    """Class of `MODULE:CLASS`; it must have METHODS. Modules are also imported from the folder of the cell file. guide: the page
    that describes the class. Raises CellError."""
    module, _, name = place.partition(":")
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
    try:
        found = getattr(importlib.import_module(module), name, None)
    except Exception as error:
        raise CellError(
            f"adapter:{place}: {module} cannot be imported ({type(error).__name__}: {error}); looked in {folder} too; see {guide}"
        ) from error
    if not isinstance(found, type):
        raise CellError(f"adapter:{place}: expected a class {name} in {module}, got none; see {guide}")
    if missing := [each for each in METHODS if not callable(getattr(found, each, None))]:
        raise CellError(
            f"adapter:{place}: expected the methods {' and '.join(METHODS)}, got none called {' or '.join(missing)}; see {guide}"
        )
    return found
