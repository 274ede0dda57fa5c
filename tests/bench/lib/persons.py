"""Limbs with the rest of their person: what upper arm and torso do to the pose, and what is left of that where they are known.

Each limb is solved with boundary elements twice, alone and as part of a person whose shoulder is up to a hand's breadth or two
from where the estimator takes it to be. The estimator sees the limb alone; the person, without knowing of more than the limb; and
the person, with the networks of `shared.skin.bearer`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table
from scipy.stats import chi2

from penumbra.shared.body.anatomy import torso_mesh, upper_arm_mesh
from penumbra.shared.body.posture import Posture
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.sim.skin import field

if TYPE_CHECKING:
    from penumbra.tests.bench.haptics import Rig

GAPS = (0.02, 0.05, 0.10, 0.15)
SHOULDER, YAW = 0.12, 0.5
"""Standard deviations of the shoulder's place, along each axis [m], and of the way that the person faces [rad]."""
ALONE, UNKNOWN, KNOWN = "limb alone", "person, limb modelled", "person, all modelled"
WINDOWS, PERIOD_NS = 5, 10_000_000
"""Number of windows after which the pose counts: the place of upper arm and torso follows from the pose before. Their period."""
CASES = (ALONE, UNKNOWN, KNOWN)
BEYOND = 0.9973


def measure(rig: Rig, seed: int, poses: int, draws: int, spread: Array) -> list[dict[str, Any]]:
    """Rows by gap and case: errors of the pose with a prior of these standard deviations (6,) by `haptics.NAMES`, and the share
    of poses whose error is beyond three sigma."""
    usual = Posture.usual(rig.cell, rig.cell.targets[rig.target])
    assert usual is not None, "expected a parametric forearm"
    rest = [field.shell(mesh.vertices) for mesh in (upper_arm_mesh(rig.cell.body), torso_mesh(rig.cell.body))]
    rows = []
    for gap in GAPS:
        errors: dict[str, list[Array]] = {case: [] for case in CASES}
        beyond: dict[str, list[bool]] = {case: [] for case in CASES}
        added = []
        for k in range(poses):
            rng = np.random.default_rng([seed, 102, int(1e4 * gap), k])
            T, signals = _scene(rig, rng, gap, usual, rest)
            added.append(signals[1] / np.maximum(signals[0], 1e-12) - 1.0)
            axes = rig.axes(T, 8)
            for _ in range(draws):
                home = rigid.perturb(T, (spread * rng.standard_normal(6)) @ axes)
                noise = rng.integers(2**31)
                for case in CASES:
                    estimator = rig.estimator(
                        home, np.sqrt(np.diag(axes.T @ np.diag(spread**2) @ axes)), posture=usual if case == KNOWN else None
                    )
                    window, own = np.tile(signals[0 if case == ALONE else 1], (10, 1)), np.random.default_rng(noise)
                    for stamp in range(1, WINDOWS + 1):
                        amplitude = rig.voltages(window, own).mean(axis=0)
                        estimate = estimator.update(stamp * PERIOD_NS, amplitude, rig.samples(8), rig.pads, rig.joints)
                    errors[case].append(axes @ rigid.pose_error(T, estimator.pose))
                    if estimate.may_be_limb:
                        beyond[case].append(_is_beyond(rigid.pose_error(T, estimate.T), estimate.information))
        for case in CASES:
            rmse = 1e3 * np.sqrt(np.mean(np.square(errors[case]), axis=0))
            rows.append(
                {
                    "array": rig.name,
                    "gap_m": gap,
                    "case": case,
                    "axial_mm": round(float(rmse[0]), 2),
                    "lateral_mm": round(float(rmse[1]), 2),
                    "height_mm": round(float(rmse[2]), 2),
                    "beyond_3_sigma": float(np.mean(beyond[case])) if beyond[case] else None,
                    "felt": len(beyond[case]) / len(errors[case]),
                    "added": [round(float(np.percentile(added, p)), 4) for p in (5, 50, 95)],
                }
            )
    return rows


def _scene(
    rig: Rig, rng: np.random.Generator, gap: float, usual: Posture, rest: list[field.Panels]
) -> tuple[Array, tuple[Array, Array]]:
    """A random limb at a gap, and the true signals (n,) of the limb alone and of its person, who is nowhere nearer to a pad."""
    while True:
        T, size = rig.place(rng, gap, 8)
        yaw = rigid.from_rpy((0.0, 0.0, 0.0), (0.0, 0.0, YAW * rng.standard_normal()))[:3, :3]
        posture = replace(
            usual, shoulder=usual.shoulder + SHOULDER * rng.standard_normal(3), R_world_torso=yaw @ usual.R_world_torso
        )
        forearm = field.limb(rig.mesh, *np.exp(size))
        placed = [rigid.apply(rigid.inverse(T) @ own, each.corners) for own, each in zip(posture.poses(T), rest, strict=True)]
        corners = rigid.apply(T, np.concatenate(placed).reshape(-1, 3))
        if np.linalg.norm(corners[:, None] - rig.pads[:, :3, 3], axis=2).min() < gap:
            continue
        whole = field.Body(field.Panels(np.concatenate([forearm.panels.corners, *placed])))
        signals = rig.signal(forearm, T, 8), rig.signal(whole, T, 8)
        if all((np.abs(each) < rig.skin.full_scale).all() for each in signals):
            return T, signals


def _is_beyond(error: Array, information: Array) -> bool:
    values = np.linalg.eigvalsh(information)
    rank = int((values > 1e-6 * values[-1]).sum())
    return bool(error @ information @ error > chi2.ppf(BEYOND, rank))


def table(rows: list[dict[str, Any]]) -> Table:
    """Errors by array, gap and case."""
    out = Table(
        *("array", "gap cm", "adds to the signals", "estimator sees", "lateral mm", "height mm", "axial mm", "beyond 3 sigma"),
        title=f"Limbs with the rest of their person, tracking prior, after {WINDOWS} windows: RMSE",
        caption="Adds: what upper arm and torso add, median (5 % to 95 %) of all electrodes.",
    )
    for row in rows:
        low, middle, high = row["added"]
        share = "-" if row["beyond_3_sigma"] is None else f"{row['beyond_3_sigma']:.0%}"
        cells = [f"{row[f'{name}_mm']:.2f}" for name in ("lateral", "height", "axial")]
        out.add_row(
            row["array"], f"{100 * row['gap_m']:g}", f"{middle:+.0%} ({low:+.0%} to {high:+.0%})", row["case"], *cells, share
        )
    return out
