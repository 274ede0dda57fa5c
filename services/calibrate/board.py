"""The printed board: a chessboard with an ArUco marker in every white square, so that a part of it is enough (ChArUco)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.services import flags
from penumbra.shared.geometry.rigid import Array

DICTIONARIES = {
    name: getattr(cv2.aruco, f"DICT_{name}")
    for name in ("4X4_50", "4X4_100", "4X4_250", "5X5_50", "5X5_100", "5X5_250", "6X6_50", "6X6_100", "6X6_250")
}
"""OpenCV's dictionaries of markers. A marker with fewer bits can be read from farther away."""
MARKER = 0.75
"""Default edge of a marker, as a share of its square's edge."""
FEWEST = 6
"""Minimum number of corners in a view: a pose has six unknowns, and a few more corners reveal a wrong one."""
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 25.4e-3}


class CalibrationError(ValueError):
    """Pictures, joints or a cell file from which nothing can be calibrated; the text says what was expected and what to do."""


def length(text: str) -> float:
    """Type of a flag: a length with its unit, in metres."""
    match = re.fullmatch(r"([0-9.]+)\s*(mm|cm|m|in)", text.strip())
    try:
        value = float(match[1]) * UNITS[match[2]] if match else 0.0
    except ValueError:
        value = 0.0
    if not 1e-4 <= value <= 10.0:
        raise ValueError(f"expected a length with its unit, as in 40mm, got {text!r}")
    return value


def squares(text: str) -> tuple[int, int]:
    """Type of a flag: columns and rows of squares."""
    match = re.fullmatch(r"(\d{1,3})\s*[xX]\s*(\d{1,3})", text.strip())
    if match is None or not all(3 <= int(each) <= 40 for each in match.groups()):
        raise ValueError(f"expected columns and rows of squares from 3 to 40, as in 7x5, got {text!r}")
    return int(match[1]), int(match[2])


FLAGS = (
    flags.Option("--squares", type=squares, default="7x5", metavar="COLUMNSxROWS", section="Board", help="squares"),
    flags.Option("--square", type=length, default="40mm", metavar="LENGTH", section="Board", help="edge of a square"),
    flags.Option(
        "--marker",
        type=length,
        show_default=f"{MARKER:g} of --square",
        metavar="LENGTH",
        section="Board",
        help="edge of a marker, without its white rim",
    ),
    flags.Option("--dictionary", choices=DICTIONARIES, default="4X4_100", section="Board", help="OpenCV's name of the markers"),
)
"""Flags that describe the board."""
MEASURED = flags.Option(
    "--square-measured",
    type=length,
    metavar="LENGTH",
    show_default="--square",
    section="Board",
    help="edge of a square as the ruler has it on paper: printers scale. Measure the whole row and divide",
)


@dataclass(frozen=True)
class Board:
    """A ChArUco board. squares: columns and rows; square, marker: edges [m]; dictionary: one of DICTIONARIES. Its frame has x
    along a row of squares, y down the columns and z into the paper; the origin is the outer corner of the black square at the top
    left.

    Raises CalibrationError if OpenCV cannot make it.
    """

    squares: tuple[int, int] = (7, 5)
    square: float = 0.04
    marker: float = MARKER * 0.04
    dictionary: str = "4X4_100"

    def __post_init__(self) -> None:
        if not 0.3 * self.square <= self.marker <= 0.95 * self.square:
            raise CalibrationError(
                f"--marker: expected 30 % to 95 % of a square of {1e3 * self.square:g} mm, got {1e3 * self.marker:g} mm"
            )
        wanted, there = self.squares[0] * self.squares[1] // 2, int(self.dictionary.partition("_")[2])
        if wanted > there:
            raise CalibrationError(f"--dictionary: expected at least {wanted} markers for this board, got {self.dictionary}")

    @classmethod
    def of(cls, options: flags.Options) -> Board:
        """The board described by FLAGS and MEASURED."""
        square = getattr(options, "square_measured", None) or options.square
        marker = (options.marker or MARKER * options.square) * square / options.square
        return cls(options.squares, square, marker, options.dictionary)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [m]."""
        return self.squares[0] * self.square, self.squares[1] * self.square

    @cached_property
    def charuco(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's own board."""
        markers = cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary])
        return cv2.aruco.CharucoBoard(self.squares, self.square, self.marker, markers)

    @cached_property
    def corners(self) -> Array:
        """The inner corners (c, 3) of the chessboard [m], in the order of their numbers."""
        return np.asarray(self.charuco.getChessboardCorners(), np.float64).reshape(-1, 3)

    @cached_property
    def black(self) -> Array:
        """The black rectangles (r, 4): x, y of the corner nearest to the origin, width and height [m]."""
        columns, rows = self.squares
        out = [
            (x * self.square, y * self.square, self.square, self.square)
            for y in range(rows)
            for x in range(columns)
            if (x + y) % 2 == 0
        ]
        bits = self.charuco.getDictionary().markerSize + 2  # including the black rim
        module = self.marker / bits
        for number, corners in zip(np.ravel(self.charuco.getIds()), self.charuco.getObjPoints(), strict=True):
            marker = cv2.aruco.generateImageMarker(self.charuco.getDictionary(), int(number), bits, borderBits=1)
            left, top = np.asarray(corners, np.float64).reshape(4, 3)[0, :2]
            for y, row in enumerate(marker):
                edges = np.flatnonzero(np.diff(np.concatenate([[0], row == 0, [0]])))  # horizontal runs, so that few edges touch
                for first, end in zip(edges[::2], edges[1::2], strict=True):
                    out.append((left + first * module, top + y * module, (end - first) * module, module))
        return np.array(out)

    @cached_property
    def _detector(self) -> cv2.aruco.CharucoDetector:
        return cv2.aruco.CharucoDetector(self.charuco)

    def find(self, image: NDArray[np.uint8]) -> tuple[Array, NDArray[np.int64]] | None:
        """The corners (n, 2) [px] in a picture (height, width, 3) RGB or (height, width), and their numbers (n,); None if there
        are fewer than FEWEST, or only corners on one line."""
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
        corners, numbers, _, _ = self._detector.detectBoard(grey)
        if numbers is None or len(numbers) < FEWEST:
            return None
        found = np.asarray(numbers, np.int64).ravel()
        points = self.corners[found, :2]
        if np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] < 0.5 * self.square:
            return None
        return np.asarray(corners, np.float64).reshape(-1, 2), found
