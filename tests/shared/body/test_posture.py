"""Where the rest of a person is."""

import numpy as np
import pytest

from penumbra.shared.body.posture import ASSUMED, STATED, Posture
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid


@pytest.fixture(scope="module")
def table() -> cells.Cell:
    return cells.load("table")


def test_a_shoulder_that_nobody_states_is_an_upper_arm_from_the_elbow_behind_and_above(table: cells.Cell) -> None:
    target = table.targets["forearm"]
    usual, home = Posture.usual(table, target), target.home.transform
    assert usual is not None and usual.spread == ASSUMED
    elbow = home[:3, 3] - usual.elbow * home[:3, 0]
    away = usual.shoulder - elbow
    assert np.linalg.norm(away) == pytest.approx(table.body.upper_arm_length)
    assert away @ home[:3, 0] < 0.0 < away[2]


def test_a_stated_shoulder_is_taken_and_better_known(table: cells.Cell) -> None:
    usual = Posture.usual(table, table.targets["forearm"].model_copy(update={"shoulder": (-0.4, 0.1, 0.5)}))
    assert usual is not None and usual.spread == STATED < ASSUMED
    np.testing.assert_array_equal(usual.shoulder, [-0.4, 0.1, 0.5])


def test_a_mesh_of_ones_own_has_nobody_behind_it(table: cells.Cell) -> None:
    assert Posture.usual(table, table.targets["forearm"].model_copy(update={"mesh": "arm.stl"})) is None


def test_the_upper_arm_meets_the_elbow_and_the_torso_the_shoulder_and_stays_upright(table: cells.Cell) -> None:
    usual = Posture.usual(table, table.targets["forearm"])
    assert usual is not None
    rng = np.random.default_rng(0)
    T = np.stack([rigid.from_rpy(rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.5, 0.5, 3)) for _ in range(5)])
    upper_arm, torso = usual.poses(T)
    elbows = T[:, :3, 3] - usual.elbow * T[:, :3, 0]
    np.testing.assert_allclose(upper_arm[:, :3, 3] + usual.upper_arm * upper_arm[:, :3, 0], elbows, atol=1e-12)
    np.testing.assert_allclose(torso[:, :3, 3], upper_arm[:, :3, 3])
    np.testing.assert_allclose(torso[:, :3, 2], np.tile([0.0, 0.0, 1.0], (5, 1)), atol=1e-12)
    toward = usual.shoulder - upper_arm[:, :3, 3]
    np.testing.assert_allclose(np.cross(toward, upper_arm[:, :3, 0]), 0.0, atol=1e-12)
