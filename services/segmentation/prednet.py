"""PredNet: a stack of layers that predict their own input, and a decoder that reads a mask from them.

One time step (section "PredNet Model"):

1. Bottom-up. Layer l predicts its input A_l from its representation R_l of the previous step. The prediction error E_l is split
   into its positive and negative parts; convolved and pooled it is the input A_{l+1} of the next layer.
2. Top-down. From the last layer to the first, R_l is updated by a cell (hGRU; others for comparison) driven by E_l and R_{l+1}.
3. The mask is decoded from all R_l but the first and from the picture: brought to one resolution, summed, convolved.

Priors, if the network has any (`model.PRIORS`), enter beside the picture and are not predicted: convolved they are added to the
second layer's input from below, through which all layers above receive them, and to the drive of its cell. Unknown priors are
zero and add nothing.

An encoder (`encoder.py`), if the network has one, processes each picture separately. Its outputs are added to the drive of the
cells of all layers but the first and, at its finest resolution, to the sum from which the mask is read; they are not predicted.

The layers see the picture at half its resolution and folded: 2 x 2 means become 12 channels (space to depth). The first layer
therefore works at a quarter of the picture's resolution, the authors' at full resolution; the folding replaces the pooling that
would follow it, and loses no information. The second layer keeps that resolution, each layer above halves it. The mask's decoder
works at half resolution; its contours come from the picture, folded likewise, and from the encoder.

References: Lotter, Kreiman, Cox 2017 (arXiv:1605.08104); Linsley, Kim, Veerabadran, Windolf, Serre 2018 (arXiv:1805.08315).
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from penumbra.services.segmentation import encoder, model
from penumbra.services.segmentation.model import FOLD, SHRINK, Model, Settings
from penumbra.shared.contract.labels import Label

State = tuple[Tensor, ...]
"""State of the network: R_l of every layer and, with axonal delays, E_l after them. Each is (batch, channels, h, w)."""
Context = dict[int, Tensor]
"""The encoder's additions (batch, channels, h, w) to the drive of layers' cells, by layer; entry 0 is added to the sum from which
the mask is read."""


class HGRU(nn.Module):
    """Horizontal gated recurrent unit (Linsley et al. 2018, eq. 4-7), without time-step gains because it runs indefinitely.

    One horizontal kernel W serves both stages: C1 inhibits, C2 excites. Per channel: alpha, mu scale and shift the inhibition,
    kappa, beta, omega weight the input, the excitation and their product.
    """

    def __init__(self, channels: int, kernel: int):
        super().__init__()
        self.horizontal = nn.Conv2d(channels, channels, kernel, padding=kernel // 2, bias=False)
        self.gain_gate = nn.Conv2d(channels, channels, 1)
        self.mix_gate = nn.Conv2d(channels, channels, 1)
        self.alpha, self.mu, self.kappa, self.beta, self.omega = (
            nn.Parameter(torch.full((channels,), value)) for value in (0.1, 0.0, 0.5, 0.5, 0.1)
        )

    def forward(self, drive: Tensor, state: Tensor) -> Tensor:
        """The new state (batch, channels, h, w) from the drive and the old state of the same shape."""
        inhibition = self.horizontal(torch.sigmoid(self.gain_gate(state)) * state)
        first = torch.tanh(drive - inhibition * _scale(state, self.alpha, self.mu))
        excitation = self.horizontal(first)
        mixed = _scale(first, self.kappa) + excitation * _scale(first, self.omega, self.beta)
        gate = torch.sigmoid(self.mix_gate(first))
        return state + (torch.tanh(mixed) - state) * gate


def _scale(x: Tensor, gain: Tensor, offset: Tensor | None = None) -> Tensor:
    """gain * x + offset per channel. It is a 1 x 1 convolution: with channels innermost in memory torch's broadcasting is 4 times
    slower."""
    return F.conv2d(x, torch.diag(gain)[:, :, None, None], offset)


class ConvLSTM(nn.Module):
    """Convolutional long short-term memory (Shi et al. 2015, arXiv:1506.04214, without peepholes). Its state concatenates output
    and memory, with half of the channels each: as many parameters and as large a state as the hGRU's."""

    def __init__(self, channels: int, kernel: int):
        super().__init__()
        half = channels // 2
        self.recurrent = nn.Conv2d(half, 4 * half, kernel, padding=kernel // 2)
        self.input = nn.Conv2d(channels, 4 * half, 1, bias=False)

    def forward(self, drive: Tensor, state: Tensor) -> Tensor:
        """The new state (batch, channels, h, w) from the drive and the old state of the same shape."""
        output, memory = state.chunk(2, 1)
        enter, keep, leave, new = (self.recurrent(output) + self.input(drive)).chunk(4, 1)
        memory = torch.sigmoid(keep) * memory + torch.sigmoid(enter) * torch.tanh(new)
        return torch.cat([torch.sigmoid(leave) * torch.tanh(memory), memory], 1)


class Convolution(nn.Module):
    """A recurrent convolution without gates (Elman's cell): tanh(W * state + V drive)."""

    def __init__(self, channels: int, kernel: int):
        super().__init__()
        self.recurrent = nn.Conv2d(channels, channels, kernel, padding=kernel // 2)
        self.input = nn.Conv2d(channels, channels, 1, bias=False)

    def forward(self, drive: Tensor, state: Tensor) -> Tensor:
        """The new state (batch, channels, h, w) from the drive and the old state of the same shape."""
        return torch.tanh(self.recurrent(state) + self.input(drive))


CELLS: dict[str, type[nn.Module]] = {"hgru": HGRU, "convlstm": ConvLSTM, "conv": Convolution}
"""Cells that update a layer's representation, by their name in the settings."""


class EncoderBlock(nn.Module):
    """A block of the encoder, with the form of `encoder.Block`."""

    def __init__(self, form: encoder.Block):
        super().__init__()
        inner = form.expansion * form.inputs
        self._form = form
        self.expand = nn.Conv2d(form.inputs, inner, 1) if form.expansion > 1 else None
        self.filter = nn.Conv2d(inner, inner, form.kernel, form.stride, groups=inner)
        self.project = nn.Conv2d(inner, form.outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        inner = x if self.expand is None else F.relu6(self.expand(x))
        out: Tensor = self.project(F.relu6(self.filter(_padded(inner, self._form.kernel, self._form.stride))))
        return x + out if self._form.adds_input else out


class Encoder(nn.Module):
    """The encoder of `encoder.py`."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3, encoder.STEM, encoder.STEM_KERNEL, 2)
        self.blocks = nn.ModuleList(EncoderBlock(form) for form in encoder.BLOCKS)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Outputs for images (batch, 3, h, w) in [0, 1]: a tensor (batch, channels, h / stride, w / stride) for each of
        `encoder.STRIDES`."""
        x = F.relu6(self.stem(_padded((image - encoder.MEAN) / encoder.SPREAD, encoder.STEM_KERNEL, 2)))
        found = []
        for i, block in enumerate(self.blocks):
            x = block(x)
            if i in encoder.TAPS:
                found.append(x)
        return found


class Gathering(nn.Module):
    """Decoder of the encoder's outputs, from the coarsest resolution to the finest."""

    def __init__(self) -> None:
        super().__init__()
        widths, below = encoder.WIDTHS, (*encoder.WIDTHS[1:], 0)
        self.narrow = nn.ModuleList(nn.Conv2d(n, width, 1) for n, width in zip(widths[1:], widths[:-1], strict=True))
        self.merge = nn.ModuleList(
            nn.Conv2d(found + (width if deeper else 0), width, 3, padding=1)
            for found, width, deeper in zip(encoder.CHANNELS, widths, below, strict=True)
        )

    def forward(self, found: list[Tensor]) -> list[Tensor]:
        """A tensor (batch, width, h / stride, w / stride) for each of `encoder.STRIDES`, from the encoder's outputs."""
        gathered = [F.relu(self.merge[-1](found[-1]))]
        for k in reversed(range(len(self.narrow))):
            coarser = _enlarged(self.narrow[k](gathered[0]), 2)
            gathered.insert(0, F.relu(self.merge[k](torch.cat([coarser, found[k]], 1))))
        return gathered


def _padded(x: Tensor, kernel: int, stride: int) -> Tensor:
    before, behind = encoder.padding(kernel, stride)
    return F.pad(x, (before, behind, before, behind))


class PredNet(nn.Module):
    """The network described above. Images are (batch, 3, h, w) in [0, 1], h and w multiples of `multiple`; priors (batch, priors,
    h, w) in [-1, 1], or None."""

    def __init__(self, settings: Settings | None = None):
        super().__init__()
        self.settings = settings = settings or Settings()
        c, n = settings.channels, len(settings.channels)
        self._inputs = inputs = [3 * FOLD * FOLD, *c[1:]]  # channels of A_l
        self.predict = nn.ModuleList(nn.Conv2d(c[i], inputs[i], 3, padding=1) for i in range(n))
        self.ascend = nn.ModuleList(nn.Conv2d(2 * inputs[i], inputs[i + 1], 3, padding=1) for i in range(n - 1))
        self.drive = nn.ModuleList(nn.Conv2d(2 * inputs[i], c[i], 3, padding=1) for i in range(n))
        self.descend = nn.ModuleList(nn.Conv2d(c[i + 1], c[i], 1) for i in range(n - 1))
        self.cells = nn.ModuleList(CELLS[settings.cell](c[i], settings.kernels[i]) for i in range(n))
        self.decode = nn.ModuleList(nn.Conv2d(c[i], settings.decoder_channels, 1) for i in range(1, n))
        self.outline = nn.Conv2d(3 * FOLD * FOLD, settings.decoder_channels, 3, padding=1, bias=False)
        self.head = nn.Conv2d(settings.decoder_channels, len(Label) * FOLD * FOLD, 3, padding=1)
        known = settings.priors * FOLD * FOLD
        self.prior_input, self.prior_drive = (
            nn.Conv2d(known, c[1], 3, padding=1, bias=False) if known else None for _ in range(2)
        )
        self.encoder = Encoder() if settings.encoder else None
        self.gather = Gathering() if settings.encoder else None
        receiving = (settings.decoder_channels, *(c[i] for i in settings.driven))
        levels = zip(encoder.WIDTHS, receiving, strict=True) if settings.encoder else ()
        self.context = nn.ModuleList(nn.Conv2d(width, channels, 1, bias=False) for width, channels in levels)
        for module in self.modules():  # channels innermost: fastest for convolutions on a CPU
            if isinstance(module, nn.Conv2d):
                module.weight.data = module.weight.data.contiguous(memory_format=torch.channels_last)

    def initial_state(self, batch: int, height: int, width: int) -> State:
        """The zero state, for images of this size. Raises ValueError if the size does not fit."""
        channels = list(self.settings.channels)
        if self.settings.delay:
            channels += [2 * n for n in self._inputs]
        weight = self.head.weight
        return tuple(
            torch.zeros(batch, c, *size, dtype=weight.dtype, device=weight.device).to(memory_format=torch.channels_last)
            for c, size in zip(channels, self.settings.state_sizes(height, width), strict=True)
        )

    def look(self, image: Tensor) -> Context:
        """The encoder's additions; empty for a network without an encoder."""
        found: Context = {}
        if self.encoder is not None and self.gather is not None:
            gathered = self.gather(self.encoder(image))
            found[0] = self.context[0](gathered[0])
            for k, i in enumerate(self.settings.driven, 1):
                part = _enlarged(self.context[k](gathered[k]), encoder.STRIDES[k] // self.settings.layer_strides[i])
                found[i] = found[i] + part if i in found else part
        return found

    def glimpsed(self, image: Tensor) -> Tensor:
        """Class logits (batch, classes, h, w) of a network with an encoder, computed without the layers."""
        return self._mask(self.outline(F.pixel_unshuffle(image, FOLD)), self.look(image))

    def forward(
        self, image: Tensor, state: State, priors: Tensor | None = None, context: Context | None = None
    ) -> tuple[Tensor, list[Tensor], State]:
        """Run one time step; returns (class logits (batch, classes, h, w), mean absolute prediction error of each layer, new
        state). context: result of `look` for the image, if already computed.

        With axonal delays a layer receives its neighbours' activity of the previous step: layer l receives a picture l steps
        late.
        """
        n = len(self.settings.channels)
        old = state[:n]
        delayed = state[n:]  # with delays: E_l of the previous step
        errors: list[Tensor] = []
        missed: list[Tensor] = []
        arriving = _shrunk(image)
        known = None if priors is None else _shrunk(priors)
        context = self.look(image) if context is None else context
        for i in range(n):
            difference = arriving - self.predict[i](old[i])
            errors.append(F.relu(torch.cat([difference, -difference], 1)))
            missed.append(difference.abs().mean())
            if i + 1 < n:
                up = self.ascend[i](delayed[i] if delayed else errors[i])
                if i == 0 and known is not None and self.prior_input is not None:
                    up = up + self.prior_input(known)
                arriving = F.relu(F.max_pool2d(up, 2) if i > 0 else up)  # the folding acts as the first layer's pooling
        new: list[Tensor] = []
        for i in reversed(range(n)):
            drive = self.drive[i](errors[i])
            if i == 1 and known is not None and self.prior_drive is not None:
                drive = drive + self.prior_drive(known)
            if i > 0 and i in context:
                drive = drive + context[i]
            if i + 1 < n:
                down = self.descend[i](old[i + 1] if delayed else new[0])
                drive = drive + (F.interpolate(down, scale_factor=2, mode="nearest") if i > 0 else down)
            new.insert(0, self.cells[i](drive, old[i]))
        total = self.decode[0](new[1])
        for i in range(2, n):
            total = total + _enlarged(self.decode[i - 1](new[i]), 2 ** (i - 1))
        total = _enlarged(total, SHRINK) + self.outline(F.pixel_unshuffle(image, FOLD))
        return self._mask(total, context), missed, (*new, *(errors if delayed else ()))

    def _mask(self, total: Tensor, context: Context) -> Tensor:
        return F.pixel_shuffle(self.head(F.relu(total + context[0] if 0 in context else total)), FOLD)


def _shrunk(x: Tensor) -> Tensor:
    """Input of the first layer from a picture or from priors."""
    return F.pixel_unshuffle(F.avg_pool2d(x, SHRINK), FOLD)


def _enlarged(x: Tensor, factor: int) -> Tensor:
    return F.interpolate(x, scale_factor=factor, mode="bilinear") if factor > 1 else x


def stored(net: PredNet) -> Model:
    """The network in the form in which it is stored and run."""
    return Model(net.settings, {name: value.detach().float().numpy().copy() for name, value in net.state_dict().items()})


def grown(net: PredNet, settings: Settings) -> PredNet:
    """A network with more channels, layers or priors, or with an encoder, that gives the masks of `net`: its old channels come
    first and receive nothing from the new ones, which are initialised at random (Net2Net, Chen et al. 2016, arXiv:1511.05641),
    and priors and encoder add nothing yet. Raises ValueError if it would not be larger."""
    old, layers = net.settings, len(net.settings.channels)
    same = (
        replace(settings, channels=old.channels, kernels=settings.kernels[:layers], priors=old.priors, encoder=old.encoder) == old
    )
    fewer = any(new < before for new, before in itertools.zip_longest(settings.channels, old.channels, fillvalue=0))
    if not same or fewer or settings.priors < old.priors or settings.encoder < old.encoder:
        raise ValueError(
            f"expected at least the channels {old.channels}, {old.priors} priors and the encoder, if any, of {old}, and "
            f"otherwise the same, got {settings}"
        )
    larger, own = PredNet(settings), dict(net.named_parameters())
    ignored = (f"descend.{layers - 1}.", "decode.", "prior_", "context.")  # inputs of old layers and of the mask from new parts
    with torch.no_grad():
        for name, value in larger.named_parameters():
            before = own.get(name)
            if before is None:
                if name.startswith(ignored):
                    value.zero_()
                continue
            rows = torch.arange(before.shape[0])
            if before.ndim == 1:
                value[rows] = before
                continue
            columns = torch.arange(before.shape[1])
            if name.startswith(("ascend.", "drive.")):  # errors: the positive part, then the negative part
                half = before.shape[1] // 2
                columns[half:] += value.shape[1] // 2 - half
            value[rows] = 0.0
            value[rows[:, None], columns] = before
    return larger


def save(path: Path, net: PredNet, card: dict[str, Any]) -> None:
    """Write weights and their card beside them."""
    model.save(path, stored(net), card)


def load(path: Path) -> tuple[PredNet, dict[str, Any]]:
    """Load the network of a weights file and its card. Raises ValueError if the two do not fit together."""
    network, card = model.load(path)
    net = PredNet(network.settings)
    try:
        net.load_state_dict({name: torch.from_numpy(value) for name, value in network.weights.items()})
    except RuntimeError as error:
        raise ValueError(f"{path}: expected this release's weights of {network.settings}: {error}") from None
    return net.eval(), card
