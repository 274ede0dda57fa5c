"""PredNet compiled by OpenVINO: the step of `prednet.PredNet` in less than half of torch's time.

It is compiled for every size of the picture apart: for all sizes at once a step takes two thirds longer, as little can be fused.
Compiling takes some tenths of a second, so the sizes that may come next are compiled ahead, in a thread of low priority. A size
that is not there yet is waited for: what comes out depends on pictures alone and not on time. Converting the network takes as
long again, so what comes of it can be kept in a file, in the folder PENUMBRA_CACHE or beside what Python keeps.
"""

from __future__ import annotations

import contextlib
import copy
import os
import tempfile
import threading
import warnings
from hashlib import blake2b
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from services.segmentation import prednet
from services.segmentation.prednet import PredNet, State

MOST = 16
"""Sizes that are kept, each some 17 MB."""


class Compiled:
    """One time step of a network for pictures of any size. `dtype`, bfloat16 or float32: of the state and the computation;
    `is_kept`: whether the converted network is kept in a file for the next start.

    Not for two threads at once: see `twin`. Raises ImportError where OpenVINO is not installed.
    """

    def __init__(self, net: PredNet, dtype: torch.dtype, is_kept: bool = False):
        import openvino

        self._ov = openvino
        self._net, self._dtype = net, dtype
        self._core = openvino.Core()
        self._type = openvino.Type.bf16 if dtype is torch.bfloat16 else openvino.Type.f32
        self._model = self._kept(net) if is_kept else self._convert(net)
        self._compiled: dict[tuple[int, int], Any] = {}
        self._requests: dict[tuple[int, int], Any] = {}
        self._asked: set[tuple[int, int]] = set()
        self._lock = threading.Lock()

    def twin(self) -> Compiled:
        """Another one of the same network, for another stream of pictures: what one compiles the other has."""
        twin = copy.copy(self)
        twin._requests = {}
        return twin

    def __call__(self, image: Tensor, state: State) -> tuple[Tensor, State]:
        """(class logits (1, classes, h, w) float32, new state) of an image (1, 3, h, w) in [0, 1] and the old state."""
        request = self._request(*image.shape[-2:])
        new = tuple(torch.empty_like(s, memory_format=torch.channels_last) for s in state)
        held = [_rows(t) for t in (image.to(self._dtype), *state)]
        for i, tensor in enumerate(held):
            request.set_input_tensor(i, self._tensor(tensor))
        for i, tensor in enumerate(new, 1):
            request.set_output_tensor(i, self._tensor(_rows(tensor)))
        request.infer()
        return torch.from_numpy(request.get_output_tensor(0).data.copy()), new

    def prepare(self, sizes: list[tuple[int, int]]) -> None:
        """Compile for pictures of these sizes (height, width) in the background, in this order: that of the next picture, and
        others that may follow."""
        fresh = [size for size in sizes if size not in self._asked]
        if fresh:
            self._asked.update(fresh)
            threading.Thread(target=self._compile_ahead, args=(fresh, fresh[0] == sizes[0]), name="compile").start()

    def is_prepared(self, size: tuple[int, int]) -> bool:
        """Whether a picture of this size (height, width) waits for nothing."""
        return size in self._compiled

    def _compile_ahead(self, sizes: list[tuple[int, int]], is_first_due: bool) -> None:
        if is_first_due:  # a frame may wait for it
            self._model_of(sizes[0])
        with contextlib.suppress(OSError, AttributeError):  # not everywhere has a thread a priority
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        for size in sizes:
            self._model_of(size)

    def _request(self, height: int, width: int) -> Any:
        size = height, width
        request = self._requests.pop(size, None)
        if request is None:
            request = self._model_of(size).create_infer_request()
            while len(self._requests) >= MOST:
                self._requests.pop(next(iter(self._requests)), None)
        self._requests[size] = request  # the last one used is the last to go
        return request

    def _model_of(self, size: tuple[int, int]) -> Any:
        with self._lock:
            model = self._compiled.pop(size, None)
            if model is None:
                model = self._compile(*size)
                while len(self._compiled) >= MOST:
                    self._compiled.pop(next(iter(self._compiled)))
            self._compiled[size] = model
            return model

    def _compile(self, height: int, width: int) -> Any:
        shapes = [s.shape for s in (torch.empty(1, 3, height, width), *self._net.initial_state(1, height, width))]
        model = self._model.clone()
        model.reshape({port: [1, h, w, c] for port, (_, c, h, w) in zip(model.inputs, shapes, strict=True)})
        settings = {
            "INFERENCE_NUM_THREADS": 1,
            "NUM_STREAMS": 1,
            "ENABLE_CPU_PINNING": False,  # two processes would be tied to the same core
            "INFERENCE_PRECISION_HINT": self._type.get_type_name(),
        }
        return self._core.compile_model(model, "CPU", settings)

    def _kept(self, net: PredNet) -> Any:
        """The network as OpenVINO's model: from its file, else converted, and put there where that can be written."""
        path = kept_at(net, self._dtype, self._ov.__version__)
        with contextlib.suppress(RuntimeError):  # none, or not one that can be read
            return self._core.read_model(path)
        model = self._convert(net)
        with contextlib.suppress(OSError, RuntimeError):
            path.parent.mkdir(exist_ok=True)
            with tempfile.TemporaryDirectory(dir=path.parent) as folder:
                fresh = Path(folder) / path.name
                self._ov.save_model(model, fresh, compress_to_fp16=False)
                for suffix in (".bin", ".xml"):  # whoever finds the second finds the first
                    fresh.with_suffix(suffix).replace(path.with_suffix(suffix))
        return model

    def _convert(self, net: PredNet) -> Any:
        """The network as OpenVINO's model; not by `openvino.convert_model`, which reports its use over the internet."""
        from openvino.frontend import FrontEndManager
        from openvino.frontend.pytorch.ts_decoder import TorchScriptPythonDecoder
        from openvino.preprocess import PrePostProcessor

        net = copy.deepcopy(net).float().eval()
        side = 4 * net.multiple
        inputs = [_rows(t) for t in (torch.zeros(1, 3, side, side), *net.initial_state(1, side, side))]
        with torch.inference_mode(), warnings.catch_warnings():
            # `torch.export`, which torch would rather have used, ties a model to one size of picture.
            warnings.simplefilter("ignore", DeprecationWarning)
            traced = torch.jit.trace(_Rows(net), inputs, check_trace=False)
        decoder = TorchScriptPythonDecoder(traced)
        frontend = FrontEndManager().load_by_framework("pytorch")
        model = frontend.convert(frontend.load(decoder))
        model.reshape({port: [1, -1, -1, t.shape[-1]] for port, t in zip(model.inputs, inputs, strict=True)})
        types = PrePostProcessor(model)
        for i in range(len(inputs)):
            types.input(i).tensor().set_element_type(self._type)
        for i in range(1, len(inputs)):
            types.output(i).tensor().set_element_type(self._type)
        return types.build()

    def _tensor(self, rows: Tensor) -> Any:
        """OpenVINO's view of a tensor's memory; numpy has no bfloat16, so it sees integers of its size."""
        memory = rows.view(torch.int16) if rows.dtype is torch.bfloat16 else rows
        return self._ov.Tensor(memory.numpy(), self._ov.Shape(list(rows.shape)), self._type)


def kept_at(net: PredNet, dtype: torch.dtype, version: str) -> Path:
    """The file of a converted network: another one for other weights, another computation, release or source."""
    digest = blake2b(f"{dtype} {version} {torch.__version__}".encode(), digest_size=8)
    for source in (__file__, prednet.__file__):
        digest.update(Path(source).read_bytes())
    for name, value in net.state_dict().items():
        digest.update(name.encode() + value.float().numpy().tobytes())
    folder = os.environ.get("PENUMBRA_CACHE") or Path(__file__).parent / "__pycache__"
    return Path(folder) / f"prednet-{digest.hexdigest()}.xml"


class _Rows(nn.Module):
    """The step with channels innermost, as the state lies in memory: nothing is reordered on its way in and out."""

    def __init__(self, net: PredNet):
        super().__init__()
        self.net = net

    def forward(self, image: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        logits, _, new = self.net(image.permute(0, 3, 1, 2), tuple(s.permute(0, 3, 1, 2) for s in state))
        return (logits, *(s.permute(0, 2, 3, 1) for s in new))


def _rows(tensor: Tensor) -> Tensor:
    """(1, c, h, w) as (1, h, w, c), contiguous; without a copy where channels are innermost."""
    return tensor.permute(0, 2, 3, 1).contiguous()
