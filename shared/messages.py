"""Every message that crosses the bus, and its wire format.

A message is a frozen dataclass; on the wire it is a MessagePack map of its fields, an array being `[dtype, shape, bytes]`.
`decode` believes nothing: it checks size, type, shape, dtype, finiteness and stamp, and says what it expected and what came.
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from dataclasses import dataclass, field
from typing import Any

import msgpack
import numpy as np

MAX_FUTURE_S = 0.5
"""A stamp further ahead of the reader's clock than this is refused: clocks of one cell are kept closer than that."""
MAX_PAST_S = 5.0
"""A stamp older than this is refused: after a network cut the backlog arrives late and says nothing about now."""


class BadMessage(ValueError):
    """A message that was refused. `kind` groups equal faults, so that each is logged once."""

    def __init__(self, kind: str, text: str):
        super().__init__(text)
        self.kind = kind


@dataclass(frozen=True)
class _ArraySpec:
    dtype: str
    shape: tuple[int | None, ...]  # None: any positive length


def _array(dtype: str, *shape: int | None) -> Any:
    return field(metadata={"array": _ArraySpec(dtype, shape)})


def _choice(*values: str) -> Any:
    return field(metadata={"choice": values})


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
    x0: int
    y0: int
    scale: int


@dataclass(frozen=True, kw_only=True)
class Joints(Message):
    """Joint angles [rad] in the order of the robot description."""

    position: np.ndarray = _array("float64", None)


@dataclass(frozen=True, kw_only=True)
class Voltages(Message):
    """Electrode amplitudes [V] of one pad, oldest row first; `stamp_ns` belongs to the last row."""

    period_ns: int
    volts: np.ndarray = _array("float32", None, None)  # (samples, electrodes)


@dataclass(frozen=True, kw_only=True)
class VisionPose(Message):
    """What the camera says. `overlap` in [0, 1] over the pixels that are scored; `hidden`: share of the target's pixels
    that something covers; `state`: tracking, occluded (too little is seen: do not use) or lost."""

    target: str
    camera: str
    frame: str
    position: np.ndarray = _array("float64", 3)
    orientation: np.ndarray = _array("float64", 4)
    covariance: np.ndarray = _array("float64", 6, 6)
    overlap: float
    hidden: float
    state: str = _choice("tracking", "occluded", "lost")


@dataclass(frozen=True, kw_only=True)
class HapticPose(Message):
    """What the skin says. `information` (6 x 6, inverse covariance) is zero along directions that it does not observe.
    `stamp_ns` is the time that the pose belongs to, `sample_stamp_ns` that of the newest voltage sample in it."""

    target: str
    frame: str
    sample_stamp_ns: int
    position: np.ndarray = _array("float64", 3)
    orientation: np.ndarray = _array("float64", 4)
    information: np.ndarray = _array("float64", 6, 6)
    gap: float
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
    orientation: np.ndarray = _array("float64", 4)
    velocity: np.ndarray = _array("float64", 6)
    covariance: np.ndarray = _array("float64", 6, 6)
    state: str = _choice("tracking", "coasting", "lost")
    sources: dict[str, Source]


@dataclass(frozen=True, kw_only=True)
class Truth(Message):
    """What the emulator knows. `hidden`: share of the target's pixels covered in the last frame; `gap`: smallest distance
    from an electrode to the target's skin [m]."""

    target: str
    frame: str
    position: np.ndarray = _array("float64", 3)
    orientation: np.ndarray = _array("float64", 4)
    velocity: np.ndarray = _array("float64", 6)
    hidden: float
    gap: float


M = typing.TypeVar("M", bound=Message)


@functools.cache
def _fields(kind: type[Message]) -> tuple[tuple[str, Any, dataclasses.Field[Any]], ...]:
    hints = typing.get_type_hints(kind)
    return tuple((f.name, hints[f.name], f) for f in dataclasses.fields(kind))


def encode(message: Message) -> bytes:
    """The MessagePack bytes of a message. Raises BadMessage where an array has not the declared dtype and shape."""
    out: dict[str, Any] = {}
    for name, _, f in _fields(type(message)):
        value = getattr(message, name)
        spec = f.metadata.get("array")
        if spec is not None:
            value = np.ascontiguousarray(value)
            _check_array(name, spec, value.dtype.name, value.shape)
            out[name] = [value.dtype.name, value.shape, value.tobytes()]
        elif isinstance(value, dict):
            out[name] = {key: dataclasses.asdict(item) for key, item in value.items()}
        elif isinstance(value, np.generic):
            out[name] = value.item()
        else:
            out[name] = value
    return msgpack.packb(out)


def decode(kind: type[M], payload: bytes, now_ns: int | None = None) -> M:
    """The message of this kind in `payload`. With `now_ns`, its stamp must lie within MAX_PAST_S and MAX_FUTURE_S of it.

    Raises BadMessage that says what was expected and what came.
    """
    if len(payload) > kind.MAX_BYTES:
        raise BadMessage("size", f"{kind.__name__}: at most {kind.MAX_BYTES} bytes expected, {len(payload)} came")
    try:
        raw = msgpack.unpackb(payload)
    except Exception as error:
        raise BadMessage("msgpack", f"{kind.__name__}: MessagePack expected, came {payload[:16]!r}… ({error})") from None
    if not isinstance(raw, dict):
        raise BadMessage("map", f"{kind.__name__}: a map of fields expected, a {type(raw).__name__} came")
    specs = _fields(kind)
    if raw.keys() != {name for name, _, _ in specs}:
        raise BadMessage("fields", f"{kind.__name__}: fields {[n for n, _, _ in specs]} expected, {sorted(map(str, raw))} came")
    values = {name: _field(kind.__name__, name, hint, f, raw[name]) for name, hint, f in specs}
    message = kind(**values)
    if now_ns is not None:
        check_stamp(message, now_ns)
    return message


def check_stamp(message: Message, now_ns: int) -> None:
    """Raises BadMessage where the stamp is too far from the reader's clock."""
    age_s = (now_ns - message.stamp_ns) * 1e-9
    if age_s > MAX_PAST_S:
        raise BadMessage("past", f"{type(message).__name__}: stamp at most {MAX_PAST_S} s old expected, {age_s:.3f} s came")
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


def _field(kind: str, name: str, hint: Any, f: dataclasses.Field[Any], value: Any) -> Any:
    where = f"{kind}.{name}"
    spec = f.metadata.get("array")
    if spec is not None:
        return _array_from_wire(where, spec, value)
    if hint is float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise BadMessage("number", f"{where}: a finite number expected, {value!r:.60} came")
        return float(value)
    if hint is int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise BadMessage("integer", f"{where}: an integer expected, {value!r:.60} came")
        return value
    if hint is str:
        choice = f.metadata.get("choice")
        if not isinstance(value, str) or (choice and value not in choice):
            raise BadMessage("text", f"{where}: {' | '.join(choice) if choice else 'a text'} expected, {value!r:.60} came")
        return value
    if not isinstance(value, dict):
        raise BadMessage("sources", f"{where}: a map of sources expected, {value!r:.60} came")
    return {str(key): _source(f"{where}.{key}", item) for key, item in value.items()}


def _source(where: str, value: Any) -> Source:
    numbers = {"age_s", "weight"}
    if (
        not isinstance(value, dict)
        or value.keys() != numbers
        or not all(isinstance(v, int | float) and not isinstance(v, bool) and np.isfinite(v) for v in value.values())
    ):
        raise BadMessage("sources", f"{where}: finite age_s and weight expected, {value!r:.60} came")
    return Source(age_s=float(value["age_s"]), weight=float(value["weight"]))


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
        raise BadMessage("array", f"{where}: [dtype, shape, bytes] expected, {value!r:.60} came")
    dtype, shape, data = value
    _check_array(where, spec, dtype, tuple(shape))
    expected = int(np.dtype(dtype).itemsize) * int(np.prod(shape, dtype=object))
    if len(data) != expected:
        raise BadMessage("array", f"{where}: {expected} bytes for {dtype} {shape} expected, {len(data)} came")
    array = np.frombuffer(data, dtype=dtype).reshape(shape)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise BadMessage(
            "finite", f"{where}: finite numbers expected, {int((~np.isfinite(array)).sum())} of {array.size} are not"
        )
    return array
