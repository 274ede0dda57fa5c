"""`penumbra bench ablation`: the authors' comparison of what the segmentation network is made of.

Each variant starts from random weights and learns for the same number of steps from the same small patches of the same sequences;
the number is what the first one reaches in --minutes. The scenes are easy, so that minutes suffice for a comparison: a bare arm
before a plain wall, and an occluder of one colour that hides up to 93 % of it. Scored on held-out sequences, calibrated on
others, as `penumbra bench segmentation` does. It says which variant learns faster, not what each can reach.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from penumbra.services import flags
from penumbra.services.segmentation import inference, prednet
from penumbra.services.segmentation.prednet import Settings
from penumbra.services.segmentation.training import evaluate, train
from penumbra.services.segmentation.training.data import Data, Simulated
from penumbra.shared import training
from penumbra.sim.sets import sequences, shots
from penumbra.tests.bench import segmentation
from penumbra.tests.bench.lib import results
from penumbra.tests.bench.lib.results import Part, Result

VARIANTS: dict[str, tuple[Settings, float]] = {
    "hGRU": (Settings(), 0.3),
    "hGRU, axonal delay": (Settings(delay=True), 0.3),
    "ConvLSTM": (Settings(cell="convlstm"), 0.3),
    "plain convolution": (Settings(cell="conv"), 0.3),
    "hGRU, no prediction loss": (Settings(), 0.0),
}
"""By name, the network's settings and the weight of the prediction errors in the loss."""
SIDE = 96
"""Width and height [px] of a sequence's pictures."""
SCHEDULE = replace(train.Schedule(), patches=((0.0, 64, 6),), seen=((0, 0.5), (4, 0.5)))
SEQUENCES = 300
"""Number of training sequences."""
HELD_OUT = 40
"""Number of sequences for the calibration, and of those for the score."""


def easy(seed: int, index: int) -> sequences.Sequence:
    """Eight frames of an easy scene, 1.5 m away from a camera of 320 x 240, cut out around the target."""
    hidden = np.random.default_rng([seed, index]).uniform(0.0, 0.93)
    film = shots.clip(seed, index, 320, 240, 1.5, hidden, "easy", 8)
    labels = np.stack([shot.labels for shot in film])
    shown = np.argwhere(np.isin(labels, inference.TARGET_LABELS))[:, 1:]
    y, x = np.clip((shown.mean(0) - SIDE / 2).astype(int) if len(shown) else (72, 112), 0, (240 - SIDE, 320 - SIDE))
    cut = np.s_[:, y : y + SIDE, x : x + SIDE]
    images = np.stack([shot.image for shot in film if shot.image is not None])
    return sequences.Sequence(images[cut], labels[cut], np.array([shot.hidden for shot in film]))


def learn(name: str, data: Data, seed: int, minutes: float, steps: int | None, folder: Path) -> tuple[train.Trainer, Any]:
    """Trains a variant for a number of steps, or of minutes. Returns the trainer and the parts of the loss at the end."""
    settings, error_weight = VARIANTS[name]
    trainer = train.Trainer(settings, replace(SCHEDULE, error_weight=error_weight), seed)
    last = training.run(trainer, data, steps, minutes, folder / "checkpoint")
    return trainer, {part: round(value, 4) for part, value in last.items()}


def score(trainer: train.Trainer, data: Data, seed: int) -> dict[str, Any]:
    """Scores the averaged weights on held-out sequences, after a calibration on others."""
    offset, _ = evaluate.calibrate(trainer.average, data.calibration)
    segmenter = inference.Segmenter(prednet.stored(trainer.average), offset, has_colours=False)  # the network alone, as theirs
    ms = inference.speed(segmenter, segmentation.VARIETY.size, segmentation.VARIETY.size)
    found = segmentation.result(seed, segmentation.rows(segmenter, data.held_out), [], ms)
    return {"rows": found["rows"], "ms_per_frame": found["ms_per_frame"]}


def tables(result: Result) -> list[Part]:
    """A row for each variant."""
    title = f"IoU mean by hidden share after {result['variants'][0]['steps']} steps, seed {result['seed']}"
    table = Table("variant", "parameters", "0 to 33%", "33 to 66%", "66 to 95%", "contour RMS px", "minutes", "ms", title=title)
    for one in result["variants"]:
        iou = ["-" if row["iou"] is None else f"{row['iou']:.3f}" for row in one["rows"]]
        rms = one["rows"][0]["contour_rms_px"]
        times = (f"{one['minutes']}", f"{one['ms_per_frame']}")
        table.add_row(one["variant"], f"{one['parameters'] / 1e3:.0f} k", *iou, "-" if rms is None else f"{rms:.2f}", *times)
    return [table]


@results.benchmark(
    "ablation",
    __doc__ or "",
    tables,
    flags.Option("--minutes", type=flags.above_zero, default=7.0, help="training of the first variant"),
    flags.Option("--steps", type=flags.positive, help="steps of every variant instead"),
    flags.Option("--seed", type=int, default=1, help="draws weights, training data and, far away, held-out data"),
    example="penumbra bench ablation --json ablation.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    torch.set_num_threads(1)
    console, steps = Console(stderr=True), options.steps
    found: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        data = Simulated(options.seed, HELD_OUT, easy, easy, SEQUENCES)
        for index in range(SEQUENCES):  # rendered ahead, so that the variants' minutes count only learning
            data[index]
        for name in VARIANTS:
            console.print(f"training: {name}")
            trainer, last = learn(name, data, options.seed, options.minutes, steps, Path(folder))
            steps = steps or trainer.step
            parameters = sum(p.numel() for p in trainer.net.parameters())
            about = {"variant": name, "parameters": parameters, "steps": trainer.step, "minutes": round(trainer.minutes, 1)}
            found.append({**about, "loss": last, **score(trainer, data, options.seed)})
            report.save({"seed": options.seed, "variants": found})


if __name__ == "__main__":
    raise SystemExit(main())
