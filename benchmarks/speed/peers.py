"""Compare features and times with those of other libraries: python benchmarks/speed/peers.py [MESH].

The meshes are a bumpy torus of --size vertices, and MESH. Libraries of the extra `peers` that are missing are "not
installed". Times are the least of --repeat calls after a first one that is not counted, because other work on the
machine only makes calls slower; JAX code is compiled. The parts:

features    by the libraries' documents and code, in the versions that VERSIONS names.
filter      exp(-5 Δ) of three float32 columns, the positions, by a series of degree 40; with the gradient of the sum of
            squares with respect to the columns. matfree is given our product with Δ.
ChebConv    a layer of degree 40 from three columns to three, with the same weights, symmetric; with the gradient of the
            sum of squares with respect to columns and parameters. "gradient, MB" is the memory that the compiled
            program allocates besides inputs and results or, in PyTorch, that is saved for the backward pass.
log-det     log det(I + 10 Δ) by the same 8 random probes and 20 products each, Chebyshev moments against Lanczos, with
            the derivative with respect to the factor 10; and exactly, by a sparse factorisation.

Differences are from our result, over its largest value; those of gradients are of the gradient with respect to the
columns or the factor.
"""

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

import jaxmark as jm
from jaxmark.alignment.original import make_original
from jaxmark.errors import require
from jaxmark.spectral.chebyshev import filter, moments
from jaxmark.spectral.laplacian import Laplacian, host_edges, sparse_matrices
from jaxmark.spectral.learned import cheb_conv

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import load, make_parser
from common.filters import TOLERANCE, bumpy_torus, graph, shifted
from common.peers import PEERS, installed
from common.tables import Row, table
from common.timing import Call, timed

DEGREE, TIME = 40, 5.0  # of the filter
FACTOR, PROBES, PRODUCTS = 10.0, 8, 20  # of the log-determinant
OURS = "jaxmark"
LIBRARIES = {
    OURS: "jaxmark",
    "PyGSP": "pygsp",
    "matfree": "matfree",
    "PyG ChebConv": "torch_geometric",
    "SciPy": "scipy",
}
VERSIONS = "jaxmark 0.1.0, PyGSP 0.6.1, matfree 0.6.3, PyTorch Geometric 2.8.1, SciPy 1.17.1"
FEATURES = """
polynomial filter of a signal             | yes    | yes | yes         | as a layer   | by hand
gradient to the signal                    | yes    | no  | yes         | yes          | no
gradient to the filter                    | yes    | no  | yes         | yes          | no
gradient to edge weights                  | yes    | no  | yes         | yes          | no
all of these, in O(N) memory              | yes    | no  | signal only | no           | no
forward mode                              | yes    | no  | polynomials | torch.func   | no
vmap                                      | yes    | no  | yes         | torch.func   | no
GPU                                       | by JAX | no  | by JAX      | by PyTorch   | no
frame bounds, inverse of a filter bank    | yes    | yes | no          | no           | no
graph of a point cloud                    | yes    | yes | no          | with another package | by hand
mass matrix other than the row sums       | lumped | no  | any matrix  | no           | any matrix
trace, spectral density                   | yes    | no  | yes         | no           | by hand
layer with learned filters (ChebConv)     | yes    | no  | no          | yes          | no
"""


class Work(NamedTuple):
    """What a program computes: its result, and its result's gradient, by calls that are repeated."""

    value: Callable[[], Any]
    gradient: Callable[[], Any] | None = None
    memory: float | None = None  # bytes that the gradient takes


Programs = Mapping[str, Callable[[Laplacian, jax.Array], Work]]


def compiled(function: Callable[..., Any], *inputs: Any) -> Callable[[], Any]:
    return partial(jax.jit(function).lower(*inputs).compile(), *inputs)


def differentiated(function: Callable[..., Any], *inputs: Any) -> Work:
    """A function of arrays, and the gradient of the sum of its result's squares, to each of them."""
    arguments = tuple(range(len(inputs)))
    gradient = jax.jit(jax.grad(lambda *given: jnp.sum(function(*given) ** 2), arguments)).lower(*inputs).compile()
    memory = gradient.memory_analysis()
    return Work(compiled(function, *inputs), partial(gradient, *inputs), memory and memory.temp_size_in_bytes)


# The filter


def heat(t: Any) -> Any:
    """The filter as a function of λ - 1."""
    return np.exp(-TIME * (t + 1)) if isinstance(t, np.ndarray) else jnp.exp(-TIME * (t + 1))


def heat_series() -> np.ndarray:
    return np.polynomial.chebyshev.chebinterpolate(heat, DEGREE).astype(np.float32)


def by_filter(operator: Laplacian, x: jax.Array) -> Work:
    return differentiated(lambda x: filter(operator, heat_series(), x), x)


def by_filter_and_coefficients(operator: Laplacian, x: jax.Array) -> Work:
    return differentiated(lambda x, c: filter(operator, c, x), x, jnp.asarray(heat_series()))


def by_funm_chebyshev(operator: Laplacian, x: jax.Array) -> Work:
    """Interpolated at the nodes of the first kind, as the series is."""
    funm = require("matfree.funm", "peers")

    def filtered(x: jax.Array) -> jax.Array:
        product = operator.product(x)
        return operator.leave(
            funm.funm_chebyshev(heat, DEGREE + 1, lambda v: product(v) - v)(operator.enter(x)),
        )

    return differentiated(filtered, x)


def by_peer(name: str, operator: Laplacian, x: jax.Array) -> Work:
    return Work(PEERS[name](shifted(operator), heat_series(), np.asarray(x)))


FILTERS: Programs = {
    OURS: by_filter,
    f"{OURS}, gradient also to coefficients": by_filter_and_coefficients,
    "matfree funm_chebyshev": by_funm_chebyshev,
} | {name: partial(by_peer, name) for name in PEERS}


# The layer


def layer_parameters(columns: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    weight = np.moveaxis(random.normal(size=(DEGREE + 1, columns, columns)), 0, -1) / DEGREE
    return {"weight": weight.astype(np.float32), "bias": random.normal(size=columns).astype(np.float32)}


def by_cheb_conv(operator: Laplacian, x: jax.Array) -> Work:
    parameters = jax.tree.map(jnp.asarray, layer_parameters(x.shape[1]))
    return differentiated(lambda x, p: cheb_conv(operator, p, x, form="symmetric"), x, parameters)


def by_geometric(operator: Laplacian, x: jax.Array) -> Work:
    """On all cores, or on the GPU that JAX computes on; it computes the weights of L from the edges at each call."""
    torch, layers = require("torch", "peers"), require("torch_geometric.nn", "peers")
    torch.set_num_threads(os.cpu_count() or 1)
    device = "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"
    layer, parameters = layers.ChebConv(x.shape[1], x.shape[1], DEGREE + 1), layer_parameters(x.shape[1])
    layer.load_state_dict(
        {f"lins.{k}.weight": torch.tensor(w.T) for k, w in enumerate(np.moveaxis(parameters["weight"], -1, 0))}
        | {"bias": torch.tensor(parameters["bias"])}
    )
    pairs, weights = host_edges(operator)
    edges = torch.tensor(np.concatenate([pairs, pairs[:, ::-1]]).T.astype(np.int64), device=device)
    values = torch.tensor(np.tile(weights, 2).astype(np.float32), device=device)
    layer, signal = layer.to(device), torch.tensor(np.asarray(x), device=device, requires_grad=True)

    def finished(result: Any) -> Any:
        if device == "cuda":
            torch.cuda.synchronize()
        return result

    def value() -> Any:
        with torch.no_grad():
            return finished(layer(signal, edges, values))

    def gradient() -> list[Any]:
        layer.zero_grad()
        signal.grad = None
        (layer(signal, edges, values) ** 2).sum().backward()
        return finished([signal.grad])

    saved: dict[int, int] = {}

    def note(tensor: Any) -> Any:
        storage = tensor.untyped_storage()
        saved[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        kept = (layer(signal, edges, values) ** 2).sum()
    del kept
    return Work(value, gradient, float(sum(saved.values())))


LAYERS: Programs = {OURS: by_cheb_conv, "PyG ChebConv": by_geometric}


# The log-determinant


def probes(operator: Laplacian, dtype: Any) -> jax.Array:
    return jax.random.rademacher(jax.random.key(0), (operator.degree.shape[0], PROBES), dtype)


def masses(operator: Laplacian) -> np.ndarray:
    """D, with 1 in place of 0: an isolated vertex adds nothing to the log-determinant."""
    degree = np.asarray(operator.degree, np.float64)
    return np.where(degree > 0, degree, 1)


def with_slope(function: Callable[..., Any], *inputs: Any) -> Work:
    """A function of the factor, and its derivative there."""
    factor = jnp.asarray(FACTOR, jnp.float32)
    return Work(compiled(function, factor, *inputs), compiled(jax.grad(function, (0,)), factor, *inputs))


def by_moments(operator: Laplacian, x: jax.Array) -> Work:
    nodes = np.cos(np.pi * (np.arange(2 * PRODUCTS + 1) + 0.5) / (2 * PRODUCTS + 1))
    series = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, 2 * PRODUCTS)).astype(np.float32)
    signs = probes(operator, x.dtype)

    def estimate(factor: jax.Array, signs: jax.Array) -> jax.Array:
        white = signs / jnp.asarray(np.sqrt(masses(operator)), signs.dtype)[:, None]
        density = moments(operator, white, degree=PRODUCTS).mean(axis=1)
        logarithms = jnp.log1p(factor * jnp.asarray(nodes + 1, factor.dtype))
        return jnp.dot(jnp.dot(series, logarithms, precision="highest"), density, precision="highest")

    return with_slope(estimate, signs)


def by_lanczos(operator: Laplacian, x: jax.Array) -> Work:
    """With its defaults: full reorthogonalisation, and a gradient of its own."""
    funm, decomp = require("matfree.funm", "peers"), require("matfree.decomp", "peers")
    integrand = funm.monte_carlo_funm_sym_logdet(decomp.tridiag_sym(PRODUCTS))

    def estimate(factor: jax.Array, signs: jax.Array) -> jax.Array:
        # The operator's own order of rows, once for all products.
        root = operator.enter(jnp.asarray(np.sqrt(masses(operator)), signs.dtype))
        product = operator.product(signs[:, 0])

        def matvec(v: jax.Array, factor: jax.Array) -> jax.Array:
            return v + factor * root * product(v / root)

        return jax.vmap(lambda v: integrand(matvec, v, factor), 1)(operator.enter(signs)).mean()

    return with_slope(estimate, probes(operator, x.dtype))


def by_factorisation(operator: Laplacian, x: jax.Array) -> Work:
    """By det(D + 10 (D - W)) / det D."""
    stiffness = sparse_matrices(operator)[0]
    mass = sparse.diags_array(masses(operator))

    def exact() -> float:
        factors = sparse_linalg.splu(
            (mass + FACTOR * stiffness).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        return float(np.log(np.abs(factors.U.diagonal())).sum() - np.log(mass.diagonal()).sum())

    return Work(exact)


DETERMINANTS: Programs = {
    f"{OURS} moments": by_moments,
    "matfree Lanczos": by_lanczos,
    "SciPy splu, exact": by_factorisation,
}

PARTS: Mapping[str, Programs] = {"filter": FILTERS, "ChebConv": LAYERS, "log-det": DETERMINANTS}


def measured(programs: Programs, operator: Laplacian, x: jax.Array, repeat: int) -> Iterator[Row]:
    """A row for each program; the first is ours, with which the others are compared."""
    ours: dict[str, Any] = {}
    for name, make in programs.items():
        row: Row = {"vertices": len(x), "program": name}
        try:
            work = make(operator, x)
        except jm.JaxmarkError:
            yield row | {"s": "not installed"}
            continue
        row["s"] = least_time(work.value, repeat)
        result = array(work.value())
        ours.setdefault("value", (row["s"], result))
        row |= compared("", row["s"], result, *ours["value"])
        if work.gradient:
            row["gradient, s"] = least_time(work.gradient, repeat)
            gradient = array(work.gradient()[0])
            ours.setdefault("gradient", (row["gradient, s"], gradient))
            row |= compared("gradient, ", row["gradient, s"], gradient, *ours["gradient"])
        if work.memory is not None:
            row["gradient, MB"] = work.memory / 1e6
        yield row


def least_time(call: Call, repeat: int) -> float:
    return min([timed(lambda: jax.block_until_ready(call()))[1] for _ in range(repeat + 1)][1:])


def array(result: Any) -> np.ndarray:
    return np.asarray(result.detach().cpu() if hasattr(result, "detach") else result)


def compared(what: str, seconds: float, result: np.ndarray, ours: float, our_result: np.ndarray) -> Row:
    difference = float(np.abs(result - our_result).max() / np.abs(our_result).max())
    return {f"{what}times ours": seconds / ours, f"{what}difference": difference}


def features() -> Iterator[Row]:
    names = list(LIBRARIES)
    yield {"": "version here"} | {name: installed(package) for name, package in LIBRARIES.items()}
    for line in FEATURES.strip().splitlines():
        feature, *cells = (cell.strip() for cell in line.split("|"))
        yield {"": feature} | dict(zip(names, cells, strict=True))


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("mesh", nargs="?", type=Path)
    parser.add_argument("--size", type=int, default=35_000, metavar="VERTICES")
    parser.add_argument("--repeat", type=int, default=10)
    options = parser.parse_args()
    if options.repeat < 1 or options.size < 1000:
        parser.error("a call is repeated once at least, and a mesh has at least 1000 vertices")
    meshes = [bumpy_torus(options.size), *([load(parser, options.mesh)] if options.mesh else [])]
    print(f"Features, as of {VERSIONS}\n\n{table(list(features()))}", flush=True)
    graphs = [graph(make_original(mesh)) for mesh in meshes]
    rows: list[Row] = []
    for name, programs in PARTS.items():
        found = [row for operator, x in graphs for row in measured(programs, operator, x, options.repeat)]
        print(f"\n{name}\n\n{table(found)}", flush=True)
        rows += found if name != "log-det" else []  # an estimate is not exact
    if any(row.get(key, 0) > TOLERANCE for row in rows for key in ("difference", "gradient, difference")):
        sys.exit(f"The programs' results differ by more than {TOLERANCE:g}.")


if __name__ == "__main__":
    main()
