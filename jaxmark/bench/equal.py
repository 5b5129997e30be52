"""Payload and strength at equal visibility: how much noise each method survives where all of them look alike."""

from __future__ import annotations  # so that `help` shows names of types instead of what they stand for

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxmark.adversaries.by_name import attack
from jaxmark.bench.benchmark import name_of, named_files
from jaxmark.bench.fitting import fit
from jaxmark.bench.leagues import get_league
from jaxmark.bench.method import Method
from jaxmark.bench.plugins import Given, load_method
from jaxmark.bench.tables import Table
from jaxmark.bench.work import COSTS, draw, load, to_bits
from jaxmark.distortion import Reference
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation import cells
from jaxmark.evaluation.cells import Cell, Pool, processes
from jaxmark.geometry.mesh import Mesh

SHARES = (0.5, 1.0, 2.0)  # of the limits
NOISE = tuple(float(f"{x:.2g}") for x in np.geomspace(1e-5, 0.05, 48))  # half widths over the mean radius
_OTHERS = 20  # keys above whose scores a mark without a message must stand


class Setting(NamedTuple):
    """A method at one payload and one visibility."""

    method: str
    payload: int
    share: float  # of the limits
    mesh: str
    seed: int


def equal_visibility(
    meshes: Sequence[str | os.PathLike[str]] | Mapping[str, Mesh],
    output: str | os.PathLike[str],
    *,
    methods: Sequence[Given] = ("keyed",),
    payloads: Sequence[int] = (16, 64),
    shares: Sequence[float] = SHARES,
    seeds: int = 1,
    workers: int | Pool = 1,
    say: Callable[[str], None] = lambda line: None,
) -> Table:
    """Bring all methods to the same visibility by bisection, and find by another the strongest noise each survives.

    Visibility is a share of the limits of what is hidden, see `visibility_of`. A message survives if
    it is read exactly; a mark without one if its score is above those of twenty other keys.

    Args:
        meshes: files, or meshes by their names.
        output: folder, in which finished settings are kept.
        methods: see `jaxmark.bench.benchmark.run`.
        payloads: bits of a message, for methods that have a choice.
        shares: of the limits.
        seeds: number of seeds.
        workers: see `jaxmark.bench.benchmark.run`.
        say: function that is called with a line about the progress after each setting.

    Raises:
        JaxmarkError: if there is no such method, a mesh cannot be read, or a share is not above 0.
    """
    if not shares or any(not share > 0 for share in shares):
        raise JaxmarkError(f"Shares of the limits are above 0, got {', '.join(map(str, shares))}.")
    folder = Path(output)
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    files, named = named_files(meshes, folder / "meshes"), {name_of(given): given for given in methods}
    grid = product(named, payloads, shares, files, range(seeds))
    settings: list[Cell] = [Setting(*setting) for setting in grid]
    if isinstance(workers, int):
        workers = processes(workers) if workers > 1 else partial(ThreadPoolExecutor, 1)
    rows = cells.run(settings, partial(_work, files, named), workers, folder / "equal.jsonl", say)
    return _table([(Setting(*row["cell"]), row) for row in rows], shares)


def _work(files: Mapping[str, Path], named: Mapping[str, Given], cell: Cell) -> dict[str, Any]:
    """One setting: the mark, and what it survives. At the top level, where workers find it."""
    setting = Setting(*cell)  # pyright: ignore[reportArgumentType] (a cell's values are those of its fields)
    method, mesh = load_method(named[setting.method], setting.payload), load(files[setting.mesh])
    key, message = draw(setting, "key", 32), to_bits(draw(setting, "message", method.bits), method.bits)
    limits = {name: setting.share * limit for name, limit in get_league("2026").bounds("hidden", mesh).items()}
    try:
        found = fit(method, mesh, message, key, limits)
    except Exception as error:  # a stranger's method may raise anything
        return {"note": f"{type(error).__name__}: {error}"}

    def survives(noise: float) -> bool:
        suspect = attack(found.mesh, "noise", noise, seed=setting.seed)
        try:
            return _is_there(method, suspect, mesh, setting, key, message)
        except Exception:
            return False

    held, lost = -1, len(NOISE)
    while lost - held > 1:
        middle = (held + lost) // 2
        held, lost = (middle, lost) if survives(NOISE[middle]) else (held, middle)
    moved = Reference(mesh).measure(found.mesh, ("rms", *COSTS))
    noise = NOISE[held] if held >= 0 else 0.0
    return {"strength": found.strength, "reached": found.reached, "moved": moved, "noise": noise}


def _is_there(method: Method, suspect: Mesh, original: Mesh, setting: Setting, key: bytes, message: np.ndarray) -> bool:
    known = None if method.blind else original
    found = method.read(suspect, key, known)
    if method.bits:
        return found.message is not None and bool(np.array_equal(np.asarray(found.message, bool), message))
    others = (draw(setting, f"other/{number}", 32) for number in range(_OTHERS))
    return all(found.score > method.read(suspect, other, known).score for other in others)


def _table(rows: Sequence[tuple[Setting, Mapping[str, Any]]], shares: Sequence[float]) -> Table:
    """The noise that half of the meshes and seeds survive, for each method, payload and share."""
    lines = []
    for method, payload in dict.fromkeys((setting.method, setting.payload) for setting, _ in rows):
        line = [method, str(payload)]
        for share in shares:
            some = [row for setting, row in rows if setting[:3] == (method, payload, share)]
            made = [row for row in some if "noise" in row]
            if not made:
                line.append("not marked")
                continue
            noise = np.median([row.get("noise", 0.0) for row in some])
            size = np.median([row["moved"]["rms"] for row in made])
            line.append(f"{noise:.2g} (RMS {size:.2g}, {len(made)}/{len(some)} marked)")
        lines.append(line)
    return Table(
        "Equal visibility",
        ["method", "bits", *(f"{share:g} × hidden" for share in shares)],
        lines,
        "The strongest noise that a mark survives, half width over the mean radius, the median over meshes and seeds;"
        " all methods are as strong as the same share of the limits of what is hidden allows.",
    )
