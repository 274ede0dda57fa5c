"""Patches around the targets of pictures, drawn anew at random, as sensors of any resolution, noise and colours see them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from penumbra.services.posecnn import patch
from penumbra.services.posecnn.network import STRIDE
from penumbra.services.posecnn.training.pictures import Truth
from penumbra.services.posecnn.training.schedule import Schedule
from penumbra.shared.geometry.rigid import Array


@dataclass(frozen=True)
class Batch:
    """images (batch, 3, side, side) in [0, 1]; labels (batch, side / STRIDE, …); centre (batch, 2) [patch px] of the target and
    its apparent length (batch,) [px]; rotation (batch, 3, 3), allocentric; points (batch, n, 3) of the target in its lengths;
    shape (batch, 5): its proportions."""

    images: Tensor
    labels: Tensor
    centre: Tensor
    length: Tensor
    rotation: Tensor
    points: Tensor
    shape: Tensor


def draw_batch(pixels: Tensor, chosen: NDArray[np.int64], truth: Truth, schedule: Schedule, rng: np.random.Generator) -> Batch:
    """One patch of each of the chosen pictures (batch,) of pixels (n, h, w, 4), red, green, blue and class, on their device.
    truth: of the chosen ones."""
    n, device = len(chosen), pixels.device
    size = np.array([pixels.shape[2], pixels.shape[1]])
    low, high = truth.low, truth.high
    extent = (high - low).max(axis=1)
    first, last = _region(low, high, size, schedule, rng)
    is_wide = rng.random(n) < schedule.wide
    narrowest, widest = (
        np.where(is_wide, schedule.room[1], schedule.room[0]),
        np.where(is_wide, schedule.widest, schedule.room[1]),
    )
    side = extent * np.exp(rng.uniform(np.log(narrowest), np.log(widest)))
    side = np.minimum(side, schedule.most_of_window * (last - first).max(axis=1))
    cut = schedule.cut * side[:, None]
    middle = np.clip((low + high) / 2.0, first + cut, np.maximum(last - cut, first + cut))
    middle = middle + rng.uniform(-1.0, 1.0, (n, 2)) * (schedule.off * np.minimum(extent, side))[:, None]
    angle = rng.normal(0.0, schedule.turn, n)
    M, focal, principal = patch.square(truth.intrinsics, middle, side, angle)
    c, s, o, i = np.cos(angle), np.sin(angle), np.zeros(n), np.ones(n)
    turned = np.stack([np.stack(row, -1) for row in ([c, -s, o], [s, c, o], [o, o, i])], -2)
    R, t = turned @ truth.T[:, :3, :3], np.einsum("nij,nj->ni", turned, truth.T[:, :3, 3])
    pictures = pixels[torch.from_numpy(chosen).to(device)].movedim(-1, 1).float()

    def here(values: ArrayLike) -> Tensor:
        return torch.from_numpy(np.asarray(values, np.float32)).to(device, non_blocking=True)

    def seen(channels: Tensor, stride: int, mode: str) -> Tensor:
        """The patches of channels (batch, c, h, w) at every stride-th pixel; black outside of the region."""
        steps = torch.arange(patch.SIDE // stride, device=device) * float(stride) + (stride - 1) / 2.0
        back = np.linalg.inv(M[..., :2])
        columns, rows, begin = here(np.stack([back[..., 0], back[..., 1], -np.einsum("nij,nj->ni", back, M[..., 2])]))
        places = columns[:, None, None] * steps[:, None] + rows[:, None, None] * steps[:, None, None] + begin[:, None, None]
        inside = ((places > here(first - 0.5)[:, None, None]) & (places < here(last - 0.5)[:, None, None])).all(-1)
        grid = (2.0 * places + 1.0) / here(size) - 1.0
        return F.grid_sample(channels, grid, mode=mode, align_corners=False) * inside[:, None]

    images = _spoilt(seen(pictures[:, :3] / 255.0, 1, "bilinear"), schedule, rng)
    return Batch(
        _recoloured(images, schedule.jitter, rng),
        seen(pictures[:, 3:], STRIDE, "nearest")[:, 0].round().long(),
        here(focal[:, None] * t[:, :2] / t[:, 2:] + principal),
        here(focal * truth.length / t[:, 2]),
        here(patch.facing(t).swapaxes(-1, -2) @ R),
        here(truth.vertices) / here(truth.length)[:, None, None],
        here(truth.shape),
    )


def _region(
    low: Array, high: Array, size: NDArray[np.int64], schedule: Schedule, rng: np.random.Generator
) -> tuple[Array, Array]:
    """The first column and row (n, 2) of the part of each picture that is shown, and those after its last: some are cut off
    around the target."""
    n = len(low)
    room = schedule.margin * (high - low).max(axis=1)[:, None, None] * rng.random((n, 2, 2))
    first = np.clip(np.floor(low - room[:, 0]), 0, size - 16)
    last = np.clip(np.ceil(high + room[:, 1]), first + 16, size)
    is_cropped = (rng.random(n) < schedule.cropped)[:, None]
    return np.where(is_cropped, first, 0.0), np.where(is_cropped, last, size)


def _spoilt(images: Tensor, schedule: Schedule, rng: np.random.Generator) -> Tensor:
    """Images (n, 3, side, side) as sensors of fewer pixels, bad lenses and noise see them. How coarse and how soft some are is
    the same for all of a batch."""
    n, device, side = len(images), images.device, images.shape[-1]
    images = images.clone()
    coarse, soft = (rng.permutation(n)[: round(share * n)] for share in (schedule.coarse, schedule.soft))
    fewer, sigma = round(side * rng.uniform(schedule.coarsest, 1.0)), rng.uniform(0.2, schedule.softest)
    if len(coarse):
        at = torch.from_numpy(coarse).to(device)
        small = F.interpolate(images[at], (fewer, fewer), mode="bilinear", antialias=True)
        images[at] = F.interpolate(small, (side, side), mode="bilinear")
    if len(soft):
        at = torch.from_numpy(soft).to(device)
        reach = int(np.ceil(3.0 * schedule.softest))
        bell = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
        kernel = torch.from_numpy((bell / bell.sum()).astype(np.float32)).to(device)
        blurred = images[at].flatten(0, 1)[:, None]
        blurred = F.conv2d(F.pad(blurred, (reach, reach, 0, 0), "replicate"), kernel[None, None, None])
        blurred = F.conv2d(F.pad(blurred, (0, 0, reach, reach), "replicate"), kernel[None, None, :, None])
        images[at] = blurred[:, 0].unflatten(0, (-1, 3))
    amount = np.where(rng.random(n) < 0.5, rng.uniform(0.0, schedule.noise, n), 0.0)
    generator = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
    noise = torch.randn(images.shape, generator=generator, device=device)
    return images + torch.from_numpy(amount.astype(np.float32)).to(device)[:, None, None, None] * noise


def _recoloured(images: Tensor, amount: float, rng: np.random.Generator) -> Tensor:
    """Images (n, 3, h, w) in [0, 1] with random changes of brightness, contrast, saturation and tint of up to `amount`, as
    `training.recoloured`."""
    change = 1.0 + amount * rng.uniform(-1.0, 1.0, (len(images), 3))
    tint = 1.0 + 0.25 * amount * rng.uniform(-1.0, 1.0, (len(images), 3))
    gain, contrast, saturation = (
        torch.from_numpy(values.astype(np.float32)).to(images.device)[..., None, None]
        for values in (change[:, :1] * tint, change[:, 1:2], change[:, 2:])
    )
    grey = images.mean(1, keepdim=True)
    images = grey + saturation * (images - grey)
    mean = images.mean((1, 2, 3), keepdim=True)
    return ((mean + contrast * (images - mean)) * gain).clamp(0.0, 1.0)
