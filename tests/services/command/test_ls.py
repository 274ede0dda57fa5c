"""`penumbra ls` finds routers of this machine and, where they announce themselves, of other hosts."""

import json
from typing import Any

import pytest

from penumbra.services.command import cli
from penumbra.shared.cell import description as cells
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node
from penumbra.tests.support import hosts
from penumbra.tests.support.live import free_port, wait_for


def listed(text: str) -> dict[str, Any]:
    return {row["router"]: row["cells"] or row["why"] for row in json.loads(text)}


@pytest.mark.slow
@pytest.mark.skipif(bool(hosts.why_not()), reason=hosts.why_not())
def test_another_host_finds_a_router_that_announces_itself_and_no_other(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with hosts.Host("robot") as robot, hosts.Host("laptop") as laptop:
        hosts.Link(robot, laptop, 9).lay()
        silent = robot.start("router", "--listen", "tcp/0.0.0.0:7448", f"--listen=unixsock-stream/{tmp_path}/silent")
        wait_for((tmp_path / "silent").exists, 20, "the silent router")
        robot.processes = {"silent": silent}
        robot.start("router", "--listen", "tcp/0.0.0.0:7447", "--announce")
        found = wait_for(
            lambda: (out := listed(laptop.penumbra("ls", "--json", "--seconds", "1"))) and "tcp/10.77.9.1:7447" in out and out,
            40,
            "the router that announces itself",
        )
        assert found == {"tcp/10.77.9.1:7447": ""}, "no cell runs yet"
        named = listed(laptop.penumbra("ls", "--json", "--connect", "tcp/10.77.9.1:7448"))
        assert named["tcp/10.77.9.1:7448"] == ""
        again = listed(laptop.penumbra("ls", "--json", "--connect", "tcp/10.77.9.1:7447"))
        assert again == {"tcp/10.77.9.1:7447": ""}, "one router is listed once"


def test_a_router_alone_is_no_cell(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    where = f"tcp/127.0.0.1:{free_port()}"

    def cells_found():
        assert cli.main(["ls", "--json", "--connect", where, "--seconds", "0.1"]) == 0
        return next(row["cells"] for row in json.loads(capsys.readouterr().out) if row["router"] == where)

    with Node("router", cells.load("table"), bus.Connection("router", listen=(where,))):
        assert cells_found() == []
        with Node("fusion", cells.load("arm"), bus.Connection(connect=(where,))):
            wait_for(lambda: cells_found() == ["arm"], 5, "the cell with a process")


def test_where_there_is_no_router_each_that_was_asked_for_says_why(monkeypatch, tmp_path, router, capsys):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    nowhere = f"tcp/127.0.0.1:{free_port()}"
    assert cli.main(["ls", "--json", "--connect", nowhere, "--connect", router, "--seconds", "0.1"]) == 0
    found = listed(capsys.readouterr().out)
    assert found[nowhere].startswith(f"no router at {nowhere}: nothing listens there")
    assert found[router] == ""
