"""Settings of the default observer, and the records that its compiled filter (`filter.py`) reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from penumbra.services.fusion.estimate import Array, Limits
from penumbra.services.fusion.records import MODEL, POSE, SENSE_MODEL
from penumbra.shared.chi_square import quantile
from penumbra.shared.contract.senses import Sense


@dataclass(frozen=True)
class Settings:
    """Numbers of the filter, with the reasons for their defaults. Those of a sense are in `shared/contract/senses.py`.

    acceleration : density of the white acceleration, linear [m^2/s^3] and angular [rad^2/s^3]: an arm that reaches 0.25 m/s.
    velocity_time : after which a velocity is forgotten [s]: limbs reach to places and stop there.
    velocity_spread : standard deviation of an unknown velocity, linear [m/s] and angular [rad/s].
    agility : bounds of the factors on `acceleration` that are learned: from a resting arm to a hand at 2 m/s.
    doubt : largest factor on the covariance of a sense that is learned.
    learning : step of all of them per measurement, at most, and per second.
    patience : after refusing everything of all senses for so long [s], start again from the newest measurement.
    source_patience : after refusing one sense for so long [s] while another is believed, doubt the state.
    agreement_time : age [s] up to which the last measurement of another sense decides whether a surprising one is an outlier.
    refusals : and at least so many measurements refused, so that two outliers after a pause do not count as persistence.
    unobserved : a direction with a standard deviation beyond this, in UNITS, is taken as not observed.
    horizon : length of the history [s]: vision is 30 to 100 ms late, more when the machine is busy.
    capacity : measurements that the history holds at most, for each sense on average: that of two is twice what 100 Hz and 20 Hz
        bring within the horizon. A storm of measurements shortens the history and costs no memory.
    weight_time : over which a source's weight remembers [s].
    """

    acceleration: tuple[float, float] = (0.1, 1.5)
    velocity_time: float = 0.35
    velocity_spread: tuple[float, float] = (0.4, 1.0)
    agility: tuple[float, float] = (0.08, 30.0)
    doubt: float = 100.0
    learning: tuple[float, float] = (0.1, 5.0)
    patience: float = 0.5
    source_patience: float = 1.0
    agreement_time: float = 0.25
    refusals: int = 5
    unobserved: float = 2.0
    horizon: float = 1.0
    capacity: int = 128
    weight_time: float = 0.5
    limits: Limits = Limits()


def model(settings: Settings, home: Array, spread: tuple[float, float]) -> NDArray[np.void]:
    """A MODEL of a target expected at the pose home (4, 4) with standard deviations spread (position [m], rotation [rad])."""
    out = np.zeros((), MODEL)
    values = vars(settings) | {"lost_age": settings.limits.lost_age, "limits": astuple(settings.limits), "home": home}
    for name in MODEL.names or ():
        if name in values:
            out[name] = values[name]
    out["home_covariance"] = np.diag(np.repeat(np.square(spread), 3))
    return out


def sense_models(senses: Sequence[Sense]) -> NDArray[np.void]:
    """The SENSE_MODEL of every sense (n,). Raises ValueError for a gate that is not in `chi_square.QUANTILES`."""
    out = np.zeros(len(senses), SENSE_MODEL)
    for record, sense in zip(out, senses, strict=True):
        for name in ("lasting", "time_constant", "floor"):
            record[name] = getattr(sense.errors, name)
        record["threshold"] = [[quantile(share, max(rank, 1)) for rank in range(POSE + 1)] for share in sense.errors.gate]
    return out
