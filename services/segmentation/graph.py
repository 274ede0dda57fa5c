"""PredNet in OpenVINO's operations, from stored weights: one time step, corresponding line by line to `prednet.PredNet.forward`.

Tensors are (1, channels, h, w), as in torch. Only the input image and the state (input and output) have their channels innermost:
this is their layout in memory and the one that CPU convolutions use, so nothing is reordered.

The graph is built without torch, in some milliseconds. OpenVINO starts a thread when it is imported, so a process that will be
forked imports this module only afterwards.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import openvino
from openvino import opset13 as op

from penumbra.services.segmentation import encoder
from penumbra.services.segmentation.model import FOLD, SHRINK, Model

CHANNELS_FIRST, CHANNELS_LAST = np.array([0, 3, 1, 2]), np.array([0, 2, 3, 1])


def step(model: Model, height: int, width: int, precision: str) -> Any:
    """OpenVINO's model of a time step for images of one size. precision: OpenVINO's name of the state's type, f32 or bf16.

    Inputs: the image (1, h, w, channels) float32 in [0, 1], the tensors of the state (1, h / stride, w / stride, channels), and,
    if the network has any, priors (1, h, w, priors) float32 in [-1, 1]. Outputs: the class logits (1, classes, h, w) float32,
    then the new state. Raises ValueError if the size does not fit.
    """
    inputs, sizes = model.inputs, model.settings.state_sizes(height, width)
    state_type = getattr(openvino.Type, precision)
    image = op.parameter([1, height, width, inputs[0] // FOLD**2], np.float32, "image")
    state = [op.parameter([1, *size, channels], state_type) for size, channels in zip(sizes, model.state_channels, strict=True)]
    known = [op.parameter([1, height, width, model.settings.priors], np.float32, "priors")] if model.settings.priors else []
    first = [_channels_first(tensor) for tensor in (image, *known)]
    logits, new = _Step(model).forward(first[0], [_channels_first(tensor) for tensor in state], *first[1:])
    outputs = [op.convert(logits, "f32"), *(op.convert(op.transpose(r, CHANNELS_LAST), state_type) for r in new)]
    return openvino.Model(outputs, [image, *state, *known], "prednet")


def _channels_first(parameter: Any) -> Any:
    return op.transpose(op.convert(parameter, "f32"), CHANNELS_FIRST)


class _Step:
    """The operations of a time step; layers are named as in the weights."""

    def __init__(self, model: Model):
        self._settings, self._weights = model.settings, model.weights

    def forward(self, image: Any, state: list[Any], priors: Any = None) -> tuple[Any, list[Any]]:
        """(class logits, new state) of an image, the old state and, if the network has any, priors."""
        n = len(self._settings.channels)
        old, delayed = state[:n], state[n:]  # with delays: E_l of the previous step
        errors: list[Any] = []
        arriving = _shrunk(image)
        known = None if priors is None else _shrunk(priors)
        context = self._context(image) if self._settings.encoder else {}
        for i in range(n):
            difference = op.subtract(arriving, self._convolution(f"predict.{i}", old[i]))
            errors.append(op.relu(op.concat([difference, op.negative(difference)], 1)))
            if i + 1 < n:
                up = self._convolution(f"ascend.{i}", delayed[i] if delayed else errors[i])
                if i == 0 and known is not None:
                    up = op.add(up, self._convolution("prior_input", known))
                arriving = op.relu(_pooled(up) if i > 0 else up)
        new: list[Any] = []
        for i in reversed(range(n)):
            drive = self._convolution(f"drive.{i}", errors[i])
            if i == 1 and known is not None:
                drive = op.add(drive, self._convolution("prior_drive", known))
            if i > 0 and i in context:
                drive = op.add(drive, context[i])
            if i + 1 < n:
                down = self._convolution(f"descend.{i}", old[i + 1] if delayed else new[0])
                drive = op.add(drive, _enlarged(down, 2, "nearest") if i > 0 else down)
            new.insert(0, getattr(self, f"_{self._settings.cell}")(f"cells.{i}", drive, old[i]))
        return self._decoded(image, new, context), [*new, *(errors if delayed else ())]

    def _context(self, image: Any) -> dict[int, Any]:
        """The encoder's contribution, as in `prednet.PredNet.look`."""
        x = op.divide(op.subtract(image, np.float32(encoder.MEAN)), np.float32(encoder.SPREAD))
        x = op.clamp(self._filtered("encoder.stem", x, 2), 0.0, 6.0)
        seen: list[Any] = []
        for k, form in enumerate(encoder.BLOCKS):
            name = f"encoder.blocks.{k}"
            inner = op.clamp(self._convolution(f"{name}.expand", x), 0.0, 6.0) if form.expansion > 1 else x
            inner = op.clamp(self._filtered(f"{name}.filter", inner, form.stride), 0.0, 6.0)
            out = self._convolution(f"{name}.project", inner)
            x = op.add(x, out) if form.adds_input else out
            if k in encoder.TAPS:
                seen.append(x)
        gathered: Any = None
        found: dict[int, Any] = {}
        for k in reversed(range(len(seen))):
            if gathered is not None:
                coarser = _enlarged(self._convolution(f"gather.narrow.{k}", gathered), 2, "linear_onnx")
                seen[k] = op.concat([coarser, seen[k]], 1)
            gathered = op.relu(self._convolution(f"gather.merge.{k}", seen[k]))
            i = self._settings.driven[k - 1] if k > 0 else 0  # in place of the first layer, the mask
            factor = encoder.STRIDES[k] // self._settings.layer_strides[i] if k > 0 else 1
            part = _enlarged(self._convolution(f"context.{k}", gathered), factor, "linear_onnx")
            found[i] = op.add(found[i], part) if i in found else part
        return found

    def _decoded(self, image: Any, representations: list[Any], context: dict[int, Any]) -> Any:
        total = self._convolution("decode.0", representations[1])
        for i in range(2, len(representations)):
            part = self._convolution(f"decode.{i - 1}", representations[i])
            total = op.add(total, _enlarged(part, 2 ** (i - 1), "linear_onnx"))
        outline = self._convolution("outline", op.space_to_depth(image, "depth_first", FOLD))
        total = op.add(_enlarged(total, SHRINK, "linear_onnx"), outline)
        total = op.relu(op.add(total, context[0]) if 0 in context else total)
        return op.depth_to_space(self._convolution("head", total), "depth_first", FOLD)

    def _hgru(self, name: str, drive: Any, state: Any) -> Any:
        inhibition = self._convolution(
            f"{name}.horizontal", op.multiply(op.sigmoid(self._convolution(f"{name}.gain_gate", state)), state)
        )
        first = op.tanh(op.subtract(drive, op.multiply(inhibition, self._scaled(name, state, "alpha", "mu"))))
        excitation = self._convolution(f"{name}.horizontal", first)
        mixed = op.add(self._scaled(name, first, "kappa"), op.multiply(excitation, self._scaled(name, first, "omega", "beta")))
        gate = op.sigmoid(self._convolution(f"{name}.mix_gate", first))
        return op.add(state, op.multiply(op.subtract(op.tanh(mixed), state), gate))

    def _convlstm(self, name: str, drive: Any, state: Any) -> Any:
        output, memory = op.split(state, 1, 2).outputs()
        gates = op.add(self._convolution(f"{name}.recurrent", output), self._convolution(f"{name}.input", drive))
        enter, keep, leave, new = op.split(gates, 1, 4).outputs()
        memory = op.add(op.multiply(op.sigmoid(keep), memory), op.multiply(op.sigmoid(enter), op.tanh(new)))
        return op.concat([op.multiply(op.sigmoid(leave), op.tanh(memory)), memory], 1)

    def _conv(self, name: str, drive: Any, state: Any) -> Any:
        return op.tanh(op.add(self._convolution(f"{name}.recurrent", state), self._convolution(f"{name}.input", drive)))

    def _convolution(self, name: str, x: Any) -> Any:
        """A convolution of stride 1 with padding that keeps the size."""
        kernel, bias = self._weights[f"{name}.weight"], self._weights.get(f"{name}.bias")
        padding = [kernel.shape[-1] // 2] * 2
        found = op.convolution(x, op.constant(kernel), [1, 1], padding, padding, [1, 1])
        return found if bias is None else op.add(found, op.constant(bias.reshape(1, -1, 1, 1)))

    def _filtered(self, name: str, x: Any, stride: int) -> Any:
        """A convolution of the encoder, with its zero padding; depthwise if its weights say so."""
        kernel, bias = self._weights[f"{name}.weight"], self._weights[f"{name}.bias"]
        before, behind = encoder.padding(kernel.shape[-1], stride)
        form = [stride] * 2, [before] * 2, [behind] * 2, [1, 1]
        if kernel.shape[1] == 1:
            found = op.group_convolution(x, op.constant(kernel[:, None]), *form)
        else:
            found = op.convolution(x, op.constant(kernel), *form)
        return op.add(found, op.constant(bias.reshape(1, -1, 1, 1)))

    def _scaled(self, name: str, x: Any, gain: str, offset: str | None = None) -> Any:
        """gain * x + offset per channel."""
        scaled = op.multiply(x, self._per_channel(f"{name}.{gain}"))
        return scaled if offset is None else op.add(scaled, self._per_channel(f"{name}.{offset}"))

    def _per_channel(self, name: str) -> Any:
        return op.constant(self._weights[name].reshape(1, -1, 1, 1))


def _shrunk(x: Any) -> Any:
    """Input of the first layer from a picture or from priors."""
    side = [SHRINK, SHRINK]
    return op.space_to_depth(op.avg_pool(x, side, [0, 0], [0, 0], side, False), "depth_first", FOLD)


def _pooled(x: Any) -> Any:
    """Maximum over each 2 x 2 positions."""
    return op.max_pool(x, [2, 2], [1, 1], [0, 0], [0, 0], [2, 2]).output(0)


def _enlarged(x: Any, factor: int, mode: str) -> Any:
    """torch's `interpolate` without aligned corners."""
    if factor == 1:
        return x
    scales, axes = np.array([factor, factor], np.float32), np.array([2, 3])
    where = "asymmetric" if mode == "nearest" else "half_pixel"
    return op.interpolate(x, scales, mode, "scales", axes=axes, coordinate_transformation_mode=where, nearest_mode="floor")
