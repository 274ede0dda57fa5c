"""Detects touched pads, and grips around a link, from the nearest surface points.

The field model holds from 3 mm on, and a converter saturates where a forearm comes within 5 mm: a surface nearer than TOUCH
counts as touching. A touched pad stays touched until the surface is farther than RELEASE. A grip needs touched pads of one link
that face in opposite directions.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from penumbra.services.haptics.surface_points import SurfacePoint
from penumbra.shared.contract.messages import ContactState
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.layout import Skin

TOUCH, RELEASE = 0.005, 0.010
"""Gaps [m] between a surface and a pad's board: below TOUCH the pad becomes touched, above RELEASE it is released. Measured: see
`penumbra bench haptics --only-surface`."""
OPPOSITE = -0.5
"""Maximum cosine of the angle between the normals of two touched pads of one link that count as a grip: at least 120 degrees."""


class Contact:
    """Contact state of a skin's pads. touched: names of the touched pads, in the skin's order."""

    def __init__(self, skin: Skin):
        self._place = {name: k for k, name in enumerate(skin.pads)}
        self._links = np.array(skin.links)
        self.forget()

    def forget(self) -> None:
        """Release all pads."""
        self.touched: tuple[str, ...] = ()

    def take(self, points: Iterable[SurfacePoint], T_world_pads: Array) -> ContactState:
        """The contact state after a window with these surface points, with the pads at T_world_pads (p, 4, 4)."""
        near = [p.pad for p in points if p.gap < (RELEASE if p.pad in self.touched else TOUCH)]
        self.touched = tuple(sorted(near, key=self._place.__getitem__))
        if not near:
            return "none"
        own = [self._place[pad] for pad in near]
        normals = T_world_pads[own, :3, 2]
        held = (normals @ normals.T < OPPOSITE) & (self._links[own][:, None] == self._links[own])
        return "grip" if held.any() else "touch"
