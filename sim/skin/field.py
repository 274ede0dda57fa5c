"""Electrostatic field of a pad near a body by boundary elements: what the pad's electrodes measure.

All surfaces are flat panels with a uniform charge each, in units in which a unit charge has the potential 1 / r. Conductors
have given potentials; where a dielectric meets air the normal displacement is continuous, which binds charge there. Potential
and field of a panel are exact (Wilton et al. 1984, DOI 10.1109/TAP.1984.1143304), collocated at centroids; between pad and body,
panels count as the points of a quadrature.

The ring is excited at one volt; electrodes and ground pour are held at zero by their amplifiers. A body takes charges q from
the ring's potential, and an electrode's charge changes by -sum phi q, with phi the potential that the electrode alone would have
at the body (Green's reciprocity): a change is computed as such, never as a difference of nearly equal capacitances.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell.pads import PadType
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import kernel

FEMTOFARAD = 4.0 * np.pi * 8.8541878128e-12 * 1e15
"""Capacitance [fF] of a unit charge at one volt, in the units of this module."""
PERSON_PF = 150.0
"""A person's capacitance to ground [pF]; usual values, 100 to 200, hardly make a difference."""
SECTOR = math.radians(11.0)
"""Maximum angle [rad] that a panel on the board spans."""
PARTS = 6
"""Number of panels side by side across a piece of copper. Panels of half the size in both directions alter a change of
capacitance by 3 %."""
NEAR = 2.5
"""Distance to the pad, in sizes of a body's panel, below which the panel counts as nine points instead of one."""
ACCURACY = 1e-5
"""Relative change of the body's charges below which the iteration between pad and body ends."""
RING, GROUND, BARE = -1, -2, -3
"""Owners of panels other than the electrodes, which are 0, 1, 2 …: excitation ring, ground, and dielectric without copper."""
CLEAR = 0.003
"""Distance [m] to the board's volume within which parts of the link behind are left out: the board is mounted there."""


class Panels:
    """Flat panels. corners (n, 4, 3) [m], counter-clockwise from outside; a triangle repeats its third. areas (n,) [m^2], unit
    normals and centroids (n, 3)."""

    def __init__(self, corners: Array):
        self.corners = np.ascontiguousarray(corners, dtype=np.float64)
        a, b, c, d = np.moveaxis(self.corners, 1, 0)
        area_vector = 0.5 * np.cross(c - a, d - b)
        self.areas = np.linalg.norm(area_vector, axis=1)
        self.normals = area_vector / self.areas[:, None]
        first, second = np.linalg.norm(np.cross(b - a, c - a), axis=1), np.linalg.norm(np.cross(c - a, d - a), axis=1)
        share = (first / (first + second))[:, None]
        self.centroids = (share * (a + b + c) + (1.0 - share) * (a + c + d)) / 3.0

    @staticmethod
    def of_mesh(vertices: Array, faces: NDArray[np.integer]) -> Panels:
        """Panels of a mesh, one per triangle."""
        return Panels(np.asarray(vertices)[np.column_stack([faces, faces[:, 2]])])

    def __len__(self) -> int:
        return len(self.corners)

    def __add__(self, other: Panels) -> Panels:
        return Panels(np.concatenate([self.corners, other.corners]))

    def points(self) -> Array:
        """Nine points (n, 9, 3) that share a panel's charge equally: a 3 x 3 grid of its bilinear patch."""
        u, v = np.meshgrid([1 / 6, 1 / 2, 5 / 6], [1 / 6, 1 / 2, 5 / 6])
        weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v]).reshape(4, 9)
        return np.einsum("ncx,ck->nkx", self.corners, weights)

    def matrices(self) -> tuple[Array, Array]:
        """Potential and normal field (n, n) at every centroid by a unit charge on every panel. A panel's own normal field, which
        jumps there, counts as zero."""
        potential, field = np.empty((len(self), len(self))), np.empty((len(self), len(self)))
        _matrices(self.corners, self.normals, self.areas, self.centroids, potential, field)
        return potential, field


class Body:
    """A body near the pads: closed panels in its own frame. Without `permittivity` it is a conductor with a capacitance to ground
    `ground_pF` (zero: floating, infinite: grounded), otherwise a dielectric. It is prepared once for all poses."""

    def __init__(self, panels: Panels, ground_pF: float = PERSON_PF, permittivity: float | None = None):
        self.panels, self.ground = panels, ground_pF * 1e3 / FEMTOFARAD
        self.conductor = permittivity is None
        self.size = np.sqrt(panels.areas)
        self.points = panels.points()
        potential, field = panels.matrices()
        if permittivity is None:
            self._response = np.linalg.inv(potential)
            self._even = self._response.sum(axis=1)  # charges of the body alone at one volt
        else:
            bound = 2.0 * np.pi * (permittivity + 1.0) / (permittivity - 1.0) / panels.areas
            self._response = np.linalg.inv(np.diag(bound) - field)

    def charges(self, outside: Array) -> Array:
        """Charges (n,) that an outside potential (n,) puts on a conductor, or an outside normal field (n,) on a dielectric."""
        if not self.conductor:
            return self._response @ outside
        induced = -self._response @ outside
        if np.isinf(self.ground):
            return induced
        return induced - self._even * (induced.sum() / (self._even.sum() + self.ground))


def limb(mesh: Mesh, length: float = 1.0, girth: float = 1.0, stations: int = 46, around: int = 22) -> Body:
    """A person's limb from its closed mesh along x, scaled by `length` along x and `girth` across: the outermost points on rays
    from the middle of each section."""
    return Body(_loft((np.asarray(mesh.vertices) * (length, girth, girth))[mesh.faces], stations, around))


def shell(vertices: Array, stations: int = 16, around: int = 14) -> Panels:
    """Panels of a few centimetres on the convex hull of points (n, 3), such as a robot's link."""
    middle = vertices.mean(axis=0)
    axes = np.linalg.svd(vertices - middle, full_matrices=False)[2]
    axes[2] = np.cross(axes[0], axes[1])
    hull = ConvexHull((vertices - middle) @ axes.T)
    return Panels(_loft(hull.points[hull.simplices], stations, around).corners @ axes + middle)


def _loft(triangles: Array, stations: int, around: int) -> Panels:
    """Closed panels around the solid that triangles (n, 3, 3) enclose, in sections along x."""
    low, high = triangles[:, :, 0].min(), triangles[:, :, 0].max()
    inset = 0.01 * (high - low)
    x = np.linspace(low + inset, high - inset, stations + 1)
    angles = np.arange(around) * 2.0 * np.pi / around
    rings, middles = np.empty((len(x), around, 3)), np.empty((len(x), 3))
    for k, at in enumerate(x):
        middles[k], rings[k] = _section(triangles, at, angles)
    i, j = np.arange(around), (np.arange(around) + 1) % around
    sides = np.stack([rings[:-1, i], rings[:-1, j], rings[1:, j], rings[1:, i]], axis=2).reshape(-1, 4, 3)
    start, end = np.broadcast_to(middles[0], (around, 3)), np.broadcast_to(middles[-1], (around, 3))
    first = np.stack([start, rings[0, j], rings[0, i], rings[0, i]], axis=1)
    last = np.stack([end, rings[-1, i], rings[-1, j], rings[-1, j]], axis=1)
    return Panels(np.concatenate([sides, first, last]))


def _section(triangles: Array, at: float, angles: Array) -> tuple[Array, Array]:
    """Middle (3,) of the section of triangles (n, 3, 3) at x, and the outermost points (angles, 3) around it."""
    cut = triangles[(triangles[:, :, 0].min(axis=1) <= at) & (triangles[:, :, 0].max(axis=1) > at)]
    side = cut[:, :, 0] > at
    alone = np.where(side.sum(axis=1) == 1, side.argmax(axis=1), (~side).argmax(axis=1))  # the corner on its own side
    n = np.arange(len(cut))
    one, ends = cut[n, alone], []
    for step in (1, 2):
        other = cut[n, (alone + step) % 3]
        ends.append(one + (other - one) * ((at - one[:, :1]) / (other[:, :1] - one[:, :1])))
    p, q = ends[0][:, 1:], ends[1][:, 1:]
    both = np.concatenate([p, q])
    middle = 0.5 * (both.min(axis=0) + both.max(axis=0))
    direction = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    # ray s * direction meets p + t (q - p)
    edge, to = q - p, p - middle
    cross = direction[:, :1] * edge[:, 1] - direction[:, 1:] * edge[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (to[:, 0] * edge[:, 1] - to[:, 1] * edge[:, 0]) / cross
        t = (to[:, 0] * direction[:, 1:] - to[:, 1] * direction[:, :1]) / cross
    radius = np.where((t > -1e-6) & (t < 1.0 + 1e-6) & (s > 0.0), s, 0.0).max(axis=1)
    return np.append(at, middle), np.column_stack([np.full(len(angles), at), middle + radius[:, None] * direction])


class PadField:
    """The field of one pad type, its board prepared for bodies at any pose.

    backing: grounded panels behind the pad in its frame (the robot link that carries it). beside (b, 4, 4): poses of other boards
    of this type in the pad's frame. Their electrodes are held at zero, and so are their rings unless driven with the pad's.
    plate_pF: capacitance [pF] of all conductors together.
    """

    def __init__(
        self, kind: PadType, backing: Panels | None = None, beside: Sequence[Array] | Array = (), is_driven: bool = False
    ):
        self._kind = kind
        self.panels, owner = board, own = _board(kind)
        held = np.where((own == BARE) | (own == RING) & is_driven, own, GROUND)
        for T in beside:
            self.panels, owner = self.panels + Panels(rigid.apply(T, board.corners)), np.concatenate([owner, held])
        if backing is not None:
            backing = self._outside(backing)
            self.panels = self.panels + backing
            owner = np.concatenate([owner, np.full(len(backing), GROUND)])
        bare = owner == BARE
        system, field = self.panels.matrices()
        eps = kind.board.permittivity
        bound = 2.0 * np.pi * (eps + 1.0) / max(eps - 1.0, 1e-6) / self.panels.areas
        system[bare] = (np.diag(bound) - field)[bare]
        self._bare = np.flatnonzero(bare)
        self._inverse = np.linalg.inv(system)
        volts = np.stack([owner == k for k in (RING, *range(len(kind.electrodes)))], axis=1).astype(float)
        self._unit = self._inverse @ volts  # charges with the ring, or one electrode, at one volt
        self.plate_pF = float((self._inverse @ (~bare).astype(float)).sum() * FEMTOFARAD * 1e-3)

    def change(self, body: Body, T_pad_body: Array) -> Array:
        """Decrease (e,) [fF] of the capacitance between the ring and each electrode by a body at T_pad_body (4, 4)."""
        R, t = T_pad_body[:3, :3], T_pad_body[:3, 3]
        at_body, along_body, at_pad = self._coupling(body.points @ R.T + t, body.panels.normals @ R.T, body.size)
        seen = at_body if body.conductor else along_body
        charges = step = body.charges(seen @ self._unit[:, 0])
        for _ in range(60):  # what the body's charges induce on the pad acts back on the body
            step = body.charges(seen @ (self._inverse @ -(at_pad @ step)))
            charges = charges + step
            if np.abs(step).sum() < ACCURACY * np.abs(charges).sum():
                break
        return self._lost(at_body, charges)

    def change_of_links(self, panels: Panels) -> Array:
        """`change` (e,) [fF] by grounded panels in the pad's frame, which may come near or touch the backing."""
        at_body, _, at_pad = self._coupling(panels.points(), panels.normals, np.sqrt(panels.areas))
        system = panels.matrices()[0] - at_body @ (self._inverse @ at_pad)
        return self._lost(at_body, -np.linalg.solve(system, at_body @ self._unit[:, 0]))

    def sources(self, beside: Panels | None = None) -> tuple[Array, Array]:
        """Point charges that have the pad's field from a distance of a centimetre on: points (s, 3) and charges (s, 1 + e), with
        the ring or one of the electrodes at one volt. beside: grounded panels in the pad's frame, such as a link behind it; those
        in the place of the board are left out."""
        if beside is None:
            return self.panels.centroids, self._unit
        beside = self._outside(beside)
        at_body, _, at_pad = self._coupling(beside.points(), beside.normals, np.sqrt(beside.areas))
        acts_back = self._inverse @ at_pad
        charges = -np.linalg.solve(beside.matrices()[0] - at_body @ acts_back, at_body @ self._unit)
        return np.concatenate([self.panels.centroids, beside.centroids]), np.concatenate(
            [self._unit - acts_back @ charges, charges]
        )

    def _outside(self, backing: Panels) -> Panels:
        """The panels that are not in the place of the board."""
        half = np.append(np.array(self._kind.board.size) / 2.0 + CLEAR, np.inf)
        behind = backing.centroids[:, 2] > -self._kind.board.thickness - CLEAR
        return Panels(backing.corners[~((np.abs(backing.centroids) < half).all(axis=1) & behind)])

    def _coupling(self, points: Array, normals: Array, size: Array) -> tuple[Array, Array, Array]:
        """Coupling of a body's panels (points (n, 9, 3), normals (n, 3) and sizes (n,) in the pad's frame) and the pad's.

        Returns potential and normal field (n, pad) at the body by unit charges on the pad, and the terms (pad, n) that unit
        charges on the body add to the pad's equations.
        """
        n, pad = len(points), len(self.panels)
        at_body, along_body, bare = np.empty((n, pad)), np.empty((n, pad)), np.empty((len(self._bare), n))
        _couple(points, normals, size, self.panels.centroids, self.panels.normals, self._bare, at_body, bare, along_body)
        at_pad = at_body.T.copy()
        at_pad[self._bare] = -bare
        return at_body, along_body, at_pad

    def _lost(self, at_body: Array, charges: Array) -> Array:
        return np.asarray(-FEMTOFARAD * ((at_body @ self._unit[:, 1:]).T @ charges))


def _board(kind: PadType) -> tuple[Panels, NDArray[np.int64]]:
    """Panels of a board and the owner of each: copper and bare dielectric on the front (z = 0), the ground pour on the back.

    The charge bound on the rim and on the millimetre around the pour is left out: with it the capacitance of all conductors
    together is 2 % larger, and the change by a body 3 % smaller."""
    board, panels, owners = kind.board, [], []

    def add(corners: Array, owner: int) -> None:
        panels.append(corners)
        owners.append(np.full(len(corners), owner))

    arcs = [e for e in kind.electrodes.values() if e.arc is not None]
    ends = [math.radians(e.towards + side * e.half_angle) for e in arcs if e.half_angle < 180 for side in (-1, 1)]
    half_x, half_y = board.size[0] / 2.0, board.size[1] / 2.0
    corner = math.atan2(half_y, half_x)
    ends += [corner, math.pi - corner, math.pi + corner, -corner]
    full = _fine(np.array([*(ends := sorted(end % (2 * math.pi) for end in ends)), ends[0] + 2 * math.pi]), SECTOR)

    add(_polar(_graded(*kind.ring.radii, both=True), full, kind.ring.centre), RING)
    for k, e in enumerate(kind.electrodes.values()):
        if e.disc is not None:
            add(_polar(_graded(0.0, e.disc, both=False), full, e.centre), k)
        elif e.arc is not None:
            towards, half = math.radians(e.towards), math.radians(e.half_angle)
            angles = full if e.half_angle == 180 else towards + _graded(-half, half, both=True, parts=7)
            add(_polar(_graded(*e.arc, both=True), angles, e.centre), k)

    # Bare board in the front: the same sectors, between all radii that occur, wherever there is no copper.
    radii = {*kind.ring.radii, *(r for e in arcs for r in e.arc or ()), *(e.disc for e in kind.electrodes.values() if e.disc)}
    edges = np.array(sorted(r for r in radii if r < min(half_x, half_y)))
    inside = _polar(edges, full, kind.ring.centre)
    rim = np.minimum(half_x / np.maximum(np.abs(np.cos(full)), 1e-9), half_y / np.maximum(np.abs(np.sin(full)), 1e-9))
    outside = _between(np.full(len(full), edges[-1]), rim, full)
    bare = np.concatenate([inside, outside])
    add(bare[~_copper(kind, Panels(bare).centroids)], BARE)

    gx, gy, z = board.ground[0] / 2.0, board.ground[1] / 2.0, -board.thickness
    xs, ys = _graded(-gx, gx, both=True, parts=12), _graded(-gy, gy, both=True, parts=12)
    add(_grid(xs, ys, z) * (1.0, -1.0, 1.0), GROUND)  # seen from behind
    return Panels(np.concatenate(panels)), np.concatenate(owners)


def _copper(kind: PadType, points: Array) -> NDArray[np.bool_]:
    """Whether points (n, 3) of the front lie on copper."""
    out = _between_radii(points, kind.ring.centre, *kind.ring.radii)
    for e in kind.electrodes.values():
        if e.disc is not None:
            out |= _between_radii(points, e.centre, -1.0, e.disc)
        elif e.arc is not None:
            angle = np.arctan2(points[:, 1] - e.centre[1], points[:, 0] - e.centre[0]) - math.radians(e.towards)
            within = np.abs((angle + np.pi) % (2 * np.pi) - np.pi) <= math.radians(e.half_angle)
            out |= within & _between_radii(points, e.centre, *e.arc)
    return out


def _between_radii(points: Array, centre: tuple[float, float], inner: float, outer: float) -> NDArray[np.bool_]:
    radius = np.hypot(points[:, 0] - centre[0], points[:, 1] - centre[1])
    return (radius >= inner) & (radius <= outer)


def _graded(low: float, high: float, both: bool, parts: int = PARTS) -> Array:
    """Edges from low to high that are denser at the upper end, or at both: charge concentrates at the edge of copper."""
    s = np.linspace(0.0, 1.0, parts + 1)
    return low + (high - low) * (0.5 * (1.0 - np.cos(np.pi * s)) if both else np.sin(0.5 * np.pi * s))


def _fine(angles: Array, widest: float) -> Array:
    """Angles [rad] with more inserted between them, so that no step is wider than `widest`."""
    steps = [(a, b) for a, b in itertools.pairwise(angles) if b > a]
    parts = [np.linspace(a, b, math.ceil((b - a) / widest) + 1)[:-1] for a, b in steps]
    return np.append(np.concatenate(parts), angles[-1])


def _polar(radii: Array, angles: Array, centre: tuple[float, float]) -> Array:
    """Quadrilaterals (n, 4, 3) between radii and angles, their corners a little farther out: they have the area of the arc."""
    step = np.diff(angles).mean()
    swell = math.sqrt(step / math.sin(step))
    bands = itertools.pairwise(radii * swell)
    panels = [_between(np.full(len(angles), inner), np.full(len(angles), outer), angles) for inner, outer in bands]
    return np.concatenate(panels) + np.array([*centre, 0.0])


def _between(inner: Array, outer: Array, angles: Array) -> Array:
    """Quadrilaterals (n - 1, 4, 3) between two curves given by their radii (n,) at angles (n,); triangles where they meet."""
    low, high = (np.column_stack([r * np.cos(angles), r * np.sin(angles), np.zeros(len(r))]) for r in (inner, outer))
    return np.stack([low[:-1], high[:-1], high[1:], low[1:]], axis=1)


def _grid(xs: Array, ys: Array, z: float) -> Array:
    """Rectangles (n, 4, 3) between edges."""
    x0, y0 = (m.ravel() for m in np.meshgrid(xs[:-1], ys[:-1]))
    x1, y1 = (m.ravel() for m in np.meshgrid(xs[1:], ys[1:]))
    flat = np.full(len(x0), z)
    return np.stack([np.stack(c, axis=1) for c in ((x0, y0, flat), (x1, y0, flat), (x1, y1, flat), (x0, y1, flat))], axis=1)


@kernel("f8[n, 4, 3], f8[n, 3], f8[n], f8[n, 3], out f8[n, n], out f8[n, n]")
def _matrices(corners, normals, areas, points, potential, field):  # type: ignore[no-untyped-def]
    for j in range(len(corners)):
        nx, ny, nz = normals[j]
        for i in range(len(points)):
            px, py, pz = points[i]
            height = (px - corners[j, 0, 0]) * nx + (py - corners[j, 0, 1]) * ny + (pz - corners[j, 0, 2]) * nz
            total, ex, ey, ez, angle = 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(4):
                ax, ay, az = corners[j, k]
                bx, by, bz = corners[j, (k + 1) % 4]
                sx, sy, sz = bx - ax, by - ay, bz - az
                length = math.sqrt(sx * sx + sy * sy + sz * sz)
                if length < 1e-9:
                    continue
                sx, sy, sz = sx / length, sy / length, sz / length
                ux, uy, uz = sy * nz - sz * ny, sz * nx - sx * nz, sx * ny - sy * nx  # outwards in the plane
                ax, ay, az = ax - px, ay - py, az - pz
                begin = ax * sx + ay * sy + az * sz
                end = begin + length
                away = ax * ux + ay * uy + az * uz
                near = away * away + height * height
                first, last = math.sqrt(near + begin * begin), math.sqrt(near + end * end)
                if begin + end > 0.0:
                    stretch = math.log((last + end) / max(first + begin, 1e-15))
                else:
                    stretch = math.log((first - begin) / max(last - end, 1e-15))
                turn = math.atan2(away * end, near + abs(height) * last) - math.atan2(away * begin, near + abs(height) * first)
                total += away * stretch - abs(height) * turn
                angle += turn
                ex, ey, ez = ex + ux * stretch, ey + uy * stretch, ez + uz * stretch
            potential[i, j] = total / areas[j]
            side = math.copysign(angle, height) if abs(height) > 1e-9 else 0.0
            along = (ex + side * nx) * normals[i, 0] + (ey + side * ny) * normals[i, 1] + (ez + side * nz) * normals[i, 2]
            field[i, j] = 0.0 if i == j else along / areas[j]


@kernel("f8[n, 9, 3], f8[n, 3], f8[n], f8[p, 3], f8[p, 3], i8[b], out f8[n, p], out f8[b, n], out f8[n, p]", fastmath=True)
def _couple(points, normals, size, pad, pad_normals, bare, potential, field, onto):  # type: ignore[no-untyped-def]
    bare_row = np.full(len(pad), -1)
    for k in range(len(bare)):
        bare_row[bare[k]] = k
    for i in range(len(points)):
        mx, my, mz = points[i, 4]
        nearest = 1e9
        for j in range(len(pad)):
            nearest = min(nearest, (pad[j, 0] - mx) ** 2 + (pad[j, 1] - my) ** 2 + (pad[j, 2] - mz) ** 2)
        split = nearest < (NEAR * size[i]) ** 2
        for j in range(len(pad)):
            total, fx, fy, fz = 0.0, 0.0, 0.0, 0.0
            for k in range(9 if split else 1):
                k = k if split else 4
                dx, dy, dz = pad[j, 0] - points[i, k, 0], pad[j, 1] - points[i, k, 1], pad[j, 2] - points[i, k, 2]
                inverse = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
                cube = inverse * inverse * inverse
                total += inverse
                fx, fy, fz = fx + dx * cube, fy + dy * cube, fz + dz * cube
            share = 1.0 / 9.0 if split else 1.0
            potential[i, j] = total * share
            if bare_row[j] >= 0:
                field[bare_row[j], i] = share * (fx * pad_normals[j, 0] + fy * pad_normals[j, 1] + fz * pad_normals[j, 2])
            onto[i, j] = -share * (fx * normals[i, 0] + fy * normals[i, 1] + fz * normals[i, 2])
