"""Monte Carlo runs for the observers: limbs that reach, and senses that err, arrive late and lose sight of them.

Nothing is drawn from the filter's own model. A limb makes minimum-jerk reaches with rests (`sim.world.motion`). A sense's errors
lie along its own axes, the camera's ray or the limb, and their share that lasts and the time it lasts are drawn anew for every
run, around what the filter assumes: vision a share of 0.6 to 0.9 and 0.5 to 2 s (0.75 and 1 s assumed), the skin 0.1 to 0.4 and
0.15 to 0.6 s (0.2 and 0.3 s). In addition there is an error of calibration, which no covariance contains: constant over a run,
with a standard deviation of 0.5 mm and 0.3 degrees in every direction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.sim.world.motion import PEAK, LimbMotion, Reach

T0_NS = 1_700_000_000_000_000_000
PERIOD_S = {"vision": 0.05, "haptic": 0.02}
DELAY_S = {"vision": (0.04, 0.06), "haptic": (0.003, 0.003)}
"""Bounds of the delay [s] from a measurement's stamp to its arrival."""
LASTING = {"vision": (0.6, 0.9), "haptic": (0.1, 0.4)}
TIME_CONSTANT_S = {"vision": (0.5, 2.0), "haptic": (0.15, 0.6)}
CALIBRATION = np.repeat([0.0005, np.radians(0.3)], 3)
RADIUS_M, RANGE_M = 0.04, 0.15
"""Radius of the forearm [m], and range of the skin [m]."""
NEAR, FAR = (0.07, 0.17), (0.22, 0.35)
"""Bounds of the height [m] of the limb's axis above the skin: always in its range, and never."""
WRONG_S, WRONG_M = (10.0, 11.0), 0.1
AWAY_SPEED, DRIFT_SPEED, WRONG_TURN = 0.3, 0.1, 0.8
"""Speeds [m/s] at which a wrong sense drifts away, from an offset and from zero, and angle [rad] by which one is turned."""
FAST_SPEED, FAST_ACCELERATION, FAST_TURN = 2.0, 50.0, 6.0
"""Peak speed, acceleration and angular rate of a fast hand [m/s, m/s^2, rad/s]."""
CAMERA = rigid.look_at([0.35, -1.15, 0.90], [0.05, 0.0, 0.15])[:3, 3]


def ns(seconds: float) -> int:
    """The stamp [ns] of a time [s] of a run."""
    return T0_NS + round(seconds * 1e9)


@dataclass(frozen=True)
class Message:
    """One measurement: its arrival and stamp [s], its sense, its pose (4, 4), its information (6, 6), and the share that is
    hidden from the camera (None for the skin)."""

    arrival: float
    stamp: float
    source: str
    T: Array
    information: Array
    hidden: float | None


@dataclass(frozen=True)
class Situation:
    """What can be seen and felt in a run.

    hidden : the share hidden from the camera at a time [s] and for a phase in [0, 1) of the run; 1: no pose.
    scored : whether errors count at a time.
    rolls : whether the roll is observed at a time; where it is not, errors are taken along the five other directions.
    heights : of the limb above the skin, None: all of the cell's region.
    feels : whether the skin measures at a time, where the limb is in range.
    """

    hidden: Callable[[float, float], float]
    scored: Callable[[float], bool]
    rolls: Callable[[float], bool] = lambda t: True
    heights: tuple[float, float] | None = None
    feels: Callable[[float], bool] = lambda t: True
    fast: bool = False
    wrong: bool = False


SETTLED_S = 2.0
"""Time [s] before which errors do not count, as the observer has just begun."""
GONE = ((2.5, 3.0), (5.0, 6.0), (8.0, 9.5), (11.5, 13.5), (15.5, 16.0), (18.0, 19.5))
"""Intervals [s] in which nothing is seen or felt."""
HANDOVER_S, OVERLAP_S = 3.0, 0.3
"""Time [s] for which one sense measures before the other takes over, and time [s] for which both do."""
ROLL_FORGOTTEN_S = 0.5


def _gone(t: float, begin: float = 0.0) -> bool:
    return any(first + begin <= t < last for first, last in GONE)


def _sees(t: float) -> bool:
    return t % (2.0 * HANDOVER_S) < HANDOVER_S


def _settled(t: float) -> bool:
    return t >= SETTLED_S


SITUATIONS = {
    "visible": Situation(lambda t, phase: 0.05, _settled),
    "part hidden": Situation(lambda t, phase: 0.55 + 0.25 * float(np.sin(2.0 * np.pi * (t / 4.0 + phase))), _settled),
    "hidden, in range": Situation(
        lambda t, phase: 0.05 if t < SETTLED_S else 1.0,
        lambda t: t >= SETTLED_S + 1.0,
        rolls=lambda t: t < SETTLED_S + ROLL_FORGOTTEN_S,
        heights=NEAR,
    ),
    "hidden, out of range": Situation(lambda t, phase: float(_gone(t)), lambda t: _gone(t, 0.1), heights=FAR),
    "hand-over": Situation(
        lambda t, phase: 0.05 if _sees(t) else 1.0,
        _settled,
        rolls=lambda t: _sees(t - OVERLAP_S) if _sees(t) else t % HANDOVER_S < ROLL_FORGOTTEN_S,
        heights=NEAR,
        feels=lambda t: not _sees(t + OVERLAP_S) or not _sees(t - OVERLAP_S),
    ),
    "one sense wrong": Situation(lambda t, phase: 0.05, _settled, heights=NEAR, wrong=True),
    "fast hand": Situation(lambda t, phase: 0.05, _settled, fast=True),
}
"""The six situations of the goals, and one beyond them: a hand at up to 2 m/s and 50 m/s^2."""


class FastHand:
    """Reaches as fast as a hand moves, with rests; it has the interface of `sim.world.motion.LimbMotion`."""

    def __init__(self, region: cells.Motion, seconds: float, rng: np.random.Generator):
        low, high = np.array([*region.low, *region.rpy_low]), np.array([*region.high, *region.rpy_high])
        goal, end = rng.uniform(low, high), 0.5
        self._reaches = [Reach(0.0, 0.5, 0.5, goal, goal)]
        while end <= seconds:
            start, goal, begin = goal, rng.uniform(low, high), end
            way, turn = float(np.linalg.norm((goal - start)[:3])), float(np.abs((goal - start)[3:]).max())
            peak = 10.0 / np.sqrt(3.0)  # of a minimum-jerk reach's acceleration, over way / duration^2
            least = max(PEAK * way / FAST_SPEED, np.sqrt(peak * way / FAST_ACCELERATION), PEAK * turn / FAST_TURN)
            duration = least * rng.uniform(1.0, 1.6)
            end = begin + duration + max(0.0, rng.uniform(-0.4, 0.6))
            self._reaches.append(Reach(begin, duration, end, start, goal))

    def at(self, time_s: float) -> tuple[Array, Array]:
        """Pose (6,) and rate (6,) at a time."""
        return next(reach for reach in self._reaches if time_s <= reach.end_s).at(time_s)


class Senses:
    """The measurements of a limb, with errors that last and errors that do not."""

    def __init__(self, rng: np.random.Generator):
        self._rng = rng
        self._lasting = {name: rng.uniform(*bounds) for name, bounds in LASTING.items()}
        self._keep = {
            name: np.exp(-PERIOD_S[name] / np.exp(rng.uniform(*np.log(bounds)))) for name, bounds in TIME_CONSTANT_S.items()
        }
        self._bias = {name: rng.normal(size=6) for name in LASTING}
        self._calibration = {name: CALIBRATION * rng.normal(size=6) for name in LASTING}

    def _error(self, source: str, axes: Array, sigma: Array) -> Array:
        """An error (6,) along axes (6, 6), one a column, with these standard deviations (6,)."""
        keep, lasting = self._keep[source], self._lasting[source]
        self._bias[source] = keep * self._bias[source] + np.sqrt(1.0 - keep**2) * self._rng.normal(size=6)
        unit = np.sqrt(lasting) * self._bias[source] + np.sqrt(1.0 - lasting) * self._rng.normal(size=6)
        return axes @ (sigma * unit) + self._calibration[source]

    def seen(self, T: Array, hidden: float) -> tuple[Array, Array]:
        """A camera's pose and information of a limb at T: uncertain along the ray, and the more so the more is hidden."""
        grown = np.exp(1.5 * hidden)
        sigma = grown * np.array([0.008, 0.002, 0.002, 0.06, 0.025, 0.025])

        def axes(T: Array) -> Array:
            return _blocks(_along(T[:3, 3] - CAMERA), T[:3, :3])

        measured = rigid.perturb(T, -self._error("vision", axes(T), sigma))
        A = axes(measured)
        return measured, (A / np.square(sigma)) @ A.T

    def felt(self, T: Array) -> tuple[Array, Array]:
        """The skin's pose and information of a limb at T: uncertain with the gap, and along the limb; the roll is not
        measured."""
        gap = float(np.clip(T[2, 3] - RADIUS_M, 0.02, RANGE_M))
        worse = np.exp(np.interp(gap, [0.02, RANGE_M], np.log([1.0, 12.0])))
        sigma = worse * np.array([0.003, 0.001, 0.0012, 0.0, 0.006, 0.01])
        error = self._error("haptic", _blocks(T[:3, :3], T[:3, :3]), sigma)
        measured = rigid.perturb(T, -error) @ rigid.from_rpy([0, 0, 0], [0.3 * self._rng.normal(), 0, 0])
        A = _blocks(measured[:3, :3], measured[:3, :3])
        weights = np.where(sigma > 0.0, 1.0 / np.square(np.maximum(sigma, 1e-9)), 0.0)
        return measured, (A * weights) @ A.T


@dataclass(frozen=True)
class Run:
    """One run: the limb's pose (4, 4) at a time [s], and the messages in the order in which they arrive."""

    situation: Situation
    seconds: float
    at: Callable[[float], Array]
    messages: list[Message] = field(repr=False)


def drawn(name: str, seed: int, index: int, seconds: float) -> Run:
    """Run `index` of a situation, before `wronged` makes a sense wrong."""
    situation = SITUATIONS[name]
    rng = np.random.default_rng([seed, list(SITUATIONS).index(name), index])
    at = _limb(situation, seconds, rng)
    senses, phase, messages = Senses(rng), rng.random(), []
    for source, period in PERIOD_S.items():
        for k in range(int(seconds / period) + 1):
            t = k * period
            T, hidden = at(t), situation.hidden(t, phase)
            if source == "vision" and hidden < 1.0:
                said, share = senses.seen(T, hidden), hidden
            elif source == "haptic" and T[2, 3] - RADIUS_M < RANGE_M and situation.feels(t):
                said, share = senses.felt(T), None
            else:
                continue
            messages.append(Message(t + rng.uniform(*DELAY_S[source]), t, source, *said, share))
    return Run(situation, seconds, at, sorted(messages, key=lambda m: m.arrival))


def silenced(run: Run, index: int) -> Run:
    """The same run without the measurements that `wronged` makes wrong."""
    return replace(run, messages=[m for m in run.messages if not _is_wrong(m, index)])


def jumped(name: str, seed: int, index: int, seconds: float) -> Run:
    """A run of a situation whose limb jumps to that of another run at half its time."""
    first, second = (drawn(name, seed, i, seconds) for i in (2 * index, 2 * index + 1))
    middle = seconds / 2.0
    messages = [m for m in first.messages if m.stamp < middle] + [m for m in second.messages if m.stamp >= middle]
    at = lambda t: (first if t < middle else second).at(t)  # noqa: E731
    return Run(first.situation, seconds, at, sorted(messages, key=lambda m: m.arrival))


def _is_wrong(m: Message, index: int) -> bool:
    return m.source == list(PERIOD_S)[index % 2] and WRONG_S[0] <= m.stamp < WRONG_S[1]


@dataclass(frozen=True)
class Wrong:
    """How a sense is wrong, in addition to its own errors: offset at first [m], speed at which it grows [m/s], turn [rad], and
    whether the sense keeps reporting its first wrong pose (`stands`)."""

    offset: float = 0.0
    speed: float = 0.0
    turn: float = 0.0
    stands: bool = False


OFFSET = Wrong(offset=WRONG_M)
WAYS = {
    "off by 10 cm": OFFSET,
    "off by 10 cm, running away at 30 cm/s": Wrong(offset=WRONG_M, speed=AWAY_SPEED),
    "standing still, 10 cm away": Wrong(offset=WRONG_M, stands=True),
    "drifting away at 10 cm/s": Wrong(speed=DRIFT_SPEED),
    "turned by 46 degrees": Wrong(turn=WRONG_TURN),
}
"""The ways in which a sense is wrong."""


def wronged(run: Run, seed: int, index: int, way: Wrong = OFFSET) -> Run:
    """The same run with one sense wrong for a second, along and about a random direction; each of the two in every other run."""
    direction = np.random.default_rng([seed, index]).normal(size=3)
    direction /= np.linalg.norm(direction)
    first: Array | None = None
    messages = []
    for m in run.messages:
        if _is_wrong(m, index):
            far = way.offset + way.speed * (m.stamp - WRONG_S[0])
            said = rigid.perturb(m.T, np.concatenate([far * direction, way.turn * direction]))
            first = said if first is None else first
            m = replace(m, T=first if way.stands else said)
        messages.append(m)
    return replace(run, messages=messages)


def delayed(run: Run, delay: Callable[[], float]) -> Run:
    """The same run with every measurement delayed by a call of `delay` [s]."""
    in_order = sorted(run.messages, key=lambda m: (m.stamp, list(PERIOD_S).index(m.source)))
    messages = [replace(m, arrival=m.stamp + delay()) for m in in_order]
    return replace(run, messages=sorted(messages, key=lambda m: m.arrival))


def _limb(situation: Situation, seconds: float, rng: np.random.Generator) -> Callable[[float], Array]:
    sim = cells.load("table").sim
    assert sim is not None
    region = sim.motion
    if situation.heights:
        low, high = situation.heights
        region = region.model_copy(update={"low": (*region.low[:2], low), "high": (*region.high[:2], high)})
    if situation.fast:
        motion: FastHand | LimbMotion = FastHand(region, seconds, rng)
    else:
        motion = LimbMotion(region, int(rng.integers(2**31)), lambda times, poses: 0.0)

    def at(t: float) -> Array:
        pose = motion.at(t)[0]
        return rigid.from_rpy(pose[:3], pose[3:])

    return at


def _blocks(a: Array, b: Array) -> Array:
    out = np.zeros((6, 6))
    out[:3, :3], out[3:, 3:] = a, b
    return out


def _along(ray: Array) -> Array:
    """A frame (3, 3), its first axis along a ray."""
    x = ray / np.linalg.norm(ray)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])
