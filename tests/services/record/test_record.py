"""The recorder on a real bus: what it keeps of what a publisher says, what is left when it is killed, full disks, files that
follow each other, and the last seconds."""

import itertools
import json
import os
import signal
import subprocess
import threading
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from penumbra.services import flags
from penumbra.services.command import cli
from penumbra.services.record import service
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import access, messages, report, topics
from penumbra.shared.recording.reading import Recording
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.shared.runtime.sender import Sender
from penumbra.tests.support.injected import full, small_disk
from penumbra.tests.support.live import PATIENCE_S, free_port, penumbra_command, wait_for
from penumbra.tests.support.nodes import node_command, pose
from penumbra.tests.support.recorded import on_the_bus
from penumbra.tests.support.recorded import recorded as written

CELL = cells.load("table")
FUSED = topics.FUSED.at(cell="table", target="forearm")
SOON_S = 0.05


@contextmanager
def recorder(router: str, *arguments: str):
    """A recorder in this process; its node."""
    options = flags.parse([*service.FLAGS, *flags.COMMON], ["--connect", router, "--keep-free-mb", "1", *arguments])
    node = Node(service.NAME, CELL, bus.connection(options))
    service.start(node, options)
    with node.open():
        yield node


@contextmanager
def process(*command: str):
    """A process that is ended as by Ctrl-C, unless it ended before."""
    popen = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield popen
    finally:
        if popen.poll() is None:
            popen.send_signal(signal.SIGINT)
        popen.communicate(timeout=PATIENCE_S)


class Publisher:
    """Publishes fused poses of a target, each with its number as its x."""

    def __init__(self, router: str):
        self.session = bus.open_session(bus.Connection(connect=(router,)), threading.Event(), lambda: None, 10.0)
        self._sender = Sender(self.session, topics.FUSED, FUSED)
        self.sent: list[messages.FusedPose] = []

    def send(self, state: str = "tracking") -> None:
        message = msgspec.structs.replace(pose(x=0.001 * len(self.sent)), state=state)
        self._sender.send(message)
        self.sent.append(message)


@pytest.fixture
def publisher(router):
    publisher = Publisher(router)
    yield publisher
    publisher.session.close()


def recorded(node: Node) -> dict:
    """What the health report says of the recorder."""
    found = node.report().report
    return found["disk"] if "disk" in found else found["memory"]


def poses(path: Path) -> list[messages.FusedPose]:
    """The fused poses in a file."""
    found = [each.message for each in Recording(path).messages([topics.FUSED])]
    assert all(isinstance(each, messages.FusedPose) for each in found)
    return found  # type: ignore[return-value]


def heard(node: Node) -> int:
    return node.report().topics[FUSED].count


def send_until(publisher: Publisher, condition, what: str, state: str = "tracking"):
    """Poses, a hundred a second, until something has happened."""
    return wait_for(condition, 10.0, what, 0.01, act=lambda: publisher.send(state))


# ---- what is recorded


def test_what_a_publisher_says_is_in_the_file_to_the_bit_with_numbers_and_without_gaps(router, publisher, tmp_path):
    path = tmp_path / "run.mcap"
    with recorder(router, "-o", str(path)) as node:
        send_until(publisher, lambda: heard(node) >= 20, "twenty poses")
        count = heard(node)
    entries = [entry for entry in Recording(path).entries() if entry.channel.topic == FUSED]
    assert len(entries) >= count and Recording(path).is_indexed
    sent = [messages.encode(each) for each in publisher.sent]
    first = sent.index(entries[0].data)
    assert [entry.data for entry in entries] == sent[first : first + len(entries)]
    assert [entry.number for entry in entries] == list(range(first, first + len(entries)))
    assert all(0 <= entry.log_ns - entry.stamp_ns < PATIENCE_S * 1e9 for entry in entries)


def test_only_the_topics_that_are_named_are_recorded(router, publisher, tmp_path):
    path = tmp_path / "run.mcap"
    with recorder(router, "-o", str(path), "--topics", "frame", "vision") as node:
        watching = Node("watch", CELL, bus.Connection(connect=(router,)))
        watching.subscribe(topics.FUSED, lambda message, names: None)
        with watching.open():
            send_until(publisher, lambda: heard(watching) >= 5, "poses on the bus")
        assert not any(key.endswith("fused") for key in node.report().topics)
    assert not path.exists()


def test_a_message_that_no_reader_would_take_is_recorded_as_it_is(router, publisher, tmp_path):
    path = tmp_path / "run.mcap"
    with recorder(router, "-o", str(path)) as node:
        wait_for(
            lambda: node.report().topics[FUSED].bad, 10, "the nonsense", act=lambda: publisher.session.put(FUSED, b"nonsense")
        )
    assert b"nonsense" in [entry.data for entry in Recording(path).entries()]
    assert Recording(path).is_indexed


def test_a_recorder_is_found_by_its_health_and_reports_what_it_writes(router, publisher, tmp_path):
    with recorder(router, "-o", str(tmp_path / "run.mcap")) as node:
        send_until(publisher, lambda: recorded(node)["messages"] > 0, "messages in the file")
        (answer,) = bus.ask(publisher.session, topics.health("table", "record"))
        found = report.read(answer)
        assert found.service == "record" and found.report["disk"]["file"] == str(tmp_path / "run.mcap")
        assert found.report["disk"]["bytes"] > 0 and found.report["disk"]["lost"] == 0


def test_a_place_that_cannot_be_written_is_refused_with_its_name(router, tmp_path):
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(bus.BusError, match=r"--out .*run.mcap: expected a file or folder that can be written"),
        recorder(router, "-o", str(tmp_path / "file" / "run.mcap")),
    ):
        pass


def test_a_recorder_s_certificate_lets_it_read_everything_and_publish_nothing():
    policy = {subject["id"] for subject in access.control()["subjects"]}
    assert "record" in policy
    assert not [rule for rule in access.control()["rules"] if rule["id"] == "record publishes"]
    (steer,) = (rule for rule in access.control()["rules"] if rule["id"] == "steer")
    assert topics.recorder("*") in steer["key_exprs"]


# ---- killed


def lost_s_of_a_kill(router: str, path: Path) -> float:
    """How much of what was on the bus is not in the file of a recorder that is killed, by the stamps of the messages [s]."""
    command = penumbra_command("record", "-o", str(path), "--connect", router, "--keep-free-mb", "1")
    with (
        process(*node_command("fusion", router)),
        process(*command) as popen,
        bus.open_session(bus.Connection(connect=(router,)), threading.Event(), lambda: None, 10.0) as session,
    ):
        wait_for(lambda: path.is_file() and path.stat().st_size > 300_000, 60, "a file that grows")
        subscriber = session.declare_subscriber(FUSED)
        for _ in range(50):
            newest = messages.decode(messages.FusedPose, subscriber.recv().payload.to_bytes()).stamp_ns
        popen.send_signal(signal.SIGKILL)
        popen.wait()
        subscriber.undeclare()
    return (newest - poses(path)[-1].stamp_ns) * 1e-9


def test_a_recorder_that_is_killed_loses_less_than_three_tenths_of_a_second(router, tmp_path):
    """One that gets its time: of three kills on a machine that may be busy, one."""
    assert any(lost_s_of_a_kill(router, tmp_path / f"{i}.mcap") < 0.3 for i in range(3))


# ---- disks


def test_files_follow_each_other_by_size_and_nothing_is_lost_between_them(router, publisher, tmp_path):
    path = tmp_path / "run.mcap"
    with recorder(router, "-o", str(path), "--roll-mb", "0.06") as node:
        send_until(publisher, lambda: recorded(node)["files"] >= 3, "three files")
    parts = [path, *(tmp_path / f"run-{i}.mcap" for i in range(2, recorded(node)["files"] + 1))]
    assert all(Recording(part).is_indexed and Recording(part).attachments for part in parts)
    found = [each.position[0] for part in parts for each in poses(part)]
    assert found == pytest.approx([0.001 * (round(found[0] / 0.001) + i) for i in range(len(found))])


def test_where_nothing_came_there_is_no_file_and_the_log_says_so(tmp_path):
    """Without a router, ended by Ctrl-C."""
    command = penumbra_command("record", "-o", str(tmp_path / "run.mcap"), "--connect", f"tcp/127.0.0.1:{free_port()}")
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as popen:
        assert popen.stderr is not None
        lines = [next(line for line in popen.stderr if "waiting for the router" in line)]
        popen.send_signal(signal.SIGINT)
        _, rest = popen.communicate(timeout=PATIENCE_S)
    assert popen.returncode == 0, lines
    assert "nothing was recorded, and no file written" in rest
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_there_is_not_overwritten(router, publisher, tmp_path):
    path = tmp_path / "run.mcap"
    path.write_text("mine")
    with recorder(router, "-o", str(path)) as node:
        send_until(publisher, lambda: recorded(node)["messages"] > 0, "messages in a file")
    assert path.read_text() == "mine" and poses(tmp_path / "run-2.mcap")


def test_in_a_folder_files_have_the_cell_s_name_and_the_time(router, publisher, tmp_path):
    with recorder(router, "-o", str(tmp_path / "new" / "folder")) as node:
        send_until(publisher, lambda: recorded(node)["messages"] > 0, "messages in a file")
    (path,) = (tmp_path / "new" / "folder").iterdir()
    assert path.name.startswith("table-20") and path.suffix == ".mcap"


@pytest.fixture
def disk(tmp_path):
    """A disk of 8 MB."""
    try:
        with small_disk(tmp_path / "disk", 8) as _:
            yield tmp_path / "disk"
    except PermissionError as error:
        pytest.skip(str(error))


def test_before_the_disk_is_full_the_file_ends_whole_and_the_next_one_begins_when_there_is_room(
    router, publisher, disk, monkeypatch
):
    monkeypatch.setattr("penumbra.services.record.disk.AGAIN_S", SOON_S)
    with recorder(router, "-o", str(disk / "run.mcap")) as node:
        send_until(publisher, lambda: recorded(node)["messages"] > 0, "messages in the file")
        with full(disk):
            send_until(publisher, lambda: node.report().reasons, "a reason")
            (reason,) = node.report().reasons
            assert reason.startswith("not recording: ")
            assert Recording(disk / "run.mcap").is_indexed or poses(disk / "run.mcap")
            assert "has no end" not in Recording(disk / "run.mcap").fault
            send_until(publisher, lambda: recorded(node)["lost"] > 0, "messages that are lost")
        send_until(publisher, lambda: not node.report().reasons, "room again")
        before = recorded(node)["messages"]
        send_until(publisher, lambda: recorded(node)["messages"] > before, "messages in the next file")
    assert Recording(disk / "run-2.mcap").is_indexed and poses(disk / "run-2.mcap")


# ---- the last seconds


def ask_for_the_last(router: str, *arguments: str) -> subprocess.CompletedProcess:
    command = penumbra_command("record", "save", "--connect", router, *arguments)
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)


def test_the_last_seconds_are_written_when_asked_for_and_no_more_of_them(router, publisher, tmp_path):
    with recorder(router, "-o", str(tmp_path), "--last", "1") as node:
        send_until(publisher, lambda: recorded(node).get("kept_s", 0) > 0.9 and len(publisher.sent) > 150, "more than a second")
        assert not list(tmp_path.iterdir())
        done = ask_for_the_last(router, "--json")
        assert done.returncode == 0, done.stderr
        answer = json.loads(done.stdout)
    path = Path(answer["file"])
    kept = poses(path)
    times = [entry.log_ns for entry in Recording(path).entries() if entry.channel.topic == FUSED]
    assert (times[-1] - times[0]) * 1e-9 <= 1.0 and Recording(path).is_indexed
    assert kept[0].position[0] > 0.0, "the first poses are forgotten"


def test_memory_is_bounded_by_bytes_too(router, publisher, tmp_path):
    with recorder(router, "-o", str(tmp_path), "--last", "60", "--last-mb", "0.05") as node:
        send_until(publisher, lambda: recorded(node)["kept_bytes"] > 0.03e6, "a full memory")
        most = []
        for _ in range(200):
            publisher.send()
            most.append(recorded(node)["kept_bytes"])
    assert 0.03e6 < max(most) <= 0.05e6


def test_a_recorder_that_writes_everything_keeps_nothing_back(router, tmp_path):
    with recorder(router, "-o", str(tmp_path / "run.mcap")):
        done = ask_for_the_last(router)
    assert done.returncode == 2 and "only one with --last keeps anything back" in done.stderr


def test_asking_where_no_recorder_runs_says_so(router):
    done = ask_for_the_last(router)
    assert done.returncode == 2 and "no recorder in cell table" in done.stderr


def test_a_loss_is_written_by_itself_with_what_came_before_and_after(router, publisher, tmp_path, monkeypatch):
    monkeypatch.setattr("penumbra.services.record.recorder.AFTER_S", 0.2)
    with recorder(router, "-o", str(tmp_path), "--last", "30") as node:
        send_until(publisher, lambda: heard(node) >= 20, "poses")
        send_until(publisher, lambda: recorded(node)["files"] == 1, "a file", state="lost")
        for _ in itertools.repeat(None, 20):  # lost still: nothing new
            publisher.send("lost")
        assert recorded(node)["files"] == 1
    (path,) = tmp_path.iterdir()
    states = [each.state for each in poses(path)]
    assert states.count("tracking") >= 15 and states[-1] == "lost" and states.index("lost") > 10


def test_ctrl_c_ends_the_file_with_an_index(router, publisher, tmp_path):
    path = tmp_path / "run.mcap"
    with process(*penumbra_command("record", "-o", str(path), "--connect", router, "--keep-free-mb", "1")) as popen:
        send_until(publisher, lambda: path.is_file() and path.stat().st_size > 100_000, "a file that grows")
        popen.send_signal(signal.SIGINT)
        popen.wait(PATIENCE_S)
        assert popen.returncode == 0
    assert Recording(path).is_indexed and poses(path)
    info = subprocess.run(penumbra_command("record", "info", str(path), "--json"), capture_output=True, text=True, check=True)
    found = json.loads(info.stdout)
    assert found["messages"][FUSED] == len(poses(path)) and found["is_indexed"] and not found["fault"]


def test_mend_writes_a_whole_file_beside_one_that_has_no_end(router, tmp_path):
    whole = written(tmp_path / "run.mcap", "table", on_the_bus(CELL, 1, 0.2, frames=False))
    os.truncate(whole, whole.stat().st_size - 100)
    info = subprocess.run(penumbra_command("record", "info", str(whole)), capture_output=True, text=True)
    assert info.returncode == 1 and "has no end" in info.stdout
    done = subprocess.run(penumbra_command("record", "mend", str(whole)), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert Recording(tmp_path / "run-mended.mcap").is_indexed
    again = subprocess.run(penumbra_command("record", "mend", str(whole)), capture_output=True, text=True)
    assert again.returncode == 2 and "is there already" in again.stderr


def test_info_and_mend_say_what_is_missing_of_a_damaged_file(tmp_path, capsys):
    path = written(tmp_path / "run.mcap", "table", on_the_bus(CELL, 1, 4.0, frames=False))
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 1000] = bytes(1000)
    path.write_bytes(data)
    assert cli.main(["record", "info", str(path), "--json"]) == 1
    (gap,) = json.loads(capsys.readouterr().out)["gaps"]
    assert gap["begin"] <= len(data) // 2 < gap["end"] and gap["seconds"] > 0.1
    assert cli.main(["record", "info", str(path)]) == 1
    assert f"bytes {gap['begin']} to {gap['end']} are damaged" in capsys.readouterr().out
    assert cli.main(["record", "mend", str(path)]) == 0
    assert f"is damaged after byte {gap['begin']}: {gap['seconds']:.2f} s of messages are missing" in capsys.readouterr().out
