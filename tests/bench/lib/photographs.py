"""Masks of still photographs beside masks that were drawn by hand, each through the window that the service would use."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from penumbra.services.segmentation import files, inference
from penumbra.services.segmentation.training.recordings import Frame
from penumbra.shared.contract.labels import TARGET_LABELS, UNLABELLED, Label
from penumbra.shared.perception.lookout import ARM_M, MARGIN_M, Window, whole_frame, window_of
from penumbra.tests.bench.lib.results import Part, Result, marked

GOAL = 0.75


def window_about(target: NDArray[np.bool_]) -> Window:
    """The window that the service would choose around an arm with these pixels (h, w)."""
    height, width = target.shape
    rows, columns = np.flatnonzero(target.any(1)), np.flatnonzero(target.any(0))
    padded = np.pad(target.astype(np.uint8), 1)  # beyond the picture there is no arm
    arm_px = 2.0 * float(cv2.distanceTransform(padded, cv2.DIST_L2, 5).max())
    margin = MARGIN_M * arm_px / ARM_M  # the depth is known only from the arm's width
    picture = Window(0, 0, width, height)
    low, high = np.array([columns[0], rows[0]]) - margin, np.array([columns[-1], rows[-1]]) + margin
    return window_of(picture, low, high, arm_px) or whole_frame(picture)


def measure(segmenter: inference.Segmenter, frames: Iterable[Frame], overlays: Path | None = None) -> Result:
    """IoU of forearm with hand in each picture that shows one, its unlabelled pixels left out: `photographs` of the JSON file.
    overlays: a folder for the pictures with their masks. Raises recordings.DataError where a picture cannot be read."""
    rows: list[dict[str, Any]] = []
    for index, frame in enumerate(frames, 1):
        image, labels = frame.read()
        truth = np.isin(labels, TARGET_LABELS)
        if not truth.any():
            continue
        window = window_about(truth)
        for k in range(files.SETTLE):  # a gap in time before each picture, after which the state is forgotten
            part = segmenter(image, window, index * 10**10 + k * files.PERIOD_NS)
        mask = np.full(labels.shape, Label.BACKGROUND, np.uint8)
        mask[window.y0 : window.bottom, window.x0 : window.right] = part.repeat(window.scale, 0).repeat(window.scale, 1)
        found, known = np.isin(mask, TARGET_LABELS), labels != UNLABELLED
        iou = (found & truth).sum() / ((found | truth) & known).sum()
        rows.append({"name": frame.picture.stem, "iou": round(float(iou), 4)})
        if overlays:
            picture = files.overlay(image, mask)
            cv2.rectangle(picture, (window.x0, window.y0), (window.right - 1, window.bottom - 1), (255, 255, 255), 1)
            files.write(overlays / f"{frame.picture.stem}.png", picture[..., ::-1])
    every = [row["iou"] for row in rows]
    mean, median = (round(float(of(every)), 4) if every else None for of in (np.mean, np.median))
    return {"photographs": {"pictures": len(rows), "iou_mean": mean, "iou_median": median, "rows": rows}}


def tables(found: Result) -> list[Part]:
    """The IoU of each picture, and of all."""
    of = found["photographs"]
    table = Table("photograph", "IoU", title="Forearm with hand in photographs, unlabelled pixels left out")
    for row in of["rows"]:
        table.add_row(row["name"], f"{row['iou']:.3f}")
    if of["pictures"]:
        mean = marked(f"{of['iou_mean']:.3f}", of["iou_mean"] >= GOAL)
        table.add_row(f"{of['pictures']}, mean (median)", f"{mean} ({of['iou_median']:.3f}), goal >= {GOAL}")
    return [table]
