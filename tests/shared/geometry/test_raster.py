"""The rasteriser against geometry that can be worked out by hand."""

import numpy as np

from penumbra.shared.body import anatomy
from penumbra.shared.cell import description
from penumbra.shared.geometry import raster, rigid

K = (100.0, 100.0, 49.5, 49.5)


def square(z: float, half: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def test_a_square_covers_the_pixels_whose_centres_it_covers_and_has_its_depth():
    view = raster.Raster(100, 100)
    view.draw(*square(1.0), *K, 7)
    expected = np.zeros((100, 100), bool)
    expected[30:70, 30:70] = True  # 49.5 +- 20 px, centres at integers
    np.testing.assert_array_equal(view.ids == 7, expected)
    np.testing.assert_allclose(view.depth[expected], 1.0, rtol=1e-6)
    assert np.isinf(view.depth[~expected]).all() and (view.ids[~expected] == raster.EMPTY).all()


def test_the_nearer_triangle_wins_in_whatever_order_they_are_drawn():
    for order in ((1.0, 2.0), (2.0, 1.0)):
        view = raster.Raster(100, 100)
        for z in order:
            view.draw(*square(z, 0.3), *K, int(z))
        assert view.ids[50, 50] == 1


def test_triangles_that_share_edges_leave_no_hole_and_cover_nothing_twice():
    rng = np.random.default_rng(3)
    for _ in range(20):
        # a fan around a random middle: every pixel inside belongs to exactly one triangle
        angle = np.sort(rng.uniform(0, 2 * np.pi, 9))
        rim = np.stack([np.cos(angle), np.sin(angle)], axis=1) * 0.4
        vertices = np.column_stack([np.vstack([rng.uniform(-0.1, 0.1, 2), rim]), np.ones(10)])
        faces = np.array([[0, 1 + i, 1 + (i + 1) % 9] for i in range(9)], np.int32)
        covered = np.sum([raster.silhouette(vertices, faces[i : i + 1], K, (0, 0, 100, 100)) for i in range(9)], axis=0)
        together = raster.silhouette(vertices, faces, K, (0, 0, 100, 100))
        assert covered.max() <= 2  # 2 only where the middle lies outside the rim's polygon and the fan folds
        np.testing.assert_array_equal(covered > 0, together)
        if angle.max() - angle.min() > np.pi and np.max(np.diff(angle)) < 2.5 and angle[0] + 2 * np.pi - angle[-1] < 2.5:
            assert covered.max() == 1


def test_a_triangle_through_the_camera_is_cut_at_the_near_plane():
    vertices = np.array([[0.0, 0.1, -1.0], [-0.5, 0.1, 2.0], [0.5, 0.1, 2.0]])
    mask = raster.silhouette(vertices, np.array([[0, 1, 2]], np.int32), K, (0, 0, 100, 100))
    rows = np.flatnonzero(mask.any(axis=1))
    assert rows[0] == 55  # the far edge at z = 2: v = 49.5 + 100 * 0.1 / 2
    assert rows[-1] == 99  # and down to the border
    view = raster.Raster(100, 100)
    view.draw(vertices, np.array([[0, 1, 2]], np.int32), *K, 1)
    np.testing.assert_array_equal(view.ids == 1, mask)


def test_a_window_shows_the_same_pixels_as_the_whole_image():
    loaded = description.load("table")
    camera, mesh = loaded.cameras["front"], anatomy.forearm_mesh(loaded.body)
    vertices = rigid.apply(rigid.inverse(camera.T_world_camera) @ rigid.from_rpy((0, 0, 0.2), (0.2, 0.1, 0)), mesh.vertices)
    k = (camera.fx, camera.fy, camera.cx, camera.cy)
    whole = raster.silhouette(vertices, mesh.faces, k, (0, 0, 640, 480))
    np.testing.assert_array_equal(raster.silhouette(vertices, mesh.faces, k, (200, 130, 160, 120)), whole[130:250, 200:360])
    assert whole.sum() > 3000
