"""Dashboard service: a server, a timer that reads the bus for its pages, and one that queries the health of processes."""

from __future__ import annotations

import math
import os
import secrets
import sys
import threading

from penumbra.services import flags
from penumbra.services.dashboard import security
from penumbra.services.dashboard.watch import LOOK_S
from penumbra.shared.contract import access, report, topics
from penumbra.shared.runtime import bus, page
from penumbra.shared.runtime.node import Node

NAME = "dashboard"
ASK_S = 1.0
IDLE_TURNS = 5
"""Without a page the health of processes is queried only every IDLE_TURNS turns, for the timeline."""
ANSWER_S = 2.0
KEY_BYTES = 18
LOOKING = (access.VIEWER, NAME)
"""Holders of certificates from which viewing keys are made: a viewer's, and the dashboard's own, which it always has."""
NICE = 5
"""Niceness of the page's threads, so that on a busy processor the threads that make the pose go first."""


FLAGS = (
    flags.Option(
        "--page",
        metavar="[ADDRESS:]PORT",
        show_default=f"127.0.0.1:{page.PORT}, or another port where that one is taken",
        help="where the page is served; without ADDRESS on loopback",
    ),
    flags.Option(
        "--host",
        multiple=True,
        metavar="NAME",
        help="a further name or address by which browsers reach the page; other names are refused. May be repeated",
    ),
    flags.Option("--look-only", is_flag=True, help="the page steers nothing"),
)
EXAMPLE = """\
penumbra dashboard --cell table
penumbra dashboard --page 0.0.0.0:8470 --host cell-7.example --look-only"""


def start(node: Node, options: flags.Options) -> None:
    """Serve the page, and read the bus for it. Raises BusError for an invalid address.

    Threads: the server's event loop owns everything about browsers; the timers own what they receive (`Watch`).
    """
    from penumbra.services.dashboard.server import Place, Server  # aiohttp: imported in this process alone, not before the fork

    try:
        address, port = flags.address(options.page) if options.page else ("127.0.0.1", page.PORT)
    except ValueError as error:
        raise bus.BusError(f"--page: {error}") from None
    keys, look_only = _keys(node, options.look_only)
    place = Place(address, port, bool(options.page), security.hosts(address, options.host))
    server = Server(node, place, keys, look_only)
    turn = 0

    def serve() -> None:
        _step_back()
        server.run()

    def look() -> None:
        if server.watch.turns == 0:
            _step_back()
        server.watch.look()

    def ask() -> None:
        nonlocal turn
        turn += 1
        if server.pages or turn % IDLE_TURNS == 1:
            try:
                answers = node.query(topics.health(node.cell.name), timeout_s=ANSWER_S)
            except bus.Refused:
                answers = []
            server.watch.judge(map(report.read, answers), server.emulator() if server.pages else None)

    node.every(ASK_S, serve, math.inf)
    node.every(LOOK_S, look)
    node.every(ASK_S, ask)
    node.add_report(page.REPORT, lambda: {"address": server.url, "pages": server.pages})
    node.add_reasons(lambda: [server.fault] if server.fault else [])


def _keys(node: Node, look_only: bool) -> tuple[security.Keys, str]:
    """The keys of the page, and the reason if nobody may steer."""
    folder = node.connection.secure
    if folder is None:
        steer = None if look_only else secrets.token_urlsafe(KEY_BYTES)
        return security.Keys(None, steer), "this page only shows: --look-only" if look_only else ""
    found = [page.key(folder, holder) for holder in LOOKING]
    steer = page.key(folder, access.OPERATOR)
    why = "this page only shows: --look-only" if look_only else "" if steer else f"{folder} holds no certificate of an operator"
    return security.Keys(tuple(key for key in found if key), None if look_only else steer), why


def _step_back() -> None:
    """Lower the thread's priority, so that the pose goes first on a busy processor: on Linux each thread has its own priority."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
