"""The verdict on a fitted pose: tracking, occluded or lost, and why."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from penumbra.services.search.settings import SearchSettings
from penumbra.shared.perception.vision import State


class Verdict(Enum):
    """The cases. `state`: the published state; `reason`: the explanation."""

    RIGHT = "tracking", "mask, and image where the limb is the mesh and there is one, confirm the pose"
    COVERED = "occluded", "too little is visible, and most of the target is covered or outside the picture"
    TOO_LITTLE = "lost", "too little is visible, and nothing covers the rest"
    ELSEWHERE = "lost", "mask and silhouette overlap too little"
    UNCONFIRMED = "lost", "the image shows no edges along the contour"
    MISSHAPEN = "lost", "the mask's boundary is not the contour's"

    def __init__(self, state: State, reason: str):
        self.state, self.reason = state, reason


@dataclass(frozen=True)
class Findings:
    """Properties by which a fitted pose is judged. overlap, misfit, is_sharp, shape, points: as of `mask_fit.Fit`; hidden: share
    of the silhouette in [0, 1] that the mask does not show; covered: share that is covered or outside the window; has_image:
    whether there was an image to confirm the pose; is_expected: whether a sure prediction agrees with the pose, and its shape, if
    not the mesh's, is not new."""

    overlap: float
    misfit: float
    is_sharp: bool
    shape: float | None
    points: float
    hidden: float
    covered: float
    has_image: bool
    is_expected: bool


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
    return Verdict.RIGHT


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
