"""What upper arm and torso add to the signals of a forearm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from penumbra.services.skin import bearer, model
from penumbra.shared.body.anatomy import target_mesh
from penumbra.shared.body.posture import Posture
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import Response, fingerprint, networks
from penumbra.sim.skin.field import PadField

UNSEEN = 77
"""Seed of persons to whom no network was fitted."""
CLOSE = 0.17
"""Gap [m] up to which the networks are within two per cent in the median."""


@pytest.fixture(scope="module")
def table() -> cells.Cell:
    return cells.load("table")


def before(cell: cells.Cell, response: Response, T: Array, shoulder: Array) -> Array:
    """Factors (n,) on the signals of a limb at T (4, 4) of a person with this shoulder (3,)."""
    posture, pads = Posture.of(cell, cell.targets["forearm"], shoulder), Skin(cell).T_world_pads()
    return response.person(pads, [T, *posture.poses(T)]) / response.person(pads, [T])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "pad"), [("table", "p0"), ("arm", "p4")])
def test_persons_that_were_not_fitted_have_the_signals_of_their_boundary_elements(name: str, pad: str) -> None:
    cell = cells.load(name)
    mounting = next(each for each in model.mountings(cell, "forearm") if each.pad == pad)
    mesh = target_mesh(cell.targets["forearm"].model_copy(update={"size": None}), cell)
    field, poses = PadField(mounting.kind, mounting.backing), model.Poses(mesh, mounting.backing, UNSEEN)
    data, network = bearer.solve(field, poses, mesh, cell.body, 60), networks(cell)[mounting.fingerprint].bearer
    assert network is not None and len(data.gap) > 20
    error, left_out = np.abs(np.expm1(network.logs(data.T, data.own) - data.ratio)), np.abs(np.expm1(-data.ratio))
    assert np.median(error[data.gap < CLOSE]) < 0.02
    matters = left_out > 0.05
    assert np.median(error[matters]) < 0.25 * np.median(left_out[matters])


def test_a_person_adds_more_to_a_limb_farther_away_and_hardly_anything_to_a_hand_on_the_pads(table: cells.Cell) -> None:
    response, shoulder = Response(table, "forearm"), np.array([-0.45, 0.15, 0.45])
    added = [
        np.median(before(table, response, rigid.transform([0.0, 0.0, height]), shoulder)) - 1.0 for height in (0.06, 0.14, 0.24)
    ]
    assert abs(added[0]) < 0.01 < added[1] < added[2]


def test_a_torso_above_the_elbow_adds_more_than_one_an_upper_arm_behind_it(table: cells.Cell) -> None:
    response, T = Response(table, "forearm"), rigid.transform([0.1, 0.0, 0.15])
    behind, above = (before(table, response, T, np.array([-0.3, 0.0, height])) for height in (0.25, 0.6))
    assert 0.0 < np.log(behind).mean() < 0.8 * np.log(above).mean()


def test_pads_of_different_mountings_have_networks_of_their_own() -> None:
    cell = cells.load("arm")
    response, known = Response(cell, "forearm"), networks(cell)
    T = cell.targets["forearm"].home.transform
    posture = Posture.of(cell, cell.targets["forearm"], np.array([-0.4, -0.3, 0.9]))
    pads = np.stack([rigid.from_rpy((0.1 * k - 0.4, -0.2, 0.45), (0.0, 0.0, 0.3 * k)) for k in range(len(cell.pads))])
    parts = np.stack([T, *posture.poses(T)])
    own = np.log(response.person(pads, parts[:1])).reshape(len(pads), -1)
    found = np.log(response.person(pads, parts)).reshape(own.shape) - own
    for k, pad in enumerate(cell.pads):
        mounting = known[fingerprint(cell, pad, "forearm")]
        assert mounting.bearer is not None
        alone = mounting.bearer.logs((rigid.inverse(pads[k]) @ parts)[None], own[k][None])
        np.testing.assert_allclose(found[k], alone[0], atol=1e-12)


def test_networks_without_a_person_add_nothing(table: cells.Cell) -> None:
    known = {own: replace(network, bearer=None) for own, network in networks(table).items()}
    response = Response(table, "forearm", known)
    assert (before(table, response, rigid.transform([0.0, 0.0, 0.2]), np.array([-0.4, 0.1, 0.5])) == 1.0).all()
