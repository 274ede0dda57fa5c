"""Training of networks: a trainer with checkpoints, and the loop over steps or minutes of all runs.

A training may run for days, in the background of other work. Time is processor time, so that a process that is stopped (SIGSTOP)
or waits loses nothing. Checkpoints are replaced atomically. Beside the exact checkpoint a compact one can be written, small
enough to travel with the sources from one machine to the next.
"""

from __future__ import annotations

import copy
import math
import signal
import time
from abc import ABC, abstractmethod
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch.optim.swa_utils import get_ema_multi_avg_fn


class Data(Protocol):
    """Training data, possibly with a generator in the background."""

    def close(self) -> None:
        """Stop generating data."""


D = TypeVar("D", bound=Data)
N = TypeVar("N", bound=torch.nn.Module)


class Trainer(ABC, Generic[N, D]):
    """A network `net` with its data, its optimiser, and the running average of its weights, which is exported.

    SETTINGS: the dataclass of the network's settings. step, minutes (of processor time): progress over all runs. steps: total
    number of steps, None where minutes end the training. warm_from: step at which the optimiser was empty. started_from: entry in
    the card of the weights that the training started from, None where it started from none. device, workers: `place`.
    """

    SETTINGS: ClassVar[type]

    def __init__(self, settings: Any, schedule: Any, seed: int, net: N, optimizer: torch.optim.Optimizer):
        self.settings, self.schedule, self.seed = settings, schedule, seed
        self.net, self.average, self.optimizer = net, copy.deepcopy(net), optimizer
        self.step, self.minutes, self.warm_from = 0, 0.0, 0
        self.steps: int | None = None
        self.started_from: dict[str, Any] | None = None
        self.device, self.workers = torch.device("cpu"), 0

    def place(self, device: torch.device, workers: int) -> None:
        """Move the network to a device and set the number of processes that draw the next steps' data; with 0 each step draws its
        own."""
        for net in (self.net, self.average):
            net.to(device)
        self.optimizer.load_state_dict(self.optimizer.state_dict())  # moves its state to the device of the weights
        self.device, self.workers = device, workers

    @abstractmethod
    def train_step(self, data: D, progress: float) -> dict[str, float]:
        """Trains one step. progress: share of the whole training, in [0, 1]. Returns the parts of the loss."""

    def descend(self, total: torch.Tensor, rate: float, clip: float, averaging: float) -> None:
        """Takes a gradient step on a loss, with clipped norm. The average keeps a share `averaging`, less in the beginning. A
        parameter group of the optimiser with a "share" learns at that share of the rate."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group.get("share", 1.0)
        self.optimizer.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), clip)
        self.optimizer.step()
        self.step += 1
        keep = min(averaging, self.step / (self.step + 10.0))
        pairs = zip(self.average.state_dict().values(), self.net.state_dict().values(), strict=True)
        means, values = zip(*((mean, value) for mean, value in pairs if mean.is_floating_point()), strict=True)
        get_ema_multi_avg_fn(keep)(means, values, None)

    def save(self, path: Path, is_compact: bool = False) -> None:
        """Writes a checkpoint from which `restore` continues exactly. With `is_compact` it has a quarter of the size: half
        precision, and no moments of the optimiser, which Adam accumulates again within its first hundred steps."""

        def stored(net: torch.nn.Module) -> dict[str, torch.Tensor]:
            values = net.state_dict()
            return {name: value.half() if value.is_floating_point() else value for name, value in values.items()}

        content = {
            "net": stored(self.net) if is_compact else self.net.state_dict(),
            "average": stored(self.average) if is_compact else self.average.state_dict(),
            "optimizer": None if is_compact else self.optimizer.state_dict(),
            "step": self.step,
            "minutes": self.minutes,
            "warm_from": self.warm_from,
            "settings": asdict(self.settings),
            "seed": self.seed,
            "started_from": self.started_from,
        }
        part = path.with_suffix(".part")
        torch.save(content, part)
        part.replace(path)

    @classmethod
    def restore(cls, path: Path, schedule: Any) -> Self:
        """The trainer of a checkpoint, exact or compact. Network and seed come from the checkpoint."""
        content = torch.load(path, map_location="cpu", weights_only=True)
        trainer = cls(cls.SETTINGS(**content["settings"]), schedule, content["seed"])  # type: ignore[call-arg]
        trainer.net.load_state_dict(content["net"])
        trainer.average.load_state_dict(content["average"])
        trainer.step, trainer.minutes, trainer.started_from = content["step"], content["minutes"], content["started_from"]
        if content["optimizer"] is None:
            trainer.warm_from = trainer.step
        else:
            trainer.optimizer.load_state_dict(content["optimizer"])
            trainer.warm_from = content["warm_from"]
        return trainer


def alone_on_a_core(_: int) -> None:
    """For the beginning of a process that draws: as many threads as cores, in as many processes, only wait for each other."""
    cv2.setNumThreads(0)


def one_cycle(progress: float, rise: float) -> float:
    """Learning rate of the one-cycle policy (Smith 2018, arXiv:1708.07120) as a share of its peak, at a progress in [0, 1]. It
    rises until the progress `rise`."""
    if progress < rise:
        return 0.05 + 0.95 * progress / rise
    fall = min((progress - rise) / (1.0 - rise), 1.0)
    return 0.005 + 0.995 * 0.5 * (1.0 + math.cos(math.pi * fall))


def recoloured(picture: NDArray[np.float32], rng: np.random.Generator, amount: float) -> NDArray[np.float32]:
    """A picture (..., 3) in [0, 1] with random changes of brightness, contrast, saturation and tint of up to `amount`."""
    brightness, contrast, saturation = 1.0 + amount * rng.uniform(-1.0, 1.0, 3)
    gain = (brightness * (1.0 + 0.25 * amount * rng.uniform(-1.0, 1.0, 3))).astype(np.float32)
    grey = picture.mean(axis=-1, keepdims=True)
    picture = grey + np.float32(saturation) * (picture - grey)
    mean = picture.mean()
    changed: NDArray[np.float32] = np.clip((mean + np.float32(contrast) * (picture - mean)) * gain, 0.0, 1.0, dtype=np.float32)
    return changed


def trapezoid(progress: float, steps: int, warm_up: int, cool_down: float) -> float:
    """Learning rate as a share of its peak: it rises over the `warm_up` steps after the optimiser's first, is constant, and falls
    over the last share `cool_down` of the progress in [0, 1]. Unlike a cycle, it can be extended during the training, and the
    averaged weights are good at any time (Hägele et al. 2024, arXiv:2405.18392)."""
    return min((steps + 1) / warm_up, 1.0) * max(min((1.0 - progress) / cool_down, 1.0), 0.005)


def begun(options: SimpleNamespace) -> Path | None:
    """Checkpoint to continue from; None where the options do not ask for it or there is none."""
    places = (options.checkpoint, options.compact) if options.resume else ()
    return next((path for path in places if path is not None and path.is_file()), None)


def complete(trainer: Trainer[Any, D], data: D, options: SimpleNamespace) -> bool:
    """Trains as specified by the flags of `services.training_flags`, on one thread, and closes the data. False where Ctrl-C or
    SIGTERM ended it; then the checkpoint is written, and the output says how to continue."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    torch.set_num_threads(1)
    try:
        run(trainer, data, options.steps, options.minutes, options.checkpoint, options.compact)
    except KeyboardInterrupt:
        save(trainer, options.checkpoint, options.compact)
        print(f"stopped at step {trainer.step}: continue with --resume --checkpoint {options.checkpoint}")
        return False
    finally:
        data.close()
    return True


def save(trainer: Trainer[Any, Any], checkpoint: Path, compact: Path | None) -> None:
    """Writes the exact checkpoint, and the compact one where it is requested."""
    trainer.save(checkpoint)
    if compact is not None:
        trainer.save(compact, is_compact=True)


def run(
    trainer: Trainer[Any, D],
    data: D,
    steps: int | None,
    minutes: float,
    checkpoint: Path,
    compact: Path | None = None,
    save_every_s: float = 120.0,
) -> dict[str, float]:
    """Trains up to a number of steps, or of minutes (over all runs). Shows a progress bar, or, without a terminal, prints a line
    with every checkpoint. Returns the parts of the loss, smoothed."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    total = steps if steps is not None else int(minutes * 60)
    trainer.steps = steps
    saved, last = time.monotonic(), time.process_time()
    smooth: dict[str, float] = {}
    with Progress(*columns) as bar:
        task = bar.add_task("steps" if steps is not None else "seconds", total=total)
        while (progress := trainer.step / steps if steps is not None else trainer.minutes / minutes if minutes else 1.0) < 1.0:
            for name, value in trainer.train_step(data, progress).items():
                smooth[name] = value if name not in smooth else smooth[name] + 0.02 * (value - smooth[name])
            now = time.process_time()
            trainer.minutes += (now - last) / 60.0
            last = now
            text = f"step {trainer.step}  " + "  ".join(f"{name} {value:.3f}" for name, value in smooth.items())
            bar.update(task, completed=int(progress * total), description=text)
            if time.monotonic() - saved > save_every_s:
                save(trainer, checkpoint, compact)
                saved = time.monotonic()
                if not bar.console.is_terminal:
                    print(f"{time.strftime('%d %H:%M:%S')}  {trainer.minutes:.1f} min  {text}", flush=True)
    save(trainer, checkpoint, compact)
    return smooth
