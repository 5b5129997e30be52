"""The field's robustness protocol: python benchmarks/robustness/smi2010.py MESH... --output FOLDER [--methods ...].

Wang, Lavoué, Denis, Baskurt, He, "A benchmark for 3D mesh watermarking", SMI 2010: 64 bits, written as strongly as two
sets of limits allow, and read after each attack, in several trials with keys, messages and attacks of their own. What
reads is the exact message; bit error rates are of the best guess. Each suspect is also read with another trial's key,
and the unmarked mesh goes through the same attacks and readers. One cell for each trial and attack, on any executor;
finished ones are kept in FOLDER, and the same command goes on where it was ended. FOLDER/smi2010.md and .json hold the
tables and all rows. --severity prints how far the attacks themselves move a mesh.
"""

import argparse
import math
import os
import sys
import time
from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import jaxmark as jm
from jaxmark.alignment.alignment import Alignment
from jaxmark.bench.leagues import CROPS, LEAGUES, PROTOCOL
from jaxmark.bench.methods.harmonics import THRESHOLD, HarmonicMark, make_mark
from jaxmark.confidence import clopper_pearson
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation._robustness import NOTHING, read
from jaxmark.evaluation.cells import Cell, processes, run
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.markers import BlindMarker, prepare

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, make_parser
from common.tables import Row, evidence, head, line, save, say
from common.timing import timed

BITS = 64
LIMITS = LEAGUES["smi2010"].limits
LEVEL = 1e-6  # false-positive probability at which jaxmark's schemes detect
SCHEMES = ("keyed", "eigen", "host", "field", "local")
METHODS = {
    "keyed": "jaxmark's default",
    "eigen": "Ohbuchi et al. 2001, 64 valence eigenvectors",
    "host": "Sohn et al., in its working form",
    "field": "read without the original, after any remeshing",
    "local": "read without the original, from any part",
    "harmonics": f"public tool, 20 cotangent eigenvectors, confirmed at a correlation of {THRESHOLD}",
}
UNMARKED, KEYS = -1, 5  # in place of a trial; how many keys the unmarked mesh is read with


@lru_cache(maxsize=8)  # what one trial reads with, and the other keys
def marker(
    method: str, mesh: str, trial: int
) -> tuple[jm.watermark.NonBlindMarker | BlindMarker | HarmonicMark, bytes]:
    """A key on an original, and its message."""
    rng, original = np.random.default_rng([trial, 64]), jm.load_mesh(mesh)
    if method == "harmonics":
        return make_mark(original, [trial, 20]), b""
    return prepare(original, rng.bytes(32), BITS, method), rng.bytes(BITS // 8)


@lru_cache(maxsize=2)
def marked(method: str, limits: str, mesh: str, trial: int) -> tuple[Mesh, Row]:
    """The mesh of one trial, and what was done to it; what does not read back is marked all the same."""
    made, message = marker(method, mesh, trial)
    bounds = LIMITS[limits]
    if isinstance(made, HarmonicMark):
        written, seconds = timed(made.embed, jm.Budget(limits=bounds).bounds(MESH))
    else:
        (written, _), seconds = timed(made.embed, message, limits=bounds, noise=0, read_back=False)
    found = jm.compare(jm.load_mesh(mesh), written, ("rms", "max", "mrms", "msdm", "msdm2", "dame"))._asdict()
    return written, {"seconds": seconds, **{name: value for name, value in found.items() if value is not None}}


def attacked(mesh: Mesh, attack: str, trial: int, crop: int) -> Mesh:
    """A mesh after an attack of the protocol, random in each trial."""
    kind, strength, *_ = PROTOCOL[attack]
    return jm.attack(mesh, kind, strength, seed=CROPS * trial + crop)


def readings(method: str, limits: str, mesh: str, suspect: Mesh, trials: Iterable[int]) -> list[Row]:
    """What a suspect is read as with the keys of several trials, aligned once."""
    rows, aligned, start = [], None, time.perf_counter()
    for trial in trials:
        made, message = marker(method, mesh, trial)
        if isinstance(made, HarmonicMark):
            correlation = made.correlation(suspect, marked(method, limits, mesh, trial)[1]["max"])
            row: Row = {"correlation": correlation, "detected": bool(correlation >= THRESHOLD)}
        else:
            try:
                aligned = made.align(suspect) if aligned is None else aligned
                one, note = read(made, aligned, message), {}
                if isinstance(aligned, Alignment):
                    note = {"method": aligned.method, "residual": aligned.residual}
            except JaxmarkError as error:
                one, note = NOTHING, {"note": str(error)}
            row = {**one._asdict(), **note, "detected": one.log10_p <= math.log10(LEVEL)}
        rows.append({"trial": trial, **row, "seconds": time.perf_counter() - start})
        start = time.perf_counter()
    return rows


def work(cell: Any) -> Row:
    """One attack in one trial, or on the unmarked mesh, read with the keys of several."""
    method, limits, mesh, trial, attack = cell
    try:
        before, info = (jm.load_mesh(mesh), {}) if trial == UNMARKED else marked(method, limits, mesh, trial)
    except JaxmarkError as error:
        return {"note": f"not marked: {error}"}
    start, crops = time.perf_counter(), range(CROPS if attack.startswith("cropping") else 1)
    try:
        suspects = [attacked(before, attack, max(trial, 0), crop) for crop in crops]
    except JaxmarkError as error:
        return {"note": f"attack failed: {error}"}
    seconds = time.perf_counter() - start
    keys = range(KEYS) if trial == UNMARKED else (trial, trial + 1)
    found = [row for suspect in suspects for row in readings(method, limits, mesh, suspect, keys)]
    return {"embedded": info, "attack_seconds": seconds, "readings": found}


def own(row: Row) -> list[Row]:
    """Readings with the key that a mesh was marked with; a mesh that could not be marked or attacked counts as one."""
    mine = [one for one in row.get("readings", []) if one["trial"] == row["cell"][3]]
    return mine or [{**NOTHING._asdict(), "detected": False, "note": row.get("note", "")}]


def results(rows: list[Row], limits: str, methods: list[str]) -> Iterator[str]:
    """A line for each attack, a column for each method."""
    where = ["perceptual", "geometric"].index(limits)
    yield head("attack", *methods, "Cho et al.", "Wang et al.")
    for attack in dict.fromkeys(row["cell"][4] for row in rows):
        cells = []
        for method in methods:
            mine = [
                one
                for row in rows
                if row["cell"][:2] == [method, limits] and row["cell"][3] != UNMARKED and row["cell"][4] == attack
                for one in own(row)
            ]
            if method == "harmonics":
                found = [one.get("correlation", 0.0) for one in mine]
                cells.append(f"{sum(one['detected'] for one in mine)}/{len(mine)}, r {np.median(found):.2f}")
            elif mine:
                errors = np.mean([one["bit_errors"] for one in mine])
                proof = evidence(*(np.median([one[name] for one in mine]) for name in ("log10_p", "log10_p_unfloored")))
                cells.append(f"{sum(one['read'] for one in mine)}/{len(mine)}, BER {errors:.2f}, p {proof}")
            else:
                cells.append("-")
        published = (PROTOCOL[attack].cho, PROTOCOL[attack].wang)
        yield line(attack, *cells, *("-" if one is None else f"{one[where]:.2f}" for one in published))


def controls(rows: list[Row], methods: list[str]) -> Iterator[str]:
    """How often a method detects at its own threshold what is not there."""
    yield head("method", "unmarked, detected", "rate at most (95 %)", "another key, detected", "rate at most (95 %)")
    for method in methods:
        cells = [method]
        for unmarked in (True, False):
            found = [
                one["detected"]
                for row in rows
                if row["cell"][0] == method and (row["cell"][3] == UNMARKED) == unmarked
                for one in row.get("readings", [])
                if one["trial"] != row["cell"][3]
            ]
            most = f"{clopper_pearson(sum(found), len(found), 0.9).high:.2g}" if found else "-"
            cells += [f"{sum(found)}/{len(found)}", most]
        yield line(*cells)


def distortions(rows: list[Row], limits: str) -> Iterator[str]:
    """What the marks themselves do to the meshes, the mean over trials."""
    names = ("rms", "mrms", "msdm", "msdm2", "dame", "seconds")
    yield head("mesh", "method", *names[:-1], "embedding, s", "reading, s (median)")
    mine = [row for row in rows if row["cell"][1] == limits and row["cell"][3] != UNMARKED and row.get("embedded")]
    for mesh, method in dict.fromkeys((row["cell"][2], row["cell"][0]) for row in mine):
        group = [row for row in mine if (row["cell"][2], row["cell"][0]) == (mesh, method)]
        means = [np.mean([row["embedded"][name] for row in group]) for name in names]
        reading = np.median([one["seconds"] for row in group for one in own(row) if "seconds" in one])
        yield line(Path(mesh).name, method, *(f"{x:.3g}" for x in means), f"{reading:.2g}")


def failures(rows: list[Row]) -> Iterator[str]:
    """Every mark of jaxmark's schemes that did not read, and why."""
    for row in rows:
        method, limits, mesh, trial, attack = row["cell"]
        for one in own(row) if trial != UNMARKED and method != "harmonics" else []:
            if not one["read"]:
                why = one.get("note") or f"{one['bit_errors']:.2f} of the bits wrong, log10 p {one['log10_p']:.1f}"
                yield f"- {method}, {limits}, {Path(mesh).name}, trial {trial}, {attack}: {why}"


def report(rows: list[Row], options: argparse.Namespace) -> str:
    """All tables, as Markdown."""
    text = [
        f"{BITS} bits, {options.trials} trials, {len(options.meshes)} meshes. Read: the exact message, so many times.",
        "BER: wrong bits of the best guess, the mean. p: log10 of the false-positive probability, the median, and in",
        "square brackets what it is without its floor at -77, which orders attacks and proves nothing. r: the",
        "correlation, the median. The published methods, `field` and `local` are blind, and read without the original,",
        "which all others have here. The published rates are those of the protocol's result page, for the model Venus.",
        "",
        *(f"- {name}: {METHODS[name]}" for name in options.methods),
    ]
    for limits in options.limits:
        bounds = ", ".join(f"{name} ≤ {value:g}" for name, value in LIMITS[limits].items())
        text += ["", f"## Marks at the {limits} limits: {bounds}", "", *results(rows, limits, options.methods)]
        text += ["", *distortions(rows, limits)]
    text += ["", f"## Controls: log10 p ≤ {math.log10(LEVEL):.0f}, or the tool's own threshold", ""]
    text += [*controls(rows, options.methods), "", "## What did not read", "", *(list(failures(rows)) or ["nothing"])]
    return "\n".join(text) + "\n"


def severity(mesh: Path) -> Iterator[str]:
    """How far attacks move a mesh: percent of the diagonal, and two perceptual metrics."""
    yield head(mesh.name, "RMS, %", "MRMS, %", "FMPD", "MSDM2")
    original = jm.load_mesh(mesh)
    for attack in PROTOCOL:
        if attack.split()[0] not in ("noise", "smoothing", "quantisation", "simplification"):
            continue
        found = jm.compare(original, attacked(original, attack, 0, 0), ("rms", "mrms", "fmpd", "msdm2"))
        far = ["-" if x is None else f"{100 * x:.4f}" for x in (found.rms, found.mrms)]
        yield line(attack, *far, f"{found.fmpd:.3f}", f"{found.msdm2:.3f}")


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--output", type=Path, default=Path("smi2010-output"))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=["keyed"])
    parser.add_argument("--limits", nargs="+", choices=LIMITS, default=list(LIMITS))
    parser.add_argument("--attacks", nargs="+", choices=PROTOCOL, default=list(PROTOCOL), metavar="ATTACK")
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--severity", action="store_true")
    options = parser.parse_args()
    if options.severity:
        for mesh in options.meshes:
            for text in severity(mesh):
                print(text, flush=True)
        return
    options.output.mkdir(parents=True, exist_ok=True)
    # Trial by trial, so that a run that is ended has some of every mesh; the unmarked ones know no limits.
    trials, meshes = [UNMARKED, *range(options.trials)], map(str, options.meshes)
    cells: list[Cell] = [
        (method, limits, mesh, trial, attack)
        for method, trial, limits, mesh, attack in product(
            options.methods, trials, options.limits, meshes, options.attacks
        )
        if trial != UNMARKED or limits == options.limits[0]
    ]

    rows = run(cells, work, processes(options.workers), options.output / "cells.jsonl", say)
    text = report(rows, options)
    save(options.output, "smi2010", text, rows)
    print(text)


if __name__ == "__main__":
    from smi2010 import main  # by its own name, by which workers find its functions

    main()
