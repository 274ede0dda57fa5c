"""A user's own frames and masks to train on, in one folder or in several, each of which is learned from as often as the others,
however much is in it. A folder has one of these forms:

  images/ and masks/   images/[SEQUENCE/]NAME.png and masks/[SEQUENCE/]NAME.png
  pairs                [SEQUENCE/]NAME.png and [SEQUENCE/]NAME_mask.png
  COCO                 one .json file with "images", "annotations" and "categories"; its file names are relative
                       to the folder or to images/ in it; polygons or run lengths, later annotations over earlier ones

Pictures may be JPEG or BMP as well. A mask is a PNG with one channel that holds a class for every pixel: 0 background, 1 robot,
2 torso, 3 upper arm, 4 forearm, 5 hand, 6 occluder (`shared.contract.labels.Label`), 255 unlabelled: nothing is learned from
there; in COCO, categories have these names, and what is not labelled counts as background. The files of a subfolder are the
frames of one sequence in the order of their names (as text: write 0001.png); pictures that lie in no subfolder are single ones,
each a sequence that stands still. A tenth of the sequences, or of their pieces of up to 40 frames, is kept for the calibration,
another for the score. A folder may say in sources.json, as a list, where its pictures come from: the weights' card repeats it.
"""

from __future__ import annotations

import itertools
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.shared.contract.labels import UNLABELLED, Label

PICTURES = (".png", ".jpg", ".jpeg", ".bmp")
PIECE = 40
"""Number of frames of a longer sequence that are held out, or trained on, together; fewer in a small folder, so that a tenth is
one piece."""
SHORTEST = 8
"""Minimum number of frames of a sequence; a shorter one is played forth and back."""
UNIT = 16
"""Pictures are cut to multiples of this many pixels per side, as the network requires."""
SMALLEST = 32
"""Minimum side [px] of a picture."""
SOURCES = "sources.json"
"""File with a folder's sources, if it has one: a list of objects, which is copied to cards."""
CLASSES = ", ".join(f"{label.value} {label.name.lower()}" for label in Label) + f", {UNLABELLED} unlabelled"


class DataError(ValueError):
    """A folder that cannot be used for training. The text says what was expected, what was received and where."""


@dataclass(frozen=True)
class Shape:
    """A class and its outline in one picture: COCO's `segmentation`, polygons or run lengths."""

    label: Label
    outline: Any


@dataclass(frozen=True)
class Frame:
    """A picture's file and its truth: a mask's file or shapes."""

    picture: Path
    truth: Path | tuple[Shape, ...]

    def read(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """RGB image (h, w, 3) and classes (h, w). Raises DataError if a file cannot be read or the two do not fit."""
        image = cv2.imread(str(self.picture), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            raise DataError(f"{self.picture}: expected a picture, got a file that cannot be read as one")
        height, width = image.shape[:2]
        if isinstance(self.truth, Path):
            labels = read_mask(self.truth)
        else:
            try:
                labels = paint(self.truth, height, width)
            except (ValueError, TypeError) as error:
                raise DataError(f"annotations of {self.picture}: expected polygons or run lengths: {error}") from None
        if labels.shape != (height, width):
            got = f"{labels.shape[1]} x {labels.shape[0]}"
            raise DataError(f"{self.truth}: expected a mask of {width} x {height} as {self.picture.name}, got {got}")
        return image[..., ::-1].astype(np.uint8), labels


class Recorded:
    """A sequence on disk that reads like an array (frames, h, w, 4) of red, green, blue and class, and is `evaluate.Labelled`."""

    def __init__(self, frames: Sequence[Frame], size: tuple[int, int]):
        self._frames = frames
        self._height, self._width = (n // UNIT * UNIT for n in size)
        there = len(frames)
        forth_and_back = [*range(there), *range(there - 2, 0, -1)]
        self._order = list(itertools.islice(itertools.cycle(forth_and_back), max(there, SHORTEST)))

    def __len__(self) -> int:
        return len(self._order)

    def __getitem__(self, chosen: slice) -> NDArray[np.uint8]:
        read = {i: np.dstack(self._frames[i].read()) for i in set(self._order[chosen])}
        return np.stack([read[i][: self._height, : self._width] for i in self._order[chosen]])

    @property
    def side(self) -> int:
        """Side [px] of the largest patch that fits in."""
        return min(self._height, self._width)

    @property
    def images(self) -> NDArray[np.uint8]:
        return self[:][..., :3]

    @property
    def labels(self) -> NDArray[np.uint8]:
        return self[:][..., 3]

    @property
    def hidden(self) -> NDArray[np.float64]:
        return np.full(len(self), np.nan)


class Recordings:
    """All sequences of folders, checked: for training (indexed), for the calibration and for the score (a tenth of each folder).

    Raises DataError or FileNotFoundError if there is nothing to train on or something does not fit.
    """

    jitter = 0.4
    """Amount of colour augmentation: the authors' for photographs."""

    def __init__(self, folders: Sequence[Path], seed: int):
        self.calibration: list[Recorded] = []
        self.held_out: list[Recorded] = []
        self._train: list[list[Recorded]] = []
        classes: set[int] = set()
        for folder in folders:
            pieces, there = _pieces(folder)
            classes |= there
            order = np.random.default_rng([seed, 4]).permutation(len(pieces))
            tenth = max(len(pieces) // 10, 1)
            self.calibration += [pieces[i] for i in order[:tenth]]
            self.held_out += [pieces[i] for i in order[tenth : 2 * tenth]]
            self._train.append([pieces[i] for i in order[2 * tenth :]])
        if not classes - {Label.BACKGROUND, UNLABELLED}:
            raise DataError(
                f"{', '.join(map(str, folders))}: expected masks with classes ({CLASSES}), got only "
                f"{' and '.join(map(str, sorted(classes)))}; of masks that are black and white, write the arm as "
                f"{Label.FOREARM.value} and the hand as {Label.HAND.value}"
            )
        self.count = len(folders) * max(len(pieces) for pieces in self._train)
        self.side = min(piece.side for piece in itertools.chain(self.calibration, self.held_out, *self._train))
        times = Counter(folders)
        self.origins = [
            {"folder": folder.name, "sequences": len(pieces), "times": times[folder], "sources": _sources(folder)}
            for folder, pieces in dict(zip(folders, self._train, strict=True)).items()
        ]
        names = ", ".join(folder.name for folder in folders)
        self.sources = (
            {"folder": names, "sequences": len(self.calibration)},
            {"folder": names, "sequences": len(self.held_out)},
        )

    def __getitem__(self, index: int) -> Recorded:
        """A sequence; of indices drawn at random from [0, count), each folder gets an equal share."""
        turn, folder = divmod(index, len(self._train))
        return self._train[folder][turn % len(self._train[folder])]

    def plain(self, index: int) -> Recorded:
        """The same sequence: nothing is pasted in front of it."""
        return self[index]

    def close(self) -> None:
        """Nothing to close."""


def _pieces(folder: Path) -> tuple[list[Recorded], set[int]]:
    """The pieces of a folder's sequences, and the classes in its masks."""
    found = find(folder)
    length = min(max(sum(map(len, found)) // 20, SHORTEST), PIECE)
    pieces, classes = [], set()
    for sequence in found:
        size, there = check(sequence)
        classes |= there
        pieces += [Recorded(sequence[i : i + length], size) for i in range(0, len(sequence), length)]
    if len(pieces) < 3:
        raise DataError(
            f"{folder}: expected at least 3 sequences, or pieces of {length} frames of them (to learn from, to calibrate and "
            f"to score with), got {len(pieces)}"
        )
    return pieces, classes


def _sources(folder: Path) -> Any:
    try:
        return json.loads((folder / SOURCES).read_text())
    except FileNotFoundError:
        return []
    except ValueError as error:
        raise DataError(f"{folder / SOURCES}: expected a list in JSON of what the pictures come from, got {error}") from None


def find(folder: Path) -> list[list[Frame]]:
    """The sequences of a folder in the forms that the module's text names, in the order of their names."""
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: expected a folder with frames and masks, found none; see `penumbra segmentation train -h`"
        )
    if (folder / "images").is_dir() and (folder / "masks").is_dir():
        pictures = {path.relative_to(folder / "images").with_suffix(""): path for path in _pictures(folder / "images")}
        masks = {path.relative_to(folder / "masks").with_suffix(""): path for path in sorted((folder / "masks").rglob("*.png"))}
        return in_sequences(folder / "images", _pairs(folder, pictures, masks))
    described = sorted(path for path in folder.glob("*.json") if path.name != SOURCES)
    if len(described) > 1:
        raise DataError(f"{folder}: expected one .json file in COCO format, got {', '.join(path.name for path in described)}")
    if described:
        return in_sequences(folder, coco(described[0]))
    every = _pictures(folder)
    stem = lambda path: path.relative_to(folder).with_suffix("")  # noqa: E731
    masks = {stem(path).with_name(path.stem.removesuffix("_mask")): path for path in every if path.stem.endswith("_mask")}
    pictures = {stem(path): path for path in every if not path.stem.endswith("_mask")}
    return in_sequences(folder, _pairs(folder, pictures, masks))


def in_sequences(root: Path, frames: Iterable[Frame]) -> list[list[Frame]]:
    """Group frames by subfolder of `root`; frames in no subfolder stay alone."""
    groups: dict[Path, list[Frame]] = {}
    for frame in sorted(frames, key=lambda frame: frame.picture):
        place = frame.picture.parent
        alone = place == root or place == root / "images"
        groups.setdefault(frame.picture if alone else place, []).append(frame)
    return list(groups.values())


def check(sequence: Sequence[Frame]) -> tuple[tuple[int, int], set[int]]:
    """Read every frame of a sequence; its height and width, and the classes in its masks. Raises DataError."""
    sizes: dict[tuple[int, ...], Path] = {}
    classes: set[int] = set()
    for frame in sequence:
        labels = frame.read()[1]
        sizes.setdefault(labels.shape, frame.picture)
        classes.update(np.unique(labels).tolist())
    if len(sizes) > 1:
        (a, first), (b, other) = list(sizes.items())[:2]
        raise DataError(
            f"{other.parent}: expected frames of one size in a sequence, got {a[1]} x {a[0]} in {first.name} and {b[1]} x {b[0]} "
            f"in {other.name}; put them into separate folders"
        )
    height, width = next(iter(sizes))
    if min(height, width) < SMALLEST:
        raise DataError(f"{sequence[0].picture}: expected at least {SMALLEST} x {SMALLEST} pixels, got {width} x {height}")
    return (height, width), classes


def read_mask(path: Path) -> NDArray[np.uint8]:
    """Classes (h, w) of a mask's file. Raises DataError if it is no mask, or a value is no class."""
    mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if mask is None:
        raise DataError(f"{path}: expected a mask, got a file that cannot be read as a picture")
    if mask.ndim == 3:
        if not (mask[..., :1] == mask[..., 1:3]).all():
            raise DataError(f"{path}: expected one channel of class indices ({CLASSES}), got colours or a palette")
        mask = mask[..., 0]
    wrong = np.argwhere((mask > max(Label)) & (mask != UNLABELLED))
    if len(wrong):
        r, c = wrong[0]
        raise DataError(f"{path}: expected classes {CLASSES}, got {mask[r, c]} at row {r}, column {c}")
    return mask.astype(np.uint8)


def coco(path: Path) -> list[Frame]:
    """The frames of a file in COCO's form (https://cocodataset.org/#format-data). Raises DataError."""
    try:
        content = json.loads(path.read_text())
        categories = {one["id"]: str(one["name"]) for one in content["categories"]}
        files = {one["id"]: str(one["file_name"]) for one in content["images"]}
        outlines = [(one["image_id"], one["category_id"], one["segmentation"]) for one in content["annotations"]]
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(
            f'{path}: expected COCO format, an object with "images" (id, file_name), "annotations" (image_id, category_id, '
            f'segmentation) and "categories" (id, name), got {error!r}'
        ) from None
    labels = {}
    for key, name in categories.items():
        label = Label.__members__.get(name.strip().upper().replace(" ", "_").replace("-", "_"))
        if label is None:
            known = ", ".join(label.name.lower() for label in Label)
            raise DataError(f"{path}: expected categories named {known}, got {name!r}; rename or remove it")
        labels[key] = label
    shapes: dict[Any, list[Shape]] = {key: [] for key in files}
    for image, category, outline in outlines:
        if image not in files or category not in labels:
            raise DataError(f"{path}: an annotation of image {image!r}, category {category!r}: one of the two is not in the file")
        shapes[image].append(Shape(labels[category], outline))
    frames = []
    for key, name in files.items():
        places = [path.parent / name, path.parent / "images" / name]
        picture = next((place for place in places if place.is_file()), None)
        if picture is None:
            raise FileNotFoundError(f"{path}: expected image {name!r} at {places[0]} or {places[1]}, found it at neither")
        frames.append(Frame(picture, tuple(shapes[key])))
    return frames


def paint(shapes: Sequence[Shape], height: int, width: int) -> NDArray[np.uint8]:
    """Classes (h, w) of shapes, later ones over earlier ones."""
    labels = np.full((height, width), Label.BACKGROUND, np.uint8)
    for shape in shapes:
        outline = shape.outline
        if isinstance(outline, list):
            for polygon in outline:
                labels[fill(np.reshape(polygon, (-1, 2)).astype(float), height, width)] = shape.label
        else:
            labels[run_lengths(outline, height, width)] = shape.label
    return labels


def fill(polygon: NDArray[np.float64], height: int, width: int) -> NDArray[np.bool_]:
    """The pixels (h, w) whose centre lies in a polygon (n, 2) of x, y in COCO's coordinates: pixel i reaches from i to i + 1."""
    mask = np.zeros((height, width), bool)
    x, y = polygon.T
    x_next, y_next = np.roll(x, -1), np.roll(y, -1)
    for row in range(max(int(y.min()), 0), min(int(np.ceil(y.max())), height)):
        middle = row + 0.5
        crosses = (y <= middle) != (y_next <= middle)
        at = np.sort((x + (middle - y) * (x_next - x) / np.where(crosses, y_next - y, 1.0))[crosses])
        for begin, end in at.reshape(-1, 2):
            mask[row, max(int(np.ceil(begin - 0.5)), 0) : max(int(np.ceil(end - 0.5)), 0)] = True
    return mask


def run_lengths(outline: Any, height: int, width: int) -> NDArray[np.bool_]:
    """The pixels (h, w) of COCO's run lengths, column by column: {"size": [h, w], "counts": a list, or packed in a string}."""
    if not isinstance(outline, dict) or not {"size", "counts"} <= outline.keys():
        raise DataError(f'expected {{"size": [h, w], "counts": …}}, got {outline!r}')
    counts = outline["counts"]
    counts = _unpack(counts) if isinstance(counts, str) else counts
    flat = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    if tuple(outline["size"]) != (height, width) or len(flat) != height * width:
        raise DataError(f"expected size {[height, width]}, got {outline['size']} with {len(flat)} pixels")
    return flat.reshape(width, height).T


def _unpack(text: str) -> list[int]:
    """COCO's packed counts: five bits per character, lowest first; from the third count on, the difference to the count two
    before."""
    counts: list[int] = []
    value = shift = 0
    for character in text.encode():
        bits = character - 48
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:  # more follow
            continue
        if bits & 16:
            value -= 1 << shift
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
        value = shift = 0
    return counts


def _pictures(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.suffix.lower() in PICTURES)


def _pairs(folder: Path, pictures: dict[Path, Path], masks: dict[Path, Path]) -> list[Frame]:
    names = sorted(pictures.keys() & masks.keys())
    if not names:
        raise DataError(
            f"{folder}: expected pairs NAME.png and NAME_mask.png, or images/NAME.png and masks/NAME.png, or a COCO .json, got "
            f"{len(pictures)} pictures and {len(masks)} masks, no two of one name"
        )
    alone = sorted(pictures.keys() ^ masks.keys())
    if alone:
        kind = "mask" if alone[0] in pictures else "picture"
        more = f" and {len(alone) - 1} more" if len(alone) > 1 else ""
        raise DataError(f"{folder}: expected a {kind} for {alone[0]}{more}, found none; add it or remove the other")
    return [Frame(pictures[name], masks[name]) for name in names]
