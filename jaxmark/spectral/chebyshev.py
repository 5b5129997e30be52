"""Polynomials of the Laplacian by the three-term recurrence, with derivatives in O(N) memory.

The spectrum of Δ̃ = Δ - I lies in [-1, 1], and T_k(Δ̃)x follows by T_k = 2Δ̃T_{k-1} - T_{k-2} (Sohn et al., Method 2; the
paper's start t_0 = 0, T_0 = 0 is an erratum for t_0 = 1, T_0 = I). All functions here take signals `[N]` or `[N, C]`,
keep the dtype of the signal, and cost `degree` products with Δ.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.laplacian import Laplacian, Operator, per_row
from jaxmark.spectral.precision import einsum, matmul

Signal = Float[Array | np.ndarray, " vertices *columns"]

_BANDS_AT_ONCE = 5  # band components that are formed together where each is used only once
_ROWS_AT_ONCE = 128  # rows that are summed as one wide row
_MIN_UNROLLED_VALUES = 2**16  # values of a signal from which on running the recurrence takes longer than compiling it


def filter(
    operator: Operator,
    coefficients: Float[Array | np.ndarray, " terms *filters"],
    x: Signal,
    *,
    derivative: Literal["recompute", "scan"] = "recompute",
) -> Float[Array, " vertices *columns"]:
    """Filter a signal: f(Δ)x for the Chebyshev series f(λ) = Σ_k c_k T_k(λ - 1), as one `lax.scan`.

    Args:
        operator: the Laplacian, of N vertices.
        coefficients: `[degree + 1]`, or `[degree + 1, C]` for one filter per column of `x`.
        x: `[N]` or `[N, C]`.
        derivative: `"recompute"` (default) takes O(N) memory in reverse mode at any degree: because Δ is self-adjoint,
            x̄ = D f(Δ) D⁻¹ȳ is another filter, and c̄_k = Σ ȳ·T_k(Δ̃)x is computed by running the recurrence again. It
            has no forward mode and no derivative with respect to the operator. `"scan"` leaves differentiation to JAX:
            it has forward mode and derivatives with respect to edge weights and degrees, and takes O(degree · N) memory
            in reverse mode.

    Returns:
        f(Δ)x, in the shape and dtype of `x`.

    Raises:
        JaxmarkError: if shapes do not fit, or the operator is differentiated under `"recompute"`.
    """
    x = jnp.asarray(x)
    _check_signal("filter", operator, x)
    c = jnp.asarray(coefficients).astype(x.dtype)
    if c.ndim not in (1, 2) or len(c) == 0 or (c.ndim == 2 and c.shape[1:] != x.shape[1:]):
        raise JaxmarkError(
            f"filter needs coefficients [degree + 1] or [degree + 1, C] for a signal {x.shape}, got {c.shape}."
        )
    match derivative:
        case "recompute":
            return _filter_recompute(operator, c, x)
        case "scan":
            return _filter_scan(operator, c, x)
    raise JaxmarkError(f"derivative must be 'recompute' or 'scan', got {derivative!r}.")


def transpose(
    operator: Operator, coefficients: Float[Array | np.ndarray, " terms *filters"], y: Signal
) -> Float[Array, " vertices *columns"]:
    """f(Δ)ᵀy = D f(Δ) D⁻¹y, by the self-adjointness of Δ: the Euclidean adjoint of `filter`, with its arguments."""
    y = jnp.asarray(y)
    mass = per_row(operator.degree, y)
    mass = jnp.where(mass > 0, mass, 1)  # an isolated vertex is its own block of Δ, so any positive mass serves
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
    _check_signal("band_components", operator, x)
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
    """Compute ⟨u, T_k(Δ̃)x⟩_D for k = 0 … degree, column by column.

    They give the correlation of `u` with every band: ⟨u, f_j(Δ)x⟩_D = Σ_k C_jk ⟨u, T_k x⟩_D. Weak bands are then small
    differences of large numbers: in float32 a band is lost where ‖f_j x‖ is below about 1e-6 ‖x‖. Reverse mode takes
    two filters and O(N) memory; there is no forward mode and no derivative with respect to the operator.

    Args:
        operator: the Laplacian, of N vertices.
        u: `[N]` or `[N, C]`.
        x: in the shape of `u`.
        degree: the largest k.

    Returns:
        `[degree + 1]` or `[degree + 1, C]`.

    Raises:
        JaxmarkError: if shapes do not fit, or the operator is differentiated.
    """
    x = jnp.asarray(x)
    u = jnp.asarray(u).astype(x.dtype)
    _check_signal("cross_moments", operator, x)
    if u.shape != x.shape:
        raise JaxmarkError(f"cross_moments needs two signals of one shape, got {u.shape} and {x.shape}.")
    return _projections(operator, per_row(operator.degree, u) * u, x, degree)


def band_energies(
    operator: Laplacian,
    coefficients: Float[Array, "bands terms"],
    u: Float[Array, "vertices columns"],
    v: Float[Array, "vertices columns"],
) -> Float[Array, " bands"]:
    """⟨u, f_j(Δ)v⟩ for each band, with vertices weighed by valence over its mean; of unit noise, the dimensions."""
    moments = cross_moments(operator, u, v, degree=coefficients.shape[1] - 1)
    mass = operator.degree.astype(u.dtype)
    return matmul(coefficients, moments.sum(axis=1)) * (jnp.sum(jnp.sign(mass)) / mass.sum())


@partial(jax.jit, static_argnames="degree")
def moments(operator: Laplacian, x: Signal, *, degree: int) -> Float[Array, " moments *columns"]:
    """Compute the moments m_k = ⟨x, T_k(Δ̃)x⟩_D for k = 0 … 2·degree by only `degree` products, column by column.

    By T_{j+k} + T_{|j-k|} = 2T_jT_k: m_2k = 2⟨T_k x, T_k x⟩_D - m_0 and m_{2k-1} = 2⟨T_k x, T_{k-1} x⟩_D - m_1. Reverse
    mode takes a filter of twice the degree and O(N) memory; there is no forward mode and no derivative with respect to
    the operator.

    Args:
        operator: the Laplacian, of N vertices.
        x: `[N]` or `[N, C]`.
        degree: number of products, half of the largest k.

    Returns:
        `[2 · degree + 1]` or `[2 · degree + 1, C]`.

    Raises:
        JaxmarkError: if shapes do not fit, or the operator is differentiated.
    """
    x = jnp.asarray(x)
    _check_signal("moments", operator, x)
    return _moments(operator, x, degree)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _moments(operator: Laplacian, x: Array, degree: int) -> Array:
    x, mass = operator.enter(x), operator.enter(per_row(operator.degree, x))

    def products(_: None, t: Array, before: Array, __: Array) -> tuple[None, tuple[Array, Array]]:
        return None, (_sums(mass * t * before), _sums(mass * t * t))

    _, (odd, even) = _scan_terms(operator, x, jnp.zeros(degree + 1, x.dtype), products, None)
    m0 = jnp.sum(mass * x * x, axis=0)[None]
    if degree == 0:
        return m0
    pairs = jnp.stack([2 * odd - odd[0], 2 * even - m0], axis=1)
    return jnp.concatenate([m0, pairs.reshape(2 * degree, *x.shape[1:])])


def _moments_forward(operator: Any, x: Any, degree: int) -> tuple[Array, tuple[Any, Array]]:
    inputs: Any = (_fixed(operator, "moments", ""), x.value)
    return _moments(*inputs, degree), inputs


def _moments_reverse(degree: int, inputs: tuple[Any, Array], cotangent: Any) -> tuple[None, Array]:
    """The cotangent x̄ = 2D Σ_k m̄_k T_k(Δ̃)x, since each moment is a quadratic form in x with a self-adjoint T_k(Δ̃)."""
    operator, x = inputs
    return None, 2 * per_row(operator.degree, x) * _filter_recompute(operator, _instantiate(cotangent), x)


_moments.defvjp(_moments_forward, _moments_reverse, symbolic_zeros=True)


@partial(jax.jit, static_argnames="method")
def gram(
    operator: Laplacian,
    coefficients: Float[Array | np.ndarray, "bands terms"],
    x: Signal,
    *,
    method: Literal["bands", "moments"] = "bands",
) -> Float[Array, "*columns bands bands"]:
    """Gram matrix ⟨f_i(Δ)x, f_j(Δ)x⟩_D of the band components, one for each column of `x`.

    Args:
        operator: the Laplacian, of N vertices.
        coefficients: one Chebyshev series per row, `[bands, degree + 1]`.
        x: `[N]` or `[N, C]`.
        method: `"bands"` forms the components; it takes O(bands · N) memory and is accurate for weak bands. `"moments"`
            takes O(N) memory by ⟨T_j x, T_k x⟩_D = (m_{j+k} + m_{|j-k|})/2, but entries below about eps · ‖x‖² are
            rounding noise: use it in float64, or where no band is weak.

    Returns:
        `[bands, bands]`, or `[C, bands, bands]` for `[N, C]`.
    """
    _check_signal("gram", operator, x)
    c = _check_bands(coefficients).astype(x.dtype)
    match method:
        case "bands":
            y = band_components(operator, c, x)
            return einsum("v,iv...,jv...->...ij", jnp.asarray(operator.degree).astype(x.dtype), y, y)
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


@jax.custom_vjp
def _filter_recompute(operator: Operator, coefficients: Array, x: Array) -> Array:
    return _filter_scan(operator, coefficients, x)


def _filter_forward(operator: Any, coefficients: Any, x: Any) -> tuple[Array, tuple[Operator, Array, Array]]:
    inputs = (
        _fixed(operator, "filter", "; call it with derivative='scan' for one in O(degree · N)"),
        coefficients.value,
        x.value,
    )
    return _filter_scan(*inputs), inputs


def _filter_reverse(inputs: tuple[Operator, Array, Array], cotangent: Any) -> tuple[None, Array, Array]:
    operator, coefficients, x = inputs
    y_bar = _instantiate(cotangent)
    c_bar: Any = _projections(operator, y_bar, x, len(coefficients) - 1)
    return None, c_bar if coefficients.ndim == x.ndim else c_bar.sum(axis=1), transpose(operator, coefficients, y_bar)


_filter_recompute.defvjp(_filter_forward, _filter_reverse, symbolic_zeros=True)


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _projections(operator: Operator, u: Array, x: Array, degree: int) -> Array:
    """Compute Σ_v u_v (T_k(Δ̃)x)_v for k = 0 … degree, column by column."""
    return _projections_scan(operator, u, x, degree)


@partial(jax.jit, static_argnums=3)
def _projections_scan(operator: Operator, u: Array, x: Array, degree: int) -> Array:
    u, x = operator.enter(u), operator.enter(x)

    def project(_: None, t: Array, __: Array, ___: Array) -> tuple[None, Array]:
        return None, _sums(u * t)

    _, rest = _scan_terms(operator, x, jnp.zeros(degree + 1, x.dtype), project, None)
    return jnp.concatenate([_sums(u * x)[None], rest])


def _projections_forward(operator: Any, u: Any, x: Any, degree: int) -> tuple[Array, tuple[Operator, Array, Array]]:
    inputs = (_fixed(operator, "cross_moments", ""), u.value, x.value)
    return _projections_scan(*inputs, degree), inputs


def _projections_reverse(
    degree: int, inputs: tuple[Operator, Array, Array], cotangent: Any
) -> tuple[None, Array, Array]:
    """The cotangents of u and x: two filters, with the cotangents of the projections as coefficients."""
    operator, u, x = inputs
    m_bar = _instantiate(cotangent)
    return None, _filter_recompute(operator, m_bar, x), transpose(operator, m_bar, u)


_projections.defvjp(_projections_forward, _projections_reverse, symbolic_zeros=True)


def _sums(x: Array) -> Array:
    """Sum over vertices, column by column; many rows at a time, because processors sum few columns slowly."""
    whole = len(x) // _ROWS_AT_ONCE * _ROWS_AT_ONCE
    wide = x[:whole].reshape(-1, _ROWS_AT_ONCE * (x.size // max(len(x), 1))).sum(axis=0)
    return wide.reshape(_ROWS_AT_ONCE, *x.shape[1:]).sum(axis=0) + x[whole:].sum(axis=0)


def _fixed(operator: Any, name: str, remedy: str) -> Operator:
    """The operator inside a derivative rule; refused if it is differentiated itself."""
    leaves, structure = jax.tree.flatten(operator, is_leaf=lambda leaf: hasattr(leaf, "perturbed"))
    if any(leaf.perturbed for leaf in leaves):
        raise JaxmarkError(f"{name} has no derivative with respect to the operator's weights in O(N) memory{remedy}.")
    return jax.tree.unflatten(structure, [leaf.value for leaf in leaves])


def _instantiate(cotangent: Any) -> Array:
    """A cotangent as an array, even if JAX passes a symbolic zero."""
    if isinstance(cotangent, jax.custom_derivatives.SymbolicZero):
        return jnp.zeros(cotangent.shape, cotangent.dtype)  # pyright: ignore[reportArgumentType]
    return jnp.asarray(cotangent)  # it may be a NumPy array


def _check_signal(name: str, operator: Operator, x: Array | np.ndarray) -> None:
    if x.ndim not in (1, 2) or x.shape[0] != operator.degree.shape[0]:
        raise JaxmarkError(
            f"{name} needs a signal [N] or [N, C] with N = {operator.degree.shape[0]} vertices, got {x.shape}."
        )
    if not jnp.issubdtype(x.dtype, jnp.floating):
        raise JaxmarkError(f"{name} needs a floating-point signal, got {x.dtype}.")


def _check_bands(coefficients: Array | np.ndarray) -> Array:
    c = jnp.asarray(coefficients)
    if c.ndim != 2 or c.shape[1] == 0:
        raise JaxmarkError(f"Band coefficients must be [bands, degree + 1], got {c.shape}.")
    return c
