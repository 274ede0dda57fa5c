"""The commands of the calibration, each imported on demand."""

from __future__ import annotations

import importlib

import click

from penumbra.services import flags

COMMANDS = {
    "board": ("print the board to a PDF at its exact size", "sheet"),
    "camera": ("intrinsics and distortion of a camera, from views of the board", "camera"),
    "hand-eye": ("where a camera stands, from views of the board on a robot's flange", "robot"),
}
"""Help text and module of each command."""


class Calibrate(flags.Group):
    """The group of the calibration commands."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        found: click.Command = importlib.import_module(f"penumbra.services.calibrate.{COMMANDS[name][1]}").main
        return found

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, about) for name, (about, _) in COMMANDS.items()])


main = Calibrate(
    "calibrate",
    "penumbra calibrate board -o board.pdf\n"
    "penumbra calibrate camera --cell mine.yaml --pictures lens\n"
    "penumbra calibrate hand-eye --cell mine.yaml --pictures poses",
    help="Measures a camera's lens, and where it stands beside a robot, and writes both into the cell file.",
)
