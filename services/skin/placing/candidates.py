"""Candidate poses of pads: on the surface of robot links, or in the plane of a cell's pads that sit on the world.

A pad is a flat board. On a link it lies on the collision mesh, its normal outwards: the link is within SAG behind every part of
it, so that it does not stand out over an edge, and no other link enters the room before it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.body.robot import RobotModel
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.faults import meant
from penumbra.shared.cell.pads import Board, Pad
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

STEP = 0.03
"""Distance [m] between neighbouring candidates: half a pad."""
SAG = 0.02
"""Maximum depth [m] of a link's surface behind any part of a board that touches it. A board of 6 cm on a tube of 8 cm in diameter
has 1.5 cm at its corners."""
STANDOFF = 0.0005
"""Distance [m] between the back of a board and the highest point of the surface behind it."""
APART = 0.002
"""Minimum distance [m] between two boards."""
ROOM = 0.03
"""Room [m] before a board which no other link may enter."""
FLAT = (0.005, np.radians(2.0))
"""Maximum height [m] and angle [rad] relative to the first pad with which pads on the world are in one plane."""
SAMPLES = 6000
"""Number of points drawn on a link's surface, from which candidates are thinned to every STEP."""
GRID = 7
"""Number of test points along each side of a board."""


@dataclass(frozen=True)
class Plane:
    """A plane for pads on the world. T_world_plane (4, 4): z outwards; low, high (2,) [m]: bounds of the boards, in its frame."""

    T_world_plane: Array
    low: Array
    high: Array


def surface_points(mesh: Mesh, step: float, count: int = SAMPLES) -> tuple[Array, Array]:
    """Points (n, 3) on a mesh, no two nearer than `step` [m], and the outward normals (n, 3) of their faces; the result is
    deterministic."""
    rng = np.random.default_rng(0)
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    solid = areas > 1e-12
    corners, normals, areas = corners[solid], normals[solid] / areas[solid, None], areas[solid]
    faces = rng.choice(len(areas), count, p=areas / areas.sum())
    u, v = rng.uniform(size=(2, count, 1))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = np.moveaxis(corners[faces], 1, 0)
    points = a + u * (b - a) + v * (c - a)
    kept, away = [0], np.linalg.norm(points - points[0], axis=1)
    while (farthest := int(away.argmax())) not in kept and away[farthest] >= step:
        kept.append(farthest)
        away = np.minimum(away, np.linalg.norm(points - points[farthest], axis=1))
    return points[kept], normals[faces[kept]]


def on_link(mesh: Mesh, board: Board, step: float) -> list[Array]:
    """T_link_pad (4, 4) of candidates on a link, at least `step` [m] apart."""
    dense, normals = surface_points(mesh, step / 3.0)
    axes = np.linalg.svd(dense - dense.mean(axis=0), full_matrices=False)[2]
    found: list[Array] = []
    for point in surface_points(mesh, step)[0]:
        near = np.linalg.norm(dense - point, axis=1) < 0.5 * max(board.size)
        outward = normals[np.argmin(np.linalg.norm(dense - point, axis=1))]
        mean = normals[near & (normals @ outward > 0.3)].sum(axis=0)
        T = _frame(point, mean / np.linalg.norm(mean), axes)
        heights = footprint(mesh, T, board)
        if np.isfinite(heights).all() and np.ptp(heights) <= SAG and heights.max() <= SAG:
            T[:3, 3] += (heights.max() + board.thickness + STANDOFF) * T[:3, 2]
            found.append(T)
    return found


def _frame(point: Array, z: Array, axes: Array) -> Array:
    """A pose (4, 4) at a point with this z axis, and x along the first of the axes (3, 3) that is not along z."""
    along = axes[0] if abs(axes[0] @ z) < 0.7 else axes[1]
    x = along - (along @ z) * z
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(z, x), z]), point
    return T


def footprint(mesh: Mesh, T_link_pad: Array, board: Board) -> Array:
    """Heights (GRID * GRID,) [m] of the link's outermost surface behind a board, relative to the pad's plane and at most 5 cm
    above it; minus infinity where there is none."""
    corners = rigid.apply(rigid.inverse(T_link_pad), mesh.vertices)[mesh.faces]
    half = 0.5 * np.asarray(board.size)
    near = ((corners[..., :2].min(axis=1) <= half) & (corners[..., :2].max(axis=1) >= -half)).all(axis=1)
    return _heights(corners[near], _grid(board))


def _grid(board: Board) -> Array:
    """Points (GRID * GRID, 2) [m] all over a board, including its corners."""
    x, y = (np.linspace(-0.5, 0.5, GRID) * side for side in board.size)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _heights(corners: Array, points: Array, most: float = 0.05) -> Array:
    """The largest z (k,), up to `most`, at which lines along z through points (k, 2) intersect triangles (m, 3, 3); minus
    infinity where they intersect none."""
    a, b, c = np.moveaxis(corners, 1, 0)
    one, two = b[:, :2] - a[:, :2], c[:, :2] - a[:, :2]
    twice = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    flat = np.abs(twice) > 1e-12  # skip triangles seen edge-on
    a, b, c, one, two, twice = (each[flat] for each in (a, b, c, one, two, twice))
    to = points[:, None, :] - a[None, :, :2]
    u = (to[..., 0] * two[:, 1] - to[..., 1] * two[:, 0]) / twice
    v = (one[:, 0] * to[..., 1] - one[:, 1] * to[..., 0]) / twice
    z = a[:, 2] + u * (b - a)[:, 2] + v * (c - a)[:, 2]
    inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9) & (z <= most)
    return np.where(inside, z, -np.inf).max(axis=1, initial=-np.inf)


def in_plane(plane: Plane, board: Board, step: float) -> list[Array]:
    """T_world_pad (4, 4) of candidates every `step` [m] in a plane, with boards within its bounds."""
    half = 0.5 * np.asarray(board.size)
    axes = []
    for low, high, inset in zip(plane.low, plane.high, half, strict=True):
        length = high - low - 2.0 * inset
        count = int(np.floor(length / step)) + 1 if length >= 0.0 else 0
        axes.append(0.5 * (low + high) + step * (np.arange(count) - 0.5 * (count - 1)))
    return [plane.T_world_plane @ rigid.transform((x, y, 0.0)) for x in axes[0] for y in axes[1]]


def plane_of(cell: cells.Cell, reach: float) -> Plane | None:
    """The plane of the pads on the world, None if there are none: bounded by the emulator's table if the cell has one at this
    plane, otherwise by `reach` [m] around these pads. Raises CellError if they are in several planes."""
    pads = {name: pad for name, pad in cell.pads.items() if pad.link == "world"}
    if not pads:
        return None
    first, *_ = pads.values()
    T = first.T_link_pad
    for name, pad in pads.items():
        away = rigid.inverse(T) @ pad.T_link_pad
        if abs(away[2, 3]) > FLAT[0] or np.arccos(np.clip(away[2, 2], -1.0, 1.0)) > FLAT[1]:
            raise cells.CellError(
                f"pads.{name}: expected the pads on the world in one plane, got one {100 * away[2, 3]:.1f} cm above or turned "
                "beside the first; give the links to place pads on with --links"
            )
    sim = cell.sim
    if sim is not None and sim.table is not None and abs(T[2, 3]) <= FLAT[0] and np.allclose(T[:3, :3], np.eye(3)):
        middle, half = np.array(sim.table_middle), 0.5 * np.array(sim.table)
        return Plane(T, middle - half - T[:2, 3], middle + half - T[:2, 3])
    own = np.array([(rigid.inverse(T) @ pad.T_link_pad)[:2, 3] for pad in pads.values()])
    return Plane(T, own.min(axis=0) - reach, own.max(axis=0) + reach)


def clear_of_links(
    pads: Sequence[Pad], board: Board, links: Mapping[str, Array], points: Mapping[str, Array]
) -> NDArray[np.bool_]:
    """Whether (c,) no other link enters the room before a pad, for poses (k, 4, 4) of links and points (m, 3) on them."""
    half = 0.5 * np.asarray(board.size)
    clear = np.ones(len(pads), bool)
    for k in range(len(next(iter(links.values())))):
        placed = {name: rigid.apply(links[name][k], own) for name, own in points.items()}
        for i, pad in enumerate(pads):
            if clear[i]:
                others = np.concatenate([own for name, own in placed.items() if name != pad.link] or [np.empty((0, 3))])
                local = rigid.apply(rigid.inverse(links[pad.link][k] @ pad.T_link_pad), others)
                inside = (np.abs(local[:, :2]) < half + APART).all(axis=1)
                clear[i] = not (inside & (local[:, 2] > -board.thickness) & (local[:, 2] < ROOM)).any()
    return clear


def overlaps(T_world_pads: Array, board: Board) -> NDArray[np.bool_]:
    """Pairs (c, c) of boards at T_world_pads (c, 4, 4) that overlap; none with itself."""
    half = np.append(0.5 * np.asarray(board.size) + APART, ROOM)
    grid = np.column_stack([_grid(board), np.zeros(GRID * GRID)])
    T = np.asarray(T_world_pads)
    out = np.zeros((len(T), len(T)), bool)
    for i, own in enumerate(T):
        near = np.flatnonzero(np.linalg.norm(T[:, :3, 3] - own[:3, 3], axis=1) < 2.0 * np.linalg.norm(half))
        corners = np.einsum("nij,kj->nki", T[near, :3, :3], grid) + T[near, None, :3, 3]
        local = (corners - own[:3, 3]) @ own[:3, :3]
        out[i, near] = (np.abs(local) < half).all(axis=-1).any(axis=-1)
    out |= out.T
    np.fill_diagonal(out, False)
    return out


def carriers(cell: cells.Cell, models: Mapping[str, RobotModel], wanted: Iterable[str]) -> tuple[str, ...]:
    """The links to place pads on, as in `link` of a pad: the wanted ones (ROBOT/LINK, LINK or world), otherwise those that carry
    pads now, otherwise all that have a mesh. Raises CellError."""
    known = [f"{robot}/{link}" for robot, model in models.items() for link in model.links]
    solid = [f"{robot}/{link}" for robot, model in models.items() for link in model.meshes]
    if not known and not cell.pads:
        raise cells.CellError(
            f"cell {cell.name}: expected a robot or a pad, got neither; add a robot with its URDF under `robots`, or a first pad "
            "on the world under `pads`, in whose plane others may lie"
        )
    chosen = []
    for name in wanted:
        full = [link for link in ("world", *known) if name in (link, link.partition("/")[2])]
        if len(full) != 1:
            others = f" or one of {', '.join(solid)}" if solid else ", as the cell has no robot"
            what = f"one of {', '.join(full)}" if full else f"world{others}"
            raise cells.CellError(f"--links: expected {what}, got {name!r}{meant(name, [*known, 'world'])}")
        if full[0] != "world" and full[0] not in solid:
            raise cells.CellError(f"--links: expected links with a collision mesh ({', '.join(solid)}), got {name!r}")
        chosen.append(full[0])
    return tuple(dict.fromkeys(chosen or [pad.link for pad in cell.pads.values()] or solid))
