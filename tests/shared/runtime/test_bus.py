"""Real sessions and a real router on loopback."""

import json
import logging
import os
import subprocess
import threading
import time

import msgpack
import msgspec
import numpy as np
import pytest
import zenoh

from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages, topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime import reader as reader_module
from penumbra.shared.runtime.guard import RATE_TIMES
from penumbra.shared.runtime.node import Node
from penumbra.shared.runtime.traffic import RATE_WINDOW_S, Rate
from penumbra.tests.support.live import free_port, penumbra_command, wait_for
from penumbra.tests.support.nodes import pose

CELL = cells.load("table")


@pytest.fixture
def endpoint():
    """Of a router in this process."""
    where = f"tcp/127.0.0.1:{free_port()}"
    with Node("router", CELL, bus.Connection("router", listen=(where,))):
        yield where


@pytest.fixture
def node(endpoint):
    """Opens nodes at the router, and closes them."""
    nodes = []

    def make(service="test", cell=CELL):
        nodes.append(Node(service, cell, bus.Connection(connect=(endpoint,))))
        return nodes[-1]

    yield make
    for each in nodes:
        each.close()


@pytest.fixture
def log(caplog):
    """What Penumbra logs, also where an earlier test has configured its logs."""
    logger = logging.getLogger("penumbra")
    logger.propagate, before = True, logger.propagate
    with caplog.at_level(logging.INFO, "penumbra"):
        yield lambda text: [record for record in caplog.records if text in record.getMessage()]
    logger.propagate = before


def until(condition, publish, what, seconds=5.0):
    """Publishes again and again until something has happened."""
    return wait_for(condition, seconds, what, 0.01, publish)


def raw(node, topic, payload, **names):
    node.session.put(topic.at(cell="table", **names), payload)


def voltages():
    return messages.Voltages(stamp_ns=time.time_ns(), period_ns=10**6, volts=np.ones((5, 5), np.float32))


def test_a_message_arrives_with_the_names_in_its_key(node):
    got = []
    reader, writer = node(), node()
    reader.subscribe(topics.VOLTAGES, lambda message, names: got.append((names, message.volts.shape)))
    reader.open(), writer.open()
    until(lambda: got, lambda: writer.publish(topics.VOLTAGES, voltages(), pad="p3"), "a message")
    names, shape = got[0]
    assert (names["pad"], shape) == ("p3", (5, 5))


def test_a_reader_knows_which_of_two_publishers_sent_a_message(node):
    heard: dict[str, list[int]] = {}
    reader, writers = node(), [node(), node()]
    reader.subscribe(topics.VOLTAGES, lambda message, names: heard.setdefault(names["publisher"], []).append(message.stamp_ns))
    reader.open(), [writer.open() for writer in writers]

    def publish():
        for writer in writers:
            writer.publish(topics.VOLTAGES, voltages(), pad="p3")

    until(lambda: len(heard) > 1, publish, "messages of both")
    until(lambda: all(len(stamps) > 3 for stamps in heard.values()), publish, "more of both")
    assert len(heard) == 2 and "" not in heard


def test_a_slow_reader_of_one_topic_does_not_hold_up_another(node):
    masks, poses, sent, let_go = [], [], [], threading.Event()
    reader, writer = node(), node()

    def take_long(message, names):
        masks.append(message.stamp_ns)
        let_go.wait()

    reader.subscribe(topics.MASK, take_long)
    reader.subscribe(topics.FUSED, lambda message, names: poses.append(message))
    reader.open(), writer.open()
    until(lambda: masks, lambda: send(writer), "the first mask")
    del poses[:]
    until(lambda: len(poses) >= 50, lambda: sent.append(send(writer)), "50 poses while a mask is worked on")
    assert len(masks) == 1
    let_go.set()
    wait_for(lambda: masks[-1] == sent[-1], 5, "the newest mask")
    assert len(masks) < 0.5 * len(sent), "the slow reader gets the newest, not the backlog"


def send(writer):
    """Sends a mask and a pose; the stamp of the mask."""
    mask = messages.Mask(stamp_ns=time.time_ns(), labels=np.zeros((4, 4), np.uint8), x0=0, y0=0, scale=1)
    writer.publish(topics.MASK, mask, camera="front")
    writer.publish(topics.FUSED, pose(), target="forearm")
    return mask.stamp_ns


def test_bad_messages_are_counted_by_kind_logged_once_and_do_not_stop_the_reader(node, log):
    got = []
    reader, writer = node(), node()
    reader.subscribe(topics.FUSED, lambda message, names: got.append(message))
    reader.open(), writer.open()
    key = topics.FUSED.at(cell="table", target="forearm")
    bad = lambda: reader.health()["topics"][key]["bad"]  # noqa: E731
    until(lambda: bad().get("msgpack", 0) >= 3, lambda: raw(writer, topics.FUSED, b"\xc1", target="forearm"), "three refusals")
    until(lambda: bad().get("past"), lambda: writer.publish(topics.FUSED, pose(1), target="forearm"), "an old stamp refused")
    until(lambda: bad().get("delete"), lambda: writer.session.delete(key), "a deletion refused")
    until(lambda: got, lambda: writer.publish(topics.FUSED, pose(), target="forearm"), "a good message")
    assert len(log("message refused")) == 3
    assert {record.fields["kind"] for record in log("message refused")} == {"msgpack", "past", "delete"}


def test_messages_of_another_version_are_ignored_counted_and_logged_once_however_many_keys_they_come_on(node, log):
    got = []
    reader, writer = node(), node()
    for topic in (topics.FUSED, topics.HAPTIC):
        reader.subscribe(topic, lambda message, names: got.append(message))
    reader.open(), writer.open()
    tomorrow = msgpack.packb({"version": messages.VERSION + 1, "stamp_ns": time.time_ns(), "twist": [0.0]})
    keys = [topic.at(cell="table", target="forearm") for topic in (topics.FUSED, topics.HAPTIC)]
    refused = lambda: [reader.health()["topics"][key]["bad"].get("version", 0) for key in keys]  # noqa: E731
    until(lambda: min(refused()) >= 3, lambda: [writer.session.put(key, tomorrow) for key in keys], "three refusals on both")
    until(lambda: got, lambda: writer.publish(topics.FUSED, pose(), target="forearm"), "a message of our version")
    (told,) = log("message refused")
    assert told.fields["kind"] == "version"
    assert f"expected wire version {messages.VERSION}, got {messages.VERSION + 1}" in told.fields["why"]
    assert reader.health()["wire_version"] == messages.VERSION


def test_a_message_for_a_part_that_the_cell_does_not_have_is_refused(node):
    got = []
    reader, writer = node(), node()
    reader.subscribe(topics.VOLTAGES, lambda message, names: got.append(names["pad"]))
    reader.open(), writer.open()
    payload = messages.encode(voltages())
    bad = lambda: reader.health()["topics"][topics.VOLTAGES.at(cell="table")]["bad"]  # noqa: E731
    until(lambda: bad().get("key"), lambda: raw(writer, topics.VOLTAGES, payload, pad="nowhere"), "the refusal")
    assert not got
    assert "penumbra/table/skin/nowhere/voltages" not in reader.health()["topics"]


def test_an_exception_of_a_handler_is_counted_and_logged_once_and_the_next_message_comes(node, log):
    got = []

    def handler(message, names):
        got.append(message)
        raise ZeroDivisionError("of the test")

    reader, writer = node(), node()
    reader.subscribe(topics.FUSED, handler)
    reader.open(), writer.open()
    until(lambda: len(got) >= 3, lambda: writer.publish(topics.FUSED, pose(), target="forearm"), "three messages")
    (kind, count) = wait_for(lambda: next(iter(reader.health()["faults"].items()), None), 1, "the fault in the health")
    assert kind.startswith("ZeroDivisionError at test_bus.py:")
    assert count >= 2
    assert len(log("of the test")) == 1


def test_what_a_reader_missed_is_counted_from_the_publishers_numbers(node):
    got, go = [], threading.Event()
    reader, writer = node(), node()

    def hold(message, names):
        got.append(message)
        go.wait()

    reader.subscribe(topics.MASK, hold)
    reader.open(), writer.open()
    until(lambda: got, lambda: send(writer), "the first mask")
    key = topics.MASK.at(cell="table", camera="front")

    def burst():
        go.clear()
        for _ in range(20):
            send(writer)
        go.set()

    until(lambda: reader.health()["topics"][key]["dropped"] >= 15, burst, "dropped masks in the health")
    row = reader.health()["topics"][key]
    published = writer.health()["published"][key]["count"]
    assert row["dropped"] <= published - row["count"], "a message before the subscription was not missed"


def test_a_message_that_is_sent_again_is_refused_and_the_next_one_taken(node):
    got = []
    reader, writer, replayer = node(), node(), node().open()
    key = topics.FUSED.at(cell="table", target="forearm")
    tape = replayer.session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
    reader.subscribe(topics.FUSED, lambda message, names: got.append(message.stamp_ns))
    reader.open(), writer.open()
    bad = lambda: reader.health()["topics"][key]["bad"]  # noqa: E731
    until(lambda: got, lambda: writer.publish(topics.FUSED, pose(), target="forearm"), "a pose")
    sample = wait_for(tape.try_recv, 5, "the recorded pose")

    def replay():
        replayer.session.put(key, sample.payload, attachment=sample.attachment)

    until(lambda: bad().get("replayed", 0) >= 3, replay, "three refusals")
    before = len(got)
    until(lambda: len(got) > before, lambda: writer.publish(topics.FUSED, pose(), target="forearm"), "the next pose")
    assert len(set(got)) == len(got)


def vision(age_s):
    now = pose()
    return messages.VisionPose(
        stamp_ns=now.stamp_ns - int(1e9 * age_s),
        target=now.target,
        frame=now.frame,
        camera="front",
        position=now.position,
        orientation=now.orientation,
        covariance=now.covariance,
        overlap=0.9,
        hidden=0.0,
        state="tracking",
    )


def test_late_vision_is_taken_and_what_is_of_a_backlog_is_refused(node):
    ages = []
    reader, writer = node(), node()
    reader.subscribe(topics.VISION, lambda message, names: ages.append((time.time_ns() - message.stamp_ns) * 1e-9))
    reader.open(), writer.open()
    bad = lambda: reader.health()["topics"][topics.VISION.at(cell="table", target="forearm")]["bad"]  # noqa: E731
    publish = lambda age_s: lambda: writer.publish(topics.VISION, vision(age_s), target="forearm")  # noqa: E731
    until(lambda: bad().get("past"), publish(topics.VISION.oldest_s + 0.01), "a refusal")
    assert not ages
    until(lambda: ages, publish(1.0), "a pose that is a second old")


@pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda topic: topic.name)
def test_no_topic_calls_a_message_a_replay_before_it_calls_itself_stale(topic):
    assert topic.stale_s + messages.MAX_FUTURE_S < topic.oldest_s <= messages.MAX_PAST_S


def test_a_flood_of_one_publisher_is_cut_and_does_not_stop_the_others(node):
    got = {"p0": 0, "p1": 0}
    reader, flooding, steady = node(), node(), node()

    def count(message, names):
        got[names["pad"]] += 1

    reader.subscribe(topics.VOLTAGES, count)
    reader.open(), flooding.open(), steady.open()
    started = time.monotonic()

    def publish():
        for _ in range(100):
            flooding.publish(topics.VOLTAGES, voltages(), pad="p0")
        steady.publish(topics.VOLTAGES, voltages(), pad="p1")

    bad = lambda pad: reader.health()["topics"][topics.VOLTAGES.at(cell="table", pad=pad)]["bad"]  # noqa: E731
    until(lambda: bad("p0").get("rate", 0) > 100 and got["p1"] >= 20, publish, "a cut flood, and the other publisher", 20.0)
    assert got["p0"] <= RATE_TIMES * topics.VOLTAGES.rate_hz * (time.monotonic() - started + 1.0)
    assert not bad("p1")


def test_a_camera_may_send_at_the_rate_that_the_cell_gives_it(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text((cells.BUILT_IN / "table.yaml").read_text().replace("rate_hz: 20", "rate_hz: 300", 1))
    node = Node("test", cells.load(path))
    rates = [node._streams.rate_hz(topic, {"camera": "front"}) for topic in (topics.FRAME, topics.MASK)]
    rates += [node._streams.rate_hz(topic, {"target": "forearm"}) for topic in (topics.VISION, topics.FUSED)]
    assert rates == [300, 300, 300, 200]


@pytest.mark.parametrize("every_s", [0.05, 0.2, 1.0])
def test_the_rate_of_a_steady_stream_is_its_rate_and_falls_when_it_ends(every_s):
    rate, looks_s = Rate(), np.arange(0.0, 8.0, every_s)
    for now_s in looks_s:
        rate.look(int(200 * now_s), now_s)
        if now_s > 2 * every_s:  # the first look that saw something started the clock
            assert rate.hz == pytest.approx(200, rel=0.02)
    for now_s in 8.0 + np.arange(0.0, 10 * RATE_WINDOW_S, every_s):
        rate.look(int(200 * looks_s[-1]), now_s)
    assert rate.hz < 0.1


def test_a_query_is_answered_and_a_refusal_carries_its_text(node):
    def answer(parameters, payload):
        if parameters.get("format") == "xml":
            raise ValueError("format: expected json, got xml")
        if parameters.get("format") == "crash":
            raise KeyError("lost")
        return payload + json.dumps(parameters).encode(), "application/json"

    server, asker = node("server").open(), node().open()
    server.answer("penumbra/table/echo", answer)
    wait_for(lambda: asker.query("penumbra/table/echo"), 5, "an answer")
    assert asker.query("penumbra/table/echo", "format=json", b"hello ") == [b'hello {"format": "json"}']
    with pytest.raises(bus.Refused, match="expected json, got xml"):
        asker.query("penumbra/table/echo", "format=xml")
    with pytest.raises(bus.Refused, match="server failed: KeyError"):
        asker.query("penumbra/table/echo", "format=crash")
    assert list(server.health()["faults"].values()) == [1]


def test_a_query_that_is_not_answered_in_time_is_distinguished_from_a_refused_one(node):
    server, asker, over = node("server").open(), node().open(), threading.Event()
    server.answer("penumbra/table/slow", lambda parameters, payload: str(over.wait(30)).encode())

    def ask() -> str:
        try:
            return str(asker.query("penumbra/table/slow", timeout_s=0.2))
        except bus.TimedOut as error:
            return str(error)

    wait_for(lambda: ask() == "no answer within 0.2 s", 5, "the query to be late")
    over.set()


def test_a_query_that_nobody_answers_returns_at_once_with_nothing(node):
    asker = node().open()
    timeout_s = 60.0
    started = time.monotonic()
    assert asker.query("penumbra/table/nobody", timeout_s=timeout_s) == []
    assert time.monotonic() - started < 0.2 * timeout_s


def test_a_taken_port_is_reported_with_what_to_do(endpoint):
    with pytest.raises(bus.BusError, match=r"taken.*--port"):
        Node("router", CELL, bus.Connection("router", listen=(endpoint,))).open()


@pytest.mark.parametrize(
    ("text", "reason"), [("{mode: 'nowhere'}", "unknown variant"), ("{nonsense: 1}", "unknown field"), ("{mode:", "expected")]
)
def test_a_bad_configuration_file_is_reported_with_its_name_and_the_reason(tmp_path, text, reason):
    path = tmp_path / "zenoh.json5"
    path.write_text(text)
    with pytest.raises(bus.BusError, match=reason) as caught:
        Node("test", CELL, bus.Connection(config=path))
    assert str(path) in str(caught.value)
    with pytest.raises(bus.BusError, match="No such file"):
        bus.configuration(bus.Connection(config=tmp_path / "missing.json5"))


def test_the_settings_of_a_configuration_file_stand_unless_a_flag_says_otherwise(tmp_path):
    path = tmp_path / "zenoh.json5"
    path.write_text('{mode: "peer", connect: {endpoints: ["tcp/10.0.0.1:7447"]}, scouting: {gossip: {enabled: true}}}')
    config = bus.configuration(bus.Connection(config=path))
    assert json.loads(config.get_json("connect/endpoints")) == ["tcp/10.0.0.1:7447"]
    assert json.loads(config.get_json("scouting/gossip/enabled")) is True
    assert bus.mode(bus.Connection(config=path)) == "peer"
    config = bus.configuration(bus.Connection("client", ("tcp/10.0.0.2:7447",), config=path))
    assert json.loads(config.get_json("connect/endpoints")) == ["tcp/10.0.0.2:7447"]
    assert json.loads(config.get_json("mode")) == "client"


@pytest.mark.parametrize("endpoint", ["nonsense", "tcp/", "pigeon/127.0.0.1:7447"])
def test_an_endpoint_that_zenoh_does_not_know_is_refused_and_not_waited_for(endpoint):
    with pytest.raises(bus.BusError, match=r"expected PROTOCOL/ADDRESS|does not open|expected what Zenoh accepts"):
        Node("test", CELL, bus.Connection(connect=(endpoint,))).open(patience_s=30)


def router_process(endpoint):
    return subprocess.Popen(penumbra_command("router", "--listen", endpoint), stderr=subprocess.DEVNULL)


def test_nodes_wait_for_the_router_and_go_on_after_it_was_away(log):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    got = []
    reader, writer = (Node(name, CELL, bus.Connection(connect=(endpoint,))) for name in ("reader", "writer"))
    reader.subscribe(topics.FUSED, lambda message, names: got.append(message))
    writer.every(0.01, lambda: writer.publish(topics.FUSED, pose(), target="forearm"))
    opening = [threading.Thread(target=each.open) for each in (reader, writer)]
    for thread in opening:
        thread.start()
    wait_for(lambda: len(log("waiting for the router at")) == 2, 5, "both to say that they wait")
    assert endpoint in log("waiting")[0].getMessage()
    assert "`penumbra up`" in log("waiting")[0].getMessage()
    router = router_process(endpoint)
    try:
        wait_for(lambda: got, 10, "a message through the router")
        router.kill()
        router.wait()
        wait_for(lambda: len(log("waiting")) == 4, 5, "both to say that the router is gone")
        before, back_ns = len(got), time.time_ns()
        router = router_process(endpoint)
        wait_for(lambda: len(got) > before, 3, "messages after the router came back")
        wait_for(lambda: len(log("the router is back")) == 2, 3, "both to say so")
        assert got[before].stamp_ns > back_ns, "no backlog"
        assert reader.query(topics.health("table", "writer")), "queryables are declared again"
    finally:
        router.kill()
        router.wait()
        reader.close()
        writer.close()


def test_a_reader_refuses_a_large_message_without_copying_it(node):
    reader, writer = node(), node()
    reader.subscribe(topics.FUSED, lambda message, names: None)
    reader.open(), writer.open()
    key = topics.FUSED.at(cell="table", target="forearm")
    payload = bytes(messages.FusedPose.MAX_BYTES + 1)
    until(lambda: reader.health()["topics"][key]["bad"].get("size"), lambda: writer.session.put(key, payload), "the refusal")


def test_publishing_says_which_names_are_missing_unknown_or_not_in_the_cell(node):
    writer = node().open()
    with pytest.raises(ValueError, match="publishing fused needs target="):
        writer.publish(topics.FUSED, pose())
    with pytest.raises(cells.CellError, match="no target 'leg': it has forearm"):
        writer.publish(topics.FUSED, pose(), target="leg")
    with pytest.raises(ValueError, match="topic fused has the names target, not camera"):
        writer.publish(topics.FUSED, pose(), target="forearm", camera="front")
    with pytest.raises(messages.BadMessage, match="position"):
        writer.publish(topics.FUSED, msgspec.structs.replace(pose(), position=np.zeros(4)), target="forearm")


def test_zenoh_endpoints_are_taken_from_the_environment_where_no_flag_gives_them(monkeypatch):
    monkeypatch.setenv("PENUMBRA_CONNECT", "tcp/router:7447")
    options = parse([])
    assert bus.connection(options).connect == ("tcp/router:7447",)
    assert bus.connection(parse(["--connect", "tcp/other:7447"])).connect == ("tcp/other:7447",)
    assert bus.connection(parse(["--mode", "router"])).connect == ()


def parse(argv):
    from penumbra.services import flags

    return flags.parse(flags.COMMON, argv)


def test_many_frames_a_second_pass_through_shared_memory_or_tcp_unchanged(node):
    image = np.random.default_rng(1).integers(0, 256, (480, 640, 3), np.uint8)
    got = []
    reader, writer = node(), node()
    reader.subscribe(topics.FRAME, lambda message, names: got.append(message.image), camera="front")
    reader.open(), writer.open()
    frame = lambda: writer.publish(topics.FRAME, messages.Frame(stamp_ns=time.time_ns(), image=image), camera="front")  # noqa: E731
    until(lambda: len(got) >= 5, frame, "five frames")
    assert all(np.array_equal(each, image) for each in got)


def test_the_session_of_another_zenoh_program_reads_what_a_node_publishes(node, endpoint):
    writer = node().open()
    config = zenoh.Config.from_json5(f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}}}')
    with zenoh.open(config) as session:
        subscriber = session.declare_subscriber("penumbra/table/target/forearm/pose/fused", zenoh.handlers.RingChannel(1))
        sample = until(subscriber.try_recv, lambda: writer.publish(topics.FUSED, pose(x=0.5), target="forearm"), "a sample")
        assert messages.decode(messages.FusedPose, sample.payload.to_bytes()).position[0] == 0.5


def test_the_latest_message_is_decoded_only_when_it_is_looked_at_and_all_are_counted(node, monkeypatch):
    decoded = []

    def counted(kind, payload):
        decoded.append(1)
        return messages.decode(kind, payload)

    monkeypatch.setattr(reader_module, "decode", counted)
    reader, writer = node(), node()
    latest = reader.latest(topics.FUSED)
    assert latest.get(target="forearm") is None
    reader.open(), writer.open()
    until(lambda: latest.drain() >= 20, lambda: writer.publish(topics.FUSED, pose(), target="forearm"), "twenty poses")
    assert not decoded
    sent = pose(x=0.5)
    writer.publish(topics.FUSED, sent, target="forearm")
    wait_for(lambda: latest.get(target="forearm").stamp_ns == sent.stamp_ns, 5, "the newest pose")
    assert latest.get(target="forearm").position[0] == 0.5
    before = len(decoded)
    assert latest.get(target="forearm") is latest.get(target="forearm") and len(decoded) == before
    key = topics.FUSED.at(cell="table", target="forearm")
    row = reader.health()["topics"][key]
    assert (row["count"], row["dropped"], row["delay_s"]) == (latest.drain(), 0, None)
    assert wait_for(lambda: reader.health()["topics"][key]["stale"], 5, "it to be missed")
    with pytest.raises(KeyError):
        latest.get(target="leg")


def test_what_a_reader_refuses_the_latest_message_refuses_too(node):
    reader, writer, replayer = node(), node(), node().open()
    latest, key = reader.latest(topics.FUSED, target="forearm"), topics.FUSED.at(cell="table", target="forearm")
    tape = replayer.session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
    reader.open(), writer.open()
    bad = lambda: reader.health()["topics"][key]["bad"]  # noqa: E731
    publish = lambda message: lambda: writer.publish(topics.FUSED, message, target="forearm")  # noqa: E731
    good = pose()
    until(lambda: latest.get(target="forearm"), publish(good), "a pose")
    sample = wait_for(tape.try_recv, 5, "the recorded pose")
    until(lambda: bad().get("past"), publish(pose(1)), "an old stamp refused")
    until(lambda: bad().get("msgpack"), lambda: writer.session.put(key, b"\xc1"), "garbage refused")
    until(lambda: bad().get("delete"), lambda: writer.session.delete(key), "a deletion refused")
    other = msgpack.packb({"version": messages.VERSION + 1, "stamp_ns": time.time_ns()})
    until(lambda: bad().get("version"), lambda: writer.session.put(key, other), "another version refused")
    until(
        lambda: bad().get("replayed"),
        lambda: replayer.session.put(key, sample.payload, attachment=sample.attachment),
        "a replay refused",
    )
    assert latest.get(target="forearm").stamp_ns == good.stamp_ns, "what was refused is not shown"


def test_a_pose_that_looks_well_from_outside_and_is_not_is_refused_when_it_is_looked_at(node):
    reader, writer = node(), node()
    latest, key = reader.latest(topics.FUSED, target="forearm"), topics.FUSED.at(cell="table", target="forearm")
    reader.open(), writer.open()

    def put():
        writer.session.put(key, msgpack.packb({"version": messages.VERSION, "stamp_ns": time.time_ns()}))

    until(lambda: latest.drain(), put, "a message with a good head")
    assert latest.get(target="forearm") is None
    assert reader.health()["topics"][key]["bad"] == {"fields": 1}


def test_this_process_is_named_in_its_instance(node):
    first, second = node(), node()
    assert str(os.getpid()) in first.instance
    assert first.instance != second.instance
