"""Repeat the figures of Sohn et al.: python benchmarks/theory/paper.py bunny.ply dragon.ply hand.ply [...].

The paper's meshes have 1494, 1257 and 1055 vertices; any meshes will do. Each part has tables and figures; numbers are
those of the paper's figures:

kernel     1 and 2: a scaling function, and its pass band B(δ), where it has at least δ = 0.5 of its value at the node.
           Bands are counted from the lowest.
time       12: f(Δ)x of three float32 columns at degree 64, over N, on the meshes and bumpy tori of --sizes. "dense" is
           the paper's method, n products with an N × N matrix, up to --largest; "sparse" is ours; both are compiled.
           Medians of --repeat calls after one that is not counted; exponents by least squares on logarithms.
degree     13: the same over the degree; "all bands" computes all n + 1 components in one pass, as the paper does.
attacks    14: bit error rate of 64 bits without a code, RMS 0.08 % of the diagonal, mean of --trials keys, messages
           and seeds. "as printed": printed kernel, unscaled components, plain correlation; "working": Jackson-damped
           bands at unit norm, decorrelated; "eigenvectors": decorrelated, too. The attacks are `jaxmark.attacks`'s:
           diagonal-noise, mark_noise, similarity and edge-flips; suspects of the last two are aligned by
           `jaxmark.alignment.attempts.align`, others are compared without alignment.
collinear  median |⟨x_i, x_j⟩_D| of unit components that are not empty, over x, y and z, and bit errors of 64 bits
           without an attack, with unscaled components and plain correlation, for each form of the kernel.
gibbs      15 and 16: 16 bands of best approximated hats, and of sums of neighbouring scaling functions of the same
           degree: the largest value of a response outside [0, 1], over its peak.

--output FILE.json has all tables and curves; with the extra `plot` each figure becomes FILE-N.png in the same folder.
"""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial import chebyshev

import jaxmark as jm
from jaxmark.alignment.attempts import align
from jaxmark.alignment.observation import observe
from jaxmark.alignment.original import Original, displace, make_original, residual
from jaxmark.attacks import mark_noise
from jaxmark.distortion import rms
from jaxmark.spectral.bands import hat, nodes, scaling
from jaxmark.spectral.chebyshev import band_components, filter
from jaxmark.watermark.carriers import host_bands
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.interfaces import Detector, Scheme
from jaxmark.watermark.reading.detectors import correlate, decorrelate
from jaxmark.watermark.schemes.modulated import EigenScheme, HostScheme

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, json_file, load, make_parser
from common.filters import DEGREE, TOLERANCE, bumpy_torus, coefficients, exponent, graph, shifted
from common.panels import Curves, Panel, pictures
from common.tables import Row, save_json, say, table
from common.timing import median_time

SIZES = (1000, 2000, 4000, 8000, 16_000, 32_000, 64_000, 128_000)
DEGREES, BANDS = (16, 32, 64, 128, 256), (32, 64)
BITS, BUDGET, DELTA = 64, 8e-4, 0.5
ALIGNED = ("similarity", "edge flips")
KERNELS: Mapping[str, dict[str, Any]] = {
    "printed": {"kernel": "printed", "damping": "none"},
    "halved": {"kernel": "halved", "damping": "none"},
    "Jackson": {"kernel": "halved", "damping": "jackson"},
}
READERS: Mapping[str, tuple[Scheme, Detector]] = {
    "as printed": (HostScheme(64, unit_norm=False, **KERNELS["printed"]), correlate),
    "working": (HostScheme(), decorrelate),
    "eigenvectors": (EigenScheme(), decorrelate),
}


Part = tuple[list[list[Row]], list[Panel]]  # tables, and what is drawn of them
Attacker = Callable[[jm.Mesh, jm.Mesh, float, int], jm.Mesh]  # marked, original, strength, seed


def by_name(name: str) -> Attacker:
    return lambda marked, _, strength, seed: jm.attack(marked, name, strength, seed=seed)


def relative(marked: jm.Mesh, original: jm.Mesh, strength: float, seed: int) -> jm.Mesh:
    return mark_noise(marked, original, strength, jax.random.key(seed))


ATTACKS: Mapping[str, tuple[Attacker, Sequence[float], str]] = {
    "none": (lambda marked, *_: marked, (0,), ""),
    "uniform": (by_name("diagonal-noise"), (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2), "half width / diagonal"),
    "relative": (relative, (0.25, 0.5, 1, 2, 4, 8, 16), "RMS / the mark's"),
    "similarity": (by_name("similarity"), (0.5, 1, 4, 9), "shift / diagonal, and scale less 1"),
    "edge flips": (by_name("edge-flips"), (0.01, 0.03, 0.1, 0.3), "share of the edges"),
}


def kernel(_: Mapping[str, jm.Mesh], __: argparse.Namespace) -> Part:
    bands, grid = 16, np.linspace(0, 2, 20_001)
    rows: list[Row] = []
    panels = [Panel(1, "λ", "f(λ)", {}), Panel(2, "λ", f"f(λ) over its value at the node, where at least {DELTA}", {})]
    for name, form in KERNELS.items():
        for band in (0, 1, bands // 2):
            c, node = scaling(bands, **form)[band], nodes(bands)[band]
            response = chebyshev.chebval(grid - 1, c)
            shape = response / chebyshev.chebval(node - 1, c)
            inside = grid[shape >= DELTA]
            row = {"kernel": name, "band": band + 1, "node λ": float(node), "peak λ": float(grid[shape.argmax()])}
            row |= {"peak / node": float(shape.max()), "from λ": float(inside.min()), "to λ": float(inside.max())}
            rows.append(row | {"f(0) / node": float(shape[0]), "least / node": float(shape.min())})
        passing = np.where(shape >= DELTA, shape, 0)
        for panel, values in zip(panels, (response, passing), strict=True):
            panel.curves[f"{name}, band {bands // 2 + 1} of {bands}"] = (grid[::20].tolist(), values[::20].tolist())
    return [rows], panels


@jax.jit
def dense_filter(matrix: jax.Array, c: jax.Array, x: jax.Array) -> jax.Array:
    """The paper's Method 2, corrected, by products with the whole matrix."""

    def step(terms: tuple[jax.Array, ...], c_k: jax.Array) -> tuple[tuple[jax.Array, ...], None]:
        before, current, total = terms
        following = 2 * (matrix @ current) - before
        return (current, following, total + c_k * following), None

    first = matrix @ x
    return jax.lax.scan(step, (x, first, c[0] * x + c[1] * first), c[2:])[0][2]


def timed(mesh: jm.Mesh, degree: int, largest: int, repeat: int) -> Row:
    operator, x = graph(make_original(mesh))
    c, run = jnp.asarray(coefficients(degree)), jax.jit(filter)
    row: Row = {"vertices": len(x), "sparse, s": median_time(lambda: run(operator, c, x), repeat)}
    if len(x) <= largest:
        matrix, ours = jnp.asarray(shifted(operator).toarray()), run(operator, c, x)
        row["dense, s"] = median_time(lambda: dense_filter(matrix, c, x), repeat)
        row["dense / sparse"] = row["dense, s"] / row["sparse, s"]
        off = float(jnp.abs(dense_filter(matrix, c, x) - ours).max() / jnp.abs(ours).max())
        if off > TOLERANCE:
            sys.exit(f"The two ways' results differ by {off:.1e}, more than {TOLERANCE:g}.")
    return row


def fitted(rows: Sequence[Row], over: str, **label: str) -> tuple[list[Row], Curves]:
    """The exponent of each way's time, and its curve."""
    found, curves = [], {}
    for way in ("dense", "sparse", "all bands"):
        points = [(float(row[over]), row[f"{way}, s"]) for row in rows if f"{way}, s" in row]
        if len(points) > 1:
            x, y = zip(*points, strict=True)
            curves[way] = (list(x), list(y))
            places = {"from": int(x[0]), "to": int(x[-1])}
            found.append(label | {"way": way, "exponent of": over, "exponent": exponent(x, y)} | places)
    return found, curves


def time(meshes: Mapping[str, jm.Mesh], options: argparse.Namespace) -> Part:
    surfaces = [*meshes.items(), *(("torus", bumpy_torus(size)) for size in options.sizes)]
    rows = [{"mesh": name} | timed(mesh, DEGREE, options.largest, options.repeat) for name, mesh in surfaces]
    exponents, curves = fitted(rows[len(meshes) :], "vertices")
    for both in (True, False):
        some = [row for row in rows[len(meshes) :] if ("dense, s" in row) == both]
        exponents += [row for row in fitted(some, "vertices")[0] if row["way"] == "sparse"]
    return [rows, exponents], [Panel(12, "vertices N", "seconds", curves, "log")]


def degree(meshes: Mapping[str, jm.Mesh], options: argparse.Namespace) -> Part:
    rows, exponents, panels = [], [], []
    for name, mesh in meshes.items():
        (operator, x), mine = graph(make_original(mesh)), []
        for n in DEGREES:
            family = jnp.asarray(scaling(n + 1), jnp.float32)
            row = {"mesh": name, "degree": n} | timed(mesh, n, len(x), options.repeat)
            row["all bands, s"] = median_time(partial(band_components, operator, family, x), options.repeat)
            mine.append(row)
        found, curves = fitted(mine, "degree", mesh=name)
        rows, exponents = rows + mine, exponents + found
        panels.append(Panel(13, "degree n", "seconds", curves, "log", name))
    return [rows, exponents], panels


def errors(
    original: Original, scheme: Scheme, detector: Detector, trials: int, kinds: Sequence[str] = tuple(ATTACKS)
) -> dict[tuple[str, float], float]:
    """Bit error rates at all strengths of some attacks: bits ±1 without a code, at the budget."""
    found: dict[tuple[str, float], list[float]] = {}
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        carrier, bits = (
            scheme.carrier(original, Choices(jm.Key(rng.bytes(32)), b""), BITS, BITS),
            rng.choice([-1.0, 1.0], BITS),
        )
        reader = carrier.reader()
        unit = original.to_host(carrier.displacement(jnp.asarray(bits, original.signal.dtype)))
        marked = displace(original, BUDGET / float(rms(unit[original.used])) * unit)
        for name, strength in [(kind, strength) for kind in kinds for strength in ATTACKS[kind][1]]:
            suspect = ATTACKS[name][0](marked, original.mesh, strength, trial)
            if name in ALIGNED:
                seen = align(original, suspect).observation(original)
            else:
                seen = observe(original.to_traced(residual(original, suspect)))
            soft = detector(reader, reader.receive(seen), 1.0)
            wrong = (np.asarray(soft) > 0) != (bits > 0)
            found.setdefault((name, strength), []).append(float(wrong.mean()))
    return {place: float(np.mean(rates)) for place, rates in found.items()}


def attacks(meshes: Mapping[str, jm.Mesh], options: argparse.Namespace) -> Part:
    with jax.enable_x64(True):
        originals = {name: make_original(mesh) for name, mesh in meshes.items()}
        found = {
            (mesh, reader): errors(original, scheme, detector, options.trials)
            for mesh, original in originals.items()
            for reader, (scheme, detector) in READERS.items()
        }
    rows, panels = [], []
    for name, (_, strengths, unit) in ATTACKS.items():
        places = [(name, strength) for strength in strengths]
        for place in places:
            rates = {f"{mesh}, {reader}": rate[place] for (mesh, reader), rate in found.items()}
            rows.append({"attack": name, "strength": place[1]} | rates)
        mean = {r: [np.mean([found[m, r][place] for m in meshes]).item() for place in places] for r in READERS}
        if len(strengths) > 1:
            curves = {reader: ([float(s) for s in strengths], rates) for reader, rates in mean.items()}
            panels.append(Panel(14, unit, "bit error rate, mean of the meshes", curves, "log x", name))
    return [rows], panels


def collinear(meshes: Mapping[str, jm.Mesh], options: argparse.Namespace) -> Part:
    rows: list[Row] = []
    with jax.enable_x64(True):
        for (name, mesh), bands in product(meshes.items(), BANDS):
            original = make_original(mesh)
            row: Row = {"mesh": name, "vertices": int(original.used.sum()), "bands": bands}
            for kind, form in KERNELS.items():
                family = scaling(bands, **form)
                upper = np.triu(np.abs(host_bands(original.operator, original.signal, family).gram), 1)
                row[kind] = float(np.median(upper[upper > 0]))  # empty bands are 0
                scheme = HostScheme(bands, unit_norm=False, **form)
                row[f"{kind}, bit errors"] = errors(original, scheme, correlate, options.trials, ["none"])["none", 0]
            rows.append(row)
    return [rows], []


def gibbs(_: Mapping[str, jm.Mesh], __: argparse.Namespace) -> Part:
    bands, band, grid = 16, 8, 1 - np.cos(np.linspace(0, np.pi, 4097))
    panels = [Panel(15, "λ", "f(λ)", {}), Panel(16, "λ", "f(λ)", {})]
    rows: list[Row] = []
    for n in (15, 31, 63, 127, 255):
        fine = {name: scaling(n + 1, **form) for name, form in KERNELS.items()}
        families = {name: one.reshape(bands, -1, n + 1).sum(axis=1) for name, one in fine.items()}
        families["hat"] = hat(nodes(bands), n)
        row: Row = {"degree": n}
        for name, family in families.items():
            values = chebyshev.chebval(grid - 1, family.T)
            beyond = np.maximum(values.max(axis=1) - 1, -values.min(axis=1)).clip(min=0)
            row[name] = float((beyond / values.max(axis=1)).max())
            if n == 63 or (name == "hat" and n < 63):
                panels[name == "hat"].curves[f"{name}, degree {n}"] = (grid[::4].tolist(), values[band, ::4].tolist())
        rows.append(row)
    ideal = np.interp(grid[::4], nodes(bands)[band - 1 : band + 2], (0, 1, 0))
    panels[1].curves["hat itself"] = (grid[::4].tolist(), ideal.tolist())
    return [rows], panels


PARTS = {one.__name__: one for one in (kernel, time, degree, attacks, collinear, gibbs)}


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, metavar="VERTICES")
    parser.add_argument("--largest", type=int, default=8000, metavar="VERTICES", help="of a dense matrix")
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--output", type=json_file, metavar="FILE.json")
    options = parser.parse_args()
    if min(options.trials, options.repeat) < 1 or min(options.sizes) < 500:
        parser.error("trials and repeats are at least 1, and sizes at least 500")
    tables: dict[str, list[list[Row]]] = {}
    panels: list[Panel] = []
    meshes = {path.stem: load(parser, path) for path in options.meshes}
    try:
        for name in options.parts:
            tables[name], drawn = PARTS[name](meshes, options)
            panels += drawn
            print(f"\n{name}", *map(table, tables[name]), sep="\n\n", flush=True)
    except jm.JaxmarkError as refusal:
        parser.error(str(refusal))
    if options.output:
        save_json(options.output, tables | {"panels": [one._asdict() for one in panels]})
        try:
            pictures(panels, options.output.with_suffix(""))
        except jm.JaxmarkError as missing:
            say(missing)


if __name__ == "__main__":
    main()
