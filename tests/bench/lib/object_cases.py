"""Photographs of objects with true poses in folders, and scores of `search refine` and `search track` on them.

A folder of a case holds `mesh.ply` (metres), `camera.json`, `truth.json` and `rgb.png`, and may hold `mask.png` or else
`mask_guided.png`. `truth.json` has `camera_from_object` of `rgb.png`, and for a sequence `frames`: a list with `file` and
`camera_from_object` of each.
"""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from penumbra.services.search.objects import meshes, tools
from penumbra.services.search.objects.meshes import ObjectFileError
from penumbra.services.search.objects.pose import ObjectEstimate, RigidObject, Tracker, find_pose
from penumbra.shared.geometry.rigid import Array, apply, perturb

STARTS = ((20.0, 0.03), (30.0, 0.05))
"""Rotation [deg] and distance [m] of the starts from the truth, each exactly, in random directions."""
CONVERGED = 0.1
"""A pose has converged if the mean distance of the mesh's points from those of the true pose is below this share of the diameter
(ADD; for a symmetric object the distance to the nearest point, ADD-S: Hinterstoisser et al. 2012,
doi:10.1007/978-3-642-37331-2_42)."""
MASKS = ("mask.png", "mask_guided.png")
"""Possible names of a mask; the first that exists is used."""
SURE = ("tracking", "occluded")
"""States that claim a right pose."""


def moved(T: Array, degrees: float, metres: float, rng: np.random.Generator) -> Array:
    """T turned and shifted by exactly these amounts, in random directions."""
    axis, way = rng.normal(size=3), rng.normal(size=3)
    error = np.concatenate([metres * way / np.linalg.norm(way), np.radians(degrees) * axis / np.linalg.norm(axis)])
    return perturb(T, error)


@dataclass(frozen=True)
class Case:
    """The content of a folder: reader of images, mesh, `vertices` (n, 3) [m] of the mesh, their largest distance [m],
    T_camera_object of rgb.png and of the frames of a sequence."""

    name: str
    folder: Path
    files: tools.CameraFiles
    rigid: RigidObject
    vertices: Array
    diameter: float
    truth: Array
    frames: tuple[tuple[Path, Array], ...]

    @property
    def mask(self) -> Path | None:
        return next((self.folder / name for name in MASKS if (self.folder / name).is_file()), None)

    def error(self, T: Array, truth: Array) -> float:
        """Mean distance of the vertices at two poses T_camera_object, as a share of the diameter."""
        return float(np.linalg.norm(apply(T, self.vertices) - apply(truth, self.vertices), axis=1).mean()) / self.diameter

    def rng(self, *seed: int) -> np.random.Generator:
        """A random generator that depends on the case's name and not on the other cases."""
        return np.random.default_rng((zlib.crc32(self.name.encode()), *seed))


def cases(folder: Path) -> list[Case]:
    """The cases in a folder's folders. Raises ObjectFileError."""
    if not folder.is_dir():
        raise ObjectFileError(f"{folder}: expected a folder of cases, found none")
    found = sorted(path.parent for path in folder.glob("*/truth.json"))
    if not found:
        raise ObjectFileError(f"{folder}: expected folders with a truth.json each, found none in it")
    return [read(path) for path in found]


def read(folder: Path) -> Case:
    """The case of a folder. Raises ObjectFileError."""
    mesh, colours = meshes.load(folder / "mesh.ply", "m")
    truth = json.loads((folder / "truth.json").read_text())
    vertices = mesh.vertices[np.unique(mesh.faces)]
    corners = np.asarray(trimesh.convex.convex_hull(vertices).vertices)
    diameter = max(float(np.linalg.norm(corners - corner, axis=1).max()) for corner in corners)
    frames = tuple((folder / one["file"], np.array(one["camera_from_object"], float)) for one in truth.get("frames", ()))
    files = tools.CameraFiles(tools.read_camera(folder / "camera.json"))
    pose = tools.read_pose(folder / "truth.json")
    return Case(folder.name, folder, files, RigidObject(mesh, colours), vertices, diameter, pose, frames)


def timed(call: Any, *arguments: Any) -> tuple[ObjectEstimate, float]:
    """A call's result and the processor time that it took [ms]."""
    begun = time.process_time()
    return call(*arguments), (time.process_time() - begun) * 1e3


def refined(case: Case, seed: int, starts: int) -> Iterator[dict[str, Any]]:
    """Rows for each of STARTS: with mask and picture, if there is a mask, and with the picture alone."""
    picture = case.files.picture(case.folder / "rgb.png")
    masks: dict[str, NDArray[np.bool_] | None] = {"mask+picture": case.files.mask(case.mask)} if case.mask else {}
    for name, mask in {**masks, "picture": None}.items():
        for degrees, metres in STARTS:
            found = []
            for i in range(starts):
                start = moved(case.truth, degrees, metres, case.rng(seed, i, int(degrees)))
                result, ms = timed(find_pose, case.rigid, mask, case.files.k, start, case.files.occluder(None), picture)
                e = case.error(result.T, case.truth)
                found.append((e, e < CONVERGED, result.state in SURE, ms))
            error, right, sure, ms_all = np.array(found, float).T
            yield {
                "name": case.name,
                "with": name,
                "start": [degrees, metres],
                "converged": round(float(right.mean()), 3),
                "wrong_but_tracking": round(float((sure * (1.0 - right)).mean()), 3),
                "tracking": round(float(sure.mean()), 3),
                "error_of_diameter": round(float(np.median(error)), 4),
                "ms": round(float(ms_all.mean()), 1),
            }


def tracked(case: Case, seed: int, starts: int) -> dict[str, Any]:
    """The row of a sequence, with the picture alone, from the nearer of STARTS.

    `right`: share of the frames that are tracked and right; `recovery_frames`: the longest run of frames that are not, including
    those after the start.
    """
    pictures = [case.files.picture(path) for path, _ in case.frames]
    right, wrong, ms_all, longest = [], [], [], 0
    for i in range(starts):
        tracker = Tracker(case.rigid, case.files.k, moved(case.frames[0][1], *STARTS[0], case.rng(seed, i)))
        run = 0
        for picture, (_, truth) in zip(pictures, case.frames, strict=True):
            found, ms = timed(tracker.update, None, case.files.occluder(None), picture)
            sure, good = found.state in SURE, case.error(found.T, truth) < CONVERGED
            right.append(sure and good)
            wrong.append(sure and not good)
            run = 0 if right[-1] else run + 1
            longest = max(longest, run)
            ms_all.append(ms)
    return {
        "name": case.name,
        "with": "picture",
        "start": list(STARTS[0]),
        "frames": len(pictures),
        "right": round(float(np.mean(right)), 3),
        "wrong_but_tracking": round(float(np.mean(wrong)), 3),
        "recovery_frames": longest,
        "ms": round(float(np.mean(ms_all)), 1),
        "ms_median": round(float(np.median(ms_all)), 1),
    }
