"""`penumbra up`, from its start: the fork server imports its modules while the launcher imports its own."""

from __future__ import annotations

import click

from penumbra.services import flags
from penumbra.services.launcher.forkserver import ForkServer
from penumbra.shared.contract.processes import PROCESSES, VISION


def _number_of(text: str) -> tuple[str, int]:
    name, _, number = text.partition("=")
    if not number.isdecimal():
        raise ValueError(f"expected NAME=NUMBER, as in segmentation=2, got {text!r}")
    return name, int(number)


def _complete_number(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[click.shell_completion.CompletionItem]:
    return [click.shell_completion.CompletionItem(f"{item.value}=") for item in flags.complete_service(ctx, param, incomplete)]


PARAMS = (
    flags.CELL,
    flags.Option("--port", type=flags.port, show_default="7447", help="TCP port of the router"),
    flags.Option(
        "--connect",
        multiple=True,
        metavar="ENDPOINT",
        show_default="without --port, $PENUMBRA_CONNECT",
        help="use a router that runs elsewhere, and start none; may be repeated",
    ),
    flags.Option("--seconds", type=flags.seconds, default=float("inf"), show_default="at Ctrl-C", help="stop after this time"),
    flags.Option("--keep-going", is_flag=True, help="let the others run where a process does not start"),
    flags.Option(
        "--detach",
        is_flag=True,
        help="run in the background: returns once the cell is tracking, or says why it is not; see penumbra ps, logs and down",
    ),
    flags.Option("--open", is_flag=True, help="open the web page in the browser"),
    flags.Option("--notify", type=int, hidden=True, help="descriptor to which a launcher in the background reports its start"),
    flags.Option("--vision", choices=VISION, default=VISION[0], help="segmentation and search, or PoseCNN"),
    *(
        flags.Option(
            f"--{flag.name}",
            type=flag.type,
            choices=flag.choices,
            help=f"{flag.about} (see penumbra {process.name} --help)",
        )
        for process in PROCESSES
        for flag in process.flags
    ),
    *(
        flags.Option(
            f"--{process.starter.name}",
            takes="maybe",
            without=process.starter.without,
            metavar=process.starter.value,
            help=f"{process.starter.about} (see penumbra {process.name} --help)",
        )
        for process in PROCESSES
        if process.starter is not None
    ),
    flags.Option(
        "--replicas",
        type=_number_of,
        multiple=True,
        metavar="NAME=N",
        shell_complete=_complete_number,
        help="run N of a process; 0 leaves it out; `penumbra scale` changes it later",
    ),
    flags.SECURE,
    flags.METRICS,
    *flags.LOG,
)
"""Its own flags, and those that the table of processes lets it pass on."""


@flags.command(
    "up",
    "Starts every process of a cell around a router, and shows what they do. Exit code 0: well; 1: a process did not start or "
    "had failed at the end, or no pose was tracked within --seconds; 2: it could not start.",
    *PARAMS,
    example="penumbra up --cell table\n"
    "penumbra up --cell arm --port 7557 --replicas segmentation=2\n"
    "penumbra up --detach && penumbra logs -f",
)
def main(options: flags.Options) -> int:
    """Start the fork server before the launcher is imported."""
    if options.detach:
        from penumbra.services.launcher import background
        from penumbra.shared.cell import description

        return background.start(description.load(options.cell).name, flags.words())
    forkserver = ForkServer()
    forkserver.start()
    try:
        from penumbra.services.launcher import launch

        return launch.run(options, forkserver)
    finally:
        forkserver.stop()
