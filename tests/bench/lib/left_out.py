"""What surrounds a pad and the forearm before it changes of the signals, and how much of that the runtime field model leaves out.

Here boundary elements have more in one system, so that everything shades everything: upper arm and torso, one conductor with the
forearm, and the three boards that surround one of the table's, with their rings held at zero (boards that are driven one after
the other) or driven with its own. The runtime model contains upper arm and torso (`shared.skin.bearer`), but no other boards.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.progress import Progress
from rich.table import Table

from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import Response
from penumbra.sim.skin.field import Body, PadField, Panels, limb, shell
from penumbra.sim.world.person import Person
from penumbra.tests.bench.lib.results import Result

GAPS = (0.02, 0.05, 0.10, 0.15, 0.20)
POSES = 6
"""Number of poses of the forearm at each gap."""
PAD, BESIDE = "p1", ("p2", "p5", "p6")
"""The pad at which the effect of neighbouring boards is solved, and these boards."""
SHIFT, TURN = (0.06, 0.03), (0.3, 0.12, 0.26)
"""Bounds of the forearm's displacement along and across from the pads' middle [m], and of its roll, pitch and yaw [rad]."""
PERSON = ("upper arm", "upper arm and torso")
LEFT = "what the networks leave of upper arm and torso"
BOARDS = ("three boards beside, not driven", "three boards beside, driven together")


def measure(cell: cells.Cell, seed: int, progress: Progress) -> list[dict[str, Any]]:
    """Rows by part and gap: relative changes of the signals by its presence."""
    target = next(iter(cell.targets))
    assert cell.sim is not None, f"cell {cell.name}: expected a `sim` section"
    person, skin = Person(cell, cell.sim, cell.targets[target]), Skin(cell)
    forearm, *others = person.meshes
    response = Response(cell, target)
    bodies = [limb(forearm).panels.corners, *(shell(mesh.vertices).corners for mesh in others)]
    surface, alone = Surface(forearm.vertices, forearm.faces), Body(Panels(bodies[0]))
    pads = dict(zip(skin.pads, skin.T_world_pads(), strict=True))
    kind = cell.pad_types[cell.pads[PAD].type]
    bare = PadField(kind)
    beside = [rigid.inverse(pads[PAD]) @ pads[name] for name in BESIDE]
    boards = [PadField(kind, beside=beside, is_driven=is_driven) for is_driven in (False, True)]
    shares: dict[tuple[str, float], list[Array]] = {}
    for gap in progress.track(GAPS, description="what is left out"):
        for k in range(POSES):
            T = _place(np.random.default_rng([seed, k]), gap, surface, skin.positions(skin.T_world_pads()))
            T_target_parts = [rigid.inverse(T) @ part for part in person.poses(T)]
            parts = [rigid.apply(*each) for each in zip(T_target_parts, bodies, strict=True)]
            usual = {name: bare.change(alone, rigid.inverse(pad) @ T) for name, pad in pads.items()}
            for count, name in enumerate(PERSON, start=2):
                body = Body(Panels(np.concatenate(parts[:count])))
                found = [bare.change(body, rigid.inverse(pad) @ T) / usual[own] - 1.0 for own, pad in pads.items()]
                shares.setdefault((name, gap), []).extend(found)
            parts, placed = person.poses(T), np.stack(list(pads.values()))
            known = response.person(placed, parts) / response.person(placed, parts[:1])
            shares.setdefault((LEFT, gap), []).append((1.0 + np.concatenate(found)) / known - 1.0)
            for name, field in zip(BOARDS, boards, strict=True):
                found = [field.change(alone, rigid.inverse(pads[PAD]) @ T) / usual[PAD] - 1.0]
                shares.setdefault((name, gap), []).extend(found)
    return [_row(name, gap, np.concatenate(found)) for (name, gap), found in shares.items()]


def _place(rng: np.random.Generator, gap: float, surface: Surface, electrodes: Array) -> Array:
    """A random pose (4, 4) of the forearm at a gap above electrodes (n, 3) [m] in a horizontal table."""
    shift, turn = rng.uniform(-1.0, 1.0, 2) * SHIFT, rng.uniform(-1.0, 1.0, 3) * TURN
    T = rigid.from_rpy((*shift, 0.25), turn)
    for _ in range(12):
        T[2, 3] += gap - float(surface.nearest((electrodes - T[:3, 3]) @ T[:3, :3])[0].min())
    return T


def _row(name: str, gap: float, share: Array) -> dict[str, Any]:
    low, middle, high = (round(float(np.percentile(share, p)), 4) for p in (5, 50, 95))
    return {"left_out": name, "gap_m": gap, "p5": low, "median": middle, "p95": high}


def table(result: Result) -> Table:
    """Medians and ranges of the changes by part and gap."""
    out = Table(
        *("part", *(f"{100 * gap:g} cm" for gap in GAPS)),
        title="What surrounds the pads and the forearm, share of the signal: median (5 % to 95 %)",
        caption=f"The forearm at {POSES} random poses a gap; of the person at all pads, of the boards at {PAD}.",
    )
    for name in (*PERSON, LEFT, *BOARDS):
        rows = [row for row in result["left_out"] if row["left_out"] == name]
        out.add_row(name, *(f"{row['median']:+.1%} ({row['p5']:+.1%} to {row['p95']:+.1%})" for row in rows))
    return out
