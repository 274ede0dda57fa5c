"""`penumbra bench lost`: how soon a lost arm is found, with the landmark models and without.

Simulated streams are short films of new scenes (`sim.sets.shots`), with the hand of the searched mesh and with posed hands
(fingers, bent wrists). Each begins lost, and goes through segmentation, search and fusion (`services.replay.chain`); a pose is
right within 5 cm and 20 degrees, and honest within three standard deviations of place and axis, as a bent hand leaves the roll
open. With --photographs, a folder of images/ and masks/ (drawn by hand: 4 forearm, 5 hand), every picture is searched once,
without knowledge of the arm but that it is before the camera. The camera is unknown too: one of 60 degrees across the longer side
is assumed. A pose is right where its outline lies on the arm: an intersection over union of at least a half with the drawn mask.
Beside the network's masks stand the drawn ones, which show what a better network would give.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.stats import chi2

from penumbra.services import flags
from penumbra.services.search import contour, starter
from penumbra.services.search.tracker import Search
from penumbra.services.segmentation import files
from penumbra.services.segmentation.inference import Segmenter, load_segmenter
from penumbra.services.segmentation.training import recordings
from penumbra.services.segmentation.training.recordings import Frame as Picture
from penumbra.shared.body import anatomy
from penumbra.shared.cell.description import Camera, Cell, Placement, Spread, Target
from penumbra.shared.contract.labels import TARGET_LABELS
from penumbra.shared.contract.messages import FusedPose, Mask, VisionPose
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception import landmarks
from penumbra.shared.perception.intrinsics import Intrinsics
from penumbra.shared.perception.landmarks import Landmarks
from penumbra.shared.perception.limbs import find, limb_of
from penumbra.shared.perception.lookout import Lookout
from penumbra.sim.sets import shots
from penumbra.sim.sets.shots import Domain, Hands
from penumbra.tests.bench.lib import photographs, results
from penumbra.tests.bench.lib.fusion_scores import THREE_SIGMA, normalised
from penumbra.tests.bench.lib.results import Part, Result
from penumbra.tests.bench.tracking import Film, played

SCENES: tuple[tuple[Domain, Hands], ...] = (("easy", "stiff"), ("easy", "posed"), ("wide", "stiff"), ("wide", "posed"))
FRAMES = 20
"""Number of frames of a film; landmarks are searched for after 0.3 s."""
LENS = math.radians(60.0)
"""Assumed field of view [rad] across the longer side of a photograph."""
HOME = (0.7, 0.4, 1.5)
"""Assumed distance from the camera [m] of an arm in a photograph, and its standard deviations [m, rad]."""
ON_THE_ARM = 0.5
"""Minimum IoU with the drawn mask at which an outline lies on the arm."""
MASKS = ("network", "drawn")


def search_with(mode: str) -> dict[str, list[str]]:
    """Arguments of the services for a mode of the landmarks."""
    return {"search": ["--landmarks", mode]}


# ---- simulated streams


def streams(
    seed: int, count: int, modes: tuple[str, ...], console: Console, scenes: Sequence[tuple[Domain, Hands]] = SCENES
) -> list[dict[str, Any]]:
    """A row for each kind of scene and each mode of the landmarks."""
    rows = []
    for domain, hands in scenes if count else ():
        found: dict[str, list[Film]] = {mode: [] for mode in modes}
        for index in track(range(count), f"{domain}, {hands} hands", console=console, transient=True):
            film = shots.clip(seed, index, domain=domain, frames=FRAMES, hands=hands)
            for mode in modes:
                found[mode].append(played(iter(film), search_with(mode)))
        rows += [{"scenes": domain, "hands": hands, "landmarks": mode, **scored(films)} for mode, films in found.items()]
    return rows


def scored(films: list[Film]) -> dict[str, Any]:
    """Number of recovered streams and their frames until then, number of streams with a wrong pose called tracking, and shares of
    the camera's and the fused tracking poses that are beyond three standard deviations in place and axis."""
    frames: list[int | None] = []
    wrong = 0
    beyond: dict[str, list[bool]] = {"vision": [], "fused": []}
    for film in films:
        right = [film.is_right(truth) for truth in film.truths]
        tracking = [stamped is not None and stamped.state == "tracking" for stamped in map(film.vision.get, _stamps(film))]
        frames.append(right.index(True) + 1 if any(right) else None)
        wrong += any(is_tracking and not is_right for is_tracking, is_right in zip(tracking, right, strict=True))
        for who, far in beyond.items():
            said = getattr(film, who)
            poses = ((said[truth.stamp_ns], truth.T) for truth in film.truths if truth.stamp_ns in said)
            far += [_is_beyond(pose, T) for pose, T in poses if pose.state == "tracking"]
    return {
        "streams": len(films),
        **_recovery(frames),
        "wrong": wrong,
        "beyond_3_sigma": {who: round(float(np.mean(far)), 4) if far else None for who, far in beyond.items()},
    }


def _is_beyond(pose: VisionPose | FusedPose, T_true: Array) -> bool:
    T = rigid.transform(pose.position, pose.orientation)
    return normalised(T_true, T, np.asarray(pose.covariance), rolls=False) > chi2.ppf(THREE_SIGMA, 5)


def _stamps(film: Film) -> list[int]:
    return [truth.stamp_ns for truth in film.truths]


def _recovery(frames: list[int | None]) -> dict[str, Any]:
    known = [n for n in frames if n is not None]
    return {"recovered": len(known), "median": float(np.median(known)) if known else None, "frames": frames}


# ---- photographs


def cell_of(image: NDArray[np.uint8]) -> Cell:
    """A cell with one person and the camera that is assumed for an image (h, w, 3), whose frame is the cell's."""
    height, width = image.shape[:2]
    focal = max(width, height) / 2.0 / math.tan(LENS / 2.0)
    camera = Camera(
        width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2.0, cy=(height - 1) / 2.0, rate_hz=20,
        position=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0),
    )  # fmt: skip
    distance, position, rotation = HOME
    target = Target(
        mesh="body:forearm", labels=("forearm", "hand"), home=Placement(position=(0.0, 0.0, distance), rpy=(0.0, 0.0, 0.0)),
        home_spread=Spread(position=position, rotation=rotation),
    )  # fmt: skip
    return Cell(name="photograph", cameras={"camera": camera}, targets={"arm": target})


class Outline:
    """Outlines of an arm at T_camera_target in an image, compared with the pixels of the arms in it."""

    def __init__(self, cell: Cell, labels: NDArray[np.uint8]):
        (camera,), (target,) = cell.cameras.values(), cell.targets.values()
        self._model = contour.Model(anatomy.target_mesh(target, cell))
        self._k = Intrinsics.of_window(camera, 0, 0, 1)
        self._size = (0, 0, camera.width, camera.height)
        _, self._parts = cv2.connectedComponents(np.isin(labels, TARGET_LABELS).astype(np.uint8))

    def iou(self, T: Array) -> float:
        """Intersection over union with the labelled arms that the outline touches."""
        shown = self._model.silhouette(T, self._k, self._size)
        touched = np.unique(self._parts[shown])
        there = np.isin(self._parts, touched[touched > 0])
        return float((shown & there).sum() / max((shown | there).sum(), 1))

    def over(self, image: NDArray[np.uint8], T: Array) -> NDArray[np.uint8]:
        """The image (h, w, 3) with the outline in yellow."""
        shown = self._model.silhouette(T, self._k, self._size).astype(np.uint8)
        edges, _ = cv2.findContours(shown, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        return np.asarray(cv2.drawContours(image.copy(), edges, -1, (255, 255, 0), 1), np.uint8)


def first_poses(models: Landmarks, image: NDArray[np.uint8], cell: Cell) -> list[Array]:
    """Poses from the landmarks alone, best first."""
    (camera,), hands_pose = cell.cameras.values(), find(models, image, (), None)
    limbs = [limb_of(hand, hands_pose[1]) for hand in hands_pose[0]]
    found = [one for limb in limbs for one in starter.starts(limb, camera, cell.body)]
    return [one.T for one in sorted(found, key=lambda one: one.misfit)]


def masks_of(
    image: NDArray[np.uint8], labels: NDArray[np.uint8], cell: Cell, segmenter: Segmenter, number: int
) -> dict[str, Mask]:
    """The network's mask of a picture in the window of a lost arm, and the drawn one in that of a tracked arm."""
    wide = Lookout(cell, "camera").window
    for k in range(number * files.SETTLE, (number + 1) * files.SETTLE):
        found = segmenter(image, wide, 10**18 + number * 10**10 + k * files.PERIOD_NS)
    near = photographs.window_about(np.isin(labels, TARGET_LABELS))
    drawn = labels[near.y0 : near.bottom : near.scale, near.x0 : near.right : near.scale]
    parts = {"network": (wide, found), "drawn": (near, drawn)}
    return {
        name: Mask(stamp_ns=0, labels=np.ascontiguousarray(part), x0=window.x0, y0=window.y0, scale=window.scale)
        for name, (window, part) in parts.items()
    }


def stills(
    pictures: list[Picture], models: Landmarks | None, segmenter: Segmenter, overlays: Path | None, console: Console
) -> dict[str, Any]:
    """The outcome of a search for each picture, kind of masks and mode of the landmarks, and the IoU of the outlines that
    landmarks alone give. Raises recordings.DataError where a picture cannot be read."""
    modes = ("off", "auto") if models else ("off",)
    rows: list[dict[str, Any]] = [{"masks": masks, "landmarks": mode, "pictures": []} for masks in MASKS for mode in modes]
    alone = []
    for number, picture in enumerate(track(pictures, "photographs", console=console, transient=True)):
        image, labels = picture.read()
        if not np.isin(labels, TARGET_LABELS).any():
            continue
        cell, name = cell_of(image), picture.picture.stem
        outline, masks = Outline(cell, labels), masks_of(image, labels, cell, segmenter, number)
        starts = first_poses(models, image, cell) if models else []
        if models:
            ious = [round(outline.iou(T), 3) for T in starts]
            alone.append({"name": name, "first": ious[0] if ious else None, "best": max(ious, default=None)})
        for row in rows:
            search = Search(cell)
            found = search.update(masks[row["masks"]], image=image, starts=starts if row["landmarks"] == "auto" else ())
            row["pictures"].append({"name": name, "state": found.state, "iou": round(outline.iou(found.T), 3)})
            if overlays and found.state == "tracking":
                files.write(overlays / f"{name}-{row['masks']}-{row['landmarks']}.png", outline.over(image, found.T)[..., ::-1])
    return {"rows": rows, "landmarks": alone}


# ---- what is shown


def tables(result: Result) -> list[Part]:
    """Recoveries in simulated streams and photographs."""
    parts: list[Part] = []
    if result["streams"]:
        table = Table(
            "scenes", "hands", "landmarks", "recovered", "frames, median", "streams with a wrong pose tracked",
            "beyond 3 sigma, vision", "fused",
            title=f"Streams that begin lost, seed {result['seed']}: a pose within 5 cm and 20 degrees in {FRAMES} frames",
        )  # fmt: skip
        for row in result["streams"]:
            median = "-" if row["median"] is None else f"{row['median']:g}"
            recovered = f"{row['recovered']} of {row['streams']}"
            beyond = ("-" if far is None else f"{far:.1%}" for far in row["beyond_3_sigma"].values())
            table.add_row(row["scenes"], row["hands"], row["landmarks"], recovered, median, str(row["wrong"]), *beyond)
        parts.append(table)
    if "photographs" in result:
        parts += _stills(result["photographs"])
    return parts


def _stills(result: dict[str, Any]) -> list[Part]:
    table = Table(
        "masks", "landmarks", "pictures", "tracking", "tracking on the arm", "tracking elsewhere",
        title=f"Photographs, a camera of {math.degrees(LENS):g} degrees assumed; on the arm: IoU >= {ON_THE_ARM:g}",
    )  # fmt: skip
    for row in result["rows"]:
        tracked = [one["iou"] for one in row["pictures"] if one["state"] == "tracking"]
        right = sum(iou >= ON_THE_ARM for iou in tracked)
        table.add_row(
            row["masks"], row["landmarks"], str(len(row["pictures"])), str(len(tracked)), str(right), str(len(tracked) - right)
        )
    parts: list[Part] = [table]
    if alone := result["landmarks"]:
        found = [one for one in alone if one["best"] is not None]
        on = {key: sum(one[key] >= ON_THE_ARM for one in found) for key in ("first", "best")}
        parts.append(
            f"Landmarks alone: hands in {len(found)} of {len(alone)} pictures; the outline of the best first pose is on the arm "
            f"in {on['first']}, that of any first pose in {on['best']}."
        )
    return parts


@results.benchmark(
    "lost",
    __doc__ or "",
    tables,
    flags.Option("--seed", type=int, default=1, help="draws the scenes"),
    flags.Option("--scenes", type=int, default=20, help="streams of each kind of scene; 0: none"),
    flags.Option("--quick", is_flag=True, help="one stream, to see that it runs"),
    flags.Option("--photographs", type=Path, metavar="FOLDER", help="images/ and masks/ of still pictures of arms"),
    flags.Option("--pictures", type=results.folder, metavar="FOLDER", help="write the outlines of tracked stills to this folder"),
    example="penumbra bench lost --scenes 20 --photographs arms --json lost.json",
)
def main(options: flags.Options, report: results.Report) -> int | None:
    console, started = Console(stderr=True), time.monotonic()
    models = landmarks.loaded(landmarks.kept()) if landmarks.is_installed(landmarks.kept()) else None
    modes = ("off", "auto") if models else ("off",)
    if not models:
        console.print("no landmark models are installed: only the search without them is measured (penumbra segmentation models)")
    count, scenes = (1, SCENES[1:2]) if options.quick else (options.scenes, SCENES)
    result: Result = {
        "seed": options.seed,
        "streams": streams(options.seed, count, modes, console, scenes),
    }
    if options.photographs:
        try:
            pictures = [frame for sequence in recordings.find(options.photographs) for frame in sequence]
            result["photographs"] = stills(pictures, models, load_segmenter(), options.pictures, console)
        except recordings.DataError as error:
            console.print(f"penumbra bench lost: {error}")
            return 2
    report.save({**result, "wall_s": round(time.monotonic() - started, 1)})
    return None


if __name__ == "__main__":
    raise SystemExit(main())
