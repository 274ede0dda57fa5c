"""The cell file: what a good one gives, and the sentence that a bad one gets."""

import numpy as np
import pytest

from penumbra.shared.cell import description, names

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
        ("noise: 6.2e-6", "noise: -1", "pad_types.five.rest.noise", "of at least 0, got -1"),
        ("rate_hz: 20", "rate: 20", "cameras.front.rate", "got rate; did you mean rate_hz"),
        ("width: 640", "width: wide", "cameras.front.width", "expected a whole number, got 'wide'"),
        ("p0: {type: five", "p0: {type: six", "pads.p0.type", "expected one of five, got 'six'"),
        ("mesh: body:forearm", "mesh: arm.stl", "targets.forearm.mesh", "got no file"),
        ("home_spread: {", "tracking_bound: 5\n    home_spread: {", "targets.forearm.tracking_bound", "at most 0.45, got 5"),
        ("low: [-0.08", "low: [0.5", "sim.motion", "lower bound"),
        ("look_at: [0.05, 0.0, 0.15]", "", "cameras.front", "look_at or rpy"),
    ],
)
def test_a_fault_is_reported_with_file_line_place_and_reason(tmp_path, old, new, place, reason):
    with pytest.raises(description.CellError) as error:
        load_changed(tmp_path, old, new)
    text = str(error.value)
    line = TABLE[: TABLE.index(old)].count("\n") + 1
    assert place in text and reason in text
    told = int(text.split("cell.yaml:")[1].split(":")[0])
    assert line - 12 <= told <= line


def test_a_shoulder_belongs_to_the_mesh_whose_elbow_is_known(tmp_path):
    seated = load_changed(tmp_path, "home_spread: {", "shoulder: [0, 0, 1]\n    home_spread: {")
    assert seated.targets["forearm"].shoulder == (0, 0, 1)
    with pytest.raises(description.CellError, match=r"targets\.forearm\.shoulder.*got one with another mesh; leave it out"):
        load_changed(tmp_path, "mesh: body:forearm", "mesh: arm.stl\n    shoulder: [0, 0, 1]")


@pytest.mark.parametrize("read", [description.load, names.read])
def test_an_unknown_cell_is_answered_with_the_ones_there_are(read):
    with pytest.raises(description.CellError, match="give one of arm, table"):
        read("kitchen")


def test_the_names_alone_are_those_of_the_whole_cell(tmp_path):
    for cell in ("table", "arm"):
        whole, found = description.load(cell), names.read(cell)
        assert (found.name, found.targets) == (whole.name, tuple(whole.targets))
        assert found.target(None) == whole.one("targets", None)
        for each in (found.target, lambda name, whole=whole: whole.one("targets", name)):
            with pytest.raises(description.CellError, match=f"cell {cell} has no target 'hand': it has forearm"):
                each("hand")


@pytest.mark.parametrize(
    ("old", "new"), [("name: table", "name: my table"), ("name: table", ""), ("targets:", "target:"), ("forearm:", "7:")]
)
def test_names_that_a_file_does_not_have_are_reported_as_by_the_whole_cell(tmp_path, old, new):
    path = tmp_path / "cell.yaml"
    path.write_text(TABLE.replace(old, new, 1))
    with pytest.raises(description.CellError) as whole:
        description.load(path)
    with pytest.raises(description.CellError) as error:
        names.read(path)
    assert str(error.value) == str(whole.value)


def test_a_file_that_is_not_yaml_is_refused(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text("name: [table")
    with pytest.raises(description.CellError, match="not YAML"):
        description.load(path)


def test_asking_for_a_camera_that_does_not_exist_names_those_that_do():
    with pytest.raises(description.CellError, match="no camera 'left': it has front"):
        description.load("table").one("cameras", "left")


def test_cells_that_were_used_compare_and_hash_by_what_their_files_say():
    first, second = description.load("arm"), description.load("arm")
    for cell in (first, second):
        assert cell.cameras["side"].T_world_camera.shape == cell.robots["panda"].base.transform.shape  # both are kept then
    assert first.cameras == second.cameras and first.robots["panda"] == second.robots["panda"]
    assert hash(first.robots["panda"]) == hash(second.robots["panda"])
    assert first.robots["panda"] != second.robots["panda"].model_copy(update={"joints": ("panda_joint1",)})


def test_a_camera_that_looks_straight_down_has_a_pose():
    camera = description.load("table").cameras["front"].model_dump() | {"position": (0.0, 0.0, 2.0), "look_at": (0.0, 0.0, 0.0)}
    R = description.Camera(**camera).T_world_camera[:3, :3]
    np.testing.assert_allclose(R, [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-12)  # +y is up in the picture


def test_a_copy_with_other_fields_has_what_follows_from_them():
    camera = description.load("table").cameras["front"]
    assert camera.lens.width == camera.width and camera.K[0, 0] == camera.fx
    copy = camera.model_copy(update={"width": 2 * camera.width, "fx": 2 * camera.fx})
    assert copy.lens.width == 2 * camera.width and copy.K[0, 0] == 2 * camera.fx
