"""Recorder service: writes all topics to files, and answers requests to save the last seconds."""

from __future__ import annotations

import json
from pathlib import Path

from penumbra.services import flags
from penumbra.services.record.disk import Disk, Limits
from penumbra.services.record.last import Last
from penumbra.services.record.recorder import Recorder
from penumbra.shared.contract import topics
from penumbra.shared.recording import provenance
from penumbra.shared.recording.foxglove import Viewers
from penumbra.shared.runtime.bus import BusError
from penumbra.shared.runtime.node import Node

NAME = "record"
TURN_S = 0.05
"""Period [s] at which messages are recorded; with `recorder.FLUSH_TURNS` less than 0.3 s are lost if the process is killed."""
SYNC_S = 5.0
"""Period [s] of syncs to the disk: the data lost in a power failure."""
WAITING_BYTES = 128 << 20
"""Maximum size [bytes] of messages waiting to be recorded: raw frames of one camera for some seconds, while the disk stalls."""
MB = 10**6

FLAGS = (
    flags.Option(
        "-o",
        "--out",
        type=Path,
        default=Path("."),
        metavar="FILE.mcap|FOLDER",
        show_default="here, named by cell and time",
        help="what to write; a file that is there is never overwritten: the next one has a number",
    ),
    flags.Option(
        "--topics",
        choices=tuple(topic.name for topic in topics.TOPICS),
        takes="many",
        metavar="TOPIC ...",
        show_default="all",
        help="record only these",
    ),
    flags.Option(
        "--raw", is_flag=True, help="keep the bytes of frames too, in place of JPEG alone: for trainings; 18 MB/s a camera"
    ),
    flags.Option("--roll-mb", type=flags.above_zero, default=1024.0, help="begin the next file after so many MB"),
    flags.Option("--roll-minutes", type=flags.above_zero, default=60.0, help="begin the next file after so many minutes"),
    flags.Option(
        "--keep-free-mb",
        type=flags.above_zero,
        default=500.0,
        help="pause while the disk has less room than this, and go on after",
    ),
    flags.Option(
        "--last",
        type=flags.above_zero,
        metavar="SECONDS",
        help="keep only so much, in memory, until `penumbra record save` or a loss",
    ),
    flags.Option("--last-mb", type=flags.above_zero, default=256.0, help="of memory at most, with --last"),
)
EXAMPLE = "penumbra record -o run.mcap\npenumbra record --topics frame joints voltages --raw\npenumbra record --last 60"


def start(node: Node, options: flags.Options) -> None:
    """Start one timer that receives, converts and writes, and one that syncs the disk. Raises BusError if nothing can be
    written."""
    wanted = [topic for topic in topics.TOPICS if not options.topics or topic.name in options.topics]
    limits = Limits(options.roll_mb * MB, options.roll_minutes * 60.0, options.keep_free_mb * MB)
    viewers = Viewers(node.cell, options.raw)
    about, attached = provenance.about(options.cell), provenance.attachments(options.cell)
    disk = Disk(options.out, node.cell.name, about, attached, viewers.stage, limits, node.log)
    try:
        disk.check()
    except OSError as error:
        raise BusError(f"--out {options.out}: expected a file or folder that can be written: {error.strerror}") from None
    last = Last(options.last, options.last_mb * MB) if options.last else None
    recorder = Recorder(node.tap(wanted, WAITING_BYTES), viewers, options.raw, disk, last, node.now_ns, node.log)
    node.add_report("disk" if last is None else "memory", recorder.describe)
    node.add_reasons(recorder.reasons)
    node.answer(
        topics.recorder(node.cell.name), lambda _, payload: (json.dumps(recorder.answer(payload)).encode(), "application/json")
    )
    node.every(TURN_S, recorder.turn)
    node.every(SYNC_S, disk.sync)
    node.when_closed(recorder.close)
