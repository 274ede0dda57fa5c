"""The records that the default observer's filter, `kernel.py`, works on: settings, a measurement, a state, an estimate."""

from __future__ import annotations

import numpy as np

from services.fusion.estimate import SOURCES

POSE, MOTION = 6, 12  # sizes of the pose, and of the pose with its velocities, within the state
UNITS = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])
"""Units [m, rad] in which translations and rotations compare: a turn by 1 rad moves the ends of a forearm by about 10 cm."""
SENSES = len(SOURCES)
SIZE = MOTION + POSE * SENSES
NEVER = -(1 << 62)
"""The stamp of what has not happened."""

MODEL = np.dtype(
    [
        *((name, "f8", SENSES) for name in ("lasting", "time_constant", "floor")),  # as in Sense
        *((name, "f8", 2) for name in ("acceleration", "velocity_spread", "agility", "learning")),  # as in Settings
        *((name, "f8") for name in ("velocity_time", "doubt", "patience", "source_patience", "refusals", "unobserved")),
        ("witness", "f8"),
        *((name, "f8") for name in ("horizon", "weight_time", "lost_age")),
        ("limits", "f8", 4),  # as in Limits
        ("threshold", "f8", (2, POSE + 1)),  # squared Mahalanobis distances that `gate` lets pass, by rank
        ("home", "f8", (4, 4)),
        ("home_covariance", "f8", (POSE, POSE)),
    ]
)
"""The settings, with the home of one target, as compiled code reads them."""

MEASUREMENT = np.dtype(
    [
        ("stamp_ns", "i8"),
        ("source", "i8"),  # which of SOURCES
        ("rank", "i8"),  # k, how many directions it observes; what follows has k rows in use
        ("p", "f8", 3),
        ("R", "f8", (3, 3)),
        ("directions", "f8", (POSE, POSE)),  # unit vectors (k, 6), in UNITS
        ("basis", "f8", (POSE, POSE)),  # (k, 6): `basis @ error` has independent entries ...
        ("sigma", "f8", POSE),  # ... with these standard deviations (k,)
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
        ("bias", "f8", SIZE - MOTION),
        ("P", "f8", (SIZE, SIZE)),  # covariance of the errors of position, rotation, velocities, and the bias of each sense
        ("agility", "f8", 2),  # learned factors on the process noise, linear and angular
        # by sense
        ("came_ns", "i8", SENSES),  # stamp of the last measurement
        ("surprise", "f8", SENSES),  # its squared Mahalanobis distance a direction
        ("heard_ns", "i8", SENSES),  # stamp of the last measurement that taught something
        ("believed_ns", "i8", SENSES),  # and of the last accepted one
        ("refused", "i8", SENSES),  # how many were refused since
        ("refused_ns", "i8", SENSES),  # stamp of the first of them
        # information that it brought [nats], fading: by how much it made the logarithm of the volume of the pose's uncertainty
        # smaller. It counts what was new: the hundredth measurement with the same error brings next to nothing
        ("gain", "f8", SENSES),
        ("doubt", "f8", SENSES),  # learned factor on its covariance
        ("has_innovation", "i8", SENSES),
        ("innovation", "f8", (SENSES, POSE)),  # the last one, in units of its standard deviation
    ]
)
"""The filter after one measurement."""

ESTIMATE = np.dtype(
    [
        ("T", "f8", (4, 4)),
        ("velocity", "f8", POSE),
        ("covariance", "f8", (POSE, POSE)),
        ("state", "i8"),  # which of STATES
        ("believed_ns", "i8", SENSES),  # stamp of the last accepted measurement of each sense, NEVER where there is none
        ("weight", "f8", SENSES),
    ]
)
"""What is answered for one target: `estimate.Estimate` in arrays."""
