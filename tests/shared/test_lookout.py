"""Where vision looks: around a target that is known, around its home when it is lost."""

from typing import Any

import numpy as np
import pytest

from penumbra.shared.body import anatomy
from penumbra.shared.cell import description
from penumbra.shared.contract.messages import FusedPose
from penumbra.shared.geometry import rigid
from penumbra.shared.perception.lookout import (
    MAX_PIXELS,
    MAX_PIXELS_WIDE,
    STEP,
    Lookout,
    Window,
    corners_of,
    whole_frame,
    window_around,
    window_of,
)
from penumbra.tests.support.cells import derive

S = 1_000_000_000


def test_the_window_holds_the_whole_target_and_stays_while_it_does():
    table = description.load("table")
    camera, mesh = table.cameras["front"], anatomy.forearm_mesh(table.body)
    corners = corners_of(mesh.vertices)
    T = rigid.from_rpy((0.02, 0.0, 0.2), (0.1, 0.1, 0.2))
    window = window_around(camera, [(T, corners)])
    assert window is not None
    points = rigid.apply(rigid.inverse(camera.T_world_camera) @ T, mesh.vertices)
    pixels = points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    assert (pixels > (window.x0, window.y0)).all() and (pixels < (window.right, window.bottom)).all()
    assert window.x0 % 8 == window.y0 % 8 == window.width % 8 == window.height % 8 == 0
    nudged = rigid.perturb(T, np.array([0.005, 0, 0, 0, 0, 0]))
    assert window_around(camera, [(nudged, corners)], window) == window


@pytest.mark.parametrize("seed", range(20))
def test_a_window_lies_in_a_picture_of_any_size_and_reaches_its_edges_where_a_target_does(seed):
    rng = np.random.default_rng(seed)
    picture = Window(0, 0, *rng.integers(100, 2000, size=2).tolist())
    size, previous = np.array([picture.width, picture.height]), None
    for _ in range(50):  # each from where the one before has looked
        low, high = np.sort(rng.uniform(-0.2, 1.2, (2, 2)) * size, axis=0)
        window = window_of(picture, low, high, float(rng.uniform(1.0, 0.3 * size.min())), previous)
        if window is None:
            assert np.any(np.minimum(high, size - 1.0) - np.maximum(low, 0.0) < 2.0)
            continue
        unit, ends = STEP * window.scale, np.array([window.right, window.bottom])
        assert window.x0 % unit == window.y0 % unit == 0 and (ends <= size).all()
        begins, at_edge = np.array([window.x0, window.y0]), np.array([low <= 0.0, high >= size])
        assert (np.where(at_edge[0], begins == 0, begins <= low + unit / 2.0)).all(), "rounded to the nearest multiple"
        assert (np.where(at_edge[1], ends > size - window.scale, ends >= high - unit / 2.0)).all()
        previous = window


def test_a_target_out_of_the_picture_has_no_window_and_the_whole_frame_is_coarse():
    table = description.load("table")
    camera = table.cameras["front"]
    behind = rigid.from_rpy((0.35, -3.0, 0.9), (0, 0, 0))
    assert window_around(camera, [(behind, corners_of(anatomy.forearm_mesh(table.body).vertices))]) is None
    assert whole_frame(camera) == Window(0, 0, 320, 240, 2)


def fused(T: rigid.Array, state: Any = "tracking", stamp_ns: int = S, sigma: float = 0.001) -> FusedPose:
    """The pose with standard deviations `sigma`, in m and rad."""
    position, orientation = rigid.position_orientation(T)
    return FusedPose(
        stamp_ns=stamp_ns, target="forearm", frame="world", position=position, orientation=orientation,
        velocity=np.zeros(6), covariance=sigma**2 * np.eye(6), state=state, sources={},
    )  # fmt: skip


def pixels_of(camera: description.Camera, points: np.ndarray) -> np.ndarray:
    local = rigid.apply(rigid.inverse(camera.T_world_camera), points)
    return local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def holds(window: Window, pixels: np.ndarray) -> bool:
    """Whether all pixels (n, 2), x and y, lie in a window."""
    return bool((pixels > (window.x0, window.y0)).all() and (pixels < (window.right, window.bottom)).all())


@pytest.fixture(scope="module")
def far() -> description.Cell:
    """A target eight metres from a camera of twelve megapixels."""
    table = description.load("table")
    update = {"width": 4096, "height": 3000, "fx": 5000.0, "fy": 5000.0, "cx": 2047.5, "cy": 1499.5, "position": (2.0, -7.0, 3.5)}
    return table.model_copy(update={"cameras": {"front": table.cameras["front"].model_copy(update=update)}})


def test_a_lost_target_is_looked_for_around_its_home(far):
    lookout, target = Lookout(far, "front"), far.targets["forearm"]
    first = lookout.window
    assert first.width * first.height <= MAX_PIXELS_WIDE and first.scale < whole_frame(far.cameras["front"]).scale
    rng = np.random.default_rng(0)
    limb = anatomy.target_mesh(target, far).vertices
    for _ in range(50):
        T = rigid.perturb(target.home.transform, np.repeat([0.12, 0.4], 3) * rng.uniform(-1.0, 1.0, 6))
        pixels = pixels_of(far.cameras["front"], rigid.apply(T, limb))
        assert holds(first, pixels)
    lookout.add(fused(target.home.transform, "lost"))
    assert lookout.look(S) == first


def test_a_known_target_is_looked_at_until_its_pose_is_old(far):
    lookout, T = Lookout(far, "front"), rigid.from_rpy((0.05, 0.02, 0.25), (0.1, 0.0, 0.3))
    wide = lookout.window
    lookout.add(fused(T))
    near = lookout.look(S + 40_000_000)
    assert near == window_around(
        far.cameras["front"], [(T, corners_of(anatomy.target_mesh(far.targets["forearm"], far).vertices))]
    )
    assert near.scale < wide.scale
    assert lookout.look(2 * S) == wide


def test_a_target_that_nothing_measures_is_in_the_window_wherever_it_may_be(far):
    lookout, camera = Lookout(far, "front"), far.cameras["front"]
    T, limb = rigid.from_rpy((0.05, 0.02, 0.25), (0.1, 0.0, 0.3)), anatomy.target_mesh(far.targets["forearm"], far).vertices
    lookout.add(fused(T))
    near = lookout.look(S)
    lookout.add(fused(T, "coasting", sigma=0.2))
    wide = lookout.look(S)
    assert wide.width * wide.height < 1.5 * MAX_PIXELS
    lookout.add(fused(T, sigma=0.2))
    assert lookout.look(S) == near, "a tracked one is seen or felt there"
    for side in (-0.19, 0.19):  # within a standard deviation
        moved = rigid.perturb(T, np.array([*(side * camera.T_world_camera[:3, 0]), 0.0, 0.0, 0.0]))
        pixels = pixels_of(camera, rigid.apply(moved, limb))
        assert not holds(near, pixels) and holds(wide, pixels)


def test_with_fewer_pixels_a_known_target_is_seen_coarser_and_a_lost_one_as_before(far):
    many, few = Lookout(far, "front"), Lookout(far, "front", 96 * 96)
    assert few.window == many.window
    for lookout in (many, few):
        lookout.add(fused(rigid.from_rpy((0.05, 0.02, 0.25), (0.1, 0.0, 0.3))))
    fine, coarse = many.look(S), few.look(S)
    assert coarse.width * coarse.height < fine.width * fine.height and coarse.scale == 2 * fine.scale


def test_what_is_foreseen_is_what_will_be_looked_at_and_changes_nothing(far):
    lookout, T = Lookout(far, "front"), rigid.from_rpy((0.05, 0.02, 0.25), (0.1, 0.0, 0.3))
    lookout.add(fused(T))
    now = lookout.look(S)
    wide = lookout.foresee(2 * S)  # by then the pose is too old
    assert wide != now and lookout.window == now and lookout.foresee(S) == now
    assert lookout.look(2 * S) == wide


def test_the_window_at_home_is_that_of_a_target_that_is_found_there():
    table = description.load("table")
    lookout = Lookout(table, "front")
    at_home, wide = lookout.at_home, lookout.window
    assert lookout.window == wide  # asking changes nothing
    lookout.add(fused(table.targets["forearm"].home.transform))
    assert lookout.look(S) == at_home != wide


def test_a_home_out_of_the_picture_is_looked_for_everywhere(far):
    away = far.targets["forearm"].model_copy(update={"home": description.Placement(position=(0.0, -20.0, 0.2))})
    lookout = Lookout(far.model_copy(update={"targets": {"forearm": away}}), "front")
    assert lookout.window == whole_frame(far.cameras["front"])


def test_a_camera_is_on_those_targets_whose_home_may_be_in_its_picture(tmp_path):
    side_by_side = description.load(derive("table", 5, 4, tmp_path))
    on = {camera: Lookout(side_by_side, camera).targets for camera in side_by_side.cameras}
    assert list(on.values()) == [("forearm",), ("forearm1",), ("forearm2",), ("forearm3",), ("forearm",)]
    lookout = Lookout(side_by_side, "camera1")
    alone = Lookout(description.load(derive("table", 1, 1, tmp_path)), "camera0")
    assert lookout.window == alone.window, "what is elsewhere widens no window"


def test_a_home_beside_the_camera_is_not_in_its_picture_and_one_around_it_may_be(far):
    front, forearm = far.cameras["front"], far.targets["forearm"]
    beside = forearm.model_copy(update={"home": description.Placement(position=(front.position[0] + 6.0, *front.position[1:]))})
    around = forearm.model_copy(update={"home": description.Placement(position=front.position)})
    assert Lookout(far.model_copy(update={"targets": {"beside": beside, "around": around}}), "front").targets == ("around",)
