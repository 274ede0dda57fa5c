"""The verdict on a fitted pose: tracking, occluded or lost, and why; and how probably it is right.

A pose is right if its position is within WRONG[0] and its axis within WRONG[1] of the truth, and the mask shows the target. Its
log odds are a weighted sum of what the fit found (logistic regression). `python -m penumbra.tests.bench.lib.verdicts` fits the
weights to simulated pictures with the network's masks: with right and wrong predictions, masks of something else, and targets
that are absent or hidden; `penumbra bench search` measures on others how true the probability is. All limbs there are the mesh:
for a limb of another shape the probability is too low, and its verdict does not depend on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from penumbra.services.search.settings import SearchSettings
from penumbra.shared.perception.vision import State

WRONG = (0.05, math.radians(20.0))
"""An error of the position [m] or of the limb's axis [rad] beyond which a pose is wrong."""
WEIGHTS = {
    "one": -9.12,
    "overlap": 4.32,
    "sharp": 1.68,
    "imageless": 0.88,
    "points": 0.73,
    "shown": 0.60,
    "sigma": -0.65,
    "surprise": -0.77,
    "expected_sigma": -1.11,
}
"""Weights of the log odds, by the names of `Findings.features`."""


class Verdict(Enum):
    """The cases. `state`: the published state; `reason`: the explanation."""

    RIGHT = "tracking", "mask, and image where the limb is the mesh and there is one, confirm the pose"
    COVERED = "occluded", "too little is visible, and most of the target is covered or outside the picture"
    TOO_LITTLE = "lost", "too little is visible, and nothing covers the rest"
    ELSEWHERE = "lost", "mask and silhouette overlap too little"
    UNCONFIRMED = "lost", "the image shows no edges along the contour"
    MISSHAPEN = "lost", "the mask's boundary is not the contour's"
    IMPROBABLE = "lost", "nothing refutes the pose, but all that was found together makes it improbable"

    def __init__(self, state: State, reason: str):
        self.state, self.reason = state, reason


@dataclass(frozen=True)
class Findings:
    """Properties by which a fitted pose is judged. overlap, misfit, is_sharp, shape, points: as of `mask_fit.Fit`; hidden: share
    of the silhouette in [0, 1] that the mask does not show; covered: share that is covered or outside the window; has_image:
    whether there was an image to confirm the pose; is_expected: whether a sure prediction agrees with the pose, and its shape, if
    not the mesh's, is not new; sigma: standard deviation of the position along its worst direction [m]; surprise: squared
    Mahalanobis distance from the prediction, which is the target's home if there is no other; expected_sigma: as sigma, of the
    prediction."""

    overlap: float
    misfit: float
    is_sharp: bool
    shape: float | None
    points: float
    hidden: float
    covered: float
    has_image: bool
    is_expected: bool
    sigma: float
    surprise: float
    expected_sigma: float

    @property
    def features(self) -> dict[str, float]:
        """What WEIGHTS weigh."""
        return {
            "one": 1.0,
            "overlap": self.overlap,
            "sharp": float(self.is_sharp),
            "imageless": float(not self.has_image),
            "points": math.log1p(self.points),
            "shown": math.log(max(1.0 - self.hidden, 0.01)),
            "sigma": math.log(self.sigma),
            "surprise": math.log1p(self.surprise),
            "expected_sigma": math.log(self.expected_sigma),
        }

    @property
    def confidence(self) -> float:
        """The probability that the pose is right."""
        features = self.features
        return 1.0 / (1.0 + math.exp(-sum(weight * features[name] for name, weight in WEIGHTS.items())))


def verdict(found: Findings, settings: SearchSettings) -> Verdict:
    """Judges a fitted pose. A small piece of a target is accepted only if a sure prediction expects it."""
    largest_hidden = settings.hidden if found.is_expected else settings.recognised
    least_points = settings.least_points if found.is_expected else settings.recognised_points
    if found.hidden > largest_hidden or found.points < least_points:
        return Verdict.COVERED if found.covered > settings.covers else Verdict.TOO_LITTLE
    if found.shape is not None:
        if found.overlap < settings.fits_shaped:
            return Verdict.ELSEWHERE
        return Verdict.RIGHT if found.shape < settings.other_shape[1] else Verdict.MISSHAPEN
    if found.overlap < least_overlap(found.is_expected and found.is_sharp, settings):
        return Verdict.ELSEWHERE
    if found.has_image and not found.is_sharp:
        return Verdict.UNCONFIRMED
    if not found.has_image and found.misfit >= settings.wrong_misfit:
        return Verdict.MISSHAPEN
    return Verdict.RIGHT if found.confidence >= settings.least_confidence else Verdict.IMPROBABLE


def least_overlap(is_confirmed: bool, settings: SearchSettings) -> float:
    """The minimum overlap of a right pose. is_confirmed: whether the image confirms the pose and a sure prediction expects it."""
    return settings.fits_expected if is_confirmed else settings.fits


def is_of_other_shape(overlap: float, shape: float | None, settings: SearchSettings) -> bool:
    """Whether a fit shows a limb that is not quite the mesh, and is right."""
    least, most = settings.other_shape
    return shape is not None and least < shape < most and overlap >= settings.fits_shaped


def explains_mask(overlap: float, misfit: float, settings: SearchSettings) -> bool:
    """Whether a pose explains the mask by itself, without an image or a prediction."""
    return overlap >= settings.fits and misfit < settings.wrong_misfit
