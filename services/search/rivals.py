"""Rivals of a tracked limb's pose, which explain the picture as well: another roll if the hand is hidden, another tilt if the
limb lies in the image plane.

A forearm is nearly round. Without its hand, a limb that is turned over has almost the same contour, and every fit keeps the
roll that it started from, right or wrong. So rivals are fitted to the picture: turns about the limb's axis, the mirror image of
its tilt, and another tilt: nearly across the line of sight, two tilts to the same side may have much the same contour (about 5
and 27 degrees), each with a minimum of its own. A rival that the image does not confirm where it begins is fitted to the mask
first: a turned limb of which only a piece shows lies elsewhere. The evidence of the pictures about a rival is summed. A rival
that the pictures and the prediction prefer replaces the pose, and all rivals are compared anew. Until that is done, it keeps
its place in the next pictures, in which a fit from the prediction, which has the pose before, would end there again. A rival
that is not refuted makes the pose as uncertain as the two are apart, until it is compared again; so does one that was not
compared yet. The prediction counts because it knows the pictures before: a limb does not turn over because something hides its
hand. A turn whose fit ends at the pose is no other pose for now, and the evidence about it starts over: where a hand turns past
the view in which both its turns look the same, the two poses meet and part again, and what was said before does not tell which
of them is right. The mirror image meets the pose whenever the limb lies across the line of sight, and is held to what was said
before.

With a bent hand, a wrong rival may look right, as the mesh's stiff hand then points to where the bent one is. So if the hand is
bent, only the forearms are compared.

One rival is compared per picture: all nine at once would delay the first pictures of a limb that was just found, and it would
have moved by then. The mirror image comes first, also when another rival has won, as it is the farthest away: a limb found again
with the wrong tilt is 10 cm off. Once all were compared, every second comparison is of a rival that the pictures clearly prefer
to the pose, if there is one, so that a right one wins within a few pictures. If all are refuted, pictures are skipped, as a
comparison costs as much as the pose itself, and every second comparison is of one of the nearest turns: a pose whose hand comes
out from behind something may drift away from the right roll, and leave it a turn of 30 degrees behind. A limb that is not quite
the mesh has its mirror image as a rival in each picture (`against_mirror`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from penumbra.services.search import detect
from penumbra.services.search.image_fit import TYPICAL, straightest
from penumbra.services.search.mask_fit import MOST_BENT, Fit, Limits
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

Shown = Callable[[Array, int, float], Fit]
"""Function of T (4 x 4), passes and hand: the pose near T after at most `passes` steps, with the hand's contour `hand` times as
uncertain as the forearm's (`mask_fit.Fit.hand`)."""
TURNS = tuple(math.radians(degrees) for degrees in (180.0, 30.0, -30.0, 60.0, -60.0, 120.0, -120.0))
"""Turns of the rivals about the limb's axis [rad], spaced by the reach of `PASSES` steps of a fit, and by half of that next to
the pose. Measured: a fit that starts 60 degrees from a pose that is off by 35 ends elsewhere."""
TILT_RAD = math.radians(22.0)
"""Distance [rad] of another tilt, and minimum one of the mirror image, which is the pose itself if a limb lies in the image
plane. Fits to pictures of visible limbs that began so far from the right tilt ended 14 to 24 degrees from it, if elsewhere."""
MIRROR, TILT = 0, len(TURNS) + 1
RIVALS = TILT + 1
"""Number of rivals: the mirror image, which is the first, the turns, and the other tilt, away from the image plane if the limb
lies nearly in it, and towards it if not."""
NEAREST = (2, 3)
"""The rivals that are turned by 30 degrees."""
PASSES = 8
"""Maximum number of steps of a rival's fit."""
REFUTED = 9.0
"""Difference of two poses' costs, `Fit.cost` plus the squared distance from the prediction, from which the worse pose is refuted:
three standard deviations. If even the better pose fits worse than noise explains, the difference of `Fit.cost` counts less."""
PREFERRED = 18.0
"""The difference from which a rival replaces the pose, and up to which a rival that did keeps its place until all are compared.
Chosen: half as much also let wrong poses replace it."""
SURPRISING = 9.0
"""Maximum squared Mahalanobis distance from the prediction that counts: a prediction may be wrong, so it counts no more than a
picture that refutes. With twice as much, 1.7 % of the fused poses of the paper's experiment were beyond three sigma instead of
0.7 %, and a limb that was predicted the wrong way round stayed so."""
LASTS, LASTS_FOREARM = 10.0, 30.0
"""Number of pictures in a row in which the same one of two poses may be wrong; the second if only the forearm decides, as the
hand is bent or the limb is not quite the mesh. An observer treats the pictures' errors as independent: ten pictures that slightly
prefer the wrong turn would convince it. With ten for bent hands, 8 % of the fused poses were outside the 99.7 % bound of place
and axis, instead of 5 % (30 streams of 2 s, seeds 76 to 78)."""
REST_NS = 140_000_000
"""Time [ns] between two comparisons while all rivals are refuted: the nearest turns are compared at least every 0.6 s and the
others every 2.5 s, or in every fourth and eighteenth picture if pictures are rarer."""
KEPT, MOST = 0.7, 6.0
"""Share of the evidence about a rival that is kept until it is compared again, and maximum evidence of one picture against it:
two pictures are needed to refute it, and several with a slight preference decide together. Chosen."""
HAND_PX, MOST_BY_HAND = 7.0, 9.0
"""Number of pixels of a hand in which mask and silhouette differ that counts as much as a cost of one: so many are wrong where
the mask's boundary is off by a standard deviation over its correlation length (`Noise`); and the most that they count in a
picture, as a mask's errors last."""
APART_RAD = 0.2
"""Angle [rad] below which two poses count as one."""
ASKEW_RAD = 0.4
"""Angle [rad] between two axes above which it is another tilt, and not another roll."""


class Rivals:
    """The rivals of one tracked limb."""

    def __init__(self, limits: Limits):
        self._limits = limits
        self.forget()

    def forget(self) -> None:
        """Start over, as with another limb."""
        self._nearest = 0
        self._begin()

    def _begin(self, won: int | None = None) -> None:
        """Compare all rivals again, with another pose of the same limb: the rival that won, if one did. The mirror image of a
        mirror image is the pose before, which has just lost."""
        self._next = MIRROR + 1 if won == MIRROR else MIRROR
        self._evidence: list[float | None] = [None] * RIVALS
        self._doubts: list[Array | None] = [None] * RIVALS
        self._before: Array | None = None
        self._compared_ns, self._is_repeat_due = 0, False

    def contested(
        self, best: Fit, stamp_ns: int, shown: Shown, surprise: Callable[[Fit], float], differs: Callable[[Fit], int]
    ) -> Fit:
        """`best`, or a rival if the picture of this stamp and the prediction prefer it, with the uncertainty that its rivals add.

        shown: fits to the image, without a prediction; surprise(fit): squared Mahalanobis distance of a pose from the prediction;
        differs(fit): number of pixels in which its hand and the mask differ.
        """

        def unlikelier(other: Fit) -> float:
            return min(surprise(other), SURPRISING) - min(surprise(best), SURPRISING)

        if self._before is not None and _angle(self._before, best.T) > APART_RAD:  # it jumped: the pose before is its rival
            other = _fitted(self._before, best, shown)
            excess = _excess(other, best, shown, differs) + unlikelier(other)
            if other.sharp and excess < (PREFERRED if None in self._evidence else 0.0):
                best = other
            elif not _is_same(other, best):
                self._begin()
        if self._is_due(stamp_ns):
            which = self._chosen()
            other = _fitted(_start(best, which), best, shown)
            evidence = KEPT * (self._evidence[which] or 0.0) + min(_excess(other, best, shown, differs), MOST)
            excess = evidence + unlikelier(other)
            if which != MIRROR and other.sharp and _is_same(other, best):
                self._evidence[which], self._doubts[which] = 0.0, None
            elif excess < -PREFERRED:
                self._begin(which)
                best = other
            else:
                self._evidence[which] = evidence
                self._doubts[which] = self._doubt(best, other.T, other.covariance, excess) if excess < REFUTED else None
        self._before = best.T
        axes, covariance = _axes(best), best.covariance
        for which, left in enumerate(self._doubts):
            if self._evidence[which] is None:  # not compared yet: assumed to fit as well as the pose
                T = _start(best, which)
                left = self._doubt(best, T, np.zeros((6, 6)), unlikelier(replace(best, T=T)))
            if left is not None:
                covariance = covariance + axes @ left @ axes.T
        return replace(best, covariance=covariance)

    def _is_due(self, stamp_ns: int) -> bool:
        """Whether to compare a rival in the picture of this stamp."""
        if self._are_refuted and 0 <= stamp_ns - self._compared_ns < REST_NS:
            return False
        self._compared_ns = stamp_ns
        return True

    def _chosen(self) -> int:
        """The rival to compare: the next one in turn, but every second time, once all were compared, the one that the pictures
        prefer most to the pose, if they do so clearly, or one of the nearest turns, if all are refuted."""
        compared = [evidence for evidence in self._evidence if evidence is not None]
        if len(compared) == RIVALS:
            self._is_repeat_due = not self._is_repeat_due
            if self._is_repeat_due and min(compared) < -MOST:
                return compared.index(min(compared))
            if self._is_repeat_due and self._are_refuted:
                self._nearest = (self._nearest + 1) % len(NEAREST)
                return NEAREST[self._nearest]
        which, self._next = self._next, (self._next + 1) % RIVALS
        return which

    @property
    def _are_refuted(self) -> bool:
        return None not in self._evidence and not any(doubt is not None for doubt in self._doubts)

    def _doubt(self, best: Fit, T: Array, covariance: Array, excess: float) -> Array:
        """The covariance that a rival adds (`_added`), along the limb's axes."""
        axes = _axes(best)
        return np.asarray(axes.T @ _added(best, T, covariance, excess, self._limits) @ axes, np.float64)


def against_mirror(
    best: Fit, near: Callable[[Array], Fit], surprise: Callable[[Fit], float], overlap: float, limits: Limits
) -> Fit:
    """The pose of a limb that is not quite the mesh, or its mirror image if fit and prediction together prefer it, as uncertain
    as the two are apart.

    near(T): such a pose near T (4 x 4), without a prediction; surprise(fit): as of `Rivals.contested`; overlap: minimum
    `Fit.overlap` of a rival.
    """
    T = detect.mirrored(best.T_searched)[0]
    if _angle(T, best.T_searched) < ASKEW_RAD:
        return best
    other = near(T)
    if other.overlap < overlap or _is_same(other, best):
        return best
    excess = other.cost - best.cost + min(surprise(other), SURPRISING) - min(surprise(best), SURPRISING)
    if excess < 0.0:
        best, other, excess = other, best, -excess
    return replace(best, covariance=best.covariance + _added(best, other.T, other.covariance, excess, limits))


def _added(best: Fit, T: Array, covariance: Array, excess: float, limits: Limits) -> Array:
    """The covariance (6, 6) that a rival T (4 x 4) adds to that of the best pose: the rival's share of the probability of both,
    times its own covariance plus `LASTS` times the square of their difference. excess: of its cost over the pose's."""
    apart = rigid.pose_error(T, best.T)
    apart[3:] /= max(1.0, float(np.linalg.norm(apart[3:])) / limits.rotation)
    share = 1.0 / (1.0 + math.exp(0.5 * min(excess, 100.0)))
    lasts = LASTS if best.hand == 1.0 and best.shape is None else LASTS_FOREARM
    return np.asarray(share * (covariance + lasts * np.outer(apart, apart)), np.float64)


def _start(best: Fit, which: int) -> Array:
    """The pose from which a rival is fitted."""
    T = best.T_searched
    tilt = detect.tilt(T)
    is_across = abs(tilt) < 0.5 * TILT_RAD
    if which == MIRROR:
        return detect.tilted(T, -math.copysign(TILT_RAD if is_across else 2.0 * abs(tilt), tilt))
    if which == TILT:
        return detect.tilted(T, math.copysign(TILT_RAD, tilt if is_across else -tilt))
    return detect.rolled(T, TURNS[which - 1])


def _fitted(T: Array, best: Fit, shown: Shown) -> Fit:
    """The rival near T (4 x 4). If the best pose's hand is bent, the rival's may be bent, too, and the forearm decides, unless
    the mesh's stiff hand fits there as well as the forearm: a bent hand hardly ever looks like it."""
    straight = shown(T, PASSES, 1.0)
    if best.hand == 1.0:
        return straight
    return straightest(straight, shown(T, PASSES, MOST_BENT))


def _excess(other: Fit, best: Fit, shown: Shown, differs: Callable[[Fit], int]) -> float:
    """By how much a rival's cost exceeds that of the best pose; infinite if the two are the same pose, or the image does not
    confirm the rival.

    Costs are scaled to the longer of the two contours: a hand seen edge on has less contour than one that shows its fingers, and
    must not gain by that. A thumb in the picture that a turn does not show costs its contour nothing: the mask tells, if both
    hands are believed."""
    if not other.sharp or _is_same(other, best):
        return math.inf
    here = best if best.hand == other.hand else shown(best.T_searched, 1, other.hand)
    longer = max(other.points, here.points)
    excess = longer * (other.cost / other.points - here.cost / here.points)
    excess /= max(1.0, min(other.rms, here.rms) / TYPICAL) ** 2
    if best.hand == other.hand == 1.0 and other.T[:3, 0] @ best.T[:3, 0] > math.cos(ASKEW_RAD):
        excess += min(max((differs(other) - differs(best)) / HAND_PX, -MOST_BY_HAND), MOST_BY_HAND)
    return excess


def _is_same(other: Fit, best: Fit) -> bool:
    return _angle(other.T, best.T) < APART_RAD


def _angle(a: Array, b: Array) -> float:
    return float(np.linalg.norm(rigid.pose_error(a, b)[3:]))


def _axes(fit: Fit) -> Array:
    """Matrix (6, 6) that takes a pose error from the limb's axes to the camera's."""
    return np.asarray(np.kron(np.eye(2), fit.T[:3, :3]), np.float64)
