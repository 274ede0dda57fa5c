"""The client against a real router, a real fusion and real readers."""

import asyncio
import contextlib
import dataclasses
import math
import os
import subprocess
import sys
import threading
import time
from functools import partial
from typing import Any, cast

import numpy as np
import pytest

import penumbra
from penumbra.services.command import certs
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, outline, topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.guard import RATE_TIMES
from penumbra.shared.runtime.node import Node
from penumbra.tests.support.cells import derive
from penumbra.tests.support.live import PATIENCE_S, free_port, wait_for
from penumbra.tests.support.nodes import pose as a_pose
from penumbra.tests.support.small import POSITION, Small, small


def where(chain):
    return chain.connection.where


@pytest.fixture
def table(router):
    with small("table", router) as chain, chain.fusion():
        yield chain


@pytest.fixture
def cell(table):
    with penumbra.connect(endpoint=where(table), timeout=30) as cell:
        yield cell


@pytest.fixture
def received(table):
    """Opens a reader of a topic in the cell, as a service has it; returns the list of what it receives and its report."""
    nodes: list[Node] = []

    def read(topic, **names):
        node = table.node(f"reader-{len(nodes)}")
        found = []
        node.subscribe(topic, lambda message, _: found.append(message), **names)
        nodes.append(node.open())
        return found, node

    yield read
    for node in nodes:
        node.close()


def until(publish, found, what):
    """Publishes again and again until something is received."""

    def step():
        publish()
        return found

    wait_for(step, 10, what, 0.05)


# ---- poses


def tracked(poses):
    return next(pose for pose in poses if pose.state == "tracking")


def test_a_pose_has_every_number_in_the_shape_that_is_documented(table, cell):
    table.seen.set()
    pose = tracked(cell.poses(timeout=10))
    assert (pose.target, pose.frame) == ("forearm", "world")
    np.testing.assert_allclose(pose.T[:3, 3], POSITION, atol=0.01)
    np.testing.assert_allclose(pose.T[:3, :3] @ pose.T[:3, :3].T, np.eye(3), atol=1e-12)
    assert (pose.T[3] == [0, 0, 0, 1]).all() and (pose.position == pose.T[:3, 3]).all()
    assert pose.covariance.shape == (6, 6) and pose.velocity.shape == (6,) and pose.orientation.shape == (4,)
    np.testing.assert_allclose(pose.sigma**2, pose.covariance.diagonal())
    np.testing.assert_allclose(pose.rpy, 0, atol=0.05)
    assert pose.sources["vision"].weight == pytest.approx(1) and pose.sources["vision"].age_s < 1
    assert 0 <= pose.age_s < 5
    with pytest.raises(dataclasses.FrozenInstanceError):
        pose.state = "lost"
    for array in (pose.T, pose.covariance, pose.velocity, pose.orientation):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_the_pose_of_a_moment_is_asked_for_by_its_stamp(table, cell):
    table.seen.set()
    tracked(cell.poses(timeout=10))
    stamp_ns = time.time_ns() - 20_000_000
    assert cell.pose(at=stamp_ns, target="forearm").stamp_ns == stamp_ns
    assert cell.pose().stamp_ns > stamp_ns
    with pytest.raises(ValueError, match="stamp_ns: expected nanoseconds"):
        cell.pose(at=time.time_ns() + 10**9)


@dataclasses.dataclass
class Numbered:
    """A chain whose poses are numbered: x is their number; sent: how many there were."""

    chain: Small
    sent: int = 0

    def publish(self, node: Node, stop: threading.Event) -> None:
        """At 200 Hz."""
        while not stop.wait(0.005):
            node.publish(topics.FUSED, a_pose(x=float(self.sent)), target="forearm")
            self.sent += 1

    def has_sent(self, number: int) -> bool:
        return self.sent >= number


@pytest.fixture
def numbered(router):
    """A cell whose poses are numbered, at 200 Hz; described by a fusion that leaves publishing to others."""
    with small("table", router) as chain:
        node = chain.node("fusion")
        node.answer(topics.description("table"), lambda parameters, payload: outline.of(chain.cell).encode())
        stop = threading.Event()
        with node:
            found = Numbered(chain)
            thread = threading.Thread(target=found.publish, args=(node, stop))
            thread.start()
            yield found
            stop.set()
            thread.join()


SLOW = 40
"""A reader that takes a pose when so many have been sent since the last is slow: 5 Hz of 200."""


def assert_newest(numbers):
    """Each is taken as it was published, not from a queue, in which they would follow one another."""
    steps = np.diff(numbers)
    assert (steps > 0.5 * SLOW).all(), steps


def test_a_slow_reader_gets_the_newest_of_200_poses_a_second_and_no_queue(numbered):
    numbers = []
    with penumbra.connect(endpoint=where(numbered.chain), timeout=30) as cell:
        for pose in cell.poses(timeout=10):
            numbers.append(pose.position[0])
            if len(numbers) == 8:
                break
            wait_for(partial(numbered.has_sent, numbered.sent + SLOW), 5, "the next poses")
    assert_newest(numbers)


def test_a_slow_async_reader_gets_the_newest_too_while_other_tasks_run(numbered):
    numbers, ticks = [], 0

    async def tick() -> None:
        nonlocal ticks
        while True:
            await asyncio.sleep(0.01)  # no wait: what the other task does
            ticks += 1

    async def main() -> None:
        async with penumbra.aconnect(endpoint=where(numbered.chain), timeout=30) as cell:
            ticking = asyncio.create_task(tick())
            async for pose in cell.poses(timeout=10):
                numbers.append(pose.position[0])
                if len(numbers) == 8:
                    break
                await asyncio.to_thread(wait_for, partial(numbered.has_sent, numbered.sent + SLOW), 5, "the next poses")
            ticking.cancel()

    asyncio.run(main())
    assert_newest(numbers)
    assert ticks > 8


def test_a_fast_reader_gets_growing_stamps_and_hardly_misses_a_pose(numbered):
    with penumbra.connect(endpoint=where(numbered.chain), timeout=30) as cell:
        poses = cell.poses(timeout=10)
        found = [next(poses) for _ in range(200)]
    stamps, numbers = [pose.stamp_ns for pose in found], [pose.position[0] for pose in found]
    assert stamps == sorted(set(stamps))
    assert np.median(np.diff(numbers)) == 1, "a busy machine makes some steps long"


def test_a_silent_cell_times_out_says_why_and_the_same_iterator_goes_on(router):
    with small("table", router) as chain, contextlib.ExitStack() as stack:
        with chain.fusion():
            cell = stack.enter_context(penumbra.connect(endpoint=router, timeout=30))
            poses = cell.poses(timeout=0.5)
            next(poses)
        with pytest.raises(TimeoutError, match=r"no pose for 0.5 s: no fusion of cell table answers: start `penumbra fusion`"):
            [next(poses) for _ in range(10)]
        with pytest.raises(TimeoutError, match=r"no pose of forearm within 0.2 s: no fusion of cell table answers"):
            cell.pose(timeout=0.2)
        with chain.fusion():
            assert next(poses).target == "forearm"


def test_a_timeout_shorter_than_a_pose_takes_does_not_call_fusion_missing(cell):
    with pytest.raises(TimeoutError, match="no pose for 0 s: fusion of cell table runs: give a longer timeout"):
        for _ in range(1000):
            next(cell.poses(timeout=0))
    with pytest.raises(TimeoutError, match="no pose of forearm within 1e-06 s: fusion of cell table runs: give a longer timeout"):
        for _ in range(1000):
            cell.pose(timeout=1e-6)


def test_a_lost_router_is_named_and_poses_resume_when_it_is_back():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    open_router = lambda: bus.open_session(  # noqa: E731
        bus.Connection("router", (), (endpoint,)), threading.Event(), lambda: None, 5.0
    )
    router = open_router()
    with small("table", endpoint) as chain, chain.fusion(), penumbra.connect(endpoint=endpoint, timeout=30) as cell:
        poses = cell.poses(timeout=0.5)
        before = next(poses)
        router.close()

        def reason() -> str:
            try:
                next(poses)
            except TimeoutError as error:
                return str(error)
            return ""

        wait_for(lambda: f"the router at {endpoint} does not answer" in reason(), 10, "the router to be missed")
        router = open_router()
        resumed = wait_for(lambda: not reason() and next(poses), 20, "poses after the router came back")
        assert resumed.stamp_ns > before.stamp_ns
        router.close()


def test_a_bad_message_is_skipped_and_reported_once(numbered, caplog):
    with penumbra.connect(endpoint=where(numbered.chain), timeout=30) as cell, numbered.chain.node("noise") as noise:
        poses = cell.poses(timeout=10)
        for _ in range(20):
            noise.session.put(topics.FUSED.at(cell="table", target="forearm"), b"nonsense")
            assert next(poses).state == "tracking"
    refused = [record for record in caplog.records if "refused" in record.getMessage() and record.name == "penumbra.client"]
    assert len(refused) == 1


def test_an_iterator_that_nobody_holds_ends_its_subscription(numbered):
    with penumbra.connect(endpoint=where(numbered.chain), timeout=30) as cell:
        poses = cell.poses(timeout=10)
        next(poses)
        slot = poses._slot
        del poses
        wait_for(lambda: slot.is_closed, 5, "the end of the subscription")


def test_a_program_that_still_holds_poses_when_it_ends_exits(table):
    program = "import penumbra; cell = penumbra.connect(timeout=30); poses = cell.poses(timeout=30); next(poses)"
    environment = {**os.environ, "PENUMBRA_CONNECT": where(table)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=PATIENCE_S)
    assert (done.returncode, done.stderr) == (0, "")


def test_closing_the_cell_ends_a_loop_in_another_thread(cell):
    seen: list[penumbra.Pose] = []
    thread = threading.Thread(target=lambda: seen.extend(pose for pose in cell.poses()))
    thread.start()
    wait_for(lambda: seen, 5, "a pose in the loop")
    cell.close()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()


def test_the_async_client_asks_and_times_out_like_the_other(table):
    async def main() -> None:
        async with penumbra.aconnect("table", endpoint=where(table), timeout=30) as cell:
            assert (await cell.pose()).target == "forearm"
            assert {each.service for each in await cell.health()} >= {"fusion", "search"}
            with pytest.raises(LookupError, match="no target 'hand'; cell table has: forearm"):
                cell.poses("hand")
            silent = cell.poses(timeout=0)
            with pytest.raises(TimeoutError, match="no pose for 0 s"):
                [await anext(silent) for _ in range(1000)]
            kept = cell.poses()
        with pytest.raises(StopAsyncIteration):
            for _ in range(2):
                await anext(kept)

    asyncio.run(main())


def test_a_closed_cell_is_read_no_more(table):
    with penumbra.connect(endpoint=where(table), timeout=30) as cell:
        pass
    for read in (cell.poses, cell.pose, cell.health):
        with pytest.raises(penumbra.BusError, match=r"cell table cannot be read \(session closed\): is the cell closed\?"):
            read()

    async def main() -> None:
        async with penumbra.aconnect(endpoint=where(table), timeout=30) as cell:
            pass
        with pytest.raises(penumbra.BusError, match="is the cell closed"):
            cell.poses()
        for read in (cell.pose, cell.health):
            with pytest.raises(penumbra.BusError, match="is the cell closed"):
                await read()

    asyncio.run(main())


def test_a_cancelled_aconnect_leaves_no_session_and_no_thread():
    async def main() -> None:
        async def never() -> None:
            async with penumbra.aconnect(endpoint=f"tcp/127.0.0.1:{free_port()}", timeout=math.inf):
                pass

        with pytest.raises(TimeoutError):
            await asyncio.wait_for(never(), 0.3)

    asyncio.run(main())  # waits for its threads


# ---- which cell


def test_the_cell_says_what_it_is_made_of(cell, table):
    assert (cell.name, cell.frame) == ("table", "world")
    assert (cell.targets, cell.cameras, cell.robots) == (("forearm",), ("front",), ())
    assert cell.pads == tuple(table.cell.pads)
    camera, described = cell.camera("front"), table.cell.cameras["front"]
    np.testing.assert_array_equal(camera.K, described.K)
    np.testing.assert_array_equal(camera.T_world_camera, described.T_world_camera)
    assert cell.pad("p0").electrodes == tuple(table.cell.pad_types["five"].electrodes)
    assert {each.service: each.status for each in cell.health()}.keys() >= {"fusion", "search"}


@pytest.mark.parametrize(
    ("ask", "text"),
    [
        (lambda cell: cell.poses("hand"), "no target 'hand'; cell table has: forearm"),
        (lambda cell: cell.pose(target="hand"), "no target 'hand'; cell table has: forearm"),
        (lambda cell: cell.camera("left"), "no camera 'left'; cell table has: front"),
        (lambda cell: cell.pad("p8"), "no pad 'p8'; cell table has: p0, p1, p2, p3, p4, p5, p6, p7"),
        (lambda cell: cell.robot("panda"), "no robot 'panda'; cell table has: none"),
    ],
)
def test_a_wrong_name_is_answered_with_the_right_ones(cell, ask, text):
    with pytest.raises(LookupError) as error:
        ask(cell)
    assert str(error.value) == text


def test_without_router_fusion_or_the_right_cell_the_error_says_which_is_missing(router, tmp_path):
    nowhere = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(penumbra.BusError, match=f"no router at {nowhere}"):
        penumbra.connect(endpoint=nowhere, timeout=0.1)
    with pytest.raises(penumbra.BusError, match=f"no cell runs at {router}: start `penumbra up`"):
        penumbra.connect(endpoint=router, timeout=0.1)
    number: Any = 42
    for name, what in (("endpoint", "text, as in 'tcp/192.168.0.7:7447'"), ("secure", "a folder")):
        with pytest.raises(penumbra.BusError, match=f"^{name}: expected {what}, got 42 \\(int\\)$"):
            penumbra.connect(**{name: number})
    with pytest.raises(penumbra.BusError, match=r"^timeout: expected seconds, got '3' \(str\)$"):
        penumbra.connect(timeout=cast(Any, "3"))
    for wrong, got in (("a/b", "'a/b'"), (number, r"42 \(int\)")):
        with pytest.raises(penumbra.BusError, match=rf"expected the name of a cell \(.*\) or its YAML file, got {got}$"):
            penumbra.connect(wrong, endpoint=router)
    with pytest.raises(penumbra.CellError, match=r"no such file missing\.yaml"):
        penumbra.connect("missing.yaml", endpoint=router)
    with small("table", router) as table:
        with pytest.raises(penumbra.BusError, match=f"no fusion in cell table at {router}"):
            penumbra.connect(endpoint=router, timeout=0.5)
        with table.fusion():
            with pytest.raises(penumbra.BusError, match=f"no cell 'arm' at {router}; running there: table"):
                penumbra.connect("arm", endpoint=router, timeout=0.5)
            other = derive("table", 1, 2, tmp_path)
            with small(other, router) as second, second.fusion():
                with pytest.raises(penumbra.BusError, match=r"several cells run .*: table, table-1x2; say which"):
                    wait_for(lambda: penumbra.connect(endpoint=router, timeout=5).close(), 5, "the second cell to be found")
                with penumbra.connect(other, endpoint=router, timeout=30) as cell:
                    assert cell.targets == ("forearm", "forearm1")


def test_the_environment_says_where_and_which(table, monkeypatch):
    monkeypatch.setenv("PENUMBRA_CONNECT", where(table))
    monkeypatch.setenv("PENUMBRA_CELL", "table")
    with penumbra.connect(timeout=30) as cell:
        assert cell.name == "table"
    monkeypatch.setenv("PENUMBRA_CELL", "arm")
    with pytest.raises(penumbra.BusError, match="no cell 'arm'"):
        penumbra.connect(timeout=0.1)


def test_a_client_waits_for_a_cell_that_starts_after_it(router):
    found = []
    thread = threading.Thread(target=lambda: found.append(penumbra.connect(endpoint=router, timeout=30)))
    thread.start()
    with small("table", router) as chain, chain.fusion():
        thread.join(PATIENCE_S)
        assert found[0].name == "table"
        found[0].close()


def test_a_cell_of_another_release_is_named(router, monkeypatch):
    with small("table", router) as chain:
        node = chain.node("fusion")
        described = dataclasses.replace(outline.of(chain.cell), wire_version=messages.VERSION + 1).encode()
        node.answer(topics.description("table"), lambda parameters, payload: described)
        with node, pytest.raises(penumbra.BusError, match="run one release of Penumbra everywhere"):
            penumbra.connect(endpoint=router, timeout=30)


# ---- publishing

IMAGE = np.arange(480 * 640 * 3, dtype=np.uint32).astype(np.uint8).reshape(480, 640, 3)


def test_images_voltages_and_joints_arrive_as_a_service_reads_them(table, cell, received):
    images, reader = received(topics.FRAME, camera="front")
    camera, stamp_ns = cell.camera("front"), time.time_ns()
    until(lambda: camera.publish(IMAGE), images, "an image")
    np.testing.assert_array_equal(images[-1].image, IMAGE)
    assert stamp_ns < images[-1].stamp_ns < time.time_ns()
    volts, _ = received(topics.VOLTAGES, pad="p3")
    rows = np.linspace(0.1, 0.4, 15).reshape(3, 5)

    def publish_rows():
        now_ns = time.time_ns()
        cell.pad("p3").publish(rows, now_ns + np.array([-4_000_000, -2_000_000, 0]))
        return volts

    wait_for(publish_rows, 10, "voltages", 0.05)
    np.testing.assert_allclose(volts[-1].volts, rows, rtol=1e-6)
    assert volts[-1].period_ns == 2_000_000
    report = reader.report().topics[topics.FRAME.at(cell="table", camera="front")]
    assert not report.bad and report.dropped is not None, "they are numbered, and none is refused"


def test_a_row_at_a_time_has_the_period_since_the_one_before(table, cell, received):
    volts, _ = received(topics.VOLTAGES, pad="p0")
    pad, stamp_ns = cell.pad("p0"), time.time_ns()
    until(lambda: pad.publish(np.full(5, 0.2)), volts, "voltages")
    first = time.time_ns()
    pad.publish(np.full(5, 0.2), first)
    pad.publish(np.full(5, 0.2), first + 10_000_000)
    wait_for(lambda: volts[-1].stamp_ns == first + 10_000_000, 10, "the last row")
    assert volts[-1].period_ns == 10_000_000 and volts[-1].stamp_ns > stamp_ns


def test_joint_angles_arrive_in_the_order_of_the_robot_s_joints(router):
    with small("arm", router) as chain, chain.fusion(), penumbra.connect(endpoint=router, timeout=30) as cell:
        found = []
        node = chain.node("reader")
        node.subscribe(topics.JOINTS, lambda message, _: found.append(message.position.tolist()))
        with node:
            robot = cell.robot("panda")
            assert robot.joints == chain.cell.robots["panda"].joints
            q = [0.1 * k for k in range(len(robot.joints))]
            until(lambda: robot.publish(q), found, "joint angles")
        assert found[0] == pytest.approx(q)
        for bad, text in (
            (q[:-1], f"robot panda: expected {len(q)} joint angles"),
            ([180.0, *q[1:]], "expected radians up to 100, got 180: are these degrees?"),
            ([math.inf, *q[1:]], "expected finite numbers"),
            (["a"] * len(q), "expected numbers"),
        ):
            with pytest.raises(ValueError, match=text):
                robot.publish(bad)


@pytest.mark.parametrize(
    ("image", "stamp_ns", "text"),
    [
        (
            IMAGE[:240],
            None,
            r"camera front: expected an image, uint8 \(480, 640, 3\) .* got uint8 \(240, 640, 3\); convert or resize",
        ),
        (IMAGE[..., 0], None, r"got uint8 \(480, 640\)"),
        (IMAGE.astype(float), None, r"got float64 \(480, 640, 3\)"),
        ("front.png", None, "got str 'front.png'"),
        (
            IMAGE,
            1.7e9,
            r"expected a stamp in integer nanoseconds since the epoch.*got 1700000000.0 \(float\); multiply seconds by 1e9",
        ),
        (IMAGE, True, r"got True \(bool\)"),
        (IMAGE, 1_700_000_000, "camera front: .*at most 1.5 s old.*; a stamp is time.time_ns"),
        (IMAGE, 10**19, "camera front: .*at most 0.5 s ahead"),
    ],
)
def test_an_image_that_readers_would_refuse_is_refused_with_what_to_do(cell, image, stamp_ns, text):
    with pytest.raises(ValueError, match=text):
        cell.camera("front").publish(image, stamp_ns)


@pytest.mark.parametrize(
    ("volts", "stamps_ns", "text"),
    [
        (np.ones(4), None, r"pad p0: expected rows of 5 amplitudes \(c, r, l, t, b\), got shape \(1, 4\)"),
        (np.ones((2, 3, 5)), None, r"got shape \(2, 3, 5\)"),
        (np.full(5, 412.0), None, r"expected amplitudes up to 3.3 V, got 412: are these volts"),
        ([0.2, math.nan, 0.2, 0.2, 0.2], None, r"expected finite numbers.*; leave a faulty measurement out"),
        (np.ones((2, 5)), [1], "expected 2 stamps, one a row"),
        (np.ones((2, 5)), [1.0, 2.0], r"got float64 \(2,\); use time.time_ns"),
        (np.ones((3, 5)), [0, 1_000_000, 50_000_000], "expected stamps that grow evenly.*; send a gap as two batches"),
        (np.ones((2, 5)), [5, 5], "expected stamps that grow evenly"),
        (np.ones((0, 5)), None, "expected finite numbers|expected rows"),
    ],
)
def test_voltages_that_readers_would_refuse_are_refused_with_what_to_do(cell, volts, stamps_ns, text):
    with pytest.raises(ValueError, match=text):
        cell.pad("p0").publish(volts, stamps_ns)


def test_a_measurement_is_published_once_and_not_more_often_than_readers_accept(cell):
    pad, stamp_ns = cell.pad("p1"), time.time_ns()
    pad.publish(np.full(5, 0.2), stamp_ns)
    with pytest.raises(ValueError, match="expected a stamp after the last one"):
        pad.publish(np.full(5, 0.2), stamp_ns)
    with pytest.raises(ValueError, match="expected at most 250 messages a second, which is what readers accept, got more"):
        for k in range(int(2 * RATE_TIMES * topics.VOLTAGES.rate_hz)):
            pad.publish(np.full(5, 0.2), stamp_ns + 1000 * (k + 1))


def test_a_closed_cell_publishes_no_more(table):
    with penumbra.connect(endpoint=where(table), timeout=30) as cell:
        cell.camera("front").publish(IMAGE)
    with pytest.raises(penumbra.BusError, match="is the cell closed"):
        cell.camera("front").publish(IMAGE)
    with pytest.raises(penumbra.BusError, match="cell table is closed"):
        cell.pad("p0").publish(np.full(5, 0.2))


def test_on_a_secured_bus_a_client_reads_as_a_viewer_and_publishes_as_a_driver(tmp_path):
    certs.make(tmp_path)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    with (
        Node("router", cells.load("table"), bus.Connection("router", listen=(endpoint,), secure=tmp_path)),
        small("table", endpoint, tmp_path) as chain,
        chain.fusion(),
        penumbra.connect(endpoint=endpoint, secure=tmp_path, timeout=30) as cell,
        chain.node("segmentation") as reader,
    ):
        assert next(cell.poses(timeout=10)).target == "forearm"
        assert cell.pose().target == "forearm"
        found = []
        reader.subscribe(topics.FRAME, lambda message, _: found.append(message))
        until(lambda: cell.camera("front").publish(IMAGE), found, "an image")
