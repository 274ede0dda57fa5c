"""Settings of the default observer, and the records that its compiled filter (`filter.py`) reads."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from penumbra.services.fusion.estimate import Limits
from penumbra.services.fusion.records import MODEL, POSE, SENSE_MODEL
from penumbra.shared.cell.description import Body, Target
from penumbra.shared.chi_square import quantile
from penumbra.shared.contract.senses import Sense
from penumbra.shared.geometry import rigid


@dataclass(frozen=True)
class FusionSettings:
    """Settings of the filter. Every field states its unit and the source of its value. The settings of a sense are in
    `shared/contract/senses.py`.

    "Chosen" means by hand; `penumbra bench fusion` shows what a change does. "By the NEES" (normalised estimation error squared)
    means that on its simulated limbs the errors are as large as the covariance says.
    """

    # ---- How a limb moves

    jerk: tuple[float, float] = (1.5, 40.0)
    """Density of the white jerk, linear [m^2/s^5] and angular [rad^2/s^5], before it is adapted: that of a slow limb. By the
    NEES; the likelihood of the measurements alone is largest with a sixth of it, but then up to 1.7 % of the poses are beyond
    three sigma. The angular one is twice that: while only the skin feels a limb, nothing observes its roll for seconds. With half
    of it, the roll of 0.5 % of the poses was beyond three sigma instead of 0.2 % (six replays of `arm`)."""
    motion_time: tuple[float, float] = (0.22, 0.22)
    """Time [s] in which such a limb changes its motion: ratio of the standard deviation of its velocity to that of its
    acceleration, linear and angular. By the NEES."""
    damping: float = 0.7
    """Damping ratio of the velocity, in (0, 1): below one, a limb that has set out stops and comes back, like a limb that reaches
    to and fro within a region. By the NEES."""
    velocity_spread: tuple[float, float] = (0.4, 1.0)
    """Standard deviation of an unknown velocity, linear [m/s] and angular [rad/s]. Chosen, not measured."""

    # ---- What is learned from the innovations

    agility: tuple[float, float] = (1.0, 30_000.0)
    """Minimum and maximum of the learned factors on `jerk`: from a limb that rests to a hand at 2 m/s. By the NEES; the minimum
    by the share of poses beyond three sigma: a limb that sets out from rest must stay within its covariance."""
    doubt: float = 100.0
    """Maximum learned factor on the covariance of a sense. Chosen, not measured."""
    learning: tuple[float, float] = (0.1, 5.0)
    """Learning rate of these factors' logarithms: maximum per measurement, and per second [1/s]. Chosen, not measured."""

    # ---- What is refused, and until when

    agreement_time: float = 0.25
    """Maximum age [s] of the last measurement of another sense that decides whether a surprising one is an outlier. Chosen, not
    measured."""
    patience: float = 0.5
    """Time [s] for which all measurements of all senses are refused before the filter restarts from the newest one. Chosen, not
    measured."""
    source_patience: float = 1.0
    """Time [s] for which one sense is refused, while another is accepted, before the covariance of the state is enlarged. Chosen,
    not measured."""
    denial: tuple[float, float] = (0.1, 0.5)
    """Age [s] of the last accepted measurement of a sense from which its word counts that the target is not where it is expected,
    and the time [s] for which it counts, as does a refused measurement that nothing contradicts. Chosen: two periods of a camera
    at 20 Hz, so that one camera does not deny what another one sees, and `patience`."""
    refusals: int = 5
    """Minimum number of refused measurements in both cases, so that two outliers after a pause do not suffice. Chosen, not
    measured."""
    offset_spread: tuple[float, float] = (0.3, 1.0)
    """Prior standard deviation of the offset of a sense that counts as wrong, in position [m] and rotation [rad]: so large that
    it gives no information. Chosen, not measured."""
    offset_drift: tuple[float, float] = (0.015, 0.2)
    """Random walk of such an offset, in position [m/s^0.5] and rotation [rad/s^0.5], before its measurements show that it runs
    away. By 40 runs of seed 8702: with 0.012 m, a sense that is off by 10 cm moves the pose by 0.77 instead of 0.86 cm, but one
    that stands still by 2.71 instead of 2.66 cm at worst. By 20 runs of seed 8701: with 0.1 rad, one that stands still leaves
    1.3 % of the poses beyond three sigma instead of 0.1 %, because no other sense observes the limb's roll."""
    offset_trial: float = 0.15
    """Time [s] from its first refused measurement in which a wrong sense's changes are not used, but only tested for a constant
    offset. By 20 runs of seed 8701: with 0.1, a sense that runs away at 30 cm/s moves the pose by 3.3 cm at worst, with 0.15 by
    2.6 cm, like a silent one."""
    offset_wander: float = 100.0
    """Maximum learned factor on the variance of this walk. Chosen, not measured."""
    offset_learning: float = 0.5
    """Learning rate of this factor's logarithm, per measurement. Chosen: 0.3 does the same (20 runs of seed 8701)."""
    unobserved: float = 2.0
    """Standard deviation, in UNITS, from which a direction counts as not observed: 20 cm or 2 rad. Chosen, not measured."""

    # ---- What is remembered

    horizon: float = 1.0
    """Length of the history [s]: vision is 30 to 100 ms late, more when the machine is busy."""
    capacity: int = 128
    """Maximum number of measurements in the history, per sense on average: for two senses, it is twice what 100 Hz and 20 Hz
    bring within the horizon. A burst of measurements shortens the history and takes no more memory."""
    weight_time: float = 0.5
    """Time constant [s] with which the information from a sense decays in its published weight. Chosen, not measured."""


MOTION = ("jerk", "motion_time", "damping")
"""The fields of `FusionSettings` that `learning.py` learns from recordings."""


def with_motion(text: str) -> FusionSettings:
    """The settings with the motion from a file of `penumbra replay --motion`. Raises ValueError for any other file."""
    try:
        found = json.loads(Path(text).read_text())
        pairs = {name: (float(found[name][0]), float(found[name][1])) for name in MOTION[:2]}
        damping = float(found["damping"])
    except (OSError, ValueError, TypeError, LookupError) as error:
        raise ValueError(f"expected a file of penumbra replay --motion, got {text!r}: {error}") from None
    if not (all(0.0 < value < math.inf for pair in pairs.values() for value in pair) and 0.0 < damping < 1.0):
        raise ValueError(f"{text}: expected positive numbers and a damping below one, got {pairs} and {damping}")
    return FusionSettings(jerk=pairs["jerk"], motion_time=pairs["motion_time"], damping=damping)


@dataclass(frozen=True)
class Arm:
    """Bounds of a forearm's place.

    shoulder : its position [m]. upper_arm : its length [m]; infinite if it is unknown, and then without a bound. elbow : its
    distance behind the target's origin, along the limb [m].
    """

    shoulder: tuple[float, float, float] = (0.0, 0.0, 0.0)
    upper_arm: float = math.inf
    elbow: float = 0.0


@dataclass(frozen=True)
class Subject:
    """Prior knowledge of a target.

    home : its expected pose (4, 4), with standard deviations `spread` (position [m], rotation [rad]).
    """

    home: rigid.Array
    spread: tuple[float, float]
    limits: Limits = Limits()
    arm: Arm = Arm()

    @classmethod
    def of(cls, target: Target, body: Body) -> Subject:
        """A target of a cell, whose person has this body."""
        arm = Arm()
        if target.shoulder is not None:
            length = target.size.length if target.size else 1.0
            arm = Arm(target.shoulder, body.upper_arm_length, 0.5 * length * body.forearm_length)
        spread = target.home_spread.position, target.home_spread.rotation
        return cls(target.home.transform, spread, Limits(tracking_bound=target.tracking_bound), arm)


def model(settings: FusionSettings, subject: Subject) -> NDArray[np.void]:
    """The MODEL of a target."""
    out = np.zeros((), MODEL)
    values = vars(settings) | vars(subject.limits) | vars(subject.arm) | {"limits": astuple(subject.limits), "home": subject.home}
    for name in MODEL.names or ():
        if name in values:
            out[name] = values[name]
    out["home_covariance"] = np.diag(np.repeat(np.square(subject.spread), 3))
    return out


def sense_models(senses: Sequence[Sense]) -> NDArray[np.void]:
    """The SENSE_MODEL of every sense (n,). Raises ValueError for a gate that is not in `chi_square.QUANTILES`."""
    out = np.zeros(len(senses), SENSE_MODEL)
    for record, sense in zip(out, senses, strict=True):
        for name in ("lasting", "time_constant", "floor", "typical", "sure"):
            record[name] = getattr(sense.errors, name)
        record["threshold"] = [[quantile(share, max(rank, 1)) for rank in range(POSE + 1)] for share in sense.errors.gate]
    return out
