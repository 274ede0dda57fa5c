"""Status and reasons of running processes, from within and from outside."""

import json
import logging
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from rich.console import Console

from penumbra.services.command import cli, doctor
from penumbra.services.launcher import display
from penumbra.services.launcher.supervised import Supervised
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.contract.report import Report
from penumbra.shared.runtime import bus, health, progress, running
from penumbra.shared.runtime.node import Node
from penumbra.shared.runtime.traffic import Traffic
from penumbra.tests.support.live import wait_for
from penumbra.tests.support.nodes import node_command, pose

CELL = cells.load("table")
WAITS = "waiting for camera/front/frame: emulator or camera or ros2 or driver is not there yet"
FUSED = topics.FUSED.at(cell="table", target="forearm")


@pytest.fixture
def client(router):
    """Nodes behind the router, not open yet."""
    nodes = []

    def make(service):
        nodes.append(Node(service, CELL, bus.Connection(connect=router.connection.listen)))
        return nodes[-1]

    yield make
    for node in nodes:
        node.close()


@pytest.fixture
def worker(router):
    """The small service of penumbra.tests.support.nodes as a process; it reads a camera that nobody plays."""
    command = node_command("worker", router.connection.listen[0])
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    wait_for(lambda: [each for each in seen(router) if each.service == "worker"], 20, "the worker")
    yield process
    process.kill()
    process.wait()


def seen(node):
    return running.ask(node.session, "table")


def test_counters_that_grew_lately_are_reported_and_forgotten_after_a_while():
    lately = health.Lately()
    assert lately.look({("a", "past"): 3}, 0.0) == {("a", "past"): 3}
    assert lately.look({("a", "past"): 5, ("", "ValueError"): 1}, 20.0) == {("a", "past"): 5, ("", "ValueError"): 1}
    assert lately.look({("a", "past"): 5, ("", "ValueError"): 1}, health.LATELY_S + 1.0) == {
        ("a", "past"): 2,
        ("", "ValueError"): 1,
    }
    assert lately.look({("a", "past"): 5, ("", "ValueError"): 1}, health.LATELY_S + 21.0) == {}


def test_a_process_with_nothing_to_say_is_ok_and_one_off_the_bus_is_down():
    assert health.judge("", {}, {}, [], 0) == ("ok", [])
    assert health.judge("no router at here", {}, {}, [], 0) == ("down", ["no router at here"])
    report = Node("worker", CELL).health()
    assert (report["status"], report["reasons"]) == ("down", ["not on the bus"])


def test_every_reason_names_what_is_missing_and_since_when():
    never, old, fresh = (Traffic(0.3) for _ in range(3))
    now_ns = 10**12
    old.record(now_ns - 3_210_000_000, now_ns)
    fresh.record(now_ns, now_ns)
    received = {f"penumbra/table/skin/{pad}/voltages": traffic for pad, traffic in zip("abc", (never, old, fresh), strict=True)}
    grown = {("penumbra/table/skin/c/voltages", "past"): 2, ("", "ValueError at x.py:3"): 1}
    assert health.judge("", received, grown, ["fusion: waiting"], now_ns) == (
        "degraded",
        [
            "nothing received on skin/a/voltages yet",
            "no skin/b/voltages for 3.2 s",
            "refused on skin/c/voltages in the last 30 s: 2 past",
            "faults in the last 30 s: 1 ValueError at x.py:3",
            "fusion: waiting",
        ],
    )


def test_two_publishers_of_a_sensors_stream_degrade_its_reader_and_replicas_that_share_one_do_not(client):
    reader, emulator, driver = (client(name) for name in ("haptics", "emulator", "driver"))
    for topic in (topics.VOLTAGES, topics.FUSED):
        reader.subscribe(topic, lambda message, names: None)
    volts = np.ones((1, len(CELL.pad_types[CELL.pads["p0"].type].electrodes)), np.float32)
    told = "several publishers of skin/p0/voltages contradict each other: let only one publish it (of emulator, skin, driver)"

    def publish(*publishers: Node) -> None:
        for node in publishers:
            message = messages.Voltages(stamp_ns=time.time_ns(), period_ns=1_000_000, volts=volts)
            node.publish(topics.VOLTAGES, message, pad="p0")
            node.publish(topics.FUSED, pose(), target="forearm")

    def received() -> int:
        return reader.report().topics[topics.VOLTAGES.at(cell="table", pad="p0")].count

    with reader, emulator, driver:
        wait_for(lambda: received() > 2 * health.MOST_TURNS, 5, "one publisher's messages", act=lambda: publish(emulator))
        assert told not in reader.report().reasons
        wait_for(lambda: told in reader.report().reasons, 5, "the reason", act=lambda: publish(emulator, driver))
        assert "several publishers of target" not in str(reader.report().reasons)


def test_missing_inputs_of_one_kind_are_one_reason():
    now_ns = 10**12
    pads = {f"penumbra/arm/skin/p{k}/voltages": Traffic(0.1) for k in range(8)}
    pads["penumbra/arm/skin/*/voltages"] = Traffic(math.inf)  # counts what is on no pad of the cell
    assert health.judge("", pads, {}, [], now_ns) == ("degraded", ["nothing received on skin/*/voltages (8) yet"])
    for k, traffic in enumerate(list(pads.values())[:8]):
        traffic.record(now_ns - (k + 1) * 100_000_000, now_ns)
    fused = {"penumbra/arm/target/forearm/pose/fused": Traffic(0.1)}
    expected = ["no skin/*/voltages (7 of 8) for 0.8 s", "nothing received on target/forearm/pose/fused yet"]
    assert health.judge("", pads | fused, {}, [], now_ns)[1] == expected


def test_a_process_that_prepares_its_work_or_waits_for_one_that_does_is_starting():
    missing = {"penumbra/arm/target/forearm/pose/haptic": Traffic(0.1, ("haptics",))}
    assert health.judge("", {}, {}, [], 0, "compiling 12 of 40") == ("starting", ["compiling 12 of 40"])
    waits = lambda traffic: f"{traffic.publishers[0]} is compiling 12 of 40"  # noqa: E731
    found = ("starting", ["waiting for target/forearm/pose/haptic: haptics is compiling 12 of 40"])
    assert health.judge("", missing, {}, [], 0, "", waits) == found
    assert health.judge("", missing, {}, ["a fault"], 0, "compiling 1 of 2", waits)[0] == "degraded"


def test_an_input_is_waited_for_while_its_publisher_starts_and_missing_when_it_should_have_come(monkeypatch):
    answers: dict[str, list[Report] | None] = {"haptics": []}
    now_s = [0.0]
    monkeypatch.setattr("penumbra.shared.runtime.progress.time.monotonic", lambda: now_s[0])

    def ask(service):
        if (reports := answers[service]) is None:
            raise bus.Refused("Timeout")
        return [json.dumps(each.as_json()).encode() for each in reports]

    waiting = progress.Waiting(ask)
    traffic = Traffic(0.1, ("haptics",))

    def why(at_s):
        now_s[0] = at_s
        waiting.look([traffic], 0)
        return waiting.why(traffic)

    assert why(1.0) == "haptics is not there yet"
    assert why(progress.ABSENT_S + 1.0) == "", "nobody runs it"
    answers["haptics"] = [Report("haptics", "a", "starting", progress="compiling 12 of 40")]
    assert why(20.0) == "haptics is compiling 12 of 40"
    answers["haptics"] = None
    assert why(25.0) == "haptics is compiling 12 of 40", "it is too busy to answer"
    answers["haptics"] = [Report("haptics", "a", "ok")]
    assert why(30.0) == "haptics has just started"
    assert why(30.0 + progress.SETTLE_S) == "", "it should have been received by now"
    answers["haptics"] = [Report("haptics", "a", "starting")]
    assert why(progress.STARTING_S - 1.0) == "haptics is starting"
    assert why(progress.STARTING_S + 1.0) == "", "nothing takes that long"


def test_progress_shows_in_the_health_before_the_node_is_open_and_is_logged_now_and_then(router, client, caplog):
    node = client("haptics")
    logging.getLogger("penumbra").propagate = True
    with caplog.at_level(logging.INFO, "penumbra"):
        for k in range(12):
            node.progress("compiling", k, 40)
    assert [record.getMessage() for record in caplog.records if "compiling" in record.getMessage()] == ["compiling 0 of 40"]
    (found,) = wait_for(lambda: [each for each in seen(router) if each.service == "haptics"], 10, "the early answer")
    assert (found.status, found.reasons) == ("starting", ("compiling 11 of 40",))
    node.progress("compiling", 40, 40)
    node.open()
    report = node.report()
    assert (report.status, report.progress) == ("ok", "")


def test_a_topic_whose_publisher_has_nothing_to_do_in_a_cell_is_not_missed():
    bare = CELL.model_copy(update={"pads": {}})
    with_pads, without = Node("fusion", CELL), Node("fusion", bare)
    for node in (with_pads, without):
        node.subscribe(topics.HAPTIC, lambda message, names: None)
    assert with_pads.report().stale and not without.report().stale


def test_a_node_reports_stale_inputs_refusals_and_faults_as_they_happen(client):
    reader, writer = client("reader"), client("writer").open()
    reader.subscribe(topics.FUSED, lambda message, names: 1 / 0)
    reader.open()
    assert reader.health()["reasons"] == ["waiting for target/forearm/pose/fused: fusion is not there yet"]

    def reasons_after(send, word):
        send()
        return next((reason for reason in reader.health()["reasons"] if word in reason), None)

    publish = lambda: writer.publish(topics.FUSED, pose(), target="forearm")  # noqa: E731
    assert "ZeroDivisionError at test_health.py" in wait_for(lambda: reasons_after(publish, "faults"), 5, "the fault")
    garble = lambda: writer.session.put(FUSED, b"garbled")  # noqa: E731
    assert "target/forearm/pose/fused" in wait_for(lambda: reasons_after(garble, "refused"), 5, "the refusal")
    wait_for(lambda: reasons_after(lambda: None, "no target/forearm/pose/fused for "), 5, "a stale input")
    assert reader.health()["status"] == "degraded"


def test_a_node_that_lost_its_router_is_down_and_says_where_it_should_be(router, client):
    node = client("worker").open()
    assert node.health()["status"] == "ok"
    router.close()
    report = wait_for(lambda: (r := node.health())["status"] == "down" and r, 6, "the loss")
    assert report["reasons"] == [f"no router at {router.connection.listen[0]}"]


def test_from_outside_every_instance_is_reported_and_one_that_hangs_is_down(router, worker):
    found = {each.service: each for each in seen(router)}
    assert found["router"].status == "ok"
    assert (found["worker"].status, found["worker"].reasons) == ("starting", (WAITS,))

    def seen_while_it_stands_still():
        """None where its lease has ended before it was asked, as on a busy machine: its token is gone then."""
        wait_for(lambda: any(each.service == "worker" and each.status == "starting" for each in seen(router)), 5, "the worker")
        worker.send_signal(signal.SIGSTOP)
        wait_for(lambda: psutil.Process(worker.pid).status() == psutil.STATUS_STOPPED, 5, "it to stop", 0.001)
        found = running.ask(router.session, "table", "worker", 0.2)
        worker.send_signal(signal.SIGCONT)
        return found

    (hung,) = wait_for(seen_while_it_stands_still, 20, "the worker among those that are there")
    assert hung.status == "down"
    assert hung.reasons == ("hangs: no answer within 0.2 s",)


def test_doctor_reports_the_status_of_the_running_processes(router, worker, capsys):
    cli.main(["doctor", "--connect", router.connection.listen[0]])
    (line,) = [line for line in capsys.readouterr().out.splitlines() if " worker " in line]
    assert line.startswith("warn worker ")
    assert line.endswith(f": starting: {WAITS}")


def test_doctor_says_how_to_start_a_cell_whose_router_runs_alone(router):
    (found,) = doctor._processes("arm", bus.Connection(connect=router.connection.listen))
    assert (found.status, found.text, found.mend) == ("warn", "no process of cell arm runs there", "penumbra up --cell arm")


def test_topics_hz_reports_the_status_of_the_processes_but_not_itself(router, worker, capsys):
    assert cli.main(["topics", "--hz", "--seconds", "0.5", "--connect", router.connection.listen[0]]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.strip()]
    services = {row[0]: row[2:] for row in rows[rows.index(["process", "instance", "status", "reasons"]) + 1 :]}
    assert services == {"router": ["ok"], "worker": ["starting", *WAITS.split()]}


def test_the_live_view_shows_what_a_running_process_suffers_from(router, worker):
    watch = display.Watch(router)
    watch.refresh()
    process = Supervised("worker", [])
    process.state, process.popen = "running", worker
    row = process.row(watch.local()[worker.pid])
    assert (row.state, row.note) == ("starting", WAITS)
    console = Console(width=200)
    with console.capture() as drawn:
        console.print(display.Picture("penumbra pose", watch).draw([row], 200, 50))
    assert "starting" in drawn.get() and WAITS in drawn.get()
    assert process.row(Report("worker", "a", "ok")).state == "running"


def test_the_heartbeat_contains_the_status_and_the_health_check_of_the_containers_reads_it(router, client, monkeypatch, tmp_path):
    path = tmp_path / "heartbeat"
    monkeypatch.setenv("PENUMBRA_HEARTBEAT", str(path))
    node = client("worker").open()
    wait_for(path.exists, 5, "the heartbeat")
    assert path.read_text() == "ok\n"
    written = path.stat().st_mtime_ns
    wait_for(lambda: path.stat().st_mtime_ns > written, 5, "the next heartbeat")
    assert checked(path) == (0, "ok")
    node.fault("here", RuntimeError("odd"))
    wait_for(lambda: path.read_text().startswith("degraded: faults in the last 30 s: 1 RuntimeError"), 5, "the fault in words")
    assert checked(path)[0] == 0, "starting it again would not help"
    router.close()
    wait_for(lambda: path.read_text().startswith("down: no router at "), 6, "the loss of the router in words")
    code, said = checked(path)
    assert (code, said.startswith("down: no router at ")) == (1, True)
    node.close()
    path.write_text("ok\n")
    os.utime(path, (time.time() - 6, time.time() - 6))
    assert checked(path)[0] == 1, "a process that hangs writes no more"


def checked(path):
    """Exit code and first line of a container's health check."""
    program = Path(__file__).parents[3] / "docker" / "heartbeat.py"
    environment = {**os.environ, "PENUMBRA_HEARTBEAT": str(path)}
    result = subprocess.run([sys.executable, "-S", program], env=environment, capture_output=True, text=True)
    return result.returncode, result.stdout.partition("\n")[0]
