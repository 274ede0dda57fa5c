"""Whether what is felt is a limb: the odds of a limb against anything else, added up over windows.

A limb leaves residuals of the size of noise and of the field model's error. Another thing leaves a share of its signal as well,
which its shape, its size or its missing way to ground decides: 3 to 50 % at 4 cm, and less beyond, where only the largest
features of a shape are felt. What is left is nearly the same in windows that follow each other, while noise is not. So each
hypothesis expects of every electrode a share that changes slowly (an Ornstein-Uhlenbeck process, followed by a Kalman filter),
and each window adds the log likelihoods of its innovations: a sequential probability ratio test (Wald 1945, DOI
10.1214/aoms/1177731118). Where noise hides the share, the likelihoods are alike: the odds do not move, and what is not decided
yet stays unidentified. A camera that has just seen the limb where it is felt decides as well.
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
"""Standard deviations of what another thing leaves unexplained within SHARES_GAP, as shares of the signal, equally probable.
Measured: residuals of metal and plastic things in the full field model, see `penumbra bench haptics`. The smallest one makes a
limb certain only where the field model is surer than that: where few pads feel a thing, as on a robot's hull, a tube leaves no
more than a limb."""
SHARES_GAP = 0.04
"""Gap [m] beyond which these shares fall with its power SHARES_POWER. Measured on grounded metal, from 4 to 12 cm."""
SHARES_POWER = 1.5
ERRORS = np.array([1.0, 2.5, 5.0])
"""The field model's error at a limb, in standard deviations of all its errors, and ERRORS_ODDS: their probabilities. Measured: at
pads that feel little, and at odd poses, the model errs more."""
ERRORS_ODDS = np.log([0.75, 0.2, 0.05])
TIMES = np.concatenate([ERRORS, np.ones(1 + len(SHARES))])[:, None]
"""The field model's error at a limb, a fault and other things, likewise."""
FAULTY = 0.01
"""Probability that an electrode is faulty, whatever is felt, and that a pad beside a limb is: their shares are then one."""

SURE = 0.5
"""Largest mean error of the field model, in smallest SHARES, with which the skin alone calls something a limb. Chosen: on the
robot's hull, where the model errs by as much as such a thing, a grounded bar was called a limb; there a camera must see it."""

Verdict = Literal["limb", "object", "unidentified"]


class Identity:
    """odds: the log odds of a limb against anything else. error (n,): standard deviation of the field model's error, as a share
    of the signal."""

    def __init__(self, skin: Skin, error: Array, settings: HapticSettings):
        self._pads, self._electrodes, self._settings = skin.first[:-1], len(error), settings
        is_sure = float(error.mean()) < SURE * SHARES[0]
        self._becomes_limb = settings.limb_odds if is_sure else np.inf
        self.forget()

    def forget(self) -> None:
        """Something else may come."""
        self._absent_s, self._is_limb = 0.0, False
        self._begin(0.0)

    def _begin(self, odds: float) -> None:
        """Starts from log odds."""
        rows = len(ERRORS) + 1 + len(SHARES)  # limbs, a fault, other things
        self._likelihood = np.zeros((rows, self._electrodes))  # log likelihoods, beside the first row's
        self._mean, self._variance = np.zeros((rows, self._electrodes)), np.ones((rows, self._electrodes))
        self._likelihood[-len(SHARES) :] = -odds / self._electrodes
        self.odds = odds

    @property
    def verdict(self) -> Verdict:
        """What is felt, as far as it is decided. A limb is one until the odds have turned."""
        if self._is_limb:
            return "limb"
        return "object" if self.odds <= -self._settings.object_odds else "unidentified"

    def see(self) -> None:
        """A camera has just seen the limb where it is felt."""
        self._is_limb = True
        if self.odds < self._settings.seen_odds:
            self._begin(self._settings.seen_odds)

    def refuse(self) -> None:
        """No limb has the size that was learnt."""
        self._is_limb = False
        if self.odds > -self._settings.object_odds:
            self._begin(-self._settings.object_odds)

    def doubt(self) -> None:
        """The limb is at another place than was thought: what spoke against a limb there says nothing."""
        self._begin(0.0)

    def take(self, reading: Reading, solution: Solution, free: Array, gap: float, elapsed_s: float) -> None:
        """Takes a window, the limb that explains it best, the share (n,) of errors that this leaves in the residuals (see
        `Solver.free`), its gap [m], and the seconds since the last window."""
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
        """Nothing was near for so many more seconds."""
        self._absent_s += elapsed_s
        if self._absent_s > self._settings.absent_s:
            self.forget()

    def _innovation(self, reading: Reading, solution: Solution, free: Array, gap: float, elapsed_s: float) -> Array:
        """The log likelihoods (rows, n) of a window's residuals, beside those of the first row."""
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
