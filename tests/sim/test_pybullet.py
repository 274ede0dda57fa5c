"""Kinematics, hulls and pictures agree with pybullet's. Collected where pybullet is installed (tests/conftest.py)."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data
import pytest
import trimesh

from penumbra.shared.body import anatomy
from penumbra.shared.body.robot import RobotModel
from penumbra.shared.cell import description
from penumbra.shared.geometry import raster, rigid
from penumbra.tests.support.robots import PANDA, odd_robot

ORIGINAL = Path(pybullet_data.getDataPath()) / "franka_panda"
"""The Panda as Bullet distributes it, from which the built-in one was made."""
HELD = {"held": 0.3}
"""The joint of the odd robot that no cell names, and where its limits hold it [rad]."""


@pytest.fixture
def client() -> Iterator[int]:
    client = pybullet.connect(pybullet.DIRECT)
    yield client
    pybullet.disconnect(client)


def load(client: int, urdf: Path) -> tuple[int, list[tuple]]:
    """The body of a URDF, and what pybullet says of its joints."""
    flags = pybullet.URDF_USE_IMPLICIT_CYLINDER  # without it a cylinder is a mesh without a file
    robot = pybullet.loadURDF(str(urdf), useFixedBase=True, flags=flags, physicsClientId=client)
    return robot, [pybullet.getJointInfo(robot, i, client) for i in range(pybullet.getNumJoints(robot, client))]


def reference(client: int, urdf: Path, model: RobotModel, joints: dict[str, float]) -> dict[str, np.ndarray]:
    """T_world_link of every link but the base, by pybullet, at joint values by name."""
    robot, infos = load(client, urdf)
    for info in infos:
        if (name := info[1].decode()) in joints:
            pybullet.resetJointState(robot, info[0], joints[name], physicsClientId=client)
    T = model.T_world_base @ rigid.transform(*pybullet.getDynamicsInfo(robot, -1, client)[3:5])
    pybullet.resetBasePositionAndOrientation(robot, *rigid.position_orientation(T), physicsClientId=client)
    states = [pybullet.getLinkState(robot, info[0], computeForwardKinematics=True, physicsClientId=client) for info in infos]
    return {info[12].decode(): rigid.transform(*state[4:6]) for info, state in zip(infos, states, strict=True)}


@pytest.fixture(scope="module")
def odd(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    folder = tmp_path_factory.mktemp("robot")
    return RobotModel(odd_robot(folder), folder)


def test_forward_kinematics_and_limits_of_the_panda_are_those_of_the_original(client):
    panda = RobotModel(PANDA)
    q = np.random.default_rng(0).uniform(panda.lower, panda.upper)
    links = panda.link_transforms(q)
    expected = reference(client, ORIGINAL / "panda.urdf", panda, dict(zip(panda.joints, q, strict=True)))
    assert list(links) == ["panda_link0", *expected]
    for link, T in expected.items():  # pybullet reports single precision
        np.testing.assert_allclose(links[link], T, atol=1e-6, err_msg=link)
    infos = {info[1].decode(): info for info in load(client, ORIGINAL / "panda.urdf")[1]}
    joints = {joint.name: joint for joint in panda.description.joints}
    for i, name in enumerate(panda.joints):
        ours = (panda.lower[i], panda.upper[i], joints[name].effort, joints[name].velocity)
        np.testing.assert_allclose(ours, infos[name][8:12], rtol=1e-6)


def test_forward_kinematics_knows_slides_free_turns_held_joints_and_tilted_inertias(odd, client):
    q = np.array([2.9, -1.1, 0.37])
    joints = dict(zip(odd.joints, q.tolist(), strict=True)) | HELD
    for link, T in reference(client, odd.description.path, odd, joints).items():
        np.testing.assert_allclose(odd.link_transforms(q)[link], T, atol=1e-6, err_msg=link)
    assert np.isinf(odd.lower[0]) and odd.lower[1:].tolist() == [-2.0, 0.0] and odd.upper[1:].tolist() == [2.0, 1.0]


def test_collision_meshes_are_where_pybullet_s_rays_hit(odd, client):
    q = np.array([0.3, 0.8, 0.1])
    reference(client, odd.description.path, odd, dict(zip(odd.joints, q.tolist(), strict=True)) | HELD)
    links, rng = odd.link_transforms(q), np.random.default_rng(2)
    for link in ("base", "one"):
        vertices = rigid.apply(links[link], odd.meshes[link].vertices)
        middle = vertices.mean(axis=0)
        for vertex in rng.permutation(vertices)[:20]:
            outside = middle + 3.0 * (vertex - middle)
            hit = pybullet.rayTest(outside, middle, physicsClientId=client)[0]
            inward = np.linalg.norm(np.array(hit[3]) - outside) - np.linalg.norm(vertex - outside)
            assert hit[0] >= 0 and inward < 2e-3, (link, inward)  # no vertex outside of pybullet's shape: facets are inside


def test_the_built_in_panda_has_the_triangles_and_masses_of_the_original(client):
    panda = RobotModel(PANDA)
    robot, infos = load(client, ORIGINAL / "panda.urdf")
    assert len(infos) == len(panda.links) - 1
    for i, link in enumerate(panda.description.links):
        mass, centre = (pybullet.getDynamicsInfo(robot, i - 1, client)[field] for field in (0, 3))
        assert i == 0 or mass == pytest.approx(link.mass)  # pybullet reports a fixed base without mass
        np.testing.assert_allclose(link.centre, centre, atol=1e-6)
        for solid in link.solids:
            assert solid.file is not None
            original = trimesh.load_mesh(ORIGINAL / "meshes" / "collision" / solid.file.name)
            ours = panda.meshes[link.name]
            theirs = rigid.apply(solid.T_link_solid, original.triangles)
            np.testing.assert_array_equal(ours.vertices[ours.faces], theirs)


def test_the_picture_agrees_with_pybullet_s_renderer(client):
    path = f"{pybullet_data.getDataPath()}/duck.obj"
    shape = pybullet.createVisualShape(pybullet.GEOM_MESH, fileName=path, meshScale=[0.1] * 3, physicsClientId=client)
    pybullet.createMultiBody(baseVisualShapeIndex=shape, basePosition=(0, 0, 0), physicsClientId=client)
    size, f = 320, 300.0
    eye = (0.35, -0.45, 0.3)
    view = pybullet.computeViewMatrix(eye, (0, 0, 0.08), (0, 0, 1))
    projection = pybullet.computeProjectionMatrixFOV(2 * np.degrees(np.arctan(size / 2 / f)), 1.0, 0.01, 10)
    renderer = pybullet.ER_TINY_RENDERER
    ids = pybullet.getCameraImage(size, size, view, projection, renderer=renderer, physicsClientId=client)[4]
    theirs = (np.asarray(ids).reshape(size, size) & 0xFFFFFF) == 0
    table = description.load("table")
    mesh = anatomy.target_mesh(table.targets["forearm"].model_copy(update={"mesh": path}), table)  # an absolute path
    vertices = rigid.apply(rigid.inverse(rigid.look_at(eye, (0, 0, 0.08))), mesh.vertices * 0.1)
    # TinyRenderer samples half a pixel to the left of and above the centre of the image plane's own pixels
    ours = raster.silhouette(vertices, mesh.faces, (f, f, size / 2, size / 2 - 1), (0, 0, size, size))
    assert theirs.sum() > 2000
    assert (ours & theirs).sum() / (ours | theirs).sum() > 0.99
