"""`penumbra bench calibration`: how near `penumbra calibrate` comes to a known lens and place, and whether it knows that."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.table import Table

from penumbra.services import flags, progress
from penumbra.services.calibrate import hand_eye, intrinsics
from penumbra.services.calibrate.board import Board
from penumbra.services.calibrate.hand_eye import Corners, Pair
from penumbra.shared.geometry import rigid
from penumbra.tests.bench.lib import results
from penumbra.tests.bench.lib.results import Part, Result
from penumbra.tests.support.charuco import LENS, Carried, Photographer, held

LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")

KINDS = (
    ("closed form", "linear", ""),
    ("result", "error", "said"),
    ("result, with the least squares' own sigma", "error", "naive"),
)
"""Kinds of results for a place: name, key of the error, and key of its standard deviation."""


def tables(result: Result) -> list[Part]:
    """Errors, their reported standard deviations, and how often the errors were within them."""
    lens = Table("", "error (rms)", "said (rms)", "error / said (rms)", "within 2", "within 3", title="camera")
    for name, row in result["lens"].items():
        digits = 2 if name in LENS_NAMES[:4] else 5
        lens.add_row(name, f"{row['error']:.{digits}f}", f"{row['said']:.{digits}f}", *_coverage(row))
    place = Table("", "error (rms)", "largest", "said (rms)", "error / said (rms)", "within 2", "within 3", title="hand-eye")
    for name, row in result["place"].items():
        unit = "mm" if "position" in name else "deg"
        numbers = [f"{row[key]:.3f} {unit}" if key in row else "" for key in ("error", "largest", "said")]
        place.add_row(name, *numbers, *(_coverage(row) if "ratio" in row else ("", "", "")))
    return [lens, place]


def _coverage(row: dict[str, Any]) -> tuple[str, ...]:
    return f"{row['ratio']:.2f}", f"{row['within_2']:.0%}", f"{row['within_3']:.0%}"


@results.benchmark(
    "calibration",
    __doc__ or "",
    tables,
    flags.Option("--runs", type=flags.positive, default=12, metavar="N", help="calibrations of each kind"),
    flags.Option("--views", type=flags.positive, default=20, metavar="N", help="pictures of each"),
    flags.Option("--seed", type=int, default=100, help="of the first run; the next ones count on"),
    example="penumbra bench calibration --runs 12 --json calibration.json",
)
def main(options: flags.Options, report: results.Report) -> None:
    photographer, robot = Photographer(Board()), Carried()
    lenses, places = [], []
    for seed in progress.track(range(options.seed, options.seed + options.runs), "calibrations"):
        lenses.append(_lens(photographer, options.views, np.random.default_rng(seed)))
        places.append(_place(photographer, robot, options.views, np.random.default_rng(seed)))
    rows = {name: _row(*zip(*(run[name] for run in lenses), strict=True)) for name in LENS_NAMES}
    report.save({"lens": rows, "place": _places(places), "runs": options.runs, "views": options.views})


def _lens(photographer: Photographer, count: int, rng: np.random.Generator) -> dict[str, tuple[float, float]]:
    """Error and standard deviation of each parameter of the lens."""
    poses = held(photographer.board, count, rng)
    views = [view for i, T in enumerate(poses) if (view := photographer.view(str(i), T, rng)) is not None]
    found = intrinsics.calibrate(photographer.board, views, LENS.width, LENS.height)
    return {name: (getattr(found.lens, name) - getattr(LENS, name), found.deviation[name]) for name in LENS_NAMES}


def _place(photographer: Photographer, robot: Carried, count: int, rng: np.random.Generator) -> dict[str, Any]:
    poses = robot.poses(photographer.board, count, rng)
    views = [(photographer.view(str(i), T, rng), A) for i, (A, T) in enumerate(poses)]
    pairs = [Pair.of(view, A, photographer.board, LENS) for view, A in views if view is not None]
    X, _ = hand_eye.linear(pairs)
    found = hand_eye.solve(pairs)
    corners = Corners(pairs)
    J = corners.jacobian(found.T_world_camera, found.T_link_board).reshape(-1, 12)
    naive = np.linalg.inv(J.T @ J) * np.mean(corners.residuals(found.T_world_camera, found.T_link_board) ** 2)
    return {
        "error": rigid.pose_error(robot.T_world_camera, found.T_world_camera),
        "linear": rigid.pose_error(robot.T_world_camera, X),
        "said": np.sqrt(np.diag(found.covariance)),
        "naive": np.sqrt(np.diag(naive)[:6]),
    }


def _places(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Errors along and about all axes together, in millimetres and degrees."""
    out: dict[str, Any] = {}
    for part, what, scale in ((slice(0, 3), "position", 1e3), (slice(3, 6), "rotation", float(np.degrees(1)))):
        for name, error, said in KINDS:
            errors = scale * np.array([run[error][part] for run in runs])
            lengths = np.linalg.norm(errors, axis=1)
            row: dict[str, float] = {}
            if said:
                row = _row(errors.ravel(), scale * np.array([run[said][part] for run in runs]).ravel())
                row["said"] *= float(np.sqrt(3.0))  # of the length, like the error
            out[f"{name}: {what}"] = row | {"error": float(np.sqrt(np.mean(lengths**2))), "largest": float(lengths.max())}
    return out


def _row(errors: Any, said: Any) -> dict[str, float]:
    errors, said = np.asarray(errors), np.asarray(said)
    ratio = np.abs(errors / said)
    return {
        "error": float(np.sqrt(np.mean(errors**2))),
        "said": float(np.sqrt(np.mean(said**2))),
        "ratio": float(np.sqrt(np.mean(ratio**2))),
        "within_2": float(np.mean(ratio < 2.0)),
        "within_3": float(np.mean(ratio < 3.0)),
    }


if __name__ == "__main__":
    raise SystemExit(main())
