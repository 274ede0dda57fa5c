"""How things look: colours and textures of bodies, light, background and sensor, drawn from a random generator."""

from __future__ import annotations

import colorsys
import dataclasses
import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.contract.labels import Label

PLAIN, BLOTCHES, STRIPES, CHECKS, WOOD, PICTURE = range(6)
"""Patterns of a texture."""
TEXTURE_FIELDS = 20
CUFF, GLOSS = 18, 19
"""Columns of cuff and gloss in a row of a body's texture, after two of Texture.fields (the body's and its sleeve's)."""
NO_CUFF = -1e9
"""Cuff [m] of a body without a sleeve: below all of its points."""

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Texture:
    """Two linear RGB colours mixed by a pattern of `period` [m], by at most `contrast`; PICTURE mixes each channel on its own."""

    colour: Colour
    accent: Colour
    pattern: int = PLAIN
    period: float = 0.1
    contrast: float = 1.0

    def fields(self) -> tuple[float, ...]:
        return (self.pattern, self.period, self.contrast, *self.colour, *self.accent)


@dataclass(frozen=True)
class Appearance:
    """A body's texture, its sleeve below `cuff` [m] along its x axis, its gloss and whether it casts a shadow."""

    texture: Texture
    sleeve: Texture | None = None
    cuff: float = NO_CUFF
    gloss: float = 0.0
    casts_shadow: bool = True

    def row(self) -> NDArray[np.float32]:
        """The TEXTURE_FIELDS numbers that the shading pass reads."""
        sleeve = self.sleeve or self.texture
        return np.array([*self.texture.fields(), *sleeve.fields(), self.cuff, self.gloss], np.float32)


@dataclass(frozen=True)
class Look:
    """Light, background and sensor of a picture: lamp position [m] and colours (linear RGB), background at infinity, the
    sensor's blur [px], noise (share of full scale), white balance and JPEG quality in percent (None: not compressed)."""

    lamp: tuple[float, float, float]
    lamp_colour: Colour
    ambient: Colour
    background: Appearance
    blur_px: float = 0.6
    noise: float = 0.012
    gain: Colour = (1.0, 1.0, 1.0)
    jpeg: int | None = None


@functools.cache
def noise_volume() -> NDArray[np.float32]:
    """Lattice values (32, 32, 32) in [0, 1] of the value noise."""
    return np.random.default_rng(7).random((32, 32, 32), dtype=np.float32)


def hsv(hue: float, saturation: float, value: float) -> Colour:
    """Linear RGB of a colour in HSV; `value` is that of a display, so the result is squared."""
    r, g, b = colorsys.hsv_to_rgb(hue % 1.0, min(max(saturation, 0.0), 1.0), min(max(value, 0.0), 1.0))
    return r * r, g * g, b * b


def skin(rng: np.random.Generator) -> Texture:
    """Human skin, from very light to very dark, slightly blotched."""
    depth = rng.uniform()
    hue = rng.uniform(0.035, 0.075)
    saturation = 0.25 + 0.35 * depth + rng.uniform(-0.05, 0.05)
    value = 0.95 - 0.6 * depth + rng.uniform(-0.03, 0.03)
    return Texture(
        hsv(hue, saturation, value), hsv(hue - 0.015, saturation + 0.1, value * 0.85), BLOTCHES, rng.uniform(0.015, 0.05), 0.6
    )


def cloth(rng: np.random.Generator) -> Texture:
    """Work clothes of any hue, that of skin less often; mostly plain or blotched."""
    hue = rng.uniform(0.12, 0.97) if rng.uniform() < 0.8 else rng.uniform()
    colour = hsv(hue, rng.uniform(0.05, 0.8), rng.uniform(0.15, 0.9))
    accent = hsv(hue + rng.uniform(-0.1, 0.1), rng.uniform(0.05, 0.8), rng.uniform(0.15, 0.9))
    pattern = int(rng.choice([PLAIN, BLOTCHES, STRIPES, CHECKS], p=[0.45, 0.35, 0.1, 0.1]))
    return Texture(colour, accent, pattern, _period(rng, 0.01, 0.06), rng.uniform(0.1, 0.5))


def _period(rng: np.random.Generator, low: float, high: float) -> float:
    """A log-uniform length between bounds [m]."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def metal(rng: np.random.Generator) -> Texture:
    """A robot's paint: white or grey, at times orange, yellow or blue."""
    if rng.uniform() < 0.85:
        return Texture(hsv(rng.uniform(), 0.05, rng.uniform(0.45, 1.0)), hsv(0.0, 0.0, 0.3), BLOTCHES, 0.2, 0.15)
    hue = rng.choice([0.06, 0.13, 0.6])
    return Texture(hsv(hue, rng.uniform(0.75, 0.95), rng.uniform(0.7, 1.0)), hsv(0.0, 0.0, 0.2), BLOTCHES, 0.2, 0.15)


def tabletop(rng: np.random.Generator) -> Texture:
    """Wood, or grey to white laminate."""
    if rng.uniform() < 0.4:
        hue, value = rng.uniform(0.07, 0.1), rng.uniform(0.4, 0.8)
        return Texture(
            hsv(hue, 0.55, value), hsv(hue - 0.01, 0.65, value * 0.75), WOOD, rng.uniform(0.05, 0.15), rng.uniform(0.3, 1.0)
        )
    hue, value = rng.uniform(0.1, 0.7), rng.uniform(0.25, 0.95)
    return Texture(hsv(hue, 0.06, value), hsv(hue, 0.1, value * 0.85), BLOTCHES, _period(rng, 0.02, 0.3), rng.uniform(0.1, 0.6))


def occluder(rng: np.random.Generator, tidy: bool = False) -> Texture:
    """Boards, boxes and tools: any colour and pattern, one in sixteen that of skin; `tidy`: strong colours."""
    choice = rng.uniform() if not tidy else 1.0
    if choice < 0.06:
        return skin(rng)
    if choice < 0.2:
        return picture(rng)
    hue, value = rng.uniform(0.12, 0.97), rng.uniform(0.1, 0.95)
    accent = hsv(hue + rng.uniform(-0.15, 0.15), rng.uniform(0.0, 0.95), np.clip(value + rng.uniform(-0.4, 0.4), 0.1, 1.0))
    pattern = int(rng.choice([PLAIN, BLOTCHES, STRIPES, CHECKS], p=[0.4, 0.3, 0.15, 0.15]))
    colour = hsv(hue, rng.uniform(0.35 if tidy else 0.0, 0.95), value)
    return Texture(colour, accent, pattern, _period(rng, 0.02, 0.2), rng.uniform(0.2, 1.0))


def picture(rng: np.random.Generator) -> Texture:
    """Patches of many colours, as in a crowded room or on a poster."""
    colours = [hsv(rng.uniform(), rng.uniform(0.1, 0.9), value) for value in (rng.uniform(0.1, 0.5), rng.uniform(0.5, 1.0))]
    return Texture(colours[0], colours[1], PICTURE, _period(rng, 0.03, 0.4), rng.uniform(0.4, 1.0))


def person(rng: np.random.Generator, tidy: bool = False) -> dict[Label, Appearance]:
    """Skin, and clothes of one cloth: short sleeves, rolled up on the forearm, or down to the wrist; at times gloves. `tidy`:
    short sleeves and bare hands."""
    bare, shirt = skin(rng), cloth(rng)
    gloss = rng.uniform(0.0, 0.06)
    length, gloves = (0.0, False) if tidy else (rng.uniform(), rng.uniform() < 0.15)
    glove, wrist = cloth(rng), rng.uniform(0.08, 0.14)
    if length < 0.55:  # short sleeves
        forearm = Appearance(glove, bare, wrist, gloss) if gloves else Appearance(bare, gloss=gloss)
        return _dressed(forearm, Appearance(bare, shirt, rng.uniform(0.08, 0.32), gloss), shirt)
    if length < 0.75:  # rolled up somewhere on the forearm
        return _dressed(Appearance(bare, shirt, rng.uniform(-0.12, 0.1), gloss), Appearance(shirt), shirt)
    return _dressed(Appearance(glove if gloves else bare, shirt, rng.uniform(0.1, 0.15), gloss), Appearance(shirt), shirt)


def _dressed(forearm: Appearance, upper_arm: Appearance, shirt: Texture) -> dict[Label, Appearance]:
    return {Label.FOREARM: forearm, Label.UPPER_ARM: upper_arm, Label.TORSO: Appearance(shirt)}


def background(rng: np.random.Generator, tidy: bool = False) -> Appearance:
    """Distant walls and furniture: 58 % in colours of low saturation, the others in many colours or, a few, in colours of skin.
    `tidy`: only the first kind."""
    choice = rng.uniform() if not tidy else 1.0
    if choice < 0.35:
        return Appearance(dataclasses.replace(picture(rng), period=_period(rng, 0.1, 1.0)), casts_shadow=False)
    if choice < 0.42:
        return Appearance(dataclasses.replace(skin(rng), period=_period(rng, 0.1, 1.0), contrast=1.0), casts_shadow=False)
    hue, value = rng.uniform(), rng.uniform(0.2, 0.95)
    colour = hsv(hue, rng.uniform(0.0, 0.3), value)
    accent = hsv(hue + rng.uniform(-0.2, 0.2), rng.uniform(0.0, 0.4), np.clip(value + rng.uniform(-0.4, 0.3), 0.1, 1.0))
    pattern = int(rng.choice([PLAIN, BLOTCHES, STRIPES, CHECKS], p=[0.2, 0.5, 0.15, 0.15]))
    return Appearance(Texture(colour, accent, pattern, _period(rng, 0.2, 2.0), rng.uniform(0.2, 0.8)), casts_shadow=False)


def look(rng: np.random.Generator, around: tuple[float, float, float] = (0.0, 0.0, 0.0), tidy: bool = False) -> Look:
    """A lamp somewhere above `around` [m], ambient light, a background and a sensor; `tidy`: well lit, and not compressed."""
    angle = rng.uniform(0, 2 * np.pi)
    distance, height = rng.uniform(0.2, 1.8), rng.uniform(1.4, 2.4)
    lamp = (around[0] + distance * np.cos(angle), around[1] + distance * np.sin(angle), around[2] + height)
    warmth, strength = rng.uniform(-0.12, 0.12), rng.uniform(0.5 if tidy else 0.35, 1.0)
    fill = rng.uniform(0.25 if tidy else 0.18, 0.55)
    tint = np.array([1 + warmth, 1.0, 1 - warmth])
    return Look(
        lamp=lamp,
        lamp_colour=tuple(strength * tint),
        ambient=tuple(fill * np.ones(3)),
        background=background(rng, tidy),
        blur_px=rng.uniform(0.4, 1.1),
        noise=rng.uniform(0.004, 0.035),
        gain=tuple(rng.uniform(0.8, 1.15) * (1 + rng.uniform(-0.06, 0.06, 3))),
        jpeg=int(rng.integers(50, 96)) if not tidy and rng.uniform() < 0.3 else None,
    )
