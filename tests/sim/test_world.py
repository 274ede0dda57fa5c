"""The simulated world: a function of time and seed that touches nothing, hides what it is told to hide, and obeys commands."""

import itertools
from collections import Counter
from typing import Any

import numpy as np
import pytest
import trimesh

from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import Label
from penumbra.shared.contract.topics import TRUTH, VOLTAGES
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.surface import Surface
from penumbra.sim.picture.occluder import AWAY, OcclusionSchedule, box
from penumbra.sim.world.clearance import hull_points, rotations
from penumbra.sim.world.motion import Clock
from penumbra.sim.world.world import BATCH, TICK_NS, Sensors, World, record
from penumbra.tests.support.cells import derive

CELLS = {name: cells.load(name) for name in ("table", "arm")}
SECONDS = 60.0


@pytest.fixture(scope="module", params=CELLS)
def world(request):
    """A world that nobody commands."""
    world = World(CELLS[request.param], seed=3)
    world.plan(SECONDS)
    return world


def camera_of(world):
    return next(iter(world.cell.cameras))


def test_a_world_is_a_function_of_seed_and_time_in_any_order():
    cell = CELLS["arm"]
    forward, backward, other = World(cell, 5), World(cell, 5), World(cell, 6)
    times = [0.0, 0.4, 3.3, 9.1]
    states = {t: forward.state(t) for t in times}
    for t in reversed(times):
        again = backward.state(t)
        np.testing.assert_array_equal(again.T_world_target, states[t].T_world_target)
        np.testing.assert_array_equal(again.joints["panda"], states[t].joints["panda"])
        assert not np.allclose(other.state(t).T_world_target, again.T_world_target)
    view, same = forward.view("side", 3.3), backward.view("side", 3.3)
    np.testing.assert_array_equal(view.image, same.image)
    assert not np.array_equal(view.image, other.view("side", 3.3).image)


def test_the_target_stays_in_its_region_below_its_speed_and_never_jumps(world):
    region, dt = world.sim.motion, 0.01
    poses, velocities = zip(*((s.pose, s.velocity) for s in map(world.state, np.arange(0.0, 30.0, dt))), strict=True)
    assert (np.min(poses, axis=0) >= [*region.low, *region.rpy_low]).all()
    assert (np.max(poses, axis=0) <= [*region.high, *region.rpy_high]).all()
    assert np.linalg.norm(np.array(velocities)[:, :3], axis=1).max() <= region.speed
    assert np.abs(np.diff(velocities, axis=0) / dt)[:, :3].max() < 3.0  # m/s^2: no jerk of a limb exceeds it
    assert np.ptp(poses, axis=0)[:3].min() > 0.05  # and it does move


def test_the_velocity_is_the_derivative_of_the_pose(world):
    h = 1e-5
    for t in np.linspace(1.0, 20.0, 40):
        before, now, after = world.state(t - h), world.state(t), world.state(t + h)
        measured = rigid.pose_error(after.T_world_target, before.T_world_target) / (2 * h)
        np.testing.assert_allclose(now.velocity, measured, atol=1e-4)


def test_the_person_touches_neither_robot_nor_pads_nor_table(world):
    skins = [Surface(mesh.vertices, mesh.faces) for mesh in world.person.meshes]
    hulls = [(robot, link, hull_points(mesh, 0.01)) for robot, m in world.robots.items() for link, mesh in m.meshes.items()]
    least_hull, least_gap, lowest = np.inf, np.inf, np.inf
    for t in np.arange(0.0, SECONDS, 0.11):
        state = world.state(t)
        least_gap = min(least_gap, world.gaps(state).min())
        placed = world.person.poses(state.T_world_target)
        lowest = min(
            lowest, *(rigid.apply(T, m.vertices)[:, 2].min() for m, T in zip(world.person.meshes[:2], placed, strict=False))
        )
        if hulls:
            points = np.concatenate([rigid.apply(state.links[robot][link], points) for robot, link, points in hulls])
            for skin, T in zip(skins, placed, strict=True):
                local = rigid.apply(rigid.inverse(T), points)
                near = (np.abs(local - skin.vertices.mean(axis=0)) < np.ptp(skin.vertices, axis=0) / 2 + 0.1).all(axis=1)
                if near.any():
                    least_hull = min(least_hull, skin.nearest(local[near])[0].min())
    assert lowest > 0.02
    if hulls:
        assert 0.015 < least_hull < 0.15
        assert least_gap > 0.015
    else:
        assert least_gap > 0.02


def test_the_reach_of_the_skin_is_entered_and_left_again_and_again(world):
    near = np.array([world.gaps(world.state(t)).min() < 0.15 for t in np.arange(0.0, SECONDS, 0.1)])
    assert 0.2 < near.mean() < 0.8
    assert np.abs(np.diff(near.astype(int))).sum() >= 8


def test_upper_arm_and_torso_hang_together_with_the_forearm(world):
    body = world.cell.body
    for t in (0.0, 7.0, 20.0):
        target, upper_arm, torso = world.person.poses(world.state(t).T_world_target)
        elbow = rigid.apply(target, (-body.forearm_length / 2, 0.0, 0.0))
        np.testing.assert_allclose(rigid.apply(upper_arm, (body.upper_arm_length, 0.0, 0.0)), elbow, atol=1e-9)
        np.testing.assert_allclose(upper_arm[:3, 3], torso[:3, 3], atol=1e-12)
        np.testing.assert_allclose(upper_arm[:3, :3] @ upper_arm[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("seed", [0, 1, 4])
def test_the_occluder_hides_the_share_that_is_commanded(seed):
    world = World(CELLS["table"], seed)
    for level, begin in ((0.0, 0.0), (0.3, 4.0), (0.6, 8.0), (0.8, 12.0)):
        world.occlude(level, begin)
        for t in (begin + 2.0, begin + 3.5):
            assert world.view("front", t).hidden == pytest.approx(level, abs=0.1), (level, t)
    world.occlude(1.0, 16.0)
    assert world.view("front", 18.0).hidden == 1.0
    world.occlude(0.0, 20.0)
    assert not (world.view("front", 22.0).labels == Label.OCCLUDER).any()


def test_the_robot_hides_the_forearm_at_times_and_at_others_does_not():
    world = World(CELLS["arm"], 0)
    world.occlude(0.0, 0.0)
    hidden = [world.view("side", t).hidden for t in np.arange(2.0, 60.0, 2.9)]
    assert min(hidden) < 0.1 and max(hidden) > 0.6


def test_a_view_labels_what_it_shows(world):
    view = world.view(camera_of(world), 1.0)
    camera = world.cell.cameras[camera_of(world)]
    assert view.image.shape == (camera.height, camera.width, 3) and view.image.dtype == np.uint8
    expected = {Label.BACKGROUND, Label.TORSO, Label.UPPER_ARM, Label.FOREARM, Label.HAND} | (
        {Label.ROBOT} if world.robots else set()
    )
    assert set(np.unique(view.labels)) == expected  # the schedule begins with the occluder away
    middle = rigid.apply(rigid.inverse(camera.T_world_camera), world.state(1.0).T_world_target[:3, 3])
    u, v, w = camera.K @ middle
    assert view.hidden > 0.5 or view.labels[round(v / w), round(u / w)] in (Label.FOREARM, Label.HAND)


def test_the_automatic_occluder_leaves_and_hides_wholly_for_two_seconds_and_more():
    for seed in range(5):
        schedule = OcclusionSchedule(seed)
        levels = np.array([schedule.at(t) for t in np.arange(0.0, 120.0, 0.1)])
        runs = [(level, len(list(run))) for level, run in itertools.groupby(levels)]
        assert max(n for level, n in runs if level == AWAY) >= 25
        assert sum(n >= 20 for level, n in runs if level == 1.0) >= 3
        assert 0.25 < (levels > 0.0).mean() < 0.75
        assert np.abs(np.diff(levels)).max() <= OcclusionSchedule.SLOPE * 0.1 + 1e-9  # it slides


def test_a_pause_holds_everything_and_motion_off_spares_the_occluder():
    world = World(CELLS["arm"], 2)
    world.set_paused(True, 2.0)
    held, later = world.state(2.0 + Clock.RAMP_S), world.state(30.0)
    np.testing.assert_array_equal(held.T_world_target, later.T_world_target)
    np.testing.assert_allclose(held.joints["panda"], later.joints["panda"], atol=1e-4)  # motors hold it, as well as they can
    np.testing.assert_array_equal(later.velocity, np.zeros(6))
    assert world.describe(30.0)["paused"] is True
    levels = {world.occlusion.at(world.occlusion_clock.at(t)) for t in np.arange(3.0, 30.0, 0.5)}
    assert levels == {AWAY}

    world.set_paused(False, 30.0)
    world.set_motion(False, 31.0)
    np.testing.assert_array_equal(world.state(32.0).T_world_target, world.state(50.0).T_world_target)
    assert len({world.occlusion.at(world.occlusion_clock.at(t)) for t in np.arange(32.0, 60.0, 0.5)}) > 1
    assert not np.array_equal(world.state(30.5).T_world_target, later.T_world_target)


def test_speed_scales_the_motion_and_its_velocity_without_a_jump():
    plain, fast = World(CELLS["table"], 2), World(CELLS["table"], 2)
    fast.set_speed(2.0, 5.0)
    scene_s = fast.clock.at(8.0)
    assert scene_s == pytest.approx(8.0 + 3.0 - Clock.RAMP_S / 2)
    np.testing.assert_allclose(fast.state(8.0).T_world_target, plain.state(scene_s).T_world_target)
    np.testing.assert_allclose(fast.state(8.0).velocity, 2.0 * plain.state(scene_s).velocity)
    steps = [np.linalg.norm(fast.state(t + 0.001).velocity - fast.state(t).velocity) for t in np.arange(4.9, 5.5, 0.001)]
    assert max(steps) < 0.02


@pytest.mark.parametrize("speed", [0.0, -1.0, 100.0, float("nan")])
def test_a_speed_that_cannot_be_is_refused(speed):
    with pytest.raises(ValueError, match="speed: expected a factor above 0 and at most 4"):
        World(CELLS["table"], 0).set_speed(speed, 0.0)


@pytest.mark.parametrize("level", [-0.1, 1.1, float("nan")])
def test_an_occlusion_that_cannot_be_is_refused(level):
    with pytest.raises(ValueError, match="occlude: expected a share from 0 to 1 or auto"):
        World(CELLS["table"], 0).occlude(level, 0.0)


def with_sim(name, **changes):
    cell = CELLS[name]
    assert cell.sim is not None
    return cell.model_copy(update={"sim": cell.sim.model_copy(update=changes)})


def test_a_cell_that_the_emulator_cannot_move_in_is_reported():
    table = CELLS["table"]
    assert table.sim is not None
    with pytest.raises(cells.CellError, match="cell table has no `sim`: the emulator needs its motion"):
        World(table.model_copy(update={"sim": None}))
    below = table.sim.motion.model_copy(update={"low": (0.0, 0.0, -0.3), "high": (0.1, 0.1, -0.2)})
    with pytest.raises(
        cells.CellError, match=r"clear of robot, pads and table, got none from \[0, 0, -0.3\] to .*; move or widen"
    ):
        World(with_sim("table", motion=below))
    with pytest.raises(cells.CellError, match="expected 7 values, one per joint of panda, got 2 and 7"):
        World(with_sim("arm", joints_low=(0.0, 0.0)))


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    return cells.load(derive("table", 3, 3, tmp_path_factory.mktemp("cells")))


def test_several_persons_move_each_at_home_and_the_first_as_if_alone(three):
    world, alone = World(three, 4), World(CELLS["table"], 4)
    for t in (0.0, 3.0, 7.5):
        targets = world.state(t).targets
        np.testing.assert_array_equal(targets["forearm"].T_world_target, alone.state(t).T_world_target)
        for name, placed in targets.items():
            away = placed.pose[:3] - three.targets[name].home.position
            assert np.abs(away).max() < 0.4, "within the region around its own home"
    assert not np.allclose(targets["forearm"].pose[1:], targets["forearm1"].pose[1:]), "they move differently"


def test_a_pad_feels_only_who_is_near_it_and_a_camera_sees_only_who_is_before_it(three):
    world, alone = World(three, 4), World(CELLS["table"], 4)
    state = world.state(5.0)
    change, first = world.change(state), alone.change(alone.state(5.0))
    np.testing.assert_allclose(change[: len(first)], first)
    assert len(change) == 3 * len(first) and (change[len(first) :] > 0).all()
    for place, camera in enumerate(three.cameras):
        assert world.model(camera) == list(three.targets)[place]
        assert [name for name in world.bodies(camera, state) if name.startswith("target")] == ["target"]
    truths: dict[str, Any] = {names["target"]: m for topic, names, m in Sensors(world, 10**18).tick(250) if topic is TRUTH}
    for name, truth in truths.items():
        np.testing.assert_allclose(truth.position, state.targets[name].pose[:3])
        assert truth.gap == pytest.approx(world.gaps(state, name).min())


def test_a_pad_that_nobody_comes_near_reads_its_rest():
    table = CELLS["table"]
    far = table.pads["p0"].model_copy(update={"position": (9.0, 0.0, 0.0)})
    world = World(table.model_copy(update={"pads": {**table.pads, "far": far}}), 1)
    sent: list[Any] = [m for topic, names, m in Sensors(world, 10**18).tick(3) if topic is VOLTAGES and names["pad"] == "far"]
    assert len(sent) == 1
    np.testing.assert_allclose(
        sent[0].volts, table.pad_types[far.type].rest.a3, atol=6 * table.pad_types[far.type].rest.noise ** 0.5
    )


def test_cameras_around_one_place_all_look_at_its_target(tmp_path):
    world = World(cells.load(derive("arm", 3, 1, tmp_path)), 2)
    for camera in world.cell.cameras:
        assert (world.view(camera, 1.0).labels == Label.FOREARM).sum() > 500


def test_a_recording_is_what_the_emulator_publishes_in_order_and_again_the_same():
    cell = CELLS["arm"]
    first, second = (list(record(cell, 7, 0.36)) for _ in range(2))
    assert [m.stamp_ns for _, _, m in first] == sorted(m.stamp_ns for _, _, m in first)
    counts = Counter(topic.name for topic, _, _ in first)
    assert counts == {"frame": 8, "voltages": 8 * 18, "joints": 18, "truth": 18}
    for (topic, names, a), (topic_again, names_again, b) in zip(first, second, strict=True):
        assert (topic, names) == (topic_again, names_again)
        for field in a.__struct_fields__:
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))


def test_recorded_voltages_are_the_fields_at_the_true_pose():
    cell = CELLS["table"]
    world, epoch = World(cell, 3), 10**18
    assert world.skin is not None
    stream: list[tuple[Any, Any, Any]] = list(record(cell, 3, 8.0, frames=False, epoch_ns=epoch))
    truth = [m for topic, _, m in stream if topic.name == "truth"]
    volts: dict[int, list[np.ndarray]] = {}
    for topic, _, m in stream:
        if topic.name == "voltages":
            assert m.volts.shape == (BATCH, 5) and m.period_ns == 1_000_000
            volts.setdefault(m.stamp_ns, []).append(m.volts[-1])
    signals = []
    for m in truth[::12]:
        state = world.state((m.stamp_ns - epoch) * 1e-9)
        gaps = world.gaps(state)
        assert m.gap == gaps.min()
        np.testing.assert_allclose(m.position, state.T_world_target[:3, 3])
        np.testing.assert_allclose(rigid.transform(m.position, m.orientation), state.T_world_target, atol=1e-12)
        noise = np.concatenate(volts[m.stamp_ns]) - world.skin.skin.amplitude(world.change(state))
        assert np.abs(noise).max() < 6 * np.sqrt(6.2e-6)
        signals.append(noise)
    assert np.var(signals) == pytest.approx(6.2e-6, rel=0.25)  # 1360 samples: 10 % at two sigma
    assert [b.stamp_ns - a.stamp_ns for a, b in itertools.pairwise(truth)] == [TICK_NS] * (len(truth) - 1)


def test_a_box_is_closed_and_its_triangles_face_outwards():
    shape = box((0.2, 0.4, 0.6), (1.0, 2.0, 3.0), Label.OCCLUDER)
    solid = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    assert solid.is_volume, "closed, and every triangle faces outwards"
    assert solid.volume == pytest.approx(0.2 * 0.4 * 0.6)
    np.testing.assert_allclose(solid.bounds, [[0.9, 1.8, 2.7], [1.1, 2.2, 3.3]])
    np.testing.assert_array_equal(shape.faces, trimesh.creation.box().faces)


def test_many_rotations_at_once_are_those_of_one_after_another():
    angles = np.random.default_rng(1).uniform(-3.0, 3.0, (50, 3))
    expected = [rigid.from_rpy(np.zeros(3), rpy)[:3, :3] for rpy in angles]
    np.testing.assert_allclose(rotations(angles), expected, atol=1e-12)  # rounding
