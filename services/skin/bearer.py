"""Fits the networks of `shared.skin.bearer` to boundary elements: what upper arm and torso add to the signals of a forearm.

Persons of random sizes in random postures, each at several poses before the pad. A field is solved with the forearm alone and
with the whole person, by the same panels, and the network learns the logarithm of the ratio.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from rich.progress import Progress

from penumbra.services.skin import fitting
from penumbra.shared.body.anatomy import Mesh, torso_mesh, upper_arm_mesh
from penumbra.shared.body.posture import frame
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.bearer import Bearer, inputs
from penumbra.sim.skin.field import Body, PadField, Panels, limb, shell

if TYPE_CHECKING:
    from penumbra.services.skin.model import Poses

PANELS, PART_PANELS = (30, 16), (14, 12)
"""Rows and columns of panels on forearm with hand, and on upper arm and torso."""
EACH = 12
"""Number of poses of a person before a pad."""
ELBOW = (np.radians(50.0), np.radians(175.0))
"""Bounds of the angle between forearm and upper arm [rad]."""
RAISED = -0.2
"""Minimum cosine between the upper arm, from elbow to shoulder, and the vertical."""
FAINTEST = 1e-4
"""Change [fF] below which a result is a numerical error."""
FARTHEST = 0.35
"""Maximum gap [m] of a forearm."""
CLEAR = 0.01
"""Minimum distance [m] of upper arm and torso from board and link."""
HIDDEN, BATCH = 32, 256
"""Units of the hidden layers, and samples per training step."""
BANDS = (0.004, 0.03, 0.06, 0.12, 0.17, 0.25, 0.35)
"""Limits of the gap bands [m] of the reported errors."""


@dataclass(frozen=True)
class Solved:
    """Solved fields: poses (n, 3, 4, 4) of limb, upper arm and torso in the pad's frame, gaps (n,) [m] of the limb; logarithms
    (n, e) of the limb's own changes [fF], and of the ratio of the whole person's to them."""

    T: Array
    gap: Array
    own: Array
    ratio: Array


@dataclass(frozen=True)
class Whole:
    """A person: panels of upper arm and torso, each in its own frame, with their poses T_limb_parts, and the forearm alone and
    the whole person as bodies in the forearm's frame."""

    parts: list[Panels]
    T_limb_parts: list[Array]
    alone: Body
    whole: Body


def person(mesh: Mesh, body: cells.Body, size: Array, rng: np.random.Generator) -> Whole:
    """A person whose forearm has this size (2,), in a random posture: elbow, way round the forearm, and torso."""
    forearm = limb(mesh, float(np.exp(size[0])), float(np.exp(size[1])), *PANELS)
    parts = [shell(each.vertices, *PART_PANELS) for each in (upper_arm_mesh(body), torso_mesh(body))]
    inner, round_ = rng.uniform(*ELBOW), rng.uniform(0.0, 2.0 * np.pi)
    toward = np.array([np.cos(inner), np.sin(inner) * np.cos(round_), np.sin(inner) * np.sin(round_)])  # from elbow to shoulder
    shoulder = toward * body.upper_arm_length - [0.5 * body.forearm_length * np.exp(size[0]), 0.0, 0.0]
    up = _direction(rng)
    while up @ toward < RAISED:
        up = _direction(rng)
    forward = _about(up, _direction(rng))[:, 1]
    torso = np.column_stack([forward, np.cross(up, forward), up])
    T = [frame(_about(-toward, up), shoulder), frame(torso, shoulder)]
    placed = [rigid.apply(own, each.corners) for own, each in zip(T, parts, strict=True)]
    return Whole(parts, T, forearm, Body(Panels(np.concatenate([forearm.panels.corners, *placed]))))


def _direction(rng: np.random.Generator) -> Array:
    out = rng.standard_normal(3)
    return out / np.linalg.norm(out)


def _about(x: Array, other: Array) -> Array:
    """A rotation (3, 3) whose first column is along x (3,), and whose second is across that and the other vector (3,)."""
    x = x / np.linalg.norm(x)
    y = np.cross(other, x)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def solve(field: PadField, poses: Poses, mesh: Mesh, body: cells.Body, count: int, progress: Progress | None = None) -> Solved:
    """Solve about `count` fields of random persons."""
    drawn = [drawn for drawn in (poses.draw() for _ in range(2 * count)) if drawn[2] < FARTHEST][:count]
    rows: list[tuple[Array, float, Array, Array]] = []
    task = progress.add_task("persons", total=len(drawn)) if progress else None
    for which, T, gaps in _grouped(drawn):
        one = person(mesh, body, poses.sizes[which], poses.rng)
        for T_pad_limb, gap in zip(T, gaps, strict=True):
            T_pad_parts = [T_pad_limb @ own for own in one.T_limb_parts]
            placed = [rigid.apply(own, each.centroids) for own, each in zip(T_pad_parts, one.parts, strict=True)]
            rest = np.concatenate(placed)
            if np.linalg.norm(rest[:, None] - poses.solid, axis=2).min() < CLEAR or np.linalg.norm(rest, axis=1).min() < gap:
                continue
            own = field.change(one.alone, T_pad_limb)
            ratio = field.change(one.whole, T_pad_limb) / own
            if (own > FAINTEST).all() and (ratio > 0.0).all():
                rows.append((np.stack([T_pad_limb, *T_pad_parts]), gap, np.log(own), np.log(ratio)))
        if progress and task is not None:
            progress.advance(task, len(T))
    if progress and task is not None:
        progress.remove_task(task)
    return Solved(*(np.array(column) for column in zip(*rows, strict=True)))


def _grouped(drawn: list[tuple[Array, int, float]]) -> Iterator[tuple[int, list[Array], list[float]]]:
    """Poses of forearms of the same size, up to EACH of them."""
    for which, group in itertools.groupby(sorted(drawn, key=lambda one: one[1]), key=lambda one: one[1]):
        own = list(group)
        for first in range(0, len(own), EACH):
            some = own[first : first + EACH]
            yield which, [T for T, _, _ in some], [gap for _, _, gap in some]


def pieces(body: cells.Body) -> Array:
    """Pieces (2, 7, k) of upper arm and torso: see `shared.skin.bearer.Bearer`."""
    panels = [shell(mesh.vertices, *PART_PANELS) for mesh in (upper_arm_mesh(body), torso_mesh(body))]
    return np.stack([np.column_stack([each.centroids, each.normals, each.areas]).T for each in panels])


def fit(data: Solved, points: Array, seed: int, steps: int) -> Bearer:
    """Train a network of the ratio's logarithm."""
    torch.manual_seed(seed)
    rng = np.random.default_rng([seed, 46])
    own = inputs(points, data.T, data.own)
    mean, scale = own.mean(axis=0), own.std(axis=0) + 1e-9
    layers = [
        torch.nn.Linear(own.shape[1], HIDDEN),
        torch.nn.Linear(HIDDEN, HIDDEN),
        torch.nn.Linear(HIDDEN, data.ratio.shape[1]),
    ]
    model = torch.nn.Sequential(layers[0], torch.nn.Tanh(), layers[1], torch.nn.Tanh(), layers[2])
    fitting.learn(model, (own - mean) / scale, data.ratio, rng, steps, BATCH, rate=4e-3, decay=0.05)
    return Bearer(points, mean, scale, *fitting.parameters(layers))


def score(bearer: Bearer, data: Solved) -> dict[str, dict[str, float]]:
    """Median and 95th percentile of the error of the whole person's signals [%], and of what leaving the rest of the person out
    would be, per band of the gap [cm]."""
    found = 100.0 * np.abs(np.expm1(bearer.logs(data.T, data.own) - data.ratio))
    return fitting.score(data.gap, BANDS, {"": found, "left_out_": 100.0 * np.abs(np.expm1(-data.ratio))})
