"""The cell file: its model, its validation, and the cells that come with Penumbra in `built_in/`."""

from pathlib import Path

BUILT_IN = Path(__file__).parent / "built_in"
DEFAULT = "table"
"""The cell where none is named."""
