"""`penumbra calibrate hand-eye`: where a camera stands, from views of a board that a robot of the cell carries."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from penumbra.services import flags
from penumbra.services.calibrate import board as boards
from penumbra.services.calibrate import hand_eye, live, outcome, views
from penumbra.services.calibrate.board import Board, CalibrationError
from penumbra.services.calibrate.hand_eye import HandEye, LeftOne, Pair
from penumbra.services.calibrate.intrinsics import View
from penumbra.shared.body.robot import RobotModel
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.runtime import bus

ANOTHER = 0.06
"""Minimum turn [rad] of some joint that makes another pose of the robot."""
GOOD_M, GOOD_RAD = 0.003, math.radians(0.3)
"""Standard deviations of the camera's pose above which the result is called poor."""


@flags.command(
    "calibrate hand-eye",
    "Measures where a camera stands beside a robot, and writes it into the cell file. Fix the board to the robot's flange, and "
    "show it to the camera in 15 to 25 poses that turn it about several axes; calibrate the lens before. From a running cell it "
    "takes a picture in each new pose in which the robot stands still.",
    outcome.CAMERA,
    flags.Option("--robot", shell_complete=flags.complete_part("robots"), show_default="its first", help="of the cell"),
    flags.Option("--link", metavar="NAME", show_default="that of the robot's last joint", help="link that the board is fixed to"),
    outcome.FOLDER,
    flags.Option(
        "--joints",
        type=Path,
        metavar="FILE",
        show_default=f"{views.JOINTS} beside the pictures",
        help="CSV of the columns picture and every joint's name",
    ),
    flags.Option("--degrees", is_flag=True, help="the file's angles are degrees"),
    flags.Option("--poses", type=flags.positive, default=20, metavar="N", help="poses to take from the running cell"),
    outcome.SAVE,
    *outcome.WRITING,
    *boards.FLAGS,
    boards.MEASURED,
    *flags.MEASURING,
    example="penumbra calibrate hand-eye --cell mine.yaml --pictures poses --dry-run\n"
    "penumbra calibrate hand-eye --cell mine.yaml --camera front --robot panda --save poses",
)
def main(options: flags.Options) -> int:
    """Run the command; returns 0, or 2 for wrong views, joints or a wrong cell file."""
    return outcome.guarded("hand-eye", lambda: _calibrate(options))


def _calibrate(options: flags.Options) -> None:
    if options.pictures is not None and options.save is not None:
        flags.refuse("--save belongs to pictures of the running cell: leave --pictures out, or --save")
    if options.pictures is None and (options.joints is not None or options.degrees):
        flags.refuse("--joints and --degrees belong to --pictures: give a folder, or leave them out")
    cell = cells.load(options.cell)
    outcome.destination(options)
    camera, robot, board = cell.one("cameras", options.camera), cell.one("robots", options.robot), Board.of(options)
    model = RobotModel(cell.robots[robot], cell.folder)
    link = carrier(model, options.link)
    console = Console(highlight=False, soft_wrap=True, stderr=options.json)
    if options.pictures is not None:
        posed = _from_folder(cell.cameras[camera], board, model, options, console)
    else:
        posed = _watched(cell, camera, robot, board, options, console)
    lens = cell.cameras[camera].lens
    pairs = [Pair.of(view, model.link_transforms(q)[link], board, lens) for view, q in posed]
    result = hand_eye.solve(pairs)
    _show(console, camera, robot, link, result)
    outcome.store(options, camera, values(result), {"rpy": "look_at"}, lambda line: console.print(escape(line)))
    if options.json:
        print(json.dumps(describe(result)))


def carrier(model: RobotModel, name: str | None) -> str:
    """The link that carries the board; by default the last one that a joint of the cell moves. Raises CalibrationError."""
    if name is None:
        return {joint.name: joint.child for joint in model.description.joints}[model.joints[-1]]
    if name not in model.links:
        raise CalibrationError(f"--link: expected one of {', '.join(model.links)}, got {name!r}")
    return name


def _from_folder(
    camera: cells.Camera, board: Board, model: RobotModel, options: flags.Options, console: Console
) -> list[tuple[View, Array]]:
    path = options.joints or options.pictures / views.JOINTS
    joints = views.read_joints(path, model.joints, (model.lower, model.upper), options.degrees)
    found, without, size = views.read(options.pictures, board)
    if size != (camera.width, camera.height):
        raise CalibrationError(
            f"{options.pictures}: expected pictures of {camera.width} x {camera.height} as in the cell file, "
            f"got {size[0]} x {size[1]}"
        )
    for names, what in (
        (without, "the board is not found in"),
        ([v.name for v in found if v.name not in joints], "no joints of"),
    ):
        if names:
            console.print(f"[yellow]note[/] {what} {len(names)} pictures: {escape(', '.join(names))}")
    return [(view, joints[view.name]) for view in found if view.name in joints]


def _watched(
    cell: cells.Cell, camera: str, robot: str, board: Board, options: flags.Options, console: Console
) -> list[tuple[View, Array]]:
    known: list[Array] = []

    def is_wanted(still: live.Still) -> bool:
        q = still.joints
        if q is None or any(np.abs(q - other).max() < ANOTHER for other in known):
            return False
        known.append(q)
        return True

    def what_next() -> str:
        return "move the robot to another pose that turns the board, and let it stand"

    console.print(f"Move robot {robot} so that camera {camera} sees the board, and let it stand in each pose; Ctrl-C ends early.")
    with live.watcher(cell, bus.connection(options), board, camera, robot) as watcher:
        taken = live.collect(watcher, is_wanted, options.poses, what_next, lambda line: console.print(escape(line)))
    if options.save is not None:
        pictures = ((still.view.name, still.image, still.joints) for still in taken)
        views.save(options.save, pictures, cell.robots[robot].joints)
    return [(still.view, still.joints) for still in taken if still.joints is not None]


def values(result: HandEye) -> dict[str, str]:
    """The values in the cell file, as YAML: to a hundredth of a millimetre and of a tenth of a degree."""
    position, orientation = rigid.position_orientation(result.T_world_camera)
    metres, radians = result.spread
    return {
        "position": f"[{', '.join(f'{each:.5f}' for each in position)}]",
        "rpy": f"[{', '.join(f'{each:.6f}' for each in rigid.rpy(orientation))}]",
        "pose_spread": f"{{position: {max(metres, 1e-6):.6f}, rotation: {max(radians, 1e-6):.6f}}}",
    }


def describe(result: HandEye) -> dict[str, Any]:
    """A result as JSON."""
    metres, radians = result.spread

    def residuals(of: dict[str, LeftOne]) -> dict[str, Any]:
        return {name: {"px": one.rms_px, "m": one.distance, "rad": one.angle} for name, one in of.items()}

    return {
        "T_world_camera": result.T_world_camera.tolist(),
        "T_link_board": result.T_link_board.tolist(),
        "deviation": {"position": metres, "rotation": radians},
        "covariance": result.covariance.tolist(),
        "rms_px": result.rms_px,
        "leave_one_out": residuals(result.residuals),
        "left_out": residuals(result.left_out),
        "notes": list(result.notes),
    }


def _show(console: Console, camera: str, robot: str, link: str, result: HandEye) -> None:
    table = Table("pose", "px", "mm", "deg", "", box=None, title="each pose as the others predict it")
    rows = [(name, one, "") for name, one in result.residuals.items()]
    rows += [(name, one, "[yellow]left out[/]") for name, one in result.left_out.items()]
    for name, one, note in sorted(rows, key=lambda row: row[0]):
        table.add_row(escape(name), f"{one.rms_px:.2f}", f"{1e3 * one.distance:.2f}", f"{math.degrees(one.angle):.2f}", note)
    console.print(table)
    position, orientation = rigid.position_orientation(result.T_world_camera)
    metres, radians = result.spread
    place = ", ".join(f"{each:.4f}" for each in position)
    turn = ", ".join(f"{math.degrees(each):.2f}" for each in rigid.rpy(orientation))
    console.print(
        f"camera {escape(camera)} stands at ({place}) m +- {1e3 * metres:.2f} mm in the world of robot {escape(robot)},"
    )
    console.print(f"its roll, pitch, yaw are ({turn}) deg +- {math.degrees(radians):.3f} deg; {len(result.residuals)} poses")
    board = ", ".join(f"{1e3 * each:.1f}" for each in result.T_link_board[:3, 3])
    console.print(f"the board's corner is at ({board}) mm of link {escape(link)}: does it look right?")
    for name in result.left_out:
        console.print(
            f"[yellow]note[/] {escape(name)} is left out: it does not fit the others; did the robot move, or the board slip?"
        )
    for note in result.notes:
        console.print(f"[yellow]note[/] {escape(note)}")
    is_poor = metres > GOOD_M or radians > GOOD_RAD
    words = "poor: more poses, more turned, nearer to the camera" if is_poor else "good"
    console.print(f"verdict: {words}")
