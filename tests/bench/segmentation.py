"""`penumbra bench segmentation`: masks of the committed (or other) weights on scenes that nothing was fitted to.

Rows: sequences of 14 frames in the training's domain, seen through a window of the default size that stands still while things
come between and leave. Recovery: films of 10 s in which a board hides all of the target for 0.2 to 2 s every few seconds, seen
through the window that the service would choose around the true pose. Both by the segmenter that the service runs, and without
priors; the rows of a network that has priors are measured with right and with wrong ones as well.

With --photographs instead: still pictures with masks drawn by hand, each shown a few times through the window that the service
would choose around the arm, its margin in relation to the arm's width in the picture, without priors.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track
from rich.table import Table

from penumbra.services import flags
from penumbra.services.segmentation import files, inference
from penumbra.services.segmentation.training import evaluate, priors, recordings
from penumbra.services.segmentation.training.evaluate import WARM_UP, FrameScore
from penumbra.shared.perception.lookout import Window, corners_of, whole_frame, window_around
from penumbra.sim.sets import sequences, shots
from penumbra.tests.bench.lib import photographs, results
from penumbra.tests.bench.lib.results import Part, Result, marked

SEED_BASE = 50_000_000
"""Added to the seed: far from every seed of training, calibration and cards."""
VARIETY = sequences.Variety(frames=14)
PERIOD_NS = 50_000_000
WHOLLY, FREE = 0.999, 0.5
"""Hidden shares from which on the target counts as fully hidden, and below which it counts as free again."""
BEFORE = 10
"""Number of frames before a full occlusion whose median IoU is the reference for the recovery."""
BACK = 0.9
"""Share of that IoU from which on the mask counts as recovered."""
GOALS: dict[str, Any] = {
    "iou": (0.93, 0.88, 0.78),
    "area_bias": 0.01,
    "contour_mean_px": 0.1,
    "contour_rms_px": 0.6,
    "recovery": 5,
    "ms": 15.0,
}


PRIORS: dict[str, priors.Kind] = {"with_priors": "right", "with_wrong_priors": "wrong"}
"""Kinds of priors that a network is measured with besides none, if it takes priors; by the name in the JSON file."""


def rows(segmenter: inference.Segmenter, data: Iterable[evaluate.Labelled], kind: priors.Kind = "missing") -> list[FrameScore]:
    """Scores of the frames of sequences after their first ones, with priors of a kind."""
    scores: list[FrameScore] = []
    for index, sequence in enumerate(data, 1):
        height, width = sequence.labels.shape[1:]
        window, start_ns = Window(0, 0, width, height), index * 10**10  # a gap in time, after which the state is forgotten
        known = evaluate.priors_of(sequence, index, kind)
        masks = [segmenter(image, window, start_ns + t * PERIOD_NS, known[t]) for t, image in enumerate(sequence.images)]
        scores += evaluate.frame_scores(np.stack(masks)[WARM_UP:], sequence.labels[WARM_UP:], sequence.hidden[WARM_UP:])
    return scores


def film_scores(segmenter: inference.Segmenter, film: list[shots.Shot]) -> tuple[list[float], list[float]]:
    """Hidden share and IoU (NaN where too little is visible) of each frame, the window around the true pose."""
    corners, window = corners_of(film[0].mesh.vertices), whole_frame(film[0].camera)
    hidden, iou = [], []
    for frame in film:
        assert frame.image is not None
        window = window_around(frame.camera, [(frame.T_world_target, corners)], window) or whole_frame(frame.camera)
        mask = segmenter(frame.image, window, frame.stamp_ns)
        middle = window.scale // 2
        labels = frame.labels[window.y0 + middle : window.bottom : window.scale, window.x0 + middle : window.right : window.scale]
        score = next(evaluate.frame_scores(mask[None], labels[None], np.array([frame.hidden])), None)
        hidden.append(frame.hidden)
        iou.append(score.iou if score else np.nan)
    return hidden, iou


def recoveries(hidden: list[float], iou: list[float]) -> list[int | None]:
    """For each full occlusion, the number of the first frame whose IoU is BACK of the reference, counted from the first in which
    half of the target is free again. One more than the frames watched where it never is; None where there is no reference, or
    the target is not free again."""
    found: list[int | None] = []
    covered = [k for k, share in enumerate(hidden) if share >= WHOLLY]
    last = [k for k, following in itertools.zip_longest(covered, covered[1:]) if following is None or following > k + 1]
    first = [k for before, k in zip([None, *covered], covered, strict=False) if before is None or k > before + 1]
    for begin, end in zip(first, last, strict=True):
        seen = [iou[k] for k in range(max(begin - 2 * BEFORE, 0), begin) if hidden[k] < FREE][-BEFORE:]
        free = next((k for k in range(end + 1, len(hidden)) if hidden[k] < FREE), None)
        if not seen or free is None or not np.nanmedian(seen) > 0.5:
            found.append(None)
            continue
        limit = next((k for k in range(free, len(hidden)) if hidden[k] >= WHOLLY), len(hidden))
        back = next((k for k in range(free, limit) if iou[k] >= BACK * np.nanmedian(seen)), limit)
        found.append(back - free + 1)
    return found


def result(seed: int, scores: list[FrameScore], recovered: list[int | None], ms: dict[str, float]) -> Result:
    """Content of the JSON file. recovery_frames: 90th percentile over the full occlusions; ms_per_frame: processor time."""
    known = [n for n in recovered if n is not None]
    return {
        "seed": seed,
        "rows": by_occlusion(scores),
        "recovery_frames": round(float(np.percentile(known, 90)), 1) if known else None,
        "recoveries": recovered,
        "ms_per_frame": ms["cpu_ms"],
        "wall_ms_per_frame": ms["wall_ms"],
    }


def by_occlusion(scores: list[FrameScore]) -> list[dict[str, Any]]:
    """A row of the JSON file for every class of hidden share."""
    table = []
    for (low, high), part in evaluate.by_hidden(scores).items():
        row = evaluate.summary(part) if part else {}
        names = {"iou": "iou_mean", "iou_median": "iou_median", "area_bias": "area_bias_median"}
        names |= {"contour_mean_px": "contour_mean_px", "contour_rms_px": "contour_rms_px"}
        table.append({"occlusion": [low, high], "frames": len(part), **{name: row.get(key) for name, key in names.items()}})
    return table


def priors_table(found: Result) -> list[Part]:
    """The effect of right and of wrong priors; nothing for a network without priors."""
    if not found.keys() >= PRIORS.keys():
        return []
    table = Table(
        "hidden", "without priors", "with priors", "with wrong priors", title="IoU mean, by what is known beside the picture"
    )
    for several in zip(found["rows"], *(found[name] for name in PRIORS), strict=True):
        low, high = several[0]["occlusion"]
        cells = ("-" if row["iou"] is None else f"{row['iou']:.3f}" for row in several)
        table.add_row(f"{low:.0%} to {high:.0%}", *cells)
    return [table]


def tables(found: Result) -> list[Part]:
    """Masks by hidden share, recovery and time, beside their goals; of photographs the IoU."""
    if "photographs" in found:
        return photographs.tables(found)
    title = f"Forearm with hand, visible pixels, seed {found['seed']}"
    table = Table("hidden", "frames", "IoU mean (median)", "goal", "area bias", "contour mean px", "contour RMS px", title=title)
    for row, goal in zip(found["rows"], GOALS["iou"], strict=True):
        mean, median = row["iou"], row["iou_median"]
        iou = "-" if mean is None else f"{marked(f'{mean:.3f}', mean >= goal)} ({median:.3f})"
        low, high = row["occlusion"]
        limits = ((key, GOALS[key]) for key in ("area_bias", "contour_mean_px", "contour_rms_px"))
        cells = ["-" if row[key] is None else marked(f"{row[key]:+.3f}", abs(row[key]) <= limit) for key, limit in limits]
        table.add_row(f"{low:.0%} to {high:.0%}", str(row["frames"]), iou, f">= {goal}", *cells)
    goals = (f"within {GOALS['area_bias']:.0%}", f"within {GOALS['contour_mean_px']}", f"<= {GOALS['contour_rms_px']}")
    table.add_row("goal", "", "", "", *goals)
    parts: list[Part] = [table, *priors_table(found)]
    if known := [n for n in found["recoveries"] if n is not None]:
        most = marked(f"{found['recovery_frames']}", found["recovery_frames"] <= GOALS["recovery"])
        parts.append(
            f"Frames until recovered from {len(known)} full occlusions: {np.median(known):.0f} median, {most} nine of ten (goal "
            f"{GOALS['recovery']}), {max(known)} worst; of {len(found['recoveries']) - len(known)} more it cannot be told."
        )
    ms = marked(f"{found['ms_per_frame']} ms", found["ms_per_frame"] <= GOALS["ms"])
    parts.append(
        f"A frame of {VARIETY.size} x {VARIETY.size} on one thread: {ms} of processor time (goal {GOALS['ms']:.0f}), "
        f"{found['wall_ms_per_frame']} ms by the clock."
    )
    return parts


@results.benchmark(
    "segmentation",
    __doc__ or "",
    tables,
    flags.Option("--seed", type=int, default=1, help="draws the scenes"),
    flags.Option("--frames", type=flags.positive, default=1650, help="frames of the rows"),
    flags.Option("--films", type=flags.natural, default=6, help="films of 10 s with full occlusions"),
    flags.Option("--weights", type=Path, default=inference.WEIGHTS, show_default="the committed ones", help="the network"),
    flags.Option(
        "--photographs", type=Path, metavar="FOLDER", help="measure only on the pictures of this folder, images/ and masks/"
    ),
    flags.Option("--pictures", type=results.folder, metavar="FOLDER", help="with --photographs: write them with their masks"),
    example="penumbra bench segmentation --json segmentation.json",
)
def main(options: flags.Options, report: results.Report) -> int | None:
    segmenter = inference.load_segmenter(options.weights)
    if options.photographs:
        try:
            frames = itertools.chain.from_iterable(recordings.find(options.photographs))
            report.save(photographs.measure(segmenter, frames, options.pictures))
        except (FileNotFoundError, recordings.DataError, files.FileError) as error:
            print(f"penumbra bench segmentation: {error}", file=sys.stderr)
            return 2
        return None
    ms = inference.speed(segmenter, VARIETY.size, VARIETY.size, 200)
    count = -(-options.frames // (VARIETY.frames - WARM_UP))

    def scored(kind: priors.Kind) -> list[FrameScore]:
        held_out = (sequences.render(SEED_BASE + options.seed, index, VARIETY) for index in range(count))
        return rows(segmenter, track(held_out, f"sequences, priors {kind}", total=count, transient=True), kind)

    scores = scored("missing")
    known = {name: by_occlusion(scored(kind)) for name, kind in PRIORS.items() if segmenter.has_priors}
    recovered: list[int | None] = []
    for index in track(range(options.films), "films", transient=True):
        recovered += recoveries(*film_scores(segmenter, list(shots.passing(SEED_BASE + options.seed, index))))
    report.save(result(options.seed, scores, recovered, ms) | known)
    return None


if __name__ == "__main__":
    raise SystemExit(main())
