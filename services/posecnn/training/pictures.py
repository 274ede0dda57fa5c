"""What PoseCNN is trained on: simulated pictures, rendered by other processes while it learns, the last of which are kept.

They begin as the segmentation's sequences do, but are seen from further away too. A step brings some new pictures, which take the
place of the oldest ones, and what it learns from is drawn from all. Which pictures there are at a step follows from its number.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from penumbra.services.posecnn.network import PROPORTIONS, proportions
from penumbra.shared import training
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.sim.sets import sequences

VARIETY = sequences.Variety(frames=1, size=384, finer=1.35, away=(0.7, 6.0))
"""A network without memory learns most from pictures of many scenes. They are large, for patches to lie within them, as fine as
patches, and from as far away as the cameras of the paper."""


@dataclass(frozen=True)
class Truth:
    """What is known of n pictures: T_camera_target (n, 4, 4), intrinsics (n, 4), hidden share (n,); low, high (n, 2): the first
    and the last column and row [px] of the target's picture, were it not hidden; its length (n,) [m] and proportions (n, 5); its
    vertices (n, m, 3) [m]."""

    T: Array
    intrinsics: Array
    hidden: Array
    low: Array
    high: Array
    length: Array
    shape: Array
    vertices: NDArray[np.float32]

    @classmethod
    def of(cls, stored: NDArray[np.float32]) -> Truth:
        """What rows of `row` say."""
        parts = np.split(stored, np.cumsum([16, 4, 1, 2, 2, 1, len(PROPORTIONS)]), axis=1)
        T, intrinsics, hidden, low, high, length, shape = (part.astype(np.float64) for part in parts[:-1])
        return cls(
            T.reshape(-1, 4, 4), intrinsics, hidden[:, 0], low, high, length[:, 0], shape, parts[-1].reshape(len(T), -1, 3)
        )


def row(T: Array, intrinsics: Array, hidden: float, vertices: Array) -> NDArray[np.float32]:
    """What is known of a picture, as one row, from T_camera_target (4, 4), intrinsics (4,), hidden share and vertices (m, 3)."""
    points = rigid.apply(T, vertices)
    shown = points[:, :2] / points[:, 2:] * intrinsics[:2] + intrinsics[2:]
    box, length = (shown.min(axis=0), shown.max(axis=0)), np.ptp(vertices[:, 0])
    known = [T.ravel(), intrinsics, [hidden], *box, [length], proportions(vertices), vertices.ravel()]
    return np.concatenate(known).astype(np.float32)


class Rendered(Dataset[tuple[Tensor, Tensor]]):
    """Renders pictures by their numbers: red, green, blue and class (n, h, w, 4) uint8, and `row` of each."""

    def __init__(self, seed: int):
        self._seed = seed

    def __getitem__(self, indices: range) -> tuple[Tensor, Tensor]:
        pixels, rows = [], []
        for index in indices:
            sequence = sequences.render(self._seed, index, VARIETY)
            poses = sequence.poses
            assert poses is not None
            pixels.append(np.concatenate([sequence.images[0], sequence.labels[0][..., None]], axis=-1))
            rows.append(row(poses.T_camera_target[0], poses.intrinsics, float(sequence.hidden[0]), poses.vertices))
        return torch.from_numpy(np.stack(pixels)), torch.from_numpy(np.stack(rows))


class RenderedPictures:
    """The last `kept` pictures, on a device; `each`: new ones a step; `first`: there at the first step. With `workers` other
    processes render them."""

    def __init__(self, seed: int, each: int, kept: int, first: int, device: torch.device, workers: int = 0):
        self._rendered, self._each, self._workers = Rendered(seed), each, workers
        self._ahead, self._parts, self._device = -(-first // each), max(kept // each, 1), device
        self._coming: Iterator[Any] | None = None
        self._next = 0
        self.pixels = torch.empty((0, VARIETY.size, VARIETY.size, 4), dtype=torch.uint8)
        self._truth = np.empty((0, 0), np.float32)

    def ensure(self, step: int) -> int:
        """Wait until the pictures of a step are there; returns their number."""
        last = step + self._ahead
        if self._coming is None:
            self._next = max(0, last + 1 - self._parts)
            self._coming = self._from(self._next)
        while self._next <= last:
            pixels, rows = next(self._coming)
            if not len(self.pixels):
                self.pixels = torch.empty((self._parts * self._each, *pixels.shape[1:]), dtype=torch.uint8, device=self._device)
                self._truth = np.empty((len(self.pixels), rows.shape[1]), np.float32)
            at = self._next % self._parts * self._each
            self.pixels[at : at + self._each].copy_(pixels, non_blocking=True)
            self._truth[at : at + self._each] = rows.numpy()
            self._next += 1
        return min(last + 1, self._parts) * self._each

    def truth(self, chosen: NDArray[np.int64]) -> Truth:
        """What is known of pictures (n,) that are there."""
        return Truth.of(self._truth[chosen])

    def close(self) -> None:
        """Render no more."""
        self._coming = None

    def _from(self, part: int) -> Iterator[Any]:
        ranges = (range(i * self._each, (i + 1) * self._each) for i in itertools.count(part))
        return iter(
            DataLoader(
                self._rendered,
                batch_size=None,
                sampler=ranges,
                num_workers=self._workers,
                worker_init_fn=training.alone_on_a_core,
                pin_memory=self._device.type == "cuda",
            )
        )
