"""Lost arms looked for by landmarks. The models are not part of the project: what needs them runs where `penumbra segmentation
models` has fetched them."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from penumbra.services.search.contour import Model
from penumbra.services.search.refinder import EVERY_NS, FRESH_NS, LOST_NS, Refinder
from penumbra.services.search.tracker import Search
from penumbra.shared.body import anatomy
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import Label
from penumbra.shared.contract.messages import Mask
from penumbra.shared.geometry import rigid
from penumbra.shared.perception import landmarks
from penumbra.shared.perception.intrinsics import Intrinsics
from penumbra.sim.sets import shots

CELL = cells.load("table")
CAMERA, TARGET = "front", "forearm"
needs_models = pytest.mark.skipif(
    not landmarks.is_installed(landmarks.kept()), reason="needs the models that `penumbra segmentation models` fetches"
)


def never() -> np.ndarray:
    raise AssertionError("nobody should look")


def test_without_models_nothing_is_looked_for_and_the_report_says_what_to_install(tmp_path):
    refinder = Refinder(CELL, tmp_path)
    for k in range(5):
        refinder.ask(CAMERA, [TARGET], k * LOST_NS, never)
        refinder.look()
    assert refinder.starts(CAMERA, TARGET, 4 * LOST_NS) == ()
    assert refinder.describe() == {
        "is_installed": False,
        "missing": f"no landmark models in {tmp_path}; do penumbra segmentation models",
        "looks": 0,
    }


def test_models_that_are_no_such_files_are_given_up(tmp_path):
    for name in landmarks.FILES:
        (tmp_path / name).write_bytes(b"something else")
    refinder = Refinder(CELL, tmp_path)
    refinder.ask(CAMERA, [TARGET], 0, never)
    refinder.ask(CAMERA, [TARGET], LOST_NS, never)
    with pytest.raises(landmarks.ModelsError, match="remove it and fetch it again"):
        refinder.look()
    refinder.ask(CAMERA, [TARGET], LOST_NS + EVERY_NS, never)
    refinder.look()
    assert "remove it and fetch it again" in refinder.missing


@needs_models
def test_an_arm_is_looked_for_once_it_is_lost_for_a_while_and_seldom():
    refinder, image = Refinder(CELL, landmarks.kept()), np.zeros((480, 640, 3), np.uint8)
    looked: list[int] = []
    for stamp_ns in range(0, 900_000_000, 50_000_000):
        lost = [TARGET] if stamp_ns != 100_000_000 else []  # found once in between: the time begins again

        def undistorted(stamp_ns: int = stamp_ns) -> np.ndarray:
            looked.append(stamp_ns)
            return image

        refinder.ask(CAMERA, lost, stamp_ns, undistorted)
        refinder.look()
    assert looked == [150_000_000 + LOST_NS, 150_000_000 + LOST_NS + EVERY_NS]
    assert refinder.describe()["looks"] == 2


@needs_models
def test_a_hand_in_the_picture_gives_poses_near_the_arm_once_and_only_while_they_are_fresh():
    found = []
    for index in range(6):
        shot = shots.shot(1, index, domain="easy", hands="posed")
        assert shot.image is not None
        camera, target = next(iter(shot.cell.cameras)), next(iter(shot.cell.targets))
        refinder, shown = Refinder(shot.cell, landmarks.kept()), functools.partial(np.copy, shot.image)
        refinder.ask(camera, [target], 0, never)
        refinder.ask(camera, [target], LOST_NS, shown)
        refinder.look()
        starts = refinder.starts(camera, target, LOST_NS)
        assert not refinder.starts(camera, target, LOST_NS)
        found.append(min((rigid.axis_angle_error(shot.T_camera_target, T) for T in starts), default=np.pi))
    assert np.median(found) < np.radians(30.0), np.degrees(found)
    refinder.ask(camera, [target], LOST_NS + EVERY_NS, shown)
    refinder.look()
    assert not refinder.starts(camera, target, LOST_NS + EVERY_NS + FRESH_NS + 1)


def test_an_arm_is_found_from_a_start_before_its_shape_is_looked_for_again():
    camera = CELL.cameras[CAMERA]
    T_home = rigid.inverse(camera.T_world_camera) @ CELL.targets[TARGET].home.transform
    T = rigid.perturb(T_home, [0.02, 0.01, 0.1, 0.1, 0.4, -0.1])
    model = Model(anatomy.target_mesh(CELL.targets[TARGET], CELL))
    shown = model.silhouette(T, Intrinsics.of_window(camera, 0, 0, 1), (0, 0, camera.width, camera.height))
    empty, mask = (
        Mask(stamp_ns=stamp_ns, labels=labels * np.uint8(Label.FOREARM), x0=0, y0=0, scale=1)
        for stamp_ns, labels in ((10**9, np.zeros_like(shown)), (10**9 + 50_000_000, shown))
    )
    start = rigid.perturb(T, [0.0, 0.01, 0.06, 0.1, -0.1, 0.1])
    elsewhere = rigid.perturb(T, [0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    search = Search(CELL)
    assert search.update(empty).state == "lost"
    assert search.update(mask).state == "lost"  # its shape was looked for 50 ms ago
    found = search.update(mask, starts=[elsewhere, start])
    assert found.state == "tracking"
    assert np.linalg.norm((camera.T_world_camera @ T - found.T)[:3, 3]) < 0.02
