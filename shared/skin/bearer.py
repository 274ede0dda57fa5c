"""What the rest of a limb's person adds to the skin's signals: the upper arm and the torso behind a forearm.

A person is one conductor, and near parts shade far ones. The networks of `response.py` stand for the forearm with its hand. A
small network beside each of them gives the logarithm of the factor by which the rest of the person changes every electrode's
signal. Its input is the limb's own signals and the positions of the skin of upper arm and torso in front of the pad, as sums over
pieces of it, weighted by powers of their nearness. `penumbra skin model` fits the networks to the boundary elements of whole
persons in random postures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from penumbra.shared.geometry import so3
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import inner, kernel

CORE = 0.01
"""Offset [m] of distances from the middle of the pad, which keeps them finite in contact."""
PLACES = 30
"""Number of inputs beside the limb's own signals."""
LAYERS = 3
ARRAYS = "f8[2, 7, q], f8[u, v], f8[u, v], f8[u, w, v], f8[u, w], f8[u, w, w], f8[u, w], f8[u, x, w], f8[u, x]"
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
        """What `_factors` takes of a mounting."""
        layers = zip(self.weights, self.biases, strict=True)
        return (self.mean, self.scale, *(array for layer in layers for array in layer))

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
        stacked = (np.stack(each) for each in zip(*(own.arrays for own in networks), strict=True))
        self._index, self.arrays = index, (np.ascontiguousarray(networks[0].points), *stacked)

    def logs(self, T_pads_parts: Array, own: Array) -> Array:
        """Logarithms (n,) of the factors: T_pads_parts (p, 3, 4, 4) are the poses of limb, upper arm and torso before the pads,
        own (n,) the logarithms of the limb's own changes [fF]."""
        out = np.empty(len(own))
        _factors(self._index, *self.arrays, np.ascontiguousarray(T_pads_parts), own, out)
        return out


def nobody(electrodes: int) -> tuple[Array, ...]:
    """Arrays in the place of those of `Bearers` for a limb without a person; nothing is computed with them."""
    shapes = (2, 7, 1), (1, 1), (1, 1), (1, 1, 1), (1, 1), (1, 1, 1), (1, 1), (1, electrodes, 1), (1, electrodes)
    return tuple(np.zeros(shape) for shape in shapes)


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


@inner
def _described(points, T, own, x):  # type: ignore[no-untyped-def]
    """The input x (e + PLACES,) of a network for the parts at T (3, 4, 4) and the limb's own logs (e,)."""
    e = len(own)
    x[:e] = own
    for i in range(3):
        x[e + i] = T[0, i, 0]
    at = _place(T[0, :3, 3], x, e + 3)
    middle = np.empty((2, 3))
    for part in range(2):
        r00, r01, r02, t0 = T[1 + part, 0, 0], T[1 + part, 0, 1], T[1 + part, 0, 2], T[1 + part, 0, 3]
        r10, r11, r12, t1 = T[1 + part, 1, 0], T[1 + part, 1, 1], T[1 + part, 1, 2], T[1 + part, 1, 3]
        r20, r21, r22, t2 = T[1 + part, 2, 0], T[1 + part, 2, 1], T[1 + part, 2, 2], T[1 + part, 2, 3]
        s0, s1, x0, y0, z0, x1, y1, z1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(points.shape[2]):
            a, b, c = points[part, 0, k], points[part, 1, k], points[part, 2, k]
            p, q, r = r00 * a + r01 * b + r02 * c + t0, r10 * a + r11 * b + r12 * c + t1, r20 * a + r21 * b + r22 * c + t2
            a, b, c = points[part, 3, k], points[part, 4, k], points[part, 5, k]
            u, v, w = r00 * a + r01 * b + r02 * c, r10 * a + r11 * b + r12 * c, r20 * a + r21 * b + r22 * c
            near = 1.0 / (p * p + q * q + r * r + CORE * CORE)
            seen = 0.5 * points[part, 6, k] * (1.0 - (p * u + q * v + r * w) * math.sqrt(near))
            first = seen * near * near
            second = first * near
            s0, x0, y0, z0 = s0 + first, x0 + first * p, y0 + first * q, z0 + first * r
            s1, x1, y1, z1 = s1 + second, x1 + second * p, y1 + second * q, z1 + second * r
        middle[0, 0], middle[0, 1], middle[0, 2] = x0 / s0, y0 / s0, z0 / s0
        middle[1, 0], middle[1, 1], middle[1, 2] = x1 / s1, y1 / s1, z1 / s1
        for power in range(2):
            x[at] = math.log(s0 if power == 0 else s1)
            at = _place(middle[power], x, at + 1)
        if part == 0:
            x[at], x[at + 1], x[at + 2] = r00, r10, r20
            at += 3


@kernel("f8[2, 7, k], f8[n, 3, 4, 4], f8[n, e], out f8[n, i]")
def _inputs(points, T, own, out):  # type: ignore[no-untyped-def]
    for row in range(len(out)):
        _described(points, T[row], own[row], out[row])


@kernel(f"i8[p], {ARRAYS}, f8[p, 3, 4, 4], f8[n], out f8[n]")
def _factors(index, points, mean, scale, w0, b0, w1, b1, w2, b2, T, own, out):  # type: ignore[no-untyped-def]
    bearers = (points, mean, scale, w0, b0, w1, b1, w2, b2)
    e, h = w2.shape[1], w1.shape[1]
    x, first, second = np.empty(mean.shape[1]), np.empty(h), np.empty(h)
    for p in range(len(index)):
        factors(bearers, index[p], T[p], own[p * e : (p + 1) * e], x, first, second, out[p * e : (p + 1) * e])


@inner
def factors(bearers, m, T, own, x, first, second, out):  # type: ignore[no-untyped-def]
    """Writes the logarithms (e,) of the factors at a pad of mounting m, before which limb, upper arm and torso are at
    T (3, 4, 4); own (e,): logarithms of the limb's own changes [fF]. x (i,), first, second (h,): working memory."""
    points, mean, scale, w0, b0, w1, b1, w2, b2 = bearers
    _described(points, T, own, x)
    for i in range(len(x)):
        x[i] = (x[i] - mean[m, i]) / scale[m, i]
    for j in range(len(first)):
        first[j] = math.tanh(b0[m, j] + so3.dot(w0[m, j], x))
    for j in range(len(second)):
        second[j] = math.tanh(b1[m, j] + so3.dot(w1[m, j], first))
    for j in range(len(out)):
        out[j] = b2[m, j] + so3.dot(w2[m, j], second)
