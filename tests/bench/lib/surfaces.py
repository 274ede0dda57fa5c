"""Points of surfaces and contact (`services.haptics.surface_points`, `.contact`) against the full boundary-element field.

Things of several shapes, on none of which the statistics of shapes were measured, come to rest at a gap before the pads; each is
one window. The true distance is that to the panels of the field model.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from rich.progress import Progress
from rich.table import Table

from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.geometry.surface import Surface
from penumbra.sim.skin import field
from penumbra.tests.bench.lib import things
from penumbra.tests.bench.lib.results import marked

if TYPE_CHECKING:
    from penumbra.tests.bench.haptics import Rig

GAPS = (0.01, 0.02, 0.03, 0.05, 0.075, 0.10, 0.125, 0.15)
CLOSE = (0.003, 0.004, 0.005, 0.007, 0.010, 0.015)
"""Gaps [m] of the rows of distances, and of contact: the boundary elements hold from 3 mm on (finer panels change the signals of
a forearm by 8 % there, by 11 % at 2 mm; nearer, the charges of limb and pad no longer converge)."""
WINDOW = 20
"""Number of samples in a window, as in `penumbra haptics`."""
NEES_BAND = (0.5, 2.0)
"""Goal for the squared error over its variance: standard deviations right within a factor of 1.4."""
ENDS = {"limb, elbow first": 1.0, "limb, hand first": -1.0}
"""Limbs that point at the pads: the sign of their axis along the pads' normal."""


def _ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(3, 0.04)


BODIES: dict[str, tuple[Callable[[], trimesh.Trimesh], float]] = {
    "bar": (things.OBJECTS["metal bar, grounded"][0], things.GROUNDED),
    "plate": (things.OBJECTS["metal plate, grounded"][0], things.GROUNDED),
    "ball": (_ball, things.GROUNDED),
    "bar, floating": (things.OBJECTS["metal bar, floating"][0], things.FLOATING),
}
KINDS = ("limb", *ENDS, *BODIES)
CLEAR = 0.02
"""Minimum distance [m] of a thing from links behind pads where its gap to the boards is larger."""
THINGS = 2
"""Number of things of each kind, of different sizes."""
TRIES = 40
"""Maximum number of places that are drawn until a thing is clear of what is behind the pads."""
PANELS = (30, 20)
"""Numbers of rows and columns of a thing's panels."""


@dataclass(frozen=True)
class Thing:
    """A thing of one of KINDS, prepared for any pose: its field and its surface."""

    kind: str
    body: field.Body
    surface: Surface


def thing(rig: Rig, kind: str, seed: int, k: int) -> Thing:
    """The k-th thing of a kind, of random size. Its surface consists of the field's panels."""
    rng = np.random.default_rng([seed, 700, KINDS.index(kind), k])
    if kind in BODIES:
        make, ground = BODIES[kind]
        body = field.Body(field.shell(np.array(make().vertices) * np.exp(rng.uniform(*things.SCALE)), *PANELS), ground)
    else:
        body = field.limb(rig.mesh, *np.exp([rng.uniform(*things.LENGTH), rng.uniform(*things.GIRTH)]))
    corners = body.panels.corners
    quads = np.arange(4 * len(corners)).reshape(-1, 4)
    return Thing(kind, body, Surface(corners.reshape(-1, 3), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])))


def placed(rig: Rig, one: Thing, gap: float, rng: np.random.Generator) -> Array:
    """A random T_world_thing (4, 4) at a gap [m] between its surface and the nearest board, and clear of links behind boards."""
    parts = zip(rig.pads, rig.fields, rig.skin.pads, strict=True)
    solid = np.concatenate([rigid.apply(pad, known.panels.centroids[::2]) for pad, known, _ in parts])
    for _ in range(TRIES):
        T = _lying(rig, one, rng)
        normal = rig.axes(T, 8)[2, :3] if one.kind not in ENDS else ENDS[one.kind] * T[:3, 0]
        T[:3, 3] += 0.3 * normal
        for _ in range(25):
            T[:3, 3] += (gap - _clearance(one, T, boards(rig))) * normal
        if _clearance(one, T, solid) > min(0.9 * gap, CLEAR):
            return T
    raise RuntimeError(f"{one.kind}: expected a place {gap:g} m before the pads of {rig.name}, got none in {TRIES} tries")


def boards(rig: Rig) -> Array:
    """Points (b, 3) of all boards in the world."""
    out = []
    for T, pad in zip(rig.pads, rig.cell.pads.values(), strict=True):
        xs, ys = (np.linspace(-0.5, 0.5, 7) * side for side in rig.cell.pad_types[pad.type].board.size)
        grid = np.stack([*(each.ravel() for each in np.meshgrid(xs, ys)), np.zeros(49)], axis=1)
        out.append(rigid.apply(T, grid))
    return np.concatenate(out)


def _clearance(one: Thing, T: Array, points: Array) -> float:
    return float(one.surface.nearest((points - T[:3, 3]) @ T[:3, :3])[0].min())


def _lying(rig: Rig, one: Thing, rng: np.random.Generator) -> Array:
    """A random pose 10 cm before the pads; limbs that point at the pads have their end there."""
    T, _ = rig.place(rng, 0.1, 8)
    if one.kind not in ENDS:
        return T
    axes = rig.axes(T, 8)[:3, :3]
    tilt, turn = rng.uniform(0.0, 0.5), rng.uniform(0.0, 2.0 * np.pi)
    x = ENDS[one.kind] * (np.cos(tilt) * axes[2] + np.sin(tilt) * (np.cos(turn) * axes[0] + np.sin(turn) * axes[1]))
    y = np.cross(x, rng.standard_normal(3))
    y /= np.linalg.norm(y)
    T[:3, :3] = np.column_stack([x, y, np.cross(x, y)])
    return T


def _window(rig: Rig, signal: Array, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_]]:
    """Mean voltages, samples and pressed electrodes (n,) of a window, as the collector makes them."""
    rows = rig.voltages(np.tile(signal, (WINDOW, 1)), rng)
    ended = rows >= rig.skin.full_scale - 0.5 * rig.skin.lsb
    return rows.mean(axis=0), np.where(ended.any(axis=0), 0, WINDOW), ended.mean(axis=0) > 0.5


def scene(rig: Rig, one: Thing, gap: float, seed: int, k: int) -> dict[str, Any]:
    """One window: true and reported distances, errors of the points and their covariances, smallest true distance, contact."""
    rng = np.random.default_rng([seed, 701, KINDS.index(one.kind), round(1e4 * gap), k])
    surface, T = one.surface, placed(rig, one, gap, rng)
    amplitude, samples, pressed = _window(rig, rig.signal(one.body, T, 8), rng)
    estimate = rig.estimator(rig.home, things.HOME_SPREAD).update(1, amplitude, samples, rig.pads, rig.joints, pressed=pressed)
    distance, nearest, _ = surface.nearest((rig.pads[:, :3, 3] - T[:3, 3]) @ T[:3, :3])
    true, where = dict(zip(rig.skin.pads, distance, strict=True)), dict(zip(rig.skin.pads, rigid.apply(T, nearest), strict=True))
    return {
        "true": np.array([true[p.pad] for p in estimate.surface]),
        "found": np.array([p.distance for p in estimate.surface]),
        "along": np.array([p.along for p in estimate.surface]),
        "error": np.array([p.position - where[p.pad] for p in estimate.surface]).reshape(-1, 3),
        "covariance": np.array([p.covariance for p in estimate.surface]).reshape(-1, 3, 3),
        "nearest": float(distance.min()),
        "contact": estimate.contact,
    }


def row(rig: Rig, own: list[Thing], gap: float, seed: int) -> dict[str, Any]:
    """Accuracy of the points in a window of each thing of a kind: of the nearest point of each, and of all."""
    scenes = [each for k, one in enumerate(own) if len((each := scene(rig, one, gap, seed, k))["found"])]
    out: dict[str, Any] = {"array": rig.name, "kind": own[0].kind, "gap_m": gap, "windows": len(own), "felt": len(scenes)}
    if not scenes:
        return out
    first = [int(s["found"].argmin()) for s in scenes]
    error = np.array([s["found"][i] - s["nearest"] for s, i in zip(scenes, first, strict=True)])
    along = np.array([s["along"][i] for s, i in zip(scenes, first, strict=True)])
    true, found, sigma, off, covariance = (
        np.concatenate([s[name] for s in scenes]) for name in ("true", "found", "along", "error", "covariance")
    )
    whole = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[:, :, None])[:, :, 0]) / 3.0
    return out | {
        "nearest_mm": round(1e3 * float(np.sqrt(np.mean(error**2))), 2),
        "nearest_bias_mm": round(1e3 * float(error.mean()), 2),
        "nearest_sigma_mm": round(1e3 * float(np.sqrt(np.mean(along**2))), 2),
        "nearest_nees": round(float(np.mean((error / along) ** 2)), 3),
        "points": len(found),
        "relative": round(float(np.sqrt(np.mean((found / true - 1.0) ** 2))), 4),
        "nees": round(float(np.mean(((found - true) / sigma) ** 2)), 3),
        "nees_position": round(float(whole.mean()), 3),
    }


def contact_row(rig: Rig, own: list[Thing], gap: float, seed: int) -> dict[str, Any]:
    """Share of the windows of things of a kind at a small gap that are called a touch."""
    called = [scene(rig, one, gap, seed, k)["contact"] for k, one in enumerate(own)]
    touch = called.count("touch") / len(own)
    return {"array": rig.name, "kind": own[0].kind, "gap_m": gap, "windows": len(own), "touch": round(touch, 3)}


def approach(rig: Rig, seed: int, k: int) -> dict[str, Any]:
    """A limb that comes from 5 cm to 3 mm, rests there for a second and leaves: steps and errors of the track's position [mm],
    and the gaps [mm] at which the touch begins and ends."""
    rng = np.random.default_rng([seed, 800, k])
    one = thing(rig, "limb", seed, k)
    T = placed(rig, one, CLOSE[0], rng)
    normal = rig.axes(T, 8)[2, :3]
    lifts = np.concatenate([np.linspace(0.047, 0.0, 17)[:-1], np.zeros(50), np.linspace(0.0, 0.047, 17)[1:]])
    known: dict[float, Array] = {}
    estimator = rig.estimator(rig.home, things.HOME_SPREAD)
    poses, true, contact = [], [], []
    for i, lift in enumerate(lifts):
        pose = T.copy()
        pose[:3, 3] += lift * normal
        key = round(float(lift), 6)
        if key not in known:
            known[key] = rig.signal(one.body, pose, 8)
        amplitude, samples, pressed = _window(rig, known[key], rng)
        found = estimator.update((i + 1) * 20_000_000, amplitude, samples, rig.pads, rig.joints, pressed=pressed)
        poses.append(estimator.pose[:3, 3])
        true.append(pose[:3, 3])
        contact.append(found.contact)
    error = np.linalg.norm(np.array(poses) - np.array(true), axis=1)
    steps = np.linalg.norm(np.diff(poses, axis=0) - np.diff(true, axis=0), axis=1)
    touched = np.flatnonzero(np.array(contact) != "none")
    resting = np.flatnonzero(lifts == 0.0)
    return {
        "array": rig.name,
        "step_before_mm": round(1e3 * float(steps[6 : resting[0] - 3].max()), 2),
        "step_touching_mm": round(1e3 * float(steps[resting[0] - 3 : resting[-1] + 3].max()), 2),
        "error_2cm_mm": round(1e3 * float(error[np.abs(lifts - 0.017).argmin()]), 2),
        "error_touching_mm": round(1e3 * float(np.sqrt(np.mean(error[resting] ** 2))), 2),
        "begins_mm": round(1e3 * float(CLOSE[0] + lifts[touched[0]]), 1) if len(touched) else None,
        "ends_mm": round(1e3 * float(CLOSE[0] + lifts[touched[-1]]), 1) if len(touched) else None,
        "without_touch": int((np.array(contact)[resting] == "none").sum()),
    }


def microseconds(rig: Rig, seed: int) -> float:
    """Median time [us] that computing the points of a window takes, with a limb before all pads."""
    rng = np.random.default_rng([seed, 900])
    one, points = thing(rig, "limb", seed, 0), rig.points
    signal = rig.signal(one.body, placed(rig, one, 0.03, rng), 8)
    variance, pressed, taken = rig.skin.noise / WINDOW, np.zeros(len(rig.skin), np.bool_), []
    for _ in range(200):
        began = time.perf_counter()
        points.find(signal, variance, pressed, rig.pads)
        taken.append(time.perf_counter() - began)
    return round(1e6 * float(np.median(taken)), 1)


def measure(rig: Rig, seed: int, count: int, progress: Progress) -> dict[str, Any]:
    """All rows of an array, `count` windows each."""
    task = progress.add_task(f"{rig.name}: surfaces", total=len(KINDS) * (len(GAPS) + len(CLOSE)))
    rows, contacts = [], []
    for kind in KINDS:
        own = [thing(rig, kind, seed, k) for k in range(count)]
        for gap in GAPS:
            rows.append(row(rig, own, gap, seed))
            progress.advance(task)
        for gap in CLOSE:
            contacts.append(contact_row(rig, own, gap, seed))
            progress.advance(task)
    approaches = [approach(rig, seed, k) for k in range(count)]
    progress.remove_task(task)
    return {"rows": rows, "contact": contacts, "approach": approaches, "us": microseconds(rig, seed)}


def tables(result: dict[str, Any]) -> list[Table | str]:
    """Distances, contact, and poses of limbs that touch."""
    parts, seed = result["surface"], result["seed"]
    low, high = NEES_BAND
    distances = Table(
        *("array", "thing", "gap cm", "felt", "nearest: RMSE mm", "bias", "sigma", "NEES"),
        *("all pads' points", "distance, relative", "NEES", "NEES of the position"),
        title=f"Points of surfaces, no shape assumed, single windows of {WINDOW} ms, seed {seed}",
        caption=f"NEES a degree of freedom; goal {low:g} to {high:g}. The floating bar is beyond what the statistics were "
        "measured on: things grounded as people are.",
    )
    contact = Table(
        *("array", "thing", *(f"{1e3 * gap:g} mm" for gap in CLOSE)), title="Share of single windows that are called a touch"
    )
    touching = Table(
        *("array", "largest step before mm", "while touching", "error at 2 cm mm", "while touching", "touch from mm", "to mm"),
        "windows at 3 mm without touch",
        title="Limbs that come from 5 cm to 3 mm, rest for 1 s and leave: the track's position",
    )
    for part in parts:
        for each in part["rows"]:
            head = [each["array"], each["kind"], f"{100 * each['gap_m']:g}", f"{each['felt']} of {each['windows']}"]
            if not each["felt"]:
                distances.add_row(*head)
                continue
            judged = (marked(f"{each[key]:.2f}", low <= each[key] <= high) for key in ("nearest_nees", "nees", "nees_position"))
            nearest, nees, position = judged
            numbers = (f"{each[key]:.1f}" for key in ("nearest_mm", "nearest_bias_mm", "nearest_sigma_mm"))
            distances.add_row(*head, *numbers, nearest, str(each["points"]), f"{each['relative']:.1%}", nees, position)
        for kind in KINDS:
            own = [f"{each['touch']:.0%}" for each in part["contact"] if each["kind"] == kind]
            contact.add_row(part["rows"][0]["array"], kind, *own)
        for each in part["approach"]:
            keys = ("step_before_mm", "step_touching_mm", "error_2cm_mm", "error_touching_mm", "begins_mm", "ends_mm")
            touching.add_row(each["array"], *(str(each[key]) for key in keys), str(each["without_touch"]))
    times = ", ".join(f"{part['rows'][0]['array']} {part['us']:g} us" for part in parts)
    return [distances, contact, touching, f"Time of the points of a window: {times}."]
