"""Where pads may sit, what they would tell there, and which are chosen."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from penumbra.services.skin.placing import candidates, sensing
from penumbra.services.skin.placing.choose import Choice
from penumbra.services.skin.placing.layout import Placing, Wish
from penumbra.services.skin.placing.shading import Shading, behind
from penumbra.shared.body.anatomy import Mesh, target_mesh
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import Pad
from penumbra.shared.geometry import rigid
from penumbra.shared.skin.response import Response, fingerprint, networks
from penumbra.sim.skin.field import PadField, limb

BOARD = cells.load("arm").pad_types["five"].board


def box(x: float, y: float, z: float) -> Mesh:
    """Around the origin, its sides so long."""
    vertices = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * (x, y, z)
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4)]
    faces += [(1, 5, 7), (1, 7, 3)]
    return Mesh(vertices, np.array(faces, np.int32), np.zeros(12, np.uint8))


@pytest.fixture(scope="module")
def arm() -> cells.Cell:
    return cells.load("arm")


def test_pads_on_a_box_lie_on_its_faces_and_not_over_its_edges() -> None:
    sides = np.array([0.3, 0.2, 0.04])  # a pad has room on two faces
    found = candidates.on_link(box(*sides), BOARD, 0.03)
    assert len(found) > 20
    for T in found:
        np.testing.assert_allclose(np.abs(T[:3, 2]), (0.0, 0.0, 1.0), atol=1e-6)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
        back = abs(T[2, 3]) - BOARD.thickness
        assert T[2, 3] * T[2, 2] > 0.0 and back == pytest.approx(0.02 + candidates.STANDOFF, abs=1e-6)
        corners = T[:3, 3] + 0.5 * np.array([[sx, sy] for sx in BOARD.size[:1] for sy in BOARD.size[1:]]) @ T[:3, :2].T
        assert (np.abs(corners[:, :2]) <= 0.5 * sides[:2] + 1e-6).all()
    assert not candidates.on_link(box(0.05, 0.05, 0.3), BOARD, 0.03)  # no face is as wide as the board


def test_the_built_in_pads_on_links_are_on_surfaces_that_are_flat_enough(arm: cells.Cell) -> None:
    meshes = robot_models(arm)["panda"].meshes
    for name in ("p1", "p2", "p3", "p4", "p5", "p6", "p7"):  # p0 stands out over the hand
        pad = arm.pads[name]
        heights = candidates.footprint(meshes[pad.link.partition("/")[2]], pad.T_link_pad, BOARD)
        assert heights.max() == pytest.approx(0.0, abs=5e-4) and heights.min() > -candidates.SAG


def test_boards_overlap_where_they_lie_in_each_other_only() -> None:
    T = np.stack([rigid.transform(place) for place in ((0, 0, 0), (0.05, 0.03, 0), (0.064, 0, 0), (0, 0, 0.1))])
    expected = np.zeros((4, 4), bool)
    expected[0, 1] = expected[1, 0] = expected[1, 2] = expected[2, 1] = True
    np.testing.assert_array_equal(candidates.overlaps(T, BOARD), expected)


def test_a_pad_needs_room_before_it_from_other_links(arm: cells.Cell) -> None:
    pad = Pad(type="five", link="r/a", position=(0.0, 0.0, 0.0))
    near, far = np.array([[0.0, 0.0, 0.02]]), np.array([[0.0, 0.0, 0.2]])
    links = {"r/a": np.eye(4)[None], "r/b": np.eye(4)[None]}
    assert not candidates.clear_of_links([pad], BOARD, links, {"r/a": far, "r/b": near})[0]
    assert candidates.clear_of_links([pad], BOARD, links, {"r/a": near, "r/b": far})[0]


def problem(seed: int, count: int = 9, scenes: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random information about the pose, a prior and pairs that overlap."""
    rng = np.random.default_rng(seed)
    J = rng.standard_normal((scenes, count, 3, 8)) * np.exp(rng.standard_normal((scenes, count, 1, 1)))
    overlaps = rng.uniform(size=(count, count)) < 0.1
    overlaps = (overlaps | overlaps.T) & ~np.eye(count, dtype=bool)
    return np.einsum("scei,scej->scij", J, J), np.eye(8), overlaps


@pytest.mark.parametrize("seed", range(6))
def test_the_choice_is_nearly_the_best_of_all_and_keeps_boards_apart(seed: int) -> None:
    information, prior, overlaps = problem(seed)
    choice = Choice(information, prior, overlaps)
    greedy = choice.more([], 3)
    chosen = choice.exchanged(greedy)
    possible = [list(k) for k in itertools.combinations(range(9), 3) if not overlaps[np.ix_(k, k)].any()]
    best = min(float(choice.errors(k).mean()) for k in possible)
    assert sorted(chosen) in possible
    assert choice.errors(chosen).mean() <= choice.errors(greedy).mean()
    assert choice.errors(chosen).mean() <= 1.03 * best


def test_what_a_link_takes_of_a_signal_is_that_of_the_full_field(arm: cells.Cell) -> None:
    pad, kind = arm.pads["p3"], arm.pad_types["five"]
    mesh = robot_models(arm)["panda"].meshes[pad.link.partition("/")[2]]
    bare = networks(arm)[fingerprint(arm, "p3", "forearm", bare=True)]
    shading = Shading(arm, kind, "forearm", bare, np.zeros(2))
    T = np.stack([rigid.from_rpy((0.0, y, z), (0.3, 0.0, 0.4)) for y, z in ((0.0, 0.10), (0.03, 0.14), (-0.05, 0.18))])
    body = limb(target_mesh(arm.targets["forearm"], arm), stations=16, around=10)
    backing = behind(mesh, pad.T_link_pad)
    with_link, without = PadField(kind, backing), PadField(kind)
    expected = np.log([with_link.change(body, each) / without.change(body, each) for each in T])
    assert expected.max() < np.log(0.7)  # the link takes a good part
    np.testing.assert_allclose(shading.ratio(backing, T), expected, atol=0.25)


def test_the_bound_before_links_is_near_that_of_the_fitted_models(arm: cells.Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("penumbra.services.skin.placing.layout.SCENES", 60)
    placing = Placing(arm, Wish(seed=9))
    present = placing.sensing(tuple(placing.present.values()))
    fitted = replace(present, response=Response(arm, "forearm"))
    ratio = present.errors(placing.scenes) / fitted.errors(placing.scenes)
    assert 0.97 < np.median(ratio) < 1.1
    assert np.percentile(ratio, 5) > 0.9 and np.percentile(ratio, 95) < 1.35


def test_scenes_keep_clear_of_the_robot_and_within_reach(arm: cells.Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("penumbra.services.skin.placing.layout.SCENES", 15)
    box = np.array([[-0.1, -0.3, 0.5], [0.2, 0.0, 0.8]])
    placing = Placing(arm, Wish(box=box, reach=0.10))
    for k, T in enumerate(placing.scenes.targets):
        assert (T[:3, 3] >= box[0]).all() and (T[:3, 3] <= box[1]).all()
        clear, away = placing.drawing.gaps(T, placing.scenes.links, placing.room, k)
        assert clear >= 0.01 and away <= 0.10


def test_a_limb_behind_a_pad_is_not_felt() -> None:
    table = cells.load("table")
    placing = Placing(table, Wish())
    down = Pad(type="five", position=(0.0, 0.0, 0.4), rpy=(np.pi, 0.0, 0.0))
    up = Pad(type="five", position=(0.0, 0.0, 0.0))
    scenes = placing.drawing.draw(placing.room, 10, 3)
    gaps, before = sensing.meeting(placing.drawing, scenes, (up, down))
    assert before[:, 0].all() and (gaps > 0.0).all()
    over = replace(scenes, targets=scenes.targets + np.array([0.0, 0.0, 0.0, 1.0]) * np.array([0, 0, 0.6, 0])[:, None])
    assert not placing.sensing((down,)).information(over).any()
