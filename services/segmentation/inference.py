"""Inference: frames and windows in, masks out; the recurrent state kept between them."""

from __future__ import annotations

import copy
import functools
import logging
import time
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from services.segmentation import prednet
from services.segmentation.openvino_step import Compiled
from services.segmentation.prednet import PredNet, State
from services.segmentation.shift import shift_state
from shared.contract.labels import TARGET_LABELS, Label
from shared.perception.lookout import MAX_PIXELS, SIZE_STEP, Window

log = logging.getLogger("penumbra.segmentation")

WEIGHTS = Path(__file__).parent / "weights" / "prednet.npz"
MAX_GAP_S = 0.5
"""After a longer silence the picture has little to do with what the state remembers."""


class Segmenter:
    """Masks of one camera's frames, in order. `offset`: added to the logits of forearm and hand, calibrated so that their masks
    are on average as large as they should be (the search would take a mask too large for an arm too near). `is_kept`: as in
    `Compiled`."""

    def __init__(self, net: PredNet, offset: float = 0.0, dtype: torch.dtype | None = None, is_kept: bool = False):
        self._dtype = fastest_dtype() if dtype is None else dtype
        self._compiled = _compiled(net, self._dtype, is_kept)
        self._net = net.to(self._dtype).eval()
        self._offset = torch.zeros(1, len(Label), 1, 1)
        self._offset[:, list(TARGET_LABELS)] = offset
        self._state: State | None = None
        self._window: Window | None = None
        self._stamp_ns = 0

    def __call__(self, image: NDArray[np.uint8], window: Window, stamp_ns: int) -> NDArray[np.uint8]:
        """Class indices (window.height, window.width) uint8 of a window of an RGB image (h, w, 3) uint8, exposed at `stamp_ns`.

        The state is forgotten where the scale changes, time stands, goes back or jumps by more than MAX_GAP_S.
        Raises ValueError where the window does not lie in the image.
        """
        with torch.inference_mode():
            picture = cut(image, window).to(self._dtype)
            state = self._remembered(window, stamp_ns)
            if self._compiled:
                logits, self._state = self._compiled(picture, state)
            else:
                logits, _, self._state = self._net(picture, state)
            self._window, self._stamp_ns = window, stamp_ns
            return classes((logits.float() + self._offset)[0])

    def twin(self) -> Segmenter:
        """Another one of the same network, for another camera: what one has compiled the other need not."""
        twin = copy.copy(self)
        twin._state, twin._window, twin._stamp_ns = None, None, 0
        twin._compiled = self._compiled.twin() if self._compiled else None
        return twin

    def prepare(self, window: Window) -> None:
        """Make ready, in the background, for windows of this size and, one after another, of the sizes that may follow."""
        if self._compiled:
            steps = ((0, 0), (0, SIZE_STEP), (0, -SIZE_STEP), (SIZE_STEP, 0), (-SIZE_STEP, 0))
            sizes = [(window.height + dy, window.width + dx) for dx, dy in steps]
            around = [(h, w) for h, w in sizes[1:] if min(h, w) >= SIZE_STEP and h * w <= MAX_PIXELS]
            self._compiled.prepare([sizes[0], *around])

    def is_prepared(self, window: Window) -> bool:
        """Whether a window of this size waits for nothing."""
        return self._compiled is None or self._compiled.is_prepared((window.height, window.width))

    def _remembered(self, window: Window, stamp_ns: int) -> State:
        follows = 0 < stamp_ns - self._stamp_ns <= MAX_GAP_S * 1e9
        if self._state is None or self._window is None or self._window.scale != window.scale or not follows:
            return self._net.initial_state(1, window.height, window.width)
        if self._window == window:
            return self._state
        return shift_state(self._state, self._net.strides, self._window, window)


def classes(logits: torch.Tensor) -> NDArray[np.uint8]:
    """The index (h, w) of the greatest of logits (classes, h, w), of equal ones the first; in a tenth of the time of
    torch's argmax."""
    greatest, index = logits[0], torch.zeros(logits.shape[1:], dtype=torch.uint8)
    for k in range(1, len(logits)):
        index.masked_fill_(logits[k] > greatest, k)
        greatest = torch.maximum(greatest, logits[k])
    return index.numpy()


def _compiled(net: PredNet, dtype: torch.dtype, is_kept: bool) -> Compiled | None:
    try:
        return Compiled(net, dtype, is_kept)
    except ImportError:
        log.info("OpenVINO is not installed: torch takes more than twice as long for a frame")
        return None


def cut(image: NDArray[np.uint8], window: Window) -> torch.Tensor:
    """The window (1, 3, height, width) in [0, 1] of an RGB image (h, w, 3) uint8; at scales above 1 their means."""
    if min(window.x0, window.y0) < 0 or window.bottom > image.shape[0] or window.right > image.shape[1]:
        raise ValueError(f"a window inside the image of {image.shape[1]} x {image.shape[0]} expected, {window} came")
    part = image[window.y0 : window.bottom, window.x0 : window.right].copy()  # messages are read-only, torch wants to write
    picture = torch.from_numpy(part).permute(2, 0, 1)[None].float() / 255.0  # channels_last, as the image is
    return picture if window.scale == 1 else F.avg_pool2d(picture, window.scale)


def load_segmenter(path: Path = WEIGHTS, dtype: torch.dtype | None = None) -> Segmenter:
    """A segmenter of a weights file with its card. Raises FileNotFoundError that says how to make one."""
    if not path.is_file():
        raise FileNotFoundError(f"no weights {path}: make them with `penumbra segmentation train --out {path}`")
    return _loaded(path, path.stat().st_mtime_ns, dtype).twin()


@functools.lru_cache(maxsize=1)
def _loaded(path: Path, changed_ns: int, dtype: torch.dtype | None) -> Segmenter:
    net, card = prednet.load(path)
    return Segmenter(net, float(card["calibration"]["target_logit_offset"]), dtype, is_kept=True)


def fastest_dtype() -> torch.dtype:
    """bfloat16 where the processor computes in it: a third faster and, in the mask, no different. Else float32."""
    able = torch.cpu.get_capabilities()
    return torch.bfloat16 if able.get("avx512_bf16") or able.get("amx_bf16") else torch.float32


def speed(segmenter: Segmenter, width: int, height: int, frames: int = 30) -> dict[str, float]:
    """Milliseconds a frame of a window of this size on random pixels, on one thread: median of the processor's time and of the
    clock's, which is longer where others want the processor too."""
    image = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    window = Window(0, 0, width, height)
    times = []
    for i in range(frames + 5):  # the first frames compile, choose kernels and fill caches
        begin = time.process_time(), time.perf_counter()
        segmenter(image, window, (i + 1) * 50_000_000)
        times.append((time.process_time() - begin[0], time.perf_counter() - begin[1]))
    cpu, wall = 1e3 * np.median(times[5:], axis=0)
    return {"cpu_ms": round(float(cpu), 2), "wall_ms": round(float(wall), 2)}
