"""Moves the recurrent state along with the window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from penumbra.services.segmentation.openvino_step import State
from penumbra.shared.perception.lookout import Window


def shift_state(state: State, strides: Sequence[int], old: Window, new: Window) -> State:
    """The recurrent state of `old`, shifted to `new` (same scale): the overlap is kept, the rest is zero.

    Raises ValueError if the windows are not a whole number of the coarsest layer's positions apart.
    """
    unit = max(strides) * old.scale
    if old.scale != new.scale or (new.x0 - old.x0) % unit or (new.y0 - old.y0) % unit:
        raise ValueError(f"expected windows of one scale, multiples of {unit} pixels apart, got {old} and {new}")
    out = []
    for tensor, stride in zip(state, strides, strict=True):
        dx, dy = ((new.x0 - old.x0) // (old.scale * stride), (new.y0 - old.y0) // (old.scale * stride))
        height, width = new.height // stride, new.width // stride
        moved = np.zeros((1, height, width, tensor.shape[-1]), tensor.dtype)
        rows = slice(max(0, dy), max(max(0, dy), min(tensor.shape[1], height + dy)))
        columns = slice(max(0, dx), max(max(0, dx), min(tensor.shape[2], width + dx)))
        moved[:, rows.start - dy : rows.stop - dy, columns.start - dx : columns.stop - dx] = tensor[:, rows, columns]
        out.append(moved)
    return tuple(out)
