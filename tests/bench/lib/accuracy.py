"""Errors of a chain's estimates by situation (what is seen and felt), for the live chain and the replay.

Errors are taken at each estimate's own stamp against the truth there.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.table import Table
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from penumbra.services import flags
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.geometry import rigid
from penumbra.tests.bench.lib.results import Result, marked

VISIBLE = 0.33
"""Maximum hidden share at which the target counts as visible (the paper's light occlusion)."""
OCCLUDED, OCCLUDED_S = 0.90, 2.0
"""The target counts as occluded when more than this share is hidden for at least this time [s]."""

SENSES = {"vision": topics.VISION, "haptic": topics.HAPTIC, "fused": topics.FUSED}
GOALS_CM = {
    ("visible", "in_range"): 2.0,
    ("visible", "out_of_range"): 2.0,
    ("occluded", "in_range"): 2.5,
    ("occluded", "out_of_range"): None,
}
"""Maximum median position error [cm] of the fused pose by situation; None: no goal."""
CHI2_3_SIGMA = float(chi2.ppf(0.9973, 6))
"""Squared Mahalanobis distance in six dimensions within which 99.73 % of normal errors lie."""
BEYOND_GOAL = 0.001
"""Maximum share of the poses called tracking that are beyond three sigma."""
USED_STATES = {"tracking", "in_range", "coasting"}


@dataclass
class TruthTrack:
    """The truth as arrays over its stamps, and the situation at each of them."""

    stamp_ns: np.ndarray
    position: np.ndarray
    axis: np.ndarray
    hidden: np.ndarray
    gap: np.ndarray

    @classmethod
    def of(cls, truths: list[messages.Truth]) -> TruthTrack:
        truths = sorted(truths, key=lambda truth: truth.stamp_ns)
        axis = Rotation.from_quat([t.orientation for t in truths]).as_matrix()[:, :, 0]
        return cls(
            np.array([t.stamp_ns for t in truths]),
            np.array([t.position for t in truths]),
            axis,
            np.array([t.hidden for t in truths]),
            np.array([t.gap for t in truths]),
        )

    def situations(self, reach: float) -> dict[tuple[str, str], np.ndarray]:
        """By (visible|occluded, in_range|out_of_range), a boolean per stamp. reach: range of the skin [m]."""
        occluded = long_runs(self.hidden > OCCLUDED, self.stamp_ns, OCCLUDED_S)
        sight = {"visible": self.hidden <= VISIBLE, "occluded": occluded}
        skin = {"in_range": self.gap <= reach, "out_of_range": self.gap > reach}
        return {(a, b): seen & felt for a, seen in sight.items() for b, felt in skin.items()}

    def errors(self, estimates: list[Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For estimates within the track: index of the first truth from their stamp on, position error [m], angle between limb
        axes [rad]."""
        estimates = [e for e in estimates if self.stamp_ns[0] <= e.stamp_ns <= self.stamp_ns[-1]]
        if not estimates:
            return np.zeros(0, int), np.zeros(0), np.zeros(0)
        stamps = np.array([e.stamp_ns for e in estimates])
        at = lambda values: np.column_stack([np.interp(stamps, self.stamp_ns, column) for column in values.T])  # noqa: E731
        position = np.linalg.norm(np.array([e.position for e in estimates]) - at(self.position), axis=1)
        axis = Rotation.from_quat([e.orientation for e in estimates]).as_matrix()[:, :, 0]
        truth_axis = at(self.axis)
        cosine = np.sum(axis * truth_axis, axis=1) / np.linalg.norm(truth_axis, axis=1)
        nearest = np.searchsorted(self.stamp_ns, stamps).clip(0, len(self.stamp_ns) - 1)
        return nearest, position, np.arccos(cosine.clip(-1, 1))


def beyond_3_sigma(truths: list[messages.Truth], estimates: list[messages.FusedPose] | list[messages.VisionPose]) -> float | None:
    """Share of the poses called tracking whose squared Mahalanobis distance by their own covariance exceeds CHI2_3_SIGMA; None
    where there are none."""
    order = sorted(truths, key=lambda truth: truth.stamp_ns)
    stamps, wrong = np.array([truth.stamp_ns for truth in order]), []
    for pose in estimates:
        if pose.state != "tracking" or not stamps[0] <= pose.stamp_ns <= stamps[-1]:
            continue
        near = order[int(np.argmin(np.abs(stamps - pose.stamp_ns)))]
        T_near = rigid.transform(near.position, near.orientation)
        T_true = rigid.perturb(T_near, near.velocity * ((pose.stamp_ns - near.stamp_ns) * 1e-9))
        error = rigid.pose_error(T_true, rigid.transform(pose.position, pose.orientation))
        wrong.append(error @ np.linalg.solve(pose.covariance, error) > CHI2_3_SIGMA)
    return float(np.mean(wrong)) if wrong else None


def long_runs(flags: np.ndarray, stamps_ns: np.ndarray, seconds: float) -> np.ndarray:
    """`flags` without runs of true shorter than `seconds`; a gap between stamps that is longer than that ends a run."""
    out = np.zeros_like(flags)
    breaks = np.flatnonzero(np.diff(flags) | (np.diff(stamps_ns) > seconds * 1e9)) + 1
    for start, end in itertools.pairwise([0, *breaks.tolist(), len(flags)]):
        if end > start and flags[start] and (stamps_ns[end - 1] - stamps_ns[start]) * 1e-9 >= seconds:
            out[start:end] = True
    return out


def percentiles(values: np.ndarray, scale: float = 1.0) -> dict[str, float | None]:
    if len(values) == 0:
        return {"p50": None, "p95": None}
    return {"p50": round(float(np.percentile(values, 50)) * scale, 3), "p95": round(float(np.percentile(values, 95)) * scale, 3)}


def summary(
    cell: cells.Cell, options: flags.Options, truths: list[messages.Truth], estimates: dict[str, list[Any]], seconds: float
) -> Result:
    """The result of both benchmarks: errors of each sense's estimates in each situation, how long these lasted of `seconds`, and
    the shares of the fused states. options: those of the command, with seed and seconds."""
    truth = TruthTrack.of(truths)
    situations = truth.situations(max(cell.pad_types[pad.type].range for pad in cell.pads.values()))
    result: Result = {"cell": cell.name, "seed": options.seed, "seconds": options.seconds}
    for key in ("error_cm", "error_p95_cm", "axis_deg", "samples"):
        result[key] = {sight: {skin: {} for skin in ("in_range", "out_of_range")} for sight in ("visible", "occluded")}
    for sense, found in estimates.items():
        nearest, position, angle = truth.errors([e for e in found if e.state in USED_STATES])
        for (sight, skin), chosen in situations.items():
            inside = chosen[nearest]
            position_cm = percentiles(position[inside], 100)
            result["error_cm"][sight][skin][sense] = position_cm["p50"]
            result["error_p95_cm"][sight][skin][sense] = position_cm["p95"]
            result["axis_deg"][sight][skin][sense] = percentiles(np.degrees(angle[inside]))["p50"]
            result["samples"][sight][skin][sense] = int(inside.sum())
    states = [f.state for f in estimates["fused"]]
    result["fused_states"] = {
        state: round(states.count(state) / max(len(states), 1), 4) for state in ("tracking", "coasting", "lost")
    }
    for sense in ("vision", "fused"):
        result[f"{sense}_beyond_3_sigma"] = beyond_3_sigma(truths, estimates[sense])
    result["situation_s"] = {
        sight: {skin: round(float(situations[sight, skin].mean()) * seconds, 1) for skin in ("in_range", "out_of_range")}
        for sight in ("visible", "occluded")
    }
    return result


def table(result: Result) -> Table:
    """Errors by situation, beside their goals."""
    title = f"Cell {result['cell']}, seed {result['seed']}: position error cm, median (p95); limb axis deg, median"
    lost, coasting = (result["fused_states"][state] for state in ("lost", "coasting"))
    caption = f"Fused poses: {lost:.1%} lost, which do not count, {coasting:.1%} coasting, which do."
    if (beyond := result.get("fused_beyond_3_sigma")) is not None:
        caption += f" Of those tracking {marked(f'{beyond:.2%}', beyond <= BEYOND_GOAL)} are beyond three sigma"
        vision = result.get("vision_beyond_3_sigma")
        caption += "." if vision is None else f", of vision's {vision:.1%}."
    table = Table("situation", "s", *SENSES, "goal", title=title, caption=caption)
    for (sight, skin), goal_cm in GOALS_CM.items():
        columns = []
        for sense in SENSES:
            median, p95, axis = (result[key][sight][skin][sense] for key in ("error_cm", "error_p95_cm", "axis_deg"))
            is_met = median is None or goal_cm is None or sense != "fused" or median <= goal_cm
            columns.append("-" if median is None else f"{marked(f'{median:.2f}', is_met)} ({p95:.2f}), {axis:.1f}°")
        named = f"{sight}, {skin.replace('_', ' ')}"
        table.add_row(named, str(result["situation_s"][sight][skin]), *columns, f"fused <= {goal_cm}" if goal_cm else "")
    return table
