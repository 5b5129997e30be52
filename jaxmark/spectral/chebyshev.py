"""Polynomials of the Laplacian by the three-term recurrence, with derivatives in O(N) memory.

The spectrum of Δ̃ = Δ - I lies in [-1, 1], and T_k(Δ̃)x follows by T_k = 2Δ̃T_{k-1} - T_{k-2} (Sohn et al., Method 2; the
paper's start t_0 = 0, T_0 = 0 is an erratum for t_0 = 1, T_0 = I). All functions here take signals `[N]` or `[N, C]`,
keep the dtype of the signal, and cost `degree` products with Δ.

A filter f(Δ)x = Σ_k c_k T_k(Δ̃)x is linear in c and in x, and a projection p_k = Σ_v u_v (T_k(Δ̃)x)_v is linear in u and
in x. As Δ is self-adjoint, each is the other's transpose, so that derivatives of any order are filters and projections
again. For the derivative with respect to the operator, the recurrence is run backwards: T_{k-2} = 2Δ̃T_{k-1} - T_k.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, PyTree

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.laplacian import Laplacian, Operator, check_signal, per_row
from jaxmark.spectral.linear import Linear, combine, floats
from jaxmark.spectral.precision import einsum, matmul

Signal = Float[Array | np.ndarray, " vertices *columns"]

_BANDS_AT_ONCE = 5  # band components that are formed together where each is used only once
_ROWS_AT_ONCE = 128  # rows that are summed as one wide row
_MIN_UNROLLED_VALUES = 2**16  # values of a signal from which on running the recurrence takes longer than compiling it


@jax.jit
def filter(
    operator: Operator, coefficients: Float[Array | np.ndarray, " terms *filters"], x: Signal
) -> Float[Array, " vertices *columns"]:
    """Filter a signal: f(Δ)x for the Chebyshev series f(λ) = Σ_k c_k T_k(λ - 1), as one `lax.scan`.

    Derivatives of any order and mode are with respect to the coefficients, the signal and the operator's weights,
    degrees and mass. The first, in reverse mode too, take O(N) memory at any degree, and so do forward-mode derivatives
    of these, such as products with Hessians. Reverse mode takes one filter for the signal and one for the coefficients;
    for the operator, it runs the recurrence back and forth, which takes about six filters.

    Args:
        operator: the Laplacian, of N vertices.
        coefficients: `[degree + 1]`, or `[degree + 1, C]` for one filter per column of `x`.
        x: `[N]` or `[N, C]`.

    Returns:
        f(Δ)x, in the shape and dtype of `x`.

    Raises:
        JaxmarkError: if shapes do not fit, or the signal is neither float32 nor float64.
    """
    x = jnp.asarray(x)
    check_signal("filter", operator, x)
    c = jnp.asarray(coefficients).astype(x.dtype)
    if c.ndim not in (1, 2) or len(c) == 0 or (c.ndim == 2 and c.shape[1:] != x.shape[1:]):
        raise JaxmarkError(
            f"filter needs coefficients [degree + 1] or [degree + 1, C] for a signal {x.shape}, got {c.shape}."
        )
    return _filter(operator, c if c.ndim == x.ndim else jnp.broadcast_to(c[:, None], (len(c), x.shape[1])), x)


@jax.jit
def transpose(
    operator: Operator, coefficients: Float[Array | np.ndarray, " terms *filters"], y: Signal
) -> Float[Array, " vertices *columns"]:
    """f(Δ)ᵀy = M f(Δ) M⁻¹y, by the self-adjointness of Δ: the Euclidean adjoint of `filter`, with its arguments."""
    y = jnp.asarray(y)
    mass = _inner_mass(operator, y)
    return mass * filter(operator, coefficients, y / mass)


@jax.jit
def band_components(
    operator: Laplacian, coefficients: Float[Array | np.ndarray, "bands terms"], x: Signal
) -> Float[Array, "bands vertices *columns"]:
    """Compute all band components f_j(Δ)x in one pass of `degree` products; O(bands · N) memory.

    Args:
        operator: the Laplacian, of N vertices.
        coefficients: one Chebyshev series per row, `[bands, degree + 1]`.
        x: `[N]` or `[N, C]`.

    Returns:
        `[bands, N]` or `[bands, N, C]`.
    """
    x = jnp.asarray(x)
    check_signal("band_components", operator, x)
    c = _check_bands(coefficients).astype(x.dtype)
    x = operator.enter(x)

    def add(total: Array, t: Array, _: Array, c_k: Array) -> tuple[Array, None]:
        return total + jnp.multiply.outer(c_k, t), None

    return jax.vmap(operator.leave)(_scan_terms(operator, x, c.T, add, jnp.multiply.outer(c[:, 0], x))[0])


@partial(jax.jit, static_argnums=0)
def over_bands(
    function: Callable[[Float[Array, " vertices *columns"]], Any],
    operator: Laplacian,
    coefficients: Float[Array | np.ndarray, "bands terms"],
    x: Signal,
) -> Any:
    """Apply a function to each band component f_j(Δ)x, a few at a time, so that it takes O(N) memory.

    Args:
        function: maps one component, in the shape of `x`, to an array or a tuple of arrays. Eager calls compile once
            for each function object, so define it outside of loops.
        operator: see `band_components`.
        coefficients: see `band_components`.
        x: see `band_components`.

    Returns:
        The function's results, stacked along a leading axis of bands.
    """
    c = _check_bands(coefficients)
    groups = jnp.pad(c, ((0, -len(c) % _BANDS_AT_ONCE), (0, 0))).reshape(-1, _BANDS_AT_ONCE, c.shape[1])

    @jax.checkpoint
    def over_group(group: Array) -> Any:
        return jax.vmap(function)(band_components(operator, group, x))

    found = jax.lax.map(over_group, groups)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[: len(c)], found)


@partial(jax.jit, static_argnames="degree")
def cross_moments(operator: Laplacian, u: Signal, x: Signal, *, degree: int) -> Float[Array, " terms *columns"]:
    """Compute ⟨u, T_k(Δ̃)x⟩_M for k = 0 … degree, column by column.

    They give the correlation of `u` with every band: ⟨u, f_j(Δ)x⟩_M = Σ_k C_jk ⟨u, T_k x⟩_M. Weak bands are then small
    differences of large numbers: in float32 a band is lost where ‖f_j x‖ is below about 1e-6 ‖x‖. Derivatives are as
    those of `filter`.

    Args:
        operator: the Laplacian, of N vertices.
        u: `[N]` or `[N, C]`.
        x: in the shape of `u`.
        degree: the largest k.

    Returns:
        `[degree + 1]` or `[degree + 1, C]`.

    Raises:
        JaxmarkError: if shapes do not fit, or the signal is neither float32 nor float64.
    """
    x = jnp.asarray(x)
    u = jnp.asarray(u).astype(x.dtype)
    check_signal("cross_moments", operator, x)
    if u.shape != x.shape:
        raise JaxmarkError(f"cross_moments needs two signals of one shape, got {u.shape} and {x.shape}.")
    return _projection(degree + 1)(operator, x, per_row(operator.mass, u) * u)


def band_energies(
    operator: Laplacian,
    coefficients: Float[Array, "bands terms"],
    u: Float[Array, "vertices columns"],
    v: Float[Array, "vertices columns"],
) -> Float[Array, " bands"]:
    """⟨u, f_j(Δ)v⟩ for each band, with vertices weighed by mass over its mean; of unit noise, the dimensions."""
    moments = cross_moments(operator, u, v, degree=coefficients.shape[1] - 1)
    mass = jnp.asarray(operator.mass).astype(u.dtype)
    return matmul(coefficients, moments.sum(axis=1)) * (jnp.sum(jnp.sign(mass)) / mass.sum())


@partial(jax.jit, static_argnames="degree")
def moments(operator: Laplacian, x: Signal, *, degree: int) -> Float[Array, " moments *columns"]:
    """Compute the moments m_k = ⟨x, T_k(Δ̃)x⟩_M for k = 0 … 2·degree by only `degree` products, column by column.

    By T_{j+k} + T_{|j-k|} = 2T_jT_k: m_2k = 2⟨T_k x, T_k x⟩_M - m_0 and m_{2k-1} = 2⟨T_k x, T_{k-1} x⟩_M - m_1.
    Derivatives are those of `cross_moments` of twice the degree.

    Args:
        operator: the Laplacian, of N vertices.
        x: `[N]` or `[N, C]`.
        degree: number of products, half of the largest k.

    Returns:
        `[2 · degree + 1]` or `[2 · degree + 1, C]`.

    Raises:
        JaxmarkError: if shapes do not fit, or the signal is neither float32 nor float64.
    """
    x = jnp.asarray(x)
    check_signal("moments", operator, x)
    return _moments(operator, x, degree)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _moments(operator: Operator, x: Array, degree: int) -> Array:
    x, mass = operator.enter(x), operator.enter(per_row(operator.mass, x))

    def products(_: None, t: Array, before: Array, __: Array) -> tuple[None, tuple[Array, Array]]:
        return None, (_sums(mass * t * before), _sums(mass * t * t))

    _, (odd, even) = _scan_terms(operator, x, jnp.zeros(degree + 1, x.dtype), products, None)
    m0 = jnp.sum(mass * x * x, axis=0)[None]
    if degree == 0:
        return m0
    pairs = jnp.stack([2 * odd - odd[0], 2 * even - m0], axis=1)
    return jnp.concatenate([m0, pairs.reshape(2 * degree, *x.shape[1:])])


@partial(_moments.defjvp, symbolic_zeros=True)
def _moments_derivative(degree: int, primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Array, Array]:
    """The derivative 2⟨x, T_k(Δ̃)ẋ⟩_M, as T_k(Δ̃) is self-adjoint, and that of the operator beside."""
    operator, x = primals
    changes, x_change = tangents
    value = _moments(operator, x, degree)
    change = jnp.zeros_like(value)
    if not isinstance(x_change, SymbolicZero):
        change += 2 * _projection(2 * degree + 1)(operator, x, per_row(operator.mass, x) * x_change)
    leaves = jax.tree.leaves(changes, is_leaf=lambda leaf: isinstance(leaf, SymbolicZero))
    if any(not isinstance(leaf, SymbolicZero) for leaf in leaves):
        part = [
            jnp.zeros(leaf.shape, leaf.dtype) if isinstance(leaf, SymbolicZero) else leaf
            for leaf in leaves
            if jnp.issubdtype(leaf.dtype, jnp.inexact)
        ]

        def of_operator(part: list[Array]) -> Array:
            return cross_moments(combine(part, operator), x, x, degree=2 * degree)

        change += jax.jvp(of_operator, (jax.tree.leaves(floats(operator)),), (part,))[1]
    return value, change


@partial(jax.jit, static_argnames="method")
def gram(
    operator: Laplacian,
    coefficients: Float[Array | np.ndarray, "bands terms"],
    x: Signal,
    *,
    method: Literal["bands", "moments"] = "bands",
) -> Float[Array, "*columns bands bands"]:
    """Gram matrix ⟨f_i(Δ)x, f_j(Δ)x⟩_M of the band components, one for each column of `x`.

    Args:
        operator: the Laplacian, of N vertices.
        coefficients: one Chebyshev series per row, `[bands, degree + 1]`.
        x: `[N]` or `[N, C]`.
        method: `"bands"` forms the components; it takes O(bands · N) memory and is accurate for weak bands. `"moments"`
            takes O(N) memory by ⟨T_j x, T_k x⟩_M = (m_{j+k} + m_{|j-k|})/2, but entries below about eps · ‖x‖² are
            rounding noise: use it in float64, or where no band is weak.

    Returns:
        `[bands, bands]`, or `[C, bands, bands]` for `[N, C]`.
    """
    check_signal("gram", operator, x)
    c = _check_bands(coefficients).astype(x.dtype)
    match method:
        case "bands":
            y = band_components(operator, c, x)
            return einsum("v,iv...,jv...->...ij", jnp.asarray(operator.mass).astype(x.dtype), y, y)
        case "moments":
            terms = c.shape[1]
            m = moments(operator, x, degree=terms - 1)
            j, k = np.indices((terms, terms))
            return einsum("ij,jk...,lk->...il", c, (m[j + k] + m[np.abs(j - k)]) / 2, c)
    raise JaxmarkError(f"gram(method=...) must be 'bands' or 'moments', got {method!r}.")


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

    # T_1 = Δ̃T_0 is the recurrence with factor 1 and T_{-1} = 0.
    factors = jnp.full(len(data) - 1, 2, x.dtype).at[:1].set(1)
    # Unrolling saves a copy of the carry in each step, but leaves more to compile.
    unroll = 3 if x.size >= _MIN_UNROLLED_VALUES else 1
    (_, _, carry), outputs = jax.lax.scan(body, (jnp.zeros_like(x), x, start), (factors, data[1:]), unroll=unroll)
    return carry, outputs


@jax.jit
def _filter_scan(operator: Operator, coefficients: Array, x: Array) -> Array:
    def add(total: Array, t: Array, _: Array, c_k: Array) -> tuple[Array, None]:
        return total + c_k * t, None

    x = operator.enter(x)
    return operator.leave(_scan_terms(operator, x, coefficients, add, coefficients[0] * x)[0])


@partial(jax.jit, static_argnums=0)
def _projection_scan(terms: int, operator: Operator, x: Array, u: Array) -> Array:
    """Compute Σ_v u_v (T_k(Δ̃)x)_v for so many k, column by column."""
    u, x = operator.enter(u), operator.enter(x)

    def project(_: None, t: Array, __: Array, ___: Array) -> tuple[None, Array]:
        return None, _sums(u * t)

    _, rest = _scan_terms(operator, x, jnp.zeros(terms, x.dtype), project, None)
    return jnp.concatenate([_sums(u * x)[None], rest])


def _transposed_filter(operator: Operator, c: Array, y: Array) -> Array:
    mass = _inner_mass(operator, y)
    return mass * _filter(operator, c, y / mass)


def _pulled_back(operator: Operator, c: Array, x: Array, y: Array) -> list[Array]:
    """The gradient of ⟨y, Σ_k c_k T_k(Δ̃)x⟩ with respect to the floating leaves of the operator, in O(N) memory.

    With b_k = c_k y + 2Δ̃ᵀb_{k+1} - b_{k+2}, it is the sum of the gradients of ⟨b_{k+1}, 2Δ T_k x⟩ over k, where b and T
    are held fixed, and the factor 2 is 1 at k = 0. Both recurrences run downwards, that of T from its last two terms.
    """
    mass = _inner_mass(operator, x)
    x, y, mass = (operator.enter(rows) for rows in (x, y, mass))
    product = operator.product(x)

    def up(state: tuple[Array, Array], factor: Array) -> tuple[tuple[Array, Array], None]:
        before, t = state
        return (t, factor * (product(t) - t) - before), None

    factors = jnp.full(len(c) - 1, 2, x.dtype).at[:1].set(1)
    (before, last), _ = jax.lax.scan(up, (jnp.zeros_like(x), x), factors)

    # Sums over edges have derivatives that only read rows; those of tables would add to them.
    edgewise = operator.by_segments
    parts = jax.tree.leaves(floats(edgewise))

    def edgewise_product(parts: list[Array], rows: Array) -> Array:
        return combine(parts, edgewise).product(rows)(rows)

    def down(state: Any, inputs: tuple[Array, Array]) -> tuple[Any, None]:
        t, following, b, b_after, total = state
        factor, c_k = inputs
        rows = operator.leave(t)
        _, pull = jax.vjp(lambda parts: edgewise_product(parts, rows), parts)
        total = jax.tree.map(jnp.add, total, pull(operator.leave(factor * b))[0])
        scaled = b / mass
        b_before = c_k * y + factor * mass * (product(scaled) - scaled) - b_after
        return (factor * (product(t) - t) - following, t, b_before, b, total), None

    start = (before, last, c[-1] * y, jnp.zeros_like(y), jax.tree.map(jnp.zeros_like, parts))
    (*_, total), _ = jax.lax.scan(down, start, (factors, c[:-1]), reverse=True)
    return total


def _changed_filter(operator: Operator, c: Array, x: Array, change: PyTree) -> Array:
    """The derivative of a filter in the direction of a change of the operator's floating leaves."""
    return jax.jvp(lambda part: _filter_scan(combine(part, operator), c, x), (floats(operator),), (change,))[1]


_change = Linear(_changed_filter, _pulled_back)

# f(Δ)x as a function of x.
_filter = Linear(
    _filter_scan,
    _transposed_filter,
    (_change, lambda operator, c, x, change: _combination(len(c))(operator, x, change)),
)


@cache
def _combination(terms: int) -> Linear:
    """f(Δ)x as a function of its coefficients: `(operator, x, c)`."""
    return Linear(
        lambda operator, x, c: _filter_scan(operator, c, x),
        _projection(terms),
        (
            lambda operator, x, c, change: _change(operator, c, x, change),
            lambda operator, x, c, change: _filter(operator, c, change),
        ),
    )


@cache
def _projection(terms: int) -> Linear:
    """Σ_v u_v (T_k(Δ̃)x)_v for so many k as a function of u: `(operator, x, u)`."""

    def of_signal(operator: Operator, x: Array, u: Array, change: Array) -> Array:
        mass = _inner_mass(operator, u)
        return _projection(terms)(operator, u / mass, mass * change)

    return Linear(
        partial(_projection_scan, terms),
        lambda operator, x, m: _combination(terms)(operator, x, m),
        (_changed_projection(terms), of_signal),
    )


@cache
def _changed_projection(terms: int) -> Linear:
    """The derivative of a projection in the direction of a change of the operator's floating leaves."""

    def apply(operator: Operator, x: Array, u: Array, change: PyTree) -> Array:
        def of_operator(part: PyTree) -> Array:
            return _projection_scan(terms, combine(part, operator), x, u)

        return jax.jvp(of_operator, (floats(operator),), (change,))[1]

    return Linear(apply, lambda operator, x, u, m: _pulled_back(operator, m, x, u))


def _inner_mass(operator: Operator, x: Array) -> Array:
    """The mass of each vertex, or 1 at vertices without any: they are blocks of their own, so any mass serves."""
    mass = per_row(operator.mass, x)
    return jnp.where(mass > 0, mass, 1)


def _sums(x: Array) -> Array:
    """Sum over vertices, column by column; many rows at a time, because processors sum few columns slowly."""
    whole = len(x) // _ROWS_AT_ONCE * _ROWS_AT_ONCE
    wide = x[:whole].reshape(-1, _ROWS_AT_ONCE * (x.size // max(len(x), 1))).sum(axis=0)
    return wide.reshape(_ROWS_AT_ONCE, *x.shape[1:]).sum(axis=0) + x[whole:].sum(axis=0)


def _check_bands(coefficients: Array | np.ndarray) -> Array:
    c = jnp.asarray(coefficients)
    if c.ndim != 2 or c.shape[1] == 0:
        raise JaxmarkError(f"Band coefficients must be [bands, degree + 1], got {c.shape}.")
    return c
