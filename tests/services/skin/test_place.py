"""`penumbra skin place` from the command line."""

import json

import pytest
import yaml

from penumbra.services.skin.placing import candidates, layout, picture
from penumbra.services.skin.placing.place import line, main, names
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import Pad

TABLE = (cells.BUILT_IN / "table.yaml").read_text()


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few places and few scenes, so that it takes a second."""
    for module, name, value in ((candidates, "STEP", 0.07), (layout, "SCENES", 30), (layout, "FRESH", 40), (picture, "CELLS", 8)):
        monkeypatch.setattr(module, name, value)


def test_the_proposed_pads_are_no_worse_and_go_into_the_cell_file_with_its_comments(few, tmp_path, capsys) -> None:
    read = "boards: [{port: /dev/ttyUSB7, channels: {c: [0, 1]}}]"
    text = TABLE.replace("p1: {type: five, ", f"p1: {{type: five, {read}, ")
    mine, new, maps = tmp_path / "mine.yaml", tmp_path / "new.yaml", tmp_path / "maps.png"
    mine.write_text(text)
    assert main(["--cell", str(mine), "--json", "-o", str(maps), "--write", str(new)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["proposed"]["pads"] == found["present"]["pads"] == 8
    assert found["proposed"]["mean_cm"] < found["present"]["mean_cm"]
    by_number = {step["pads"]: step["mean_cm"] for step in found["steps"]}
    assert sorted(by_number) == list(range(1, 13)) and by_number[12] < by_number[8] < by_number[2]
    assert by_number[8] == found["proposed"]["mean_cm"]
    written = cells.load(new)
    assert {name: list(pad.position) for name, pad in written.pads.items()} == {
        name: pad["position"] for name, pad in found["pads"].items()
    }
    assert written.pads["p1"].boards == cells.load(mine).pads["p1"].boards != ()
    assert {row.strip() for row in text.splitlines() if "#" in row and "p1" not in row} <= {
        row.strip() for row in new.read_text().splitlines()
    }
    assert maps.read_bytes()[:4] == b"\x89PNG" and maps.stat().st_size > 20_000


def test_the_printed_pads_are_those_of_a_cell_file(few, capsys) -> None:
    assert main(["--cell", "table", "--number", "3", "--workspace", "-0.1", "0.1", "0.25", "0.1", "-0.1", "0.08"]) == 0
    out = capsys.readouterr().out
    assert "proposed" in out and "95 % below cm" in out and "The bound leaves out" in out
    pads = yaml.safe_load(out[out.index("pads:\n") :].split("\n\n")[0])["pads"]
    assert list(pads) == ["p0", "p1", "p2"]
    assert all(Pad(**pad).link == "world" for pad in pads.values())


def test_pads_on_links_are_backed_and_new_ones_get_names_of_their_own() -> None:
    pads = [Pad(type="five", link="panda/panda_link5", position=(k, 0.0, 0.0), backed=True) for k in range(3)]
    named = names(("p0", "p2"), tuple(pads))
    assert list(named) == ["p0", "p2", "p1"]
    assert line(pads[1]) == "{type: five, link: panda/panda_link5, position: [1.0, 0.0, 0.0], backed: true}"


def without_sim(text: str) -> str:
    return text[: text.index("\nsim:")] + "\n"


ARM = (cells.BUILT_IN / "arm.yaml").read_text()
BARE = without_sim(TABLE[: TABLE.index("pads:  ")] + TABLE[TABLE.index("targets:") :])
JOINTS = ["--joints", "0", "-0.1", "0", "-2", "0", "1.9", "0.8"]


def test_a_robot_without_pads_gets_some_on_its_links_at_the_joints_that_are_given(few, tmp_path, capsys) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text(without_sim(ARM[: ARM.index("pads:  ")] + ARM[ARM.index("targets:") :]))
    assert main(["--cell", str(mine), "--links", "panda_link5", "panda_hand", "--number", "2", *JOINTS, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert "present" not in found and found["links"] == ["panda/panda_link5", "panda/panda_hand"]
    assert len(found["pads"]) == 2 and all(pad["backed"] and pad["link"] in found["links"] for pad in found["pads"].values())
    assert 0.0 < found["proposed"]["taken_by_other_links"] < 0.9
    by_number = {step["pads"]: step["mean_cm"] for step in found["steps"]}
    assert by_number[2] < by_number[1]


WRONG = {
    "no robot and no pads": (BARE, [], "expected a robot or a pad, got neither; add a robot"),
    "unknown link": (ARM, ["--links", "panda_link55"], "--links: expected world or one of panda/panda_link0"),
    "a link of no robot": (TABLE, ["--links", "hand"], "--links: expected world, as the cell has no robot, got 'hand'"),
    "no pad on the world": (ARM, ["--links", "world"], "add a first one to the cell file"),
    "no room": (TABLE, ["--number", "400"], "--number: expected at most"),
    "three numbers": (TABLE, ["--workspace", "0", "0", "0"], "--workspace: expected 6 numbers"),
    "out of reach": (TABLE, ["--workspace", "2", "2", "2", "3", "3", "3"], "give another --workspace"),
    "joints unknown": (without_sim(ARM), [], "--joints: expected the angles of panda_joint1"),
    "too few joints": (ARM, ["--joints", "0", "1"], "--joints: expected 7 values"),
    "several planes": (TABLE.replace("[0.12, 0.04, 0.0]", "[0.12, 0.04, 0.1]"), [], "pads.p7: expected the pads on the world in"),
    "fewer pads into the file": (TABLE, ["--number", "3", "--write", "new.yaml"], "--write: expected at least as many"),
    "picture of another kind": (TABLE, ["-o", "map.pdf"], "--out: expected a file that ends in .png"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wish_that_cannot_be_met_is_one_line_that_says_what_to_do(case: str, few, tmp_path, capsys) -> None:
    text, flags, expected = WRONG[case]
    mine = tmp_path / "mine.yaml"
    mine.write_text(text)
    assert main(["--cell", str(mine), *flags]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("penumbra skin place: ") and expected in error
    assert not (tmp_path / "new.yaml").exists()
