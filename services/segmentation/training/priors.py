"""Draws priors for training and evaluation: right (with errors), wrong, and missing ones.

A network that only saw right priors would rely on them and ignore the picture. Here the stated uncertainty is drawn widely, some
errors exceed it, a target is sometimes shown elsewhere or turned, some frames are late, and some priors are missing, also within
a sequence.
"""

from __future__ import annotations

import functools
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from penumbra.services.segmentation import priors
from penumbra.services.segmentation.model import PRIORS
from penumbra.shared.body import anatomy
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import TARGET_LABELS
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.intrinsics import Intrinsics
from penumbra.sim.sets.sequences import Sequence

Kind = Literal["right", "wrong", "missing"]
TARGET_SHARES: dict[Kind, float] = {"right": 0.38, "wrong": 0.24, "missing": 0.38}
ROBOT_SHARES: dict[Kind, float] = {"right": 0.48, "wrong": 0.14, "missing": 0.38}
"""Probability of each kind of prior in a sequence. Wrong ones are far more frequent than in use, so that the picture decides."""
SWITCHED = 0.25
"""Share of the sequences with a prior in which it ends at, or starts from, a random frame."""
STATED_M, STATED_RAD, STATED_PX = (0.002, 0.06), (0.02, 0.5), (2.0, 25.0)
"""Bounds of the stated standard deviations, drawn log-uniformly. The last is for priors that are made from labels: a sharper one
would give away the outline, while the mesh of a limb has its own fingers."""
UNDERSTATED = 0.5
"""Standard deviation of the logarithm of an error's ratio to its stated deviation: occasionally the error is three times the
stated deviation."""
LATEST = 2
"""Maximum number of frames by which a target's prior is late."""
CALIBRATION_PX = 1.0
"""Standard deviation [px] of a robot's silhouette from its place in the picture."""
FEWEST = 30
"""Minimum number of pixels of an arm, over all frames, that may be shown alone."""


def packed(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Priors in [-1, 1] as bytes, for storage beside pictures."""
    return np.rint(128.0 + 127.0 * values).astype(np.uint8)


def unpacked(values: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Priors in [-1, 1] from bytes."""
    return (values.astype(np.float32) - np.float32(128.0)) / np.float32(127.0)


def of_sequence(sequence: Sequence, rng: np.random.Generator, kind: Kind | None = None) -> NDArray[np.float32]:
    """Priors (frames, h, w, 2) of a simulated sequence, all of one kind, or of a random kind per channel; missing if a sequence
    has no poses, or no silhouettes of robots."""
    out = np.zeros((*sequence.labels.shape, len(PRIORS)), np.float32)
    if sequence.robots is not None:
        robot = kind or _drawn(ROBOT_SHARES, rng)
        if robot != "missing":
            out[..., 0] = _switched(_robots(sequence.robots, robot, rng), rng, kind is None)
    if sequence.poses is not None:
        target = kind or _drawn(TARGET_SHARES, rng)
        if target != "missing":
            k = Intrinsics(*sequence.poses.intrinsics)
            _, height, width = sequence.labels.shape
            found = _predicted(sequence.poses.T_camera_target, k, (height, width), target, rng)
            out[..., 1] = _switched(found, rng, kind is None)
    return out


def of_labels(labels: NDArray[np.uint8], rng: np.random.Generator, kind: Kind | None = None) -> NDArray[np.float32]:
    """Priors (frames, h, w, 2) of a sequence from its labels (frames, h, w) alone: the target is the labelled pixels, half of the
    time only one of several arms, as a pose gives one arm. Robots are unknown."""
    out = np.zeros((*labels.shape, len(PRIORS)), np.float32)
    target = kind or _drawn(TARGET_SHARES, rng)
    shown = np.isin(labels, TARGET_LABELS)
    if target == "missing" or not shown.any():
        return out
    if rng.random() < 0.5:
        shown = _one_arm(shown, rng)
    out[..., 1] = _switched(_moved(shown, target, rng), rng, kind is None)
    return out


def _drawn(shares: dict[Kind, float], rng: np.random.Generator) -> Kind:
    return tuple(shares)[rng.choice(len(shares), p=list(shares.values()))]


def _switched(film: NDArray[np.float32], rng: np.random.Generator, may_switch: bool) -> NDArray[np.float32]:
    """A prior's film (frames, h, w), at random without its first or last frames."""
    if may_switch and rng.random() < SWITCHED:
        frame = int(rng.integers(1, max(len(film), 2)))
        film[slice(0, frame) if rng.random() < 0.5 else slice(frame, None)] = 0.0
    return film


def _log_uniform(bounds: tuple[float, float], rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(*np.log(bounds))))


def _direction(count: int, rng: np.random.Generator) -> Array:
    v = rng.normal(size=count)
    return v / np.linalg.norm(v)


@functools.cache
def _mesh() -> Mesh:
    """The target's mesh in a cell, which never quite matches the person's arm."""
    cell = cells.load("table")
    return anatomy.target_mesh(next(iter(cell.targets.values())), cell)


def _predicted(
    T_camera_target: Array, k: Intrinsics, shape: tuple[int, int], kind: Kind, rng: np.random.Generator
) -> NDArray[np.float32]:
    """The target's prior (frames, h, w) at its poses (frames, 4, 4) with an error that changes slowly."""
    metres, turn = _log_uniform(STATED_M, rng), _log_uniform(STATED_RAD, rng)
    stated = np.array([metres, metres, metres * rng.uniform(1.0, 4.0), turn, turn, turn])
    error: Array = stated * rng.normal(size=6) * np.exp(rng.normal(0.0, UNDERSTATED))
    elsewhere = np.zeros(6)
    if kind == "wrong":
        elsewhere = np.concatenate([_direction(3, rng) * rng.uniform(0.08, 0.4), _direction(3, rng) * rng.uniform(0.5, np.pi)])
    late, drift = int(rng.integers(0, LATEST + 1)), rng.normal(0.0, 0.1)
    out = np.zeros((len(T_camera_target), *shape), np.float32)
    for t in range(len(out)):
        T = rigid.perturb(T_camera_target[max(t - late, 0)], elsewhere + (1.0 + drift * t) * error)
        share = priors.silhouette(_mesh(), T, np.diag(stated**2), k, shape)
        if share is not None:
            out[t] = priors.combined([share], True, shape)
    return out


def _robots(robots: NDArray[np.bool_], kind: Kind, rng: np.random.Generator) -> NDArray[np.float32]:
    """The robots' prior (frames, h, w) from their silhouettes, with a small or a large offset."""
    place = np.array([[1.0, 0.0, rng.normal(0.0, CALIBRATION_PX)], [0.0, 1.0, rng.normal(0.0, CALIBRATION_PX)]])
    if kind == "wrong":
        height, width = robots.shape[1:]
        place = np.asarray(cv2.getRotationMatrix2D((width / 2.0, height / 2.0), rng.uniform(-180.0, 180.0), 1.0), float)
        place[:, 2] += _direction(2, rng) * rng.uniform(10.0, 60.0)
    return 2.0 * _warped(robots, place, cv2.INTER_NEAREST) - 1.0


def _warped(film: NDArray[np.bool_], place: NDArray[Any], how: int) -> NDArray[np.float32]:
    """A film (frames, h, w) moved by an affine transform (2, 3)."""
    size = (film.shape[2], film.shape[1])
    return np.stack([cv2.warpAffine(frame, place, size, flags=how) for frame in film.astype(np.float32)])


def _one_arm(shown: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.bool_]:
    """One of the components of the target's pixels (frames, h, w), connected in space and time."""
    parts, _ = ndimage.label(shown, np.ones((3, 3, 3)))
    sizes = np.bincount(parts.ravel())[1:]
    large = np.flatnonzero(sizes >= FEWEST) + 1
    return np.asarray(parts == rng.choice(large)) if len(large) > 1 else shown


def _moved(shown: NDArray[np.bool_], kind: Kind, rng: np.random.Generator) -> NDArray[np.float32]:
    """The target's prior (frames, h, w) from its pixels, moved, turned, scaled, late and blurred."""
    stated = _log_uniform(STATED_PX, rng)
    rows, columns = np.nonzero(shown.any(0))
    factor = stated * np.exp(rng.normal(0.0, UNDERSTATED))
    extent = max(float(np.hypot(np.ptp(rows), np.ptp(columns))), 2.0 * factor)
    shift: Array = factor * rng.normal(size=2)
    turn = np.degrees(factor / extent) * rng.normal()
    if kind == "wrong":
        shift = shift + _direction(2, rng) * rng.uniform(0.3, 1.0) * extent
        turn += rng.uniform(30.0, 180.0)
    scale = float(np.exp(rng.normal(0.0, 0.08)))
    place = np.asarray(cv2.getRotationMatrix2D((float(columns.mean()), float(rows.mean())), turn, scale), float)
    place[:, 2] += shift
    film = _warped(shown, place, cv2.INTER_LINEAR)
    wider = int(rng.integers(0, 5))  # a limb's mesh differs from this person's limb, and labels have gaps between its parts
    film = film[np.maximum(np.arange(len(film)) - rng.integers(0, LATEST + 1), 0)]
    soft = [cv2.dilate(frame, np.ones((2 * wider + 1, 2 * wider + 1), np.uint8)) for frame in film]
    return np.stack([2.0 * priors.blurred(np.asarray(frame, np.float32), (stated, stated)) - 1.0 for frame in soft])
