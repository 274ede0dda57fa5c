"""A camera whose lens distorts: its pictures are undistorted once, and give the poses of a camera without distortion."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from penumbra.services.search.tracker import Search
from penumbra.services.segmentation.inference import load_segmenter
from penumbra.shared.body import anatomy
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.messages import Mask
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.lens import Undistortion
from penumbra.shared.perception.lookout import corners_of, window_around
from penumbra.sim.world.world import World

BARREL = {"k1": -0.32, "k2": 0.12, "p1": 0.001, "p2": -0.0015, "k3": -0.02}
TIMES = np.arange(40, 100) * 0.05
PRIOR = np.diag([0.02**2] * 3 + [0.07**2] * 3)


def cell(**distortion: float) -> cells.Cell:
    """The table's cell, its camera turned so that the arm is near the edge, where a lens distorts most."""
    table = cells.load("table")
    camera = table.cameras["front"].model_dump(exclude={"cx"}) | {"cx": 470.0, **distortion}
    return table.model_copy(update={"cameras": {"front": cells.Camera(**camera)}})


@cache
def errors(is_distorted: bool, is_undistorted: bool) -> np.ndarray:
    """Position errors (n,) [m] of segmentation and search on an emulated camera's pictures, each started 2 cm away."""
    seen = cell(**BARREL) if is_distorted else cell()
    world, camera = World(seen, 3), seen.cameras["front"]
    world.occlude(0.0, 0.0)
    undistort, segmenter = Undistortion(camera.lens), load_segmenter()
    search, rng = Search(seen), np.random.default_rng(0)
    corners = corners_of(anatomy.target_mesh(seen.targets["forearm"], seen).vertices)
    out, window = [], None
    for time_s in TIMES:
        T = world.state(time_s).targets["forearm"].T_world_target
        image = world.view("front", time_s).image
        if is_undistorted:
            image = undistort(image)
        window = window_around(camera, [(T, corners)], window)
        assert window is not None
        stamp_ns = round(time_s * 1e9)
        labels = segmenter(image, window, stamp_ns)
        mask = Mask(stamp_ns=stamp_ns, labels=labels, x0=window.x0, y0=window.y0, scale=window.scale)
        start = rigid.perturb(T, rng.normal(size=6) * np.sqrt(np.diag(PRIOR)))
        found = search.update(mask, start, PRIOR, {}, image)
        out.append(np.linalg.norm(found.T[:3, 3] - T[:3, 3]))
    return np.array(out[5:])  # the recurrent network has seen nothing at first


@pytest.mark.slow
def test_a_distorted_camera_gives_the_poses_of_one_that_is_not():
    plain, distorted = np.median(errors(False, False)), np.median(errors(True, True))
    assert distorted < 1.3 * plain + 0.001


def test_a_distortion_that_is_ignored_moves_the_pose():
    assert np.median(errors(True, False)) > 3.0 * np.median(errors(True, True))


def test_the_emulated_picture_is_the_pinhole_s_after_undistortion():
    plain, bent = World(cell(), 3), World(cell(**BARREL), 3)
    for world in (plain, bent):
        world.occlude(0.0, 0.0)
    view, seen = plain.view("front", 2.0), bent.view("front", 2.0)
    assert seen.image.shape == view.image.shape and seen.labels.shape == view.labels.shape
    np.testing.assert_array_equal(seen.labels, view.labels)
    undistorted = Undistortion(cell(**BARREL).cameras["front"].lens)(seen.image).astype(float)
    smooth = [cv2.GaussianBlur(image.astype(np.float32), (0, 0), 2.0) for image in (view.image, undistorted, seen.image)]
    assert np.abs(smooth[1] - smooth[0]).mean() < 0.5 * np.abs(smooth[2] - smooth[0]).mean()  # what is left is the sensor's noise


def test_the_emulated_picture_has_no_empty_border():
    """The lens shows more than the pinhole picture of the same size: that is rendered too."""
    seen = World(cell(**BARREL), 3).view("front", 2.0).image
    assert min(seen[0].std(), seen[-1].std(), seen[:, 0].std(), seen[:, -1].std()) > 1.0


@pytest.mark.parametrize("wrong", [(240, 320), (480, 641)])
def test_a_frame_of_another_size_is_refused(wrong):
    with pytest.raises(ValueError, match="expected a picture of 640 x 480"):
        Undistortion(cell(**BARREL).cameras["front"].lens)(np.zeros((*wrong, 3), np.uint8))
