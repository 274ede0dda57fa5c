"""Wires the simulated world to the bus: control queries in, frames, joints, voltages and the truth out.

With --serial the voltages of pads go the way of the real skin: as bytes of their boards, for `penumbra skin` to read."""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable
from functools import partial

from penumbra.services import flags
from penumbra.services.emulator.control import control
from penumbra.services.emulator.pacing import Pacer, Time
from penumbra.shared.contract import topics
from penumbra.shared.contract.topics import VOLTAGES
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.sim.world.world import TICK_NS, Sensors, Stream, World

NAME = "emulator"

PLAN_S = 10.0
"""Time [s] by which the limb's motion is planned ahead, in the frames' thread: planning must not delay the skin."""
AHEAD_S = 0.1
"""Delay [s] of a command: frames until then may have been rendered already."""
LEAVES_S = 2.0
"""Time [s] that an emulator waits for one that has just ended: on another host it counts as alive for a second more."""
AGAIN_S = 0.001
"""Period [s] of a turn, which waits by itself; this only keeps a failing one from busy-looping."""


ALL_PADS = "*"
FLAGS = (
    flags.Option("--seed", type=int, default=0, help="draws motion, occlusion, colours and noise"),
    flags.Option(
        "--serial",
        takes="many",
        without=ALL_PADS,
        metavar="[PAD ...]",
        help="serve the boards of these pads (none named: of all) on pseudo-terminals instead of publishing their voltages",
    ),
    flags.Option(
        "--serial-folder",
        type=flags.folder,
        metavar="DIR",
        help="where links to the pseudo-terminals are made, named p0-0 for the first board of pad p0",
    ),
    flags.Option("--occlude", default="auto", metavar="LEVEL|auto", help="share of the target to hide"),
)
EXAMPLE = "penumbra emulator --cell table --seed 7 --occlude 0.5"


def refuse_second(node: Node) -> None:
    """Raise bus.BusError if the cell has an emulator already. Without a router there is none."""
    with contextlib.ExitStack() as stack:
        try:
            session = stack.enter_context(bus.open_session(node.connection, node.stopping, lambda: None, 0.0))
        except bus.BusError:  # the node waits for the router, or reports the fault
            return
        deadline = time.monotonic() + LEAVES_S
        while any(reply.ok for reply in session.liveliness().get(topics.alive(node.cell.name, NAME))):
            if time.monotonic() > deadline:
                raise bus.BusError(
                    f"cell {node.cell.name} at {node.connection.where} has an emulator already, and two would contradict each "
                    "other: end that one first, or start its `penumbra up` with --replicas emulator=0"
                )
            if node.stopping.wait(0.1):
                return


def start(node: Node, options: flags.Options) -> None:
    """Threads: the skin's timer, one timer per camera and the answers share the world; motions and occluders have their own
    locks, and commands replace the data that the timers read.

    Every stream has its own turn: the next data is prepared before its instant, as in a real sensor.
    """
    cell = node.cell
    refuse_second(node)
    world = World(cell, options.seed)
    world.plan(PLAN_S)
    sensors = Sensors(world, node.now_ns())
    for camera in cell.cameras.keys() - cell.sources.keys():  # compile what the first turn would wait for
        sensors.frame(camera, 0)
    sensors.tick(1)
    world_time = Time(node.now_ns)

    def time_s() -> float:
        return world_time.now_ns() * 1e-9

    serial = None
    if options.serial:
        from penumbra.services.emulator.serial_boards import SerialBoards  # its boards' model takes as long to import as all else

        pads = list(cell.pads) if ALL_PADS in options.serial else list(options.serial)
        serial = SerialBoards(world, pads, options.serial_folder, world_time.began_ns, TICK_NS * 1e-9, AHEAD_S)
        for name, device in serial.devices.items():
            node.log.info("board on a pseudo-terminal", board=name, device=device)
        node.every(AGAIN_S, partial(serial.serve, node.stopping), math.inf)
    served = serial.pads if serial else ()

    def answer(_: dict[str, str], payload: bytes) -> tuple[bytes, str]:
        return json.dumps(control(world, payload, time_s() + AHEAD_S, serial)).encode(), "application/json"

    def turn(pacer: Pacer, prepare: Callable[[int], Stream]) -> None:
        k = pacer.next()
        sensors.epoch_ns = world_time.epoch_ns()
        messages = prepare(k)
        if not node.stopping.wait(pacer.ready()):
            for topic, names, message in messages:
                if topic is not VOLTAGES or names["pad"] not in served:
                    node.publish(topic, message, **names)

    def frame(camera: str, k: int) -> Stream:
        world.plan(time_s() + PLAN_S)
        return sensors.frame(camera, k)

    control(world, json.dumps({"command": "occlude", "value": options.occlude}).encode(), 0.0)
    node.answer(topics.control(cell.name), answer)
    skin = Pacer(0, TICK_NS, world_time.now_ns, late_ns=TICK_NS)
    node.every(AGAIN_S, partial(turn, skin, sensors.tick))
    for camera, description in cell.cameras.items():
        if camera in cell.sources:
            node.log.info("left to `penumbra camera`: the cell file gives it a source", camera=camera)
            continue
        period_ns = 1e9 / description.rate_hz
        pacer = Pacer(0, period_ns, world_time.now_ns, late_ns=period_ns / 10)
        node.every(AGAIN_S, partial(turn, pacer, partial(frame, camera)))
