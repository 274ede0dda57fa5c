"""`penumbra skin model`: fits the networks of `shared.response` to the boundary-element field of a cell's pads.

For every mounting of a cell (a pad type, and for a backed pad its robot link) the field is solved for limbs of random size at
random poses, from contact to where nothing is felt, and a network learns the logarithms. Mountings that already have a network
are left alone. The first mounting is learned from nothing, the others start from the one without a link and need fewer poses.
"""

from __future__ import annotations

import itertools
import json
import time
from dataclasses import dataclass
from datetime import date

import numpy as np
import torch
from rich.progress import Progress

from services import arguments
from shared import cell as cells
from shared import geometry
from shared.body import Mesh, target_mesh
from shared.response import FEATURES, FOLDER, Axis, Network, features, fingerprint, networks, save
from shared.robot import robot_models
from shared.surface import Surface
from sim.field import Body, PadField, Panels, limb, shell

Array = np.ndarray

POSES, POSES_BACKED = 36_000, 9_000
"""Fields solved for a bare pad, and for one more mounting."""
LIMBS = 32
"""Sizes of limbs: each must be prepared, so poses share them."""
LENGTH, GIRTH = (-0.12, 0.10), (-0.31, 0.15)
"""Bounds of the log factors: from the 5th percentile of women to the 95th of men (ANSUR II), and a little beyond."""
GAPS = (0.003, 0.5)
"""From what gap [m] between pad and skin to what."""
BEHIND = -0.35
"""A limb may be as far behind the pad's plane as this cosine of its direction."""
HIDDEN = 80
STEPS, BATCH = 24_000, 512
HELD_OUT_SEED = 1_000_003
BANDS = (0.005, 0.015, 0.03, 0.06, 0.12, 0.17, 0.25, 0.5)
"""Gaps [m] between which errors are reported apart."""


@dataclass(frozen=True)
class Mounting:
    """What a network is fitted for: name of its file, its fingerprint and that of the same pad without
    a link, the pad type and the link behind it."""

    name: str
    fingerprint: str
    bare: str
    kind: cells.PadType
    backing: Panels | None


def mountings(cell: cells.Cell, target: str) -> list[Mounting]:
    """The different mountings of a cell's pads, those without a link first."""
    out: dict[str, Mounting] = {}
    models = robot_models(cell) if any(pad.backed for pad in cell.pads.values()) else {}
    for name, pad in sorted(cell.pads.items(), key=lambda item: item[1].backed):
        own = fingerprint(cell, name, target)
        if own in out:
            continue
        backing, label = None, f"{pad.type}-{target}"
        if pad.backed:
            robot, _, link = pad.link.partition("/")
            mesh = models[robot].meshes[link]
            backing, label = (
                shell(geometry.apply(geometry.inverse(pad.T_link_pad), mesh.vertices)),
                f"{cell.name}-{name}-{target}",
            )
        out[own] = Mounting(label, own, fingerprint(cell, name, target, bare=True), cell.pad_types[pad.type], backing)
    return list(out.values())


class Poses:
    """Random limbs before a pad: where they are, how they lie, how large they are; none that touches the board or the link."""

    def __init__(self, mesh: Mesh, backing: Panels | None, seed: int):
        self.rng = np.random.default_rng([seed, 41])
        self.surface = Surface(mesh.vertices, mesh.faces)
        self.ends = float(mesh.vertices[:, 0].min()), float(mesh.vertices[:, 0].max())
        xs, ys = np.meshgrid(np.linspace(-0.0305, 0.0305, 7), np.linspace(-0.03, 0.03, 7))
        board = np.column_stack([xs.ravel(), ys.ravel(), np.zeros(xs.size)])
        self.solid = board if backing is None else np.concatenate([board, backing.centroids])
        sizes = np.random.default_rng([seed, 42]).permuted(np.tile((np.arange(LIMBS) + 0.5) / LIMBS, (2, 1)), axis=1).T
        self.sizes = np.array([LENGTH[0], GIRTH[0]]) + sizes * (LENGTH[1] - LENGTH[0], GIRTH[1] - GIRTH[0])

    def draw(self, gap: float | None = None) -> tuple[Array, int]:
        """T_pad_limb (4, 4) and the number of the limb, at this gap [m] within 2 %, or at any."""
        rng = self.rng
        while True:
            which = int(rng.integers(LIMBS))
            factors = np.exp(self.sizes[which][[0, 1, 1]])
            up = BEHIND + (1.0 - BEHIND) * rng.uniform() ** 0.6
            turn = rng.uniform(0, 2 * np.pi)
            toward = np.array([*(np.sqrt(1 - up * up) * np.array([np.cos(turn), np.sin(turn)])), up])
            x = np.cross(toward, rng.standard_normal(3)) + toward * np.tan(rng.normal(0.0, 0.45)) * rng.uniform(0, 1)
            x /= np.linalg.norm(x)
            y = np.cross(rng.standard_normal(3), x)
            y /= np.linalg.norm(y)
            R = np.column_stack([x, y, np.cross(x, y)])
            along = rng.uniform(self.ends[0] - 0.06, self.ends[1] + 0.06) * factors[0]
            # slide it away along `toward` until the pad's middle has the wanted gap
            wanted = gap or np.exp(rng.uniform(*np.log(GAPS)))
            far = wanted + 0.05
            for _ in range(12):
                t = toward * far - along * x
                short = wanted - self._gap(np.zeros((1, 3)), R, t, factors)
                if abs(short) < 0.02 * wanted:
                    break
                far += short
            if far > 0.0 and abs(short) < 0.02 * wanted and self._gap(self.solid, R, t, factors) > GAPS[0]:
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = R, t
                return T, which

    def _gap(self, points: Array, R: Array, t: Array, factors: Array) -> float:
        """About the distance [m] of points (n, 3) to the limb: exact in the mesh's own size."""
        local = (points - t) @ R
        distance, nearest, _ = self.surface.nearest(local / factors)
        return float((np.sign(distance) * np.linalg.norm(nearest * factors - local, axis=1)).min())


@dataclass(frozen=True)
class Solved:
    """Fields: poses (n, 4, 4) of the limb in the pad's frame, sizes (n, 2) of it, changes (n, e) [fF]."""

    T: Array
    size: Array
    change: Array


def solve(
    mounting: Mounting, mesh: Mesh, count: int, seed: int, progress: Progress | None = None, gap: float | None = None
) -> Solved:
    """So many random fields, at one gap [m] or at all."""
    field, poses = PadField(mounting.kind, mounting.backing), Poses(mesh, mounting.backing, seed)
    limbs: dict[int, Body] = {}
    T, size, change = np.empty((count, 4, 4)), np.empty((count, 2)), np.empty((count, len(mounting.kind.electrodes)))
    task = progress.add_task(f"{mounting.name}: fields", total=count) if progress else None
    for k in range(count):
        T[k], which = poses.draw(gap)
        size[k] = poses.sizes[which]
        if which not in limbs:
            limbs[which] = limb(mesh, *np.exp(size[k]))
        change[k] = field.change(limbs[which], T[k])
        if progress and task is not None and k % 50 == 0:
            progress.update(task, completed=k)
    if progress and task is not None:
        progress.remove_task(task)
    return Solved(T, size, change)


class _Fit(torch.nn.Module):
    def __init__(self, outputs: int):
        super().__init__()
        self.layers = torch.nn.ModuleList(
            [torch.nn.Linear(FEATURES, HIDDEN), torch.nn.Linear(HIDDEN, HIDDEN), torch.nn.Linear(HIDDEN, outputs)]
        )
        self.skip = torch.nn.Linear(FEATURES, outputs, bias=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        first, second, last = self.layers
        y: torch.Tensor = last(torch.tanh(second(torch.tanh(first(x))))) + self.skip(x)
        return y


def fit(
    axis: Axis, data: Solved, seed: int, steps: int, start: Network | None = None, progress: Progress | None = None
) -> Network:
    """The network that has the logarithms of the changes; robust against the few poses that it cannot follow."""
    torch.manual_seed(seed)
    rng = np.random.default_rng([seed, 43])
    usable = (data.change > 1e-6).all(axis=1)
    inputs, wanted = features(axis, data.T, data.size)[usable], np.log(data.change[usable])
    mean, scale = (start.mean, start.scale) if start else (inputs.mean(axis=0), inputs.std(axis=0) + 1e-9)
    x = torch.from_numpy(((inputs - mean) / scale).astype(np.float32))
    y = torch.from_numpy(wanted.astype(np.float32))
    model = _Fit(y.shape[1])
    with torch.no_grad():
        if start is None:
            model.layers[2].bias.copy_(y.mean(dim=0))
        else:
            for layer, weight, bias in zip(model.layers, start.weights, start.biases, strict=True):
                layer.weight.copy_(torch.from_numpy(weight))
                layer.bias.copy_(torch.from_numpy(bias))
            model.skip.weight.copy_(torch.from_numpy(start.skip))
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    task = progress.add_task("network", total=steps) if progress else None
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = 2e-3 * min(1.0, (step + 1) / 300) * (0.5 * (1.0 + np.cos(np.pi * step / steps)) + 5e-4)
        rows = torch.from_numpy(rng.integers(0, len(x), BATCH))
        error = model(x[rows]) - y[rows]
        loss = (torch.sqrt(error * error + 0.02**2) - 0.02).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if progress and task is not None and step % 100 == 0:
            progress.update(task, completed=step, description=f"network, error {error.abs().median().item():.4f}")
    if progress and task is not None:
        progress.remove_task(task)
    with torch.no_grad():
        weights = tuple(layer.weight.numpy().astype(float) for layer in model.layers)
        biases = tuple(layer.bias.numpy().astype(float) for layer in model.layers)
        return Network(axis, mean, scale, weights, biases, model.skip.weight.numpy().astype(float))  # type: ignore[arg-type]


def predict(network: Network, data: Solved) -> Array:
    """Changes (n, e) [fF] of a network."""
    x = (features(network.axis, data.T, data.size) - network.mean) / network.scale
    first = np.tanh(x @ network.weights[0].T + network.biases[0])
    second = np.tanh(first @ network.weights[1].T + network.biases[1])
    return np.exp(second @ network.weights[2].T + network.biases[2] + x @ network.skip.T)


def score(network: Network, data: Solved) -> dict[str, dict[str, float]]:
    """Median and 95th percentile of the relative error of all electrodes [%] per band of the gap [cm]."""
    error = 100.0 * np.abs(predict(network, data) / data.change - 1.0)
    gap = np.exp(features(network.axis, data.T, data.size)[:, 0])
    out = {}
    for low, high in itertools.pairwise(BANDS):
        own = error[(gap >= low) & (gap < high)]
        if len(own):
            out[f"{100 * low:g}-{100 * high:g} cm"] = {
                "poses": len(own),
                "median_percent": round(float(np.median(own)), 3),
                "p95_percent": round(float(np.percentile(own, 95)), 3),
            }
    return out


def main(argv: list[str]) -> int:
    """`penumbra skin model`"""
    parser = arguments.Parser(
        prog="penumbra skin model", description="Fits the field model of a cell's pads to its boundary elements."
    )
    arguments.add_cell(parser)
    parser.add_argument("--target", help="the limb (default: the cell's first target)")
    parser.add_argument("--seed", type=int, default=1, help="draws poses and the network's start (default: %(default)s)")
    parser.add_argument(
        "--poses", type=int, help=f"fields to solve for each mounting (default: {POSES}, with a link {POSES_BACKED})"
    )
    parser.add_argument("--steps", type=int, default=STEPS, help="of the network's training (default: %(default)s)")
    parser.add_argument("--again", action="store_true", help="also fit mountings that have a network already")
    options = parser.parse_args(argv)
    cell = cells.load(options.cell)
    if not cell.pads:
        raise cells.CellError(f"cell {cell.name} has no pads: nothing to fit")
    torch.set_num_threads(1)
    target = cell.one("targets", options.target)
    mesh = target_mesh(cell.targets[target], cell)
    axis = Axis.of(mesh)
    with Progress() as progress:
        for mounting in mountings(cell, target):
            known = networks(cell)
            if mounting.fingerprint in known and not options.again:
                progress.console.print(f"{mounting.name}: has a network already, kept (--again fits it anew)")
                continue
            began = time.monotonic()
            start = known.get(mounting.bare) if mounting.backing is not None else None
            poses = options.poses or (POSES if start is None else POSES_BACKED)
            network = fit(
                axis, solve(mounting, mesh, poses, options.seed, progress), options.seed, options.steps, start, progress
            )
            held_out = score(network, solve(mounting, mesh, max(poses // 12, 50), HELD_OUT_SEED, progress))
            path = cell.folder / FOLDER / f"{mounting.name}.npz"
            save(path, network, mounting.fingerprint)
            card = {
                "made_by": f"penumbra skin model --cell {options.cell} --target {target} --seed {options.seed}",
                "date": date.today().isoformat(),
                "fingerprint": mounting.fingerprint,
                "poses": poses,
                "steps": options.steps,
                "minutes": round((time.monotonic() - began) / 60.0, 1),
                "held_out_seed": HELD_OUT_SEED,
                "held_out": held_out,
            }
            path.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")
            progress.console.print(f"{mounting.name}: {path}")
            for band, row in held_out.items():
                progress.console.print(f"  {band:>9}: median {row['median_percent']} %, 95 % below {row['p95_percent']} %")
    return 0
