"""Pads among other boards: poses with a field model that knows the boards beside each pad, and with that of lone pads.

Voltages come from boundary elements in which every pad has the others beside it. An estimator that takes each pad for a lone one,
and one that knows what the others take, see the same windows. Neither has a network to start from: both start from the prior.
"""

from __future__ import annotations

import time
from typing import Any, Protocol

import numpy as np
from rich.progress import Progress
from rich.table import Table

from penumbra.services.haptics.estimator import Estimator
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.response import SIZE_SPREAD, Response, fingerprint, networks
from penumbra.sim.skin import field
from penumbra.tests.bench.lib import drift
from penumbra.tests.bench.lib.results import Result, marked

POSES, DRAWS = 12, 4
"""Poses of a gap, and draws of noise and prior of each."""
GAPS = (0.01, 0.02, 0.05, 0.10, 0.15)
PRIORS: dict[str, Array] = {
    "tracking": np.array([0.02, 0.02, 0.02, 0.1, 0.1, 0.1]),
    "broad": np.array([0.08, 0.04, 0.04, 0.3, np.radians(8.0), np.radians(15.0)]),
}
"""Standard deviations along and across the limb, along the pads' normal [m], and of roll, pitch and yaw [rad]."""
NAMES = ("axial", "lateral", "height", "roll", "pitch", "yaw")
SHOWN = ("lateral", "height", "axial")
NEES_GOAL = (0.5, 2.0)
SAMPLES = 10


class Rig(drift.Rig, Protocol):
    """What is used of a benchmark's rig beside `drift.Rig`."""

    surface: Surface

    def information(self, signal: Array, T: Array, size: Array) -> Array:
        """Fisher information (8, 8) of a window with true signals (n,) about pose (4, 4) and size (2,)."""


def pose_bound(information: Array, axes: Array, spread: Array) -> Array:
    """Variances (6,) of a pose error along axes (6, 6), one a row: the Cramér-Rao bound of an information (8, 8) about pose and
    size with a prior of these standard deviations (6,) along the axes and the size's spread between people."""
    total = information.copy()
    total[:6, :6] += axes.T @ np.diag(spread**-2) @ axes
    total[6:, 6:] += np.diag(SIZE_SPREAD**-2)
    return np.asarray(np.diag(axes @ np.linalg.inv(total)[:6, :6] @ axes.T))


def models(rig: Rig) -> dict[str, Response]:
    """Responses of a rig's pads by what they know: lone pads, or the boards beside."""
    known = networks(rig.cell)
    lone = {
        fingerprint(rig.cell, pad, rig.target): known[fingerprint(rig.cell, pad, rig.target, bare=True)] for pad in rig.cell.pads
    }
    return {"lone pads": Response(rig.cell, rig.target, lone), "boards beside": Response(rig.cell, rig.target)}


def measure(rig: Rig, seed: int, poses: int, progress: Progress) -> list[dict[str, Any]]:
    """Rows by what is known, prior and gap: errors of single windows, their squares over the published covariances, and times."""
    responses = models(rig)
    found: dict[tuple[str, str, float], list[tuple[Array, float, float]]] = {}
    bounds: dict[tuple[str, float], list[Array]] = {}
    for gap in progress.track(GAPS, description=f"{rig.name}: among other boards"):
        for k in range(poses):
            rng = np.random.default_rng([seed, 300, int(1e4 * gap), k])
            T, size = rig.place(rng, gap, 8)
            signal, axes = rig.signal(field.limb(rig.mesh, *np.exp(size)), T, 8), rig.axes(T, 8)
            information = rig.information(signal, T, size)
            for prior, spread in PRIORS.items():
                bounds.setdefault((prior, gap), []).append(pose_bound(information, axes, spread))
                for _ in range(DRAWS):
                    home = rigid.perturb(T, (spread * rng.standard_normal(6)) @ axes)
                    around = np.sqrt(np.diag(axes.T @ np.diag(spread**2) @ axes))
                    amplitude = rig.voltages(np.tile(signal, (SAMPLES, 1)), rng).mean(axis=0)
                    for name, response in responses.items():
                        estimator = Estimator(rig.skin, response, rig.surface, home, around)
                        found.setdefault((name, prior, gap), []).append(_window(rig, estimator, amplitude, T))
    return [_row(*key, windows, bounds[key[1:]]) for key, windows in found.items()]


def _window(rig: Rig, estimator: Estimator, amplitude: Array, T: Array) -> tuple[Array, float, float]:
    """Error (6,) by NAMES of a window's pose, that of the published pose in squares of its covariance per known direction (nan
    where it knows none), and the time that it took [ms]."""
    begin = time.process_time()
    estimate = estimator.update(1, amplitude, np.full(len(rig.skin), SAMPLES), rig.pads)
    ms = 1e3 * (time.process_time() - begin)
    values = np.linalg.eigvalsh(estimate.information)
    rank = int((values > 1e-6 * max(values[-1], 1e-9)).sum())
    error = rigid.pose_error(T, estimate.T)
    nees = float(error @ estimate.information @ error) / rank if rank else float("nan")
    return rig.axes(T, 8) @ rigid.pose_error(T, estimator.pose), nees, ms


def _row(name: str, prior: str, gap: float, windows: list[tuple[Array, float, float]], bounds: list[Array]) -> dict[str, Any]:
    errors, nees, ms = (np.array(each) for each in zip(*windows, strict=True))
    units = [1e3 if axis in SHOWN else np.degrees(1.0) for axis in NAMES]
    rmse = np.round(np.sqrt(np.mean(np.square(errors), axis=0)) * units, 2)
    bound = np.round(np.sqrt(np.mean(bounds, axis=0)) * units, 2)
    return {
        "known": name,
        "prior": prior,
        "gap_m": gap,
        "windows": len(windows),
        "rmse": dict(zip(NAMES, rmse.tolist(), strict=True)),
        "bound": dict(zip(NAMES, bound.tolist(), strict=True)),
        "felt": round(float(np.isfinite(nees).mean()), 3),
        "nees": round(float(np.nanmean(nees)), 2) if np.isfinite(nees).any() else None,
        "ms": round(float(np.median(ms)), 3),
    }


def table(result: Result) -> Table:
    """Errors and NEES by prior, gap and what is known."""
    names = [f"{name} {'mm' if name in SHOWN else 'deg'}" for name in (*SHOWN, "pitch", "yaw")]
    out = Table(
        *("prior", "gap cm", "model", *names, "felt", "NEES", "ms"),
        title=f"Pads among others, seed {result['seed']}: RMSE of single windows (bound)",
        caption=f"{result['among'][0]['windows']} windows a row. NEES a degree of freedom of what is published.",
    )
    for row in sorted(result["among"], key=lambda row: (row["prior"] != "tracking", row["gap_m"])):
        nees = "" if row["nees"] is None else marked(f"{row['nees']:.2f}", row["nees"] <= NEES_GOAL[1])
        rmse = (f"{row['rmse'][name]:.2f} ({row['bound'][name]:.2f})" for name in (*SHOWN, "pitch", "yaw"))
        out.add_row(
            row["prior"], f"{100 * row['gap_m']:g}", row["known"], *rmse, f"{row['felt']:.0%}", nees, f"{row['ms']:.2f}"
        )  # fmt: skip
    return out
