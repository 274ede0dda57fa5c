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
from penumbra.services.fusion.settings import MOTION
from penumbra.services.replay import in_process, live, smooth
from penumbra.services.replay.chain import SERVICES
from penumbra.services.replay.live import SENSORS
from penumbra.services.replay.tracks import Writer
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import access, topics
from penumbra.shared.contract.topics import Topic
from penumbra.shared.recording import provenance
from penumbra.shared.recording.faults import RecordingError
from penumbra.shared.recording.reading import ABOUT, Played, Recording
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
    "the bit the same every time; what they make is compared with what was recorded. With --smooth nothing is played: the best "
    "trajectory afterwards is made of the senses' poses in the file, or beside --in-process of those of today's methods. The "
    "exit code is 1 where a file is damaged or has no end.",
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
    flags.Option("--smooth", is_flag=True, help="poses from the measurements before and after them"),
    flags.Option(
        "--out",
        "-o",
        type=Path,
        metavar="FILE.mcap",
        help="record what the methods make (--in-process), and the smoothed poses beside what was recorded (--smooth)",
    ),
    flags.Option(
        "--motion",
        type=Path,
        metavar="FILE.json",
        help="with --smooth: learn how the limbs move, and write it here, for penumbra fusion --motion",
    ),
    *(
        flags.Option(
            f"--{service}",
            type=shlex.split,
            default="",
            show_default=False,
            metavar="FLAGS",
            help=f"with --in-process: flags of {service}, quoted as one word; penumbra {service} --help lists them",
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
    "penumbra replay run.mcap --in-process --json\n"
    "penumbra replay run.mcap --smooth --out smooth.mcap\n"
    "penumbra replay run.mcap --smooth --motion motion.json",
)
def main(options: flags.Options) -> int:
    """Play, and print what was played; returns 1 if a file is damaged or has no end."""
    if options.out is not None and not (options.in_process or options.smooth):
        flags.refuse("expected --in-process or --smooth beside --out, got --out alone")
    if options.motion is not None and not options.smooth:
        flags.refuse("expected --smooth beside --motion, got --motion alone")
    if (options.in_process or options.smooth) and (options.sensors or options.topics or options.loop or flags.is_given("rate")):
        flags.refuse(
            "expected --in-process and --smooth without --sensors, --topics, --loop and --rate: "
            "--in-process always takes only what the sensors said, and neither is played in real time"
        )
    for service in SERVICES:
        if getattr(options, service) and not options.in_process:
            flags.refuse(f"expected --in-process beside --{service}, got --{service} alone")
    if options.sensors and options.topics:
        flags.refuse("expected --sensors or --topics, got both")
    if options.out is not None and options.out.exists():
        raise bus.BusError(f"{options.out} is there already: give another --out")
    recordings = [Recording(path) for path in options.file]
    cell = cells.load(options.cell) if options.cell else recordings[0].cell()
    for recording in recordings:
        if recording.about["cell"] != cell.name:
            raise RecordingError(
                f"{recording.path}: expected a recording of cell {cell.name}, got one of cell {recording.about['cell']}: "
                "replay the files of each cell by themselves, without --cell or with that cell"
            )
    play = _here if options.in_process or options.smooth else _live
    found = play(options, recordings, cell)
    found["faults"] = [recording.fault for recording in recordings if recording.fault]
    found["unread"] = {str(recording.path): recording.unread for recording in recordings if recording.unread}
    _print(found, options.json)
    return int(bool(found["faults"]))


def _here(options: flags.Options, recordings: Sequence[Recording], cell: cells.Cell) -> dict[str, Any]:
    """Replay without a bus: through the methods, or as smoothed poses, or both."""
    writer = _writer(options, recordings[0], cell) if options.out is not None else None
    smoothing = smooth.Smoothing(cell) if options.smooth else None
    try:
        if smoothing is not None and not options.in_process:
            found = smooth.smooth(_messages(recordings, smooth.READ, options.from_s), recordings, writer, smoothing)
        else:
            arguments = {service: getattr(options, service) for service in SERVICES}
            messages = _messages(recordings, topics.TOPICS, options.from_s)
            found = in_process.play(cell, messages, arguments, writer=writer, smoothing=smoothing)
    finally:
        if writer is not None:
            writer.close()
    if smoothing is not None and options.motion is not None:
        found["motion"] = smoothing.learned().described()
        options.motion.write_text(json.dumps(found["motion"], indent=2) + "\n")
    return found


def _writer(options: flags.Options, recording: Recording, cell: cells.Cell) -> Writer:
    """A new recording, with the provenance of this installation if its methods make it, else that of the first recording."""
    if not options.in_process:
        return Writer(cell, options.out, {ABOUT: recording.about}, recording.attachments)
    source = options.cell or recording.about["cell_file"]
    return Writer(cell, options.out, provenance.about(source), provenance.attachments(source))


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
    """The messages of all files as one sequence. Raises RecordingError if the files end before `from_s`."""
    begins_ns = ends_ns = None
    for recording in recordings:
        for each in recording.messages(wanted):
            begins_ns, ends_ns = each.received_ns if begins_ns is None else begins_ns, each.received_ns
            if each.received_ns >= begins_ns + round(from_s * 1e9):
                yield each
    if begins_ns is not None and ends_ns is not None and ends_ns < begins_ns + round(from_s * 1e9):
        length_s = (ends_ns - begins_ns) * 1e-9
        raise RecordingError(f"--from {from_s:g}: the recording is {length_s:.1f} s long: give fewer seconds")


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
    for name, counts in found.get("measurements", {}).items():
        passed = ", ".join(
            f"{count['accepted']} of {count['accepted'] + count['gated']} of {s}" for s, count in counts["senses"].items()
        )
        print(f"  {name}: the gates passed {passed}; {counts['reinstated']} others are used, {counts['dismissed']} of these not")
    for name, why in found.get("not_smoothed", {}).items():
        print(f"smoothed {name}: none: {why}")
    if (motion := found.get("motion")) is not None:
        print(f"motion, from {motion['measurements']} measurements, each by {motion['gain']:.3f} nats more likely:")
        for name in MOTION:
            print(f"  {name}: {motion[name]}")
    if "messages" in found:
        counts = ", ".join(f"{name} {count}" for name, count in found["topics"].items())
        print(f"{found['messages']} messages ({counts or 'none'}), at most {1e3 * found['late_s']:.0f} ms late")
    for line in (
        *found["faults"],
        *(f"{path}: messages that cannot be read: {kinds}" for path, kinds in found["unread"].items()),
    ):
        print(line)
