"""Slow links: what a router is told about them, and what then crosses. tests/chain/test_hosts.py has a real one."""

import json
import re
import threading

import numpy as np
import psutil
import pytest
import zenoh

from penumbra.services import flags
from penumbra.services.command import cli
from penumbra.services.router import service
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.shared.runtime.slow_links import BATCH, SEND_BUFFER, SlowLinks
from penumbra.tests.support.live import free_port, wait_for
from penumbra.tests.support.nodes import pose

CELL = cells.load("table")
LOOPBACK = next(name for name, found in psutil.net_if_addrs().items() if any(each.address == "127.0.0.1" for each in found))
BOUND = f"#so_sndbuf={SEND_BUFFER}"


def started(*argv: str) -> Node:
    node = Node("router", CELL, bus.Connection("router", listen=("tcp/0.0.0.0:7447",)))
    service.start(node, flags.parse(service.FLAGS, argv))
    return node


def test_a_router_without_a_slow_link_gets_no_rule():
    assert started().connection.slow is None


def test_a_slow_link_carries_each_stream_as_often_as_the_table_says_or_the_user():
    slow = started(f"--slow={LOOPBACK}", "--slow-hz=fused=2.5", "--slow-hz=frame=0.1").connection.slow
    assert slow is not None and slow.interfaces == (LOOPBACK,)
    rates = dict(slow.rates_hz)
    assert rates.pop("penumbra/table/target/forearm/pose/fused") == 2.5
    assert rates.pop("penumbra/table/camera/front/frame") == 0.1
    assert rates["penumbra/table/skin/p7/voltages"] == 0 and rates["penumbra/table/target/forearm/pose/vision"] == 20


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (["--slow", "wlan77"], r"--slow: expected a network interface of this host \(.*\), got wlan77"),
        (["--slow-hz", "fused=5"], "--slow-hz: expected --slow INTERFACE beside it, got fused=5 alone"),
        (
            ["--slow", LOOPBACK, "--slow-hz", "fused"],
            "--slow-hz: expected TOPIC=HZ, as in fused=20, with TOPIC one of frame, .*, got fused",
        ),
        (["--slow", LOOPBACK, "--slow-hz", "fussed=1"], "--slow-hz: expected TOPIC=HZ, .*, got fussed=1"),
        (["--slow", LOOPBACK, "--slow-hz", "fused=-1"], "--slow-hz: expected TOPIC=HZ, .*, got fused=-1"),
        (["--slow", LOOPBACK, "--slow-hz", "fused=nan"], "--slow-hz: expected TOPIC=HZ, .*, got fused=nan"),
    ],
)
def test_what_cannot_be_is_reported(flags, text, capsys):
    assert cli.main(["router", *flags]) == 2
    assert re.search(text, capsys.readouterr().err)


@pytest.mark.parametrize(
    ("endpoint", "is_listening", "bound"),
    [
        ("tcp/0.0.0.0:7447", True, BOUND),
        ("tcp/[::]:7447", True, BOUND),
        ("tcp/127.0.0.1:7447", True, BOUND),
        ("tcp/192.0.2.1:7447", True, ""),
        ("tls/127.0.0.1:7447#iface=lo", False, BOUND.replace("#", ";")),
        ("tcp/no-such-host.invalid:7447", False, BOUND),
        ("unixsock-stream//tmp/a.socket", True, ""),
    ],
)
def test_only_endpoints_on_the_slow_interface_get_a_small_buffer(endpoint, is_listening, bound):
    assert SlowLinks((LOOPBACK,), {}).bounded([endpoint], is_listening) == (endpoint + bound,)


def test_the_settings_reach_zenoh():
    config = bus.configuration(started(f"--slow={LOOPBACK}").connection)
    assert json.loads(config.get_json("transport/link/tx/batch_size")) == BATCH
    (rule,) = json.loads(config.get_json("downsampling"))
    assert rule["interfaces"] == [LOOPBACK] and rule["flows"] == ["egress"]
    assert json.loads(config.get_json("listen/endpoints")) == ["tcp/0.0.0.0:7447" + BOUND]


def test_what_leaves_by_a_slow_interface_is_thinned_out():
    """Loopback is the slow one here: poses come at the rate asked for, frames do not come."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    key = topics.FUSED.at(cell="table", target="forearm")
    slow = SlowLinks((LOOPBACK,), {key: 10.0, topics.FRAME.at(cell="table", camera="front"): 0.0})
    router = bus.open_session(bus.Connection("router", listen=(endpoint,), slow=slow), threading.Event(), lambda: None, 5.0)
    heard: list[zenoh.Sample] = []
    frame = np.zeros((48, 64, 3), np.uint8)
    client = bus.Connection(connect=(endpoint,))
    with router, Node("fusion", CELL, client) as node, bus.open_session(client, threading.Event(), lambda: None, 5.0) as session:
        session.declare_subscriber("penumbra/**", heard.append)
        node.every(0.01, lambda: node.publish(topics.FUSED, pose(), target="forearm"))
        node.every(0.01, lambda: node.publish(topics.FRAME, messages.Frame(stamp_ns=1, image=frame), camera="front"))
        wait_for(lambda: len(heard) >= 10, 20, "ten poses")
        published = node.health()["published"]
    assert {str(sample.key_expr) for sample in heard} == {key}
    assert published[key]["count"] > 3 * len(heard), "of a hundred a second ten cross"
    assert heard[0].priority == zenoh.Priority.INTERACTIVE_HIGH


def test_poses_go_before_signals_and_signals_before_images():
    order = [getattr(zenoh.Priority, priority.value) for priority in topics.Priority]
    assert order == [zenoh.Priority.INTERACTIVE_HIGH, zenoh.Priority.DATA_HIGH, zenoh.Priority.DATA_LOW]
    assert {topic.name for topic in topics.TOPICS if topic.priority is topics.Priority.POSE} == {"vision", "haptic", "fused"}
    assert {topic.name for topic in topics.TOPICS if topic.priority is topics.Priority.IMAGE} == {"frame", "mask"}
    for topic in topics.TOPICS:
        assert 0 <= topic.slow_hz <= topic.rate_hz
