"""Colour model of the target, learned online from the network's own masks.

The network is most certain along edges, and least certain inside a smooth, evenly lit arm unlike its training data. There the
picture itself helps: a pixel is probably the target's if clearly recognised parts of the target have its colour and their
surroundings do not. Colour histograms of the target, of the rest of the body (often in the same sleeve), of the robot and of
everything else are accumulated from the network's probabilities; the logarithms of their ratios (Jones and Rehg,
doi:10.1023/A:1013200319198) are added to the network's logits. As in GrabCut (doi:10.1145/1015706.1015720), the histograms are
estimated a second time from the first estimate. There is no other feedback: each frame's histograms start from the network's
masks, so that they cannot drift away from them.

The constants were chosen by the IoU on photographs of training/photographs, none of which the network had seen, and on simulated
sequences of seeds 424242 and 424243. With two groups, target and rest, photographs are as good, and simulated targets that are a
third to two thirds hidden are worse; with one group per class, photographs are worse.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.shared.contract.labels import TARGET_LABELS, Label
from penumbra.shared.native import kernel

SHAPE = (16, 16, 16)
"""Bins of L*, a* and b*: 16, 8 and 8 levels wide; a* and b* beyond 64 of 128 either way, which are rare, count as 64. L* in 8
bins was worse, narrower bins of a* and b* no better."""
GROUPS = (tuple(TARGET_LABELS), (Label.TORSO, Label.UPPER_ARM), (Label.ROBOT,), (Label.BACKGROUND, Label.OCCLUDER))
"""Classes that share a histogram, the target's first."""
_GROUP_OF = np.array([next(k for k, group in enumerate(GROUPS) if label in group) for label in Label], np.uint8)
HALF_LIFE_S = 1.0
"""Age [s] at which a frame's weight is half. 0.2 and 4 s are as good where looks do not change."""
WEIGHT = 2.5
"""Weight of a colour's log-likelihood ratio relative to the network's logits, which are too weak for an unfamiliar look."""
GREATEST = 2.0
"""Maximum log-likelihood ratio of a colour, either way: without it, the colours of few pixels decide."""
ENOUGH_PX = 1000.0
"""Weighted number of pixels of a group at which its colours have half weight: of a nearly hidden target few pixels are known, and
some of these wrongly."""
EVERY = 2
"""Histograms use every second pixel of every second row: as good, in a quarter of the time."""
FEW_PX = 1.0
"""Number of pixels of a colour at which it has half weight."""
UNSURE = 0.5
"""Uncertain pixels, as a share of the target's, above which colours have full weight: on certain masks they mostly add blur."""
SMOOTH_PX = 1.0
"""Standard deviation [px] of the spatial filter: single pixels' colours are noisy."""
OWN_SHARE = 0.05
"""Minimum share of a connected region that the network itself must call the target; other regions are objects of the same
colours."""


class Colours:
    """Colour model of the target and its surroundings for one camera."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Reset, as for another scene."""
        self._seen = np.zeros((len(GROUPS), *SHAPE), np.float32)

    def classes(self, picture: NDArray[np.uint8], logits: NDArray[np.float32], elapsed_s: float) -> NDArray[np.uint8]:
        """The class of each pixel (h, w), from the network's logits (classes, h, w) and the colours.

        picture: RGB (h, w, 3). elapsed_s: time since the previous frame.
        """
        index = _bins(picture)
        of_some, probability = index[::EVERY, ::EVERY].copy(), _probability(logits[:, ::EVERY, ::EVERY].copy())
        target = probability[0]
        doubt = float(np.minimum(target, 1.0 - target).sum()) / max(float(target.sum()), 1.0)
        weight = WEIGHT * min(doubt / UNSURE, 1.0)
        evidence = _evidence(_histograms(of_some, probability), of_some)
        first = probability * np.exp(np.float32(weight) * evidence).transpose(2, 0, 1)
        self._seen *= np.float32(0.5 ** (elapsed_s / HALF_LIFE_S))
        self._seen += _histograms(of_some, first / first.sum(0))
        found, own = np.empty((2, 2, *index.shape), np.uint8)
        _decide(logits, _GROUP_OF, _evidence(self._seen, index), weight, found[0], found[1], own[0], own[1])
        return np.where(_strays(found[1], own[1]), own[0], found[0])


def _bins(picture: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Index of each pixel's bin (h, w) in a flattened histogram."""
    index = np.empty(picture.shape[:2], np.uint16)
    _bin(np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2LAB), np.uint8), index)
    return index


def _probability(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Probability of each group (groups, h, w)."""
    each = np.exp(logits - logits.max(0))
    of_groups = np.stack([each[list(group)].sum(0) for group in GROUPS])
    return of_groups / of_groups.sum(0)


def _histograms(index: NDArray[np.uint16], probability: NDArray[np.float32]) -> NDArray[np.float32]:
    """Number of pixels per colour and group (groups, *SHAPE); index and probability hold one pixel in EVERY squared."""
    counts = np.zeros((len(GROUPS), int(np.prod(SHAPE))))
    _count(index, np.ascontiguousarray(probability), counts)
    return (EVERY**2 * counts).astype(np.float32).reshape(len(GROUPS), *SHAPE)


def _evidence(seen: NDArray[np.float32], index: NDArray[np.uint16]) -> NDArray[np.float32]:
    """For each group, the log-likelihood ratio of each pixel's colour (h, w, groups) between it and the others."""
    smooth = np.empty_like(seen)
    _smooth(seen, smooth)
    of_colour, of_group, tiny = smooth.sum(0), smooth.sum((1, 2, 3)), np.float32(1e-6)
    known, everything = of_colour / (of_colour + FEW_PX), of_group.sum()
    table = np.empty((of_colour.size, len(GROUPS)), np.float32)
    for k, (inside, pixels) in enumerate(zip(smooth, of_group, strict=True)):
        prior = np.log((pixels + tiny) / (everything - pixels + tiny))
        ratio = np.clip(np.log((inside + tiny) / (of_colour - inside + tiny)) - prior, -GREATEST, GREATEST)
        table[:, k] = (ratio * known * (pixels / (pixels + ENOUGH_PX))).ravel()
    return np.asarray(cv2.GaussianBlur(table.take(index, 0), (0, 0), SMOOTH_PX), np.float32)


def _strays(target: NDArray[np.uint8], own: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Connected regions (h, w) of the target that the network's own mask hardly contains; both masks are 0 or 1."""
    count, region = cv2.connectedComponents(target, connectivity=4)
    pixels, seen = np.zeros((2, count), np.int64)
    _measure(region, target, own, pixels, seen)
    return (seen < OWN_SHARE * pixels)[region]


@kernel("u1[h, w, 3], out u2[h, w]")
def _bin(lab, index):
    for row in range(index.shape[0]):
        for column in range(index.shape[1]):
            a, b = lab[row, column, 1], lab[row, column, 2]
            i = 0 if a < 64 else 15 if a > 191 else (a - 64) >> 3
            j = 0 if b < 64 else 15 if b > 191 else (b - 64) >> 3
            index[row, column] = ((np.int64(lab[row, column, 0]) >> 4) << 8) | (i << 4) | j


@kernel("u2[h, w], f4[g, h, w], out f8[g, n]")
def _count(index, probability, counts):
    for group in range(len(counts)):
        for row in range(index.shape[0]):
            for column in range(index.shape[1]):
                counts[group, index[row, column]] += probability[group, row, column]


@kernel("f4[g, l, m, n], out f4[g, l, m, n]")
def _smooth(seen, out):
    """Smooths histograms along each axis in turn: half of each bin goes to its neighbours, at an end to the only one and to
    itself; the sums are kept."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    old = seen.copy()
    for axis in range(3):
        last = seen.shape[axis + 1] - 1
        for g in range(seen.shape[0]):
            for i in range(seen.shape[1]):
                for j in range(seen.shape[2]):
                    for k in range(seen.shape[3]):
                        if axis == 0:
                            sides = old[g, max(i - 1, 0), j, k] + old[g, min(i + 1, last), j, k]
                        elif axis == 1:
                            sides = old[g, i, max(j - 1, 0), k] + old[g, i, min(j + 1, last), k]
                        else:
                            sides = old[g, i, j, max(k - 1, 0)] + old[g, i, j, min(k + 1, last)]
                        out[g, i, j, k] = half * old[g, i, j, k] + quarter * sides
        old[:] = out


@kernel("f4[c, h, w], u1[c], f4[h, w, g], f4, out u1[h, w], out u1[h, w], out u1[h, w], out u1[h, w]")
def _decide(logits, group_of, evidence, weight, found, is_target, own, own_is_target):
    """The class of each pixel with the evidence of its group, times a weight, and by the network's own logits, and whether these
    are of the first group; of equal classes the first one."""
    w = np.float32(weight)
    for row in range(found.shape[0]):
        for column in range(found.shape[1]):
            best, best_own = 0, 0
            greatest, greatest_own = np.float32(-np.inf), np.float32(-np.inf)
            for k in range(len(group_of)):
                value = logits[k, row, column]
                if value > greatest_own:
                    best_own, greatest_own = k, value
                value += w * evidence[row, column, group_of[k]]
                if value > greatest:
                    best, greatest = k, value
            found[row, column], is_target[row, column] = best, group_of[best] == 0
            own[row, column], own_is_target[row, column] = best_own, group_of[best_own] == 0


@kernel("i4[h, w], u1[h, w], u1[h, w], out i8[n], out i8[n]")
def _measure(region, target, own, pixels, seen):
    """Counts the pixels of a target's regions, and those of them that are also in the network's own mask."""
    for row in range(region.shape[0]):
        for column in range(region.shape[1]):
            if target[row, column]:
                pixels[region[row, column]] += 1
                seen[region[row, column]] += own[row, column]
