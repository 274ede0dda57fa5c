"""Table of all senses: the quantity that each measures, its topic, and the model of its errors.

Fusion knows nothing else about its senses. A new sense is a row here, a topic with its message, and the service that publishes
it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from penumbra.shared.contract import topics
from penumbra.shared.contract.topics import Topic


class Measures(Enum):
    """Kinds of measurement, by the fields of their messages. All messages also have `target` and `frame`."""

    POSE = ("position", "orientation", "covariance")
    """A pose with its covariance (6, 6)."""
    POSE_INFORMATION = ("position", "orientation", "information")
    """A pose with its information (6, 6), the inverse covariance, which is zero along directions that are not observed. It may
    also have a `step`: the pose error (6,) from the pose at which its likelihood was linearised to this pose."""
    POSITION = ("position", "covariance")
    """The position of the target's origin with its covariance (3, 3)."""


@dataclass(frozen=True)
class Errors:
    """Error model of one sense, beyond the content of its messages.

    lasting : share of the variance that is common to successive measurements. 0.75: chosen, not measured.
    time_constant : time constant [s] with which this common error decays. 1 s: chosen, not measured.
    floor : standard deviation of errors that its covariance does not contain (its calibration), in `records.UNITS` of fusion:
        0.006 is 0.6 mm and 0.34 degrees. These errors do not decay. Chosen, not measured.
    typical, sure : share of the variance in its messages that its errors have as a rule. It is `typical` in directions that are
        known well and one in those that are hardly known, halfway at a standard deviation of `sure`, in the same units. A filter
        that weighs by a variance which allows for rare large errors lags behind the limb. So it weighs by this share; the rest
        counts as a lasting error that the published pose may have (`fusion.history.consider`).
    gate : probabilities with which a good measurement passes the gate. The second applies while another sense is less
        surprising; the third applies in that case after a row of refusals (`FusionSettings.refusals`): a sense that was wrong is
        used again when it agrees, not when it is nearly plausible. All are keys of `chi_square.QUANTILES`.
    """

    lasting: float = 0.75
    time_constant: float = 1.0
    floor: float = 0.006
    typical: float = 1.0
    sure: float = 0.3
    gate: tuple[float, float, float] = (0.9999, 0.999, 0.9)


@dataclass(frozen=True)
class Sense:
    """One sense.

    name : as in `FusedPose.sources`, the health report and the log.
    topic : its messages, one stream for each target. `topic.publishers` are the services that may publish it.
    measures : kind of measurement in its messages.
    errors : error model that the filter assumes.
    usable : value of the message's `state` with which a measurement is used; with any other value the sense only counts as
        present. None for a message without a state.
    denies : value of `state` with which a sense says that it looks where the target is expected, and that the target is not
        there. None where it never says that.
    part : message field that names the part of the cell which measured ("camera"). Each part is a separate stream with one
        publisher at a time. None where a target has one stream.

    Raises TypeError for a topic that is not of a target, and for a message without these fields.
    """

    name: str
    topic: Topic
    measures: Measures
    errors: Errors = Errors()
    usable: str | None = None
    denies: str | None = None
    part: str | None = None

    def __post_init__(self) -> None:
        if "{target}" not in self.topic.key:
            raise TypeError(f"sense {self.name}: expected a topic with {{target}} in its key, got {self.topic.key}")
        known = set(self.topic.message.__struct_fields__)
        has_state = self.usable is not None or self.denies is not None
        wanted = {"target", "frame", *self.measures.value, *({"state"} if has_state else ()), *({self.part} - {None})}
        if missing := sorted(wanted - known):
            raise TypeError(
                f"sense {self.name}: expected the fields {', '.join(sorted(wanted))}, "
                f"got {self.topic.message.__name__} without {', '.join(missing)}"
            )


SENSES = (
    # Measured in replays of both cells: of the variance of a limb in full sight, errors have a quarter to a half. The other
    # values were chosen on replays of `arm`
    Sense(
        "vision",
        topics.VISION,
        Measures.POSE,
        Errors(lasting=0.5, time_constant=0.7, typical=0.4),
        usable="tracking",
        denies="lost",
        part="camera",
    ),
    # windows of the skin share no samples and the noise of its voltages is white. Measured on the emulator: a fifth of the
    # variance comes from the response model and is common to successive windows
    Sense("haptic", topics.HAPTIC, Measures.POSE_INFORMATION, Errors(lasting=0.2, time_constant=0.3), usable="in_range"),
)
