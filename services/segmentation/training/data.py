"""Training data of the segmentation network: simulated sequences, recordings, and both mixed."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from penumbra.services.segmentation import inference
from penumbra.services.segmentation.training import clothes, priors, recordings
from penumbra.services.segmentation.training.evaluate import WARM_UP, Labelled
from penumbra.shared import training
from penumbra.shared.contract.labels import UNLABELLED, Label
from penumbra.shared.perception.lookout import WIDEST_ARM_PX
from penumbra.sim.picture import looks
from penumbra.sim.sets import sequences

VALIDATION_SEED = 1_000_000
"""Offset to the seed for held-out data: the network is never trained on these seeds."""
VARIETY = sequences.Variety(frames=3, size=176, real=0.7)
"""Variety of the training sequences."""
ARM_PX = (12.0, float(WIDEST_ARM_PX))
"""Bounds of the width [px] to which arms of recordings are scaled."""
ARM_SHARE = 0.08
"""Assumed arm width in a recording without arms, as a share of its longer side."""
CLOTHED = 0.15
"""Share of the sequences of recordings whose arms get other sleeves or gloves."""
BORROWED = 0.15
"""Share of the sequences of recordings in front of which the people of another recording are pasted."""
COVERED = 0.2
"""Share of the sequences of recordings that have simulated robots, occluders and people in front."""
PERSON = (Label.TORSO, Label.UPPER_ARM, Label.FOREARM, Label.HAND)
"""The classes of people."""
AROUND = {"target": 0.55, "rest": 0.25}
"""Shares of the patches that lie around a pixel of the target, and of the rest of a person (faces look like hands, and sleeves
like the clothes above them); the others lie anywhere."""
ENDLESS = 2**31
"""Number of sequences of an endless set."""


class Data(Protocol):
    """Training sequences, and held-out ones for the calibration and the score. The training sequences are red, green, blue and
    class (frames, h, w, 4); if more is known than the labels say, also priors (frames, h, w, 6), packed. jitter: amount of colour
    augmentation; side: the largest patch [px] that fits in all; sources: the card's description of the held-out data; origins:
    its description of the training data."""

    jitter: float
    side: int

    @property
    def sources(self) -> tuple[dict[str, Any], dict[str, Any]]: ...
    @property
    def origins(self) -> list[dict[str, Any]]: ...
    @property
    def calibration(self) -> Iterable[Labelled]: ...
    @property
    def held_out(self) -> Iterable[Labelled]: ...
    @property
    def count(self) -> int:
        """Number of training sequences."""

    def __getitem__(self, index: int, /) -> Any: ...
    def plain(self, index: int, /) -> Any:
        """A sequence with nothing pasted in front, for training the encoder without the layers."""

    def close(self) -> None:
        """Stop making sequences."""


Render = Callable[[int, int], sequences.Sequence]


def _varied(seed: int, index: int) -> sequences.Sequence:
    return sequences.render(seed, index, VARIETY)


class Simulated:
    """Sequences rendered on demand. `each`: number for the calibration, and for the score; `learned`, `scored`: render a sequence
    from a seed and an index, for training, and for calibration and score; `most`: number of training sequences, which are then
    kept in memory."""

    jitter = 0.2
    """Amount of colour augmentation: less than the authors' for photographs, because our renderer varies the light itself."""
    side = VARIETY.size

    def __init__(
        self,
        seed: int,
        each: int = 60,
        learned: Render = _varied,
        scored: Render = sequences.render,
        most: int | None = None,
    ):
        self._seed, self.each, self._learned, self._scored = seed, each, learned, scored
        self.count = ENDLESS if most is None else most
        self._kept = functools.lru_cache(maxsize=most or 0)(self._rendered)

    def __getitem__(self, index: int) -> NDArray[np.uint8]:
        """Red, green, blue, class and priors (frames, h, w, 6) of a sequence."""
        return self._kept(index)

    def plain(self, index: int) -> NDArray[np.uint8]:
        """The same sequence: nothing is pasted in front of it."""
        return self[index]

    def _rendered(self, index: int) -> NDArray[np.uint8]:
        sequence = self._learned(self._seed, index)
        known = priors.of_sequence(sequence, np.random.default_rng([self._seed, 6, index]))
        return np.concatenate([sequence.images, sequence.labels[..., None], priors.packed(known)], axis=-1)

    @property
    def origins(self) -> list[dict[str, Any]]:
        """The card's description of the training data: the seed."""
        return [{"simulated": "sim.sets.sequences", "seed": self._seed}]

    @property
    def sources(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Seeds that are used for nothing else."""
        return {"seed": VALIDATION_SEED + self._seed}, {"seed": VALIDATION_SEED + self._seed + 1}

    @property
    def calibration(self) -> Iterator[sequences.Sequence]:
        """Sequences for the calibration, rendered on demand."""
        return (self._scored(VALIDATION_SEED + self._seed, index) for index in range(self.each))

    @property
    def held_out(self) -> Iterator[sequences.Sequence]:
        """Sequences for the score."""
        return (self._scored(VALIDATION_SEED + self._seed + 1, index) for index in range(self.each))

    def close(self) -> None:
        """Nothing to close."""


class Mixed:
    """Mix of recordings and simulated sequences. `share`: share of simulated training sequences. In front of some recordings are
    the people of others, with the objects that they hold (Ghiasi et al. 2021, arXiv:2012.07177); some have simulated robots and
    occluders in front, half of these also an arm. Calibration and score use equal numbers of both kinds."""

    jitter = 0.15
    """Amount of colour augmentation: photographs are many, and differ themselves."""
    side = VARIETY.size
    count = ENDLESS

    def __init__(self, recorded: recordings.Recordings, simulated: Simulated, share: float, seed: int):
        self._recorded, self._simulated, self._share, self._seed = recorded, simulated, share, seed
        calibration, scored = ({**a, **b} for a, b in zip(simulated.sources, recorded.sources, strict=True))
        self.sources = calibration, {**scored, "simulated": share}
        self.origins = [*({**origin, "share": share} for origin in simulated.origins), *recorded.origins]

    @property
    def calibration(self) -> Iterator[Labelled]:
        """Simulated sequences, and as many patches of recordings."""
        yield from self._simulated.calibration
        yield from patches(self._recorded.calibration, self._simulated.each, VALIDATION_SEED + self._seed)

    @property
    def held_out(self) -> Iterator[Labelled]:
        """Other simulated sequences and patches."""
        yield from self._simulated.held_out
        yield from patches(self._recorded.held_out, self._simulated.each, VALIDATION_SEED + self._seed + 1)

    def __getitem__(self, index: int) -> NDArray[np.uint8]:
        """Red, green, blue, class and priors (frames, h, w, 6) of a sequence."""
        rng = np.random.default_rng([self._seed, 5, index])
        if rng.random() < self._share:
            return self._simulated[index]
        film = self._filmed(rng)
        if rng.random() < BORROWED:
            film = covered(film, self._filmed(rng), (*PERSON, Label.OCCLUDER))
        known = priors.packed(priors.of_labels(film[..., 3], np.random.default_rng([self._seed, 6, index])))
        film = np.concatenate([film, known], axis=-1)
        if rng.random() < COVERED:
            film = pasted(film, self._simulated[index], rng)
        return np.concatenate([looks.filmed(film[..., :3], rng), film[..., 3:]], axis=-1)

    def plain(self, index: int) -> NDArray[np.uint8]:
        """One frame of a recording (1, h, w, 4), turned and moved."""
        return self._shown(np.random.default_rng([self._seed, 9, index]), 1)

    def _filmed(self, rng: np.random.Generator) -> NDArray[np.uint8]:
        """A random recording as seen by a camera (frames, h, w, 4), some with other clothes."""
        film = self._shown(rng, VARIETY.frames)
        return clothes.worn(film, rng) if rng.random() < CLOTHED else film

    def _shown(self, rng: np.random.Generator, frames: int) -> NDArray[np.uint8]:
        return moved(self._recorded[int(rng.integers(self._recorded.count))], frames, VARIETY.size, rng)

    def close(self) -> None:
        """Nothing to close."""


@dataclass(frozen=True)
class Patch:
    """A patch of a recording as a window shows it; `evaluate.Labelled`."""

    images: NDArray[np.uint8]
    labels: NDArray[np.uint8]

    @property
    def hidden(self) -> NDArray[np.float64]:
        return np.full(len(self.labels), np.nan)


def patches(films: Sequence[recordings.Recorded], count: int, seed: int) -> Iterator[Patch]:
    """Patches (`count` of them) of films, each film equally often, at the scale at which windows show arms."""
    order = np.random.default_rng([seed, 7]).permutation(len(films))
    for index in range(count):
        rng = np.random.default_rng([seed, 8, index])
        film = moved(films[order[index % len(films)]], VARIETY.frames + WARM_UP, VARIETY.size, rng)
        yield Patch(film[..., :3], film[..., 3])


def moved(recorded: recordings.Recorded, frames: int, size: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """A recording's frames (`frames`, size, size, 4) as seen by a camera that is turned and moves, at a scale at which its arms
    are as wide as in windows; pixels outside of the picture are UNLABELLED."""
    start = int(rng.integers(0, len(recorded) - frames + 1))
    film = recorded[start : start + frames]
    arms = np.isin(film[frames // 2, ..., 3], inference.TARGET_LABELS)
    arm_px = (
        2.0 * cv2.distanceTransform(arms.astype(np.uint8), cv2.DIST_L2, 5).max() if arms.any() else ARM_SHARE * max(arms.shape)
    )
    zoom = np.exp(rng.uniform(*np.log(ARM_PX))) / arm_px
    if (shrink := int(1.0 / zoom)) > 1:  # avoid aliasing: average details finer than a pixel
        film = np.stack([_smaller(frame, shrink) for frame in film])
        arms, zoom = arms[::shrink, ::shrink], zoom * shrink
    middle = _middle(film[frames // 2, ..., 3], size // 6, rng)
    angle = rng.normal(0.0, 20.0) if rng.random() < 0.7 else rng.uniform(-180.0, 180.0)
    speed = rng.random() ** 1.5
    shift, turn, grow = speed * rng.uniform(-8.0, 8.0, 2), speed * rng.uniform(-2.0, 2.0), 1.0 + speed * rng.uniform(-0.02, 0.02)
    out = np.empty((frames, size, size, 4), np.uint8)
    for t, frame in enumerate(film):
        since = t - frames // 2
        place = cv2.getRotationMatrix2D((float(middle[1]), float(middle[0])), angle + since * turn, zoom * grow**since)
        place[:, 2] += size / 2.0 - middle[::-1] + since * shift
        labels = cv2.extractChannel(frame, 3)
        out[t] = cv2.warpAffine(frame, place, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        out[t, ..., 3] = cv2.warpAffine(labels, place, (size, size), flags=cv2.INTER_NEAREST, borderValue=float(UNLABELLED))
    return out


def _smaller(frame: NDArray[np.uint8], by: int) -> NDArray[np.uint8]:
    height, width = (n // by for n in frame.shape[:2])
    smaller = np.asarray(cv2.resize(frame[: height * by, : width * by], (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    smaller[..., 3] = frame[by // 2 :: by, by // 2 :: by, 3][:height, :width]
    return smaller


def pasted(film: NDArray[np.uint8], over: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A film (frames, h, w, 6) with the robot and the occluders of another in front, and the prior of this robot; half of the
    time also its person, and half of these with the prior of the pasted arms instead of the film's own."""
    front, out = [Label.ROBOT, Label.OCCLUDER], film.copy()
    out[..., 4] = over[..., 4]
    if rng.random() < 0.5:
        front += PERSON
        if rng.random() < 0.5:
            out[..., 5] = over[..., 5]
    return covered(out, over, front)


def covered(film: NDArray[np.uint8], over: NDArray[np.uint8], classes: Sequence[Label]) -> NDArray[np.uint8]:
    """A film (frames, h, w, 4 or more) with the pixels of these classes in another film pasted in front."""
    out = film.copy()
    for below, above in zip(out, over, strict=True):
        cover = np.isin(above[..., 3], classes)
        soft = cv2.GaussianBlur(cover.astype(np.float32), (0, 0), 0.7)[..., None]  # as the lens does along an edge
        below[..., :3] = (soft * above[..., :3] + (1.0 - soft) * below[..., :3] + 0.5).astype(np.uint8)
        below[cover, 3] = above[cover, 3]
    return out


def draw_batch(
    chosen: Iterable[Any], frames: int, size: int, rng: np.random.Generator, amount: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Random patches of `frames` frames of sequences (n, h, w, 4 or 6): images (batch, frames, 3, size, size) in [0, 1], labels
    (batch, frames, size, size) and priors (batch, frames, 2, size, size), made from the labels if a sequence has none. Patches
    are placed by AROUND; mirrored, played backwards and recoloured at random, by `amount`."""
    images, labels, known = [], [], []
    for sequence in chosen:
        start = rng.integers(0, len(sequence) - frames + 1)
        sequence = sequence[start : start + frames]
        height, width = sequence.shape[1:3]
        middle = _middle(sequence[rng.integers(len(sequence)), ..., 3], size // 3, rng)
        y, x = np.clip(middle - size // 2, 0, [height - size, width - size])
        patch = sequence[:, y : y + size, x : x + size]
        if rng.random() < 0.5:
            patch = patch[:, :, ::-1]
        if rng.random() < 0.5:
            patch = patch[::-1]
        picture = training.recoloured(patch[..., :3].astype(np.float32) / 255.0, rng, amount)
        images.append(torch.from_numpy(picture).movedim(-1, 1))
        labels.append(torch.from_numpy(patch[..., 3].astype(np.int64)))
        prior = priors.unpacked(patch[..., 4:]) if patch.shape[-1] > 4 else priors.of_labels(patch[..., 3], rng)
        known.append(torch.from_numpy(prior).movedim(-1, 1))
    return torch.stack(images), torch.stack(labels), torch.stack(known)


def _middle(labels: NDArray[np.uint8], beside: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Row and column of the centre of a patch of a picture with these classes (h, w): up to `beside` pixels from a pixel chosen
    by AROUND, or anywhere if there is none."""
    chosen = rng.random()
    if chosen < sum(AROUND.values()):
        which = inference.TARGET_LABELS if chosen < AROUND["target"] else (Label.TORSO, Label.UPPER_ARM)
        there = np.argwhere(np.isin(labels, which))
        if len(there):
            around: NDArray[np.int64] = there[rng.integers(len(there))] + rng.integers(-beside, beside + 1, size=2)
            return around
    return rng.integers(0, labels.shape)
