"""`penumbra bench placing`: whether the estimator reaches what `penumbra skin place` expects of a layout.

For each built-in cell, pads are proposed; then limbs of random size lie at fresh poses of the workspace, before the present pads
and before the proposed ones. Voltages come from the full boundary-element model with the link behind each pad, a window of twenty
samples; `services.haptics.estimator` finds the pose, once from the target's home and once from a track. Beside its errors
stands the bound with the same prior. Of a cell with pads before links the estimator has the field model by which places are
compared, not a fitted one, and for the present pads also the fitted one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from rich.table import Table

from penumbra.services import flags, progress
from penumbra.services.haptics.estimator import Estimator
from penumbra.services.skin.placing.layout import Placing, Wish, summary
from penumbra.services.skin.placing.scenes import Scenes
from penumbra.services.skin.placing.sensing import RANGES, SAMPLES, Sensing, meeting
from penumbra.services.skin.placing.shading import behind
from penumbra.shared.body.anatomy import target_mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin import bound
from penumbra.shared.skin.response import Response, networks
from penumbra.sim.skin.field import PadField, limb
from penumbra.tests.bench.lib import results
from penumbra.tests.bench.lib.results import Part, Result

LIMB_PANELS = (32, 16)
"""Rows and columns of panels of the true limb."""
TRACKING = np.repeat([0.02, 0.1], 3)
"""Standard deviations [m, rad] of a track, as in `penumbra bench haptics`."""
SHOWN = ("expected_cm", "expected_p95_cm", "found_cm", "found_p95_cm")


def tables(result: Result) -> list[Part]:
    """The expected errors of the layouts, and the estimator's errors beside the bound."""
    proposed = Table("cell", "pads", "median cm", "95 % below cm", "within 2 cm", title="Expected at best")
    for cell, layouts in result["cells"].items():
        for name in ("present", "proposed"):
            row = layouts[name]
            shown = f"{row['median_cm']:.2f}", f"{row['p95_cm']:.2f}", f"{100 * row['within_2_cm']:.0f} %"
            proposed.add_row(cell, f"{row['pads']} {name}", *shown)
    reached = Table(
        "cell",
        "pads",
        "prior",
        "expected, median cm",
        "95 % below cm",
        "estimator, median cm",
        "95 % below cm",
        "median of error / expected",
        title="Reached by the estimator",
    )
    for row in result["rows"]:
        reached.add_row(
            row["cell"], row["pads"], row["prior"], *(f"{row[name]:.2f}" for name in SHOWN), f"{row['median_ratio']:.2f}"
        )
    return [proposed, reached]


@results.benchmark(
    "placing",
    __doc__ or "",
    tables,
    flags.Option("--cell", multiple=True, default=("table", "arm"), metavar="CELL", help="a cell; may be repeated"),
    flags.Option("--scenes", type=flags.positive, default=60, metavar="N", help="limbs before each layout"),
    flags.Option("--seed", type=int, default=5103, help="of the proposal and of the limbs"),
    example="penumbra bench placing --cell table --json placing.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    found: dict[str, Any] = {"cells": {}, "rows": [], "scenes": options.scenes}
    for name in options.cell:
        placing = Placing(cells.load(name), Wish(seed=options.seed))
        proposed, _ = placing.choose()
        present = placing.sensing(tuple(placing.present.values()))
        found["cells"][name] = {
            layout: {"pads": len(each.pads), **summary(each.errors(placing.fresh))}
            for layout, each in (("present", present), ("proposed", proposed))
        }
        scenes = placing.drawing.draw(placing.room, options.scenes, options.seed + 2)
        layouts = {"present": {"present": present}, "proposed": {"proposed": proposed}}
        if any(pad.backed for pad in present.pads):
            layouts["present"]["present, fitted model"] = _fitted(placing, present)
        for alike in layouts.values():
            signals = _signals(placing, next(iter(alike.values())), scenes, options.seed)
            for layout, sensing in alike.items():
                for row in _rows(placing, sensing, scenes, signals, options.seed):
                    found["rows"].append({"cell": name, "pads": f"{len(sensing.pads)} {layout}", **row})
            report.save(found)


def _fitted(placing: Placing, present: Sensing) -> Sensing:
    """The present pads with the models that were fitted to them, without the robot's other links."""
    known = {own: replace(network, rest=None) for own, network in networks(placing.cell).items()}
    return replace(present, response=Response(placing.cell, placing.target, known))


def _rows(placing: Placing, sensing: Sensing, scenes: Scenes, signals: Sequence[Array], seed: int) -> list[dict[str, Any]]:
    """The bound and the estimator's errors from home and from a track, with these true signals (n,) [V] of each scene."""
    information = sensing.information(scenes).sum(axis=1)
    target = placing.drawing.target
    spread = np.repeat([target.home_spread.position, target.home_spread.rotation], 3)
    out = []
    for prior, deviation in (("home", spread), ("track", TRACKING)):
        rng = np.random.default_rng([seed, 62])
        total = information + sensing.prior
        total[:, :6, :6] += np.diag(deviation**-2.0) - np.diag(spread**-2.0)
        expected = bound.position_error(total)
        errors = np.empty(len(scenes))
        for k, (T, T_pads, signal) in enumerate(zip(scenes.targets, scenes.pads(sensing.pads), signals, strict=True)):
            start = target.home.transform if prior == "home" else rigid.perturb(T, TRACKING * rng.standard_normal(6))
            measured = target.size is not None
            estimator = Estimator(sensing.skin, sensing.response, placing.drawing.surface, start, deviation, measured=measured)
            skin = sensing.skin
            noise = np.sqrt(skin.noise / SAMPLES) * rng.standard_normal(len(skin))
            amplitude = np.clip(skin.a3 + skin.polarity * signal + noise, 0.0, skin.full_scale)
            samples = np.where(amplitude < skin.full_scale, SAMPLES, 0)
            estimator.update(1, amplitude, samples, T_pads)
            errors[k] = np.linalg.norm(estimator.pose[:3, 3] - T[:3, 3])
        out.append({"prior": prior, **_compared(expected, errors)})
    return out


def _compared(expected: Array, errors: Array) -> dict[str, float]:
    """Medians and 95th percentiles [cm], and the median ratio."""
    values = [*np.percentile(100.0 * expected, [50.0, 95.0]), *np.percentile(100.0 * errors, [50.0, 95.0])]
    return {
        **{name: round(float(value), 2) for name, value in zip(SHOWN, values, strict=True)},
        "median_ratio": round(float(np.median(errors / expected)), 2),
    }


def _signals(placing: Placing, sensing: Sensing, scenes: Scenes, seed: int) -> Sequence[Array]:
    """True signals (n,) [V] of limbs of random size, scene by scene, from the full field."""
    cell, target = placing.cell, placing.drawing.target
    rng = np.random.default_rng([seed, 61])
    own = target.size or cells.Size()
    mesh = target_mesh(target.model_copy(update={"size": None}), cell)
    fields = []
    for pad in progress.track(sensing.pads, "fields of pads"):
        robot, _, link = pad.link.partition("/")
        backing = behind(placing.models[robot].meshes[link], pad.T_link_pad) if pad.backed else None
        fields.append(PadField(cell.pad_types[pad.type], backing))
    gaps, before = meeting(placing.drawing, scenes, sensing.pads)
    felt = before & (gaps < RANGES * cell.pad_types[placing.kind].range)
    spread = 1.0 / np.sqrt(np.diag(sensing.prior)[6:])
    out = []
    for k in progress.track(range(len(scenes)), "limbs"):
        size = np.log([own.length, own.girth]) + sensing.size + spread * rng.standard_normal(2)
        length, girth = np.exp(size)
        body = limb(mesh, float(length), float(girth), *LIMB_PANELS)
        change = np.zeros(len(sensing.skin))
        for p, T_pad in enumerate(scenes.pads(sensing.pads)[k]):
            if felt[k, p]:
                change[sensing.skin.of(p)] = fields[p].change(body, rigid.inverse(T_pad) @ scenes.targets[k])
        out.append(sensing.skin.gain * sensing.skin.sensitivity * change)
    return out


if __name__ == "__main__":
    raise SystemExit(main())
