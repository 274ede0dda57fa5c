"""The default observer's filter, compiled: an error-state Kalman filter that knows that the errors of a sense last.

State: position p, rotation R, linear and angular velocity, and a bias of every sense. Errors are along fixed axes, the rotation's
applied from the left (`shared.geometry.rigid.perturb`). Velocities are constant but for white acceleration, and slowly forgotten.

A sense is wrong by nearly the same amount from one measurement to the next: a mask a pixel too large is a forearm 2 cm too near
for as long as nobody moves. A filter that takes 100 such measurements a second for independent believes in a tenth of the error
that they have, and then no longer listens to the other sense. So the error of every measurement is split: a share `lasting` of
its variance belongs to the sense's bias, a first-order Gauss-Markov process that the filter estimates, the rest is white. The
bias is kept in units of the measurement's own standard deviation, which changes with distance and occlusion: a measurement of
covariance L L' reads pose + sqrt(lasting) L bias + white noise.

Numbers are learned from the innovations on the way, all from whether each resembles the one before of the same sense.
Innovations that resemble each other mean that the filter lags behind the limb: more process noise, linear and angular each on its
own, or a limb that turns would make way for a sense that is wrong about where it is. Innovations that are too large
and do not resemble each other mean that the sense is noisier than it says: less belief in it, never more than it asks for.

Measurements come late and out of order: the filter goes back to the stamp, applies, and replays what came after. The result
depends on the measurements and their stamps alone, never on the order of arrival (within the horizon): the whole state of the
filter, what it refused included, is a function of the state before and the measurement. A history is a ring of measurements in
the order of stamp, source and position, each with the state after it. Its first entry is the newest one that is older than the
horizon: nothing is inserted before it. `ring` (2,) holds the slot of the first entry and the number of entries.

Everything works in place on the records of `records.py`; `measure_all` and `estimate_all` are called from outside,
for as many targets as there are. It is one file because numba keeps what it compiled until the file of the function called from
outside changes: after a change of `so3.py`, or of what is compiled in `estimate.py`, delete services/fusion/__pycache__.

Sources: error-state filter on SO(3): Sola, "Quaternion kinematics for the error-state Kalman filter" (2017), arXiv:1711.02508;
coloured measurement noise by state augmentation: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and
Navigation" (2001), sections 8.2 and 8.3, DOI 10.1002/0471221279; correlation of innovations as the sign of a wrong process
noise: Mehra, "On the identification of variances and adaptive Kalman filtering" (1970), DOI 10.1109/TAC.1970.1099422.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from services.fusion import so3
from services.fusion.estimate import ACCEPTED, DUPLICATE, GATED, LATE, LOST, NOTHING, fault, state_of
from services.fusion.records import MEASUREMENT, MOTION, NEVER, POSE, SENSES, SIZE, UNITS

HASTE = 4.0
"""So many times as fast a measurement that is refused teaches that the limb is faster: while it is, all are refused."""
ODD = 2.0
"""From so large a squared Mahalanobis distance a direction, 1 expected, a measurement is not heard on how fast the limb is while
another sense is less surprising: a sense that is wrong by little drags the state along."""


@njit(cache=True)
def forget(state):  # type: ignore[no-untyped-def]
    """Makes a state that knows nothing."""
    state.stamp_ns = state.accepted_ns = NEVER
    state.passed = state.rank = 0
    state.distance = 0.0
    state.agility[0] = state.agility[1] = 1.0
    for i in range(POSE):
        state.velocity[i] = 0.0
    for i in range(POSE * SENSES):
        state.bias[i] = 0.0
    for s in range(SENSES):
        state.came_ns[s] = state.heard_ns[s] = state.believed_ns[s] = state.refused_ns[s] = NEVER
        state.refused[s] = state.has_innovation[s] = 0
        state.gain[s], state.doubt[s] = 0.0, 1.0


@njit(cache=True)
def reduce(model, source, stamp_ns, T, information, m):  # type: ignore[no-untyped-def]
    """Writes a pose (4, 4) with its information (6, 6) as the MEASUREMENT m."""
    m.stamp_ns, m.source = stamp_ns, source
    for i in range(3):
        m.p[i] = T[i, 3]
        for j in range(3):
            m.R[i, j] = T[i, j]
    scaled = np.empty((POSE, POSE))
    for i in range(POSE):
        for j in range(POSE):
            scaled[i, j] = 0.5 * (information[i, j] + information[j, i]) * UNITS[i] * UNITS[j]
    eigenvalues, vectors = so3.eigen(scaled)
    k = 0
    for e in range(POSE):
        if eigenvalues[e] > max(model.unobserved**-2, 1e-9 * eigenvalues[POSE - 1]):
            for i in range(POSE):
                m.directions[k, i] = vectors[i, e]
                m.basis[k, i] = vectors[i, e] / UNITS[i]
            m.sigma[k] = math.sqrt(1.0 / eigenvalues[e])
            k += 1
    m.rank, m.has_axis, m.slides = k, 0, 0
    if 0 < k < POSE:
        weakest, axes = so3.eigen(_seen(m, 3))
        m.has_axis = weakest[0] < 1e-3
        for i in range(3):
            m.axis[i] = axes[i, 0]
        weakest, axes = so3.eigen(_seen(m, 0))
        m.slides = weakest[0] < 1e-3


@njit(cache=True)
def _seen(m, first):  # type: ignore[no-untyped-def]
    """The sum (3, 3) of the outer products of the directions' translations (first 0) or rotations (first 3)."""
    out = np.zeros((3, 3))
    for k in range(m.rank):
        for i in range(3):
            for j in range(3):
                out[i, j] += m.directions[k, first + i] * m.directions[k, first + j]
    return out


@njit(cache=True)
def step(model, state, m):  # type: ignore[no-untyped-def]
    """Takes a state on to a measurement: predicted to its stamp, and updated unless the gate refuses it."""
    fresh = m.stamp_ns - state.accepted_ns > model.lost_age * 1e9
    if fresh:
        start(model, state, m, model.home[:3, 3].copy(), model.home[:3, :3].copy(), model.home_covariance.copy())
    else:
        predict(model, state, m.stamp_ns)
    while True:
        z, H = linearised(model, state, m)
        PHt, S_inverse, innovation = innovated(model, state, m, z, H)
        if fresh:
            break
        distance = so3.dot(innovation, innovation)
        state.distance, state.rank = distance, m.rank
        state.surprise[m.source], state.came_ns[m.source] = distance / m.rank, m.stamp_ns
        contradicted = _is_contradicted(model, state, m)
        passes = distance <= model.threshold[1 if contradicted else 0, m.rank]
        if not passes and not contradicted:
            learn(model, state, m, innovation, HASTE)
        elif passes:
            learn(model, state, m, innovation, 0.0 if contradicted and distance > ODD * m.rank else 1.0)
        if passes:
            break
        if state.refused[m.source] == 0:
            state.refused_ns[m.source] = m.stamp_ns
        state.refused[m.source] += 1
        state.passed = 0
        if _is_blind(model, state) and not contradicted:
            start(model, state, m, state.p.copy(), state.R.copy(), state.P[:POSE, :POSE] + model.home_covariance)
        elif _is_persistent(model, state, m):
            # So long a disagreement is no outlier: one of the senses is biased beyond its covariance, nobody knows which.
            for i in range(SIZE):
                for j in range(SIZE):
                    state.P[i, j] *= distance / m.rank
        else:
            return
        fresh = True  # as if it were the first
    update(state, m, z, PHt, S_inverse)


@njit(cache=True)
def _is_contradicted(model, state, m):  # type: ignore[no-untyped-def]
    """Whether another sense, heard lately, is less surprising, believed or not: then a surprising measurement is wrong rather
    than the state. What it would teach is that the limb is faster, until it passes the gate."""
    for s in range(SENSES):
        if m.stamp_ns - state.came_ns[s] < model.witness * 1e9 and state.surprise[s] < state.surprise[m.source]:
            return True
    return False


@njit(cache=True)
def _is_blind(model, state):  # type: ignore[no-untyped-def]
    """Whether everything of all senses has been refused for so long that the state must be wrong."""
    first_ns, refused = state.stamp_ns, 0
    for s in range(SENSES):
        if state.refused[s]:
            first_ns = min(first_ns, state.refused_ns[s])
            refused += state.refused[s]
    return state.stamp_ns - max(state.accepted_ns, first_ns) >= model.patience * 1e9 and refused >= model.refusals


@njit(cache=True)
def _is_persistent(model, state, m):  # type: ignore[no-untyped-def]
    """Whether everything of the measurement's sense has been refused for so long that one of the senses must be wrong."""
    lasts_ns = m.stamp_ns - state.refused_ns[m.source]
    return state.refused[m.source] >= model.refusals and lasts_ns >= model.source_patience * 1e9


@njit(cache=True)
def start(model, state, m, p, R, covariance):  # type: ignore[no-untyped-def]
    """Makes a new state for one measurement to update; along what it does not observe, from a pose p (3,), R (3, 3) with its
    covariance (6, 6)."""
    for _ in range(5):  # Gauss-Newton on the observed directions; one step does where all are observed
        value, _ = error(p, R, m)
        correction = np.zeros(POSE)
        for i in range(m.rank):
            for j in range(POSE):
                correction[j] -= value[i] * UNITS[j] * m.directions[i, j]
        for i in range(3):
            p[i] += correction[i]
        R = so3.product(so3.exp(correction[3:]), R)
    wide = np.eye(POSE)  # where it observes, the measurement decides
    for k in range(m.rank):
        for i in range(POSE):
            for j in range(POSE):
                wide[i, j] += 9.0 * UNITS[i] * m.directions[k, i] * m.basis[k, j]
    forget(state)
    state.stamp_ns = state.accepted_ns = state.heard_ns[m.source] = m.stamp_ns
    for i in range(3):
        state.p[i] = p[i]
        for j in range(3):
            state.R[i, j] = R[i, j]
    covariance = so3.product_transposed(so3.product(wide, covariance), wide)
    for i in range(SIZE):
        for j in range(SIZE):
            state.P[i, j] = covariance[i, j] if i < POSE and j < POSE else 0.0
        if i >= POSE:
            state.P[i, i] = model.velocity_spread[(i - POSE) // 3] ** 2 if i < MOTION else 1.0


@njit(cache=True)
def move(model, dt, p, R, velocity, P, agility):  # type: ignore[no-untyped-def]
    """Takes a pose, its velocity (6,) and the covariance P (n, n), n >= 12, on by dt [s]: an integrated Ornstein-Uhlenbeck
    velocity; agility (2,). F and Q are its transition and process noise, P = F P F' + Q; entries beyond the 12th stay."""
    tau = model.velocity_time
    decay, reach, twice = math.exp(-dt / tau), -tau * math.expm1(-dt / tau), -0.5 * tau * math.expm1(-2.0 * dt / tau)
    rotation = reach * velocity[3:]
    turn, lever = so3.exp(rotation), so3.hat(0.5 * reach * rotation)
    for i in range(3):
        lever[i, i] += reach  # left Jacobian to first order
    for _ in range(2):  # F times P, then, P being transposed on the way, F times (F P)'
        _transit(P, turn, lever, reach, decay)
        for i in range(len(P)):
            for j in range(i):
                P[i, j], P[j, i] = P[j, i], P[i, j]
    for i in range(POSE):
        density = agility[i // 3] * model.acceleration[i // 3]
        P[i, i] += density * max(0.0, tau**2 * (dt - 2.0 * reach + twice))
        P[i, i + 6] += density * 0.5 * reach**2
        P[i + 6, i] += density * 0.5 * reach**2
        P[i + 6, i + 6] += density * twice
    for i in range(3):
        p[i] += reach * velocity[i]
    so3.turn(turn, R)
    for i in range(POSE):
        velocity[i] *= decay


@njit(cache=True)
def _transit(P, turn, lever, reach, decay):  # type: ignore[no-untyped-def]
    """F times P (n, n), in place."""
    for j in range(len(P)):
        for i in range(3):
            P[i, j] += reach * P[6 + i, j]
        x, y, z, u, v, w = P[3, j], P[4, j], P[5, j], P[9, j], P[10, j], P[11, j]
        for i in range(3):
            P[3 + i, j] = turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z + lever[i, 0] * u + lever[i, 1] * v + lever[i, 2] * w
        for i in range(6, MOTION):
            P[i, j] *= decay


@njit(cache=True)
def predict(model, state, stamp_ns):  # type: ignore[no-untyped-def]
    """Takes a state on to a later stamp."""
    dt = (stamp_ns - state.stamp_ns) * 1e-9
    move(model, dt, state.p, state.R, state.velocity, state.P, state.agility)
    for s in range(SENSES):
        keep = math.exp(-dt / model.time_constant[s])
        for i in range(MOTION + POSE * s, MOTION + POSE * (s + 1)):
            state.bias[i - MOTION] *= keep
            for j in range(SIZE):
                state.P[i, j] *= keep
            for j in range(SIZE):
                state.P[j, i] *= keep
            state.P[i, i] += 1.0 - keep**2
        state.gain[s] *= math.exp(-dt / model.weight_time)
    state.stamp_ns = stamp_ns


@njit(cache=True)
def error(p, R, m):  # type: ignore[no-untyped-def]
    """The error of a pose p (3,), R (3, 3) along the directions of a measurement (k,), and its derivative (k, 6) by the pose.

    What is not observed belongs to the limb and turns with it: the roll about its axis, the way along it. Were the directions
    those at the measured pose, their noise would let information leak into what nobody observes; so they are turned to the
    pose in question. A roll that is made up, however large, says nothing (swing-twist decomposition).
    """
    turn = so3.product_transposed(R, m.R)
    if m.has_axis:
        rotation = so3.swing(m.axis, so3.turned(turn, m.axis))
        jacobian = so3.exp(-rotation)
    else:
        rotation = so3.log(turn)
        jacobian = so3.left_jacobian_inverse(rotation)
    slide = so3.exp(-rotation) if m.slides else np.eye(3)
    value, derivative = np.zeros(m.rank), np.zeros((m.rank, POSE))
    for k in range(m.rank):
        for i in range(3):
            for j in range(3):
                derivative[k, i] += m.basis[k, j] * slide[j, i]
                derivative[k, 3 + i] += m.basis[k, 3 + j] * jacobian[j, i]
            value[k] += derivative[k, i] * (p[i] - m.p[i]) + m.basis[k, 3 + i] * rotation[i]
    return value, derivative


@njit(cache=True)
def linearised(model, state, m):  # type: ignore[no-untyped-def]
    """Innovation z (k,) and its derivative H (k, 12) by the pose and the sense's bias, the white noise left out.

    A measurement says: the error e with `perturb(T_measured, e) == T_true` is noise along its directions.
    """
    s, first = m.source, POSE * m.source
    value, derivative = error(state.p.copy(), state.R.copy(), m)
    z, H = np.empty(m.rank), np.empty((m.rank, 2 * POSE))
    for i in range(m.rank):
        # what no covariance tells, the floor, is a calibration: all of it lasts
        lasting = math.sqrt(state.doubt[s] * (model.lasting[s] * m.sigma[i] ** 2 + model.floor[s] ** 2))
        z[i] = -value[i]
        for j in range(POSE):
            H[i, j] = derivative[i, j]
            H[i, POSE + j] = lasting * m.directions[i, j]
            z[i] -= H[i, POSE + j] * state.bias[first + j]
    return z, H


@njit(cache=True)
def innovated(model, state, m, z, H):  # type: ignore[no-untyped-def]
    """P H' (n, k), the inverse of the innovation's covariance (k, k), and the innovation (6,) in units of its standard
    deviation, zero where the measurement sees nothing; its square is the squared Mahalanobis distance."""
    k, first = m.rank, MOTION + POSE * m.source
    PHt = np.zeros((SIZE, k))
    for i in range(SIZE):
        for j in range(k):
            for c in range(POSE):
                PHt[i, j] += state.P[i, c] * H[j, c] + state.P[i, first + c] * H[j, POSE + c]
    S = np.zeros((k, k))
    for i in range(k):
        for j in range(k):
            for c in range(POSE):
                S[i, j] += H[i, c] * PHt[c, j] + H[i, POSE + c] * PHt[first + c, j]
        S[i, i] += state.doubt[m.source] * (1.0 - model.lasting[m.source]) * m.sigma[i] ** 2
    eigenvalues, vectors = so3.eigen(S)
    innovation, S_inverse = np.zeros(POSE), np.zeros((k, k))
    for e in range(k):  # S^-1/2 is symmetric, so that innovations of different directions compare
        along = 0.0
        for i in range(k):
            along += vectors[i, e] * z[i]
            for j in range(k):
                S_inverse[i, j] += vectors[i, e] * vectors[j, e] / eigenvalues[e]
        for i in range(k):
            for j in range(POSE):
                innovation[j] += along / math.sqrt(eigenvalues[e]) * vectors[i, e] * m.directions[i, j]
    return PHt, S_inverse, innovation


@njit(cache=True)
def learn(model, state, m, innovation, haste):  # type: ignore[no-untyped-def]
    """Adapts the agilities, `haste` times as fast as usual, and the doubt to an innovation (6,)."""
    s = m.source
    length = math.sqrt(so3.dot(innovation, innovation) / m.rank)
    innovation = min(1.0, 2.0 / max(length, 1e-9)) * innovation  # an outlier teaches no more than two sigma do
    if state.has_innovation[s]:
        step = min(model.learning[0], model.learning[1] * (m.stamp_ns - state.heard_ns[s]) * 1e-9)
        alike = so3.dot(innovation, state.innovation[s]) / m.rank  # 0 expected
        unlike = so3.dot(innovation, innovation) / m.rank - alike  # 1 expected
        for half in range(2):
            share, along = 0.0, 0.0
            for i in range(3 * half, 3 * half + 3):
                along += innovation[i] * state.innovation[s, i]
                for k in range(m.rank):
                    share += m.directions[k, i] ** 2
            if share > 1e-3:
                faster = state.agility[half] * math.exp(haste * step * along / share)
                state.agility[half] = min(max(faster, model.agility[0]), model.agility[1])
        state.doubt[s] = min(max(state.doubt[s] * math.exp(0.5 * step * (unlike - 1.25)), 1.0), model.doubt)
    state.heard_ns[s], state.has_innovation[s] = m.stamp_ns, 1
    for i in range(POSE):
        state.innovation[s, i] = innovation[i]


@njit(cache=True)
def update(state, m, z, PHt, S_inverse):  # type: ignore[no-untyped-def]
    """Updates a state with an accepted measurement."""
    s, P = m.source, state.P
    before = _log_volume(P)
    K = so3.product(PHt, S_inverse)
    dx = np.zeros(SIZE)
    for i in range(SIZE):
        for k in range(m.rank):
            dx[i] += K[i, k] * z[k]
            for j in range(SIZE):
                P[i, j] -= K[i, k] * PHt[j, k]
    turn = so3.exp(dx[3:6])
    if m.rank < POSE:  # what is not observed turns with the limb: see `error`
        for first in (3, 9):
            so3.turn(turn, P[first : first + 3])
            so3.turn(turn, P[:, first : first + 3].T)
    for i in range(SIZE):
        for j in range(i):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])
    so3.turn(turn, state.R)
    so3.orthonormalise(state.R)
    for i in range(3):
        state.p[i] += dx[i]
    for i in range(POSE):
        state.velocity[i] += dx[POSE + i]
    for i in range(POSE * SENSES):
        state.bias[i] += dx[MOTION + i]
    state.gain[s] += 0.5 * (before - _log_volume(P))
    state.accepted_ns = state.believed_ns[s] = m.stamp_ns
    state.refused[s], state.refused_ns[s] = 0, NEVER
    state.passed = 1


@njit(cache=True)
def _log_volume(P):  # type: ignore[no-untyped-def]
    """The logarithm of the determinant of the pose's covariance, from its Cholesky factor."""
    L = np.zeros((POSE, POSE))
    volume = 0.0
    for i in range(POSE):
        for j in range(i + 1):
            rest = P[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(rest) if i == j else rest / L[j, j]
        volume += 2.0 * math.log(L[i, i])
    return volume


@njit(cache=True)
def clear(states, measurements, ring):  # type: ignore[no-untyped-def]
    """Makes a history of one entry, which is older than all and knows nothing."""
    ring[0], ring[1] = 0, 1
    measurements[0].stamp_ns, measurements[0].source = NEVER, -1
    forget(states[0])


@njit(cache=True)
def adopt(model, states, measurements, rings, target, stamp_ns, T, velocity, covariance, believed_ns, weight):  # type: ignore[no-untyped-def]
    """Makes a history of one entry: a pose T (4, 4) at a stamp, with velocity (6,), the pose's covariance (6, 6), stamps (n,) of
    what was last believed of each sense, and the weights (n,). The velocity may be off by as much as one that is unknown."""
    clear(states[target], measurements[target], rings[target])
    state = states[target, 0]
    measurements[target, 0].stamp_ns = state.stamp_ns = stamp_ns
    for i in range(3):
        state.p[i] = T[i, 3]
        for j in range(3):
            state.R[i, j] = T[i, j]
    so3.orthonormalise(state.R)
    for i in range(SIZE):
        for j in range(SIZE):
            state.P[i, j] = 0.5 * (covariance[i, j] + covariance[j, i]) if i < POSE and j < POSE else 0.0
        if i >= POSE:
            state.P[i, i] = model.velocity_spread[(i - POSE) // 3] ** 2 if i < MOTION else 1.0
    for i in range(POSE):
        state.velocity[i] = velocity[i]
    for s in range(SENSES):
        state.believed_ns[s], state.gain[s] = believed_ns[s], weight[s]
        state.accepted_ns = max(state.accepted_ns, believed_ns[s])


@njit(cache=True)
def insert(model, states, measurements, ring, m):  # type: ignore[no-untyped-def]
    """Takes a measurement: ACCEPTED or GATED, LATE (older than the history: not applied) or DUPLICATE (not applied). A full ring
    gives up its oldest entry before the horizon does."""
    size, horizon_ns = len(states), np.int64(model.horizon * 1e9)
    at = ring[1]  # where it belongs: seldom far from the end
    while at > 0 and _is_after(measurements[(ring[0] + at - 1) % size], m):
        at -= 1
    newest_ns = measurements[(ring[0] + ring[1] - 1) % size].stamp_ns
    if at == 0 or m.stamp_ns < newest_ns - horizon_ns:
        return LATE
    if not _is_after(m, measurements[(ring[0] + at - 1) % size]):
        return DUPLICATE
    if ring[1] == size:
        if at == 1:
            return LATE
        _drop_first(ring, size)
        at -= 1
    for j in range(ring[1], at, -1):
        measurements[(ring[0] + j) % size] = measurements[(ring[0] + j - 1) % size]
    measurements[(ring[0] + at) % size] = m
    ring[1] += 1
    for j in range(at, ring[1]):
        slot = (ring[0] + j) % size
        states[slot] = states[(ring[0] + j - 1) % size]
        step(model, states[slot], measurements[slot])
    passed = states[(ring[0] + at) % size].passed
    newest_ns = max(newest_ns, m.stamp_ns)
    while ring[1] > 1 and measurements[(ring[0] + 1) % size].stamp_ns < newest_ns - horizon_ns:
        _drop_first(ring, size)
    return ACCEPTED if passed else GATED


@njit(cache=True)
def find(states, ring, stamp_ns):  # type: ignore[no-untyped-def]
    """The slot of the state after the newest measurement not after `stamp_ns`; of the oldest one that knows something, if all are
    later."""
    size, at = len(states), ring[1] - 1
    while at > 0 and states[(ring[0] + at) % size].stamp_ns > stamp_ns:
        at -= 1
    if at == 0 and ring[1] > 1 and states[ring[0]].stamp_ns == NEVER:
        at = 1
    return (ring[0] + at) % size


@njit(cache=True)
def _is_after(a, b):  # type: ignore[no-untyped-def]
    """Whether a measurement comes after another: by stamp, source, and position, as of two cameras that expose together."""
    if a.stamp_ns != b.stamp_ns:
        return a.stamp_ns > b.stamp_ns
    if a.source != b.source:
        return a.source > b.source
    for i in range(3):
        if a.p[i] != b.p[i]:
            return a.p[i] > b.p[i]
    return False


@njit(cache=True)
def _drop_first(ring, size):  # type: ignore[no-untyped-def]
    ring[0] = (ring[0] + 1) % size
    ring[1] -= 1


@njit(cache=True)
def clear_all(states, measurements, rings):  # type: ignore[no-untyped-def]
    for i in range(len(rings)):
        clear(states[i], measurements[i], rings[i])


@njit(cache=True)
def measure_all(models, states, measurements, rings, targets, sources, stamps_ns, T, information, latest_ns, fates):  # type: ignore[no-untyped-def]
    """`Bank.measure`, one after the other."""
    m = np.empty(1, MEASUREMENT)[0]
    for r in range(len(targets)):
        i = targets[r]
        fates[r] = fault(stamps_ns[r], T[r], information[r], latest_ns)
        if fates[r] == 0:
            reduce(models[i], sources[r], stamps_ns[r], T[r], information[r], m)
            fates[r] = insert(models[i], states[i], measurements[i], rings[i], m) if m.rank else NOTHING


@njit(cache=True)
def estimate_all(models, states, rings, stamp_ns, out):  # type: ignore[no-untyped-def]
    """`Bank.estimate`, one after the other."""
    for n in range(len(out)):
        model, state, found = models[n], states[n, find(states[n], rings[n], stamp_ns)], out[n]
        if state.stamp_ns == NEVER:
            p, R, P = model.home[:3, 3].copy(), model.home[:3, :3].copy(), model.home_covariance.copy()
            velocity, found.state = np.zeros(POSE), LOST
        else:
            p, R, P = state.p.copy(), state.R.copy(), state.P[:MOTION, :MOTION].copy()
            velocity = state.velocity.copy()
            move(model, max(0.0, (stamp_ns - state.stamp_ns) * 1e-9), p, R, velocity, P, state.agility)
            found.state = state_of((stamp_ns - state.accepted_ns) * 1e-9, P, model.limits)
        for i in range(3):
            for j in range(3):
                found.T[i, j] = R[i, j]
            found.T[i, 3], found.T[3, i] = p[i], 0.0
        found.T[3, 3] = 1.0
        for i in range(POSE):
            found.velocity[i] = velocity[i]
            for j in range(POSE):
                found.covariance[i, j] = P[i, j]
        total = 0.0
        for s in range(SENSES):
            total += state.gain[s]
        for s in range(SENSES):
            found.believed_ns[s] = state.believed_ns[s]
            found.weight[s] = state.gain[s] / total if total > 0.0 else 0.0
