"""Polynomials of the Laplacian as products of first-degree factors (Sohn et al., Method 1).

Beside Method 2, the recurrence of `chebyshev`, this is the slower one, for bands share nothing. With the zeros in the
order that the paper has them it loses digits with every factor: of 32 scaling functions all of float32's and half of
float64's, of 64 all, and from 128 on float32 overflows. In Leja's order it keeps as many as the recurrence, at any
degree that was tried. `python benchmarks/families.py MESH --parts methods` measures all that.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.laplacian import Operator


class Factors(NamedTuple):
    """f(λ) = Π_i scale_i (λ - zero_i), applied in this order."""

    zeros: Float[Array | np.ndarray, "*bands factors"]
    scales: Float[Array | np.ndarray, "*bands factors"]


def lagrange_factors(nodes: Float[np.ndarray, " bands"], *, order: Literal["leja", "printed"] = "leja") -> Factors:
    """Lagrange polynomials Π_{i≠j} (λ - λ_i)/(λ_j - λ_i) in factors, one node a row.

    At the zeros of a Chebyshev polynomial these are the scaling functions, `lagrange` has their Chebyshev series.

    Args:
        nodes: λ `[bands]`, distinct, in [0, 2].
        order: `"printed"` takes the zeros as they come and A_j = 1/Π_{i≠j}(λ_j - λ_i) in one piece at the end, as
            the paper does (it leaves A_j out in Method 1: an erratum). `"leja"` takes the zeros in Leja's order, each
            as far as may be from those before it, and A_j in equal parts (Reichel, BIT 30, 1990).

    Returns:
        Factors `[bands, bands - 1]` each.

    Raises:
        JaxmarkError: if two nodes fall together, or `order` is unknown.
    """
    size = len(nodes)
    if size < 2 or len(np.unique(nodes)) < size:
        raise JaxmarkError(f"lagrange_factors needs two nodes or more, all distinct, got {nodes}.")
    rows = np.arange(size)
    others = np.stack([rows[rows != j] for j in rows])
    gaps = nodes[:, None] - nodes[others]
    match order:
        case "printed":
            scales = np.ones_like(gaps)
            with np.errstate(over="ignore", divide="ignore"):
                scales[:, -1] = 1 / gaps.prod(axis=1)
            return Factors(nodes[others], scales)
        case "leja":
            scales = np.repeat(np.exp(-np.log(np.abs(gaps)).mean(axis=1, keepdims=True)), size - 1, axis=1)
            scales[:, 0] *= np.sign(gaps).prod(axis=1)
            return Factors(np.stack([nodes[other][leja(nodes[other])] for other in others]), scales)
    raise JaxmarkError(f"order must be 'leja' or 'printed', got {order!r}.")


def leja(nodes: Float[np.ndarray, " nodes"]) -> Int64[np.ndarray, " nodes"]:
    """The order in which each node has the largest product of distances to those before it; the first is the largest.

    So the products of the first factors stay of one size over all of the spectrum (Reichel, BIT 30, 1990).
    """
    chosen = [int(np.argmax(np.abs(nodes)))]
    with np.errstate(divide="ignore"):
        distances = np.log(np.abs(nodes[:, None] - nodes))
    total = distances[chosen[0]].copy()
    for _ in range(len(nodes) - 1):
        chosen.append(int(np.argmax(total)))
        total += distances[chosen[-1]]
    return np.array(chosen, np.int64)


def filter(
    operator: Operator, factors: Factors, x: Float[Array | np.ndarray, " vertices *columns"]
) -> Float[Array, " vertices *columns"]:
    """f(Δ)x factor by factor, as one `lax.scan` of as many products.

    All bands are `jax.vmap(filter, (None, 0, None))(operator, factors, x)`, and share nothing: n + 1 times the products
    of `chebyshev.band_components`. Derivatives in all modes are JAX's own; with respect to `x` in O(N) memory, to
    factors and operator in O(degree · N).

    Args:
        operator: the Laplacian, of N vertices.
        factors: of one band, `[degree]` each.
        x: `[N]` or `[N, C]`.

    Returns:
        f(Δ)x, in the shape and dtype of `x`.

    Raises:
        JaxmarkError: if the shapes do not fit.
    """
    x = jnp.asarray(x)
    zeros, scales = (jnp.asarray(part).astype(x.dtype) for part in factors)
    if len(x) != operator.degree.shape[0] or zeros.ndim != 1 or zeros.shape != scales.shape:
        raise JaxmarkError(
            f"product.filter needs factors [degree] and a signal [N] or [N, C] with N = {operator.degree.shape[0]},"
            f" got {zeros.shape}, {scales.shape} and {x.shape}."
        )
    product = operator.product(x)
    x = operator.enter(x)

    def step(y: Array, factor: tuple[Array, Array]) -> tuple[Array, None]:
        zero, scale = factor
        return scale * (product(y) - zero * y), None

    return operator.leave(jax.lax.scan(step, x, (zeros, scales))[0])
