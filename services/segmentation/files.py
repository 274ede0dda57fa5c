"""`penumbra segmentation infer`: masks and overlays of picture and film files.

A film's frames, and with --sequence the given pictures, are processed in order, and the network's state is passed on. Other
pictures are independent: each is shown SETTLE times, as the network needs some frames to settle.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from penumbra.services import flags
from penumbra.services.segmentation import inference
from penumbra.shared.contract.labels import COLOURS, TARGET_LABELS, Label
from penumbra.shared.perception.lookout import STEP, Window, reduced, whole_frame

SETTLE = 4
"""Number of times that a picture without a predecessor is shown to the network. Chosen, not measured."""
PERIOD_NS = 50_000_000
"""Time [ns] between pictures without stamps: that of the cameras for which the network is trained."""


class FileError(ValueError):
    """A file that cannot be read or written. The text says which, what was expected and what to do."""


@flags.command(
    "segmentation infer",
    "Writes masks and overlays of pictures and films. For NAME.png: NAME_mask.png, one channel of class indices ("
    + ", ".join(f"{label.value} {label.name.lower()}" for label in Label)
    + "), and NAME_overlay.png; for a film NAME.mp4: a mask a frame in NAME_masks/ and NAME_overlay.mp4.",
    flags.Argument("files", type=Path, nargs=-1, required=True, metavar="IMAGE|VIDEO...", help="what is looked at"),
    flags.Option("--out", type=flags.folder, default=Path("masks"), help="folder to write to"),
    flags.Option("--weights", type=Path, default=inference.WEIGHTS, show_default="the committed one", help="the network"),
    flags.Option("--sequence", is_flag=True, help="the pictures are frames of one film, in this order"),
    flags.Option(
        "--scale",
        choices=("1", "2", "4", "8"),
        show_default="as the service at a whole frame, 2 at 640 x 480",
        help="average squares of so many pixels a side first",
    ),
    example="penumbra segmentation infer arm.png film.mp4 --out masks",
)
def main(options: flags.Options) -> int:
    """Write the masks; returns 2 if a file cannot be read."""
    scale = int(options.scale) if options.scale else None
    try:
        check_names(options.files)
        options.out.mkdir(parents=True, exist_ok=True)
        segmenter = inference.load_segmenter(options.weights)
        stamp_ns = 0
        for path in options.files:
            if is_picture(path):
                image = read(path)
                if not options.sequence:
                    stamp_ns += 2 * round(inference.MAX_GAP_S * 1e9)  # long enough that the previous picture is forgotten
                for _ in range(1 if options.sequence else SETTLE):
                    stamp_ns += PERIOD_NS
                    mask = whole_mask(segmenter, image, scale, stamp_ns)
                write(options.out / f"{path.stem}_mask.png", mask)
                write(options.out / f"{path.stem}_overlay.png", overlay(image, mask)[..., ::-1])
            else:
                stamp_ns += 2 * round(inference.MAX_GAP_S * 1e9)
                stamp_ns = film(segmenter, path, options.out, scale, stamp_ns)
    except (FileError, FileNotFoundError) as error:
        print(f"penumbra segmentation infer: {error}", file=sys.stderr)
        return 2
    print(f"{len(options.files)} masked: {options.out}")
    return 0


def check_names(paths: Sequence[Path]) -> None:
    """Raise FileError if one file's output would overwrite another's."""
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise FileError(
            f"expected files of different names, got {twice} twice; run the command once per file, with an --out each"
        )


def is_picture(path: Path) -> bool:
    """Whether a file is a picture; otherwise it may be a film. Raises FileNotFoundError."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a picture or a film, found no file")
    return bool(cv2.haveImageReader(str(path)))


def read(path: Path) -> NDArray[np.uint8]:
    """An RGB image (h, w, 3)."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise FileError(f"{path}: expected a picture, got a file that begins as one but cannot be read; check that it is whole")
    return np.ascontiguousarray(image[..., ::-1]).astype(np.uint8)


def film(segmenter: inference.Segmenter, path: Path, out: Path, scale: int | None, stamp_ns: int) -> int:
    """Write masks and overlay of a film; returns the stamp of its last frame. Raises FileError."""
    source = cv2.VideoCapture(str(path))
    rate = source.get(cv2.CAP_PROP_FPS) or 1e9 / PERIOD_NS
    count = max(int(source.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
    folder, target = out / f"{path.stem}_masks", out / f"{path.stem}_overlay.mp4"
    writer: cv2.VideoWriter | None = None
    for index, image in enumerate(track(frames(source), path.name, total=count or None, transient=True)):
        stamp_ns += PERIOD_NS
        mask = whole_mask(segmenter, image, scale, stamp_ns)
        if writer is None:
            folder.mkdir(exist_ok=True)
            size = (image.shape[1], image.shape[0])
            writer = cv2.VideoWriter(str(target), cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
            if not writer.isOpened():
                raise FileError(f"{target}: OpenCV cannot write films here: give it pictures")
        write(folder / f"{index:06d}.png", mask)
        writer.write(np.ascontiguousarray(overlay(image, mask)[..., ::-1]))
    if writer is None:
        raise FileError(f"{path}: expected a picture or a film, got a file of which OpenCV reads no frame")
    writer.release()
    return stamp_ns


def frames(source: cv2.VideoCapture) -> Iterator[NDArray[np.uint8]]:
    """The RGB frames (h, w, 3) of a film."""
    while True:
        there, image = source.read()
        if not there:
            return
        yield np.ascontiguousarray(image[..., ::-1]).astype(np.uint8)


def whole_mask(segmenter: inference.Segmenter, image: NDArray[np.uint8], scale: int | None, stamp_ns: int) -> NDArray[np.uint8]:
    """Classes (h, w) of a whole image (h, w, 3), as the service computes them without a known pose; remaining pixels at the
    edges, fewer than the scale, are background. Raises FileError if the image is too small for the network."""
    height, width = image.shape[:2]
    picture = Window(0, 0, width, height)
    window = whole_frame(picture) if scale is None else reduced(picture, scale)
    if min(width, height) < (least := STEP * window.scale):
        raise FileError(f"expected a picture of at least {least} x {least} pixels, got {width} x {height}")
    labels = segmenter(image, window, stamp_ns)
    mask = np.full((height, width), Label.BACKGROUND, np.uint8)
    mask[: window.bottom, : window.right] = labels.repeat(window.scale, axis=0).repeat(window.scale, axis=1)
    return mask


def overlay(image: NDArray[np.uint8], mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image (h, w, 3) with every class except background in its colour, and the target's contour in white."""
    colours = image.copy()
    for label, colour in COLOURS.items():
        colours[mask == label] = colour
    blended = (image // 2 + colours // 2).astype(np.uint8)
    blended[mask == Label.BACKGROUND] = image[mask == Label.BACKGROUND]
    target = np.isin(mask, TARGET_LABELS).astype(np.uint8)
    contours, _ = cv2.findContours(target, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(blended, contours, -1, (255, 255, 255), 1), np.uint8)


def write(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a picture file of one channel, or of blue, green, red. Raises FileError."""
    if not cv2.imwrite(str(path), image):
        raise FileError(f"{path}: cannot be written")
