"""Points of surfaces without a shape, and contact, by the full boundary-element field."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import trimesh

from penumbra.services.haptics.contact import RELEASE, TOUCH, Contact
from penumbra.services.haptics.estimator import Estimator
from penumbra.services.haptics.service import WEIGHTS, shapes_of
from penumbra.services.haptics.surface_points import GAPS, Shapes, SurfacePoint, SurfacePoints, forearm, fused
from penumbra.shared.body.anatomy import target_mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import Response
from penumbra.sim.skin import field

SAMPLES = 20
NONE = np.zeros(40, bool)


def made(cell: cells.Cell, kind=SurfacePoints):
    """The finder of a cell's points, or an estimator that has it."""
    mesh = target_mesh(cell.targets["forearm"], cell)
    surface, shapes = Surface(mesh.vertices, mesh.faces), shapes_of(cell, "forearm", WEIGHTS)
    if kind is SurfacePoints:
        return SurfacePoints(Skin(cell), Response(cell, "forearm"), surface, shapes)
    home = cell.targets["forearm"].home.transform
    return Estimator(Skin(cell), Response(cell, "forearm"), surface, home, np.repeat([0.12, 0.4], 3), shapes=shapes)


@pytest.fixture(scope="module")
def finder(table: cells.Cell) -> SurfacePoints:
    return made(table)


@pytest.fixture(scope="module")
def bare(table: cells.Cell) -> field.PadField:
    return field.PadField(table.pad_types["five"])


def signals(bare: field.PadField, skin: Skin, pads: np.ndarray, body: field.Body, T: np.ndarray) -> np.ndarray:
    """True signals (n,) [V], up to the converter's end."""
    change = np.concatenate([bare.change(body, rigid.inverse(pad) @ T) for pad in pads])
    return skin.signal(skin.amplitude(change))


def shape(mesh: trimesh.Trimesh) -> field.Body:
    return field.Body(field.shell(np.array(mesh.vertices), 24, 16))


def ball() -> field.Body:
    return shape(trimesh.creation.icosphere(3, 0.04))


def plate() -> field.Body:
    return shape(trimesh.creation.box((0.16, 0.16, 0.03)))


def at(x: float, y: float, z: float) -> np.ndarray:
    return rigid.from_rpy((x, y, z), (0.0, 0.0, 0.0))


@pytest.mark.parametrize(("body", "middle"), [(ball, 0.04), (plate, 0.015)])
@pytest.mark.parametrize("gap", [0.02, 0.05, 0.1])
def test_things_that_are_no_limb_are_at_their_distance(finder, bare, skin, body, middle, gap) -> None:
    pads = skin.T_world_pads()
    points = finder.find(signals(bare, skin, pads, body(), at(0.04, 0.04, gap + middle)), skin.noise / SAMPLES, NONE, pads)
    nearest = min(points, key=lambda point: point.distance)
    assert nearest.distance == pytest.approx(gap, rel=0.3) and abs(nearest.distance - gap) < 3.0 * nearest.along
    assert 0.03 < nearest.along / nearest.distance < 0.3
    expected = {"p6"} if body is ball else {"p2", "p5", "p6", "p7"}  # a plate has the same gap over several
    assert nearest.pad in expected and nearest.position[2] == pytest.approx(gap, rel=0.3)


def test_where_nothing_is_near_there_is_no_point(finder, skin) -> None:
    noise, rng = skin.noise / SAMPLES, np.random.default_rng(0)
    found = [finder.find(np.sqrt(noise) * rng.standard_normal(40), noise, NONE, skin.T_world_pads()) for _ in range(200)]
    assert not any(found)


def test_noise_makes_points_less_certain_and_moves_them_by_no_more_than_that(finder, bare, skin) -> None:
    pads, rng = skin.T_world_pads(), np.random.default_rng(1)
    clean = signals(bare, skin, pads, ball(), at(0.04, 0.04, 0.12))
    (sure,) = (p for p in finder.find(clean, skin.noise / 1e6, NONE, pads) if p.pad == "p6")
    noise = skin.noise / SAMPLES
    found = [finder.find(clean + np.sqrt(noise) * rng.standard_normal(40), noise, NONE, pads) for _ in range(50)]
    own = [point for points in found for point in points if point.pad == "p6"]
    assert len(own) > 45 and min(point.along for point in own) > sure.along
    scatter = np.std([point.distance for point in own])
    assert 0.0 < scatter < np.mean([point.along for point in own])


def test_an_electrode_that_is_left_out_is_not_missed(finder, bare, skin) -> None:
    pads = skin.T_world_pads()
    clean, variance = signals(bare, skin, pads, ball(), at(0.04, 0.04, 0.09)), skin.noise / SAMPLES
    (whole,) = (p for p in finder.find(clean, variance, NONE, pads) if p.pad == "p6")
    middle = skin.names.index("p6/c")
    spoiled, without = clean.copy(), variance.copy()
    spoiled[middle], without[middle] = 1.2, np.inf
    (left,) = (p for p in finder.find(spoiled, without, NONE, pads) if p.pad == "p6")
    assert left.distance == pytest.approx(whole.distance, rel=0.2) and left.along > 0.9 * whole.along


def test_no_pad_is_farther_from_a_surface_than_from_another_pads_point() -> None:
    pads = np.stack([at(0.0, 0.0, 0.0), at(0.1, 0.0, 0.0)])
    x = np.log([[0.02, 1.0, 1.0, 0.02], [0.18, 1.0, 1.0, 0.18]])
    covariance = np.stack([np.diag([0.05, 0.1, 0.1, 0.1]) ** 2, np.diag([0.3, 0.3, 0.3, 0.3]) ** 2])
    near, far = fused(("a", "b"), np.array([0, 1]), x, covariance, pads, 1.0)
    assert near.distance == pytest.approx(0.02, rel=0.01)
    assert far.distance < 0.12 and far.along < 0.2 * 0.18, "0.102 m from the other pad's point"
    assert far.position[2] == pytest.approx(far.distance) and near.across == pytest.approx(0.002, rel=0.01)
    np.testing.assert_allclose(near.covariance, np.diag(np.square([near.across, near.across, near.along])), atol=1e-9)
    apart = fused(("a", "b"), np.array([0, 1]), x - [[0.0, 0.0, 0.0, 0.0], [1.5, 0.0, 0.0, 1.5]], covariance, pads, 1.0)[1]
    assert apart.distance == pytest.approx(0.18 * np.exp(-1.5), rel=0.01), "a bound that is far away changes nothing"


def test_a_pads_signals_are_compared_with_those_of_its_own_mounting() -> None:
    """A link behind a pad takes most of its signals: without it in the comparison, things would seem farther away."""
    arm = cells.load("arm")
    mesh = target_mesh(arm.targets["forearm"], arm)
    logs = forearm(Skin(arm), Response(arm, "forearm"), Surface(mesh.vertices, mesh.faces))
    table = cells.load("table")
    free = forearm(Skin(table), Response(table, "forearm"), Surface(mesh.vertices, mesh.faces))
    far = int(np.searchsorted(GAPS, 0.1))
    assert (np.diff(logs, axis=0) < 0.0).all() and (np.diff(free, axis=0) < 0.0).all()
    assert (logs[far] - free[far]).mean() < np.log(0.6)


def test_shapes_of_another_design_are_refused(table: cells.Cell, tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match="penumbra haptics shapes"):
        Shapes.load(tmp_path, "0123456789abcdef")


def test_points_leave_the_pose_as_it_is_to_the_bit(table: cells.Cell, bare: field.PadField, skin: Skin) -> None:
    pads, mesh = skin.T_world_pads(), target_mesh(table.targets["forearm"], table)
    signal = signals(bare, skin, pads, field.limb(mesh), rigid.from_rpy((0.02, 0.0, 0.1), (0.0, 0.0, 0.1)))
    with_points, without = made(table, Estimator), made(table, Estimator)
    without._points = None
    for one, other in zip(windows(with_points, skin, pads, signal, 5), windows(without, skin, pads, signal, 5), strict=True):
        assert one.surface and not other.surface and one.state == other.state and one.gap == other.gap
        np.testing.assert_array_equal(one.T, other.T)
        np.testing.assert_array_equal(one.information, other.information)


# ---- contact


def point(pad: str, distance: float) -> SurfacePoint:
    return SurfacePoint(pad, np.zeros(3), np.eye(3)[2], 2.0 * distance, 0.001, 0.001, distance)


def test_a_touch_ends_farther_away_than_it_begins(skin: Skin) -> None:
    contact, pads = Contact(skin), skin.T_world_pads()
    between = 0.5 * (TOUCH + RELEASE)
    assert contact.take([point("p3", between)], pads) == "none"
    assert contact.take([point("p5", TOUCH - 1e-4), point("p3", TOUCH - 1e-4)], pads) == "touch"
    assert contact.touched == ("p3", "p5")
    assert contact.take([point("p3", between)], pads) == "touch" and contact.touched == ("p3",)
    assert contact.take([point("p3", RELEASE + 1e-4)], pads) == "none" and not contact.touched


def windows(estimator: Estimator, skin: Skin, pads: np.ndarray, signal: np.ndarray, count: int, start: int = 0):
    """Estimates of windows of these signals (n,), with noise, as the collector makes windows."""
    rng = np.random.default_rng(start)
    for i in range(start, start + count):
        volts = skin.a3 + signal + np.sqrt(skin.noise) * rng.standard_normal((SAMPLES, len(skin)))
        volts = np.clip(volts, 0.0, skin.full_scale)
        ended = volts >= skin.full_scale - 0.5 * skin.lsb
        samples = np.where(ended.any(axis=0), 0, SAMPLES)
        yield estimator.update((i + 1) * 20_000_000, volts.mean(axis=0), samples, pads, pressed=ended.mean(axis=0) > 0.5)


@pytest.mark.parametrize(("gap", "state"), [(0.003, "touch"), (0.012, "none"), (0.02, "none")])
def test_a_limb_that_touches_a_pad_is_a_touch_and_one_beside_it_is_none(table, bare, skin, gap, state) -> None:
    estimator, pads = made(table, Estimator), skin.T_world_pads()
    mesh = target_mesh(table.targets["forearm"], table)
    T = rigid.from_rpy((0.0, 0.04, 0.1), (0.0, 0.0, 0.0))
    surface = Surface(mesh.vertices, mesh.faces)
    for _ in range(10):
        T[2, 3] += gap - float(surface.nearest((skin.positions(pads) - T[:3, 3]) @ T[:3, :3])[0].min())
    found = list(windows(estimator, skin, pads, signals(bare, skin, pads, field.limb(mesh), T), 3))
    assert {estimate.contact for estimate in found} == {state}
    assert all(bool(estimate.touched) == (state == "touch") for estimate in found)


def test_an_electrode_that_is_stuck_at_the_end_of_its_scale_touches_nothing(table, bare, skin) -> None:
    estimator, pads = made(table, Estimator), skin.T_world_pads()
    signal = signals(bare, skin, pads, ball(), at(0.04, 0.04, 0.12))
    signal[skin.names.index("p1/c")] = 2.0
    found = list(windows(estimator, skin, pads, signal, 3))
    assert {estimate.contact for estimate in found} == {"none"}
    assert all({"p6"} <= {p.pad for p in estimate.surface} for estimate in found)


def test_a_hand_around_a_post_is_a_grip_and_its_palm_alone_a_touch(table: cells.Cell, bare: field.PadField) -> None:
    """Four pads around a square post; palm and fingers lie on opposite sides."""
    sides = {"east": 0.0, "north": 0.5 * np.pi, "west": np.pi, "south": -0.5 * np.pi}
    out = 0.032
    pads = {
        name: table.pads["p0"].model_copy(
            update={"position": (out * np.cos(turn), out * np.sin(turn), 0.2), "rpy": (0.0, 0.5 * np.pi, turn)}
        )
        for name, turn in sides.items()
    }
    cell = cells.Cell.model_validate({**dict(table), "pads": {name: pad.model_dump() for name, pad in pads.items()}})
    skin = Skin(cell)
    T_world_pads = skin.T_world_pads()
    np.testing.assert_allclose(T_world_pads[0, :3, 2], [1.0, 0.0, 0.0], atol=1e-12)
    make = partial(trimesh.creation.box, (0.025, 0.085, 0.1))
    palm, fingers = make(), make()
    palm.apply_translation((out + 0.0125 + 0.003, 0.0, 0.2))
    fingers.apply_translation((-out - 0.0125 - 0.003, 0.0, 0.2))
    parts = [field.shell(np.array(each.vertices), 24, 16) for each in (palm, fingers)]
    estimator = made(cell, Estimator)
    alone = signals(bare, skin, T_world_pads, field.Body(parts[0]), np.eye(4))
    closed = signals(bare, skin, T_world_pads, field.Body(parts[0] + parts[1]), np.eye(4))
    assert {(e.contact, e.touched) for e in windows(estimator, skin, T_world_pads, alone, 3)} == {("touch", ("east",))}
    gripped = {(e.contact, e.touched) for e in windows(estimator, skin, T_world_pads, closed, 3, 3)}
    assert gripped == {("grip", ("east", "west"))}
    released = list(windows(estimator, skin, T_world_pads, np.zeros(len(skin)), 3, 6))
    assert {e.contact for e in released} == {"none"}


def test_pads_whose_electrodes_contradict_each_other_have_no_point(table: cells.Cell, finder: SurfacePoints) -> None:
    skin = Skin(table)
    signal = np.full(len(skin), -5e-3)
    signal[skin.first[:-1]] = 0.1  # as no surface does: one electrode of each pad alone
    assert finder.find(signal, skin.noise / SAMPLES, NONE, skin.T_world_pads()) == []
