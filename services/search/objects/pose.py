"""One pose of any rigid mesh on any mask (`find_pose`), and a sequence of them (`Tracker`).

The start counts as a weak measurement beside the mask: a mask that is a few per cent too large says less about the depth than a
start that is a few centimetres off. The covariance is that of both together. The mask's noise is measured on the
mask itself, by how far the contour stays away from its boundary.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.services.search import image_fit as colours
from penumbra.services.search.contour import MEASURED, Model
from penumbra.services.search.evidence import COVERED, FREE, TARGET, Intrinsics
from penumbra.services.search.mask_fit import Fit, Limits, Noise
from penumbra.services.search.objects import basin, meshes
from penumbra.services.search.objects.basin import Level, Prior, Pyramid, Score, Shape
from penumbra.services.search.settings import ONE_IN_10_000
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.geometry.rigid import Array, inverse, perturb, pose_error, transform

Bool = NDArray[np.bool_]
State = Literal["tracking", "occluded", "lost"]

FACES = (800, 4000)
"""Number of triangles that a mesh is simplified to, for small and for full pictures: finer ones are smaller than a pixel."""
START = (0.035, 0.4)
"""Standard deviations [m, rad] of a start, along and about each axis: 6 cm and 40 degrees in all."""
SMALLEST_PX = 60
"""Least number of pixels of a mask that shows a pose."""
FITS = 0.75
"""Overlap below which the object is not where the pose says. At the right pose, masks with an IoU of 0.83 have 0.8."""
COVERS = 0.6
"""Share of the silhouette that is covered, from which a pose that fits is called occluded."""
EDGE_PX = (0.4, 6.0)
"""Bounds of the estimated standard deviation [px] of a mask's boundary."""
CORRELATION, DILATION = 30.0, 0.35
"""Length over which a mask's boundary errs together [px], and how much too large or small the mask is [px], for each pixel that
the boundary errs: fitted to the masks of `penumbra bench objects`."""


class RigidObject:
    """A mesh prepared for contours, about its own middle. Raises ObjectFileError for a mesh without a surface."""

    def __init__(self, mesh: Mesh):
        mesh = meshes.repaired(mesh, FACES[1])
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        self.T_object_middle = transform((low + high) / 2.0)
        self.T_middle_object = inverse(self.T_object_middle)
        mesh = Mesh(mesh.vertices - (low + high) / 2.0, mesh.faces, mesh.labels)
        self.shape = Shape(Model(meshes.repaired(mesh, FACES[0])), Model(mesh))
        self.diameter = float(np.linalg.norm(high - low))

    def published(self, found: ObjectEstimate) -> ObjectEstimate:
        """An estimate of the middle's pose, T_camera_middle, as one of the object's own frame."""
        x, y, z = found.T[:3, :3] @ self.T_middle_object[:3, 3]
        A = np.eye(6)
        A[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]  # a rotation vector w moves the origin by w x (x, y, z)
        covariance = A @ found.covariance @ A.T
        return replace(found, T=found.T @ self.T_middle_object, covariance=(covariance + covariance.T) / 2.0)


@dataclass(frozen=True)
class ObjectEstimate:
    """T_camera_object, covariance (6, 6) along the camera's axes, overlap in [0, 1] and state."""

    T: Array
    covariance: Array
    overlap: float
    state: State


def observed(mask: Bool, occluder: Bool | None = None) -> NDArray[np.uint8]:
    """The state (h, w) of every pixel, of a mask (h, w) and of what stands in front of the object."""
    state = np.where(mask, TARGET, FREE).astype(np.uint8)
    if occluder is not None:
        state[occluder] = COVERED
    return state


def started(rigid: RigidObject, T_start: Array, spread: tuple[float, float] = START) -> Prior:
    """What a start T_camera_object says, known to `spread` [m, rad] along and about each axis."""
    return Prior(T_start @ rigid.T_object_middle, np.diag(np.repeat(np.square(spread) ** -1.0, 3)))


def find_pose(
    rigid: RigidObject,
    mask: Bool,
    k: Intrinsics,
    T_start: Array,
    occluder: Bool | None = None,
    picture: NDArray[np.uint8] | None = None,
    spread: tuple[float, float] = START,
) -> ObjectEstimate:
    """The pose of an object in a mask (h, w), from a start T_camera_object (4 x 4) that may be 30 degrees and 5 cm off.

    `occluder` (h, w): pixels that show something in front of the object; `picture` (h, w, 3) uint8 RGB: the image that the mask
    is of, on which the pose is refined; `spread`: standard deviations [m, rad] of the start along and about each axis.
    """
    state, prior = observed(mask, occluder), started(rigid, T_start, spread)
    if np.count_nonzero(state == TARGET) < SMALLEST_PX:
        return rigid.published(_lost(prior.T))
    masks = basin.pyramid(state, k)
    return rigid.published(judged(rigid.shape, masks, basin.search(rigid.shape, masks, prior), prior, picture))


def judged(
    shape: Shape, masks: Pyramid, found: list[tuple[Score, Array]], prior: Prior, picture: NDArray[np.uint8] | None = None
) -> ObjectEstimate:
    """The estimate of the middle's pose, T_camera_middle, from those that `basin` found, best first."""
    model, at = shape.fine, masks.fine
    noise = measured_noise(model, at, found[0][1])
    widths = (2.0 * noise.edge,) * 4
    poses = [basin.descend(model, at, T, prior, widths, noise) for _, T in found]
    found = basin.distinct(basin.ranked(model, at, poses, prior, noise))
    best, T = found[0]
    contour = basin.contour(model, at, T, 6.0 * noise.edge / at.scale)
    H, _ = basin.information(contour, at, T, 2.0 * noise.edge, noise)
    covariance = np.asarray(np.linalg.inv(H + prior.information), np.float64)
    # poses that explain the mask nearly as well may be the right one
    weights = np.exp(-0.5 * np.minimum([score.cost - best.cost for score, _ in found], 100.0))
    errors = [pose_error(other, T) for _, other in found]
    apart = sum((w * np.outer(e, e) for w, e in zip(weights, errors, strict=True)), np.zeros((6, 6)))
    covariance = covariance + apart / weights.sum()
    if picture is not None:
        T, covariance = _on_picture(shape, masks, T, covariance, best, noise, picture)
    if prior.cost(T) > ONE_IN_10_000:  # nothing that the start allows explains the mask
        return _lost(T, best.overlap)
    state = _state(best, contour.points["length"][contour.kind == MEASURED].sum() * at.scale)
    if state == "lost":
        return _lost(T, best.overlap)
    return ObjectEstimate(T, covariance, best.overlap, state)


def measured_noise(model: Model, at: Level, T: Array) -> Noise:
    """How the mask errs, by what the contour at the right pose leaves."""
    found = basin.contour(model, at, T, 3.0 * EDGE_PX[1] / at.scale)
    r = np.abs(found.r[found.kind == MEASURED]) * at.scale
    if not len(r):
        return basin.NOISE
    edge = min(max(1.48 * float(np.median(r)), EDGE_PX[0]), EDGE_PX[1])
    return Noise(edge, max(14.0, CORRELATION * edge), DILATION * edge)


def _on_picture(
    shape: Shape, masks: Pyramid, T: Array, covariance: Array, best: Score, noise: Noise, picture: NDArray[np.uint8]
) -> tuple[Array, Array]:
    """The pose and covariance with what the colours on both sides of the contour say, on the small picture and then on the full
    one; unchanged where they say nothing, or what the mask contradicts."""
    prior = np.asarray(np.linalg.inv(covariance), np.float64)
    found = Fit(T, covariance, T, 0.0, math.inf, 0.0, best.cost, 0.0, best.both, best.either, best.either - best.both)
    for model, at in ((shape.coarse, masks.coarse), (shape.fine, masks.fine)):
        (h, w), e = at.shape, at.evidence
        window = picture[e.y0 : e.y0 + h * e.scale, e.x0 : e.x0 + w * e.scale]
        small = np.asarray(cv2.resize(window, (w, h), interpolation=cv2.INTER_AREA), np.uint8)
        settings = colours.ImageSettings(mask=max(noise.edge / at.scale, 0.8))
        found = colours.fit_image(model, found, small, replace(e, x0=0, y0=0, scale=1), T, prior, settings)
    error = pose_error(found.T_searched, T)
    if found.length < SHORTEST * masks.fine.evidence.boundary_px or error @ prior @ error > ONE_IN_10_000:
        return T, covariance
    return found.T_searched, np.asarray(np.linalg.inv(np.linalg.inv(found.covariance) + prior), np.float64)


SHORTEST = 0.4
"""Share of the mask's boundary along which the picture has to show an edge."""


def _state(best: Score, length: float) -> State:
    if best.overlap < FITS or length < basin.NOISE.correlation or best.both < SMALLEST_PX / 4:
        return "lost"
    return "occluded" if best.covered > COVERS * (best.covered + best.both) else "tracking"


def _lost(T: Array, overlap: float = 0.0) -> ObjectEstimate:
    return ObjectEstimate(T, Limits().covariance, overlap, "lost")


FRAME_WIDTHS = (8.0, 6.0, 5.0, 5.0, 5.0)
"""Widths [px] of the steps from the prediction, see `basin.descend`."""
DROP = 0.12
"""Decrease of the overlap, against its usual value, from which the surroundings are searched too."""
SMOOTHING = 0.3
"""Weight of the newest frame in the smoothed velocity."""
UNKNOWN = (0.6, 3.0)
"""Standard deviations of the change of velocity, [m/s] and [rad/s]; the pose's grow by them with the time bridged."""
LONGEST_S = 0.3
"""Time without a sight of the object [s] after which it is looked for no further away than before."""


class Tracker:
    """A rigid object in a sequence of masks: each pose starts from the last one, moved on at constant velocity.

    T_start (4 x 4): T_camera_object before the first frame, known to `spread` [m, rad]; `dt_s`: time between frames.
    """

    def __init__(
        self, rigid: RigidObject, k: Intrinsics, T_start: Array, dt_s: float = 1.0 / 30.0, spread: tuple[float, float] = START
    ):
        self._rigid, self._k, self._dt = rigid, k, dt_s
        self._growth = np.diag(np.repeat(np.square(UNKNOWN) * dt_s**2, 3))
        self._T = T_start @ rigid.T_object_middle
        self._covariance = np.diag(np.repeat(np.square(spread), 3))
        self._velocity, self._usual = np.zeros(6), 0.0
        self._missed = -1  # frames since the last pose; there was none before the start

    def update(self, mask: Bool, occluder: Bool | None = None, picture: NDArray[np.uint8] | None = None) -> ObjectEstimate:
        """The pose in the next frame; arguments as of `find_pose`. Lost, the pose is the last one and the covariance wide."""
        state = observed(mask, occluder)
        T = perturb(self._T, self._velocity * self._dt)
        bridged = min(1.0 + self._missed, max(LONGEST_S / self._dt, 1.0))
        covariance = self._covariance + bridged**2 * self._growth
        prior = Prior(T, np.asarray(np.linalg.inv(covariance), np.float64))
        found = self._look(state, prior, picture)
        if found is None or found.state == "lost":
            return self._miss(state, found)
        if self._missed == 0:
            moved = pose_error(found.T, self._T) / self._dt
            self._velocity = self._velocity + SMOOTHING * (moved - self._velocity)
        self._usual = found.overlap if self._missed else self._usual + 0.1 * (found.overlap - self._usual)
        self._T, self._covariance, self._missed = found.T, found.covariance, 0
        return self._rigid.published(found)

    def _look(self, state: NDArray[np.uint8], prior: Prior, picture: NDArray[np.uint8] | None) -> ObjectEstimate | None:
        if np.count_nonzero(state == TARGET) < SMALLEST_PX:
            return None
        model, masks = self._rigid.shape.fine, basin.pyramid(state, self._k)
        if self._missed == 0:
            T = basin.descend(self._rigid.shape.coarse, masks.coarse, prior.T, prior, FRAME_WIDTHS)
            near = basin.ranked(model, masks.fine, [T], prior, basin.NOISE)
            if near[0][0].overlap > max(FITS, self._usual - DROP):
                return judged(self._rigid.shape, masks, near, prior, picture)
        return judged(self._rigid.shape, masks, basin.search(self._rigid.shape, masks, prior), prior, picture)

    def _miss(self, state: NDArray[np.uint8], found: ObjectEstimate | None) -> ObjectEstimate:
        """The object is where it was, as far as is known: covered where something stands there."""
        self._missed = max(self._missed, 0) + 1
        self._velocity = np.zeros(6)
        h, w = state.shape
        silhouette = self._rigid.shape.fine.silhouette(self._T, self._k, (0, 0, w, h))
        drawn = int(np.count_nonzero(silhouette))
        covered = drawn > 0 and np.count_nonzero(silhouette & (state == COVERED)) > COVERS * drawn
        lost = ObjectEstimate(self._T, Limits().covariance, found.overlap if found else 0.0, "occluded" if covered else "lost")
        return self._rigid.published(lost)
