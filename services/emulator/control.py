"""Control queries of the emulator: JSON in, JSON out."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from penumbra.sim.world.world import World

if TYPE_CHECKING:
    from penumbra.services.emulator.serial_boards import SerialBoards

COMMANDS = {
    "occlude": "a share of the target's pixels to hide from 0 to 1, or auto",
    "motion": "on or off: target and robot move or stand still",
    "pause": "stop the simulation",
    "resume": "continue the simulation",
    "speed": "how fast target and robot move: above 0, at most 4, 1 is as in the cell file",
    "skin": "PAD[/ELECTRODE] FAULT [SIZE] or `all none`: dead, saturated, drift, warm, hum, gain, turned, mirrored, none",
    "board": "PAD-NUMBER error, lost, short, missing or slip: a fault of a board that --serial serves, such as p0-1 lost",
    "state": "print the current settings",
}
"""Every command, and the meaning of its value."""


def control(world: World, payload: bytes, time_s: float, serial: SerialBoards | None = None) -> dict[str, Any]:
    """Carry out `{"command": NAME, "value": VALUE}` from `time_s` on; returns the settings then in force. The value may be a
    text. serial: the boards on serial ports.

    Raises ValueError with the possibilities for an invalid request.
    """
    try:
        request = json.loads(payload)
    except ValueError:
        raise ValueError(_expected(payload[:60].decode(errors="replace"))) from None
    if not isinstance(request, dict) or not isinstance(request.get("command"), str) or request.keys() - {"command", "value"}:
        raise ValueError(_expected(payload[:60].decode(errors="replace")))
    command, value = request["command"], request.get("value")
    if command in ("pause", "resume", "state") and value is not None:
        raise ValueError(f"{command}: expected no value, got {value!r}")
    if command == "occlude":
        world.occlude(None if value == "auto" else _number(command, value), time_s)
    elif command == "motion":
        if value not in ("on", "off"):
            raise ValueError(f"motion: expected {COMMANDS[command]}, got {_got(value)}")
        world.set_motion(value == "on", time_s)
    elif command == "speed":
        world.set_speed(_number(command, value), time_s)
    elif command == "skin":
        if not isinstance(value, str):
            raise ValueError(f"skin: expected {COMMANDS['skin']}, got {_got(value)}")
        world.break_skin(value, time_s)
    elif command == "board":
        if serial is None:
            raise ValueError("board: no boards are served: start the emulator with --serial")
        if not isinstance(value, str):
            raise ValueError(f"board: expected {COMMANDS['board']}, got {_got(value)}")
        serial.fault(value)
    elif command in ("pause", "resume"):
        world.set_paused(command == "pause", time_s)
    elif command != "state":
        raise ValueError(_expected(command))
    return world.describe(time_s)


def _number(command: str, value: Any) -> float:
    try:
        if isinstance(value, bool):
            raise ValueError
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{command}: expected {COMMANDS[command]}, got {_got(value)}") from None


def _got(value: Any) -> str:
    return "nothing" if value is None else repr(value)


def _expected(got: str) -> str:
    possible = "\n".join(f"  {name:8} {about}" for name, about in COMMANDS.items())
    return f'expected {{"command": NAME, "value": VALUE}}, got {got!r}. Commands:\n{possible}'
