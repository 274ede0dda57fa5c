"""Faults of the services that connect a cell with the outside: recorder, web page, ROS 2, camera, robot.

Each of them is timed where its work arrives: in the recorder's files, in a browser that shows the page, at a ROS node, and on the
bus for frames and joints. Recorder, page and ROS 2 run beside a whole chain, whose pose must go on; camera and robot run alone,
with a real RTSP server and a program that speaks RTDE at the other end.
"""

from __future__ import annotations

import functools
import importlib.util
import itertools
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import zenoh
from rich.console import Console
from rich.progress import track
from rich.table import Table

from penumbra.services.ros2 import convert
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.recording.faults import RecordingError
from penumbra.shared.recording.reading import Recording
from penumbra.shared.runtime import scheduling
from penumbra.tests.bench.lib.results import Result, marked
from penumbra.tests.support import devices, injected, numbered, observed, ros
from penumbra.tests.support.live import Running, free_port, penumbra_up, wait_for

READY_S, LOOK_S = 180.0, 1.0
OLD_S = 15.0
"""Minimum age [s] of a process that is struck: one that dies early counts as in a crash loop, and is restarted after a delay."""
BEFORE_S, SETTLED_S = 3.0, 0.5
"""The old rate is measured for BEFORE_S before the fault, without the last SETTLED_S, of which a recorder may lose a part."""
AFTER_S, LONGEST_S = 4.0, 30.0
"""Minimum time [s] for which a service is watched after a fault, and maximum while the old rate is not back."""
FREEZE_S, AWAY_S = 3.0, 5.0
DISK_MB = 900
"""Size [MB] of the recorder's disk, of which the recorder leaves 500 MB free."""
CAMERA_HZ = 20
GOAL_BACK_S, GOAL_LOST_S, GOAL_GAP_MS = 1.5, 0.3, 50.0
"""Goals, as for the chain; docs/recording.md says what a recorder may lose."""
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
WITHOUT_GL = ("--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--disable-3d-apis")
"""Flags of a browser that draws no scene: drawing it would take the processors from the chain."""
NOTE_ARRIVALS = """
window.arrivals = [];
window.WebSocket = class extends WebSocket {
  constructor(...words) {
    super(...words);
    this.addEventListener("message", () => window.arrivals.push(Date.now()));
  }
};
"""
"""Script that notes arrivals of messages in the page itself, since the browser's driver reports them late."""


@dataclass(frozen=True)
class Row:
    """One fault of one service. back_s: from its beginning until the old rate is back, None where it never was; missing_s: the
    longest time without an arrival; before_s: how much of that was before the fault, in the recorder's files; gap_ms: the
    longest time without a fused pose of the chain beside it, None where there is none."""

    service: str
    fault: str
    lasts_s: float
    back_s: float | None
    missing_s: float
    before_s: float | None
    gap_ms: float | None


@dataclass
class Probe:
    """A running service, and the arrival times of its output [s, steady clock]. outside: listens to the chain beside it; device:
    the other end of the service's connection; disk: folder of its files, None where that cannot be filled."""

    running: Running
    times: Callable[[], list[float]]
    outside: observed.Outside | None = None
    device: Any = None
    disk: Path | None = None


# ---- faults


def _process(probe: Probe, service: str) -> psutil.Process:
    (found,) = injected.instances(psutil.Process(probe.running.launcher.pid), service)
    return found


def _kill(probe: Probe, service: str) -> AbstractContextManager[None]:
    return injected.at_once(partial(injected.kill, _process(probe, service)))


def _freeze(probe: Probe, service: str) -> AbstractContextManager[None]:
    return injected.frozen(_process(probe, service))


def _hangs(probe: Probe, service: str) -> AbstractContextManager[None]:
    return injected.frozen(psutil.Process(probe.device.process.pid))


@contextmanager
def _gone(probe: Probe, service: str) -> Iterator[None]:
    probe.device.kill()
    try:
        yield
    finally:
        probe.device.start()


def _full(probe: Probe, service: str) -> AbstractContextManager[None]:
    if probe.disk is None:
        raise PermissionError("full disk: expected a user who may mount a disk for it (root)")
    return injected.full(probe.disk)


Strike = Callable[[Probe, str], AbstractContextManager[None]]
FAULTS: dict[str, tuple[Strike, float]] = {
    "kill": (_kill, 0.0),
    "freeze": (_freeze, FREEZE_S),
    "full disk": (_full, AWAY_S),
    "other end hangs": (_hangs, AWAY_S),
    "other end away": (_gone, AWAY_S),
}
"""By name, what begins and ends the fault, and its duration [s]. The other end is the camera, the controller or the ROS
router."""
SUDDEN = ("kill", "freeze")
"""Faults that a recorder cannot foresee; before a disk is full it ends its file."""
SERVICES: dict[str, tuple[str, ...]] = {
    "record": ("kill", "freeze", "full disk"),
    "dashboard": ("kill", "freeze"),
    "ros2": ("kill", "freeze", "other end away"),
    "camera": ("kill", "freeze", "other end hangs", "other end away"),
    "robot": ("kill", "freeze", "other end hangs", "other end away"),
}
"""The faults of each service."""


def lacks(service: str) -> str:
    """The reason why a service cannot be tested here; empty where it can."""
    modules = {"record": "mcap", "ros2": "rosbags", "robot": "rtde_receive", "dashboard": "playwright"}
    if (module := modules.get(service)) and importlib.util.find_spec(module) is None:
        return f"{module} is not installed"
    if service == "dashboard" and not _browser():
        return f"there is no browser: expected one of {', '.join(CHROMIUM)}"
    return numbered.lacks_gstreamer() if service == "camera" else ""


def _browser() -> str | None:
    return next(filter(None, map(shutil.which, CHROMIUM)), None)


# ---- what arrives


class Arrivals:
    """Arrival times [s, steady clock] of the messages on a key of a session."""

    def __init__(self, session: zenoh.Session, key: str):
        self._times: list[float] = []
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(1024))
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for _ in self._subscriber:
            self._times.append(time.monotonic())

    def __call__(self) -> list[float]:
        return list(self._times)


def recorded(folder: Path) -> list[float]:
    """Arrival times [s, steady clock] of the fused poses in a folder's files; a file without an end is read as far as
    possible."""
    epoch_s = observed.epoch_ns() * 1e-9
    return sorted(at_s - epoch_s for path in folder.glob("*.mcap") for at_s in _poses(path, path.stat().st_size))


@functools.lru_cache(maxsize=64)
def _poses(path: Path, size: int) -> list[float]:
    """Arrival times [s since the epoch] of the fused poses in a file, cached while it has this size."""
    try:
        return [1e-9 * each.received_ns for each in Recording(path).messages([topics.FUSED])]
    except RecordingError:  # nothing of it is written yet
        return []


class RosRouter:
    """A router like rmw_zenohd."""

    def __init__(self) -> None:
        self.port = free_port()
        self.start()

    def start(self) -> None:
        self._session = ros.router(self.port)

    def kill(self) -> None:
        self._session.close()


@contextmanager
def _recorder(beside: Beside) -> Iterator[Probe]:
    yield Probe(beside.running, partial(recorded, beside.folder), outside=beside.outside, disk=beside.disk)


@contextmanager
def _ros(beside: Beside) -> Iterator[Probe]:
    with ros.peer(beside.router.port) as peer:
        pose = Arrivals(peer.session, peer.key(f"/penumbra/{beside.target}/pose", convert.POSE))
        yield Probe(beside.running, pose, outside=beside.outside, device=beside.router)


@contextmanager
def _page(beside: Beside) -> Iterator[Probe]:
    from playwright import sync_api

    epoch_s = observed.epoch_ns() * 1e-9
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=_browser(), args=[*WITHOUT_GL], timeout=1e3 * READY_S)
        page = browser.new_page()
        page.add_init_script(NOTE_ARRIVALS)
        page.goto(f"http://127.0.0.1:{beside.page}/", wait_until="commit", timeout=1e3 * READY_S)
        arrivals = lambda: [1e-3 * at_ms - epoch_s for at_ms in page.evaluate("arrivals")]  # noqa: E731
        yield Probe(beside.running, arrivals, outside=beside.outside)
        browser.close()


@dataclass
class Beside:
    """A chain with recorder, ROS and web page. folder: of the recordings; a disk of its own where this user may mount one."""

    running: Running
    target: str
    outside: observed.Outside
    router: RosRouter
    page: int
    folder: Path
    disk: Path | None


BESIDE: dict[str, Callable[[Beside], AbstractContextManager[Probe]]] = {"record": _recorder, "dashboard": _page, "ros2": _ros}


@contextmanager
def _chain(cell: str, seed: int) -> Iterator[Beside]:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "disk"
        disk: Path | None = folder
        try:
            stack.enter_context(injected.small_disk(folder, DISK_MB))
        except PermissionError:
            disk = None
        router = RosRouter()
        stack.callback(router.kill)
        page = free_port()
        more = ("--record", str(folder), "--ros2", f"tcp/127.0.0.1:{router.port}", "--page", f"127.0.0.1:{page}")
        running = stack.enter_context(penumbra_up(cell, seed, *more, environment={"ROS_DOMAIN_ID": str(ros.DOMAIN)}))
        wait_for(running.is_tracking, READY_S, "a tracked pose", 0.3)
        loaded = cells.load(cell)
        target = loaded.one("targets", None)
        outside = stack.enter_context(observed.Outside(running.session, running.cell, target, next(iter(loaded.pads))))
        scheduling.go_first(with_children=False)  # or gaps contain this process's own waiting
        yield Beside(running, target, outside, router, page, folder, disk)


def _without(*services: str) -> list[str]:
    return [word for name in services for word in ("--replicas", f"{name}=0")]


@contextmanager
def _camera(seed: int) -> Iterator[Probe]:
    with tempfile.TemporaryDirectory() as folder, devices.CameraServer(free_port(), CAMERA_HZ) as server:
        path = numbered.cell(Path(folder), {"url": server.url, "latency": 0.0})
        with penumbra_up(str(path), seed, *_without("segmentation", "search", "fusion", "dashboard")) as running:
            yield Probe(running, Arrivals(running.session, topics.FRAME.at(cell=running.cell)), device=server)


@contextmanager
def _robot(seed: int) -> Iterator[Probe]:
    with tempfile.TemporaryDirectory() as folder, devices.Controller() as controller:
        path = devices.robot_cell(Path(folder), f"ur:{controller.address}")
        with penumbra_up(str(path), seed, *_without("fusion", "dashboard")) as running:
            yield Probe(running, Arrivals(running.session, topics.JOINTS.at(cell=running.cell)), device=controller)


ALONE: dict[str, Callable[[int], AbstractContextManager[Probe]]] = {"camera": _camera, "robot": _robot}


def run(cell: str, seed: int, plan: dict[str, list[str]], done: Callable[[Row], None]) -> None:
    """Injects the planned faults, and passes every row to `done`. Services beside a chain share one chain."""

    def strike(service: str, probe: Probe) -> None:
        for fault in track(plan[service], service, console=Console(stderr=True)):
            done(measure(probe, service, fault))

    if beside := [service for service in plan if service in BESIDE]:
        with _chain(cell, seed) as chain:
            for service in beside:
                with BESIDE[service](chain) as probe:
                    strike(service, probe)
    for service in [service for service in plan if service in ALONE]:
        with ALONE[service](seed) as probe:
            strike(service, probe)


# ---- a row


def measure(probe: Probe, service: str, fault: str) -> Row:
    """Injects a fault once, and watches the service until the old rate is back."""
    strike, lasts_s = FAULTS[fault]
    wait_for(lambda: _is_ready(probe, service), READY_S, f"what {service} does", LOOK_S)
    time.sleep(BEFORE_S)
    with strike(probe, service):
        fault_s = time.monotonic()  # filling a disk takes a while
        time.sleep(lasts_s)
    over_s = time.monotonic()
    while True:
        time.sleep(AFTER_S)
        now_s = time.monotonic()
        times = [at_s for at_s in probe.times() if fault_s - BEFORE_S <= at_s <= now_s]
        before = [at_s for at_s in times if at_s <= fault_s]
        hz = sum(at_s <= fault_s - SETTLED_S for at_s in before) / (BEFORE_S - SETTLED_S)
        back_s = observed.recovery_s(times, hz, fault_s, now_s)
        if back_s is not None or now_s - over_s > LONGEST_S:
            break
    edges = [*before[-1:], *(at_s for at_s in times if at_s > fault_s), now_s]
    return Row(
        service,
        fault,
        lasts_s,
        None if back_s is None else round(back_s, 3),
        round(max(b - a for a, b in itertools.pairwise(edges)), 3),
        round(fault_s - before[-1], 3) if service == "record" and fault in SUDDEN else None,
        None if probe.outside is None else _gap_ms(probe.outside, fault_s, now_s),
    )


def _is_ready(probe: Probe, service: str) -> bool:
    """Whether the service is at least OLD_S old, and had output within the last second."""
    found = injected.instances(psutil.Process(probe.running.launcher.pid), service)
    if len(found) != 1 or time.time() - found[0].create_time() < OLD_S:
        return False
    return any(at_s > time.monotonic() - 1.0 for at_s in probe.times())


def _gap_ms(outside: observed.Outside, fault_s: float, end_s: float) -> float:
    begin_s = fault_s - observed.WINDOW_S
    senses = [(topic, outside.seen(topic, begin_s, end_s)) for topic, _ in observed.SENSES]
    return round(1e3 * observed.gap_s(outside.seen(topics.FUSED, begin_s, end_s), senses, end_s), 1)


def table(result: Result) -> Table:
    """A row for each service and fault."""
    out = Table(
        *(
            "service",
            "fault",
            "lasts s",
            "back s",
            "nothing arrives for s",
            "of it before the fault s",
            "gap ms of the chain's pose",
        ),
        title=f"Services that connect the cell, seed {result['seed']}",
        caption=f"Goals: back within {GOAL_BACK_S:g} s of the fault's end; a recorder loses at most {GOAL_LOST_S:g} s of what "
        f"was before; no gap in the pose above {GOAL_GAP_MS:g} ms.",
    )
    for row in (Row(**each) for each in result["connected"]):
        in_time = row.back_s is not None and row.back_s <= row.lasts_s + GOAL_BACK_S
        out.add_row(
            *(row.service, row.fault, f"{row.lasts_s:g}"),
            marked("never" if row.back_s is None else f"{row.back_s:.2f}", in_time),
            f"{row.missing_s:.2f}",
            "-" if row.before_s is None else marked(f"{row.before_s:.2f}", row.before_s <= GOAL_LOST_S),
            "-" if row.gap_ms is None else marked(f"{row.gap_ms:.0f}", row.gap_ms <= GOAL_GAP_MS),
        )
    return out
