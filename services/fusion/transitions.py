"""The filter's steps for the smoother, compiled: all steps of a run, the motion between two states, and the residual of a
measurement at a state.

They are the filter's own (`filter.step`, `filter.predict`, `filter.linearised`), so that smoother and filter have the same model.
"""

from __future__ import annotations

import numpy as np

from penumbra.services.fusion.filter import Model, State, forget, linearised, predict, step, transition
from penumbra.services.fusion.records import MEASUREMENT, MODEL, SENSE_MODEL, SENSE_STATE, STATE
from penumbra.shared.geometry import so3
from penumbra.shared.native import kernel


@kernel(
    "MODEL[1], SENSE_MODEL[n], MEASUREMENT[t], f8[t, 2], out STATE[k], out SENSE_STATE[k, n], out f8[w, size, size], "
    "out f8[size, 6]",
    MODEL=MODEL,
    SENSE_MODEL=SENSE_MODEL,
    MEASUREMENT=MEASUREMENT,
    STATE=STATE,
    SENSE_STATE=SENSE_STATE,
)
def run(models, sense_models, measurements, agility, states, senses, P, PHt):  # type: ignore[no-untyped-def]
    """The filter over measurements (t,) in the order of their stamps: the state before the first one, without any information,
    and those after each of them, (t + 1,) in all. P: the covariances of as many of the last states as there is room for, at least
    two, in turn. agility (t, 2): factors on the process noise of the motion to each measurement, which the state before it then
    has; zero: those that the filter learns."""
    model = Model(models[0], sense_models)
    forget(State(states[0], senses[0], P[0]))
    for i in range(len(measurements)):
        for half in range(2):
            if agility[i, half] > 0.0:
                states[i].agility[half] = agility[i, half]
        states[i + 1] = states[i]
        for s in range(senses.shape[1]):
            senses[i + 1, s] = senses[i, s]
        slot = (i + 1) % len(P)
        so3.copy(P[i % len(P)], P[slot])
        step(model, State(states[i + 1], senses[i + 1], P[slot]), measurements[i], PHt)


@kernel(
    "MODEL[1], SENSE_MODEL[n], STATE[t], SENSE_STATE[t, n], i8[t], out STATE[t], out SENSE_STATE[t, n], out f8[t, size, size], "
    "out f8[t, size, size]",
    MODEL=MODEL,
    SENSE_MODEL=SENSE_MODEL,
    STATE=STATE,
    SENSE_STATE=SENSE_STATE,
)
def transit(models, sense_models, states, senses, stamps_ns, later, later_senses, F, Q):  # type: ignore[no-untyped-def]
    """Each state at a later stamp, with the derivative F of its errors by those before, and the process noise Q: a covariance P
    becomes F P F' + Q."""
    for i in range(len(states)):
        model = Model(models[0], sense_models)
        later[i] = states[i]
        for s in range(senses.shape[1]):
            later_senses[i, s] = senses[i, s]
        for j in range(Q.shape[1]):
            for k in range(Q.shape[2]):
                Q[i, j, k] = 0.0
        transition(model, states[i], stamps_ns[i], F[i])
        predict(model, State(later[i], later_senses[i], Q[i]), stamps_ns[i])


@kernel(
    "MODEL[1], SENSE_MODEL[n], MEASUREMENT[t], STATE[t], SENSE_STATE[t, n], out f8[t, 6], out f8[t, 6, 12], out f8[t, 6]",
    MODEL=MODEL,
    SENSE_MODEL=SENSE_MODEL,
    MEASUREMENT=MEASUREMENT,
    STATE=STATE,
    SENSE_STATE=SENSE_STATE,
)
def linearise(models, sense_models, measurements, states, senses, z, H, white):  # type: ignore[no-untyped-def]
    """What is left of each measurement at the state of its stamp, z (6,), its derivative H (6, 12) by the pose and the bias of
    its sense, and the variances (6,) of its white noise. Directions that it does not observe have zeros and a variance of one."""
    unused = np.empty((0, 0))
    for i in range(len(states)):
        model, m = Model(models[0], sense_models), measurements[i]
        for j in range(6):
            z[i, j], white[i, j] = 0.0, 1.0
            for k in range(12):
                H[i, j, k] = 0.0
        linearised(model, State(states[i], senses[i], unused), m, z[i], H[i])
        for j in range(m.rank):
            white[i, j] = senses[i, m.source].doubt * (1.0 - model.senses[m.source].lasting) * m.sigma[j] ** 2
