"""The paper's search: gradient ascent on the overlap f_m of the mask and the mesh's candidate mask.

It adds nothing to the paper: covered pixels are scored as if the target were not there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from penumbra.services.search.contour import Model
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.intrinsics import Intrinsics


@dataclass(frozen=True)
class Ascent:
    """`sample` [m, rad]: step of the central differences that estimate the Jacobian of f_m; `step`, `smallest`: first and minimum
    step as multiples of it; `iterations`: maximum number. The paper leaves them open; these find the maximum from 2 cm and 4
    deg."""

    sample: tuple[float, ...] = (0.004, 0.004, 0.02, 0.03, 0.03, 0.03)
    step: float = 2.0
    smallest: float = 0.05
    iterations: int = 40


def f_m(m: NDArray[np.bool_], m_hat: NDArray[np.bool_]) -> float:
    """The overlap in [-1, 1] of two masks (h, w): sum over i, j of 4 (m - 1/2) (m_hat - 1/2) / (w h), the paper's f_m.

    A pixel in which they agree counts 1, one in which they differ -1, so f_m is 1 - 2 * (share that differs).
    """
    return 1.0 - 2.0 * np.count_nonzero(m != m_hat) / m.size


def ascend(
    model: Model, T_previous: Array, m: NDArray[np.bool_], k: Intrinsics, ascent: Ascent | None = None
) -> tuple[Array, float]:
    """The pose T_camera_target of maximum overlap near the previous frame's, argmax of f_m(m, f_g(x, Omega)), and its f_m.

    The ascent follows the Jacobian of f_m, estimated by central differences along all six directions; a step that gains nothing
    is halved.
    """
    ascent = ascent or Ascent()
    h, w = m.shape
    sample = np.array(ascent.sample)

    def score(T: Array) -> float:
        return f_m(m, model.silhouette(T, k, (0, 0, w, h)))  # f_g: the candidate mask of a pose

    T, best, step = T_previous, score(T_previous), ascent.step
    for _ in range(ascent.iterations):
        jacobian = np.empty(6)
        for i, distance in enumerate(np.diag(sample)):
            jacobian[i] = score(rigid.perturb(T, distance)) - score(rigid.perturb(T, -distance))
        size = float(np.linalg.norm(jacobian))
        if size == 0.0:
            break
        while step >= ascent.smallest:
            candidate = rigid.perturb(T, step * sample * jacobian / size)
            value = score(candidate)
            if value > best:
                T, best, step = candidate, value, step * 1.5
                break
            step /= 2.0
        else:
            break
    return T, best
