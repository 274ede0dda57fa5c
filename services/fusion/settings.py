"""Settings of the default observer, whose filter is in `kernel.py`, and how they are handed to it."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, field

import numpy as np
from numpy.typing import NDArray

from services.fusion.estimate import SOURCES, Array, Limits
from services.fusion.records import MODEL, POSE


@dataclass(frozen=True)
class Sense:
    """What is known of the errors of one sense.

    lasting : share of the variance that is the same from one measurement to the next.
    time_constant : after which such an error is forgotten [s].
    floor : standard deviation, in UNITS, of what its covariance does not tell, its calibration: 0.006 is 0.6 mm and 0.34 degrees.
        All of it lasts.
    """

    lasting: float = 0.75
    time_constant: float = 1.0
    floor: float = 0.006


@dataclass(frozen=True)
class Settings:
    """Numbers of the filter, with the reasons for their defaults.

    senses : see Sense. A mask's bias lasts for as long as the limb rests. The skin's windows share no samples and its voltages'
        noise is white: measured on the emulator, a fifth of the variance is the response model's and lasts.
    acceleration : density of the white acceleration, linear [m^2/s^3] and angular [rad^2/s^3]: an arm that reaches 0.25 m/s.
    velocity_time : after which a velocity is forgotten [s]: limbs reach to places and stop there.
    velocity_spread : standard deviation of an unknown velocity, linear [m/s] and angular [rad/s].
    agility : bounds of the factors on `acceleration` that are learned: from a resting arm to a hand at 2 m/s.
    doubt : largest factor on the covariance of a sense that is learned.
    learning : step of all of them per measurement, at most, and per second.
    gate : probability with which a good measurement passes the gate; the second, while another sense is less surprising.
    patience : after refusing everything of all senses for so long [s], start again from the newest measurement.
    source_patience : after refusing one sense for so long [s] while another is believed, doubt the state.
    witness : a refused measurement teaches nothing while another sense, heard within so long [s], is less surprising.
    refusals : and at least so many measurements refused, so that two outliers after a pause do not count as persistence.
    unobserved : a direction with a standard deviation beyond this, in UNITS, is taken as not observed.
    horizon : length of the history [s]: vision is 30 to 100 ms late, more when the machine is busy.
    capacity : measurements that the history holds at most: twice what 100 Hz and 20 Hz bring within the horizon; a storm of them
        shortens the history and costs no memory.
    weight_time : over which a source's weight remembers [s].
    """

    senses: dict[str, Sense] = field(default_factory=lambda: {"vision": Sense(), "haptic": Sense(lasting=0.2, time_constant=0.3)})
    acceleration: tuple[float, float] = (0.1, 1.5)
    velocity_time: float = 0.35
    velocity_spread: tuple[float, float] = (0.4, 1.0)
    agility: tuple[float, float] = (0.08, 30.0)
    doubt: float = 100.0
    learning: tuple[float, float] = (0.1, 5.0)
    gate: tuple[float, float] = (0.9999, 0.999)
    patience: float = 0.5
    source_patience: float = 1.0
    witness: float = 0.25
    refusals: int = 5
    unobserved: float = 2.0
    horizon: float = 1.0
    capacity: int = 256
    weight_time: float = 0.5
    limits: Limits = Limits()


def model(settings: Settings, home: Array, spread: tuple[float, float]) -> NDArray[np.void]:
    """A MODEL of a target expected at the pose home (4, 4) with standard deviations spread (position [m], rotation [rad])."""
    out = np.zeros((), MODEL)
    values = vars(settings) | {"lost_age": settings.limits.lost_age, "limits": astuple(settings.limits), "home": home}
    for name in MODEL.names or ():
        if name in values:
            out[name] = values[name]
    for name in ("lasting", "time_constant", "floor"):
        out[name] = [getattr(settings.senses[source], name) for source in SOURCES]
    out["threshold"] = [[_quantile(max(rank, 1), share) for rank in range(POSE + 1)] for share in settings.gate]
    out["home_covariance"] = np.diag(np.repeat(np.square(spread), 3))
    return out


def _quantile(rank: int, share: float) -> float:
    """The chi-square quantile of `rank` degrees of freedom: `share` of the squares are below it."""
    low, high = 0.0, 1e3
    for _ in range(64):
        middle = 0.5 * (low + high)
        # the upper tail, from that of 1 or 2 degrees of freedom in steps of 2 (Abramowitz and Stegun 26.4.4, 26.4.5, 26.4.8)
        half = 0.5 * middle
        tail, reached = (math.erfc(math.sqrt(half)), 1) if rank % 2 else (math.exp(-half), 2)
        while reached < rank:
            tail += half ** (0.5 * reached) * math.exp(-half) / math.gamma(0.5 * reached + 1.0)
            reached += 2
        low, high = (middle, high) if tail > 1.0 - share else (low, middle)
    return 0.5 * (low + high)
