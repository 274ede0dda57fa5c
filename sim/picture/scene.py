"""The scene as cameras see it: furniture, the appearance of everything, and the pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.layout import electrode_positions
from penumbra.sim.picture import appearance
from penumbra.sim.picture.appearance import Appearance
from penumbra.sim.picture.distortion import Distortion
from penumbra.sim.picture.occluder import box
from penumbra.sim.picture.renderer import Body, Renderer, Shape

PLATE, PLATE_MARGIN, TABLE_THICK = 0.003, 0.02, 0.03
"""Thickness of a pad, margin by which it is wider than its electrodes, thickness of the table top [m]."""


@dataclass(frozen=True)
class View:
    """A picture and its truth: `image` (h, w, 3) uint8 RGB as the camera's lens shows it, `labels` (h, w) uint8 classes of the
    undistorted picture, `hidden`: share of the target's pixels in the picture that something covers."""

    image: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    hidden: float


class Cameras:
    """The cell's cameras, and the light and colours of its things, drawn from a seed: those of a tidy work cell."""

    def __init__(self, cell: cells.Cell, seed: int):
        self._cell, self._seed = cell, seed
        self._distortions = {name: Distortion.of(camera) for name, camera in cell.cameras.items()}
        self._renderers = {name: Renderer(cell.cameras[name], distortion=found) for name, found in self._distortions.items()}
        self._shapes: dict[str, Shape] = {}
        rng = np.random.default_rng([seed, 6])
        person = appearance.person(rng, tidy=True)
        self._looks = {"target": person[Label.FOREARM], "upper_arm": person[Label.UPPER_ARM], "torso": person[Label.TORSO]}
        self._looks["occluder"] = Appearance(appearance.occluder(rng, tidy=True))
        self._looks["table"] = Appearance(appearance.tabletop(rng), casts_shadow=False)
        self._looks["pad"] = Appearance(appearance.metal(rng), gloss=0.2)
        self._looks |= {robot: Appearance(appearance.metal(rng), gloss=rng.uniform(0.1, 0.4)) for robot in cell.robots}
        self._light = appearance.look(rng, next(iter(cell.targets.values())).home.position, tidy=True)

    def view(self, camera: str, bodies: Mapping[str, tuple[Mesh, Array]], time_s: float) -> View:
        """The picture of things by name (`target` among them; ROBOT/LINK for robots), each with T_world_mesh. The sensor's noise
        depends on seed, camera and time alone."""
        renderer, names = self._renderers[camera], list(bodies)
        scene = [Body(self._shape(name, mesh), T, self._look(name)) for name, (mesh, T) in bodies.items()]
        rng = np.random.default_rng([self._seed, 7, list(self._renderers).index(camera), round(time_s * 1e6)])
        picture = renderer.render(scene, self._light, rng)
        distortion = self._distortions[camera]
        labels = distortion.pinhole(picture.labels) if distortion else picture.labels
        return View(picture.image, labels, renderer.hidden_fraction(picture, scene, names.index("target")))

    def _shape(self, name: str, mesh: Mesh) -> Shape:
        if name not in self._shapes:
            self._shapes[name] = Shape.of(mesh)
        return self._shapes[name]

    def _look(self, name: str) -> Appearance:
        return self._looks[name.partition("/")[0].partition(" ")[0]]


def furniture(cell: cells.Cell, sim: cells.Sim) -> dict[str, tuple[Mesh, str]]:
    """Furniture of the cell, with the link that carries it: `pad NAME` as plates slightly larger than their electrodes' circle,
    and `table`."""
    out = {}
    for name, pad in cell.pads.items():
        radius = np.linalg.norm(electrode_positions(cell.pad_types[pad.type]), axis=1).max()
        side = 2.0 * radius + PLATE_MARGIN
        plate = box((side, side, PLATE), (0.0, 0.0, -PLATE / 2.0), Label.BACKGROUND if pad.link == "world" else Label.ROBOT)
        out[f"pad {name}"] = (dataclasses.replace(plate, vertices=rigid.apply(pad.T_link_pad, plate.vertices)), pad.link)
    if sim.table is not None:  # its top lies slightly below the pads' faces, so that these are visible
        middle = (*sim.table_middle, -(PLATE + TABLE_THICK) / 2.0)
        out["table"] = (box((*sim.table, TABLE_THICK), middle, Label.BACKGROUND), "world")
    return out
