"""Computes the reduction of a pad's signals by the grounded link behind it, at any place on the link.

A backed pad has its own field model, which takes minutes to fit (`penumbra skin model`). To compare many places, the model of a
bare pad is corrected: the boundary elements of pad and link give the potentials with and without the link, and to first order a
limb's signal is the product of two of them (Green's reciprocity, see `sim.skin.field`). The logarithm of the ratio is regressed
on the network's input (ridge regression), so that the corrected model is a network of the same kind, with derivatives.

Beyond 5 cm its signals at the eight places of the cell `arm` are 0 to 26 % weaker in the median than those of the fitted models,
and the expected error of all eight is 4 % larger (`tests/services/skin/test_placing.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial import ConvexHull

from penumbra.shared.body.anatomy import Mesh, target_mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import Pad, PadType
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.response import Network, features
from penumbra.sim.skin.field import Body, PadField, Panels, limb, shell

LIMB_PANELS = (14, 8)
"""Rows and columns of panels of the limb, the same for both signals in a ratio."""
LINK_PANELS = (6, 6)
"""Rows and columns of panels of a link that is not behind the pad."""
JOINED = 0.005
"""Minimum distance [m] of such panels from the link behind the pad."""
POSES = 48
"""Maximum number of poses at which the ratio is computed: those nearest to the pad."""
RIDGE = 0.3
"""Weight of the ridge, in poses: effects of an input that few poses show are shrunk to zero."""
LEAST = 1e-3
"""Minimum signal as a share of a bare pad's: the first order is not valid below it."""
ERROR = 0.02
"""Assumed standard deviation of the relative error of a fitted model at the place: those of `arm` have 0.7 to 1.4 %, and a place
that is not fitted yet counts as worse."""


class Shading:
    """Corrects the network of a bare pad type for one target. size (2,): the limb's, relative to the target's mesh in the cell
    file's size."""

    def __init__(self, cell: cells.Cell, kind: PadType, target: str, bare: Network, size: Array):
        own = cell.targets[target].size or cells.Size()
        self._size = np.log([own.length, own.girth]) + size
        mesh = target_mesh(cell.targets[target].model_copy(update={"size": None}), cell)
        self._bare, self._field = bare, PadField(kind)
        self._limb = _body(mesh, self._size)
        self._sources = self._field.sources()

    def network(self, backing: Panels, T_pad_limb: Array, gaps: Array) -> Network:
        """The network of a pad before grounded panels (in its frame), from limbs at T_pad_limb (k, 4, 4) with gaps (k,) [m]."""
        nearest = np.argsort(gaps, kind="stable")[:POSES]
        T = T_pad_limb[nearest]
        ratio = self.ratio(backing, T)
        x = features(self._bare.points, T, np.tile(self._size, (len(T), 1)))
        x = (x - self._bare.mean) / self._bare.scale
        middle = x.mean(axis=0)
        centred, offset = x - middle, ratio.mean(axis=0)
        slopes = np.linalg.solve(centred.T @ centred + RIDGE * np.eye(x.shape[1]), centred.T @ (ratio - offset)).T
        *biases, last = self._bare.biases
        return replace(
            self._bare,
            skip=self._bare.skip + slopes,
            biases=(biases[0], biases[1], last + offset - slopes @ middle),
            error=max(self._bare.error, ERROR),
        )

    def ratio(self, backing: Panels, T_pad_limb: Array) -> Array:
        """Logarithms (k, e) of the ratio of signals with and without the link, for limbs at T_pad_limb (k, 4, 4), to first
        order."""
        link = self._field.sources(backing)
        changes = [[_change(self._limb, T, *sources) for sources in (link, self._sources)] for T in T_pad_limb]
        with_link, without = np.moveaxis(np.array(changes), 1, 0)
        return np.asarray(np.log(np.maximum(with_link, LEAST * without) / without))


def _body(mesh: Mesh, size: Array) -> Body:
    """A limb of this size (2,), with LIMB_PANELS."""
    length, girth = np.exp(size)
    return limb(mesh, float(length), float(girth), *LIMB_PANELS)


def behind(mesh: Mesh, T_link_pad: Array) -> Panels:
    """The panels of a link in the frame of a pad on it."""
    return shell(rigid.apply(rigid.inverse(T_link_pad), mesh.vertices))


def beside(meshes: Mapping[str, Mesh], links: Mapping[str, Array], pad: Pad) -> Panels:
    """The panels of all other links, by ROBOT/LINK at T_world_link (4, 4), in the frame of a pad on one of them; without those in
    this link, or joined to it."""
    T_pad_world = rigid.inverse(links[pad.link] @ pad.T_link_pad)
    own = ConvexHull(rigid.apply(T_pad_world @ links[pad.link], meshes[pad.link].vertices))
    others = [
        rigid.apply(T_pad_world @ links[name], shell(mesh.vertices, *LINK_PANELS).corners)
        for name, mesh in meshes.items()
        if name != pad.link
    ]
    panels = Panels(np.concatenate(others))
    away = (panels.centroids @ own.equations[:, :3].T + own.equations[:, 3]).max(axis=1) > JOINED
    return Panels(panels.corners[away])


def _change(body: Body, T_pad_body: Array, at: Array, charges: Array) -> Array:
    """The change (e,), in arbitrary units, by a body at T_pad_body (4, 4) in the field of charges (s, 1 + e) at (s, 3)."""
    points = rigid.apply(T_pad_body, body.panels.centroids)
    squares = (points**2).sum(axis=1)[:, None] + (at**2).sum(axis=1) - 2.0 * points @ at.T
    potentials = (1.0 / np.sqrt(np.maximum(squares, 1e-8))) @ charges
    return np.asarray(-potentials[:, 1:].T @ body.charges(potentials[:, 0]))
