"""The person whose limb is felt: the limb's size, and where the shoulder is.

The size changes only with the person. It is learned close to the pads, where it can be separated from the pose. Farther away,
where it would drift with the field model's errors, its uncertainty is only considered (a Schmidt filter). So is that of the
shoulder, which `drift` learns while a camera sees the limb.
"""

from __future__ import annotations

import math

import numpy as np

from penumbra.services.haptics.solve import UNKNOWNS, marginal
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


class Person:
    """The person of a limb, as a body (5,): log length, log girth, and the offset of the shoulder from where the posture has it
    [m]. mean (5,), information (5, 5): what is known of it. measured: whether the cell file states this person's size;
    shoulder_spread [m]: standard deviation of the offset along each axis."""

    def __init__(self, measured: bool, shoulder_spread: float) -> None:
        self._usual = np.array([*(np.zeros(2) if measured else SIZE), 0.0, 0.0, 0.0])
        self._spread = np.array([*(SIZE_MEASURED if measured else SIZE_SPREAD), *np.full(3, shoulder_spread)])
        self.mean, self.information = self._usual.copy(), np.diag(1.0 / self._spread**2)

    def forget(self) -> None:
        """Forget the learned size: the next limb may be another person's."""
        self.mean[:2], self.information[:2, :2] = self._usual[:2], np.diag(1.0 / self._spread[:2] ** 2)

    @property
    def usual(self) -> tuple[Array, Array]:
        """Mean and standard deviations (5,) between people."""
        return self._usual, self._spread

    @property
    def size(self) -> Array:
        """Log length and log girth (2,)."""
        return self.mean[:2]

    @property
    def strangeness(self) -> float:
        """Distance of the size from the usual one, in standard deviations between people."""
        return float(np.linalg.norm((self.size - self._usual[:2]) / SIZE_SPREAD))

    def predict(self, elapsed_s: float, shoulder: tuple[Array, Array]) -> None:
        """Decay the learned size towards the usual one. shoulder: offset (3,) [m] and covariance (3, 3) as known now."""
        keep = math.exp(-elapsed_s / SIZE_MEMORY_S)
        covariance = keep**2 * _inverse(self.information[:2, :2]) + (1.0 - keep**2) * np.diag(self._spread[:2] ** 2)
        self.mean = np.concatenate([self._usual[:2] + keep * (self.size - self._usual[:2]), shoulder[0]])
        self.information[:2, :2], self.information[2:, 2:] = _inverse(covariance), np.linalg.inv(shoulder[1])

    def learn(self, body: Array, information: Array, gradient: Array, pose_information: Array) -> None:
        """Learn the size from a window's likelihood (11, 11), (11,) by pose and body at a solution of this body (5,);
        pose_information (6, 6): prior information on the pose."""
        information, gradient = information.copy(), gradient.copy()
        information[:6, :6] += pose_information
        information[8:, 8:] += self.information[2:, 2:]
        gradient[8:] += self.information[2:, 2:] @ (self.mean - body)[2:]
        left, pull = marginal(information, gradient, np.delete(np.eye(UNKNOWNS), (6, 7), axis=1))
        known = self.information[:2, :2]
        total = known + left[6:8, 6:8]
        self.mean[:2] = body[:2] + _inverse(total) @ (known @ (self.mean - body)[:2] + pull[6:8])
        self.information[:2, :2] = total

    def marginalised(self, information: Array, gradient: Array, body: Array, lasting: float = 1.0) -> tuple[Array, Array]:
        """Information (6, 6) and gradient (6,) of the pose, from a likelihood (11, 11), (11,) by pose and body at a solution of
        this body (5,), with the body marginalised. lasting: factor on the body's covariance, because its error is the same in
        many windows."""
        known, across = self.information / lasting, information[:6, 6:]
        share = np.linalg.solve(information[6:, 6:] + known, across.T).T
        pull = gradient[6:] + known @ (self.mean - body)
        return information[:6, :6] - share @ across.T, gradient[:6] - share @ pull


def _inverse(matrix: Array) -> Array:
    """Inverse of a symmetric positive definite matrix (2, 2)."""
    (a, b), (_, c) = matrix.tolist()
    return np.array([[c, -b], [-b, a]]) / (a * c - b * b)
