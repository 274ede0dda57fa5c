"""Records of the default observer, `filter.py` and `history.py`: settings, measurement, state, estimate.

The data of the senses are an array (n,) of records in the order of the table of senses, so that the compiled filter serves any
number of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

POSE, MOTION = 6, 18  # sizes of the pose, and of the pose with its velocity and acceleration, within the state
UNITS = (0.1, 0.1, 0.1, 1.0, 1.0, 1.0)
"""Units [m, rad] that make translations and rotations comparable: a turn by 1 rad moves the ends of a forearm by about 10 cm."""
GATES = 3
"""Number of gates of a sense, see `senses.Errors`."""
NEVER = -(1 << 62)
"""Stamp of an event that has not happened."""
NOBODY = -1
"""Row that stands for no sense."""


def size(senses: int) -> int:
    """Number of the state's errors: position, rotation, their velocities and accelerations, the bias of each sense, and the
    offset of the one that is wrong."""
    return MOTION + POSE * senses + POSE


MODEL = np.dtype(
    [
        *((name, "f8", 2) for name in ("jerk", "motion_time", "velocity_spread", "agility", "learning")),  # as in FusionSettings
        *((name, "f8") for name in ("damping", "doubt", "patience", "source_patience", "refusals")),
        *((name, "f8") for name in ("unobserved", "agreement_time", "horizon", "weight_time", "lost_age")),
        *((name, "f8", 2) for name in ("offset_spread", "offset_drift", "denial")),
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
        *((name, "f8") for name in ("lasting", "time_constant", "floor", "typical", "sure")),  # as in `senses.Errors`
        ("threshold", "f8", (GATES, POSE + 1)),  # maximum squared Mahalanobis distances of its `gate`, by rank
    ]
)
"""The settings of one sense."""

MEASUREMENT = np.dtype(
    [
        ("stamp_ns", "i8"),
        ("source", "i8"),  # row of the table of senses
        ("rank", "i8"),  # k, the number of directions that it observes; the fields below have k rows in use
        ("p", "f8", 3),
        ("R", "f8", (3, 3)),
        ("directions", "f8", (POSE, POSE)),  # unit vectors (k, 6), in UNITS
        ("basis", "f8", (POSE, POSE)),  # (k, 6): `basis @ error` has independent entries ...
        ("sigma", "f8", POSE),  # ... with these standard deviations (k,)
        ("rest", "f8", POSE),  # the stated variances less these typical ones (k,): of lasting errors that are not estimated
        ("ahead", "f8", POSE),  # `basis @` the pose error from p, R to the peak of its likelihood (k,)
        ("has_axis", "i8"),  # whether the rotation about `axis` is not observed (a limb's, if its roll is not seen)
        ("axis", "f8", 3),
        ("slides", "i8"),  # whether a translation is not observed (along a limb, if neither of its ends is seen)
    ]
)
"""One pose of one sense, reduced to the directions that it observes."""

STATE = np.dtype(
    [
        ("stamp_ns", "i8"),  # NEVER: nothing is known yet
        ("accepted_ns", "i8"),  # stamp of the last accepted measurement of any sense
        ("passed", "i8"),  # whether the last measurement was accepted
        ("distance", "f8"),  # its squared Mahalanobis distance and the number of its directions: 0 if it started the state
        ("rank", "i8"),
        ("p", "f8", 3),
        ("R", "f8", (3, 3)),
        ("velocity", "f8", POSE),
        ("acceleration", "f8", POSE),
        ("agility", "f8", 2),  # learned factors on the process noise, linear and angular
        ("fast_ns", "i8", 2),  # stamps at which the limb last moved and turned fast, or was not expected to
        ("wrong", "i8"),  # row of the sense that counts as wrong by an offset, or NOBODY
        ("wander", "f8", 2),  # learned factors on the variance of the offset's random walk, in position and rotation
        ("offset", "f8", POSE),  # of that sense, in units of its prior standard deviation
    ]
)
"""The filter after one measurement, without the covariance (size, size) of all errors, which is a separate array."""

SENSE_STATE = np.dtype(
    [
        ("measured_ns", "i8"),  # stamp of the last measurement
        ("surprise", "f8"),  # its squared Mahalanobis distance per direction
        ("rank", "i8"),  # and the directions that it observed, with their standard deviations, as in a MEASUREMENT
        ("directions", "f8", (POSE, POSE)),
        ("sigma", "f8", POSE),
        ("rest", "f8", POSE),
        ("residual", "f8", POSE),  # how far it is from the state along them, in UNITS
        ("learned_ns", "i8"),  # stamp of the last measurement to which agility and doubt were adapted
        ("accepted_ns", "i8"),  # stamp of the last accepted measurement
        ("refused", "i8"),  # number of measurements refused since
        ("refused_ns", "i8"),  # stamp of the first of them
        ("contradicted", "i8"),  # whether another sense contradicted the last of them
        ("unsteady", "i8"),  # whether their offset is not constant
        # information [nats] that it contributed, with decay: decrease of the logarithm of the volume of the pose's uncertainty.
        # Only what is new counts: the hundredth measurement with the same error contributes almost nothing
        ("gain", "f8"),
        ("doubt", "f8"),  # learned factor on its covariance
        ("has_innovation", "i8"),
        ("innovation", "f8", POSE),  # the last one, in units of its standard deviation
        ("bias", "f8", POSE),
    ]
)
"""The filter's state of one sense after a measurement of any sense."""

ESTIMATE = np.dtype(
    [
        ("pose", "f8", (4, 4)),
        ("velocity", "f8", POSE),
        ("covariance", "f8", (POSE, POSE)),
        ("state", "i8"),  # which of STATES
    ]
)
"""The estimate of one target: `estimate.Estimate` as arrays."""

SENSE_ESTIMATE = np.dtype([("accepted_ns", "i8"), ("weight", "f8")])
"""The estimate of one sense; its stamp is that of its last accepted measurement, NEVER if there is none."""


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
        """The histories of some of the targets, as views."""
        measurements, states, senses, P, rings = self
        return History(measurements[targets], states[targets], senses[targets], P[targets], rings[targets])
