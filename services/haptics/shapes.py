"""Makes `weights/shapes-TYPE.npz` again from a seed: `penumbra haptics shapes --cell table`.

The file states the effect of unknown objects on a pad's signals, relative to that of a forearm across the pad (see
`surface_points.py`): mean and covariance over random superellipsoids (Barr 1981, DOI 10.1109/MCG.1981.1673799: from rods, plates
and blocks to balls and lenses), grounded as a person is, at random poses before the pad, with the full boundary-element field of
the pad alone.
"""

from __future__ import annotations

import datetime
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress
from scipy.spatial import ConvexHull

from penumbra.services import flags
from penumbra.services.haptics.surface_points import GAPS, MODEL_ERROR, SCALES, Shapes, X, across, extended
from penumbra.shared.body.anatomy import target_mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import PadType
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.response import fingerprint
from penumbra.sim.skin import field

WEIGHTS = Path(__file__).parent / "weights"
HALF, POWERS = (0.01, 0.25), (0.2, 1.0)
"""Bounds of the half axes [m], log-uniform, and of the superellipsoid's two exponents, from a block's edges to a ball."""
LONGEST = 0.04
"""Minimum of the longest half axis [m]. Chosen: a smaller object, such as a finger, comes with a larger one; including it in the
statistics would make every object seem a tenth too near from 10 cm on."""
DISTANCES = (0.004, 0.35)
"""Bounds of the distance from the pad's middle [m], log-uniform."""
STEEPEST = math.radians(65.0)
"""Maximum angle [rad] between the pad's normal and the direction of the nearest point."""
CLEAR = 0.003
"""Minimum distance [m] of an object from the pad's plane."""
EACH = 24
"""Number of poses drawn per object."""
PANELS = (30, 20)
"""Rows and columns of panels on an object's surface."""
TABLE: Array = np.geomspace(0.005, 0.3, 24)
"""Gaps [m] of the forearm at which the statistics are tabulated."""
WIDTH = 0.2
"""Width, in log gap, of the Gaussian kernel that weights the scenes at each of these gaps."""
HELD_OUT = 4
"""One object in HELD_OUT is left out of the fit and used for the card's score."""


@dataclass(frozen=True)
class Scenes:
    """Objects before a pad. thing (n,): the object's index; x (n, 4): with d0 = 1 m, see `surface_points.py`; change (n, e)
    [fF]."""

    thing: Array
    x: Array
    change: Array


def superellipsoid(rng: np.random.Generator) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (v, 3) [m] and faces (f, 3) of a random superellipsoid's convex hull."""
    half = np.zeros(3)
    while half.max() < LONGEST:
        half = np.exp(rng.uniform(math.log(HALF[0]), math.log(HALF[1]), 3))
    first, second = rng.uniform(*POWERS, 2)
    ball = rng.standard_normal((1500, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    up, around = np.arcsin(ball[:, 2]), np.arctan2(ball[:, 1], ball[:, 0])

    def power(x: Array, exponent: float) -> Array:
        return np.sign(x) * np.abs(x) ** exponent

    ring = power(np.cos(up), first)
    points = np.stack([ring * power(np.cos(around), second), ring * power(np.sin(around), second), power(np.sin(up), first)], 1)
    hull = ConvexHull(points * half)
    used, corner = np.unique(hull.simplices, return_inverse=True)
    vertices, faces = np.asarray(hull.points[used], np.float64), corner.reshape(-1, 3).astype(np.int64)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = np.einsum("fi,fi->f", normals, hull.equations[:, :3]) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    return vertices, faces


def drawn(kind: PadType, things: int, seed: int, progress: Progress | None = None) -> Scenes:
    """Random objects, each at up to EACH poses before a pad of this type."""
    pad, rng = field.PadField(kind), np.random.default_rng([seed, 60])
    task = progress.add_task("things before a pad", total=things) if progress else None
    rows: list[tuple[int, Array, Array]] = []
    xs, ys = (np.linspace(-0.5, 0.5, 9) * side for side in kind.board.size)
    board = np.stack([*(each.ravel() for each in np.meshgrid(xs, ys)), np.zeros(81)], axis=1)
    for which in range(things):
        vertices, faces = superellipsoid(rng)
        surface, body = Surface(vertices, faces), field.Body(field.shell(vertices, *PANELS))
        poses = [_placed(surface, vertices, board, rng) for _ in range(EACH)]
        for x, T in filter(None, poses):
            rows.append((which, x, pad.change(body, T)))
        if progress and task is not None:
            progress.advance(task)
    thing, x, change = (np.array(column) for column in zip(*rows, strict=True))
    return Scenes(thing, x, np.minimum(change, _most(kind)))


def _placed(surface: Surface, vertices: Array, board: Array, rng: np.random.Generator) -> tuple[Array, Array] | None:
    """x (4,) of an object whose nearest point is at a random distance and direction, and T_pad_thing (4, 4); None if no pose
    before the pad was found. board (b, 3): points of the pad's board."""
    for _ in range(20):
        wanted = math.exp(rng.uniform(math.log(DISTANCES[0]), math.log(DISTANCES[1])))
        way = rng.standard_normal(3)
        way /= np.linalg.norm(way)
        start, low, high = 0.5 * vertices[rng.integers(len(vertices))], 0.0, 1.0
        for _ in range(30):
            middle = 0.5 * (low + high)
            short = float(surface.nearest((start + middle * way)[None])[0][0]) < wanted
            low, high = (middle, high) if short else (low, middle)
        origin = start + high * way
        distance, nearest, _ = surface.nearest(origin[None])
        toward = (nearest[0] - origin) / distance[0]
        cosine = rng.uniform(math.cos(STEEPEST), 1.0)
        beside = np.cross(toward, rng.standard_normal(3))
        z = cosine * toward + math.sqrt(1.0 - cosine**2) * beside / np.linalg.norm(beside)
        x = np.cross(z, rng.standard_normal(3))
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3] = np.stack([x, np.cross(z, x), z])
        T[:3, 3] = -T[:3, :3] @ origin
        if rigid.apply(T, vertices)[:, 2].min() > CLEAR:
            gap = float(surface.nearest((board - T[:3, 3]) @ T[:3, :3])[0].min())
            return np.array([math.log(distance[0]), *(T[:3, :3] @ toward)[:2], math.log(gap)]), T
    return None


def _most(kind: PadType) -> float:
    """Largest change [fF] that the converter can measure."""
    span = kind.chain.adc_reference / 2.0 - kind.rest.a3 if kind.rest.polarity > 0 else kind.rest.a3
    return span / kind.chain.sensitivity


def beside_forearm(kind: PadType, cell: cells.Cell, target: str, scenes: Scenes) -> tuple[Array, Array]:
    """The log gap (n,) of the forearm that gives each scene's total signal, and x and r of the scene relative to it (n, 4 +
    e)."""
    mesh = target_mesh(cell.targets[target], cell)
    pad, body = field.PadField(kind), field.limb(mesh)
    solved = np.log([np.minimum(pad.change(body, T), _most(kind)) for T in across(Surface(mesh.vertices, mesh.faces))])
    logs = extended(solved.reshape(2, len(GAPS), -1).mean(axis=0))
    totals = np.log(np.exp(logs).sum(axis=1))
    gap = np.interp(-np.log(scenes.change.sum(axis=1)), -totals, np.log(GAPS))
    at = np.stack([np.interp(gap, np.log(GAPS), own) for own in logs.T], axis=1)
    x = scenes.x.copy()
    x[:, SCALES] -= gap[:, None]
    return gap, np.concatenate([x, np.log(scenes.change) - at], axis=1)


def statistics(gap: Array, y: Array) -> tuple[Array, Array]:
    """Mean (m, 4 + e) and covariance (m, 4 + e, 4 + e) of rows y (n, 4 + e) at TABLE, by linear regression on log gaps (n,) with
    a Gaussian kernel."""
    means, covariances = [], []
    for centre in np.log(TABLE):
        away = gap - centre
        weight = np.exp(-0.5 * (away / WIDTH) ** 2)
        weight /= weight.sum()
        A = np.stack([np.ones_like(away), away], axis=1)
        line = np.linalg.solve((A * weight[:, None]).T @ A, (A * weight[:, None]).T @ y)
        left = y - A @ line
        means.append(line[0])
        covariances.append((left * weight[:, None]).T @ left)
    return np.array(means), np.array(covariances)


def score(shapes: Shapes, gap: Array, y: Array) -> dict[str, float]:
    """Root mean square errors of log distance, direction and log gap, and the NEES of the point per degree of freedom, on scenes
    without noise."""
    mean, C = shapes.at(np.exp(gap))
    gain = np.linalg.solve(C[:, X:, X:] + MODEL_ERROR**2 * np.eye(y.shape[1] - X), C[:, X:, :X]).transpose(0, 2, 1)
    error = (y - mean)[:, :X] - np.einsum("nij,nj->ni", gain, (y - mean)[:, X:])
    left = (C[:, :X, :X] - gain @ C[:, X:, :X])[:, :3, :3]
    nees = np.einsum("ni,ni->n", error[:, :3], np.linalg.solve(left, error[:, :3, None])[:, :, 0]) / 3.0
    rms = np.sqrt(np.mean(error**2, axis=0))
    return {
        "log_distance": round(float(rms[0]), 4),
        "direction": round(float(np.hypot(rms[1], rms[2])), 4),
        "log_gap": round(float(rms[3]), 4),
        "nees": round(float(nees.mean()), 3),
    }


def export(
    kind: PadType, cell: cells.Cell, target: str, own: str, path: Path, options: Any, progress: Progress
) -> dict[str, Any]:
    """Fit one pad type; write its file and card."""
    scenes = drawn(kind, options.things, options.seed, progress)
    gap, y = beside_forearm(kind, cell, target, scenes)
    unseen = scenes.thing % HELD_OUT == 0
    shapes = Shapes(TABLE, *statistics(gap[~unseen], y[~unseen]))
    held_out = score(shapes, gap[unseen], y[unseen])
    arrays = {"gaps": TABLE, "mean": shapes.mean, "covariance": shapes.covariance, "error": np.array(held_out["log_distance"])}
    np.savez_compressed(path, fingerprint=np.array(own), **{name: np.float32(each) for name, each in arrays.items()})  # type: ignore[arg-type]
    card = {
        "made_by": f"penumbra haptics shapes --cell {options.cell} --target {target} --seed {options.seed}",
        "date": datetime.date.today().isoformat(),
        "seed": options.seed,
        "fingerprint": own,
        "settings": {
            "things": options.things,
            "scenes": len(y),
            "half_axes_m": HALF,
            "longest_m": LONGEST,
            "distances_m": DISTANCES,
        },
        "held_out": held_out,
    }
    path.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n")
    return card


@flags.command(
    "haptics shapes",
    "Measures what things of unknown shape do to the signals of a cell's pads, for the points of surfaces.",
    flags.CELL,
    flags.Option("--target", show_default="the cell's first", help="the target whose signals are compared with"),
    flags.Option("--seed", type=int, default=1, help="draws the things"),
    flags.Option("--things", type=flags.positive, default=140, help="how many"),
    flags.Option("--out", type=Path, default=WEIGHTS, show_default="the folder that the service loads", help="folder"),
    example="penumbra haptics shapes --cell mine.yaml",
)
def main(options: flags.Options) -> int:
    """Fit every pad design of the cell."""
    cell = cells.load(options.cell)
    target = cell.one("targets", options.target)
    kinds = {fingerprint(cell, name, target, bare=True): pad.type for name, pad in cell.pads.items()}
    if not kinds:
        raise cells.CellError(f"cell {cell.name} has no pads: nothing to fit")
    with Progress() as progress:
        for own, name in kinds.items():
            path = options.out / f"shapes-{name}.npz"
            card = export(cell.pad_types[name], cell, target, own, path, options, progress)
            progress.console.print(f"{path} and its card: {json.dumps(card['held_out'])}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
