"""The recurrence of Chebyshev polynomials, and its derivatives of any order and mode in O(N) memory.

A filter f(Δ)x = Σ_k c_k T_k(Δ̃)x is linear in c and in x, and a projection p_k = Σ_v u_v (T_k(Δ̃)x)_v is linear in u and
in x. As Δ is self-adjoint, each is the other's transpose, so that derivatives of any order are filters and projections
again. So are the components of a bank of filters and their synthesis, and convolutions with matrices of weights. For
the derivative with respect to the operator, the recurrence is run backwards: T_{k-2} = 2Δ̃T_{k-1} - T_k.

Here, terms come first, as a scan takes them: coefficients are `[terms]` for signals `[N]`, `[terms, C]` for signals
`[N, C]`, and `[terms, inputs, outputs]` of convolutions; only those of a bank are `[bands, terms]`. Nothing is checked.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, PyTree

from jaxmark.spectral.kernels import Computation, component_rows, filter_rows, installed, project_rows, where_installed
from jaxmark.spectral.laplacian import MIN_LARGE_VALUES, Operator, per_row
from jaxmark.spectral.linear import Linear, along, combine, floats
from jaxmark.spectral.precision import einsum, matmul

_ROWS_AT_ONCE = 512  # rows that are summed as one wide row
_MAX_SUMMED_COLUMNS = 6  # up to which sums took less time than matrix products, by measurement
_UNROLLED_ON_GPU = 5  # steps, by measurement


def _scan_terms(
    operator: Operator,
    x: Array,
    data: Array,
    step: Callable[[Any, Array, Array, Array], tuple[Any, Any]],
    start: Any,
) -> tuple[Any, Any]:
    """Run `step(carry, T_k x, T_{k-1} x, data[k])` over k = 1 … len(data) - 1; callers treat T_0 x = x themselves.

    Rows are in the operator's own order.
    """
    product = operator.product(x)

    def body(state: tuple[Array, Array, Any], inputs: tuple[Array, Array]) -> tuple[tuple[Array, Array, Any], Any]:
        before, current, carry = state
        factor, datum = inputs
        following = factor * (product(current) - current) - before
        carry, output = step(carry, following, current, datum)
        return (current, following, carry), output

    # Unrolling saves a copy of the carry in each step, but leaves more to compile. On GPUs, bodies of some more steps
    # are launched as one.
    unroll = _UNROLLED_ON_GPU if jax.default_backend() == "gpu" else 3 if x.size >= MIN_LARGE_VALUES else 1
    (_, _, carry), outputs = jax.lax.scan(
        body, (jnp.zeros_like(x), x, start), (_factors(len(data), x), data[1:]), unroll=unroll
    )
    return carry, outputs


def _factors(terms: int, x: Array) -> Array:
    """Return the factors of the recurrence from T_1 on; T_1 = Δ̃T_0 is a step with factor 1 and T_{-1} = 0."""
    factors = np.full(terms - 1, 2, x.dtype)
    factors[:1] = 1
    return jnp.asarray(factors)


@dataclass(frozen=True)
class Family:
    """Filters of one kind, Σ_k mix(T_k(Δ̃)x, w_k), by the bilinear maps that they and their derivatives are made of."""

    mix: Callable[[Array, Array], Array]  # of rows and the weights of one term
    pair: Callable[[Array, Array], Array]  # ⟨w, pair(t, y)⟩ = ⟨mix(t, w), y⟩
    turn: Callable[[Array], Array]  # ⟨t, mix(y, turn(w))⟩ = ⟨mix(t, w), y⟩, also for the weights of all terms at once
    filter_kernel: Computation | None = None  # of rows, weights and signal
    project_kernel: Computation | None = None  # of the number of terms, rows and two signals


@partial(jax.jit, static_argnums=0)
def _filter_scan(family: Family, operator: Operator, w: Array, x: Array) -> Array:
    """Filter a signal without rules of its own; see `_filtered`."""

    def add(total: Array, t: Array, _: Array, w_k: Array) -> tuple[Array, None]:
        return total + family.mix(t, w_k), None

    x = operator.enter(x)
    return operator.leave(_scan_terms(operator, x, w, add, family.mix(x, w[0]))[0])


@partial(jax.jit, static_argnums=(0, 1))
def _projection_scan(family: Family, terms: int, operator: Operator, x: Array, y: Array) -> Array:
    """Pair T_k(Δ̃)x with y, for each of so many k."""
    x, y = operator.enter(x), operator.enter(y)

    def project(_: None, t: Array, __: Array, ___: Array) -> tuple[None, Array]:
        return None, family.pair(t, y)

    _, rest = _scan_terms(operator, x, jnp.zeros(terms, x.dtype), project, None)
    return jnp.concatenate([family.pair(x, y)[None], rest])


def _pulled_back(family: Family, operator: Operator, w: Array, x: Array, y: Array) -> list[Array]:
    """Compute the gradient of Σ_k ⟨mix(T_k(Δ̃)x, w_k), y⟩ by the operator's floating leaves, in O(N) memory.

    With z_k = mix(y, turn(w_k)) and b_k = z_k + 2Δ̃ᵀb_{k+1} - b_{k+2}, it is the sum of the gradients of
    ⟨b_{k+1}, 2Δ T_k x⟩ over k, where b and T are held fixed, and the factor 2 is 1 at k = 0. Both recurrences run
    downwards, that of T from its last two terms.
    """
    mass = inner_mass(operator, x)
    x, y, mass = (operator.enter(rows) for rows in (x, y, mass))
    product = operator.product(x)
    (last, before), _ = _scan_terms(
        operator, x, w, lambda _, t, before, __: ((t, before), None), (x, jnp.zeros_like(x))
    )
    factors = _factors(len(w), x)

    # Sums over edges have derivatives that only read rows; those of tables would add to them.
    edgewise = operator.by_segments
    parts = jax.tree.leaves(floats(edgewise))

    def edgewise_product(parts: list[Array], rows: Array) -> Array:
        return combine(parts, edgewise).product(rows)(rows)

    def down(state: Any, inputs: tuple[Array, Array]) -> tuple[Any, None]:
        t, following, b, b_after, total = state
        factor, w_k = inputs
        rows = operator.leave(t)
        _, pull = jax.vjp(lambda parts: edgewise_product(parts, rows), parts)
        total = jax.tree.map(jnp.add, total, pull(operator.leave(factor * b))[0])
        scaled = b / mass
        b_before = family.mix(y, family.turn(w_k)) + factor * mass * (product(scaled) - scaled) - b_after
        return (factor * (product(t) - t) - following, t, b_before, b, total), None

    start = (before, last, family.mix(y, family.turn(w[-1])), jnp.zeros_like(x), jax.tree.map(jnp.zeros_like, parts))
    (*_, total), _ = jax.lax.scan(down, start, (factors, w[:-1]), reverse=True)
    return total


def changes_of(primal: PyTree, tangents: Any) -> PyTree | None:
    """Convert the tangents of an argument of a `jax.custom_jvp` rule for `along`; None if it does not change."""
    leaves: list[Any] = jax.tree.leaves(tangents, is_leaf=lambda leaf: isinstance(leaf, SymbolicZero))
    if all(isinstance(leaf, SymbolicZero) for leaf in leaves):
        return None
    part = [
        (jnp.zeros(leaf.shape, leaf.dtype) if isinstance(leaf, SymbolicZero) else leaf)  # pyright: ignore[reportArgumentType]
        if jnp.issubdtype(leaf.dtype, jnp.inexact)
        else None
        for leaf in leaves
    ]
    return jax.tree.unflatten(jax.tree.structure(primal), part)


@cache
def _changed(family: Family) -> Linear:
    """Return the derivative of a filter in the direction of a change of the operator's floating leaves."""
    return Linear(
        lambda operator, w, x, change: along(lambda changed: _filter_scan(family, changed, w, x), operator, change),
        partial(_pulled_back, family),
    )


@cache
def _filtered(family: Family) -> Linear:
    """Make a filter as a function of the signal: `(operator, w, x)`."""
    scan = partial(_filter_scan, family)

    def transposed(operator: Operator, w: Array, y: Array) -> Array:
        mass = inner_mass(operator, y)
        return mass * _filtered(family)(operator, family.turn(w), y / mass)

    return Linear(
        scan,
        transposed,
        (_changed(family), lambda operator, w, x, change: _of_weights(family, len(w))(operator, x, change)),
        _changed_jointly(family),
        where_installed(family.filter_kernel, scan),
    )


@cache
def _changed_jointly(family: Family) -> Linear:
    """Return the derivative of a filter in directions of weights and signal: `(operator, w, x, (change, change))`."""

    def apply(operator: Operator, w: Array, x: Array, changes: tuple[Array, Array]) -> Array:
        of_w, of_x = changes
        return _filtered(family)(operator, w, of_x) + _of_weights(family, len(w))(operator, x, of_w)

    def transposed(operator: Operator, w: Array, x: Array, y: Array) -> tuple[Array, Array]:
        mass = inner_mass(operator, y)
        of_x, of_w = _filter_and_projection(family, operator, family.turn(w), y / mass, mass * x)
        return family.turn(of_w), mass * of_x

    return Linear(apply, transposed)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _filter_and_projection(family: Family, operator: Operator, w: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Filter a signal, and pair T_k(Δ̃)x with y for each k, by one recurrence."""
    if installed() and jax.default_backend() == "cpu":
        # Kernels have one recurrence each, and take less time for two than the scan for one.
        return _filtered(family)(operator, w, x), projection(len(w), family)(operator, x, y)
    x, y = operator.enter(x), operator.enter(y)

    def add(total: Array, t: Array, _: Array, w_k: Array) -> tuple[Array, Array]:
        return total + family.mix(t, w_k), family.pair(t, y)

    total, rest = _scan_terms(operator, x, w, add, family.mix(x, w[0]))
    return operator.leave(total), jnp.concatenate([family.pair(x, y)[None], rest])


@partial(_filter_and_projection.defjvp, symbolic_zeros=True)
def _change_of_both(family: Family, primals: Any, tangents: Any) -> tuple[Any, Any]:
    """Differentiate the two one by one, by their own rules."""
    operator, w, x, y = primals
    of_operator, of_w, of_x, of_y = (changes_of(*pair) for pair in zip(primals, tangents, strict=True))

    def change(rule: Linear, arguments: tuple[Any, ...], changes: tuple[Any, ...], like: Array) -> Array:
        found = [rule.derivative(i, arguments, part) for i, part in enumerate(changes) if part is not None]
        return sum(found, jnp.zeros_like(like))

    values = _filter_and_projection(family, operator, w, x, y)
    filtering, pairing = _filtered(family), projection(len(w), family)
    return values, (
        change(filtering, (operator, w, x), (of_operator, of_w, of_x), values[0]),
        change(pairing, (operator, x, y), (of_operator, of_x, of_y), values[1]),
    )


@cache
def _of_weights(family: Family, terms: int) -> Linear:
    """Make a filter as a function of its weights: `(operator, x, w)`."""
    scan = partial(_filter_scan, family)
    on_processors = where_installed(family.filter_kernel, scan)
    return Linear(
        lambda operator, x, w: scan(operator, w, x),
        lambda operator, x, y: projection(terms, family)(operator, x, y),
        (
            lambda operator, x, w, change: _changed(family)(operator, w, x, change),
            lambda operator, x, w, change: _filtered(family)(operator, w, change),
        ),
        on_processors=lambda operator, x, w: on_processors(operator, w, x),
    )


@cache
def _changed_projection(family: Family, terms: int) -> Linear:
    """Return the derivative of a projection in the direction of a change of the operator's floating leaves."""
    scan = partial(_projection_scan, family, terms)
    return Linear(
        lambda operator, x, y, change: along(lambda changed: scan(changed, x, y), operator, change),
        lambda operator, x, y, w: _pulled_back(family, operator, w, x, y),
    )


#: Filters with a series for each column, Σ_k c_k T_k(Δ̃)x, with projections Σ_v u_v (T_k(Δ̃)x)_v.
COLUMNS = Family(lambda t, c: c * t, lambda t, u: _sums(u * t), lambda c: c, filter_rows, project_rows)


@cache
def projection(terms: int, family: Family = COLUMNS) -> Linear:
    """Make the map from y to the pairings ⟨T_k(Δ̃)x, y⟩ for all k < `terms`: `(operator, x, y)`."""
    scan = partial(_projection_scan, family, terms)

    def by_signal(operator: Operator, x: Array, y: Array, change: Array) -> Array:
        mass = inner_mass(operator, y)
        return family.turn(projection(terms, family)(operator, y / mass, mass * change))

    return Linear(
        scan,
        lambda operator, x, w: _of_weights(family, terms)(operator, x, w),
        (_changed_projection(family, terms), by_signal),
        on_processors=where_installed(family.project_kernel and partial(family.project_kernel, terms), scan),
    )


def _mix(x: Array, weight: Array) -> Array:
    """Compute the product xW; few columns are summed one by one, as narrow matrices are slow on processors."""
    if x.shape[1] > _MAX_SUMMED_COLUMNS:
        return matmul(x, weight)
    return sum((x[:, i, None] * weight[i] for i in range(1, x.shape[1])), x[:, :1] * weight[0])


filter_scan = partial(_filter_scan, COLUMNS)

#: f(Δ)x as a function of x: `(operator, c, x)`.
filtered = _filtered(COLUMNS)

#: Σ_k T_k(Δ̃)x W_k as a function of x `[N, inputs]`: `(operator, W, x)` with W `[terms, inputs, outputs]`.
convolution = _filtered(Family(_mix, lambda t, y: matmul(t.T, y), lambda w: w.mT))


def solve(
    apply: Callable[[Array], Array], right: Array, mass: Array, iterations: int, tolerance: float | None = None
) -> Array:
    """Solve f(Δ)x = `right` by conjugate gradients, for the map x → f(Δ)x of a positive f; see `filter_rational`."""
    root, tolerance = jnp.sqrt(mass), 10 * float(jnp.finfo(right.dtype).eps) if tolerance is None else tolerance
    z, _ = cg(lambda z: root * apply(z / root), root * right, tol=tolerance, maxiter=iterations)
    return z / root


def inner_mass(operator: Operator, x: Array) -> Array:
    """Return the mass of each vertex, or 1 at vertices without mass, for which any mass is correct."""
    mass = per_row(operator.mass, x)
    return jnp.where(mass > 0, mass, 1)


def _sums(x: Array) -> Array:
    """Sum over vertices, column by column; many rows at a time, because few columns are summed slowly."""
    whole = len(x) // _ROWS_AT_ONCE * _ROWS_AT_ONCE
    wide = x[:whole].reshape(-1, _ROWS_AT_ONCE * (x.size // max(len(x), 1))).sum(axis=0)
    return wide.reshape(_ROWS_AT_ONCE, *x.shape[1:]).sum(axis=0) + x[whole:].sum(axis=0)


@jax.jit
def _components_scan(operator: Operator, c: Array, x: Array) -> Array:
    def add(total: Array, t: Array, _: Array, c_k: Array) -> tuple[Array, None]:
        return total + jnp.multiply.outer(c_k, t), None

    x = operator.enter(x)
    return jax.vmap(operator.leave)(_scan_terms(operator, x, c.T, add, jnp.multiply.outer(c[:, 0], x))[0])


@jax.jit
def _synthesis_scan(operator: Operator, c: Array, parts: Array) -> Array:
    """Clenshaw's recurrence, on all parts at once."""
    product, parts = operator.product(parts[0]), jax.vmap(operator.enter)(parts)

    def step(state: tuple[Array, Array], c_k: Array) -> tuple[tuple[Array, Array], None]:
        current, before = state
        following = einsum("j,j...->...", c_k, parts) + 2 * (product(current) - current) - before
        return (following, current), None

    zero = jnp.zeros_like(parts[0])
    (current, before), _ = jax.lax.scan(step, (zero, zero), c.T[:0:-1])
    return operator.leave(einsum("j,j...->...", c[:, 0], parts) + (product(current) - current) - before)


def _per_column(c: Array, x: Array) -> Array:
    """Return the coefficients of a bank for each column of a signal."""
    return c if x.ndim == 1 else jnp.broadcast_to(c[..., None], (*c.shape, x.shape[1]))


#: All g_j(Δ)x as a function of x: `(operator, c, x)`.
components = Linear(
    _components_scan,
    lambda operator, c, y: inner_mass(operator, y[0]) * synthesis(operator, c, y / inner_mass(operator, y[0])),
    (
        lambda operator, c, x, change: jax.vmap(_changed(COLUMNS), (None, 0, None, None))(
            operator, _per_column(c, x), x, change
        ),
        lambda operator, c, x, change: jax.vmap(_of_weights(COLUMNS, c.shape[1]), (None, None, 0))(
            operator, x, _per_column(change, x)
        ),
    ),
    on_processors=where_installed(component_rows, _components_scan),
)

#: Σ_j g_j(Δ)y_j as a function of all y_j: `(operator, c, y)`.
synthesis = Linear(
    _synthesis_scan,
    lambda operator, c, x: inner_mass(operator, x) * components(operator, c, x / inner_mass(operator, x)),
    (
        lambda operator, c, y, change: jax.vmap(_changed(COLUMNS), (None, 0, 0, None))(
            operator, _per_column(c, y[0]), y, change
        ).sum(axis=0),
        lambda operator, c, y, change: jax.vmap(_of_weights(COLUMNS, c.shape[1]), (None, 0, 0))(
            operator, y, _per_column(change, y[0])
        ).sum(axis=0),
    ),
)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def moments(operator: Operator, x: Array, degree: int) -> Array:
    """Compute ⟨x, T_k(Δ̃)x⟩_M for k = 0 … 2·degree; see `chebyshev.moments`."""
    x, mass = operator.enter(x), operator.enter(per_row(operator.mass, x))

    def products(_: None, t: Array, before: Array, __: Array) -> tuple[None, tuple[Array, Array]]:
        return None, (_sums(mass * t * before), _sums(mass * t * t))

    _, (odd, even) = _scan_terms(operator, x, jnp.zeros(degree + 1, x.dtype), products, None)
    m0 = jnp.sum(mass * x * x, axis=0)[None]
    if degree == 0:
        return m0
    pairs = jnp.stack([2 * odd - odd[0], 2 * even - m0], axis=1)
    return jnp.concatenate([m0, pairs.reshape(2 * degree, *x.shape[1:])])


@partial(moments.defjvp, symbolic_zeros=True)
def _moments_derivative(degree: int, primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Array, Array]:
    """Return the derivative 2⟨x, T_k(Δ̃)ẋ⟩_M, as T_k(Δ̃) is self-adjoint, and that of the operator beside."""
    operator, x = primals
    changes, x_change = tangents
    value = moments(operator, x, degree)
    change = jnp.zeros_like(value)
    if not isinstance(x_change, SymbolicZero):
        change += 2 * projection(2 * degree + 1)(operator, x, per_row(operator.mass, x) * x_change)
    moved = changes_of(operator, changes)
    if moved is not None:

        def of_operator(changed: Operator) -> Array:
            return projection(2 * degree + 1)(changed, x, per_row(changed.mass, x) * x)

        change += along(of_operator, operator, moved)
    return value, change
