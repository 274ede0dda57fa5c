"""Inputs that may come over a wire or from a file, as strategies of hypothesis: valid ones, and damaged ones."""

from typing import Any

import msgpack
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from penumbra.shared.contract import messages

STAMPS = st.integers(0, 2**63 - 1)
FINITE = st.floats(-1e6, 1e6)
SHARES = st.floats(0, 1)
NAMES = st.text(max_size=20)


def vector(n):
    return npst.arrays(np.float64, n, elements=FINITE)


@st.composite
def quaternion(draw):
    q = draw(vector(4))
    norm = np.linalg.norm(q)
    return q / norm if norm > 1e-3 else np.array([0.0, 0.0, 0.0, 1.0])


@st.composite
def covariance(draw):
    root = draw(npst.arrays(np.float64, (6, 6), elements=st.floats(-10, 10)))
    return root @ root.T


SIDES = st.integers(1, 12)
SOURCES = st.dictionaries(NAMES, st.builds(messages.Source, age_s=FINITE, weight=SHARES), max_size=4)
POSE = {"stamp_ns": STAMPS, "target": NAMES, "frame": NAMES, "position": vector(3), "orientation": quaternion()}
POINTS = st.builds(
    messages.SurfacePoint,
    link=NAMES,
    position=st.tuples(FINITE, FINITE, FINITE),
    distance=FINITE,
    along=FINITE,
    across=FINITE,
    gap=FINITE,
)
KINDS: dict[type[messages.Message], dict[str, Any]] = {
    messages.Frame: {"stamp_ns": STAMPS, "image": st.tuples(SIDES, SIDES).flatmap(lambda s: npst.arrays(np.uint8, (*s, 3)))},
    messages.Mask: {
        "stamp_ns": STAMPS,
        "labels": st.tuples(SIDES, SIDES).flatmap(lambda s: npst.arrays(np.uint8, s)),
        "x0": st.integers(-8192, 8192),
        "y0": st.integers(-8192, 8192),
        "scale": st.integers(1, 64),
    },
    messages.Joints: {"stamp_ns": STAMPS, "position": SIDES.flatmap(vector)},
    messages.Voltages: {
        "stamp_ns": STAMPS,
        "period_ns": st.integers(1, 10**9),
        "volts": st.tuples(SIDES, SIDES).flatmap(lambda s: npst.arrays(np.float32, s, elements=st.floats(0, 4, width=32))),
    },
    messages.VisionPose: {
        **POSE,
        "camera": NAMES,
        "covariance": covariance(),
        "overlap": SHARES,
        "hidden": SHARES,
        "state": st.sampled_from(["tracking", "occluded", "lost"]),
    },
    messages.HapticPose: {
        **POSE,
        "sample_stamp_ns": STAMPS,
        "information": covariance(),
        "gap": FINITE,
        "state": st.sampled_from(["in_range", "unidentified", "object", "out_of_range"]),
        "surface": st.dictionaries(NAMES, POINTS, max_size=4),
        "contact": st.sampled_from(["none", "touch", "grip"]),
        "touched": st.lists(NAMES, max_size=4).map(tuple),
        "step": vector(6),
    },
    messages.FusedPose: {
        **POSE,
        "velocity": vector(6),
        "covariance": covariance(),
        "state": st.sampled_from(["tracking", "coasting", "lost"]),
        "sources": SOURCES,
    },
    messages.Truth: {**POSE, "velocity": vector(6), "hidden": SHARES, "gap": FINITE},
}
SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=300)
    | st.binary(max_size=64)
    | st.sampled_from(["float64", "object", "V8", "U4294967295", "float16", ">f8"])
    | st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=8))
    | st.builds(msgpack.Timestamp, st.integers(0, 2**33))
)
KEYS = st.text(max_size=8) | st.binary(max_size=8) | st.integers(0, 9)
ANYTHING = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4), max_leaves=12
)

SPOILERS = [
    *(b"\xc1", b"\xff" * 16, b"\x00" * 8, b"\xdd\xff\xff\xff\xff", b"\xdf\x7f\xff\xff\xff", b"\xc6\xff\xff\xff\xff"),
    *(b"\x91" * 40, b"\xcb\x7f\xf8" + bytes(6), b"\xcf" + b"\xff" * 8, b"Error\r\n"),
    *(b"*a", b"&a [*a]", b"<<: ", b"!!int x", b"!!timestamp x", b"{", b"[", b"- ", b"\n  ", b": ", b"? ", b"'", b"\\0"),
    *(b"0x" + b"f" * 200, b"1e999", b".nan", b"2001-99-99", b"../" * 60, b"\xed\xa0\x80"),
]
"""Pieces that have upset parsers of MessagePack, of YAML and of the boards' line."""


@st.composite
def damaged(draw, whole: bytes) -> bytes:
    """Valid bytes of which a few were changed, cut, doubled or inserted."""
    out = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(out)))
        end = min(len(out), start + draw(st.integers(0, 24)))
        match draw(st.sampled_from(["change", "cut", "double", "put in"])):
            case "change":
                out[start:end] = draw(st.binary(min_size=end - start, max_size=end - start))
            case "cut":
                del out[start:end]
            case "double":
                out[start:start] = out[start:end]
            case _:
                out[start:start] = draw(st.sampled_from(SPOILERS))
    return bytes(out)
