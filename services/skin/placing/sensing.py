"""Computes the information of pads at given places about a limb, per scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from penumbra.services.progress import track
from penumbra.services.skin.placing.scenes import GAP, Drawing, Room, Scenes
from penumbra.services.skin.placing.shading import Shading, behind, beside
from penumbra.shared.body.anatomy import SIZE
from penumbra.shared.body.robot import RobotModel
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import Pad
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin import bound
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import Network, Response, fingerprint, networks

SAMPLES = 20
"""Number of samples (one per millisecond) in a window of `penumbra haptics`, for whose poses the errors are expected."""
BEHIND = -0.15
"""Minimum cosine between the pad's normal and the direction to the limb's nearest point: beyond it the limb is not felt, and
field models are fitted only up to there (`penumbra skin model`)."""
FEWEST = 12
"""Minimum number of scenes in which a limb must be felt from a useful place."""
MEASURED = 30
"""Number of limbs for which the effect of other links is computed."""
RANGES = 1.7
"""Maximum gap, in ranges of a pad, at which a limb is used for the model of a place: beyond it the signal is lost in the
noise."""


def meeting(drawing: Drawing, scenes: Scenes, pads: tuple[Pad, ...]) -> tuple[Array, NDArray[np.bool_]]:
    """Gaps (n, p) [m] from the middles of pads to the limb, and whether (n, p) it is before them."""
    gaps, before = np.empty((len(scenes), len(pads))), np.empty((len(scenes), len(pads)), bool)
    for k, (T, T_pads) in enumerate(zip(scenes.targets, scenes.pads(pads), strict=True)):
        middles = (T_pads[:, :3, 3] - T[:3, 3]) @ T[:3, :3]
        gaps[k], nearest, _ = drawing.surface.nearest(middles)
        toward = np.einsum("pi,pi->p", (nearest - middles) @ T[:3, :3].T, T_pads[:, :3, 2])
        before[k] = toward >= BEHIND * gaps[k]
    return gaps, before


def is_useful(gaps: Array, before: NDArray[np.bool_], reach: float) -> NDArray[np.bool_]:
    """Whether (p,) a limb is felt from a place in enough scenes."""
    return np.asarray((before & (gaps < reach)).sum(axis=0) >= FEWEST)


@dataclass(frozen=True)
class Sensing:
    """Pads of one design at their places, with the field model of each one's mounting."""

    drawing: Drawing
    pads: tuple[Pad, ...]
    skin: Skin
    response: Response
    size: Array

    @property
    def prior(self) -> Array:
        """Prior information (8, 8) about pose and size."""
        return bound.prior(self.drawing.target)

    def information(self, scenes: Scenes) -> Array:
        """Fisher information (n, p, 8, 8) of a window about pose and size."""
        before = meeting(self.drawing, scenes, self.pads)[1]
        out = np.empty((len(scenes), len(self.pads), 8, 8))
        for k, (T, T_pads) in enumerate(zip(scenes.targets, scenes.pads(self.pads), strict=True)):
            out[k] = bound.information(self.skin, self.response, T_pads, T, self.size, SAMPLES)
        out[~before] = 0.0
        return out

    def errors(self, scenes: Scenes) -> Array:
        """Expected errors (n,) [m] of the position, by the Cramér-Rao bound."""
        return bound.position_error(self.prior + self.information(scenes).sum(axis=1))


class FieldModels:
    """Field models of one type of pad (a key of `pad_types`) of a cell for a target, at any places. Raises CellError if there is
    no model of a bare pad."""

    def __init__(self, cell: cells.Cell, target: str, kind: str, models: Mapping[str, RobotModel]):
        self._cell, self._target, self._models = cell, target, models
        self._known = networks(cell)
        self.size: Array = SIZE if cell.targets[target].size is None else np.zeros(2)
        place = Pad(type=kind, position=(0.0, 0.0, 0.0))
        bare = fingerprint(_with(cell, (place,)), _name(0), target)
        if bare not in self._known:
            raise cells.CellError(
                f"cell {cell.name}: no field model of a bare pad {kind} for target {target}; fit it once: put a pad of this type "
                "on the world (without `backed`) into a copy of the cell file, and run penumbra skin model --cell COPY"
            )
        self._bare, self._kind = self._known[bare], cell.pad_types[kind]

    def sensing(self, drawing: Drawing, pads: tuple[Pad, ...], scenes: Scenes) -> Sensing:
        """Pads with their field models; models of backed pads are made for the limbs of these scenes."""
        cell = _with(self._cell, pads)
        gaps, before = meeting(drawing, scenes, pads)
        known = dict(self._known)
        backed = [k for k, pad in enumerate(pads) if pad.backed]
        for k in track(backed, "field models of pads before links") if backed else ():
            known[fingerprint(cell, _name(k), self._target)] = self._before_link(pads[k], scenes, gaps[:, k], before[:, k])
        return Sensing(drawing, pads, Skin(cell), Response(cell, self._target, known), self.size)

    def taken(self, drawing: Drawing, pads: tuple[Pad, ...], scenes: Scenes, room: Room) -> float | None:
        """Median share of the signals of backed pads that other links take; no field model contains it. It is computed in the
        middle of the joints' bounds, for the limbs of these scenes that keep clear there. None if no such pad feels one."""
        links = {name: T[0] for name, T in drawing.middle.items()}
        clear = [T for T in scenes.targets if drawing.gaps(T, drawing.middle, room)[0] >= GAP][:MEASURED]
        meshes = {f"{robot}/{link}": mesh for robot, model in self._models.items() for link, mesh in model.meshes.items()}
        middle = Scenes(np.array(clear), {name: np.tile(T, (len(clear), 1, 1)) for name, T in links.items()})
        if not clear or not any(pad.backed for pad in pads):
            return None
        gaps, before = meeting(drawing, middle, pads)
        felt, shares = before & (gaps < self._kind.range), []
        for k in track([k for k, pad in enumerate(pads) if pad.backed and felt[:, k].any()], "what other links take"):
            own = behind(meshes[pads[k].link], pads[k].T_link_pad)
            T = rigid.inverse(links[pads[k].link] @ pads[k].T_link_pad) @ middle.targets[felt[:, k]]
            alone, among = (self.shading.ratio(each, T) for each in (own, own + beside(meshes, links, pads[k])))
            shares.append(1.0 - np.exp(among - alone))
        return float(np.median(np.concatenate(shares))) if shares else None

    @cached_property
    def shading(self) -> Shading:
        return Shading(self._cell, self._kind, self._target, self._bare, self.size)

    def _before_link(self, pad: Pad, scenes: Scenes, gaps: Array, before: NDArray[np.bool_]) -> Network:
        robot, _, link = pad.link.partition("/")
        felt = np.flatnonzero(before & (gaps < RANGES * self._kind.range))
        if not len(felt):
            return self._bare  # its information is zero: see `Sensing.information`
        T_pad_world = np.stack([rigid.inverse(T @ pad.T_link_pad) for T in scenes.links[pad.link][felt]])
        backing = behind(self._models[robot].meshes[link], pad.T_link_pad)
        return self.shading.network(backing, T_pad_world @ scenes.targets[felt], gaps[felt])


def _name(place: int) -> str:
    return f"p{place}"


def _with(cell: cells.Cell, pads: Sequence[Pad]) -> cells.Cell:
    """The cell with only these pads."""
    return cell.model_copy(update={"pads": {_name(k): pad for k, pad in enumerate(pads)}})
