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
HEAD = 1024
"""Bytes within which the large array of a message begins."""
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
    """Class indices (`shared.contract.labels`) of a window of a frame. Mask pixel (r, c) covers `scale` x `scale` image pixels
    whose first is (y0 + r * scale, x0 + c * scale); outside the window nothing is known."""

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
    """The one pose. `velocity`: linear [m/s] and angular [rad/s] along the frame's axes. `sources` by name (of the
    table of senses); a sense that was never heard is absent."""

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
Convert = Callable[[Any], Any]


class _Plan:
    """How the fields of a message class go onto the wire and come from it, worked out once: a bus that carries thousands of
    messages a second has no time to look at declarations. write, read: functions by field; read raises BadMessage."""

    def __init__(self, kind: type[Message]):
        hints = typing.get_type_hints(kind)
        self.write: dict[str, Convert] = {}
        self.read: dict[str, Convert] = {}
        for declared in dataclasses.fields(kind):
            name, hint, spec = declared.name, hints[declared.name], declared.metadata.get("array")
            where = f"{kind.__name__}.{name}"
            if spec is not None:
                self.write[name], self.read[name] = _array_writer(name, spec), _array_reader(where, spec)
            elif hint is float or hint is int:
                within = declared.metadata.get("within", (-LARGEST, LARGEST) if hint is float else (-math.inf, math.inf))
                self.write[name], self.read[name] = _plain, _number_reader(where, hint, within)
            elif hint is str:
                self.write[name], self.read[name] = _plain, _text_reader(where, declared.metadata.get("choice"))
            else:
                self.write[name], self.read[name] = _write_sources, _sources_reader(where)


_plan = typing.cast(Callable[[type[Message]], _Plan], functools.cache(_Plan))


def encode(message: Message) -> bytes:
    """The MessagePack bytes of a message. Raises BadMessage where an array has not the declared dtype and shape."""
    out: dict[str, Any] = {"version": VERSION}
    large = None
    for name, write in _plan(type(message)).write.items():
        value = write(getattr(message, name))
        if type(value) is list and len(value[2]) >= LARGE:
            large = name
        out[name] = value
    if large is None:
        return msgpack.packb(out)
    out[large] = out.pop(large)  # to the end, where a reader finds it without a copy
    return b"".join(_pieces(out))


def _pieces(fields: dict[str, Any]) -> Iterator[bytes | memoryview]:
    """What MessagePack makes of a message's fields, with the bytes of arrays as they are: `packb` would copy them twice."""
    packer = msgpack.Packer()
    yield packer.pack_map_header(len(fields))
    for name, value in fields.items():
        yield packer.pack(name)
        if isinstance(value, list):
            dtype, shape, view = value
            yield packer.pack_array_header(3) + packer.pack(dtype) + packer.pack(shape)
            yield struct.pack(">BI", BIN32, len(view))
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
    read = _plan(kind).read
    if raw.keys() != read.keys():
        raise BadMessage("fields", f"{kind.__name__}: fields {list(read)} expected, {sorted(map(_short, raw))} came")
    message = kind(**{name: convert(raw[name]) for name, convert in read.items()})
    if now_ns is not None:
        check_stamp(message, now_ns, oldest_s)
    return message


def _unpack(payload: bytes) -> Any:
    """The objects in a payload."""
    if len(payload) <= Message.MAX_BYTES:
        return msgpack.unpackb(payload, **_STRUCTURE)
    found = _without_a_copy(payload)
    return _counted(payload) if found is None else found


def _counted(payload: bytes) -> Any:
    """A large payload may be full of tiny lists, each many times its size in memory: they are counted."""
    count = itertools.count(1)

    def limited(container: Any) -> Any:
        if next(count) > 64:
            raise ValueError("too many lists and maps")
        return container

    return msgpack.unpackb(payload, list_hook=limited, object_hook=limited, **_STRUCTURE)


def _without_a_copy(payload: bytes) -> Any:
    """The objects of a payload that ends with the bytes of a large array, as `encode` writes it: these bytes stay where they are.
    None for any other payload."""
    at = payload.find(BIN32, 0, HEAD)
    while at >= 0 and at + 5 + int.from_bytes(payload[at + 1 : at + 5], "big") != len(payload):
        at = payload.find(BIN32, at + 1, HEAD)
    if at < 0:
        return None
    found = msgpack.unpackb(payload[:at] + b"\xc4\x00", **_STRUCTURE)  # as if there were none of them
    array = next(reversed(found.values()), None) if isinstance(found, dict) else None
    if not isinstance(array, list) or array[-1:] != [b""]:
        return None
    array[-1] = memoryview(payload)[at + 5 :]
    return found


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


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _write_sources(value: dict[str, Source]) -> dict[str, Any]:
    return {key: dict(vars(item)) for key, item in value.items()}


def _array_writer(name: str, spec: _ArraySpec) -> Convert:
    def write(value: Any) -> list[Any]:
        value = np.ascontiguousarray(value)
        if value.dtype != spec.numpy or value.shape != spec.shape:
            _check_array(name, spec, value.dtype.name, value.shape)
        return [spec.dtype, value.shape, value.data.cast("B") if value.nbytes >= LARGE else value.tobytes()]

    return write


def _array_reader(where: str, spec: _ArraySpec) -> Convert:
    numpy, check, is_float = spec.numpy, spec.check, spec.numpy.kind == "f"

    def read(value: Any) -> np.ndarray:
        well_formed = (
            type(value) is list
            and len(value) == 3
            and type(value[0]) is str
            and type(value[1]) is list
            and all(type(n) is int for n in value[1])
            and isinstance(value[2], bytes | memoryview)
        )
        if not well_formed:
            raise BadMessage("array", f"{where}: [dtype, shape, bytes] expected, {_short(value)} came")
        dtype, shape, data = value
        _check_array(where, spec, dtype, tuple(shape))
        if len(data) != numpy.itemsize * math.prod(shape):
            expected = numpy.itemsize * math.prod(shape)
            raise BadMessage("array", f"{where}: {expected} bytes for {dtype} {shape} expected, {len(data)} came")
        array = np.frombuffer(data, numpy).reshape(shape)
        # the sum of squares is soon made, and small where all is well; else each number is looked at, also where it is NaN
        if is_float and not np.vdot(array, array) <= LARGEST and not np.abs(array).max() <= LARGEST:
            count = int((~(np.abs(array) <= LARGEST)).sum())
            raise BadMessage("finite", f"{where}: finite numbers up to {LARGEST:g} expected, {count} of {array.size} are not")
        if check is not None and (fault := check(array)):
            raise BadMessage("values", f"{where}: {fault}")
        return array

    return read


def _number_reader(where: str, hint: type, within: tuple[float, float]) -> Convert:
    low, high = within
    kinds = (int,) if hint is int else (int, float)
    wanted = "an integer" if hint is int else "a finite number"

    def read(value: Any) -> Any:
        if type(value) in kinds and low <= value <= high:
            return hint(value)
        if type(value) not in kinds or not math.isfinite(value):
            raise BadMessage("number", f"{where}: {wanted} expected, {_short(value)} came")
        raise BadMessage("range", f"{where}: {wanted} from {low:g} to {high:g} expected, {_short(value)} came")

    return read


def _text_reader(where: str, choice: tuple[str, ...] | None) -> Convert:
    def read(value: Any) -> str:
        if type(value) is str and (choice is None or value in choice):
            return value
        raise BadMessage("text", f"{where}: {' | '.join(choice) if choice else 'a text'} expected, {_short(value)} came")

    return read


def _sources_reader(where: str) -> Convert:
    number = _number_reader(where, float, (-LARGEST, LARGEST))

    def read(value: Any) -> dict[str, Source]:
        if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
            raise BadMessage("sources", f"{where}: a map of sources expected, {_short(value)} came")
        return {key: source(key, item) for key, item in value.items()}

    def source(key: str, item: Any) -> Source:
        if not isinstance(item, dict) or item.keys() != {"age_s", "weight"}:
            raise BadMessage("sources", f"{where}.{key}: age_s and weight expected, {_short(item)} came")
        return Source(number(item["age_s"]), number(item["weight"]))

    return read


def _short(value: Any) -> str:
    """A value in a log line: never more of it than a line holds, however large it is."""
    if isinstance(value, bytes | str):
        return repr(value[:40]) + ("…" if len(value) > 40 else "")
    if isinstance(value, list | dict):
        return f"a {'list' if isinstance(value, list) else 'map'} of {len(value)}"
    return f"{value!r:.60}"
