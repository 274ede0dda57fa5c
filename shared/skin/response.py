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
from numba import njit
from numpy.typing import ArrayLike, NDArray

from shared.body import urdf
from shared.cell import description as cells

Array = NDArray[np.float64]

FOLDER = "skin"
"""Beside a cell file: where its fitted networks are."""
FEATURES = 36
RIM = 0.024
"""The limb's nearness is also seen from four points so far [m] from the pad's middle, where outer electrodes are."""
CORE = 0.01
"""Added to distances from the pad's middle [m]: in contact nothing becomes infinite."""
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
        points, ends = np.stack([each.points for each in own]), np.stack([each.ends for each in own])
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
    for k in range(len(out)):
        _features(points, ends, np.ascontiguousarray(T_pad_limb[k, :3, :3]), T_pad_limb[k, :3, 3].copy(), size[k], out[k])
    return out


def _stack(arrays: list[Array]) -> Array:
    """Arrays in one, smaller ones filled up with zeros: a unit without weights changes nothing."""
    shape = np.max([each.shape for each in arrays], axis=0)
    return np.stack([np.pad(each, [(0, n - k) for n, k in zip(shape, each.shape, strict=True)]) for each in arrays])


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")  # a division that may raise is not vectorised
def _sums(px, py, pz, nx, ny, nz, area, R, t, along, across, core, out):  # type: ignore[no-untyped-def]
    """Sums over the skin before a pad, into out: for each of three powers of nearness the weight and its first moments along the
    pad's axes (12), for the middle one the second moments xx, yy, xy, zz, and from 32 on the weight as seen from right, left, top
    and bottom of the pad. All in single precision, in one loop."""
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = s10 = s11 = s12 = s13 = s14 = s15 = np.float32(0.0)
    s16 = s17 = s18 = s19 = np.float32(0.0)
    twice, square = np.float32(2.0 * RIM), np.float32(RIM * RIM)
    half, one = np.float32(0.5), np.float32(1.0)
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    t0, t1, t2 = t[0], t[1], t[2]
    for k in range(px.shape[0]):
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
        s0 += w0
        s1 += w0 * x
        s2 += w0 * y
        s3 += w0 * z
        s4 += w1
        s5 += w1 * x
        s6 += w1 * y
        s7 += w1 * z
        s8 += w2
        s9 += w2 * x
        s10 += w2 * y
        s11 += w2 * z
        s12 += w1 * x * x
        s13 += w1 * y * y
        s14 += w1 * x * y
        s15 += w1 * z * z
        far += square
        right, left = one / (far - twice * x), one / (far + twice * x)
        top, bottom = one / (far - twice * y), one / (far + twice * y)
        s16 += seen * right * right * right
        s17 += seen * left * left * left
        s18 += seen * top * top * top
        s19 += seen * bottom * bottom * bottom
    out[0], out[1], out[2], out[3], out[4], out[5], out[6], out[7] = s0, s1, s2, s3, s4, s5, s6, s7
    out[8], out[9], out[10], out[11], out[12], out[13], out[14], out[15] = s8, s9, s10, s11, s12, s13, s14, s15
    out[32], out[33], out[34], out[35] = s16, s17, s18, s19


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def values(index, points, ends, mean, scale, w0, b0, w1, b1, w2, b2, skip, T, size, out):  # type: ignore[no-untyped-def]
    """Log changes of all electrodes, into out (n,). Arguments: `Response.arrays`, T_pads_target (p, 4, 4), size (2,)."""
    e = skip.shape[1]
    x = np.empty(FEATURES)
    for p in range(len(index)):
        m = index[p]
        _features(points[m], ends[m], T[p, :3, :3], T[p, :3, 3], size, x)
        x -= mean[m]
        x /= scale[m]
        first = np.tanh(np.dot(w0[m], x) + b0[m])
        second = np.tanh(np.dot(w1[m], first) + b1[m])
        out[p * e : (p + 1) * e] = np.dot(w2[m], second) + b2[m] + np.dot(skip[m], x)


@njit(cache=True, nogil=True)
def derivatives(index, points, ends, mean, scale, w0, b0, w1, b1, w2, b2, skip, T, size, out, jacobian):  # type: ignore[no-untyped-def]
    """The same with derivatives, into jacobian (n, 8): see `Response.logs`."""
    e = skip.shape[1]
    x, high, low = np.empty(FEATURES), np.empty(FEATURES), np.empty(FEATURES)
    by = np.empty((FEATURES, 8))
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
        x -= mean[m]
        x /= scale[m]
        first = np.tanh(np.dot(w0[m], x) + b0[m])
        second = np.tanh(np.dot(w1[m], first) + b1[m])
        out[p * e : (p + 1) * e] = np.dot(w2[m], second) + b2[m] + np.dot(skip[m], x)
        back = np.dot(w2[m] * (1.0 - second * second), w1[m])
        back = np.dot(back * (1.0 - first * first), w0[m]) + skip[m]
        jacobian[p * e : (p + 1) * e] = np.dot(back, by)
