"""The training loss: classes, directions and lengths per pixel, and the rotation by how far it moves the target's points.

Of the paper's two losses of the rotation, PLoss (eq. 4) compares every point with itself, SLoss (eq. 5) with the nearest one,
which forgives turns that map the object to itself. A forearm is nearly symmetric in roll, its hand with the thumb is not. So
points of the forearm are compared with the nearest and points of the hand with themselves: a roll that only the hand shows is
paid for by the hand alone, and turning the limb end for end, which SLoss alone nearly forgives, costs all that it should.
Distances are not squared (as in Wang et al. 2019, doi:10.1109/CVPR.2019.00346): few arms seen wrongly must not outweigh the rest.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from penumbra.services.posecnn.network import Dense, mean_length
from penumbra.shared.contract.labels import TARGET_LABELS


def matrices(quaternions: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4), (x, y, z, w)."""
    x, y, z, w = quaternions.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def rotation(R: Tensor, R_true: Tensor, symmetric: Tensor, other: Tensor) -> Tensor:
    """Mean distance (batch,) by which rotations (batch, 3, 3) put points wrongly, in the points' unit: `symmetric` (batch, n, 3)
    to the nearest of the same points put rightly, `other` (batch, m, 3) to themselves."""
    nearest = torch.cdist(symmetric @ R.mT, symmetric @ R_true.mT, compute_mode="donot_use_mm_for_euclid_dist").min(-1).values
    apart = (other @ (R - R_true).mT).square().sum(-1).clamp_min(1e-12).sqrt()
    return torch.cat([nearest, apart], -1).mean(-1)


def dense(out: Dense, labels: Tensor, centre: Tensor, length: Tensor) -> dict[str, Tensor]:
    """Parts of the loss per position. labels (batch, h, w) int64 at the output's stride, centre (batch, 2) in the output's
    pixels, length (batch,): log of the apparent length over the reference.

    labels: cross entropy; target: 1 - Dice of the target's classes as one, a picture with few of its pixels weighing as much as
    another; direction and length: smooth L1 on the target's visible pixels, every picture weighing the same; distance: that of
    the mean of their lengths by their weights, which the estimator takes.
    """
    (h, w), device = labels.shape[1:], labels.device
    target = torch.isin(labels, torch.tensor(TARGET_LABELS, device=device))
    shown = target.sum((1, 2)) > 0
    share = target / target.sum((1, 2), keepdim=True).clamp_min(1) / shown.sum().clamp_min(1)
    rows, columns = torch.meshgrid(torch.arange(h, device=device), torch.arange(w, device=device), indexing="ij")
    direction = F.normalize(centre[:, :, None, None] - torch.stack([columns, rows])[None], dim=1)
    missed = F.smooth_l1_loss(out.direction, direction, reduction="none", beta=0.1).sum(1)
    probability = out.logits.softmax(1)[:, list(TARGET_LABELS)].sum(1)
    mean = mean_length(out.length, out.weight, target)
    both, total = (probability * target).sum((1, 2)), probability.sum((1, 2)) + target.sum((1, 2))
    return {
        "labels": F.cross_entropy(out.logits, labels),
        "target": 1.0 - ((2.0 * both + 5.0) / (total + 5.0)).mean(),
        "direction": (share * missed).sum(),
        "length": (
            share * F.smooth_l1_loss(out.length, length[:, None, None].expand_as(out.length), reduction="none", beta=0.02)
        ).sum(),
        "distance": (shown * F.smooth_l1_loss(mean, length, reduction="none", beta=0.005)).sum() / shown.sum().clamp_min(1),
    }
