"""Detection of faulty electrodes from a pad's voltages, and the likely reason where a pad's voltages do not fit.

`Watch` examines one pad alone. `likely` finds faults that this cannot show (a pad rotated on its mount, a calibration from
another pad): it compares the pad's signals with the field model at a pose known from the other pads and cameras.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.layout import Skin

Kind = Literal["saturated", "dead", "noisy", "hum", "drift"]

BLOCK = 20
"""Number of samples over which a limb's motion is a cubic; the residual is noise."""
LOOK_S = 1.0
"""Duration [s] of one look: it resolves 50 and 60 Hz, and a mean is known to 0.08 mV."""
LEAST_SAMPLES = 100
"""Minimum number of samples in a look, at any sampling rate."""
MAINS_HZ = (50.0, 60.0)
"""Frequencies of the mains."""
BESIDE_HZ = (-6.0, -3.5, 3.5, 6.0)
"""Offsets [Hz] from a mains line of the frequencies that it is compared with. A moving limb contributes at all of them."""
QUIET = 0.25
"""Share of the calibrated noise (variance) below which an electrode is dead. 6 standard deviations of an estimate with 800
degrees of freedom lie at 0.7; the rest is a margin for a calibration that was noisy."""
NOISY = 4.0
"""Multiple of the calibrated noise (variance) above which an electrode is noisy. Chosen, not measured."""
RIPPLE = 0.01
"""Noise as a share of the signal that is no fault: a hand is never quite still."""
LINE = 25.0
"""Minimum power of a mains line, relative to its mean under white noise: one false alarm in exp(25) looks."""
STANDS_OUT = 4.0
"""Minimum ratio of a line's amplitude to those beside it."""
HUM_V = 5e-4
"""Amplitude [V] below which hum is harmless."""
BELOW_V = 1.5e-3
"""Magnitude [V] of a negative signal that is a fault: a body takes field lines away, it adds none."""
ALONE = (4.0, 10.0)
ALONE_V = 3e-3
FAR_V = 0.03
"""An electrode is faulty if its signal exceeds the largest of its pad's others by such a factor plus ALONE_V [V]. The first
factor is for signals up to FAR_V [V], as from a limb 5 cm away, whose signals are nearly equal; the second is for larger ones.
Chosen, not measured."""
LASTS = 3
"""Number of successive looks with a drift before it is reported."""

MENDS: dict[Kind, str] = {
    "saturated": "turn the amplifier's potentiometer down, or take away what touches the pad",
    "dead": "check the electrode's wire and connector, and which channel the cell file gives it",
    "noisy": "check connectors and shield, or calibrate again",
    "hum": "shield the wires, move them away from mains cables, and connect the board's ground",
    "drift": "let the boards warm up and measure the offsets again with nothing near: penumbra skin calibrate",
}


@dataclass(frozen=True)
class Fault:
    """Reason why an electrode is not used; `text` says what was expected and what was measured."""

    kind: Kind
    text: str


@dataclass(frozen=True)
class Look:
    """Measurements of one look at e electrodes. level (e,) [V]: mean; signal (e,) [V]: the skin's part of it, without polarity;
    noise (e,) [V^2]: variance of a sample without motion; hum (e,) [V], hum_hz (e,): amplitude of the mains and its frequency."""

    level: Array
    signal: Array
    noise: Array
    hum: Array
    hum_hz: Array


class Watch:
    """Detects faults of one pad's electrodes as samples arrive; `pad` is its index in `skin`. For the false alarms under white
    noise, see the thresholds. Saturated and dead electrodes are reported within BLOCK samples, other faults after a look, a drift
    after LASTS looks."""

    def __init__(self, skin: Skin, pad: int):
        own = skin.of(pad)
        self.names = tuple(name.partition("/")[2] for name in skin.names[own])
        self._a3, self._polarity, self._noise = skin.a3[own], skin.polarity[own], skin.noise[own]
        self._end, self._top = skin.full_scale[own], skin.full_scale[own] - 0.5 * skin.lsb[own]
        # range below which there is no noise; an electrode with noise below a step of the converter may show none
        self._still = np.where(self._noise > skin.lsb[own] ** 2, 1.01 * skin.lsb[own], -np.inf)
        reach = skin.peak[own] / skin.a2[own]
        self._even: Array = reach.mean() / reach
        self.look: Look | None = None
        self._rows: list[Array] = []
        self._count = self._due_ns = 0
        self._tail = np.empty((0, len(self.names)))
        self._slow: dict[int, Fault] = {}
        self._quick: dict[int, Fault] = {}
        self._odd = np.zeros(len(self.names), np.int64)

    def add(self, stamp_ns: int, period_ns: int, volts: Array) -> dict[str, Fault]:
        """Adds a batch (s, e) [V] whose last row has stamp_ns; returns the current faults by electrode."""
        if self._rows and abs(stamp_ns - (len(volts) - 1) * period_ns - self._due_ns) > 3 * period_ns + 5_000_000:
            self._forget()
        self._due_ns = stamp_ns + period_ns
        self._rows.append(volts)
        self._count += len(volts)
        self._tail = volts[-BLOCK:] if len(volts) >= BLOCK else np.concatenate([self._tail, volts])[-BLOCK:]
        if len(self._tail) == BLOCK:
            self._see_ends()
        if self._count >= max(LEAST_SAMPLES, LOOK_S * 1e9 / period_ns):
            self.look = self._see(np.concatenate(self._rows).astype(np.float64), period_ns * 1e-9)
            self._slow = self._judge(self.look, self._count)
            self._rows.clear()
            self._count = 0
        return self.faults

    @property
    def faults(self) -> dict[str, Fault]:
        """Current faults by electrode, the gravest of each."""
        found = {**self._slow, **self._quick}
        return {self.names[k]: found[k] for k in sorted(found)}

    def _forget(self) -> None:
        self._rows.clear()
        self._count = 0
        self._tail = self._tail[:0]

    def _see_ends(self) -> None:
        """Electrodes at an end of the converter, or without any noise, in the last BLOCK samples."""
        high, low = np.maximum.reduce(self._tail), np.minimum.reduce(self._tail)
        ended = high >= self._top
        self._quick = {}
        for k in (ended | (high - low <= self._still)).nonzero()[0].tolist():
            if ended[k]:
                text = f"saturated: it reads {high[k]:.3f} V, amplitudes end at {self._end[k]:.3f} V"
                self._quick[k] = Fault("saturated", text)
            else:
                self._quick[k] = Fault("dead", f"dead: {BLOCK} samples at {high[k]:.3f} V without noise")

    def _see(self, volts: Array, period_s: float) -> Look:
        level = volts.mean(axis=0)
        centred = volts - level
        blocks = centred[: len(centred) // BLOCK * BLOCK].reshape(-1, BLOCK, centred.shape[1])
        basis = _cubics()
        left = np.sum(blocks**2, axis=(0, 1)) - np.sum(np.einsum("si,bse->bie", basis, blocks) ** 2, axis=(0, 1))
        noise = np.maximum(left, 0.0) / (len(blocks) * (BLOCK - basis.shape[1]))
        amplitude = np.abs(_lines(len(volts), period_s) @ centred).reshape(len(MAINS_HZ), 1 + len(BESIDE_HZ), -1)
        clear = amplitude[:, 0] * (amplitude[:, 0] > STANDS_OUT * amplitude[:, 1:].mean(axis=1))
        which = np.argmax(clear, axis=0)
        hum = np.take_along_axis(clear, which[None], axis=0)[0]
        return Look(level, self._polarity * (level - self._a3), noise, hum, np.array(MAINS_HZ)[which])

    def _judge(self, look: Look, samples: int) -> dict[int, Fault]:
        """Faults by electrode, the gravest of each."""
        quiet = look.noise < QUIET * self._noise
        noisy = look.noise > NOISY * self._noise + (RIPPLE * look.signal) ** 2
        hums = (look.hum > HUM_V) & (look.hum**2 > LINE * 6.0 * self._noise / samples)
        drifts = self._drifts(look.signal)
        self._odd = np.where(drifts, self._odd + 1, 0)
        out: dict[int, Fault] = {}
        for k in range(len(self.names)):
            mv, design = 1e3 * np.sqrt(look.noise[k]), 1e3 * np.sqrt(self._noise[k])
            if quiet[k]:
                out[k] = Fault("dead", f"dead: expected noise of {design:.2g} mV, got {mv:.2g} mV")
            elif hums[k]:
                out[k] = Fault("hum", f"hum: {1e3 * look.hum[k]:.2g} mV at {look.hum_hz[k]:g} Hz")
            elif noisy[k]:
                out[k] = Fault("noisy", f"noisy: expected noise of {design:.2g} mV, got {mv:.2g} mV")
            elif self._odd[k] >= LASTS:
                where = "below zero" if look.signal[k] < 0 else "and the pad's other electrodes show no such signal"
                out[k] = Fault("drift", f"drift: its signal is {1e3 * look.signal[k]:+.2g} mV, {where}")
        return out

    def _drifts(self, signal: Array) -> NDArray[np.bool_]:
        """Signals (e,) [V] that no body causes: negative ones, or that of one electrode alone."""
        even = signal * self._even  # equal for all electrodes where a body is far
        below: NDArray[np.bool_] = signal < -BELOW_V
        if len(signal) < 3:
            return below
        order = np.sort(even)
        others = np.where(even == order[-1], order[-2], order[-1])  # the largest of the others
        factor = np.where(signal < FAR_V, *ALONE)
        alone: NDArray[np.bool_] = even > factor * np.maximum(others, 0.0) + ALONE_V
        return below | alone


@lru_cache(maxsize=1)
def _cubics() -> Array:
    """Orthonormal basis (BLOCK, 4) of cubics."""
    return np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, BLOCK), 4))[0]


@lru_cache(maxsize=4)
def _lines(samples: int, period_s: float) -> NDArray[np.complex128]:
    """Rows that give the amplitudes of each mains line and of the frequencies beside it. Hann's window keeps a limb's motion
    below them."""
    time = np.arange(samples) * period_s
    window = np.hanning(samples)
    window *= 2.0 / window.sum()
    hz = np.array([line + beside for line in MAINS_HZ for beside in (0.0, *BESIDE_HZ)])
    return np.asarray(window * np.exp(-2j * np.pi * hz[:, None] * time), np.complex128)


# ---- faults of a whole pad


def arrangements(centroids: Array) -> dict[str, NDArray[np.intp]]:
    """Wrong ways to mount a pad: for each, the index (e,) of the electrode at whose place each electrode then is.

    centroids (e, 2 or 3) [m] in the pad's frame. Ways that move no electrode to another's place are left out.
    """
    xy = centroids[:, :2]
    turns = {
        "turned by 180 degrees": ((-1.0, 0.0), (0.0, -1.0)),
        "turned by 90 degrees": ((0.0, -1.0), (1.0, 0.0)),
        "turned by -90 degrees": ((0.0, 1.0), (-1.0, 0.0)),
        "mirrored left to right": ((-1.0, 0.0), (0.0, 1.0)),
        "mirrored top to bottom": ((1.0, 0.0), (0.0, -1.0)),
    }
    out = {}
    for name, turn in turns.items():
        place = np.argmin(np.linalg.norm(xy[None] - (xy @ np.array(turn).T)[:, None], axis=2), axis=1)
        if len(set(place)) == len(xy) and (place != np.arange(len(xy))).any():
            out[name] = place
    return out


@dataclass(frozen=True)
class Suspicion:
    """Diagnosis of a pad. `text`: likely fault, None where the pad fits; misfit: mean squared residual with the pad as in the
    cell file, in variances; left: the rest of it if `text` is right; gain: ratio of the pad's signals to the predicted ones."""

    text: str | None
    misfit: float
    left: float
    gain: float


MISFIT = 4.0
"""Mean squared residual, in variances, above which a pad does not fit, for any reason."""
SUSPECT = 0.5
"""Mean squared residual, in variances, above which a pad does not fit where an arrangement explains it."""
EXPLAINED = 0.4
"""Maximum share of the misfit that may remain after an explanation."""
MODEL_ERROR = 0.05
"""Relative error of the predicted signals, from the field model."""
CONTRAST = 0.3
"""Share of the pose's error that affects each electrode of a pad differently."""
LASTING = 0.5
"""Share of the pose's error that is constant over the moments, and looks like a gain."""
SURE = 3.0
"""Standard deviations from one at which a gain is another pad's."""


def likely(predicted: Array, measured: Array, noise: Array, pose_error: Array, centroids: Array) -> Suspicion:
    """Finds the fault of a whole pad that explains its signals.

    predicted, measured (k, e) [V]: signals at k moments with a body in reach, from the field model and from the electrodes; noise
    (k, e) or (e,) [V^2]: variance of a measured signal; pose_error (k,): relative standard deviation of the predicted signals due
    to the pose's error, which affects all electrodes of a pad nearly alike; centroids (e, 2 or 3). Raises ValueError for other
    shapes or none.
    """
    if predicted.shape != measured.shape or predicted.ndim != 2 or not len(predicted):
        raise ValueError(f"expected signals (k, e) of the same shape, got {predicted.shape} and {measured.shape}")
    own = np.hypot(MODEL_ERROR, CONTRAST * pose_error)[:, None] * np.maximum(np.abs(predicted), np.abs(measured))
    spread = noise + own**2

    def misfit(model: Array) -> float:
        """Mean squared residual with a covariance of diag(spread) + (pose_error model)(pose_error model)^T (Sherman and Morrison
        1950)."""
        left = measured - model
        alike = pose_error[:, None] * model / spread
        removed = np.sum(alike * left, axis=1) ** 2 / (1.0 + np.sum(alike * pose_error[:, None] * model, axis=1))
        return float(np.mean(np.sum(left**2 / spread, axis=1) - removed) / predicted.shape[1])

    weighted = predicted / spread
    gain = max(float(np.sum(weighted * measured) / max(np.sum(weighted * predicted), 1e-30)), 1e-3)
    before = misfit(predicted)
    guesses = {name: misfit(predicted[:, place]) for name, place in arrangements(centroids).items()}
    best = min(guesses, key=guesses.__getitem__, default=None)
    if best is not None and before > SUSPECT and guesses[best] < EXPLAINED * before:
        return Suspicion(best, before, guesses[best], gain)
    left = misfit(gain * predicted)
    if left < MISFIT and abs(np.log(gain)) > SURE * np.hypot(MODEL_ERROR, LASTING * float(np.median(pose_error))):
        return Suspicion(f"calibrated as another pad: its signals are {gain:.2f} times what they should be", before, left, gain)
    text = "does not fit the pose, for no known reason" if before > MISFIT else None
    return Suspicion(text, before, before, gain)
