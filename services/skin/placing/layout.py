"""Finds pads for a workspace, and evaluates them and the present ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from penumbra.services.progress import track
from penumbra.services.skin.placing import candidates, sensing
from penumbra.services.skin.placing.choose import Choice
from penumbra.services.skin.placing.scenes import Drawing, Room, Scenes
from penumbra.services.skin.placing.sensing import FieldModels, Sensing
from penumbra.shared.body.robot import RobotModel, robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import Board, Pad
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

SCENES, FRESH = 160, 300
"""Number of scenes for which pads are chosen, and of other scenes on which the result is reported."""
POSTURES = 8
"""Number of robot postures in which a place must be clear of other links."""
SOLID = 0.03
"""Distance [m] between the points that represent a link from which a limb keeps clear."""
MORE = 4
"""Number of pads beyond the wanted ones whose gain is reported."""
FINE_M = 0.02
"""Error [m] up to which a limb counts as felt well."""
DIGITS = 4
"""Number of decimals of positions [m] and angles [rad] of proposed pads."""


@dataclass(frozen=True)
class Wish:
    """The user's request. links: as in `candidates.carriers`; number: of pads, as many as now if None; box (2, 3) [m]: bounds of
    the target's position; reach [m]: as in `Room`; joints: of all robots, those of the emulator if None."""

    target: str | None = None
    links: tuple[str, ...] = ()
    number: int | None = None
    box: Array | None = None
    reach: float | None = None
    joints: tuple[float, ...] | None = None
    seed: int = 0


@dataclass(frozen=True)
class Step:
    """Result for a number of pads: `errors` (n,) [m] of fresh scenes."""

    pads: int
    errors: Array

    def summary(self) -> dict[str, float]:
        return {"pads": self.pads, **summary(self.errors)}


def summary(errors: Array) -> dict[str, float]:
    """Median, 95th percentile and mean [cm] of expected errors (n,) [m], and the share of scenes in which the limb is felt
    well."""
    median, p95 = np.percentile(100.0 * errors, [50.0, 95.0])
    return {
        "median_cm": round(float(median), 2),
        "p95_cm": round(float(p95), 2),
        "mean_cm": round(float(100.0 * errors.mean()), 2),
        "within_2_cm": round(float((errors <= FINE_M).mean()), 3),
    }


class Placing:
    """A cell and a wish, with everything derived from them. Raises CellError for a wish that cannot be met."""

    def __init__(self, cell: cells.Cell, wish: Wish):
        self.cell, self.wish = cell, wish
        self.target = cell.one("targets", wish.target)
        self.models: Mapping[str, RobotModel] = robot_models(cell)
        self.links = candidates.carriers(cell, self.models, wish.links)
        self.kind = self._kind()
        self.board = cell.pad_types[self.kind].board
        self.reach = wish.reach or cell.pad_types[self.kind].range
        self.plane = candidates.plane_of(cell, self.reach) if "world" in self.links else None
        if "world" in self.links and self.plane is None:
            raise cells.CellError(
                "--links: expected a pad on the world, in whose plane others may lie, got none; add a first one to the cell file"
            )
        self.drawing = Drawing(cell, self.target, self.models, wish.box, self._joints())
        self.fields = FieldModels(cell, self.target, self.kind, self.models)

    @property
    def present(self) -> dict[str, Pad]:
        """The pads of the cell file with their designed laws, for comparison at any place."""
        designed: dict[str, Any] = {"calibration": {}, "boards": ()}
        return {name: pad.model_copy(update=designed) for name, pad in self.cell.pads.items() if pad.type == self.kind}

    @property
    def number(self) -> int:
        """Number of wanted pads."""
        return self.wish.number or len(self.present) or 8

    @cached_property
    def room(self) -> Room:
        """The region of the limb, around all possible places of pads."""
        solids = {
            f"{robot}/{link}": candidates.surface_points(mesh, SOLID)[0]
            for robot, model in self.models.items()
            for link, mesh in model.meshes.items()
        }
        plane = None if self.plane is None else self.plane.T_world_plane
        return Room(solids, plane, self._places(solids), self.reach)

    @cached_property
    def scenes(self) -> Scenes:
        """The scenes for which pads are chosen."""
        return self.drawing.draw(self.room, SCENES, self.wish.seed)

    @cached_property
    def fresh(self) -> Scenes:
        """Other scenes, for which nothing was chosen."""
        return self.drawing.draw(self.room, FRESH, self.wish.seed + 1)

    def possible(self) -> Sensing:
        """All places from which the limb is felt in enough scenes, with their field models. The present pads on the same links
        come first and are always included."""
        kept = [pad for pad in self.present.values() if pad.link in self.links]
        pads = (*kept, *(self.pad(link, T) for link, own in self.room.places.items() for T in own))
        gaps, before = sensing.meeting(self.drawing, self.scenes, pads)
        useful = sensing.is_useful(gaps, before, sensing.RANGES * self.cell.pad_types[self.kind].range)
        if not useful.any():
            raise cells.CellError(
                f"--links: expected places that face the target's workspace, got none of {len(pads)} on {', '.join(self.links)}; "
                "give other links, or another --workspace"
            )
        useful[: len(kept)] = True
        return self.sensing([pad for pad, good in zip(pads, useful, strict=True) if good])

    def sensing(self, pads: Sequence[Pad]) -> Sensing:
        return self.fields.sensing(self.drawing, tuple(pads), self.scenes)

    def taken(self, layout: Sensing) -> float | None:
        """The share of a layout's signals that links other than those behind the pads take, see `FieldModels.taken`."""
        return self.fields.taken(self.drawing, layout.pads, self.fresh, self.room)

    def pad(self, link: str, T_link_pad: Array) -> Pad:
        """A pad at a place. On a link it is backed by it, unless the pads on links of this cell are not."""
        position, orientation = rigid.position_orientation(T_link_pad)
        on_links = [pad.backed for pad in self.present.values() if pad.link != "world"]
        return Pad(
            type=self.kind,
            link=link,
            position=_rounded(position),
            rpy=_rounded(rigid.rpy(orientation)),
            backed=link != "world" and (any(on_links) or not on_links),
        )

    def choose(self) -> tuple[Sensing, list[Step]]:
        """The proposed pads, and the result for each number of pads, up to MORE than wanted. Raises CellError if there is no
        room."""
        possible = self.possible()
        T = self.drawing.middle
        overlaps = candidates.overlaps(np.stack([T[pad.link][0] @ pad.T_link_pad for pad in possible.pads]), self.board)
        choice = Choice(possible.information(self.scenes), possible.prior, overlaps)
        greedy: list[int] = []
        for count in track(range(1, self.number + 1), "choosing pads"):
            greedy = choice.more(greedy, count)
            if len(greedy) == count:
                continue
            raise cells.CellError(
                f"--number: expected at most {len(greedy)} pads, for which there is room where the limb is felt, got "
                f"{self.number}; give fewer, or more --links"
            )
        starts = [greedy]
        if self.number == len(self.present) and all(pad in possible.pads for pad in self.present.values()):
            starts.append([possible.pads.index(pad) for pad in self.present.values()])
        chosen = min((choice.exchanged(start) for start in starts), key=lambda found: float(choice.errors(found).mean()))
        further = choice.more(chosen, self.number + MORE)
        fresh = Choice(possible.information(self.fresh), possible.prior, overlaps)
        orders = [greedy[:count] for count in range(1, self.number)]
        orders += [further[:count] for count in range(self.number, len(further) + 1)]
        steps = [Step(len(order), fresh.errors(order)) for order in orders]
        return self.sensing([possible.pads[k] for k in chosen]), steps

    def _kind(self) -> str:
        types = [pad.type for pad in self.cell.pads.values() if pad.link in self.links]
        types += [*(pad.type for pad in self.cell.pads.values()), *self.cell.pad_types]
        if not types:
            raise cells.CellError(f"cell {self.cell.name}: expected a design of pads, got none; add one under `pad_types`")
        return types[0]

    def _joints(self) -> Array:
        """Bounds (2, j) of all robots' joints."""
        names = [joint for model in self.models.values() for joint in model.joints]
        given, sim = self.wish.joints, self.cell.sim
        if given is not None:
            if len(given) != len(names):
                what = f"{len(names)} values ({', '.join(names)})" if names else "none, as the cell has no robot"
                raise cells.CellError(f"--joints: expected {what}, got {len(given)}; give one for each joint")
            return np.array([given, given], float)
        if names and (sim is None or not sim.joints_low):
            raise cells.CellError(
                f"--joints: expected the angles of {', '.join(names)} at which the robot works, as cell {self.cell.name} has no "
                "`sim` with their bounds; give them in radians"
            )
        return np.array([sim.joints_low, sim.joints_high]) if names and sim is not None else np.zeros((2, 0))

    def _places(self, solids: Mapping[str, Array]) -> dict[str, list[Array]]:
        """T_link_pad of all places by link that are clear of other links in several postures."""
        links = self.drawing.links(self.drawing.postures(np.random.default_rng([self.wish.seed, 52]), POSTURES))
        out = {}
        for link in track(self.links, "places on links"):
            if link == "world":
                assert self.plane is not None
                found = candidates.in_plane(self.plane, self.board, candidates.STEP)
            else:
                robot, _, name = link.partition("/")
                found = candidates.on_link(self.models[robot].meshes[name], self.board, candidates.STEP)
            clear = candidates.clear_of_links([self.pad(link, T) for T in found], self.board, links, solids)
            out[link] = [T for T, is_clear in zip(found, clear, strict=True) if is_clear]
        out = {link: own for link, own in out.items() if own}
        if not out:
            raise cells.CellError(
                f"--links: expected a surface on which a board of {_size(self.board)} lies, got none on {', '.join(self.links)}; "
                "give other links"
            )
        return out


def _rounded(values: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(value), DIGITS) + 0.0 for value in values)
    return x, y, z


def _size(board: Board) -> str:
    return " x ".join(f"{100 * side:g}" for side in board.size) + " cm"
