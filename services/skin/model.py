"""`penumbra skin model`: fits the networks of `shared.skin.response` to the boundary-element field of a cell's pads.

For every mounting in a cell (a pad type, and for a backed pad its robot link) the field is solved for limbs of random size at
random poses, from contact to where nothing is felt, and a network learns the logarithms. Mountings that already have a network
are left alone. The network of a bare pad is trained from scratch; for a pad before a link only the difference from the bare one
is trained, which needs fewer poses. Beside each, a network for the rest of the person (`bearer.py`), if it has none.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import Any

import numpy as np
import torch
from rich.progress import Progress
from scipy.linalg import block_diag
from scipy.spatial import ConvexHull

from penumbra.services import flags
from penumbra.services.skin import bearer, fitting
from penumbra.shared.body.anatomy import Mesh, target_mesh
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import PadType
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.response import FEATURES, FOLDER, Network, Rest, features, fingerprint, networks, save
from penumbra.sim.skin.field import Body, PadField, Panels, limb, shell

Array = np.ndarray

POSES, POSES_BACKED = 45_000, 3_000
"""Number of fields solved for a bare pad, and for each backed mounting."""
POSTURES = 80
"""Number of robot postures for which the effect of its other links on a pad is computed."""
LINK_PANELS = (8, 8)
"""Rows and columns of panels on each of these links."""
JOINED = 0.005
"""Minimum distance [m] of such panels from the link behind the pad; nearer panels are left out."""
LIMBS = 32
"""Number of limb sizes: each must be prepared, so poses share them."""
LENGTH, GIRTH = (-0.12, 0.10), (-0.31, 0.15)
"""Bounds of the log factors: from the 5th percentile of women to the 95th of men (ANSUR II), and slightly beyond."""
GAPS = (0.004, 0.04, 0.12, 0.5)
"""Bounds of the gaps [m]: a third of the limbs lies between the first and the second, a third between the first and the third,
and a third between the first and the last."""
CLEAR = 0.003
"""Minimum distance [m] of a limb from the board or the link."""
BEHIND = -0.15
"""Minimum cosine between the pad's normal and the limb's direction: limbs may be slightly behind the pad's plane."""
TILT = 0.6
"""Maximum angle [rad] between the limb's axis and the plane across the direction to the limb."""
OVERHANG = 0.05
"""Maximum distance [m] of a pad beyond the limb's ends."""
PIECES = (40, 18)
"""Rows and columns of the limb's pieces."""
HIDDEN, HIDDEN_BACKED = 128, 32
STEPS, STEPS_BACKED, BATCH = 250_000, 10_000, 512
"""Units of the hidden layers and training steps, of a bare pad and of the effect of a link behind it; samples per step."""
PERSONS, PERSONS_BACKED, PERSON_STEPS = 8_000, 3_000, 20_000
"""Numbers of fields solved for the rest of the person, and training steps for it."""
NEAR_GAP = 0.05
"""Gap [m] below which the networks have larger errors."""
FAINTEST = 1e-5
"""Change [fF] below which a result is a numerical error, as for a limb behind the link."""
HELD_OUT_SEED = 1_000_003
"""Seed of the limbs on which a network is scored; it is not trained on them."""
BANDS = (0.005, 0.015, 0.03, 0.06, 0.12, 0.17, 0.25, 0.5)
"""Limits of the gap bands [m] of the reported errors."""


@dataclass(frozen=True)
class Mounting:
    """A mounting for which a network is fitted: a pad that has it, the file's name, its fingerprint and that of the same pad
    without a link, the pad type and the link behind it."""

    pad: str
    name: str
    fingerprint: str
    bare: str
    kind: PadType
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
                shell(rigid.apply(rigid.inverse(pad.T_link_pad), mesh.vertices)),
                f"{cell.name}-{name}-{target}",
            )
        out[own] = Mounting(name, label, own, fingerprint(cell, name, target, bare=True), cell.pad_types[pad.type], backing)
    return list(out.values())


class Poses:
    """Random limbs before a pad, with position, direction and size; none touches the board or the link."""

    def __init__(self, mesh: Mesh, backing: Panels | None, seed: int):
        self.rng = np.random.default_rng([seed, 41])
        self.surface = Surface(mesh.vertices, mesh.faces)
        self.ends = float(mesh.vertices[:, 0].min()), float(mesh.vertices[:, 0].max())
        xs, ys = np.meshgrid(np.linspace(-0.0305, 0.0305, 7), np.linspace(-0.03, 0.03, 7))
        board = np.column_stack([xs.ravel(), ys.ravel(), np.zeros(xs.size)])
        self.solid = board if backing is None else np.concatenate([board, backing.centroids])
        sizes = np.random.default_rng([seed, 42]).permuted(np.tile((np.arange(LIMBS) + 0.5) / LIMBS, (2, 1)), axis=1).T
        self.sizes = np.array([LENGTH[0], GIRTH[0]]) + sizes * (LENGTH[1] - LENGTH[0], GIRTH[1] - GIRTH[0])

    def draw(self, gap: float | None = None) -> tuple[Array, int, float]:
        """T_pad_limb (4, 4), the index of the limb, and its gap [m]: within 2 % of `gap`, or random."""
        rng = self.rng
        while True:
            which = int(rng.integers(LIMBS))
            factors = np.exp(self.sizes[which][[0, 1, 1]])
            up = BEHIND + (1.0 - BEHIND) * rng.uniform() ** 0.6
            turn = rng.uniform(0, 2 * np.pi)
            toward = np.array([*(np.sqrt(1 - up * up) * np.array([np.cos(turn), np.sin(turn)])), up])
            x = np.cross(toward, rng.standard_normal(3))
            x = x / np.linalg.norm(x) + np.tan(rng.uniform(-TILT, TILT)) * toward
            x /= np.linalg.norm(x)
            y = np.cross(rng.standard_normal(3), x)
            y /= np.linalg.norm(y)
            R = np.column_stack([x, y, np.cross(x, y)])
            along = rng.uniform(self.ends[0] - OVERHANG, self.ends[1] + OVERHANG) * factors[0]
            # move the limb away along `toward` until the pad's middle has the wanted gap
            wanted = gap or float(np.exp(rng.uniform(np.log(GAPS[0]), np.log(GAPS[rng.integers(1, 4)]))))
            far = wanted + 0.05
            for _ in range(12):
                t = toward * far - along * x
                short = wanted - self._gap(np.zeros((1, 3)), R, t, factors)
                if abs(short) < 0.02 * wanted:
                    break
                far += short
            if far > 0.0 and abs(short) < 0.02 * wanted and self._gap(self.solid, R, t, factors) > CLEAR:
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = R, t
                return T, which, wanted - short

    def _gap(self, points: Array, R: Array, t: Array, factors: Array) -> float:
        """Approximate smallest distance [m] of points (n, 3) to the limb: exact at the mesh's own size."""
        local = (points - t) @ R
        distance, nearest, _ = self.surface.nearest(local / factors)
        return float((np.sign(distance) * np.linalg.norm(nearest * factors - local, axis=1)).min())


@dataclass(frozen=True)
class Solved:
    """Solved fields: poses (n, 4, 4) of the limb in the pad's frame, its sizes (n, 2) and gaps (n,) [m], changes (n, e) [fF]."""

    T: Array
    size: Array
    gap: Array
    change: Array


def solve(
    mounting: Mounting,
    mesh: Mesh,
    count: int,
    seed: int,
    progress: Progress | None = None,
    gaps: Sequence[float] = (),
    limbs: dict[tuple[float, ...], Body] | None = None,
) -> Solved:
    """Solve `count` random fields, at these gaps [m] in turn, or at random ones. limbs: those prepared so far, by size; preparing
    takes time."""
    field, poses = PadField(mounting.kind, mounting.backing), Poses(mesh, mounting.backing, seed)
    limbs = {} if limbs is None else limbs
    T, size, gap = np.empty((count, 4, 4)), np.empty((count, 2)), np.empty(count)
    change = np.empty((count, len(mounting.kind.electrodes)))
    task = progress.add_task(f"{mounting.name}: fields", total=count) if progress else None
    for k in range(count):
        T[k], which, gap[k] = poses.draw(gaps[k % len(gaps)] if gaps else None)
        size[k] = poses.sizes[which]
        key = tuple(size[k].tolist())
        if key not in limbs:
            limbs[key] = limb(mesh, *np.exp(size[k]))
        change[k] = field.change(limbs[key], T[k])
        if progress and task is not None and k % 50 == 0:
            progress.update(task, completed=k)
    if progress and task is not None:
        progress.remove_task(task)
    return Solved(T, size, gap, change)


def pieces(mesh: Mesh) -> Array:
    """The limb's surface in pieces (7, k): see `shared.skin.response.Network`."""
    panels = limb(mesh, stations=PIECES[0], around=PIECES[1]).panels
    return np.ascontiguousarray(np.column_stack([panels.centroids, panels.normals, panels.areas]).T, dtype=np.float32)


def links(cell: cells.Cell, mounting: Mounting, joints: Array) -> Array:
    """Changes (k, e) [fF] by all links but the pad's own, at joint angles (k, j) of the cell's robots."""
    models, own = robot_models(cell), cell.pads[mounting.pad]
    field = PadField(mounting.kind, mounting.backing)
    robot, _, carrier = own.link.partition("/")
    others = {
        (name, link): shell(mesh.vertices, *LINK_PANELS).corners
        for name, model in models.items()
        for link, mesh in model.meshes.items()
        if (name, link) != (robot, carrier)
    }
    behind = ConvexHull(rigid.apply(rigid.inverse(own.T_link_pad), models[robot].meshes[carrier].vertices))
    change = np.empty((len(joints), len(mounting.kind.electrodes)))
    for k, q in enumerate(joints):
        poses, first = {}, 0
        for name, model in models.items():
            poses[name] = model.link_transforms(q[first : first + len(model.joints)])
            first += len(model.joints)
        T_pad_world = rigid.inverse(poses[robot][carrier] @ own.T_link_pad)
        corners = np.concatenate([rigid.apply(T_pad_world @ poses[name][link], c) for (name, link), c in others.items()])
        away = (corners.mean(axis=1) @ behind.equations[:, :3].T + behind.equations[:, 3]).max(axis=1) > JOINED
        change[k] = field.change_of_links(Panels(corners[away]))
    return change


def joint_range(cell: cells.Cell) -> tuple[Array, Array]:
    """Bounds (j,) [rad] of all joints: the cell's own for the emulator, or those of the robots."""
    if cell.sim is not None and cell.sim.joints_low:
        return np.array(cell.sim.joints_low), np.array(cell.sim.joints_high)
    models = robot_models(cell).values()
    return np.concatenate([m.lower for m in models]), np.concatenate([m.upper for m in models])


def fit_rest(cell: cells.Cell, mounting: Mounting, seed: int) -> tuple[Rest, float]:
    """The polynomial for the other links of a pad's robot, and the 95th percentile of its relative error on held-out postures."""
    low, high = joint_range(cell)
    postures = np.random.default_rng([seed, 44]).uniform(low, high, (POSTURES, len(low)))
    others = np.random.default_rng([HELD_OUT_SEED, 44]).uniform(low, high, (POSTURES // 5, len(low)))
    empty = Rest(np.zeros((len(mounting.kind.electrodes), 1)), 0.5 * (low + high), 0.5 * np.maximum(high - low, 1e-6))
    change, held_out = links(cell, mounting, postures), links(cell, mounting, others)
    rest = replace(empty, coefficients=np.linalg.lstsq(empty.terms(postures), np.log(change), rcond=None)[0].T)
    return rest, float(np.percentile(np.abs(rest.change(others) / held_out - 1.0), 95))


class _Fit(torch.nn.Module):
    def __init__(self, outputs: int, hidden: int):
        super().__init__()
        self.first, self.second = torch.nn.Linear(FEATURES, hidden), torch.nn.Linear(hidden, hidden)
        self.last, self.skip = torch.nn.Linear(hidden, outputs), torch.nn.Linear(FEATURES, outputs, bias=False)

    @property
    def layers(self) -> tuple[torch.nn.Linear, ...]:
        """The layers with biases, from input to output."""
        return self.first, self.second, self.last

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        hidden = torch.tanh(self.second(torch.tanh(self.first(x))))
        return torch.as_tensor(self.last(hidden) + self.skip(x))


def fit(
    points: Array, data: Solved, seed: int, steps: int, start: Network | None = None, progress: Progress | None = None
) -> Network:
    """Train a network of the changes' logarithms. With a start, only the difference from it is trained, by a small network
    beside it."""
    torch.manual_seed(seed)
    rng = np.random.default_rng([seed, 43])
    usable = (data.change > FAINTEST).all(axis=1)
    data = Solved(data.T[usable], data.size[usable], data.gap[usable], data.change[usable])
    inputs, wanted = features(points, data.T, data.size), np.log(data.change)
    if start is not None:
        wanted -= np.log(predict(start, data))
    mean, scale = (start.mean, start.scale) if start else (inputs.mean(axis=0), inputs.std(axis=0) + 1e-9)
    model = _Fit(wanted.shape[1], HIDDEN if start is None else HIDDEN_BACKED)
    with torch.no_grad():
        model.last.bias.copy_(torch.from_numpy(wanted.astype(np.float32)).mean(dim=0))
    fitting.learn(model, (inputs - mean) / scale, wanted, rng, steps, BATCH, 2e-3, 0.0 if start is None else 0.1, progress)
    weights, biases = fitting.parameters(model.layers)
    network = Network(points, mean, scale, weights, biases, model.skip.weight.detach().numpy().astype(float))  # type: ignore[arg-type]
    return network if start is None else beside(start, network)


def beside(one: Network, other: Network) -> Network:
    """One network whose outputs are the sums of those of two networks with the same input."""
    (a0, a1, a2), (b0, b1, b2) = one.weights, other.weights
    (a3, a4, a5), (b3, b4, b5) = one.biases, other.biases
    weights = np.concatenate([a0, b0]), block_diag(a1, b1), np.concatenate([a2, b2], axis=1)
    biases = np.concatenate([a3, b3]), np.concatenate([a4, b4]), a5 + b5
    return replace(one, weights=weights, biases=biases, skip=one.skip + other.skip)


def predict(network: Network, data: Solved) -> Array:
    """Changes (n, e) [fF] of a network."""
    x = (features(network.points, data.T, data.size) - network.mean) / network.scale
    first = np.tanh(x @ network.weights[0].T + network.biases[0])
    second = np.tanh(first @ network.weights[1].T + network.biases[1])
    return np.exp(second @ network.weights[2].T + network.biases[2] + x @ network.skip.T)


def error(network: Network, data: Solved) -> float:
    """Standard deviation of the relative error beyond NEAR_GAP, estimated from the median; the tails are left to the estimator's
    outlier handling."""
    far = data.gap > NEAR_GAP
    return float(1.4826 * np.median(np.abs(np.log(predict(network, data)[far] / np.maximum(data.change[far], FAINTEST)))))


def score(network: Network, data: Solved) -> dict[str, dict[str, float]]:
    """Median and 95th percentile of the relative error of all electrodes [%] per band of the gap [cm]."""
    return fitting.score(data.gap, BANDS, {"": 100.0 * np.abs(predict(network, data) / data.change - 1.0)})


@flags.command(
    "skin model",
    "Fits the field model of a cell's pads to its boundary elements.",
    flags.CELL,
    flags.Option("--target", show_default="the cell's first", help="the limb"),
    flags.Option("--seed", type=int, default=1, help="draws poses and the network's start"),
    flags.Option("--poses", type=int, help=f"fields to solve for each mounting (default: {POSES}, with a link {POSES_BACKED})"),
    flags.Option("--steps", type=int, help=f"of the network's training (default: {STEPS}, with a link {STEPS_BACKED})"),
    flags.Option("--again", is_flag=True, help="also fit mountings that have a network already"),
    example="penumbra skin model --cell mine.yaml",
)
def main(options: flags.Options) -> int:
    cell = cells.load(options.cell)
    if not cell.pads:
        raise cells.CellError(f"cell {cell.name} has no pads: nothing to fit")
    torch.set_num_threads(1)
    target = cell.one("targets", options.target)
    mesh = target_mesh(cell.targets[target].model_copy(update={"size": None}), cell)  # the networks take the size as input
    points = pieces(mesh)
    is_whole = cell.targets[target].mesh == "body:forearm"
    with Progress() as progress:
        for mounting in mountings(cell, target):
            known = networks(cell)
            network = None if options.again else known.get(mounting.fingerprint)
            if network is not None and (network.bearer is not None or not is_whole):
                progress.console.print(f"{mounting.name}: has a network already, kept (--again fits it anew)")
                continue
            path = cell.folder / FOLDER / f"{mounting.name}.npz"
            card: dict[str, Any] = json.loads(path.with_suffix(".json").read_text()) if path.is_file() else {}
            card["made_by"] = f"penumbra skin model --cell {options.cell} --target {target} --seed {options.seed}"
            if network is None:
                network, fitted = _fitted(cell, mounting, mesh, points, known, options, progress)
                card |= fitted
            if is_whole:
                network, card["rest_of_person"] = _with_person(cell, mounting, mesh, network, options, progress)
            save(path, network, mounting.fingerprint)
            path.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")
            progress.console.print(f"{mounting.name}: {path}")
            for what in ("held_out", "rest_of_person"):
                for band, row in card.get(what, {}).items():
                    words = f"median {row['median_percent']} %, 95 % below {row['p95_percent']} %"
                    progress.console.print(f"  {what.replace('_', ' ')} {band:>9}: {words}")
    return 0


def _fitted(
    cell: cells.Cell,
    mounting: Mounting,
    mesh: Mesh,
    points: Array,
    known: Mapping[str, Network],
    options: flags.Options,
    progress: Progress,
) -> tuple[Network, dict[str, Any]]:
    """A mounting's network and what its card says of it."""
    began = time.monotonic()
    start = known.get(mounting.bare) if mounting.backing is not None else None
    poses = options.poses or (POSES if start is None else POSES_BACKED)
    steps = options.steps or (STEPS if start is None else STEPS_BACKED)
    data = solve(mounting, mesh, poses, options.seed, progress)
    network = fit(points, data, options.seed, steps, start, progress)
    unseen = solve(mounting, mesh, max(poses // 12, 50), HELD_OUT_SEED, progress)
    rest, rest_error = fit_rest(cell, mounting, options.seed) if mounting.backing is not None else (None, None)
    card = {
        "date": date.today().isoformat(),
        "fingerprint": mounting.fingerprint,
        "poses": poses,
        "steps": steps,
        "minutes": round((time.monotonic() - began) / 60.0, 1),
        "held_out_seed": HELD_OUT_SEED,
        "held_out": score(network, unseen),
        **({"other_links_p95_percent": round(100.0 * rest_error, 2)} if rest_error is not None else {}),
    }
    return replace(network, rest=rest, error=error(network, unseen)), card


def _with_person(
    cell: cells.Cell, mounting: Mounting, mesh: Mesh, network: Network, options: flags.Options, progress: Progress
) -> tuple[Network, dict[str, Any]]:
    """The network with the rest of the person beside it, and the score of that."""
    poses = options.poses or (PERSONS if mounting.backing is None else PERSONS_BACKED)
    field = PadField(mounting.kind, mounting.backing)
    data, unseen = (
        bearer.solve(field, Poses(mesh, mounting.backing, seed), mesh, cell.body, count, progress)
        for seed, count in ((options.seed, poses), (HELD_OUT_SEED, max(poses // 8, 50)))
    )
    found = bearer.fit(data, bearer.pieces(cell.body), options.seed, options.steps or PERSON_STEPS)
    return replace(network, bearer=found), bearer.score(found, unseen)
