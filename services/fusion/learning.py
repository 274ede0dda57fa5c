"""Learns how the limbs of a recording move: the motion that makes its measurements most likely.

The likelihood is that of the innovations of the observer's own filter, without gates, over the measurements that pass its gates
forwards or backwards in time. The settings in `MOTION` are learned; the agility adapts to the innovations as usual.

Source: Schweppe, "Evaluation of likelihood functions for Gaussian signals" (1965), DOI 10.1109/TIT.1965.1053737; the simplex of
Nelder and Mead (1965), DOI 10.1093/comjnl/7.4.308.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from penumbra.services.fusion import records
from penumbra.services.fusion.estimate import Array
from penumbra.services.fusion.records import POSE
from penumbra.services.fusion.settings import MOTION, FusionSettings
from penumbra.services.fusion.smoother import BLOCK, Filter, NothingMeasuredError, Smoother

PIECE = 2048
"""Number of measurements after which the filter starts over: it bounds the memory for their covariances."""
LEAST = 50
"""Minimum number of measurements to learn from: some seconds of vision. Chosen, not measured; a minute or more is better."""
STEPS = 400
"""Maximum number of likelihoods that are computed. Chosen: five numbers settle to a hundredth within two hundred."""
MOST_DAMPED = 0.99
"""Maximum damping ratio that is learned: at one, where a limb at rest would lead, the motion is no oscillation any more and
`motion.py` has no solution."""


@dataclass(frozen=True)
class Learned:
    """settings : with the learned motion. measurements : number of measurements that it was learned from. gain : increase [nats]
    of their mean log-likelihood over the settings before."""

    settings: FusionSettings
    measurements: int
    gain: float

    def described(self) -> dict[str, Any]:
        """The entries of its file."""
        return {name: getattr(self.settings, name) for name in MOTION} | {"measurements": self.measurements, "gain": self.gain}


def learned(smoothers: Sequence[Smoother], settings: FusionSettings | None = None) -> Learned:
    """The motion of all targets whose measurements the smoothers have. Raises NothingMeasuredError if fewer than LEAST can be
    used."""
    settings = settings or FusionSettings()
    pieces = [
        (smoother, segment[first : first + PIECE])
        for smoother in smoothers
        for segment in smoother.segments()
        for first in range(0, len(segment), PIECE)
    ]
    count = sum(len(piece) - 1 for _, piece in pieces)
    if count < LEAST:
        raise NothingMeasuredError(f"motion: expected {LEAST} measurements or more to learn from, got {count}; record for longer")

    def cost(x: Array) -> float:
        tried = _settings(settings, x)
        return -sum(log_likelihood(smoother.filter(tried), piece) for smoother, piece in pieces) / count

    from scipy.optimize import minimize  # imported here, because replaying does not need it

    begin = _numbers(settings)
    found = minimize(cost, begin, method="Nelder-Mead", options={"maxfev": STEPS, "xatol": 0.01, "fatol": 1e-5})
    return Learned(_settings(settings, found.x), count, cost(begin) - float(found.fun))


def log_likelihood(filter: Filter, measurements: NDArray[np.void]) -> float:
    """Log-likelihood [nats] of measurements (k,) except the first, each given those before it, up to a constant."""
    states, total = filter.run(measurements, np.zeros((len(measurements), 2))), 0.0
    for begin in range(0, len(measurements) - 1, BLOCK):
        after = slice(begin + 1, min(begin + BLOCK, len(measurements) - 1) + 1)
        now = measurements[after]
        predicted, _, _ = filter.moved(states.of(slice(begin, after.stop - 1)), now["stamp_ns"].copy())
        z, H, white = filter.linearised(now, predicted)
        first = records.MOTION + POSE * now["source"][:, None] + np.arange(POSE)
        rows = np.concatenate([np.broadcast_to(np.arange(POSE), first.shape), first], axis=1)
        P = np.take_along_axis(np.take_along_axis(predicted.P, rows[:, :, None], 1), rows[:, None, :], 2)
        S = H @ P @ H.transpose(0, 2, 1) + white[:, :, None] * np.eye(POSE)
        total -= 0.5 * float(np.sum(z * np.linalg.solve(S, z[:, :, None])[:, :, 0]) + np.linalg.slogdet(S)[1].sum())
    return total


def _numbers(settings: FusionSettings) -> Array:
    """The learned fields as unbounded numbers (5,)."""
    share = settings.damping / MOST_DAMPED
    return np.append(np.log([*settings.jerk, *settings.motion_time]), math.log(share / (1.0 - share)))


def _settings(settings: FusionSettings, x: Array) -> FusionSettings:
    """The inverse of `_numbers`."""
    a, b, c, d = np.exp(x[:4]).tolist()
    return replace(settings, jerk=(a, b), motion_time=(c, d), damping=MOST_DAMPED / (1.0 + math.exp(-float(x[4]))))
