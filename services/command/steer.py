"""`penumbra restart` and `penumbra scale`: request a change from a running launcher, and report its progress."""

from __future__ import annotations

import json
import secrets
import time
from dataclasses import replace
from typing import Any

from penumbra.services import flags
from penumbra.services.command.look import open_session
from penumbra.shared.contract import access, topics
from penumbra.shared.runtime import bus, running, which

ASK_S = 0.2
PATIENCE_S = 10.0
"""Maximum time [s] without an answer from a launcher that has begun; then it counts as gone."""


@flags.command(
    "restart",
    "Restarts services of the running `penumbra up`, one process after another. The new one serves before the old one ends, "
    "except where only one can run (emulator).",
    flags.Argument(
        "service",
        nargs=-1,
        shell_complete=flags.complete_service,
        help="what to restart; where none is named, all that can be replaced without a gap",
    ),
    flags.Option("--all", is_flag=True, help="every service, also one that can run only once (emulator)"),
    flags.JSON,
    *flags.LOOKING,
    example="penumbra restart fusion haptics",
)
def restart(options: flags.Options) -> int:
    """Restart services; returns 1 if a restart failed."""
    if options.all and options.service:
        flags.refuse(f"expected --all or names, got both: {' '.join(options.service)}")
    return _change(options, {"command": "restart", "services": "all" if options.all else options.service or None})


def _replicas(text: str) -> tuple[str, int]:
    service, _, number = text.partition("=")
    if not number.isdecimal():
        raise ValueError(f"expected NAME=NUMBER, as in segmentation=2, got {text!r}")
    return service, int(number)


@flags.command(
    "scale",
    "Changes the number of replicas of a service of the running `penumbra up`.",
    flags.Argument("replicas", type=_replicas, metavar="NAME=NUMBER", help="as in segmentation=2; 0 ends it"),
    flags.JSON,
    *flags.LOOKING,
    example="penumbra scale segmentation=2",
)
def scale(options: flags.Options) -> int:
    """Change numbers of replicas; returns 1 if the change failed."""
    service, number = options.replicas
    return _change(options, {"command": "scale", "service": service, "number": number})


def _change(options: flags.Options, command: dict[str, Any]) -> int:
    """Request a change from every launcher of the cell, and print its progress until all are done; returns 1 if one of them
    failed."""
    with open_session(replace(bus.connection(options), service=access.OPERATOR)) as session:
        cell = which.name_of(session, options.cell)
        key, name = topics.launcher(cell), secrets.token_hex(8)
        states = _ask(session, key, command | {"id": name})
        if not states:
            remedy = which.elsewhere(session, cell)
            if running.ask(session, cell):
                remedy = "start `penumbra up`; containers are restarted by docker compose"
            raise bus.BusError(f"no launcher runs in cell {cell}: {remedy}")
        told, heard = "", time.monotonic()
        while not all(state["done"] for state in states):
            now = "; ".join(state["doing"] for state in states if not state["done"])
            if now != told and not options.json:
                print(now, flush=True)
                told = now
            time.sleep(ASK_S)
            if answers := _ask(session, key, {"command": "state", "id": name}):
                states, heard = answers, time.monotonic()
            elif time.monotonic() - heard > PATIENCE_S:
                raise bus.BusError(f"the launcher of cell {cell} ended during the {states[0]['what']}")
    if options.json:
        print(json.dumps(states))
    else:
        print("\n".join(f"{state['what']}: {state['error'] or 'done'}" for state in states))
    return int(any(state["error"] for state in states))


def _ask(session: Any, key: str, command: dict[str, Any]) -> list[dict[str, Any]]:
    return [json.loads(answer) for answer in bus.ask(session, key, payload=json.dumps(command).encode())]
