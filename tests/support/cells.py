"""Cells of any size, made from a built-in one: work places side by side, each with the equipment of the built-in cell."""

from __future__ import annotations

import math
from pathlib import Path

import yaml

from penumbra.shared.cell import description as cells

PITCH = 4.0
"""Distance [m] between work places along x: no camera sees the next one's arm, no pad feels it."""


def derive(base: str, cameras: int, targets: int, folder: Path, rate_hz: float | None = None) -> Path:
    """Writes a cell file with these numbers of cameras and targets, and returns its path.

    A work place for each target, with its own set of pads; camera k looks at place k modulo their number, from the built-in
    place and, where a place has several, from other directions around it. A robot stays with the first place. rate_hz: of the
    cameras (default: the built-in rate).
    """
    source = cells.source(base)
    data = yaml.safe_load(source.read_text())
    camera, pads = next(iter(data["cameras"].values())), data["pads"]
    name, target = next(iter(data["targets"].items()))
    data["name"] = f"{data['name']}-{cameras}x{targets}"
    data["targets"] = {
        name if place == 0 else f"{name}{place}": {**target, "home": _shifted(target["home"], place)} for place in range(targets)
    }
    data["pads"] = {
        pad if place == 0 else f"{pad}_{place}": _shifted(description, place)
        for place in range(targets)
        for pad, description in pads.items()
        if place == 0 or "link" not in description
    }
    data["cameras"] = {f"camera{k}": _turned(camera, k % targets, k // targets, rate_hz) for k in range(cameras)}
    if targets > 1 and "table" in data["sim"]:
        length, breadth = data["sim"]["table"]
        x, y = data["sim"]["table_middle"]
        data["sim"] |= {"table": [length + (targets - 1) * PITCH, breadth], "table_middle": [x + (targets - 1) * PITCH / 2, y]}
    path = folder / f"{data['name']}.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    return path


def _shifted(description: dict, place: int) -> dict:
    x, y, z = description["position"]
    return {**description, "position": [x + place * PITCH, y, z]}


def _turned(camera: dict, place: int, turn: int, rate_hz: float | None) -> dict:
    """A camera at a place, turned about the point that it looks at: by 0, 40, -40, 80 … degrees about the vertical."""
    angle = math.radians(40.0 * ((turn + 1) // 2) * (-1) ** (turn + 1))
    x, y, z = (a - b for a, b in zip(camera["position"], camera["look_at"], strict=True))
    c, s = math.cos(angle), math.sin(angle)
    middle = _shifted({"position": camera["look_at"]}, place)["position"]
    position = [middle[0] + c * x - s * y, middle[1] + s * x + c * y, middle[2] + z]
    return {**camera, "position": position, "look_at": middle, **({} if rate_hz is None else {"rate_hz": rate_hz})}
