"""Limbs and other things that come near a skin: their bodies, and their paths past the pads.

A thing comes from 20 cm along the pads' normal to a gap of 2 to 10 cm. There it stays, or slides past. Voltages come from the
full boundary-element model. Sizes, places and paths are random; every second thing comes to rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import trimesh
from numpy.typing import NDArray
from rich.table import Table
from scipy.interpolate import CubicSpline

from penumbra.services.haptics.estimator import Estimator
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.layout import Skin
from penumbra.sim.skin import field
from penumbra.tests.bench.lib.results import Result, marked

LIMBS = ("limb", "limb, hand first")
"""Kinds that are limbs: forearm and hand across the middle of the pads, and with the hand alone before them."""
FAR_M, NEAREST_M = 0.20, (0.02, 0.10)
"""Gap at which a path begins, and bounds of the gap at which it leads past the pads [m]."""
APPROACH, SLIDE = (0.15, 0.35), (0.1, 0.3)
"""Bounds of the speeds [m/s] towards the pads and past them."""
PAST_S = 1.0
"""Time [s] for which a thing is at its smallest gap."""
KNOT_S = 0.05
"""Interval [s] at which fields are solved; in between a spline interpolates the signals."""
FAINT = 1e-4
"""Signal [V] above which the logarithm is interpolated, and below which the signal itself is."""
LENGTH, GIRTH = (-0.1, 0.1), (-0.27, 0.11)
"""Bounds of a limb's log sizes: from the 5th percentile of women to the 95th of men (ANSUR II)."""
PANELS = (24, 16)
"""Numbers of rows and columns of a thing's panels."""
SCALE = (-0.2, 0.2)
"""Bounds of the log of a thing's size, relative to that of OBJECTS."""


def _rod(radius: float, length: float) -> trimesh.Trimesh:
    """A closed cylinder along x."""
    rod = trimesh.creation.cylinder(radius, length, sections=24)
    rod.apply_transform(rigid.from_rpy((0.0, 0.0, 0.0), (0.0, np.pi / 2.0, 0.0)))
    return rod


def _block(*size: float) -> trimesh.Trimesh:
    return trimesh.creation.box(size)


GROUNDED, FLOATING = np.inf, 0.0
OBJECTS: dict[str, tuple[Callable[[], trimesh.Trimesh], float, float | None]] = {
    "metal bar, grounded": (lambda: _rod(0.015, 0.40), GROUNDED, None),
    "metal bar, floating": (lambda: _rod(0.015, 0.40), FLOATING, None),
    "metal tube, grounded": (lambda: _rod(0.040, 0.40), GROUNDED, None),
    "metal tube, floating": (lambda: _rod(0.040, 0.40), FLOATING, None),
    "metal plate, grounded": (lambda: _block(0.12, 0.12, 0.03), GROUNDED, None),
    "bottle of water": (lambda: _rod(0.035, 0.20), FLOATING, None),
    "plastic block": (lambda: _block(0.12, 0.08, 0.05), FLOATING, 3.0),
}
"""Mesh, capacitance to ground [pF] and permittivity of things that are no limbs. The tube is as long and thick as a forearm. Tap
water conducts at 100 kHz, and its bottle is thin."""


SEEN = ("limb, seen", "limb, hand first, seen")
"""The kinds of LIMBS when a camera sees them until they arrive at the pads."""
KINDS = (*LIMBS, *SEEN, *OBJECTS)
SEEN_SIGMA = (0.005, 0.05)
"""Standard deviations [m, rad] of the camera's pose: chosen as those of a fused pose that uses a camera."""
WINDOW_S, SAMPLES = 0.01, 10
"""Length [s] of a window, and number of samples in it."""
HOME_SPREAD = np.repeat([0.12, 0.4], 3)
"""Standard deviations [m, rad] of the target about its home, as in the built-in cells."""
TAKEN_GOAL, REFUSED_GOAL_S = 0.01, 0.1
"""Goals: maximum share of objects called a limb, and maximum time [s] for which a limb is called an object."""
LATE_S = 0.5
"""Time [s] after a thing is first felt from which on it must not be misclassified."""


class Pads(Protocol):
    """The part of a rig that is used here: its pads (p, 4, 4), joints (j,), and the limb's mesh and home (4, 4)."""

    pads: Array
    joints: Array
    mesh: Mesh
    skin: Skin
    home: Array

    def estimator(self, home: Array, spread: Array) -> Estimator:
        """A new estimator that expects the target at home (4, 4), with standard deviations spread (6,)."""

    def samples(self, count: int) -> NDArray[np.int64]:
        """Numbers of samples (n,) in a window on `count` pads."""

    def voltages(self, signal: Array, rng: np.random.Generator) -> Array:
        """Samples (s, n) [V] of signals (s, n)."""

    def signal(self, body: field.Body, T: Array, count: int) -> Array:
        """Signals (n,) [V] of a body at T (4, 4)."""

    def place(self, rng: np.random.Generator, gap: float, count: int) -> tuple[Array, Array]:
        """T (4, 4) of a limb at a gap [m], and its size (2,)."""

    def axes(self, T: Array, count: int) -> Array:
        """Directions (6, 6): along, across, away."""


@dataclass(frozen=True)
class Pass:
    """A thing's path. arrival_s: when it is at its smallest gap; stamps_s (w,): middles of the windows; signals (w, n) [V]: the
    true ones; gaps (w,) [m]; poses (w, 4, 4)."""

    arrival_s: float
    stamps_s: Array
    signals: Array
    gaps: Array
    poses: Array


def passing(rig: Pads, kind: str, seed: int, k: int) -> Pass:
    """The k-th path of one of KINDS, in windows of WINDOW_S."""
    rng = np.random.default_rng([seed, 500, KINDS.index(kind), k])
    T, size = rig.place(rng, 0.05, 8)
    if kind in OBJECTS:
        make, ground, permittivity = OBJECTS[kind]
        mesh = make()
        vertices, faces = np.array(mesh.vertices) * np.exp(rng.uniform(*SCALE)), np.array(mesh.faces)
        body = field.Body(field.shell(vertices, *PANELS), ground, permittivity)
    else:
        size = np.array([rng.uniform(*LENGTH), rng.uniform(*GIRTH)])
        vertices, faces = rig.mesh.vertices * np.exp(size[[0, 1, 1]]), rig.mesh.faces
        body = field.limb(rig.mesh, *np.exp(size))
    surface, axes = Surface(vertices, faces), rig.axes(T, 8)[:3, :3]
    if "hand first" in kind:
        T[:3, 3] += (rng.uniform(0.02, 0.10) - vertices[:, 0].max()) * axes[0]  # the hand's end lies past the pads' middle
    electrodes = rig.skin.positions(rig.pads)

    def gap(pose: Array) -> float:
        return float(surface.nearest((electrodes - pose[:3, 3]) @ pose[:3, :3])[0].min())

    nearest = rng.uniform(*NEAREST_M)
    for _ in range(12):
        T[:3, 3] += (nearest - gap(T)) * axes[2]
    approach, turn = rng.uniform(*APPROACH), rng.uniform(0.0, 2.0 * np.pi)
    slide = 0.0 if k % 2 else rng.uniform(*SLIDE)
    arrival_s = (FAR_M - nearest) / approach
    along = slide * (np.cos(turn) * axes[0] + np.sin(turn) * axes[1])

    def at(t: float) -> Array:
        pose = T.copy()
        pose[:3, 3] += max(arrival_s - t, 0.0) * approach * axes[2] + (max(t - arrival_s, 0.0) - 0.5 * PAST_S) * along
        return pose

    end_s = arrival_s + PAST_S
    knots = np.unique([*np.arange(0.0, arrival_s, KNOT_S), *np.linspace(arrival_s, end_s, 1 + round(PAST_S / KNOT_S))])
    still = (knots > arrival_s) & (slide == 0.0)
    solved = [rig.signal(body, at(t), 8) for t in knots[~still]]
    values = np.arcsinh(np.array(solved + [solved[-1]] * int(still.sum())) / FAINT)
    stamps = np.asarray(np.arange(1, int(end_s / WINDOW_S)) * WINDOW_S, np.float64)
    signals: Array = np.asarray(FAINT * np.sinh(CubicSpline(knots, values)(stamps)), np.float64)
    poses = np.array([at(t) for t in stamps])
    return Pass(arrival_s, stamps, signals, np.array([gap(pose) for pose in poses]), poses)


def row(rig: Pads, mounting: str, kind: str, seed: int, passes: int) -> dict[str, Any]:
    """Classification of things of a kind: shares of passes and of windows called a limb later than LATE_S after first being felt,
    the longest time as an object, and the median time until a decision, None where there never is one."""
    taken, windows, refused_s, decided_s, as_object = [], [], 0.0, [], []
    for k in range(passes):
        states = np.array(_called(rig, kind, seed, k))
        felt = np.flatnonzero(states != "out_of_range")
        first = int(felt[0]) if len(felt) else len(states)
        late = states[first + round(LATE_S / WINDOW_S) :] == "in_range"
        taken.append(bool(late.any()))
        windows.append(float(late.mean()) if len(late) else 0.0)
        ends = np.flatnonzero(np.diff(np.concatenate([[False], states == "object", [False]]).astype(int)))
        refused_s = max([refused_s, *(WINDOW_S * (ends[1::2] - ends[::2]))])
        as_object.append(bool((states == "object").any()))
        decided = np.flatnonzero(np.isin(states, ("in_range", "object")))
        if len(decided):
            decided_s.append(WINDOW_S * (int(decided[0]) - first))
    return {
        "kind": kind,
        "mounting": mounting,
        "passes": passes,
        "taken_for_limb": round(float(np.mean(taken)), 3),
        "windows_as_limb": round(float(np.mean(windows)), 3),
        "called_object": round(float(np.mean(as_object)), 3),
        "refused_s": round(float(refused_s), 2),
        "undecided": round(1.0 - len(decided_s) / passes, 3),
        "decided_after_s": round(float(np.median(decided_s)), 2) if decided_s else None,
    }


def _called(rig: Pads, kind: str, seed: int, k: int) -> list[str]:
    """The estimator's states in the windows of a path."""
    rng = np.random.default_rng([seed, 501, KINDS.index(kind), k])
    found, estimator = passing(rig, kind, seed, k), rig.estimator(rig.home, HOME_SPREAD)
    sigma = np.repeat(SEEN_SIGMA, 3)
    states: list[str] = []
    for stamp_s, signal, T in zip(found.stamps_s, found.signals, found.poses, strict=True):
        expected = None
        if kind in SEEN and stamp_s < found.arrival_s:
            expected = rigid.perturb(T, sigma * rng.standard_normal(6)), np.diag(sigma**2)
        amplitude = rig.voltages(np.tile(signal, (SAMPLES, 1)), rng).mean(axis=0)
        estimate = estimator.update(round(1e9 * stamp_s), amplitude, rig.samples(8), rig.pads, rig.joints, expected)
        states.append(estimate.state)
    return states


def table(result: Result) -> Table:
    """The classification of things that pass."""
    table = Table(
        *("array", "thing", "passes", "called a limb later than 0.5 s", "its windows", "called an object", "longest, s"),
        *("never decided", "decided after, s"),
        title=f"Things that pass within 10 cm, seed {result['seed']}",
        caption=f"Goals: at most {TAKEN_GOAL:.0%} of objects called a limb, no limb called an object for longer than "
        f"{REFUSED_GOAL_S:g} s. Seen: a camera saw the limb until it arrived.",
    )
    for row in result["objects"]:
        is_limb = row["kind"].startswith("limb")
        taken, refused = f"{row['taken_for_limb']:.0%}", f"{row['refused_s']:.2f}"
        after = row["decided_after_s"]
        table.add_row(
            *(row["mounting"], row["kind"], str(row["passes"])),
            taken if is_limb else marked(taken, row["taken_for_limb"] <= TAKEN_GOAL),
            f"{row['windows_as_limb']:.0%}",
            f"{row['called_object']:.0%}",
            marked(refused, row["refused_s"] <= REFUSED_GOAL_S) if is_limb else refused,
            f"{row['undecided']:.0%}",
            "" if after is None else f"{after:.2f}",
        )
    return table
