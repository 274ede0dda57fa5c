"""The sensing board's protocol to the byte, and the emulated board that speaks it."""

import io
import json
import math
import struct
import sys
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from penumbra.services.command import cli
from penumbra.shared.cell import description as cells
from penumbra.shared.skin import board
from penumbra.shared.skin.board import Command, Kind, PacketError
from penumbra.sim.skin.board import FAULTS, Board
from penumbra.tests.support.boards import amplitudes, ask

REST = np.array([0.2, 0.5])
PACKET = bytes.fromhex("0400" + "8000" * 6 + "0000") + struct.pack("<24I", *range(262_144, 262_144 + 24 * 128, 128))
"""128 cycles of 4 samples; a sum grows by one step a cycle from each sample to the next."""


@pytest.fixture
def device():
    return Board(lambda time_s: REST, seed=1)


def at_resonance(device, clock, samples_per_cycle=4):
    ask(device, clock, board.set_frequency(device.tank.resonance_hz, samples_per_cycle))


# ---- commands


def test_commands_are_sixteen_bytes_little_endian():
    assert board.send_measures(128).hex() == "00000000" + "80000000" + "fffffffe" * 2
    assert board.set_frequency(100e3, 4).hex() == "02000000" + "ffffffff" + "0050c347" + "00008040"
    assert Command(Kind.SET_FREQ, 0, 100e3, 400e3).pack() == struct.pack("<iIff", 1, 0, 100e3, 400e3)
    assert Command.unpack(struct.pack("<iIff", -1, 7, -2.0, 0.5)) == Command(-1, 7, -2.0, 0.5)


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (lambda: board.send_measures(0), "expected 1 to 65504 cycles, got 0, which a board never answers"),
        (lambda: board.send_measures(65505), "got 65505"),
        (lambda: board.set_frequency(100e3, 10), "expected 2 to 9, got 10; above 9 the firmware stops"),
        (lambda: board.set_frequency(-1.0, 4), "electrode_hz: expected above 0"),
        (lambda: board.set_frequency(math.nan, 4), "electrode_hz: expected above 0 .*, got nan"),
        (lambda: Command(0, -1).pack(), "expected .* measures from 0 to 2\\^32 - 1"),
        (lambda: Command.unpack(bytes(15)), "expected .* 16 bytes, got 15"),
    ],
)
def test_a_command_that_no_board_answers_is_refused_before_it_is_sent(build, text):
    with pytest.raises(PacketError, match=text):
        build()


def test_cycles_are_reached_in_steps_and_frequencies_are_whole_ticks():
    assert [board.cycles(100, 4), board.cycles(128, 4), board.cycles(129, 4), board.cycles(1, 4)] == [128, 128, 160, 32]
    assert [board.cycles(1, n) for n in board.SAMPLES_PER_CYCLE] == [64, 43, 32, 26, 21, 18, 16, 14]
    assert board.cycles(board.MOST_MEASURES, 4) == board.MOST_MEASURES
    assert board.actual_hz(100e3) == 100e3
    assert board.actual_hz(92_700.0) == 120e6 / 1294
    assert board.actual_hz(92_700.0, 4) == 120e6 / 1296


# ---- replies


def test_a_reply_is_read_to_the_last_sum():
    reply = board.decode(PACKET)
    assert reply.counts.tolist() == [128] * 6
    assert reply.sums.tolist() == [[262_144 + 128 * (4 * c + k) for k in range(4)] for c in range(6)]
    dc, component = reply.fourier()
    assert dc.tolist() == [2048 + 4 * c + 1.5 for c in range(6)]
    assert component.tolist() == [-1 + 1j] * 6  # I = (m0 - m2) / 2 = -1, Q = (m1 - m3) / 2 = -1
    assert board.encode(reply.counts, reply.sums) == PACKET


def test_at_two_samples_a_cycle_the_amplitude_is_half_of_their_difference():
    sums = np.tile([2600, 1400], (6, 1)) * 64
    dc, component = board.decode(board.encode([64] * 6, sums)).fourier()
    assert dc.tolist() == [2000] * 6
    assert component.tolist() == [600] * 6


@given(
    st.integers(2, 9).flatmap(
        lambda n: st.tuples(
            st.lists(st.integers(0, 0xFFFF), min_size=6, max_size=6),
            st.lists(st.lists(st.integers(0, 0xFFFF_FFFF), min_size=n, max_size=n), min_size=6, max_size=6),
        )
    )
)
def test_every_reply_survives_packing_and_reading(content):
    counts, sums = content
    packet = board.encode(counts, sums)
    assert len(packet) == board.reply_bytes(len(sums[0])) and packet[1] == 0 and packet[14:16] == b"\0\0"
    reply = board.decode(packet)
    assert reply.counts.tolist() == counts and reply.sums.tolist() == sums


@given(st.integers(2, 9), st.floats(0.0, 1500.0), st.floats(-3.1, 3.1), st.floats(1800.0, 2200.0))
def test_the_first_fourier_component_of_a_sine_is_its_amplitude_and_phase(n, amplitude, phase, level):
    k = np.arange(n)
    wave = level + amplitude * np.cos(2.0 * np.pi * k / n + phase)
    count = 4096
    reply = board.decode(board.encode([count] * 6, np.tile(np.rint(count * wave), (6, 1)).astype(np.int64)))
    dc, component = reply.fourier()
    seen = amplitude * np.exp(1j * phase) if n > 2 else amplitude * math.cos(phase)
    np.testing.assert_allclose(component, seen, atol=2.0 / count)  # sums are whole numbers
    np.testing.assert_allclose(dc, level, atol=1.0 / count)


SIZED = st.integers(2, 9).flatmap(
    lambda n: st.binary(min_size=board.reply_bytes(n) - 1, max_size=board.reply_bytes(n) - 1).map(bytes([n]).__add__)
)


@given(st.one_of(st.binary(max_size=300), SIZED))
@settings(max_examples=300)
def test_no_bytes_crash_the_decoder(data):
    with suppress(PacketError):
        board.decode(data).fourier()


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (
            PACKET[:-1],
            "64, 88, 112, 136, 160, 184, 208 or 232 bytes .*, and by its first byte this one has 112, got 111 bytes",
        ),
        (b"", "got 0 bytes"),
        (b"\x0b" + bytes(20), "got 21 bytes"),
        (b"\x05" + PACKET[1:], "112 bytes hold 4 samples a cycle, but the first byte says 5: 136 bytes fit"),
        (b"\x00" + PACKET[1:], "but the first byte says 0: a board takes 2 to 9"),
    ],
)
def test_a_packet_of_the_wrong_size_is_refused_with_the_sizes_that_fit(data, text):
    with pytest.raises(PacketError, match=text):
        board.decode(data)


def test_a_channel_without_cycles_has_no_amplitude():
    with pytest.raises(PacketError, match="got none in channel 2"):
        board.decode(board.encode([1, 1, 0, 1, 1, 1], np.ones((6, 4), int))).fourier()


def decode(text, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(text)))
    code = cli.main(["skin", "decode"])
    out, err = capsys.readouterr()
    return code, out, err


def test_skin_decode_prints_a_reply_as_json(monkeypatch, capsys):
    spaced = b"\n".join(PACKET.hex(" ").encode()[i : i + 48] for i in range(0, 3 * len(PACKET), 48))
    code, out, _ = decode(spaced, monkeypatch, capsys)
    found = json.loads(out)
    assert code == 0
    assert found.keys() == {"samples_per_cycle", "counts", "sums", "dc", "amplitude", "phase_deg"}
    assert found["samples_per_cycle"] == 4 and found["counts"] == [128] * 6 and found["sums"][5][3] == 262_144 + 128 * 23
    assert found["amplitude"] == pytest.approx([math.sqrt(2.0)] * 6) and found["phase_deg"] == pytest.approx([135.0] * 6)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (b"04 0g", "expected hex digits, got 'g' as character 4"),
        (b"04\xff", "expected hex digits, got '\\\\xff'"),
        (b"040", "expected two hex digits per byte, got 3 digits"),
        (b"0400", "112, got 2 bytes"),
        (b"", "got 0 bytes"),
        (b"04" + b"00" * 111, "got none in channel 0, 1, 2, 3, 4, 5"),
    ],
)
def test_skin_decode_refuses_in_one_line_what_is_no_reply(text, error, monkeypatch, capsys):
    code, out, err = decode(text, monkeypatch, capsys)
    assert code == 2 and not out
    assert err.startswith("penumbra skin decode: ") and error in err and len(err.splitlines()) == 1


# ---- the place in the stream of commands


@pytest.mark.parametrize("before", range(16))
def test_the_probes_show_where_commands_begin_whatever_came_before(before):
    stream = before * board.FILLER + b"".join(board.realign_probes())
    frames = [Command.unpack(stream[i : i + 16]) for i in range(0, len(stream) - 15, 16)]
    (probe,) = [frame for frame in frames if frame.is_answered(4)]
    found = board.realign_answer(b"Error\r\n" + probe.pack() + b"\0")
    assert found is not None
    number, answer = found
    assert (before + number) % 16 == 0 and answer == probe
    assert board.realign_answer(probe.pack(), 1) is None  # an answer that comes late is of another attempt


def test_half_a_command_followed_by_another_asks_for_nothing():
    requests = [board.send_measures(board.cycles(n, 4)) for n in (1, 100, 1000, 10_000, 65_504)]
    settings_ = [board.set_frequency(hz, n) for hz in (80e3, 92_593.0, 93_750.0) for n in (2, 4, 8)]
    for first in requests + settings_:
        for second in requests + settings_:
            frames = [Command.unpack((first + second)[k : k + 16]) for k in range(1, 16)]
            assert not any(frame.is_answered(4) for frame in frames)


# ---- the emulated board


def test_an_emulated_board_answers_with_the_frequencies_that_it_took(device):
    answer = Command.unpack(ask(device, [0.0], Command(Kind.SET_FREQ_2, 5, 92_700.0, 4.0).pack()))
    assert answer == Command(Kind.SET_FREQ_2, 5, *(float(np.float32(hz)) for hz in (120e6 / 1296, 120e6 / 324)))
    answer = Command.unpack(ask(device, [1.0], Command(Kind.SET_FREQ, 0, -1.0, -1.0).pack()))
    assert answer.electrode_hz == np.float32(120e6 / 1296)  # kept
    answer = Command.unpack(ask(device, [2.0], Command(Kind.SET_FREQ, 0, 92_700.0, 399_000.0).pack()))
    assert (answer.electrode_hz, answer.sample_hz) == (np.float32(120e6 / 1294), np.float32(120e6 / 301))


def test_replies_have_the_pads_amplitudes_noise_and_phases(device):
    clock = [0.0]
    at_resonance(device, clock)
    packets = [board.decode(ask(device, clock, board.send_measures(100))) for _ in range(1500)]
    assert packets[0].counts.tolist() == [128] * 6
    components = np.array([packet.fourier()[1] for packet in packets]) * 3.3 / 4095
    volts = np.abs(components)
    sigma = math.sqrt(6.2e-6 * 100 / 128)
    np.testing.assert_allclose(volts.mean(axis=0), np.repeat(REST, 3), rtol=2e-3, atol=4.0 * sigma / math.sqrt(1500))
    np.testing.assert_allclose(volts.std(axis=0), sigma, rtol=4.0 / math.sqrt(2 * 1500))
    levels = np.mean([packet.fourier()[0] for packet in packets], axis=0)
    np.testing.assert_allclose(levels, 2047.5, atol=0.5)  # 1.65 V
    correlation = np.corrcoef(volts.T)
    assert correlation[0, 1] > 0.99 and abs(correlation[0, 3]) < 0.1  # the noise is the electrode's, not the channel's


def test_sums_could_have_come_from_samples_of_twelve_bits():
    device, clock = Board(lambda time_s: [1.65, 0.0], seed=3), [0.0]
    at_resonance(device, clock)
    for measures in (1, 128, 4096):
        reply = board.decode(ask(device, clock, board.send_measures(measures)))
        assert reply.is_possible(board.cycles(measures, 4))
    # An amplitude of full scale is cut off by the converter: noise makes it smaller, never larger than the same without.
    assert amplitudes(ask(device, clock, board.send_measures(4096)))[0] < 1.65


def test_the_amplitude_falls_away_from_resonance_as_an_lc_tank_says(device):
    clock = [0.0]
    quality, found = device.tank.quality, []
    frequencies = np.array([80e3, 88e3, device.tank.resonance_hz, 100e3])
    for hz in frequencies:
        ask(device, clock, board.set_frequency(hz, 4))
        found.append(amplitudes(ask(device, clock, board.send_measures(60_000)))[3])
    ratio = np.array([board.actual_hz(hz, 4) for hz in frequencies]) / device.tank.resonance_hz
    expected = REST[1] / np.sqrt(1.0 + (quality * (ratio - 1.0 / ratio)) ** 2)
    np.testing.assert_allclose(found, expected, atol=4.0 * math.sqrt(6.2e-6 / 600))
    assert device.tank.resonance_hz == pytest.approx(92.7e3, rel=1e-3)


@pytest.mark.parametrize(("measures", "rate_hz"), [(128, 231), (32, 298)])
def test_replies_come_at_the_rate_of_the_real_board(device, measures, rate_hz):
    clock = [0.0]
    for _ in range(100):
        ask(device, clock, board.send_measures(measures))
    assert 100 / clock[0] == pytest.approx(rate_hz, rel=0.01)
    assert 1.0 / (board.reply_bytes(4) * board.BYTE_S) == pytest.approx(446, rel=0.01)  # what the wire allows


@pytest.mark.parametrize(
    "command", [Command(0, 0), Command(0, 65_505), Command(3), Command(-1), Command(4), Command(1 << 30)], ids=str
)
def test_some_commands_are_never_answered_and_the_next_one_is(device, command):
    clock = [0.0]
    assert ask(device, clock, command.pack()) == b""
    assert len(ask(device, clock, board.send_measures(65_504))) == 112


def test_only_the_last_of_several_pending_requests_is_answered(device):
    clock = [0.0]
    burst = ask(device, clock, b"".join(board.send_measures(n) for n in (1024, 32, 64)))
    assert len(burst) == 112 and board.decode(burst).counts[0] == 64
    device.receive(board.send_measures(1024), clock[0])
    while clock[0] + 1e-3 > (due := device.next_s()):
        device.send(due)  # begins to measure
    device.receive(board.send_measures(32) + board.send_measures(96), clock[0] + 2e-3)
    both = ask(device, [clock[0] + 2e-3], b"")
    assert [board.decode(packet).counts[0] for packet in (both[:112], both[112:])] == [1024, 96]


def test_more_than_nine_samples_a_cycle_stop_the_firmware_until_its_power_is_off(device):
    clock = [0.0]
    assert ask(device, clock, Command(Kind.SET_FREQ_2, 0, 92e3, 10.0).pack()) == b""
    assert ask(device, clock, board.send_measures(128)) == b""
    device.receive_break(clock[0])
    assert ask(device, clock, board.send_measures(128)) == b""
    device.power_on()
    assert len(ask(device, clock, board.send_measures(128))) == 112


@pytest.mark.parametrize(("samples_per_cycle", "slips"), [(2, False), (3, True), (4, False), (5, True), (7, True), (8, False)])
def test_phases_slip_where_the_samples_of_a_cycle_do_not_divide_a_block(device, samples_per_cycle, slips):
    clock = [0.0]
    at_resonance(device, clock, samples_per_cycle)
    found = amplitudes(ask(device, clock, board.send_measures(board.step(samples_per_cycle) * 40)))[3]
    seen = REST[1] if samples_per_cycle > 2 else REST[1] * math.cos(0.35)
    assert (abs(found / seen - 1.0) > 0.3) == slips


def test_a_lost_byte_of_a_command_silences_a_board_until_a_break(device):
    clock = [0.0]
    ask(device, clock, board.send_measures(128)[1:])
    assert [len(ask(device, clock, board.send_measures(128))) for _ in range(5)] == [0] * 5
    device.receive_break(clock[0])
    assert len(ask(device, clock, board.send_measures(128))) == 112


def test_faults_happen_once_and_where_they_are_asked_for(device):
    clock = [0.0]
    at_resonance(device, clock)
    request = board.send_measures(128)
    whole = ask(device, clock, request)
    device.fault("error")
    damaged = ask(device, clock, request)
    assert damaged[56:63] == b"Error\r\n" and board.decode(damaged[:56] + damaged[63:]).is_possible(128)
    device.fault("short")
    assert len(ask(device, clock, request)) == len(whole) - 1
    device.fault("missing")
    assert ask(device, clock, request) == b""
    device.fault("slip")
    mixed, after = (board.decode(ask(device, clock, request)).fourier()[1][3] for _ in range(2))
    before = board.decode(whole).fourier()[1][3]
    assert np.degrees(np.angle(after / before)) == pytest.approx(90.0, abs=3.0)
    assert abs(mixed) / abs(before) == pytest.approx(math.sqrt(0.5), abs=0.05)  # half with the one phase, half with the other
    assert len(ask(device, clock, request)) == 112
    with pytest.raises(ValueError, match="one of error, lost, short, missing, slip, got 'fire'"):
        device.fault("fire")


@given(st.lists(st.one_of(st.binary(max_size=40), st.builds(lambda k, m, e, s: struct.pack("<iIff", k, m, e, s),
       st.integers(0, 3), st.integers(0, 3000), st.floats(width=32), st.floats(width=32))), max_size=8),
       st.lists(st.sampled_from(sorted(FAULTS)), max_size=3))  # fmt: skip
@settings(max_examples=150, deadline=None)
def test_no_bytes_crash_an_emulated_board(writes, faults):
    device, clock = Board(lambda time_s: REST, seed=4), [0.0]
    for fault in faults:
        device.fault(fault)
    for data in writes:
        ask(device, clock, data)


def test_the_same_seed_gives_the_same_bytes():
    def stream(seed):
        device, clock = Board(lambda time_s: REST, seed=seed), [0.0]
        return b"".join(ask(device, clock, board.send_measures(128)) for _ in range(3))

    assert stream(5) == stream(5) != stream(6)


def test_a_pad_without_boards_in_the_cell_file_has_three_of_two_electrodes():
    cell = cells.load("table")
    found = board.readers(cell.pads["p0"], cell.pad_types["five"])
    assert [dict(reader.channels) for reader in found] == [
        {"c": (0, 1, 2), "r": (3, 4, 5)},
        {"l": (0, 1, 2), "t": (3, 4, 5)},
        {"b": (0, 1, 2)},
    ]
