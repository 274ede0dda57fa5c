"""The search for one target in the masks of one camera: evidence, fit, verdict, and recovery after a loss."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from penumbra.services.search import contour, detect, evidence, paper_search
from penumbra.services.search.evidence import TARGET, Evidence
from penumbra.services.search.image_fit import ImageSettings, fit_image, straightest
from penumbra.services.search.mask_fit import CONVERGED, GOOD, MISFIT, ROUGH, Fit, Limits, Noise, fit, hand_differs, with_prior
from penumbra.services.search.rivals import PASSES, Rivals, against_mirror
from penumbra.services.search.settings import SearchSettings
from penumbra.services.search.shape_fit import fit_shape
from penumbra.services.search.verdict import Findings, explains_mask, is_of_other_shape, least_overlap, verdict
from penumbra.shared.body import anatomy
from penumbra.shared.cell.description import Cell
from penumbra.shared.contract.messages import Mask
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.intrinsics import Intrinsics
from penumbra.shared.perception.robot_depth import RobotDepth
from penumbra.shared.perception.vision import State, VisionEstimate

METHODS = ("default", "paper")
"""Values of `--method`: least squares on the contour, and the paper's ascent on f_m."""


@dataclass(frozen=True)
class Searched(VisionEstimate):
    """`T_searched`: the most probable pose, given the measurement and the prediction; `findings`: by which the pose was judged,
    None where none was found."""

    T_searched: Array
    findings: Findings | None = None


class Search:
    """One target seen by one camera. Raises CellError for a name that the cell does not have."""

    def __init__(
        self,
        cell: Cell,
        camera: str | None = None,
        target: str | None = None,
        method: str = "default",
        noise: Noise | None = None,
        settings: SearchSettings | None = None,
    ):
        if method not in METHODS:
            raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
        self.method, self.settings = method, settings or SearchSettings()
        self._camera = cell.cameras[cell.one("cameras", camera)]
        self._target = cell.targets[cell.one("targets", target)]
        self._model = contour.Model(anatomy.target_mesh(self._target, cell))
        self._reach = self.settings.detect_reach * float(np.ptp(self._model.vertices, axis=0).max())
        self._noise, self._limits = noise or Noise(), Limits()
        self._T_camera_world = rigid.inverse(self._camera.T_world_camera)
        self._axes = np.kron(np.eye(2), self._camera.T_world_camera[:3, :3])  # covariances: camera axes to world axes
        self._robots = RobotDepth(cell, self._T_camera_world)
        self._detected_ns: int | None = None
        self._last: tuple[int, Array] | None = None  # stamp and T_camera_target of the last picture in which it was tracked
        self._rivals = Rivals(self._limits)
        self._beside = np.diag(np.repeat(np.square(self.settings.beside), 3) ** -1.0)
        self._has_other_shape = False  # than the mesh, in the last picture in which it was tracked
        self._sharp = 0  # pictures that showed the mesh, less those in which the target was lost since

    def prepare(self) -> None:
        """Compiles what `update` needs, so that the first frame does not wait for it."""
        joints = {name: np.zeros(len(robot.joints)) for name, robot in self._robots.robots.items()}
        T_home, size = self._target.home.transform, (self._camera.width, self._camera.height)
        k = Intrinsics.of_window(self._camera, 0, 0, 1)
        shown = self._model.silhouette(self._T_camera_world @ T_home, k, (0, 0, *size))
        mask = Mask(stamp_ns=0, labels=shown * np.uint8(self._target.label_values[0]), x0=0, y0=0, scale=1)
        image = np.repeat(mask.labels[..., None] * np.uint8(20), 3, axis=2)
        self.update(mask, T_home, 1e-4 * np.eye(6), joints, image)
        self._detected_ns, self._last, self._has_other_shape, self._sharp = None, None, False, 0
        self._rivals.forget()

    def update(
        self,
        mask: Mask,
        T_prior: Array | None = None,
        prior_covariance: Array | None = None,
        joints: Mapping[str, Array] | None = None,
        image: NDArray[np.uint8] | None = None,
        starts: Sequence[Array] = (),
    ) -> Searched:
        """The estimate of the target's pose from a mask and its image.

        T_prior (4 x 4): the predicted T_world_target, None if unknown; `prior_covariance` (6, 6) along the world's axes; `joints`
        (n,) [rad] by robot, for the exact occlusion by robots; `image` (h, w, 3) uint8 RGB: without it only the mask is used;
        starts (4 x 4 each): first poses T_camera_target for a lost target, from another source than the mask.

        Raises ValueError for a mask or an image that cannot be this camera's.
        """
        h, w = mask.labels.shape
        if mask.scale < 1 or h * mask.scale > 2 * self._camera.height or w * mask.scale > 2 * self._camera.width:
            raise ValueError(
                f"mask: expected a window of an image of {self._camera.width} x {self._camera.height} at a scale of at least 1, "
                f"got {w} x {h} at scale {mask.scale}: check the segmentation's camera"
            )
        if image is not None and image.shape[:2] != (self._camera.height, self._camera.width):
            raise ValueError(
                f"image: expected {self._camera.width} x {self._camera.height} as of the mask's camera, "
                f"got {image.shape[1]} x {image.shape[0]}"
            )
        T_start = self._T_camera_world @ (self._target.home.transform if T_prior is None else T_prior)
        if self.method == "paper":
            return self._paper(self._gather(mask, T_start, joints), T_start)
        tracked, is_certain = None, False
        if T_prior is not None:
            seen, best, is_certain = self._track(mask, T_start, prior_covariance, joints, image)
            tracked = seen, best
            if is_certain:
                prior = np.zeros((6, 6)) if prior_covariance is None else self._regularising(prior_covariance)
                tracked = seen, self._among_rivals(seen, best, mask.stamp_ns, image, T_start, prior)
        if not is_certain:
            tracked = self._found_again(mask, tracked, T_start, prior_covariance, joints, image, starts)
        if tracked is None:
            return self._lost(T_start)
        found = self._judge(*tracked, image is not None, T_start if T_prior is not None else None, prior_covariance)
        if found.state == "tracking":
            self._last = mask.stamp_ns, tracked[1].T_searched
        return found

    def _found_again(
        self,
        mask: Mask,
        tracked: tuple[Evidence, Fit] | None,
        T_start: Array,
        prior_covariance: Array | None,
        joints: Mapping[str, Array] | None,
        image: NDArray[np.uint8] | None,
        starts: Sequence[Array],
    ) -> tuple[Evidence, Fit] | None:
        """The pose found elsewhere than at the prediction, if it is better than `tracked`, the pose found there: near the last
        tracked pose, at one of the starts, or anywhere in the mask."""
        other = None
        if self._last is not None and 0 < mask.stamp_ns - self._last[0] < self.settings.recent_ns:
            seen, found = self._near(mask, self._last[1], T_start, joints)
            if explains_mask(found.overlap, found.misfit, self.settings):
                other = seen, found
        if other is None:
            self._rivals.forget()
            usable = tracked is not None and explains_mask(tracked[1].overlap, tracked[1].misfit, self.settings)
            if self._is_detection_due(mask.stamp_ns, "doubtful" if usable else "lost", bool(starts)):
                other = self._detect(mask, T_start, joints, starts)
        if other is None or (tracked is not None and not self._is_better(other[1], tracked[1], T_start, prior_covariance)):
            return tracked
        found = self._closer(*other, other[1].T_searched, np.zeros((6, 6)), image)
        return other[0], self._among_rivals(other[0], found, mask.stamp_ns, image, found.T, np.zeros((6, 6)))

    def _track(
        self,
        mask: Mask,
        T_start: Array,
        prior_covariance: Array | None,
        joints: Mapping[str, Array] | None,
        image: NDArray[np.uint8] | None,
    ) -> tuple[Evidence, Fit, bool]:
        """The pose near the prediction, and whether no other needs to be searched for. The fit to the mask is rough if an image
        follows. A pose that the image does not confirm is fitted again from mirror images, and behind an unknown occluder. A limb
        that had another shape than the mesh is assumed to keep it."""
        seen = self._gather(mask, T_start, joints, limb=T_start)
        prior = self._regularising(prior_covariance)
        first = self._fit(seen, T_start, T_start, prior, CONVERGED if image is None else ROUGH)
        best = self._closer(seen, first, T_start, prior, image)
        if self._has_other_shape and not best.sharp:
            shaped = self._shaped(seen, best, T_start, prior)
            if is_of_other_shape(shaped.overlap, shaped.shape, self.settings):
                return seen, shaped, True
        if not best.sharp:
            other = self._settled(seen, self._with_mirror(seen, first, T_start, prior), T_start, prior)
            if other is not first:
                first, best = other, self._closer(seen, other, T_start, prior, image)
        if image is not None and not best.sharp and seen.seen_px >= detect.SMALLEST_PX:
            seen, best = self._behind_unknown(seen, mask.labels, T_start, prior, image) or (seen, best)
        fits = best.sharp or (first.overlap >= self.settings.fits_well and first.misfit < self.settings.wrong_misfit)
        return seen, best, fits or seen.seen_px < detect.SMALLEST_PX

    def _among_rivals(
        self, seen: Evidence, best: Fit, stamp_ns: int, image: NDArray[np.uint8] | None, T_prior: Array, prior: Array
    ) -> Fit:
        """The pose that image and prediction prefer: `best` or a rival. prior: information (6, 6) about T_prior."""
        if image is None or not best.sharp:
            self._rivals.forget()
            return best

        def shown(T: Array, passes: int, hand: float) -> Fit:
            def near(start: Fit) -> Fit:
                start = replace(start, hand=hand)
                return fit_image(
                    self._model, start, image, seen, start.T_searched, np.zeros((6, 6)), ImageSettings(passes=passes)
                )

            found = near(replace(best, T=T, T_searched=T))
            if found.sharp or passes < PASSES:  # the latter: not a rival, but the pose itself
                return found
            return near(self._fit(seen, T, T, self._beside, ROUGH))

        def differs(found: Fit) -> int:
            return hand_differs(self._model, found.T_searched, seen)

        return self._rivals.contested(best, stamp_ns, shown, _surprise(T_prior, prior), differs)

    def _behind_unknown(
        self, seen: Evidence, labels: NDArray[np.uint8], T_start: Array, prior: Array, image: NDArray[np.uint8]
    ) -> tuple[Evidence, Fit] | None:
        """The pose behind something that the mask does not label as an occluder; None if the image does not confirm it."""
        state = seen.state.copy()
        predicted = self._model.silhouette(T_start, seen.intrinsics, (0, 0, *state.shape[::-1]))
        evidence.cover_unexplained(state, predicted)
        less = evidence.gather(state, labels, seen.intrinsics, seen.x0, seen.y0, seen.scale)
        closer = self._closer(less, self._fit(less, T_start, T_start, prior), T_start, prior, image)
        return (less, closer) if closer.sharp else None

    def _closer(self, seen: Evidence, found: Fit, T_prior: Array, prior: Array, image: NDArray[np.uint8] | None) -> Fit:
        """The fit refined on the image if that shows edges along the contour; else the fit itself."""
        if image is None or seen.seen_px < detect.SMALLEST_PX:
            return found
        closer = fit_image(self._model, found, image, seen, T_prior, prior)
        if found.hand > 1.0:
            closer = straightest(fit_image(self._model, replace(found, hand=1.0), image, seen, T_prior, prior), closer)
        away = rigid.pose_error(closer.T, T_prior)
        is_expected = bool(prior.any() and away @ prior @ away < self.settings.expected)
        return closer if closer.sharp and closer.overlap >= least_overlap(is_expected, self.settings) else found

    def _gather(self, mask: Mask, T: Array, joints: Mapping[str, Array] | None, limb: Array | None = None) -> Evidence:
        """The evidence of a mask. `limb`: T_camera_target of the limb, if known; beyond its near end the mask is not used."""
        k = Intrinsics.of_window(self._camera, mask.x0, mask.y0, mask.scale)
        depth = self._robots.render(joints, k, mask.labels.shape) if joints else None
        z = self._model.in_camera(T)[:, 2]
        state = evidence.classify(mask.labels, self._target.label_values, depth, (float(z.min()), float(z.max())))
        evidence.cover_outside(state, mask.x0, mask.y0, mask.scale, self._camera)
        if limb is not None:
            evidence.cover_beyond(state, limb, float(self._model.vertices[:, 0].min()) - self.settings.joint_margin, k)
        return evidence.gather(state, mask.labels, k, mask.x0, mask.y0, mask.scale)

    @property
    def _home_information(self) -> Array:
        spread = self._target.home_spread
        return np.diag(np.repeat([spread.position**-2.0, spread.rotation**-2.0], 3))

    def _predicted(self, prior_covariance: Array | None) -> tuple[Array, Array]:
        """The prediction's covariance along the camera's axes, and the floor that is added to it."""
        floor = np.diag(np.repeat(np.square(self.settings.prior_floor), 3))
        covariance = np.zeros((6, 6)) if prior_covariance is None else self._axes.T @ prior_covariance @ self._axes
        return covariance, floor

    def _regularising(self, prior_covariance: Array | None) -> Array:
        """The information (6, 6) about the prediction that regularises the solve."""
        covariance, floor = self._predicted(prior_covariance)
        return np.asarray(np.linalg.inv(self.settings.prior_inflation**2 * covariance + floor), np.float64)

    def _settled(self, seen: Evidence, first: Fit, T_prior: Array, prior: Array) -> Fit:
        """The fit, or, if it is bad, the best of fits beside it: the error is mostly in the roll, or in the sign of the tilt."""
        if seen.seen_px < detect.SMALLEST_PX or first.misfit <= MISFIT:
            return first
        beside = [self._fit(seen, T, T_prior, prior) for T in detect.mirrored(first.T_searched)]
        return min((first, *beside), key=lambda found: found.cost)

    def _is_better(self, other: Fit, first: Fit, T_start: Array, prior_covariance: Array | None) -> bool:
        """Whether another pose explains the mask better, and either the prediction allows it or the first one fails."""
        if other.overlap <= max(first.overlap, self.settings.fits):
            return False
        covariance, floor = self._predicted(prior_covariance)
        error = rigid.pose_error(other.T, T_start)
        distance = error @ np.linalg.solve(covariance + floor + other.covariance, error)
        return bool(first.overlap < self.settings.fits or distance < self.settings.gate)

    def _is_expected(self, found: Fit, T_start: Array, prior_covariance: Array | None) -> bool:
        """Whether the prediction is sure and agrees with the pose found."""
        covariance, floor = self._predicted(prior_covariance)
        distance = float(np.linalg.norm(T_start[:3, 3]))
        sight = T_start[:3, 3] / distance
        across, along = self.settings.sure[0], max(self.settings.sure[0], self.settings.sure[1] * distance)
        scaled = np.eye(3) / across + np.outer(sight, sight) * (1.0 / along - 1.0 / across)
        if np.linalg.eigvalsh(scaled @ covariance[:3, :3] @ scaled)[-1] > 1.0:
            return False
        error = rigid.pose_error(found.T, T_start)
        uncertain = covariance + found.covariance + (floor if prior_covariance is None else 0.0)
        return bool(error @ np.linalg.solve(uncertain, error) < self.settings.expected)

    def _with_mirror(self, seen: Evidence, first: Fit, T_start: Array, prior: Array) -> Fit:
        """The fit from the prediction, merged with the fit from its mirror image if both may be right: an axis nearly parallel to
        the image looks the same tilted either way. They are merged by likelihood, so that the covariance covers both."""
        T_mirror = detect.mirrored(first.T_searched)[0]
        away = rigid.pose_error(T_mirror, T_start)
        if first.overlap < self.settings.fits or (first.misfit < GOOD and away @ prior @ away > self.settings.gate):
            return first
        other = self._fit(seen, T_mirror, T_start, prior)
        if other.cost < first.cost:
            first, other = other, first
        share = 1.0 / (1.0 + np.exp(0.5 * min(other.cost - first.cost, 100.0)))
        if share < 0.01:
            return first
        apart = rigid.pose_error(other.T, first.T)
        covariance = (1.0 - share) * first.covariance + share * other.covariance + share * (1.0 - share) * np.outer(apart, apart)
        return replace(first, T=rigid.perturb(first.T, share * apart), covariance=covariance)

    def _is_detection_due(self, stamp_ns: int, case: str, is_news: bool) -> bool:
        """Whether to detect now. is_news: there are new starts."""
        early = self._detected_ns is not None and 0 < stamp_ns - self._detected_ns < self.settings.detect_every_ns[case]
        if early and not is_news:
            return False
        self._detected_ns = stamp_ns
        return True

    def _detect(
        self, mask: Mask, T_home: Array, joints: Mapping[str, Array] | None, starts: Sequence[Array]
    ) -> tuple[Evidence, Fit] | None:
        """Finds the target anywhere in the mask, not too far from home: the pose that explains most of the first region that it
        fits, found from one of the starts or from the mask's shape."""
        information, best, most = self._home_information, None, (False, 0.0)
        reach_px = self._reach * self._camera.fx / mask.scale / max(T_home[2, 3], contour.NEAR)
        for window, pieces in detect.regions(mask, self._target.label_values, reach_px):
            whole = self._gather(window, T_home, joints)
            for T in self._first_poses(whole, pieces, T_home, joints, starts):
                seen, found = self._near(window, T, T_home, joints)
                away = rigid.pose_error(found.T_searched, T_home)
                explains = explains_mask(found.overlap, found.misfit, self.settings)
                fits = explains, self._overlap(whole, found.T_searched)
                if away @ information @ away < self.settings.home_gate and fits > most:
                    best, most = (seen, found), fits
                if most > (True, self.settings.fits):
                    return best
            if most > (True, self.settings.explained):
                break
        return best

    def _near(self, mask: Mask, T: Array, T_home: Array, joints: Mapping[str, Array] | None) -> tuple[Evidence, Fit]:
        """The pose near T that explains a mask best, not too far from home."""
        seen, information = self._gather(mask, T, joints, limb=T), self._home_information
        return seen, self._settled(seen, self._fit(seen, T, T_home, information), T_home, information)

    def _first_poses(
        self, whole: Evidence, pieces: Sequence[Mask], T_home: Array, joints: Mapping[str, Array] | None, starts: Sequence[Array]
    ) -> Iterator[Array]:
        """Poses from which a region is fitted: the starts with the largest overlap, and the best one of each of its pieces."""
        overlaps = [(self._overlap(whole, T), T) for T in starts]
        near = sorted((pair for pair in overlaps if pair[0] > self.settings.start_overlap), key=lambda pair: -pair[0])
        yield from (T for _, T in near[: self.settings.detect_fits])
        for piece in pieces:
            T = self._best_start(self._gather(piece, T_home, joints), T_home)
            if T is not None:
                yield T

    def _best_start(self, seen: Evidence, T_home: Array) -> Array | None:
        """The pose that best explains the largest region of a mask."""
        spread, information = self._target.home_spread, self._home_information

        def score(share: float, T: Array) -> float:
            angle = np.arccos(np.clip((np.sum(T[:3, :3] * T_home[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
            distance = np.linalg.norm(T[:3, 3] - T_home[:3, 3])
            return share - self.settings.home_weight * float(np.hypot(distance / spread.position, angle / spread.rotation))

        def fitted(T: Array) -> tuple[float, Fit]:
            found = self._fit(seen, T, T_home, information, ROUGH)
            return score(found.overlap, found.T_searched), found

        starts = detect.hypotheses(self._model, seen, T_home)
        if not starts:
            return None
        ranked = sorted(starts, key=lambda T: -score(self._overlap(seen, T), T))
        best = max((fitted(T) for T in ranked[: self.settings.detect_fits]), key=lambda pair: pair[0])
        for T in detect.mirrored(best[1].T_searched):
            best = max(best, fitted(T), key=lambda pair: pair[0])
        return best[1].T_searched

    def _fit(self, seen: Evidence, T_start: Array, T_prior: Array, prior: Array, converged: float = CONVERGED) -> Fit:
        return fit(self._model, T_start, seen, T_prior, prior, self._noise, self._limits, converged)

    def _overlap(self, seen: Evidence, T: Array) -> float:
        h, w = seen.state.shape
        both, free = evidence.compare(seen.state, self._model.silhouette(T, seen.intrinsics, (0, 0, w, h)))
        return both / max(seen.seen_px + free, 1)

    def _judge(
        self, seen: Evidence, best: Fit, with_image: bool, T_prior: Array | None, prior_covariance: Array | None
    ) -> Searched:
        """The estimate from a fit; `with_image`: whether there was an image to confirm it; T_prior: predicted T_camera_target,
        None if unknown: the target is then expected at home."""
        covariance, floor = self._predicted(prior_covariance)
        if T_prior is None:
            T_expected, regular = self._T_camera_world @ self._target.home.transform, self._home_information
            expected = np.asarray(np.linalg.inv(regular), np.float64)
        else:
            T_expected, regular, expected = T_prior, self._regularising(prior_covariance), covariance + floor
        may_differ = self._sharp < self.settings.shape_known[0] and seen.seen_px >= detect.SMALLEST_PX
        if may_differ and best.shape is None and not best.sharp and best.misfit > MISFIT:
            best = self._shaped(seen, best, T_expected, regular)
        is_known = best.shape is None or self._has_other_shape
        is_expected = T_prior is not None and is_known and self._is_expected(best, T_prior, prior_covariance)
        found = self._findings(seen, best, with_image, is_expected, T_expected, expected)
        state = verdict(found, self.settings).state
        self._sharp = min(self._sharp + best.sharp, self.settings.shape_known[1]) if state != "lost" else max(self._sharp - 1, 0)
        if state != "tracking":
            T, covariance = best.T_searched, self._limits.covariance
            return self._estimate(T, covariance, best.overlap, found.hidden, state, T, found)
        self._has_other_shape = best.shape is not None
        T_probable, turning = best.T_searched, np.zeros((6, 6))
        if T_prior is not None and prior_covariance is not None:
            T_probable = with_prior(best.T, best.covariance, T_prior, np.asarray(np.linalg.inv(covariance), np.float64))
        if found.hidden > self.settings.turning[0]:
            axis = best.T[:3, 0]
            turning[3:, 3:] = self.settings.turning[1] ** 2 * np.outer(axis, axis)
        return self._estimate(best.T, best.covariance + turning, best.overlap, found.hidden, state, T_probable, found)

    def _shaped(self, seen: Evidence, found: Fit, T_prior: Array, prior: Array) -> Fit:
        """Fits a limb whose shape is not quite the mesh's."""
        spread = anatomy.SIZE_SPREAD if self._target.size is None else anatomy.SIZE_MEASURED

        def near(T: Array, T_prior: Array, prior: Array) -> Fit:
            start = replace(found, T_searched=T)
            return fit_shape(self._model, start, seen, T_prior, prior, spread, self._noise, self._limits)

        best, none = near(found.T_searched, T_prior, prior), np.zeros((6, 6))
        surprise = _surprise(T_prior, prior)
        return against_mirror(best, lambda T: near(T, T, none), surprise, self.settings.fits_shaped, self._limits)

    def _findings(
        self, seen: Evidence, best: Fit, with_image: bool, is_expected: bool, T_expected: Array, expected: Array
    ) -> Findings:
        """The properties of a fit; expected: covariance (6, 6) of the prediction T_expected (4 x 4)."""
        amodal = max(self._amodal_px(best.T_searched, seen.intrinsics), 1)
        away = rigid.pose_error(best.T, T_expected)
        return Findings(
            overlap=best.overlap,
            misfit=best.misfit,
            is_sharp=best.sharp,
            shape=best.shape,
            points=best.points,
            hidden=float(np.clip(1.0 - seen.seen_px / amodal, 0.0, 1.0)),
            covered=1.0 - (best.both + best.free) / amodal,
            has_image=with_image,
            is_expected=is_expected,
            sigma=_worst(best.covariance),
            surprise=float(away @ np.linalg.solve(expected, away)),
            expected_sigma=_worst(expected),
        )

    def _amodal_px(self, T: Array, k: Intrinsics) -> int:
        """Number of pixels of the whole silhouette, also where it is covered or outside the window."""
        V = self._model.in_camera(T)
        if V[:, 2].min() < contour.NEAR:
            return 0
        u, v = k.fx * V[:, 0] / V[:, 2] + k.cx, k.fy * V[:, 1] / V[:, 2] + k.cy
        x0, y0 = int(np.floor(u.min())), int(np.floor(v.min()))
        window = (x0, y0, min(int(np.ceil(u.max())) - x0 + 1, 4096), min(int(np.ceil(v.max())) - y0 + 1, 4096))
        return int(np.count_nonzero(self._model.silhouette(T, k, window)))

    def _paper(self, seen: Evidence, T_start: Array) -> Searched:
        """The paper's ascent from the prediction. The paper does not describe what follows a loss, but its errors imply that the
        limb is found again: an ascent that ends away from the mask is repeated from poses that may have produced the mask."""
        if seen.seen_px < detect.SMALLEST_PX:  # f_m would then be largest where the silhouette leaves the picture
            return self._lost(T_start)
        mask, k, fails = seen.state == TARGET, seen.intrinsics, self.settings.paper_fails
        T, value = paper_search.ascend(self._model, T_start, mask, k)
        if self._overlap(seen, T) < fails:
            T_home = self._T_camera_world @ self._target.home.transform
            starts = sorted(detect.hypotheses(self._model, seen, T_home), key=lambda start: -self._overlap(seen, start))
            again = (paper_search.ascend(self._model, start, mask, k) for start in starts[: self.settings.detect_fits])
            T, value = max(((T, value), *again), key=lambda found: found[1])
            if self._overlap(seen, T) < fails:
                return self._lost(T_start)
        hidden = float(np.clip(1.0 - seen.seen_px / max(self._amodal_px(T, k), 1), 0.0, 1.0))
        covariance = np.diag(np.repeat(np.square(self.settings.paper_sigma), 3))
        state: State = "occluded" if hidden > self.settings.hidden else "tracking"
        return self._estimate(T, covariance, (value + 1.0) / 2.0, hidden, state, T)

    def _lost(self, T: Array) -> Searched:
        self._has_other_shape = False
        return self._estimate(T, self._limits.covariance, 0.0, 1.0, "lost", T)

    def _estimate(
        self,
        T: Array,
        covariance: Array,
        share: float,
        hidden: float,
        state: State,
        T_searched: Array,
        found: Findings | None = None,
    ) -> Searched:
        T_world_camera = self._camera.T_world_camera
        covariance = self._axes @ covariance @ self._axes.T
        covariance = (covariance + covariance.T) / 2.0
        confidence = found.confidence if found is not None else 0.0 if state == "lost" else None
        T, T_searched = T_world_camera @ T, T_world_camera @ T_searched
        return Searched(T, covariance, share, hidden, state, T_searched, found, confidence=confidence)


def _worst(covariance: Array) -> float:
    """The standard deviation [m] of a position along its worst direction, from the covariance (6, 6) of its pose."""
    return math.sqrt(float(np.linalg.eigvalsh(covariance[:3, :3])[-1]))


def _surprise(T_prior: Array, prior: Array) -> Callable[[Fit], float]:
    """Function that gives a pose's squared Mahalanobis distance from a prediction T_prior (4 x 4) with its information (6, 6)."""

    def distance(found: Fit) -> float:
        away = rigid.pose_error(found.T, T_prior)
        return float(away @ np.linalg.solve(np.eye(6) + prior @ found.covariance, prior @ away))

    return distance
