"""The loop that every network's training runs: so many steps, or minutes over all runs, with checkpoints and a progress bar."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Protocol, TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

D = TypeVar("D", contravariant=True)


class Trainer(Protocol[D]):
    """A network that learns from data. step, minutes: so many so far, over all runs."""

    step: int
    minutes: float

    def train_step(self, data: D, progress: float) -> dict[str, float]:
        """A step at a share of the whole training in [0, 1]; returns the parts of its loss."""
        ...

    def save(self, path: Path) -> None:
        """Writes a checkpoint."""
        ...


def run(
    trainer: Trainer[D], data: D, steps: int | None, minutes: float, checkpoint: Path, save_every_s: float = 120.0
) -> dict[str, float]:
    """Train up to so many steps, or minutes (over all runs); shows a progress bar. Returns the loss's parts, smoothed."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    total = steps if steps is not None else int(minutes * 60)
    saved = last = time.monotonic()
    smooth: dict[str, float] = {}
    with Progress(*columns) as bar:
        task = bar.add_task("steps" if steps is not None else "seconds", total=total)
        while (progress := trainer.step / steps if steps is not None else trainer.minutes / minutes if minutes else 1.0) < 1.0:
            for name, value in trainer.train_step(data, progress).items():
                smooth[name] = value if name not in smooth else smooth[name] + 0.02 * (value - smooth[name])
            now = time.monotonic()
            trainer.minutes += (now - last) / 60.0
            last = now
            text = "  ".join(f"{name} {value:.3f}" for name, value in smooth.items())
            bar.update(task, completed=int(progress * total), description=f"step {trainer.step}  {text}")
            if now - saved > save_every_s:
                trainer.save(checkpoint)
                saved = now
    trainer.save(checkpoint)
    return smooth
