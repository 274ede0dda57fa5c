"""Compares hypotheses about an object's pose by how well they explain the picture.

`search` follows those of `region.hypotheses` from small to large pictures, keeps the best of each stage, and brings them to their
optimum (`settled`); `follow` has one, a prediction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from penumbra.services.search.contour import Model
from penumbra.services.search.objects import basin
from penumbra.services.search.objects.basin import Prior, Shape
from penumbra.services.search.objects.region import Floats, Level, Window, descend, hypotheses, lines
from penumbra.services.search.settings import ONE_IN_10_000
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

FIRST, KEPT = 12, (6, 4, 3)
"""Number of hypotheses that are followed at first, and kept after each stage."""
COLOURED = (60, 8)
"""Number of hypotheses whose colours are compared with the mesh's, if it has some, and number of those that are followed in
addition."""
BY_PAINT = 5.0
"""Weight of the log-likelihood of the mesh's colours relative to the score of a shifted contour. With 3 to 10, one in eleven to
one in five of the first hypotheses of simulated objects that are near the truth were not near it without the colours."""
CONVINCING = 3.0
"""Log-likelihood of the mesh's colours from which they prove a pose: 20 to 1."""
AGAIN = (9.0, 21.0, 33.0), 20
"""Angles [deg], and number of axes, by which the starts are turned for a second search: if the best pose is refuted, and, for a
mesh with colours, if neither colours nor contour are convincing."""
REFUTED = 0.0
"""Log-likelihood below which a pose explains the picture less well than a contour anywhere else: it is wrong, however much of its
contour happens to lie on edges."""
SUPPORTED = (0.35, 0.65)
"""Share of the contour that lies on edges, below which a pose is lost, and below which it is doubtful. On photographs, right
poses have 0.7 to 1 if nothing hides the object, and few that are far off have more than 0.6."""
SAME_START = (0.012, 0.2)
"""Shifted hypotheses nearer than this [m, rad] count as one."""
SCORED_PX = 30.0
"""Length of contour [px] whose offsets count as one in the likelihood of a pose."""
SETTLING = (4,) * 8
"""Reaches of the lines in the last steps [px]. Distance and tilt together hardly change the contour, so each step covers only a
small part of the way to their optimum."""
LEAST_SUPPORT = 0.05
"""Minimum likelihood of an offset near zero, relative to that of any offset: an occluder makes a few lines wrong, not the
pose."""
SCORING = 7
"""Reach of the lines by which poses are compared [px]."""


@dataclass(frozen=True)
class Found:
    """A pose T_camera_object; `score`: log-likelihood of its contour and colours relative to any others, and of the start;
    `colours`: that of the colours alone, 0 if the mesh has none; `support`: share of the contour's length that lies on an edge;
    `length`: of the visible contour [px of the image]; `level`: picture in which it was compared."""

    T: Array
    score: float
    colours: float
    support: float
    length: float
    level: Level


def scored(shape: Shape, model: Model, at: Level, T: Array, prior: Prior, creases: bool) -> Found:
    """How well a pose explains a picture."""
    contour = lines(shape, model, at, T, SCORING)
    length = float(contour.length.sum())
    if length <= 0.0:
        return Found(T, -math.inf, 0.0, 0.0, 0.0, at)
    score = float(contour.length @ np.log(np.maximum(contour.support, LEAST_SUPPORT)))
    if creases:
        inside = lines(shape, model, at, T, SCORING, True)
        score += float(inside.length @ np.log(np.maximum(inside.support, LEAST_SUPPORT)))
    score = score / SCORED_PX - 0.5 * prior.cost(T)
    compared = at.compared(shape, T)
    colours = 0.0 if compared is None else compared.score
    support = float(contour.length @ (contour.support > 1.0)) / length
    return Found(T, score + colours, colours, support, length * at.scale, at)


def search(shape: Shape, window: Window, prior: Prior, reach: float) -> list[Found]:
    """The poses T_camera_object near the prior, up to `reach` [m] to the side, that explain the picture best, best first."""
    model, starts = shape.coarse, basin.starts(prior.T)
    table = of_mask = window.of_mask()
    if table is None:
        rng = np.random.default_rng(0)
        shifts = rng.normal(0.0, 0.25 * reach, (len(starts), 3))
        table = window.of_poses(model, [rigid.perturb(T, [*way, 0.0, 0.0, 0.0]) for T, way in zip(starts, shifts, strict=True)])
    at = window.level(window.factors[0], table)
    found = followed(shape, window, prior, of_mask, first(shape, at, hypotheses(model, at, starts, prior, reach)))
    unproved = not found or (found[0].colours < CONVINCING and found[0].support < SUPPORTED[1])
    if not found or found[0].score < REFUTED or (shape.paints is not None and unproved):
        more = hypotheses(model, at, basin.starts(prior.T, *AGAIN), prior, reach)
        found = sorted([*found, *followed(shape, window, prior, of_mask, first(shape, at, more))], key=lambda one: -one.score)
    return found


def followed(shape: Shape, window: Window, prior: Prior, of_mask: Floats | None, poses: list[Array]) -> list[Found]:
    """The poses to which hypotheses lead from small to large pictures, best first, with the log-odds of the mask's colours, or,
    if None, of those inside and around each pose's silhouette."""
    factors = window.factors
    stages = [(factors[0], shape.coarse, (7, 7, 6, 6), 0.06), (factors[0], shape.coarse, (6, 5), 0.03)]
    stages += [(factor, shape.fine, (7, 6, 5), 0.02) for factor in factors[1:]]
    stages += [(factors[-1], shape.fine, (5, 4, 4, 4), 0.015)]
    found: list[Found] = []
    for i, (factor, model, reaches, gap) in enumerate(stages):
        found, last = [], factor == factors[-1]
        for T in poses:
            at = window.level(factor, window.of_pose(shape.coarse, T, gap) if of_mask is None else of_mask)
            T = descend(shape, model, at, T, prior, reaches, last)
            if prior.cost(T) < ONE_IN_10_000:
                found.append(scored(shape, model, at, T, prior, last))
        found.sort(key=lambda one: -one.score)
        poses = distinct([one.T for one in found], basin.SAME, KEPT[min(i, len(KEPT) - 1)])
    return settled(shape, [one for one in found if any(one.T is T for T in poses)], prior)


def first(shape: Shape, at: Level, found: list[tuple[float, Array]]) -> list[Array]:
    """Selects the hypotheses to follow from all with their scores, best first: those with the best contours, and, if the mesh has
    colours, those with the best contours and colours together."""
    poses = distinct([T for _, T in found], SAME_START, FIRST)
    if at.painted is None:
        return poses
    votes = {id(T): vote for vote, T in found}
    many = distinct([T for _, T in found], SAME_START, COLOURED[0])
    colours = [at.compared(shape, T) for T in many]
    both = [votes[id(T)] + BY_PAINT * (one.score if one is not None else 0.0) for T, one in zip(many, colours, strict=True)]
    best = distinct([many[i] for i in np.argsort(both)[::-1]], SAME_START, COLOURED[1])
    return poses + [T for T in best if not any(T is other for other in poses)]


def settled(shape: Shape, found: list[Found], prior: Prior) -> list[Found]:
    """The poses after more steps on the same picture and with the same colours, best first."""
    poses = [(one.level, descend(shape, shape.fine, one.level, one.T, prior, SETTLING, True)) for one in found]
    return sorted((scored(shape, shape.fine, at, T, prior, True) for at, T in poses), key=lambda one: -one.score)


def distinct(poses: list[Array], same: tuple[float, float], most: int) -> list[Array]:
    """The poses that have no earlier one nearer than `same` [m, rad], at most `most` of them."""
    kept: list[Array] = []
    for T in poses:
        errors = [rigid.pose_error(T, other) for other in kept]
        if all(np.linalg.norm(e[:3]) > same[0] or np.linalg.norm(e[3:]) > same[1] for e in errors):
            kept.append(T)
        if len(kept) == most:
            break
    return kept


def follow(shape: Shape, window: Window, table: Floats, prior: Prior) -> Found:
    """The pose near a prediction, by known log-odds (BINS^3,) of the colours."""
    small, large = window.factors[max(len(window.factors) - 2, 0)], window.factors[-1]
    T = descend(shape, shape.coarse, window.level(small, table), prior.T, prior, (7, 6), small == large, near=True)
    at = window.level(large, table)
    T = descend(shape, shape.fine, at, T, prior, (5, 4), True, near=True)
    return scored(shape, shape.fine, at, T, prior, True)
