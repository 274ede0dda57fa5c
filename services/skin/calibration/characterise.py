"""`penumbra skin characterise`: the paper's characterisation of a pad, on the emulated skin or on a recording of a real one.

Distances, angles and plane scans are fitted by Gaussian-process regression (Rasmussen and Williams 2006), as in the paper; noise
and signal-to-noise ratio as in its section "Sensor Model". The results are CSV tables and pictures.
"""

from __future__ import annotations

import csv
import json
import sys
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from scipy.spatial import cKDTree
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from penumbra.services import flags
from penumbra.services.progress import track
from penumbra.services.skin.calibration import calibrate, law, recording
from penumbra.services.skin.calibration.law import RecordingError
from penumbra.services.skin.calibration.recording import Recording
from penumbra.shared.cell import description as cells

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from penumbra.shared.geometry.rigid import Array

HELD_OUT = 5
"""One place in HELD_OUT of the distances and angles is left out of a second regression, which is scored on it."""
TABLE = ("gap_m", "angle_deg", "electrode", "signal_V", "deviation_V", "regression_V", "low_V", "high_V", "snr_dB")
"""Columns of distances.csv; low and high: one standard deviation around the regression."""
COLOURS = ("#1b6ca8", "#c8553d", "#3a7d44", "#8e5aa8", "#b8860b", "#4f6d7a", "#a23b72", "#2f4b7c")


@dataclass(frozen=True)
class Places:
    """k places at which the pad was held: gap (k,) [m], angle (k,) [degrees], x, y (k,) [m]; signal (k, e) [V], absolute means;
    deviation (k, e) [V]: standard deviations of these means."""

    gap: Array
    angle: Array
    x: Array
    y: Array
    signal: Array
    deviation: Array

    def where(self, rows: NDArray[np.bool_]) -> Places:
        return Places(*(getattr(self, name)[rows] for name in ("gap", "angle", "x", "y", "signal", "deviation")))


def _count(text: str) -> int:
    if not 10 <= (value := flags.integer(text)) <= 10_000:
        raise ValueError(f"expected 10 to 10000 samples, got {text!r}")
    return value


def _step(text: str) -> float:
    if not 0.002 <= (value := flags.number(text)) <= 0.05:
        raise ValueError(f"expected a step from 0.002 to 0.05 m, got {text!r}")
    return value


@flags.command(
    "skin characterise",
    "Measures a pad by distances, angles and plane scans, and writes tables and pictures.",
    flags.CELL,
    flags.Option("--out", type=flags.folder, required=True, metavar="FOLDER", help="tables, pictures and summary.json go there"),
    flags.Option(
        "--data",
        type=Path,
        metavar="FILE",
        show_default="the emulated skin is measured",
        help="a recording as of `skin calibrate`, with angle_deg, scan (distance or plane), object, x_m and y_m beside it",
    ),
    flags.Option("--pad", show_default="the cell's first", help="the pad"),
    flags.Option("--target", show_default="the cell's first", help="the limb of the emulated skin"),
    flags.Option("--samples", type=_count, default=50, help="emulated samples at a place"),
    flags.Option("--step", type=_step, default=0.01, metavar="M", help="emulated plane scans' grid"),
    flags.Option("--seed", type=int, default=0, help="of the emulated noise"),
    flags.JSON,
    example="penumbra skin characterise --cell mine.yaml --pad p0 --data recording.csv --out p0",
)
def main(options: flags.Options) -> int:
    """Run the command; returns 0, or 2 for an unusable recording or cell."""
    try:
        _characterise(options)
    except (RecordingError, cells.CellError) as error:
        for line in str(error).splitlines():
            print(f"penumbra skin characterise: {line}", file=sys.stderr)
        return 2
    return 0


def _characterise(options: flags.Options) -> None:
    cell = cells.load(options.cell)
    pad = cell.one("pads", options.pad)
    target = cell.one("targets", options.target)
    console = Console(highlight=False, soft_wrap=True, stderr=True)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.data is None:
        recorded = emulated(cell, pad, target, options.samples, options.step, options.seed)
        about = f"emulated pad {pad} of cell {cell.name}, {target}, seed {options.seed}"
        recording.write(options.out / "recording.csv", recorded, about)
    else:
        recorded = recording.read(options.data, list(cell.pad_types[cell.pads[pad].type].electrodes), "--data")
        if (recorded.labels["pad"] != "").any():
            recorded = recorded.where(recorded.labels["pad"] == pad)
    result = characterise(cell, pad, recorded, options.out)
    (options.out / "summary.json").write_text(json.dumps(result, indent=2) + "\n")
    if options.json:
        print(json.dumps(result))
        return
    for name, row in result["electrodes"].items():
        console.print(
            f"{name}: noise {1e6 * row['noise']:.2f} mV², SNR 1 dB at {100 * row['reach_m']:.1f} cm, "
            f"a1 {row['a1']:.3g} V, a2 {row['a2']:.3g} /m²; held out, regression is off by {row['held_out']:.2f} deviations"
        )
    console.print(f"{options.out}: {', '.join(sorted(path.name for path in options.out.iterdir()))}")


def emulated(cell: cells.Cell, pad: str, target: str, samples: int, step: float, seed: int, sparse: int = 1) -> Recording:
    """A recording of the emulated skin (`sim.skin.characterisation`); sparse: only one in `sparse` poses is measured."""
    from penumbra.sim.skin import characterisation

    kind = cell.pads[pad].type
    poses = characterisation.poses(cell, target, kind, step)[:: max(1, sparse)]
    volts = characterisation.measure(cell, target, kind, poses, samples, seed, lambda held: track(held, "fields"))
    counts = [len(rows) for rows in volts]

    def spread(values: Iterable[Any], kind: Any) -> NDArray:
        return np.repeat(np.array(list(values), dtype=kind), counts)

    return Recording(
        spread((p.gap for p in poses), np.float64),
        np.concatenate(volts),
        tuple(cell.pad_types[kind].electrodes),
        {
            "pad": np.full(sum(counts), pad),
            "object": spread((p.part for p in poses), np.str_),
            "scan": spread((p.scan for p in poses), np.str_),
        },
        {
            "angle_deg": spread((p.angle for p in poses), np.float64),
            "x_m": spread((p.x if p.scan == "plane" else 0.0 for p in poses), np.float64),
            "y_m": spread((p.y if p.scan == "plane" else 0.0 for p in poses), np.float64),
        },
    )


def characterise(cell: cells.Cell, pad: str, recorded: Recording, out: Path) -> dict[str, Any]:
    """Write tables and pictures of a recording to a folder; returns the results as JSON. Raises RecordingError if there are too
    few distances."""
    plane = recorded.labels["scan"] == "plane"
    distances = recorded.where(~plane)
    fits = calibrate.calibrate(cell, pad, distances.where(distances.numbers["angle_deg"] == 0.0))
    a3, polarity = (np.array([getattr(fit.law, name) for fit in fits.values()]) for name in ("a3", "polarity"))
    noise = np.array([fit.law.noise for fit in fits.values()])
    near = places(distances.where(np.isfinite(distances.gap)), a3, polarity, noise)
    result: dict[str, Any] = {"pad": pad, "cell": cell.name, "places": len(near.gap), "electrodes": {}, "planes": {}}

    grid = _grid(near)
    points = _points(near.gap, near.angle)
    models: list[Regression] = []
    for k, name in enumerate(track(fits, "regression")):
        models.append(Regression(points, near.signal[:, k], near.deviation[:, k]))
        kept = np.arange(len(near.gap)) % HELD_OUT != HELD_OUT // 2
        part = Regression(points[kept], near.signal[kept, k], near.deviation[kept, k], models[-1].kernel)
        result["electrodes"][name] = calibrate.describe(fits[name]) | {
            "held_out": part.misfit(points[~kept], near.signal[~kept, k], near.deviation[~kept, k])
        }
    _table(out / "distances.csv", near, fits, noise, [model.signal(points) for model in models])
    _distance_picture(out / "distances.png", near, fits, models[0])
    _angle_picture(
        out / "angles.png", grid, list(fits), noise, [model.signal(_points(grid.gap, grid.angle))[0] for model in models]
    )
    _snr_picture(out / "snr.png", near, fits)
    for part in sorted(set(recorded.labels["object"][plane])):
        scan = places(recorded.where(plane & (recorded.labels["object"] == part)), a3, polarity, noise)
        result["planes"][part or "object"] = _plane(out, part or "object", scan, list(fits), noise)
    return result


def places(recorded: Recording, a3: Array, polarity: Array, noise: Array) -> Places:
    """Means of the samples at each place; a3 (e,) [V], polarity (e,), noise (e,) [V^2]: of the electrodes."""
    where = np.stack([recorded.gap, *(recorded.numbers[name] for name in recording.NUMBERS)], axis=1)
    held, index = np.unique(where, axis=0, return_inverse=True)
    index = index.reshape(-1)
    good = np.isfinite(recorded.volts)
    count = np.zeros((len(held), len(a3)))
    total = np.zeros_like(count)
    np.add.at(count, index, good)
    np.add.at(total, index, np.where(good, recorded.volts, 0.0))
    rows = (count > 0).all(axis=1)
    held, count, total = held[rows], count[rows], total[rows]
    gap, angle, x, y = held.T
    return Places(gap, angle, x, y, polarity * (total / count - a3), np.sqrt(noise / count))


class Regression:
    """A Gaussian process of an electrode's signal over places (k, d), on asinh(v / 2s) with s the noise of a mean. Far away this
    is the signal itself, with even noise; close to the pad its logarithm, which is equally smooth everywhere."""

    def __init__(self, points: Array, signal: Array, deviation: Array, kernel: Any = None):
        self._unit = 2.0 * float(np.median(deviation))
        y = np.arcsinh(signal / self._unit)
        self._mean = float(y.mean())
        alpha = (deviation / np.hypot(signal, self._unit)) ** 2
        spread = points.std(axis=0) + 1e-9
        bounds = [(0.05 * s, 20.0 * s) for s in spread]
        smooth = ConstantKernel(y.var() + 1e-3, (1e-3, 1e4)) * RBF(spread, bounds)
        start = kernel or smooth + WhiteKernel(1e-4, (1e-8, 1.0))
        optimiser = "fmin_l_bfgs_b" if kernel is None else None
        self._process = GaussianProcessRegressor(start, alpha=alpha, optimizer=optimiser)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a length scale at its bound means that nothing changes along it
            self._process.fit(points, y - self._mean)
        self.kernel = self._process.kernel_

    def signal(self, points: Array) -> tuple[Array, Array, Array]:
        """The signal [V] at places, and the band of one standard deviation around it."""
        mean, deviation = self._process.predict(points, return_std=True)
        return tuple(self._unit * np.sinh(mean + self._mean + sign * deviation) for sign in (0.0, -1.0, 1.0))  # type: ignore[return-value]

    def misfit(self, points: Array, signal: Array, deviation: Array) -> float:
        """Root mean square of the differences between readings and predictions at other places, in standard deviations of
        both."""
        mean, spread = self._process.predict(points, return_std=True)
        left = np.arcsinh(signal / self._unit) - mean - self._mean
        return float(np.sqrt(np.mean(left**2 / (spread**2 + (deviation / np.hypot(signal, self._unit)) ** 2))))


def _points(gap: Array, angle: Array) -> Array:
    """Inputs (k, 2) of the regression of distances and angles, both of order one."""
    return np.stack([np.log(np.maximum(gap, 1e-3)), angle / 45.0], axis=1)


def _grid(near: Places) -> Places:
    """An even grid over the gaps and angles of a recording, for pictures."""
    gaps = np.geomspace(max(near.gap.min(), 1e-3), near.gap.max(), 60)
    angles = np.linspace(near.angle.min(), near.angle.max(), 46 if np.ptp(near.angle) else 1)
    gap, angle = (grid.ravel() for grid in np.meshgrid(gaps, angles))
    nothing = np.zeros((len(gap), 0))
    return Places(gap, angle, np.zeros(len(gap)), np.zeros(len(gap)), nothing, nothing)


def _snr(signal: Array, noise: float) -> Array:
    """Signal-to-noise ratio [dB] of one sample; far below zero where nothing is felt."""
    return 10.0 * np.log10(np.maximum(signal, 1e-7) ** 2 / (2.0 * noise))


def _table(path: Path, near: Places, fits: dict[str, law.Fit], noise: Array, found: list[tuple[Array, Array, Array]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(TABLE)
        for k, name in enumerate(fits):
            for i in range(len(near.gap)):
                values = (near.signal[i, k], near.deviation[i, k], *(column[i] for column in found[k]))
                ratio = _snr(near.signal[i, k], noise[k])
                writer.writerow([f"{near.gap[i]:.4f}", f"{near.angle[i]:g}", name, *(f"{v:.6g}" for v in values), f"{ratio:.2f}"])


def _plane(out: Path, part: str, scan: Places, names: list[str], noise: Array) -> dict[str, Any]:
    """Write table and picture of a plane scan, as measured and by regression; returns its results."""
    points = np.stack([scan.x, scan.y], axis=1)
    xs, ys = (np.linspace(axis.min(), axis.max(), 80) for axis in (scan.x, scan.y))
    fine = np.stack([grid.ravel() for grid in np.meshgrid(xs, ys)], axis=1)
    models: list[Regression] = []
    for k, _ in enumerate(track(names, f"plane, {part}")):
        models.append(Regression(points, scan.signal[:, k], scan.deviation[:, k], models[0].kernel if models else None))
    with (out / f"plane_{part}.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["x_m", "y_m", *(f"{name}_V" for name in names), *(f"{name}_regression_V" for name in names)])
        smooth = np.stack([model.signal(points)[0] for model in models], axis=1)
        for i in range(len(points)):
            values = (*points[i], *scan.signal[i], *smooth[i])
            writer.writerow([f"{value:.6g}" for value in values])
    nearest = cKDTree(points).query(fine)[1]
    size = (2.6 * len(names) + 1.2, 1.0 + 5.2 * np.ptp(scan.y) / max(np.ptp(scan.x), 0.01))
    figure, axes = plt.subplots(2, len(names), figsize=size, sharex=True, sharey=True, squeeze=False, layout="constrained")
    top = 1e3 * max(float(scan.signal.max()), 1e-3)
    colours: dict[str, Any] = {"cmap": "magma", "norm": matplotlib.colors.AsinhNorm(linear_width=5.0, vmin=0.0, vmax=top)}
    for k, name in enumerate(names):
        rows = {"read": scan.signal[nearest, k], "regression": models[k].signal(fine)[0]}
        for row, (kind, signal) in zip(axes[:, k], rows.items(), strict=True):
            drawn = row.pcolormesh(100 * xs, 100 * ys, 1e3 * signal.reshape(len(ys), -1), **colours)
            row.set_title(f"{name}: {kind}")
            row.set_aspect("equal")
        axes[1, k].set_xlabel("along the limb, cm")
    for row in axes[:, 0]:
        row.set_ylabel("across, cm")
    figure.suptitle(f"Plane {100 * scan.gap.mean():.3g} cm above the highest skin, {part.replace('_', ' ')}")
    figure.colorbar(
        drawn,
        ax=axes,
        shrink=0.8,
        label="signal, mV",
        format="%g",
        ticks=[v for v in (0, 5, 20, 50, 100, 200, 500, 1000) if v < top],
    )
    _save(figure, out / f"plane_{part}.png")
    return {"places": len(points), "largest_V": dict(zip(names, scan.signal.max(axis=0).tolist(), strict=True))}


def _distance_picture(path: Path, near: Places, fits: dict[str, law.Fit], model: Regression) -> None:
    """Signals against distance at angle zero with the fitted laws, and of the first electrode at every angle."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.8), sharey=True)
    flat = near.angle == near.angle.min()
    fine = np.geomspace(near.gap[flat].min(), near.gap[flat].max(), 200)
    for k, (name, fit) in enumerate(fits.items()):
        colour = COLOURS[k % len(COLOURS)]
        means = (100 * near.gap[flat], 1e3 * near.signal[flat, k], 1e3 * near.deviation[flat, k])
        left.errorbar(*means, fmt="o", ms=3, color=colour)
        left.plot(100 * fine, 1e3 * law.signal(fit.law, fine), color=colour, lw=1.2, label=f"{name}, a2 = {fit.law.a2:.3g} /m²")
    left.set_title(f"angle {near.angle.min():g}°; lines: the fitted law")
    angles = np.unique(near.angle)
    shades = plt.get_cmap("viridis")(np.linspace(0.0, 0.9, len(angles)))
    for colour, angle in zip(shades, angles, strict=True):
        own = near.angle == angle
        mean, low, high = model.signal(_points(fine, np.full(len(fine), angle)))
        right.plot(100 * near.gap[own], 1e3 * near.signal[own, 0], "o", ms=2.5, color=colour)
        right.plot(100 * fine, 1e3 * mean, color=colour, lw=0.9, label=f"{angle:g}°")
        right.fill_between(100 * fine, 1e3 * low, 1e3 * high, color=colour, alpha=0.2, lw=0)
    right.set_title(f"electrode {next(iter(fits))}, every angle; lines: regression")
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("nearest distance between board and skin, cm")
        axes.set_ylim(1e3 * max(np.median(near.deviation), 1e-4), 2e3 * near.signal.max())
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    left.set_ylabel("signal, mV")
    _save(figure, path)


def _angle_picture(path: Path, grid: Places, names: list[str], noise: Array, signals: list[Array]) -> None:
    """Regression over distance and angle, with the line of 1 dB."""
    gaps, angles = np.unique(grid.gap), np.unique(grid.angle)
    if len(angles) < 2:
        return
    figure, axes = plt.subplots(
        1, len(names), figsize=(2.6 * len(names) + 1.2, 3.6), sharey=True, squeeze=False, layout="constrained"
    )
    for k, name in enumerate(names):
        ratio = _snr(signals[k].reshape(len(angles), len(gaps)), float(noise[k]))
        drawn = axes[0, k].contourf(100 * gaps, angles, ratio, levels=np.arange(-10, 51, 5), cmap="magma", extend="both")
        axes[0, k].contour(100 * gaps, angles, ratio, levels=[law.SNR_DB], colors="white", linewidths=1.5)
        axes[0, k].set_xscale("log")
        axes[0, k].set_xlabel("distance, cm")
        axes[0, k].set_title(name)
    axes[0, 0].set_ylabel("angle, degrees")
    figure.colorbar(drawn, ax=axes, label="SNR of a sample, dB (white: 1 dB)")
    _save(figure, path)


def _snr_picture(path: Path, near: Places, fits: dict[str, law.Fit]) -> None:
    """Signal-to-noise ratio against distance at angle zero, and the distance at which it falls to 1 dB."""
    figure, axes = plt.subplots(figsize=(6.4, 4.6))
    flat = near.angle == near.angle.min()
    fine = np.geomspace(near.gap[flat].min(), near.gap[flat].max(), 200)
    for k, (name, fit) in enumerate(fits.items()):
        colour, reach = COLOURS[k % len(COLOURS)], law.reach(fit.law)
        axes.plot(100 * near.gap[flat], _snr(near.signal[flat, k], fit.law.noise), "o", ms=3, color=colour)
        label = f"{name}: {law.SNR_DB:g} dB at {100 * reach:.1f} cm"
        axes.plot(100 * fine, law.snr_db(fit.law, fine), color=colour, lw=1.2, label=label)
    axes.axhline(law.SNR_DB, color="black", lw=0.8, ls="--")
    axes.set_xscale("log")
    axes.set_ylim(-15, None)
    axes.set_xlabel("distance between board and skin, cm")
    axes.set_ylabel("SNR of a sample, dB")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=120, bbox_inches="tight")
    plt.close(figure)
