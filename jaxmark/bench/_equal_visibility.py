"""Payload and strength at equal visibility: the noise that each method survives where all marks are equally visible."""

from __future__ import annotations  # so that `help` shows names of types instead of what they stand for

import os
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from jaxmark.adversaries.by_name import attack
from jaxmark.bench.composed_attacks import last_within
from jaxmark.bench.method import Given, load_method
from jaxmark.bench.strength_search import fit
from jaxmark.bench.tables import Table
from jaxmark.bench.tasks import Bench, Meshes, draw, draw_mark, load, make_bench, moved
from jaxmark.bench.tracks import get_track
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation import cells
from jaxmark.evaluation.cells import Pool
from jaxmark.geometry.mesh import Mesh

SHARES = (0.5, 1.0, 2.0)  # of the limits
NOISE = tuple(float(f"{x:.2g}") for x in np.geomspace(1e-5, 0.05, 48))  # half widths over the mean radius
_OTHER_KEYS = 20  # whose scores a mark without a message must exceed


def equal_visibility(
    meshes: Meshes,
    output: str | os.PathLike[str],
    *,
    methods: Sequence[Given] = ("keyed",),
    payloads: Sequence[int] = (16, 64),
    shares: Sequence[float] = SHARES,
    samples: int = 1,
    workers: int | Pool = 1,
    say: Callable[[str], None] = lambda line: None,
) -> Table:
    """Bring all methods to the same visibility by bisection, and find by another the strongest noise each survives.

    Visibility is a share of the limits of hidden marks, see `visibility_of`. A message survives if it is read exactly;
    a mark without one if its score is above those of twenty other keys.

    Args:
        meshes: files, or meshes by their names.
        output: folder, in which finished settings are kept.
        methods: see `jaxmark.bench.benchmark.run`.
        payloads: bits of a message, for methods that have a choice.
        shares: of the limits.
        samples: number of samples, each with a key, a message and noise of its own.
        workers: see `jaxmark.bench.benchmark.run`.
        say: function that is called with a line about the progress after each setting.

    Raises:
        JaxmarkError: if there is no such method, a mesh cannot be read, or a share is not above 0.
    """
    if not shares or any(not share > 0 for share in shares):
        raise JaxmarkError(f"Shares of the limits are above 0, got {', '.join(map(str, shares))}.")
    bench = make_bench(output, meshes, methods)
    settings = list(product(bench.methods, payloads, shares, bench.meshes, range(samples)))
    rows = cells.run(settings, partial(_work, bench), workers, Path(output) / "equal.jsonl", say)

    def cell(method: str, payload: int, share: float) -> str:
        """Tabulate the median noise that is survived."""
        some = [row for row in rows if tuple(row["cell"][:3]) == (method, payload, share)]
        made = [row for row in some if "noise" in row]
        if not made:
            return "not marked"
        noise = np.median([row.get("noise", 0.0) for row in some])
        size = np.median([row["moved"]["rms"] for row in made])
        return f"{noise:.2g} (RMS {size:.2g}, {len(made)}/{len(some)} marked)"

    return Table(
        "Equal visibility",
        ["method", "bits", *(f"{share:g} × hidden" for share in shares)],
        [
            [method, str(payload), *(cell(method, payload, share) for share in shares)]
            for method, payload in dict.fromkeys((row["cell"][0], row["cell"][1]) for row in rows)
        ],
        "The strongest noise that a mark survives, half width over the mean radius, the median over meshes and seeds;"
        " all methods are as strong as the same share of the limits of what is hidden allows.",
    )


def _work(bench: Bench, cell: Any) -> dict[str, Any]:
    """Mark a mesh, and find what the mark survives; at the top level, so that processes can import it."""
    name, payload, share, file, seed = cell
    method, mesh = load_method(bench.methods[name], payload), load(bench.meshes[file])
    key, message = draw_mark(method.bits, *cell)
    limits = {metric: share * limit for metric, limit in get_track("2026").bounds("hidden", mesh).items()}
    try:
        found = fit(method, mesh, message, key, limits)
    except Exception as error:  # a foreign method may raise anything
        return {"note": f"{type(error).__name__}: {error}"}
    known = None if method.blind else mesh

    def is_read(suspect: Mesh) -> bool:
        reading = method.read(suspect, key, known)
        if method.bits:
            return reading.message is not None and bool(np.array_equal(np.asarray(reading.message, bool), message))
        others = (draw(32, f"other/{number}", *cell) for number in range(_OTHER_KEYS))
        return all(reading.score > method.read(suspect, other, known).score for other in others)

    def survives(place: int) -> bool:
        suspect = attack(found.mesh, "noise", NOISE[place], seed=seed)
        try:
            return is_read(suspect)
        except Exception:  # see above
            return False

    last = last_within(len(NOISE), survives)
    noise = NOISE[last] if last >= 0 else 0.0
    return {"strength": found.strength, "reached": found.reached, "moved": moved(mesh, found), "noise": noise}
