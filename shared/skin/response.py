"""Response of the electrodes to a limb at a pose: small networks, fitted to the boundary-element field of a cell's pads.

One network serves one mounting: a pad type, with or without the robot's link behind it, and one limb. Its input is the position
of the limb's skin in front of the pad (sums over pieces of it, weighted by powers of their nearness, with their first and second
moments), and which part of the limb that is. Its output is the logarithm of the change of capacitance [fF] of every electrode.
The sign of the change is the same for every limb: what is grounded takes field lines away. `penumbra skin model` fits the
networks. A mounting is identified by its fingerprint alone.

The limb's size is two logarithms, of its length and girth relative to the cell file's target in its size.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from penumbra.shared.body import urdf
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import inner, kernel
from penumbra.shared.skin import layers
from penumbra.shared.skin.bearer import Bearer, Bearers

FOLDER = "skin"
"""Folder beside a cell file with its fitted networks."""
FEATURES = 36
RIM = 0.024
"""Distance [m] from the pad's middle of four more points that see the limb's nearness, where outer electrodes are."""
CORE = 0.01
"""Offset [m] of distances from the middle of the pad, which keeps them finite in contact."""
LANES = 16
"""Number of partial sums over the limb's skin: two or more vectors on every processor."""
ROUND = 0.02
"""Distance [m] from the limb's axis below which the direction around the limb fades out; it is undefined on the axis."""
SUMS = 20
"""Number of sums over the limb's skin from which the features are computed: see `_sums`."""
SLOPES = 8
"""Number of derivatives of a response: by the pose error along the pad's axes, and by the two sizes."""
_X, _Y, _Z, _FACING, _AREA, _SEEN, _NEAR, _ROOT, _RIGHT, _LEFT, _TOP, _BOTTOM = (LANES * row for row in range(12))
_MOVED, _ROWS = 12 * LANES, 12 + 4 * SLOPES
"""Layout of the working memory of `_sums` for LANES pieces: the derivatives of x, y, z and facing begin at _MOVED."""


@dataclass(frozen=True)
class Rest:
    """Changes at a mounting's electrodes due to the robot's other links: coefficients (e, terms) of a second-degree polynomial
    for the logarithm [fF], in joint angles scaled from middle -+ half (j,) [rad] to -1 to 1. With several mountings, the arrays
    have one more dimension in front."""

    coefficients: Array
    middle: Array
    half: Array

    def change(self, joints: ArrayLike) -> Array:
        """Changes (..., e) [fF] at joint angles (..., j), clipped to the range of the fit."""
        exponents: Array = np.einsum("...t,...et->...e", self.terms(np.asarray(joints)), self.coefficients)
        return np.exp(exponents)

    def terms(self, joints: Array) -> Array:
        """The polynomial's terms (..., terms)."""
        z = np.clip((joints - self.middle) / self.half, -1.0, 1.0)
        i, k = _pairs(z.shape[-1])
        return np.concatenate([np.ones((*z.shape[:-1], 1)), z, z[..., i] * z[..., k]], axis=-1)


REST = ("coefficients", "middle", "half")
"""The fields of `Rest`."""


@functools.cache
def _pairs(n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The indices of all pairs of n numbers."""
    return np.triu_indices(n)


@dataclass(frozen=True)
class Network:
    """Response of one mounting. points (7, k): pieces of the limb's skin, in its own frame: centre [m], normal, area [m^2]; mean
    and scale (FEATURES,) of the input; three weight matrices (rows are outputs) with biases; a linear skip (e, FEATURES); rest:
    contribution of the robot, where the pad sits on one; error: standard deviation of the relative error on held-out poses;
    bearer: contribution of the rest of the person, if the limb is the parametric forearm."""

    points: NDArray[np.float32]
    mean: Array
    scale: Array
    weights: tuple[Array, Array, Array]
    biases: tuple[Array, Array, Array]
    skip: Array
    rest: Rest | None = None
    error: float = 0.0
    bearer: Bearer | None = None

    @property
    def ends(self) -> Array:
        """Coordinates (2,) [m] of the limb's ends along its axis."""
        return np.array([self.points[0].min(), self.points[0].max()], dtype=float)

    def arrays(self) -> dict[str, Array]:
        """All arrays by name, for storage."""
        out: dict[str, Any] = {"points": self.points, "mean": self.mean, "scale": self.scale, "error": self.error}
        out |= {f"weight{i}": w for i, w in enumerate(self.weights)} | {f"bias{i}": b for i, b in enumerate(self.biases)}
        if self.rest is not None:
            out |= {"rest": self.rest.coefficients, "rest_middle": self.rest.middle, "rest_half": self.rest.half}
        if self.bearer is not None:
            out |= self.bearer.stored()
        return {**out, "skip": self.skip}

    @staticmethod
    def of(data) -> Network:  # type: ignore[no-untyped-def]
        """The inverse of `arrays`."""
        points = np.ascontiguousarray(data["points"], dtype=np.float32)
        weights, biases = (
            tuple(np.ascontiguousarray(data[f"{kind}{i}"], dtype=float) for i in range(3)) for kind in ("weight", "bias")
        )
        mean, scale, skip = (np.ascontiguousarray(data[name], dtype=float) for name in ("mean", "scale", "skip"))
        rest = Rest(*(data[name].astype(float) for name in ("rest", "rest_middle", "rest_half"))) if "rest" in data else None
        bearer = Bearer.of(data) if "bearer_mean" in data else None
        return Network(points, mean, scale, weights, biases, skip, rest, float(data["error"]), bearer)  # type: ignore[arg-type]


class Response:
    """Networks of all pads of a cell for one of its targets. Every pad has e electrodes, in the order of
    `shared.skin.layout.Skin`. size (2,): logs of the target's length and girth relative to the mesh. error (n,): standard
    deviation of the networks' error, as a share of the change.

    known: networks by fingerprint; default: those of `networks`. Raises CellError where a pad's mounting has no network, or pads
    differ in their number of electrodes.
    """

    def __init__(self, cell: cells.Cell, target: str, known: Mapping[str, Network] | None = None):
        known = networks(cell) if known is None else known
        prints = [fingerprint(cell, pad, target) for pad in cell.pads]
        missing = [pad for pad, own in zip(cell.pads, prints, strict=True) if own not in known]
        if missing:
            raise cells.CellError(
                f"cell {cell.name}: no field model for target {target} on the pads {', '.join(missing)}: their design, their "
                f"mounting or the limb is new. Fit it once: penumbra skin model --cell FILE"
            )
        different = sorted(set(prints))
        own = [known[each] for each in different]
        sizes = {len(each.skip) for each in own}
        if len(sizes) > 1:
            raise cells.CellError(f"cell {cell.name}: expected pads with equally many electrodes, got {sorted(sizes)}")
        self.electrodes = sizes.pop()
        size = cell.targets[target].size or cells.Size()
        self.size = np.log([size.length, size.girth])
        rests = {pad: rest for pad, each in enumerate(prints) if (rest := known[each].rest) is not None}
        self._moved = np.array(list(rests), np.int64)  # the pads in front of links
        self._rest = Rest(*(np.stack([getattr(rest, name) for rest in rests.values()]) for name in REST)) if rests else None
        self.error = np.repeat([known[each].error for each in prints], self.electrodes)
        self.index = np.array([different.index(each) for each in prints])
        bearers = [each.bearer for each in own if each.bearer is not None]
        self.bearers = Bearers(bearers, self.index) if len(bearers) == len(own) else None
        points, ends = np.stack([_whole(each.points) for each in own]), np.stack([each.ends for each in own])
        mean, scale = np.stack([each.mean for each in own]), np.stack([each.scale for each in own])
        first, second, third = (_stack([each.weights[i] for each in own]) for i in range(3))
        biases = tuple(_stack([each.biases[i] for each in own]) for i in range(3))
        inputs = (np.ascontiguousarray(weights.transpose(0, 2, 1)) for weights in (first, second))  # rows are inputs
        self.arrays = (self.index, points, ends, mean, scale, next(inputs), biases[0], next(inputs), biases[1], third,
                       biases[2], np.stack([each.skip for each in own]).astype(np.float32))  # fmt: skip

    def change(self, T_pads_target: Array, size: ArrayLike = (0.0, 0.0)) -> Array:
        """Changes (n,) [fF] due to the limb at T_pads_target (p, 4, 4) with its size (2,): log length, log girth."""
        out = np.empty(len(self.index) * self.electrodes)
        values(*self.arrays, np.ascontiguousarray(T_pads_target), self.size + size, out)
        return np.exp(out)

    def person(self, T_world_pads: Array, T_world_parts: Sequence[Array] | Array, size: ArrayLike = (0.0, 0.0)) -> Array:
        """Changes (n,) [fF] by a limb with its person. T_world_pads (p, 4, 4); T_world_parts (4, 4): the limb, and upper arm and
        torso if it has them, which count where they were fitted; size: as for `change`."""
        T_pads_parts: Array = np.linalg.inv(T_world_pads)[:, None] @ np.stack(tuple(T_world_parts))
        change = self.change(T_pads_parts[:, 0], size)
        if self.bearers is None or len(T_world_parts) == 1:
            return change
        return np.asarray(change * np.exp(self.bearers.logs(T_pads_parts, np.log(change))))

    def rest(self, joints: ArrayLike) -> Array:
        """Changes (n,) [fF] due to the robot's other links, also without a limb, at all joint angles (j,) of the cell."""
        out = np.zeros((len(self.index), self.electrodes))
        if self._rest is not None:
            out[self._moved] = self._rest.change(joints)
        return out.reshape(-1)

    def logs(self, T_pads_target: Array, size: ArrayLike = (0.0, 0.0)) -> tuple[Array, Array]:
        """Log changes (n,) and their derivatives (n, 8) by the target's pose, as in `rigid.perturb` but along the axes of each
        electrode's own pad, and by the two sizes."""
        out = np.empty(len(self.index) * self.electrodes)
        jacobian = np.empty((len(out), 8))
        derivatives(*self.arrays, np.ascontiguousarray(T_pads_target), self.size + size, out, jacobian)
        return out, jacobian


def fingerprint(cell: cells.Cell, pad: str, target: str, bare: bool = False) -> str:
    """Hash of what the response of a pad to a target depends on: copper and board, the limb, and unless `bare` the link
    behind."""
    own, aim = cell.pads[pad], cell.targets[target]
    kind = cell.pad_types[own.type]
    parts = {
        "board": kind.board.model_dump(),
        "ring": kind.ring.model_dump(),
        "electrodes": {name: e.model_dump(exclude={"law"}) for name, e in kind.electrodes.items()},
        "limb": cell.body.model_dump() if aim.mesh.startswith("body:") else _digest((cell.folder / aim.mesh).read_bytes()),
    }
    if own.backed and not bare:
        robot, _, link = own.link.partition("/")
        shapes = urdf.read(cells.urdf_path(cell.robots[robot], cell.folder)).link(link).shapes()
        parts["behind"] = {"shapes": shapes, "at": [own.position, own.rpy]}
    return _digest(json.dumps(parts, sort_keys=True).encode())


def networks(cell: cells.Cell) -> dict[str, Network]:
    """All fitted networks beside the cell file and among the built-in cells, by fingerprint."""
    out = {}
    for folder in (cells.BUILT_IN / FOLDER, cell.folder / FOLDER):
        for path in sorted(folder.glob("*.npz")):
            with np.load(path) as data:
                try:
                    out[str(data["fingerprint"])] = Network.of(data)
                except (KeyError, ValueError) as error:
                    raise cells.CellError(
                        f"{path}: expected a network of `penumbra skin model` ({error}); fit it again"
                    ) from None
    return out


def save(path: Path, network: Network, own: str) -> None:
    """Stores a network in single precision, for the mounting with this fingerprint."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {name: np.asarray(a, np.float32) for name, a in network.arrays().items()}
    np.savez_compressed(path, fingerprint=np.array(own), **arrays)  # type: ignore[arg-type]


def features(points: NDArray[np.float32], T_pad_limb: Array, size: Array) -> Array:
    """Input (n, FEATURES) of a network for limbs with these points at T_pad_limb (n, 4, 4), of sizes (n, 2)."""
    out = np.empty((len(T_pad_limb), FEATURES))
    ends = np.array([points[0].min(), points[0].max()], dtype=float)
    points = _whole(points)
    for k in range(len(out)):
        _features(points, ends, np.ascontiguousarray(T_pad_limb[k, :3, :3]), T_pad_limb[k, :3, 3].copy(), size[k], out[k])
    return out


def _whole(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Pieces of skin (7, k), padded with pieces of zero area to a multiple of LANES."""
    more = np.repeat(points[:, -1:], -points.shape[1] % LANES, axis=1)
    more[6] = 0.0
    return np.ascontiguousarray(np.concatenate([points, more], axis=1))


def _stack(arrays: list[Array]) -> NDArray[np.float32]:
    """Stacks arrays, padding smaller ones with zeros: a unit without weights changes nothing."""
    shape = np.max([each.shape for each in arrays], axis=0)
    padded = [np.pad(each, [(0, n - k) for n, k in zip(shape, each.shape, strict=True)]) for each in arrays]
    return np.stack(padded).astype(np.float32)


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


@inner
def _sums(points, R, t, along, across, has_slopes, out):  # type: ignore[no-untyped-def]
    """Sums over the skin before a pad, in single precision, into row 0 of out (1 + SLOPES, SUMS): for each of three powers of
    nearness the weight and its first moments along the pad's axes (12); for the middle one the second moments xx, yy, xy, zz; and
    the weight as seen from right, left, top and bottom of the pad. With has_slopes their derivatives go into the other rows."""
    px, py, pz, nx, ny, nz, area = points[0], points[1], points[2], points[3], points[4], points[5], points[6]
    rows = 1 + SLOPES if has_slopes else 1
    lanes = np.zeros(rows * SUMS * LANES, np.float32)  # of every LANES-th piece: vectors add up alike on all processors
    work = np.zeros(_ROWS * LANES, np.float32)  # one array, or the compiler suspects that one overwrites another
    half, one, two, three = np.float32(0.5), np.float32(1.0), np.float32(2.0), np.float32(3.0)
    twice, square, core = np.float32(2.0 * RIM), np.float32(RIM * RIM), np.float32(CORE * CORE)
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    t0, t1, t2 = t[0], t[1], t[2]
    for k in range(3):
        for i in range(LANES):
            work[_MOVED + (4 * k + k) * LANES + i] = one
    for block in range(px.shape[0] // LANES):
        for i in range(LANES):
            k = LANES * block + i
            a, b, c = px[k] * along, py[k] * across, pz[k] * across
            x = r00 * a + r01 * b + r02 * c + t0
            y = r10 * a + r11 * b + r12 * c + t1
            z = r20 * a + r21 * b + r22 * c + t2
            ux = r00 * nx[k] + r01 * ny[k] + r02 * nz[k]
            uy = r10 * nx[k] + r11 * ny[k] + r12 * nz[k]
            uz = r20 * nx[k] + r21 * ny[k] + r22 * nz[k]
            facing = x * ux + y * uy + z * uz
            far = x * x + y * y + z * z + core
            near = one / far
            root = math.sqrt(near)
            rim = far + square
            work[_X + i], work[_Y + i], work[_Z + i], work[_FACING + i], work[_AREA + i] = x, y, z, facing, area[k]
            work[_SEEN + i], work[_NEAR + i], work[_ROOT + i] = area[k] * (half - half * facing * root), near, root
            work[_RIGHT + i], work[_LEFT + i] = one / (rim - twice * x), one / (rim + twice * x)
            work[_TOP + i], work[_BOTTOM + i] = one / (rim - twice * y), one / (rim + twice * y)
        for i in range(LANES):
            x, y, z, near, seen = work[_X + i], work[_Y + i], work[_Z + i], work[_NEAR + i], work[_SEEN + i]
            right, left, top, bottom = work[_RIGHT + i], work[_LEFT + i], work[_TOP + i], work[_BOTTOM + i]
            w0 = seen * near * near
            w1 = w0 * near
            w2 = w1 * near * near
            lanes[i] += w0
            lanes[LANES + i] += w0 * x
            lanes[2 * LANES + i] += w0 * y
            lanes[3 * LANES + i] += w0 * z
            lanes[4 * LANES + i] += w1
            lanes[5 * LANES + i] += w1 * x
            lanes[6 * LANES + i] += w1 * y
            lanes[7 * LANES + i] += w1 * z
            lanes[8 * LANES + i] += w2
            lanes[9 * LANES + i] += w2 * x
            lanes[10 * LANES + i] += w2 * y
            lanes[11 * LANES + i] += w2 * z
            lanes[12 * LANES + i] += w1 * x * x
            lanes[13 * LANES + i] += w1 * y * y
            lanes[14 * LANES + i] += w1 * x * y
            lanes[15 * LANES + i] += w1 * z * z
            lanes[16 * LANES + i] += seen * right * right * right
            lanes[17 * LANES + i] += seen * left * left * left
            lanes[18 * LANES + i] += seen * top * top * top
            lanes[19 * LANES + i] += seen * bottom * bottom * bottom
        if not has_slopes:
            continue
        for i in range(LANES):
            k = LANES * block + i
            a, b, c = px[k] * along, py[k] * across, pz[k] * across
            ux = r00 * nx[k] + r01 * ny[k] + r02 * nz[k]
            uy = r10 * nx[k] + r11 * ny[k] + r12 * nz[k]
            uz = r20 * nx[k] + r21 * ny[k] + r22 * nz[k]
            qx, qy, qz = work[_X + i] - t0, work[_Y + i] - t1, work[_Z + i] - t2
            at = _MOVED + i
            work[at + 3 * LANES], work[at + 7 * LANES], work[at + 11 * LANES] = ux, uy, uz
            work[at + 13 * LANES], work[at + 14 * LANES], work[at + 15 * LANES] = -qz, qy, uy * t2 - uz * t1
            work[at + 16 * LANES], work[at + 18 * LANES], work[at + 19 * LANES] = qz, -qx, uz * t0 - ux * t2
            work[at + 20 * LANES], work[at + 21 * LANES], work[at + 23 * LANES] = -qy, qx, ux * t1 - uy * t0
            work[at + 24 * LANES], work[at + 25 * LANES], work[at + 26 * LANES] = r00 * a, r10 * a, r20 * a
            work[at + 27 * LANES] = a * nx[k]
            work[at + 28 * LANES], work[at + 29 * LANES] = r01 * b + r02 * c, r11 * b + r12 * c
            work[at + 30 * LANES], work[at + 31 * LANES] = r21 * b + r22 * c, b * ny[k] + c * nz[k]
        for p in range(SLOPES):
            by, own = _MOVED + 4 * p * LANES, (1 + p) * SUMS * LANES
            for i in range(LANES):
                x, y, z, near, seen = work[_X + i], work[_Y + i], work[_Z + i], work[_NEAR + i], work[_SEEN + i]
                right, left, top, bottom = work[_RIGHT + i], work[_LEFT + i], work[_TOP + i], work[_BOTTOM + i]
                dx, dy, dz, turn = work[by + i], work[by + LANES + i], work[by + 2 * LANES + i], work[by + 3 * LANES + i]
                d_far = two * (x * dx + y * dy + z * dz)
                share = -near * d_far  # the relative change of the nearness
                d_seen = -half * work[_AREA + i] * work[_ROOT + i] * (turn + half * work[_FACING + i] * share)
                w0, d0 = seen * near * near, (d_seen + two * seen * share) * near * near
                w1, d1 = w0 * near, (d_seen + three * seen * share) * near * near * near
                cube = near * near * near
                w2, d2 = w1 * near * near, (d_seen + (two + three) * seen * share) * cube * near * near
                lanes[own + i] += d0
                lanes[own + LANES + i] += d0 * x + w0 * dx
                lanes[own + 2 * LANES + i] += d0 * y + w0 * dy
                lanes[own + 3 * LANES + i] += d0 * z + w0 * dz
                lanes[own + 4 * LANES + i] += d1
                lanes[own + 5 * LANES + i] += d1 * x + w1 * dx
                lanes[own + 6 * LANES + i] += d1 * y + w1 * dy
                lanes[own + 7 * LANES + i] += d1 * z + w1 * dz
                lanes[own + 8 * LANES + i] += d2
                lanes[own + 9 * LANES + i] += d2 * x + w2 * dx
                lanes[own + 10 * LANES + i] += d2 * y + w2 * dy
                lanes[own + 11 * LANES + i] += d2 * z + w2 * dz
                lanes[own + 12 * LANES + i] += (d1 * x + two * w1 * dx) * x
                lanes[own + 13 * LANES + i] += (d1 * y + two * w1 * dy) * y
                lanes[own + 14 * LANES + i] += d1 * x * y + w1 * (dx * y + x * dy)
                lanes[own + 15 * LANES + i] += (d1 * z + two * w1 * dz) * z
                lanes[own + 16 * LANES + i] += (d_seen - three * seen * right * (d_far - twice * dx)) * right * right * right
                lanes[own + 17 * LANES + i] += (d_seen - three * seen * left * (d_far + twice * dx)) * left * left * left
                lanes[own + 18 * LANES + i] += (d_seen - three * seen * top * (d_far - twice * dy)) * top * top * top
                lanes[own + 19 * LANES + i] += (d_seen - three * seen * bottom * (d_far + twice * dy)) * bottom * bottom * bottom
    for row in range(rows):
        for i in range(SUMS):
            total = np.float32(0.0)
            for lane in range(LANES):
                total += lanes[(row * SUMS + i) * LANES + lane]
            out[row, i] = total


@inner
def _described(points, ends, R, t, size, has_slopes, sums, out, by):  # type: ignore[no-untyped-def]
    """The input of a network, out (FEATURES,), for a limb at R (3, 3), t (3,) before a pad, of this size (2,); with has_slopes
    its derivatives by (FEATURES, SLOPES). sums (1 + SLOPES, SUMS): memory."""
    along = math.exp(size[0])
    single = R.astype(np.float32), t.astype(np.float32)
    _sums(points, *single, np.float32(along), np.float32(math.exp(size[1])), has_slopes, sums)
    s = sums[0]
    for first in (0, 4, 8):
        weight = s[first]
        x, y, z = s[first + 1] / weight, s[first + 2] / weight, s[first + 3] / weight
        far = math.sqrt(x * x + y * y + z * z)
        away = far + CORE
        out[first] = math.log(weight)
        out[first + 1], out[first + 2], out[first + 3] = x / away, y / away, z / away
        spread = (s[12] + s[13] + s[15]) / weight
        if first == 4:
            out[12], out[13] = (s[12] / weight - x * x) / spread, (s[13] / weight - y * y) / spread
            out[14], out[15] = (s[14] / weight - x * y) / spread, (s[15] / weight - z * z) / spread
        for p in range(SLOPES if has_slopes else 0):
            d = sums[1 + p]
            d_log = d[first] / weight
            dx, dy, dz = d[first + 1] / weight - x * d_log, d[first + 2] / weight - y * d_log, d[first + 3] / weight - z * d_log
            d_away = (x * dx + y * dy + z * dz) / (far + 1e-12) / away
            by[first, p] = d_log
            by[first + 1, p], by[first + 2, p] = (dx - x * d_away) / away, (dy - y * d_away) / away
            by[first + 3, p] = (dz - z * d_away) / away
            if first == 4:
                d_spread = ((d[12] + d[13] + d[15]) / weight - spread * d_log) / spread
                by[12, p] = ((d[12] - s[12] * d_log) / weight - 2.0 * x * dx) / spread - out[12] * d_spread
                by[13, p] = ((d[13] - s[13] * d_log) / weight - 2.0 * y * dy) / spread - out[13] * d_spread
                by[14, p] = ((d[14] - s[14] * d_log) / weight - x * dy - y * dx) / spread - out[14] * d_spread
                by[15, p] = ((d[15] - s[15] * d_log) / weight - 2.0 * z * dz) / spread - out[15] * d_spread
    out[16], out[17] = size[0], size[1]
    out[18], out[19] = out[4] * out[7], out[4] * out[0]
    for row in range(3):  # the limb's axis, and its way round, in the pad's frame
        out[20 + row] = R[row, 0]
        out[23 + row] = R[row, 1]
    # the pad's origin in the limb's frame: which part of the limb it sees, and from which side
    x = -(R[0, 0] * t[0] + R[1, 0] * t[1] + R[2, 0] * t[2])
    y = -(R[0, 1] * t[0] + R[1, 1] * t[1] + R[2, 1] * t[2])
    z = -(R[0, 2] * t[0] + R[1, 2] * t[1] + R[2, 2] * t[2])
    low, high = ends[0] * along, ends[1] * along
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    out[26] = math.tanh((x - middle) / half)
    away = math.sqrt(y * y + z * z + ROUND * ROUND)
    cosine, sine = y / away, z / away
    out[27], out[28] = cosine, sine
    out[29], out[30] = cosine * cosine - sine * sine, 2.0 * cosine * sine
    out[31] = out[4] * out[26]
    for side in range(4):
        out[32 + side] = math.log(s[16 + side]) - out[4]
    if not has_slopes:
        return
    for p in range(SLOPES):
        for i in range(16, 32):
            by[i, p] = 0.0
        dx, dy, dz = 0.0, 0.0, 0.0
        if p < 3:
            dx, dy, dz = -R[p, 0], -R[p, 1], -R[p, 2]
        elif p < 6:  # a turn about axis p - 3 of the pad: rows a and b mix
            a, b = (p - 2) % 3, (p - 1) % 3
            by[20 + a, p], by[20 + b, p] = -R[b, 0], R[a, 0]
            by[23 + a, p], by[23 + b, p] = -R[b, 1], R[a, 1]
            dx = R[b, 0] * t[a] - R[a, 0] * t[b]
            dy = R[b, 1] * t[a] - R[a, 1] * t[b]
            dz = R[b, 2] * t[a] - R[a, 2] * t[b]
        else:
            by[10 + p, p] = 1.0
            dx = -x if p == 6 else 0.0  # the limb's middle and half length grow alike
        by[26, p] = (1.0 - out[26] * out[26]) * dx / half
        d_away = cosine * dy + sine * dz
        d_cosine, d_sine = (dy - cosine * d_away) / away, (dz - sine * d_away) / away
        by[27, p], by[28, p] = d_cosine, d_sine
        by[29, p], by[30, p] = 2.0 * (cosine * d_cosine - sine * d_sine), 2.0 * (d_cosine * sine + cosine * d_sine)
        by[18, p] = by[4, p] * out[7] + out[4] * by[7, p]
        by[19, p] = by[4, p] * out[0] + out[4] * by[0, p]
        by[31, p] = by[4, p] * out[26] + out[4] * by[26, p]
        for side in range(4):
            by[32 + side, p] = sums[1 + p, 16 + side] / s[16 + side] - by[4, p]


@kernel("f4[7, k], f8[2], f8[3, 3], f8[3], f8[2], out f8[36]")
def _features(points, ends, R, t, size, out):  # type: ignore[no-untyped-def]
    _described(points, ends, R, t, size, False, np.empty((1, SUMS)), out, np.empty((0, 0)))


@inner
def _outputs(last, bias, skip, second, x, out):  # type: ignore[no-untyped-def]
    """The network's output (e,): last (e, n) on its second layer (n,), skip (e, FEATURES) on its input."""
    for i in range(len(out)):
        out[i] = layers.dot(last[i], second) + bias[i] + layers.dot(skip[i], x)


ARRAYS = """i8[p], f4[m, 7, k], f8[m, 2], f8[m, 36], f8[m, 36],
    f4[m, 36, a], f4[m, a], f4[m, a, b], f4[m, b], f4[m, e, b], f4[m, e], f4[m, e, 36]"""
"""Signature of `Response.arrays` for kernels: m networks for p pads, with a and b units in their layers and e electrodes."""


@kernel(f"{ARRAYS}, f8[p, 4, 4], f8[2], out f8[n]")
def values(index, points, ends, mean, scale, w0, b0, w1, b1, w2, b2, skip, T, size, out):  # type: ignore[no-untyped-def]
    """Log changes of all electrodes, into out (n,). Arguments: `Response.arrays`, T_pads_target (p, 4, 4), size (2,)."""
    e = skip.shape[1]
    exact, x = np.empty(FEATURES), np.empty(FEATURES, np.float32)
    first, second = np.empty(w0.shape[2], np.float32), np.empty(w1.shape[2], np.float32)
    sums, nothing = np.empty((1, SUMS)), np.empty((0, 0))
    for p in range(len(index)):
        m = index[p]
        _described(points[m], ends[m], T[p, :3, :3], T[p, :3, 3], size, False, sums, exact, nothing)
        for i in range(FEATURES):
            x[i] = (exact[i] - mean[m, i]) / scale[m, i]
        layers.bent(w0[m], b0[m], x, first)
        layers.bent(w1[m], b1[m], first, second)
        _outputs(w2[m], b2[m], skip[m], second, x, out[p * e : (p + 1) * e])


@kernel(f"{ARRAYS}, f8[p, 4, 4], f8[2], out f8[n], out f8[n, 8]")
def derivatives(index, points, ends, mean, scale, w0, b0, w1, b1, w2, b2, skip, T, size, out, jacobian):  # type: ignore[no-untyped-def]
    """The same with derivatives, into jacobian (n, 8): see `Response.logs`."""
    e = skip.shape[1]
    exact, x, by = np.empty(FEATURES), np.empty(FEATURES, np.float32), np.empty((FEATURES, SLOPES))
    first, second = np.empty(w0.shape[2], np.float32), np.empty(w1.shape[2], np.float32)
    shallow, deep = np.empty((e, w0.shape[2]), np.float32), np.empty((e, w1.shape[2]), np.float32)
    sums = np.empty((1 + SLOPES, SUMS))
    for p in range(len(index)):
        m = index[p]
        _described(points[m], ends[m], T[p, :3, :3], T[p, :3, 3], size, True, sums, exact, by)
        for i in range(FEATURES):
            x[i] = (exact[i] - mean[m, i]) / scale[m, i]
        layers.bent(w0[m], b0[m], x, first)
        layers.bent(w1[m], b1[m], first, second)
        _outputs(w2[m], b2[m], skip[m], second, x, out[p * e : (p + 1) * e])
        layers.slopes(w1[m], w2[m], first, second, deep, shallow)
        jacobian[p * e : (p + 1) * e] = 0.0
        for i in range(FEATURES):
            for electrode in range(e):
                slope = (layers.dot(w0[m, i], shallow[electrode]) + skip[m, electrode, i]) / scale[m, i]
                for k in range(SLOPES):
                    jacobian[p * e + electrode, k] += slope * by[i, k]
