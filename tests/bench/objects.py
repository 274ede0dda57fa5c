"""`penumbra bench objects`: `search refine` on household objects, from bad starts and on masks as networks make them; with
--cases on photographs, and `search track` on films."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from rich.progress import track
from rich.table import Table
from scipy.spatial import cKDTree

from penumbra.services import flags
from penumbra.services.search.objects.meshes import ObjectFileError
from penumbra.services.search.objects.pose import RigidObject, find_pose
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.geometry import raster
from penumbra.shared.geometry.rigid import Array, apply, from_rpy, pose_error, transform
from penumbra.shared.perception.intrinsics import Intrinsics
from penumbra.tests.bench.lib import object_cases, results
from penumbra.tests.bench.lib.object_cases import CONVERGED, STARTS, SURE, moved
from penumbra.tests.bench.lib.results import Part, Result, marked

Bool = NDArray[np.bool_]

WIDTH, HEIGHT = 640, 480
K = Intrinsics(572.4, 573.6, 325.3, 242.0)
GOALS = {20.0: 0.97, 30.0: 0.85}
WRONG, RECOVERY = 0.01, 5
"""Goals: maximum share of poses that say "tracking" and are wrong, and maximum frames until a lost object is found again."""
MASKS = {"exact": (1.0, 1.0), "0.86": (0.83, 0.89)}
"""Range of the masks' IoU with the truth."""


# --- objects ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Thing:
    """A mesh in metres; `symmetries`: rotations (n, 3, 3) that leave its shape unchanged, including the identity."""

    name: str
    mesh: trimesh.Trimesh
    symmetries: Array

    @property
    def diameter(self) -> float:
        """Largest distance [m] between two of `points`."""
        points = self.points
        return float(np.linalg.norm(points[:, None] - points[None], axis=2).max())

    @property
    def points(self) -> Array:
        """Some 500 of its vertices (n, 3) [m]."""
        vertices = np.asarray(self.mesh.vertices, float)
        return vertices[:: max(1, len(vertices) // 500)]


def turn(axis: str, count: int) -> Array:
    """The rotations (count, 3, 3) about an axis by multiples of 1 / count of a turn."""
    return np.array([from_rpy((0, 0, 0), np.eye(3)["xyz".index(axis)] * a)[:3, :3] for a in _angles(count)])


def _angles(count: int) -> Array:
    return np.arange(count) * 2 * np.pi / count


def placed(mesh: trimesh.Trimesh, at: tuple[float, float, float], rpy: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    """A part turned by roll, pitch, yaw [deg], then moved to a place [mm]."""
    return mesh.apply_transform(from_rpy(at, np.radians(rpy)))


def tube(points: Array, radii: Array, segments: int = 24, along: Array | None = None) -> trimesh.Trimesh:
    """A closed tube along points (n, 3) with radii (n,) or (n, 2); its sections are perpendicular to `along` (3,)."""
    radii = np.broadcast_to(np.asarray(radii, float).reshape(len(points), -1), (len(points), 2))
    along = np.gradient(points, axis=0) if along is None else np.tile(along, (len(points), 1))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, np.where(np.abs(along[:, [0]]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(along, side)
    a = _angles(segments)[None, :, None]
    rings = (
        points[:, None] + radii[:, 0, None, None] * np.cos(a) * side[:, None] + radii[:, 1, None, None] * np.sin(a) * up[:, None]
    )
    n, i = len(points), np.arange(segments)
    j = (i + 1) % segments
    faces = [np.stack([np.full(segments, n * segments), j, i], 1)]
    for r in range(n - 1):
        b = r * segments
        faces += [np.stack([b + i, b + j, b + segments + i], 1), np.stack([b + j, b + segments + j, b + segments + i], 1)]
    faces.append(np.stack([np.full(segments, n * segments + 1), (n - 1) * segments + i, (n - 1) * segments + j], 1))
    return trimesh.Trimesh(np.vstack([rings.reshape(-1, 3), points[0], points[-1]]), np.concatenate(faces), process=False)


def joined(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh of several parts."""
    whole = trimesh.util.concatenate(parts)
    assert isinstance(whole, trimesh.Trimesh)
    return whole


def lathe(profile: Array, flat: float = 1.0, segments: int = 48) -> trimesh.Trimesh:
    """A body of revolution about z of a profile (n, 2) of radius and height; `flat`: ratio of its thin to its wide half axis."""
    r, z = np.asarray(profile, float).T
    return tube(np.stack([0 * z, 0 * z, z], 1), np.stack([r, r * flat], 1), segments, np.array([0.0, 0.0, 1.0]))


def drill() -> trimesh.Trimesh:
    return joined(
        [
            tube(np.array([[x, 0, 0] for x in (-75, -70, -20, 40, 62, 70)], float), np.array([22, 28, 30, 28, 24, 20])),
            tube(np.array([[x, 0, 0] for x in (68, 75, 95, 112, 114)], float), np.array([14, 18, 17, 9, 3])),
            tube(
                np.array([[-25, 0, -15], [-30, 0, -60], [-38, 0, -105], [-42, 0, -125]], float),
                np.array([[16, 20], [15, 18], [15, 19], [17, 22]]),
            ),
            placed(trimesh.creation.box((105, 62, 38)), (-32, 0, -140)),
            placed(trimesh.creation.box((14, 14, 30)), (2, 0, -38), (0, 20, 0)),
        ]
    )


def mug() -> trimesh.Trimesh:
    cup = lathe(np.array([[0.1, -46], [38, -47], [41, -44], [41, 40], [41, 47], [37, 47], [37, -42], [0.1, -43]]))
    a = np.linspace(-1.35, 1.35, 24)
    return joined([cup, tube(np.stack([39 + 32 * np.cos(a), 0 * a, 30 * np.sin(a)], 1), np.full((24, 2), [5, 8]), 16)])


def spray_bottle() -> trimesh.Trimesh:
    body = lathe(
        np.array([[0.1, -100], [40, -99], [43, -90], [43, 0], [38, 40], [22, 75], [14, 90], [14, 105], [0.1, 105.5]]), 0.65
    )
    return joined(
        [
            body,
            placed(trimesh.creation.box((78, 24, 26)), (14, 0, 118)),
            tube(np.array([[52, 0, 120], [66, 0, 121], [67, 0, 121]], float), np.array([8, 7, 1])),
            tube(np.array([[38, 0, 108], [42, 0, 90], [36, 0, 66]], float), np.array([[8, 5], [8, 4], [7, 3]]), 12),
        ]
    )


def duck() -> trimesh.Trimesh:
    def ball(x: float, y: float, z: float, *half: float) -> trimesh.Trimesh:
        return placed(trimesh.creation.icosphere(4).apply_scale(half), (x, y, z))

    return joined(
        [
            ball(0, 0, 0, 52, 40, 34),
            ball(34, 0, 46, 28, 26, 27),
            placed(trimesh.creation.icosphere(3).apply_scale((18, 13, 6)), (64, 0, 42)),
            placed(trimesh.creation.icosphere(3).apply_scale((26, 20, 9)), (-46, 0, 18), (0, 35, 0)),
            ball(-6, 36, 6, 28, 10, 17),
            ball(-6, -36, 6, 28, 10, 17),
        ]
    )


def scissors() -> trimesh.Trimesh:
    a = np.append(_angles(32), 0)
    parts = []
    for side in (-1, 1):
        parts.append(placed(trimesh.creation.box((105, 11, 3)), (50, -side * 9, side * 1.6), (0, 0, -side * 11)))
        parts.append(tube(np.array([[0, side * 0, side * 1.6], [-30, side * 9, 0]], float), np.array([6, 5]), 12))
        size = (26 if side > 0 else 32, 17)
        parts.append(
            tube(np.stack([-55 + size[0] * np.cos(a), side * 19 + size[1] * np.sin(a), 0 * a], 1), np.full((33, 2), [4.5, 5]), 12)
        )
    return joined(parts)


def mustard_bottle() -> trimesh.Trimesh:
    profile = [
        [0.1, -90],
        [44, -90],
        [47, -84],
        [46, -40],
        [42, 10],
        [43, 45],
        [34, 66],
        [16, 72],
        [15, 84],
        [7, 88],
        [5, 103],
        [0.1, 104],
    ]
    return lathe(np.array(profile), 0.62)


def banana() -> trimesh.Trimesh:
    a = np.linspace(-0.95, 0.95, 40)
    radius = 18 * np.sqrt(np.clip(1 - (a / 1.0) ** 4, 0.03, 1)) * np.where(a > 0.75, 0.55, 1.0)
    return tube(np.stack([105 * np.sin(a), 0 * a, 105 * (1 - np.cos(a))], 1), radius, 20)


def pitcher() -> trimesh.Trimesh:
    body = lathe(
        np.array([[0.1, -110], [50, -110], [54, -100], [60, 60], [66, 118], [62, 118], [56, 60], [50, -104], [0.1, -104]])
    )
    a = np.linspace(-1.4, 1.4, 24)
    return joined(
        [
            body,
            tube(np.stack([-52 - 48 * np.cos(a), 0 * a, 10 + 75 * np.sin(a)], 1), np.full((24, 2), [8, 11]), 16),
            placed(trimesh.creation.box((30, 26, 30)), (62, 0, 104), (0, 40, 0)),
        ]
    )


def worn(mesh: trimesh.Trimesh, faces: int, rng: np.random.Generator, kind: str) -> trimesh.Trimesh:
    """The mesh [m] with at least `faces` triangles and, by `kind`, the roughness of a scan or a defect of mesh files."""
    edge = 2.8 * np.sqrt(mesh.area / faces)
    vertices, triangles = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, edge, max_iter=20)
    if kind == "rough":
        wave = rng.normal(0.0, 0.5, (3, 12))  # about a centimetre long
        vertices = vertices + 0.15 * np.sin(vertices @ wave + rng.uniform(0, 6, 12)) @ rng.normal(size=(12, 3))
    if kind == "holes":
        triangles = triangles[rng.random(len(triangles)) > 0.03]
    if kind == "flipped":
        flip = rng.random(len(triangles)) < 0.3
        triangles = np.where(flip[:, None], triangles[:, ::-1], triangles)
    if kind == "soup":
        vertices, triangles = vertices[triangles].reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)
    return trimesh.Trimesh(vertices / 1000.0, triangles, process=False)


_ONE = np.eye(3)[None]
_AROUND_Z = turn("z", 72)
_BOX = np.concatenate([_ONE, turn("x", 2)[1:], turn("y", 2)[1:], turn("z", 2)[1:]])
MAKERS: dict[str, tuple[Callable[[], trimesh.Trimesh], int, str, Array]] = {
    "drill": (drill, 40_000, "rough", _ONE),
    "mug": (mug, 16_000, "holes", _ONE),
    "spray bottle": (spray_bottle, 20_000, "flipped", _ONE),
    "duck": (duck, 15_000, "rough", _ONE),
    "scissors": (scissors, 5_000, "soup", _ONE),
    "mustard bottle": (mustard_bottle, 30_000, "rough", turn("z", 2)),
    "banana": (banana, 6_000, "holes", _ONE),
    "pitcher": (pitcher, 60_000, "soup", _ONE),
    "cracker box": (lambda: trimesh.creation.box((60, 158, 210)), 12_000, "flipped", _BOX),
    "soup can": (
        lambda: trimesh.creation.cylinder(33.0, 102.0, sections=48),
        8_000,
        "rough",
        np.concatenate([_AROUND_Z, _AROUND_Z @ turn("x", 2)[1]]),
    ),
}


def thing(name: str, seed: int) -> Thing:
    maker, faces, kind, symmetries = MAKERS[name]
    return Thing(name, worn(maker(), faces, np.random.default_rng(seed), kind), symmetries)


# --- masks ------------------------------------------------------------------------------------------------------------------


def iou(a: Bool, b: Bool) -> float:
    return int(np.count_nonzero(a & b)) / max(int(np.count_nonzero(a | b)), 1)


def spoiled(truth: Bool, wanted: float, rng: np.random.Generator) -> Bool:
    """A mask (h, w) with an IoU of about `wanted` with the truth, with the errors of instance segmentation: its boundary wobbles
    and is smoothed, the whole is shifted and too large or small, and at times a thin part is missing, something is bitten out or
    added, or it has a hole."""
    size = float(np.sqrt(np.count_nonzero(truth)))
    inside = truth.astype(np.uint8)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    wobble = sum(a * _noise(truth.shape, s, rng) for a, s in ((2.0, 4.0), (2.5, 10.0), (1.5, 25.0)))
    bias, shift, smoothing = rng.normal(0.0, 1.0), rng.normal(0.0, 1.2, 2), rng.uniform(0.0, 4.0)
    thin, bite, blob, hole = rng.random(4) < (0.3, 0.35, 0.35, 0.2)
    edge = np.argwhere(np.abs(distance) < 1.5)
    at = {kind: edge[rng.integers(len(edge))][::-1] for kind in ("bite", "blob")}
    middle = np.argwhere(distance > 0.5 * distance.max())
    at["hole"] = middle[rng.integers(len(middle))][::-1]
    radius = {"bite": rng.uniform(0.1, 0.3) * size, "blob": rng.uniform(0.1, 0.25) * size, "hole": rng.uniform(0.05, 0.15) * size}
    rows, columns = np.mgrid[: truth.shape[0], : truth.shape[1]]

    def made(s: float) -> Bool:
        mask: NDArray[Any] = distance + s * (wobble + bias) > 0
        if thin:
            r = int(round(7 * s))
            mask = (
                cv2.morphologyEx(
                    mask.astype(np.uint8), cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * r + 1,) * 2)
                )
                > 0
            )
        mask = cv2.warpAffine(
            mask.astype(np.float32), np.array([[1, 0, s * shift[0]], [0, 1, s * shift[1]]], float), truth.shape[::-1]
        )
        mask = cv2.GaussianBlur(mask, (0, 0), 0.3 + s * smoothing) > 0.5
        for kind, wanted_too in (("bite", bite), ("blob", blob), ("hole", hole)):
            if wanted_too:
                disc = np.hypot(columns - at[kind][0], rows - at[kind][1]) < s * radius[kind]
                mask = mask | disc if kind == "blob" else mask & ~disc
        return mask

    low, high = 0.0, 3.0
    for _ in range(12):
        middle_s = (low + high) / 2
        low, high = (low, middle_s) if iou(made(middle_s), truth) < wanted else (middle_s, high)
    return made(low)


def _noise(shape: tuple[int, int], sigma: float, rng: np.random.Generator) -> Array:
    """Smooth noise (h, w) of unit standard deviation."""
    small = cv2.GaussianBlur(rng.normal(size=(shape[0] // 2, shape[1] // 2)), (0, 0), sigma / 2)
    return cv2.resize(small / small.std(), shape[::-1], interpolation=cv2.INTER_LINEAR)


# --- measurement ------------------------------------------------------------------------------------------------------------


def drawn_pose(rng: np.random.Generator) -> Array:
    """T_camera_object of an object in the picture, 0.6 to 1.2 m away, in any orientation."""
    z = rng.uniform(0.6, 1.2)
    centre = (rng.uniform(0.3, 0.7) * WIDTH, rng.uniform(0.3, 0.7) * HEIGHT)
    q = rng.normal(size=4)
    return transform(((centre[0] - K.cx) / K.fx * z, (centre[1] - K.cy) / K.fy * z, z), q / np.linalg.norm(q))


@dataclass(frozen=True)
class Errors:
    """`add`: share of the diameter; `rotation` [rad] modulo the object's symmetry; `position` (3,) [m]; `nearest` true pose."""

    add: float
    rotation: float
    position: Array
    nearest: Array


def errors(one: Thing, T: Array, T_true: Array) -> Errors:
    turns = np.tile(np.eye(4), (len(one.symmetries), 1, 1))
    turns[:, :3, :3] = one.symmetries
    candidates = T_true @ turns
    angles = [np.linalg.norm(pose_error(candidate, T)[3:]) for candidate in candidates]
    nearest = candidates[int(np.argmin(angles))]
    found, true = apply(T, one.points), apply(T_true, one.points)
    distance = cKDTree(true).query(found)[0] if len(turns) > 1 else np.linalg.norm(found - true, axis=1)
    return Errors(float(distance.mean()) / one.diameter, float(min(angles)), T[:3, 3] - T_true[:3, 3], nearest)


def scene(one: Thing, seed: tuple[int, ...], wanted: tuple[float, float]) -> tuple[Array, Bool]:
    """A pose T_camera_object and a mask (HEIGHT, WIDTH) of it."""
    rng = np.random.default_rng(seed)
    T = drawn_pose(rng)
    vertices, faces = np.asarray(one.mesh.vertices, float), np.ascontiguousarray(one.mesh.faces, np.int32)
    truth = raster.silhouette(apply(T, vertices), faces, (K.fx, K.fy, K.cx, K.cy), (0, 0, WIDTH, HEIGHT))
    share = rng.uniform(*wanted)
    return T, truth if share >= 1.0 else spoiled(truth, share, rng)


def measure(name: str, seed: int, count: int) -> list[dict[str, Any]]:
    """The rows of one object: its share converged and its errors by mask and start."""
    one = thing(name, seed)
    faces = np.asarray(one.mesh.faces, np.int32)
    rigid = RigidObject(Mesh(np.asarray(one.mesh.vertices, np.float64), faces, np.zeros(len(faces), np.uint8)))
    rows, index = [], list(MAKERS).index(name)
    for mask_name, wanted in MASKS.items():
        scenes = [scene(one, (seed, index, i), wanted) for i in range(count)]
        for degrees, metres in STARTS:
            found = []
            for i, (T_true, mask) in enumerate(scenes):
                start = moved(T_true, degrees, metres, np.random.default_rng((seed, index, i, int(degrees))))
                begun = time.perf_counter()
                result = find_pose(rigid, mask, K, start)
                ms = (time.perf_counter() - begun) * 1e3
                error = errors(one, result.T, T_true)
                e = pose_error(error.nearest, result.T)
                nees, centimetres = float(e @ np.linalg.solve(result.covariance, e)), np.linalg.norm(e[:3]) * 100
                found.append((error.add, np.degrees(error.rotation), centimetres, nees, result.state in SURE, ms))
            add, rotation, position, nees_all, sure, ms_all = np.array(found, float).T
            rows.append(
                {
                    "object": name,
                    "faces": len(faces),
                    "mask_iou": mask_name,
                    "start_deg": degrees,
                    "start_cm": metres * 100,
                    "starts": count,
                    "goal": GOALS[degrees],
                    "converged": round(float((add < CONVERGED).mean()), 3),
                    "within_10_deg": round(float((rotation < 10.0).mean()), 3),
                    "add_median": round(float(np.median(add)), 4),
                    "rotation_deg_median": round(float(np.median(rotation)), 2),
                    "position_cm_median": round(float(np.median(position)), 2),
                    "within_5_cm": round(float((position < 5.0).mean()), 3),
                    "nees_median": round(float(np.median(nees_all)), 2),
                    "nees_mean": round(float(np.mean(nees_all)), 2),
                    "wrong_but_tracking": round(float(((add >= CONVERGED) & (sure == 1)).mean()), 3),
                    "ms_median": round(float(np.median(ms_all)), 1),
                }
            )
    return rows


def tables(result: Result) -> list[Part]:
    """A row for each object, mask and start, and for all objects; of photographs a row for each case, and for all."""
    if "cases" in result:
        return [_cases_table(result), _sequences_table(result)]
    title = f"search refine, seed {result['seed']}: share converged (ADD below {CONVERGED:.0%} of the diameter), median errors"
    table = Table("object", "mask", "start", "converged", "goal", "< 10 deg", "ADD", "deg", "cm", "NEES", "ms", title=title)
    keys = ("within_10_deg", "add_median", "rotation_deg_median", "position_cm_median", "nees_median")
    for row in result["rows"]:
        start = f"{row['start_deg']:.0f}°, {row['start_cm']:.0f} cm"
        converged = marked(f"{row['converged']:.2f}", row["converged"] >= row["goal"])
        numbers = [f"{row[key]:.2f}" for key in keys]
        table.add_row(
            row["object"], row["mask_iou"], start, converged, f">= {row['goal']:.2f}", *numbers, f"{row['ms_median']:.0f}"
        )
    return [table]


def averages(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of all objects together."""
    keys = [key for key, value in rows[0].items() if isinstance(value, float) and key not in ("start_deg", "start_cm")]
    out = []
    for mask in MASKS:
        for degrees, metres in STARTS:
            some = [row for row in rows if row["mask_iou"] == mask and row["start_deg"] == degrees]
            mean = {key: round(float(np.mean([row[key] for row in some])), 3) for key in keys}
            out.append({"object": "all", "faces": 0, "mask_iou": mask, "start_deg": degrees, "start_cm": metres * 100, **mean})
    return out


def _cases_table(result: Result) -> Table:
    title = f"search refine on photographs, seed {result['seed']}: shares of {result['starts']} starts, median error"
    table = Table("case", "with", "start", "converged", "goal", "tracking", "wrong but tracking", "error", "ms", title=title)
    for row in [*result["cases"], *overall(result["cases"])]:
        goal = GOALS[row["start"][0]]
        table.add_row(
            row["name"],
            row["with"],
            f"{row['start'][0]:.0f}°, {row['start'][1] * 100:.0f} cm",
            marked(f"{row['converged']:.2f}", row["converged"] >= goal),
            f">= {goal:.2f}",
            f"{row['tracking']:.2f}",
            marked(f"{row['wrong_but_tracking']:.3f}", row["wrong_but_tracking"] <= WRONG),
            f"{row['error_of_diameter']:.3f}",
            f"{row['ms']:.0f}",
        )
    return table


def _sequences_table(result: Result) -> Table:
    title = f"search track on films, picture alone, seed {result['seed']}"
    table = Table("sequence", "frames", "right", "wrong but tracking", "frames to recover", "ms", "median ms", title=title)
    for row in result["sequences"]:
        wrong = marked(f"{row['wrong_but_tracking']:.3f}", row["wrong_but_tracking"] <= WRONG)
        recovery = marked(str(row["recovery_frames"]), row["recovery_frames"] <= RECOVERY)
        times = f"{row['ms']:.0f}", f"{row['ms_median']:.0f}"
        table.add_row(row["name"], str(row["frames"]), f"{row['right']:.2f}", wrong, recovery, *times)
    return table


def overall(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The means of the rows of all cases, by input and start."""
    out = []
    for given, start in dict.fromkeys((row["with"], tuple(row["start"])) for row in rows):
        some = [row for row in rows if row["with"] == given and tuple(row["start"]) == start]
        keys = [key for key, value in some[0].items() if isinstance(value, float)]
        mean = {key: round(float(np.mean([row[key] for row in some])), 4) for key in keys}
        out.append({"name": "all", "with": given, "start": list(start), **mean})
    return out


@results.benchmark(
    "objects",
    __doc__ or "",
    tables,
    flags.Option("--seed", type=int, default=1, help="draws poses, masks and starts"),
    flags.Option("--starts", type=flags.positive, default=30, help="of each object, mask and distance"),
    flags.Option("--objects", choices=MAKERS, takes="many", default=list(MAKERS), metavar="NAME", help=", ".join(MAKERS)),
    flags.Option("--cases", type=Path, metavar="FOLDER", help="photographs with true poses, a folder each: see object_cases.py"),
    example="penumbra bench objects --json objects.json",
)
def main(options: flags.Options, report: results.Report) -> int | None:
    if options.cases is not None:
        return _main_cases(options, report)
    rows: list[dict[str, Any]] = []
    for name in track(options.objects, description="objects", disable=not sys.stderr.isatty()):
        rows += measure(name, options.seed, options.starts)
    rows += averages(rows)
    report.save({"seed": options.seed, "rows": rows})
    return None


def _main_cases(options: flags.Options, report: results.Report) -> int | None:
    try:
        found = object_cases.cases(options.cases)
    except ObjectFileError as error:
        print(f"penumbra bench objects: {error}", file=sys.stderr)
        return 2
    rows: list[dict[str, Any]] = []
    sequences: list[dict[str, Any]] = []
    for case in track(found, description="cases", disable=not sys.stderr.isatty()):
        rows += object_cases.refined(case, options.seed, options.starts)
        if case.frames:
            sequences.append(object_cases.tracked(case, options.seed, options.starts))
        report.save({"seed": options.seed, "starts": options.starts, "cases": rows, "sequences": sequences})
    return None


if __name__ == "__main__":
    raise SystemExit(main())
