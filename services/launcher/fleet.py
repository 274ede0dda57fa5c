"""The processes of a launcher by service, and changes while they run: rolling restarts, and numbers of replicas.

A change is a generator that the launcher's main thread advances step by step, because a process ends with the thread that started
it. A change is requested on the bus, and polled until it is done.
"""

from __future__ import annotations

import json
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from penumbra.services.launcher.forkserver import ForkServer
from penumbra.services.launcher.supervised import Supervised, stop, wait

READY_S = 120.0
"""Maximum time [s] that a change waits for a process that it started: a first start compiles."""
MOST = 64
"""Maximum number of replicas of a service on one machine."""
REMEMBERED = 16
"""Number of changes whose state can still be queried."""


class ChangeFailed(RuntimeError):
    """A change stops before its end; the text says why."""


@dataclass(frozen=True)
class Kind:
    """How a service's processes are started. beside: whether two may run at once, so that a new one can take over from an old
    one; is_required: whether the other processes need it."""

    command: list[str]
    restart: str = "always"
    environment: dict[str, str] = field(default_factory=dict)
    beside: bool = True
    is_required: bool = False

    def check(self, service: str, number: int) -> None:
        """Raise ValueError for an impossible number of replicas."""
        if self.is_required and number != 1:
            raise ValueError(f"{service}: expected 1, got {number}: all other processes meet there")
        most = MOST if self.beside else 1
        if not 0 <= number <= most:
            why = "" if self.beside else ", because only one can run"
            raise ValueError(f"{service}: expected 0 to {most}{why}, got {number}")


@dataclass
class Change:
    """One change: its name, its current step, and its result."""

    what: str
    steps: Iterator[str]
    doing: str = "begins"
    error: str = ""
    is_done: bool = False

    def report(self) -> dict[str, Any]:
        return {"what": self.what, "doing": self.doing, "error": self.error, "done": self.is_done}


class Fleet:
    """The processes of a launcher. kinds: every service that may run; counts: number of processes per service, 0 by default;
    forkserver: source of restarted services while it runs; write: receives a service and a line of its standard error, which goes
    to the launcher's own by default."""

    def __init__(
        self,
        kinds: Mapping[str, Kind],
        counts: Mapping[str, int],
        forkserver: ForkServer | None = None,
        write: Callable[[str, str], None] | None = None,
    ):
        self._kinds, self._forkserver, self._write = kinds, forkserver, write
        self._groups = {name: [self._make(name) for _ in range(counts.get(name, 0))] for name in kinds}
        self._lock = threading.Lock()
        self._changes: OrderedDict[str, Change] = OrderedDict()
        self._name()

    @property
    def processes(self) -> list[Supervised]:
        """All processes, in the order of the kinds."""
        return [process for group in self._groups.values() for process in tuple(group)]

    def start(self, *services: str) -> list[Supervised]:
        """Start the processes of these services, or without names all that are not started yet; returns them."""
        chosen = [process for name in services or self._groups for process in self._groups[name] if process.state == "stopped"]
        for process in chosen:
            process.start()
        return chosen

    def watch(self) -> None:
        """Supervise every process, and advance the current change by one step. To be called from the thread that started them."""
        for process in self.processes:
            process.watch()
        if self._forkserver is not None:
            self._forkserver.watch(all(process.is_ready or process.popen is None for process in self.processes))
        change = self._under_way()
        if change is None:
            return
        try:
            change.doing = next(change.steps)
        except StopIteration:
            change.is_done = True
        except (ChangeFailed, OSError) as error:
            change.error, change.is_done = str(error), True

    def wait(self, seconds: float) -> None:
        """Wait until a process ends, or for `seconds`."""
        wait(self.processes, seconds)

    def stop(self) -> None:
        """End all processes, the required ones last, so that no other process misses them."""
        if self._forkserver is not None:
            self._forkserver.stop()
        for is_required in (False, True):
            stop([
                process
                for name, group in self._groups.items()
                if self._kinds[name].is_required == is_required
                for process in tuple(group)
            ])  # fmt: skip

    # ---- requests on the bus

    def answer(self, parameters: dict[str, str], payload: bytes) -> bytes:
        """Answer the launcher's queryable with a change's report: `{command: restart, services, id}` (a list, `all`, or null for
        all that can be replaced without a gap), `{command: scale, service, number, id}` or `{command: state, id}`. Raises
        ValueError that says what was expected."""
        try:
            asked = json.loads(payload)
            command, name = asked["command"], str(asked["id"])[:64]
        except (ValueError, TypeError, KeyError):
            raise ValueError(f"expected JSON with command and id, got {payload[:60]!r}") from None
        with self._lock:
            if command == "state":
                if name not in self._changes:
                    raise ValueError(f"expected a change requested from this launcher, got {name}")
            elif command == "restart":
                self._begin(name, self._restart(asked.get("services")))
            elif command == "scale":
                self._begin(name, self._scale(asked.get("service"), asked.get("number")))
            else:
                raise ValueError(f"expected restart, scale or state, got {command!r:.60}")
            return json.dumps(self._changes[name].report()).encode()

    def _under_way(self) -> Change | None:
        return next((change for change in tuple(self._changes.values()) if not change.is_done), None)

    def _begin(self, name: str, change: Change) -> None:
        if (other := self._under_way()) is not None:
            raise ValueError(f"busy: {other.what}, {other.doing}; ask again when that is done")
        self._changes[name] = change
        while len(self._changes) > REMEMBERED:
            self._changes.popitem(last=False)

    def _restart(self, services: Any) -> Change:
        running = [name for name, group in self._groups.items() if group]
        if services is None:
            services = [name for name in running if self._kinds[name].beside]
        elif services == "all":
            services = running
        strangers = [name for name in services if name not in running] if isinstance(services, list) else [services]
        if strangers:
            raise ValueError(f"expected one of {', '.join(running) or 'no service'}, which run here, got {strangers[0]!s:.60}")
        chosen = [name for name in running if name in services]
        return Change(f"restart of {', '.join(chosen) or 'nothing'}", self._one_after_another(chosen))

    def _scale(self, service: Any, number: Any) -> Change:
        if service not in self._kinds or not isinstance(number, int) or isinstance(number, bool):
            raise ValueError(
                f"expected NAME=NUMBER with NAME one of {', '.join(self._kinds)}, got {service!s:.60}={number!s:.60}"
            )
        self._kinds[service].check(service, number)
        return Change(f"scale {service} to {number}", self._to_number(service, number))

    # ---- changes, step by step

    def _one_after_another(self, services: list[str]) -> Iterator[str]:
        for service in services:
            for old in tuple(self._groups[service]):
                yield from self._replace(service, old)
        if self._forkserver is not None:
            self._forkserver.renew()  # restarted services may have been installed anew

    def _replace(self, service: str, old: Supervised) -> Iterator[str]:
        if self._kinds[service].beside:  # the old one serves until the new one is ready
            new = yield from self._add(service, is_afresh=True)
            yield from self._remove(service, old)
        else:
            yield from self._end(old)
            new = self._make(service)
            group = self._groups[service]
            group[group.index(old)] = new
            self._name()
            new.start(is_afresh=True)
            yield from self._until_ready(new)
        new.restarts += old.restarts

    def _to_number(self, service: str, number: int) -> Iterator[str]:
        group = self._groups[service]
        while len(group) < number:
            yield from self._add(service)
        while len(group) > number:
            yield from self._remove(service, group[-1])

    def _add(self, service: str, is_afresh: bool = False) -> Generator[str, None, Supervised]:
        new = self._make(service)
        self._groups[service].append(new)
        self._name()
        new.start(is_afresh)
        try:
            yield from self._until_ready(new)
        except ChangeFailed:
            yield from self._remove(service, new)
            raise
        return new

    def _remove(self, service: str, old: Supervised) -> Iterator[str]:
        yield from self._end(old)
        self._groups[service].remove(old)
        self._name()

    def _end(self, old: Supervised) -> Iterator[str]:
        old.end()
        while old.state != "stopped":
            yield f"waiting for {old.name} ({old.pid}) to end"

    def _until_ready(self, new: Supervised) -> Iterator[str]:
        deadline = time.monotonic() + READY_S
        while not new.is_ready:
            if new.restarts or new.state in ("waiting", "failed"):
                raise ChangeFailed(f"{new.name} did not start: {new.note}")
            if time.monotonic() > deadline:
                raise ChangeFailed(f"{new.name} did not answer within {READY_S:.0f} s")
            yield f"waiting for {new.name} ({new.pid}) to serve"

    def _make(self, service: str) -> Supervised:
        kind = self._kinds[service]
        write = partial(self._write, service) if self._write else None
        return Supervised(service, kind.command, kind.restart, kind.environment, self._forkserver, write)

    def _name(self) -> None:
        """A single process is named like its service; several are numbered."""
        for service, group in self._groups.items():
            for number, process in enumerate(tuple(group), 1):
                process.name = service if len(group) == 1 else f"{service} {number}"
