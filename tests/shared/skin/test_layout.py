"""The skin: electrodes and signal chain, nearest points on meshes, the networks of the field, and the emulated voltages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import trimesh

from penumbra.shared.body.anatomy import forearm_mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import Law, Pad
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin import layout
from penumbra.shared.skin.layout import Near, Skin
from penumbra.shared.skin.response import Response
from penumbra.sim.skin.field import PadField, limb
from penumbra.sim.skin.pads import SkinModel
from penumbra.tests.support.cells import derive


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


def calibrated(cell: cells.Cell, law: Law) -> cells.Cell:
    """The cell with this law on every electrode of every pad."""
    pads = {
        name: pad.model_copy(update={"calibration": dict.fromkeys(cell.pad_types[pad.type].electrodes, law)})
        for name, pad in cell.pads.items()
    }
    return cell.model_copy(update={"pads": pads})


def test_amplitudes_are_the_signal_chains_and_a_calibration_is_a_gain_beside_the_design(table: cells.Cell) -> None:
    designed, kind = layout.Skin(table), table.pad_types["five"]
    change = np.full(len(designed), 0.55)
    # excitation times admittance times feedback: 11.47 V * 2 pi 100 kHz * 0.55 fF * 1 Mohm
    np.testing.assert_allclose(designed.signal(designed.amplitude(change)), 11.47 * 2e5 * np.pi * 0.55e-15 * 1e6)
    nominal = kind.law("c")
    law = nominal.model_copy(update={"a1": 1.2 * nominal.a1, "a3": 0.5, "polarity": -1})
    measured = layout.Skin(calibrated(table, law))
    centres = [name.endswith("/c") for name in measured.names]
    np.testing.assert_allclose(measured.gain[centres], 1.2)
    np.testing.assert_allclose(measured.amplitude(change)[centres], 0.5 - 1.2 * designed.sensitivity[0] * 0.55)
    np.testing.assert_allclose(measured.signal(measured.amplitude(change))[centres], 1.2 * designed.sensitivity[0] * 0.55)


def test_a_law_that_an_electrode_does_not_have_is_refused_with_its_name(table: cells.Cell) -> None:
    law = table.pad_types["five"].law("c")
    pads = {"p0": table.pads["p0"].model_copy(update={"calibration": {"middle": law}})}
    with pytest.raises(ValueError, match="expected one of the electrodes c, r, l, t, b, got 'middle'"):
        cells.Cell.model_validate({**table.model_dump(), "pads": {k: v.model_dump() for k, v in pads.items()}})


def test_electrodes_follow_the_link_that_carries_their_pad(table: cells.Cell) -> None:
    pads = {"a": Pad(type="five", link="panda/hand", position=(0, 0, 0.1), rpy=(0, 0, np.pi / 2))}
    robots = {"panda": cells.Robot(urdf="panda/panda.urdf", joints=("panda_joint1",))}
    moving = layout.Skin(table.model_copy(update={"pads": pads, "robots": robots}))
    T = rigid.from_rpy((1, 2, 3), (0, 0, 0))
    electrodes = moving.positions(moving.T_world_pads(layout.link_names({"panda": {"hand": T}})))
    # the pad is turned by a quarter: its right electrode points along y
    np.testing.assert_allclose(electrodes[1], [1 + 0.00016, 2 + 0.02415, 3.1], atol=5e-5)  # the published centroid
    with pytest.raises(ValueError, match=r"expected the poses of the links \['panda/hand'\]"):
        moving.T_world_pads()


def test_a_cell_without_pads_is_refused_in_words(table: cells.Cell) -> None:
    with pytest.raises(ValueError, match="cell table has no pads"):
        layout.Skin(table.model_copy(update={"pads": {}}))


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


def test_emulated_voltages_have_the_chains_mean_and_the_calibrated_noise(table: cells.Cell) -> None:
    model = SkinModel(table, "forearm")
    change = np.full((20_000, len(model.skin)), 0.55)
    volts = model.volts(change, np.random.default_rng(2))
    # 20 000 x 40 samples: the mean is known to 3 uV, a variance to 0.2 %
    assert volts.mean() == pytest.approx(model.skin.amplitude(change[0]).mean(), abs=2e-5)
    assert volts.var(axis=0).mean() == pytest.approx(table.pad_types["five"].rest.noise, rel=0.01)


def test_amplitudes_end_at_zero_and_at_half_of_the_converters_reference(table: cells.Cell) -> None:
    nominal = table.pad_types["five"].law("c")
    for a3, polarity, end in ((0.0, 1, 0.0), (1.5, 1, 1.65)):
        model = SkinModel(calibrated(table, nominal.model_copy(update={"a3": a3, "polarity": polarity})), "forearm")
        change = np.full((200, len(model.skin)), 0.0 if end == 0.0 else 100.0)
        volts = model.volts(change, np.random.default_rng(3))
        assert volts.min() >= 0.0 and volts.max() <= 1.65
        assert end in volts


def test_equal_seeds_give_equal_voltages(table: cells.Cell) -> None:
    model = SkinModel(table, "forearm")
    first, second = (model.volts(np.ones(len(model.skin)), np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.fixture(scope="module")
def response(table: cells.Cell) -> Response:
    return Response(table, "forearm")


def poses(count: int, seed: int) -> np.ndarray:
    """T_pads_target (count, 8, 4, 4): a forearm 5 to 20 cm above eight pads at one place."""
    rng = np.random.default_rng(seed)
    low, high = (-0.1, -0.1, 0.10, -0.5, -0.3, -0.5), (0.1, 0.1, 0.25, 0.5, 0.3, 0.5)
    return np.stack([np.tile(rigid.from_rpy(x[:3], x[3:]), (8, 1, 1)) for x in rng.uniform(low, high, (count, 6))])


def test_the_networks_agree_with_the_field_that_they_stand_for(table: cells.Cell, response: Response) -> None:
    pad, mesh = PadField(table.pad_types["five"]), forearm_mesh(table.body)
    small, large = (limb(mesh, *np.exp(size)) for size in ((-0.08, -0.25), (0.05, 0.1)))
    errors = []
    for k, T in enumerate(poses(24, 11)):
        body, size = ((small, (-0.08, -0.25)), (large, (0.05, 0.1)))[k % 2]
        errors.append(np.abs(response.change(T, size)[:5] / pad.change(body, T[0]) - 1.0))
    assert np.median(errors) < 0.01
    assert np.percentile(errors, 95) < 0.05


def test_the_networks_derivatives_are_those_of_their_values(response: Response) -> None:
    step = 1e-3
    for T in poses(5, 12):
        value, jacobian = response.logs(T, (0.02, -0.1))
        np.testing.assert_allclose(np.exp(value), response.change(T, (0.02, -0.1)))
        for k in range(6):
            moved = [np.stack([rigid.perturb(t, side * step * np.eye(6)[k]) for t in T]) for side in (1, -1)]
            up, down = (np.log(response.change(m, (0.02, -0.1))) for m in moved)
            np.testing.assert_allclose(jacobian[:, k], (up - down) / (2 * step), rtol=0.01, atol=0.02)
        for k in range(2):
            sizes = [np.array([0.02, -0.1]) + side * step * np.eye(2)[k] for side in (1, -1)]
            up, down = (np.log(response.change(T, size)) for size in sizes)
            np.testing.assert_allclose(jacobian[:, 6 + k], (up - down) / (2 * step), rtol=0.01, atol=0.02)


def test_a_limb_that_was_not_fitted_gets_instructions(table: cells.Cell) -> None:
    thick = table.model_copy(update={"body": table.body.model_copy(update={"forearm_circumference": 0.5})})
    with pytest.raises(cells.CellError, match="penumbra skin model --cell"):
        Response(thick, "forearm")


def test_the_pads_near_a_target_are_those_at_its_home_and_all_on_robots(tmp_path):
    side_by_side = cells.load(derive("table", 1, 3, tmp_path))
    whole = Skin(side_by_side)
    for place, name in enumerate(side_by_side.targets):
        near = Near.of(side_by_side, name)
        assert list(near.pads) == list(range(8 * place, 8 * place + 8))
        assert [whole.names[k] for k in near.electrodes] == list(Skin(near.cell).names)
    arm = cells.load("arm")
    assert Near.of(arm, "forearm").cell == arm
