"""`penumbra up --detach`, ps, logs and down, with a real launcher; and the records that they read."""

import json
import os
import subprocess

import psutil
import pytest

from penumbra.services.command import cli, machine, runs
from penumbra.services.launcher import background
from penumbra.shared.cell import names
from penumbra.shared.contract.processes import PROCESSES
from penumbra.tests.support.live import PATIENCE_S, free_port, penumbra_command, wait_for

NOTHING = [f"--replicas={process.name}=0" for process in PROCESSES if process.replicas and process.name != "router"]


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch):
    """A state folder of the test's own, in which nothing runs at its end."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    yield tmp_path
    for run in runs.running():
        psutil.Process(run.pid).kill()


def test_a_cell_in_the_background_is_listed_has_logs_and_is_ended(capfd):
    before = set(os.listdir("/dev/shm"))
    assert cli.main(["up", "--detach", "--port", str(free_port()), *NOTHING, "--replicas=fusion=1"]) == 0
    said = capfd.readouterr().out
    assert "cell table runs (pid " in said.splitlines()[-1]
    (run,) = runs.running()
    wait_for(lambda: {row.process for row in machine.rows(run)} == {"launcher", "router", "fusion"}, 10, "all processes")
    assert cli.main(["ps", "--json"]) == 0
    rows = {row["process"]: row for row in json.loads(capfd.readouterr().out)}
    assert rows["launcher"]["pid"] == run.pid and rows["router"]["state"] == "running"
    assert all(row["memory_mb"] > 1 and row["uptime_s"] >= 0 for row in rows.values())
    assert cli.main(["logs", "fusion", "-n", "50"]) == 0
    assert "fusion: on the bus" in capfd.readouterr().out
    assert cli.main(["logs", "nobody"]) == 2
    assert "expected the log of one of fusion, launcher, router, got 'nobody'" in capfd.readouterr().err
    assert cli.main(["ls", "--json", "--connect", *run.connect]) == 0
    assert {"router": run.connect[0], "cells": ["table"], "why": ""} in json.loads(capfd.readouterr().out)
    assert cli.main(["up", "--detach", "--port", str(free_port()), *NOTHING]) == 2
    assert f"cell table runs already (pid {run.pid}): end it with `penumbra down table`" in capfd.readouterr().err
    children = psutil.Process(run.pid).children(recursive=True)
    assert cli.main(["down", "arm"]) == 2
    assert "expected a cell that runs on this machine, got 'arm'; choose one of table" in capfd.readouterr().err
    assert cli.main(["down"]) == 0
    assert not any(child.is_running() and child.status() != psutil.STATUS_ZOMBIE for child in children)
    assert runs.running() == []
    left = [name for name in set(os.listdir("/dev/shm")) - before if str(run.pid) in name]
    assert left == []


def test_a_cell_that_does_not_start_in_the_background_says_why(capfd):
    taken = free_port()
    assert cli.main(["up", "--detach", "--connect", f"tcp/127.0.0.1:{taken}", "--replicas=magic=1"]) == 2
    assert "--replicas magic=1: expected one of emulator" in capfd.readouterr().err


def test_a_cell_that_waits_for_its_router_in_the_background_says_so_is_listed_and_can_be_ended(capfd):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = penumbra_command("up", "--detach", "--connect", endpoint, *NOTHING, "--replicas=fusion=1")
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as starter:
        assert starter.stdout is not None
        assert starter.stdout.readline() == f"waiting for the router at {endpoint}\n"
        assert [run.cell for run in runs.running()] == ["table"]
        assert cli.main(["down"]) == 0
        assert starter.wait(PATIENCE_S) == 1
    assert runs.running() == []


def test_a_slow_start_is_told_in_few_lines(monkeypatch, tmp_path, capsys):
    def told(lines):
        said, say = os.pipe()
        with os.fdopen(say, "w") as pipe, subprocess.Popen(["sleep", "60"]) as launcher:
            pipe.writelines(f"{line}\n" for line in lines)
            pipe.flush()
            try:
                assert background._follow(launcher, said, tmp_path / "log") == 0
            finally:
                launcher.kill()
                os.close(said)
        return capsys.readouterr().out.splitlines()[:-1]

    lines = ["waiting for a (0.1 s)", "waiting for a (0.2 s)", "waiting for b", "waiting for c", "up: cell"]
    assert told(lines) == ["waiting for a (0.1 s)"]
    monkeypatch.setattr(background, "TELL_S", 0.0)
    assert told(lines) == ["waiting for a (0.1 s)", "waiting for b", "waiting for c"]


def test_nothing_that_runs_is_said_in_a_line(capfd):
    for command in (["ps"], ["down"], ["logs"]):
        assert cli.main(command) == (0 if command == ["ps"] else 2)
    out, err = capfd.readouterr()
    assert out == "no cell runs on this machine: start one with `penumbra up`\n"
    assert err.splitlines() == [
        "penumbra down: no cell runs on this machine: start one with `penumbra up`",
        "penumbra logs: no logs on this machine: `penumbra up --detach` keeps them",
    ]


def test_records_of_launchers_that_are_gone_are_removed(state):
    with runs.recorded("table", names.source("table"), ("tcp/127.0.0.1:1",), None, None):
        (run,) = runs.running()
        assert (run.cell, run.pid, run.logs) == ("table", os.getpid(), None)
        path = state / "penumbra" / "run" / f"{os.getpid()}.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "began": 1.0}))
        assert runs.running() == [], "another process has its number"
        assert not path.exists()


def test_logs_of_several_services_are_in_the_order_of_time_also_while_they_are_followed(state):
    logs = runs.Logs(state / "here")

    def say(service: str, second: int, *more: str) -> None:
        for line in (f"2026-11-23T00:00:{second:02}.000Z info    {service}: {second}", *more):
            logs.write(service, f"{line}\n")

    def numbers(lines: list[machine.Line]) -> list[str]:
        return [line.text.rpartition(" ")[2] for line in lines]

    say("fusion", 1)
    say("fusion", 4, "Traceback", "ValueError: bad")
    say("search", 2)
    logs.write("search", '{"time": "2026-11-23T00:00:05.000Z", "level": "info", "message": "as JSON: 5"}\n')
    merged = machine.Merged(state / "here", ())
    assert [(line.service, line.text.split()[-1]) for line in merged.read()] == [
        ("fusion", "1"),
        ("search", "2"),
        ("fusion", "4"),
        ("fusion", "Traceback"),
        ("fusion", "bad"),
        ("search", '5"}'),
    ]
    say("search", 8)
    assert merged.settled() == []
    say("fusion", 7)  # in the file after what was logged later
    say("haptics", 9)
    assert numbers(merged.settled()) == ["7", "8"]
    assert numbers(merged.settled()) == ["9"]
    assert merged.width == len("haptics")
    assert machine.Merged(state / "here", ("fusion",)).read()[-1].text.endswith("7")
    assert machine.Merged(state / "here", ("fusion",)).width == 0


def test_the_newest_lines_of_all_services_are_printed_with_their_names(state, capfd):
    logs = runs.Logs(runs.logs_of("table"))
    for second, service in enumerate(("fusion", "search", "fusion", "search")):
        logs.write(service, f"2026-11-23T00:00:{second:02}.000Z info    {service}: said {second}\n")
    assert cli.main(["logs", "-n", "3"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert [line.partition(" | ")[0] for line in lines] == ["search", "fusion", "search"]
    assert [line[-1] for line in lines] == ["1", "2", "3"]
    assert cli.main(["logs", "fusion", "-n", "1"]) == 0
    assert capfd.readouterr().out == "2026-11-23T00:00:02.000Z info    fusion: said 2\n"


def test_a_log_is_rolled_and_followed_across_its_roll(state, monkeypatch):
    monkeypatch.setattr(runs, "LOG_BYTES", 200)
    logs = runs.Logs(state / "here")
    logs.write("fusion", "first\n")
    tail = machine.Tail(state / "here" / "fusion.log")
    seen = list(tail.read())
    for number in range(60):
        logs.write("fusion", f"line {number} of sixty\n")
        seen += tail.read()
    assert seen == ["first", *(f"line {number} of sixty" for number in range(60))]
    assert (state / "here" / "fusion.log").stat().st_size <= 200
    assert len(list((state / "here").glob("fusion.log*"))) == 1 + runs.LOGS_KEPT
