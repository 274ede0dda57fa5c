"""Recordings of electrodes at known gaps as CSV, read and written by `penumbra skin calibrate` and `characterise`.

One row per sample: `distance_m` (empty, `inf` or `empty` if nothing is near) and one column per electrode in volts. Optional
columns: `pad`, `object`, `scan`, and `angle_deg`, `x_m`, `y_m` of the pad. Separators are comma, semicolon or tab; lines that
begin with # are skipped.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from penumbra.services.skin.calibration.law import RecordingError
from penumbra.shared.geometry.rigid import Array

UNITS = {"distance_m": 1.0, "distance_cm": 0.01, "distance_mm": 0.001}
EMPTY = ("", "inf", "infinity", "empty", "rest", "none")
FARTHEST = 2.0
"""Maximum plausible gap [m]. A larger number is in other units: nothing is felt from there."""


@dataclass(frozen=True)
class Recording:
    """s samples in order of time. gap (s,) [m], infinite where nothing was near; volts (s, e), NaN where a cell is empty or not a
    number; labels: texts by column (s,), "" if a file has no such column; numbers: by column (s,), zero likewise; notes: what was
    skipped."""

    gap: Array
    volts: Array
    electrodes: tuple[str, ...]
    labels: dict[str, NDArray[np.str_]]
    numbers: dict[str, Array]
    notes: tuple[str, ...] = ()

    def where(self, rows: NDArray[np.bool_]) -> Recording:
        """The samples with these rows (s,)."""
        labels = {name: column[rows] for name, column in self.labels.items()}
        numbers = {name: column[rows] for name, column in self.numbers.items()}
        return Recording(self.gap[rows], self.volts[rows], self.electrodes, labels, numbers, self.notes)


LABELS = ("pad", "object", "scan")
NUMBERS = ("angle_deg", "x_m", "y_m")


def read(path: Path, electrodes: Sequence[str], flag: str) -> Recording:
    """Read a recording of these electrodes from the file that a flag names. Raises RecordingError with the line that cannot be
    read."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no text in UTF-8"
        what = f"the column distance_m and {', '.join(electrodes)} [V]"
        raise RecordingError(f"{flag} {path}: expected a CSV file with {what}; it cannot be read: {why}") from None
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and not line.lstrip().startswith("#")]
    if len(lines) < 2:
        raise RecordingError(f"{path}: expected a line of column names and samples below it, got {len(lines)} lines")
    separator = max(";\t,", key=lines[0][1].count)
    header = [name.strip().strip('"') for name in lines[0][1].split(separator)]
    place = {name.lower(): i for i, name in enumerate(header)}
    if len(place) < len(header):
        raise RecordingError(f"{path}:{lines[0][0]}: expected every column once, got {', '.join(header)}")
    unit = [name for name in UNITS if name in place]
    missing = [name for name in electrodes if name.lower() not in place]
    if len(unit) != 1 or missing:
        raise RecordingError(
            f"{path}:{lines[0][0]}: expected the columns distance_m (or _cm, _mm) and {', '.join(electrodes)} [V], got "
            f"{', '.join(header)}"
        )
    known = {*unit, *(name.lower() for name in electrodes), *LABELS, *NUMBERS}
    unknown = [name for name in header if name.lower() not in known]
    notes = [f"columns passed over: {', '.join(unknown)}"] if unknown else []
    rows = []
    for number, cells in zip((n for n, _ in lines[1:]), csv.reader((s for _, s in lines[1:]), delimiter=separator), strict=True):
        if len(cells) != len(header):
            raise RecordingError(f"{path}:{number}: expected {len(header)} cells as in the first line, got {len(cells)}")
        rows.append((number, cells))

    def numbers(name: str, empty: float, words: Mapping[str, float] | None = None) -> Array:
        column = place[name.lower()]
        return np.array([_number(path, n, name, cells[column], empty, words or {}, separator) for n, cells in rows])

    gap = numbers(unit[0], np.inf, dict.fromkeys(EMPTY, np.inf)) * UNITS[unit[0]]
    wrong = np.flatnonzero(np.isfinite(gap) & ((gap < 0.0) | (gap > FARTHEST)) | np.isnan(gap))
    if len(wrong):
        raise RecordingError(f"{path}:{rows[wrong[0]][0]}: expected a distance from 0 to {FARTHEST:g} m, got {gap[wrong[0]]:g} m")
    volts = np.stack([numbers(name, np.nan) for name in electrodes], axis=1)
    volts[~np.isfinite(volts)] = np.nan
    low = np.argwhere(volts < 0.0)
    if len(low):
        raise RecordingError(
            f"{path}:{rows[low[0][0]][0]}: expected an amplitude of at least 0 V, got {volts[tuple(low[0])]:g} for "
            f"{electrodes[low[0][1]]}"
        )
    largest = float(np.nanmax(volts, initial=0.0))
    if largest > 30.0:
        raise RecordingError(
            f"{path}: expected amplitudes in volts, got {largest:g}; check whether they are millivolts or counts"
        )
    labels = {name: np.full(len(rows), "", dtype=np.str_) for name in LABELS}
    for name in set(LABELS) & set(place):
        labels[name] = np.array([cells[place[name]].strip() for _, cells in rows], dtype=np.str_)
    beside = {name: numbers(name, 0.0) if name in place else np.zeros(len(rows)) for name in NUMBERS}
    for name, column in beside.items():
        if not np.isfinite(column).all():
            line = rows[int(np.argmin(np.isfinite(column)))][0]
            raise RecordingError(f"{path}:{line}: expected a number for {name}, or nothing")
    return Recording(gap, volts, tuple(electrodes), labels, beside, tuple(notes))


def write(path: Path, recording: Recording, about: str) -> None:
    """Write a recording in the form that `read` reads; columns without data are left out. about: the file's first line."""
    labels = [name for name, column in recording.labels.items() if (column != "").any()]
    numbers = [name for name, column in recording.numbers.items() if column.any()]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        file.write(f"# {about}\n")
        writer = csv.writer(file)
        writer.writerow([*labels, "distance_m", *numbers, *recording.electrodes])
        for i, gap in enumerate(recording.gap):
            writer.writerow(
                [
                    *(recording.labels[name][i] for name in labels),
                    f"{gap:.6g}" if np.isfinite(gap) else "empty",
                    *(f"{recording.numbers[name][i]:.6g}" for name in numbers),
                    *(f"{v:.6f}" if np.isfinite(v) else "" for v in recording.volts[i]),
                ]
            )


def _number(path: Path, line: int, name: str, text: str, empty: float, words: Mapping[str, float], separator: str) -> float:
    text = text.strip().lower()
    if text in words:
        return words[text]
    if not text:
        return empty
    try:
        return float(text.replace(",", ".") if separator != "," else text)
    except ValueError:
        raise RecordingError(f"{path}:{line}: expected a number for {name}, got {text!r}") from None
