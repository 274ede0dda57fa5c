"""What surrounds the haptic method: windows of voltages, where the pads are, and the service on a real bus."""

from __future__ import annotations

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from penumbra.services.haptics import service
from penumbra.services.haptics.batches import SATURATED, Backlog, Collector, VoltageWindow
from penumbra.services.haptics.pad_poses import PadPoses
from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.geometry import rigid
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import Response, networks
from penumbra.sim.world.world import TICK_NS, Sensors, World
from penumbra.tests.support.live import free_port, wait_for

MS = 1_000_000
OPTIONS = {"method": "solve", "weights": service.WEIGHTS, "window_ms": 10.0}


# ---- windows


def batch(skin: Skin, rng: np.random.Generator, level: float = 0.21) -> np.ndarray:
    return level + 0.0025 * rng.standard_normal((5, 5))


def play(collector: Collector, skin: Skin, stamps: list[int], silent: dict[str, int] | None = None) -> list:
    rng = np.random.default_rng(0)
    windows = []
    for stamp in stamps:
        for pad in skin.pads:
            if stamp < (silent or {}).get(pad, 1 << 62):
                windows.append(collector.add(pad, stamp, MS, batch(skin, rng)))
    return [w for w in windows if w is not None]


def test_windows_do_not_overlap_and_are_stamped_at_their_middle(skin: Skin) -> None:
    windows = play(Collector(skin, 10 * MS), skin, [1_000_000_000 + 5 * MS * i for i in range(1, 41)])
    assert len(windows) == 20
    assert all(set(w.samples) == {10} and not w.faults for w in windows)
    assert [w.newest_ns - w.stamp_ns for w in windows] == [4_500_000] * 20  # the middle of 0, 1, … 9 ms
    assert set(np.diff([w.newest_ns for w in windows])) == {10 * MS}


def test_a_window_is_complete_with_the_last_pads_batch_and_not_before(skin: Skin) -> None:
    collector, rng = Collector(skin, 10 * MS), np.random.default_rng(0)
    for stamp in (5 * MS, 10 * MS):
        done = [collector.add(pad, stamp, MS, batch(skin, rng)) is not None for pad in skin.pads]
    assert done == [False] * 7 + [True]


def test_the_first_window_waits_until_every_pad_had_its_chance(skin: Skin) -> None:
    collector, rng = Collector(skin, 10 * MS), np.random.default_rng(0)
    volts = 0.21 + 0.0025 * rng.standard_normal((10, 5))  # a whole window in a batch
    windows = [collector.add(pad, 1000 * MS, MS, volts) for pad in skin.pads]
    assert windows[:7] == [None] * 7
    assert windows[7] is not None and set(windows[7].samples) == {10}


def test_a_silent_pad_is_waited_for_a_little_and_then_left_out(skin: Skin) -> None:
    collector = Collector(skin, 10 * MS, patience_ns=30 * MS)
    windows = play(collector, skin, [5 * MS * i for i in range(1, 61)], silent={"p3": 100 * MS})
    assert windows[-1].faults == {"p3": "silent"} and (windows[-1].samples[skin.of(3)] == 0).all()
    assert (windows[-1].samples > 0).sum() == 35 and windows[-1].newest_ns >= 290 * MS
    assert np.diff([w.newest_ns for w in windows]).max() <= 40 * MS


@pytest.mark.parametrize("end", ["full scale", "zero"])
def test_an_electrode_that_reads_an_end_of_its_adc_is_left_out_at_once_and_alone(skin: Skin, end: str) -> None:
    collector, rng = Collector(skin, 10 * MS), np.random.default_rng(0)
    windows = []
    for stamp in (5 * MS, 10 * MS):
        for pad in skin.pads:
            volts = batch(skin, rng)
            if pad == "p1":
                volts[2:, 3] = skin.full_scale[8] if end == "full scale" else 0.0
            windows.append(collector.add(pad, stamp, MS, volts))
    assert windows[-1] is not None and set(windows[-1].faults) == {"p1/t"} and "saturated" in windows[-1].faults["p1/t"]
    assert np.flatnonzero(windows[-1].samples == 0).tolist() == [skin.names.index("p1/t")]
    assert np.flatnonzero(windows[-1].pressed).tolist() == ([skin.names.index("p1/t")] if end == "full scale" else [])


def test_an_electrode_without_any_noise_is_left_out(skin: Skin) -> None:
    collector, rng = Collector(skin, 10 * MS), np.random.default_rng(0)
    for stamp in (5 * MS * np.arange(1, 7)).tolist():
        for pad in skin.pads:
            volts = batch(skin, rng)
            volts[:, 0] = 0.21 if pad == "p0" else volts[:, 0]
            window = collector.add(pad, stamp, MS, volts)
    assert window is not None and set(window.faults) == {"p0/c"} and "dead" in window.faults["p0/c"]
    assert window.samples[0] == 0 and (window.samples[1:] == 10).all()


def test_after_a_cut_a_window_holds_new_samples_only_and_a_restart_of_the_source_is_followed(skin: Skin) -> None:
    collector = Collector(skin, 10 * MS)
    play(collector, skin, [5 * MS, 10 * MS])
    (later,) = play(collector, skin, [500 * MS])
    assert later.newest_ns == 500 * MS and later.newest_ns - later.stamp_ns < 10 * MS
    assert len(play(collector, skin, [20 * MS, 25 * MS, 30 * MS])) >= 1  # its clock began again


def test_repeated_and_overtaken_batches_are_ignored(skin: Skin) -> None:
    windows = play(Collector(skin, 10 * MS), skin, [5 * MS, 5 * MS, 10 * MS, 5 * MS, 15 * MS, 20 * MS])
    assert [w.newest_ns for w in windows] == [10 * MS, 20 * MS]
    assert all(set(w.samples) == {10} for w in windows)


def test_a_reader_that_fell_behind_leaves_windows_out_until_it_has_caught_up() -> None:
    backlog = Backlog(patience_ns=30 * MS)
    offset = 300 * MS  # the other clock is that much behind
    delays = [2, 3, 2, 50, 40, 20, 3]
    late = [backlog.is_late(10 * MS * i, 10 * MS * i + offset + delay * MS) for i, delay in enumerate(delays)]
    assert late == [False, False, False, True, True, False, False]


def test_other_rates_give_windows_too(skin: Skin) -> None:
    collector, rng = Collector(skin, 10 * MS), np.random.default_rng(0)
    stamps = (np.arange(1, 231) * 1e9 / 231).astype(int)  # the board's own pace: single rows, 231 a second
    windows = [
        w
        for s in stamps
        for p in skin.pads
        if (w := collector.add(p, int(s), 4_329_004, 0.2 + 0.003 * rng.standard_normal((1, 5))))
    ]
    assert 70 < len(windows) < 100
    assert all(w.samples.min() >= 2 for w in windows)


def test_a_batch_that_fits_no_pad_is_refused_in_words(skin: Skin) -> None:
    collector = Collector(skin, 10 * MS)
    with pytest.raises(ValueError, match=r"expected a pad of p0, .*, got 'p9'"):
        collector.add("p9", 1, MS, np.zeros((5, 5)))
    with pytest.raises(ValueError, match="expected rows of 5 electrodes"):
        collector.add("p0", 1, MS, np.zeros((5, 4)))
    with pytest.raises(ValueError, match="positive period_ns"):
        collector.add("p0", 1, 0, np.zeros((5, 5)))
    with pytest.raises(ValueError, match="--window-ms above zero"):
        Collector(skin, length_ns=0)


# ---- kinematics


def test_pads_on_a_robot_move_with_its_joints_between_two_messages() -> None:
    cell = cells.load("arm")
    models = robot_models(cell)
    skin = Skin(cell)
    poses = PadPoses(cell, skin, models)
    assert poses.at(0) is None
    (robot,) = models
    first = np.array([0.0, -0.1, 0.0, -2.0, 0.0, 1.9, 0.7])
    poses.add(robot, 0, first)
    poses.add(robot, 10 * MS, first + 0.02)
    found = poses.at(5 * MS)
    assert found is not None
    links = models[robot].link_transforms(first + 0.01)
    np.testing.assert_allclose(found[0], skin.T_world_pads({f"{robot}/{link}": T for link, T in links.items()}), atol=1e-12)
    np.testing.assert_allclose(found[1], first + 0.01)
    ahead = poses.at(15 * MS)
    assert ahead is not None
    np.testing.assert_allclose(ahead[1], first + 0.03)  # carried on
    assert poses.at(500 * MS) is None  # too long ago
    with pytest.raises(ValueError, match="expected 7 joint angles"):
        poses.add(robot, 20 * MS, np.zeros(6))


def test_fixed_pads_need_no_joint_angles(table: cells.Cell, skin: Skin) -> None:
    found = PadPoses(table, skin, {}).at(123)
    assert found is not None and found[1].shape == (0,)


# ---- the service


@pytest.mark.alone
def test_the_service_keeps_up_with_the_pads_and_goes_on_without_a_silent_one(table: cells.Cell) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    world = World(table, seed=3)
    world.plan(3.0)
    poses: list[tuple[int, messages.HapticPose]] = []
    options = SimpleNamespace(**OPTIONS)
    haptics = Node("haptics", table, bus.Connection(connect=(endpoint,)))
    service.start(haptics, options)
    reader = Node("reader", table, bus.Connection(connect=(endpoint,)))
    reader.subscribe(topics.HAPTIC, lambda message, names: poses.append((reader.now_ns(), message)))
    truths = {}
    with (
        Node("router", table, bus.Connection("router", listen=(endpoint,))),
        haptics,
        reader,
        Node("emulator", table, bus.Connection(connect=(endpoint,))) as emulator,
    ):
        sensors = Sensors(world, 0)
        sensors.tick(1)  # compiled before the clock starts
        epoch_ns = sensors.epoch_ns = emulator.now_ns()
        k, silent_ns = 0, 1 << 62

        def tick() -> None:
            nonlocal k
            k = max(k + 1, (emulator.now_ns() - epoch_ns) // TICK_NS)  # a busy machine leaves ticks out
            for topic, names, message in sensors.tick(k):
                if isinstance(message, messages.Truth):
                    truths[message.stamp_ns] = message
                elif names.get("pad") != "p5" or message.stamp_ns < silent_ns:
                    emulator.publish(topic, message, **names)
            threading.Event().wait(max(0.0, (epoch_ns + (k + 1) * TICK_NS - emulator.now_ns()) * 1e-9))

        def played(count: int) -> None:
            before = len(poses)
            wait_for(lambda: len(poses) >= before + count, 15, f"{count} poses", 0.0, tick)

        played(60)
        silent_ns = emulator.now_ns()
        played(60)
    ages_ns = [came_ns - pose.sample_stamp_ns for came_ns, pose in poses]
    periods_ns = np.diff([pose.sample_stamp_ns for _, pose in poses])
    assert np.min(ages_ns) < 0.5 * np.median(periods_ns)  # the median too on an idle machine
    assert np.diff([pose.stamp_ns for _, pose in poses]).min() > 0
    last = poses[-1][1]
    truth = truths[last.sample_stamp_ns]
    # without a camera it may be anything that is as near as a limb
    assert truth.gap > 0.12 or last.state in ("in_range", "unidentified")
    assert last.gap == pytest.approx(truth.gap, abs=0.03 + 0.3 * truth.gap)
    misfits = {name: value for name, value in haptics.report().report.items() if name.startswith("misfit/")}
    if any(pose.state == "in_range" for _, pose in poses):
        assert set(misfits) == {f"misfit/{pad}" for pad in table.pads} and max(misfits.values()) < 4.0


def test_a_fused_pose_is_looked_at_only_where_a_camera_had_a_part_in_it_lately() -> None:
    """One that rests on the skin alone would confirm the skin."""

    def fused(**sources: messages.Source) -> messages.FusedPose:
        return messages.FusedPose(
            stamp_ns=1_000 * MS,
            target="forearm",
            frame="world",
            position=np.zeros(3),
            orientation=np.array([0.0, 0.0, 0.0, 1.0]),
            velocity=np.zeros(6),
            covariance=np.eye(6),
            state="tracking",
            sources=sources,
        )

    skin_only, camera = fused(haptic=messages.Source(0.0, 1.0)), fused(vision=messages.Source(0.2, 0.1))
    assert service.seen(None, 1_000 * MS) is None and service.seen(skin_only, 1_000 * MS) is None
    assert service.seen(camera, 1_200 * MS) is camera
    assert service.seen(camera, 1_400 * MS) is None


def test_what_touches_is_in_the_health_and_is_no_fault(table: cells.Cell) -> None:
    node = Node("haptics", table, bus.Connection(connect=("tcp/127.0.0.1:1",)))
    contacts, nothing = service.Contacts(node), service.estimator(node, SimpleNamespace(**OPTIONS), table, "forearm").nothing("")
    contacts.update("forearm", nothing)
    assert node.report().report["contact"] == {"forearm": {"state": "none", "touched": []}}
    touching = replace(nothing, contact="touch", touched=("p2",))
    contacts.update("forearm", touching)
    assert node.report().report["contact"] == {"forearm": {"state": "touch", "touched": ["p2"]}}
    assert service.is_by_touch("p2/c", SATURATED, touching)
    assert not service.is_by_touch("p3/c", SATURATED, touching) and not service.is_by_touch("p2", "silent", touching)


def test_a_turned_pad_stands_out_by_its_misfit_in_the_health(table: cells.Cell, skin: Skin) -> None:
    """Its electrodes read what the ones opposite should; its estimate goes on without it."""
    node = Node("haptics", table, bus.Connection(connect=("tcp/127.0.0.1:1",)))
    misfits, which = service.Misfits(node), service.estimator(node, SimpleNamespace(**OPTIONS), table, "forearm")
    T = rigid.from_rpy((0.02, -0.02, 0.075), (0.0, 0.05, 0.1))
    T_pads_target = np.stack([rigid.inverse(pad) for pad in skin.T_world_pads()]) @ T
    signals = skin.gain * skin.sensitivity * Response(table, "forearm").change(T_pads_target)
    own = skin.of(1)
    signals[own] = signals[own][[0, 2, 1, 4, 3]]  # c r l t b, turned by a half
    rng = np.random.default_rng(0)
    for i in range(100):
        amplitude = skin.amplitude(signals / skin.gain / skin.sensitivity) + np.sqrt(skin.noise / 10) * rng.standard_normal(40)
        window = VoltageWindow((i + 1) * 10 * MS, (i + 1) * 10 * MS, amplitude, np.full(40, 10), {}, np.zeros(40, bool))
        estimate = which.update(window.stamp_ns, window.amplitude, window.samples, skin.T_world_pads())
        misfits.update(estimate, skin, window.samples)
    told = node.report().report
    assert max(told, key=told.__getitem__) == "misfit/p1" and told["misfit/p1"] > 6.0
    assert np.abs(rigid.pose_error(T, which.pose)[:3]).max() < 0.01


@pytest.mark.parametrize("is_fitted", [True, False])
def test_a_field_model_without_the_rest_of_the_person_is_reported(
    table: cells.Cell, monkeypatch: pytest.MonkeyPatch, is_fitted: bool
) -> None:
    without = {own: replace(network, bearer=None) for own, network in networks(table).items()}
    if not is_fitted:
        monkeypatch.setattr(service, "Response", lambda cell, target: Response(cell, target, without))
    told: list[str] = []
    node = SimpleNamespace(log=SimpleNamespace(warning=lambda what, **values: told.append(values["why"])))
    service.estimator(node, SimpleNamespace(**OPTIONS), table, "forearm")
    assert is_fitted == (not told) and all("penumbra skin model" in why for why in told)
