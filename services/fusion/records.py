"""The records that the default observer, `filter.py` and `history.py`, works on: settings, a measurement, a state, an estimate.

What there is of every sense is a record in an array (n,) of its own, in the order of the table of senses, so that the compiled
filter serves any number of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

POSE, MOTION = 6, 18  # sizes of the pose, and of the pose with its velocity and acceleration, within the state
UNITS = (0.1, 0.1, 0.1, 1.0, 1.0, 1.0)
"""Units [m, rad] in which translations and rotations compare: a turn by 1 rad moves the ends of a forearm by about 10 cm."""
GATES = 3
"""How many gates a sense has: see `senses.Errors`."""
NEVER = -(1 << 62)
"""The stamp of what has not happened."""
NOBODY = -1
"""The row of no sense."""


def size(senses: int) -> int:
    """Number of the state's errors: position, rotation, their velocities and accelerations, the bias of each sense, and the
    offset of the one that is wrong."""
    return MOTION + POSE * senses + POSE


MODEL = np.dtype(
    [
        *((name, "f8", 2) for name in ("jerk", "motion_time", "velocity_spread", "agility", "learning")),  # as in FusionSettings
        *((name, "f8") for name in ("damping", "doubt", "patience", "source_patience", "refusals")),
        *((name, "f8") for name in ("unobserved", "agreement_time", "horizon", "weight_time", "lost_age")),
        *((name, "f8", 2) for name in ("offset_spread", "offset_drift")),
        *((name, "f8") for name in ("offset_trial", "offset_wander", "offset_learning")),
        ("limits", "f8", 4),  # as in Limits
        ("shoulder", "f8", 3),  # as in Arm
        ("upper_arm", "f8"),
        ("elbow", "f8"),
        ("home", "f8", (4, 4)),
        ("home_covariance", "f8", (POSE, POSE)),
    ]
)
"""The settings, with the home of one target, as compiled code reads them."""

SENSE_MODEL = np.dtype(
    [
        *((name, "f8") for name in ("lasting", "time_constant", "floor")),  # as in `senses.Errors`
        ("threshold", "f8", (GATES, POSE + 1)),  # squared Mahalanobis distances that its `gate` lets pass, by rank
    ]
)
"""The same of one sense."""

MEASUREMENT = np.dtype(
    [
        ("stamp_ns", "i8"),
        ("source", "i8"),  # row of the table of senses
        ("rank", "i8"),  # k, how many directions it observes; what follows has k rows in use
        ("p", "f8", 3),
        ("R", "f8", (3, 3)),
        ("directions", "f8", (POSE, POSE)),  # unit vectors (k, 6), in UNITS
        ("basis", "f8", (POSE, POSE)),  # (k, 6): `basis @ error` has independent entries ...
        ("sigma", "f8", POSE),  # ... with these standard deviations (k,)
        ("ahead", "f8", POSE),  # `basis @` the pose error from p, R to where its likelihood peaks (k,)
        ("has_axis", "i8"),  # whether the rotation about `axis` is not observed (a limb's, where its roll is not seen)
        ("axis", "f8", 3),
        ("slides", "i8"),  # whether a translation is not observed (along a limb, where neither of its ends is seen)
    ]
)
"""One pose of one sense, reduced to the directions that it observes."""

STATE = np.dtype(
    [
        ("stamp_ns", "i8"),  # NEVER: nothing is known yet
        ("accepted_ns", "i8"),  # stamp of the last accepted measurement of any sense
        ("passed", "i8"),  # whether the last measurement was accepted
        ("distance", "f8"),  # its squared Mahalanobis distance, and how many directions that has: 0 where it began the state
        ("rank", "i8"),
        ("p", "f8", 3),
        ("R", "f8", (3, 3)),
        ("velocity", "f8", POSE),
        ("acceleration", "f8", POSE),
        ("agility", "f8", 2),  # learned factors on the process noise, linear and angular
        ("wrong", "i8"),  # row of the sense that is taken for wrong by an offset; NOBODY
        ("wander", "f8", 2),  # learned factors on the variance of the offset's random walk, in position and rotation
        ("offset", "f8", POSE),  # by which it is, in units of its standard deviation beforehand
    ]
)
"""The filter after one measurement, without the covariance (size, size) of all errors, which is an array of its own."""

SENSE_STATE = np.dtype(
    [
        ("measured_ns", "i8"),  # stamp of the last measurement
        ("surprise", "f8"),  # its squared Mahalanobis distance per direction
        ("rank", "i8"),  # and the directions that it observed: as of a MEASUREMENT
        ("directions", "f8", (POSE, POSE)),
        ("learned_ns", "i8"),  # stamp of the last measurement that agility and doubt were adapted to
        ("accepted_ns", "i8"),  # and of the last accepted one
        ("refused", "i8"),  # how many were refused since
        ("refused_ns", "i8"),  # stamp of the first of them
        ("unsteady", "i8"),  # whether they are off by no offset that stays
        # information that it brought [nats], fading: by how much it made the logarithm of the volume of the pose's uncertainty
        # smaller. It counts what was new: the hundredth measurement with the same error brings next to nothing
        ("gain", "f8"),
        ("doubt", "f8"),  # learned factor on its covariance
        ("has_innovation", "i8"),
        ("innovation", "f8", POSE),  # the last one, in units of its standard deviation
        ("bias", "f8", POSE),
    ]
)
"""What the filter knows of one sense after a measurement of any."""

ESTIMATE = np.dtype(
    [
        ("pose", "f8", (4, 4)),
        ("velocity", "f8", POSE),
        ("covariance", "f8", (POSE, POSE)),
        ("state", "i8"),  # which of STATES
    ]
)
"""What is answered for one target: `estimate.Estimate` in arrays."""

SENSE_ESTIMATE = np.dtype([("accepted_ns", "i8"), ("weight", "f8")])
"""The same of one sense; its stamp is that of its last accepted measurement, NEVER where there is none."""


class History(NamedTuple):
    """The histories of targets (t,), each a ring of c entries, with n senses; see `history.py`.

    measurements (t, c) : MEASUREMENT. states (t, c) : STATE. senses (t, c, n) : SENSE_STATE. P (t, c, size, size) : covariances
    of the errors of position, rotation, their velocities and accelerations, the bias of each sense, and the offset of a wrong
    one. rings (t, 2) : see `history.py`.
    """

    measurements: NDArray[np.void]
    states: NDArray[np.void]
    senses: NDArray[np.void]
    P: NDArray[np.float64]
    rings: NDArray[np.int64]

    @classmethod
    def empty(cls, targets: int, capacity: int, senses: int) -> History:
        """Memory for histories, not yet cleared."""
        n, shape = size(senses), (targets, capacity)
        return cls(
            np.zeros(shape, MEASUREMENT),
            np.zeros(shape, STATE),
            np.zeros((*shape, senses), SENSE_STATE),
            np.zeros((*shape, n, n)),
            np.zeros((targets, 2), np.int64),
        )

    def of(self, targets: slice) -> History:
        """The histories of some of the targets, without a copy."""
        measurements, states, senses, P, rings = self
        return History(measurements[targets], states[targets], senses[targets], P[targets], rings[targets])
