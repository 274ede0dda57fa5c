"""Estimates the drift of the electrodes since their calibration: gain and offset of each, with their covariance.

An electrode reads y = (1 + g) (s + l) + o, where s is the limb's signal, l that of the robot's other links by the field model,
and g and o are the changes of its gain and offset. One Kalman filter holds all of them. Each is an Ornstein-Uhlenbeck process: a
random walk over minutes that is bounded over hours. Gains have a common part, since boards warm up together. The filter learns
from blocks of one second

- in which nothing is near: s = 0;
- in which a camera has just seen the limb. The field model is linearised about the window's solution. The errors of the camera's
  pose (with its covariance) and of the limb's size (with its spread between people) are common to all electrodes, so the filter
  learns nothing that pose or size explain as well. Their lasting part, the bias, is also in the filter's state, and so is where
  the person's shoulder is. A limb at rest adds no information.

Electrodes whose innovation cannot be drift are left out. A block is refused if its innovations are too large together: another
object is near, or the pose was wrong. After REFUSED such blocks in a row the covariance counts as too small, and the filter
starts again as after an old calibration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from penumbra.services.haptics.solve import NEAR_ERROR, NEAR_SIGNAL, UNKNOWNS
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.layout import Skin

GAIN_SPREAD, GAIN_SHARED = 0.006, 0.02
"""Standard deviations of gains long after a calibration: GAIN_SPREAD of each, GAIN_SHARED of their common part. Derived: 10 K at
-0.1 to -0.3 %/K."""
OFFSET_SPREAD = 1e-3
"""Standard deviation [V] of an offset long after a calibration. Derived: 10 K at 0.1 mV/K."""
WALK_S = 1500.0
"""Time constant [s] of the gains' and offsets' processes. Chosen: boards warm up within ten minutes, rooms within an hour."""
CALIBRATED = (5e-4, 2e-5)
"""Standard deviations of gain and offset [V] just after a calibration. Chosen: those of the mean of ten thousand samples."""
BLOCK_S = 1.0
"""Length [s] of a block of windows; the filter makes one update per block."""
QUIET_S = 3.0
"""Time [s] without anything in range after which a block counts as empty."""
STEADY = 4.0
"""Change of an electrode from one empty block to the next, in standard deviations, above which it counts as moved."""
STILL = 0.1
"""Maximum share of electrodes that may have moved, or be left out, in a block from which the filter learns."""
FARTHEST = 0.02
"""Maximum offset [V]. A larger one is a fault, not drift."""
MODEL = 2.0
"""Factor on the field model's error. The filter averages this error over poses, where it is neither white nor normal. Chosen."""
OUTLIER = 4.0
"""Innovation of an electrode, given those of all others, in standard deviations, above which it cannot be drift."""
WORST = 4.0
"""Number of standard deviations by which the sum of squared innovations may exceed its mean."""
REFUSED = 5
"""Number of refused blocks in a row after which the filter starts again."""
MOVED = 0.03
"""Distance [m] that a limb must move before a block seen by a camera adds information: the field model's error then differs."""
AGAIN_S = 30.0
"""Time [s] after which such a block is used even if the limb has not moved. Chosen."""
CURVED = 0.5
"""Error of the linearisation by the shoulder's place: this share of the deviation that its uncertainty makes. Chosen:
without it, one that was 22 cm off was taken for another, 27 cm below it."""
BIAS = np.repeat([0.01, 0.05], 3)
"""Standard deviations [m, rad] of the lasting error of a camera's pose. Chosen: that of a camera's mounting beside the robot."""
BIAS_S = 100.0
"""Time constant [s] of this bias, and of the person's size and shoulder. Chosen."""


@dataclass(frozen=True)
class Seen:
    """A camera's prediction of a window, linear about the window's solution. signal (n,) [V]: at the solution; error (n,): of the
    field model there, as a share; slopes (n, 11): derivatives by pose and body; toward (11,): step from the solution to the
    camera's pose and the usual body; covariance (6, 6): of the camera's pose; position (3,) [m]: of the solution."""

    signal: Array
    error: Array
    slopes: Array
    toward: Array
    covariance: Array
    position: Array


class Drift:
    """Kalman filter of gains and offsets. links_error: standard deviation of the links' signals, as a share; body_spread (5,):
    standard deviations of the body (`person.Person`) between people.

    sigma: standard deviations (n,) of the gains about their common mean, and of the offsets [V]. A common change of the gains
    looks like another girth, whose spread between people is several times as large.

    The state is the changes of gains (n,) and offsets (n,) [V], and the bias (11,) of camera and body.
    """

    def __init__(self, skin: Skin, links_error: float, body_spread: Array):
        n = self._n = len(skin)
        self._noise, self._links_error = skin.noise, links_error
        spread = np.concatenate([np.full(n, GAIN_SPREAD), np.full(n, OFFSET_SPREAD), BIAS, body_spread])
        self._old = np.diag(spread**2)  # of an old calibration and an unknown person
        self._old[:n, :n] += GAIN_SHARED**2
        self._times = np.concatenate([np.full(2 * n, WALK_S), np.full(len(spread) - 2 * n, BIAS_S)])
        self._mean, self._covariance = np.zeros(len(spread)), self._old.copy()
        self._covariance[: 2 * n, : 2 * n] = np.diag(np.repeat(np.square(CALIBRATED), n))
        self.sigma = self._deviations()
        self._unlearned_s, self._refused = 0.0, 0
        self.forget()

    def forget(self) -> None:
        """Discard the current block; the learned drift stays."""
        self._block, self._quiet_s = _Block(self._n), 0.0
        self._before: Array | None = None  # signals of the last empty block
        self._place, self._here_s = np.full(3, np.inf), 0.0  # last block learned with a camera, time since then

    @property
    def gain(self) -> Array:
        """Change of each gain (n,), as a share."""
        return self._mean[: self._n]

    @property
    def offset(self) -> Array:
        """Change of each offset (n,) [V]."""
        return self._mean[self._n : 2 * self._n]

    @property
    def shoulder(self) -> tuple[Array, Array]:
        """Offset (3,) [m] of the person's shoulder from where the posture has it, and its covariance (3, 3)."""
        return self._mean[-3:], self._covariance[-3:, -3:]

    def _deviations(self) -> tuple[Array, Array]:
        """The value of `sigma` for the current covariance."""
        n, own = self._n, self._covariance[: self._n, : self._n]
        gains = np.diag(own) - 2.0 * own.mean(axis=1) + own.mean()
        return np.sqrt(np.maximum(gains, 0.0)), np.sqrt(np.diag(self._covariance)[n : 2 * n])

    def predict(self, elapsed_s: float) -> None:
        """Predict the state, in steps of at least one block."""
        self._unlearned_s += elapsed_s
        if self._unlearned_s < BLOCK_S:
            return
        keep = np.exp(-self._unlearned_s / self._times)
        self._mean *= keep
        self._covariance = self._old + np.outer(keep, keep) * (self._covariance - self._old)
        self._unlearned_s = 0.0
        self.sigma = self._deviations()

    def signal(self, raw: Array, links: Array) -> Array:
        """The limb's signals (n,) [V]: readings raw (n,) (less the calibrated offsets) corrected for drift, less the links'
        signals (n,)."""
        return np.asarray((raw - self.offset) / (1.0 + self.gain) - links)

    def take(
        self, signal: Array, links: Array, samples: NDArray[np.integer], elapsed_s: float, seen: Seen | None, is_near: bool
    ) -> None:
        """Add a window: signals (n,) [V] as `signal` returns them, their numbers of samples (n,), the links' signals (n,) [V],
        and the camera's prediction. is_near: something is felt, or a camera sees the limb."""
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
        """Learn from a block in which nothing is near. The offset of an electrode that has jumped gets a wider covariance."""
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
        """Learn from a block in which a camera saw the limb, if that adds information."""
        if np.linalg.norm(block.position - self._place) < MOVED and self._here_s < AGAIN_S:
            return
        self._place, self._here_s = block.position, 0.0
        total, _, innovation = self._innovation(block)
        used = block.used.copy()
        for _ in range(int(STILL * used.sum()) + 1):
            at = np.flatnonzero(used)
            inverse = np.linalg.inv(total[np.ix_(at, at)])
            pulled = inverse @ innovation[at]
            score = np.abs(pulled) / np.sqrt(np.diag(inverse))  # of each electrode, given all others
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
        """Covariance (n, n), the measurement Jacobian (n, m) and the innovation (n,) of a block."""
        n = self._n
        H = np.concatenate([np.diag(block.signal + block.links), np.eye(n), block.slopes], axis=1)
        share = MODEL * (block.error + NEAR_ERROR * block.signal / NEAR_SIGNAL)
        alone = self._noise / np.maximum(block.samples, 1) + (share * block.signal) ** 2 + (self._links_error * block.links) ** 2
        shoulder = block.slopes[:, 8:]
        alone += CURVED**2 * np.einsum("ni,ij,nj->n", shoulder, self._covariance[-3:, -3:], shoulder)
        pose = block.slopes[:, :6] @ block.covariance @ block.slopes[:, :6].T
        return H @ self._covariance @ H.T + pose + np.diag(alone), H, block.innovation - block.slopes @ self._mean[2 * n :]

    def _learn(self, block: _Block, used: NDArray[np.bool_]) -> None:
        """Kalman update with the electrodes in use (n,)."""
        total, H, innovation = self._innovation(block)
        at = np.flatnonzero(used)
        across = H[at] @ self._covariance
        gain = np.linalg.solve(total[np.ix_(at, at)], across)
        self._mean = self._mean + gain.T @ innovation[at]
        left = self._covariance - gain.T @ across
        self._covariance = 0.5 * (left + left.T)


class _Block:
    """Means over windows, weighted by their samples (n,): unexplained signals, the signals of limb and links by the field model
    (n,) [V], the model's error (n,), slopes (n, 11), the camera's covariance (6, 6) and the limb's position (3,)."""

    def __init__(self, n: int, is_seen: bool = False):
        self.is_seen, self.seconds, self.samples = is_seen, 0.0, np.zeros(n)
        self._windows = 0
        self._sums = np.zeros((n, 4)), np.zeros((n, UNKNOWNS)), np.zeros((6, 6)), np.zeros(3)

    def add(self, signal: Array, links: Array, samples: NDArray[np.integer], elapsed_s: float, seen: Seen | None) -> None:
        """Adds a window."""
        self.seconds += elapsed_s
        self.samples += samples
        self._windows += 1
        columns, slopes, covariance, position = self._sums
        predicted, error = (np.zeros_like(signal), np.zeros_like(signal)) if seen is None else (seen.signal, seen.error)
        unexplained = signal - predicted
        if seen is not None:
            unexplained = unexplained - seen.slopes @ seen.toward
            slopes += samples[:, None] * seen.slopes
            covariance += seen.covariance
            position += seen.position
        columns += samples[:, None] * np.stack([unexplained, predicted, links, error], axis=1)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Electrodes (n,) that have samples."""
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
    def error(self) -> Array:
        return self._mean(0)[:, 3]

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
