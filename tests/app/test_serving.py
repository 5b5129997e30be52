"""The page of a catalogue: what it shows, and what it does not do for strangers."""

import http.client
import json
import math
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import jaxmark as jm
from jaxmark.app.serving import Desk, make_app
from jaxmark.watermark.evidence.ledger import rounded_up
from tests.samples import rough_sphere

uvicorn = pytest.importorskip("uvicorn")
pytestmark = pytest.mark.usefixtures("unchecked")
KEY = jm.Key(bytes(range(32)))
OURS = {"x-jaxmark": "find"}


class Slow(Desk):
    """Finds nobody, when it is let."""

    go = threading.Event()
    seen: list[tuple[int, str]]

    def find(self, data: bytes, suffix: str) -> dict[str, Any]:
        self.seen.append((len(data), suffix))
        if data == b"bad":
            raise jm.JaxmarkError("This is no mesh.")
        if data == b"worse":
            raise RuntimeError("not expected")
        self.go.wait(20)
        return {"named": False, "matches": []}


class Server:
    """A server of a catalogue with one original, on a port of its own."""

    def __init__(self, desk: Slow) -> None:
        self.desk = desk
        settings = uvicorn.Config(make_app(desk, 1000), host="127.0.0.1", port=0, log_level="critical")
        self._server, self._socket = uvicorn.Server(settings), settings.bind_socket()
        self._thread = threading.Thread(target=self._server.run, kwargs={"sockets": [self._socket]}, daemon=True)
        self._thread.start()
        while not self._server.started:
            time.sleep(0.01)

    def __call__(self, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, dict[str, str], bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self._socket.getsockname()[1], timeout=30)
        try:
            connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
            found = connection.getresponse()
            return found.status, dict(found.getheaders()), found.read()
        finally:
            connection.close()

    def upload(self, head: bytes) -> socket.socket:
        """Begin an upload of ten bytes, of which the first is sent."""
        connection = socket.create_connection(self._socket.getsockname(), timeout=30)
        connection.sendall(head + b"Content-Length: 10\r\n\r\nx")
        return connection

    def end(self) -> None:
        self._server.should_exit = True
        self._thread.join(10)
        self._socket.close()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    jm.save_mesh(rough_sphere(60), tmp_path / "<b>odd.obj")
    with jm.Catalogue(tmp_path / "shop.db") as catalogue:
        catalogue.add(tmp_path / "<b>odd.obj")
    desk = Slow(tmp_path / "shop.db", [KEY])
    desk.seen = []
    running = Server(desk)
    yield running
    desk.go.set()
    running.end()
    desk.go.clear()


def test_originals_are_shown_without_a_key_or_a_path(server: Server):
    status, headers, page = server("GET", "/")
    assert status == 200
    assert "default-src 'none'" in headers["content-security-policy"]
    assert b"catalogue.js" in page
    listed = server("GET", "/originals")[2]
    assert [one["name"] for one in json.loads(listed)["originals"]] == ["<b>odd.obj"]
    assert server("GET", "/thumbnails/1")[2].startswith(b"\x89PNG")
    for answer in (page, listed, server("GET", "/catalogue.js")[2]):
        assert KEY.hex().encode() not in answer
        assert str(server.desk.catalogue.parent).encode() not in answer


@pytest.mark.parametrize(
    "path",
    [
        "/../../etc/passwd",
        "/thumbnails/..%2f..%2fetc%2fpasswd",
        "/thumbnails/2",
        "/thumbnails/99999999999999999999",
        f"/thumbnails/{'9' * 5000}",
        "/dossiers/..%2f..%2fshop.db",
        "/shop.db",
    ],
)
def test_nothing_else_is_there(server: Server, path: str):
    status, _, answer = server("GET", path)
    assert status == 404
    assert b"Traceback" not in answer


def test_files_are_taken_from_the_page_only_and_up_to_a_size(server: Server):
    server.desk.go.set()
    find = "/find?name=a.obj"
    assert server("POST", find, b"x", host="evil.example", **OURS)[0] == 400
    assert server("POST", find, b"x")[0] == 403
    assert server("POST", find, b"x", sec_fetch_site="cross-site", **OURS)[0] == 403
    assert server("POST", "/find?name=../../a.txt", b"x", **OURS)[0] == 415
    assert server("POST", "/find?name=a.gltf", b"x", **OURS)[0] == 415
    assert server("POST", find, b"x" * 1001, **OURS)[0] == 413
    assert server("GET", find)[0] == 405
    assert server.desk.seen == []
    assert server("POST", "/find?name=../../../etc/A.OBJ", b"x" * 1000, **OURS)[0] == 200
    assert server.desk.seen == [(1000, ".obj")]
    status, _, answer = server("POST", find, b"bad", **OURS)
    assert (status, json.loads(answer)) == (422, {"refused": "This is no mesh."})
    status, _, answer = server("POST", find, b"worse", **OURS)
    assert status == 500
    assert b"Traceback" not in answer


def test_a_fifth_file_is_turned_away(server: Server):
    found: list[int] = []

    def send() -> None:
        found.append(server("POST", "/find?name=a.obj", b"x", **OURS)[0])

    threads = [threading.Thread(target=send) for _ in range(4)]
    for thread in threads:
        thread.start()
    time.sleep(0.5)  # all are there
    assert server("POST", "/find?name=a.obj", b"x", **OURS)[0] == 503
    assert server("GET", "/originals")[0] == 200
    server.desk.go.set()
    for thread in threads:
        thread.join(20)
    assert found == [200] * 4
    assert len(server.desk.seen) == 4


def test_slow_uploads_keep_no_others_waiting(server: Server):
    server.desk.go.set()
    slow = [
        server.upload(b"POST /find?name=a.obj HTTP/1.1\r\nHost: 127.0.0.1\r\nx-jaxmark: find\r\n") for _ in range(8)
    ]
    assert server("POST", "/find?name=a.obj", b"x", **OURS)[0] == 200
    for one in slow:
        one.close()


def test_a_killed_worker_leaves_no_file(tmp_path: Path):
    seen: list[Path] = []

    class Killed:
        """A worker that is killed while it reads a file."""

        def run(self, function: Any, *args: Any) -> Any:
            seen.append(args[-1])
            assert (seen[0].name, seen[0].read_bytes()) == ("suspect.obj", b"v 0 0 0")
            raise jm.JaxmarkError("The file was not read.")

    desk = Desk(tmp_path / "shop.db", [KEY])
    for _ in range(2):
        desk._workers.get()
    desk._workers.put(Killed())  # type: ignore[arg-type]
    with pytest.raises(jm.JaxmarkError, match="not read"):
        desk.find(b"v 0 0 0", ".obj")
    assert not seen[0].parent.exists()
    assert isinstance(desk._workers.get(), Killed), "the next file finds a worker"


@pytest.mark.slow
def test_a_file_that_is_dropped_is_named_with_its_dossier(tmp_path: Path):
    mesh = rough_sphere(900)
    jm.save_mesh(mesh, tmp_path / "model.obj")
    with jm.Catalogue(tmp_path / "shop.db") as catalogue:
        catalogue.add(tmp_path / "model.obj")
    before = (tmp_path / "shop.db").read_bytes()
    marked, _ = jm.embed(mesh, b"8 bytes!", KEY, budget=0.004)
    jm.save_mesh(marked, tmp_path / "suspect.obj")
    desk = Desk(tmp_path / "shop.db", [KEY, jm.Key(bytes(32))])
    found = desk.find((tmp_path / "suspect.obj").read_bytes(), ".obj")
    assert (found["original"], found["id"], found["message"]) == ("model.obj", 1, b"8 bytes!".hex())
    page = desk.dossiers[found["dossier"]].decode()
    assert b"8 bytes!".hex() in page
    assert found["readings"] == 2
    assert f"<sup>{rounded_up(found['log10_p']):.1f}</sup>" in page, (
        "the dossier is charged for the catalogue, as the verdict is"
    )
    assert f"<sup>{rounded_up(found['log10_p'] - math.log10(2)):.1f}</sup>" not in page
    assert KEY.hex() not in str(found)
    assert (tmp_path / "shop.db").read_bytes() == before
    for worker in (desk._workers.get(), desk._workers.get()):
        worker._seconds = 0.5
        desk._workers.put(worker)
    with pytest.raises(jm.JaxmarkError, match=r"more than 0\.5 seconds"):
        desk.find((tmp_path / "suspect.obj").read_bytes(), ".obj")
    desk.end()
