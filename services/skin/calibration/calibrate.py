"""`penumbra skin calibrate`: the response law of every electrode of a pad, from a recording or by hand, into the cell file."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import YAMLError

from penumbra.services import flags
from penumbra.services.skin.calibration import law, recording
from penumbra.services.skin.calibration.law import Fit, RecordingError
from penumbra.services.skin.calibration.recording import Recording
from penumbra.shared.cell import description as cells
from penumbra.shared.cell import edit
from penumbra.shared.cell.pads import Law
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import Voltages
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.runtime import bus

GAPS_M = (0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.08, 0.12, 0.16, 0.20)
"""Default gaps [m]: even steps of the signal's logarithm."""
SHOWN_M = (0.01, 0.02, 0.03, 0.05, 0.08, 0.10, 0.12, 0.15, 0.20)
"""Gaps [m] in the table of signal-to-noise ratios."""
PATIENCE_S = 3.0
"""Time [s] to wait for voltages before an error is reported."""
BY_HAND = 2e-3
"""Standard deviation [m] of a gap that is held by hand with a ruler."""


def _gap(text: str) -> float:
    value = flags.above_zero(text)
    if value > 0.5:
        raise ValueError(f"expected a gap in metres, at most 0.5, got {text!r}")
    return value


@flags.command(
    "skin calibrate",
    __doc__ or "",
    flags.Option(
        "--pad", show_default="the recording's column `pad`, or the cell's first pad", help="the pad that is calibrated"
    ),
    flags.Option(
        "--csv",
        type=Path,
        metavar="FILE",
        help="a recording: columns distance_m (`empty` where nothing is near) and one per electrode in volts, many samples a "
        "distance; without it the limb is held by hand",
    ),
    flags.Option(
        "--distances",
        type=_gap,
        takes="many",
        metavar="M ...",
        show_default=" ".join(f"{d:g}" for d in GAPS_M),
        help="gaps to hold the limb at",
    ),
    flags.Option("--seconds", type=flags.above_zero, default=2.0, help="samples at each gap"),
    flags.Option("--record", type=Path, metavar="FILE", help="keep what was read by hand as a recording"),
    flags.Option(
        "--placing",
        type=flags.above_zero,
        metavar="M",
        show_default=f"{law.PLACING:g} of recordings, {BY_HAND:g} by hand",
        help="standard deviation of the gaps",
    ),
    flags.Option("--out", type=Path, metavar="FILE", show_default="the cell file itself", help="write the cell here"),
    flags.Option("--dry-run", is_flag=True, help="print, write nothing"),
    flags.JSON,
    *flags.MEASURING,
    example="penumbra skin calibrate --cell mine.yaml --pad p0 --csv recording.csv",
)
def main(options: flags.Options) -> int:
    """Run the command; returns 0, or 2 for wrong readings or a wrong cell file."""
    if options.csv is not None and (options.distances or options.record):
        flags.refuse("--distances and --record belong to the guided procedure: leave --csv out, or them")
    try:
        _calibrate(options)
    except (RecordingError, cells.CellError, bus.BusError) as error:
        for line in str(error).splitlines():
            print(f"penumbra skin calibrate: {line}", file=sys.stderr)
        return 2
    return 0


def _calibrate(options: flags.Options) -> None:
    cell = cells.load(options.cell)
    path = edit.destination(options.cell, options.out) if not options.dry_run else None
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


# ---- readings


def _recorded(cell: cells.Cell, options: flags.Options) -> dict[str, Recording]:
    """On-axis rows of each pad in a CSV file; rows at an angle or from a plane scan are for `characterise`."""
    pad = cell.one("pads", options.pad)
    kind = cell.pad_types[cell.pads[pad].type]
    found = recording.read(options.csv, list(kind.electrodes), "--csv")
    named = found.labels["pad"]
    if (named != "").any() and options.pad is None:
        unknown = sorted(set(named) - set(cell.pads))
        if unknown:
            got = ", ".join(unknown)
            raise RecordingError(f"{options.csv}: expected pads of cell {cell.name} ({', '.join(cell.pads)}), got {got}")
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
            raise RecordingError(f"pad {name}: expected the electrodes of {pad}, got others; use one file per pad type")
        objects = sorted(set(found.labels["object"][own]) - {"", "empty"})
        if len(objects) > 1:
            own &= np.isin(found.labels["object"], ["", "empty", "forearm"]) if "forearm" in objects else own
            if "forearm" not in objects:
                raise RecordingError(f"{options.csv}: expected one object, or a forearm among them, got {', '.join(objects)}")
        out[name] = found.where(own)
    return out


def guided(
    cell: cells.Cell, pad: str, connection: bus.Connection, gaps: Sequence[float], seconds: float, console: Console
) -> Recording:
    """Prompt for the empty scene and each gap on the terminal (or a pipe of Enters) and record each. Raises RecordingError if the
    input ends early, BusError if no voltages arrive."""
    from penumbra.shared.runtime.node import Node

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
                    f"pad {pad}: expected voltages within {PATIENCE_S:g} s, got none; start `penumbra skin` or `penumbra "
                    f"emulator` on cell {cell.name}"
                )
            if volts.shape[1] != len(electrodes):
                raise RecordingError(
                    f"pad {pad}: expected {len(electrodes)} electrodes as in the cell file, got {volts.shape[1]}"
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
        raise RecordingError("the answers ended before the last gap: expected Enter for each gap, or q to end early") from None


class _Ear:
    """Collects a pad's batches during a measurement."""

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
        """Samples (s, e) of the next `seconds`, or None if too few arrive."""
        with self._lock:
            self._heard, self._wanted_s = [], seconds
            self._full.clear()
        if not self._full.wait(seconds + PATIENCE_S):
            return None
        return np.concatenate(self._heard)


# ---- the fits


def calibrate(cell: cells.Cell, pad: str, recorded: Recording, placing: float = law.PLACING) -> dict[str, Fit]:
    """Fit every electrode of a pad. Raises RecordingError that names all electrodes that cannot be fitted."""
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
            f"pad {pad}: mixed polarity: as the limb approaches, {', '.join(rising)} rise and {', '.join(falling)} fall: one "
            "amplifier moves all in one direction; check that every channel is connected, and to the right electrode"
        )
    return fits


def describe(fit: Fit) -> dict[str, Any]:
    """A fit as JSON: the law, relative standard deviations of a1 and a2, that of a3 [V], gain, and the gap [m] at which the SNR
    is 1 dB."""
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


def write(source: Path, path: Path, laws: dict[str, dict[str, Law]]) -> None:
    """Write the cell file at `source` with the laws of these pads to `path`; comments and layout are kept. The file is replaced
    only by one that loads. Raises RecordingError if it cannot be read, CellError if it cannot be written."""
    editor = YAML()
    editor.preserve_quotes = True
    editor.width = 1 << 20  # breaks no line
    try:
        data = editor.load(source.read_text())
    except (OSError, YAMLError) as error:
        raise RecordingError(f"{source}: cannot be read: {error}") from None
    for pad, by_electrode in laws.items():
        entry = data["pads"][pad]
        entry["calibration"] = _block({name: _row(found) for name, found in by_electrode.items()})
        entry.fa.set_block_style()
    text = StringIO()
    editor.dump(data, text)
    edit.write(path, text.getvalue())


def _block(entries: dict[str, CommentedMap]) -> CommentedMap:
    out = CommentedMap(entries)
    out.fa.set_block_style()
    return out


def _row(found: Law) -> CommentedMap:
    """A law as one line of YAML; five digits are far below the uncertainty."""
    values = {name: float(f"{getattr(found, name):.5g}") for name in ("a1", "a2", "a3")}
    out = CommentedMap(**values, polarity=found.polarity, noise=float(f"{found.noise:.4g}"))
    out.fa.set_flow_style()
    return out
