"""Kinematics and hull of a robot from its URDF.

pybullet (an own client without graphics) reads the URDF once: the tree of joints and the collision shapes. After that
nothing of it is needed: forward kinematics is a chain of small matrix products, safe to call from any thread.
"""

from __future__ import annotations

import functools
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pybullet
import pybullet_data
from numpy.typing import ArrayLike

from shared.body.anatomy import Mesh
from shared.cell import description as cells
from shared.contract.labels import Label
from shared.geometry import rigid
from shared.geometry.rigid import Array

if TYPE_CHECKING:
    import trimesh

_PYBULLET = threading.Lock()  # connecting and loading share state inside pybullet


class RobotModel:
    """A robot of the cell.

    joints: names of the joints that move, in the order of every `q`; lower, upper: their limits (n,), infinite where the URDF
    sets none. links: names of all links.

    Raises CellError where the URDF cannot be read or does not have a joint.
    """

    def __init__(self, robot: cells.Robot, folder: Path = Path(".")):
        self.joints = robot.joints
        self.T_world_base = robot.base.transform
        path = _urdf_path(robot.urdf, folder)
        with _PYBULLET:
            client = pybullet.connect(pybullet.DIRECT)
            try:
                self._read(path, client)
            finally:
                pybullet.disconnect(client)

    def _read(self, path: Path, client: int) -> None:
        try:
            # without the flag a cylinder comes back as a mesh without a file
            flags = pybullet.URDF_USE_IMPLICIT_CYLINDER
            body = pybullet.loadURDF(str(path), useFixedBase=True, flags=flags, physicsClientId=client)
        except pybullet.error as error:
            raise cells.CellError(
                f"{path}: a URDF expected that pybullet can load, and all its meshes: {error} It says more on stdout."
            ) from None
        infos = [pybullet.getJointInfo(body, i, physicsClientId=client) for i in range(pybullet.getNumJoints(body, client))]
        base = pybullet.getBodyInfo(body, client)[0].decode()
        self.links = (base, *(info[12].decode() for info in infos))
        self._parent = [-1, *(info[16] + 1 for info in infos)]
        moving = {info[1].decode(): i for i, info in enumerate(infos, start=1) if info[2] in _MOVING}
        unknown = [name for name in self.joints if name not in moving]
        if unknown:
            raise cells.CellError(f"{path}: no moving joint {', '.join(unknown)}: it has {', '.join(moving) or 'none'}")
        limits = np.array([_limits(infos[moving[name] - 1]) for name in self.joints]).reshape(-1, 2)
        self.lower, self.upper = limits[:, 0], limits[:, 1]

        # A joint's transform is origin + s sine + c (1 - cos), s = sin q for a revolute joint and q for a prismatic one.
        # Origin and axis are measured by moving the joint: pybullet's own fields refer to inertial frames.
        n = len(self.links)
        still = _relative_transforms(body, client, self._parent)
        self._origin, self._sine, self._cosine = still.copy(), np.zeros((n, 4, 4)), np.zeros((n, 4, 4))
        self._index = np.full(n, -1)
        self._prismatic = np.zeros(n, bool)
        for name, i in moving.items():
            pybullet.resetJointState(body, i - 1, 1.0, physicsClientId=client)
            moved = rigid.inverse(still[i]) @ _relative_transforms(body, client, self._parent)[i]
            pybullet.resetJointState(body, i - 1, 0.0, physicsClientId=client)
            generator = np.zeros((4, 4))
            self._prismatic[i] = infos[i - 1][2] == pybullet.JOINT_PRISMATIC
            if self._prismatic[i]:
                generator[:3, 3] = moved[:3, 3]
            else:  # a turn by 1 rad: the skew part is sin(1) [axis]x
                generator[:3, :3] = (moved[:3, :3] - moved[:3, :3].T) / (2.0 * np.sin(1.0))
            if name in self.joints:
                self._index[i] = self.joints.index(name)
                self._sine[i] = still[i] @ generator
                self._cosine[i] = self._sine[i] @ generator  # zero for a prismatic joint
            else:  # held where it is as near to zero as its limits allow
                q = np.clip(0.0, *_limits(infos[i - 1]))
                s, c = (q, 0.0) if self._prismatic[i] else (np.sin(q), 1.0 - np.cos(q))
                self._origin[i] = still[i] @ (np.eye(4) + s * generator + c * generator @ generator)
        self._origin[0] = self.T_world_base
        self._shapes = {name: shapes for i, name in enumerate(self.links) if (shapes := _collision_shapes(body, i - 1, client))}

    @functools.cached_property
    def meshes(self) -> dict[str, Mesh]:
        """The collision mesh of each link that has one, in the link's frame. Kinematics need none: made when asked for."""
        return {name: _mesh(shapes) for name, shapes in self._shapes.items()}

    def link_transforms(self, q: ArrayLike) -> dict[str, Array]:
        """T_world_link (..., 4, 4) of every link at joint angles [rad] or displacements [m] q (..., n).

        Raises ValueError where q has not one value per joint.
        """
        q = np.asarray(q, dtype=float)
        if q.shape[-1:] != (len(self.joints),):
            raise ValueError(f"joint angles: {len(self.joints)} values ({', '.join(self.joints)}) expected, shape {q.shape} came")
        padded = np.concatenate([q, np.zeros((*q.shape[:-1], 1))], axis=-1)[..., self._index]
        s = np.where(self._prismatic, padded, np.sin(padded))[..., None, None]
        c = np.where(self._prismatic, 0.0, 1.0 - np.cos(padded))[..., None, None]
        T = np.ascontiguousarray(np.moveaxis(self._origin + s * self._sine + c * self._cosine, -3, 0))
        for i, parent in enumerate(self._parent[1:], start=1):  # a parent comes before its children
            T[i] = T[parent] @ T[i]
        return dict(zip(self.links, T, strict=True))


def robot_models(cell: cells.Cell) -> dict[str, RobotModel]:
    """The model of every robot of the cell. Raises CellError, also where a pad sits on a link that its robot has not."""
    models = {name: _model(robot, cell.folder) for name, robot in cell.robots.items()}
    for name, pad in cell.pads.items():
        robot, _, link = pad.link.partition("/")
        if robot in models and link not in models[robot].links:
            raise cells.CellError(
                f"pads.{name}.link: robot {robot} has no link {link!r}: it has {', '.join(models[robot].links)}"
            )
    return models


@functools.lru_cache(maxsize=8)
def _model(robot: cells.Robot, folder: Path) -> RobotModel:
    """Read once: pybullet takes half a second for a Panda, and everything of a process may use the same model."""
    return RobotModel(robot, folder)


_MOVING = (pybullet.JOINT_REVOLUTE, pybullet.JOINT_PRISMATIC)


def _urdf_path(urdf: str, folder: Path) -> Path:
    in_data = urdf.removeprefix("pybullet:")
    path = Path(pybullet_data.getDataPath()) / in_data if in_data != urdf else folder / urdf
    if not path.is_file():
        raise cells.CellError(f"robot: no file {path}: give pybullet:PATH (in pybullet's data) or a URDF beside the cell file")
    return path


def _limits(info: tuple) -> tuple[float, float]:
    """The limits of a joint; a URDF without limits reads as lower >= upper."""
    return (info[8], info[9]) if info[8] < info[9] else (-np.inf, np.inf)


def _relative_transforms(body: int, client: int, parent: list[int]) -> Array:
    """T_parent_link (n, 4, 4) of all links in pybullet's present state; the first, the base, is the identity."""
    T = np.tile(np.eye(4), (len(parent), 1, 1))
    inertial = pybullet.getDynamicsInfo(body, -1, client)[3:5]
    position, orientation = pybullet.getBasePositionAndOrientation(body, client)
    T[0] = rigid.transform(position, orientation) @ rigid.inverse(rigid.transform(*inertial))
    for i in range(1, len(parent)):
        state = pybullet.getLinkState(body, i - 1, computeForwardKinematics=True, physicsClientId=client)
        T[i] = rigid.transform(state[4], state[5])
    relative = np.array([T[i] if parent[i] < 0 else rigid.inverse(T[parent[i]]) @ T[i] for i in range(len(parent))])
    relative[0] = np.eye(4)
    return relative


Solid = tuple[int, tuple[float, float, float], str]
"""A collision shape: pybullet's kind, its dimensions [m] or, of a mesh, its scale, and the mesh's file."""


def _collision_shapes(body: int, link: int, client: int) -> list[tuple[Solid, Array]]:
    """The collision shapes of a link, each with its transform to the link's frame."""
    T_link_inertial = rigid.transform(*pybullet.getDynamicsInfo(body, link, client)[3:5])
    return [
        ((kind, dimensions, file.decode()), T_link_inertial @ rigid.transform(position, orientation))
        for _, _, kind, dimensions, file, position, orientation in pybullet.getCollisionShapeData(body, link, client)
    ]


def _mesh(shapes: list[tuple[Solid, Array]]) -> Mesh:
    """All shapes of a link as one mesh in the link's frame."""
    parts = [_solid(*solid).apply_transform(T) for solid, T in shapes]
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + first for part, first in zip(parts, counts, strict=False)]).astype(np.int32)
    return Mesh(vertices, faces, np.full(len(faces), Label.ROBOT, np.uint8))


def _solid(kind: int, dimensions: tuple[float, float, float], file: str) -> trimesh.Trimesh:
    import trimesh

    if kind == pybullet.GEOM_MESH:
        return trimesh.load_mesh(file).apply_scale(dimensions)
    if kind == pybullet.GEOM_BOX:
        return trimesh.creation.box(extents=dimensions)
    if kind == pybullet.GEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=2, radius=dimensions[0])
    if kind == pybullet.GEOM_CYLINDER:
        return trimesh.creation.cylinder(height=dimensions[0], radius=dimensions[1], sections=24)
    if kind == pybullet.GEOM_CAPSULE:
        return trimesh.creation.capsule(height=dimensions[0], radius=dimensions[1], count=[24, 12])
    raise cells.CellError(f"robot: collision shapes mesh, box, sphere, cylinder or capsule expected, pybullet's kind {kind} came")
