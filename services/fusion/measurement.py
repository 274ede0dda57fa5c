"""A measurement of the default observer's filter, compiled: a pose of one sense, reduced to the directions that it observes, and
the error of another pose along these.

A likelihood that leaves tens of degrees open may peak as far from its point of linearisation, as that of a window of the skin.
Such a measurement keeps the pose of linearisation, and how far `ahead` of it the peak is. At the peak, the directions that it
knows well would be turned as far, and many such measurements would lead the pose away together.
"""

from __future__ import annotations

import math

import numpy as np

from penumbra.services.fusion.records import POSE, UNITS
from penumbra.shared.geometry import so3
from penumbra.shared.native import inner


@inner
def reduce(model, source, stamp_ns, T, information, step, m):  # type: ignore[no-untyped-def]
    """Writes a pose (4, 4) with its information (6, 6) as the MEASUREMENT m; step (6,): from there to where its likelihood
    peaks."""
    of = model.senses[source]
    m.stamp_ns, m.source = stamp_ns, source
    for i in range(3):
        m.p[i] = T[i, 3]
        for j in range(3):
            m.R[i, j] = T[i, j]
    scaled, vectors = np.empty((POSE, POSE)), np.empty((POSE, POSE))
    for i in range(POSE):
        for j in range(POSE):
            scaled[i, j] = 0.5 * (information[i, j] + information[j, i]) * UNITS[i] * UNITS[j]
    so3.eigen(scaled, POSE, vectors)
    k = 0
    for e in range(POSE):
        if scaled[e, e] > max(model.one.unobserved**-2, 1e-9 * scaled[POSE - 1, POSE - 1]):
            variance = 1.0 / scaled[e, e]
            share = of.typical + (1.0 - of.typical) * variance / (variance + of.sure**2)
            for i in range(POSE):
                m.directions[k, i] = vectors[i, e]
                m.basis[k, i] = vectors[i, e] / UNITS[i]
            m.sigma[k] = math.sqrt(share * variance)
            m.rest[k] = (1.0 - share) * variance
            m.ahead[k] = so3.dot(m.basis[k], step)
            k += 1
    m.rank, m.has_axis, m.slides = k, 0, 0
    if 0 < k < POSE:
        m.has_axis = _weakest(m, 3, vectors) < 1e-3
        for i in range(3):
            m.axis[i] = vectors[i, 0]
        m.slides = _weakest(m, 0, vectors) < 1e-3


@inner
def undo(step, T, information):  # type: ignore[no-untyped-def]
    """Takes a pose (4, 4) and its information (6, 6) back by a step (6,), to where its likelihood was linearised."""
    back, turn = np.empty(3), np.empty((3, 3))
    for i in range(3):
        back[i] = -step[3 + i]
        T[i, 3] -= step[i]
    so3.exp(back, turn)
    so3.turn(turn, T[:, :3], 0)
    so3.turn(turn, information, 3)
    so3.turn_columns(turn, information, 3)


@inner
def _weakest(m, first, vectors):  # type: ignore[no-untyped-def]
    """The smallest eigenvalue of the sum (3, 3) of the outer products of the directions' translations (first 0) or rotations
    (first 3); writes the eigenvectors."""
    seen = np.zeros((3, 3))
    for k in range(m.rank):
        for i in range(3):
            for j in range(3):
                seen[i, j] += m.directions[k, first + i] * m.directions[k, first + j]
    so3.eigen(seen, 3, vectors)
    return seen[0, 0]


@inner
def error(p, R, m, value, derivative):  # type: ignore[no-untyped-def]
    """The error of a pose p (3,), R (3, 3) along the directions of a measurement (k,), and its derivative (k, 6) by the pose.

    What is not observed belongs to the limb and turns with it: the roll about its axis, the way along it. Were the directions
    those at the measured pose, their noise would let information leak into what nobody observes; so they are turned to the
    pose in question. A roll that is made up, however large, says nothing (swing-twist decomposition).

    Returns the bend, the error of linearisation in UNITS: the displacement from the measured pose times the rotation from there,
    as far as the measurement sees it. Along what it observes, both are taken within three of its standard deviations, where they
    are if the pose in question is right.
    """
    turn, rotation, jacobian, slide = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    back, away = np.empty(3), np.empty(POSE)
    so3.product_transposed(R, m.R, turn)
    if m.has_axis:
        so3.turned(turn, m.axis, back)
        so3.swing(m.axis, back, rotation)
    else:
        so3.log(turn, rotation)
    for i in range(3):
        back[i] = -rotation[i]
    if m.has_axis:
        so3.exp(back, jacobian)
    else:
        so3.left_jacobian_inverse(rotation, jacobian)
    if m.slides:
        so3.exp(back, slide)
    for k in range(m.rank):
        value[k] = -m.ahead[k]
        for i in range(3):
            derivative[k, i] = 0.0 if m.slides else m.basis[k, i]
            derivative[k, 3 + i] = 0.0
            for j in range(3):
                if m.slides:
                    derivative[k, i] += m.basis[k, j] * slide[j, i]
                derivative[k, 3 + i] += m.basis[k, 3 + j] * jacobian[j, i]
            value[k] += derivative[k, i] * (p[i] - m.p[i]) + m.basis[k, 3 + i] * rotation[i]
    for i in range(3):
        away[i], away[3 + i] = (p[i] - m.p[i]) / UNITS[i], rotation[i] / UNITS[3 + i]
    for k in range(m.rank):
        excess = value[k] - min(max(value[k], -3.0 * m.sigma[k]), 3.0 * m.sigma[k])
        for i in range(POSE):
            away[i] -= excess * m.directions[k, i]
    turned = 0.0
    for k in range(m.rank):
        turned += so3.dot(m.directions[k, 3:], away[3:]) ** 2
    return math.sqrt(turned * so3.dot(away[:3], away[:3]))
