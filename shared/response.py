"""What a limb at a pose changes at the electrodes: small networks, fitted to the boundary-element field of a cell's pads.

One network serves one mounting: a pad type, with or without the robot's link behind it, and one limb. It sees the limb's axis
from the pad (how far its skin is, in which direction, how it runs, which part of it, from which side) and gives the logarithm of
the change of capacitance [fF] of every electrode, whose sign is the same for every limb: what is grounded takes field lines away.
`penumbra skin model` fits the networks; a mounting is known by its fingerprint wherever the files come from.

The limb's size is two logarithms, of the factors by which the target's mesh is stretched along its axis and across it.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from shared import cell as cells
from shared.body import Mesh

Array = NDArray[np.float64]

FOLDER = "skin"
"""Beside a cell file: where its fitted networks are."""
FEATURES = 16
CONTACT = 0.004
"""Added to the gap [m] before its logarithm: in contact nothing becomes infinite."""
ROUND = 0.02
"""The side from which the limb is seen fades out this near [m] to its axis, where it has no meaning."""
STEP = 1e-6
"""Step [m, rad] of the features' numerical derivatives."""


@dataclass(frozen=True)
class Axis:
    """A limb's axis: from x0 to x1 [m] along x, centre (k, 2) in y and z and mean radius (k,) [m] at k even places."""

    x0: float
    x1: float
    nodes: Array  # (k, 3): y, z, radius

    @staticmethod
    def of(mesh: Mesh, places: int = 24) -> Axis:
        """The axis of a closed mesh along x, smoothed so that it has no kinks."""
        u, v = (w.ravel() for w in np.meshgrid(np.arange(0.5, 12.0), np.arange(0.5, 12.0)))
        u, v = (w[u + v < 12.0, None, None] / 12.0 for w in (u, v))
        a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
        points = (a + u * (b - a) + v * (c - a)).reshape(-1, 3)
        weight = np.tile(np.linalg.norm(np.cross(b - a, c - a), axis=1), len(u))
        low, high = float(points[:, 0].min()), float(points[:, 0].max())

        def section(at: float) -> tuple[float, float, float]:
            near = weight * np.exp(-0.5 * ((points[:, 0] - at) / (0.03 * (high - low))) ** 2)
            y, z = near @ points[:, 1:] / near.sum()
            return float(y), float(z), float(near @ np.hypot(points[:, 1] - y, points[:, 2] - z) / near.sum())

        x0, x1 = low + section(low)[2], high - section(high)[2]  # the skin ends a radius beyond the axis
        return Axis(x0, x1, np.array([section(at) for at in np.linspace(x0, x1, places)]))


@dataclass(frozen=True)
class Network:
    """The response of one mounting: input mean and scale (FEATURES,), three weight matrices (rows are outputs) with biases, and
    a linear skip (e, FEATURES)."""

    axis: Axis
    mean: Array
    scale: Array
    weights: tuple[Array, Array, Array]
    biases: tuple[Array, Array, Array]
    skip: Array

    def arrays(self) -> dict[str, Array]:
        """Everything under names, to be stored."""
        out = {"axis": np.array([self.axis.x0, self.axis.x1]), "nodes": self.axis.nodes, "mean": self.mean, "scale": self.scale}
        out |= {f"weight{i}": w for i, w in enumerate(self.weights)} | {f"bias{i}": b for i, b in enumerate(self.biases)}
        return {**out, "skip": self.skip}

    @staticmethod
    def of(data) -> Network:  # type: ignore[no-untyped-def]
        """From what `arrays` gave."""
        x0, x1 = map(float, data["axis"])
        axis = Axis(x0, x1, np.ascontiguousarray(data["nodes"], dtype=float))
        weights, biases = (
            tuple(np.ascontiguousarray(data[f"{kind}{i}"], dtype=float) for i in range(3)) for kind in ("weight", "bias")
        )
        mean, scale, skip = (np.ascontiguousarray(data[name], dtype=float) for name in ("mean", "scale", "skip"))
        return Network(axis, mean, scale, weights, biases, skip)  # type: ignore[arg-type]


class Response:
    """The networks of all pads of a cell for one of its targets; every pad has e electrodes, in the order of `shared.skin.Skin`.

    Raises CellError where a pad's mounting has no network, or pads differ in their number of electrodes.
    """

    def __init__(self, cell: cells.Cell, target: str):
        known = networks(cell)
        prints = [fingerprint(cell, pad, target) for pad in cell.pads]
        missing = [pad for pad, own in zip(cell.pads, prints, strict=True) if own not in known]
        if missing:
            raise cells.CellError(
                f"cell {cell.name}: no field model for target {target} on the pads {', '.join(missing)}: their design, their "
                f"mounting or the limb is new. Fit it once: penumbra skin model --cell {cell.file or cell.name}"
            )
        different = sorted(set(prints))
        own = [known[each] for each in different]
        sizes = {len(each.skip) for each in own}
        if len(sizes) > 1:
            raise cells.CellError(f"cell {cell.name}: pads with equally many electrodes expected, {sorted(sizes)} came")
        self.electrodes = sizes.pop()
        self.index = np.array([different.index(each) for each in prints])
        self.axes = np.array([[each.axis.x0, each.axis.x1] for each in own])
        self.nodes = np.stack([each.axis.nodes for each in own])
        self.mean, self.scale = np.stack([each.mean for each in own]), np.stack([each.scale for each in own])
        first, second, third = (np.stack([each.weights[i] for each in own]) for i in range(3))
        biases = tuple(np.stack([each.biases[i] for each in own]) for i in range(3))
        self.arrays = (self.index, self.axes, self.nodes, self.mean, self.scale, first, biases[0], second, biases[1], third,
                       biases[2], np.stack([each.skip for each in own]))  # fmt: skip

    def change(self, T_pads_target: Array, size: ArrayLike = (0.0, 0.0)) -> Array:
        """Changes (n,) [fF] by the limb at T_pads_target (p, 4, 4), with its size (2,): log length, log girth."""
        out = np.empty(len(self.index) * self.electrodes)
        values(*self.arrays, np.ascontiguousarray(T_pads_target), np.asarray(size, dtype=float), out)
        return np.exp(out)

    def logs(self, T_pads_target: Array, size: ArrayLike = (0.0, 0.0)) -> tuple[Array, Array]:
        """Log changes (n,) and their derivatives (n, 8) by the target's pose, as `geometry.perturb` moves it but along the axes
        of each electrode's own pad, and by the two sizes."""
        out = np.empty(len(self.index) * self.electrodes)
        jacobian = np.empty((len(out), 8))
        derivatives(*self.arrays, np.ascontiguousarray(T_pads_target), np.asarray(size, dtype=float), out, jacobian)
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
        parts["behind"] = {"urdf": cell.robots[robot].urdf, "link": link, "at": [own.position, own.rpy]}
    return _digest(json.dumps(parts, sort_keys=True).encode())


def networks(cell: cells.Cell) -> dict[str, Network]:
    """All fitted networks beside the cell file and among the built-in cells, by fingerprint."""
    out = {}
    for folder in (cells.BUILT_IN / FOLDER, cell.folder / FOLDER):
        for path in sorted(folder.glob("*.npz")):
            with np.load(path) as data:
                out[str(data["fingerprint"])] = Network.of(data)
    return out


def save(path: Path, network: Network, own: str) -> None:
    """Store a network for the mounting with this fingerprint, in half the memory."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {name: a.astype(np.float32) for name, a in network.arrays().items()}
    np.savez_compressed(path, fingerprint=np.array(own), **arrays)  # type: ignore[arg-type]


def features(axis: Axis, T_pad_limb: Array, size: Array) -> Array:
    """Input (n, FEATURES) of a network for limbs at T_pad_limb (n, 4, 4) of sizes (n, 2)."""
    out = np.empty((len(T_pad_limb), FEATURES))
    ends = np.array([axis.x0, axis.x1])
    for k in range(len(out)):
        _features(ends, axis.nodes, np.ascontiguousarray(T_pad_limb[k, :3, :3]), T_pad_limb[k, :3, 3].copy(), size[k], out[k])
    return out


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


@njit(cache=True, nogil=True)
def _features(ends, nodes, R, t, size, out):  # type: ignore[no-untyped-def]
    length, girth = math.exp(size[0]), math.exp(size[1])
    # the pad's origin in the limb's frame
    px = -(R[0, 0] * t[0] + R[1, 0] * t[1] + R[2, 0] * t[2])
    py = -(R[0, 1] * t[0] + R[1, 1] * t[1] + R[2, 1] * t[2])
    pz = -(R[0, 2] * t[0] + R[1, 2] * t[1] + R[2, 2] * t[2])
    low, high = ends[0] * length, ends[1] * length
    foot = min(max(px, low), high)
    place = (foot - low) / (high - low)
    # axis and radius there: a Catmull-Rom spline through the nodes
    k = len(nodes)
    f = place * (k - 1)
    i = min(int(f), k - 2)
    u = f - i
    cy, cz, radius = 0.0, 0.0, 0.0
    for step in range(-1, 3):
        if step == -1:
            w = ((-0.5 * u + 1.0) * u - 0.5) * u
        elif step == 0:
            w = (1.5 * u - 2.5) * u * u + 1.0
        elif step == 1:
            w = ((-1.5 * u + 2.0) * u + 0.5) * u
        else:
            w = (0.5 * u - 0.5) * u * u
        node = nodes[min(max(i + step, 0), k - 1)]
        cy, cz, radius = cy + w * node[0], cz + w * node[1], radius + w * node[2]
    cy, cz, radius = cy * girth, cz * girth, radius * girth
    dx, dy, dz = foot - px, cy - py, cz - pz  # from the pad to the axis, in the limb's frame
    distance = math.sqrt(dx * dx + dy * dy + dz * dz) + 1e-9
    gap = math.log(max(distance - radius, 0.0) + CONTACT)
    across = math.sqrt(dy * dy + dz * dz + ROUND * ROUND)
    sy, sz = -dy / across, -dz / across
    beyond = (px - foot) / distance
    out[0] = gap
    for row in range(3):  # direction of the axis point, and of the axis, in the pad's frame
        out[1 + row] = (R[row, 0] * dx + R[row, 1] * dy + R[row, 2] * dz) / distance
        out[4 + row] = R[row, 0]
    out[7] = place
    out[8] = beyond
    out[9], out[10] = sy, sz
    out[11], out[12] = sy * sy - sz * sz, 2.0 * sy * sz
    out[13], out[14] = size[0], size[1]
    out[15] = gap * out[3]


@njit(cache=True, nogil=True)
def values(index, ends, nodes, mean, scale, w0, b0, w1, b1, w2, b2, skip, T, size, out):  # type: ignore[no-untyped-def]
    """Log changes of all electrodes, into out (n,). Arguments: `Response.arrays`, T_pads_target (p, 4, 4), size (2,)."""
    e = skip.shape[1]
    x = np.empty(FEATURES)
    for p in range(len(index)):
        m = index[p]
        _features(ends[m], nodes[m], T[p, :3, :3], T[p, :3, 3], size, x)
        x -= mean[m]
        x /= scale[m]
        first = np.tanh(np.dot(w0[m], x) + b0[m])
        second = np.tanh(np.dot(w1[m], first) + b1[m])
        out[p * e : (p + 1) * e] = np.dot(w2[m], second) + b2[m] + np.dot(skip[m], x)


@njit(cache=True, nogil=True)
def derivatives(index, ends, nodes, mean, scale, w0, b0, w1, b1, w2, b2, skip, T, size, out, jacobian):  # type: ignore[no-untyped-def]
    """The same with derivatives, into jacobian (n, 8): see `Response.logs`."""
    e = skip.shape[1]
    x, high, low = np.empty(FEATURES), np.empty(FEATURES), np.empty(FEATURES)
    by = np.empty((FEATURES, 8))
    R, t, other = np.empty((3, 3)), np.empty(3), np.empty(2)
    for p in range(len(index)):
        m = index[p]
        _features(ends[m], nodes[m], T[p, :3, :3], T[p, :3, 3], size, x)
        for k in range(8):
            for side in (1, -1):
                step = side * STEP
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
                _features(ends[m], nodes[m], R, t, other, high if side > 0 else low)
            for i in range(FEATURES):
                by[i, k] = (high[i] - low[i]) / (2.0 * STEP * scale[m, i])
        x -= mean[m]
        x /= scale[m]
        first = np.tanh(np.dot(w0[m], x) + b0[m])
        second = np.tanh(np.dot(w1[m], first) + b1[m])
        out[p * e : (p + 1) * e] = np.dot(w2[m], second) + b2[m] + np.dot(skip[m], x)
        back = np.dot(w2[m] * (1.0 - second * second), w1[m])
        back = np.dot(back * (1.0 - first * first), w0[m]) + skip[m]
        jacobian[p * e : (p + 1) * e] = np.dot(back, by)
