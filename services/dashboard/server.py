"""The web server: the page's files, a websocket for its data, and requests that steer."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import socket
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web

from penumbra.services.dashboard import files, scene, security
from penumbra.services.dashboard.hub import PICTURE, SLOW, Hub, Offer, Page
from penumbra.services.dashboard.steering import Steering
from penumbra.services.dashboard.watch import Watch
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import topics
from penumbra.shared.runtime import bus
from penumbra.shared.runtime.node import Node

KEY = "X-Penumbra-Key"
"""Header with the client's key."""
MOST_BYTES = 4096
"""Maximum size [bytes] of a request from a page."""
HELLO_S = 5.0
"""Time [s] in which a new websocket must identify itself."""
HEARTBEAT_S = 10.0
STOP_S = 1.0
RETRY_S = 0.2
NEWS_S = 1.0
"""Time [s] in which a new session learns the other participants of the bus."""
HANDOVER_S = 10.0
"""Time [s] that a dashboard waits for the port of the one that it replaces."""
STRANGER = 4401
"""Close code of the websocket if the key is not valid."""


@dataclass(frozen=True)
class Place:
    """Where the page is served. address, port: to listen at; is_chosen: whether a user named the port, so that no other one is
    used; hosts: names under which the page is reached."""

    address: str
    port: int
    is_chosen: bool
    hosts: frozenset[str]


class Server:
    """Serves the page in its own thread, by `run`.

    keys: who may view and steer. look_only: the reason why nobody may steer, or empty.
    """

    def __init__(self, node: Node, place: Place, keys: security.Keys, look_only: str):
        self._node, self._place, self._keys, self._look_only = node, place, keys, look_only
        self._hub = Hub()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._files = files.read()
        self._scene: asyncio.Task[bytes] | None = None
        self._sockets: set[web.WebSocketResponse] = set()
        self._steering = Steering(node)
        self.watch = Watch(node, lambda: self._hub.wanted, self.offer)
        self.url = ""
        """The address of the page, empty while it is not served."""
        self.fault = ""
        """The reason why the page is not served, in words."""

    @property
    def pages(self) -> int:
        """Number of open pages."""
        return self._hub.wanted.pages

    @property
    def can_steer(self) -> bool:
        """Whether anybody may steer on this page."""
        return self._keys.steer is not None

    def offer(self, *offers: Offer) -> None:
        """Pass messages to the pages, from any thread."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop is just ending
                self._loop.call_soon_threadsafe(self._hub.offer, *offers)

    def emulator(self) -> dict[str, Any] | None:
        """The settings of the emulator, None if there is none or they may not be requested."""
        if not self.can_steer or self._node.cell.sim is None:
            return None
        try:
            return self._steering.emulator("state")
        except (bus.BusError, ValueError):
            return None

    # ---- life

    def run(self) -> None:
        """Serve until the node stops."""
        try:
            asyncio.run(self._run())
        finally:
            self._loop, self.url = None, ""
            self._steering.close()

    async def _run(self) -> None:
        listening = await self._listen()
        if listening is None:
            return
        self._loop = asyncio.get_running_loop()
        runner = web.AppRunner(self._app(), access_log=None, shutdown_timeout=STOP_S)
        await runner.setup()
        try:
            await web.SockSite(runner, listening).start()
            address, port = listening.getsockname()[:2]
            name = "127.0.0.1" if address in ("0.0.0.0", "::") else f"[{address}]" if ":" in address else address
            self.url = f"http://{name}:{port}/"
            self._node.log.info("the page is served", at=self.url, steering=self._look_only or "allowed")
            await asyncio.to_thread(self._node.stopping.wait)
            for each in tuple(self._sockets):
                await each.close(code=WSCloseCode.GOING_AWAY)
        finally:
            await runner.cleanup()

    async def _listen(self) -> socket.socket | None:
        """The listening socket, None if the node stops before there is one. If the port is used by the dashboard that this one
        replaces, wait for it; if another program uses it and no user chose it, use any other port."""
        place, waited_s = self._place, 0.0
        port = place.port
        while not self._node.stopping.is_set():
            listening = socket.socket(socket.AF_INET6 if ":" in place.address else socket.AF_INET)
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listening.bind((place.address, port))
                listening.listen(64)
            except OSError as error:
                listening.close()
                if not self.fault:
                    self.fault = f"the page cannot be served at {place.address}:{port} ({error.strerror}): give another --page"
                    self._node.log.warning("the page waits for its port", why=self.fault)
                may_move = error.errno == errno.EADDRINUSE and not place.is_chosen and waited_s >= NEWS_S
                if may_move and (waited_s >= HANDOVER_S or not await asyncio.to_thread(self._is_second)):
                    port = 0
                    continue
                waited_s += RETRY_S
                await asyncio.sleep(RETRY_S)
            else:
                self.fault = ""
                listening.setblocking(False)
                return listening
        return None

    def _is_second(self) -> bool:
        """Whether another dashboard of this cell, which may be about to end, is on the bus. The bus is queried: a node that has
        just opened does not know its replicas yet."""
        session = self._node.session
        if session is None:
            return False
        tokens = session.liveliness().get(topics.alive(self._node.cell.name, self._node.service))
        found = {str(reply.ok.key_expr).rpartition("/")[2] for reply in tokens if reply.ok is not None}
        return bool(found - {self._node.instance})

    # ---- requests

    def _app(self) -> web.Application:
        app = web.Application(middlewares=[self._guard], client_max_size=MOST_BYTES)
        app.add_routes(
            [
                web.get("/socket", self._socket),
                web.get("/scene", self._send_scene),
                web.post("/key", self._send_key),
                web.post("/emulator", self._steer_emulator),
                web.post("/restart", self._restart),
                *(web.get(path, self._send_file) for path in self._files),
            ]
        )
        return app

    @web.middleware
    async def _guard(self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]) -> Any:
        """Refuse requests that our page did not send, before any other check."""
        needs_origin = request.method != "GET" or request.path == "/socket"
        response: web.StreamResponse
        if why := security.refusal(request.headers, self._place.hosts, needs_origin):
            response = web.json_response({"error": why}, status=403)
        else:
            try:
                response = await handler(request)
            except web.HTTPException as error:
                response = web.json_response({"error": error.reason}, status=error.status)
        if not response.prepared:
            response.headers.update(security.HEADERS)
        return response

    def _right(self, request: web.Request) -> security.Right | None:
        return self._keys.right(request.headers.get(KEY, ""))

    async def _send_file(self, request: web.Request) -> web.Response:
        file = self._files[request.path]
        headers = {"ETag": file.tag, "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
        if request.headers.get("If-None-Match") == file.tag:
            return web.Response(status=304, headers=headers)
        body, kind = file.content, {"Content-Type": file.kind}
        if "gzip" in request.headers.get("Accept-Encoding", ""):
            body = await asyncio.to_thread(lambda: file.compressed)
            headers["Content-Encoding"] = "gzip"
        return web.Response(body=body, headers=headers | kind)

    async def _send_key(self, request: web.Request) -> web.Response:
        """The steering key if there are no certificates, else null. Only our page can read it."""
        is_open = self._keys.look is None
        return web.json_response({"key": (self._keys.steer or "") if is_open else None}, headers={"Cache-Control": "no-store"})

    async def _send_scene(self, request: web.Request) -> web.Response:
        if self._right(request) is None:
            return _error(401, "expected a key to look, got none that fits")
        if self._scene is None:
            self._scene = asyncio.create_task(asyncio.to_thread(scene.pack, self._node.cell))
        try:
            packed = await asyncio.shield(self._scene)
        except cells.CellError as error:
            self._scene = None
            return _error(500, str(error))
        return web.Response(body=packed, content_type="application/octet-stream", headers={"Cache-Control": "no-store"})

    async def _steer_emulator(self, request: web.Request) -> web.Response:
        return await self._steer(request, self._command_emulator)

    def _command_emulator(self, asked: dict[str, Any]) -> dict[str, Any]:
        value = asked.get("value")
        if value is not None and not isinstance(value, int | float | str):
            raise ValueError(f"expected a number or a text as value, got {value!r:.40}")
        return self._steering.emulator(str(asked.get("command", "")), value)

    async def _restart(self, request: web.Request) -> web.Response:
        return await self._steer(request, lambda asked: self._steering.restart(str(asked.get("service", ""))))

    async def _steer(self, request: web.Request, act: Callable[[dict[str, Any]], dict[str, Any]]) -> web.Response:
        """The answer of `act` to the request's JSON, if the client may steer."""
        if self._right(request) != "steer":
            why = self._look_only or "expected the key to steer, got none that fits: reload the page"
            self._node.log.warning("a request to steer was refused", path=request.path, why=why)
            return _error(403, why)
        try:
            asked = json.loads(await request.read())
            if request.content_type != "application/json" or not isinstance(asked, dict):
                raise ValueError
        except ValueError:
            return _error(400, "expected a JSON object")
        try:
            answer = await asyncio.to_thread(act, asked)
        except (bus.BusError, ValueError) as error:
            return _error(409, str(error))
        self._node.log.info("an operator steers", path=request.path, asked=str(asked)[:80])
        return web.json_response(answer)

    # ---- the websocket

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if self._hub.is_full:
            return _error(503, "expected fewer open pages: close one")
        socket = web.WebSocketResponse(compress=False, heartbeat=HEARTBEAT_S, max_msg_size=MOST_BYTES)
        await socket.prepare(request)
        self._sockets.add(socket)
        try:
            await self._show(socket)
        except (ConnectionError, TimeoutError):
            pass
        finally:
            self._sockets.discard(socket)
            await socket.close()
        return socket

    async def _show(self, socket: web.WebSocketResponse) -> None:
        """Send the cell's data to one page, until it is closed."""
        try:
            hello = json.loads(await socket.receive_str(timeout=HELLO_S))
            right, camera = self._keys.right(str(hello.get("key", ""))), self._camera(hello.get("camera"))
        except (ValueError, TypeError, AttributeError):
            await socket.close(code=WSCloseCode.POLICY_VIOLATION, message=b"expected a hello")
            return
        if right is None:
            await socket.close(code=STRANGER, message=b"expected a key, got none that fits")
            return
        await socket.send_json({
            "stream": "hello",
            "may_steer": right == "steer",
            "look_only": self._look_only,
            "instance": self._node.instance,
        })  # fmt: skip
        page = Page(camera)
        page.offer(SLOW, self.watch.slow())
        self._hub.open(page)
        sending = asyncio.create_task(self._send(socket, page))
        try:
            async for message in socket:
                if message.type is not WSMsgType.TEXT:
                    continue
                said = json.loads(message.data)
                if "shown" in said:
                    page.shown(said["shown"])
                if "camera" in said:
                    page.camera = self._camera(said["camera"])
                self._hub.look()
        except (ValueError, TypeError):
            await socket.close(code=WSCloseCode.POLICY_VIOLATION, message=b"expected shown or camera")
        finally:
            sending.cancel()
            self._hub.close(page)

    def _camera(self, name: Any) -> str:
        """The name of a camera of the cell, empty for none. Raises ValueError for another name."""
        if name in (None, ""):
            return ""
        if name not in self._node.cell.cameras:
            raise ValueError(f"expected a camera of the cell, got {name!r:.40}")
        return str(name)

    async def _send(self, socket: web.WebSocketResponse, page: Page) -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                stream, message = await page.next()
                self._hub.look()
                await socket.send_frame(message, WSMsgType.BINARY if stream == PICTURE else WSMsgType.TEXT)


def _error(status: int, text: str) -> web.Response:
    return web.json_response({"error": text}, status=status)
