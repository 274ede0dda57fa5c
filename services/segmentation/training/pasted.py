"""Cuts hands out from plain backgrounds and pastes them in front of photographs without people, with exact masks.

A hand of the Sign Language Digits Dataset (Mavi 2020, arXiv:2011.08927) is separated from the wall behind it by colour. Pictures
on white, whose hands have masks, are cut out with everything that they show.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.shared.contract.labels import TARGET_LABELS, UNLABELLED, Label

SIDE = 200
"""Side [px] at which a hand is cut out."""
CLEAR = 1.15
"""Colour difference from the wall above which a pixel likely belongs to the hand, as a multiple of Otsu's threshold."""
ARM_PX = 12
"""Minimum width [px] of an arm where it leaves the picture."""
AREA = 0.09, 0.55
"""Bounds of a cut-out hand's share of its picture: below, it is only a part of a hand; above, it contains wall."""
DISTINCT = 0.45
"""Minimum colour difference from the wall of nearly all of a hand, as a share of its median: below, it is a shadow."""
WRIST = 0.78
"""Maximum width of a wrist, as a share of the hand's maximum width."""
WRIST_PX = 5
"""Half the height [px] of the unlabelled band about the wrist."""
WHITE = 180
"""Value of the darkest channel above which a pixel counts as white."""
SCALES = 0.45, 0.85
"""Bounds of the scale from pixels of a cut-out hand to pixels of a scene."""
TILT_RAD = 0.4
"""Maximum angle [rad] of an arm from its side's normal."""
BEYOND_PX = 3
"""Distance [px] that an arm reaches beyond its side of the scene, so that its end is not seen."""


@dataclass(frozen=True)
class Cutout:
    """A cut-out to paste: image (h, w, 3) BGR, solid (h, w), 1 where it hides the background, and classes (h, w)."""

    image: NDArray[np.uint8]
    solid: NDArray[np.uint8]
    labels: NDArray[np.uint8]


def hand(image: NDArray[np.uint8]) -> Cutout | None:
    """The hand of a picture (h, w, 3) BGR whose arm leaves through the lower edge, before a plain wall that fills the upper one;
    None if no hand is clearly separated from the wall."""
    image = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC).astype(np.uint8)
    colours = cv2.cvtColor(image, cv2.COLOR_BGR2LAB)[..., 1:].astype(np.float32)
    edge, upper = SIDE // 20, SIDE * 3 // 5
    around = (colours[:edge], colours[:upper, :edge], colours[:upper, -edge:])
    wall = np.median(np.concatenate([part.reshape(-1, 2) for part in around]), axis=0)
    difference = np.linalg.norm(colours - wall, axis=2)
    scaled = (255.0 * difference / max(float(difference.max()), 1e-6)).astype(np.uint8)
    threshold, _ = cv2.threshold(scaled, 0, 255, cv2.THRESH_OTSU)
    other = cv2.morphologyEx((scaled > CLEAR * threshold).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    guess = np.where(other > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    guess[cv2.erode(other, np.ones((9, 9), np.uint8)) > 0] = cv2.GC_FGD
    guess[cv2.dilate(other, np.ones((21, 21), np.uint8)) == 0] = cv2.GC_BGD
    if not (guess == cv2.GC_FGD).any() or not (guess == cv2.GC_BGD).any():
        return None
    cv2.setRNGSeed(0)  # GrabCut uses a process-wide generator; the same picture must be cut the same way
    cv2.grabCut(image, guess, (0, 0, 0, 0), np.zeros((1, 65)), np.zeros((1, 65)), 2, cv2.GC_INIT_WITH_MASK)
    solid = largest(cv2.medianBlur(np.isin(guess, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8), 5).astype(np.uint8))
    inside = difference[cv2.erode(solid, np.ones((5, 5), np.uint8)) > 0]
    leaves_elsewhere = solid[:3].any() or solid[: SIDE // 2, :3].any() or solid[: SIDE // 2, -3:].any()
    if not AREA[0] < solid.mean() < AREA[1] or leaves_elsewhere or solid[-1].sum() < ARM_PX or not inside.size:
        return None
    if np.quantile(inside, 0.08) < DISTINCT * np.median(inside):
        return None
    return Cutout(image, solid, parted(solid))


def largest(solid: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The largest connected part of a mask (h, w)."""
    _, parts, stats, _ = cv2.connectedComponentsWithStats(solid)
    areas = stats[1:, cv2.CC_STAT_AREA]
    return (parts == 1 + int(areas.argmax())).astype(np.uint8) if areas.size else solid


def parted(solid: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Classes (h, w) of a hand (h, w) whose arm leaves through the lower edge: pixels below its narrowest row are forearm, if
    that row is clearly narrower than the hand."""
    labels = np.where(solid > 0, Label.HAND, Label.BACKGROUND).astype(np.uint8)
    widths = cv2.blur(solid.sum(1).astype(np.float32)[:, None], (1, 9)).ravel()
    widest = int(widths.argmax())
    wrist = widest + int(widths[widest:].argmin())
    if widths[wrist] < WRIST * widths[widest]:
        below, band = np.s_[wrist:], np.s_[wrist - WRIST_PX : wrist + WRIST_PX]
        labels[below][solid[below] > 0] = Label.FOREARM
        labels[band][solid[band] > 0] = UNLABELLED
    return labels


def on_white(image: NDArray[np.uint8], labels: NDArray[np.uint8]) -> Cutout:
    """Everything that is not white in a picture (h, w, 3) BGR with known classes (h, w)."""
    things = cv2.morphologyEx((image.min(2) < WHITE).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
    solid = ((things > 0) | np.isin(labels, TARGET_LABELS)).astype(np.uint8)
    return Cutout(image, solid, labels)


def from_side(cutout: Cutout, height: int, width: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Random affine map (2, 3) that places a hand in a scene (height, width) with its arm coming in from one side."""
    rows, columns = cutout.solid.shape
    scale, turn = rng.uniform(*SCALES), rng.uniform(-TILT_RAD, TILT_RAD)
    side = int(rng.integers(4))  # from below, from the left, from above, from the right
    beyond = BEYOND_PX + scale * columns / 2.0 * np.sin(abs(turn))
    along = rng.uniform(0.15, 0.85)
    ends = np.array(
        [
            (along * width, height + beyond),
            (-beyond, along * height),
            (along * width, -beyond),
            (width + beyond, along * height),
        ]
    )
    angle = side * np.pi / 2.0 + turn
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    linear = scale * turned @ np.diag([rng.choice([-1.0, 1.0]), 1.0])
    return np.column_stack([linear, ends[side] - linear @ (columns / 2.0, rows)])


def filling(cutout: Cutout, height: int, width: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Affine map (2, 3) with which a whole picture fills a scene (height, width), mirrored at random in either direction."""
    rows, columns = cutout.solid.shape
    mirrored = rng.choice([-1.0, 1.0], 2)
    linear = np.diag(mirrored * (width / columns, height / rows))
    return np.column_stack([linear, np.where(mirrored < 0.0, (width, height), 0.0)])


def paste(
    scene: NDArray[np.uint8],
    labels: NDArray[np.uint8],
    cutout: Cutout,
    place: NDArray[np.float64],
    rng: np.random.Generator,
) -> None:
    """Paste a cut-out in front of a scene (h, w, 3) BGR and its classes (h, w), both changed in place, by an affine map (2, 3),
    with other light and colour, a soft shadow and a soft edge; the edge of labelled parts is unlabelled."""
    size = labels.shape[::-1]
    image = cv2.warpAffine(cutout.image, place, size, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    solid, classes = (cv2.warpAffine(part, place, size, flags=cv2.INTER_NEAREST) for part in (cutout.solid, cutout.labels))
    three = np.ones((3, 3), np.uint8)
    cover = cv2.GaussianBlur(cv2.erode(solid, three).astype(np.float32), (0, 0), 0.8)[..., None]
    shift = np.array([[1.0, 0.0, rng.uniform(-12.0, 12.0)], [0.0, 1.0, rng.uniform(-12.0, 12.0)]])
    shadow = (
        rng.uniform(0.1, 0.45) * cv2.GaussianBlur(cv2.warpAffine(solid.astype(np.float32), shift, size), (0, 0), 8.0)[..., None]
    )
    light = (rng.uniform(0.75, 1.2) * np.exp(rng.normal(0.0, 0.035, 3))).astype(np.float32)
    front = np.minimum(image * light, 255.0)
    scene[:] = (scene * (1.0 - shadow) * (1.0 - cover) + front * cover).astype(np.uint8)
    labels[solid > 0] = classes[solid > 0]
    known = (classes != Label.BACKGROUND).astype(np.uint8)
    labels[cv2.dilate(known, three) != cv2.erode(known, three)] = UNLABELLED


def noisy(scene: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A scene (h, w, 3) with noise of a random amount, the same over pasted parts and background."""
    noise = rng.normal(0.0, rng.uniform(0.0, 4.0), scene.shape)
    return np.clip(np.rint(scene + noise), 0.0, 255.0).astype(np.uint8)
