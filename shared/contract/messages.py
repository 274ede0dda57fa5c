"""Every message that crosses the bus, and its wire format.

A message is a frozen dataclass; on the wire it is a MessagePack map of its fields, an array being `[dtype, shape, bytes]`, led by
the `version` of this format: any MessagePack library reads it. `decode` checks size, version, types, shapes, dtypes, ranges,
finiteness and stamp. msgspec checks types, ranges and lengths in C, from the declarations below, and stops at the first wrong
byte, so that no payload fills the memory. The bytes of an array are copied once where they are encoded, and not at all where
they are decoded: the array is a read-only view of the payload.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec
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
SMALL = 64
"""Up to so many numbers Python makes a norm as fast as NumPy, and several times faster where NumPy's code is in no cache, as
with a message every few milliseconds."""
LONGEST_TEXT, MOST_SOURCES = 256, 32
"""Characters of a name, and senses of a pose: more than any message needs, less than fills a memory."""


@dataclass(frozen=True)
class _ArraySpec:
    dtype: str
    shape: tuple[int | None, ...]  # None: any positive length
    check: Callable[[np.ndarray, float], str | None] | None = None  # what else is wrong with the values, by their norm

    @functools.cached_property
    def numpy(self) -> np.dtype:
        return np.dtype(self.dtype)

    @functools.cached_property
    def _fixed(self) -> tuple[tuple[int, int], ...]:
        return tuple((axis, length) for axis, length in enumerate(self.shape) if length is not None)

    def fits(self, shape: tuple[int, ...]) -> bool:
        """Whether an array may have this shape."""
        if len(shape) != len(self.shape) or 0 in shape:
            return False
        for axis, length in self._fixed:  # noqa: SIM110 (a generator for `all` takes longer than the rest)
            if shape[axis] != length:
                return False
        return True


def _array(dtype: str, *shape: int | None, check: Callable[[np.ndarray, float], str | None] | None = None) -> Any:
    return field(metadata={"array": _ArraySpec(dtype, shape, check)})


def _quaternion() -> Any:
    return _array("float64", 4, check=_not_unit)


def _covariance() -> Any:
    """Also an information matrix: symmetric and not negative in any direction."""
    return _array("float64", 6, 6, check=_not_semidefinite)


def _not_unit(value: np.ndarray, norm: float) -> str | None:
    return None if abs(norm - 1) <= UNIT_TOLERANCE else f"a unit quaternion expected, one of norm {norm:.4g} came"


def _not_semidefinite(value: np.ndarray, norm: float) -> str | None:
    is_symmetric = value.tobytes() == value.T.tobytes()  # to the last bit: the usual case, and quickly seen
    lowest = float(np.linalg.eigvalsh(value)[0])
    if is_symmetric and lowest >= 0.0:
        return None
    tolerance = ROUNDING * float(np.abs(value).max())
    if np.abs(value - value.T).max() > tolerance:
        return "a symmetric matrix expected, one with different halves came"
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


_Quantity = Annotated[float, msgspec.Meta(ge=-LARGEST, le=LARGEST)]
_Name = Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]


class Source(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One sense as the observer sees it: age of its last accepted measurement [s] and its share of the information in use."""

    age_s: _Quantity
    weight: _Quantity


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


class _Codec(typing.Generic[M]):
    """What a message class is on the wire, worked out once from its declarations.

    wire: the typed map that msgspec reads and writes, in which an array is a tuple (dtype, shape, bytes). arrays: the fields that
    hold one. faults: by field, the `kind` of BadMessage for a value that msgspec refuses.
    """

    def __init__(self, kind: type[M]):
        self.kind = kind
        self.arrays: dict[str, _ArraySpec] = {}
        self.faults: dict[str, str] = {}
        hints, wire = typing.get_type_hints(kind), []
        for declared in dataclasses.fields(kind):
            name, hint, metadata = declared.name, hints[declared.name], declared.metadata
            if (spec := metadata.get("array")) is not None:
                self.arrays[name] = spec
                wire.append((name, _array_on_the_wire(spec)))
                self.faults[name] = "array"
            elif hint in (int, float):
                low, high = metadata.get("within", (None, None) if hint is int else (-LARGEST, LARGEST))
                wire.append((name, Annotated[hint, msgspec.Meta(ge=low, le=high)]))
                self.faults[name] = "number"
            elif hint is str:
                wire.append((name, Literal[metadata["choice"]] if "choice" in metadata else _Name))
                self.faults[name] = "text"
            else:
                wire.append((name, Annotated[dict[_Name, Source], msgspec.Meta(max_length=MOST_SOURCES)]))
                self.faults[name] = "sources"
        self.wire = msgspec.defstruct(
            kind.__name__, [("version", Literal[VERSION]), *wire], forbid_unknown_fields=True, gc=False, frozen=True
        )
        self.decoder = msgspec.msgpack.Decoder(self.wire)

    def encode(self, message: M) -> bytes:
        fields = dict(vars(message))
        for name, spec in self.arrays.items():
            fields[name] = _packed(name, spec, fields[name])
        return _ENCODER.encode(self.wire(VERSION, **fields))

    def decode(self, payload: bytes) -> M:
        try:
            fields = msgspec.structs.asdict(self.decoder.decode(payload))
        except MemoryError:  # the reader's fault
            raise
        except Exception as error:
            raise self.refusal(payload, error) from None
        del fields["version"]
        for name, spec in self.arrays.items():
            fields[name] = self._unpacked(name, spec, *fields[name])
        message = object.__new__(self.kind)
        vars(message).update(fields)  # at once: the __init__ of a frozen dataclass sets field by field
        return message

    def refusal(self, payload: bytes, error: Exception) -> BadMessage:
        """Why msgspec did not take a payload. Another release may send other fields: its version is the reason, then."""
        where = self.kind.__name__
        if not isinstance(error, msgspec.ValidationError):
            return BadMessage("msgpack", f"{where}: MessagePack expected, came {payload[:16]!r}… ({error!s:.100})")
        try:
            version = _version(payload)
        except msgspec.ValidationError:
            return BadMessage("map", f"{where}: a map of fields expected ({error!s:.300})")
        except (ValueError, RecursionError) as worse:  # msgspec raises UnicodeDecodeError, too
            return BadMessage("msgpack", f"{where}: MessagePack expected, came {payload[:16]!r}… ({worse!s:.100})")
        if version != VERSION:
            why = f"wire version {VERSION} expected, {_short(version)} came: run one release of Penumbra everywhere"
            return BadMessage("version", f"{where}: {why}")
        found = re.search(r"\$\.(\w+)", str(error))
        kind = self.faults.get(found[1], "fields") if found else "fields"
        if kind == "number" and re.search(r"`(int|float)` [<>]=", str(error)):
            kind = "range"
        return BadMessage(kind, f"{where}: {error!s:.300}")

    def _unpacked(self, name: str, spec: _ArraySpec, dtype: str, shape: tuple[int, ...], data: memoryview) -> np.ndarray:
        """The array (read-only) whose bytes these are, when its values have been looked at: a view, or, where numbers do not
        begin at a multiple of their size, a copy. Large arrays have values of one byte, which begin anywhere."""
        expected = spec.numpy.itemsize * math.prod(shape)
        if len(data) != expected:
            came = f"{expected} bytes for {dtype} {list(shape)} expected, {len(data)} came"
            raise BadMessage("array", f"{self.kind.__name__}.{name}: {came}")
        array: np.ndarray = np.ndarray(shape, spec.numpy, data)
        if not array.flags.aligned:
            array = array.copy()
            array.flags.writeable = False
        if spec.numpy.kind != "f":
            return array
        # the norm is soon made, and small where all is well; else each number is looked at, also where it is NaN
        small, form = array.size <= SMALL, typing.cast(Literal["d"], spec.numpy.char)
        norm = math.hypot(*data.cast(form)) if small else math.sqrt(float(np.vdot(array, array)))
        if not norm <= LARGEST and not np.abs(array).max() <= LARGEST:
            count = int((~(np.abs(array) <= LARGEST)).sum())
            wanted = f"finite numbers up to {LARGEST:g} expected, {count} of {array.size} are not"
            raise BadMessage("finite", f"{self.kind.__name__}.{name}: {wanted}")
        if spec.check is not None and (fault := spec.check(array, norm)):
            raise BadMessage("values", f"{self.kind.__name__}.{name}: {fault}")
        return array


_codec = typing.cast(Callable[[type[M]], _Codec[M]], functools.cache(_Codec))


def encode(message: Message) -> bytes:
    """The MessagePack bytes of a message. Raises BadMessage where an array has not the declared dtype and shape."""
    return _codec(type(message)).encode(message)


def decode(kind: type[M], payload: bytes, now_ns: int | None = None, oldest_s: float = MAX_PAST_S) -> M:
    """The message of this kind in `payload`. With `now_ns`, its stamp must not be older than oldest_s, nor MAX_FUTURE_S ahead.

    Raises BadMessage that says what was expected and what came.
    """
    if len(payload) > kind.MAX_BYTES:
        raise BadMessage("size", f"{kind.__name__}: at most {kind.MAX_BYTES} bytes expected, {len(payload)} came")
    message = _codec(kind).decode(payload)
    if now_ns is not None:
        check_stamp(kind, message.stamp_ns, now_ns, oldest_s)
    return message


def check_stamp(kind: type[Message], stamp_ns: int, now_ns: int, oldest_s: float) -> None:
    """Raises BadMessage where the stamp of a message is too far from the reader's clock."""
    age_s = (now_ns - stamp_ns) * 1e-9
    if age_s > oldest_s:
        raise BadMessage("past", f"{kind.__name__}: stamp at most {oldest_s:g} s old expected, {age_s:.3f} s came")
    if age_s < -MAX_FUTURE_S:
        raise BadMessage(
            "future", f"{kind.__name__}: stamp at most {MAX_FUTURE_S} s ahead expected, {-age_s:.3f} s came: check the clocks"
        )


class Head(msgspec.Struct, frozen=True, gc=False):
    """What a reader must know of a message that it does not look at; its other fields are skipped."""

    version: Literal[VERSION]  # type: ignore[valid-type]
    stamp_ns: int
    camera: _Name = ""


_HEADS = msgspec.msgpack.Decoder(Head)


def head(kind: type[Message], payload: bytes) -> Head:
    """The head of a message of this kind. Raises BadMessage where it has none of this version."""
    try:
        return _HEADS.decode(payload)
    except MemoryError:
        raise
    except Exception as error:
        raise _codec(kind).refusal(payload, error) from None


def _array_on_the_wire(spec: _ArraySpec) -> Any:
    """The type of [dtype, shape, bytes], of which msgspec lets nothing else through."""
    literal: Any = Literal  # of values that are known only here
    lengths = tuple(Annotated[int, msgspec.Meta(ge=1)] if n is None else literal[n] for n in spec.shape)
    return types.GenericAlias(tuple, (literal[spec.dtype], types.GenericAlias(tuple, lengths), memoryview))


def _packed(name: str, spec: _ArraySpec, value: Any) -> tuple[str, tuple[int, ...], memoryview]:
    value = np.ascontiguousarray(value)
    if value.dtype != spec.numpy or not spec.fits(value.shape):
        wanted = "x".join("n" if n is None else str(n) for n in spec.shape)
        raise BadMessage(
            "array", f"{name}: {spec.dtype} of shape {wanted} expected, {value.dtype.name} of shape {value.shape} came"
        )
    return spec.dtype, value.shape, value.data


def _plain(value: Any) -> Any:
    """A NumPy scalar as a Python number, for msgspec, which does not know it."""
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_plain)


class _Version(msgspec.Struct):
    """The version of a message of any release; what else is in it is skipped and not made into objects."""

    version: msgspec.Raw = msgspec.Raw(msgspec.msgpack.encode(None))


def _version(payload: bytes) -> Any:
    """The version that a payload carries, None where it carries none. Raises msgspec.DecodeError where it is no map of names."""
    raw = msgspec.msgpack.decode(payload, type=_Version).version
    return msgspec.msgpack.decode(raw) if len(raw) <= LONGEST_TEXT else f"something of {len(raw)} bytes"


def _short(value: Any) -> str:
    """A value in a log line, and never more of it than a line holds."""
    return f"{value!r:.60}"
