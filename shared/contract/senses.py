"""The one table of senses: what each measures, on which topic, and what is known of its errors.

Fusion knows nothing else of its senses. A new sense is a row here, a topic with its message, and the service that publishes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from penumbra.shared.contract import topics
from penumbra.shared.contract.topics import Topic


class Measures(Enum):
    """What a sense measures, by the fields of its message. All have `target` and `frame` too."""

    POSE = ("position", "orientation", "covariance")
    """A pose with its covariance (6, 6)."""
    POSE_INFORMATION = ("position", "orientation", "information")
    """A pose with its information (6, 6), the inverse covariance: zero along directions that are not observed. It may have a
    `step`, too: the pose error (6,) that leads to the pose from the one at which its likelihood was linearised."""
    POSITION = ("position", "covariance")
    """The position of the target's origin with its covariance (3, 3)."""


@dataclass(frozen=True)
class Errors:
    """What is known of the errors of one sense beside what its messages say.

    lasting : share of the variance that is the same from one measurement to the next. 0.75: chosen, not measured.
    time_constant : time constant [s] with which such an error decays. 1 s: chosen, not measured.
    floor : standard deviation of what its covariance does not contain, its calibration, in `records.UNITS` of fusion: 0.006 is
        0.6 mm and 0.34 degrees. All of it lasts. Chosen, not measured.
    gate : probabilities with which a good measurement passes the gate; the second, while another sense is less surprising; the
        third, while so and after a row of refusals (`FusionSettings.refusals`): a sense that was wrong is used again when it
        agrees, not when it is nearly plausible. All are shares in `chi_square.QUANTILES`.
    """

    lasting: float = 0.75
    time_constant: float = 1.0
    floor: float = 0.006
    gate: tuple[float, float, float] = (0.9999, 0.999, 0.9)


@dataclass(frozen=True)
class Sense:
    """One sense.

    name : as in `FusedPose.sources`, the health report and the log.
    topic : its messages, one stream for each target. `topic.publishers` are the services that may publish it.
    measures : what its messages contain.
    errors : what the filter assumes of its errors.
    usable : value of the message's `state` with which a measurement is used; with any other the sense is only known to be there.
        None for a message without a state.
    part : field of the message that names the part of the cell which measured ("camera"). Each part is a stream of its own, with
        one publisher at a time. None where a target has one stream.

    Raises TypeError for a topic that is not of a target, and for a message without these fields.
    """

    name: str
    topic: Topic
    measures: Measures
    errors: Errors = Errors()
    usable: str | None = None
    part: str | None = None

    def __post_init__(self) -> None:
        if "{target}" not in self.topic.key:
            raise TypeError(f"sense {self.name}: expected a topic with {{target}} in its key, got {self.topic.key}")
        known = set(self.topic.message.__struct_fields__)
        wanted = {"target", "frame", *self.measures.value, *({"state"} if self.usable else ()), *({self.part} - {None})}
        if missing := sorted(wanted - known):
            raise TypeError(
                f"sense {self.name}: expected the fields {', '.join(sorted(wanted))}, "
                f"got {self.topic.message.__name__} without {', '.join(missing)}"
            )


SENSES = (
    # a mask's bias lasts for as long as the limb rests
    Sense("vision", topics.VISION, Measures.POSE, Errors(lasting=0.75, time_constant=1.0), usable="tracking", part="camera"),
    # windows of the skin share no samples and the noise of its voltages is white: measured on the emulator, a fifth of the
    # variance is the response model's and lasts
    Sense("haptic", topics.HAPTIC, Measures.POSE_INFORMATION, Errors(lasting=0.2, time_constant=0.3), usable="in_range"),
)
