"""The driver of the sensing boards against emulated ones: on a line with a simulated clock, and on real pseudo-terminals."""

import itertools
import subprocess
import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from penumbra.services.command import cli
from penumbra.services.emulator.serial_boards import Terminals
from penumbra.services.skin import service
from penumbra.services.skin.driver import Batches, BoardSilent, Line, PadReader, Row, resonance
from penumbra.services.skin.port import SerialPort
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import SensingBoard
from penumbra.shared.contract import topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.shared.skin import board
from penumbra.sim.skin.board import FAULTS, Board, Tank
from penumbra.tests.support.boards import SimulatedPort
from penumbra.tests.support.live import PATIENCE_S, free_port, penumbra_command, wait_for

CELL = cells.load("table")
ELECTRODES = ["c", "r", "l", "t", "b"]
REST = {"c": 0.2, "r": 0.3, "l": 0.4, "t": 0.5, "b": 0.6}
READERS = board.readers(CELL.pads["p0"], CELL.pad_types["five"])
SIGMA = np.sqrt(6.2e-6 * 100 / 128)
"""Noise of an amplitude over 128 cycles [V]."""
KINDS = {"error": "overrun", "lost": "silent", "short": "short", "missing": "silent", "slip": "slip"}
"""What the driver calls a fault of the line."""


def emulated(amplitude=lambda name, time_s: REST[name], noise=6.2e-6):
    """The three boards of a pad, each with a coil of its own."""
    out = []
    for k, reader in enumerate(READERS):
        names = list(reader.channels)
        electrode_of = [0, 0, 0, 1, 1, 1] if len(names) == 2 else [0, 0, 0, -1, -1, -1]
        tank = Tank(coil=47e-3 * (0.98, 1.0, 1.02)[k])
        function = lambda time_s, names=names: [amplitude(name, time_s) for name in names]  # noqa: E731
        out.append(Board(function, electrode_of, seed=k, noise=noise, tank=tank))
    return out


def lines_on(ports):
    return [Line(port, sum(reader.channels.values(), ())) for port, reader in zip(ports, READERS, strict=True)]


def pad_of(lines):
    return PadReader(lines, [reader.channels for reader in READERS], ELECTRODES, 3.3 / 4095)


class SimulatedPad:
    """A tuned pad on simulated lines."""

    def __init__(self, devices):
        self.clock = [0.0]
        self.devices = devices
        self.ports = [SimulatedPort(device, self.clock, f"line {k}") for k, device in enumerate(devices)]
        self.lines = lines_on(self.ports)
        for line in self.lines:
            line.tune()
        self.reader = pad_of(self.lines)

    def rows(self, number):
        return [self.reader.read() for _ in range(number)]


@pytest.fixture
def pad():
    return SimulatedPad(emulated())


# ---- on a simulated line


def test_every_board_is_swept_to_its_own_resonance(pad):
    for line, device in zip(pad.lines, pad.devices, strict=True):
        assert line.resonance_hz == pytest.approx(device.tank.resonance_hz, rel=5e-4)
        assert line.electrode_hz == np.float32(board.actual_hz(line.resonance_hz, 4)) == np.float32(device.electrode_hz)
        assert abs(device.tank.response(line.electrode_hz)) > 0.998  # periods are multiples of four ticks


def test_a_board_without_resonance_keeps_the_standard_frequency():
    device = Board(lambda time_s: [0.0, 0.0], seed=1)
    line = Line(SimulatedPort(device, [0.0]), range(6))
    line.tune()
    assert line.resonance_hz == 0.0 and line.electrode_hz == board.ELECTRODE_HZ


@pytest.mark.parametrize("shape", [np.linspace(1.0, 2.0, 36), np.linspace(2.0, 1.0, 36), np.zeros(36), np.full(36, 1e-3)])
def test_what_has_no_peak_has_no_resonance(shape):
    assert resonance(np.linspace(80e3, 115e3, 36), shape, 0.1) == 0.0


def test_rows_are_the_electrodes_amplitudes_at_the_rate_of_the_boards(pad):
    began_s = pad.clock[0]
    rows = pad.rows(1000)
    assert 1000 / (pad.clock[0] - began_s) == pytest.approx(226, rel=0.02)  # 128 cycles at 92.7 kHz
    volts = np.array([row.volts for row in rows])
    np.testing.assert_allclose(volts.mean(axis=0), list(REST.values()), atol=1e-3)
    np.testing.assert_allclose(volts.std(axis=0), SIGMA, rtol=4.0 / np.sqrt(2000))
    assert all(not line.count.faults for line in pad.lines)


def test_stamps_are_the_middle_of_the_integration():
    pad = SimulatedPad(emulated(lambda name, time_s: 0.5 * time_s, noise=0.0))
    left = [abs(device.tank.response(device.electrode_hz)) for device in pad.devices]  # by periods of whole ticks
    for row in pad.rows(100):
        measured_s = row.volts / np.array(left)[[0, 0, 1, 1, 2]] / 0.5
        # Where the firmware's own half millisecond lies, before or after, cannot be seen from outside; and the converter's noise.
        np.testing.assert_allclose(measured_s, row.stamp_ns * 1e-9, atol=0.5e-3)
        assert row.skew_ns < 50_000  # the boards measure at the same time


@pytest.mark.parametrize("fault", sorted(FAULTS))
def test_after_a_fault_a_board_answers_again_within_50_ms_of_the_line_and_its_amplitudes_are_right(pad, fault):
    pad.rows(20)
    pad.devices[1].fault(fault)
    rows = pad.rows(10)
    count = pad.lines[1].count
    assert count.faults[KINDS[fault]] >= 1 and count.longest_s < 0.050 and count.breaks == 0
    assert rows[0] is None and sum(row is None for row in rows) <= 2
    for row in rows:
        if row is not None:
            np.testing.assert_allclose(row.volts, list(REST.values()), atol=5.0 * SIGMA)
    for other in (pad.lines[0], pad.lines[2]):
        assert not other.count.faults


@pytest.mark.parametrize("lost", range(1, 16))
def test_a_command_cut_short_anywhere_is_made_up_for_without_a_break(pad, lost):
    pad.rows(3)
    pad.devices[0].receive(board.send_measures(128)[lost:], pad.clock[0])
    rows = pad.rows(6)
    assert [row is None for row in rows] == [True] + [False] * 5 or not any(row is None for row in rows[1:])
    assert pad.lines[0].count.longest_s < 0.050 and pad.lines[0].count.breaks == 0


def test_a_board_that_the_probes_do_not_bring_back_gets_a_break_and_is_back_within_50_ms(pad):
    pad.rows(3)
    pad.ports[2].deaf = True
    rows = pad.rows(4)
    assert [row is None for row in rows] == [True, False, False, False]
    assert pad.lines[2].count.breaks == 1 and pad.lines[2].count.longest_s < 0.050


def test_a_board_that_says_nothing_any_more_is_reported_with_its_port(pad):
    pad.ports[1].dead = True
    with pytest.raises(BoardSilent, match="no answer on line 1, nor after a BREAK"):
        pad.rows(1)


def test_a_board_whose_power_was_off_is_not_read_at_a_frequency_that_it_no_longer_has(pad):
    pad.rows(3)
    pad.devices[0].power_on()
    pad.devices[0].fault("missing")
    with pytest.raises(BoardSilent, match="line 0 has lost its frequency: was its power off"):
        pad.rows(3)


def test_a_device_that_is_no_board_is_reported():
    class Echo(SimulatedPort):
        def write(self, data):
            self._came += data

    with pytest.raises(
        BoardSilent, match="expected a board that accepts 80000 Hz, got wrong answers; check whether chatty is another device"
    ):
        Line(Echo(emulated()[0], [0.0], "chatty"), range(6)).tune()


def test_many_faults_in_a_row_never_let_a_wrong_amplitude_through(pad):
    rng = np.random.default_rng(7)
    rows = []
    for _ in range(300):
        if rng.random() < 0.3:
            pad.devices[rng.integers(3)].fault(str(rng.choice(sorted(FAULTS))))
        rows += pad.rows(1)
    good = np.array([row.volts for row in rows if row is not None])
    assert len(good) > 150
    np.testing.assert_allclose(good, np.tile(list(REST.values()), (len(good), 1)), atol=6.0 * SIGMA)
    assert max(line.count.longest_s for line in pad.lines) < 0.15  # several faults may follow upon each other


def test_an_electrode_has_one_board_and_reads_nothing_without(pad):
    with pytest.raises(ValueError, match="electrode c: expected one board that measures it, got 2"):
        PadReader([], [READERS[0].channels, READERS[0].channels], ELECTRODES, 1.0)
    row = PadReader(pad.lines[:1], [READERS[0].channels], ELECTRODES, 3.3 / 4095).read()
    assert row is not None
    np.testing.assert_allclose(row.volts, [REST["c"], REST["r"], 0.0, 0.0, 0.0], atol=6.0 * SIGMA)


# ---- batches


def rows_at(*stamps_ns):
    return [Row(stamp_ns, np.full(5, 1e-9 * stamp_ns), 0) for stamp_ns in stamps_ns]


def test_batches_are_evenly_spaced_rows_and_every_row_keeps_its_time():
    batches, out = Batches(20_000_000), []
    period = 4_400_000
    stamps = [k * period for k in range(1, 12)] + [11 * period + 30_000_000 + k * period for k in range(12)]  # a gap between
    for row in rows_at(*stamps):
        out += batches.add(row)
    out += batches.flush()
    times = [stamp - period_ns * k for stamp, period_ns, volts in out for k in range(len(volts) - 1, -1, -1)]
    np.testing.assert_allclose(times, [v for _, _, volts in out for v in volts[:, 0] * 1e9], atol=period * 0.01)
    assert len(times) == len(stamps) and max(len(volts) for _, _, volts in out) == 5  # four, when the period is known


def test_a_lag_that_turns_out_to_be_less_does_not_bring_rows_nearer_to_each_other():
    period, lags = 4_400_000, (5_000_000, 5_000_000, 2_000_000, 2_000_000, 1_000_000)
    batches, out = Batches(20_000_000), []
    for k, lag in enumerate(lags):
        out += batches.add(Row(k * period + lag, np.zeros(5), 0, lag))
    ((stamp_ns, period_ns, volts),) = out
    assert (stamp_ns, period_ns, len(volts)) == (4 * period + lags[-1], period, len(lags))


def test_slow_rows_are_handed_on_at_once_when_their_period_is_known():
    batches = Batches(20_000_000)
    found = [len(batches.add(row)) for row in rows_at(0, 700_000_000, 1_400_000_000, 2_100_000_000)]
    assert found == [0, 1, 1, 1]


# ---- on real pseudo-terminals


@contextmanager
def served(devices):
    """Boards on pseudo-terminals of this process: (the paths of their devices, a function that pulls the plug)."""
    stopping = threading.Event()
    terminals = Terminals({f"p0-{k}": device for k, device in enumerate(devices)}, time.monotonic)

    def serve():
        while not stopping.is_set():
            terminals.turn()
        terminals.close()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()

    def unplug():
        stopping.set()
        thread.join(PATIENCE_S)

    try:
        yield list(terminals.devices.values()), unplug
    finally:
        unplug()


def test_a_pad_is_read_on_pseudo_terminals_and_survives_every_fault():
    devices = emulated()
    with served(devices) as (names, _):
        ports = [SerialPort(name) for name in names]
        lines = lines_on(ports)
        for line, device in zip(lines, devices, strict=True):
            line.tune()
            assert line.resonance_hz == pytest.approx(device.tank.resonance_hz, rel=5e-4)
        reader = pad_of(lines)
        for fault in FAULTS:
            devices[1].fault(fault)
            rows = [reader.read() for _ in range(12)]
            good = np.array([row.volts for row in rows if row is not None])
            assert lines[1].count.faults[KINDS[fault]] >= 1
            assert len(good) >= 4  # a busy machine may cost more than the fault
            np.testing.assert_allclose(good, np.tile(list(REST.values()), (len(good), 1)), atol=6.0 * SIGMA)
        for port in ports:
            port.close()


def test_a_break_reaches_a_board_on_a_pseudo_terminal():
    device = emulated()[0]
    with served([device]) as (names, _):
        port = SerialPort(names[0])
        port.write(board.send_measures(128)[:9])
        wait_for(lambda: device._partial, 10, "the half command")
        port.send_break()
        wait_for(lambda: not device._partial, 10, "the board to forget it")
        port.close()


@pytest.mark.parametrize(
    ("device", "text"),
    [
        ("/dev/ttyNOWHERE", "no device /dev/ttyNOWHERE: is the board plugged in\\? Serial devices now: "),
        ("/dev/null", "/dev/null cannot be opened as a serial port: "),
    ],
)
def test_a_port_that_cannot_be_used_is_reported_with_what_to_do(device, text):
    with pytest.raises(OSError, match=text):
        SerialPort(device)


def test_a_port_in_use_is_reported():
    with served(emulated()[:1]) as (names, _):
        first = SerialPort(names[0])
        with pytest.raises(OSError, match="is in use by another process: end it, or give another port"):
            SerialPort(names[0])
        first.close()


# ---- as a service


@pytest.fixture
def heard():
    """A router, the skin service on devices that a test names, and what it published: (start, messages, health)."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    messages, nodes = [], []
    router = Node("router", CELL, bus.Connection("router", listen=(endpoint,)))
    router.subscribe(topics.VOLTAGES, lambda message, names: messages.append((names["pad"], message)))

    def start(ports):
        node = Node("skin", CELL, bus.Connection(connect=(endpoint,)))
        service.start(node, SimpleNamespace(device=ports, pad="p3", cycles=128))
        nodes.append(node.open())
        return node

    with router:
        try:
            yield start, messages
        finally:
            for node in nodes:
                node.close()


def test_the_service_publishes_voltages_of_its_pad_with_the_times_of_the_measurements(heard):
    start, messages = heard
    with served(emulated()) as (names, _):
        before_ns = time.time_ns()
        node = start(names)
        wait_for(lambda: len(messages) >= 20, 30, "20 messages")
        report = node.health()["report"]["p3"]
    after_ns = time.time_ns()
    assert {pad for pad, _ in messages} == {"p3"}
    stamps = [message.stamp_ns for _, message in messages]
    assert before_ns < stamps[0] and stamps == sorted(stamps) and stamps[-1] < after_ns
    volts = np.concatenate([message.volts for _, message in messages])
    np.testing.assert_allclose(volts, np.tile(list(REST.values()), (len(volts), 1)), atol=6.0 * SIGMA)
    for _, message in messages:
        assert message.period_ns > 4_000_000  # never more than the boards can give
    assert report["state"] == "reading" and report["rate_hz"] < 231
    assert [entry["resonance_hz"] for entry in report["boards"]] == pytest.approx(
        [device.tank.resonance_hz for device in emulated()], rel=5e-4
    )


def test_a_missing_board_is_named_before_there_is_a_router(tmp_path):
    port = tmp_path / "tty"
    command = penumbra_command("skin", "--pad", "p3", "--device", str(port), "--connect", f"tcp/127.0.0.1:{free_port()}")
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as popen:
        assert popen.stderr is not None
        said = list(itertools.takewhile(lambda line: "waiting for the router" not in line, popen.stderr))
        popen.terminate()
        popen.communicate(timeout=PATIENCE_S)
    assert any("no such device yet" in line and f"port={port}" in line for line in said), said


def test_a_board_that_is_pulled_out_is_reported_and_read_again_when_it_is_back(heard, tmp_path):
    start, messages = heard
    ports = [tmp_path / f"p0-{k}" for k in range(3)]
    node = start([str(port) for port in ports])

    def plug_in(devices):
        for port, device in zip(ports, devices, strict=True):
            port.unlink(missing_ok=True)
            port.symlink_to(device)

    def state():
        return node.health()["report"]["p3"]["state"]

    wait_for(lambda: "is the board plugged in?" in state(), 10, "the missing board to be reported")
    report = node.report()
    assert report.status == "degraded" and any(why.startswith(f"pad p3: no device {ports[0]}") for why in report.reasons)
    with served(emulated()) as (names, unplug):
        plug_in(names)
        wait_for(lambda: messages, 30, "the first message")
        unplug()
        wait_for(lambda: state() != "reading", 10, "the lost board to be reported")
    messages.clear()
    with served(emulated()) as (names, _):
        plug_in(names)
        wait_for(lambda: messages, 30, "a message from the board that is back")
        assert state() == "reading"
        assert not [why for why in node.report().reasons if why.startswith("pad p3")]


@pytest.mark.parametrize(
    ("argv", "text"),
    [
        ([], "no pad of cell table has boards: give --device DEVICE, or `boards:` in the cell file"),
        (["--pad", "p1"], "pad p1 of cell table has no boards: give --device"),
        (["--pad", "p9"], "cell table has no pad 'p9'"),
        (["--device", "/dev/a"] * 4, "--device: expected a port per board, got /dev/a twice"),
        (
            [word for name in "abcd" for word in ("--device", f"/dev/{name}")],
            "pad p0: expected 3 ports, one per board (c, r; l, t; b), got 4; give --device for each, in this order",
        ),
        (["--device", "/dev/a", "--device", "/dev/b", "--device", "/dev/a"], "expected a port per board, got /dev/a twice"),
        (
            ["--device", "/dev/a", "--device", "/dev/b", "--device", "/dev/c", "--cycles", "0"],
            "--cycles: expected 1 to 60000, got 0",
        ),
    ],
)
def test_ports_that_do_not_fit_the_pad_are_refused_in_one_line(argv, text, capsys):
    assert cli.main(["skin", *argv]) == 2
    err = capsys.readouterr().err
    assert text in err and len(err.splitlines()) == 1


def test_the_cell_file_can_name_ports_and_channels():
    boards = [
        SensingBoard(port="/dev/x", channels={"t": (0, 1), "b": (2, 3), "l": (4, 5)}),
        SensingBoard(port="/dev/y", channels={"c": (0,), "r": (5,)}),
    ]
    cell = CELL.model_copy(update={"pads": {**CELL.pads, "p2": CELL.pads["p2"].model_copy(update={"boards": tuple(boards)})}})
    assert service.pads(cell, (), None) == {"p2": tuple(boards)}
    assert [reader.port for reader in service.pads(cell, ["/dev/v", "/dev/w"], "p2")["p2"]] == ["/dev/v", "/dev/w"]
    boards[1] = boards[1].model_copy(update={"port": None})
    cell.pads["p2"] = CELL.pads["p2"].model_copy(update={"boards": tuple(boards)})
    with pytest.raises(
        cells.CellError, match=r"pads.p2.boards: expected a port of every board; add it, or give --pad p2 --device"
    ):
        service.pads(cell, (), None)
