"""Every message that crosses the bus, and its wire format.

A message is a frozen dataclass; on the wire it is a MessagePack map of its fields, an array being `[dtype, shape, bytes]`, led by
the `version` of this format. `decode` believes nothing: it checks size, version, type, shape, dtype, finiteness and stamp, and
says what it expected and what came.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import struct
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import msgpack
import numpy as np

VERSION = 1
"""Of the wire format: it counts up with every change of a message's fields or of their meaning. Every version keeps it under
`version` in a map, so that also a reader of another one can tell what came."""
MAX_FUTURE_S = 0.5
"""A stamp further ahead of the reader's clock than this is refused: clocks of one cell are kept closer than that."""
MAX_PAST_S = 5.0
"""A stamp older than this is refused, where a topic says nothing else: after a network cut the backlog arrives late and says
nothing about now."""


class BadMessage(ValueError):
    """A message that was refused. `kind` groups equal faults, so that each is logged once."""

    def __init__(self, kind: str, text: str):
        super().__init__(text)
        self.kind = kind


LARGEST = 1e12
"""No quantity of a cell is larger in SI units, and its square is still finite."""
UNIT_TOLERANCE = 1e-3
"""How far the norm of a quaternion may be from one."""
ROUNDING = 1e-6
"""What shares and matrices may be off by rounding, relative."""
LARGE = 65_536
"""Bytes of an array from which it is worth while not to copy it twice."""
BIN32 = 0xC6
"""MessagePack's head of bytes with their number in 32 bits."""
_STRUCTURE = {"max_array_len": 16, "max_map_len": 32, "max_str_len": 256, "max_ext_len": 0}
"""What MessagePack may hold: more than any message needs, less than fills a memory."""


@dataclass(frozen=True)
class _ArraySpec:
    dtype: str
    shape: tuple[int | None, ...]  # None: any positive length
    check: Callable[[np.ndarray], str | None] | None = None  # what else is wrong with the values

    @functools.cached_property
    def numpy(self) -> np.dtype:
        return np.dtype(self.dtype)


def _array(dtype: str, *shape: int | None, check: Callable[[np.ndarray], str | None] | None = None) -> Any:
    return field(metadata={"array": _ArraySpec(dtype, shape, check)})


def _quaternion() -> Any:
    return _array("float64", 4, check=_not_unit)


def _covariance() -> Any:
    """Also an information matrix: symmetric and not negative in any direction."""
    return _array("float64", 6, 6, check=_not_semidefinite)


def _not_unit(value: np.ndarray) -> str | None:
    norm = float(np.sqrt(value @ value))
    return None if abs(norm - 1) <= UNIT_TOLERANCE else f"a unit quaternion expected, one of norm {norm:.4g} came"


def _not_semidefinite(value: np.ndarray) -> str | None:
    tolerance = ROUNDING * float(np.abs(value).max())
    if np.abs(value - value.T).max() > tolerance:
        return "a symmetric matrix expected, one with different halves came"
    lowest = float(np.linalg.eigvalsh(value)[0])
    return None if lowest >= -tolerance else f"a matrix without negative eigenvalues expected, one with {lowest:.4g} came"


def _choice(*values: str) -> Any:
    return field(metadata={"choice": values})


def _within(low: float, high: float) -> Any:
    return field(metadata={"within": (low, high)})


def _share() -> Any:
    return _within(-ROUNDING, 1 + ROUNDING)


@dataclass(frozen=True, kw_only=True)
class Message:
    """What all messages share. `stamp_ns`: time of the measurement (not of its publication), nanoseconds since the epoch."""

    MAX_BYTES: typing.ClassVar[int] = 65_536
    stamp_ns: int


@dataclass(frozen=True, kw_only=True)
class Frame(Message):
    """One camera image, row-major RGB, pixel centres at integer coordinates."""

    MAX_BYTES: typing.ClassVar[int] = 64_000_000
    image: np.ndarray = _array("uint8", None, None, 3)


@dataclass(frozen=True, kw_only=True)
class Mask(Message):
    """Class indices (`shared.classes`) of a window of a frame. Mask pixel (r, c) covers `scale` x `scale` image pixels whose
    first is (y0 + r * scale, x0 + c * scale); outside the window nothing is known."""

    MAX_BYTES: typing.ClassVar[int] = 32_000_000
    labels: np.ndarray = _array("uint8", None, None)
    x0: int = _within(-8192, 8192)
    y0: int = _within(-8192, 8192)
    scale: int = _within(1, 64)


@dataclass(frozen=True, kw_only=True)
class Joints(Message):
    """Joint angles [rad] in the order of the robot description."""

    position: np.ndarray = _array("float64", None)


@dataclass(frozen=True, kw_only=True)
class Voltages(Message):
    """Electrode amplitudes [V] of one pad, oldest row first; `stamp_ns` belongs to the last row."""

    period_ns: int = _within(1, 1_000_000_000)
    volts: np.ndarray = _array("float32", None, None)  # (samples, electrodes)


@dataclass(frozen=True, kw_only=True)
class VisionPose(Message):
    """What the camera says. `overlap` in [0, 1] over the pixels that are scored; `hidden`: share of the target's pixels
    that something covers; `state`: tracking, occluded (too little is seen: do not use) or lost."""

    target: str
    camera: str
    frame: str
    position: np.ndarray = _array("float64", 3)
    orientation: np.ndarray = _quaternion()
    covariance: np.ndarray = _covariance()
    overlap: float = _share()
    hidden: float = _share()
    state: str = _choice("tracking", "occluded", "lost")


@dataclass(frozen=True, kw_only=True)
class HapticPose(Message):
    """What the skin says. `information` (6 x 6, inverse covariance) is zero along directions that it does not observe.
    `stamp_ns` is the time that the pose belongs to, `sample_stamp_ns` that of the newest voltage sample in it."""

    target: str
    frame: str
    sample_stamp_ns: int
    position: np.ndarray = _array("float64", 3)
    orientation: np.ndarray = _quaternion()
    information: np.ndarray = _covariance()
    gap: float = _within(-LARGEST, LARGEST)
    state: str = _choice("in_range", "out_of_range")


@dataclass(frozen=True)
class Source:
    """One sense as the observer sees it: age of its last accepted measurement [s] and its share of the information in use."""

    age_s: float
    weight: float


@dataclass(frozen=True, kw_only=True)
class FusedPose(Message):
    """The one pose. `velocity`: linear [m/s] and angular [rad/s] along the frame's axes. `sources` by name (vision, haptic);
    a sense that was never heard is absent."""

    target: str
    frame: str
    position: np.ndarray = _array("float64", 3)
    orientation: np.ndarray = _quaternion()
    velocity: np.ndarray = _array("float64", 6)
    covariance: np.ndarray = _covariance()
    state: str = _choice("tracking", "coasting", "lost")
    sources: dict[str, Source]


@dataclass(frozen=True, kw_only=True)
class Truth(Message):
    """What the emulator knows. `hidden`: share of the target's pixels covered in the last frame; `gap`: smallest distance
    from an electrode to the target's skin [m]."""

    target: str
    frame: str
    position: np.ndarray = _array("float64", 3)
    orientation: np.ndarray = _quaternion()
    velocity: np.ndarray = _array("float64", 6)
    hidden: float = _share()
    gap: float = _within(-LARGEST, LARGEST)


M = typing.TypeVar("M", bound=Message)
Fields = tuple[tuple[str, Any, typing.Mapping[str, Any]], ...]


def _read_fields(kind: Any) -> Fields:
    """Name, type and metadata of each field of a message class."""
    hints = typing.get_type_hints(kind)
    return tuple((f.name, hints[f.name], f.metadata) for f in dataclasses.fields(kind))


_fields = typing.cast(Callable[[type[Message]], Fields], functools.cache(_read_fields))


def _read_names(kind: Any) -> frozenset[str]:
    return frozenset(field.name for field in dataclasses.fields(kind))


_field_names = typing.cast(Callable[[type[Message]], frozenset[str]], functools.cache(_read_names))


@functools.cache
def _dtype_name(dtype: np.dtype) -> str:
    """numpy puts the name together anew each time, which takes longer than the rest of an array."""
    return dtype.name


def encode(message: Message) -> bytes:
    """The MessagePack bytes of a message. Raises BadMessage where an array has not the declared dtype and shape."""
    out: dict[str, Any] = {"version": VERSION}
    large = False
    for name, _, metadata in _fields(type(message)):
        value = getattr(message, name)
        spec = metadata.get("array")
        if spec is not None:
            value = np.ascontiguousarray(value)
            dtype = _dtype_name(value.dtype)
            _check_array(name, spec, dtype, value.shape)
            out[name] = [dtype, value.shape, value.data.cast("B")]  # a view: nothing is copied yet
            large |= value.nbytes >= LARGE
        elif isinstance(value, dict):
            out[name] = {key: dict(vars(item)) for key, item in value.items()}
        elif isinstance(value, np.generic):
            out[name] = value.item()
        else:
            out[name] = value
    return b"".join(_pieces(out)) if large else msgpack.packb(out)


def _pieces(fields: dict[str, Any]) -> Iterator[bytes | memoryview]:
    """What MessagePack makes of a message's fields, with the bytes of arrays as they are: `packb` would copy them twice."""
    packer = msgpack.Packer()
    yield packer.pack_map_header(len(fields))
    for name, value in fields.items():
        yield packer.pack(name)
        if isinstance(value, list):
            dtype, shape, view = value
            yield packer.pack_array_header(3) + packer.pack(dtype) + packer.pack(shape)
            yield struct.pack(">BI", BIN32, view.nbytes)
            yield view
        else:
            yield packer.pack(value)


def decode(kind: type[M], payload: bytes, now_ns: int | None = None, oldest_s: float = MAX_PAST_S) -> M:
    """The message of this kind in `payload`. With `now_ns`, its stamp must not be older than oldest_s, nor MAX_FUTURE_S ahead.

    Raises BadMessage that says what was expected and what came.
    """
    if len(payload) > kind.MAX_BYTES:
        raise BadMessage("size", f"{kind.__name__}: at most {kind.MAX_BYTES} bytes expected, {len(payload)} came")
    try:
        raw = _unpack(payload)
    except MemoryError:  # the reader's fault
        raise
    except Exception as error:
        raise BadMessage("msgpack", f"{kind.__name__}: MessagePack expected, came {payload[:16]!r}… ({error!s:.100})") from None
    if not isinstance(raw, dict):
        raise BadMessage("map", f"{kind.__name__}: a map of fields expected, a {type(raw).__name__} came")
    version = raw.pop("version", None)
    if version != VERSION:
        raise BadMessage(
            "version",
            f"{kind.__name__}: wire version {VERSION} expected, {_short(version)} came: run one release of Penumbra everywhere",
        )
    specs = _fields(kind)
    if raw.keys() != _field_names(kind):
        raise BadMessage(
            "fields", f"{kind.__name__}: fields {[n for n, _, _ in specs]} expected, {sorted(map(_short, raw))} came"
        )
    message = kind(**{name: _field(kind.__name__, name, hint, metadata, raw[name]) for name, hint, metadata in specs})
    if now_ns is not None:
        check_stamp(message, now_ns, oldest_s)
    return message


def _unpack(payload: bytes) -> Any:
    """The objects in a payload. A large one may be full of tiny lists, each many times its size in memory: they are counted."""
    if len(payload) <= Message.MAX_BYTES:
        return msgpack.unpackb(payload, **_STRUCTURE)
    count = itertools.count(1)

    def limited(container: Any) -> Any:
        if next(count) > 64:
            raise ValueError("too many lists and maps")
        return container

    return msgpack.unpackb(payload, list_hook=limited, object_hook=limited, **_STRUCTURE)


def check_stamp(message: Message, now_ns: int, oldest_s: float) -> None:
    """Raises BadMessage where the stamp is too far from the reader's clock."""
    age_s = (now_ns - message.stamp_ns) * 1e-9
    if age_s > oldest_s:
        raise BadMessage("past", f"{type(message).__name__}: stamp at most {oldest_s:g} s old expected, {age_s:.3f} s came")
    if age_s < -MAX_FUTURE_S:
        raise BadMessage(
            "future",
            f"{type(message).__name__}: stamp at most {MAX_FUTURE_S} s ahead expected, {-age_s:.3f} s came: check the clocks",
        )


def _check_array(where: str, spec: _ArraySpec, dtype: str, shape: tuple[int, ...]) -> None:
    fits = len(shape) == len(spec.shape) and all(n > 0 and m in (None, n) for n, m in zip(shape, spec.shape, strict=True))
    if dtype != spec.dtype or not fits:
        wanted = "x".join("n" if n is None else str(n) for n in spec.shape)
        raise BadMessage("array", f"{where}: {spec.dtype} of shape {wanted} expected, {dtype} of shape {tuple(shape)} came")


def _field(kind: str, name: str, hint: Any, metadata: typing.Mapping[str, Any], value: Any) -> Any:
    where = f"{kind}.{name}"
    spec = metadata.get("array")
    if spec is not None:
        return _array_from_wire(where, spec, value)
    if hint is float or hint is int:
        return _number(where, hint, metadata.get("within", (-LARGEST, LARGEST) if hint is float else None), value)
    if hint is str:
        choice = metadata.get("choice")
        if not isinstance(value, str) or (choice and value not in choice):
            raise BadMessage("text", f"{where}: {' | '.join(choice) if choice else 'a text'} expected, {_short(value)} came")
        return value
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise BadMessage("sources", f"{where}: a map of sources expected, {_short(value)} came")
    return {key: _source(f"{where}.{key}", item) for key, item in value.items()}


def _number(where: str, hint: type, within: tuple[float, float] | None, value: Any) -> Any:
    wanted = "an integer" if hint is int else "a finite number"
    numeric = isinstance(value, int) or (hint is float and isinstance(value, float))
    if not numeric or isinstance(value, bool) or not math.isfinite(value):
        raise BadMessage("number", f"{where}: {wanted} expected, {_short(value)} came")
    if within is not None and not within[0] <= value <= within[1]:
        raise BadMessage("range", f"{where}: {wanted} from {within[0]:g} to {within[1]:g} expected, {_short(value)} came")
    return hint(value)


def _source(where: str, value: Any) -> Source:
    if not isinstance(value, dict) or value.keys() != {"age_s", "weight"}:
        raise BadMessage("sources", f"{where}: age_s and weight expected, {_short(value)} came")
    return Source(**{name: _number(f"{where}.{name}", float, (-LARGEST, LARGEST), number) for name, number in value.items()})


def _array_from_wire(where: str, spec: _ArraySpec, value: Any) -> np.ndarray:
    well_formed = (
        isinstance(value, list)
        and len(value) == 3
        and isinstance(value[0], str)
        and isinstance(value[1], list)
        and all(isinstance(n, int) and not isinstance(n, bool) and n >= 0 for n in value[1])
        and isinstance(value[2], bytes)
    )
    if not well_formed:
        raise BadMessage("array", f"{where}: [dtype, shape, bytes] expected, {_short(value)} came")
    dtype, shape, data = value
    _check_array(where, spec, dtype, tuple(shape))
    expected = spec.numpy.itemsize * math.prod(shape)
    if len(data) != expected:
        raise BadMessage("array", f"{where}: {expected} bytes for {dtype} {shape} expected, {len(data)} came")
    array = np.frombuffer(data, spec.numpy).reshape(shape)
    # the sum of squares is soon made, and small where all is well; else each number is looked at, also where it is NaN
    if spec.numpy.kind == "f" and not np.vdot(array, array) <= LARGEST and not np.abs(array).max() <= LARGEST:
        count = int((~(np.abs(array) <= LARGEST)).sum())
        raise BadMessage("finite", f"{where}: finite numbers up to {LARGEST:g} expected, {count} of {array.size} are not")
    fault = spec.check(array) if spec.check else None
    if fault:
        raise BadMessage("values", f"{where}: {fault}")
    return array


def _short(value: Any) -> str:
    """A value in a log line: never more of it than a line holds, however large it is."""
    if isinstance(value, bytes | str):
        return repr(value[:40]) + ("…" if len(value) > 40 else "")
    if isinstance(value, list | dict):
        return f"a {'list' if isinstance(value, list) else 'map'} of {len(value)}"
    return f"{value!r:.60}"
