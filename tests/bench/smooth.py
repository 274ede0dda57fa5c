"""`penumbra bench smooth`: how much better a trajectory is afterwards, and whether its covariance is true.

Three poses at the same moments: the fused one as it was published then; as of its stamp, the same filter once all measurements up
to that moment have arrived; and the smoothed one, from those before and after it. Without --cell the measurements are those of
the simulated limbs and senses of `penumbra bench fusion` (`tests.bench.lib.fusion_runs`). With --cell a recording of a simulated
cell goes through segmentation, search, haptics and fusion in this process (`services.replay`), while a panel hides the limb
wholly again and again, for 0.5 to 2 s.

NEES and its 95 % band as in `penumbra bench fusion`; of a cell there is one run, whose errors are correlated, and no band. The
six degrees of freedom are those of the pose. Visible and hidden in a cell: at most a third of the limb's pixels, more than 90 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.stats import chi2

from penumbra.services import flags
from penumbra.services.fusion.estimate import Array, Estimate, measured
from penumbra.services.fusion.observer import ErrorStateObserver
from penumbra.services.fusion.settings import Subject
from penumbra.services.fusion.smoother import Smoother
from penumbra.services.replay.chain import Heard, Replay
from penumbra.services.replay.smooth import BY_TOPIC
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.geometry import rigid
from penumbra.sim.world.world import World, stream
from penumbra.tests.bench.lib import fusion_runs as runs
from penumbra.tests.bench.lib import fusion_scores as scores
from penumbra.tests.bench.lib import results
from penumbra.tests.bench.lib.accuracy import OCCLUDED, VISIBLE
from penumbra.tests.bench.lib.results import Part, Result, marked

POSES = {"published": "as published", "stamp": "as of the stamp", "smoothed": "smoothed"}
HIDE_S, SEE_S, SLIDE_S = (0.5, 1.0, 1.5, 2.0), 1.4, 0.8
"""Times [s] for which the panel hides the limb wholly (in turn), for which it is away, and that it takes in between."""
EVERY = 22
"""One of this many published poses is scored: as often as in `penumbra bench fusion`."""
Measurement = tuple[str, int, Array, Array, Array | None]
Score = tuple[float, float]
"""Position error [m] and NEES."""


def trajectories(
    subject: Subject, measurements: Sequence[Measurement], stamps_ns: Sequence[int]
) -> dict[int, dict[str, Estimate]]:
    """The estimates by stamp (ascending), from the measurements up to it (`stamp`) and from all (`smoothed`). Stamps before the
    first measurement that the smoother uses or after the last one are left out."""
    observer, smoother = ErrorStateObserver(subject.home, subject.spread), Smoother(subject)
    in_order = sorted(measurements, key=lambda each: (each[1], list(observer.log.counts).index(each[0])))
    for each in measurements:
        smoother.measure(*each)
    found, taken, trajectory = {}, 0, smoother.trajectory()
    within = [stamp_ns for stamp_ns in stamps_ns if trajectory.begin_ns <= stamp_ns <= trajectory.end_ns]
    for stamp_ns, smoothed in zip(within, trajectory.estimates(np.array(within)), strict=True):
        while taken < len(in_order) and in_order[taken][1] <= stamp_ns:
            source, at_ns, T, information, step = in_order[taken]
            observer.measure(source, at_ns, T, information, step=step)
            taken += 1
        found[stamp_ns] = {"stamp": observer.estimate(stamp_ns), "smoothed": smoothed}
    return found


def score(truth: rigid.Array, T: rigid.Array, covariance: Array, rolls: bool = True) -> Score:
    """Score of a pose (4, 4) with its covariance (6, 6); `rolls` as in `scores.normalised`."""
    return float(np.linalg.norm(truth[:3, 3] - T[:3, 3])), scores.normalised(truth, T, covariance, rolls)


def summary(rows: Sequence[dict[str, Score]], dof: Sequence[int], states: Sequence[str]) -> dict[str, Any]:
    """Summary of the moments of a situation, from their scores, degrees of freedom and states of the smoothed poses."""
    out: dict[str, Any] = {"moments": len(rows), "tracking": states.count("tracking") / len(states), "poses": {}}
    for name in POSES:
        errors, nees = np.array([row[name] for row in rows]).T
        out["poses"][name] = {
            "median_cm": 100.0 * float(np.median(errors)),
            "p95_cm": 100.0 * float(np.percentile(errors, 95)),
            "nees": float(nees.mean()),
            "beyond_3_sigma": float(np.mean(nees > chi2.ppf(scores.THREE_SIGMA, dof))),
        }
    return out


# ---- simulated senses


def of_senses(seed: int, count: int, seconds: float, console: Console) -> dict[str, Any]:
    """A row for each situation."""
    found = {}
    for name, situation in runs.SITUATIONS.items():
        rows: list[dict[str, Score]] = []
        dof: list[int] = []
        states: list[str] = []
        for index in track(range(count), name, console=console, transient=True):
            run = runs.drawn(name, seed, index, seconds)
            run = runs.wronged(run, seed, index) if situation.wrong else run
            observer = ErrorStateObserver(scores.HOME, scores.SPREAD)
            player = scores.Player(run, [scores.taking(observer)])
            told = [(m.source, runs.ns(m.stamp), m.T, m.information, None) for m in run.messages]
            subject = Subject(scores.HOME, scores.SPREAD)
            at = trajectories(subject, told, [runs.ns(t) for t in scores.instants(run)])
            for t in (t for t in scores.instants(run) if runs.ns(t) in at):
                player.until(t)
                poses = at[runs.ns(t)]
                poses["published"] = observer.estimate(runs.ns(t))
                rolls = situation.rolls(t)
                rows.append({key: score(run.at(t), each.T, each.covariance, rolls) for key, each in poses.items()})
                dof.append(6 if rolls else 5)
                states.append(poses["smoothed"].state)
        found[name] = summary(rows, dof, states) | {"band": scores.band(np.full(count, np.mean(dof)))}
    return found


# ---- cells


class Truths:
    """The limb's pose between the truths of an emulator."""

    def __init__(self, said: Sequence[messages.Truth]):
        self._said = sorted(said, key=lambda each: each.stamp_ns)
        self._stamps_ns = np.array([each.stamp_ns for each in self._said])

    def at(self, stamp_ns: int) -> tuple[rigid.Array, messages.Truth]:
        """The pose (4, 4) at a stamp, from the nearest truth and its velocity, and that truth."""
        near = self._said[int(np.argmin(np.abs(self._stamps_ns - stamp_ns)))]
        T = rigid.transform(near.position, near.orientation)
        return rigid.perturb(T, near.velocity * ((stamp_ns - near.stamp_ns) * 1e-9)), near


def heard_of(cell: cells.Cell, seed: int, seconds: float) -> list[Heard]:
    """Messages in the cell while the panel comes and goes: poses of the senses and of fusion, and the truth."""
    world, at, number = World(cell, seed), SEE_S, 0
    world.occlude(0.0, 0.0)
    while at < seconds:
        hidden_s = HIDE_S[number % len(HIDE_S)]
        world.occlude(1.0, at)
        world.occlude(0.0, at + SLIDE_S + hidden_s)
        at, number = at + 2.0 * SLIDE_S + hidden_s + SEE_S, number + 1
    heard: list[Heard] = []
    wanted = (*BY_TOPIC, topics.FUSED, topics.TRUTH)
    Replay(cell, hear=lambda item: heard.append(item) if item.topic in wanted else None).run(stream(world, seconds))
    return heard


def of_cell(cell: cells.Cell, seed: int, seconds: float, skip: float) -> dict[str, Any]:
    """A row for each situation that occurred, of the cell's first target."""
    name, target = next(iter(cell.targets.items()))
    heard = [item for item in heard_of(cell, seed, seconds) if item.names["target"] == name]
    truths = Truths([item.message for item in heard if item.topic is topics.TRUTH])
    told = [
        (sense.name, item.message.stamp_ns, *measured(item.message, sense.measures))
        for item in heard
        if (sense := BY_TOPIC.get(item.topic)) is not None and item.message.state == sense.usable
    ]
    begins_ns = heard[0].time_ns + round(skip * 1e9)
    fused = [item.message for item in heard if item.topic is topics.FUSED][::EVERY]
    fused = [each for each in fused if each.stamp_ns >= begins_ns]
    reach = max(cell.pad_types[pad.type].range for pad in cell.pads.values())
    situations: dict[str, list[tuple[dict[str, Score], str]]] = {}
    poses = trajectories(Subject.of(target, cell.body), told, [each.stamp_ns for each in fused])
    for each in fused:
        T, near = truths.at(each.stamp_ns)
        if each.stamp_ns not in poses or VISIBLE < near.hidden <= OCCLUDED:
            continue
        found = poses[each.stamp_ns]
        row = {key: score(T, one.T, one.covariance) for key, one in found.items()}
        row["published"] = score(T, rigid.transform(each.position, each.orientation), each.covariance)
        where = f"{'hidden' if near.hidden > OCCLUDED else 'visible'}, {'in' if near.gap <= reach else 'out of'} range"
        situations.setdefault(where, []).append((row, found["smoothed"].state))
    return {
        where: summary([row for row, _ in rows], [6] * len(rows), [state for _, state in rows])
        for where, rows in sorted(situations.items(), reverse=True)
    }


# ---- what is shown


def tables(result: Result) -> list[Part]:
    """One table."""
    heads = [text for name in POSES.values() for text in (f"{name}, cm", "NEES")]
    of = (
        f"cell {result['cell']}, {result['seconds']:g} s"
        if result["cell"]
        else f"{result['runs']} runs of {result['seconds']:g} s"
    )
    table = Table(
        *("situation", "moments", *heads, "95 % band", "beyond 3 sigma", "tracking"),
        title=f"Position error, median (95 % below), seed {result['seed']}: {of}; the last two columns are of the smoothed poses",
    )
    for name, row in result["situations"].items():
        low, high = row.get("band") or (0.0, np.inf)
        texts = []
        for pose in row["poses"].values():
            texts += [
                f"{pose['median_cm']:.2f} ({pose['p95_cm']:.2f})",
                marked(f"{pose['nees']:.2f}", low <= pose["nees"] <= high),
            ]
        smoothed = row["poses"]["smoothed"]
        shown = f"{low:.2f} .. {high:.2f}" if "band" in row else "-"
        table.add_row(name, str(row["moments"]), *texts, shown, f"{smoothed['beyond_3_sigma']:.2%}", f"{row['tracking']:.0%}")
    return [table]


@results.benchmark(
    "smooth",
    __doc__ or "",
    tables,
    flags.Option("--cell", show_default="simulated senses", help="built-in cell or YAML file"),
    flags.Option("--seed", type=int, default=1, help="draws limbs, errors and delays; motion and appearance of a cell"),
    flags.Option("--runs", type=flags.positive, default=20, help="of each situation of the simulated senses"),
    flags.Option("--seconds", type=flags.above_zero, default=20.0, help="length of a run, or of the recording"),
    flags.Option("--skip", type=float, default=1.0, help="seconds at the start of a recording that are not scored"),
    example="penumbra bench smooth --json smooth.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    if options.cell:
        cell = cells.load(options.cell)
        found = of_cell(cell, options.seed, options.seconds, options.skip)
    else:
        found = of_senses(options.seed, options.runs, options.seconds, Console(stderr=True))
    named = {"cell": options.cell or "", "seed": options.seed, "runs": options.runs, "seconds": options.seconds}
    report.save({**named, "situations": found})


if __name__ == "__main__":
    raise SystemExit(main())
