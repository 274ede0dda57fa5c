"""`penumbra record save`, `info` and `mend`: tools for a recorder and its files."""

from __future__ import annotations

import json
import threading
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from penumbra.services import flags
from penumbra.services.record.recorder import SAVE_S
from penumbra.shared.contract import access, topics
from penumbra.shared.recording import reading
from penumbra.shared.recording.reading import Recording
from penumbra.shared.runtime import bus, which

FILE = flags.Argument("file", type=Path, metavar="FILE", help="a file of `penumbra record`")
PATIENCE_S = 1.0


@flags.command(
    "save",
    "Has the cell's recorder write the seconds that it keeps (`penumbra record --last`), and prints where.",
    flags.JSON,
    *flags.LOOKING,
    example="penumbra record save",
)
def save(options: flags.Options) -> None:
    """Request a file from every recorder of the cell."""
    request = json.dumps({"command": "save"}).encode()
    connection = replace(bus.connection(options), service=access.OPERATOR)
    with bus.open_session(connection, threading.Event(), lambda: None, PATIENCE_S) as session:
        cell = which.name_of(session, options.cell)
        answers = bus.ask(session, topics.recorder(cell), payload=request, timeout_s=SAVE_S)
        if not answers:
            raise bus.BusError(f"no recorder in cell {cell}: {which.whats_there(session, cell, 'record')}")
    for answer in map(json.loads, answers):
        print(json.dumps(answer) if options.json else f"{answer['file']}: {answer['seconds']} s")


@flags.command(
    "info",
    "Prints what a file holds. The exit code is 1 where it is damaged or its end is missing.",
    FILE,
    flags.JSON,
    example="penumbra record info run.mcap",
)
def info(options: flags.Options) -> int:
    """Print the contents; returns 1 if a part or the end is missing."""
    found = described(Recording(options.file))
    if options.json:
        print(json.dumps(found))
    else:
        for name, value in found["about"].items():
            print(f"{name:24} {value}")
        print(f"{'seconds':24} {found['seconds']}")
        for topic, count in found["messages"].items():
            print(f"{topic:44} {count}")
        for gap in found["gaps"]:
            print(f"bytes {gap['begin']} to {gap['end']} are damaged: {gap['seconds']:.2f} s of messages are missing")
        print(found["fault"] or "the file is whole")
    return int(bool(found["fault"]))


def described(recording: Recording) -> dict[str, Any]:
    """Metadata, seconds, messages by topic, and faults."""
    counts: Counter[str] = Counter()
    stamps: list[int] = []
    for entry in recording.entries():
        counts[entry.channel.topic] += 1
        stamps = [min([entry.log_ns, *stamps[:1]]), max([entry.log_ns, *stamps[1:]])]
    seconds = round((stamps[1] - stamps[0]) * 1e-9, 3) if stamps else 0.0
    return {
        "about": dict(recording.about),
        "seconds": seconds,
        "messages": dict(sorted(counts.items())),
        "is_indexed": recording.is_indexed,
        "fault": recording.fault,
        "gaps": [asdict(gap) for gap in recording.gaps],
    }


@flags.command(
    "mend",
    "Writes all that can be read of a file that is damaged or whose recorder was killed to a new, whole file with an index, and "
    "reads that again.",
    FILE,
    flags.Option("-o", "--out", type=Path, metavar="FILE", show_default="FILE-mended.mcap", help="what to write"),
    example="penumbra record mend run.mcap",
)
def mend(options: flags.Options) -> None:
    """Repair a file, and print what was saved."""
    out = options.out or options.file.with_stem(f"{options.file.stem}-mended")
    try:
        found = reading.mend(options.file, out)
    except FileExistsError:
        raise bus.BusError(f"{out} is there already: give another --out") from None
    print(
        f"{out}: {found.messages} messages of {found.seconds:.1f} s"
        + (f"; {found.fault}" if found.fault else "; none was missing")
    )
