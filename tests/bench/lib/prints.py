"""Household objects with prints: meshes with colours, and pictures of them in other light, before a colourful background.

The colours are patches about random points of the surface, as on packages, and two large areas. A picture has other light than
the mesh's colours: a lamp to the side, a tint, another gamma, noise and blur. The scale of the mesh is wrong by 0.5 % (one
standard deviation).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from penumbra.services.search.objects import paint
from penumbra.services.search.objects.pose import RigidObject
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.geometry import raster
from penumbra.shared.geometry.rigid import Array, apply
from penumbra.shared.perception.intrinsics import Intrinsics

SUBDIVIDED = 0.0025
"""Maximum edge [m] of a printed mesh: the colours of its vertices are the print."""
PATCHES = 40
"""Number of patches of a print."""
MISPLACED = 0.001
"""Standard deviation [m] of the displacement of a print on the surface in a scan."""
MAKERS: dict[str, Callable[[], trimesh.Trimesh]] = {
    "box": lambda: trimesh.creation.box((0.06, 0.158, 0.21)),
    "flat box": lambda: trimesh.creation.box((0.03, 0.085, 0.073)),
    "cube": lambda: trimesh.creation.box((0.085, 0.085, 0.085)),
    "can": lambda: trimesh.creation.cylinder(0.033, 0.102, sections=48),
}


@dataclass(frozen=True)
class Printed:
    """A trimesh with coloured vertices as a user has it, the true colours (n, 3) of its vertices, and the objects of
    `search refine` with its colours (`rigid`) and without (`plain`)."""

    mesh: trimesh.Trimesh
    colours: NDArray[np.uint8]
    rigid: RigidObject
    plain: RigidObject

    def error(self, T: Array, truth: Array) -> float:
        """Mean distance of the vertices at two poses, as a share of the diameter."""
        V = np.asarray(self.mesh.vertices)
        return float(np.linalg.norm(apply(T, V) - apply(truth, V), axis=1).mean()) / self.rigid.diameter


def printed(name: str, seed: int) -> Printed:
    """An object of MAKERS with a print."""
    rng = np.random.default_rng(seed)
    body = MAKERS[name]()
    vertices, faces = trimesh.remesh.subdivide_to_size(body.vertices, body.faces, SUBDIVIDED, max_iter=12)
    vertices, faces = np.asarray(vertices, float), np.asarray(faces, np.int64)
    grounds, across, begin = rng.uniform(20, 235, (2, 3)), rng.normal(size=3), rng.uniform(-0.02, 0.02)
    middles = vertices[rng.integers(len(vertices), size=PATCHES)]
    radii, inks = rng.uniform(0.003, 0.02, PATCHES), rng.uniform(10, 245, (PATCHES, 3))

    def print_at(points: Array) -> NDArray[np.uint8]:
        distance, nearest = cKDTree(middles).query(points)
        ground = np.where((points @ across > begin)[:, None], *grounds)
        return np.where((distance < radii[nearest])[:, None], inks[nearest], ground).astype(np.uint8)

    waves, phases = rng.normal(0.0, 40.0, (3, 8)), rng.uniform(0.0, 2.0 * np.pi, 8)
    off = np.sin(vertices @ waves + phases) @ rng.normal(0.0, MISPLACED / 2.0, (8, 3))
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=print_at(vertices + off), process=False)
    whole = Mesh(vertices, faces.astype(np.int32), np.zeros(len(faces), np.uint8))
    return Printed(mesh, print_at(vertices), RigidObject(whole, paint.cloud(mesh)), RigidObject(whole))


def photographed(
    one: Printed, T: Array, k: Intrinsics, shape: tuple[int, int], seed: int, hidden: float = 0.0
) -> NDArray[np.uint8]:
    """A picture (h, w, 3) of it at T_camera_object; a thing of another colour hides a stripe, a share `hidden` of its width."""
    rng = np.random.default_rng(seed)
    h, w = shape
    picture = cv2.resize(rng.uniform(20, 235, (h // 80, w // 80, 3)), (w, h), interpolation=cv2.INTER_NEAREST)
    scale = 1.0 + rng.normal(0.0, 0.005)
    V = apply(T, np.asarray(one.mesh.vertices) * scale)
    faces = np.asarray(one.mesh.faces, np.int32)
    surface = raster.Raster(w, h)
    surface.draw(V, faces, k.fx, k.fy, k.cx, k.cy, 0)
    seen = surface.triangles >= 0
    normal = np.cross(V[faces[:, 1]] - V[faces[:, 0]], V[faces[:, 2]] - V[faces[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
    lamp = rng.normal(size=3) + np.array([0.0, -1.0, -1.5])
    light = 0.45 + 0.75 * np.maximum(normal @ (lamp / np.linalg.norm(lamp)), 0.0)
    colour = one.colours[faces].mean(axis=1) / 255.0
    look = light[:, None] * rng.uniform(0.7, 1.1, 3) * colour ** rng.uniform(0.7, 1.3)
    picture[seen] = 255.0 * look[surface.triangles[seen]]
    if hidden:
        columns = np.flatnonzero(seen.any(axis=0))
        begin = rng.uniform(columns[0], columns[-1] - hidden * len(columns))
        picture[:, int(begin) : int(begin + hidden * len(columns))] = rng.uniform(20, 235, 3)
    picture = cv2.GaussianBlur(picture + rng.normal(0.0, 10.0, (h, w, 3)), (0, 0), rng.uniform(0.5, 1.2))
    return np.asarray(picture.clip(0, 255), np.uint8)
