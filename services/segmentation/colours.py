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

from penumbra.services.segmentation.classes import classes
from penumbra.shared.contract.labels import TARGET_LABELS, Label

SHAPE = (16, 16, 16)
"""Bins of L*, a* and b*: 16, 8 and 8 levels wide; a* and b* beyond 64 of 128 either way, which are rare, count as 64. L* in 8
bins was worse, narrower bins of a* and b* no better."""
GROUPS = (tuple(TARGET_LABELS), (Label.TORSO, Label.UPPER_ARM), (Label.ROBOT,), (Label.BACKGROUND, Label.OCCLUDER))
"""Classes that share a histogram, the target's first."""
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
        some, of_some = np.ascontiguousarray(logits[:, ::EVERY, ::EVERY]), np.ascontiguousarray(index[::EVERY, ::EVERY])
        probability = _probability(some)
        target = probability[0]
        doubt = float(np.minimum(target, 1.0 - target).sum()) / max(float(target.sum()), 1.0)
        weight = WEIGHT * min(doubt / UNSURE, 1.0)
        first = _with(some, _evidence(_histograms(of_some, probability), of_some), weight)
        self._seen *= np.float32(0.5 ** (elapsed_s / HALF_LIFE_S))
        self._seen += _histograms(of_some, _probability(first))
        found, own = classes(_with(logits, _evidence(self._seen, index), weight)), classes(logits)
        return np.where(_strays(_is_target(found), _is_target(own)), own, found)


def _bins(picture: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Index of each pixel's bin (h, w) in a flattened histogram."""
    lab = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2LAB), np.uint8)
    light, a, b = lab[..., 0] >> 4, *(np.clip(lab[..., k] >> 3, 8, 23) - 8 for k in (1, 2))
    return np.asarray((light.astype(np.intp) << 8) | (a.astype(np.intp) << 4) | b)


def _probability(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Probability of each group (groups, h, w)."""
    each = np.exp(logits - logits.max(0))
    of_groups = np.stack([each[list(group)].sum(0) for group in GROUPS])
    return of_groups / of_groups.sum(0)


def _histograms(index: NDArray[np.intp], probability: NDArray[np.float32]) -> NDArray[np.float32]:
    """Number of pixels per colour and group (groups, *SHAPE); index and probability hold one pixel in EVERY squared."""
    flat, size = index.ravel(), int(np.prod(SHAPE))
    counts = np.stack([np.bincount(flat, of.ravel(), size).reshape(SHAPE) for of in probability])
    return (EVERY**2 * counts).astype(np.float32)


def _evidence(seen: NDArray[np.float32], index: NDArray[np.intp]) -> list[NDArray[np.float32]]:
    """For each group, the log-likelihood ratio of each pixel's colour (h, w) between it and the others."""
    seen = _smoothed(seen)
    of_colour, of_group, tiny = seen.sum(0), seen.sum((1, 2, 3)), np.float32(1e-6)
    known, everything, found = of_colour / (of_colour + FEW_PX), of_group.sum(), []
    for inside, pixels in zip(seen, of_group, strict=True):
        prior = np.log((pixels + tiny) / (everything - pixels + tiny))
        ratio = np.clip(np.log((inside + tiny) / (of_colour - inside + tiny)) - prior, -GREATEST, GREATEST)
        ratio *= known * (pixels / (pixels + ENOUGH_PX))
        found.append(cv2.GaussianBlur(ratio.ravel()[index], (0, 0), SMOOTH_PX))
    return found


def _smoothed(seen: NDArray[np.float32]) -> NDArray[np.float32]:
    """Histograms smoothed along each axis in turn: half of each bin goes to its neighbours; the sums are kept."""
    for axis in range(1, 4):
        old = np.moveaxis(seen, axis, 0)
        new = 0.5 * old
        new[1:] += 0.25 * old[:-1]
        new[:-1] += 0.25 * old[1:]
        new[[0, -1]] += 0.25 * old[[0, -1]]
        seen = np.moveaxis(new, 0, axis)
    return seen


def _with(logits: NDArray[np.float32], evidence: list[NDArray[np.float32]], weight: float) -> NDArray[np.float32]:
    out = logits.copy()
    for group, found in zip(GROUPS, evidence, strict=True):
        for label in group:
            out[label] += np.float32(weight) * found
    return out


def _is_target(index: NDArray[np.uint8]) -> NDArray[np.bool_]:
    found: NDArray[np.bool_] = np.isin(index, GROUPS[0])
    return found


def _strays(target: NDArray[np.bool_], own: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Connected regions (h, w) of the target that the network's own mask hardly contains."""
    count, region = cv2.connectedComponents(target.astype(np.uint8), connectivity=4)
    pixels, seen = (np.bincount(region[chosen], minlength=count) for chosen in (target, own & target))
    return (seen < OWN_SHARE * pixels)[region]
