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


UNLABELLED = 255
"""What masks to learn from hold where nobody knows the class: neither losses nor scores look there."""
