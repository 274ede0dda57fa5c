"""Robots for tests: the built-in Panda, and one with all features that the Panda lacks."""

from pathlib import Path

from penumbra.shared.cell import description as cells

PANDA = cells.Robot(
    urdf="panda/panda.urdf",
    base=cells.Placement(position=(0.5, 0.1, 0.2), rpy=(0.1, 0.2, 3.0)),
    joints=tuple(f"panda_joint{i}" for i in range(1, 8)),
)
# All features that the Panda lacks: tilted inertial frames, a prismatic and a continuous joint, primitives, a held joint.
ODD = """<robot name="odd">
 <link name="base"><inertial><origin xyz="0.1 0.2 0.3" rpy="0.3 0.2 0.1"/><mass value="1"/>
   <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0 0 0.1" rpy="0 0 0.5"/><geometry><box size="0.2 0.1 0.4"/></geometry></collision>
  <collision><origin xyz="0 0 0.5"/><geometry><sphere radius="0.1"/></geometry></collision></link>
 <joint name="turn" type="revolute"><parent link="base"/><child link="one"/><origin xyz="0 0.1 0.4" rpy="0.4 0.1 0.2"/>
  <axis xyz="0.6 0 0.8"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
 <link name="one"><inertial><origin xyz="0.3 0.2 0.3" rpy="0.9 0.2 0.4"/><mass value="1"/>
   <inertia ixx="1" iyy="2" izz="1" ixy="0.1" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0 0.2 0.1" rpy="0.5 0 0.5"/><geometry><cylinder radius="0.1" length="0.4"/></geometry>
  </collision></link>
 <joint name="slide" type="prismatic"><parent link="one"/><child link="two"/><origin xyz="0 0.1 0.4" rpy="0.4 0.1 0.2"/>
  <axis xyz="0 1 0"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
 <link name="two"><inertial><mass value="1"/><inertia ixx="1" iyy="2" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
 <joint name="spin" type="continuous"><parent link="two"/><child link="three"/><origin xyz="0 0.1 0.4" rpy="0.4 0.1 0.2"/>
  <axis xyz="0 0 1"/></joint>
 <link name="three"><inertial><mass value="1"/><inertia ixx="1" iyy="2" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
 <joint name="held" type="revolute"><parent link="three"/><child link="four"/><axis xyz="0 0 1"/>
  <limit lower="0.3" upper="2" effort="1" velocity="1"/></joint>
 <link name="four"><inertial><mass value="1"/><inertia ixx="1" iyy="2" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>"""
ODD_JOINTS = ("spin", "turn", "slide")
"""Joints of ODD, in another order than in the URDF."""


def odd_robot(folder: Path, text: str = ODD) -> cells.Robot:
    """The robot ODD, or a changed one, whose URDF is written into a folder."""
    (folder / "odd.urdf").write_text(text)
    return cells.Robot(urdf="odd.urdf", joints=ODD_JOINTS, base=cells.Placement(position=(1, 2, 3), rpy=(0.1, 0.2, 0.3)))
