"""Whether something touches pads, or closes around what carries them, by the points of surfaces before them.

The field model holds from 3 mm on, and a converter ends where a forearm comes within 5 mm: what is nearer than TOUCH counts as
touching. A pad that is touched stays so until it is farther than RELEASE, and a grip needs touched pads of one link that look
in opposite directions.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from penumbra.services.haptics.surface_points import SurfacePoint
from penumbra.shared.contract.messages import ContactState
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.layout import Skin

TOUCH, RELEASE = 0.005, 0.010
"""Gaps [m] of a surface to a pad's board below which the pad is touched, and above which it no longer is. Measured: see
`penumbra bench haptics --only-surface`."""
OPPOSITE = -0.5
"""Largest cosine of the angle between the normals of two touched pads of one link that are held: 120 degrees apart or more."""


class Contact:
    """The pads of a skin that are touched. touched: their names, in the skin's order."""

    def __init__(self, skin: Skin):
        self._place = {name: k for k, name in enumerate(skin.pads)}
        self._links = np.array(skin.links)
        self.forget()

    def forget(self) -> None:
        """Nothing touches."""
        self.touched: tuple[str, ...] = ()

    def take(self, points: Iterable[SurfacePoint], T_world_pads: Array) -> ContactState:
        """The state after a window with these points, with the pads at T_world_pads (p, 4, 4)."""
        near = [p.pad for p in points if p.gap < (RELEASE if p.pad in self.touched else TOUCH)]
        self.touched = tuple(sorted(near, key=self._place.__getitem__))
        if not near:
            return "none"
        own = [self._place[pad] for pad in near]
        normals = T_world_pads[own, :3, 2]
        held = (normals @ normals.T < OPPOSITE) & (self._links[own][:, None] == self._links[own])
        return "grip" if held.any() else "touch"
