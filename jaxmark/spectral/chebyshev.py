"""Polynomials of the Laplacian by the three-term recurrence, with derivatives in O(N) memory.

The spectrum of Δ̃ = Δ - I lies in [-1, 1], and T_k(Δ̃)x follows by T_k = 2Δ̃T_{k-1} - T_{k-2} (Sohn et al., Method 2; the
paper's start t_0 = 0, T_0 = 0 is an erratum for t_0 = 1, T_0 = I). `recurrence` computes all of it, and has the
derivatives.

All functions take an operator with N vertices and signals `[N]` or `[N, C]` in float32 or float64, keep the dtype of
the signal, and cost `degree` products with Δ. A bank of filters is `[bands, degree + 1]`, one Chebyshev series a row.
`JaxmarkError` is raised if shapes or dtypes do not fit.
"""

# `help` then shows the names of type aliases, such as ArrayLike, and not all that they stand for.
from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxmark.errors import JaxmarkError
from jaxmark.spectral import recurrence
from jaxmark.spectral.bands._lowpasses import heat_degree
from jaxmark.spectral.bands._partitions import nodes
from jaxmark.spectral.laplacian import Laplacian, Operator, Signal, checked_signal, per_row
from jaxmark.spectral.precision import check_precision, einsum, matmul

Series = Float[Array | np.ndarray, "*filters terms"]
Bank = Float[Array | np.ndarray, "bands terms"]

_MIN_ALIGNED = 2**16  # vertices from which on a fourth column pays on a GPU, by measurement
_VALUES_AT_ONCE = 60  # values per vertex of band components that are formed together


def filter(operator: Operator, coefficients: Series, x: Signal) -> Float[Array, " vertices *columns"]:
    """Filter a signal: f(Δ)x for the Chebyshev series f(λ) = Σ_k c_k T_k(λ - 1), as one `lax.scan`.

    Derivatives of any order and mode are with respect to the coefficients, the signal and the operator's weights,
    degrees and mass. The first, in reverse mode too, take O(N) memory at any degree, and so do forward-mode derivatives
    of these, such as products with Hessians. Reverse mode takes one filter for the signal and one for the coefficients;
    for the operator, it runs the recurrence back and forth, which takes about six filters.

    Args:
        operator: the Laplacian, of N vertices.
        coefficients: `[degree + 1]`, or `[C, degree + 1]` for one filter per column of `x`; those of a function of λ
            are given by `fit`.
        x: `[N]` or `[N, C]`.

    Returns:
        f(Δ)x, in the shape and dtype of `x`.

    Raises:
        JaxmarkError: if coefficients or signal have other shapes or types.
    """
    if callable(coefficients):
        raise JaxmarkError(
            "filter takes Chebyshev coefficients; those of a function are spectral.fit(function, degree).coefficients."
        )
    return _filter(operator, coefficients, x)


@jax.jit
def _filter(operator: Operator, coefficients: Series, x: Signal) -> Float[Array, " vertices *columns"]:
    x = checked_signal("filter", operator, x)
    if jnp.iscomplexobj(coefficients):
        raise JaxmarkError("filter needs real coefficients, got complex ones.")
    c = jnp.asarray(coefficients).astype(x.dtype)
    if c.ndim not in (1, 2) or c.shape[-1] == 0 or (c.ndim == 2 and c.shape[:1] != x.shape[1:]):
        raise JaxmarkError(
            f"filter needs coefficients [degree + 1] or [C, degree + 1] for a signal {x.shape}, got {c.shape}."
        )
    c = jnp.broadcast_to(c, (*x.shape[1:], c.shape[-1])).T
    if x.shape[1:] == (3,) and len(x) >= _MIN_ALIGNED and jax.default_backend() == "gpu":
        # GPUs load rows of 16 bytes at once, but not those of 12.
        c, padded = (jnp.pad(array, ((0, 0), (0, 1))) for array in (c, x))
        return recurrence.filtered(operator, c, padded)[:, :3]
    return recurrence.filtered(operator, c, x)


@jax.jit
def transpose(operator: Operator, coefficients: Series, y: Signal) -> Float[Array, " vertices *columns"]:
    """Apply the Euclidean adjoint of `filter`: f(Δ)ᵀy = M f(Δ) M⁻¹y, as Δ is self-adjoint."""
    y = jnp.asarray(y)
    mass = recurrence.inner_mass(operator, y)
    return mass * filter(operator, coefficients, y / mass)


@jax.jit
def band_components(operator: Laplacian, coefficients: Bank, x: Signal) -> Float[Array, "bands vertices *columns"]:
    """Compute all band components f_j(Δ)x, `[bands, N]` or `[bands, N, C]`, in one pass; O(bands · N) memory."""
    x = checked_signal("band_components", operator, x)
    return recurrence.components(operator, _check_bands(coefficients).astype(x.dtype), x)


@jax.jit
def synthesise(
    operator: Operator, coefficients: Bank, parts: Float[Array | np.ndarray, ...]
) -> Float[Array, " vertices *columns"]:
    """Sum up filtered parts `[bands, N]` or `[bands, N, C]`: Σ_j g_j(Δ)y_j, in one pass; O(bands · N) memory.

    This is the adjoint of `band_components` in the inner product ⟨, ⟩_M. It is its inverse, too, if the frame is
    `tight` with Σ_j g_j² = 1. Derivatives are as those of `filter`.
    """
    parts, c = jnp.asarray(parts), _check_bands(coefficients)
    check_parts("synthesise", operator, c, parts)
    return recurrence.synthesis(operator, c.astype(parts.dtype), parts)


@partial(jax.jit, static_argnums=0)
def over_bands(
    function: Callable[[Float[Array, " vertices *columns"]], Any], operator: Laplacian, coefficients: Bank, x: Signal
) -> Any:
    """Apply a function to each band component f_j(Δ)x, a few at a time, so that it takes O(N) memory.

    The function maps one component, in the shape of `x`, to an array or a tuple of arrays, which are stacked along a
    leading axis of bands. Eager calls compile once for each function object, so define it outside of loops.
    """
    c, x = _check_bands(coefficients), jnp.asarray(x)
    most = max(_VALUES_AT_ONCE * len(x) // max(x.size, 1), 1)
    at_once = -(-len(c) // -(-len(c) // most))  # groups of nearly equal size
    groups = jnp.pad(c, ((0, -len(c) % at_once), (0, 0))).reshape(-1, at_once, c.shape[1])

    @jax.checkpoint
    def over_group(group: Array) -> Any:
        return jax.vmap(function)(band_components(operator, group, x))

    found = jax.lax.map(over_group, groups)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[: len(c)], found)


@partial(jax.jit, static_argnames="degree")
def cross_moments(operator: Laplacian, u: Signal, x: Signal, *, degree: int) -> Float[Array, " terms *columns"]:
    """Compute ⟨u, T_k(Δ̃)x⟩_M for k = 0 … degree, column by column: `[degree + 1]` or `[degree + 1, C]`.

    They give the correlation of `u` with every band: ⟨u, f_j(Δ)x⟩_M = Σ_k C_jk ⟨u, T_k x⟩_M. Weak bands are then small
    differences of large numbers: in float32 a band is lost where ‖f_j x‖ is below about 1e-6 ‖x‖. Derivatives are as
    those of `filter`.
    """
    x = checked_signal("cross_moments", operator, x)
    u = jnp.asarray(u).astype(x.dtype)
    if u.shape != x.shape:
        raise JaxmarkError(f"cross_moments needs two signals of one shape, got {u.shape} and {x.shape}.")
    return recurrence.projection(degree + 1)(operator, x, per_row(operator.mass, u) * u)


def band_energies(
    operator: Laplacian,
    coefficients: Float[Array, "bands terms"],
    u: Float[Array, "vertices columns"],
    v: Float[Array, "vertices columns"],
) -> Float[Array, " bands"]:
    """Compute ⟨u, f_j(Δ)v⟩ of each band, with mass over its mean as weights; of unit noise, the bands' dimensions."""
    products = cross_moments(operator, u, v, degree=coefficients.shape[1] - 1).sum(axis=1)
    return matmul(coefficients, products / _mean_mass(operator, u))


def energy_moments(operator: Laplacian, x: Float[Array, "vertices columns"], terms: int) -> Float[Array, " terms"]:
    """Compute ⟨x, T_k(Δ̃)x⟩ for so many k, with mass over its mean as weights, over all columns; see `moments`."""
    return moments(operator, x, degree=terms // 2)[:terms].sum(axis=1) / _mean_mass(operator, x)


def _mean_mass(operator: Laplacian, like: Array) -> Float[Array, ""]:
    """Compute the mean mass of the vertices that have one."""
    mass = jnp.asarray(operator.mass).astype(like.dtype)
    return mass.sum() / jnp.sum(jnp.sign(mass))


@partial(jax.jit, static_argnames="degree")
def moments(operator: Laplacian, x: Signal, *, degree: int) -> Float[Array, " moments *columns"]:
    """Compute the moments m_k = ⟨x, T_k(Δ̃)x⟩_M for k = 0 … 2·degree by only `degree` products, column by column.

    By T_{j+k} + T_{|j-k|} = 2T_jT_k: m_2k = 2⟨T_k x, T_k x⟩_M - m_0 and m_{2k-1} = 2⟨T_k x, T_{k-1} x⟩_M - m_1. The
    result is `[2 · degree + 1]` or `[2 · degree + 1, C]`. Derivatives are those of `cross_moments` of twice the degree.
    """
    return recurrence.moments(operator, checked_signal("moments", operator, x), degree)


@partial(jax.jit, static_argnames="method")
def gram(
    operator: Laplacian, coefficients: Bank, x: Signal, *, method: Literal["bands", "moments"] = "bands"
) -> Float[Array, "*columns bands bands"]:
    """Compute the Gram matrix ⟨f_i(Δ)x, f_j(Δ)x⟩_M of the band components, one for each column of `x`.

    Args:
        operator: the Laplacian, of N vertices.
        coefficients: `[bands, degree + 1]`.
        x: `[N]` or `[N, C]`.
        method: `"bands"` forms the components; it takes O(bands · N) memory and is accurate for weak bands. `"moments"`
            takes O(N) memory by ⟨T_j x, T_k x⟩_M = (m_{j+k} + m_{|j-k|})/2, but entries below about eps · ‖x‖² are
            rounding noise: use it in float64, or where no band is weak.

    Returns:
        `[bands, bands]`, or `[C, bands, bands]` for `[N, C]`.
    """
    x = checked_signal("gram", operator, x)
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


def heat(
    operator: Operator, x: Signal, t: ArrayLike | Array, *, degree: int | None = None
) -> Float[Array, " vertices *columns"]:
    """Let heat flow for a time t: e^{-tΔ}x, the solution of ẋ = -Δx.

    One `filter` of a degree that grows as √t, with its derivatives, also with respect to t. Several times of one signal
    take one pass by `band_components(operator, bands.heat(times), x)`.

    The error in the M-norm, relative to `x`, was at most t/5 times the machine epsilon, plus a few epsilons, on the
    meshes and paths measured: in float64 4e-12 at t = 10⁵. In float32 it is 1e-6 at t = 10²; at 10⁵ it is 2e-5 under
    valence weights and 6e-4 under cotangent ones, whose sums are rounded, too.

    Args:
        operator: the Laplacian, of N vertices.
        x: `[N]` or `[N, C]`.
        t: the time, not negative; or `[C]`, one for each column.
        degree: degree of the polynomial; by default the truncation is below the epsilon of the dtype of `x`. It is an
            array's shape, so it must be given where t is traced (under `jit`, `grad` or `vmap` of t): for times up to
            T, `bands.heat([T]).shape[1] - 1` is enough.

    Raises:
        JaxmarkError: if t is negative or not finite, or it is traced and no degree is given.
    """
    x = jnp.asarray(x)
    check_precision("heat", x)
    if np.shape(t) not in ((), x.shape[1:]):
        raise JaxmarkError(f"heat needs one time, or one for each column of a signal {x.shape}, got {np.shape(t)}.")
    if not isinstance(t, Tracer):
        enough = heat_degree(np.asarray(t), float(jnp.finfo(x.dtype).eps))
        degree = enough if degree is None else degree
    if degree is None:
        raise JaxmarkError("heat(degree=...) must be given where t is traced, for example under jit or grad.")
    return _flow(operator, x, jnp.asarray(t), degree)


@partial(jax.jit, static_argnames="degree")
def _flow(operator: Operator, x: Array, t: Array, degree: int) -> Array:
    values = jnp.exp(-jnp.multiply.outer(jnp.asarray(nodes(degree + 1), x.dtype), t.astype(x.dtype)))
    # The series that interpolates at the nodes; they ascend in λ, where the transform has them descend.
    series = jax.scipy.fft.dct(values[::-1], axis=0) / (degree + 1)
    return filter(operator, series.at[0].divide(2).T, x)


def _check_bands(coefficients: Array | np.ndarray) -> Array:
    c = jnp.asarray(coefficients)
    if c.ndim != 2 or c.shape[1] == 0:
        raise JaxmarkError(f"Band coefficients must be [bands, degree + 1], got {c.shape}.")
    return c


def check_parts(name: str, operator: Operator, c: Array | np.ndarray, parts: Array) -> None:
    """Refuse parts that are not one signal for each band.

    Raises:
        JaxmarkError: if they are not `[bands, N]` or `[bands, N, C]`, in float32 or float64.
    """
    if parts.ndim not in (2, 3) or len(parts) != len(c):
        raise JaxmarkError(f"{name} needs parts [bands, N] or [bands, N, C] of {len(c)} bands, got {parts.shape}.")
    checked_signal(name, operator, parts[0])
