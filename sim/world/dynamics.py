"""The robots of a cell as bodies with motors: they follow a script, carry a load, and stop before they touch a person.

Bullet integrates them (Coumans & Bai, http://pybullet.org). Every TICK_S a servo reads the joints, compares them with the script
and commands the motors' velocities, within the URDF's limits of effort and velocity. A robot stops when a person comes near. It
yields if the person still pushes it, and catches up with the script when the person has gone.
"""

from __future__ import annotations

import contextlib
import os
import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.body.robot import RobotModel
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Discards what C code writes to standard error: pybullet prints the time of its build when it is imported."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


with _quiet():
    import pybullet

TICK_S = 0.02
"""Period of the servo [s]."""
STEPS = 4
"""Number of Bullet's steps per tick (200 Hz)."""
GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""
KEPT = 15_000
"""Number of past ticks that are kept: five minutes."""

STOP_M = 0.010
"""Distance [m] to a person at which a robot stops; it grows with the speed at which they approach (`REACTION_S`)."""
REACTION_S = 0.03
"""Reaction time [s]: the distance that robot and person approach in it is added to `STOP_M` (protective separation distance,
ISO/TS 15066, 5.5.4)."""
GO_M = 0.015
"""Distance [m] to a person from which a stopped robot goes on. The planned motion of persons keeps it (`sim.world.clearance`)."""
TOUCH_M = 0.001
"""Distance [m] below which person and robot touch: the tolerance of Bullet's contacts."""
WATCH_M = 0.10
"""Distance [m] from a robot beyond which persons are ignored."""
YIELD = 0.1
"""Share of the motors' maximum effort that holds a robot against a push, in addition to the effort for its weight."""
ACCELERATION = 7.5
"""Maximum commanded change of a joint's velocity [rad/s^2 or m/s^2]: the lowest of the Panda's published limits (joint 2)."""
CATCH_UP = 0.5
"""Maximum velocity [rad/s or m/s], in addition to the script's, at which a robot returns to the script after a stop."""
PERSON_M = 2.0
"""Distance [m] from a robot's reach beyond which a person is not simulated: the extent of a body and its motion."""
UNLIMITED = 1e5
"""Effort [Nm] and velocity of a joint for which the URDF gives none: Bullet needs finite values."""
LIGHTEST = 1e-3
"""Minimum mass [kg] of a moving link; without mass the mass matrix is singular."""

_CONNECTING = threading.Lock()  # connecting shares state inside pybullet


@dataclass(frozen=True)
class Bystander:
    """A person beside the robots. meshes: the parts of the body; at(time_s): T_world_mesh (4, 4) of each."""

    meshes: Sequence[Mesh]
    at: Callable[[float], Sequence[Array]]


class Robots:
    """The cell's robots in motion.

    script(time_s): commanded joint values (n,) [rad or m] by robot at a time [s]. persons: the persons that the robots stop for.
    obstacles: fixed meshes in world coordinates; links that touch one at the start count as mounted on it.
    """

    def __init__(
        self,
        models: Mapping[str, RobotModel],
        payloads: Mapping[str, cells.Payload],
        script: Callable[[float], dict[str, Array]],
        persons: Sequence[Bystander],
        obstacles: Sequence[Mesh],
    ):
        self._script, self._persons = script, persons
        with _CONNECTING:
            self._client = pybullet.connect(pybullet.DIRECT)
        weakref.finalize(self, pybullet.disconnect, self._client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=TICK_S / STEPS, deterministicOverlappingPairs=1, physicsClientId=self._client
        )
        pybullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=self._client)
        self._hulls = [  # by person, mesh and part
            [[self._fixed(points) for points in connected_parts(mesh)] for mesh in person.meshes] for person in persons
        ]
        people = [hull for parts in self._hulls for hulls in parts for hull in hulls]
        begin, soon = script(0.0), script(TICK_S)
        self._arms = {
            name: _Arm(self._client, model, payloads.get(name), begin[name], (soon[name] - begin[name]) / TICK_S, people)
            for name, model in models.items()
        }
        for mesh in obstacles:
            fixed = self._fixed(mesh.vertices)
            for arm in self._arms.values():
                arm.mount(fixed)
        self._demanded = begin
        self._ticks = deque([{name: arm.q for name, arm in self._arms.items()}], maxlen=KEPT)
        self._count = 1
        self._lock = threading.Lock()

    def at(self, time_s: float) -> dict[str, Array]:
        """Joint values (n,) by robot at a time >= 0, linear between ticks. Raises ValueError for a time no longer kept."""
        k, share = divmod(time_s / TICK_S + 1e-9, 1.0)  # a time that is a tick up to rounding needs nothing after it
        first, ahead = int(k), int(share > 2e-9)
        with self._lock:
            while self._count <= first + ahead:
                self._tick()
            oldest = self._count - len(self._ticks)
            if first < oldest:
                raise ValueError(f"robots: expected a time of the last {KEPT * TICK_S:g} s, got {time_s:g} s: make a new world")
            before, after = self._ticks[first - oldest], self._ticks[first + ahead - oldest]
        return {name: q + share * (after[name] - q) for name, q in before.items()}

    def stopped(self) -> dict[str, bool]:
        """Whether each robot stands still for a person now."""
        return {name: arm.stopped for name, arm in self._arms.items()}

    def _tick(self) -> None:
        time_s = self._count * TICK_S
        for person, parts in zip(self._persons, self._hulls, strict=True):
            for T, hulls in zip(person.at(time_s), parts, strict=True):
                position, orientation = rigid.position_orientation(T)
                for hull in hulls:
                    pybullet.resetBasePositionAndOrientation(hull, position, orientation, physicsClientId=self._client)
        demanded = self._script(time_s)
        for name, arm in self._arms.items():
            arm.command(self._demanded[name], demanded[name])
        for _ in range(STEPS):
            pybullet.stepSimulation(self._client)
        for arm in self._arms.values():
            arm.read()
        self._demanded = demanded
        self._ticks.append({name: arm.q for name, arm in self._arms.items()})
        self._count += 1

    def _fixed(self, points: Array) -> int:
        """Adds a static body, the convex hull of points (n, 3) in its own frame, at the origin of the world."""
        shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, vertices=points.tolist(), physicsClientId=self._client)
        return int(pybullet.createMultiBody(0.0, shape, physicsClientId=self._client))


class _Arm:
    """One robot: its body, servo and protective stop. q (n,): its joint values; people: bodies that it stops for.

    A link's shape is the convex hull of its collision shapes; its inertia is that of a homogeneous solid of this shape, since
    those of URDFs are often made up (the Panda's: 0.1 kg m^2 for every link).
    """

    def __init__(
        self, client: int, model: RobotModel, payload: cells.Payload | None, q: Array, velocity: Array, people: Sequence[int]
    ):
        self._client, self._people = client, people
        self.stopped = False
        self._gap = np.inf
        self.q, self._velocity = q, velocity
        joints = {joint.name: (i, joint) for i, joint in enumerate(model.description.joints)}
        self._index = [joints[name][0] for name in model.joints]
        named = [joints[name][1] for name in model.joints]
        self._lower, self._upper = model.lower, model.upper
        self._effort = np.minimum([joint.effort for joint in named], UNLIMITED)
        self._fastest = np.minimum([joint.velocity for joint in named], UNLIMITED)
        self._load, self._hold = self._effort, q
        self._body = self._make(model, payload)
        for i, joint, value, rate in zip(self._index, named, q, velocity, strict=True):
            limits = {"jointLowerLimit": joint.lower, "jointUpperLimit": joint.upper} if np.isfinite(joint.upper) else {}
            pybullet.changeDynamics(self._body, i, jointDamping=joint.damping, **limits, physicsClientId=client)
            pybullet.resetJointState(self._body, i, value, rate, physicsClientId=client)

    def _make(self, model: RobotModel, payload: cells.Payload | None) -> int:
        description = model.description
        hulls = [
            pybullet.createCollisionShape(
                pybullet.GEOM_MESH, vertices=model.meshes[link].vertices.tolist(), physicsClientId=self._client
            )
            if link in model.meshes
            else -1
            for link in model.links
        ]
        placed = [rigid.position_orientation(T) for T in model.T_parent_link]
        parents, masses = list(model.parents[1:]), [max(link.mass or 0.0, LIGHTEST) for link in description.links[1:]]
        axes, centres = [joint.axis for joint in description.joints], [link.centre for link in description.links[1:]]
        kinds = [_kind(joint.kind) if joint.name in model.joints else pybullet.JOINT_FIXED for joint in description.joints]
        if payload is not None:
            placed.append((np.array(payload.position), np.array((0.0, 0.0, 0.0, 1.0))))
            parents.append(model.links.index(payload.link))
            masses.append(payload.mass)
            axes.append(np.array((0.0, 0.0, 1.0)))
            centres.append(np.zeros(3))
            kinds.append(pybullet.JOINT_FIXED)
            hulls.append(-1)
        n = len(parents)
        return int(
            pybullet.createMultiBody(
                baseCollisionShapeIndex=hulls[0],
                basePosition=placed[0][0],
                baseOrientation=placed[0][1],
                linkMasses=masses,
                linkCollisionShapeIndices=hulls[1:],
                linkVisualShapeIndices=[-1] * n,
                linkPositions=[position for position, _ in placed[1:]],
                linkOrientations=[orientation for _, orientation in placed[1:]],
                linkInertialFramePositions=centres,
                linkInertialFrameOrientations=[(0.0, 0.0, 0.0, 1.0)] * n,
                linkParentIndices=parents,
                linkJointTypes=kinds,
                linkJointAxis=axes,
                physicsClientId=self._client,
            )
        )

    def mount(self, obstacle: int) -> None:
        """Disables contact between an obstacle and the links that touch it now: they are mounted on it."""
        for point in pybullet.getClosestPoints(self._body, obstacle, TOUCH_M, physicsClientId=self._client):
            pybullet.setCollisionFilterPair(self._body, obstacle, point[3], -1, 0, physicsClientId=self._client)

    def command(self, demanded: Array, soon: Array) -> None:
        """Sets the motors for a tick. demanded, soon: the script's joint values (n,) at the tick's begin and end."""
        gap = min((self._distance(person) for person in self._people), default=np.inf)
        approach = max(0.0, self._gap - gap) / TICK_S if np.isfinite(self._gap) else 0.0
        self._gap = gap
        stood, pushed = self.stopped, gap < TOUCH_M
        self.stopped = gap < (GO_M if stood else STOP_M + REACTION_S * approach)
        if self.stopped:
            if pushed or not stood:
                self._hold = self.q
            effort = np.minimum(self._effort, self._load + YIELD * self._effort) if pushed else self._effort
            self._drive((self._hold - self.q) / TICK_S, effort)
            return
        demanded, soon = (np.minimum(np.maximum(q, self._lower), self._upper) for q in (demanded, soon))
        behind = demanded - self.q
        catch_up = np.minimum(np.minimum(np.abs(behind) / TICK_S, np.sqrt(ACCELERATION * np.abs(behind))), CATCH_UP)
        change = (soon - demanded) / TICK_S + np.sign(behind) * catch_up - self._velocity
        most = ACCELERATION * TICK_S
        velocity = self._velocity + np.minimum(np.maximum(change, -most), most)
        self._drive(np.minimum(np.maximum(velocity, -self._fastest), self._fastest), self._effort)

    def read(self) -> None:
        """Reads the joints after a tick."""
        states = pybullet.getJointStates(self._body, self._index, physicsClientId=self._client)
        self.q = np.array([state[0] for state in states])
        self._velocity = np.array([state[1] for state in states])
        if self._gap >= TOUCH_M:
            self._load = np.abs([state[3] for state in states])

    def _drive(self, velocity: Array, effort: Array) -> None:
        pybullet.setJointMotorControlArray(
            self._body,
            self._index,
            pybullet.VELOCITY_CONTROL,
            targetVelocities=velocity,
            forces=effort,
            physicsClientId=self._client,
        )

    def _distance(self, person: int) -> float:
        """Distance [m] to a person's hull, infinite beyond WATCH_M."""
        points = pybullet.getClosestPoints(self._body, person, WATCH_M, physicsClientId=self._client)
        return min((point[8] for point in points), default=np.inf)


def within_reach(models: Iterable[RobotModel], position: ArrayLike) -> bool:
    """Whether a person whose target has its home at a position (3,) [m] may come near one of the robots."""
    reaches = ((model, float(np.linalg.norm(model.T_parent_link[1:, :3, 3], axis=1).sum())) for model in models)
    return any(np.linalg.norm(model.T_world_base[:3, 3] - np.asarray(position)) < reach + PERSON_M for model, reach in reaches)


def _kind(kind: str) -> int:
    return int(pybullet.JOINT_PRISMATIC if kind == "prismatic" else pybullet.JOINT_REVOLUTE)


def connected_parts(mesh: Mesh) -> list[Array]:
    """Vertices (n, 3) of each connected component of a mesh. Those of the parametric forearm (forearm, palm, thumb) are
    convex."""
    n = len(mesh.vertices)
    edges = np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]])
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    count, part = connected_components(graph, directed=False)
    return [mesh.vertices[part == i] for i in range(count)]
