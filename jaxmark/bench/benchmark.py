"""The benchmark of the field: every method on every mesh, as strong as one set of limits allows, after every attack."""

from __future__ import annotations  # so that `help` shows names of types instead of what they stand for

import importlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

from jaxmark.bench.calibration import RATE
from jaxmark.bench.leagues import get_league
from jaxmark.bench.method import Method
from jaxmark.bench.plugins import Given, digest_of, load_method
from jaxmark.bench.results import BenchResults
from jaxmark.bench.work import MARK, UNMARKED, Bench, Task, keep_mesh, work
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation import cells
from jaxmark.evaluation.cells import Pool, processes
from jaxmark.extras import require
from jaxmark.files import load_mesh
from jaxmark.geometry.canonical import geometry_hash
from jaxmark.geometry.mesh import Mesh

ROWS = "cells.jsonl"
KEYS = 2  # for each unmarked suspect: a hundred nulls give a rate of 1 %


def run(
    meshes: Sequence[str | os.PathLike[str]] | Mapping[str, Mesh],
    output: str | os.PathLike[str],
    *,
    methods: Sequence[Given] = ("keyed",),
    leagues: Sequence[str] = ("smi2010",),
    attacks: Sequence[str] = (),
    limits: Sequence[str] = (),
    payloads: Sequence[int] = (64,),
    seeds: int = 1,
    others: Sequence[str | os.PathLike[str]] = (),
    keys: int = KEYS,
    rate: float = RATE,
    workers: int | Pool = 1,
    after: Callable[[], object] | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> BenchResults:
    """Run what is not finished of a benchmark, and return the results of all. Needs the extra `align`.

    From each seed derive, for each method and mesh, a key, a message and the random choices of the attacks. Suspects
    without the method's mark are always read, too: unmarked meshes after every attack, other methods' marks, marks of
    another key, and other meshes.

    Args:
        meshes: files, or meshes by their names.
        output: folder, in which finished cells and marked meshes are kept; the same benchmark goes on where it was
            ended, and a wider one takes over what both have.
        methods: names in `jaxmark.bench.methods.METHODS`, files that declare a method, or methods.
        leagues: names in `jaxmark.bench.leagues.LEAGUES`.
        attacks: those of a league that are named, or begin with a name that is given; by default all.
        limits: names of a league's sets of limits; by default all.
        payloads: bits of a message, for methods that have a choice.
        seeds: number of seeds.
        others: files of further meshes, which every method reads unmarked, in place of each mesh.
        keys: number of keys that each unmarked suspect is read with.
        rate: of false positives, at which a mark counts as detected.
        workers: number of processes, where 1 is this one, or a function that makes an executor, see
            `jaxmark.evaluation.cells`.
        after: function that is called by the worker after each cell, such as `jax.clear_caches` in a run of many hours.
        say: function that is called with a line about the progress after each cell.

    Raises:
        JaxmarkError: if there is no such method, league or attack, a mesh cannot be read, or libigl is missing. What a
            method or an attack refuses ends nothing but its cell.
    """
    require("igl", "align")
    if seeds < 1 or keys < 1 or not meshes or not methods or any(bits < 1 for bits in payloads):
        raise JaxmarkError(
            "A benchmark needs a mesh, a method, a seed, a key for unmarked meshes, and positive payloads."
        )
    if isinstance(workers, int) and workers < 1:
        raise JaxmarkError(f"A benchmark needs a worker, got {workers}.")
    if not 0 < rate < 1:
        raise JaxmarkError(f"The rate of false positives is between 0 and 1, got {rate:g}.")
    folder = Path(output)
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    leagues, payloads = list(dict.fromkeys(leagues)), list(dict.fromkeys(payloads))
    named = {name_of(given): given for given in methods}
    marked = named_files(meshes, folder / "meshes")
    unrelated = named_files(others, folder / "meshes")
    bench = Bench(folder / "meshes", {**unrelated, **marked}, named, after)
    made = {name: load_method(given, payloads[0]) for name, given in named.items()}
    _check_names("attack", attacks, [name for league in leagues for name in get_league(league).lines])
    _check_names("set of limits", limits, [name for league in leagues for name in get_league(league).limits])
    plans = {league: _plan(league, attacks, limits) for league in leagues}
    skipped = {f"{league}, {name}": why for league, plan in plans.items() for name, why in plan.skipped.items()}
    for name, why in skipped.items():
        say(f"skipped: {name}: {why}")
    if workers == 1:
        # First imported in another thread, pymeshlab destroys the heap when Python ends.
        for name in sorted({need for plan in plans.values() for need in plan.needs}):
            importlib.import_module(name)
    if isinstance(workers, int):
        workers = processes(workers) if workers > 1 else partial(ThreadPoolExecutor, 1)
    # Seed by seed, so that a run that is ended has some of every mesh.
    whole = [
        Task(name, payload, league, "", mesh, seed, name, MARK)
        for seed, payload, league, mesh, name in product(range(seeds), payloads, leagues, marked, named)
    ]
    marks = [task._replace(limits=one) for task in whole for one in plans[task.league].limits]
    suspects = [one for task in whole for one in _suspects(task, plans[task.league], list(named), keys)]
    suspects += [
        task._replace(source=other, attack="none", number=number)
        for task, other, number in product(whole, unrelated, range(keys))
        if task.league == leagues[0] and task.mesh != other
    ]
    rows = []
    for part in (marks, suspects):
        rows += cells.run(part, partial(work, bench), workers, folder / ROWS, say, _told)
    return BenchResults(made, tuple(rows), skipped, rate)


def _suspects(task: Task, plan: _Plan, methods: Sequence[str], keys: int) -> Iterator[Task]:
    """What one method reads of one mesh in one seed: it unmarked and marked, and in the first seed others' marks."""
    for attack, number in product(plan.attacks, range(keys)):
        yield task._replace(source=UNMARKED, attack=attack, number=number)
    for limits in plan.limits[:1]:  # and with the key that is used to mark it
        yield task._replace(limits=limits, source=UNMARKED, attack="none")
    for limits, attack in product(plan.limits, plan.attacks):
        yield task._replace(limits=limits, attack=attack)
    if task.seed == 0 and plan.limits:
        for other in methods:
            if other != task.method:
                yield task._replace(limits=plan.limits[0], source=other, attack="none")


def _told(cell: cells.Cell) -> str:
    task = Task(*cell)  # pyright: ignore[reportArgumentType] (see `work`)
    return f"{task.method}, {task.mesh}, {task.limits or task.source}, {task.attack}"


def name_of(given: Given) -> str:
    """What a method is called in cells: a file's by its content, too."""
    if isinstance(given, Method):
        return given.name
    path = Path(given)
    return f"{path.stem}@{digest_of(path)}" if path.suffix in (".py", ".toml") else str(given)


def named_files(meshes: Sequence[str | os.PathLike[str]] | Mapping[str, Mesh], folder: Path) -> dict[str, Path]:
    """The files of meshes by names that tell their content; meshes that have none get one."""
    found: dict[str, Path] = {}
    if isinstance(meshes, Mapping):
        for name, mesh in meshes.items():
            path = folder / f"{name}-{geometry_hash(mesh).hex()[:8]}.npz"
            if not path.exists():
                keep_mesh(path, mesh)
            found[path.stem] = path
        return found
    for given in meshes:
        if not isinstance(given, str | os.PathLike):
            raise JaxmarkError(f"Meshes are files, or a mapping of names to meshes; got {type(given).__name__}.")
        path = Path(given)
        found[f"{path.stem}-{geometry_hash(load_mesh(path)).hex()[:8]}"] = path.resolve()
    return found


class _Plan(NamedTuple):
    """What of a league is run."""

    attacks: Sequence[str]
    limits: Sequence[str]
    needs: frozenset[str]  # packages
    skipped: Mapping[str, str]  # attacks that need what is not installed, and why


def _plan(league: str, attacks: Sequence[str], limits: Sequence[str]) -> _Plan:
    """What of a league is named; all of it where nothing is."""
    lines, bounds = get_league(league).lines, get_league(league).limits
    wanted = [name for name in lines if not attacks or any(_fits(name, one) for one in attacks)]
    skipped = {name: why for name in wanted if (why := lines[name].missing())}
    there = [name for name in wanted if name not in skipped]
    needs = frozenset(need for name in there for need in lines[name].needs)
    return _Plan(there, [one for one in bounds if not limits or one in limits], needs, skipped)


def _fits(name: str, given: str) -> bool:
    """Whether a name is the one that is given, or begins with its words."""
    return name == given or name.startswith((f"{given} ", f"{given},"))


def _check_names(what: str, given: Sequence[str], every: Sequence[str]) -> None:
    if unknown := [one for one in given if not any(_fits(name, one) for name in every)]:
        raise JaxmarkError(f"There is no {what} {unknown[0]!r}; there are {', '.join(dict.fromkeys(every))}.")
