"""Benchmark watermarking methods: each on every mesh, as strong as one set of limits allows, after every attack."""

from __future__ import annotations  # so that `help` shows names of types instead of what they stand for

import importlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

from jaxmark.bench.calibration import RATE
from jaxmark.bench.method import Given, load_method
from jaxmark.bench.readings import BenchResults
from jaxmark.bench.tasks import MARK, UNMARKED, Meshes, Task, make_bench, run_task
from jaxmark.bench.tracks import Track, get_track
from jaxmark.errors import JaxmarkError, require
from jaxmark.evaluation import cells
from jaxmark.evaluation.cells import Pool

KEYS = 2  # for each unmarked suspect: a hundred nulls give a rate of 1 %


def run(
    meshes: Meshes,
    output: str | os.PathLike[str],
    *,
    methods: Sequence[Given] = ("keyed",),
    tracks: Sequence[str] = ("smi2010",),
    attacks: Sequence[str] = (),
    limits: Sequence[str] = (),
    payloads: Sequence[int] = (64,),
    samples: int = 1,
    others: Sequence[str | os.PathLike[str]] = (),
    keys: int = KEYS,
    rate: float = RATE,
    workers: int | Pool = 1,
    after: Callable[[], object] | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> BenchResults:
    """Run what is not finished of a benchmark, and return the results of all. Needs the extra `align`.

    Each sample of a method and mesh has a key, a message and random choices of the attacks of its own. Suspects
    without the method's mark are always read, too: unmarked meshes after every attack, other methods' marks, marks of
    another key, and other meshes.

    Args:
        meshes: files, or meshes by their names.
        output: folder, in which finished tasks and marked meshes are kept; the same benchmark resumes where it was
            ended, and a wider one takes over what both have.
        methods: names in `jaxmark.bench.method.METHODS`, files that declare a method, or methods.
        tracks: names in `jaxmark.bench.tracks.TRACKS`.
        attacks: those of a track that are named, or begin with a name that is given; by default all.
        limits: names of a track's sets of limits; by default all.
        payloads: bits of a message, for methods that have a choice.
        samples: number of samples.
        others: files of further meshes, which every method reads unmarked, in place of each mesh.
        keys: number of keys that each unmarked suspect is read with.
        rate: of false positives, at which a mark counts as detected.
        workers: number of processes, where 1 is this one, or a function that makes an executor, see
            `jaxmark.evaluation.cells`.
        after: function that is called by the worker after each task, such as `jax.clear_caches` in a run of many hours.
        say: function that is called with a line about the progress after each task.

    Raises:
        JaxmarkError: if there is no such method, track or attack, a mesh cannot be read, or libigl is missing. A
            refusal by a method or an attack ends only its task.
    """
    require("igl", "align")
    if samples < 1 or keys < 1 or not meshes or not methods or any(bits < 1 for bits in payloads):
        raise JaxmarkError(
            "A benchmark needs a mesh, a method, a sample, a key for unmarked meshes, and positive payloads."
        )
    if isinstance(workers, int) and workers < 1:
        raise JaxmarkError(f"A benchmark needs a worker, got {workers}.")
    if not 0 < rate < 1:
        raise JaxmarkError(f"The rate of false positives is between 0 and 1, got {rate:g}.")
    tracks, payloads = list(dict.fromkeys(tracks)), list(dict.fromkeys(payloads))
    bench, unrelated = make_bench(output, meshes, methods, after), make_bench(output, others, ()).meshes
    marked, named = bench.meshes, bench.methods
    bench = replace(bench, meshes={**unrelated, **marked})
    made = {name: load_method(given, payloads[0]) for name, given in named.items()}
    every = [get_track(track) for track in tracks]
    _check_names("attack", attacks, [name for track in every for name in track.lines])
    _check_names("set of limits", limits, [name for track in every for name in track.limits])
    parts, skipped = {}, {}
    for track in tracks:
        lines = {name: one for name, one in get_track(track).lines.items() if _is_wanted(name, attacks)}
        missing = {name: why for name, one in lines.items() if (why := one.missing())}
        bounds = {name: one for name, one in get_track(track).limits.items() if not limits or name in limits}
        parts[track] = Track(bounds, {name: one for name, one in lines.items() if name not in missing})
        skipped |= {f"{track}, {name}": why for name, why in missing.items()}
    for name, why in skipped.items():
        say(f"skipped: {name}: {why}")
    if workers == 1:
        # First imported in another thread, pymeshlab destroys the heap when Python ends.
        for name in sorted({need for part in parts.values() for one in part.lines.values() for need in one.needs}):
            importlib.import_module(name)
    # Sample by sample, so that a run that is ended has some of every mesh.
    whole = [
        Task(name, payload, track, "", mesh, seed, name, MARK)
        for seed, payload, track, mesh, name in product(range(samples), payloads, tracks, marked, named)
    ]
    marks = [task._replace(limits=one) for task in whole for one in parts[task.track].limits]
    suspects = [one for task in whole for one in _suspects(task, parts[task.track], list(named), keys)]
    suspects += [
        task._replace(source=other, attack="none", number=number)
        for task, other, number in product(whole, unrelated, range(keys))
        if task.track == tracks[0] and task.mesh != other
    ]
    rows = []
    for some in (marks, suspects):
        rows += cells.run(some, partial(run_task, bench), workers, Path(output) / "cells.jsonl", say, _title)
    return BenchResults(made, tuple(rows), skipped, rate)


def _suspects(task: Task, track: Track, methods: Sequence[str], keys: int) -> Iterator[Task]:
    """Yield the suspects of one method, mesh and sample: unmarked and marked, and in the first sample others' marks."""
    for attack, number in product(track.lines, range(keys)):
        yield task._replace(source=UNMARKED, attack=attack, number=number)
    first = list(track.limits)[:1]
    for limits in first:  # and with the key that is used to mark it
        yield task._replace(limits=limits, source=UNMARKED, attack="none")
    for limits, attack in product(track.limits, track.lines):
        yield task._replace(limits=limits, attack=attack)
    if task.seed == 0:
        for limits, other in product(first, methods):
            if other != task.method:
                yield task._replace(limits=limits, source=other, attack="none")


def _title(cell: cells.Cell) -> str:
    task = Task(*cell)  # pyright: ignore[reportArgumentType] (see `run_task`)
    return f"{task.method}, {task.mesh}, {task.limits or task.source}, {task.attack}"


def _is_wanted(name: str, given: Sequence[str]) -> bool:
    """Whether a name is one of those that are given, or begins with the words of one; all are if none is given."""
    return not given or any(name == one or name.startswith((f"{one} ", f"{one},")) for one in given)


def _check_names(what: str, given: Sequence[str], every: Sequence[str]) -> None:
    if unknown := [one for one in given if not any(_is_wanted(name, [one]) for name in every)]:
        raise JaxmarkError(f"There is no {what} {unknown[0]!r}; there are {', '.join(dict.fromkeys(every))}.")
