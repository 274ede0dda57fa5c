"""The paper's curves as numbers: each function returns the data of one picture, ready for JSON."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import raster, rigid
from penumbra.sim.sets import trial
from penumbra.sim.skin.field import PadField, limb
from penumbra.tests.bench import haptics, skin, table1
from penumbra.tests.bench.lib.trials import ERRORS, Played

EDGES_M = (1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0)
"""Borders [m] of the bins of camera distance."""
CLEAR = 0.10
"""Maximum hidden share for errors by distance, as in the paper."""
AXES = ("lateral_cm", "depth_cm", "attitude_deg")
GAPS_CM = np.arange(1.0, 20.5, 1.0)
LEVELS = {"no occlusion": 0.9, "light": 2.0, "medium": 3.3, "heavy": 4.6}
"""Time [s] in the middle of each level of a passage."""


def vision_by_distance(results: Sequence[Played]) -> dict[str, Any]:
    """Mean errors of the vision of every chain by camera distance, of all runs' frames that are less than CLEAR hidden."""
    out: dict[str, Any] = {"hidden_below": CLEAR, "edges_m": list(EDGES_M), "chains": {}}
    for chain in results[0]["chains"]:
        rows = []
        for low, high in itertools.pairwise(EDGES_M):
            own = [each for each in results if low <= each["distance_m"] < high]
            row: dict[str, Any] = {"from_m": low, "to_m": high}
            for error in AXES:
                values = [_clear(each, chain, error) for each in own]
                known = np.concatenate([*values, np.zeros(0)])
                row[error] = round(float(known.mean()), 4) if len(known) else None
                row[f"{error}_ci95"] = table1.bootstrap(values)
                row["frames"] = len(known)
            rows.append(row)
        out["chains"][chain] = rows
    return out


def _clear(result: Played, chain: str, error: str) -> np.ndarray:
    """An error of vision in the frames with less than CLEAR hidden, from half the lead-in on."""
    values = np.array(result["chains"][chain]["vision"][error], dtype=float)
    use = (np.array(result["hidden"]) < CLEAR) & (np.array(result["times_s"]) >= trial.LEAD_S / 2.0)
    return values[use & np.isfinite(values)]


def haptic_by_gap(seed: int, quick: bool) -> dict[str, Any]:
    """Root mean squares of the skin's errors by the gap, of one window of ten samples from eight pads (`penumbra bench haptics`):
    ours from a broad prior and from a track, the Cramér-Rao bound of the latter, and the paper's network."""
    rig, plan = haptics.Rig("bare"), haptics.Plan(1 if quick else 12, 4, 0, 0, 0.0, 0)
    scenes: dict[tuple[int, float, int], haptics.Scene] = {}
    out: dict[str, Any] = {"array": rig.name, "pads": 8, "rows": []}
    for method in ("solve", "paper"):
        for row in haptics.single_windows(rig, seed, plan, method, scenes, (8,)):
            if row["speed"] == 0.0:
                out["rows"].append({"method": method, **row})
    return out


def response_by_gap() -> dict[str, Any]:
    """The centre electrode's signal [V] before a forearm that lies across, by the gap, of the boundary-element model; and the
    paper's law fitted to it."""
    cell = cells.load("table")
    kind = next(iter(cell.pad_types.values()))
    pad, mesh = PadField(kind), skin.forearm(cell)
    body = limb(mesh)
    volts = kind.chain.sensitivity * np.array([pad.change(body, skin.across(mesh, gap / 100))[0] for gap in GAPS_CM])
    return {
        "gaps_cm": GAPS_CM.tolist(),
        "volts": volts.round(7).tolist(),
        "law": {**skin.law(GAPS_CM / 100, volts), "a3": kind.rest.a3},
        "paper_law": skin.LAW,
        "noise_V": float(np.sqrt(kind.rest.noise)),
    }


def through_occlusion(result: Played) -> dict[str, Any]:
    """A passage: position errors over time, None where there is no pose."""
    return {
        "times_s": result["times_s"],
        "hidden": result["hidden"],
        "gap_m": result["gap_m"],
        "distance_m": result["distance_m"],
        "error_cm": {
            f"{chain}_{sense}": result["chains"][chain][sense]["cm"]
            for chain in result["chains"]
            for sense in ("vision", "fused")
        },
    }


def examples(result: Played, chain: str = "procnet") -> list[dict[str, Any]]:
    """A frame of a passage for every level: its exposure time, the hidden share, the fused pose and its errors."""
    times = np.array(result["times_s"])
    out = []
    for name, time_s in LEVELS.items():
        k = int(np.argmin(np.abs(times - time_s)))
        fused = result["chains"][chain]["fused"]
        out.append(
            {"level": name, "time_s": result["times_s"][k], "hidden": result["hidden"][k], "pose": fused["poses"][k]}
            | {error: fused[error][k] for error in ERRORS}
        )
    return out


def outline(scene: trial.Trial, pose: Sequence[float]) -> np.ndarray:
    """The pixels (h, w) that the limb covers at a stored pose."""
    camera, mesh = scene.camera, scene.world.person.meshes[0]
    T = rigid.inverse(camera.T_world_camera) @ rigid.transform(pose[:3], pose[3:])
    k = (camera.fx, camera.fy, camera.cx, camera.cy)
    return raster.silhouette(rigid.apply(T, mesh.vertices), mesh.faces, k, (0, 0, camera.width, camera.height))
