"""Common parts of the calibrations: their flags, and writing a result to the cell file."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from penumbra.services import flags
from penumbra.services.calibrate.board import CalibrationError
from penumbra.shared.cell import edit
from penumbra.shared.cell.faults import CellError
from penumbra.shared.cell.names import source
from penumbra.shared.runtime import bus

CAMERA = flags.Option("--camera", shell_complete=flags.complete_part("cameras"), show_default="its first", help="of the cell")
FOLDER = flags.Option(
    "--pictures",
    type=Path,
    metavar="FOLDER",
    help="pictures of the board as the camera takes them; without it they come from the running cell",
)
SAVE = flags.Option(
    "--save", type=flags.folder, metavar="FOLDER", help="keep the pictures that came from the running cell, for --pictures"
)
WRITING = (
    flags.Option("--out", type=Path, metavar="FILE", show_default="the cell file itself", help="write the cell here"),
    flags.Option("--dry-run", is_flag=True, help="show what would change in the cell file, write nothing"),
    flags.JSON,
)


def guarded(name: str, run: Callable[[], None]) -> int:
    """Run a calibration; returns 0, or 2 after printing what is wrong."""
    try:
        run()
    except (CalibrationError, CellError, bus.BusError) as error:
        for line in str(error).splitlines():
            print(f"penumbra calibrate {name}: {line}", file=sys.stderr)
        return 2
    return 0


def destination(options: flags.Options) -> Path:
    """The file for the result, determined before anything is measured, so that no measurement is lost. Raises CellError."""
    return source(options.cell) if options.dry_run else edit.destination(options.cell, options.out)


def store(
    options: flags.Options, camera: str, values: Mapping[str, str], instead: Mapping[str, str], say: Callable[[str], None]
) -> None:
    """Write values of a camera to the cell file, or show the change. Raises CellError."""
    path, origin = destination(options), source(options.cell)
    text = edit.with_values(origin, ("cameras", camera), values, instead)
    if options.dry_run:
        say(edit.difference(origin, text).rstrip() or f"{origin}: nothing changes")
        return
    edit.write(path, text)
    say(f"{path}: camera {camera} written")
