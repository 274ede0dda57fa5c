"""The history of the default observer, compiled, for measurements that come late and out of order.

The filter goes back to a measurement's stamp, applies it, and replays the later ones (`insert`). The result depends only on the
measurements and their stamps, and not on the order of arrival (within the horizon): the whole state of the filter, including its
refusals, is a function of the state before and the measurement (`filter.step`).

A history is a ring of measurements in the order of stamp, source and position, each with the state after it. Its first entry is
the newest one that is older than the horizon: nothing is inserted before it. `ring` (2,) holds the slot of the first entry and
the number of entries.

`clear_all`, `adopt`, `measure_all` and `estimate_all` are the entry points, for any number of targets.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from penumbra.services.fusion.estimate import (
    ACCEPTED,
    COASTING,
    DUPLICATE,
    GATED,
    LATE,
    LOST,
    NOTHING,
    TRACKING,
    fault,
    state_of,
)
from penumbra.services.fusion.filter import Model, State, fade, forget, is_contested, spread, step
from penumbra.services.fusion.measurement import reduce, undo
from penumbra.services.fusion.motion import move, within_reach
from penumbra.services.fusion.records import (
    ESTIMATE,
    MEASUREMENT,
    MODEL,
    MOTION,
    NEVER,
    POSE,
    SENSE_ESTIMATE,
    SENSE_MODEL,
    SENSE_STATE,
    STATE,
    UNITS,
)
from penumbra.shared.geometry import so3
from penumbra.shared.native import inner, kernel


class Entries(NamedTuple):
    """The history of one target: `records.History` without the first dimension."""

    measurements: Any
    states: Any
    senses: Any
    P: Any
    ring: Any


@inner
def clear(history):  # type: ignore[no-untyped-def]
    """Makes a history of one entry without any information, older than every measurement."""
    history.ring[0], history.ring[1] = 0, 1
    first = history.measurements[0]
    first.stamp_ns, first.source = NEVER, -1
    forget(State(history.states[0], history.senses[0], history.P[0]))


@inner
def insert(model, history, m, PHt):  # type: ignore[no-untyped-def]
    """Takes a measurement: ACCEPTED or GATED, LATE (older than the history: not applied) or DUPLICATE (not applied). Where
    the ring is full, its oldest entry is dropped, though it is within the horizon."""
    measurements, ring = history.measurements, history.ring
    size, horizon_ns = len(measurements), np.int64(model.one.horizon * 1e9)
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
        _copy_state(history, (ring[0] + j - 1) % size, slot)
        step(model, State(history.states[slot], history.senses[slot], history.P[slot]), measurements[slot], PHt)
    passed = history.states[(ring[0] + at) % size].passed
    newest_ns = max(newest_ns, m.stamp_ns)
    while ring[1] > 1 and measurements[(ring[0] + 1) % size].stamp_ns < newest_ns - horizon_ns:
        _drop_first(ring, size)
    return ACCEPTED if passed else GATED


@inner
def _copy_state(history, source, slot):  # type: ignore[no-untyped-def]
    history.states[slot] = history.states[source]
    for s in range(history.senses.shape[1]):
        history.senses[slot, s] = history.senses[source, s]
    so3.copy(history.P[source], history.P[slot])


@inner
def find(history, stamp_ns):  # type: ignore[no-untyped-def]
    """The slot of the state after the newest measurement not after `stamp_ns`; of the oldest one with information, if all are
    later."""
    states, ring = history.states, history.ring
    size, at = len(states), ring[1] - 1
    while at > 0 and states[(ring[0] + at) % size].stamp_ns > stamp_ns:
        at -= 1
    if at == 0 and ring[1] > 1 and states[ring[0]].stamp_ns == NEVER:
        at = 1
    return (ring[0] + at) % size


@inner
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


@inner
def _drop_first(ring, size):  # type: ignore[no-untyped-def]
    ring[0] = (ring[0] + 1) % size
    ring[1] -= 1


@kernel(
    "out MEASUREMENT[t, c], out STATE[t, c], out SENSE_STATE[t, c, n], out f8[t, c, size, size], out i8[t, 2]",
    MEASUREMENT=MEASUREMENT,
    STATE=STATE,
    SENSE_STATE=SENSE_STATE,
)
def clear_all(measurements, states, senses, P, rings):  # type: ignore[no-untyped-def]
    """Clears the histories of all targets."""
    for i in range(len(rings)):
        clear(Entries(measurements[i], states[i], senses[i], P[i], rings[i]))


@inner
def _calibration(sense_models, shares):  # type: ignore[no-untyped-def]
    """The variance, in UNITS, of what a pose is off by because the senses that it is made of are: their calibration. To the
    filter it is a part of their biases, which decay and average out; it does not."""
    variance, total = 0.0, 0.0
    for s in range(len(shares)):
        variance += shares[s].weight * sense_models[s].floor ** 2
        total += shares[s].weight
    return variance / total if total > 0.0 else 0.0


@kernel("SENSE_MODEL[n], SENSE_STATE[n], f8[size, size], out f8[6, 6]", SENSE_MODEL=SENSE_MODEL, SENSE_STATE=SENSE_STATE)
def consider(sense_models, senses, P, covariance):  # type: ignore[no-untyped-def]
    """Adds to a pose's covariance what the pose is off by where the senses' common errors are larger than the filter assumes.

    It depends on a bias by P_pb P_bb^-1: not at all, where another sense has told what the bias is.
    """
    variances, vectors, along = np.empty((POSE, POSE)), np.empty((POSE, POSE)), np.empty((POSE, POSE))
    larger, gain, product = np.empty((POSE, POSE)), np.empty((POSE, POSE)), np.empty((POSE, POSE))
    for s in range(len(senses)):
        of, sense, first = sense_models[s], senses[s], MOTION + POSE * s
        if of.typical == 1.0:
            continue
        for i in range(POSE):
            for j in range(POSE):
                variances[i, j] = P[first + i, first + j]
                larger[i, j] = 0.0
                for k in range(sense.rank):
                    share = sense.rest[k] / (of.lasting * sense.sigma[k] ** 2 + of.floor**2)
                    larger[i, j] += math.sqrt(share) * sense.directions[k, i] * sense.directions[k, j]
        so3.eigen(variances, POSE, vectors)
        for i in range(POSE):
            for e in range(POSE):
                along[i, e] = 0.0
                for j in range(POSE):
                    along[i, e] += P[i, first + j] * vectors[j, e] / variances[e, e]
        so3.product_transposed(along, vectors, product)
        so3.product(product, larger, gain)
        so3.product(gain, vectors, along)
        for i in range(POSE):
            for j in range(POSE):
                for e in range(POSE):
                    covariance[i, j] += along[i, e] * variances[e, e] * along[j, e]


@kernel(
    "MODEL[t], SENSE_MODEL[n], out MEASUREMENT[t, c], out STATE[t, c], out SENSE_STATE[t, c, n], out f8[t, c, size, size], "
    "out i8[t, 2], i8, i8, f8[4, 4], f8[6], f8[6, 6], SENSE_ESTIMATE[n]",
    MODEL=MODEL,
    SENSE_MODEL=SENSE_MODEL,
    MEASUREMENT=MEASUREMENT,
    STATE=STATE,
    SENSE_STATE=SENSE_STATE,
    SENSE_ESTIMATE=SENSE_ESTIMATE,
)
def adopt(
    models, sense_models, measurements, states, senses, P, rings, target, stamp_ns, T, velocity, covariance, known
):  # type: ignore[no-untyped-def]  # fmt: skip
    """Makes a history of one entry: a pose T (4, 4) at a stamp, with velocity (6,), the pose's covariance (6, 6), and what is
    known of the senses. The velocity may be off by as much as one that is unknown."""
    history = Entries(measurements[target], states[target], senses[target], P[target], rings[target])
    clear(history)
    state = State(history.states[0], history.senses[0], history.P[0])
    now, first = state.now, history.measurements[0]
    first.stamp_ns = now.stamp_ns = stamp_ns
    for i in range(3):
        now.p[i] = T[i, 3]
    so3.copy(T, now.R)
    so3.orthonormalise(now.R)
    spread(models[target], state, covariance)
    scaled, vectors, calibration = np.empty((POSE, POSE)), np.empty((POSE, POSE)), _calibration(sense_models, known)
    for i in range(POSE):
        for j in range(POSE):
            scaled[i, j] = state.P[i, j] / (UNITS[i] * UNITS[j])
    so3.eigen(scaled, POSE, vectors)
    if scaled[0, 0] > calibration:  # as it is in all that this observer publishes
        for i in range(POSE):
            state.P[i, i] -= calibration * UNITS[i] ** 2
    for i in range(POSE):
        now.velocity[i] = velocity[i]
    for s in range(len(known)):
        sense = state.senses[s]
        sense.accepted_ns, sense.gain = known[s].accepted_ns, known[s].weight
        now.accepted_ns = max(now.accepted_ns, known[s].accepted_ns)


@kernel(
    "MODEL[t], SENSE_MODEL[n], out MEASUREMENT[t, c], out STATE[t, c], out SENSE_STATE[t, c, n], out f8[t, c, size, size], "
    "out i8[t, 2], i8[m], i8[m], i8[m], f8[m, 4, 4], f8[m, 6, 6], f8[m, 6], i8, out i8[m], out MEASUREMENT[1], out f8[size, 6]",
    MODEL=MODEL,
    SENSE_MODEL=SENSE_MODEL,
    MEASUREMENT=MEASUREMENT,
    STATE=STATE,
    SENSE_STATE=SENSE_STATE,
)
def measure_all(
    models, sense_models, measurements, states, senses, P, rings,
    targets, sources, stamps_ns, T, information, steps, latest_ns, fates, taken, PHt,
):  # type: ignore[no-untyped-def]  # fmt: skip
    """`Bank.measure`, one after the other. taken, PHt : memory for the measurement under way, and for `step`."""
    m, there, known = taken[0], np.empty((4, 4)), np.empty((POSE, POSE))
    for r in range(len(targets)):
        i = targets[r]
        so3.copy(T[r], there)
        so3.copy(information[r], known)
        undo(steps[r], there, known)
        fates[r] = fault(stamps_ns[r], there, known, latest_ns)
        if fates[r] == 0:
            model = Model(models[i], sense_models)
            reduce(model, sources[r], stamps_ns[r], there, known, steps[r], m)
            history = Entries(measurements[i], states[i], senses[i], P[i], rings[i])
            fates[r] = insert(model, history, m, PHt) if m.rank else NOTHING


@inner
def _is_denied(one, senses, denied_ns, stamp_ns):  # type: ignore[no-untyped-def]
    """Whether a sense that saw the target until recently looks where the target is expected, and does not find it there."""
    for s in range(len(senses)):
        seen_ns, said_ns = senses[s].accepted_ns, denied_ns[s]
        has_seen = seen_ns != NEVER and stamp_ns - seen_ns < one.lost_age * 1e9
        if has_seen and said_ns - seen_ns > one.denial[0] * 1e9 and 0 <= stamp_ns - said_ns < one.denial[1] * 1e9:
            return True
    return False


@kernel(
    "MODEL[t], SENSE_MODEL[n], MEASUREMENT[t, c], STATE[t, c], SENSE_STATE[t, c, n], f8[t, c, size, size], i8[t, 2], i8[t, n], "
    "i8, out ESTIMATE[t], out SENSE_ESTIMATE[t, n]",
    MODEL=MODEL,
    SENSE_MODEL=SENSE_MODEL,
    MEASUREMENT=MEASUREMENT,
    STATE=STATE,
    SENSE_STATE=SENSE_STATE,
    ESTIMATE=ESTIMATE,
    SENSE_ESTIMATE=SENSE_ESTIMATE,
)
def estimate_all(
    models, sense_models, measurements, states, senses, P, rings, denied_ns, stamp_ns, out, shares
):  # type: ignore[no-untyped-def]  # fmt: skip
    """`Bank.estimate`, one after the other. denied_ns (t, n) : stamps at which senses last denied the targets."""
    p, R, ahead = np.empty(3), np.empty((3, 3)), np.empty_like(P[0, 0])
    velocity, acceleration = np.empty(POSE), np.empty(POSE)
    for n in range(len(out)):
        history = Entries(measurements[n], states[n], senses[n], P[n], rings[n])
        one, slot, found = models[n], find(history, stamp_ns), out[n]
        now, of_senses = states[n, slot], senses[n, slot]
        total = 0.0
        for s in range(len(of_senses)):
            total += of_senses[s].gain
        for s in range(len(of_senses)):
            share = shares[n, s]
            share.accepted_ns = of_senses[s].accepted_ns
            share.weight = of_senses[s].gain / total if total > 0.0 else 0.0
        if now.stamp_ns == NEVER:
            for i in range(3):
                p[i] = one.home[i, 3]
            so3.copy(one.home, R)
            for i in range(POSE):
                velocity[i] = 0.0
            so3.copy(one.home_covariance, found.covariance)
            found.state = LOST
        else:
            for i in range(3):
                p[i] = now.p[i]
            so3.copy(now.R, R)
            so3.copy(P[n, slot], ahead)
            for i in range(POSE):
                velocity[i], acceleration[i] = now.velocity[i], now.acceleration[i]
            dt = max(0.0, (stamp_ns - now.stamp_ns) * 1e-9)
            move(one, dt, p, R, velocity, acceleration, ahead, now.agility)
            fade(sense_models, dt, ahead)
            so3.copy(ahead, found.covariance)
            for i in range(POSE):
                found.covariance[i, i] += _calibration(sense_models, shares[n]) * UNITS[i] ** 2
            consider(sense_models, of_senses, ahead, found.covariance)
            if stamp_ns > now.accepted_ns:  # a guess; what is measured is believed
                within_reach(one, p, R)
            found.state = state_of((stamp_ns - now.accepted_ns) * 1e-9, found.covariance, one.limits)
            if found.state == TRACKING and (
                is_contested(one, State(now, of_senses, P[n, slot]), stamp_ns)
                or _is_denied(one, of_senses, denied_ns[n], stamp_ns)
            ):
                found.state = COASTING
        for i in range(3):
            for j in range(3):
                found.pose[i, j] = R[i, j]
            found.pose[i, 3], found.pose[3, i] = p[i], 0.0
        found.pose[3, 3] = 1.0
        for i in range(POSE):
            found.velocity[i] = velocity[i]
