"""Shape and weights of the network, as stored and as the running service uses them, without torch.

`prednet.py` is the same network in torch, for training; `openvino_step.py` runs it in OpenVINO.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from penumbra.services.segmentation import encoder

SHRINK = 2
"""Side [px] of the blocks of picture pixels whose means the layers see."""
FOLD = 2
"""Side of the block of pixels folded into one position: of these means for the first layer, of the picture for the mask's
decoder."""
CELLS = ("hgru", "convlstm", "conv")
"""Cells that may update a layer's representation; `prednet.py` describes them."""
PRIORS = ("robot", "target")
"""Prior knowledge of a picture, one channel each: where the robots are, and where the targets are expected. Values are 2 p - 1 of
a pixel's probability p to lie in the silhouette, even if occluded: 1 inside, -1 outside, 0 where unknown."""


def kernels_of(layers: int) -> tuple[int, ...]:
    """Width of the cell's kernel in each of `layers` layers: 3 in the two finest, 5 above."""
    return tuple(3 if i < 2 else 5 for i in range(layers))


@dataclass(frozen=True)
class Settings:
    """Size of the network. channels, kernels: of each layer's cell. The authors have 64-128-256-512 and kernels of 5; kernels of
    5 in the coarse layers alone (`kernels_of`) cost a tenth of the time of 5 everywhere and reach as far. `delay`: axonal delays.
    `cell`: one of CELLS, all with nearly the same number of parameters. `priors`: number of prior channels, those of PRIORS or
    none. `encoder`: whether an encoder's output also drives the cells."""

    channels: tuple[int, ...] = (16, 16, 32, 64)
    kernels: tuple[int, ...] = (3, 3, 5, 5)
    decoder_channels: int = 16
    delay: bool = False
    cell: str = "hgru"
    priors: int = 0
    encoder: bool = False

    def __post_init__(self) -> None:
        if self.cell not in CELLS:
            raise ValueError(f"cell: expected one of {', '.join(CELLS)}, got {self.cell!r}")
        if self.cell == "convlstm" and any(n % 2 for n in self.channels):
            raise ValueError(f"expected even channels, which a ConvLSTM halves, got {self.channels}")
        if self.priors not in (0, len(PRIORS)):
            raise ValueError(f"priors: expected 0 or {len(PRIORS)} channels ({', '.join(PRIORS)}), got {self.priors}")
        if len(self.channels) != len(self.kernels) or len(self.channels) < 2:
            raise ValueError(f"expected one kernel per layer and at least 2 layers, got {self.channels} and {self.kernels}")

    @property
    def layer_strides(self) -> tuple[int, ...]:
        """Image pixels per position and axis of each layer."""
        return tuple(SHRINK * FOLD * 2 ** max(i - 1, 0) for i in range(len(self.channels)))

    @property
    def strides(self) -> tuple[int, ...]:
        """Image pixels per position and axis of each tensor of the state."""
        return self.layer_strides * (2 if self.delay else 1)

    @property
    def multiple(self) -> int:
        """Number of pixels of which image sides must be a multiple; the state can be shifted by multiples of it."""
        return max(self.layer_strides[-1], encoder.STRIDES[-1] if self.encoder else 1)

    @property
    def driven(self) -> tuple[int, ...]:
        """Index of the layer that each encoder output except the first drives: the coarsest layer no coarser than the output."""
        return tuple(max(i for i, own in enumerate(self.layer_strides) if own <= stride) for stride in encoder.STRIDES[1:])

    def state_sizes(self, height: int, width: int) -> tuple[tuple[int, int], ...]:
        """(height, width) of each tensor of the state for images of this size. Raises ValueError where the size does not fit."""
        if height % self.multiple or width % self.multiple or min(height, width) <= 0:
            raise ValueError(f"image size: expected positive multiples of {self.multiple}, got {width} x {height}")
        return tuple((height // stride, width // stride) for stride in self.strides)


@dataclass(frozen=True)
class Model:
    """A network: its settings, and its parameters (float32) by their names in `prednet.PredNet`."""

    settings: Settings
    weights: dict[str, NDArray[np.float32]]

    @property
    def inputs(self) -> tuple[int, ...]:
        """Number of channels of each layer's input A_l, which layer l predicts."""
        return tuple(len(self.weights[f"predict.{i}.bias"]) for i in range(len(self.settings.channels)))

    @property
    def state_channels(self) -> tuple[int, ...]:
        """Number of channels of each tensor of the state: R_l of every layer and, with axonal delays, E_l after them."""
        errors = tuple(2 * n for n in self.inputs) if self.settings.delay else ()
        return self.settings.channels + errors


def save(path: Path, model: Model, card: dict[str, Any]) -> None:
    """Write weights (npz, half precision: a third of the mask's noise floor, half the size) and their card beside them."""
    halves: dict[str, Any] = {name: value.astype(np.float16) for name, value in model.weights.items()}
    np.savez(path, **halves)
    text = json.dumps({**card, "settings": {**card.get("settings", {}), "network": asdict(model.settings)}}, indent=2)
    path.with_suffix(".json").write_text(text + "\n")


def load(path: Path) -> tuple[Model, dict[str, Any]]:
    """Load the network of a weights file and its card. Raises ValueError for a card of something else."""
    card = json.loads(path.with_suffix(".json").read_text())
    try:
        network = {key: tuple(value) if isinstance(value, list) else value for key, value in card["settings"]["network"].items()}
        settings = Settings(**network)  # type: ignore[arg-type]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected a card of the segmentation network beside it, got another one: {error}") from None
    with np.load(path, allow_pickle=False) as stored:
        weights = {name: stored[name].astype(np.float32) for name in stored.files}
    return Model(settings, weights), card
