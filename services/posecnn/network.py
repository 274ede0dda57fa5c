"""PoseCNN (Xiang et al. 2018) small enough to run on one core.

A convolutional encoder and decoder give for every pixel its class, the unit direction to the projected centre of the target (the
origin of its mesh) and the target's apparent length; features pooled in the region that the votes name give the rotation.

What differs from the original: 4.2 million parameters, trained from nothing, in place of VGG16; one object, whose proportions are
an input, for one network serves all persons; the input is a patch zoomed to the target; apparent length in place of depth, so
that neither the zoom nor the person's size matters, and a mean by weights that the network gives; the region is a square around
the voted centre, as wide as the length says, in place of the box of the voting pixels; the rotation is allocentric (relative to
the ray through the centre, Kundu et al. 2018, doi:10.1109/CVPR.2018.00375), for a patch shows the arm as that ray sees it,
wherever in the image it was cut out.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from penumbra.shared.contract.labels import Label

STRIDE = 4
"""Patch pixels a side of one position of the dense outputs."""
REFERENCE_PX = 160.0
"""The network's lengths are logarithms of the apparent length over this."""
REACH = 0.75
"""Half the side of the region whose features give the rotation, in lengths of the target."""
BINS, SAMPLES = 8, 16
"""A side of the pooled region, and samples that are pooled."""
PROPORTIONS = (-0.29, -0.11, 0.186, -0.1, 0.1)
"""Proportions of the mean body's forearm and hand (`proportions`)."""


@dataclass(frozen=True)
class PoseCnnSettings:
    """channels: at strides 4, 8, 16 and 32; pooled: of the features that are pooled; hidden: of the layer before the rotation."""

    channels: tuple[int, int, int, int] = (64, 96, 160, 224)
    pooled: int = 24
    hidden: int = 128


@dataclass(frozen=True)
class Dense:
    """What the network says of every position (h, w) of a batch: logits (batch, classes, h, w); direction (batch, 2, h, w), of
    about unit length; length (batch, h, w), log of the apparent length over REFERENCE_PX; weight (batch, h, w), log of how much
    that length counts; features (batch, c, h / 4, w / 4)."""

    logits: Tensor
    direction: Tensor
    length: Tensor
    weight: Tensor
    features: Tensor


def proportions(vertices: NDArray[np.float64]) -> NDArray[np.float32]:
    """How a limb along x is shaped, whatever its size: the bounds of its vertices (n, 3), in its lengths: least x, least and
    greatest y, least and greatest z. Least x tells how much of it is forearm, for the origin is the forearm's middle."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    bounds = np.array([low[0], low[1], high[1], low[2], high[2]])
    return np.asarray(bounds / (high[0] - low[0]), np.float32)


class Block(nn.Module):
    """A residual block of two convolutions (He et al. 2016)."""

    def __init__(self, channels: int):
        super().__init__()
        self.first, self.second = conv(channels, channels), conv(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.second(F.relu(self.first(x))))


class Context(nn.Module):
    """Adds to every position what the mean of all says."""

    def __init__(self, channels: int):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, channels))

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.layers(x.mean((2, 3)))[:, :, None, None])


def conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """A convolution, normalised."""
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    convolution.weight.data = convolution.weight.data.contiguous(memory_format=torch.channels_last)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs, momentum=0.02))


class Network(nn.Module):
    """The network of the module's description. Images are (batch, 3, side, side) in [0, 1], side a multiple of 32."""

    def __init__(self, settings: PoseCnnSettings = PoseCnnSettings()):
        super().__init__()
        self.settings = settings
        a, b, c, d = settings.channels
        self.stem = nn.ModuleList([conv(3 * STRIDE**2, a), conv(a, a)])
        self.down = nn.ModuleList([conv(a, b, stride=2), conv(b, c, stride=2), conv(c, d, stride=2)])
        self.blocks = nn.ModuleList([Block(b), nn.Sequential(Block(c), Block(c)), nn.Sequential(Block(d), Context(d), Block(d))])
        self.shape = nn.Linear(len(PROPORTIONS), d)
        self.lateral = nn.ModuleList([conv(d, c, 1), conv(c, b, 1), conv(b, a, 1)])
        self.merge = nn.ModuleList([conv(c, c), conv(b, b), conv(a, a)])
        self.head = nn.Conv2d(a, len(Label) + 4, 1)
        self.pool = conv(c, settings.pooled, 1)
        self.rotation = nn.Sequential(
            nn.Linear(settings.pooled * BINS**2, settings.hidden), nn.ReLU(), nn.Linear(settings.hidden, 4)
        )

    def forward(self, images: Tensor, shapes: Tensor) -> Dense:
        """`shapes` (batch, 5): the `proportions` of each picture's target."""
        x = F.pixel_unshuffle((images - 0.45) / 0.25, STRIDE).contiguous(memory_format=torch.channels_last)
        for layer in self.stem:
            x = F.relu(layer(x))
        skips = []
        for i, (down, block) in enumerate(zip(self.down, self.blocks, strict=True)):
            skips.append(x)
            x = down(x)
            if i + 1 == len(self.down):
                x = x + self.shape((shapes - shapes.new_tensor(PROPORTIONS)) / 0.05)[:, :, None, None]
            x = block(F.relu(x))
        features = x
        for i, (lateral, merge) in enumerate(zip(self.lateral, self.merge, strict=True)):
            x = F.interpolate(lateral(x), scale_factor=2, mode="nearest") + skips[-1 - i]
            x = F.relu(merge(F.relu(x)))
            if i == 0:
                features = F.relu(self.pool(x))
        with torch.autocast(x.device.type, enabled=False):  # a thousandth of a length counts
            out = self.head(x.float())
        n = len(Label)
        return Dense(out[:, :n], out[:, n : n + 2], out[:, n + 2], out[:, n + 3], features)

    def rotations(self, features: Tensor, centre: Tensor, length: Tensor) -> Tensor:
        """Unit quaternions (batch, 4), (x, y, z, w), of the allocentric rotation, from features (batch, c, h, w) pooled around
        centres (batch, 2) [patch px] for apparent lengths (batch,) [px]."""
        side = features.shape[-1] * 4 * STRIDE
        steps = (torch.arange(SAMPLES, dtype=torch.float32, device=features.device) + 0.5) / SAMPLES * 2.0 - 1.0
        rows, columns = torch.meshgrid(steps, steps, indexing="ij")
        grid = torch.stack([columns, rows], -1)[None] * (REACH * length[:, None, None, None]) + centre[:, None, None]
        grid = (2.0 * grid + 1.0) / side - 1.0
        samples = F.grid_sample(features.float(), grid, align_corners=False)
        pooled = F.avg_pool2d(samples, SAMPLES // BINS)
        return F.normalize(self.rotation(pooled.flatten(1)).float(), dim=1)


def mean_length(length: Tensor, weight: Tensor, counts: Tensor) -> Tensor:
    """The mean (batch,) of lengths (batch, h, w) by their weights (log), of the positions that count (batch, h, w)."""
    share = weight.masked_fill(~counts, -torch.inf).flatten(1).softmax(1).nan_to_num(0.0)
    return (share * length.flatten(1)).sum(1)


def save(path: Path, net: Network, card: dict[str, Any]) -> None:
    """Write weights (npz, half precision) and their card beside them."""
    stored: dict[str, Any] = {name: _compact(value) for name, value in net.state_dict().items()}
    np.savez(path, **stored)
    text = json.dumps({**card, "settings": {**card.get("settings", {}), "network": asdict(net.settings)}}, indent=2)
    path.with_suffix(".json").write_text(text + "\n")


def _compact(value: Tensor) -> np.ndarray:
    return value.numpy().astype(np.float16) if value.is_floating_point() else value.numpy()


def load(path: Path) -> tuple[Network, dict[str, Any]]:
    """The network of a weights file, ready to be used, and its card.

    Raises FileNotFoundError that says how to make one, ValueError where weights and card do not fit together.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no weights {path}: make them with `penumbra posecnn train --out {path}`")
    card = json.loads(path.with_suffix(".json").read_text())
    network = {key: tuple(value) if isinstance(value, list) else value for key, value in card["settings"]["network"].items()}
    net = Network(PoseCnnSettings(**network))  # type: ignore[arg-type]
    with np.load(path, allow_pickle=False) as stored:
        weights = {name: torch.from_numpy(stored[name]) for name in stored.files}
    try:
        net.load_state_dict(weights)
    except RuntimeError as error:
        raise ValueError(f"{path}: expected weights of {network}, as its card says: {error}") from None
    return net.eval(), card
