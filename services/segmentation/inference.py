"""Inference: masks from frames and windows, with the recurrent state kept between frames."""

from __future__ import annotations

import copy
import functools
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from penumbra.services.segmentation import model
from penumbra.services.segmentation.classes import classes
from penumbra.services.segmentation.colours import Colours
from penumbra.services.segmentation.model import Model
from penumbra.services.segmentation.openvino_step import Compiled, Precision, State
from penumbra.services.segmentation.shift import shift_state
from penumbra.shared.contract.labels import TARGET_LABELS
from penumbra.shared.native import processor
from penumbra.shared.perception.lookout import MAX_PIXELS, Window

WEIGHTS = Path(__file__).parent / "weights" / "prednet.npz"
MAX_GAP_S = 0.5
"""Maximum gap [s] between frames across which the recurrent state is kept: after a longer one it has little to do with the
picture. Chosen, not measured."""
FEWEST_PIXELS = 112 * 112
"""Minimum size of a window [px], even on a slower machine: an arm fills too few pixels of a smaller one."""


class Segmenter:
    """Masks of one camera's frames, in order. `offset`: added to the logits of forearm and hand, calibrated so that their masks
    have the right size on average (the search would mistake a too large mask for a closer arm). `precision`: of the computation,
    by default the fastest of this processor; masks differ by rounding only. `has_colours`: whether the picture's colours are used
    beside the network (`colours.py`)."""

    def __init__(self, network: Model, offset: float = 0.0, precision: Precision | None = None, has_colours: bool = True):
        self._compiled = Compiled(network, precision or ("bf16" if processor.has_bfloat16() else "f32"))
        self._strides, self._multiple, self._offset = network.settings.strides, network.settings.multiple, np.float32(offset)
        self._has_priors = network.settings.priors > 0
        self._colours = Colours() if has_colours else None
        self._state: State | None = None
        self._window: Window | None = None
        self._stamp_ns = 0

    @property
    def has_priors(self) -> bool:
        """Whether the network uses priors."""
        return self._has_priors

    def __call__(
        self, image: NDArray[np.uint8], window: Window, stamp_ns: int, priors: NDArray[np.float32] | None = None
    ) -> NDArray[np.uint8]:
        """Class indices (window.height, window.width) uint8 of a window of an RGB image (h, w, 3) uint8, exposed at `stamp_ns`.
        priors (window.height, window.width, 2): see `model.PRIORS`, None if there are none.

        A window whose size does not fit the network is padded at the right and lower edge. The state is reset if the scale
        changes; the state and the colours are reset if time stands still, goes back or jumps by more than MAX_GAP_S. Raises
        ValueError if the window does not lie in the image.
        """
        picture, elapsed_s = cut(image, window), (stamp_ns - self._stamp_ns) * 1e-9
        if not 0.0 < elapsed_s <= MAX_GAP_S:
            self._forget()
            elapsed_s = 0.0  # nothing is remembered
        seen = self._seen(window)
        known = None if priors is None else _continued(priors, seen)
        logits, self._state = self._compiled(_continued(picture, seen), self._remembered(seen), known)
        self._window, self._stamp_ns = seen, stamp_ns
        if seen != window:
            logits = np.ascontiguousarray(logits[:, : window.height, : window.width])
        for label in TARGET_LABELS:
            logits[label] += self._offset
        if self._colours is None:
            return classes(logits)
        return self._colours.classes(np.rint(255.0 * picture).astype(np.uint8), logits, elapsed_s)

    def twin(self) -> Segmenter:
        """Another segmenter of the same network, for another camera; the two share compiled models."""
        twin = copy.copy(self)
        twin._stamp_ns, twin._colours = 0, Colours() if self._colours is not None else None
        twin._forget()
        twin._compiled = self._compiled.twin()
        return twin

    def prepare(self, *windows: Window) -> None:
        """Compile for windows of these sizes in the background, in order."""
        self._compiled.prepare([(seen.height, seen.width) for seen in map(self._seen, windows)])

    def is_prepared(self, window: Window) -> bool:
        """Whether the model for a window of this size is compiled."""
        seen = self._seen(window)
        return self._compiled.is_prepared((seen.height, seen.width))

    def _seen(self, window: Window) -> Window:
        """The window padded to a size that fits the network."""
        height, width = (-(-n // self._multiple) * self._multiple for n in (window.height, window.width))
        return replace(window, height=height, width=width)

    def _forget(self) -> None:
        self._state = self._window = None
        if self._colours is not None:
            self._colours.forget()

    def _remembered(self, window: Window) -> State:
        if self._state is None or self._window is None or self._window.scale != window.scale:
            return self._compiled.initial_state(window.height, window.width)
        if self._window == window:
            return self._state
        return shift_state(self._state, self._strides, self._window, window)


def _continued(picture: NDArray[np.float32], window: Window) -> NDArray[np.float32]:
    """A picture (h, w, channels) padded to a window with the same origin by repeating its last pixels."""
    below, beside = window.height - picture.shape[0], window.width - picture.shape[1]
    return np.pad(picture, ((0, below), (0, beside), (0, 0)), "edge") if below or beside else picture


def cut(image: NDArray[np.uint8], window: Window) -> NDArray[np.float32]:
    """The window (height, width, 3) in [0, 1] of an RGB image (h, w, 3) uint8; at scales above 1, means of pixels."""
    if min(window.x0, window.y0) < 0 or window.bottom > image.shape[0] or window.right > image.shape[1]:
        raise ValueError(f"expected a window inside the image of {image.shape[1]} x {image.shape[0]}, got {window}")
    part = image[window.y0 : window.bottom, window.x0 : window.right]
    if window.scale == 1:
        return np.divide(part, np.float32(255.0), dtype=np.float32)
    rows = part[:: window.scale].astype(np.uint16)
    for k in range(1, window.scale):
        rows += part[k :: window.scale]
    sums = rows[:, :: window.scale].astype(np.float32)
    for k in range(1, window.scale):
        sums += rows[:, k :: window.scale]
    return np.divide(sums, np.float32(255.0 * window.scale**2))


def load_segmenter(path: Path = WEIGHTS, precision: Precision | None = None) -> Segmenter:
    """A segmenter from a weights file and its card. Raises FileNotFoundError that says how to make one."""
    if not path.is_file():
        raise FileNotFoundError(f"no weights {path}: make them with `penumbra segmentation train --out {path}`")
    card = path.with_suffix(".json")
    if not card.is_file():
        raise FileNotFoundError(
            f"{path}: expected weights (.npz) with their card {card.name} beside them, got no card; copy both files"
        )
    return _loaded(path, path.stat().st_mtime_ns, precision).twin()


@functools.lru_cache(maxsize=1)
def _loaded(path: Path, changed_ns: int, precision: Precision | None) -> Segmenter:
    network, card = model.load(path)
    return Segmenter(network, float(card["calibration"]["target_logit_offset"]), precision)


def affordable(segmenter: Segmenter, tried: Window, step_s: float) -> int:
    """Number of pixels of a window that takes step_s on one thread of this processor, within FEWEST_PIXELS and
    lookout.MAX_PIXELS. tried: the window used for the measurement, preferably the first one to be segmented, since it is compiled
    here."""
    ms = speed(segmenter, tried.width, tried.height, frames=3, unused=1)["cpu_ms"]
    pixels = tried.width * tried.height * 1e3 * step_s / ms
    return round(min(max(pixels, FEWEST_PIXELS), MAX_PIXELS))


def speed(segmenter: Segmenter, width: int, height: int, frames: int = 30, unused: int = 5) -> dict[str, float]:
    """Milliseconds per frame of a window of this size on random pixels, on one thread: median of the processor's time and of the
    wall time, which is longer if other processes use the processor. unused: number of frames before these, the first of which
    compiles."""
    image = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    window = Window(0, 0, width, height)
    times = []
    for i in range(unused + frames):
        begin = time.process_time(), time.perf_counter()
        segmenter(image, window, (i + 1) * 50_000_000)
        times.append((time.process_time() - begin[0], time.perf_counter() - begin[1]))
    cpu, wall = 1e3 * np.median(times[unused:], axis=0)
    return {"cpu_ms": round(float(cpu), 2), "wall_ms": round(float(wall), 2)}
