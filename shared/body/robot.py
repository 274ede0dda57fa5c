"""Kinematics and hull of a robot from its URDF.

The URDF is read once. Forward kinematics is then a chain of small matrix products, safe to call from any thread.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from penumbra.shared.body import urdf
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array


class RobotModel:
    """A robot of the cell.

    joints: names of the moving joints, in the order of every `q`; lower, upper: their limits (n,), infinite where the URDF sets
    none. links: names of all links, a parent before its children; parents: index of the parent of each link, -1 for the base.
    description: the parsed URDF.

    A moving joint that the cell does not name is fixed at the position nearest to zero that its limits allow.

    Raises CellError where the URDF cannot be read or lacks one of the joints.
    """

    def __init__(self, robot: cells.Robot, folder: Path = Path(".")):
        self.joints = robot.joints
        self.T_world_base = robot.base.transform
        try:
            self.description = urdf.read(cells.urdf_path(robot, folder))
        except (cells.CellError, urdf.UrdfError) as error:
            raise cells.CellError(f"robot: {error}") from None
        if fault := self.description.fault(robot.joints):
            raise cells.CellError(f"robot: {fault}")
        self.links = tuple(link.name for link in self.description.links)
        self.parents = (-1, *(self.links.index(joint.parent) for joint in self.description.joints))
        moving = {joint.name: joint for joint in self.description.joints}
        self.lower = np.array([moving[name].lower for name in self.joints])
        self.upper = np.array([moving[name].upper for name in self.joints])

        # A joint's transform is origin + s sine + c (1 - cos), s = sin q for a revolute joint and q for a prismatic one.
        n = len(self.links)
        self._origin, self._sine, self._cosine = np.zeros((n, 4, 4)), np.zeros((n, 4, 4)), np.zeros((n, 4, 4))
        self._index = np.full(n, -1)
        self._prismatic = np.array([False, *(joint.kind == "prismatic" for joint in self.description.joints)])
        self._origin[0] = self.T_world_base
        for i, joint in enumerate(self.description.joints, start=1):
            generator = _generator(joint)
            if joint.name in self.joints:
                self._index[i] = self.joints.index(joint.name)
                self._origin[i] = joint.T_parent_child
                self._sine[i] = joint.T_parent_child @ generator
                self._cosine[i] = self._sine[i] @ generator  # zero for a prismatic joint
            else:
                q = np.clip(0.0, joint.lower, joint.upper)
                s, c = (q, 0.0) if self._prismatic[i] else (np.sin(q), 1.0 - np.cos(q))
                self._origin[i] = joint.T_parent_child @ (np.eye(4) + s * generator + c * generator @ generator)

    @property
    def T_parent_link(self) -> Array:
        """T_parent_link (n, 4, 4) of all links with the cell's joints at zero; for the base T_world_base."""
        return self._origin

    @functools.cached_property
    def meshes(self) -> dict[str, Mesh]:
        """Collision mesh of each link that has one, in the link's frame. Loaded on first access, because kinematics need no mesh.

        Raises CellError where a mesh file cannot be read.
        """
        return {link.name: _mesh(link.solids, self.description.path) for link in self.description.links if link.solids}

    def link_transforms(self, q: ArrayLike) -> dict[str, Array]:
        """T_world_link (..., 4, 4) of every link, for joint angles [rad] or displacements [m] q (..., n).

        Raises ValueError where q does not have one value per joint.
        """
        q = np.asarray(q, dtype=float)
        if q.shape[-1:] != (len(self.joints),):
            raise ValueError(f"joint angles: expected {len(self.joints)} values ({', '.join(self.joints)}), got shape {q.shape}")
        padded = np.concatenate([q, np.zeros((*q.shape[:-1], 1))], axis=-1)[..., self._index]
        s = np.where(self._prismatic, padded, np.sin(padded))[..., None, None]
        c = np.where(self._prismatic, 0.0, 1.0 - np.cos(padded))[..., None, None]
        T = np.ascontiguousarray(np.moveaxis(self._origin + s * self._sine + c * self._cosine, -3, 0))
        for i, parent in enumerate(self.parents[1:], start=1):  # a parent comes before its children
            T[i] = T[parent] @ T[i]
        return dict(zip(self.links, T, strict=True))


def robot_models(cell: cells.Cell) -> dict[str, RobotModel]:
    """Models of all robots of the cell. Raises CellError, also where a pad sits on a link that its robot does not have."""
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
    """Model of a robot, cached: all parts of a process share the model and its meshes."""
    return RobotModel(robot, folder)


def _generator(joint: urdf.Joint) -> Array:
    """Derivative (4, 4) of the joint's motion at zero: [axis]x for a revolute joint, the axis as translation for a prismatic
    one."""
    out = np.zeros((4, 4))
    if joint.kind == "prismatic":
        out[:3, 3] = joint.axis
    elif joint.moves:
        x, y, z = joint.axis
        out[:3, :3] = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
    return out


def _mesh(solids: tuple[urdf.Solid, ...], path: Path) -> Mesh:
    """All collision shapes of a link as one mesh in the link's frame."""
    parts = [(rigid.apply(solid.T_link_solid, vertices), faces) for solid in solids for vertices, faces in [_solid(solid, path)]]
    counts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + first for (_, faces), first in zip(parts, counts, strict=False)]).astype(np.int32)
    return Mesh(vertices, faces, np.full(len(faces), Label.ROBOT, np.uint8))


def _solid(solid: urdf.Solid, path: Path) -> tuple[Array, Array]:
    """Vertices (n, 3) [m] and faces (m, 3) of a collision shape, in its own frame."""
    if solid.file is not None:
        vertices, faces = _plain_obj(solid.file) or _mesh_file(solid.file, f"{path}:{solid.line}")
        return vertices * solid.size, faces
    return _primitive(solid.kind, solid.size)


def _plain_obj(file: Path) -> tuple[Array, Array] | None:
    """Vertices and faces of an OBJ file that contains only `v x y z` and `f a b c`, such as those of the built-in robot; None for
    any other file. trimesh would read them too, but its import costs 0.4 s of CPU."""
    if file.suffix.lower() != ".obj":
        return None
    lines = [line.split() for line in file.read_text(errors="replace").splitlines() if line.strip() and not line.startswith("#")]
    if any(line[0] not in ("v", "f") or len(line) != 4 for line in lines):
        return None
    try:
        vertices = np.array([line[1:] for line in lines if line[0] == "v"], float)
        faces = np.array([line[1:] for line in lines if line[0] == "f"], int) - 1
    except ValueError:  # a face with texture coordinates or normals
        return None
    return (vertices, faces) if faces.size and faces.min() >= 0 and faces.max() < len(vertices) else None


def _mesh_file(file: Path, place: str) -> tuple[Array, Array]:
    import trimesh

    try:
        mesh = trimesh.load_mesh(file)
    except Exception as error:  # trimesh's readers raise any exception
        raise cells.CellError(f"{place}: expected a mesh that trimesh reads (STL, OBJ, PLY, GLB), got {file}: {error}") from None
    if not len(getattr(mesh, "faces", ())):
        raise cells.CellError(f"{place}: expected a mesh with triangles, got none in {file}")
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _primitive(kind: urdf.SolidKind, size: tuple[float, ...]) -> tuple[Array, Array]:
    from trimesh import creation

    if kind == "box":
        solid = creation.box(extents=size)
    elif kind == "sphere":
        solid = creation.icosphere(subdivisions=2, radius=size[0])
    elif kind == "cylinder":
        solid = creation.cylinder(radius=size[0], height=size[1], sections=24)
    else:
        solid = creation.capsule(radius=size[0], height=size[1], count=[24, 12])
    return np.asarray(solid.vertices), np.asarray(solid.faces)
