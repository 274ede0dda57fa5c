"""Makes weights/ again: `penumbra posecnn train`.

Every step renders some new simulated pictures (`pictures`) and learns from patches of those that are kept. Step n takes its
pictures, patches and colours from a generator seeded by (seed, n), and the schedule is a function of the progress, so that a run
of --steps interrupted and resumed ends with the same weights as one that was not.

On a GPU other processes render, one per core, and a step uses more patches at once. The committed weights are of two such
trainings, the first with `reuse` 26; the card says what differed in the second:

  export OMP_NUM_THREADS=1
  penumbra posecnn train --device cuda --workers 15 --times 32 --rate 2e-3 --steps 8500 --out first.npz
  penumbra posecnn train --device cuda --workers 15 --times 32 --rate 1.5e-3 --steps 14000 --seed 1 --start first.npz
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from penumbra.services import flags, training_flags
from penumbra.services.posecnn import network
from penumbra.services.posecnn.estimator import WEIGHTS
from penumbra.services.posecnn.network import REFERENCE_PX, STRIDE, Network, PoseCnnSettings
from penumbra.services.posecnn.training import evaluate, loss
from penumbra.services.posecnn.training.patches import Batch, draw_batch
from penumbra.services.posecnn.training.pictures import RenderedPictures
from penumbra.services.posecnn.training.schedule import Schedule
from penumbra.shared import training
from penumbra.shared.body import anatomy
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import TARGET_LABELS, Label
from penumbra.shared.native import processor
from penumbra.sim.sets import shots

VALIDATION_SEED = 2_000_000
"""Added to the seed for held-out pictures: nothing there was ever trained on."""
DIFFERS = (
    "backbone: a residual encoder and decoder of 4.2 million parameters trained from nothing, in place of VGG16",
    "one object; its proportions (the bounds of the known mesh) are an input, for the persons differ",
    "input: patches of 256 x 256 zoomed to where fusion expects the target, in place of the whole image; two, of different "
    "zooms, whose depths are averaged",
    "depth: as the target's apparent length in pixels, averaged over the voting pixels by weights that the network gives them; "
    "the known mesh's length and the focal length make it metres, so neither the zoom nor the person's size matters",
    "region of the rotation: a square around the voted centre as wide as the voted length says, in place of the voters' box",
    "rotation: allocentric, relative to the ray through the centre",
    "loss of the rotation: SLoss on the forearm and PLoss on the hand, distances not squared",
    "the centre is refined by least squares over the rays that agree",
    "covariance: learned from held-out pictures; the original has none; no refinement by depth images",
    "data: single frames simulated as PredNet's sequences are, 386 486 of them, finer and by cameras up to 6 times as far away, "
    "in place of YCB-Video and its synthetic images",
)


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
        self._coming: tuple[RenderedPictures, Batch, np.random.Generator] | None = None
        self._forearm = torch.from_numpy(np.setdiff1d(np.arange(len(mesh.vertices)), hand)[::2])

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
        if self._coming is None or self._coming[0] is not data:
            self._coming = data, *self._drawn(data)
        _, batch, rng = self._coming
        parts = self._losses(batch, rng)
        total = torch.stack([weight * parts[name] for name, weight in schedule.weights]).sum()
        self.descend(total, schedule.rate(progress), 5.0, schedule.averaging)
        self._coming = data, *self._drawn(data)  # while the device computes
        values = torch.stack([*parts.values(), total]).tolist()
        return dict(zip((*parts, "total"), values, strict=True))

    def _drawn(self, data: RenderedPictures) -> tuple[Batch, np.random.Generator]:
        """The patches of the coming step, and what draws the rest of it."""
        rng = np.random.default_rng([self.seed, 1, self.step])
        chosen = rng.integers(data.ensure(self.step), size=self.schedule.batch)
        return draw_batch(data.pixels, chosen, data.truth(chosen), self.schedule, rng), rng

    def _losses(self, batch: Batch, rng: np.random.Generator) -> dict[str, Tensor]:
        is_half = self.device.type != "cpu" or processor.has_bfloat16()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=is_half):
            out = self.net(batch.images, batch.shape)
        parts = loss.dense(
            out, batch.labels, (batch.centre - (STRIDE - 1) / 2.0) / STRIDE, torch.log(batch.length / REFERENCE_PX)
        )
        shift, stretch = self.schedule.region
        n = len(batch.length)
        off = torch.from_numpy(rng.normal(0.0, shift, (n, 2)).astype(np.float32)).to(self.device)
        size = torch.from_numpy(np.exp(rng.normal(0.0, stretch, n)).astype(np.float32)).to(self.device)
        quaternions = self.net.rotations(out.features, batch.centre + off * batch.length[:, None], batch.length * size)
        hand, forearm = self._hand.to(self.device), self._forearm.to(self.device)
        missed = loss.rotation(loss.matrices(quaternions), batch.rotation, batch.points[:, forearm], batch.points[:, hand])
        seen = torch.isin(batch.labels, torch.tensor(TARGET_LABELS, device=self.device)).sum((1, 2)) >= 8
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
    net = trainer.average.cpu().eval()
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
    *training_flags.of_every("posecnn", 75.0),
    flags.Option("--start", type=Path, metavar="FILE", help="start from these weights instead of random ones"),
    flags.Option("--rate", type=float, default=Schedule.peak_rate, help="peak learning rate"),
    flags.Option(
        "--out", type=Path, default=WEIGHTS, show_default="the committed ones", help="the weights, their card beside them"
    ),
    flags.Option("--held-out", type=flags.positive, default=500, help="pictures for the calibration, and as many for the score"),
    *training_flags.on_device("patches"),
    example="penumbra posecnn train --minutes 75 --out posecnn.npz",
)
def main(options: flags.Options) -> int:
    """Trains, then writes weights and card."""
    schedule = replace(Schedule(), peak_rate=options.rate).times(options.times)
    if checkpoint := training.begun(options):
        trainer = Trainer.restore(checkpoint, schedule)
    elif options.start is not None:
        trainer = Trainer.begin(options.start, schedule, options.seed)
    else:
        trainer = Trainer(PoseCnnSettings(), schedule, options.seed)
    trainer.place(options.device, options.workers)
    data = schedule.pictures(trainer.seed, options.device, options.workers)
    if not training.complete(trainer, data, options):
        return 130
    card = export(trainer, options.out, options.held_out)
    print(f"{options.out}: {card['held_out']}")
    return 0
