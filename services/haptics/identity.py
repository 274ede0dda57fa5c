"""Decides whether the object that is felt is a limb, from the odds of a limb against anything else over successive windows.

A limb leaves residuals of the size of noise and of the field model's error. Another object also leaves a share of its signal,
which depends on its shape, its size and its grounding: 3 to 50 % at 4 cm, and less beyond, where only the largest features of a
shape are felt. This share is nearly the same in successive windows, while noise is not. Each hypothesis therefore expects of
every electrode a share that changes slowly (an Ornstein-Uhlenbeck process in a Kalman filter), and each window adds the log
likelihoods of its innovations: a sequential probability ratio test (Wald 1945, DOI 10.1214/aoms/1177731118). Where noise hides
the share, the likelihoods are alike: the odds do not change, and an undecided object stays unidentified. A camera that has just
seen the limb where it is felt also decides.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from penumbra.services.haptics.settings import HapticSettings
from penumbra.services.haptics.solve import NEAR_ERROR, NEAR_SIGNAL, Reading, Solution
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.layout import Skin

SHARES = np.array([0.01, 0.03, 0.1, 0.3])
"""Standard deviations of the share of the signal that another object leaves unexplained within SHARES_GAP; all are equally
probable. Measured: residuals of metal and plastic objects in the full field model, see `penumbra bench haptics`. The smallest one
identifies a limb only if the field model's error is smaller: where few pads feel an object, as on a robot's hull, a tube leaves
no more than a limb."""
SHARES_GAP = 0.04
"""Gap [m] beyond which these shares fall as its power SHARES_POWER. Measured on grounded metal, from 4 to 12 cm."""
SHARES_POWER = 1.5
ERRORS = np.array([1.0, 2.5, 5.0])
"""The field model's error at a limb, in standard deviations of all its errors; ERRORS_ODDS are the logs of their probabilities.
Measured: the model errs more at pads that feel little and at unusual poses."""
ERRORS_ODDS = np.log([0.75, 0.2, 0.05])
TIMES = np.concatenate([ERRORS, np.ones(1 + len(SHARES))])[:, None]
"""The field model's error, in the same unit, per hypothesis: limbs, a fault, other objects."""
FAULTY = 0.01
"""Probability that an electrode is faulty, whatever is felt, and that a pad beside a limb is. A fault leaves a share of one."""

SURE = 0.5
"""Maximum mean error of the field model, in units of the smallest of SHARES, with which the skin alone may identify a limb.
Chosen: on the robot's hull, where the model's error is as large as such a share, a grounded bar was called a limb; there a camera
must see it."""

Verdict = Literal["limb", "object", "unidentified"]


class Identity:
    """Log odds of a limb against any other object (odds). error (n,): standard deviation of the field model's error, as a share
    of the signal."""

    def __init__(self, skin: Skin, error: Array, settings: HapticSettings):
        self._pads, self._electrodes, self._settings = skin.first[:-1], len(error), settings
        is_sure = float(error.mean()) < SURE * SHARES[0]
        self._becomes_limb = settings.limb_odds if is_sure else np.inf
        self.forget()

    def forget(self) -> None:
        """Reset: the next object may be another one."""
        self._absent_s, self._is_limb = 0.0, False
        self._begin(0.0)

    def _begin(self, odds: float) -> None:
        """Start from the given log odds."""
        rows = len(ERRORS) + 1 + len(SHARES)  # limbs, a fault, other things
        self._likelihood = np.zeros((rows, self._electrodes))  # log likelihoods, less the first row's
        self._mean, self._variance = np.zeros((rows, self._electrodes)), np.ones((rows, self._electrodes))
        self._likelihood[-len(SHARES) :] = -odds / self._electrodes
        self.odds = odds

    @property
    def verdict(self) -> Verdict:
        """The object's identity, as far as it is decided. A limb stays one until the odds fall below zero."""
        if self._is_limb:
            return "limb"
        return "object" if self.odds <= -self._settings.object_odds else "unidentified"

    def see(self) -> None:
        """A camera has just seen the limb where it is felt."""
        self._is_limb = True
        if self.odds < self._settings.seen_odds:
            self._begin(self._settings.seen_odds)

    def refuse(self) -> None:
        """The learned size is impossible for a limb."""
        self._is_limb = False
        if self.odds > -self._settings.object_odds:
            self._begin(-self._settings.object_odds)

    def doubt(self) -> None:
        """The limb is at another place than assumed: evidence against a limb at the old place no longer counts."""
        self._begin(0.0)

    def take(self, reading: Reading, solution: Solution, free: Array, gap: float, elapsed_s: float) -> None:
        """Add a window, its best limb solution, the share (n,) of errors that stays in the residuals (see `Solver.free`), the gap
        [m], and the seconds since the last window."""
        settings = self._settings
        self._absent_s = 0.0
        added = self._innovation(reading, solution, free, gap, elapsed_s)
        before = self._likelihood * math.exp(-elapsed_s / settings.odds_memory_s)
        odds, most = self._odds(before), settings.odds_rate * elapsed_s
        self._likelihood = before + added
        self.odds = self._odds(self._likelihood)
        if abs(step := self.odds - odds) > most:
            self._likelihood = before + added * (most / abs(step))
            self.odds = self._odds(self._likelihood)
        self._likelihood *= min(1.0, settings.most_odds / max(abs(self.odds), 1e-9))
        self._is_limb = self.odds >= (0.0 if self._is_limb else self._becomes_limb)

    def miss(self, elapsed_s: float) -> None:
        """Nothing was near for another elapsed_s seconds."""
        self._absent_s += elapsed_s
        if self._absent_s > self._settings.absent_s:
            self.forget()

    def _innovation(self, reading: Reading, solution: Solution, free: Array, gap: float, elapsed_s: float) -> Array:
        """The log likelihoods (rows, n) of a window's residuals, less those of the first row."""
        signal = np.maximum(np.maximum(reading.signal, solution.signal), 0.0)
        used = np.isfinite(reading.variance)
        noise = np.where(used, reading.variance, 1.0)
        others = SHARES * min(1.0, SHARES_GAP / max(gap, SHARES_GAP)) ** SHARES_POWER
        share = np.concatenate([0.0 * ERRORS, [1.0], others])[:, None]
        model = TIMES * (reading.error + NEAR_ERROR * signal / NEAR_SIGNAL)
        scale = np.sqrt(free * (model**2 + share**2) * signal**2 + reading.doubt**2)
        keep = math.exp(-elapsed_s / self._settings.share_memory_s)
        mean, variance = keep * self._mean, 1.0 - keep**2 * (1.0 - self._variance)
        total = scale**2 * variance + noise
        innovation = reading.signal - solution.signal - scale * mean
        gain = np.where(used, variance * scale / total, 0.0)
        self._mean, self._variance = mean + gain * innovation, variance * (1.0 - gain * scale)
        log = np.where(used, -0.5 * (np.log(total) + innovation**2 / total), 0.0)
        return np.asarray(log - log[0])

    def _odds(self, likelihood: Array) -> float:
        n = len(ERRORS)
        well, ill = math.log(1.0 - FAULTY), math.log(FAULTY)
        by_electrode = np.logaddexp(well + likelihood, ill + likelihood[n])
        by_pad = np.add.reduceat(by_electrode[:n], self._pads, axis=1)
        faulty = np.add.reduceat(likelihood[n], self._pads)
        limb = np.logaddexp.reduce(ERRORS_ODDS + np.logaddexp(well + by_pad, ill + faulty).sum(axis=1))
        other = np.logaddexp.reduce(by_electrode[n + 1 :].sum(axis=1)) - math.log(len(SHARES))
        return float(limb - other)
