"""The training loss: sum of the layers' prediction errors + Dice + focal (section "PredNet Model"), plus the Dice loss of the
target's classes as one, which the search uses. UNLABELLED pixels are ignored."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from penumbra.services.segmentation.inference import TARGET_LABELS
from penumbra.shared.contract.labels import UNLABELLED

ERROR_WEIGHTS = (1.0, 0.1)
"""Weights of the prediction error of the first layer and of every other layer, as in Lotter et al. 2017 (L_all): an upper layer
can also lower its error by sending nothing, so it must not weigh as much as the picture's."""


def dice(logits: Tensor, labels: Tensor, smooth: float = 20.0) -> Tensor:
    """1 - the mean over the classes present of 2 |P and T| / (|P| + |T|) (Milletari et al. 2016, doi:10.1109/3DV.2016.79).

    logits (batch, classes, h, w), labels (batch, h, w) int64; counted over the whole batch. `smooth` [pixels] keeps a class of a
    few pixels from weighing as much as a large one.
    """
    known = (labels != UNLABELLED)[:, None]
    probability = logits.softmax(1) * known
    truth = F.one_hot(labels.where(known[:, 0], 0), logits.shape[1]).movedim(-1, 1) * known.to(probability.dtype)
    both, sum_p, sum_t = ((probability * truth).sum((0, 2, 3)), probability.sum((0, 2, 3)), truth.sum((0, 2, 3)))
    score = (2.0 * both + smooth) / (sum_p + sum_t + smooth)
    present = sum_t > 0
    return 1.0 - score[present].mean()


def target_dice(logits: Tensor, labels: Tensor, smooth: float = 20.0) -> Tensor:
    """1 - the mean over the pictures that show the target of 2 |P and T| / (|P| + |T|), with its classes taken as one: a picture
    with a small visible part weighs as much as another. Shapes as for `dice`."""
    target = list(TARGET_LABELS)
    probability = logits.softmax(1)[:, target].sum(1) * (labels != UNLABELLED)
    truth = torch.isin(labels, labels.new_tensor(target)).to(probability.dtype)
    both, sum_p, sum_t = ((probability * truth).sum((1, 2)), probability.sum((1, 2)), truth.sum((1, 2)))
    score = (2.0 * both + smooth) / (sum_p + sum_t + smooth)
    shown = sum_t > 0
    return 1.0 - (score[shown].mean() if shown.any() else score.mean())


def focal(logits: Tensor, labels: Tensor, gamma: float = 2.0) -> Tensor:
    """Mean of -(1 - p)^gamma log p of the true class (Lin et al. 2017, doi:10.1109/ICCV.2017.324). Shapes as for `dice`."""
    log_p = -F.cross_entropy(logits, labels, reduction="none", ignore_index=UNLABELLED)  # zero where unlabelled
    return (-((1.0 - log_p.exp()) ** gamma) * log_p).sum() / (labels != UNLABELLED).sum().clamp(min=1)


def prediction_error(missed: list[Tensor]) -> Tensor:
    """The weighted sum of the layers' mean absolute prediction errors."""
    return ERROR_WEIGHTS[0] * missed[0] + ERROR_WEIGHTS[1] * torch.stack(missed[1:]).sum()
