"""All messages on the bus, and their wire format.

A message is a frozen `msgspec.Struct`. On the wire it is a MessagePack map of its fields that begins with the `version` of this
format; an array is `[dtype, shape, bytes]`. Any MessagePack library reads it. `decode` checks size, version, types, shapes,
dtypes, ranges, finiteness and stamp. msgspec checks types, ranges and lengths in C, from the declarations below, and stops at the
first wrong byte, so that no payload fills the memory. The bytes of an image or a mask are copied once when they are encoded, and
never when they are decoded: the array is a read-only view of the payload.
"""

from __future__ import annotations

import functools
import math
import re
import threading
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeAlias

import msgspec
import numpy as np
from msgspec.structs import force_setattr

VERSION = 1
"""Version of the wire format. It increases with every change of a message's fields or of their meaning. Every version keeps it
under `version` in a map, so that a reader of another version recognises it."""
MAX_FUTURE_S = 0.5
"""Maximum time [s] of a stamp ahead of the reader's clock. Clocks of one cell are synchronised more closely."""
MAX_PAST_S = 5.0
"""Default maximum age [s] of a stamp. After a network outage, queued messages arrive late and say nothing about the present."""


class BadMessage(ValueError):
    """A refused message. `kind` groups equal faults, so that each kind is logged once."""

    def __init__(self, kind: str, text: str):
        super().__init__(text)
        self.kind = kind


LARGEST = 1e12
"""Maximum magnitude of a number: no quantity of a cell is larger in SI units, and its square is still finite."""
UNIT_TOLERANCE = 1e-3
"""Maximum deviation of a quaternion's norm from one."""
ROUNDING = 1e-6
"""Relative tolerance for rounding errors in shares and matrices."""
SMALL = 64
"""Number of entries up to which Python computes a norm as fast as NumPy. It is several times faster where NumPy's code is not in
the cache, as with a message every few milliseconds."""
LONGEST_TEXT, MOST_SOURCES, MOST_PADS = 256, 32, 128
"""Maximum length of a name, of senses in a pose and of pads in a skin: more than any message needs, too little to exhaust
memory."""


@dataclass(frozen=True)
class Array:
    """An array field. shape: None stands for any positive length. check: finds further faults of the values, given their norm."""

    dtype: np.dtype
    shape: tuple[int | None, ...]
    check: Callable[[np.ndarray, float], str | None] | None = None

    def fits(self, array: np.ndarray) -> bool:
        """Whether an array has this dtype and shape."""
        shape = array.shape
        if (array.dtype is not self.dtype and array.dtype != self.dtype) or len(shape) != len(self.shape) or 0 in shape:
            return False
        for length, wanted in zip(shape, self.shape):  # noqa: SIM110, B905 (faster than a generator)
            if wanted is not None and length != wanted:
                return False
        return True

    def read(self, shape: tuple[int, ...], data: bytes | memoryview) -> np.ndarray:
        """Read-only array from its bytes, after a check of its values. Raises BadMessage."""
        if len(data) != self.dtype.itemsize * math.prod(shape):
            wanted = self.dtype.itemsize * math.prod(shape)
            raise BadMessage("array", f"expected {wanted} bytes for {self.dtype} {list(shape)}, got {len(data)}")
        flat = np.frombuffer(data, self.dtype)
        array = flat if len(shape) == 1 else flat.reshape(shape)
        if self.dtype.kind != "f":
            return array
        # a small norm, which is cheap to compute, proves that all is well; else each number is checked, also for NaN
        norm = math.hypot(*flat.tolist()) if flat.size <= SMALL else math.sqrt(float(np.vdot(flat, flat)))
        if not norm <= LARGEST and not np.abs(flat).max() <= LARGEST:
            count = int((~(np.abs(flat) <= LARGEST)).sum())
            raise BadMessage("finite", f"expected finite numbers up to {LARGEST:g}, got {count} of {flat.size} that are not")
        if self.check is not None and (fault := self.check(array, norm)):
            raise BadMessage("values", fault)
        return array


def array(dtype: str, *shape: int | None, check: Callable[[np.ndarray, float], str | None] | None = None) -> Any:
    """Type of the wire form [dtype, shape, bytes]; msgspec accepts nothing else. The bytes of an image are a view of the payload.
    Numbers are copied by msgspec, so that they are aligned to their size, as compiled code requires."""
    literal: Any = Literal  # its values are known at run time only
    lengths = tuple(Annotated[int, msgspec.Meta(ge=1)] if n is None else literal[n] for n in shape)
    data = memoryview if dtype == "uint8" else bytes
    wire: Any = types.GenericAlias(tuple, (literal[dtype], types.GenericAlias(tuple, lengths), data))
    return Annotated[wire, Array(np.dtype(dtype), shape, check)]


def not_unit(value: np.ndarray, norm: float) -> str | None:
    return None if abs(norm - 1) <= UNIT_TOLERANCE else f"expected a unit quaternion, got one of norm {norm:.4g}"


def not_semidefinite(value: np.ndarray, norm: float) -> str | None:
    if value.tobytes() == value.T.tobytes():  # identical to the last bit: the usual case, and a cheap test
        if _is_positive_definite(value.tolist()):
            return None
    elif np.abs(value - value.T).max() > ROUNDING * float(np.abs(value).max()):
        return "expected a symmetric matrix, got one with different halves"
    lowest, tolerance = float(np.linalg.eigvalsh(value)[0]), ROUNDING * float(np.abs(value).max())
    return None if lowest >= -tolerance else f"expected a matrix without negative eigenvalues, got one with {lowest:.4g}"


def _is_positive_definite(rows: list[list[float]]) -> bool:
    """Whether a symmetric matrix has a Cholesky factor. NumPy takes three times as long when its code is not in the cache."""
    factor: list[list[float]] = []
    for i, given in enumerate(rows):
        row: list[float] = []
        for j, above in enumerate(factor):
            rest = given[j]
            for k in range(j):
                rest -= row[k] * above[k]
            row.append(rest / above[j])
        pivot = given[i] - sum([each * each for each in row])
        if not pivot > 0.0:
            return False
        row.append(math.sqrt(pivot))
        factor.append(row)
    return True


if TYPE_CHECKING:
    Image: TypeAlias = np.ndarray
    Labels: TypeAlias = np.ndarray
    Numbers: TypeAlias = np.ndarray
    Samples: TypeAlias = np.ndarray
    Position: TypeAlias = np.ndarray
    Quaternion: TypeAlias = np.ndarray
    Twist: TypeAlias = np.ndarray
    Covariance: TypeAlias = np.ndarray
else:
    Image = array("uint8", None, None, 3)
    Labels = array("uint8", None, None)
    Numbers = array("float64", None)
    Samples = array("float32", None, None)
    Position = array("float64", 3)
    Quaternion = array("float64", 4, check=not_unit)
    Twist = array("float64", 6)
    Covariance = array("float64", 6, 6, check=not_semidefinite)  # also an information matrix

Name = Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]
Quantity = Annotated[float, msgspec.Meta(ge=-LARGEST, le=LARGEST)]
Share = Annotated[float, msgspec.Meta(ge=-ROUNDING, le=1 + ROUNDING)]
Pixel = Annotated[int, msgspec.Meta(ge=-8192, le=8192)]


class Message(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="version", tag=VERSION):
    """Base of all messages. `stamp_ns`: time of the measurement (not of its publication), nanoseconds since the epoch."""

    MAX_BYTES: ClassVar[int] = 65_536
    stamp_ns: int


class Frame(Message, frozen=True, kw_only=True):
    """One camera image, not undistorted, row-major RGB, pixel centres at integer coordinates."""

    MAX_BYTES: ClassVar[int] = 64_000_000
    image: Image


class Mask(Message, frozen=True, kw_only=True):
    """Class indices (`shared.contract.labels`) of a window of a frame. Mask pixel (r, c) covers `scale` x `scale` image pixels,
    the first of which is (y0 + r * scale, x0 + c * scale). Outside the window the class is unknown. Image pixels are those of the
    undistorted image (`shared.geometry.lens`)."""

    MAX_BYTES: ClassVar[int] = 32_000_000
    labels: Labels
    x0: Pixel
    y0: Pixel
    scale: Annotated[int, msgspec.Meta(ge=1, le=64)]


class Joints(Message, frozen=True, kw_only=True):
    """Joint angles [rad] or displacements [m] in the order of `joints` in the cell file."""

    position: Numbers


class Voltages(Message, frozen=True, kw_only=True):
    """Electrode amplitudes [V] of one pad, (samples, electrodes), oldest row first; `stamp_ns` belongs to the last row."""

    period_ns: Annotated[int, msgspec.Meta(ge=1, le=1_000_000_000)]
    volts: Samples


class VisionPose(Message, frozen=True, kw_only=True):
    """Pose measured by a camera. `overlap`: in [0, 1], over the pixels that are scored; `hidden`: covered share of the target's
    pixels; `state`: tracking, occluded (too little is visible: do not use) or lost; `confidence`: probability in [0, 1] that the
    pose is within 5 cm and 20 degrees of the truth, none if the publisher does not know."""

    target: Name
    camera: Name
    frame: Name
    position: Position
    orientation: Quaternion
    covariance: Covariance
    overlap: Share
    hidden: Share
    state: Literal["tracking", "occluded", "lost"]
    confidence: Share | None = None


HapticState = Literal["in_range", "unidentified", "object", "out_of_range"]
ContactState = Literal["none", "touch", "grip"]


class SurfacePoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nearest surface point in front of a pad, on any object.

    Attributes:
        link: Link that carries the pad, `world` or ROBOT/LINK.
        position: The point (x, y, z), in the pose's frame [m].
        distance: From the middle of the pad to the point [m].
        along: Standard deviation of the distance, along the line from the pad, which is the surface's normal [m].
        across: Standard deviation of the point across this line [m].
        gap: Smallest distance between the surface and the pad's board [m].
    """

    link: Name
    position: tuple[Quantity, Quantity, Quantity]
    distance: Quantity
    along: Quantity
    across: Quantity
    gap: Quantity


class HapticPose(Message, frozen=True, kw_only=True):
    """Pose measured by the skin. `information` (6 x 6, inverse covariance) is zero along directions that are not observed.
    `stamp_ns` is the time of the pose, `sample_stamp_ns` that of the newest voltage sample in it.

    `state`: in_range (a limb), unidentified (a limb or another object: the pose is that of a limb that would give these
    voltages), object (not a limb: the same pose, with zero information) or out_of_range (nothing near). Use only in_range as the
    target's pose. `gap`: smallest distance from an electrode to the limb's surface at this pose [m].

    `surface`: the nearest surface point by pad, for each pad that senses something: the `link` that carries the pad, the point's
    `position` in `frame`, its `distance` from the middle of the pad with the standard deviations `along` and `across` the line
    between them, and the `gap` between the surface and the pad's board [m]. No shape is assumed, and the points belong to no
    target. `contact`: none, touch (a surface came within 5 mm of a pad and is still within 10 mm) or grip (on opposite sides of
    one link), for the pads `touched`, whatever the `state`.

    `step`: translation [m] and rotation vector [rad], about the frame's axes, from the linearisation point of the likelihood to
    this pose. Combine poses that are uncertain by tens of degrees at the linearisation point, as fusion does.
    """

    target: Name
    frame: Name
    sample_stamp_ns: int
    position: Position
    orientation: Quaternion
    information: Covariance
    gap: Quantity
    state: HapticState
    surface: Annotated[dict[Name, SurfacePoint], msgspec.Meta(max_length=MOST_PADS)] = {}
    contact: ContactState = "none"
    touched: Annotated[tuple[Name, ...], msgspec.Meta(max_length=MOST_PADS)] = ()
    step: Twist = msgspec.field(default_factory=lambda: np.zeros(6))


class Source(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Contribution of one sense to a fused pose.

    Attributes:
        age_s: Age of its last accepted measurement [s].
        weight: Its share of the information in use, from 0 to 1.
    """

    age_s: Quantity
    weight: Quantity


FusedState = Literal["tracking", "coasting", "lost"]


class FusedPose(Message, frozen=True, kw_only=True):
    """The fused pose. `velocity`: linear [m/s] and angular [rad/s] along the frame's axes. `state`: tracking (a sense measures
    the target, and three standard deviations of the position are within the target's `tracking_bound`), coasting (no sense does,
    the newest measurement contradicts the pose, a camera that saw the target until recently does not see it there, or the pose is
    less certain: do not rely on it within the bound) or lost. `sources`: by name (see the table of senses), without senses that
    have sent nothing."""

    target: Name
    frame: Name
    position: Position
    orientation: Quaternion
    velocity: Twist
    covariance: Covariance
    state: FusedState
    sources: Annotated[dict[Name, Source], msgspec.Meta(max_length=MOST_SOURCES)]


class SmoothedPose(Message, frozen=True, kw_only=True):
    """The pose in hindsight, from measurements before and after its stamp. It occurs in files of `penumbra replay --smooth`,
    never on the bus. Fields as in FusedPose, but `state` depends on the measurement nearest in time, before or after."""

    target: Name
    frame: Name
    position: Position
    orientation: Quaternion
    velocity: Twist
    covariance: Covariance
    state: FusedState


class Truth(Message, frozen=True, kw_only=True):
    """Ground truth of the emulator. `hidden`: covered share of the target's pixels in the last frame; `gap`: smallest distance
    from an electrode to the target's skin [m]."""

    target: Name
    frame: Name
    position: Position
    orientation: Quaternion
    velocity: Twist
    hidden: Share
    gap: Quantity


M = typing.TypeVar("M", bound=Message)


class Codec(typing.Generic[M]):
    """Encodes and decodes messages of one class. It is derived once from the class's declarations; get it from `codec`.

    arrays: the array fields. faults: by field, the `kind` of BadMessage for a value that msgspec refuses.
    """

    def __init__(self, kind: type[M]):
        self.kind = kind
        self.decoder = msgspec.msgpack.Decoder(kind)
        self.arrays: list[tuple[str, Array]] = []
        self.faults: dict[str, str] = {}
        for field in msgspec.structs.fields(kind):
            name, hint = field.name, field.type
            found = [each for each in getattr(hint, "__metadata__", ()) if isinstance(each, Array)]
            self.arrays += [(name, spec) for spec in found]
            bare = getattr(hint, "__origin__", hint)
            self.faults[name] = "array" if found else _FAULTS.get(bare, name)

    def encode(self, message: M) -> bytes:
        """As the function `encode`."""
        for name, spec in self.arrays:
            array = getattr(message, name)
            if not spec.fits(array):
                wanted = f"{spec.dtype} of shape {'x'.join('n' if n is None else str(n) for n in spec.shape)}"
                raise BadMessage("array", f"{name}: expected {wanted}, got {array.dtype.name} of shape {array.shape}")
        return _ENCODER.encode(message)

    def decode(self, payload: bytes) -> M:
        """As the function `decode`, without the checks of size and stamp."""
        try:
            message = self.decoder.decode(payload)
        except MemoryError:  # not a fault of the message
            raise
        except Exception as error:
            raise self.refusal(payload, error) from None
        if not payload.startswith(_LED, 1) and _version(payload) != VERSION:  # msgspec also accepts a map without a version
            raise self.refusal(payload, msgspec.ValidationError("no version"))
        for name, spec in self.arrays:
            given = getattr(message, name)
            if isinstance(given, np.ndarray):  # the default of a field that was not sent
                continue
            _, shape, data = given
            try:
                force_setattr(message, name, spec.read(shape, data))  # no other code has this message yet
            except BadMessage as error:
                raise BadMessage(error.kind, f"{self.kind.__name__}.{name}: {error}") from None
        return message

    def refusal(self, payload: bytes, error: Exception) -> BadMessage:
        """Reason why msgspec refused a payload. Another release may send other fields; then the version is the reason."""
        where = self.kind.__name__
        if not isinstance(error, msgspec.ValidationError):
            return BadMessage("msgpack", f"{where}: expected MessagePack, got {payload[:16]!r}… ({error!s:.100})")
        try:
            version = _version(payload)
        except msgspec.ValidationError:
            return BadMessage("map", f"{where}: expected a map of fields ({error!s:.300})")
        except (msgspec.DecodeError, ValueError, RecursionError) as worse:  # UnicodeDecodeError is a ValueError
            return BadMessage("msgpack", f"{where}: expected MessagePack, got {payload[:16]!r}… ({worse!s:.100})")
        if version != VERSION:
            why = f"expected wire version {VERSION}, got {_short(version)}; run one release of Penumbra everywhere"
            return BadMessage("version", f"{where}: {why}")
        found = re.search(r"\$\.(\w+)", str(error))
        kind = self.faults.get(found[1], "fields") if found else "fields"
        if kind == "number" and re.search(r"`(int|float)` [<>]=", str(error)):
            kind = "range"
        return BadMessage(kind, f"{where}: {error!s:.300}")


_FAULTS = {int: "number", float: "number", str: "text", Literal: "text"}
"""The `kind` of BadMessage for a value of the wrong type."""
_making = threading.Lock()


@functools.cache
def _made(kind: type[Message]) -> Codec[Any]:
    with _making:  # decoding a class while msgspec still compiles it in another thread crashes the process
        return Codec(kind)


codec = typing.cast(Callable[[type[M]], Codec[M]], _made)
"""The codec of a message class."""


def encode(message: Message) -> bytes:
    """MessagePack bytes of a message. Raises BadMessage where an array does not have the declared dtype and shape."""
    return codec(type(message)).encode(message)


def decode(kind: type[M], payload: bytes, now_ns: int | None = None, oldest_s: float = MAX_PAST_S) -> M:
    """The message of this kind in `payload`. With `now_ns`, its stamp must be at most oldest_s old and at most MAX_FUTURE_S
    ahead.

    Raises BadMessage that says what was expected and what was received.
    """
    if len(payload) > kind.MAX_BYTES:
        raise BadMessage("size", f"{kind.__name__}: expected at most {kind.MAX_BYTES} bytes, got {len(payload)}")
    message = codec(kind).decode(payload)
    if now_ns is not None:
        check_stamp(kind, message.stamp_ns, now_ns, oldest_s)
    return message


def check_stamp(kind: type[Message], stamp_ns: int, now_ns: int, oldest_s: float) -> None:
    """Raises BadMessage where a message's stamp is too far from the reader's clock."""
    age_s = (now_ns - stamp_ns) * 1e-9
    if age_s > oldest_s:
        raise BadMessage("past", f"{kind.__name__}: expected a stamp at most {oldest_s:g} s old, got {age_s:.3f} s")
    if age_s < -MAX_FUTURE_S:
        raise BadMessage(
            "future", f"{kind.__name__}: expected a stamp at most {MAX_FUTURE_S} s ahead, got {-age_s:.3f} s; check the clocks"
        )


class Head(msgspec.Struct, frozen=True, gc=False):
    """Fields that a reader needs of a message that it does not decode; the other fields are skipped."""

    version: Literal[VERSION]  # type: ignore[valid-type]
    stamp_ns: int
    camera: Name = ""


_HEADS = msgspec.msgpack.Decoder(Head)


def head(kind: type[Message], payload: bytes) -> Head:
    """Head of a message of this kind. Raises BadMessage where the payload is not a message of this version."""
    try:
        return _HEADS.decode(payload)
    except MemoryError:
        raise
    except Exception as error:
        raise codec(kind).refusal(payload, error) from None


def _plain(value: Any) -> Any:
    """An array as [dtype, shape, bytes], and a NumPy scalar as a Python number. msgspec supports neither."""
    if type(value) is np.ndarray:
        # `tobytes` is one call for any layout, but it copies, and images are too large for that
        data = np.ascontiguousarray(value).data if value.itemsize == 1 else value.tobytes()
        return _NAMES[value.dtype], value.shape, data
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError


_NAMES = {np.dtype(name): name for name in ("uint8", "float32", "float64")}
_ENCODER = msgspec.msgpack.Encoder(enc_hook=_plain)
_LED = msgspec.msgpack.encode({"version": VERSION})[1:]
"""First bytes of the fields of our messages."""


class _Version(msgspec.Struct):
    """The version in a message of any release. Its other fields are skipped, without creating objects."""

    version: msgspec.Raw = msgspec.Raw(msgspec.msgpack.encode(None))


def _version(payload: bytes) -> Any:
    """The version in a payload, None where it has none. Raises msgspec.DecodeError where it is not a map of names."""
    raw = msgspec.msgpack.decode(payload, type=_Version).version
    return msgspec.msgpack.decode(raw) if len(raw) <= LONGEST_TEXT else f"something of {len(raw)} bytes"


def _short(value: Any) -> str:
    """A value in a log line, shortened."""
    return f"{value!r:.60}"
