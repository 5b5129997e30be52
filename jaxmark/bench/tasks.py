"""The tasks of the benchmark: make a mark as strong as the limits allow, or attack a mesh and read the suspects."""

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

UNMARKED = "unmarked"  # value of `Task.source` for a suspect without a mark
MARK = "mark"  # value of `Task.attack` for a task that makes a mark
COSTS = ("mrms", "dame", "msdm2")  # metrics of the distortion by an attack, compared with the marked mesh
_OWN, _SECOND = "own", "second"  # names of keys: of the mark, and of a second mark that overwrites it

Meshes = Sequence[str | os.PathLike[str]] | Mapping[str, Mesh]  # files, or meshes by their names


class Task(NamedTuple):
    """A cell of the benchmark: a method reads an attacked mesh, which is marked or not."""

    method: str
    payload: int  # requested payload in bits; a method may have a fixed payload
    track: str
    limits: str  # name of the set of limits; empty if nothing is marked
    mesh: str
    seed: int  # number of the sample, from which key, message and attacks derive
    source: str  # the method whose mark the suspect has; or `UNMARKED`; or another, unmarked mesh as the suspect
    attack: str  # name of the attack in the track, or `MARK`
    number: int = 0  # number of the key, if an unmarked suspect is read with several keys

    @property
    def sample(self) -> tuple[str, int, str, int]:
        """The fields from which the key and the message derive."""
        return self.method, self.payload, self.mesh, self.seed

    @property
    def own(self) -> bool:
        """Whether the suspect has the mark of the method that reads it."""
        return self.source == self.method

    @property
    def suspect(self) -> "Task":
        """The fields on which the suspect depends; others are empty, so that methods and keys share it."""
        if self.own:
            return self
        if self.source == UNMARKED:
            return self._replace(method="", payload=0, limits="", number=0)
        return self._replace(method="", number=0)

    @property
    def mark(self) -> "Task":
        """The task that makes the mark of the suspect."""
        return self._replace(method=self.source, attack=MARK)


@dataclass(frozen=True)
class Bench:
    """The meshes and methods of a benchmark, as workers need them."""

    folder: Path  # folder of marked meshes
    meshes: Mapping[str, Path]
    methods: Mapping[str, Given]
    after: Callable[[], object] | None = None  # function at the top level of a module, called after each task

    def file(self, task: Task, copy: int = 0) -> Path:
        """Return the path of a mesh that a task makes."""
        return self.folder / f"{hashlib.sha256(repr((*task, copy)).encode()).hexdigest()[:24]}.npz"


def make_bench(
    output: str | os.PathLike[str], meshes: Meshes, methods: Sequence[Given], after: Callable[[], object] | None = None
) -> Bench:
    """Make a `Bench`, with names of meshes and methods that depend on their content; write meshes without a file."""
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
                raise JaxmarkError(
                    f"Meshes must be files, or a mapping of names to meshes; got {type(given).__name__}."
                )
            path = Path(given)
            files[f"{path.stem}-{geometry_hash(load_mesh(path)).hex()[:8]}"] = path.resolve()
    return Bench(folder, files, {_name_of(given): given for given in methods}, after)


def _name_of(given: Given) -> str:
    if isinstance(given, Method):
        return given.name
    path = Path(given)
    return f"{path.stem}@{digest_of(path)}" if path.suffix in (".py", ".toml") else str(given)


def run_task(bench: Bench, cell: Cell) -> dict[str, Any]:
    """Run a task; this function is at the top level of the module, so that worker processes can import it."""
    task = Task(*cell)  # pyright: ignore[reportArgumentType] (the values of a cell have the types of the fields)
    try:
        return _mark(bench, task) if task.attack == MARK else _attack_and_read(bench, task)
    finally:
        if bench.after is not None:
            bench.after()


def draw(size: int, *place: object) -> bytes:
    """Derive bytes from a place in the benchmark; equal places give equal bytes."""
    return hashlib.shake_256("/".join(("jaxmark/bench", *map(str, place))).encode()).digest(size)


def draw_mark(bits: int, *place: object) -> tuple[bytes, Bits]:
    """Derive a key and a message with a number of bits from a place in the benchmark."""
    message = np.unpackbits(np.frombuffer(draw(bits, "message", *place), np.uint8))[:bits]
    return draw(32, "key", *place), message.astype(bool)


def _mark(bench: Bench, task: Task) -> dict[str, Any]:
    """Make the mark of a task, and save the mesh."""
    start = time.perf_counter()
    try:
        mesh = load(bench.meshes[task.mesh])
        mark = _fit(bench, task, mesh, _OWN)
        _save(bench.file(task), mark.mesh)
        row = {"strength": mark.strength, "tries": mark.tries, "reached": mark.reached, "moved": moved(mesh, mark)}
    except (Exception, SystemExit) as error:  # a method of the user may raise any exception, which ends only its task
        row = {"note": f"Not marked: {_sentence(error)}"}
    return {**row, "seconds": time.perf_counter() - start}


def _fit(bench: Bench, task: Task, mesh: Mesh, name: str) -> Fitted:
    """Mark a mesh as strongly as the limits of a task allow; a task without limits uses the first of its track."""
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
    except (Exception, SystemExit) as error:  # also exceptions of a method that overwrites its own mark
        return {"note": f"Not attacked: {_sentence(error)}", "readings": []}
    seconds, costs = time.perf_counter() - start, {}
    if task.own and line.in_place:
        with suppress(JaxmarkError):  # raised for a suspect whose area is 0
            costs = Reference(before).measure(suspects[0], COSTS)
    readings = [
        reading for copy, suspect in enumerate(suspects) for reading in _read(bench, task, original, suspect, copy)
    ]
    return {"attack_seconds": seconds, "seconds": time.perf_counter() - start, "costs": costs, "readings": readings}


def _suspects(bench: Bench, task: Task, line: Line, before: Mesh) -> list[Mesh]:
    """Attack a mesh; what all methods read is attacked once."""
    if task.attack == OVERWRITTEN:
        return [_fit(bench, task, before, _SECOND).mesh]
    if task.own:
        return line.suspects(before, task.seed)
    files = [bench.file(task.suspect, copy) for copy in range(line.copies)]
    if not all(file.exists() for file in files):
        for file, suspect in zip(files, line.suspects(before, task.seed), strict=True):
            _save(file, suspect)
    return [load(file) for file in files]


def _read(bench: Bench, task: Task, original: Mesh, suspect: Mesh, copy: int) -> Iterator[dict[str, Any]]:
    """Read a suspect with the keys of a task."""
    # A key without a mark is used for one reading only, so that false positives are independent of each other.
    fresh = "/".join((task.track, task.limits, task.source, task.attack, str(copy), str(task.number)))
    names = [_OWN] if task.limits and task.source == UNMARKED else [_OWN, fresh] if task.own else [fresh]
    method, suspect = load_method(bench.methods[task.method], task.payload), _read_only(suspect)
    message = draw_mark(method.bits, _OWN, *task.sample)[1]
    for name in names:
        start = time.perf_counter()
        row = {"copy": copy, "own": task.own and name == _OWN}
        try:
            reading = method.read(suspect, draw_mark(0, name, *task.sample)[0], None if method.blind else original)
            row |= _compare(reading, message)
        except (Exception, SystemExit) as error:  # see `_mark`
            row |= {"read": False, "bit_errors": 0.5, "score": None, "log10_p": None, "note": _sentence(error)}
        yield {**row, "seconds": time.perf_counter() - start}


def _compare(reading: Reading, message: Bits) -> dict[str, Any]:
    """Compare a reading with the message; returns JSON values, in which infinite numbers are clipped to finite ones."""
    guess, errors = reading.message, 0.5  # without a guess, half of the bits count as wrong
    if guess is not None and len(message):
        if np.shape(guess) != message.shape:
            raise JaxmarkError(f"A reading has {np.size(guess)} bits, but the message {len(message)}.")
        errors = float(np.mean(np.asarray(guess, bool) != message))
    most, score = sys.float_info.max, float(reading.score)
    log10_p = None if reading.log10_p is None else float(reading.log10_p)
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
    """Load a mesh from a mesh file or a file of arrays; repeated calls return the same arrays from a cache."""
    status = path.stat()
    return _load(path, (status.st_mtime_ns, status.st_size, status.st_ino))


@lru_cache(maxsize=8)
def _load(path: Path, version: tuple[int, ...]) -> Mesh:
    if path.suffix != ".npz":
        return _read_only(load_mesh(path))
    with np.load(path) as arrays:
        return _read_only(Mesh(arrays["vertices"], arrays["faces"]))


def _read_only(mesh: Mesh) -> Mesh:
    """Make the arrays of a mesh read-only, so that a method cannot change the mesh with which it is compared."""
    parts = [np.asarray(part) for part in mesh]
    parts = [part.copy() if part.flags.writeable else part for part in parts]
    for part in parts:
        part.setflags(write=False)
    return Mesh(*parts)
