"""Scores masks on labelled sequences and calibrates their size, for cards and for `penumbra bench segmentation`."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from penumbra.services.segmentation.classes import classes
from penumbra.services.segmentation.inference import TARGET_LABELS
from penumbra.services.segmentation.prednet import PredNet
from penumbra.services.segmentation.training import priors
from penumbra.shared.contract.labels import UNLABELLED, Label
from penumbra.sim.sets import sequences

WARM_UP = 3
"""Number of frames at the start of a sequence that are not scored: the recurrent state is still empty."""
HIDDEN = (0.0, 0.33, 0.66, 0.95)
"""Limits of the bins of hidden share in the score."""
FEWEST = 50
"""Minimum number of pixels of the target in a frame that is scored."""
NEAR_PX = 6.0
"""Maximum distance [px] of a boundary: a farther one belongs to something else, which is an error but not a contour error."""
OWN = (Label.BACKGROUND, Label.TORSO)
"""Neighbouring classes at which the boundary is the target's own; any other class may be in front of it."""


class Labelled(Protocol):
    """A labelled sequence: images (frames, h, w, 3) uint8, labels (frames, h, w) uint8, hidden: share of the target covered
    (frames,), NaN if unknown."""

    @property
    def images(self) -> NDArray[np.uint8]: ...
    @property
    def labels(self) -> NDArray[np.uint8]: ...
    @property
    def hidden(self) -> NDArray[np.float64]: ...


@dataclass(frozen=True)
class FrameScore:
    """Score of a frame's mask of the target against its true visible pixels: hidden share, IoU, masked over true area, and the
    boundary's offsets [px] at the points of the true one, positive where the mask is too large."""

    hidden: float
    iou: float
    area: float
    offsets: NDArray[np.float64]


def priors_of(sequence: Labelled, seed: int, kind: priors.Kind | None = None) -> NDArray[np.float32]:
    """Priors (frames, h, w, 2) of a sequence, drawn from a seed as in training, or all of one kind: from the scene of a simulated
    sequence, from the labels of others."""
    rng = np.random.default_rng(seed)
    if isinstance(sequence, sequences.Sequence):
        return priors.of_sequence(sequence, rng, kind)
    return priors.of_labels(sequence.labels, rng, kind)


def run(net: PredNet, images: NDArray[np.uint8], known: NDArray[np.float32] | None = None) -> Iterator[torch.Tensor]:
    """Logits (classes, h, w) float32 of each frame of a sequence (frames, h, w, 3) uint8, from an empty state; known: its priors
    (frames, h, w, 2), or None."""
    state = net.initial_state(1, *images.shape[1:3])
    dtype = net.head.weight.dtype
    for t, image in enumerate(images):
        with torch.inference_mode():
            picture = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].to(dtype) / 255.0
            prior = None if known is None else torch.from_numpy(known[t]).permute(2, 0, 1)[None].to(dtype)
            logits, _, state = net(picture, state, prior)
        yield logits[0].float()


def calibrate(net: PredNet, data: Iterable[Labelled]) -> tuple[float, dict[str, Any]]:
    """The offset of the target classes' logits that maximises the mean IoU, and that IoU without it and with it. A network with
    priors gets them as in training."""
    offsets = np.linspace(-3.0, 3.0, 241)
    target, other = list(TARGET_LABELS), [i for i in Label if i not in TARGET_LABELS]
    scores = []
    for index, sequence in enumerate(data):
        found = run(net, sequence.images, priors_of(sequence, index) if net.settings.priors else None)
        for logits, labels in itertools.islice(zip(found, sequence.labels, strict=True), WARM_UP, None):
            labelled = labels != UNLABELLED
            margin = (logits[target].amax(0) - logits[other].amax(0)).numpy()[labelled]
            truth = np.isin(labels[labelled], TARGET_LABELS)
            if truth.sum() > FEWEST:
                masked, both = (len(m) - np.searchsorted(np.sort(m), -offsets, side="right") for m in (margin, margin[truth]))
                scores.append(both / (masked + truth.sum() - both))
    if not scores:
        return 0.0, {"frames": 0}
    iou = np.mean(scores, axis=0)
    best = int(np.argmax(iou))
    scored = {"iou_mean_before": round(float(iou[len(offsets) // 2]), 4), "iou_mean": round(float(iou[best]), 4)}
    return round(float(offsets[best]), 3), {**scored, "frames": len(scores)}


def held_out(net: PredNet, offset: float, data: Iterable[Labelled]) -> dict[str, Any]:
    """The card's score: `summary` by hidden share, and the IoU of every class. A network with priors is scored without them; its
    scores with right and with wrong priors are added for simulated sequences, whose priors are not made from their labels."""
    kinds: dict[str, priors.Kind] = {"without": "missing"}
    if net.settings.priors:
        kinds |= {"with_priors": "right", "with_wrong_priors": "wrong"}
    scores = {name: _Score() for name in kinds}
    bias = torch.zeros(len(Label), 1, 1)
    bias[list(TARGET_LABELS)] = offset
    for index, sequence in enumerate(data):
        for name, kind in kinds.items():
            if kind != "missing" and not isinstance(sequence, sequences.Sequence):
                continue
            given = None if kind == "missing" else priors_of(sequence, index, kind)
            found = np.stack([classes((logits + bias).numpy()) for logits in run(net, sequence.images, given)])
            scores[name].add(found[WARM_UP:], sequence.labels[WARM_UP:], sequence.hidden[WARM_UP:])
    first = scores.pop("without").result()
    return first | {name: score.result() for name, score in scores.items()}


class _Score:
    """Accumulates scores of frames."""

    def __init__(self) -> None:
        self._frames: list[FrameScore] = []
        self._both, self._either = np.zeros(len(Label)), np.zeros(len(Label))

    def add(self, found: NDArray[np.uint8], labels: NDArray[np.uint8], hidden: NDArray[np.float64]) -> None:
        """Add frames with found and true classes (frames, h, w)."""
        found[labels == UNLABELLED] = UNLABELLED  # exclude unlabelled pixels from every class
        for label in Label:
            self._both[label] += np.sum((found == label) & (labels == label))
            self._either[label] += np.sum((found == label) | (labels == label))
        self._frames += frame_scores(found, labels, hidden)

    def result(self) -> dict[str, Any]:
        """The scores in the card's form."""
        score: dict[str, Any] = {}
        for (low, high), part in by_hidden(self._frames).items():
            if part:
                score[f"hidden {low:.0%} to {high:.0%}"] = summary(part)
        if unknown := [s for s in self._frames if np.isnan(s.hidden)]:
            score["hidden share unknown"] = summary(unknown)
        either = self._either
        score["iou_by_class"] = {i.name.lower(): round(float(self._both[i] / either[i]), 3) for i in Label if either[i]}
        return score


def frame_scores(found: NDArray[np.uint8], labels: NDArray[np.uint8], hidden: NDArray[np.float64]) -> Iterator[FrameScore]:
    """Scores of frames with at least FEWEST visible pixels of the target, from found and true classes (frames, h, w)."""
    for mask, truth, share in zip(found, labels, hidden, strict=True):
        f, t = np.isin(mask, TARGET_LABELS), np.isin(truth, TARGET_LABELS)
        if t.sum() > FEWEST:
            iou, area = (f & t).sum() / (f | t).sum(), f.sum() / t.sum()
            yield FrameScore(float(share), float(iou), float(area), contour_offsets(f, truth))


def contour_offsets(found: NDArray[np.bool_], truth: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Offsets [px] of a mask's (h, w) boundary outside the target's own boundary in the true classes (h, w), at every edge
    between a pixel of the target and one that it hides.

    The published mask is measured: the signed distance of the boundary between its pixels. A correct mask has offsets of zero;
    the truth also consists of whole pixels, so a boundary that is off by t is off by one pixel at a share t of the points. Points
    with no boundary within NEAR_PX are left out.
    """
    target, own = np.isin(truth, TARGET_LABELS), np.isin(truth, OWN)
    rows, columns = np.flatnonzero(target.any(1)), np.flatnonzero(target.any(0))
    if not len(rows):
        return np.empty(0)
    margin = int(NEAR_PX) + 2
    box = (slice(max(rows[0] - margin, 0), rows[-1] + margin + 1), slice(max(columns[0] - margin, 0), columns[-1] + margin + 1))
    found, target, own = found[box], target[box], own[box]
    if found.all() or not found.any():
        return np.empty(0)
    inside, outside = distance_transform_edt(found), distance_transform_edt(~found)
    depth = np.where(found, inside - 0.5, 0.5 - outside)  # depth of the pixels' centres below the mask's boundary
    offsets = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        edges = (target[a] & own[b]) | (own[a] & target[b])
        offsets.append(((depth[a] + depth[b]) / 2.0)[edges])
    every = np.concatenate(offsets)
    return every[np.abs(every) <= NEAR_PX]


def by_hidden(scores: Iterable[FrameScore]) -> dict[tuple[float, float], list[FrameScore]]:
    """Frames' scores by the bin of hidden share, (from, to)."""
    every = list(scores)
    return {(low, high): [s for s in every if low <= s.hidden < high] for low, high in itertools.pairwise(HIDDEN)}


def summary(scores: Sequence[FrameScore]) -> dict[str, Any]:
    """The card's summary of at least one frame's scores: IoU, area bias (relative), contour error [px]."""
    iou, area = np.array([s.iou for s in scores]), np.array([s.area for s in scores])
    offsets = np.concatenate([s.offsets for s in scores])
    known = len(offsets) > 0
    return {
        "iou_median": round(float(np.median(iou)), 3),
        "iou_mean": round(float(iou.mean()), 3),
        "area_bias_median": round(float(np.median(area) - 1.0), 4),
        "contour_mean_px": round(float(offsets.mean()), 3) if known else None,
        "contour_rms_px": round(float(np.sqrt((offsets**2).mean())), 3) if known else None,
        "frames": len(scores),
    }
