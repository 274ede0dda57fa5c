"""`penumbra bench table1`: the paper's result table, on runs that nothing was fitted to, beside the paper's own numbers.

A cell of the table is what the skin reaches (all of the run, or nothing of it), how far away the camera stands, and the share of
the limb that is hidden. `sim.sets.trial` draws its runs, `tests.bench.lib.trials` plays them through the services: ProcNet (our
vision) and what fusion makes of it with the skin, PoseCNN likewise, and the paper's own search, network and observer throughout.

Errors are those of the object's centre, averages over all scored frames as in the paper, with the 95 % confidence interval of a
bootstrap over the runs. A sense that has no pose in a frame cannot be scored there: the share of such frames stands beside.
"""

from __future__ import annotations

import functools
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from penumbra.services import flags
from penumbra.sim.sets import trial
from penumbra.sim.sets.trial import SETTINGS, Setting
from penumbra.tests.bench.lib import campaign, results, trials
from penumbra.tests.bench.lib.results import Part, Result, marked
from penumbra.tests.bench.lib.trials import CHAINS

REFERENCE = Path(__file__).parents[1] / "references" / "paper_table1.json"
COLUMNS = {
    "procnet": ("procnet", "vision"),
    "multimodal_procnet": ("procnet", "fused"),
    "posecnn": ("posecnn", "vision"),
    "multimodal_posecnn": ("posecnn", "fused"),
    "paper_procnet": ("faithful", "vision"),
    "paper_multimodal_procnet": ("faithful", "fused"),
    "live_multimodal_procnet": ("procnet", "live"),
}
"""By name, the chain and the kind of its poses. The first four are the paper's, two more its method, as we built it; the last is
the fused pose as it is published, some 40 ms before the camera's pose of the same moment is known."""
PAPERS = tuple(COLUMNS)[:4]
REACHES = {"inside": "haptic_range_inside", "outside": "haptic_range_outside"}
DISTANCES = {"short": "short_0_3m", "medium": "medium_3_6m", "long": "long_6_10m"}
"""Names in the paper's table."""
TRIALS, QUICK_TRIALS = 20, 1
QUICK_S = 1.6
"""Length [s] of a quick run: about half of the scored time."""
SHARES = {"inside": (1.0 / 5.0, 1.0 / 4.0), "outside": (1.0 / 3.0, 1.0 / 2.0)}
"""Maximum error of multimodal ProcNet as a share of that of the paper's best column, by reach of the skin. The second share holds
for the hardest settings: under heavy occlusion, and out of range at a long distance."""
GOALS = {
    "multimodal": "multimodal ProcNet in range at most a fifth of the paper's best column, a quarter under heavy occlusion; "
    "out of range at most a third, a half under heavy occlusion and at 6 to 10 m",
    "posecnn": "no error of ProcNet or multimodal ProcNet above the paper's PoseCNN",
    "rival": "our PoseCNN within 1.5 times of the paper's, so that it is a rival",
    "fusion": "fusion not worse than its own vision, where both have a pose",
}
RIVAL = 1.5
DRAWS = 2000
CAMERA = (
    f"One camera: {trial.SENSOR_PX[0]} x {trial.SENSOR_PX[1]} pixels, focal length {trial.FOCAL_PX:g} px, {trial.RATE_HZ:g} Hz, "
    "read only around the limb; pixels summed: "
    + ", ".join(f"{name} {n} x {n} (focal length then {trial.FOCAL_PX / n:g} px)" for name, n in trial.BINNING.items() if n > 1)
)


@functools.cache
def reference() -> dict[str, Any]:
    """The paper's table."""
    found: dict[str, Any] = json.loads(REFERENCE.read_text())
    return found


def paper_of(setting: Setting) -> list[float]:
    """The paper's four numbers [cm] of a setting."""
    numbers: list[float] = reference()[REACHES[setting.reach]][DISTANCES[setting.distance]][setting.occlusion]
    return numbers


def one(setting: dict[str, Any], seed: int, index: int, seconds: float) -> trials.Played:
    """Draws and plays a trial."""
    return trials.played(trial.draw(Setting(**setting), seed, index), seconds)


def jobs(seed: int, count: int, seconds: float) -> list[campaign.Job]:
    """All trials, those of every setting in turn."""
    return [
        campaign.Job(f"{seed}-{setting}-{k}-{seconds:g}", "penumbra.tests.bench.table1:one", (asdict(setting), seed, k, seconds))
        for k in range(count)
        for setting in SETTINGS
    ]


def table(results: Sequence[trials.Played], seed: int) -> dict[str, Any]:
    """The whole table in the layout of the paper's, of `trials.played` results."""
    out: dict[str, Any] = {
        "source": f"penumbra bench table1 --seed {seed}; average position error in cm; paper: {reference()['source']}",
        "seed": seed,
        "columns": list(COLUMNS),
        "camera": CAMERA,
        "bands": {
            "camera_distance_m": trial.DISTANCE_M,
            "occlusion": trial.HIDDEN,
            "gap_m": {"inside": list(trial.GAP_M["inside"]), "outside": [trial.GAP_M["outside"][0], None]},
        },
    }
    for setting in SETTINGS:
        own = [each for each in results if Setting(**each["setting"]) == setting]
        row = out.setdefault(REACHES[setting.reach], {}).setdefault(DISTANCES[setting.distance], {})
        row[setting.occlusion] = {**score(own), "paper": paper_of(setting)}
    out["goals"] = goals(out)
    return out


def score(results: Sequence[trials.Played]) -> dict[str, Any]:
    """The numbers of one cell of the table, lists in the order of COLUMNS; None where no frame has a pose."""
    scored = [trials.is_scored(each) for each in results]
    out: dict[str, Any] = {"trials": len(results), "frames": int(sum(each.sum() for each in scored))}
    out |= {"mean_hidden": _mean([np.array(each["hidden"])[use] for each, use in zip(results, scored, strict=True)])}
    out |= {"mean_gap_m": _mean([np.array(each["gap_m"])[use] for each, use in zip(results, scored, strict=True)])}
    names = ("ours", "ours_ci95", "p95_cm", "axis_deg", "roll_deg", "lateral_cm", "depth_cm", "no_pose")
    out |= {name: [] for name in names}
    values = {
        error: {column: [_errors(each, *where, error, use) for each, use in zip(results, scored, strict=True)]
                for column, where in COLUMNS.items()}
        for error in trials.ERRORS
    }  # fmt: skip
    for column in COLUMNS:
        cm = values["cm"][column]
        every = np.concatenate(cm) if cm else np.zeros(0)
        known = every[np.isfinite(every)]
        out["ours"].append(_rounded(known.mean()) if len(known) else None)
        out["ours_ci95"].append(bootstrap([each[np.isfinite(each)] for each in cm]))
        out["p95_cm"].append(_rounded(np.percentile(known, 95)) if len(known) else None)
        for error in ("axis_deg", "roll_deg", "lateral_cm", "depth_cm"):
            out[error].append(_mean([each[np.isfinite(each)] for each in values[error][column]]))
        out["no_pose"].append(_rounded(1.0 - len(known) / len(every)) if len(every) else None)
    out["lost"] = {column: out["no_pose"][k] for k, column in enumerate(COLUMNS) if "multimodal" in column}
    out["fused_against_vision"] = {
        chain: _both(values["cm"][vision], values["cm"][fused])
        for chain, vision, fused in zip(CHAINS, tuple(COLUMNS)[0:6:2], tuple(COLUMNS)[1:6:2], strict=True)
    }
    return out


def bootstrap(groups: Sequence[np.ndarray]) -> list[float] | None:
    """The 95 % confidence interval of the mean over all values, resampled by groups, as values within one are correlated. None
    for fewer than two groups with values."""
    groups = [each for each in groups if len(each)]
    if len(groups) < 2:
        return None
    sums, counts = np.array([each.sum() for each in groups]), np.array([len(each) for each in groups])
    drawn = np.random.default_rng(0).integers(0, len(groups), (DRAWS, len(groups)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    return [_rounded(value) for value in np.percentile(means, [2.5, 97.5])]


def cells_of(found: dict[str, Any]) -> Iterator[tuple[trial.Reach, trial.Distance, trial.Occlusion, dict[str, Any]]]:
    """Reach, distance, occlusion and numbers of every cell of a table."""
    for setting in SETTINGS:
        numbers = found[REACHES[setting.reach]][DISTANCES[setting.distance]][setting.occlusion]
        yield setting.reach, setting.distance, setting.occlusion, numbers


def goals(found: dict[str, Any]) -> dict[str, Any]:
    """Number of cells that meet each goal, and those that miss it, with the ratios of their errors to the allowed ones (None: no
    error)."""
    ratios: dict[str, dict[str, float | None]] = {goal: {} for goal in GOALS}
    for reach, distance, occlusion, cell in cells_of(found):
        name, ours, paper = str(Setting(reach, distance, occlusion)), cell["ours"], cell["paper"]
        is_hard = occlusion == "heavy" or (reach, distance) == ("outside", "long")
        both = cell["fused_against_vision"]["procnet"]
        ratios["multimodal"][name] = _ratio(ours[1], SHARES[reach][is_hard] * min(paper))
        ratios["posecnn"][name] = max((_ratio(ours[k], paper[2]) for k in (0, 1)), key=lambda ratio: ratio or np.inf)
        ratios["rival"][name] = _ratio(ours[2], RIVAL * paper[2])
        ratios["fusion"][name] = _ratio(both["fused_cm"], both["vision_cm"])
    out = {}
    for goal, text in GOALS.items():
        missed = {name: ratio for name, ratio in ratios[goal].items() if ratio is None or ratio > 1.0}
        out[goal] = {"goal": text, "met": len(SETTINGS) - len(missed), "of": len(SETTINGS), "missed": missed}
    return out


def _ratio(value: float | None, allowed: float | None) -> float | None:
    return None if value is None or allowed is None else _rounded(value / allowed)


def _both(vision: list[np.ndarray], fused: list[np.ndarray]) -> dict[str, Any]:
    """Mean errors where both have a pose, and the confidence interval of the error that fusion adds."""
    both = [np.isfinite(v) & np.isfinite(f) for v, f in zip(vision, fused, strict=True)]
    v = [each[use] for each, use in zip(vision, both, strict=True)]
    f = [each[use] for each, use in zip(fused, both, strict=True)]
    return {
        "frames": int(sum(use.sum() for use in both)),
        "vision_cm": _mean(v),
        "fused_cm": _mean(f),
        "added_cm_ci95": bootstrap([b - a for a, b in zip(v, f, strict=True)]),
    }


def _errors(result: trials.Played, chain: str, sense: str, error: str, use: np.ndarray) -> np.ndarray:
    """One error of the scored frames, NaN where there is no pose."""
    if chain not in result["chains"]:
        return np.full(int(use.sum()), np.nan)
    return np.array(result["chains"][chain][sense][error], dtype=float)[use]


def _mean(groups: Sequence[np.ndarray]) -> float | None:
    every = np.concatenate(groups) if groups else np.zeros(0)
    return _rounded(every.mean()) if len(every) else None


def _rounded(value: float) -> float:
    return round(float(value), 3)


def tables(found: Result) -> list[Part]:
    """The table, ours over the paper's, and the goals."""
    parts: list[Part] = []
    for reach, key in REACHES.items():
        view = Table(
            "camera", "hidden", *(f"{name}\nours / paper" for name in ("ProcNet", "multimodal", "PoseCNN", "multimodal")),
            "paper's method\nvision / fused", "multimodal\npublished", "no pose\nvision / fused",
            title=f"{reach.capitalize()} of the skin's range: position error, cm",
        )  # fmt: skip
        for distance, name in DISTANCES.items():
            for occlusion, cell in found[key][name].items():
                cells = [_cell(cell, k) for k in range(len(PAPERS))]
                faithful = " / ".join(_text(cell["ours"][k]) for k in (4, 5))
                missing = " / ".join(
                    f"{100 * cell['no_pose'][k]:.0f}%" if cell["no_pose"][k] is not None else "-" for k in (0, 1)
                )
                view.add_row(distance, occlusion, *cells, faithful, _text(cell["ours"][6]), missing)
        parts.append(view)
    parts.append(f"{found['camera']}.")
    for result in found["goals"].values():
        missed = ", ".join(f"{name} {_text(ratio)}" for name, ratio in result["missed"].items())
        more = f"; over it, as a factor: {missed}" if missed else ""
        met = marked(f"{result['met']} of {result['of']}", not result["missed"])
        parts.append(f"{result['goal'][0].upper()}{result['goal'][1:]}: {met} cells{more}.")
    return parts


def _cell(cell: dict[str, Any], k: int) -> str:
    value, interval, paper = cell["ours"][k], cell["ours_ci95"][k], cell["paper"][k]
    spread = f" [{interval[0]:.2f}, {interval[1]:.2f}]" if interval else ""
    return f"{_text(value)}{spread} / {paper:.2f}"


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def measure(options: flags.Options, folder: Path, progress: Progress) -> tuple[dict[str, Any], list[trials.Played]]:
    """The table and the trials that it is made of."""
    count, seconds = (QUICK_TRIALS, QUICK_S) if options.quick else (options.trials, trial.SECONDS)
    results = campaign.run(jobs(options.seed, count, seconds), folder, options.jobs, progress, "trials")
    return table(results, options.seed), results


PARAMS = (
    flags.Option("--seed", type=int, default=1, help="draws persons, motions, looks, occluders and the camera's places"),
    flags.Option("--trials", type=flags.positive, default=TRIALS, help="runs of each cell of the table"),
    flags.Option("--quick", is_flag=True, help="one short run a cell: whether it runs, no numbers to believe"),
    flags.Option("--jobs", type=flags.positive, default=2, help="processes, each on one core"),
)
"""The flags that `penumbra bench paper` has too."""


@results.benchmark(
    "table1",
    (__doc__ or "").partition("\n\n")[0],
    tables,
    *PARAMS,
    flags.Option("--resume", type=Path, metavar="FOLDER", help="keep finished runs here, and take those that are there"),
    example="penumbra bench table1 --quick --json table1.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary, campaign.bar(Console(stderr=True)) as progress:
        folder = options.resume or Path(temporary)
        found, _ = measure(options, folder, progress)
    found["wall_s"] = round(time.monotonic() - started, 1)
    report.save(found)


if __name__ == "__main__":
    raise SystemExit(main())
