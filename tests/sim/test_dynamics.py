"""The emulated robot as a body: it follows its script, carries a load, keeps its limits, and stops before it touches a person."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.body.robot import RobotModel, robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import rigid
from penumbra.sim.picture.occluder import box
from penumbra.sim.world.dynamics import CATCH_UP, STOP_M, TICK_S, Bystander, Robots, connected_parts
from penumbra.sim.world.motion import joint_motions
from penumbra.sim.world.world import World
from penumbra.tests.support.robots import odd_robot

ARM = cells.load("arm")
REST = np.array([0.0, -0.1, 0.0, -2.0, 0.0, 1.9, 0.785])
"""Joint values [rad] in the middle of the cell's bounds."""
FAR = rigid.from_rpy((9.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def panda() -> RobotModel:
    return robot_models(ARM)["panda"]


def moved(panda, script, persons=(), payload=None, obstacles=()):
    payloads = {"panda": payload} if payload else {}
    return Robots({"panda": panda}, payloads, lambda t: {"panda": script(t)}, persons, obstacles)


def sweep(time_s):
    """The first joint turns by 1 rad at 0.2 rad/s, beginning gently, the others rest."""
    q = REST.copy()
    q[0] += np.interp(time_s, [0.0, 1.0, 5.5, 6.0], [0.0, 0.05, 0.95, 1.0])
    return q


def in_the_way(panda, share=0.5):
    """T_world_box of a place that the robot's hand passes in `sweep`."""
    q = REST.copy()
    q[0] += share
    T = panda.link_transforms(q)["panda_hand"].copy()
    T[:3, :3] = np.eye(3)
    return T


def person(at):
    return Bystander([box((0.06, 0.06, 0.3), (0.0, 0.0, 0.0), Label.FOREARM)], lambda time_s: [at(time_s)])


def resting_cube(T, size):
    return Bystander([box((size,) * 3, (0.0, 0.0, 0.0), Label.FOREARM)], lambda time_s: [T])


def gap(robots):
    """Between the robot and the nearest person at the last tick [m]."""
    return robots._arms["panda"]._gap


@pytest.mark.parametrize("seed", [0, 1])
def test_in_the_built_in_cell_the_robot_keeps_to_its_script_and_is_never_stopped(seed):
    assert ARM.sim is not None
    world = World(ARM, seed)
    script = joint_motions(ARM, ARM.sim, seed)["panda"]
    for t in np.arange(0.0, 40.0, 0.05):
        off = np.abs(world.state(t).joints["panda"] - script.at(t)).max()
        assert off < 1e-4, t  # 5 micrometres at the hand: what Bullet's solver and the line between two ticks leave
        assert world.describe(t)["stopped"] == {"panda": False}, t


def test_a_robot_stops_before_it_touches_and_goes_on_when_the_way_is_free(panda):
    place = in_the_way(panda)
    robots = moved(panda, sweep, [person(lambda t: place if t < 8.0 else FAR)])
    turned: list[float] = []
    gaps = []
    for t in np.arange(0.0, 14.0, TICK_S):
        turned.append(robots.at(t)["panda"][0])
        gaps.append(gap(robots))
    angles = np.array(turned)
    at = {t: round(t / TICK_S) for t in (6.0, 7.9, 8.1, 13.9)}
    assert min(gaps) > 0.0 and min(gaps) < 2 * STOP_M, "it stops near the person and does not touch"
    assert 0.1 < angles[at[6.0]] < 0.5 and angles[at[6.0]] == pytest.approx(angles[at[7.9]], abs=1e-4), "it stands still"
    assert angles[at[13.9]] == pytest.approx(1.0, abs=1e-3), "it catches up"
    assert np.abs(np.diff(angles)).max() / TICK_S < CATCH_UP + 0.2 + 1e-3, "and takes its time for it"
    assert robots.stopped() == {"panda": False}


def test_a_robot_that_is_pushed_yields(panda):
    place = in_the_way(panda)
    against = np.cross(place[:3, 3] - panda.T_world_base[:3, 3], (0.0, 0.0, 1.0))
    against /= np.linalg.norm(against)

    def pusher(time_s):
        """Stands in the way, then goes 10 cm against the robot's motion in two seconds."""
        T = place.copy()
        T[:3, 3] += against * 0.05 * np.clip(time_s - 5.0, 0.0, 2.0)
        return T

    robots = moved(panda, sweep, [person(pusher)])
    stood = panda.link_transforms(robots.at(4.9)["panda"])["panda_hand"][:3, 3]
    deepest = min(gap(robots) for t in np.arange(5.0, 7.5, TICK_S) if robots.at(t))
    pushed = panda.link_transforms(robots.at(7.5)["panda"])["panda_hand"][:3, 3]
    assert against @ (pushed - stood) > 0.03, "the hand was pushed away"
    assert deepest > -0.005, "and the person did not get into the robot"
    assert robots.stopped() == {"panda": True}


def test_the_rated_load_is_carried_and_ten_times_of_it_sinks_to_the_table(panda):
    table = box((2.0, 2.0, 0.03), (0.0, 0.0, -0.015), Label.BACKGROUND)
    loads = {mass: cells.Payload(mass=mass, link="panda_hand", position=(0.0, 0.0, 0.1)) for mass in (3.0, 30.0)}
    carried = moved(panda, sweep, payload=loads[3.0], obstacles=[table])
    assert max(np.abs(carried.at(t)["panda"] - sweep(t)).max() for t in np.arange(0.0, 6.5, 0.1)) < 2e-3
    sunk = moved(panda, sweep, payload=loads[30.0], obstacles=[table]).at(6.5)["panda"]
    assert (sunk > panda.lower - 0.02).all() and (sunk < panda.upper + 0.02).all(), "joints keep their limits"
    T = panda.link_transforms(sunk)["panda_hand"]
    lowest = rigid.apply(T, panda.meshes["panda_hand"].vertices)[:, 2].min()
    assert T[2, 3] < panda.link_transforms(sweep(6.5))["panda_hand"][2, 3] - 0.2 and lowest > -0.02


def test_a_script_beyond_limits_is_followed_up_to_them_and_no_faster_than_the_motors_turn(panda):
    goal = REST + np.array([9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    robots = moved(panda, lambda t: REST if t < 0.5 else goal)
    angles = np.array([robots.at(t)["panda"][0] for t in np.arange(0.0, 8.0, TICK_S)])
    assert angles[-1] == pytest.approx(panda.upper[0], abs=1e-3)
    assert np.abs(np.diff(angles)).max() / TICK_S <= 2.175 + 1e-3


def test_times_may_be_asked_for_in_any_order_and_runs_are_alike(panda):
    times = [3.0, 0.013, 2.5, 0.0, 1.999]
    place = in_the_way(panda, 0.2)
    first, second = (moved(panda, sweep, [person(lambda t: place)]) for _ in range(2))
    forward = {t: first.at(t)["panda"] for t in sorted(times)}
    for t in times:
        np.testing.assert_array_equal(second.at(t)["panda"], forward[t])


def test_a_time_that_is_forgotten_is_reported(panda, monkeypatch):
    monkeypatch.setattr("penumbra.sim.world.dynamics.KEPT", 50)
    robots = moved(panda, sweep)
    robots.at(2.0)
    with pytest.raises(ValueError, match=r"expected a time of the last 1 s, got 0.5 s: make a new world"):
        robots.at(0.5)


def test_bodies_are_where_the_kinematics_puts_the_links(tmp_path):
    """Centres of mass beside the links' origins, tilted joints, a slide, several shapes a link: a thin rod finds every hull."""
    model = RobotModel(odd_robot(tmp_path), tmp_path)
    q = np.array([0.3, 0.8, 0.1])
    links = model.link_transforms(q)
    for link, mesh in model.meshes.items():
        vertices = rigid.apply(links[link], mesh.vertices)
        for axis in range(3):
            for vertex, side in ((vertices[vertices[:, axis].argmin()], -1.0), (vertices[vertices[:, axis].argmax()], 1.0)):
                T = np.eye(4)
                T[:3, 3] = vertex
                T[axis, 3] += side * 0.03  # a cube of 2 cm at 3 cm: a gap of 2 cm, unless another link is nearer
                robots = Robots({"odd": model}, {}, lambda t: {"odd": q}, [resting_cube(T, 0.02)], [])
                robots.at(TICK_S)
                assert robots._arms["odd"]._gap < 0.02 + 1e-3, (link, axis, side)


def test_the_parts_of_a_person_s_arm_are_convex():
    from scipy.spatial import ConvexHull

    mesh = World(ARM, 0).person.meshes[0]
    parts = connected_parts(mesh)
    assert len(parts) == 3 and sum(map(len, parts)) == len(mesh.vertices)
    whole = volume(mesh)
    assert sum(ConvexHull(part).volume for part in parts) == pytest.approx(whole, rel=0.08)


def volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def python(code: str) -> subprocess.CompletedProcess:
    root = Path(__file__).parents[2]
    return subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=120)


def test_a_world_with_a_robot_is_silent():
    done = python(
        "from penumbra.shared.cell import description; from penumbra.sim.world.world import World;"
        "World(description.load('arm'), 0).state(1.0)"
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_without_pybullet_cells_without_robots_run_and_others_say_what_to_install():
    code = """import sys; sys.modules["pybullet"] = None
from penumbra.shared.cell import description as cell; from penumbra.sim.world.world import World
print(World(cell.load("table"), 0).state(1.0).joints)
World(cell.load("arm"), 0)"""
    done = python(code)
    assert done.stdout == "{}\n"
    assert "cell arm has a robot: the emulator moves it with pybullet, which is not installed: pip install" in done.stderr
