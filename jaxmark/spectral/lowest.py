"""The lowest eigenpairs of the Laplacian in traced form, with derivatives."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float

from jaxmark.errors import JaxmarkError
from jaxmark.seeds import Seed, random_key
from jaxmark.spectral.lanczos import symmetric
from jaxmark.spectral.laplacian import Operator
from jaxmark.spectral.linear import Linear
from jaxmark.spectral.precision import matmul
from jaxmark.spectral.recurrence import along, changes_of, inner_mass

_GUARDS = 10  # vectors beside those asked for, and a fifth of these, so that the last ones converge, too
_DEGREE = 80  # of the filter of one iteration
_MAX_ITERATIONS = 60
_MAX_SOLVER_ITERATIONS = 2000


class LowestPairs(NamedTuple):
    """Eigenpairs of Δ from 0 on, ascending; a null vector for each component is among them."""

    values: Float[Array, " pairs"]  # in [0, 2]; times `Laplacian.scale`, those of (D - W)x = λMx
    vectors: Float[Array, "vertices pairs"]  # M-orthonormal; isolated vertices come last, with the value 2
    residual: Float[Array, ""]  # the largest ‖Δφ - λφ‖_M of a pair


@partial(jax.jit, static_argnames=("count", "dtype"))
def lowest_eigenpairs(operator: Operator, count: int, seed: Seed, *, dtype: Any = jnp.float32) -> LowestPairs:
    """Compute the lowest eigenpairs by iterating subspaces under Chebyshev filters; for up to a hundred of them.

    Unlike `eigenpairs`, which runs on the host, this works under `jit` and `vmap`, and has derivatives with respect to
    the operator, in all modes: as in Magnus, "On differentiating eigenvalues and eigenvectors", 1985, where values are
    apart, also from the first that is left out; turns of vectors within an eigenspace are left out. Reference: Zhou,
    Saad, Tiago, Chelikowsky, "Self-consistent-field calculations using Chebyshev-filtered subspace iteration", 2006.

    Args:
        operator: the Laplacian, of N vertices.
        count: number of pairs, null vectors included, at most the number of vertices.
        seed: a number or a JAX random key, of the start of the iteration; converged pairs depend on it by signs, and by
            the bases of eigenspaces.
        dtype: float32 or float64.

    Returns:
        The pairs. They are iterated for until the residual is a hundred times the machine epsilon, or 60 times.

    Raises:
        JaxmarkError: if there are fewer vertices than pairs, no pair is asked for, or the dtype is another.
    """
    size = operator.mass.shape[0]
    block = min(count + count // 5 + _GUARDS, size)
    if not 1 <= count <= size:
        raise JaxmarkError(f"A graph of {size} vertices has 1 to {size} eigenpairs, not {count}.")
    if dtype not in (jnp.float32, jnp.float64):
        raise JaxmarkError(f"lowest_eigenpairs computes in float32 or float64, not in {jnp.dtype(dtype)}.")
    start = jax.random.normal(random_key(seed), (size, block), dtype)
    values, vectors = _pairs(count, operator, jnp.where(operator.linked(start), start, 0))
    left = _product(operator, vectors)(vectors) - values * vectors
    residual = jnp.sqrt(jnp.max(jnp.sum(left**2, axis=0)[:count]))
    vectors = vectors[:, :count]
    return LowestPairs(values[:count], vectors / jnp.sqrt(inner_mass(operator, vectors)), residual)


def _product(operator: Operator, like: Array) -> Callable[[Array], Array]:
    """The map y → Ay, in which isolated vertices are the highest frequency, so that they are none of the lowest."""
    product, linked = symmetric(operator, like), operator.linked(like)
    return lambda y: product(y) + jnp.where(linked, 0, 2 * y)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _pairs(count: int, operator: Operator, start: Array) -> tuple[Array, Array]:
    """The lowest eigenpairs of A = M^½ΔM^-½, as many as the start has columns, of which `count` have converged."""
    product, small = _product(operator, start), 100 * jnp.finfo(start.dtype).eps

    def rotate(block: Array) -> tuple[Array, Array, Array]:
        """Ritz pairs of a block (Rayleigh, Ritz), and the largest residual of those that count."""
        basis = jnp.linalg.qr(block)[0]
        moved = product(basis)
        projected = matmul(basis.T, moved)
        values, turn = jnp.linalg.eigh((projected + projected.T) / 2)
        vectors = matmul(basis, turn)
        left = matmul(moved, turn) - values * vectors
        return values, vectors, jnp.sqrt(jnp.max(jnp.sum(left**2, axis=0)[:count]))

    def goes_on(state: tuple[Array, Array, Array, Array]) -> Array:
        _, _, residual, done = state
        return (residual > small) & (done < _MAX_ITERATIONS)

    def improve(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        values, vectors, _, done = state
        return *rotate(_damped(product, vectors, values[-1])), done + 1

    found = rotate(start)
    values, vectors, _, _ = jax.lax.while_loop(goes_on, improve, (*found, jnp.zeros((), jnp.int32)))
    return values, vectors


def _damped(product: Any, block: Array, cut: Array) -> Array:
    """T_n of A stretched so that what is above the cut lies in [-1, 1], divided by its value at 0.

    The division step by step keeps the numbers in range (Zhou, Saad, Tiago, Chelikowsky, algorithm 4.1).
    """
    half, middle = (2 - cut) / 2, (2 + cut) / 2
    sigma = first = -half / middle
    before, current = block, (product(block) - middle * block) * (sigma / half)

    def step(state: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
        before, current, sigma = state
        following = 1 / (2 / first - sigma)
        new = 2 * (following / half) * (product(current) - middle * current) - sigma * following * before
        return (current, new, following), None

    (_, current, _), _ = jax.lax.scan(step, (before, current, sigma), None, length=_DEGREE - 1)
    return current


def _solve_beside(operator: Operator, vectors: Array, values: Array, right: Array) -> Array:
    """(A - λ_i)⁺ on what is orthogonal to all vectors; it is definite there if all other eigenvalues are larger."""
    product = symmetric(operator, right)

    def project(y: Array) -> Array:
        return y - matmul(vectors, matmul(vectors.T, y))

    def matrix(y: Array) -> Array:
        beside = project(y)
        return project(product(beside) - values * beside) + y - beside

    return project(
        cg(matrix, project(right), tol=10 * float(jnp.finfo(right.dtype).eps), maxiter=_MAX_SOLVER_ITERATIONS)[0]
    )


_beside = Linear(_solve_beside, lambda operator, vectors, values, y: _beside(operator, vectors, values, y))


@partial(_pairs.defjvp, symbolic_zeros=True)
def _pairs_derivative(
    count: int, primals: tuple[Any, Array], tangents: tuple[Any, Any]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """λ̇_i = y_iᵀȦy_i and ẏ_i = (λ_i - A)⁺Ȧy_i, by the pairs that were found and by conjugate gradients beside them."""
    operator, start = primals
    values, vectors = _pairs(count, operator, start)
    changes = changes_of(operator, tangents[0])
    if changes is None:
        return (values, vectors), (jnp.zeros_like(values), jnp.zeros_like(vectors))
    kept, own = vectors[:, :count], values[:count]
    turned = along(lambda changed: symmetric(changed, kept)(kept), operator, changes)
    inside = matmul(kept.T, turned)
    gap = own - own[:, None]
    near = jnp.abs(gap) < 100 * jnp.finfo(own.dtype).eps
    mixed = jnp.where(near, 0, inside / jnp.where(near, 1, gap))
    # What is not asked for has not converged, and is left to the solver.
    rest = _beside(operator, kept, own, -turned)
    moved = jnp.zeros_like(vectors).at[:, :count].set(matmul(kept, mixed) + rest)
    return (values, vectors), (jnp.zeros_like(values).at[:count].set(jnp.diagonal(inside)), moved)
