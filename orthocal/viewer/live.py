"""Live scenes: a web server in this process that only this machine can reach.

The server ends with the process in every case. It listens on 127.0.0.1 and answers only requests
for that name from its own pages. So no other web page can read the scene.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import threading
from typing import Any

import tornado.httpserver
import tornado.iostream
import tornado.web
import tornado.websocket

from orthocal.errors import OrthocalError
from orthocal.viewer.scene import Scene, viewer_script

ADDRESS = "127.0.0.1"
FIRST_PORT = 7000
PORT_COUNT = 100

ACCEPT_DELAY = 0.1
"""Delay before the next attempt to accept a connection if no file descriptor is free, [s]."""

_HOSTS = r"(localhost|127\.0\.0\.1)"  # tornado removes the port


class _SameOrigin(tornado.web.RequestHandler):
    """Handler that refuses requests from pages of other origins.

    Tornado's check compares only the host, and trusts `Sec-Fetch-Site`. This check also compares
    the scheme. It runs before the handler of every request.
    """

    def initialize(self, scene: Scene, listeners: set[_Commands]) -> None:
        self.scene, self.listeners = scene, listeners

    def prepare(self) -> None:
        headers = self.request.headers
        for name in ("Origin", "Sec-Websocket-Origin"):
            if headers.get(name, f"http://{self.request.host}") != f"http://{self.request.host}":
                raise tornado.web.HTTPError(403)


class _Page(_SameOrigin):
    """Page of the scene."""

    def get(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.finish(self.scene.to_live_html())


class _Viewer(_SameOrigin):
    """Viewer of meshcat, sent from memory because a file would need a free descriptor."""

    def get(self) -> None:
        self.set_header("Content-Type", "text/javascript; charset=utf-8")
        self.finish(viewer_script())


class _Commands(_SameOrigin, tornado.websocket.WebSocketHandler):
    """Commands of the scene: all existing ones, then each new one."""

    def check_origin(self, origin: str) -> bool:
        """Accept the origin, which `prepare` has checked."""
        return True

    async def open(self, *args: str, **kwargs: str) -> None:
        self.sent, self.lock = 0, asyncio.Lock()
        self.listeners.add(self)
        await self.catch_up()

    async def catch_up(self) -> None:
        """Send the commands that have not been sent yet."""
        async with self.lock:
            try:
                for data in self.scene.pack(self.sent):
                    await self.write_message(data, binary=True)
                    self.sent += 1
            except tornado.websocket.WebSocketClosedError:
                self.listeners.discard(self)

    def on_message(self, message: str | bytes) -> None:
        """Ignore messages of the page."""

    def on_close(self) -> None:
        self.listeners.discard(self)


class LiveScene:
    """Web server that shows a scene; also a context manager.

    Commands that `scene.visualizer` adds later are shown immediately.

    Args:
        scene: The scene.
        port: Port of the server; by default the first free one from 7000 on.

    Raises:
        OrthocalError: If no port is free.
        TypeError: If `scene` is not a Scene.
    """

    def __init__(self, scene: Scene, *, port: int | None = None) -> None:
        if not isinstance(scene, Scene):
            raise TypeError(f"found a {type(scene).__name__}; expected a Scene: draw_scene(...)")
        if port is not None and not (isinstance(port, int) and 0 <= port < 2**16):
            raise ValueError(f"the port is {port!r}; expected 0 to 65535")
        self.scene = scene
        self._parent = os.getppid()  # the parent may end before `wait` is called
        self._socket = _listen(port)
        self.port = int(self._socket.getsockname()[1])
        self._ready = threading.Event()
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._serve()), name="orthocal-live", daemon=True
        )
        self._thread.start()
        self._ready.wait()

    @property
    def url(self) -> str:
        """Address to open in a browser on this machine."""
        return f"http://{ADDRESS}:{self.port}/"

    def wait(self) -> None:
        """Serve until Ctrl-C, a request to terminate, or the end of the parent process."""
        ended = threading.Event()
        previous = {
            number: signal.signal(number, lambda *_: ended.set())
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        try:
            while not ended.wait(0.2) and os.getppid() == self._parent:
                pass
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)

    def close(self) -> None:
        """Stop the server and free its port."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._end.set)
            self._thread.join()

    def __enter__(self) -> LiveScene:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    async def _serve(self) -> None:
        """Run the server until `close`."""
        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        listeners: set[_Commands] = set()
        tasks: set[asyncio.Task[None]] = set()
        server = tornado.httpserver.HTTPServer(_application(self.scene, listeners))
        accepting = asyncio.create_task(_accept(server, self._socket))

        def send() -> None:
            for listener in tuple(listeners):
                task = asyncio.create_task(listener.catch_up())
                tasks.add(task)  # the event loop has only a weak reference
                task.add_done_callback(tasks.discard)

        def notify() -> None:
            self._loop.call_soon_threadsafe(send)

        self.scene.listeners.append(notify)
        self._ready.set()
        try:
            await self._end.wait()
        finally:
            self.scene.listeners.remove(notify)
            accepting.cancel()
            await asyncio.wait([accepting])
            self._socket.close()
            for listener in tuple(listeners):
                listener.close()
            await server.close_all_connections()


async def _accept(server: tornado.httpserver.HTTPServer, listening: socket.socket) -> None:
    """Accept connections, with a delay while the process has no free file descriptor.

    Tornado's loop would try to accept the same connection without a delay.
    """
    while True:
        try:
            connection, address = await asyncio.get_running_loop().sock_accept(listening)
        except OSError:
            await asyncio.sleep(ACCEPT_DELAY)
        else:
            server.handle_stream(tornado.iostream.IOStream(connection), address)


def _application(scene: Scene, listeners: set[_Commands]) -> tornado.web.Application:
    """Application with the handlers of the scene."""
    shared = {"scene": scene, "listeners": listeners}
    handlers: list[Any] = [
        (r"/", _Page, shared),
        (r"/commands", _Commands, shared),
        (r"/main\.min\.js", _Viewer, shared),
    ]
    application = tornado.web.Application(log_function=lambda _: None)
    application.add_handlers(_HOSTS, handlers)
    logging.getLogger("tornado").setLevel(logging.ERROR)
    return application


def _listen(port: int | None) -> socket.socket:
    """Listening socket on a port, or on the first free default port.

    Raises:
        OrthocalError: If no port is free.
    """
    candidates = [port] if port is not None else range(FIRST_PORT, FIRST_PORT + PORT_COUNT)
    reason = ""
    for candidate in candidates:
        try:
            server = socket.create_server((ADDRESS, candidate), backlog=128)
        except OSError as e:
            reason = str(e.strerror)
            continue
        server.setblocking(False)
        return server
    if port is not None:
        raise OrthocalError(f"cannot listen on port {port} of {ADDRESS}: {reason}", where="port")
    raise OrthocalError(
        f"no port of {ADDRESS} from {FIRST_PORT} to {FIRST_PORT + PORT_COUNT - 1} is free",
        where="port",
    )
