"""`penumbra skin place`: proposes where a cell's pads should sit, and how many, by the Cramér-Rao bound of their field model."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from penumbra.services import flags
from penumbra.services.skin.placing.layout import FRESH, Placing, Step, Wish, summary
from penumbra.services.skin.placing.sensing import SAMPLES
from penumbra.shared.cell import description as cells
from penumbra.shared.cell import edit
from penumbra.shared.cell.pads import Pad
from penumbra.shared.geometry.rigid import Array

LEFT_OUT = (
    "The bound leaves out: links beside the one behind a pad, which take signal and give one by themselves; other objects; other "
    "poses, far from the true one, that would be felt alike; wiring; whether the mesh is the hull, and a board can be mounted "
    "there; collisions of a pad with what the robot works on."
)


@flags.command(
    "skin place",
    "Proposes places for pads by what they could tell about the target's position at most (the Cramér-Rao bound of the field "
    "model with its noise, of one window of voltages), and compares them with the present ones.",
    flags.CELL,
    flags.Option("--target", show_default="the cell's first", help="the limb"),
    flags.Option(
        "--links",
        takes="many",
        metavar="LINK ...",
        show_default="those with pads, else all",
        help="where pads may sit: ROBOT/LINK, LINK, or world, the plane of the pads there",
    ),
    flags.Option("--number", type=flags.positive, metavar="N", show_default="as many as now, else 8", help="pads to place"),
    flags.Option(
        "--workspace",
        type=flags.number,
        takes="many",
        metavar="X Y Z X Y Z",
        show_default="around the target's home",
        help="two corners of a box in the world: where the limb's middle may be [m]",
    ),
    flags.Option(
        "--range",
        type=flags.above_zero,
        metavar="M",
        show_default="that of the pads",
        help="largest gap from the limb to the nearest possible place: limbs farther away do not count",
    ),
    flags.Option(
        "--joints",
        type=flags.number,
        takes="many",
        metavar="RAD ...",
        show_default="the bounds of `sim`",
        help="all robots' joints, where the robot stands still while it works",
    ),
    flags.Option("--seed", type=int, default=0, help="draws limbs and postures"),
    flags.Option("-o", "--out", type=Path, metavar="FILE.png", help="write maps of the expected error, present beside proposed"),
    flags.Option("--write", type=Path, metavar="FILE", help="write the cell with the proposed pads there; comments are kept"),
    flags.JSON,
    example="penumbra skin place --cell arm --links panda_link5 panda_link6 panda_hand -o pads.png",
)
def main(options: flags.Options) -> int:
    """Run the command; returns 0, or 2 for an unusable cell or wish."""
    try:
        _place(options)
    except (cells.CellError, OSError) as error:
        for line in str(error).splitlines():
            print(f"penumbra skin place: {line}", file=sys.stderr)
        return 2
    return 0


def _place(options: flags.Options) -> None:
    cell = cells.load(options.cell)
    if options.out is not None and options.out.suffix.lower() != ".png":
        raise cells.CellError(f"--out: expected a file that ends in .png, got {options.out}; give another name")
    placing = Placing(cell, _wish(options))
    if options.write is not None:
        _refuse_fewer(cell, placing.number)
    proposed, steps = placing.choose()
    layouts = {"proposed": proposed}
    if placing.present:
        layouts = {"present": placing.sensing(tuple(placing.present.values())), **layouts}
    errors = {name: sensing.errors(placing.fresh) for name, sensing in layouts.items()}
    taken = {name: placing.taken(sensing) for name, sensing in layouts.items()}
    named = names(tuple(cell.pads), proposed.pads)
    if options.json:
        print(json.dumps(_result(placing, errors, taken, steps, named)))
    else:
        console = Console(highlight=False, soft_wrap=True)
        _show(console, placing, errors, steps, named)
        _warn(console, taken, named)
    if options.out is not None:
        from penumbra.services.skin.placing import picture  # importing matplotlib takes a second

        picture.write(options.out, placing, {f"{len(each.pads)} pads, {name}": each for name, each in layouts.items()})
        print(f"{options.out}: maps of the expected error", file=sys.stderr)
    if options.write is not None:
        written = {name: line(pad, cell.pads.get(name)) for name, pad in named.items()}
        edit.write(options.write, edit.with_values(cells.source(options.cell), ("pads",), written))
        print(f"{options.write}: {len(named)} pads written; calibrate them there", file=sys.stderr)


def _wish(options: flags.Options) -> Wish:
    corners = options.workspace
    if corners and len(corners) != 6:
        raise cells.CellError(f"--workspace: expected 6 numbers, x y z of two corners [m], got {len(corners)}")
    box = None
    if corners:
        box = np.sort(np.reshape(corners, (2, 3)), axis=0)
    joints = tuple(options.joints) or None
    return Wish(options.target, tuple(options.links), options.number, box, options.range, joints, options.seed)


def _refuse_fewer(cell: cells.Cell, number: int) -> None:
    if not cell.pads or number < len(cell.pads):
        raise cells.CellError(
            f"--write: expected at least as many pads as the {len(cell.pads)} of the cell file, and one there already, got "
            f"{number}; leave --write out, and put the printed pads into the file by hand"
        )


# ---- the pads as YAML


def names(old: Sequence[str], pads: Sequence[Pad]) -> dict[str, Pad]:
    """Name pads by the old names, and by new names if there are more pads."""
    fresh = (name for k in range(len(old) + len(pads)) if (name := f"p{k}") not in old)
    return {(old[k] if k < len(old) else next(fresh)): pad for k, pad in enumerate(pads)}


def line(pad: Pad, before: Pad | None = None) -> str:
    """A pad as YAML in one line, with the boards of the pad that it replaces."""
    values: dict[str, Any] = {"type": pad.type, "link": pad.link, "position": list(pad.position), "rpy": list(pad.rpy)}
    if pad.link == "world":
        del values["link"]
    if not any(pad.rpy):
        del values["rpy"]
    if pad.backed:
        values["backed"] = True
    if before is not None and before.boards:
        values["boards"] = [board.model_dump(mode="json", exclude_none=True) for board in before.boards]
    return yaml.safe_dump(values, default_flow_style=True, sort_keys=False, width=10_000).strip()


# ---- what is shown


def _result(
    placing: Placing,
    errors: Mapping[str, Array],
    taken: Mapping[str, float | None],
    steps: Sequence[Step],
    named: Mapping[str, Pad],
) -> dict[str, Any]:
    return {
        "cell": placing.cell.name,
        "target": placing.target,
        "links": list(placing.links),
        "seed": placing.wish.seed,
        "scenes": FRESH,
        **{
            name: {"pads": _count(placing, name, named), **summary(each), "taken_by_other_links": taken[name]}
            for name, each in errors.items()
        },
        "steps": [step.summary() for step in steps],
        "pads": {name: yaml.safe_load(line(pad)) for name, pad in named.items()},
        "left_out": LEFT_OUT,
    }


def _count(placing: Placing, layout: str, named: Mapping[str, Pad]) -> int:
    return len(placing.present) if layout == "present" else len(named)


def _show(
    console: Console, placing: Placing, errors: Mapping[str, Array], steps: Sequence[Step], named: Mapping[str, Pad]
) -> None:
    console.print(
        f"Expected error of the position of {placing.target}, at best: one window of {SAMPLES} ms, without a camera, {FRESH} "
        f"poses within {100 * placing.reach:g} cm of a possible place, seed {placing.wish.seed}."
    )
    table = Table("", "pads", "median cm", "95 % below cm", "within 2 cm", box=None, padding=(0, 2, 0, 0))
    for name, each in errors.items():
        table.add_row(name, str(_count(placing, name, named)), *_cells(summary(each)))
    table.add_section()
    for step in steps:
        more = "with fewer" if step.pads < len(named) else "with more" if step.pads > len(named) else "proposed"
        if more != "proposed":
            table.add_row(more, str(step.pads), *_cells(step.summary()))
    console.print(table)
    console.print("\npads:", markup=False)
    for name, pad in named.items():
        console.print(f"  {name}: {line(pad, placing.cell.pads.get(name))}", markup=False)
    console.print()


def _warn(console: Console, taken: Mapping[str, float | None], named: Mapping[str, Pad]) -> None:
    """Print what the numbers leave out, and what to do with new pads."""
    known = [f"{100 * share:.0f} % of the signals of the {name} pads" for name, share in taken.items() if share is not None]
    if known:
        console.print(f"Not counted: other links than the one behind a pad take {', '.join(known)} (median).")
    if any(pad.backed for pad in named.values()):
        console.print("Each new place before a link needs its field model: penumbra skin model --cell FILE.")
    console.print(LEFT_OUT)


def _cells(row: Mapping[str, float]) -> tuple[str, str, str]:
    return f"{row['median_cm']:.2f}", f"{row['p95_cm']:.2f}", f"{100 * row['within_2_cm']:.0f} %"
