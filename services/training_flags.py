"""The flags of trainings (`shared.training`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from penumbra.services import flags

if TYPE_CHECKING:
    import torch


def of_every(name: str, minutes: float) -> tuple[flags.Option, ...]:
    """The flags of every training; minutes: its default duration."""
    return (
        flags.Option(
            "--minutes",
            type=flags.above_zero,
            default=minutes,
            callback=_one_of("steps"),
            help="of the processor's time to train",
        ),
        flags.Option(
            "--steps",
            type=flags.positive,
            callback=_one_of("minutes"),
            help="train for so many steps instead: the same result on every run of one machine",
        ),
        flags.Option("--seed", type=int, default=0, help="of data, initial weights and batches"),
        flags.Option("--checkpoint", type=Path, default=Path(f"{name}.checkpoint"), help="written every few minutes"),
        flags.Option(
            "--compact",
            type=Path,
            metavar="FILE",
            help="a checkpoint of a quarter of the size, written as often: to keep with the sources",
        ),
        flags.Option(
            "--resume",
            is_flag=True,
            help="continue from the checkpoint if there is one, else from the compact one if there is",
        ),
    )


def on_device(drawn: str) -> tuple[flags.Option, ...]:
    """The flags of a training on any device, with other processes that draw what is learned from (`drawn`)."""
    return (
        flags.Option(
            "--device", type=_device, default="cpu", metavar="NAME", help="that the network is on, as torch names it: cuda, say"
        ),
        flags.Option(
            "--workers",
            type=flags.natural,
            default=0,
            metavar="N",
            help="other processes that draw what is learned from; their time is not counted",
        ),
        flags.Option(
            "--times",
            type=flags.positive,
            default=1,
            metavar="N",
            help=f"N times as many {drawn} a step, where a device has room for them",
        ),
    )


def _device(text: str) -> torch.device:
    import torch  # here, because only trainings have it

    try:
        return torch.empty(0, device=text).device
    except (RuntimeError, AssertionError) as error:
        there = ", ".join(["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))])
        raise ValueError(f"expected a device that torch has here ({there}), got {text!r}: {error}") from None


def _one_of(other: str) -> Callable[[click.Context, click.Parameter, Any], Any]:
    """Refuse a flag together with another one of the same meaning."""

    def check(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
        names = sorted((str(param.name), other))
        if all(ctx.get_parameter_source(name) is flags.COMMAND_LINE for name in names):
            ctx.fail(f"expected --{' or --'.join(names)}, got both")
        return value

    return check
