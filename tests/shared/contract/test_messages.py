"""The wire format against everything that may come over a wire."""

import threading
import time
import tracemalloc
from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from penumbra.shared.contract import messages
from penumbra.shared.contract.messages import BadMessage, decode, encode
from penumbra.tests.support.inputs import ANYTHING, KINDS
from penumbra.tests.support.nodes import pose

ALL = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)


KNOWN_HAPTIC: dict[str, Any] = {
    "stamp_ns": 1,
    "sample_stamp_ns": 1,
    "target": "forearm",
    "frame": "world",
    "position": np.zeros(3),
    "orientation": np.array([0.0, 0.0, 0.0, 1.0]),
    "information": np.eye(6),
    "gap": 0.1,
    "state": "in_range",
}


def same(a, b):
    for name in a.__struct_fields__:
        x, y = getattr(a, name), getattr(b, name)
        if isinstance(x, np.ndarray):
            np.testing.assert_array_equal(x, y)
            assert x.dtype == y.dtype
        else:
            assert x == y


def refused(kind, payload, now_ns=None):
    with pytest.raises(BadMessage) as caught:
        decode(kind, payload, now_ns)
    assert len(str(caught.value)) < 600, "a log line, not a dump"
    return caught.value


def changed(message, **fields):
    return msgpack.packb(msgpack.unpackb(encode(message)) | fields)


@ALL
@settings(max_examples=25, deadline=None)
@given(st.data())
def test_every_message_comes_back_as_it_was_sent_ready_for_compiled_code(kind, data):
    message = kind(**data.draw(st.fixed_dictionaries(KINDS[kind])))
    found = decode(kind, encode(message))
    same(found, message)
    for value in msgspec.structs.astuple(found):  # wherever its bytes began on the wire
        assert not isinstance(value, np.ndarray) or (value.flags.aligned and value.flags.c_contiguous)


@ALL
@settings(max_examples=70, deadline=None)
@given(st.data())
def test_whatever_stands_in_a_field_decode_answers_with_a_message_or_bad_message(kind, data):
    fields = msgpack.unpackb(encode(kind(**data.draw(st.fixed_dictionaries(KINDS[kind])))))
    for name in data.draw(st.sets(st.sampled_from(sorted(fields)), min_size=1)):
        if isinstance(fields[name], list) and fields[name] and data.draw(st.booleans()):  # or of an array
            fields[name][data.draw(st.integers(0, len(fields[name]) - 1))] = data.draw(ANYTHING)
        else:
            fields[name] = data.draw(ANYTHING)
    try:
        message = decode(kind, msgpack.packb(fields), time.time_ns())
    except BadMessage as error:
        assert len(str(error)) < 600
    else:
        encode(message)


@ALL
@settings(max_examples=70, deadline=None)
@given(payload=st.binary(max_size=400) | ANYTHING.map(lambda value: msgpack.packb(value)))
def test_any_other_bytes_are_refused(kind, payload):
    refused(kind, payload)


@ALL
@settings(max_examples=25, deadline=None)
@given(st.data())
def test_a_truncated_message_is_refused(kind, data):
    payload = encode(kind(**data.draw(st.fixed_dictionaries(KINDS[kind]))))
    refused(kind, payload[: data.draw(st.integers(0, len(payload) - 1))])


def test_a_message_over_its_size_limit_is_refused_unread():
    assert refused(messages.Joints, bytes(messages.Joints.MAX_BYTES + 1)).kind == "size"


@pytest.mark.parametrize("tiny", [b"\x90", b"\x80", b"\xa0", b"\x01"], ids=["lists", "maps", "texts", "integers"])
@pytest.mark.parametrize("nested", [False, True])
def test_a_large_message_of_tiny_objects_does_not_fill_the_memory(tiny, nested):
    payload = b"\xdd" + (2_000_000).to_bytes(4, "big") + 2_000_000 * tiny
    if nested:  # lists of fifteen lists of fifteen lists
        payload = tiny
        for _ in range(5):
            payload = b"\x9f" + 15 * payload
    payload = b"\x82\xa8stamp_ns\x01\xa5image" + payload
    tracemalloc.start()
    try:
        refused(messages.Frame, payload)
        assert tracemalloc.get_traced_memory()[1] < 2 * len(payload) + 1_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("version", [0, messages.VERSION + 1, 2**63, "1", None, [1], 1.5])
@ALL
def test_a_message_of_another_version_is_refused_before_its_fields_are_looked_at(kind, version):
    error = refused(kind, msgpack.packb({"version": version, "field_of_tomorrow": 1}))
    assert error.kind == "version"
    assert f"{kind.__name__}: expected wire version {messages.VERSION}, got " in str(error)


def test_a_message_without_a_version_is_refused_as_one_of_before_there_were_versions():
    fields = msgpack.unpackb(encode(pose()))
    assert fields.pop("version") == messages.VERSION
    error = refused(messages.FusedPose, msgpack.packb(fields))
    assert (error.kind, "got None" in str(error)) == ("version", True)


def test_a_thousand_levels_of_nesting_are_refused():
    deep = b"\x91" * 60_000
    assert refused(messages.Joints, deep).kind == "map"
    version = msgpack.packb({"version": messages.VERSION})[1:]
    for before in (b"\x82" + version + b"\xa8position", b"\x82" + version + b"\xa5field", b"\x81\xa7version"):
        assert refused(messages.Joints, before + deep).kind == "msgpack"


@pytest.mark.parametrize("shape", [[2**62, 2**62, 3], [2**31, 2**31, 3], [0, 0, 3], [1, 1, 3, 1], [], [True, 1, 3], [-1, 1, 3]])
def test_a_shape_that_does_not_belong_to_the_bytes_is_refused(shape):
    payload = msgpack.packb({"version": messages.VERSION, "stamp_ns": 1, "image": ["uint8", shape, b"abc"]})
    assert refused(messages.Frame, payload).kind == "array"


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
def test_an_array_with_numbers_that_are_no_measures_is_refused(value):
    position = np.array([0.0, value, 0.0])
    assert refused(messages.FusedPose, changed(pose(), position=["float64", [3], position.tobytes()])).kind == "finite"


@pytest.mark.parametrize("q", [[0.0, 0, 0, 0], [1.0, 1, 0, 0], [0.0, 0, 0, 0.9]])
def test_an_orientation_that_is_no_unit_quaternion_is_refused(q):
    error = refused(messages.FusedPose, changed(pose(), orientation=["float64", [4], np.array(q).tobytes()]))
    assert "unit quaternion" in str(error)


@pytest.mark.parametrize("matrix", [-np.eye(6), np.triu(np.ones((6, 6))), np.ones((6, 6)) - np.eye(6)])
def test_a_matrix_that_is_no_covariance_is_refused(matrix):
    assert refused(messages.FusedPose, changed(pose(), covariance=["float64", [6, 6], matrix.tobytes()])).kind == "values"


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (messages.Mask, "scale", 0),
        (messages.Mask, "scale", 2**40),
        (messages.Mask, "x0", -(2**40)),
        (messages.Mask, "x0", True),
        (messages.Mask, "x0", 1.0),
        (messages.Voltages, "period_ns", 0),
        (messages.Voltages, "period_ns", -1),
    ],
)
def test_a_number_outside_its_range_is_refused_with_the_range(kind, field, value):
    good = {
        messages.Mask: messages.Mask(stamp_ns=1, labels=np.zeros((2, 2), np.uint8), x0=0, y0=0, scale=1),
        messages.Voltages: messages.Voltages(stamp_ns=1, period_ns=1, volts=np.zeros((1, 1), np.float32)),
    }[kind]
    error = refused(kind, changed(good, **{field: value}))
    assert f"`$.{field}`" in str(error) and "Expected `int`" in str(error)
    assert error.kind == ("range" if type(value) is int else "number")


def test_a_share_that_is_off_by_rounding_is_taken():
    truth = messages.Truth(
        stamp_ns=1,
        target="a",
        frame="b",
        position=np.zeros(3),
        orientation=np.array([0.0, 0, 0, 1]),
        velocity=np.zeros(6),
        hidden=1 + 1e-12,
        gap=0.1,
    )
    same(decode(messages.Truth, encode(truth)), truth)
    assert refused(messages.Truth, changed(truth, hidden=1.5)).kind == "range"


@pytest.mark.parametrize(("offset_s", "kind"), [(-6.0, "past"), (-1e9, "past"), (1.0, "future"), (1e9, "future")])
def test_a_stamp_far_from_the_readers_clock_is_refused(offset_s, kind):
    now = time.time_ns()
    payload = encode(pose(now + int(offset_s * 1e9)))
    assert refused(messages.FusedPose, payload, now).kind == kind
    decode(messages.FusedPose, payload)  # a replay has no clock


def test_a_negative_stamp_is_refused_by_a_reader_with_a_clock():
    assert refused(messages.FusedPose, changed(pose(), stamp_ns=-(2**63)), time.time_ns()).kind == "past"


def test_encoding_an_array_of_the_wrong_shape_says_what_was_expected():
    with pytest.raises(BadMessage, match=r"position: expected float64 of shape 3, got float32 of shape \(2,\)"):
        encode(msgspec.structs.replace(pose(), position=np.zeros(2, np.float32)))


def test_an_array_is_plain_message_pack_and_is_read_where_it_lies():
    rng = np.random.default_rng(0)
    sent = [
        messages.Frame(stamp_ns=5, image=rng.integers(0, 255, (300, 400, 3), np.uint8)),
        messages.Mask(stamp_ns=5, labels=rng.integers(0, 6, (300, 400), np.uint8), x0=-3, y0=700, scale=2),
    ]
    for message, name in zip(sent, ("image", "labels"), strict=True):
        payload, expected = encode(message), getattr(message, name)
        dtype, shape, data = msgpack.unpackb(payload)[name]
        assert (np.frombuffer(data, dtype).reshape(shape) == expected).all()
        array = getattr(decode(type(message), payload), name)
        assert (array == expected).all()
        assert np.shares_memory(array, np.frombuffer(payload, np.uint8))
        assert not array.flags.writeable


def test_a_haptic_pose_of_a_sense_that_knows_no_steps_has_none():
    sent = msgpack.unpackb(encode(messages.HapticPose(**KNOWN_HAPTIC)))
    del sent["step"]
    found = decode(messages.HapticPose, msgpack.packb(sent))
    np.testing.assert_array_equal(found.step, np.zeros(6))
    same(decode(messages.HapticPose, encode(found)), found)


def test_the_fields_of_a_map_may_come_in_any_order_as_other_libraries_write_them():
    sent = pose()
    fields = msgpack.unpackb(encode(sent))
    same(decode(messages.FusedPose, msgpack.packb(dict(reversed(fields.items())))), sent)


@pytest.mark.parametrize("change", ["shorter", "longer", "head", "nested"])
def test_a_large_array_that_is_not_what_it_says_is_refused(change):
    payload = messages.encode(messages.Frame(stamp_ns=5, image=np.zeros((300, 400, 3), np.uint8)))
    damaged = {
        "shorter": payload[:-1],
        "longer": payload + b"x",
        "head": b"\xc1" + payload[1:],
        "nested": payload[:-360_000].replace(b"uint8", b"uint9") + payload[-360_000:],
    }[change]
    with pytest.raises(BadMessage):
        messages.decode(messages.Frame, damaged)


@pytest.mark.parametrize("version", [b"\xa1\x83", b"\x81\xa1\x83\x01"], ids=["text", "key"])
def test_a_version_that_is_no_utf_8_is_refused(version):
    assert refused(messages.Frame, b"\x81\xa7version" + version).kind == "msgpack"


def test_a_payload_that_is_wrong_and_cut_off_is_refused():
    cut = b"\x83\xa7versid\x00\x00\xa5image\x93\xa5uint8\x93\x02\x03\x03\xc4\x12" + bytes(18)  # a version that is no key
    with pytest.raises(messages.BadMessage):
        messages.decode(messages.Frame, cut)


def test_threads_do_not_work_out_a_class_at_the_same_time(monkeypatch):
    both, together = threading.Barrier(2), []

    class Watched(messages.Codec):
        def __init__(self, kind):
            try:
                both.wait(timeout=0.2)
                together.append(kind)
            except threading.BrokenBarrierError:
                pass  # nobody else was here
            super().__init__(kind)

    class Fresh(messages.Message, frozen=True, kw_only=True):
        pass

    monkeypatch.setattr(messages, "Codec", Watched)
    threads = [threading.Thread(target=messages.codec, args=(Fresh,)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not together
