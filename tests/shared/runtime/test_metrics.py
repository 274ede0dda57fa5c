"""The page of metrics against the health that it is made of."""

import signal
import subprocess
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.report import Report
from penumbra.shared.runtime import bus, metrics
from penumbra.shared.runtime.node import Node
from penumbra.tests.support.live import PATIENCE_S, free_port, penumbra_command, wait_for
from penumbra.tests.support.nodes import pose

CELL = cells.load("table")
FUSED = topics.FUSED.at(cell="table", target="forearm")


def page(port):
    """The samples of a page: name and labels to value; None where there is no page."""
    try:
        text = urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5).read().decode()
    except OSError:
        return None
    return [sample for family in text_string_to_metric_families(text) for sample in family.samples]


def value(samples, name, **labels):
    """Of the one sample with these labels; None where there is none."""
    found = [each.value for each in samples or () if each.name == name and labels.items() <= each.labels.items()]
    assert len(found) < 2, f"{name} {labels} is not one sample"
    return found[0] if found else None


@pytest.fixture
def served():
    """Serves reports on a port of its own."""
    servers = []

    def make(reports):
        port = free_port()
        servers.append(metrics.serve("127.0.0.1", port, reports))
        return port

    yield make
    for server in servers:
        server.shutdown()
        server.server_close()


def test_the_page_says_what_the_health_says(served):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Node("router", CELL, bus.Connection("router", listen=(endpoint,))) as node:

        def fail(message, names):
            raise ZeroDivisionError

        node.subscribe(topics.FUSED, fail)
        port = served(lambda: [node.report()])
        node.publish(topics.FUSED, pose(), target="forearm")
        assert node.session is not None
        for payload in (b"\xc1", b"\xc1\xc1"):
            node.session.put(FUSED, payload)
        wait_for(lambda: (r := node.health())["topics"][FUSED]["bad"].get("msgpack") == 2 and r["faults"], 5, "the messages")
        samples, report = page(port), node.health()
    who = {"cell": "table", "service": "router", "instance": node.instance}
    at = {**who, "topic": "fused", "key": FUSED}
    traffic = report["topics"][FUSED]
    assert value(samples, "penumbra_received_messages_total", **at) == traffic["count"] == 1
    assert value(samples, "penumbra_published_messages_total", **at) == 1
    for kind, count in traffic["bad"].items():
        assert value(samples, "penumbra_refused_messages_total", **at, kind=kind) == count
    ((kind, count),) = report["faults"].items()
    assert value(samples, "penumbra_faults_total", **who, kind=kind) == count == 1
    assert value(samples, "penumbra_status", **who, status="degraded") == 1
    assert value(samples, "penumbra_status", **who, status="ok") == 0
    assert value(samples, "penumbra_received_age_seconds", **at) <= traffic["age_s"]
    assert value(samples, "penumbra_memory_bytes", **who) == pytest.approx(1e6 * report["memory_mb"], rel=0.2)
    assert value(samples, "penumbra_uptime_seconds", **who) <= report["uptime_s"]


def report(service, instance, **told):
    return Report(
        service, instance, "ok", cell="table", host="here", uptime_s=1.0, cpu=0.5, memory_mb=10.0, replicas=1, report=told
    )


def test_one_page_covers_many_processes_with_their_restarts_and_the_state_of_the_pose(served):
    launcher = report("launcher", "a", processes={"fusion": {"state": "running", "is_running": True, "restarts": 3, "note": ""}})
    fusion = report("fusion", "b", forearm={"state": "coasting", "vision": {"used": 3}})
    samples = page(served(lambda: [launcher, fusion]))
    assert value(samples, "penumbra_restarts_total", service="launcher", process="fusion") == 3
    assert value(samples, "penumbra_running", process="fusion") == 1
    expected = {"tracking": 0, "coasting": 1, "lost": 0}
    assert {state: value(samples, "penumbra_fused_state", target="forearm", state=state) for state in expected} == expected
    assert {value(samples, "penumbra_cpu_cores", service=service) for service in ("launcher", "fusion")} == {0.5}


def started(*argv):
    return subprocess.Popen(penumbra_command(*argv), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def test_a_service_serves_its_own_page_until_it_ends_and_ends_in_time():
    port, router = free_port(), free_port()
    process = started("router", "--listen", f"tcp/127.0.0.1:{router}", "--metrics-port", str(port))
    try:
        wait_for(lambda: value(page(port), "penumbra_status", service="router", status="ok") == 1, 20, "the page", 0.2)
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
        assert page(port) is None
    finally:
        process.kill()
        process.communicate()


def test_the_launchers_page_covers_the_processes_that_answer_it():
    port, router = free_port(), free_port()
    nothing = [
        word
        for name in ("emulator", "segmentation", "search", "haptics", "fusion", "dashboard")
        for word in ("--replicas", f"{name}=0")
    ]
    process = started("up", "--port", str(router), "--metrics-port", str(port), *nothing)
    try:
        with Node("helper", CELL, bus.Connection(connect=(f"tcp/127.0.0.1:{router}",))).open(20) as helper:
            covers = lambda: value(page(port), "penumbra_status", instance=helper.instance, status="ok") == 1  # noqa: E731
            wait_for(covers, 20, "another process on the launcher's page", 0.2)
            assert value(page(port), "penumbra_status", service="launcher", status="ok") == 1
        wait_for(lambda: value(page(port), "penumbra_uptime_seconds", service="helper") is None, 10, "its end", 0.2)
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)


@pytest.mark.parametrize("text", ["0", "70000", "here", "0.0.0.0:", "-1"])
def test_a_port_that_is_none_is_refused_in_one_line(text):
    process = started("router", f"--metrics-port={text}")
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert f"--metrics-port: expected a port from 1 to 65535, or ADDRESS:PORT as in 0.0.0.0:9464, got {text!r}" in err


@pytest.mark.parametrize("service", ["router", "up"])
def test_a_port_that_is_taken_is_reported_in_one_line_before_anything_starts(service, served):
    port, endpoint = served(list), f"tcp/127.0.0.1:{free_port()}"
    where = ["--listen", endpoint] if service == "router" else ["--port", endpoint.rpartition(":")[2]]
    process = started(service, *where, "--metrics-port", str(port))
    _, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, len(err.splitlines())) == (2, 1)
    assert f"--metrics-port 127.0.0.1:{port} cannot be opened (Address already in use): give another one" in err
