"""`penumbra skin calibrate`: laws from readings, what it says of bad ones, and what it writes."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from penumbra.services.command import cli
from penumbra.services.skin.calibration import calibrate, law, recording
from penumbra.services.skin.calibration.law import RecordingError
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import Law
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import Voltages
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.shared.skin.layout import Skin

CELL = cells.load("table")
KIND = CELL.pad_types["five"]
ELECTRODES = tuple(KIND.electrodes)
GAPS = np.array([0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.08, 0.12, 0.16, 0.2, np.inf])
FULL_SCALE, LSB = 1.65, 3.3 / 4095


def read_volts(truth, gaps, samples, rng, gain=1.0):
    """Samples of an electrode that follows a law, at gaps [m], one block of samples each."""
    clean = truth.a3 + truth.polarity * gain * np.where(
        np.isinf(gaps), 0.0, law.signal(truth, np.where(np.isinf(gaps), 1.0, gaps))
    )
    return np.repeat(clean, samples) + np.sqrt(truth.noise) * rng.standard_normal(samples * len(gaps))


def fit(volts, gaps, samples, name="c"):
    return law.fit(law.readings(np.repeat(gaps, samples), volts, FULL_SCALE, LSB, name), KIND.law(name), name)


def made(gains, polarity=1, seed=8, gaps=GAPS, samples=200):
    """A recording of one pad whose electrodes have these gains."""
    rng = np.random.default_rng(seed)
    columns = []
    for name, gain in zip(ELECTRODES, gains, strict=True):
        truth = KIND.law(name).model_copy(update={"polarity": polarity, "a3": 0.9 if polarity < 0 else 0.2})
        columns.append(read_volts(truth, gaps, samples, rng, gain))
    n = samples * len(gaps)
    labels = {name: np.full(n, "", dtype=np.str_) for name in recording.LABELS}
    numbers = {name: np.zeros(n) for name in recording.NUMBERS}
    return recording.Recording(np.repeat(gaps, samples), np.stack(columns, axis=1), ELECTRODES, labels, numbers)


@pytest.mark.parametrize("polarity", [1, -1])
@pytest.mark.parametrize("electrode", ["c", "r"])
def test_a_fit_finds_the_law_that_the_samples_follow(polarity, electrode):
    truth = KIND.law(electrode).model_copy(update={"polarity": polarity, "a3": 0.9})
    found = fit(read_volts(truth, GAPS, 500, np.random.default_rng(3), 1.2), GAPS, 500, electrode)
    assert found.law.polarity == polarity
    # 10 samples in 500 lie beyond 2.3 standard deviations; the law's own error is none here, so the fit is within its own
    assert np.all(np.abs(np.log([found.law.a1 / truth.a1 / 1.2, found.law.a2 / truth.a2])) < found.deviation[:2])
    assert abs(found.law.a3 - 0.9) < 3 * found.deviation[2]
    assert found.gain == pytest.approx(1.2, rel=0.04)  # the share that the law may be wrong by
    assert found.law.noise == pytest.approx(truth.noise, rel=0.1)  # 5000 samples: 2 % at one standard deviation


def test_a_fit_is_right_far_out_where_a_fit_of_volts_is_not():
    """Readings that follow the law only roughly close in, as real ones do: what it says at 15 cm must not pay for that."""
    gaps = GAPS[:-1]
    truth = KIND.law("c")
    bent = law.signal(truth, gaps) * (1.0 + 0.15 * np.exp(-gaps / 0.01))
    rng = np.random.default_rng(4)
    volts = np.repeat(truth.a3 + bent, 1000) + np.sqrt(truth.noise) * rng.standard_normal(1000 * len(gaps))
    rest = truth.a3 + np.sqrt(truth.noise) * rng.standard_normal(1000)
    found = fit(np.concatenate([volts, rest]), GAPS, 1000)
    assert law.signal(found.law, 0.15) == pytest.approx(law.signal(truth, 0.15), rel=0.05)


def test_one_gap_that_was_held_wrongly_hardly_moves_the_fit_and_is_named():
    truth = KIND.law("c")
    volts = read_volts(truth, GAPS, 300, np.random.default_rng(5))
    volts[300 * 5 : 300 * 6] += 0.6 * law.signal(truth, 0.06)
    found = fit(volts, GAPS, 300)
    assert found.gain == pytest.approx(1.0, rel=0.1)
    assert any("6 cm lies" in note and "above the law" in note for note in found.notes)


def test_the_noise_is_that_of_successive_samples_and_not_of_a_swaying_hand():
    time = np.arange(4000) * 1e-3
    volts = 0.3 + 0.02 * np.sin(2 * np.pi * 1.3 * time) + 2.5e-3 * np.random.default_rng(6).standard_normal(4000)
    assert np.sqrt(law.white_noise(volts)) == pytest.approx(2.5e-3, rel=0.05)


def test_the_range_ends_where_the_ratio_is_one_decibel():
    paper = Law(a1=2.66, a2=3.0e4, a3=0.2, noise=6.2e-6)
    assert law.reach(paper) == pytest.approx(0.15, abs=0.002)  # the paper's figure
    assert law.snr_db(paper, law.reach(paper)) == pytest.approx(1.0)
    assert law.reach(paper.model_copy(update={"noise": 100.0})) == 0.0


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda gaps, v: (gaps[:600], v[:600]), r"expected at least 4 gaps .*, got 3; record more"),
        (lambda gaps, v: (np.repeat([0.1, 0.11, 0.12, 0.13], 200), v[:800]), "farthest is at least twice the nearest"),
        (
            lambda gaps, v: (gaps, 0.0 * v + 0.2 + 2e-3 * np.random.default_rng(1).standard_normal(len(v))),
            "no contrast: it reads 0.2",
        ),
        (lambda gaps, v: (gaps, np.where(gaps < 0.018, v - 0.35, v)), "mixed polarity: .* the other way from 1.5 cm to 2 cm"),
        (lambda gaps, v: (gaps, np.full_like(v, 1.65)), "got 0; saturated at 1 cm, .*turn the amplifier down"),
        (lambda gaps, v: (gaps, np.where(np.arange(len(v)) % 3 > 0, np.nan, v)), "are not numbers: record them again"),
        (lambda gaps, v: (gaps, np.repeat(v.reshape(-1, 200).mean(axis=1), 200)), "no noise at all"),
    ],
)
def test_readings_that_no_law_fits_are_refused_with_the_reason(change, text):
    gaps = np.repeat(GAPS, 200)
    volts = read_volts(KIND.law("c"), GAPS, 200, np.random.default_rng(2))
    gaps, volts = change(gaps, volts)
    with pytest.raises(RecordingError, match=text):
        law.fit(law.readings(gaps, volts, FULL_SCALE, LSB, "p0/c"), KIND.law("c"), "p0/c")


def test_saturated_gaps_and_missing_samples_are_left_out_and_named():
    volts = read_volts(KIND.law("c"), GAPS, 200, np.random.default_rng(2))
    volts[:200] = 1.65
    volts[500:520] = np.nan
    found = fit(volts, GAPS, 200)
    assert found.gain == pytest.approx(1.0, rel=0.05)
    assert any("20 of 2200 samples are missing" in note for note in found.notes)
    assert any("saturated at 1 cm" in note for note in found.notes)


def test_electrodes_that_go_different_ways_are_refused_by_name():
    mixed = made([1.0] * 5)
    volts = mixed.volts.copy()
    volts[:, 2] = 0.4 - volts[:, 2] + 0.2
    with pytest.raises(RecordingError, match=r"pad p0: mixed polarity: .* c, r, t, b rise and l fall"):
        calibrate.calibrate(CELL, "p0", recording.Recording(mixed.gap, volts, ELECTRODES, mixed.labels, mixed.numbers))


# ---- recordings


@given(seed=st.integers(0, 50), separator=st.sampled_from([",", ";", "\t"]), unit=st.sampled_from(["m", "cm", "mm"]))
@settings(max_examples=15, deadline=None)
def test_recordings_are_read_in_every_layout_that_is_documented(tmp_path_factory, seed, separator, unit):
    rng = np.random.default_rng(seed)
    gaps = rng.choice(GAPS, 20)
    volts = rng.uniform(0.0, 1.6, (20, 5)).round(4)
    scale = {"m": 1.0, "cm": 100.0, "mm": 1000.0}[unit]
    point = "," if separator == ";" else "."
    rows = ["# a remark", separator.join(["Pad", f"Distance_{unit}", *(name.upper() for name in ELECTRODES), "humidity"]), ""]
    for gap, row in zip(gaps, volts, strict=True):
        where = rng.choice(["", "inf", "empty"]) if np.isinf(gap) else f"{scale * gap:.6g}"
        rows.append(separator.join(["p3", *(cell.replace(".", point) for cell in (where, *map(str, row), "40"))]))
    path = tmp_path_factory.mktemp("csv") / "r.csv"
    path.write_text("\ufeff" + "\n".join(rows))
    found = recording.read(path, ELECTRODES, "--csv")
    np.testing.assert_allclose(found.gap, gaps)
    np.testing.assert_allclose(found.volts, volts)
    assert set(found.labels["pad"]) == {"p3"} and found.notes == ("columns passed over: humidity",)


def test_a_recording_that_is_written_is_read_the_same(tmp_path):
    before = made([1.0] * 5, samples=20)
    before.numbers["angle_deg"][:20] = 30.0
    recording.write(tmp_path / "deep" / "r.csv", before, "made")
    after = recording.read(tmp_path / "deep" / "r.csv", ELECTRODES, "--csv")
    np.testing.assert_allclose(after.gap, before.gap)
    np.testing.assert_allclose(after.volts, before.volts, atol=1e-6)
    np.testing.assert_allclose(after.numbers["angle_deg"], before.numbers["angle_deg"])


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "expected a line of column names and samples below it, got 0 lines"),
        ("c,r,l,t,b\n1,1,1,1,1\n", "expected the columns distance_m .*, got c, r, l, t, b"),
        ("distance_m,c,r,l,t\n0.1,1,1,1,1\n", "got distance_m, c, r, l, t"),
        ("distance_m,c,c,r,l,t,b\n0.1,1,1,1,1,1,1\n", "every column once"),
        ("distance_m,c,r,l,t,b\n0.1,1,1,1,1\n", "csv:2: expected 6 cells .*, got 5"),
        ("distance_m,c,r,l,t,b\n0.1,1,high,1,1,1\n", "csv:2: expected a number for r, got 'high'"),
        ("distance_m,c,r,l,t,b\n0.1,1,1,1,1,1\nfar,1,1,1,1,1\n", "csv:3: expected a number for distance_m, got 'far'"),
        ("distance_m,c,r,l,t,b\n15,1,1,1,1,1\n", "csv:2: expected a distance from 0 to 2 m, got 15 m"),
        ("distance_m,c,r,l,t,b\n0.1,1,-1,1,1,1\n", "csv:2: expected an amplitude of at least 0 V, got -1 for r"),
        ("distance_m,c,r,l,t,b\n0.1,614,1,1,1,1\n", "expected amplitudes in volts, got 614; check whether they are millivolts"),
        ("distance_m,c,r,l,t,b,angle_deg\n0.1,1,1,1,1,1,nan\n", "csv:2: expected a number for angle_deg"),
    ],
)
def test_a_bad_recording_is_refused_with_its_line(tmp_path, text, complaint):
    path = tmp_path / "r.csv"
    path.write_text(text)
    with pytest.raises(RecordingError, match=complaint):
        recording.read(path, ELECTRODES, "--csv")


# ---- the command and the cell file


@pytest.fixture
def own_cell(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        cells.source("table")
        .read_text()
        .replace(
            "p3: {type: five, position: [0.12, -0.04, 0.0]}", "p3: {type: five, position: [0.12, -0.04, 0.0]}   # the wrist's"
        )
    )
    return path


def test_a_calibration_is_written_between_the_lines_of_the_cell_file(tmp_path, own_cell, capsys):
    recording.write(tmp_path / "r.csv", made([1.1, 0.9, 1.0, 1.0, 1.05]), "made")
    before = own_cell.read_text().splitlines()
    assert cli.main(["skin", "calibrate", "--cell", str(own_cell), "--pad", "p1", "--csv", str(tmp_path / "r.csv")]) == 0
    out = capsys.readouterr().out
    assert "calibration of p1 written" in out and "15 cm" in out and "1 dB at" in out
    after = own_cell.read_text().splitlines()
    at = next(i for i, line in enumerate(before) if line.startswith("  p1:"))
    assert after[:at] == before[:at] and after[at] == "  p1:"
    assert after[-(len(before) - at - 1) :] == before[at + 1 :]  # not a comment or a space has moved
    cell = cells.load(own_cell)
    assert list(cell.pads["p1"].calibration) == list(ELECTRODES) and not cell.pads["p0"].calibration
    skin = Skin(cell)
    assert skin.peak[5] == pytest.approx(cell.pads["p1"].calibration["c"].a1)
    # again: the calibration is replaced, not doubled
    assert cli.main(["skin", "calibrate", "--cell", str(own_cell), "--pad", "p1", "--csv", str(tmp_path / "r.csv")]) == 0
    assert own_cell.read_text().splitlines() == after


def test_a_built_in_cell_is_not_overwritten_but_copied(tmp_path, capsys):
    path = tmp_path / "r.csv"
    recording.write(path, made([1.0] * 5), "made")
    source = cells.source("table").read_text()
    assert cli.main(["skin", "calibrate", "--csv", str(path)]) == 2
    assert "the built-in cell table is not overwritten: give --out FILE" in capsys.readouterr().err
    assert cli.main(["skin", "calibrate", "--csv", str(path), "--dry-run"]) == 0
    assert cli.main(["skin", "calibrate", "--csv", str(path), "--out", str(tmp_path / "new.yaml"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["p0"]["c"]["reach_m"] == pytest.approx(law.reach(KIND.law("c")), rel=0.05)
    assert cells.load(tmp_path / "new.yaml").pads["p0"].calibration["c"].a1 == pytest.approx(found["p0"]["c"]["a1"], rel=1e-4)
    assert cells.source("table").read_text() == source


def test_what_cannot_be_calibrated_leaves_the_cell_file_alone(tmp_path, own_cell, capsys):
    bad = made([1.0] * 5)
    bad.volts[:, 3] = 0.2 + 2.5e-3 * np.random.default_rng(0).standard_normal(len(bad.volts))
    recording.write(tmp_path / "r.csv", bad, "made")
    before = own_cell.read_text()
    for arguments, text in (
        ([], "electrode p0/t: no contrast"),
        (["--pad", "p9"], "no pad 'p9'"),
        (["--csv", str(tmp_path / "none.csv")], "none.csv: expected a CSV file with the column distance_m and "),
        (["--csv", str(tmp_path)], f"--csv {tmp_path}: expected a CSV file"),
        (["--csv", str(tmp_path / "none.csv")], "it cannot be read: No such file or directory\n"),
    ):
        assert cli.main(["skin", "calibrate", "--cell", str(own_cell), "--csv", str(tmp_path / "r.csv"), *arguments]) == 2
        assert text in capsys.readouterr().err
    assert own_cell.read_text() == before


class Held:
    """A pad on the bus before which a limb is held: the gap is what the last question asked for."""

    def __init__(self, endpoint):
        self.gap, self.rng = np.inf, np.random.default_rng(9)
        self.node = Node("emulator", CELL, bus.Connection(connect=(endpoint,)))
        self.node.every(0.02, self.send)
        self.answers = iter([np.inf, *GAPS[:-1]])

    def send(self):
        gap = self.gap
        volts = np.stack([read_volts(KIND.law(name), np.array([gap]), 20, self.rng, 1.1) for name in ELECTRODES], axis=1)
        self.node.publish(
            topics.VOLTAGES, Voltages(stamp_ns=self.node.now_ns(), period_ns=1_000_000, volts=volts.astype("f4")), pad="p2"
        )

    def answer(self):
        self.gap = next(self.answers)
        return ""


@pytest.mark.slow
def test_the_guided_procedure_asks_for_every_gap_and_fits_what_the_bus_brings(router, tmp_path, monkeypatch, capsys):
    held = Held(router)
    monkeypatch.setattr("builtins.input", held.answer)
    gaps = [f"{gap:g}" for gap in GAPS[:-1]]
    with held.node.open(5.0):
        out, kept = tmp_path / "mine.yaml", tmp_path / "kept.csv"
        command = ["skin", "calibrate", "--pad", "p2", "--seconds", "0.4", "--out", str(out), "--record", str(kept), "--json"]
        assert cli.main([*command, "--connect", router, "--distances", *gaps]) == 0
    console = capsys.readouterr()
    assert "Take everything away" in console.err and "Hold the skin 12 cm above the middle of pad p2" in console.err
    found = json.loads(console.out.splitlines()[-1])["p2"]
    assert all(row["gain"] == pytest.approx(1.1, rel=0.05) for row in found.values())
    assert set(cells.load(out).pads["p2"].calibration) == set(ELECTRODES)
    # what was read by hand can be read again
    assert cli.main(["skin", "calibrate", "--csv", str(kept), "--pad", "p2", "--dry-run"]) == 0


def test_the_guided_procedure_says_what_is_missing(router, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(calibrate, "PATIENCE_S", 0.2)
    command = ["skin", "calibrate", "--pad", "p2", "--seconds", "0.1", "--out", str(tmp_path / "x.yaml"), "--connect", router]
    monkeypatch.setattr("builtins.input", lambda: "")
    assert cli.main(command) == 2
    assert "pad p2: expected voltages within 0.2 s, got none; start `penumbra skin`" in capsys.readouterr().err

    def ended():
        raise EOFError

    monkeypatch.setattr("builtins.input", ended)
    assert cli.main(command) == 2
    assert "the answers ended before the last gap" in capsys.readouterr().err
    monkeypatch.setattr("builtins.input", lambda: "q")
    assert cli.main(command) == 2
    assert "nothing was recorded" in capsys.readouterr().err
