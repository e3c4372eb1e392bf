"""The live server is for this machine only, and ends with its process in every case."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import os
import re
import signal
import socket
import subprocess
import sys
import time

import meshcat.geometry as g
import psutil
import pytest
import umsgpack
from conftest import ROOT
from processes import children_of, is_running, until
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

from orthocal import LiveScene, draw_scene
from orthocal.errors import OrthocalError

PATIENCE = 60.0
"""Longest wait for an expected event, [s]."""

VIEW = [sys.executable, "-m", "orthocal", "view", "orthoglide"]


@pytest.fixture(scope="module")
def scene(orthoglide):
    return draw_scene(orthoglide)


FEW_FILES = """
import os, resource, sys
from orthocal import LiveScene, draw_scene, load_robot
live = LiveScene(draw_scene(load_robot("orthoglide")))
opened = len(os.listdir("/proc/self/fd"))
resource.setrlimit(resource.RLIMIT_NOFILE, (opened + 4, opened + 4))
print(live.port, flush=True)
sys.stdin.read()
raise RuntimeError("something else went wrong")
"""
WRONG = "something else went wrong"


def test_server_without_free_descriptors_lets_connections_wait_quietly():
    """Otherwise the event loop reports the same connection as fast as it can. The process ends with
    an exception of its script, and its port is free."""
    with subprocess.Popen(
        [sys.executable, "-c", FEW_FILES],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        port = int(process.stdout.readline())
        clients = [socket.create_connection(("127.0.0.1", port), 20) for _ in range(30)]
        time.sleep(0.3)
        before = sum(psutil.Process(process.pid).cpu_times()[:2])
        time.sleep(1.0)
        assert sum(psutil.Process(process.pid).cpu_times()[:2]) - before < 0.25
        for client in clients:
            client.close()
        time.sleep(0.3)
        assert get(port)[0] == 200
        assert len(get(port, "/main.min.js")[1]) > 100_000
        process.stdin.close()
        lines = process.stderr.read().splitlines()
        assert (lines[0][:9], lines[-1]) == ("Traceback", f"RuntimeError: {WRONG}")
        assert sum(not line.startswith(" ") for line in lines) == 2
    assert process.returncode == 1
    assert_free(port)


def get(port, path="/", host="127.0.0.1", headers=None):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", path, headers={"Host": f"{host}:{port}", **(headers or {})})
    answer = connection.getresponse()
    text = answer.read().decode(errors="replace")
    connection.close()
    return answer.status, text


def is_open(port):
    with socket.socket() as s:
        s.settimeout(5)
        return s.connect_ex(("127.0.0.1", port)) == 0


def assert_free(port):
    """Fail if a port stays open; tests that run at the same time may open it for a moment."""
    until(lambda: not is_open(port), PATIENCE)


def listening(pid):
    """Listening addresses and ports of a process."""
    connections = psutil.Process(pid).net_connections("inet")
    return [tuple(c.laddr) for c in connections if c.status == psutil.CONN_LISTEN]


def start(*arguments, code=None):
    """Start a view in another process; return the process and its port."""
    command = [*VIEW, *arguments] if code is None else [sys.executable, "-c", code]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    )
    line = process.stdout.readline()
    found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\n", line)
    if not found:
        process.kill()
        pytest.fail(f"no address: {line!r} {process.stderr.read()}")
    return process, int(found[1])


async def hang_up(connection):
    connection.close()
    while await connection.read_message() is not None:
        pass


# ---- in this process


def test_page_viewer_and_commands_come_from_the_server(scene):
    with LiveScene(scene) as live:
        status, page = get(live.port)
        assert status == 200
        assert scene.title in page
        assert "main.min.js" in page
        status, script = get(live.port, "/main.min.js")
        assert status == 200
        assert "MeshCat" in script[:400]
        assert get(live.port, "/etc/passwd")[0] == 404
        assert get(live.port, "/../setup.py")[0] == 404
        assert get(live.port, host="localhost")[0] == 200
        assert get(live.port, host="evil.example")[0] == 404  # it resolves to 127.0.0.1
    assert_free(live.port)


@pytest.mark.parametrize("name", ["Origin", "Sec-Websocket-Origin"])
@pytest.mark.parametrize(
    ("origin", "accepted"),
    [
        ("http://127.0.0.1:{port}", True),
        ("https://127.0.0.1:{port}", False),
        ("ftp://127.0.0.1:{port}", False),
        ("http://127.0.0.1:{port}/", False),
        ("http://localhost:{port}", False),
        ("http://127.0.0.1", False),
        ("http://evil.example", False),
        ("null", False),
    ],
)
def test_page_and_commands_are_for_the_same_origin_alone(scene, name, origin, accepted):
    with LiveScene(scene) as live:
        headers = {name: origin.format(port=live.port), "Sec-Fetch-Site": "same-origin"}

        async def first_command():
            request = HTTPRequest(f"ws://127.0.0.1:{live.port}/commands", headers=headers)
            connection = await websocket_connect(request)
            first = await connection.read_message()
            await hang_up(connection)
            return umsgpack.unpackb(first)

        for path in ("/", "/main.min.js"):
            assert get(live.port, path, headers=headers)[0] == (200 if accepted else 403)
        if accepted:
            assert asyncio.run(first_command())["type"] == "delete"
        else:
            with pytest.raises(HTTPClientError, match="403"):
                asyncio.run(first_command())


def test_later_commands_are_sent_at_once(orthoglide):
    scene = draw_scene(orthoglide)
    known = len(scene.commands)

    async def follow(live):
        origin = f"http://127.0.0.1:{live.port}"
        request = HTTPRequest(f"ws://127.0.0.1:{live.port}/commands", headers={"Origin": origin})
        connection = await websocket_connect(request)
        first = [umsgpack.unpackb(await connection.read_message()) for _ in range(known)]
        scene.visualizer["/Mine"].set_object(g.Sphere(0.1))
        later = umsgpack.unpackb(await asyncio.wait_for(connection.read_message(), PATIENCE))
        await hang_up(connection)
        return first, later

    with LiveScene(scene) as live:
        with LiveScene(scene):
            pass  # another view of the same scene does not disturb this one
        first, later = asyncio.run(follow(live))
    assert [c["path"] for c in first] == [c["path"] for c in scene.commands[:known]]
    assert later["path"] == "/Mine"
    scene.visualizer["/Mine"].delete()  # without a listener


def test_other_types_than_a_scene_are_refused(orthoglide):
    with pytest.raises(TypeError, match=r"found a Robot; expected a Scene: draw_scene"):
        LiveScene(orthoglide)


def test_two_views_find_two_ports(scene):
    with LiveScene(scene) as one, LiveScene(scene) as two:
        assert one.port != two.port
        with pytest.raises(OrthocalError, match=f"cannot listen on port {one.port} of 127.0.0.1"):
            LiveScene(scene, port=one.port)
    for port in (one.port, two.port):
        assert_free(port)
    with LiveScene(scene, port=0) as any_free:
        pass
    with LiveScene(scene, port=any_free.port) as again:
        assert again.port == any_free.port


# ---- in another process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_view_ends_cleanly_on_a_signal(number):
    """It has no children, and its port is free afterwards."""
    process, port = start()
    assert listening(process.pid) == [("127.0.0.1", port)]
    assert children_of(process.pid) == []
    assert get(port)[0] == 200
    process.send_signal(number)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    assert errors == "Open this in a browser on this machine; Ctrl-C ends.\n"
    assert_free(port)


BUSY = """
import os, time
from orthocal import LiveScene, draw_scene, load_robot
parent = os.getppid()
with LiveScene(draw_scene(load_robot('orthoglide'))) as live:
    print(live.url, flush=True)
    while os.getppid() == parent:
        time.sleep(0.05)
    live.wait()
"""
"""A view whose parent ends before it waits."""


@pytest.mark.parametrize("view", [VIEW, [sys.executable, "-c", BUSY]], ids=["waiting", "busy"])
def test_view_ends_with_a_killed_parent(view):
    """A view ends if the shell or script that started it is killed."""
    code = (
        "import subprocess, sys\n"
        f"view = subprocess.Popen({view!r}, stdout=subprocess.PIPE, text=True)\n"
        "print(view.stdout.readline(), end='', flush=True)\n"
        "view.wait()\n"
    )
    process, port = start(code=code)
    (child,) = map(int, children_of(process.pid))
    assert listening(child) == [("127.0.0.1", port)]
    process.kill()
    process.wait(PATIENCE)
    process.stdout.close()
    process.stderr.close()
    try:
        until(lambda: not is_running(child), PATIENCE)  # its port may be in use again
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
