"""The boundary-element fields of a built-in cell's pads as they are mounted: before links, or among the boards beside them."""

from __future__ import annotations

import functools

import numpy as np

from penumbra.services.skin.model import mountings
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.response import fingerprint
from penumbra.sim.skin.field import Body, PadField


@functools.cache
def fields(name: str) -> tuple[PadField, ...]:
    """In the order of the pads."""
    cell = cells.load(name)
    target = next(iter(cell.targets))
    known = {each.fingerprint: PadField(each.kind, each.backing) for each in mountings(cell, target)}
    return tuple(known[fingerprint(cell, pad, target)] for pad in cell.pads)


def changes(name: str, T_world_pads: Array, body: Body, T: Array) -> Array:
    """Changes (n,) [fF] at all electrodes by a body at T (4, 4), with the pads at T_world_pads (p, 4, 4)."""
    own = zip(fields(name), T_world_pads, strict=True)
    return np.concatenate([field.change(body, rigid.inverse(pad) @ T) for field, pad in own])
