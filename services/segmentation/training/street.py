"""Street photographs with labelled people, as frames and masks for training.

The photographs and the class of every pixel (skin, kinds of clothes, bags) come from Clothing Co-Parsing (Yang, Luo, Lin 2014,
doi:10.1109/CVPR.2014.407; github.com/bearpaw/clothing-co-parsing, Apache-2.0; the photographers' rights are not cleared, so
neither pictures nor masks are kept here). Landmarks of a pose model locate the arms (`penumbra segmentation models`). Skin and
sleeves near a forearm are labelled forearm, beyond the wrist hand; undecidable pixels are UNLABELLED, as is a band along the
target's coarse contours.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import scipy.io
from numpy.typing import NDArray
from rich.progress import track

from penumbra.shared.contract.labels import TARGET_LABELS, UNLABELLED, Label
from penumbra.shared.perception.landmarks import Landmarks, Pose

PATHS = "photos", "annotations/pixel-level", "label_list.mat"
"""Paths used of the dataset's repository."""
SLEEVED = (
    "blazer",
    "blouse",
    "bodysuit",
    "cape",
    "cardigan",
    "coat",
    "dress",
    "hoodie",
    "jacket",
    "jumper",
    "romper",
    "shirt",
    "suit",
    "sweater",
    "sweatshirt",
    "t-shirt",
    "top",
)
"""Clothes that may cover an arm."""
WORN = ("accessories", "bracelet", "ring", "watch")
"""Objects that count as part of the arm on which they are worn."""
BAGS = ("bag", "purse", "wallet")
SURE = 0.6
"""Minimum visibility of elbow and wrist with which an arm is used."""
RADII = {Label.UPPER_ARM: 0.19, Label.FOREARM: 0.16, Label.HAND: 0.2}
"""Radii of an arm's parts, as shares of the forearm's length."""
HAND = 0.75
"""Length of the hand as a share of the forearm's."""
BAND_PX = 2
"""Half the width [px] of the band along the target's contours that is not used for training."""


@dataclass(frozen=True)
class Arm:
    """Ends (2, 2) [px] of the parts of an arm, the forearm's length [px], and whether elbow and wrist are clearly visible."""

    parts: dict[Label, NDArray[np.float64]]
    length: float
    is_sure: bool

    @classmethod
    def of(cls, pose: Pose, first: int) -> Arm:
        """The left arm (landmarks from 11) or the right one (from 12): shoulder, elbow, wrist, little and index finger."""
        shoulder, elbow, wrist, little, index = pose.points[[first, first + 2, first + 4, first + 6, first + 8]]
        length = max(float(np.linalg.norm(wrist - elbow)), 0.7 * float(np.linalg.norm(elbow - shoulder)), 1.0)
        ahead = (little + index) / 2.0 - wrist
        tip = wrist + ahead / max(float(np.linalg.norm(ahead)), 1e-6) * HAND * length
        ends = {Label.UPPER_ARM: (shoulder, elbow), Label.FOREARM: (elbow, wrist), Label.HAND: (wrist, tip)}
        is_sure = bool(pose.visible[[first + 2, first + 4]].min() > SURE)
        return cls({label: np.array(two) for label, two in ends.items()}, length, is_sure)


def masks(parts: NDArray[np.uint8], names: list[str], pose: Pose) -> NDArray[np.uint8]:
    """Classes (h, w) from the dataset's classes (h, w) with these names, and the person's landmarks."""

    def named(*wanted: str) -> NDArray[np.bool_]:
        return np.isin(parts, [names.index(name) for name in wanted])

    height, width = parts.shape
    skin, sleeved, nothing = named("skin"), named(*SLEEVED), named("null")
    arms = [Arm.of(pose, first) for first in (11, 12)]
    length = max(arm.length for arm in arms)
    # how far [forearm lengths] each pixel lies outside each part of the nearer arm
    outside = {
        label: np.min([_distance(arm.parts[label], height, width) / arm.length for arm in arms], axis=0) - radius
        for label, radius in RADII.items()
    }
    kinds = list(outside)
    every = np.stack([outside[label] for label in kinds])
    nearest = np.array(kinds, np.uint8)[every.argmin(0)]
    near = every.min(0)
    target_near = np.minimum(outside[Label.FOREARM], outside[Label.HAND])
    points = pose.points
    shoulders = points[11:13].mean(0)
    other = [(points[0], points[0], 0.45), (points[0], shoulders, 0.3)]  # head and neck
    other += [(points[a], points[b], 0.25) for a, b in ((23, 25), (25, 27), (24, 26), (26, 28))]  # legs
    rest = np.min([_distance(np.array([a, b]), height, width) / length - radius for a, b, radius in other], axis=0)

    labels = np.full(parts.shape, Label.TORSO, np.uint8)  # also the rest of the person
    labels[nothing] = Label.BACKGROUND
    labels[nothing & (outside[Label.HAND] < -0.05)] = UNLABELLED  # held objects have no class there
    on_arm = near < rest
    labels[skin & on_arm] = nearest[skin & on_arm]
    labels[skin & ((np.abs(near - rest) < 0.1) | (on_arm & (near > 0.3)))] = UNLABELLED
    core = target_near < -0.08
    bare = (core & skin).sum() > (core & sleeved).sum()
    if bare:  # clothes under the arm, or its short sleeve
        labels[sleeved & (outside[Label.FOREARM] < -0.05)] = UNLABELLED
        labels[sleeved & (outside[Label.UPPER_ARM] < 0.0)] = Label.UPPER_ARM
    else:
        limb = sleeved & (near < -0.03)
        labels[limb] = np.where(nearest == Label.HAND, np.uint8(UNLABELLED), nearest)[limb]  # cuff, or a coat behind a hand
        labels[sleeved & (np.abs(near - 0.05) <= 0.08)] = UNLABELLED
    labels[named("gloves")] = Label.HAND
    worn = named(*WORN)
    labels[worn] = np.where(near < 0.1, nearest, UNLABELLED)[worn]
    bags = named(*BAGS)
    labels[bags] = np.where(target_near < 0.4, np.uint8(Label.OCCLUDER), np.uint8(UNLABELLED))[bags]
    lower = ~(skin | sleeved | nothing | worn | bags | named("gloves", "hair", "hat", "scarf"))
    labels[lower & (outside[Label.HAND] < -0.05)] = UNLABELLED  # a hand in a pocket
    for arm in arms:
        if not arm.is_sure:
            about = np.min([_distance(ends, height, width) for ends in arm.parts.values()], axis=0)
            labels[(about < 0.5 * arm.length) & ~nothing] = UNLABELLED
    target = np.isin(labels, TARGET_LABELS).astype(np.uint8)
    square = np.ones((2 * BAND_PX + 1, 2 * BAND_PX + 1), np.uint8)
    labels[cv2.dilate(target, square) != cv2.erode(target, square)] = UNLABELLED
    return labels


def _distance(ends: NDArray[np.float64], height: int, width: int) -> NDArray[np.float32]:
    """Distance [px] of every pixel (h, w) from the line between two ends (2, 2)."""
    along = ends[1] - ends[0]
    y, x = np.mgrid[:height, :width].astype(np.float32) - ends[0, ::-1, None, None].astype(np.float32)
    t = np.clip((x * along[0] + y * along[1]) / max(float(along @ along), 1e-6), 0.0, 1.0)
    return np.hypot(x - t * along[0], y - t * along[1]).astype(np.float32)


def write(source: Path, find: Landmarks, out: Path) -> int:
    """Write images/ and masks/ of the photographs in a copy of Clothing Co-Parsing in which the models find a person with a
    clearly visible arm; returns their number. Raises FileNotFoundError if there are no labels."""
    annotated = sorted((source / "annotations" / "pixel-level").glob("*.mat"))
    if not annotated:
        raise FileNotFoundError(f"{source / 'annotations' / 'pixel-level'}: expected a .mat file for each photograph, found none")
    names = [str(name[0]) for name in scipy.io.loadmat(source / "label_list.mat")["label_list"][0]]
    for folder in ("images", "masks"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    written = 0
    for path in track(annotated, "photographs"):
        parts = scipy.io.loadmat(path)["groundtruth"].astype(np.uint8)
        photograph = source / "photos" / f"{path.stem}.jpg"
        image = cv2.imread(str(photograph), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None or image.shape[:2] != parts.shape or not parts.any():
            continue
        pose = find.pose_of(np.ascontiguousarray(image[..., ::-1]), parts > 0)
        if pose.found < 0.8 or not any(Arm.of(pose, first).is_sure for first in (11, 12)):
            continue
        shutil.copyfile(photograph, out / "images" / photograph.name)
        cv2.imwrite(str(out / "masks" / f"{path.stem}.png"), masks(parts, names, pose))
        written += 1
    return written
