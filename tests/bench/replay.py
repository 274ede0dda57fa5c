"""`penumbra bench replay`: the accuracy of the whole chain without a machine's limits: no frame is lost, delays are nominal."""

from __future__ import annotations

import json
import time
from pathlib import Path

from rich.console import Console

from penumbra.services import flags
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.sim.world.world import record
from penumbra.tests.bench.live import SENSES, accuracy, reach_of, show_errors
from penumbra.tests.support.replay import SERVICES, Replay


@flags.command(
    "bench replay",
    __doc__ or "",
    flags.Option("--cell", default="table", help="built-in cell or YAML file"),
    flags.Option("--seconds", type=flags.above_zero, default=60.0, help="length of the recording"),
    flags.Option("--seed", type=int, default=1, help="draws motion, occlusion and appearance"),
    flags.Option("--skip", type=float, default=2.0, help="seconds at the start that are not scored"),
    flags.Option("--json", type=Path, metavar="FILE", help="write the numbers to this file"),
    *(
        flags.Option(f"--{service}", default="", metavar="FLAGS", help=f"flags of {service}, such as '--method paper'")
        for service in SERVICES
    ),
    example="penumbra bench replay --json replay.json",
)
def main(options: flags.Options) -> int:
    cell = cells.load(options.cell)
    replay = Replay(cell, arguments={service: getattr(options, service).split() for service in SERVICES})
    started = time.monotonic()
    heard = replay.run(record(cell, options.seed, options.seconds))
    begin_ns = heard[0].time_ns + options.skip * 1e9
    chosen = [item for item in heard if item.time_ns >= begin_ns]
    truths = [item.message for item in chosen if item.topic is topics.TRUTH]
    estimates = {sense: [item.message for item in chosen if item.topic is topic] for sense, topic in SENSES.items()}
    result = {"cell": cell.name, "seed": options.seed, "seconds": options.seconds}
    result |= accuracy(truths, estimates, reach_of(cell), options.seconds - options.skip)
    result["wall_s"] = round(time.monotonic() - started, 1)
    show_errors(result, Console())
    if options.json:
        options.json.write_text(json.dumps(result, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
