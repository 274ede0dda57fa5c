"""Fits the paper's response law to one electrode's readings at known gaps: v = a3 + polarity * a1 / (1 + a2 d^2).

At small gaps the errors come from the law itself and from the placing of the limb, at large gaps from noise. A fit in volts sees
only the first and hides errors of 30 % at 15 cm; a fit of logarithms treats noise as signal there. So every gap is weighted by
all three: the standard error of its mean [V], a share of the signal that the law cannot represent (LAW_ERROR), and the slope
times the placing's error. The loss is robust (soft L1, Triggs et al. 2000, doi:10.1007/3-540-44480-7_21): a single wrong gap has
little weight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from penumbra.shared.cell.pads import Law, Nominal
from penumbra.shared.geometry.rigid import Array

LAW_ERROR = 0.04
"""Error of the law as a share of the signal: that of the field model's responses around it, 1 to 20 cm."""
PLACING = 5e-4
"""Standard deviation [m] of a gap held by a robot or a rig; it is larger by hand."""
SHAPE_SPREAD = 0.2
"""Prior standard deviation of log a2 about the designed value, which depends on the shapes of board and limb. The prior decides
where the nearest gap does not separate a1 and a2 (beyond 2 cm only their ratio is observed)."""
SNR_DB = 1.0
"""Signal-to-noise ratio [dB] at the end of the paper's range (section "Sensor Model")."""
FEWEST = 4
"""Minimum number of gaps, including an empty scene: three parameters and one to check them."""
SAME_GAP = 1e-4
"""Maximum difference [m] between gaps that count as the same."""
CLIPPED = 0.1
"""Share of the samples at an end of the converter above which a gap is left out."""
SURE = 6.0
"""Number of standard errors above which a difference is significant."""
MIXED = 0.25
"""Maximum share by which the signal may reverse over the gaps before its polarity counts as unclear."""


class RecordingError(ValueError):
    """Readings to which no law can be fitted; the text says what was expected, what was received and what to do."""


@dataclass(frozen=True)
class Readings:
    """An electrode's readings at k increasing gaps: gap (k,) [m], infinite where nothing was near; mean (k,) [V] and its standard
    error (k,); noise [V^2], the variance of one sample, or None if there are too few samples; notes: what was left out."""

    gap: Array
    mean: Array
    error: Array
    noise: float | None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Fit:
    """A fitted law. deviation (3,): standard deviations of log a1, log a2 and a3 [V]; covariance (3, 3): of the same; residual
    (k,): readings less the law, in standard deviations of all three errors; gain: the signal as a share of the designed law's,
    over the measured gaps (a1 alone correlates with a2 and says less)."""

    law: Law
    covariance: Array
    residual: Array
    gain: float
    notes: tuple[str, ...] = ()

    @property
    def deviation(self) -> Array:
        return np.sqrt(np.diag(self.covariance))


def signal(law: Law | Nominal, gap: ArrayLike) -> Array:
    """Change of the amplitude [V] by a limb at gaps [m], without its sign; zero at an infinite gap."""
    return law.a1 / (1.0 + law.a2 * np.asarray(gap, np.float64) ** 2)


def snr_db(law: Law, gap: ArrayLike) -> Array:
    """Signal-to-noise ratio [dB] of one sample at gaps [m] (paper, section "Sensor Model"): 10 log10(v^2 / (2 sigma^2))."""
    return 10.0 * np.log10(signal(law, gap) ** 2 / (2.0 * law.noise))


def reach(law: Law, snr: float = SNR_DB) -> float:
    """The gap [m] at which the ratio falls to `snr` [dB]; zero if it never reaches that."""
    least = np.sqrt(2.0 * law.noise * 10.0 ** (snr / 10.0))
    return float(np.sqrt(max(law.a1 / least - 1.0, 0.0) / law.a2))


def white_noise(volts: Array) -> float:
    """Variance [V^2] of one sample from differences of successive ones (von Neumann 1941, doi:10.1214/aoms/1177731677), so that a
    swaying limb or a drifting offset does not count. Single spikes are left out. volts (s,), s >= 3."""
    steps = np.diff(volts)
    typical = 1.4826 * np.median(np.abs(steps))
    kept = steps[np.abs(steps) <= 5.0 * typical] if typical > 0.0 else steps
    return float(np.mean(kept**2) / 2.0)


def readings(gaps: Array, volts: Array, full_scale: float, lsb: float, name: str) -> Readings:
    """Group the samples of an electrode by gap.

    gaps (s,) [m], infinite for an empty scene; volts (s,) in order of time, NaN where a sample is missing; full_scale, lsb [V]:
    the converter's. Raises RecordingError if too little is left.
    """
    notes = []
    missing = ~np.isfinite(volts)
    if missing.any():
        notes.append(f"{missing.sum()} of {len(volts)} samples are missing or not a number: left out")
    if 2 * missing.sum() > len(volts):
        raise RecordingError(f"electrode {name}: {missing.sum()} of {len(volts)} samples are not numbers: record them again")
    gaps, volts = gaps[~missing], volts[~missing]
    rows: list[tuple[float, float, float]] = []
    variances = []
    clipped = []
    for gap in _distinct(gaps):
        own = volts[(gaps == gap) | (np.abs(gaps - gap) <= SAME_GAP)] if np.isfinite(gap) else volts[np.isinf(gaps)]
        if np.mean((own >= full_scale - lsb / 2.0) | (own <= lsb / 2.0)) > CLIPPED:
            clipped.append(gap)
            continue
        if len(own) >= 10:
            variances.append((white_noise(own), len(own)))
        rows.append((gap, *_mean(own, lsb)))
    if clipped:
        where = ", ".join(map(_gap, clipped))
        notes.append(f"saturated at {where} (an amplitude of 0 or from {full_scale:.3g} V on): left out")
    if len(rows) < FEWEST:
        why = f"; {notes[-1]}" if clipped else ""
        raise RecordingError(
            f"electrode {name}: expected at least {FEWEST} gaps (the empty scene may be one), got {len(rows)}{why}; record more, "
            "from 1 to 20 cm" + (", and turn the amplifier down" if clipped else "")
        )
    gap_, mean, error = (np.array(column) for column in zip(*rows, strict=True))
    noise = _pooled(np.array(variances)) if variances else None
    return Readings(gap_, mean, error, noise, tuple(notes))


def fit(read: Readings, nominal: Law, name: str, placing: float = PLACING) -> Fit:
    """Fit an electrode's law.

    nominal: its law as designed (the start, and for a2 a weak prior); placing [m]: standard deviation of the gaps. Raises
    RecordingError if the readings have no contrast, mixed polarity or too short a range.
    """
    notes = list(read.notes)
    near = np.isfinite(read.gap)
    if near.sum() < FEWEST - 1 or read.gap[near].max() < 2.0 * max(read.gap[near].min(), SAME_GAP):
        raise RecordingError(
            f"electrode {name}: expected gaps of which the farthest is at least twice the nearest, got "
            f"{', '.join(map(_gap, read.gap[near])) or 'none'}; record from 1 to 20 cm"
        )
    polarity = _polarity(read, name)
    if read.noise is None:
        notes.append("fewer than 10 samples at every gap: the noise stays as designed")
    noise = nominal.noise if read.noise is None else read.noise
    if noise == 0.0:
        raise RecordingError(f"electrode {name}: no noise at all in its samples: record raw samples, not means or a simulation's")
    prior = np.log(nominal.a2)
    x = _start(read, polarity, prior)

    def parts(x: Array) -> tuple[Array, Array]:
        """Signal, and the magnitude of its relative derivative by the gap."""
        d = np.where(near, read.gap, 0.0)
        fall = 1.0 + np.exp(x[1]) * d**2
        return np.where(near, np.exp(x[0]) / fall, 0.0), 2.0 * np.exp(x[1]) * d / fall

    def standard(x: Array, deviation: Array) -> Array:
        s = parts(x)[0]
        return np.append((read.mean - x[2] - polarity * s) / deviation, (x[1] - prior) / SHAPE_SPREAD)

    for _ in range(20):  # the errors are shares of the signal, so they are updated with it
        s, slope = parts(x)
        deviation = np.sqrt(read.error**2 + s**2 * (LAW_ERROR**2 + (slope * placing) ** 2))
        found = least_squares(standard, x, args=(deviation,), loss="soft_l1", x_scale=(1.0, 1.0, 0.01))
        moved, x = np.abs(found.x - x).max(), found.x
        if moved < 1e-7:
            break
    residual = standard(x, deviation)[:-1]
    excess = max(1.0, float(2.0 * found.cost) / max(len(residual) - 3, 1))
    if x[2] < 0.0:
        raise RecordingError(
            f"electrode {name}: the fit's offset a3 is {x[2]:.3g} V, an amplitude is never below 0: check the gaps"
        )
    law = Law(a1=float(np.exp(x[0])), a2=float(np.exp(x[1])), a3=float(x[2]), polarity=polarity, noise=noise)
    gain = float(np.exp(np.mean(np.log(signal(law, read.gap[near]) / signal(nominal, read.gap[near])))))
    for gap, r in zip(read.gap, residual, strict=True):
        if abs(r) > 4.0:
            notes.append(f"{_gap(gap)} lies {abs(r):.0f} standard deviations {'above' if r > 0 else 'below'} the law")
    return Fit(law, np.linalg.inv(found.jac.T @ found.jac) * excess, residual, gain, tuple(notes))


def _distinct(gaps: Array) -> list[float]:
    """Gaps that differ by more than SAME_GAP, increasing."""
    out: list[float] = []
    for gap in np.unique(gaps):
        if not out or gap - out[-1] > SAME_GAP:
            out.append(float(gap))
    return out


def _mean(volts: Array, lsb: float) -> tuple[float, float]:
    """Mean without spikes, and its standard error: that of white noise, or of the means of ten sections if the noise is not
    white, plus a minimum for rounding of a signal without noise."""
    middle = np.median(volts)
    spread = max(1.4826 * float(np.median(np.abs(volts - middle))), lsb)
    kept = volts[np.abs(volts - middle) <= 6.0 * spread]
    error = spread / np.sqrt(len(kept))
    if len(kept) >= 40:
        stretches = [stretch.mean() for stretch in np.array_split(kept, 10)]
        error = max(error, float(np.std(stretches, ddof=1)) / np.sqrt(10.0))
    return float(kept.mean()), float(np.hypot(error, 0.05 * lsb))


def _pooled(variances: Array) -> float:
    """One variance from those of k gaps, (k, 2) with their numbers of samples; gaps with more than twice the median variance are
    left out."""
    kept = variances[variances[:, 0] <= 2.0 * np.median(variances[:, 0])]
    return float(np.average(kept[:, 0], weights=kept[:, 1]))


def _polarity(read: Readings, name: str) -> Literal[-1, 1]:
    """1 if the amplitude rises as a limb approaches, -1 if it falls."""
    low, high = int(np.argmin(read.mean)), int(np.argmax(read.mean))
    span = read.mean[high] - read.mean[low]
    if span < SURE * np.hypot(read.error[low], read.error[high]):
        raise RecordingError(
            f"electrode {name}: no contrast: it reads {read.mean.mean():.4f} V at every gap, within {1e3 * span:.2g} mV: "
            "check that it is connected, and that the limb was above this pad"
        )
    steps = np.diff(read.mean)
    sure = np.abs(steps) > SURE * np.hypot(read.error[1:], read.error[:-1])
    falls, rises = -steps[sure & (steps < 0)].sum(), steps[sure & (steps > 0)].sum()
    if min(falls, rises) > MIXED * max(falls, rises):
        way = steps < 0 if falls < rises else steps > 0
        odd = int(np.argmax(np.where(sure & way, np.abs(steps), 0.0)))
        raise RecordingError(
            f"electrode {name}: mixed polarity: with the gap its amplitude rises by {1e3 * rises:.3g} mV and falls by "
            f"{1e3 * falls:.3g} mV, the other way from {_gap(read.gap[odd])} to {_gap(read.gap[odd + 1])}: "
            "were gaps mixed up, or was something else near?"
        )
    return 1 if falls > rises or (falls == rises and low > high) else -1


def _start(read: Readings, polarity: int, prior: float) -> Array:
    """The best of many values of a2, with a1 and a3 by linear least squares: (log a1, log a2, a3)."""
    best: tuple[float, Array] | None = None
    near = np.isfinite(read.gap)
    for log_a2 in prior + np.linspace(-3.0, 3.0, 25):
        shape = np.where(near, 1.0 / (1.0 + np.exp(log_a2) * np.where(near, read.gap, 0.0) ** 2), 0.0)
        weight = 1.0 / np.hypot(read.error, LAW_ERROR * shape * np.ptp(read.mean) / np.ptp(shape))
        design = np.stack([polarity * shape, np.ones_like(shape)], axis=1) * weight[:, None]
        (a1, a3), *_ = np.linalg.lstsq(design, read.mean * weight, rcond=None)
        cost = float(np.sum((design @ (a1, a3) - read.mean * weight) ** 2))
        if a1 > 0.0 and (best is None or cost < best[0]):
            best = (cost, np.array([np.log(a1), log_a2, a3]))
    if best is None:  # most steps contradict the polarity: start the robust fit from the design
        return np.array([np.log(np.ptp(read.mean)), prior, read.mean[-1]])
    return best[1]


def _gap(gap: float) -> str:
    return f"{100 * gap:.3g} cm" if np.isfinite(gap) else "the empty scene"
