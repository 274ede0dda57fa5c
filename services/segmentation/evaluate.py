"""How good masks are on labelled sequences, and the calibration of their size."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from services.segmentation.infer import TARGET_LABELS
from services.segmentation.prednet import PredNet
from shared.classes import Label

WARM_UP = 3
"""Frames at the start of a sequence that do not count: the state knows nothing yet."""
HIDDEN = (0.0, 0.33, 0.66, 0.95)
"""Borders of the classes of hidden share in the score."""
GOOD = 0.8
"""Frames of this IoU and more calibrate the size: in others wholes are wrong, not contours."""


class Labelled(Protocol):
    """A sequence: images (frames, h, w, 3) uint8, labels (frames, h, w) uint8, hidden: share of the target covered (frames,)."""

    @property
    def images(self) -> NDArray[np.uint8]: ...
    @property
    def labels(self) -> NDArray[np.uint8]: ...
    @property
    def hidden(self) -> NDArray[np.float64]: ...


def run(net: PredNet, images: NDArray[np.uint8]) -> torch.Tensor:
    """Logits (frames, classes, h, w) float32 of a sequence (frames, h, w, 3) uint8, from an empty state."""
    state = net.initial_state(1, *images.shape[1:3])
    dtype, out = net.head.weight.dtype, []
    with torch.inference_mode():
        for image in images:
            picture = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].to(dtype) / 255.0
            logits, _, state = net(picture, state)
            out.append(logits.float())
    return torch.cat(out)


def calibrate(net: PredNet, data: Iterable[Labelled]) -> tuple[float, dict[str, Any]]:
    """The offset of the target classes' logits that makes the median ratio of masked to true area 1, and the bias without it."""
    offsets = np.linspace(-3.0, 3.0, 241)
    ratios = []
    for sequence in data:
        logits = run(net, sequence.images)
        target, other = list(TARGET_LABELS), [i for i in Label if i not in TARGET_LABELS]
        margin = (logits[:, target].amax(1) - logits[:, other].amax(1)).numpy()
        truth = np.isin(sequence.labels, TARGET_LABELS)
        for m, t in zip(margin[WARM_UP:], truth[WARM_UP:], strict=True):
            if t.any() and ((m > 0) & t).sum() >= GOOD * ((m > 0) | t).sum():
                ratios.append((m.size - np.searchsorted(np.sort(m.ravel()), -offsets, side="right")) / t.sum())
    if not ratios:
        return 0.0, {"area_bias_before": None, "frames": 0}
    median = np.median(ratios, axis=0)
    best = int(np.argmin(np.abs(median - 1.0)))
    return round(float(offsets[best]), 3), {"area_bias_before": round(float(median[120] - 1.0), 4), "frames": len(ratios)}


def held_out(net: PredNet, offset: float, data: Iterable[Labelled]) -> dict[str, Any]:
    """The score: IoU of forearm and hand together and area bias (relative) by hidden share, and the IoU of every class."""
    bias = torch.zeros(1, len(Label), 1, 1)
    bias[:, list(TARGET_LABELS)] = offset
    rows = []  # hidden, IoU, area ratio
    both, either = np.zeros(len(Label)), np.zeros(len(Label))
    for sequence in data:
        found = (run(net, sequence.images) + bias).argmax(1).numpy()[WARM_UP:]
        labels = sequence.labels[WARM_UP:]
        for label in Label:
            both[label] += np.sum((found == label) & (labels == label))
            either[label] += np.sum((found == label) | (labels == label))
        f, t = np.isin(found, TARGET_LABELS), np.isin(labels, TARGET_LABELS)
        for k, hidden in enumerate(sequence.hidden[WARM_UP:]):
            if t[k].sum() > 50:
                rows.append((hidden, (f[k] & t[k]).sum() / (f[k] | t[k]).sum(), f[k].sum() / t[k].sum()))
    table = np.array(rows).reshape(-1, 3)
    score: dict[str, Any] = {}
    for low, high in itertools.pairwise(HIDDEN):
        part = table[(table[:, 0] >= low) & (table[:, 0] < high)]
        if len(part):
            score[f"hidden {low:.0%} to {high:.0%}"] = {
                "iou_median": round(float(np.median(part[:, 1])), 3),
                "iou_mean": round(float(part[:, 1].mean()), 3),
                "area_bias_median": round(float(np.median(part[:, 2]) - 1.0), 4),
                "frames": len(part),
            }
    score["iou_by_class"] = {i.name.lower(): round(float(both[i] / either[i]), 3) for i in Label if either[i]}
    return score
