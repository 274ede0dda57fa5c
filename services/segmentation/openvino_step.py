"""The network in OpenVINO, compiled from stored weights without torch or intermediate files.

It is compiled per picture size: a model for all sizes takes three quarters longer per step, as little can be fused. A size costs
some 0.13 s of the processor's time and 22 MB, so sizes that will soon be needed are compiled ahead, in a thread. A call waits for
a size that is not compiled yet, so that the output depends on pictures alone and not on timing.
"""

from __future__ import annotations

import copy
import threading
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from penumbra.services.segmentation.model import Model

Precision = Literal["f32", "bf16"]
State = tuple[NDArray[Any], ...]
"""State of the network: R_l of every layer and, with axonal delays, E_l after them. Each is (1, h, w, channels), float32 or
bfloat16. numpy has no bfloat16 and holds its bits as uint16; zero is zero in both."""

MOST = 12
"""Maximum number of compiled sizes; a minute of a moving arm needs seven to ten."""


class Compiled:
    """One time step of a network for pictures of any size. `precision`: of the state and of the computation.

    Not thread-safe: see `twin`. Raises ImportError if OpenVINO is not installed, ValueError if the weights do not match the
    settings.
    """

    def __init__(self, model: Model, precision: Precision):
        import openvino  # it starts a thread, and a process that will be forked must not have a second one

        from penumbra.services.segmentation import graph

        self._ov, self._graph = openvino, graph
        try:
            graph.step(model, model.settings.multiple, model.settings.multiple, precision)
        except (KeyError, RuntimeError) as error:
            raise ValueError(
                f"expected weights of {model.settings}, got others ({error}); use the weights that belong to the card, "
                "and train again what an earlier release has trained"
            ) from None
        self._core, self._type = openvino.Core(), getattr(openvino.Type, precision)
        self._model, self._precision = model, precision
        self._dtype = np.dtype(np.uint16 if precision == "bf16" else np.float32)
        self._compiled: dict[tuple[int, int], Any] = {}
        self._requests: dict[tuple[int, int], Any] = {}
        self._pending: set[tuple[int, int]] = set()
        self._lock = threading.Lock()

    def twin(self) -> Compiled:
        """Another instance of the same network, for another stream of pictures; the two share compiled models."""
        twin = copy.copy(self)
        twin._requests = {}
        return twin

    def initial_state(self, height: int, width: int) -> State:
        """The zero state, for pictures of this size. Raises ValueError if the size does not fit."""
        sizes, channels = self._model.settings.state_sizes(height, width), self._model.state_channels
        return tuple(np.zeros((1, *size, c), self._dtype) for size, c in zip(sizes, channels, strict=True))

    def __call__(
        self, image: NDArray[np.float32], state: State, priors: NDArray[np.float32] | None = None
    ) -> tuple[NDArray[np.float32], State]:
        """(class logits (classes, h, w), new state) of an image (h, w, channels) in [0, 1], the old state and, for a network with
        priors, the priors (h, w, priors) in [-1, 1] or None. The logits are OpenVINO's memory, which the next call overwrites."""
        request = self._request(*image.shape[:2])
        new = tuple(np.empty_like(tensor) for tensor in state)
        request.set_input_tensor(0, self._ov.Tensor(image[None]))
        for i, (before, after) in enumerate(zip(state, new, strict=True), 1):
            request.set_input_tensor(i, self._tensor(before))
            request.set_output_tensor(i, self._tensor(after))
        if count := self._model.settings.priors:
            if priors is None:
                priors = np.zeros((*image.shape[:2], count), np.float32)
            request.set_input_tensor(1 + len(state), self._ov.Tensor(priors[None]))
        request.infer()
        logits: NDArray[np.float32] = request.get_output_tensor(0).data[0]
        return logits, new

    def prepare(self, sizes: list[tuple[int, int]]) -> None:
        """Compile for pictures of these sizes (height, width) in the background, in this order."""
        with self._lock:
            fresh = [size for size in sizes if size not in self._compiled and size not in self._pending]
            self._pending.update(fresh)
        if fresh:
            threading.Thread(target=self._compile_ahead, args=(fresh,), name="compile").start()

    def is_prepared(self, size: tuple[int, int]) -> bool:
        """Whether the model for pictures of this size (height, width) is compiled."""
        return size in self._compiled

    def _compile_ahead(self, sizes: list[tuple[int, int]]) -> None:
        for size in sizes:
            self._model_of(size)

    def _request(self, height: int, width: int) -> Any:
        size = height, width
        request = self._requests.pop(size, None)
        if request is None:
            request = self._model_of(size).create_infer_request()
            while len(self._requests) >= MOST:
                self._requests.pop(next(iter(self._requests)), None)
        self._requests[size] = request  # dictionary order: the least recently used one goes first
        return request

    def _model_of(self, size: tuple[int, int]) -> Any:
        with self._lock:
            model = self._compiled.pop(size, None)
            if model is None:
                model = self._compile(*size)
                while len(self._compiled) >= MOST:
                    self._compiled.pop(next(iter(self._compiled)))
            self._compiled[size] = model
            self._pending.discard(size)
            return model

    def _compile(self, height: int, width: int) -> Any:
        settings = {
            "INFERENCE_NUM_THREADS": 1,
            "NUM_STREAMS": 0,  # compute in the caller's thread: two more threads per size would only wait
            "ENABLE_CPU_PINNING": False,  # pinning would tie two processes to the same core
            "INFERENCE_PRECISION_HINT": self._precision,
        }
        return self._core.compile_model(self._graph.step(self._model, height, width, self._precision), "CPU", settings)

    def _tensor(self, array: NDArray[Any]) -> Any:
        """OpenVINO's view of an array's memory."""
        return self._ov.Tensor(array, self._ov.Shape(array.shape), self._type)
