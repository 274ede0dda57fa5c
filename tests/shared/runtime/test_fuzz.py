"""A few inputs of `tests.fuzz` each time, and what they have found once."""

import time

import pytest

from penumbra.shared.cell import description as cells
from penumbra.tests import fuzz


@pytest.mark.parametrize(("name", "inputs"), [("messages", 300), ("board", 100), ("cell", 30)])
def test_every_decoder_answers_or_refuses_whatever_comes(name, inputs, tmp_path):
    fuzz.run(name, inputs, time.time_ns() % 2**32, tmp_path)


def test_the_cell_that_is_damaged_is_good_before(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_bytes(fuzz.SMALL_CELL)
    assert cells.load(path).name == "small"


def test_a_fault_of_a_decoder_is_found(tmp_path, monkeypatch):
    def decode(kind, payload, now_ns):
        raise ZeroDivisionError

    monkeypatch.setattr(fuzz.messages, "decode", decode)
    with pytest.raises(ZeroDivisionError):
        fuzz.run("messages", 5, 1, tmp_path)


def lists(levels):
    """A list of ten lists of ten lists …, in a few lines."""
    rows = [b"a0: &a0 [1]", *(b"a%d: &a%d [%s]" % (k, k, b", ".join([b"*a%d" % (k - 1)] * 10)) for k in range(1, levels))]
    return b"\n".join(rows)


def merges(levels):
    """A map that takes in ten maps that take in ten maps …"""
    rows = [b"a0: &a0 {x: 1}"]
    rows += [b"a%d: &a%d {<<: [%s]}" % (k, k, b", ".join([b"*a%d" % (k - 1)] * 10)) for k in range(1, levels)]
    return b"\n".join(rows)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (lists(12), "expected at most 200000 values"),
        (merges(12), "expected at most 200000 values"),
        (b"name: &a [*a]", "contains itself"),
        (b"[" * 20_000, "recursion"),
        (b"name: 2001-99-99", "month must be in"),
        (b"name: !!timestamp x", "NoneType"),
        (b"name: !!bool x", "'x'"),
        (b"name: " + b"9" * 5000, "integer string conversion"),
        (b"name: \xff\xfe", "expected UTF-8, got the byte 0xff; save the file as UTF-8"),
        (b"#" * 1_000_001, "expected at most 1000000 bytes"),
        (b"cameras: {front: {width: 0x" + b"f" * 5000 + b"}}", "an integer of 20000 bits"),
        (b"name: " + b"x " * 100_000, "got 'x x"),
        (b"".join(b"k%d: 1\n" % k for k in range(5000)), "faults more"),
        (fuzz.SMALL_CELL.replace(b"body:forearm", b"m" * 300), "no file"),
        (fuzz.SMALL_CELL.replace(b"body:forearm", b"m\\0"), "no file"),
    ],
)
def test_a_cell_file_that_would_fill_the_memory_or_that_yaml_trips_over_is_refused_in_few_words(tmp_path, text, reason):
    path = tmp_path / "cell.yaml"
    path.write_bytes(text)
    before = fuzz.memory_mb()
    with pytest.raises(cells.CellError, match=reason) as caught:
        cells.load(path)
    assert len(str(caught.value)) < 30_000
    assert fuzz.memory_mb() - before < 200
