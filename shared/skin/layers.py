"""Layers of the field model's small networks, for kernels, in single precision, as their weights were learnt.

A network here has two layers with tanh and a linear output; rows of the first two weight matrices are inputs, those of the last
one are outputs.
"""

from __future__ import annotations

import numpy as np

from penumbra.shared.native import inner


@inner
def tanh(x):  # type: ignore[no-untyped-def]
    """tanh to a few units in the last place, of numbers and without a call, so that it runs on vectors: the rational
    approximation that Eigen uses (`generic_fast_tanh_float`)."""
    x = min(max(x, np.float32(-7.905311)), np.float32(7.905311))
    square = x * x
    top = np.float32(-2.7607684e-16) * square + np.float32(2.0001879e-13)
    top = top * square + np.float32(-8.604672e-11)
    top = top * square + np.float32(5.1222973e-08)
    top = top * square + np.float32(1.4857224e-05)
    top = top * square + np.float32(6.3726195e-04)
    top = top * square + np.float32(4.8935246e-03)
    bottom = np.float32(1.1982584e-06) * square + np.float32(1.1853471e-04)
    bottom = bottom * square + np.float32(2.2684346e-03)
    bottom = bottom * square + np.float32(4.8935253e-03)
    return x * top / bottom


@inner
def bent(weights, bias, x, out):  # type: ignore[no-untyped-def]
    """A layer's output (n,), tanh of bias + x weights, for an input (m,) and weights (m, n), four rows of them at a time."""
    for j in range(len(out)):
        out[j] = bias[j]
    m = len(x)
    for i in range(0, m - m % 4, 4):
        x0, x1, x2, x3 = x[i], x[i + 1], x[i + 2], x[i + 3]
        w0, w1, w2, w3 = weights[i], weights[i + 1], weights[i + 2], weights[i + 3]
        for j in range(len(out)):
            out[j] += x0 * w0[j] + x1 * w1[j] + x2 * w2[j] + x3 * w3[j]
    for i in range(m - m % 4, m):
        for j in range(len(out)):
            out[j] += x[i] * weights[i, j]
    for j in range(len(out)):
        out[j] = tanh(out[j])


@inner(fastmath=True)
def dot(a, b):  # type: ignore[no-untyped-def]
    """The scalar product of two vectors (n,)."""
    total = np.float32(0.0)
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@inner
def slopes(w1, w2, first, second, deep, shallow):  # type: ignore[no-untyped-def]
    """Writes the derivatives of the outputs by what enters the second layer, deep (e, b), and the first one, shallow (e, a).
    first (a,), second (b,): what the layers give; w1 (a, b), w2 (e, b): weights of the second layer and of the output."""
    one = np.float32(1.0)
    for electrode in range(len(deep)):
        for j in range(deep.shape[1]):
            deep[electrode, j] = w2[electrode, j] * (one - second[j] * second[j])
    for j in range(shallow.shape[1]):  # a row of weights is read once for all electrodes
        for electrode in range(len(deep)):
            shallow[electrode, j] = dot(w1[j], deep[electrode]) * (one - first[j] * first[j])
