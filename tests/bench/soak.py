"""`penumbra bench soak`: the events of a day in a cell, in half an hour, and what has grown by then.

Clients come, ask and go, viewers watch, things hide the arm, it leaves and comes back, processes are killed, all are replaced one
after another, the router goes away, nonsense is published: each as often as on a day, `--speed` times as fast. The sensors are
not sped up. Clocks could be made to run faster in every process, but the services cannot process more: on a machine with busy
cores frames are already left out, and a delay would only count for more of the faster seconds. So a leak per event shows as after
a day, one per message as after `--minutes`; growth is given per hour of these.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import psutil
import zenoh
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from penumbra.services import flags
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.tests.bench.lib import results
from penumbra.tests.bench.lib.results import Part, Result, marked
from penumbra.tests.support import injected
from penumbra.tests.support.live import Running, connect, penumbra_command, penumbra_up, service_of, wait_for

DAY_S = 86_400.0
SAMPLE_S = 5.0
WARM_UP_S = 60.0
"""Warm-up [s] of every process, in which caches fill and code is compiled; at most a third of the run."""
ANSWER_S = 60.0
LOOK_S, AWAY_S = 2.0, 4.0
"""Times [s] for which a viewer watches, and for which the arm is away."""


@dataclass(frozen=True)
class Sample:
    """One process at one time. memory_mb: private memory; mapped: number of files in /dev/shm that it maps."""

    at_s: float
    memory_mb: float
    threads: int
    handles: int
    mapped: int


@dataclass(frozen=True)
class Row:
    """Growth of the processes of one service that lived long enough. processes: their number; memory_mb: of the last one;
    mb_per_hour: median slope of their memory, None where none lived long enough; threads, handles, mapped: maximum that one
    process gained between the first and the last third of its life."""

    service: str
    processes: int
    memory_mb: float
    mb_per_hour: float | None
    threads: int
    handles: int
    mapped: int


class Life:
    """The events in the life of a chain. Each is a method; EVENTS has how often it happens per day."""

    def __init__(self, running: Running, router: injected.Router, cell: cells.Cell, seed: int):
        self.running, self.router, self.cell = running, router, cell
        self._rng = np.random.default_rng(seed)
        self._restart: subprocess.Popen | None = None
        self._away_until_s: float | None = None
        self._publishers: list[zenoh.Publisher] = []

    def client(self) -> None:
        """A client comes, asks for the pose, and goes."""
        with connect(self.router.port) as session:
            key = topics.current_pose(self.running.cell, self.cell.one("targets", None))
            for _ in range(3):
                list(session.get(f"{key}?format=json", timeout=1.0))

    def viewer(self) -> None:
        """A viewer watches pictures, masks and poses for a while."""
        with connect(self.router.port) as session:
            rings = [
                session.declare_subscriber(topic.at(cell=self.running.cell), zenoh.handlers.RingChannel(1))
                for topic in (topics.FRAME, topics.MASK, topics.FUSED)
            ]
            time.sleep(LOOK_S)
            for ring in rings:
                ring.undeclare()

    def occlusion(self) -> None:
        """Something hides a share of the arm, or nothing does."""
        if self._away_until_s is None:
            self._control("occlude", float(self._rng.choice([0.0, 0.0, 0.5, 1.0])))

    def absence(self) -> None:
        """The arm is neither seen nor felt for a while, then it is back."""
        self._away_until_s = time.monotonic() + AWAY_S
        self._set_away(True)

    def nonsense(self) -> None:
        """Bytes that are no message, on every topic that is read."""
        for topic in topics.TOPICS:
            names = {"camera": next(iter(self.cell.cameras)), "pad": next(iter(self.cell.pads))}
            names |= {"target": self.cell.one("targets", None), "robot": next(iter(self.cell.robots), "robot")}
            self.running.session.put(topic.at(cell=self.running.cell, **names), self._rng.bytes(100))

    def kill(self) -> None:
        """SIGKILL to one of the services."""
        service = str(self._rng.choice(["emulator", "segmentation", "search", "haptics", "fusion"]))
        for process in injected.instances(psutil.Process(self.running.launcher.pid), service)[:1]:
            injected.kill(process)

    def restart(self) -> None:
        """`penumbra restart`: all that can be, one after another."""
        if self._restart is None or self._restart.poll() is not None:
            endpoint = f"tcp/127.0.0.1:{self.router.port}"
            restart = ["restart", "--cell", self.running.cell, "--connect", endpoint]
            self._restart = subprocess.Popen(penumbra_command(*restart), stdout=subprocess.DEVNULL)

    def router_loss(self) -> None:
        """The router dies, and another one takes its place."""
        self.router.replace()

    def turn(self) -> None:
        """Ends an absence whose time is over."""
        if self._away_until_s is not None and time.monotonic() > self._away_until_s:
            self._away_until_s = None
            self._set_away(False)

    def settle(self) -> None:
        """Brings the arm back, in sight."""
        self._set_away(False)

    def end(self) -> None:
        """Stops a restart that still runs."""
        if self._restart is not None:
            self._restart.kill()
            self._restart.wait()

    def _set_away(self, is_away: bool) -> None:
        self._control("occlude", 1.0 if is_away else 0.0)
        for words in [f"{pad} dead" for pad in self.cell.pads] if is_away else ["all none"]:
            self._control("skin", words)

    def _control(self, command: str, value: float | str) -> None:
        """Sends a command, again and again while the emulator is away."""
        wait_for(lambda: self.running.control({"command": command, "value": value}), ANSWER_S, "the emulator's answer", 0.2)


EVENTS: dict[str, tuple[float, Callable[[Life], None]]] = {
    "client": (288, Life.client),
    "viewer": (48, Life.viewer),
    "occlusion": (720, Life.occlusion),
    "absence": (144, Life.absence),
    "nonsense": (1440, Life.nonsense),
    "kill": (24, Life.kill),
    "restart": (4, Life.restart),
    "router loss": (8, Life.router_loss),
}
"""By name, how often per day an event happens, and its method."""


class Gauge:
    """The series of samples of every process of a chain, by service and pid, and their files in /dev/shm."""

    def __init__(self, launcher: psutil.Process, router: injected.Router):
        self._launcher, self._router = launcher, router
        self.series: defaultdict[tuple[str, int], list[Sample]] = defaultdict(list)
        self.names: set[str] = set()  # of files in /dev/shm that one of them has mapped at any time
        self.shm_mb: list[float] = []  # total size of those that existed, by sample

    def look(self) -> None:
        """Takes a sample of each process."""
        now_s = time.monotonic()
        for name, process in self._processes():
            with suppress(psutil.NoSuchProcess, FileNotFoundError, ProcessLookupError):
                memory = process.memory_info()
                maps = Path(f"/proc/{process.pid}/maps").read_text()
                mapped = set(re.findall(r"/dev/shm/(\S+)", maps))
                self.names |= mapped
                own_mb = (memory.rss - memory.shared) / 1e6
                sample = Sample(now_s, own_mb, process.num_threads(), process.num_fds(), len(mapped))
                self.series[name, process.pid].append(sample)
        self.shm_mb.append(round(sum(self._sizes_mb()), 1))

    def _sizes_mb(self) -> Iterator[float]:
        for name in self.names:
            with suppress(FileNotFoundError):
                yield os.path.getsize(f"/dev/shm/{name}") / 1e6

    def _processes(self) -> Iterator[tuple[str, psutil.Process]]:
        yield "launcher", self._launcher
        with suppress(psutil.NoSuchProcess):
            yield "router", psutil.Process(self._router.popen.pid)
        with suppress(psutil.NoSuchProcess):
            for child in self._launcher.children():
                if name := service_of(child):
                    yield name, child

    def rows(self, warm_up_s: float) -> list[Row]:
        """Growth by service after the warm-up of each process."""
        by_service: defaultdict[str, list[list[Sample]]] = defaultdict(list)
        for (service, _), samples in self.series.items():
            by_service[service].append([each for each in samples if each.at_s >= samples[0].at_s + warm_up_s])
        return [row_of(service, [each for each in all_series if len(each) >= 6]) for service, all_series in by_service.items()]


def row_of(service: str, all_series: Sequence[Sequence[Sample]]) -> Row:
    """The growth of a service whose processes left these samples after their warm-up."""
    if not all_series:
        return Row(service, 0, 0.0, None, 0, 0, 0)
    gained = [max(gain(each, name) for each in all_series) for name in ("threads", "handles", "mapped")]
    mb_per_s = slope([([each.at_s for each in series], [each.memory_mb for each in series]) for series in all_series])
    return Row(service, len(all_series), round(all_series[-1][-1].memory_mb, 1), round(3600 * mb_per_s, 2), *gained)


def gain(series: Sequence[Sample], name: str) -> int:
    """Increase of the median of a number from the first to the last third."""
    values, third = [getattr(each, name) for each in series], len(series) // 3
    return round(float(np.median(values[-third:]) - np.median(values[:third])))


def slope(all_series: Sequence[tuple[Sequence[float], Sequence[float]]]) -> float:
    """The median slope between any two points of the same series (Theil 1950, Sen 1968, doi:10.1080/01621459.1968.10480934),
    which a step or an outlier hardly changes."""
    slopes: list[float] = []
    for x, y in all_series:
        i, j = np.triu_indices(len(x), 1)
        slopes += ((np.asarray(y)[j] - np.asarray(y)[i]) / (np.asarray(x)[j] - np.asarray(x)[i])).tolist()
    return float(np.median(slopes))


@contextmanager
def chain(cell: str, seed: int) -> Iterator[tuple[Running, injected.Router]]:
    """`penumbra up --connect` to a router that can be killed, with an empty cache. With models in it, those that look for lost
    arms would be loaded when an arm is first lost, and their hundred megabytes would look like a leak."""
    with tempfile.TemporaryDirectory() as cache:
        router = injected.Router(os.environ)
        try:
            through = ("--connect", f"tcp/127.0.0.1:{router.port}")
            with penumbra_up(cell, seed, *through, port=router.port, environment={"PENUMBRA_CACHE": cache}) as running:
                yield running, router
        finally:
            router.kill()


def soak(cell: str, seed: int, minutes: float, speed: float) -> dict:
    """Runs the events for `minutes` at `speed`, and returns the numbers."""
    with chain(cell, seed) as (running, router):
        wait_for(running.is_tracking, 180, "a tracked pose", 0.5)
        life, gauge = Life(running, router, cells.load(cell), seed), Gauge(psutil.Process(running.launcher.pid), router)
        began_s = time.monotonic()
        periods_s = {name: DAY_S / speed / per_day for name, (per_day, _) in EVENTS.items()}
        due_s = {name: began_s + period_s / 2 for name, period_s in periods_s.items()} | {"look": began_s}
        happened: Counter[str] = Counter()
        try:
            with Progress(console=Console(stderr=True)) as progress:
                bar = progress.add_task("soak", total=60 * minutes)
                while (now_s := time.monotonic()) < began_s + 60 * minutes:
                    progress.update(bar, completed=now_s - began_s)
                    name = min(due_s, key=lambda each: due_s[each])
                    life.turn()
                    if due_s[name] > now_s:
                        time.sleep(min(0.2, due_s[name] - now_s))
                    elif name == "look":
                        gauge.look()
                        due_s[name] = now_s + SAMPLE_S
                    else:
                        EVENTS[name][1](life)
                        happened[name] += 1
                        due_s[name] += periods_s[name]
            life.settle()
        finally:
            life.end()
        is_back = wait_for(running.is_tracking, 120, "a tracked pose at the end", 0.5)
        gauge.look()
    return {
        "seed": seed,
        "minutes": minutes,
        "speed": speed,
        "events": dict(happened),
        "tracking_at_end": is_back,
        "shm_mb": {"first": gauge.shm_mb[0], "last": gauge.shm_mb[-1]},
        "rows": [asdict(row) for row in gauge.rows(min(WARM_UP_S, 20 * minutes))],
    }


def tables(result: Result) -> list[Part]:
    """What grew, by service."""
    events = ", ".join(f"{n} x {name}" for name, n in result["events"].items())
    table = Table(
        *("service", "processes", "MB", "growth MB/h\n0", "threads\n+0", "handles\n+0", "/dev/shm mapped\n+0"),
        title=f"{result['minutes']:g} minutes at {result['speed']:g} times the events of a day: {events}",
    )
    for row in result["rows"]:
        grown = "lived too short" if row["mb_per_hour"] is None else f"{row['mb_per_hour']:+.1f}"
        gains = [f"{row[name]:+d}" for name in ("threads", "handles", "mapped")]
        table.add_row(row["service"], str(row["processes"]), f"{row['memory_mb']:.0f}", grown, *gains)
    tracked = marked("tracked" if result["tracking_at_end"] else "not tracked", result["tracking_at_end"])
    return [table, "At the end: {}; in /dev/shm {last} MB, {first} MB at first.".format(tracked, **result["shm_mb"])]


@results.benchmark(
    "soak",
    __doc__ or "",
    tables,
    flags.Option("--cell", default="table", help="built-in cell or YAML file"),
    flags.Option("--seed", type=int, default=1, help="draws motion and what happens"),
    flags.Option("--minutes", type=flags.above_zero, default=30.0, help="how long (a day at --speed 48)"),
    flags.Option("--speed", type=flags.above_zero, default=48.0, help="events, times as often as on a day"),
    example="penumbra bench soak --json soak.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    report.save(soak(options.cell, options.seed, options.minutes, options.speed))


if __name__ == "__main__":
    sys.exit(main())
