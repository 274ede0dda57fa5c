"""Trains the networks of the field model, and scores them by the gap."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from rich.progress import Progress

from penumbra.shared.geometry.rigid import Array

SMALL = 0.02
"""Error of a logarithm below which the loss is its square, and above which it is its amount."""


def learn(
    model: torch.nn.Module,
    inputs: Array,
    wanted: Array,
    rng: np.random.Generator,
    steps: int,
    batch: int,
    rate: float,
    decay: float,
    progress: Progress | None = None,
) -> None:
    """Train a network of logarithms, robust against the few poses that it cannot fit. inputs (n, i), wanted (n, e); batch:
    samples of a step; rate: the largest one of its learning; decay: of its weights."""
    x, y = (torch.from_numpy(each.astype(np.float32)) for each in (inputs, wanted))
    optimizer = torch.optim.AdamW(model.parameters(), lr=rate, weight_decay=decay)
    task = progress.add_task("network", total=steps) if progress else None
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / 300) * (0.5 * (1.0 + np.cos(np.pi * step / steps)) + 5e-4)
        rows = torch.from_numpy(rng.integers(0, len(x), batch))
        error = model(x[rows]) - y[rows]
        loss = (torch.sqrt(error * error + SMALL**2) - SMALL).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if progress and task is not None and step % 100 == 0:
            progress.update(task, completed=step, description=f"network, error {error.abs().median().item():.4f}")
    if progress and task is not None:
        progress.remove_task(task)


def parameters(layers: Sequence[torch.nn.Linear]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Weights (rows are outputs) and biases of layers."""
    weights = tuple(layer.weight.detach().numpy().astype(float) for layer in layers)
    return weights, tuple(layer.bias.detach().numpy().astype(float) for layer in layers)


def score(gap: Array, bands: Sequence[float], errors: Mapping[str, Array]) -> dict[str, dict[str, float]]:
    """Median and 95th percentile of errors (n, e) [%] by name, per band of the gap (n,) [m], whose limits are given."""
    out = {}
    for low, high in itertools.pairwise(bands):
        own = (gap >= low) & (gap < high)
        if own.any():
            row: dict[str, float] = {"poses": int(own.sum())}
            for name, error in errors.items():
                row[f"{name}median_percent"] = round(float(np.median(error[own])), 3)
                row[f"{name}p95_percent"] = round(float(np.percentile(error[own], 95)), 3)
            out[f"{100 * low:g}-{100 * high:g} cm"] = row
    return out
