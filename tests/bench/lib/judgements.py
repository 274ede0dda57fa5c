"""What the search says of its own poses: frames with right and wrong starts and masks, or without a target, and how well its
confidence tells them apart."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import rankdata

from penumbra.services.search.tracker import Searched
from penumbra.services.segmentation.inference import Segmenter
from penumbra.shared.contract.labels import Label
from penumbra.shared.contract.messages import Mask
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.lookout import whole_frame
from penumbra.sim.sets import shots
from penumbra.sim.sets.shots import Shot
from penumbra.tests.bench.lib.searches import (
    HIDDEN,
    NEES_VIEW,
    PRIOR,
    Result,
    around,
    network_masks,
    perturbed,
    search_of,
    searched,
)

GONE = 0.95
"""Hidden share above which nothing is left to track."""
CONFIDENCES = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.01)
"""Bounds of the confidences that are compared with the share of right poses."""
KINDS = ("good start", "bad start", "wrong mask", "no prior", "absent")


@dataclass(frozen=True)
class Judgement:
    """A frame of one of KINDS: the estimate, whether its pose is wrong, whether the mask shows the target.

    Where the search gives up, it reports the start's pose. With a good start and a mask that shows something else this pose is
    right by chance: such a frame counts as one that should be doubted.
    """

    kind: str
    estimate: Searched
    is_wrong: bool
    is_shown: bool

    @property
    def is_told(self) -> bool:
        return self.estimate.state == "tracking"

    @property
    def confidence(self) -> float:
        """0 where the search did not say."""
        return self.estimate.confidence or 0.0

    @property
    def should_be_doubted(self) -> bool:
        return self.is_wrong or not (self.is_shown or self.is_told)


def lost_frames(
    seed: int,
    count: int,
    segmenter: Segmenter,
    domain: shots.Domain,
    view: tuple[int, int, float] = NEES_VIEW,
    hands: shots.Hands = "stiff",
    has_image: bool = True,
    spreads: tuple[float, ...] = (1.0,),
) -> Iterator[Judgement]:
    """Frames of all KINDS. has_image: whether the search gets the image as well; spreads: factors, in turn, on the standard
    deviations of the starts, which the search knows; bad starts are not as near as it is told."""
    for index in range(count):
        rng = np.random.default_rng([seed, index, 2])
        spread = spreads[index % len(spreads)]

        def judgement(kind: str, shot: Shot, mask: Mask, T_prior: Array | None, spread: float = spread) -> Judgement:
            search, covariance = search_of(shot, "default", False), None if T_prior is None else spread**2 * PRIOR
            estimate = search.update(mask, T_prior, covariance, shot.joints, shot.image if has_image else None)
            is_wrong = Result(estimate, shot, 0.0).is_wrong or kind == "absent"
            return Judgement(kind, estimate, is_wrong, shows_target(mask, shot))

        film = shots.clip(seed, index, *view, HIDDEN[index % len(HIDDEN)], domain, 3, hands=hands)
        last = film[-1]
        near, far = spread * perturbed(rng), np.concatenate([_length(rng, 0.08, 0.4), _length(rng, 0.3, 1.5)])
        T_near, T_far = (rigid.perturb(last.T_world_target, error) for error in (near, far))
        *_, mask = network_masks(segmenter, film, around(near))
        yield judgement("good start", last, mask, T_near)
        yield judgement("wrong mask", last, spoiled(mask, rng), T_near)
        *_, mask = network_masks(segmenter, film, around(far))
        yield judgement("bad start", last, mask, T_far)
        *_, mask = network_masks(segmenter, film, lambda shot, previous: whole_frame(shot.camera))
        yield judgement("no prior", last, mask, None)
        empty = shots.clip(seed, index, *view, 0.0, domain, 3, present=False)
        T_prior = rigid.perturb(empty[-1].T_world_target, near) if index % 2 else None
        *_, mask = network_masks(segmenter, empty, around(near))
        yield judgement("absent", empty[-1], mask, T_prior)


def shows_target(mask: Mask, shot: Shot) -> bool:
    """Whether the IoU of the target's pixels in the mask and in the truth is at least a half."""
    target = (Label.FOREARM, Label.HAND)
    ours = np.zeros(shot.labels.shape, bool)
    h, w = (n * mask.scale for n in mask.labels.shape)
    ours[mask.y0 : mask.y0 + h, mask.x0 : mask.x0 + w] = np.kron(
        np.isin(mask.labels, target), np.ones((mask.scale, mask.scale), bool)
    )
    theirs = np.isin(shot.labels, target)
    return bool((ours & theirs).sum() >= 0.5 * max((ours | theirs).sum(), 1))


def _length(rng: np.random.Generator, low: float, high: float) -> Array:
    v = rng.normal(size=3)
    return rng.uniform(low, high) * v / np.linalg.norm(v)


def spoiled(mask: Mask, rng: np.random.Generator) -> Mask:
    """A mask that is wrong about where the target is: mirrored, turned by 180 degrees, moved away, or with the upper arm's region
    called the target and the target background."""
    labels = mask.labels
    kind = rng.integers(4)
    if kind == 0:
        labels = labels[:, ::-1]
    elif kind == 1:
        labels = labels[::-1, ::-1]
    elif kind == 2:
        labels = np.roll(labels, rng.choice([-1, 1], 2) * np.array(labels.shape) // 4, axis=(0, 1))
    else:
        table = np.arange(256, dtype=np.uint8)
        table[[Label.FOREARM, Label.HAND, Label.UPPER_ARM]] = Label.BACKGROUND, Label.BACKGROUND, Label.FOREARM
        labels = table[labels]
    return Mask(stamp_ns=mask.stamp_ns, labels=np.ascontiguousarray(labels), x0=mask.x0, y0=mask.y0, scale=mask.scale)


def gone_frames(seed: int, count: int, segmenter: Segmenter, domain: shots.Domain) -> Iterator[Searched]:
    """Estimates from frames in which more than GONE of the target is hidden."""
    for index in range(count):
        film = shots.clip(seed, index, *NEES_VIEW, (0.975, 0.99, 1.0)[index % 3], domain, 5)
        error = perturbed(np.random.default_rng([seed, index, 3]))
        search = search_of(film[-1], "default", False)
        for shot, mask in zip(film, network_masks(segmenter, film, around(error)), strict=True):
            found = searched(shot, search, mask, rigid.perturb(shot.T_world_target, error))
            if shot.hidden > GONE:
                yield found.estimate


def auc(scores: Array, positive: np.ndarray) -> float | None:
    """Area under the ROC curve: the probability that a positive scores above a negative, ties counted half."""
    n, p = int((~positive).sum()), int(positive.sum())
    if not n or not p:
        return None
    return float((rankdata(scores)[positive].sum() - p * (p + 1) / 2.0) / (n * p))


def reliability(frames: Sequence[Judgement]) -> list[dict[str, Any]]:
    """By bounds of the confidence: the number of frames, their mean confidence, and the share that should not be doubted."""
    rows = []
    for low, high in itertools.pairwise(CONFIDENCES):
        chosen = [frame for frame in frames if low <= frame.confidence < high]
        if chosen:
            mean = float(np.mean([frame.confidence for frame in chosen]))
            right = float(np.mean([not frame.should_be_doubted for frame in chosen]))
            rows.append({"low": low, "high": high, "frames": len(chosen), "confidence": round(mean, 3), "right": round(right, 3)})
    return rows
