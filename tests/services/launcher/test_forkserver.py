"""Services that are forked from a process which has imported everything, with real processes."""

import contextlib
import ctypes
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from penumbra.services.launcher import forkserver, supervised
from penumbra.services.launcher.fleet import Fleet, Kind
from penumbra.services.launcher.forkserver import Forked, ForkServer
from penumbra.services.launcher.supervised import Supervised
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.processes import PROCESSES
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support.live import PATIENCE_S, free_port, penumbra_command, wait_for
from penumbra.tests.support.nodes import node_command

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are adopted on Linux only")

CELL = cells.load("table")
TELLS = """
import json, os, sys, time
said = {"name": __name__, "argv": sys.argv[1:], "where": os.environ["WHERE"], "session": os.getsid(0)}
print(json.dumps(said), file=sys.stderr)
time.sleep(600)
"""
FAILS = "import sys; sys.exit('out of luck')"
HAS_A_CHILD = (
    "import subprocess, sys, time\n"
    "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
    "print('up', file=sys.stderr, flush=True); time.sleep(600)"
)
HAS_A_THREAD = "import threading; threading.Thread(target=threading.Event().wait, daemon=True).start()"


@pytest.fixture
def make(tmp_path, monkeypatch):
    """Starts a fork server of modules, some of them given as text, and waits until it is ready."""
    started = []
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), str(Path(__file__).parents[3])]))
    monkeypatch.setattr(supervised, "STABLE_S", 0.0)
    monkeypatch.setattr(forkserver, "CALM_S", 0.0)

    def make(*modules, is_ready=True, **texts):
        for name, text in texts.items():
            (tmp_path / f"{name}.py").write_text(text)
        server = ForkServer((), modules)
        started.append(server)
        server.start()
        if is_ready:
            wait_for(lambda: server.has_modules, 60, "a fork server that has all modules", act=lambda: server.watch(True))
        return server

    yield make
    for server in started:
        server.stop()
    ctypes.CDLL(None).prctl(36, 0, 0, 0, 0)  # no longer adopts


@pytest.fixture
def supervise():
    """A process of `python -m MODULE ...` that is killed and started again."""
    started = []

    def make(server, module, *arguments, **own):
        process = Supervised(module, [sys.executable, "-m", module, *arguments], environment=own, forkserver=server)
        process.start(is_afresh=True)
        started.append(process)
        return process

    yield make
    supervised.stop(started)


def kill(process):
    """Kills it and returns when it runs again."""
    before = process.pid
    os.kill(before, signal.SIGKILL)
    wait_for(lambda: process.watch() or process.pid not in (None, before), 10, "another process")


def said(process):
    return wait_for(lambda: list(process._last_words), 10, "its words")


def arg_start(pid):
    """Where a process has its command line: another place after every exec, and the same after a fork."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[45])


def zombies():
    """Those among this process's descendants, whichever test they are of."""
    found = set()
    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):
            if child.status() == psutil.STATUS_ZOMBIE:
                found.add(child)
    return found


def test_a_forked_service_is_as_one_that_was_started_plainly(make, supervise):
    before = zombies()
    server = make(tells=TELLS)
    process = supervise(server, "tells", "--flag", "value", WHERE="there", OMP_NUM_THREADS="1")
    plain = said(process)
    kill(process)
    assert isinstance(process.popen, Forked)
    assert said(process) == [plain[0].replace(str(plain_session(plain)), str(process.pid))]
    ps = psutil.Process(process.pid)
    assert (ps.ppid(), os.getpgid(process.pid)) == (os.getpid(), process.pid)
    wait_for(lambda: not zombies() - before, 5, "the one in between gone, not a zombie")
    process.end()
    wait_for(lambda: process.watch() or process.state == "stopped", 5, "its end at SIGTERM")


def plain_session(words):
    return int(words[0].rpartition(" ")[2].strip("}"))


def test_a_forked_service_that_fails_is_reported_with_its_last_output(make, supervise):
    server = make(fails=FAILS)
    process = supervise(server, "fails")
    wait_for(lambda: process.watch() or process.restarts, 10, "the first failure")
    assert isinstance(process.popen, Forked)
    wait_for(lambda: process.watch() or process.restarts > 1, 10, "its failure")
    assert process.note == "exit code 1: out of luck"


def test_what_a_forked_service_started_itself_ends_with_it_and_leaves_no_zombie(make, supervise):
    process = supervise(make(parent=HAS_A_CHILD), "parent")
    kill(process)
    assert isinstance(process.popen, Forked)
    said(process)
    (child,) = psutil.Process(process.pid).children()
    kill(process)
    wait_for(lambda: process.watch() or not child.is_running(), 5, "the end of its child")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_without_its_fork_server_a_service_is_started_plainly_and_a_new_one_comes(make, supervise, monkeypatch, number):
    monkeypatch.setattr(forkserver, "AGAIN_S", 0.1)
    server = make(tells=TELLS)
    process = supervise(server, "tells", WHERE="there")
    first = server.pid
    os.kill(first, number)
    kill(process)
    assert isinstance(process.popen, subprocess.Popen)
    assert server.pid is None and not psutil.pid_exists(first), "one that does not answer is ended, with what it would still do"
    said(process)
    wait_for(lambda: server.watch(True) or server.has_modules, 30, "another fork server")
    kill(process)
    assert isinstance(process.popen, Forked)


def test_a_fork_server_with_a_second_thread_is_none(make, supervise, capfd):
    server = make("threads", is_ready=False, threads=HAS_A_THREAD, tells=TELLS)
    first = server.pid
    wait_for(lambda: server.watch(server.pid == first) or server.pid is None, 30, "its end")
    told = "fork server: expected one thread after its imports, got 2: services are started plainly"
    assert told in capfd.readouterr().err
    process = supervise(server, "tells", WHERE="there")
    kill(process)
    assert isinstance(process.popen, subprocess.Popen)


def test_it_imports_the_services_when_nothing_has_been_starting_for_a_while(make, monkeypatch):
    monkeypatch.setattr(forkserver, "CALM_S", 0.5)
    server = make("json", is_ready=False)
    wait_for(lambda: server.is_ready, 60, "a fork server")
    calm: list[tuple[float, bool]] = []

    def watched():
        is_calm, before = len(calm) > 3, time.monotonic()  # the first four times something is starting
        server.watch(is_calm)
        calm.append((time.monotonic() if is_calm else before, is_calm))
        return server.has_modules

    wait_for(watched, 30, "its imports", 0.1)
    assert calm[-1][0] - max(at for at, is_calm in calm if not is_calm) >= 0.5


def test_every_service_can_be_forked(make):
    assert make(*(process.module for process in PROCESSES)).is_ready, "none of their imports starts a thread"


def test_a_module_that_is_not_installed_is_left_to_its_service(make):
    assert make("penumbra.services.nowhere.service", "json").has_modules


def test_a_service_is_back_from_the_fork_server_in_less_than_half_the_time_of_a_plain_start(router, make, supervise):
    server = make("penumbra.tests.support.nodes")
    process = supervise(None, "penumbra.tests.support.nodes", "worker", "--connect", router)
    times = {}
    with Node("test", CELL, bus.Connection(connect=(router,))) as node:
        session = node.session
        assert session is not None
        tokens = lambda: [r.ok for r in session.liveliness().get(topics.alive("table", "worker"), timeout=1.0) if r.ok]  # noqa: E731
        wait_for(lambda: len(tokens()) == 1, 20, "the service")
        for origin in (None, server):
            process._forkserver, taken = origin, []
            for _ in range(3):
                pid = process.pid
                began = time.monotonic()
                kill(process)
                is_back = lambda pid=pid: any(f"-{pid}-" not in str(r.key_expr) for r in tokens())  # noqa: E731
                wait_for(is_back, 20, "the service to be back", 0.005)
                taken.append(time.monotonic() - began)
            times[origin] = min(taken)
    print(f"back after {times[server]:.3f} s, plainly after {times[None]:.3f} s")
    assert times[server] < 0.5 * times[None]


def test_after_a_restart_by_command_services_are_forked_from_what_is_installed_then(router, make):
    server = make("penumbra.tests.support.nodes")
    command = node_command("worker", router)
    fleet = Fleet({"worker": Kind(command)}, {"worker": 1}, server)
    fleet.start()
    try:
        first = server.pid
        fleet.answer({}, b'{"command": "restart", "services": ["worker"], "id": "a"}')

        def step():
            for process in fleet.processes:
                process.heard()
            fleet.watch()
            return b'"done": true' in fleet.answer({}, b'{"command": "state", "id": "a"}')

        wait_for(step, 20, "the restart")
        (process,) = fleet.processes
        assert isinstance(process.popen, subprocess.Popen), "a plain start reads what is installed now"
        wait_for(lambda: step() and server.is_ready and server.pid != first, 30, "another fork server")
    finally:
        fleet.stop()
    assert server.pid is None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_forked_service_and_the_fork_server_end_with_the_launcher(number):
    counts = {process.name: 0 for process in PROCESSES if process.replicas} | {"router": 1, "fusion": 1}
    replicas = [word for name, count in counts.items() for word in ("--replicas", f"{name}={count}")]
    command = penumbra_command("up", "--port", str(free_port()), *replicas)
    up = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        (server,) = wait_for(lambda: children(up.pid, "penumbra fork server"), 60, "the fork server", 0.1)

        (fusion,) = wait_for(lambda: children(up.pid, "penumbra fusion"), 30, "the fusion", 0.1)
        assert arg_start(fusion.pid) == arg_start(server.pid), "already its first process is forked"
        family = psutil.Process(up.pid).children(recursive=True)
        assert len(family) >= 3, "router, fork server and fusion"
        up.send_signal(number)
        gone = lambda: up.poll() is not None and not any(c.is_running() and c.status() != "zombie" for c in family)  # noqa: E731
        wait_for(gone, 10, "the end of all")
    finally:
        up.kill()
        up.wait()


def test_a_fork_server_whose_launcher_is_gone_ends_without_a_word():
    """A socket that is closed with something unread in it, here that the fork server is ready, resets the other end."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    command = [sys.executable, "-m", "penumbra.services.launcher.forkserver", str(theirs.fileno()), "json"]
    server = subprocess.Popen(command, pass_fds=[theirs.fileno()], stderr=subprocess.PIPE, text=True)
    theirs.close()
    wait_for(lambda: select.select([ours], [], [], 0)[0], 30, "the fork server")
    ours.close()
    assert server.communicate(timeout=PATIENCE_S)[1] == ""


def children(pid, word):
    """The children of a process whose command line contains a word."""
    out = []
    for child in psutil.Process(pid).children():
        with contextlib.suppress(psutil.NoSuchProcess):
            out += [child] if word in " ".join(child.cmdline()) else []
    return out


def test_a_death_is_noticed_at_once(supervise, make):
    process = supervise(None, "timeit", "-n", "1", "-r", "1", "import time; time.sleep(600)")
    threading.Timer(0.2, process.signal, (signal.SIGKILL,)).start()
    began = time.monotonic()
    supervised.wait([process], 60.0)
    assert time.monotonic() - began < 30.0, "it did not wait to the end"
