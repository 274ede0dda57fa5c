"""`penumbra bench paper`: the paper's whole experiment: its table, its curves as pictures with their data, and a page of all.

In FOLDER: index.html, which needs no other file; for each picture NAME.png and NAME.json, for the table table1.json. Finished
runs are kept in FOLDER/runs: a run that was killed goes on where it was.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from penumbra.services import flags
from penumbra.sim.sets import trial
from penumbra.tests.bench import table1
from penumbra.tests.bench.lib import campaign, curves, page, pictures, results, trials
from penumbra.tests.bench.table1 import tables


def passed(seed: int) -> trials.Played:
    """A run through all levels of occlusion."""
    return trials.played(trial.passage(seed), trial.PASSAGE_S)


def jobs(seed: int, quick: bool) -> list[campaign.Job]:
    """The measurements in addition to the table's runs."""
    here = "penumbra.tests.bench.paper"
    return [
        campaign.Job(f"{seed}-passage", f"{here}:passed", (seed,)),
        campaign.Job(f"{seed}-haptic{'-quick' * quick}", "penumbra.tests.bench.lib.curves:haptic_by_gap", (seed, quick)),
        campaign.Job("response", "penumbra.tests.bench.lib.curves:response_by_gap", ()),
    ]


def draw(
    found: dict[str, Any], played: Sequence[trials.Played], others: Sequence[Any], run: results.Result, folder: Path
) -> None:
    """Writes all pictures with their data. run: description of the run."""
    passage, haptic, response = others
    shown = {
        "table": found,
        "vision_by_distance": curves.vision_by_distance(played),
        "haptic_by_gap": haptic,
        "through_occlusion": curves.through_occlusion(passage),
        "response_by_gap": response,
    }
    for name, data in shown.items():
        pictures.DRAWN[name](data, folder / f"{name}.png")
        if data is not found:
            results.write(folder / f"{name}.json", {**data, "run": run})
    frames = curves.examples(passage)
    pictures.examples(trial.passage(run["seed"]), frames, folder / "examples.png")
    results.write(folder / "examples.json", frames)


@flags.command(
    "bench paper",
    (__doc__ or "").partition("\n\n")[0],
    *table1.PARAMS,
    flags.Option("--out", type=results.folder, required=True, metavar="FOLDER", help="where pictures, data and index.html go"),
    example="penumbra bench paper --quick --out paper",
)
def main(options: flags.Options) -> int:
    started = time.monotonic()
    folder: Path = options.out
    report = results.Report(folder / "table1.json")
    with campaign.bar(Console(stderr=True)) as progress:
        others = campaign.run(jobs(options.seed, options.quick), folder / "runs", options.jobs, progress, "curves")
        found, played = table1.measure(options, folder / "runs", progress)
    draw(found, played, others, report.run, folder)
    report.save({**found, "wall_s": round(time.monotonic() - started, 1)})
    page.write(found, folder, folder / "index.html", options.quick)
    report.show(tables)
    print(f"{folder / 'index.html'}: the table, the curves and the paper's numbers")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
