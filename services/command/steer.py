"""`penumbra restart` and `penumbra scale`: what a running launcher is asked to change, and how it gets on."""

from __future__ import annotations

import json
import secrets
import time
from dataclasses import replace
from typing import Any

from services import flags
from services.command.look import open_session
from shared.cell import description as cells
from shared.contract import access, topics
from shared.runtime import bus

ASK_S = 0.2
PATIENCE_S = 10.0
"""How long a launcher that has begun may keep silent before it counts as gone."""


def restart(argv: list[str]) -> int:
    """`penumbra restart [SERVICE ...] [--all]`"""
    parser = flags.parser(
        "restart",
        "Restarts services of the running `penumbra up`, one process after another. The new one serves before the old one ends, "
        "except where there can be but one (emulator).",
    )
    parser.add_argument("service", nargs="*", help="what to restart (default: all that can be replaced without a gap)")
    parser.add_argument("--all", action="store_true", help="everything, also what there can be but one of (emulator)")
    options = parser.parse_args(argv)
    if options.all and options.service:
        parser.error(f"--all or names expected, both came: {' '.join(options.service)}")
    return _change(options, {"command": "restart", "services": "all" if options.all else options.service or None})


def scale(argv: list[str]) -> int:
    """`penumbra scale NAME=NUMBER`"""
    parser = flags.parser("scale", "Changes the number of replicas of a service of the running `penumbra up`.")
    parser.add_argument("replicas", metavar="NAME=NUMBER", help="as in segmentation=2; 0 ends it")
    options = parser.parse_args(argv)
    service, _, number = options.replicas.partition("=")
    if not number.isdecimal():
        parser.error(f"NAME=NUMBER expected, as in segmentation=2, {options.replicas!r} came")
    return _change(options, {"command": "scale", "service": service, "number": int(number)})


def _change(options: Any, command: dict[str, Any]) -> int:
    """Asks every launcher of the cell for a change, and tells how it gets on until all are done; 1 if one of them failed."""
    cell = cells.load(options.cell)
    key, name = topics.launcher(cell.name), secrets.token_hex(8)
    with open_session(replace(bus.connection(options), service=access.OPERATOR)) as session:
        states = _ask(session, key, command | {"id": name})
        if not states:
            raise bus.BusError(
                f"no launcher runs in cell {cell.name}: start `penumbra up`; containers are restarted by docker compose"
            )
        told, heard = "", time.monotonic()
        while not all(state["done"] for state in states):
            now = "; ".join(state["doing"] for state in states if not state["done"])
            if now != told:
                print(now, flush=True)
                told = now
            time.sleep(ASK_S)
            if answers := _ask(session, key, {"command": "state", "id": name}):
                states, heard = answers, time.monotonic()
            elif time.monotonic() - heard > PATIENCE_S:
                raise bus.BusError(f"the launcher of cell {cell.name} went away while it was at the {states[0]['what']}")
    for state in states:
        print(f"{state['what']}: {state['error'] or 'done'}")
    return int(any(state["error"] for state in states))


def _ask(session: Any, key: str, command: dict[str, Any]) -> list[dict[str, Any]]:
    return [json.loads(answer) for answer in bus.ask(session, key, payload=json.dumps(command).encode())]
