"""Data to test the segmentation network with: a small scene, and tensors in the layout of the running service."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from penumbra.sim.sets import sequences


def scene(frames: int = 6, size: int = 96) -> NDArray[np.uint8]:
    """Pictures (frames, size, size, 3) of a scene that no network was trained on."""
    return sequences.render(987_654, 3, sequences.Variety(frames=frames, size=size)).images


def as_rows(tensor: torch.Tensor) -> NDArray:
    """A tensor (1, c, h, w) in the layout of the running service, (1, h, w, c)."""
    return tensor.permute(0, 2, 3, 1).contiguous().numpy()
