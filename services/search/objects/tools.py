"""`penumbra search refine` and `penumbra search track`: any rigid mesh on any masks, from files to files."""

from __future__ import annotations

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

from penumbra.services import flags
from penumbra.services.search.contour import NEAR
from penumbra.services.search.objects import meshes, pose
from penumbra.services.search.objects.meshes import ObjectFileError
from penumbra.services.search.objects.pose import ObjectEstimate, RigidObject, Tracker
from penumbra.shared.cell.faults import meant
from penumbra.shared.geometry.lens import COEFFICIENTS, FOREIGN, Lens, Undistortion
from penumbra.shared.geometry.rigid import Array, position_orientation
from penumbra.shared.perception.intrinsics import Intrinsics

Bool = NDArray[np.bool_]

PICTURES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
CAMERA = ("width", "height", "fx", "fy", "cx", "cy")
"""Keys of a camera file."""
UNUSED = ("depth_scale",)
"""Other keys in camera files of object data sets, which say nothing about the picture."""
CROPPED = 0.25
"""Maximum distance of the principal point outside the picture, as a share of its size: pictures of objects are often cropped."""
RIGID = 1e-2
"""Maximum error of a rotation matrix that counts as rounding."""
FURTHEST = 100.0
"""Maximum distance [m] of a start: a larger one is in other units."""
TIMES = 5.0
"""Maximum ratio of the lengths of silhouette and mask at the start: beyond it, unit, camera or pose are wrong."""
COLOURS = {"tracking": (80, 220, 80), "occluded": (60, 180, 250), "doubtful": (60, 220, 250), "lost": (60, 60, 230)}
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


CAMERA_HELP = f"{', '.join(CAMERA)}, and for a lens with distortion {', '.join(COEFFICIENTS)} as OpenCV has them"
COMMON = (
    flags.Option("--mesh", type=Path, required=True, metavar="FILE", help="PLY, STL, OBJ, GLB or OFF"),
    flags.Option("--mesh-unit", choices=tuple(meshes.UNITS), default="m", help="of the mesh file's coordinates"),
    flags.Option("--camera", type=Path, required=True, metavar="JSON", help=CAMERA_HELP),
    flags.Option("--init", type=Path, required=True, metavar="JSON", help="camera_from_object: 4 x 4, metres"),
    flags.Option(
        "--init-sigma",
        type=float,
        nargs=2,
        default=(pose.START[0], math.degrees(pose.START[1])),
        show_default=f"{pose.START[0]} {math.degrees(pose.START[1]):.0f}",
        metavar="M DEG",
        help="how well the start is known along and about each axis",
    ),
)
"""The flags of both commands."""


@flags.command(
    "search refine",
    "Refines one pose of a rigid mesh on a mask, an image or both.",
    *COMMON,
    flags.Option("--mask", type=Path, metavar="PNG", help="not black where the object is seen; its boundary may be 4 px off"),
    flags.Option("--image", type=Path, metavar="PNG", help="the image that the mask is of; needed where there is no mask"),
    flags.Option("--occluder", type=Path, metavar="PNG", help="not black where something stands in front of the object"),
    flags.JSON,
    example="penumbra search refine --mesh cup.stl --mesh-unit mm --camera camera.json --init start.json --mask mask.png",
)
def refine(options: flags.Options) -> int:
    """Finds one pose in a mask or image. Returns 0, whatever its state, or 2 for wrong input."""
    return _reported("refine", _refine, options)


@flags.command(
    "search track",
    "Tracks a rigid mesh through a sequence of masks, images or both.",
    *COMMON,
    flags.Option("--masks", type=Path, metavar="FOLDER", help="one mask a frame, in the order of their names"),
    flags.Option("--images", type=Path, metavar="FOLDER", help="the images, of the same names; needed where there are no masks"),
    flags.Option("--occluders", type=Path, metavar="FOLDER", help="masks of what stands in front, of the same names"),
    flags.Option("--fps", type=flags.above_zero, default=30.0, help="frames a second of masks and video"),
    flags.Option("--out", type=flags.folder, default=Path("track"), metavar="FOLDER", help="for poses.csv and overlay.mp4"),
    example="penumbra search track --mesh cup.stl --camera camera.json --init start.json --masks masks --out track",
)
def track(options: flags.Options) -> int:
    """The poses of a sequence, as a table and a video; returns the same codes as `refine`."""
    return _reported("track", _track, options)


def _reported(name: str, run: Callable[[flags.Options], None], options: flags.Options) -> int:
    try:
        run(options)
    except ObjectFileError as error:
        print(f"penumbra search {name}: {error}", file=sys.stderr)
        return 2
    return 0


def _refine(options: flags.Options) -> None:
    rigid, files, T = _given(options)
    if options.mask is None and options.image is None:
        raise ObjectFileError("expected --mask, --image or both, got neither")
    k, occluder = files.k, files.occluder(options.occluder)
    mask = None if options.mask is None else files.mask(options.mask)
    if mask is not None:
        if not mask.any():
            raise ObjectFileError(f"{options.mask}: expected pixels that show the object (not black), got black ones only")
        check_mask(mask, options.mask)
    check_start(rigid, T, files, mask, occluder, options.init)
    picture = None if options.image is None else files.picture(options.image)
    found = pose.find_pose(rigid, mask, k, T, occluder, picture, options.spread)
    print(json.dumps(as_json(found)) if options.json else as_text(found))


def _track(options: flags.Options) -> None:
    rigid, files, T = _given(options)
    k, (height, width) = files.k, files.shape
    if options.masks is None and options.images is None:
        raise ObjectFileError("expected --masks, --images or both, got neither")
    names = frames(options.masks or options.images)
    masks = None if options.masks is None else names
    images = None if options.images is None else beside(names, options.images)
    occluders = None if options.occluders is None else beside(names, options.occluders)
    options.out.mkdir(parents=True, exist_ok=True)
    tracker = Tracker(rigid, k, T, 1.0 / options.fps, options.spread)
    video = cv2.VideoWriter(str(options.out / "overlay.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), options.fps, (width, height))
    counts = dict.fromkeys(COLOURS, 0)
    try:
        with (options.out / "poses.csv").open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(FIELDS)
            for i, name in enumerate(progress(names, description="frames", disable=not sys.stderr.isatty())):
                mask, occluder = (
                    None if masks is None else files.mask(name),
                    files.occluder(None if occluders is None else occluders[i]),
                )
                picture = None if images is None else files.picture(images[i])
                if i == 0 and (mask is None or mask.any()):
                    if mask is not None:
                        check_mask(mask, name)
                    check_start(rigid, T, files, mask, occluder, options.init)
                found = tracker.update(mask, occluder, picture)
                counts[found.state] += 1
                table.writerow(row(name.name, found))
                video.write(overlay(rigid, found, files, mask, picture))
    finally:
        video.release()
    print(f"{len(names)} frames: " + ", ".join(f"{n} {state}" for state, n in counts.items()) + f"; see {options.out}")


def _given(options: flags.Options) -> tuple[RigidObject, CameraFiles, Array]:
    """The inputs of both commands: object, reader of the camera's files, start."""
    metres, degrees = options.init_sigma
    if not (0 < metres < 10 and 0 < degrees < 360):
        raise ObjectFileError(
            f"--init-sigma: expected metres from 0 to 10 and degrees from 0 to 360, got {metres:g} and {degrees:g}"
        )
    options.spread = metres, math.radians(degrees)
    files, T = CameraFiles(read_camera(options.camera)), read_pose(options.init)
    try:
        return RigidObject(*meshes.load(options.mesh, options.mesh_unit)), files, T
    except ObjectFileError as error:
        raise ObjectFileError(str(error) if str(options.mesh) in str(error) else f"{options.mesh}: {error}") from None


# --- files ------------------------------------------------------------------------------------------------------------------


def _json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text())
    except OSError as error:
        raise ObjectFileError(f"{path}: expected a readable JSON file: {error.strerror}") from None
    except ValueError as error:
        raise ObjectFileError(f"{path}: expected JSON: {error}") from None
    if not isinstance(value, dict):
        raise ObjectFileError(f"{path}: expected a JSON object, got {type(value).__name__}")
    return value


def read_camera(path: Path) -> Lens:
    """Size, intrinsics and distortion of a camera file. Raises ObjectFileError."""
    value = _json(path)
    missing = [name for name in CAMERA if name not in value]
    if missing:
        raise ObjectFileError(f"{path}: expected the keys {', '.join(CAMERA)}, got none of {', '.join(missing)}")
    for name in value:
        if name in FOREIGN:
            raise ObjectFileError(f"{path}: {name}: {FOREIGN[name]}")
        if name not in (*CAMERA, *COEFFICIENTS, *UNUSED):
            known = (*CAMERA, *COEFFICIENTS)
            raise ObjectFileError(f"{path}: {name}: expected one of the keys {', '.join(known)}, got {name}{meant(name, known)}")
    for name in (each for each in value if each not in UNUSED):
        number = value[name]
        if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
            raise ObjectFileError(f"{path}: {name}: expected a finite number, got {number!r}")
    w, h = value["width"], value["height"]
    if w != int(w) or h != int(h) or not (16 <= w <= 16384 and 16 <= h <= 16384):
        raise ObjectFileError(f"{path}: expected width and height of 16 to 16384 whole pixels, got {w} x {h}")
    numbers = {name: float(value.get(name, 0.0)) for name in (*CAMERA[2:], *COEFFICIENTS)}
    lens = Lens(int(w), int(h), **numbers)
    for name, reason in lens.faults(room=CROPPED):
        raise ObjectFileError(f"{path}: {name}: {reason}")
    return lens


def read_pose(path: Path) -> Array:
    """T_camera_object of a pose file. Raises ObjectFileError."""
    value = _json(path)
    if "camera_from_object" not in value:
        raise ObjectFileError(f"{path}: expected the key camera_from_object, got {', '.join(value) or 'no key'}")
    try:
        T = np.array(value["camera_from_object"], dtype=np.float64)
    except (ValueError, TypeError):
        T = np.empty(0)
    if T.shape != (4, 4):
        raise ObjectFileError(f"{path}: camera_from_object: expected 4 rows of 4 numbers, got shape {T.shape}")
    if not np.isfinite(T).all():
        raise ObjectFileError(f"{path}: camera_from_object: expected finite numbers, got some that are not")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > RIGID or np.linalg.det(R) < 0 or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ObjectFileError(
            f"{path}: camera_from_object: expected a rotation without scale or mirror image, a translation and the last row "
            f"0 0 0 1, got a determinant of {np.linalg.det(R):.3g} and the last row {' '.join(f'{v:g}' for v in T[3])}"
        )
    u, _, vt = np.linalg.svd(R)
    T[:3, :3] = u @ vt
    distance = float(np.linalg.norm(T[:3, 3]))
    if distance > FURTHEST:
        raise ObjectFileError(
            f"{path}: camera_from_object: expected metres, got an object {distance:.4g} m away; check whether it is in "
            "millimetres"
        )
    return T


def _image(path: Path, shape: tuple[int, int], flags: int) -> NDArray[np.uint8]:
    if not path.is_file():
        raise ObjectFileError(f"{path}: expected an image file, found none")
    image = cv2.imdecode(np.frombuffer(path.read_bytes() or b"\0", np.uint8), flags)
    if image is None:
        raise ObjectFileError(f"{path}: expected an image that OpenCV reads (PNG, JPEG ...), got another file")
    if image.shape[:2] != shape:
        raise ObjectFileError(
            f"{path}: expected an image of {shape[1]} x {shape[0]}, as the camera's file says, got {image.shape[1]} x "
            f"{image.shape[0]}"
        )
    return np.asarray(image)


def read_mask(path: Path, shape: tuple[int, int]) -> Bool:
    """The pixels (h, w) of a mask file that are brighter than half of its brightest; none where all are 0. Raises
    ObjectFileError."""
    image = _image(path, shape, cv2.IMREAD_UNCHANGED)
    if image.ndim == 3:
        alpha = image[..., 3:]
        image = image[..., :3].max(axis=2)
        if alpha.size and image.min() == image.max():  # only the alpha channel has the mask
            image = alpha[..., 0]
    return np.asarray(image > image.max() / 2.0)


def read_picture(path: Path, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """An image (h, w, 3) uint8 RGB. Raises ObjectFileError."""
    return np.ascontiguousarray(_image(path, shape, cv2.IMREAD_COLOR)[..., ::-1])


class CameraFiles:
    """Reads the masks and pictures of a camera, undistorted to pinhole pictures. k: their intrinsics; shape: (height, width)."""

    def __init__(self, lens: Lens):
        self.k, self.shape = Intrinsics(lens.fx, lens.fy, lens.cx, lens.cy), (lens.height, lens.width)
        self._undistort = Undistortion(lens)

    def mask(self, path: Path) -> Bool:
        """The pixels (h, w) of a mask file that are set. Raises ObjectFileError."""
        mask = read_mask(path, self.shape)
        return np.asarray(self._undistort(mask.astype(np.uint8) * np.uint8(255)) > 127)

    def occluder(self, path: Path | None) -> Bool | None:
        """The pixels (h, w) where the object may be hidden: those of a mask file, and those that the camera does not show; None
        if there are neither. Raises ObjectFileError."""
        covered, unseen = None if path is None else self.mask(path), self._undistort.unseen
        return covered if unseen is None else unseen if covered is None else covered | unseen

    def picture(self, path: Path) -> NDArray[np.uint8]:
        """An image (h, w, 3) uint8 RGB. Raises ObjectFileError."""
        return self._undistort(read_picture(path, self.shape))


def frames(folder: Path) -> list[Path]:
    """The image files of a folder in the order of their names, numbers in names by their value. Raises ObjectFileError."""
    if not folder.is_dir():
        raise ObjectFileError(f"{folder}: expected a folder of masks, found none")
    found = sorted((p for p in folder.iterdir() if p.suffix.lower() in PICTURES), key=lambda p: _order(p.stem))
    if not found:
        raise ObjectFileError(f"{folder}: expected a folder of images ({', '.join(sorted(PICTURES))}), found none in it")
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
            f"{folder}: expected an image of the same name for every mask, got none for {len(missing)} of {len(names)}, first "
            f"{missing[0]}"
        )
    return [by_stem[path.stem] for path in names]


# --- checks -----------------------------------------------------------------------------------------------------------------


def check_mask(mask: Bool, path: Path) -> None:
    """Raises ObjectFileError for a mask (h, w) that cannot be one object's."""
    share = float(mask.mean())
    if share > 0.95:
        raise ObjectFileError(
            f"{path}: expected the object and its surroundings, got a mask with {share:.0%} of its pixels set; check whether "
            "it is inverted"
        )


def check_start(rigid: RigidObject, T: Array, files: CameraFiles, mask: Bool | None, occluder: Bool | None, path: Path) -> None:
    """Raises ObjectFileError for a start T_camera_object from which the object cannot be reached."""
    k, (h, w) = files.k, files.shape
    V = rigid.shape.fine.in_camera(T @ rigid.T_object_middle)
    if V[:, 2].min() < NEAR:
        z = (T @ rigid.T_object_middle)[2, 3]
        raise ObjectFileError(
            f"{path}: camera_from_object: expected the whole object at least {NEAR} m in front of the camera (z > 0), got its "
            f"middle at z = {z:.3g} m with a length of {rigid.diameter:.3g} m; check that this is not object_from_camera, and "
            "the mesh's unit"
        )
    u, v = k.fx * V[:, 0] / V[:, 2] + k.cx, k.fy * V[:, 1] / V[:, 2] + k.cy
    if u.max() < -w or u.min() > 2 * w or v.max() < -h or v.min() > 2 * h:
        raise ObjectFileError(
            f"{path}: camera_from_object: expected an object in or near the image ({w} x {h}), got one at pixel ({u.mean():.0f}, "
            f"{v.mean():.0f}); check that pose and camera belong together"
        )
    if mask is None:
        return
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    seen = math.hypot(rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1)
    expected = math.hypot(float(np.ptp(u)), float(np.ptp(v)))
    hidden = occluder is not None or rows[0] == 0 or columns[0] == 0 or rows[-1] == h - 1 or columns[-1] == w - 1
    if seen > TIMES * expected or (expected > TIMES * seen and not hidden):
        raise ObjectFileError(
            f"{path}: expected a start whose silhouette is about as large as the mask ({seen:.0f} pixels), got {expected:.0f} "
            f"pixels for a mesh of {rigid.diameter:.3g} m; check --mesh-unit, the focal length and the start's distance"
        )


# --- results ----------------------------------------------------------------------------------------------------------------


def as_json(found: ObjectEstimate) -> dict[str, Any]:
    """The result as the command prints it with --json."""
    return {
        "camera_from_object": found.T.tolist(),
        "covariance": found.covariance.tolist(),
        "overlap": round(found.overlap, 4),
        "state": found.state,
    }


def as_text(found: ObjectEstimate) -> str:
    """The result as text."""
    position, q = position_orientation(found.T)
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
    """A row of the table, see FIELDS."""
    position, q = position_orientation(found.T)
    sigma = np.sqrt(np.diag(found.covariance))
    return [name, found.state, f"{found.overlap:.4f}", *(f"{value:.6f}" for value in (*position, *q, *sigma))]


def overlay(
    rigid: RigidObject, found: ObjectEstimate, files: CameraFiles, mask: Bool | None, picture: NDArray[np.uint8] | None
) -> NDArray[np.uint8]:
    """The frame (h, w, 3) uint8 BGR with the mask's boundary in white and the pose's silhouette in its state's colour."""
    h, w = files.shape
    out = np.zeros((h, w, 3), np.uint8) if picture is None else np.ascontiguousarray(picture[..., ::-1])
    silhouette = rigid.shape.fine.silhouette(found.T @ rigid.T_object_middle, files.k, (0, 0, w, h))
    for region, colour in ((mask, (255, 255, 255)), (silhouette, COLOURS[found.state])):
        if region is None:
            continue
        lines, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(out, lines, -1, colour, 1 if region is mask else 2, cv2.LINE_AA)
    cv2.putText(
        out, f"{found.state} {found.overlap:.2f}", (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, COLOURS[found.state], 2, cv2.LINE_AA
    )
    return out
