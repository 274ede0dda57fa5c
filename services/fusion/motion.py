"""Motion model of a limb, compiled.

The velocity is that of a damped oscillator driven by white jerk: a limb speeds up and slows down smoothly, as in reaches, and a
faster limb takes less time over the same distance. Its elbow stays within the upper arm's length of the shoulder.

A motion is a position p (3,), a rotation R (3, 3), a velocity (6,) and an acceleration (6,), linear and angular, with the
covariance of their errors in the order of `records.py`. `filter.py` predicts its states with it, `history.py` its estimates.
"""

from __future__ import annotations

import math

import numpy as np

from penumbra.services.fusion.records import POSE
from penumbra.shared.geometry import so3
from penumbra.shared.native import inner

HASTE = 0.2
"""Power of the agility by which a motion is faster: the unit of a density of jerk^2 is distance^2 / duration^5, so that reaches
over the same distance in half the time have 32 times the density."""
NODES = (0.5 - 0.1 * 15.0**0.5, 0.5, 0.5 + 0.1 * 15.0**0.5)
"""Nodes of the Gauss-Legendre quadrature with three of them on [0, 1]."""
WEIGHTS = (5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0)
"""Their weights."""


@inner
def flow(one, dt, agility, out):  # type: ignore[no-untyped-def]
    """Writes, of the linear and the angular motion (2, 6), the derivatives of what is after dt [s] by what was before: the pose
    by the velocity and by the acceleration, the velocity by both, and the acceleration by both. agility (2,)."""
    for half in range(2):
        w = agility[half] ** HASTE / one.motion_time[half]
        along, across = one.damping * w, w * math.sqrt(1.0 - one.damping**2)
        decay = math.exp(-along * dt)
        swing, kept = decay * math.sin(across * dt) / across, decay * math.cos(across * dt)
        out[half, 1] = (1.0 - kept - along * swing) / w**2
        out[half, 0] = swing + 2.0 * along * out[half, 1]
        out[half, 2], out[half, 3] = kept + along * swing, swing
        out[half, 4], out[half, 5] = -(w**2) * swing, kept - along * swing


@inner
def disturb(one, dt, agility, out):  # type: ignore[no-untyped-def]
    """Writes, of the linear and the angular motion (2, 6), what white jerk adds within dt [s] to the covariance of the pose, its
    velocity and its acceleration: the entries (0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2). agility (2,)."""
    by = np.empty((2, 6))
    w = max(agility[0] ** HASTE / one.motion_time[0], agility[1] ** HASTE / one.motion_time[1])
    pieces = 1 + int(4.0 * w * dt)  # in each the integrands are polynomials of the fifth degree, but for 1e-8 of them
    for half in range(2):
        for k in range(6):
            out[half, k] = 0.0
    for piece in range(pieces):
        for node in range(3):
            flow(one, dt * (piece + NODES[node]) / pieces, agility, by)
            for half in range(2):
                density, of, k = agility[half] * one.jerk[half] * WEIGHTS[node] * dt / pieces, by[half], 0
                for i in range(1, 6, 2):
                    for j in range(1, i + 1, 2):
                        out[half, k] += density * of[i] * of[j]
                        k += 1


@inner
def move(one, dt, p, R, velocity, acceleration, P, agility):  # type: ignore[no-untyped-def]
    """Takes a pose, its velocity (6,), its acceleration (6,) and the covariance P (n, n), n >= 18, on by dt [s]; agility (2,). F
    and Q are its transition and process noise, P = F P F' + Q; entries beyond the 18th stay."""
    by, rotation, turn, noise = np.empty((2, 6)), np.empty(3), np.empty((3, 3)), np.empty((2, 6))
    disturb(one, dt, agility, noise)
    flow(one, dt, agility, by)
    for i in range(3):
        rotation[i] = by[1, 0] * velocity[3 + i] + by[1, 1] * acceleration[3 + i]
        p[i] += by[0, 0] * velocity[i] + by[0, 1] * acceleration[i]
    so3.exp(rotation, turn)
    so3.turn(turn, R, 0)
    for _ in range(2):  # F times P, then, P being transposed on the way, F times (F P)'
        transit(P, turn, rotation, by)
        for i in range(len(P)):
            for j in range(i):
                P[i, j], P[j, i] = P[j, i], P[i, j]
    for i in range(POSE):
        k, of, to = 0, by[i // 3], noise[i // 3]
        for a in range(3):
            for b in range(a + 1):
                P[i + 6 * a, i + 6 * b] += to[k]
                if a != b:
                    P[i + 6 * b, i + 6 * a] += to[k]
                k += 1
        before = velocity[i]
        velocity[i] = of[2] * before + of[3] * acceleration[i]
        acceleration[i] = of[4] * before + of[5] * acceleration[i]


@inner
def within_reach(one, p, R):  # type: ignore[no-untyped-def]
    """Takes a position p (3,) back to where its arm can be: the elbow stays within the upper arm's length of the shoulder."""
    away = np.empty(3)
    for i in range(3):
        away[i] = p[i] - one.elbow * R[i, 0] - one.shoulder[i]
    distance = math.sqrt(so3.dot(away, away))
    if distance > one.upper_arm:
        for i in range(3):
            p[i] -= (1.0 - one.upper_arm / distance) * away[i]


@inner
def transit(P, turn, rotation, by):  # type: ignore[no-untyped-def]
    """F times P (n, n), in place; by (2, 6): see `flow`. What an angular velocity and acceleration add to the rotation is
    turned by the left Jacobian of `rotation`, to first order."""
    a, b, c = 0.5 * rotation[0], 0.5 * rotation[1], 0.5 * rotation[2]
    for j in range(len(P)):
        for i in range(3):
            P[i, j] += by[0, 0] * P[6 + i, j] + by[0, 1] * P[12 + i, j]
        x, y, z = P[3, j], P[4, j], P[5, j]
        u = by[1, 0] * P[9, j] + by[1, 1] * P[15, j]
        v = by[1, 0] * P[10, j] + by[1, 1] * P[16, j]
        w = by[1, 0] * P[11, j] + by[1, 1] * P[17, j]
        P[3, j] = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + u - c * v + b * w
        P[4, j] = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + c * u + v - a * w
        P[5, j] = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z - b * u + a * v + w
        for i in range(POSE):
            of, before = by[i // 3], P[6 + i, j]
            P[6 + i, j] = of[2] * before + of[3] * P[12 + i, j]
            P[12 + i, j] = of[4] * before + of[5] * P[12 + i, j]
