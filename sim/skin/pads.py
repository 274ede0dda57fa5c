"""Readings of the pads: how a limb changes the capacitance of their electrodes, and the resulting amplitudes.

The changes come from the networks that stand for the boundary-element field (`shared.skin.response`): eight pads at 1 kHz take a
few per cent of a core, with the factors by which the person's upper arm and torso change them. The changes by the robot's other
links are added, as if the limb did not shade them. Other pads are not modelled.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from penumbra.shared.cell import description as cells
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import Response


class SkinModel:
    """The pads of a cell before one of its targets, n electrodes in all, in the order of `shared.skin.layout.Skin` (`.skin`)."""

    def __init__(self, cell: cells.Cell, target: str):
        self.skin = Skin(cell)
        self._response = Response(cell, target)

    def person(self, T_world_pads: Array, T_world_parts: Sequence[Array]) -> Array:
        """Changes of capacitance (n,) [fF] by the target's person, for pads (p, 4, 4). T_world_parts (4, 4): the target, and the
        upper arm and torso if it has them."""
        return self._response.person(T_world_pads, T_world_parts)

    def rest(self, joints: ArrayLike) -> Array:
        """Changes (n,) [fF] by the robots at all their joint angles (j,)."""
        return self._response.rest(joints)

    def volts(self, change: ArrayLike, rng: np.random.Generator) -> Array:
        """Amplitudes (..., n) [V] of samples of a millisecond, for changes (..., n) [fF]: signal chain, white noise of the
        calibrated variance, clipping at full scale. The hundred cycles of a sample average out the converter's quantisation."""
        skin = self.skin
        noisy = skin.amplitude(change) + np.sqrt(skin.noise) * rng.standard_normal(np.shape(change))
        return np.clip(noisy, 0.0, skin.full_scale)
