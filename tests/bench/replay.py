"""`penumbra bench replay`: the accuracy of the whole chain without a machine's limits: no frame is lost, delays are nominal."""

from __future__ import annotations

import json
import time
from pathlib import Path

from rich.console import Console

from services.flags import Parser, above_zero
from shared.cell import description as cells
from shared.contract import topics
from sim.world.world import record
from tests.bench.live import SENSES, accuracy, reach_of, show_errors
from tests.support.replay import SERVICES, Replay


def main(argv: list[str] | None = None) -> int:
    parser = Parser(prog="penumbra bench replay", description=__doc__)
    parser.add_argument("--cell", default="table", help="built-in cell or YAML file")
    parser.add_argument("--seconds", type=above_zero, default=60.0, help="length of the recording")
    parser.add_argument("--seed", type=int, default=1, help="draws motion, occlusion and appearance")
    parser.add_argument("--skip", type=float, default=2.0, help="seconds at the start that are not scored")
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    for service in SERVICES:
        parser.add_argument(f"--{service}", default="", metavar="FLAGS", help=f"flags of {service}, such as '--method paper'")
    options = parser.parse_args(argv)
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
