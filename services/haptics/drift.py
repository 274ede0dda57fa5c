"""How the electrodes have drifted since they were calibrated: gain and offset of each, and how well they are known.

An electrode reads y = (1 + g) (s + l) + o: s the limb's signal and l that of the robot's other links by the field model, g and o
what its gain and offset have moved by. All of them are one Kalman filter. Each is an Ornstein-Uhlenbeck process: a random walk
over minutes that is bounded over hours. Gains share a part, since boards warm up together. The filter takes blocks of a second

- in which nothing is near: s = 0;
- in which a camera has just seen the limb. The field model is linear about the window's solution. The camera's pose with its
  covariance and the limb's size with its spread between people are errors that all electrodes have in common, so that nothing is
  learned of what place or size explain as well. What stays wrong with both for long is a state of the filter too, its bias, and
  a limb that rests says nothing new.

Electrodes whose innovation no drift explains are left out. A block whose innovations are too large together is refused: another
thing is near, or the pose was wrong. Where that goes on, less is known than the covariance says, and the filter starts again as
after a calibration that is old.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from penumbra.services.haptics.solve import NEAR_ERROR, NEAR_SIGNAL
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.layout import Skin

GAIN_SPREAD, GAIN_SHARED = 0.006, 0.02
"""Standard deviations of gains long after a calibration: of each alone, and of all together. Derived: 10 K at -0.1 to
-0.3 %/K."""
OFFSET_SPREAD = 1e-3
"""The same of an offset [V]. Derived: 10 K at 0.1 mV/K."""
WALK_S = 1500.0
"""Time constant [s] of these processes. Chosen: boards warm up within ten minutes, rooms within an hour."""
CALIBRATED = (5e-4, 2e-5)
"""Standard deviations of gain and offset [V] just after a calibration. Chosen: of the mean of ten thousand samples."""
BLOCK_S = 1.0
"""Length [s] of a block of windows that is learned from as a whole."""
QUIET_S = 3.0
"""Time [s] for which nothing may have been in range before a block counts as empty."""
STEADY = 4.0
"""Change of an electrode from one empty block to the next, in standard deviations, above which it has moved."""
STILL = 0.1
"""Largest share of electrodes that may have moved, or be left out, in a block that is learned from."""
FARTHEST = 0.02
"""Largest offset [V]. A rest that is farther off is a fault and no drift."""
MODEL = 2.0
"""Factor on the field model's error: this filter averages it over places, where it is neither white nor normal. Chosen."""
OUTLIER = 4.0
"""Innovation of an electrode, given those of all others, in standard deviations, that its drift does not explain."""
WORST = 4.0
"""Standard deviations by which the sum of squared innovations may exceed its mean."""
REFUSED = 5
"""Number of refused blocks in a row after which the filter starts again."""
MOVED = 0.03
"""Distance [m] by which a limb has moved before a camera's block says something new: the field model's error is another one."""
AGAIN_S = 30.0
"""Time [s] after which it says something new all the same. Chosen."""
BIAS = np.repeat([0.01, 0.05], 3)
"""Standard deviations [m, rad] of what a camera's pose is off by for long. Chosen: of a camera's place beside the robot."""
BIAS_S = 100.0
"""Time constant [s] of this bias, and of who is there. Chosen."""


@dataclass(frozen=True)
class Seen:
    """What a camera predicts of a window, linear about the window's solution. signal (n,) [V]: there; slopes (n, 8): by pose and
    size; toward (8,): the camera's pose and the usual size beside the solution's; covariance (6, 6): of the camera's pose;
    position (3,) [m]: the solution's."""

    signal: Array
    slopes: Array
    toward: Array
    covariance: Array
    position: Array


class Drift:
    """error (n,), links_error: standard deviations of the field model's signals and of the links', as shares; size_spread (2,):
    of log sizes between people.

    sigma: standard deviations (n,) of gains beside the mean of all, and of offsets [V]. What gains have in common looks like
    another girth, whose spread between people is several times as large.

    The state is what gains (n,) and offsets (n,) [V] have moved by, and the bias (8,) of camera and size.
    """

    def __init__(self, skin: Skin, error: Array, links_error: float, size_spread: Array):
        n = self._n = len(skin)
        self._noise, self._error, self._links_error = skin.noise, error, links_error
        spread = np.concatenate([np.full(n, GAIN_SPREAD), np.full(n, OFFSET_SPREAD), BIAS, size_spread])
        self._old = np.diag(spread**2)  # of a skin whose calibration is old, and an unknown person
        self._old[:n, :n] += GAIN_SHARED**2
        self._times = np.concatenate([np.full(2 * n, WALK_S), np.full(len(spread) - 2 * n, BIAS_S)])
        self._mean, self._covariance = np.zeros(len(spread)), self._old.copy()
        self._covariance[: 2 * n, : 2 * n] = np.diag(np.repeat(np.square(CALIBRATED), n))
        self.sigma = self._deviations()
        self._unlearned_s, self._refused = 0.0, 0
        self.forget()

    def forget(self) -> None:
        """Start to watch again; what was learned stays."""
        self._block, self._quiet_s = _Block(self._n), 0.0
        self._before: Array | None = None  # the last empty block's signals
        self._place, self._here_s = np.full(3, np.inf), 0.0  # where a camera's block was last learned from, and since when

    @property
    def gain(self) -> Array:
        """What each gain has moved by (n,), as a share."""
        return self._mean[: self._n]

    @property
    def offset(self) -> Array:
        """What each offset has moved by (n,) [V]."""
        return self._mean[self._n : 2 * self._n]

    def _deviations(self) -> tuple[Array, Array]:
        """What is `sigma` until something is learned or becomes old."""
        n, own = self._n, self._covariance[: self._n, : self._n]
        gains = np.diag(own) - 2.0 * own.mean(axis=1) + own.mean()
        return np.sqrt(np.maximum(gains, 0.0)), np.sqrt(np.diag(self._covariance)[n : 2 * n])

    def predict(self, elapsed_s: float) -> None:
        """What was learned becomes old, in steps of a block."""
        self._unlearned_s += elapsed_s
        if self._unlearned_s < BLOCK_S:
            return
        keep = np.exp(-self._unlearned_s / self._times)
        self._mean *= keep
        self._covariance = self._old + np.outer(keep, keep) * (self._covariance - self._old)
        self._unlearned_s = 0.0
        self.sigma = self._deviations()

    def signal(self, raw: Array, links: Array) -> Array:
        """The limb's signals (n,) [V] in readings (n,) beside the calibrated offsets, of which links are so much (n,)."""
        return np.asarray((raw - self.offset) / (1.0 + self.gain) - links)

    def take(
        self, signal: Array, links: Array, samples: NDArray[np.integer], elapsed_s: float, seen: Seen | None, is_near: bool
    ) -> None:
        """Takes a window: signals (n,) [V] as `signal` gives them, over so many samples (n,), what links add (n,) [V], and what
        a camera has just seen. is_near: something is, or a camera sees the limb."""
        if not 0.0 < elapsed_s < BLOCK_S or (seen is None and is_near):
            self._block, self._quiet_s, self._before = _Block(self._n), 0.0, None
            return
        if self._block.is_seen != (seen is not None):
            self._block, self._quiet_s, self._before = _Block(self._n, seen is not None), 0.0, None
        self._quiet_s += elapsed_s
        self._here_s += elapsed_s
        self._block.add(signal, links, samples, elapsed_s, seen)
        if self._block.seconds < BLOCK_S:
            return
        block, self._block = self._block, _Block(self._n, self._block.is_seen)
        if block.is_seen:
            self._learn_seen(block)
        elif self._quiet_s > QUIET_S:
            self._learn_rest(block)
        self.sigma = self._deviations()

    def _learn_rest(self, block: _Block) -> None:
        """From a block in which nothing is near. An electrode whose rest has jumped is learned anew."""
        mean, before = block.innovation, self._before
        self._before = mean
        noise = np.sqrt(2.0 * self._noise / np.maximum(block.samples, 1))
        if before is None or (np.abs(mean - before) > STEADY * noise)[block.used].mean() > STILL:
            return
        total, _, _ = self._innovation(block)
        jumped = block.used & (np.abs(mean) > OUTLIER * np.sqrt(np.diag(total)))
        at = self._n + np.flatnonzero(jumped)
        self._covariance[at, at] += mean[jumped] ** 2
        self._learn(block, block.used & (np.abs(self.offset + mean) < FARTHEST))

    def _learn_seen(self, block: _Block) -> None:
        """From a block in which a camera saw the limb, where that says something new."""
        if np.linalg.norm(block.position - self._place) < MOVED and self._here_s < AGAIN_S:
            return
        self._place, self._here_s = block.position, 0.0
        total, _, innovation = self._innovation(block)
        used = block.used.copy()
        for _ in range(int(STILL * used.sum()) + 1):
            at = np.flatnonzero(used)
            inverse = np.linalg.inv(total[np.ix_(at, at)])
            pulled = inverse @ innovation[at]
            score = np.abs(pulled) / np.sqrt(np.diag(inverse))  # of each, given all others
            if score.max() < OUTLIER:
                break
            used[at[score.argmax()]] = False
        is_explained = innovation[at] @ pulled < len(at) + WORST * np.sqrt(2.0 * len(at))
        self._refused = 0 if is_explained and score.max() < OUTLIER else self._refused + 1
        if not self._refused:
            self._learn(block, used)
        elif self._refused >= REFUSED:
            self._refused, self._covariance = 0, self._old.copy()

    def _innovation(self, block: _Block) -> tuple[Array, Array, Array]:
        """Covariance (n, n), the state's slopes (n, m) and innovation (n,) of a block."""
        n = self._n
        H = np.concatenate([np.diag(block.signal + block.links), np.eye(n), block.slopes], axis=1)
        share = MODEL * (self._error + NEAR_ERROR * block.signal / NEAR_SIGNAL)
        alone = self._noise / np.maximum(block.samples, 1) + (share * block.signal) ** 2 + (self._links_error * block.links) ** 2
        pose = block.slopes[:, :6] @ block.covariance @ block.slopes[:, :6].T
        return H @ self._covariance @ H.T + pose + np.diag(alone), H, block.innovation - block.slopes @ self._mean[2 * n :]

    def _learn(self, block: _Block, used: NDArray[np.bool_]) -> None:
        """A step of the filter with the electrodes (n,) in use."""
        total, H, innovation = self._innovation(block)
        at = np.flatnonzero(used)
        across = H[at] @ self._covariance
        gain = np.linalg.solve(total[np.ix_(at, at)], across)
        self._mean = self._mean + gain.T @ innovation[at]
        left = self._covariance - gain.T @ across
        self._covariance = 0.5 * (left + left.T)


class _Block:
    """Means over windows, weighted by their samples (n,): signals that nothing explains yet, what the limb's and the links'
    signals are by the field model (n,) [V], slopes (n, 8), a camera's covariance (6, 6) and the limb's position (3,)."""

    def __init__(self, n: int, is_seen: bool = False):
        self.is_seen, self.seconds, self.samples = is_seen, 0.0, np.zeros(n)
        self._windows = 0
        self._sums = np.zeros((n, 3)), np.zeros((n, 8)), np.zeros((6, 6)), np.zeros(3)

    def add(self, signal: Array, links: Array, samples: NDArray[np.integer], elapsed_s: float, seen: Seen | None) -> None:
        """Adds a window."""
        self.seconds += elapsed_s
        self.samples += samples
        self._windows += 1
        columns, slopes, covariance, position = self._sums
        predicted = np.zeros_like(signal) if seen is None else seen.signal
        unexplained = signal - predicted
        if seen is not None:
            unexplained = unexplained - seen.slopes @ seen.toward
            slopes += samples[:, None] * seen.slopes
            covariance += seen.covariance
            position += seen.position
        columns += samples[:, None] * np.stack([unexplained, predicted, links], axis=1)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which electrodes (n,) were in use at all."""
        return self.samples > 0

    @property
    def innovation(self) -> Array:
        return self._mean(0)[:, 0]

    @property
    def signal(self) -> Array:
        return self._mean(0)[:, 1]

    @property
    def links(self) -> Array:
        return self._mean(0)[:, 2]

    @property
    def slopes(self) -> Array:
        return self._mean(1)

    @property
    def covariance(self) -> Array:
        return self._sums[2] / self._windows

    @property
    def position(self) -> Array:
        return self._sums[3] / self._windows

    def _mean(self, which: int) -> Array:
        return np.asarray(self._sums[which] / np.maximum(self.samples, 1.0)[:, None])
