"""Image sequences with class labels for training the segmentation: `render(seed, index)` is a function of its arguments.

Scenes are drawn around those of the built-in cells: their cameras, motions, persons, robots and tables, each varied, with things
that come between and leave, clutter, and all appearances that `sim.picture.renderer` draws. A sequence is seen through a window
that stands still, at scales from those of a far arm or a coarse whole frame to those of a near one.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.body.posture import frame
from penumbra.shared.body.robot import RobotModel, robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.sim.picture import appearance, limb, looks
from penumbra.sim.picture.appearance import Appearance
from penumbra.sim.picture.occluder import Panel, box
from penumbra.sim.picture.renderer import Body, Renderer, Shape
from penumbra.sim.world.person import Person

CELLS = ("table", "arm")
PERIOD_S = 0.05
"""Time [s] between frames, as of a camera at 20 Hz."""
ASTRAY = 0.12
"""Share of sequences whose window lies anywhere in the frame instead of around the target."""
ARM_PX = (8.0, 56.0)
"""Bounds of the forearm's width in the picture [px] in sequences that imitate real cameras (`Variety.real`)."""
ARM_M = 0.085
"""Width of a forearm [m], from which the focal length for ARM_PX is computed."""


@dataclass(frozen=True)
class Variety:
    """The variety of the sequences. frames: per sequence; size [px] of the window; scale: bounds of the focal length relative to
    the cell's camera; finer: a factor of these; speed [m/s] and turn [rad/s]: maximum of the target's; jitter [m]: maximum offset
    of the window's middle from the target's along each axis; away: bounds of the camera's distance relative to the cell's
    camera's, its focal length growing with it; real: share of sequences with the looks, hands, sizes and cameras of
    `sim.picture.looks`, `sim.picture.limb` and ARM_PX."""

    frames: int = 8
    size: int = 192
    scale: tuple[float, float] = (0.4, 1.5)
    finer: float = 1.0
    speed: float = 0.5
    turn: float = 1.2
    jitter: float = 0.06
    away: tuple[float, float] = (1.0, 1.0)
    real: float = 0.0


@dataclass(frozen=True)
class Poses:
    """Poses of the target. T_camera_target (frames, 4, 4); intrinsics (4,) of the window: fx, fy, cx, cy [px]; vertices (n, 3)
    [m] of the target's mesh, that of the person in the pictures."""

    T_camera_target: Array
    intrinsics: Array
    vertices: Array


@dataclass(frozen=True)
class Sequence:
    """A labelled sequence. images (frames, h, w, 3) uint8 RGB; labels (frames, h, w) uint8; hidden (frames,): share of the
    target's pixels in the window that something covers; poses: None where only the labels are known; robots (frames, h, w): the
    robots' silhouettes including covered parts, None where they are not known."""

    images: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    hidden: NDArray[np.float64]
    poses: Poses | None = None
    robots: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Thing:
    """A shape, its poses T_world_shape (frames, 4, 4) and its appearance."""

    shape: Shape
    T: Array
    appearance: Appearance


def render(seed: int, index: int, variety: Variety = Variety()) -> Sequence:
    """Sequence `index` of the endless data set `seed`."""
    rng = np.random.default_rng([seed, index])
    is_real = variety.real > 0.0 and rng.random() < variety.real
    camera, things = scene(rng, variety, is_real)
    around = tuple(things[0].T[0, :3, 3])
    look = looks.look(rng, around) if is_real else appearance.look(rng, around)
    x0, y0 = _window(camera, things[0], variety, rng, anywhere=is_real)
    renderer = Renderer(camera, (x0, y0, variety.size, variety.size))
    k = np.array([camera.fx, camera.fy, camera.cx - x0, camera.cy - y0])
    T_camera_world = rigid.inverse(camera.T_world_camera)
    machines = [thing for thing in things if Label.ROBOT in thing.shape.mesh.labels]
    robots = np.zeros((variety.frames, variety.size, variety.size), np.bool_)
    images, labels, hidden = [], [], []
    for t in range(variety.frames):
        bodies = [Body(thing.shape, thing.T[t], thing.appearance) for thing in things]
        picture = renderer.render(bodies, look, rng)
        images.append(picture.image)
        labels.append(picture.labels)
        hidden.append(renderer.hidden_fraction(picture, bodies, 0))
        for machine in machines:
            mesh = machine.shape.mesh
            raster.draw_silhouette(rigid.apply(T_camera_world @ machine.T[t], mesh.vertices), mesh.faces, *k, robots[t])
    film = np.stack(images)
    if is_real:
        film = looks.filmed(film, rng)
    T_camera_target = np.stack([T_camera_world @ T for T in things[0].T])
    poses = Poses(T_camera_target, k, things[0].shape.mesh.vertices)
    return Sequence(film, np.stack(labels), np.array(hidden), poses, robots)


def _window(camera: cells.Camera, target: Thing, variety: Variety, rng: np.random.Generator, anywhere: bool) -> tuple[int, int]:
    """The window's first column and row: around the target in the middle of the sequence (`anywhere`: around one of its
    points), or, for a share ASTRAY, anywhere in the frame."""
    room = np.array([camera.width, camera.height]) - variety.size
    if rng.random() < ASTRAY:
        x0, y0 = rng.integers(0, room + 1)
        return int(x0), int(y0)
    vertices = target.shape.mesh.vertices
    point = vertices[rng.integers(len(vertices))] if anywhere else (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    middle = rigid.apply(target.T[variety.frames // 2], point)
    x, y, z = rigid.apply(rigid.inverse(camera.T_world_camera), middle + rng.uniform(-1.0, 1.0, 3) * variety.jitter)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    x0, y0 = np.clip(np.round([u, v]).astype(int) - variety.size // 2, 0, room)
    return int(x0), int(y0)


def scene(rng: np.random.Generator, variety: Variety = Variety(), is_real: bool = False) -> tuple[cells.Camera, list[Thing]]:
    """A camera and the things in front of it, the target first; `is_real`: with hands, clothes, sizes and things as real cameras
    may show them."""
    cell = _cell(CELLS[rng.integers(len(CELLS))])
    assert cell.sim is not None
    times: Array = np.arange(variety.frames, dtype=float) * PERIOD_S - variety.frames * PERIOD_S / 2
    measures = {name: value * rng.uniform(0.86, 1.14) for name, value in cell.body.model_dump().items()}
    varied = cell.model_copy(update={"body": cells.Body(**measures)})
    shoulder = np.asarray(cell.sim.shoulder) + rng.normal(0.0, 0.06, 3)
    target = next(iter(cell.targets.values()))
    person = Person(varied, cell.sim.model_copy(update={"shoulder": tuple(shoulder)}), target)
    if is_real:
        person.meshes[0] = limb.mesh(varied.body, rng)
    T_target = path(cell.sim.motion, variety, times, rng)
    clothes = looks.person(rng) if is_real else appearance.person(rng)
    things = [
        Thing(Shape.of(mesh), T, clothes[label])
        for label, mesh, T in zip(
            (Label.FOREARM, Label.UPPER_ARM, Label.TORSO), person.meshes, person.poses(T_target), strict=True
        )
    ]
    middle = T_target[len(times) // 2]
    camera = _camera(next(iter(cell.cameras.values())), middle[:3, 3], variety, rng)
    if is_real:
        camera = _zoomed(camera, middle[:3, 3], variety, rng)
        things += _worn_and_held(varied.body, T_target, rng)
    things += _robot(cell, times, rng)
    table = furniture(cell.sim.table or (1.2, 0.8), len(times), rng)
    if is_real:
        table = [replace(thing, appearance=looks.thing(rng)) if rng.random() < 0.4 else thing for thing in table]
    things += table
    for _ in range(rng.choice([0, 1, 2], p=[0.35, 0.5, 0.15] if is_real else [0.2, 0.65, 0.15])):
        between = _between(camera, person.meshes[0], T_target, times, rng)
        things.append(replace(between, appearance=looks.thing(rng)) if is_real else between)
    return camera, things


def _zoomed(camera: cells.Camera, target: Array, variety: Variety, rng: np.random.Generator) -> cells.Camera:
    """The camera with a focal length that shows a forearm at `target` (3,) [m] with a width within ARM_PX; its frame scales."""
    low, high = np.log(ARM_PX)
    distance = np.linalg.norm(np.asarray(camera.position) - target)
    scale = float(np.exp(rng.uniform(low, high)) * distance / (ARM_M * camera.fx))
    width, height = (max(round(scale * n), variety.size) for n in (camera.width, camera.height))
    lens = {"fx": scale * camera.fx, "fy": scale * camera.fy, "cx": (width - 1) / 2.0, "cy": (height - 1) / 2.0}
    return camera.model_copy(update={"width": width, "height": height, **lens})


def _worn_and_held(body: cells.Body, T_target: Array, rng: np.random.Generator) -> list[Thing]:
    """At times a watch, and at times a thing in the hand, which counts as an occluder."""
    things = []
    if rng.random() < 0.3:
        things.append(Thing(Shape.of(limb.band(body, rng)), T_target, Appearance(looks.cloth(rng), gloss=rng.uniform(0.0, 0.5))))
    if rng.random() < 0.3:
        mesh = shape(rng)
        mesh = replace(mesh, vertices=rng.uniform(0.25, 0.7) * mesh.vertices)
        palm = (body.forearm_length / 2.0 + rng.uniform(0.4, 0.9) * body.hand_length, rng.normal(0.0, 0.02), -0.03)
        T_target_thing = rigid.from_rpy(palm, rng.uniform(-np.pi, np.pi, 3))
        things.append(Thing(Shape.of(mesh), T_target @ T_target_thing, looks.thing(rng)))
    return things


@functools.cache
def _cell(name: str) -> cells.Cell:
    return cells.load(name)


@functools.cache
def _robots(name: str) -> dict[str, tuple[RobotModel, dict[str, Shape]]]:
    return {
        robot: (model, {link: Shape.of(mesh) for link, mesh in model.meshes.items()})
        for robot, model in robot_models(_cell(name)).items()
    }


def path(motion: cells.Motion, variety: Variety, times: Array, rng: np.random.Generator) -> Array:
    """Poses (frames, 4, 4) of the target at a constant twist; in one of seven sequences it stands still."""
    position = rng.uniform(np.subtract(motion.low, 0.06), np.add(motion.high, 0.06))
    rpy = 1.4 * rng.uniform(motion.rpy_low, motion.rpy_high)
    if rng.random() < 0.15:
        rpy += rng.normal(0.0, (1.2, 0.3, 0.5))
    twist = np.concatenate([_direction(rng) * variety.speed, _direction(rng) * variety.turn]) * rng.random() ** 1.5
    if rng.random() < 1.0 / 7.0:
        twist[:] = 0.0
    middle = rigid.from_rpy(position, rpy)
    return np.stack([rigid.perturb(middle, twist * t) for t in times])


def _camera(camera: cells.Camera, target: Array, variety: Variety, rng: np.random.Generator) -> cells.Camera:
    """A camera near the cell's or, in one of six cases, anywhere around the target; its resolution is scaled."""
    position = np.asarray(camera.position) + rng.normal(0.0, 0.1, 3)
    look_at = np.asarray(camera.look_at or target) + rng.normal(0.0, 0.08, 3)
    if rng.random() < 1.0 / 6.0:
        azimuth, elevation = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.1, 1.3)
        away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        position, look_at = target + rng.uniform(1.1, 2.2) * away, target + rng.normal(0.0, 0.1, 3)
    low, high = variety.scale
    choice = rng.random()  # around 1: the crop at native resolution; around 0.5: the whole frame at scale 2
    scale = rng.uniform(0.85, 1.15) if choice < 0.7 else rng.uniform(0.45, 0.6) if choice < 0.9 else rng.uniform(low, high)
    scale = variety.finer * float(np.clip(scale, low, high))
    width, height = (max(round(scale * n), variety.size) for n in (camera.width, camera.height))
    factor = 1.0
    if variety.away != (1.0, 1.0):
        factor = float(np.exp(rng.uniform(*np.log(variety.away))))
        position = target + factor * (position - target)
    return camera.model_copy(
        update={
            "width": width,
            "height": height,
            "fx": camera.fx * scale * factor,
            "fy": camera.fy * scale * factor,
            "cx": (width - 1) / 2.0,
            "cy": (height - 1) / 2.0,
            "position": tuple(position),
            "look_at": tuple(look_at),
            "rpy": None,
        }
    )


def _robot(cell: cells.Cell, times: Array, rng: np.random.Generator) -> list[Thing]:
    """The cell's robots, slightly displaced; the table cell at times borrows those of the arm cell."""
    if not cell.robots:
        if rng.random() < 0.75:
            return []
        cell = _cell("arm")
    return robots(cell, times, rng, astray=0.06)[0]


def robots(cell: cells.Cell, times: Array, rng: np.random.Generator, astray: float = 0.0) -> tuple[list[Thing], dict[str, Array]]:
    """The robots of a built-in cell and their joints (frames, n) [rad], which move within and slightly beyond their bounds.
    `astray` [m]: standard deviation of the robots' displacement."""
    assert cell.sim is not None
    things, joints = [], {}
    offset = np.eye(4)
    offset[:3, 3] = rng.normal(0.0, astray, 3)
    paint = Appearance(appearance.metal(rng), gloss=rng.uniform(0.0, 0.4))
    plates = Appearance(appearance.metal(rng) if rng.random() < 0.5 else appearance.cloth(rng))
    for name, (model, shapes) in _robots(cell.name).items():
        low, high = np.asarray(cell.sim.joints_low), np.asarray(cell.sim.joints_high)
        q = rng.uniform(low - 0.3, high + 0.3) + times[:, None] * rng.normal(0.0, 0.3, len(low))
        links = model.link_transforms(q)
        things += [Thing(shape, offset @ links[link], paint) for link, shape in shapes.items()]
        plate = Shape.of(box((0.09, 0.09, 0.003), (0.0, 0.0, -0.0015), Label.ROBOT))
        for pad in cell.pads.values():
            things.append(Thing(plate, offset @ links[pad.link.partition("/")[2]] @ pad.T_link_pad, plates))
        joints[name] = q
    return things, joints


def furniture(table: tuple[float, float], frames: int, rng: np.random.Generator) -> list[Thing]:
    """A table, plates in it and clutter on it, all labelled as background."""
    things = []
    if rng.random() < 0.9:
        size = np.array(table) * rng.uniform(0.8, 1.4, 2)
        top = Appearance(appearance.tabletop(rng), casts_shadow=False)
        things.append(_standing(box((*size, 0.03), (0.0, 0.0, -0.017), Label.BACKGROUND), np.eye(4), frames, top))
        if rng.random() < 0.6:
            rows, columns, pitch = rng.integers(1, 4), rng.integers(2, 6), rng.uniform(0.06, 0.1)
            side = pitch * rng.uniform(0.7, 1.1)
            plate = Appearance(appearance.metal(rng) if rng.random() < 0.5 else appearance.cloth(rng), casts_shadow=False)
            for i in range(rows):
                for k in range(columns):
                    at = ((k - (columns - 1) / 2) * pitch, (i - (rows - 1) / 2) * pitch, -0.0015)
                    things.append(_standing(box((side, side, 0.003), at, Label.BACKGROUND), np.eye(4), frames, plate))
    for _ in range(rng.integers(1, 6) if rng.random() < 0.35 else 0):
        size = rng.uniform(0.03, 0.25, 3)
        T = rigid.from_rpy([*rng.uniform(-0.6, 0.6, 2), size[2] / 2], [0.0, 0.0, rng.uniform(0.0, np.pi)])
        colours = Appearance(appearance.occluder(rng))
        things.append(_standing(box(size, (0.0, 0.0, 0.0), Label.BACKGROUND), T, frames, colours))
    return things


def _standing(mesh: Mesh, T: Array, frames: int, looks: Appearance) -> Thing:
    return Thing(Shape.of(mesh), np.broadcast_to(T, (frames, 4, 4)), looks)


def _between(camera: cells.Camera, target: Mesh, T_target: Array, times: Array, rng: np.random.Generator) -> Thing:
    """An occluder between camera and target, moving or at rest: the emulator's panel, or a thing of another shape on the line of
    sight."""
    frames = len(times)
    looks = Appearance(appearance.occluder(rng))
    if rng.random() < 0.6:
        panel = Panel(int(rng.integers(2**31)))
        level = rng.uniform(-0.5, 1.0) + times * rng.choice([0.0, rng.normal(0.0, 2.5)])
        poses = [panel.pose(float(np.clip(a, -0.99, 1.0)), camera, target, T) for a, T in zip(level, T_target, strict=True)]
        return Thing(Shape.of(panel.mesh), np.stack([T for T in poses if T is not None]), looks)
    mesh = shape(rng)
    hidden = rigid.apply(T_target[frames // 2], target.vertices[rng.integers(len(target.vertices))])
    eye = np.asarray(camera.position)
    share = rng.uniform(0.35, 0.92)
    middle = eye + share * (hidden - eye) + rng.normal(0.0, 0.05, 3)
    rotation = rigid.from_rpy(middle, rng.uniform(-np.pi, np.pi, 3))
    velocity = _direction(rng) * rng.uniform(0.0, 0.6) * share if rng.random() < 0.7 else np.zeros(3)
    return Thing(Shape.of(mesh), frame(rotation[:3, :3], middle + times[:, None] * velocity), looks)


def shape(rng: np.random.Generator) -> Mesh:
    """An occluder: a box, a board, a tube or a stone."""
    kind = rng.integers(4)
    if kind == 0:
        return box(rng.uniform(0.04, 0.3, 3), (0.0, 0.0, 0.0), Label.OCCLUDER)
    if kind == 1:
        return box((*rng.uniform(0.1, 0.45, 2), 0.005), (0.0, 0.0, 0.0), Label.OCCLUDER)
    if kind == 2:
        solid = trimesh.creation.cylinder(radius=rng.uniform(0.01, 0.09), height=rng.uniform(0.15, 0.8), sections=20)
    else:  # a stone
        solid = trimesh.convex.convex_hull(rng.normal(size=(14, 3)) * rng.uniform(0.03, 0.12, 3))
    return Mesh(np.asarray(solid.vertices), solid.faces.astype(np.int32), np.full(len(solid.faces), Label.OCCLUDER, np.uint8))


def _direction(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)
