"""Faults of the skin, applied to clean voltages: the effects of broken wires, warm amplifiers or wrong mounting."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.faults import arrangements
from penumbra.shared.skin.layout import Skin

KINDS = {
    "dead": "a broken wire: no amplitude and no noise",
    "saturated": "the amplifier at its limit",
    "drift": "an offset that warms up by SIZE volts (default 0.05)",
    "warm": "a board that is SIZE kelvin warmer after some minutes (default 10): gain and offset, other ones of every electrode",
    "hum": "mains of SIZE volts at 50 Hz (default 0.01)",
    "gain": "a calibration from another pad: signals times SIZE (default 1.5)",
    "turned": "the pad mounted turned by 180 degrees",
    "mirrored": "its left and right electrodes swapped",
    "none": "in order again",
}
"""Every fault and its meaning. `turned` and `mirrored` apply to a whole pad."""
SIZES = {"drift": 0.05, "warm": 10.0, "hum": 0.01, "gain": 1.5}
LARGEST = {"drift": 1.0, "warm": 40.0, "hum": 1.0, "gain": 10.0}
"""Default and maximum SIZE of a drift [V], of a warming [K], of a hum [V], and of a gain."""
ARRANGEMENTS = {"turned": "turned by 180 degrees", "mirrored": "mirrored left to right"}
MAINS_HZ = 50.0
"""Frequency of the hum [Hz]."""
WARMS_S = 30.0
"""Time constant [s] of a drift."""
BOARD_WARMS_S = 300.0
"""Time constant [s] with which a board warms up: chosen as minutes, as for a populated board in a plastic shell."""
GAIN_PER_K = (-0.003, -0.001)
"""Bounds of an electrode's gain coefficient [1/K]: chosen as for charge amplifiers with ceramic capacitors and an oscillator."""
OFFSET_PER_K = 1e-4
"""Standard deviation of an electrode's offset coefficient [V/K]: chosen as a twentieth of a sample's noise."""


@dataclass(frozen=True)
class Warming:
    """Effect of temperature on n electrodes: coefficients of gain (n,) [1/K] and offset (n,) [V/K]."""

    gain: Array
    offset: Array

    @staticmethod
    def draw(rng: np.random.Generator, n: int) -> Warming:
        """Random coefficients of n electrodes."""
        return Warming(rng.uniform(*GAIN_PER_K, n), OFFSET_PER_K * rng.standard_normal(n))

    def apply(self, volts: Array, a3: Array, kelvin: ArrayLike) -> Array:
        """Voltages (s, n) of electrodes with offsets a3 (n,) [V] that are warmer by `kelvin` (s,), from those without warming."""
        warmer = np.asarray(kelvin, np.float64)[..., None]
        return np.asarray(a3 + (1.0 + self.gain * warmer) * (volts - a3) + self.offset * warmer)


@dataclass(frozen=True)
class _Fault:
    kind: str
    size: float
    since_s: float


class SkinFaults:
    """The faults in force on the pads of a skin: a function of the commands given and of the samples' times."""

    def __init__(self, skin: Skin):
        self._skin = skin
        self._warming = Warming.draw(np.random.default_rng(len(skin)), len(skin))
        self._electrodes: dict[int, _Fault] = {}
        self._pads: dict[int, str] = {}

    def command(self, words: str, time_s: float) -> None:
        """`PAD[/ELECTRODE] FAULT [SIZE]` or `all none`: a fault of an electrode, or of all of a pad, from time_s on.

        Raises ValueError, which lists what is possible.
        """
        where, kind, size = self._parse(words)
        pads, electrodes = self._find(where)
        if kind in ARRANGEMENTS:
            if where not in self._skin.pads:
                raise ValueError(
                    f"skin: expected one of {', '.join(self._skin.pads)} for {kind}, a fault of a whole pad, got {where!r}"
                )
            self._pads = {**self._pads, pads[0]: kind}
            return
        kept = {k: fault for k, fault in self._electrodes.items() if k not in electrodes}
        # new dictionaries: another thread may be applying the old ones
        self._electrodes = kept if kind == "none" else kept | dict.fromkeys(electrodes, _Fault(kind, size, time_s))
        if kind == "none":
            self._pads = {pad: arrangement for pad, arrangement in self._pads.items() if pad not in pads}

    def describe(self) -> dict[str, str]:
        """Faults in force by pad or electrode, as they were commanded."""
        out = {self._skin.pads[pad]: kind for pad, kind in self._pads.items()}
        for k, fault in sorted(self._electrodes.items()):
            out[self._skin.names[k]] = f"{fault.kind} {fault.size:g}" if fault.kind in SIZES else fault.kind
        return out

    def apply(self, pad: int, times_s: ArrayLike, volts: Array) -> Array:
        """Voltages (s, e) [V] of the skin's pad number `pad` with its faults, from clean ones at times (s,) [s]."""
        skin, own = self._skin, self._skin.of(pad)
        faults = [(k - own.start, fault) for k, fault in self._electrodes.items() if own.start <= k < own.stop]
        arrangement = self._pads.get(pad)
        if arrangement is None and not faults:
            return volts
        time = np.asarray(times_s, np.float64)
        out = np.array(volts, np.float64)
        if arrangement is not None:
            out = out[:, arrangements(skin.centroids[own])[ARRANGEMENTS[arrangement]]]
        for k, fault in faults:
            a3 = skin.a3[own][k]
            match fault.kind:
                case "dead":
                    out[:, k] = 0.0
                case "saturated":
                    out[:, k] = skin.full_scale[own][k]
                case "drift":
                    out[:, k] += fault.size * -np.expm1(-np.maximum(time - fault.since_s, 0.0) / WARMS_S)
                case "warm":
                    one = Warming(self._warming.gain[own][k : k + 1], self._warming.offset[own][k : k + 1])
                    kelvin = fault.size * -np.expm1(-np.maximum(time - fault.since_s, 0.0) / BOARD_WARMS_S)
                    out[:, k : k + 1] = one.apply(out[:, k : k + 1], a3, kelvin)
                case "hum":
                    out[:, k] += fault.size * np.sin(2.0 * np.pi * MAINS_HZ * time)
                case "gain":
                    out[:, k] = a3 + fault.size * (out[:, k] - a3)
        return np.clip(out, 0.0, skin.full_scale[own])

    def _parse(self, words: str) -> tuple[str, str, float]:
        parts = words.split()
        if len(parts) not in (2, 3) or parts[1] not in KINDS or (parts[0] == "all" and parts[1] != "none"):
            possible = "; ".join(f"{name}: {about}" for name, about in KINDS.items())
            raise ValueError(f"skin: expected PAD[/ELECTRODE] FAULT [SIZE] or `all none`, got {words!r}. Faults: {possible}")
        where, kind = parts[:2]
        if len(parts) == 2:
            return where, kind, SIZES.get(kind, 0.0)
        if kind not in SIZES:
            raise ValueError(f"skin: {kind}: expected no size, got {parts[2]!r}")
        try:
            size = float(parts[2])
        except ValueError:
            size = math.nan
        if not 0.0 < abs(size) <= LARGEST[kind]:
            raise ValueError(f"skin: expected a size of {kind} up to {LARGEST[kind]:g}, got {parts[2]!r}")
        return where, kind, size

    def _find(self, where: str) -> tuple[list[int], list[int]]:
        """Indices in the skin of the pads and the electrodes that a name denotes."""
        skin = self._skin
        if where == "all":
            return list(range(len(skin.pads))), list(range(len(skin)))
        if where in skin.pads:
            pad = skin.pads.index(where)
            return [pad], list(range(len(skin)))[skin.of(pad)]
        if where in skin.names:
            return [], [skin.names.index(where)]
        raise ValueError(
            f"skin: expected a pad of {', '.join(skin.pads)} or one of their electrodes, such as {skin.names[0]}, got {where!r}"
        )
