"""A local web page that shows a catalogue and finds the originals of uploaded files. Needs the extra `serve`.

The server answers only this machine. It writes nothing unless --keep is given, its answers contain no key, and no name
from a request becomes a path. Two processes with limits of time and memory read uploaded files. Two more files may
wait, and the server rejects others.
"""

import asyncio
import secrets
import socket
import tempfile
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import click

from jaxmark.app.catalogue_commands import CATALOGUE
from jaxmark.app.find_commands import keep
from jaxmark.app.limited import Worker
from jaxmark.app.options import read_key
from jaxmark.app.output import answer, error_text
from jaxmark.app.read_files import FileReader
from jaxmark.catalogue import Catalogue, Finder, Match
from jaxmark.errors import JaxmarkError, require
from jaxmark.files import SUFFIXES
from jaxmark.files.atomic import write_atomically
from jaxmark.files.programs import release_programs
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.evidence import ledger

_PATH = click.Path(path_type=Path)
_HOST = "127.0.0.1"
_WORKERS = 2  # processes that read uploaded files
_MOST_JOBS = 4  # most uploaded files that wait or are being read
_MOST_UPLOADS = 16  # most files that are being uploaded; slow uploads alone cannot keep all others from being read
_MOST_SECONDS, _MOST_MEGABYTES = 120.0, 4096  # for reading one file
_UPLOAD_SECONDS = 120.0
_MOST_DOSSIERS = 16  # most dossiers in memory
_MOST_LISTED = 200  # most originals in one answer
_UPLOADED = tuple(suffix for suffix in SUFFIXES if suffix != ".gltf")  # .gltf files refer to other files
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'; script-src 'self';"
    " connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
# Header that the page sends with an uploaded file. Browsers do not let pages of other sites send it without permission
# of this server, so that their requests are rejected.
_OUR_HEADER = "x-jaxmark"


@click.command(name="serve")
@CATALOGUE
@click.option(
    "--key",
    "key_files",
    type=_PATH,
    multiple=True,
    required=True,
    help="Key file. Repeat the option for several keys.",
)
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8737, show_default=True, help="Port; 0 selects a free one."
)
@click.option(
    "--most-megabytes",
    type=click.IntRange(1, 4096),
    default=64,
    show_default=True,
    help="Largest size of an uploaded file, in megabytes.",
)
@click.option("--keep", "keeps", is_flag=True, help="Store verdicts in the catalogue; otherwise, it is only read.")
def serve_command(
    catalogue_file: Path, key_files: tuple[Path, ...], port: int, most_megabytes: int, keeps: bool
) -> None:
    """Serve a web page that shows the catalogue, and names the original of a mesh file that is dropped on it.

    Only this machine can open the page. Needs the extra `serve`. Writes nothing, except verdicts with --keep. Runs
    until it is interrupted by Ctrl+C.
    """
    uvicorn = require("uvicorn", "serve")
    require("starlette", "serve")
    Catalogue(catalogue_file, read_only=True).close()
    desk = Desk(catalogue_file.resolve(), [read_key(file) for file in key_files], keeps=keeps)
    app = make_app(desk, most_megabytes * 2**20)
    settings = uvicorn.Config(app, host=_HOST, port=port, log_level="warning", server_header=False, access_log=False)
    server = uvicorn.Server(settings)
    try:
        listening = socket.create_server((_HOST, port))
    except OSError as error:
        raise JaxmarkError(f"The port {port} cannot be used: {error.strerror}; give another --port.") from None
    desk.begin()
    with listening as socket_:
        answer(False, {}, f"http://{_HOST}:{socket_.getsockname()[1]}/ shows {catalogue_file}; Ctrl+C ends it")
        server.run(sockets=[socket_])


@dataclass
class Desk:
    """The state of the server: it finds the originals of files in its workers, and keeps the latest dossiers."""

    catalogue: Path
    keys: Sequence[Key]
    keeps: bool = False  # whether verdicts are stored in the catalogue
    dossiers: OrderedDict[str, bytes] = field(default_factory=OrderedDict)
    _workers: SimpleQueue[Worker] = field(default_factory=SimpleQueue)  # those that are not reading a file

    def __post_init__(self) -> None:
        for _ in range(_WORKERS):
            self._workers.put(Worker(_MOST_SECONDS, _MOST_MEGABYTES))

    def begin(self) -> None:
        """Begin the processes of the workers, so that the first files need not wait for them."""
        workers = [self._workers.get() for _ in range(_WORKERS)]
        for worker in workers:
            worker.begin()
            self._workers.put(worker)

    def end(self) -> None:
        """End the processes of the workers that are not reading a file."""
        while not self._workers.empty():
            self._workers.get().end()

    def find(self, data: bytes, suffix: str) -> dict[str, Any]:
        """Find the originals of an uploaded file; wait for a worker if all are reading.

        Raises:
            JaxmarkError: see `Finder` and `Worker`.
        """
        worker = self._workers.get()
        try:
            with tempfile.TemporaryDirectory() as folder:  # here, because nothing of a killed worker deletes it
                suspect = Path(folder) / f"suspect{suffix}"
                suspect.write_bytes(data)
                values, page = worker.run(_find, self.catalogue, tuple(self.keys), self.keeps, suspect)
        finally:
            self._workers.put(worker)
        if page is not None:
            values["dossier"] = secrets.token_urlsafe(16)
            self.dossiers[values["dossier"]] = page
            while len(self.dossiers) > _MOST_DOSSIERS:
                self.dossiers.popitem(last=False)
        return values


@lru_cache(maxsize=1)
def _finder(catalogue: Path, keys: tuple[Key, ...], keeps: bool) -> Finder[Catalogue]:
    return Finder(Catalogue(catalogue, read_only=not keeps), keys)


def _find(catalogue: Path, keys: tuple[Key, ...], keeps: bool, suspect: Path) -> tuple[dict[str, Any], bytes | None]:
    """Find the originals of a file in a worker; returns the verdict as values for JSON, and the page of a dossier.

    The dossier is written into the folder of the file.

    Raises:
        JaxmarkError: see `Finder`.
    """
    finder, page = _finder(catalogue, keys, keeps), None
    verdict = finder.find(suspect)
    if keeps:
        keep(finder.catalogue, Path("uploaded"), verdict)
    values = verdict.as_json()
    for match in verdict.named[:1]:
        values["dossier"] = None
        page = _dossier(finder, suspect, match, verdict.readings, suspect.parent)
    release_programs()
    numbers = {entry.path: entry.id for entry in finder.catalogue.originals()}
    for entry in (values, *values["matches"]):
        if entry["original"] is not None:
            entry["id"], entry["original"] = numbers.get(entry["original"]), Path(entry["original"]).name
    return values, page


def _dossier(finder: Finder[Catalogue], suspect: Path, match: Match, readings: int, folder: Path) -> bytes | None:
    """Make the dossier of a message that was read from a file of one mesh.

    The dossier is charged, like the verdict, for all readings by which the catalogue could have named an original.

    Returns None if no message was read, if the file has several meshes or pieces, or if a dossier cannot be made.
    """
    if not match.message or match.mesh or match.piece:
        return None
    key = next(key for name, key in finder.keys.items() if name == match.key)
    query, record = "SELECT json FROM records WHERE digest = ?", None
    for row in finder.catalogue.database.rows(query, match.record):
        record = folder / "record.json"
        write_atomically(record, row["json"].encode())
    bits = None if record is not None else 4 * len(match.message)
    charge = ledger.ORIGINALS.charge("original", readings)
    reader = FileReader(key, bits, None, diagnoses=False, charges=(charge,))
    with suppress(JaxmarkError):  # without the extra `plot` there is a verdict, but no dossier
        reader.read(suspect, Path(match.original), record, dossier=folder / "dossier")
        return (folder / "dossier" / "dossier.html").read_bytes()
    return None


def make_app(desk: Desk, most_bytes: int) -> Any:
    """Make the ASGI application (Starlette).

    Args:
        desk: the state of the server.
        most_bytes: largest size of an uploaded file, in bytes.

    Raises:
        JaxmarkError: if the extra `serve` is missing.
    """
    require("starlette", "serve")
    from starlette.applications import Starlette
    from starlette.concurrency import run_in_threadpool
    from starlette.middleware import Middleware
    from starlette.middleware.trustedhost import TrustedHostMiddleware
    from starlette.requests import ClientDisconnect, Request
    from starlette.responses import JSONResponse, Response
    from starlette.routing import Route

    uploading = waiting = 0

    def reply(content: bytes, kind: str, status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
        return Response(content, status, {**_HEADERS, **(headers or {})}, kind)

    def respond(values: Any, status: int = 200) -> Response:
        return JSONResponse(values, status, _HEADERS)

    def refuse(sentence: str, status: int) -> Response:
        return respond({"refused": sentence}, status)

    def read(work: Callable[[Catalogue], Response]) -> Response:
        try:
            with Catalogue(desk.catalogue, read_only=True) as catalogue:
                return work(catalogue)
        except JaxmarkError as error:
            return refuse(str(error), 404)

    async def page(request: Request) -> Response:
        return reply(_asset("catalogue.html"), "text/html; charset=utf-8")

    async def script(request: Request) -> Response:
        return reply(_asset("catalogue.js"), "text/javascript; charset=utf-8")

    async def icon(request: Request) -> Response:
        return reply(b"", "image/x-icon", 204)  # browsers ask for it, and report an error if there is no answer

    async def originals(request: Request) -> Response:
        start = request.query_params.get("start", "0")
        first = int(start) if start.isdecimal() and len(start) < 10 else 0
        return await run_in_threadpool(read, lambda catalogue: respond(_listed(catalogue, first)))

    async def thumbnail(request: Request) -> Response:
        text = request.path_params["number"]
        if not (text.isdecimal() and text.isascii() and len(text) < 19):  # a number of SQLite
            return refuse("The catalogue has no original with this number.", 404)
        return await run_in_threadpool(read, lambda catalogue: reply(catalogue.thumbnail(int(text)), "image/png"))

    async def dossier(request: Request) -> Response:
        content = desk.dossiers.get(request.path_params["token"])
        if content is None:
            return refuse("There is no such dossier; drop the file again.", 404)
        return reply(content, "text/html; charset=utf-8")

    async def find(request: Request) -> Response:
        nonlocal uploading, waiting
        if _OUR_HEADER not in request.headers or request.headers.get("sec-fetch-site", "same-origin") != "same-origin":
            return refuse("Files can only be uploaded from the catalogue's page.", 403)
        suffix = Path(request.query_params.get("name", "")).suffix.lower()
        if suffix not in _UPLOADED:
            return refuse(f"This is not a mesh file; drop one of {', '.join(_UPLOADED)}.", 415)
        if uploading >= _MOST_UPLOADS:
            return refuse(f"{_MOST_UPLOADS} files are being uploaded; try again when one is done.", 503)
        uploading += 1
        try:
            async with asyncio.timeout(_UPLOAD_SECONDS):
                data = bytearray()
                async for chunk in request.stream():
                    data += chunk
                    if len(data) > most_bytes:
                        sentence = f"The file is larger than {most_bytes // 2**20} megabytes, the limit of this server."
                        return refuse(sentence, 413)
        except TimeoutError:
            return refuse(f"The upload took longer than {_UPLOAD_SECONDS:g} seconds.", 408)
        except ClientDisconnect:
            return refuse("The browser has closed the connection.", 400)
        finally:
            uploading -= 1
        if waiting >= _MOST_JOBS:
            return refuse(f"{_MOST_JOBS} files are being processed; try again when one is done.", 503)
        waiting += 1
        try:
            return respond(await run_in_threadpool(desk.find, bytes(data), suffix))
        except Exception as error:
            return refuse(error_text(error), 422 if isinstance(error, JaxmarkError) else 500)
        finally:
            waiting -= 1

    return Starlette(
        routes=[
            Route("/", page),
            Route("/catalogue.js", script),
            Route("/favicon.ico", icon),
            Route("/originals", originals),
            Route("/thumbnails/{number:str}", thumbnail),
            Route("/dossiers/{token:str}", dossier),
            Route("/find", find, methods=["POST"]),
        ],
        # Requests under another host name are rejected, so that no other site can reach the page by DNS rebinding.
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=[_HOST, "localhost"])],
    )


def _listed(catalogue: Catalogue, start: int) -> dict[str, Any]:
    """List some originals, as values for JSON."""
    every = catalogue.originals()
    entries = every[start : start + _MOST_LISTED]
    rows = [
        {
            "id": entry.id,
            "name": Path(entry.path).name,
            **{name: getattr(entry, name) for name in ("vertices", "records", "recipients", "added")},
        }
        for entry in entries
    ]
    return {"count": len(every), "start": start, "originals": rows}


def _asset(name: str) -> bytes:
    return resources.files("jaxmark.app").joinpath(name).read_bytes()
