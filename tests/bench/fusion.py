"""`penumbra bench fusion`: is the observer as good as it says, is it better than its rivals, and what does it cost.

Monte Carlo runs of simulated limbs and senses (`tests.bench.lib.fusion_runs`: minimum-jerk reaches, errors that last, pictures
that are late; nothing is drawn from the filter's own model) in six situations, and in a seventh with a hand as fast as hands are.

NEES: the squared error of the pose that is published, in units of its covariance, at the moment of publication; 6 degrees of
freedom, 5 where the roll about the limb is not observed. NIS: the same of the innovations of accepted measurements. Values of
one run at different times are correlated, those of different runs are not. So the 95 % band is that of the mean of all runs at
one instant, a chi-square with as many degrees of freedom as these runs have together (Bar-Shalom, Li, Kirubarajan 2001, section
5.4, as OpenVINS plots it); the value beside it is the mean over all instants, and `inside` the share of instants whose mean over
the runs is within the band of its own, 0.95 for a perfect filter.

Beyond 3 sigma: of the poses called tracking, the share whose squared error in units of its covariance is beyond what 99.73 % of
normal errors stay within. Even a perfect filter has 0.27 % there.

As of the stamp: at the stamp of every measurement, once it has arrived, the error of the fused pose there beside that of the
measurement itself: what fusion costs. What delay costs is the rest, up to the error as of now.

Wrong: a sense is off by 10 cm for a second. How far the pose is moved is taken beside the same run in which the sense is right;
beside it stands how far it moves if the sense is silent for that second, which no gate can avoid. The same for other ways of
being wrong, with the share of the poses called tracking that are beyond 3 sigma, in the 5 s from then on.

Jump: the limb is elsewhere from one moment to the next, as where an emulator starts again: the messages of one run until then,
and those of another one afterwards. Noticed: until the pose is right or not called tracking any more.

Late: every measurement is 0, 50 or 200 ms late, or each by 0 to 200 ms at random, so that they come in a random order. What is
compared is the pose as of the newest stamp that has arrived, read at the same moments: a filter that goes back and replays is
not worse at it, one that takes late for new is. Beside it stand the error of the pose as of now, which must be guessed further
ahead the later the measurements are, and the largest distance between the poses as of a stamp once everything up to it has
arrived and those of the run in which nothing is late: 0 for a filter that does not depend on the order of arrival.

Errors beside those of the baselines are of the pose as of now, from what has arrived by then: the oracle, which knows the truth,
and the average hold the newest measurement of each sense, gtsam's smoother and the paper's observer predict from theirs.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy.stats import chi2

from penumbra.services import flags
from penumbra.services.fusion.estimate import STATES, Estimate
from penumbra.services.fusion.observer import Bank, ErrorStateObserver
from penumbra.services.fusion.settings import Subject
from penumbra.shared.contract import messages
from penumbra.shared.geometry.rigid import Array
from penumbra.tests.bench.lib import fusion_runs as runs
from penumbra.tests.bench.lib import results
from penumbra.tests.bench.lib.fusion_scores import (
    BASELINES,
    GUESSED_S,
    HOME,
    LATE_S,
    NOTICED_S,
    PUBLISHED_HZ,
    SLOW,
    SLOW_EVERY,
    SOURCES,
    SPREAD,
    THREE_SIGMA,
    Jump,
    Lateness,
    Scores,
    Way,
    consistency,
    jump,
    late,
    scored,
    shift,
    taking,
    ways,
)
from penumbra.tests.bench.lib.results import Part, Result, marked

WRONG_RUNS = 10
"""Number of runs with a wrong sense for each run of a situation."""
WRONG_GOAL_CM, WRONG_MEDIAN_GOAL_CM, BEYOND_GOAL, STAMP_GOAL, GUESSED_GOAL_CM = 3.0, 1.0, 0.001, 1.05, 2.0
LATE_GOAL, STEP_GOAL_MS, CORE_GOAL = 1.05, 0.3, 1.0
TARGETS = (1, 10, 100)
Indices = NDArray[np.int64]


def step_times(seed: int, seconds: float) -> dict[str, float]:
    """Median times [ms] of one predict, update and publish: of measurements in order, and of pictures later than the skin's."""
    run = runs.drawn("one sense wrong", seed, 0, seconds)
    found = {}
    for name, each in (("in order", runs.delayed(run, lambda: 0.0)), ("late pictures", run)):
        observer, took = ErrorStateObserver(HOME, SPREAD), []
        take = taking(observer)
        for m in each.messages:
            began = time.perf_counter()
            take(m)
            encoded(observer.estimate(runs.ns(m.arrival)), runs.ns(m.arrival))
            if name == "in order" or m.source == "vision":
                took.append(time.perf_counter() - began)
        found[name] = float(1000.0 * np.median(took[len(took) // 10 :]))
    return found


def encoded(estimate: Estimate, stamp_ns: int) -> bytes:
    """The pose at a stamp, encoded as on the bus."""
    return messages.encode(estimate.message(stamp_ns, "forearm", "world"))


def core_shares(seed: int, seconds: float) -> list[dict[str, float]]:
    """Shares of a core that a bank of n observers takes to predict, update and answer at 200 Hz, without and with the encoding of
    every pose as a message. The measurements of all targets are those of four runs, in the order of their arrival."""
    drawn = [runs.drawn("one sense wrong", seed, i, seconds) for i in range(4)]
    found = []
    for n in TARGETS:
        bank = Bank([Subject(HOME, SPREAD)] * n)
        batches = _batches(drawn, n, seconds)
        took, told = [], []
        for k, batch in enumerate(batches):
            now_ns = runs.ns((k + 1) / PUBLISHED_HZ)
            began = time.process_time()
            if len(batch[0]):
                bank.measure(*batch)
            bank.estimate(now_ns)
            took.append(time.process_time() - began)
            began = time.process_time()
            for estimate in bank.estimates(now_ns):
                encoded(estimate, now_ns)
            told.append(time.process_time() - began)
        settled = len(batches) // 4
        share = PUBLISHED_HZ * float(np.mean(took[settled:]))
        found.append({"n": n, "core_share": share, "with_messages": share + PUBLISHED_HZ * float(np.mean(told[settled:]))})
    return found


def _batches(drawn: list[runs.Run], n: int, seconds: float) -> list[tuple[Indices, Indices, Indices, Array, Array]]:
    """Arguments of `Bank.measure`: the measurements of n targets that arrive in each step of a stream at 200 Hz."""
    steps = int(seconds * PUBLISHED_HZ)
    arrived: list[list[tuple[int, runs.Message]]] = [[] for _ in range(steps)]
    for target in range(n):
        for m in drawn[target % len(drawn)].messages:
            step = int(m.arrival * PUBLISHED_HZ)
            if step < steps:
                arrived[step].append((target, m))
    return [
        (
            np.array([target for target, _ in each], np.int64),
            np.array([SOURCES.index(m.source) for _, m in each], np.int64),
            np.array([runs.ns(m.stamp) for _, m in each], np.int64),
            np.array([m.T for _, m in each]),
            np.array([m.information for _, m in each]),
        )
        for each in arrived
    ]


def summary(each: list[Scores]) -> dict[str, Any]:
    """Statistics of the runs of a situation."""
    times, count = np.concatenate([s.times for s in each]), len(each)
    stamps, nis = np.concatenate([s.stamps for s in each]), np.concatenate([s.nis for s in each])
    told = consistency(stamps, nis, np.concatenate([s.nis_dof for s in each]), count)
    errors = {key: 100.0 * np.concatenate([s.errors[key] for s in each]) for key in ("ours", *BASELINES)}
    there = 100.0 * np.concatenate([s.errors["ours"] for s in each if len(s.errors["gtsam"])])
    values, dof, states = (np.concatenate([getattr(s, key) for s in each]) for key in ("nees", "nees_dof", "states"))
    nees = consistency(times, values, dof, count)
    tracked = states == "tracking"
    beyond = values[tracked] > chi2.ppf(THREE_SIGMA, dof[tracked])
    at_stamps = {source: 100.0 * np.concatenate([s.at_stamps[source] for s in each]) for source in SOURCES}
    return {
        "nees": nees["mean"],
        "nees_band": nees["band"],
        "nees_inside": nees["inside"],
        "nis": told["mean"],
        "nis_band": told["band"],
        "nis_inside": told["inside"],
        "error_cm": float(errors["ours"].mean()),
        "error_p95_cm": float(np.percentile(errors["ours"], 95)),
        "error_beside_slow_cm": float(there.mean()),
        "baselines_cm": {key: float(errors[key].mean()) for key in BASELINES},
        "refused": sum(s.gated for s in each),
        "states": {state: float(np.mean(states == state)) for state in STATES},
        "beyond_3_sigma": float(beyond.mean()) if len(beyond) else None,
        "at_stamps_cm": {source: pairs.mean(axis=0).tolist() for source, pairs in at_stamps.items() if len(pairs)},
    }


def guessed(each: list[Scores]) -> dict[str, float]:
    """Position errors [cm] within GUESSED_S after the limb ceases to be seen or felt, and later."""
    ages = np.concatenate([[t - max(begin for begin, _ in runs.GONE if begin <= t) for t in s.times] for s in each])
    errors = 100.0 * np.concatenate([s.errors["ours"] for s in each])
    early, later = errors[ages <= GUESSED_S], errors[ages > GUESSED_S]
    return {
        "median": float(np.median(early)),
        "p95": float(np.percentile(early, 95)),
        "worst": float(early.max()),
        "later_worst": float(later.max(initial=0.0)),
    }


def jumps(each: list[Jump]) -> dict[str, float]:
    """Statistics of all jumps."""
    return {
        "noticed_median_s": float(np.median([one.noticed for one in each])),
        "noticed_worst_s": max(one.noticed for one in each),
        "beyond_3_sigma": sum(one.wrong for one in each) / max(1, sum(one.tracked for one in each)),
        "again_median_s": float(np.median([one.again for one in each])),
        "again_worst_s": max(one.again for one in each),
    }


def lateness(each: list[dict[str, Lateness]]) -> dict[str, Any]:
    """Mean errors [cm] by lateness, as of the newest stamp and as of now, and the largest difference [mm] after the fact."""
    return {
        "late": {name: float(100.0 * np.concatenate([one[name].newest for one in each]).mean()) for name in LATE_S},
        "late_now": {name: float(100.0 * np.concatenate([one[name].now for one in each]).mean()) for name in LATE_S},
        "late_difference_mm": {name: 1000.0 * max(one[name].difference for one in each) for name in LATE_S},
    }


def by_way(each: list[dict[str, Way]]) -> list[dict[str, Any]]:
    """A row for each way in which a sense is wrong: how far [cm] it moves the pose, and how that pose is judged."""
    rows = []
    for name in each[0]:
        found = [one[name] for one in each]
        tracked = sum(way.tracked for way in found)
        rows.append(
            {
                "way": name,
                **apart([way.moved for way in found]),
                "tracking": tracked / max(1, sum(way.poses for way in found)),
                "beyond_3_sigma": sum(way.beyond for way in found) / max(1, tracked),
            }
        )
    return rows


EXTRA: dict[str, Callable[[int, int, float], Any]] = {"shift": shift, "ways": ways, "late": late, "jump": jump}


def part(name: str, seed: int, index: int, seconds: float) -> Any:
    """The unit of work of a process: one run of a situation, or of an entry of EXTRA."""
    return EXTRA[name](seed, index, seconds) if name in EXTRA else scored(name, seed, index, seconds)


def measured(seed: int, count: int, seconds: float, jobs: int, console: Console) -> dict[str, Any]:
    """The whole benchmark."""
    every: dict[str, list[Any]] = {
        name: [None] * (count * WRONG_RUNS if name == "shift" else count) for name in (*runs.SITUATIONS, *EXTRA)
    }
    with Progress(console=console, transient=True) as bar, _pool(jobs) as pool:
        task = bar.add_task("runs", total=sum(map(len, every.values())))
        waiting = {
            pool.submit(part, name, seed, index, seconds): (name, index)
            for name, each in every.items()
            for index in range(len(each))
        }
        for done in as_completed(waiting):
            name, index = waiting[done]
            every[name][index] = done.result()
            bar.advance(task)
    steps = step_times(seed, seconds)
    return {
        "seed": seed,
        "runs": count,
        "seconds": seconds,
        "situations": {name: summary(every[name]) for name in runs.SITUATIONS},
        **lateness(every["late"]),
        "guessed_cm": guessed(every["hidden, out of range"]),
        "jump": jumps(every["jump"]),
        **{
            f"{kind}_sense_cm": apart(column)
            for kind, column in zip(("wrong", "silent"), zip(*every["shift"], strict=True), strict=True)
        },
        "wrong_ways": by_way(every["ways"]),
        "step_ms": steps["in order"],
        "step_late_ms": steps["late pictures"],
        "targets": core_shares(seed, min(seconds, 5.0)),
    }


def apart(distances: Sequence[float]) -> dict[str, float]:
    """Median and largest of distances [m], in cm."""
    return {"runs": len(distances), "median": 100.0 * float(np.median(distances)), "worst": 100.0 * max(distances)}


def _pool(jobs: int) -> ProcessPoolExecutor:
    """Fresh processes: a fork beside the progress bar's thread may hang."""
    return ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"))


def tables(found: Result) -> list[Part]:
    """Consistency, errors, late measurements, what a wrong sense does, and times, beside their goals."""
    title = f"Consistency, seed {found['seed']}: {found['runs']} runs of {found['seconds']:g} s"
    consistent = Table(
        "situation",
        "NEES",
        "95 % band",
        "inside",
        "NIS",
        "95 % band",
        "inside",
        "refused",
        "tracking",
        f"beyond 3 sigma (goal {BEYOND_GOAL:.1%} or less)",
        title=title,
    )
    for name, row in found["situations"].items():
        consistent.add_row(
            name, *_judged(row, "nees"), *_judged(row, "nis"), str(row["refused"]), f"{row['states']['tracking']:.0%}",
            "-" if (beyond := row["beyond_3_sigma"]) is None else marked(f"{beyond:.2%}", beyond <= BEYOND_GOAL),
        )  # fmt: skip
    stamps = Table(
        "situation",
        *SOURCES,
        "as of now",
        title=f"Position error as of the stamp, mean, cm: sense / fused (goal <= {STAMP_GOAL:g} x)",
    )
    for name, row in found["situations"].items():
        pairs = [row["at_stamps_cm"].get(source) for source in SOURCES]
        told = (
            "-" if pair is None else marked(f"{pair[0]:.2f} / {pair[1]:.2f}", pair[1] <= STAMP_GOAL * pair[0]) for pair in pairs
        )
        stamps.add_row(name, *told, f"{row['error_cm']:.2f}")
    title = f"Position error as of now, mean, cm (goal: ours the least); {' and '.join(SLOW)} of every {SLOW_EVERY}th run"
    errors = Table("situation", "ours", "95 % below", *BASELINES, title=title)
    for name, row in found["situations"].items():
        ours = {key: row["error_beside_slow_cm" if key in SLOW else "error_cm"] for key in BASELINES}
        others = (marked(f"{value:.2f}", ours[key] <= value) for key, value in row["baselines_cm"].items())
        errors.add_row(name, f"{row['error_cm']:.2f}", f"{row['error_p95_cm']:.2f}", *others)
    late = Table("ms late", "as of the newest stamp, cm", f"goal <= {LATE_GOAL:g} x", "as of now, cm", "after the fact, mm")
    for name, value in found["late"].items():
        ratio = value / found["late"]["0"]
        late.add_row(
            name, f"{value:.3f}", marked(f"{ratio:.3f}", ratio <= LATE_GOAL), f"{found['late_now'][name]:.3f}",
            f"{found['late_difference_mm'][name]:.2g}",
        )  # fmt: skip
    wrong, silent, hidden, jumped, step = (
        found[key] for key in ("wrong_sense_cm", "silent_sense_cm", "guessed_cm", "jump", "step_ms")
    )
    bank = Table(
        "targets", "share of a core at 200 Hz", "with messages", title=f"A bank of observers (goal: 100 within {CORE_GOAL:g})"
    )
    for row in found["targets"]:
        share = marked(f"{row['core_share']:.1%}", row["core_share"] <= CORE_GOAL)
        bank.add_row(f"{row['n']}", share, f"{row['with_messages']:.1%}")
    by = Table(
        *("one sense is", f"moves the pose by, median, cm (goal {WRONG_MEDIAN_GOAL_CM:g})", f"at worst (goal {WRONG_GOAL_CM:g})"),
        *("tracking", "beyond 3 sigma"),
        title=f"A sense that is wrong for a second, by how it is: {found['wrong_ways'][0]['runs']} runs each",
    )
    for row in found["wrong_ways"]:
        by.add_row(
            row["way"],
            marked(f"{row['median']:.2f}", row["median"] <= WRONG_MEDIAN_GOAL_CM),
            marked(f"{row['worst']:.2f}", row["worst"] <= WRONG_GOAL_CM),
            f"{row['tracking']:.0%}",
            marked(f"{row['beyond_3_sigma']:.2%}", row["beyond_3_sigma"] <= BEYOND_GOAL),
        )
    return [
        consistent,
        errors,
        stamps,
        late,
        f"A sense that is wrong by 10 cm for a second moves the pose by at most {_goal(wrong['worst'], WRONG_GOAL_CM, 'cm')}, in "
        f"the median by {_goal(wrong['median'], WRONG_MEDIAN_GOAL_CM, 'cm')}, of {wrong['runs']} runs; one that is silent for as "
        f"long by {silent['worst']:.2f} and {silent['median']:.2f} cm.",
        by,
        f"Nothing seen or felt: within {GUESSED_S:g} s {hidden['median']:.2f} cm off in the median, 95 % below "
        f"{hidden['p95']:.2f}, at worst {_goal(hidden['worst'], GUESSED_GOAL_CM, 'cm')}; later, "
        f"at worst, {hidden['later_worst']:.1f} cm.",
        f"A jump is noticed after {jumped['noticed_median_s']:.3f} s in the median, at worst after "
        f"{_goal(jumped['noticed_worst_s'], NOTICED_S, 's')}; of the poses called tracking later than that "
        f"{100 * jumped['beyond_3_sigma']:.2f} % are beyond 3 sigma. It is right again after {jumped['again_median_s']:.2f} s in "
        f"the median, at worst after {jumped['again_worst_s']:.2f} s.",
        f"One predict, update and publish: {marked(f'{step:.3f} ms', step <= STEP_GOAL_MS)} (goal {STEP_GOAL_MS:g}), of a "
        f"picture behind the skin's measurements {found['step_late_ms']:.3f} ms.",
        bank,
    ]


def _goal(value: float, goal: float, unit: str) -> str:
    """A value beside the goal that it must not exceed."""
    return f"{marked(f'{value:.2f} {unit}', value <= goal)} (goal {goal:g})"


def _judged(row: dict[str, Any], key: str) -> tuple[str, str, str]:
    if row[key] is None:
        return "-", "-", "-"
    low, high = row[f"{key}_band"]
    return marked(f"{row[key]:.2f}", low <= row[key] <= high), f"{low:.2f} .. {high:.2f}", f"{row[f'{key}_inside']:.0%}"


@results.benchmark(
    "fusion",
    __doc__ or "",
    tables,
    flags.Option("--seed", type=int, default=1, help="draws limbs, errors and delays"),
    flags.Option("--runs", type=flags.positive, default=100, help="of each situation"),
    flags.Option("--seconds", type=flags.above_zero, default=20.0, help="length of a run"),
    flags.Option("--jobs", type=flags.positive, default=2, help="processes"),
    example="penumbra bench fusion --json fusion.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    report.save(measured(options.seed, options.runs, options.seconds, options.jobs, Console(stderr=True)))


if __name__ == "__main__":
    raise SystemExit(main())
