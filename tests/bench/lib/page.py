"""One self-contained HTML page: the table beside the paper's, the goals, and all pictures."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path
from typing import Any

from penumbra.sim.sets.trial import HIDDEN
from penumbra.tests.bench import table1

STYLE = """
:root { color-scheme: light; --ink: #1c2530; --pale: #66707c; --line: #dfe4e9; --ours: #1257a8; --good: #e6f3e9; --bad: #fbe7e4; }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; margin-bottom: .2rem; } h2 { font-size: 1.25rem; margin: 2.4rem 0 .4rem; }
p.note, figcaption { color: var(--pale); font-size: .92rem; } figure { margin: 0; } img { max-width: 100%; height: auto; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { padding: .3rem .5rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th { font-weight: 600; vertical-align: bottom; } th.left, td.left { text-align: left; } td small { color: var(--pale); }
tr.part th { text-align: left; padding-top: 1rem; } td.good { background: var(--good); } td.bad { background: var(--bad); }
td b { color: var(--ours); }
"""
CAPTIONS = {
    "table": ("All cells at a glance", "Logarithmic scale; the bar is the 95 % confidence interval over the runs."),
    "vision_by_distance": (
        "Vision against camera distance",
        "Frames of all runs with less than 10 % hidden; means with 95 % confidence. Above: the focal length in the "
        "pixels that were read.",
    ),
    "haptic_by_gap": (
        "The skin against distance",
        "One window of ten samples from eight pads, voltages of the boundary-element model, limbs of unknown size. Dotted: the "
        "range that the skin claims.",
    ),
    "through_occlusion": (
        "Through an occlusion",
        "One run beside the robot in the skin's range. A line ends where its sense says that it has no pose.",
    ),
    "response_by_gap": (
        "Response against distance",
        "A forearm across the pad's middle, and the law v = a1 / (1 + a2 d^2) fitted in log space.",
    ),
    "examples": (
        "Levels of occlusion",
        "Frames of that run; green: where the fused pose has the forearm.",
    ),
}
HEADS = ("ProcNet", "multimodal ProcNet", "PoseCNN", "multimodal PoseCNN")


def write(found: dict[str, Any], folder: Path, path: Path, quick: bool) -> None:
    """The page of a table and of the pictures NAME.png in a folder."""
    warning = "<p><strong>A quick run: to see that everything works. Its numbers mean little.</strong></p>" if quick else ""
    trials = sorted({cell["trials"] for _, _, _, cell in table1.cells_of(found)})
    parts = [
        "<!doctype html><html lang='en'><meta charset='utf-8'><meta name='viewport' content='width=device-width'>",
        f"<title>Penumbra beside the paper</title><style>{STYLE}</style>",
        "<h1>Penumbra beside the paper</h1>",
        f"<p class='note'>Position error of a forearm's centre, averages in cm. Seed {found['seed']}, "
        f"{' to '.join(map(str, trials))} runs a cell. Paper: Zechmair, Bornet, Morel, <cite>Multimodal visual-haptic pose "
        "estimation in the presence of transient occlusion</cite>, table 1.</p>",
        warning,
        "<h2>The table</h2><div class='wide'>",
        _table(found),
        "</div>",
        f"<p class='note'>{escape(found['camera'])}; the paper names none. Ours in blue with the 95 % confidence "
        "interval of a bootstrap over the runs, then the paper's number; green: at most the paper's. Fused poses are those of a "
        "frame's exposure, reported when the camera's pose of it is known; as published: the value published at the "
        "exposure. A sense is scored where it has a pose; the last column says how often it has none.</p>",
        _goals(found),
    ]
    for name, (title, text) in CAPTIONS.items():
        data = base64.b64encode((folder / f"{name}.png").read_bytes()).decode()
        parts.append(
            f"<h2>{escape(title)}</h2><figure><img alt='{escape(title)}' src='data:image/png;base64,{data}'>"
            f"<figcaption>{escape(text)} Data: {'table1' if name == 'table' else name}.json</figcaption></figure>"
        )
    path.write_text("\n".join(parts) + "</html>\n")


def _table(found: dict[str, Any]) -> str:
    heads = "".join(f"<th>{head}<br><small>ours [95 %] / paper</small></th>" for head in HEADS)
    rows = [
        f"<table><thead><tr><th class='left'>camera</th><th class='left'>hidden</th>{heads}"
        "<th>multimodal<br><small>as published</small></th><th>paper's method<br><small>vision / fused</small></th>"
        "<th>p95<br><small>fused</small></th>"
        "<th>axis / roll<br><small>fused</small></th><th>no pose<br><small>vision / fused</small></th></tr></thead><tbody>"
    ]
    part = ""
    for reach, distance, occlusion, cell in table1.cells_of(found):
        if reach != part:
            part = reach
            rows.append(f"<tr class='part'><th colspan='11'>{reach} of the skin's range</th></tr>")
        band = "{:.0f}-{:.0f} %".format(*(100 * share for share in HIDDEN[occlusion]))
        own = "".join(_cell(cell, k) for k in range(len(HEADS)))
        both = " / ".join(_number(cell["ours"][k]) for k in (4, 5))
        angles = " / ".join(_number(cell[error][1], 1) for error in ("axis_deg", "roll_deg"))
        missing = " / ".join("-" if share is None else f"{100 * share:.0f} %" for share in cell["no_pose"][:2])
        rows.append(
            f"<tr><td class='left'>{distance}</td><td class='left'>{occlusion} <small>{band}</small></td>"
            f"{own}<td>{_number(cell['ours'][6])}</td><td>{both}</td><td>{_number(cell['p95_cm'][1])}</td><td>{angles}&deg;</td><td>{missing}</td></tr>"
        )
    return "".join(rows) + "</tbody></table>"


def _cell(cell: dict[str, Any], k: int) -> str:
    value, interval, paper = cell["ours"][k], cell["ours_ci95"][k], cell["paper"][k]
    spread = f" <small>[{interval[0]:.2f}, {interval[1]:.2f}]</small>" if interval else ""
    verdict = ""
    if value is not None and k < 2:  # that our PoseCNN differs from theirs is neither good nor bad
        verdict = " class='good'" if value <= paper else " class='bad'"
    return f"<td{verdict}><b>{_number(value)}</b>{spread} / {paper:.2f}</td>"


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _goals(found: dict[str, Any]) -> str:
    items = []
    for result in found["goals"].values():
        missed = ", ".join(f"{name} ({_number(ratio)})" for name, ratio in result["missed"].items())
        more = f"; over it, as a factor: {escape(missed)}" if missed else ""
        items.append(f"<li>{escape(result['goal'])}: {result['met']} of {result['of']} cells{more}</li>")
    return f"<h2>Goals</h2><ul>{''.join(items)}</ul>"
