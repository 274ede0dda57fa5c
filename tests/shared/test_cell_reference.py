"""The page about cell files: its keys are those of the model, and its example is one."""

import re
from pathlib import Path

import pytest
import yaml

from penumbra.shared.cell import description as cells
from penumbra.shared.cell import reference

PAGE = Path(__file__).parents[2] / "docs" / "own-cell.md"


def test_the_page_lists_every_key_with_unit_and_default_as_the_model_has_them():
    text = PAGE.read_text()
    assert reference.inserted(text) == text, f"run: python -m penumbra.shared.cell.reference {PAGE.name}, in docs"


def test_every_key_is_described_and_every_number_has_a_unit_or_needs_none():
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \| (.*?) \|$", reference.markdown(), re.MULTILINE)
    assert {"width", "k3", "joints_low", "excitation_V"} <= {row[0] for row in rows}
    bare = {"permittivity", "k1", "k2", "p1", "p2", "k3", "polarity", "length", "girth"}
    for key, kind, default, meaning in rows:
        assert meaning != "None" and default, key
        if "number" in kind and key not in bare and key != "channels":
            assert "[" in meaning, f"{key} has no unit"


def test_the_page_s_example_is_a_camera():
    example = re.search(r"```yaml\n(cameras:.*?)```", PAGE.read_text(), re.DOTALL)
    assert example is not None
    camera = cells.Camera(**yaml.safe_load(example[1])["cameras"]["front"])
    assert not camera.lens.is_pinhole


def test_a_page_without_marks_is_refused():
    with pytest.raises(ValueError, match="keys: begin"):
        reference.inserted("# A page")
