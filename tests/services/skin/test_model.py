"""`penumbra skin model`: networks for pads, limbs and mountings that are new."""

import json
from dataclasses import replace

import numpy as np
import pytest

from penumbra.services.skin import model
from penumbra.shared.body.anatomy import forearm_mesh, target_mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.skin.response import FOLDER, Response, Rest, networks
from penumbra.sim.skin.field import PadField, limb


@pytest.fixture
def few_limbs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model, "LIMBS", 3)


@pytest.mark.slow
def test_a_cell_with_another_limb_is_fitted_once_and_then_usable(tmp_path, few_limbs, capsys) -> None:
    text = (cells.BUILT_IN / "table.yaml").read_text()
    path = tmp_path / "mine.yaml"
    path.write_text(text + "\nbody: {forearm_circumference: 0.24, wrist_circumference: 0.15}\n")
    with pytest.raises(cells.CellError, match="penumbra skin model"):
        Response(cells.load(path), "forearm")
    assert model.main(["--cell", str(path), "--poses", "150", "--steps", "1500"]) == 0
    cell = cells.load(path)
    assert sorted(p.name for p in (tmp_path / FOLDER).iterdir()) == ["five-forearm.json", "five-forearm.npz"]
    response, pad = Response(cell, "forearm"), PadField(cell.pad_types["five"])
    T = rigid.from_rpy((0.0, 0.0, 0.12), (0.0, 0.0, 0.5))
    found = response.change(np.tile(T, (8, 1, 1)))
    np.testing.assert_allclose(found[:5], pad.change(limb(forearm_mesh(cell.body)), T), rtol=0.5)  # from 150 poses
    assert 0.0 < response.error[0] < 0.5
    card = json.loads((tmp_path / FOLDER / "five-forearm.json").read_text())
    with_person = sum(band["poses"] for band in card["rest_of_person"].values())
    assert with_person > 10 and networks(cell)[card["fingerprint"]].bearer is not None
    capsys.readouterr()
    assert model.main(["--cell", str(path)]) == 0  # nothing is left to do
    assert "kept" in capsys.readouterr().out


def test_two_networks_beside_each_other_give_the_sum_of_their_logs() -> None:
    (one, other) = (replace(n, rest=None) for n in list(networks(cells.load("arm")).values())[:2])
    data = model.Solved(
        np.tile(rigid.from_rpy((0.0, 0.02, 0.12), (0.1, 0.2, 0.3)), (2, 1, 1)), np.zeros((2, 2)), *[np.ones(2)] * 2
    )
    other = replace(other, mean=one.mean, scale=one.scale)
    both = model.predict(model.beside(one, other), data)
    np.testing.assert_allclose(both, model.predict(one, data) * model.predict(other, data), rtol=1e-9)


def test_drawn_limbs_keep_clear_of_the_board_and_have_the_wanted_gap(few_limbs) -> None:
    mesh = forearm_mesh(cells.load("table").body)
    poses = model.Poses(mesh, None, 5)
    for _ in range(20):
        T, which, gap = poses.draw(0.05)
        assert gap == pytest.approx(0.05, rel=0.03)
        assert poses._gap(poses.solid, T[:3, :3], T[:3, 3], np.exp(poses.sizes[which][[0, 1, 1]])) > model.CLEAR


def test_what_other_links_change_follows_the_joints_within_their_range() -> None:
    cell = cells.load("arm")
    mounting = next(m for m in model.mountings(cell, "forearm") if m.pad == "p1")
    low, high = model.joint_range(cell)
    joints = np.random.default_rng(8).uniform(low, high, (2, len(low)))
    rest = networks(cell)[mounting.fingerprint].rest
    assert rest is not None
    np.testing.assert_allclose(rest.change(joints), model.links(cell, mounting, joints), rtol=0.02)
    held = Rest(rest.coefficients, rest.middle, rest.half)
    np.testing.assert_allclose(held.change(high + 1.0), held.change(high), rtol=1e-6)  # beyond the range as at its end


def test_a_person_of_another_size_needs_no_new_network() -> None:
    table = cells.load("table")
    aim = table.targets["forearm"].model_copy(update={"size": cells.Size(length=1.08, girth=0.9)})
    cell = table.model_copy(update={"targets": {"forearm": aim}})
    response, field = Response(cell, "forearm"), PadField(cell.pad_types["five"])
    T = rigid.from_rpy((0.02, 0.01, 0.08), (0.2, 0.1, 0.3))
    expected = field.change(limb(target_mesh(aim, cell)), T)
    assert response.change(np.tile(T, (8, 1, 1)))[:5] == pytest.approx(expected, rel=0.05)
    assert Response(table, "forearm").change(np.tile(T, (8, 1, 1)))[:5] != pytest.approx(expected, rel=0.05)
