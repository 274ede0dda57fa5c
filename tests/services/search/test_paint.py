"""Meshes with colours: what their prints say about a pose, and which files have some."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from PIL import Image

from penumbra.services.search.objects import contest, meshes, paint, region
from penumbra.services.search.objects.pose import RigidObject, Tracker, find_pose, started
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.geometry.rigid import from_rpy, perturb, pose_error
from penumbra.tests.bench.lib import prints
from penumbra.tests.bench.lib.prints import Printed, photographed, printed
from penumbra.tests.bench.objects import CONVERGED, HEIGHT, WIDTH, K, moved

SHAPE = HEIGHT, WIDTH
ABOVE = from_rpy((0.02, -0.01, 0.5), (2.2, 0.3, 0.4))


@pytest.fixture(scope="module")
def cube() -> Printed:
    return printed("cube", 11)


@pytest.mark.parametrize(("name", "degrees"), [("cube", 90.0), ("cube", 180.0), ("box", 180.0)])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_turn_that_leaves_the_contour_as_it_is_is_decided_by_the_print(name, degrees, axis):
    one = printed(name, 11)
    picture = photographed(one, ABOVE, K, SHAPE, 3)
    turned = ABOVE @ from_rpy((0, 0, 0), np.radians(degrees) * np.eye(3)[axis])

    def preferred(rigid: RigidObject) -> float:
        true = ABOVE @ rigid.T_object_middle
        window = region.Window(picture, None, None, K, rigid.shape, true, 0.0)
        at = window.level(window.factors[-1], window.of_pose(rigid.shape.coarse, true, 0.015))
        nothing = started(rigid, ABOVE, (10.0, 10.0))
        both = (
            contest.scored(rigid.shape, rigid.shape.fine, at, T @ rigid.T_object_middle, nothing, True) for T in (ABOVE, turned)
        )
        right, wrong = (found.score for found in both)
        return right - wrong

    assert abs(preferred(one.plain)) < contest.CONVINCING
    assert preferred(one.rigid) > 2.0 * contest.CONVINCING


@pytest.mark.parametrize("hidden", [0.0, 0.3])
def test_the_turn_of_a_can_is_known_by_its_print_also_where_a_part_is_hidden(hidden):
    one = printed("can", 4)
    picture = photographed(one, ABOVE, K, SHAPE, 5, hidden)
    start = ABOVE @ from_rpy((0, 0, 0), (0.0, 0.0, np.radians(20.0)))
    found = find_pose(one.rigid, None, K, start, picture=picture)
    error, axis = pose_error(ABOVE, found.T), found.T[:3, 2]
    assert np.linalg.norm(error[3:]) < np.radians(3.0)
    assert np.sqrt(axis @ found.covariance[3:, 3:] @ axis) < np.radians(3.0)
    assert error @ np.linalg.solve(found.covariance, error) < 22.5  # 99.9 % of chi^2 with six degrees of freedom


def test_an_object_that_a_thing_slides_over_is_followed_by_its_print(cube):
    start = moved(ABOVE, 5.0, 0.01, np.random.default_rng(0))
    with_print, plain = Tracker(cube.rigid, K, start), Tracker(cube.plain, K, start)
    whole = photographed(cube, ABOVE, K, SHAPE, 7)
    columns = np.flatnonzero(cube.rigid.shape.fine.silhouette(ABOVE, K, (0, 0, WIDTH, HEIGHT)).any(axis=0))
    for share in (0.0, 0.0, 0.05, 0.1, 0.15):  # of its width; the thing is of one colour
        picture = whole.copy()
        picture[:, : columns[0] + int(share * len(columns))] = (180, 90, 30)
        found = with_print.update(None, None, picture)
        assert found.state == "tracking"
        assert cube.error(found.T, ABOVE) < CONVERGED
        by_contour = plain.update(None, None, picture)
        assert by_contour.state == "doubtful" or cube.error(by_contour.T, ABOVE) < CONVERGED / 5


def test_another_print_is_not_taken_for_the_objects(cube):
    picture = photographed(printed("cube", 12), ABOVE, K, SHAPE, 3)
    window = region.Window(picture, None, None, K, cube.rigid.shape, ABOVE, 0.0)
    at = window.level(window.factors[-1], np.zeros(region.BINS**3, np.float32))
    compared = at.compared(cube.rigid.shape, ABOVE @ cube.rigid.T_object_middle)
    assert compared is not None
    assert compared.score < contest.CONVINCING


def test_light_and_tint_change_the_likelihood_of_a_print_little(cube):
    picture = photographed(cube, ABOVE, K, SHAPE, 3)
    scores = []
    for one in (picture, (picture * (0.9, 0.7, 0.5)).astype(np.uint8)):
        window = region.Window(one, None, None, K, cube.rigid.shape, ABOVE, 0.0)
        at = window.level(window.factors[-1], np.zeros(region.BINS**3, np.float32))
        compared = at.compared(cube.rigid.shape, ABOVE @ cube.rigid.T_object_middle)
        assert compared is not None
        scores.append(compared.score)
    assert min(scores) > 0.7 * max(scores)


def test_steps_by_the_print_alone_lead_to_the_true_pose(cube):
    picture, true = photographed(cube, ABOVE, K, SHAPE, 3), ABOVE @ cube.rigid.T_object_middle
    T = moved(true, 4.0, 0.004, np.random.default_rng(2))
    window = region.Window(picture, None, None, K, cube.rigid.shape, true, 0.0)
    at = window.level(window.factors[0], np.zeros(region.BINS**3, np.float32))
    for _ in range(6):
        compared = at.compared(cube.rigid.shape, T)
        assert compared is not None
        H, g = compared.information
        np.testing.assert_allclose(H, H.T, atol=1e-6 * np.abs(H).max())
        T = perturb(T, np.linalg.solve(H, g))
    assert cube.error(T @ cube.rigid.T_middle_object, ABOVE) < 0.02  # the print is off by 1 mm, the size by up to 1 %


# --- files ------------------------------------------------------------------------------------------------------------------


def test_a_mesh_of_one_colour_has_no_print_and_gives_the_same_pose(cube, tmp_path):
    grey = trimesh.Trimesh(
        cube.mesh.vertices, cube.mesh.faces, vertex_colors=np.full((len(cube.mesh.vertices), 3), 120, np.uint8), process=False
    )
    grey.export(tmp_path / "grey.ply")
    rigid = RigidObject(*meshes.load(tmp_path / "grey.ply", "m"))
    assert rigid.shape.paints is None
    picture, start = photographed(cube, ABOVE, K, SHAPE, 3), moved(ABOVE, 15.0, 0.02, np.random.default_rng(1))
    grey_T, plain_T = (find_pose(one, None, K, start, picture=picture).T for one in (rigid, cube.plain))
    np.testing.assert_allclose(grey_T, plain_T, atol=1e-4)


def test_a_mesh_without_colours_has_no_print(tmp_path):
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "box.stl")
    assert meshes.load(tmp_path / "box.stl", "m")[1] is None


@pytest.mark.parametrize("suffix", ["ply", "glb", "obj"])
def test_colours_of_vertices_are_read_at_their_places_in_metres(cube, tmp_path, suffix):
    scaled = cube.mesh.copy()
    scaled.apply_scale(1000.0)
    scaled.export(tmp_path / f"cube.{suffix}")
    mesh, found = meshes.load(tmp_path / f"cube.{suffix}", "mm")
    assert found is not None
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([0.085] * 3, rel=1e-3)
    vertex = np.argmin(np.linalg.norm(cube.mesh.vertices[:, None] - found.points[None, ::40], axis=2), axis=0)
    wanted = np.asarray(cube.mesh.visual.vertex_colors, float)[vertex, :3]
    assert np.median(np.abs(found.colours[::40] - wanted)) < 5.0


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_the_picture_of_a_texture_is_read_the_right_way_up(tmp_path, suffix):
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], float)
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32, :, 0], picture[32:, :, 2] = 250, 250  # its upper half is red, its lower half blue
    material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(picture))
    if suffix == "glb":
        material = material.to_pbr()
    visual = trimesh.visual.TextureVisuals(uv=corners[:, :2] / 0.1, material=material)
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False).export(tmp_path / f"sheet.{suffix}")
    _, found = meshes.load(tmp_path / f"sheet.{suffix}", "m")
    assert found is not None
    assert (found.colours[found.points[:, 1] > 0.055] == (250, 0, 0)).all()
    assert (found.colours[found.points[:, 1] < 0.045] == (0, 0, 250)).all()


def test_points_are_spread_evenly_over_a_surface():
    body = prints.MAKERS["box"]()
    points, face, weights = paint.spread_over(np.asarray(body.vertices), np.asarray(body.faces), 3000)
    np.testing.assert_allclose(np.einsum("nc,ncd->nd", weights, body.vertices[body.faces[face]]), points)
    share = np.bincount(face, minlength=len(body.faces)) / 3000
    np.testing.assert_allclose(share, body.area_faces / body.area, atol=1e-3)


def test_paint_is_about_the_points_of_the_mesh_that_is_drawn(cube):
    whole = Mesh(np.asarray(cube.mesh.vertices), np.asarray(cube.mesh.faces, np.int32), np.zeros(len(cube.mesh.faces), np.uint8))
    colours = paint.cloud(cube.mesh)
    assert colours is not None
    found = paint.painted(whole, colours)
    assert found is not None
    assert [len(one.points) for one in found] == list(paint.POINTS)
    assert all((np.abs(one.points).max(axis=1) == pytest.approx(0.0425)) for one in found)
    assert all((np.sum(one.normals * one.points, axis=1) > 0.0).all() for one in found)
