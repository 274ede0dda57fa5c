"""`penumbra bench recorder`: what a recorder beside the running chain costs: its CPU, and the chain's rates and ages with and
without it.

The chain runs all the time. Pairs of spans follow one another, one with a recorder and one without, in alternating order, so
that drifts of the machine affect both. Motion and occlusion are drawn from `--seed`.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from rich.table import Table

from penumbra.services import flags
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.tests.bench.lib import results
from penumbra.tests.bench.lib.results import Part, Result, marked
from penumbra.tests.bench.live import Recording, cpu_times, fused_ages_s
from penumbra.tests.support.live import PATIENCE_S, Running, free_port, penumbra_command, penumbra_up, wait_for

SETTLE_S = 2.0
"""Waiting time [s] after a recorder has begun or ended."""
GOAL_PERCENT = 3.0
"""Maximum loss of a rate [%], as for everything that only observes."""
NAMES = {
    "vision_hz": "frames used per second",
    "haptic_hz": "haptic poses per second",
    "fused_hz": "fused poses per second",
    "age_ms": "exposure to fused pose, median ms",
    "chain_cores": "CPU of all processes of the chain, cores",
}
"""Keys of the values that are measured over a span, and their names."""
Span = dict[str, float | None]
"""Values of a span; the age is None where no pose of vision was tracked."""


def span(running: Running, target: str, seconds: float) -> Span:
    """Rates, age and CPU of the chain over `seconds`."""
    recording = Recording(running.session, running.cell, target)
    processes = running.processes()
    before, began = cpu_times(processes), time.monotonic()
    time.sleep(seconds)
    elapsed, after = time.monotonic() - began, cpu_times(processes)
    recording.close()
    vision, fused = recording.decoded(topics.VISION)[1], recording.decoded(topics.FUSED)[1]
    ages_s = fused_ages_s(vision, fused)
    return {
        "vision_hz": len(vision) / elapsed,
        "haptic_hz": len(recording.samples[topics.HAPTIC.name]) / elapsed,
        "fused_hz": len(fused) / elapsed,
        "age_ms": 1e3 * float(np.median(ages_s)) if len(ages_s) else None,
        "chain_cores": sum(after[name] - before[name] for name in after) / elapsed,
    }


def recorded_span(running: Running, target: str, seconds: float, words: Sequence[str]) -> Span:
    """`span` while a recorder writes, with the recorder's CPU [cores] and data rate [MB/s]."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        command = penumbra_command("record", "-o", str(path), "--cell", running.cell, *words)
        popen = subprocess.Popen([*command, "--connect", f"tcp/127.0.0.1:{running.port}"])
        try:
            wait_for(lambda: path.exists() and path.stat().st_size > 1e6, PATIENCE_S, "a file that grows", 0.1)
            time.sleep(SETTLE_S)
            own = psutil.Process(popen.pid)
            before, bytes_before, began = own.cpu_times(), path.stat().st_size, time.monotonic()
            found = span(running, target, seconds)
            elapsed, after = time.monotonic() - began, own.cpu_times()
            cores = (after.user + after.system - before.user - before.system) / elapsed
            written = (path.stat().st_size - bytes_before) * 1e-6 / elapsed
        finally:
            popen.terminate()
            popen.wait(PATIENCE_S)
    time.sleep(SETTLE_S)
    return {**found, "recorder_cores": cores, "mb_per_s": written}


def tables(result: Result) -> list[Part]:
    """Each number without and with a recorder, and the change by pairs of spans with its standard error."""
    table = Table(
        *("", "without", "with a recorder", "change %", "goal"),
        title=f"Cell {result['cell']}, seed {result['seed']}, {len(result['without'])} pairs of spans of {result['seconds']:g} s",
    )
    for key, name in NAMES.items():
        pairs = zip(*([each[key] for each in result[which]] for which in ("without", "beside")), strict=True)
        known = np.array([pair for pair in pairs if None not in pair], float)
        if not len(known):
            table.add_row(name, "-", "-", "-", "")
            continue
        without, beside = known.T
        change = 100.0 * (beside - without) / without
        error = float(np.std(change, ddof=1) / np.sqrt(len(change))) if len(change) > 1 else float("nan")
        is_rate = key.endswith("_hz")
        mean = float(np.mean(change))
        table.add_row(
            *(name, f"{np.mean(without):.2f}", f"{np.mean(beside):.2f}"),
            marked(f"{mean:+.1f} +- {error:.1f}", not is_rate or mean > -GOAL_PERCENT),
            f"> -{GOAL_PERCENT:g}" if is_rate else "",
        )
    cores, written = (np.mean([each[key] for each in result["beside"]]) for key in ("recorder_cores", "mb_per_s"))
    table.add_row("CPU of the recorder, cores", "", f"{cores:.2f}", "", "")
    table.add_row("written, MB/s", "", f"{written:.2f}", "", "")
    return [table]


@results.benchmark(
    "recorder",
    __doc__ or "",
    tables,
    flags.Option("--cell", default="table", help="built-in cell"),
    flags.Option("--pairs", type=flags.positive, default=6, help="of spans with and without"),
    flags.Option("--seconds", type=flags.above_zero, default=15.0, help="length of a span"),
    flags.Option("--seed", type=int, default=1, help="draws motion, occlusion and appearance"),
    flags.Option("--raw", is_flag=True, help="keep the bytes of frames too"),
    example="penumbra bench recorder --json recorder.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    target = cells.load(options.cell).one("targets", None)
    found: dict[str, list[dict[str, Any]]] = {"without": [], "beside": []}
    words = ["--raw"] if options.raw else []
    page = f"127.0.0.1:{free_port()}"  # another running cell may use the usual port
    with penumbra_up(options.cell, options.seed, "--log-level", "error", "--page", page) as running:
        wait_for(running.is_tracking, 120, "a tracked pose", 0.5)
        for k in range(options.pairs):
            for which in ("without", "beside") if k % 2 else ("beside", "without"):
                one = (
                    span(running, target, options.seconds)
                    if which == "without"
                    else recorded_span(running, target, options.seconds, words)
                )
                found[which].append({name: None if value is None else round(value, 4) for name, value in one.items()})
            report.save({"cell": options.cell, "seed": options.seed, "seconds": options.seconds, **found})


if __name__ == "__main__":
    sys.exit(main())
