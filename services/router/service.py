"""Router of a host: a node in router mode forwards messages between local processes and linked routers."""

from __future__ import annotations

import math

import psutil

from penumbra.services import flags
from penumbra.shared.contract import topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.shared.runtime.slow_links import SlowLinks

NAME = "router"
MODE = "router"


LINKS = "Several hosts"
FLAGS = (
    flags.Option(
        "--announce",
        is_flag=True,
        section=LINKS,
        help="answer Zenoh's scouting, so that `penumbra ls` finds this router from other hosts; other Zenoh programs that scout "
        "find it as well",
    ),
    flags.Option(
        "--slow",
        multiple=True,
        metavar="INTERFACE",
        section=LINKS,
        help="traffic through this network interface (such as wlan0) uses a slow link: poses cross it at a reduced rate, in "
        "short queues; frames, masks and voltages do not. May be repeated; the other end needs it too",
    ),
    flags.Option(
        "--slow-hz",
        multiple=True,
        metavar="TOPIC=HZ",
        section=LINKS,
        show_default="as in `penumbra topics`",
        help="rate per stream of a topic on a slow link, 0 for never",
    ),
)
EXAMPLE = """\
penumbra router                                         # of one host
penumbra router --listen tcp/0.0.0.0:7447 --announce    # one of several hosts, and on each of the others:
penumbra router --connect tcp/THAT-HOST:7447            # processes connect to the router of their host"""


def start(node: Node, options: flags.Options) -> None:
    """Nothing but the links: the session itself is the router. Raises BusError for an invalid interface or rate."""
    rates_hz = {topic.name: topic.slow_hz for topic in topics.TOPICS} | dict(_rate(text) for text in options.slow_hz)
    known = psutil.net_if_addrs()
    if unknown := [name for name in options.slow if name not in known]:
        raise bus.BusError(f"--slow: expected a network interface of this host ({', '.join(known)}), got {unknown[0]}")
    if options.slow_hz and not options.slow:
        raise bus.BusError(f"--slow-hz: expected --slow INTERFACE beside it, got {options.slow_hz[0]} alone")
    if options.announce:
        node.announce()
    if options.slow:
        keys = {key: rates_hz[topic.name] for topic in topics.TOPICS for key in node.keys(topic, {})}
        node.thin_out(SlowLinks(tuple(options.slow), keys))


def _rate(text: str) -> tuple[str, float]:
    name, _, rate = text.partition("=")
    names = [topic.name for topic in topics.TOPICS]
    try:
        rate_hz = float(rate)
    except ValueError:
        rate_hz = math.nan
    if name not in names or not 0.0 <= rate_hz < math.inf:
        raise bus.BusError(f"--slow-hz: expected TOPIC=HZ, as in fused=20, with TOPIC one of {', '.join(names)}, got {text}")
    return name, rate_hz
