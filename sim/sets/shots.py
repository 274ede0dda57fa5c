"""Single pictures and short films of the target with everything known about them, for tests and benchmarks of vision.

`shot(seed, index, …)` is a function of its arguments: what a camera with a lens of 60 degrees sees of a person, at a given
distance and with a given share of the target hidden. Persons, poses, looks, robots, furniture and occluders are drawn as
`sim.sets.sequences` draws them for training; here, though, the target lies wholly in the picture, the hidden share is as
requested, and nothing but robot, upper arm and occluder covers the target.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.body import anatomy
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.sim.picture import appearance, limb
from penumbra.sim.picture.appearance import Appearance, Look, Texture
from penumbra.sim.picture.occluder import box
from penumbra.sim.picture.renderer import Body, Renderer, Shape
from penumbra.sim.sets import sequences
from penumbra.sim.sets.sequences import Thing
from penumbra.sim.world.motion import LimbMotion
from penumbra.sim.world.person import Person

Domain = Literal["wide", "easy"]
"""wide: all looks that the training draws. easy: bare skin before a plain light wall, a plain strong colour for the occluder."""
Hands = Literal["stiff", "posed"]
"""stiff: the hand of the mesh that is searched for; posed: one with fingers and a bent wrist (`sim.picture.limb`)."""

LENS = math.radians(60.0)
"""Horizontal field of view [rad]."""
PERIOD_S = sequences.PERIOD_S
BORDER_PX = 8
"""Minimum distance [px] of the target from the border of the picture."""
WITHIN = 0.02
"""Maximum deviation of the hidden share from the requested one."""
UPPER_ARM = 0.08
"""Hidden share that counts as none: the upper arm's rounded end covers some of the elbow."""
FOREIGN = 0.003
"""Maximum share of the target that things not labelled as occluders (table, clutter, torso) may cover."""
STEPS = 32
"""Number of positions of an occluder that are tried on its way across the target."""


@dataclass(frozen=True)
class Shot:
    """A picture and its truth.

    image (h, w, 3) uint8 RGB, None where only labels were asked for; labels (h, w) uint8 classes; hidden: share of the target's
    pixels that something covers; T_world_target (4, 4); velocity (6,) of the target, linear [m/s] and angular [rad/s] along the
    world's axes; cell: that of the picture, with its one camera, its robots and the body of the person seen; joints (n,) [rad]
    by robot; stamp_ns: of the exposure.
    """

    image: NDArray[np.uint8] | None
    labels: NDArray[np.uint8]
    hidden: float
    T_world_target: Array
    velocity: Array
    cell: cells.Cell
    joints: dict[str, Array]
    stamp_ns: int

    @property
    def camera(self) -> cells.Camera:
        """The camera that took the picture."""
        return next(iter(self.cell.cameras.values()))

    @functools.cached_property
    def mesh(self) -> Mesh:
        """The mesh that is searched for; with stiff hands it is exactly the target's."""
        return anatomy.target_mesh(next(iter(self.cell.targets.values())), self.cell)

    @property
    def T_camera_target(self) -> Array:
        """The target's pose (4, 4) in the camera's frame."""
        return rigid.inverse(self.camera.T_world_camera) @ self.T_world_target


def shot(
    seed: int,
    index: int,
    width: int = 640,
    height: int = 480,
    distance_m: float = 1.5,
    hidden: float = 0.0,
    domain: Domain = "wide",
    images: bool = True,
    hands: Hands = "stiff",
) -> Shot:
    """Picture `index` of the endless set `seed`. See `clip`."""
    return clip(seed, index, width, height, distance_m, hidden, domain, 1, images, hands=hands)[0]


def clip(
    seed: int,
    index: int,
    width: int = 640,
    height: int = 480,
    distance_m: float = 1.5,
    hidden: float = 0.0,
    domain: Domain = "wide",
    frames: int = 4,
    images: bool = True,
    present: bool = True,
    hands: Hands = "stiff",
) -> list[Shot]:
    """Pictures PERIOD_S apart between which target, robot and occluder move slightly. The last one has the requested hidden share
    within WITHIN (for 0: at most UPPER_ARM). `distance_m`: depth of the target's middle; images: whether to render images, or
    only labels (much faster); present: whether the person is in the pictures."""
    if not 0.0 <= hidden <= 1.0:
        raise ValueError(f"hidden: expected a share from 0 to 1, got {hidden}")
    for attempt in itertools.count():
        rng = np.random.default_rng([seed, index, attempt])
        scene = _Scene(rng, index, (width, height), distance_m, domain, frames, hands=hands)
        if (occluder := scene.occluder(hidden, rng)) is not None:
            things = scene.things if present else scene.things[len(scene.person.meshes) :]
            return list(scene.film([*things, *occluder], rng, images))
    raise AssertionError("endless")


def passing(
    seed: int,
    index: int,
    width: int = 640,
    height: int = 480,
    domain: Domain = "wide",
    seconds: float = 10.0,
    rate_hz: float = 20.0,
) -> Iterator[Shot]:
    """A film of the target as it reaches, about 1.5 m from a fixed camera. About every three seconds a board passes before it and
    hides all of it for 0.2 to 2 s."""
    frames = round(seconds * rate_hz)
    times: Array = np.arange(frames) / rate_hz
    cell = _cell("table")
    assert cell.sim is not None
    for attempt in itertools.count(1 << 20):
        rng = np.random.default_rng([seed, index, attempt])
        limb = LimbMotion(cell.sim.motion, int(rng.integers(2**31)), lambda times, poses: 0.0)
        poses = np.array([limb.at(t)[0] for t in times])
        T_target = np.stack([rigid.from_rpy(pose[:3], pose[3:]) for pose in poses])
        scene = _Scene(rng, 0, (width, height), 1.5, domain, frames, T_target)
        if all(_Counts(scene, frame).clear for frame in range(0, frames, 10)):
            board = _passing_board(scene, times, rng)
            yield from scene.film([*scene.things, board], rng, True, 1.0 / rate_hz)
            return


class _Scene:
    """A person before a camera, with robot and furniture but without an occluder. `things`: the target first."""

    def __init__(
        self,
        rng: np.random.Generator,
        index: int,
        size: tuple[int, int],
        distance_m: float,
        domain: Domain,
        frames: int,
        T_target: Array | None = None,
        hands: Hands = "stiff",
    ):
        cell = _cell(sequences.CELLS[index % len(sequences.CELLS)])
        sim = cell.sim
        assert sim is not None
        self.domain, self.frames = domain, frames
        measures = {name: value * rng.uniform(0.86, 1.14) for name, value in cell.body.model_dump().items()}
        cell = cell.model_copy(update={"body": cells.Body(**measures)})
        shoulder = np.asarray(sim.shoulder) + rng.normal(0.0, 0.06, 3)
        times: Array = np.arange(1.0 - frames, 1.0) * PERIOD_S
        if T_target is None:
            T_target = sequences.path(sim.motion, sequences.Variety(frames=frames), times, rng)
        self.T_target = T_target
        target = next(iter(cell.targets.values()))
        person = Person(cell, sim.model_copy(update={"shoulder": tuple(shoulder)}), target)
        if hands == "posed":
            person.meshes[0] = limb.mesh(cell.body, rng)
        self.person, self.mesh = person, person.meshes[0]
        self._target_labels = np.unique(self.mesh.labels)
        name, camera = next(iter(cell.cameras.items()))
        self.camera = _camera(camera, self.mesh, self.T_target, size, distance_m, rng)
        clothes = appearance.person(rng) if domain == "wide" else _bare(rng)
        labels = (Label.FOREARM, Label.UPPER_ARM, Label.TORSO)
        self.things = [
            Thing(Shape.of(mesh), T, clothes[label])
            for label, mesh, T in zip(labels, person.meshes, person.poses(self.T_target), strict=True)
        ]
        self.joints: dict[str, Array] = {}
        robots: dict[str, cells.Robot] = {}
        if domain == "wide":
            if cell.robots and rng.random() < 0.5:
                robots = cell.robots
                things, self.joints = sequences.robots(cell, times, rng)
                self.things += things
            self.things += sequences.furniture(sim.table or (1.2, 0.8), frames, rng)
        around = tuple(self.T_target[-1, :3, 3])
        self.look = appearance.look(rng, around) if domain == "wide" else _plain(rng, around)
        pads = {pad: each for pad, each in cell.pads.items() if each.link == "world" or robots}
        self.cell = cell.model_copy(update={"cameras": {name: self.camera}, "robots": robots, "pads": pads})

    def occluder(self, wanted: float, rng: np.random.Generator) -> list[Thing] | None:
        """No or one occluder, so that the last frame hides the wanted share; None where the scene does not allow it."""
        counts = _Counts(self, -1)
        bare = counts.hidden()
        if not counts.clear or bare > (UPPER_ARM if wanted == 0.0 else wanted + WITHIN):
            return None
        if wanted <= bare + WITHIN:
            return []
        for tries in range(12):
            mesh, place = _approach(self, rng, tries > 8 or rng.random() < 0.3, 1.0 + 0.1 * tries)
            found = _place_for(wanted, _Way(counts, mesh, place))
            if found is None:
                continue
            paint = Appearance(appearance.occluder(rng)) if self.domain == "wide" else _strong(rng)
            speed = rng.normal(0.0, 0.4) if rng.random() < 0.5 else 0.0  # shares of its way per second
            ways = found + speed * PERIOD_S * (np.arange(self.frames) - (self.frames - 1.0))
            return [Thing(Shape.of(mesh), np.stack([place(x) for x in ways]), paint)]
        return None

    def film(self, things: list[Thing], rng: np.random.Generator, images: bool, period_s: float = PERIOD_S) -> Iterator[Shot]:
        """The pictures of all frames."""
        renderer = Renderer(self.camera)
        T_camera_world = rigid.inverse(self.camera.T_world_camera)
        k = (self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy)
        for t in range(self.frames):
            bodies = [Body(thing.shape, thing.T[t], thing.appearance) for thing in things]
            image: NDArray[np.uint8] | None = None
            if images:
                picture = renderer.render(bodies, self.look, rng)
                image, labels = picture.image, picture.labels
            else:
                view = raster.Raster(self.camera.width, self.camera.height)
                for index, one in enumerate(bodies):
                    vertices = rigid.apply(T_camera_world @ one.T_world_body, one.shape.mesh.vertices)
                    view.draw(vertices, one.shape.mesh.faces, *k, index)
                kinds = np.concatenate([one.shape.mesh.labels for one in bodies])
                labels = np.where(view.triangles >= 0, kinds[view.triangles], np.uint8(Label.BACKGROUND))
            vertices = rigid.apply(T_camera_world @ self.T_target[t], self.mesh.vertices)
            whole = raster.silhouette(vertices, self.mesh.faces, k, (0, 0, self.camera.width, self.camera.height))
            seen = np.isin(labels, self._target_labels) & whole
            hidden = 1.0 - int(seen.sum()) / max(int(whole.sum()), 1)
            near = slice(max(t - 1, 0), t + 2)
            T = self.T_target[near]
            velocity = rigid.pose_error(T[-1], T[0]) / (max(len(T) - 1, 1) * period_s)
            joints = {name: q[t] for name, q in self.joints.items()}
            stamp_ns = 10**18 + round(t * period_s * 1e9)
            yield Shot(image, labels, hidden, self.T_target[t], velocity, self.cell, joints, stamp_ns)


@dataclass(frozen=True)
class _Way:
    """The share of the target that an occluder hides, as a function of its position on its way."""

    counts: _Counts
    mesh: Mesh
    place: Callable[[float], Array]

    def __call__(self, way: float) -> float:
        return self.counts.hidden(self.mesh, self.place(way))


class _Counts:
    """Counts of the target's covered pixels in a frame of a scene, in a window around it. `clear`: whether the target lies in the
    picture, and at most FOREIGN of it is covered by things that are not labelled as occluders."""

    def __init__(self, scene: _Scene, frame: int):
        camera = scene.camera
        self._T_camera_world = rigid.inverse(camera.T_world_camera)
        vertices = rigid.apply(self._T_camera_world @ scene.T_target[frame], scene.mesh.vertices)
        pixels = _project(camera, vertices)
        low, high = np.floor(pixels.min(axis=0)).astype(int) - 2, np.ceil(pixels.max(axis=0)).astype(int) + 3
        self._k = (camera.fx, camera.fy, camera.cx - low[0], camera.cy - low[1])
        width, height = (high - low).tolist()
        whole = raster.silhouette(vertices, scene.mesh.faces, self._k, (0, 0, width, height))
        self._area = max(int(whole.sum()), 1)
        self._view = raster.Raster(width, height)
        for index, thing in enumerate(scene.things):
            self._draw(thing.shape.mesh, thing.T[frame], index)
        self._depth, self._ids = self._view.depth.copy(), self._view.ids.copy()
        labels = np.concatenate([thing.shape.mesh.labels for thing in scene.things])[self._view.triangles[whole]]
        foreign = np.isin(labels, (Label.BACKGROUND, Label.TORSO)).sum() / self._area
        inside = (low > BORDER_PX).all() and (high < np.array([camera.width, camera.height]) - BORDER_PX).all()
        self.clear = bool(inside and foreign <= FOREIGN)

    def _draw(self, mesh: Mesh, T: Array, index: int) -> None:
        vertices = rigid.apply(self._T_camera_world @ T, mesh.vertices)
        self._view.draw(vertices, mesh.faces, *self._k, index)

    def hidden(self, mesh: Mesh | None = None, T: Array | None = None) -> float:
        """Share of the target that is covered. mesh, T: a further occluder at T_world_thing, if any."""
        np.copyto(self._view.depth, self._depth)
        np.copyto(self._view.ids, self._ids)
        if mesh is not None and T is not None:
            self._draw(mesh, T, 254)
        return 1.0 - int((self._view.ids == 0).sum()) / self._area


def _place_for(wanted: float, hidden: Callable[[float], float]) -> float | None:
    """First position in [0, 1] on an occluder's way at which it hides the wanted share; None where there is none."""
    before = 0.0
    for x in np.linspace(0.0, 1.0, STEPS):
        if hidden(float(x)) >= wanted:
            break
        before = float(x)
    else:
        return None
    after = float(x)
    for _ in range(8):
        middle = (before + after) / 2.0
        before, after = (before, middle) if hidden(middle) >= wanted else (middle, after)
    return after if abs(hidden(after) - wanted) <= WITHIN else None


def _approach(scene: _Scene, rng: np.random.Generator, board: bool, scale: float) -> tuple[Mesh, Callable[[float], Array]]:
    """An occluder that enters between camera and target from one side, and its T_world_shape by the position on its way: at 0 it
    touches the target's picture, at 1 its leading edge has reached the far end. `scale`: size relative to the training's."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    ahead = np.array([np.cos(angle), np.sin(angle)])  # against its motion in the picture
    aside = np.array([-ahead[1], ahead[0]])
    T_camera_target = rigid.inverse(scene.camera.T_world_camera) @ scene.T_target[-1]
    corners = rigid.apply(T_camera_target, scene.mesh.vertices)
    picture = corners[:, :2] / corners[:, 2:]
    if board:
        share, mesh = rng.uniform(0.4, 0.7), box((*rng.uniform(0.35, 0.6, 2), 0.003), (0.0, 0.0, 0.0), Label.OCCLUDER)
        R = np.eye(3)
        R[:2, 0], R[:2, 1] = ahead, aside
    else:
        share, mesh = rng.uniform(0.4, 0.9), sequences.shape(rng)
        mesh = dataclasses.replace(mesh, vertices=scale * mesh.vertices)
        R = rigid.from_rpy((0.0, 0.0, 0.0), rng.uniform(-np.pi, np.pi, 3))[:3, :3]
    size = np.linalg.norm(mesh.vertices, axis=1).max()
    depth = min(share * float(corners[:, 2].mean()), float(corners[:, 2].min()) - (0.0 if board else size) - 0.01)
    depth = max(depth, size + 0.1)
    edge = (mesh.vertices @ R.T)[:, :2] @ ahead / depth
    near, far = picture @ ahead, picture @ aside
    across = 0.5 * (far.min() + far.max()) + (0.0 if board else rng.normal(0.0, 0.15) * np.ptp(far))

    def place(way: float) -> Array:
        along = near.max() + way * (near.min() - near.max()) - edge.min()
        T = np.eye(4)
        T[:3, :3] = R
        T[:3, 3] = *(depth * (along * ahead + across * aside)), depth
        return np.asarray(scene.camera.T_world_camera @ T)

    return mesh, place


def _passing_board(scene: _Scene, times: Array, rng: np.random.Generator) -> Thing:
    """A board that enters from one side about every three seconds, hides all of the target for 0.2 to 2 s, and leaves on the
    other."""
    share, ramp, size = 0.55, 0.4, 0.5
    mesh = box((size, size, 0.003), (0.0, 0.0, 0.0), Label.OCCLUDER)
    T_camera_world = rigid.inverse(scene.camera.T_world_camera)
    begin, poses, passes = 1.5, [], []
    for hold in itertools.cycle(rng.permutation([0.2, 0.5, 1.0, 2.0])):
        passes.append((begin, float(hold), rng.uniform(0.0, 2.0 * np.pi)))
        begin += 2.0 * ramp + float(hold) + rng.uniform(1.2, 1.8)
        if begin > times[-1]:
            break
    for t, T_target in zip(times, scene.T_target, strict=True):
        start, hold, angle = next((one for one in reversed(passes) if one[0] <= t), (1e9, 1.0, passes[0][2]))
        ahead = np.array([np.cos(angle), np.sin(angle)])
        aside = np.array([-ahead[1], ahead[0]])
        corners = rigid.apply(T_camera_world @ T_target, scene.mesh.vertices)
        depth = share * float(corners[:, 2].mean())
        picture = corners[:, :2] / corners[:, 2:]
        near, far, half = picture @ ahead, picture @ aside, 0.5 * size / depth
        margin = 0.02 / depth
        low, high = near.min() - margin - half, near.max() + margin + half  # of the board's middle: before and after
        covers = near.min() - margin + half, near.max() + margin - half  # and while it hides everything
        since = t - start
        along = np.interp(since, [0.0, ramp, ramp + hold, 2.0 * ramp + hold], [high, covers[0], covers[1], low])
        if not 0.0 <= since <= 2.0 * ramp + hold:
            along = high + 3.0
        T = np.eye(4)
        T[:2, 0], T[:2, 1] = ahead, aside
        T[:3, 3] = *(depth * (along * ahead + 0.5 * (far.min() + far.max()) * aside)), depth
        poses.append(scene.camera.T_world_camera @ T)
    return Thing(Shape.of(mesh), np.stack(poses), Appearance(appearance.occluder(rng)))


def _camera(
    camera: cells.Camera, mesh: Mesh, T_target: Array, size: tuple[int, int], distance_m: float, rng: np.random.Generator
) -> cells.Camera:
    """A camera at a distance from the target, in the direction of the cell's camera or, in one of six cases, in a random one, and
    turned so that the target lies in the inner part of the picture."""
    middle = rigid.apply(T_target[len(T_target) // 2 if len(T_target) > 8 else -1], mesh.vertices.mean(axis=0))
    away = np.asarray(camera.position) - middle + rng.normal(0.0, 0.12, 3)
    if rng.random() < 1.0 / 6.0:
        azimuth, elevation = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.2, 1.2)
        away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    width, height = size
    focal = width / 2.0 / math.tan(LENS / 2.0)
    off = rng.uniform(-0.2, 0.2, 2) * size / focal  # where the target is in the picture, in normalised coordinates
    sight = away / np.linalg.norm(away)
    T = rigid.look_at(middle + distance_m * sight, middle)
    # The picture's middle is turned away from the target, and the camera moved so that the target keeps its depth.
    R = T[:3, :3] @ rigid.from_rpy((0.0, 0.0, 0.0), (math.atan(off[1]), -math.atan(off[0]), 0.0))[:3, :3]
    ray = R.T @ T[:3, 2]
    position = middle - distance_m * (R @ (ray / ray[2]))
    return cells.Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=(width - 1) / 2.0,
        cy=(height - 1) / 2.0,
        rate_hz=camera.rate_hz,
        position=tuple(position),
        look_at=tuple(position + R[:, 2]),
    )


def _project(camera: cells.Camera, points: Array) -> Array:
    """Pixels (n, 2) of points (n, 3) in the camera's frame."""
    return np.asarray(points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy))


@functools.cache
def _cell(name: str) -> cells.Cell:
    return cells.load(name)


def _bare(rng: np.random.Generator) -> dict[Label, Appearance]:
    """Bare arms of medium skin colour and a dark shirt."""
    bare = dataclasses.replace(appearance.skin(rng), colour=appearance.hsv(rng.uniform(0.03, 0.07), 0.5, rng.uniform(0.35, 0.6)))
    shirt = Texture(appearance.hsv(0.6, 0.4, 0.3), (0.0, 0.0, 0.0), contrast=0.0)
    upper_arm = Appearance(bare, shirt, rng.uniform(0.2, 0.32))
    return {Label.FOREARM: Appearance(bare), Label.UPPER_ARM: upper_arm, Label.TORSO: Appearance(shirt)}


def _strong(rng: np.random.Generator) -> Appearance:
    colour = appearance.hsv(rng.uniform(0.3, 0.75), 0.9, rng.uniform(0.4, 0.9))
    return Appearance(Texture(colour, colour))


def _plain(rng: np.random.Generator, around: tuple[float, float, float]) -> Look:
    """A light wall, even light, a good sensor."""
    wall = appearance.hsv(rng.uniform(), 0.04, rng.uniform(0.85, 1.0))
    return dataclasses.replace(
        appearance.look(rng, around),
        lamp_colour=(0.5, 0.5, 0.5),
        ambient=(0.5, 0.5, 0.5),
        background=Appearance(Texture(wall, wall), casts_shadow=False),
        blur_px=0.5,
        noise=0.008,
        gain=(1.0, 1.0, 1.0),
        jpeg=None,
    )
