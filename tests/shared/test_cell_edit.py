"""Changing values of a cell file leaves every other character alone."""

import pytest

from penumbra.shared.cell import description as cells
from penumbra.shared.cell import edit
from penumbra.shared.cell.description import CellError

CELL = """\
# a cell of mine
name: mine
cameras:
  front:                 # on the tripod
    width:  640          # two spaces stay
    height: 480
    fx: 554.26           # guessed
    fy: 554.26
    cx: 319.5
    cy: 239.5

    # measured with a ruler
    position: [0.35, -1.15, 0.90]
    look_at: [0.05, 0.0, 0.15]   # the table's middle

  side: {width: 640, height: 480, fx: 500, fy: 500, cx: 319.5, cy: 239.5,
         position: [1, 1, 1], look_at: [0, 0, 0]}  # in two lines
targets:
  forearm: {mesh: "body:forearm", labels: [forearm, hand], home: {position: [0.0, 0.0, 0.20]}}
"""


@pytest.fixture
def own_cell(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(CELL)
    return path


def test_values_change_where_they_stand_and_new_ones_follow_them(own_cell):
    values = {"width": "640", "fx": "615.2", "cy": "236.0", "k1": "-0.28", "k2": "0.09"}
    text = edit.with_values(own_cell, ("cameras", "front"), values)
    expected = CELL.replace("fx: 554.26           # guessed", "fx: 615.2           # guessed").replace(
        "    cy: 239.5\n", "    cy: 236.0\n    k1: -0.28\n    k2: 0.09\n"
    )
    assert text == expected


def test_a_key_takes_the_place_of_another_one_and_its_comment_stays(own_cell):
    values = {"position": "[1.0, 2.0, 3.0]", "rpy": "[0.1, 0.2, 0.3]", "pose_spread": "{position: 0.001, rotation: 0.002}"}
    text = edit.with_values(own_cell, ("cameras", "front"), values, {"rpy": "look_at"})
    expected = CELL.replace("position: [0.35, -1.15, 0.90]", "position: [1.0, 2.0, 3.0]").replace(
        "    look_at: [0.05, 0.0, 0.15]   # the table's middle\n",
        "    rpy: [0.1, 0.2, 0.3]   # the table's middle\n    pose_spread: {position: 0.001, rotation: 0.002}\n",
    )
    assert text == expected
    own_cell.write_text(text)
    assert edit.with_values(own_cell, ("cameras", "front"), values, {"rpy": "look_at"}) == text, "twice is as once"
    edit.write(own_cell, text)
    assert cells.load(own_cell).cameras["front"].rpy == (0.1, 0.2, 0.3)


def test_a_map_in_braces_over_two_lines_keeps_its_lines(own_cell):
    values = {"fx": "615.2", "cy": "236.0", "k1": "-0.28"}
    text = edit.with_values(own_cell, ("cameras", "side"), values)
    assert text == CELL.replace("fx: 500, fy", "fx: 615.2, fy").replace("cy: 239.5,\n", "cy: 236.0, k1: -0.28,\n")
    first = edit.with_values(own_cell, ("cameras", "side"), {"rate_hz": "30"})
    assert "side: {rate_hz: 30, width: 640" in first
    assert "    rate_hz: 30\n    width:  640" in edit.with_values(own_cell, ("cameras", "front"), {"rate_hz": "30"})


def test_the_last_line_may_lack_its_end(own_cell):
    own_cell.write_text("a: {b: 1}\nc:\n  d: 2")
    assert edit.with_values(own_cell, ("c",), {"d": "3", "e": "4"}) == "a: {b: 1}\nc:\n  d: 3\n  e: 4"


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        (CELL, ("cameras", "back"), r"mine.yaml:3: cameras.back: expected back, got none; add it"),
        ("a: &x {fx: 1}\ncameras: {front: *x}\n", ("cameras", "front"), "expected the value of front itself, got an alias"),
        ("n: &x 7\ncameras: {front: {fx: *x}}\n", ("cameras", "front"), "expected the value of fx itself, got an alias"),
        ("cameras: {front: 3}\n", ("cameras", "front"), "expected a map with values, got something else"),
        ("cameras: {front: [\n", ("cameras", "front"), "not YAML"),
    ],
)
def test_what_cannot_be_changed_is_refused_with_its_line(own_cell, text, place, words):
    own_cell.write_text(text)
    with pytest.raises(CellError, match=words):
        edit.with_values(own_cell, place, {"fx": "615.2"})


def test_a_text_that_does_not_load_replaces_nothing(own_cell):
    with pytest.raises(CellError, match=r"the cell would not load from there: .*mine.yaml:7: cameras.front.fx"):
        edit.write(own_cell, CELL.replace("fx: 554.26 ", "fx: -1 "))
    assert own_cell.read_text() == CELL
    assert [path.name for path in own_cell.parent.iterdir()] == ["mine.yaml"]


def test_the_difference_shows_only_what_changes(own_cell):
    lines = edit.difference(own_cell, CELL.replace("height: 480\n    fx", "height: 490\n    fx")).splitlines()
    assert [line for line in lines if line[0] in "+-" and line[:3] not in ("---", "+++")] == [
        "-    height: 480",
        "+    height: 490",
    ]
    assert edit.difference(own_cell, CELL) == ""


def test_a_built_in_cell_needs_another_place(tmp_path, own_cell):
    with pytest.raises(CellError, match="the built-in cell table is not overwritten: give --out FILE"):
        edit.destination("table", None)
    assert edit.destination("table", tmp_path / "x.yaml") == tmp_path / "x.yaml"
    assert edit.destination(str(own_cell), None) == own_cell


def test_a_value_in_a_block_is_replaced_up_to_its_end_and_what_follows_stays(own_cell):
    values = {"forearm": '{mesh: "body:forearm", labels: [hand], home: {}}', "other": "{mesh: m.stl, labels: [hand], home: {}}"}
    block = '  forearm:    # mine\n    mesh: "body:forearm"\n    labels:\n      - hand\n    home:\n'
    block += "      position: [0, 0, 1]  # high\n"
    own_cell.write_text(CELL[: CELL.index("  forearm: {")] + block + "\n# of the emulator\nsim: null\n")
    text = edit.with_values(own_cell, ("targets",), values)
    expected = (
        f"  forearm:    # mine\n    {values['forearm']}  # high\n  other: {values['other']}\n\n# of the emulator\nsim: null\n"
    )
    assert text[text.index("  forearm:") :] == expected
