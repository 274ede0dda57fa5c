"""`penumbra segmentation label`: frames and masks to train on, made of films of your own arms by a teacher.

The teacher finds hands and elbows (`penumbra segmentation models`), follows them through the film, and learns from them the
colours of hand, forearm and surroundings, over the film and in each frame. A pixel is hand or forearm where place and colours say
so. Where they disagree, or the teacher does not know (how far a forearm without an elbow goes, what a sleeve covers, skin that
belongs to no hand that was found), it is unlabelled; frames without a hand are left out.

Look at the sheets in check/ before training, and remove the frames with faults: `rm labels/*/NAME/0123.*` removes a frame's
picture and mask, `rm -r labels/*/NAME` a sequence. What is violet is unlabelled and does no harm.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.progress import track
from scipy.ndimage import gaussian_filter

from penumbra.services import flags
from penumbra.services.segmentation import files
from penumbra.services.segmentation.inference import cut
from penumbra.services.segmentation.training.models import FOLDER
from penumbra.services.segmentation.training.recordings import PIECE
from penumbra.shared.contract.labels import TARGET_LABELS, UNLABELLED, Label
from penumbra.shared.perception import landmarks, lookout
from penumbra.shared.perception.landmarks import Hand, Landmarks, Points
from penumbra.shared.perception.limbs import FOREARM, Limb, find, limb_of
from penumbra.shared.perception.lookout import ARM_M, MARGIN_M, Window, window_of

RATE_HZ = 15.0
"""Frame rate [1/s] at which films are labelled: about that of the cameras for which the network is trained."""
GAP_S = 0.4
"""Maximum time [s] over which a missing hand, or its elbow, is interpolated linearly."""
FASTEST = 12.0
"""Maximum speed of a hand [hand sizes/s] at which two detections are the same hand: 1 m/s."""
SAME = 0.7
"""Maximum distance [hand sizes] between an elbow's positions relative to the wrist, at different times, at which they confirm
each other."""
LONGEST = 3.1
"""Maximum length of a forearm [hand sizes]: bare skin beyond it is the upper arm."""
SURE = 1.3
"""Length of the forearm [hand sizes] that is labelled if no elbow is known: it may be foreshortened."""
BINS = 32
"""Number of bins of each of the three colour channels (L*a*b*)."""
BLUR = 1.2
"""Standard deviation [bins] with which colour histograms are smoothed."""
MOST = 4.0
"""Maximum log-likelihood ratio of a pixel's colour, which limits its weight against the pixel's place."""
DOUBT = 1.0
"""Log odds up to which a pixel is unlabelled."""
LEARN = 24
"""Number of frames from which the film's colours are learned."""
HAND_M = 0.09
"""Size of a hand [m], from the wrist to the knuckles."""
TILE, COLUMNS = 240, 5
"""Width [px] of a frame on a sheet, and number of frames per row."""
VIOLET = (200, 0, 200)
"""Colour [RGB] of unlabelled pixels."""

Bool = NDArray[np.bool_]
Field = NDArray[np.float32]


# ---- where the arms are


def follow(seen: Sequence[Sequence[Limb]], period_s: float) -> list[list[Limb]]:
    """Track the limbs of a film with a frame period period_s; returns the limbs of each frame. A hand that is missing for up to
    GAP_S is interpolated, one that appears once is dropped, and an elbow known up to GAP_S before or after is interpolated."""
    gap = int(GAP_S / period_s)
    tracks: list[dict[int, Limb]] = []
    for t, limbs in enumerate(seen):
        free = [one for one in tracks if t - max(one) <= gap + 1]
        for limb in limbs:
            apart = [float(np.linalg.norm(limb.middle - one[max(one)].middle)) for one in free]
            best = int(np.argmin(apart)) if apart else -1
            if best >= 0 and apart[best] < (0.5 + FASTEST * period_s) * limb.size:
                free.pop(best)[t] = limb
            else:
                tracks.append({t: limb})
    out: list[list[Limb]] = [[] for _ in seen]
    for one in tracks:
        if len(one) > 1 or gap < 1:
            for t, limb in filled(one, gap).items():
                out[t].append(limb)
    return out


def filled(found: dict[int, Limb], gap: int) -> dict[int, Limb]:
    """A limb in all frames from its first to its last, by frame. An elbow that no other one within `gap` frames confirms is
    dropped."""
    times = np.array(sorted(found))
    every = np.arange(times[0], times[-1] + 1)
    points = _evenly(every, times, np.stack([found[t].points for t in times]))
    out = {int(t): Limb(p, is_seen=int(t) in found) for t, p in zip(every, points, strict=True)}
    for name in ("elbow", "shoulder"):
        known = np.array([t for t in times if getattr(found[t], name) is not None])
        if not len(known):
            continue
        ends = np.stack([getattr(found[t], name) - found[t].points[0] for t in known])
        if gap:
            apart = np.linalg.norm(ends[:, None] - ends[None], axis=-1) / np.array([found[t].size for t in known])
            near = (np.abs(known[:, None] - known[None]) <= gap) & (apart < SAME)
            known, ends = known[near.sum(1) > 2], ends[near.sum(1) > 2]
        for t, end in zip(every, _evenly(every, known, ends) if len(known) else (), strict=False):
            if np.abs(known - t).min() <= gap:
                out[int(t)] = replace(out[int(t)], **{name: out[int(t)].points[0] + end})
    return out


def _evenly(every: NDArray[np.int64], times: NDArray[np.int64], values: Points) -> Points:
    """Values (n, ...) known at n times, interpolated linearly at `every` time."""
    flat = values.reshape(len(times), -1)
    return np.asarray(np.stack([np.interp(every, times, column) for column in flat.T], 1).reshape(len(every), *values.shape[1:]))


# ---- which pixels they are


@dataclass
class Colours:
    """Colour histograms of hands, of forearms and of their surroundings: (3, BINS, BINS, BINS), each with sum 1 or 0."""

    seen: NDArray[np.float32]

    @classmethod
    def none(cls) -> Colours:
        return cls(np.zeros((3, BINS, BINS, BINS), np.float32))

    @classmethod
    def of(cls, bins: NDArray[np.int64], parts: Sequence[Bool]) -> Colours:
        """Histograms of the pixels of hands, forearms and surroundings in a picture, given as bins (h, w)."""
        counts = [np.bincount(bins[part], minlength=BINS**3).reshape(BINS, BINS, BINS).astype(np.float32) for part in parts]
        return cls(np.stack([gaussian_filter(c, BLUR) / max(float(c.sum()), 1.0) for c in counts]))

    def and_(self, other: Colours) -> Colours:
        """Combine two models, with equal weight where both have data."""
        total = self.seen + other.seen
        return Colours(total / np.maximum(total.sum((1, 2, 3), keepdims=True), 1e-9))

    def ratios(self, bins: NDArray[np.int64]) -> tuple[Field, Field]:
        """Log-likelihood ratios (h, w) of hand and of forearm, which may be bare, against the surroundings."""
        hand, forearm, rest = (part.ravel() + 2e-6 for part in self.seen)
        out = []
        for part in (hand, np.maximum(forearm, 0.5 * hand)):
            table = np.clip(np.log(part / rest), -MOST, MOST).astype(np.float32)
            out.append(np.asarray(cv2.blur(table[bins], (3, 3)), np.float32))
        return out[0], out[1]


@dataclass(frozen=True)
class Place:
    """Geometry of each pixel (h, w) relative to a limb, in hand sizes: distance outside the hand and the forearm, position along
    the forearm from the wrist (1: the elbow), and the log odds of hand and forearm by place alone."""

    limb: Limb
    hand: Field
    forearm: Field
    along: Field
    hand_odds: Field
    forearm_odds: Field

    @classmethod
    def of(cls, limb: Limb, height: int, width: int) -> Place:
        size, points = limb.size, limb.points
        shape = np.zeros((height, width), np.uint8)
        fixed = np.round(points).astype(np.int32)
        cv2.fillConvexPoly(shape, cv2.convexHull(fixed[[0, 1, 2, 5, 9, 13, 17]]), 1)
        for first in range(1, 21, 4):
            for a, b in itertools.pairwise(fixed[first : first + 4]):
                cv2.line(shape, a.tolist(), b.tolist(), 1, max(round(0.16 * size), 1))
        hand = _outside(shape.astype(bool)) / size
        is_known = limb.elbow is not None
        # if the elbow is unknown, a wedge that widens from the wrist
        end = limb.elbow if limb.elbow is not None else points[0] + FOREARM * size * limb.back
        length = max(float(np.linalg.norm(end - points[0])), 1e-6)
        way = (end - points[0]) / length
        y, x = np.mgrid[:height, :width].astype(np.float32)
        x, y = x - np.float32(points[0, 0]), y - np.float32(points[0, 1])
        along = x * way[0] + y * way[1]
        short = max(length - 0.25 * size, 0.0)  # the round end of the elbow lies a quarter beyond
        inside = np.clip(along, 0.0, short)
        radius = 0.3 + (0.12 if is_known else 0.6) * inside / length
        forearm = (np.hypot(x - inside * way[0], y - inside * way[1]) / size - radius).astype(np.float32)
        hand_odds = np.clip(-12.0 * hand, -6.0, 3.0)
        forearm_odds = np.clip(-10.0 * forearm, -6.0, 2.0) if is_known else np.clip(-5.0 * forearm, -6.0, 0.0)
        return cls(limb, hand, forearm, (along / length).astype(np.float32), hand_odds, forearm_odds)

    @property
    def core(self) -> Bool:
        """Pixels (h, w) in the middle of the forearm."""
        if self.limb.elbow is not None:
            return (self.forearm < -0.15) & (self.along > 0.0) & (self.along < 0.9)
        return (self.forearm < -0.15) & (self.along > 0.0) & (self.along * FOREARM < 0.5)


def _outside(shape: Bool) -> Field:
    """Distance [px] of each pixel (h, w) from the edge of a shape, negative in it."""
    inside = shape.astype(np.uint8)
    return np.asarray(
        cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5) - cv2.distanceTransform(inside, cv2.DIST_L2, 5), np.float32
    )


def bins_of(image: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Index of the colour bin (h, w) of each pixel of an RGB image (h, w, 3)."""
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).astype(np.int64) * BINS // 256
    return np.asarray((lab[..., 0] * BINS + lab[..., 1]) * BINS + lab[..., 2])


@dataclass(frozen=True)
class Found:
    """A limb by place and colours: log odds (h, w) of hand and forearm, and its colours."""

    place: Place
    hand: Field
    forearm: Field
    colours: Colours

    @property
    def odds(self) -> Field:
        """Log odds (h, w) of hand or forearm."""
        return np.maximum(self.hand, self.forearm)

    @property
    def doubts_elbow(self) -> bool:
        """Whether nothing on the way to the elbow differs from the surroundings."""
        core = self.place.core
        return not core.any() or float(np.median((self.forearm - self.place.forearm_odds)[core])) < 0.5


def fit(place: Place, bins: NDArray[np.int64], near: Field, film: Colours) -> Found:
    """Alternate between estimating a limb's pixels and their colours, with the film's colours as a prior. `near`: distance of
    each pixel (h, w) from any limb of the frame."""
    y, x = np.mgrid[: near.shape[0], : near.shape[1]]
    around = np.hypot(x - place.limb.points[0, 0], y - place.limb.points[0, 1]) < 4.5 * place.limb.size
    hand, forearm, rest = place.hand < -0.03, place.core, around & (near > 0.25)
    for _ in range(4):
        own = Colours.of(bins, (hand, forearm if forearm.sum() > 20 else hand, rest if rest.any() else ~hand))
        of_hand, of_forearm = own.and_(film).ratios(bins)
        z_hand, z_forearm = place.hand_odds + of_hand, place.forearm_odds + of_forearm
        hand = (z_hand > DOUBT) & (place.hand < 0.15)
        forearm = (z_forearm > DOUBT) & (place.forearm < 0.1) & (place.hand > 0.0)
        rest = around & (np.maximum(z_hand, z_forearm) < -DOUBT)
    return Found(place, z_hand, z_forearm, own)


def label(image: NDArray[np.uint8], limbs: Sequence[Limb], film: Colours) -> tuple[NDArray[np.uint8], Colours]:
    """Classes (h, w) of an RGB image (h, w, 3) with these limbs, given the film's colours, and the colours seen in it."""
    height, width = image.shape[:2]
    bins = bins_of(image)
    places = [Place.of(limb, height, width) for limb in limbs]
    near = np.min([np.minimum(place.hand, place.forearm) for place in places], axis=0)
    found = [fit(place, bins, near, film) for place in places]
    doubted = np.zeros((height, width), bool)
    for i, one in enumerate(found):
        if one.place.limb.elbow is not None and one.doubts_elbow:
            doubted |= (one.place.forearm < 0.1) & (one.place.hand > 0.05)
            place = Place.of(replace(one.place.limb, elbow=None, shoulder=None), height, width)
            found[i] = fit(place, bins, near, film)
    labels = np.full((height, width), Label.BACKGROUND, np.uint8)
    best = np.max([one.odds for one in found], axis=0)
    unknown = np.abs(best) < DOUBT
    for one in found:
        place = one.place
        mine = _connected(one.odds > 0.0, place.hand < -0.03)
        if place.limb.elbow is None:
            beyond = place.along * FOREARM
            wedge = (place.forearm < 0.0) & (place.hand > 0.05) & (beyond > 0.0)
            unknown |= (mine & (beyond > SURE) & (place.hand > 0.1)) | (wedge & ~mine)
            edge = wedge & (place.forearm > -0.1) & (beyond > 0.4) & (beyond < SURE)
            if (mine & edge).sum() > 0.3 * edge.sum():  # wider than an arm: no edge separates it, unless it is bare
                unknown |= mine & (beyond > 0.0) & (place.hand > 0.05) & (one.hand - place.hand_odds < DOUBT)
        else:
            unknown |= (place.forearm < 0.0) & (place.hand > 0.05) & ~mine  # a sleeve, or something in front
        shape = place.hand < -0.03
        if not place.limb.is_seen or (mine & shape).sum() < 0.4 * shape.sum():  # missed or hidden
            unknown |= mine | (np.minimum(place.hand, place.forearm) < 0.1)
        is_hand = (place.hand < 0.02) | ((place.hand < place.forearm) & (place.along < 0.05))
        top = mine & (one.odds >= best - 1e-6)
        labels[top] = np.where(is_hand, np.uint8(Label.HAND), np.uint8(Label.FOREARM))[top]
        hiding = (one.odds < -DOUBT) & (place.hand < -0.05)
        labels[hiding & ~np.isin(labels, TARGET_LABELS)] = Label.OCCLUDER
    colours = Colours(np.mean([one.colours.seen for one in found], axis=0, dtype=np.float32))
    skin, _ = colours.and_(film).ratios(bins)
    strange = cv2.morphologyEx(((skin > 0.7) & (near > 0.1)).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    upper = np.zeros((height, width), bool)
    for one in found:
        ended = one.place.forearm > 0.25 if one.place.limb.elbow is not None else one.place.along > LONGEST / FOREARM
        upper |= _connected((skin > DOUBT) | (one.odds > 0.0), one.place.hand < -0.03) & ended & (one.place.along > 1.0)
    unknown |= doubted & ~np.isin(labels, TARGET_LABELS)
    unknown |= cv2.dilate(strange, np.ones((5, 5), np.uint8)).astype(bool) & ~np.isin(labels, TARGET_LABELS)
    labels[unknown] = UNLABELLED
    labels[upper & (skin > DOUBT) & (near > 0.25)] = Label.UPPER_ARM
    return labels, colours


def _connected(mask: Bool, seed: Bool) -> Bool:
    """The parts of a mask (h, w) that touch the seed."""
    _, parts = cv2.connectedComponents(mask.astype(np.uint8))
    touched = np.unique(parts[mask & seed])
    return np.asarray(np.isin(parts, touched[touched > 0]))


# ---- films


def pictures(path: Path, every: int) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Number and RGB image (h, w, 3) of every Nth frame of a film, or of a picture. Raises FileError, FileNotFoundError."""
    if files.is_picture(path):
        yield 0, files.read(path)
        return
    film = cv2.VideoCapture(str(path))
    if not film.isOpened():
        raise files.FileError(f"{path}: expected a picture or a film, got a file of which OpenCV reads no frame")
    for number in itertools.count():
        if not film.grab():
            break
        if number % every == 0:
            there, image = film.retrieve()
            if there:
                yield number, np.ascontiguousarray(image[..., ::-1]).astype(np.uint8)
    film.release()


def rate(path: Path) -> float:
    """Frame rate [1/s] of a film, RATE_HZ if the file does not state it; 1 for a picture."""
    return 1.0 if files.is_picture(path) else cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FPS) or RATE_HZ


def arms(
    models: Landmarks, frames: Iterable[tuple[int, NDArray[np.uint8]]], period_s: float
) -> tuple[dict[int, list[Limb]], int]:
    """The limbs in each frame that shows any, by its number, and the scale that the service would use for most of them."""
    numbers, seen, size, hands, pose = [], [], Window(0, 0, 0, 0), list[Hand](), None
    for number, image in frames:
        hands, pose = find(models, image, hands, pose)
        numbers.append(number)
        seen.append([limb_of(hand, pose) for hand in hands])
        size = Window(0, 0, image.shape[1], image.shape[0])
    limbs = {number: there for number, there in zip(numbers, follow(seen, period_s), strict=True) if there}
    scales = sorted(scale(size, there) for there in limbs.values())
    return limbs, scales[len(scales) // 2] if scales else 1


def scale(picture: Window, limbs: Iterable[Limb]) -> int:
    """Scale that the service would use for limbs in a picture of this size."""
    low, high, arm_px = np.array([np.inf, np.inf]), np.array([-np.inf, -np.inf]), 0.0
    for limb in limbs:
        end = limb.elbow if limb.elbow is not None else limb.points[0] + SURE * limb.size * limb.back
        points = np.vstack([limb.points, end])
        metre_px = limb.size / HAND_M
        margin, arm_px = MARGIN_M * metre_px, max(arm_px, ARM_M * metre_px)
        low, high = np.minimum(low, points.min(0) - margin), np.maximum(high, points.max(0) + margin)
    window = window_of(picture, low, high, arm_px)
    return window.scale if window else 1


def reduced(image: NDArray[np.uint8], scale: int) -> NDArray[np.uint8]:
    """An image (h, w, 3) as the service sees it at a scale."""
    window = lookout.reduced(Window(0, 0, image.shape[1], image.shape[0]), scale)
    return np.asarray(np.round(255.0 * cut(image, window)), np.uint8)


def labelled(models: Landmarks, path: Path, every: int) -> Iterator[tuple[int, NDArray[np.uint8], NDArray[np.uint8]]]:
    """Number, picture (h, w, 3) and classes (h, w) of the frames of a film that show arms, at the service's scale."""
    limbs, scale = arms(models, track(pictures(path, every), f"{path.stem}: arms", transient=True), every / rate(path))

    def frames(every: int) -> Iterator[tuple[int, NDArray[np.uint8], list[Limb]]]:
        for number, image in pictures(path, every):
            if number in limbs:
                yield number, reduced(image, scale), [limb.scaled(1.0 / scale) for limb in limbs[number]]

    known = Colours.none()
    if len(limbs) > 1:
        some = frames(every * -(-len(limbs) // LEARN))
        seen = [label(image, there, known)[1].seen for _, image, there in track(some, f"{path.stem}: colours", transient=True)]
        known = Colours(np.mean(seen, axis=0, dtype=np.float32))
    for number, image, there in track(frames(every), f"{path.stem}: labels", total=len(limbs), transient=True):
        yield number, image, label(image, there, known)[0]


def seen(image: NDArray[np.uint8], labels: NDArray[np.uint8], title: str) -> NDArray[np.uint8]:
    """A tile of a sheet (h, TILE, 3) RGB: the picture under its classes, violet where unlabelled."""
    shown = files.overlay(image, np.where(labels == UNLABELLED, np.uint8(Label.BACKGROUND), labels))
    shown[labels == UNLABELLED] = shown[labels == UNLABELLED] // 2 + np.array(VIOLET, np.uint8) // 2
    size = (TILE, round(TILE * image.shape[0] / image.shape[1]))
    tile = cv2.resize(shown, size, interpolation=cv2.INTER_AREA)
    tile[:18, :54] = 0
    cv2.putText(tile, title, (2, 13), cv2.FONT_HERSHEY_PLAIN, 0.9, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(tile, np.uint8)


class Folder:
    """The output folder: images/ and masks/ as `recordings` reads them, and the sheets in check/."""

    def __init__(self, out: Path):
        self._out = out
        self.frames = 0
        for name in ("images", "masks", "check"):
            (out / name).mkdir(parents=True, exist_ok=True)

    def check(self, film: str) -> None:
        """Raise FileError if there are already frames of a film of this name."""
        if there := sorted((self._out / "images").glob(f"{film}_{'[0-9]' * 6}")):
            raise files.FileError(f"{there[0]}: expected no frames of {film} yet, got some; remove them, or choose another --out")

    def add(self, sequence: str, frames: Sequence[tuple[int, NDArray[np.uint8], NDArray[np.uint8]]]) -> None:
        """Write consecutive frames of a sequence. Raises FileError."""
        tiles = []
        for number, image, labels in frames:
            name = f"{number:06d}"
            for kind, ending, picture in (("images", "jpg", image[..., ::-1]), ("masks", "png", labels)):
                (self._out / kind / sequence).mkdir(exist_ok=True)
                files.write(self._out / kind / sequence / f"{name}.{ending}", picture)
            tiles.append(seen(image, labels, name))
        self.frames += len(tiles)
        for i in range(0, len(tiles), PIECE):
            part = tiles[i : i + PIECE]
            part += [np.zeros_like(part[0])] * (-len(part) % COLUMNS)
            sheet = np.vstack([np.hstack(part[k : k + COLUMNS]) for k in range(0, len(part), COLUMNS)])
            files.write(self._out / "check" / f"{sequence}-{frames[i][0]:06d}.jpg", sheet[..., ::-1])


@flags.command(
    "segmentation label",
    "Makes frames and masks for `penumbra segmentation train --data` from films of your own arms.\n\n" + (__doc__ or ""),
    flags.Argument("films", type=Path, nargs=-1, required=True, metavar="FILM...", help="films, or single pictures"),
    flags.Option("--out", type=flags.folder, default=Path("labels"), help="folder to write images/, masks/ and check/ to"),
    flags.Option(
        "--every", type=flags.positive, metavar="N", show_default=f"{RATE_HZ:.0f} a second", help="label every Nth frame"
    ),
    FOLDER,
    example="penumbra segmentation label arm.mp4 --out labels",
)
def main(options: flags.Options) -> int:
    """Write frames and masks; returns 2 if a file cannot be read, or no hand is found."""
    try:
        models = Landmarks(options.models)
        files.check_names(options.films)
        folder = Folder(options.out)
        for path in options.films:
            folder.check(path.stem)
            every = options.every or max(round(rate(path) / RATE_HZ), 1)
            run: list[tuple[int, NDArray[np.uint8], NDArray[np.uint8]]] = []
            for frame in labelled(models, path, every):
                if run and frame[0] > run[-1][0] + every:
                    folder.add(f"{path.stem}_{run[0][0]:06d}", run)
                    run = []
                run.append(frame)
            if run:
                folder.add(f"{path.stem}_{run[0][0]:06d}", run)
    except (landmarks.ModelsError, files.FileError, FileNotFoundError) as error:
        print(f"penumbra segmentation label: {error}", file=sys.stderr)
        return 2
    if not folder.frames:
        print("penumbra segmentation label: expected films with hands in them, found no hand", file=sys.stderr)
        return 2
    print(
        f"{folder.frames} frames: {options.out}. Look at {options.out / 'check'} and remove what is wrong, then\n"
        f"penumbra segmentation train --data {options.out} --simulated 0.4 --start --with-start --rate 1e-3 --minutes 10"
    )
    return 0
