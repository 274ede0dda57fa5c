"""Pictures for tests and benchmarks of vision: what is asked for is what they show."""

import itertools

import numpy as np
import pytest

from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import raster, rigid
from penumbra.sim.sets import shots


def silhouette(shot: shots.Shot) -> np.ndarray:
    camera = shot.camera
    vertices = rigid.apply(shot.T_camera_target, shot.mesh.vertices)
    k = (camera.fx, camera.fy, camera.cx, camera.cy)
    return raster.silhouette(vertices, shot.mesh.faces, k, (0, 0, camera.width, camera.height))


@pytest.mark.parametrize("hidden", [0.0, 0.3, 0.6, 0.85, 0.97])
def test_the_share_asked_for_is_hidden(hidden):
    for index in range(6):
        shot = shots.shot(31, index, 320, 240, 1.5, hidden, images=False)
        whole = silhouette(shot)
        seen = np.isin(shot.labels, (Label.FOREARM, Label.HAND))
        assert not (seen & ~whole).any()  # the pose and the mesh told are those of the picture
        measured = 1.0 - seen.sum() / whole.sum()
        assert measured == pytest.approx(shot.hidden, abs=1e-9)
        assert measured == pytest.approx(hidden, abs=shots.WITHIN) or (hidden == 0.0 and measured <= shots.UPPER_ARM)


def test_only_robot_upper_arm_and_occluder_cover_the_target():
    for index in range(12):
        shot = shots.shot(32, index, 320, 240, 1.5, 0.3, images=False)
        over = shot.labels[silhouette(shot)]
        foreign = np.isin(over, (Label.BACKGROUND, Label.TORSO)).mean()
        assert foreign < 0.02


@pytest.mark.parametrize("size, distance_m", [((320, 240), 1.5), ((640, 480), 4.5), ((1280, 960), 8.0)])
def test_the_target_lies_wholly_in_the_picture_at_the_distance(size, distance_m):
    for index in range(6):
        shot = shots.shot(33, index, size[0], size[1], distance_m, images=False)
        whole = silhouette(shot)
        border = np.concatenate([whole[: shots.BORDER_PX].ravel(), whole[:, -shots.BORDER_PX :].ravel()])
        assert whole.any() and not border.any()
        middle = rigid.apply(shot.T_camera_target, shot.mesh.vertices.mean(axis=0))
        assert middle[2] == pytest.approx(distance_m, rel=0.02)
        assert 2.0 * np.degrees(np.arctan(shot.camera.width / 2.0 / shot.camera.fx)) == pytest.approx(60.0)


def test_a_picture_is_a_function_of_seed_and_index_and_its_labels_do_not_depend_on_paint():
    first, again, bare = (shots.shot(34, 3, 320, 240, 1.5, 0.6, images=images) for images in (True, True, False))
    np.testing.assert_array_equal(first.image, again.image)
    np.testing.assert_array_equal(first.labels, bare.labels)
    assert bare.image is None
    assert not np.array_equal(first.labels, shots.shot(35, 3, 320, 240, 1.5, 0.6, images=False).labels)


def test_robots_stand_where_cell_and_joints_say():
    from penumbra.shared.perception.intrinsics import Intrinsics
    from penumbra.shared.perception.robot_depth import RobotDepth

    index = next(i for i in range(1, 40, 2) if shots.shot(36, i, 320, 240, images=False).joints)
    shot = shots.shot(36, index, 320, 240, images=False)
    depth = RobotDepth(shot.cell, rigid.inverse(shot.camera.T_world_camera)).render(
        shot.joints, Intrinsics.of_window(shot.camera, 0, 0, 1), shot.labels.shape
    )
    robot = shot.labels == Label.ROBOT
    assert robot.any()
    assert (np.isfinite(depth) | ~robot).mean() > 0.99  # but for the pads' plates


def test_a_film_moves_little_by_little_and_ends_in_the_picture_asked_for():
    film = shots.clip(37, 2, 320, 240, 1.5, 0.6, frames=4, images=False)
    assert film[-1].hidden == pytest.approx(0.6, abs=shots.WITHIN)
    assert np.diff([shot.stamp_ns for shot in film]).tolist() == [round(shots.PERIOD_S * 1e9)] * 3
    for before, after in itertools.pairwise(film):
        error = rigid.pose_error(after.T_world_target, before.T_world_target)
        assert np.abs(error[:3]).max() < 0.5 * shots.PERIOD_S + 1e-9
        np.testing.assert_allclose(after.velocity * shots.PERIOD_S, error, atol=1e-3)


def test_a_board_passes_and_hides_everything_for_a_while():
    hidden = np.array([shot.hidden for shot in shots.passing(38, 0, 320, 240, "easy")])
    gone = np.flatnonzero(np.diff((hidden > 0.999).astype(int)) == 1)
    assert len(gone) >= 2
    assert 0.02 < (hidden > 0.999).mean() < 0.6
    assert np.median(hidden) < 0.2


def test_a_share_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"expected a share from 0 to 1, got 1\.2"):
        shots.shot(1, 0, hidden=1.2)
