"""Faults of the skin: made by the emulator, found in voltages alone, and by `penumbra doctor --skin` on the bus."""

import json

import numpy as np
import pytest

from penumbra.services.command import cli
from penumbra.services.skin.doctor import Examination
from penumbra.shared.body.anatomy import target_mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.contract.messages import FusedPose, Voltages
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.shared.skin.faults import LASTS, Watch, arrangements, likely
from penumbra.shared.skin.layout import Skin
from penumbra.sim.skin.faults import BOARD_WARMS_S, GAIN_PER_K, KINDS, OFFSET_PER_K, SIZES, SkinFaults
from penumbra.sim.skin.field import PadField, limb
from penumbra.tests.support.live import free_port

CELL = cells.load("table")
SKIN = Skin(CELL)
OWN = SKIN.of(0)
NAMES = tuple(CELL.pad_types["five"].electrodes)
BATCH, PERIOD_NS = 20, 1_000_000


def rest(samples, rng, signal=0.0):
    """Clean voltages (s, 5) of the first pad with nothing near, or with signals (s, 5) [V]."""
    noise = np.sqrt(SKIN.noise[OWN]) * rng.standard_normal((samples, len(NAMES)))
    return np.clip(SKIN.a3[OWN] + SKIN.polarity[OWN] * signal + noise, 0.0, SKIN.full_scale[OWN])


def watch(volts, faults=None, lost=()):
    """What a watch tells after every batch of 20 samples; batches `lost` never come."""
    found, out = Watch(SKIN, 0), []
    for i in range(len(volts) // BATCH):
        rows = slice(i * BATCH, (i + 1) * BATCH)
        if i in lost:
            continue
        batch = volts[rows] if faults is None else faults.apply(0, np.arange(len(volts))[rows] * 1e-3, volts[rows])
        out.append(found.add(10**18 + (i + 1) * BATCH * PERIOD_NS, PERIOD_NS, batch.astype("f4").astype("f8")))
    return out


@pytest.mark.parametrize(
    ("fault", "kind", "batches"),
    [
        ("dead", "dead", 1),
        ("saturated", "saturated", 1),
        ("hum", "hum", 50),
        ("hum 0.0015", "hum", 50),
        ("drift -0.05", "drift", 50 * (LASTS + 3)),  # it takes time to grow to what is below any body's signal
        ("drift 0.1", "drift", 50 * (LASTS + 4)),
    ],
)
def test_every_fault_of_an_electrode_is_reported_by_its_name_in_time(fault, kind, batches):
    faults = SkinFaults(SKIN)
    faults.command(f"p0/t {fault}", 0.0)
    told = watch(rest(BATCH * batches, np.random.default_rng(1)), faults)
    assert set(told[-1]) == {"t"} and told[-1]["t"].kind == kind
    assert told[-1]["t"].text.startswith(kind)


def test_a_fault_that_ends_is_no_longer_reported():
    rng, faults = np.random.default_rng(2), SkinFaults(SKIN)
    found, told = Watch(SKIN, 0), []
    for i in range(200):
        if i in (0, 100):
            faults.command(f"p0/r {'hum' if i == 0 else 'none'}", i * 0.02)
        volts = faults.apply(0, (i * BATCH + np.arange(BATCH)) * 1e-3, rest(BATCH, rng))
        told.append(found.add(10**18 + i * BATCH * PERIOD_NS, PERIOD_NS, volts))
    assert "r" in told[99] and not told[-1]


def test_white_noise_raises_no_alarm():
    """600 s of five electrodes: 3000 looks. One in exp(25) is what the thresholds allow, so a single alarm is a mistake."""
    rng = np.random.default_rng(3)
    assert not any(any(watch(rest(10_000, rng))) for _ in range(60))


def test_a_moving_limb_raises_no_alarm():
    """Signals of a limb that comes, goes, crosses the pad and ends above it, up to half a metre a second, by the response law."""
    rng = np.random.default_rng(4)
    seconds = 120
    time = np.arange(seconds * 50 + 1) / 50.0
    phases = rng.uniform(0, 2 * np.pi, (3, 3))
    rates = np.array([0.11, 0.37, 0.83])

    def sway(amplitudes, k):
        return np.sum(np.array(amplitudes) * np.sin(2 * np.pi * rates * time[:, None] + phases[k]), axis=1)

    height, across, along = (
        np.maximum(0.1 + sway([0.07, 0.05, 0.02], 0), 0.012),
        sway([0.06, 0.04, 0.02], 1),
        sway([0.1, 0.04, 0.02], 2),
    )
    x, y = SKIN.centroids[OWN][:, :2].T
    beyond = np.maximum(x - (along[:, None] + 0.05), 0.0)
    radius = 0.04
    gap = np.sqrt((y - across[:, None]) ** 2 + (height[:, None] + radius) ** 2 + beyond**2) - radius
    signal = SKIN.peak[OWN] / (1.0 + SKIN.a2[OWN] * gap**2)
    at = np.arange(1, seconds * 1000 + 1) / BATCH
    fine = np.stack([np.interp(at, np.arange(len(time)), column) for column in signal.T], axis=1)
    assert fine.max() > 0.2 and np.median(fine) < 0.01  # near at times, far at others
    assert not any(watch(rest(len(fine), rng, fine)))


def test_lost_batches_raise_no_alarm():
    rng = np.random.default_rng(5)
    lost = set(rng.choice(1500, 200, replace=False))
    assert not any(watch(rest(1500 * BATCH, rng), lost=lost))


def test_hum_is_found_at_both_mains_frequencies_and_at_a_boards_slower_rate():
    rng = np.random.default_rng(6)
    period = 4_300_000  # 231 samples a second
    for hz in (50.0, 60.0):
        found = Watch(SKIN, 0)
        for i in range(120):
            time = (i * 4 + np.arange(4)) * period * 1e-9
            batch = rest(4, rng)
            batch[:, 1] += 0.004 * np.sin(2 * np.pi * hz * time)
            told = found.add(10**18 + (i * 4 + 3) * period, period, batch)
        assert set(told) == {"r"} and f"{hz:g} Hz" in told["r"].text
        assert found.look is not None
        assert found.look.hum[1] == pytest.approx(0.004, rel=0.3)


def test_a_pad_whose_electrodes_all_feel_a_limb_has_not_drifted():
    far = 0.006 * SKIN.peak[OWN] / SKIN.a2[OWN] / (SKIN.peak[OWN] / SKIN.a2[OWN]).max()
    assert not any(watch(rest(10_000, np.random.default_rng(7), far)))


# ---- the emulator's commands


def test_commands_are_kept_described_and_taken_back():
    faults = SkinFaults(SKIN)
    for words in ("p0/r dead", "p1 hum 0.02", "p1/c gain", "p2 turned", "p3/t drift -0.01"):
        faults.command(words, 1.0)
    told = faults.describe()
    assert told["p0/r"] == "dead" and told["p1/c"] == f"gain {SIZES['gain']:g}" and told["p1/t"] == "hum 0.02"
    assert told["p2"] == "turned" and told["p3/t"] == "drift -0.01" and len(told) == 8
    faults.command("p1 none", 2.0)
    assert set(faults.describe()) == {"p0/r", "p2", "p3/t"}
    faults.command("all none", 3.0)
    assert faults.describe() == {}
    clean = rest(20, np.random.default_rng(8))
    assert faults.apply(0, np.zeros(20), clean) is clean


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("", "expected PAD\\[/ELECTRODE\\] FAULT \\[SIZE\\] or `all none`, got ''. Faults: dead: a broken wire"),
        ("p0/r broken", "got 'p0/r broken'. Faults: dead"),
        ("p0/r hum 1 2", "got 'p0/r hum 1 2'"),
        ("all dead", "got 'all dead'"),
        ("p9 dead", "expected a pad of p0, p1, .* such as p0/c, got 'p9'"),
        ("p0/x dead", "got 'p0/x'"),
        ("p0/r turned", "expected one of p0, .* for turned, a fault of a whole pad, got 'p0/r'"),
        ("p0/r dead 3", "dead: expected no size, got '3'"),
        ("p0/r hum loud", "expected a size of hum up to 1, got 'loud'"),
        ("p0/r hum nan", "expected a size of hum up to 1, got 'nan'"),
        ("p0/r gain 0", "expected a size of gain up to 10, got '0'"),
        ("p0/r drift 5", "expected a size of drift up to 1, got '5'"),
    ],
)
def test_a_bad_command_is_refused_with_what_is_possible(words, text):
    faults = SkinFaults(SKIN)
    with pytest.raises(ValueError, match=text):
        faults.command(words, 0.0)
    assert faults.describe() == {}


def test_faults_do_what_they_say():
    clean = rest(1000, np.random.default_rng(9), np.full((1000, 5), 0.1))
    time = np.arange(1000) * 1e-3
    level = clean.mean(axis=0)

    def made(words):
        faults = SkinFaults(SKIN)
        faults.command(words, 0.0)
        return faults.apply(0, time, clean)

    assert set(KINDS) == {"dead", "saturated", "drift", "warm", "hum", "gain", "turned", "mirrored", "none"}
    assert not made("p0/c dead")[:, 0].any()
    assert (made("p0/c saturated")[:, 0] == 1.65).all()
    assert made("p0/c gain 2")[:, 0].mean() - SKIN.a3[0] == pytest.approx(2 * (level[0] - SKIN.a3[0]))
    np.testing.assert_allclose(
        made("p0 hum 0.01").reshape(50, 20, 5).mean(axis=1), clean.reshape(50, 20, 5).mean(axis=1), atol=1e-9
    )
    np.testing.assert_array_equal(
        made("p0 turned")[:, [NAMES.index(e) for e in "rltb"]], clean[:, [NAMES.index(e) for e in "lrbt"]]
    )
    np.testing.assert_array_equal(
        made("p0 mirrored")[:, [NAMES.index(e) for e in "rltb"]], clean[:, [NAMES.index(e) for e in "lrtb"]]
    )
    drifted = made("p0/b drift 0.05")[:, NAMES.index("b")] - clean[:, NAMES.index("b")]
    assert (
        drifted[0] == 0.0 and np.all(np.diff(drifted) >= 0.0) and drifted[-1] == pytest.approx(0.05 * (1 - np.exp(-0.999 / 30)))
    )


def test_a_board_that_warms_up_changes_the_gain_and_offset_of_every_electrode_by_its_own_coefficients():
    clean = np.array([SKIN.a3[:5], SKIN.a3[:5] + 0.1])  # nothing near, then a signal of 0.1 V
    faults = SkinFaults(SKIN)
    faults.command(f"{SKIN.pads[0]} warm 10", 5.0)
    np.testing.assert_array_equal(faults.apply(0, [4.0, 5.0], clean), clean)
    half_s = 5.0 + BOARD_WARMS_S * np.log(2.0)
    half, whole = (faults.apply(0, [at, at], clean) - clean for at in (half_s, 5.0 + 30.0 * BOARD_WARMS_S))
    np.testing.assert_allclose(half, 0.5 * whole, atol=1e-9)
    gain = (whole[1] - whole[0]) / 0.1 / 10.0
    assert (gain > GAIN_PER_K[0]).all() and (gain < GAIN_PER_K[1]).all() and np.ptp(gain) > 0.0
    assert np.ptp(whole[0]) > 0.0 and np.abs(whole[0]).max() < 4.0 * 10.0 * OFFSET_PER_K


# ---- what a whole pad is likely to be


@pytest.fixture(scope="module")
def moments():
    """Signals (k, 5) [V] of a forearm at random places 3 to 9 cm before a pad, by the field model, and with a pose that is
    3 mm off."""
    rng = np.random.default_rng(10)
    field, body = PadField(CELL.pad_types["five"]), limb(target_mesh(CELL.targets["forearm"], CELL))
    true: list[np.ndarray] = []
    known: list[np.ndarray] = []
    for _ in range(24):
        T = np.eye(4)
        T[:3, 3] = rng.uniform([-0.15, -0.05, 0.08], [0.05, 0.05, 0.13])
        off = T.copy()
        off[:3, 3] += [0.002, -0.002, 0.0015]
        for out, pose in ((true, T), (known, off)):
            out.append(SKIN.signal(SKIN.amplitude(np.tile(field.change(body, pose), len(SKIN.pads))))[OWN])
    return np.stack(known), np.stack(true)


CENTROIDS = SKIN.centroids[OWN]


def suspect(moments, faulty):
    known, true = moments
    noise = SKIN.noise[OWN] / 20
    read = faulty(true) + np.sqrt(noise) * np.random.default_rng(11).standard_normal(true.shape)
    return likely(known, read, noise, np.full(len(known), 0.15), CENTROIDS)


def test_a_pad_as_the_cell_file_has_it_is_not_suspected(moments):
    assert suspect(moments, lambda true: true).text is None
    assert suspect(moments, lambda true: 1.1 * true).text is None  # within what the pose's error does


@pytest.mark.parametrize("name", ["turned by 180 degrees", "turned by 90 degrees", "mirrored top to bottom"])
def test_a_pad_that_is_mounted_wrongly_is_suspected_of_just_that(moments, name):
    place = arrangements(CENTROIDS)[name]
    found = suspect(moments, lambda true: true[:, place])
    assert found.text == name and found.left < 0.4 * found.misfit


@pytest.mark.parametrize("gain", [0.7, 1.5])
def test_a_calibration_of_another_pad_is_suspected_with_its_gain(moments, gain):
    found = suspect(moments, lambda true: gain * true)
    assert "calibrated as another pad" in found.text and found.gain == pytest.approx(gain, rel=0.2)


def test_what_nothing_explains_is_reported_without_a_reason(moments):
    found = suspect(moments, lambda true: true * [1.0, 3.0, 0.3, 0.3, 3.0])
    assert found.text == "does not fit the pose, for no known reason"


def test_likely_wants_signals_that_belong_together():
    with pytest.raises(ValueError, match=r"expected signals \(k, e\) of the same shape"):
        likely(np.ones((3, 5)), np.ones((3, 4)), np.ones(5), np.ones(3), CENTROIDS)


# ---- penumbra doctor --skin


def pads_on_the_bus(endpoint, faults, silent=()):
    """A node that publishes the voltages of every pad with nothing near."""
    node, rng = Node("emulator", CELL, bus.Connection(connect=(endpoint,))), np.random.default_rng(12)
    count = iter(range(1_000_000))
    begun_ns = node.now_ns()

    def send():
        k = next(count)
        for i, pad in enumerate(CELL.pads):
            if pad not in silent:
                stamp_ns = begun_ns + (k + 1) * BATCH * PERIOD_NS
                time = (k * BATCH + np.arange(BATCH)) * 1e-3
                volts = faults.apply(i, time, rest(BATCH, rng)).astype("f4")
                node.publish(topics.VOLTAGES, Voltages(stamp_ns=stamp_ns, period_ns=PERIOD_NS, volts=volts), pad=pad)

    node.every(0.02, send)
    return node


def test_the_doctor_finds_what_is_broken_on_the_bus_and_says_how_to_repair_it(router, capsys):
    faults = SkinFaults(SKIN)
    for words in ("p0/r dead", "p3/c saturated", "p5/b hum"):
        faults.command(words, 0.0)
    command = ["doctor", "--skin", "--seconds", "3", "--connect", router]
    with pads_on_the_bus(router, faults, silent=("p7",)).open(5.0):
        assert cli.main(command) == 1
        text = capsys.readouterr().out
        assert cli.main([*command, "--json"]) == 1
    assert "fail p0/r: dead: 20 samples at 0.000 V without noise -> check the electrode's wire" in text
    assert "fail p7: silent: no voltages received -> start its driver" in text
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["wrong"] == 4
    wrong = {
        f"{pad}/{e}": row["fault"] for pad, said in found["pads"].items() for e, row in said["electrodes"].items() if row["fault"]
    }
    assert wrong == {"p0/r": "dead", "p3/c": "saturated", "p5/b": "hum"}
    fine = found["pads"]["p1"]["electrodes"]["c"]
    assert fine["noise_V"] == pytest.approx(fine["calibrated_noise_V"], rel=0.2) and fine["hum_V"] < 1e-3


def test_the_doctor_is_content_with_a_skin_in_order(router, capsys):
    with pads_on_the_bus(router, SkinFaults(SKIN)).open(5.0):
        assert cli.main(["doctor", "--skin", "--seconds", "3", "--connect", router]) == 0
    assert "8 pads, nothing wrong" in capsys.readouterr().out


def test_the_doctor_says_when_there_is_nothing_to_look_at(router, tmp_path, capsys):
    assert cli.main(["doctor", "--skin", "--seconds", "2", "--connect", router]) == 2
    assert "cell table: expected voltages within 2 s, got none; start `penumbra up`" in capsys.readouterr().err
    bare = tmp_path / "bare.yaml"
    bare.write_text("name: bare\ntargets:\n  arm: {mesh: 'body:forearm', labels: [hand], home: {}}\n")
    assert cli.main(["doctor", "--skin", "--cell", str(bare), "--connect", router]) == 2
    assert "cell bare has no pads: there is no skin to look at" in capsys.readouterr().err
    assert cli.main(["doctor", "--skin", "--connect", f"tcp/127.0.0.1:{free_port()}"]) == 2
    assert "no router" in capsys.readouterr().err
    assert cli.main(["doctor", "--skin", "--seconds", "0.5"]) == 2
    assert "--seconds: expected 2 to 3600, got 0.5" in capsys.readouterr().err


def test_the_doctor_trusts_a_pose_that_says_nothing_is_near_more_than_a_pad_that_drifted_as_a_whole():
    """All electrodes of a warm pad rise alike, as if a limb were far away: only the pose tells."""
    examination, rng = Examination(CELL), np.random.default_rng(13)
    assert not examination.notes
    far = np.array([0.0, 0.0, 1.5])
    for i in range(150):
        stamp_ns = 10**18 + (i + 1) * BATCH * PERIOD_NS
        examination.pose(
            FusedPose(stamp_ns=stamp_ns, target="forearm", frame="world", position=far, orientation=np.array([0.0, 0, 0, 1]),
                      velocity=np.zeros(6), covariance=1e-5 * np.eye(6), state="tracking", sources={}), {},
        )  # fmt: skip
        for pad in ("p0", "p1"):
            volts = rest(BATCH, rng) + (0.006 if pad == "p1" else 0.0)
            examination.voltages(Voltages(stamp_ns=stamp_ns, period_ns=PERIOD_NS, volts=volts.astype("f4")), {"pad": pad})
    pads = examination.judge({})["pads"]
    assert all(row["fault"] == "drift" for row in pads["p1"]["electrodes"].values())
    assert not any(row["fault"] for row in pads["p0"]["electrodes"].values())


def test_a_pad_that_something_touches_is_not_called_faulty():
    """Its electrodes read the end of their scale, as those of a pad whose amplifier is turned too high do."""
    examination, rng = Examination(CELL), np.random.default_rng(14)
    for i in range(60):
        stamp_ns = 10**18 + (i + 1) * BATCH * PERIOD_NS
        volts = rest(BATCH, rng)
        volts[:, 0] = 1.65
        examination.voltages(Voltages(stamp_ns=stamp_ns, period_ns=PERIOD_NS, volts=volts.astype("f4")), {"pad": "p0"})
    alone, touched = examination.judge({})["pads"]["p0"], examination.judge({}, frozenset({"p0"}))["pads"]["p0"]
    assert alone["electrodes"]["c"]["fault"] == "saturated" and not alone["touched"]
    assert touched["electrodes"]["c"]["fault"] is None and touched["touched"]
