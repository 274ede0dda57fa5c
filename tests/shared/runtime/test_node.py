"""Nodes as whole processes: replicas, health, logs, and how they end."""

import contextlib
import functools
import itertools
import json
import logging
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import zenoh

from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.runtime import bus, logs
from penumbra.shared.runtime.beats import BEAT_S, MISSED, STEADY, Beats
from penumbra.shared.runtime.hang import Turn
from penumbra.shared.runtime.node import Node
from penumbra.shared.runtime.reader import sender_of
from penumbra.shared.runtime.replicas import Clock, Pace, Replicas, Share
from penumbra.shared.runtime.traffic import RATE_WINDOW_S
from penumbra.tests.support import injected
from penumbra.tests.support.live import PATIENCE_S, free_port, penumbra_command, stays, wait_for
from penumbra.tests.support.nodes import node_command, pose

CELL = cells.load("table")
STREAMS = [f"stream/{k}" for k in range(60)]


@pytest.fixture
def replica(router):
    """Opens replicas of one service in this process."""
    nodes = []

    def make():
        nodes.append(Node("worker", CELL, bus.Connection(connect=router.connection.listen)).open())
        return nodes[-1]

    yield make
    for node in nodes:
        node.close()


@pytest.fixture
def process(router):
    """Starts the small service of penumbra.tests.support.nodes as a process of its own."""
    started = []

    def make(service="worker", *arguments, **environment):
        command = node_command(service, router.connection.listen[0], *arguments)
        started.append(subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, **environment}))
        return started[-1]

    yield make
    for each in started:
        each.kill()
        each.communicate()


def living(node, service="worker"):
    replies = node.session.liveliness().get(topics.alive("table", service), timeout=1.0)
    return {str(reply.ok.key_expr).rpartition("/")[2] for reply in replies if reply.ok}


def health(node, service="worker"):
    return [json.loads(answer) for answer in node.query(topics.health("table", service))]


def owners(nodes):
    """The owner of each stream, once all agree on exactly one; None before."""
    found = [[node for node in nodes if node.owns(stream)] for stream in STREAMS]
    return [each[0] for each in found] if all(len(each) == 1 for each in found) else None


def test_a_replica_that_leaves_takes_nothing_over():
    opened: list[bool] = []

    def read(leaves):
        opened.append(leaves)

    for leaves in (False, True):
        replicas = Replicas("penumbra/table/alive/x/one", "penumbra/table/beat/x/one")
        replicas.wait()
        replicas.share(Share(("stream",), [], functools.partial(read, leaves)))
        if leaves:
            assert replicas.leave() == []
        replicas.withdraw()  # counts who is there: nobody else
    assert opened == [False]


def test_every_stream_has_one_owner_and_only_the_dead_ones_streams_move(replica):
    nodes = [replica() for _ in range(3)]
    before = wait_for(lambda: owners(nodes), 5, "one owner for every stream")
    assert {id(owner) for owner in before} == {id(node) for node in nodes}, "every replica has some of sixty streams"
    nodes[1].close()
    survivors = [nodes[0], nodes[2]]
    after = wait_for(lambda: owners(survivors), 5, "one owner for every stream after a death")
    assert all(new is old for old, new in zip(before, after, strict=True) if old is not nodes[1])


def test_a_replica_that_runs_alone_owns_everything_even_before_it_is_on_the_bus():
    node = Node("worker", CELL)
    assert all(node.owns(stream) for stream in STREAMS)


def test_the_streams_of_a_frozen_process_move_to_the_living_one(replica, process):
    frozen = process()
    node = replica()
    wait_for(lambda: not all(map(node.owns, STREAMS)), 10, "the other process to own some streams")
    frozen.send_signal(signal.SIGSTOP)
    wait_for(lambda: all(map(node.owns, STREAMS)), 3, "its streams")
    frozen.send_signal(signal.SIGCONT)
    wait_for(lambda: not all(map(node.owns, STREAMS)), 5, "it to own some again after it thawed")


def test_a_replica_whose_beats_are_missed_owns_nothing_though_its_token_is_there(replica, monkeypatch):
    judge: Callable[..., frozenset[str]] = Beats.judge
    heard: set[str] = set()

    def noted(beats: Beats, others: Collection[str], names: Collection[str], now_s: float) -> frozenset[str]:
        heard.update(names)
        return judge(beats, others, names, now_s)

    monkeypatch.setattr(Beats, "judge", noted)
    node, silent = replica(), replica()
    before = wait_for(lambda: owners([node, silent]), 5, "one owner for every stream")
    wait_for(lambda: heard == {node.instance, silent.instance}, 5, "each to hear the other one")
    with monkeypatch.context() as frozen:
        frozen.setattr(silent.replicas, "others", frozenset())  # it beats for nobody
        wait_for(lambda: all(map(node.owns, STREAMS)), 10, "its streams")
        assert silent.instance in wait_for(lambda: living(node), 5, "an answer to the query for tokens")
    wait_for(lambda: owners([node, silent]) == before, 10, "each to have its own again")


def test_a_replica_counts_as_frozen_from_a_row_of_missed_beats_until_it_has_beaten_for_a_while() -> None:
    beats = Beats("own")
    now_s = itertools.count()  # in periods of beats
    judge = lambda heard: beats.judge(("other", "old"), heard, BEAT_S * next(now_s))  # noqa: E731
    assert judge([]) == frozenset(), "one that has never beaten is not missed"
    assert judge(["other"]) == frozenset()
    assert [judge([]) for _ in range(MISSED)] == [frozenset()] * (MISSED - 1) + [{"other"}]
    assert [judge(["other"]) for _ in range(STEADY)] == [{"other"}] * (STEADY - 1) + [frozenset()]
    assert all(judge(["other"] if k % MISSED else []) == frozenset() for k in range(3 * MISSED)), "a beat now and then is late"


def test_a_replica_that_has_stood_still_knows_that_the_others_have_taken_over() -> None:
    beats = Beats("own")
    for k in range(3):
        assert beats.judge(("other",), ["other"], BEAT_S * k) == frozenset()
    later_s = BEAT_S * (2 + MISSED + 1)
    assert beats.judge(("other",), [], later_s) == {"own"}, "it has missed one beat of the other, and the other many of its"
    for k in range(1, STEADY):
        assert beats.judge(("other",), ["other"], later_s + BEAT_S * k) == {"own"}
    assert beats.judge(("other",), ["other"], later_s + BEAT_S * STEADY) == frozenset()


def test_a_replica_receives_only_the_messages_of_its_own_streams(router, replica, process):
    process("camera")
    nodes = [replica() for _ in range(2)]
    key = topics.FRAME.at(cell="table", camera="front")
    heard: dict[str, list[Any]] = {node.instance: [] for node in nodes}
    for node in nodes:
        stream = next(s for s in STREAMS)
        node.subscribe(topics.FRAME, lambda m, n, node=node: heard[node.instance].append(m.stamp_ns), [stream], camera="front")
    owner = wait_for(lambda: owners(nodes), 5, "one owner")[0]
    (other,) = (node for node in nodes if node is not owner)
    wait_for(lambda: len(heard[owner.instance]) > 10, 10, "frames at the owner")
    del heard[other.instance][:]
    wait_for(lambda: len(heard[owner.instance]) > 30, 10, "more frames at the owner")
    assert not heard[other.instance]
    assert key not in other.health()["stale"], "what another replica reads is not missed here"
    owner.close()
    wait_for(lambda: heard[other.instance], 5, "frames at the other one, which owns the stream now")
    third = replica()
    third.subscribe(topics.FRAME, lambda m, n: heard.setdefault(third.instance, []).append(m.stamp_ns), STREAMS, camera="front")
    wait_for(lambda: heard.get(third.instance), 10, "frames at a replica that has come")


def test_the_next_in_rank_is_the_one_that_takes_over(replica):
    nodes = [replica() for _ in range(3)]
    wait_for(lambda: owners(nodes), 5, "one owner for every stream")
    for stream in STREAMS[:8]:
        assert sorted(node.rank(stream) for node in nodes) == [0, 1, 2]
    (owner,), (second,) = ([node for node in nodes if node.rank(STREAMS[0]) == rank] for rank in (0, 1))
    owner.close()
    wait_for(lambda: second.owns(STREAMS[0]), 5, "the second to own it")


def test_health_of_all_instances_is_one_wildcard_query(router, process):
    process("worker"), process("helper")
    wait_for(lambda: len(living(router, "*")) >= 3, 10, "both processes")
    found = {report["service"]: report for report in map(json.loads, router.query(topics.health("table")))}
    assert found.keys() == {"router", "worker", "helper"}
    published = wait_for(lambda: health(router)[0]["published"], 5, "a published topic")
    assert published.keys() == {"penumbra/table/target/forearm/pose/fused"}
    key = "penumbra/table/camera/front/frame"
    assert found["worker"]["topics"][key]["count"] == 0
    assert found["worker"]["stale"] == [key], "a topic that was never received is stale"


def test_health_reports_rate_age_cpu_and_memory_of_a_steady_publisher(router, process):
    key = topics.FUSED.at(cell="table", target="forearm")
    sent = router.session.declare_subscriber(key, zenoh.handlers.FifoChannel(100_000))
    reader = Node("reader", CELL, bus.Connection(connect=router.connection.listen))
    taken: list[tuple[float, int]] = []
    reader.subscribe(topics.FUSED, lambda message, names: taken.append((time.monotonic(), message.stamp_ns)))
    row = lambda: reader.health()["topics"][key]  # noqa: E731
    with reader:
        worker = process()
        wait_for(lambda: len(taken) > 250, 20, "250 poses")

        def rate_is_reported():
            reported_hz, now_s = row()["rate_hz"], time.monotonic()
            return reported_hz == pytest.approx(sum(at_s > now_s - RATE_WINDOW_S for at_s, _ in taken) / RATE_WINDOW_S, rel=0.3)

        wait_for(rate_is_reported, 20, "the rate at which poses arrive")
        wait_for(lambda: not row()["stale"], 5, "a fresh pose")
        assert 0.0 <= row()["delay_s"] < topics.FUSED.oldest_s
        (report,) = health(router)
        assert report["pid"] == worker.pid
        assert 0 < report["cpu"] < 1
        assert 20 < report["memory_mb"] < 500
        worker.kill()
        wait_for(lambda: row()["stale"], 2, "the topic to be stale after its publisher died")

        numbers: dict[int, Any] = {}
        while (sample := sent.try_recv()) is not None:
            numbers[messages.decode(messages.FusedPose, sample.payload.to_bytes()).stamp_ns] = sender_of(sample)[1]

        def is_all_counted():  # a reader that a busy machine holds up for longer than its ring lasts, 40 ms, drops some
            (_, first), (_, last), now = taken[0], taken[-1], row()
            return now["count"] == len(taken) and now["count"] + now["dropped"] == numbers[last] - numbers[first] + 1

        wait_for(is_all_counted, 5, "every pose to be taken or counted as dropped")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_process_with_exit_code_zero(router, process, number):
    worker = process()
    wait_for(lambda: living(router), 10, "the process")
    worker.send_signal(number)
    assert worker.wait(PATIENCE_S) == 0, "by itself: it is not killed"
    assert not living(router)


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="looks into /proc")
def test_processes_that_end_leave_nothing_in_shared_memory():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    nodes = [node_command(name, endpoint) for name in ("worker", "camera")]
    commands = [penumbra_command("router", "--listen", endpoint), *nodes]
    processes = [subprocess.Popen(command, stderr=subprocess.DEVNULL) for command in commands]
    try:
        segments = wait_for(lambda: segments_of(processes[2]), 30, "frames in shared memory")
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait(PATIENCE_S)
    assert not [segment for segment in segments if segment.exists()]


def segments_of(process):
    maps = Path(f"/proc/{process.pid}/maps").read_text().split()
    found = {Path(word) for word in maps if word.startswith("/dev/shm/") and word.endswith(".zenoh")}
    with contextlib.suppress(FileNotFoundError):  # another process, that has ended since
        return found if any(segment.stat().st_size > 640 * 480 * 3 for segment in found) else None


def test_a_process_that_waits_for_its_router_ends_on_a_signal():
    command = node_command("worker", f"tcp/127.0.0.1:{free_port()}")
    worker = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert worker.stderr is not None
    try:
        assert "waiting for the router" in worker.stderr.readline()
        worker.terminate()
        assert worker.wait(PATIENCE_S) == 0
    finally:
        worker.kill()
        worker.communicate()


def test_a_handler_that_hangs_does_not_keep_the_node_from_closing(router):
    let_go, returned = threading.Event(), threading.Event()

    def hang():
        let_go.wait()
        returned.set()

    node = Node("worker", CELL, bus.Connection(connect=router.connection.listen)).open()
    node.every(0.01, hang)
    node.close()
    assert not returned.is_set(), "it did not wait for the handler"
    let_go.set()


def test_a_timer_keeps_its_rhythm_and_goes_on_after_an_exception(replica):
    calls = []

    def tick():
        calls.append(time.monotonic())
        if len(calls) == 3:
            raise RuntimeError("third")

    node = replica()
    node.every(0.01, tick)
    wait_for(lambda: len(calls) >= 100, 5, "a hundred turns")
    is_regular = lambda: np.median(np.diff(calls[-50:])) == pytest.approx(0.01, rel=0.2)  # noqa: E731
    wait_for(is_regular, 5, "the period between most of the turns")  # a busy machine is late for some
    assert calls[-1] - calls[4] > 0.01 * (len(calls) - 7), "one turn is made up for, and never more"
    assert list(node.health()["faults"].values()) == [1]


def test_turns_that_a_timer_misses_are_not_made_up_for(replica):
    calls = []

    def tick():
        calls.append(time.monotonic())
        if len(calls) == 1:
            wait_for(lambda: time.monotonic() - calls[0] > 0.3, 1, "a long turn")

    replica().every(0.02, tick)
    wait_for(lambda: len(calls) >= 8, 5, "eight turns")
    assert calls[7] - calls[1] > 4 * 0.02, "of six turns one may be made up for, of the fifteen that were missed"


def record(message, *values, **fields):
    out = logging.makeLogRecord(
        {"name": "penumbra.fusion", "levelname": "WARNING", "msg": message, "args": values, "fields": fields}
    )
    out.created = 0.0
    return out


def test_a_log_line_is_a_sentence_and_its_fields():
    text = logs._Text().format(record("lost %d", 3, target="forearm", why="no sense", gain=0.123456789, instance="host-1"))
    assert text == '1970-01-01T00:00:00.000Z warning fusion: lost 3 target=forearm why="no sense" gain=0.123457'


def test_a_json_log_line_is_an_object_with_its_fields_apart():
    line = json.loads(logs._Json().format(record("lost", gain=0.5, instance="host-1")))
    assert line == {
        "time": "1970-01-01T00:00:00.000Z",
        "level": "warning",
        "service": "fusion",
        "instance": "host-1",
        "message": "lost",
        "fields": {"gain": 0.5},
    }


@pytest.mark.parametrize(
    ("flags", "environment"), [(["--log-format", "json"], {}), ([], {"PENUMBRA_LOG_FORMAT": "json"})], ids=["flag", "environment"]
)
def test_a_process_logs_json_when_asked_to(flags, environment):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = node_command("worker", endpoint, *flags)
    worker = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, **environment})
    assert worker.stderr is not None
    try:
        line = json.loads(worker.stderr.readline())
    finally:
        worker.kill()
        worker.communicate()
    assert line.keys() == {"time", "level", "service", "instance", "message", "fields"}
    assert (line["service"], line["level"]) == ("worker", "warning")
    assert endpoint in line["message"]
    assert str(worker.pid) in line["instance"]


SAYS_ALL_SORTS = """
import logging, threading, warnings
from penumbra.shared.runtime import logs
logs.configure("info", "json", "worker")
logging.getLogger("library").warning("of a library")
warnings.warn("of Python")
thread = threading.Thread(target=lambda: {}["of a thread"])
thread.start()
thread.join()
raise RuntimeError("the end")
"""


def test_as_json_everything_that_a_process_says_is_an_object_a_line_also_its_last_output():
    err = subprocess.run([sys.executable, "-c", SAYS_ALL_SORTS], capture_output=True, text=True).stderr
    library, python, thread, end = map(json.loads, err.splitlines())
    assert (library["service"], library["message"]) == ("library", "of a library")
    assert "of Python" in python["message"]
    assert (thread["service"], thread["message"]) == ("worker", "KeyError: 'of a thread'")
    assert end["message"] == "RuntimeError: the end"
    assert end["trace"].startswith("Traceback")
    assert logs.sentence(err.splitlines()[-1]) == "RuntimeError: the end"


@pytest.mark.parametrize("line", ["Killed", "3", "[1]", "{}", '{"note": 1}', "{"])
def test_a_line_that_is_none_of_ours_says_what_it_says(line):
    assert logs.sentence(line) == line


@pytest.mark.parametrize("where", ["timer", "reader"])
def test_a_replica_with_a_hanging_handler_leaves_its_streams_to_the_others_until_it_returns(replica, where):
    hanging, other = nodes = [replica(), replica()]
    before = wait_for(lambda: owners(nodes), 5, "one owner for every stream")
    let_go = threading.Event()
    if where == "timer":
        hanging.every(0.01, let_go.wait)
    else:
        hanging.subscribe(topics.FUSED, lambda message, names: let_go.wait())
        other.every(0.05, lambda: other.publish(topics.FUSED, pose(), target="forearm"))
    wait_for(
        lambda: owners(nodes) == [other] * len(STREAMS) and living(other) == {other.instance},
        10,
        "all streams to be the other one's",
    )
    (report,) = [report for report in health(other) if report["instance"] == hanging.instance]
    assert not report["ready"] and report["status"] == "degraded"
    assert any(where in reason and "hangs for" in reason for reason in report["reasons"])
    let_go.set()
    wait_for(lambda: owners(nodes) == before, 10, "the streams to come back")
    assert hanging.health()["hangs"] == ""


def test_a_stream_that_comes_back_waits_for_the_call_that_is_under_way(replica):
    """The handler belongs to one thread at a time, also where its subscription was closed and opened again."""
    node, other = nodes = [replica(), replica()]
    wait_for(lambda: owners(nodes), 5, "one owner for every stream")
    stream = next(stream for stream in STREAMS if node.owns(stream))
    under_way, at_once, let_go = set(), [], threading.Event()

    def handler(message, names):
        under_way.add(threading.get_ident())
        at_once.append(len(under_way))
        let_go.wait(PATIENCE_S)
        under_way.discard(threading.get_ident())

    node.subscribe(topics.FUSED, handler, [stream])
    other.every(0.01, lambda: other.publish(topics.FUSED, pose(), target="forearm"))
    wait_for(lambda: at_once, 10, "a call")
    row = lambda: node.health()["topics"][topics.FUSED.at(cell="table", target="forearm")]  # noqa: E731
    node.replicas.withdraw()
    wait_for(lambda: not node.owns(stream), 10, "the stream to go")
    node.replicas.join(node.session)
    wait_for(lambda: row()["count"] >= 2, 10, "a message for the second reader")
    let_go.set()
    wait_for(lambda: len(at_once) > 20, 10, "more calls")
    assert max(at_once) == 1


def test_a_replica_that_is_slow_but_alive_leaves_its_streams_to_the_others(replica, process):
    slow = psutil.Process(process().pid)
    other = replica()
    wait_for(lambda: len(living(other)) == 2, 10, "two replicas")
    assert not all(map(other.owns, STREAMS))
    with injected.slowed(slow):
        wait_for(lambda: all(map(other.owns, STREAMS)), 20, "all streams to be the other one's")
        assert stays(lambda: all(map(other.owns, STREAMS)), 1.0), "they stay there while it is slow"
    wait_for(lambda: not all(map(other.owns, STREAMS)), 20, "the streams to come back")


def test_where_no_replica_is_fit_one_keeps_all_streams_until_the_others_are_fit(replica, monkeypatch):
    nodes = [replica() for _ in range(3)]
    before = wait_for(lambda: owners(nodes), 5, "one owner for every stream")
    with monkeypatch.context() as overloaded:
        overloaded.setattr(Pace, "judge", lambda *_: "stalled")
        kept = wait_for(lambda: (found := owners(nodes)) and len(set(map(id, found))) == 1 and found, 10, "a single owner")
        wait_for(lambda: living(nodes[0]) == {kept[0].instance}, 10, "the others to withdraw")
        kept[0].close()
        left = [node for node in nodes if node is not kept[0]]
        wait_for(lambda: len(living(left[0])) == 1 and owners(left), 10, "one of the others to serve")
    wait_for(lambda: (found := owners(left)) and all(new is old for old, new in zip(before, found, strict=True) if old in left),
             10, "the streams to be shared again")  # fmt: skip


@pytest.mark.slow
def test_a_process_whose_watch_itself_hangs_says_so(replica, monkeypatch):
    node, let_go = replica(), threading.Event()
    assert node.health()["hangs"] == ""
    monkeypatch.setattr(Clock, "judge", lambda *_: let_go.wait() and "")
    wait_for(lambda: "the watchdog itself has been blocked" in node.health()["hangs"], 20, "the health to tell")
    let_go.set()
    wait_for(lambda: node.health()["hangs"] == "", 20, "the health to be well again")


def test_a_replica_that_hangs_alone_keeps_its_streams(replica):
    alone, let_go = replica(), threading.Event()
    alone.every(0.01, let_go.wait)
    wait_for(lambda: alone.health()["hangs"], 10, "the hang to be noticed")
    assert all(map(alone.owns, STREAMS))
    let_go.set()


def test_a_replica_whose_clock_is_off_leaves_its_streams_to_the_others_until_it_is_right(replica, router, monkeypatch):
    off, other = nodes = [replica(), replica()]
    ahead_ns = [0]
    monkeypatch.setattr(off, "now_ns", lambda: time.time_ns() + ahead_ns[0])
    before = wait_for(lambda: owners(nodes), 5, "one owner for every stream")
    for node in nodes:
        node.subscribe(topics.FUSED, lambda message, names: None)
    router.every(0.01, lambda: router.publish(topics.FUSED, pose(), target="forearm"))
    ahead_ns[0] = 3600 * 10**9
    wait_for(lambda: owners(nodes) == [other] * len(STREAMS), 10, "all streams to be the other one's")
    assert off.health()["status"] == "degraded"
    assert any("check the clock" in reason for reason in off.health()["reasons"])
    ahead_ns[0] = 0
    wait_for(lambda: owners(nodes) == before, 10, "the streams to come back")
    assert not any("check the clock" in reason for reason in off.health()["reasons"])


def test_a_handler_that_always_takes_long_does_not_hang(replica):
    patient = replica()
    patient.every(0.01, patient.stopping.wait, math.inf)
    slow = Turn("slow", 0.1)
    for _ in range(30):
        with slow:
            time.sleep(0.05)  # no wait: so long a turn is the usual one
    with slow:
        assert slow.hangs_s(time.monotonic() + 0.12) == 0.0, "0.1 s longer than usual"
        wait_for(lambda: slow.hangs_s(time.monotonic()), 10, "a turn that hangs")
    assert slow.hangs_s(time.monotonic() + 100.0) == 0.0
    assert patient.health()["hangs"] == "", "it may take as long as it likes"


def test_a_process_that_runs_out_of_memory_in_a_handler_does_not_go_on_as_if_it_were_the_message(router):
    node = Node("worker", CELL, bus.Connection(connect=router.connection.listen))
    node.fault("reader", ValueError("a bad picture"))
    with pytest.raises(MemoryError):
        node.fault("reader", MemoryError("18 MB"))
    assert sum(node.health()["faults"].values()) == 1


def test_a_log_on_a_full_disk_loses_lines_and_a_closed_one_is_reported():
    with open("/dev/full", "w") as full:
        stream = logs.Lossy(full)
        for _ in range(10_000):
            assert stream.write("a line that does not fit\n") == 25
        stream.flush()
        assert not stream.isatty()
        os.dup2(os.open(os.devnull, os.O_WRONLY), full.fileno())  # room again
    reading, writing = os.pipe()
    os.close(reading)
    with pytest.raises(BrokenPipeError), os.fdopen(writing, "w") as gone:
        stream = logs.Lossy(gone)
        stream.write("nobody reads\n")
        stream.flush()


def test_a_process_whose_thread_fails_ends_and_says_why():
    code = "import threading, time; from penumbra.shared.runtime import logs; logs.configure(ends_with_thread=True); "
    code += "threading.Thread(target=lambda: 1 / 0).start(); time.sleep(60)"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S)
    assert ended.returncode == 1
    assert "ZeroDivisionError" in ended.stderr


def test_a_node_that_ends_while_it_warms_up_says_nothing(router, monkeypatch):
    failed: list[Any] = []
    monkeypatch.setattr(threading, "excepthook", failed.append)
    node = Node("worker", CELL, bus.Connection(connect=router.connection.listen))
    closed = threading.Event()

    def ends_in_its_thread() -> bool:
        if threading.current_thread() is threading.main_thread() or node.session is None:
            return False
        node.stopping.set()
        node.session.close()
        closed.set()
        return True

    node.warm_when(ends_in_its_thread)
    with node:
        assert closed.wait(20)
        wait_for(lambda: not any(thread.name == "warm up" for thread in threading.enumerate()), 20, "the end of the thread")
    assert not failed
