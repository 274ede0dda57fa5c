"""`penumbra search refine` and `penumbra search track`: any rigid mesh on any masks, from files to files."""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.progress import track as progress

from services.flags import Parser
from services.search.contour import NEAR
from services.search.evidence import Intrinsics
from services.search.objects import meshes, pose
from services.search.objects.meshes import ObjectFileError
from services.search.objects.pose import ObjectEstimate, RigidObject, Tracker
from shared.geometry import rigid as geometry
from shared.geometry.rigid import Array

Bool = NDArray[np.bool_]

PICTURES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
CAMERA = ("width", "height", "fx", "fy", "cx", "cy")
VIEW = (0.15, 60.0)
"""Focal lengths that are believed, in widths of the image: 147 degrees to 1 degree."""
RIGID = 1e-2
"""A rotation matrix's largest error that is taken for rounding."""
FURTHEST = 100.0
"""A start further away than this [m] is in other units."""
TIMES = 5.0
"""A start whose silhouette is so many times as large or as small as the mask has a wrong unit, camera or pose."""
COLOURS = {"tracking": (80, 220, 80), "occluded": (60, 180, 250), "lost": (60, 60, 230)}
"""Blue, green, red of a contour in the video."""
FIELDS = (
    "frame",
    "state",
    "overlap",
    "x",
    "y",
    "z",
    "qx",
    "qy",
    "qz",
    "qw",
    *(f"sigma_{name}" for name in ("x", "y", "z", "rx", "ry", "rz")),
)


def refine(argv: list[str]) -> int:
    """One pose on one mask: 0, whatever its state, or 2 for input that is wrong."""
    return _told("refine", _refine, argv)


def track(argv: list[str]) -> int:
    """The poses of a sequence of masks, as a table and a video; the exit code as of `refine`."""
    return _told("track", _track, argv)


def _told(name: str, run: Callable[[list[str]], None], argv: list[str]) -> int:
    try:
        run(argv)
    except ObjectFileError as error:
        print(f"penumbra search {name}: {error}", file=sys.stderr)
        return 2
    return 0


def _refine(argv: list[str]) -> None:
    parser = _parser("refine", "Refines one pose of a rigid mesh on one mask.")
    parser.add_argument("--mask", type=Path, required=True, metavar="PNG", help="not black where the object is seen")
    parser.add_argument("--image", type=Path, metavar="PNG", help="the image that the mask is of: the pose is refined on it")
    parser.add_argument("--occluder", type=Path, metavar="PNG", help="not black where something stands in front of the object")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    rigid, (k, shape), T = _given(options)
    mask = read_mask(options.mask, shape)
    occluder = None if options.occluder is None else read_mask(options.occluder, shape)
    if not mask.any():
        raise ObjectFileError(f"{options.mask}: pixels that show the object expected (not black), all are black")
    check_mask(mask, options.mask)
    check_start(rigid, T, k, mask, occluder, options.init)
    picture = None if options.image is None else read_picture(options.image, shape)
    found = pose.find_pose(rigid, mask, k, T, occluder, picture, options.spread)
    print(json.dumps(as_json(found)) if options.json else as_text(found))


def _track(argv: list[str]) -> None:
    parser = _parser("track", "Tracks a rigid mesh through a sequence of masks.")
    parser.add_argument(
        "--masks", type=Path, required=True, metavar="FOLDER", help="one mask a frame, in the order of their names"
    )
    parser.add_argument("--images", type=Path, metavar="FOLDER", help="the images, of the same names")
    parser.add_argument("--occluders", type=Path, metavar="FOLDER", help="masks of what stands in front, of the same names")
    parser.add_argument("--fps", type=float, default=30.0, help="frames a second of masks and video (default: 30)")
    parser.add_argument(
        "--out", type=Path, default=Path("track"), metavar="FOLDER", help="for poses.csv and overlay.mp4 (default: track)"
    )
    options = parser.parse_args(argv)
    if not options.fps > 0:
        raise ObjectFileError(f"--fps: a number above 0 expected, {options.fps:g} came")
    rigid, (k, shape), T = _given(options)
    names = frames(options.masks)
    images = None if options.images is None else beside(names, options.images)
    occluders = None if options.occluders is None else beside(names, options.occluders)
    options.out.mkdir(parents=True, exist_ok=True)
    tracker = Tracker(rigid, k, T, 1.0 / options.fps, options.spread)
    video = cv2.VideoWriter(str(options.out / "overlay.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), options.fps, shape[::-1])
    counts = dict.fromkeys(COLOURS, 0)
    try:
        with (options.out / "poses.csv").open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(FIELDS)
            for i, name in enumerate(progress(names, description="frames", disable=not sys.stderr.isatty())):
                mask = read_mask(name, shape)
                occluder = None if occluders is None else read_mask(occluders[i], shape)
                picture = None if images is None else read_picture(images[i], shape)
                if i == 0 and mask.any():
                    check_mask(mask, name)
                    check_start(rigid, T, k, mask, occluder, options.init)
                found = tracker.update(mask, occluder, picture)
                counts[found.state] += 1
                table.writerow(row(name.name, found))
                video.write(overlay(rigid, found, k, mask, picture))
    finally:
        video.release()
    print(f"{len(names)} frames: " + ", ".join(f"{n} {state}" for state, n in counts.items()) + f"; see {options.out}")


def _parser(name: str, about: str) -> argparse.ArgumentParser:
    parser = Parser(prog=f"penumbra search {name}", description=about)
    parser.add_argument("--mesh", type=Path, required=True, metavar="FILE", help="PLY, STL, OBJ, GLB or OFF")
    parser.add_argument("--mesh-unit", choices=meshes.UNITS, default="m", help="of the mesh file's coordinates (default: m)")
    parser.add_argument("--camera", type=Path, required=True, metavar="JSON", help=", ".join(CAMERA))
    parser.add_argument("--init", type=Path, required=True, metavar="JSON", help="camera_from_object: 4 x 4, metres")
    metres, turn = pose.START
    parser.add_argument(
        "--init-sigma", type=float, nargs=2, default=(metres, math.degrees(turn)), metavar=("M", "DEG"),
        help=f"how well the start is known along and about each axis (default: {metres} {math.degrees(turn):.0f})",
    )  # fmt: skip
    return parser


def _given(options: argparse.Namespace) -> tuple[RigidObject, tuple[Intrinsics, tuple[int, int]], Array]:
    """What both commands need: object, camera with the image's shape, start."""
    metres, degrees = options.init_sigma
    if not (0 < metres < 10 and 0 < degrees < 360):
        raise ObjectFileError(f"--init-sigma: metres and degrees above 0 expected, {metres:g} and {degrees:g} came")
    options.spread = metres, math.radians(degrees)
    camera, T = read_camera(options.camera), read_pose(options.init)
    try:
        return RigidObject(meshes.load(options.mesh, options.mesh_unit)), camera, T
    except ObjectFileError as error:
        raise ObjectFileError(str(error) if str(options.mesh) in str(error) else f"{options.mesh}: {error}") from None


# --- files ------------------------------------------------------------------------------------------------------------------


def _json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text())
    except OSError as error:
        raise ObjectFileError(f"{path}: a readable JSON file expected: {error.strerror}") from None
    except ValueError as error:
        raise ObjectFileError(f"{path}: JSON expected: {error}") from None
    if not isinstance(value, dict):
        raise ObjectFileError(f"{path}: a JSON object expected, {type(value).__name__} came")
    return value


def read_camera(path: Path) -> tuple[Intrinsics, tuple[int, int]]:
    """Intrinsics and (height, width) of a camera file. Raises ObjectFileError."""
    value = _json(path)
    missing = [name for name in CAMERA if name not in value]
    if missing:
        raise ObjectFileError(f"{path}: the keys {', '.join(CAMERA)} expected, {', '.join(missing)} missing")
    for name in CAMERA:
        number = value[name]
        if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
            raise ObjectFileError(f"{path}: {name}: a finite number expected, {number!r} came")
    w, h = value["width"], value["height"]
    if w != int(w) or h != int(h) or not (16 <= w <= 16384 and 16 <= h <= 16384):
        raise ObjectFileError(f"{path}: width and height of 16 to 16384 whole pixels expected, {w} x {h} came")
    for name in ("fx", "fy"):
        if not VIEW[0] * w <= value[name] <= VIEW[1] * w:
            raise ObjectFileError(
                f"{path}: {name}: a focal length of {VIEW[0] * w:.0f} to {VIEW[1] * w:.0f} pixels expected for an image "
                f"{w} wide, {value[name]:g} came: is it in millimetres, or of another image size?"
            )
    if not 0.5 < value["fx"] / value["fy"] < 2.0:
        raise ObjectFileError(f"{path}: fx and fy of nearly the same size expected, {value['fx']:g} and {value['fy']:g} came")
    for name, size in (("cx", w), ("cy", h)):
        if not -0.25 * size <= value[name] <= 1.25 * size:
            raise ObjectFileError(
                f"{path}: {name}: a principal point in or near the image ({size} pixels) expected, {value[name]:g} came: "
                "do width and height belong to these intrinsics?"
            )
    return Intrinsics(*(float(value[name]) for name in CAMERA[2:])), (int(h), int(w))


def read_pose(path: Path) -> Array:
    """T_camera_object of a pose file. Raises ObjectFileError."""
    value = _json(path)
    if "camera_from_object" not in value:
        raise ObjectFileError(f"{path}: the key camera_from_object expected, {', '.join(value) or 'no key'} came")
    try:
        T = np.array(value["camera_from_object"], dtype=np.float64)
    except (ValueError, TypeError):
        T = np.empty(0)
    if T.shape != (4, 4):
        raise ObjectFileError(f"{path}: camera_from_object: 4 rows of 4 numbers expected, a shape of {T.shape} came")
    if not np.isfinite(T).all():
        raise ObjectFileError(f"{path}: camera_from_object: finite numbers expected, some are not")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > RIGID or np.linalg.det(R) < 0 or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ObjectFileError(
            f"{path}: camera_from_object: a rotation without scale or mirror image, a translation and the last row 0 0 0 1 "
            f"expected, a determinant of {np.linalg.det(R):.3g} and the last row {' '.join(f'{v:g}' for v in T[3])} came"
        )
    u, _, vt = np.linalg.svd(R)
    T[:3, :3] = u @ vt
    distance = float(np.linalg.norm(T[:3, 3]))
    if distance > FURTHEST:
        raise ObjectFileError(
            f"{path}: camera_from_object in metres expected, this object is {distance:.4g} m away: is it in millimetres?"
        )
    return T


def _image(path: Path, shape: tuple[int, int], flags: int) -> NDArray[np.uint8]:
    if not path.is_file():
        raise ObjectFileError(f"{path}: an image file expected, there is none")
    image = cv2.imdecode(np.frombuffer(path.read_bytes() or b"\0", np.uint8), flags)
    if image is None:
        raise ObjectFileError(f"{path}: an image that OpenCV reads expected (PNG, JPEG ...), this is none")
    if image.shape[:2] != shape:
        raise ObjectFileError(
            f"{path}: an image of {shape[1]} x {shape[0]} expected, as the camera's file says, "
            f"{image.shape[1]} x {image.shape[0]} came"
        )
    return np.asarray(image)


def read_mask(path: Path, shape: tuple[int, int]) -> Bool:
    """The pixels (h, w) of a mask file that are brighter than half of its brightest; none where all are 0. Raises
    ObjectFileError."""
    image = _image(path, shape, cv2.IMREAD_UNCHANGED)
    if image.ndim == 3:
        alpha = image[..., 3:]
        image = image[..., :3].max(axis=2)
        if alpha.size and image.min() == image.max():  # only the alpha channel tells
            image = alpha[..., 0]
    return np.asarray(image > image.max() / 2.0)


def read_picture(path: Path, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """An image (h, w, 3) uint8 RGB. Raises ObjectFileError."""
    return np.ascontiguousarray(_image(path, shape, cv2.IMREAD_COLOR)[..., ::-1])


def frames(folder: Path) -> list[Path]:
    """The image files of a folder in the order of their names, numbers in names by their value. Raises ObjectFileError."""
    if not folder.is_dir():
        raise ObjectFileError(f"{folder}: a folder of masks expected, there is none")
    found = sorted((p for p in folder.iterdir() if p.suffix.lower() in PICTURES), key=lambda p: _order(p.stem))
    if not found:
        raise ObjectFileError(f"{folder}: a folder of images expected ({', '.join(sorted(PICTURES))}), it has none")
    return found


def _order(name: str) -> tuple[tuple[int, str], ...]:
    parts, digits = [], ""
    for letter in [*name, ""]:
        if letter.isdigit():
            digits += letter
            continue
        if digits:
            parts.append((int(digits), ""))
            digits = ""
        parts.append((-1, letter))
    return tuple(parts)


def beside(names: list[Path], folder: Path) -> list[Path]:
    """The files of a folder that have the same names as these, whatever their suffix. Raises ObjectFileError."""
    by_stem = {path.stem: path for path in frames(folder)}
    missing = [path.stem for path in names if path.stem not in by_stem]
    if missing:
        raise ObjectFileError(
            f"{folder}: an image for every mask expected, by name, {len(missing)} of {len(names)} are missing, first {missing[0]}"
        )
    return [by_stem[path.stem] for path in names]


# --- checks -----------------------------------------------------------------------------------------------------------------


def check_mask(mask: Bool, path: Path) -> None:
    """Raises ObjectFileError for a mask (h, w) that cannot be one object's."""
    share = float(mask.mean())
    if share > 0.95:
        raise ObjectFileError(
            f"{path}: the object and its surroundings expected, {share:.0%} of the mask is set: is it inverted?"
        )


def check_start(rigid: RigidObject, T: Array, k: Intrinsics, mask: Bool, occluder: Bool | None, path: Path) -> None:
    """Raises ObjectFileError for a start T_camera_object from which the mask cannot be reached."""
    V = rigid.shape.fine.in_camera(T @ rigid.T_object_middle)
    if V[:, 2].min() < NEAR:
        z = (T @ rigid.T_object_middle)[2, 3]
        raise ObjectFileError(
            f"{path}: camera_from_object: the whole object at least {NEAR} m in front of the camera expected (z > 0), its "
            f"middle is at z = {z:.3g} m and it is {rigid.diameter:.3g} m long: is this object_from_camera, or the mesh's unit "
            "another?"
        )
    u, v = k.fx * V[:, 0] / V[:, 2] + k.cx, k.fy * V[:, 1] / V[:, 2] + k.cy
    h, w = mask.shape
    if u.max() < -w or u.min() > 2 * w or v.max() < -h or v.min() > 2 * h:
        raise ObjectFileError(
            f"{path}: camera_from_object: an object in or near the image ({w} x {h}) expected, this one is at pixel "
            f"({u.mean():.0f}, {v.mean():.0f}): do pose and camera belong together?"
        )
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    seen = math.hypot(rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1)
    expected = math.hypot(float(np.ptp(u)), float(np.ptp(v)))
    hidden = occluder is not None or rows[0] == 0 or columns[0] == 0 or rows[-1] == h - 1 or columns[-1] == w - 1
    if seen > TIMES * expected or (expected > TIMES * seen and not hidden):
        raise ObjectFileError(
            f"{path}: a start whose silhouette is about as large as the mask ({seen:.0f} pixels) expected, it is {expected:.0f} "
            f"pixels large, for a mesh of {rigid.diameter:.3g} m: check --mesh-unit, the focal length and the start's distance"
        )


# --- results ----------------------------------------------------------------------------------------------------------------


def as_json(found: ObjectEstimate) -> dict[str, Any]:
    """The result as the command prints it."""
    return {
        "camera_from_object": found.T.tolist(),
        "covariance": found.covariance.tolist(),
        "overlap": round(found.overlap, 4),
        "state": found.state,
    }


def as_text(found: ObjectEstimate) -> str:
    """The result in words."""
    position, q = geometry.position_orientation(found.T)
    sigma = np.sqrt(np.diag(found.covariance))
    return "\n".join(
        [
            f"state      {found.state}, overlap {found.overlap:.3f}",
            "position   " + "  ".join(f"{p:.4f} ± {s:.4f}" for p, s in zip(position, sigma[:3], strict=True)) + " m",
            f"quaternion {'  '.join(f'{value:.5f}' for value in q)} (x, y, z, w)",
            "rotation ± " + "  ".join(f"{math.degrees(s):.2f}" for s in sigma[3:]) + " deg about the camera's axes",
        ]
    )


def row(name: str, found: ObjectEstimate) -> list[Any]:
    """A line of the table: FIELDS."""
    position, q = geometry.position_orientation(found.T)
    sigma = np.sqrt(np.diag(found.covariance))
    return [name, found.state, f"{found.overlap:.4f}", *(f"{value:.6f}" for value in (*position, *q, *sigma))]


def overlay(
    rigid: RigidObject, found: ObjectEstimate, k: Intrinsics, mask: Bool, picture: NDArray[np.uint8] | None
) -> NDArray[np.uint8]:
    """The frame (h, w, 3) uint8 BGR with the mask's boundary in white and the pose's silhouette in its state's colour."""
    h, w = mask.shape
    out = np.zeros((h, w, 3), np.uint8) if picture is None else np.ascontiguousarray(picture[..., ::-1])
    silhouette = rigid.shape.fine.silhouette(found.T @ rigid.T_object_middle, k, (0, 0, w, h))
    for region, colour in ((mask, (255, 255, 255)), (silhouette, COLOURS[found.state])):
        lines, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(out, lines, -1, colour, 1 if region is mask else 2, cv2.LINE_AA)
    cv2.putText(
        out, f"{found.state} {found.overlap:.2f}", (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, COLOURS[found.state], 2, cv2.LINE_AA
    )
    return out
