"""The robot that a URDF describes, and what is reported of a URDF that cannot be used. tests/sim/test_pybullet.py has the
numbers."""

import dataclasses
import re
import subprocess
import sys
import timeit
from pathlib import Path

import numpy as np
import pytest

from penumbra.shared.body.robot import RobotModel, robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.tests.support.robots import ODD, ODD_JOINTS, PANDA, odd_robot


@pytest.fixture(scope="module")
def panda():
    return RobotModel(PANDA)


def test_forward_kinematics_of_many_poses_is_that_of_each(panda):
    q = np.random.default_rng(1).uniform(-1, 1, (4, 7))
    together = panda.link_transforms(q)
    for i in range(4):
        for link, T in panda.link_transforms(q[i]).items():
            np.testing.assert_allclose(together[link][i], T, atol=1e-12)


def test_meshes_are_the_files_of_the_urdf(panda):
    assert set(panda.meshes) == {*(f"panda_link{i}" for i in range(8)), "panda_hand", "panda_leftfinger", "panda_rightfinger"}
    assert sum(len(mesh.faces) for mesh in panda.meshes.values()) == 3472
    low, high = panda.meshes["panda_hand"].vertices.min(axis=0), panda.meshes["panda_hand"].vertices.max(axis=0)
    np.testing.assert_allclose(high - low, [0.0632, 0.2045, 0.0916], atol=2e-3)  # metres, not millimetres


def test_one_pose_costs_no_more_than_a_few_products_of_matrices_a_link(panda):
    def cost(call):
        return min(timeit.repeat(call, number=10, repeat=20))  # the best of some: other processes may run

    q, T = np.zeros(7), np.eye(4)
    assert cost(lambda: panda.link_transforms(q)) < 10 * len(panda.link_transforms(q)) * cost(lambda: T @ T)


def test_a_wrong_number_of_joint_angles_is_reported(panda):
    with pytest.raises(ValueError, match=r"expected 7 values \(panda_joint1, .*\), got shape \(6,\)"):
        panda.link_transforms(np.zeros(6))


def test_an_unknown_joint_is_reported_with_the_joints_that_there_are():
    with pytest.raises(cells.CellError, match=r"no moving joint elbow in .*panda.urdf: it has panda_joint1, panda_joint2"):
        RobotModel(PANDA.model_copy(update={"joints": ("panda_joint1", "elbow")}))


def test_a_missing_urdf_is_reported():
    with pytest.raises(cells.CellError, match=r"no file .*panda/none.urdf: give a URDF beside the cell file, or the built-in"):
        RobotModel(PANDA.model_copy(update={"urdf": "panda/none.urdf"}))


@pytest.mark.parametrize(
    ("old", "new", "line", "reason"),
    [
        ("</robot>", "<robot>", 21, "expected XML, got"),
        ('<link name="base">', "<link>", 2, "expected name=... in <link>, got none"),
        ('box size="0.2 0.1 0.4"', 'mesh filename="none.stl"', 4, "no file .*none.stl of a mesh: put it there, or correct"),
        ('box size="0.2 0.1 0.4"', 'mesh filename="package://no/none.stl"', 4, "no file .*no/none.stl of a mesh"),
        ('box size="0.2 0.1 0.4"', 'box size="0.2 0.1"', 4, r"expected size=3 numbers in <box>, got '0.2 0.1'"),
        ('box size="0.2 0.1 0.4"', 'box size="0.2 nan 0.4"', 4, "expected size=3 numbers in <box>, got '0.2 nan 0.4'"),
        ('box size="0.2 0.1 0.4"', 'box size="0.2 -1 0.4"', 4, "expected a box with sizes above 0 m"),
        ('box size="0.2 0.1 0.4"', "cone", 4, "expected one of mesh, box, sphere, cylinder, capsule as geometry, got cone"),
        ('<mass value="1"/>\n   <inertia ixx="1" iyy="1"', '<mass value="-1"/>\n   <inertia ixx="1" iyy="1"', 2, "a mass of at"),
        ('<parent link="three"/>', '<parent link="four"/>', 18, "expected a tree of links, got a cycle: four -> four"),
        ('<parent link="base"/>', '<parent link="four"/>', 6, "got a cycle: one -> two -> three -> four -> one"),
        ('<child link="two"/>', '<child link="one"/>', 12, "expected another child link for each joint, got 'one' again"),
        ('<link name="two">', '<link name="one">', 14, "expected another name for each link, got 'one' again"),
        ('<child link="two"/>', '<child link="thumb"/>', 12, "joint slide: no link 'thumb': it has base, one, two"),
        ('<axis xyz="0.6 0 0.8"/>', '<axis xyz="0 0 0"/>', 6, "expected an axis that is not zero"),
        ('type="prismatic"', 'type="floating"', 12, "a joint of type fixed, revolute, continuous, prismatic, got 'floating'"),
        ('<link name="base">', '<link name="loose"/><link name="base">', 1, "the base, got loose, base: join them"),
    ],
)  # fmt: skip
def test_a_urdf_that_cannot_be_used_is_reported_with_its_line(tmp_path, old, new, line, reason):
    with pytest.raises(cells.CellError, match=rf"robot: .*odd.urdf:{line}: .*{reason}"):
        RobotModel(odd_robot(tmp_path, edited(old, new)), tmp_path)


def edited(old: str, new: str) -> str:
    assert old in ODD
    return ODD.replace(old, new, 1)


def test_a_part_that_hangs_on_itself_is_reported_though_the_rest_is_a_tree(tmp_path):
    loop = """<link name="a"/><link name="b"/>
      <joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>
      <joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint></robot>"""
    with pytest.raises(cells.CellError, match=r"odd.urdf:2[23]: expected a tree of links, got a cycle: "):
        RobotModel(odd_robot(tmp_path, edited("</robot>", loop)), tmp_path)


def test_a_mesh_that_is_none_is_reported_when_it_is_asked_for(tmp_path):
    (tmp_path / "bad.stl").write_text("no mesh")
    model = RobotModel(odd_robot(tmp_path, edited('box size="0.2 0.1 0.4"', 'mesh filename="bad.stl"')), tmp_path)
    with pytest.raises(cells.CellError, match=r"odd.urdf:4: expected a mesh .*bad.stl"):
        _ = model.meshes


@pytest.mark.parametrize(
    "name", ["package://hand/parts/tip.obj", "package://parts/tip.obj", "file://parts/tip.obj", "parts/tip.obj"]
)
def test_meshes_are_found_beside_the_urdf_and_in_the_package_around_it(tmp_path, name):
    folder = tmp_path / "hand"
    (folder / "parts").mkdir(parents=True)
    (folder / "parts" / "tip.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    model = RobotModel(odd_robot(folder, edited('box size="0.2 0.1 0.4"', f'mesh filename="{name}" scale="2 2 2"')), folder)
    assert model.meshes["base"].vertices[:3].max() == pytest.approx(2.0 * np.cos(0.5), abs=1e-12)  # turned by 0.5 rad


def test_an_obj_with_more_than_triangles_is_the_same_mesh(tmp_path):
    plain = cells.BUILT_IN / "panda" / "meshes" / "hand.obj"
    (tmp_path / "rich.obj").write_text(
        "vn 0 0 1\n" + re.sub(r"(?m)^f (\d+) (\d+) (\d+)", r"f \1//1 \2//1 \3//1", plain.read_text())
    )
    (tmp_path / "plain.obj").write_bytes(plain.read_bytes())
    box = 'box size="0.2 0.1 0.4"'
    rich, same = (
        RobotModel(odd_robot(tmp_path, edited(box, f'mesh filename="{file}"')), tmp_path).meshes["base"]
        for file in ("rich.obj", "plain.obj")
    )
    np.testing.assert_array_equal(rich.vertices[rich.faces], same.vertices[same.faces])


def test_a_joint_named_twice_is_reported(tmp_path):
    with pytest.raises(cells.CellError, match="every joint once, got spin several times"):
        RobotModel(odd_robot(tmp_path).model_copy(update={"joints": (*ODD_JOINTS, "spin")}), tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("panda_joint7]", "elbow]", r"robots.panda.joints: no moving joint elbow in .*panda.urdf: it has panda_joint1"),
        ("panda/panda.urdf", "none.urdf", r"robots.panda.urdf: no file .*none.urdf: give a URDF beside the cell file"),
        ("panda/panda_hand", "panda/thumb", r"pads.p0.link: robot panda has no link 'thumb': it has panda_link0"),
        ("  table: [0.9", "  payloads: {panda: {mass: 1, link: tip}}\n  table: [0.9", r"sim.payloads.panda.link: robot panda"),
        ("  table: [0.9", "  payloads: {ur5: {mass: 1, link: tip}}\n  table: [0.9", r"sim.payloads.ur5: expected one of panda"),
    ],
)  # fmt: skip
def test_a_cell_whose_robot_lacks_what_it_names_is_refused_with_the_line(tmp_path, old, new, place):
    text = (cells.BUILT_IN / "arm.yaml").read_text()
    assert old in text
    (tmp_path / "mine.yaml").write_text(text.replace(old, new, 1))
    line = text[: text.index(old)].count("\n") + 1
    with pytest.raises(cells.CellError, match=rf"mine.yaml:{line}: {place}"):
        cells.load(tmp_path / "mine.yaml")


def test_a_robot_costs_little_to_read():
    """Half a second with pybullet; CPU time of a process of its own, which has nothing else to do."""
    code = """import resource
from penumbra.shared.cell import description
from penumbra.shared.body.robot import RobotModel
arm = description.load("arm")
begin = resource.getrusage(resource.RUSAGE_SELF)
RobotModel(arm.robots["panda"], arm.folder).meshes
end = resource.getrusage(resource.RUSAGE_SELF)
import sys
print(end.ru_utime + end.ru_stime - begin.ru_utime - begin.ru_stime)
print([name for name in ("trimesh", "scipy", "pybullet", "lxml") if name in sys.modules])"""
    out = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[3], capture_output=True, text=True, check=True)
    cpu_s, loaded = out.stdout.splitlines()
    assert float(cpu_s) < 0.15 and loaded == "[]"  # 0.01 s on the machine where it was written


def test_a_pad_on_a_link_that_the_robot_has_not_is_reported():
    cell = cells.load("arm")
    pads = {"p0": cell.pads["p0"].model_copy(update={"link": "panda/panda_thumb"})}
    with pytest.raises(cells.CellError, match=r"pads.p0.link: robot panda has no link 'panda_thumb': it has panda_link0"):
        robot_models(cell.model_copy(update={"pads": pads}))


def test_the_pads_of_the_arm_cell_lie_on_the_hull_and_face_outward():
    cell = cells.load("arm")
    model = robot_models(cell)["panda"]
    for name, pad in cell.pads.items():
        mesh = model.meshes[pad.link.split("/")[1]]
        T = rigid.inverse(pad.T_link_pad)
        local = dataclasses.replace(mesh, vertices=rigid.apply(T, mesh.vertices))
        height = local.vertices[np.hypot(*local.vertices[:, :2].T) < 0.03, 2]
        middle = local.vertices.mean(axis=0)
        assert middle[2] < -0.02, name  # the body of the link lies behind the pad
        assert height.size == 0 or height.max() < 0.004, name  # nothing of the link stands out of the pad
