"""Visible creases of a mesh inside its silhouette: edges between two faces that both face the camera."""

from __future__ import annotations

import numpy as np

from penumbra.services.search.contour import POINT, Model, Points
from penumbra.shared.geometry import raster
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.intrinsics import Intrinsics

SHARP = 0.5
"""Minimum angle between the faces of a crease [rad]: an edge with a smaller one may belong to a round surface."""
BEHIND = 0.004
"""Distance [m] behind the visible surface beyond which a point counts as hidden."""
BORDER = 2
"""Margin at the picture's border [px] in which points are left out."""


class Creases:
    """The sharp edges of a mesh."""

    def __init__(self, model: Model):
        V, F, E = model.vertices, model.faces, model.edges
        normal = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
        E = E[E[:, 3] >= 0]
        turn = np.arccos(np.clip(np.sum(normal[E[:, 2]] * normal[E[:, 3]], axis=1), -1.0, 1.0))
        self._model, self._edges = model, E[turn > SHARP]

    def points(self, T: Array, k: Intrinsics, shape: tuple[int, int], spacing: float) -> Points:
        """Points (n,) of the visible creases at a pose T_camera_object in a picture (h, w), `spacing` [px] apart. Their normals
        are those of the creases in the image, of either sign."""
        V, F, E = self._model.in_camera(T), self._model.faces, self._edges
        corners = V[F[E[:, 2:]]]  # (n, two faces, three corners, 3)
        away = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
        E = E[(np.sum(away * corners[:, :, 0], axis=2) < 0.0).all(axis=1)]
        z = np.maximum(V[:, 2], 1e-9)
        P = np.stack([k.fx * V[:, 0] / z + k.cx, k.fy * V[:, 1] / z + k.cy], axis=1)
        way = P[E[:, 1]] - P[E[:, 0]]
        length = np.linalg.norm(way, axis=1)
        E, way, length = E[length > 1e-3], way[length > 1e-3], length[length > 1e-3]
        count = np.maximum((length / spacing + 0.5).astype(np.int64), 1)
        edge = np.repeat(np.arange(len(E)), count)
        s = (np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[edge]
        # linear in the inverse depth
        depth = 1.0 / ((1.0 - s) / z[E[edge, 0]] + s / z[E[edge, 1]])
        pixel = P[E[edge, 0]] + s[:, None] * way[edge]
        points = np.empty(len(edge), POINT)
        points["position"] = np.stack([(pixel[:, 0] - k.cx) / k.fx * depth, (pixel[:, 1] - k.cy) / k.fy * depth, depth], axis=1)
        points["pixel"] = pixel
        points["normal"] = np.stack([way[edge, 1], -way[edge, 0]], axis=1) / length[edge, None]
        points["length"] = length[edge] / count[edge]
        h, w = shape
        inside = ((pixel > BORDER) & (pixel < (w - BORDER - 1, h - BORDER - 1))).all(axis=1)
        points = points[inside]
        if not len(points):
            return points
        surface = raster.Raster(w, h)
        surface.draw(V, F, k.fx, k.fy, k.cx, k.cy, 0)
        x, y = (points["pixel"] + 0.5).astype(np.int64).T
        return points[surface.depth[y, x] > points["position"][:, 2] - BEHIND]
