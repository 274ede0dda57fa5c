"""Model of the cell file: cameras, robots, pads, targets and frames, read from one YAML file.

A user with another robot, mesh, camera or skin edits only that file. It is validated when it is loaded; a fault is reported with
its line. `penumbra check` also covers what takes longer: meshes, field models, networks, and what cameras and pads can reach.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import pi
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from penumbra.shared.body import urdf
from penumbra.shared.cell import BUILT_IN as BUILT_IN
from penumbra.shared.cell import document, names
from penumbra.shared.cell.document import Document
from penumbra.shared.cell.explain import explain
from penumbra.shared.cell.faults import CellError as CellError  # every reader of a cell file catches it from here
from penumbra.shared.cell.faults import Fault, meant, refuse
from penumbra.shared.cell.fields import (
    Angles3,
    Measure,
    Metres,
    Model,
    Name,
    Number,
    Positive,
    Vector3,
    Whole,
)
from penumbra.shared.cell.names import is_file
from penumbra.shared.cell.names import source as source
from penumbra.shared.cell.pads import Pad, PadType
from penumbra.shared.cell.sources import CameraSource as CameraSource
from penumbra.shared.cell.sources import JointSource as JointSource
from penumbra.shared.contract.labels import Label
from penumbra.shared.contract.messages import Frame
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.lens import COEFFICIENTS, Lens

FAULTS = 20
"""Maximum number of faults in the text of an error."""
MOST_PIXELS = Frame.MAX_BYTES // 3 - 1000
"""Maximum number of pixels of an RGB picture, with room for the rest of its message."""
SAME = 1e-6
"""Distance [m] below which two points count as equal."""


class Placement(Model):
    """A pose in a parent frame."""

    position: Vector3 = Field(default=(0.0, 0.0, 0.0), description="x, y, z in the parent frame [m]")
    rpy: Angles3 = Field(default=(0.0, 0.0, 0.0), description="roll, pitch, yaw about the parent's fixed axes [rad]")

    @cached_property
    def transform(self) -> rigid.Array:
        """T_parent_this, 4 x 4."""
        return rigid.from_rpy(self.position, self.rpy)


class Spread(Model):
    """Standard deviations of a pose."""

    position: Annotated[Number, Field(gt=0, le=5)] = Field(description="of the position along each axis [m]")
    rotation: Annotated[Number, Field(gt=0, le=pi)] = Field(description="of the rotation about each axis [rad]")


class Camera(Model):
    """A camera. Its optical frame has x to the right, y down and z forward; pixel centres are at integer coordinates. Pictures of
    a lens with distortion are undistorted when they arrive; everything else uses the pinhole picture."""

    width: Annotated[Whole, Field(ge=16, le=8192)] = Field(description="columns of a picture [px]")
    height: Annotated[Whole, Field(ge=16, le=8192)] = Field(description="rows of a picture [px]")
    fx: Positive = Field(description="focal length along the columns [px]")
    fy: Positive = Field(description="focal length along the rows [px]")
    cx: Number = Field(description="column of the principal point [px]")
    cy: Number = Field(description="row of the principal point [px]")
    k1: Number = Field(default=0.0, description="radial distortion, OpenCV's k1")
    k2: Number = Field(default=0.0, description="radial distortion, OpenCV's k2")
    p1: Number = Field(default=0.0, description="tangential distortion, OpenCV's p1")
    p2: Number = Field(default=0.0, description="tangential distortion, OpenCV's p2")
    k3: Number = Field(default=0.0, description="radial distortion, OpenCV's k3")
    rate_hz: Annotated[Number, Field(gt=0, le=1000)] = Field(default=20.0, description="pictures per second [Hz]")
    position: Vector3 = Field(description="where it stands in the world [m]")
    look_at: Vector3 | None = Field(
        default=None, description="the point in the middle of its view [m]; either this or rpy. Looking straight down, +y is up"
    )
    rpy: Angles3 | None = Field(default=None, description="roll, pitch, yaw of its optical frame [rad]; either this or look_at")
    source: CameraSource | None = Field(
        default=None, description="where its pictures come from; without it the emulator or a program of yours publishes them"
    )
    pose_spread: Spread | None = Field(
        default=None, description="how well that is known, where it was measured, written by `penumbra calibrate hand-eye`"
    )

    @model_validator(mode="after")
    def _possible(self) -> Camera:
        faults = self.lens.faults()
        if (count := self.width * self.height) > MOST_PIXELS:
            what = f"expected at most {MOST_PIXELS} pixels, which is what a message may carry, got {count}"
            faults.append(("width", f"{what}; publish smaller pictures, and scale fx, fy, cx and cy as well"))
        if (self.look_at is None) == (self.rpy is None):
            got = "neither" if self.rpy is None else "both"
            faults.append(("rpy" if self.rpy else "", f"expected either look_at or rpy, got {got}; give one of them"))
        elif self.look_at is not None and np.linalg.norm(np.subtract(self.look_at, self.position)) < SAME:
            faults.append(("look_at", "expected a point in front of the camera, got its own position; give a point that it sees"))
        refuse(faults)
        return self

    @cached_property
    def T_world_camera(self) -> rigid.Array:
        if self.look_at is None:
            return rigid.from_rpy(self.position, self.rpy or (0.0, 0.0, 0.0))
        x, y, _ = np.subtract(self.look_at, self.position)
        is_vertical = np.hypot(x, y) < SAME
        return rigid.look_at(self.position, self.look_at, (0.0, 1.0, 0.0) if is_vertical else (0.0, 0.0, 1.0))

    @cached_property
    def K(self) -> rigid.Array:
        """The 3 x 3 intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @cached_property
    def lens(self) -> Lens:
        """Its size, intrinsics and distortion."""
        return Lens(**{name: getattr(self, name) for name in ("width", "height", "fx", "fy", "cx", "cy", *COEFFICIENTS)})


class Robot(Model):
    """A robot."""

    urdf: str = Field(description="its URDF: a path beside the cell file, or the built-in panda/panda.urdf")
    base: Placement = Field(default=Placement(), description="its base in the world")
    joints: Annotated[tuple[str, ...], Field(min_length=1)] = Field(
        description="the joints that move, in the order of the joint messages"
    )
    source: JointSource | None = Field(
        default=None, description="where its joints come from; without it the emulator or a program of yours publishes them"
    )


class Size(Model):
    """Scale factors of a target's mesh."""

    length: Annotated[Number, Field(ge=0.2, le=5)] = Field(default=1.0, description="along its x axis")
    girth: Annotated[Number, Field(ge=0.2, le=5)] = Field(default=1.0, description="across its x axis")


class Target(Model):
    """A target to be tracked."""

    mesh: str = Field(
        description="body:forearm, the parametric forearm with hand, or a mesh file beside the cell file, in metres, its x axis "
        "along the limb"
    )
    size: Size | None = Field(
        default=None,
        description="the person's size relative to the mesh, where it was measured; without it the camera takes the mesh for the "
        "person, and the skin assumes any person",
    )
    labels: Annotated[tuple[Literal["robot", "torso", "upper_arm", "forearm", "hand", "occluder"], ...], Field(min_length=1)] = (
        Field(description="the mask classes that show it, of: robot, torso, upper_arm, forearm, hand, occluder")
    )
    home: Placement = Field(description="where it is expected before anything is known, in the world")
    home_spread: Spread = Field(default=Spread(position=0.15, rotation=0.4), description="how well its home is known")
    tracking_bound: Annotated[Number, Field(ge=0.005, le=0.45)] = Field(
        default=0.15,
        description="what the state `tracking` promises: the position is within so much of the truth, at three standard "
        "deviations [m]; beyond it the state is `coasting`",
    )
    shoulder: Vector3 | None = Field(
        default=None,
        description="where the person's shoulder is in the world, if it stays there, as that of somebody seated [m]: a limb that "
        "nothing measures stays within the arm's reach of it, and the skin expects upper arm and torso there; for the mesh "
        "body:forearm",
    )

    @model_validator(mode="after")
    def _known(self) -> Target:
        faults = []
        if self.mesh.startswith("body:") and self.mesh != "body:forearm":
            what = f"expected body:forearm, or a mesh file beside the cell file, got {self.mesh!r:.60}"
            faults.append(("mesh", f"{what}; body:forearm is the only parametric body"))
        if self.shoulder is not None and self.mesh != "body:forearm":
            what = "expected a shoulder with the mesh body:forearm, whose elbow is known, got one with another mesh; leave it out"
            faults.append(("shoulder", what))
        if twice := sorted({label for label in self.labels if self.labels.count(label) > 1}):
            faults.append(("labels", f"expected each class once, got {', '.join(twice)} several times; remove one"))
        refuse(faults)
        return self

    @cached_property
    def label_values(self) -> tuple[int, ...]:
        return tuple(int(Label[name.upper()]) for name in self.labels)


class Body(Model):
    """The person's measures. Defaults: 50th percentile of men, ANSUR II (Gordon et al. 2014)."""

    forearm_length: Measure = Field(default=0.267, description="elbow to wrist [m]")
    hand_length: Measure = Field(default=0.193, description="wrist to tip of the middle finger [m]")
    hand_breadth: Measure = Field(default=0.088, description="across the knuckles [m]")
    forearm_circumference: Measure = Field(default=0.308, description="largest [m]")
    wrist_circumference: Measure = Field(default=0.176, description="at the wrist [m]")
    upper_arm_length: Measure = Field(default=0.336, description="shoulder to elbow [m]")
    upper_arm_circumference: Measure = Field(default=0.358, description="largest [m]")
    chest_breadth: Measure = Field(default=0.289, description="from side to side [m]")
    chest_depth: Measure = Field(default=0.254, description="from front to back [m]")
    shoulder_height: Measure = Field(default=0.58, description="shoulder above the seat [m]")


class Motion(Model):
    """The region in which the emulator moves the target."""

    low: Vector3 = Field(description="lower bounds of x, y, z [m]")
    high: Vector3 = Field(description="upper bounds of x, y, z [m]")
    rpy_low: Angles3 = Field(description="lower bounds of roll, pitch, yaw [rad]")
    rpy_high: Angles3 = Field(description="upper bounds of roll, pitch, yaw [rad]")
    speed: Annotated[Number, Field(ge=0.01, le=10)] = Field(default=0.25, description="maximum speed of a reach [m/s]")

    @model_validator(mode="after")
    def _ordered(self) -> Motion:
        faults = []
        for name in ("low", "rpy_low"):
            upper = name.replace("low", "high")
            low, high = getattr(self, name), getattr(self, upper)
            if any(a > b for a, b in zip(low, high, strict=True)):
                what = f"expected lower bounds that do not exceed {upper} {list(high)}, got {list(low)}"
                faults.append((name, f"{what}; exchange them"))
        refuse(faults)
        return self


class Payload(Model):
    """The load of a robot: a point mass."""

    mass: Annotated[Number, Field(gt=0, le=1000)] = Field(description="of the load [kg]")
    link: str = Field(description="the link that carries it")
    position: Vector3 = Field(default=(0.0, 0.0, 0.0), description="x, y, z in the frame of the link [m]")


class Sim(Model):
    """Settings of the emulator."""

    motion: Motion = Field(description="where and how fast the target moves")
    shoulder: Vector3 = Field(description="where the person's right shoulder would be if the arm were long enough [m]")
    joints_low: tuple[Number, ...] = Field(
        default=(), description="lower bounds of all robots' joints, one after the other [rad or m]"
    )
    joints_high: tuple[Number, ...] = Field(
        default=(), description="upper bounds of all robots' joints, one after the other [rad or m]"
    )
    payloads: dict[Name, Payload] = Field(default={}, description="what robots carry, by robot")
    table: tuple[Positive, Positive] | None = Field(
        default=None, description="length and breadth of a table whose top is z = 0 [m]"
    )
    table_middle: tuple[Metres, Metres] = Field(default=(0.0, 0.0), description="x, y of the table's middle [m]")


class Cell(Model):
    """A work cell. Unless stated otherwise, units are metres, radians and volts, and coordinates are in the world frame."""

    name: Name = Field(description="of the cell; part of every topic's key")
    frame: Name = Field(default="world", description="name of the world frame in messages")
    cameras: dict[Name, Camera] = Field(default={}, description="by name")
    robots: dict[Name, Robot] = Field(default={}, description="by name")
    pad_types: dict[Name, PadType] = Field(default={}, description="designs of pads, by name")
    pads: dict[Name, Pad] = Field(default={}, description="by name")
    targets: Annotated[dict[Name, Target], Field(min_length=1)] = Field(description="what is tracked, by name")
    body: Body = Field(default=Body(), description="the person's measures")
    sim: Sim | None = Field(default=None, description="what only the emulator needs; a real cell may leave it out")
    folder: Path = Field(default=Path("."), exclude=True)

    @model_validator(mode="after")
    def _references(self) -> Cell:
        faults = [*self._pad_faults(), *self._mesh_faults(), *self._robot_faults()]
        if self.sim is not None:
            what = "expected no source beside `sim`, whose emulator moves the robot; remove one of them"
            faults += [(f"robots.{name}.source", what) for name in self.joint_sources]
        refuse(faults)
        return self

    def _pad_faults(self) -> list[tuple[str, str]]:
        faults: list[tuple[str, str]] = []
        places: dict[tuple[Any, ...], str] = {}
        ports: dict[str, str] = {}
        for name, pad in self.pads.items():
            if pad.type not in self.pad_types:
                what = f"expected one of {', '.join(self.pad_types) or 'pad_types'}, got {pad.type!r:.60}"
                faults.append((f"pads.{name}.type", what + meant(pad.type, self.pad_types)))
                continue
            electrodes = list(self.pad_types[pad.type].electrodes)
            for electrode in sorted(set(pad.calibration) - set(electrodes)):
                what = f"expected one of the electrodes {', '.join(electrodes)}, got {electrode!r}{meant(electrode, electrodes)}"
                faults.append((f"pads.{name}.calibration.{electrode}", what))
            for k, board in enumerate(pad.boards):
                for electrode in sorted(set(board.channels) - set(electrodes)):
                    what = (
                        f"expected one of the electrodes {', '.join(electrodes)}, got {electrode!r}{meant(electrode, electrodes)}"
                    )
                    faults.append((f"pads.{name}.boards.{k}.channels.{electrode}", what))
                if board.port is not None and board.port in ports:
                    what = f"expected a port for each board, got {board.port!r:.60} again ({ports[board.port]} has it)"
                    faults.append((f"pads.{name}.boards.{k}.port", what))
                ports.setdefault(board.port or "", f"pad {name}")
            if pad.backed and pad.link == "world":
                faults.append((f"pads.{name}.backed", "expected a pad on a robot's link, got one on world; leave backed out"))
            place = (pad.link, pad.position)
            if place in places:
                what = f"expected a place of its own, got that of {places[place]}"
                faults.append((f"pads.{name}.position", f"{what}; give another position or remove one of the pads"))
            places.setdefault(place, name)
        return faults

    def _mesh_faults(self) -> list[tuple[str, str]]:
        files = {name: self.folder / target.mesh for name, target in self.targets.items() if not target.mesh.startswith("body:")}
        remedy = "give body:forearm or a mesh file beside the cell file"
        missing = {name: path for name, path in files.items() if not is_file(path)}
        return [(f"targets.{name}.mesh", f"expected a mesh, got no file {path}; {remedy}") for name, path in missing.items()]

    def _robot_faults(self) -> list[tuple[str, str]]:
        """Faults of URDFs that cannot be read, of joints and limits, and of links that pads or payloads name and the robot does
        not have."""
        faults: list[tuple[str, str]] = []
        links: dict[str, tuple[str, ...]] = {}
        limits: list[tuple[str, float, float]] = []
        for name, robot in self.robots.items():
            try:
                description = urdf.read(urdf_path(robot, self.folder))
            except (CellError, urdf.UrdfError) as error:
                faults.append((f"robots.{name}.urdf", str(error)))
                continue
            links[name] = tuple(link.name for link in description.links)
            if fault := description.fault(robot.joints):
                faults.append((f"robots.{name}.joints", fault))
                continue
            moving = {joint.name: joint for joint in description.joints}
            limits += [(joint, moving[joint].lower, moving[joint].upper) for joint in robot.joints]
        if self.sim is not None and not faults:
            faults += _bound_faults(self.sim, limits)
        places = {f"pads.{name}.link": pad.link.partition("/") for name, pad in self.pads.items() if pad.link != "world"}
        for name, payload in (self.sim.payloads if self.sim else {}).items():
            if name not in self.robots:
                faults.append((f"sim.payloads.{name}", f"expected one of {', '.join(self.robots) or 'robots'}, got {name!r}"))
            else:
                places[f"sim.payloads.{name}.link"] = (name, "/", payload.link)
        for place, (owner, slash, link) in places.items():
            if owner not in self.robots or not slash:
                known = ", ".join(self.robots) or "robots, of which this cell has none"
                faults.append(
                    (place, f"expected world, or ROBOT/LINK with ROBOT one of {known}, got {owner + slash + link!r:.60}")
                )
            elif owner in links and link not in links[owner]:
                faults.append(
                    (
                        place,
                        f"robot {owner} has no link {link!r:.60}: it has {', '.join(links[owner])}{meant(link, links[owner])}",
                    )
                )
        return faults

    @property
    def sources(self) -> dict[str, CameraSource]:
        """Sources of pictures by camera, where the file gives one."""
        return {name: camera.source for name, camera in self.cameras.items() if camera.source is not None}

    @property
    def joint_sources(self) -> dict[str, JointSource]:
        """Sources of joint positions by robot, where the file gives one."""
        return {name: robot.source for name, robot in self.robots.items() if robot.source is not None}

    def one(self, kind: Literal["cameras", "robots", "pads", "targets"], name: str | None) -> str:
        """Checked name of a camera, robot, pad or target; None means the first one. Raises CellError."""
        return names.one(self.name, kind[:-1], getattr(self, kind), name)


def _bound_faults(sim: Sim, limits: Sequence[tuple[str, float, float]]) -> list[tuple[str, str]]:
    """Faults of the emulator's joint bounds. limits: name and URDF limits of each joint."""
    wrong = [name for name in ("joints_low", "joints_high") if len(getattr(sim, name)) != len(limits)]
    if wrong:
        names = ", ".join(joint for joint, _, _ in limits) or "no robot moves"
        what = f"expected {len(limits)} values, one for each joint ({names})"
        return [(f"sim.{name}", f"{what}, got {len(getattr(sim, name))}; add or remove values") for name in wrong]
    faults = []
    for k, (joint, lower, upper) in enumerate(limits):
        low, high = sim.joints_low[k], sim.joints_high[k]
        if low > high:
            what = f"expected a lower bound of {joint} that does not exceed the upper one, {high:g}, got {low:g}"
            faults.append((f"sim.joints_low.{k}", f"{what}; exchange them"))
        for side, value in (("low", low), ("high", high)):
            if not lower <= value <= upper:
                what = f"expected a bound of {joint} within its limits in the URDF, {lower:g} to {upper:g}, got {value:g}"
                faults.append((f"sim.joints_{side}.{k}", what))
    return faults


@dataclass(frozen=True)
class Reading:
    """Result of reading a cell file; `cell` is None where the file has faults."""

    document: Document
    cell: Cell | None
    faults: tuple[Fault, ...]


def read(cell: str | Path) -> Reading:
    """Reads a built-in cell (`table`, `arm`) or a YAML file, and collects all faults of that file. Raises CellError where the
    file does not exist or is not YAML."""
    path = source(cell)
    found = document.read(path)
    if not isinstance(found.data, Mapping):
        got = "an empty file" if found.data is None else f"a {type(found.data).__name__}"
        return Reading(found, None, (found.fault([], f"expected a map with name, cameras, pads and targets, got {got}"),))
    faults = list(found.duplicates)
    read_cell = None
    try:
        read_cell = Cell.model_validate({**found.data, "folder": path.parent})
    except ValidationError as error:
        faults += [found.fault(place, reason) for place, reason in explain(Cell, error.errors())]
    if "folder" in found.data:
        faults.append(found.fault("folder", "expected no such key, got folder; remove it"))
    return Reading(found, None if faults else read_cell, tuple(sorted(faults, key=lambda fault: fault.line)))


def load(cell: str | Path) -> Cell:
    """Loads a built-in cell (`table`, `arm`) or a YAML file. Raises CellError with file, line and reason."""
    reading = read(cell)
    if reading.cell is None:
        more = len(reading.faults) - FAULTS
        texts = [*map(str, reading.faults[:FAULTS]), *([f"{reading.document.path}: and {more} faults more"] if more > 0 else [])]
        raise CellError("\n".join(texts))
    return reading.cell


def urdf_path(robot: Robot, folder: Path) -> Path:
    """URDF of a robot; folder: that of the cell file. Raises CellError where there is none."""
    for path in (folder / robot.urdf, BUILT_IN / robot.urdf):
        if is_file(path):
            return path
    raise CellError(f"no file {folder / robot.urdf}: give a URDF beside the cell file, or the built-in panda/panda.urdf")
