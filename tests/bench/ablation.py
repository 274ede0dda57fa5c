"""`penumbra bench ablation`: the authors' comparison of what the segmentation network is made of.

Each variant starts from random weights and learns for the same number of steps from the same small patches of the same sequences;
the first one's number is what --minutes allow. Scored on held-out sequences as `penumbra bench segmentation` does. So short a
training says which variant learns faster, not what each can reach.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from services.segmentation import evaluate, infer, train
from services.segmentation.prednet import Settings
from sim import sequences
from tests.bench import segmentation

VARIANTS: dict[str, tuple[Settings, float]] = {
    "hGRU": (Settings(), 0.3),
    "hGRU, axonal delay": (Settings(delay=True), 0.3),
    "ConvLSTM": (Settings(cell="convlstm"), 0.3),
    "plain convolution": (Settings(cell="conv"), 0.3),
    "hGRU, no prediction loss": (Settings(), 0.0),
}
"""Network and weight of the prediction errors in the loss."""
PATCHES = ((0.0, 64, 8), (0.5, 96, 4))
CALIBRATION, SCORED = 12, 40
"""Sequences."""


def learn(
    name: str, seed: int, minutes: float, steps: int | None, cache: Path, folder: Path, most: int
) -> tuple[train.Trainer, dict[str, float]]:
    """A variant trained for so many steps, or minutes, and the parts of the loss over its last twentieth."""
    settings, error_weight = VARIANTS[name]
    schedule = replace(train.Schedule(), patches=PATCHES, error_weight=error_weight, most=most)
    trainer = train.Trainer(settings, schedule, seed)
    data = train.DataSet(cache, seed, schedule.most)
    try:
        last = train.run(trainer, data, steps, minutes, folder / "checkpoint")
    finally:
        data.close()
    return trainer, last


def score(trainer: train.Trainer, seed: int, scored: int = SCORED) -> dict[str, Any]:
    """The averaged weights on held-out sequences, calibrated on others."""
    base = segmentation.SEED_BASE + seed
    offset, _ = evaluate.calibrate(trainer.average, (sequences.render(base + 1, i) for i in range(CALIBRATION)))
    segmenter = infer.Segmenter(trainer.average, offset)
    ms = infer.speed(segmenter, segmentation.VARIETY.size, segmentation.VARIETY.size)
    scores = segmentation.rows(segmenter, seed, scored * (segmentation.VARIETY.frames - evaluate.WARM_UP))
    return segmentation.result(seed, scores, [], ms) | {"recovery_frames": None}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="penumbra bench ablation", description=__doc__)
    parser.add_argument("--minutes", type=float, default=7.0, help="training of the first variant (default: 7)")
    parser.add_argument("--steps", type=int, help="steps of every variant instead")
    parser.add_argument("--seed", type=int, default=1, help="draws weights, training data and, far away, held-out data")
    parser.add_argument("--cache", type=Path, help="folder of rendered sequences (default: rendered anew, then deleted)")
    parser.add_argument("--most", type=int, default=400, help="sequences to learn from (default: 400)")
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    console, steps, found = Console(), options.steps, []
    with tempfile.TemporaryDirectory() as folder:
        cache = options.cache or Path(folder) / "sequences"
        for name in VARIANTS:
            console.print(f"training: {name}")
            trainer, last = learn(name, options.seed, options.minutes, steps, cache, Path(folder), options.most)
            steps = steps or trainer.step
            parameters = sum(p.numel() for p in trainer.net.parameters())
            about = {"variant": name, "parameters": parameters, "steps": trainer.step, "minutes": round(trainer.minutes, 1)}
            found.append({**about, "loss": last, **score(trainer, options.seed)})
            if options.json:
                options.json.write_text(json.dumps({"seed": options.seed, "variants": found}, indent=1) + "\n")
    show(found, console)
    return 0


def show(found: list[dict[str, Any]], console: Console) -> None:
    title = f"IoU mean by hidden share after {found[0]['steps']} steps, seed {found[0]['seed']}"
    table = Table("variant", "parameters", "0 to 33%", "33 to 66%", "66 to 95%", "contour RMS px", "minutes", "ms", title=title)
    for one in found:
        iou = ["-" if row["iou"] is None else f"{row['iou']:.3f}" for row in one["rows"]]
        rms = one["rows"][0]["contour_rms_px"]
        times = (f"{one['minutes']}", f"{one['ms_per_frame']}")
        table.add_row(one["variant"], f"{one['parameters'] / 1e3:.0f} k", *iou, "-" if rms is None else f"{rms:.2f}", *times)
    console.print(table)


if __name__ == "__main__":
    raise SystemExit(main())
