"""Compare all families of bands: python benchmarks/theory/families.py MESH ... [--bands 16] [--degree 63].

The parts:

table      one row a family, one cell a mesh: median leakage / median coherence / ε, the largest coherence, of the unit
           components of x, y and z (the paper's Condition 3 requires both near 0) / the lowest degree, or order, at
           which median leakage is at most 1 % ("-": above degree 255, or order 8). The pass band of a band is its own
           interval and both neighbouring ones; bands without energy have leakage 1. Overshoot is the largest value of a
           response outside [0, 1]. Products are with Δ, for all bands and three columns at once; for conjugate
           gradients, the range over the meshes, counted in float64 at float32's tolerance.
           Families of fixed degree get more bands, of which neighbours are summed. "count" and "energy" place the edges
           by the mesh's spectral density or the host's energy, from --degree moments. "exact" is the result of Lagrange
           polynomials at the eigenvalues without rounding errors.
methods    the scaling functions, and Lagrange polynomials at a polyhedron's eigenvalues, by Method 1 and Method 2: the
           largest error against dense eigenvectors over the largest value ("lost": above 1); and the time band by band
           over that of one pass of Method 2. On meshes of at most 2,500 points.
"""

import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float64
from scipy.sparse import linalg as sparse_linalg

import jaxmark as jm
from jaxmark.geometry.mesh import make_mesh, weld, weld_mesh
from jaxmark.spectral import product, rational
from jaxmark.spectral.bands import Damping, bernstein, equal_edges, hat, intervals, lagrange, nodes, report, scaling
from jaxmark.spectral.chebyshev import band_components, filter, moments
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import Laplacian, centre, sparse_matrices
from jaxmark.spectral.spectrum import Quadrature, eigenpairs, quadrature, white_probes

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.tables import head, line
from common.timing import median_time

SELECTIVE = 0.01  # median leakage
NODES, PROBES = 512, 8
STEPS = (1, 2, 3, 4, 6, 8, 12, 16)  # degree + 1 over the bands
ORDERS = range(1, 9)
DENSE = 2500


class Sample(NamedTuple):
    """A mesh, and what families are measured on."""

    name: str
    operator: Laplacian
    x: Float64[np.ndarray, "vertices 3"]
    measures: tuple[Quadrature, ...]  # of x, y and z
    density: Float64[np.ndarray, " terms"]  # moments of the spectrum
    energy: Float64[np.ndarray, " terms"]  # and of the host


class Family(NamedTuple):
    """Bands by bands, degree or order, and mesh."""

    name: str
    responses: Callable[[int, int, Sample], Any]
    edges: Callable[[int, Sample], Float64[np.ndarray, " edges"] | None] = lambda bands, sample: None
    degrees: Literal["degree", "order", "none"] = "degree"


def in_angle(bands: int, *_: object) -> Float64[np.ndarray, " edges"]:
    return 1 - np.cos(np.linspace(0, np.pi, bands + 1))


def by_count(bands: int, sample: Sample) -> Float64[np.ndarray, " edges"]:
    return equal_edges(sample.density, bands)


def by_energy(bands: int, sample: Sample) -> Float64[np.ndarray, " edges"]:
    return equal_edges(sample.energy, bands)


def summed(family: Callable[..., np.ndarray], **options: Any) -> Callable[[int, int, Sample], np.ndarray]:
    """Neighbours of a family of degree + 1 bands, as one each."""

    def responses(bands: int, degree: int, _: Sample) -> np.ndarray:
        fine = family(degree + 1, **options)
        return fine.reshape(bands, -1, fine.shape[1]).sum(axis=1)

    return responses


@cache
def hats(bands: int, degree: int) -> np.ndarray:
    return hat(nodes(bands), degree)


def butterworth(edges: Callable[[int, Sample], np.ndarray]) -> Callable[[int, int, Sample], Callable]:
    def responses(bands: int, order: int, sample: Sample) -> Callable:
        bank = rational.butterworth(edges(bands, sample), order)
        return lambda values: rational.response(bank, values)

    return responses


def exact(bands: int, _: int, __: Sample) -> Callable:
    edges = in_angle(bands)
    return lambda values: ((values >= edges[:-1, None]) & (values < edges[1:, None])).astype(float)


DAMPINGS: tuple[Damping, ...] = ("none", "lanczos", "jackson")
FAMILIES = [
    Family("scaling, as printed", summed(scaling, kernel="printed")),
    *(Family(f"scaling, {name}", summed(scaling, damping=name)) for name in DAMPINGS),
    Family("Bernstein", summed(bernstein), lambda bands, _: np.linspace(0, 2, bands + 1)),
    Family("hat, minimax", lambda bands, degree, _: hats(bands, degree)),
    Family("count, jackson", lambda bands, degree, s: intervals(by_count(bands, s), degree + 1), by_count),
    Family("energy, jackson", lambda bands, degree, s: intervals(by_energy(bands, s), degree + 1), by_energy),
    Family("Butterworth", butterworth(in_angle), degrees="order"),
    Family("exact", exact, degrees="none"),
]


def make_sample(name: str, mesh: jm.Mesh, degree: int) -> Sample:
    points = weld_mesh(mesh, weld(np.asarray(mesh.vertices)))
    operator = from_mesh(points)
    x = centre(operator, np.asarray(points.vertices))
    with jax.enable_x64(True):
        density, energy = (
            np.asarray(moments(operator, jnp.asarray(signal), degree=degree // 2 + 1)).sum(axis=1)[: degree + 1]
            for signal in (white_probes(operator, 0, PROBES), x)
        )
    return Sample(name, operator, x, tuple(quadrature(operator, one, NODES) for one in x.T), density, energy)


def products_of(operator: Laplacian, bank: Float64[np.ndarray, "bands sections 6"], x: np.ndarray) -> int:
    """Products with Δ that `rational.filter_rational` takes for all bands, with all columns of x at once."""
    stiffness, mass = sparse_matrices(operator)
    root = np.sqrt(np.where(mass.diagonal() > 0, mass.diagonal(), 1))[:, None]
    counted = 0

    def quadratic(c: np.ndarray, y: np.ndarray) -> np.ndarray:
        nonlocal counted
        counted += 2
        first = stiffness @ (y / root) / root
        return c[0] * y + c[1] * first + c[2] * (stiffness @ (first / root) / root)

    for sections in bank:
        y = root * x
        for section in sections:
            right = quadratic(section[:3], y).ravel()
            size, matvec = (x.size, x.size), lambda z, c=section[3:]: quadratic(c, z.reshape(x.shape)).ravel()
            solver: Any = sparse_linalg.LinearOperator(size, matvec, dtype=np.float64)  # pyright: ignore[reportCallIssue]
            tolerance = 10 * float(np.finfo(np.float32).eps)
            y = sparse_linalg.cg(solver, right, rtol=tolerance, maxiter=2000)[0].reshape(x.shape)
    return counted


def cell(family: Family, sample: Sample, bands: int, degree: int) -> str:
    def found(size: int) -> tuple[float, float, float]:
        responses, edges = family.responses(bands, size, sample), family.edges(bands, sample)
        reports = [report(measure, responses, edges=edges) for measure in sample.measures]
        return (
            float(np.median([one.leakage for one in reports])),
            float(np.median([one.coherence_median for one in reports])),
            max(one.coherence_max for one in reports),
        )

    sizes = {"degree": [step * bands - 1 for step in STEPS], "order": ORDERS, "none": []}[family.degrees]
    least = "-"
    for size in reversed(sizes):
        if found(size)[0] > SELECTIVE:
            break
        least = str(size)
    return " / ".join([*(f"{value:.3f}" for value in found(degree)), least])


def table(samples: Sequence[Sample], bands: int, degree: int, order: int) -> None:
    names = [f"{sample.name}, {len(sample.x)}" for sample in samples]
    print(f"\n{bands} bands; leakage / coherence / ε / smallest degree or order\n")
    print(head("family", "degree", "products", "overshoot", *names))
    for family in FAMILIES:
        match family.degrees:
            case "degree":
                size, shown, products = degree, str(degree), str(degree)
            case "order":
                counts = [products_of(s.operator, rational.butterworth(in_angle(bands), order), s.x) for s in samples]
                size, shown, products = order, f"order {order}", f"{min(counts):,} - {max(counts):,}"
            case "none":
                size, shown, products = 0, "N - 1", "N - 1"
        overshoot = max(
            report(s.measures[0], family.responses(bands, size, s), edges=family.edges(bands, s)).overshoot.max()
            for s in samples
        )
        cells = [cell(family, sample, bands, size) for sample in samples]
        print(line(family.name, shown, products, f"{overshoot:.3f}", *cells), flush=True)


def dense_bands(operator: Laplacian, coefficients: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The band components of a centred signal by the whole eigenbasis: `[bands, N]`."""
    values, vectors, _ = eigenpairs(operator)
    responses = np.polynomial.chebyshev.chebval(values - 1, coefficients.T)
    return (responses * (vectors.T @ (operator.degree * x))) @ vectors.T


def method_errors(operator: Laplacian, points: np.ndarray, coefficients: np.ndarray, dtype: str) -> list[str]:
    """Of Method 2, Method 1 in Leja's order and as printed, on white noise."""
    noise = np.random.default_rng(0).normal(size=(len(operator.degree), 1))
    x = centre(operator, noise)[:, 0]
    expected = dense_bands(operator, coefficients, x)
    with jax.enable_x64(dtype == "float64"):
        signal = jnp.asarray(x.astype(dtype))
        found = [band_components(operator, coefficients, signal)]
        for order in ("leja", "printed"):
            factors = product.lagrange_factors(points, order=order)
            with np.errstate(over="ignore"):  # the paper's A_j
                found.append(jax.jit(jax.vmap(product.filter_by_factors, (None, 0, None)))(operator, factors, signal))
        errors = [float(np.abs(np.asarray(one) - expected).max() / np.abs(expected).max()) for one in found]
    return [f"{error:.0e}" if error < 1 else "lost" if np.isfinite(error) else "overflow" for error in errors]


def methods(sample: Sample, repeat: int) -> None:
    print(f"\n{sample.name}: Method 1 and Method 2, error relative to the largest value\n")
    print(head("polynomials", "degree", "dtype", "Method 2", "Method 1, Leja's order", "Method 1, as printed"))
    for dtype in ("float32", "float64"):
        for bands in (8, 16, 32, 64, 128, 256):
            errors = method_errors(sample.operator, nodes(bands), scaling(bands), dtype)
            print(line("scaling", bands - 1, dtype, *errors))
    for name in ("icosahedron", "icosphere of 42"):
        solid = trimesh.creation.icosphere(subdivisions=int(name != "icosahedron"))
        operator = from_mesh(make_mesh(solid.vertices, solid.faces))
        pairs = eigenpairs(operator)
        values = np.append(0, pairs.values[np.unique(pairs.space)])
        for dtype in ("float32", "float64"):
            errors = method_errors(operator, values, lagrange(values), dtype)
            print(line(f"eigenvalues of an {name}", len(values) - 1, dtype, *errors))

    x, bands = jnp.asarray(sample.x, jnp.float32), 64
    family = scaling(bands)
    factors = product.lagrange_factors(nodes(bands))
    once, one = jax.jit(product.filter_by_factors), jax.jit(filter)
    singles = [product.Factors(*(part[j] for part in factors)) for j in range(bands)]
    second = median_time(lambda: band_components(sample.operator, family, x), repeat)
    apart = median_time(lambda: [one(sample.operator, row, x) for row in family], repeat)
    first = median_time(lambda: [once(sample.operator, single, x) for single in singles], repeat)
    print(f"\n{bands} bands of three columns, time over one pass: one by one {apart / second:.1f}, Method 1", end=" ")
    print(f"{first / second:.1f}")


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--bands", type=int, default=16)
    parser.add_argument("--degree", type=int, default=63, help="one less than a multiple of --bands")
    parser.add_argument("--order", type=int, default=3, help="of rational bands")
    parser.add_argument("--parts", nargs="+", choices=["table", "methods"], default=["table", "methods"])
    parser.add_argument("--repeat", type=int, default=5)
    arguments = parser.parse_args()
    if (arguments.degree + 1) % arguments.bands:
        parser.error("--degree must be one less than a multiple of --bands")
    samples = [make_sample(path.stem, load(parser, path), arguments.degree) for path in arguments.meshes]
    if "table" in arguments.parts:
        table(samples, arguments.bands, arguments.degree, arguments.order)
    if "methods" in arguments.parts:
        for sample in samples:
            if len(sample.x) <= DENSE:
                methods(sample, arguments.repeat)


if __name__ == "__main__":
    main()
