"""The spectrum itself: eigenvectors, and a signal's spectral measure. Host-side reference, in float64.

Filters never need it; the eigenvector scheme, the tests and the reports do.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float64, Int64, PRNGKeyArray
from scipy import linalg, sparse
from scipy.sparse import csgraph
from scipy.sparse import linalg as sparse_linalg

from jaxmark.errors import JaxmarkError
from jaxmark.laplacian import Laplacian, centre, sparse_matrices

# Below this many vertices a dense decomposition is faster than it is to iterate, and finds every eigenvalue.
_DENSE_LIMIT = 2500


class Eigenpairs(NamedTuple):
    """The lowest eigenpairs of Δ on the vertices that have edges, ascending."""

    values: Float64[np.ndarray, " pairs"]  # in [0, 2]
    vectors: Float64[np.ndarray, "vertices pairs"]  # D-orthonormal; 0 at isolated vertices
    space: Int64[np.ndarray, " pairs"]  # index of the first pair with the same eigenvalue: one eigenspace


class Quadrature(NamedTuple):
    """Nodes and weights with ⟨x, f(Δ)x⟩_D = Σ_i weight_i f(node_i) for polynomials f of degree < 2 · nodes."""

    nodes: Float64[np.ndarray, " nodes"]
    weights: Float64[np.ndarray, " nodes"]


def eigenpairs(operator: Laplacian, count: int | None = None, *, tolerance: float = 1e-7) -> Eigenpairs:
    """Eigenpairs of Δ above its null space: D-orthonormal, so that x = Σ_i ⟨x, φ_i⟩_D φ_i for centred x.

    Dense (`eigh`) up to 2,500 vertices, by shift-and-invert Lanczos (`eigsh`) from a fixed start beyond.

    Args:
        operator: the Laplacian, of N vertices.
        count: how many of the lowest, at most. None for all.
        tolerance: eigenvalues closer than this are one eigenspace, in which no basis is preferred: only its projection
            means anything. An eigenspace that `count` would cut is left out.

    Returns:
        The pairs with eigenvalue above the null space (one null vector per connected component is left out).

    Raises:
        JaxmarkError: if `count` is below 1, or so many pairs of a large mesh are asked for that iterating is hopeless.
    """
    if count is not None and count < 1:
        raise JaxmarkError(f"eigenpairs(count=...) must be at least 1, got {count}.")
    linked, root, scaled = _symmetric(operator)
    size = len(linked)
    null, component = csgraph.connected_components(scaled, directed=False)
    # One more than asked for tells whether the last eigenspace is whole.
    wanted = size - null if count is None else min(count + 1, size - null)
    if wanted == 0:
        values, vectors = np.zeros(0), np.zeros((size, 0))
    elif size <= _DENSE_LIMIT:
        values, vectors = linalg.eigh(scaled.toarray(), subset_by_index=(null, null + wanted - 1))
    elif 3 * wanted > size:
        raise JaxmarkError(
            f"{wanted} eigenvectors of a mesh of {size} vertices are too many to iterate for; ask for fewer, or use"
            " polynomial bands."
        )
    else:
        values, vectors = _lowest(scaled, root, component, wanted)
    fresh = np.diff(values, prepend=-np.inf) > tolerance
    space = np.maximum.accumulate(np.where(fresh, np.arange(len(values)), 0)).astype(np.int64)
    kept = len(values) if count is None or len(values) <= count else int(space[count])
    full = np.zeros((len(operator.degree), kept))
    full[linked] = vectors[:, :kept] / root[:, None]
    return Eigenpairs(values[:kept], full, space[:kept])


def quadrature(operator: Laplacian, x: Float64[np.ndarray, " vertices"], steps: int) -> Quadrature:
    """Gauss quadrature of the spectral measure of a signal, by Lanczos with full reorthogonalisation.

    Reference: Golub, Meurant, "Matrices, Moments and Quadrature with Applications", 2010, ch. 6.

    Args:
        operator: the Laplacian, of N vertices.
        x: one signal `[N]`, best centred.
        steps: the number of nodes; fewer come back where the signal lies in a smaller invariant space.

    Returns:
        Nodes in [0, 2] and non-negative weights that sum to ⟨x, x⟩_D.
    """
    linked, root, scaled = _symmetric(operator)
    vector = root * x[linked]
    norm = float(np.linalg.norm(vector))
    if norm == 0:
        return Quadrature(np.zeros(0), np.zeros(0))
    steps = min(steps, len(vector))
    basis = np.zeros((steps + 1, len(vector)))
    basis[0] = vector / norm
    alphas: list[float] = []
    betas: list[float] = []
    for k in range(steps):
        following = scaled @ basis[k]
        alphas.append(float(following @ basis[k]))
        for _ in range(2):  # twice is enough (Kahan, Parlett)
            following -= basis[: k + 1].T @ (basis[: k + 1] @ following)
        betas.append(float(np.linalg.norm(following)))
        if betas[-1] < 1e-12:
            break
        basis[k + 1] = following / betas[-1]
    nodes, vectors = linalg.eigh_tridiagonal(alphas, betas[: len(alphas) - 1])
    return Quadrature(nodes, norm**2 * vectors[0] ** 2)


def white(operator: Laplacian, key: PRNGKeyArray, probes: int) -> Float64[np.ndarray, "vertices probes"]:
    """Signals whose spectral measures sum, on average, to the count of eigenvalues above the null space.

    Keyed signs over √D, by Hutchinson: Σ_p ⟨u_p, f(Δ)u_p⟩_D estimates Σ_i f(λ_i), with a variance of at most
    2 Σ_i f(λ_i)²/probes (Avron, Toledo, J. ACM 58, 2011). Their `chebyshev.moments`, summed, are those of the spectral
    density.

    Args:
        operator: the Laplacian, of N vertices.
        key: any, but not a mark's: what bands are made from must not depend on that.
        probes: how many signals.

    Returns:
        `[N, probes]`, centred, 0 at isolated vertices.
    """
    degree = np.asarray(operator.degree, np.float64)
    signs = np.asarray(jax.random.rademacher(key, (len(degree), probes)), np.float64)
    scale = np.where(degree > 0, 1 / np.sqrt(np.where(degree > 0, probes * degree, 1)), 0)
    return centre(operator, scale[:, None] * signs)


def _symmetric(operator: Laplacian) -> tuple[Int64[np.ndarray, " linked"], np.ndarray, sparse.csc_array]:
    """Δ made symmetric, D^-1/2 (D - W) D^-1/2, on the vertices that have edges; which these are, and √D on them."""
    stiffness, mass = sparse_matrices(operator)
    degree = mass.diagonal()
    linked = np.flatnonzero(degree > 0)
    root = np.sqrt(degree[linked])
    inverse = sparse.diags_array(1 / root)
    return linked, root, sparse.csc_array(inverse @ stiffness[linked][:, linked] @ inverse)


def _lowest(
    scaled: sparse.csc_array, root: np.ndarray, component: np.ndarray, wanted: int
) -> tuple[Float64[np.ndarray, " pairs"], Float64[np.ndarray, "vertices pairs"]]:
    """The lowest eigenpairs above the null space of D^-1/2 (D - W) D^-1/2, by shift-and-invert Lanczos.

    The null vectors, D^1/2 on each component, are known: with them projected out, only what is wanted is iterated for.
    """
    size = len(root)
    null = sparse.csr_array((root, (np.arange(size), component)))
    null = null @ sparse.diags_array(1 / np.sqrt(null.multiply(null).sum(axis=0)))
    shift = 1e-6  # keeps the matrix definite
    factor = sparse_linalg.splu(
        scaled + shift * sparse.eye_array(size, format="csc"),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )

    def inverse(x: np.ndarray) -> np.ndarray:
        y = factor.solve(x.reshape(-1))
        return y - null @ (null.T @ y)

    # A fixed start keeps the result repeatable.
    start = inverse(np.cos(np.arange(size, dtype=np.float64)))
    operator = sparse_linalg.LinearOperator(scaled.shape, matvec=inverse, dtype=np.float64)  # pyright: ignore[reportCallIssue]
    reciprocals, vectors = sparse_linalg.eigsh(operator, wanted, v0=start)
    order = np.argsort(-reciprocals)
    return 1 / reciprocals[order] - shift, vectors[:, order]
