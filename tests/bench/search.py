"""`penumbra bench search`: how near the search comes to the truth, and to what a mask can tell at all.

Random scenes that hide a given share of the target (`sim.sets.shots`), starts perturbed by 2 cm and 4 degrees. Exact masks come
from the renderer, network masks from the trained segmentation, which saw the frames before in the window that the service would
cut. Beside each row stand the paper's search and the Cramér-Rao bound of an exact mask (`tests.bench.lib.bound`): the median of
the position errors that an efficient estimator would make on the same pictures, the prior left out, as the published pose leaves
it out.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy.stats import chi2

from penumbra.services import flags
from penumbra.services.segmentation.inference import Segmenter, load_segmenter
from penumbra.shared.geometry import rigid
from penumbra.sim.sets import shots
from penumbra.sim.sets.shots import Shot
from penumbra.tests.bench.lib import bound, results
from penumbra.tests.bench.lib.judgements import GONE, KINDS, auc, gone_frames, lost_frames, reliability
from penumbra.tests.bench.lib.results import Part, marked
from penumbra.tests.bench.lib.searches import (
    HIDDEN,
    NEES_VIEW,
    PRIOR,
    VIEWS,
    Result,
    around,
    exact_mask,
    network_masks,
    perturbed,
    search_of,
    searched,
    window_of,
)

GOALS = {0.0: (0.25, 0.4), 0.3: (0.3, 0.5), 0.6: (0.6, 1.2), 0.85: (1.5, 2.5)}
"""Goals for the position error of the whole chain at NEES_VIEW, median and mean [cm], by hidden share."""
BOUND_GOAL, FASTER_GOAL, BETTER_GOAL, AUC_GOAL = 1.2, 10.0, 5.0, 0.97
WARM_FRAMES = 4


@dataclass(frozen=True)
class Plan:
    """Numbers of scenes: per row; tracked ones per row for the NEES; per kind of frame for the detector of lost poses; of hidden
    arms. domain: looks of the scenes."""

    scenes: int
    nees: int
    lost: int
    gone: int
    domain: shots.Domain = "wide"


FULL, QUICK = Plan(40, 200, 50, 110), Plan(2, 3, 2, 2)


def exact_results(
    seed: int, view: tuple[int, int, float], hidden: float, count: int
) -> tuple[dict[str, list[Result]], list[Shot]]:
    """Searches of exact masks by method, and the pictures."""
    out: dict[str, list[Result]] = {"contour": [], "paper": []}
    pictures = []
    for index in range(count):
        shot = shots.shot(seed, index, *view, hidden, images=False)
        T_prior = rigid.perturb(shot.T_world_target, perturbed(np.random.default_rng([seed, index, 1])))
        mask = exact_mask(shot, window_of(shot, T_prior))
        for method in out:
            search = search_of(shot, "default" if method == "contour" else method, True)
            out[method].append(searched(shot, search, mask, T_prior))
        pictures.append(shot)
    return out, pictures


def network_results(
    seed: int,
    view: tuple[int, int, float],
    hidden: float,
    count: int,
    segmenter: Segmenter,
    domain: shots.Domain = "wide",
    tracked: int = 0,
) -> tuple[dict[str, list[Result]], list[Shot]]:
    """Searches of the network's masks by method, after some frames that warm its state, and the pictures: `count` of them, and
    up to twice as many until `tracked` of them are tracked."""
    out: dict[str, list[Result]] = {"contour": [], "paper": []}
    pictures: list[Shot] = []
    while len(pictures) < count or (
        len(pictures) < 2 * count and sum(r.estimate.state == "tracking" for r in out["contour"]) < tracked
    ):
        index = len(pictures)
        film = shots.clip(seed, index, *view, hidden, domain, WARM_FRAMES)
        error = perturbed(np.random.default_rng([seed, index, 1]))
        *_, mask = network_masks(segmenter, film, around(error))
        T_prior = rigid.perturb(film[-1].T_world_target, error)
        for method in out:
            search = search_of(film[-1], "default" if method == "contour" else method, False)
            out[method].append(searched(film[-1], search, mask, T_prior))
        pictures.append(film[-1])
    return out, pictures


def row(masks: str, view: tuple[int, int, float], hidden: float, method: str, results: list[Result], bounds: dict[str, float]):
    """A row of the table as JSON: medians, and the 90th percentiles and means beside them."""
    measured = {
        "position_cm": (100.0, [r.position for r in results]),
        "lateral_cm": (100.0, [r.lateral for r in results]),
        "depth_cm": (100.0, [r.depth for r in results]),
        "axis_deg": (180.0 / np.pi, [r.axis for r in results]),
        "roll_deg": (180.0 / np.pi, [r.roll for r in results]),
    }
    medians = {key: round(scale * float(np.median(values)), 4) for key, (scale, values) in measured.items()}
    p90 = {key: round(scale * float(np.quantile(values, 0.9)), 4) for key, (scale, values) in measured.items()}
    mean = round(100.0 * float(np.mean(measured["position_cm"][1])), 4)
    tracked = [100.0 * r.position for r in results if r.estimate.state == "tracking"]
    width, height, distance_m = view
    return {
        "masks": masks,
        "width": width,
        "height": height,
        "distance_m": distance_m,
        "occlusion": hidden,
        "method": method,
        **medians,
        "position_cm": {"median": medians["position_cm"], "p90": p90["position_cm"], "mean": mean},
        "p90": {key: value for key, value in p90.items() if key != "position_cm"},
        **bounds,
        "ms": round(float(np.median([r.ms for r in results])), 3),
        "searched_cm": round(100.0 * float(np.median([r.with_prior for r in results])), 4),
        "tracked_cm": {"median": round(float(np.median(tracked)), 4), "mean": round(float(np.mean(tracked)), 4)}
        if tracked
        else None,
        "not_tracking": round(float(np.mean([r.estimate.state != "tracking" for r in results])), 4),
        "frames": len(results),
    }


def bounds_of(pictures: Iterable[Shot]) -> dict[str, float]:
    """The bound of pictures [cm]: median position error for a round limb, the same where the mesh's flat sides show its roll,
    the same with the prior of the start, and the root mean square for the round limb."""
    pictures = list(pictures)
    round_limb = [bound.information(shot) for shot in pictures]
    with_prior = [each + np.linalg.inv(PRIOR) for each in round_limb]
    with_facets = [bound.information(shot, facets=True) for shot in pictures]
    return {
        "bound_cm": round(100.0 * float(np.median(bound.position_errors(round_limb))), 4),
        "bound_facets_cm": round(100.0 * float(np.median(bound.position_errors(with_facets))), 4),
        "bound_prior_cm": round(100.0 * float(np.median(bound.position_errors(with_prior))), 4),
        "bound_rms_cm": round(100.0 * bound.position_rms(round_limb), 4),
    }


def nees(results: list[Result]) -> dict[str, Any]:
    """Normalised estimation error squared of the tracked poses without the roll (5 degrees of freedom): its mean, the band in
    which that lies with 95 % if the covariances are true, and its median (4.35 expected)."""
    values = []
    for result in results:
        if result.estimate.state != "tracking":
            continue
        basis = np.zeros((5, 6))
        basis[:3, :3] = np.eye(3)
        basis[3:, 3:] = result.shot.T_world_target[:3, 1:3].T
        error = basis @ result.error
        values.append(float(error @ np.linalg.solve(basis @ result.estimate.covariance @ basis.T, error)))
    if not values:
        return {"frames": 0, "mean": None, "median": None, "band": None}
    n = 5 * len(values)
    band = [round(float(chi2.ppf(p, n)) / len(values), 3) for p in (0.025, 0.975)]
    return {
        "frames": len(values),
        "mean": round(float(np.mean(values)), 3),
        "median": round(float(np.median(values)), 3),
        "band": band,
    }


def rows_of(seed: int, plan: Plan, masks: tuple[str, ...]) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """All rows of the table, and the NEES at NEES_VIEW by kind of mask and share hidden."""
    segmenter = load_segmenter() if "network" in masks else None
    rows: list[dict[str, Any]] = []
    consistency: dict[str, dict[str, Any]] = {kind: {} for kind in masks}
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("rows", total=len(masks) * len(VIEWS) * len(HIDDEN))
        for kind in masks:
            for view in VIEWS:
                for hidden in HIDDEN:
                    if kind == "exact" or segmenter is None:
                        results, pictures = exact_results(seed, view, hidden, plan.scenes)
                    elif view == NEES_VIEW:
                        results, pictures = network_results(seed, view, hidden, plan.nees, segmenter, plan.domain, plan.nees)
                    else:
                        results, pictures = network_results(seed, view, hidden, plan.scenes, segmenter, plan.domain)
                    bounds = bounds_of(pictures)
                    rows += [row(kind, view, hidden, method, found, bounds) for method, found in results.items()]
                    if view == NEES_VIEW:
                        consistency[kind][f"{hidden:g}"] = nees(results["contour"])
                    progress.advance(task)
    return rows, consistency


def overall(parts: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The NEES over all shares hidden, beside its parts."""
    used = [part for part in parts.values() if part["frames"]]
    n = sum(part["frames"] for part in used)
    mean = sum(part["mean"] * part["frames"] for part in used) / n if n else None
    band = [round(float(chi2.ppf(p, 5 * n)) / n, 3) for p in (0.025, 0.975)] if n else None
    return {"mean": None if mean is None else round(mean, 3), "band": band, "frames": n, "by_occlusion": parts}


def judged(seed: int, plan: Plan) -> dict[str, Any]:
    """The search's own judgement: as a detector of wrong poses, and where nothing is left to see."""
    segmenter = load_segmenter()
    frames = list(lost_frames(seed, plan.lost, segmenter, plan.domain))
    doubts = np.array([1.0 - frame.confidence for frame in frames])
    area = auc(doubts, np.array([frame.should_be_doubted for frame in frames]))
    by_error = auc(doubts, np.array([frame.is_wrong for frame in frames]))
    kinds = {}
    for kind in KINDS:
        chosen = [frame for frame in frames if frame.kind == kind]
        kinds[kind] = {
            "frames": len(chosen),
            "wrong": sum(frame.is_wrong for frame in chosen),
            "not shown": sum(not frame.is_shown for frame in chosen),
            "tracking": sum(frame.is_told for frame in chosen),
            "wrong and tracking": sum(frame.is_told and frame.is_wrong for frame in chosen),
        }
    gone = list(gone_frames(seed, plan.gone, segmenter, plan.domain))
    return {
        "lost_auc": None if by_error is None else round(by_error, 4),
        "lost_auc_giving_up_right": None if area is None else round(area, 4),
        "lost": kinds,
        "reliability": reliability(frames),
        "false_tracking": sum(estimate.state == "tracking" for estimate in gone),
        "hidden_frames": len(gone),
    }


def measure(seed: int, plan: Plan, parts: tuple[str, ...]) -> dict[str, Any]:
    """The whole benchmark; `parts` of exact, network, judged."""
    masks = tuple(part for part in parts if part != "judged")
    exact_results(seed + 1, VIEWS[0], 0.3, 1)  # compiles and warms up
    if "network" in masks:
        network_results(seed + 1, VIEWS[0], 0.3, 1, load_segmenter())
    result: dict[str, Any] = {"seed": seed, "domain": plan.domain}
    result["rows"], consistency = rows_of(seed, plan, masks)
    result["nees"] = overall(consistency["network"]) if "network" in masks else {}
    if "exact" in masks:
        result["nees"]["exact"] = overall(consistency["exact"])
    return result | (judged(seed, plan) if "judged" in parts else {})


def tables(result: dict[str, Any]) -> list[Part]:
    """Errors beside the bound and the paper's search, consistency, and the search's own judgement."""
    parts: list[Part] = [_errors(result, kind) for kind in dict.fromkeys(row["masks"] for row in result["rows"])]
    consistent = Table("masks", "hidden", "mean", "95 % band", "median (4.35)", "frames", title="NEES, 5 degrees of freedom")
    for name, part in (("network", result["nees"]), ("exact", result["nees"].get("exact", {}))):
        for hidden, each in part.get("by_occlusion", {}).items():
            if each["frames"]:
                low, high = each["band"]
                mean = marked(f"{each['mean']:.2f}", low <= each["mean"] <= high)
                consistent.add_row(
                    name, f"{float(hidden):.0%}", mean, f"{low:.2f} to {high:.2f}", f"{each['median']:.2f}", str(each["frames"])
                )
    if consistent.row_count:
        parts.append(consistent)
    if "lost_auc" in result:
        parts += _judged(result)
    return parts


def _errors(result: dict[str, Any], kind: str) -> Table:
    """The rows of one kind of masks."""
    table = Table(
        "picture", "hidden", "position cm", "mean", "tracked: median / mean", "bound cm", "with prior / bound", "paper's method",
        "lateral cm", "depth cm", "axis deg", "roll deg", "ms / paper's", "not tracking", "goal",
        title=f"{kind.capitalize()} masks, seed {result['seed']}, {result['domain']} domain: median (90th percentile)",
    )  # fmt: skip
    papers = {_key(row): row for row in result["rows"] if row["method"] == "paper"}
    for row in result["rows"]:
        if row["masks"] != kind or row["method"] == "paper":
            continue
        position, paper, tracked = row["position_cm"], papers[_key(row)], row["tracked_cm"]
        cells = [f"{row[key]:.2f} ({row['p90'][key]:.2f})" for key in ("lateral_cm", "depth_cm", "axis_deg", "roll_deg")]
        table.add_row(
            f"{row['width']} x {row['height']}, {row['distance_m']:g} m", f"{row['occlusion']:.0%}",
            f"{position['median']:.2f} ({position['p90']:.2f})", f"{position['mean']:.2f}",
            f"{tracked['median']:.2f} / {tracked['mean']:.2f}" if tracked else "-", f"{row['bound_cm']:.2f}",
            f"{row['searched_cm']:.2f} / {row['bound_prior_cm']:.2f}", f"{paper['position_cm']['median']:.2f}", *cells,
            f"{row['ms']:.1f} / {paper['ms']:.1f}", f"{row['not_tracking']:.0%}", _goal(row, paper),
        )  # fmt: skip
    return table


def _judged(result: dict[str, Any]) -> list[Part]:
    """Tables of the search's own judgement."""
    kinds = Table(
        "frames with", *next(iter(result["lost"].values())), title="Poses that the search calls tracked, and wrong ones"
    )
    for kind, each in result["lost"].items():
        kinds.add_row(kind, *map(str, each.values()))
    area = result["lost_auc"]
    told = "-" if area is None else marked(f"{area:.3f}", area >= AUC_GOAL)
    false = marked(f"{result['false_tracking']} of {result['hidden_frames']}", result["false_tracking"] == 0)
    reliable = Table("confidence", "frames", "mean confidence", "right", title="How often a pose is right, by its confidence")
    for row in result["reliability"]:
        reliable.add_row(
            f"{row['low']:g} to {min(row['high'], 1.0):g}", str(row["frames"]), f"{row['confidence']:.2f}", f"{row['right']:.2f}"
        )
    return [
        kinds,
        reliable,
        f"Wrong poses doubted: area under the ROC curve {told} (goal {AUC_GOAL}); {result['lost_auc_giving_up_right']} if giving "
        "up on a mask of something else is right, whatever the start.",
        f"More than {GONE:.0%} hidden and tracking: {false} (goal 0).",
    ]


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["masks"], row["width"], row["distance_m"], row["occlusion"]


def _goal(row: dict[str, Any], paper: dict[str, Any]) -> str:
    """The values of a row beside its goals."""
    position = row["position_cm"]
    if row["masks"] == "exact":
        ratio = position["median"] / row["bound_cm"]
        better, faster = paper["position_cm"]["median"] / max(position["median"], 1e-9), paper["ms"] / row["ms"]
        return ", ".join([
            f"{marked(f'{ratio:.2f}', ratio <= BOUND_GOAL)} of bound (<= {BOUND_GOAL:g})",
            f"{marked(f'{better:.0f}', better >= BETTER_GOAL)} x better ({BETTER_GOAL:g})",
            f"{marked(f'{faster:.1f}', faster >= FASTER_GOAL)} x faster ({FASTER_GOAL:g})",
        ])  # fmt: skip
    if (row["width"], row["height"], row["distance_m"]) != NEES_VIEW:
        return ""
    median, mean = GOALS[row["occlusion"]]
    is_met = position["median"] <= median and position["mean"] <= mean
    return marked(f"median <= {median:g}, mean <= {mean:g}", is_met)


@results.benchmark(
    "search",
    __doc__ or "",
    tables,
    flags.Option("--seed", type=int, default=1, help="draws scenes and starts"),
    flags.Option("--frames", type=flags.positive, help=f"scenes of each row (default {FULL.scenes}; at least 200 for the NEES)"),
    flags.Option("--quick", is_flag=True, help="a few scenes of everything, to see that it runs"),
    flags.Option("--domain", choices=("wide", "easy"), default="wide", help="looks of the network's scenes"),
    flags.Option("--parts", choices=("exact", "network", "judged"), takes="many", default=["exact", "network", "judged"]),
    example="penumbra bench search --quick --json search.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    plan = replace(QUICK if options.quick else FULL, domain=options.domain)
    if options.frames:
        plan = Plan(options.frames, max(options.frames, 200), options.frames, options.frames, options.domain)
    started = time.monotonic()
    result = measure(options.seed, plan, tuple(options.parts))
    report.save({**result, "wall_s": round(time.monotonic() - started, 1)})


if __name__ == "__main__":
    raise SystemExit(main())
