"""What a limb at a pose changes at the electrodes: small networks, fitted to the boundary-element field of a cell's pads.

One network serves one mounting: a pad type, with or without the robot's link behind it, and one limb. It sees how the limb's skin
lies before the pad (sums over pieces of it, weighted by powers of their nearness, with their first and second moments) and which
part of the limb that is, and gives the logarithm of the change of capacitance [fF] of every electrode, whose sign is the same for
every limb: what is grounded takes field lines away.
`penumbra skin model` fits the networks; a mounting is known by its fingerprint wherever the files come from.

The limb's size is two logarithms, of the factors by which it is longer and thicker than the cell file's target in its size.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.body import urdf
from shared.cell import description as cells
from shared.native import inner, kernel

Array = NDArray[np.float64]

FOLDER = "skin"
"""Beside a cell file: where its fitted networks are."""
FEATURES = 36
RIM = 0.024
"""The limb's nearness is also seen from four points so far [m] from the pad's middle, where outer electrodes are."""
CORE = 0.01
"""Added to distances from the pad's middle [m]: in contact nothing becomes infinite."""
LANES = 16
"""Sums over the limb's skin are as many partial sums: two or more vectors on every processor."""
ROUND = 0.02
"""The side from which the limb is seen fades out this near [m] to its axis, where it has no meaning."""
STEPS = np.array([3e-4, 3e-4, 3e-4, 2e-3, 2e-3, 2e-3, 5e-3, 5e-3])
"""Steps [m, rad, -] of the features' numerical derivatives: single precision carries them."""


@dataclass(frozen=True)
class Rest:
    """What the other links of the robot change at a mounting's electrodes: coefficients (e, terms) of a second-degree polynomial
    for the logarithm [fF], in joint angles that run from -1 to 1 within middle -+ half (j,) [rad]."""

    coefficients: Array
    middle: Array
    half: Array

    def change(self, joints: ArrayLike) -> Array:
        """Changes (..., e) [fF] at joint angles (..., j); beyond the range as at its end."""
        return np.exp(self.terms(np.asarray(joints)) @ self.coefficients.T)

    def terms(self, joints: Array) -> Array:
        """The polynomial's terms (..., terms)."""
        z = np.clip((joints - self.middle) / self.half, -1.0, 1.0)
        i, k = np.triu_indices(z.shape[-1])
        return np.concatenate([np.ones((*z.shape[:-1], 1)), z, z[..., i] * z[..., k]], axis=-1)


@dataclass(frozen=True)
class Network:
    """The response of one mounting. points (7, k): the limb's skin in pieces, in its own frame: centre [m], normal, area [m^2];
    mean and scale (FEATURES,) of the input; three weight matrices (rows are outputs) with biases; a linear skip (e, FEATURES);
    rest: the robot's own share, where the pad sits on one; error: standard deviation of the relative error on held-out poses."""

    points: NDArray[np.float32]
    mean: Array
    scale: Array
    weights: tuple[Array, Array, Array]
    biases: tuple[Array, Array, Array]
    skip: Array
    rest: Rest | None = None
    error: float = 0.0

    @property
    def ends(self) -> Array:
        """Where the limb begins and ends along its axis (2,) [m]."""
        return np.array([self.points[0].min(), self.points[0].max()], dtype=float)

    def arrays(self) -> dict[str, Array]:
        """Everything under names, to be stored."""
        out: dict[str, Any] = {"points": self.points, "mean": self.mean, "scale": self.scale, "error": self.error}
        out |= {f"weight{i}": w for i, w in enumerate(self.weights)} | {f"bias{i}": b for i, b in enumerate(self.biases)}
        if self.rest is not None:
            out |= {"rest": self.rest.coefficients, "rest_middle": self.rest.middle, "rest_half": self.rest.half}
        return {**out, "skip": self.skip}

    @staticmethod
    def of(data) -> Network:  # type: ignore[no-untyped-def]
        """From what `arrays` gave."""
        points = np.ascontiguousarray(data["points"], dtype=np.float32)
        weights, biases = (
            tuple(np.ascontiguousarray(data[f"{kind}{i}"], dtype=float) for i in range(3)) for kind in ("weight", "bias")
        )
        mean, scale, skip = (np.ascontiguousarray(data[name], dtype=float) for name in ("mean", "scale", "skip"))
        rest = Rest(*(data[name].astype(float) for name in ("rest", "rest_middle", "rest_half"))) if "rest" in data else None
        return Network(points, mean, scale, weights, biases, skip, rest, float(data["error"]))  # type: ignore[arg-type]


class Response:
    """The networks of all pads of a cell for one of its targets; every pad has e electrodes, in the order of
    `shared.skin.layout.Skin`. error (n,): standard deviation of what they get wrong, as a share of the change.

    Raises CellError where a pad's mounting has no network, or pads differ in their number of electrodes.
    """

    def __init__(self, cell: cells.Cell, target: str):
        known = networks(cell)
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
            raise cells.CellError(f"cell {cell.name}: pads with equally many electrodes expected, {sorted(sizes)} came")
        self.electrodes = sizes.pop()
        size = cell.targets[target].size or cells.Size()
        self._size = np.log([size.length, size.girth])
        self._rest = [known[each].rest for each in prints]
        self.error = np.repeat([known[each].error for each in prints], self.electrodes)
        self.index = np.array([different.index(each) for each in prints])
        points, ends = np.stack([_whole(each.points) for each in own]), np.stack([each.ends for each in own])
        mean, scale = np.stack([each.mean for each in own]), np.stack([each.scale for each in own])
        first, second, third = (_stack([each.weights[i] for each in own]) for i in range(3))
        biases = tuple(_stack([each.biases[i] for each in own]) for i in range(3))
        self.arrays = (self.index, points, ends, mean, scale, first, biases[0], second, biases[1], third,
                       biases[2], np.stack([each.skip for each in own]))  # fmt: skip

    def change(self, T_pads_target: Array, size: ArrayLike = (0.0, 0.0)) -> Array:
        """Changes (n,) [fF] by the limb at T_pads_target (p, 4, 4), with its size (2,): log length, log girth."""
        out = np.empty(len(self.index) * self.electrodes)
        values(*self.arrays, np.ascontiguousarray(T_pads_target), self._size + size, out)
        return np.exp(out)

    def rest(self, joints: ArrayLike) -> Array:
        """Changes (n,) [fF] by the robot's other links at all joint angles (j,) of the cell: there also without a limb."""
        none = np.zeros(self.electrodes)
        return np.concatenate([none if each is None else each.change(joints) for each in self._rest])

    def logs(self, T_pads_target: Array, size: ArrayLike = (0.0, 0.0)) -> tuple[Array, Array]:
        """Log changes (n,) and their derivatives (n, 8) by the target's pose, as `geometry.perturb` moves it but along the axes
        of each electrode's own pad, and by the two sizes."""
        out = np.empty(len(self.index) * self.electrodes)
        jacobian = np.empty((len(out), 8))
        derivatives(*self.arrays, np.ascontiguousarray(T_pads_target), self._size + size, out, jacobian)
        return out, jacobian


def fingerprint(cell: cells.Cell, pad: str, target: str, bare: bool = False) -> str:
    """What the response of a pad to a target depends on: copper and board, the limb, and unless `bare` the link behind."""
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
                    raise cells.CellError(f"{path}: a network of penumbra skin model expected ({error}): fit it again") from None
    return out


def save(path: Path, network: Network, own: str) -> None:
    """Store a network for the mounting with this fingerprint, in half the memory."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {name: np.asarray(a, np.float32) for name, a in network.arrays().items()}
    np.savez_compressed(path, fingerprint=np.array(own), **arrays)  # type: ignore[arg-type]


def features(points: NDArray[np.float32], T_pad_limb: Array, size: Array) -> Array:
    """Input (n, FEATURES) of a network for limbs of these points at T_pad_limb (n, 4, 4), of sizes (n, 2)."""
    out = np.empty((len(T_pad_limb), FEATURES))
    ends = np.array([points[0].min(), points[0].max()], dtype=float)
    points = _whole(points)
    for k in range(len(out)):
        _features(points, ends, np.ascontiguousarray(T_pad_limb[k, :3, :3]), T_pad_limb[k, :3, 3].copy(), size[k], out[k])
    return out


def _whole(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Pieces of skin (7, k), with some without area at the end, so that there are a multiple of LANES."""
    more = np.repeat(points[:, -1:], -points.shape[1] % LANES, axis=1)
    more[6] = 0.0
    return np.ascontiguousarray(np.concatenate([points, more], axis=1))


def _stack(arrays: list[Array]) -> Array:
    """Arrays in one, smaller ones filled up with zeros: a unit without weights changes nothing."""
    shape = np.max([each.shape for each in arrays], axis=0)
    return np.stack([np.pad(each, [(0, n - k) for n, k in zip(shape, each.shape, strict=True)]) for each in arrays])


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


@inner
def _sums(px, py, pz, nx, ny, nz, area, R, t, along, across, core, out):  # type: ignore[no-untyped-def]
    """Sums over the skin before a pad, into out: for each of three powers of nearness the weight and its first moments along the
    pad's axes (12), for the middle one the second moments xx, yy, xy, zz, and from 32 on the weight as seen from right, left, top
    and bottom of the pad. All in single precision, in one loop."""
    lanes = np.zeros((20, LANES), np.float32)  # sums of every LANES-th piece: vectors add up alike on all processors
    twice, square = np.float32(2.0 * RIM), np.float32(RIM * RIM)
    half, one = np.float32(0.5), np.float32(1.0)
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    t0, t1, t2 = t[0], t[1], t[2]
    for block in range(px.shape[0] // LANES):
        for lane in range(LANES):
            k = LANES * block + lane
            a, b, c = px[k] * along, py[k] * across, pz[k] * across
            x = r00 * a + r01 * b + r02 * c + t0
            y = r10 * a + r11 * b + r12 * c + t1
            z = r20 * a + r21 * b + r22 * c + t2
            lx, ly, lz = r00 * x + r10 * y + r20 * z, r01 * x + r11 * y + r21 * z, r02 * x + r12 * y + r22 * z
            facing = lx * nx[k] + ly * ny[k] + lz * nz[k]
            far = x * x + y * y + z * z + core
            near = one / far
            seen = area[k] * (half - half * facing * math.sqrt(near))
            w0 = seen * near * near
            w1 = w0 * near
            w2 = w1 * near * near
            rim = far + square
            right, left = one / (rim - twice * x), one / (rim + twice * x)
            top, bottom = one / (rim - twice * y), one / (rim + twice * y)
            lanes[0, lane] += w0
            lanes[1, lane] += w0 * x
            lanes[2, lane] += w0 * y
            lanes[3, lane] += w0 * z
            lanes[4, lane] += w1
            lanes[5, lane] += w1 * x
            lanes[6, lane] += w1 * y
            lanes[7, lane] += w1 * z
            lanes[8, lane] += w2
            lanes[9, lane] += w2 * x
            lanes[10, lane] += w2 * y
            lanes[11, lane] += w2 * z
            lanes[12, lane] += w1 * x * x
            lanes[13, lane] += w1 * y * y
            lanes[14, lane] += w1 * x * y
            lanes[15, lane] += w1 * z * z
            lanes[16, lane] += seen * right * right * right
            lanes[17, lane] += seen * left * left * left
            lanes[18, lane] += seen * top * top * top
            lanes[19, lane] += seen * bottom * bottom * bottom
    for i in range(20):
        total = np.float32(0.0)
        for lane in range(LANES):
            total += lanes[i, lane]
        out[i if i < 16 else 16 + i] = total


@kernel("f4[7, k], f8[2], f8[3, 3], f8[3], f8[2], out f8[36]")
def _features(points, ends, R, t, size, out):  # type: ignore[no-untyped-def]
    length, girth = math.exp(size[0]), math.exp(size[1])
    along, across, core = np.float32(length), np.float32(girth), np.float32(CORE * CORE)
    single = R.astype(np.float32), t.astype(np.float32)
    rows = (
        points[0],
        points[1],
        points[2],
        points[3],
        points[4],
        points[5],
        points[6],
    )  # each contiguous, or nothing is vectorised
    _sums(*rows, *single, along, across, core, out)
    xx, yy, xy, zz = out[12], out[13], out[14], out[15]
    for first in (0, 4, 8):
        weight = out[first]
        x, y, z = out[first + 1] / weight, out[first + 2] / weight, out[first + 3] / weight
        if first == 4:
            spread = (xx + yy + zz) / weight
            out[12], out[13] = (xx / weight - x * x) / spread, (yy / weight - y * y) / spread
            out[14], out[15] = (xy / weight - x * y) / spread, (zz / weight - z * z) / spread
        away = math.sqrt(x * x + y * y + z * z) + CORE
        out[first] = math.log(weight)
        out[first + 1], out[first + 2], out[first + 3] = x / away, y / away, z / away
    out[16], out[17] = size[0], size[1]
    out[18], out[19] = out[4] * out[7], out[4] * out[0]
    for row in range(3):  # the limb's axis, and its way round, in the pad's frame
        out[20 + row] = R[row, 0]
        out[23 + row] = R[row, 1]
    # the pad's origin in the limb's frame: which part of the limb it sees, and from which side
    x = -(R[0, 0] * t[0] + R[1, 0] * t[1] + R[2, 0] * t[2])
    y = -(R[0, 1] * t[0] + R[1, 1] * t[1] + R[2, 1] * t[2])
    z = -(R[0, 2] * t[0] + R[1, 2] * t[1] + R[2, 2] * t[2])
    low, high = ends[0] * length, ends[1] * length
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    out[26] = math.tanh((x - middle) / half)
    away = math.sqrt(y * y + z * z + ROUND * ROUND)
    c, s = y / away, z / away
    out[27], out[28] = c, s
    out[29], out[30] = c * c - s * s, 2.0 * c * s
    out[31] = out[4] * out[26]
    for side in range(32, 36):
        out[side] = math.log(out[side]) - out[4]


@inner(fastmath=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    """The scalar product of two vectors (n,)."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@inner
def _back(gradients, slopes, weights, out):  # type: ignore[no-untyped-def]
    """Adds (gradients * slopes) @ weights to out (e, m), for gradients (e, n), slopes (n,) and weights (n, m), four rows of the
    weights at a time."""
    n = len(weights)
    for i in range(0, n - n % 4, 4):
        for row in range(len(out)):
            f0, f1 = gradients[row, i] * slopes[i], gradients[row, i + 1] * slopes[i + 1]
            f2, f3 = gradients[row, i + 2] * slopes[i + 2], gradients[row, i + 3] * slopes[i + 3]
            for j in range(out.shape[1]):
                out[row, j] += f0 * weights[i, j] + f1 * weights[i + 1, j] + f2 * weights[i + 2, j] + f3 * weights[i + 3, j]
    for i in range(n - n % 4, n):
        for row in range(len(out)):
            f0 = gradients[row, i] * slopes[i]
            for j in range(out.shape[1]):
                out[row, j] += f0 * weights[i, j]


@inner
def _layer(weights, bias, x, out):  # type: ignore[no-untyped-def]
    """A layer's output (n,) for an input (m,): tanh(weights x + bias)."""
    for i in range(len(out)):
        out[i] = math.tanh(_dot(weights[i], x) + bias[i])


@inner
def _changes(w2, b2, skip, second, x, out):  # type: ignore[no-untyped-def]
    """The network's output (e,) for its second layer's and the skip's input."""
    for i in range(len(out)):
        out[i] = _dot(w2[i], second) + b2[i] + _dot(skip[i], x)


_ARRAYS = """i8[p], f4[m, 7, k], f8[m, 2], f8[m, 36], f8[m, 36],
    f8[m, a, 36], f8[m, a], f8[m, b, a], f8[m, b], f8[m, e, b], f8[m, e], f8[m, e, 36]"""
"""`Response.arrays`, for the kernels' signatures: m networks of p pads, with a and b units in their layers and e electrodes."""


@kernel(f"{_ARRAYS}, f8[p, 4, 4], f8[2], out f8[n]")
def values(index, points, ends, mean, scale, w0, b0, w1, b1, w2, b2, skip, T, size, out):  # type: ignore[no-untyped-def]
    """Log changes of all electrodes, into out (n,). Arguments: `Response.arrays`, T_pads_target (p, 4, 4), size (2,)."""
    e = skip.shape[1]
    x, first, second = np.empty(FEATURES), np.empty(w0.shape[1]), np.empty(w1.shape[1])
    for p in range(len(index)):
        m = index[p]
        _features(points[m], ends[m], T[p, :3, :3], T[p, :3, 3], size, x)
        for i in range(FEATURES):
            x[i] = (x[i] - mean[m, i]) / scale[m, i]
        _layer(w0[m], b0[m], x, first)
        _layer(w1[m], b1[m], first, second)
        _changes(w2[m], b2[m], skip[m], second, x, out[p * e : (p + 1) * e])


@kernel(f"{_ARRAYS}, f8[p, 4, 4], f8[2], out f8[n], out f8[n, 8]")
def derivatives(index, points, ends, mean, scale, w0, b0, w1, b1, w2, b2, skip, T, size, out, jacobian):  # type: ignore[no-untyped-def]
    """The same with derivatives, into jacobian (n, 8): see `Response.logs`."""
    e = skip.shape[1]
    x, high, low = np.empty(FEATURES), np.empty(FEATURES), np.empty(FEATURES)
    first, second, ones = np.empty(w0.shape[1]), np.empty(w1.shape[1]), np.ones(FEATURES)
    by, back, deep = np.empty((FEATURES, 8)), np.empty((e, FEATURES)), np.empty((e, w0.shape[1]))
    R, t, other = np.empty((3, 3)), np.empty(3), np.empty(2)
    for p in range(len(index)):
        m = index[p]
        _features(points[m], ends[m], T[p, :3, :3], T[p, :3, 3], size, x)
        for k in range(8):
            for side in (1, -1):
                step = side * STEPS[k]
                R[:], t[:], other[:] = T[p, :3, :3], T[p, :3, 3], size
                if k < 3:
                    t[k] += step
                elif k < 6:  # a turn about axis k - 3 of the pad: rows a and b mix
                    a, b = (k - 2) % 3, (k - 1) % 3
                    for column in range(3):
                        va, vb = T[p, a, column], T[p, b, column]
                        R[a, column], R[b, column] = va - step * vb, vb + step * va
                else:
                    other[k - 6] += step
                _features(points[m], ends[m], R, t, other, high if side > 0 else low)
            for i in range(FEATURES):
                by[i, k] = (high[i] - low[i]) / (2.0 * STEPS[k] * scale[m, i])
        for i in range(FEATURES):
            x[i] = (x[i] - mean[m, i]) / scale[m, i]
        _layer(w0[m], b0[m], x, first)
        _layer(w1[m], b1[m], first, second)
        _changes(w2[m], b2[m], skip[m], second, x, out[p * e : (p + 1) * e])
        deep[:], back[:], jacobian[p * e : (p + 1) * e] = 0.0, skip[m], 0.0
        for i in range(len(second)):  # the slope of tanh
            second[i] = 1.0 - second[i] * second[i]
        for i in range(len(first)):
            first[i] = 1.0 - first[i] * first[i]
        _back(w2[m], second, w1[m], deep)
        _back(deep, first, w0[m], back)
        _back(back, ones, by, jacobian[p * e : (p + 1) * e])
