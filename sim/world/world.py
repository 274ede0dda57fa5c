"""The simulated cell: where everything is at a time, what the cameras see and what the skin feels.

`World(cell, seed).state(t)` is a function of time, seed and the commands given (occlude, motion, pause, speed). Each target is a
person's (`sim.world.actor`), who moves by reaches that never touch robot, pads or table. Persons do not avoid one another: their
homes should be as far apart as people work. Robots are bodies that follow a script (`sim.world.dynamics`): their motion is
integrated up to the latest time that was asked for, and the last minutes of it are kept.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.messages import Frame, Joints, Message, Truth, Voltages
from penumbra.shared.contract.topics import FRAME, JOINTS, TRUTH, VOLTAGES, Topic
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.lookout import Lookout
from penumbra.shared.skin.layout import link_names
from penumbra.sim.picture.occluder import OcclusionSchedule, Panel
from penumbra.sim.picture.scene import Cameras, View, furniture
from penumbra.sim.skin.faults import SkinFaults
from penumbra.sim.skin.pads import SkinModel
from penumbra.sim.world.actor import Actor, Placed
from penumbra.sim.world.motion import Clock, JointMotion, joint_motions
from penumbra.sim.world.person import Person

if TYPE_CHECKING:
    from penumbra.sim.world.dynamics import Robots

FAR = 10.0
"""Gap [m] in the truth of a cell without pads."""
FAINTEST = 1e-9
"""Minimum change of capacitance [fF], so that the logarithm is finite for a pad with nothing near."""
MAX_SPEED = 4.0
"""Maximum speed of the scene [scene seconds per second]: the cameras and the planner could not follow a faster one."""


@dataclass(frozen=True)
class WorldState:
    """State of the world. time_s: real time; targets by name; joints by robot (n,); links: T_world_link by robot and link."""

    time_s: float
    targets: dict[str, Placed]
    joints: dict[str, Array]
    links: dict[str, dict[str, Array]]

    @property
    def T_world_target(self) -> Array:
        """Pose (4, 4) of the cell's first target; `pose` and `velocity` are those of the same target."""
        return self._first.T_world_target

    @property
    def pose(self) -> Array:
        return self._first.pose

    @property
    def velocity(self) -> Array:
        return self._first.velocity

    @property
    def _first(self) -> Placed:
        return next(iter(self.targets.values()))


class World:
    """The cell in motion. Times are real seconds from the start, >= 0; commands act from `time_s` on.

    Raises CellError where the cell lacks what the emulator needs, or its motion region holds no allowed pose.
    """

    def __init__(self, cell: cells.Cell, seed: int = 0):
        if cell.sim is None:
            raise cells.CellError(f"cell {cell.name} has no `sim`: the emulator needs its motion, shoulder and joint bounds")
        self.cell, self.sim, self.seed = cell, cell.sim, seed
        self.robots = robot_models(cell)
        scripts = joint_motions(cell, cell.sim, seed)
        self.actors = {name: Actor(cell, cell.sim, name, seed + i, self.robots, scripts) for i, name in enumerate(cell.targets)}
        self.skin = SkinModel(cell, next(iter(cell.targets))) if cell.pads else None
        self.skin_faults = SkinFaults(self.skin.skin) if self.skin else None
        self.furniture = furniture(cell, cell.sim)
        self._cameras = Cameras(cell, seed)
        self._shown = {camera: Lookout(cell, camera).targets for camera in cell.cameras}
        self.clock, self.occlusion_clock = Clock(), Clock()
        self.occlusion = OcclusionSchedule(seed)
        self.panel = Panel(seed)
        self._bodies = _bodies(self, scripts) if self.robots else None
        self._motion, self._paused, self._speed = True, False, 1.0

    @property
    def person(self) -> Person:
        """The person to whom the cell's first target belongs."""
        return next(iter(self.actors.values())).person

    def model(self, camera: str) -> str:
        """Name of the target that a camera's occluder hides and whose hidden share is measured: the first that it sees."""
        return next(iter(self._shown[camera] or self.actors))

    def state(self, time_s: float) -> WorldState:
        """Where everything is at a time."""
        scene_s = self.clock.at(time_s)
        joints = self._bodies.at(time_s) if self._bodies else {}
        return WorldState(
            time_s=time_s,
            targets={name: actor.at(scene_s, self.clock.rate(time_s)) for name, actor in self.actors.items()},
            joints=joints,
            links={name: self.robots[name].link_transforms(q) for name, q in joints.items()},
        )

    def plan(self, until_s: float) -> None:
        """Plan the limbs' motion up to a time at the present speed, so that `state` answers at once."""
        for actor in self.actors.values():
            actor.plan(self.clock.at(until_s))

    def electrodes(self, state: WorldState) -> Array:
        """Electrode centroids (n, 3) [m] in the world, in the order of `shared.skin.layout.Skin`."""
        assert self.skin is not None
        return self.skin.skin.positions(self.skin.skin.T_world_pads(link_names(state.links)))

    def gaps(self, state: WorldState, target: str | None = None) -> Array:
        """Distances [m] from the electrodes that a target may come near to the target's skin (default: the first target)."""
        target = self.cell.one("targets", target)
        actor = self.actors[target]
        if self.skin is None or not len(actor.near.electrodes):
            return np.empty(0)
        return actor.gaps(state.targets[target], self.electrodes(state)[actor.near.electrodes])

    def change(self, state: WorldState) -> Array:
        """Changes of capacitance (n,) [fF] that the targets and the robots cause."""
        assert self.skin is not None
        joints = np.concatenate([*state.joints.values(), np.zeros(0)])
        T_world_pads = self.skin.skin.T_world_pads(link_names(state.links))
        change = np.array(self.skin.rest(joints))
        for name, actor in self.actors.items():
            change[actor.near.electrodes] += actor.change(state.targets[name], T_world_pads)
        return np.maximum(change, FAINTEST)

    def view(self, camera: str, time_s: float) -> View:
        """What a camera sees at a time."""
        return self._cameras.view(camera, self.bodies(camera, self.state(time_s)), time_s)

    def bodies(self, camera: str, state: WorldState) -> dict[str, tuple[Mesh, Array]]:
        """Everything that a camera may see by name, with its T_world_mesh: target, upper_arm, torso (of other persons followed by
        the target's name), ROBOT/LINK, pads, table and occluder."""
        links = {"world": np.eye(4), **link_names(state.links)}
        model = self.model(camera)
        out: dict[str, tuple[Mesh, Array]] = {}
        for name in dict.fromkeys((model, *self._shown[camera])):
            person, T = self.actors[name].person, state.targets[name].T_world_target
            parts = zip(("target", "upper_arm", "torso"), person.meshes, person.poses(T), strict=False)
            out |= {part if name == model else f"{part} {name}": (mesh, T) for part, mesh, T in parts}
        out |= {
            f"{robot}/{link}": (mesh, state.links[robot][link])
            for robot, model in self.robots.items()
            for link, mesh in model.meshes.items()
        }
        out |= {name: (mesh, links[link]) for name, (mesh, link) in self.furniture.items()}
        T_world_panel = self.occluder(camera, state)
        return out if T_world_panel is None else {**out, "occluder": (self.panel.mesh, T_world_panel)}

    def occluder(self, camera: str, state: WorldState) -> Array | None:
        """T_world_panel (4, 4) of a camera's occluder, None while it is away."""
        level = self.occlusion.at(self.occlusion_clock.at(state.time_s))
        model = self.model(camera)
        mesh, T_world_target = self.actors[model].person.meshes[0], state.targets[model].T_world_target
        return self.panel.pose(level, self.cell.cameras[camera], mesh, T_world_target)

    # Commands

    def occlude(self, level: float | None, time_s: float) -> None:
        """Hide a share [0, 1] of the target's pixels from each camera (above 0.95: all), or follow the schedule (None)."""
        if level is not None and not 0.0 <= level <= 1.0:
            raise ValueError(f"occlude: expected a share from 0 to 1 or auto, got {level}")
        self.occlusion.command(self.occlusion_clock.at(time_s), level)

    def set_motion(self, on: bool, time_s: float) -> None:
        """Let target and robot move, or hold them still."""
        self._motion = on
        self._set_rates(time_s)

    def set_paused(self, paused: bool, time_s: float) -> None:
        """Hold everything, the occluder too, or go on."""
        self._paused = paused
        self._set_rates(time_s)

    def set_speed(self, speed: float, time_s: float) -> None:
        """Scene seconds per second of target and robot."""
        if not 0.0 < speed <= MAX_SPEED:
            raise ValueError(f"speed: expected a factor above 0 and at most {MAX_SPEED:g}, got {speed:g}")
        self._speed = speed
        self._set_rates(time_s)

    def break_skin(self, words: str, time_s: float) -> None:
        """Put a fault into a pad or an electrode, or take it out: see `sim.skin.faults`."""
        if self.skin_faults is None:
            raise ValueError(f"skin: cell {self.cell.name} has no pads")
        self.skin_faults.command(words, time_s)

    def describe(self, time_s: float) -> dict[str, Any]:
        """The commands in force, for people and programs."""
        occlusion = self.occlusion.commanded
        return {
            "occlusion": "auto" if occlusion is None else occlusion,
            "occlusion_now": max(0.0, self.occlusion.at(self.occlusion_clock.at(time_s))),
            "motion": "on" if self._motion else "off",
            "paused": self._paused,
            "speed": self._speed,
            "scene_s": self.clock.at(time_s),
            "stopped": self._bodies.stopped() if self._bodies else {},
            "skin": self.skin_faults.describe() if self.skin_faults else {},
            "seed": self.seed,
        }

    def _set_rates(self, time_s: float) -> None:
        self.clock.set_rate(time_s, self._speed if self._motion and not self._paused else 0.0)
        self.occlusion_clock.set_rate(time_s, 0.0 if self._paused else 1.0)


def _bodies(world: World, scripts: Mapping[str, JointMotion]) -> Robots:
    """The robots of a world as bodies. Raises CellError where pybullet is missing."""
    try:
        from penumbra.sim.world import dynamics
    except ModuleNotFoundError:
        raise cells.CellError(
            f"cell {world.cell.name} has a robot: the emulator moves it with pybullet, which is not installed: "
            "pip install 'pybullet>=3.2.7,<4', or choose a cell without robots such as table "
            "(pybullet has wheels up to CPython 3.11; on later ones pip compiles it, which takes a C++ compiler)"
        ) from None
    clock = world.clock  # not the world: it holds the bodies, and a cycle of the two would stay until garbage is collected
    persons = [
        dynamics.Bystander(actor.person.meshes, partial(_parts, actor, clock))
        for name, actor in world.actors.items()
        if dynamics.within_reach(world.robots.values(), world.cell.targets[name].home.position)
    ]
    tables = [mesh for name, (mesh, _) in world.furniture.items() if name == "table"]
    return dynamics.Robots(world.robots, world.sim.payloads, partial(_scripted, scripts, clock), persons, tables)


def _parts(actor: Actor, clock: Clock, time_s: float) -> list[Array]:
    return actor.parts(clock.at(time_s))


def _scripted(scripts: Mapping[str, JointMotion], clock: Clock, time_s: float) -> dict[str, Array]:
    return {name: script.at(clock.at(time_s)) for name, script in scripts.items()}


BATCH = 20
"""Number of samples in a voltage message."""
SAMPLE_NS = 1_000_000
"""Sampling period of an electrode [ns]."""
TICK_NS = BATCH * SAMPLE_NS

Stream = list[tuple[Topic, dict[str, str], Message]]
"""Messages with their topic and the names that fill its key."""


class Sensors:
    """The sensor messages of a world. Time zero of the world is `epoch_ns`; tick k of the skin ends at epoch + k TICK_NS, frame k
    is exposed at epoch + k periods of its camera. Ticks and frames may be skipped without changing the others. The epoch may be
    changed at any time, as when a clock is set: stamps follow it, the world does not."""

    def __init__(self, world: World, epoch_ns: int):
        self.world, self.epoch_ns = world, epoch_ns
        self._logs: tuple[int, Array] | None = None  # a tick and its log changes, for the samples up to the next tick
        self._watch: dict[str, str] = {}  # by the first camera that sees a target, this target
        for camera in world.cell.cameras:
            if (name := world.model(camera)) not in self._watch.values():
                self._watch[camera] = name
        # by target, times [ns] of its camera's frames and the share hidden in each
        self._hidden = {name: deque([(0, 0.0)], maxlen=4) for name in world.actors}

    def frame_ns(self, camera: str, k: int) -> int:
        """Exposure time of frame k of a camera [ns since the epoch]."""
        return round(k * 1e9 / self.world.cell.cameras[camera].rate_hz)

    def frame(self, camera: str, k: int) -> Stream:
        """Frame k of a camera."""
        at_ns = self.frame_ns(camera, k)
        view = self.world.view(camera, at_ns * 1e-9)
        if camera in self._watch:
            self._hidden[self._watch[camera]].append((at_ns, view.hidden))
        return [(FRAME, {"camera": camera}, Frame(stamp_ns=self.epoch_ns + at_ns, image=view.image))]

    def tick(self, k: int) -> Stream:
        """Voltages of every pad, joints of every robot and the truths at tick k >= 1."""
        world, cell = self.world, self.world.cell
        stamp_ns = self.epoch_ns + k * TICK_NS
        state = world.state(k * TICK_NS * 1e-9)
        out: Stream = []
        faults = world.skin_faults
        if world.skin is not None and faults is not None:
            logs = np.log(world.change(state))
            if self._logs is None or self._logs[0] != k - 1:
                self._logs = (k - 1, np.log(world.change(world.state((k - 1) * TICK_NS * 1e-9))))
            ratio = np.arange(1, BATCH + 1)[:, None] / BATCH
            times_s = (k - 1 + ratio[:, 0]) * TICK_NS * 1e-9
            rng = np.random.default_rng([world.seed, 5, k])
            volts = world.skin.volts(np.exp(self._logs[1] + ratio * (logs - self._logs[1])), rng)
            for i, pad in enumerate(cell.pads):
                samples = faults.apply(i, times_s, volts[:, world.skin.skin.of(i)]).astype(np.float32)
                out.append((VOLTAGES, {"pad": pad}, Voltages(stamp_ns=stamp_ns, period_ns=SAMPLE_NS, volts=samples)))
            self._logs = (k, logs)
        out += [(JOINTS, {"robot": name}, Joints(stamp_ns=stamp_ns, position=q)) for name, q in state.joints.items()]
        truths = [(TRUTH, {"target": name}, self._truth(name, state, stamp_ns, k * TICK_NS)) for name in world.actors]
        return [*out, *truths]

    def _truth(self, target: str, state: WorldState, stamp_ns: int, at_ns: int) -> Truth:
        placed = state.targets[target]
        return Truth(
            stamp_ns=stamp_ns,
            target=target,
            frame=self.world.cell.frame,
            position=placed.pose[:3],
            orientation=rigid.position_orientation(rigid.from_rpy(placed.pose[:3], placed.pose[3:]))[1],
            velocity=placed.velocity,
            hidden=next((hidden for seen_ns, hidden in reversed(tuple(self._hidden[target])) if seen_ns <= at_ns), 0.0),
            gap=float(self.world.gaps(state, target).min(initial=FAR)),
        )


def record(
    cell: cells.Cell, seed: int, seconds: float, frames: bool = True, epoch_ns: int = 10**18
) -> Iterator[tuple[Topic, dict[str, str], Message]]:
    """All messages of a run in the order of their stamps, as the emulator would publish them: (topic, names, message).

    frames: without them nothing is rendered (a hundred times faster), and the truth says that nothing is hidden.
    """
    return stream(World(cell, seed), seconds, frames, epoch_ns)


def stream(
    world: World, seconds: float, frames: bool = True, epoch_ns: int = 10**18
) -> Iterator[tuple[Topic, dict[str, str], Message]]:
    """`record` for a world that has been given commands."""
    sensors = Sensors(world, epoch_ns)
    ends_ns = epoch_ns + round(seconds * 1e9)
    counts = dict.fromkeys(world.cell.cameras if frames else (), 0)
    for k in range(1, (ends_ns - epoch_ns) // TICK_NS + 1):
        for camera in counts:
            while sensors.frame_ns(camera, counts[camera]) <= k * TICK_NS:
                yield from sensors.frame(camera, counts[camera])
                counts[camera] += 1
        yield from sensors.tick(k)
