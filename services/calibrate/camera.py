"""`penumbra calibrate camera`: intrinsics and distortion of a camera, from views of the board."""

from __future__ import annotations

import json
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from penumbra.services import flags
from penumbra.services.calibrate import board as boards
from penumbra.services.calibrate import intrinsics, live, outcome, views
from penumbra.services.calibrate.board import Board, CalibrationError
from penumbra.services.calibrate.intrinsics import Intrinsics
from penumbra.shared.cell import description as cells
from penumbra.shared.runtime import bus

GOOD_PX = 0.5
"""Residual [px] above which the pictures are blurred, the board is not flat, or the model does not fit the lens."""
GOOD_FOCUS = 0.005
"""Relative standard deviation of the focal lengths above which the result is poor: 5 mm at a metre."""


@flags.command(
    "calibrate camera",
    "Measures a camera's intrinsics and distortion from views of the board, and writes them into the cell file. From a running "
    "cell it takes each view that adds something, while the board is held still, and says what is missing.",
    outcome.CAMERA,
    outcome.FOLDER,
    flags.Option("--views", type=flags.positive, default=20, metavar="N", help="views to take from the running cell"),
    outcome.SAVE,
    *outcome.WRITING,
    *boards.FLAGS,
    boards.MEASURED,
    *flags.MEASURING,
    example="penumbra calibrate camera --cell mine.yaml --pictures lens --dry-run\n"
    "penumbra calibrate camera --cell mine.yaml --camera front --square-measured 39.8mm --save lens",
)
def main(options: flags.Options) -> int:
    """Run the command; returns 0, or 2 for wrong views or a wrong cell file."""
    return outcome.guarded("camera", lambda: _calibrate(options))


def _calibrate(options: flags.Options) -> None:
    if options.pictures is not None and options.save is not None:
        flags.refuse("--save belongs to pictures of the running cell: leave --pictures out, or --save")
    cell = cells.load(options.cell)
    outcome.destination(options)
    camera, board = cell.one("cameras", options.camera), Board.of(options)
    console = Console(highlight=False, soft_wrap=True, stderr=options.json)
    coverage = views.Coverage(board, cell.cameras[camera].lens)
    if options.pictures is not None:
        found, without, size = views.read(options.pictures, board)
        if without:
            console.print(f"[yellow]note[/] the board is not found in {len(without)} pictures: {escape(', '.join(without))}")
    else:
        found = _watched(cell, camera, board, coverage, options, console)
        size = (cell.cameras[camera].width, cell.cameras[camera].height)
    result = intrinsics.calibrate(board, found, *size)
    coverage = views.Coverage(board, result.lens)  # tilts with the lens just found
    for view in found:
        coverage.add(view)
    _show(console, camera, result, coverage.missing())
    if size != (cell.cameras[camera].width, cell.cameras[camera].height):
        console.print(f"[yellow]note[/] width and height change as well: the camera must publish {size[0]} x {size[1]}")
    outcome.store(options, camera, values(result), {}, lambda line: console.print(escape(line)))
    if options.json:
        print(json.dumps(describe(result)))


def _watched(
    cell: cells.Cell, camera: str, board: Board, coverage: views.Coverage, options: flags.Options, console: Console
) -> list[intrinsics.View]:
    def is_wanted(still: live.Still) -> bool:
        if adds := coverage.adds(still.view):
            coverage.add(still.view)
        return adds

    def what_next() -> str:
        return "; ".join(coverage.missing()) or "any other view: turn or move it"

    console.print(f"Hold the board before camera {camera}, still for a moment at each place; Ctrl-C ends early.")
    with live.watcher(cell, bus.connection(options), board, camera) as watcher:
        taken = live.collect(watcher, is_wanted, options.views, what_next, lambda line: console.print(escape(line)))
    if options.save is not None:
        views.save(options.save, ((still.view.name, still.image, None) for still in taken), ())
    if not taken:
        raise CalibrationError("no view was taken: the board must be seen and held still")
    return [still.view for still in taken]


def values(result: Intrinsics) -> dict[str, str]:
    """The values in the cell file, as YAML. The last digit is below a tenth of any uncertainty."""
    lens = result.lens
    focal = {name: f"{getattr(lens, name):.3f}" for name in intrinsics.NAMES[:4]}
    bends = {name: f"{getattr(lens, name):.6f}" for name in intrinsics.NAMES[4:]}
    return {"width": str(lens.width), "height": str(lens.height), **focal, **bends}


def describe(result: Intrinsics) -> dict[str, Any]:
    """A result as JSON."""
    return {
        "width": result.lens.width,
        "height": result.lens.height,
        **{name: {"value": getattr(result.lens, name), "deviation": result.deviation[name]} for name in intrinsics.NAMES},
        "rms_px": result.rms_px,
        "residuals_px": result.residuals,
        "left_out_px": result.left_out,
    }


def _show(console: Console, camera: str, result: Intrinsics, missing: list[str]) -> None:
    table = Table("", "value", "+-", box=None, title=f"camera {escape(camera)}: {len(result.residuals)} views")
    for name in intrinsics.NAMES:
        digits = 2 if name in intrinsics.NAMES[:4] else 5
        table.add_row(name, f"{getattr(result.lens, name):.{digits}f}", f"{result.deviation[name]:.{digits}f}")
    console.print(table)
    worst = max(result.residuals, key=lambda name: result.residuals[name])
    console.print(f"residual {result.rms_px:.3f} px; largest {result.residuals[worst]:.3f} px in {escape(worst)}")
    for name, residual in result.left_out.items():
        console.print(f"[yellow]note[/] {escape(name)} is left out: it does not fit the others, {residual:.2f} px")
    if result.rms_px > GOOD_PX:
        console.print(
            f"[yellow]note[/] more than {GOOD_PX:g} px: is the board flat and sharp in all pictures, and the focus fixed?"
        )
    if result.deviation["fx"] > GOOD_FOCUS * result.lens.fx:
        console.print("[yellow]note[/] the focal length is uncertain: take more views, near ones and tilted ones")
    for what in missing:
        console.print(f"[yellow]note[/] no view of {escape(what)}")
