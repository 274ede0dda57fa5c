"""Electrodes that drift: how far a limb's pose is off after the boards have become warmer, and whether its covariance says so.

An estimator that was calibrated cold lives through ten minutes in which the boards warm up. A camera sees a limb move before the
pads, or nothing is near, or no voltages come for an hour. Then the camera loses the limb, which rests at a gap. Voltages come
from the full boundary-element model.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any, Protocol

import numpy as np
from rich.progress import Progress
from rich.table import Table
from scipy.interpolate import CubicSpline

from penumbra.services.fusion.observer import ErrorStateObserver
from penumbra.services.haptics.estimator import Estimator
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.sim.skin import field
from penumbra.sim.skin.faults import BOARD_WARMS_S, Warming
from penumbra.tests.bench.lib import things
from penumbra.tests.bench.lib.results import Result, marked

LIMBS = 2
"""Number of limbs per row, chosen for time: five minutes per array."""
GAPS = (0.02, 0.05, 0.10, 0.15)
LIVES = ("seen", "away", "silent")
"""The possible lives of an estimator before: a camera sees a limb, nothing is near, no voltages come."""
WARMER_K = (0.0, 10.0)
"""Final warming [K] of the boards, of which 86 % are reached after LIFE_S."""
LIFE_S, SILENT_S = 600.0, 3600.0
"""Durations [s] of a life, and of the silent one."""
EVERY_S = 0.2
"""Interval [s] of the windows of a life, chosen for time: with the skin's rate, ten times as high, learning would be easier."""
REACH = np.array([0.05, 0.03, 0.065])
CYCLES = np.array([3, 1, 2])
"""Motion of a seen limb: amplitudes [m] along, across and away (from 2 to 15 cm), and their cycles in WAY_S."""
WAY_S, KNOT_S = 12.0, 0.1
"""Period of this motion, and interval at which fields are solved on it [s]."""
WINDOW_S, SAMPLES = 0.02, 20
"""Length [s] of a window, and number of samples in it."""
RESTS_S, LAST_SEEN_S, SETTLED_S = 4.0, 0.1, 1.0
"""Times [s] for which the limb rests, for which the camera still sees it, and after which errors count."""
SEEN_LASTS_S = 1.0
"""Time constant [s] of one half of the variance of the camera's error; the other half is constant."""
SIGMA: Array = np.repeat(things.SEEN_SIGMA, 3)
NEES_GOAL = (0.5, 2.0)
NAMES = ("axial", "lateral", "height", "roll", "pitch", "yaw")
SHOWN = ("lateral", "height", "axial")


class Rig(things.Pads, Protocol):
    """The attributes of a benchmark's rig that are used in addition to `things.Pads`."""

    name: str
    cell: Any
    target: str


class _Life:
    """An estimator's life with one limb: pose, size and motion of the limb, and warming of the electrodes."""

    def __init__(self, rig: Rig, seed: int, k: int):
        self.rig, self.seed, self.k = rig, seed, k
        self.T, self.size = self.place(0.085)
        self.body = field.limb(rig.mesh, *np.exp(self.size))
        knots = np.linspace(0.0, WAY_S, round(WAY_S / KNOT_S) + 1)
        logs = np.log([rig.signal(self.body, self.at(t), 8) for t in knots[:-1]])
        self.way = CubicSpline(knots, np.concatenate([logs, logs[:1]]), bc_type="periodic")
        self.warming = Warming.draw(np.random.default_rng([seed, 301, k]), len(rig.skin))

    def place(self, gap: float) -> tuple[Array, Array]:
        """The limb's pose (4, 4) at a gap [m], and its size (2,), the same at every gap."""
        return self.rig.place(np.random.default_rng([self.seed, 300, self.k]), gap, 8)

    def at(self, t: float) -> Array:
        """The limb's pose (4, 4) at a time [s] of its motion."""
        step = (REACH * np.sin(2.0 * np.pi * CYCLES * t / WAY_S)) @ self.rig.axes(self.T, 8)[:3, :3]
        return rigid.perturb(self.T, np.append(step, np.zeros(3)))

    def volts(self, signal: Array, kelvin: float, rng: np.random.Generator) -> Array:
        """Mean voltages (n,) of a window with these true signals (n,) [V] on boards that are warmer by `kelvin`."""
        clean = self.rig.voltages(np.tile(signal, (SAMPLES, 1)), rng).mean(axis=0)
        return self.warming.apply(clean[None], self.rig.skin.a3, [kelvin])[0]

    def born(self, rng: np.random.Generator) -> Estimator:
        """A new estimator that expects the limb somewhere before the pads."""
        home = rigid.perturb(self.T, things.HOME_SPREAD * rng.standard_normal(6))
        return self.rig.estimator(home, things.HOME_SPREAD)

    def lived(self, life: str, warmer: float) -> tuple[Estimator, float]:
        """An estimator after a life of LIVES, and its age [s]."""
        rig, rng = self.rig, np.random.default_rng([self.seed, 302, self.k, LIVES.index(life)])
        estimator = self.born(rng)
        used = np.full(len(rig.skin), SAMPLES)
        if life == "silent":
            nothing = self.volts(np.zeros(len(rig.skin)), 0.0, rng)
            estimator.update(int(WINDOW_S * 1e9), nothing, used, rig.pads, rig.joints)
            return estimator, SILENT_S
        stays, changes = SIGMA * rng.standard_normal((2, 6)) / np.sqrt(2.0)
        for i in range(1, round(LIFE_S / EVERY_S) + 1):
            t = i * EVERY_S
            signal, expected = np.zeros(len(rig.skin)), None
            if life == "seen":
                signal = np.exp(self.way(t % WAY_S))
                keep = np.exp(-EVERY_S / SEEN_LASTS_S)
                changes = keep * changes + np.sqrt(0.5 * (1.0 - keep**2)) * SIGMA * rng.standard_normal(6)
                expected = rigid.perturb(self.at(t), stays + changes), np.diag(SIGMA**2)
            volts = self.volts(signal, warmer * -np.expm1(-t / BOARD_WARMS_S), rng)
            estimator.update(int(t * 1e9), volts, used, rig.pads, rig.joints, expected)
        return estimator, LIFE_S

    def rest(self, estimator: Estimator, age_s: float, gap: float, warmer: float) -> dict[str, Any]:
        """The results of a limb that rests at a gap: errors (w, 6) by NAMES, NEES of the published and of the observer's
        poses."""
        rig, rng = self.rig, np.random.default_rng([self.seed, 303, self.k, int(1e4 * gap)])
        T, _ = self.place(gap)
        signal, axes = rig.signal(self.body, T, 8), rig.axes(T, 8)
        spread = rig.cell.targets[rig.target].home_spread
        seen = rigid.perturb(T, SIGMA * rng.standard_normal(6))
        observer = ErrorStateObserver(seen, (spread.position, spread.rotation))
        errors, published, fused, in_range = list[Array](), list[float](), list[float](), list[bool]()
        for i in range(1, round(RESTS_S / WINDOW_S) + 1):
            t = i * WINDOW_S
            stamp_ns = int((age_s + t) * 1e9)
            expected = (seen, np.diag(SIGMA**2)) if t <= LAST_SEEN_S else None
            volts = self.volts(signal, warmer, rng)
            estimate = estimator.update(stamp_ns, volts, np.full(len(rig.skin), SAMPLES), rig.pads, rig.joints, expected)
            if estimate.may_be_limb:
                observer.measure("haptic", stamp_ns, estimate.T, estimate.information, step=estimate.step)
            if t < SETTLED_S:
                continue
            errors.append(axes @ rigid.pose_error(T, estimator.pose))
            in_range.append(estimate.may_be_limb)
            if not estimate.may_be_limb:
                continue
            values = np.linalg.eigvalsh(estimate.information)
            error = rigid.pose_error(T, estimate.T)
            published.append(float(error @ estimate.information @ error) / int((values > 1e-6 * values[-1]).sum()))
            told = observer.estimate(stamp_ns)
            known = np.delete(rig.axes(told.T, 8), NAMES.index("roll"), axis=0)
            error = known @ rigid.pose_error(T, told.T)
            fused.append(float(error @ np.linalg.solve(known @ told.covariance @ known.T, error)) / len(known))
        return {"errors": errors, "published": published, "fused": fused, "in_range": in_range}


def measure(rig: Rig, seed: int, limbs: int, progress: Progress) -> list[dict[str, Any]]:
    """Rows by life, warming and gap, over `limbs` limbs."""
    found: dict[tuple[str, float, float], list[dict[str, Any]]] = {}
    task = progress.add_task(f"{rig.name}: drift", total=limbs * len(LIVES) * len(WARMER_K))
    for k in range(limbs):
        drawn = _Life(rig, seed, k)
        for life in LIVES:
            for warmer in WARMER_K:
                estimator, age_s = drawn.lived(life, warmer)
                reached = warmer * -np.expm1(-age_s / BOARD_WARMS_S)
                for gap in GAPS:
                    rested = drawn.rest(deepcopy(estimator), age_s, gap, reached)
                    found.setdefault((life, warmer, gap), []).append(rested)
                progress.advance(task)
    progress.remove_task(task)
    return [_row(rig.name, *key, rests) for key, rests in found.items()]


def _row(array: str, life: str, warmer: float, gap: float, rests: list[dict[str, Any]]) -> dict[str, Any]:
    errors = np.array([error for each in rests for error in each["errors"]])
    units = [1e3 if name in SHOWN else np.degrees(1.0) for name in NAMES]
    rmse = np.round(np.sqrt(np.mean(np.square(errors), axis=0)) * units, 2)
    nees = {name: [np.mean(each[name]) for each in rests if each[name]] for name in ("published", "fused")}
    return {
        "array": array,
        "life": life,
        "warmer_k": warmer,
        "gap_m": gap,
        "limbs": len(rests),
        "rmse": dict(zip(NAMES, rmse.tolist(), strict=True)),
        "in_range": round(float(np.mean([each["in_range"] for each in rests])), 3),
        **{name: round(float(np.mean(each)), 2) if each else None for name, each in nees.items()},
    }


def table(result: Result) -> Table:
    """Errors and NEES by array, life, warming and gap."""
    names = [f"{name} {'mm' if name in SHOWN else 'deg'}" for name in (*SHOWN, "pitch", "yaw")]
    low, high = NEES_GOAL
    out = Table(
        *("array", "before", "warmer by K", "gap cm", *names, "in range", "NEES published", "of the observer"),
        title=f"Limbs that rest on boards that became warmer, seed {result['seed']}: RMSE",
        caption=f"{result['drift'][0]['limbs']} limbs a row. NEES a degree of freedom; goal {low:g} to {high:g}.",
    )
    for row in result["drift"]:
        rmse = (f"{row['rmse'][name]:.2f}" for name in (*SHOWN, "pitch", "yaw"))
        nees = ("" if row[name] is None else marked(f"{row[name]:.2f}", row[name] <= high) for name in ("published", "fused"))
        place = (row["array"], row["life"], f"{row['warmer_k']:g}", f"{100 * row['gap_m']:g}")
        out.add_row(*place, *rmse, f"{row['in_range']:.0%}", *nees)
    return out
