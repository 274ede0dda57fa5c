"""`penumbra bench haptics`: how near the skin's pose comes to what its voltages can tell at all.

Voltages come from the full boundary-element model (`sim.skin.field`), never from the response that the estimator uses: random
limb poses at a given gap, sizes from the 5th percentile woman to the 95th man that the estimator does not know, ten samples
averaged, noise and converter as the cell says. Beside every error stands the Cramér-Rao bound with that size unknown, once with
the broad prior that the first look at a limb has, once with a tracking prior.

Then limbs that rest for ten seconds (what is published, and what the default observer makes of it, against their covariances),
limbs that move through all gaps, and things that are no limb. `--only-surface`: points of surfaces without a shape, and contact.
`--only-drift`: limbs before electrodes whose gains and offsets have drifted. `--only-persons`: limbs with upper arm and torso.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy.interpolate import CubicSpline
from scipy.stats import chi2

from penumbra.services import flags
from penumbra.services.fusion.observer import ErrorStateObserver
from penumbra.services.haptics import paper_network
from penumbra.services.haptics.batches import Collector
from penumbra.services.haptics.estimator import Estimator
from penumbra.services.haptics.service import WEIGHTS, shapes_of
from penumbra.services.haptics.surface_points import SurfacePoints
from penumbra.services.skin.model import links, mountings
from penumbra.shared.body.anatomy import SIZE_SPREAD, target_mesh
from penumbra.shared.body.posture import Posture
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin import bound
from penumbra.shared.skin.layout import Skin, link_names
from penumbra.shared.skin.response import Response, fingerprint
from penumbra.sim.skin import field
from penumbra.tests.bench.lib import drift, persons, results, surfaces, things
from penumbra.tests.bench.lib.results import Part, Result, marked

ARRAYS = {"bare": "table", "hull": "arm"}
"""Cells by array: pads in a table top, and pads on a robot's hull."""
GAPS = (0.01, 0.02, 0.03, 0.05, 0.075, 0.10, 0.125, 0.15, 0.20)
PADS = (8, 4, 1)
SPEEDS = (0.0, 0.5)
SAMPLES, PERIOD_NS = 10, 1_000_000
WINDOW_NS = SAMPLES * PERIOD_NS
BROAD = np.array([0.08, 0.04, 0.04, 0.3, np.radians(8.0), np.radians(15.0)])
"""Standard deviations of the broad prior of a limb without a track: axial, lateral, height [m], roll, pitch, yaw [rad]."""
TRACKING = np.array([0.02, 0.02, 0.02, 0.1, 0.1, 0.1])
GIRTH, LENGTH = (-0.27, 0.11), (-0.1, 0.1)
"""Ranges of the log sizes."""
NAMES = ("axial", "lateral", "height", "roll", "pitch", "yaw")
RATIO_GOAL, MS_GOAL = 1.2, 2.0
NEAR_M = (0.02, 0.15)
"""Range of the gaps [m] for which the first goal holds."""
REST_S, SETTLED_S = 10.0, 1.0
SHOWN = ("lateral", "height", "axial")
RESTING_GAPS = (0.02, 0.03, 0.05, 0.075, 0.10, 0.125, 0.15)
BANDS = ((0.0, 0.04), (0.04, 0.075), (0.075, 0.125), (0.125, 0.175))


@dataclass(frozen=True)
class Plan:
    """Numbers of poses per row, of draws of noise and prior per pose, of resting limbs per gap, of moving limbs and their
    duration [s], and of passes per kind of thing."""

    poses: int
    draws: int
    resting: int
    moving: int
    moving_s: float
    passes: int


FULL, QUICK = Plan(12, 4, 4, 3, 4.0, 3), Plan(2, 2, 1, 1, 1.0, 1)


class Rig:
    """The pads of a cell, a robot that carries them in the middle of its joints' ranges, and their true field.

    pads (p, 4, 4): poses in the world; joints (j,); chosen: indices of the pads that are used, by their number.
    """

    def __init__(self, name: str):
        self.name, self.cell = name, cells.load(ARRAYS[name])
        self.target = self.cell.one("targets", None)
        self.skin = Skin(self.cell)
        self.response = Response(self.cell, self.target)
        self.mesh = target_mesh(self.cell.targets[self.target], self.cell)
        self.surface = Surface(self.mesh.vertices, self.mesh.faces)
        self.home = self.cell.targets[self.target].home.transform
        sim = self.cell.sim
        assert sim is not None, f"cell {self.cell.name}: expected a `sim` section"
        self.joints = (np.array(sim.joints_low) + np.array(sim.joints_high)) / 2.0
        carriers, first = {}, 0
        for robot, model in robot_models(self.cell).items():
            carriers[robot] = model.link_transforms(self.joints[first : first + len(model.joints)])
            first += len(model.joints)
        self.pads = self.skin.T_world_pads(link_names(carriers))
        known = {each.fingerprint: each for each in mountings(self.cell, self.target)}
        fields = {own: field.PadField(each.kind, each.backing) for own, each in known.items()}
        prints = [fingerprint(self.cell, pad, self.target) for pad in self.cell.pads]
        self.fields = [fields[own] for own in prints]
        self._rest = np.zeros(len(self.skin))  # changes by the robot's other links
        if len(self.joints):
            self._rest = np.concatenate([links(self.cell, known[own], self.joints[None])[0] for own in prints])
        self.weights: paper_network.PoseNetwork | None = None
        try:
            self.weights = paper_network.load(WEIGHTS / f"{self.cell.name}-{self.target}.npz", self.cell, self.target)
        except (FileNotFoundError, ValueError) as error:
            print(f"{name}: without a network: {error}", file=sys.stderr)
        self.shapes = shapes_of(self.cell, self.target, WEIGHTS)
        self.points = SurfacePoints(self.skin, self.response, self.surface, self.shapes)
        away = np.linalg.norm(self.pads[:, :3, 3] - self.pads[:, :3, 3].mean(axis=0), axis=1)
        order = np.argsort(away.round(6), kind="stable")
        self.chosen = {count: np.sort(order[:count]) for count in PADS}

    def estimator(self, home: Array, spread: Array, method: str = "solve", posture: Posture | None = None) -> Estimator:
        """A new estimator that expects the target at home (4, 4), with standard deviations spread (6,) along the world's axes."""
        given = self.skin, self.response, self.surface, home, spread, self.weights, method
        return Estimator(*given, shapes=self.shapes, posture=posture)

    def samples(self, count: int) -> np.ndarray:
        """Numbers of samples (n,) of the electrodes in a window when `count` pads are used."""
        return np.where(np.isin(self.skin.pad_of, self.chosen[count]), SAMPLES, 0)

    def signal(self, body: field.Body, T: Array, count: int) -> Array:
        """True signals (n,) [V] of a body at T; zero at pads that are not used."""
        out = np.zeros(len(self.skin))
        for k in self.chosen[count]:
            own = self.skin.of(k)
            out[own] = self.fields[k].change(body, rigid.inverse(self.pads[k]) @ T)
        return out * self.skin.gain * self.skin.sensitivity

    def voltages(self, signal: Array, rng: np.random.Generator) -> Array:
        """Samples (s, n) [V] of these signals (s, n): with the changes by the robot's other links, and noise."""
        skin = self.skin
        clean = skin.amplitude(signal / (skin.gain * skin.sensitivity) + self._rest)
        return np.clip(clean + np.sqrt(skin.noise) * rng.standard_normal(signal.shape), 0.0, skin.full_scale)

    def gap(self, T: Array, size: Array, count: int) -> float:
        """Minimum distance [m] from an electrode in use to the limb's skin."""
        scale = np.exp(size[[0, 1, 1]])
        used = np.isin(self.skin.pad_of, self.chosen[count])
        local = (self.skin.positions(self.pads)[used] - T[:3, 3]) @ T[:3, :3] / scale
        distance, _, gradient = self.surface.nearest(local)
        return float((distance / np.linalg.norm(gradient / scale, axis=1)).min())

    def axes(self, T: Array, count: int) -> Array:
        """Directions (6, 6), one a row, of a pose error by NAMES: along the limb, across it in the pads' plane, along the pads'
        normal, and the turns about these three."""
        axial = T[:3, 0]
        normal = self.pads[self.chosen[count], :3, 2].mean(axis=0)
        normal = normal - (normal @ axial) * axial
        normal /= np.linalg.norm(normal)
        frame = np.stack([axial, np.cross(normal, axial), normal])
        return np.block([[frame, np.zeros((3, 3))], [np.zeros((3, 3)), frame]])

    def place(self, rng: np.random.Generator, gap: float, count: int) -> tuple[Array, Array]:
        """A random pose at a gap above the pads in use, and a random size (2,)."""
        size = np.array([rng.uniform(*LENGTH), rng.uniform(*GIRTH)])
        T = self.home.copy()
        axes = self.axes(T, count)[:3, :3]
        T[:3, 3] = self.pads[self.chosen[count], :3, 3].mean(axis=0)
        T[:3, 3] += np.array([rng.uniform(-0.05, 0.05), rng.uniform(-0.03, 0.03), 0.25]) @ axes
        turn = np.array([0.3 * rng.standard_normal(), rng.uniform(-0.12, 0.12), rng.uniform(-0.26, 0.26)]) @ axes
        T[:3, :3] = rigid.perturb(T, np.concatenate([np.zeros(3), turn]))[:3, :3]
        for _ in range(12):
            T[:3, 3] += (gap - self.gap(T, size, count)) * axes[2]
        return T, size

    def information(self, signal: Array, T: Array, size: Array) -> Array:
        """Fisher information (8, 8) of a window with these true signals (n,) about pose and size, by the response's
        derivatives."""
        J = signal[:, None] * bound.logs(self.skin, self.response, self.pads, T, size)[1]
        return np.asarray(J.T @ (J / (self.skin.noise / SAMPLES)[:, None]))


@dataclass
class Row:
    """Errors by NAMES (trials, 6) and variances of the bound (poses, 6)."""

    errors: list[Array]
    bounds: list[Array]


Scene = tuple[Array, Array, dict[float, Array], np.random.Generator]


def _scene(rig: Rig, seed: int, count: int, gap: float, k: int) -> Scene:
    """A random pose and size, the window's mean signals (n,) by speed, and the random generator for the rest. Limbs that run into
    a pad's link, whose field has no solution, are drawn again."""
    rng = np.random.default_rng([seed, count, int(1e4 * gap), k])
    while True:
        T, size = rig.place(rng, gap, count)
        body = field.limb(rig.mesh, *np.exp(size))
        direction = rng.standard_normal(3)
        step = 0.5 * (WINDOW_NS - PERIOD_NS) * 1e-9 * direction / np.linalg.norm(direction)
        signals = {0.0: rig.signal(body, T, count)}
        for speed in SPEEDS[1:]:  # the mean over the window's way, by Simpson's rule
            ends = [rig.signal(body, rigid.perturb(T, np.append(s * speed * step, np.zeros(3))), count) for s in (-1, 1)]
            signals[speed] = (4.0 * signals[0.0] + ends[0] + ends[1]) / 6.0
        if all((np.abs(each) < rig.skin.full_scale).all() for each in signals.values()):
            return T, size, signals, rng


def single_windows(
    rig: Rig,
    seed: int,
    plan: Plan,
    method: str = "solve",
    scenes: dict[tuple[int, float, int], Scene] | None = None,
    counts: Sequence[int] | None = None,
) -> Iterator[dict[str, Any]]:
    """Rows of single windows. counts: numbers of pads (default: PADS); scenes: those of another method, whose fields are
    reused."""
    scenes = {} if scenes is None else scenes
    for count in counts or PADS:
        for gap in GAPS:
            priors = (False, True) if method == "solve" else (False,)  # the network knows no other prior than its training's
            table = {(prior, speed): Row([], []) for prior in priors for speed in SPEEDS}
            for k in range(plan.poses):
                if (count, gap, k) not in scenes:
                    scenes[count, gap, k] = _scene(rig, seed, count, gap, k)
                T, size, signals, rng = scenes[count, gap, k]
                axes, middle = rig.axes(T, count), signals[0.0]
                information = rig.information(middle, T, size)
                for (prior, speed), row in table.items():
                    spread = TRACKING if prior else BROAD
                    row.bounds.append(_bound(information, axes, spread))
                    for _ in range(plan.draws):
                        home = rigid.perturb(T, (spread * rng.standard_normal(6)) @ axes)
                        estimator = rig.estimator(home, np.sqrt(np.diag(axes.T @ np.diag(spread**2) @ axes)), method)
                        amplitude = rig.voltages(np.tile(signals[speed], (SAMPLES, 1)), rng).mean(axis=0)
                        estimator.update(1, amplitude, rig.samples(count), rig.pads, rig.joints)
                        row.errors.append(axes @ rigid.pose_error(T, estimator.pose))
            for (prior, speed), row in table.items():
                yield _row(rig, gap, count, prior, speed, row)


def _bound(information: Array, axes: Array, spread: Array) -> Array:
    """Variances (6,) by NAMES of the bound with a prior on pose and size."""
    total = information.copy()
    total[:6, :6] += axes.T @ np.diag(spread**-2) @ axes
    total[6:, 6:] += np.diag(SIZE_SPREAD**-2)
    return np.asarray(np.diag(axes @ np.linalg.inv(total)[:6, :6] @ axes.T))


def _row(rig: Rig, gap: float, count: int, prior: bool, speed: float, row: Row) -> dict[str, Any]:
    rmse = dict(zip(NAMES, np.sqrt(np.mean(np.square(row.errors), axis=0)), strict=True))
    bound = dict(zip(NAMES, np.sqrt(np.mean(row.bounds, axis=0)), strict=True))
    units = {name: 1e3 if name in SHOWN else np.degrees(1.0) for name in NAMES}
    out: dict[str, Any] = {"array": rig.name, "gap_m": gap, "pads": count, "prior": prior, "speed": speed}
    for kind, values in (("rmse", rmse), ("bound", bound)):
        out[f"{kind}_mm"] = {name: round(float(values[name] * units[name]), 3) for name in SHOWN}
        out[f"{kind}_deg"] = {name: round(float(values[name] * units[name]), 3) for name in ("pitch", "yaw")}
    out["ratio"] = {name: round(float(rmse[name] / bound[name]), 2) for name in (*SHOWN, "pitch", "yaw")}
    return out


@dataclass(frozen=True)
class Consistency:
    """Consistency of one limb. published, fused: mean NEES per degree of freedom of the published poses and of the default
    observer's; in_range: share of windows in range; ms: times [ms] from a window's last sample to its pose; errors: pose errors
    (6,) by NAMES of the windows after SETTLED_S, when the size has been learnt."""

    published: float
    fused: float
    in_range: float
    ms: list[float]
    errors: list[Array]


def resting(rig: Rig, seed: int, gap: float, k: int) -> Consistency:
    """A limb that comes into sight and rests."""
    rng = np.random.default_rng([seed, 100, int(1e4 * gap), k])
    T, size = rig.place(rng, gap, 8)
    signal = rig.signal(field.limb(rig.mesh, *np.exp(size)), T, 8)
    count = int(REST_S * 1e9 / WINDOW_NS)
    return _followed(rig, rng, [T] * count, np.tile(signal, (count, 1)))


def _followed(rig: Rig, rng: np.random.Generator, poses: list[Array], signals: Array) -> Consistency:
    """Runs estimator and observer on windows with these true poses and signals (windows, n)."""
    axes = rig.axes(poses[0], 8)
    home = rigid.perturb(poses[0], (BROAD * rng.standard_normal(6)) @ axes)
    estimator = rig.estimator(home, np.sqrt(np.diag(axes.T @ np.diag(BROAD**2) @ axes)))
    spread = rig.cell.targets[rig.target].home_spread
    observer = ErrorStateObserver(home, (spread.position, spread.rotation))
    estimator.warm_up(len(rig.joints))
    collector = Collector(rig.skin, WINDOW_NS)
    published, fused, ms, errors, seen = [], [], [], [], 0
    for i, T in enumerate(poses):
        stamp_ns = (i + 1) * WINDOW_NS
        volts = rig.voltages(np.tile(signals[i], (SAMPLES, 1)), rng)
        for pad, name in enumerate(rig.skin.pads):
            begin = time.perf_counter()
            window = collector.add(name, stamp_ns, PERIOD_NS, volts[:, rig.skin.of(pad)])
        assert window is not None
        estimate = estimator.update(window.stamp_ns, window.amplitude, window.samples, rig.pads, rig.joints)
        ms.append(1e3 * (time.perf_counter() - begin))
        if estimate.may_be_limb:  # the thing is a limb
            observer.measure("haptic", window.stamp_ns, estimate.T, estimate.information, step=estimate.step)
        if stamp_ns < SETTLED_S * 1e9:
            continue
        errors.append(rig.axes(T, 8) @ rigid.pose_error(T, estimator.pose))
        seen += estimate.in_range
        if not estimate.may_be_limb:
            continue
        values = np.linalg.eigvalsh(estimate.information)
        rank = int((values > 1e-6 * values[-1]).sum())
        error = rigid.pose_error(T, estimate.T)
        published.append(float(error @ estimate.information @ error) / rank)
        if i % 10 == 0:
            told = observer.estimate(window.stamp_ns)
            known = np.delete(rig.axes(told.T, 8), NAMES.index("roll"), axis=0)
            error = known @ rigid.pose_error(T, told.T)
            fused.append(float(error @ np.linalg.solve(known @ told.covariance @ known.T, error)) / len(known))
    mean_published, mean_fused = (float(np.mean(values)) if values else float("nan") for values in (published, fused))
    return Consistency(mean_published, mean_fused, seen / max(len(errors), 1), ms, errors)


def _rmse(errors: list[Array]) -> dict[str, float]:
    """Root mean squares of errors (6,) by NAMES, in mm and degrees."""
    units = [1e3 if name in SHOWN else np.degrees(1.0) for name in NAMES]
    return dict(zip(NAMES, np.round(np.sqrt(np.mean(np.square(errors), axis=0)) * units, 2).tolist(), strict=True))


def moving(rig: Rig, seed: int, k: int, seconds: float) -> tuple[list[float], Consistency]:
    """A limb that moves through all gaps at up to the highest speed: its gaps [m] and its consistency."""
    rng = np.random.default_rng([seed, 200, k])
    T, size = rig.place(rng, 0.02, 8)
    body, axes = field.limb(rig.mesh, *np.exp(size)), rig.axes(T, 8)
    stamps = np.arange(1, int(seconds * 1e9 / WINDOW_NS) + 1) * WINDOW_NS * 1e-9
    # along, across, and up and down between 2 and 16 cm: a sine each, at most SPEEDS[-1] together
    reach, phase = np.array([0.05, 0.03, 0.07]), rng.uniform(0.0, 2.0 * np.pi, 3)
    rate = rng.uniform(0.5, 1.0, 3)
    rate *= SPEEDS[-1] / np.linalg.norm(reach * rate)
    phase[2] = -0.5 * np.pi

    def at(t: NDArray[np.floating[Any]]) -> list[Array]:
        way = reach * (np.sin(np.outer(t, rate) + phase) - np.sin(phase)) @ axes[:3, :3]
        return [rigid.perturb(T, np.append(step, np.zeros(3))) for step in way]

    knots = np.arange(0.0, seconds + 0.05, 0.04)
    logs = np.log(np.maximum([rig.signal(body, pose, 8) for pose in at(knots)], 1e-9))
    middles = stamps - 0.5 * (SAMPLES - 1) * PERIOD_NS * 1e-9
    poses = at(middles)
    found = _followed(rig, rng, poses, np.exp(CubicSpline(knots, logs)(middles)))
    return [rig.gap(pose, size, 8) for pose in poses[-len(found.errors) :]], found


def sequences(rig: Rig, seed: int, plan: Plan, progress: Progress) -> dict[str, Any]:
    """Resting and moving limbs."""
    task = progress.add_task(f"{rig.name}: sequences", total=len(RESTING_GAPS) * plan.resting + plan.moving)
    by_gap, found = {}, []
    for gap in RESTING_GAPS:
        here = []
        for k in range(plan.resting):
            here.append(resting(rig, seed, gap, k))
            progress.advance(task)
        found += here
        shares = {name: float(np.nanmean([getattr(each, name) for each in here])) for name in ("published", "fused", "in_range")}
        by_gap[f"{gap:g}"] = {name: round(share, 3) for name, share in shares.items()} | {
            "rmse": _rmse([error for each in here for error in each.errors])
        }
    gaps: list[float] = []
    errors: list[Array] = []
    followed: list[Consistency] = []
    for k in range(plan.moving):
        more, each = moving(rig, seed, k, plan.moving_s)
        gaps, errors, followed = gaps + more, errors + each.errors, [*followed, each]
        progress.advance(task)
    table = {}
    for low, high in BANDS:
        inside = (np.array(gaps) >= low) & (np.array(gaps) < high)
        if inside.any():
            table[f"{low:g}-{high:g}"] = _rmse(list(np.array(errors)[inside]))
    progress.remove_task(task)
    ms = np.concatenate([each.ms[50:] for each in found + followed])
    fused = [each.fused for each in found if np.isfinite(each.fused)]
    return {
        "nees": {
            "mean": round(float(np.mean(fused)), 3),
            "band": [round(float(chi2.ppf(p, 5 * len(fused)) / (5 * len(fused))), 3) for p in (0.025, 0.975)],
            "published": round(float(np.nanmean([each.published for each in found])), 3),
            "limbs": len(fused),
            "by_gap": by_gap,
            "moving": {
                name: round(float(np.nanmean([getattr(each, name) for each in followed])), 3) for name in ("published", "fused")
            },
        },
        "moving": table,
        "ms": {"median": round(float(np.median(ms)), 3), "p95": round(float(np.percentile(ms, 95)), 3)},
    }


def measure_objects(seed: int, passes: int, arrays: tuple[str, ...]) -> list[dict[str, Any]]:
    """Rows of things that pass."""
    rows = []
    with Progress(console=Console(stderr=True), transient=True) as progress:
        for name in arrays:
            rig = Rig(name)
            rig.estimator(rig.home, np.ones(6)).warm_up(len(rig.joints))
            for kind in progress.track(things.KINDS, description=f"{name}: things that pass"):
                rows.append(things.row(rig, name, kind, seed, passes))
    return rows


def measure(seed: int, plan: Plan, arrays: tuple[str, ...], paper: bool) -> dict[str, Any]:
    """The whole benchmark."""
    result: dict[str, Any] = {"seed": seed, "rows": [], "paper": []}
    parts = {}
    with Progress(console=Console(stderr=True), transient=True) as progress:
        for name in arrays:
            rig = Rig(name)
            rig.estimator(rig.home, np.ones(6)).warm_up(len(rig.joints))
            scenes: dict[tuple[int, float, int], Scene] = {}
            methods = ["solve"] + (["paper"] if paper and rig.weights is not None else [])
            for method in methods:
                task = progress.add_task(f"{name}: {method}", total=len(PADS) * len(GAPS))
                for row in single_windows(rig, seed, plan, method, scenes):
                    result["rows" if method == "solve" else "paper"].append(row)
                    progress.update(task, advance=1.0 / (len(SPEEDS) * (2 if method == "solve" else 1)))
                progress.remove_task(task)
            parts[name] = sequences(rig, seed, plan, progress)
    first = parts[arrays[0]]
    result["objects"] = measure_objects(seed, plan.passes, arrays)
    return result | {"nees": first["nees"], "ms": first["ms"]["median"], "arrays": parts}


def tables(result: Result) -> list[Part]:
    """Errors beside their bounds, then limbs that rest and move, and things that are taken for one. The JSON also has single
    windows with fewer pads and of moving limbs, of which only shares are shown."""
    if "surface" in result:
        return surfaces.tables(result)
    if "drift" in result:
        return [drift.table(result)]
    if "persons" in result:
        return [persons.table(result["persons"])]
    if "arrays" not in result:
        return [things.table(result)]
    shown, lines = result["arrays"], list[Part]()
    consistent = Table(
        *("array", "limbs", "of the observer's pose", "95 % band", "of the published one", "moving: observer's", "published"),
        title=f"NEES a degree of freedom, limbs that rest for {REST_S:g} s",
    )
    units = [f"{name} {'mm' if name in SHOWN else 'deg'}" for name in NAMES]
    resting = Table(
        "array", "gap cm", "NEES", "published", "in range", *units, title="Limbs that rest: RMSE once the size is learnt"
    )
    moving = Table("array", "gap m", *units, title="Limbs that move through all gaps: RMSE")
    for name, part in shown.items():
        nees, (low, high) = part["nees"], part["nees"]["band"]
        consistent.add_row(
            name, str(nees["limbs"]), marked(f"{nees['mean']:.2f}", low <= nees["mean"] <= high), f"{low:.2f} to {high:.2f}",
            f"{nees['published']:.2f}", f"{nees['moving']['fused']:.2f}", f"{nees['moving']['published']:.2f}",
        )  # fmt: skip
        for gap, each in nees["by_gap"].items():
            shares = (f"{each['fused']:.2f}", f"{each['published']:.2f}", f"{each['in_range']:.0%}")
            resting.add_row(name, f"{100 * float(gap):g}", *shares, *(f"{each['rmse'][axis]:.2f}" for axis in NAMES))
        for band, each in part["moving"].items():
            moving.add_row(name, band, *(f"{each[axis]:.2f}" for axis in NAMES))
        p95 = marked(f"{part['ms']['p95']} ms", part["ms"]["p95"] <= MS_GOAL)
        lines.append(f"From sample to pose, {name}: {part['ms']['median']} ms, 95th percentile {p95} (goal {MS_GOAL:g}).")
    return [_errors(result), _shares(result), consistent, resting, moving, things.table(result), *lines]


def _errors(result: Result) -> Table:
    """Errors with eight pads and limbs at rest."""
    theirs = {_key(row): row for row in result["paper"]}
    table = Table(
        *("array", "prior", "gap cm", "lateral mm", "height mm", "axial mm", "pitch deg", "yaw deg", "worst ratio"),
        "paper's method: lateral / height / axial",
        title=f"Eight pads, limbs at rest, seed {result['seed']}: RMSE (bound)",
        caption=f"Goal: a ratio to the bound of at most {RATIO_GOAL}. Prior: tracking, 2 cm and 5.7 degrees, or broad.",
    )
    for row in sorted(result["rows"], key=lambda row: (row["array"], not row["prior"])):
        if row["pads"] != PADS[0] or row["speed"]:
            continue
        values = [f"{row['rmse_mm'][name]:.2f} ({row['bound_mm'][name]:.2f})" for name in SHOWN]
        values += [f"{row['rmse_deg'][name]:.2f} ({row['bound_deg'][name]:.2f})" for name in ("pitch", "yaw")]
        paper = theirs.get(_key(row))
        table.add_row(
            *(row["array"], _prior(row["prior"]), f"{100 * row['gap_m']:g}", *values, _judged(max(row["ratio"].values()))),
            "" if paper is None else " / ".join(f"{paper['rmse_mm'][name]:.1f}" for name in SHOWN),
        )
    return table


def _shares(result: Result) -> Table:
    """How many errors are near their bound, by the number of pads."""
    low, high = NEAR_M
    table = Table(
        *("array", "pads", "prior", f"within {RATIO_GOAL} times the bound", "largest ratio"),
        title=f"Errors from {100 * low:g} to {100 * high:g} cm, at rest and moving",
    )
    ratios: dict[tuple[str, int, bool], list[float]] = {}
    for row in result["rows"]:
        if low <= row["gap_m"] <= high:
            ratios.setdefault((row["array"], row["pads"], row["prior"]), []).extend(row["ratio"].values())
    for (array, pads, prior), found in ratios.items():
        within = float(np.mean(np.array(found) <= RATIO_GOAL))
        table.add_row(array, str(pads), _prior(prior), marked(f"{within:.0%}", within == 1.0), _judged(max(found)))
    return table


def _prior(is_tracking: bool) -> str:
    return "tracking" if is_tracking else "broad"


def _judged(ratio: float) -> str:
    return marked(f"{ratio:.2f}", ratio <= RATIO_GOAL)


def picture(result: dict[str, Any], path: Path) -> None:
    """The paper's curve: errors against the gap with eight pads, beside their bounds."""
    from matplotlib.figure import Figure

    arrays = list(result["arrays"])
    figure = Figure(figsize=(10.0, 4.2 * len(arrays)), layout="constrained")
    axes = figure.subplots(len(arrays), 2, squeeze=False)
    for line, name in zip(axes, arrays, strict=True):
        for plot, (kind, unit, names) in zip(line, (("mm", "mm", SHOWN), ("deg", "deg", ("pitch", "yaw"))), strict=True):
            for prior, style in ((True, "-"), (False, ":")):
                rows = [r for r in result["rows"] if (r["array"], r["pads"], r["prior"], r["speed"]) == (name, 8, prior, 0.0)]
                gaps = [100 * row["gap_m"] for row in rows]
                for k, each in enumerate(names):
                    label = f"{each}, {'tracking' if prior else 'broad'} prior"
                    plot.plot(gaps, [row[f"rmse_{kind}"][each] for row in rows], f"C{k}o{style}", ms=4, label=label)
                    plot.plot(gaps, [row[f"bound_{kind}"][each] for row in rows], f"C{k}{style}", lw=4, alpha=0.25)
            plot.set(
                xlabel="gap [cm]", ylabel=f"error [{unit}]", yscale="log", title=f"{name} array, 8 pads; pale: Cramér-Rao bound"
            )
            plot.grid(alpha=0.3, which="both")
            plot.legend(fontsize=7)
    figure.savefig(path, dpi=120)


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in ("array", "gap_m", "pads", "prior", "speed"))


@results.benchmark(
    "haptics",
    (__doc__ or "").partition("\n\n")[0],
    tables,
    flags.Option("--seed", type=int, default=1),
    flags.Option("--picture", type=Path, help="draw error against gap here (PNG, PDF or SVG)"),
    flags.Option("--array", choices=tuple(ARRAYS), multiple=True, help="only this one (default: all)"),
    flags.Option("--method", choices=("both", "solve"), default="both", help="the paper's beside ours"),
    flags.Option("--only-objects", is_flag=True, help="only things that pass"),
    flags.Option("--only-surface", is_flag=True, help="only points of surfaces, and contact"),
    flags.Option("--only-drift", is_flag=True, help="only limbs before electrodes that have drifted"),
    flags.Option("--only-persons", is_flag=True, help="only limbs with upper arm and torso"),
    flags.Option("--quick", is_flag=True, help="a few of everything: whether it runs, no numbers to believe"),
    example="penumbra bench haptics --quick --json haptics.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    plan, arrays = QUICK if options.quick else FULL, tuple(options.array or ARRAYS)
    if options.only_surface:
        with Progress(console=Console(stderr=True), transient=True) as progress:
            parts = [
                surfaces.measure(Rig(name), options.seed, 1 if options.quick else surfaces.THINGS, progress) for name in arrays
            ]
        result: dict[str, Any] = {"seed": options.seed, "surface": parts}
    elif options.only_drift:
        with Progress(console=Console(stderr=True), transient=True) as progress:
            limbs = 1 if options.quick else drift.LIMBS
            rows = [row for name in arrays for row in drift.measure(Rig(name), options.seed, limbs, progress)]
        result = {"seed": options.seed, "drift": rows}
    elif options.only_persons:
        each = [persons.measure(Rig(name), options.seed, plan.poses, plan.draws, TRACKING) for name in arrays]
        result = {"seed": options.seed, "persons": [row for rows in each for row in rows]}
    elif options.only_objects:
        result = {"seed": options.seed, "objects": measure_objects(options.seed, plan.passes, arrays)}
    else:
        result = measure(options.seed, plan, arrays, options.method == "both")
    report.save(result)
    if options.picture and "arrays" in result:
        picture(result, options.picture)


if __name__ == "__main__":
    raise SystemExit(main())
