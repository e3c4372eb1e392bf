"""Live scenes: a web server in this process that only this machine can reach.

The server ends with the process, however the process ends. It listens on 127.0.0.1 and answers
only requests for that name from its own pages, so that no other web page can read the scene.
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
"""Delay before the next connection if the process has no free file descriptor, [s]."""

_EXHAUSTED = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})

_HOSTS = r"(localhost|127\.0\.0\.1)"  # tornado removes the port


class _SameOrigin(tornado.web.RequestHandler):
    """A handler that refuses requests from pages of other origins.

    Tornado's own check compares the host alone, and trusts `Sec-Fetch-Site`; this one also
    compares the scheme, and runs for every request before the handler does.
    """

    def initialize(self, scene: Scene, listeners: set[_Commands]) -> None:
        self.scene, self.listeners = scene, listeners

    def prepare(self) -> None:
        headers = self.request.headers
        for name in ("Origin", "Sec-Websocket-Origin"):
            if headers.get(name, f"http://{self.request.host}") != f"http://{self.request.host}":
                raise tornado.web.HTTPError(403)


class _Page(_SameOrigin):
    """The page of the scene."""

    def get(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.finish(self.scene.to_live_html())


class _Viewer(_SameOrigin):
    """meshcat's viewer, sent from memory: a file would need a free descriptor."""

    def get(self) -> None:
        self.set_header("Content-Type", "text/javascript; charset=utf-8")
        self.finish(viewer_script())


class _Listener(socket.socket):
    """A listening socket that closes new connections if the process has no free descriptor.

    Otherwise the event loop would report the same connection again and again.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401 - as the socket's
        super().__init__(*args, **kwargs)
        self._spare = os.open(os.devnull, os.O_RDONLY)

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection, or close it if no descriptor is free."""
        try:
            return super().accept()
        except OSError as e:
            if e.errno not in _EXHAUSTED:
                raise
        self._refuse()
        raise BlockingIOError  # as if there were no connection

    def close(self) -> None:
        """Close the socket and the spare descriptor."""
        self._free_spare()
        super().close()

    def _refuse(self) -> None:
        """Accept a connection with the spare descriptor and close it."""
        self._free_spare()
        with suppress(OSError):
            super().accept()[0].close()
        try:
            self._spare = os.open(os.devnull, os.O_RDONLY)
        except OSError:
            time.sleep(PAUSE)  # another thread has used the descriptor

    def _free_spare(self) -> None:
        if self._spare >= 0:
            os.close(self._spare)
            self._spare = -1


class _Commands(_SameOrigin, tornado.websocket.WebSocketHandler):
    """The commands of the scene: all so far, then each new one."""

    def check_origin(self, origin: str) -> bool:
        """Accept the origin: `prepare` has checked it."""
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
    """A web server that shows a scene; also a context manager.

    Commands that are added later by `scene.visualizer` show at once.

    Args:
        scene: The scene.
        port: Port to listen on; by default the first free one from 7000 on.

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
        self._parent = os.getppid()  # it may end before `wait` is called
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

        def send() -> None:
            for listener in tuple(listeners):
                task = loop.create_task(listener.catch_up())
                tasks.add(task)  # the loop keeps no reference
                task.add_done_callback(tasks.discard)

        tasks: set[asyncio.Task[None]] = set()

        def change() -> None:
            loop.call_soon_threadsafe(send)

        self.scene.listeners.append(change)
        try:
            loop.run_forever()
        finally:
            self.scene.listeners.remove(change)
            server.stop()
            for listener in tuple(listeners):
                listener.close()
            loop.run_until_complete(server.close_all_connections())
            pending = asyncio.all_tasks(loop)
            for task in pending:
                task.cancel()
            loop.run_until_complete(asyncio.gather(*pending, return_exceptions=True))
            loop.close()


def _application(scene: Scene, listeners: set[_Commands]) -> tornado.web.Application:
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
    candidates = [port] if port is not None else range(FIRST_PORT, FIRST_PORT + PORTS_TRIED)
    reason = ""
    for candidate in candidates:
        try:
            server = socket.create_server((ADDRESS, candidate), backlog=128)
            listener = _Listener(fileno=server.detach())
        except OSError as e:
            reason = str(e.strerror)
            continue
        listener.setblocking(False)
        return listener
    if port is not None:
        raise OrthocalError(f"cannot listen on port {port} of {ADDRESS}: {reason}", where="port")
    raise OrthocalError(
        f"no port of {ADDRESS} from {FIRST_PORT} to {FIRST_PORT + PORTS_TRIED - 1} is free",
        where="port",
    )
