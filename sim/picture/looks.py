"""Looks of real rooms, people and cameras, for training: coloured light, wrong white balance, saturated walls, strong shading,
black and patterned sleeves, gloves, and the artefacts of a cheap camera.

Those of `sim.picture.appearance` stay as they are, so that benchmarks remain comparable.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.shared.contract.labels import Label
from penumbra.sim.picture import appearance
from penumbra.sim.picture.appearance import BLOTCHES, CHECKS, PLAIN, STRIPES, Appearance, Colour, Look, Texture, hsv

BALANCE = 0.4
"""Maximum share by which a wrong white balance makes a channel brighter or darker in the picture."""


def skin(rng: np.random.Generator) -> Texture:
    """Human skin under any make of camera: from pale to very dark, with blotches, hair and veins of some contrast."""
    depth = rng.uniform()
    hue = rng.uniform(0.01, 0.09)
    saturation = 0.15 + 0.45 * depth * rng.uniform(0.5, 1.2) + rng.uniform(0.0, 0.15)
    value = 1.0 - 0.7 * depth + rng.uniform(-0.05, 0.05)
    accent = hsv(hue - rng.uniform(0.0, 0.03), saturation + rng.uniform(-0.05, 0.2), value * rng.uniform(0.4, 0.9))
    return Texture(hsv(hue, saturation, value), accent, BLOTCHES, _length(rng, 0.003, 0.08), rng.uniform(0.3, 1.0))


def cloth(rng: np.random.Generator) -> Texture:
    """Clothes and gloves of any colour: one in four black, one in eight white, the others of any hue; two in three patterned,
    some strongly."""
    choice = rng.uniform()
    if choice < 0.25:
        colour = hsv(rng.uniform(), rng.uniform(0.0, 0.4), rng.uniform(0.03, 0.22))
    elif choice < 0.375:
        colour = hsv(rng.uniform(), rng.uniform(0.0, 0.1), rng.uniform(0.8, 1.0))
    else:
        colour = hsv(rng.uniform(), rng.uniform(0.0, 0.95), rng.uniform(0.15, 0.95))
    accent = hsv(rng.uniform(), rng.uniform(0.0, 0.9), rng.uniform(0.05, 1.0))
    pattern = int(rng.choice([PLAIN, BLOTCHES, STRIPES, CHECKS], p=[0.35, 0.35, 0.15, 0.15]))
    return Texture(colour, accent, pattern, _length(rng, 0.004, 0.1), rng.uniform(0.05, 1.0) ** 1.5)


def person(rng: np.random.Generator) -> dict[Label, Appearance]:
    """Bare, half sleeved and sleeved arms, a fifth with gloves."""
    bare, shirt, glove = skin(rng), cloth(rng), cloth(rng)
    gloss = float(rng.choice([0.0, rng.uniform(0.0, 0.4)]))
    hand = glove if rng.uniform() < 0.25 else bare
    length = rng.uniform()
    if length < 0.5:  # short sleeves
        forearm = Appearance(hand, bare, rng.uniform(0.06, 0.14), gloss)
        upper_arm = Appearance(bare, shirt, rng.uniform(0.0, 0.32), gloss)
    elif length < 0.7:  # rolled up
        forearm, upper_arm = Appearance(bare, shirt, rng.uniform(-0.12, 0.1), gloss), Appearance(shirt)
    else:
        forearm, upper_arm = Appearance(hand, shirt, rng.uniform(0.09, 0.16), gloss), Appearance(shirt)
    return {Label.FOREARM: forearm, Label.UPPER_ARM: upper_arm, Label.TORSO: Appearance(shirt)}


def thing(rng: np.random.Generator) -> Appearance:
    """Furniture, clutter and things held or passing by, as in `sim.picture.appearance` or like clothes."""
    if rng.uniform() < 0.6:
        return Appearance(appearance.occluder(rng), gloss=float(rng.choice([0.0, rng.uniform(0.0, 0.5)])))
    return Appearance(cloth(rng), gloss=rng.uniform(0.0, 0.5))


def background(rng: np.random.Generator) -> Appearance:
    """A wall or a room, as in `sim.picture.appearance` or of a saturated colour."""
    if rng.uniform() < 0.6:
        return appearance.background(rng)
    hue, value = rng.uniform(), rng.uniform(0.2, 1.0)
    colour = hsv(hue, rng.uniform(0.3, 1.0), value)
    accent = hsv(hue + rng.normal(0.0, 0.1), rng.uniform(0.0, 1.0), value * rng.uniform(0.3, 1.1))
    pattern = int(rng.choice([PLAIN, BLOTCHES, STRIPES, CHECKS], p=[0.35, 0.45, 0.1, 0.1]))
    return Appearance(Texture(colour, accent, pattern, _length(rng, 0.05, 2.0), rng.uniform(0.1, 1.0)), casts_shadow=False)


def look(rng: np.random.Generator, around: tuple[float, float, float]) -> Look:
    """Light from above or from aside, soft or hard, of any colour; a sensor whose exposure and white balance are off."""
    usual = appearance.look(rng, around)
    angle, distance, height = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.3, 2.5), rng.uniform(0.1, 2.2)
    lamp = (around[0] + distance * math.cos(angle), around[1] + distance * math.sin(angle), around[2] + height)
    share = rng.uniform(0.4, 0.95)  # of the light that comes from the lamp and casts shadows
    strength = rng.uniform(0.9, 1.8)
    off = 2.0 * math.log1p(BALANCE) * rng.uniform()  # twice, as the picture shows the square root
    balance = np.exp(off * rng.uniform(-1.0, 1.0, 3))
    return dataclasses.replace(
        usual,
        lamp=lamp,
        lamp_colour=_tinted(rng, strength * share),
        ambient=_tinted(rng, strength * (1.0 - share)),
        background=background(rng),
        blur_px=rng.uniform(0.3, 1.6),
        noise=rng.uniform(0.002, 0.05),
        gain=tuple(rng.uniform(0.7, 1.4) * balance / balance.mean()),
        jpeg=int(rng.integers(15, 96)) if rng.uniform() < 0.5 else None,
    )


def _tinted(rng: np.random.Generator, strength: float) -> Colour:
    """Light of a strength: in three of five cases nearly white, otherwise warm or of any colour."""
    choice = rng.uniform()
    if choice < 0.6:
        colour = hsv(rng.uniform(), rng.uniform(0.0, 0.1), 1.0)
    elif choice < 0.85:
        colour = hsv(rng.uniform(0.04, 0.14), rng.uniform(0.1, 0.6), 1.0)
    else:
        colour = hsv(rng.uniform(), rng.uniform(0.1, 0.5), 1.0)
    mean = sum(colour) / 3.0
    return (strength * colour[0] / mean, strength * colour[1] / mean, strength * colour[2] / mean)


def filmed(images: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A film (frames, h, w, 3) with the artefacts of a cheap camera: motion blur, low resolution, sharpening, a tone curve,
    flicker of lamps in bands of rows, hunting exposure, compression; each in some films only."""
    frames, height, width = images.shape[:3]
    kernel = _motion(rng) if rng.random() < 0.25 else None
    coarse = rng.uniform(0.35, 0.8) if rng.random() < 0.2 else 1.0
    sharpen = rng.uniform(0.3, 2.0) if rng.random() < 0.25 else 0.0
    gamma = np.exp(rng.normal(0.0, 0.2)) if rng.random() < 0.5 else 1.0
    saturation = rng.uniform(0.2, 1.5) if rng.random() < 0.3 else 1.0
    flicker = rng.uniform(0.03, 0.15) if rng.random() < 0.1 else 0.0
    hunting = rng.normal(0.0, 0.04) if rng.random() < 0.3 else 0.0
    quality = int(rng.integers(10, 80)) if rng.random() < 0.2 else None
    level = (0.45 / max(float(images.mean()) / 255.0, 0.05)) ** rng.uniform(0.0, 1.0)  # automatic exposure of random strength
    pitch, phase = rng.uniform(20.0, 200.0), rng.uniform(0.0, 2.0 * math.pi)
    out = np.empty_like(images)
    for t in range(frames):
        picture = images[t].astype(np.float32) * np.float32(min(level, 3.0) / 255.0)
        if kernel is not None:
            picture = cv2.filter2D(picture, -1, kernel)
        if coarse < 1.0:
            small = cv2.resize(picture, None, fx=coarse, fy=coarse, interpolation=cv2.INTER_AREA)
            picture = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
        if sharpen:
            picture = picture + sharpen * (picture - cv2.GaussianBlur(picture, (0, 0), 1.2))
        if saturation != 1.0:
            grey = picture.mean(axis=-1, keepdims=True)
            picture = grey + saturation * (picture - grey)
        picture = np.clip(picture, 0.0, 1.0) ** np.float32(gamma) * np.float32(1.0 + hunting * (t - frames / 2))
        if flicker:
            rows = 2.0 * math.pi * np.arange(height) / pitch + phase + 2.1 * t
            picture = picture * (1.0 + flicker * np.sin(rows)).astype(np.float32)[:, None, None]
        out[t] = (np.clip(picture, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
        if quality is not None:
            _, packed = cv2.imencode(".jpg", out[t], [cv2.IMWRITE_JPEG_QUALITY, quality])
            out[t] = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)
    return out


def _motion(rng: np.random.Generator) -> NDArray[np.float32]:
    """The kernel of a motion blur along a line of 2 to 9 pixels."""
    length, angle = rng.uniform(2.0, 9.0), rng.uniform(0.0, math.pi)
    along = np.linspace(-length / 2.0, length / 2.0, 33)
    kernel = np.zeros((11, 11), np.float32)
    np.add.at(kernel, (np.round(5 + along * math.sin(angle)).astype(int), np.round(5 + along * math.cos(angle)).astype(int)), 1.0)
    return kernel / kernel.sum()


def _length(rng: np.random.Generator, low: float, high: float) -> float:
    """A log-uniform length between bounds [m]."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))
