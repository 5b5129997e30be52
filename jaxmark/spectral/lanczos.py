"""Quadratic forms and traces of functions of the Laplacian by Lanczos iteration, traced and with derivatives.

Unlike moments, Lanczos iteration also serves functions that no polynomial follows, such as the logarithm near 0.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.chebyshev import Signal
from jaxmark.spectral.laplacian import Operator, check_signal
from jaxmark.spectral.precision import matmul
from jaxmark.spectral.recurrence import along, changes_of, inner_mass

Function = Callable[[Float[Array, " values"]], Float[Array, " values"]]


@partial(jax.jit, static_argnames=("function", "steps"))
def quadratic_form(operator: Operator, function: Function, x: Signal, *, steps: int) -> Float[Array, " *columns"]:
    """Compute ⟨x, f(Δ)x⟩_M by Gauss quadrature, column by column.

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

    Returns:
        A scalar, or `[C]`.

    Raises:
        JaxmarkError: if shapes do not fit, the signal is neither float32 nor float64, or there is no step.
    """
    x = jnp.asarray(x)
    check_signal("quadratic_form", operator, x)
    _check_steps("quadratic_form", steps)
    return _forms(operator, function, jnp.sqrt(inner_mass(operator, x)) * x, steps)


@partial(jax.jit, static_argnames=("function", "steps"))
def trace(
    operator: Operator, function: Function, probes: Float[Array | np.ndarray, "vertices probes"], *, steps: int
) -> Float[Array, ""]:
    """Estimate Σ_i f(λ_i) over the eigenvalues of Δ above its null space, such as a log-determinant.

    Stochastic Lanczos quadrature (Ubaru, Chen, Saad, "Fast estimation of tr(f(A)) via stochastic Lanczos quadrature",
    2017): the sum of `quadratic_form` over random signals. A density of eigenvalues is that of a narrow bump. For
    derivatives with respect to the operator, signals are held fixed as √M times the probes, whose squares do not depend
    on the mass: so the derivative estimates that of the sum.

    Args:
        operator: see `quadratic_form`.
        function: see `quadratic_form`.
        probes: from `white_probes`, which says how large the variance is.
        steps: see `quadratic_form`.
    """
    u = jnp.asarray(probes)
    check_signal("trace", operator, u)
    _check_steps("trace", steps)
    return jnp.sum(_forms(operator, function, jax.lax.stop_gradient(jnp.sqrt(inner_mass(operator, u))) * u, steps))


def _check_steps(name: str, steps: int) -> None:
    if steps < 1:
        raise JaxmarkError(f"{name} needs one step or more, got {steps}.")


def _forms(operator: Operator, function: Function, v: Array, steps: int) -> Array:
    """vᵀf(A)v column by column, one after the other, as each takes the memory of all its steps."""
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
    gains, slopes = function(values), _slopes(function, values)
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


def _slopes(function: Function, values: Array) -> Array:
    return jax.jvp(function, (values,), (jnp.ones_like(values),))[1]


def symmetric(operator: Operator, like: Array) -> Callable[[Array], Array]:
    """The map y → M^½ΔM^-½ y, in the vertices' order."""
    product, root = operator.product(like), jnp.sqrt(inner_mass(operator, like))
    return lambda y: root * operator.leave(product(operator.enter(y / root)))


def _ritz(steps: int, operator: Operator, v: Array) -> tuple[Array, Array, Array]:
    """Ritz vectors `[N, steps]` and values of A, and the parts of v along them.

    Where v lies in a smaller invariant subspace, what is past it has vectors of zero, and the first step's value.
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
    # What is past the subspace is decoupled, so that the parts along it are zero but for rounding, which must not count
    # where the function has none of the values that rounding gives, such as a logarithm's at 0.
    live = jnp.abs(turn[0]) > small
    values = jnp.where(live, values, value)
    return matmul(basis.T, turn), values, jnp.where(live, length * turn[0], 0)
