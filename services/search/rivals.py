"""Other poses of a tracked limb that explain the picture as well: its roll where the hand is hidden, its tilt where it lies
in the image plane.

A forearm is nearly round: without its hand, a limb that is turned over has almost the same contour, and every fit stays with
the turn that it began with, surely or not. So its rivals are fitted to the picture: turns about the limb's axis, and the mirror
image of its tilt. What the pictures say of a rival adds up. One that they and the prediction prefer takes the pose's place, and
the others are its rivals then. Until all have been compared it keeps that place in the next pictures, where a fit from the
prediction, which has the turn before, would end there again. A rival that they cannot refute makes the pose as uncertain as the
two are apart, until it is compared again; so does one that was not compared yet. What the prediction says it knows from the
pictures before: a limb does not turn over because something hides its hand.

A bent hand makes one of them look right, as the mesh's stiff one then points where the bent one is; so where the hand is bent the
forearms are compared alone.

One is compared in a picture: eight times as many in the first ones would have a limb that was just found wait, and it would be
elsewhere by then. The mirror image comes first, as it is the farthest away: a limb found again with the wrong tilt is 10 cm off.
Once all were compared, the one that is refuted least comes every second time, and the refuted ones wait while others are left, so
that a rival that is right wins within a few pictures. Where all are refuted, pictures go by without: a comparison costs as much
as the pose itself. A limb that is not quite the mesh has its mirror image as a rival in each picture (`against_mirror`).
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
"""The pose near T (4 x 4) after at most so many steps, with the hand's contour so many times as uncertain as the forearm's
(`mask_fit.Fit.hand`)."""
TURNS = tuple(math.radians(degrees) for degrees in (180.0, 30.0, -30.0, 60.0, -60.0, 120.0, -120.0))
"""Turns of the rivals about the limb's axis [rad]: as far apart as `PASSES` steps of a fit reach, and half of that beside the
pose. Measured: a fit that starts 60 degrees from a pose that is off by 35 ends elsewhere."""
RIVALS = len(TURNS) + 1
"""Number of rivals: the turns, and the mirror image."""
PASSES = 8
"""Steps of a rival's fit, at most."""
REFUTED = 9.0
"""Difference of two poses' `Fit.cost`, and of what the prediction says of them, from which the worse one is refuted: three
standard deviations. Where even the better one fits worse than noise explains, the cost's difference counts less."""
PREFERRED = 18.0
"""The same from which a rival takes the pose's place, and up to which one that did keeps it until all are compared. Chosen: half
as much let poses that are wrong as well take it."""
SURPRISING = 9.0
"""Largest squared Mahalanobis distance from the prediction that counts: a prediction may be wrong, so it says no more than a
picture that refutes. With twice as much, 1.7 % of the fused poses of the paper's experiment were beyond three sigma in place of
0.7 %, and a limb that was predicted the wrong way round stayed so."""
LASTS, LASTS_FOREARM = 10.0, 30.0
"""Number of pictures in a row of which the same one of two poses may be the wrong one, and where only the forearm tells, as the
hand is bent or the limb is not quite the mesh. An observer takes the pictures' errors for independent: ten that prefer the wrong
turn a little would convince it. Of bent hands, with ten 8 % of the fused poses were farther off in place and axis than 99.7 % are
to be, in place of 5 % (30 streams of 2 s, seeds 76 to 78)."""
REST_NS = 140_000_000
"""Time [ns] between two comparisons while all rivals are refuted: each is compared every 1.1 s, or in each eighth picture where
pictures are rarer."""
KEPT, MOST = 0.7, 6.0
"""Share of the evidence about a rival that is kept until it is compared again, and the most that one picture says against it: two
have to refute it, and several that prefer one of the two a little decide together. Chosen."""
APART_RAD = 0.2
"""Poses that differ by less are one."""
JUMPED_RAD = 0.4
"""A pose that differs by more from that in the picture before has jumped: then that one is its rival."""


class Rivals:
    """The rivals of one tracked limb."""

    def __init__(self, limits: Limits):
        self._limits = limits
        self.forget()

    def forget(self) -> None:
        """Begin anew, as with another limb."""
        self._next = 0
        self._is_least_due = False
        self._begin()

    def _begin(self) -> None:
        """Compare all again with another pose of the same limb."""
        self._evidence: list[float | None] = [None] * RIVALS
        self._doubts: list[Array | None] = [None] * RIVALS
        self._before: Array | None = None
        self._compared_ns = 0

    def contested(self, best: Fit, stamp_ns: int, shown: Shown, surprise: Callable[[Fit], float]) -> Fit:
        """`best`, or a rival where the picture of this stamp and the prediction prefer that, as uncertain as rivals make it.

        shown: of the image, without regard to a prediction; surprise(fit): the squared Mahalanobis distance of a pose from the
        prediction.
        """

        def unlikelier(other: Fit) -> float:
            return min(surprise(other), SURPRISING) - min(surprise(best), SURPRISING)

        if self._before is not None and _angle(self._before, best.T) > JUMPED_RAD:
            other = _fitted(self._before, best, shown)
            excess = _excess(other, best, shown) + unlikelier(other)
            if other.sharp and excess < (PREFERRED if None in self._evidence else 0.0):
                best = other
            else:
                self._begin()
        if self._is_due(stamp_ns):
            which = self._chosen()
            other = _fitted(_start(best, which), best, shown)
            evidence = KEPT * (self._evidence[which] or 0.0) + min(_excess(other, best, shown), MOST)
            excess = evidence + unlikelier(other)
            if excess < -PREFERRED:
                self._begin()
                best = other
            else:
                self._evidence[which] = evidence
                self._doubts[which] = self._doubt(best, other.T, other.covariance, excess) if excess < REFUTED else None
        self._before = best.T
        axes, covariance = _axes(best), best.covariance
        for which, left in enumerate(self._doubts):
            if self._evidence[which] is None:  # not compared yet: as sure of its place as the pose itself
                T = _start(best, which)
                left = self._doubt(best, T, np.zeros((6, 6)), unlikelier(replace(best, T=T)))
            if left is not None:
                covariance = covariance + axes @ left @ axes.T
        return replace(best, covariance=covariance)

    def _is_due(self, stamp_ns: int) -> bool:
        """Whether to compare a rival in the picture of this stamp."""
        are_refuted = None not in self._evidence and not any(doubt is not None for doubt in self._doubts)
        if are_refuted and 0 <= stamp_ns - self._compared_ns < REST_NS:
            return False
        self._compared_ns = stamp_ns
        return True

    def _chosen(self) -> int:
        """The rival to compare: the next one that is not refuted, but once all were compared every second time the one that is
        refuted least."""
        evidence = [-math.inf if known is None else known for known in self._evidence]
        self._is_least_due = not self._is_least_due
        if self._is_least_due and -math.inf < min(evidence) < REFUTED:
            return evidence.index(min(evidence))
        in_turn = [(self._next + k) % RIVALS for k in range(RIVALS)]
        which = next((k for k in in_turn if evidence[k] < REFUTED), self._next)
        self._next = (which + 1) % RIVALS
        return which

    def _doubt(self, best: Fit, T: Array, covariance: Array, excess: float) -> Array:
        """What a rival adds (`_added`), along the limb's axes."""
        axes = _axes(best)
        return np.asarray(axes.T @ _added(best, T, covariance, excess, self._limits) @ axes, np.float64)


def against_mirror(
    best: Fit, near: Callable[[Array], Fit], surprise: Callable[[Fit], float], overlap: float, limits: Limits
) -> Fit:
    """The pose of a limb that is not quite the mesh, or its mirror image where that and the prediction are likelier together, as
    uncertain as the two are apart.

    near(T): such a pose near T (4 x 4), without regard to a prediction; surprise(fit): as of `Rivals.contested`; overlap: that a
    rival has at least (`Fit.overlap`).
    """
    T = detect.mirrored(best.T_searched)[0]
    if _angle(T, best.T_searched) < JUMPED_RAD:
        return best
    other = near(T)
    if other.overlap < overlap or _angle(other.T, best.T) < APART_RAD:
        return best
    excess = other.cost - best.cost + min(surprise(other), SURPRISING) - min(surprise(best), SURPRISING)
    if excess < 0.0:
        best, other, excess = other, best, -excess
    return replace(best, covariance=best.covariance + _added(best, other.T, other.covariance, excess, limits))


def _added(best: Fit, T: Array, covariance: Array, excess: float, limits: Limits) -> Array:
    """What a rival T (4 x 4) adds to the covariance (6, 6) of the best pose: as much of its own covariance, and of the square of
    what they are apart, `LASTS` times, as it has of the probability of both. excess: by how much its cost is above the pose's."""
    apart = rigid.pose_error(T, best.T)
    apart[3:] /= max(1.0, float(np.linalg.norm(apart[3:])) / limits.rotation)
    share = 1.0 / (1.0 + math.exp(0.5 * min(excess, 100.0)))
    lasts = LASTS if best.hand == 1.0 and best.shape is None else LASTS_FOREARM
    return np.asarray(share * (covariance + lasts * np.outer(apart, apart)), np.float64)


def _start(best: Fit, which: int) -> Array:
    """The pose from which to fit a rival."""
    T = best.T_searched.copy()
    if which == 0:
        return detect.mirrored(T)[0]
    T[:3, :3] = rigid.rotation(TURNS[which - 1] * T[:3, 0]) @ T[:3, :3]
    return T


def _fitted(T: Array, best: Fit, shown: Shown) -> Fit:
    """The rival near T (4 x 4). Where the best pose's hand is bent, the rival's may be, too, and the forearm decides, unless the
    mesh's stiff hand fits there as well as the forearm: a bent one hardly ever looks like it."""
    straight = shown(T, PASSES, 1.0)
    if best.hand == 1.0:
        return straight
    return straightest(straight, shown(T, PASSES, MOST_BENT))


def _excess(other: Fit, best: Fit, shown: Shown) -> float:
    """By how much a rival's cost is above that of the best pose; infinite where it is the same pose, or none. Costs are taken for
    the longer of the two contours: a hand that is seen edge on has less of it than one that shows its fingers, and must not be
    the cheaper for what it leaves unexplained."""
    if not other.sharp or _angle(other.T, best.T) < APART_RAD:
        return math.inf
    here = best if best.hand == other.hand else shown(best.T_searched, 1, other.hand)
    longer = max(other.points, here.points)
    excess = longer * (other.cost / other.points - here.cost / here.points)
    return excess / max(1.0, min(other.rms, here.rms) / TYPICAL) ** 2


def _angle(a: Array, b: Array) -> float:
    return float(np.linalg.norm(rigid.pose_error(a, b)[3:]))


def _axes(fit: Fit) -> Array:
    """From the limb's axes to the camera's, of a pose error (6, 6)."""
    return np.asarray(np.kron(np.eye(2), fit.T[:3, :3]), np.float64)
