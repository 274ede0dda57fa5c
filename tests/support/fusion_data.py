"""Limbs, senses and their errors for the tests of fusion."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from penumbra.services.fusion.observer import ErrorStateObserver
from penumbra.services.fusion.paper import PaperObserver
from penumbra.services.fusion.records import UNITS
from penumbra.services.fusion.settings import FusionSettings
from penumbra.shared.contract import senses
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

T0_NS = 1_700_000_000_000_000_000
HOME = rigid.from_rpy([0.0, 0.0, 0.2], [0.0, 0.0, 0.0])
SPREAD = (0.12, 0.4)
VISION = np.diag(1.0 / np.square([0.01, 0.01, 0.01, 0.03, 0.03, 0.03]))
"""Information (6, 6) of a camera's pose."""
SKIN = [0.006, 0.003, 0.002, 1.0, 0.02, 0.03]
"""Standard deviations [m, rad] of a haptic pose along and about the limb's axes."""
STEP = np.array([0.02, -0.01, 0.03, 0.0, 0.2, -0.6])
"""Pose error (6,) from where a likelihood was linearised to its peak."""
NO_ROLL = np.diag([1.0, 1.0, 1.0, 0.0, 1.0, 1.0])


def ns(seconds: float) -> int:
    """The stamp [ns] of a time [s]."""
    return T0_NS + round(seconds * 1e9)


def still(observer: ErrorStateObserver | PaperObserver, T: Array, begin: float, end: float, information: Array = VISION) -> None:
    """Perfect vision of a limb that rests at T, at 20 Hz."""
    for t in np.arange(begin, end, 0.05):
        observer.measure("vision", ns(t), T, information, 0.0)


class Errors:
    """A sense's pose errors: a lasting and a white part, zero in directions that are not observed."""

    def __init__(self, errors: senses.Errors, period: float, rng: np.random.Generator):
        self._errors, self._rng = errors, rng
        self._keep = np.exp(-period / errors.time_constant)
        self._bias = rng.normal(size=6)

    def draw(self, seen: Array) -> Array:
        """An error (6,) for a measurement of information (6, 6)."""
        self._bias = self._keep * self._bias + np.sqrt(1 - self._keep**2) * self._rng.normal(size=6)
        w, V = np.linalg.eigh(seen * np.outer(UNITS, UNITS))
        of = self._errors
        variances = np.where(w > 1e-6, 1.0 / np.abs(w), 0.0)
        share = of.typical + (1.0 - of.typical) * variances / (variances + of.sure**2)
        root = (V * np.sqrt(share * variances)) @ V.T
        white = self._rng.normal(size=6)
        lasting = self._errors.lasting
        return UNITS * (root @ (np.sqrt(lasting) * self._bias + np.sqrt(1 - lasting) * white))


def motion(dt: float, settings: FusionSettings) -> tuple[Array, Array]:
    """Transition and process noise (3, 3) of position, velocity and acceleration along one axis over dt [s], by Van Loan,
    "Computing integrals involving the matrix exponential" (1978), DOI 10.1109/TAC.1978.1101743."""
    w = 1.0 / settings.motion_time[0]
    rates = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -(w**2), -2.0 * settings.damping * w]])
    both = np.zeros((6, 6))
    both[:3, :3], both[3:, 3:] = -rates, rates.T
    both[2, 5] = settings.jerk[0]
    powers = expm(dt * both)
    F = powers[3:, 3:].T
    return F, F @ powers[:3, 3:]


def without_roll(T: Array, sigma: list[float]) -> Array:
    """Information (6, 6) of a measurement without roll, with these standard deviations along the limb's axes."""
    B = np.kron(np.eye(2), T[:3, :3])
    return B @ NO_ROLL @ np.diag(1.0 / np.square(sigma)) @ B.T
