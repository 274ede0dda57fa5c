"""`penumbra bench skin`: the field model beside the measured and solved figures of the real pad, and its speed.

What is compared: the capacitance of all conductors of the bare pad, what a forearm changes at the centre electrode, the response
law fitted to it in log space, where its signal-to-noise ratio is 1 dB, lateral contrast, the influence of a grounded link; how a
limb, a hand, a metal bar and a plastic block differ; and the networks that run live beside the boundary elements that they
stand for, at poses and sizes that they were not fitted to. `--seed` draws those. `--only-left-out`: what
the rest of the person and neighbouring boards change, which the networks leave out.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import trimesh
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy.optimize import brentq, least_squares

from penumbra.services import flags
from penumbra.services.skin import model
from penumbra.shared.body.anatomy import Mesh, target_mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.response import networks
from penumbra.sim.skin.field import Body, PadField, limb, shell
from penumbra.sim.skin.pads import SkinModel
from penumbra.sim.world.person import Person
from penumbra.tests.bench.lib import left_out, results
from penumbra.tests.bench.lib.results import Part, Result, marked

Array = np.ndarray

PLATE_PF = 2.448
CENTRE_FF = {1: 103.0, 2: 32.8, 5: 4.96, 10: 1.28, 15: 0.60, 20: 0.35}
LAW = {"a1": 2.66, "a2": 3.0e4, "log_r2": 0.9995}
SNR_1DB_CM = 15.0
CONTRAST = {2: 0.37, 5: 0.14, 10: 0.053, 15: 0.028}
LINK_FACTOR = {10: 0.49, 15: 0.37}
"""Figures of the published pad: boundary elements and the paper's."""
CAPSENSE_MS = 100.0
"""Maximum time [ms] per step and sensor of CapSense, an open simulator of capacitive sensors by finite elements."""
MEDIAN_GOAL, P95_GOAL, CORE_GOAL = 0.01, 0.05, 0.1
"""Goals of the networks: median and 95th percentile of the relative errors, share of a core."""
OFF_CENTRE_M = 0.02
LINK_RADIUS_M, LINK_LENGTH_M, LINK_BEHIND_M = 0.07, 0.30, 0.005
"""A robot's link: a grounded cylinder behind the pad's face."""
GAPS_CM = (1, 2, 3, 5, 7.5, 10, 12.5, 15, 20)


def forearm(cell: cells.Cell) -> Mesh:
    """The median man's forearm, from elbow to wrist."""
    return part(target_mesh(next(iter(cell.targets.values())), cell), Label.FOREARM)


def part(mesh: Mesh, label: Label) -> Mesh:
    """The faces of a mesh with one label."""
    own = mesh.labels == label
    used, faces = np.unique(mesh.faces[own], return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), mesh.labels[own])


def across(mesh: Mesh, gap: float, aside: float = 0.0) -> Array:
    """T_pad_mesh (4, 4): its axis along the pad's y, `aside` [m] along x, its skin at this gap [m] from the point of the pad's
    plane below its middle."""
    T = rigid.from_rpy((aside, 0.0, 0.0), (0.0, 0.0, np.pi / 2))
    T[1, 3] = -0.5 * (mesh.vertices[:, 0].min() + mesh.vertices[:, 0].max())
    surface, under = Surface(mesh.vertices, mesh.faces), np.array([[aside, 0.0, 0.0]])

    def excess(height: float) -> float:
        T[2, 3] = height
        return float(surface.nearest(rigid.apply(rigid.inverse(T), under))[0][0]) - gap

    T[2, 3] = brentq(excess, gap, gap + 0.2)
    return T


def law(gaps: Array, volts: Array) -> dict[str, float]:
    """The paper's law fitted to gaps [m] and signals [V], both (n,), in log space."""

    def residual(p: Array) -> Array:
        return p[0] - np.log1p(np.exp(p[1]) * gaps**2) - np.log(volts)

    fit = least_squares(residual, (np.log(volts[0]), 10.0))
    a1, a2 = np.exp(fit.x)
    return {"a1": float(a1), "a2": float(a2), "log_r2": float(1.0 - fit.fun.var() / np.log(volts).var())}


def figures(cell: cells.Cell) -> dict[str, Any]:
    """The figures to compare with the real pad's, of the cell's first pad type without a link."""
    kind = next(iter(cell.pad_types.values()))
    pad, mesh = PadField(kind), forearm(cell)
    body, volt = limb(mesh), kind.chain.sensitivity

    def centre(gap: float) -> float:
        return float(pad.change(body, across(mesh, gap))[0])

    gaps = np.arange(1.0, 20.1, 0.5) / 100
    changes = np.array([centre(gap) for gap in gaps])
    fitted = law(gaps, volt * changes)
    decibel = 10.0 * np.log10((volt * changes) ** 2 / (2.0 * kind.rest.noise))
    contrast = {}
    for gap in CONTRAST:
        # the published centroids lie a quarter of a millimetre off the middle: the mean of both sides
        right, left = (pad.change(body, across(mesh, gap / 100, side * OFF_CENTRE_M)) for side in (1, -1))
        contrast[gap] = 0.5 * float((right[1] - right[2]) / (right[1] + right[2]) + (left[2] - left[1]) / (left[1] + left[2]))
    cylinder = trimesh.creation.cylinder(LINK_RADIUS_M, LINK_LENGTH_M, sections=32)
    x_axis = rigid.from_rpy((0.0, 0.0, -LINK_RADIUS_M - LINK_BEHIND_M), (0.0, np.pi / 2, 0.0))
    backed = PadField(kind, shell(rigid.apply(x_axis, np.asarray(cylinder.vertices))))
    factor = {gap: float(backed.change(body, across(mesh, gap / 100))[0]) / centre(gap / 100) for gap in LINK_FACTOR}
    return {
        "plate_pF": pad.plate_pF,
        "centre_fF": {gap: centre(gap / 100) for gap in CENTRE_FF},
        "law": {**fitted, "a3": kind.rest.a3},
        "snr_1db_cm": float(100.0 * np.interp(-1.0, -decibel, gaps)),
        "lateral_contrast": contrast,
        "link_factor": factor,
        "bodies_fF": bodies(cell, pad),
    }


def bodies(cell: cells.Cell, pad: PadField) -> dict[str, dict[int, list[float]]]:
    """Changes [fF] by different bodies at all electrodes, by name and gap [cm]."""
    whole = target_mesh(next(iter(cell.targets.values())), cell)
    arm, hand = part(whole, Label.FOREARM), part(whole, Label.HAND)
    cylinder = trimesh.creation.cylinder(0.02, 0.3, sections=24, transform=rigid.from_rpy((0, 0, 0), (0, np.pi / 2, 0)))
    bar = Mesh(np.asarray(cylinder.vertices), np.asarray(cylinder.faces, np.int32), np.zeros(len(cylinder.faces), np.uint8))
    panels = limb(bar).panels
    shown = {
        "forearm": (arm, limb(arm)),
        "hand": (hand, limb(hand)),
        "metal bar, grounded": (bar, Body(panels, ground_pF=np.inf)),
        "metal bar, floating": (bar, Body(panels, ground_pF=0.0)),
        "plastic bar": (bar, Body(panels, permittivity=3.0)),
    }
    return {
        name: {gap: pad.change(body, across(mesh, gap / 100)).round(4).tolist() for gap in (2, 5, 10)}
        for name, (mesh, body) in shown.items()
    }


def live(cell: cells.Cell, seed: int, poses: int) -> dict[str, Any]:
    """The networks of a cell beside the boundary elements: relative errors by gap, and time."""
    target, aim = next(iter(cell.targets.items()))
    mesh, known = target_mesh(aim, cell), networks(cell)
    errors: dict[float, list[Array]] = {gap: [] for gap in GAPS_CM}
    mountings = model.mountings(cell, target)
    limbs: dict[Any, Any] = {}
    for mounting in mountings:
        count = len(GAPS_CM) * max(1, poses // len(mountings))
        data = model.solve(mounting, mesh, count, seed, gaps=[gap / 100 for gap in GAPS_CM], limbs=limbs)
        relative = np.abs(model.predict(known[mounting.fingerprint], data) / data.change - 1.0)
        for k, gap in enumerate(GAPS_CM):
            errors[gap].append(relative[k :: len(GAPS_CM)].ravel())
    pooled = {gap: np.concatenate(parts) for gap, parts in errors.items()}
    assert cell.sim is not None, f"cell {cell.name}: expected a `sim` section"
    skin, person = SkinModel(cell, target), Person(cell, cell.sim, aim)
    T, pads = rigid.from_rpy((0.0, 0.0, 0.12), (0.1, 0.2, 0.3)), np.tile(np.eye(4), (len(cell.pads), 1, 1))
    skin.person(pads, person.poses(T))
    blocks = []
    for _ in range(9):
        began = time.process_time()
        for _ in range(300):
            skin.person(pads, person.poses(T))
        blocks.append((time.process_time() - began) / 300)
    return {
        "pads": len(cell.pads),
        "rate_hz": 1000,
        "core_share": float(np.median(blocks) * 1000.0),
        "error_median": {gap: float(np.median(e)) for gap, e in pooled.items()},
        "error_p95": {gap: float(np.percentile(e, 95)) for gap, e in pooled.items()},
    }


def tables(found: Result) -> list[Part]:
    """Figures beside the real pad's, changes by different bodies, and the networks that run live."""
    if "left_out" in found:
        return [left_out.table(found)]
    figure = Table("figure", "ours", "the real pad", title="The pad near a forearm")
    figure.add_row("all conductors at 1 V, pF", f"{found['plate_pF']:.3f}", f"{PLATE_PF}")
    for gap, value in found["centre_fF"].items():
        figure.add_row(f"change at the centre, {gap} cm, fF", f"{value:.3g}", f"{CENTRE_FF[int(gap)]:.3g}")
    for name, value in LAW.items():
        figure.add_row(f"law, {name}", f"{found['law'][name]:.5g}", f"{value:.5g}")
    figure.add_row("SNR of 1 dB at, cm", f"{found['snr_1db_cm']:.1f}", f"{SNR_1DB_CM:g}")
    for gap, value in found["lateral_contrast"].items():
        figure.add_row(f"lateral contrast, {gap} cm", f"{value:.3f}", f"{CONTRAST[int(gap)]}")
    for gap, value in found["link_factor"].items():
        figure.add_row(f"with a grounded link, {gap} cm, times", f"{value:.2f}", f"{LINK_FACTOR[int(gap)]}")
    body = Table("body", "2 cm", "5 cm", "10 cm", title="Change at the electrodes c r l t b, fF (loss of capacitance)")
    for name, rows in found["bodies_fF"].items():
        body.add_row(name, *(" ".join(f"{v:.3g}" for v in row) for row in rows.values()))
    parts: list[Part] = [figure, body]
    for name, where in (("live", "bare pads (table)"), ("live_hull", "on the robot's links (arm)")):
        one = found[name]
        error = Table(
            *("gap, cm", f"median error, % (goal {MEDIAN_GOAL:.0%})", f"95 % below, % (goal {P95_GOAL:.0%})"),
            title=f"Networks beside boundary elements: {where}",
        )
        for gap, value in one["error_median"].items():
            p95 = one["error_p95"][gap]
            error.add_row(
                gap, marked(f"{100 * value:.2f}", value <= MEDIAN_GOAL), marked(f"{100 * p95:.2f}", p95 <= P95_GOAL)
            )  # fmt: skip
        share = marked(f"{100 * one['core_share']:.1f} %", one["core_share"] <= CORE_GOAL)
        each_us = 1000.0 * one["core_share"] / one["pads"]
        parts += [
            error,
            f"{one['pads']} pads at {one['rate_hz']} Hz: {share} of a core (goal {CORE_GOAL:.0%}), {each_us:.1f} us a pad and "
            f"step, where CapSense needs up to {1000 * CAPSENSE_MS:.0f} us for a sensor.",
        ]
    return parts


@results.benchmark(
    "skin",
    __doc__ or "",
    tables,
    flags.Option("--seed", type=int, default=1, help="draws the poses of the live comparison"),
    flags.Option("--poses", type=flags.positive, default=160, help="for each gap of the live comparison"),
    flags.Option("--only-left-out", is_flag=True, help="only what the rest of the person and other boards change"),
    example="penumbra bench skin --json skin.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    table, arm = cells.load("table"), cells.load("arm")
    if options.only_left_out:
        with Progress(console=Console(stderr=True), transient=True) as progress:
            report.save({"seed": options.seed, "left_out": left_out.measure(table, options.seed, progress)})
        return
    found = {"seed": options.seed, **figures(table), "live": live(table, options.seed, options.poses)}
    found["live_hull"] = live(arm, options.seed, options.poses)
    report.save(found)


if __name__ == "__main__":
    raise SystemExit(main())
