"""A scene live in a browser, from a server that only this machine reaches.

The server lives in this process, so it ends with it, however that ends. It listens on 127.0.0.1
and answers only those who ask for it by that name: a page from elsewhere cannot read along.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import signal
import socket
import threading
import time
from contextlib import suppress
from types import TracebackType
from typing import Any

import tornado.httpserver
import tornado.web
import tornado.websocket

from orthocal.errors import OrthocalError
from orthocal.viewer.scene import Scene, viewer_script

ADDRESS = "127.0.0.1"
FIRST_PORT = 7000
PORTS_TRIED = 100

PAUSE = 0.1
"""Time until the next visitor is looked at where there is no descriptor for any, [s]."""

_EXHAUSTED = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})

_HOSTS = r"(localhost|127\.0\.0\.1)"  # tornado takes the port off


class _Page(tornado.web.RequestHandler):
    """The scene's page."""

    def initialize(self, scene: Scene) -> None:
        self.scene = scene

    def get(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.finish(self.scene.to_live_html())


class _Viewer(tornado.web.RequestHandler):
    """Meshcat's viewer, from memory: it opens no file that there may be no descriptor for."""

    def get(self) -> None:
        self.set_header("Content-Type", "text/javascript; charset=utf-8")
        self.finish(viewer_script())


class _Listener(socket.socket):
    """A listening socket that turns visitors away where the process may open no more files.

    Else the server would be told of the same visitor again and again, and say so each time.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401 - as the socket's
        super().__init__(*args, **kwargs)
        self._spare = os.open(os.devnull, os.O_RDONLY)

    def accept(self) -> tuple[socket.socket, Any]:
        """Take the next visitor in."""
        try:
            return super().accept()
        except OSError as e:
            if e.errno not in _EXHAUSTED:
                raise
        self._turn_away()
        raise BlockingIOError  # as if there were nobody

    def close(self) -> None:
        """Close it, and what it kept in reserve."""
        if self._spare >= 0:
            os.close(self._spare)
            self._spare = -1
        super().close()

    def _turn_away(self) -> None:
        """Take a visitor in by the descriptor that was kept for this, and show the way out."""
        if self._spare >= 0:
            os.close(self._spare)
            self._spare = -1
        with suppress(OSError):
            super().accept()[0].close()
        try:
            self._spare = os.open(os.devnull, os.O_RDONLY)
        except OSError:
            time.sleep(PAUSE)  # somebody else has taken it: not again at once


class _Commands(tornado.websocket.WebSocketHandler):
    """The scene's commands, all that there are and then those that follow."""

    def initialize(self, scene: Scene, listeners: set[_Commands]) -> None:
        self.scene, self.listeners = scene, listeners

    def check_origin(self, origin: str) -> bool:
        """Whether the page that asks came from here."""
        return origin == f"http://{self.request.host}"

    async def open(self, *args: str, **kwargs: str) -> None:
        self.sent, self.lock = 0, asyncio.Lock()
        self.listeners.add(self)
        await self.catch_up()

    async def catch_up(self) -> None:
        """Send what has not been sent yet."""
        async with self.lock:
            try:
                for data in self.scene.pack(self.sent):
                    await self.write_message(data, binary=True)
                    self.sent += 1
            except tornado.websocket.WebSocketClosedError:
                self.listeners.discard(self)

    def on_message(self, message: str | bytes) -> None:
        """A page has nothing to say."""

    def on_close(self) -> None:
        self.listeners.discard(self)


class LiveScene:
    """A scene on a server of this process; a context manager, too.

    What is added to the scene after that, by `scene.visualizer`, shows at once.

    Args:
        scene: What to show.
        port: Where to listen; by default the first free one from 7000 on.

    Raises:
        OrthocalError: If no port is free.
        TypeError: If that is no scene.
    """

    def __init__(self, scene: Scene, *, port: int | None = None) -> None:
        if not isinstance(scene, Scene):
            raise TypeError(f"found a {type(scene).__name__}; expected a Scene: draw_scene(...)")
        if port is not None and not (isinstance(port, int) and 0 <= port < 2**16):
            raise ValueError(f"the port is {port!r}; expected 0 to 65535")
        self.scene = scene
        self._parent = os.getppid()  # it may have ended before anybody waits
        self._socket = _listen(port)
        self.port = int(self._socket.getsockname()[1])
        self._ready = threading.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = threading.Thread(target=self._serve, name="orthocal-live", daemon=True)
        self._thread.start()
        self._ready.wait()

    @property
    def url(self) -> str:
        """Address to open in a browser on this machine."""
        return f"http://{ADDRESS}:{self.port}/"

    def wait(self) -> None:
        """Serve until Ctrl-C, until the process is asked to end, or what started it has ended."""
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
        """End the server; the port is free again."""
        if self._loop is not None and self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()

    def __enter__(self) -> LiveScene:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _serve(self) -> None:
        self._loop = loop = asyncio.new_event_loop()
        asyncio.set_event_loop(loop)
        listeners: set[_Commands] = set()
        server = tornado.httpserver.HTTPServer(_application(self.scene, listeners))
        loop.call_soon(server.add_socket, self._socket)
        loop.call_soon(self._ready.set)

        def tell() -> None:
            for listener in tuple(listeners):
                task = loop.create_task(listener.catch_up())
                tasks.add(task)  # the loop itself holds none
                task.add_done_callback(tasks.discard)

        tasks: set[asyncio.Task[None]] = set()

        def change() -> None:
            loop.call_soon_threadsafe(tell)

        self.scene.listeners.append(change)
        try:
            loop.run_forever()
        finally:
            self.scene.listeners.remove(change)
            server.stop()
            for listener in tuple(listeners):
                listener.close()
            loop.run_until_complete(server.close_all_connections())
            left = asyncio.all_tasks(loop)
            for task in left:
                task.cancel()
            loop.run_until_complete(asyncio.gather(*left, return_exceptions=True))
            loop.close()


def _application(scene: Scene, listeners: set[_Commands]) -> tornado.web.Application:
    handlers: list[Any] = [
        (r"/", _Page, {"scene": scene}),
        (r"/commands", _Commands, {"scene": scene, "listeners": listeners}),
        (r"/main\.min\.js", _Viewer),
    ]
    application = tornado.web.Application(log_function=lambda _: None)
    application.add_handlers(_HOSTS, handlers)
    logging.getLogger("tornado").setLevel(logging.ERROR)
    return application


def _listen(port: int | None) -> socket.socket:
    tried = [port] if port is not None else range(FIRST_PORT, FIRST_PORT + PORTS_TRIED)
    reason = ""
    for candidate in tried:
        try:
            made = socket.create_server((ADDRESS, candidate), backlog=128)
            found = _Listener(fileno=made.detach())
        except OSError as e:
            reason = str(e.strerror)
            continue
        found.setblocking(False)
        return found
    if port is not None:
        raise OrthocalError(f"port {port} of {ADDRESS} cannot be had: {reason}", where="port")
    raise OrthocalError(
        f"no port of {ADDRESS} from {FIRST_PORT} to {FIRST_PORT + PORTS_TRIED - 1} is free",
        where="port",
    )
