"""The curves of `tests.bench.lib.curves` drawn, each as one PNG: labels beside the lines, units on the axes, readable when
small."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from penumbra.sim.sets.trial import BINNING, DISTANCE_M, FOCAL_PX, HIDDEN, PASSAGE, PASSAGE_S, Trial
from penumbra.tests.bench import table1
from penumbra.tests.bench.lib import curves

INK, PALE, GRID = "#1c2530", "#8a94a0", "#dfe4e9"
OURS, VISION, RIVAL, RIVAL_FUSED, PAPER = "#1257a8", "#5aa2e0", "#c8433a", "#e59b3c", "#7d8590"
"""Colours of fused, our vision, PoseCNN, PoseCNN with the skin, and the paper's numbers or method."""
NAMES = {"procnet": "ProcNet, ours", "posecnn": "PoseCNN", "faithful": "paper's search"}
COLOURS = {"procnet": OURS, "posecnn": RIVAL, "faithful": PAPER}
DPI = 130
OUTLINE = (30, 230, 60)


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.08)  # type: ignore[union-attr,call-arg]
    return figure


def _dress(axes: Axes, xlabel: str, ylabel: str, title: str = "") -> None:
    axes.set_xlabel(xlabel, fontsize=12, color=INK)
    axes.set_ylabel(ylabel, fontsize=12, color=INK)
    axes.set_title(title, fontsize=13, loc="left", color=INK)
    axes.tick_params(labelsize=11, colors=INK)
    axes.grid(color=GRID, lw=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _plain(axes: Axes, ticks: Sequence[float]) -> None:
    """Sets a logarithmic scale with these ticks, labelled as plain numbers."""
    axes.set_yscale("log")
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()


def _name(axes: Axes, x: float, y: float, text: str, colour: str, **how: Any) -> None:
    axes.annotate(
        text,
        (x, y),
        **{"xytext": (6, 0), "textcoords": "offset points", "va": "center", "fontsize": 11, **how},
        color=colour,
        annotation_clip=False,
    )


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=DPI, facecolor="white")


def vision_by_distance(data: dict[str, Any], path: Path) -> None:
    """Three panels: lateral, depth, attitude."""
    figure = _figure(12.0, 4.4)
    panels = figure.subplots(1, 3)
    shown = (
        ("lateral_cm", "across the line of sight", "error [cm]"),
        ("depth_cm", "along the line of sight", "error [cm]"),
        ("attitude_deg", "attitude", "error [degrees]"),
    )
    for axes, (error, title, unit) in zip(panels, shown, strict=True):
        _dress(axes, "camera distance [m]", unit, title)
        ends: dict[str, tuple[float, float]] = {}
        for chain, rows in data["chains"].items():
            rows = [row for row in rows if row[error] is not None]
            if not rows:
                continue
            x, y = [0.5 * (row["from_m"] + row["to_m"]) for row in rows], [row[error] for row in rows]
            axes.plot(x, y, "o-", color=COLOURS[chain], ms=5, lw=2)
            for middle, row in zip(x, rows, strict=True):
                if row[f"{error}_ci95"]:
                    axes.plot(
                        [middle, middle], row[f"{error}_ci95"], color=COLOURS[chain], lw=5, alpha=0.3, solid_capstyle="butt"
                    )
            ends[chain] = x[-1], y[-1]
        axes.set_xlim(1.0, 10.2)
        axes.set_xticks([2, 4, 6, 8, 10])
        ticks = _ticks(axes.dataLim.intervaly)
        _plain(axes, ticks)
        _focal_lengths(axes)
    places = _apart([y for _, y in ends.values()], (ticks[-1] / ticks[0]) ** (1.0 / 15.0))
    for (chain, (x_end, _)), y_end in zip(ends.items(), places, strict=True):
        _name(axes, x_end, y_end, NAMES[chain], COLOURS[chain])
    _save(figure, path)


def _focal_lengths(axes: Axes) -> None:
    """Writes the focal length [px] over each range of distances [m]."""
    focal: dict[float, tuple[float, float]] = {}
    for distance, (near, far) in DISTANCE_M.items():
        length = FOCAL_PX / BINNING[distance]
        focal[length] = (min(near, focal.get(length, (near, far))[0]), far)
    for length, (near, far) in focal.items():
        axes.annotate(
            f"f = {length:.0f} px",
            (0.5 * (near + far), 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, -4),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=9,
            color=PALE,
        )
        if far < max(end for _, end in DISTANCE_M.values()):
            axes.axvline(far, color=PALE, lw=1, ls=":")


def _ticks(interval: Sequence[float]) -> list[float]:
    """1, 2, 5 and their decades within an interval and one beyond each end."""
    every = np.array([m * 10.0**e for e in range(-4, 5) for m in (1, 2, 5)])
    low, high = np.searchsorted(every, interval)
    return every[max(low - 1, 0) : high + 1].tolist()


def haptic_by_gap(data: dict[str, Any], path: Path) -> None:
    """Three directions, ours from a track and from a broad start over the bound, and the paper's network."""
    figure = _figure(12.0, 4.4)
    panels = figure.subplots(1, 3, sharey=True)
    shown = (("height", "along the pads' normal"), ("lateral", "across the limb"), ("axial", "along the limb"))
    kinds = (
        (("solve", True), OURS, "-", "from a track"),
        (("solve", False), VISION, "-", "first look"),
        (("paper", False), PAPER, "--", "paper's network"),
    )
    for axes, (error, title) in zip(panels, shown, strict=True):
        _dress(axes, "gap between electrode and skin [cm]", "RMS error [mm]" if axes is panels[0] else "", title)
        for (method, prior), colour, style, name in kinds:
            rows = [row for row in data["rows"] if (row["method"], row["prior"]) == (method, prior)]
            x, y = [100 * row["gap_m"] for row in rows], [row["rmse_mm"][error] for row in rows]
            if not rows:
                continue
            axes.plot(x, y, "o" + style, color=colour, ms=5, lw=2)
            if method == "solve":
                axes.plot(x, [row["bound_mm"][error] for row in rows], color=colour, lw=6, alpha=0.25)
            if axes is panels[-1]:
                _name(axes, x[-1], y[-1], name, colour)
        axes.axvline(15.0, color=PALE, lw=1, ls=":")
        axes.set_xlim(0, 21)
    every = [row[kind][error] for row in data["rows"] for kind in ("rmse_mm", "bound_mm") for error, _ in shown]
    _plain(panels[0], _ticks((min(every), max(every))))
    panels[0].annotate(
        "pale: the least possible error\n(Cramér-Rao bound)",
        (0.97, 0.04),
        xycoords="axes fraction",
        ha="right",
        va="bottom",
        fontsize=10,
        color=PALE,
    )
    _save(figure, path)


def response_by_gap(data: dict[str, Any], path: Path) -> None:
    """The signal over the gap with the law that was fitted, the paper's, and the noise."""
    figure = _figure(7.6, 4.8)
    axes = figure.subplots()
    _dress(axes, "gap between electrode and skin [cm]", "signal of the centre electrode [mV]")
    gaps = np.linspace(0.8, 20.0, 200)

    def law(a1: float, a2: float, **_: float) -> NDArray[np.float64]:
        return 1e3 * a1 / (1.0 + a2 * (gaps / 100) ** 2)

    ours, paper = data["law"], data["paper_law"]
    axes.plot(gaps, law(**ours), color=VISION, lw=5, alpha=0.6)
    axes.plot(gaps, law(**paper), "--", color=INK, lw=1.5)
    axes.plot(data["gaps_cm"], 1e3 * np.array(data["volts"]), "o", color=OURS, ms=6)
    axes.axhline(1e3 * data["noise_V"], color=RIVAL, lw=1.5, ls=":")
    values = 1e3 * np.array(data["volts"])
    _plain(axes, _ticks((min(values.min(), 1e3 * data["noise_V"]), values.max())))
    axes.set(xlim=(0, 20.5), xticks=range(0, 21, 5))
    at = int(np.searchsorted(gaps, 8.0))
    fitted = f"$v = {ours['a1']:.2f}\\,/\\,(1 + {ours['a2'] / 1e4:.2f}\\times 10^4\\,d^2)$ V"
    text = f"dots: boundary elements\nline: law fitted, {fitted}"
    _name(axes, gaps[at], law(**ours)[at], text, OURS, xytext=(8, 24))
    theirs = f"$v = {paper['a1']:.2f}\\,/\\,(1 + {paper['a2'] / 1e4:.2f}\\times 10^4\\,d^2)$ V"
    _name(axes, gaps[at], law(**paper)[at], f"dashed: the paper's law,\n{theirs}", INK, xytext=(-10, -30), ha="right")
    _name(axes, 0.4, 1e3 * data["noise_V"], "noise of one sample", RIVAL, xytext=(0, 9))
    _save(figure, path)


def through_occlusion(data: dict[str, Any], path: Path) -> None:
    """Errors over time, over the hidden share."""
    figure = _figure(10.0, 5.6)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    times, error = np.array(data["times_s"]), {name: np.array(v, dtype=float) for name, v in data["error_cm"].items()}
    kinds = (
        ("posecnn_vision", RIVAL, "PoseCNN", 1.5),
        ("procnet_vision", VISION, "ProcNet", 1.5),
        ("posecnn_fused", RIVAL_FUSED, "PoseCNN and skin, fused", 2.0),
        ("procnet_fused", OURS, "ProcNet and skin, fused", 2.6),
    )
    _dress(top, "", "position error [cm]")
    ends = {}
    for name, colour, text, width in kinds:
        if name in error and np.isfinite(error[name]).any():
            top.plot(times, error[name], color=colour, lw=width)
            known = np.flatnonzero(np.isfinite(error[name]))
            ends[text] = (float(np.median(error[name][known[-10:]])), colour)
    drawn = np.concatenate([error[name][np.isfinite(error[name])] for name, *_ in kinds if name in error])
    ticks = _ticks((max(float(np.percentile(drawn, 2)), 0.02), float(drawn.max())))
    _plain(top, ticks)
    top.set_ylim(ticks[0], ticks[-1])
    places = _apart([value for value, _ in ends.values()], (ticks[-1] / ticks[0]) ** (1.0 / 15.0))
    for (text, (_, colour)), y in zip(ends.items(), places, strict=True):
        _name(top, PASSAGE_S, y, text, colour)
    _dress(bottom, "time [s]", "hidden [%]")
    bottom.fill_between(times, 100 * np.array(data["hidden"]), color=INK, alpha=0.25, lw=0)
    bottom.plot(times, 100 * np.array(data["hidden"]), color=INK, lw=1.5)
    bottom.set(ylim=(0, 105), yticks=[0, 33, 66, 100], xlim=(0, PASSAGE_S))
    names = ("in sight", "light", "medium", "heavy", "wholly hidden", "in sight again")
    for (begin, _), (end, _), name in zip(PASSAGE, [*PASSAGE[1:], (PASSAGE_S, 0.0)], names, strict=True):
        top.annotate(
            name,
            (0.5 * (begin + end), 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 2),
            ha="center",
            textcoords="offset points",
            fontsize=11,
            color=INK,
        )
        for axes in (top, bottom):
            axes.axvline(begin, color=PALE, lw=0.8, ls=":")
    _save(figure, path)


def _apart(values: Sequence[float], factor: float) -> list[float]:
    """Places for labels beside values on a logarithmic scale, at least a factor apart, in the same order."""
    out = [0.0] * len(values)
    last = 0.0
    for k in np.argsort(values):
        out[k] = last = max(values[k], last * factor)
    return out


def examples(scene: Trial, data: Sequence[dict[str, Any]], path: Path) -> None:
    """Four frames with the estimated silhouette, like the paper's figure of occlusion levels."""
    figure = _figure(10.0, 7.6)
    camera = next(iter(scene.cell.cameras))
    for axes, frame in zip(figure.subplots(2, 2).ravel(), data, strict=True):
        picture = scene.world.view(camera, frame["time_s"]).image.copy()
        shown = curves.outline(scene, frame["pose"]).astype(np.uint8)
        outline, _ = cv2.findContours(shown, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, outline, -1, OUTLINE, max(2, picture.shape[1] // 350), cv2.LINE_AA)
        axes.imshow(picture, interpolation="antialiased")
        axes.set_axis_off()
        error = "lost" if frame["cm"] is None else f"error {frame['cm']:.2f} cm"
        axes.set_title(f"{frame['level']}: {100 * frame['hidden']:.0f} % hidden, {error}", fontsize=13, loc="left", color=INK)
    _save(figure, path)


def table(found: dict[str, Any], path: Path) -> None:
    """All cells of the table: our fused error with its interval, the paper's best column, PoseCNN."""
    figure = _figure(11.0, 5.4)
    panels = figure.subplots(1, 2, sharey=True, sharex=True)
    rows = [(d, o) for d in table1.DISTANCES for o in HIDDEN if (d, o) != ("long", "heavy")]
    columns = tuple(table1.COLUMNS)
    every: list[float] = []
    for axes, (reach, key) in zip(panels, table1.REACHES.items(), strict=True):
        _dress(axes, "position error [cm]", "", f"{reach} of the skin's range")
        for y, (distance, occlusion) in enumerate(rows):
            cell = found[key][table1.DISTANCES[distance]][occlusion]
            values = {name: cell["ours"][columns.index(name)] for name in ("procnet", "multimodal_procnet", "multimodal_posecnn")}
            best = min(cell["paper"])
            every += [best, *(v for v in values.values() if v is not None)]
            axes.plot([best], [y], "D", color=PAPER, ms=7)
            for name, marker, colour, size in (
                ("multimodal_posecnn", "s", RIVAL_FUSED, 6),
                ("procnet", "o", VISION, 6),
                ("multimodal_procnet", "o", OURS, 9),
            ):
                if values[name] is not None:
                    axes.plot([values[name]], [y], marker, color=colour, ms=size)
            if interval := cell["ours_ci95"][1]:
                axes.plot(interval, [y, y], color=OURS, lw=2.5)
        axes.axhline(2.5, color=PALE, lw=0.8)
        axes.axhline(5.5, color=PALE, lw=0.8)
    ranges = {name: f"{HIDDEN[name][0] * 100:.0f}-{HIDDEN[name][1] * 100:.0f} %" for name in HIDDEN}
    panels[0].set_yticks(range(len(rows)), [f"{d}, {o} ({ranges[o]})" for d, o in rows])
    panels[0].invert_yaxis()
    ticks = _ticks((min(every), max(every)))
    panels[0].set_xscale("log")
    panels[0].set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    panels[0].minorticks_off()
    marks = (
        ("o", OURS, "ours, fused (95 %)"),
        ("o", VISION, "ours, vision alone"),
        ("s", RIVAL_FUSED, "PoseCNN with skin, here"),
        ("D", PAPER, "paper's best column"),
    )
    handles = [panels[1].plot([], [], marker, color=colour, label=text)[0] for marker, colour, text in marks]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=11)
    _save(figure, path)


DRAWN: dict[str, Callable[..., None]] = {
    "table": table,
    "vision_by_distance": vision_by_distance,
    "haptic_by_gap": haptic_by_gap,
    "through_occlusion": through_occlusion,
    "response_by_gap": response_by_gap,
}
