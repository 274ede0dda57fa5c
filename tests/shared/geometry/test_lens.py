"""Lenses: OpenCV's distortion, both ways, and pictures without it."""

from typing import Any

import cv2
import numpy as np
import pytest

from penumbra.shared.geometry.lens import COEFFICIENTS, Lens, Undistortion

SIZE: dict[str, Any] = {"width": 320, "height": 240, "fx": 250.0, "fy": 248.0, "cx": 161.3, "cy": 118.2}
BARREL = Lens(**SIZE, k1=-0.31, k2=0.12, p1=0.0012, p2=-0.0008, k3=-0.02)
PINCUSHION = Lens(**SIZE, k1=0.2, k2=-0.05, p1=-0.001, p2=0.002)
K = np.array([[250.0, 0.0, 161.3], [0.0, 248.0, 118.2], [0.0, 0.0, 1.0]])


def coefficients(lens: Lens) -> np.ndarray:
    return np.array([getattr(lens, name) for name in COEFFICIENTS])


def picture() -> np.ndarray:
    noise = np.random.default_rng(1).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 3.0))


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION])
def test_points_are_distorted_as_opencv_projects_them(lens):
    rays = np.random.default_rng(0).uniform((-0.5, -0.4, 1.0), (0.5, 0.4, 1.0), (100, 3))
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, coefficients(lens))
    pinhole = rays[:, :2] * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    np.testing.assert_allclose(lens.distorted(pinhole), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION])
def test_undistorted_points_are_those_that_the_lens_shows_there(lens):
    grid = lens.grid()
    np.testing.assert_allclose(lens.distorted(lens.undistorted(grid)), grid, atol=1e-5)
    expected = cv2.undistortImagePoints(grid.reshape(-1, 1, 2), K, coefficients(lens), arg1=(3, 200, 1e-12))
    np.testing.assert_allclose(lens.undistorted(grid).reshape(-1, 2), expected[:, 0], atol=1e-3)


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION])
def test_a_picture_is_undistorted_as_by_opencv(lens):
    found = Undistortion(lens)(picture()).astype(int)
    expected = cv2.undistort(picture(), K, coefficients(lens)).astype(int)
    assert np.abs(found - expected).max() <= 1


def test_a_part_of_a_picture_is_that_of_the_whole_and_the_rest_is_black():
    undistort = Undistortion(BARREL)
    part = undistort(picture(), (40, 30, 200, 400))
    np.testing.assert_array_equal(part[30:, 40:200], undistort(picture())[30:, 40:200])
    assert not part[:30].any() and not part[:, 200:].any()


def test_a_pinhole_s_picture_is_the_camera_s():
    undistort, image = Undistortion(Lens(**SIZE)), picture()
    assert undistort(image) is image
    assert undistort.unseen is None


def test_what_the_camera_does_not_show_is_known():
    assert Undistortion(BARREL).unseen is None  # the camera sees more than the pinhole picture shows
    unseen = Undistortion(PINCUSHION).unseen
    assert unseen is not None and unseen[0, 0] and unseen[-1, -1] and not unseen[60:180, 80:240].any()
    white = Undistortion(PINCUSHION)(np.full((240, 320, 3), 255, np.uint8))
    assert not white[unseen].all() and (white[~cv2.dilate(unseen.astype(np.uint8), np.ones((3, 3))).astype(bool)] == 255).all()


def test_a_picture_of_another_size_is_refused():
    for lens in (BARREL, Lens(**SIZE)):
        with pytest.raises(ValueError, match="expected a picture of 320 x 240, got 160 x 120"):
            Undistortion(lens)(picture()[::2, ::2])


def test_beyond_the_fold_of_a_distortion_nothing_is_seen():
    """A polynomial that fits the picture turns back outside of it, and would show the scene mirrored there."""
    lens = Lens(width=320, height=240, fx=160.0, fy=160.0, cx=159.5, cy=119.5, k1=-0.25)
    grid = lens.grid()
    radius = np.linalg.norm((grid - (159.5, 119.5)) / 160.0, axis=-1)
    assert not lens.faults()
    assert not lens.is_seen(grid)[radius > np.sqrt(1.0 / 0.75) + 0.01].any()
    assert np.isnan(Lens(**{**SIZE, "fx": 120.0, "fy": 120.0}, k1=-0.25).undistorted((0.0, 0.0))).all()


@pytest.mark.parametrize(
    ("changed", "place", "words"),
    [
        ({"fx": 161.3}, "fx", "not swapped with cx"),
        ({"fx": 4.0, "fy": 4.0}, "fx", "whether it is in millimetres"),
        ({"cx": 400.0}, "cx", "principal point in the picture, from 0 to 319, got 400"),
        ({"k1": 31.0}, "k1", "from -20 to 20, got 31"),
        ({"k1": -8.0}, "k1", "folds over"),
    ],
)
def test_what_cannot_be_a_camera_s_is_reported(changed, place, words):
    found = Lens(**{**SIZE, **changed}).faults()
    assert found[0][0] == place and words in found[0][1]
    assert not Lens(**SIZE).faults() and not BARREL.faults() and not PINCUSHION.faults()
