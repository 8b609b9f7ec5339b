"""Who may ask the server for what."""

import http.client
import json
import socket
import threading
import time
from contextlib import closing

import numpy as np
import pytest

from pipeline.errors import FootageError, SettingsError
from pipeline.output.mesh import Mesh
from pipeline.view.server import ViewServer
from pipeline.view.subjects import MeshSubject

MESH = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))


@pytest.fixture
def server():
    with ViewServer(MeshSubject(MESH, "corner.ply")) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


def answer(server, path, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    host = headers.pop("host", f"127.0.0.1:{server.server_port}")
    connection.request("GET", path, headers={"Host": host, **{k.replace("_", "-"): v for k, v in headers.items()}})
    with closing(connection):
        response = connection.getresponse()
        return response, response.read()


def test_the_page_and_its_frames(server):
    path = f"/{server.token}/"
    response, body = answer(server, path)
    assert response.status == 200
    assert b"script-src &#x27;sha256-" in body
    assert response.headers["Content-Security-Policy"] == "frame-ancestors 'none'"
    assert (response.headers["Cache-Control"], response.headers["Referrer-Policy"]) == ("no-store", "no-referrer")
    _, about = answer(server, path + "about")
    assert json.loads(about)["title"] == "corner.ply"
    _, message = answer(server, path + "frame/0?fields=points&step=1")
    length = int.from_bytes(message[:4], "little")
    head = json.loads(message[4 : 4 + length])
    place = head["arrays"]["points"]
    points = np.frombuffer(message, "<f4", 9, 4 + length + place["offset"]).reshape(place["shape"])
    assert np.array_equal(points, MESH.vertices)
    assert server.address == f"http://127.0.0.1:{server.server_port}{path}"
    assert server.socket.getsockname()[0] == "127.0.0.1"


@pytest.mark.parametrize(
    "headers",
    [
        {"host": "evil.example"},
        {"host": "evil.example:80"},
        {"host": ""},
        {"Origin": "http://evil.example"},
        {"Origin": "http://localhost:1"},
        {"Origin": "null"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
    ],
)
def test_another_page_gets_nothing(server, headers):
    response, body = answer(server, f"/{server.token}/about", **headers)
    assert (response.status, body) == (404, b"")


def test_a_tunnel_ends_at_any_port(server):
    ours = {"host": "localhost:9000", "Origin": "http://localhost:9000", "Sec_Fetch_Site": "same-origin"}
    assert answer(server, f"/{server.token}/about", **ours)[0].status == 200


@pytest.mark.parametrize("path", ["/", "/about", "/x/about", "//about", "/{token}x/about"])
def test_without_the_token_there_is_nothing(server, path):
    assert answer(server, path.format(token=server.token))[0].status == 404


@pytest.mark.parametrize(
    "route", ["frame/x", "frame/0?step=x", "frame/0?step=0", "nothing", "../about", "live?after=0", "frame/0?step=-1"]
)
def test_what_is_no_request_of_the_page_is_a_line(server, route):
    response, body = answer(server, f"/{server.token}/{route}")
    assert response.status == 422
    assert "\n" not in json.loads(body)["error"]


def test_a_port_that_is_taken_is_named(server):
    with pytest.raises(SettingsError, match=f"port {server.server_port} cannot be used .*: give another --port"):
        ViewServer(MeshSubject(MESH, "other"), server.server_port)


def test_a_browser_that_says_nothing_holds_nobody_up(server):
    with socket.create_connection(("127.0.0.1", server.server_port)) as silent:
        silent.sendall(b"GET /")
        assert answer(server, f"/{server.token}/about")[0].status == 200


def test_what_is_not_live_has_no_next_frame():
    begin = time.monotonic()
    with pytest.raises(FootageError, match="is not live"):
        MeshSubject(MESH, "corner.ply").next(0, ["points"], 60.0)
    assert time.monotonic() - begin < 30
