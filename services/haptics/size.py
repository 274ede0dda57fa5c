"""Estimates the size of the limb, which changes only with the person.

It is learned close to the pads, where it can be separated from the pose. Farther away, where it would drift with the field
model's errors, its uncertainty is only considered (a Schmidt filter).
"""

from __future__ import annotations

import math

import numpy as np

from penumbra.services.haptics.solve import marginal
from penumbra.shared.body.anatomy import SIZE, SIZE_MEASURED, SIZE_SPREAD
from penumbra.shared.geometry.rigid import Array

SIZE_GAP = 0.06
"""Maximum gap [m] at which the size is learned. Farther away it is only considered (see above)."""
SIZE_MEMORY_S = 20.0
"""Time constant [s] with which the learned size decays to the average one."""
SIZE_LASTING = 200.0
"""Number of windows in which the field model makes about the same error while a limb rests. When the size is learned, the error's
variance is multiplied by it."""
PERSON_S = 5.0
"""Time [s] without a limb in range after which the next limb may be another person's."""


class Size:
    """Size of the limb. mean (2,): log length and log girth; information (2, 2). measured: whether the cell file states this
    person's size."""

    def __init__(self, measured: bool = False) -> None:
        self._usual: Array = np.zeros(2) if measured else SIZE
        self._spread: Array = SIZE_MEASURED if measured else SIZE_SPREAD
        self.forget()

    def forget(self) -> None:
        """Forget the learned size: the next limb may be another person's."""
        self.mean, self.information = self._usual.copy(), np.diag(1.0 / self._spread**2)

    @property
    def usual(self) -> tuple[Array, Array]:
        """Mean and standard deviations (2,) between people."""
        return self._usual, self._spread

    @property
    def strangeness(self) -> float:
        """Distance of the mean from the usual size, in standard deviations between people."""
        return float(np.linalg.norm((self.mean - self._usual) / SIZE_SPREAD))

    def predict(self, elapsed_s: float) -> None:
        """Decay the learned size towards the usual one."""
        keep = math.exp(-elapsed_s / SIZE_MEMORY_S)
        covariance = keep**2 * _inverse(self.information) + (1.0 - keep**2) * np.diag(self._spread**2)
        self.mean = self._usual + keep * (self.mean - self._usual)
        self.information = _inverse(covariance)

    def learn(self, size: Array, information: Array, gradient: Array, pose_information: Array) -> None:
        """Add a window's likelihood (8, 8), (8,) by pose and size at a solution of this size (2,); pose_information (6, 6): prior
        information on the pose."""
        information = information.copy()
        information[:6, :6] += pose_information
        left, pull = marginal(information, gradient, np.eye(8)[:, :6])
        total = self.information + left[6:, 6:]
        self.mean = size + _inverse(total) @ (self.information @ (self.mean - size) + pull[6:])
        self.information = total

    def marginalised(self, information: Array, gradient: Array, size: Array, lasting: float = 1.0) -> tuple[Array, Array]:
        """Information (6, 6) and gradient (6,) of the pose, from a likelihood (8, 8), (8,) by pose and size at a solution of this
        size (2,), with the size marginalised. lasting: factor on the size's covariance, because its error is the same in many
        windows."""
        known, across = self.information / lasting, information[:6, 6:]
        share = across @ _inverse(information[6:, 6:] + known)
        pull = gradient[6:] + known @ (self.mean - size)
        return information[:6, :6] - share @ across.T, gradient[:6] - share @ pull


def _inverse(matrix: Array) -> Array:
    """Inverse of a symmetric positive definite matrix (2, 2)."""
    (a, b), (_, c) = matrix.tolist()
    return np.array([[c, -b], [-b, a]]) / (a * c - b * b)
