"""Looks for lost arms in the picture by landmarks, if their models are installed. It has its own thread, so that no tracked
stream waits, and looks only while an arm is lost, at most once every EVERY_NS per camera."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from penumbra.services.search import starter
from penumbra.shared.cell.description import Cell
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception import landmarks
from penumbra.shared.perception.landmarks import Landmarks
from penumbra.shared.perception.limbs import find, limb_of

Image = NDArray[np.uint8]

LOST_NS = 300_000_000
"""Time [ns] for which a target must be lost before landmarks are looked for. Chosen: the search alone has tried twice by then."""
EVERY_NS = 250_000_000
"""Minimum time [ns] between two looks at a camera's picture: one costs 20 to 60 ms of processor time."""
FRESH_NS = 500_000_000
"""Maximum age [ns] of a first pose that is used: an arm moves 10 cm meanwhile."""
MOST = 6
"""Maximum number of first poses per target, from all hands in the picture together."""


@dataclass(frozen=True)
class _Wanted:
    """A picture, and the targets that are lost in it."""

    stamp_ns: int
    undistorted: Callable[[], Image]
    targets: tuple[str, ...]


class Refinder:
    """Finds first poses for the lost targets of a cell.

    Threads: the mask threads, each with its own cameras, call `ask` and `starts`; a timer calls `look`. They share dictionaries
    whose entries are replaced or removed as a whole.
    """

    def __init__(self, cell: Cell, folder: Path):
        """folder: of the landmark models. Without valid models, or without openvino, nothing is found, and `missing` says why."""
        bodies = {name: starter.body_of(target, cell.body) for name, target in cell.targets.items()}
        self._bodies = {name: body for name, body in bodies.items() if body is not None}
        self._cameras, self._folder = cell.cameras, folder
        self._models: Landmarks | None = None
        self._since: dict[str, dict[str, int]] = {camera: {} for camera in cell.cameras}
        self._asked_ns = dict.fromkeys(cell.cameras, 0)
        self._wanted: dict[str, _Wanted] = {}
        self._found: dict[tuple[str, str], tuple[int, list[Array]]] = {}
        self._looks = 0
        self.missing = ""
        if importlib.util.find_spec("openvino") is None:
            self.missing = "openvino is not installed; do pip install 'penumbra[segmentation]'"
        elif not landmarks.is_installed(folder):
            self.missing = f"no landmark models in {folder}; do penumbra segmentation models"

    def describe(self) -> dict[str, object]:
        """Fields of the health report: whether landmarks are in use, what is missing for them, and the number of looks."""
        return {"is_installed": not self.missing, "missing": self.missing, "looks": self._looks}

    def ask(self, camera: str, lost: Collection[str], stamp_ns: int, undistorted: Callable[[], Image]) -> None:
        """Requests a look for targets that are lost in a camera's picture; `undistorted` makes its pinhole picture."""
        since = self._since[camera] = {target: self._since[camera].get(target, stamp_ns) for target in lost}
        due = tuple(name for name in since if name in self._bodies and stamp_ns - since[name] >= LOST_NS)
        if self.missing or not due or 0 <= stamp_ns - self._asked_ns[camera] < EVERY_NS:
            return
        self._asked_ns[camera] = stamp_ns
        self._wanted[camera] = _Wanted(stamp_ns, undistorted, due)

    def starts(self, camera: str, target: str, stamp_ns: int) -> Sequence[Array]:
        """First poses T_camera_target (4, 4) of a target for a picture of this stamp; each set is returned once."""
        found_ns, poses = self._found.pop((camera, target), (0, []))
        return poses if abs(stamp_ns - found_ns) <= FRESH_NS else ()

    def look(self) -> None:
        """Looks at the pictures that were requested since the last call."""
        for camera in list(self._wanted):
            wanted = self._wanted.pop(camera)
            if self._models is None:
                try:
                    self._models = landmarks.loaded(self._folder)
                except landmarks.ModelsError as error:
                    self.missing = str(error)
                    raise
            image = wanted.undistorted()
            hands, pose = find(self._models, image, (), None)
            limbs = [limb_of(hand, pose) for hand in hands]
            self._looks += 1
            for target in wanted.targets:
                found = [one for limb in limbs for one in starter.starts(limb, self._cameras[camera], self._bodies[target])]
                best = sorted(found, key=lambda one: one.misfit)[:MOST]
                self._found[camera, target] = wanted.stamp_ns, [one.T for one in best]
