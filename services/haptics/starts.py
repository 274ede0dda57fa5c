"""Starting poses of a solve without a track: home, home moved along the limb, and the network's pose."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from penumbra.services.haptics.settings import HapticSettings
from penumbra.services.haptics.solve import Reading
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.layout import Skin


class Limb:
    """The target's surface relative to a skin."""

    def __init__(self, skin: Skin, surface: Surface):
        self._skin, self._surface = skin, surface

    def gap(self, reading: Reading, T: Array, size: Array) -> float:
        """Smallest gap [m] from an electrode in use to a limb of this size (2,) at T_world_target (4, 4); negative inside."""
        scale = np.exp(size[[0, 1, 1]])
        local = (self._skin.positions(reading.T_world_pads)[np.isfinite(reading.variance)] - T[:3, 3]) @ T[:3, :3] / scale
        distance, _, gradient = self._surface.nearest(local)
        stretch = gradient / scale
        return float((distance / np.sqrt(np.einsum("ni,ni->n", stretch, stretch))).min())


class Starts:
    """Starting poses of a solve from scratch, by number from 0 to len() - 1. home (4, 4): T_world_target; by_network: returns the
    network's pose of a reading, the last of the starts."""

    def __init__(self, home: Array, limb: Limb, by_network: Callable[[Reading], Array], settings: HapticSettings):
        self._home, self._limb, self._by_network, self._settings = home, limb, by_network, settings
        self.forget()

    def __len__(self) -> int:
        return len(self._settings.slides) + 1

    def forget(self) -> None:
        """Restart the round through the starts and the count of windows."""
        self._last, self._windows = 0, 0

    def is_due(self) -> bool:
        """Count a tracked window; returns whether it is also solved from another start."""
        self._windows = (self._windows + 1) % self._settings.elsewhere_every
        return self._windows == 0

    def elsewhere(self, reading: Reading, tracked: Array, size: Array) -> Array:
        """The next start of the round that is not near the tracked pose (4, 4)."""
        slides = self._settings.slides
        along = float((tracked[:3, 3] - self._home[:3, 3]) @ self._home[:3, 0])
        self._last = (self._last + 1) % len(self)
        if self._last < len(slides) and abs(slides[self._last] - along) < self._settings.elsewhere_away:
            self._last += 1
        return self.at(self._last, reading, size)

    def at(self, which: int, reading: Reading, size: Array) -> Array:
        """T_world_target (4, 4) of start `which` for a limb of this size (2,), moved away from the pads to the clearance."""
        if which == len(self._settings.slides):
            return self._by_network(reading)
        T = self._home.copy()
        T[:3, 3] += self._settings.slides[which] * T[:3, 0]
        normal = reading.T_world_pads[:, :3, 2].mean(axis=0)
        normal /= np.linalg.norm(normal) + 1e-9
        for _ in range(3):  # a step may change the nearest electrode
            short = self._settings.clearance - self._limb.gap(reading, T, size)
            if short < 0.005:
                break
            T[:3, 3] += short * normal
        return T
