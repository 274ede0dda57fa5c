"""Publishes the pictures of cameras, films and folders as frames, each with the time of its exposure.

A source is v4l2:/dev/video0, rtsp://HOST/PATH, file:FILM, folder:PICTURES or adapter:MODULE:CLASS, a class of yours for any SDK.
Give it with --source, or in the cell file under `source:` of the camera: then `penumbra up` starts this process, and the
emulator leaves the camera out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

from pydantic import ValidationError

from penumbra.services import flags
from penumbra.services.camera import adapter, files, live
from penumbra.services.camera.feed import Feed
from penumbra.services.camera.reader import Reader
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.explain import explain
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import MAX_FUTURE_S, Frame
from penumbra.shared.contract.topics import FRAME
from penumbra.shared.runtime.adapter import load
from penumbra.shared.runtime.node import Node

NAME = "camera"
AGAIN_S = 0.001
"""Period [s] of a turn, which waits by itself; this only keeps a failing one from busy-looping."""
TAKE_S = 0.5
"""Maximum time [s] that a turn waits for a picture."""
LOOK_S = 1.0
"""Period [s] at which the process checks whether the emulator publishes the same camera."""

FLAGS = (
    flags.Option(
        "--source",
        metavar="SOURCE",
        show_default="those of the cell file",
        help="v4l2:/dev/video0, rtsp://HOST/PATH, file:FILM, folder:PICTURES or adapter:MODULE:CLASS",
    ),
    flags.Option(
        "--camera",
        metavar="NAME",
        show_default="the cell's first, or all with a source in the cell file",
        shell_complete=flags.complete_part("cameras"),
        help="the camera that --source belongs to",
    ),
    flags.Option("--loop", is_flag=True, help="begin a film or a folder again at its end"),
    flags.Option("--rate", type=flags.above_zero, metavar="HZ", show_default="the film's own", help="of a film or a folder"),
    flags.Option("--latency", type=float, metavar="S", help="from exposure to arrival, where nothing measures it"),
)
EXAMPLE = "penumbra camera --source v4l2:/dev/video0\npenumbra camera --camera front --source file:film.mp4 --loop"


def start(node: Node, options: flags.Options) -> None:
    """Start two threads per camera: one reads, and owns its `Reader` except the slot; one publishes the picture in the slot. The
    health report only reads."""
    live.quiet()
    for name, source in sources(node.cell, options).items():
        camera = node.cell.cameras[name]
        folder = node.cell.folder if options.source is None else Path.cwd()
        if (source.is_played or source.kind == "v4l2") and not source.path(folder).exists():
            node.log.warning("nothing is there yet: it is waited for", camera=name, source=source.url)
        reader = Reader(
            name,
            camera,
            source,
            opener(name, camera, source, folder, node),
            not source.is_played,
            FRAME.oldest_s - MAX_FUTURE_S,
            node.stopping,
            partial(node.log.error, camera=name),
        )
        conflict = Conflict(node, name)
        if conflict.is_possible:
            node.every(LOOK_S, conflict.look)
        node.add_report(name, reader.describe)
        node.add_reasons(reader.reasons)
        node.add_reasons(conflict.reasons)
        node.every(AGAIN_S, reader.session, math.inf)
        node.every(AGAIN_S, partial(publish, node, name, reader, conflict))


def publish(node: Node, name: str, reader: Reader, conflict: Conflict) -> None:
    """Publish the next picture that arrives within TAKE_S."""
    shot = reader.take(TAKE_S)
    if shot is not None and shot.stamp_ns is not None and conflict.is_free:
        node.publish(FRAME, Frame(stamp_ns=shot.stamp_ns, image=shot.image), camera=name)


def sources(cell: cells.Cell, options: flags.Options) -> dict[str, cells.CameraSource]:
    """The sources to read, by camera. Raises CellError if there is none, or an invalid one."""
    given = {"loop": options.loop or None, "rate_hz": options.rate, "latency": options.latency}
    given = {key: value for key, value in given.items() if value is not None}
    if options.source is not None:
        source = _checked({"url": options.source, **given})
        if source.is_played and not (path := source.path(Path.cwd())).exists():
            what = f"expected a film or a folder of pictures, got nothing at {path}"
            raise cells.CellError(f"--source: {what}; correct it, or put it there")
        return {cell.one("cameras", options.camera): source}
    found = cell.sources
    if options.camera is not None:
        name = cell.one("cameras", options.camera)
        found = {name: found[name]} if name in found else {}
    if not found:
        what = f"camera {options.camera}" if options.camera else "no camera"
        has = "has no source" if options.camera else "has a source"
        how = "give --source SOURCE, or `source:` of the camera in the cell file"
        raise cells.CellError(f"{what} of cell {cell.name} {has}: {how}")
    if not given:
        return found
    return {name: _checked(source.model_dump(exclude_unset=True) | given) for name, source in found.items()}


def _checked(values: dict[str, object]) -> cells.CameraSource:
    try:
        return cells.CameraSource.model_validate(values)
    except ValidationError as error:
        flag = {"url": "--source", "rate_hz": "--rate"}
        found = [(".".join(place), reason) for place, reason in explain(cells.CameraSource, error.errors())]
        raise cells.CellError("; ".join(f"{flag.get(place, f'--{place}')}: {reason}" for place, reason in found)) from None


def opener(name: str, camera: cells.Camera, source: cells.CameraSource, folder: Path, node: Node) -> Callable[[], Feed]:
    """A function that opens a source. folder: base of relative paths. Raises CellError for an adapter without its class."""
    path = source.path(folder)
    match source.kind:
        case "v4l2":
            return partial(live.V4l2, source.place, camera)
        case "file":
            return partial(files.Film, path, source.loop, source.rate_hz, camera.rate_hz, node.stopping)
        case "folder":
            return partial(files.Folder, path, source.loop, source.rate_hz or camera.rate_hz, node.stopping)
        case "adapter":
            return partial(adapter.Adapted, load(source.place, folder.absolute(), "docs/own-camera.md"), name, camera)
    return partial(live.Rtsp, source)


class Conflict:
    """Detects that the emulator publishes the same camera: it does if the cell file has `sim` and no source for the camera. Two
    publishers would contradict each other, so this process stays silent while an emulator lives."""

    def __init__(self, node: Node, name: str):
        self._node, self._name = node, name
        self.is_possible = node.cell.sim is not None and name not in node.cell.sources
        self.is_free = not self.is_possible

    def look(self) -> None:
        """Check whether an emulator lives."""
        session = self._node.session
        if session is None:
            return
        tokens = session.liveliness().get(topics.alive(self._node.cell.name, "emulator"))
        self.is_free = not any(reply.ok for reply in tokens)

    def reasons(self) -> list[str]:
        """What to do about an emulator."""
        if self.is_free or self._node.session is None:
            return []
        return [
            f"camera {self._name}: not published, since the emulator publishes it: write its source into the cell file, or start "
            "the cell with --replicas emulator=0"
        ]
