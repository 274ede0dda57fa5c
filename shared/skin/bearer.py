"""What the rest of a limb's person adds to the skin's signals: the upper arm and the torso behind a forearm.

A person is one conductor, and near parts shade far ones. The networks of `response.py` stand for the forearm with its hand. A
small network beside each of them gives the logarithm of the factor by which the rest of the person changes every electrode's
signal. Its input is the limb's own signals and the positions of the skin of upper arm and torso in front of the pad, as sums over
pieces of it, weighted by powers of their nearness. `penumbra skin model` fits the networks to the boundary elements of whole
persons in random postures.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import inner, kernel
from penumbra.shared.skin import layers

CORE = 0.01
"""Offset [m] of distances from the middle of the pad, which keeps them finite in contact."""
PLACES = 30
"""Number of inputs beside the limb's own signals."""
LAYERS = 3
ARRAYS = "f8[2, 7, q], f8[u, v], f8[u, v], f4[u, v, w], f4[u, w], f4[u, w, w], f4[u, w], f4[u, x, w], f4[u, x]"
"""Types of `Bearers.arrays` in a kernel's signature."""


@dataclass(frozen=True)
class Bearer:
    """Network of one mounting. points (2, 7, k): pieces of upper arm and torso, each in its own frame, as in `response.Network`;
    mean, scale (inputs,); three weight matrices (rows are outputs) with biases."""

    points: Array
    mean: Array
    scale: Array
    weights: tuple[Array, ...]
    biases: tuple[Array, ...]

    @property
    def arrays(self) -> tuple[Array, ...]:
        """What `_factors` takes of a mounting: see `layers`."""
        weights = self.weights[0].T, self.weights[1].T, self.weights[2]
        return (self.mean, self.scale, *_single(itertools.chain(*zip(weights, self.biases, strict=True))))

    def logs(self, T_pad_parts: Array, own: Array) -> Array:
        """Logarithms (n, e) of the factors: see `inputs`."""
        return Bearers([self], np.zeros(len(T_pad_parts), np.int64)).logs(T_pad_parts, own.reshape(-1)).reshape(own.shape)

    def stored(self) -> dict[str, Array]:
        """All arrays by name, for storage."""
        out = {"bearer_points": self.points, "bearer_mean": self.mean, "bearer_scale": self.scale}
        out |= {f"bearer_weight{i}": weight for i, weight in enumerate(self.weights)}
        return out | {f"bearer_bias{i}": bias for i, bias in enumerate(self.biases)}

    @staticmethod
    def of(data: Mapping[str, Any]) -> Bearer:
        """The inverse of `stored`."""
        weights, biases = (tuple(data[f"bearer_{kind}{i}"].astype(float) for i in range(LAYERS)) for kind in ("weight", "bias"))
        points, mean, scale = (data[f"bearer_{name}"].astype(float) for name in ("points", "mean", "scale"))
        return Bearer(points, mean, scale, weights, biases)


class Bearers:
    """The networks of several pads: those of their mountings, of which the pads (p,) have the index."""

    def __init__(self, networks: Sequence[Bearer], index: Array):
        stacked = (np.ascontiguousarray(np.stack(each)) for each in zip(*(own.arrays for own in networks), strict=True))
        self._index, self.arrays = index, (np.ascontiguousarray(networks[0].points), *stacked)

    def logs(self, T_pads_parts: Array, own: Array) -> Array:
        """Logarithms (n,) of the factors: T_pads_parts (p, 3, 4, 4) are the poses of limb, upper arm and torso before the pads,
        own (n,) the logarithms of the limb's own changes [fF]."""
        out = np.empty(len(own))
        _factors(self._index, *self.arrays, np.ascontiguousarray(T_pads_parts), own, out)
        return out


def nobody(electrodes: int) -> tuple[Array, ...]:
    """Arrays in the place of those of `Bearers` for a limb without a person; nothing is computed with them."""
    places, shapes = ((2, 7, 1), (1, 1), (1, 1)), ((1, 1, 1), (1, 1), (1, 1, 1), (1, 1), (1, electrodes, 1), (1, electrodes))
    return (*map(np.zeros, places), *_single(map(np.zeros, shapes)))


def _single(arrays: Iterable[Array]) -> Iterator[Any]:
    """The arrays in single precision."""
    return (array.astype(np.float32) for array in arrays)


def inputs(points: Array, T_pad_parts: Array, own: Array) -> Array:
    """Inputs (n, e + PLACES) of the networks: points as in `Bearer`, T_pad_parts (n, 3, 4, 4) poses of limb, upper arm and torso
    before a pad, own (n, e) the logarithms of the limb's own changes [fF]."""
    out = np.empty((len(own), own.shape[1] + PLACES))
    _inputs(np.ascontiguousarray(points), np.ascontiguousarray(T_pad_parts), np.ascontiguousarray(own), out)
    return out


@inner
def _place(t, x, first):  # type: ignore[no-untyped-def]
    """Writes direction and logarithm of the distance of a place t (3,) into x from `first` on; returns what follows."""
    away = math.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]) + CORE
    for i in range(3):
        x[first + i] = t[i] / away
    x[first + 3] = math.log(away)
    return first + 4


@inner(fastmath=True)
def _sums(points, R, t, out):  # type: ignore[no-untyped-def]
    """Sums over a part's pieces (7, k) before a pad, out (2, 4): the weight and its first moments, for two powers of nearness."""
    ax, ay, az, nx, ny, nz, area = points[0], points[1], points[2], points[3], points[4], points[5], points[6]
    r00, r01, r02, t0 = R[0, 0], R[0, 1], R[0, 2], t[0]
    r10, r11, r12, t1 = R[1, 0], R[1, 1], R[1, 2], t[1]
    r20, r21, r22, t2 = R[2, 0], R[2, 1], R[2, 2], t[2]
    s0, s1, x0, y0, z0, x1, y1, z1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(area)):
        x = r00 * ax[k] + r01 * ay[k] + r02 * az[k] + t0
        y = r10 * ax[k] + r11 * ay[k] + r12 * az[k] + t1
        z = r20 * ax[k] + r21 * ay[k] + r22 * az[k] + t2
        u = r00 * nx[k] + r01 * ny[k] + r02 * nz[k]
        v = r10 * nx[k] + r11 * ny[k] + r12 * nz[k]
        w = r20 * nx[k] + r21 * ny[k] + r22 * nz[k]
        near = 1.0 / (x * x + y * y + z * z + CORE * CORE)
        seen = 0.5 * area[k] * (1.0 - (x * u + y * v + z * w) * math.sqrt(near))
        first = seen * near * near
        second = first * near
        s0, x0, y0, z0 = s0 + first, x0 + first * x, y0 + first * y, z0 + first * z
        s1, x1, y1, z1 = s1 + second, x1 + second * x, y1 + second * y, z1 + second * z
    out[0, 0], out[0, 1], out[0, 2], out[0, 3] = s0, x0, y0, z0
    out[1, 0], out[1, 1], out[1, 2], out[1, 3] = s1, x1, y1, z1


@inner
def described(points, T, own, sums, x):  # type: ignore[no-untyped-def]
    """Writes the input x (e + PLACES,) of a network for the parts at T (3, 4, 4) and the limb's own logs (e,). sums (2, 4):
    working memory."""
    e = len(own)
    x[:e] = own
    for i in range(3):
        x[e + i] = T[0, i, 0]
    at = _place(T[0, :3, 3], x, e + 3)
    for part in range(2):
        _sums(points[part], T[1 + part, :3, :3], T[1 + part, :3, 3], sums)
        for power in range(2):
            weight = sums[power, 0]
            for i in range(3):
                sums[power, 1 + i] /= weight
            x[at] = math.log(weight)
            at = _place(sums[power, 1:], x, at + 1)
        if part == 0:
            for i in range(3):
                x[at + i] = T[1, i, 0]
            at += 3


@kernel("f8[2, 7, k], f8[n, 3, 4, 4], f8[n, e], out f8[n, i]")
def _inputs(points, T, own, out):  # type: ignore[no-untyped-def]
    sums = np.empty((2, 4))
    for row in range(len(out)):
        described(points, T[row], own[row], sums, out[row])


@kernel(f"i8[p], {ARRAYS}, f8[p, 3, 4, 4], f8[n], out f8[n]")
def _factors(index, points, mean, scale, w0, b0, w1, b1, w2, b2, T, own, out):  # type: ignore[no-untyped-def]
    bearers = (points, mean, scale, w0, b0, w1, b1, w2, b2)
    e, h = w2.shape[1], w1.shape[1]
    x, sums = np.empty(mean.shape[1]), np.empty((2, 4))
    first, second = np.empty(h, np.float32), np.empty(h, np.float32)
    for p in range(len(index)):
        described(points, T[p], own[p * e : (p + 1) * e], sums, x)
        factors(bearers, index[p], x, first, second, out[p * e : (p + 1) * e])


@inner
def factors(bearers, m, x, first, second, out):  # type: ignore[no-untyped-def]
    """Writes the logarithms (e,) of the factors at a pad of mounting m for the input x (i,), and the layers' outputs first and
    second (h,)."""
    _, mean, scale, w0, b0, w1, b1, w2, b2 = bearers
    scaled = np.empty(len(x), np.float32)
    for i in range(len(x)):
        scaled[i] = (x[i] - mean[m, i]) / scale[m, i]
    layers.bent(w0[m], b0[m], scaled, first)
    layers.bent(w1[m], b1[m], first, second)
    for j in range(len(out)):
        out[j] = layers.dot(w2[m, j], second) + b2[m, j]


@inner
def slopes(bearers, m, first, second, out):  # type: ignore[no-untyped-def]
    """Writes the derivatives (e, i) of the logarithms that `factors` gives, by its input."""
    _, _, scale, w0, _, w1, _, w2, _ = bearers
    deep, shallow = np.empty((len(out), w1.shape[1]), np.float32), np.empty((len(out), w1.shape[1]), np.float32)
    layers.slopes(w1[m], w2[m], first, second, deep, shallow)
    for electrode in range(len(out)):
        for i in range(out.shape[1]):
            out[electrode, i] = layers.dot(w0[m, i], shallow[electrode]) / scale[m, i]
