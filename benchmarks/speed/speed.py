"""Measure time and memory, with other programs on the same work: python benchmarks/speed/speed.py [MESH] [--parts ...].

Meshes are bumpy tori of the given sizes, with every square cut along either diagonal, and vertices row by row or
--shuffled; a MESH replaces the first. Times are medians of --repeat calls after a first one that is not counted, or of
fewer calls if these take over a minute. The parts:

filter     f(Δ)x of three float32 columns, compared with SciPy, PyGSP and torch (extra `peers`; missing libraries are
           named), with the largest difference from our result over the largest value. Traffic counts, once a step, the
           neighbours' indices, the weights if any, two numbers of each vertex, x, the previous term, the next term, and
           the sum read and written; "of a copy" is this traffic per second over that of a pass which reads and writes a
           large array.
gradients  all bands, moments, and the filter with both gradients: time over the plain filter's; and peak memory, each
           in a process of its own, beyond the memory held once the operator is built and the function compiled.
stages     the library's functions from end to end, each in a process of its own: the first call, with its lowering and
           compiling (durations of `jax.monitoring`, without tracing), later calls, and the whole process; the
           eigenvector scheme over the keyed one, in writing and in embedding, which reads the mark again; and dense
           decompositions.
scaling    exponents of vertices and degree, by least squares on logarithms, without compiling.
memory     only on request: peak resident memory and time of stages in processes of their own, by default at 0.1, 1 and
           4 million vertices.

On an accelerator the filter runs there, by default at 1 and 10 million vertices. --output FILE.json also draws
FILE.png, with the extra `plot`.
"""

import json
import os
import platform
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxmark as jm
from jaxmark.alignment.original import Original, make_original
from jaxmark.errors import require
from jaxmark.spectral import kernels
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.chebyshev import band_components, filter, moments
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import Laplacian, sparse_matrices
from jaxmark.spectral.recurrence import filter_scan
from jaxmark.watermark.schemes.keyed import KeyedScheme

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import json_file, load, make_parser
from common.filters import DEGREE, TOLERANCE, bumpy_torus, coefficients, exponent, graph, reordered, shifted
from common.marks import BUDGET, KEY, MESSAGE
from common.peers import PEERS, installed
from common.stages import FILTERS, WHOLE, apart, with_gradients
from common.tables import Row, save_json, say, table
from common.timing import Call, median_time

SIZES, ON_ACCELERATOR = (35_000, 100_000, 300_000, 1_000_000), (1_000_000, 10_000_000)
FOR_MEMORY = (100_000, 1_000_000, 4_000_000)
DENSE = (500, 1000, 2000)
DEGREES, BANDS = (16, 32, 64, 128), (32, 128)  # of the filter; of the scheme, beside the usual 64
COPIED = 2**26  # numbers
OURS, WITHOUT_KERNELS = "jaxmark filter", "without kernels"
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # of Okabe and Ito


class Bench(NamedTuple):
    """What the parts share."""

    sizes: Sequence[int]
    mesh: Callable[[int], jm.Mesh]  # of each size, by its index
    original: Callable[[int], Original]  # the same, prepared
    repeat: int
    alone: bool  # without the peers

    def time(self, function: Callable[..., Any], *inputs: Any) -> float:
        """Median seconds of a function, compiled."""
        run = jax.jit(function)
        return median_time(lambda: run(*inputs), self.repeat)


def filters(bench: Bench) -> Iterator[Row]:
    c = coefficients(DEGREE)
    for index in range(len(bench.sizes)):
        operator, x = graph(bench.original(index))
        ours, seconds = np.asarray(filter(operator, c, x)), bench.time(filter, operator, c, x)
        moved = traffic(operator, x)
        row = {"vertices": len(x), "edges": len(operator.edges), "program": OURS, "s": seconds, "times ours": 1.0}
        rate = DEGREE * moved / seconds
        yield row | {"bytes a step": moved, "GB/s": rate / 1e9, "of a copy": rate / copying()}
        if kernels.installed():
            scanned, theirs = bench.time(filter_scan, operator, c, x), np.asarray(filter_scan(operator, c, x))
            yield compared(row, WITHOUT_KERNELS, scanned, theirs, ours)
        if bench.alone:
            continue
        matrix = shifted(operator)
        for name, peer in PEERS.items():
            try:
                run = peer(matrix, c, np.asarray(x))
            except jm.JaxmarkError as missing:
                yield {"vertices": len(x), "program": name, "note": str(missing)}
                continue
            seconds_there = median_time(run, bench.repeat)
            theirs: Any = run()
            theirs = np.asarray(theirs.cpu() if hasattr(theirs, "cpu") else theirs)
            yield compared(row, name, seconds_there, theirs, ours)


def compared(ours: Row, program: str, seconds: float, found: np.ndarray, result: np.ndarray) -> Row:
    """The row of another program on the same work."""
    difference = float(np.abs(found - result).max() / np.abs(result).max())
    same = {key: ours[key] for key in ("vertices", "edges")} | {"program": program, "s": seconds}
    return same | {"times ours": seconds / ours["s"], "difference": difference}


def traffic(operator: Laplacian, x: Any) -> int:
    """Bytes of the arrays that a step of the filter reads and writes, each counted once."""
    table = operator.neighbours
    places = 2 * len(operator.edges) if table is None else np.size(table.vertices) + np.size(table.rest) // 3
    weighing = 0 if operator.weights is None else x.itemsize
    return places * (4 + weighing) + 2 * len(x) * x.itemsize + 5 * x.nbytes


def gradients(bench: Bench) -> Iterator[Row]:
    c, bands = coefficients(DEGREE), scaling(DEGREE, damping="jackson").astype(np.float32)
    timed: dict[str, tuple[Callable[..., Any], Any]] = {
        OURS: (filter, c),
        "with both gradients": (with_gradients, c),
        f"moments, of {DEGREE} products": (lambda operator, _, x: moments(operator, x, degree=DEGREE), c),
        f"band_components, {len(bands)} bands": (band_components, bands),
    }
    for index in range(len(bench.sizes)):
        operator, x = graph(bench.original(index))
        plain = 0.0
        for name, (function, numbers) in list(timed.items())[: 4 if index == 0 else 2]:
            seconds = bench.time(function, operator, numbers, x)
            plain = plain or seconds
            yield {"vertices": len(x), "what": name, "s": seconds, "times the filter": seconds / plain}
    rows = list(apart(bench.mesh(len(bench.sizes) - 1), FILTERS))
    beyond = [row["peak, GB"] - row["held, GB"] for row in rows]
    for name, row, value in zip(timed, rows, beyond, strict=False):
        ratio = value / beyond[0]
        yield {"vertices": row["vertices"], "what": f"{name}, memory", "GB": value, "times the filter": ratio}


def stages(bench: Bench) -> Iterator[Row]:
    rows = list(apart(bench.mesh(0), list(WHOLE), bench.repeat))
    yield from rows
    found = {row["stage"]: row for row in rows}
    for stage in ("write", "embed"):
        keyed, eigen = found[stage], found[f"{stage}, eigenvectors"]
        times = [key for key in ("first call, s", "later calls, s", "process, s") if key in keyed and key in eigen]
        ratios = {key: eigen[key] / keyed[key] for key in times}
        yield {"vertices": keyed["vertices"], "stage": f"{stage}, eigenvectors over keyed"} | ratios
    sizes: list[int] = []
    seconds: list[float] = []
    for size in DENSE:
        stiffness, mass = sparse_matrices(from_mesh(bumpy_torus(size)))
        root = 1 / np.sqrt(mass.diagonal())
        dense = root[:, None] * stiffness.toarray() * root
        sizes.append(len(dense))
        seconds.append(median_time(partial(np.linalg.eigh, dense), bench.repeat))
        yield {"vertices": len(dense), "stage": "all eigenvectors, dense eigh", "later calls, s": seconds[-1]}
    yield {"stage": "dense eigh", "exponent of vertices": exponent(sizes, seconds)}


def exponents(bench: Bench) -> Iterator[Row]:
    def row(what: str, of: str, places: list[int], seconds: list[float]) -> Row:
        points = {"from": places[0], "to": places[-1], "s": seconds[0], "s at the end": seconds[-1]}
        return {"what": what, "exponent of": of, "exponent": exponent(places, seconds)} | points

    everything = [graph(bench.original(index)) for index in range(len(bench.sizes))]
    sizes = [len(x) for _, x in everything]
    c = coefficients(DEGREE)
    if len(sizes) > 1:
        yield row(OURS, "vertices", sizes, [bench.time(filter, operator, c, x) for operator, x in everything])
    operator, x = everything[min(1, len(sizes) - 1)]
    by_degree = [bench.time(filter, operator, coefficients(degree), x) for degree in DEGREES]
    yield row(OURS, "degree", list(DEGREES), by_degree)
    # Smaller ones, since each is compiled anew.
    small, usual = [bumpy_torus(bench.sizes[0] // part) for part in (4, 2, 1)], KeyedScheme()
    sizes, by_size = [len(mesh.vertices) for mesh in small], [both(mesh, usual) for mesh in small]
    few, many = (both(small[0], replace(usual, bands=bands)) for bands in BANDS)
    degrees = [BANDS[0] - 1, usual.bands - 1, BANDS[1] - 1]
    for what in ("embed", "detect"):
        yield row(what, "vertices", sizes, [one[what] for one in by_size])
        yield row(what, "degree", degrees, [one[what] for one in (few, by_size[0], many)])


def both(mesh: jm.Mesh, scheme: KeyedScheme) -> dict[str, float]:
    """Seconds to embed and to detect, compiled."""
    marked, _ = jm.embed(mesh, MESSAGE, KEY, budget=BUDGET, scheme=scheme)
    calls: dict[str, Call] = {
        "embed": partial(jm.embed, mesh, MESSAGE, KEY, budget=BUDGET, scheme=scheme),
        "detect": partial(jm.detect, marked, original=mesh, key=KEY, scheme=scheme),
    }
    return {name: median_time(call, 1) for name, call in calls.items()}


def memory(bench: Bench) -> Iterator[Row]:
    for index in range(len(bench.sizes)):
        yield from apart(bench.mesh(index), ["load", "prepare", "embed", "detect", *FILTERS])


PARTS: Mapping[str, Callable[[Bench], Iterator[Row]]] = {
    "filter": filters,
    "gradients": gradients,
    "stages": stages,
    "scaling": exponents,
    "memory": memory,
}


def copying() -> float:
    """Bytes a second, read and written, at which JAX's device passes over a large array."""
    # Many times in one program, so that no fresh memory is asked for.
    x, times = jnp.ones(COPIED, jnp.float32), 16
    copies = jax.jit(lambda x: jax.lax.fori_loop(0, times, lambda _, x: x + 1, x))
    return times * 2 * x.nbytes / median_time(lambda: copies(x), 3)


def machine() -> Row:
    """What this runs on."""
    source, target = np.ones(COPIED, np.float32), np.zeros(COPIED, np.float32)
    info = Path("/proc/cpuinfo")
    models = [line for line in info.read_text().splitlines() if "model name" in line] if info.exists() else []
    packages = ("jax", "jaxlib", "numpy", "scipy", "pygsp", "torch")
    return {
        "processor": models[0].partition(":")[2].strip() if models else platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "memory, GB": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9,
        "device": f"{jax.devices()[0].device_kind} ({jax.default_backend()})",
        "copy by JAX, GB/s": copying() / 1e9,
        "copy by NumPy, GB/s": 2 * source.nbytes / median_time(lambda: np.copyto(target, source), 5) / 1e9,
        "Python": platform.python_version(),
    } | {package: installed(package) for package in packages}


def picture(rows: list[Row], path: Path) -> None:
    """Seconds of each program over the vertices."""
    require("matplotlib", "plot")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4.5), layout="constrained")
    axes = figure.add_subplot(xlabel="vertices", ylabel="seconds", title=f"Filter of degree {DEGREE}, three columns")
    names = dict.fromkeys(row["program"] for row in rows)
    for name, colour, marker in zip(names, COLOURS, "os^D", strict=False):
        points = [(row["vertices"], row["s"]) for row in rows if row["program"] == name and "s" in row]
        if points:
            axes.loglog(*zip(*points, strict=True), marker=marker, color=colour, label=name)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("mesh", nargs="?", type=Path)
    parser.add_argument("--sizes", type=int, nargs="+", metavar="VERTICES")
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS)[:-1])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--shuffled", action="store_true", help="vertices of synthetic meshes in random order")
    parser.add_argument("--alone", action="store_true", help="without the other programs")
    parser.add_argument("--output", type=json_file, metavar="FILE.json", help="rewritten after each part")
    options = parser.parse_args()
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # processes of their own share the accelerator
    if options.repeat < 1 or min(options.sizes or SIZES) < 1000:
        parser.error("a call is repeated once at least, and a mesh has at least 1000 vertices")
    given = options.mesh and load(parser, options.mesh)
    found: Row = {"machine": machine()}

    @cache
    def mesh(sizes: tuple[int, ...], index: int) -> jm.Mesh:
        if given and index == 0:
            return given
        made = bumpy_torus(sizes[index])
        return reordered(made) if options.shuffled else made

    original = cache(lambda *place: make_original(mesh(*place)))
    print(table([{"machine": key, "": value} for key, value in found["machine"].items()]), flush=True)
    for name in options.parts:
        usual = FOR_MEMORY if name == "memory" else SIZES if jax.default_backend() == "cpu" else ON_ACCELERATOR
        sizes = tuple(options.sizes or usual)
        bench = Bench(sizes, partial(mesh, sizes), partial(original, sizes), options.repeat, options.alone)
        try:
            for row in PARTS[name](bench):
                found.setdefault(name, []).append(row)
                say(json.dumps(row))
        except jm.JaxmarkError as refusal:
            parser.error(f"{name}: {refusal}")
        print(f"\n{name}\n\n{table(found[name])}", flush=True)
        if options.output:
            save_json(options.output, found)
    if options.output and "filter" in found:
        try:
            picture(found["filter"], options.output.with_suffix(".png"))
        except jm.JaxmarkError as missing:
            say(missing)
    if any(row.get("difference", 0) > TOLERANCE for row in found.get("filter", [])):
        sys.exit(f"The programs' results differ by more than {TOLERANCE:g}.")


if __name__ == "__main__":
    main()
