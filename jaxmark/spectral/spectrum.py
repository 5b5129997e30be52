"""The spectrum of the Laplacian: eigenpairs, and the spectral measure of a signal, on the host in float64.

Filters never need it; it is the reference for tests and reports, and the basis of the eigenvector scheme.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float64, Int64
from scipy import linalg, sparse
from scipy.sparse import csgraph
from scipy.sparse import linalg as sparse_linalg

from jaxmark.errors import JaxmarkError
from jaxmark.seeds import Seed, random_key
from jaxmark.spectral.laplacian import Laplacian, centre, symmetric_matrix

# Up to this number of vertices, a dense decomposition is faster than an iterative one, and finds every eigenvalue.
_DENSE_LIMIT = 2500
_ROUNDING = 100 * np.finfo(np.float64).eps  # of eigenvalues, which are at most 2
_SHIFT = 1e-6  # of iterated matrices, over the median of their diagonal, which keeps them definite


class Eigenpairs(NamedTuple):
    """The lowest eigenpairs of Δ on the vertices that have edges, ascending."""

    values: Float64[np.ndarray, " pairs"]  # in [0, 2]; times `Laplacian.scale`, those of (D - W)x = λMx
    vectors: Float64[np.ndarray, "vertices pairs"]  # M-orthonormal; 0 at isolated vertices
    space: Int64[np.ndarray, " pairs"]  # index of the first pair in the same eigenspace


class Quadrature(NamedTuple):
    """Nodes and weights with ⟨x, f(Δ)x⟩_M = Σ_i weight_i f(node_i) for polynomials f of degree < 2 · nodes."""

    nodes: Float64[np.ndarray, " nodes"]
    weights: Float64[np.ndarray, " nodes"]


def eigenpairs(operator: Laplacian, count: int | None = None, *, tolerance: float = 1e-7) -> Eigenpairs:
    """Compute eigenpairs of Δ above its null space, M-orthonormal, so that x = Σ_i ⟨x, φ_i⟩_M φ_i for centred x.

    By a dense decomposition (`eigh`) up to 2,500 vertices, beyond by shift-and-invert Lanczos (`eigsh`) from a fixed
    start.

    Args:
        operator: the Laplacian, of N vertices.
        count: largest number of pairs, from the lowest eigenvalue on. None for all.
        tolerance: eigenvalues that differ by less than this share of them form one eigenspace. Its basis is arbitrary,
            so that only the projection onto the whole eigenspace is meaningful; an eigenspace that `count` would cut is
            left out.

    Returns:
        The pairs, without the null vectors, of which there is one for each connected component.

    Raises:
        JaxmarkError: if `count` is below 1 or would cut the first eigenspace, or more than a third of all pairs of a
            mesh of over 2,500 vertices are asked for.
    """
    if count is not None and count < 1:
        raise JaxmarkError(f"eigenpairs(count=...) must be at least 1, got {count}.")
    linked, root, matrix = symmetric_matrix(operator)
    size, scaled = len(linked), sparse.csc_array(matrix)
    null, component = csgraph.connected_components(scaled, directed=False)
    # One pair more than asked for tells whether the last eigenspace is complete.
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
    fresh = np.diff(values, prepend=-np.inf) > tolerance * values + _ROUNDING
    space = np.maximum.accumulate(np.where(fresh, np.arange(len(values)), 0)).astype(np.int64)
    kept = len(values) if count is None or len(values) <= count else int(space[count])
    if kept == 0 < len(values):
        raise JaxmarkError(f"The lowest eigenspace has more pairs than count={count}; ask for more.")
    full = np.zeros((len(operator.degree), kept))
    full[linked] = vectors[:, :kept] / root[:, None]
    return Eigenpairs(values[:kept], full, space[:kept])


def quadrature(operator: Laplacian, x: Float64[np.ndarray, " vertices"], steps: int) -> Quadrature:
    """Compute a Gauss quadrature of a signal's spectral measure, by Lanczos iteration with full reorthogonalisation.

    Reference: Golub, Meurant, "Matrices, Moments and Quadrature with Applications", 2010, ch. 6.

    Args:
        operator: the Laplacian.
        x: one signal `[N]`, preferably centred.
        steps: number of nodes; the result has fewer if the signal lies in a smaller invariant subspace. Nodes are in
            [0, 2]; weights are not negative, and sum to ⟨x, x⟩_M.
    """
    linked, root, matrix = symmetric_matrix(operator)
    scaled, vector = sparse.csc_array(matrix), root * x[linked]
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
        for _ in range(2):  # two orthogonalisations are enough (Kahan, Parlett)
            following -= basis[: k + 1].T @ (basis[: k + 1] @ following)
        betas.append(float(np.linalg.norm(following)))
        if betas[-1] < 1e-12:
            break
        basis[k + 1] = following / betas[-1]
    nodes, vectors = linalg.eigh_tridiagonal(alphas, betas[: len(alphas) - 1])
    return Quadrature(nodes, norm**2 * vectors[0] ** 2)


def white_probes(operator: Laplacian, seed: Seed, probes: int) -> Float64[np.ndarray, "vertices probes"]:
    """Draw random signals whose spectral measures sum, in expectation, to the count of the eigenvalues.

    The signals are random signs over √M, as in Hutchinson's estimator: Σ_p ⟨u_p, f(Δ)u_p⟩_M estimates Σ_i f(λ_i), over
    eigenvalues above the null space, with a variance of at most 2 Σ_i f(λ_i)²/probes (Avron, Toledo, J. ACM 58, 2011).
    Their `chebyshev.moments`, summed over the signals, are those of the spectral density.

    Args:
        operator: the Laplacian, of N vertices.
        seed: a number or a JAX random key; nothing secret, because bands must not depend on a mark's key.
        probes: number of signals, which are centred, and 0 at isolated vertices.
    """
    mass = np.where(np.asarray(operator.degree) > 0, np.asarray(operator.mass, np.float64), 0)
    signs = np.asarray(jax.random.rademacher(random_key(seed), (len(mass), probes)), np.float64)
    scale = np.where(mass > 0, 1 / np.sqrt(np.where(mass > 0, probes * mass, 1)), 0)
    return centre(operator, scale[:, None] * signs)


def _lowest(
    scaled: sparse.csc_array, root: np.ndarray, component: np.ndarray, wanted: int
) -> tuple[Float64[np.ndarray, " pairs"], Float64[np.ndarray, "vertices pairs"]]:
    """Compute the lowest eigenpairs above the null space of M^1/2 Δ M^-1/2, by shift-and-invert Lanczos.

    The null vectors, M^1/2 on each component, are known; with them projected out, only wanted pairs are iterated for.
    """
    size = len(root)
    null = sparse.csr_array((root, (np.arange(size), component)))
    null = null @ sparse.diags_array(1 / np.sqrt(null.multiply(null).sum(axis=0)))
    shift = _SHIFT * float(np.median(scaled.diagonal()))  # a few thin faces raise only their own elements
    factor = sparse_linalg.splu(
        scaled + shift * sparse.eye_array(size, format="csc"),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )

    def inverse(x: np.ndarray) -> np.ndarray:
        y = factor.solve(x.reshape(-1))
        return y - null @ (null.T @ y)

    # A fixed start makes the result repeatable.
    start = inverse(np.cos(np.arange(size, dtype=np.float64)))
    operator = sparse_linalg.LinearOperator(scaled.shape, matvec=inverse, dtype=np.float64)  # pyright: ignore[reportCallIssue]
    reciprocals, vectors = sparse_linalg.eigsh(operator, wanted, v0=start)
    order = np.argsort(-reciprocals)
    return 1 / reciprocals[order] - shift, vectors[:, order]
