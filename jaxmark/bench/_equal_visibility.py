"""Robustness at equal visibility: the strongest noise that each method survives if all marks are equally visible."""

from __future__ import annotations  # so that `help` shows the names of type aliases, not their definitions

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

SHARES = (0.5, 1.0, 2.0)  # visibilities, as multiples of the limits of hidden marks
NOISE = tuple(float(f"{x:.2g}") for x in np.geomspace(1e-5, 0.05, 48))  # half widths over the mean radius
_OTHER_KEYS = 20  # number of other keys whose scores a mark without a message must exceed


def equal_visibility(
    meshes: Meshes,
    output: str | os.PathLike[str],
    *,
    methods: Sequence[Given] = ("keyed",),
    payloads: Sequence[int] = (16, 64),
    shares: Sequence[float] = SHARES,
    samples: int = 1,
    workers: int | Pool = 1,
    log: Callable[[str], None] = lambda line: None,
) -> Table:
    """Find the strongest noise that each method survives, at equal visibility of their marks.

    Two bisections find the strength of each mark and the strongest noise. The visibility is a multiple of the limits of
    hidden marks, see `visibility_of`. A message survives if it is read exactly. A mark without a message survives if
    its score exceeds the scores of twenty other keys.

    Args:
        meshes: files, or meshes by their names.
        output: folder for finished settings, from which a run resumes.
        methods: see `jaxmark.bench.benchmark.run`.
        payloads: payloads in bits, for methods that support several.
        shares: visibilities, as multiples of the limits of hidden marks.
        samples: number of samples, each with its own key, message and noise.
        workers: see `jaxmark.bench.benchmark.run`.
        log: callback, called with a line about the progress after each setting.

    Raises:
        JaxmarkError: if there is no such method, a mesh cannot be read, or a share is not above 0.
    """
    if not shares or any(not share > 0 for share in shares):
        raise JaxmarkError(f"Shares of the limits must be above 0, got {', '.join(map(str, shares))}.")
    bench = make_bench(output, meshes, methods)
    settings = list(product(bench.methods, payloads, shares, bench.meshes, range(samples)))
    rows = cells.run(settings, partial(_work, bench), workers, Path(output) / "equal.jsonl", log)

    def cell(method: str, payload: int, share: float) -> str:
        """Format the median noise that is survived."""
        some = [row for row in rows if tuple(row["cell"][:3]) == (method, payload, share)]
        marked = [row for row in some if "noise" in row]
        if not marked:
            return "not marked"
        noise = np.median([row.get("noise", 0.0) for row in some])
        size = np.median([row["moved"]["rms"] for row in marked])
        return f"{noise:.2g} (RMS {size:.2g}, {len(marked)}/{len(some)} marked)"

    return Table(
        "Equal visibility",
        ["method", "bits", *(f"{share:g} × hidden" for share in shares)],
        [
            [method, str(payload), *(cell(method, payload, share) for share in shares)]
            for method, payload in dict.fromkeys((row["cell"][0], row["cell"][1]) for row in rows)
        ],
        "The strongest noise that a mark survives: half width over the mean radius, median over meshes and seeds. In a"
        " column, all methods mark as strongly as the same multiple of the limits of hidden marks allows.",
    )


def _work(bench: Bench, cell: Any) -> dict[str, Any]:
    """Mark a mesh, and find the strongest noise that the mark survives.

    This function is at the top level of the module, so that worker processes can import it.
    """
    name, payload, share, file, seed = cell
    method, mesh = load_method(bench.methods[name], payload), load(bench.meshes[file])
    key, message = draw_mark(method.bits, *cell)
    limits = {metric: share * limit for metric, limit in get_track("2026").bounds("hidden", mesh).items()}
    try:
        fitted = fit(method, mesh, message, key, limits)
    except Exception as error:  # a method of the user may raise any exception
        return {"note": f"{type(error).__name__}: {error}"}
    original = None if method.blind else mesh

    def is_read(suspect: Mesh) -> bool:
        reading = method.read(suspect, key, original)
        if method.bits:
            return reading.message is not None and bool(np.array_equal(np.asarray(reading.message, bool), message))
        others = (draw(32, f"other/{number}", *cell) for number in range(_OTHER_KEYS))
        return all(reading.score > method.read(suspect, other, original).score for other in others)

    def survives(place: int) -> bool:
        suspect = attack(fitted.mesh, "noise", NOISE[place], seed=seed)
        try:
            return is_read(suspect)
        except Exception:  # see above
            return False

    last = last_within(len(NOISE), survives)
    noise = NOISE[last] if last >= 0 else 0.0
    return {"strength": fitted.strength, "reached": fitted.reached, "moved": moved(mesh, fitted), "noise": noise}
