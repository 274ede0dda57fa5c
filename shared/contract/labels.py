"""Class indices of the pixels of every mask: the authors' classes, and occluders."""

from __future__ import annotations

from enum import IntEnum


class Label(IntEnum):
    BACKGROUND = 0
    ROBOT = 1
    TORSO = 2
    UPPER_ARM = 3
    FOREARM = 4
    HAND = 5
    OCCLUDER = 6


TARGET_LABELS = (Label.FOREARM, Label.HAND)
"""Classes of a forearm with its hand, for which networks are trained and their logits calibrated. At run time the classes of a
target come from the cell file (`labels`)."""
COLOURS: dict[Label, tuple[int, int, int]] = {
    Label.ROBOT: (90, 120, 200),
    Label.TORSO: (150, 110, 170),
    Label.UPPER_ARM: (230, 170, 60),
    Label.FOREARM: (60, 190, 90),
    Label.HAND: (20, 230, 200),
    Label.OCCLUDER: (200, 60, 60),
}
"""Overlay colour (R, G, B, 0 to 255) of each class; the background is not coloured."""
UNLABELLED = 255
"""Value in the masks of training data for pixels of unknown class. Losses and scores ignore these pixels."""
