"""What the pads read: gaps from electrodes to the person's skin, and their voltages with noise and ADC.

Each electrode follows the paper's response law (eq. sensor_approx) on its own gap. Another physical model needs only
these two calls, `gaps` and `volts`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from shared import cell as cells
from shared.skin import Skin
from shared.surface import Surface

Array = NDArray[np.float64]


class Mesh(Protocol):
    """What is felt: vertices (n, 3) [m] and faces (m, 3), such as `shared.body.Mesh`."""

    @property
    def vertices(self) -> Array: ...
    @property
    def faces(self) -> NDArray[np.int32]: ...


class SkinModel:
    """The pads of a cell, n electrodes in all, in the order of `shared.skin.Skin` (`.skin`)."""

    def __init__(self, cell: cells.Cell):
        self.skin = Skin(cell)
        self._surfaces: dict[int, tuple[Mesh, Surface]] = {}  # by identity; the mesh is kept so that its id stays its own

    def gaps(self, electrodes: Array, bodies: Iterable[tuple[Mesh, Array]]) -> Array:
        """Distance [m] (n,) of electrodes (n, 3) in the world to the nearest of the bodies' skins, each (mesh, T_world_mesh);
        zero in contact. Meshes are prepared once and remembered: pass the same objects again."""
        nearest = np.full(len(electrodes), np.inf)
        for mesh, T_world_mesh in bodies:
            local = (electrodes - T_world_mesh[:3, 3]) @ T_world_mesh[:3, :3]
            np.minimum(nearest, self._surface(mesh).nearest(local)[0], out=nearest)
        return np.maximum(nearest, 0.0)

    def volts(self, gaps: Array, rng: np.random.Generator) -> Array:
        """Amplitudes (..., n) [V] as the ADC gives them, for gaps (..., n) [m]: law, white noise of the law's variance,
        rounding to steps, limits 0 and reference."""
        skin = self.skin
        sigma = np.sqrt(skin.noise - skin.lsb**2 / 12.0)  # Skin counts the rounding as noise; here it happens
        analog = skin.volts(gaps) + sigma * rng.standard_normal(np.shape(gaps))
        return np.round(np.clip(analog, 0.0, skin.reference) / skin.lsb) * skin.lsb

    def _surface(self, mesh: Mesh) -> Surface:
        known = self._surfaces.get(id(mesh))
        if known is None:
            known = self._surfaces[id(mesh)] = (mesh, Surface(mesh.vertices, mesh.faces))
        return known[1]
