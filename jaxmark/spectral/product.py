"""Polynomials of the Laplacian as products of first-degree factors (Sohn et al., Method 1).

This is slower than Method 2, the recurrence of `chebyshev`, because bands share no products. With the zeros in the
paper's order it loses digits with every factor: 32 scaling functions lose all digits of float32 and half of float64's,
64 lose all of both, and from 128 on float32 overflows. In Leja's order it keeps as many digits as the recurrence, at
any degree that was tried. `python benchmarks/theory/families.py MESH --parts methods` measures this.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.laplacian import Operator, Signal, checked_signal


class Factors(NamedTuple):
    """Factors of f(λ) = Π_i scale_i (λ - zero_i), in the order in which they are applied."""

    zeros: Float[Array | np.ndarray, "*bands factors"]
    scales: Float[Array | np.ndarray, "*bands factors"]


def lagrange_factors(nodes: Float[np.ndarray, " bands"], *, order: Literal["leja", "printed"] = "leja") -> Factors:
    """Factor the Lagrange polynomials Π_{i≠j} (λ - λ_i)/(λ_j - λ_i), one node a row: `[bands, bands - 1]`.

    At the zeros of a Chebyshev polynomial these are the scaling functions; `lagrange` gives their Chebyshev series.

    Args:
        nodes: λ `[bands]`, distinct, in [0, 2].
        order: `"printed"` applies the zeros in the order of the nodes and A_j = 1/Π_{i≠j}(λ_j - λ_i) as a whole at the
            end, as the paper does (its Method 1 omits A_j, which is an erratum). `"leja"` applies the zeros in Leja's
            order, each as far as possible from those before it, and A_j in equal parts (Reichel, BIT 30, 1990).

    Raises:
        JaxmarkError: if there are fewer than two nodes, two coincide, or `order` is unknown.
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
    """Order nodes by Leja: the largest first, then always the node with the largest product of distances to the others.

    So the products of the first factors are of similar size over the whole spectrum (Reichel, BIT 30, 1990).
    """
    chosen = [int(np.argmax(np.abs(nodes)))]
    with np.errstate(divide="ignore"):
        distances = np.log(np.abs(nodes[:, None] - nodes))
    total = distances[chosen[0]].copy()
    for _ in range(len(nodes) - 1):
        chosen.append(int(np.argmax(total)))
        total += distances[chosen[-1]]
    return np.array(chosen, np.int64)


@jax.jit
def filter_by_factors(operator: Operator, factors: Factors, x: Signal) -> Float[Array, " vertices *columns"]:
    """Filter a signal factor by factor: f(Δ)x as one `lax.scan`, with one product per factor.

    All bands at once are `jax.vmap(filter_by_factors, (None, 0, None))(operator, factors, x)`; they share no products,
    so that n + 1 bands take n + 1 times the products of `chebyshev.band_components`. Derivatives are JAX's own, in all
    modes: with respect to `x` in O(N) memory, with respect to factors and operator in O(degree · N).

    Args:
        operator: the Laplacian, of N vertices.
        factors: the factors of one band, `[degree]` each.
        x: `[N]` or `[N, C]`, whose dtype the result keeps.

    Raises:
        JaxmarkError: if the shapes do not fit.
    """
    x = checked_signal("filter_by_factors", operator, x)
    zeros, scales = (jnp.asarray(part).astype(x.dtype) for part in factors)
    if zeros.ndim != 1 or zeros.shape != scales.shape:
        raise JaxmarkError(f"filter_by_factors needs factors [degree], got {zeros.shape} and {scales.shape}.")
    product = operator.product(x)
    x = operator.enter(x)

    def step(y: Array, factor: tuple[Array, Array]) -> tuple[Array, None]:
        zero, scale = factor
        return scale * (product(y) - zero * y), None

    return operator.leave(jax.lax.scan(step, x, (zeros, scales))[0])
