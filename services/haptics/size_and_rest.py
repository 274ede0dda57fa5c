"""What changes slowly beside the pose: the size of the limb, and the rest of every electrode.

Both are learnt only where they can be told from the pose: the size close to the pads, and only considered farther away (a Schmidt
filter), where it would drift with what the model gets wrong; rests while nothing is near.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from penumbra.services.haptics.solve import marginal
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.response import SIZE, SIZE_MEASURED, SIZE_SPREAD

SIZE_GAP = 0.06
"""Largest gap [m] at which the size is learnt. Farther away the size is only considered (see above)."""
SIZE_MEMORY_S = 20.0
"""Time constant [s] with which the learnt size decays to the average one."""
SIZE_LASTING = 200.0
"""Number of windows in which the field model makes about the same error while a limb rests: for the size, its variance is
multiplied by it."""
PERSON_S = 5.0
"""Time [s] without a limb in range after which the next one may be another person's."""
TARE_S = 10.0
"""Time constant [s] with which the rests follow the voltages."""
QUIET_S = 3.0
"""Time [s] for which nothing may have been in range before the rests follow."""
STEADY = 3.0
"""Distance of a signal from its smoothed value, in standard deviations, above which the electrode counts as moved: the rests
follow only while at most a tenth of the electrodes has moved."""
SMOOTH_S = 1.0
"""Time constant [s] of the smoothed signals."""
FARTHEST_TARE = 0.02
"""Largest correction of a rest [V]. A rest that is farther off is a fault and no drift."""


class Size:
    """mean (2,): log length and log girth; information (2, 2). measured: whether the cell file states this person's size."""

    def __init__(self, measured: bool = False) -> None:
        self._usual: Array = np.zeros(2) if measured else SIZE
        self._spread: Array = SIZE_MEASURED if measured else SIZE_SPREAD
        self.forget()

    def forget(self) -> None:
        """Another person may come."""
        self.mean, self.information = self._usual.copy(), np.diag(1.0 / self._spread**2)

    @property
    def strangeness(self) -> float:
        """How far the mean is from a usual one, in standard deviations between people."""
        return float(np.linalg.norm((self.mean - self._usual) / SIZE_SPREAD))

    def predict(self, elapsed_s: float) -> None:
        """What was learnt fades."""
        keep = np.exp(-elapsed_s / SIZE_MEMORY_S)
        covariance = keep**2 * np.linalg.inv(self.information) + (1.0 - keep**2) * np.diag(self._spread**2)
        self.mean = self._usual + keep * (self.mean - self._usual)
        self.information = np.linalg.inv(covariance)

    def learn(self, size: Array, information: Array, gradient: Array, pose_information: Array) -> None:
        """Takes a window's likelihood (8, 8), (8,) by pose and size at a solution of this size (2,); pose_information (6, 6):
        what is known of the pose without it."""
        information = information.copy()
        information[:6, :6] += pose_information
        left, pull = marginal(information, gradient, np.eye(8)[:, :6])
        total = self.information + left[6:, 6:]
        self.mean = size + np.linalg.solve(total, self.information @ (self.mean - size) + pull[6:])
        self.information = total

    def marginalised(self, information: Array, gradient: Array, size: Array, lasting: float = 1.0) -> tuple[Array, Array]:
        """Information (6, 6) and gradient (6,) of the pose, from a likelihood (8, 8), (8,) by pose and size at a solution of this
        size (2,), after the size was marginalised. lasting: the factor on the covariance of what is known of the size, whose
        error is the same in many windows."""
        information, gradient = information.copy(), gradient.copy()
        information[6:, 6:] += self.information / lasting
        gradient[6:] += self.information @ (self.mean - size) / lasting
        information, gradient = marginal(information, gradient, np.eye(8)[:, 6:])
        return information[:6, :6], gradient[:6]


class Tare:
    """offset (n,) [V]: what the rests of the electrodes have moved by. noise (n,) [V^2]: of one sample."""

    def __init__(self, noise: Array):
        self._noise = noise
        self.offset = np.zeros(len(noise))
        self.forget()

    def forget(self) -> None:
        """Start to watch again; what was learnt stays."""
        self._quiet_s, self._smooth, self._weight = 0.0, np.zeros_like(self.offset), 0.0

    def update(self, signal: Array, samples: NDArray[np.integer], elapsed_s: float, in_range: bool) -> None:
        """Takes the signals (n,) [V] of a window, with the offset already subtracted, over so many samples (n,) each."""
        if in_range or not 0.0 < elapsed_s < 1.0:
            self.forget()
            return
        share = 1.0 - np.exp(-elapsed_s / SMOOTH_S)
        self._weight += share * (1.0 - self._weight)
        felt = samples > 0
        self._smooth += share * (np.where(felt, signal, 0.0) - self._smooth)
        mean = self._smooth / self._weight
        sigma = np.sqrt(self._noise / np.maximum(samples, 1) * 0.5 * elapsed_s / SMOOTH_S) + 2e-4
        if (np.abs(signal - mean) > STEADY * (sigma + np.sqrt(self._noise / np.maximum(samples, 1))) + 1e-3)[felt].mean() > 0.1:
            self.forget()  # something moves
            return
        self._quiet_s += elapsed_s
        if self._quiet_s > QUIET_S:
            step = (1.0 - np.exp(-elapsed_s / TARE_S)) * mean
            moved = np.where(felt & (np.abs(self.offset + step) < FARTHEST_TARE), step, 0.0)
            self.offset += moved
            self._smooth -= moved * self._weight
