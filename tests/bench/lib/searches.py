"""Single searches: a picture whose target is hidden by a given share, a start 2 cm and 4 degrees off, an exact mask or the
network's, and the errors of the pose found. Benchmarks and fits share them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from penumbra.services.search.mask_fit import Noise
from penumbra.services.search.tracker import Search, Searched
from penumbra.services.search.verdict import WRONG
from penumbra.services.segmentation.inference import Segmenter
from penumbra.shared.contract.messages import Mask
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.lookout import Window, corners_of, whole_frame, window_around
from penumbra.sim.sets.shots import Shot

HIDDEN = (0.0, 0.3, 0.6, 0.85)
VIEWS = ((320, 240, 1.5), (640, 480, 1.5), (1280, 960, 4.5), (1280, 960, 8.0))
"""Width and height of the pictures [px], distance [m]."""
NEES_VIEW = VIEWS[1]
"""View of the NEES, of the goals for the whole chain, and of the frames for the other numbers."""
START = (0.02, np.radians(4.0))
"""Root mean square length of the starts' errors: position [m], rotation [rad]."""
PRIOR = np.diag(np.repeat(np.square(START) / 3.0, 3))
"""Covariance of the starts, the same along any axes."""
EXACT = Noise(edge=0.29, correlation=2.0, dilation=0.02)
"""Noise of an exact mask, for the search: uniform in a pixel, and the stairs of a slanted edge repeat it."""


@dataclass(frozen=True)
class Result:
    """One search of one frame, its time [ms], and its errors: position, depth (along the line of sight) and lateral [m], axis and
    roll [rad]."""

    estimate: Searched
    shot: Shot
    ms: float

    @property
    def error(self) -> Array:
        return rigid.pose_error(self.shot.T_world_target, self.estimate.T)

    @property
    def position(self) -> float:
        return float(np.linalg.norm(self.error[:3]))

    @property
    def with_prior(self) -> float:
        """Position error [m] of the pose that is most probable given the start as a prior."""
        return float(np.linalg.norm(self.shot.T_world_target[:3, 3] - self.estimate.T_searched[:3, 3]))

    @property
    def depth(self) -> float:
        sight = self.shot.T_world_target[:3, 3] - self.shot.camera.T_world_camera[:3, 3]
        return float(abs(self.error[:3] @ sight) / np.linalg.norm(sight))

    @property
    def lateral(self) -> float:
        return float(np.sqrt(max(self.position**2 - self.depth**2, 0.0)))

    @property
    def axis(self) -> float:
        return rigid.axis_angle_error(self.shot.T_world_target, self.estimate.T)

    @property
    def roll(self) -> float:
        """Twist about the limb's axis of the rotation between the two poses."""
        x, _, _, w = Rotation.from_matrix(self.shot.T_world_target[:3, :3].T @ self.estimate.T[:3, :3]).as_quat()
        return float(abs((2.0 * np.arctan2(x, w) + np.pi) % (2.0 * np.pi) - np.pi))

    @property
    def is_wrong(self) -> bool:
        return bool(self.position > WRONG[0] or self.axis > WRONG[1])


def perturbed(rng: np.random.Generator) -> Array:
    """A random pose error (6,) of a start."""
    return rng.normal(size=6) * np.sqrt(np.diag(PRIOR))


def search_of(shot: Shot, method: str, exact: bool) -> Search:
    return Search(shot.cell, method=method, noise=EXACT if exact else None)


def searched(shot: Shot, search: Search, mask: Mask, T_prior: Array | None) -> Result:
    """One update and its processor time, which excludes other processes."""
    begin = time.process_time()
    estimate = search.update(mask, T_prior, None if T_prior is None else PRIOR, shot.joints, shot.image)
    return Result(estimate, shot, 1e3 * (time.process_time() - begin))


def window_of(shot: Shot, T: Array, previous: Window | None = None) -> Window:
    """The window that the segmentation service would cut around a pose."""
    around = window_around(shot.camera, [(T, corners_of(shot.mesh.vertices))], previous)
    return around or whole_frame(shot.camera)


def around(error: Array) -> Callable[[Shot, Window | None], Window]:
    """The window around the true pose moved by an error (6,), for a frame and the window before."""
    return lambda shot, previous: window_of(shot, rigid.perturb(shot.T_world_target, error), previous)


def exact_mask(shot: Shot, window: Window) -> Mask:
    """The labels of a window at the picture's own resolution."""
    labels = np.ascontiguousarray(shot.labels[window.y0 : window.bottom, window.x0 : window.right])
    return Mask(stamp_ns=shot.stamp_ns, labels=labels, x0=window.x0, y0=window.y0, scale=1)


def network_masks(segmenter: Segmenter, film: list[Shot], window_at: Callable[[Shot, Window | None], Window]) -> Iterator[Mask]:
    """The masks of a film, in the window that `window_at` gives for each frame and the window before."""
    window = None
    for shot in film:
        window = window_at(shot, window)
        assert shot.image is not None
        labels = segmenter(shot.image, window, shot.stamp_ns)
        yield Mask(stamp_ns=shot.stamp_ns, labels=labels, x0=window.x0, y0=window.y0, scale=window.scale)
