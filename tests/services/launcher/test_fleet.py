"""Restarts and numbers of replicas while a launcher runs, with real processes asked for by the real commands."""

import json
import logging
import os
import signal
import sys
import threading
from functools import partial

import pytest
from rich.console import Console

from penumbra.services.command import cli
from penumbra.services.launcher import launch
from penumbra.services.launcher.fleet import Fleet, Kind
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support.live import PATIENCE_S, free_port, wait_for
from penumbra.tests.support.nodes import node_command

CELL = cells.load("table")
ALWAYS_CRASHES = [sys.executable, "-c", "import sys; sys.exit('out of luck')"]


class Counted(Fleet):
    """Counts after every step how many processes of a service serve and are not told to end. Tokens would tell as much of a
    machine that is not busy: on one that is, a replica withdraws for moments by itself, where another one lives."""

    def __init__(self, kinds, counts):
        super().__init__(kinds, counts)
        self._kept, self.fewest = tuple(kinds), {}

    def watch(self):
        super().watch()
        self.fewest = {service: min(fewest, self.serving(service)) for service, fewest in self.fewest.items()}

    def count_from_now(self):
        self.fewest = {service: self.serving(service) for service in self._kept}

    def serving(self, service):
        return sum(each.service == service and each.has_served and each.state == "running" for each in self.processes)


class Launched:
    """A launcher of small services, and who of them is alive at any time."""

    def __init__(self, node, fleet, kinds):
        self.node, self.fleet = node, fleet
        self.living: dict[str, set[str]] = {name: set() for name in kinds}
        tokens = node.session.liveliness().declare_subscriber(topics.alive("table"), self._on_token, history=True)
        self._tokens = tokens
        self.launcher = launch.Launcher(node, fleet, Console(width=400, quiet=True), keep_going=True)
        self.thread = threading.Thread(target=self.launcher.run, args=(120,))
        self.thread.start()

    def _on_token(self, sample):
        service, instance = str(sample.key_expr).split("/")[-2:]
        if service in self.living:
            living = self.living[service]
            (living.discard if str(sample.kind).endswith("DELETE") else living.add)(instance)

    def pids(self, service):
        return [process.pid for process in self.fleet.processes if process.name.partition(" ")[0] == service]

    def has(self, service, count):
        return len(self.living[service]) == count

    def command(self, *argv):
        return cli.main([*argv, "--connect", self.node.connection.listen[0]])


@pytest.fixture
def launched():
    """Starts a launcher of `kinds` and waits until `counts` of them serve."""
    running = []

    def make(kinds, counts, serving=None):
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        node = Node("launcher", CELL, bus.Connection("router", listen=(endpoint,))).open()
        kinds = {name: kind(endpoint) for name, kind in kinds.items()}
        running.append(Launched(node, Counted(kinds, counts), kinds))
        wanted = counts if serving is None else serving
        up = running[-1]
        is_up = lambda: all(up.has(name, n) and up.fleet.serving(name) == n for name, n in wanted.items())  # noqa: E731
        wait_for(is_up, 60, f"{wanted} alive")
        return up

    yield make
    for each in running:
        each.node.stopping.set()
        each.thread.join(PATIENCE_S)
        each.node.close()


def small(name, beside=True, **environment):
    """The small service of penumbra.tests.support.nodes under another name."""
    return lambda endpoint: Kind(
        node_command(name, endpoint),
        environment=environment,
        beside=beside,
    )


def test_a_rolling_restart_replaces_every_process_and_no_service_is_ever_without_one(launched, capsys):
    up = launched({"worker": small("worker"), "helper": small("helper")}, {"worker": 1, "helper": 2})
    before = {name: up.pids(name) for name in ("worker", "helper")}
    up.fleet.count_from_now()
    assert up.command("restart") == 0
    assert up.fleet.fewest == {"worker": 1, "helper": 2}
    for name, pids in before.items():
        assert len(up.pids(name)) == len(pids)
        assert not set(up.pids(name)) & set(pids)
        wait_for(partial(up.has, name, len(pids)), 5, "the old ones to be gone")
    assert [process.name for process in up.fleet.processes] == ["worker", "helper 1", "helper 2"]
    out = capsys.readouterr().out
    assert "waiting for worker 2 (" in out
    assert out.endswith("restart of worker, helper: done\n")


def test_what_there_can_be_only_one_of_ends_before_its_successor_begins_and_the_others_stay(launched):
    up = launched({"sensor": small("sensor", beside=False), "worker": small("worker")}, {"sensor": 1, "worker": 1})
    before = {name: up.pids(name) for name in ("sensor", "worker")}
    up.fleet.count_from_now()
    assert up.command("restart", "sensor") == 0
    assert up.fleet.fewest == {"sensor": 0, "worker": 1}
    assert up.pids("sensor") != before["sensor"]
    assert up.pids("worker") == before["worker"]
    up.fleet.count_from_now()
    before = {name: up.pids(name) for name in ("sensor", "worker")}
    assert up.command("restart") == 0
    assert up.pids("sensor") == before["sensor"], "without a name only what can be replaced without a gap"
    assert up.pids("worker") != before["worker"]


def test_a_successor_that_does_not_start_is_reported_and_the_old_one_goes_on(launched, tmp_path, capsys):
    broken = tmp_path / "broken"
    code = (
        f"import os, runpy, sys; os.path.exists({str(broken)!r}) and sys.exit('no licence'); "
        "runpy.run_module('penumbra.tests.support.nodes', None, '__main__')"
    )
    kind = lambda endpoint: Kind([sys.executable, "-c", code, "worker", "--connect", endpoint])  # noqa: E731
    up = launched({"worker": kind, "helper": small("helper")}, {"worker": 1, "helper": 1})
    before = {name: up.pids(name) for name in ("worker", "helper")}
    broken.touch()
    assert up.command("restart", "--all") == 1
    assert "worker 2 did not start: exit code 1: no licence" in capsys.readouterr().out
    assert {name: up.pids(name) for name in ("worker", "helper")} == before


def test_a_crash_loop_is_reported_and_does_not_hold_up_what_is_restarted(launched, caplog, monkeypatch):
    monkeypatch.setattr(logging.getLogger("penumbra"), "propagate", True)
    crashing = lambda endpoint: Kind(ALWAYS_CRASHES)  # noqa: E731
    up = launched({"crashing": crashing, "worker": small("worker")}, {"crashing": 1, "worker": 1}, {"worker": 1})
    before = up.pids("worker")
    told = "crashing waiting: crash loop: exit code 1: out of luck"
    wait_for(lambda: told in up.node.health()["reasons"], 20, "the report of a crash loop")
    assert up.node.health()["status"] == "degraded"
    line = "a process exits repeatedly; the others continue"
    wait_for(lambda: [record for record in caplog.records if record.message == line], 5, "the line in the log")
    assert up.command("restart", "worker") == 0
    assert len(up.pids("worker")) == 1 and up.pids("worker") != before


def test_replicas_are_added_and_removed_while_the_first_goes_on(launched):
    up = launched({"worker": small("worker")}, {"worker": 1})
    (first,) = up.pids("worker")
    assert up.command("scale", "worker=3") == 0
    assert len(set(up.pids("worker"))) == 3 and up.pids("worker")[0] == first
    wait_for(lambda: len(up.living["worker"]) == 3, 5, "three tokens")
    replicas = lambda: {r["replicas"] for r in map(json.loads, up.node.query(topics.health("table", "worker")))}  # noqa: E731
    wait_for(lambda: replicas() == {3}, 10, "each to know of the others", 0.1)
    assert up.command("scale", "worker=1") == 0
    assert up.pids("worker") == [first]
    assert up.command("scale", "worker=0") == 0
    assert up.pids("worker") == []
    assert up.command("scale", "worker=1") == 0
    assert len(up.pids("worker")) == 1


def test_a_hung_process_is_ended_by_force_when_it_is_replaced(launched):
    up = launched({"worker": small("worker")}, {"worker": 1})
    (hung,) = up.pids("worker")
    os.kill(hung, signal.SIGSTOP)
    assert up.command("restart", "worker") == 0
    assert up.pids("worker") != [hung] and len(up.pids("worker")) == 1


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["restart", "magic"], "penumbra restart: expected one of worker, which run here, got magic"),
        (
            ["scale", "magic=2"],
            "penumbra scale: expected NAME=NUMBER with NAME one of worker, sensor, meeting, got magic=2",
        ),
        (["scale", "worker=65"], "penumbra scale: worker: expected 0 to 64, got 65"),
        (["scale", "meeting=0"], "penumbra scale: meeting: expected 1, got 0: all other processes meet there"),
        (
            ["scale", "sensor=2"],
            "penumbra scale: sensor: expected 0 to 1, because only one can run, got 2",
        ),
    ],
)
def test_what_cannot_be_changed_is_one_line_that_says_what_can(argv, line, capsys):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Node("launcher", CELL, bus.Connection("router", listen=(endpoint,))) as node:
        kinds = {
            "worker": Kind(ALWAYS_CRASHES),
            "sensor": Kind(ALWAYS_CRASHES, beside=False),
            "meeting": Kind(ALWAYS_CRASHES, beside=False, is_required=True),
        }
        fleet = Fleet(kinds, {"worker": 1})
        launch.Launcher(node, fleet, Console(quiet=True))
        assert cli.main([*argv, "--connect", endpoint]) == 2
    assert capsys.readouterr().err == line + "\n"


def test_one_change_at_a_time():
    fleet = Fleet({"worker": Kind(ALWAYS_CRASHES)}, {"worker": 1})
    ask = lambda **words: json.loads(fleet.answer({}, json.dumps(words).encode()))  # noqa: E731
    assert ask(command="restart", id="a")["done"] is False
    with pytest.raises(ValueError, match="busy: restart of worker, begins; ask again"):
        ask(command="scale", service="worker", number=2, id="b")
    assert ask(command="state", id="a")["what"] == "restart of worker"
    with pytest.raises(ValueError, match="expected a change requested from this launcher, got b"):
        ask(command="state", id="b")


@pytest.mark.parametrize("payload", [b"", b"[]", b"{}", b'{"command": "restart"}', b"\xff", b'{"command": "fly", "id": 1}'])
def test_a_request_that_is_none_is_refused(payload):
    with pytest.raises(ValueError, match="expected"):
        Fleet({}, {}).answer({}, payload)


@pytest.mark.parametrize("argv", [["restart"], ["scale", "fusion=2"]])
def test_without_a_launcher_the_commands_say_what_to_start(argv, capsys):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Node("router", CELL, bus.Connection("router", listen=(endpoint,))):
        assert cli.main([*argv, "--connect", endpoint]) == 2
    assert "no launcher runs in cell table: start `penumbra up`" in capsys.readouterr().err
