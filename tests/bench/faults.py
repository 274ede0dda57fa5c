"""`penumbra bench faults`: every fault for every service of the running chain, measured from outside over the bus.

The arm moves in sight of the camera; a fault strikes the replica that owns the stream. A client of the bus, which knows nothing
of the fault, measures: the longest time without a fused pose while a sense was alive, how long the service's topics took to get
back to their old rates, measurements used twice, and poses called tracking that were wrong by more than three sigma.

Services that connect the cell with the outside (`tests/bench/lib/connected.py`) have faults of their own, which are measured at
the output of each.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import psutil
from rich.console import Console
from rich.progress import track
from rich.table import Table

from penumbra.services import flags
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.topics import Topic
from penumbra.shared.runtime import scheduling
from penumbra.tests.bench.lib import connected, results
from penumbra.tests.bench.lib.results import Part, Result, marked
from penumbra.tests.support import injected, observed
from penumbra.tests.support.live import Running, penumbra_up, service_of, wait_for

SERVICES = ("emulator", "segmentation", "search", "haptics", "fusion")
REPLICATED = SERVICES[1:]
ALL = "all"
BEFORE_S = 3.0
"""Time [s] over which the rates before a fault are measured; those of its halves must agree within STEADY."""
OLD_S = 15.0
"""Minimum age [s] of a process that is struck: one that dies early counts as in a crash loop, and is restarted after a delay."""
STEADY = 0.3
AFTER_S, LONGEST_S = 4.0, 30.0
"""Minimum time [s] for which the chain is watched after a fault, and maximum while the old rate is not back."""
READY_S = 180.0
"""Time limit [s] for the chain to be ready: a first start compiles."""
HOUR_S = 3600.0
STARVED_S = 10.0
"""Time [s] for which a process that gets no new memory is watched; it ends when it needs some."""
GOAL_GAP_MS, GOAL_ALONE_S, GOAL_REPLICA_S = 50.0, 1.5, 0.5


@dataclass
class Chain:
    """A running chain, the observer that listens to it (`outside`), and the parts of its setup that can be broken."""

    running: Running
    cell: cells.Cell
    replicas: int
    broken: injected.Breakable | None = None
    outside: observed.Outside = field(init=False)

    def instances(self, service: str) -> list[psutil.Process]:
        return injected.instances(psutil.Process(self.running.launcher.pid), service)

    @property
    def parts(self) -> injected.Breakable:
        assert self.broken is not None, "expected a chain of `breakable`"
        return self.broken

    def owner(self, service: str) -> psutil.Process:
        """The replica of a service that publishes at the highest rate."""
        reports = [report for report in observed.health(self.running) if report["service"] == service]
        busiest = max(reports, key=lambda report: sum(row["rate_hz"] for row in report["published"].values()))
        return psutil.Process(busiest["pid"])

    def is_settled(self, service: str = ALL) -> bool:
        """Whether all services are ready, `service` for at least OLD_S, and the arm is tracked in sight of the camera."""
        if self.running.control({"command": "occlude", "value": 0}) is None:
            return False
        reports = [report for report in observed.health(self.running) if report["ready"]]
        if any(report["uptime_s"] < OLD_S for report in reports if service in (ALL, report["service"])):
            return False
        ready = [report["service"] for report in reports]
        wanted = {service: self.replicas if service in REPLICATED else 1 for service in SERVICES}
        pose = self.running.pose()
        return all(ready.count(name) == n for name, n in wanted.items()) and pose is not None and pose["state"] == "tracking"


# ---- setups


@contextmanager
def plain(cell: str, seed: int, replicas: int) -> Iterator[Chain]:
    """`penumbra up`."""
    with penumbra_up(cell, seed, *_replicas(replicas)) as running:
        yield Chain(running, cells.load(cell), replicas)


@contextmanager
def breakable(cell: str, seed: int, replicas: int) -> Iterator[Chain]:
    """`injected.breakable`."""
    with injected.breakable(cell, seed, *_replicas(replicas)) as broken:
        yield Chain(broken.running, cells.load(cell), replicas, broken)


def _replicas(number: int) -> list[str]:
    return [word for name in REPLICATED for word in ("--replicas", f"{name}={number}")]


# ---- faults


@dataclass(frozen=True)
class Fault:
    """A kind of fault. setup: the chain that it needs; strike: begins the fault of a service's process, and ends it; lasts_s:
    time in between; services: those that it strikes, ALL for all at once; quick: whether it belongs to the short run."""

    setup: Callable[[str, int, int], AbstractContextManager[Chain]]
    strike: Callable[[Chain, Any], AbstractContextManager[Any]]
    lasts_s: float = 0.0
    services: tuple[str, ...] = SERVICES
    quick: bool = False


def _kill(chain: Chain, process: psutil.Process) -> AbstractContextManager[None]:
    return injected.at_once(partial(injected.kill, process))


def _memory(chain: Chain, process: psutil.Process) -> AbstractContextManager[None]:
    return injected.at_once(partial(injected.starve, process, chain.running.session, chain.running.cell, STARVED_S))


@contextmanager
def _crash_loop(chain: Chain, process: psutil.Process) -> Iterator[None]:
    service = service_of(process) or ""
    spared = {each.pid for each in chain.instances(service)} - {process.pid}
    with injected.crash_loop(lambda: [each for each in chain.instances(service) if each.pid not in spared]):
        yield


def _on(inject: Callable[[psutil.Process], AbstractContextManager[Any]]) -> Callable[..., AbstractContextManager[Any]]:
    return lambda chain, process: inject(process)


def _storm(topic: Topic, chain: Chain, process: None) -> AbstractContextManager[Any]:
    names = {"camera": next(iter(chain.cell.cameras)), "pad": next(iter(chain.cell.pads))}
    names |= {"target": next(iter(chain.cell.targets)), "robot": next(iter(chain.cell.robots), "")}
    return injected.storm(chain.running.session, topic.at(cell=chain.running.cell, **names))


def _router(chain: Chain, process: None) -> AbstractContextManager[None]:
    return injected.at_once(chain.parts.router.replace)


def _cut(chain: Chain, process: psutil.Process) -> AbstractContextManager[None]:
    return chain.parts.link.cut(process)


def _own_clock(seconds: float, chain: Chain, process: psutil.Process) -> AbstractContextManager[None]:
    return chain.parts.clocks.shifted(seconds, process)


def _all_clocks(seconds: float, chain: Chain, process: None) -> AbstractContextManager[None]:
    return injected.at_once(partial(chain.parts.clocks.jump, seconds))


@contextmanager
def _kill_on_full_disk(chain: Chain, process: psutil.Process) -> Iterator[None]:
    if chain.parts.disk is None:
        raise PermissionError("full disk: expected a user who may mount a disk for it (root)")
    with injected.full(chain.parts.disk):
        injected.kill(process)
        yield


FAULTS = {
    "none": Fault(plain, lambda chain, process: nullcontext(), 5.0, (ALL,), quick=True),
    "kill": Fault(plain, _kill, quick=True),
    "freeze": Fault(plain, _on(injected.frozen), 3.0, quick=True),
    "memory": Fault(plain, _memory, quick=True),
    "crash loop": Fault(plain, _crash_loop, 5.0),
    "slow": Fault(plain, _on(injected.slowed), 5.0),
    **{
        f"storm of {topic.name}": Fault(plain, partial(_storm, topic), 5.0, (ALL,))
        for topic in topics.TOPICS
        if topic is not topics.TRUTH  # nobody reads it
    },
    "router": Fault(breakable, _router, 0.0, (ALL,), quick=True),
    "cut 5 s": Fault(breakable, _cut, 5.0),
    "cut 30 s": Fault(breakable, _cut, 30.0),
    "clock +1 h": Fault(breakable, partial(_all_clocks, HOUR_S), 0.0, (ALL,), quick=True),
    "clock -1 h": Fault(breakable, partial(_all_clocks, -HOUR_S), 0.0, (ALL,), quick=True),
    "own clock +1 h": Fault(breakable, partial(_own_clock, HOUR_S), 3.0),
    "own clock -1 h": Fault(breakable, partial(_own_clock, -HOUR_S), 3.0),
    "full disk": Fault(breakable, _kill_on_full_disk, 5.0),
}


@dataclass(frozen=True)
class Row:
    """One fault of one service, and how long it lasted; otherwise as `observed.Numbers`."""

    fault: str
    service: str
    replicas: int
    lasts_s: float
    gap_ms: float
    recovery_s: float | None
    reused: int
    false_tracking: int
    tracking: int
    worst_cm: float


def steady_hz(outside: observed.Outside) -> dict[str, float] | None:
    """The rates [Hz] of all topics over BEFORE_S, None while one of them is not steady, or silent."""
    outside.forget()
    times = [time.monotonic()]
    for _ in range(2):
        time.sleep(0.5 * BEFORE_S)
        times.append(time.monotonic())
    first, second = (observed.rates_hz(outside, begin_s, end_s) for begin_s, end_s in itertools.pairwise(times))
    if any(abs(second[name] - hz) > STEADY * max(second[name], hz) or not hz for name, hz in first.items()):
        return None
    return {name: 0.5 * (hz + second[name]) for name, hz in first.items()}


def measure(chain: Chain, name: str, service: str) -> Row:
    """Injects a fault once, and watches the chain until the old rate is back."""
    fault = FAULTS[name]
    wait_for(lambda: chain.is_settled(service), READY_S, "a chain that tracks the arm", 0.3)
    old_hz = wait_for(lambda: steady_hz(chain.outside), READY_S, "steady rates of all topics", 0.0)
    process = None if service == ALL else chain.owner(service)
    taken = observed.opened(chain.running, chain.outside)
    fault_s = time.monotonic()
    with fault.strike(chain, process):
        time.sleep(fault.lasts_s)
    over_s = time.monotonic()
    while True:
        time.sleep(AFTER_S)
        taken_after = observed.closed(chain.running, chain.outside)
        reused = observed.reused(chain.outside, taken, taken_after)
        now_s = time.monotonic()
        found = observed.numbers(chain.outside, service, old_hz, fault_s, now_s, reused)
        if found.recovery_s is not None or now_s - over_s > LONGEST_S:
            return Row(name, service, chain.replicas, fault.lasts_s, **asdict(found))


def possible(cell: cells.Cell) -> list[str]:
    """The faults that are possible in a cell: no storm of joint angles without a robot."""
    return [name for name in FAULTS if cell.robots or name != f"storm of {topics.JOINTS.name}"]


def plan(faults: Sequence[str], services: Sequence[str], replicas: Sequence[int]) -> list[tuple[str, int, list[tuple[str, str]]]]:
    """The setups to start, with their numbers of replicas, and the faults and services to go through in each."""
    out: dict[tuple[str, int], list[tuple[str, str]]] = {}
    for number in replicas:
        for name in faults:
            for service in FAULTS[name].services:
                able = service in REPLICATED or (number == 1 and service in (*services, ALL))
                if able and (service == ALL or service in services):
                    out.setdefault((FAULTS[name].setup.__name__, number), []).append((name, service))
    return [(setup, number, rows) for (setup, number), rows in out.items()]


def run(options: flags.Options, done: Callable[[Row], None]) -> None:
    """Runs the plan, and passes every row to `done`."""
    if options.service and not set(options.service) & set(SERVICES):
        return
    able = possible(cells.load(options.cell))
    if options.fault and not set(options.fault) & set(FAULTS):
        return
    chosen = [name for name in options.fault if name in FAULTS] or [
        name for name in able if FAULTS[name].quick or not options.quick
    ]
    for name in set(chosen) - set(able):
        raise SystemExit(f"--fault {name!r}: expected a cell with a robot, such as --cell arm; {options.cell} has none")
    replicas = options.replicas or ([1] if options.quick else [1, 2])
    setups = {each.__name__: each for each in (plain, breakable)}
    groups = plan(chosen, options.service or SERVICES, replicas)
    for setup, number, rows in groups:
        with ExitStack() as stack:
            chain = stack.enter_context(setups[setup](options.cell, options.seed, number))
            names = (chain.cell.one("targets", None), next(iter(chain.cell.pads)))
            wait_for(chain.is_settled, READY_S, "a chain that tracks the arm", 0.3)
            chain.outside = stack.enter_context(observed.Outside(chain.running.session, options.cell, *names))
            scheduling.go_first(with_children=False)  # or gaps contain this process's own waiting
            for name, service in track(rows, f"{setup}, {number} of each", console=Console(stderr=True)):
                done(measure(chain, name, service))


def connected_plan(options: flags.Options) -> dict[str, list[str]]:
    """The faults to run for each service that connects the cell, without services that cannot be tested here."""
    out = {}
    for service, faults in connected.SERVICES.items():
        able = [name for name in faults if name in (options.fault or faults)]
        if not able or service not in (options.service or connected.SERVICES) or 1 not in (options.replicas or [1]):
            continue
        if why := connected.lacks(service):
            Console(stderr=True).print(f"[yellow]note[/] {service} is left out: {why}")
        else:
            out[service] = able
    return out


def is_back(row: Row) -> bool:
    """Whether the service was back in time. One without replicas can be back only after the fault."""
    goal_s = GOAL_REPLICA_S if row.replicas > 1 else row.lasts_s + GOAL_ALONE_S
    return row.recovery_s is not None and row.recovery_s <= goal_s


def tables(result: Result) -> list[Part]:
    """The chain's services, then those that connect it, where any were struck."""
    return [
        *([_chain_table(result)] if result["rows"] else ()),
        *([connected.table(result)] if result.get("connected") else ()),
    ]


def _chain_table(result: Result) -> Table:
    """A row for each fault and number of replicas: recovery by struck service, and the worst values over the services."""
    table = Table(
        *("fault", "of each", "lasts s", *(f"{service}\nback s" for service in (*SERVICES, ALL))),
        *("gap ms, fusion\nnot struck / struck", "reused", "false tracking\nof poses", "worst cm"),
        title=f"Faults, seed {result['seed']}",
        caption=f"Goals: gap <= {GOAL_GAP_MS:g} ms; back within {GOAL_ALONE_S:g} s of the fault's end, with a replica within "
        f"{GOAL_REPLICA_S:g} s of its beginning; none reused, none falsely tracking. Gaps are the largest of all services, "
        "counts the sums.",
    )
    rows = [Row(**each) for each in result["rows"]]
    for (fault, replicas), found in itertools.groupby(
        sorted(rows, key=lambda row: (row.replicas, list(FAULTS).index(row.fault))), key=lambda row: (row.fault, row.replicas)
    ):
        own = {row.service: row for row in found}
        reused, false = (sum(getattr(row, name) for row in own.values()) for name in ("reused", "false_tracking"))
        table.add_row(
            *(fault, str(replicas), f"{next(iter(own.values())).lasts_s:g}"),
            *(_back(own.get(service)) for service in (*SERVICES, ALL)),
            " / ".join(
                _gap([row for row in own.values() if (row.service == "fusion") == is_struck]) for is_struck in (False, True)
            ),
            marked(str(reused), reused == 0),
            f"{marked(str(false), false == 0)} of {sum(row.tracking for row in own.values())}",
            f"{max(row.worst_cm for row in own.values()):.1f}",
        )
    return table


def _back(row: Row | None) -> str:
    if row is None:
        return "-"
    return marked("never" if row.recovery_s is None else f"{row.recovery_s:.2f}", is_back(row))


def _gap(rows: Sequence[Row]) -> str:
    longest_ms = max((row.gap_ms for row in rows), default=None)
    return "-" if longest_ms is None else marked(f"{longest_ms:.0f}", longest_ms <= GOAL_GAP_MS)


@results.benchmark(
    "faults",
    __doc__ or "",
    tables,
    flags.Option("--cell", default="table", help="built-in cell or YAML file"),
    flags.Option("--seed", type=int, default=1, help="draws motion and appearance"),
    flags.Option("--quick", is_flag=True, help="the faults that show most, without replicas"),
    flags.Option(
        "--fault",
        choices=tuple(dict.fromkeys((*FAULTS, *connected.FAULTS))),
        multiple=True,
        help="this fault only; may be repeated",
    ),
    flags.Option(
        "--service", choices=(*SERVICES, *connected.SERVICES), multiple=True, help="strike this service only; may be repeated"
    ),
    flags.Option("--replicas", type=int, choices=(1, 2), multiple=True, help="so many of each service; may be repeated"),
    example="penumbra bench faults --quick --json faults.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    found: dict[str, list[dict[str, Any]]] = {"rows": [], "connected": []}

    def done(row: Row | connected.Row) -> None:
        found["rows" if isinstance(row, Row) else "connected"].append(asdict(row))
        report.save({"seed": options.seed, **found})

    run(options, done)
    connected.run(options.cell, options.seed, connected_plan(options), done)


if __name__ == "__main__":
    sys.exit(main())
