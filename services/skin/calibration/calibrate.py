"""`penumbra skin calibrate`: the response law of every electrode of a pad, from a recording or by hand, into the cell file."""

from __future__ import annotations

import argparse
import json
import os
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import YAMLError

from services import flags
from services.skin.calibration import law, recording
from services.skin.calibration.law import Fit, RecordingError
from services.skin.calibration.recording import Recording
from shared.cell import description as cells
from shared.contract import topics
from shared.contract.messages import Voltages
from shared.geometry.rigid import Array
from shared.runtime import bus

GAPS_M = (0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.08, 0.12, 0.16, 0.20)
"""Asked for by default: even steps of the signal's logarithm."""
SHOWN_M = (0.01, 0.02, 0.03, 0.05, 0.08, 0.10, 0.12, 0.15, 0.20)
"""Rows of the table of signal-to-noise ratios."""
PATIENCE_S = 3.0
"""How long to wait for voltages before saying that none come."""
BY_HAND = 2e-3
"""Standard deviation [m] of a gap that is held by hand with a ruler."""


def main(argv: list[str]) -> int:
    """0, or 2 for readings or a cell file that are wrong."""
    try:
        _calibrate(argv)
    except (RecordingError, cells.CellError, bus.BusError) as error:
        for line in str(error).splitlines():
            print(f"penumbra skin calibrate: {line}", file=sys.stderr)
        return 2
    return 0


def _calibrate(argv: list[str]) -> None:
    options = _options(argv)
    cell = cells.load(options.cell)
    path = destination(options.cell, options.out) if not options.dry_run else None
    console = Console(highlight=False, soft_wrap=True, stderr=options.json)
    if options.csv is not None:
        recordings = _recorded(cell, options)
    else:
        pad = cell.one("pads", options.pad)
        gaps = sorted(options.distances or GAPS_M)
        recordings = {pad: guided(cell, pad, bus.connection(options), gaps, options.seconds, console)}
        if options.record is not None:
            recording.write(options.record, recordings[pad], f"pad {pad} of cell {cell.name}, held by hand")
    placing = options.placing or (law.PLACING if options.csv is not None else BY_HAND)
    found = {pad: calibrate(cell, pad, recorded, placing) for pad, recorded in recordings.items()}
    for pad, fits in found.items():
        _show(console, pad, fits, recordings[pad].notes)
    if path is not None:
        laws = {pad: {name: fit.law for name, fit in fits.items()} for pad, fits in found.items()}
        write(cells.source(options.cell), path, laws)
        console.print(f"{escape(str(path))}: calibration of {', '.join(found)} written")
    if options.json:
        print(json.dumps({pad: {name: describe(fit) for name, fit in fits.items()} for pad, fits in found.items()}))


def _options(argv: list[str]) -> argparse.Namespace:
    parser = flags.parser("skin calibrate", __doc__ or "")
    parser.add_argument("--pad", help="which pad (default: the recording's column `pad`, or the cell's first pad)")
    parser.add_argument("--csv", type=Path, metavar="FILE",
                        help="a recording: columns distance_m (`empty` where nothing is near) and one per electrode in volts, "
                             "many samples a distance; without it the limb is held by hand")  # fmt: skip
    parser.add_argument("--distances", type=_gap, nargs="+", metavar="M",
                        help=f"gaps to hold the limb at (default: {' '.join(f'{d:g}' for d in GAPS_M)})")  # fmt: skip
    parser.add_argument("--seconds", type=_positive, default=2.0, help="samples at each gap (default: %(default)s)")
    parser.add_argument("--record", type=Path, metavar="FILE", help="keep what was read by hand as a recording")
    by_default = f"{law.PLACING:g} of recordings, {BY_HAND:g} by hand"
    parser.add_argument("--placing", type=_positive, metavar="M", help=f"standard deviation of the gaps (default: {by_default})")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the cell here (default: the cell file itself)")
    parser.add_argument("--dry-run", action="store_true", help="print, write nothing")
    parser.add_argument("--json", action="store_true", help="print the fits as JSON")
    options = parser.parse_args(argv)
    if options.csv is not None and (options.distances or options.record):
        parser.error("--distances and --record belong to the guided procedure: leave --csv out, or them")
    return options


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"a number above 0 expected, {text} came")
    return value


def _gap(text: str) -> float:
    value = _positive(text)
    if value > 0.5:
        raise argparse.ArgumentTypeError(f"a gap in metres, at most 0.5, expected, {text} came")
    return value


def destination(cell: str, out: Path | None) -> Path:
    """The file that a calibration goes into. Raises RecordingError for a built-in cell without `out`."""
    source = cells.source(cell)
    if out is None and source.parent == cells.BUILT_IN:
        raise RecordingError(f"the built-in cell {cell} is not overwritten: give --out FILE, and use that with --cell")
    return out or source


# ---- readings


def _recorded(cell: cells.Cell, options: argparse.Namespace) -> dict[str, Recording]:
    """What a CSV file holds of each pad, on axis: rows at an angle or from a plane scan belong to `characterise`."""
    pad = cell.one("pads", options.pad)
    kind = cell.pad_types[cell.pads[pad].type]
    found = recording.read(options.csv, list(kind.electrodes))
    named = found.labels["pad"]
    if (named != "").any() and options.pad is None:
        unknown = sorted(set(named) - set(cell.pads))
        if unknown:
            came = ", ".join(unknown)
            raise RecordingError(f"{options.csv}: pads of cell {cell.name} expected ({', '.join(cell.pads)}), came {came}")
        wanted = [name for name in cell.pads if (named == name).any()]
    else:
        wanted = [pad]
        if (named != "").any() and not (named == pad).any():
            raise RecordingError(f"{options.csv}: no row of pad {pad}: it has {', '.join(sorted(set(named)))}")
    on_axis = (found.numbers["angle_deg"] == 0.0) & (found.labels["scan"] != "plane")
    out = {}
    for name in wanted:
        own = on_axis & ((named == name) | (named == ""))
        if tuple(cell.pad_types[cell.pads[name].type].electrodes) != found.electrodes:
            raise RecordingError(f"pad {name} has other electrodes than {pad}: one file a pad type expected")
        objects = sorted(set(found.labels["object"][own]) - {"", "empty"})
        if len(objects) > 1:
            own &= np.isin(found.labels["object"], ["", "empty", "forearm"]) if "forearm" in objects else own
            if "forearm" not in objects:
                raise RecordingError(f"{options.csv}: one object expected, or a forearm among them, came {', '.join(objects)}")
        out[name] = found.where(own)
    return out


def guided(
    cell: cells.Cell, pad: str, connection: bus.Connection, gaps: Sequence[float], seconds: float, console: Console
) -> Recording:
    """Asks for the empty scene and each gap on the terminal (or a pipe of Enters) and records each. Raises RecordingError where
    the answers end early, BusError where no voltages come."""
    from shared.runtime.node import Node

    electrodes = tuple(cell.pad_types[cell.pads[pad].type].electrodes)
    ear = _Ear()
    node = Node("calibrate", cell, connection)
    node.subscribe(topics.VOLTAGES, ear, pad=pad)
    gap_rows, volts_rows = [], []
    console.print(f"Pad {pad}: Enter begins each recording of {seconds:g} s, s leaves one out, q ends.")
    with node.open(1.0):
        for gap in (np.inf, *gaps):
            what = f"Hold the skin {100 * gap:g} cm above the middle of pad {pad}" if np.isfinite(gap) else "Take everything away"
            console.print(f"{what}: ", end="")
            answer = _answer()
            if answer == "q":
                break
            if answer == "s":
                continue
            volts = ear.listen(seconds)
            if volts is None:
                raise bus.BusError(
                    f"no voltages of pad {pad} came within {PATIENCE_S:g} s: is `penumbra skin` or `penumbra emulator` running "
                    f"on cell {cell.name}?"
                )
            if volts.shape[1] != len(electrodes):
                raise RecordingError(
                    f"pad {pad}: {len(electrodes)} electrodes expected as in the cell file, {volts.shape[1]} came"
                )
            means = "  ".join(f"{name} {mean:.4f} V" for name, mean in zip(electrodes, volts.mean(axis=0), strict=True))
            console.print(f"  {len(volts)} samples, {means}")
            gap_rows.append(np.full(len(volts), gap))
            volts_rows.append(volts)
    if not gap_rows:
        raise RecordingError("nothing was recorded: press Enter at each gap")
    s = sum(map(len, gap_rows))
    labels = {name: np.full(s, pad if name == "pad" else "") for name in recording.LABELS}
    numbers = {name: np.zeros(s) for name in recording.NUMBERS}
    return Recording(np.concatenate(gap_rows), np.concatenate(volts_rows), electrodes, labels, numbers)


def _answer() -> str:
    try:
        return input().strip().lower()
    except EOFError:
        raise RecordingError(
            "the answers ended before the last gap: Enter for each of them expected, or q to end early"
        ) from None


class _Ear:
    """Keeps a pad's batches while asked to."""

    def __init__(self) -> None:
        self._heard: list[Array] = []
        self._wanted_s = 0.0
        self._full = threading.Event()
        self._lock = threading.Lock()

    def __call__(self, message: Voltages, _: dict[str, str]) -> None:
        with self._lock:
            if self._wanted_s <= 0.0:
                return
            self._heard.append(message.volts.astype(np.float64))
            self._wanted_s -= len(message.volts) * message.period_ns * 1e-9
            if self._wanted_s <= 0.0:
                self._full.set()

    def listen(self, seconds: float) -> Array | None:
        """Samples (s, e) of the next so many seconds, or None where too few come."""
        with self._lock:
            self._heard, self._wanted_s = [], seconds
            self._full.clear()
        if not self._full.wait(seconds + PATIENCE_S):
            return None
        return np.concatenate(self._heard)


# ---- the fits


def calibrate(cell: cells.Cell, pad: str, recorded: Recording, placing: float = law.PLACING) -> dict[str, Fit]:
    """The fit of every electrode of a pad. Raises RecordingError that names all electrodes that cannot be fitted."""
    kind = cell.pad_types[cell.pads[pad].type]
    chain = kind.chain
    full_scale, lsb = chain.adc_reference / 2.0, chain.adc_reference / (2.0**chain.adc_bits - 1.0)
    fits, wrong = {}, []
    for k, name in enumerate(recorded.electrodes):
        try:
            read = law.readings(recorded.gap, recorded.volts[:, k], full_scale, lsb, f"{pad}/{name}")
            fits[name] = law.fit(read, kind.law(name), f"{pad}/{name}", placing)
        except RecordingError as error:
            wrong.append(str(error))
    if wrong:
        raise RecordingError("\n".join(wrong))
    ways = {fit.law.polarity for fit in fits.values()}
    if len(ways) > 1:
        rising = [name for name, fit in fits.items() if fit.law.polarity > 0]
        falling = [name for name in fits if name not in rising]
        raise RecordingError(
            f"pad {pad}: mixed polarity: as the limb comes near {', '.join(rising)} rise and {', '.join(falling)} fall: one "
            "amplifier makes all go one way. Is a channel not connected, or assigned to the wrong electrode?"
        )
    return fits


def describe(fit: Fit) -> dict[str, Any]:
    """A fit as JSON: the law, relative standard deviations of a1 and a2, that of a3 [V], gain, and where SNR is 1 dB [m]."""
    return {
        **fit.law.model_dump(),
        "deviation": dict(zip(("a1", "a2", "a3"), map(float, fit.deviation), strict=True)),
        "gain": fit.gain,
        "reach_m": law.reach(fit.law),
        "snr_db": {f"{gap:g}": float(law.snr_db(fit.law, gap)) for gap in SHOWN_M},
        "notes": list(fit.notes),
    }


def _show(console: Console, pad: str, fits: dict[str, Fit], notes: Sequence[str]) -> None:
    headings = ("", "a1 V", "±%", "a2 1/m2", "±%", "a3 V", "±mV", "sign", "noise mV", "gain", f"{law.SNR_DB:g} dB at")
    table = Table(*headings, box=None, title=f"pad {escape(pad)}: v = a3 + polarity a1 / (1 + a2 d^2)")
    for name, fit in fits.items():
        found, deviation = fit.law, fit.deviation
        table.add_row(
            name,
            f"{found.a1:.3g}",
            f"{100 * deviation[0]:.0f}",
            f"{found.a2:.0f}",
            f"{100 * deviation[1]:.0f}",
            f"{found.a3:.4f}",
            f"{1e3 * deviation[2]:.2f}",
            f"{found.polarity:+d}",
            f"{1e3 * np.sqrt(found.noise):.2f}",
            f"{fit.gain:.3f}",
            f"{100 * law.reach(found):.1f} cm",
        )
    console.print(table)
    ratios = Table("gap", *fits, box=None, title="signal-to-noise ratio of one sample, dB")
    for gap in SHOWN_M:
        ratios.add_row(f"{100 * gap:g} cm", *(f"{law.snr_db(fit.law, gap):.1f}" for fit in fits.values()))
    console.print(ratios)
    for note in (*notes, *(f"{name}: {note}" for name, fit in fits.items() for note in fit.notes)):
        console.print(f"[yellow]note[/] {escape(note)}")


# ---- the cell file


def write(source: Path, path: Path, laws: dict[str, dict[str, cells.Law]]) -> None:
    """The cell file at `source` with the laws of these pads, at `path`; its comments and layout stay. The file is replaced
    only by one that loads. Raises RecordingError where it cannot be written."""
    editor = YAML()
    editor.preserve_quotes = True
    editor.width = 1 << 20  # breaks no line
    try:
        data = editor.load(source.read_text())
        for pad, by_electrode in laws.items():
            entry = data["pads"][pad]
            entry["calibration"] = _block({name: _row(found) for name, found in by_electrode.items()})
            entry.fa.set_block_style()
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_name(f".{path.name}.{os.getpid()}.yaml")
        try:
            with draft.open("w") as file:
                editor.dump(data, file)
            cells.load(draft)
            draft.replace(path)
        except cells.CellError as error:
            raise RecordingError(
                f"{path}: the cell would not load from there: {str(error).replace(str(draft), str(path))}"
            ) from None
        finally:
            draft.unlink(missing_ok=True)
    except (OSError, YAMLError) as error:
        raise RecordingError(f"{path}: cannot be written: {error}") from None


def _block(entries: dict[str, CommentedMap]) -> CommentedMap:
    out = CommentedMap(entries)
    out.fa.set_block_style()
    return out


def _row(found: cells.Law) -> CommentedMap:
    """One line; five digits are far below the uncertainty."""
    values = {name: float(f"{getattr(found, name):.5g}") for name in ("a1", "a2", "a3")}
    out = CommentedMap(**values, polarity=found.polarity, noise=float(f"{found.noise:.4g}"))
    out.fa.set_flow_style()
    return out
