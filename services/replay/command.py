"""`penumbra replay`."""

from __future__ import annotations

import json
import shlex
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from penumbra.services import flags
from penumbra.services.replay import in_process, live
from penumbra.services.replay.chain import SERVICES
from penumbra.services.replay.live import SENSORS
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import access, topics
from penumbra.shared.contract.topics import Topic
from penumbra.shared.recording import provenance
from penumbra.shared.recording.reading import Played, Recording
from penumbra.shared.runtime import bus

PATIENCE_S = 1.0
NAMES = tuple(topic.name for topic in topics.TOPICS)


def _rate(text: str) -> float:
    rate = flags.number(text)
    live.check_rate(rate)
    return rate


def _seconds(text: str) -> float:
    value = flags.number(text)
    if value < 0:
        raise ValueError(f"expected seconds from the beginning, got {text!r}")
    return value


@flags.command(
    "replay",
    "Plays files of `penumbra record` onto the bus, with new stamps. With --sensors only what sensors said: the methods that run "
    "(penumbra up --replicas emulator=0) make today's poses of it. With --in-process the methods run here, without a bus, and to "
    "the bit the same every time; what they make is compared with what was recorded. The exit code is 1 where a file had no end.",
    flags.Argument(
        "file", nargs=-1, required=True, type=Path, metavar="FILE ...", help="one file, or those that follow each other"
    ),
    flags.Option(
        "--rate", type=_rate, default=1.0, help="seconds of the recording in a second; above 1 the methods may not follow"
    ),
    flags.Option("--loop", is_flag=True, help="again and again, until Ctrl-C"),
    flags.Option("--from", "from_s", type=_seconds, default=0.0, metavar="SECONDS", help="begin so long after its beginning"),
    flags.Option("--sensors", is_flag=True, help="only frames, joints and voltages"),
    flags.Option("--topics", choices=NAMES, takes="many", metavar="TOPIC ...", show_default="all", help="only these"),
    flags.Option("--in-process", is_flag=True, help="through the methods in this process, without a bus"),
    flags.Option("--out", type=Path, metavar="FILE.mcap", help="with --in-process: record what the methods make"),
    *(
        flags.Option(
            f"--{service}", default="", metavar="FLAGS", help=f"with --in-process: flags of {service}, such as '--log-level info'"
        )
        for service in SERVICES
    ),
    flags.Option(
        "--cell",
        envvar="PENUMBRA_CELL",
        show_envvar=True,
        metavar="CELL",
        shell_complete=flags.complete_cell,
        show_default="the one in the file",
        help="table, arm or a YAML file",
    ),
    flags.JSON,
    *flags.BUS,
    *flags.LOG,
    example="penumbra replay run.mcap --loop\n"
    "penumbra up --replicas emulator=0 & penumbra replay run.mcap --sensors\n"
    "penumbra replay run.mcap --in-process --json",
)
def main(options: flags.Options) -> int:
    """Plays, and prints what was played; 1 where a file had no end."""
    if options.out is not None and not options.in_process:
        flags.refuse("expected --in-process beside --out, got --out alone")
    if options.sensors and options.topics:
        flags.refuse("expected --sensors or --topics, got both")
    recordings = [Recording(path) for path in options.file]
    cell = cells.load(options.cell) if options.cell else recordings[0].cell()
    found = _in_process(options, recordings, cell) if options.in_process else _live(options, recordings, cell)
    found["faults"] = [recording.fault for recording in recordings if recording.fault]
    found["unread"] = {str(recording.path): recording.unread for recording in recordings if recording.unread}
    _print(found, options.json)
    return int(bool(found["faults"]))


def _in_process(options: flags.Options, recordings: Sequence[Recording], cell: cells.Cell) -> dict[str, Any]:
    arguments = {service: shlex.split(getattr(options, service)) for service in SERVICES}
    source = options.cell or recordings[0].about["cell_file"]
    about = provenance.about(source) if options.out else None
    attached = provenance.attachments(source) if options.out else None
    messages = _messages(recordings, topics.TOPICS, options.from_s)
    return {"poses": in_process.play(cell, messages, arguments, out=options.out, about=about, attached=attached)}


def _live(options: flags.Options, recordings: Sequence[Recording], cell: cells.Cell) -> dict[str, Any]:
    wanted = SENSORS if options.sensors else tuple(t for t in topics.TOPICS if not options.topics or t.name in options.topics)
    connection = replace(bus.connection(options), service=access.DRIVER)
    if connection.secure is not None and not set(wanted) <= set(SENSORS):
        raise bus.BusError(
            "on a secured bus nobody may publish for all others: give --sensors, or replay on a router without --secure"
        )
    frames = sum(3 * camera.width * camera.height for camera in cell.cameras.values())
    connection = replace(connection, pool_bytes=max(bus.POOL_BYTES, 3 * frames))
    with bus.open_session(connection, threading.Event(), lambda: None, PATIENCE_S) as session:
        live.check_alone(session, cell.name, wanted)
        player = live.Player(session, options.rate)
        stopping = threading.Event()
        try:
            while True:
                player.play(_messages(recordings, wanted, options.from_s), stopping)
                if not options.loop or not player.count.messages:
                    break
        except KeyboardInterrupt:
            print(file=sys.stderr)
    return {"messages": player.count.messages, "topics": player.count.topics, "late_s": round(player.count.late_s, 3)}


def _messages(recordings: Iterable[Recording], wanted: Sequence[Topic], from_s: float) -> Iterator[Played]:
    """The messages of all files, as of one."""
    begins_ns = None
    for recording in recordings:
        for each in recording.messages(wanted):
            begins_ns = each.received_ns if begins_ns is None else begins_ns
            if each.received_ns >= begins_ns + round(from_s * 1e9):
                yield each


def _print(found: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(found))
        return
    for name, track in found.get("poses", {}).items():
        states = ", ".join(f"{state} {share:.1%}" for state, share in track["states"].items())
        print(f"{name}: {track['messages']} messages, {states}; sha256 {track['sha256'][:16]}")
        for what in ("from_recorded_mm", "from_truth_mm", "recorded_from_truth_mm"):
            if (apart := track[what]) is not None:
                words = what.removesuffix("_mm").replace("_", " ")
                print(f"  {words}: median {apart['median']:.1f} mm, largest {apart['largest']:.1f} mm")
    if "messages" in found:
        counts = ", ".join(f"{name} {count}" for name, count in found["topics"].items())
        print(f"{found['messages']} messages ({counts or 'none'}), at most {1e3 * found['late_s']:.0f} ms late")
    for line in (
        *found["faults"],
        *(f"{path}: messages that cannot be read: {kinds}" for path, kinds in found["unread"].items()),
    ):
        print(line)
