"""One description of the cell: cameras, robots, pads, targets and frames, read from one YAML file.

A user with another robot, mesh, camera or skin edits only that file. It is validated on load; a fault is told with its line.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from shared.body import urdf
from shared.contract.labels import Label
from shared.geometry import rigid

BUILT_IN = Path(__file__).parent / "built_in"
MAX_BYTES = 1_000_000
MAX_NODES = 200_000
"""A file has at most so many bytes and values: a thousand calibrated pads."""
FAULTS = 20
"""Faults of a file that are told at once."""

Vector3 = Annotated[tuple[float, float, float], Field(description="metres or radians")]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]


class CellError(ValueError):
    """A cell file that cannot be used; the text names the file, the line, what was expected and what came."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, ignored_types=(cached_property,))


class Placement(_Model):
    """A pose in a parent frame: position [m] and roll, pitch, yaw [rad] about the parent's fixed axes."""

    position: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 = (0.0, 0.0, 0.0)

    @cached_property
    def transform(self) -> rigid.Array:
        """T_parent_this, 4 x 4."""
        return rigid.from_rpy(self.position, self.rpy)


class Camera(_Model):
    """A pinhole camera: size and intrinsics in pixels, rate, and where it stands: `position` with `look_at` or `rpy`
    (of the optical frame: x right, y down, z forward)."""

    width: Annotated[int, Field(ge=16, le=8192)]
    height: Annotated[int, Field(ge=16, le=8192)]
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    rate_hz: Positive = 20.0
    position: Vector3
    look_at: Vector3 | None = None
    rpy: Vector3 | None = None

    @model_validator(mode="after")
    def _one_direction(self) -> Camera:
        if (self.look_at is None) == (self.rpy is None):
            raise ValueError("give either look_at or rpy, not both and not neither")
        return self

    @cached_property
    def T_world_camera(self) -> rigid.Array:
        if self.look_at is not None:
            return rigid.look_at(self.position, self.look_at)
        return rigid.from_rpy(self.position, self.rpy or (0.0, 0.0, 0.0))

    @cached_property
    def K(self) -> rigid.Array:
        """The 3 x 3 intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


class Robot(_Model):
    """A robot: its URDF (a path beside the cell file, or the built-in `panda/panda.urdf`), base and moving joints."""

    urdf: str
    base: Placement = Placement()
    joints: tuple[str, ...]


class Nominal(_Model):
    """An electrode's response law as designed, on its pad's gap d [m] to a forearm that lies across: a1 / (1 + a2 d^2) [V]."""

    a1: Positive
    a2: Positive


class Electrode(_Model):
    """One measurement electrode in the pad's frame (x right, y up, z out of the pad), around `centre` [m]: a `disc` of this
    radius [m], or an `arc` between two radii [m], `half_angle` [degrees] to both sides of the direction `towards` [degrees
    from x]. `law`: its response as designed."""

    centre: tuple[float, float] = (0.0, 0.0)
    disc: Positive | None = None
    arc: tuple[Positive, Positive] | None = None
    towards: float = 0.0
    half_angle: Annotated[float, Field(gt=0, le=180)] = 180.0
    law: Nominal

    @model_validator(mode="after")
    def _one_shape(self) -> Electrode:
        if (self.disc is None) == (self.arc is None):
            raise ValueError("give either disc (a radius) or arc (two radii)")
        if self.arc is not None and self.arc[0] >= self.arc[1]:
            raise ValueError(f"arc: the inner radius first, got {self.arc}")
        return self

    @cached_property
    def centroid(self) -> tuple[float, float]:
        """Of its area [m]."""
        if self.arc is None:
            return self.centre
        (inner, outer), half = self.arc, np.radians(self.half_angle)
        radius = 2.0 / 3.0 * (outer**3 - inner**3) / (outer**2 - inner**2) * np.sin(half) / half
        angle = np.radians(self.towards)
        return (float(self.centre[0] + radius * np.cos(angle)), float(self.centre[1] + radius * np.sin(angle)))


class Board(_Model):
    """A printed board with its electrodes on the front: size and the ground pour on its back (x, y) [m], thickness [m],
    relative permittivity."""

    size: tuple[Positive, Positive]
    ground: tuple[Positive, Positive]
    thickness: Positive
    permittivity: Annotated[float, Field(ge=1.0)] = 4.5


class Ring(_Model):
    """The excitation ring: inner and outer radius [m] around `centre` [m]."""

    radii: tuple[Positive, Positive]
    centre: tuple[float, float] = (0.0, 0.0)


class Chain(_Model):
    """From a change of capacitance to an amplitude: excitation [V], its frequency [Hz], the amplifier's feedback resistance
    [ohm], the converter's bits and reference [V]. The amplifier works around half of the reference, so amplitudes end there."""

    excitation_V: Positive
    frequency_hz: Positive
    feedback_ohm: Positive
    adc_bits: Annotated[int, Field(ge=1, le=24)] = 12
    adc_reference: Positive = 3.3

    @cached_property
    def sensitivity(self) -> float:
        """Volts of amplitude per femtofarad."""
        return self.excitation_V * 2.0 * np.pi * self.frequency_hz * self.feedback_ohm * 1e-15


class Rest(_Model):
    """An amplitude as designed, with nothing near: offset a3 [V]; whether it rises (1) or falls (-1) where something comes near;
    variance of its noise [V^2] in a sample of one millisecond."""

    a3: NotNegative
    polarity: Literal[-1, 1] = 1
    noise: NotNegative


class Law(_Model):
    """An electrode's calibrated response, the paper's law (eq. sensor_approx): v = a3 + polarity * a1 / (1 + a2 d^2), d the gap
    to the skin [m]; noise [V^2] is a variance."""

    a1: Positive
    a2: Positive
    a3: NotNegative
    polarity: Literal[-1, 1] = 1
    noise: NotNegative


class PadType(_Model):
    """A design of pads. `board` and `ring` belong to the field model; `range` [m]: how far it feels."""

    board: Board
    ring: Ring
    electrodes: Annotated[dict[Name, Electrode], Field(min_length=1)]
    chain: Chain
    rest: Rest
    range: Positive = 0.15

    def law(self, electrode: str) -> Law:
        """An electrode's law as designed."""
        nominal = self.electrodes[electrode].law
        return Law(a1=nominal.a1, a2=nominal.a2, a3=self.rest.a3, polarity=self.rest.polarity, noise=self.rest.noise)


class SensingBoard(_Model):
    """A sensing board of a pad: the serial port that it is on, and which of its six channels measure which electrode."""

    port: str | None = None
    channels: Annotated[dict[Name, tuple[Annotated[int, Field(ge=0, le=5)], ...]], Field(min_length=1)]


class Pad(_Model):
    """A pad on `link` (`world`, or ROBOT/LINK), its frame's z axis pointing out of the skin. `backed`: whether the link is
    grounded metal behind it that its field model includes. `calibration`: measured laws by electrode. `boards`: what reads it."""

    type: str
    link: str = "world"
    position: Vector3
    rpy: Vector3 = (0.0, 0.0, 0.0)
    backed: bool = False
    calibration: dict[Name, Law] = {}
    boards: tuple[SensingBoard, ...] = ()

    @cached_property
    def T_link_pad(self) -> rigid.Array:
        return rigid.from_rpy(self.position, self.rpy)


class Spread(_Model):
    """Standard deviations of a pose: position [m], rotation [rad]."""

    position: Positive
    rotation: Positive


class Size(_Model):
    """Factors by which a target's mesh is stretched along its x axis and across it."""

    length: Positive = 1.0
    girth: Positive = 1.0


class Target(_Model):
    """What is tracked. `mesh`: `body:forearm` (the parametric forearm with hand) or a mesh file beside the cell file, in
    metres, its x axis along the limb. `size`: how much larger than the mesh the person at hand is, where that was measured; the
    skin's field model follows without being fitted again. Not given: the camera takes the mesh for the person, the skin knows
    only how people differ. `labels`: the mask classes that show it. `home`: where it is expected before anything is
    known, with its spread."""

    mesh: str
    size: Size | None = None
    labels: tuple[Literal["robot", "torso", "upper_arm", "forearm", "hand", "occluder"], ...]
    home: Placement
    home_spread: Spread = Spread(position=0.15, rotation=0.4)

    @cached_property
    def label_values(self) -> tuple[int, ...]:
        return tuple(int(Label[name.upper()]) for name in self.labels)


class Body(_Model):
    """The person's measures [m]; defaults: 50th percentile of men, ANSUR II (Gordon et al. 2014)."""

    forearm_length: Positive = 0.267
    hand_length: Positive = 0.193
    hand_breadth: Positive = 0.088
    forearm_circumference: Positive = 0.308
    wrist_circumference: Positive = 0.176
    upper_arm_length: Positive = 0.336
    upper_arm_circumference: Positive = 0.358
    chest_breadth: Positive = 0.289
    chest_depth: Positive = 0.254
    shoulder_height: Positive = 0.58


class Motion(_Model):
    """The region in which the emulator moves the target: bounds of position [m] and roll, pitch, yaw [rad]."""

    low: Vector3
    high: Vector3
    rpy_low: Vector3
    rpy_high: Vector3
    speed: Positive = 0.25

    @model_validator(mode="after")
    def _ordered(self) -> Motion:
        for low, high, what in ((self.low, self.high, "low/high"), (self.rpy_low, self.rpy_high, "rpy_low/rpy_high")):
            if any(a > b for a, b in zip(low, high, strict=True)):
                raise ValueError(f"{what}: every lower bound must not exceed its upper bound, got {low} and {high}")
        return self


class Payload(_Model):
    """What a robot carries: its mass [kg], as a point at `position` [m] in the frame of `link`."""

    mass: Positive
    link: str
    position: Vector3 = (0.0, 0.0, 0.0)


class Sim(_Model):
    """What only the emulator needs. `shoulder`: where the person's right shoulder would be [m] if the arm were long enough;
    `joints_low`, `joints_high`: the bounds of all robots' joints, one after the other; `payloads`: what robots carry; `table`:
    length and breadth [m] of a table whose top is z = 0, around `table_middle`."""

    motion: Motion
    shoulder: Vector3
    joints_low: tuple[float, ...] = ()
    joints_high: tuple[float, ...] = ()
    payloads: dict[Name, Payload] = {}
    table: tuple[float, float] | None = None
    table_middle: tuple[float, float] = (0.0, 0.0)


class Cell(_Model):
    name: Name
    frame: Name = "world"
    cameras: dict[Name, Camera] = {}
    robots: dict[Name, Robot] = {}
    pad_types: dict[Name, PadType] = {}
    pads: dict[Name, Pad] = {}
    targets: Annotated[dict[Name, Target], Field(min_length=1)]
    body: Body = Body()
    sim: Sim | None = None
    folder: Path = Path(".")

    @model_validator(mode="after")
    def _references(self) -> Cell:
        links = {"world"} | {f"{name}/" for name in self.robots}
        for name, pad in self.pads.items():
            if pad.type not in self.pad_types:
                raise ValueError(f"pads.{name}.type: one of {sorted(self.pad_types)} expected, got {pad.type!r}")
            electrodes = self.pad_types[pad.type].electrodes
            named = {*pad.calibration, *(electrode for board in pad.boards for electrode in board.channels)}
            if unknown := sorted(named - set(electrodes)):
                raise ValueError(f"pads.{name}: electrodes {list(electrodes)} expected, got {', '.join(unknown)}")
            if pad.backed and pad.link == "world":
                raise ValueError(f"pads.{name}.backed: only a pad on a robot's link has the link behind it, this one is on world")
            robot, slash, _ = pad.link.partition("/")
            if robot + slash not in links:
                raise ValueError(
                    f"pads.{name}.link: world or ROBOT/LINK with ROBOT one of {sorted(self.robots)} expected, got {pad.link!r}"
                )
        for name, target in self.targets.items():
            if not target.mesh.startswith("body:") and not is_file(self.folder / target.mesh):
                raise ValueError(
                    f"targets.{name}.mesh: no file {self.folder / target.mesh}: give body:forearm or a mesh beside the cell file"
                )
        self._check_robots()
        return self

    def _check_robots(self) -> None:
        """Raises ValueError for a URDF that cannot be read, and for joints, links of pads and payloads that its robot has not."""
        links: dict[str, tuple[str, ...]] = {}
        for name, robot in self.robots.items():
            try:
                description = urdf.read(urdf_path(robot, self.folder))
            except (CellError, urdf.UrdfError) as error:
                raise ValueError(f"robots.{name}.urdf: {error}") from None
            if fault := description.fault(robot.joints):
                raise ValueError(f"robots.{name}.joints: {fault}")
            links[name] = tuple(link.name for link in description.links)
        places = {f"pads.{name}.link": pad.link.partition("/") for name, pad in self.pads.items() if pad.link != "world"}
        for name, payload in (self.sim.payloads if self.sim else {}).items():
            if name not in self.robots:
                raise ValueError(f"sim.payloads.{name}: expected one of {sorted(self.robots)}, got {name!r}")
            places[f"sim.payloads.{name}.link"] = (name, "/", payload.link)
        for place, (owner, _, link) in places.items():
            if link not in links[owner]:
                raise ValueError(f"{place}: robot {owner} has no link {link!r}: it has {', '.join(links[owner])}")

    def one(self, kind: Literal["cameras", "robots", "pads", "targets"], name: str | None) -> str:
        """The name of a camera, robot, pad or target, checked; None means the first one. Raises CellError."""
        known = getattr(self, kind)
        if name is None and known:
            return str(next(iter(known)))
        if name not in known:
            raise CellError(f"cell {self.name} has no {kind[:-1]} {name!r}: it has {', '.join(known) or 'none'}")
        return str(name)


def source(cell: str | Path) -> Path:
    """The YAML file of a built-in name (`table`, `arm`) or path. Raises CellError where there is none."""
    path = BUILT_IN / f"{cell}.yaml"
    if not is_file(path):
        path = Path(cell)
    if not is_file(path):
        built_in = ", ".join(sorted(p.stem for p in BUILT_IN.glob("*.yaml")))
        raise CellError(f"no cell {str(cell)!r}: give one of {built_in}, or the path of a YAML file")
    return path


def load(cell: str | Path) -> Cell:
    """The cell of a built-in name (`table`, `arm`) or of a YAML file. Raises CellError with file, line and reason."""
    path = source(cell)
    data, tree = _read(path)
    if not isinstance(data, dict):
        raise CellError(f"{path}:1: a map with name, cameras, pads and targets expected, a {type(data).__name__} came")
    try:
        return Cell.model_validate({**data, "folder": path.parent})
    except ValidationError as error:
        faults = error.errors()
        more = [f"{path}: and {len(faults) - FAULTS} faults more"] if len(faults) > FAULTS else []
        raise CellError("\n".join([*(_explain(path, tree, e) for e in faults[:FAULTS]), *more])) from None


def _read(path: Path) -> tuple[Any, yaml.Node | None]:
    """What a YAML file holds, and the nodes that it comes from. Raises CellError where it is none, or more than a cell needs: a
    short file may name lists of lists of lists that fill any memory."""
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise CellError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        if len(text) > MAX_BYTES:
            raise ValueError(f"at most {MAX_BYTES} bytes expected, more came")
        loader = yaml.SafeLoader(text.decode())
        tree = loader.get_single_node()
        _count_nodes(tree, {})
        return None if tree is None else loader.construct_document(tree), tree
    except Exception as error:  # PyYAML has no end of kinds for what a scalar is not
        raise CellError(f"{path}: not YAML: {error!s:.500}") from None


def _count_nodes(node: yaml.Node | None, known: dict[int, int | None]) -> int:
    """Nodes in a tree, those that are referred to counted each time. Raises ValueError for more than MAX_NODES, and where one
    contains itself."""
    if not isinstance(node, yaml.CollectionNode):
        return 1
    if id(node) not in known:
        known[id(node)] = None
        pairs = isinstance(node, yaml.MappingNode)
        inner = [part for pair in node.value for part in pair] if pairs else node.value
        known[id(node)] = 1 + sum(_count_nodes(part, known) for part in inner)
    count = known[id(node)]
    if count is None:
        raise ValueError("a value that contains itself")
    if count > MAX_NODES:
        raise ValueError(f"at most {MAX_NODES} values expected, more came")
    return count


def _explain(path: Path, tree: yaml.Node | None, error: Any) -> str:
    location = [str(part) for part in error["loc"]]
    reason = error["msg"].removeprefix("Value error, ")
    if not location and ": " in reason:  # a fault between parts names its place itself
        location = reason.partition(": ")[0].split(".")
        reason = reason.partition(": ")[2]
    got = error.get("input")
    if isinstance(got, str | int | float | bool) and "got" not in reason:
        reason += f", got {_short(got)}"
    return f"{path}:{_line(tree, location)}: {'.'.join(location):.200}: {reason:.500}"


def _short(value: str | int | float) -> str:
    """A value in an error; Python does not print very long integers at all."""
    if isinstance(value, int) and value.bit_length() > 64:
        return f"an integer of {value.bit_length()} bits"
    return f"{value!r:.100}"


def urdf_path(robot: Robot, folder: Path) -> Path:
    """The URDF of a robot of a cell in a folder. Raises CellError where there is none."""
    for path in (folder / robot.urdf, BUILT_IN / robot.urdf):
        if is_file(path):
            return path
    raise CellError(f"no file {folder / robot.urdf}: give a URDF beside the cell file, or the built-in panda/panda.urdf")


def is_file(path: Path) -> bool:
    """Whether a file is there; none is where the name cannot be one."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _line(node: yaml.Node | None, location: list[str]) -> int:
    """The line of the deepest node on the way to `location`."""
    if node is None:
        return 1
    line = node.start_mark.line + 1
    for part in location:
        if isinstance(node, yaml.MappingNode):
            match = next(((k, v) for k, v in node.value if k.value == part), None)
            if match is None:
                break
            line, node = match[0].start_mark.line + 1, match[1]
        elif isinstance(node, yaml.SequenceNode) and part.isdigit() and int(part) < len(node.value):
            node = node.value[int(part)]
            line = node.start_mark.line + 1
        else:
            break
    return line
