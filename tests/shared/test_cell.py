"""The cell file: what a good one gives, and the sentence that a bad one gets."""

import numpy as np
import pytest

from shared.cell import description

TABLE = (description.BUILT_IN / "table.yaml").read_text()


def load_changed(tmp_path, old, new):
    assert old in TABLE
    path = tmp_path / "cell.yaml"
    path.write_text(TABLE.replace(old, new, 1))
    return description.load(path)


@pytest.mark.parametrize("name", ["table", "arm"])
def test_the_built_in_cells_load_and_have_eight_pads_of_five_electrodes(name):
    loaded = description.load(name)
    assert len(loaded.pads) == 8
    assert all(len(loaded.pad_types[pad.type].electrodes) == 5 for pad in loaded.pads.values())


def test_the_camera_sees_the_target_s_home_near_the_middle_of_its_image():
    loaded = description.load("table")
    camera = loaded.cameras["front"]
    home = np.append(loaded.targets["forearm"].home.position, 1.0)
    x, y, z = (np.linalg.inv(camera.T_world_camera) @ home)[:3]
    assert 1.2 < z < 1.8
    assert np.hypot(camera.fx * x / z, camera.fy * y / z) < 80


@pytest.mark.parametrize(
    ("old", "new", "place", "reason"),
    [
        ("noise: 6.2e-6", "noise: -1", "pad_types.five.rest.noise", "greater than or equal to 0, got -1"),
        ("rate_hz: 20", "rate: 20", "cameras.front.rate", "not permitted, got 20"),
        ("width: 640", "width: wide", "cameras.front.width", "valid integer"),
        ("p0: {type: five", "p0: {type: six", "pads.p0.type", "one of ['five'] expected, got 'six'"),
        ("mesh: body:forearm", "mesh: arm.stl", "targets.forearm.mesh", "no file"),
        ("low: [-0.08", "low: [0.5", "sim.motion", "lower bound"),
        ("look_at: [0.05, 0.0, 0.15]", "", "cameras.front", "look_at or rpy"),
    ],
)
def test_a_fault_is_told_with_file_line_place_and_reason(tmp_path, old, new, place, reason):
    with pytest.raises(description.CellError) as error:
        load_changed(tmp_path, old, new)
    text = str(error.value)
    line = TABLE[: TABLE.index(old)].count("\n") + 1
    assert place in text and reason in text
    told = int(text.split("cell.yaml:")[1].split(":")[0])
    assert line - 12 <= told <= line


def test_an_unknown_cell_is_answered_with_the_ones_there_are():
    with pytest.raises(description.CellError, match="give one of arm, table"):
        description.load("kitchen")


def test_a_file_that_is_not_yaml_is_told_so(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text("name: [table")
    with pytest.raises(description.CellError, match="not YAML"):
        description.load(path)


def test_asking_for_a_camera_that_does_not_exist_names_those_that_do():
    with pytest.raises(description.CellError, match="no camera 'left': it has front"):
        description.load("table").one("cameras", "left")
