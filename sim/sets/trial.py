"""The scenes of the paper's experiment: a limb in or out of the skin's reach, a camera at a distance, a share of the limb hidden.

`draw(setting, seed, index)` is a short run of a built-in cell, in turn of `table` (pads in a table top, an occluder that slides)
and of `arm` (pads on a moving robot, which hides the limb together with the occluder). Person, motion, light, textures, noise and
the camera's place are drawn anew for every index. A run that leaves its bands is drawn again, before anything is rendered.

One camera serves all distances. Of its twelve megapixels a run reads only the region that can show the limb, and sums the pixels
two by two at short distance.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.body.anatomy import Mesh, target_mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.fields import Vector3
from penumbra.shared.contract.messages import Message
from penumbra.shared.contract.topics import Topic
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.sim.picture.occluder import AWAY
from penumbra.sim.world.world import World, stream

Reach = Literal["inside", "outside"]
Distance = Literal["short", "medium", "long"]
Occlusion = Literal["light", "medium", "heavy"]

GAP_M: dict[Reach, tuple[float, float]] = {"inside": (0.02, 0.15), "outside": (0.25, np.inf)}
"""Distance [m] from the nearest electrode to the limb's skin, in every scored frame."""
DISTANCE_M: dict[Distance, tuple[float, float]] = {"short": (1.5, 3.0), "medium": (3.0, 6.0), "long": (6.0, 10.0)}
"""Distance from the camera to the middle of the motion [m]; nearer than 1.5 m the limb's motion does not fit into the picture."""
HIDDEN: dict[Occlusion, tuple[float, float]] = {"light": (0.0, 0.33), "medium": (0.33, 0.66), "heavy": (0.66, 1.0)}
"""Share of the limb's pixels that something covers."""

SENSOR_PX, FOCAL_PX, RATE_HZ = (4096, 3000), 7246.0, 20.0
"""The camera: width and height [px], focal length [px] (25 mm, pixels of 3.45 um: 31.5 degrees across), frame rate [Hz]."""
BINNING: dict[Distance, int] = {"short": 2, "medium": 1, "long": 1}
"""Binning: number of sensor pixels along each side of a pixel that is read."""
STEP_PX = 8
"""Multiple [px] to which the borders of the region that is read are rounded."""
HOME_SIGMAS = 1.0
"""Distance from home, in standard deviations, up to which the region shows the limb: a search may look for it there."""

LEAD_S, SECONDS = 0.8, 2.6
"""Lead-in before the occluder comes, which is not scored, and length of a whole run [s]."""
HOLD_S = (0.5, 1.0)
"""Bounds of the time [s] that the occluder stays in a place before it slides to the next."""
MARGIN = 0.03
"""Minimum distance of the intended hidden share from the borders of its band: the share drifts while the limb turns."""
LEAD_HIDDEN = 0.33
"""Maximum share that the robot may hide before the occluder comes."""
IN_BAND = 0.75
"""Minimum share of the frames after the lead-in whose hidden share lies in the band."""
SIZE = 0.12
"""Maximum relative deviation of a person's length and girth from the median man's."""
SPEED_M_S = (0.15, 0.40)
"""Bounds of the maximum speed [m/s] of a run's reaches."""
DIRECTION = np.radians([12.0, 8.0])
"""Maximum deviation [rad] of the camera's direction from the built-in one: around the vertical, and up and down."""
PASSAGE = ((0.0, 0.0), (1.3, 0.2), (2.6, 0.5), (3.9, 0.85), (5.2, 1.0), (6.5, 0.0))
"""Times [s] in a `passage` and the share that is hidden from each on."""
PASSAGE_S, PASSAGE_WITHIN = 8.0, 0.10
"""Duration [s] of a passage, and maximum deviation of the hidden share from PASSAGE."""
COARSE_PX = 160
"""Width [px] of the pictures in which hidden shares are counted."""
TRIES = 400
"""Maximum number of runs that are drawn until one keeps to its bands."""


@dataclass(frozen=True)
class Setting:
    """A cell of the paper's result table."""

    reach: Reach
    distance: Distance
    occlusion: Occlusion

    def __str__(self) -> str:
        return f"{self.reach}-{self.distance}-{self.occlusion}"


SETTINGS = tuple(
    Setting(reach, distance, occlusion)
    for reach in GAP_M
    for distance in DISTANCE_M
    for occlusion in HIDDEN
    if (distance, occlusion) != ("long", "heavy")  # the paper has none
)


@dataclass(frozen=True)
class Volume:
    """Region [m] in which the limb's origin moves, and displacement `shift` [m] of the shoulder from the built-in cell's."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)


VOLUMES: dict[tuple[str, Reach], Volume] = {
    ("table", "inside"): Volume((-0.08, -0.06, 0.07), (0.08, 0.06, 0.20)),
    ("table", "outside"): Volume((-0.08, -0.06, 0.37), (0.08, 0.06, 0.55), (0.0, 0.0, 0.25)),
    ("arm", "inside"): Volume((-0.06, -0.22, 0.50), (0.14, -0.06, 0.74)),
    ("arm", "outside"): Volume((-0.06, -0.60, 0.50), (0.14, -0.36, 0.74), (0.0, -0.29, 0.0)),
}
"""Volumes of the motion by built-in cell and reach."""
PASSAGE_VOLUME = Volume((-0.06, -0.20, 0.62), (0.10, -0.10, 0.74))
"""Volume of a passage: above the robot's forearm in the camera's view, where the robot alone hides little."""


@dataclass(frozen=True)
class Trial:
    """A run. cell: the built-in one with this person, motion and camera; occlusion: times [s], each with the occluder's level
    from then on."""

    setting: Setting
    index: int
    cell: cells.Cell
    seed: int
    occlusion: tuple[tuple[float, float], ...]

    @cached_property
    def world(self) -> World:
        """The trial's world, with all commands given."""
        world = World(self.cell, self.seed)
        world.occlude(0.0, 0.0)
        for time_s, level in self.occlusion:
            world.occlude(level, time_s)
        return world

    @property
    def camera(self) -> cells.Camera:
        """The region of the sensor that is read, as a camera of its own."""
        return next(iter(self.cell.cameras.values()))

    @property
    def distance_m(self) -> float:
        """Distance from the camera to the middle of the motion."""
        target = next(iter(self.cell.targets.values()))
        return float(np.linalg.norm(np.subtract(self.camera.position, target.home.position)))

    def record(self, seconds: float = SECONDS) -> Iterator[tuple[Topic, dict[str, str], Message]]:
        """The trial's messages, in the order of their stamps."""
        return stream(self.world, seconds)


def draw(setting: Setting, seed: int, index: int) -> Trial:
    """Trial `index` of the endless set of a setting and a seed. Raises RuntimeError where none of TRIES runs keeps to its
    bands."""
    for attempt in range(TRIES):
        root = np.random.SeedSequence([seed, SETTINGS.index(setting), index, attempt])
        name = ("table", "arm")[index % 2]
        trial = _scene(name, VOLUMES[name, setting.reach], setting, index, root, SECONDS)
        if trial is None:
            continue
        rng = np.random.default_rng(root.spawn(1)[0])
        trial = dataclasses.replace(trial, occlusion=_occlusion(setting, Coarse(trial.world), rng))
        if _keeps_hidden(trial):
            return trial
    raise RuntimeError(f"trial {index} of {setting}: in {TRIES} tries none kept to its bands")


def passage(seed: int) -> Trial:
    """A longer run of `arm` in the skin's range, PASSAGE_S long, through all levels of occlusion (PASSAGE). Raises RuntimeError
    where none of TRIES runs keeps to them."""
    setting = Setting("inside", "short", "heavy")
    ends = [begin for begin, _ in PASSAGE[1:]] + [PASSAGE_S]
    for attempt in range(TRIES):
        root = np.random.SeedSequence([seed, len(SETTINGS), attempt])
        trial = _scene("arm", PASSAGE_VOLUME, setting, 0, root, PASSAGE_S)
        if trial is None:
            continue
        shown, commands = Coarse(trial.world), []
        slide = 1.0 / trial.world.occlusion.SLOPE
        holds = zip(PASSAGE, ends, strict=True)
        for (begin, share), end in sorted(holds, key=lambda hold: hold[0][1]):  # the unhidden phases first: most runs fail there
            level = shown.level((begin + end) / 2.0, share) if share else 0.0
            reached = [shown.hidden(t, level or AWAY) for t in (begin + slide, end)]
            if np.abs(np.array(reached) - share).max() > PASSAGE_WITHIN:
                break
            comes = bool(share) and begin == PASSAGE[1][0]  # from beyond the border of the picture
            commands.append((begin - slide * comes, level))
        else:
            return dataclasses.replace(trial, occlusion=tuple(sorted(commands)))
    raise RuntimeError(f"passage of seed {seed}: in {TRIES} tries none kept to its levels")


def frame_times(begin_s: float = 0.0, seconds: float = SECONDS) -> Array:
    """Exposure times [s] of the frames from `begin_s` on."""
    times = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    return times[times >= begin_s]


class Coarse:
    """Hidden shares of the limb, counted in small pictures of a world's camera."""

    def __init__(self, world: World):
        self.world = world
        self.name = next(iter(world.cell.cameras))
        camera = world.cell.cameras[self.name]
        scale = camera.width / COARSE_PX
        self._k = (camera.fx / scale, camera.fy / scale, (camera.cx + 0.5) / scale - 0.5, (camera.cy + 0.5) / scale - 0.5)
        self._raster = raster.Raster(COARSE_PX, int(camera.height / scale))
        self._T_camera_world = rigid.inverse(camera.T_world_camera)
        self._still: tuple[float, NDArray, NDArray, int] | None = (
            None  # time, depth and ids without the occluder, the limb's pixels
        )

    def hidden(self, time_s: float, level: float) -> float:
        """Hidden share [0, 1] at a time [s] with the occluder at a level."""
        view, world = self._raster, self.world
        state = world.state(time_s)
        if self._still is None or self._still[0] != time_s:
            self._still = (time_s, *self._without(time_s))
        _, view.depth[:], view.ids[:], whole = self._still
        T = world.panel.pose(level, world.cell.cameras[self.name], world.person.meshes[0], state.T_world_target)
        if T is not None:
            self._draw(world.panel.mesh, T, 1)
        return 1.0 - int((view.ids == 0).sum()) / whole if whole else 1.0

    def level(self, time_s: float, share: float) -> float:
        """The occluder's level at which a share is hidden; the lowest one where more is hidden without it."""
        low, high = 0.0, 1.0
        for _ in range(7):
            middle = (low + high) / 2.0
            low, high = (middle, high) if self.hidden(time_s, middle) < share else (low, middle)
        return high

    def _without(self, time_s: float) -> tuple[NDArray, NDArray, int]:
        view, world = self._raster, self.world
        bodies = world.bodies(self.name, world.state(time_s))
        view.clear()
        mesh, T = bodies.pop("target")
        self._draw(mesh, T, 0)
        whole = int((view.ids == 0).sum())
        bodies.pop("occluder", None)
        for mesh, T in bodies.values():
            self._draw(mesh, T, 1)
        return view.depth.copy(), view.ids.copy(), whole

    def _draw(self, mesh: Mesh, T: Array, value: int) -> None:
        self._raster.draw(rigid.apply(self._T_camera_world @ T, mesh.vertices), mesh.faces, *self._k, value)


def _scene(name: str, volume: Volume, setting: Setting, index: int, root: np.random.SeedSequence, seconds: float) -> Trial | None:
    """A trial without commands; None where its limb leaves the picture or the band of its gap."""
    try:
        trial = Trial(
            setting, index, _cell(name, volume, setting, np.random.default_rng(root)), int(root.generate_state(1)[0]), ()
        )
        kept = _keeps_gap(trial, seconds) and _keeps_picture(trial, seconds)
    except cells.CellError:  # the region holds no pose that keeps clear of the robot
        return None
    return trial if kept else None


def _cell(name: str, volume: Volume, setting: Setting, rng: np.random.Generator) -> cells.Cell:
    """A built-in cell with a person of another size, another region of motion, and the experiment's camera."""
    cell = cells.load(name)
    assert cell.sim is not None
    motion = cell.sim.motion.model_copy(update={"low": volume.low, "high": volume.high, "speed": rng.uniform(*SPEED_M_S)})
    sim = cell.sim.model_copy(update={"motion": motion, "shoulder": tuple(np.add(cell.sim.shoulder, volume.shift).tolist())})
    middle = tuple(((np.array(volume.low) + volume.high) / 2.0).tolist())
    target_name, target = next(iter(cell.targets.items()))
    length, girth = np.exp(rng.uniform(-1.0, 1.0, 2) * np.log1p(SIZE))
    target = target.model_copy(
        update={"home": target.home.model_copy(update={"position": middle}), "size": cells.Size(length=length, girth=girth)}
    )
    camera_name, camera = next(iter(cell.cameras.items()))
    assert camera.look_at is not None
    x, y, z = np.subtract(camera.position, camera.look_at)
    azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    azimuth, elevation = np.array([azimuth, elevation]) + rng.uniform(-1.0, 1.0, 2) * DIRECTION
    towards = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    place = tuple((np.array(middle) + rng.uniform(*DISTANCE_M[setting.distance]) * towards).tolist())
    cell = cell.model_copy(update={"sim": sim, "targets": {target_name: target}})
    return cell.model_copy(update={"cameras": {camera_name: _camera(place, middle, BINNING[setting.distance], cell)}})


def _camera(position: Vector3, look_at: Vector3, binning: int, cell: cells.Cell) -> cells.Camera:
    """The binned region of the sensor that shows the limb at all poses that it may take."""
    width, height = (size // binning for size in SENSOR_PX)
    focal, cx, cy = FOCAL_PX / binning, (width - 1) / 2.0, (height - 1) / 2.0
    whole = cells.Camera(
        width=width, height=height, fx=focal, fy=focal, cx=cx, cy=cy, rate_hz=RATE_HZ, position=position, look_at=look_at
    )
    points = rigid.apply(rigid.inverse(whole.T_world_camera), _reached(cell))
    pixels = focal * points[:, :2] / points[:, 2:] + (cx, cy)
    low = np.clip(np.floor(pixels.min(axis=0) / STEP_PX) * STEP_PX, 0, None).astype(int)
    high = np.minimum(np.ceil(pixels.max(axis=0) / STEP_PX) * STEP_PX, [width, height]).astype(int)
    (x0, y0), (w, h) = low, high - low
    return whole.model_copy(update={"width": int(w), "height": int(h), "cx": cx - float(x0), "cy": cy - float(y0)})


def _reached(cell: cells.Cell) -> Array:
    """Points (n, 3) [m] of the limb at the ends of its motion, and at its home moved by HOME_SIGMAS along each axis."""
    assert cell.sim is not None
    target, region = next(iter(cell.targets.values())), cell.sim.motion
    vertices = target_mesh(target, cell).vertices
    low, high = np.array([*region.low, *region.rpy_low]), np.array([*region.high, *region.rpy_high])
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 6)
    poses = [rigid.from_rpy(pose[:3], pose[3:]) for pose in corners]
    room = HOME_SIGMAS * target.home_spread.position
    poses += [
        rigid.perturb(target.home.transform, np.append(sign * room * axis, np.zeros(3))) for axis in np.eye(3) for sign in (-1, 1)
    ]
    return np.concatenate([rigid.apply(T, vertices) for T in poses])


def _keeps_gap(trial: Trial, seconds: float) -> bool:
    low, high = GAP_M[trial.setting.reach]
    world = trial.world
    gaps = [world.gaps(world.state(time_s)).min() for time_s in frame_times(LEAD_S, seconds)]
    return min(gaps) >= low and max(gaps) <= high


def _keeps_picture(trial: Trial, seconds: float) -> bool:
    """Whether the limb lies wholly in the picture."""
    camera, world = trial.camera, trial.world
    T_camera_world = rigid.inverse(camera.T_world_camera)
    for time_s in frame_times(0.0, seconds):
        points = rigid.apply(T_camera_world @ world.state(time_s).T_world_target, world.person.meshes[0].vertices)
        pixels = points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        if pixels.min() < 0.0 or (pixels > (camera.width - 1, camera.height - 1)).any():
            return False
    return True


def _occlusion(setting: Setting, shown: Coarse, rng: np.random.Generator) -> tuple[tuple[float, float], ...]:
    """The occluder's commands for the hidden share of a setting. The occluder begins to cover the limb when the lead-in ends."""
    low, high = HIDDEN[setting.occlusion]
    slide = 1.0 / shown.world.occlusion.SLOPE
    commands: list[tuple[float, float]] = []
    time_s = LEAD_S - slide
    while time_s < SECONDS:
        hold = float(rng.uniform(*HOLD_S)) + (0.0 if commands else slide)
        share = float(rng.uniform(low + MARGIN if low else 0.0, high - MARGIN if high < 1.0 else 1.0))
        middle = min(max(time_s + hold / 2.0, LEAD_S), SECONDS)
        commands.append((time_s, shown.level(middle, share)))
        time_s += hold
    return tuple(commands)


def _keeps_hidden(trial: Trial) -> bool:
    low, high = HIDDEN[trial.setting.occlusion]
    world, shown = trial.world, Coarse(trial.world)

    def hidden(times: Array) -> Array:
        return np.array([shown.hidden(t, world.occlusion.at(world.occlusion_clock.at(t))) for t in times])

    if hidden(frame_times()[: int(LEAD_S / 2.0 * RATE_HZ)]).max() > LEAD_HIDDEN:
        return False
    shares = hidden(frame_times(LEAD_S))
    return bool(np.mean((shares >= low) & (shares <= high)) >= IN_BAND)
