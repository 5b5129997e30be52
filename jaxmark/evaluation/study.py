"""Robustness studies over a declared grid of meshes, schemes, payloads, budgets, attacks and seeds."""

from __future__ import annotations  # so that `help` shows the names of type aliases, not their definitions

import hashlib
import json
import math
import os
import pickle
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import product
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from jaxmark.adversaries.by_name import attack_each, get_attack
from jaxmark.attacks import Attack
from jaxmark.attacks.attack import mean_distance
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation._rates import LOG10_LEVEL, Control, Row
from jaxmark.evaluation._robustness import NOTHING, Outcome, compare_with
from jaxmark.evaluation.cells import Cell, Pool, run
from jaxmark.evaluation.study_results import Results
from jaxmark.files import load_mesh
from jaxmark.files.atomic import read_file
from jaxmark.files.typed import parse_toml
from jaxmark.geometry.canonical import geometry_hash
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.blind.scheme import BlindScheme
from jaxmark.watermark.coding.keys import Key, commitment
from jaxmark.watermark.coding.message import DEFAULT_BITS
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.markers import Marker, prepare
from jaxmark.watermark.perception.budget import Budget, BudgetLike
from jaxmark.watermark.schemes.registry import DEFAULT_SCHEME, find_blind, get_nonblind, parameters_of

_SEEDS_PER_CELL = 5  # most seeds of a cell, whose attacks are computed by one call
_MAX_FILE_BYTES = 2**24  # largest size of a TOML file


@dataclass(frozen=True)
class Study:
    """A grid of readings: every mesh with every scheme, payload and budget, after every attack, for each seed.

    From each seed derive a key, a message and the random choices of the attack. Two controls are always read, too: the
    same suspects without a mark, and the marked ones with another key.

    Attributes:
        meshes: files, or meshes, by their names.
        attacks: strengths by name in `ATTACKS`, or attacks of your own by any name, such as
            `{"noise": [0.001, 0.005], "mine": Attack(function, "unit", (0.1,))}`.
        schemes: names, or schemes of your own by any name.
        payloads: sizes of the message, in bits.
        budgets: see `embed`: RMS displacements over the diagonal, names of visibilities, limits by metric, or budgets.
        samples: number of samples of each cell, with the seeds 0, 1, …
        keys: keys of your own, which samples take in turn; by default, each seed gives a key.
    """

    meshes: Mapping[str, str | os.PathLike[str] | Mesh]
    attacks: Mapping[str, Sequence[float] | Attack]
    schemes: Sequence[str] | Mapping[str, str | Scheme | BlindScheme] = (DEFAULT_SCHEME,)
    payloads: Sequence[int] = (DEFAULT_BITS,)
    budgets: Sequence[BudgetLike] = ("hidden",)
    samples: int = 5
    keys: Sequence[bytes] = ()

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            JaxmarkError: if a field has another form than described, an attack, a scheme or a metric does not exist, a
                payload is no positive multiple of 8 bits, or there is nothing to do.
        """
        self._check_forms()
        parts = {"mesh": self.meshes, "attack": self.attacks, "scheme": self._schemes, "budget": self._budgets}
        parts |= {f"strength of {name!r}": strengths for name, (_, strengths) in self._attacks.items()}
        for name, part in {**parts, "payload": self.payloads, "sample": range(self.samples)}.items():
            if not part:
                raise JaxmarkError(f"A study needs at least one {name}.")
        for name, (_, strengths) in self._attacks.items():
            for strength in strengths:
                if not (isinstance(strength, Real) and math.isfinite(strength) and strength >= 0):
                    raise JaxmarkError(f"The strengths of {name!r} are finite and not negative, got {strength!r}.")
        for bits in self.payloads:
            if not isinstance(bits, Integral) or bits < 8 or bits % 8:
                raise JaxmarkError(f"A payload is a positive multiple of 8 bits, got {bits!r}.")

    def _check_forms(self) -> None:
        """Check that fields with names are mappings, and that fields of several values are sequences."""
        examples = {"meshes": '{"bunny": mesh}', "attacks": '{"noise": [0.005]}'}
        for name, example in examples.items():
            if not isinstance(getattr(self, name), Mapping):
                raise JaxmarkError(f"The {name} of a study have names: give them as a mapping, such as {example}.")
        for name, mesh in self.meshes.items():
            if not isinstance(mesh, Mesh | str | os.PathLike):
                raise JaxmarkError(f"The mesh {name!r} of a study is a Mesh or a file, got {type(mesh).__name__}.")
        for name, given in self.attacks.items():
            if callable(given):
                get_attack(given)  # pyright: ignore[reportArgumentType] (refuses a function)
            if isinstance(given, str) or not isinstance(given, Sequence):  # an `Attack` is a tuple
                raise JaxmarkError(
                    f"The strengths of the attack {name!r} are a list, such as [0.001, 0.005], got {given!r}."
                )
        examples = {"schemes": '["keyed", "host"]', "payloads": "[32, 64]", "budgets": '[0.0008, "hidden"]'}
        for name, example in examples.items():
            given = getattr(self, name)
            if isinstance(given, str) or not isinstance(given, Sequence | Mapping):
                raise JaxmarkError(f"The {name} of a study are a list, such as {example}, got {given!r}.")
        for key in self.keys:
            Key(key)
        if not isinstance(self.samples, Integral):
            raise JaxmarkError(f"samples is a whole number, such as 5, got {self.samples!r}.")

    def run(
        self,
        output: str | os.PathLike[str],
        workers: int | Pool = 1,
        log: Callable[[str], None] = lambda line: None,
    ) -> Results:
        """Run the cells that are not finished, and return the results of all cells.

        Args:
            output: file of JSON lines, to which each finished cell is appended. The same study resumes from it, and a
                study with more cells reuses the finished ones. Cells are identified by the content of mesh files and
                the fields of schemes, but an attack of your own is identified by its name only.
            workers: number of processes, where 1 is this process; or a function that makes an executor (see
                `jaxmark.evaluation.cells`). A script that asks for more than one must do so below
                `if __name__ == "__main__":`, because the processes import it.
            log: callback, called with a line about the progress after each cell.

        Raises:
            JaxmarkError: if a mesh cannot be read, or the study cannot be sent to workers. A refused mesh or attack
                does not end a study; the reason is stored in its rows.
        """
        cells = list(dict.fromkeys(self._cells()))
        if isinstance(workers, int):
            if workers < 1:
                raise JaxmarkError(f"A study needs at least one worker, got {workers}.")
            if workers > 1:
                try:
                    pickle.dumps(self)
                except Exception as error:  # pickle raises many types
                    raise JaxmarkError(
                        f"This study cannot be sent to other processes ({error}); define its attacks and schemes in a"
                        " module, or use one worker."
                    ) from None
        try:
            done = run(cells, partial(work, self), workers, output, log, self._name)
        finally:
            _marker.cache_clear()
            _mark.cache_clear()
        distances = {name: _mean_distance(mesh) for name, mesh in self.meshes.items()}
        return Results(tuple(row for cell in done for row in self._rows(cell, distances)))

    @property
    def _given_schemes(self) -> Mapping[str, str | Scheme | BlindScheme]:
        return self.schemes if isinstance(self.schemes, Mapping) else {name: name for name in self.schemes}

    @property
    def _schemes(self) -> dict[str, Scheme | BlindScheme]:
        return {name: find_blind(scheme) or get_nonblind(scheme) for name, scheme in self._given_schemes.items()}

    @property
    def _budgets(self) -> dict[str, Budget]:
        """The budgets by their names in rows: `0.0008`, `hidden`, or `dame=0.008`."""
        return {str(one): one for one in map(Budget.of, self.budgets)}

    @property
    def _attacks(self) -> dict[str, tuple[Attack, Sequence[float]]]:
        """The attacks with their strengths, by their names in rows."""
        attacks = {name: one if isinstance(one, Attack) else get_attack(name) for name, one in self.attacks.items()}
        own = {name: one.strengths if isinstance(one, Attack) else one for name, one in self.attacks.items()}
        return {name: (attacks[name], own[name]) for name in own}

    def _cells(self) -> Iterator[Cell]:
        """All cells; those with the same marked meshes follow each other, so that each mesh is marked once."""
        digests = {name: _digest(mesh) for name, mesh in self.meshes.items()}
        schemes, budgets, count = self._schemes, self._budgets, self.samples
        blocks = [(first, min(_SEEDS_PER_CELL, count - first)) for first in range(0, count, _SEEDS_PER_CELL)]
        for mesh, scheme, bits, budget, block in product(self.meshes, schemes, self.payloads, budgets, blocks):
            # Cells of older files whose readings lack a field are read again.
            fields = [digests[mesh], schemes[scheme].name, parameters_of(schemes[scheme]), Outcome._fields]
            fields += [commitment(key) for key in self.keys]
            digest = hashlib.sha256(json.dumps(fields).encode()).hexdigest()[:16]
            for name, (_, strengths) in self._attacks.items():
                for strength in strengths:
                    yield mesh, scheme, bits, budget, name, float(strength), *block, digest

    def _name(self, cell: Cell) -> str:
        """Name a cell by the fields that vary in this study, such as `noise 0.02, budget 0.0004`."""
        mesh, scheme, bits, budget, attack, strength, *_ = cell
        names = str(mesh), str(scheme), f"{bits} bits", f"budget {budget}"
        parts = self.meshes, self.schemes, self.payloads, self.budgets
        varied = [name for name, part in zip(names, parts, strict=True) if len(part) > 1]
        return ", ".join([f"{attack} {strength:g}", *varied])

    def _rows(self, cell: Mapping[str, Any], distances: Mapping[str, float | None]) -> Iterator[Row]:
        mesh, scheme, bits, budget, attack, strength, *_ = cell["cell"]
        kind, given, distance = self._attacks[attack][0], self._budgets[budget], distances[mesh]
        length = None if distance is None else kind.length(strength, distance)
        budget = given.rms if given == Budget(given.rms) and given.rms is not None else budget
        for one in cell["readings"]:
            detected = one["log10_p"] <= LOG10_LEVEL
            point = mesh, scheme, bits, budget, attack, strength, kind.unit
            yield Row(*point, length=length, detected=detected, **one)


@dataclass(frozen=True)
class _Point:
    """The data that all cells with the same marked meshes share; seeds give keys and messages."""

    cell: Cell  # identifies the point
    mesh: str | os.PathLike[str] | Mesh = field(compare=False)
    scheme: str | Scheme | BlindScheme = field(compare=False)
    bits: int = field(compare=False)
    budget: Budget = field(compare=False)
    keys: Sequence[bytes] = field(compare=False, repr=False)

    def key(self, seed: int, control: Control = "marked") -> Key:
        """Return the key of a seed, or another one for the control that reads with a wrong key."""
        if control == "wrong-key" or not self.keys:
            return Key(_derive(seed + (control == "wrong-key"), "key", 32))
        return Key(self.keys[seed % len(self.keys)])


def work(study: Study, cell: Cell) -> dict[str, Any]:
    """Compute a cell: one attack at one strength for a few seeds; at the top level, so that workers can import it.

    For each seed, the marked suspect is read with its key and with another one, and the unmarked suspect with the key.
    """
    mesh, scheme, bits, budget, name, strength, first, count, digest = cell
    point = _Point(
        (mesh, scheme, bits, budget, digest),
        study.meshes[str(mesh)],
        study._given_schemes[str(scheme)],  # a name stands for any pass band
        int(bits),
        study._budgets[str(budget)],
        study.keys,
    )
    seeds = list(range(int(first), int(first) + int(count)))
    marked = [_mark(point, seed) for seed in seeds]
    meshes = [mesh for mesh, _ in marked] + [_original_mesh(point, seeds[0])] * len(seeds)
    suspects = _attack_meshes(meshes, study._attacks[str(name)][0], float(strength), seeds + seeds)
    readings: list[dict[str, Any]] = []
    for seed, (_, rms), suspect, control in zip(seeds, marked, suspects, suspects[len(seeds) :], strict=False):
        readings += _read(point, suspect, seed, ("marked", "wrong-key"), rms)
        readings += _read(point, control, seed, ("unmarked",), 0.0)
    return {"readings": readings}


def _attack_meshes(meshes: list[Mesh | str], attack: Attack, strength: float, seeds: list[int]) -> list[Mesh | str]:
    """Attack meshes by one call, or one by one if any is refused; a refused mesh is replaced by the reason."""
    there = {place: mesh for place, mesh in enumerate(meshes) if isinstance(mesh, Mesh)}
    if not there:
        return meshes
    try:
        found = attack_each(list(there.values()), attack, strength, seeds=[seeds[place] for place in there])
    except JaxmarkError as error:
        if len(meshes) == 1:
            return [f"Not attacked: {error}"]
        found = [_attack_meshes([mesh], attack, strength, [seeds[place]])[0] for place, mesh in there.items()]
    made = dict(zip(there, found, strict=True))
    return [made.get(place, mesh) for place, mesh in enumerate(meshes)]


def _read(
    point: _Point, suspect: Mesh | str, seed: int, controls: Sequence[Control], rms: float
) -> Iterator[dict[str, Any]]:
    """Read a suspect with several keys, aligned once."""
    refusal, registered = suspect if isinstance(suspect, str) else "", None
    for control in controls:
        start, outcome = time.perf_counter(), NOTHING
        if not refusal and not isinstance(suspect, str):
            try:
                marker = _marker(point, point.key(seed, control))
                registered = marker.register(suspect) if registered is None else registered
                outcome = compare_with(_derive(seed, "message", point.bits // 8), marker, marker.read(registered))
            except JaxmarkError as error:
                refusal = str(error)
        said = {"refusal": refusal, "seconds": time.perf_counter() - start}
        yield {"seed": seed, "control": control, **outcome._asdict(), **said, "rms": rms}


@lru_cache(maxsize=_SEEDS_PER_CELL + 1)  # the keys that a cell reads with
def _marker(point: _Point, key: Key) -> Marker:
    mesh = point.mesh if isinstance(point.mesh, Mesh) else load_mesh(point.mesh)
    return prepare(mesh, key, point.bits, point.scheme, adapt_to=point.budget)


@lru_cache(maxsize=_SEEDS_PER_CELL)
def _mark(point: _Point, seed: int) -> tuple[Mesh | str, float]:
    """Mark as strongly as the budget allows, readable or not; return the mesh or the reason of a refusal, and RMS."""
    budget = replace(point.budget, noise=0.0 if point.budget.noise is None else point.budget.noise)
    message = _derive(seed, "message", point.bits // 8)
    try:
        mesh, info = _marker(point, point.key(seed)).embed(message, budget, read_back="never")
    except JaxmarkError as error:
        return f"Not marked: {error}", 0.0
    return mesh, info.rms


def _original_mesh(point: _Point, seed: int) -> Mesh | str:
    try:
        return _marker(point, point.key(seed)).original.mesh
    except JaxmarkError as error:
        return f"Not marked: {error}"


def _mean_distance(mesh: str | os.PathLike[str] | Mesh) -> float | None:
    """Compute the mean distance of a mesh's vertices to their centre, over its diagonal; None for a refused mesh."""
    try:
        return mean_distance(mesh if isinstance(mesh, Mesh) else load_mesh(mesh))
    except JaxmarkError:
        return None


def _derive(seed: int, label: str, size: int) -> bytes:
    return hashlib.shake_256(f"jaxmark/study/{label}/{seed}".encode()).digest(size)


def _digest(mesh: str | os.PathLike[str] | Mesh) -> str:
    """Compute the hexadecimal hash of a file's bytes, or of a mesh's geometry."""
    if isinstance(mesh, Mesh):
        return geometry_hash(mesh).hex()
    try:
        return hashlib.sha256(read_file(mesh)).hexdigest()
    except OSError as error:
        raise JaxmarkError(f"Cannot read {os.fspath(mesh)}: {error.strerror}.") from None


def load_study(path: str | os.PathLike[str]) -> Study:
    """Load a study from a TOML file.

    The tables `meshes` (files, relative to the TOML file's folder) and `attacks` (lists of strengths) are by name.
    `schemes` (names), `payloads`, `budgets` (numbers, names, or tables of limits) and `samples` are as in `Study`, and
    have its defaults.

    Raises:
        JaxmarkError: if the file cannot be read, is not TOML, or declares no study.
    """
    name = os.fspath(path)
    try:
        declared = parse_toml(read_file(path, _MAX_FILE_BYTES))
    except OSError as error:
        raise JaxmarkError(f"Cannot read {name}: {error.strerror}.") from None
    except JaxmarkError as error:
        raise JaxmarkError(f"{name} is no TOML: {error}.") from None
    for part in ("meshes", "attacks"):
        if part not in declared:
            raise JaxmarkError(f"{name} declares no {part}; give a table [{part}].")
    for part, value in declared.items():
        if part not in _FIELDS:
            raise JaxmarkError(f"{name}: a study has no field {part!r}; there are {', '.join(_FIELDS)}.")
        shape, fits = _FIELDS[part]
        if not fits(value):
            raise JaxmarkError(f"{name}: {part} must be {shape}.")
    meshes = {label: Path(path).parent / file for label, file in declared["meshes"].items()}
    try:
        return Study(**{**declared, "meshes": meshes})
    except JaxmarkError as error:
        raise JaxmarkError(f"{name}: {error}") from None
    except OverflowError:
        raise JaxmarkError(f"{name}: one of its numbers is too large.") from None


Test = Callable[[Any], bool]


def _is(*types: type) -> Test:
    return lambda value: isinstance(value, types) and not isinstance(value, bool)


def _list(fits: Test) -> Test:
    return lambda value: isinstance(value, list) and all(map(fits, value))


def _table(fits: Test) -> Test:
    return lambda value: isinstance(value, dict) and all(map(fits, value.values()))


_number, _text = _is(int, float), _is(str)
# The form of each field in a TOML file, in words and as a test.
_FIELDS: dict[str, tuple[str, Test]] = {
    "meshes": ("a table of files", _table(_text)),
    "attacks": ("a table of lists of numbers", _table(_list(_number))),
    "schemes": ("a list of names", _list(_text)),
    "payloads": ("a list of whole numbers of bits", _list(_is(int))),
    "budgets": (
        "a list of numbers, names or tables of limits",
        _list(lambda one: _number(one) or _text(one) or (bool(one) and _table(_number)(one))),
    ),
    "samples": ("a whole number", _is(int)),
}
