"""Measures how well the voltages have been explained lately: of all pads together, and of each pad."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from penumbra.services.haptics.settings import HapticSettings
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.layout import Skin


class SmoothedMisfit:
    """A misfit, smoothed over windows. value: starts at one, that of explained voltages."""

    def __init__(self, settings: HapticSettings):
        self._share, self._cap = settings.misfit_share, settings.misfit_cap
        self.value = 1.0

    def after(self, misfit: float) -> float:
        """The value after a window of this misfit."""
        return self.value + self._share * (min(misfit, self._cap) - self.value)

    def take(self, misfit: float) -> None:
        """Add the misfit of a window."""
        self.value = self.after(misfit)


class PadTrust:
    """Trust in each pad. A pad that is mounted turned, or has another pad's calibration, fits worse than the others for as long
    as it is mounted, and loses weight."""

    def __init__(self, skin: Skin, settings: HapticSettings):
        self._skin, self._settings = skin, settings
        self.forget()

    def forget(self) -> None:
        """Trust all pads again."""
        self._misfit = np.ones(len(self._skin.pads))

    def distrust(self) -> Array:
        """Factor (n,) >= 1 on all variances of an electrode."""
        return np.asarray((np.maximum(1.0, self._misfit / self._settings.pad_misfit) ** 2)[self._skin.pad_of], np.float64)

    def update(self, residuals: Array, is_used: NDArray[np.bool_]) -> None:
        """Add the residuals (n,) of a window in standard deviations, zero for electrodes that are not in use (n,)."""
        squares = np.minimum(residuals**2, self._settings.pad_cap)
        used = np.maximum(np.add.reduceat(is_used.astype(float), self._skin.first[:-1]), 1.0)
        self._misfit += self._settings.pad_share * (np.add.reduceat(squares, self._skin.first[:-1]) / used - self._misfit)
