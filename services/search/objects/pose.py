"""Finds the pose of any rigid mesh in a mask or picture (`find_pose`), or in a sequence of them (`Tracker`).

The start counts as a weak measurement beside the mask: a mask that is a few per cent too large says less about the depth than a
start that is a few centimetres off. The covariance is that of both together. For a mask alone, its noise is measured on the mask
itself, by the distance of the contour from its boundary; if there is a picture, the picture decides (`region`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from penumbra.services.search.contour import MEASURED, NEAR, Model
from penumbra.services.search.evidence import COVERED, FREE, TARGET
from penumbra.services.search.mask_fit import Limits, Noise
from penumbra.services.search.objects import basin, contest, meshes, region
from penumbra.services.search.objects.basin import Level, Prior, Pyramid, Score, Shape
from penumbra.services.search.objects.creases import Creases
from penumbra.services.search.objects.paint import Cloud, painted
from penumbra.services.search.settings import ONE_IN_10_000
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.geometry.rigid import Array, inverse, perturb, pose_error, transform
from penumbra.shared.perception.intrinsics import Intrinsics

Bool = NDArray[np.bool_]
State = Literal["tracking", "occluded", "doubtful", "lost"]

FACES = (800, 4000)
"""Number of triangles to which a mesh is simplified, for small and for full pictures: finer ones are smaller than a pixel."""
START = (0.035, 0.4)
"""Standard deviations [m, rad] of a start, along and about each axis: 6 cm and 40 degrees in total."""
SMALLEST_PX = 60
"""Minimum number of pixels of a mask that shows a pose."""
FITS = 0.75
"""Minimum overlap of a right pose. At the right pose, masks with an IoU of 0.83 have 0.8."""
COVERS = 0.6
"""Share of the silhouette that is covered, above which a pose that fits is called occluded."""
EDGE_PX = (0.4, 6.0)
"""Bounds of the estimated standard deviation [px] of a mask's boundary."""
CORRELATION, DILATION = 30.0, 0.35
"""Length over which a mask's boundary shares its error [px], and standard deviation of the mask's dilation [px], both per pixel
of the boundary's standard deviation: fitted to the masks of `penumbra bench objects`."""


class RigidObject:
    """A mesh about its own middle, prepared for contours, and for comparisons of its colours if it has some. Raises
    ObjectFileError for a mesh without a surface."""

    def __init__(self, mesh: Mesh, colours: Cloud | None = None):
        mesh = meshes.repaired(mesh, FACES[1])
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        self.T_object_middle = transform((low + high) / 2.0)
        self.T_middle_object = inverse(self.T_object_middle)
        mesh = Mesh(mesh.vertices - (low + high) / 2.0, mesh.faces, mesh.labels)
        coarse = Model(meshes.repaired(mesh, FACES[0]))
        paints = None if colours is None else painted(mesh, replace(colours, points=colours.points - (low + high) / 2.0))
        self.shape = Shape(coarse, Model(mesh), Creases(coarse), paints)
        self.diameter = float(np.linalg.norm(high - low))
        self._moments = mesh.vertices.T @ mesh.vertices / len(mesh.vertices)

    def error(self, covariance: Array, T: Array) -> float:
        """RMS error [m] of the mesh's points by a covariance (6, 6) of T_camera_middle."""
        S = T[:3, :3] @ self._moments @ T[:3, :3].T
        # a rotation vector w moves a point x by w x x: E |w x x|^2 = tr(W (tr(S) 1 - S)), and the middle is at no mean of x
        turned = float(np.trace(covariance[3:, 3:] @ (np.trace(S) * np.eye(3) - S)))
        return math.sqrt(float(np.trace(covariance[:3, :3])) + turned)

    def published(self, found: ObjectEstimate) -> ObjectEstimate:
        """Converts an estimate of the middle's pose, T_camera_middle, to one of the object's own frame."""
        x, y, z = found.T[:3, :3] @ self.T_middle_object[:3, 3]
        A = np.eye(6)
        A[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]  # a rotation vector w moves the origin by w x (x, y, z)
        covariance = A @ found.covariance @ A.T
        return replace(found, T=found.T @ self.T_middle_object, covariance=(covariance + covariance.T) / 2.0)


@dataclass(frozen=True)
class ObjectEstimate:
    """T_camera_object, covariance (6, 6) along the camera's axes, overlap in [0, 1] and state.

    The overlap is that of mask and silhouette; without a mask, it is the share of the visible contour that lies on an edge.
    Doubtful: the most probable pose, which may be off by more than a tenth of the object, as the covariance says.
    """

    T: Array
    covariance: Array
    overlap: float
    state: State


def observed(mask: Bool, occluder: Bool | None = None) -> NDArray[np.uint8]:
    """The state (h, w) of every pixel, from a mask (h, w) and the pixels of occluders."""
    state = np.where(mask, TARGET, FREE).astype(np.uint8)
    if occluder is not None:
        state[occluder] = COVERED
    return state


def started(rigid: RigidObject, T_start: Array, spread: tuple[float, float] = START) -> Prior:
    """The prior of a start T_camera_object with standard deviations `spread` [m, rad] along and about each axis."""
    return Prior(T_start @ rigid.T_object_middle, np.diag(np.repeat(np.square(spread) ** -1.0, 3)))


def find_pose(
    rigid: RigidObject,
    mask: Bool | None,
    k: Intrinsics,
    T_start: Array,
    occluder: Bool | None = None,
    picture: NDArray[np.uint8] | None = None,
    spread: tuple[float, float] = START,
) -> ObjectEstimate:
    """The pose of an object in a mask (h, w), in a picture (h, w, 3) uint8 RGB or in both, from a start T_camera_object (4 x 4)
    that may be 30 degrees and 5 cm off. Raises ValueError if neither is given.

    `occluder` (h, w): pixels that show something in front of the object; `spread`: standard deviations [m, rad] of the start
    along and about each axis.
    """
    prior = started(rigid, T_start, spread)
    if mask is not None and np.count_nonzero(mask if occluder is None else mask & ~occluder) < SMALLEST_PX:
        return rigid.published(_lost(prior.T))
    if picture is not None:
        return rigid.published(_Colours(rigid, k).search(picture, mask, occluder, prior)[0])
    if mask is None:
        raise ValueError("find_pose: expected a mask, a picture or both, got neither")
    masks = basin.pyramid(observed(mask, occluder), k)
    return rigid.published(judged(rigid.shape, masks, basin.search(rigid.shape, masks, prior), prior))


def judged(shape: Shape, masks: Pyramid, found: list[tuple[Score, Array]], prior: Prior) -> ObjectEstimate:
    """The estimate of the middle's pose, T_camera_middle, from the poses that `basin` found, best first."""
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
    if prior.cost(T) > ONE_IN_10_000:  # no pose that the start allows explains the mask
        return _lost(T, best.overlap)
    state = _state(best, contour.points["length"][contour.kind == MEASURED].sum() * at.scale)
    if state == "lost":
        return _lost(T, best.overlap)
    return ObjectEstimate(T, covariance, best.overlap, state)


def measured_noise(model: Model, at: Level, T: Array) -> Noise:
    """The mask's noise, from the contour's remaining offsets at the right pose."""
    found = basin.contour(model, at, T, 3.0 * EDGE_PX[1] / at.scale)
    r = np.abs(found.r[found.kind == MEASURED]) * at.scale
    if not len(r):
        return basin.NOISE
    edge = min(max(1.48 * float(np.median(r)), EDGE_PX[0]), EDGE_PX[1])
    return Noise(edge, max(14.0, CORRELATION * edge), DILATION * edge)


def _state(best: Score, length: float) -> State:
    if best.overlap < FITS or length < basin.NOISE.correlation or best.both < SMALLEST_PX / 4:
        return "lost"
    return "occluded" if best.covered > COVERS * (best.covered + best.both) else "tracking"


def _lost(T: Array, overlap: float = 0.0) -> ObjectEstimate:
    return ObjectEstimate(T, Limits().covariance, overlap, "lost")


GAP = 0.015
"""Distance from a good pose's contour within which no colours are learned, as a share of the object's size."""
MARGIN = 2.0
"""Distance from the start within which an object is searched for, in standard deviations of its position."""
TYPICAL = 0.85
"""Share of the contour on edges from which the covariance is that of the settings; below, it grows with the share's inverse
fourth power."""
CERTAIN = 0.06
"""RMS error of the mesh's points by the covariance, as a share of the diameter, above which a pose is doubtful: one in ten is
then off by more than a tenth, if the error is mostly along one direction, such as the depth."""


class _Colours:
    """Judges poses of an object from pictures of a camera with intrinsics k."""

    def __init__(self, rigid: RigidObject, k: Intrinsics):
        self._rigid, self._shape, self._k = rigid, rigid.shape, k

    def search(
        self, picture: NDArray[np.uint8], mask: Bool | None, occluder: Bool | None, prior: Prior
    ) -> tuple[ObjectEstimate, NDArray[np.float32] | None]:
        """The estimate of T_camera_middle from a far start, and the log-odds of the colours there; None if edges hardly support
        it."""
        reach = MARGIN * float(np.sqrt(1.0 / prior.information[0, 0]))
        window = region.Window(
            picture, mask, occluder, self._k, self._shape, prior.T, reach * self._k.fx / max(prior.T[2, 3], NEAR)
        )
        found = contest.search(self._shape, window, prior, reach)
        if not found:
            return _lost(prior.T), None
        table = window.of_pose(self._shape.coarse, found[0].T, GAP) if found[0].support > contest.SUPPORTED[1] else None
        return self.judged(found, prior, mask, occluder, picture.shape[:2]), table

    def judged(
        self, found: list[contest.Found], prior: Prior, mask: Bool | None, occluder: Bool | None, shape: tuple[int, int]
    ) -> ObjectEstimate:
        """The estimate of T_camera_middle from poses in a picture (h, w), best first."""
        best = found[0]
        overlap, covered = best.support, 0.0
        if mask is not None or occluder is not None:
            h, w = shape
            silhouette = self._shape.fine.silhouette(best.T, self._k, (0, 0, w, h))
            free = silhouette if occluder is None else silhouette & ~occluder
            covered = 1.0 - int(np.count_nonzero(free)) / max(int(np.count_nonzero(silhouette)), 1)
            if mask is not None:
                seen = mask if occluder is None else mask & ~occluder
                overlap = int(np.count_nonzero(seen & free)) / max(int(np.count_nonzero(seen | free)), 1)
        T, covariance = self._posterior(found, prior)
        if best.support < contest.SUPPORTED[0] or (mask is not None and overlap < FITS) or best.length < basin.NOISE.correlation:
            return _lost(T, overlap)
        refuted = best.support < contest.SUPPORTED[1] or best.score < contest.REFUTED
        if refuted or self._rigid.error(covariance, T) > CERTAIN * self._rigid.diameter:
            return ObjectEstimate(T, covariance, overlap, "doubtful")
        return ObjectEstimate(T, covariance, overlap, "occluded" if covered > COVERS else "tracking")

    def _posterior(self, found: list[contest.Found], prior: Prior) -> tuple[Array, Array]:
        """The best pose with the prior, weighted by the accuracy of the contours, and its covariance with the other poses by
        likelihood."""
        best = found[0]
        trust = min(1.0, max(best.support, 0.1) / TYPICAL) ** 4  # an occluder may have pulled the rest of the contour along
        colours = best.level.compared(self._shape, best.T) if best.colours > contest.CONVINCING else None
        measured = region.covariance(self._shape, best.level, best.T, trust, colours)
        gain = measured @ np.linalg.inv(measured + np.linalg.inv(prior.information))
        T = perturb(best.T, gain @ pose_error(prior.T, best.T))
        covariance = measured - gain @ measured
        weights = np.exp([one.score - best.score for one in found])
        errors = np.array([pose_error(one.T, best.T) for one in found])
        apart = np.einsum("n,ni,nj->ij", weights / weights.sum(), errors, errors)
        return T, np.asarray((covariance + covariance.T) / 2.0 + apart, np.float64)


FRAME_WIDTHS = (8.0, 6.0, 5.0, 5.0, 5.0)
"""Widths [px] of the steps from the prediction, see `basin.descend`."""
DROP = 0.12
"""Decrease of the overlap from its usual value above which the surroundings are searched, too."""
SMOOTHING = 0.3
"""Weight of the newest frame in the smoothed velocity."""
LEARNING = 0.1
"""Weight of the newest frame in the colours."""
UNKNOWN = (0.6, 3.0)
"""Standard deviations of the change of velocity, [m/s] and [rad/s]; those of the pose grow by them with the bridged time."""
LONGEST_S = 0.3
"""Time [s] without a sight of the object after which the uncertainty of its pose stops growing."""


class Tracker:
    """Tracks a rigid object in a sequence of masks or pictures: each pose starts from the last one at constant velocity.

    T_start (4 x 4): T_camera_object before the first frame, with standard deviations `spread` [m, rad]; `dt_s`: time between
    frames.
    """

    def __init__(
        self, rigid: RigidObject, k: Intrinsics, T_start: Array, dt_s: float = 1.0 / 30.0, spread: tuple[float, float] = START
    ):
        self._rigid, self._k, self._dt = rigid, k, dt_s
        self._growth = np.diag(np.repeat(np.square(UNKNOWN) * dt_s**2, 3))
        self._T = T_start @ rigid.T_object_middle
        self._covariance = np.diag(np.repeat(np.square(spread), 3))
        self._weak = np.asarray(np.linalg.inv(self._covariance), np.float64)
        self._velocity, self._usual = np.zeros(6), 0.0
        self._colours = _Colours(rigid, k)
        self._table: NDArray[np.float32] | None = None  # log-odds of the colours
        self._usual_support = 0.0
        self._convinced = False  # whether the mesh's colours have been seen: from then on they are expected
        self._missed = -1  # frames since the last pose; there was none before the start

    def update(self, mask: Bool | None, occluder: Bool | None = None, picture: NDArray[np.uint8] | None = None) -> ObjectEstimate:
        """The pose in the next frame; arguments as of `find_pose`. If lost, the pose is the last one and the covariance wide."""
        if mask is None and picture is None:
            raise ValueError("Tracker.update: expected a mask, a picture or both, got neither")
        T = perturb(self._T, self._velocity * self._dt)
        bridged = min(1.0 + self._missed, max(LONGEST_S / self._dt, 1.0))
        covariance = self._covariance + bridged**2 * self._growth
        prior = Prior(T, np.asarray(np.linalg.inv(covariance), np.float64))
        if mask is not None and np.count_nonzero(mask if occluder is None else mask & ~occluder) < SMALLEST_PX:
            found = None
        elif picture is not None:
            found = self._look_at_picture(picture, mask, occluder, prior)
        else:
            assert mask is not None
            found = self._look(observed(mask, occluder), prior)
        if found is None or found.state == "lost":
            return self._miss(found, occluder)
        if self._missed == 0:
            moved = pose_error(found.T, self._T) / self._dt
            self._velocity = self._velocity + SMOOTHING * (moved - self._velocity)
        self._usual = found.overlap if self._missed else self._usual + 0.1 * (found.overlap - self._usual)
        self._T, self._covariance, self._missed = found.T, found.covariance, 0
        return self._rigid.published(found)

    def _look(self, state: NDArray[np.uint8], prior: Prior) -> ObjectEstimate:
        model, masks = self._rigid.shape.fine, basin.pyramid(state, self._k)
        if self._missed == 0:
            T = basin.descend(self._rigid.shape.coarse, masks.coarse, prior.T, prior, FRAME_WIDTHS)
            near = basin.ranked(model, masks.fine, [T], prior, basin.NOISE)
            if near[0][0].overlap > max(FITS, self._usual - DROP):
                return judged(self._rigid.shape, masks, near, prior)
        return judged(self._rigid.shape, masks, basin.search(self._rigid.shape, masks, prior), prior)

    def _look_at_picture(
        self, picture: NDArray[np.uint8], mask: Bool | None, occluder: Bool | None, prior: Prior
    ) -> ObjectEstimate | None:
        shape = self._rigid.shape
        if self._missed == 0 and self._table is not None:
            window = region.Window(picture, mask, occluder, self._k, shape, prior.T, 0.0)
            one = contest.follow(shape, window, self._table, prior)
            proved = one.colours > contest.CONVINCING
            hidden = self._convinced and not proved
            if proved or (one.support > max(contest.SUPPORTED[1], self._usual_support - DROP) and not hidden):
                self._convinced = self._convinced or proved
                # the errors of the contour are the same in all frames: the last pose adds nothing
                alone = Prior(one.T, self._weak)
                found = self._colours.judged([one], alone, mask, occluder, picture.shape[:2])
                if found.state == "tracking":  # else it may be something else that is seen
                    self._usual_support += SMOOTHING * (one.support - self._usual_support)
                    newest = window.of_pose(shape.coarse, one.T, GAP)
                    self._table = self._table + np.float32(LEARNING) * (newest - self._table)
                return found
        found, table = self._colours.search(picture, mask, occluder, prior)
        if found.state == "lost" or table is None:
            return None
        self._table, self._usual_support = table, 0.0
        return found

    def _miss(self, found: ObjectEstimate | None, occluder: Bool | None) -> ObjectEstimate:
        """The estimate of an object that is not seen: its last pose, occluded if something covers it, else lost."""
        self._missed = max(self._missed, 0) + 1
        self._velocity = np.zeros(6)
        covered = False
        if occluder is not None:
            h, w = occluder.shape
            silhouette = self._rigid.shape.fine.silhouette(self._T, self._k, (0, 0, w, h))
            drawn = int(np.count_nonzero(silhouette))
            covered = drawn > 0 and bool(np.count_nonzero(silhouette & occluder) > COVERS * drawn)
        lost = ObjectEstimate(self._T, Limits().covariance, found.overlap if found else 0.0, "occluded" if covered else "lost")
        return self._rigid.published(lost)
