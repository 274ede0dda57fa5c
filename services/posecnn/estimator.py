"""The pose of one target in one camera's pictures by PoseCNN: patch, network, votes, rotation, and a judgement of the result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from penumbra.services.posecnn import network, patch, voting
from penumbra.services.posecnn.network import REFERENCE_PX, STRIDE, Network
from penumbra.services.posecnn.uncertainty import Signs, Uncertainty
from penumbra.shared.body import anatomy
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell.description import Camera, Cell
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import processor
from penumbra.shared.perception.lookout import Window
from penumbra.shared.perception.vision import State, VisionEstimate

WEIGHTS = Path(__file__).parent / "weights" / "posecnn.npz"
WIDTHS = (1.1, 0.85)
"""Sides of the patches that are looked at, in those of the window. The network's lengths lean towards those that are usual in a
patch, the more the less of the target is seen; the mean of two patches leans less. The first one's classes, votes and rotation
are used."""
SMALLEST = 24
"""Pixels of the target, counted at the network's stride, below which there is nothing to vote."""
AGREEING = 0.6
"""Share of the pixels that must agree with the vote."""
FITS = 0.5
"""Least overlap of the target's pixels and the mesh at a right pose."""
HIDDEN = 0.92
"""Largest hidden share with which a pose is measured."""
COVERED = 0.5
"""Covered share of the predicted silhouette from which the target is occluded and not lost."""
COVERS = (Label.ROBOT, Label.TORSO, Label.UPPER_ARM, Label.OCCLUDER)
TOO_SMALL, WIDER = 0.45, 1.8
"""Where nothing is known of the target and its pixels extend over less than this share of the patch, a second patch is taken: a
square larger than that extent by this factor."""
FEWEST = 8
"""Least number of pixels, at the network's stride, for a second patch."""
TILED, TILE = 2.0, 0.6
"""A window wider than so many patches, where nothing is known of the target, is also read in four tiles of this share of it."""
UNKNOWN = np.diag([1.0**2] * 3 + [1.5**2] * 3)
"""Covariance of a pose that says nothing, [m^2, rad^2]."""


@dataclass(frozen=True)
class PoseCnnEstimate(VisionEstimate):
    """signs: what the covariance was read from, None where nothing was found."""

    signs: Signs | None = None


@dataclass(frozen=True)
class Found:
    """What one look shows: T_camera_target, the vote for its centre, overlap and hidden share in [0, 1]."""

    T: Array
    vote: voting.Vote
    overlap: float
    hidden: float


class PoseCNN:
    """One target seen by one camera. Raises CellError for a name that the cell does not have."""

    def __init__(
        self,
        cell: Cell,
        camera: str | None = None,
        target: str | None = None,
        net: Network | None = None,
        uncertainty: Uncertainty | None = None,
    ):
        self._camera: Camera = cell.cameras[cell.one("cameras", camera)]
        self._target = cell.targets[cell.one("targets", target)]
        self._mesh: Mesh = anatomy.target_mesh(self._target, cell)
        self._length = float(np.ptp(self._mesh.vertices[:, 0]))
        self._shape = torch.from_numpy(network.proportions(self._mesh.vertices))[None]
        if net is None or uncertainty is None:
            net, uncertainty = load()
        self._net, self._uncertainty = net, uncertainty
        self._half = processor.has_bfloat16()
        self._T_camera_world = rigid.inverse(self._camera.T_world_camera)
        self._axes = np.kron(np.eye(2), self._camera.T_world_camera[:3, :3])

    def prepare(self) -> None:
        """Compiles what `update` needs, so that the first frame does not wait for it."""
        image = np.zeros((self._camera.height, self._camera.width, 3), np.uint8)
        with torch.inference_mode():
            self._look(self._squares(image, np.array([patch.SIDE / 2.0] * 2), float(patch.SIDE)))
        voting.vote(np.array([[4.0, 4.0], [8.0, 4.0]]), np.array([[1.0, 0.0], [-1.0, 0.0]]), patch.SIDE // STRIDE)
        ahead = rigid.apply(rigid.from_rpy((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)), self._mesh.vertices)
        raster.silhouette(ahead, self._mesh.faces, (50.0, 50.0, 32.0, 32.0), (0, 0, 64, 64))

    def update(self, image: NDArray[np.uint8], window: Window, T_prior: Array | None = None) -> PoseCnnEstimate:
        """What an image (h, w, 3) uint8 RGB says about the target's pose, looked for in a window; T_prior (4 x 4): the predicted
        T_world_target, None where nothing is known: it decides only whether a target that is not seen counts as occluded.

        Raises ValueError for an image that is not of the camera's size.
        """
        if image.shape[:2] != (self._camera.height, self._camera.width):
            expected, got = f"{self._camera.width} x {self._camera.height}", f"{image.shape[1]} x {image.shape[0]}"
            raise ValueError(f"image: expected {expected} (the cell file), got {got}")
        middle = np.array([window.x0 + window.right - 1, window.y0 + window.bottom - 1]) / 2.0
        side = float(max(window.right - window.x0, window.bottom - window.y0))
        looks = [(middle, side)]
        if T_prior is None and side > TILED * patch.SIDE:
            looks += [(middle + side / 4.0 * np.array([x, y]), TILE * side) for y in (-1, 1) for x in (-1, 1)]
        with torch.inference_mode():
            for at, width in looks:
                squares = self._squares(image, at, width)
                labels, found = self._look(squares)
                estimate = self._judge(squares[0], labels, found, T_prior)
                if T_prior is None and (region := self._region(labels, squares[0])) is not None:
                    nearer = self._squares(image, *region)
                    estimate = self._judge(nearer[0], *self._look(nearer), T_prior)
                if estimate.state == "tracking":
                    break
        return estimate

    def _squares(self, image: NDArray[np.uint8], middle: Array, side: float) -> list[patch.Patch]:
        """The patches of an image around a point (2,) [px], for a window `side` image columns wide."""
        return [patch.cut(image, self._intrinsics, middle, width * side) for width in WIDTHS]

    def _region(self, labels: NDArray[np.int64], square: patch.Patch) -> tuple[Array, float] | None:
        """Middle (2,) and side [image px] of a square around the pixels of the target, where they take up too little of a patch:
        the network knows targets that nearly fill it."""
        columns_rows = np.argwhere(np.isin(labels, self._target.label_values))[:, ::-1] * float(STRIDE)
        if len(columns_rows) < FEWEST:
            return None
        low, high = np.quantile(columns_rows, (0.05, 0.95), axis=0)
        extent = float((high - low).max()) + STRIDE
        if extent > TOO_SMALL * patch.SIDE:
            return None
        fx, fy, cx, cy = self._intrinsics
        middle = ((low + high) / 2.0 - square.centre) / square.focal * [fx, fy] + [cx, cy]
        return middle, WIDER * extent / square.focal * fx

    @property
    def _intrinsics(self) -> Array:
        camera = self._camera
        return np.array([camera.fx, camera.fy, camera.cx, camera.cy])

    def _look(self, squares: list[patch.Patch]) -> tuple[NDArray[np.int64], Found | None]:
        """The class of every position (side / STRIDE, …) of the first of the patches, and the target, None where too little of it
        shows there."""
        pictures = torch.from_numpy(np.stack([square.pixels for square in squares])).movedim(-1, 1).float() / 255.0
        with torch.autocast("cpu", torch.bfloat16, enabled=self._half):
            out = self._net(pictures, self._shape.expand(len(squares), -1))
        classes = out.logits.argmax(1).numpy()
        seen = np.isin(classes, self._target.label_values)
        square, labels = squares[0], classes[0]
        rows, columns = np.nonzero(seen[0])
        if len(rows) < SMALLEST:
            return labels, None
        directions = out.direction[0].numpy()[:, rows, columns].T.astype(np.float64)
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-6)
        vote = voting.vote(np.column_stack([columns, rows]).astype(np.float64), directions, len(labels))
        if not vote.agrees.any():
            return labels, None
        counts = torch.from_numpy(seen.copy())
        counts[0, rows[~vote.agrees], columns[~vote.agrees]] = False
        depth = self._depth(squares, network.mean_length(out.length, out.weight, counts).numpy(), counts.sum((1, 2)).numpy())
        centre = vote.centre * STRIDE + (STRIDE - 1) / 2.0
        length_px = square.focal * self._length / depth
        T = np.eye(4)
        T[:3, 3] = depth * np.array([*(centre - square.centre) / square.focal, 1.0])
        pooled = torch.from_numpy(centre[None].astype(np.float32)), torch.tensor([length_px])
        quaternion = self._net.rotations(out.features[:1], *pooled)[0].numpy()
        T[:3, :3] = patch.facing(T[:3, 3]) @ rigid.transform((0.0, 0.0, 0.0), quaternion)[:3, :3]
        return labels, self._found(T, vote, labels, seen[0], square)

    def _depth(self, squares: list[patch.Patch], lengths: NDArray[np.float32], pixels: NDArray[np.int64]) -> float:
        """The depth [m] at which the target has its apparent lengths (n,), logarithms over REFERENCE_PX, in patches in which so
        many pixels (n,) show it; the first counts in any case."""
        focal = np.array([square.focal for square in squares])
        depths = np.log(focal * self._length / REFERENCE_PX) - lengths
        return float(np.exp(depths[(pixels >= SMALLEST) | (np.arange(len(pixels)) == 0)].mean()))

    def _found(
        self, T: Array, vote: voting.Vote, labels: NDArray[np.int64], seen: NDArray[np.bool_], square: patch.Patch
    ) -> Found | None:
        vertices = rigid.apply(T, self._mesh.vertices)
        if vertices[:, 2].min() < raster.NEAR:
            return None
        whole, inside = self._silhouette(vertices, square, len(labels))
        both = int((seen & inside).sum())
        free = int((inside & ~seen & ~np.isin(labels, COVERS)).sum())
        return Found(
            T,
            vote,
            overlap=both / max(int(seen.sum()) + free, 1),
            hidden=float(np.clip(1.0 - seen.sum() / max(whole, 1), 0.0, 1.0)),
        )

    def _silhouette(self, vertices: Array, square: patch.Patch, side: int) -> tuple[int, NDArray[np.bool_]]:
        """Positions that vertices (n, 3) in the camera's frame cover at the network's stride: how many in all, and which of the
        patch (side, side)."""
        focal, centre = square.focal / STRIDE, (square.centre - (STRIDE - 1) / 2.0) / STRIDE
        window = (-side, -side, 3 * side, 3 * side)
        covered = raster.silhouette(vertices, self._mesh.faces, (focal, focal, *centre), window)
        return int(covered.sum()), covered[side : 2 * side, side : 2 * side]

    def _judge(
        self, square: patch.Patch, labels: NDArray[np.int64], found: Found | None, T_prior: Array | None
    ) -> PoseCnnEstimate:
        T_world_camera = self._camera.T_world_camera
        if found is not None and found.hidden <= HIDDEN and found.vote.share >= AGREEING and found.overlap >= FITS:
            own = self._camera.fx * self._length / found.T[2, 3]
            signs = Signs(
                found.hidden, min(own, square.focal * self._length / found.T[2, 3]), found.vote.spread, found.vote.share
            )
            covariance = self._axes @ self._uncertainty.covariance(found.T, self._length, signs) @ self._axes.T
            return PoseCnnEstimate(T_world_camera @ found.T, covariance, found.overlap, found.hidden, "tracking", signs)
        T = self._target.home.transform if T_prior is None else T_prior
        state: State = "occluded" if T_prior is not None and self._is_covered(labels, square, T_prior) else "lost"
        overlap, hidden = (found.overlap, found.hidden) if found is not None else (0.0, 1.0)
        return PoseCnnEstimate(T, UNKNOWN, overlap, hidden, state)

    def _is_covered(self, labels: NDArray[np.int64], square: patch.Patch, T_world_target: Array) -> bool:
        """Whether most of the target's picture at a pose shows things that can stand before it."""
        vertices = rigid.apply(self._T_camera_world @ T_world_target, self._mesh.vertices)
        if vertices[:, 2].min() < raster.NEAR:
            return False
        _, inside = self._silhouette(vertices, square, len(labels))
        return bool(inside.any() and np.isin(labels[inside], COVERS).mean() >= COVERED)


def load(path: Path = WEIGHTS) -> tuple[Network, Uncertainty]:
    """The network of a weights file and the uncertainty in its card. Raises FileNotFoundError that says how to make one."""
    net, card = network.load(path)
    return net, Uncertainty({kind: tuple(values) for kind, values in card["calibration"]["coefficients"].items()})
