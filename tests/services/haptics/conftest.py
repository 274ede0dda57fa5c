"""Fixtures of the tests of the haptic sense."""

import pytest

from penumbra.shared.cell import description as cells
from penumbra.shared.skin.layout import Skin


@pytest.fixture(scope="session")
def table() -> cells.Cell:
    return cells.load("table")


@pytest.fixture(scope="session")
def skin(table: cells.Cell) -> Skin:
    return Skin(table)
