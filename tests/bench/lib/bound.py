"""The Cramér-Rao bound of a pose from an exact mask, computed from the picture's truth and not by the search.

A hard mask says of every pixel on the boundary that the contour passes within half a pixel of it: an error that is uniform in
+-1/2 px, of variance 1/12 px^2, independent for each pixel of the contour's length. The information about the pose is the sum
over the visible contour of how far a pose error moves it along its normal. `information` has that from the mesh's occluding
edges, and `rendered_information` from nothing but renderings on both sides of the true pose, to check it.

What counts is the target's outer contour where both sides of it are known: beside a pixel that something covers (an occluder, the
upper arm beyond the elbow) a mask does not show whose border it is.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.services.search import evidence
from penumbra.services.search.evidence import COVERED
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.intrinsics import Intrinsics
from penumbra.shared.perception.robot_depth import RobotDepth
from penumbra.sim.sets.shots import Shot

VARIANCE_PX2 = 1.0 / 12.0
"""Variance [px^2] of an error that is uniform in a pixel."""
FINE = 8
"""Factor by which the rendering that shows whether an edge is on the silhouette's outside is finer than the picture."""
CREASE = 0.8
"""Angle [rad] above which facets meet at a crease of the body instead of approximating a round surface."""


def states(shot: Shot) -> NDArray[np.uint8]:
    """State of every pixel of a picture with respect to the target, see `services.search.evidence`."""
    k = Intrinsics.of_window(shot.camera, 0, 0, 1)
    depth = None
    if shot.joints:
        robots = RobotDepth(shot.cell, rigid.inverse(shot.camera.T_world_camera))
        depth = robots.render(shot.joints, k, shot.labels.shape)
    z = rigid.apply(shot.T_camera_target, shot.mesh.vertices)[:, 2]
    target = next(iter(shot.cell.targets.values()))
    return evidence.classify(shot.labels, target.label_values, depth, (float(z.min()), float(z.max())))


def information(shot: Shot, facets: bool = False) -> Array:
    """The Fisher information (6, 6) about the pose error along the camera's axes, as `rigid.pose_error` defines it, around the
    true pose. facets: whether the flat sides of the mesh of a round limb show its roll."""
    points, normals, lengths = _contour(shot, facets)
    camera, origin = shot.camera, shot.T_camera_target[:3, 3]
    X, Y, Z = points.T
    a, b = normals[:, 0] * camera.fx / Z, normals[:, 1] * camera.fy / Z
    by_position = np.column_stack([a, b, -(a * X + b * Y) / Z])
    motion = np.hstack([by_position, np.cross(points - origin, by_position)])
    uv = points[:, :2] / Z[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    motion, lengths = motion[visible := _visible(shot, uv)], lengths[visible]
    return np.asarray((motion * (lengths / VARIANCE_PX2)[:, None]).T @ motion)


def _visible(shot: Shot, uv: Array) -> NDArray[np.bool_]:
    """Whether nothing covers the pixels (n, 2) and their neighbours."""
    near = cv2.dilate((states(shot) == COVERED).astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1)
    column, row = np.clip(np.round(uv).astype(int), 0, np.array(near.shape[::-1]) - 1).T
    return np.asarray(near[row, column] == 0)


def _contour(shot: Shot, facets: bool) -> tuple[Array, Array, Array]:
    """Points (n, 3) [m] of the outer contour in the camera's frame, outward normals (n, 2) in the picture, lengths (n,) [px]."""
    camera, mesh = shot.camera, shot.mesh
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    V = rigid.apply(shot.T_camera_target, mesh.vertices)
    corners = V[mesh.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-30)
    front = np.sum(area * corners[:, 0], axis=1) < 0.0
    i, j, f, g = _edges(mesh).T
    occluding = front[f] != front[g]
    i, j, f, g = (index[occluding] for index in (i, j, f, g))
    P = V[:, :2] / V[:, 2:] * focal + centre
    spans = np.linalg.norm(P[j] - P[i], axis=1)
    pieces = np.maximum(np.ceil(2.0 * spans).astype(int), 1)  # of half a pixel
    edge = np.repeat(np.arange(len(i)), pieces)
    share = (np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 0.5) / pieces[edge]
    i, j, f, g = i[edge], j[edge], f[edge], g[edge]
    along = (P[j] - P[i]) / np.maximum(spans[edge], 1e-9)[:, None]
    uv = P[i] + share[:, None] * (P[j] - P[i])
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    third = mesh.faces[np.where(front[f], f, g)].sum(axis=1) - i - j  # the third corner of the face in front lies inside
    normal *= -np.sign(np.sum(normal * (P[third] - P[i]), axis=1, keepdims=True))
    z = 1.0 / ((1.0 - share) / V[i, 2] + share / V[j, 2])
    points = np.column_stack([(uv - centre) / focal * z[:, None], z])
    if not facets:
        points = points * (1.0 + _roundness(V[j] - V[i], area, unit, f, g, points) / np.linalg.norm(points, axis=1))[:, None]
    low = np.floor(P.min(axis=0)).astype(int) - 2
    size = (np.ceil(P.max(axis=0)).astype(int) + 3 - low) * FINE
    cx, cy = (centre - low + 0.5) * FINE - 0.5
    fine = raster.silhouette(V, mesh.faces, (*(focal * FINE), cx, cy), (0, 0, int(size[0]), int(size[1])))

    def filled(offset_px: float) -> NDArray[np.bool_]:
        column, row = np.round((uv + offset_px * normal - low + 0.5) * FINE - 0.5).astype(int).T
        return np.asarray(fine[row, column])

    outer = filled(-0.2) & ~filled(0.2)
    return points[outer], normal[outer], (spans / pieces.clip(1))[edge][outer]


def _edges(mesh: Mesh) -> NDArray[np.int64]:
    """The edges (n, 4) of a closed mesh: two vertices and the two faces beside them."""
    pairs = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    order = np.lexsort(pairs.T)
    first, second = order[::2], order[1::2]
    assert np.array_equal(pairs[first], pairs[second]), "expected a closed mesh"
    return np.column_stack([pairs[first], first // 3, second // 3])


def _roundness(along: Array, area: Array, unit: Array, f: NDArray, g: NDArray, points: Array) -> Array:
    """Distance (n,) [m] along the line of sight from a facet's edge to where the round surface that the mesh approximates is seen
    edge-on. The surface's normal turns evenly between the middles of two facets."""
    turn = np.arccos(np.clip(np.sum(unit[f] * unit[g], axis=1), -1.0, 1.0))
    middle = unit[f] + unit[g]
    away = np.sum(middle * points, axis=1) / (np.linalg.norm(middle, axis=1) * np.linalg.norm(points, axis=1))
    height = (np.linalg.norm(area[f], axis=1) + np.linalg.norm(area[g], axis=1)) / (2.0 * np.linalg.norm(along, axis=1))
    return np.where((turn > 1e-6) & (turn < CREASE), -np.arcsin(np.clip(away, -1.0, 1.0)) / np.maximum(turn, 1e-6) * height, 0.0)


def rendered_information(shot: Shot, blur_px: float = 0.7, step_px: float = 0.25) -> Array:
    """`information` with facets, from renderings. The silhouette's share of each pixel, slightly blurred, is a level set. Its
    differences between poses on both sides of the true one, divided by its gradient, are the contour's motion. Its noise adds
    information where there is next to none."""
    grid, fine = 8, 32  # cells a pixel of the level set, and of the renderings
    camera, T = shot.camera, shot.T_camera_target
    vertices = rigid.apply(T, shot.mesh.vertices)
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    pixels = vertices[:, :2] / vertices[:, 2:] * focal + centre
    low, high = np.floor(pixels.min(axis=0)).astype(int) - 4, np.ceil(pixels.max(axis=0)).astype(int) + 5
    width, height = (high - low).tolist()
    k = (*(focal * fine), *((centre - low + 0.5) * fine - 0.5))

    def share(error: Array) -> Array:
        moved = rigid.apply(rigid.perturb(T, error), shot.mesh.vertices)
        picture = raster.silhouette(moved, shot.mesh.faces, k, (0, 0, width * fine, height * fine)).astype(np.float32)
        cells = cv2.resize(picture, (width * grid, height * grid), interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.GaussianBlur(cells, (0, 0), blur_px * grid), np.float64)

    slope = np.hypot(*np.gradient(share(np.zeros(6)))) * grid
    row, column = np.nonzero(slope > 0.01)
    visible = _visible(shot, (np.column_stack([column, row]) + 0.5) / grid - 0.5 + low)
    row, column = row[visible], column[visible]
    weights, motion = slope[row, column], np.empty((6, len(row)))
    for i, unit in enumerate(np.eye(6)):
        after = rigid.apply(rigid.perturb(T, 1e-4 * unit), shot.mesh.vertices)
        fastest = np.linalg.norm((after[:, :2] / after[:, 2:]) * focal + centre - pixels, axis=1).max() / 1e-4
        step = float(min(step_px / max(fastest, 1e-9), 0.05))
        moved = (share(step * unit) - share(-step * unit))[row, column] / (2.0 * step * weights)
        motion[i] = np.clip(moved, -fastest, fastest)
    return np.asarray((motion * weights) @ motion.T / (VARIANCE_PX2 * grid**2))


def position_errors(informations: list[Array], draws: int = 400) -> Array:
    """Position errors [m] (n * draws,) that an efficient estimator would have on pictures with these informations."""
    rng = np.random.default_rng(0)
    return np.concatenate(
        [np.linalg.norm((rng.normal(size=(draws, 6)) @ root(information).T)[:, :3], axis=1) for information in informations]
    )


def root(information: Array) -> Array:
    """A square root (6, 6) of the covariance; directions without information get a metre or a radian."""
    values, axes = np.linalg.eigh(information)
    return np.asarray(axes / np.sqrt(np.maximum(values, 1.0)))


def position_rms(informations: list[Array]) -> float:
    """The median over pictures of the root mean square position error [m] by the bound."""
    return float(np.median([np.linalg.norm(root(information)[:3]) for information in informations]))
