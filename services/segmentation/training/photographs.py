"""`penumbra segmentation photographs`: photographs as frames and masks to train on, from clones of public repositories.

The photographs are not kept in the project. Its folder training/photographs has what makes them ready again: repositories with
their commits and licences (repositories.csv), the pictures that are used (pictures.csv), and masks that were drawn for it. Three
folders are written, of what the clones have:

  street   people in the street, from Clothing Co-Parsing and the models that `penumbra segmentation models` fetches
  close    hands and forearms at work, with the project's masks
  scenes   pictures without people, and cut-out hands in front of these

With --get, `git clone` fetches the repositories first, each at its commit in the table, and only the files that are used.

A larger picture is shrunk, by the mean of areas, until its longer side has 960 pixels; that is the size of the masks.
"""

from __future__ import annotations

import csv
import itertools
import json
import math
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from penumbra.services import flags
from penumbra.services.segmentation.training import clones, models, pasted, recordings, street
from penumbra.services.segmentation.training.recordings import DataError, read_mask
from penumbra.shared.contract.labels import Label
from penumbra.shared.perception.landmarks import Landmarks, ModelsError

STREET = "bearpaw/clothing-co-parsing"
HANDS = "ardamavi/Sign-Language-Digits-Dataset"
WHOLE = {STREET: street.PATHS, HANDS: ("Dataset",)}
"""Paths used of the repositories whose pictures pictures.csv does not list one by one."""
LONGEST = 960
"""Maximum length [px] of a picture's longer side."""
QUALITY = 95
"""Quality of the JPEG files [%]."""
SEED = 8
"""Seed of the pasted hands."""
SCENE = 480, 640
"""Height and width [px] of a scene with pasted hands."""
COMPOSED = 200
"""Number of scenes with hands that are cut out by colour."""
HANDS_IN_A_SCENE = 2, 4
"""Bounds of the number of hands in a scene."""
REPEATS = 6
"""Number of scenes made from each picture on white."""


@dataclass(frozen=True)
class Picture:
    """A row of pictures.csv: kind "close" or "scene"; name of the written picture and of the mask; frame of a GIF, else empty;
    width and height [px] as labelled; backdrop "white" if the picture can be cut out."""

    kind: str
    name: str
    repository: str
    path: str
    frame: str
    width: str
    height: str
    backdrop: str

    def read(self, clone: Path) -> NDArray[np.uint8]:
        """The picture (height, width, 3) BGR. Raises DataError if the clone does not have it."""
        path = clone / self.path
        image = cv2.imread(str(path)) if not self.frame else _frame(path, int(self.frame))
        if image is None:
            raise DataError(f"{path}: expected a picture, found none; check out the commit in repositories.csv")
        if max(image.shape) > LONGEST:
            scale = LONGEST / max(image.shape)
            image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        if image.shape[:2] != (int(self.height), int(self.width)):
            got = f"{image.shape[1]} x {image.shape[0]}"
            raise DataError(f"{path}: expected {self.width} x {self.height}, got {got}; check out the commit in repositories.csv")
        return image.astype(np.uint8)


def _frame(path: Path, index: int) -> NDArray[np.uint8] | None:
    film = cv2.VideoCapture(str(path))
    for _ in range(index):
        film.grab()
    found, image = film.read()
    return image.astype(np.uint8) if found else None


class Folder:
    """Output folder of images/ and masks/, with a record of what was written."""

    def __init__(self, path: Path):
        self.path, self._images, self._masks = path, path / "images", path / "masks"
        self.written = 0

    def write(self, name: str, image: NDArray[np.uint8], labels: NDArray[np.uint8]) -> None:
        """Write an image (h, w, 3) BGR and its classes (h, w)."""
        for folder in (self._images, self._masks):
            folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(self._images / f"{name}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        cv2.imwrite(str(self._masks / f"{name}.png"), labels)
        self.written += 1

    def name_sources(self, repositories: Iterable[clones.Repository]) -> None:
        """Write the sources of the photographs, for the cards of networks trained on them."""
        self.path.mkdir(parents=True, exist_ok=True)
        text = json.dumps([asdict(repository) for repository in repositories], indent=2)
        (self.path / recordings.SOURCES).write_text(text + "\n")

    def read(self, name: str) -> NDArray[np.uint8]:
        """Read a written image (h, w, 3) BGR."""
        image = cv2.imread(str(self._images / f"{name}.jpg"))
        assert image is not None
        return image.astype(np.uint8)


class Sources:
    """The tables of a folder, and the clones in another one. Raises OSError or TypeError if a table cannot be read."""

    def __init__(self, tables: Path, folder: Path):
        with (tables / "repositories.csv").open(newline="") as file:
            self._repositories = [clones.Repository(**row) for row in csv.DictReader(file)]
        with (tables / "pictures.csv").open(newline="") as file:
            self._pictures = [Picture(**row) for row in csv.DictReader(file)]
        self._masks = tables / "masks"
        self._folder = folder

    @property
    def missing(self) -> list[clones.Repository]:
        """The repositories without a clone."""
        return [repository for repository in self._repositories if not self.clone(repository.repository)]

    def cloned(self, names: Iterable[str]) -> list[clones.Repository]:
        """Those of these repositories that have clones, each once, in the order of the table."""
        wanted = set(names)
        return [one for one in self._repositories if one.repository in wanted and self.clone(one.repository)]

    def clone(self, repository: str) -> Path | None:
        """Path of a repository's clone, if it exists."""
        place = self._place(repository)
        return place if place.is_dir() else None

    def get(self, repository: clones.Repository, host: str) -> None:
        """Clone the used files of a repository. Raises CloneError."""
        listed = (picture.path for picture in self._pictures if picture.repository == repository.repository)
        paths = dict.fromkeys([*WHOLE.get(repository.repository, ()), *listed])
        repository.get(self._place(repository.repository), host, paths)

    def pictures(self, kind: str) -> list[Picture]:
        """The pictures of a kind that the clones should have."""
        return [picture for picture in self._pictures if picture.kind == kind and self.clone(picture.repository)]

    def read(self, picture: Picture) -> NDArray[np.uint8]:
        """A picture (h, w, 3) BGR. Raises DataError if the clone does not have it."""
        return picture.read(self._place(picture.repository))

    def mask(self, picture: Picture) -> NDArray[np.uint8]:
        """Classes (h, w) of a close picture. Raises DataError if there are none."""
        return read_mask(self._masks / f"{picture.name}.png")

    def _place(self, repository: str) -> Path:
        return self._folder / repository.split("/")[1]


def write_close(sources: Sources, out: Path) -> int:
    """Write the photographs for which the project has masks; returns their number."""
    folder = Folder(out)
    for picture in track(sources.pictures("close"), "close"):
        folder.write(picture.name, sources.read(picture), sources.mask(picture))
    folder.name_sources(sources.cloned(picture.repository for picture in sources.pictures("close")))
    return folder.written


def write_scenes(sources: Sources, out: Path) -> int:
    """Write photographs without people, and others with hands pasted in front of these; returns their number."""
    folder, rng = Folder(out), np.random.default_rng(SEED)
    for picture in track(sources.pictures("scene"), "scenes"):
        image = sources.read(picture)
        folder.write(picture.name, image, np.full(image.shape[:2], Label.BACKGROUND, np.uint8))
    if not folder.written:
        return 0
    hands = _hands(sources.clone(HANDS), rng)
    for index in track(range(COMPOSED), "hands"):
        cutouts = list(itertools.islice(hands, int(rng.integers(*HANDS_IN_A_SCENE, endpoint=True))))
        if not cutouts:
            break
        scene, labels = _empty(sources, folder, SCENE, rng)
        for cutout in cutouts:
            pasted.paste(scene, labels, cutout, pasted.from_side(cutout, *SCENE, rng), rng)
        folder.write(f"hands-{index:03d}", pasted.noisy(scene, rng), labels)
    for picture in track([picture for picture in sources.pictures("close") if picture.backdrop == "white"], "hands with things"):
        cutout = pasted.on_white(sources.read(picture), sources.mask(picture))
        size = round(SCENE[1] * int(picture.height) / int(picture.width)), SCENE[1]
        for index in range(REPEATS):
            scene, labels = _empty(sources, folder, size, rng)
            pasted.paste(scene, labels, cutout, pasted.filling(cutout, *size, rng), rng)
            folder.write(f"{picture.name}-{index}", pasted.noisy(scene, rng), labels)
    every = [*sources.pictures("scene"), *(picture for picture in sources.pictures("close") if picture.backdrop == "white")]
    folder.name_sources(sources.cloned([HANDS, *(picture.repository for picture in every)]))
    return folder.written


def _hands(clone: Path | None, rng: np.random.Generator) -> Iterator[pasted.Cutout]:
    """The hands of a clone of HANDS, if there is one, in random order, without those that cannot be cut out."""
    paths = sorted(clone.glob("Dataset/*/*.JPG")) if clone else []
    for index in rng.permutation(len(paths)):
        image = cv2.imread(str(paths[index]))
        cutout = None if image is None else pasted.hand(image.astype(np.uint8))
        if cutout:
            yield cutout


def _empty(
    sources: Sources, folder: Folder, size: tuple[int, int], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A part (h, w, 3) BGR of a random scene, mirrored at random, and its classes (h, w)."""
    scenes = sources.pictures("scene")
    image = folder.read(scenes[rng.integers(len(scenes))].name)
    scale = max(np.divide(size, image.shape[:2])) * rng.uniform(1.0, 1.4)
    shape = [max(math.ceil(scale * n), least) for n, least in zip(image.shape[:2], size, strict=True)]
    image = cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR).astype(np.uint8)
    top, left = (int(rng.integers(n - least + 1)) for n, least in zip(shape, size, strict=True))
    part = image[top : top + size[0], left : left + size[1]]
    return np.ascontiguousarray(part[:, :: rng.choice([-1, 1])]), np.full(size, Label.BACKGROUND, np.uint8)


@flags.command(
    "segmentation photographs",
    "Makes frames and masks for `penumbra segmentation train --data` from clones of public repositories.\n\n" + (__doc__ or ""),
    flags.Argument(
        "clones", type=Path, help="folder with the clones, each called as its repository; those that are not there are named"
    ),
    flags.Option(
        "--get",
        takes="maybe",
        without=clones.HOST,
        metavar="[URL]",
        help=f"clone what is not there, from URL/OWNER/NAME (without a value: {clones.HOST}/OWNER/NAME)",
    ),
    models.FOLDER,
    flags.Option("--tables", type=Path, default=Path("training/photographs"), help="the project's folder with tables and masks"),
    flags.Option("--out", type=flags.folder, default=Path("photographs"), help="folder to write street/, close/ and scenes/ to"),
    example="penumbra segmentation photographs clones --get",
)
def main(options: flags.Options) -> int:
    """Clone if asked to, then write the folders that the existing clones allow."""
    try:
        sources = Sources(options.tables, options.clones)
        for repository in track(sources.missing if options.get else (), "clones"):
            try:
                sources.get(repository, options.get)
            except clones.CloneError as error:
                _tell(str(error))
        if missing := ", ".join(repository.repository for repository in sources.missing):
            _tell(f"{options.clones}: expected clones of {missing} as well; what needs them is left out (--get clones them)")
        folders = {}
        people = sources.clone(STREET)
        if people:
            try:
                folders["street"] = street.write(people, Landmarks(options.models), options.out / "street")
                Folder(options.out / "street").name_sources(sources.cloned([STREET]))
            except ModelsError as error:
                _tell(f"street is left out: {error}")
        folders["close"] = write_close(sources, options.out / "close")
        folders["scenes"] = write_scenes(sources, options.out / "scenes")
    except (OSError, TypeError, ValueError) as error:
        _tell(str(error))
        return 2
    for name, written in folders.items():
        print(f"{options.out / name}: {written} photographs")
    return 0 if any(folders.values()) else 2


def _tell(text: str) -> None:
    print(f"penumbra segmentation photographs: {text}", file=sys.stderr)
