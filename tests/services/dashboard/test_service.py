"""The dashboard on a real bus, asked as a browser asks: what it shows, what it refuses, and what it steers."""

from __future__ import annotations

import asyncio
import io
import json
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import asynccontextmanager, contextmanager, suppress

import aiohttp
import pytest
from rich.console import Console

from penumbra.services.command import certs
from penumbra.services.dashboard import link, security
from penumbra.services.dashboard.hub import MOST_PAGES
from penumbra.services.launcher import launch
from penumbra.services.launcher.fleet import Fleet, Kind
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import access, topics
from penumbra.shared.runtime import bus, page
from penumbra.shared.runtime.node import Node
from penumbra.tests.services.dashboard.conftest import Served, address, started
from penumbra.tests.support.live import PATIENCE_S, free_port, wait_for
from penumbra.tests.support.nodes import node_command
from penumbra.tests.support.shown import SERVICES

TABLE = cells.load("table")
FOREIGN = "http://evil.example"


class Browser:
    """A browser's requests: those of our page, and those that other pages have it send."""

    def __init__(self, session: aiohttp.ClientSession, url: str):
        self.session, self.url = session, url
        self.own = {"Origin": url.rstrip("/")}

    async def ask(self, method: str, path: str, headers: dict[str, str] | None = None, **more) -> tuple[int, dict]:
        """Status and JSON of the answer."""
        async with self.session.request(
            method, f"{self.url}{path}", headers=self.own if headers is None else headers, **more
        ) as it:
            text = await it.read()
            return it.status, json.loads(text) if it.content_type == "application/json" else {}

    async def key(self) -> str:
        return (await self.ask("POST", "key"))[1]["key"]

    async def steer(self, path: str, request: object, key: str | None) -> tuple[int, dict]:
        headers = self.own | ({"X-Penumbra-Key": key} if key is not None else {})
        return await self.ask("POST", path, headers, json=request)

    @asynccontextmanager
    async def page(self, key: str = "", camera: str = "front"):
        """An open page: its websocket, after the hello."""
        async with self.session.ws_connect(f"{self.url}socket", headers=self.own, max_msg_size=0) as ws:
            await ws.send_json({"key": key, "camera": camera})
            yield ws


def browse(url: str, act):
    """What `act(browser)` returns, in a session without cookies or cache."""

    async def run():
        async with aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(PATIENCE_S)) as session:
            return await act(Browser(session, url))

    return asyncio.run(run())


async def until(ws, is_it):
    """The first message of a page for which `is_it` is true. As a page does, it says of every message that it was shown."""
    async with asyncio.timeout(PATIENCE_S):
        async for message in ws:
            binary = message.type is aiohttp.WSMsgType.BINARY
            said = {"stream": "picture", "bytes": message.data} if binary else json.loads(message.data)
            if said["stream"] != "hello":
                await ws.send_json({"shown": said["stream"]})
            if is_it(said):
                return said
    raise AssertionError(f"the websocket ended with {ws.close_code}")


def of_stream(stream: str, is_it=lambda said: True):
    """Whether a message is of a stream, and is as it should be."""
    return lambda said: said["stream"] == stream and is_it(said)


def outlined(picture: bytes) -> bool:
    """Whether a picture shows the mask and the outline of the pose."""
    header = json.loads(picture[4 : 4 + int.from_bytes(picture[:4], "little")])
    return bool(header["mask"] and header["outlines"].get("forearm", {}).get("lines"))


def running(said) -> set[str]:
    """The names of the processes that a page is told of."""
    return {row["name"] for row in said.get("processes", {}).get("rows", ())}


def last_state(said) -> dict:
    """The newest entry of the timeline on a pose."""
    return [entry for entry in said["timeline"] if entry["kind"] == "target"][-1]


# ---- looking


def test_a_page_receives_pose_scene_picture_processes_and_rates(served: Served):
    """Of each stream the first that is whole: the cell may have begun a moment ago, each pad by itself."""
    measured = {topic.name for topic in topics.TOPICS} - {"joints"}
    everything = {"dashboard", *SERVICES, "router"}

    def is_whole(moment) -> bool:
        now = moment["targets"]["forearm"]
        senses, sources = set(now.get("senses", ())), set(now.get("sources", ()))
        from_both = senses == {"vision front", "haptic"} and sources == {"vision", "haptic"}
        is_tracked = now["state"] == "tracking" and now["error"] is not None and now["ellipsoid"] is not None
        return from_both and is_tracked and moment["pads"].keys() == TABLE.pads.keys()

    def is_told(slow) -> bool:
        has_rates = {row["topic"] for row in slow["rates"]} == measured
        return has_rates and everything <= running(slow) and bool(slow["timeline"]) and last_state(slow)["state"] == "tracking"

    async def look(browser: Browser):
        async with browser.page() as ws:
            hello = await until(ws, lambda said: True)
            assert hello["stream"] == "hello" and not hello["may_steer"], "without the key a page may look"
            moment = await until(ws, of_stream("moment", is_whole))
            picture = await until(ws, of_stream("picture", lambda said: outlined(said["bytes"])))
            await until(ws, of_stream("slow", is_told))
        return moment, picture["bytes"]

    moment, picture = browse(served.url, look)
    now = moment["targets"]["forearm"]
    assert now["error"]["position"] < 0.05 and len(now["ellipsoid"]["radii"]) == 3
    assert picture.rstrip().endswith(b"\xff\xd9")


def test_a_page_that_does_not_show_what_it_gets_gets_one_message_a_stream(served: Served):
    """A second page that keeps up says how much time has passed."""

    async def look(browser: Browser):
        async with browser.page() as silent, browser.page() as other:
            for _ in range(15):
                await until(other, of_stream("moment"))
            await silent.ping()
            counts: dict[str, int] = {}
            while True:
                try:
                    message = await silent.receive(timeout=0.5)
                except TimeoutError:
                    return counts
                stream = "picture" if message.type is aiohttp.WSMsgType.BINARY else json.loads(message.data)["stream"]
                counts[stream] = counts.get(stream, 0) + 1

    assert browse(served.url, look) == {"hello": 1, "moment": 1, "picture": 1, "slow": 1}


def test_nothing_is_taken_from_cameras_and_skin_while_no_page_is_open(served: Served):
    frames = topics.FRAME.at(cell="table", camera="front")
    session = served.shown.nodes["emulator"].session
    assert session is not None
    publisher = session.declare_publisher(frames)

    def is_read() -> bool:
        return publisher.matching_status.matching  # type: ignore[attr-defined]  # zenoh's stubs say that it is a bool

    wait_for(lambda: not is_read(), 30, "nobody to read frames")

    async def look(browser: Browser):
        async with browser.page() as ws:
            await until(ws, of_stream("picture"))
            return is_read()

    assert browse(served.url, look)
    wait_for(lambda: not is_read(), 30, "nobody to read frames")
    publisher.undeclare()
    assert served.page["pages"] == 0


def test_the_reason_of_a_lost_pose_is_in_the_timeline(served: Served):
    async def look(browser: Browser):
        async with browser.page() as ws:
            served.shown.hidden, served.shown.feels = 0.9, False
            try:
                lost = await until(ws, of_stream("slow", lambda said: last_state(said)["state"] == "lost"))
            finally:
                served.shown.hidden, served.shown.feels = 0.1, True
            await until(ws, of_stream("slow", lambda said: last_state(said)["state"] == "tracking"))
            return last_state(lost)["why"]

    why = browse(served.url, look)
    assert "vision of front: too little to see, 90% hidden" in why and "haptic: nothing in range, gap 40 cm" in why


def test_the_scene_and_the_files_come_compressed_and_only_once(served: Served):
    async def look(browser: Browser):
        status, _ = await browser.ask("GET", "scene", {})
        async with browser.session.get(browser.url) as first:
            text, tag = await first.text(), first.headers["ETag"]
            policy = first.headers["Content-Security-Policy"]
        async with browser.session.get(browser.url, headers={"If-None-Match": tag}) as again:
            return status, text, policy, again.status

    status, text, policy, again = browse(served.url, look)
    assert status == 200 and "<title>Penumbra</title>" in text and again == 304
    assert "frame-ancestors 'none'" in policy and "unsafe" not in policy, (
        "no other page may frame ours and have its buttons pressed"
    )


@pytest.mark.parametrize(
    "path", ["../service.py", "page/index.html", "vendor/", "vendor/../../service.py", "%2e%2e/service.py", "x"]
)
def test_nothing_but_the_pages_files_can_be_asked_for(served: Served, path: str):
    host, port = served.host.split(":")
    with socket.create_connection((host, int(port)), 10) as raw:
        raw.sendall(f"GET /{path} HTTP/1.1\r\nHost: {served.host}\r\nConnection: close\r\n\r\n".encode())
        assert raw.makefile("rb").readline().split()[1] == b"404"


# ---- steering


def test_the_page_steers_the_emulator(served: Served):
    async def steer(browser: Browser):
        key = await browser.key()
        answers = [
            await browser.steer("emulator", {"command": "occlude", "value": 0.25}, key),
            await browser.steer("emulator", {"command": "speed", "value": 2}, key),
            await browser.steer("emulator", {"command": "motion", "value": "off"}, key),
            await browser.steer("emulator", {"command": "occlude", "value": 7}, key),
            await browser.steer("emulator", {"command": "skin", "value": "p0 dead"}, key),
        ]
        async with browser.page(key) as ws:
            hello = await until(ws, lambda said: True)
            slow = await until(ws, of_stream("slow", lambda said: (said.get("emulator") or {}).get("occlusion") == 0.25))
        return answers, hello, slow["emulator"]

    answers, hello, emulator = browse(served.url, steer)
    assert [status for status, _ in answers] == [200, 200, 200, 409, 409]
    assert "expected a share from 0 to 1 or auto, got 7" in answers[3][1]["error"], "the emulator's own reason"
    assert hello["may_steer"]
    assert (emulator["occlusion"], emulator["speed"], emulator["motion"]) == (0.25, 2.0, "off")


def test_without_a_launcher_a_restart_says_so(served: Served):
    async def steer(browser: Browser):
        return await browser.steer("restart", {"service": "fusion"}, await browser.key())

    status, said = browse(served.url, steer)
    assert status == 409 and "no launcher runs in cell table" in said["error"]


@contextmanager
def launching(endpoint: str, service: str, command: list[str], console: Console) -> Iterator[launch.Launcher]:
    """A real launcher with one real process."""
    node = Node("launcher", TABLE, bus.Connection(connect=(endpoint,))).open()
    launcher = launch.Launcher(node, Fleet({service: Kind(command)}, {service: 1}), console, keep_going=True)
    thread = threading.Thread(target=launcher.run, args=(600,))
    thread.start()
    try:
        yield launcher
    finally:
        node.stopping.set()
        thread.join(PATIENCE_S)
        node.close()


@pytest.fixture
def launched(served: Served) -> Iterator[launch.Launcher]:
    with launching(served.endpoint, "worker", node_command("worker", served.endpoint), Console(quiet=True)) as launcher:
        yield launcher


def test_the_page_restarts_a_process_of_the_launcher(served: Served, launched: launch.Launcher):
    wait_for(lambda: [each.is_ready for each in launched.fleet.processes] == [True], 60, "the worker to serve")
    before = launched.fleet.processes[0].pid

    async def steer(browser: Browser):
        key = await browser.key()
        async with browser.page(key) as ws:
            slow = await until(ws, of_stream("slow", lambda said: "worker" in str(said.get("processes"))))
        return slow["processes"], await browser.steer("restart", {"service": "worker"}, key)

    processes, (status, said) = browse(served.url, steer)
    (row,) = (row for row in processes["rows"] if row["service"] == "worker")
    assert processes["can_restart"] and row["can_restart"]
    assert (status, said) == (200, {"what": "restart of worker", "error": ""})
    assert launched.fleet.processes[0].pid != before


# ---- who is refused


STEERING = [("POST", "emulator"), ("POST", "restart"), ("POST", "key"), ("GET", "socket")]


def refused(served: Served, method: str, path: str, headers: dict[str, str]) -> tuple[int, dict]:
    """What a request gets that has everything but what `headers` say; a websocket asks for its upgrade."""

    async def ask(browser: Browser):
        upgrade = {
            "Connection": "Upgrade",
            "Upgrade": "websocket",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "x" * 22 + "==",
        }
        key = {"X-Penumbra-Key": await browser.key()}
        body = {} if path == "socket" else {"json": {"command": "occlude", "value": 0.9, "service": "fusion"}}
        return await browser.ask(method, path, (upgrade if path == "socket" else {}) | key | headers, **body)

    return browse(served.url, ask)


@pytest.mark.parametrize(("method", "path"), STEERING)
def test_another_page_in_the_browser_can_neither_look_nor_steer(served: Served, method: str, path: str):
    for origin in (FOREIGN, "null", "http://127.0.0.1:1", f"http://{served.host}.evil.example", "http://localhost"):
        status, said = refused(served, method, path, {"Origin": origin})
        assert status == 403 and "expected an Origin of the page itself" in said["error"], origin


@pytest.mark.parametrize(("method", "path"), STEERING)
def test_a_request_without_an_origin_can_neither_look_nor_steer(served: Served, method: str, path: str):
    status, said = refused(served, method, path, {})
    assert status == 403 and "expected an Origin, got none" in said["error"]


@pytest.mark.parametrize(("method", "path"), [*STEERING, ("GET", ""), ("GET", "scene"), ("GET", "main.js")])
def test_a_name_that_leads_here_by_a_trick_of_dns_is_refused(served: Served, method: str, path: str):
    port = served.host.split(":")[1]
    for host in (f"evil.example:{port}", f"127.0.0.1.evil.example:{port}", "evil.example", f"127.0.0.1@evil.example:{port}", ""):
        status, said = refused(served, method, path, {"Host": host, "Origin": f"http://{host}"})
        assert status in (400, 403) and "error" in said, host


@pytest.mark.parametrize("path", ["scene", "main.js"])
def test_another_page_cannot_load_ours_as_a_part_of_it(served: Served, path: str):
    status, said = browse(served.url, lambda browser: browser.ask("GET", path, {"Sec-Fetch-Site": "cross-site"}))
    assert status == 403 and "got one from cross-site" in said["error"]
    assert browse(served.url, lambda browser: browser.ask("GET", path, {"Sec-Fetch-Site": "same-origin"}))[0] == 200


@pytest.mark.parametrize("path", ["emulator", "restart"])
@pytest.mark.parametrize("key", [None, "", "guess", "é"])
def test_without_the_key_nothing_is_steered(served: Served, path: str, key: str | None):
    before = served.shown.hidden
    request = {"command": "occlude", "value": 0.95, "service": "fusion"}
    status, said = browse(served.url, lambda browser: browser.steer(path, request, key))
    assert status == 403 and "expected the key to steer" in said["error"]
    assert served.shown.hidden == before


@pytest.mark.parametrize(
    ("content", "status"),
    [(b"", 400), (b"[1]", 400), (b"{", 400), (b"x" * 5000, 413), (b'{"command": "occlude", "value": {}}', 409)],
)
def test_a_request_that_is_none_is_refused(served: Served, content: bytes, status: int):
    async def ask(browser: Browser):
        headers = browser.own | {"X-Penumbra-Key": await browser.key(), "Content-Type": "application/json"}
        return await browser.ask("POST", "emulator", headers, data=content)

    found, said = browse(served.url, ask)
    assert (found, bool(said["error"])) == (status, True)


@pytest.mark.parametrize(
    "hello", ["", "[]", "null", '{"key": "", "camera": "none"}', '{"key": 1, "camera": ["front"]}', "x" * 5000]
)
def test_a_page_with_a_wrong_hello_is_closed(served: Served, hello: str):
    async def greet(browser: Browser):
        async with browser.session.ws_connect(f"{browser.url}socket", headers=browser.own) as ws:
            await ws.send_str(hello)
            while (message := await ws.receive()).type is aiohttp.WSMsgType.TEXT:
                pass
            return message.type, ws.close_code

    kind, code = browse(served.url, greet)
    assert kind in (aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED) and code in (1008, 1009)
    wait_for(lambda: served.page["pages"] == 0, 30, "no page")


def test_the_number_of_pages_is_limited(served: Served):
    async def crowd(browser: Browser):
        opened = []
        for _ in range(MOST_PAGES):
            ws = await browser.session.ws_connect(f"{browser.url}socket", headers=browser.own)
            await ws.send_json({"key": "", "camera": ""})
            await ws.receive()
            opened.append(ws)
        try:
            await browser.session.ws_connect(f"{browser.url}socket", headers=browser.own)
        except aiohttp.WSServerHandshakeError as error:
            return error.status
        finally:
            for ws in opened:
                await ws.close()

    assert browse(served.url, crowd) == 503


@pytest.mark.parametrize(
    ("host", "origin", "is_fine"),
    [
        ("127.0.0.1:8470", "http://127.0.0.1:8470", True),
        ("LocalHost:8470", "http://localhost:8470", True),
        ("[::1]:8470", "http://[::1]:8470", True),
        ("cell-7.example", "https://cell-7.example", True),
        ("cell-7.example", "http://cell-7.example:81", False),
        ("cell-7.example.evil", "http://cell-7.example.evil", False),
        ("127.0.0.1:8470", "file://127.0.0.1:8470", False),
        ("[::1", "http://[::1", False),
    ],
)
def test_hosts_and_origins(host: str, origin: str, is_fine: bool):
    known = security.hosts("0.0.0.0", ["Cell-7.example"])
    assert (security.refusal({"Host": host, "Origin": origin}, known, True) == "") == is_fine


# ---- rights


def test_a_dashboard_that_only_looks_has_no_key(served: Served):
    words = ("--look-only", "--page", str(free_port()))
    with started(TABLE, bus.Connection(connect=(served.endpoint,)), *words) as node:

        async def steer(browser: Browser):
            assert await browser.key() == ""
            async with browser.page() as ws:
                hello = await until(ws, lambda said: True)
            return hello, await browser.steer("emulator", {"command": "occlude", "value": 0.95}, "")

        hello, (status, said) = browse(address(node), steer)
    assert not hello["may_steer"] and status == 403
    assert hello["look_only"] == said["error"] == "this page only shows: --look-only"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("certs")
    certs.make(out)
    return out


@pytest.mark.parametrize("has_operator", [True, False])
def test_on_a_secured_bus_a_viewer_looks_an_operator_steers_and_a_stranger_sees_nothing(folder, tmp_path, has_operator: bool):
    """The dashboard's folder holds what its machine may do: without the operator's certificate the router lets nobody steer."""
    own = tmp_path / "own"
    own.mkdir()
    for name in ("ca", "dashboard", "viewer", *(("operator",) if has_operator else ())):
        for path in folder.glob(f"{name}*.pem"):
            (own / path.name).write_bytes(path.read_bytes())
    endpoint = f"tls/127.0.0.1:{free_port()}"
    viewer, operator = page.key(folder, access.VIEWER), page.key(folder, access.OPERATOR)
    assert viewer and operator and viewer != operator
    router = Node("router", TABLE, bus.Connection("router", listen=(endpoint,), secure=folder))
    emulator = Node("emulator", TABLE, bus.Connection(connect=(endpoint,), secure=folder))
    emulator.answer(topics.control("table"), lambda parameters, payload: payload)
    secured = bus.Connection(connect=(endpoint,), secure=own)
    with router, emulator, started(TABLE, secured, "--page", str(free_port())) as node:

        async def steer(browser: Browser):
            assert await browser.key() is None, "the key is not given to whoever asks"
            seen = []
            for key in ("", "guess", viewer, operator):
                async with browser.page(key) as ws:
                    message = await ws.receive()
                    seen.append(
                        json.loads(message.data)["may_steer"] if message.type is aiohttp.WSMsgType.TEXT else ws.close_code
                    )
            looked = [(await browser.ask("GET", "scene", {"X-Penumbra-Key": key}))[0] for key in ("", viewer)]
            command = {"command": "occlude", "value": 0.5}
            return seen, looked, [await browser.steer("emulator", command, key) for key in ("", viewer, operator)]

        seen, looked, steered = browse(address(node), steer)
    assert looked == [401, 200]
    if has_operator:
        assert seen == [4401, 4401, False, True]
        assert [status for status, _ in steered] == [403, 403, 200] and steered[2][1] == {"command": "occlude", "value": 0.5}
    else:
        assert seen == [4401, 4401, False, 4401]
        assert [status for status, _ in steered] == [403] * 3 and "holds no certificate of an operator" in steered[2][1]["error"]


def test_the_links_of_a_secured_cell_are_printed_for_those_who_hold_its_certificates(folder, tmp_path):
    assert link.links(folder, "http://127.0.0.1:8470/") == [
        f"to look   http://127.0.0.1:8470/#key={page.key(folder, 'viewer')}",
        f"to steer  http://127.0.0.1:8470/#key={page.key(folder, 'operator')}",
    ]
    with pytest.raises(bus.BusError, match=r"expected viewer-key.pem or operator-key.pem, got neither"):
        link.links(tmp_path, "http://127.0.0.1:8470/")


# ---- the port


def test_a_port_that_is_taken_is_reported_and_waited_for(served: Served, caplog):
    port = free_port()
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.1", port))
        other.listen()
        node = started(TABLE, bus.Connection(connect=(served.endpoint,)), "--page", str(port)).open()
        try:
            wait_for(lambda: f"the page cannot be served at 127.0.0.1:{port}" in str(node.health()["reasons"]), 30, "the reason")
            other.close()
            assert address(node) == f"http://127.0.0.1:{port}/"
            assert caplog.text.count("the page waits for its port") == 1
            assert not node.health()["reasons"]
        finally:
            node.close()


def test_a_wrong_address_is_refused():
    with pytest.raises(bus.BusError, match="--page: expected a port from 1 to 65535, or ADDRESS:PORT"):
        started(TABLE, bus.Connection(), "--page", "here")


def test_a_page_is_back_at_its_address_when_the_dashboard_was_killed_or_restarted(router: str):
    """The new one begins while the old one has the port, and takes it over."""
    port = free_port()
    command = [sys.executable, "-c", SERVES.format(port=port), "dashboard", "--cell", "table", "--connect", router]
    out = io.StringIO()
    with launching(router, "dashboard", command, Console(file=out, width=400)) as launcher:

        def pid() -> int:
            """The process that serves the page, as its health says; 0 where none does."""
            found = [each for each in launcher.watch.health.values() if page.address_in([each]) == f"http://127.0.0.1:{port}/"]
            return found[0].pid if len(found) == 1 else 0

        first = wait_for(pid, 60, "the page")
        os.kill(first, signal.SIGKILL)
        second = wait_for(lambda: pid() not in (0, first) and pid(), 60, "the page after a kill")
        key = wait_for(lambda: got_key(port), 60, "an answer")

        async def restart(browser: Browser):
            with suppress(aiohttp.ClientError):  # the one that is asked ends before it has answered
                await browser.steer("restart", {"service": "dashboard"}, key)

        browse(f"http://127.0.0.1:{port}/", restart)
        wait_for(lambda: pid() not in (0, first, second), 60, "the page after a restart")
        assert wait_for(lambda: got_key(port), 60, "an answer") != key, "a key is of one process"
        wait_for(lambda: f"page: http://127.0.0.1:{port}/" in out.getvalue(), 30, "the address on the launcher's screen")


SERVES = """
import sys
from penumbra.shared.runtime import page
page.PORT = {port}  # as if nobody had chosen one
from penumbra.services.command.cli import main
sys.exit(main(sys.argv[1:]))
"""


def got_key(port: int) -> str:
    """The key that a page gets, empty where nobody answers."""
    with suppress(aiohttp.ClientError):
        return browse(f"http://127.0.0.1:{port}/", Browser.key)
    return ""
