"""The skin: response law, electrodes, nearest points on meshes, and the emulated voltages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import trimesh

from shared import cell as cells
from shared import geometry, skin
from shared.surface import Surface
from sim.skin import SkinModel


@dataclass(frozen=True)
class Body:
    vertices: np.ndarray
    faces: np.ndarray


def body(shape: trimesh.Trimesh) -> Body:
    return Body(np.array(shape.vertices), np.array(shape.faces, dtype=np.int32))


def winding_number(shape: Body, points: np.ndarray) -> np.ndarray:
    """One inside, zero outside: the solid angle of all triangles (van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(shape.vertices[shape.faces][None] - points[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    top = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
    bottom = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return np.arctan2(top, bottom).sum(axis=1) / (2 * np.pi)


@pytest.fixture(scope="module")
def table() -> cells.Cell:
    return cells.load("table")


def test_the_law_falls_from_contact_to_nothing_and_its_inverse_gives_the_gap_back(table: cells.Cell) -> None:
    law = table.pad_types["five"].law
    gaps = np.linspace(0.0, 0.4, 200)
    amplitude = skin.volts(law, gaps, gain=1.3)
    assert amplitude[0] == pytest.approx(law.a3 + 1.3 * law.a1)
    assert (np.diff(amplitude) < 0).all()
    np.testing.assert_allclose(skin.gap(law, amplitude, gain=1.3), gaps, atol=1e-9)


def test_the_published_table_of_gaps_and_signals_is_reproduced(table: cells.Cell) -> None:
    law = table.pad_types["five"].law
    signal = skin.volts(law, [0.01, 0.02, 0.05, 0.10, 0.15]) - law.a3
    # the boundary-element table of the pad; its law is a fit in log space, so a tenth of a value may differ
    np.testing.assert_allclose(1e3 * signal, [614, 219, 33, 8.4, 3.95], rtol=0.1)


def test_a_pad_in_shunt_mode_reads_less_near_a_person_and_inverts_all_the_same(table: cells.Cell) -> None:
    law = table.pad_types["five"].law.model_copy(update={"polarity": -1, "a3": 3.0})
    assert skin.volts(law, 0.02) < skin.volts(law, 0.10) < law.a3
    assert skin.gap(law, skin.volts(law, 0.05)) == pytest.approx(0.05)


def test_a_voltage_that_no_gap_gives_is_clipped_to_contact_or_to_far_away(table: cells.Cell) -> None:
    law = table.pad_types["five"].law
    assert skin.gap(law, law.a3 + 2 * law.a1) == 0.0
    assert skin.gap(law, law.a3 - 0.01, farthest=0.7) == pytest.approx(0.7)


def test_electrodes_follow_the_link_that_carries_their_pad(table: cells.Cell) -> None:
    pads = {"a": cells.Pad(type="five", link="panda/hand", position=(0, 0, 0.1), rpy=(0, 0, np.pi / 2))}
    robots = {"panda": cells.Robot(urdf="pybullet:franka_panda/panda.urdf", joints=("panda_joint1",))}
    moving = skin.Skin(table.model_copy(update={"pads": pads, "robots": robots}))
    T = geometry.from_rpy((1, 2, 3), (0, 0, 0))
    electrodes = moving.positions(moving.T_world_pads(skin.link_names({"panda": {"hand": T}})))
    # the pad is turned by a quarter: its right electrode points along y
    np.testing.assert_allclose(electrodes[1], [1 + 0.00016, 2 + 0.02415, 3.1], atol=1e-9)
    with pytest.raises(ValueError, match=r"links \['panda/hand'\] expected"):
        moving.T_world_pads()


def test_a_cell_without_pads_is_refused_in_words(table: cells.Cell) -> None:
    with pytest.raises(ValueError, match="cell table has no pads"):
        skin.Skin(table.model_copy(update={"pads": {}}))


def test_nearest_points_agree_with_trimesh_and_the_sign_with_the_winding_number() -> None:
    shape = body(trimesh.creation.cone(0.06, 0.2, sections=17))  # sharp edges and a sharp tip
    points = np.random.default_rng(0).uniform(-0.12, 0.25, (800, 3))
    distance, nearest, gradient = Surface(shape.vertices, shape.faces).nearest(points)
    reference, length, _ = trimesh.proximity.closest_point_naive(trimesh.Trimesh(shape.vertices, shape.faces), points)
    np.testing.assert_allclose(np.abs(distance), length, atol=1e-12)
    np.testing.assert_allclose(nearest, reference, atol=1e-9)
    np.testing.assert_array_equal(distance < 0, winding_number(shape, points) > 0.5)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0)


def test_the_gradient_is_the_derivative_of_the_distance() -> None:
    shape = body(trimesh.creation.capsule(height=0.2, radius=0.04))
    surface = Surface(shape.vertices, shape.faces)
    points = np.random.default_rng(1).uniform(-0.15, 0.25, (50, 3))
    distance, _, gradient = surface.nearest(points)
    step = 1e-6
    numeric = np.stack([(surface.nearest(points + step * e)[0] - distance) / step for e in np.eye(3)], axis=1)
    np.testing.assert_allclose(gradient, numeric, atol=1e-3)  # second differences of a curvature of 1/1 cm


@pytest.mark.parametrize(
    ("vertices", "faces"),
    [(np.zeros((3, 2)), [[0, 1, 2]]), (np.zeros((3, 3)), [[0, 1, 3]]), (np.full((3, 3), np.nan), [[0, 1, 2]])],
)
def test_what_is_no_mesh_is_refused(vertices: np.ndarray, faces: list[list[int]]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Surface(vertices, np.array(faces))


def test_the_nearest_of_several_bodies_is_felt_and_touching_is_gap_zero(table: cells.Cell) -> None:
    model = SkinModel(table)
    ball, box = body(trimesh.creation.icosphere(4, radius=0.05)), body(trimesh.creation.box([0.02, 0.02, 0.02]))
    electrodes = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.2]])
    gaps = model.gaps(electrodes, [(ball, geometry.transform([0, 0, 0.2])), (box, geometry.transform([0.4, 0, 0]))])
    np.testing.assert_allclose(gaps, [0.15, 0.09, 0.0], atol=2e-4)  # facets of the ball


def test_emulated_voltages_have_the_laws_mean_and_noise_and_the_steps_of_the_adc(table: cells.Cell) -> None:
    model = SkinModel(table)
    law = table.pad_types["five"].law
    gaps = np.full((20_000, len(model.skin)), 0.05)
    volts = model.volts(gaps, np.random.default_rng(2))
    steps = volts / (law.adc_reference / 4095)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    # 20 000 x 40 samples: the mean is known to 3 uV, a variance to 0.2 %
    assert volts.mean() == pytest.approx(skin.volts(law, 0.05), abs=2e-5)
    assert volts.var(axis=0).mean() == pytest.approx(law.noise + (law.adc_reference / 4095) ** 2 / 12, rel=0.01)


def test_the_adc_ends_at_zero_and_at_its_reference(table: cells.Cell) -> None:
    low = table.pad_types["five"].law.model_copy(update={"a3": 0.0})
    high = low.model_copy(update={"a3": 1.5})
    for law, gap, end in ((low, 1.0, 0.0), (high, 0.0, 3.3)):
        kind = table.pad_types["five"].model_copy(update={"law": law})
        model = SkinModel(table.model_copy(update={"pad_types": {"five": kind}}))
        volts = model.volts(np.full((200, len(model.skin)), gap), np.random.default_rng(3))
        assert volts.min() >= 0.0 and volts.max() <= 3.3
        assert end in volts


def test_equal_seeds_give_equal_voltages(table: cells.Cell) -> None:
    model = SkinModel(table)
    gaps = np.full(len(model.skin), 0.1)
    first, second = (model.volts(gaps, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
