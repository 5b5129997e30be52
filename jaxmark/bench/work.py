"""What one cell of the benchmark computes: a mark as strong as limits allow, or a suspect and what is read of it."""

import hashlib
import io
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxmark.bench.fitting import Fitted, fit
from jaxmark.bench.leagues import OVERWRITTEN, Line, get_league
from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.plugins import Given, load_method
from jaxmark.distortion import Reference
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation.cells import Cell
from jaxmark.files import load_mesh
from jaxmark.files.atomic import write_atomically
from jaxmark.geometry.mesh import Mesh

UNMARKED = "unmarked"  # in place of the method whose mark a suspect has
MARK = "mark"  # in place of an attack: the mark itself is made
COSTS = ("mrms", "dame", "msdm2")  # what an attack does to the shape, measured against the marked mesh
_OWN, _SECOND = "own", "second"  # keys: of the mark, and of one that is written over it


class Task(NamedTuple):
    """A cell: a method reads what an attack made of a mesh, which is marked or not."""

    method: str
    payload: int  # bits of a message that are asked for; a method may have its own number
    league: str
    limits: str  # empty where nothing is marked
    mesh: str
    seed: int
    source: str  # whose mark the suspect has, or `UNMARKED`, or another mesh, unmarked, in place of this one
    attack: str  # of the league, or `MARK`
    number: int = 0  # of the key, where several that wrote nothing are tried

    @property
    def mark(self) -> "Task":
        """The cell that makes the mark which the suspect has."""
        return self._replace(method=self.source, attack=MARK)


@dataclass(frozen=True)
class Bench:
    """What workers need to know of a benchmark."""

    folder: Path  # marked meshes are kept in it
    meshes: Mapping[str, Path]
    methods: Mapping[str, Given]
    after: Callable[[], object] | None = None  # called after each cell; at the top level of a module

    def method(self, task: Task) -> Method:
        """The method of a cell."""
        return load_method(self.methods[task.method], task.payload)


def work(bench: Bench, cell: Cell) -> dict[str, Any]:
    """Compute a cell. At the top level, where workers find it."""
    try:
        return _work(bench, cell)
    finally:
        if bench.after is not None:
            bench.after()


def _work(bench: Bench, cell: Cell) -> dict[str, Any]:
    task = Task(*cell)  # pyright: ignore[reportArgumentType] (a cell's values are those of its fields)
    start = time.perf_counter()
    if task.attack == MARK:
        try:
            found = _mark(bench, task)
        except (Exception, SystemExit) as error:  # a stranger's method may raise anything, which ends only its cell
            return {"note": f"Not marked: {_said(error)}", "seconds": time.perf_counter() - start}
        return {**found, "seconds": time.perf_counter() - start}
    before = original = load(bench.meshes[task.mesh])
    if task.source in bench.meshes:
        before = load(bench.meshes[task.source])
    elif task.source != UNMARKED:
        file = _file(bench, task.mark)
        if not file.exists():
            return {"note": "Not marked.", "readings": []}
        before = load(file)
    line = get_league(task.league).lines[task.attack]
    try:
        suspects = _suspects(bench, task, line, before)
    except (Exception, SystemExit) as error:  # also a stranger's, whose method writes over its mark
        return {"note": f"Not attacked: {_said(error)}", "readings": []}
    seconds = time.perf_counter() - start
    own = task.source == task.method
    costs = _costs(before, suspects[0]) if own and line.in_place else {}
    readings = [
        one for copy, suspect in enumerate(suspects) for one in _readings(bench, task, original, suspect, own, copy)
    ]
    spent = time.perf_counter() - start
    return {"attack_seconds": seconds, "seconds": spent, "costs": costs, "readings": readings}


def key_of(task: Task, name: str) -> bytes:
    """The key of that name on a mesh in a seed."""
    return draw((task.method, task.payload, task.mesh, task.seed), f"key/{name}", 32)


def message_of(task: Task, bits: int, name: str = _OWN) -> Bits:
    """The message of a mark, of so many bits, that goes with the key of that name."""
    return to_bits(draw((task.method, task.payload, task.mesh, task.seed), f"message/{name}", bits), bits)


def draw(place: tuple[object, ...], label: str, size: int) -> bytes:
    """Bytes for a purpose in a place of the benchmark, always the same."""
    return hashlib.shake_256("/".join(("jaxmark/bench", label, *map(str, place))).encode()).digest(size)


def to_bits(drawn: bytes, bits: int) -> Bits:
    """The first bits of some bytes."""
    return np.unpackbits(np.frombuffer(drawn, np.uint8))[:bits].astype(bool)


def _mark(bench: Bench, task: Task) -> dict[str, Any]:
    """Make the mark of a cell, and keep the mesh."""
    mesh, method = load(bench.meshes[task.mesh]), bench.method(task)
    found = _fit(method, task, mesh, _OWN)
    keep_mesh(_file(bench, task), found.mesh)
    moved = Reference(mesh).measure(found.mesh, ("rms", *COSTS))
    return {"strength": found.strength, "tries": found.tries, "reached": found.reached, "moved": moved}


def _fit(method: Method, task: Task, mesh: Mesh, name: str) -> Fitted:
    """Mark a mesh with the key of a name as strongly as the limits of a cell allow, or the first of its league."""
    league = get_league(task.league)
    bounds = league.bounds(task.limits or next(iter(league.limits)), mesh)
    return fit(method, mesh, message_of(task, method.bits, name), key_of(task, name), bounds)


def _suspects(bench: Bench, task: Task, line: Line, before: Mesh) -> list[Mesh]:
    """What the attack of a cell makes of a mesh; of an unmarked one it is made once for all methods."""
    if task.attack == OVERWRITTEN:
        return [_fit(bench.method(task), task, before, _SECOND).mesh]
    if task.source != UNMARKED:
        return line.suspects(before, task.seed)
    shared = task._replace(method="", payload=0, limits="", number=0)
    files = [_file(bench, shared, copy) for copy in range(line.copies)]
    if not all(file.exists() for file in files):
        for file, suspect in zip(files, line.suspects(before, task.seed), strict=True):
            keep_mesh(file, suspect)
    return [load(file) for file in files]


def _file(bench: Bench, task: Task, copy: int = 0) -> Path:
    """The file of a mesh that a cell makes."""
    return bench.folder / f"{hashlib.sha256(repr((*task, copy)).encode()).hexdigest()[:24]}.npz"


def keep_mesh(path: Path, mesh: Mesh) -> None:
    """Write a mesh as arrays, exactly as it is."""
    content = io.BytesIO()
    np.savez_compressed(content, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))
    write_atomically(path, content.getvalue())


def load(path: Path) -> Mesh:
    """A mesh of a file of any format, or of `keep_mesh`; the same arrays for whoever asks again."""
    now = path.stat()
    return _loaded(path, (now.st_mtime_ns, now.st_size, now.st_ino))


@lru_cache(maxsize=8)
def _loaded(path: Path, version: tuple[int, ...]) -> Mesh:
    """A mesh of a file, as it is in this version."""
    if path.suffix != ".npz":
        return _kept(load_mesh(path))
    with np.load(path) as found:
        return _kept(Mesh(found["vertices"], found["faces"]))


def _kept(mesh: Mesh) -> Mesh:
    """A mesh whose arrays nobody changes: a method that did would change what it is compared with."""
    parts = [np.asarray(part) for part in mesh]
    parts = [part.copy() if part.flags.writeable else part for part in parts]
    for part in parts:
        part.setflags(write=False)
    return Mesh(*parts)


def _costs(before: Mesh, suspect: Mesh) -> dict[str, float | None]:
    try:
        return {str(name): value for name, value in Reference(before).measure(suspect, COSTS).items()}
    except JaxmarkError:  # a suspect without an area
        return {}


def _readings(
    bench: Bench, task: Task, original: Mesh, suspect: Mesh, own: bool, copy: int
) -> Iterator[dict[str, Any]]:
    """What a suspect is read as with the keys that a cell tries."""
    # Keys that wrote nothing are used once, so that false positives are independent of each other.
    fresh = "/".join((task.league, task.limits, task.source, task.attack, str(copy), str(task.number)))
    names = [_OWN] if task.limits and task.source == UNMARKED else [_OWN, fresh] if own else [fresh]
    method, suspect = bench.method(task), _kept(suspect)
    message = message_of(task, method.bits)
    for name in names:
        start, note = time.perf_counter(), ""
        try:
            found = method.read(suspect, key_of(task, name), None if method.blind else original)
            errors = _errors(found.message, message)
            score, log10_p = _score_of(found)
        except (Exception, SystemExit) as error:  # see `_work`
            errors, score, log10_p, note = 0.5, -math.inf, None, _said(error)
        yield {
            "copy": copy,
            "own": own and name == _OWN,
            "read": bool(method.bits) and errors == 0,
            "bit_errors": errors,
            "score": score if math.isfinite(score) else None,
            "log10_p": log10_p,
            "seconds": time.perf_counter() - start,
            **({"note": note} if note else {}),
        }


def _score_of(found: Reading) -> tuple[float, float | None]:
    """Score and log10 p of a reading, as JSON can hold them: a probability of 0 is the least that there is."""
    score, log10_p = float(found.score), None if found.log10_p is None else float(found.log10_p)
    if math.isnan(score) or (log10_p is not None and math.isnan(log10_p)):
        raise JaxmarkError("The reader's score, or its log10_p, is not a number.")
    most = sys.float_info.max
    return min(score, most), None if log10_p is None else min(max(log10_p, -most), 0.0)


def _errors(said: Bits | None, message: Bits) -> float:
    """Share of wrong bits; 1/2 where nothing is said."""
    if said is None or not len(message):
        return 0.5
    if np.shape(said) != message.shape:
        raise JaxmarkError(f"A reading has {np.size(said)} bits, but the message {len(message)}.")
    return float(np.mean(np.asarray(said, bool) != message))


def _said(error: BaseException) -> str:
    return str(error) if isinstance(error, JaxmarkError) else f"{type(error).__name__}: {error}"
