"""Reader for a robot's URDF: its tree of links and joints, limits, masses and collision shapes (http://wiki.ros.org/urdf/XML).

It uses the XML parser of the standard library. yourdfpy would import trimesh, 0.4 s of CPU in every process that needs only the
kinematics, and it keeps no line numbers for errors. Of visual shapes only
the presence is read; materials, transmissions and mimics are not.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

JointKind = Literal["fixed", "revolute", "continuous", "prismatic"]
SolidKind = Literal["mesh", "box", "sphere", "cylinder", "capsule"]
MESH_SCALE = "1 1 1"


class UrdfError(ValueError):
    """A URDF that cannot be used. The text names the file, the line, what was expected and what was found."""


@dataclass(frozen=True)
class Solid:
    """A collision shape.

    size: the scale (3,) of a mesh, the edges (3,) [m] of a box, the radius [m] of a sphere, the radius and the length along z [m]
    of a cylinder or a capsule (without its caps). file: of a mesh, else None. T_link_solid: (4, 4). line: of its description in
    the URDF.
    """

    kind: SolidKind
    size: tuple[float, ...]
    file: Path | None
    T_link_solid: Array
    line: int


@dataclass(frozen=True)
class Link:
    """A link. mass [kg]: None where the URDF has no `inertial`; centre (3,): of mass [m], in the link's frame; is_drawn: whether
    it has a visual shape."""

    name: str
    solids: tuple[Solid, ...]
    mass: float | None
    centre: Array
    is_drawn: bool

    def shapes(self) -> list[list[Any]]:
        """Collision shapes as JSON values, for comparisons. They do not depend on the location of the mesh files."""
        return [
            [
                solid.kind,
                solid.size,
                (np.round(solid.T_link_solid, 6) + 0.0).tolist(),  # neither rounding errors nor a negative zero count
                hashlib.sha256(solid.file.read_bytes()).hexdigest() if solid.file else "",
            ]
            for solid in self.solids
        ]


@dataclass(frozen=True)
class Joint:
    """A joint. T_parent_child (4, 4): at zero; axis (3,): unit vector in the child's frame; lower, upper [rad or m], effort [Nm
    or N] and velocity [rad/s or m/s]: limits, infinite where the URDF sets none; damping [Nm s/rad or N s/m]."""

    name: str
    kind: JointKind
    parent: str
    child: str
    T_parent_child: Array
    axis: Array
    lower: float
    upper: float
    effort: float
    velocity: float
    damping: float
    line: int

    @property
    def moves(self) -> bool:
        return self.kind != "fixed"


@dataclass(frozen=True)
class Urdf:
    """A robot. links: the base first, then depth first in the order of the file; joints: joint i carries links[i + 1]."""

    path: Path
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]

    def link(self, name: str) -> Link:
        """The link with this name. Raises KeyError."""
        return {link.name: link for link in self.links}[name]

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of the joints that move."""
        return tuple(joint.name for joint in self.joints if joint.moves)

    def fault(self, joints: tuple[str, ...]) -> str:
        """Describes what is wrong with a choice of joints; empty where all of them move and none is named twice."""
        unknown = [name for name in joints if name not in self.moving]
        if unknown:
            return f"no moving joint {', '.join(unknown)} in {self.path}: it has {', '.join(self.moving) or 'none'}"
        twice = [name for name, count in Counter(joints).items() if count > 1]
        return f"every joint once, got {', '.join(twice)} several times" if twice else ""


def read(path: Path) -> Urdf:
    """Reads the robot from a file. Raises UrdfError."""
    return _Reader(path).robot()


class _Reader:
    """The XML of a file, with the line of each element."""

    def __init__(self, path: Path):
        self.path = path
        self._lines: dict[ElementTree.Element, int] = {}
        builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()

        def start(tag: str, attributes: dict[str, str]) -> None:
            self._lines[builder.start(tag, attributes)] = parser.CurrentLineNumber

        parser.StartElementHandler = start
        parser.EndElementHandler = builder.end
        try:
            parser.Parse(path.read_bytes(), True)
        except OSError as error:
            raise UrdfError(f"{path}: cannot be read: {error.strerror}") from None
        except expat.ExpatError as error:
            raise UrdfError(f"{path}:{error.lineno}: expected XML, got {expat.ErrorString(error.code)}") from None
        self._root = builder.close()

    def robot(self) -> Urdf:
        if self._root.tag != "robot":
            raise self._error(self._root, f"expected a URDF, <robot name=...>, got <{self._root.tag}>")
        links = {link.name: link for link in map(self._link, self._named("link"))}
        joints = {joint.child: joint for joint in map(self._joint, self._named("joint"))}
        if not links:
            is_xacro = any(each.tag.startswith("xacro:") for each in self._root)
            hint = "; convert it with `xacro FILE.xacro > FILE.urdf`" if is_xacro else ""
            raise self._error(self._root, f"expected at least one link, got none{hint}")
        order, pending = [], [self._base(links, joints)]
        while pending:
            order.append(name := pending.pop())
            pending += [joint.child for joint in reversed(joints.values()) if joint.parent == name]
        self._connected(order, joints)
        return Urdf(self.path, tuple(links[name] for name in order), tuple(joints[name] for name in order[1:]))

    def _base(self, links: dict[str, Link], joints: dict[str, Joint]) -> str:
        """The link that is no joint's child."""
        for joint in joints.values():
            for name in (joint.parent, joint.child):
                if name not in links:
                    raise UrdfError(f"{self.path}:{joint.line}: joint {joint.name}: no link {name!r}: it has {', '.join(links)}")
        bases = [name for name in links if name not in joints]
        if not bases:
            raise UrdfError(f"{self.path}:{next(iter(joints.values())).line}: {_cycle(next(iter(joints)), joints)}")
        if len(bases) > 1:
            raise self._error(self._root, f"expected one link that no joint carries, the base, got {', '.join(bases)}: join them")
        return bases[0]

    def _connected(self, order: list[str], joints: dict[str, Joint]) -> None:
        """Raises UrdfError for links that form a cycle and are not connected to the base."""
        if loose := next((joint for joint in joints.values() if joint.child not in order), None):
            raise UrdfError(f"{self.path}:{loose.line}: {_cycle(loose.child, joints)}")

    def _named(self, tag: str) -> list[ElementTree.Element]:
        """Elements of the robot's links or joints. Each has a unique name, and no two joints have the same child link."""
        elements = self._root.findall(tag)
        self._unique(elements, [self._attribute(element, "name") for element in elements], "name")
        if tag == "joint":
            children = [self._attribute(self._child(element, "child"), "link") for element in elements]
            self._unique(elements, children, "child link")
        return elements

    def _unique(self, elements: list[ElementTree.Element], values: list[str], what: str) -> None:
        for i, (element, value) in enumerate(zip(elements, values, strict=True)):
            if value in values[:i]:
                raise self._error(element, f"expected another {what} for each {element.tag}, got {value!r} again")

    def _link(self, element: ElementTree.Element) -> Link:
        inertial = element.find("inertial")
        mass, centre = None, np.zeros(3)
        if inertial is not None:
            (mass,) = self._numbers(self._child(inertial, "mass"), "value", 1)
            centre = self._origin(inertial)[:3, 3]
            if mass < 0.0:
                raise self._error(inertial, f"expected a mass of at least 0 kg, got {mass:g}")
        solids = tuple(self._solid(each) for each in element.findall("collision"))
        return Link(element.attrib["name"], solids, mass, centre, element.find("visual") is not None)

    def _solid(self, collision: ElementTree.Element) -> Solid:
        geometries = list(self._child(collision, "geometry"))
        shape = geometries[0] if len(geometries) == 1 else collision
        file = None
        match shape.tag:
            case "mesh":
                file, size = self._mesh_file(shape), self._numbers(shape, "scale", 3, MESH_SCALE)
            case "box":
                size = self._numbers(shape, "size", 3)
            case "sphere":
                size = self._numbers(shape, "radius", 1)
            case "cylinder" | "capsule":
                size = (*self._numbers(shape, "radius", 1), *self._numbers(shape, "length", 1))
            case _:
                got = ", ".join(each.tag for each in geometries) or "nothing"
                raise self._error(collision, f"expected one of {', '.join(get_args(SolidKind))} as geometry, got {got}")
        if shape.tag != "mesh" and min(size) <= 0.0:
            raise self._error(shape, f"expected a {shape.tag} with sizes above 0 m, got {size}")
        return Solid(shape.tag, size, file, self._origin(collision), self._lines[shape])

    def _mesh_file(self, mesh: ElementTree.Element) -> Path:
        """The file of a mesh: `file://PATH`, a path relative to the URDF, or `package://PACKAGE/PATH`. PACKAGE is the name of a
        folder around the URDF, or is left out."""
        name = self._attribute(mesh, "filename")
        if name.startswith("package://"):
            rest = name.removeprefix("package://")
            inside = rest.partition("/")[2] or rest
            folder = self.path.parent.resolve()
            places = [base / part for base in (folder, *folder.parents) for part in (rest, inside)]
        else:
            places = [self.path.parent / name.removeprefix("file://")]
        for place in places:
            if place.is_file():
                return place
        raise self._error(mesh, f"no file {places[0]} of a mesh: put it there, or correct its filename {name!r}")

    def _joint(self, element: ElementTree.Element) -> Joint:
        kind = self._attribute(element, "type")
        if kind not in get_args(JointKind):
            raise self._error(element, f"expected a joint of type {', '.join(get_args(JointKind))}, got {kind!r}")
        axis = np.array(self._numbers(element.find("axis"), "xyz", 3, "1 0 0"))
        length = float(np.linalg.norm(axis))
        if length == 0.0 and kind != "fixed":
            raise self._error(element, "expected an axis that is not zero, got 0 0 0")
        limit, dynamics = element.find("limit"), element.find("dynamics")
        (lower,), (upper,) = (self._numbers(limit, name, 1, "0") for name in ("lower", "upper"))
        if kind == "continuous" or lower >= upper:  # as in ROS, where a joint without limits may say 0 and 0
            lower, upper = -math.inf, math.inf
        (effort,), (velocity,) = (self._numbers(limit, name, 1, "0") for name in ("effort", "velocity"))
        (damping,) = self._numbers(dynamics, "damping", 1, "0")
        return Joint(
            name=element.attrib["name"],
            kind=cast(JointKind, kind),
            parent=self._attribute(self._child(element, "parent"), "link"),
            child=self._attribute(self._child(element, "child"), "link"),
            T_parent_child=self._origin(element),
            axis=axis / (length or 1.0),
            lower=lower,
            upper=upper,
            effort=effort if effort > 0.0 else math.inf,
            velocity=velocity if velocity > 0.0 else math.inf,
            damping=damping,
            line=self._lines[element],
        )

    def _origin(self, element: ElementTree.Element) -> Array:
        origin = element.find("origin")
        return rigid.from_rpy(self._numbers(origin, "xyz", 3, "0 0 0"), self._numbers(origin, "rpy", 3, "0 0 0"))

    def _child(self, element: ElementTree.Element, tag: str) -> ElementTree.Element:
        child = element.find(tag)
        if child is None:
            raise self._error(element, f"expected a <{tag}> in <{element.tag}>, got none")
        return child

    def _attribute(self, element: ElementTree.Element, name: str) -> str:
        value = element.get(name)
        if not value:
            raise self._error(element, f"expected {name}=... in <{element.tag}>, got none")
        return value

    def _numbers(self, element: ElementTree.Element | None, name: str, count: int, default: str = "") -> tuple[float, ...]:
        """`count` finite numbers of an attribute. The default stands in for a missing element or attribute."""
        text = default if element is None else element.get(name, default)
        try:
            numbers = tuple(float(word) for word in text.split())
        except ValueError:
            numbers = ()
        if len(numbers) != count or not all(map(math.isfinite, numbers)):
            assert element is not None  # the defaults are numbers
            raise self._error(element, f"expected {name}={count} numbers in <{element.tag}>, got {text!r}")
        return numbers

    def _error(self, element: ElementTree.Element, text: str) -> UrdfError:
        return UrdfError(f"{self.path}:{self._lines[element]}: {text}")


def _cycle(link: str, joints: dict[str, Joint]) -> str:
    """Error text with the cycle that a link and its parents form."""
    way = [link]
    while way[-1] not in way[:-1]:
        way.append(joints[way[-1]].parent)
    way = way[way.index(way[-1]) :]
    return f"expected a tree of links, got a cycle: {' -> '.join(reversed(way))}"
