"""Views of the board from a folder of pictures, and the views that are still missing for a good lens."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.services import progress
from penumbra.services.calibrate.board import Board, CalibrationError
from penumbra.services.calibrate.intrinsics import View
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.lens import Lens
from penumbra.shared.geometry.rigid import Array

Picture = NDArray[np.uint8]
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
JOINTS = "joints.csv"
"""File beside the pictures: a header with `picture` and every joint, and a line for each picture [rad]."""
PARTS = 3
"""Rows and columns of parts of a picture, each of which should have corners."""
TILT = math.radians(15.0)
"""Minimum angle [rad] of a tilted view."""
NEAR = 0.45
"""Minimum share of the picture's width that the board covers in a near view."""
STEP, TURN, SCALE = 0.12, math.radians(10.0), 1.25
"""Minimum change that makes another view: the board moved by this share of the width, turned by this angle [rad], or scaled by
this factor."""
SLACK = 0.1
"""Maximum excess [rad] of joints beyond their limits: drives overshoot."""


def read(folder: Path, board: Board) -> tuple[list[View], list[str], tuple[int, int]]:
    """The views in a folder of pictures, the names of pictures without the board, and their width and height. Raises
    CalibrationError if there is no picture, or pictures of different sizes."""
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    except OSError as error:
        raise CalibrationError(f"{folder}: expected a folder of pictures: {error.strerror}") from None
    if not paths:
        raise CalibrationError(f"{folder}: expected pictures ({', '.join(SUFFIXES)}), got none")
    views, without, sizes = [], [], dict[tuple[int, int], str]()
    for path in progress.track(paths, "looking for the board"):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise CalibrationError(f"{path}: expected a picture, got something that OpenCV cannot read; remove it")
        sizes.setdefault((image.shape[1], image.shape[0]), path.name)
        if len(sizes) > 1:
            got = " and ".join(f"{name} with {width} x {height}" for (width, height), name in sizes.items())
            raise CalibrationError(f"{folder}: expected pictures of one size, got {got}: use those of one camera and one setting")
        found = board.find(np.asarray(image, np.uint8))
        if found is None:
            without.append(path.name)
        else:
            views.append(View(path.name, *found))
    return views, without, next(iter(sizes))


class Coverage:
    """Coverage of the views: corners in all parts of the picture, tilts to all sides, near ones.

    lens: approximately that of the camera, used to judge tilts; it need not be exact.
    """

    def __init__(self, board: Board, lens: Lens):
        self._board, self._lens = board, lens
        self._K = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
        self._seen = np.zeros((PARTS, PARTS), bool)
        self._kinds: set[str] = set()
        self._poses: list[Array] = []

    def add(self, view: View) -> None:
        """Add a view."""
        self._seen |= self._parts(view)
        T = self._pose(view)
        self._kinds |= self._kinds_of(view, T)
        self._poses.append(T)

    def adds(self, view: View) -> bool:
        """Whether a view shows something that is missing, or differs from all others."""
        T = self._pose(view)
        if (self._parts(view) & ~self._seen).any() or self._kinds_of(view, T) - self._kinds:
            return True
        return all(self._differ(T, other) for other in self._poses)

    def missing(self) -> list[str]:
        """Instructions for the person with the board that would make the lens more certain."""
        rows, columns = ("upper", "middle", "lower"), ("left", "middle", "right")
        names = [
            "the middle" if row == column == "middle" else f"the {row} {column}"
            for r, row in enumerate(rows)
            for c, column in enumerate(columns)
            if not self._seen[r, c]
        ]
        out = [f"the board in {', '.join(names)} of the picture"] if names else []
        sides = [side for side in ("left", "right", "upper", "lower") if side not in self._kinds]
        if sides:
            out.append(f"its {', '.join(sides)} side tilted towards the camera by {math.degrees(TILT):.0f} degrees or more")
        if "near" not in self._kinds:
            out.append("the board so near that it fills half of the picture")
        return out

    def _parts(self, view: View) -> NDArray[np.bool_]:
        out = np.zeros((PARTS, PARTS), bool)
        at = np.clip(view.corners * PARTS / (self._lens.width, self._lens.height), 0, PARTS - 1e-9).astype(int)
        out[at[:, 1], at[:, 0]] = True
        return out

    def _pose(self, view: View) -> Array:
        _, rotation, place = cv2.solvePnP(self._board.corners[view.numbers], view.corners, self._K, None)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rigid.rotation(np.ravel(rotation)), np.ravel(place)
        return T

    def _kinds_of(self, view: View, T: Array) -> set[str]:
        x, y, _ = T[:3, 2]  # normal of the board's back
        low = math.sin(TILT)
        tilts = {"left": x < -low, "right": x > low, "upper": y < -low, "lower": y > low}
        out = {side for side, is_there in tilts.items() if is_there}
        return out | ({"near"} if np.ptp(view.corners[:, 0]) > NEAR * self._lens.width else set())

    def _differ(self, T: Array, other: Array) -> bool:
        middle = np.array([*self._board.size, 0.0]) / 2.0
        a, b = rigid.apply(T, middle), rigid.apply(other, middle)
        moved = np.abs(a[:2] / a[2] - b[:2] / b[2]).max() * self._lens.fx / self._lens.width
        turned = np.linalg.norm(rigid.pose_error(T, other)[3:])
        grown = max(a[2] / b[2], b[2] / a[2])
        return bool(moved > STEP or turned > TURN or grown > SCALE)


# ---- joints beside pictures


def read_joints(path: Path, names: Sequence[str], limits: tuple[Array, Array], are_degrees: bool = False) -> dict[str, Array]:
    """Joint angles [rad] by picture, in the order of `names`, whatever the order of the file's columns. limits: lower and upper
    ones (n,). Raises CalibrationError with the faulty line."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [(n, row) for n, row in enumerate(csv.reader(file), 1) if any(each.strip() for each in row)]
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(
            f"{path}: expected a file of joint angles with the columns picture, {', '.join(names)}: {error}"
        ) from None
    rows = [(n, [cell.strip() for cell in row]) for n, row in rows if not row[0].lstrip().startswith("#")]
    header = rows[0][1] if rows else []
    missing = [name for name in ("picture", *names) if header.count(name) != 1]
    if missing:
        raise CalibrationError(
            f"{path}: expected each of the columns picture, {', '.join(names)} once, got {', '.join(header) or 'nothing'}; "
            f"correct {', '.join(missing)}"
        )
    out: dict[str, Array] = {}
    for n, row in rows[1:]:
        entry = dict(zip(header, row, strict=False))
        try:
            q = np.array([float(entry[name]) for name in names])
        except (KeyError, ValueError):
            raise CalibrationError(f"{path}:{n}: expected a number for every joint, got {', '.join(row)}") from None
        q = np.radians(q) if are_degrees else q
        wrong = [name for name, each, low, high in zip(names, q, *limits, strict=True) if not low - SLACK <= each <= high + SLACK]
        if wrong:
            raise CalibrationError(
                f"{path}:{n}: expected angles within the limits of the URDF [rad], got {', '.join(wrong)} beyond theirs; for "
                "degrees give --degrees"
            )
        out[entry["picture"]] = q
    return out


def save(folder: Path, taken: Iterable[tuple[str, Picture, Array | None]], joints: Sequence[str]) -> None:
    """Save pictures RGB by their names, and joints [rad] if there are any, as `read` and `read_joints` read them. Raises
    CalibrationError if they cannot be written."""
    lines = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, image, q in taken:
            if not cv2.imwrite(str(folder / name), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
                raise CalibrationError(f"{folder / name}: cannot be written")
            if q is not None:
                lines.append([name, *(f"{each:.8g}" for each in q)])
        if lines:
            with (folder / JOINTS).open("w", newline="") as file:
                csv.writer(file).writerows([["picture", *joints], *lines])
    except OSError as error:
        raise CalibrationError(f"{folder}: cannot be written: {error.strerror}") from None
