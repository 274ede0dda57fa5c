"""What a pixel may show: the class indices of every mask (the authors' classes, and what else may stand in the way)."""

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
"""The classes of a forearm with its hand. Networks are trained for them, and their logits calibrated for them; at run time the
classes of a target are those of the cell file (`labels`)."""
COLOURS: dict[Label, tuple[int, int, int]] = {
    Label.ROBOT: (90, 120, 200),
    Label.TORSO: (150, 110, 170),
    Label.UPPER_ARM: (230, 170, 60),
    Label.FOREARM: (60, 190, 90),
    Label.HAND: (20, 230, 200),
    Label.OCCLUDER: (200, 60, 60),
}
"""The colour [RGB, of 255] of each class where a mask is shown over its picture; the background stays as it is."""
UNLABELLED = 255
"""Value in the masks of training data where the class is not known: losses and scores leave it out."""
