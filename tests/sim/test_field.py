"""The boundary-element field of a pad: against closed forms, the published pad's figures, symmetry and physics."""

import numpy as np
import pytest
import trimesh

from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.sim.skin.field import FEMTOFARAD, Body, PadField, Panels, limb
from penumbra.tests.bench import skin as bench


@pytest.fixture(scope="module")
def table() -> cells.Cell:
    return cells.load("table")


@pytest.fixture(scope="module")
def pad(table: cells.Cell) -> PadField:
    return PadField(table.pad_types["five"])


@pytest.fixture(scope="module")
def arm(table: cells.Cell) -> tuple:
    mesh = bench.forearm(table)
    return mesh, limb(mesh)


def test_a_sphere_has_its_textbook_capacitance_and_a_cube_the_published_one() -> None:
    sphere = trimesh.creation.icosphere(3, radius=0.05)
    charges = np.linalg.solve(Panels.of_mesh(sphere.vertices, sphere.faces).matrices()[0], np.ones(len(sphere.faces)))
    assert charges.sum() == pytest.approx(0.05, rel=0.01)
    cube = trimesh.creation.box([1.0, 1.0, 1.0]).subdivide().subdivide().subdivide()
    charges = np.linalg.solve(Panels.of_mesh(cube.vertices, cube.faces).matrices()[0], np.ones(len(cube.faces)))
    assert charges.sum() == pytest.approx(0.6607, rel=0.01)  # of a unit cube, in units of 4 pi eps_0 (Hwang & Mascagni 2004)


def test_a_panels_field_is_the_derivative_of_its_potential() -> None:
    rng = np.random.default_rng(0)
    square = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.01, 0.02, 0.0], [0.0, 0.02, 0.0]])
    step = 1e-6

    def probe(at: np.ndarray, facing: np.ndarray) -> tuple[float, float]:
        """Potential and field along `facing` at a point of the square's unit charge."""
        u = np.cross(facing, [0.3, 0.5, 0.8])
        u *= 1e-7 / np.linalg.norm(u)
        v = np.cross(facing, u)
        tiny = at + np.array([-u - v, u - v, u + v, v - u])
        potential, field = Panels(np.stack([square, tiny])).matrices()
        return potential[1, 0], field[1, 0]

    for _ in range(20):
        at, facing = rng.uniform(-0.03, 0.03, 3), rng.standard_normal(3)
        facing /= np.linalg.norm(facing)
        slope = (probe(at + step * facing, facing)[0] - probe(at - step * facing, facing)[0]) / (2 * step)
        assert probe(at, facing)[1] == pytest.approx(-slope, rel=1e-4)


def test_a_dielectric_sphere_in_an_even_field_has_the_textbook_dipole() -> None:
    sphere = trimesh.creation.icosphere(3, radius=0.05)
    panels = Panels.of_mesh(sphere.vertices, sphere.faces)
    charges = Body(panels, permittivity=3.0).charges(panels.normals[:, 2])  # a field of 1 along z
    dipole = charges @ panels.centroids[:, 2]
    assert dipole == pytest.approx(0.05**3 * (3.0 - 1.0) / (3.0 + 2.0), rel=0.05)  # flat panels


def test_the_pad_holds_its_published_capacitance(pad: PadField) -> None:
    assert pad.plate_pF == pytest.approx(bench.PLATE_PF, rel=0.01)


def test_a_forearm_changes_the_centre_as_published(pad: PadField, arm: tuple) -> None:
    for gap, wanted in bench.CENTRE_FF.items():
        assert pad.change(arm[1], bench.across(arm[0], gap / 100))[0] == pytest.approx(wanted, rel=0.1)


def test_the_signal_of_a_forearm_follows_the_papers_law(table: cells.Cell, pad: PadField, arm: tuple) -> None:
    gaps = np.arange(1.0, 20.1, 0.5) / 100
    kind = table.pad_types["five"]
    volts = np.array([pad.change(arm[1], bench.across(arm[0], gap))[0] for gap in gaps]) * kind.chain.sensitivity
    law = bench.law(gaps, volts)
    assert law["log_r2"] > 0.999
    nominal = kind.electrodes["c"].law  # what the cell file says of the design
    assert law["a1"] == pytest.approx(nominal.a1, rel=0.1) and law["a2"] == pytest.approx(nominal.a2, rel=0.1)
    np.testing.assert_allclose(volts[[0, 8, 18, 28]], [0.614, 0.033, 0.0084, 0.00395], rtol=0.15)


def test_symmetric_electrodes_feel_alike_and_a_turned_limb_swaps_them(pad: PadField, arm: tuple) -> None:
    T = bench.across(arm[0], 0.04, 0.015)
    change = pad.change(arm[1], T)
    turned = pad.change(arm[1], rigid.from_rpy((0, 0, 0), (0, 0, np.pi)) @ T)
    # right and left, top and bottom change places; the centroids of the real pad are up to 0.4 mm off
    np.testing.assert_allclose(turned[[0, 2, 1, 4, 3]], change, rtol=0.06)
    assert change[1] > 1.2 * change[2]


def test_a_person_is_as_good_as_grounded_and_what_floats_or_insulates_is_not(pad: PadField, arm: tuple) -> None:
    mesh, body = arm
    T = bench.across(mesh, 0.03)
    grounded = pad.change(Body(body.panels, ground_pF=np.inf), T)
    np.testing.assert_allclose(pad.change(body, T), grounded, rtol=0.05)
    np.testing.assert_allclose(pad.change(Body(body.panels, ground_pF=100.0), T), grounded, rtol=0.07)
    floating = pad.change(Body(body.panels, ground_pF=0.0), T)
    assert (floating < 0.9 * grounded).all()
    # what has no charge to take up answers with its dipole, an insulator's being the smaller one, and falls off faster
    far = bench.across(mesh, 0.15)
    for neutral in (Body(body.panels, ground_pF=0.0), Body(body.panels, permittivity=3.0)):
        near_share, far_share = pad.change(neutral, T)[0] / grounded[0], pad.change(neutral, far)[0] / pad.change(body, far)[0]
        assert 0.0 < far_share < 0.6 * near_share
    assert (pad.change(Body(body.panels, permittivity=3.0), T) < floating).all()


def test_panels_that_carry_a_pad_take_its_signal(table: cells.Cell, pad: PadField, arm: tuple) -> None:
    box = trimesh.creation.box([0.14, 0.14, 0.3], transform=rigid.from_rpy((0, 0, -0.157), (0, 0, 0)))
    box = box.subdivide().subdivide().subdivide()
    backed = PadField(table.pad_types["five"], Panels.of_mesh(box.vertices, box.faces))
    shares = [backed.change(arm[1], T)[0] / pad.change(arm[1], T)[0] for T in (bench.across(arm[0], g) for g in (0.02, 0.1, 0.2))]
    assert 0.85 < shares[0] < 1.0 and shares[0] > shares[1] > shares[2] and 0.2 < shares[2] < 0.6


def test_both_ways_to_solve_for_grounded_panels_agree(pad: PadField, arm: tuple) -> None:
    T = bench.across(arm[0], 0.04)
    moved = Panels(rigid.apply(T, arm[1].panels.corners))
    np.testing.assert_allclose(pad.change_of_links(moved), pad.change(Body(arm[1].panels, ground_pF=np.inf), T), rtol=1e-3)


def test_finer_panels_change_little(table: cells.Cell, pad: PadField, arm: tuple) -> None:
    finer = limb(arm[0], stations=60, around=30)
    for gap in (0.02, 0.1):
        T = bench.across(arm[0], gap)
        np.testing.assert_allclose(pad.change(arm[1], T), pad.change(finer, T), rtol=0.02)


def test_units_are_farads() -> None:
    assert pytest.approx(111.265, rel=1e-4) == FEMTOFARAD / 1e3  # 4 pi eps_0, in pF per metre


def test_a_board_beside_a_pad_shades_it_adds_when_it_is_driven_too_and_does_nothing_from_afar(
    table: cells.Cell, pad: PadField, arm: tuple
) -> None:
    kind, T = table.pad_types["five"], rigid.transform([0.0, 0.0, 0.10])
    alone = pad.change(arm[1], T)

    def with_board(x: float, is_driven: bool = False) -> np.ndarray:
        return PadField(kind, beside=[rigid.transform([x, 0.0, 0.0])], is_driven=is_driven).change(arm[1], T)

    assert (with_board(0.08) < 0.95 * alone).all() and (with_board(0.08, is_driven=True) > 1.05 * alone).all()
    np.testing.assert_allclose(with_board(5.0), alone, rtol=0.01)
