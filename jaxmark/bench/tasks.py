"""Tasks of the benchmark: make a mark as strong as limits allow, or attack a mesh and read the suspects."""

import hashlib
import io
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxmark.bench.method import Bits, Given, Method, Reading, digest_of, load_method
from jaxmark.bench.strength_search import Fitted, fit
from jaxmark.bench.tracks import OVERWRITTEN, Line, get_track
from jaxmark.distortion import Reference
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation.cells import Cell
from jaxmark.files import load_mesh
from jaxmark.files.atomic import write_atomically
from jaxmark.geometry.canonical import geometry_hash
from jaxmark.geometry.mesh import Mesh

UNMARKED = "unmarked"  # in place of the method whose mark a suspect has
MARK = "mark"  # in place of an attack: the mark itself is made
COSTS = ("mrms", "dame", "msdm2")  # the distortion by an attack, measured against the marked mesh
_OWN, _SECOND = "own", "second"  # keys: of the mark, and of one that is written over it

Meshes = Sequence[str | os.PathLike[str]] | Mapping[str, Mesh]  # files, or meshes by their names


class Task(NamedTuple):
    """A cell of the benchmark: a method reads an attacked mesh, which is marked or not."""

    method: str
    payload: int  # bits of a message that are asked for; a method may have its own number
    track: str
    limits: str  # empty where nothing is marked
    mesh: str
    seed: int  # number of the sample, from which key, message and attacks derive
    source: str  # the method whose mark the suspect has, or `UNMARKED`, or an unmarked mesh in place of this one
    attack: str  # of the track, or `MARK`
    number: int = 0  # of the key, where several that wrote nothing are tried

    @property
    def sample(self) -> tuple[str, int, str, int]:
        """The fields from which the key and the message derive."""
        return self.method, self.payload, self.mesh, self.seed

    @property
    def mark(self) -> "Task":
        """The task that makes the mark of the suspect."""
        return self._replace(method=self.source, attack=MARK)


@dataclass(frozen=True)
class Bench:
    """The meshes and methods of a benchmark, as workers need them."""

    folder: Path  # of marked meshes
    meshes: Mapping[str, Path]
    methods: Mapping[str, Given]
    after: Callable[[], object] | None = None  # called after each task; at the top level of a module

    def file(self, task: Task, copy: int = 0) -> Path:
        """The file of a mesh that a task makes."""
        return self.folder / f"{hashlib.sha256(repr((*task, copy)).encode()).hexdigest()[:24]}.npz"


def make_bench(
    output: str | os.PathLike[str], meshes: Meshes, methods: Sequence[Given], after: Callable[[], object] | None = None
) -> Bench:
    """Name meshes and methods by their contents; meshes that have no file are written to the folder."""
    folder, files = Path(output) / "meshes", {}
    folder.mkdir(parents=True, exist_ok=True)
    if isinstance(meshes, Mapping):
        for name, mesh in meshes.items():
            path = folder / f"{name}-{geometry_hash(mesh).hex()[:8]}.npz"
            if not path.exists():
                _save(path, mesh)
            files[path.stem] = path
    else:
        for given in meshes:
            if not isinstance(given, str | os.PathLike):
                raise JaxmarkError(f"Meshes are files, or a mapping of names to meshes; got {type(given).__name__}.")
            path = Path(given)
            files[f"{path.stem}-{geometry_hash(load_mesh(path)).hex()[:8]}"] = path.resolve()
    return Bench(folder, files, {_name_of(given): given for given in methods}, after)


def _name_of(given: Given) -> str:
    if isinstance(given, Method):
        return given.name
    path = Path(given)
    return f"{path.stem}@{digest_of(path)}" if path.suffix in (".py", ".toml") else str(given)


def run_task(bench: Bench, cell: Cell) -> dict[str, Any]:
    """Run a task; at the top level of a module, so that processes can import it."""
    task = Task(*cell)  # pyright: ignore[reportArgumentType] (a cell's values are those of its fields)
    try:
        return _mark(bench, task) if task.attack == MARK else _attack_and_read(bench, task)
    finally:
        if bench.after is not None:
            bench.after()


def draw(size: int, *place: object) -> bytes:
    """Derive bytes from a place in the benchmark, always the same."""
    return hashlib.shake_256("/".join(("jaxmark/bench", *map(str, place))).encode()).digest(size)


def draw_mark(bits: int, *place: object) -> tuple[bytes, Bits]:
    """Derive a key, and a message of a number of bits."""
    message = np.unpackbits(np.frombuffer(draw(bits, "message", *place), np.uint8))[:bits]
    return draw(32, "key", *place), message.astype(bool)


def _mark(bench: Bench, task: Task) -> dict[str, Any]:
    """Make the mark of a task, and save the mesh."""
    start = time.perf_counter()
    try:
        mesh = load(bench.meshes[task.mesh])
        found = _fit(bench, task, mesh, _OWN)
        _save(bench.file(task), found.mesh)
        row = {"strength": found.strength, "tries": found.tries, "reached": found.reached, "moved": moved(mesh, found)}
    except (Exception, SystemExit) as error:  # a foreign method may raise anything, which ends only its task
        row = {"note": f"Not marked: {_sentence(error)}"}
    return {**row, "seconds": time.perf_counter() - start}


def _fit(bench: Bench, task: Task, mesh: Mesh, name: str) -> Fitted:
    """Mark a mesh as strongly as the limits of a task allow, or the first limits of its track."""
    method, track = load_method(bench.methods[task.method], task.payload), get_track(task.track)
    key, message = draw_mark(method.bits, name, *task.sample)
    return fit(method, mesh, message, key, track.bounds(task.limits or next(iter(track.limits)), mesh))


def moved(mesh: Mesh, found: Fitted) -> Mapping[Any, float | None]:
    """Measure the distortion by a mark."""
    return Reference(mesh).measure(found.mesh, ("rms", *COSTS))


def _attack_and_read(bench: Bench, task: Task) -> dict[str, Any]:
    start = time.perf_counter()
    file = {UNMARKED: bench.meshes[task.mesh], **bench.meshes}.get(task.source, bench.file(task.mark))
    if not file.exists():
        return {"note": "Not marked.", "readings": []}
    original, before = load(bench.meshes[task.mesh]), load(file)
    line = get_track(task.track).lines[task.attack]
    try:
        suspects = _suspects(bench, task, line, before)
    except (Exception, SystemExit) as error:  # also of a foreign method, which writes over its mark
        return {"note": f"Not attacked: {_sentence(error)}", "readings": []}
    seconds, costs, own = time.perf_counter() - start, {}, task.source == task.method
    if own and line.in_place:
        with suppress(JaxmarkError):  # of a suspect without an area
            costs = Reference(before).measure(suspects[0], COSTS)
    readings = [one for copy, suspect in enumerate(suspects) for one in _read(bench, task, original, suspect, copy)]
    return {"attack_seconds": seconds, "seconds": time.perf_counter() - start, "costs": costs, "readings": readings}


def _suspects(bench: Bench, task: Task, line: Line, before: Mesh) -> list[Mesh]:
    """Attack a mesh; an unmarked one is attacked once for all methods."""
    if task.attack == OVERWRITTEN:
        return [_fit(bench, task, before, _SECOND).mesh]
    if task.source != UNMARKED:
        return line.suspects(before, task.seed)
    shared = task._replace(method="", payload=0, limits="", number=0)
    files = [bench.file(shared, copy) for copy in range(line.copies)]
    if not all(file.exists() for file in files):
        for file, suspect in zip(files, line.suspects(before, task.seed), strict=True):
            _save(file, suspect)
    return [load(file) for file in files]


def _read(bench: Bench, task: Task, original: Mesh, suspect: Mesh, copy: int) -> Iterator[dict[str, Any]]:
    """Read a suspect with the keys of a task."""
    # Keys that wrote nothing are used once, so that false positives are independent of each other.
    fresh = "/".join((task.track, task.limits, task.source, task.attack, str(copy), str(task.number)))
    own = task.source == task.method
    names = [_OWN] if task.limits and task.source == UNMARKED else [_OWN, fresh] if own else [fresh]
    method, suspect = load_method(bench.methods[task.method], task.payload), _read_only(suspect)
    message = draw_mark(method.bits, _OWN, *task.sample)[1]
    for name in names:
        start = time.perf_counter()
        row = {"copy": copy, "own": own and name == _OWN}
        try:
            found = method.read(suspect, draw_mark(0, name, *task.sample)[0], None if method.blind else original)
            row |= _compare(found, message)
        except (Exception, SystemExit) as error:  # see `_mark`
            row |= {"read": False, "bit_errors": 0.5, "score": None, "log10_p": None, "note": _sentence(error)}
        yield {**row, "seconds": time.perf_counter() - start}


def _compare(found: Reading, message: Bits) -> dict[str, Any]:
    """Compare a reading with the message, as JSON can hold it: a probability of 0 becomes the least float."""
    guess, errors = found.message, 0.5  # half of the bits are wrong where nothing is guessed
    if guess is not None and len(message):
        if np.shape(guess) != message.shape:
            raise JaxmarkError(f"A reading has {np.size(guess)} bits, but the message {len(message)}.")
        errors = float(np.mean(np.asarray(guess, bool) != message))
    most, score = sys.float_info.max, float(found.score)
    log10_p = None if found.log10_p is None else float(found.log10_p)
    if math.isnan(score) or (log10_p is not None and math.isnan(log10_p)):
        raise JaxmarkError("The reader's score, or its log10_p, is not a number.")
    return {
        "read": bool(len(message)) and errors == 0,
        "bit_errors": errors,
        "score": min(score, most) if score > -math.inf else None,
        "log10_p": None if log10_p is None else min(max(log10_p, -most), 0.0),
    }


def _sentence(error: BaseException) -> str:
    return str(error) if isinstance(error, JaxmarkError) else f"{type(error).__name__}: {error}"


def _save(path: Path, mesh: Mesh) -> None:
    """Write a mesh as arrays, exactly as it is."""
    content = io.BytesIO()
    np.savez_compressed(content, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))
    write_atomically(path, content.getvalue())


def load(path: Path) -> Mesh:
    """Load a mesh from a file of any format, or of arrays; the same arrays each time."""
    status = path.stat()
    return _load(path, (status.st_mtime_ns, status.st_size, status.st_ino))


@lru_cache(maxsize=8)
def _load(path: Path, version: tuple[int, ...]) -> Mesh:
    if path.suffix != ".npz":
        return _read_only(load_mesh(path))
    with np.load(path) as found:
        return _read_only(Mesh(found["vertices"], found["faces"]))


def _read_only(mesh: Mesh) -> Mesh:
    """Make the arrays of a mesh read-only: a method that changed them would change what it is compared with."""
    parts = [np.asarray(part) for part in mesh]
    parts = [part.copy() if part.flags.writeable else part for part in parts]
    for part in parts:
        part.setflags(write=False)
    return Mesh(*parts)
