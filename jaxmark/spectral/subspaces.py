"""Functions of the Laplacian in small subspaces, traced and with derivatives: quadrature, traces, lowest eigenpairs.

Unlike moments, Lanczos iteration also serves functions that no polynomial follows, such as the logarithm near 0.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float

from jaxmark.errors import JaxmarkError
from jaxmark.seeds import Seed, random_key
from jaxmark.spectral.laplacian import Operator, Signal, checked_signal
from jaxmark.spectral.linear import Linear, along
from jaxmark.spectral.precision import matmul
from jaxmark.spectral.recurrence import changes_of, inner_mass

Function = Callable[[Float[Array, " values"]], Float[Array, " values"]]

_GUARDS = 10  # vectors beside those asked for, and a fifth of these, so that the last ones converge, too
_DEGREE = 80  # of the filter of one iteration
_MAX_ITERATIONS = 60
_MAX_SOLVER_ITERATIONS = 2000


@partial(jax.jit, static_argnames=("function", "steps"))
def quadratic_form(operator: Operator, function: Function, x: Signal, *, steps: int) -> Float[Array, " *columns"]:
    """Compute ⟨x, f(Δ)x⟩_M by Gauss quadrature, a scalar or `[C]`, column by column.

    It is exact for polynomials of degree below twice the steps, and converges for any function that is smooth on the
    eigenvalues that `x` has a part of. Reference: Golub, Meurant, "Matrices, Moments and Quadrature with Applications",
    2010, ch. 6. Derivatives with respect to signal and operator, in all modes, come from the same Krylov space: one
    product for each step, and as exact as the value once that has converged (Kandolf, Koskela, Relton, Schweitzer,
    "Computing low-rank approximations of the Fréchet derivative of a matrix function using Krylov subspace methods",
    2021).

    Args:
        operator: the Laplacian, of N vertices.
        function: maps λ in [0, 2] to f(λ), value by value. Calls compile once for each function object, so define it
            outside of loops. It must be finite wherever `x` has a part: leave out the null space of a logarithm by
            `centre`, or by the probes of `white_probes`.
        x: `[N]` or `[N, C]`.
        steps: number of nodes, at least 1. Memory is O(steps · N), as all steps are kept orthogonal to each other.

    Raises:
        JaxmarkError: if shapes do not fit, the signal is neither float32 nor float64, or there is no step.
    """
    return _forms("quadratic_form", operator, function, x, steps)


@partial(jax.jit, static_argnames=("function", "steps"))
def trace(
    operator: Operator, function: Function, probes: Float[Array | np.ndarray, "vertices probes"], *, steps: int
) -> Float[Array, ""]:
    """Estimate Σ_i f(λ_i) over the eigenvalues of Δ above its null space, such as a log-determinant.

    Stochastic Lanczos quadrature (Ubaru, Chen, Saad, "Fast estimation of tr(f(A)) via stochastic Lanczos quadrature",
    2017): the sum of `quadratic_form` over random signals. A density of eigenvalues is that of a narrow bump. For
    derivatives with respect to the operator, signals are held fixed as √M times the probes, whose squares do not depend
    on the mass: so the derivative estimates that of the sum.

    The arguments are those of `quadratic_form`, with probes `[N, probes]` from `white_probes`, which says how large the
    variance is.
    """
    return jnp.sum(_forms("trace", operator, function, probes, steps, held=True))


def _forms(
    name: str, operator: Operator, function: Function, x: Array | np.ndarray, steps: int, held: bool = False
) -> Array:
    """vᵀf(A)v of v = M^½x column by column, one after the other, as each takes the memory of all its steps.

    If v is held fixed, derivatives with respect to the operator do not pass through it.
    """
    x = checked_signal(name, operator, x)
    if steps < 1:
        raise JaxmarkError(f"{name} needs one step or more, got {steps}.")
    root = jnp.sqrt(inner_mass(operator, x))
    v = (jax.lax.stop_gradient(root) if held else root) * x
    columns = jnp.where(operator.linked(v), v, 0).reshape(len(v), -1).T
    one = jax.checkpoint(lambda column: _form(function, steps, operator, column))
    return jax.lax.map(one, columns).reshape(v.shape[1:])


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _form(function: Function, steps: int, operator: Operator, v: Array) -> Array:
    """vᵀf(A)v for A = M^½ΔM^-½, which is symmetric."""
    _, values, parts = _ritz(steps, operator, v)
    return jnp.sum(parts**2 * function(values))


@partial(_form.defjvp, symbolic_zeros=True)
def _form_derivative(
    function: Function, steps: int, primals: tuple[Any, Array], tangents: tuple[Any, Any]
) -> tuple[Array, Array]:
    """2 v̇ᵀf(A)v + Σ_ij c_i c_j f[θ_i, θ_j] y_iᵀȦy_j, with Ritz pairs (θ, y), divided differences and c = yᵀv."""
    operator, v = primals
    changes, v_change = tangents
    vectors, values, parts = _ritz(steps, operator, v)
    gains, slopes = jax.jvp(function, (values,), (jnp.ones_like(values),))
    form = jnp.sum(parts**2 * gains)
    change = jnp.zeros_like(form)
    if not isinstance(v_change, SymbolicZero):
        change += 2 * jnp.vdot(v_change, matmul(vectors, gains * parts))
    moved = changes_of(operator, changes)
    if moved is not None:
        gap = values[:, None] - values
        near = jnp.abs(gap) < jnp.sqrt(jnp.finfo(v.dtype).eps)
        between = jnp.where(near, (slopes[:, None] + slopes) / 2, (gains[:, None] - gains) / jnp.where(near, 1, gap))
        turned = along(lambda changed: symmetric(changed, vectors)(vectors), operator, moved)
        change += jnp.sum(matmul(vectors, between * jnp.outer(parts, parts)) * turned)
    return form, change


def symmetric(operator: Operator, like: Array) -> Callable[[Array], Array]:
    """Return the map y → M^½ΔM^-½ y, in the vertices' order."""
    product, root = operator.product(like), jnp.sqrt(inner_mass(operator, like))
    return lambda y: root * operator.leave(product(operator.enter(y / root)))


def _ritz(steps: int, operator: Operator, v: Array) -> tuple[Array, Array, Array]:
    """Ritz vectors `[N, steps]` and values of A, and the parts of v along them.

    If v lies in a smaller invariant subspace, the steps past it have vectors of zero, and the first step's value.
    """
    product, tiny = symmetric(operator, v), jnp.finfo(v.dtype).tiny
    small = 100 * jnp.finfo(v.dtype).eps
    length = jnp.sqrt(jnp.sum(v**2))
    first = v / jnp.maximum(length, tiny)

    def step(state: tuple[Array, Array], k: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        basis, current = state
        basis = basis.at[k].set(current)
        following = product(current)
        diagonal = jnp.vdot(following, current)
        for _ in range(2):  # two orthogonalisations are enough (Kahan, Parlett)
            following -= matmul(basis.T, matmul(basis, following))
        left = jnp.sqrt(jnp.sum(following**2))
        goes_on = left > small
        following = jnp.where(goes_on, following / jnp.where(goes_on, left, 1), 0)
        return (basis, following), (diagonal, jnp.where(goes_on, left, 0))

    start = jnp.zeros((steps, len(v)), v.dtype), first
    (basis, _), (diagonal, beside) = jax.lax.scan(step, start, jnp.arange(steps))
    alive = jnp.concatenate([jnp.ones(1, bool), jnp.cumprod(beside[:-1] > 0).astype(bool)])
    value = jnp.where(length > 0, diagonal[0], 1)  # a signal of zero has none
    diagonal = jnp.where(alive & (length > 0), diagonal, value)
    matrix = jnp.diag(diagonal) + jnp.diag(beside[:-1], 1) + jnp.diag(beside[:-1], -1)
    values, turn = jnp.linalg.eigh(matrix)
    # The steps past the subspace are decoupled, so that the parts along them are zero but for rounding. They must not
    # count where the function is not finite at the values that rounding gives, such as a logarithm at 0.
    live = jnp.abs(turn[0]) > small
    values = jnp.where(live, values, value)
    return matmul(basis.T, turn), values, jnp.where(live, length * turn[0], 0)


class LowestPairs(NamedTuple):
    """Eigenpairs of Δ from 0 on, ascending; a null vector for each component is among them."""

    values: Float[Array, " pairs"]  # in [0, 2]; times `Laplacian.scale`, those of (D - W)x = λMx
    vectors: Float[Array, "vertices pairs"]  # M-orthonormal; for isolated vertices, see `lowest_eigenpairs`
    residual: Float[Array, ""]  # the largest ‖Δφ - λφ‖_M of a pair


@partial(jax.jit, static_argnames=("count", "dtype"))
def lowest_eigenpairs(operator: Operator, count: int, seed: Seed, *, dtype: Any = jnp.float32) -> LowestPairs:
    """Compute the lowest eigenpairs by iterating subspaces under Chebyshev filters; for up to a hundred of them.

    Unlike `eigenpairs`, which runs on the host, this works under `jit` and `vmap`, and has derivatives with respect to
    the operator, in all modes: as in Magnus, "On differentiating eigenvalues and eigenvectors", 1985, where values are
    apart, also from the first that is left out; turns of vectors within an eigenspace are left out. Reference: Zhou,
    Saad, Tiago, Chelikowsky, "Self-consistent-field calculations using Chebyshev-filtered subspace iteration", 2006.

    `eigenpairs` leaves isolated vertices out. Here shapes are static, so they are filled in after all other pairs, with
    the value 2, the upper bound of the spectrum: only a `count` above the number of vertices with edges shows them.

    Args:
        operator: the Laplacian, of N vertices.
        count: number of pairs, null vectors of components with edges included, at most the number of vertices.
        seed: a number or a JAX random key, of the start of the iteration; converged pairs depend on it by signs, and by
            the bases of eigenspaces.
        dtype: float32 or float64. Iteration ends at a residual of a hundred times its epsilon, or after 60 times.

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
    """Return the map y → Ay, in which isolated vertices have the highest frequency, so that they are left out."""
    product, linked = symmetric(operator, like), operator.linked(like)
    return lambda y: product(y) + jnp.where(linked, 0, 2 * y)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _pairs(count: int, operator: Operator, start: Array) -> tuple[Array, Array]:
    """Compute the lowest eigenpairs of A = M^½ΔM^-½, one per column of the start; `count` have converged."""
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
    """Apply (A - λ_i)⁺ orthogonally to all vectors, where it is definite if all other eigenvalues are larger."""
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
    # The other pairs have not converged, and are left to the solver.
    rest = _beside(operator, kept, own, -turned)
    moved = jnp.zeros_like(vectors).at[:, :count].set(matmul(kept, mixed) + rest)
    return (values, vectors), (jnp.zeros_like(values).at[:count].set(jnp.diagonal(inside)), moved)
