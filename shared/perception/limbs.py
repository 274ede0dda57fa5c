"""Arms in a picture: hands and the elbows that belong to them, from the landmark models (`landmarks.py`)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.perception.landmarks import FOUND, PALM, Hand, Landmarks, Points, Pose, Region

HANDS = 1.0
"""Maximum distance, in sizes of the hand (wrist to knuckles), between a body's wrist landmark and a hand's wrist for the two to
match."""
FOREARM = 2.7
"""Length of a forearm seen from the side, in sizes of the hand (ANSUR II: 0.25 m and 0.09 m)."""
KNUCKLES = (5, 9, 13, 17)
"""Landmarks of the knuckles, from index to little finger."""


@dataclass(frozen=True)
class Limb:
    """A hand with its arm: points (21, 2) of the hand, elbow and shoulder (2,) where they are known [px]. is_seen: false for a
    hand that is not visible but must be there."""

    points: Points
    elbow: Points | None = None
    shoulder: Points | None = None
    is_seen: bool = True

    @property
    def size(self) -> float:
        """Size of the hand, as `Hand.size` [px]."""
        return Hand(self.points, 1.0, 0.5).size

    @property
    def middle(self) -> Points:
        """Middle of the palm (2,) [px]."""
        return np.asarray(self.points[list(PALM)].mean(0))

    @property
    def back(self) -> Points:
        """The direction (2,) from the knuckles to the wrist."""
        way = self.points[0] - self.points[list(KNUCKLES)].mean(0)
        return np.asarray(way / max(float(np.linalg.norm(way)), 1e-6))

    def scaled(self, factor: float) -> Limb:
        """The limb in a picture enlarged by a factor. Pixel centres are at integer coordinates."""
        elbow, shoulder = (None if p is None else (p + 0.5) * factor - 0.5 for p in (self.elbow, self.shoulder))
        return replace(self, points=(self.points + 0.5) * factor - 0.5, elbow=elbow, shoulder=shoulder)


def find(
    models: Landmarks, image: NDArray[np.uint8], before: Iterable[Hand], pose: Pose | None
) -> tuple[list[Hand], Pose | None]:
    """Finds hands and body in an image (h, w, 3) RGB, given those of the previous image.

    The body is detected by its head. Cells seldom show a head, so otherwise it is assumed where a person behind a table would be.
    Such a pose is kept only while it agrees with a hand.
    """
    height, width = image.shape[:2]
    short, long = min(height, width), max(height, width)
    count = 3 if long > 1.2 * short else 1
    ends = np.array([[short, short], [2 * width - short, 2 * height - short]]) / 2.0
    tiles = [Region(ends[0] + t * (ends[1] - ends[0]), float(short)) for t in np.linspace(0.0, 1.0, count)]
    hands = models.hands(image, before, tiles if count > 1 else ())
    found = models.pose(image, pose)
    if found is None and hands:
        for down in (0.5, 0.8):
            begin = models.pose_in(image, Region(np.array([0.5 * width, down * height]), 1.6 * long))
            guess = models.pose_in(image, begin.region)
            if guess.found > FOUND and any(limb_of(hand, guess).elbow is not None for hand in hands):
                return hands, guess
    return hands, found


def limb_of(hand: Hand, pose: Pose | None) -> Limb:
    """A hand with the elbow of the arm whose wrist matches the hand's. The model invents arms for bodies that are not visible, so
    the elbow is accepted only if it lies opposite the knuckles, at a forearm's distance."""
    limb, nearest = Limb(hand.points), HANDS * hand.size
    if pose is None:
        return limb
    alone = limb
    for first in (11, 12):
        shoulder, elbow, wrist = pose.points[[first, first + 2, first + 4]]
        away = float(np.linalg.norm(wrist - hand.points[0]))
        length = float(np.linalg.norm(elbow - hand.points[0]))
        opposite = (elbow - hand.points[0]) @ alone.back > 0.3 * length
        if pose.visible[first + 2] > 0.5 and away < nearest and opposite and 0.8 < length / hand.size < 1.5 * FOREARM:
            limb, nearest = Limb(hand.points, elbow, shoulder if pose.visible[first] > 0.5 else None), away
    return limb
