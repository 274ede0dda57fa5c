"""How PoseCNN's training goes: its rate, its data, and how pictures and patches are varied."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from penumbra.services.posecnn.training.pictures import RenderedPictures
from penumbra.shared import training


@dataclass(frozen=True)
class Schedule:
    """How training goes. `peak_rate`, `decay`: of AdamW's one cycle; `batch`: patches a step; `reuse`: how many of them there are
    for each picture that is rendered; `kept`: number of pictures that are drawn from, the last ones; `first`: of those that are
    there at the first step; `weights`: of the loss's parts; `averaging`: of the weights that are exported.

    Pictures: `cropped`: share of those that are cut off around the target, up to `margin` extents beside it; `coarse`: share of
    the patches that are seen by a sensor of fewer pixels, at least the share `coarsest` along each side; `soft`: share of those
    that are blurred, by up to `softest` [px]; `noise`: largest standard deviation of what is added to half of them. How sharp a
    patch is and where its picture ends must not tell how far it was zoomed.

    Patches: `room`: bounds of their side, in extents of the target's picture, and with a share `wide` up to `widest`; `off`: how
    far at most their middle is off the target's, in extents; `most_of_window`: their largest side and `cut`: their middle's least
    distance from the picture's border, in sides of picture and patch, for beyond it is black; `turn` [rad]: standard deviation of
    the camera's turn about its axis. `jitter`: of the colours. `region`: standard deviations of the pooled region's centre, in
    apparent lengths, and of its size.
    """

    peak_rate: float = 1e-3
    decay: float = 1e-2
    batch: int = 16
    reuse: int = 32
    kept: int = 2048
    first: int = 128
    weights: tuple[tuple[str, float], ...] = (
        ("labels", 1.0),
        ("target", 1.0),
        ("direction", 2.0),
        ("length", 5.0),
        ("distance", 30.0),
        ("rotation", 4.0),
    )
    averaging: float = 0.998
    cropped: float = 0.3
    margin: float = 0.3
    coarse: float = 0.25
    coarsest: float = 0.4
    soft: float = 0.3
    softest: float = 1.5
    noise: float = 0.03
    room: tuple[float, float] = (1.1, 1.8)
    wide: float = 0.12
    widest: float = 5.0
    off: float = 0.2
    most_of_window: float = 1.05
    cut: float = 0.4
    turn: float = 0.3
    jitter: float = 0.25
    region: tuple[float, float] = (0.05, 0.08)

    def rate(self, progress: float) -> float:
        """The learning rate at a progress in [0, 1]."""
        return self.peak_rate * training.one_cycle(progress, 0.08)

    def times(self, count: int) -> Schedule:
        """The schedule with so many times as much data at once."""
        return replace(self, batch=count * self.batch, kept=count * self.kept, first=count * self.first)

    def pictures(self, seed: int, device: torch.device, workers: int) -> RenderedPictures:
        """Pictures of these numbers."""
        return RenderedPictures(seed, max(self.batch // self.reuse, 1), self.kept, self.first, device, workers)
