"""`penumbra bench replay`: the accuracy of the whole chain without a machine's limits: no frame is lost, delays are nominal."""

from __future__ import annotations

import time

from penumbra.services import flags
from penumbra.services.replay.chain import SERVICES, Replay
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.sim.world.world import record
from penumbra.tests.bench.lib import accuracy, results
from penumbra.tests.bench.lib.accuracy import SENSES
from penumbra.tests.bench.lib.results import Part, Result


def tables(result: Result) -> list[Part]:
    """The errors."""
    return [accuracy.table(result)]


@results.benchmark(
    "replay",
    __doc__ or "",
    tables,
    flags.Option("--cell", default="table", help="built-in cell or YAML file"),
    flags.Option("--seconds", type=flags.above_zero, default=60.0, help="length of the recording"),
    flags.Option("--seed", type=int, default=1, help="draws motion, occlusion and appearance"),
    flags.Option("--skip", type=float, default=2.0, help="seconds at the start that are not scored"),
    *(
        flags.Option(f"--{service}", default="", metavar="FLAGS", help=f"flags of {service}, such as '--method paper'")
        for service in SERVICES
    ),
    example="penumbra bench replay --json replay.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    cell = cells.load(options.cell)
    replay = Replay(cell, arguments={service: getattr(options, service).split() for service in SERVICES})
    started = time.monotonic()
    heard = replay.run(record(cell, options.seed, options.seconds))
    begin_ns = heard[0].time_ns + options.skip * 1e9
    chosen = [item for item in heard if item.time_ns >= begin_ns]
    truths = [item.message for item in chosen if item.topic is topics.TRUTH]
    estimates = {sense: [item.message for item in chosen if item.topic is topic] for sense, topic in SENSES.items()}
    result = accuracy.summary(cell, options, truths, estimates, options.seconds - options.skip)
    report.save({**result, "wall_s": round(time.monotonic() - started, 1)})


if __name__ == "__main__":
    raise SystemExit(main())
