"""Makes weights/ again: `penumbra segmentation train`; with --data, weights for a user's own frames and masks.

Every step renders new simulated sequences, which takes a fifth of its time. Step n draws its sequences, patches and colours from
a generator seeded by (seed, n), and all schedules are functions of the progress, so a run of --steps that is interrupted and
resumed ends with the same weights as an uninterrupted one. For days in the background, over several machines:

  OMP_NUM_THREADS=1 nice -n 19 penumbra segmentation train --size 16 32 64 128 --steps 150000 --resume --compact FILE

On a GPU drawing takes longest, so other processes draw, one per core, and a step uses more data at once:

  OMP_NUM_THREADS=1 penumbra segmentation train --device cuda --workers 15 --times 4 --steps 5000

Weights from the ends of successive trainings, each with its rate lowered, have different errors, and their mean may be better
than each: --mean (Izmailov et al. 2018, arXiv:1803.05407). The mean with a training's initial weights is about as good
on the new data, and forgets less: --with-start (Wortsman et al. 2022, arXiv:2109.01903).

With --priors the network also receives silhouettes of robot and target, with --encoder the outputs of filters pretrained on
photographs. A network without them, from --start or --resume, is extended by both, and gives the same masks until it has learned
to use them.
"""

from __future__ import annotations

import datetime
import itertools
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from penumbra.services import flags, training_flags
from penumbra.services.segmentation import inference, prednet
from penumbra.services.segmentation.model import PRIORS, kernels_of
from penumbra.services.segmentation.prednet import PredNet, Settings, State
from penumbra.services.segmentation.training import loss, pretrained, recordings
from penumbra.services.segmentation.training.data import Data, Mixed, Simulated, draw_batch
from penumbra.services.segmentation.training.evaluate import calibrate, held_out
from penumbra.shared import training
from penumbra.shared.native import processor
from penumbra.shared.perception.landmarks import ModelsError, kept


@dataclass(frozen=True)
class Schedule:
    """Training schedule. `peak_rate`: of Adam, reached after `warm_up` steps and lowered over the last share `cool_down`;
    `encoder_share`: share of that rate for the encoder, which is pretrained; `frames`: number per step, few, because many
    sequences teach more than long ones; `alone`: number of first steps in which the encoder learns masks alone, from the same
    number of single frames, each of another sequence, at half of a step's cost; `beside`: number of such frames in each later
    step, as a share of that step's frames; `patches`: (progress from which on, pixels per side, sequences per batch);
    `error_weight`, `focal_weight`, `target_weight`: of the losses besides Dice; `clip`: maximum norm of the gradient;
    `averaging`: of the exported weights; `seen`: (number of frames that the state has seen before the frames of the loss,
    probability)."""

    peak_rate: float = 2e-3
    encoder_share: float = 0.2
    warm_up: int = 100
    cool_down: float = 0.4
    frames: int = 2
    alone: int = 0
    beside: float = 0.0
    patches: tuple[tuple[float, int, int], ...] = ((0.0, 128, 10), (0.6, 160, 6))
    error_weight: float = 0.3
    focal_weight: float = 5.0
    target_weight: float = 1.0
    clip: float = 1.0
    averaging: float = 0.997
    seen: tuple[tuple[int, float], ...] = ((0, 0.55), (4, 0.33), (12, 0.08), (36, 0.04))

    def rate(self, progress: float, steps: int) -> float:
        """The learning rate at a progress in [0, 1] and a number of steps since the optimiser's first."""
        return self.peak_rate * training.trapezoid(progress, steps, self.warm_up, self.cool_down)

    def before(self, rng: np.random.Generator) -> int:
        """Number of frames that the state shall have seen, drawn from `seen`."""
        counts, shares = zip(*self.seen, strict=True)
        return int(rng.choice(counts, p=shares))

    def patch(self, progress: float) -> tuple[int, int]:
        """Pixels per side and sequences per batch at a progress."""
        return next((size, batch) for start, size, batch in reversed(self.patches) if progress >= start)

    def drawn(self, step: int, progress: float) -> Drawn:
        """The training data of a step at a progress."""
        size, batch = self.patch(progress)
        frames = batch * self.frames
        if step < self.alone:
            return Drawn(step, size, sequences=0, frames=self.frames, plain=frames)
        return Drawn(step, size, sequences=batch, frames=self.frames, plain=round(self.beside * frames))


class Drawn(NamedTuple):
    """Training data of a step: patches of `size` pixels per side from `sequences` sequences with `frames` frames each, and from
    `plain` plain frames."""

    step: int
    size: int
    sequences: int
    frames: int
    plain: int


Batch = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""Result of `draw_batch`."""


class Batches(Dataset[tuple[Batch | None, Batch | None]]):
    """Draws the training data of steps: of sequences, and of plain frames."""

    def __init__(self, data: Data, seed: int):
        self._data, self._seed = data, seed

    def __getitem__(self, drawn: Drawn) -> tuple[Batch | None, Batch | None]:
        rng, data = np.random.default_rng([self._seed, 1, drawn.step]), self._data
        size = min(drawn.size, data.side)
        sequences, plain = (
            draw_batch((draw(int(i)) for i in rng.integers(data.count, size=count)), frames, size, rng, data.jitter)
            if count
            else None
            for draw, count, frames in ((data.__getitem__, drawn.sequences, drawn.frames), (data.plain, drawn.plain, 1))
        )
        return sequences, plain


class Trainer(training.Trainer[PredNet, Data]):
    """PredNet being trained."""

    SETTINGS = Settings
    schedule: Schedule

    def __init__(self, settings: Settings, schedule: Schedule, seed: int):
        torch.manual_seed(seed)
        net = PredNet(settings)
        own: list[torch.nn.Parameter] = []
        of_encoder: list[torch.nn.Parameter] = []
        for name, value in net.named_parameters():
            (of_encoder if name.startswith("encoder.") else own).append(value)
        groups: list[dict[str, Any]] = [{"params": own}]
        if of_encoder:
            groups.append({"params": of_encoder, "share": schedule.encoder_share})
        super().__init__(settings, schedule, seed, net, torch.optim.Adam(groups, betas=(0.9, 0.98)))
        self._progress = 0.0
        self._batches: tuple[Data, Iterator[Any]] | None = None

    def train_step(self, data: Data, progress: float) -> dict[str, float]:
        """One step of gradient descent; returns the parts of the loss."""
        self._progress = progress
        if self._batches is None or self._batches[0] is not data:
            self._batches = data, self._coming(data)
        sequences, plain = next(self._batches[1])
        schedule = self.schedule
        weights = {"dice": 1.0, "focal": schedule.focal_weight, "target": schedule.target_weight, "error": schedule.error_weight}
        parts: dict[str, torch.Tensor] = {}
        is_half = self.device.type != "cpu" or processor.has_bfloat16()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=is_half):
            if sequences is not None:
                before = schedule.before(np.random.default_rng([self.seed, 2, self.step]))
                parts |= self._losses(*self._here(sequences), before)
            if plain is not None:
                images, labels, _ = self._here(plain)
                of_plain = self._masks(self.net.glimpsed(images.flatten(0, 1)).float(), labels.flatten(0, 1))
                parts |= {f"plain {name}": value for name, value in of_plain.items()}
        total = torch.stack([weights[name.removeprefix("plain ")] * value for name, value in parts.items()]).sum()
        rate = schedule.rate(progress, self.step - self.warm_from)
        self.descend(total, rate, schedule.clip, schedule.averaging)
        values = torch.stack([*parts.values(), total]).tolist()
        return dict(zip((*parts, "total"), values, strict=True))

    def _coming(self, data: Data) -> Iterator[Any]:
        """The training data of this step and the following ones. If the training time is limited in minutes and processes draw
        ahead, patches get their next size that number of steps late."""

        def following() -> Iterator[Drawn]:
            for step in itertools.count(self.step):
                yield self.schedule.drawn(step, step / self.steps if self.steps else self._progress)

        return iter(
            DataLoader(
                Batches(data, self.seed),
                batch_size=None,
                sampler=following(),
                num_workers=self.workers,
                worker_init_fn=training.alone_on_a_core,
            )
        )

    def _here(self, batch: Batch) -> Batch:
        images, labels, known = (part.to(self.device) for part in batch)
        return images, labels, known

    def _losses(self, images: torch.Tensor, labels: torch.Tensor, known: torch.Tensor, before: int) -> dict[str, torch.Tensor]:
        """Losses of images (batch, frames, 3, h, w) in [0, 1] with labels (batch, frames, h, w) and, for a network with priors,
        known (batch, frames, 2, h, w). `before`: number of frames played without learning, forth and back through the sequence,
        so that the network is also trained with a state that has seen many frames. Without it masks decay within seconds of
        use."""
        frames = images.shape[1]
        seen = {i: part.unflatten(0, images.shape[:2]) for i, part in self.net.look(images.flatten(0, 1)).items()}
        state = self.net.initial_state(images.shape[0], *images.shape[-2:])
        with torch.no_grad():
            for n in range(before, 0, -1):  # the last one played is the second frame, from which the first is one step
                turn, t = divmod(n, frames - 1)
                _, _, state = self._play(images, known, seen, t if turn % 2 == 0 else frames - 1 - t, state)
        logits, errors = [], []
        for t in range(frames):
            out, missed, state = self._play(images, known, seen, t, state)
            logits.append(out.float())
            if t > 0 or before:  # an empty state predicts nothing
                errors.append(loss.prediction_error([m.float() for m in missed]))
        parts = self._masks(torch.cat(logits), labels.transpose(0, 1).flatten(0, 1))
        return parts | {"error": torch.stack(errors).mean()}

    @staticmethod
    def _masks(logits: torch.Tensor, labels: torch.Tensor) -> dict[str, torch.Tensor]:
        """Mask losses of logits (n, classes, h, w) with labels (n, h, w)."""
        return {
            "dice": loss.dice(logits, labels),
            "focal": loss.focal(logits, labels),
            "target": loss.target_dice(logits, labels),
        }

    def _play(
        self, images: torch.Tensor, known: torch.Tensor, seen: prednet.Context, t: int, state: State
    ) -> tuple[torch.Tensor, list[torch.Tensor], State]:
        context = {i: part[:, t] for i, part in seen.items()}
        return self.net(images[:, t], state, known[:, t] if self.settings.priors else None, context)

    @classmethod
    def begin(cls, path: Path, schedule: Schedule, seed: int, channels: tuple[int, ...] | None = None) -> Trainer:
        """A trainer that starts from weights with a card, grown to more channels or layers if `channels` is given; the card that
        it writes names these weights. Raises ValueError if there are fewer channels."""
        net, card = prednet.load(path)
        if channels is not None:
            torch.manual_seed(seed)
            net = prednet.grown(net, replace(net.settings, channels=channels, kernels=kernels_of(len(channels))))
        trainer = cls(net.settings, schedule, seed)
        trainer.net.load_state_dict(net.state_dict())
        trainer.average.load_state_dict(net.state_dict())
        trainer.started_from = _named(card) | ({"started_from": card["started_from"]} if "started_from" in card else {})
        return trainer

    def extended(self, has_priors: bool, pretrained: Mapping[str, torch.Tensor] | None) -> Trainer:
        """This training with priors from its next step on, with an encoder that starts from these weights, or both, and with a
        reset optimiser; returns itself if it has them already."""
        settings = replace(
            self.settings,
            priors=len(PRIORS) if has_priors else self.settings.priors,
            encoder=self.settings.encoder or pretrained is not None,
        )
        if settings == self.settings:
            return self
        trainer = Trainer(settings, self.schedule, self.seed)
        for own, other in ((self.net, trainer.net), (self.average, trainer.average)):
            other.load_state_dict(prednet.grown(own, settings).state_dict())
            if other.encoder is not None and self.net.encoder is None and pretrained is not None:
                other.encoder.load_state_dict(pretrained)
        trainer.step, trainer.minutes, trainer.started_from = self.step, self.minutes, self.started_from
        trainer.warm_from = self.step
        return trainer


def mean(net: PredNet, others: Sequence[PredNet]) -> PredNet:
    """The network whose weights are the mean of those of all. Raises ValueError if their forms differ."""
    for other in others:
        if other.settings != net.settings:
            raise ValueError(f"expected weights of {net.settings}, got some of {other.settings}")
    states = [each.state_dict() for each in (net, *others)]
    out = PredNet(net.settings)
    out.load_state_dict({name: torch.stack([state[name] for state in states]).mean(0) for name in states[0]})
    return out.eval()


def export(trainer: Trainer, out: Path, data: Data, others: Sequence[tuple[PredNet, dict[str, Any]]] = ()) -> dict[str, Any]:
    """Calibrate and score the averaged weights, or their mean with those of other networks with cards, on held-out sequences, and
    write them with their card; returns the card. Raises ValueError as `mean`."""
    net = mean(trainer.average.cpu(), [other for other, _ in others])
    offset, calibrated = calibrate(net, data.calibration)
    card = {
        "seed": trainer.seed,
        "date": datetime.date.today().isoformat(),
        "settings": {
            "schedule": asdict(trainer.schedule),
            "steps": trainer.step,
            "minutes": round(trainer.minutes, 1),
        },
        **({"started_from": trainer.started_from} if trainer.started_from else {}),
        **({"mean_with": [_named(card) for _, card in others]} if others else {}),
        "parameters": sum(p.numel() for p in trainer.net.parameters()),
        "learned_from": [*data.origins, *([pretrained.ORIGIN] if trainer.settings.encoder else [])],
        "calibration": {**data.sources[0], "target_logit_offset": offset, **calibrated},
        "held_out": {**data.sources[1], **held_out(net, offset, data.held_out)},
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    prednet.save(out, net, card)
    return card


def _named(card: Mapping[str, Any]) -> dict[str, Any]:
    """The entry with which a card names another card's weights."""
    named = {key: card[key] for key in ("seed", "date") if key in card}
    return named | {key: card["settings"][key] for key in ("steps", "minutes") if key in card["settings"]}


@flags.command(
    "segmentation train",
    "Trains the segmentation network on simulated sequences, on your own frames and masks, or both.\n\n"
    + (recordings.__doc__ or ""),
    *training_flags.of_every("segmentation", 60.0),
    flags.Option("--size", type=int, takes="many", metavar="N ...", show_default="16 16 32 64", help="channels of each layer"),
    flags.Option("--delay/--no-delay", default=False, help="axonal delays between the layers"),
    flags.Option("--recurrence", choices=tuple(prednet.CELLS), default="hgru", help="what updates the layers' representations"),
    flags.Option("--error-weight", type=float, show_default="0.3; 0: without", help="of the prediction errors in the loss"),
    flags.Option("--priors", is_flag=True, help="the network also receives what is known of the robot and the target"),
    flags.Option(
        "--encoder",
        type=Path,
        takes="maybe",
        without=str(kept()),
        metavar="[FOLDER]",
        help="the network also has an encoder, of the models in this folder (without a value: where they are kept)",
    ),
    flags.Option(
        "--alone",
        type=flags.positive,
        metavar="N",
        show_default="0",
        help="the encoder learns by itself in the first N steps, of recordings with nothing put before them; then all learns",
    ),
    flags.Option(
        "--beside",
        type=flags.above_zero,
        metavar="SHARE",
        show_default="0",
        help="in each later step, too, the encoder learns by itself from so many single frames, as a share of the step's",
    ),
    flags.Option("--rate", type=float, default=Schedule.peak_rate, help="peak learning rate"),
    flags.Option(
        "--start",
        type=Path,
        takes="maybe",
        without=str(inference.WEIGHTS),
        metavar="[FILE]",
        help="start from these weights (without a value: the committed ones), grown to --size, instead of random ones",
    ),
    flags.Option(
        "--mean",
        type=Path,
        takes="many",
        metavar="FILE ...",
        help="write the mean with these weights, of earlier steps or from the same start",
    ),
    flags.Option(
        "--with-start", is_flag=True, help="write the mean with the weights of --start, which forgets less of other scenes"
    ),
    flags.Option(
        "--data",
        type=Path,
        takes="many",
        metavar="FOLDER ...",
        help="your own frames and masks, in the forms above, instead of simulated ones",
    ),
    flags.Option(
        "--simulated",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="with --data: share of simulated sequences, so that nothing is forgotten",
    ),
    flags.Option(
        "--out",
        type=flags.output,
        metavar="FILE",
        show_default="the committed ones; with --data segmentation.npz",
        help="the weights, their card beside them",
    ),
    flags.Option(
        "--held-out", type=flags.positive, default=60, help="simulated sequences for calibration, and as many for the score"
    ),
    *training_flags.on_device("sequences"),
    example="penumbra segmentation train --data recordings --start --minutes 60",
)
def main(options: flags.Options) -> int:
    """Train, then write weights and card."""
    patches = tuple((start, size, batch * options.times) for start, size, batch in Schedule.patches)
    schedule = Schedule(peak_rate=options.rate, alone=options.alone or 0, beside=options.beside or 0.0, patches=patches)
    if options.error_weight is not None:
        schedule = replace(schedule, error_weight=options.error_weight)
    if checkpoint := training.begun(options):
        trainer = Trainer.restore(checkpoint, schedule)
    elif options.start:
        trainer = Trainer.begin(options.start, schedule, options.seed, tuple(options.size) if options.size else None)
    else:
        channels = tuple(options.size or Settings.channels)
        settings = Settings(channels, kernels_of(len(channels)), delay=options.delay, cell=options.recurrence)
        trainer = Trainer(settings, schedule, options.seed)
    try:
        trainer = trainer.extended(options.priors, pretrained.weights(options.encoder) if options.encoder else None)
    except ModelsError as error:
        print(f"penumbra segmentation train: {error}", file=sys.stderr)
        return 2
    given = [flag for flag, value in (("--alone", options.alone), ("--beside", options.beside)) if value]
    if given and not trainer.settings.encoder:
        print(
            f"penumbra segmentation train: {given[0]}: expected a network with an encoder, got one without; add --encoder",
            file=sys.stderr,
        )
        return 2
    if options.with_start and not options.start:
        print("penumbra segmentation train: --with-start: expected --start, got none", file=sys.stderr)
        return 2
    others: list[tuple[PredNet, dict[str, Any]]] = []
    for flag, paths in (("--mean", options.mean or ()), ("--with-start", (options.start,) if options.with_start else ())):
        try:
            others += [prednet.load(path) for path in paths]
            mean(trainer.average, [other for other, _ in others])
        except (OSError, ValueError) as error:
            print(f"penumbra segmentation train: {flag}: {error}", file=sys.stderr)
            return 2
    simulated = Simulated(trainer.seed, options.held_out)
    data: Data = simulated
    try:
        if options.data:
            data = recorded = recordings.Recordings(options.data, trainer.seed)
            if options.simulated:
                data = Mixed(recorded, simulated, options.simulated, trainer.seed)
    except recordings.DataError as error:
        print(f"penumbra segmentation train: {error}", file=sys.stderr)
        return 2
    out = options.out or (Path("segmentation.npz") if options.data else inference.WEIGHTS)
    trainer.place(options.device, options.workers)
    if not training.complete(trainer, data, options):
        return 130
    card = export(trainer, out, data, others)
    print(f"{out}: {card['held_out']}")
    return 0
