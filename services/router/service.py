"""The meeting point of a host: a node in router mode passes on what the others say, here and at the routers it is linked to."""

from __future__ import annotations

import argparse
import math

import psutil

from shared.contract import topics
from shared.runtime import bus
from shared.runtime.node import Node
from shared.runtime.slow_links import SlowLinks

NAME = "router"
MODE = "router"


def arguments(parser: argparse.ArgumentParser) -> None:
    """The service's own flags."""
    group = parser.add_argument_group(
        "several hosts",
        "A router a host, linked: `--listen tcp/0.0.0.0:7447` on one, `--connect tcp/THAT-HOST:7447` on the others. Processes "
        "connect to the router of their own host.",
    )
    group.add_argument(
        "--slow",
        action="append",
        default=[],
        metavar="INTERFACE",
        help="what leaves by this network interface (such as wlan0) takes a slow link: poses cross it, thinned out, and nothing "
        "waits long; frames, masks and voltages stay here. May be repeated; the other end needs it too",
    )
    group.add_argument(
        "--slow-hz",
        action="append",
        default=[],
        metavar="TOPIC=HZ",
        help="how often a slow link carries each stream of a topic, 0 for never (default: as `penumbra topics` says)",
    )


def start(node: Node, options: argparse.Namespace) -> None:
    """Nothing but the links: the session itself is the router. Raises BusError for an interface or a rate that cannot be."""
    rates_hz = {topic.name: topic.slow_hz for topic in topics.TOPICS} | dict(_rate(text) for text in options.slow_hz)
    known = psutil.net_if_addrs()
    if unknown := [name for name in options.slow if name not in known]:
        raise bus.BusError(f"--slow {unknown[0]}: a network interface of this host expected: {', '.join(known)}")
    if options.slow_hz and not options.slow:
        raise bus.BusError(f"--slow-hz {options.slow_hz[0]}: say with --slow INTERFACE which link is slow")
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
        raise bus.BusError(f"--slow-hz {text}: TOPIC=HZ expected, as in fused=20, with TOPIC one of {', '.join(names)}")
    return name, rate_hz
