"""Makes weights/ again: `penumbra posecnn train`.

Simulated pictures, such as PredNet's sequences begin with, but also from further away, are rendered by a second process into a
growing data set on disk while the network learns from those there. Step n takes its pictures, patches and colours from a
generator seeded by (seed, n), and the schedule is a function of the progress, so that a run of --steps interrupted and resumed
ends with the same weights as one that was not.
"""

from __future__ import annotations

import datetime
import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from penumbra.services import flags
from penumbra.services.posecnn import network, patch
from penumbra.services.posecnn.estimator import WEIGHTS
from penumbra.services.posecnn.network import REFERENCE_PX, STRIDE, Network, PoseCnnSettings, proportions
from penumbra.services.posecnn.training import evaluate, loss
from penumbra.shared import training
from penumbra.shared.body import anatomy
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import TARGET_LABELS, Label
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import processor
from penumbra.sim.sets import sequences, shots

VALIDATION_SEED = 2_000_000
"""Added to the seed for held-out pictures: nothing there was ever trained on."""
DIFFERS = (
    "backbone: a residual encoder and decoder of 1.5 million parameters trained from nothing, in place of VGG16",
    "one object; its proportions (the bounds of the known mesh) are an input, for the persons differ",
    "input: a patch of 128 x 128 zoomed to where fusion expects the target, in place of the whole image",
    "depth: as the target's apparent length in pixels, averaged over the voting pixels; the known mesh's length and the focal "
    "length make it metres, so neither the zoom nor the person's size matters",
    "region of the rotation: a square around the voted centre as wide as the voted length says, in place of the voters' box",
    "rotation: allocentric, relative to the ray through the centre",
    "loss of the rotation: SLoss on the forearm and PLoss on the hand, distances not squared",
    "the centre is refined by least squares over the rays that agree",
    "covariance: learned from held-out pictures; the original has none; no refinement by depth images",
    "data: first frames of simulated sequences as PredNet's, 28 672 of them, by cameras up to 6 times as far away, in place of "
    "YCB-Video and its synthetic images",
)
VARIETY = sequences.Variety(frames=1, size=256, away=(0.7, 6.0))
"""A network without memory learns most from pictures of many scenes. They are large, for patches to lie within them, and from as
far away as the cameras of the paper."""
CHUNK = 256
"""Pictures in a file of the data set."""


@dataclass(frozen=True)
class Schedule:
    """How training goes. `peak_rate`, `decay`: of AdamW's one cycle; `batch`: pictures a step; `reuse`: how often a picture is
    visited on average while the data set grows up to `most`; `weights`: of the loss's parts; `averaging`: of the weights that are
    exported.

    Pictures: `cropped`: share of those that are cut off around the target, up to `margin` extents beside it; `coarse`: share of
    those seen by a sensor of fewer pixels, at least the share `coarsest`; `soft`: share of the patches that are blurred, by up to
    `softest` [px]; `noise`: largest standard deviation of what is added to half of them. How sharp a patch is and where its
    picture ends must not tell how far it was zoomed.

    Patches: `room`: bounds of their side, in extents of the target's picture, and with a share `wide` up to `widest`; `off`: how
    far at most their middle is off the target's, in extents; `most_of_window`: their largest side and `cut`: their middle's least
    distance from the picture's border, in sides of picture and patch, for beyond it is black; `turn` [rad]: standard deviation of
    the camera's turn about its axis. `jitter`: of the colours. `region`: standard deviations of the pooled region's centre, in
    apparent lengths, and of its size.
    """

    peak_rate: float = 1e-3
    decay: float = 1e-3
    batch: int = 16
    reuse: int = 5
    most: int = 28_672
    weights: tuple[tuple[str, float], ...] = (
        ("labels", 1.0),
        ("target", 1.0),
        ("direction", 2.0),
        ("length", 5.0),
        ("distance", 10.0),
        ("rotation", 4.0),
    )
    averaging: float = 0.998
    cropped: float = 0.3
    margin: float = 0.3
    coarse: float = 0.3
    coarsest: float = 0.4
    soft: float = 0.4
    softest: float = 1.0
    noise: float = 0.03
    room: tuple[float, float] = (1.1, 1.8)
    wide: float = 0.12
    widest: float = 5.0
    off: float = 0.2
    most_of_window: float = 1.05
    cut: float = 0.4
    turn: float = 0.15
    jitter: float = 0.25
    region: tuple[float, float] = (0.05, 0.08)

    def rate(self, progress: float) -> float:
        """The learning rate at a progress in [0, 1]."""
        return self.peak_rate * training.one_cycle(progress, 0.08)


@dataclass(frozen=True)
class Truth:
    """What is known of a picture: T_camera_target (4, 4), intrinsics (4,), hidden share, vertices (n, 3) [m] of the target."""

    T: Array
    intrinsics: Array
    hidden: float
    vertices: Array

    @classmethod
    def of(cls, stored: NDArray[np.float32]) -> Truth:
        """What `_render_to` stored."""
        row: Array = stored.astype(np.float64)
        return cls(row[:16].reshape(4, 4), row[16:20], float(row[20]), row[21:].reshape(-1, 3))


class RenderedPictures:
    """Pictures rendered in order by a process of low priority, kept on disk in files of `chunk`."""

    def __init__(self, folder: Path, seed: int, most: int, chunk: int = CHUNK):
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._seed, self._chunk, self._chunks = folder, seed, chunk, -(-most // chunk)
        self._asked = 0
        self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=os.nice, initargs=(10,))
        self._pending: list[Future[None]] = []
        self._pixels: list[NDArray[np.uint8]] = []
        self._truth: list[NDArray[np.float32]] = []

    def ensure(self, count: int, ahead: int = 4) -> int:
        """Wait until `count` pictures (or all) are there, ask for some more; returns how many may be used."""
        chunks = min(-(-count // self._chunk), self._chunks)
        for chunk in range(self._asked, min(chunks + ahead, self._chunks)):
            first = chunk * self._chunk
            indices = range(first, first + self._chunk)
            self._pending.append(self._pool.submit(_render_to, self._path(chunk), self._seed, indices))
            self._asked = chunk + 1
        while len(self._pixels) < chunks:
            path = self._path(len(self._pixels))
            self._pending[len(self._pixels)].result()
            self._pixels.append(np.load(path, mmap_mode="r"))
            self._truth.append(np.load(path.with_suffix(".truth.npy")))
        return chunks * self._chunk

    def __getitem__(self, index: int) -> tuple[NDArray[np.uint8], Truth]:
        """Red, green, blue and class (h, w, 4) of a picture that is there, and what is known of it."""
        chunk, i = divmod(index, self._chunk)
        return self._pixels[chunk][i], Truth.of(self._truth[chunk][i])

    def close(self) -> None:
        """Render no more."""
        self._pool.shutdown(cancel_futures=True)

    def _path(self, chunk: int) -> Path:
        return self._folder / f"{self._seed}-{chunk:05d}.npy"


def _render_to(path: Path, seed: int, indices: range) -> None:
    if path.is_file():
        return
    pixels, rows = [], []
    for index in indices:
        sequence = sequences.render(seed, index, VARIETY)
        poses = sequence.poses
        assert poses is not None
        pixels.append(np.concatenate([sequence.images[0], sequence.labels[0][..., None]], axis=-1))
        rows.append(np.concatenate([poses.T_camera_target[0].ravel(), poses.intrinsics, sequence.hidden, poses.vertices.ravel()]))
    np.save(path.with_suffix(".truth.npy"), np.array(rows, np.float32))
    part = path.with_suffix(".part.npy")
    np.save(part, np.stack(pixels))
    part.replace(path)  # a file is there wholly or not at all


@dataclass(frozen=True)
class Batch:
    """images (batch, 3, side, side) in [0, 1]; labels (batch, side / STRIDE, …); centre (batch, 2) [patch px] of the target and
    its apparent length (batch,) [px]; rotation (batch, 3, 3), allocentric; points (batch, n, 3) of the target in its lengths;
    shape (batch, 5): its proportions."""

    images: Tensor
    labels: Tensor
    centre: Tensor
    length: Tensor
    rotation: Tensor
    points: Tensor
    shape: Tensor


def draw_batch(chosen: list[tuple[NDArray[np.uint8], Truth]], schedule: Schedule, rng: np.random.Generator) -> Batch:
    """Patches around the targets of pictures, drawn anew at random."""
    columns: dict[str, list[Any]] = {name: [] for name in Batch.__dataclass_fields__}
    for pixels, truth in chosen:
        if rng.random() < schedule.cropped:
            pixels, truth = _cropped(pixels, truth, schedule.margin, rng)
        low, high = _box(truth)
        extent = float((high - low).max())
        room = schedule.room if rng.random() >= schedule.wide else (schedule.room[1], schedule.widest)
        size = np.array(pixels.shape[1::-1])
        side = min(extent * float(np.exp(rng.uniform(*np.log(room)))), schedule.most_of_window * size.max())
        inside = np.clip((low + high) / 2.0, schedule.cut * side, np.maximum(size - schedule.cut * side, schedule.cut * side))
        middle = inside + rng.uniform(-1.0, 1.0, 2) * schedule.off * min(extent, side)
        angle = rng.normal(0.0, schedule.turn)
        M, focal, principal = patch.square(truth.intrinsics, middle, side, angle)
        T = rigid.from_rpy((0.0, 0.0, 0.0), (0.0, 0.0, angle)) @ truth.T
        length = float(np.ptp(truth.vertices[:, 0]))
        halved = np.column_stack([M[:, :2], M[:, 2] - (STRIDE - 1) / 2.0]) / STRIDE
        side_out = patch.SIDE // STRIDE
        columns["images"].append(training.recoloured(_seen(pixels[..., :3], M, schedule, rng), rng, schedule.jitter))
        columns["labels"].append(cv2.warpAffine(pixels[..., 3], halved, (side_out, side_out), flags=cv2.INTER_NEAREST))
        columns["centre"].append(focal * T[:2, 3] / T[2, 3] + principal)
        columns["length"].append(focal * length / T[2, 3])
        columns["rotation"].append(patch.facing(T[:3, 3]).T @ T[:3, :3])
        columns["points"].append(truth.vertices / length)
        columns["shape"].append(proportions(truth.vertices))
    stacked = {name: torch.from_numpy(np.stack(values)) for name, values in columns.items()}
    as_float = {name: stacked[name].float() for name in ("centre", "length", "rotation", "points", "shape")}
    return Batch(stacked["images"].movedim(-1, 1), stacked["labels"].long(), **as_float)


def _box(truth: Truth) -> tuple[Array, Array]:
    """The first and the last column and row (2,) [px] of a target's picture, were it not hidden."""
    points = rigid.apply(truth.T, truth.vertices)
    shown = points[:, :2] / points[:, 2:] * truth.intrinsics[:2] + truth.intrinsics[2:]
    return shown.min(axis=0), shown.max(axis=0)


def _cropped(pixels: NDArray[np.uint8], truth: Truth, margin: float, rng: np.random.Generator) -> tuple[NDArray[np.uint8], Truth]:
    """A picture (h, w, 4) cut off around its target at random, leaving up to `margin` extents beside it."""
    low, high = _box(truth)
    room = margin * float((high - low).max()) * rng.random((2, 2))
    size = np.array(pixels.shape[1::-1])
    first = np.clip(np.floor(low - room[0]), 0, size - 16).astype(int)
    last = np.clip(np.ceil(high + room[1]), first + 16, size).astype(int)
    moved = replace(truth, intrinsics=truth.intrinsics - [0.0, 0.0, *first])
    return pixels[first[1] : last[1], first[0] : last[0]], moved


def _seen(image: NDArray[np.uint8], M: Array, schedule: Schedule, rng: np.random.Generator) -> NDArray[np.float32]:
    """The patch (SIDE, SIDE, 3) in [0, 1] of a picture by a map M (2, 3), as a sensor of any resolution and noise sees it."""
    if rng.random() < schedule.coarse:
        before = np.array(image.shape[1::-1])
        after = np.maximum(np.round(before * rng.uniform(schedule.coarsest, 1.0)), 8.0)
        image = np.asarray(cv2.resize(image, after.astype(int).tolist(), interpolation=cv2.INTER_AREA), np.uint8)
        larger = before / after
        M = np.column_stack([M[:, :2] * larger, M[:, 2] + M[:, :2] @ ((larger - 1.0) / 2.0)])
    found = patch.warp(image, M).astype(np.float32) / np.float32(255.0)
    if rng.random() < schedule.soft:
        found = np.asarray(cv2.GaussianBlur(found, (0, 0), rng.uniform(0.2, schedule.softest)), np.float32)
    if rng.random() < 0.5:
        found += np.float32(rng.uniform(0.0, schedule.noise)) * rng.standard_normal(found.shape, np.float32)
    return found


class Trainer(training.Trainer[Network, RenderedPictures]):
    """PoseCNN being trained."""

    SETTINGS = PoseCnnSettings
    schedule: Schedule

    def __init__(self, settings: PoseCnnSettings, schedule: Schedule, seed: int):
        torch.manual_seed(seed)
        net = Network(settings)
        super().__init__(settings, schedule, seed, net, torch.optim.AdamW(net.parameters(), weight_decay=schedule.decay))
        self.average.eval()
        mesh = anatomy.forearm_mesh(cells.Body())
        hand = np.unique(mesh.faces[mesh.labels == Label.HAND])
        self._hand = torch.from_numpy(hand)
        self._forearm = torch.from_numpy(np.setdiff1d(np.arange(len(mesh.vertices)), hand))
        self._half = processor.has_bfloat16()

    @classmethod
    def begin(cls, path: Path, schedule: Schedule, seed: int) -> Trainer:
        """A trainer that starts from weights with a card; the card that it writes names them."""
        net, card = network.load(path)
        trainer = cls(net.settings, schedule, seed)
        trainer.net.load_state_dict(net.state_dict())
        trainer.average.load_state_dict(net.state_dict())
        trainer.started_from = {name: card[name] for name in ("seed", "date", "started_from") if name in card}
        return trainer

    def train_step(self, data: RenderedPictures, progress: float) -> dict[str, float]:
        """One step of gradient descent; returns the parts of the loss."""
        schedule = self.schedule
        rng = np.random.default_rng([self.seed, 1, self.step])
        count = data.ensure(8 * CHUNK + self.step * schedule.batch // schedule.reuse)
        batch = draw_batch([data[i] for i in rng.integers(count, size=schedule.batch)], schedule, rng)
        parts = self._losses(batch, rng)
        total = sum(weight * parts[name] for name, weight in schedule.weights)
        assert isinstance(total, Tensor)
        self.descend(total, schedule.rate(progress), 5.0, schedule.averaging)
        return {name: float(value.detach()) for name, value in parts.items()} | {"total": float(total.detach())}

    def _losses(self, batch: Batch, rng: np.random.Generator) -> dict[str, Tensor]:
        with torch.autocast("cpu", torch.bfloat16, enabled=self._half):
            out = self.net(batch.images, batch.shape)
        parts = loss.dense(
            out, batch.labels, (batch.centre - (STRIDE - 1) / 2.0) / STRIDE, torch.log(batch.length / REFERENCE_PX)
        )
        shift, stretch = self.schedule.region
        n = len(batch.length)
        off = torch.from_numpy(rng.normal(0.0, shift, (n, 2)).astype(np.float32))
        size = torch.from_numpy(np.exp(rng.normal(0.0, stretch, n)).astype(np.float32))
        quaternions = self.net.rotations(out.features, batch.centre + off * batch.length[:, None], batch.length * size)
        missed = loss.rotation(
            loss.matrices(quaternions), batch.rotation, batch.points[:, self._forearm], batch.points[:, self._hand]
        )
        seen = torch.isin(batch.labels, torch.tensor(TARGET_LABELS)).sum((1, 2)) >= 8
        return parts | {"rotation": (missed * seen).sum() / seen.sum().clamp_min(1)}


def held_out_shots(seed: int, count: int) -> Iterator[shots.Shot]:
    """Pictures of 640 x 480 as the service sees them, at all distances at which the network sees a difference (further away it is
    the lens that must be longer) and all shares hidden."""
    for index in range(count):
        rng = np.random.default_rng([seed, index])
        distance, hidden = float(np.exp(rng.uniform(*np.log((1.0, 4.5))))), float(rng.uniform(0.0, 0.9))
        yield shots.shot(seed, index, distance_m=distance, hidden=hidden)


def export(trainer: Trainer, out: Path, each: int) -> dict[str, Any]:
    """Calibrate the covariance and score the averaged weights on held-out pictures, write them with their card; returns the
    card."""
    net = trainer.average.eval()
    seeds = VALIDATION_SEED + trainer.seed, VALIDATION_SEED + trainer.seed + 1
    uncertainty = evaluate.calibrated(net, held_out_shots(seeds[0], each), seeds[0])
    found = evaluate.results(net, uncertainty, held_out_shots(seeds[1], each), seeds[1])
    card = {
        "seed": trainer.seed,
        "date": datetime.date.today().isoformat(),
        "settings": {"schedule": asdict(trainer.schedule), "steps": trainer.step, "minutes": round(trainer.minutes, 1)},
        **({"started_from": trainer.started_from} if trainer.started_from else {}),
        "parameters": sum(p.numel() for p in net.parameters()),
        "differs": DIFFERS,
        "calibration": {"seed": seeds[0], "count": each, "coefficients": uncertainty.coefficients},
        "held_out": {"seed": seeds[1], "bands": evaluate.score(found)},
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    network.save(out, net, card)
    return card


@flags.command(
    "posecnn train",
    "Trains PoseCNN on simulated pictures, and writes weights and card.",
    *flags.training("posecnn", 75.0),
    flags.Option("--start", type=Path, metavar="FILE", help="start from these weights instead of random ones"),
    flags.Option("--cache", type=Path, default=Path("posecnn-data"), help="folder of rendered pictures (8 GB)"),
    flags.Option(
        "--out", type=Path, default=WEIGHTS, show_default="the committed ones", help="the weights, their card beside them"
    ),
    flags.Option("--held-out", type=flags.positive, default=500, help="pictures for the calibration, and as many for the score"),
    example="penumbra posecnn train --minutes 75 --out posecnn.npz",
)
def main(options: flags.Options) -> int:
    """Trains, then writes weights and card."""
    schedule = Schedule()
    if checkpoint := training.begun(options):
        trainer = Trainer.restore(checkpoint, schedule)
    elif options.start is not None:
        trainer = Trainer.begin(options.start, schedule, options.seed)
    else:
        trainer = Trainer(PoseCnnSettings(), schedule, options.seed)
    data = RenderedPictures(options.cache, trainer.seed, schedule.most)
    if not training.complete(trainer, data, options):
        return 130
    card = export(trainer, options.out, options.held_out)
    print(f"{options.out}: {card['held_out']}")
    return 0
