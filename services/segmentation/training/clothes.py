"""Draws sleeves and gloves on the bare arms of photographs.

Few photographs show sleeved forearms or gloves, and a network that has seen few takes skin colour for an arm. The shading of the
photograph is kept; its colour becomes that of a drawn cloth.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.shared.contract.labels import TARGET_LABELS, UNLABELLED, Label
from penumbra.sim.picture import looks
from penumbra.sim.picture.appearance import BLOTCHES, CHECKS, STRIPES, Texture

RIM_PX = 3
"""Unlabelled pixels this close [px] to clothed ones are clothed, too: for coarsely labelled contours."""
BRIGHT = 0.8
"""Quantile of a limb's brightness at which the cloth's colour is shown: brighter pixels are highlights."""
PERIOD_PX = 3.0, 25.0
"""Bounds [px] of the period of a cloth's pattern."""


def worn(film: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A film (frames, h, w, 4 or more) of red, green, blue and class whose forearms get sleeves (long or rolled up), whose hands
    get gloves, or both."""
    labels = film[len(film) // 2, ..., 3]
    if not np.isin(labels, TARGET_LABELS).any():
        return film
    choice, share = rng.random(), rng.random()
    sleeve = looks.cloth(rng) if choice < 0.75 else None
    glove = looks.cloth(rng) if choice > 0.6 else None
    toward = _toward_elbow(labels, rng)
    reach = np.quantile(_along(toward, *np.nonzero(np.isin(labels, TARGET_LABELS))), 0.6 * share)
    out = film.copy()
    for cloth, parts in ((sleeve, (Label.FOREARM, Label.UPPER_ARM)), (glove, (Label.HAND,))):
        if cloth is None:
            continue
        pattern = _pattern(cloth, labels.shape, rng)
        for before, after in zip(film, out, strict=True):
            covered = np.isin(before[..., 3], parts)
            if cloth is sleeve and choice < 0.4:  # rolled up
                covered &= _along(toward, *np.indices(covered.shape)) > reach
            after[..., :3] = _dyed(before, covered, cloth, pattern)
    return out


def _toward_elbow(labels: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.float64]:
    """Direction (2,) row, column from hands to forearms; random if the picture does not show both."""
    hand, forearm = (np.argwhere(labels == part) for part in (Label.HAND, Label.FOREARM))
    if len(hand) and len(forearm):
        away = forearm.mean(0) - hand.mean(0)
        if np.linalg.norm(away) > 1.0:
            return away / np.linalg.norm(away)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.sin(angle), np.cos(angle)])


def _along(direction: NDArray[np.float64], rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float64]:
    return direction[0] * rows + direction[1] * columns


def _pattern(cloth: Texture, size: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float32]:
    """Share in [0, 1] of the cloth's second colour at each pixel (h, w)."""
    period, angle = float(np.exp(rng.uniform(*np.log(PERIOD_PX)))), rng.uniform(0.0, np.pi)
    rows, columns = np.indices(size, np.float32) * np.float32(2.0 * np.pi / period)
    across = np.sin(np.cos(angle) * rows + np.sin(angle) * columns)
    if cloth.pattern == STRIPES:
        mixed = across > 0.0
    elif cloth.pattern == CHECKS:
        mixed = (across > 0.0) ^ (np.sin(np.sin(angle) * rows - np.cos(angle) * columns) > 0.0)
    elif cloth.pattern == BLOTCHES:
        noise = cv2.GaussianBlur(rng.normal(size=size).astype(np.float32), (0, 0), period / 4.0)
        mixed = np.clip(0.5 + noise / max(4.0 * float(noise.std()), 1e-6), 0.0, 1.0)
    else:  # plain
        return np.zeros(size, np.float32)
    return cloth.contrast * cv2.GaussianBlur(mixed.astype(np.float32), (0, 0), 0.6)


def _dyed(
    frame: NDArray[np.uint8], covered: NDArray[np.bool_], cloth: Texture, pattern: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """The picture (h, w, 3) of a frame (h, w, 4 or more) with the covered pixels (h, w) in the colours of a cloth."""
    picture = frame[..., :3]
    if not covered.any():
        return picture
    rim = np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)
    near = cv2.dilate(covered.astype(np.uint8), rim) > 0
    cover = covered | (near & (frame[..., 3] == UNLABELLED))
    soft = cv2.GaussianBlur(cover.astype(np.float32), (0, 0), 0.7)[..., None]
    linear = (picture.astype(np.float32) / 255.0) ** 2
    shade = linear.mean(axis=-1)
    shade = np.clip(shade / max(float(np.quantile(shade[covered], BRIGHT)), 1e-3), 0.0, 1.5)[..., None]
    own, accent = np.array(cloth.colour, np.float32), np.array(cloth.accent, np.float32)
    dyed = np.clip(shade * (own + pattern[..., None] * (accent - own)), 0.0, 1.0) ** 0.5 * 255.0
    return (soft * dyed + (1.0 - soft) * picture + 0.5).astype(np.uint8)
