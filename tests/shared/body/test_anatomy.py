"""The person's meshes: closed, of the measures asked for, and replaceable by a user's own."""

import numpy as np
import pytest
import trimesh

from penumbra.shared.body import anatomy
from penumbra.shared.cell import description
from penumbra.shared.contract.labels import Label


def solid(mesh: anatomy.Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("make", [anatomy.forearm_mesh, anatomy.upper_arm_mesh, anatomy.torso_mesh])
def test_a_part_is_closed_and_its_faces_look_outwards(make):
    mesh = solid(make(description.Body()))
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0


def test_the_forearm_has_the_measures_asked_for():
    measures = description.Body(forearm_length=0.28, hand_length=0.2, forearm_circumference=0.3, wrist_circumference=0.18)
    mesh = anatomy.forearm_mesh(measures)
    forearm = mesh.vertices[np.unique(mesh.faces[mesh.labels == Label.FOREARM])]
    hand = mesh.vertices[np.unique(mesh.faces[mesh.labels == Label.HAND])]
    assert np.ptp(forearm[:, 0]) == pytest.approx(0.28)
    assert (forearm[:, 0].min(), hand[:, 0].max()) == pytest.approx((-0.14, 0.14 + 0.2))
    for x, around in ((-0.14 + 0.25 * 0.28, 0.3), (0.1399, 0.18)):
        section = solid(mesh).section(plane_origin=(x, 0, 0), plane_normal=(1, 0, 0))
        assert section is not None
        largest = max(np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in section.discrete)
        assert largest == pytest.approx(around, rel=0.02)  # a polygon of 18 corners is 0.5 % shorter than its ellipse


def test_the_thumb_is_on_the_side_of_positive_y_so_that_roll_can_be_seen():
    mesh = anatomy.forearm_mesh(description.Body())
    assert mesh.vertices[:, 1].max() > -mesh.vertices[:, 1].min() + 0.02


def test_a_user_s_mesh_is_read_from_beside_the_cell_file(tmp_path):
    trimesh.creation.cylinder(0.04, 0.4).export(tmp_path / "limb.stl")
    loaded = description.load("table").model_copy(update={"folder": tmp_path})
    target = loaded.targets["forearm"].model_copy(update={"mesh": "limb.stl"})
    mesh = anatomy.target_mesh(target, loaded)
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx((0.08, 0.08, 0.4), abs=1e-3)
    assert (mesh.labels == Label.FOREARM).all()


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (lambda path: path.write_text("no mesh"), "triangle mesh"),
        (lambda path: trimesh.creation.box((400, 80, 80)).export(path), "scale it by 0.001 to metres"),
    ],
)
def test_a_mesh_that_cannot_be_a_limb_is_refused_with_the_reason(tmp_path, write, reason):
    write(tmp_path / "limb.stl")
    loaded = description.load("table").model_copy(update={"folder": tmp_path})
    target = loaded.targets["forearm"].model_copy(update={"mesh": "limb.stl"})
    with pytest.raises(description.CellError, match=reason):
        anatomy.target_mesh(target, loaded)


def test_a_target_in_its_size_is_the_mesh_stretched():
    table = description.load("table")
    large = table.targets["forearm"].model_copy(update={"size": description.Size(length=1.1, girth=0.9)})
    vertices = anatomy.target_mesh(table.targets["forearm"], table).vertices
    np.testing.assert_allclose(anatomy.target_mesh(large, table).vertices, vertices * (1.1, 0.9, 0.9))
