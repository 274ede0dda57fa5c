"""`penumbra bench dashboard`: what the web page costs the running chain, without and with open pages in turns.

A page is a websocket that confirms every message at once as shown, like a browser that keeps up with all messages; the browser's
own computing is not included. Rounds without and with pages take turns, in reversed order from pair to pair, so that other load
on the machine affects both. Motion and occlusion are drawn from `--seed`.
"""

from __future__ import annotations

import asyncio
import json
import sys
import threading
import time
from collections import Counter
from typing import Any

import aiohttp
import numpy as np
from rich.table import Table

from penumbra.services import flags
from penumbra.shared.cell import description as cells
from penumbra.tests.bench.lib import results
from penumbra.tests.bench.lib.results import Part, Result, marked
from penumbra.tests.bench.live import Recording, cpu_times
from penumbra.tests.support.live import Running, free_port, penumbra_up, wait_for

RATES = {
    "frames_per_s": "frames used per second",
    "haptic_per_s": "haptic poses per second",
    "fused_per_s": "fused poses per second",
}
CHANGE_GOAL = 0.03
"""Maximum share by which a rate of the chain may fall while pages are open."""
CPU_GOAL = 0.04
"""Maximum CPU [cores] of the dashboard per open page."""
MOMENTS_GOAL = 29.0
"""Minimum number of pictures of the scene per second and page; the dashboard offers 30."""
SETTLE_S = 1.0
"""Time [s] before a round, in which pages open or close."""


class Pages:
    """Open pages of a dashboard at `url`, within a `with` block. counts: received messages by stream."""

    def __init__(self, url: str, camera: str, number: int):
        self._url, self._camera, self._number = url, camera, number
        self.counts: Counter[str] = Counter()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.fault: BaseException | None = None

    def __enter__(self) -> Pages:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._loop.call_soon_threadsafe(lambda: [task.cancel() for task in asyncio.all_tasks(self._loop)])
        self._thread.join()

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._show_all())
        except asyncio.CancelledError:
            pass
        except BaseException as error:
            self.fault = error
        finally:
            self._loop.close()

    async def _show_all(self) -> None:
        async with aiohttp.ClientSession() as session, asyncio.TaskGroup() as group:
            for _ in range(self._number):
                group.create_task(self._show(session))

    async def _show(self, session: aiohttp.ClientSession) -> None:
        headers = {"Origin": self._url.rstrip("/")}
        async with session.ws_connect(f"{self._url}socket", headers=headers, max_msg_size=0) as socket:
            await socket.send_json({"key": "", "camera": self._camera})
            async for message in socket:
                binary = message.type is aiohttp.WSMsgType.BINARY
                stream = "picture" if binary else json.loads(message.data)["stream"]
                if stream != "hello":
                    await socket.send_json({"shown": stream})
                self.counts[stream] += 1
        raise ConnectionError(f"the page was closed with {socket.close_code}")


def measure(running: Running, recording: Recording, pages: Pages | None, seconds: float) -> dict[str, Any]:
    """Rates of the chain, CPU and what the pages received, over `seconds`."""
    time.sleep(SETTLE_S)
    processes = running.processes()
    for rows in recording.samples.values():
        rows.clear()
    shown = Counter(pages.counts) if pages else Counter()
    cpu_before, began = cpu_times(processes), time.monotonic()
    time.sleep(seconds)
    counts = {name: len(rows) for name, rows in recording.samples.items()}
    seen = Counter(pages.counts) if pages else Counter()
    cpu_after, elapsed = cpu_times(processes), time.monotonic() - began
    cpu = {name: (spent - cpu_before.get(name, spent)) / elapsed for name, spent in cpu_after.items()}
    if pages and pages.fault:
        raise pages.fault
    return {
        "frames_per_s": round(counts["vision"] / elapsed, 2),
        "haptic_per_s": round(counts["haptic"] / elapsed, 2),
        "fused_per_s": round(counts["fused"] / elapsed, 2),
        "shown_per_s": {stream: round((seen[stream] - shown[stream]) / elapsed, 2) for stream in ("picture", "moment")},
        "cpu": round(sum(cpu.values()), 3),
        "dashboard_cpu": round(cpu["dashboard"], 4),
    }


def change(result: Result, rate: str) -> tuple[float, float, float]:
    """Relative change of a rate with pages: lower quartile, median and upper quartile over the pairs of rounds."""
    pairs = np.array([[pair[side][rate] for side in ("without", "with")] for pair in result["pairs"]])
    low, middle, high = np.percentile(pairs[:, 1] / np.maximum(pairs[:, 0], 1e-9) - 1.0, (25, 50, 75)).tolist()
    return low, middle, high


def tables(result: Result) -> list[Part]:
    """The chain without and with pages, then what the pages received and cost."""
    pages, pairs = result["pages"], result["pairs"]
    title = f"Cell {result['cell']}, seed {result['seed']}, {len(pairs)} pairs of {result['seconds']:g} s, pages: {pages}"
    table = Table("", "without", "with", "change", "goal", title=title,
                  caption="means over the rounds; change: median of the pairs, and their quartiles")  # fmt: skip
    for rate, name in RATES.items():
        means = [f"{np.mean([pair[side][rate] for pair in pairs]):.1f}" for side in ("without", "with")]
        low, middle, high = change(result, rate)
        said = f"{100.0 * middle:+.1f} % ({100.0 * low:+.1f} to {100.0 * high:+.1f})"
        table.add_row(name, *means, marked(said, middle > -CHANGE_GOAL), f"> -{CHANGE_GOAL:.0%}")
    cpu = {side: float(np.mean([pair[side]["dashboard_cpu"] for pair in pairs])) for side in ("without", "with")}
    with_pages = f"{cpu['with']:.3f} cores"
    table.add_row("CPU of the dashboard", f"{cpu['without']:.3f} cores", marked(with_pages, cpu["with"] <= CPU_GOAL * pages), "",
                  f"<= {CPU_GOAL * pages:g} cores")  # fmt: skip
    every = [f"{np.mean([pair[side]['cpu'] for pair in pairs]):.2f} cores" for side in ("without", "with")]
    table.add_row("CPU of all processes", *every, "", "")
    shown = [pair["with"]["shown_per_s"] for pair in pairs]
    scene, picture = (float(np.mean([each[stream] for each in shown])) / pages for stream in ("moment", "picture"))
    goal = f">= {MOMENTS_GOAL:g}"
    table.add_row("pictures of the scene per second and page", "", marked(f"{scene:.1f}", scene >= MOMENTS_GOAL), "", goal)
    table.add_row("pictures of the camera per second and page", "", f"{picture:.1f}", "", "as frames used")
    return [table]


@results.benchmark(
    "dashboard",
    __doc__ or "",
    tables,
    flags.Option("--cell", default="table", help="built-in cell or YAML file"),
    flags.Option("--pages", type=flags.positive, default=1, help="number of open pages"),
    flags.Option("--pairs", type=flags.positive, default=24, help="number of rounds without, and as many with pages"),
    flags.Option("--seconds", type=flags.above_zero, default=4.0, help="length of a round"),
    flags.Option("--seed", type=int, default=1, help="draws motion, occlusion and appearance"),
    example="penumbra bench dashboard --cell arm --json dashboard-arm.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    cell, port = cells.load(options.cell), free_port()
    target, camera = cell.one("targets", None), cell.one("cameras", None)
    with penumbra_up(options.cell, options.seed, "--page", str(port), "--log-level", "error") as running:
        wait_for(running.is_tracking, 120, "a tracked pose", 0.5)
        wait_for(lambda: "dashboard" in running.health(), 60, "the dashboard", 0.5)
        recording = Recording(running.session, cell.name, target)
        pairs: list[dict[str, Any]] = []
        for number in range(options.pairs):
            pair: dict[str, Any] = {}
            for side in ("without", "with") if number % 2 else ("with", "without"):
                if side == "without":
                    pair[side] = measure(running, recording, None, options.seconds)
                    continue
                with Pages(f"http://127.0.0.1:{port}/", camera, options.pages) as pages:
                    pair[side] = measure(running, recording, pages, options.seconds)
            pairs.append(pair)
            report.save({
                "cell": cell.name,
                "seed": options.seed,
                "seconds": options.seconds,
                "pages": options.pages,
                "pairs": pairs,
            })  # fmt: skip
        recording.close()


if __name__ == "__main__":
    sys.exit(main())
