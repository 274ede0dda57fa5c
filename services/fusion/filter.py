"""The default observer's filter, compiled: an error-state Kalman filter for senses with lasting errors.

State: position p, rotation R, linear and angular velocity and acceleration, a bias of every sense, and the offset of a wrong one.
Errors are along fixed axes, the rotation's applied from the left (`shared.geometry.rigid.perturb`). Their motion model is in
`motion.py`.

A sense is wrong by nearly the same amount from one measurement to the next: a mask that is a pixel too large puts a forearm 2 cm
too near for as long as nobody moves. A filter that treats 100 such measurements a second as independent assumes a tenth of their
error, and then ignores the other sense. So the error of every measurement is split: a share `lasting` of its variance belongs to
the sense's bias, a first-order Gauss-Markov process that the filter estimates, and the rest is white. The bias is in units of the
measurement's own standard deviation, which changes with distance and occlusion: a measurement of covariance L L' reads
pose + sqrt(lasting) L bias + white noise. Where a stated covariance allows for rare large errors, L L' is the `typical` share of
it: a filter that weighs by more takes a limb's motion for a change of the bias, and lags behind. What the bias may be larger by
is considered and not estimated: `history.consider` adds it to the covariance that is published. A measurement that leaves
directions open is linearised where it was measured; used far from there, it has an error which lasts, too (`measurement.error`).

A measurement that the gate refuses and another sense contradicts is wrong, but its changes may be right. From then on its sense
reads pose + offset + bias + white noise. The offset is unknown at first, and constant except for a slow random walk. While the
sense is on trial, its measurements update the offset and not the pose; later ones also update the motion of the limb, as far as
their noise allows. The speed of the offset's walk is learned: a sense whose offset runs away says nothing about the limb. The
offset is dropped when a measurement passes the gate without it, because the sense is right again, and when the sense or another
one is surprising: then the sense is not used until it is right again, which also means near what the others measured last: a
covariance that has grown since lets anything pass the gate.

Three factors adapt to the innovations, by whether each innovation resembles the one before of the same sense:
- If those of a wrong sense, relative to its offset, resemble each other, the offset runs away: its walk grows.
- If those of other senses resemble each other, the filter lags behind the limb: the process noise grows, separately for linear
  and angular motion, because otherwise a limb that turns would let a sense with a wrong position pass. It stays large while the
  limb moves fast, and for seconds afterwards.
- If innovations are too large and do not resemble each other, the sense is noisier than it says: its covariance grows, and is
  never smaller than the sense says.

Everything works in place on the records of `records.py`; `history.py` calls `step` with the measurements that `measurement.py`
makes of poses. The number of senses is that of the records. Functions write their results to their last arguments.

Sources: error-state filter on SO(3): Sola, "Quaternion kinematics for the error-state Kalman filter" (2017), arXiv:1711.02508;
coloured measurement noise by state augmentation: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and
Navigation" (2001), sections 8.2 and 8.3, DOI 10.1002/0471221279; correlation of innovations as the sign of a wrong process
noise: Mehra, "On the identification of variances and adaptive Kalman filtering" (1970), DOI 10.1109/TAC.1970.1099422; errors that
are considered and not corrected: Schmidt, "Application of state-space methods to navigation problems" (1966),
DOI 10.1016/B978-1-4831-6716-9.50011-4.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from penumbra.services.fusion.measurement import error
from penumbra.services.fusion.motion import flow, move, transit
from penumbra.services.fusion.records import MOTION, NEVER, NOBODY, POSE, UNITS
from penumbra.shared.geometry import so3
from penumbra.shared.native import inner

REFUSED_RATE = 30.0
"""Factor on the growth rate of the process noise while measurements are refused: all are, until the filter has caught up with the
limb. Chosen: with 4, a hand that reaches 20 to 45 cm within 0.3 s, after a rest of a second, is found again up to a picture
later."""
SWIFT, REMEMBERED = 100.0, 0.3
"""Agility above which a limb is fast, and factor on the rate at which its agility then decreases: a fast hand that rests will set
out as before, and no picture shows it in time. Slow limbs have agilities up to 20. With 0.3 instead of 1, 0.05 % instead of 1.0 %
of the poses of a fast hand are beyond three sigma (12 runs of seed 8401)."""
FAST, RESTED_S, FORGOTTEN = 2.0, 3.0, 0.4
"""A limb whose speed has not been above that many times `velocity_spread` (0.8 m/s, 2 rad/s) for that time [s] is not fast any
more: its agility then decreases down to SWIFT at that share of the learning rate, by a factor of 7 a second for each sense. Fast
hands reach that speed at least every 2.6 s (12 runs of seed 8821)."""
TOLD_APART = 9.0
"""Squared Mahalanobis distance between two poses, by the covariance of one measurement, above which that measurement tells them
apart: three standard deviations."""
SURPRISING = 2.0
"""Squared Mahalanobis distance per direction (1 expected) above which a measurement does not change the process noise while
another sense agrees better with the state: otherwise the state would follow a sense with a small bias. Chosen, not measured."""


class State(NamedTuple):
    """One entry of a history. now : STATE. senses (n,) : SENSE_STATE. P (size, size) : covariance of all errors."""

    now: Any
    senses: Any
    P: Any


class Model(NamedTuple):
    """one : MODEL of the target. senses (n,) : SENSE_MODEL."""

    one: Any
    senses: Any


@inner
def forget(state):  # type: ignore[no-untyped-def]
    """Makes a state without any information."""
    now = state.now
    now.stamp_ns = now.accepted_ns = NEVER
    now.passed = now.rank = 0
    now.distance = 0.0
    now.agility[0] = now.agility[1] = now.wander[0] = now.wander[1] = 1.0
    now.fast_ns[0] = now.fast_ns[1] = NEVER
    now.wrong = NOBODY
    for i in range(POSE):
        now.velocity[i] = now.acceleration[i] = now.offset[i] = 0.0
    for s in range(len(state.senses)):
        sense = state.senses[s]
        sense.measured_ns = sense.learned_ns = sense.accepted_ns = sense.refused_ns = NEVER
        sense.refused = sense.contradicted = sense.has_innovation = sense.unsteady = 0
        sense.gain, sense.doubt = 0.0, 1.0
        for i in range(POSE):
            sense.bias[i] = 0.0


@inner
def step(model, state, m, PHt):  # type: ignore[no-untyped-def]
    """Advances a state to a measurement: predicts it, and updates it unless the gate refuses. PHt (size, 6): memory."""
    one, now, sense = model.one, state.now, state.senses[m.source]
    fresh = m.stamp_ns - now.accepted_ns > one.lost_age * 1e9
    if fresh:
        _start_at_home(one, state, m)
    else:
        predict(model, state, m.stamp_ns)
    sense.rank = m.rank
    so3.copy(m.directions, sense.directions)
    for k in range(m.rank):
        sense.sigma[k], sense.rest[k] = m.sigma[k], m.rest[k]
    z, H, S_inverse, innovation = np.empty(POSE), np.zeros((POSE, 3 * POSE)), np.empty((POSE, POSE)), np.empty(POSE)
    while True:
        linearised(model, state, m, z, H)
        innovated(model, state, m, z, H, PHt, S_inverse, innovation)
        for j in range(POSE):
            sense.residual[j] = 0.0
            for k in range(m.rank):
                sense.residual[j] += z[k] * m.directions[k, j]
        if fresh:
            break
        distance = so3.dot(innovation, innovation)
        now.distance, now.rank = distance, m.rank
        sense.surprise, sense.measured_ns = distance / m.rank, m.stamp_ns
        contradicted = _is_contradicted(one, state, m, z)
        gate = 0 if not contradicted else 1 if sense.refused < one.refusals else 2
        passes = distance <= model.senses[m.source].threshold[gate, m.rank]
        if passes and sense.unsteady and _disagrees(one, state, m):  # only the covariance has grown meanwhile
            passes, contradicted = False, True
        if now.wrong != NOBODY and now.wrong != m.source and distance > model.senses[m.source].threshold[1, m.rank]:
            _refute(state)
            continue
        if not passes and not contradicted:
            learn(model, state, m, innovation, REFUSED_RATE)
        elif passes:
            learn(model, state, m, innovation, 0.0 if contradicted and distance > SURPRISING * m.rank else 1.0)
        if passes:
            if now.wrong != m.source:
                break
            trust(state)  # it is right again, whatever it was wrong by
            fresh = True
            continue
        if sense.refused == 0:
            sense.refused_ns = m.stamp_ns
        sense.refused += 1
        sense.contradicted = 1 if contradicted else 0
        now.passed = 0
        if _is_blind(one, state) and not contradicted:
            _start_where_it_is(one, state, m)
        elif _is_persistent(one, state, m):
            # So long a disagreement is no outlier: one of the senses is biased beyond its covariance, nobody knows which.
            trust(state)
            for i in range(len(state.P)):
                for j in range(len(state.P)):
                    state.P[i, j] *= distance / m.rank
        else:
            _follow(model, state, m, z, H, PHt, S_inverse, innovation, contradicted)
            return
        fresh = True  # as if it were the first
    update(state, m, z, PHt, S_inverse, 0)
    now.accepted_ns = sense.accepted_ns = m.stamp_ns
    sense.refused, sense.refused_ns, sense.unsteady = 0, NEVER, 0
    now.passed = 1


@inner
def _follow(model, state, m, z, H, PHt, S_inverse, innovation, contradicted):  # type: ignore[no-untyped-def]
    """Uses how a refused measurement changes, as one of a sense that is off by an offset which stays: from where it is
    contradicted on, and while nothing refutes that."""
    now, sense = state.now, state.senses[m.source]
    if now.wrong == m.source:
        offset(model, state, m, z, H)
        innovated(model, state, m, z, H, PHt, S_inverse, innovation)
        if so3.dot(innovation, innovation) <= model.senses[m.source].threshold[1, m.rank]:
            _learn_wander(model.one, now, sense, m, innovation)
            is_on_trial = m.stamp_ns - sense.refused_ns < model.one.offset_trial * 1e9
            update(state, m, z, PHt, S_inverse, len(state.P) - POSE if is_on_trial else 0)
        else:
            _refute(state)
    elif contradicted and now.wrong == NOBODY and not sense.unsteady:
        now.wrong, sense.has_innovation = m.source, 0
        now.wander[0] = now.wander[1] = 1.0
        offset(model, state, m, z, H)
        innovated(model, state, m, z, H, PHt, S_inverse, innovation)
        update(state, m, z, PHt, S_inverse, len(state.P) - POSE)


@inner
def _learn_wander(one, now, sense, m, innovation):  # type: ignore[no-untyped-def]
    """Adapts how fast the offset of a wrong sense wanders to an innovation (6,) of that sense."""
    scale = _moderation(m, innovation)
    if sense.has_innovation:
        for half in range(2):
            change = one.offset_learning * scale * _resemblance(m, innovation, sense.innovation, half)
            now.wander[half] = min(max(now.wander[half] * math.exp(change), 1.0), one.offset_wander)
    _keep(sense, innovation, scale)


@inner
def _refute(state):  # type: ignore[no-untyped-def]
    """No offset of the wrong sense stays: it is not used until it is right again."""
    state.senses[state.now.wrong].unsteady = 1
    trust(state)


@inner
def trust(state):  # type: ignore[no-untyped-def]
    """Forgets that a sense is taken for wrong by an offset."""
    now, P = state.now, state.P
    if now.wrong != NOBODY:
        state.senses[now.wrong].has_innovation = 0  # the last one was beside its offset
    now.wrong = NOBODY
    for i in range(len(P) - POSE, len(P)):
        now.offset[i + POSE - len(P)] = 0.0
        for j in range(len(P)):
            P[i, j] = P[j, i] = 1.0 if i == j else 0.0


@inner
def _is_contradicted(one, state, m, z):  # type: ignore[no-untyped-def]
    """Whether another sense with a recent measurement, accepted or not, agrees better with the state: then the measurement is
    wrong rather than the state. To adapt to it would raise the process noise until it passes the gate. A sense that cannot tell
    the measured pose from the state's agrees with either: the skin does not feel a roll, and from afar not where along itself a
    limb is. z: the innovation (k,)."""
    surprise = state.senses[m.source].surprise
    for s in range(len(state.senses)):
        other = state.senses[s]
        if m.stamp_ns - other.measured_ns < one.agreement_time * 1e9 and other.surprise < surprise:
            apart = 0.0
            for k in range(other.rank):
                along = 0.0
                for i in range(m.rank):
                    along += z[i] * so3.dot(m.directions[i], other.directions[k])
                apart += (along / other.sigma[k]) ** 2
            if apart > TOLD_APART:
                return True
    return False


@inner
def _disagrees(one, state, m):  # type: ignore[no-untyped-def]
    """Whether a recent measurement of another sense is told apart from this one, by the covariances of the two. If the other one
    was refused, the limb may have moved in between as the state does not."""
    sense = state.senses[m.source]
    for s in range(len(state.senses)):
        other = state.senses[s]
        age = (m.stamp_ns - other.measured_ns) * 1e-9
        if s == m.source or age >= one.agreement_time:
            continue
        apart = 0.0
        for k in range(other.rank):
            along, variance = 0.0, other.sigma[k] ** 2
            for j in range(POSE):
                along += (sense.residual[j] - other.residual[j]) * other.directions[k, j]
                if other.refused:
                    variance += (age * one.velocity_spread[j // 3] / UNITS[j] * other.directions[k, j]) ** 2
            for i in range(m.rank):
                variance += (m.sigma[i] * so3.dot(m.directions[i], other.directions[k])) ** 2
            apart += along**2 / variance
        if apart > TOLD_APART:
            return True
    return False


@inner
def is_contested(one, state, stamp_ns):  # type: ignore[no-untyped-def]
    """Whether a sense contradicts the state at a stamp, and no other one contradicts that sense, or nothing newer has confirmed
    the state: the limb may be elsewhere. A sense that is wrong for long is answered by the next measurement that is accepted of
    another one which can tell the two poses apart, and one that falls silent, by time."""
    for s in range(len(state.senses)):
        sense = state.senses[s]
        is_answered = sense.contradicted or stamp_ns - sense.measured_ns >= one.denial[1] * 1e9
        if sense.refused and (not is_answered or sense.refused_ns >= state.now.accepted_ns):
            return True
    return False


@inner
def _is_blind(one, state):  # type: ignore[no-untyped-def]
    """Whether everything of all senses has been refused for so long that the state must be wrong."""
    now = state.now
    first_ns, refused = now.stamp_ns, 0
    for s in range(len(state.senses)):
        sense = state.senses[s]
        if sense.refused:
            first_ns = min(first_ns, sense.refused_ns)
            refused += sense.refused
    return now.stamp_ns - max(now.accepted_ns, first_ns) >= one.patience * 1e9 and refused >= one.refusals


@inner
def _is_persistent(one, state, m):  # type: ignore[no-untyped-def]
    """Whether everything of the measurement's sense has been refused for so long that one of the senses must be wrong."""
    sense = state.senses[m.source]
    lasts_ns = m.stamp_ns - sense.refused_ns
    return sense.refused >= one.refusals and lasts_ns >= one.source_patience * 1e9


@inner
def _start_at_home(one, state, m):  # type: ignore[no-untyped-def]
    """Begins where the target is expected before anything is known."""
    p, R, covariance = np.empty(3), np.empty((3, 3)), np.empty((POSE, POSE))
    for i in range(3):
        p[i] = one.home[i, 3]
    so3.copy(one.home, R)
    so3.copy(one.home_covariance, covariance)
    start(one, state, m, p, R, covariance)


@inner
def _start_where_it_is(one, state, m):  # type: ignore[no-untyped-def]
    """Begins anew at the state's own pose, which may be wrong by as much as one that is only expected."""
    p, R, covariance = np.empty(3), np.empty((3, 3)), np.empty((POSE, POSE))
    for i in range(3):
        p[i] = state.now.p[i]
    so3.copy(state.now.R, R)
    for i in range(POSE):
        for j in range(POSE):
            covariance[i, j] = state.P[i, j] + one.home_covariance[i, j]
    start(one, state, m, p, R, covariance)


@inner
def start(one, state, m, p, R, covariance):  # type: ignore[no-untyped-def]
    """Makes a new state for one measurement to update; along what it does not observe, from a pose p (3,), R (3, 3) with its
    covariance (6, 6), which are changed."""
    value, derivative, correction = np.empty(POSE), np.empty((POSE, POSE)), np.empty(POSE)
    turn, turned = np.empty((3, 3)), np.empty((3, 3))
    for _ in range(5):  # Gauss-Newton on the observed directions; one step does where all are observed
        error(p, R, m, value, derivative)
        for j in range(POSE):
            correction[j] = 0.0
            for i in range(m.rank):
                correction[j] -= value[i] * UNITS[j] * m.directions[i, j]
        for i in range(3):
            p[i] += correction[i]
        so3.exp(correction[3:], turn)
        so3.product(turn, R, turned)
        so3.copy(turned, R)
    wide, product = np.empty((POSE, POSE)), np.empty((POSE, POSE))
    for i in range(POSE):
        for j in range(POSE):
            wide[i, j] = 1.0 if i == j else 0.0
            for k in range(m.rank):  # where it observes, the measurement decides
                wide[i, j] += 9.0 * UNITS[i] * m.directions[k, i] * m.basis[k, j]
    so3.product(wide, covariance, product)
    so3.product_transposed(product, wide, covariance)
    forget(state)
    now = state.now
    now.stamp_ns = now.accepted_ns = state.senses[m.source].learned_ns = m.stamp_ns
    for i in range(3):
        now.p[i] = p[i]
    so3.copy(R, now.R)
    spread(one, state, covariance)


@inner
def spread(one, state, covariance):  # type: ignore[no-untyped-def]
    """Sets the covariance of all errors where only the pose's (6, 6) is known."""
    P = state.P
    for i in range(len(P)):
        for j in range(len(P)):
            P[i, j] = 0.5 * (covariance[i, j] + covariance[j, i]) if i < POSE and j < POSE else 0.0
        if i >= POSE:
            P[i, i] = 1.0
            if i < MOTION:
                P[i, i] = one.velocity_spread[i % POSE // 3] ** 2
            if 2 * POSE <= i < MOTION:
                P[i, i] /= one.motion_time[i % POSE // 3] ** 2


@inner
def predict(model, state, stamp_ns):  # type: ignore[no-untyped-def]
    """Takes a state on to a later stamp."""
    one, now, P = model.one, state.now, state.P
    dt = (stamp_ns - now.stamp_ns) * 1e-9
    move(one, dt, now.p, now.R, now.velocity, now.acceleration, P, now.agility)
    fade(model.senses, dt, P)
    for s in range(len(state.senses)):
        sense = state.senses[s]
        for i in range(POSE):
            sense.bias[i] *= math.exp(-dt / model.senses[s].time_constant)
        sense.gain *= math.exp(-dt / one.weight_time)
    if now.wrong != NOBODY:
        for i in range(POSE):
            walk = one.offset_drift[i // 3] / one.offset_spread[i // 3]
            P[len(P) - POSE + i, len(P) - POSE + i] += dt * now.wander[i // 3] * walk**2
    now.stamp_ns = stamp_ns


@inner
def fade(sense_models, dt, P):  # type: ignore[no-untyped-def]
    """Takes the covariance of all errors on by dt [s], as far as the biases of the senses change."""
    for s in range(len(sense_models)):
        keep, first = math.exp(-dt / sense_models[s].time_constant), MOTION + POSE * s
        for i in range(first, first + POSE):
            for j in range(len(P)):
                P[i, j] *= keep
            for j in range(len(P)):
                P[j, i] *= keep
            P[i, i] += 1.0 - keep**2


@inner
def transition(model, now, stamp_ns, F):  # type: ignore[no-untyped-def]
    """The derivative F (size, size) of the errors at a later stamp by those of a STATE: `predict` makes P of F P F' + Q."""
    one, dt = model.one, (stamp_ns - now.stamp_ns) * 1e-9
    by, rotation, turn = np.empty((2, 6)), np.empty(3), np.empty((3, 3))
    flow(one, dt, now.agility, by)
    for i in range(3):
        rotation[i] = by[1, 0] * now.velocity[3 + i] + by[1, 1] * now.acceleration[3 + i]
    so3.exp(rotation, turn)
    for i in range(len(F)):
        for j in range(len(F)):
            F[i, j] = 1.0 if i == j else 0.0
    transit(F, turn, rotation, by)
    for i in range(MOTION, len(F) - POSE):
        F[i, i] = math.exp(-dt / model.senses[(i - MOTION) // POSE].time_constant)


@inner
def linearised(model, state, m, z, H):  # type: ignore[no-untyped-def]
    """Innovation z (k,) and its derivative H[:, :12] by the pose and the sense's bias, the white noise left out.

    A measurement says: the error e with `perturb(T_measured, e) == T_true` is noise along its directions.
    """
    of, sense = model.senses[m.source], state.senses[m.source]
    derivative = np.empty((POSE, POSE))
    bend = error(state.now.p, state.now.R, m, z, derivative)
    for i in range(m.rank):
        # what no covariance contains, the errors of calibration (the floor) and of linearisation (the bend), lasts
        unstated = of.floor**2 + bend**2 * so3.dot(m.directions[i, :3], m.directions[i, :3])
        lasting = math.sqrt(sense.doubt * (of.lasting * m.sigma[i] ** 2 + unstated))
        z[i] = -z[i]
        for j in range(POSE):
            H[i, j] = derivative[i, j]
            H[i, POSE + j] = lasting * m.directions[i, j]
            z[i] -= H[i, POSE + j] * sense.bias[j]


@inner
def offset(model, state, m, z, H):  # type: ignore[no-untyped-def]
    """Takes the offset of a wrong sense out of the innovation z (k,), and writes its derivative by it, H[:, 12:] (k, 6)."""
    for i in range(m.rank):
        for j in range(POSE):
            H[i, 2 * POSE + j] = m.basis[i, j] * model.one.offset_spread[j // 3]
            z[i] -= H[i, 2 * POSE + j] * state.now.offset[j]


@inner
def innovated(model, state, m, z, H, PHt, S_inverse, innovation):  # type: ignore[no-untyped-def]
    """With H (k, 18) by the pose, the bias and the offset: P H' (size, k), the inverse of the innovation's covariance (k, k), and
    the innovation (6,) in units of its standard deviation, zero where the measurement sees nothing; its square is the squared
    Mahalanobis distance."""
    k, first, last, P = m.rank, MOTION + POSE * m.source, len(state.P) - POSE, state.P
    for i in range(len(P)):
        for j in range(k):
            PHt[i, j] = 0.0
            for c in range(POSE):
                PHt[i, j] += P[i, c] * H[j, c] + P[i, first + c] * H[j, POSE + c] + P[i, last + c] * H[j, 2 * POSE + c]
    S, vectors = np.empty((POSE, POSE)), np.empty((POSE, POSE))
    for i in range(k):
        for j in range(k):
            S[i, j] = S_inverse[i, j] = 0.0
            for c in range(POSE):
                S[i, j] += H[i, c] * PHt[c, j] + H[i, POSE + c] * PHt[first + c, j] + H[i, 2 * POSE + c] * PHt[last + c, j]
        S[i, i] += state.senses[m.source].doubt * (1.0 - model.senses[m.source].lasting) * m.sigma[i] ** 2
    so3.eigen(S, k, vectors)
    for j in range(POSE):
        innovation[j] = 0.0
    for e in range(k):  # S^-1/2 is symmetric, so that innovations of different directions compare
        along = 0.0
        for i in range(k):
            along += vectors[i, e] * z[i]
            for j in range(k):
                S_inverse[i, j] += vectors[i, e] * vectors[j, e] / S[e, e]
        for i in range(k):
            for j in range(POSE):
                innovation[j] += along / math.sqrt(S[e, e]) * vectors[i, e] * m.directions[i, j]


@inner
def learn(model, state, m, innovation, factor):  # type: ignore[no-untyped-def]
    """Adapts the agilities, `factor` times as fast as usual, and the doubt to an innovation (6,)."""
    now, sense, bounds = state.now, state.senses[m.source], model.one.agility
    scale = _moderation(m, innovation)
    if sense.has_innovation:
        rate = min(model.one.learning[0], model.one.learning[1] * (m.stamp_ns - sense.learned_ns) * 1e-9)
        alike = scale * so3.dot(innovation, sense.innovation) / m.rank  # 0 expected
        unlike = scale * scale * so3.dot(innovation, innovation) / m.rank - alike  # 1 expected
        for half in range(2):
            change = factor * rate * scale * _resemblance(m, innovation, sense.innovation, half)
            if now.agility[half] <= SWIFT or _is_fast(model.one, now, half):
                now.fast_ns[half] = m.stamp_ns
            if m.stamp_ns - now.fast_ns[half] > RESTED_S * 1e9:
                change -= FORGOTTEN * rate
            elif change < 0.0 and now.agility[half] > SWIFT:
                change *= REMEMBERED  # it may set out again as it did before
            now.agility[half] = min(max(now.agility[half] * math.exp(change), bounds[0]), bounds[1])
        sense.doubt = min(max(sense.doubt * math.exp(0.5 * rate * (unlike - 1.25)), 1.0), model.one.doubt)
    sense.learned_ns = m.stamp_ns
    _keep(sense, innovation, scale)


@inner
def _is_fast(one, now, half):  # type: ignore[no-untyped-def]
    """Whether a limb moves (half 0) or turns (1) as slow limbs never do."""
    velocity = now.velocity[3 * half : 3 * half + 3]
    return so3.dot(velocity, velocity) > (FAST * one.velocity_spread[half]) ** 2


@inner
def _moderation(m, innovation):  # type: ignore[no-untyped-def]
    """What an innovation (6,) is to be multiplied with before anything is learned from it: an outlier counts no more than two
    sigma do."""
    return min(1.0, 2.0 / max(math.sqrt(so3.dot(innovation, innovation) / m.rank), 1e-9))


@inner
def _resemblance(m, innovation, last, half):  # type: ignore[no-untyped-def]
    """How much the translation (half 0) or rotation (1) of an innovation (6,) is as that of the last one (6,): the mean product
    of what is observed of both, 0 expected."""
    share, along = 0.0, 0.0
    for i in range(3 * half, 3 * half + 3):
        along += innovation[i] * last[i]
        for k in range(m.rank):
            share += m.directions[k, i] ** 2
    return along / share if share > 1e-3 else 0.0


@inner
def _keep(sense, innovation, scale):  # type: ignore[no-untyped-def]
    """Remembers an innovation (6,), times a scale, as the sense's last one."""
    sense.has_innovation = 1
    for i in range(POSE):
        sense.innovation[i] = scale * innovation[i]


@inner
def update(state, m, z, PHt, S_inverse, first):  # type: ignore[no-untyped-def]
    """Updates the errors of a state from the `first` on with a measurement; those before it stay as they are."""
    now, sense, P = state.now, state.senses[m.source], state.P
    before = _log_volume(P)
    K, rotation, turn = np.empty(POSE), np.empty(3), np.empty((3, 3))
    for i in range(len(P)):
        correction = 0.0
        for k in range(m.rank):  # a row of the gain
            K[k] = 0.0
            for j in range(m.rank):
                K[k] += PHt[i, j] * S_inverse[j, k]
            correction += K[k] * z[k]
        for k in range(m.rank):
            for j in range(0 if i >= first else first, len(P)):
                P[i, j] -= K[k] * PHt[j, k]
        if i < first:
            correction = 0.0
        if i < POSE:
            for s in range(len(state.senses)):
                state.senses[s].residual[i] -= correction / UNITS[i]
        if i < 3:
            now.p[i] += correction
        elif i < POSE:
            rotation[i - 3] = correction
        elif i < 2 * POSE:
            now.velocity[i - POSE] += correction
        elif i < MOTION:
            now.acceleration[i - 2 * POSE] += correction
        elif i < len(P) - POSE:
            state.senses[(i - MOTION) // POSE].bias[(i - MOTION) % POSE] += correction
        elif now.wrong != NOBODY:
            now.offset[i + POSE - len(P)] += correction
    so3.exp(rotation, turn)
    if m.rank < POSE:  # what is not observed turns with the limb: see `error`
        for first in (3, 9, 15):
            so3.turn(turn, P, first)
            so3.turn_columns(turn, P, first)
    for i in range(len(P)):
        for j in range(i):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])
    so3.turn(turn, now.R, 0)
    so3.orthonormalise(now.R)
    sense.gain += 0.5 * (before - _log_volume(P))


@inner
def _log_volume(P):  # type: ignore[no-untyped-def]
    """The logarithm of the determinant of the pose's covariance, from its Cholesky factor."""
    L = np.empty((POSE, POSE))
    volume = 0.0
    for i in range(POSE):
        for j in range(i + 1):
            rest = P[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(rest) if i == j else rest / L[j, j]
        volume += 2.0 * math.log(L[i, i])
    return volume
