"""`penumbra bench replay`: the accuracy of the whole chain without a machine's limits: no frame is lost, delays are nominal."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

from msgspec.structs import replace

from penumbra.services import flags
from penumbra.services.replay.chain import SERVICES, Replay
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.sim.world.world import record
from penumbra.tests.bench.lib import accuracy, results
from penumbra.tests.bench.lib.accuracy import SENSES
from penumbra.tests.bench.lib.results import Part, Result

APART_NS = 10**12
"""Time [ns] from the beginning of one run to that of the next, as all are scored together."""


def tables(result: Result) -> list[Part]:
    """The errors."""
    return [accuracy.table(result)]


@results.benchmark(
    "replay",
    __doc__ or "",
    tables,
    flags.Option("--cell", default="table", help="built-in cell or YAML file"),
    flags.Option("--seconds", type=flags.above_zero, default=60.0, help="length of the recording"),
    flags.Option("--runs", type=flags.positive, default=1, help="number of recordings, from as many seeds"),
    flags.Option("--seed", type=int, default=1, help="of the first; draws motion, occlusion and appearance"),
    flags.Option("--skip", type=float, default=2.0, help="seconds at the start of each that are not scored"),
    *(
        flags.Option(f"--{service}", default="", metavar="FLAGS", help=f"flags of {service}, such as '--method paper'")
        for service in SERVICES
    ),
    example="penumbra bench replay --json replay.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    cell, started = cells.load(options.cell), time.monotonic()
    found: dict[str, list[Any]] = {name: [] for name in ("truth", *SENSES)}
    for run in range(options.runs):
        for name, message in _heard(cell, options, run):
            found[name].append(message)
    truths = found.pop("truth")
    result = accuracy.summary(cell, options, truths, found, options.runs * (options.seconds - options.skip))
    report.save({**result, "runs": options.runs, "wall_s": round(time.monotonic() - started, 1)})


def _heard(cell: cells.Cell, options: flags.Options, run: int) -> Iterator[tuple[str, Any]]:
    """Messages of a run of the chain, and the truth, by name; their stamps are later than those of all earlier runs."""
    replay = Replay(cell, arguments={service: getattr(options, service).split() for service in SERVICES})
    heard = replay.run(record(cell, options.seed + run, options.seconds))
    named = {topic: name for name, topic in {"truth": topics.TRUTH, **SENSES}.items()}
    begin_ns = heard[0].time_ns + options.skip * 1e9
    for item in heard:
        if item.time_ns >= begin_ns and item.topic in named:
            yield named[item.topic], replace(item.message, stamp_ns=item.message.stamp_ns + run * APART_NS)


if __name__ == "__main__":
    raise SystemExit(main())
