"""Cramér-Rao bound of the pose of a limb from the pads' voltages, for any estimator, from the field model.

The voltage of an electrode is its signal plus Gaussian noise, so its Fisher information about pose and size is J^T J / variance.
The information of electrodes adds up, and so does that of the prior (Van Trees, Detection, Estimation, and Modulation Theory I,
1968, section 2.4). The size is estimated with the pose, and its uncertainty increases that of the pose.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from penumbra.shared.body.anatomy import SIZE_MEASURED, SIZE_SPREAD
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import Response


def logs(skin: Skin, response: Response, T_world_pads: Array, T_world_target: Array, size: ArrayLike) -> tuple[Array, Array]:
    """Log changes (n,) and their derivatives (n, 8) by the target's pose error along the world's axes and by its size (2,), with
    pads at T_world_pads (p, 4, 4)."""
    T_pads_target = np.stack([rigid.inverse(T) for T in T_world_pads]) @ T_world_target
    values, jacobian = response.logs(T_pads_target, size)
    R = T_world_pads[skin.pad_of, :3, :3]
    for part in (slice(0, 3), slice(3, 6)):
        jacobian[:, part] = np.einsum("nij,nj->ni", R, jacobian[:, part])
    return values, jacobian


def information(
    skin: Skin, response: Response, T_world_pads: Array, T_world_target: Array, size: ArrayLike, samples: int
) -> Array:
    """Fisher information (p, 8, 8), by pad, of the mean of `samples` samples about pose and size. Errors of the field model count
    as noise, and an electrode whose amplitude reaches its full scale contributes nothing."""
    values, jacobian = logs(skin, response, T_world_pads, T_world_target, size)
    signal = skin.gain * skin.sensitivity * np.exp(values)
    variance = skin.noise / samples + (response.error * signal) ** 2
    ends = skin.a3 + skin.polarity * signal
    weight = np.where((ends < skin.full_scale) & (ends > 0.0), signal**2 / variance, 0.0)
    J = jacobian.reshape(len(skin.pads), -1, 8)
    return np.asarray(np.einsum("pei,pej->pij", J * weight.reshape(len(skin.pads), -1, 1), J))


def prior(target: cells.Target) -> Array:
    """Prior information (8, 8) about pose and size: the spread of the target's home, and the spread of sizes between people, or
    of a size that was measured."""
    pose = np.repeat([target.home_spread.position, target.home_spread.rotation], 3)
    return np.diag(np.concatenate([pose, SIZE_SPREAD if target.size is None else SIZE_MEASURED]) ** -2.0)


def position_error(total: Array) -> Array:
    """Root mean square error (...,) [m] of the position at a total information (..., 8, 8), which includes the prior."""
    covariance = np.linalg.inv(total)
    return np.asarray(np.sqrt(np.trace(covariance[..., :3, :3], axis1=-2, axis2=-1)))
