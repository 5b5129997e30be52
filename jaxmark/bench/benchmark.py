"""The runner of the benchmark: every method marks every mesh under the same limits, and is read after every attack."""

from __future__ import annotations  # so that `help` shows the names of type aliases, not their definitions

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

KEYS = 2  # default number of keys for each unmarked suspect; a rate of 1 % needs about a hundred nulls


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
    log: Callable[[str], None] = lambda line: None,
) -> BenchResults:
    """Run the unfinished tasks of a benchmark, and return the results of all tasks. Needs the extra `align`.

    Each sample of a method and mesh has its own key, message and random choices of the attacks. Suspects without the
    method's mark are always read, too: unmarked meshes after every attack, marks of other methods, marks of another
    key, and other meshes.

    Args:
        meshes: files, or meshes by their names.
        output: folder for finished tasks and marked meshes. The same benchmark resumes from it; a benchmark with more
            meshes, methods or attacks reuses the finished tasks.
        methods: names in `jaxmark.bench.method.METHODS`, files that declare a method, or methods.
        tracks: names in `jaxmark.bench.tracks.TRACKS`.
        attacks: attacks of the tracks, by name or by the first words of their names; by default all.
        limits: names of a track's sets of limits; by default all.
        payloads: payloads in bits, for methods that support several.
        samples: number of samples.
        others: files of unmarked meshes that are read as further suspects for each mesh.
        keys: number of keys with which each unmarked suspect is read.
        rate: false-positive rate at which a mark counts as detected.
        workers: number of processes, where 1 is this process; or a function that makes an executor, see
            `jaxmark.evaluation.cells`.
        after: function that the worker calls after each task, such as `jax.clear_caches` in a run of many hours.
        log: callback, called with a line about the progress after each task.

    Raises:
        JaxmarkError: if there is no such method, track or attack, a mesh cannot be read, or libigl is missing. If a
            method or an attack refuses a mesh, only its task ends.
    """
    require("igl", "align")
    if samples < 1 or keys < 1 or not meshes or not methods or any(bits < 1 for bits in payloads):
        raise JaxmarkError(
            "A benchmark needs at least one mesh, method, sample and key for unmarked meshes, and positive payloads."
        )
    if isinstance(workers, int) and workers < 1:
        raise JaxmarkError(f"A benchmark needs at least one worker, got {workers}.")
    if not 0 < rate < 1:
        raise JaxmarkError(f"The false-positive rate must be between 0 and 1, got {rate:g}.")
    tracks, payloads = list(dict.fromkeys(tracks)), list(dict.fromkeys(payloads))
    bench, unrelated = make_bench(output, meshes, methods, after), make_bench(output, others, ()).meshes
    marked, given_methods = bench.meshes, bench.methods
    bench = replace(bench, meshes={**unrelated, **marked})
    loaded = {name: load_method(given, payloads[0]) for name, given in given_methods.items()}
    every = [get_track(track) for track in tracks]
    _check_names("attack", attacks, [name for track in every for name in track.lines])
    _check_names("set of limits", limits, [name for track in every for name in track.limits])
    parts, skipped = {}, {}
    for track in tracks:
        lines = {name: line for name, line in get_track(track).lines.items() if _is_selected(name, attacks)}
        missing = {name: reason for name, line in lines.items() if (reason := line.missing())}
        bounds = {name: bound for name, bound in get_track(track).limits.items() if not limits or name in limits}
        parts[track] = Track(bounds, {name: line for name, line in lines.items() if name not in missing})
        skipped |= {f"{track}, {name}": reason for name, reason in missing.items()}
    for name, reason in skipped.items():
        log(f"skipped: {name}: {reason}")
    if workers == 1:
        # If pymeshlab is imported first in another thread, it corrupts the heap when Python ends.
        for name in sorted({need for part in parts.values() for line in part.lines.values() for need in line.needs}):
            importlib.import_module(name)
    # Samples are the outermost loop, so that an interrupted run has results of every mesh.
    templates = [
        Task(name, payload, track, "", mesh, seed, name, MARK)
        for seed, payload, track, mesh, name in product(range(samples), payloads, tracks, marked, given_methods)
    ]
    marks = [task._replace(limits=limit) for task in templates for limit in parts[task.track].limits]
    suspects = [
        suspect for task in templates for suspect in _suspects(task, parts[task.track], list(given_methods), keys)
    ]
    suspects += [
        task._replace(source=other, attack="none", number=number)
        for task, other, number in product(templates, unrelated, range(keys))
        if task.track == tracks[0] and task.mesh != other
    ]
    rows = []
    for some in (marks, suspects):
        rows += cells.run(
            some, partial(run_task, bench), workers, Path(output) / "cells.jsonl", log, _title, _suspect_of
        )
    return BenchResults(loaded, tuple(rows), skipped, rate)


def _suspects(task: Task, track: Track, methods: Sequence[str], keys: int) -> Iterator[Task]:
    """Yield the suspects of one method, mesh and sample: unmarked, marked, and in the first sample with other marks."""
    for attack, number in product(track.lines, range(keys)):
        yield task._replace(source=UNMARKED, attack=attack, number=number)
    first = list(track.limits)[:1]
    for limits in first:  # the unmarked mesh is also read with the key that marks it
        yield task._replace(limits=limits, source=UNMARKED, attack="none")
    for limits, attack in product(track.limits, track.lines):
        yield task._replace(limits=limits, attack=attack)
    if task.seed == 0:
        for limits, other in product(first, methods):
            if other != task.method:
                yield task._replace(limits=limits, source=other, attack="none")


def _suspect_of(cell: cells.Cell) -> Task:
    """Return the suspect of a cell, which is aligned once for all methods and keys."""
    return Task(*cell).suspect  # pyright: ignore[reportArgumentType] (see `run_task`)


def _title(cell: cells.Cell) -> str:
    task = Task(*cell)  # pyright: ignore[reportArgumentType] (see `run_task`)
    return f"{task.method}, {task.mesh}, {task.limits or task.source}, {task.attack}"


def _is_selected(name: str, selected: Sequence[str]) -> bool:
    """Whether a name is selected by its full name or its first words; without a selection, all names are."""
    return not selected or any(name == entry or name.startswith((f"{entry} ", f"{entry},")) for entry in selected)


def _check_names(kind: str, selected: Sequence[str], every: Sequence[str]) -> None:
    if unknown := [entry for entry in selected if not any(_is_selected(name, [entry]) for name in every)]:
        raise JaxmarkError(f"There is no {kind} {unknown[0]!r}; there are {', '.join(dict.fromkeys(every))}.")
